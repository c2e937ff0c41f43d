"""Specs: what a person writes, and the runs that follow from it."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from clamber.errors import InputError
from clamber.study.climb import ClimbResult
from clamber.study.spec import (
    COARSE,
    LAG,
    MIN_ZONE,
    ROUND,
    Run,
    Spec,
    load_spec,
    next_runs,
    strands,
    zone_of_change,
)
from conftest import ROOT

EXPERIMENTS = sorted((ROOT / "examples" / "experiments").glob("*.yaml"))


def spec_of(**content: object) -> Spec:
    return Spec.model_validate({"base": {"height": 0.275}, **content})


def all_runs(spec: Spec, reached: Callable[[Run], bool]) -> list[Run]:
    """Every run of a spec, chosen as outcomes become known, one after another."""
    out: list[Run] = []
    for strand in strands(spec):
        known: list[Run] = []
        done: dict[str, ClimbResult] = {}
        while len(done) < strand.runs:
            known += next_runs(spec, strand, known, done)
            run = known[len(done)]
            done[run.name] = ClimbResult(reached=reached(run))
        assert next_runs(spec, strand, known, done) == []
        out += known
    return out


def test_a_grid_is_every_combination_for_every_controller():
    spec = spec_of(
        grid={
            "disturb.friction": [0.4, 0.8],
            "disturb.mass": {"from": 0.9, "to": 1.1, "steps": 3},
        }
    )
    runs = all_runs(spec, lambda run: True)
    assert [run.factors for run in runs[:6]] == [
        {"disturb.friction": f, "disturb.mass": m}
        for f in (0.4, 0.8)
        for m in (0.9, 1.0, 1.1)
    ]
    assert len(runs) == 12
    assert [run.job.controller for run in runs] == ["pid"] * 6 + ["mixed"] * 6
    for run in runs:
        assert run.job.disturb.friction == run.factors["disturb.friction"]
        assert run.job.disturb.mass == run.factors["disturb.mass"]
        assert run.job.height == 0.275


def test_every_run_has_its_own_seed_and_both_controllers_the_same():
    spec = spec_of(seed=100, random={"runs": 5, "factors": {"disturb.push": 50}})
    runs = all_runs(spec, lambda run: True)
    assert [run.job.disturb.seed for run in runs] == [*range(100, 105)] * 2
    seeds = spec_of(grid={"disturb.seed": [7, 8]}, controllers=["pid"])
    assert [run.job.disturb.seed for run in all_runs(seeds, lambda r: True)] == [7, 8]


def test_random_values_have_their_distributions():
    spec = spec_of(
        controllers=["mixed"],
        random={
            "runs": 400,
            "factors": {
                "disturb.friction": {"uniform": [0.5, 1.0]},
                "disturb.yaw": {"plus_minus": "5 deg"},
                "disturb.mass": {"plus_minus": 0.1, "about": 1.0},
                "disturb.delay": [0.0, 0.01],
            },
            "either": [
                {"disturb.unevenness": 0.03},
                {"disturb.height": {"plus_minus": 0.03}},
            ],
        },
    )
    runs = all_runs(spec, lambda run: True)

    def values(name: str) -> np.ndarray:
        return np.array([r.factors[name] for r in runs if name in r.factors])

    for name, lo, hi in (
        ("disturb.friction", 0.5, 1.0),
        ("disturb.yaw", -math.radians(5), math.radians(5)),
        ("disturb.mass", 0.9, 1.1),
        ("disturb.height", -0.03, 0.03),
    ):
        x = (values(name) - lo) / (hi - lo)
        assert x.min() >= 0
        assert x.max() <= 1
        assert x.mean() == pytest.approx(0.5, abs=4 / math.sqrt(12 * len(x)))
        assert np.sqrt(x.var()) == pytest.approx(math.sqrt(1 / 12), rel=0.15)
    assert set(values("disturb.delay")) == {0.0, 0.01}
    uneven = [r for r in runs if r.job.disturb.unevenness > 0]
    high = [r for r in runs if r.job.disturb.height != 0]
    assert len(uneven) + len(high) == 400
    assert not {r.name for r in uneven} & {r.name for r in high}
    assert 140 < len(uneven) < 260
    friction, mass = values("disturb.friction"), values("disturb.mass")
    assert abs(np.corrcoef(friction, mass)[0, 1]) < 0.2


def test_more_runs_of_a_random_sample_begin_with_the_same():
    def sample(runs: int) -> list[Run]:
        factors = {"disturb.push": {"uniform": [0, 100]}}
        spec = spec_of(random={"runs": runs, "factors": factors}, controllers=["pid"])
        return all_runs(spec, lambda run: True)

    assert [r.factors for r in sample(20)[:8]] == [r.factors for r in sample(8)]


def search(**fields: object) -> Spec:
    whole = {"factor": "disturb.friction", "from": 1.0, "to": 0.2, "runs": 40, **fields}
    return spec_of(search=whole, controllers=["pid"])


def test_a_search_begins_with_even_levels_from_the_easy_to_the_hard_end():
    runs = all_runs(search(runs=COARSE), lambda run: True)
    levels = [run.factors["disturb.friction"] for run in runs]
    assert levels == pytest.approx(np.linspace(1.0, 0.2, COARSE), abs=1e-6)
    assert [run.share for run in runs] == pytest.approx(
        np.linspace(0, 1, COARSE), abs=1e-5
    )
    geometric = search(
        factor="speed", **{"from": 0.05}, to=3.0, scale="log", runs=COARSE
    )
    speeds = [run.job.speed for run in all_runs(geometric, lambda run: True)]
    assert speeds == pytest.approx(np.geomspace(0.05, 3.0, COARSE), rel=1e-5)


@pytest.mark.parametrize("limit", [0.93, 0.55, 0.31])
def test_a_search_closes_in_on_where_success_changes(limit: float):
    runs = all_runs(search(), lambda run: run.factors["disturb.friction"] > limit)
    levels = np.array([run.factors["disturb.friction"] for run in runs])
    late = levels[-4 * ROUND :]
    assert np.abs(late - limit).max() < 0.15 * 0.8
    assert late.min() < limit < late.max()
    assert levels[levels > limit].min() - levels[levels <= limit].max() < 0.02


def test_a_search_samples_as_wide_as_chance_decides(rng: np.random.Generator):
    def reached(run: Run) -> bool:
        assert run.share is not None
        return rng.uniform() < np.clip((0.8 - run.share) / 0.6, 0, 1)

    runs = all_runs(search(runs=120), reached)
    late = np.array([run.share for run in runs[COARSE:]])
    assert late.max() - late.min() > 0.5
    assert np.mean((late > 0.2) & (late < 0.8)) > 0.6


@pytest.mark.parametrize(("always", "half"), [(True, 1.0), (False, 0.0)])
def test_a_search_that_never_changes_looks_at_the_end_in_question(
    always: bool, half: float
):
    runs = all_runs(search(), lambda run: always)
    late = np.array([run.share for run in runs[COARSE:]])
    assert np.all(np.abs(late - half) <= 0.5)
    assert len(set(late.tolist())) > 20


def test_what_a_search_does_next_does_not_depend_on_the_last_runs_under_way():
    spec = search()
    strand = strands(spec)[0]
    known = next_runs(spec, strand, [], {})
    done = {
        r.name: ClimbResult(reached=r.factors["disturb.friction"] > 0.5) for r in known
    }
    assert next_runs(spec, strand, known, dict(list(done.items())[:-1])) == []
    known = [*known, *next_runs(spec, strand, known, done)]
    assert len(known) == COARSE + ROUND
    ahead = next_runs(spec, strand, known, done)  # no outcome of the last round yet
    assert len(ahead) == ROUND
    for outcome in (True, False):
        heard = done | {r.name: ClimbResult(reached=outcome) for r in known[-LAG:]}
        assert next_runs(spec, strand, known, heard) == ahead


def test_the_zone_of_change_is_a_bisection_where_outcomes_are_separate():
    u = np.linspace(0, 1, 11)
    lo, hi = zone_of_change(u, u < 0.45)
    assert (lo, hi) == pytest.approx((0.45 - MIN_ZONE * 0.75, 0.45 + MIN_ZONE * 0.75))
    mixed = u < 0.45
    mixed[7] = True  # 0.7, above failures at 0.5 and 0.6
    assert zone_of_change(u, mixed) == pytest.approx((0.3, 0.9))
    lo, hi = zone_of_change(u, u < 0.05)
    assert lo == 0.0
    assert hi == pytest.approx(0.15)
    close = np.array([0.0, 0.5, 0.501, 1.0])
    lo, hi = zone_of_change(close, close < 0.5005)
    assert hi - lo == pytest.approx(MIN_ZONE)
    assert zone_of_change(u, u < 2) == (0.5, 1.0)
    assert zone_of_change(u, u > 2) == (0.0, 0.5)


def test_a_search_may_go_to_several_ends():
    spec = search(factor="disturb.height", **{"from": 0.0}, to=[-0.1, 0.1], runs=8)
    up, down = {}, {}
    for run in all_runs(spec, lambda run: True):
        (down if run.name.startswith("pid-to--0.1-") else up)[run.name] = run
    assert len(up) == len(down) == 8
    assert [r.job.disturb.height for r in up.values()] == [
        -r.job.disturb.height for r in down.values()
    ]


def test_flags_follow_from_a_level_in_a_random_direction():
    spec = search(
        factor="start",
        unit="m",
        **{"from": 0.0},
        to=0.1,
        sets=[
            {"flags": ["disturb.x", "disturb.y"], "direction": "random"},
            {"flags": ["disturb.yaw"], "direction": "random", "scale": "150 deg"},
        ],
    )
    runs = all_runs(spec, lambda run: True)
    assert spec.factors == ["start", "disturb.x", "disturb.y", "disturb.yaw"]
    angles, signs = [], []
    for run in runs:
        d, level = run.job.disturb, run.factors["start"]
        assert math.hypot(d.x, d.y) == pytest.approx(level, abs=1e-6)
        assert abs(d.yaw) == pytest.approx(level * math.radians(150), abs=1e-5)
        if level > 0:
            angles.append(math.atan2(d.y, d.x))
            signs.append(math.copysign(1, d.yaw))
    assert np.ptp(angles) > 4.0
    assert set(signs) == {1.0, -1.0}


def test_levels_are_rounded_to_steps():
    runs = all_runs(
        search(factor="disturb.delay", **{"from": 0.0}, to=0.02, step=0.001),
        lambda run: run.job.disturb.delay < 0.011,
    )
    for run in runs:
        ms = 1000 * run.job.disturb.delay
        assert ms == pytest.approx(round(ms), abs=1e-9)
        assert run.share == pytest.approx(run.job.disturb.delay / 0.02)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("base: {height: 0.3}", "one of grid, random and search"),
        (
            "base: {height: 0.3}\ngrid: {disturb.fricton: [1]}",
            "not disturb.f",
        ),
        ("base: {height: 0.3, disturb.seed: 1}\ngrid: {disturb.mass: [1]}", "`seed`"),
        ("grid: {controller: [pid]}", "controllers in `controllers`"),
        ("controllers: [lqr]\ngrid: {height: [0.3]}", "controllers.0 is 'lqr'"),
        ("grid: {disturb.mass: [1.1]}", "height or scene"),
        (
            "base: {height: 0.3}\ngrid: {disturb.friction: [2.0]}",
            "disturb.friction is 2",
        ),
        ("grid: {height: [high]}", "height is 'high'"),
        (
            "grid: {height: {from: 0.1, to: 0.2}}",
            "grid.height.range.steps: expected a value",
        ),
        ("grid: {height: 0.3}", "grid.height"),
        (
            "random: {runs: 9, factors: {disturb.x: {uniform: [0]}}}",
            "random.factors.disturb.x.uniform",
        ),
        (
            "base: {height: 1}\nrandom: {runs: 9, factors: {disturb.x: {normal: 1}}}",
            "random.factors.disturb.x.uniform.uniform: expected a value",
        ),
        ("search: {factor: height, from: .nan, to: 0.2, runs: 9}", "finite number"),
        (
            "search: {factor: height, from: 0.1, to: 0.1, runs: 20}",
            "ends that differ from the start",
        ),
        (
            "search: {factor: height, from: 0.0, to: 0.1, runs: 20, scale: log}",
            "positive ends for a log scale",
        ),
        ("search: {factor: height, from: 0.1, to: 0.2, runs: 3}", "search.runs is 3"),
        ("search: {factor: tilt, from: 0.1, to: 0.2, runs: 9}", "not tilt"),
        ("random: {runs: 0}", "random.runs is 0"),
        ("colour: red", "colour"),
        ("- 1", "a mapping of fields"),
    ],
)
def test_a_wrong_spec_is_one_sentence_with_file_and_field(
    text: str, said: str, tmp_path: Path
):
    path = tmp_path / "spec.yaml"
    path.write_text(text)
    with pytest.raises(InputError) as wrong:
        load_spec(path)
    assert said in str(wrong.value)
    assert str(path) in str(wrong.value)
    assert "\n" not in str(wrong.value)


def test_files_that_a_spec_names_lie_beside_it(tmp_path: Path):
    (tmp_path / "scene.yaml").write_text("boxes: []")
    path = tmp_path / "spec.yaml"
    path.write_text("base: {scene: scene.yaml}\ngrid: {disturb.mass: [1.0]}")
    spec = load_spec(path)
    job = next_runs(spec, strands(spec)[0], [], {})[0].job
    assert job.scene == str(tmp_path / "scene.yaml")
    assert job.robot == "coman"


@pytest.mark.parametrize("path", EXPERIMENTS, ids=lambda p: p.stem)
def test_the_experiments_can_be_read(path: Path):
    spec = load_spec(path)
    assert spec.about
    by_controller = {c: 0 for c in spec.controllers}
    for s in strands(spec):
        by_controller[s.controller] += s.runs
    assert min(by_controller.values()) >= (300 if spec.random is not None else 30)
