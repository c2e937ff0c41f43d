"""Planar regions of a triangle mesh -> supports to stand on, convex pieces to hit.

The polygons of `regions` are cut into convex parts. Each part, made solid to the inside
of the mesh, is a piece that links keep clear of and that physics collides with; a
closed part of the mesh that is convex itself is one piece as it is. What of the regions
is level enough, wide enough and not covered is a support.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import shapely
from scipy.spatial import ConvexHull, QhullError
from shapely.geometry.base import BaseGeometry

from clamber.model.fields import field_of, is_seen_from_above
from clamber.model.regions import (
    BORDER,
    Region,
    Surface,
    find_regions,
    polygons_in,
    tidied,
)
from clamber.model.scene import EVEN, HeightField, Mesh, Rejected, Support

FILL = 0.008  # [m] of a notch in a border that a convex part may fill
NARROW = 0.022  # [m] radius of the smallest disc that has room on a support
STEEPEST = 0.02  # of a normal's z below which a face is a wall
COVERED = 0.12  # [m] what is nearer over a support leaves no room for a limb
DEEPEST = 0.4  # [m] of a piece under its region
SHEET = 0.006  # [m] ... and the least
LISTED = 0.01  # [m^2] a smaller region that is no support is not worth a word
FLAT_ENOUGH = 0.003  # [m] from a convex hull, of a part that is convex


def mesh_of(
    name: str,
    vertices: np.ndarray,
    faces: np.ndarray,
    *,
    friction: float,
    roughness: float = 0.0,
    field: HeightField | None = None,
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
        field: Heights that the triangles are of, where they are.
        notes: What was mended, a sentence each.
    """
    surface, regions = find_regions(vertices, faces)
    pieces, of_part = _convex_parts(surface)
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
    if not surface.noisy:
        field = None
    elif field is None and is_seen_from_above(surface.vertices, surface.faces):
        field = field_of(vertices, faces)
    return Mesh(
        name=name,
        pieces=tuple(pieces),
        supports=tuple(supports),
        under=tuple(first),
        field=field,
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


# Polygons -> convex parts.


def _convex_rings(shape: BaseGeometry, ragged: float) -> list[np.ndarray]:
    """Convex polygons (K, 2), counter-clockwise, that make up polygons.

    Notches in their borders are filled, deeper ones where borders are `ragged` [m].
    """
    fill = max(FILL, 2.0 * ragged)
    out = []
    for polygon in polygons_in(shape):
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
    """Indices of the points (n, 2) on their convex hull, counter-clockwise."""
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


def _convex_parts(surface: Surface) -> tuple[list[np.ndarray], dict[int, int]]:
    """Corners (K, 3) of the connected parts that are convex, and which each is."""
    vertices, faces = surface.vertices, surface.faces
    pairs, part = surface.pairs, surface.part
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
    regions: Sequence[Region], tops: Sequence[tuple[int, np.ndarray]]
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
    region: Region, ring: np.ndarray, others: Sequence[np.ndarray]
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
    """Least depth within a shape of a plane through corners (m, 3), in P [m]."""
    at = shapely.get_coordinates(shape)
    if len(at) == 0:
        return math.inf
    X = np.column_stack([corners[:, :2], np.ones(len(corners))])
    plane = np.linalg.lstsq(X, corners[:, 2], rcond=None)[0]
    return float(-(at @ plane[:2] + plane[2]).max())


# Regions -> supports.


def _supports(
    regions: Sequence[Region], pieces: Sequence[np.ndarray], friction: float
) -> tuple[list[tuple[int, np.ndarray]], list[Rejected]]:
    """Region and convex polygon (K, 2) of each support; what is none, and why."""
    found, rejected = [], []
    middle, radius = _balls(pieces)
    corners = np.concatenate([*pieces, np.zeros((0, 3))])
    first = np.cumsum([0, *(len(p) for p in pieces)])[:-1]
    for i, region in enumerate(regions):
        if region.normal[2] < STEEPEST:
            continue

        def reject(shape: BaseGeometry, why: str, region: Region = region) -> None:
            for polygon in polygons_in(shape):
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
        z = (corners - region.origin) @ region.normal
        near = np.linalg.norm(middle - centre, axis=1) < reach + COVERED
        near &= np.maximum.reduceat(z, first) > EVEN
        over = (_over(region.local(pieces[k])) for k in np.flatnonzero(near).tolist())
        covers = [c for c in over if c is not None]
        left = shape.difference(shapely.union_all(covers)) if covers else shape
        left = tidied(left)
        reject(shape.difference(left.buffer(BORDER)), "covered")
        for polygon in polygons_in(_shrunk(left, region.ragged)):
            for ring in _convex_rings(tidied(polygon), region.ragged):
                if shapely.Polygon(ring).buffer(-NARROW).is_empty:
                    reject(shapely.Polygon(ring), "too narrow")
                else:
                    found.append((i, ring))
    return found, rejected


def _shrunk(shape: BaseGeometry, ragged: float) -> BaseGeometry:
    """Without what is thinner than a hair, and where noise may have added to it."""
    inner = shape.buffer(-1e-3 - ragged, join_style="mitre")
    return inner.buffer(1e-3, join_style="mitre")


def _above_ground(region: Region) -> BaseGeometry:
    """Part of a region that is above the ground z = 0, by more than `EVEN` / 2."""
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
    """Outline of a convex piece (K, 3), in P, at heights from `EVEN` to `COVERED`."""
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


def _support(name: str, region: Region, ring: np.ndarray, friction: float) -> Support:
    """The record, its origin in the middle of the polygon."""
    middle = np.array(shapely.Polygon(ring).centroid.coords)[0]
    return Support(
        name=name,
        position=region.world(middle[None])[0],
        rotation=region.rotation,
        polygon=ring - middle,
        friction=friction,
    )
