"""Tables and pictures of a sweep say what its rows say."""

from __future__ import annotations

import csv
import itertools
import math
import runpy
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

from clamber.study.climb import ClimbResult
from clamber.study.curves import (
    BIN_RUNS,
    MAX_BINS,
    bins,
    draw_success,
    save_curves,
    summarise,
)
from clamber.study.spec import Run, Spec, load_spec, next_runs, strands
from clamber.study.statistics import wilson
from clamber.study.sweep import CRASHED, Rows, cells, columns
from conftest import ROOT

EXPERIMENTS = ROOT / "examples" / "experiments"


def swept(content: dict, reached: Callable[[Run], bool]) -> tuple[Spec, Rows]:
    """A spec with rows that ended as `reached` says."""
    spec = Spec.model_validate({"base": {"height": 0.275}, **content})
    rows: Rows = []
    for strand in strands(spec):
        known: list[Run] = []
        done: dict[str, ClimbResult] = {}
        while len(done) < strand.runs:
            known += next_runs(spec, strand, known, done)
            for run in known[len(done) :]:
                done[run.name] = ClimbResult(reached=reached(run))
        rows += [(run, done[run.name]) for run in known]
    return spec, rows


def friction(**more: object) -> dict:
    fields = {"factor": "disturb.friction", "from": 1.0, "to": 0.2, "runs": 40}
    return {"search": {**fields, **more}}


def test_a_summary_counts_runs_and_says_where_success_breaks():
    limit = {"pid": 0.61, "mixed": 0.37}
    spec, rows = swept(
        friction(),
        lambda run: run.factors["disturb.friction"] > limit[run.job.controller],
    )
    for s in summarise(spec, rows):
        mine = [o.reached for r, o in rows if r.job.controller == s.controller]
        assert (s.runs, s.reached) == (40, sum(mine))
        assert s.share == sum(mine) / 40
        assert (s.low, s.high) == wilson(sum(mine), 40)
        assert s.half == pytest.approx(limit[s.controller], abs=0.01)
        assert s.half_from is not None
        assert s.half_to is not None
        # From the easy side to the hard one, which is downwards here.
        assert s.half_from > limit[s.controller] > s.half_to
        assert s.half_from - s.half_to < 0.05
        assert (s.start, s.end, s.errors) == (1.0, 0.2, 0)


def test_a_factor_that_never_breaks_is_said_to_break_beyond_its_range():
    spec, rows = swept(friction(), lambda run: run.job.controller == "mixed")
    pid, mixed = summarise(spec, rows)
    assert (pid.half, pid.half_from, pid.half_to) == ("before 1", None, None)
    assert (mixed.half, mixed.half_from, mixed.half_to) == ("beyond 0.2", None, None)
    assert mixed.low == pytest.approx(wilson(40, 40)[0])


def test_a_signed_factor_breaks_on_each_side_by_itself():
    content = {
        "search": {
            "factor": "disturb.height",
            "from": 0.0,
            "to": [-0.1, 0.1],
            "runs": 40,
        },
        "controllers": ["mixed"],
    }
    spec, rows = swept(
        content, lambda run: -0.07 < run.factors["disturb.height"] < 0.03
    )
    down, up = summarise(spec, rows)
    assert down.half == pytest.approx(-0.07, abs=0.002)
    assert up.half == pytest.approx(0.03, abs=0.002)
    assert (down.end, up.end) == (-0.1, 0.1)


def test_the_half_point_of_a_log_scale_is_a_value_of_the_factor():
    content = {
        "search": {
            "factor": "speed",
            "from": 0.05,
            "to": 3.0,
            "scale": "log",
            "runs": 40,
        },
        "controllers": ["pid"],
    }
    spec, rows = swept(content, lambda run: run.factors["speed"] < 1.0)
    assert summarise(spec, rows)[0].half == pytest.approx(1.0, rel=0.05)


def test_crashed_runs_are_counted_apart():
    spec, rows = swept(friction(runs=8), lambda run: True)
    run, _ = rows[3]
    rows[3] = (run, ClimbResult(reached=False, why=f"{CRASHED}ValueError: x"))
    assert [s.errors for s in summarise(spec, rows)] == [1, 0]
    assert [s.reached for s in summarise(spec, rows)] == [7, 8]


def test_bins_of_many_values_hold_neighbours_in_equal_numbers():
    spec, rows = swept(friction(), lambda run: run.factors["disturb.friction"] > 0.5)
    mine = [b for b in bins(spec, rows) if b.controller == "pid"]
    values = sorted(
        r.factors["disturb.friction"] for r, _ in rows if r.job.controller == "pid"
    )
    assert sum(b.runs for b in mine) == 40
    assert len(mine) == min(MAX_BINS, 40 // BIN_RUNS)
    assert max(b.runs for b in mine) - min(b.runs for b in mine) <= 1
    assert mine[0].first == values[0]
    assert mine[-1].last == values[-1]
    for a, b in itertools.pairwise(mine):
        assert a.last <= b.first
    for b in mine:
        inside = [v for v in values if b.first <= v <= b.last]
        assert b.reached == sum(v > 0.5 for v in inside)
        assert b.middle == pytest.approx(np.mean(inside))
        assert (b.low, b.high) == wilson(b.reached, b.runs)


def test_few_values_are_a_bin_each_and_words_always():
    spec, rows = swept(
        {
            "grid": {
                "robot": ["coman", "coman29"],
                "disturb.mass": [0.9, 1.0, 1.1],
            },
            "controllers": ["pid"],
        },
        lambda run: run.factors["disturb.mass"] < 1.05 and run.job.robot == "coman",
    )
    found = {(b.factor, b.middle): (b.runs, b.reached) for b in bins(spec, rows)}
    assert found == {
        ("robot", "coman"): (3, 2),
        ("robot", "coman29"): (3, 0),
        ("disturb.mass", 0.9): (2, 1),
        ("disturb.mass", 1.0): (2, 1),
        ("disturb.mass", 1.1): (2, 0),
    }


def test_runs_that_do_not_set_a_factor_are_in_none_of_its_bins():
    spec, rows = swept(
        {
            "random": {
                "runs": 60,
                "factors": {"disturb.mass": 1.1},
                "either": [
                    {"disturb.unevenness": 0.03},
                    {"disturb.height": {"plus_minus": 0.03}},
                ],
            },
            "controllers": ["pid"],
        },
        lambda run: run.job.disturb.unevenness > 0,
    )
    (mass,) = [b for b in bins(spec, rows) if b.factor == "disturb.mass"]
    assert (mass.first, mass.middle, mass.last, mass.runs) == (1.1, 1.1, 1.1, 60)
    uneven = [b for b in bins(spec, rows) if b.factor == "disturb.unevenness"]
    high = [b for b in bins(spec, rows) if b.factor == "disturb.height"]
    assert sum(b.runs for b in uneven) + sum(b.runs for b in high) == 60
    assert {b.middle for b in uneven} == {0.03}  # to the last bit
    assert {b.share for b in uneven} == {1.0}
    assert {b.share for b in high} == {0.0}


@pytest.mark.whole
def test_tables_and_picture_are_written_alike_each_time(tmp_path: Path):
    spec, rows = swept(friction(), lambda run: run.factors["disturb.friction"] > 0.5)
    files = save_curves(spec, rows, tmp_path)
    assert [f.name for f in files] == ["summary.csv", "curve.csv", "success.png"]
    with (tmp_path / "summary.csv").open() as f:
        table = list(csv.DictReader(f))
    assert [r["controller"] for r in table] == ["pid", "mixed"]
    assert float(table[0]["half"]) == pytest.approx(0.5, abs=0.02)
    before = [f.read_bytes() for f in files]
    save_curves(spec, rows, tmp_path)
    assert [f.read_bytes() for f in files] == before


@pytest.mark.parametrize(
    "content",
    [
        friction(runs=8),
        {"random": {"runs": 9, "factors": {f"disturb.{k}": 0.1 for k in ("x", "y")}}},
        {"grid": {"robot": ["coman", "coman29"]}},
        {
            "search": {
                "factor": "speed",
                "from": 0.1,
                "to": 1.0,
                "runs": 8,
                "scale": "log",
            }
        },
    ],
)
def test_every_kind_of_sweep_is_drawn_in_the_colours_of_its_controllers(
    content: dict, tmp_path: Path
):
    spec, rows = swept(content, lambda run: run.job.disturb.seed % 2 == 0)
    image = np.asarray(Image.open(draw_success(spec, rows, tmp_path / "a.png")), float)
    for colour in ((0xB9, 0x1C, 0x1C), (0x1D, 0x4E, 0xD8)):
        off = np.linalg.norm(image[..., :3] - colour, axis=-1)
        assert np.count_nonzero(off < 20.0) > 20


@pytest.mark.whole
def test_the_picture_shows_the_level_at_which_success_breaks(tmp_path: Path):
    """The curve's descent lies where the axes say, as seen in its pixels."""

    def column(limit: float) -> float:
        content = {**friction(), "controllers": ["pid"]}
        spec, rows = swept(content, lambda r: r.factors["disturb.friction"] > limit)
        path = draw_success(spec, rows, tmp_path / f"{limit}.png")
        image = np.asarray(Image.open(path), float)[..., :3]
        red = np.linalg.norm(image - (0xB9, 0x1C, 0x1C), axis=-1) < 20.0
        middle = red[int(0.45 * len(red)) : int(0.55 * len(red))]
        return float(np.flatnonzero(middle.any(axis=0)).mean()) / image.shape[1]

    assert column(0.4) < column(0.6) < column(0.8)
    step = column(0.6) - column(0.4)
    assert column(0.8) - column(0.6) == pytest.approx(step, abs=0.03)
    assert not math.isnan(step)


@pytest.mark.whole
def test_the_page_of_experiments_tells_what_has_been_run(tmp_path: Path):
    """Two of the experiments, one of them not done yet, with quick jobs."""
    runs, docs = tmp_path / "runs", tmp_path / "docs"
    for name, limit in (("friction", 0.5), ("all-at-once", 0.0)):
        spec = load_spec(EXPERIMENTS / f"{name}.yaml")
        _, rows = swept(
            spec.model_dump(by_alias=True, exclude_unset=True),
            lambda run, limit=limit: run.factors["disturb.friction"] > limit,
        )
        folder = runs / name
        folder.mkdir(parents=True)
        text = yaml.safe_dump(spec.model_dump(by_alias=True, exclude_unset=True))
        (folder / "spec.yaml").write_text(text)
        kept = rows if name == "friction" else rows[:-100]
        with (folder / "runs.csv").open("w", newline="") as f:
            writer = csv.writer(f, lineterminator="\n")
            writer.writerow(columns(spec))
            writer.writerows(cells(spec, *row) for row in kept)
    script = EXPERIMENTS / "page.py"
    subprocess.run([sys.executable, script, runs, docs], check=True)
    text = (docs / "experiments.md").read_text()
    assert text.index("## Friction of ground and box") < text.index("## All at once")
    assert "clamber sweep examples/experiments/friction.yaml" in text
    (pid,) = [
        x for x in text.splitlines() if x.startswith("| friction | pid | 1 | 0.15 |")
    ]
    assert float(pid.split("|")[6]) == pytest.approx(0.5, abs=0.02)
    assert "So far 200 of 300 runs." in text
    assert "| all-at-once | mixed | 200 | 200 | 100.0 % | 98.1 to 100.0 % |" in text
    pictures = {f.name for f in (docs / "experiments").iterdir()}
    names = {"friction", "all-at-once"}
    assert pictures == {f"{n}.{kind}" for n in names for kind in ("png", "csv")}
    kept = (docs / "experiments" / "friction.csv").read_text()
    assert kept == (runs / "friction" / "runs.csv").read_text()


def test_every_experiment_has_its_place_on_the_page():
    order = runpy.run_path(str(EXPERIMENTS / "page.py"))["ORDER"]
    assert sorted(order) == sorted(f.stem for f in EXPERIMENTS.glob("*.yaml"))
