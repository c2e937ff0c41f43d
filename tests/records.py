"""Records compared field by field, and what they are made of."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from clamber.model.world import World
from clamber.planning.trajectory import Samples


def differences(a: Any, b: Any, at: str = "") -> Iterator[str]:
    """Where two values do not hold the same, to the last bit."""
    a, b = (np.asarray(x) if isinstance(x, Samples) else x for x in (a, b))
    if isinstance(a, np.ndarray):
        if not isinstance(b, np.ndarray) or (a.dtype, a.shape) != (b.dtype, b.shape):
            yield f"{at}: {type(a).__name__} of another shape"
        elif a.tobytes() != b.tobytes():
            yield at
    elif isinstance(a, Mapping) and isinstance(b, Mapping):
        if list(a) != list(b):
            yield f"{at}: {list(a)}, {list(b)}"
        for k in a.keys() & b.keys():
            yield from differences(a[k], b[k], f"{at}.{k}")
    elif type(a) is not type(b):
        yield f"{at}: {type(a).__name__}, {type(b).__name__}"
    elif isinstance(a, World):  # compiled models are compared by their source
        names = (f.name for f in dataclasses.fields(a) if f.name != "model")
        for n in names:
            yield from differences(getattr(a, n), getattr(b, n), f"{at}.{n}")
    elif dataclasses.is_dataclass(a):
        for f in (f for f in dataclasses.fields(a) if f.init):  # the rest follows
            of = f"{at}.{f.name}"
            yield from differences(getattr(a, f.name), getattr(b, f.name), of)
    elif isinstance(a, (tuple, list)):
        if len(a) != len(b):
            yield f"{at}: {len(a)}, {len(b)} of them"
        for i, (x, y) in enumerate(zip(a, b, strict=False)):
            yield from differences(x, y, f"{at}.{i}")
    elif not (a == b or (a != a and b != b)):
        yield f"{at}: {a!r}, {b!r}"


def same(a: Any, b: Any) -> bool:
    """Whether two values hold the same, to the last bit."""
    return not list(differences(a, b))


def records_in(x: Any) -> Iterator[Any]:
    """A record, and all that it is made of."""
    if isinstance(x, (tuple, list)):
        for y in x:
            yield from records_in(y)
    elif isinstance(x, Mapping):
        yield from records_in(tuple(x.values()))
    elif dataclasses.is_dataclass(x) and not isinstance(x, type):
        yield x
        for f in dataclasses.fields(x):
            yield from records_in(getattr(x, f.name))


def kinds_in(hint: Any, seen: set[type] | None = None) -> set[type]:
    """The record types that a value of that type may be made of."""
    seen = set() if seen is None else seen
    if dataclasses.is_dataclass(hint) and isinstance(hint, type) and hint not in seen:
        seen.add(hint)
        for inside in typing.get_type_hints(hint).values():
            kinds_in(inside, seen)
    for inside in typing.get_args(hint):
        kinds_in(inside, seen)
    return seen
