"""Triangles seen from above -> heights on a grid, as physics collides with them.

The pieces that are planned with follow a scan within its noise. What is executed meets
the noise itself: a height field that goes through the triangles.
"""

from __future__ import annotations

import numpy as np

from clamber.model.regions import face_normals
from clamber.model.scene import HeightField

FINEST = 0.006  # [m] spacing of a field
SHARE = 3.0  # spacings to an edge of the triangles
MOST_HEIGHTS = 250_000  # of a field
UNDER = 0.05  # [m] lower than all else is what has no triangle over it
DOWN = 0.5  # of a unit normal: a wall may face down so far for noise
HIDDEN = 0.1  # share of the area that may face down: more is not seen from above


def is_seen_from_above(vertices: np.ndarray, faces: np.ndarray) -> bool:
    """Whether nearly nothing of triangles, without most noise, faces down.

    Args:
        vertices: (V, 3) in the world [m].
        faces: (F, 3) counter-clockwise seen from outside.
    """
    normals, areas = face_normals(vertices, faces)
    return bool(areas[normals[:, 2] < -DOWN].sum() <= HIDDEN * areas.sum())


def field_of(vertices: np.ndarray, faces: np.ndarray) -> HeightField:
    """The highest point of triangles over each place of a grid.

    Args:
        vertices: (V, 3) in the world [m].
        faces: (F, 3).
    """
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    low, high = vertices[:, :2].min(axis=0), vertices[:, :2].max(axis=0)
    edge = float(np.median(np.linalg.norm((b - a)[:, :2], axis=1)))
    spacing = max(
        edge / SHARE, FINEST, float(np.sqrt(np.prod(high - low) / MOST_HEIGHTS))
    )
    count = np.maximum(np.ceil((high - low) / spacing).astype(int), 1) + 1
    step = (high - low) / (count - 1)
    heights = _heights(a, b, c, normal, low, step, count)
    known = np.isfinite(heights)
    heights[~known] = heights[known].min() - UNDER
    return HeightField(
        heights=heights, size=high - low, position=(low + high) / 2, yaw=0.0
    )


def _heights(
    a: np.ndarray,
    b: np.ndarray,
    c: np.ndarray,
    normal: np.ndarray,
    low: np.ndarray,
    step: np.ndarray,
    count: np.ndarray,
) -> np.ndarray:
    """(rows, columns) of triangles with corners (F, 3) each, -inf where none is."""
    out = np.full((count[1], count[0]), -np.inf)
    steep = np.abs(normal[:, 2]) < 1e-12
    a, b, c, normal = (x[~steep] for x in (a, b, c, normal))
    corners = np.stack([a, b, c], axis=1)[..., :2]
    first = np.ceil((corners.min(axis=1) - low) / step - 1e-9).astype(int)
    last = np.floor((corners.max(axis=1) - low) / step + 1e-9).astype(int)
    wide = np.maximum(last - first + 1, 0)
    of = np.repeat(np.arange(len(a)), wide.prod(axis=1))
    start = np.cumsum(wide.prod(axis=1)) - wide.prod(axis=1)
    k = np.arange(len(of)) - start[of]
    at = first[of] + np.stack([k % wide[of, 0], k // wide[of, 0]], axis=1)
    p = low + at * step
    inside = np.ones(len(of), dtype=bool)
    up = np.sign(normal[of, 2])
    for i in range(3):
        x, y = corners[of, i], corners[of, (i + 1) % 3]
        side = (y - x)[:, 0] * (p - x)[:, 1] - (y - x)[:, 1] * (p - x)[:, 0]
        inside &= side * up >= -1e-12
    of, at, p = of[inside], at[inside], p[inside]
    n = normal[of]
    z = a[of, 2] - np.sum((p - a[of, :2]) * n[:, :2], axis=1) / n[:, 2]
    inside = (at >= 0).all(axis=1) & (at < count).all(axis=1)
    np.maximum.at(out, (at[inside, 1], at[inside, 0]), z[inside])
    return out
