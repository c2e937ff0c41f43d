"""BVH: a hierarchy of joints with constant offsets and their angles over time.

A joint's rotation is the product of its channels in the order in which they are listed,
whichever that is; its position channels, where it has any, take the offset's place.
Positions follow by forward kinematics. An `End Site` becomes a point called after its
joint with `_end`.

Shapes: N samples of a block, J joints.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from clamber.errors import InputError
from clamber.recording.points import (
    MAX_POINTS,
    Points,
    read_table,
    say_count,
    unique_names,
)

MAGIC = b"HIERARCHY"
_LINE = 1 << 16  # [byte] a longer line of the hierarchy is none
_FRAMES = 1024  # samples whose kinematics are computed at once: they fit a cache


@dataclass(slots=True)
class _Joint:
    """A joint as it is read; `channels` are (kind, axis, column)."""

    name: str
    parent: int
    offset: np.ndarray
    channels: list[tuple[str, int, int]]


def read_bvh(path: Path) -> Points:
    """Joint centres of a BVH file.

    The file says neither unit nor axes; y is usually up.

    Raises:
        InputError: It is no such file, with the line and what was expected there.
        OSError: It cannot be opened.
    """
    with path.open("rb") as file:
        joints, columns, line = _read_hierarchy(file, path)
        count, rate, line = _read_motion(file, path, line)
        blocks = [
            _positions(joints, rows[k : k + _FRAMES])
            for rows in read_table(file, columns, None, line, path)
            for k in range(0, len(rows), _FRAMES)
        ]
    if not blocks:
        raise InputError("rows of numbers", path, f"line {line}")
    position = np.concatenate(blocks)
    return Points(
        names=unique_names(_names(joints)),
        position=position,
        rate=rate,
        usual_up="y",
        notes=tuple(say_count(len(position), count, "Frames")),
    )


def _names(joints: list[_Joint]) -> list[str]:
    """Joint names; those of several people are prefixed by the person's number."""
    roots = np.cumsum([j.parent < 0 for j in joints])
    names = [j.name for j in joints]
    if roots[-1] < 2 or len(set(names)) == len(names):
        return names
    return [f"{k}:{n}" for k, n in zip(roots, names, strict=True)]


def _read_hierarchy(file: BinaryIO, path: Path) -> tuple[list[_Joint], int, int]:
    """Joints, parents first; how many channels there are; lines read so far."""
    joints: list[_Joint] = []
    open_joints: list[int] = []  # the way from the root to where we are
    columns, line = 0, 0
    while text := file.readline(_LINE):
        line += 1
        words = text.decode("utf-8", "replace").split()
        match words:
            case [] | ["{"] | ["HIERARCHY"]:
                continue
            case ["MOTION"] if not open_joints and joints:
                return joints, columns, line
            case ["ROOT" | "JOINT", *name]:
                above = open_joints[-1] if open_joints else -1
                joints.append(_Joint(" ".join(name).strip("{ "), above, _ZERO, []))
                open_joints.append(len(joints) - 1)
            case ["End", *_] if open_joints:
                end = f"{joints[open_joints[-1]].name}_end"
                joints.append(_Joint(end, open_joints[-1], _ZERO, []))
                open_joints.append(len(joints) - 1)
            case ["}"] if open_joints:
                open_joints.pop()
            case ["OFFSET", *numbers] if open_joints and len(numbers) == 3:
                joints[open_joints[-1]].offset = _numbers(numbers, line, path)
            case ["CHANNELS", count, *kinds] if open_joints:
                if not count.isdecimal() or int(count) != len(kinds):
                    where = f"line {line}"
                    raise InputError(f"{count} channels", path, where, len(kinds))
                for kind in kinds:
                    channel = _channel(kind, columns, line, path)
                    joints[open_joints[-1]].channels.append(channel)
                    columns += 1
            case _:
                expected = (
                    "HIERARCHY, ROOT, JOINT, End Site, OFFSET x y z, CHANNELS, "
                    "braces in pairs, then MOTION"
                )
                found = " ".join(words)[:40]
                raise InputError(expected, path, f"line {line}", found)
        if max(len(joints), columns // 6) > MAX_POINTS:
            raise InputError(f"at most {MAX_POINTS} joints", path, f"line {line}")
    raise InputError("MOTION", path, f"line {line + 1}")


_ZERO = np.zeros(3)


def _channel(kind: str, column: int, line: int, path: Path) -> tuple[str, int, int]:
    axis, what = "XYZ".find(kind[:1].upper()), kind[1:].lower()
    if axis < 0 or what not in ("position", "rotation"):
        expected = "channels such as Xposition or Zrotation"
        raise InputError(expected, path, f"line {line}", kind[:40])
    return what, axis, column


def _numbers(words: list[str], line: int, path: Path) -> np.ndarray:
    try:
        x = np.array([float(w.replace(",", ".")) for w in words])
    except ValueError:
        x = np.array([np.nan])
    if not np.isfinite(x).all():
        raise InputError(f"{len(words)} finite numbers", path, f"line {line}")
    return x


def _read_motion(file: BinaryIO, path: Path, line: int) -> tuple[float, float, int]:
    """Stated number of rows, the rate [Hz], and the line of the first row."""
    said: list[float] = []
    for key in ("Frames:", "Frame Time:"):
        text = b"\n"
        while text and not text.strip():
            text, line = file.readline(_LINE), line + 1
        plain = " ".join(text.decode("utf-8", "replace").split())
        if not plain.lower().startswith(key.lower()):
            expected = f"`{key}` and a number"
            raise InputError(expected, path, f"line {line}", plain[:40])
        said.append(float(_numbers([plain[len(key) :]], line, path)[0]))
    count, step = said
    if not step > 0.0:
        raise InputError("a positive frame time", path, f"line {line}", step)
    return count, 1.0 / step, line + 1


def _positions(joints: list[_Joint], rows: np.ndarray) -> np.ndarray:
    """Forward kinematics: (N, J, 3) of (N, columns) channels.

    p_j = p_parent + R_parent (offset or channels), R_j = R_parent R_1 R_2 R_3
    """
    n = len(rows)
    out = np.empty((n, len(joints), 3))
    rotation: list[np.ndarray | None] = []  # (3, 3, N); None where it is never needed
    parents = {j.parent for j in joints}
    for k, joint in enumerate(joints):
        moved = np.repeat(joint.offset[:, None], n, axis=1)
        for what, axis, column in joint.channels:
            if what == "position":
                moved[axis] = rows[:, column]
        above = rotation[joint.parent] if joint.parent >= 0 else None
        if above is not None:
            moved = np.sum(above * moved, axis=1) + out[:, joint.parent].T
        out[:, k] = moved.T
        rotation.append(_turned(above, joint, rows) if k in parents else None)
    return out


def _turned(above: np.ndarray | None, joint: _Joint, rows: np.ndarray) -> np.ndarray:
    """R_parent times the joint's own rotations, one axis after the other (3, 3, N)."""
    R = np.repeat(np.eye(3)[:, :, None], len(rows), axis=2) if above is None else above
    for what, axis, column in joint.channels:
        if what == "rotation":
            angle = np.radians(rows[:, column])
            c, s = np.cos(angle), np.sin(angle)
            a, b = (axis + 1) % 3, (axis + 2) % 3
            R_new = R.copy()
            R_new[:, a] = R[:, a] * c + R[:, b] * s
            R_new[:, b] = R[:, b] * c - R[:, a] * s
            R = R_new
    return R
