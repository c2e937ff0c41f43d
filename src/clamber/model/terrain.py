"""Files of a scene -> `Scene`: a scene.yaml, or the boxes of a drawing (`boxes`)."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import pydantic

from clamber.errors import InputError, read_yaml, validated
from clamber.model.arguments import checks_types
from clamber.model.boxes import NAME, read_described, read_obj, read_sdf
from clamber.model.description import read_xml
from clamber.model.scene import GROUND, MAX_LENGTH, Box, Scene, finite, length
from clamber.model.se3 import matrix_from_rpy

DRAWN = (".obj", ".xml", ".mjcf", ".urdf", ".sdf", ".world")  # files of boxes
_MESHES = (".stl", ".dae", ".ply", ".usd", ".usda", ".usdz", ".glb", ".gltf", ".fbx")

Number = Annotated[float, pydantic.AfterValidator(finite)]
Length = Annotated[float, pydantic.AfterValidator(length)]
Friction = Annotated[float, pydantic.Field(gt=0.0, le=1.0)]
Roughness = Annotated[float, pydantic.Field(ge=0.0, le=0.1)]


class _Strict(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(extra="forbid")


class GroundFile(_Strict):
    """`ground` of a scene file."""

    friction: Friction = 0.8


class BoxFile(_Strict):
    """One of `boxes` of a scene file.

    The third number of `position` is the height of the lower face, 0 without it; that
    of `Box.position` is the middle's.
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
            position=np.array([x, y, bottom + self.size[2] / 2]),
            rotation=matrix_from_rpy(self.rpy),
            friction=self.friction,
            roughness=self.roughness,
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
    friction: Friction = 0.8
    up: Literal["x", "y", "z", "-x", "-y", "-z"] | None = None
    start: tuple[Number, Number, Number] = (0.0, 0.0, 0.0)
    goal: tuple[Number, Number] | tuple[Number, Number, Number] | None = None

    @pydantic.field_validator("boxes")
    @classmethod
    def _unique(cls, boxes: list[BoxFile] | str) -> list[BoxFile] | str:
        if isinstance(boxes, str):
            return boxes
        names = [b.name for b in boxes] + [GROUND]
        if len(set(names)) != len(names):
            raise ValueError(f"expected different names, none of them {GROUND!r}")
        return boxes

    def scene(self, folder: Path = Path()) -> Scene:
        """The record; files that it names are in `folder`.

        Raises:
            InputError: A file that it names cannot be used.
        """
        friction = self.ground.friction
        if isinstance(self.boxes, str):
            boxes, drawn = read_boxes(folder / self.boxes, self.friction, self.up)
            if drawn is not None and "friction" not in self.ground.model_fields_set:
                friction = drawn
        else:
            boxes = [b.box() for b in self.boxes]
        return Scene(
            boxes=tuple(boxes),
            ground_friction=friction,
            start=np.array(self.start),
            goal=None if self.goal is None else np.array(self.goal),
        )


SceneLike = Scene | float | str | Path  # a scene, or what `load_scene` makes one of


@checks_types
def load_scene(path: SceneLike) -> Scene:
    """Read a `scene.yaml`, or the boxes of an OBJ, MJCF (`.xml`), URDF or SDF.

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
    drawn = path.suffix.lower() in DRAWN
    if path.suffix.lower() in _MESHES:
        expected = f"a scene.yaml, or boxes as {', '.join(DRAWN)}: export it as OBJ"
        raise InputError(expected, path)
    content = {"boxes": path.name} if drawn else read_yaml(path)
    file = validated(SceneFile, content, path)
    try:
        return file.scene(path.parent)
    except InputError as e:
        if drawn or not isinstance(file.boxes, str):
            raise
        source = path if e.source is None else f"{path}, {e.source}"
        raise InputError(e.expected, source, e.field, e.value) from e


def read_boxes(
    path: Path, friction: float, up: str | None = None
) -> tuple[list[Box], float | None]:
    """Boxes of a drawing, and the friction of the ground where it has one.

    Args:
        path: The file.
        friction: Of boxes of which it says none.
        up: The axis that points up in an OBJ; None for z, unless it is plainly y.

    Raises:
        InputError: It cannot be read, or a box of it cannot be used.
    """
    ground = None
    if path.suffix.lower() == ".obj":
        boxes = read_obj(path, up=up or "z", friction=friction)
        if up is None:
            _check_up(boxes, path)
    elif read_xml(path).tag == "sdf":
        boxes = read_sdf(path, friction)
    else:
        boxes, ground = read_described(path, friction)
    names = [b.name for b in boxes]
    for b in boxes:
        fault = None
        if names.count(b.name) > 1 or b.name == GROUND or not re.match(NAME, b.name):
            fault = f"a name of its own of letters, digits and _, not {GROUND!r}"
        elif max(np.abs(b.size).max(), np.abs(b.position).max()) > MAX_LENGTH:
            fault = f"metres, at most {MAX_LENGTH:g}: is it in millimetres?"
        elif not 0 < b.friction <= 1:
            fault = f"a friction above 0, at most 1, not {b.friction:g}"
        if fault:
            raise InputError(fault, path, f"box {b.name!r}")
    if ground is not None and not 0 < ground <= 1:
        raise InputError("a friction above 0, at most 1", path, "ground", ground)
    return boxes, ground


def _check_up(boxes: list[Box], path: Path) -> None:
    """Refuse a drawing that is half under the ground and stands on it with y up."""
    half = np.array([np.abs(b.rotation) @ b.size / 2 for b in boxes])
    low = np.min([b.position for b in boxes] - half, axis=0)
    if low[2] < -_SUNK and low[1] > -_SUNK:
        expected = (
            f"z up: it reaches {-low[2]:.2f} m under the ground, with y up it would "
            "stand on it; say so by `up: y` beside `boxes` in a scene.yaml, or `up: z`"
        )
        raise InputError(expected, path)


_SUNK = 0.01  # [m] what is drawn so little under the ground stands on it
