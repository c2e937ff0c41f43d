"""A run folder -> what is shown of it: records, and arrays over time.

A run whose files are broken or missing is read as far as it can be, and what is not
there is named. What is shown, in a report or a view, comes from here.

Shapes: n samples, nq coordinates, nS surfaces, na joints, M recorded states.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from clamber.contact.contact import Contact
from clamber.contact.steps import Step
from clamber.errors import ClamberError, InputError
from clamber.execution.simulation import Rollout
from clamber.execution.verdict import Verdict
from clamber.model.kinematics import Kinematics
from clamber.model.records import short_repr
from clamber.model.scene import Support
from clamber.model.world import World
from clamber.planning.records import Plan
from clamber.planning.samples import Samples
from clamber.planning.trajectory import Trajectory
from clamber.recording.demonstration import runs
from clamber.run.folder import (
    EXECUTION,
    PLAN,
    PLANNED_SCENE,
    PLANNED_TRAJECTORY,
    ROLLOUT,
    RUN_MAKERS,
    TIMINGS,
    VERDICT,
    load_fields,
    load_plan,
    load_rollout,
    load_verdict,
)
from clamber.step.polygon import com_margin, support_polygon
from clamber.step.posture import Keyframe
from clamber.step.stability import statics_at
from clamber.step.statics import (
    Phase,
    contact_forces,
    projected_distance,
    theta_max,
)

SAMPLES_A_SECOND = 25
SHORTEST_LOAD = 0.06  # [s] a shorter touch, or gap, is none
LOADED = 0.01  # [weights] a surface that bears more is loaded
TOUCHING = 0.005  # [m] a bearing point nearer to its support than this bears
_Loaded = TypeVar("_Loaded")


# What a folder holds.


@dataclass(eq=False, slots=True, kw_only=True)
class Run:
    """The readable parts of a run folder, and why others could not be read.

    Attributes:
        folder: The run folder.
        missing: A sentence for each thing that could not be read.
        written, execution, timings: Fields of the JSON files; empty where they are
            missing.
        plan, rollout, verdict: None where their files are.
    """

    folder: Path
    missing: list[str] = field(default_factory=list)
    written: Mapping[str, Any] = field(default_factory=dict)
    execution: Mapping[str, Any] = field(default_factory=dict)
    timings: Mapping[str, Any] = field(default_factory=dict)
    plan: Plan | None = None
    rollout: Rollout | None = None
    verdict: Verdict | None = None

    __repr__ = short_repr

    def attempt(self, load: Callable[[], _Loaded]) -> _Loaded | None:
        """What `load` returns; None, and a sentence more, where it cannot."""
        try:
            return load()
        except ClamberError as e:
            text = str(e).replace(f"{self.folder}/", "")
            if text not in self.missing:
                self.missing.append(text)
            return None

    def fields(self, name: str) -> dict[str, Any]:
        """The fields of a JSON file; none where it cannot be read."""
        return self.attempt(lambda: load_fields(self.folder, name)) or {}

    def has(self, name: str) -> bool:
        """Whether there is such a file."""
        return (self.folder / name).exists()


def read_run(folder: Path) -> Run:
    """Read all that can be read of a run folder.

    Raises:
        InputError: It is no folder.
    """
    if not folder.is_dir():
        raise InputError(f"a run folder; {RUN_MAKERS}", source=folder)
    run = Run(folder=folder)
    run.written, ran = run.fields(PLAN), run.has(ROLLOUT)
    if run.written:
        run.plan = run.attempt(lambda: load_plan(folder, without=(TIMINGS,)))
        if run.plan is None and run.has(PLANNED_SCENE):
            without = (TIMINGS, PLANNED_TRAJECTORY)
            run.plan = run.attempt(lambda: load_plan(folder, without=without))
        if ran:
            run.rollout = run.attempt(lambda: load_rollout(folder))
            if run.rollout is None and run.plan is not None:
                run.rollout = run.attempt(
                    lambda: load_rollout(folder, with_events=False)
                )
    elif ran:
        run.missing.append(f"{ROLLOUT} is not shown: that takes a whole {PLAN}")
    if ran or run.has(EXECUTION):
        run.execution = run.fields(EXECUTION)
    if ran or run.has(VERDICT):
        run.verdict = run.attempt(lambda: load_verdict(folder))
    run.timings = run.fields(TIMINGS)
    if run.written and not ran:
        text = "the plan has not been run in physics"
        if run.verdict or run.execution:
            text = "it has been run in physics; `clamber simulate` writes it anew"
        run.missing.append(f"no {ROLLOUT}: {text}")
    return run


# Stances.


def stance_rows(
    written: Mapping[str, Any], times: list[float | None]
) -> list[dict[str, Any]]:
    """Rows of the table of stances, by the keys of `plan.json`.

    Args:
        written: Fields of `plan.json`, or none.
        times: When each keyframe is reached [s].
    """
    keys, rows = written.get("keyframes", []), []
    if not keys:
        return []
    on = ", ".join(c["surface"] for c in keys[0]["contacts"])
    moves = [f"start, on {on}", *(_named(c["step"]) for c in written["changes"])]
    for key, time, move in zip(keys, times, moves, strict=True):
        e = key["static_equilibrium"]
        force = _force_by_surface(e)
        rows.append(
            {
                "move": move,
                "time": time,
                "com_margin": key["com_margin"],
                "robust_margin": key.get("robust_margin"),  # none in older runs
                "margin": e["margin"],
                "limiting": e["limiting"],
                "contacts": [
                    {
                        "surface": c["surface"],
                        "support": c["support"],
                        "position": c["position"],
                        "projected_distance": c["projected_distance"],
                        "contact_angle": c["contact_angle"],
                        "phase": c["phase"],
                        "force": force.get(c["surface"]),
                    }
                    for c in key["contacts"]
                ],
            }
        )
    return rows


def _named(step: Mapping[str, Any]) -> str:
    """A step of `plan.json` in words, as `Step` has them."""
    makes = None
    if step.get("makes") is not None:
        names = {k: step["makes"][k] for k in ("surface", "support")}
        makes = Contact(**names, position=np.zeros(3), quaternion=np.eye(4)[0])
    return str(Step(limb=step["limb"], breaks=tuple(step["breaks"]), makes=makes))


def _force_by_surface(equilibrium: Mapping[str, Any]) -> dict[str, list[float]]:
    """[N] of each surface over its bearing points; empty where they are not named."""
    names, forces = equilibrium.get("surfaces"), equilibrium["forces"]
    if not isinstance(names, list) or len(names) != len(forces):
        return {}
    total: dict[str, np.ndarray] = {}
    for name, force in zip(names, forces, strict=True):
        total[str(name)] = total.get(str(name), np.zeros(3)) + np.array(force)
    return {n: f.tolist() for n, f in total.items()}


def keyframe_times(plan: Plan, rollout: Rollout | None) -> list[float | None]:
    """When each keyframe is reached [s]; None where the run never gets there."""
    n = len(plan.keyframes)
    if plan.trajectory is None:
        # The keyframes alone, a second each.
        return [float(i) if rollout is None else None for i in range(n)]
    followed = None if rollout is None else rollout.followed
    end = math.inf if rollout is None else float(rollout.time[-1]) + 0.02
    known = (followed or plan.trajectory).keyframes.tolist()[:n]
    known += [math.inf] * (n - len(known))
    return [t if t <= end else None for t in known]


def change_at(changes: Sequence[str], reached: Sequence[float | None], t: float) -> str:
    """The contact change that is under way at a time [s]; after the last `done`.

    Args:
        changes: What they are called.
        reached: As `keyframe_times` has it, one more than changes.
        t: [s].
    """
    pairs = zip(changes, reached[1:], strict=True)
    return next((c for c, at in pairs if at is None or at > t), "done")


def force_by_contact(world: World, key: Keyframe) -> dict[str, np.ndarray]:
    """(3,) [N] of each surface, over all its bearing points."""
    points, load, torque = statics_at(Kinematics(world), key.q, key.stance)
    names = np.array(points.names)
    forces = contact_forces(points, load, torque=torque).forces
    return {c.surface: forces[names == c.surface].sum(axis=0) for c in key.stance}


def planned_forces(
    plan: Plan, t: Trajectory, row: int
) -> tuple[np.ndarray, np.ndarray]:
    """(nS,) bool, contacts closed in a sample of the plan, and (nS, 3) forces [N].

    Those are the least that hold the robot at rest there, zeros of open contacts.
    """
    world, closed, q = plan.world, t.contact[row], t.q[row]
    k = int(np.searchsorted(t.keyframes, t.time[row], side="right"))
    near = {
        c.surface: c for x in plan.keyframes[max(k - 1, 0) : k + 1] for c in x.stance
    }
    bears = [near[s] for s, on in zip(t.surfaces, closed, strict=True) if on]
    points, load, torque = statics_at(Kinematics(world), q, bears)
    forces, surfaces = np.zeros((len(closed), 3)), list(t.surfaces)
    held = contact_forces(points, load, torque=torque).forces
    np.add.at(forces, [surfaces.index(n) for n in points.names], held)
    return closed, forces


# The motion, sampled.


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Motion:
    """A run over time: what physics made of it, else its plan, else its keyframes.

    Attributes:
        world: That it moves in.
        stills: Keyframes alone, one a second.
        time: (n,) [s]; q: (n, nq); reference: (n, nq) what was to be followed, where
            physics ran.
        points: (n, nS, 3) lowest points of the surfaces [m]; support: (n, nS) index of
            the support below, in the order of `world.supports`.
        planned: (n, nS) bool, contacts of the reference; loaded: what bears in physics.
        distance, limit: (n, nS) projected distances (4.17) of what is planned or bears,
            and l sin(theta_max) in that posture [m]; NaN elsewhere.
        margin: (n,) of the centre of mass [m]; planned_margin: of the reference.
        error: (n, 3) largest and root mean square joint error [rad], of the base [m].
        force: (n, nS, 3) [N] in the world.
        size: (n, nS) [N], effort: (n, na) share of the limit, push_size: (n, 1) [N]:
            the largest from a sample to the next, effort with its sign.
        push: (n, 3) on the pelvis [N].
        schedule, loads: For each surface from when to when it is planned to bear, and
            bears [s].
        events: Times at which a contact is made or ends [s]; felt: of the
            events of the execution.

    An array is None where there is nothing that it could be of.
    """

    world: World
    stills: bool
    time: np.ndarray
    q: np.ndarray
    reference: np.ndarray | None = None
    points: np.ndarray
    support: np.ndarray
    planned: np.ndarray | None
    loaded: np.ndarray | None = None
    distance: np.ndarray
    limit: np.ndarray
    margin: np.ndarray
    planned_margin: np.ndarray | None = None
    error: np.ndarray | None = None
    force: np.ndarray | None = None
    size: np.ndarray | None = None
    effort: np.ndarray | None = None
    push: np.ndarray | None = None
    push_size: np.ndarray | None = None
    schedule: list[list[tuple[float, float]]]
    loads: list[list[tuple[float, float]]] | None
    events: list[float]
    felt: list[float]

    __repr__ = short_repr

    @property
    def bears(self) -> np.ndarray:
        """(n, nS) bool, which surfaces are loaded: in physics, else as planned."""
        found = self.planned if self.loaded is None else self.loaded
        assert found is not None  # there is one of them
        return found

    def phase(self, row: int, surface: int) -> Phase | None:
        """Phase of a contact at a sample; None where it is neither planned nor loaded.

        Args:
            row: Index of the sample.
            surface: Index of the surface.
        """
        planned = self.planned is not None and bool(self.planned[row, surface])
        loaded = bool(self.bears[row, surface])
        if not (planned or loaded):
            return None
        if self.distance[row, surface] > self.limit[row, surface]:
            return "sliding"
        return "supporting" if loaded else "reach-to-supportable"


def swings_of(motion: Motion, trajectory: Trajectory) -> list[tuple[float, np.ndarray]]:
    """When contacts are made [s], and the swing paths (m, 3) of their surfaces [m]."""
    names, time = list(motion.world.surfaces), trajectory.time
    out = []
    for s in trajectory.segments:
        if s.makes is not None:
            begin, end = float(time[s.begin]), float(time[s.end - 1])
            rows = (motion.time >= begin) & (motion.time <= end)
            out.append((end, motion.points[rows, names.index(s.makes.surface)]))
    return out


def sample_motion(
    plan: Plan,
    rollout: Rollout | None,
    execution: Mapping[str, Any],
    most: int | None = None,
    tell: Callable[[float], None] = lambda done: None,
) -> Motion:
    """Sample a run at 25 Hz.

    Args:
        plan: What was to be done.
        rollout: What physics made of it, or None.
        execution: Fields of `execution.json`, or none.
        most: Samples at most.
        tell: Called with the share done.
    """
    world = plan.world if rollout is None else rollout.world
    reference = plan.trajectory
    if rollout is not None:
        reference = rollout.followed or reference
    series: dict[str, Any]
    loads = None
    if rollout is not None:
        rows = even_rows(rollout.time, most)
        time, q = rollout.time[rows], rollout.qpos[rows]
        loaded = steadily_loaded(rollout)
        loads = spells(rollout.time, loaded)
        series = _physics(rollout, reference, loaded, rows)
    elif reference is not None:
        rows = even_rows(reference.time, most)
        time, q = reference.time[rows], reference.q[rows]
        series = {"planned": reference.contact[rows]}
    else:
        time = np.arange(len(plan.keyframes), dtype=float)
        q = np.array([k.q for k in plan.keyframes])
        held = [{c.surface for c in k.stance} for k in plan.keyframes]
        series = {"planned": np.array([[s in h for s in world.surfaces] for h in held])}
    planned, bears = series["planned"], series.get("loaded")
    bears = planned if bears is None else bears
    marked = bears if planned is None else bears | planned
    q_ref = series.get("reference")
    twice = q_ref is not None and planned is not None
    series |= stability_of(world, q, marked, bears, lambda x: tell(x / (1 + twice)))
    if q_ref is not None and planned is not None:
        planned_ones = stability_of(
            world, q_ref, planned, planned, lambda x: tell((1 + x) / 2)
        )
        series["planned_margin"] = planned_ones["margin"]
        series["error"] = _errors(world, q, q_ref)
    end = float(time[-1])
    schedule = [] if reference is None else spells(reference.time, reference.contact)
    schedule = [[(a, min(b, end)) for a, b in x if a < end] for x in schedule]
    switches = {t for x in loads or schedule for pair in x for t in pair}
    return Motion(
        world=world,
        stills=rollout is None and reference is None,
        time=time,
        q=q,
        schedule=schedule or [[] for _ in world.surfaces],
        loads=loads,
        events=sorted({round(t, 3) for t in switches if SHORTEST_LOAD < t < end}),
        felt=[e["time"] for e in execution.get("events", []) if e["time"] <= end],
        **series,
    )


def even_rows(time: np.ndarray, most: int | None) -> np.ndarray:
    """Indices of samples at 25 Hz, evenly spaced, the last one among them.

    Args:
        time: (n,) evenly spaced [s].
        most: So many at most.
    """
    duration = float(time[-1] - time[0])
    gaps = max(1, round(duration * SAMPLES_A_SECOND))
    if most is not None:
        gaps = min(most - 1, gaps)
    step = max(1, math.ceil((len(time) - 1) / gaps))
    return np.unique(np.append(np.arange(0, len(time), step), len(time) - 1))


def _physics(
    rollout: Rollout,
    reference: Trajectory | None,
    loaded: np.ndarray,
    rows: np.ndarray,
) -> dict[str, np.ndarray | None]:
    """Series of what physics made; torques and forces at their peaks."""
    world = rollout.world
    order = [world.model.actuator(name).id for name in world.joints]
    effort = rollout.actuator_force[:, order] / world.tau_max
    size = np.linalg.norm(rollout.contact_force, axis=2)
    out: dict[str, np.ndarray | None] = {
        "loaded": loaded[rows],
        "force": rollout.contact_force[rows],
        "size": peaks(size, rows),
        "effort": peaks(effort, rows),
        "planned": None,
    }
    if reference is not None:
        at = np.minimum(rows * rollout.stride, len(reference.time) - 1)
        out["planned"] = reference.contact[at]
        out["reference"] = reference.q[at]
    if rollout.push is not None:
        at = np.minimum(rows * rollout.stride, len(rollout.push) - 1)
        size = np.linalg.norm(rollout.push, axis=1)[:, None]
        out["push"], out["push_size"] = rollout.push[at], peaks(size, at)
    return out


def peaks(x: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """(n, k) of x (M, k), from each row up to the next: the value farthest from 0."""
    high = np.maximum.reduceat(x, rows, axis=0)
    low = np.minimum.reduceat(x, rows, axis=0)
    return np.where(high >= -low, high, low)


def stability_of(
    world: World,
    postures: np.ndarray,
    marked: np.ndarray,
    bears: np.ndarray,
    tell: Callable[[float], None] = lambda done: None,
) -> dict[str, np.ndarray]:
    """Geometric stability (4.17) of postures (n, nq): fields of a `Motion`.

    Args:
        world: Robot and supports.
        postures: (n, nq).
        marked: (n, nS) bool, surfaces of which the distances are wanted.
        bears: (n, nS) bool, surfaces on which the centre of mass is held.
        tell: Called with the share done.
    """
    kin, supports = Kinematics(world), list(world.supports)
    n, count = marked.shape
    points, support = np.zeros((n, count, 3)), np.zeros((n, count), dtype=int)
    d, limit = np.full((n, count), np.nan), np.full((n, count), np.nan)
    margin = np.full(n, np.nan)
    for i, q in enumerate(postures):
        if i % 100 == 0:
            tell(i / n)
        kin.update(q)
        bearing = []
        for j, surface in enumerate(world.surfaces):
            below = support_below(world, kin, surface)
            points[i, j] = point = kin.contact_point(surface, below.normal)
            support[i, j] = supports.index(below.name)
            if marked[i, j]:
                mass = kin.landmark(world.robot.limb_of(surface).root)[1]
                d[i, j] = projected_distance(point, mass)
                length = float(np.linalg.norm(mass - point))
                limit[i, j] = length * math.sin(theta_max(below.friction))
            if bears[i, j]:
                bearing.append(bearing_of(kin, surface, below))
        if bearing:
            polygon = support_polygon(np.concatenate(bearing)[:, :2])
            margin[i] = com_margin(kin.com, polygon)
    names = ("points", "support", "distance", "limit", "margin")
    return dict(zip(names, (points, support, d, limit, margin), strict=True))


def bearing_of(kin: Kinematics, surface: str, support: Support) -> np.ndarray:
    """(k, 3) points of a surface that touch a support; the nearest one at least."""
    points = kin.bearing_points(surface, support.normal)
    gaps = support.height(points)
    return points[gaps <= max(TOUCHING, float(gaps.min()))]


def support_below(world: World, kin: Kinematics, surface: str) -> Support:
    """The support that a surface is nearest to at the present posture."""
    found = []
    for k, s in enumerate(world.supports.values()):
        point = kin.contact_point(surface, s.normal)
        found.append((abs(float(s.height(point))), k, s, point))
    for _, _, s, point in sorted(found):
        if s.inside(point, -0.05):
            return s
    return found[0][2]


def posture_at(motion: Motion, q: np.ndarray, t: float) -> np.ndarray:
    """(nq,) of postures (n, nq) of a motion at a time [s]; of stills the last one."""
    time = motion.time
    row = row_at(time, t)
    after = min(row + 1, len(time) - 1)
    if motion.stills or after == row:
        return q[row]
    share = min(max((t - time[row]) / (time[after] - time[row]), 0.0), 1.0)
    a, b = q[row], q[after].copy()
    b[3:7] *= 1.0 if a[3:7] @ b[3:7] >= 0 else -1.0
    out = (1 - share) * a + share * b
    out[3:7] /= np.linalg.norm(out[3:7])
    return out


def support_polygon_at(motion: Motion, kin: Kinematics, row: int) -> np.ndarray:
    """(K, 3) support polygon of the loaded contacts, at the highest of them [m].

    Args:
        motion: The run.
        kin: At the posture then.
        row: Index of the sample; empty where nothing bears.
    """
    supports = list(motion.world.supports.values())
    points = [
        bearing_of(kin, surface, supports[motion.support[row, j]])
        for j, surface in enumerate(motion.world.surfaces)
        if motion.bears[row, j]
    ]
    if not points:
        return np.zeros((0, 3))
    found = np.concatenate(points)
    flat = support_polygon(found[:, :2])
    return np.column_stack([flat, np.full(len(flat), found[:, 2].max())])


def _errors(world: World, q: np.ndarray, q_ref: np.ndarray) -> np.ndarray:
    """(n, 3) largest and mean square joint error [rad], distance of the base [m]."""
    off = np.abs(q[:, world.qadr] - q_ref[:, world.qadr])
    base = np.linalg.norm(q[:, :3] - q_ref[:, :3], axis=1)
    rms = np.sqrt((off**2).mean(axis=1))
    return np.stack([off.max(axis=1), rms, base], axis=1)


def steadily_loaded(rollout: Rollout) -> np.ndarray:
    """(M, nS) bool, the surfaces that bear; gaps, then touches, below 60 ms left out.

    A stiff contact that rolls is without force for a step now and then; one in which
    the run begins, until it has been pressed.
    """
    force = np.linalg.norm(rollout.contact_force, axis=2)
    loaded = force > LOADED * rollout.world.mass * 9.81
    last = len(rollout.time) - 1
    step = float(rollout.time[-1] - rollout.time[0]) / max(last, 1)
    for column in loaded.T:
        for state in (True, False):
            for a, b in runs(column != state):
                if (a > 0 or state) and b <= last and (b - a) * step < SHORTEST_LOAD:
                    column[a:b] = state
    return loaded


def spells(time: np.ndarray, contact: np.ndarray) -> list[list[tuple[float, float]]]:
    """For each surface (columns) from when to when it is in contact [s]."""
    last = len(time) - 1
    return [
        [(float(time[a]), float(time[min(b, last)])) for a, b in runs(column)]
        for column in contact.T
    ]


def row_at(times: np.ndarray, t: float) -> int:
    """Index of the last of rising times (n,) up to `t` [s]; 0 before the first."""
    return max(0, int(np.searchsorted(times, t + 1e-9, side="right")) - 1)


def thinned(x: np.ndarray | Samples, n: int) -> np.ndarray:
    """About `n` rows, evenly spaced, the last one among them."""
    return x[np.unique(np.linspace(0, len(x) - 1, min(n, len(x))).round().astype(int))]
