"""Boxes of a drawing: OBJ with eight vertices a box, or the fixed boxes of an MJCF."""

from __future__ import annotations

import itertools
import re
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from clamber.errors import InputError, unreadable
from clamber.model.description import compile_description, read_description
from clamber.model.se3 import matrix_from_rpy

NAME = r"^[A-Za-z][A-Za-z0-9_]*$"  # of a box
_LARGEST = 1e6  # [m]
_FIT = 2e-3  # [m] a vertex further than this from the fitted box is no box's


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class DrawnBox:
    """A box as it is drawn.

    Attributes:
        name: Its own, or `box1`, `box2` and so on.
        size: (3,) full lengths [m].
        position: (3,) centre in the world [m].
        rotation: (3, 3) R_WB.
        friction: Coulomb coefficient; None where the drawing says none.
    """

    name: str
    size: np.ndarray
    position: np.ndarray
    rotation: np.ndarray
    friction: float | None = None


def read_drawn_boxes(path: Path) -> tuple[list[DrawnBox], float | None]:
    """Boxes of an OBJ [m, z up] or MJCF, and the friction of the ground in it.

    Raises:
        InputError: It is neither, or holds no box.
    """
    if path.suffix.lower() == ".obj":
        return read_obj(path), None
    return read_mjcf_boxes(path)


def read_obj(path: Path, scale: float = 1.0, up: str = "z") -> list[DrawnBox]:
    """Boxes of an OBJ in the order of the file.

    An object (`o` or `g`) of eight vertices gives its box its name; a file without
    objects holds eight vertices a box, which are called `box1`, `box2` and so on.

    Args:
        path: The file.
        scale: Metres per unit.
        up: The axis that points up in it.

    Raises:
        InputError: It is no such file.
    """
    groups: list[tuple[str | None, list[list[float]]]] = [(None, [])]
    try:
        lines = path.read_text().splitlines()
    except OSError as e:
        raise unreadable(path, e) from e
    except UnicodeDecodeError as e:
        raise InputError("an OBJ file, in UTF-8", source=path) from e
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
                raise InputError(
                    "three finite numbers", source=path, field=f"line {number}"
                )
            groups[-1][1].append(x)
    boxes: list[DrawnBox] = []
    groups = [(name, v) for name, v in groups if v]
    if not groups or any(len(v) % 8 for _, v in groups):
        count = sum(len(v) for _, v in groups)
        raise InputError("8 vertices a box", source=path, field="v", value=count)
    for name, vertices in groups:
        v = to_z_up(scale * np.array(vertices), up)
        for k in range(0, len(v), 8):
            single = name if name is not None and len(v) == 8 else None
            boxes.append(_fit_box(single or f"box{len(boxes) + 1}", v[k : k + 8], path))
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


def _fit_box(name: str, v: np.ndarray, path: Path) -> DrawnBox:
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
            source=path,
            field=name,
        )
    return DrawnBox(
        name=name, size=high - low, position=R @ (low + high) / 2, rotation=R
    )


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


def read_mjcf_boxes(path: Path) -> tuple[list[DrawnBox], float | None]:
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
            raise InputError(
                "boxes and a plane",
                source=path,
                field=f"geom {name!r}",
                value=kind.name.removeprefix("mjGEOM_").lower(),
            )
        if not re.match(NAME, name):
            name = f"box{len(boxes) + 1}"
        boxes.append(
            DrawnBox(
                name=name,
                size=2.0 * model.geom_size[g],
                position=data.geom_xpos[g].copy(),
                rotation=data.geom_xmat[g].reshape(3, 3).copy(),
                friction=float(model.geom_friction[g, 0]),
            )
        )
    if not boxes:
        raise InputError("a box that is fixed to the world", source=path, field="geom")
    return boxes, ground
