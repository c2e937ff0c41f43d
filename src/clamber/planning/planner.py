"""plan(): a contact sequence becomes a trajectory, stage by stage.

sequence -> robot's scale -> moves -> keyframes -> transitions -> paths -> trajectory
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from clamber.contact.contact import ContactSequence
from clamber.contact.scaling import retarget
from clamber.contact.steps import Step, split_moves
from clamber.errors import InputError
from clamber.model.robot import Robot
from clamber.model.scene import Scene
from clamber.model.world import World, build_world
from clamber.planning.records import Plan, PlanOptions, Progress, Route
from clamber.planning.search import follow_steps
from clamber.planning.trajectory import Trajectory, build_trajectory
from clamber.step.change import Change, standing
from clamber.step.ik import IK
from clamber.step.path import Phase, overlap, watched_pairs
from clamber.step.posture import Keyframe
from clamber.step.stability import limiting_joint

# Where a step is missed, the search begins again with other weights of the keyframes:
# they lead it to other contacts, from which there may be a way. The default is first.
VARIATIONS: tuple[dict[str, float], ...] = (
    {},
    {"stability_weight": 2.0},
    {"direction_weight": 2.0},
    {"reference_weight": 2.0},
    {"reference_weight": 0.5},
    {"stability_weight": 4.0},
    {"balance_margin": 1.4},
)


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
    if options.speed != "max" and not options.speed > 0:
        raise InputError(
            "a positive joint speed [rad/s], or max", field="speed", value=options.speed
        )
    clock = _Clock()
    world = build_world(robot, scene)
    ik = IK(world)
    check_reach(ik)
    start = standing(ik, options.keyframe)
    check_start(ik, start)
    goal = retarget(sequence, world)
    clock.lap("retarget")

    steps, skipped = split_moves(goal, world)
    found, used = search_steps(ik, start, steps, options, report)
    clock.lap("search")
    report("trajectory", 1.0, "")
    trajectory = timed(world, found.changes, options.speed)
    clock.lap("trajectory")
    return Plan(
        world=world,
        options=used,
        sequence=goal,
        start=found.start,
        changes=found.changes,
        skipped=tuple(skipped),
        failures=found.failures,
        trajectory=trajectory,
        complete=found.arrived and bool(found.changes),
        timings=clock.laps,
    )


def search_steps(
    ik: IK,
    start: Keyframe,
    steps: Sequence[Step],
    options: PlanOptions,
    report: Progress = lambda stage, share, note: None,
) -> tuple[Route, PlanOptions]:
    """What the search finds with the weights that lead it farthest, and those.

    Args:
        ik: Workspace.
        start: The keyframe to begin from.
        steps: To plan, in order.
        options: Of the plan; `VARIATIONS` of its weights are tried where it is stuck.
        report: Called with stage, share and note, for progress.
    """
    found, used = None, options
    for factors in VARIATIONS:
        weights = {k: f * getattr(options.keyframe, k) for k, f in factors.items()}
        varied = replace(options, keyframe=replace(options.keyframe, **weights))
        trial = follow_steps(ik, start, steps, varied, report)
        if found is None or len(trial.failures) < len(found.failures):
            found, used = trial, varied
        if found.arrived:
            break
    assert found is not None
    return found, used


def timed(
    world: World,
    changes: Sequence[Change],
    speed: float | Literal["max"],
    lead: Sequence[Phase] = (),
) -> Trajectory | None:
    """The trajectory of `lead`, which leads to the first keyframe, and the changes.

    Args:
        world: Robot and scene.
        changes: One after the other.
        speed: Largest joint speed [rad/s], or `max`.
        lead: Phases before the first change.

    Returns:
        None where nothing moves.
    """
    phases = [*lead, *(p for change in changes for p in change.phases)]
    if not phases:
        return None
    ends = np.cumsum([len(lead), *(len(change.phases) for change in changes)])
    return build_trajectory(world, phases, speed=speed, keyframe_after=ends.tolist())


class _Clock:
    """Seconds by stage."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self.laps[stage] = self.laps.get(stage, 0.0) + now - self._last
        self._last = now


def check_start(ik: IK, start: Keyframe) -> None:
    """A robot that cannot stand, or stands in a box, is the user's mistake.

    Raises:
        InputError: The robot's home posture falls over or exceeds its effort limits, or
            a box is where it stands.
    """
    world = ik.world
    depth, pair = overlap(ik, start.q, watched_pairs(world, start.stance))
    names = (
        [] if pair < 0 else [world.model.geom(int(g)).name for g in world.pairs[pair]]
    )
    boxes = [b.name for b in world.scene.boxes if b.name in names]
    if depth > 0 and boxes:
        raise InputError(
            "a start where no box is: move the one or the other",
            field="scene.start",
            value=" and ".join(names),
        )
    if start.com_margin < 0 or not start.equilibrium.feasible:
        why = f"its mass is {-1e3 * start.com_margin:.0f} mm beside its soles"
        if start.com_margin >= 0:
            why = limiting_joint(ik.kin, start.q, start.stance)
        raise InputError(
            f"a posture that stands within the effort limits ({why})",
            field="robot.home",
        )


def check_reach(ik: IK) -> None:
    """A box that no limb could touch from the start is the user's mistake.

    Raises:
        InputError: The nearest point of the first box's top is farther from where the
            robot stands than legs, trunk and arms are long together.
    """
    kin, world = ik.kin, ik.world
    kin.update(world.home)

    def length(arm: bool) -> float:
        limb = next(x for x in world.robot.limbs.values() if x.is_arm == arm)
        a, b, c = (kin.landmark(n)[1] for n in (limb.root, limb.middle, limb.end))
        return float(np.linalg.norm(b - a) + np.linalg.norm(c - b))

    shoulder, hip = (
        next(
            kin.landmark(x.root)[1]
            for x in world.robot.limbs.values()
            if x.is_arm == arm
        )
        for arm in (True, False)
    )
    reach = length(True) + float(np.linalg.norm(shoulder - hip)) + length(False)
    start = np.array([*world.scene.start[:2], 0.0])
    for box in world.scene.boxes[:1]:
        top = box.top
        local = top.rotation.T @ (start - top.position)
        half = top.polygon.max(axis=0)
        nearest = np.array([*np.clip(local[:2], -half, half), 0.0])
        distance = float(np.linalg.norm(nearest - local))
        if distance > reach:
            raise InputError(
                f"the nearest point of its top within {reach:.2f} m of the start,"
                " the robot's reach",
                field=f"scene.boxes.{box.name}",
                value=f"{distance:.2f} m away",
            )
