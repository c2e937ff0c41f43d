"""Base of records with arrays: a short `repr`, read-only arrays."""

from __future__ import annotations

import enum
from collections.abc import Mapping, Set
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

_LONGEST = 240  # characters of a `repr`


def frozen_array(x: ArrayLike, shape: tuple[int, ...] | None = None) -> np.ndarray:
    """A read-only copy in floats; the shape has -1 where any length will do.

    Raises:
        ValueError: It has another shape.
    """
    out = np.array(x, dtype=float)
    if shape is not None and (
        out.ndim != len(shape)
        or any(s not in (-1, n) for s, n in zip(shape, out.shape, strict=True))
    ):
        raise ValueError(f"shape {out.shape}, expected {shape}")
    out.setflags(write=False)
    return out


def short_repr(self: Any) -> str:
    """A record in one short line: of large fields the shape, of records the name.

    In the body of a dataclass, `__repr__ = short_repr`.
    """
    parts = [
        f"{f.name}={_brief(getattr(self, f.name))}" for f in fields(self) if f.repr
    ]
    text = ", ".join(parts)
    if len(text) > _LONGEST:
        text = text[:_LONGEST].rpartition(", ")[0] + ", ..."
    return f"{type(self).__name__}({text})"


def _brief(value: object) -> str:
    """Short form of a value: itself if it is short, else its type and length."""
    if isinstance(value, np.ndarray):
        if value.ndim == 1 and len(value) <= 4 and value.dtype.kind in "bif":
            return f"[{', '.join(f'{x:.4g}' for x in value.tolist())}]"
        return f"array{value.shape}"
    if isinstance(value, float | np.floating):
        return f"{value:.4g}"
    if isinstance(value, enum.Enum):
        return value.name
    if isinstance(value, Path):
        return repr(value.name)
    if isinstance(value, str):
        return repr(value if len(value) <= 40 else f"{value[:37]}...")
    if value is None or isinstance(value, bool | int):
        return repr(value)
    if isinstance(value, Mapping | Set | tuple | list):
        few = isinstance(value, tuple) and len(value) <= 4
        if few and all(isinstance(x, str | int | float | None) for x in value):
            inside = ", ".join(map(_brief, value))
            return f"({inside},)" if len(value) == 1 else f"({inside})"
        return f"<{len(value)}>"
    return f"<{type(value).__name__}>"
