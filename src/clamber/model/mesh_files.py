"""Mesh files that MuJoCo does not load -> vertices and triangles.

STL in text, and COLLADA: nodes of the scene are placed by their transforms, in metres.
Only the file itself is read: no textures, nothing that it refers to.

Shapes: N vertices, F triangles.
"""

from __future__ import annotations

import io
import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from clamber.errors import InputError, unreadable
from clamber.model.markup import read_content, read_xml

COLLADA, STL = ".dae", ".stl"
STL_HEAD, STL_FACE = 84, 50  # [byte] of an STL that is not text
MAX_TRIANGLES = 2_000_000
MAX_NODES = 100_000  # placed: nodes that name one another can multiply without end
# What a shape does not need; the rest of a COLLADA file need not be in order.
_BESIDE = (
    "library_images library_effects library_materials library_cameras library_lights"
    " library_animations library_controllers bind_material instance_camera"
    " instance_light extra"
).split()
_CORNER = re.compile(rb"(?i)\bvertex\s+(\S+)\s+(\S+)\s+(\S+)")
# The way right, in and up of a COLLADA file to x, -y and z.
_UPRIGHT = {
    "X_UP": np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]),
    "Y_UP": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "Z_UP": np.eye(3),
}


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class MeshFile:
    """What a file holds, in its own axes.

    Attributes:
        vertices: (N, 3) [m].
        triangles: (F, 3) indices of vertices.
        upright: (3, 3) rotation that makes z of the axis that the file calls up; tools
            differ in whether they heed it.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    upright: np.ndarray


def read_mesh(path: Path) -> MeshFile | None:
    """The triangles of a file; None: MuJoCo loads it itself.

    Raises:
        InputError: It cannot be read, or is COLLADA or STL in text, and broken or too
            large.
    """
    suffix, upright = path.suffix.lower(), np.eye(3)
    if suffix == COLLADA:
        corners, upright = _read_collada(path)
    elif suffix == STL and _is_text(path):
        corners = _read_text_stl(path)
    else:
        return None
    if not np.isfinite(corners).all():
        raise InputError("a mesh of finite numbers", source=path)
    vertices, faces = np.unique(
        corners.reshape(-1, 3).astype(np.float32), axis=0, return_inverse=True
    )
    faces = faces.reshape(-1, 3)
    faces = faces[
        (faces[:, 0] != faces[:, 1])
        & (faces[:, 1] != faces[:, 2])
        & (faces[:, 2] != faces[:, 0])
    ]
    if len(faces) == 0:
        raise InputError("a mesh with triangles", source=path)
    return MeshFile(vertices=vertices.astype(float), triangles=faces, upright=upright)


def _is_text(path: Path) -> bool:
    """Whether an STL is text: a binary one may begin with the same word."""
    try:
        with path.open("rb") as f:
            head = f.read(STL_HEAD)
        size = path.stat().st_size
    except OSError as e:
        raise unreadable(path, e) from e
    faces = int.from_bytes(head[80:], "little")
    binary = len(head) == STL_HEAD and size == STL_HEAD + STL_FACE * faces
    return head.lstrip().startswith(b"solid") and not binary


def _read_text_stl(path: Path) -> np.ndarray:
    """(F, 3, 3) corners of the triangles."""
    found = _CORNER.findall(read_content(path))
    try:
        corners = np.array(found, dtype=bytes).astype(float)
    except ValueError as e:
        raise InputError(
            f"an STL with three numbers a vertex ({e})", source=path
        ) from e
    if len(corners) % 3 or not len(corners):
        raise InputError(
            "an STL with three vertices a triangle",
            source=path,
            field="vertices",
            value=len(corners),
        )
    return corners.reshape(-1, 3, 3)


def _read_collada(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """(F, 3, 3) corners of the triangles [m], and the rotation to z up."""
    root = read_xml(path)
    try:
        return _placed(root, path)
    except InputError:
        raise
    except Exception as e:  # the library raises whatever it trips over
        why = " ".join(str(e).split()) or type(e).__name__
        raise InputError(f"a COLLADA mesh ({why})", source=path) from e


def _placed(root: ElementTree.Element, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Corners of all triangles of a document's scene, and the rotation to z up."""
    import collada  # slow to import, and few need it
    from collada import scene
    from collada.polylist import Polylist
    from collada.triangleset import TriangleSet

    for parent in root.iter():
        for child in list(parent):
            if child.tag.rpartition("}")[2] in _BESIDE:
                parent.remove(child)
        numbers = (parent.text or "") if parent.tag.endswith("float_array") else ""
        if "nan" in numbers.lower():  # zero to the library
            raise InputError("a mesh of finite numbers", source=path)
    with warnings.catch_warnings():
        # What is no number would end a list of numbers, with a warning.
        warnings.filterwarnings("error", message=".*string or file could not be read")
        document = collada.Collada(io.BytesIO(ElementTree.tostring(root)))
    if document.scene is None:
        raise InputError("COLLADA with a scene", source=path)
    asset = document.assetInfo
    assert asset is not None  # a document without has an empty one
    unit = 1.0 if asset.unitmeter is None else float(asset.unitmeter)
    if not 0 < unit < np.inf:
        raise InputError(
            "a positive number", source=path, field="<unit meter>", value=unit
        )
    stack = [(n, np.eye(4)) for n in document.scene.nodes]
    corners, triangles, nodes = [np.zeros((0, 3, 3))], 0, 0
    while stack:
        node, X_WN = stack.pop()
        nodes += 1
        if nodes > MAX_NODES:
            raise InputError(f"at most {MAX_NODES} nodes in its scene", source=path)
        if isinstance(node, scene.Node):
            X_WN = X_WN @ node.matrix.astype(float)
            stack += [(child, X_WN) for child in node.children]
        if not isinstance(node, scene.GeometryNode):
            continue
        for shape in node.geometry.primitives:
            if isinstance(shape, Polylist):
                shape = shape.triangleset()
            if not isinstance(shape, TriangleSet) or shape.vertex is None:
                continue  # lines
            index = shape.vertex_index
            if index.min(initial=0) < 0:
                raise InputError("indices of vertices from 0", source=path)
            triangles += len(index)
            if triangles > MAX_TRIANGLES:
                raise InputError(f"at most {MAX_TRIANGLES} triangles", source=path)
            with np.errstate(all="ignore"):  # what is not finite is refused later
                local = shape.vertex.astype(float) @ X_WN[:3, :3].T + X_WN[:3, 3]
                corners.append(unit * local[index])
    return np.concatenate(corners), _UPRIGHT[asset.upaxis or "Y_UP"]
