"""Policy of a demonstration: cycles of contacts, and the pelvis's pose.

The demo policy is a table of states and actions [thesis 5.1]. A state is a `Stance`:
contacts and the pelvis's pose, in a region (`G`, `O`, `M`). An action is the surface
that makes a contact, or moves it. Contracted [thesis 5.2], it is a sequence of options:
a cycle of actions, the states in which it begins, the region in which it ends.

Angles of the pelvis are roll, pitch, yaw with R = Rz(yaw) Rx(roll) Ry(pitch): yaw is
where the pelvis faces, roll how far its left side is up, pitch how far the trunk leans
forward, past the horizontal too. (The usual order Rz Ry Rx has no yaw where the trunk
is level, which is how a person crawls.)

Edge frame E of an obstacle: x into the obstacle, horizontal, z up.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal

import numpy as np

from clamber.contact.contact import PARTS, Region, Stance
from clamber.model.arguments import checks_types
from clamber.model.records import short_repr
from clamber.model.scene import Edge, Scene, Support
from clamber.model.se3 import wrap

Place = Literal["G", "M", "O", "goal"]
PLACES: tuple[Place, ...] = ("G", "M", "O", "goal")
IMPOSED = math.pi / 10  # [rad] a wider distribution imposes nothing [thesis 5.2.2]


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class DemoPolicy:
    """The table of states and actions that a demonstration shows [algorithm 1].

    Attributes:
        source: Name of the demonstration, for people.
        scene: The scene it was recorded in; states are in its world.
        subject: Segment lengths of the person by name [m].
        states: N + 1 stances; the last one is the goal.
        actions: N; action i leads from state i to state i + 1: the surface that makes
            a contact or moves it. None where contacts are only broken.
    """

    source: str
    scene: Scene
    subject: Mapping[str, float]
    states: tuple[Stance, ...]
    actions: tuple[str | None, ...]

    __repr__ = short_repr

    def __post_init__(self) -> None:
        """Check that there is one more state than actions, and the surfaces."""
        if len(self.states) != len(self.actions) + 1:
            raise ValueError("one more state than there are actions")
        _check_surfaces(tuple(a for a in self.actions if a is not None))
        for action, after in zip(self.actions, self.states[1:], strict=True):
            if action is not None and after.contact(action) is None:
                raise ValueError(f"action {action} leads to a state without it")
        object.__setattr__(self, "subject", MappingProxyType(dict(self.subject)))


@dataclass(frozen=True, slots=True, kw_only=True)
class Option:
    """A cycle of actions with the states in which it begins and ends.

    The cycle is taken at least once, and again until a state of `termination` is
    reached, or no stable contact is found.

    Attributes:
        name: `ac1`, `ac2` ...: the same cycle in the same region has the same name.
        region: Where its contacts are made, `G`, `M` or `O`; `goal` for those on the
            ground that end the demonstration.
        surfaces: The surfaces that it moves, in order.
        repeats: How often in a row the demonstration shows the cycle; the median of
            several demonstrations.
        initiation: Initiation set: regions of the states in which it was seen to begin.
        held: Surfaces in contact whenever it was seen to begin.
        termination: Termination set: region of the next option; `goal` for the last.
    """

    name: str
    region: Place
    surfaces: tuple[str, ...]
    repeats: int
    initiation: tuple[Region, ...]
    held: tuple[str, ...]
    termination: Place

    def __post_init__(self) -> None:
        """Check regions and surfaces; a cycle has two at least, and repeats."""
        _check_surfaces(self.surfaces)
        _check_surfaces(self.held)
        if len(self.surfaces) < 2 or len(set(self.surfaces)) < len(self.surfaces):
            raise ValueError(f"surfaces {self.surfaces}, expected two or more, once")
        if self.repeats < 2:
            raise ValueError(f"repeats {self.repeats}, expected 2 or more")
        for place in (self.region, self.termination):
            if place not in PLACES:
                raise ValueError(f"region {place!r}, expected one of {PLACES}")
        if not self.initiation or set(self.initiation) - set(PLACES[:3]):
            raise ValueError(
                f"initiation {self.initiation}, expected some of {PLACES[:3]}"
            )


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class PelvisDistribution:
    """Normal distributions of the pelvis's roll, pitch and yaw (5.5, 5.6).

    Attributes:
        mean: (3,) circular means [rad].
        sigma: (3,) standard deviations about them [rad]; infinite with fewer than two
            samples.
        samples: Number of states that it was estimated from.
    """

    mean: np.ndarray
    sigma: np.ndarray
    samples: int

    __repr__ = short_repr

    def __post_init__(self) -> None:
        """Copy the arrays, wrap the means and check that nothing is negative."""
        mean, sigma = (np.array(x, dtype=float) for x in (self.mean, self.sigma))
        if mean.shape != (3,) or not np.all(np.isfinite(mean)):
            raise ValueError(f"mean {mean}, expected 3 finite numbers")
        if sigma.shape != (3,) or not np.all(sigma >= 0):
            raise ValueError(f"sigma {sigma}, expected 3 numbers that are not negative")
        if self.samples < 0:
            raise ValueError(f"samples {self.samples}, expected 0 or more")
        for name, x in (("mean", wrap(mean)), ("sigma", sigma)):
            x.setflags(write=False)
            object.__setattr__(self, name, x)

    @property
    def imposed(self) -> tuple[tuple[float, float] | None, ...]:
        """Range mean -+ sigma of each angle [rad]; None where it is too wide."""
        return tuple(
            (float(m - s), float(m + s)) if s < IMPOSED else None
            for m, s in zip(self.mean, self.sigma, strict=True)
        )

    def clip(self, angles: np.ndarray) -> np.ndarray:
        """The nearest (3,) angles within `imposed` [algorithm 3, step 14]."""
        off = wrap(np.asarray(angles, dtype=float) - self.mean)
        within = self.mean + np.clip(off, -self.sigma, self.sigma)
        return np.where(self.sigma < IMPOSED, wrap(within), angles)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class GeneralPolicy:
    """Options in the order of the task, and the pelvis's orientation meanwhile.

    Attributes:
        options: In the order of the task; one may occur several times.
        over_top: Pelvis over the top, yaw against the edge that was climbed up.
        near_edge: Pelvis near an edge that was climbed, yaw against that edge: 0 faces
            the obstacle.
        goal: Surfaces in contact at the end.
        reach: Longest step of each surface on one support, in lengths of its limb
            (upper arm + forearm, thigh + shank): the `max_i` of (5.9).
        demos: The demonstrations' tables that it was learned from.
        notes: Where the demonstrations disagree, for people.
        secondary: Policies of the demonstrations whose cycles come in another order.
    """

    options: tuple[Option, ...]
    over_top: PelvisDistribution
    near_edge: PelvisDistribution
    goal: tuple[str, ...]
    reach: Mapping[str, float] = field(default_factory=dict)
    demos: tuple[DemoPolicy, ...] = ()
    notes: tuple[str, ...] = ()
    secondary: tuple[GeneralPolicy, ...] = ()

    __repr__ = short_repr

    def __post_init__(self) -> None:
        """Check that there are options, their order, and the surfaces."""
        if not self.options:
            raise ValueError("expected at least one option")
        ends = (*(o.region for o in self.options[1:]), "goal")
        for option, end in zip(self.options, ends, strict=True):
            if option.termination != end:
                raise ValueError(
                    f"termination {option.termination!r} of {option.name}, "
                    f"expected {end!r}"
                )
        _check_surfaces(self.goal)
        _check_surfaces(tuple(self.reach))
        if not all(x > 0 and math.isfinite(x) for x in self.reach.values()):
            raise ValueError(f"reach {dict(self.reach)}, expected positive numbers")
        object.__setattr__(self, "reach", MappingProxyType(dict(self.reach)))

    @property
    def sources(self) -> tuple[str, ...]:
        """Names of the demonstrations that it was learned from."""
        return tuple(d.source for d in self.demos)


def _check_surfaces(names: tuple[str, ...]) -> None:
    if unknown := [n for n in names if n not in PARTS]:
        raise ValueError(f"unknown surface {unknown[0]!r}, expected one of {PARTS}")


# The pelvis over an obstacle.


def pelvis_angles(R: np.ndarray) -> np.ndarray:
    """Roll, pitch, yaw (3,) of R (3, 3) = Rz(yaw) Rx(roll) Ry(pitch) [rad]."""
    return np.array(
        [
            math.asin(float(np.clip(R[2, 1], -1.0, 1.0))),
            math.atan2(-R[2, 0], R[2, 2]),
            math.atan2(-R[0, 1], R[1, 1]),
        ]
    )


def pelvis_rotation(angles: np.ndarray) -> np.ndarray:
    """R (3, 3) = Rz(yaw) Rx(roll) Ry(pitch) of roll, pitch, yaw (3,) [rad]."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(angles), np.sin(angles)
    return np.array(
        [
            [cy * cp - sy * sr * sp, -sy * cr, cy * sp + sy * sr * cp],
            [sy * cp + cy * sr * sp, cy * cr, sy * sp - cy * sr * cp],
            [-cr * sp, sr, cr * cp],
        ]
    )


def climbed_edges(
    support: Support, start: np.ndarray, goal: np.ndarray
) -> tuple[Edge, ...]:
    """The edge that is climbed up, and the one that is climbed down where there is one.

    Args:
        support: Top of the obstacle.
        start: Where the task begins, (2,) or more, x, y in the world [m].
        goal: Where it ends; over the top itself, nothing is climbed down.
    """
    ends = [start] if _over(support, goal) else [start, goal]
    return tuple(support.edge_towards(np.asarray(p)) for p in ends)


def _over(support: Support, p: np.ndarray) -> bool:
    foot = np.array([p[0], p[1], 0.0])
    foot[2] = -float(support.height(foot)) / support.normal[2]
    return bool(support.inside(foot))


@checks_types
def pelvis_distribution(
    policy: GeneralPolicy,
    edges: tuple[Edge, ...],
    position: np.ndarray,
    *,
    near: float,
) -> PelvisDistribution | None:
    """The pelvis's orientation in the world, by where it is (5.5 to 5.8).

    Over the top and near an edge as well, means are averaged (on the circle), and
    sigma = sqrt(sigma_1^2 + sigma_2^2) / 2, the deviation of the mean of two.

    Args:
        policy: The policy.
        edges: Edges of the obstacle, as from `climbed_edges`.
        position: (3,) of the pelvis in the world [m].
        near: Distance within which the pelvis is near an edge: a thigh's length [m].

    Returns:
        Roll, pitch and yaw in the world; None where the pelvis is neither over the top
        nor near an edge: nothing is known there.
    """
    edge = min(edges, key=lambda e: e.distance(position))
    distance = edge.distance(position)
    at_edge = _turned(policy.near_edge, edge.yaw)
    on_top = _turned(policy.over_top, edges[0].yaw)
    if distance < -near:
        return None
    if distance < 0.0:
        return at_edge
    if distance > near:
        return on_top
    apart = wrap(at_edge.mean - on_top.mean)
    return PelvisDistribution(
        mean=on_top.mean + apart / 2.0,
        sigma=np.hypot(at_edge.sigma, on_top.sigma) / 2.0,
        samples=at_edge.samples + on_top.samples,
    )


def _turned(d: PelvisDistribution, yaw: float) -> PelvisDistribution:
    mean = d.mean + np.array([0.0, 0.0, yaw])
    return PelvisDistribution(mean=mean, sigma=d.sigma, samples=d.samples)
