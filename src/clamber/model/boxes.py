"""Scene files of other programs -> `Box` records, and shapes of other kinds.

An OBJ holds boxes by their corners; an MJCF, URDF or SDF holds fixed shapes. Meshes
with the corners of a box are boxes, other shapes are triangles.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np

from clamber.errors import InputError, check_kind, unreadable
from clamber.model.description import (
    compile_description,
    read_description,
    read_mesh,
    read_xml,
)
from clamber.model.records import short_repr
from clamber.model.scene import GROUND, Box
from clamber.model.se3 import matrix_from_rpy

NAME = r"^[A-Za-z][A-Za-z0-9_]*$"  # of a box
DEFAULT_FRICTION = 0.8
_LARGEST = 1e6  # [m]
_FIT = 2e-3  # [m] a vertex further than this from the fitted box is no box's
_SAME = 1e-5  # of the size of all: nearer vertices are one corner
_NO_BOX = "no other shapes than boxes are climbed: put boxes in its place"


class NoBox(InputError):
    """A shape that was drawn is no box."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Shape:
    """A shape that is no box.

    Attributes:
        name: It has no other's.
        vertices: (V, 3) in the world [m].
        faces: (F, 3) counter-clockwise seen from outside.
        friction: Coulomb coefficient.
    """

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    friction: float

    __repr__ = short_repr


Drawn = tuple[list[Box], list[Shape]]


def read_obj(
    path: Path,
    scale: float = 1.0,
    up: str = "z",
    friction: float = DEFAULT_FRICTION,
) -> list[Box]:
    """Boxes of an OBJ in the order of the file.

    An object (`o` or `g`) of one box gives it its name; others are called `box1`,
    `box2` and so on. A box has eight corners: where vertices share one, as exporters
    write them, faces tell which belong together; without, eight in a row do.

    Args:
        path: The file.
        scale: Metres per unit.
        up: The axis that points up in it.
        friction: Of the boxes.

    Raises:
        InputError: It is no such file.
    """
    check_kind(path, "an OBJ")
    try:
        lines = path.read_text().splitlines()
    except OSError as e:
        raise unreadable(path, e) from e
    except UnicodeDecodeError as e:
        raise InputError("an OBJ file, in UTF-8", path) from e
    name: str | None = None
    vertices: list[list[float]] = []
    names: list[str | None] = []  # of each vertex: the object it is listed in
    faces: list[tuple[str | None, list[int]]] = []
    for number, line in enumerate(lines, start=1):
        word, *rest = line.split() or [""]
        if word in ("o", "g") and rest:
            name = rest[0]
        elif word == "v":
            try:
                x = [float(a) for a in rest[:3]]
            except ValueError:
                x = []
            if len(x) != 3 or not np.all(np.isfinite(x)):
                raise InputError("three finite numbers", path, f"line {number}")
            vertices.append(x)
            names.append(name)
        elif word == "f":
            faces.append((name, _indices(rest, len(vertices), number, path)))
    if not vertices:
        raise InputError("8 vertices a box", path, "v", 0)
    v = to_z_up(scale * np.array(vertices), up)
    pieces = _pieces(v, names, faces)
    count = {n: sum(m == n for m, _ in pieces) for n, _ in pieces}
    boxes: list[Box] = []
    for name, rows in pieces:
        single = name if name is not None and count[name] == 1 else None
        called = single or f"box{len(boxes) + 1}"
        box = replace(_fit_box(called, _corners(v[rows]), path), friction=friction)
        boxes.append(box)
    return boxes


def _indices(words: list[str], count: int, line: int, path: Path) -> list[int]:
    """Vertex indices of a face, from 0; negative ones count from the end."""
    try:
        found = [int(w.split("/")[0]) for w in words]
    except ValueError:
        found = [0]
    found = [i - 1 if i > 0 else count + i for i in found if i]
    if len(found) != len(words) or not all(0 <= i < count for i in found):
        raise InputError("indices of vertices before it", path, f"line {line}")
    return found


def _pieces(
    v: np.ndarray,
    names: Sequence[str | None],
    faces: Sequence[tuple[str | None, list[int]]],
) -> list[tuple[str | None, list[int]]]:
    """Vertex indices of each solid among vertices (N, 3), and its object's name."""
    by_eight: list[tuple[str | None, list[int]]] = []
    for name, several in itertools.groupby(range(len(v)), key=lambda i: names[i]):
        rows = list(several)
        if len(rows) > 8 and len(_corners(v[rows])) == 8:
            by_eight.append((name, rows))
            continue
        by_eight += [(name, rows[k : k + 8]) for k in range(0, len(rows), 8)]
    used = [i for _, f in faces for i in f]
    if len(set(used)) < len(v):  # points alone, or some of them
        return by_eight
    called: dict[int, str | None] = {i: n for n, f in faces for i in f}
    for merged in (False, True):
        solid = _joined(v, [f for _, f in faces], merged)
        solids: dict[int, list[int]] = {}
        for i in range(len(v)):
            solids.setdefault(int(solid[i]), []).append(i)
        if merged or all(len(rows) == 8 for rows in solids.values()):
            break
    return [(called[rows[0]], rows) for rows in solids.values()]


def _joined(v: np.ndarray, faces: list[list[int]], merged: bool) -> np.ndarray:
    """(N,) which vertices are joined by faces: the same number.

    Args:
        v: (N, 3) vertices.
        faces: Indices.
        merged: Whether vertices at one place are joined too.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    links = [(f[0], i) for f in faces for i in f[1:]]
    if merged:
        same: dict[tuple, int] = {}
        for i, place in enumerate(map(tuple, _rounded(v).tolist())):
            links.append((same.setdefault(place, i), i))
    ends = np.array(links, dtype=np.intp).reshape(-1, 2).T
    graph = coo_array((np.ones(len(links)), tuple(ends)), shape=(len(v), len(v)))
    return connected_components(graph, directed=False)[1]


def _rounded(v: np.ndarray) -> np.ndarray:
    """Vertices (N, 3) as whole numbers of a length that tells corners apart."""
    size = float(np.ptp(v, axis=0).max())
    return np.round(v / (_SAME * size if size > 0 else 1.0))


def _corners(v: np.ndarray) -> np.ndarray:
    """(K, 3) vertices (N, 3), each place once; the very same where none is double."""
    _, first = np.unique(_rounded(v), axis=0, return_index=True)
    return v if len(first) == len(v) else v[np.sort(first)]


# Which axes, with which sign, become x, y and z: always a rotation, never a mirror.
AXES = {
    "z": ((0, 1), (1, 1), (2, 1)),
    "y": ((0, 1), (2, -1), (1, 1)),
    "x": ((1, 1), (2, 1), (0, 1)),
    "-z": ((0, 1), (1, -1), (2, -1)),
    "-y": ((0, 1), (2, 1), (1, -1)),
    "-x": ((2, 1), (1, 1), (0, -1)),
}


def to_z_up(x: np.ndarray, up: str) -> np.ndarray:
    """Coordinates (..., 3) in which `up` points up as coordinates with z up."""
    return np.stack([sign * x[..., k] for k, sign in AXES[up]], axis=-1)


def _fit_box(name: str, v: np.ndarray, path: Path) -> Box:
    """The box (8, 3) vertices belong to, in any order: upright if it can be."""
    if len(v) != 8:
        found = f"{len(v)} corners"
        raise NoBox(f"8 vertices of a box: {_NO_BOX}", path, name, found)
    order = np.argsort(v[:, 2], kind="stable")
    base = v[order[:4]]
    # Of the three ways from one corner to the others the longest is the diagonal.
    ways = sorted((base[1:] - base[0])[:, :2], key=np.linalg.norm)
    yaw = float(np.arctan2(ways[1][1], ways[1][0]))
    yaw = (yaw + np.pi / 4) % (np.pi / 2) - np.pi / 4
    R = matrix_from_rpy([0.0, 0.0, yaw])
    off, low, high = _extent(v, R)
    if off > _FIT:
        tilted = _tilted(v)
        if tilted is not None:
            R = tilted
            off, low, high = _extent(v, R)
    if off > _FIT or np.any(high - low < _FIT):
        raise NoBox(
            "8 vertices of a box "
            f"(one is {off:.3f} m off; size {(high - low).round(3).tolist()})",
            path,
            name,
        )
    return Box(name=name, size=high - low, centre=R @ (low + high) / 2, rotation=R)


def _extent(v: np.ndarray, R: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Misfit of vertices to a box along the axes `R`, its low and high corner [m]."""
    local = v @ R
    low, high = local.min(axis=0), local.max(axis=0)
    off = np.minimum(np.abs(local - low), np.abs(local - high)).max()
    return float(off), low, high


def _tilted(v: np.ndarray) -> np.ndarray | None:
    """(3, 3) axes of a box that leans, the most upright last; None: no right angles.

    Three ways from one corner are its edges where they are square to each other; of
    those that are, the shortest: the others are diagonals of faces.
    """
    if np.abs(v).max() > _LARGEST:
        return None
    ways = v[1:] - v[0]
    best, axes = np.inf, None
    for triple in itertools.combinations(ways, 3):
        lengths = np.array([np.linalg.norm(x) for x in triple])
        if lengths.min() < _FIT:
            continue
        units = np.array(triple) / lengths[:, None]
        square = float(np.abs(units @ units.T - np.eye(3)).max())
        off, _, _ = _extent(v, units.T)
        if square < 0.02 and off <= _FIT and lengths.sum() < best:
            best, axes = float(lengths.sum()), units
    if axes is None:
        return None
    z = axes[int(np.argmax(np.abs(axes[:, 2])))]
    z = z * np.sign(z[2])
    rest = [a for a in axes if abs(a @ z) < 0.5]
    x = max(rest, key=lambda a: abs(a[0]))
    x = x * (np.sign(x[0]) or 1.0)
    x = x - z * (x @ z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def read_described(
    path: Path, friction: float = DEFAULT_FRICTION
) -> tuple[Drawn, float | None]:
    """Fixed geometry of an MJCF or URDF, and the friction of its ground plane.

    Args:
        path: The file.
        friction: Of the shapes of a URDF, which says none.

    Raises:
        InputError: It is no such file, or holds no fixed shape but a plane.
    """
    says_friction = read_xml(path).tag != "robot"
    model = compile_description(read_description(path, lenient=True), path)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    boxes: list[Box] = []
    shapes: list[Shape] = []
    ground = None
    for g in range(model.ngeom):
        body = int(model.geom_bodyid[g])
        solid = model.geom_contype[g] or model.geom_conaffinity[g]
        if model.body_weldid[body] != 0 or not solid:
            continue
        mu = float(model.geom_friction[g, 0]) if says_friction else friction
        place, R = data.geom_xpos[g].copy(), data.geom_xmat[g].reshape(3, 3).copy()
        kind, name = mujoco.mjtGeom(int(model.geom_type[g])), model.geom(g).name
        if kind == mujoco.mjtGeom.mjGEOM_PLANE:
            ground = mu
            continue
        called = _called(name, model.body(body).name if body else "", (*boxes, *shapes))
        if kind == mujoco.mjtGeom.mjGEOM_BOX:
            size = 2.0 * model.geom_size[g]
            box = Box(name=called, size=size, centre=place, rotation=R)
            boxes.append(replace(box, friction=mu))
        else:
            v, faces = _triangles(model, g)
            _add(boxes, shapes, called, place + v @ R.T, faces, mu, path)
    if not boxes and not shapes:
        raise InputError("a shape that is fixed to the world", path, "geom")
    return (boxes, shapes), ground


def _add(
    boxes: list[Box],
    shapes: list[Shape],
    name: str,
    vertices: np.ndarray,
    faces: np.ndarray,
    friction: float,
    path: Path,
) -> None:
    """A mesh in the world, as the box that it is, or as it is."""
    corners = _corners(vertices)
    if len(corners) == 8:
        try:
            box = _fit_box(name, corners, path)
        except NoBox:
            pass
        else:
            boxes.append(replace(box, friction=friction))
            return
    shapes.append(Shape(name=name, vertices=vertices, faces=faces, friction=friction))


def _triangles(model: mujoco.MjModel, geom: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) in the geom's frame and faces (F, 3) of a geom that is no box."""
    kind, size = mujoco.mjtGeom(int(model.geom_type[geom])), model.geom_size[geom]
    data = int(model.geom_dataid[geom])
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        first, n = int(model.mesh_vertadr[data]), int(model.mesh_vertnum[data])
        face, m = int(model.mesh_faceadr[data]), int(model.mesh_facenum[data])
        v = model.mesh_vert[first : first + n].astype(float)
        return v, model.mesh_face[face : face + m].astype(np.int64)
    if kind == mujoco.mjtGeom.mjGEOM_HFIELD:
        n, m = int(model.hfield_nrow[data]), int(model.hfield_ncol[data])
        first, (x, y, high, _) = int(model.hfield_adr[data]), model.hfield_size[data]
        heights = model.hfield_data[first : first + n * m].reshape(n, m) * high
        return grid_triangles(np.linspace(-x, x, m), np.linspace(-y, y, n), heights)
    word = kind.name.removeprefix("mjGEOM_").lower()
    return _round_shape(word, size)


def grid_triangles(
    x: np.ndarray, y: np.ndarray, heights: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and faces (F, 3) of heights (rows, columns) at x and y."""
    X, Y = np.meshgrid(x, y)
    i = np.arange(X.size).reshape(X.shape)
    a, b, c, d = i[:-1, :-1], i[:-1, 1:], i[1:, :-1], i[1:, 1:]
    halves = (a, b, d), (a, d, c)
    faces = np.concatenate([np.stack(f, axis=-1).reshape(-1, 3) for f in halves])
    return np.stack([X, Y, heights], axis=-1).reshape(-1, 3).astype(float), faces


def _round_shape(kind: str, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a sphere, capsule, cylinder or ellipsoid along z."""
    from trimesh import creation  # slow to import, and few need it

    if kind == "cylinder":
        mesh = creation.cylinder(radius=size[0], height=2.0 * size[1], sections=48)
    elif kind == "capsule":
        mesh = creation.capsule(height=2.0 * size[1], radius=size[0], count=(24, 48))
    else:
        mesh = creation.icosphere(subdivisions=3)
        mesh.apply_scale(size if kind == "ellipsoid" else size[0])
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def _called(name: str, place: str, boxes: Sequence[Box | Shape]) -> str:
    """A box's name: its own, or that of the body it is on, or its number."""
    taken = {b.name for b in boxes} | {GROUND}
    for wanted in (name, place, *(f"{place}{k}" for k in range(2, len(boxes) + 2))):
        plain = re.sub(r"[^A-Za-z0-9_]", "_", wanted)
        if re.match(NAME, plain) and plain not in taken:
            return plain
    return f"box{len(boxes) + 1}"


# SDF, Gazebo's description of worlds and models.


def read_sdf(path: Path, friction: float = DEFAULT_FRICTION) -> Drawn:
    """Shapes of the static models of an SDF; of all models where none is static.

    Raises:
        InputError: It is no such file, or holds no shape but a plane.
    """
    root = read_xml(path)
    models = list(root.iter("model"))
    if root.tag != "sdf" or not models:
        raise InputError("an SDF with a model", path, "<model>")
    include = root.find(".//include")
    if include is not None:
        uri = include.findtext("uri", "")
        expected = "models written out in this file, not included from others"
        raise InputError(expected, path, "<include>", uri)
    static = [m for m in models if _is_true(m.findtext("static", ""))]
    boxes: list[Box] = []
    shapes: list[Shape] = []
    for model in static or models:
        for link in model.findall("link"):
            for shape in link.findall("collision"):
                label = model.get("name", ""), link.get("name", "")
                where = f"collision {shape.get('name')!r} of {'/'.join(label)}"
                R, p = np.eye(3), np.zeros(3)
                for element in (model, link, shape):
                    R_next, p_next = _pose(element, where, path)
                    R, p = R @ R_next, p + R @ p_next
                name = label[0] if len(model) else ""
                name = _called("", name, (*boxes, *shapes))
                text = shape.findtext("surface/friction/ode/mu")
                mu = friction if text is None else min(_number(text, where, path), 1.0)
                found = _sdf_shape(shape, where, path)
                if isinstance(found, np.ndarray):
                    box = Box(name=name, size=found, centre=p, rotation=R)
                    boxes.append(replace(box, friction=mu))
                elif found is not None:
                    _add(boxes, shapes, name, p + found[0] @ R.T, found[1], mu, path)
    if not boxes and not shapes:
        raise InputError("a collision shape", path, "<collision>")
    return boxes, shapes


def _sdf_shape(
    shape: ElementTree.Element, where: str, path: Path
) -> np.ndarray | tuple[np.ndarray, np.ndarray] | None:
    """Size (3,) of a box, vertices and faces of another collision; None of a plane."""
    geometry = shape.find("geometry")
    kinds = [] if geometry is None else list(geometry)
    kind = kinds[0] if kinds else ElementTree.Element("nothing")

    def number(key: str) -> float:
        return _number(kind.findtext(key, ""), where, path)

    if kind.tag == "plane":
        return None
    if kind.tag == "box":
        size = _numbers(kind.findtext("size", ""), 3, where, path)
        if np.any(size <= 0):
            raise InputError("positive lengths", path, where, size.tolist())
        return size
    if kind.tag == "mesh":
        uri = kind.findtext("uri", "")
        scale = _numbers(kind.findtext("scale", "1 1 1"), 3, where, path)
        file = path.parent / re.sub(r"^(file|model|package)://", "", uri)
        found = read_mesh(file)
        return found.vertices * scale, found.triangles
    if kind.tag in ("cylinder", "capsule"):
        half = number("length") / 2
        return _round_shape(kind.tag, np.array([number("radius"), half, 0.0]))
    if kind.tag == "sphere":
        return _round_shape(kind.tag, np.array([number("radius"), 0.0, 0.0]))
    if kind.tag == "ellipsoid":
        radii = _numbers(kind.findtext("radii", ""), 3, where, path)
        return _round_shape(kind.tag, radii)
    known = "box, cylinder, sphere, capsule, ellipsoid, mesh or plane"
    raise InputError(known, path, where, kind.tag)


def _pose(
    element: ElementTree.Element, where: str, path: Path
) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3, 3) and place (3,) of an element in the one around it."""
    pose = element.find("pose")
    if pose is None or not (pose.text or "").strip():
        return np.eye(3), np.zeros(3)
    if pose.get("relative_to"):
        expected = "poses relative to what is around them, as without relative_to"
        raise InputError(expected, path, where, pose.get("relative_to"))
    x = _numbers(pose.text or "", 6, where, path)
    angles = np.radians(x[3:]) if _is_true(pose.get("degrees", "")) else x[3:]
    return matrix_from_rpy(angles.tolist()), x[:3]


def _is_true(text: str | None) -> bool:
    return (text or "").strip().lower() in ("1", "true")


def _number(text: str, where: str, path: Path) -> float:
    return float(_numbers(text, 1, where, path)[0])


def _numbers(text: str, count: int, where: str, path: Path) -> np.ndarray:
    """So many finite numbers of a text."""
    try:
        x = np.array([float(w) for w in text.split()])
    except ValueError:
        x = np.array([np.nan])
    if len(x) != count or not np.isfinite(x).all() or np.abs(x).max() > _LARGEST:
        raise InputError(f"{count} finite numbers", path, where, text.strip()[:40])
    return x
