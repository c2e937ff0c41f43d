"""plan(): a contact sequence becomes a trajectory, stage by stage.

    sequence -> robot's scale -> moves -> keyframes -> transitions -> paths -> trajectory
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from clamber.contact import Contact, ContactSequence, Stance
from clamber.errors import InputError, Status
from clamber.model import Robot, World, build_world
from clamber.path import Path, plan_path
from clamber.posture import direct, gradient, lbfgs
from clamber.posture.ik import IK, support_rotation
from clamber.posture.keyframe import (
    Keyframe,
    KeyframeOptions,
    KeyframeTask,
    finish,
)
from clamber.scaling import retarget
from clamber.scene import GROUND, Scene
from clamber.se3 import quat_from_matrix
from clamber.trajectory import Trajectory, build_trajectory
from clamber.transition import (
    Move,
    Transition,
    approach_contact,
    eased_contact,
    plan_transition,
)

Method = Literal["direct", "lbfgs", "gradient"]
METHODS = {"direct": direct.optimise, "lbfgs": lbfgs.optimise, "gradient": gradient.optimise}
MOVED = 0.005  # [m] a repair by less is none
MAX_REPAIRS = 4  # earlier contacts that may be put elsewhere for a later move's sake
SAME_PLACE = 0.03  # [m] a contact made again nearer than this has not moved
Progress = Callable[[str, float, str], None]


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class PlanOptions:
    """How a plan is made.

    Attributes:
        method: How contact positions are optimised.
        speed: Largest joint speed [rad/s]; the thesis used 0.05.
        keyframe: Options of the posture optimisation.
    """

    method: Method = "direct"
    speed: float = 0.3
    keyframe: KeyframeOptions = field(default_factory=KeyframeOptions)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Skipped:
    """A stance of the demonstration that is no keyframe, and why."""

    stance: int
    reason: str


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Plan:
    """Everything that planning found.

    Attributes:
        world: Robot and scene.
        sequence: The demonstration in the robot's scene.
        keyframes: The start first; one more after each path.
        paths: Between neighbouring keyframes.
        skipped: Stances left out.
        trajectory: None where not even one move was found.
        complete: The last stance of the demonstration was reached.
        timings: Seconds by stage.
    """

    world: World
    options: PlanOptions
    sequence: ContactSequence
    keyframes: tuple[Keyframe, ...]
    paths: tuple[Path, ...]
    skipped: tuple[Skipped, ...]
    trajectory: Trajectory | None
    complete: bool
    timings: dict[str, float]


def plan(
    sequence: ContactSequence,
    robot: Robot,
    scene: Scene,
    *,
    options: PlanOptions | None = None,
    progress: Progress | None = None,
) -> Plan:
    """Plan the whole motion.

    Raises:
        InputError: The scene does not fit the sequence, or is out of the robot's reach.
    """
    options = options or PlanOptions()
    report = progress or (lambda stage, share, note: None)
    if not options.speed > 0:
        raise InputError("a positive joint speed [rad/s]", field="speed", value=options.speed)
    clock = _Clock()
    world = build_world(robot, scene)
    ik = IK(world)
    check_reach(ik)
    goal = retarget(sequence, world)
    clock.lap("retarget")

    keyframes = [standing(ik, options)]
    paths: list[Path] = []
    skipped: list[Skipped] = []
    moves = list(moves_of(goal, world))
    for index, _, move in moves:
        if not isinstance(move, Move):
            skipped.append(Skipped(stance=index, reason=move))
    moves = [m for m in moves if isinstance(m[2], Move)]
    done: list[int] = []  # the move that each path makes
    missed: list[Skipped] = []
    repairs = k = 0
    while k < len(moves):
        index, stance, move = moves[k]
        report("plan", k / len(moves), str(move))
        result = plan_move(ik, keyframes[-1], move, stance, options, clock)
        if not isinstance(result, str):
            keyframes.append(result[0])
            paths.append(result[1])
            done.append(k)
            k += 1
            continue
        better = repair(ik, keyframes, paths, move) if repairs < MAX_REPAIRS else None
        clock.lap("repairs")
        if better is None:
            missed.append(Skipped(stance=index, reason=result))
            k += 1
            continue
        repairs += 1
        j, contact = better
        k = done[j]
        del keyframes[j + 1 :], paths[j:], done[j:]
        missed = [m for m in missed if m.stance <= moves[k][0]]
        moves[k] = (*moves[k][:2], replace(moves[k][2], makes=contact, firm=True))
    skipped += missed
    trajectory = None
    if paths:
        report("trajectory", 1.0, "")
        phases = [p for path in paths for p in path.phases]
        per = [len(path.phases) for path in paths]
        trajectory = build_trajectory(
            world, phases, speed=options.speed, keyframe_after=np.cumsum(per) - 1
        )
        clock.lap("trajectory")
    return Plan(
        world=world,
        options=options,
        sequence=goal,
        keyframes=tuple(keyframes),
        paths=tuple(paths),
        skipped=tuple(skipped),
        trajectory=trajectory,
        complete=not missed and bool(paths),
        timings=clock.laps,
    )


def repair(
    ik: IK, keyframes: list[Keyframe], paths: list[Path], move: Move
) -> tuple[int, Contact] | None:
    """Which earlier path should have made its contact elsewhere for `move` to work.

    Looks at the last contact first.

    Returns:
        Index of the path, and the contact at its better place; None where none helps.
    """
    standing_on = {c.surface for c in keyframes[-1].stance} - set(move.breaks)
    for j in range(len(paths) - 1, -1, -1):
        made = paths[j].transition.move.makes
        if made is None or made.surface not in standing_on:
            continue
        standing_on.discard(made.surface)
        contact = eased_contact(ik, keyframes[-1], move, made.surface)
        if contact is not None and np.linalg.norm(contact.position - made.position) > MOVED:
            return j, contact
    return None


class _Clock:
    """Seconds by stage."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self.laps[stage] = self.laps.get(stage, 0.0) + now - self._last
        self._last = now


def check_reach(ik: IK) -> None:
    """A box that no limb could touch from the start is the user's mistake.

    Raises:
        InputError: Its nearest point of the top is farther from the shoulders than the
            robot is long.
    """
    kin, world = ik.kin, ik.world
    kin.update(world.home)
    limbs = world.robot.limbs.values()

    def length(arm: bool) -> float:
        limb = next(x for x in limbs if x.is_arm == arm)
        a, b, c = (kin.landmark(n)[1] for n in (limb.root, limb.middle, limb.end))
        return float(np.linalg.norm(b - a) + np.linalg.norm(c - b))

    shoulder = next(kin.landmark(x.root)[1] for x in limbs if x.is_arm)
    hip = next(kin.landmark(x.root)[1] for x in limbs if not x.is_arm)
    trunk = float(np.linalg.norm(shoulder - hip))
    reach = length(True) + trunk + length(False)
    start = np.array([*world.scene.start[:2], 0.0])
    for box in world.scene.boxes[:1]:
        top = box.top
        corners = top.position + top.polygon @ top.rotation[:, :2].T
        lo, hi = corners.min(axis=0), corners.max(axis=0)
        nearest = np.clip(start, lo, hi)
        distance = float(np.linalg.norm(nearest - start))
        if distance > reach:
            raise InputError(
                f"the nearest point of its top within {reach:.2f} m, the robot's reach from its start",
                field=f"scene.boxes.{box.name}",
                value=round(distance, 3),
            )


def standing(ik: IK, options: PlanOptions) -> Keyframe:
    """The first keyframe: both feet where the robot starts."""
    world, kin = ik.world, ik.kin
    kin.update(world.home)
    up = world.supports[GROUND].normal
    feet = []
    for limb in world.robot.limbs.values():
        if limb.is_arm:
            continue
        surface = limb.surfaces[0]
        s = world.surfaces[surface]
        p = kin.contact_point(surface, up)
        R = kin.rotation(s.body) @ (s.rotation if s.rotation is not None else np.eye(3))
        p = p - up * (p @ up)
        R = support_rotation(world.supports[GROUND], quat_from_matrix(R))
        feet.append(
            Contact(surface=surface, support=GROUND, position=p, quaternion=quat_from_matrix(R))
        )
    task = KeyframeTask(held=tuple(feet), new=(), q_reference=world.home)
    return finish(
        ik, task, options.keyframe, world.home, method="home", iterations=0, cost_before=0.0
    )


def moves_of(sequence: ContactSequence, world: World) -> Iterator[tuple[int, Stance, Move | str]]:
    """Split each change of stance into moves of one limb, or say why there is none.

    A limb that only leaves its contact is part of its next move where it has one. Where
    two surfaces of a limb are down at once, the one nearer to the trunk bears the load.
    """
    closed: dict[str, Contact] = {}
    for limb in world.robot.limbs.values():
        if not limb.is_arm:
            closed[limb.name] = Contact(
                surface=limb.surfaces[0], support=GROUND, position=np.zeros(3), quaternion=[1, 0, 0, 0]
            )
    first = sequence.stances[0]
    for limb in world.robot.limbs.values():
        if limb.name in closed:
            c = first.contact(limb.surfaces[0])
            if c is not None:
                closed[limb.name] = c
    for i, stance in enumerate(sequence.stances[1:], start=1):
        made = False
        reasons = []
        for limb in world.robot.limbs.values():
            wanted = [c for c in stance.contacts if c.surface in limb.surfaces]
            has = closed.get(limb.name)
            if not wanted:
                if has is None:
                    continue
                if _comes_back(sequence, i, limb.surfaces):
                    reasons.append(f"{limb.name.replace('_', ' ')} in the air: part of its next move")
                else:
                    made = True
                    del closed[limb.name]
                    yield i, stance, Move(limb=limb.name, breaks=(has.surface,), makes=None)
                continue
            target = max(wanted, key=lambda c: limb.surfaces.index(c.surface))
            if has is not None and has.surface == target.surface and has.support == target.support:
                if np.linalg.norm(has.position - target.position) < SAME_PLACE:
                    continue
            made = True
            closed[limb.name] = target
            breaks = (has.surface,) if has is not None else ()
            yield i, stance, Move(limb=limb.name, breaks=breaks, makes=target)
        if not made:
            yield i, stance, "; ".join(reasons) or "no limb makes or leaves a contact that bears load"


def _comes_back(sequence: ContactSequence, i: int, surfaces: tuple[str, ...]) -> bool:
    return any(c.surface in surfaces for s in sequence.stances[i + 1 :] for c in s.contacts)


def plan_move(
    ik: IK, before: Keyframe, move: Move, stance: Stance, options: PlanOptions, clock: _Clock
) -> tuple[Keyframe, Path] | str:
    """The next keyframe and the path to it, or why there is none."""
    held = tuple(c for c in before.stance if c.surface not in move.breaks)
    if not held:
        return f"{move}: nothing else bears load"
    task = KeyframeTask(
        held=held,
        new=(move.makes,) if move.makes else (),
        q_reference=before.q,
        directions=stance.posture,
    )
    if move.firm and move.makes:
        key = _keyframe_there(ik, task, move.makes, before.q, options)
    else:
        key = METHODS[options.method](ik, task, before.q, options.keyframe)
    clock.lap("keyframes")
    transition = plan_transition(ik, before, key, move)
    clock.lap("transitions")
    if move.makes and (key.status is not Status.SOLVED or transition.status is not Status.SOLVED):
        key, transition = _again_from_reach(ik, before, key, move, task, transition, options)
        clock.lap("transitions")
    if key.status is not Status.SOLVED:
        return f"{move}: {key.status.value}"
    if transition.status is not Status.SOLVED:
        return f"{move}: {transition.status.value}"
    path = plan_path(ik, transition)
    clock.lap("paths")
    if path.status is not Status.SOLVED:
        return f"{move}: {path.note or path.status.value}"
    return key, path


def _again_from_reach(
    ik: IK,
    before: Keyframe,
    key: Keyframe,
    move: Move,
    task: KeyframeTask,
    transition: Transition,
    options: PlanOptions,
) -> tuple[Keyframe, Transition]:
    """Put the contact where the unloaded robot reaches it, and optimise around that."""
    assert move.makes is not None
    wanted = next(c for c in key.stance if c.surface == move.makes.surface)
    again = _keyframe_there(ik, task, wanted, transition.shifted, options)
    again = replace(again, cost_before=key.cost_before, iterations=key.iterations + again.iterations)
    return again, plan_transition(ik, before, again, move)


def _keyframe_there(
    ik: IK, task: KeyframeTask, wanted: Contact, q: np.ndarray, options: PlanOptions
) -> Keyframe:
    """A stable posture with the new contact at, or nearest to, a given place."""
    contact, solution = approach_contact(ik, task.held, wanted, q)
    fixed = replace(task, new=(contact,), fixed=True)
    key = direct.optimise(ik, fixed, solution.q, options.keyframe)
    return replace(key, method=options.method)
