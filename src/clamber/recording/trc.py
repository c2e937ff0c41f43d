"""TRC, the marker files of OpenSim: tables in text after some lines of heading.

Cells lie between tabs, commas or semicolons. Programs write more or fewer of them than
the format's description says, and counts that are wrong: the rows count.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from clamber.errors import InputError
from clamber.recording.points import (
    MAX_POINTS,
    Points,
    place_rows,
    read_table,
    unique_names,
    unit_of,
)

MAGIC = b"PathFileType"
_HEADING = 1 << 20  # [byte] a longer line of heading is none
_LINES = 8  # of heading, at most


def read_trc(path: Path) -> Points:
    """Markers of a TRC file; empty cells are gaps.

    The heading does not say which axis is up: y is usual.

    Raises:
        InputError: It is no such file, with the line and what was expected there.
        OSError: It cannot be opened.
    """
    with path.open("rb") as file:
        said: dict[str, str] = {}
        before: list[str] = []
        for line in range(1, _LINES + 1):
            text = file.readline(_HEADING).decode("utf-8-sig", "replace")
            delimiter = next((d for d in "\t;," if d in text), None)
            cells = _cells(text, delimiter)
            if line == 1 and not text.lstrip('" ').startswith(MAGIC.decode()):
                raise InputError("`PathFileType`", path, "line 1")
            if cells and cells[0].lower().rstrip("#") == "frame":
                break
            if "datarate" in [c.lower() for c in before]:
                said = _said(before, cells)
            before = cells
        else:
            expected = "`Frame#`, `Time` and the markers' names"
            raise InputError(expected, path, f"line {_LINES}")
        names, places = _markers(cells)
        if not 0 < len(names) <= MAX_POINTS:
            raise InputError(f"1 to {MAX_POINTS} names", path, f"line {line}")
        line, place = line + 1, file.tell()
        while (text := file.readline(_HEADING)) and not _is_row(text):
            line, place = line + 1, file.tell()  # axes, empty lines
        file.seek(place)
        width = 2 + 3 * (max(places) + 1)
        blocks = list(read_table(file, width, delimiter, line, path, ragged=True))
    if not blocks:
        raise InputError("rows of numbers", path, f"line {line}")
    rows = np.concatenate(blocks)
    notes = _check(said, len(rows), len(names))
    points = rows[:, 2:].reshape(len(rows), -1, 3)[:, places]
    return Points(
        names=unique_names(names),
        position=place_rows(rows[:, 0], points, line, "Frame#", path),
        rate=_rate(said, rows[:, 1], notes, path),
        unit=unit_of(said.get("units", ""), "Units", notes),
        usual_up="y",
        notes=tuple(notes),
    )


def _cells(text: str, delimiter: str | None) -> list[str]:
    """Cells of a header line, stripped."""
    if delimiter is None:
        return text.split()
    try:
        cells = next(csv.reader([text.rstrip("\r\n")], delimiter=delimiter), [])
    except csv.Error:
        cells = []
    return [c.strip() for c in cells]


def _said(keys: Sequence[str], values: Sequence[str]) -> dict[str, str]:
    """Settings by name, lower case; empty cells between them say nothing."""
    if len([k for k in keys if k]) == len([v for v in values if v]):
        keys, values = ([c for c in row if c] for row in (keys, values))
    return {k.lower(): v for k, v in zip(keys, values, strict=False)}


def _markers(cells: Sequence[str]) -> tuple[list[str], list[int]]:
    """Names, and which three columns are whose: one without a name has columns too."""
    places = [k for k, c in enumerate(cells) if k > 1 and c]
    names = [cells[k] for k in places]
    if all((k - 2) % 3 == 0 for k in places):
        return names, [(k - 2) // 3 for k in places]
    return names, list(range(len(names)))


def _is_row(text: bytes) -> bool:
    """Whether a line is one of numbers."""
    first = text.replace(b";", b"\t").replace(b",", b"\t").split(b"\t")[0].split()
    try:
        return bool(first) and np.isfinite(float(first[0]))
    except ValueError:
        return text.strip() != b"" and not text.strip(b"\t ,;\r\n").startswith(
            (b"X", b"x")
        )


def _check(said: dict[str, str], rows: int, markers: int) -> list[str]:
    """Notes on counts of the heading that are wrong."""
    notes: list[str] = []
    for key, found in (("NumFrames", rows), ("NumMarkers", markers)):
        count = _number(said.get(key.lower()))
        if count is not None and count != found:
            what = "rows" if key == "NumFrames" else "names"
            notes.append(f"{key} says {count:g}, the file has {found} {what}")
    return notes


def _rate(
    said: dict[str, str], time: np.ndarray, notes: list[str], path: Path
) -> float:
    """Samples per second, as the heading or else the column of times says."""
    rate = _number(said.get("datarate"))
    if rate is not None and rate > 0:
        return rate
    span = float(time[-1] - time[0])
    if not span > 0:
        raise InputError("a rate under `DataRate`, or times", path, "line 3")
    rate = (len(time) - 1) / span
    notes.append(f"DataRate says nothing: {rate:.6g} Hz by the times")
    return rate


def _number(text: str | None) -> float | None:
    """A number of the heading; None where there is none."""
    try:
        return float((text or "").replace(",", "."))
    except ValueError:
        return None
