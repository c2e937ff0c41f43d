"""The support polygon: where the centre of mass may be, and how far it is from there.

Everything here works on arrays, in the horizontal plane. Shapes: K vertices.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from clamber.model.records import short_repr

_GRID = 2.0**30  # vertices of a support polygon lie on a grid of about a nanometre


def support_polygon(points: np.ndarray) -> np.ndarray:
    """Convex hull of points (N, 2), counter-clockwise, without collinear vertices.

    Coordinates are rounded to a grid of a nanometre, on which the hull is computed in
    whole numbers and thus exactly: feet side by side with corners that differ in the
    last bit make no sliver edges.

    Returns:
        (K, 2) vertices [m]: two of them for collinear points, one where all coincide,
        none where there are none.
    """
    # In plain numbers: numpy takes several times as long for a few points.
    flat = np.asarray(points, dtype=float).tolist()
    ordered = sorted({(round(x * _GRID), round(y * _GRID)) for x, y in flat})
    if len(ordered) < 3:
        return np.array(ordered, dtype=float).reshape(-1, 2) / _GRID
    hull: list[tuple[int, int]] = []
    for chain in (ordered, ordered[::-1]):  # the lower, then the upper one
        first = len(hull)
        for p in chain:
            px, py = p
            while len(hull) - first >= 2:
                ax, ay = hull[-2]
                bx, by = hull[-1]
                if (bx - ax) * (py - ay) > (by - ay) * (px - ax):
                    break
                hull.pop()
            hull.append(p)
        hull.pop()  # the next chain begins with it
    return np.array(hull, dtype=float) / _GRID


def polygon_halfplanes(polygon: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Half-planes `A p <= b` of a convex, counter-clockwise polygon (K, 2).

    A segment gives the two sides of a strip without width and a cap at either end, a
    point four half-planes that meet in it: only the set itself satisfies them.

    Returns:
        A: (K, 2) unit outward normals, row i of the edge from vertex i; (4, 2) for a
            segment or a point.
        b: (K,) or (4,) [m].
    """
    v = np.asarray(polygon, dtype=float).tolist()
    if not v:
        raise ValueError("a polygon without vertices has no half-planes")
    rows: list[tuple[float, float]] = []
    b: list[float] = []
    for (ax, ay), (bx, by) in zip(v, v[1:] + v[:1], strict=True):
        ex, ey = bx - ax, by - ay
        length = math.hypot(ex, ey)
        ex, ey = (ex / length, ey / length) if length > 0 else (1.0, 0.0)
        rows.append((ey, -ex))
        b.append(ey * ax - ex * ay)
        if len(v) < 3:  # the cap at the far end
            rows.append((ex, ey))
            b.append(ex * bx + ey * by)
    if len(v) == 1:
        (x, y), rows, b = v[0], [(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)], []
        b = [x, -x, y, -y]
    return np.array(rows), np.array(b)


def com_margin(com: ArrayLike, polygon: np.ndarray) -> float:
    """Signed distance from the centre of mass to the polygon's border [m].

    Args:
        com: (2,) or (3,); the height does not count.
        polygon: (K, 2) convex, counter-clockwise.

    Returns:
        Positive inside, minus the Euclidean distance outside, -inf without vertices.
    """
    x, y = np.asarray(com, dtype=float)[:2].tolist()
    return nearest_border(x, y, np.asarray(polygon, dtype=float).tolist())[0]


def com_margins(com: np.ndarray, polygon: np.ndarray) -> np.ndarray:
    """(n,) `com_margin` of many centres of mass (n, 2)."""
    if len(polygon) < 3:
        return np.array([com_margin(c, polygon) for c in com])
    A, b = polygon_halfplanes(polygon)
    out = (b - com @ A.T).min(axis=1)
    for i in np.flatnonzero(out < 0.0):
        out[i] = com_margin(com[i], polygon)
    return out


def nearest_border(
    x: float, y: float, v: list[list[float]]
) -> tuple[float, tuple[float, float]]:
    """Signed distance to the border, positive inside, and the outward direction."""
    nearest, out = -math.inf, (1.0, 0.0)
    if len(v) >= 3:
        edge = -math.inf
        for (ax, ay), (bx, by) in zip(v, v[1:] + v[:1], strict=True):
            ex, ey = bx - ax, by - ay
            length = math.hypot(ex, ey)
            s = ((x - ax) * ey - (y - ay) * ex) / length
            if s > edge:
                edge, out = s, (ey / length, -ex / length)
        if edge <= 0:
            return -edge, out
    for (ax, ay), (bx, by) in zip(v, v[1:] + v[:1], strict=True):
        ex, ey = bx - ax, by - ay
        square = ex * ex + ey * ey
        t = ((x - ax) * ex + (y - ay) * ey) / square if square > 0 else 0.0
        t = min(max(t, 0.0), 1.0)
        dx, dy = x - ax - t * ex, y - ay - t * ey
        distance = math.hypot(dx, dy)
        if -distance > nearest:
            nearest = -distance
            if distance > 0:
                out = dx / distance, dy / distance
            elif square > 0:
                out = ey / math.sqrt(square), -ex / math.sqrt(square)
    return nearest, out


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class SupportEllipse:
    """An ellipse inside a support polygon, as a string around two foci draws it.

    Attributes:
        centre: (2,) [m].
        semi_axes: (2,) the longer one first [m].
        foci: (2, 2) [m].
        string_length: s, the sum of a border point's distances to the foci [m].
    """

    centre: np.ndarray
    semi_axes: np.ndarray
    foci: np.ndarray
    string_length: float

    __repr__ = short_repr

    def excess(self, com: ArrayLike) -> tuple[float, np.ndarray]:
        """Summed distance of a point to the foci less the string length (4.28).

        Args:
            com: (2,) or (3,); the height does not count.

        Returns:
            excess: d_com - s, negative inside, zero on the border [m].
            gradient: (2,) its derivative by x and y; a focus itself adds nothing.
        """
        x, y = np.asarray(com, dtype=float)[:2].tolist()
        total, gx, gy = -self.string_length, 0.0, 0.0
        for fx, fy in self.foci.tolist():
            d = math.hypot(x - fx, y - fy)
            total += d
            gx, gy = gx + (x - fx) / max(d, 1e-12), gy + (y - fy) / max(d, 1e-12)
        return total, np.array([gx, gy])


def support_ellipse(polygon: np.ndarray) -> SupportEllipse:
    """Fit an ellipse to a convex polygon (K, 2) from inside.

    The ellipse has the polygon's centre of area and the directions and ratio of axes
    of its second moments of area, and is scaled until it touches the nearest edge:
    with E the second moments, `E_ellipse = k E`, k the largest for which
    `sqrt(n^T E_ellipse n) <= b - n^T c` on every edge. Closed form, and equivariant
    under affine maps: for triangles and parallelograms (two feet side by side) it is
    the largest ellipse that fits at all. Collinear points give the segment, one point
    itself, as ellipses without area: no centre of mass has a negative excess there.
    """
    v = np.asarray(polygon, dtype=float).tolist()
    if not v:
        raise ValueError("a polygon without vertices has no ellipse")
    mx = my = 0.0
    for x, y in v:
        mx, my = mx + x, my + y
    mx, my = mx / len(v), my / len(v)
    r = [(x - mx, y - my) for x, y in v]
    sides = list(zip(r, r[1:] + r[:1], strict=True))
    # Area, first and second moments about the middle, triangle by triangle.
    area = square = cx = cy = xx = xy = yy = 0.0
    for (ax, ay), (bx, by) in sides:
        cross, sx, sy = ax * by - ay * bx, ax + bx, ay + by
        area, square = area + cross, square + ax * ax + ay * ay
        cx, cy = cx + cross * sx, cy + cross * sy
        xx += cross * (ax * ax + bx * bx + sx * sx)
        xy += cross * (ax * ay + bx * by + sx * sy)
        yy += cross * (ay * ay + by * by + sy * sy)
    area *= 0.5
    if area <= 1e-12 * square:
        half = max(r, key=lambda p: p[0] * p[0] + p[1] * p[1])
        return _ellipse((mx, my), math.hypot(*half), 0.0, half)
    cx, cy = cx / (6 * area), cy / (6 * area)
    xx, xy, yy = (m / (24 * area) for m in (xx, xy, yy))
    xx, xy, yy = xx - cx * cx, xy - cx * cy, yy - cy * cy
    k = math.inf
    for (ax, ay), (bx, by) in sides:
        nx, ny = by - ay, ax - bx  # not of unit length: the ratio does not mind
        room = nx * (ax - cx) + ny * (ay - cy)
        k = min(k, room * room / (nx * nx * xx + 2 * nx * ny * xy + ny * ny * yy))
    # Eigenvalues of the symmetric 2 x 2 matrix, and the direction of the larger.
    half, skew = 0.5 * (xx + yy), math.hypot(0.5 * (xx - yy), xy)
    angle = 0.5 * math.atan2(2 * xy, xx - yy)
    major, minor = math.sqrt(k * (half + skew)), math.sqrt(k * max(half - skew, 0.0))
    focal = math.sqrt(max(major * major - minor * minor, 0.0))
    focus = (focal * math.cos(angle), focal * math.sin(angle))
    return _ellipse((mx + cx, my + cy), major, minor, focus)


def _ellipse(
    centre: tuple[float, float], major: float, minor: float, focus: tuple[float, float]
) -> SupportEllipse:
    """Of semi-axes `major` and `minor`, with a focus seen from the centre."""
    (x, y), (fx, fy) = centre, focus
    return SupportEllipse(
        centre=np.array([x, y]),
        semi_axes=np.array([major, minor]),
        foci=np.array([[x - fx, y - fy], [x + fx, y + fy]]),
        string_length=2 * major,
    )
