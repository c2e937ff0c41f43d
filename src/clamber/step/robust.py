"""Robust stability margin of a posture, under errors of model and contacts.

The margin of the centre of mass that is left in the worst case of a mass, a friction, a
centre of mass and contacts that are each a little off: the largest displacement that
contact forces within friction cones and torque limits bear in every direction, an LP
each [DelPrete16], less what the centre of mass and the contacts may be off. On level
supports this is exact: contacts that are moved by d are a centre of mass moved by -d,
and no contact moves the border of the support polygon by more than itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from clamber import _core
from clamber.contact.contact import Contact
from clamber.model.kinematics import Kinematics
from clamber.step.path import Phase
from clamber.step.stability import statics_at

MASS = 0.1  # share of it
FRICTION = 0.5  # from here on; less where a support has less
COM = 0.02  # [m]
CONTACT = 0.01  # [m]


def robust_margin(kin: Kinematics, q: np.ndarray, contacts: Sequence[Contact]) -> float:
    """Worst-case margin of the centre of mass [m].

    Negative where the posture need not hold: so much farther inside the centre of mass
    would have to be.

    Args:
        kin: Workspace.
        q: (nq,) the posture.
        contacts: That bear.
    """
    points, load, torque = statics_at(kin, q, contacts)
    slippery = replace(points, mu=np.minimum(points.mu, FRICTION))
    room = min(
        _core.com_room(
            *slippery.arrays,
            load.com,
            share * load.mass,
            replace(torque, gravity=share * torque.gravity).arrays,
        )
        for share in (1.0 - MASS, 1.0 + MASS)
    )
    return room - COM - CONTACT


def robust_margin_along(kin: Kinematics, phases: Sequence[Phase]) -> float | None:
    """The least `robust_margin` [m] of all postures of phases; None where none is."""
    return min(
        (robust_margin(kin, q, phase.contacts) for phase in phases for q in phase.q),
        default=None,
    )
