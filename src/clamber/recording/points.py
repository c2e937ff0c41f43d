"""What a recording's file says before anybody asks who the person is: named points.

Every reader ends here. Units and axes are still the file's own; where the file does not
say which, the field is None and `recording` decides.

Shapes: T samples, F points.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from clamber.errors import InputError, unreadable

MAX_RATE = 100_000.0  # [Hz] more is a mistake, not a camera
MAX_POINTS = 10_000
FARTHEST = 1e6  # [m] no recording reaches so far
_BLOCK = 4096  # samples checked at once
METRES = {
    "m": 1.0, "meter": 1.0, "meters": 1.0, "metre": 1.0, "metres": 1.0,
    "dm": 0.1,
    "cm": 0.01, "centimeters": 0.01, "centimetres": 0.01,
    "mm": 0.001, "millimeters": 0.001, "millimetres": 0.001,
    "um": 1e-6, "micrometers": 1e-6,
    "in": 0.0254, "inch": 0.0254, "inches": 0.0254,
    "ft": 0.3048, "feet": 0.3048,
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
    """

    names: tuple[str, ...]
    position: np.ndarray
    rate: float
    unit: float | None = None
    up: str | None = None
    usual_up: str = "z"
    orientation: Mapping[str, np.ndarray] = field(default_factory=dict)


def read_safely(read: Callable[[Path], Points], path: Path) -> Points:
    """Points of a reader, checked for what no format allows.

    Raises:
        InputError: The file cannot be opened, or is of no use.
    """
    try:
        points = read(path)
    except OSError as e:
        raise unreadable(path, e) from e
    if len(points.position) < 2 or not points.names:
        raise InputError(
            "at least two samples of at least one point",
            source=path,
            field="shape",
            value=points.position.shape,
        )
    if not 0.0 < points.rate <= MAX_RATE:  # also where it is NaN
        raise InputError(
            f"a positive rate, at most {MAX_RATE:g} Hz",
            source=path,
            field="rate",
            value=points.rate,
        )
    farthest = FARTHEST / (points.unit or 1.0)
    for first in range(0, len(points.position), _BLOCK):  # no second copy of it all
        block = points.position[first : first + _BLOCK]
        far = ~(np.abs(block) <= farthest) & ~np.isnan(block)
        if far.any():
            k, f, _ = np.argwhere(far)[0]
            raise InputError(
                f"finite coordinates, at most {FARTHEST:g} m",
                source=path,
                field=f"{points.names[f]}, sample {first + k}",
                value=block[k, f].tolist(),
            )
    return points


def unit_of(word: str, source: Path, field: str) -> float:
    """Metres per unit, by the word that a file uses for it.

    Raises:
        InputError: It is no unit of length.
    """
    plain = word.strip().strip("\0").lower()
    if plain not in METRES:
        raise InputError(
            "a unit of length such as m, cm, mm or inches",
            source=source,
            field=field,
            value=word,
        )
    return METRES[plain]


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
