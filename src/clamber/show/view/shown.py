"""What is to be seen of a run at a time: poses, contacts, forces, balance, the way.

Nothing here knows of a browser: records are made once of a run, a `Frame` of a time.

Shapes: M states, nq coordinates, nb drawn bodies, nS surfaces, k contacts, m arrows.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from clamber.execution.simulation import STRIDE, Rollout
from clamber.model.kinematics import Kinematics
from clamber.model.world import PHYSICS_STEP, World
from clamber.planning.records import Plan
from clamber.run.folder import keyframe_fields
from clamber.show.meshes import Mesh, body_meshes, body_poses
from clamber.show.pictures import FORCE_LENGTH
from clamber.show.sample import (
    Motion,
    bearing_of,
    keyframe_times,
    row_at,
    sample_motion,
    stance_rows,
    steadily_loaded,
    support_below,
)
from clamber.show.view.edits import keyframe_steps
from clamber.step.posture import CLEARANCE
from clamber.step.statics import (
    GRAVITY,
    Phase,
    com_margin,
    contact_phase,
    projected_distance,
    support_ellipse,
    support_polygon,
    theta_max,
)

PLAN_STRIDE = 10  # samples of a trajectory between two states that are shown
ELLIPSE_POINTS = 24
WAY_POINTS = 12  # of a limb's way
AT_REST = 0.15  # [s] around a keyframe its forces are shown where physics has not run
ARROW = 2 * FORCE_LENGTH  # [m] of the robot's weight: out of the limb it begins in
PUSH_SCALE = 2.0  # arrows of pushes are so much longer than those of contact forces
LEAST_FORCE = 0.005  # [weights] smaller forces are no arrow
# Of shapes that a processor draws in time, at a pixel for 4 mm; and of those at rest.
DEVIATION, MAX_TRIANGLES, FINE_TRIANGLES = 0.005, 6_000, 20_000
ALIKE, ALIKE_TURNED = 0.004, 0.02  # [m], [rad] that are not seen between two poses
STATES = STRIDE * PHYSICS_STEP  # [s] between two recorded states
MOVED = 0.01  # [m] a contact that is farther from where it was has been made anew


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Touch:
    """A contact at a time.

    Attributes:
        position: (3,) where the surface is nearest to its support [m].
        normal: (3,) of the support.
        friction: Of the support.
        loaded: It bears, in physics where that has run.
        phase: supporting, reach-to-supportable or sliding.
        force: (3,) on the robot [N]; None where nothing knows it.
    """

    surface: str
    support: str
    position: np.ndarray
    normal: np.ndarray
    friction: float
    loaded: bool
    phase: Phase
    force: np.ndarray | None


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Frame:
    """What is to be seen at a time.

    Attributes:
        row: Of the states.
        poses: (nb, 7) position [m] and quaternion of the drawn bodies; ghost: the same
            of the reference, None where physics has not run.
        touches: Contacts that are planned, or bear.
        push: (2, 3) tail and tip of the arrow of a push [m], or None.
        polygon: (K, 3) support polygon of what bears, at the height of the highest of
            it [m]; ellipse: (E, 3) in it, empty where it has no area.
        com: (3,) and foot: (3,) its projection on the polygon's plane [m].
        margin: Of the centre of mass in the polygon [m]; NaN where nothing bears.
        stance: Index of the last keyframe that has been reached.
    """

    time: float
    row: int
    poses: np.ndarray
    ghost: np.ndarray | None
    touches: tuple[Touch, ...]
    push: np.ndarray | None
    polygon: np.ndarray
    ellipse: np.ndarray
    com: np.ndarray
    foot: np.ndarray
    margin: float
    stance: int


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Way:
    """Where a surface travels to its contact, as planned.

    Attributes:
        stance: Index of the keyframe that it leads to.
        points: (n, 3) of the surface's centre [m].
        radius: Of the surface, and what is kept free around it [m].
    """

    stance: int
    surface: str
    points: np.ndarray
    radius: float


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Shown:
    """A run as it is shown.

    Attributes:
        plan: What was to be done; rollout: what physics made of it, or None.
        motion: For the plots.
        meshes: (nb) drawn bodies; fine: the same with more faces.
        time: (M,) [s]; q: (M, nq); reference: (M, nq) or None.
        planned, loaded: (M, nS) bool.
        force: (M, nS, 3) [N], or None.
        stances: Rows of the table.
        reached: (K,) times of the keyframes [s], None where the run never gets there.
        ways: Of the moves that there are.
    """

    plan: Plan
    rollout: Rollout | None
    motion: Motion
    meshes: tuple[Mesh, ...]
    fine: tuple[Mesh, ...]
    time: np.ndarray
    q: np.ndarray
    reference: np.ndarray | None
    planned: np.ndarray
    loaded: np.ndarray
    force: np.ndarray | None
    stances: tuple[Mapping[str, Any], ...]
    reached: tuple[float | None, ...]
    ways: tuple[Way, ...]

    @property
    def world(self) -> World:
        """That it moves in."""
        return self.motion.world

    @property
    def duration(self) -> float:
        """[s]."""
        return float(self.time[-1])

    def events(self) -> list[float]:
        """Times to step through: contacts made or lost, keyframes, both ends [s]."""
        keys = [t for t in self.reached if t is not None] if self.motion.stills else []
        return sorted({0.0, *self.motion.events, *keys, self.duration})


def show_run(
    plan: Plan, rollout: Rollout | None, execution: Mapping[str, Any] | None = None
) -> Shown:
    """Gather what is to be seen of a plan, and of what physics made of it.

    Args:
        plan: What was to be done.
        rollout: What physics made of it, or None.
        execution: Fields of `execution.json`, or none.
    """
    motion = sample_motion(plan, rollout, execution or {})
    world, reference, force = motion.world, None, None
    trajectory = plan.trajectory
    if rollout is not None:
        trajectory = rollout.followed or trajectory
        time, q, force = rollout.time, rollout.qpos, rollout.contact_force
        loaded = planned = steadily_loaded(rollout)
        if trajectory is not None:
            at = np.minimum(
                np.arange(len(time)) * rollout.stride, len(trajectory.time) - 1
            )
            reference, planned = trajectory.q[at], trajectory.contact[at]
    elif trajectory is not None:
        rows = np.arange(0, len(trajectory.time), PLAN_STRIDE)
        rows = np.unique(np.append(rows, len(trajectory.time) - 1))
        time, q = trajectory.time[rows], trajectory.q[rows]
        loaded = planned = trajectory.contact[rows]
    else:
        time, q = motion.time, motion.q
        assert motion.planned is not None
        loaded = planned = motion.planned
    kin = Kinematics(plan.world)
    keyframes = [keyframe_fields(k, kin) for k in plan.keyframes]
    times = keyframe_times(plan, rollout)
    return Shown(
        plan=plan,
        rollout=rollout,
        motion=motion,
        meshes=tuple(
            body_meshes(world.model, deviation=DEVIATION, max_triangles=MAX_TRIANGLES)
        ),
        fine=tuple(body_meshes(world.model, max_triangles=FINE_TRIANGLES)),
        time=time,
        q=q,
        reference=reference,
        planned=planned,
        loaded=loaded,
        force=force,
        stances=tuple(stance_rows({"keyframes": keyframes}, times)),
        reached=tuple(times),
        ways=_ways(plan),
    )


def frame_at(shown: Shown, kin: Kinematics, t: float) -> Frame:
    """What is to be seen at a time.

    Args:
        shown: The run.
        kin: A workspace of its world.
        t: [s]; the state then, or the last one before.
    """
    world = shown.world
    row = row_at(shown.time, t)
    ghost = None
    if shown.reference is not None:
        kin.update(shown.reference[row])
        ghost = body_poses(kin.data, shown.meshes)
    kin.update(shown.q[row])
    stance = stance_at(shown, t)
    static = _static_forces(shown, t, stance)
    touches, bearing = [], []
    for j, surface in enumerate(world.surfaces):
        loaded, planned = bool(shown.loaded[row, j]), bool(shown.planned[row, j])
        if not (loaded or planned):
            continue
        support = support_below(world, kin, surface)
        point = kin.contact_point(surface, support.normal)
        mass = kin.landmark(world.robot.limb_of(surface).root)[1]
        force = static.get(surface)
        if shown.force is not None:
            force = shown.force[row, j] if loaded else None
        touches.append(
            Touch(
                surface=surface,
                support=support.name,
                position=point,
                normal=support.normal,
                friction=support.friction,
                loaded=loaded,
                phase=contact_phase(
                    projected_distance(point, mass),
                    float(np.linalg.norm(mass - point)),
                    theta_max(support.friction),
                    loaded=loaded,
                ),
                force=force,
            )
        )
        if loaded:
            bearing.append(bearing_of(kin, surface, support))
    com = kin.com.copy()
    polygon, ellipse = np.zeros((0, 3)), np.zeros((0, 3))
    margin, height = math.nan, 0.0
    if bearing:
        points = np.concatenate(bearing)
        flat, height = support_polygon(points[:, :2]), float(points[:, 2].max())
        polygon = _at_height(flat, height)
        margin = com_margin(com, flat)
        if len(flat) > 2:
            ellipse = _at_height(_ellipse(flat), height)
    return Frame(
        time=t,
        row=row,
        poses=body_poses(kin.data, shown.meshes),
        ghost=ghost,
        touches=tuple(touches),
        push=_push(shown, kin, row),
        polygon=polygon,
        ellipse=ellipse,
        com=com,
        foot=np.array([com[0], com[1], height]),
        margin=margin,
        stance=stance,
    )


def stance_at(shown: Shown, t: float) -> int:
    """Index of the last keyframe that has been reached at a time [s].

    To within two recorded states: the last one may be reached after the last of them.
    """
    past = [
        i for i, at in enumerate(shown.reached) if at is not None and at < t + STATES
    ]
    return past[-1] if past else 0


def apart(ghost: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """(nb,) whether bodies of the ghost can be told from those of the robot.

    Args:
        ghost: (nb, 7) position [m] and unit quaternion.
        poses: (nb, 7) the same of the robot.
    """
    turned = np.abs(np.sum(ghost[:, 3:] * poses[:, 3:], axis=1))
    off = np.linalg.norm(ghost[:, :3] - poses[:, :3], axis=1)
    return (off > ALIKE) | (2 * np.arccos(np.minimum(turned, 1.0)) > ALIKE_TURNED)


def weight_of(world: World) -> float:
    """[N]."""
    return world.mass * GRAVITY


def force_arrow(world: World, touch: Touch) -> np.ndarray | None:
    """(2, 3) tail and tip of a contact's force [m]; None where there is none."""
    if touch.force is None:
        return None
    share = touch.force / weight_of(world)
    if np.linalg.norm(share) < LEAST_FORCE:
        return None
    return np.stack([touch.position, touch.position + ARROW * share])


def _static_forces(shown: Shown, t: float, stance: int) -> Mapping[str, np.ndarray]:
    """Forces of a keyframe's equilibrium [N], near its time; physics has its own."""
    if shown.force is not None:
        return {}
    for i in (stance, stance + 1):
        at = shown.reached[i] if i < len(shown.reached) else None
        if at is not None and abs(t - at) <= (0.5 if shown.motion.stills else AT_REST):
            contacts = shown.stances[i]["contacts"]
            known = {c["surface"]: c["force"] for c in contacts}
            return {s: np.array(f) for s, f in known.items() if f is not None}
    return {}


def _push(shown: Shown, kin: Kinematics, row: int) -> np.ndarray | None:
    """(2, 3) tail and tip of the push on the pelvis [m]."""
    if shown.rollout is None or shown.rollout.push is None:
        return None
    step = min(row * shown.rollout.stride, len(shown.rollout.push) - 1)
    share = shown.rollout.push[step] / weight_of(shown.world)
    if np.linalg.norm(share) < LEAST_FORCE:
        return None
    base = kin.data.xpos[shown.world.base]
    return np.stack([base - PUSH_SCALE * ARROW * share, base])


def _at_height(points: np.ndarray, z: float) -> np.ndarray:
    return np.column_stack([points, np.full(len(points), z)])


def _ellipse(polygon: np.ndarray) -> np.ndarray:
    """(E, 2) points of the ellipse in a polygon (K, 2) [m]."""
    e = support_ellipse(polygon)
    way = e.foci[1] - e.foci[0]
    length = float(np.linalg.norm(way))
    major = way / length if length > 1e-9 else np.array([1.0, 0.0])
    minor = np.array([-major[1], major[0]])
    a = np.linspace(0.0, 2 * math.pi, ELLIPSE_POINTS, endpoint=False)[:, None]
    return (
        e.centre
        + e.semi_axes[0] * np.cos(a) * major
        + e.semi_axes[1] * np.sin(a) * minor
    )


def _ways(plan: Plan) -> tuple[Way, ...]:
    """How the surfaces that make contacts travel, along the planned trajectory."""
    trajectory, world = plan.trajectory, plan.world
    if trajectory is None:
        return ()
    kin = Kinematics(world)
    ways = []
    for i in range(1, min(len(plan.keyframes), len(trajectory.keyframes))):
        before = {c.surface: c for c in plan.keyframes[i - 1].stance}
        for c in plan.keyframes[i].stance:
            was = before.get(c.surface)
            if was is not None and np.linalg.norm(was.position - c.position) < MOVED:
                continue
            a, b = (trajectory.at(t) for t in trajectory.keyframes[i - 1 : i + 1])
            column = trajectory.contact[a : b + 1, trajectory.surfaces.index(c.surface)]
            free = np.flatnonzero(~column)
            if len(free):
                a, b = a + int(free[0]), a + int(free[-1]) + 1
            surface, points = world.surfaces[c.surface], []
            for q in trajectory.q[a : b + 1 : PLAN_STRIDE]:
                kin.update(q)
                points.append(kin.point(surface.body, surface.centre))
            ways.append(
                Way(
                    stance=i,
                    surface=c.surface,
                    points=_even(np.array(points)),
                    radius=surface.radius + CLEARANCE,
                )
            )
    return tuple(ways)


def _even(points: np.ndarray) -> np.ndarray:
    """(n, 3) points evenly spaced along a line (m, 3)."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    length = np.concatenate([[0.0], np.cumsum(steps)])
    at = np.linspace(0.0, length[-1], WAY_POINTS)
    return np.stack([np.interp(at, length, x) for x in points.T], axis=1)


def way_at(shown: Shown, t: float) -> Way | None:
    """The way that is under way, or comes next, at a time [s]."""
    stance = stance_at(shown, t) + 1
    return next((w for w in shown.ways if w.stance == stance), None)


def tube(points: np.ndarray, radius: float, sides: int = 12) -> tuple[np.ndarray, ...]:
    """Vertices (n, 3) and triangles (F, 3) of a tube with round ends around a line.

    Args:
        points: (n, 3) of the line, no two neighbours alike [m].
        radius: [m].
        sides: Faces around it.
    """
    steps = np.diff(points, axis=0)
    keep = np.append(True, np.linalg.norm(steps, axis=1) > 1e-6)
    points = points[keep]
    if len(points) < 2:
        points = np.concatenate([points, points + np.array([0.0, 0.0, 1e-4])])
    along = np.gradient(points, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    # Half a ball at either end: rings that shrink along the first and last direction.
    angles = np.linspace(0.0, math.pi / 2, 4)[1:]
    rings = [(p, d, radius) for p, d in zip(points, along, strict=True)]
    for a in angles:
        c, s = radius * math.cos(a), radius * math.sin(a)
        rings.insert(0, (points[0] - s * along[0], along[0], c))
        rings.append((points[-1] + s * along[-1], along[-1], c))
    side = np.cross(along[0], np.eye(3)[np.argmin(np.abs(along[0]))])
    turn = np.linspace(0.0, 2 * math.pi, sides, endpoint=False)[:, None]
    vertices = []
    for centre, direction, r in rings:
        side = side - (side @ direction) * direction  # turned as little as can be
        side /= np.linalg.norm(side)
        other = np.cross(direction, side)
        vertices.append(centre + r * (np.cos(turn) * side + np.sin(turn) * other))
    i, j = np.meshgrid(np.arange(len(rings) - 1), np.arange(sides), indexing="ij")
    a, b = (i * sides + j).ravel(), (i * sides + (j + 1) % sides).ravel()
    faces = np.concatenate(
        [np.stack([a, b, b + sides], 1), np.stack([a, b + sides, a + sides], 1)]
    )
    return np.concatenate(vertices), faces


def beams(segments: np.ndarray, width: float) -> tuple[np.ndarray, ...]:
    """Vertices (6 n, 3) and triangles (6 n, 3) of lines that are rods of three sides.

    Their number is that of the segments, also of those without length.

    Args:
        segments: (n, 2, 3) their ends [m].
        width: [m] of a side.
    """
    way = segments[:, 1] - segments[:, 0]
    length = np.linalg.norm(way, axis=1, keepdims=True)
    along = np.where(length > 1e-9, way / np.maximum(length, 1e-9), [1.0, 0.0, 0.0])
    steep = np.abs(along[:, 2:]) > 0.9
    side = np.cross(np.where(steep, [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]), along)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(along, side)
    turn = 2 * math.pi * np.arange(3) / 3 + math.pi / 2  # an edge on top
    ring = np.stack([math.cos(a) * side + math.sin(a) * up for a in turn], axis=1)
    ring *= width / math.sqrt(3)
    vertices = np.concatenate([segments[:, :1] + ring, segments[:, 1:] + ring], axis=1)
    i, j = np.arange(3), (np.arange(3) + 1) % 3
    faces = np.concatenate([np.stack([i, j, j + 3], 1), np.stack([i, j + 3, i + 3], 1)])
    start = 6 * np.arange(len(segments))[:, None, None]
    return vertices.reshape(-1, 3), (faces + start).reshape(-1, 3)


def person_times(shown: Shown) -> tuple[np.ndarray, np.ndarray]:
    """Times (n,) of the robot and of the person at which they make the same contact.

    Between them the one clock is the other one, stretched [s].
    """
    robot, person = [0.0], [float(shown.plan.sequence.t[0])]
    for i, step in keyframe_steps(shown.plan):
        t = shown.reached[i]
        if t is not None and t > robot[-1]:
            robot.append(t)
            person.append(float(shown.plan.sequence.t[step.stance]))
    if shown.duration > robot[-1]:
        robot.append(shown.duration)
        person.append(float(shown.plan.sequence.t[-1]))
    return np.array(robot), np.array(person)
