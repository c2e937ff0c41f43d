"""Boxes of a recording: an OBJ of eight vertices a box, upright, turned at will."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from clamber.errors import InputError
from clamber.scene import Box
from clamber.se3 import matrix_from_rpy

FLOOR = "floor"
_FIT = 2e-3  # [m] a vertex further than this from the fitted box is no box's
_THIN = 1e-3  # [m] what rises less above the ground is part of it


def read_obj_boxes(path: Path, scale: float = 1.0, up: str = "z") -> list[Box]:
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
    except (OSError, UnicodeDecodeError) as e:
        raise InputError("a readable OBJ file", source=path) from e
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
    boxes: list[Box] = []
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


def _fit_box(name: str, v: np.ndarray, path: Path) -> Box:
    """The upright box (8, 3) vertices belong to, in any order."""
    order = np.argsort(v[:, 2], kind="stable")
    base = v[order[:4]]
    # Of the three ways from one corner to the others the longest is the diagonal.
    ways = sorted((base[1:] - base[0])[:, :2], key=np.linalg.norm)
    yaw = float(np.arctan2(ways[1][1], ways[1][0]))
    yaw = (yaw + np.pi / 4) % (np.pi / 2) - np.pi / 4
    R = matrix_from_rpy([0.0, 0.0, yaw])
    local = v @ R
    low, high = local.min(axis=0), local.max(axis=0)
    off = np.minimum(np.abs(local - low), np.abs(local - high)).max()
    if off > _FIT or np.any(high - low < _FIT):
        raise InputError(
            "8 vertices of an upright box "
            f"(one is {off:.3f} m off; size {(high - low).round(3).tolist()})",
            source=path,
            field=name,
        )
    return Box(name=name, size=high - low, position=R @ (low + high) / 2, rotation=R)


def lower_to_ground(boxes: list[Box], ground: str, source: object) -> tuple:
    """What remains of the boxes over the chosen ground, and the height it had [m].

    Raises:
        InputError: No box has that name.
    """
    names = [b.name for b in boxes]
    if ground == FLOOR:
        level = 0.0
    elif ground in names:
        level = float(boxes[names.index(ground)].top.position[2])
    else:
        raise InputError(
            f"{FLOOR} or one of the boxes {names}",
            source=source,
            field="ground",
            value=ground,
        )
    kept = []
    for b in boxes:
        top = float(b.top.position[2]) - level
        if b.name == ground or top < _THIN:
            continue
        if abs(b.rotation[2, 2]) < 1 - 1e-9:  # a tilted box is lowered, never cut
            kept.append(replace(b, position=b.position - [0.0, 0.0, level]))
            continue
        bottom = max(float(b.position[2] - b.size[2] / 2) - level, 0.0)
        size = np.array([b.size[0], b.size[1], top - bottom])
        centre = np.array([b.position[0], b.position[1], (top + bottom) / 2])
        kept.append(replace(b, size=size, position=centre))
    return tuple(kept), level
