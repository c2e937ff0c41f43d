"""One contact change: keyframe, transition and path to it, or why there is none."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from clamber.contact.contact import Contact
from clamber.contact.steps import Step
from clamber.errors import Status
from clamber.model.scene import GROUND
from clamber.model.se3 import matrix_from_quat, matrix_from_rpy, quat_from_matrix
from clamber.model.world import World
from clamber.step import direct, gradient, lbfgs
from clamber.step.ik import IK, support_rotation
from clamber.step.path import Path, plan_path
from clamber.step.posture import (
    Keyframe,
    KeyframeOptions,
    KeyframeTask,
    finish,
)
from clamber.step.stability import limiting_joint
from clamber.step.transition import (
    MARGINS,
    approach_contact,
    plan_transition,
    rolled,
)

METHODS = {
    "direct": direct.optimise,
    "lbfgs": lbfgs.optimise,
    "gradient": gradient.optimise,
}


def standing(
    ik: IK, options: KeyframeOptions, at: np.ndarray | None = None
) -> Keyframe:
    """Both feet on the ground in the posture that the robot starts from.

    Args:
        ik: Workspace.
        options: Of the posture optimisation.
        at: (3,) ankles' midpoint x, y [m] and yaw [rad]; None: where the robot starts.
    """
    world, kin = ik.world, ik.kin
    home = world.home if at is None else home_at(world, at)
    kin.update(home)
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
            Contact(
                surface=surface,
                support=GROUND,
                position=p,
                quaternion=quat_from_matrix(R),
            )
        )
    task = KeyframeTask(held=tuple(feet), new=(), q_reference=home)
    return finish(
        ik,
        task,
        options,
        home,
        method="home",
        iterations=0,
        cost_before=0.0,
    )


def _home_over(world: World, feet: Sequence[Contact]) -> np.ndarray:
    """(nq,) the posture that the robot starts from, over feet somewhere."""
    x, y, z = np.mean([c.position for c in feet], axis=0)
    headings = np.sum([matrix_from_quat(c.quaternion)[:, 0] for c in feet], axis=0)
    q = home_at(world, np.array([x, y, np.arctan2(headings[1], headings[0])]))
    q[2] += z
    return q


def home_at(world: World, at: np.ndarray) -> np.ndarray:
    """(nq,) the posture that the robot starts from, moved along the ground.

    Args:
        world: Robot and scene.
        at: (3,) ankles' midpoint x, y [m] and yaw [rad].
    """
    start, q = world.scene.start, world.home.copy()
    R = matrix_from_rpy(np.array([0.0, 0.0, at[2] - start[2]]))
    q[:2] = R[:2, :2] @ (q[:2] - start[:2]) + at[:2]
    q[3:7] = quat_from_matrix(R @ matrix_from_quat(q[3:7]))
    return q


def plan_step(
    ik: IK,
    before: Keyframe,
    step: Step,
    method: str,
    options: KeyframeOptions,
    lap: Callable[[str], None],
) -> tuple[Keyframe, Path] | str:
    """The next keyframe and the path to it, or why there is none."""
    held = tuple(c for c in before.stance if c.surface not in step.breaks)
    if not held:
        return f"{step}: nothing else bears load"
    result = _plan_on(ik, before, step, held, method, options, lap)
    if isinstance(result, str) and step.makes:
        # On tiptoe, feet that stay reach farther.
        tiptoe = tuple(rolled(ik, before.q, c, step.makes.position) for c in held)
        if any(a is not b for a, b in zip(held, tiptoe, strict=True)):
            other = _plan_on(ik, before, step, tiptoe, method, options, lap)
            if not isinstance(other, str):
                return other
    return result


def _plan_on(
    ik: IK,
    before: Keyframe,
    step: Step,
    held: tuple[Contact, ...],
    method: str,
    options: KeyframeOptions,
    lap: Callable[[str], None],
) -> tuple[Keyframe, Path] | str:
    """The next keyframe and the path to it on the contacts `held`, or why not."""
    world = ik.world
    new = (step.makes,) if step.makes else ()
    task = KeyframeTask(
        held=held,
        new=new,
        q_reference=before.q if step.reference is None else step.reference,
        directions=step.target.posture,
        base_rotation=step.base_rotation,
    )
    begin = before.q
    if step.stands_up:
        begin = _home_over(world, (*held, *new))
        task = replace(task, q_reference=begin, directions={})
    wanted, result = step.makes, "nothing tried"
    for there in (True, False) if step.fixed else (False, True):
        if wanted is not None and there:
            # Put the contact where the unloaded robot reaches it.
            key = _keyframe_there(ik, task, wanted, step, before.q, method, options)
        else:
            key = METHODS[method](ik, task, begin, options)
            if step.makes is not None:
                wanted = next(c for c in key.stance if c.surface == step.makes.surface)
        lap("keyframes")
        result = _best_margin(ik, before, key, step, lap)
        if not isinstance(result, str):
            return key, result
        if step.makes is None:
            break
    return result


def _best_margin(
    ik: IK, before: Keyframe, key: Keyframe, step: Step, lap: Callable[[str], None]
) -> Path | str:
    """The path with the largest of `MARGINS` for which there is one, or why not."""
    if key.status is Status.OVERLOADED:
        return f"{step}: {limiting_joint(ik.kin, key.q, key.stance)}"
    if key.status is not Status.SOLVED:
        return f"{step}: {key.status.value}"
    reason = ""
    for margin in MARGINS:
        transition = plan_transition(ik, before, key, step, margin=margin)
        lap("transitions")
        if transition.status is not Status.SOLVED:
            reason = f"{step}: {transition.note or transition.status.value}"
            continue
        path = plan_path(ik, transition)
        lap("paths")
        if path.status is Status.SOLVED:
            return path
        reason = f"{step}: {path.note or path.status.value}"
    return reason


def _keyframe_there(
    ik: IK,
    task: KeyframeTask,
    wanted: Contact,
    step: Step,
    q: np.ndarray,
    method: str,
    options: KeyframeOptions,
) -> Keyframe:
    """A stable posture with the new contact at, or nearest to, a given place."""
    contact, solution = approach_contact(ik, task.held, wanted, q, step.seeds.touching)
    fixed = replace(task, new=(contact,), fixed=True)
    key = direct.optimise(ik, fixed, solution.q, options)
    return replace(key, method=method)
