"""The scene: a ground plane and boxes, whose flat tops are the supports.

A `Support` frame P has its origin in the middle of the surface and z along the outward
normal; its convex polygon is given in that frame's x and y, counter-clockwise.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import pydantic
import yaml

from clamber.errors import InputError, unreadable
from clamber.model.records import frozen_array, short_repr
from clamber.model.se3 import matrix_from_rpy
from clamber.model.terrain import NAME, read_drawn_boxes

GROUND = "ground"
DRAWN = (".obj", ".xml")  # files of boxes
GROUND_HALF_SIZE = 20.0  # [m] the ground is a support of this half width
NEAR_FACE = 0.23  # [m] from the ankles' midpoint to the box of `Scene.from_height`
MAX_LENGTH = 50.0  # [m] a larger box is a wrong unit


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Support:
    """A flat convex region that can bear load.

    Attributes:
        name: `ground`, or the box whose top it is.
        position: (3,) origin of P in the world [m].
        rotation: (3, 3) R_WP; its last column is the outward normal.
        polygon: (K, 2) vertices in P, counter-clockwise [m].
        friction: Coulomb coefficient mu.
        normal: (3,) outward normal in the world.
    """

    name: str
    position: np.ndarray
    rotation: np.ndarray
    polygon: np.ndarray
    friction: float
    normal: np.ndarray = field(init=False)
    _half_planes: tuple[np.ndarray, np.ndarray] = field(init=False, repr=False)

    __repr__ = short_repr

    def __post_init__(self) -> None:
        """Copy the arrays and check that the polygon is convex, ccw."""
        object.__setattr__(self, "position", frozen_array(self.position, (3,)))
        object.__setattr__(self, "rotation", frozen_array(self.rotation, (3, 3)))
        object.__setattr__(self, "normal", frozen_array(self.rotation[:, 2], (3,)))
        object.__setattr__(self, "polygon", frozen_array(self.polygon, (-1, 2)))
        edges = np.roll(self.polygon, -1, axis=0) - self.polygon
        nxt = np.roll(edges, -1, axis=0)
        if np.any(edges[:, 0] * nxt[:, 1] - edges[:, 1] * nxt[:, 0] <= 0):
            raise ValueError(f"support {self.name}: polygon is not convex, ccw")
        out = np.stack([edges[:, 1], -edges[:, 0]], axis=1)
        out /= np.linalg.norm(out, axis=1, keepdims=True)
        b = np.sum(out * self.polygon, axis=1)
        A = out @ self.rotation[:, :2].T
        planes = frozen_array(A, (-1, 3)), frozen_array(b + A @ self.position, (-1,))
        object.__setattr__(self, "_half_planes", planes)

    def height(self, points: np.ndarray) -> np.ndarray:
        """Signed distance (...,) of world points (..., 3) over the plane [m]."""
        return (points - self.position) @ self.normal

    def project(self, points: np.ndarray) -> np.ndarray:
        """World points (..., 3) moved along the normal onto the plane."""
        return points - self.height(points)[..., None] * self.normal

    def edges(self) -> tuple[np.ndarray, np.ndarray]:
        """Half-planes `A p <= b` of the polygon, A (K, 3) in the world, b (K,)."""
        return self._half_planes

    def inside(self, points: np.ndarray, margin: float = 0.0) -> np.ndarray:
        """Whether world points (..., 3) project at least `margin` inside [m]."""
        A, b = self.edges()
        return np.all(points @ A.T <= b - margin, axis=-1)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Box:
    """A box obstacle: full lengths, centre and rotation in the world.

    Its faces are uneven by about `roughness` [m]: what is no contact keeps so much more
    distance from them.
    """

    name: str
    size: np.ndarray
    position: np.ndarray
    rotation: np.ndarray
    friction: float = 0.8
    roughness: float = 0.0

    __repr__ = short_repr

    def __post_init__(self) -> None:
        """Copy the arrays and check their shapes."""
        object.__setattr__(self, "size", frozen_array(self.size, (3,)))
        object.__setattr__(self, "position", frozen_array(self.position, (3,)))
        object.__setattr__(self, "rotation", frozen_array(self.rotation, (3, 3)))

    @property
    def top(self) -> Support:
        """The face whose outward normal is most upright."""
        axis = int(np.argmax(np.abs(self.rotation[2])))
        sign = 1.0 if self.rotation[2, axis] >= 0 else -1.0
        i, j = (axis + 1) % 3, (axis + 2) % 3
        R = np.stack(
            [
                self.rotation[:, i],
                self.rotation[:, j] * sign,
                self.rotation[:, axis] * sign,
            ],
            axis=1,
        )
        hx, hy = self.size[i] / 2, self.size[j] / 2
        return Support(
            name=self.name,
            position=self.position + R[:, 2] * self.size[axis] / 2,
            rotation=R,
            polygon=np.array([[-hx, -hy], [hx, -hy], [hx, hy], [-hx, hy]]),
            friction=self.friction,
        )


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Scene:
    """Ground and boxes, where the robot starts and where it should get.

    Attributes:
        boxes: Obstacles; the first is the one to climb where no goal is named.
        ground_friction: Coulomb coefficient of the ground.
        start: (3,) ankles' midpoint x, y [m] and yaw [rad].
        goal: (2,) pelvis x, y or (3,) with yaw; None for "on top of the first box".
    """

    boxes: tuple[Box, ...] = ()
    ground_friction: float = 0.8
    start: np.ndarray
    goal: np.ndarray | None = None

    __repr__ = short_repr

    def __post_init__(self) -> None:
        """Copy the arrays and check that names are unique."""
        object.__setattr__(self, "start", frozen_array(self.start, (3,)))
        if self.goal is not None:
            object.__setattr__(self, "goal", frozen_array(self.goal, (-1,)))
        names = [b.name for b in self.boxes]
        if len({*names, GROUND}) != len(names) + 1:
            raise ValueError(f"names are not unique: {names}")

    @property
    def ground(self) -> Support:
        """The plane z = 0."""
        s = GROUND_HALF_SIZE
        return Support(
            name=GROUND,
            position=np.zeros(3),
            rotation=np.eye(3),
            polygon=np.array([[-s, -s], [s, -s], [s, s], [-s, s]]),
            friction=self.ground_friction,
        )

    @property
    def supports(self) -> tuple[Support, ...]:
        """Ground first, then the tops of the boxes in order."""
        return (self.ground, *(b.top for b in self.boxes))

    def support(self, name: str) -> Support:
        """The support of that name; KeyError lists those that exist."""
        for s in self.supports:
            if s.name == name:
                return s
        raise KeyError(
            f"no support {name!r}; there are {[s.name for s in self.supports]}"
        )

    @classmethod
    def from_height(cls, height: float, friction: float = 0.8) -> Scene:
        """One box of 1.0 x 1.2 x height m, its near face 0.23 m from the ankles."""
        return SceneFile.model_validate(
            {
                "ground": {"friction": friction},
                "boxes": [
                    {
                        "name": "box",
                        "size": [1.0, 1.2, height],
                        "position": [NEAR_FACE + 0.5, 0.0],
                        "friction": friction,
                    }
                ],
            }
        ).scene()


def _finite(x: float) -> float:
    if not math.isfinite(x):
        raise ValueError("expected a finite number")
    if abs(x) > MAX_LENGTH:
        raise ValueError(
            f"expected metres or radians, at most {MAX_LENGTH:g}: is it in millimetres?"
        )
    return x


def _positive(x: float) -> float:
    if x <= 0:
        raise ValueError("expected a positive length [m]")
    return x


Number = Annotated[float, pydantic.AfterValidator(_finite)]
Length = Annotated[
    float, pydantic.AfterValidator(_finite), pydantic.AfterValidator(_positive)
]
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
        if isinstance(self.boxes, str):
            boxes, friction = drawn_boxes(folder / self.boxes, self.friction)
            if friction is None or "friction" in self.ground.model_fields_set:
                friction = self.ground.friction
            return Scene(
                boxes=boxes,
                ground_friction=friction,
                start=np.array(self.start),
                goal=None if self.goal is None else np.array(self.goal),
            )
        boxes = []
        for b in self.boxes:
            bottom = b.position[2] if len(b.position) == 3 else 0.0
            centre = [b.position[0], b.position[1], bottom + b.size[2] / 2]
            boxes.append(
                Box(
                    name=b.name,
                    size=np.array(b.size),
                    position=np.array(centre),
                    rotation=matrix_from_rpy(b.rpy),
                    friction=b.friction,
                    roughness=b.roughness,
                )
            )
        return Scene(
            boxes=tuple(boxes),
            ground_friction=self.ground.friction,
            start=np.array(self.start),
            goal=None if self.goal is None else np.array(self.goal),
        )


def drawn_boxes(path: Path, friction: float) -> tuple[tuple[Box, ...], float | None]:
    """Boxes of an OBJ or MJCF, and the friction of the ground where it has one.

    Args:
        path: The file.
        friction: Of boxes of which it says none.

    Raises:
        InputError: It cannot be read, or a box of it cannot be used.
    """
    drawn, ground = read_drawn_boxes(path)
    names = [b.name for b in drawn]
    for b in drawn:
        fault = None
        if names.count(b.name) > 1 or b.name == GROUND or not re.match(NAME, b.name):
            fault = f"a name of its own of letters, digits and _, not {GROUND!r}"
        elif max(np.abs(b.size).max(), np.abs(b.position).max()) > MAX_LENGTH:
            fault = f"metres, at most {MAX_LENGTH:g}: is it in millimetres?"
        elif b.friction is not None and not 0 < b.friction <= 1:
            fault = f"a friction above 0, at most 1, not {b.friction:g}"
        if fault:
            raise InputError(fault, source=path, field=f"box {b.name!r}")
    boxes = tuple(
        Box(
            name=b.name,
            size=b.size,
            position=b.position,
            rotation=b.rotation,
            friction=friction if b.friction is None else b.friction,
        )
        for b in drawn
    )
    if ground is not None and not 0 < ground <= 1:
        raise InputError(
            "a friction above 0, at most 1", source=path, field="ground", value=ground
        )
    return boxes, ground


def input_error(error: pydantic.ValidationError, source: object) -> InputError:
    """The first fault of a validation as one sentence with file, field and value."""
    first = error.errors()[0]
    # Where a field may be one of two shapes, pydantic adds the shape to the path.
    where = ".".join(
        x
        for x in map(str, first["loc"])
        if not x.startswith(("tuple[", "union[", "list["))
    )
    text = first["msg"].removeprefix("Value error, ").removeprefix("expected ")
    text = text.removeprefix("Input should be ")
    value = first.get("input")
    if first["type"] == "missing":
        text, value = "a value: it is missing", None
    elif first["type"] == "extra_forbidden":
        text = "no such field: mend its name, or leave it out"
    if not where:  # the fields together are wrong: their values are no help
        return InputError(text, source=source)
    return InputError(text, source=source, field=where, value=value)


def read_yaml(path: Path) -> dict:
    """A YAML mapping from disk.

    Raises:
        InputError: The file is missing, unreadable or no mapping.
    """
    try:
        content = yaml.safe_load(path.read_text())
    except OSError as e:
        raise unreadable(path, e) from e
    except (yaml.YAMLError, UnicodeDecodeError) as e:
        raise InputError(f"YAML ({_fault(e)})", source=path) from e
    if not isinstance(content, dict):
        raise InputError(
            "a mapping of fields", source=path, value=type(content).__name__
        )
    return content


def _fault(error: yaml.YAMLError | UnicodeDecodeError) -> str:
    """What is wrong with a YAML file, and in which line."""
    if isinstance(error, yaml.MarkedYAMLError) and error.problem_mark is not None:
        return f"line {error.problem_mark.line + 1}: {error.problem}"
    return str(error).splitlines()[0]


def load_scene(path: str | Path) -> Scene:
    """Read a `scene.yaml`, or the boxes of an OBJ or MJCF (`.xml`).

    Raises:
        InputError: The file or one of its fields cannot be used.
    """
    path = Path(path)
    try:
        if path.suffix.lower() in DRAWN:
            return SceneFile(boxes=path.name).scene(path.parent)
        return SceneFile.model_validate(read_yaml(path)).scene(path.parent)
    except pydantic.ValidationError as e:
        raise input_error(e, path) from e
