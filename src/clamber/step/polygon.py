"""The support polygon: where the centre of mass may be, and how far it is from there.

Everything here works on arrays, in the horizontal plane. Shapes: K vertices.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from clamber import _core
from clamber.model.records import short_repr


def support_polygon(points: np.ndarray) -> np.ndarray:
    """Convex hull of points (N, 2), counter-clockwise, without collinear vertices.

    Coordinates are rounded to a grid of a nanometre, on which the hull is computed in
    whole numbers and thus exactly: feet side by side with corners that differ in the
    last bit make no sliver edges.

    Returns:
        (K, 2) vertices [m]: two of them for collinear points, one where all coincide,
        none where there are none.

    Raises:
        ValueError: A coordinate is no number, or a hull has more than 64 vertices.
    """
    return _core.support_polygon(points)


def polygon_halfplanes(polygon: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Half-planes `A p <= b` of a convex, counter-clockwise polygon (K, 2).

    A segment gives the two sides of a strip without width and a cap at either end, a
    point four half-planes that meet in it: only the set itself satisfies them.

    Returns:
        A: (K, 2) unit outward normals, row i of the edge from vertex i; (4, 2) for a
            segment or a point.
        b: (K,) or (4,) [m].
    """
    return _core.polygon_halfplanes(polygon)


def com_margin(com: ArrayLike, polygon: np.ndarray) -> float:
    """Signed distance from the centre of mass to the polygon's border [m].

    Args:
        com: (2,) or (3,); the height does not count.
        polygon: (K, 2) convex, counter-clockwise.

    Returns:
        Positive inside, minus the Euclidean distance outside; -inf without vertices,
        NaN of a centre of mass that is no number.
    """
    x, y = np.asarray(com, dtype=float)[:2].tolist()
    return _core.com_margin(x, y, polygon)


def com_margins(com: np.ndarray, polygon: np.ndarray) -> np.ndarray:
    """(n,) `com_margin` of many centres of mass (n, 2)."""
    return _core.com_margins(com, polygon)


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
        return _core.ellipse_excess(self.foci, self.string_length, x, y)


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
    centre, semi_axes, foci, string_length = _core.support_ellipse(polygon)
    return SupportEllipse(
        centre=centre, semi_axes=semi_axes, foci=foci, string_length=string_length
    )
