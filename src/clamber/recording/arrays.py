"""Bare arrays of joint centres or markers: `.npy`, and `.npz` with names and rate.

Motions of robots and bodies, in `.npz` or pickles, are told here by their words and
handed on. Objects in arrays are programs and are refused; so is what would unpack to
more than is sane.
"""

from __future__ import annotations

import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from clamber.errors import InputError
from clamber.recording import robots, smpl
from clamber.recording.pickles import Plain, read_pickle
from clamber.recording.points import MAX_POINTS, Points, unique_names

NPY_MAGIC, NPZ_MAGIC = b"\x93NUMPY", b"PK\x03\x04"
MAX_BYTES = 2 << 30  # of an archive, unpacked: three hours of 60 points at 120 Hz
# What NumPy raises on files that are none; headers are Python literals.
_WRONG_FILE = (
    ValueError, EOFError, TypeError, AttributeError, SyntaxError, RecursionError,
    MemoryError, OverflowError, RuntimeError, tokenize.TokenError, zipfile.BadZipFile,
    zlib.error, NotImplementedError,
)  # fmt: skip
_FIELDS = {
    "positions": ("positions", "joints", "points"),
    "names": ("names", "joint_names"),
    "rate": ("rate", "fps", "mocap_framerate", "mocap_frame_rate"),
}
# Landmarks of MediaPipe's pose, as FreeMoCap's arrays have them.
_MEDIAPIPE = (
    "nose left_eye_inner left_eye left_eye_outer right_eye_inner right_eye "
    "right_eye_outer left_ear right_ear mouth_left mouth_right left_shoulder "
    "right_shoulder left_elbow right_elbow left_wrist right_wrist left_pinky "
    "right_pinky left_index right_index left_thumb right_thumb left_hip right_hip "
    "left_knee right_knee left_ankle right_ankle left_heel right_heel "
    "left_foot_index right_foot_index"
).split()
_WORDS = {*(w for words in _FIELDS.values() for w in words), *robots.WORDS, *smpl.WORDS}
USUAL = {n: names for n, (_, names) in smpl.JOINTS.items()} | {33: _MEDIAPIPE}


@dataclass(frozen=True, slots=True, kw_only=True)
class Given:
    """What the user states about an array, or a robot's or a body's motion.

    Attributes:
        names: Of the columns, in place of the file's own.
        rate: In place of the file's own [Hz].
        subject: Which of several motions.
        body_model: The file of SMPL's body model.
        robot: Whose motion it is: a built-in robot, or its robot.yaml.
    """

    names: Sequence[str] | None = None
    rate: float | None = None
    subject: str | None = None
    body_model: Path | None = None
    robot: str | None = None


def read_pickled(path: Path, given: Given) -> Points:
    """A motion in a pickle: of a robot, of a body, or of points.

    Raises:
        InputError: It is no such file, or more must be said of it.
        OSError: It cannot be opened.
    """
    found = read_pickle(path)
    if isinstance(found, Plain):
        found = found.state
    while isinstance(found, dict) and not _says(found):
        several = {str(k): v for k, v in found.items() if isinstance(v, dict)}
        if given.subject in several:
            found = several[given.subject]
        elif len(several) == 1:
            found = next(iter(several.values()))
        elif several:
            expected = f"which motion is meant: one of {sorted(several)[:20]}"
            raise InputError(expected, path, "subject")
        else:
            break
    if not isinstance(found, dict) or not _says(found):
        has = sorted(map(str, found))[:12] if isinstance(found, dict) else type(found)
        expected = (
            "root_pos, root_rot and dof_pos of a robot, poses of a body, or positions; "
            f"it has {has}"
        )
        raise InputError(expected, path)
    return _read_found({str(k): v for k, v in found.items()}, given, path)


def _says(found: Mapping[Any, object]) -> bool:
    words = {str(k) for k in found}
    known = words & {*_FIELDS["positions"]}
    return bool(known) or smpl.are_parameters(found) or robots.is_motion(found)


def _read_found(found: dict[str, Any], given: Given, path: Path) -> Points:
    """Points of a file's named arrays; positions go before poses."""
    for field, words in _FIELDS.items():
        if word := next((w for w in words if w in found), None):
            found.setdefault(field, found[word])
    positions = found.get("positions")
    shape = np.shape(positions) if positions is not None else ()
    if not (len(shape) == 3 and shape[2] == 3):
        if robots.is_motion(found):
            return robots.read_motion(found, given.robot, given.names, given.rate, path)
        if smpl.are_parameters(found):
            return smpl.read_body(found, given.body_model, given.rate, path)
    if positions is None:
        has = ", ".join(sorted(found)[:12])
        raise InputError(f"an array called `positions`; it has {has}", path)
    return _named(found, given, path)


def read_array(path: Path, given: Given) -> Points:
    """Positions (T, F, 3) of a `.npy`, or of a `.npz` with `positions`.

    Without names an array of 22, 24, 52 or 55 joints is taken for one of SMPL's, one of
    33 for MediaPipe's. An `.npz` may hold a robot's or a body's motion instead.

    Raises:
        InputError: It is no such file, or nothing says its names or rate.
        OSError: It cannot be opened.
    """
    return _read_found(_load(path), given, path)


def _named(found: Mapping[str, Any], given: Given, path: Path) -> Points:
    """Positions with their names and rate."""
    names, rate = given.names, given.rate
    raw = np.asarray(found["positions"])
    if raw.dtype.kind not in "fiu":
        raise InputError("numbers", path, "dtype", str(raw.dtype))
    if raw.ndim != 3 or raw.shape[2] != 3 or raw.shape[1] > MAX_POINTS:
        expected = f"an array (samples, points, 3) of at most {MAX_POINTS} points"
        raise InputError(expected, path, "shape", raw.shape)
    count = raw.shape[1]
    if names is None and "names" in found:
        listed = np.asarray(found["names"])
        if listed.dtype.kind not in "US" or listed.ndim != 1:
            raise InputError("a list of names", path, "names")
        names = listed.astype(str).tolist()
    if names is None and count in USUAL:
        names = USUAL[count]
    if rate is None and "rate" in found:
        said = np.asarray(found["rate"])
        if said.size != 1 or said.dtype.kind not in "fiu":
            raise InputError("a number [Hz]", path, "rate")
        rate = said.item()
    none = "a value: a bare array has none of its own"
    if names is None:
        raise InputError(none, path, "names")
    if rate is None:
        raise InputError(none, path, "rate")
    if len(names) != count:
        raise InputError(f"{count} names, one a point", path, "names", len(names))
    if len(set(names)) != count:
        twice = next(n for n in names if list(names).count(n) > 1)
        raise InputError("different names", path, "names", twice)
    if raw.dtype.kind != "f" or raw.dtype.itemsize < 4:  # half precision ends at 65504
        raw = raw.astype(np.float32)
    return Points(names=unique_names(names), position=raw, rate=rate)


def _load(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a file that say something to a reader."""
    try:
        with warnings.catch_warnings(), path.open("rb") as file:
            warnings.simplefilter("ignore")  # of headers that are odd but readable
            if file.read(2) != NPZ_MAGIC[:2]:
                # Mapped, not read: a header may claim more than the file holds.
                return {"positions": np.array(np.load(path, mmap_mode="r"))}
            with zipfile.ZipFile(file) as archive:
                size = sum(i.file_size for i in archive.infolist())
            if size > MAX_BYTES:
                expected = f"at most {MAX_BYTES} bytes, unpacked"
                raise InputError(expected, path, value=size)
            with np.load(path, allow_pickle=False) as z:
                return {k: z[k] for k in z.files if k in _WORDS}
    except _WRONG_FILE as e:
        expected = f"an array of NumPy without pickled objects ({_fault(e)})"
        raise InputError(expected, path) from e


def _fault(error: BaseException) -> str:
    """NumPy's error message, on one line."""
    return " ".join(str(error).split())[:80] or type(error).__name__
