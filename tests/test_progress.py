"""Progress: shares never fall, the time left does not rise, the end is at 100 %."""

from __future__ import annotations

import io
import itertools
import json
import os
import re
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from clamber.cli import output, progress
from clamber.cli.output import INTERRUPTED
from clamber.show.page import Work
from clamber.show.track import COSTS, DRAWING, EARLY, EXECUTION, PLANNING, Track

CLIMB = ("detect", *PLANNING, *EXECUTION, *DRAWING)


class Hands:
    """A clock that is moved by hand."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def told(pace: dict[str, float], stages: Sequence[str] = CLIMB) -> list[tuple]:
    """(time, share, time left) of a command; `pace`: how much slower stages are."""
    clock = Hands()
    track = Track(*stages, clock=clock)
    out = []
    for stage in stages:
        seconds = COSTS[stage] * pace.get(stage, 1.0)
        for k in range(11):
            clock.now += seconds / 10 if k else 0.0
            track.update(stage, k / 10)
            out.append((clock.now, track.share, track.left))
    return out


@pytest.mark.parametrize("slow", [1.0, 7.0])
def test_where_stages_cost_what_is_known_a_share_of_the_time_is_that_of_the_bar(
    slow: float,
):
    seen = told(dict.fromkeys(CLIMB, slow))
    end = seen[-1][0]
    for now, share, left in seen:
        assert share == pytest.approx(now / end, abs=0.06)
        assert (left is None) == (share < EARLY)
        if left is not None:
            assert left == pytest.approx(end - now, abs=0.12 * end)


def test_a_job_that_goes_on_counts_the_time_of_what_it_does_anew():
    clock = Hands()
    track = Track("sweep", "draw", clock=clock)
    track.update("sweep", 0.5)
    assert track.left is None
    clock.now = 10.0
    track.update("sweep", 0.75)
    assert track.left == pytest.approx(10.0, rel=0.05)


@pytest.mark.parametrize("stage", CLIMB)
@pytest.mark.parametrize("factor", [0.2, 5.0])
def test_the_share_never_falls_and_the_time_left_never_rises(stage: str, factor: float):
    seen = told({stage: factor})
    shares = [s for _, s, _ in seen]
    lefts = [x for _, _, x in seen if x is not None]
    assert shares == sorted(shares)
    assert lefts == sorted(lefts, reverse=True)
    assert shares[-1] == pytest.approx(1.0)
    assert len(lefts) >= 8


def test_what_is_tried_again_goes_on_from_where_it_was():
    track = Track("plan", "save", clock=Hands())
    shares = []
    for stage, done in (
        ("plan", 0.0), ("plan", 0.8), ("plan", 0.0), ("plan", 0.5), ("search", 0.1),
        ("search", 0.9), ("plan", 0.2), ("save", 0.0), ("plan", 0.3), ("save", 1.0),
    ):  # fmt: skip
        track.update(stage, done)
        shares.append(track.share)
    assert shares == sorted(shares)
    assert shares[3] > shares[2]
    assert shares[5] > shares[4]
    assert shares[-2] < shares[-1] == 1.0


def test_what_falls_back_a_little_goes_on_from_there_without_a_jump():
    track, shares = Track("simulate", clock=Hands()), []
    for done in (0.0, 0.4, 0.8, 0.78, 0.79, 0.9, 0.88, 0.94, 1.0):
        track.update("simulate", done)
        shares.append(track.share)
    assert shares == sorted(shares)
    assert shares[3] == shares[2] == pytest.approx(0.8)
    assert shares[4] == pytest.approx(0.8 + 0.2 * 0.01 / 0.22)
    assert max(np.diff(shares)) < 0.41
    assert shares[-1] == pytest.approx(1.0)


def test_a_time_left_that_was_far_too_short_is_said_no_more():
    clock = Hands()
    track = Track("simulate", clock=clock)
    track.update("simulate", 0.0)
    said = []
    for now, done in ((1.0, 0.2), (10.0, 0.25), (20.0, 0.3), (21.0, 0.9), (22.0, 1.0)):
        clock.now = now
        track.update("simulate", done)
        said.append(str(track))
    assert said == ["0:04 left", "", "", "0:02 left", ""]


def shown_on_a_log(reports: Sequence[tuple[str, float]], *stages: str) -> list[str]:
    log = io.StringIO()
    track = Track(*stages, clock=itertools.count(0.0, 0.1).__next__)
    with progress.lines(Console(file=log, width=80), track) as report:
        for stage, done in reports:
            report(stage, done, "a note")
    return log.getvalue().splitlines()


def test_a_log_has_a_line_for_each_tenth_and_each_stage_and_ends_at_the_whole():
    reports = [("plan", k / 100) for k in range(100)]
    reports += [("save", k / 100) for k in range(60)]
    lines = shown_on_a_log(reports, "plan", "save")
    assert lines[0] == "  0 % plan a note"
    assert 8 <= len(lines) <= 13
    assert lines[-1] == "100 % done"
    assert any(re.search(r"save a note \(0:\d\d left\)$", x) for x in lines)
    shares = [int(x.split()[0]) for x in lines]
    assert shares == sorted(shares)
    assert max(np.diff(shares[:-1])) <= 11


def test_a_log_says_again_what_takes_long(monkeypatch):
    monkeypatch.setattr(progress, "QUIET", 0.2)  # long for two reports
    log, deadline = io.StringIO(), time.monotonic() + 10.0
    with progress.lines(Console(file=log, width=80), progress.Track("plan")) as report:
        report("plan", 0.01, "a step")
        report("plan", 0.02, "another step")
        while log.getvalue().count("another step") < 2:
            assert time.monotonic() < deadline
            time.sleep(0.01)
    lines = log.getvalue().splitlines()
    assert lines[0] == "  1 % plan a step"
    assert set(lines[1:-1]) == {"  2 % plan another step"}
    assert lines[-1] == "100 % done"


def test_a_terminal_shows_stage_share_and_time_left():
    screen = io.StringIO()
    console = Console(file=screen, width=100, force_terminal=True)
    track = Track("plan", "save", clock=itertools.count().__next__)
    with progress.bar(console, track) as report:
        report("plan", 0.2, "[LHand]")
        report("plan", 0.5, "RHand")
        report("save", 0.5, "")
    for word in ("plan", "save", "[LHand]", "100%", "left", "done"):
        assert word in screen.getvalue()


def test_a_bar_that_goes_on_later_is_not_said_to_be_done():
    log = io.StringIO()
    console = Console(file=log, width=80)
    track = Track("plan", "pictures", clock=Hands())
    with progress.lines(console, track, more=True) as report:
        report("plan", 1.0, "")
    assert "100 %" not in log.getvalue()
    with progress.lines(console, track) as report:
        report("pictures", 0.5, "")
    assert log.getvalue().splitlines()[-1] == "100 % done"


class Panel:
    """What `Work` asks of a page's panel."""

    def __init__(self) -> None:
        self.shares: list[float] = []
        self.texts: list[str] = []

    def add_progress_bar(self, value: float, visible: bool) -> Any:
        return _Told(self.shares, value=value, visible=visible)

    def add_html(self, content: str) -> Any:
        return _Told(self.texts, content=content)


class _Told:
    def __init__(self, told: list[Any], **fields: Any) -> None:
        vars(self).update(fields, told=told)

    def __setattr__(self, name: str, value: Any) -> None:
        vars(self)[name] = value
        if name != "visible":
            self.told.append(value)


def test_the_bar_of_a_page_is_of_all_stages_and_never_falls():
    panel, stages = Panel(), ("detect", *PLANNING, *EXECUTION)
    work = Work(panel)

    def job() -> str:
        for stage in stages:
            for k in range(5):
                work.report(stage, k / 4, "a note")
        return "made"

    assert work.do(job, *stages) == "made"
    shares = panel.shares
    assert shares == sorted(shares)
    assert shares[0] == 0.0
    assert shares[-1] == pytest.approx(100.0)
    whole = sum(COSTS[s] for s in stages)
    detected = 100 * COSTS["detect"] / whole
    assert any(x == pytest.approx(detected) for x in shares)
    assert max(np.diff(shares)) <= 100 * COSTS["simulate"] / whole / 4 + 1e-9
    assert any("simulate: a note" in x and "left)" in x for x in panel.texts)
    assert "made" in panel.texts[-1]


# A whole climb.


def climb(folder: Path, *more: str) -> subprocess.Popen[str]:
    """A climb in a process of its own, in which Ctrl-C is not ignored."""
    code = (
        "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler);"
        "from clamber.cli import main; sys.exit(main(sys.argv[1:]))"
    )
    return subprocess.Popen(
        [sys.executable, "-u", "-c", code, "climb", "--out", str(folder), *more],
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        start_new_session=True,
    )


def check_whole(folder: Path) -> None:
    """Every file of a folder can be read; there is none that was being written."""
    for path in folder.iterdir():
        assert not path.name.startswith("."), path
        if path.suffix == ".json":
            assert json.loads(path.read_text()), path
        elif path.suffix == ".npz":
            with np.load(path) as arrays:
                assert all(arrays[name] is not None for name in arrays)
        elif path.suffix == ".png":
            with Image.open(path) as picture:
                picture.load()
        elif path.suffix == ".xml":
            assert path.read_text().rstrip().endswith("</mujoco>")
        else:
            assert path.suffix == ".mp4", path


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["detect", "save", "simulate", "pictures", "video"])
def test_ctrl_c_leaves_whole_files_and_says_which(stage: str, tmp_path: Path):
    folder = tmp_path / "run"
    said = ""
    with climb(folder, "--video") as job:
        assert job.stderr is not None
        for line in job.stderr:
            said = line
            if re.match(rf" *\d+ % {stage}\b", line):
                time.sleep(0.1)
                os.killpg(job.pid, signal.SIGINT)  # as a terminal does: to all of them
                break
        rest = job.stderr.read()
        assert job.wait() == INTERRUPTED, said + rest
    assert "Traceback" not in rest
    last = rest.splitlines()[-1]
    assert last.startswith("clamber: interrupted")
    if stage == "detect":
        assert not folder.exists()
        return
    check_whole(folder)
    for path in folder.iterdir():
        assert path.name in last
    assert "sequence.json" in last
    assert ("rollout.npz" in last) == (stage in ("pictures", "video"))


PRESSED = """
import importlib.abc, os, signal, sys

class Pressed(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name == module:
            os.kill(os.getpid(), signal.SIGINT)

module, *sys.argv = sys.argv[1:]
signal.signal(signal.SIGINT, signal.default_int_handler)
sys.meta_path.insert(0, Pressed())
from clamber.__main__ import main
sys.exit(main())
"""


@pytest.mark.parametrize("module", ["tyro", "clamber.cli.flags", "mujoco"])
def test_ctrl_c_while_it_is_loaded_is_one_sentence(module: str):
    job = subprocess.run(
        [sys.executable, "-c", PRESSED, module, "clamber", "climb"],
        capture_output=True,
        text=True,
    )
    assert job.returncode == INTERRUPTED, job.stderr
    assert job.stderr.startswith("clamber: interrupted")
    assert len(job.stderr.splitlines()) == 1, job.stderr


def test_that_is_the_program_which_is_installed():
    project = Path(__file__).parents[1] / "pyproject.toml"
    scripts = tomllib.loads(project.read_text())["project"]["scripts"]
    assert scripts == {"clamber": "clamber.__main__:main"}


def test_an_interrupt_names_what_a_folder_holds(tmp_path: Path):
    (tmp_path / "b.json").write_text("{}")
    (tmp_path / "a.npz").write_text("")
    with pytest.raises(output.Interrupted) as e, output.filling(tmp_path):
        raise KeyboardInterrupt
    assert str(e.value) == f"interrupted; in {tmp_path} are, whole: a.npz, b.json"
    assert "nothing was written" in str(output.Interrupted(tmp_path / "none"))
