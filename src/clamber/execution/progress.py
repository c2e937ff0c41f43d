"""The plan at hand: its contact changes in samples, and what is left of it."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np

from clamber.contact.contact import Contact
from clamber.errors import InputError, Status
from clamber.model.progress import Progress
from clamber.model.records import short_repr
from clamber.model.scene import Scene
from clamber.planning.planner import plan
from clamber.planning.records import Budget, Plan, State
from clamber.planning.trajectory import Trajectory
from clamber.step.change import Change, Failure
from clamber.step.ik import ExtraClearance
from clamber.step.posture import Keyframe

HORIZON = 6  # contact changes that a policy is followed ahead, before it goes on
FALLBACK = 0.035  # [m] a deviation that the plan at hand may survive as it is


@dataclass(frozen=True, eq=False, slots=True)
class Span:
    """A contact change of a trajectory, in samples."""

    begin: int  # sample of the keyframe before
    swing: int  # first sample with the limb in the air
    touch: int  # last sample before the new contact is closed
    end: int
    makes: Contact | None

    __repr__ = short_repr


class AtHand:
    """The plan at hand, and how far it has come.

    Attributes:
        plan: Its `keyframes` are those before, between and after the changes.
        spans: Its contact changes.
        change: How many of them are done: the number of the present one.
        failure: Why it does not lead to the end; empty where it does.
        goes_on: It is a policy's, planned some changes ahead.
    """

    def __init__(self, plan: Plan, trajectory: Trajectory) -> None:
        """At the beginning of the plan, timed as this trajectory."""
        self.plan, self.keyframes = plan, plan.keyframes
        self.spans, self.change = _spans(plan, trajectory), 0
        self.failure = str(plan.failures[0]) if plan.failures else ""
        self.goes_on = not plan.complete and not plan.failures

    @property
    def is_through(self) -> bool:
        """All changes are done."""
        return self.change == len(self.spans)

    @property
    def stance(self) -> tuple[Contact, ...]:
        """Contacts of the last keyframe reached, as planned."""
        return self.keyframes[self.change].stance

    @property
    def next_stance(self) -> tuple[Contact, ...]:
        """Contacts of the next keyframe."""
        return self.keyframes[self.change + 1].stance

    @property
    def next_contact(self) -> Contact | None:
        """The contact that the present change makes, if any."""
        return None if self.is_through else self.spans[self.change].makes

    def near_contacts(self) -> dict[str, Contact]:
        """Contacts of the last and the next keyframe, by surface."""
        near = self.keyframes[self.change : self.change + 2]
        return {c.surface: c for key in near for c in key.stance}

    def closed_contacts(
        self, closed: np.ndarray, surfaces: tuple[str, ...]
    ) -> list[Contact]:
        """Contacts that are closed, by their surfaces of nS in order: (nS,) bool."""
        row = surfaces.index
        return [c for s, c in self.near_contacts().items() if closed[row(s)]]


def rest_of(
    made: Plan,
    scene: Scene,
    start: State | Keyframe | None,
    off: float,
    clearance: ExtraClearance,
    report: Progress,
) -> Plan:
    """The rest of a plan, in the scene as it is estimated.

    Where contacts are so far `off` that the plan at hand will not do, other ones than
    the demonstrated may. Where nothing robust is left to do, it need not be.
    """
    options = made.options
    try:
        found = plan(
            made.policy or made.sequence,
            made.world.robot,
            scene,
            start=start,
            options=options,
            contacts="any" if off >= FALLBACK else "demonstrated",
            budget=Budget(ahead=HORIZON),
            clearance=clearance,
            progress=lambda stage, done, note: report(
                stage, done, f"planning again: {note}"
            ),
        )
        if not (options.robust and found.failures):
            return found
        keyframe = replace(options.keyframe, robust=False)
        usual = replace(options, robust=False, keyframe=keyframe)
        made = replace(made, options=usual)
        return rest_of(made, scene, start, off, clearance, report)
    except InputError as e:
        failure = Failure(status=Status.UNREACHABLE, detail=str(e))
        return replace(
            made, changes=(), failures=(failure,), trajectory=None, complete=False
        )


def nearest_keyframe(plan: Plan, made: Change, *, begin: int) -> int | None:
    """Keyframe of a plan to which a contact change of another plan leads.

    Args:
        plan: Its keyframes are looked at, but for the start.
        made: The change.
        begin: The first keyframe that it may be.

    Returns:
        Of those after the same step, with the same surfaces on the same supports, the
        one whose contacts are the nearest, the first of equals; None: there is none.
    """
    here = _places(made.keyframe)
    away: dict[int, float] = {}
    for i, change in enumerate(plan.changes, start=1):
        there = _places(change.keyframe)
        same = str(change.step) == str(made.step) and there.keys() == here.keys()
        if i >= begin and same:
            gaps = [np.linalg.norm(p - here[k]) for k, p in there.items()]
            away[i] = float(sum(gaps))
    return min(away, key=away.__getitem__, default=None)


def _places(key: Keyframe) -> dict[tuple[str, str], np.ndarray]:
    """(3,) of each contact, by surface and support."""
    return {(c.surface, c.support): c.position for c in key.stance}


def _spans(plan: Plan, t: Trajectory) -> list[Span]:
    """The contact changes of a trajectory."""
    out = []
    for j, (before, after) in enumerate(itertools.pairwise(plan.keyframes)):
        parts = [x for x in t.segments if x.change == j]
        begin, end = t.at(float(t.keyframes[j])), parts[-1].end - 1
        making = next((x for x in parts if x.makes is not None), None)
        if making is None:
            out.append(Span(begin, begin, end, end, None))
            continue
        # A limb that is in the air swings from the start.
        gone = {c.surface for c in before.stance} - {c.surface for c in after.stance}
        swing = making.begin if gone else begin
        out.append(Span(begin, swing, making.end - 1, end, making.makes))
    return out
