"""MjModel -> triangles: what a browser needs to draw a robot and its obstacles.

The geoms that MuJoCo's viewer shows are tessellated once, in the frame of their body,
and merged into one mesh a body. Meshes with more triangles than a page can carry are
simplified by clustering their vertices on a grid [Lindstrom00].

Shapes: N vertices, F triangles.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from clamber.model.boxes import grid_triangles
from clamber.model.records import short_repr
from clamber.model.world import World

SLICES, FEWEST_SLICES = 28, 6  # around a round geom
SHOWN_GROUPS = (0, 1, 2)  # of geoms, in MuJoCo's viewer
MAX_TRIANGLES = 60_000  # of all mesh geoms together
CREASE = math.radians(40.0)  # an edge that turns by more is sharp
NEAR_MEAN = 1e-2  # how much the vertex of a cell keeps to the middle of those in it
AROUND = 64  # faces around a vertex that are looked at
PLAIN = (0.5, 0.5, 0.5, 1.0)  # a geom's colour where it has none: its material's counts
PAD_COLOUR = (0.13, 0.14, 0.16, 1.0)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Mesh:
    """Triangles of one body.

    Attributes:
        body: Its id; 0 is the world, whose planes are left out.
        vertices: (N, 3) [m] and normals: (N, 3) in the body's frame.
        colours: (N, 3) in [0, 1].
        triangles: (F, 3) indices of vertices.
    """

    body: int
    vertices: np.ndarray
    normals: np.ndarray
    colours: np.ndarray
    triangles: np.ndarray

    __repr__ = short_repr


def body_poses(data: mujoco.MjData, meshes: Sequence[Mesh]) -> np.ndarray:
    """(nb, 7) position [m] and unit quaternion of the bodies of meshes."""
    bodies = [m.body for m in meshes]
    return np.concatenate([data.xpos[bodies], data.xquat[bodies]], axis=1)


_Triangles = tuple[np.ndarray, np.ndarray, np.ndarray]  # vertices, normals, triangles


def body_meshes(
    model: mujoco.MjModel,
    *,
    max_triangles: int = MAX_TRIANGLES,
    deviation: float = 0.0,
    pads: Collection[int] = (),
) -> list[Mesh]:
    """The visible geoms of each body, tessellated; bodies that show nothing left out.

    Args:
        model: Compiled.
        max_triangles: More than these in mesh geoms are simplified.
        deviation: That faces may be off a round geom [m]: small ones get fewer.
        pads: Geoms that are drawn as pads of rubber.
    """
    shown = np.flatnonzero(
        np.isin(model.geom_group, SHOWN_GROUPS)
        & (model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE)
        & np.array([geom_colour(model, g)[3] > 0 for g in range(model.ngeom)])
    )
    faces = sum(
        int(model.mesh_facenum[model.geom_dataid[g]])
        for g in shown
        if model.geom_dataid[g] >= 0
    )
    keep = min(1.0, max_triangles / max(faces, 1))
    by_body: dict[int, list[tuple[_Triangles, np.ndarray]]] = {}
    for g in shown:
        part = geom_triangles(model, int(g), keep, _slices(model, int(g), deviation))
        if part is not None:
            colour = np.array(PAD_COLOUR) if g in pads else geom_colour(model, int(g))
            parts = by_body.setdefault(int(model.geom_bodyid[g]), [])
            parts.append((part, colour[:3]))
    meshes = []
    for body, parts in sorted(by_body.items()):
        starts = np.cumsum([0, *(len(v) for (v, _, _), _ in parts)])
        meshes.append(
            Mesh(
                body=body,
                vertices=np.concatenate([v for (v, _, _), _ in parts]),
                normals=np.concatenate([n for (_, n, _), _ in parts]),
                colours=np.concatenate(
                    [np.tile(c, (len(v), 1)) for (v, _, _), c in parts]
                ),
                triangles=np.concatenate(
                    [f + s for ((_, _, f), _), s in zip(parts, starts, strict=False)]
                ),
            )
        )
    return meshes


def own_geoms(model: mujoco.MjModel, world: World) -> np.ndarray:
    """(ngeom,) bool: geoms of the robot, in the model of a world or one dressed up."""
    return model.body_rootid[model.geom_bodyid] == model.body_rootid[world.base]


def own_meshes(world: World) -> np.ndarray:
    """(ngeom,) bool: the meshes that the robot of a world is drawn with."""
    model, own = world.model, own_geoms(world.model, world)
    meshes = model.geom_type == mujoco.mjtGeom.mjGEOM_MESH.value
    return own & meshes & np.isin(model.geom_group, SHOWN_GROUPS)


def pads_of(world: World) -> list[int]:
    """Geoms of contact surfaces that are drawn as pads of rubber.

    They stand out of a robot's own meshes like balls; as pads they belong to it. A
    robot without meshes is drawn as it is.
    """
    if not own_meshes(world).any():
        return []
    return [g for s in world.surfaces.values() for g in s.geoms]


def geom_colour(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """(4,) of the geom, or of its material where the geom has none of its own."""
    own, material = model.geom_rgba[geom], int(model.geom_matid[geom])
    if material >= 0 and np.allclose(own, PLAIN):
        return model.mat_rgba[material]
    return own


def geom_triangles(
    model: mujoco.MjModel, geom: int, keep: float = 1.0, slices: int = SLICES
) -> _Triangles | None:
    """Vertices, normals and triangles of a geom, in the frame of its body.

    Args:
        model: Compiled.
        geom: Its id.
        keep: Share of a mesh's triangles that may stay.
        slices: Faces around a round geom.

    Returns:
        None for a kind that has no surface of its own, a plane.
    """
    kind, size = mujoco.mjtGeom(model.geom_type[geom]), model.geom_size[geom]
    data = int(model.geom_dataid[geom])
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        v, n, f = _box(size)
    elif kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        v, n, f = _revolved(_round(size[0], 0.0, slices), slices)
    elif kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        v, n, f = _revolved(_round(size[0], size[1], slices), slices)
    elif kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        r, h = size[0], size[1]
        rim = [(0, h, 0, 1), (r, h, 0, 1), (r, h, 1, 0), (r, -h, 1, 0), (r, -h, 0, -1)]
        v, n, f = _revolved(np.array([*rim, (0, -h, 0, -1)], dtype=float), slices)
    elif kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        v, n, f = _revolved(_round(1.0, 0.0, slices), slices)
        v, n = v * size, n / size
        n = n / np.linalg.norm(n, axis=1, keepdims=True)
    elif data >= 0 and kind in (
        mujoco.mjtGeom.mjGEOM_MESH,
        mujoco.mjtGeom.mjGEOM_SDF,
    ):
        v, n, f = _mesh(model, data, keep)
    elif kind == mujoco.mjtGeom.mjGEOM_HFIELD:
        v, n, f = _heights(model, data)
    else:
        return None
    R = np.zeros(9)
    mujoco.mju_quat2Mat(R, model.geom_quat[geom])
    R = R.reshape(3, 3)
    return v @ R.T + model.geom_pos[geom], n @ R.T, f


def _heights(model: mujoco.MjModel, field: int) -> _Triangles:
    """A height field from above, smooth between its heights."""
    rows, columns = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
    x, y, rise, _ = model.hfield_size[field]
    first = int(model.hfield_adr[field])
    heights = model.hfield_data[first : first + rows * columns]
    heights = rise * heights.reshape(rows, columns).astype(float)
    along = np.linspace(-x, x, columns), np.linspace(-y, y, rows)
    v, f = grid_triangles(*along, heights)
    down, right = np.gradient(heights, along[1], along[0])
    n = np.stack([-right, -down, np.ones_like(heights)], axis=-1).reshape(-1, 3)
    return v, n / np.linalg.norm(n, axis=1, keepdims=True), f


def _slices(model: mujoco.MjModel, geom: int, deviation: float) -> int:
    """Faces around a round geom so that none is farther inside it than that [m]."""
    size = model.geom_size[geom]
    long = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_ELLIPSOID
    radius = float(size.max() if long else size[0])
    if deviation <= 0.0 or radius <= 0.0:
        return SLICES
    half = math.acos(max(0.0, 1.0 - deviation / radius))
    return min(max(math.ceil(math.pi / half), FEWEST_SLICES), SLICES)


def _round(radius: float, half: float, slices: int) -> np.ndarray:
    """Profile of a ball, its halves `half` above and below the middle."""
    a = np.linspace(math.pi / 2, 0.0, round(2 * slices / 7) + 1)
    up = np.stack(
        [radius * np.cos(a), radius * np.sin(a) + half, np.cos(a), np.sin(a)], axis=1
    )
    return np.concatenate([up, up[::-1] * [1.0, -1.0, 1.0, -1.0]])


def _revolved(profile: np.ndarray, slices: int) -> _Triangles:
    """A profile (n, 4) of r, z and its normal from top to bottom, turned about z."""
    a = np.linspace(0.0, 2 * math.pi, slices + 1)
    c, s, one = np.cos(a), np.sin(a), np.ones(slices + 1)
    r, z, nr, nz = (x[:, None] for x in profile.T)
    v = np.stack([r * c, r * s, z * one], axis=-1).reshape(-1, 3)
    n = np.stack([nr * c, nr * s, nz * one], axis=-1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(len(profile) - 1), np.arange(slices), indexing="ij")
    a0 = (i * (slices + 1) + j).ravel()
    b0 = a0 + slices + 1
    f = np.concatenate(
        [np.stack([a0, b0, b0 + 1], axis=1), np.stack([a0, b0 + 1, a0 + 1], axis=1)]
    )
    return v, n, _with_area(v, f)


def _box(size: np.ndarray) -> _Triangles:
    """Six faces of four vertices, each with the face's normal."""
    vertices, normals = [], []
    for axis in range(3):
        for sign in (1.0, -1.0):
            b, c = (axis + 1) % 3, (axis + 2) % 3
            for u, w in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
                x = np.zeros(3)
                x[axis], x[b], x[c] = sign, u * sign, w
                vertices.append(x * size)
                normals.append(np.eye(3)[axis] * sign)
    quad = np.array([[0, 1, 2], [0, 2, 3]])
    f = np.concatenate([quad + 4 * i for i in range(6)])
    return np.array(vertices), np.array(normals), f


def _mesh(model: mujoco.MjModel, mesh: int, keep: float) -> _Triangles:
    """A mesh asset, as it is or simplified.

    Its own normals are not used: MuJoCo averages those of a coarse mesh over its edges.
    """
    start, count = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
    vertex = model.mesh_face[start : start + count].astype(int)
    first = int(model.mesh_vertadr[mesh])
    v = model.mesh_vert[first : first + int(model.mesh_vertnum[mesh])].astype(float)
    if keep < 1.0:
        v, vertex = simplified(v, vertex, max(4, int(keep * count)))
    return shaded(v, vertex)


def shaded(vertices: np.ndarray, triangles: np.ndarray) -> _Triangles:
    """Normals for a mesh: smooth over its faces, but not across a sharp edge.

    The normal at a corner is the mean, weighted by area, of the faces around its vertex
    that are less than `CREASE` away from the corner's own.
    """
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    area = np.cross(b - a, c - a)
    length = np.linalg.norm(area, axis=1, keepdims=True)
    face = np.repeat(np.arange(len(triangles)), 3)
    order = np.argsort(triangles.ravel(), kind="stable")
    corner = triangles.ravel()[order]
    own, weight = (area / np.maximum(length, 1e-12))[face[order]], area[face[order]]
    total = weight.copy()
    for k in range(1, AROUND):
        i = np.flatnonzero(corner[k:] == corner[:-k])
        if not len(i):
            break
        i = i[np.einsum("ij,ij->i", own[i], own[i + k]) > math.cos(CREASE)]
        total[i] += weight[i + k]
        total[i + k] += weight[i]
    normal = np.empty_like(total)
    normal[order] = total / np.maximum(
        np.linalg.norm(total, axis=1, keepdims=True), 1e-12
    )
    key = np.column_stack([triangles.ravel(), np.round(normal * 100)]).astype(int)
    _, first, index = np.unique(key, axis=0, return_index=True, return_inverse=True)
    return vertices[triangles.ravel()[first]], normal[first], index.reshape(-1, 3)


def simplified(
    vertices: np.ndarray, triangles: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """At most `count` triangles: vertices in one cell of a grid become one.

    It lies where the planes of the triangles around them meet best, by area squared
    [Lindstrom00], so that flat faces stay flat and edges sharp. The grid is coarsened
    until the count holds, at the latest when all is in one cell.
    """
    low = vertices.min(axis=0)
    extent = max(float((vertices.max(axis=0) - low).max()), 1e-9)
    cells = 1 << 10
    while True:
        cell = np.floor((vertices - low) / extent * cells).astype(np.int64)
        key = (cell[:, 0] * (cells + 1) + cell[:, 1]) * (cells + 1) + cell[:, 2]
        _, index, size = np.unique(key, return_inverse=True, return_counts=True)
        f = index[triangles]
        f = f[(f[:, 0] != f[:, 1]) & (f[:, 1] != f[:, 2]) & (f[:, 2] != f[:, 0])]
        if len(f) <= count or cells == 1:
            break
        # Triangles grow with the square of the cells; the last steps are small.
        cells = max(1, int(cells / max(1.15, 0.8 * math.sqrt(len(f) / max(count, 1)))))
    mean = _summed(index, vertices, len(size)) / size[:, None]
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    area = np.cross(b - a, c - a)
    of, normal = index[triangles].ravel(), np.repeat(area, 3, axis=0)
    # The planes n^T x = n^T a, about the mean: Q y = r, kept near it by a little of Q.
    off = np.einsum("ij,ij->i", normal, np.repeat(a, 3, axis=0) - mean[of])
    Q = _summed(of, (normal[:, :, None] * normal[:, None]).reshape(-1, 9), len(size))
    Q = Q.reshape(-1, 3, 3)
    r = _summed(of, normal * off[:, None], len(size))
    kept = np.trace(Q, axis1=1, axis2=2) * NEAR_MEAN + 1e-300
    y = np.linalg.solve(Q + kept[:, None, None] * np.eye(3), r[:, :, None])[:, :, 0]
    far = np.linalg.norm(y, axis=1, keepdims=True) * cells / extent
    v = mean + y / np.maximum(far, 1.0)
    return v, _with_area(v, f)


def _summed(index: np.ndarray, rows: np.ndarray, count: int) -> np.ndarray:
    """(count, k) sums of rows (n, k) with the same index (n,)."""
    return np.stack([np.bincount(index, x, count) for x in rows.T], axis=1)


def _with_area(v: np.ndarray, f: np.ndarray) -> np.ndarray:
    """The triangles that are not a line or a point."""
    a, b, c = (v[f[:, k]] for k in range(3))
    return f[np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-14]
