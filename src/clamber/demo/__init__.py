"""Demonstrations: recordings of people, read from disk or made by the built-in one.

One file per format; all of them end in a `Demonstration`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from clamber.demo.arrays import load_array, load_recording
from clamber.demo.demonstration import (
    PARTS,
    Demonstration,
    Gap,
    build_demonstration,
)
from clamber.demo.synthetic import ClimbOptions, synthesize_climb
from clamber.errors import InputError
from clamber.scene import Scene

__all__ = [
    "BUILT_IN",
    "PARTS",
    "ClimbOptions",
    "Demonstration",
    "Gap",
    "build_demonstration",
    "load_demo",
    "synthesize_climb",
]

BUILT_IN = ("climb",)
_SEED = 20  # of the built-in demonstration: the same one everywhere, always
_FORMATS = (".yaml", ".yml", ".npy", ".npz")


def load_demo(
    path_or_name: str | Path,
    *,
    scene: Scene | None = None,
    names: str | Path | list[str] | None = None,
    rate: float | None = None,
    span: tuple[float, float] | None = None,
) -> Demonstration:
    """Read a recording, or take the built-in one by its name.

    Args:
        path_or_name: `climb` for the built-in synthetic one, a `recording.yaml`, or a
            bare array (`.npy`, or `.npz` with `positions`, `names` and `rate`).
        scene: Replaces the boxes of the recording, in its coordinates.
        names: Of the columns of a bare array: a list, or a JSON file with one.
        rate: Of a bare array [Hz].
        span: Part of the recording to keep [s]; of a `recording.yaml`, its own by
            default.

    Raises:
        InputError: The name is unknown, or the file or a field cannot be used.
    """
    if str(path_or_name) == "climb":
        demo, _ = synthesize_climb(np.random.default_rng(_SEED))
        return demo
    path = Path(path_or_name)
    if path.suffix.lower() not in _FORMATS:
        raise InputError(
            f"one of the built-in demonstrations {list(BUILT_IN)} or a file "
            f"that ends in {', '.join(_FORMATS)}",
            source="recording",
            value=str(path_or_name),
        )
    if path.suffix.lower() in (".yaml", ".yml"):
        return load_recording(path, scene=scene, span=span)
    return load_array(path, scene=scene, names=names, rate=rate, span=span)
