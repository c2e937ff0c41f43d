"""Files of terrain -> triangles in the world, mended where they have faults.

A mesh is an OBJ, STL, PLY, GLB or COLLADA file; a cloud of points (PLY, PCD or an npy
of three columns) becomes one, as a height map of the highest points; so does a height
map (npy or a picture). What is mended is said in a sentence each, what cannot be is an
`InputError`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from clamber.errors import InputError, check_kind, unreadable
from clamber.model.boxes import grid_triangles, to_z_up
from clamber.model.description import read_shapes
from clamber.model.scene import MAX_LENGTH

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
MESHES = (".obj", ".stl", ".ply", ".glb", ".gltf", ".dae")
CLOUDS = (".pcd", ".npy")
PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
SMALLEST = 0.02  # [m] terrain less wide than this is in another unit
MOST = 250_000  # triangles that are looked at one by one
ROUNDS = 6  # of averaging, before neighbours are put together
MOST_POINTS = 20_000_000
_SAME = 1e-5  # [m] nearer vertices are one

Triangles = tuple[np.ndarray, np.ndarray]  # vertices (V, 3) [m], faces (F, 3)


def read_terrain(
    path: Path, *, scale: float = 1.0, up: str = "z"
) -> tuple[Triangles, list[str]]:
    """The triangles of a mesh, or of the surface of a cloud, z up.

    Args:
        path: The file.
        scale: Metres per unit.
        up: The axis that points up in it.

    Returns:
        Vertices and faces, and what was mended, a sentence each.

    Raises:
        InputError: It cannot be used.
    """
    check_kind(path, "a mesh or a cloud of points", "npy", "ply", "gltf")
    suffix = path.suffix.lower()
    corners, points = np.zeros((0, 3, 3)), np.zeros((0, 3))
    if suffix == ".npy":
        points = _array(path)
        if points.ndim != 2 or points.shape[1] < 3:
            raise InputError("points (N, 3)", path, "shape", list(points.shape))
        points = points[:, :3]
    elif suffix == ".pcd":
        points = _read_pcd(path)
    elif suffix in MESHES:
        corners, points, upright = read_shapes(path)
        corners = corners @ upright.T
    else:
        known = ", ".join((*MESHES, *CLOUDS))
        raise InputError(f"a mesh or cloud: {known}", path)
    corners = scale * to_z_up(corners, up)
    if len(corners) == 0 and len(points):
        return _of_points(scale * to_z_up(points, up), path)
    bad = ~np.isfinite(corners).all(axis=(1, 2))
    notes = []
    if bad.any():
        notes.append(f"{bad.sum()} triangles with values that are no numbers left out")
        corners = corners[~bad]
    if len(corners) == 0:
        raise InputError("a mesh with triangles", path)
    check_size(corners.reshape(-1, 3), path)
    keys = np.round(corners.reshape(-1, 3) / _SAME).astype(np.int64)
    _, first, index = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    return mended(corners.reshape(-1, 3)[first], index.reshape(-1, 3), path, notes)


def check_size(points: np.ndarray, path: Path) -> None:
    """Refuse points (N, 3) [m] that must be in another unit.

    Raises:
        InputError: They are.
    """
    size = np.ptp(points, axis=0)
    fault, value = None, f"{size.max():.3g} m wide"
    if max(np.abs(points).max(), size.max()) > MAX_LENGTH:
        fault, value = "mm", f"{np.abs(points).max():.3g} m away"
    if size.max() < SMALLEST:
        fault = "m, where it is not"
    if fault:
        raise InputError(
            f"metres, {SMALLEST:g} to {MAX_LENGTH:g}: say `unit: {fault}` (or cm, in,"
            " ft) beside its name in a scene.yaml",
            path,
            "size",
            value,
        )


def mended(
    vertices: np.ndarray, faces: np.ndarray, path: Path, notes: Sequence[str] = ()
) -> tuple[Triangles, list[str]]:
    """Triangles each once, facing outwards, no more than can be looked at.

    Args:
        vertices: (V, 3) [m].
        faces: (F, 3).
        path: For messages.
        notes: What was mended before.

    Raises:
        InputError: Nothing is left.
    """
    from clamber.model.regions import averaged, merged  # bring SciPy and shapely

    notes, count = list(notes), len(faces)
    cell = 0.005
    if len(faces) > MOST:  # else noise would be cut into layers
        vertices = averaged(vertices, faces, ROUNDS)
    while len(faces) > MOST:
        vertices, faces = merged(vertices, faces, cell)
        cell *= 1.5
    if len(faces) < count:
        text = f"{count} triangles put together to {len(faces)}"
        notes.append(f"{text}, {1e3 * cell / 1.5:.0f} mm apart")
    a, b, c = faces.T
    x, y, z = (vertices[faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(y - x, z - x), axis=1) / 2
    faces = faces[(a != b) & (b != c) & (c != a) & (area > 1e-12)]
    faces, doubled = _once(faces)
    if doubled:
        notes.append(f"{doubled} doubled triangles left out")
    if len(faces) == 0:
        raise InputError("a mesh with triangles", path)
    faces, turned, open_ = _outwards(vertices, faces)
    if turned:
        notes.append(f"{turned} triangles that faced the wrong way turned round")
    if open_:
        notes.append(f"not closed ({open_} open edges): solid behind what it shows")
    return (vertices, faces), notes


def _once(faces: np.ndarray) -> tuple[np.ndarray, int]:
    """Faces (F, 3) without those that are there twice, and how many were.

    Where most are there both ways round, that is the one sheet from both of its sides;
    where few are, they are between solids that touch, and stay.
    """
    rolled = np.stack([np.roll(faces, k, axis=1) for k in range(3)], axis=1)
    same = rolled[np.arange(len(faces)), np.argmin(rolled[:, :, 0], axis=1)]
    _, first = np.unique(same, axis=0, return_index=True)
    out = faces[np.sort(first)]
    _, first = np.unique(np.sort(out, axis=1), axis=0, return_index=True)
    if len(out) - len(first) > 0.3 * len(out):
        out = out[np.sort(first)]
    return out, len(faces) - len(out)


def _outwards(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, int, int]:
    """Faces (F, 3) turned out of what they enclose, or up; how many were not.

    Also how many of their edges are open.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import breadth_first_order, connected_components

    from clamber.model.regions import neighbours

    pairs, edge = neighbours(faces, vertices)
    n = len(faces)
    start = faces[pairs, edge]
    against = start[:, 0] == start[:, 1]  # along the common edge, the same way
    links = coo_array((np.ones(len(pairs)), tuple(pairs.T)), shape=(n, n)).tocsr()
    count, part = connected_components(links, directed=False)
    flip = np.zeros(n, dtype=bool)
    if against.any():
        both = np.concatenate([pairs, pairs[:, ::-1]])
        odd = {(int(i), int(j)) for i, j in both[np.concatenate([against, against])]}
        for i in np.unique(part[pairs[against, 0]]):
            seed = int(np.flatnonzero(part == i)[0])
            order, before = breadth_first_order(links, seed, directed=False)
            for j in order[1:].tolist():
                k = int(before[j])
                flip[j] = flip[k] ^ ((k, j) in odd)
    out = np.where(flip[:, None], faces[:, ::-1], faces)
    a, b, c = (vertices[out[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    middle = (
        np.stack([np.bincount(part, a[:, k], count) for k in range(3)], axis=1)
        / np.bincount(part, minlength=count)[:, None]
    )
    volume = np.bincount(part, np.sum((a - middle[part]) * normal, axis=1), count)
    upward = np.bincount(part, normal[:, 2], count)
    sides = np.bincount(part[pairs[:, 0]], minlength=count) * 2
    closed = sides >= 3 * np.bincount(part, minlength=count)
    wrong = np.where(closed, volume, upward) < -1e-12
    flip ^= wrong[part]
    out = np.where(flip[:, None], faces[:, ::-1], faces)
    return out, int(flip.sum()), int(3 * n - 2 * len(pairs))


# Heights.


def read_heights(path: Path, low: float, high: float) -> np.ndarray:
    """(rows, columns) heights [m] of an npy, or of a picture, black is low.

    Args:
        path: The file. Rows of an npy go along y, its columns along x; a picture is
            seen from above, x to the right and y up.
        low: Height of black [m].
        high: Height of white [m].

    Raises:
        InputError: It cannot be used.
    """
    if path.suffix.lower() == ".npy":
        heights = _array(path)
    elif path.suffix.lower() in PICTURES:
        from PIL import Image

        try:
            picture = np.asarray(Image.open(path), dtype=float)
        except (OSError, ValueError) as e:
            raise InputError(f"a picture of heights ({e})", path) from e
        picture = picture[..., 0] if picture.ndim == 3 else picture
        white = 65535.0 if picture.max() > 255 else 255.0
        heights = low + (high - low) * picture[::-1] / white
    else:
        raise InputError("heights as .npy or .png", path)
    if heights.ndim != 2 or min(heights.shape) < 2:
        raise InputError("heights (rows, columns)", path, "shape", list(heights.shape))
    if heights.size > MOST_POINTS:
        raise InputError(f"at most {MOST_POINTS} heights", path, value=heights.size)
    return heights


def triangles_of_heights(
    heights: np.ndarray, size: tuple[float, float], path: Path
) -> tuple[Triangles, list[str]]:
    """The triangles of heights (rows, columns) [m] over a rectangle about the origin.

    Where a height is no number there is a hole.

    Raises:
        InputError: Nothing is left, or the heights are in another unit.
    """
    known, notes = np.isfinite(heights), []
    if not known.any():
        raise InputError("heights that are numbers", path)
    if not known.all():
        notes.append(f"{(~known).sum()} heights that are no numbers: holes")
    if np.abs(heights[known]).max() > MAX_LENGTH:
        value = f"{np.abs(heights[known]).max():.3g} m high"
        raise InputError("heights in metres, or `scale`", path, "heights", value)
    rows, columns = heights.shape
    x, y = (np.linspace(-0.5, 0.5, n) for n in (columns, rows))
    flat = np.where(known, heights, 0.0)
    vertices, faces = grid_triangles(size[0] * x, size[1] * y, flat)
    faces = faces[known.ravel()[faces].all(axis=1)]
    return mended(vertices, faces, path, notes)


# Points.


def _of_points(points: np.ndarray, path: Path) -> tuple[Triangles, list[str]]:
    """The surface that points (N, 3) were measured on, as it is seen from above.

    In cells about twice as far apart as the points are, the middle of those that are
    highest; gaps of a cell or two are bridged, larger ones are holes.
    """
    from scipy.ndimage import distance_transform_edt
    from scipy.spatial import KDTree

    good, notes = np.isfinite(points).all(axis=1), []
    if not good.all():
        notes.append(f"{(~good).sum()} points that are no numbers left out")
        points = points[good]
    if len(points) < 30:
        raise InputError("at least 30 points", path, "points", len(points))
    if len(points) > MOST_POINTS:
        raise InputError(f"at most {MOST_POINTS} points", path, value=len(points))
    check_size(points, path)
    some = points[:: max(len(points) // 20_000, 1)]
    near = KDTree(points).query(some, k=2)[0][:, 1]
    cell = max(2.0 * float(np.median(near)), 0.01)
    low = points.min(axis=0)
    at = np.floor((points[:, :2] - low[:2]) / cell).astype(np.int64)
    columns, rows = at.max(axis=0) + 1
    if rows * columns > MOST_POINTS:
        raise InputError("points closer together", path, "points", len(points))
    key = at[:, 1] * columns + at[:, 0]
    order = np.lexsort([-points[:, 2], key])
    heights = np.full(rows * columns, np.nan)
    starts = np.flatnonzero(np.diff(key[order], prepend=-1))
    for first, mine in zip(starts, np.split(order, starts[1:]), strict=True):
        z = points[mine, 2]
        heights[key[order[first]]] = np.median(z[z > z[0] - 0.03])
    heights = heights.reshape(rows, columns)
    found = distance_transform_edt(np.isnan(heights), return_indices=True)
    assert found is not None
    away, nearest = found
    bridged = (away > 0) & (away <= 2.0)
    heights[bridged] = heights[tuple(nearest[:, bridged])]
    size = ((columns - 1) * cell, (rows - 1) * cell)
    (vertices, faces), more = triangles_of_heights(heights, size, path)
    middle = [*(low[:2] + 0.5 * cell + 0.5 * np.array(size)), 0.0]
    text = f"{len(points)} points as seen from above, in cells of {1e3 * cell:.0f} mm"
    return (vertices + middle, faces), [*notes, text, *more]


def _array(path: Path) -> np.ndarray:
    """A numeric npy."""
    try:
        out = np.load(path, allow_pickle=False)
    except OSError as e:
        raise unreadable(path, e) from e
    except (ValueError, EOFError) as e:
        raise InputError(f"an .npy of numbers ({e})", path) from e
    if not isinstance(out, np.ndarray) or out.dtype.kind not in "fiu":
        raise InputError("an .npy of numbers", path)
    return out.astype(float)


_PCD_KINDS = {"F": "f", "I": "i", "U": "u"}


def _read_pcd(path: Path) -> np.ndarray:
    """(N, 3) points of a PCD in text or binary."""
    try:
        content = path.read_bytes()
    except OSError as e:
        raise unreadable(path, e) from e
    head: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in head:
        end = content.find(b"\n", at)
        if end < 0 or len(head) > 20:
            raise InputError("a PCD file", path)
        words = content[at:end].decode("ascii", "replace").split()
        at = end + 1
        if words and not words[0].startswith("#"):
            head[words[0]] = words[1:]
    try:
        names, count = head["FIELDS"], int(head["POINTS"][0])
        sizes = zip(head["TYPE"], head["SIZE"], strict=True)
        kinds = [f"<{_PCD_KINDS[t]}{int(s)}" for t, s in sizes]
        counts = [int(c) for c in head.get("COUNT", ["1"] * len(names))]
        fields = [(n, k, (c,)) for n, k, c in zip(names, kinds, counts, strict=True)]
        columns = [names.index(x) for x in "xyz"]
        if head["DATA"] == ["binary"]:
            rows = np.frombuffer(content, np.dtype(fields), count, at)
            return np.stack([rows[n][:, 0] for n in "xyz"], axis=1).astype(float)
        if head["DATA"] == ["ascii"]:
            first = [sum(counts[:c]) for c in columns]
            text = content[at:].decode("ascii").splitlines()[:count]
            return np.array([[float(t.split()[i]) for i in first] for t in text])
    except (KeyError, ValueError, IndexError, TypeError) as e:
        raise InputError(f"a PCD file with x, y and z ({e})", path) from e
    raise InputError("DATA ascii or binary", path, "DATA", " ".join(head["DATA"]))
