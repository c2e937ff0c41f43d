"""Cubic pieces are SciPy's, to the last bit."""

import subprocess
import sys

import numpy as np
import pytest
from scipy.interpolate import CubicSpline, PchipInterpolator
from scipy.ndimage import correlate1d

from clamber import _core
from clamber.model import cubics
from clamber.recording.detect import correlated, local_quadratics


def some(n, seed=0):
    """Nodes of a path, and points there."""
    rng = np.random.default_rng([n, seed])
    return np.cumsum(rng.uniform(0.05, 0.15, n)), rng.normal(size=(n, 7))


@pytest.mark.parametrize("n", [2, 3, 4, 30])
def test_a_smooth_curve_and_its_derivatives_are_those_of_a_clamped_spline(n):
    x, y = some(n)
    ends = np.random.default_rng(n).normal(size=(2, 7))
    c = cubics.pieces(x, y, _core.smooth_slopes(x, y, ends))
    known = CubicSpline(x, y, bc_type=((1, ends[0]), (1, ends[1])))
    assert np.array_equal(c, known.c)
    at = np.concatenate([x, np.linspace(x[0] - 0.1, x[-1] + 0.1, 101)])
    for order, found in enumerate(cubics.along(c, x, at)):
        assert np.array_equal(found, known(at, order))


def test_nodes_increase_and_points_are_finite():
    x, y = some(4)
    ends, nothing = np.zeros((2, 7)), np.where(np.arange(4) == 2, np.nan, 1.0)
    for nodes, points in (
        *((x[::-1], y), (x * [1, 1, 0, 1], y), (x[:1], y[:1]), (x, y[:3])),
        *((x * nothing, y), (x, y * nothing[:, None])),
    ):
        with pytest.raises(ValueError, match="nodes that increase"):
            _core.smooth_slopes(nodes, points, ends)


@pytest.mark.parametrize("n", [2, 3, 4, 30])
def test_a_curve_that_never_overshoots_is_that_of_pchip(n):
    for seed in range(20):
        x, y = some(n, seed)
        y = np.round(y, seed % 3)  # some are level
        c = cubics.pieces(x, y, cubics.monotone_slopes(x, y))
        known = PchipInterpolator(x, y, axis=0)
        at = np.linspace(x[0], x[-1], 101)
        assert np.array_equal(cubics.along(c, x, at)[0], known(at))


@pytest.mark.parametrize("order", [0, 1])
def test_tracks_are_smoothed_as_by_a_correlation(order):
    for n in range(5, 40, 2):  # rounding leaves some of the weights no mirror of others
        x = np.random.default_rng(n).normal(size=(80, 4, 3))
        impulse = np.zeros((2 * n - 1, 1))
        impulse[n - 1] = 1.0
        half = n // 2
        weights = local_quadratics(impulse, n, order)[half : half + n, 0][::-1]
        known = correlate1d(x, weights, axis=0, mode="constant")
        found = local_quadratics(x, n, order)
        assert np.array_equal(found[half:-half], known[half:-half])
        assert np.array_equal(correlated(x, weights), known[half:-half])


@pytest.mark.whole
def test_a_recording_is_planned_without_scipy():
    code = (
        "import sys, clamber, clamber.execution.simulation, clamber.run.folder\n"
        "found = clamber.detect_contacts(clamber.load_demo('climb'))\n"
        "clamber.plan(found, 'coman', clamber.Scene.from_height(0.275))\n"
        "sys.exit('scipy' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
