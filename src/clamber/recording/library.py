"""Demonstrations: recordings of people, read from disk or made by the built-in one.

One file per format; all of them end in named `Points`, and these in a `Demonstration`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from clamber.errors import InputError
from clamber.model.scene import Scene
from clamber.recording.crossing import synthesize_crossing
from clamber.recording.demonstration import Demonstration
from clamber.recording.levels import fit_levels
from clamber.recording.recording import SUFFIXES, load_recording
from clamber.recording.synthetic import synthesize_climb

BUILT_IN = {"climb": synthesize_climb, "crossing": synthesize_crossing}
_SEED = 20  # of the built-in demonstrations: the same ones everywhere, always


def load_demo(
    path_or_name: str | Path,
    *,
    scene: Scene | None = None,
    names: str | Path | Sequence[str] | None = None,
    rate: float | None = None,
    span: tuple[float, float] | None = None,
    fit_floor: bool = False,
) -> Demonstration:
    """Read a recording, or take a built-in one by its name.

    Args:
        path_or_name: `climb` or `crossing` for a built-in synthetic one, a
            `recording.yaml`, or a recording: C3D, TRC, BVH, Motive's CSV, or an array
            (`.npy`, or `.npz` with `positions`, `names` and `rate`).
        scene: Replaces the boxes of the recording, in its coordinates.
        names: Of the columns of a bare array: a list, or a JSON file with one.
        rate: Of a bare array, or in place of the file's own [Hz].
        span: Part of the recording to keep [s]; of a `recording.yaml`, its own by
            default.
        fit_floor: Correct the heights of floor and boxes by what rests on them.

    Raises:
        InputError: The name is unknown, or the file or a field cannot be used.
    """
    if str(path_or_name) in BUILT_IN:
        demo, _ = BUILT_IN[str(path_or_name)](np.random.default_rng(_SEED))
        return fit_levels(demo) if fit_floor else demo
    path = Path(path_or_name)
    if path.suffix.lower() not in SUFFIXES and not path.is_file():
        raise InputError(
            f"one of the built-in demonstrations {list(BUILT_IN)} or a file "
            f"that ends in {', '.join(SUFFIXES)}",
            source="recording",
            value=str(path_or_name),
        )
    return load_recording(
        path, scene=scene, names=names, rate=rate, span=span, fit_floor=fit_floor
    )
