"""TRC, the marker files of OpenSim: tab-separated text with five lines of heading."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from clamber.errors import InputError
from clamber.recording.points import (
    MAX_POINTS,
    Points,
    check_count,
    place_rows,
    read_table,
    unique_names,
    unit_of,
)

MAGIC = b"PathFileType"
_HEADING = 1 << 20  # [byte] a longer line of heading is none


def read_trc(path: Path) -> Points:
    """Markers of a TRC file; empty cells are gaps.

    The heading does not say which axis is up: y is usual.

    Raises:
        InputError: It is no such file, with the line and what was expected there.
        OSError: It cannot be opened.
    """
    with path.open("rb") as file:
        heading = [
            file.readline(_HEADING).decode("utf-8", "replace").rstrip("\r\n")
            for _ in range(5)
        ]
        if not heading[0].startswith(MAGIC.decode()):
            raise InputError("`PathFileType`", path, "line 1")
        keys, values = heading[1].split("\t"), heading[2].split("\t")
        said = {
            k.strip().lower(): v.strip() for k, v in zip(keys, values, strict=False)
        }
        rate = _number(said, "DataRate", path)
        count = _number(said, "NumMarkers", path)
        if "units" not in said:
            raise InputError("`Units` in the heading", path, "line 2")
        unit = unit_of(said["units"], path, "line 3, Units")
        names = [n.strip() for n in heading[3].split("\t")]
        if [n.lower() for n in names[:2]] != ["frame#", "time"]:
            expected = "`Frame#`, `Time` and the markers' names"
            raise InputError(expected, path, "line 4")
        names = [n for n in names[2:] if n]
        if len(names) != count or not 0 < count <= MAX_POINTS:
            expected = f"as many names as NumMarkers says ({count:g})"
            raise InputError(expected, path, "line 4", len(names))
        line, place = 6, file.tell()
        while (text := file.readline(_HEADING)) and not text.strip():
            line, place = line + 1, file.tell()  # a line between heading and rows
        file.seek(place)
        blocks = list(read_table(file, 2 + 3 * len(names), "\t", line, path))
    if not blocks:
        raise InputError("rows of numbers", path, f"line {line}")
    rows = np.concatenate(blocks)
    if "numframes" in said:
        expected = _number(said, "NumFrames", path)
        check_count(len(rows), expected, line, "NumFrames", path)
    place = rows[:, 2:].reshape(len(rows), len(names), 3)
    return Points(
        names=unique_names(names),
        position=place_rows(rows[:, 0], place, line, "Frame#", path),
        rate=rate,
        unit=unit,
        usual_up="y",
    )


def _number(said: dict[str, str], key: str, path: Path) -> float:
    """A number of the heading."""
    text = said.get(key.lower())
    try:
        return float(text or "")
    except ValueError as e:
        expected = f"`{key}` with a number below it"
        raise InputError(expected, path, "line 3", text) from e
