"""One search: contact changes are tried, what promises most first, until one arrives.

What may come next is an `Entry`: how far it has come, its price, and what to try for
more. The cheapest is taken from the queue and tried, and what it leads to is put there.
What is tried, and with what result, is noted for all searches of a plan together, and
one budget bounds them.
"""

from __future__ import annotations

import heapq
import itertools
import time
from collections.abc import Iterable
from typing import Protocol, Self, TypeVar

from clamber.contact.steps import Step
from clamber.errors import Status
from clamber.planning.records import (
    Attempt,
    Budget,
    PlanOptions,
    Progress,
    silent,
)
from clamber.step.change import Change, Failure, change_contact
from clamber.step.ik import IK
from clamber.step.posture import Keyframe


class Entry(Protocol):
    """What may come next in a search."""

    @property
    def price(self) -> float:
        """The least is taken first; it may rise while the entry waits."""
        ...

    @property
    def ended(self) -> bool:
        """Nothing is left to be tried: where it is the cheapest, it is found."""
        ...

    def tried(self) -> Iterable[Self]:
        """Try what comes next; what may come after that."""
        ...


E = TypeVar("E", bound=Entry)


class Search:
    """What the searches of one plan share.

    Attributes:
        ik: Workspace.
        options: How steps are planned.
        budget: How much may be tried.
        report: Called with stage, share and note, for progress.
        attempts: All that was tried, in order.
    """

    def __init__(
        self,
        ik: IK,
        options: PlanOptions,
        budget: Budget | None = None,
        report: Progress = silent,
    ) -> None:
        """Nothing has been tried; a budget of seconds counts from now on."""
        self.ik, self.options, self.report = ik, options, report
        self.budget = budget or Budget()
        self.attempts: list[Attempt] = []
        seconds = self.budget.seconds
        self._end = None if seconds is None else time.monotonic() + seconds

    @property
    def late(self) -> bool:
        """Whether the budget of seconds is spent."""
        return self._end is not None and time.monotonic() > self._end

    def change(
        self,
        proposer: str,
        before: Keyframe,
        step: Step,
        options: PlanOptions | None = None,
    ) -> Change | Failure:
        """Try a step that a proposer wants, and note what came of it."""
        how = options or self.options
        found = change_contact(self.ik, before, step, how.keyframe, how.method)
        failure = found if isinstance(found, Failure) else None
        self.attempts.append(Attempt(proposer=proposer, step=step, failure=failure))
        return found

    def best_first(
        self, entries: Iterable[E], most: int | None = None
    ) -> tuple[E | None, Failure | None]:
        """The first entry that has ended and is the cheapest, or why there is none.

        Where the budget is spent, what would have come next.

        Args:
            entries: To begin with.
            most: Attempts; None: as many as it takes.
        """
        queue: list[tuple[float, int, E]] = []
        order, before = itertools.count(), len(self.attempts)
        for entry in entries:
            heapq.heappush(queue, (entry.price, next(order), entry))
        while queue:
            price, _, entry = heapq.heappop(queue)
            if entry.ended:
                return entry, None
            spent = most is not None and len(self.attempts) - before >= most
            if spent or self.late:
                return entry, Failure(status=Status.BUDGET)
            for x in [entry] if entry.price > price else entry.tried():
                heapq.heappush(queue, (x.price, next(order), x))
        return None, Failure(status=Status.EXHAUSTED)
