"""Boxes of a recording, and which of them is the ground."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from clamber.errors import InputError
from clamber.model.scene import Box
from clamber.model.terrain import read_obj

FLOOR = "floor"
_THIN = 1e-3  # [m] what rises less above the ground is part of it


def read_obj_boxes(path: Path, scale: float = 1.0, up: str = "z") -> list[Box]:
    """Boxes of an OBJ in the order of the file; see `read_obj`."""
    return read_obj(path, scale, up)


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
