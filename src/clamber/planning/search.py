"""One search: contact changes are tried, what promises most first, until one arrives.

What may come next is an `Entry`: how far it has come, its price, and what to try for
more. The cheapest is taken from the queue and tried, and what it leads to is put there.
What is tried, and with what result, is noted for all searches of a plan together, and
one budget bounds them.

Where one step has failed, what is next in the queue is tried by other threads
meanwhile: the core leaves the interpreter alone while it solves. What is found, and in
which order it is noted, does not depend on them.
"""

from __future__ import annotations

import functools
import heapq
import itertools
import os
import time
from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from queue import Empty, SimpleQueue
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

# A keyframe, a step to try from it, and how.
Want = tuple[Keyframe, Step, PlanOptions]


def threads() -> int:
    """How many try steps at a time: as many as there are cores.

    Fewer where the environment's OMP_NUM_THREADS says so, as it does for processes
    that work side by side.
    """
    all_ours = getattr(os, "sched_getaffinity", None)  # not on every system
    cores = len(all_ours(0)) if all_ours else os.cpu_count() or 1
    told = os.environ.get("OMP_NUM_THREADS", "")
    return max(1, min(cores, int(told))) if told.isdecimal() else cores


@functools.cache
def _pool(workers: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(workers, thread_name_prefix="clamber")


# A forked process has a copy of the pool and none of its threads: it would wait.
os.register_at_fork(after_in_child=_pool.cache_clear)


class Entry(Protocol):
    """What may come next in a search."""

    @property
    def wants(self) -> Want | None:
        """The step that is tried first, where that is known."""
        ...

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
        self._others = threads() - 1
        self._ahead: dict[tuple[int, int, int], tuple[Want, Future]] = {}
        self._spare: SimpleQueue[IK] = SimpleQueue()
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
        want = before, step, options or self.options
        _, ahead = self._ahead.pop(_name(want), (want, None))
        found = _tried(self.ik, want) if ahead is None else ahead.result()
        failure = found if isinstance(found, Failure) else None
        self.attempts.append(Attempt(proposer=proposer, step=step, failure=failure))
        return found

    def _look_ahead(self, entries: Iterable[Entry]) -> None:
        """Have other threads try what these want first."""
        for entry in entries:
            busy = sum(not f.done() for _, f in self._ahead.values())
            want = entry.wants
            if (
                want is not None
                and busy < self._others
                and _name(want) not in self._ahead
            ):
                future = _pool(self._others).submit(self._aside, want)
                self._ahead[_name(want)] = want, future

    def _aside(self, want: Want) -> Change | Failure:
        """Try a step in another workspace."""
        try:
            ik = self._spare.get_nowait()
        except Empty:
            ik = IK(self.ik.world, self.ik.extra)
        try:
            return _tried(ik, want)
        finally:
            self._spare.put(ik)

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
            tried = self.attempts[before:]
            if self.late or (most is not None and len(tried) >= most):
                return entry, Failure(status=Status.BUDGET)
            if self._others and any(a.failure for a in tried):
                ahead = heapq.nsmallest(self._others, queue)
                self._look_ahead(x for _, _, x in ahead)
            for x in [entry] if entry.price > price else entry.tried():
                heapq.heappush(queue, (x.price, next(order), x))
        return None, Failure(status=Status.EXHAUSTED)


def _name(want: Want) -> tuple[int, int, int]:
    """The same for the same objects, which whoever asks keeps."""
    before, step, options = want
    return id(before), id(step), id(options)


def _tried(ik: IK, want: Want) -> Change | Failure:
    before, step, options = want
    return change_contact(ik, before, step, options.keyframe, options.method)
