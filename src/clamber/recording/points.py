"""Named points of a recording file, before they are mapped to a person.

Every reader ends here. Units and axes are still the file's own; where the file does not
say which, the field is None and `recording` decides. Tables of numbers in text files,
which three formats have, are read here too.

Shapes: T samples, F points.
"""

from __future__ import annotations

import io
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np

from clamber.errors import InputError, unreadable
from clamber.model.records import short_repr

MAX_RATE = 100_000.0  # [Hz] more is a mistake, not a camera
MAX_POINTS = 10_000
FARTHEST = 1e6  # [m] no recording reaches so far
_BLOCK = 4096  # samples checked at once
METRES = {
    "m": 1.0, "meter": 1.0, "meters": 1.0, "metre": 1.0, "metres": 1.0,
    "dm": 0.1,
    "cm": 0.01, "centimeters": 0.01, "centimetres": 0.01,
    "mm": 0.001, "millimeters": 0.001, "millimetres": 0.001,
    "um": 1e-6, "µm": 1e-6, "micrometers": 1e-6,
    "in": 0.0254, "inch": 0.0254, "inches": 0.0254,
    "ft": 0.3048, "foot": 0.3048, "feet": 0.3048,
}  # fmt: skip


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Points:
    """Named points over time, as the file has them.

    Attributes:
        names: (F,) different names.
        position: (T, F, 3) in the file's unit and axes; NaN where a point is not seen.
        rate: Samples per second [Hz].
        unit: Metres per unit of length; None where the file does not say.
        up: The axis that points up, such as `z` or `-y`; None where it does not say.
        usual_up: What is usual for this format, where the file does not say.
        orientation: (T, 4) wxyz of rigid bodies and bones by name, in the file's axes;
            NaN where they are not seen.
        offsets: Heights of points over what their parts rest on, by kind, where they
            are known [m].
        notes: What is odd about the file, and what was made of it.
    """

    names: tuple[str, ...]
    position: np.ndarray
    rate: float
    unit: float | None = None
    up: str | None = None
    usual_up: str = "z"
    orientation: Mapping[str, np.ndarray] = field(default_factory=dict)
    offsets: Mapping[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    __repr__ = short_repr


def read_safely(read: Callable[[Path], Points], path: Path) -> Points:
    """Points of a reader, checked for what every format requires.

    Raises:
        InputError: The file cannot be opened, or is of no use.
    """
    try:
        points = read(path)
    except OSError as e:
        raise unreadable(path, e) from e
    if len(points.position) < 2 or not points.names:
        expected = "at least two samples of at least one point"
        raise InputError(expected, path, "shape", points.position.shape)
    if not 0.0 < points.rate <= MAX_RATE:  # also where it is NaN
        expected = f"a positive rate, at most {MAX_RATE:g} Hz"
        raise InputError(expected, path, "rate", points.rate)
    farthest = FARTHEST / (points.unit or 1.0)
    for first in range(0, len(points.position), _BLOCK):  # no second copy of it all
        block = points.position[first : first + _BLOCK]
        far = ~(np.abs(block) <= farthest) & ~np.isnan(block)
        if far.any():
            k, f, _ = np.argwhere(far)[0]
            expected = f"finite coordinates, at most {FARTHEST:g} m"
            where = f"{points.names[f]}, sample {first + k}"
            raise InputError(expected, path, where, block[k, f].tolist())
    return points


def unit_of(word: str, where: str, notes: list[str]) -> float | None:
    """Metres per unit, by the word that a file uses for it.

    Args:
        word: Such as `mm`, `[mm]`, `Millimeters`; empty where there is none.
        where: It is said, for the note.
        notes: Is told of a word that is no unit of length.

    Returns:
        None where the word is none, so that the person tells.
    """
    plain = re.sub(r"[\s\[\]().\"'\0]", "", word.lower())
    plain = plain if plain in METRES else plain + "s"  # millimeter
    if plain != "s" and plain not in METRES:
        notes.append(f"{where}: {_printed(word)!r} is no unit of length: ignored")
    return METRES.get(plain)


def _printed(text: str) -> str:
    return "".join(c if c.isprintable() else "?" for c in text)[:20]


def unique_names(names: Sequence[str]) -> tuple[str, ...]:
    """The names as one may print them, those that come again numbered.

    Two points may not share a name, and a name is no place for line ends.
    """
    names = ["".join(c if c.isprintable() else "?" for c in n) for n in names]
    taken = set(names)
    count: dict[str, int] = {}
    out: list[str] = []
    for name in names:
        count[name] = count.get(name, 0) + 1
        fresh = name
        while count[name] > 1 and fresh in taken:
            fresh = f"{name} ({count[name]})"
            count[name] += fresh in taken
        taken.add(fresh)
        out.append(fresh)
    return tuple(out)


# Tables of numbers.

_READ = 1 << 20  # [byte] read at once
_ROW = re.compile(r"at row (\d+)(?:, column (\d+))?")  # in what NumPy says is wrong


def read_table(
    file: BinaryIO,
    columns: int,
    delimiter: str | None,
    line: int,
    source: Path,
    *,
    ragged: bool = False,
) -> Iterator[np.ndarray]:
    """Blocks (N, columns) of numbers until the end of the file.

    Args:
        file: Open at the start of the first row.
        columns: How many numbers a row has; empty cells at its end are not counted.
        delimiter: One character, or None for any white space. Where it is no comma,
            numbers may have one in place of the point.
        line: Number of the first row's line, for messages.
        source: The file's name, for messages.
        ragged: Whether a row may lack points, of three cells each, at its end.

    Yields:
        Arrays of float; a cell that is empty is NaN.

    Raises:
        InputError: A row has other than `columns` cells or a cell is no finite number.
    """
    gap = delimiter.encode() if delimiter else b""
    most = min(_READ, os.fstat(file.fileno()).st_size)
    while block := file.read(most):
        block += file.readline()
        lines = block.replace(b"\r", b"").split(b"\n")
        rows = {
            number: _filled(text, columns, gap, ragged)
            for number, text in enumerate(lines, line)
            if text.strip()
        }
        line += len(lines) - 1
        if rows:
            yield _parsed(rows, columns, delimiter, source)


def _filled(text: bytes, columns: int, gap: bytes, ragged: bool) -> bytes:
    """A row of as many cells as there are columns, `nan` in its empty ones."""
    if gap != b",":
        text = text.replace(b",", b".")
    if not gap:
        return text
    while text.count(gap) >= columns and (rest := text.rstrip(b" ")).endswith(gap):
        text = rest[: -len(gap)]
    for _ in range(2):  # cells side by side
        text = text.replace(gap + gap, gap + b"nan" + gap)
    text = b"nan" + text if text.startswith(gap) else text
    text = text + b"nan" if text.endswith(gap) else text
    lacking = columns - 1 - text.count(gap)
    if ragged and lacking > 0 and lacking % 3 == 0:
        text += lacking * (gap + b"nan")
    return text


def _parsed(
    rows: dict[int, bytes], columns: int, delimiter: str | None, source: Path
) -> np.ndarray:
    """Numbers (N, columns) of rows by their lines."""
    lines = list(rows)
    text = io.BytesIO(b"\n".join(rows.values()))
    try:
        x = np.loadtxt(text, delimiter=delimiter, comments=None, ndmin=2)
    except (ValueError, OverflowError) as e:
        row, cell = 0, None
        if said := _ROW.search(str(e)):
            row, cell = int(said[1]), said[2]
            row -= cell is None  # NumPy counts rows from 1 where it counts cells
        if cell is None:
            found = len(
                rows[lines[row]].split(delimiter.encode() if delimiter else None)
            )
            where = f"line {lines[row]}"
            raise InputError(f"{columns} cells", source, where, found) from e
        where = f"line {lines[row]}, cell {cell}"
        raise InputError(f"a finite number ({e})", source, where) from e
    if x.shape[1] != columns:
        raise InputError(f"{columns} cells", source, f"line {lines[0]}", x.shape[1])
    if np.isinf(x).any():
        row, cell = np.argwhere(np.isinf(x))[0]
        where = f"line {lines[row]}, cell {cell + 1}"
        raise InputError("a finite number", source, where, x[row, cell])
    return x


def place_rows(
    number: np.ndarray, rows: np.ndarray, line: int, what: str, source: Path
) -> np.ndarray:
    """Rows (N, ...) in their places by their numbers (N,): what is missing is NaN.

    Args:
        number: Of each row's sample, as the file counts them.
        rows: What the file says of it.
        line: Number of the first row's line, for messages.
        what: The column that counts, for messages.
        source: The file's name, for messages.

    Raises:
        InputError: Numbers do not increase one by one, or more samples are missing
            than there are.
    """
    step = np.diff(number)
    if np.all(step == 1.0):
        return rows
    wrong = ~((step >= 1.0) & (step == np.round(step)))
    if not wrong.any():
        missing = np.cumsum(step - 1.0)
        wrong = missing > len(number)
    if wrong.any():
        k = int(np.argmax(wrong))
        two = f"{number[k]:.6g} and then {number[k + 1]:.6g}"
        expected = f"{what} to count the rows, found {two}"
        raise InputError(expected, source, f"line {line + k + 1}")
    place = (number - number[0]).astype(int)
    out = np.full((int(place[-1]) + 1, *rows.shape[1:]), np.nan)
    out[place] = rows
    return out


def say_count(found: int, said: float, what: str) -> list[str]:
    """A note on a file whose header states another number of rows than it has."""
    if found == said:
        return []
    return [f"{what} says {said:g}, the file has {found} rows"]
