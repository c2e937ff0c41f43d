"""Step after step: keyframe, transition, path; earlier contacts mended where needed.

Each step is planned from the keyframe before it. Where a step fails because of where an
earlier contact lies, that contact is put where the step would have liked it, and
planning goes on from there; where nothing helps, the step is skipped with its reason.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

from clamber.contact.contact import Contact
from clamber.contact.steps import Seeds, Skipped, Step
from clamber.step.change import plan_step, standing
from clamber.step.ik import IK
from clamber.step.path import Path
from clamber.step.posture import (
    Keyframe,
    KeyframeOptions,
)
from clamber.step.transition import (
    MARGINS,
    eased_contacts,
)

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
        report("plan", k / len(steps), str(step))
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
            better = next(repairs(ik, keyframes, paths, step), None)
            lap("repairs")
        if better is None:
            missed[k] = Skipped(stance=step.stance, reason=result, missed=True)
            k += 1
            continue
        mended += 1
        places, seeds = better
        steps[k] = replace(step, seeds=seeds)
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
    return replace(step, makes=contact, fixed=True)


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
    for places, seeds in repairs(ik, keyframes, paths, step, margin=MARGINS[0]):
        lap("repairs")
        j = min(places)
        again = [*making[j:-1], replace(step, seeds=seeds)]
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


def repairs(
    ik: IK,
    keyframes: list[Keyframe],
    paths: list[Path],
    step: Step,
    *,
    margin: float = MARGINS[-1],
) -> Iterator[tuple[dict[int, Contact], Seeds]]:
    """Which earlier paths should have made their contacts elsewhere for `step` to work.

    Looks at one contact after the other, the last one first, and then at all at once.

    Yields:
        By index of the path, the contact at its better place, and the posture that
        `step` then goes through.
    """
    standing_on = {c.surface for c in keyframes[-1].stance} - set(step.breaks)
    made: dict[str, int] = {}
    for j in range(len(paths) - 1, -1, -1):
        new = paths[j].transition.step.makes
        if new is not None and new.surface in standing_on and new.surface not in made:
            made[new.surface] = j
    for surfaces in (*([x] for x in made), list(made)):
        eased = eased_contacts(ik, keyframes[-1], step, surfaces, margin=margin)
        if eased is not None:
            contacts, seeds = eased
            yield {made[c.surface]: c for c in contacts}, seeds
