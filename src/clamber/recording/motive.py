"""OptiTrack Motive's CSV, format versions 1.2x: rigid bodies, bones and markers.

One line of settings, an empty one, then lines of what each column is (`Type`, `Name`,
`ID`, from 1.24 also `Parent`), of what it measures (`Rotation`, `Position`) and along
which axis. Quaternions are written X Y Z W, y is up, cells of what is not seen are
empty.
"""

from __future__ import annotations

import csv
from pathlib import Path
from typing import BinaryIO

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

MAGIC = b"Format Version"
_LINES = 12  # lines of heading, at most
_HEADING = 1 << 22  # [byte] a longer line of heading is none
_ORDER = {"bone": 0, "marker": 1, "rigid body": 2}  # of those that share a name


def read_motive(path: Path) -> Points:
    """Rigid bodies, bones and markers of a Motive CSV.

    Raises:
        InputError: It is no such file, with the line and what was expected there.
        OSError: It cannot be opened.
    """
    with path.open("rb") as file:
        said, rows, first = _read_heading(file, path)
        columns = _columns(rows, path, first - 1)
        blocks = list(read_table(file, len(rows["axis"]), ",", first, path))
    if not blocks:
        raise InputError("rows of numbers", path, f"line {first}")
    table = np.concatenate(blocks)
    table = place_rows(table[:, 0], table, first, "Frame", path)
    names = unique_names([name for _, name in columns])
    notes: list[str] = []
    return Points(
        names=names,
        position=table[:, np.array([c["Position"] for c in columns.values()])],
        rate=_rate(said, path),
        unit=unit_of(said.get("length units", "meters"), "Length Units", notes),
        up="y",
        orientation={
            n: table[:, c["Rotation"]]
            for n, c in zip(names, columns.values(), strict=True)
            if "Rotation" in c
        },
        notes=tuple(notes),
    )


def _read_heading(
    file: BinaryIO, path: Path
) -> tuple[dict[str, str], dict[str, list[str]], int]:
    """Settings, the heading's rows by what they say, and the first row's line."""
    rows: dict[str, list[str]] = {}
    said: dict[str, str] = {}
    before: list[str] = []
    for line in range(1, _LINES + 1):
        text = file.readline(_HEADING)
        if line == 1 and not text.lstrip(b'\xef\xbb\xbf"').startswith(MAGIC):
            break
        try:
            cells = next(csv.reader([text.decode("utf-8-sig", "replace")]), [])
        except csv.Error:
            break
        if line == 1:
            pairs = zip(cells[::2], cells[1::2], strict=False)
            said = {k.strip().lower(): v.strip() for k, v in pairs}
        elif [c.strip().lower() for c in cells[:1]] == ["frame"]:
            rows["axis"], rows["measure"] = cells, before
            return said, rows, line + 1
        elif len(cells) > 1 and cells[1].strip():
            rows[cells[1].strip().lower()] = cells
        before = cells
    expected = "`Format Version` first, and later a line that begins with Frame,Time"
    if not said:
        expected = (
            "Motive's CSV, which begins with `Format Version`; of another table save "
            "positions (T, F, 3), names and rate as .npz"
        )
    raise InputError(expected, path, f"line {_LINES if said else 1}")


def _columns(
    rows: dict[str, list[str]], path: Path, line: int
) -> dict[tuple[str, str], dict[str, list[int]]]:
    """Columns of position (X, Y, Z) and rotation (W, X, Y, Z) by type and name.

    Bones come first, rigid bodies last: they keep their name where others share it.
    Rotations in Euler angles have no W and are left out.
    """
    width = len(rows["axis"])
    for row in ("type", "name", "measure"):
        if len(rows.get(row, [])) > width or row not in rows:
            expected = f"a line of `{row.title()}`, as long as that of the axes"
            raise InputError(expected, path, f"line {line}")
        rows[row] = rows[row] + [""] * (width - len(rows[row]))
    found: dict[tuple[str, str], dict[str, dict[str, int]]] = {}
    for k in range(2, width):
        key = (rows["type"][k].strip(), rows["name"][k].strip())
        axes = found.setdefault(key, {}).setdefault(rows["measure"][k].strip(), {})
        axes.setdefault(rows["axis"][k].strip().upper(), k)
    out: dict[tuple[str, str], dict[str, list[int]]] = {}
    for key, measures in found.items():
        place, turn = measures.get("Position", {}), measures.get("Rotation", {})
        if set("XYZ") <= set(place):
            out[key] = {"Position": [place[a] for a in "XYZ"]}
            if set("WXYZ") <= set(turn):
                out[key]["Rotation"] = [turn[a] for a in "WXYZ"]
    if not 0 < len(out) <= MAX_POINTS:
        expected = f"between 1 and {MAX_POINTS} columns of Position X, Y, Z"
        raise InputError(expected, path, f"line {line}", len(out))
    return dict(sorted(out.items(), key=lambda i: _ORDER.get(i[0][0].lower(), 3)))


def _rate(said: dict[str, str], path: Path) -> float:
    for key in ("export frame rate", "capture frame rate"):
        if key in said:
            try:
                return float(said[key])
            except ValueError as e:
                where = f"line 1, {key}"
                raise InputError("a number [Hz]", path, where, said[key]) from e
    raise InputError("`Export Frame Rate`", path, "line 1")
