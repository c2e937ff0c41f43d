"""Plan, rollout -> verdict: whether the robot ended where the plan says.

A rollout holds what was measured and nothing else, so that whoever writes one down is
judged alike: `measure` makes figures of it, `judge` compares them with their limits.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from clamber.contact.steps import on_feet
from clamber.execution.simulation import END, Rollout
from clamber.model.arguments import checks_types
from clamber.model.kinematics import Kinematics
from clamber.model.records import short_repr
from clamber.model.scene import GROUND
from clamber.model.se3 import upward, wrap, yaw_of
from clamber.model.shown import Shown
from clamber.model.world import PHYSICS_STEP, World
from clamber.planning.records import Plan
from clamber.step.stability import STANDING_SHARE, standing_share

END_SPEED = 0.05  # [m/s] of the pelvis at the end
TILT_TOL = np.radians(20.0)  # pelvis against the plan at the end
HEIGHT_TOL = 0.08  # [m] pelvis against the plan at the end
FULL = 0.999  # of its effort limit, from which on a joint is at it
UNINTENDED_TOL = 0.01  # share of the total contact load on non-contact links
LOAD_ON_PLAN = 0.97  # of the weight, at the end, on the contacts planned
LOAD_ON_OBSTACLES = 0.98  # ... on obstacles, where the scene has no goal
ABOVE_SUPPORT = 0.05  # [m] pelvis at the end
PENETRATION_TOL = 0.010  # [m] of the robot into itself or into the scene
GOAL_TOL = 0.15  # [m] pelvis against a goal in the scene
YAW_TOL = np.radians(15.0)
SHOWN = {  # for people: the unit of a figure, and how many of another one it is
    "": (100.0, "%"),
    "m": (1000.0, "mm"),
    "m/s": (1000.0, "mm/s"),
    "rad": (float(np.degrees(1.0)), "deg"),
}
EVERY = 5  # recorded states between two looks for self-penetration


class Figure(StrEnum):
    """Criteria of a verdict; the value is the label with its unit."""

    UPRIGHT = "did not fall"
    WENT_ON = "did not stop on the way"
    COMPLETE = "planned to the last stance"
    LOAD_ON_PLAN = "load on planned contacts at the end"
    END_SPEED = "pelvis speed at the end [m/s]"
    TILT = "pelvis tilt error at the end [rad]"
    HEIGHT = "pelvis height error at the end [m]"
    UNINTENDED = "load on non-contact links"
    PENETRATION = "deepest penetration of the scene [m]"
    SELF_PENETRATION = "deepest self-penetration [m]"
    EFFORT = "largest effort, share of the limit"
    STANDING = "pelvis over its feet at the end, share of its first height"
    LOAD_ON_OBSTACLES = "load on obstacles at the end"
    ABOVE_SUPPORT = "pelvis above its support at the end [m]"
    GOAL = "pelvis to the goal [m]"
    YAW = "yaw error at the goal [rad]"

    @property
    def label(self) -> str:
        """Without the unit."""
        return self.value.partition(" [")[0]

    def in_words(self, value: float) -> str:
        """A value for people: yes or no, percent, millimetres or degrees."""
        if self in (Figure.UPRIGHT, Figure.WENT_ON, Figure.COMPLETE):
            return "yes" if value else "no"
        factor, unit = SHOWN[self.value.partition(" [")[2].removesuffix("]")]
        return f"{factor * value:.1f} {unit}"

    def limit_in_words(self, limit: float) -> str:
        """A limit for people, and whether it is the least or the most."""
        words = self.in_words(limit)
        return words if words == "yes" else f"at {self._bound} {words}"

    @property
    def _bound(self) -> str:
        least = (Figure.LOAD_ON_PLAN, Figure.STANDING, Figure.LOAD_ON_OBSTACLES)
        return "least" if self in (*least, Figure.ABOVE_SUPPORT) else "most"


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Criterion:
    """One figure with its limit.

    Attributes:
        value: In the unit that the figure's name says.
        limit: The smallest or the largest accepted value, in the same unit.
        ok: Whether the value is within it.
    """

    value: float
    limit: float
    ok: bool


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Verdict(Shown):
    """Success or failure in physics, and the figures that it rests on.

    Attributes:
        reached: Every criterion is met.
        criteria: By figure.
    """

    reached: bool
    criteria: dict[Figure, Criterion]

    __repr__ = short_repr

    def rows(self) -> list[tuple[str, str, str, bool]]:
        """For people: each criterion's label, value, limit, and whether it is met."""
        return [
            (f.label, f.in_words(c.value), f.limit_in_words(c.limit), c.ok)
            for f, c in self.criteria.items()
        ]

    def failed(self) -> str:
        """Labels of the criteria that are not met, between commas."""
        return ", ".join(f.label for f, c in self.criteria.items() if not c.ok)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Figures:
    """A rollout in numbers.

    Attributes:
        end_load: Vertical force, share of the weight, by `surface@support` over the
            last second; other links are called `other`.
        end_speed: Largest pelvis speed over the last second [m/s].
        unintended: Normal impulse on non-contact links, over that on all links.
        unintended_by: The same share by geom.
        penetration: Deepest of any contact [m].
        self_penetration: Of the robot into itself [m]; self_pair: where.
        effort: Largest of any joint, share of its limit.
    """

    end_load: dict[str, float]
    end_speed: float
    unintended: float
    unintended_by: dict[str, float]
    penetration: float
    self_penetration: float
    self_pair: str
    effort: float

    __repr__ = short_repr


def measure(rollout: Rollout) -> Figures:
    """The figures of a rollout."""
    world = rollout.world
    step, (geom, support) = rollout.contact_step, rollout.contact_geoms.T
    normal, vertical = rollout.contact_load.T
    surface_of = {g: n for n, s in world.surfaces.items() for g in s.geoms}
    at_end = step >= len(rollout.ctrl) - len(rollout.end_speed)
    tail = min(round(END / PHYSICS_STEP), len(rollout.ctrl))
    on = [
        f"{surface_of.get(g, 'other')}@{world.support_of_geom[s]}"
        for g, s in zip(geom[at_end].tolist(), support[at_end].tolist(), strict=True)
    ]
    recorded = step % rollout.stride == 0
    other = recorded & ~np.isin(geom, list(surface_of))
    total = max(float(np.add.accumulate([0.0, *normal[recorded]])[-1]), 1e-9)
    parts = [world.model.geom(g).name for g in geom[other].tolist()]
    by_part = _sums(parts, normal[other])
    depth, pair = self_penetration(world, rollout.qpos)
    order = [world.model.actuator(j).id for j in world.joints]
    effort = np.abs(rollout.actuator_force[:, order]) / world.tau_max
    return Figures(
        end_load={
            k: v / (world.mass * 9.81 * tail)
            for k, v in _sums(on, vertical[at_end]).items()
        },
        end_speed=float(rollout.end_speed.max(initial=0.0)),
        unintended=float(np.add.accumulate([0.0, *normal[other]])[-1]) / total,
        unintended_by={k: v / total for k, v in by_part.items()},
        penetration=float(rollout.penetration.max(initial=0.0)),
        self_penetration=depth,
        self_pair=pair,
        effort=float(effort.max(initial=0.0)),
    )


def _sums(names: list[str], values: np.ndarray) -> dict[str, float]:
    """The sum of the values (n,) of each name, added in their order."""
    if not names:
        return {}
    keys, which = np.unique(names, return_inverse=True)
    total = np.bincount(which, weights=values)
    return dict(zip(keys.tolist(), total.tolist(), strict=True))


def self_penetration(world: World, qpos: np.ndarray) -> tuple[float, str]:
    """Deepest overlap of the robot with itself in states (M, nq) [m], and where."""
    kin = Kinematics(world)
    env = world.model.body_weldid[world.model.geom_bodyid] == 0
    own = ~env[world.pairs].any(axis=1)
    worst, pair = 0.0, ""
    for q in qpos[::EVERY]:
        kin.update(q)
        near = kin.proximity(0.0, own)
        if len(near.distance) and -near.distance.min() > worst:
            i = int(np.argmin(near.distance))
            worst = -float(near.distance[i])
            pair = " and ".join(
                world.model.geom(int(g)).name for g in world.pairs[near.pairs[i]]
            )
    return worst, pair


def strained_joint(rollout: Rollout) -> tuple[str, float, float] | None:
    """The joint that was at its effort limit for longest; None where none was.

    Returns:
        Its name, the limit [N m], and for how long in all [s].
    """
    world = rollout.world
    order = [world.model.actuator(j).id for j in world.joints]
    at_limit = np.abs(rollout.actuator_force[:, order]) > FULL * world.tau_max
    times = at_limit.sum(axis=0) * rollout.stride * PHYSICS_STEP
    j = int(np.argmax(times))
    if times[j] == 0.0:
        return None
    return world.joints[j], float(world.tau_max[j]), float(times[j])


@checks_types
def judge(plan: Plan, rollout: Rollout, figures: Figures | None = None) -> Verdict:
    """Did the robot end where the plan says, on what it planned to rest on?

    Args:
        plan: The plan that was executed.
        rollout: Its simulation.
        figures: Figures of the rollout, where they have been computed.
    """
    assert plan.trajectory is not None
    f = measure(rollout) if figures is None else figures
    world, scene = rollout.world, plan.world.scene
    planned, last = (rollout.followed or plan.trajectory).q[-1], rollout.qpos[-1]
    final = plan.keyframes[-1].stance
    up, up_planned = (upward(q[3:7]) for q in (last, planned))
    tilt = float(np.arccos(np.clip(up @ up_planned, -1.0, 1.0)))
    on_plan = _load_on(world, f.end_load, rollout.rests_on)
    on_ground = sum(v for k, v in f.end_load.items() if k.endswith("@" + GROUND))
    criteria = {
        Figure.UPRIGHT: _at_least(float(not rollout.fell), 1.0),
        Figure.WENT_ON: _at_least(float(not rollout.stopped), 1.0),
        Figure.COMPLETE: _at_least(float(plan.complete), 1.0),
        Figure.LOAD_ON_PLAN: _at_least(on_plan, LOAD_ON_PLAN),
        Figure.END_SPEED: _at_most(f.end_speed, END_SPEED),
        Figure.TILT: _at_most(tilt, float(TILT_TOL)),
        Figure.HEIGHT: _at_most(float(abs(last[2] - planned[2])), HEIGHT_TOL),
        Figure.UNINTENDED: _at_most(f.unintended, UNINTENDED_TOL),
        Figure.PENETRATION: _at_most(f.penetration, PENETRATION_TOL),
        Figure.SELF_PENETRATION: _at_most(f.self_penetration, PENETRATION_TOL),
        Figure.EFFORT: _at_most(f.effort, 1.0 + 1e-6),
    }
    if on_feet(plan.world, final):
        stands = standing_share(world, final, last)
        criteria[Figure.STANDING] = _at_least(stands, STANDING_SHARE)
    if scene.goal is None:
        on_boxes = sum(f.end_load.values()) - on_ground
        supports = [
            world.supports[c.support] for c in final if c.support in world.supports
        ]
        above = min((s.height(last[:3]) for s in supports), default=last[2])
        criteria[Figure.LOAD_ON_OBSTACLES] = _at_least(on_boxes, LOAD_ON_OBSTACLES)
        criteria[Figure.ABOVE_SUPPORT] = _at_least(float(above), ABOVE_SUPPORT)
    else:
        away = float(np.linalg.norm(last[:2] - scene.goal[:2]))
        criteria[Figure.GOAL] = _at_most(away, GOAL_TOL)
        if len(scene.goal) == 3:
            off = float(abs(wrap(yaw_of(last[3:7]) - scene.goal[2])))
            criteria[Figure.YAW] = _at_most(off, float(YAW_TOL))
    return Verdict(reached=all(c.ok for c in criteria.values()), criteria=criteria)


def _load_on(
    world: World, load: Mapping[str, float], rests_on: Collection[str]
) -> float:
    """The share of the weight on contacts `surface@support`.

    A surface that is on a support of a mesh rests on the parts beside it as well.
    """
    owners = {s: world.scene.owner(s) for s in world.support_geom}

    def key(contact: str) -> tuple[str, str]:
        surface, _, support = contact.partition("@")
        return surface, owners.get(support, support)

    return sum(sum(v for k, v in load.items() if key(k) == key(c)) for c in rests_on)


def _at_most(value: float, limit: float) -> Criterion:
    return Criterion(value=value, limit=limit, ok=bool(value <= limit))


def _at_least(value: float, limit: float) -> Criterion:
    return Criterion(value=value, limit=limit, ok=bool(value >= limit))
