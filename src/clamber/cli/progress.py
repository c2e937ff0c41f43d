"""Progress of a command on the terminal: a bar, or lines for a log."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator

from rich.console import Console
from rich.progress import BarColumn, TaskProgressColumn, TextColumn
from rich.progress import Progress as Bar

from clamber.model.progress import Progress
from clamber.show.track import Track

QUIET = 3.0  # [s] without a line in a log, after which one says what is being done


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
        task = bars.add_task("", total=1.0, visible=False, left="", note="")
        bars.update(task, completed=track.share, visible=True)
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
