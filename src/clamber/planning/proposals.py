"""Proposals of a gait, contacts to be made or stairs to climb, and their results."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np

from clamber.contact.contact import Contact
from clamber.contact.steps import Step
from clamber.errors import Status
from clamber.model.records import short_repr
from clamber.planning.route import Frame
from clamber.step.change import Change, Failure
from clamber.step.posture import Keyframe

Accept = Literal["all", "some", "never"]
Made = tuple[tuple[Change, str], ...]  # changes with their options


@dataclass(frozen=True, eq=False, slots=True)
class Goal:
    """A contact that shall be made, the first of some that can be, for an option."""

    option: str
    contacts: tuple[Contact, ...]

    __repr__ = short_repr


@dataclass(frozen=True, slots=True, kw_only=True)
class Round:
    """How goals are tried: the first contact alone; the pelvis as the policy says."""

    first: bool = False
    pelvis: bool = False


FREELY, IMPOSED = (Round(),), (Round(pelvis=True),)
# What cannot move all the way is tried again once the others have.
TOGETHER = (Round(first=True, pelvis=True), Round())


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Outcome:
    """What came of a proposal, or where a manoeuvre begins.

    Attributes:
        key: The keyframe after it.
        changes: Made; those that the proposal came after first.
        left: Surfaces of goals that could not be made.
        failure: Why the last of them; None: there is none.
    """

    key: Keyframe
    changes: Made = ()
    left: tuple[str, ...] = ()
    failure: Failure | None = None

    __repr__ = short_repr

    @property
    def stance(self) -> tuple[Contact, ...]:
        """Contacts of the keyframe."""
        return self.key.stance


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Proposal:
    """Contacts to be made one after the other.

    Attributes:
        after: What it goes on from.
        goals: In order.
        body: Where the body shall get to.
        rounds: How they are tried; in the later ones, those that are left.
        posture: What postures stay near to: on all fours, or with the weight between
            hands and feet, or as the robot stands at home.
        accept: Whether it is enough where all goals are made, or some; `never`: it is
            the beginning of another one.
    """

    after: Outcome
    goals: Sequence[Goal]
    body: Frame
    rounds: tuple[Round, ...] = FREELY
    posture: Literal["quadrupedal", "upright", "home"] = "quadrupedal"
    accept: Accept = "all"

    __repr__ = short_repr


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Climb:
    """Steps none of which may be missing; earlier ones are repaired for later ones.

    Attributes:
        after: What it goes on from.
        steps: In order, with their options.
        start: (3,) x, y, yaw of the ankles' midpoint where it stands instead, or None.
        accept: As of a `Proposal`.
    """

    after: Outcome
    steps: Sequence[tuple[Step, str]]
    start: np.ndarray | None = None
    accept: Accept = "all"

    __repr__ = short_repr


# Sent what came of each proposal; returns whether the goal has been reached.
Manoeuvre = Generator[Proposal | Climb, Outcome, bool]
Part = Generator[Proposal | Climb, Outcome, None]


def stuck(why: str) -> Failure:
    """There is nothing to go on with."""
    return Failure(status=Status.STUCK, detail=why)


def pursue(
    manoeuvre: Manoeuvre, attempt: Callable[[Proposal | Climb], Outcome]
) -> tuple[Made, Failure | None]:
    """The changes of the first proposal that is accepted.

    Without changes, why there are none; neither where the goal has been reached.
    """
    failure = stuck("no contact of the cycle moves")
    ask = partial(next, manoeuvre)
    while True:
        try:
            proposal = ask()
        except StopIteration as end:
            return (), None if end.value else failure
        tried = attempt(proposal)
        failure = tried.failure or failure
        enough = {"all": not tried.left, "some": True, "never": False}
        if tried.changes and enough[proposal.accept]:
            return tried.changes, None
        ask = partial(manoeuvre.send, tried)
