"""One search: contact changes are tried, what promises most first, until one arrives.

What may come next is an `Entry`: its price, and how to find out what comes after it.
The cheapest is taken from the queue, and what it leads to is put there. What is tried,
and with what result, is noted for all searches of a plan together, and one budget
bounds them.

Where one step has failed, what is next in the queue is looked at by other threads
meanwhile, each in a workspace of its own: the core leaves the interpreter alone while
it solves. So are jobs that do not need one another (`Search.each`). What is found, and
in which order it is noted, does not depend on them.
"""

from __future__ import annotations

import copy
import functools
import heapq
import itertools
import math
import os
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from queue import Empty, SimpleQueue
from typing import Any, Protocol, Self, TypeVar

from clamber.contact.steps import Step
from clamber.errors import Status
from clamber.model.progress import Progress, silent
from clamber.planning.records import (
    Attempt,
    Budget,
    PlanOptions,
)
from clamber.step.change import Change, Failure, change_contact
from clamber.step.ik import IK
from clamber.step.posture import Keyframe

QUEUED = 2  # entries at most that wait for a thread, for each
SILENCE = 1.0  # [s] after which it is said what another thread is trying


def threads() -> int:
    """Number of threads that try steps: one a core.

    Fewer where the environment's OMP_NUM_THREADS says so, as it does for processes
    that work side by side.
    """
    all_ours = getattr(os, "sched_getaffinity", None)  # not on every system
    cores = len(all_ours(0)) if all_ours else os.cpu_count() or 1
    told = os.environ.get("OMP_NUM_THREADS", "")
    return max(1, min(cores, int(told))) if told.isdecimal() else cores


@functools.cache
def _pool(workers: int, of: str) -> ThreadPoolExecutor:
    """Threads; what waits for others of a pool must be in another one."""
    return ThreadPoolExecutor(workers, thread_name_prefix=f"clamber-{of}")


# A forked process has a copy of the pools and none of their threads: it would wait.
os.register_at_fork(after_in_child=_pool.cache_clear)


F = TypeVar("F")


class Entry(Protocol[F]):
    """A candidate of a search, which yields its successors."""

    @property
    def price(self) -> float:
        """The least is taken first; it may rise while the entry waits."""
        ...

    @property
    def ended(self) -> bool:
        """Nothing is left to be tried: where it is the cheapest, it is found."""
        ...

    @property
    def idle(self) -> bool:
        """Nothing is to be tried any more: it leads nowhere."""
        ...

    def look(self, search: Search) -> F:
        """Try what comes next in a search; others are asked before this, or after."""
        ...

    def after(self, found: F) -> Iterable[Self]:
        """Successors of this candidate, given its result, in order."""
        ...


E = TypeVar("E", bound=Entry[Any])
T = TypeVar("T")


class Search:
    """State shared by the searches of one plan.

    Attributes:
        ik: Workspace.
        options: How steps are planned.
        budget: How much may be tried.
        attempts: All that was tried, in order.
        part: What it is doing, of all that may be tried: said before each note.
    """

    def __init__(
        self,
        ik: IK,
        options: PlanOptions,
        budget: Budget | None = None,
        report: Progress = silent,
    ) -> None:
        """Nothing has been tried; a budget of seconds counts from now on."""
        self.ik, self.options = ik, options
        self.budget = budget or Budget()
        self.attempts: list[Attempt] = []
        self.part, self._report, self._at = "", report, ("plan", 0.0)
        self._threads = threads()
        self._spare: SimpleQueue[IK] = SimpleQueue()
        seconds = self.budget.seconds
        self._end = None if seconds is None else time.monotonic() + seconds

    @property
    def left(self) -> float | None:
        """Remaining budget [s]; None without a bound."""
        return None if self._end is None else max(self._end - time.monotonic(), 0.0)

    @property
    def late(self) -> bool:
        """Whether the budget of seconds is spent."""
        return self.left == 0.0

    def report(self, stage: str, share: float, note: str) -> None:
        """Say what is being tried."""
        self._at = stage, share
        self._report(stage, share, f"{self.part}: {note}" if self.part else note)

    def note(self, text: str) -> None:
        """Say what is being tried, in the stage that is reported already."""
        self.report(*self._at, text)

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

    def each(self, jobs: Sequence[Callable[[Search], T]]) -> list[T]:
        """Results of independent jobs, run in parallel.

        What they try is noted as if one had come after the other.
        """
        if self._threads == 1 or len(jobs) < 2:
            return [job(self) for job in jobs]
        share = max(1, self._threads // len(jobs))
        asides = [_Aside(self, job, share) for job in jobs]
        for aside in asides[1:]:
            aside.begin("jobs")
        return [aside.result(asides) for aside in asides]

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
        order, before, failed = itertools.count(), len(self.attempts), False
        ahead: dict[int, _Aside] = {}  # by identity of the entry, which they keep
        for entry in entries:
            heapq.heappush(queue, (entry.price, next(order), entry))
        try:
            while queue:
                price, _, entry = heapq.heappop(queue)
                if entry.ended:
                    return entry, None
                tried = len(self.attempts)
                if self.late or (most is not None and tried - before >= most):
                    return entry, Failure(status=Status.BUDGET)
                if entry.price > price:
                    heapq.heappush(queue, (entry.price, next(order), entry))
                    continue
                if entry.idle:
                    continue
                if failed:
                    self._look_ahead(ahead, queue)
                aside = ahead.pop(id(entry), None)
                found = aside.result(ahead.values()) if aside else entry.look(self)
                failed = failed or any(a.failure for a in self.attempts[tried:])
                for x in entry.after(found):
                    heapq.heappush(queue, (x.price, next(order), x))
        finally:
            for aside in ahead.values():
                aside.stop()
        return None, Failure(status=Status.EXHAUSTED)

    def _look_ahead(
        self, ahead: dict[int, _Aside], queue: list[tuple[float, int, E]]
    ) -> None:
        """Have other threads look at the entries that are next."""
        others = self._threads - 1
        room = QUEUED * others - sum(not a.done for a in ahead.values())
        next_ones = heapq.nsmallest(room + len(ahead), queue) if room > 0 else []
        for _, _, entry in next_ones:
            if room > 0 and id(entry) not in ahead and not (entry.ended or entry.idle):
                ahead[id(entry)] = aside = _Aside(self, entry.look, 1)
                aside.begin("entries")
                room -= 1


class _Aside:
    """A job in another thread, in a search of its own, and what it tries there."""

    def __init__(
        self, search: Search, job: Callable[[Search], Any], workers: int
    ) -> None:
        """Do nothing yet.

        Args:
            search: Whose budget it has, and where what it tries is noted in the end.
            job: What is to be done.
            workers: Threads that it may use itself.
        """
        self._search, self._job = search, job
        self._own = copy.copy(search)
        self._own.attempts, self._own._report = [], self._hear
        self._own._threads = workers
        self._future: Future | None = None
        self._heard: tuple[str, float, str] | None = None

    def _hear(self, *said: Any) -> None:
        """Keep what it says until somebody waits for it."""
        self._heard = said

    def begin(self, of: str) -> None:
        """Wait for a thread of a pool."""
        self._future = _pool(threads() - 1, of).submit(self._run)

    @property
    def done(self) -> bool:
        """Whether nothing is left to be done for it."""
        return self._future is not None and self._future.done()

    def stop(self) -> None:
        """Nobody waits for it any more."""
        self._own._end = -math.inf
        if self._future is not None:
            self._future.cancel()

    def result(self, others: Iterable[_Aside]) -> Any:
        """Its result; if no thread has begun it, this one computes it at once.

        Args:
            others: Of which one that waits is done while this one is not ready.
        """
        if self._future is None or self._future.cancel():
            return self._job(self._search)
        while not self._future.done():
            helped = next((x for x in others if x._take()), None)
            if helped is None:
                break
            helped._own._report = self._search._report
            helped._future = Future()
            helped._future.set_result(helped._run())
        while not wait([self._future], SILENCE).done:
            if self._heard is not None:
                self._search._report(*self._heard)
        found = self._future.result()
        self._search.attempts.extend(self._own.attempts)
        return found

    def _take(self) -> bool:
        """Whether it was waiting for a thread, and is no more."""
        future = self._future
        return future is not None and not future.done() and future.cancel()

    def _run(self) -> Any:
        own = self._own
        try:
            own.ik = own._spare.get_nowait()
        except Empty:
            own.ik = IK(own.ik.world, own.ik.extra)
        try:
            return self._job(own)
        finally:
            own._spare.put(own.ik)
