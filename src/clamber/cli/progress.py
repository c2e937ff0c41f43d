"""How far a command has come, and how long it will still take.

A command is a list of stages, each of which reports a share of itself. They are weighed
by what they cost, so that a tenth of the bar is about a tenth of the time.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator, Sequence

from rich.console import Console
from rich.progress import BarColumn, TaskProgressColumn, TextColumn
from rich.progress import Progress as Bar

from clamber.model.progress import Progress

# [s] of one core: the built-in climb of COMAN onto a box of 0.275 m, drawn by the
# processor, by `time.process_time` between the reports of each stage. What a stage
# costs on another machine, or for another robot, differs by about the same factor.
COSTS = {
    "detect": 0.2,
    "plan": 0.2,
    "trajectory": 0.1,
    "save": 0.3,
    "simulate": 2.0,
    "save run": 0.8,
    "pictures": 5.2,
    "video": 34.0,
    "draw": 2.0,
    "report": 2.0,
    "sweep": 200.0,
    "robot": 6.0,
}
EARLY = 0.1  # share before which nothing can be said of the time left
QUIET = 5.0  # [s] without a line in a log, after which one says what is being done


class Track:
    """Share done of all stages of a command, which never falls, and the time left."""

    def __init__(
        self, *stages: str, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Nothing has been done.

        Args:
            stages: In their order, of `COSTS`; of one that is left out nothing is done
                and the next begins where it would end.
            clock: [s].
        """
        costs = [COSTS[s] for s in stages]
        self.stages: Sequence[str] = stages
        self._widths = [c / sum(costs) for c in costs]
        self._clock, self._began = clock, clock()
        self._at, self._base, self._inside = 0, 0.0, 0.0
        self.share = 0.0
        self.left: float | None = None

    def update(self, stage: str, done: float) -> None:
        """Take in a report.

        A stage that begins anew, or one that is not in the list, such as the search for
        other contacts in the planning, does what is left of the stage it is in.
        """
        at = self.stages.index(stage) if stage in self.stages else self._at
        if at > self._at:
            self._at, self._base, self._inside = at, 0.0, 0.0
        elif at < self._at:
            return
        inside = self._base + (1.0 - self._base) * done
        if inside < self._inside:
            self._base = self._inside
            inside = self._base + (1.0 - self._base) * done
        self._inside = min(inside, 1.0)
        before = sum(self._widths[: self._at])
        share = before + self._widths[self._at] * self._inside
        self.share = min(max(self.share, share), 1.0)
        self._estimate()

    def finish(self) -> None:
        """All is done, whatever was left out."""
        self.share, self.left = 1.0, 0.0

    def _estimate(self) -> None:
        """The time left, which is corrected downwards alone."""
        spent = self._clock() - self._began
        if self.share >= EARLY:
            left = spent * (1.0 - self.share) / self.share
            self.left = left if self.left is None else min(self.left, left)

    def __str__(self) -> str:
        """The time left in words; empty where nothing can be said of it."""
        if self.left is None or self.share >= 1.0:
            return ""
        seconds = round(self.left)
        return f"{seconds // 60}:{seconds % 60:02d} left"


@contextlib.contextmanager
def bar(console: Console, track: Track, *, more: bool = False) -> Iterator[Progress]:
    """A bar with stage, share and the time left, for a terminal.

    `more`: The command goes on after it.
    """
    columns = (
        TextColumn("{task.description:<10}"),
        BarColumn(bar_width=24),
        TaskProgressColumn(),
        TextColumn("{task.fields[left]:>9}"),
        TextColumn("{task.fields[note]}", markup=False),
    )
    with Bar(*columns, console=console, transient=more) as bars:
        task = bars.add_task("", total=1.0, left="", note="")
        bars.update(task, completed=track.share)
        shown = [""]

        def report(stage: str, done: float, note: str) -> None:
            track.update(stage, done)
            fresh, shown[0] = stage != shown[0], stage
            bars.update(
                task,
                refresh=fresh,
                description=stage,
                completed=track.share,
                left=str(track),
                note=note,
            )

        yield report
        if not more:
            track.finish()
            bars.update(task, description="done", completed=1.0, left="", note="")


@contextlib.contextmanager
def lines(console: Console, track: Track, *, more: bool = False) -> Iterator[Progress]:
    """A line for each tenth of a command and for each stage, for logs.

    And for what has taken `QUIET` since the last one.

    `more`: The command goes on after it.
    """
    shown, doing, ended = (-1, ""), ("", ""), threading.Event()
    spoke = threading.Event()

    def say(stage: str, note: str) -> None:
        words = [w for w in (f"{100 * track.share:3.0f} % {stage}", note) if w]
        left = f" ({track})" if str(track) else ""
        text = " ".join(words) + left
        console.print(text, markup=False, highlight=False, soft_wrap=True)
        spoke.set()

    def report(stage: str, done: float, note: str) -> None:
        nonlocal shown, doing
        track.update(stage, done)
        doing, now = (stage, note), (int(10 * track.share), stage)
        if now != shown:
            shown = now
            say(stage, note)

    def remind() -> None:
        while not ended.is_set():
            if not spoke.wait(QUIET) and doing[0]:
                say(*doing)
            spoke.clear()

    reminder = threading.Thread(target=remind, daemon=True)
    reminder.start()
    try:
        yield report
    finally:
        ended.set()
        spoke.set()
        reminder.join()
    if not more:
        track.finish()
        say("done", "")
