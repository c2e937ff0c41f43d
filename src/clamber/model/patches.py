"""A triangle mesh -> its planar regions: supports to stand on, convex pieces to hit.

Triangles that lie in one plane, as nearly as the mesh is even, are a region; the noise
of a scan is measured first, and sets how nearly that is. A region's border is a
polygon in its plane, with holes, cut into convex parts. Each part, made solid to the
inside of the mesh, is a piece that links keep clear of and that physics collides with;
a closed part of the mesh that is convex itself is one piece as it is. What of the
regions is level enough, wide enough and not covered is a support.

Shapes: V vertices, F faces, E pairs of faces with an edge in common. Polygons are in
the frame P of their region: origin in its plane, z along the outward normal.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError
from shapely.geometry.base import BaseGeometry

from clamber import _core
from clamber.model.records import short_repr
from clamber.model.scene import Mesh, Rejected, Support
from clamber.model.se3 import frame_from_normal

SMOOTH = 0.006  # [m] a triangle of an even mesh is no farther from its region's plane
ROUGHEST = 0.010  # [m] ... of any mesh
SIGMAS = 3.0  # of the noise, that a triangle may be off
TURN = math.radians(18.0)  # between a triangle's normal and its region's
NOISY_TURN = math.radians(32.0)  # ... where there is noise
CELL = 0.020  # [m] a noisy mesh is not looked at more finely
ROUNDS = 8  # of smoothing what is noisy
FINE = 0.06  # [m] longer edges say nothing of noise
SMALL = 1.5e-3  # [m^2] a smaller region joins one beside it, where it can
BORDER = 0.006  # [m] by which borders are straightened
FILL = 0.008  # [m] of a notch in a border that a convex part may fill
NARROW = 0.022  # [m] radius of the smallest disc that has room on a support
STEEPEST = 0.02  # of a normal's z below which a face is a wall
COVERED = 0.12  # [m] what is nearer over a support leaves no room for a limb
EVEN = 0.012  # [m] what rises less from a support belongs to it
DEEPEST = 0.4  # [m] of a piece under its region
SHEET = 0.006  # [m] ... and the least
LISTED = 0.01  # [m^2] a smaller region that is no support is not worth a word
FLAT_ENOUGH = 0.003  # [m] from a convex hull, of a part that is convex


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class _Region:
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
        return self.rotation[:, 2]

    def world(self, ring: np.ndarray, z: float = 0.0) -> np.ndarray:
        """(K, 3) in the world of points (K, 2) at a height."""
        return self.origin + ring @ self.rotation[:, :2].T + z * self.normal

    def local(self, points: np.ndarray) -> np.ndarray:
        """(..., 3) in P of points in the world."""
        return (points - self.origin) @ self.rotation


def mesh_of(
    name: str,
    vertices: np.ndarray,
    faces: np.ndarray,
    *,
    friction: float,
    roughness: float = 0.0,
    notes: tuple[str, ...] = (),
) -> Mesh:
    """The terrain that triangles are the surface of.

    Args:
        name: Its supports are called by it, with a number where there are several: the
            largest is the first.
        vertices: (V, 3) in the world [m].
        faces: (F, 3) counter-clockwise seen from outside.
        friction: Coulomb coefficient.
        roughness: Unevenness beyond what the triangles show [m].
        notes: What was mended, a sentence each.
    """
    beside = neighbours(faces, vertices)
    reach, turn = _evenness(vertices, faces, *beside)
    if turn > TURN:
        if _median_edge(vertices, faces) < CELL:
            vertices, faces = merged(vertices, faces, CELL)
            beside = neighbours(faces)
        vertices = _denoised(vertices, faces, beside[0])
    n = len(faces)
    links = coo_array((np.ones(len(beside[0])), tuple(beside[0].T)), shape=(n, n))
    part = connected_components(links, directed=False)[1]
    regions = _regions(vertices, faces, *beside, part, reach, turn)
    pieces, of_part = _convex_parts(vertices, faces, beside[0], part)
    under: dict[int, list[int]] = {}  # of each region, its pieces
    tops: list[tuple[int, np.ndarray]] = []  # region and ring of what is not convex
    for i, region in enumerate(regions):
        if region.part in of_part:
            under[i] = [of_part[region.part]]
            continue
        for ring in _convex_rings(region.shape, region.ragged):
            under.setdefault(i, []).append(len(pieces) + len(tops))
            tops.append((i, ring))
    pieces += _solids(regions, tops)
    found, rejected = _supports(regions, pieces, friction)
    found.sort(key=lambda f: -shapely.Polygon(f[1]).area)
    supports, first = [], []
    for k, (i, ring) in enumerate(found):
        called = name if len(found) == 1 else f"{name}_{k + 1}"
        support = _support(called, regions[i], ring, friction)
        supports.append(support)
        first.append(min(under[i], key=lambda p: _beside(pieces[p], support)))
    return Mesh(
        name=name,
        pieces=tuple(pieces),
        supports=tuple(supports),
        under=tuple(first),
        friction=friction,
        roughness=roughness,
        rejected=tuple(rejected),
        notes=notes,
    )


def _beside(piece: np.ndarray, support: Support) -> float:
    """From the middle of a piece (K, 3) to that of a support [m]."""
    top = piece[support.height(piece) > -EVEN]
    top = piece if len(top) == 0 else top
    return float(np.linalg.norm(top.mean(axis=0) - support.position))


# Triangles -> regions.


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
    """Which half-edges (n,) of one edge are neighbours, by angles about it.

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


def _normals(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(F, 3) unit normals and (F,) areas."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    n = np.cross(b - a, c - a)
    length = np.linalg.norm(n, axis=1)
    return n / np.maximum(length, 1e-300)[:, None], length / 2


def _evenness(
    vertices: np.ndarray, faces: np.ndarray, pairs: np.ndarray, edge: np.ndarray
) -> tuple[float, float]:
    """How far triangles may be from their plane [m], and turned from it [rad].

    In a plane with noise sigma, the far vertex of a neighbour is off a triangle's plane
    by about two sigma; at real edges by more, so that the lower quartile is looked at.
    """
    if len(pairs) == 0:
        return SMOOTH, TURN
    normals, _ = _normals(vertices, faces)
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
    normals: np.ndarray, areas: np.ndarray, pairs: np.ndarray, rounds: int
) -> np.ndarray:
    """Normals averaged with those of neighbours that are alike."""
    a, b = pairs.T
    for _ in range(rounds):
        alike = np.exp(-np.sum((normals[a] - normals[b]) ** 2, axis=1) / 0.5)
        out = normals * areas[:, None]
        for one, other in ((a, b), (b, a)):
            weight = alike * areas[other]
            for k in range(3):
                out[:, k] += np.bincount(one, weight * normals[other, k], len(normals))
        normals = out / np.maximum(np.linalg.norm(out, axis=1), 1e-300)[:, None]
    return normals


def _median_edge(vertices: np.ndarray, faces: np.ndarray) -> float:
    """[m]: noise on shorter edges turns triangles any way."""
    corners = vertices[faces]
    edges = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
    return float(np.median(edges))


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


def _denoised(vertices: np.ndarray, faces: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Vertices moved so that triangles have the normals that are smoothed."""
    normals, areas = _normals(vertices, faces)
    soft = _smoothed(normals, areas, pairs, ROUNDS)
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
    edge: np.ndarray,
    part: np.ndarray,
    reach: float,
    turn: float,
) -> list[_Region]:
    """Planar regions, in the order in which they were found: the flattest first."""
    normals, areas = _normals(vertices, faces)
    n = len(faces)
    soft = _smoothed(normals, areas, pairs, 4 if turn > TURN else 0)
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
    ragged = reach if turn > TURN else 0.0
    return _bordered(vertices, faces, normals, areas, pairs, edge, label, part, ragged)


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
    pairs: np.ndarray,
    edge: np.ndarray,
    label: np.ndarray,
    part: np.ndarray,
    ragged: float,
) -> list[_Region]:
    """The regions of labels (F,), each with the plane that fits it and its border.

    Borders of noisy meshes are `ragged` by so much [m].
    """
    inner = np.zeros((len(faces), 3), dtype=bool)
    same = label[pairs[:, 0]] == label[pairs[:, 1]]
    for k in range(2):
        inner[pairs[same, k], edge[same, k]] = True
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
        ends = np.stack([flat, np.roll(flat, -1, axis=1)], axis=2)[~inner[mine]]
        shape = _area_in(ends, flat, ragged)
        if not shape.is_empty:
            out.append(
                _Region(
                    origin=origin,
                    rotation=R,
                    shape=shape,
                    part=int(part[mine[0]]),
                    ragged=ragged,
                )
            )
    return out


def _fitted(
    corners: np.ndarray, w: np.ndarray, origin: np.ndarray, normal: np.ndarray
) -> np.ndarray:
    """The normal (3,) of the plane through triangles (n, 3, 3), close to `normal`."""
    x = (corners - origin).reshape(-1, 3)
    values, axes = np.linalg.eigh((x * np.repeat(w, 3)[:, None]).T @ x)
    best = axes[:, 0] * (np.sign(axes[:, 0] @ normal) or 1.0)
    return best if values[1] > 4 * values[0] and best @ normal > 0.9 else normal


def _area_in(ends: np.ndarray, triangles: np.ndarray, ragged: float) -> BaseGeometry:
    """What is inside border lines (n, 2, 2), straightened, small holes closed.

    Where lines cross, as the folds of a noisy border do, the triangles (m, 3, 2) are
    put together instead.
    """
    area = float(np.abs(_doubled_area(triangles)).sum() / 2)
    lines = shapely.MultiLineString(list(ends))
    for crossing in (False, True):
        try:
            shape = shapely.build_area(shapely.node(lines) if crossing else lines)
        except shapely.errors.GEOSException:
            continue
        if shape.is_valid and abs(shape.area - area) < 0.05 * area:
            break
    else:
        shape = shapely.union_all(shapely.make_valid(shapely.polygons(triangles)))
    if ragged > 0.0:
        even = shape.buffer(ragged, join_style="mitre", mitre_limit=2.0)
        even = even.buffer(-2.0 * ragged, join_style="mitre", mitre_limit=2.0)
        even = even.buffer(ragged, join_style="mitre", mitre_limit=2.0)
        shape = shape if even.is_empty else even
    return _tidied(shape, max(BORDER, ragged))


def _doubled_area(triangles: np.ndarray) -> np.ndarray:
    u, v = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    return u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]


def _tidied(shape: BaseGeometry, border: float = BORDER) -> BaseGeometry:
    """Polygons with few corners, without slits, slivers and pinholes."""
    kept = [p for p in _polygons(shape) if p.area > 1e-6]
    kept = [
        shapely.Polygon(p.exterior, [h for h in p.interiors if _ring_area(h) > 4e-4])
        for p in kept
    ]
    return shapely.make_valid(shapely.union_all(kept).simplify(border))


def _ring_area(ring: shapely.LinearRing) -> float:
    return float(shapely.Polygon(ring).area)


def _polygons(shape: BaseGeometry) -> Iterator[shapely.Polygon]:
    for g in shapely.get_parts(shape):
        if isinstance(g, shapely.Polygon):
            yield g
        elif isinstance(g, shapely.MultiPolygon | shapely.GeometryCollection):
            yield from _polygons(g)


# Polygons -> convex parts.


def _convex_rings(shape: BaseGeometry, ragged: float) -> list[np.ndarray]:
    """Convex polygons (K, 2), counter-clockwise, that make up polygons.

    Notches in their borders are filled, deeper ones where borders are `ragged` [m].
    """
    fill = max(FILL, 2.0 * ragged)
    out = []
    for polygon in _polygons(shape):
        hull = polygon.convex_hull
        if polygon.buffer(fill).covers(hull):
            rings = [_ring(hull)]
        else:
            rings = _merged(polygon, fill)
        out += [r for r in map(_strict, rings) if r is not None]
    return out


def _ring(polygon: BaseGeometry) -> np.ndarray:
    """(K, 2) of its outer border, counter-clockwise."""
    ring = shapely.get_coordinates(shapely.get_exterior_ring(polygon))[:-1]
    return ring if _signed(ring) > 0 else ring[::-1]


def _signed(ring: np.ndarray) -> float:
    x, y = ring.T
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2


def _merged(polygon: shapely.Polygon, fill: float) -> list[np.ndarray]:
    """Triangles, put together over their longest common edges while that is convex."""
    cut = shapely.constrained_delaunay_triangles(polygon)
    triangles = [_ring(t) for t in shapely.get_parts(cut) if t.area > 1e-9]
    points, index = np.unique(
        np.round(np.concatenate(triangles), 9), axis=0, return_inverse=True
    )
    ids, at = [], 0
    for t in triangles:
        ids.append([int(i) for i in index[at : at + len(t)]])
        at += len(t)
    of_edge: dict[tuple[int, int], int] = {}
    for k, t in enumerate(ids):
        for a, b in zip(t, t[1:] + t[:1], strict=True):
            of_edge[a, b] = k
    inner = sorted(
        ((a, b) for a, b in of_edge if a < b and (b, a) in of_edge),
        key=lambda e: (-float(np.sum((points[e[0]] - points[e[1]]) ** 2)), e),
    )
    room = polygon.buffer(fill)
    shapely.prepare(room)
    root = list(range(len(ids)))

    def find(k: int) -> int:
        while root[k] != k:
            root[k] = root[root[k]]
            k = root[k]
        return k

    for a, b in inner:
        one, other = find(of_edge[a, b]), find(of_edge[b, a])
        if one == other:
            continue
        both = _hull(points, ids[one] + ids[other])
        if room.covers(shapely.Polygon(points[both])):
            ids[one], root[other] = both, one
    return [points[ids[k]] for k in range(len(ids)) if find(k) == k]


def _hull(points: np.ndarray, ids: list[int]) -> list[int]:
    """Of some points (n, 2), those on their convex hull, counter-clockwise."""
    order = sorted(set(ids), key=lambda i: (points[i, 0], points[i, 1]))
    out: list[int] = []
    for half in (order, order[::-1]):
        chain: list[int] = []
        for i in half:
            while len(chain) > 1 and _turns(points, chain[-2], chain[-1], i) <= 0:
                chain.pop()
            chain.append(i)
        out += chain[:-1]
    return out


def _turns(points: np.ndarray, a: int, b: int, c: int) -> float:
    (ax, ay), (bx, by), (cx, cy) = points[a], points[b], points[c]
    return (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)


def _strict(ring: np.ndarray) -> np.ndarray | None:
    """The ring without corners that are none; None where it has no area."""
    try:
        hull = ConvexHull(ring)
    except (QhullError, ValueError):
        return None
    out = ring[hull.vertices]
    before, after = out - np.roll(out, 1, axis=0), np.roll(out, -1, axis=0) - out
    cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    out = out[cross > 1e-9]
    return out if len(out) >= 3 and hull.volume > 1e-6 else None


# Regions -> solid pieces.


def _convex_parts(
    vertices: np.ndarray, faces: np.ndarray, pairs: np.ndarray, part: np.ndarray
) -> tuple[list[np.ndarray], dict[int, int]]:
    """Corners (K, 3) of the connected parts that are convex, and which each is."""
    count = int(part.max()) + 1
    closed = np.bincount(part[pairs[:, 0]], minlength=count) * 2
    closed = closed >= 3 * np.bincount(part, minlength=count)
    pieces: list[np.ndarray] = []
    of_part: dict[int, int] = {}
    order = np.argsort(part, kind="stable")
    for mine in np.split(order, np.flatnonzero(np.diff(part[order])) + 1):
        i = int(part[mine[0]])
        if not closed[i]:
            continue
        a, b, c = (vertices[faces[mine, k]] for k in range(3))
        volume = float(np.sum(a * np.cross(b, c)) / 6)
        corners = np.unique(faces[mine])
        try:
            hull = ConvexHull(vertices[corners])
        except QhullError:
            continue
        if hull.volume - abs(volume) < FLAT_ENOUGH * hull.area:
            of_part[i] = len(pieces)
            pieces.append(vertices[corners][hull.vertices])
    return pieces, of_part


def _solids(
    regions: Sequence[_Region], tops: Sequence[tuple[int, np.ndarray]]
) -> list[np.ndarray]:
    """Each convex top made solid: narrower with depth, no deeper than what is there."""
    if not tops:
        return []
    rings = [regions[i].world(ring) for i, ring in tops]
    middle, radius = _balls(rings)
    normal = np.array([regions[i].normal for i, _ in tops])
    out = []
    for k, (i, ring) in enumerate(tops):
        away = np.linalg.norm(middle - middle[k], axis=1)
        below = (middle - middle[k]) @ normal[k] - radius < -1e-4
        facing = (normal @ normal[k] < -0.05) & below
        others = np.flatnonzero(facing & (away < radius + radius[k] + DEEPEST))
        out.append(_solid(regions[i], ring, [rings[j] for j in others]))
    return out


def _balls(pieces: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Centre (n, 3) and radius (n,) of a ball around each piece (K, 3)."""
    middle = np.array([p.mean(axis=0) for p in pieces]).reshape(-1, 3)
    away = [np.linalg.norm(p - m, axis=1) for p, m in zip(pieces, middle, strict=True)]
    return middle, np.array([a.max() for a in away])


def _solid(
    region: _Region, ring: np.ndarray, others: Sequence[np.ndarray]
) -> np.ndarray:
    """(K, 3) of a top (n, 2) and of a bottom as deep as `others` (m, 3) allow."""
    top = shapely.Polygon(ring)
    bottoms = [region.local(o) for o in others]
    shapes = [shapely.Polygon(b[:, :2]).convex_hull for b in bottoms]
    depth = DEEPEST
    while depth > SHEET:
        inner = top.buffer(-depth, join_style="mitre")
        if inner.is_empty:
            inner = shapely.Point(top.centroid)
        room = min(
            (
                _depth_of(b, inner.intersection(s))
                for b, s in zip(bottoms, shapes, strict=True)
                if s.intersects(inner)
            ),
            default=math.inf,
        )
        if room >= depth - 1e-4:
            break
        depth = max(min(0.6 * depth, room), SHEET)
    inner = top.buffer(-depth, join_style="mitre")
    inner = inner if isinstance(inner, shapely.Polygon) else shapely.Polygon()
    if inner.is_empty or depth <= SHEET:
        spot = np.array(top.centroid.coords) if depth > SHEET else ring
    else:
        spot = _ring(inner.convex_hull)
    return np.concatenate([region.world(ring), region.world(spot, -depth)])


def _depth_of(corners: np.ndarray, shape: BaseGeometry) -> float:
    """How deep a plane through corners (m, 3), in P, is at the least in a shape [m]."""
    at = shapely.get_coordinates(shape)
    if len(at) == 0:
        return math.inf
    X = np.column_stack([corners[:, :2], np.ones(len(corners))])
    plane = np.linalg.lstsq(X, corners[:, 2], rcond=None)[0]
    return float(-(at @ plane[:2] + plane[2]).max())


# Regions -> supports.


def _supports(
    regions: Sequence[_Region], pieces: Sequence[np.ndarray], friction: float
) -> tuple[list[tuple[int, np.ndarray]], list[Rejected]]:
    """Region and convex polygon (K, 2) of each support; what is none, and why."""
    found, rejected = [], []
    middle, radius = _balls(pieces)
    for i, region in enumerate(regions):
        if region.normal[2] < STEEPEST:
            continue

        def reject(shape: BaseGeometry, why: str, region: _Region = region) -> None:
            for polygon in _polygons(shape):
                if polygon.area > LISTED:
                    outline = region.world(_ring(polygon))
                    rejected.append(Rejected(outline=outline, why=why))

        slope = math.acos(min(float(region.normal[2]), 1.0))
        if math.tan(slope) > friction:
            text = f"too steep: {math.degrees(slope):.0f} degrees"
            reject(region.shape, f"{text}, friction {friction:g}")
            continue
        if region.shape.buffer(-NARROW).is_empty:
            reject(region.shape, "too narrow")
            continue
        shape = _above_ground(region)
        reach = shapely.minimum_bounding_radius(shape) + radius
        around = shapely.minimum_bounding_circle(shape).centroid
        if shape.is_empty:
            continue
        centre = region.world(np.array(around.coords))[0]
        near = np.flatnonzero(np.linalg.norm(middle - centre, axis=1) < reach + COVERED)
        over = (_over(region.local(pieces[k])) for k in near.tolist())
        covers = [c for c in over if c is not None]
        left = shape.difference(shapely.union_all(covers)) if covers else shape
        left = _tidied(left)
        reject(shape.difference(left.buffer(BORDER)), "covered")
        for polygon in _polygons(_shrunk(left, region.ragged)):
            for ring in _convex_rings(_tidied(polygon), region.ragged):
                if shapely.Polygon(ring).buffer(-NARROW).is_empty:
                    reject(shapely.Polygon(ring), "too narrow")
                else:
                    found.append((i, ring))
    return found, rejected


def _shrunk(shape: BaseGeometry, ragged: float) -> BaseGeometry:
    """Without what is thinner than a hair, and where noise may have added to it."""
    inner = shape.buffer(-1e-3 - ragged, join_style="mitre")
    return inner.buffer(1e-3, join_style="mitre")


def _above_ground(region: _Region) -> BaseGeometry:
    """What of a region is over the plane z = 0, by more than it would be felt."""
    n = region.rotation[2]  # z of a point (x, y, 0) of P is origin + n . (x, y, 0)
    size, tilt = 100.0, float(np.hypot(n[0], n[1]))
    z = region.world(shapely.get_coordinates(region.shape))[:, 2]
    if z.min() >= EVEN / 2 or z.max() <= EVEN / 2:
        return region.shape if z.min() >= EVEN / 2 else shapely.Polygon()
    up = n[:2] / tilt
    line = up * ((EVEN / 2 - region.origin[2]) / tilt)
    side = size * np.array([-up[1], up[0]])
    corners = [line - side, line + side, line + side + 2 * size * up]
    half = shapely.Polygon([*corners, line - side + 2 * size * up])
    return region.shape.intersection(half)


def _over(points: np.ndarray) -> BaseGeometry | None:
    """What a convex piece (K, 3), in P, covers between `EVEN` and `COVERED` over it."""
    z = points[:, 2]
    if z.max() <= EVEN or z.min() >= COVERED:
        return None
    inside = [points[(z >= EVEN) & (z <= COVERED)]]
    for level in (EVEN, COVERED):
        low, high = points[z < level], points[z > level]
        if len(low) and len(high):
            share = (level - low[:, None, 2]) / (high[None, :, 2] - low[:, None, 2])
            cut = low[:, None] + share[..., None] * (high[None] - low[:, None])
            inside.append(cut.reshape(-1, 3))
    at = np.concatenate(inside)[:, :2]
    return shapely.MultiPoint(at).convex_hull.buffer(1e-4) if len(at) else None


def _support(name: str, region: _Region, ring: np.ndarray, friction: float) -> Support:
    """The record, its origin in the middle of the polygon."""
    middle = np.array(shapely.Polygon(ring).centroid.coords)[0]
    return Support(
        name=name,
        position=region.world(middle[None])[0],
        rotation=region.rotation,
        polygon=ring - middle,
        friction=friction,
    )


def moved(mesh: Mesh, by: np.ndarray) -> Mesh:
    """A mesh shifted by (3,) [m]."""
    return replace(
        mesh,
        pieces=tuple(p + by for p in mesh.pieces),
        supports=tuple(replace(s, position=s.position + by) for s in mesh.supports),
        rejected=tuple(replace(r, outline=r.outline + by) for r in mesh.rejected),
    )
