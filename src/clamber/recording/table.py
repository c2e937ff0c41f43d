"""Tables of numbers in text files, fast, and precise about what is wrong where.

Whole blocks of lines go through NumPy's parser; a block that it refuses is read again
cell by cell, which finds the line and the cell to blame.
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np

from clamber.errors import InputError

_BLOCK = 1 << 20  # [byte] read at once
_SHOWN = 40  # characters of a wrong cell that a message repeats


def read_blocks(
    file: BinaryIO, *, columns: int, delimiter: str | None, line: int, source: Path
) -> Iterator[np.ndarray]:
    """Blocks (N, columns) of numbers until the end of the file.

    Args:
        file: Open at the start of the first row.
        columns: How many numbers a row has; one delimiter more at its end is allowed.
        delimiter: One character, or None for any white space.
        line: Number of the first row's line, for messages.
        source: The file's name, for messages.

    Yields:
        Arrays of float; a cell that is empty is NaN.

    Raises:
        InputError: A row has other than `columns` cells or a cell is no finite number.
    """
    most = min(_BLOCK, os.fstat(file.fileno()).st_size)
    while block := file.read(most):
        block = block + file.readline()
        rows = _parse_block(block, columns, delimiter)
        if rows is None:
            rows = _parse_lines(block, columns, delimiter, line, source)
        line += block.count(b"\n")
        if len(rows):
            yield rows


def _parse_block(
    block: bytes, columns: int, delimiter: str | None
) -> np.ndarray | None:
    """All rows at once; None where something is not as it should be."""
    text = block.replace(b"\r", b"")
    if delimiter is not None:
        d = delimiter.encode()
        if d + d in text:
            text = text.replace(d + d, d + b"nan" + d).replace(d + d, d + b"nan" + d)
        if d + b"\n" in text or text.endswith(d):
            text = text.replace(d + b"\n", d + b"nan\n")
            text += b"nan" if text.endswith(d) else b""
    if not text.strip():
        return np.empty((0, columns))
    try:
        rows = np.loadtxt(io.BytesIO(text), delimiter=delimiter, comments=None, ndmin=2)
    except (ValueError, OverflowError):
        return None
    if rows.shape[1] == columns + 1 and np.isnan(rows[:, -1]).all():
        rows = rows[:, :-1]
    return rows if rows.shape[1] == columns and not np.isinf(rows).any() else None


def _parse_lines(
    block: bytes, columns: int, delimiter: str | None, line: int, source: Path
) -> np.ndarray:
    """Row by row: what the fast way refuses, either read or explained."""
    out: list[list[float]] = []
    split = None if delimiter is None else delimiter.encode()
    for number, text in enumerate(block.split(b"\n"), start=line):
        text = text.strip(b" \r\n")
        if not text:
            continue
        cells = text.split(split)
        if len(cells) == columns + 1 and not cells[-1].strip():
            cells.pop()
        if len(cells) != columns:
            raise InputError(
                f"{columns} cells", source=source, field=f"line {number}",
                value=len(cells),
            )  # fmt: skip
        out.append([_number(c, number, k, source) for k, c in enumerate(cells, 1)])
    return np.array(out).reshape(-1, columns)


def _number(cell: bytes, line: int, column: int, source: Path) -> float:
    """A cell's number; NaN where it is empty or says so."""
    cell = cell.strip()
    try:
        value = float(cell) if cell else np.nan
    except ValueError:
        value = np.inf
    if np.isinf(value) or b"_" in cell:
        raise InputError(
            "a finite number",
            source=source,
            field=f"line {line}, cell {column}",
            value=cell[:_SHOWN].decode("utf-8", "replace"),
        )
    return value


def place_rows(
    number: np.ndarray, rows: np.ndarray, *, line: int, what: str, source: Path
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
        raise InputError(
            f"{what} to count the rows, found {number[k]:.6g} and then "
            f"{number[k + 1]:.6g}",
            source=source,
            field=f"line {line + k + 1}",
        )
    place = (number - number[0]).astype(int)
    out = np.full((int(place[-1]) + 1, *rows.shape[1:]), np.nan)
    out[place] = rows
    return out


def check_count(found: int, said: float, *, line: int, what: str, source: Path) -> None:
    """Refuse a file that ends before its heading says so.

    Raises:
        InputError: There are fewer rows than `said`, from `line` on.
    """
    if not found >= said:
        raise InputError(
            f"{said:g} rows, as {what} says; the file ends after {found}",
            source=source,
            field=f"line {line + found}",
        )
