"""Step after step: keyframe, transition, path; earlier contacts mended where needed.

Each step is planned from the keyframe before it. Where a step fails because of where an
earlier contact lies, that contact is put where the step would have liked it, and
planning goes on from there; where nothing helps, the step is skipped with its reason.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from clamber.contact.contact import Contact
from clamber.contact.steps import Seeds, Step
from clamber.planning.records import PlanOptions, Progress, Route
from clamber.step.change import Change, Failure, change_contact
from clamber.step.ik import IK
from clamber.step.posture import Keyframe
from clamber.step.transition import MARGINS, eased_contacts

MAX_REPAIRS = 4  # earlier contacts that may be put elsewhere for a later step's sake


def follow_steps(
    ik: IK,
    start: Keyframe,
    steps: Sequence[Step],
    options: PlanOptions,
    report: Progress,
) -> Route:
    """Plan all steps in order.

    Args:
        ik: Workspace.
        start: The keyframe to begin from.
        steps: Of the demonstration.
        options: Of the plan.
        report: Called with stage, share and note, for progress.
    """
    changes: list[Change] = []
    failures: dict[int, Failure] = {}  # by step
    steps = list(steps)
    done: list[int] = []  # the step that each change makes
    mended = k = 0
    while k < len(steps):
        step = steps[k]
        report("plan", k / len(steps), str(step))
        route = Route(start=start, changes=tuple(changes))
        found = change_contact(ik, route.end, step, options.keyframe, options.method)
        if isinstance(found, Change):
            done.append(k)
            made = [found]
            if mended < MAX_REPAIRS and found.margin < MARGINS[0]:
                roomier = _roomier(ik, route, [steps[i] for i in done], options)
                if roomier is not None:
                    mended += 1
                    j, again, made = roomier
                    for i, changed in zip(done[j:], again, strict=True):
                        steps[i] = changed
                    del changes[j:]
            changes += made
            k += 1
            continue
        better = None
        if mended < MAX_REPAIRS:
            better = next(repairs(ik, route, step), None)
        if better is None:
            failures[k] = found
            k += 1
            continue
        mended += 1
        places, seeds = better
        steps[k] = replace(step, seeds=seeds)
        for j, contact in places.items():
            steps[done[j]] = _placed(steps[done[j]], contact)
        j = min(places)
        k = done[j]
        del changes[j:], done[j:]
        failures = {i: f for i, f in failures.items() if i < k}
    return Route(
        start=start,
        changes=tuple(changes),
        failures=tuple(failures.values()),
        arrived=not failures,
    )


def _placed(step: Step, contact: Contact) -> Step:
    """The step, its contact made there and nowhere else."""
    return replace(step, makes=contact, fixed=True)


def _roomier(
    ik: IK, route: Route, making: list[Step], options: PlanOptions
) -> tuple[int, list[Step], list[Change]] | None:
    """A step with the largest margin, for which earlier contacts are put elsewhere.

    `making` holds the step of each change, and last the one to find more room for.

    Returns:
        The first change to be replaced, its step and those after it, and what has been
        planned for them; None where that does not help.
    """
    step = making[-1]
    for places, seeds in repairs(ik, route, step, margin=MARGINS[0]):
        j = min(places)
        again = [*making[j:-1], replace(step, seeds=seeds)]
        for i, contact in places.items():
            again[i - j] = _placed(again[i - j], contact)
        least = [*(c.margin for c in route.changes[j:]), MARGINS[0]]
        key, made = route.keyframes[j], []
        for s, margin in zip(again, least, strict=True):
            found = change_contact(ik, key, s, options.keyframe, options.method)
            if isinstance(found, Failure) or found.margin < margin:
                break
            key = found.keyframe
            made.append(found)
        else:
            return j, again, made
    return None


def repairs(
    ik: IK, route: Route, step: Step, *, margin: float = MARGINS[-1]
) -> Iterator[tuple[dict[int, Contact], Seeds]]:
    """Which earlier changes should have made their contacts elsewhere for `step`.

    Looks at one contact after the other, the last one first, and then at all at once.

    Yields:
        By index of the change, the contact at its better place, and the posture that
        `step` then goes through.
    """
    standing_on = {c.surface for c in route.end.stance} - set(step.breaks)
    made: dict[str, int] = {}
    for j in range(len(route.changes) - 1, -1, -1):
        new = route.changes[j].step.makes
        if new is not None and new.surface in standing_on and new.surface not in made:
            made[new.surface] = j
    for surfaces in (*([x] for x in made), list(made)):
        eased = eased_contacts(ik, route.end, step, surfaces, margin=margin)
        if eased is not None:
            contacts, seeds = eased
            yield {made[c.surface]: c for c in contacts}, seeds
