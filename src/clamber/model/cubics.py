"""Cubic pieces through points: as SciPy's to the last bit, which is slow to import.

Shapes: n nodes, of which there are two or more; k coordinates.
"""

from __future__ import annotations

import numpy as np


def monotone_slopes(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(n, k) slopes at x (n,) of the curve through y (n, k) that nowhere overshoots.

    The weighted harmonic mean of what rises on both sides (PCHIP), none at extremes.
    """
    h = np.diff(x)[:, None]
    rise = np.diff(y, axis=0) / h
    if len(h) == 1:
        return np.concatenate([rise, rise])
    out = np.zeros_like(y)
    before, after = 2.0 * h[1:] + h[:-1], h[1:] + 2.0 * h[:-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = (before / rise[:-1] + after / rise[1:]) / (before + after)
    same = np.sign(rise[:-1]) * np.sign(rise[1:]) > 0.0
    out[1:-1][same] = 1.0 / mean[same]
    for end, beside in ((0, 1), (-1, -2)):
        h0, h1, m0, m1 = h[end], h[beside], rise[end], rise[beside]
        d = ((2.0 * h0 + h1) * m0 - h0 * m1) / (h0 + h1)
        steep = (np.sign(m0) != np.sign(m1)) & (np.abs(d) > 3.0 * np.abs(m0))
        d = np.where(steep, 3.0 * m0, d)
        out[end] = np.where(np.sign(d) == np.sign(m0), d, 0.0)
    return out


def pieces(x: np.ndarray, y: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """(4, n - 1, k) coefficients between the nodes, from the third power down."""
    h = np.diff(x)[:, None]
    rise = np.diff(y, axis=0) / h
    third = (slope[:-1] + slope[1:] - 2.0 * rise) / h
    return np.stack([third / h, (rise - slope[:-1]) / h - third, slope[:-1], y[:-1]])


def along(c: np.ndarray, x: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, ...]:
    """(T, k) values at (T,), and their first and second derivatives.

    Args:
        c: `pieces`; those at the ends go on beyond the nodes.
        x: (n,) nodes.
        at: (T,).
    """
    i = np.searchsorted(x[1:-1], at, side="right")
    s = (at - x[i])[:, None]
    c3, c2, c1, c0 = c[:, i]
    return (
        c0 + c1 * s + c2 * (s * s) + c3 * (s * s * s),
        c1 + c2 * s * 2.0 + c3 * (s * s) * 3.0,
        c2 * 2.0 + c3 * s * 6.0,
    )
