"""Shares and half points with their intervals, against the definitions."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import optimize, special

from clamber.study.statistics import CHI2, SLOPES, fit_break, wilson

Z = 1.959963984540054  # two-sided 95 % of the normal distribution


@pytest.mark.parametrize(("k", "n"), [(1, 7), (15, 30), (29, 30), (298, 300)])
def test_the_ends_of_wilsons_interval_solve_its_equation(k: int, n: int):
    for p in wilson(k, n):
        assert abs(k / n - p) == pytest.approx(
            Z * math.sqrt(p * (1 - p) / n), abs=1e-12
        )


def test_wilsons_interval_holds_at_the_ends():
    low, high = wilson(30, 30)
    assert high == 1.0
    assert low == pytest.approx(30 / (30 + Z**2))
    assert wilson(0, 30) == pytest.approx((0.0, Z**2 / (30 + Z**2)))
    assert wilson(0, 0) == (0.0, 1.0)


def likelihood(u: np.ndarray, y: np.ndarray, centre: float, slope: float) -> float:
    p = 1 / (1 + np.exp(slope * (u - centre)))
    return float(np.sum(np.log(np.maximum(np.where(y, p, 1 - p), 1e-300))))


def sample(rng: np.random.Generator, n: int, centre: float, slope: float):
    u = rng.uniform(0.0, 1.0, n)
    return u, rng.uniform(size=n) < special.expit(slope * (centre - u))


def test_the_curve_is_that_of_maximum_likelihood(rng: np.random.Generator):
    u, y = sample(rng, 200, 0.6, 12.0)
    fit = fit_break(u, y)
    assert fit is not None
    best = optimize.minimize(
        lambda x: -likelihood(u, y, x[0], x[1]), [0.5, 8.0], method="Nelder-Mead"
    )
    assert fit.half == pytest.approx(best.x[0], abs=2e-3)
    assert fit.slope == pytest.approx(best.x[1], rel=0.05)  # they are on a grid
    assert likelihood(u, y, fit.centre, fit.slope) >= -best.fun - 0.01
    assert fit.success(fit.centre) == pytest.approx(0.5)
    assert np.all(np.diff(fit.success(np.linspace(0, 1, 50))) < 0)


def test_the_interval_ends_where_the_profile_has_fallen_by_the_quantile(
    rng: np.random.Generator,
):
    u, y = sample(rng, 60, 0.5, 15.0)
    fit = fit_break(u, y)
    assert fit is not None
    assert fit.low is not None
    assert fit.high is not None
    assert fit.low < fit.centre < fit.high

    def profile(c: float) -> float:
        return max(likelihood(u, y, c, s) for s in SLOPES)

    for end in (fit.low, fit.high):
        assert 2 * (profile(fit.centre) - profile(end)) == pytest.approx(CHI2, abs=1e-3)


@pytest.mark.whole
def test_the_interval_covers_the_truth_about_as_often_as_it_says():
    covered = 0
    for seed in range(120):
        u, y = sample(np.random.default_rng(seed), 40, 0.55, 14.0)
        fit = fit_break(u, y)
        assert fit is not None
        low = 0.0 if fit.low is None else fit.low
        high = 1.0 if fit.high is None else fit.high
        covered += low <= 0.55 <= high
    # 95 % of 120, give or take three standard deviations
    assert 0.95 * 120 - 3 * math.sqrt(120 * 0.95 * 0.05) <= covered <= 120


def test_separate_successes_and_failures_break_between_them():
    u = np.array([0.0, 0.2, 0.4, 0.5, 0.6, 0.8, 1.0])
    fit = fit_break(u, u < 0.45)
    assert fit is not None
    assert fit.half == pytest.approx(0.45, abs=0.02)
    assert fit.low is not None
    assert fit.high is not None
    assert 0.0 < fit.low < 0.4
    assert 0.5 < fit.high < 1.0


def test_runs_that_all_end_alike_have_no_curve():
    u = np.linspace(0, 1, 9)
    assert fit_break(u, np.ones(9, bool)) is None
    assert fit_break(u, np.zeros(9, bool)) is None


@pytest.mark.whole
def test_a_break_beyond_the_range_is_not_placed_in_it(rng: np.random.Generator):
    u = np.linspace(0.0, 1.0, 300)
    y = rng.uniform(size=300) < special.expit(6.0 * (1.3 - u))
    fit = fit_break(u, y)
    assert fit is not None
    assert not y.all()
    assert fit.half is None
    assert fit.centre > 1.0
    assert fit.high is None
    before = fit_break(u, ~y[::-1])  # mirrored: it broke before the range began
    assert before is not None
    assert before.half is None
    assert before.centre == pytest.approx(1.0 - fit.centre, abs=1e-3)
    assert before.low is None
