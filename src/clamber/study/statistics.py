"""Success rates and break points: shares and curves with their intervals.

Levels run from the easy end of a factor, u = 0, to the hard one, u = 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import optimize, special, stats

CONFIDENCE = 0.95
CHI2 = float(stats.chi2.ppf(CONFIDENCE, 1))  # one degree of freedom
SLOPES = np.geomspace(0.5, 400.0, 160)  # steeper ones cannot be told from a step
REACH = 0.5  # the half point is sought this far beyond both ends


def wilson(successes: int, runs: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a share; (0, 1) of no runs.

    The shares p for which |k/n - p| <= z sqrt(p (1 - p) / n).
    """
    if runs == 0:
        return 0.0, 1.0
    found = stats.binomtest(successes, runs).proportion_ci(CONFIDENCE, method="wilson")
    return float(found.low), float(found.high)


@dataclass(frozen=True, slots=True, kw_only=True)
class Break:
    """Level at which the success rate falls through one half.

    Attributes:
        half: The level of 50 % success; None: outside [0, 1], see `low` and `high`.
        low: Lower end of its 95 % interval; None: not bounded within [0, 1].
        high: Upper end, likewise.
        slope: Of the logistic curve, per unit of level; the half point may lie outside.
        centre: Its half point, also where that lies outside [0, 1].
    """

    half: float | None
    low: float | None
    high: float | None
    slope: float
    centre: float

    def success(self, level: ArrayLike) -> np.ndarray:
        """Probability of success 1 / (1 + exp(slope (u - centre)))."""
        return special.expit(self.slope * (self.centre - np.asarray(level, float)))


def fit_break(level: ArrayLike, reached: ArrayLike) -> Break | None:
    """Logistic regression by maximum likelihood, falling in the level.

    The interval of the half point c is that of the profile likelihood,
    {c: 2 (L_max - max_slope L(c, slope)) <= 3.84}. It holds also where successes and
    failures are separate and the best slope is infinite.

    Args:
        level: (n,) in [0, 1].
        reached: (n,) bool.

    Returns:
        None where all runs ended alike: there is no curve to fit.
    """
    u = np.asarray(level, dtype=float)
    y = np.asarray(reached, dtype=bool)
    if y.all() or not y.any():
        return None
    sign = np.where(y, 1.0, -1.0)

    def profile(c: float) -> float:
        return float(_likelihoods(c, u, sign).max())

    grid = np.linspace(-REACH, 1.0 + REACH, 401)
    values = np.array([profile(c) for c in grid])
    best = int(values.argmax())
    # Of a plateau, between separate successes and failures, the middle.
    flat = np.flatnonzero(values >= values[best] - 1e-6)
    if len(flat) > 1:
        centre = float(grid[flat].mean())
    else:
        a, b = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
        found: Any = optimize.minimize_scalar(
            lambda c: -profile(float(c)), bounds=(a, b), method="bounded"
        )
        centre = float(found.x)
    top = max(profile(centre), float(values[best]))
    bound = top - CHI2 / 2

    def end(side: slice) -> float | None:
        """Level at which the profile falls below the bound, going outwards."""
        last = centre
        for c in grid[side]:
            if profile(c) < bound:
                found = optimize.root_scalar(
                    lambda x: profile(float(x)) - bound, bracket=(last, float(c))
                )
                return float(found.root) if 0.0 <= found.root <= 1.0 else None
            last = float(c)
        return None

    after = int(np.searchsorted(grid, centre, side="right"))
    before = int(np.searchsorted(grid, centre, side="left"))
    return Break(
        half=centre if 0.0 <= centre <= 1.0 else None,
        low=end(slice(before - 1, None, -1)) if before else None,
        high=end(slice(after, None)),
        slope=float(SLOPES[int(_likelihoods(centre, u, sign).argmax())]),
        centre=centre,
    )


def _likelihoods(c: float, u: np.ndarray, sign: np.ndarray) -> np.ndarray:
    """Log likelihood for each of `SLOPES`: sum of log expit(+- slope (c - u))."""
    return special.log_expit(np.outer(SLOPES, sign * (c - u))).sum(axis=1)
