"""Bare arrays of joint centres or markers: `.npy`, and `.npz` with names and rate.

Nothing in them is believed before it is checked: a header may claim more than the file
holds, an archive may unpack to a thousand times its size, and pickles are programs.
"""

from __future__ import annotations

import io
import math
import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np

from clamber.errors import InputError
from clamber.recording.points import MAX_POINTS, Points, unique_names

NPY_MAGIC, NPZ_MAGIC = b"\x93NUMPY", b"PK\x03\x04"
_RATIO = 8  # an archive of recorded numbers never shrinks so far
_SLACK = 1 << 16  # [byte] small archives may
_MAX_NAME = 200  # characters
# What NumPy raises on headers that are none: they are Python literals.
_WRONG_HEADER = (
    ValueError, EOFError, TypeError, SyntaxError, RecursionError, MemoryError,
    tokenize.TokenError,
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
    with path.open("rb") as file:
        magic = file.read(len(NPY_MAGIC))
        file.seek(0)
        if magic.startswith(NPZ_MAGIC[:2]):
            raw, own_names, own_rate = _read_npz(file, path)
        else:
            size = path.stat().st_size
            raw, own_names, own_rate = _read_npy(file, size, path), None, None
    if raw.dtype.kind not in "fiu":
        raise InputError("numbers", source=path, field="dtype", value=str(raw.dtype))
    if raw.ndim != 3 or raw.shape[2] != 3:
        raise InputError(
            "an array (samples, points, 3)", source=path, field="shape",
            value=raw.shape,
        )  # fmt: skip
    if raw.shape[1] > MAX_POINTS:
        raise InputError(
            f"at most {MAX_POINTS} points", source=path, field="shape", value=raw.shape
        )
    names = own_names if names is None else names
    if names is None and raw.shape[1] in SMPL:
        names = SMPL[raw.shape[1]][1]
    rate = own_rate if rate is None else rate
    for field, value in (("names", names), ("rate", rate)):
        if value is None:
            raise InputError(
                "a value: a bare array has none of its own", source=path, field=field
            )
    assert names is not None
    assert rate is not None
    if len(names) != raw.shape[1]:
        raise InputError(
            f"{raw.shape[1]} names, one a point", source=path, field="names",
            value=len(names),
        )  # fmt: skip
    if len(set(names)) != len(names):
        twice = next(n for n in names if list(names).count(n) > 1)
        raise InputError("different names", source=path, field="names", value=twice)
    if raw.dtype.kind != "f":
        raw = raw.astype(np.float32)
    return Points(names=unique_names(names), position=raw, rate=rate)


def _read_npy(file: BinaryIO, size: int, path: Path, member: str = "") -> np.ndarray:
    """One array, after its header has been held against the bytes there are."""
    field = member or None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of headers that are odd but readable
            version = np.lib.format.read_magic(file)
            read = {
                (1, 0): np.lib.format.read_array_header_1_0,
                (2, 0): np.lib.format.read_array_header_2_0,
            }.get(version)
            if read is None:
                raise ValueError("version")
            shape, fortran, dtype = read(file)
    except _WRONG_HEADER as e:
        raise InputError(
            "an array of NumPy, version 1 or 2, that is not pickled", source=path,
            field=field or "byte 0",
        ) from e  # fmt: skip
    if dtype.hasobject or dtype.names is not None or dtype.subdtype is not None:
        raise InputError(
            "plain numbers or text; objects are programs and are refused",
            source=path,
            field=": ".join(x for x in (member, "dtype") if x),
            value=str(dtype),
        )
    start = file.tell()
    count = math.prod(shape)
    if min(shape, default=0) < 0 or start + count * dtype.itemsize > size:
        raise InputError(
            f"{count * dtype.itemsize} bytes from byte {start} on, as its header says",
            source=path,
            field=field or f"byte {size}",
        )
    raw = file.read(count * dtype.itemsize)
    if len(raw) < count * dtype.itemsize:
        raise InputError(
            "as many bytes as its header says", source=path,
            field=field or f"byte {start + len(raw)}",
        )  # fmt: skip
    array = np.frombuffer(raw, dtype=dtype) if raw else np.empty(0, dtype)
    return array.reshape(shape, order="F" if fortran else "C")


def _read_npz(
    file: BinaryIO, path: Path
) -> tuple[np.ndarray, list[str] | None, float | None]:
    """Positions, and names and rate where the archive has them."""
    try:
        with zipfile.ZipFile(file) as archive:
            inside = {i.filename.removesuffix(".npy"): i for i in archive.infolist()}
            found: dict[str, np.ndarray] = {}
            for field, words in _FIELDS.items():
                word = next((w for w in words if w in inside), None)
                if word is not None:
                    found[field] = _read_member(archive, inside[word], path)
    except OSError:
        raise
    except (
        zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, ValueError,
        NotImplementedError, OverflowError, AttributeError, TypeError,
    ) as e:  # fmt: skip
        raise InputError("a whole .npz archive", source=path, field="byte 0") from e
    if "positions" not in found:
        raise InputError("an array called `positions`", source=path, value=list(inside))
    names = None
    if "names" in found:
        raw = found["names"]
        short = raw.dtype.itemsize <= 4 * _MAX_NAME
        if raw.dtype.kind not in "US" or raw.ndim != 1 or not short:
            raise InputError(
                f"a list of names, each at most {_MAX_NAME} characters long",
                source=path,
                field="names",
            )
        names = [
            n.decode("utf-8", "replace") if isinstance(n, bytes) else str(n)
            for n in raw.tolist()
        ]
    rate = None
    if "rate" in found:
        if found["rate"].size != 1 or found["rate"].dtype.kind not in "fiu":
            raise InputError("a number [Hz]", source=path, field="rate")
        rate = float(found["rate"].ravel()[0])
    return found["positions"], names, rate


def _read_member(
    archive: zipfile.ZipFile, info: zipfile.ZipInfo, path: Path
) -> np.ndarray:
    """One array of the archive; never more bytes than are fair for its size."""
    most = _RATIO * info.compress_size + _SLACK
    if info.file_size > most:
        raise InputError(
            f"an array of at most {_RATIO} times its packed size "
            f"({info.compress_size} bytes)",
            source=path,
            field=info.filename,
            value=info.file_size,
        )
    with archive.open(info) as packed:
        content = packed.read(most)
    return _read_npy(io.BytesIO(content), len(content), path, info.filename)
