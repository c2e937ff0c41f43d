"""Bare arrays of joint centres or markers: `.npy`, and `.npz` with names and rate.

Pickles are programs and are refused; so is what would unpack to more than is sane.
"""

from __future__ import annotations

import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from clamber.errors import InputError
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
# Joints of the SMPL bodies, in order; arrays of them often come without names.
_SMPL_22 = (
    "pelvis left_hip right_hip spine1 left_knee right_knee spine2 left_ankle "
    "right_ankle spine3 left_foot right_foot neck left_collar right_collar head "
    "left_shoulder right_shoulder left_elbow right_elbow left_wrist right_wrist"
).split()
_FINGERS = [
    f"{{side}}_{f}{k}" for f in ("index", "middle", "pinky", "ring", "thumb")
    for k in (1, 2, 3)
]  # fmt: skip
_HANDS = [f.format(side=s) for s in ("left", "right") for f in _FINGERS]
SMPL = {
    22: ("SMPL body", _SMPL_22),
    24: ("SMPL", [*_SMPL_22, "left_hand", "right_hand"]),
    52: ("SMPL-H", [*_SMPL_22, *_HANDS]),
    55: ("SMPL-X", [*_SMPL_22, "jaw", "left_eye_smplhf", "right_eye_smplhf", *_HANDS]),
}


def read_array(
    path: Path, *, names: Sequence[str] | None = None, rate: float | None = None
) -> Points:
    """Positions (T, F, 3) of a `.npy`, or of a `.npz` with `positions`.

    Without names an array of 22, 24, 52 or 55 joints is taken for one of SMPL's.

    Args:
        path: The file.
        names: Of the columns, in place of the file's own.
        rate: In place of the file's own [Hz].

    Raises:
        InputError: It is no such file, or nothing says its names or rate.
        OSError: It cannot be opened.
    """
    found = _load(path)
    if "positions" not in found:
        raise InputError("an array called `positions`", path)
    raw = found["positions"]
    if raw.dtype.kind not in "fiu":
        raise InputError("numbers", path, "dtype", str(raw.dtype))
    if raw.ndim != 3 or raw.shape[2] != 3 or raw.shape[1] > MAX_POINTS:
        expected = f"an array (samples, points, 3) of at most {MAX_POINTS} points"
        raise InputError(expected, path, "shape", raw.shape)
    count = raw.shape[1]
    if names is None and "names" in found:
        if found["names"].dtype.kind != "U" or found["names"].ndim != 1:
            raise InputError("a list of names", path, "names")
        names = found["names"].tolist()
    if names is None and count in SMPL:
        names = SMPL[count][1]
    if rate is None and "rate" in found:
        if found["rate"].size != 1 or found["rate"].dtype.kind not in "fiu":
            raise InputError("a number [Hz]", path, "rate")
        rate = found["rate"].item()
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
    """The arrays of `_FIELDS` that a file has."""
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
                return {
                    field: z[word]
                    for field, words in _FIELDS.items()
                    for word in words[::-1]
                    if word in z
                }
    except _WRONG_FILE as e:
        expected = f"an array of NumPy without pickled objects ({_fault(e)})"
        raise InputError(expected, path) from e


def _fault(error: BaseException) -> str:
    """What NumPy says of a file, on one line."""
    return " ".join(str(error).split())[:80] or type(error).__name__
