"""A triangle mesh -> its planar regions.

Triangles that lie in one plane, as nearly as the mesh is even, are a region; the noise
of a scan is measured first, and sets how nearly that is. A region's border is a polygon
in its plane, with holes.

Shapes: V vertices, F faces, E pairs of faces with an edge in common. Polygons are in
the frame P of their region: origin in its plane, z along the outward normal.
"""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from shapely.geometry.base import BaseGeometry

from clamber import _core
from clamber.model.records import short_repr
from clamber.model.se3 import frame_from_normal

SMOOTH = 0.006  # [m] a triangle of an even mesh is no farther from its region's plane
ROUGHEST = 0.010  # [m] ... of any mesh
SIGMAS = 3.0  # of the noise, that a triangle may be off
TURN = math.radians(18.0)  # between a triangle's normal and its region's
NOISY_TURN = math.radians(32.0)  # ... where there is noise
CELL = 0.020  # [m] a noisy mesh that is finer is put together to this
ROUNDS = 8  # of smoothing what is noisy
ALIKE = 0.2  # square of the distance of normals that are alike
BLURRED = 0.5  # ... under the most noise
FINE = 0.06  # [m] longer edges say nothing of noise
SMALL = 1.5e-3  # [m^2] a smaller region joins one beside it, where it can
BORDER = 0.006  # [m] by which borders are straightened


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Region:
    """Triangles in one plane.

    Attributes:
        origin: (3,) of P.
        rotation: (3, 3) R_WP.
        shape: A polygon in P, or several.
        part: Which connected part of the mesh it is of.
        ragged: Its border is so uneven for noise [m].
    """

    origin: np.ndarray
    rotation: np.ndarray
    shape: BaseGeometry
    part: int
    ragged: float

    __repr__ = short_repr

    @property
    def normal(self) -> np.ndarray:
        """(3,) outward, in the world."""
        return self.rotation[:, 2]

    def world(self, ring: np.ndarray, z: float = 0.0) -> np.ndarray:
        """(K, 3) in the world of points (K, 2) at a height."""
        return self.origin + ring @ self.rotation[:, :2].T + z * self.normal

    def local(self, points: np.ndarray) -> np.ndarray:
        """(..., 3) in P of points in the world."""
        return (points - self.origin) @ self.rotation


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Surface:
    """Triangles as regions are made of them: of a scan, without most of its noise.

    Attributes:
        vertices: (V, 3) [m].
        faces: (F, 3).
        pairs: (E, 2) faces with an edge in common.
        part: (F,) which connected part each is of.
        noisy: It is of a scan.
    """

    vertices: np.ndarray
    faces: np.ndarray
    pairs: np.ndarray
    part: np.ndarray
    noisy: bool

    __repr__ = short_repr


def find_regions(
    vertices: np.ndarray, faces: np.ndarray
) -> tuple[Surface, list[Region]]:
    """The planar regions of triangles, the flattest first.

    Args:
        vertices: (V, 3) [m].
        faces: (F, 3) counter-clockwise seen from outside.
    """
    beside = neighbours(faces, vertices)
    reach, turn = _evenness(vertices, faces, *beside)
    alike = ALIKE if reach < ROUGHEST else BLURRED
    if turn > TURN:
        if _median_edge(vertices, faces) < 0.9 * CELL:
            vertices, faces = merged(vertices, faces, CELL)
            beside, alike = neighbours(faces), BLURRED
        vertices = _denoised(vertices, faces, beside[0], alike)
    n = len(faces)
    links = coo_array((np.ones(len(beside[0])), tuple(beside[0].T)), shape=(n, n))
    part = connected_components(links, directed=False)[1]
    surface = Surface(
        vertices=vertices, faces=faces, pairs=beside[0], part=part, noisy=turn > TURN
    )
    return surface, _regions(vertices, faces, beside[0], part, reach, turn, alike)


def neighbours(
    faces: np.ndarray, vertices: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """(E, 2) faces with an edge in common, and (E, 2) which edge of each that is.

    Edge k of a face goes from its vertex k to the next. Where more than two faces meet,
    as solids do that touch along an edge, those are neighbours that have the same solid
    between them, where `vertices` are given.
    """
    a, b = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    low, high = np.minimum(a, b).astype(np.int64), np.maximum(a, b)
    key = low * (int(faces.max()) + 1) + high
    order = np.argsort(key, kind="stable")
    starts = np.flatnonzero(np.diff(key[order], prepend=-1))
    count = np.diff(starts, append=len(order))
    two = starts[count == 2]
    more: list[tuple[int, int]] = []
    for start, n in zip(starts[count > 2], count[count > 2], strict=True):
        some = order[start : start + n]
        along = a[some] == low[some]
        if vertices is None or 2 * along.sum() != n:  # no surfaces of solids
            found = list(itertools.pairwise(some.tolist()))
        else:
            found = _around(vertices, faces, some, along)
        more += found
    pairs = np.stack([order[two], order[two + 1]], axis=1)
    pairs = np.concatenate([pairs, np.array(more, dtype=np.int64).reshape(-1, 2)])
    return pairs // 3, pairs % 3


def _around(
    vertices: np.ndarray, faces: np.ndarray, half: np.ndarray, along: np.ndarray
) -> list[tuple[int, int]]:
    """Pairs of neighbours among half-edges (n,) of one edge, by angle about it.

    From a face that has the edge `along` it, the solid is on the side to which one
    turns with the clock, as far as the next face that has it the other way round.
    """
    first = half[np.argmax(along)]
    p, q = vertices[faces[first // 3, [first % 3, (first % 3 + 1) % 3]]]
    axis = (q - p) / max(float(np.linalg.norm(q - p)), 1e-12)
    far = vertices[faces[half // 3, (half % 3 + 2) % 3]] - p
    far = far - np.outer(far @ axis, axis)
    x = far[0] / max(float(np.linalg.norm(far[0])), 1e-12)
    angle = np.arctan2(far @ np.cross(axis, x), far @ x)
    out, free = [], list(np.flatnonzero(~along))
    for i in np.flatnonzero(along):
        if not free:
            break
        turn = [(angle[i] - angle[j] - 1e-6) % (2 * np.pi) for j in free]
        out.append((int(half[i]), int(half[free.pop(int(np.argmin(turn)))])))
    return out


def face_normals(
    vertices: np.ndarray, faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(F, 3) unit normals and (F,) areas [m^2].

    Args:
        vertices: (V, 3) [m].
        faces: (F, 3) counter-clockwise seen from outside.
    """
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    n = np.cross(b - a, c - a)
    length = np.linalg.norm(n, axis=1)
    return n / np.maximum(length, 1e-300)[:, None], length / 2


def _evenness(
    vertices: np.ndarray, faces: np.ndarray, pairs: np.ndarray, edge: np.ndarray
) -> tuple[float, float]:
    """Tolerances of plane fitting: distance [m] and angle [rad], from the mesh's noise.

    In a plane with noise sigma, the far vertex of a neighbour is off a triangle's plane
    by about two sigma; at real edges by more, so that the lower quartile is looked at.
    """
    if len(pairs) == 0:
        return SMOOTH, TURN
    normals, _ = face_normals(vertices, faces)
    corners = vertices[faces]
    longest = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).max(axis=1)
    fine = (longest[pairs] < FINE).all(axis=1)
    if fine.mean() < 0.5:
        return SMOOTH, TURN
    (a, b), far = pairs[fine].T, (edge[fine, 1] + 2) % 3
    off = np.abs(np.sum((corners[b, far] - corners[a, 0]) * normals[a], axis=1))
    sigma = float(np.quantile(off, 0.25)) / 0.64
    reach = float(np.clip(SIGMAS * sigma, SMOOTH, ROUGHEST))
    return reach, TURN if SIGMAS * sigma < SMOOTH else NOISY_TURN


def _smoothed(
    normals: np.ndarray,
    areas: np.ndarray,
    pairs: np.ndarray,
    rounds: int,
    alike: float,
) -> np.ndarray:
    """Normals averaged with those of neighbours that are alike."""
    a, b = pairs.T
    for _ in range(rounds):
        share = np.exp(-np.sum((normals[a] - normals[b]) ** 2, axis=1) / alike)
        out = normals * areas[:, None]
        for one, other in ((a, b), (b, a)):
            weight = share * areas[other]
            for k in range(3):
                out[:, k] += np.bincount(one, weight * normals[other, k], len(normals))
        normals = out / np.maximum(np.linalg.norm(out, axis=1), 1e-300)[:, None]
    return normals


def _median_edge(vertices: np.ndarray, faces: np.ndarray) -> float:
    """[m]: noise on shorter edges turns triangles any way."""
    corners = vertices[faces]
    edges = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
    return float(np.median(edges))


def averaged(vertices: np.ndarray, faces: np.ndarray, rounds: int) -> np.ndarray:
    """Vertices (V, 3), each the mean of itself and of those beside it, some times.

    Args:
        vertices: (V, 3) [m].
        faces: (F, 3).
        rounds: How often.
    """
    a, b = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    count = 1.0 + np.bincount(a, minlength=len(vertices))
    for _ in range(rounds):
        beside = [np.bincount(a, v[b], len(vertices)) for v in vertices.T]
        vertices = (vertices + np.stack(beside, axis=1)) / count[:, None]
    return vertices


def merged(
    vertices: np.ndarray, faces: np.ndarray, cell: float
) -> tuple[np.ndarray, np.ndarray]:
    """A mesh whose vertices in one cell of a grid are one, in their middle.

    Args:
        vertices: (V, 3) [m].
        faces: (F, 3).
        cell: Side of the grid's cells [m].
    """
    at = np.floor((vertices - vertices.min(axis=0)) / cell).astype(np.int64)
    nx, ny, _ = at.max(axis=0) + 1
    key = at[:, 0] + nx * (at[:, 1] + ny * at[:, 2])
    _, index, count = np.unique(key, return_inverse=True, return_counts=True)
    out = [np.bincount(index, vertices[:, k]) / count for k in range(3)]
    faces = index[faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    return np.stack(out, axis=1), faces[np.sort(first)]


def _denoised(
    vertices: np.ndarray, faces: np.ndarray, pairs: np.ndarray, alike: float
) -> np.ndarray:
    """Vertices moved so that triangles have the normals that are smoothed."""
    normals, areas = face_normals(vertices, faces)
    soft = _smoothed(normals, areas, pairs, ROUNDS, alike)
    count = np.maximum(np.bincount(faces.ravel(), minlength=len(vertices)), 1)
    for _ in range(ROUNDS):
        centre = vertices[faces].mean(axis=1)
        move = np.zeros_like(vertices)
        for k in range(3):
            v = faces[:, k]
            by = np.sum((centre - vertices[v]) * soft, axis=1)[:, None] * soft
            for x in range(3):
                move[:, x] += np.bincount(v, by[:, x], len(vertices))
        vertices = vertices + move / count[:, None]
    return vertices


def _regions(
    vertices: np.ndarray,
    faces: np.ndarray,
    pairs: np.ndarray,
    part: np.ndarray,
    reach: float,
    turn: float,
    alike: float,
) -> list[Region]:
    """Planar regions, in the order in which they were found: the flattest first."""
    normals, areas = face_normals(vertices, faces)
    n = len(faces)
    soft = _smoothed(normals, areas, pairs, 4 if turn > TURN else 0, alike)
    ends = np.concatenate([pairs, pairs[:, ::-1]])
    bend = 1.0 - np.sum(soft[ends[:, 0]] * soft[ends[:, 1]], axis=1)
    bent = np.bincount(ends[:, 0], bend, n) / np.maximum(
        np.bincount(ends[:, 0], minlength=n), 1
    )
    order = np.lexsort([-areas, np.round(bent, 4)])
    ends = ends[np.argsort(ends[:, 0], kind="stable")]
    first = np.concatenate([[0], np.cumsum(np.bincount(ends[:, 0], minlength=n))])
    label = _core.grow_planes(
        np.ascontiguousarray(vertices[faces]),
        np.ascontiguousarray(soft),
        areas,
        first.astype(np.int32),
        np.ascontiguousarray(ends[:, 1], dtype=np.int32),
        order.astype(np.int32),
        reach,
        math.cos(turn),
    )
    label = _joined(vertices, faces, normals, areas, pairs, label, reach)
    ragged = ROUGHEST if turn > TURN else 0.0
    return _bordered(vertices, faces, normals, areas, label, part, ragged)


def _joined(
    vertices: np.ndarray,
    faces: np.ndarray,
    normals: np.ndarray,
    areas: np.ndarray,
    pairs: np.ndarray,
    label: np.ndarray,
    reach: float,
) -> np.ndarray:
    """Labels (F,) without most of the small regions: they join a larger one beside."""
    size = np.bincount(label, areas)
    a, b = label[pairs].T
    beside: dict[int, set[int]] = {}
    for x, y in {(int(x), int(y)) for x, y in zip(a, b, strict=True) if x != y}:
        for one, other in ((x, y), (y, x)):
            if size[one] < SMALL and size[other] > size[one]:
                beside.setdefault(one, set()).add(other)
    if not beside:
        return label
    order = np.argsort(label, kind="stable")
    start = np.searchsorted(label[order], np.arange(len(size) + 1))
    centre = vertices[faces].mean(axis=1)
    known: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def plane(i: int) -> tuple[np.ndarray, np.ndarray]:
        if i not in known:
            mine = order[start[i] : start[i + 1]]
            w = areas[mine] + 1e-12
            normal = w @ normals[mine]
            normal /= max(float(np.linalg.norm(normal)), 1e-12)
            known[i] = (w @ centre[mine]) / w.sum(), normal
        return known[i]

    target = np.arange(len(size))
    for i in sorted(beside, key=lambda i: (size[i], i)):
        corners = vertices[faces[order[start[i] : start[i + 1]]]].reshape(-1, 3)
        best = 2.0 * reach
        for j in sorted(beside[i]):
            middle, normal = plane(j)
            off = float(np.abs((corners - middle) @ normal).max())
            if off < best:
                best, target[i] = off, j
    while not np.array_equal(target[target], target):
        target = target[target]
    return target[label]


def _bordered(
    vertices: np.ndarray,
    faces: np.ndarray,
    normals: np.ndarray,
    areas: np.ndarray,
    label: np.ndarray,
    part: np.ndarray,
    ragged: float,
) -> list[Region]:
    """The regions of labels (F,), each with the plane that fits it and its border.

    Borders of noisy meshes are `ragged` by so much [m].
    """
    border = _borders(faces, label)
    order = np.argsort(label, kind="stable")
    out = []
    for mine in np.split(order, np.flatnonzero(np.diff(label[order])) + 1):
        w = areas[mine]
        if w.sum() < 1e-8:
            continue
        corners = vertices[faces[mine]]
        origin = (w @ corners.mean(axis=1)) / w.sum()
        normal = w @ normals[mine]
        length = float(np.linalg.norm(normal))
        if length < 0.3 * w.sum():
            continue  # folded: the one side and the other
        normal = _fitted(corners, w, origin, normal / length)
        R = frame_from_normal(normal, [1.0, 0.0, 0.0])
        flat = ((corners - origin) @ R)[..., :2]
        ends = np.stack([flat, np.roll(flat, -1, axis=1)], axis=2)[border[mine]]
        shape = _area_in(ends, flat, ragged)
        if not shape.is_empty:
            out.append(
                Region(
                    origin=origin,
                    rotation=R,
                    shape=shape,
                    part=int(part[mine[0]]),
                    ragged=ragged,
                )
            )
    return out


def _borders(faces: np.ndarray, label: np.ndarray) -> np.ndarray:
    """(F, 3) edges that an odd number of faces with one label have: closed lines."""
    a, b = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    size = np.int64(faces.max()) + 1
    key = np.minimum(a, b) * size + np.maximum(a, b)
    of = np.repeat(label, 3)
    order = np.lexsort([key, of])
    new = (np.diff(key[order], prepend=-1) != 0) | (np.diff(of[order], prepend=-1) != 0)
    starts = np.flatnonzero(new)
    count = np.diff(starts, append=len(order))
    out = np.zeros(len(key), dtype=bool)
    out[order[starts[count % 2 == 1]]] = True
    return out.reshape(-1, 3)


def _fitted(
    corners: np.ndarray, w: np.ndarray, origin: np.ndarray, normal: np.ndarray
) -> np.ndarray:
    """The normal (3,) of the plane through triangles (n, 3, 3), close to `normal`."""
    x = (corners - origin).reshape(-1, 3)
    values, axes = np.linalg.eigh((x * np.repeat(w, 3)[:, None]).T @ x)
    best = axes[:, 0] * (np.sign(axes[:, 0] @ normal) or 1.0)
    return best if values[1] > 4 * values[0] and best @ normal > 0.9 else normal


def _area_in(ends: np.ndarray, triangles: np.ndarray, ragged: float) -> BaseGeometry:
    """Area inside border segments (n, 2, 2), straightened, small holes closed.

    Where lines cross, as the folds of a noisy border do, it is the cells between them
    that have a triangle (m, 3, 2) over them.
    """
    area = float(np.abs(_doubled_area(triangles)).sum() / 2)
    lines = shapely.MultiLineString(list(ends))
    shape = shapely.Polygon()
    if ragged == 0.0:
        with contextlib.suppress(shapely.errors.GEOSException):
            shape = shapely.build_area(lines)
    if not shape.is_valid or abs(shape.area - area) > 0.05 * area:
        cells = shapely.get_parts(shapely.polygonize([shapely.node(lines)]))
        faces: Any = shapely.polygons(triangles)  # an array, for an array of rings
        tree = shapely.STRtree(faces)
        full = tree.query(shapely.point_on_surface(cells), predicate="intersects")[0]
        shape = shapely.coverage_union_all(cells[np.unique(full)])
    if ragged > 0.0:
        even = shape.buffer(ragged, join_style="mitre", mitre_limit=2.0)
        even = even.buffer(-2.0 * ragged, join_style="mitre", mitre_limit=2.0)
        even = even.buffer(ragged, join_style="mitre", mitre_limit=2.0)
        shape = shape if even.is_empty else even
    return tidied(shape, max(BORDER, ragged))


def _doubled_area(triangles: np.ndarray) -> np.ndarray:
    u, v = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    return u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]


def tidied(shape: BaseGeometry, border: float = BORDER) -> BaseGeometry:
    """Polygons straightened by `border` [m], without slits, slivers and pinholes."""
    kept = [p for p in polygons_in(shape) if p.area > 1e-6]
    kept = [
        shapely.Polygon(p.exterior, [h for h in p.interiors if _ring_area(h) > 4e-4])
        for p in kept
    ]
    return shapely.make_valid(shapely.union_all(kept).simplify(border))


def _ring_area(ring: shapely.LinearRing) -> float:
    return float(shapely.Polygon(ring).area)


def polygons_in(shape: BaseGeometry) -> Iterator[shapely.Polygon]:
    """Polygons of a shape, without its points and lines."""
    for g in shapely.get_parts(shape):
        if isinstance(g, shapely.Polygon):
            yield g
        elif isinstance(g, shapely.MultiPolygon | shapely.GeometryCollection):
            yield from polygons_in(g)
