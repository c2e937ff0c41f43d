"""Tasks of surfaces in a posture, and how they are passed to the core.

The rows of these tasks are the core's (src/native/tasks.cpp). A round surface touches
under its centre. Where it is closed on its support it rolls: the contact moves with the
link, and the link's material point with it.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from clamber import _core
from clamber.contact.contact import Contact
from clamber.model.core import numbers_of
from clamber.model.kinematics import Kinematics
from clamber.model.records import short_repr
from clamber.model.scene import Support
from clamber.model.se3 import frame_from_normal, matrix_from_quat
from clamber.model.world import World

EDGE_INSET: float = _core.EDGE_INSET
EDGE_ROOM: float = _core.EDGE_ROOM
EDGE_WEIGHT: float = _core.EDGE_WEIGHT
ROUGHNESS_WEIGHT: float = _core.ROUGHNESS_WEIGHT
# Body segments by name: (limb, from, to); the trunk is the mean of hips and shoulders.
_SEGMENTS = {
    f"{side}_{part}": (f"{side}_{limb}", a, b)
    for side in ("left", "right")
    for part, limb, a, b in (
        ("upper_arm", "arm", "root", "middle"),
        ("forearm", "arm", "middle", "end"),
        ("thigh", "leg", "root", "middle"),
        ("shank", "leg", "middle", "end"),
    )
}
# Of a surface on, or on its way to, a support. `rotation` is R_WC (3, 3) of a flat
# surface in contact: that of the contact, its z along the support's normal.


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Closed:
    """A contact in its place.

    Attributes:
        contact: Where it holds. A round surface rolls from its `link`; without, its
            centre stays over the contact's position.
        rotation: Of a flat surface.
        loaded: It may bear force, and counts for the support polygon.
    """

    contact: Contact
    rotation: np.ndarray
    loaded: bool = True

    __repr__ = short_repr


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class OnEdge:
    """A flat surface that has rolled onto its contact's edge, which is in its place.

    Attributes:
        contact: Where the edge's middle holds; the surface may turn about it, and would
            rather lie flat.
        rotation: As it lay flat.
        loaded: It may bear force, and counts for the support polygon.
    """

    contact: Contact
    rotation: np.ndarray
    loaded: bool = True

    __repr__ = short_repr


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Sliding:
    """A contact that is closed wherever it is on its support.

    Attributes:
        contact: Where it would be liked.
        rotation: Of a flat surface, up to a turn about the normal.
        reference: Weight of the distance to the contact's position.
        stability: Weight of (4.25), the horizontal distance from the contact to the
            mass it supports.
        loaded: It may bear force, and counts for the support polygon.
    """

    contact: Contact
    rotation: np.ndarray
    reference: float = 0.0
    stability: float = 0.0
    loaded: bool = True

    __repr__ = short_repr


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Reaching:
    """A surface in swing.

    Attributes:
        contact: Where it should be, and what it goes to.
        rotation: Of a flat surface.
        weight: Of the distance; of a turn, 0.3 of it.
    """

    contact: Contact
    rotation: np.ndarray
    weight: float

    __repr__ = short_repr


ClosedTask = Closed | OnEdge | Sliding
SurfaceTask = ClosedTask | Reaching
_KINDS = (Closed, OnEdge, Sliding, Reaching)  # in the core's order


def closed(world: World, c: Contact, *, loaded: bool = True) -> Closed | OnEdge:
    """A contact that keeps its place."""
    task = Closed if c.edge is None else OnEdge
    return task(contact=c, rotation=_rotation(world, c), loaded=loaded)


def sliding(world: World, c: Contact, reference: float, **more: Any) -> Sliding:
    """A contact that is closed on its support, preferably where it is."""
    flat, R = _flat(c), _rotation(world, c)
    return Sliding(contact=flat, rotation=R, reference=reference, **more)


def reaching(world: World, c: Contact, at: np.ndarray, *, weight: float) -> Reaching:
    """A contact's surface at a point (3,), turned as in contact."""
    there = replace(c, position=at, edge=None)
    return Reaching(contact=there, rotation=_rotation(world, c), weight=weight)


def support_rotation(support: Support, quaternion: np.ndarray) -> np.ndarray:
    """R_WC: z along the support's normal, x as near to the quaternion's as it can."""
    return frame_from_normal(support.normal, matrix_from_quat(quaternion)[:, 0])


def _flat(c: Contact) -> Contact:
    return c if c.edge is None else replace(c, edge=None)


def _rotation(world: World, c: Contact) -> np.ndarray:
    return _turned(world.supports[c.support], c)


@functools.lru_cache(maxsize=64)  # a change asks for the same contacts a dozen times
def _turned(support: Support, c: Contact) -> np.ndarray:
    R = support_rotation(support, c.quaternion)
    R.flags.writeable = False
    return R


# For the core: whole numbers, then real ones, a row for each.

_IDENTITY = (1.0, 0.0, 0.0, 0.0)


def packed_tasks(
    world: World, tasks: Sequence[SurfaceTask]
) -> tuple[np.ndarray, np.ndarray]:
    """(n, 6) kinds, surfaces, supports, edges, flags, and (n, 19) numbers."""
    surfaces, supports = numbers_of(world)
    what = np.empty((len(tasks), 6), np.int32)
    where = np.empty((len(tasks), 19))
    for i, t in enumerate(tasks):
        c = t.contact
        what[i] = (
            _KINDS.index(type(t)),
            surfaces[c.surface],
            supports[c.support],
            -1 if c.edge is None else c.edge,
            not isinstance(t, Reaching) and t.loaded,
            c.link is not None,
        )
        where[i, :3], where[i, 3:12] = c.position, t.rotation.ravel()
        where[i, 12:16] = _IDENTITY if c.link is None else c.link
        slides = isinstance(t, Sliding)
        where[i, 16:] = (
            t.reference if slides else 0.0,
            t.stability if slides else 0.0,
            t.weight if isinstance(t, Reaching) else 0.0,
        )
    return what, where


def packed_contacts(
    world: World, contacts: Sequence[Contact]
) -> tuple[np.ndarray, np.ndarray]:
    """(n, 4) surfaces, supports, edges, flags, and (n, 11) numbers."""
    surfaces, supports = numbers_of(world)
    what = np.empty((len(contacts), 4), np.int32)
    where = np.empty((len(contacts), 11))
    for i, c in enumerate(contacts):
        what[i] = (
            surfaces[c.surface],
            supports[c.support],
            -1 if c.edge is None else c.edge,
            c.link is not None,
        )
        where[i, :3], where[i, 3:7] = c.position, c.quaternion
        where[i, 7:] = _IDENTITY if c.link is None else c.link
    return what, where


def contact_rows(kin: Kinematics, contacts: Iterable[Contact]) -> np.ndarray:
    """(m, nv) velocities of contacts that are zero while they are closed.

    At the present posture: of their points, and of links that lie flat how they turn.
    """
    rows = [np.zeros((0, kin.world.model.nv))]
    for c in contacts:
        n = kin.world.supports[c.support].normal
        s = kin.world.surface(c.surface, c.edge)
        linear, angular = kin.jacobians(s.body, kin.contact_point(c.surface, n, c.edge))
        rows.append(linear.copy())
        if s.is_flat and c.edge is None:
            rows.append(angular.copy())
    return np.concatenate(rows)


def packed_parts(
    world: World,
    held: Sequence[Contact],
    broken: Sequence[Contact],
    made: Contact | None,
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Contacts that stay, those that are broken and the new one of a step."""
    new = () if made is None else (made,)
    return [packed_contacts(world, c) for c in (held, broken, new)]


# One or two places: body, point (3,) in its frame.
Places = Sequence[tuple[int, np.ndarray]]
# From the middle of places to that of others, in a direction (3,) of the world, with a
# weight.
Pointing = tuple[Places, Places, np.ndarray, float]


def segment_ends(world: World, segment: str) -> tuple[Places, Places]:
    """End points of a body segment, such as `left_thigh` or `trunk`."""
    limbs = world.robot.limbs
    if segment == "trunk":
        start = [limbs[x].root for x in ("left_leg", "right_leg")]
        end = [limbs[x].root for x in ("left_arm", "right_arm")]
    else:
        limb, first, second = _SEGMENTS[segment]
        start, end = [getattr(limbs[limb], first)], [getattr(limbs[limb], second)]
    return [world.landmark(x) for x in start], [world.landmark(x) for x in end]


def leaning(world: World, surface: str, direction: np.ndarray, w: float) -> Pointing:
    """From a surface to the mass that its limb supports, in a direction (3,)."""
    s = world.surfaces[surface]
    root = world.landmark(world.robot.limb_of(surface).root)
    return [(s.body, s.centre)], [root], direction, w


def packed_pointing(tasks: Sequence[Pointing]) -> tuple[np.ndarray, np.ndarray]:
    """(n, 4) bodies, -1 for none, and (n, 16) points, directions and weights."""
    what = np.full((len(tasks), 4), -1, np.int32)
    where = np.zeros((len(tasks), 16))
    for i, (start, end, direction, weight) in enumerate(tasks):
        for first, places in ((0, start), (2, end)):
            for k, (body, point) in enumerate(places, first):
                what[i, k], where[i, 3 * k : 3 * k + 3] = body, point
        where[i, 12:15], where[i, 15] = direction, weight
    return what, where
