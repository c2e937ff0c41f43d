"""Share of a job that is done, and its remaining time.

A job is a list of stages, each of which reports a share of itself. They are weighed by
what they cost, so that a tenth of the bar is about a tenth of the time.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

# [s] of two cores: the built-in climb of COMAN onto a box of 0.275 m, drawn by the
# processor, as its timings.json says. What a stage costs on another machine, or for
# another robot, differs by about the same factor.
COSTS = {
    "detect": 0.2,
    "plan": 0.1,
    "trajectory": 0.1,
    "save": 0.2,
    "simulate": 1.0,
    "save run": 0.2,
    "pictures": 5.0,
    "video": 14.5,
    "draw": 2.0,
    "report": 2.0,
    "sweep": 200.0,
    "robot": 6.0,
}
PLANNING, EXECUTION = ("plan", "trajectory", "save"), ("simulate", "save run")
DRAWING = ("pictures", "video")
MISJUDGED = 1.5  # so many times what was said of the time left is no longer said
EARLY = 0.1  # share before which nothing can be said of the time left


class Track:
    """Share done of all stages of a job, which never falls, and the time left."""

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
        self._at, self._inside, self._done = 0, 0.0, 0.0
        self._base, self._from = 0.0, 0.0
        self.share = 0.0
        self._first: float | None = None  # of a job that goes on where it was stopped
        self.left: float | None = None
        self._believed = False

    def update(self, stage: str, done: float) -> None:
        """Take in a report.

        A stage that falls back or begins anew, or one that is not in the list, such as
        the search for other contacts in the planning, does what is left of the stage.
        """
        at = self.stages.index(stage) if stage in self.stages else self._at
        if at > self._at:
            self._at, self._inside, self._done = at, 0.0, 0.0
            self._base, self._from = 0.0, 0.0
        elif at < self._at:
            return
        if done < self._done:
            self._base, self._from = self._inside, done
        self._done = done
        if done > self._from:
            within = min((done - self._from) / (1.0 - self._from), 1.0)
            self._inside = self._base + (1.0 - self._base) * within
        before = sum(self._widths[: self._at])
        share = before + self._widths[self._at] * self._inside
        self.share = min(max(self.share, share), 1.0)
        self._estimate()

    def finish(self) -> None:
        """All is done, whatever was left out."""
        self.share, self.left = 1.0, 0.0

    def _estimate(self) -> None:
        """The time left, corrected downwards alone; not believed when far too short."""
        spent = self._clock() - self._began
        self._first = self.share if self._first is None else self._first
        done = self.share - self._first
        if done >= EARLY:
            left = spent * (1.0 - self.share) / done
            self.left = left if self.left is None else min(self.left, left)
            self._believed = left < MISJUDGED * self.left + 1.0

    def __str__(self) -> str:
        """The time left in words; empty where nothing can be said of it."""
        if self.left is None or not self._believed or self.share >= 1.0:
            return ""
        seconds = round(self.left)
        return f"{seconds // 60}:{seconds % 60:02d} left"
