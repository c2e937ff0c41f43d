"""The scene: a ground plane, boxes and meshes, whose flat parts are the supports.

A `Support` frame P has its origin in the middle of the surface and z along the outward
normal; its convex polygon is given in that frame's x and y, counter-clockwise. Files
are read by `clamber.model.terrain`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from clamber.errors import InputError
from clamber.model.records import frozen_array, short_repr
from clamber.model.se3 import matrix_from_rpy

GROUND = "ground"
GROUND_HALF_SIZE = 20.0  # [m] the ground is a support of this half width
NEAR_FACE = 0.23  # [m] from the ankles' midpoint to the box of `Scene.from_height`
EVEN = 0.012  # [m] what rises less from a support of a mesh belongs to it
MAX_LENGTH = 50.0  # [m] a larger box is a wrong unit
_ROUNDING = 1e-9  # [m]


def length(x: float) -> float:
    """A positive, finite length [m].

    Raises:
        ValueError: It is none.
    """
    if finite(x) <= 0:
        raise ValueError("expected a positive length [m]")
    return x


def finite(x: float) -> float:
    """A finite number in metres or radians.

    Raises:
        ValueError: It is none, or so large that it must be in another unit.
    """
    if not math.isfinite(x):
        raise ValueError("expected a finite number")
    if abs(x) > MAX_LENGTH:
        raise ValueError(
            f"expected metres or radians, at most {MAX_LENGTH:g}: is it in millimetres?"
        )
    return x


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Edge:
    """A line along which a support ends, where it is climbed.

    Attributes:
        point: (3,) on it, in the world [m].
        inward: (2,) horizontal unit normal, towards the support.
    """

    point: np.ndarray
    inward: np.ndarray

    __repr__ = short_repr

    def distance(self, p: np.ndarray) -> float:
        """Signed distance of a world point (2,) or (3,) behind the line [m]."""
        return float((p[:2] - self.point[:2]) @ self.inward)

    @property
    def rotation(self) -> np.ndarray:
        """(3, 3) R_WE of the edge frame E: x inwards, z up."""
        x, y = self.inward
        return np.array([[x, -y, 0.0], [y, x, 0.0], [0.0, 0.0, 1.0]])

    @property
    def yaw(self) -> float:
        """Yaw of the edge frame in the world [rad]."""
        return math.atan2(self.inward[1], self.inward[0])


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Support:
    """A flat convex region that can bear load.

    Attributes:
        name: `ground`, the box whose top it is, or the mesh that it is of, numbered
            where that has several.
        position: (3,) origin of P in the world [m].
        rotation: (3, 3) R_WP; its last column is the outward normal.
        polygon: (K, 2) vertices in P, counter-clockwise [m].
        friction: Coulomb coefficient mu.
        normal: (3,) outward normal in the world.
    """

    name: str
    position: np.ndarray
    rotation: np.ndarray
    polygon: np.ndarray
    friction: float
    normal: np.ndarray = field(init=False)
    _half_planes: tuple[np.ndarray, np.ndarray] = field(init=False, repr=False)
    _half_sizes: np.ndarray | None = field(init=False, repr=False)

    __repr__ = short_repr

    def __post_init__(self) -> None:
        """Copy the arrays and check that the polygon is convex, ccw."""
        object.__setattr__(self, "position", frozen_array(self.position, (3,)))
        object.__setattr__(self, "rotation", frozen_array(self.rotation, (3, 3)))
        object.__setattr__(self, "normal", frozen_array(self.rotation[:, 2], (3,)))
        object.__setattr__(self, "polygon", frozen_array(self.polygon, (-1, 2)))
        edges = np.roll(self.polygon, -1, axis=0) - self.polygon
        before = np.roll(edges, 1, axis=0)
        turns = before[:, 0] * edges[:, 1] - before[:, 1] * edges[:, 0]
        if len(edges) < 3 or np.any(turns <= 0):
            raise ValueError(f"support {self.name}: polygon is not convex, ccw")
        out = np.stack([edges[:, 1], -edges[:, 0]], axis=1)
        out /= np.linalg.norm(out, axis=1, keepdims=True)
        b = np.sum(out * self.polygon, axis=1)
        if np.any(self.polygon @ out.T > b + _ROUNDING):  # more than once around
            raise ValueError(f"support {self.name}: polygon is not convex, it winds")
        A = out @ self.rotation[:, :2].T
        planes = frozen_array(A), frozen_array(b + A @ self.position)
        object.__setattr__(self, "_half_planes", planes)
        x, y = half = self.polygon.max(axis=0)
        rectangle = [[-x, -y], [x, -y], [x, y], [-x, y]]
        is_rectangle = np.array_equal(self.polygon, rectangle)
        object.__setattr__(self, "_half_sizes", half if is_rectangle else None)

    @property
    def vertices(self) -> np.ndarray:
        """(K, 3) of the polygon in the world, counter-clockwise seen from outside."""
        return self.position + self.polygon @ self.rotation[:, :2].T

    def height(self, points: np.ndarray) -> np.ndarray:
        """Signed distance (...,) of world points (..., 3) over the plane [m]."""
        return (points - self.position) @ self.normal

    def project(self, points: np.ndarray) -> np.ndarray:
        """World points (..., 3) moved along the normal onto the plane."""
        return points - self.height(points)[..., None] * self.normal

    def edges(self) -> tuple[np.ndarray, np.ndarray]:
        """Half-planes `A p <= b` of the polygon, A (K, 3) in the world, b (K,)."""
        return self._half_planes

    def inside(self, points: np.ndarray, margin: float = 0.0) -> np.ndarray:
        """Whether world points (..., 3) project at least `margin` inside [m]."""
        A, b = self.edges()
        return np.all(points @ A.T <= b - margin, axis=-1)

    def level(self, points: np.ndarray) -> np.ndarray:
        """Height z (...,) of the plane above or below world points (..., 2 or 3) [m].

        A wall, whose normal is level, has none.
        """
        n, off = self.normal, points[..., :2] - self.position[:2]
        return self.position[2] - off @ n[:2] / n[2]

    def nearest(self, point: np.ndarray, inset: float = 0.0) -> np.ndarray:
        """The nearest point (3,) of the support, `inset` [m] away from its border.

        Where the support is too narrow for that, on its middle; a rectangle is narrow
        along each of its sides alone.

        Args:
            point: (3,) in the world [m].
            inset: From the border inwards [m].
        """
        local = self.rotation.T @ (point - self.position)
        if self._half_sizes is not None:
            half = np.maximum(self._half_sizes - inset, 0.0)
            x, y = np.clip(local[:2], -half, half)
        else:
            x, y = self._nearest_in_polygon(local[:2], inset)
        return self.position + self.rotation @ np.array([x, y, 0.0])

    def _nearest_in_polygon(self, p: np.ndarray, inset: float) -> np.ndarray:
        """(2,) of the shrunk polygon, in P: `p`, on one side of it, or a corner."""
        edges = np.roll(self.polygon, -1, axis=0) - self.polygon
        A = np.stack([edges[:, 1], -edges[:, 0]], axis=1)
        A /= np.linalg.norm(A, axis=1, keepdims=True)
        b = np.sum(A * self.polygon, axis=1) - inset
        candidates = [p, *(p - (A @ p - b)[:, None] * A)]
        for i in range(len(A)):
            for j in range(i):
                if abs(A[i, 0] * A[j, 1] - A[i, 1] * A[j, 0]) > _ROUNDING:
                    candidates.append(np.linalg.solve(A[[i, j]], b[[i, j]]))
        q = np.array(candidates)
        q = q[np.all(q @ A.T <= b + _ROUNDING, axis=1)]
        if len(q) == 0:
            return self._nearest_in_polygon(p, self._depth() - _ROUNDING)
        return q[np.argmin(np.linalg.norm(q - p, axis=1))]

    def _depth(self) -> float:
        """The largest distance that a point of the polygon has to its border [m]."""
        from scipy.optimize import linprog  # slow to import, and rarely needed

        A, b = self.edges()
        rows = np.column_stack([A @ self.rotation[:, :2], np.ones(len(b))])
        b = b - A @ self.position
        found = linprog([0.0, 0.0, -1.0], rows, b, bounds=(None, None))
        return float(found.x[2])

    def edge_towards(self, point: np.ndarray) -> Edge:
        """The edge that is nearest to a place, seen from above, there where it is.

        Abreast of a corner, the edge that faces the place more.

        Args:
            point: (2,) or (3,) in the world [m].
        """
        start, corners = point[:2], self.vertices
        best, out = (math.inf, 0.0), None
        for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            span = float(np.linalg.norm((b - a)[:2]))
            if span < _ROUNDING:  # upright, of a wall
                continue
            along = (b - a)[:2] / span
            s = float(np.clip((start - a[:2]) @ along, 0.0, span))
            foot = a[:2] + s * along
            inward = np.array([-along[1], along[0]])  # ccw: inside lies to the left
            score = float(np.linalg.norm(foot - start)), float((start - a[:2]) @ inward)
            if score < best:
                z = a[2] + (b[2] - a[2]) * s / span
                best, out = score, Edge(point=np.array([*foot, z]), inward=inward)
        assert out is not None  # a polygon has an area
        return out


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Box:
    """A box obstacle.

    Attributes:
        name: Also that of the support on its top.
        size: (3,) full lengths [m].
        centre: (3,) its middle in the world [m].
        rotation: (3, 3) R_WB of the box's frame in the world.
        friction: Coulomb coefficient of its faces.
        roughness: Unevenness of its faces [m]: links that are not in contact with them
            keep their distance plus this.
        top: The face whose outward normal is most upright.
    """

    name: str
    size: np.ndarray
    centre: np.ndarray
    rotation: np.ndarray
    friction: float = 0.8
    roughness: float = 0.0
    top: Support = field(init=False, repr=False)

    __repr__ = short_repr

    def __post_init__(self) -> None:
        """Copy the arrays and check their shapes."""
        object.__setattr__(self, "size", frozen_array(self.size, (3,)))
        object.__setattr__(self, "centre", frozen_array(self.centre, (3,)))
        object.__setattr__(self, "rotation", frozen_array(self.rotation, (3, 3)))
        object.__setattr__(self, "top", self._top())

    def _top(self) -> Support:
        axis = int(np.argmax(np.abs(self.rotation[2])))
        sign = 1.0 if self.rotation[2, axis] >= 0 else -1.0
        i, j = (axis + 1) % 3, (axis + 2) % 3
        R = np.stack(
            [
                self.rotation[:, i],
                self.rotation[:, j] * sign,
                self.rotation[:, axis] * sign,
            ],
            axis=1,
        )
        hx, hy = self.size[i] / 2, self.size[j] / 2
        return Support(
            name=self.name,
            position=self.centre + R[:, 2] * self.size[axis] / 2,
            rotation=R,
            polygon=np.array([[-hx, -hy], [hx, -hy], [hx, hy], [-hx, hy]]),
            friction=self.friction,
        )


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Rejected:
    """A flat part of a mesh that is no support.

    Attributes:
        outline: (K, 3) its border in the world [m].
        why: It is none, in words.
    """

    outline: np.ndarray
    why: str

    __repr__ = short_repr

    def __post_init__(self) -> None:
        """Copy the outline."""
        object.__setattr__(self, "outline", frozen_array(self.outline, (-1, 3)))


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class HeightField:
    """Heights over a rectangle, linear between them.

    Attributes:
        heights: (rows, columns) in the world [m], rows along y, columns along x.
        size: (2,) of the rectangle, whose border the outermost heights are on [m].
        position: (2,) of its middle [m].
        yaw: By which it is turned [rad].
    """

    heights: np.ndarray
    size: np.ndarray
    position: np.ndarray
    yaw: float

    __repr__ = short_repr

    def __post_init__(self) -> None:
        """Copy the arrays and check their shapes."""
        heights = frozen_array(self.heights)
        if heights.ndim != 2 or min(heights.shape) < 2:
            raise ValueError(f"heights {heights.shape} are no rows and columns")
        object.__setattr__(self, "heights", heights)
        object.__setattr__(self, "size", frozen_array(self.size, (2,)))
        object.__setattr__(self, "position", frozen_array(self.position, (2,)))


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Mesh:
    """Terrain of any shape, as planning and physics know it (made by `patches`).

    Attributes:
        name: Its supports are called by it.
        pieces: Convex solids, each the hull of corners (K, 3) in the world [m].
        supports: Flat parts that bear load.
        under: Of each support, the piece that it lies on.
        field: What physics collides with in place of the pieces, where these leave out
            the noise of a scan.
        friction: Coulomb coefficient.
        roughness: It is uneven by about this [m], see `Box`.
        rejected: Flat parts that bear none.
        notes: What was mended in the file, a sentence each.
    """

    name: str
    pieces: tuple[np.ndarray, ...]
    supports: tuple[Support, ...]
    under: tuple[int, ...]
    field: HeightField | None = None
    friction: float = 0.8
    roughness: float = 0.0
    rejected: tuple[Rejected, ...] = ()
    notes: tuple[str, ...] = ()

    __repr__ = short_repr

    def __post_init__(self) -> None:
        """Copy the arrays and check that each support lies on a piece."""
        pieces = tuple(frozen_array(p, (-1, 3)) for p in self.pieces)
        object.__setattr__(self, "pieces", pieces)
        if len(self.under) != len(self.supports) or any(
            not 0 <= i < len(pieces) for i in self.under
        ):
            raise ValueError(f"mesh {self.name}: a piece under each support")

    def piece_name(self, i: int) -> str:
        """Name of a piece's geom; no support has it."""
        return f"{self.name}.{i}"


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Scene:
    """Ground, boxes and meshes, where the robot starts and where it should get.

    Attributes:
        boxes: Obstacles; the first is the one to climb where no goal is named.
        meshes: Obstacles of other shapes.
        ground_friction: Coulomb coefficient of the ground.
        start: (3,) ankles' midpoint x, y [m] and yaw [rad].
        goal: (2,) pelvis x, y or (3,) with yaw; None for "on top of the first box".
        ground: The plane z = 0.
        tops: What may be climbed on: tops of the boxes in order, then those of meshes.
        supports: The ground, then the tops.
    """

    boxes: tuple[Box, ...] = ()
    meshes: tuple[Mesh, ...] = ()
    ground_friction: float = 0.8
    start: np.ndarray
    goal: np.ndarray | None = None
    ground: Support = field(init=False, repr=False)
    tops: tuple[Support, ...] = field(init=False, repr=False)
    supports: tuple[Support, ...] = field(init=False, repr=False)

    __repr__ = short_repr

    def __post_init__(self) -> None:
        """Copy the arrays, check that names are unique, gather the supports."""
        object.__setattr__(self, "start", frozen_array(self.start, (3,)))
        if self.goal is not None:
            object.__setattr__(self, "goal", frozen_array(self.goal, (-1,)))
        names = [*(x.name for x in (*self.boxes, *self.meshes))]
        names += [s.name for m in self.meshes for s in m.supports if s.name != m.name]
        if len({*names, GROUND}) != len(names) + 1:
            raise ValueError(f"names are not unique: {names}")
        s = GROUND_HALF_SIZE
        ground = Support(
            name=GROUND,
            position=np.zeros(3),
            rotation=np.eye(3),
            polygon=np.array([[-s, -s], [s, -s], [s, s], [-s, s]]),
            friction=self.ground_friction,
        )
        meshes = (s for m in self.meshes for s in m.supports)
        tops = (*(b.top for b in self.boxes), *meshes)
        object.__setattr__(self, "ground", ground)
        object.__setattr__(self, "tops", tops)
        object.__setattr__(self, "supports", (ground, *tops))

    @property
    def notes(self) -> tuple[str, ...]:
        """Repairs made to the mesh files, a sentence each."""
        return tuple(f"{m.name}: {note}" for m in self.meshes for note in m.notes)

    def owner(self, name: str) -> str:
        """The mesh that a support or a piece is of; else the name itself."""
        for m in self.meshes:
            if name.partition(".")[0] == m.name or name in {s.name for s in m.supports}:
                return m.name
        return name

    def kind(self, name: str) -> str:
        """The key of a support's shape in a scene file: `boxes` or `meshes`."""
        return "boxes" if name in {b.name for b in self.boxes} else "meshes"

    def below(self, point: np.ndarray, slack: float = 0.0) -> Support | None:
        """The highest support under a point (3,); None where there is none.

        Args:
            point: In the world [m].
            slack: A support that ends so far beside the point, or is so far above it,
                is under it as well [m].
        """
        under = []
        for s in self.supports:
            if s.normal[2] > _ROUNDING:
                z = float(s.level(point))
                foot = np.array([point[0], point[1], z])
                if z <= point[2] + slack and s.inside(foot, -slack):
                    under.append((z, s))
        return max(under, key=lambda x: x[0])[1] if under else None

    def support(self, name: str) -> Support:
        """The support of that name; KeyError lists those that exist."""
        for s in self.supports:
            if s.name == name:
                return s
        raise KeyError(
            f"no support {name!r}; there are {[s.name for s in self.supports]}"
        )

    @classmethod
    def from_height(cls, height: float, friction: float = 0.8) -> Scene:
        """One box of 1.0 x 1.2 x height m, its near face 0.23 m from the ankles.

        Raises:
            InputError: The height is no positive length, or the friction not from 0
                to 1.
        """
        try:
            size = np.array([1.0, 1.2, length(height)])
        except ValueError as e:
            text = str(e).removeprefix("expected ")
            raise InputError(text, None, "height", height) from e
        if not 0 < friction <= 1:
            raise InputError("above 0, at most 1", None, "friction", friction)
        box = Box(
            name="box",
            size=size,
            centre=np.array([NEAR_FACE + 0.5, 0.0, height / 2]),
            rotation=matrix_from_rpy([0.0, 0.0, 0.0]),
            friction=friction,
        )
        return cls(boxes=(box,), ground_friction=friction, start=np.zeros(3))
