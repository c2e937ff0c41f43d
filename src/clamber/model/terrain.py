"""Files of a scene -> `Scene`: a scene.yaml, or the boxes of a drawing.

A drawing is an OBJ with eight vertices a box, or the fixed boxes of an MJCF.
"""

from __future__ import annotations

import itertools
import re
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import mujoco
import numpy as np
import pydantic

from clamber.errors import InputError, read_yaml, unreadable, validated
from clamber.model.arguments import checks_types
from clamber.model.description import compile_description, read_description
from clamber.model.scene import GROUND, MAX_LENGTH, Box, Scene, finite, length
from clamber.model.se3 import matrix_from_rpy

NAME = r"^[A-Za-z][A-Za-z0-9_]*$"  # of a box
DRAWN = (".obj", ".xml")  # files of boxes
DEFAULT_FRICTION = 0.8
_LARGEST = 1e6  # [m]
_FIT = 2e-3  # [m] a vertex further than this from the fitted box is no box's

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
    """One of `boxes` of a scene file."""

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

    `boxes` may be the name of an OBJ or MJCF file beside it; `friction` is then that of
    boxes which the file gives none.
    """

    version: int = 1
    ground: GroundFile = GroundFile()
    boxes: list[BoxFile] | str = []
    friction: Friction = 0.8
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
            boxes, drawn = read_boxes(folder / self.boxes, self.friction)
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
    """Read a `scene.yaml`, or the boxes of an OBJ or MJCF (`.xml`).

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
    content = {"boxes": path.name} if drawn else read_yaml(path)
    return validated(SceneFile, content, path).scene(path.parent)


def read_boxes(path: Path, friction: float) -> tuple[list[Box], float | None]:
    """Boxes of an OBJ or MJCF, and the friction of the ground where it has one.

    Args:
        path: The file.
        friction: Of boxes of which it says none.

    Raises:
        InputError: It cannot be read, or a box of it cannot be used.
    """
    if path.suffix.lower() == ".obj":
        boxes, ground = read_obj(path, friction=friction), None
    else:
        boxes, ground = read_mjcf_boxes(path)
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


def read_obj(
    path: Path,
    scale: float = 1.0,
    up: str = "z",
    friction: float = DEFAULT_FRICTION,
) -> list[Box]:
    """Boxes of an OBJ in the order of the file.

    An object (`o` or `g`) of eight vertices gives its box its name; a file without
    objects holds eight vertices a box, which are called `box1`, `box2` and so on.

    Args:
        path: The file.
        scale: Metres per unit.
        up: The axis that points up in it.
        friction: Of the boxes.

    Raises:
        InputError: It is no such file.
    """
    groups: list[tuple[str | None, list[list[float]]]] = [(None, [])]
    try:
        lines = path.read_text().splitlines()
    except OSError as e:
        raise unreadable(path, e) from e
    except UnicodeDecodeError as e:
        raise InputError("an OBJ file, in UTF-8", path) from e
    for number, line in enumerate(lines, start=1):
        word, *rest = line.split() or [""]
        if word in ("o", "g") and rest:
            groups.append((rest[0], []))
        elif word == "v":
            try:
                x = [float(a) for a in rest[:3]]
            except ValueError:
                x = []
            if len(x) != 3 or not np.all(np.isfinite(x)):
                raise InputError("three finite numbers", path, f"line {number}")
            groups[-1][1].append(x)
    boxes: list[Box] = []
    groups = [(name, v) for name, v in groups if v]
    if not groups or any(len(v) % 8 for _, v in groups):
        count = sum(len(v) for _, v in groups)
        raise InputError("8 vertices a box", path, "v", count)
    for name, vertices in groups:
        v = to_z_up(scale * np.array(vertices), up)
        for k in range(0, len(v), 8):
            single = name if name is not None and len(v) == 8 else None
            box = _fit_box(single or f"box{len(boxes) + 1}", v[k : k + 8], path)
            boxes.append(replace(box, friction=friction))
    return boxes


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
        raise InputError(
            "8 vertices of a box "
            f"(one is {off:.3f} m off; size {(high - low).round(3).tolist()})",
            path,
            name,
        )
    return Box(name=name, size=high - low, position=R @ (low + high) / 2, rotation=R)


def _extent(v: np.ndarray, R: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """How far vertices are from a box along the axes `R`, its low and high corner."""
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


def read_mjcf_boxes(path: Path) -> tuple[list[Box], float | None]:
    """Box geoms of an MJCF that are fixed to the world, and its plane's friction.

    Raises:
        InputError: It is no MJCF, or holds other fixed shapes than boxes and a plane.
    """
    model = compile_description(read_description(path), path)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    boxes, ground = [], None
    for g in range(model.ngeom):
        fixed = model.body_weldid[model.geom_bodyid[g]] == 0
        solid = model.geom_contype[g] or model.geom_conaffinity[g]
        if not fixed or not solid:
            continue
        kind = mujoco.mjtGeom(int(model.geom_type[g]))
        name = model.geom(g).name
        if kind == mujoco.mjtGeom.mjGEOM_PLANE:
            ground = float(model.geom_friction[g, 0])
            continue
        if kind != mujoco.mjtGeom.mjGEOM_BOX:
            what = kind.name.removeprefix("mjGEOM_").lower()
            raise InputError("boxes and a plane", path, f"geom {name!r}", what)
        if not re.match(NAME, name):
            name = f"box{len(boxes) + 1}"
        boxes.append(
            Box(
                name=name,
                size=2.0 * model.geom_size[g],
                position=data.geom_xpos[g].copy(),
                rotation=data.geom_xmat[g].reshape(3, 3).copy(),
                friction=float(model.geom_friction[g, 0]),
            )
        )
    if not boxes:
        raise InputError("a box that is fixed to the world", path, "geom")
    return boxes, ground
