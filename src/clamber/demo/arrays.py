"""Bare arrays of joint centres or markers, alone or described by a `recording.yaml`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import pydantic

from clamber.demo.boxes import FLOOR, from_y_up, lower_to_ground, read_obj_boxes
from clamber.demo.demonstration import (
    MAX_GAP,
    SIDES,
    Demonstration,
    build_demonstration,
)
from clamber.demo.skeleton import canonical_columns, known_point
from clamber.errors import InputError
from clamber.scene import Box, Scene, input_error, load_scene, read_yaml

_UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
_MAX_RATE = 100_000.0  # [Hz] more is a mistake, not a camera

Rate = Annotated[float, pydantic.Field(gt=0.0, le=_MAX_RATE, allow_inf_nan=False)]
Seconds = Annotated[float, pydantic.Field(ge=0.0, allow_inf_nan=False)]
Name = Annotated[str, pydantic.Field(min_length=1)]


class RecordingFile(pydantic.BaseModel):
    """What a recording does not say of itself (`recording.yaml`)."""

    model_config = pydantic.ConfigDict(extra="forbid")

    version: Literal[1] = 1
    file: Name
    names: Name | list[Name] | None = None
    rate: Rate | None = None
    unit: Literal["m", "cm", "mm"] = "m"
    up: Literal["z", "y"] = "z"
    boxes: Name | None = None
    ground: Name = FLOOR
    span: tuple[Seconds, Seconds] | None = None
    max_gap: Seconds = MAX_GAP
    parts: dict[str, Name | list[Name]] | None = None

    @pydantic.field_validator("span")
    @classmethod
    def _increasing(
        cls, span: tuple[float, float] | None
    ) -> tuple[float, float] | None:
        if span is not None and span[1] <= span[0]:
            raise ValueError("expected an end after the start")
        return span

    @pydantic.field_validator("parts")
    @classmethod
    def _known(cls, parts: dict | None) -> dict | None:
        for point in parts or {}:
            if not known_point(point):
                raise ValueError(f"expected a part such as LHand, found {point!r}")
        return parts


def load_recording(
    path: Path,
    *,
    scene: Scene | None = None,
    span: tuple[float, float] | None = None,
) -> Demonstration:
    """Read a `recording.yaml` and the files it names.

    Raises:
        InputError: One of them, or one of its fields, cannot be used.
    """
    try:
        said = RecordingFile.model_validate(read_yaml(path))
    except pydantic.ValidationError as e:
        raise input_error(e, path) from e
    return _build(path, said, scene=scene, span=span)


def load_array(
    path: Path,
    *,
    scene: Scene | None = None,
    names: str | Path | Sequence[str] | None = None,
    rate: float | None = None,
    span: tuple[float, float] | None = None,
) -> Demonstration:
    """Read a bare array (T, F, 3) [m], z up, without a `recording.yaml`.

    Raises:
        InputError: The file, names or rate cannot be used.
    """
    if names is not None and not isinstance(names, (str, Path)):
        listed: str | list[str] | None = list(names)
    else:
        listed = None if names is None else str(Path(names).absolute())
    try:
        said = RecordingFile.model_validate(
            {"file": path.name, "names": listed, "rate": rate}
        )
    except pydantic.ValidationError as e:
        raise input_error(e, path) from e
    return _build(path, said, scene=scene, span=span)


def _build(
    path: Path,
    said: RecordingFile,
    *,
    scene: Scene | None,
    span: tuple[float, float] | None,
) -> Demonstration:
    """The record, in the coordinates in which the chosen ground is z = 0."""
    folder = path.parent
    raw, own_names, own_rate = _read_array(folder / said.file)
    names = _read_names(said.names, folder, path) if said.names else own_names
    rate = said.rate if said.rate is not None else own_rate
    for field, value in (("names", names), ("rate", rate)):
        if value is None:
            raise InputError(
                "a value: a bare array has none of its own", source=path, field=field
            )
    assert names is not None
    assert rate is not None
    if raw.ndim != 3 or raw.shape[2] != 3 or len(raw) < 2:
        raise InputError(
            "an array (samples, points, 3)",
            source=folder / said.file,
            field="shape",
            value=raw.shape,
        )
    if len(names) != raw.shape[1]:
        raise InputError(
            f"{raw.shape[1]} names, one a point", source=path, field="names",
            value=len(names),
        )  # fmt: skip
    columns = canonical_columns(names, said.parts, path)
    first, last = _span(span or said.span, len(raw), rate, path)
    raw = raw[first:last, list(columns.values())].astype(float) * _UNITS[said.unit]
    if said.up == "y":
        raw = from_y_up(raw)
    points = list(columns)
    if "Pelvis" not in points:
        hips = raw[:, [points.index("LHip"), points.index("RHip")]]
        raw = np.concatenate([raw, hips.mean(axis=1, keepdims=True)], axis=1)
        points.append("Pelvis")

    given = _boxes(said, folder) if scene is None else scene
    boxes, level = lower_to_ground(list(given.boxes), said.ground, path)
    raw[..., 2] -= level
    placed = replace(given, boxes=boxes, start=_start(raw, points), goal=None)
    return build_demonstration(
        raw,
        names=points,
        rate=rate,
        scene=placed,
        source=str(path),
        t0=first / rate,
        max_gap=said.max_gap,
    )


def _read_array(path: Path) -> tuple[np.ndarray, list[str] | None, float | None]:
    """Positions, and names and rate where the file has them."""
    try:
        content = np.load(path, allow_pickle=False)
        if isinstance(content, np.ndarray):
            raw, names, rate = content, None, None
        else:
            with content:
                raw = content["positions"]
                names = (
                    [str(n) for n in content["names"]] if "names" in content else None
                )
                rate = float(content["rate"]) if "rate" in content else None
    except KeyError as e:
        raise InputError("an array called `positions`", source=path) from e
    except OSError as e:
        reason = e.strerror or "not a whole array file"
        raise InputError(f"a readable .npy or .npz file ({reason})", source=path) from e
    except (ValueError, EOFError) as e:
        raise InputError("a .npy or .npz file of numbers", source=path) from e
    if not np.issubdtype(raw.dtype, np.number) or np.iscomplexobj(raw):
        raise InputError("numbers", source=path, field="dtype", value=str(raw.dtype))
    if rate is not None and not 0.0 < rate <= _MAX_RATE:
        raise InputError("a positive rate [Hz]", source=path, field="rate", value=rate)
    return raw, names, rate


def _read_names(names: str | list[str], folder: Path, source: Path) -> list[str]:
    """Names as they are listed, or from the JSON file that lists them."""
    if isinstance(names, str):
        path = folder / names
        try:
            names = json.loads(path.read_text())
        except OSError as e:
            raise InputError(f"a readable file ({e.strerror})", source=path) from e
        except ValueError as e:
            raise InputError("a JSON list of names", source=path) from e
        source = path
    if not isinstance(names, list) or not all(isinstance(n, str) for n in names):
        raise InputError("a list of names", source=source, field="names")
    if len(set(names)) != len(names):
        twice = next(n for n in names if names.count(n) > 1)
        raise InputError("different names", source=source, field="names", value=twice)
    return names


def _span(
    span: tuple[float, float] | None, n: int, rate: float, source: Path
) -> tuple[int, int]:
    """Half-open range of samples of a span [s]."""
    if span is None:
        return 0, n
    end = (n - 1) / rate
    first = int(np.ceil(span[0] * rate - 1e-6))
    last = min(int(np.floor(span[1] * rate + 1e-6)) + 1, n)
    if span[0] < 0 or last - first < 2:
        raise InputError(
            f"a stretch between 0 and {end:.2f} s with at least two samples",
            source=source,
            field="span",
            value=list(span),
        )
    return first, last


def _boxes(said: RecordingFile, folder: Path) -> Scene:
    """The scene that `boxes` names, without a start of its own yet."""
    boxes: list[Box] = []
    if said.boxes is not None:
        path = folder / said.boxes
        if path.suffix.lower() in (".yaml", ".yml"):
            return load_scene(path)
        if path.suffix.lower() != ".obj":
            raise InputError("an .obj or a scene.yaml", source=path, field="boxes")
        boxes = read_obj_boxes(path, _UNITS[said.unit], said.up == "y")
    return Scene(boxes=tuple(boxes), start=np.zeros(3))


def _start(raw: np.ndarray, points: list[str]) -> np.ndarray:
    """Ankles' midpoint and the way the hips face, where first all are seen."""
    track = {s + p: raw[:, points.index(s + p)] for s in SIDES for p in ("Foot", "Hip")}
    seen = np.all([np.isfinite(x).all(axis=1) for x in track.values()], axis=0)
    if not seen.any():
        return np.zeros(3)
    first = {n: x[np.argmax(seen)] for n, x in track.items()}
    middle = (first["LFoot"] + first["RFoot"]) / 2
    left = first["LHip"] - first["RHip"]
    return np.array([middle[0], middle[1], np.arctan2(-left[0], left[1])])
