"""A contact sequence as a person changes it: contacts moved, surfaces left out.

Edits are made to the sequence of a plan, which is in the robot's scene and at its
scale; planning it again is `pipeline.plan`, as ever.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from clamber.contact.contact import Contact, ContactSequence
from clamber.contact.steps import same_place
from clamber.execution.simulation import Rollout
from clamber.execution.verdict import Verdict
from clamber.planning.planner import plan
from clamber.planning.records import Plan
from clamber.planning.substitutes import without_surfaces
from clamber.run.folder import (
    SEQUENCE,
    next_free_folder,
    save_plan,
    save_rollout,
    save_sequence,
    save_verdict,
)

INSET = 0.01  # [m] a contact that is dragged stays so far inside its support
FOLDER = "edited"  # in the run folder


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Interval:
    """A contact over the stances of a sequence that hold it.

    Attributes:
        contact: As the sequence has it.
        first, last: Its first stance, and the one after its last.
        planned: (3,) where the plan makes it [m], which optimises what it is shown.
    """

    contact: Contact
    first: int
    last: int
    planned: np.ndarray

    @property
    def name(self) -> str:
        """For people."""
        return f"{self.contact.surface} on {self.contact.support}, stance {self.first}"


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Edits:
    """What a person wants otherwise.

    Attributes:
        moved: Place (3,) of contacts by the index of their interval [m].
        off: Surfaces that are not to be used.
    """

    moved: Mapping[int, np.ndarray] = field(
        default_factory=lambda: MappingProxyType({})
    )
    off: frozenset[str] = frozenset()

    def __bool__(self) -> bool:
        """Whether there is any."""
        return bool(self.moved or self.off)


def intervals_of(made: Plan) -> tuple[Interval, ...]:
    """The contacts of a plan's sequence that can be moved: those made on the way."""
    sequence = made.sequence
    planned = {
        (c.step.stance, c.step.makes.surface): c.keyframe
        for c in made.changes
        if c.step.index is not None and c.step.makes is not None
    }
    out = []
    for surface in made.world.surfaces:
        column = [s.contact(surface) for s in sequence.stances]
        i = 0
        while i < len(column):
            c, j = column[i], i + 1
            if c is None:
                i += 1
                continue
            while j < len(column) and (d := column[j]) and same_place(c, d):
                j += 1
            if i > 0:
                key = planned.get((i, surface))
                at = [x for x in key.stance if x.surface == surface] if key else []
                out.append(
                    Interval(
                        contact=c,
                        first=i,
                        last=j,
                        planned=at[0].position if at else c.position,
                    )
                )
            i = j
    return tuple(sorted(out, key=lambda s: s.first))


def edited_sequence(made: Plan, edits: Edits) -> ContactSequence:
    """The sequence of a plan with the edits in it.

    Raises:
        KeyError: A interval is none of the plan's.
    """
    intervals = dict(enumerate(intervals_of(made)))
    stances = list(made.sequence.stances)
    for index, place in edits.moved.items():
        interval = intervals[index]
        support = made.world.supports[interval.contact.support]
        contact = replace(
            interval.contact, position=support.nearest(place, INSET), fixed=True
        )
        for i in range(interval.first, interval.last):
            stances[i] = replace(
                stances[i],
                contacts=tuple(
                    contact if c.surface == contact.surface else c
                    for c in stances[i].contacts
                ),
            )
    sequence = replace(made.sequence, stances=tuple(stances))
    return without_surfaces(sequence, edits.off)


def plan_edited(
    made: Plan,
    edits: Edits,
    progress: Callable[[str, float, str], None] | None = None,
) -> Plan:
    """Plan again, with the edits.

    Raises:
        InputError: The scene does not fit what is left of the sequence.
    """
    return plan(
        edited_sequence(made, edits),
        made.world.robot,
        made.world.scene,
        options=made.options,
        progress=progress,
    )


def save_edited(
    folder: Path, made: Plan, done: tuple[Rollout, Verdict] | None = None
) -> Path:
    """Save a plan, and what physics made of it, as a run of its own.

    Args:
        folder: The run folder: `edited` in it, or `edited-2` ... where that exists.
        made: The plan.
        done: Rollout and verdict, where it has been simulated.

    Raises:
        OSError: It cannot be written.
    """
    out = next_free_folder(folder, FOLDER)
    save_sequence(made.sequence, out / SEQUENCE)
    save_plan(made, out)
    if done is not None:
        save_rollout(made, done[0], out)
        save_verdict(done[1], out)
    return out


def paired_times(
    plan: Plan, reached: Sequence[float | None], end: float
) -> tuple[np.ndarray, np.ndarray]:
    """Times (n,) of robot and person at which they make the same contact [s].

    Between them the one clock is the other one, stretched.

    Args:
        plan: What was to be done.
        reached: When each keyframe is reached [s].
        end: Of the robot's motion [s].
    """
    t = plan.sequence.t
    robot, person = [0.0], [float(t[0])]
    for change, at in zip(plan.changes, reached[1:], strict=True):
        if change.step.index is None or at is None:
            continue
        if at > robot[-1]:
            robot.append(at)
            person.append(float(t[change.step.stance]))
    if end > robot[-1]:
        robot.append(end)
        person.append(float(t[-1]))
    return np.array(robot), np.array(person)
