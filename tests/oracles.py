"""The same as the package says, another way: what tests hold it against."""

from __future__ import annotations

import numpy as np

from clamber.contact.contact import Contact
from clamber.model.kinematics import Kinematics


def contact_drift(kin: Kinematics, c: Contact) -> float:
    """Distance of a contact from where it should be at the present posture [m]."""
    n = kin.world.supports[c.support].normal
    p = kin.contact_point(c.surface, n, c.edge)
    return float(np.linalg.norm(p - c.position - kin.roll(c.surface, n, c.link)))
