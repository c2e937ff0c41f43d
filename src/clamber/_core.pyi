"""Native core: inner loops of kinematics, distances, postures, paths, statics."""

import numpy as np

def support_polygon(points: np.ndarray) -> np.ndarray:
    """(K, 2) convex hull of points (N, 2)."""

def polygon_halfplanes(polygon: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A, b of half-planes `A p <= b` of a polygon (K, 2)."""

def com_margin(x: float, y: float, polygon: np.ndarray) -> float:
    """Signed distance to the border, positive inside."""

def nearest_border(
    x: float, y: float, polygon: np.ndarray
) -> tuple[float, tuple[float, float]]:
    """`com_margin`, and the unit direction that leads out the shortest way."""

def com_margins(com: np.ndarray, polygon: np.ndarray) -> np.ndarray:
    """(n,) `com_margin` of many (n, 2)."""

def support_ellipse(
    polygon: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Centre (2,), semi-axes (2,), foci (2, 2) and string length."""

def ellipse_excess(
    foci: np.ndarray, string_length: float, x: float, y: float
) -> tuple[float, np.ndarray]:
    """Summed distance to the foci less the string length, and its gradient (2,)."""

class Proximity:
    """Which of many pairs of shapes are near, asked again and again as they move."""

    def __init__(
        self,
        kinds: np.ndarray,
        sizes: np.ndarray,
        vertices: list[np.ndarray],
        pairs: np.ndarray,
    ) -> None:
        """Kinds (n,) int32 and sizes (n, 3) of shapes, hull vertices of each (k, 3)."""

    def query(
        self,
        xpos: np.ndarray,
        xmat: np.ndarray,
        reach: float,
        active: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Pairs (m,), distances (m,), normals, first and second points (m, 3)."""
