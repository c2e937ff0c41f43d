"""Files of a scene -> `Scene`: a scene.yaml, or a drawing of boxes or of any shape."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pydantic

from clamber.errors import InputError, read_yaml, validated
from clamber.model.arguments import checks_types
from clamber.model.boxes import (
    NAME,
    Drawn,
    NoBox,
    Shape,
    read_described,
    read_obj,
    read_sdf,
)
from clamber.model.description import read_xml
from clamber.model.scans import (
    CLOUDS,
    MESHES,
    MOST,
    UNITS,
    check_size,
    mended,
    read_heights,
    read_terrain,
    triangles_of_heights,
)
from clamber.model.scene import (
    GROUND,
    MAX_LENGTH,
    Box,
    HeightField,
    Mesh,
    Scene,
    finite,
    length,
)
from clamber.model.se3 import matrix_from_rpy

DRAWN = (".obj", ".xml", ".mjcf", ".urdf", ".sdf", ".world")  # files of boxes
_Y_UP = (".glb", ".gltf")  # by their specification
_OTHER = (".usd", ".usda", ".usdz", ".fbx", ".blend", ".step", ".stp")

Number = Annotated[float, pydantic.AfterValidator(finite)]
Length = Annotated[float, pydantic.AfterValidator(length)]
Friction = Annotated[float, pydantic.Field(gt=0.0, le=1.0)]
Roughness = Annotated[float, pydantic.Field(ge=0.0, le=0.1)]


Up = Literal["x", "y", "z", "-x", "-y", "-z"]


class _Strict(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(extra="forbid")


class GroundFile(_Strict):
    """`ground` of a scene file."""

    friction: Friction = 0.8


class BoxFile(_Strict):
    """One of `boxes` of a scene file.

    The third number of `position` is the height of the lower face, 0 without it.
    """

    name: str = pydantic.Field(pattern=NAME)
    size: tuple[Length, Length, Length]
    position: tuple[Number, Number] | tuple[Number, Number, Number]
    rpy: tuple[Number, Number, Number] = (0.0, 0.0, 0.0)
    friction: Friction = 0.8
    roughness: Roughness = 0.0

    def box(self) -> Box:
        """The record."""
        x, y, *z = self.position
        bottom = z[0] if z else 0.0
        return Box(
            name=self.name,
            size=np.array(self.size),
            centre=np.array([x, y, bottom + self.size[2] / 2]),
            rotation=matrix_from_rpy(self.rpy),
            friction=self.friction,
            roughness=self.roughness,
        )


class MeshFile(_Strict):
    """One of `meshes` of a scene file: a mesh, or a cloud of points.

    It is scaled, turned to z up, turned by `rpy` about its origin and put at
    `position`.
    """

    name: str = pydantic.Field(pattern=NAME)
    file: str
    unit: Literal["m", "cm", "mm", "in", "ft"] = "m"
    up: Up = "z"
    scale: Annotated[float, pydantic.Field(gt=0.0, allow_inf_nan=False)] = 1.0
    position: tuple[Number, Number] | tuple[Number, Number, Number] = (0.0, 0.0)
    rpy: tuple[Number, Number, Number] = (0.0, 0.0, 0.0)
    friction: Friction = 0.8
    roughness: Roughness = 0.0

    def mesh(self, folder: Path) -> Mesh:
        """The record; the file is in `folder`."""
        path, scale = folder / self.file, UNITS[self.unit] * self.scale
        (vertices, faces), notes = read_terrain(path, scale=scale, up=self.up)
        vertices = vertices @ matrix_from_rpy(self.rpy).T + _place(self.position)
        return _mesh(self, path, vertices, faces, notes)


class HeightsFile(_Strict):
    """One of `heightfields` of a scene file: heights over a rectangle.

    Rows go along y, columns along x; the corners are at the borders of `size`, whose
    middle is at `position`. `range` are the heights of black and white in a picture.
    """

    name: str = pydantic.Field(pattern=NAME)
    file: str
    size: tuple[Length, Length]
    position: tuple[Number, Number] | tuple[Number, Number, Number] = (0.0, 0.0)
    yaw: Number = 0.0
    range: tuple[Number, Number] | None = None
    friction: Friction = 0.8
    roughness: Roughness = 0.0

    def mesh(self, folder: Path) -> Mesh:
        """The record; the file is in `folder`."""
        path = folder / self.file
        if path.suffix.lower() != ".npy" and self.range is None:
            raise InputError("the heights of black and white [m]", path, "range")
        heights = read_heights(path, *(self.range or (0.0, 1.0)))
        (vertices, faces), notes = triangles_of_heights(heights, self.size, path)
        turn = matrix_from_rpy([0.0, 0.0, self.yaw])
        place = _place(self.position)
        vertices = vertices @ turn.T + place
        field = None
        if np.isfinite(heights).all() and heights.size <= MOST:
            field = HeightField(
                heights=heights + place[2],
                size=np.array(self.size),
                position=place[:2],
                yaw=self.yaw,
            )
        return _mesh(self, path, vertices, faces, notes, field)


def _place(position: Sequence[float]) -> np.ndarray:
    return np.array([*position, 0.0])[:3]


def _mesh(
    said: MeshFile | HeightsFile,
    path: Path,
    vertices: np.ndarray,
    faces: np.ndarray,
    notes: list[str],
    field: HeightField | None = None,
) -> Mesh:
    from clamber.model.patches import mesh_of  # brings SciPy and shapely with it

    check_size(vertices, path)
    return mesh_of(
        said.name,
        vertices,
        faces,
        friction=said.friction,
        roughness=said.roughness,
        field=field,
        notes=tuple(notes),
    )


class SceneFile(_Strict):
    """A scene as a person writes it (`scene.yaml`).

    `boxes` may be the name of a drawing beside it: an OBJ, MJCF, URDF or SDF;
    `friction` is then that of boxes which the file gives none, and `up` the axis that
    points up in an OBJ.
    """

    version: int = 1
    ground: GroundFile = GroundFile()
    boxes: list[BoxFile] | str = []
    meshes: list[MeshFile] = []
    heightfields: list[HeightsFile] = []
    friction: Friction = 0.8
    up: Up | None = None
    start: tuple[Number, Number, Number] = (0.0, 0.0, 0.0)
    goal: tuple[Number, Number] | tuple[Number, Number, Number] | None = None

    @pydantic.field_validator("boxes", "meshes", "heightfields")
    @classmethod
    def _unique(cls, shapes: Any, info: pydantic.ValidationInfo) -> Any:
        before = (info.data.get(k) or [] for k in ("boxes", "meshes"))
        named = [
            x for some in (*before, shapes) if not isinstance(some, str) for x in some
        ]
        names = [x.name for x in named] + [GROUND]
        if len(set(names)) != len(names):
            raise ValueError(f"expected different names, none of them {GROUND!r}")
        return shapes

    def scene(self, folder: Path = Path()) -> Scene:
        """The record; files that it names are in `folder`.

        Raises:
            InputError: A file that it names cannot be used.
        """
        friction = self.ground.friction
        meshes = [m.mesh(folder) for m in (*self.meshes, *self.heightfields)]
        if isinstance(self.boxes, str):
            path = folder / self.boxes
            (boxes, shapes), drawn = read_drawn(path, self.friction, self.up)
            meshes += [_mesh_of_shape(s, path) for s in shapes]
            if drawn is not None and "friction" not in self.ground.model_fields_set:
                friction = drawn
        else:
            boxes = [b.box() for b in self.boxes]
        return Scene(
            boxes=tuple(boxes),
            meshes=tuple(meshes),
            ground_friction=friction,
            start=np.array(self.start),
            goal=None if self.goal is None else np.array(self.goal),
        )


SceneLike = Scene | float | str | Path  # a scene, or what `load_scene` makes one of


@checks_types
def load_scene(path: SceneLike) -> Scene:
    """Read a scene: a `scene.yaml`, a drawing of boxes, a mesh or a point cloud.

    A drawing is an OBJ, MJCF (`.xml`), URDF or SDF file; a mesh an OBJ, STL, PLY, GLB
    or COLLADA file in metres; a point cloud a PLY, PCD or npy file.

    Args:
        path: The file; or the height [m] of one box, see `Scene.from_height`; a `Scene`
            is returned as it is.

    Raises:
        InputError: The file, one of its fields, or the height cannot be used.
    """
    if isinstance(path, Scene):
        return path
    if not isinstance(path, str | Path):
        return Scene.from_height(float(path))
    path = Path(path)
    suffix = path.suffix.lower()
    shape = {"name": _name_of(path), "file": path.name}
    if suffix in _Y_UP:
        shape["up"] = "y"
    if suffix in _OTHER:
        known = ", ".join((*DRAWN, *MESHES[1:], *CLOUDS))
        raise InputError(f"a scene.yaml or {known}: export it as OBJ", path)
    if suffix in DRAWN:
        try:
            return SceneFile(boxes=path.name).scene(path.parent)
        except NoBox as e:
            if suffix != ".obj":
                raise
            boxes = e
        try:
            return validated(SceneFile, {"meshes": [shape]}, path).scene(path.parent)
        except InputError:
            raise boxes from None
    drawn = suffix in (*MESHES, *CLOUDS)
    content = {"meshes": [shape]} if drawn else read_yaml(path)
    file = validated(SceneFile, content, path)
    try:
        return file.scene(path.parent)
    except InputError as e:
        if not isinstance(file.boxes, str):
            raise
        source = path if e.source is None else f"{path}, {e.source}"
        raise InputError(e.expected, source, e.field, e.value) from e


def _name_of(path: Path) -> str:
    """Name of a terrain, from that of its file."""
    plain = re.sub(r"[^A-Za-z0-9_]", "_", path.stem)
    return plain if re.match(NAME, plain) and plain != GROUND else "terrain"


def _mesh_of_shape(shape: Shape, path: Path) -> Mesh:
    """The record; its faces may have been drawn any way round."""
    from clamber.model.patches import mesh_of  # brings SciPy and shapely with it

    triangles, notes = mended(shape.vertices, shape.faces, path)
    return mesh_of(shape.name, *triangles, friction=shape.friction, notes=tuple(notes))


def read_drawn(
    path: Path, friction: float, up: str | None = None
) -> tuple[Drawn, float | None]:
    """Shapes in a scene file, and the ground's friction if it gives one.

    Args:
        path: The file.
        friction: Of shapes of which it says none.
        up: The axis that points up in an OBJ; None for z, unless it is plainly y.

    Raises:
        InputError: It cannot be read, or a shape of it cannot be used.
    """
    ground, shapes = None, []
    if path.suffix.lower() == ".obj":
        boxes = read_obj(path, up=up or "z", friction=friction)
        if up is None:
            _check_up(boxes, path)
    elif read_xml(path).tag == "sdf":
        boxes, shapes = read_sdf(path, friction)
    else:
        (boxes, shapes), ground = read_described(path, friction)
    names = [b.name for b in (*boxes, *shapes)]
    for b in (*boxes, *shapes):
        fault = None
        at = b.vertices.mean(axis=0) if isinstance(b, Shape) else b.centre
        points = b.vertices if isinstance(b, Shape) else [b.size, b.centre]
        if names.count(b.name) > 1 or b.name == GROUND or not re.match(NAME, b.name):
            fault = f"a name of its own of letters, digits and _, not {GROUND!r}"
        elif np.abs(points).max() > MAX_LENGTH:
            fault = f"metres, at most {MAX_LENGTH:g}: is it in millimetres?"
        elif not 0 < b.friction <= 1:
            fault = f"a friction above 0, at most 1, not {b.friction:g}"
        if fault:
            kind = "shape" if isinstance(b, Shape) else "box"
            where = "({:.3g}, {:.3g}, {:.3g})".format(*at)  # its file may not name it
            raise InputError(fault, path, f"{kind} {b.name!r} at {where}")
    if ground is not None and not 0 < ground <= 1:
        raise InputError("a friction above 0, at most 1", path, "ground", ground)
    return (boxes, shapes), ground


def _check_up(boxes: list[Box], path: Path) -> None:
    """Refuse a drawing that is half under the ground and stands on it with y up."""
    half = np.array([np.abs(b.rotation) @ b.size / 2 for b in boxes])
    low = np.min([b.centre for b in boxes] - half, axis=0)
    if low[2] < -_SUNK and low[1] > -_SUNK:
        expected = (
            f"z up: it reaches {-low[2]:.2f} m under the ground, with y up it would "
            "stand on it; say so by `up: y` beside `boxes` in a scene.yaml, or `up: z`"
        )
        raise InputError(expected, path)


_SUNK = 0.01  # [m] what is drawn so little under the ground stands on it
