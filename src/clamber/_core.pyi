"""Native core: inner loops of kinematics, distances, postures, paths, statics."""

import numpy as np

def support_polygon(points: np.ndarray) -> np.ndarray:
    """(K, 2) convex hull of points (N, 2)."""

def polygon_halfplanes(polygon: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A, b of half-planes `A p <= b` of a polygon (K, 2)."""

def com_margin(x: float, y: float, polygon: np.ndarray) -> float:
    """Signed distance to the border, positive inside."""

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

# Statics: points and normals (nc, 3), mu (nc,), edges of a pyramid, com (3,), mass;
# torque: jacobian (3 nc, nv), gravity (nv,), dofs (na,), limits (na,) or None.

BALANCE_TOL: float
PUSH_TOL: float

_Torque = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None

def contact_frames(normals: np.ndarray) -> np.ndarray:
    """(nc, 3, 3) smallest rotations of the world's x to normals (nc, 3), as z."""

def cone_generators(normals: np.ndarray, mu: np.ndarray, edges: int) -> np.ndarray:
    """(nc, edges, 3) edges of the pyramids inside the friction cones."""

def load_rows(
    points: np.ndarray,
    normals: np.ndarray,
    mu: np.ndarray,
    edges: int,
    com: np.ndarray,
    torque: _Torque,
) -> np.ndarray:
    """(6 + na, nc * edges) wrenches and torques of unit forces along the edges."""

def contact_forces(
    points: np.ndarray,
    normals: np.ndarray,
    mu: np.ndarray,
    edges: int,
    com: np.ndarray,
    mass: float,
    torque: _Torque,
    price: np.ndarray | None,
) -> tuple[np.ndarray, float]:
    """The least forces (nc, 3) [N], and what they leave unbalanced [weights]."""

def push_margin(
    points: np.ndarray,
    normals: np.ndarray,
    mu: np.ndarray,
    edges: int,
    com: np.ndarray,
    mass: float,
    torque: _Torque,
) -> tuple[float, np.ndarray]:
    """Margin [weights], and how fast points and joints (nc + na,) give way there."""

def is_statically_stable(
    points: np.ndarray,
    normals: np.ndarray,
    mu: np.ndarray,
    edges: int,
    com: np.ndarray,
) -> bool:
    """Whether forces within the friction cones balance gravity."""
