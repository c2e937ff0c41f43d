"""Contacts, stances and the sequence of stances that a demonstration shows.

Contact frame C: origin at the point on the support, z along the support's outward
normal, x along the heading of the link (a foot's toes, a forearm's hand, a shank's
knee), projected into the support.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from clamber.model.records import short_repr
from clamber.model.scene import GROUND, Scene
from clamber.model.shown import Shown

Region = Literal["G", "M", "O"]
# Surfaces of a person: each side has a hand, an elbow, a knee and a foot.
PARTS = tuple(s + p for p in ("Hand", "Elbow", "Knee", "Foot") for s in "LR")
# The limb of each, by the names that limbs of robots have.
LIMBS = {
    s + p: f"{side}_{limb}"
    for s, side in (("L", "left"), ("R", "right"))
    for limb, parts in (("arm", ("Hand", "Elbow")), ("leg", ("Foot", "Knee")))
    for p in parts
}
DIRECTIONS = (
    "trunk",
    "left_upper_arm",
    "left_forearm",
    "right_upper_arm",
    "right_forearm",
    "left_thigh",
    "left_shank",
    "right_thigh",
    "right_shank",
)  # each from its proximal to its distal end; the trunk from the hips to the shoulders


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Contact:
    """A robot's or a person's surface on a support.

    Attributes:
        surface: Name of the surface, such as `LHand`.
        support: Name of the support, such as `ground`.
        position: (3,) the point on the support, in the world [m].
        quaternion: (4,) orientation of C in the world, wxyz.
        edge: A flat surface rolled onto one of its four edges: the edge's index, and
            `position` is the middle of that edge. None while it lies flat.
        link: (4,) orientation of a round surface's link in the world where it touches
            at `position`; as the link turns, the surface rolls from there. None where
            no robot's posture belongs to the contact yet.
        fixed: Set by a user: the contact is planned at this position, or as near to it
            as the robot can reach; otherwise the position is a reference only.
    """

    surface: str
    support: str
    position: np.ndarray
    quaternion: np.ndarray
    edge: int | None = None
    link: np.ndarray | None = None
    fixed: bool = False

    __repr__ = short_repr

    def __post_init__(self) -> None:
        """Copy the arrays and check their shapes."""
        for name, n in (("position", 3), ("quaternion", 4)):
            x = np.array(getattr(self, name), dtype=float)
            if x.shape != (n,) or not np.all(np.isfinite(x)):
                raise ValueError(f"{name} {x}, expected {n} finite numbers")
            x.setflags(write=False)
            object.__setattr__(self, name, x)
        if self.link is not None:
            link = np.array(self.link, dtype=float)
            link.setflags(write=False)
            object.__setattr__(self, "link", link)


def region_of(contacts: tuple[Contact, ...]) -> Region:
    """`G` all on the ground, `O` all on obstacles, else `M` (none at all: `G`)."""
    on_ground = [c.support == GROUND for c in contacts]
    return "G" if all(on_ground) else "M" if any(on_ground) else "O"


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Stance:
    """The contacts that hold at once, and the body's posture.

    Attributes:
        contacts: One for each surface in contact.
        posture: Unit directions (3,) in the world by name, from `DIRECTIONS`; may be
            empty where the demonstration does not say.
        pelvis: (7,) pose of the pelvis in the world, position [m] and orientation
            wxyz; its frame has y to the left hip and z along the trunk. None where the
            demonstration does not say, and once the sequence is at the robot's scale.
    """

    contacts: tuple[Contact, ...]
    posture: Mapping[str, np.ndarray] = field(default_factory=dict)
    pelvis: np.ndarray | None = None

    __repr__ = short_repr

    def __post_init__(self) -> None:
        """Check that no surface appears twice, the directions and the pelvis."""
        names = [c.surface for c in self.contacts]
        if len(set(names)) != len(names):
            raise ValueError(f"a surface appears twice in a stance: {names}")
        if unknown := set(self.posture) - set(DIRECTIONS):
            raise ValueError(f"unknown directions {sorted(unknown)}")
        if self.pelvis is not None:
            pelvis = np.array(self.pelvis, dtype=float)
            if pelvis.shape != (7,) or not np.all(np.isfinite(pelvis)):
                raise ValueError(f"pelvis {pelvis}, expected 7 finite numbers")
            pelvis.setflags(write=False)
            object.__setattr__(self, "pelvis", pelvis)

    @property
    def region(self) -> Region:
        """G, M or O."""
        return region_of(self.contacts)

    @property
    def surfaces(self) -> tuple[str, ...]:
        """Names of the surfaces in contact."""
        return tuple(c.surface for c in self.contacts)

    def contact(self, surface: str) -> Contact | None:
        """The contact of that surface; None where it is in the air."""
        return next((c for c in self.contacts if c.surface == surface), None)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class ContactInterval:
    """One contact of one part over time, as detected.

    Attributes:
        part: The person's part, such as `LHand`.
        is_surface: False for a part that bears load and that no robot has as a
            contact surface: the seat.
        t0: Start [s].
        t1: End [s].
        contact: Support and pose.
    """

    part: str
    is_surface: bool
    t0: float
    t1: float
    contact: Contact

    __repr__ = short_repr


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class ContactSequence(Shown):
    """Stances in order: what `detect_contacts` finds and `plan` starts from.

    Attributes:
        source: Name of the recording or plan that it comes from, for people.
        subject: Segment lengths by name [m]; None for a robot's own plan.
        scene: The scene it was recorded in; positions are in its world.
        stances: N stances.
        t: (N + 1,) times [s]; stance i holds from t[i] to t[i + 1].
        intervals: The raw intervals the stances were made of, by start time.
    """

    source: str
    subject: Mapping[str, float] | None
    scene: Scene
    stances: tuple[Stance, ...]
    t: np.ndarray
    intervals: tuple[ContactInterval, ...] = ()

    __repr__ = short_repr

    def __post_init__(self) -> None:
        """Check that times increase and that the scene has every support."""
        t = np.array(self.t, dtype=float)
        if t.shape != (len(self.stances) + 1,) or not np.all(np.diff(t) > 0):
            raise ValueError("times must increase, one more than there are stances")
        t.setflags(write=False)
        object.__setattr__(self, "t", t)
        for name in dict.fromkeys(c.support for s in self.stances for c in s.contacts):
            self.scene.support(name)
