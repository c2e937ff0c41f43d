"""Step after step: keyframe, transition, path; earlier contacts mended where needed.

Each step is planned from the keyframe before it. Where a step fails because of where an
earlier contact lies, that contact is put where the step would have liked it, and
planning goes on from there; where nothing helps, the step is skipped with its reason.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from clamber.contact import Contact
from clamber.errors import Status
from clamber.model import World
from clamber.moves import Guide, Move, Skipped, Step
from clamber.path import Path, plan_path
from clamber.posture import direct, gradient, lbfgs
from clamber.posture.ik import IK, support_rotation
from clamber.posture.keyframe import (
    Keyframe,
    KeyframeOptions,
    KeyframeTask,
    finish,
    weakness,
)
from clamber.scene import GROUND
from clamber.se3 import matrix_from_quat, matrix_from_rpy, quat_from_matrix
from clamber.transition import (
    MARGINS,
    approach_contact,
    eased_contacts,
    plan_transition,
    rolled,
)

METHODS = {
    "direct": direct.optimise,
    "lbfgs": lbfgs.optimise,
    "gradient": gradient.optimise,
}
MAX_REPAIRS = 4  # earlier contacts that may be put elsewhere for a later step's sake


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Found:
    """What the search found.

    Attributes:
        keyframes: The start, and one more for each path.
        paths: Between neighbouring keyframes.
        missed: Steps for which there is no way.
    """

    keyframes: tuple[Keyframe, ...]
    paths: tuple[Path, ...]
    missed: tuple[Skipped, ...]


def plan_steps(
    ik: IK,
    steps: Sequence[Step],
    method: str,
    options: KeyframeOptions,
    *,
    lap: Callable[[str], None],
    report: Callable[[str, float, str], None],
    start: Keyframe | None = None,
) -> Found:
    """Plan all steps in order.

    Args:
        ik: Workspace.
        steps: Of the demonstration.
        method: Key of `METHODS`.
        options: Of the posture optimisation.
        lap: Called with the stage that has just ended, for timing.
        report: Called with stage, share and note, for progress.
        start: The keyframe to begin from; None: both feet where the robot starts.
    """
    keyframes = [standing(ik, options) if start is None else start]
    paths: list[Path] = []
    missed: dict[int, Skipped] = {}  # by step
    steps = list(steps)
    done: list[int] = []  # the step that each path makes
    mended = k = 0
    while k < len(steps):
        step = steps[k]
        report("plan", k / len(steps), str(step.move))
        result = plan_step(ik, keyframes[-1], step, method, options, lap)
        if not isinstance(result, str):
            made, done = [result], [*done, k]
            if mended < MAX_REPAIRS and _margin(result[1]) < MARGINS[0]:
                making = [steps[i] for i in done]
                roomier = _roomier(ik, keyframes, paths, making, method, options, lap)
                if roomier is not None:
                    mended += 1
                    j, again, made = roomier
                    for i, changed in zip(done[j:], again, strict=True):
                        steps[i] = changed
                    del keyframes[j + 1 :], paths[j:]
            keyframes += [key for key, _ in made]
            paths += [path for _, path in made]
            k += 1
            continue
        better = None
        if mended < MAX_REPAIRS:
            better = next(repairs(ik, keyframes, paths, step.move), None)
            lap("repairs")
        if better is None:
            missed[k] = Skipped(stance=step.stance, reason=result, missed=True)
            k += 1
            continue
        mended += 1
        places, guide = better
        steps[k] = replace(step, guide=guide)
        for j, contact in places.items():
            steps[done[j]] = _placed(steps[done[j]], contact)
        j = min(places)
        k = done[j]
        del keyframes[j + 1 :], paths[j:], done[j:]
        missed = {i: m for i, m in missed.items() if i < k}
    return Found(
        keyframes=tuple(keyframes), paths=tuple(paths), missed=tuple(missed.values())
    )


def _margin(path: Path) -> float:
    return path.transition.margin


def _placed(step: Step, contact: Contact) -> Step:
    """The step, its contact made there and nowhere else."""
    return replace(step, move=replace(step.move, makes=contact, firm=True))


def _roomier(
    ik: IK,
    keyframes: list[Keyframe],
    paths: list[Path],
    making: list[Step],
    method: str,
    options: KeyframeOptions,
    lap: Callable[[str], None],
) -> tuple[int, list[Step], list[tuple[Keyframe, Path]]] | None:
    """A step with the largest margin, for which earlier contacts are put elsewhere.

    `making` holds the step of each path, and last the one to find more room for.

    Returns:
        The first path to be replaced, its step and those after it, and what has been
        planned for them; None where that does not help.
    """
    step = making[-1]
    for places, guide in repairs(ik, keyframes, paths, step.move, margin=MARGINS[0]):
        lap("repairs")
        j = min(places)
        again = [*making[j:-1], replace(step, guide=guide)]
        for i, contact in places.items():
            again[i - j] = _placed(again[i - j], contact)
        key, made = keyframes[j], []
        for s in again:
            least = MARGINS[0] if s is again[-1] else _margin(paths[j + len(made)])
            result = plan_step(ik, key, s, method, options, lap)
            if isinstance(result, str) or _margin(result[1]) < least:
                break
            key = result[0]
            made.append(result)
        else:
            return j, again, made
    return None


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


def repairs(
    ik: IK,
    keyframes: list[Keyframe],
    paths: list[Path],
    move: Move,
    *,
    margin: float = MARGINS[-1],
) -> Iterator[tuple[dict[int, Contact], Guide]]:
    """Which earlier paths should have made their contacts elsewhere for `move` to work.

    Looks at one contact after the other, the last one first, and then at all at once.

    Yields:
        By index of the path, the contact at its better place, and the posture that
        `move` then goes through.
    """
    standing_on = {c.surface for c in keyframes[-1].stance} - set(move.breaks)
    made: dict[str, int] = {}
    for j in range(len(paths) - 1, -1, -1):
        new = paths[j].transition.move.makes
        if new is not None and new.surface in standing_on and new.surface not in made:
            made[new.surface] = j
    for surfaces in (*([x] for x in made), list(made)):
        eased = eased_contacts(ik, keyframes[-1], move, surfaces, margin=margin)
        if eased is not None:
            contacts, guide = eased
            yield {made[c.surface]: c for c in contacts}, guide


def plan_step(
    ik: IK,
    before: Keyframe,
    step: Step,
    method: str,
    options: KeyframeOptions,
    lap: Callable[[str], None],
) -> tuple[Keyframe, Path] | str:
    """The next keyframe and the path to it, or why there is none."""
    move = step.move
    held = tuple(c for c in before.stance if c.surface not in move.breaks)
    if not held:
        return f"{move}: nothing else bears load"
    result = _plan_on(ik, before, step, held, method, options, lap)
    if isinstance(result, str) and move.makes:
        # On tiptoe, feet that stay reach farther.
        tiptoe = tuple(rolled(ik, before.q, c, move.makes.position) for c in held)
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
    move, world = step.move, ik.world
    new = (move.makes,) if move.makes else ()
    task = KeyframeTask(
        held=held,
        new=new,
        q_reference=before.q if step.reference is None else step.reference,
        directions=step.target.posture,
        base_rotation=step.base_rotation,
    )
    begin = before.q
    if step.rises:
        begin = _home_over(world, (*held, *new))
        task = replace(task, q_reference=begin, directions={})
    wanted, result = move.makes, "nothing tried"
    for there in (True, False) if move.firm else (False, True):
        if wanted is not None and there:
            # Put the contact where the unloaded robot reaches it.
            key = _keyframe_there(ik, task, wanted, step, before.q, method, options)
        else:
            key = METHODS[method](ik, task, begin, options)
            if move.makes is not None:
                wanted = next(c for c in key.stance if c.surface == move.makes.surface)
        lap("keyframes")
        result = _best_margin(ik, before, key, step, lap)
        if not isinstance(result, str):
            return key, result
        if move.makes is None:
            break
    return result


def _best_margin(
    ik: IK, before: Keyframe, key: Keyframe, step: Step, lap: Callable[[str], None]
) -> Path | str:
    """The path with the largest of `MARGINS` for which there is one, or why not."""
    move = step.move
    if key.status is Status.OVERLOADED:
        ik.kin.update(key.q)
        return f"{move}: {weakness(ik.kin, key.stance)}"
    if key.status is not Status.SOLVED:
        return f"{move}: {key.status.value}"
    reason = ""
    for margin in MARGINS:
        transition = plan_transition(
            ik, before, key, move, margin=margin, guide=step.guide
        )
        lap("transitions")
        if transition.status is not Status.SOLVED:
            reason = f"{move}: {transition.note or transition.status.value}"
            continue
        path = plan_path(ik, transition)
        lap("paths")
        if path.status is Status.SOLVED:
            return path
        reason = f"{move}: {path.note or path.status.value}"
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
    contact, solution = approach_contact(ik, task.held, wanted, q, step.guide.touching)
    fixed = replace(task, new=(contact,), fixed=True)
    key = direct.optimise(ik, fixed, solution.q, options)
    return replace(key, method=method)
