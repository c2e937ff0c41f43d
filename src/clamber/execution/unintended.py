"""Measured contact forces -> the link that carries load where no contact is planned.

What the surfaces carry is less than the weight: another link carries the rest. Motion
is slow, so forces and moments balance, those of gravity, of the surfaces and of it:

    F = -(m g + sum f_i),        p x F = -(c x m g + sum p_i x f_i).

The second says where on a plane the line of F passes, up to what the noise of the
forces leaves, a few centimetres, and up to where on its sole a foot carries its load,
which is not measured. That tells one arm from the other, and the link is the one that
comes nearest to a support there.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np

from clamber import _core
from clamber.model.kinematics import Kinematics
from clamber.model.scene import GROUND

MISSING = 0.08  # of the weight that the surfaces do not carry
SIDEWAYS = 15.0  # [N] and more than the force upwards: a surface hits a side
SEARCHED = 0.06  # [m] a support is believed no farther from what touches it
KNOWN = 0.015  # [m] ... and the ground, which is known
AWAY = 0.20  # [m] from the line of the force, besides what soles leave open
LASTS = 0.2  # [s] a link is loaded for so long where it should not be: it is
ALERT = 0.1  # [s] ... where supports have turned out to be uneven
CLEARANCE = 0.02  # [m] farther than where an unintended contact was
RETREATS = 4  # as often another way is looked for
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True)
class UnintendedContact:
    """An unintended contact: the link, and what it touches.

    Attributes:
        geom: Of the robot, in the model.
        support: Name.
        distance: Between them as believed [m]; really 0.
    """

    geom: int
    support: str
    distance: float


def load_is_missing(load: np.ndarray, weight: float) -> bool:
    """Whether forces (nS, 3) of the surfaces [N] are less than the weight [N]."""
    return _core.load_is_missing(load, weight, MISSING)


def hit_sideways(load: np.ndarray, least: float = SIDEWAYS) -> list[int]:
    """Surfaces loaded more tangentially than normally, and by more than `least` [N].

    No contact on a level support is loaded like that, at a friction of up to 1.

    Args:
        load: (nS, 3) forces on them [N].
        least: As above.
    """
    return _core.hit_sideways(load, least)


def loaded_link(
    kin: Kinematics, load: np.ndarray, weight: float
) -> UnintendedContact | None:
    """The link, none of the surfaces, that carries what these do not.

    Args:
        kin: In the posture as measured, of the world as believed.
        load: (nS, 3) forces on the surfaces [N], world axes.
        weight: Of the robot [N].

    Returns:
        None where no link is near a support on the line of the force.
    """
    world = kin.world
    down = np.array([0.0, 0.0, -weight])
    points = [kin.contact_point(s, UP) for s in world.surfaces]
    force = -(down + load.sum(axis=0))
    moment = -(np.cross(kin.com, down) + np.cross(points, load).sum(axis=0))
    open_ = _moment_of_soles(kin, load) / max(force[2], 1e-9)
    own = [g for s in world.surfaces.values() for g in s.geoms]
    best, found = SEARCHED + AWAY, None
    for near, p in _near_supports(kin, np.isin(world.pairs, own).sum(axis=1) == 0):
        # p x F = M in the plane z = p_z.
        x = (p[2] * force[0] - moment[1]) / force[2]
        y = (p[2] * force[1] + moment[0]) / force[2]
        away = max(float(np.hypot(x - p[0], y - p[1])) - open_, 0.0)
        if away < AWAY and max(near.distance, 0.0) + away < best:
            best, found = max(near.distance, 0.0) + away, near
    return found


def _moment_of_soles(kin: Kinematics, load: np.ndarray) -> float:
    """The most that forces (nS, 3) turn about the middles of flat surfaces [N m]."""
    half = [  # 0 of a ball
        np.linalg.norm(s.corners - s.centre, axis=1).max()
        for s in kin.world.surfaces.values()
    ]
    return float(np.maximum(load[:, 2], 0.0) @ half)


def nearest_of(kin: Kinematics, surfaces: Collection[str]) -> UnintendedContact | None:
    """The geom of some surfaces that is nearest to a support; None where none is."""
    world = kin.world
    own = [g for s in surfaces for g in world.surfaces[s].geoms]
    near = _near_supports(kin, np.isin(world.pairs, own).sum(axis=1) > 0)
    return min((x for x, _ in near), key=lambda x: x.distance, default=None)


def _near_supports(
    kin: Kinematics, active: np.ndarray
) -> list[tuple[UnintendedContact, np.ndarray]]:
    """Geoms near a support among pairs (P,), each with its nearest point (3,)."""
    world = kin.world
    supports = list(world.support_of_geom)
    of_support = np.isin(world.pairs, supports)
    near = kin.proximity(SEARCHED, active & (of_support.sum(axis=1) == 1))
    out = []
    for k, distance, a, b in zip(
        near.pairs, near.distance, near.first, near.second, strict=True
    ):
        first = int(of_support[k, 0])  # the robot's is the other one
        geom, other = int(world.pairs[k, first]), int(world.pairs[k, 1 - first])
        support = world.support_of_geom[other]
        if support == GROUND and distance > KNOWN:
            continue
        touch = UnintendedContact(geom, support, float(distance))
        out.append((touch, b if first else a))
    return out


class Watch:
    """Looks out for unintended contacts in slow motion.

    Attributes:
        weight: Of the robot, as measured [N].
        found: What was found last and not taken yet.
        clearance: Extra clearance [m] by geom and support, after those that were found.
        alert: Supports have turned out to be uneven.
    """

    def __init__(
        self, surfaces: Sequence[str], period: float, force_scale: float = 1.0
    ) -> None:
        """Look at the forces on `surfaces`, in order, every `period` [s]."""
        self.weight, self.alert = 0.0, False
        self.found: UnintendedContact | None = None
        self.clearance: dict[tuple[int, str], float] = {}
        self._surfaces, self._period = surfaces, period
        self._sideways = SIDEWAYS * force_scale
        self._lasted, self._taken = 0.0, 0
        # Those that there is no way around.
        self._accepted: set[tuple[int, str]] = set()

    def look(self, load: np.ndarray, in_use: Callable[[], Collection[str]]) -> None:
        """Does something seem to be loaded that should not? Once every period.

        Args:
            load: (nS, 3) forces on the surfaces [N].
            in_use: Gives the surfaces that may be loaded.
        """
        if load_is_missing(load, self.weight) or self._hit(load, in_use):
            self._lasted += self._period
        else:
            self._lasted = 0.0

    @property
    def seems_so(self) -> bool:
        """Something seems to be loaded that should not be."""
        return self._lasted > 0.0

    @property
    def is_due(self) -> bool:
        """It has seemed so for long enough to ask what it is."""
        lasts = self._lasted >= (ALERT if self.alert else LASTS)
        return lasts and self._taken < RETREATS

    def find(
        self,
        kin: Kinematics,
        load: np.ndarray,
        in_use: Callable[[], Collection[str]],
        moving: Collection[int],
    ) -> bool:
        """Is it an unintended contact? Then it is `found`.

        Args:
            kin: In the posture as measured.
            load: (nS, 3) forces on the surfaces [N].
            in_use: Gives the surfaces that may be loaded.
            moving: Links that may touch what they like.
        """
        self._lasted = 0.0
        if load_is_missing(load, self.weight):
            found = loaded_link(kin, load, self.weight)
        else:
            found = nearest_of(kin, self._hit(load, in_use))
        if found is not None and (
            int(kin.world.model.geom_bodyid[found.geom]) in moving
            or (found.geom, found.support) in self._accepted
        ):
            found = None
        self.found = found
        return found is not None

    def _hit(
        self, load: np.ndarray, in_use: Callable[[], Collection[str]]
    ) -> list[str]:
        """Surfaces, none of those in use, that hit a side."""
        rows = hit_sideways(load, self._sideways)
        if not rows:
            return []
        used = in_use()
        hit = [self._surfaces[i] for i in rows]
        return [s for s in hit if s not in used]

    def take(self) -> UnintendedContact:
        """Returns the contact found; planning keeps more clearance from then on."""
        at = self.found
        assert at is not None
        self.found, key = None, (at.geom, at.support)
        self.clearance[key] = CLEARANCE + max(at.distance, self.clearance.get(key, 0.0))
        self._taken += 1
        return at

    def accept(self, at: UnintendedContact) -> None:
        """There is no way around it: it is not found again."""
        self._accepted.add((at.geom, at.support))
