"""C3D, the exchange format of motion capture: 512-byte blocks, parameters, samples.

Read here rather than through `ezc3d`: that library holds each marker of
each sample as an object and trusts the counts in the file (see docs/recordings.md).
The tests compare both on the same files.

A marker's sample is x, y, z and a fourth word that is negative where the marker was not
seen. Numbers are floats or scaled integers, of Intel, MIPS or DEC byte order.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from clamber.errors import InputError
from clamber.recording.points import MAX_POINTS, Points, unique_names, unit_of

KEY = 0x50  # second byte of every C3D file
_BLOCK = 512
_INTEL, _DEC, _MIPS = 84, 85, 86
_MOST = 0.9  # of its samples there, a file is read; with fewer it was cut short
# Results of models that share the list of points with the markers.
_RESULTS = ("ANGLES", "FORCES", "MOMENTS", "POWERS", "SCALARS")
_Parameters = dict[tuple[str, str], np.ndarray | list[str]]


def read_c3d(path: Path) -> Points:
    """Markers of a C3D file; what was not seen is NaN.

    Raises:
        InputError: It is no such file, with the byte and what was expected there.
        OSError: It cannot be opened.
    """
    content = np.fromfile(path, dtype=np.uint8)
    if len(content) < 2 * _BLOCK or content[1] != KEY:
        expected = f"a C3D file: at least {2 * _BLOCK} bytes, the second one {KEY:#x}"
        raise InputError(expected, path, "byte 1")
    start = (int(content[0]) - 1) * _BLOCK
    if not _BLOCK <= start <= len(content) - 4:
        expected = "the number of the block where parameters begin"
        raise InputError(expected, path, "byte 0", int(content[0]))
    processor = int(content[start + 3])
    if processor not in (_INTEL, _DEC, _MIPS):
        expected = f"processor {_INTEL}, {_DEC} or {_MIPS}"
        raise InputError(expected, path, f"byte {start + 3}", processor)
    parameters = _read_parameters(content, start, processor, path)
    header = _Header.read(content, parameters, processor, path)
    notes: list[str] = []
    if header.points == 0 and ("ROTATION", "DATA_START") in parameters:
        return _read_bodies(content, parameters, header, processor, path)
    position = _read_samples(content, header, processor, path, notes)
    names = _labels(parameters, header.points, notes)
    results = {n for kind in _RESULTS for n in _words(parameters, kind)}
    keep = [i for i, n in enumerate(names) if n not in results]
    if len(keep) < len(names):
        position = position[:, keep]
        names = [names[i] for i in keep]
    units = _words(parameters, "UNITS")
    return Points(
        names=unique_names(names),
        position=position,
        rate=header.rate,
        unit=unit_of(units[0], "POINT:UNITS", notes) if units else None,
        up=_up(parameters),
        notes=tuple(notes),
    )


def _read_bodies(
    content: np.ndarray,
    parameters: _Parameters,
    header: _Header,
    processor: int,
    path: Path,
) -> Points:
    """Rigid bodies of a file without points: 4 x 4 matrices, column after column.

    A seventeenth number, negative where the body was not seen, follows each.
    """
    notes: list[str] = []
    names = _words(parameters, "LABELS", "ROTATION")
    said = {
        n: _number(parameters, "ROTATION", n)
        for n in ("USED", "DATA_START", "RATE", "RATIO")
    }
    used, block = (
        int(x) & 0xFFFF if x is not None and np.isfinite(x) else 0
        for x in (said["USED"], said["DATA_START"])
    )
    used = used or len(names)
    start = (block - 1) * _BLOCK
    if not 0 < used <= MAX_POINTS or not _BLOCK <= start <= len(content):
        expected = f"between 1 and {MAX_POINTS} points, or rigid bodies"
        raise InputError(expected, path, "ROTATION", [used, block])
    rate = said["RATE"] or header.rate * (said["RATIO"] or 1.0)
    frames = round(header.frames * rate / header.rate) if header.rate > 0 else 0
    row = 17 * 4 * used
    frames = min(frames, (len(content) - start) // row)
    raw = content[start : start + frames * row]
    x = _numbers(raw, "f4", processor).reshape(frames, used, 17)
    # Some programs write rows one after the other: then the last column is 0 0 0 1.
    by_rows = not np.any(x[..., 12:15]) and np.any(x[..., 3:12:4])
    matrix = x[..., :16].reshape(frames, used, 4, 4)
    matrix = matrix if by_rows else np.swapaxes(matrix, 2, 3)
    position = matrix[..., :3, 3].astype(np.float32)
    seen = (x[..., 16] >= 0) & np.any(matrix[..., :3, :3] != 0, axis=(2, 3))
    position[~seen] = np.nan
    units = _words(parameters, "UNITS", "ROTATION") or _words(parameters, "UNITS")
    notes.append("no points: the origins of its rigid bodies in their place")
    names = [*names, *(f"body {k + 1}" for k in range(len(names), used))][:used]
    return Points(
        names=unique_names(names),
        position=position,
        rate=rate,
        unit=unit_of(units[0], "UNITS", notes) if units else None,
        up=_up(parameters),
        notes=tuple(notes),
    )


def _numbers(raw: np.ndarray, kind: str, processor: int) -> np.ndarray:
    """Bytes as `i2` or `f4` numbers of the processor that wrote them."""
    raw = np.ascontiguousarray(raw)
    if processor == _MIPS:
        return raw.view(f">{kind}").astype(kind)
    if processor == _DEC and kind == "f4":
        # Words are swapped and the exponent is two larger than that of IEEE.
        swapped = raw.view("<u2").reshape(-1, 2)[:, ::-1]
        with np.errstate(invalid="ignore"):  # what is no number stays none
            return np.ascontiguousarray(swapped).view("<f4").ravel() * np.float32(0.25)
    return raw.view(f"<{kind}").astype(kind, copy=False)


def _read_parameters(
    content: np.ndarray, start: int, processor: int, path: Path
) -> _Parameters:
    """All parameters by group and name, upper case."""
    groups: dict[int, str] = {}
    found: list[tuple[int, str, np.ndarray | list[str]]] = []
    at, end = start + 4, min(len(content), start + 255 * _BLOCK)
    order = ">" if processor == _MIPS else "<"
    while True:
        if at + 2 > end:
            raise InputError("the end of the parameters", path, f"byte {at}")
        length, group = (int(x) for x in content[at : at + 2].view(np.int8))
        if length == 0 or group == 0:
            break
        name_end = at + 2 + abs(length)
        if name_end + 2 > end:
            raise InputError(f"a name of {abs(length)} bytes", path, f"byte {at}")
        name = content[at + 2 : name_end].tobytes().decode("latin-1").strip().upper()
        (step,) = struct.unpack(f"{order}h", content[name_end : name_end + 2].tobytes())
        if group < 0:
            groups[-group] = name
        else:
            value = _read_value(content, name_end + 2, processor, path)
            found.append((group, name, value))
        if step == 0:
            break
        if step < 3:
            expected = "a step forward to the next parameter"
            raise InputError(expected, path, f"byte {name_end}", step)
        at = name_end + step
    return {(groups.get(g, ""), n): v for g, n, v in found}


def _read_value(
    content: np.ndarray, at: int, processor: int, path: Path
) -> np.ndarray | list[str]:
    """A parameter's numbers, flat, or its strings."""
    head = content[at : at + 2]
    kind, rank = (int(x) for x in head.view(np.int8)) if len(head) == 2 else (0, -1)
    sizes = [int(d) for d in content[at + 2 : at + 2 + max(rank, 0)]]
    width = {-1: 1, 1: 1, 2: 2, 4: 4}.get(kind, 0)
    count = int(np.prod(sizes, dtype=object)) if sizes else 1
    data = at + 2 + max(rank, 0)
    if width == 0 or not 0 <= rank <= 7 or data + count * width > len(content):
        expected = "type -1, 1, 2 or 4, at most 7 dimensions, and as many values"
        raise InputError(expected, path, f"byte {at}", [kind, rank, *sizes])
    raw = content[data : data + count * width]
    if kind == -1:
        text, wide = raw.tobytes().decode("latin-1"), sizes[0] if sizes else 1
        starts = range(0, count, wide) if wide else ()
        return [text[k : k + wide].strip(" \0") for k in starts[:255]]
    if kind == 1:
        return raw.copy()
    return _numbers(raw, "i2" if kind == 2 else "f4", processor)


def _words(parameters: _Parameters, name: str, group: str = "POINT") -> list[str]:
    """Strings of a parameter; none where it has none."""
    value = parameters.get((group, name), [])
    return value if isinstance(value, list) else []


def _number(parameters: _Parameters, group: str, name: str) -> float | None:
    """First number of a parameter; None where it has none."""
    value = parameters.get((group, name))
    if isinstance(value, list) or value is None or not len(value):
        return None
    return float(value[0])


@dataclass(frozen=True, slots=True)
class _Header:
    """Layout of the samples in the file."""

    points: int
    analog: int  # numbers of a sample that belong to other devices
    frames: int
    start: int  # [byte]
    scale: float  # negative: floats
    rate: float

    @classmethod
    def read(
        cls, content: np.ndarray, parameters: _Parameters, processor: int, path: Path
    ) -> _Header:
        """Reads the first block; what does not fit there, from the parameters."""
        words = _numbers(content[:_BLOCK], "i2", processor).view(np.uint16)
        scale, rate = (
            float(_numbers(content[b : b + 4], "f4", processor)[0]) for b in (12, 20)
        )
        points, analog, first, last = (int(w) for w in words[1:5])
        frames = last - first + 1
        if (long := _long_frames(parameters)) is not None:
            frames = long
        said = _number(parameters, "POINT", "SCALE")
        scale = scale if said is None or np.isnan(said) else said
        said = _number(parameters, "POINT", "RATE")
        rate = rate if said is None or not said > 0 else said
        start = (int(words[8]) - 1) * _BLOCK
        rotations = ("ROTATION", "DATA_START") in parameters
        if not (0 < points or rotations) or points > MAX_POINTS:
            expected = f"between 1 and {MAX_POINTS} points"
            raise InputError(expected, path, "byte 2", points)
        if frames < 1 or not (_BLOCK <= start <= len(content) or points == 0):
            where, found = "byte 6 (frames), byte 16 (block)", start // _BLOCK + 1
            expected = "samples, after the parameters"
            raise InputError(expected, path, where, [frames, found])
        return cls(points, analog, frames, start, scale, rate)


def _long_frames(parameters: _Parameters) -> int | None:
    """Count of samples where 16 bits may not hold it; None where nothing says so."""
    ends = []
    for name in ("ACTUAL_START_FIELD", "ACTUAL_END_FIELD"):
        value = parameters.get(("TRIAL", name))
        if isinstance(value, np.ndarray) and value.dtype == np.int16 and len(value) > 1:
            low, high = (int(w) for w in value[:2].view(np.uint16))
            ends.append(low + (high << 16))
    if len(ends) == 2 and ends[1] >= ends[0]:
        return ends[1] - ends[0] + 1
    for name in ("LONG_FRAMES", "FRAMES"):
        value = parameters.get(("POINT", name))
        if isinstance(value, np.ndarray) and len(value):
            count = (
                value[:1].view(np.uint16)[0] if value.dtype == np.int16 else value[0]
            )
            if np.isfinite(count) and count >= 1:
                return int(count)
    return None


def _read_samples(
    content: np.ndarray,
    header: _Header,
    processor: int,
    path: Path,
    notes: list[str],
) -> np.ndarray:
    """(T, F, 3) float32, NaN where the fourth word says so or all three are zero."""
    kind = "f4" if header.scale < 0 else "i2"
    width = int(kind[1])
    row = (4 * header.points + header.analog) * width
    frames, present = header.frames, (len(content) - header.start) // row
    if present < _MOST * frames:
        expected = (
            f"{frames} samples of {row} bytes each from byte {header.start} on; "
            f"the file ends after {present}"
        )
        raise InputError(expected, path, f"byte {len(content)}")
    if present < frames:
        notes.append(f"it says {frames} samples and ends after {present}")
        frames = present
    end = header.start + frames * row
    rows = content[header.start : end].reshape(frames, row)
    out = np.empty((frames, header.points, 3), dtype=np.float32)
    step = max(1, (1 << 22) // row)
    for k in range(0, frames, step):
        block = rows[k : k + step, : 4 * header.points * width]
        x = _numbers(block.ravel(), kind, processor).reshape(len(block), -1, 4)
        with np.errstate(invalid="ignore", over="ignore"):
            place = x[..., :3].astype(np.float32)
            if kind == "i2":
                place *= np.float32(abs(header.scale))
            unseen = (x[..., 3] < 0) | ~np.any(place != 0, axis=2)
        place[unseen] = np.nan
        out[k : k + step] = place
    return out


def _labels(parameters: _Parameters, count: int, notes: list[str]) -> list[str]:
    """Names of the points: LABELS, LABELS2 ... each hold at most 255."""
    labels = _words(parameters, "LABELS")
    k = 2
    while more := _words(parameters, f"LABELS{k}"):
        labels, k = labels + more, k + 1
    if len(labels) < count:
        notes.append(
            f"{count} points have {len(labels)} labels: the others are unnamed"
        )
        labels += [f"unnamed {k + 1}" for k in range(len(labels), count)]
    return labels[:count]


def _up(parameters: _Parameters) -> str | None:
    """The axis that the screen shows upward.

    Its sign is ignored: programs write -Z for a laboratory whose z is up.
    """
    words = _words(parameters, "Y_SCREEN")
    axis = words[0].strip().lower().lstrip("+-") if words else ""
    return axis if axis in ("x", "y", "z") else None


def is_c3d(start: bytes, path: Path) -> bool:
    """Whether a file is one, by its second byte and where that sends a reader."""
    if len(start) < 2 or start[1] != KEY or start[0] < 2:
        return False
    with path.open("rb") as file:
        file.seek((start[0] - 1) * _BLOCK + 3)
        return file.read(1) in (bytes([p]) for p in (_INTEL, _DEC, _MIPS))
