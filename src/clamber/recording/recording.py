"""Any recording file, with or without a `recording.yaml` -> Demonstration.

The readers say what is in a file; here it is decided what that means: which format it
is, what the names are, which unit and which axis, which box is the ground, and what of
it becomes the record.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import pydantic

from clamber.errors import InputError, check_kind, read_yaml, unreadable, validated
from clamber.model.arguments import checks_types
from clamber.model.boxes import read_obj, to_z_up
from clamber.model.scene import Box, Scene
from clamber.model.se3 import matrix_from_quat, matrix_from_rpy
from clamber.model.terrain import DRAWN, SceneLike, load_scene
from clamber.recording import arrays, bvh, c3d, motive, trc
from clamber.recording.built_in import BUILT_IN, load_built_in
from clamber.recording.demonstration import (
    MAX_GAP,
    SIDES,
    Demonstration,
    RawTracks,
    build_demonstration,
)
from clamber.recording.levels import fit_levels, settle
from clamber.recording.points import MAX_RATE, METRES, Points, read_safely
from clamber.recording.skeleton import (
    Recognised,
    known_point,
    median_length,
    recognise,
    solve_centres,
)

Rate = Annotated[float, pydantic.Field(gt=0.0, le=MAX_RATE, allow_inf_nan=False)]
Seconds = Annotated[float, pydantic.Field(ge=0.0, allow_inf_nan=False)]
Name = Annotated[str, pydantic.Field(min_length=1)]
Metres = Annotated[float, pydantic.Field(ge=-1.0, le=1.0, allow_inf_nan=False)]
Far = Annotated[float, pydantic.Field(ge=-1000.0, le=1000.0, allow_inf_nan=False)]
Angle = Annotated[float, pydantic.Field(ge=-6.3, le=6.3, allow_inf_nan=False)]
Scale = Annotated[float, pydantic.Field(gt=0.0, le=1000.0, allow_inf_nan=False)]

# Suffix, what the content begins with and at which byte, and the reader.
_READERS: tuple[tuple[tuple[str, ...], int, bytes, Callable[..., Points]], ...] = (
    ((".c3d",), 1, bytes([c3d.KEY]), c3d.read_c3d),
    ((".trc",), 0, trc.MAGIC, trc.read_trc),
    ((".bvh",), 0, bvh.MAGIC, bvh.read_bvh),
    ((".csv",), 0, motive.MAGIC, motive.read_motive),
    ((".npy",), 0, arrays.NPY_MAGIC, arrays.read_array),
    ((".npz",), 0, arrays.NPZ_MAGIC, arrays.read_array),
    ((".pkl", ".pickle"), 0, b"\x80", arrays.read_pickled),
)
YAML = (".yaml", ".yml")
FLOOR = "floor"
_THIN = 1e-3  # [m] what rises less above the ground is part of it
SUFFIXES = (*YAML, *(s for suffixes, *_ in _READERS for s in suffixes))


class FixedPoint(pydantic.BaseModel):
    """A point that is fixed to a rigid body or bone."""

    model_config = pydantic.ConfigDict(extra="forbid")

    body: Name
    at: tuple[Metres, Metres, Metres]


class RecordingFile(pydantic.BaseModel):
    """Facts that a recording does not contain (`recording.yaml`)."""

    model_config = pydantic.ConfigDict(extra="forbid")

    version: Literal[1] = 1
    file: Name
    names: Name | list[Name] | None = None
    rate: Rate | None = None
    unit: str | Scale | None = None
    up: Literal["x", "y", "z", "-x", "-y", "-z"] | None = None
    offset: Far | tuple[Far, Far, Far] | None = None
    rotation: tuple[Angle, Angle, Angle] | None = None
    subject: Name | None = None
    body_model: Name | None = None
    robot: Name | None = None
    boxes: Name | None = None
    ground: Name = FLOOR
    span: tuple[Seconds, Seconds] | None = None
    max_gap: Seconds = MAX_GAP
    parts: dict[str, Name | list[Name] | FixedPoint] | None = None
    offsets: dict[str, Metres] | None = None

    @pydantic.field_validator("span")
    @classmethod
    def _increasing(
        cls, span: tuple[float, float] | None
    ) -> tuple[float, float] | None:
        if span is not None and span[1] <= span[0]:
            raise ValueError("expected an end after the start")
        return span

    @pydantic.field_validator("unit")
    @classmethod
    def _unit_of_length(cls, unit: str | float | None) -> str | float | None:
        if isinstance(unit, str) and unit not in METRES:
            raise ValueError(f"expected metres per unit or one of {', '.join(METRES)}")
        return unit

    @pydantic.field_validator("parts")
    @classmethod
    def _known(cls, parts: dict | None) -> dict | None:
        for point in parts or {}:
            if not known_point(point):
                raise ValueError(f"expected a part such as LHand, found {point!r}")
        return parts

    @pydantic.field_validator("offsets")
    @classmethod
    def _kinds(cls, offsets: dict | None) -> dict | None:
        for kind in offsets or {}:
            if kind.split(".")[0] not in ("Hand", "Elbow", "Knee", "Foot"):
                raise ValueError(
                    "expected a part without its side, such as Knee or Foot.toe, "
                    f"found {kind!r}"
                )
        return offsets


@checks_types
def load_demo(
    path_or_name: str | Path,
    *,
    scene: SceneLike | None = None,
    names: str | Path | Sequence[str] | None = None,
    rate: float | None = None,
    span: tuple[float, float] | None = None,
    fit_floor: bool = False,
    subject: str | None = None,
    body_model: str | Path | None = None,
    robot: str | Path | None = None,
) -> Demonstration:
    """Read a recording, or take a built-in one by its name.

    Args:
        path_or_name: `climb` or `crossing` for a built-in synthetic one, a
            `recording.yaml`, or a recording: C3D, TRC, BVH, Motive's CSV, an array
            (`.npy`, or `.npz` with `positions`, `names` and `rate`), or the motion of a
            body or a robot (`.npz`, `.pkl`).
        scene: The scene it was recorded in, in the recording's coordinates; replaces
            its own boxes.
        names: Names of a bare array's points: a list, or a JSON file with one.
        rate: Sampling rate of a bare array, or in place of the file's own [Hz].
        span: Part of the recording to keep, from and to [s]; None: all of it, or the
            span of a `recording.yaml`.
        fit_floor: Correct the heights of floor and boxes by whatever rests on them, not
            only where the floor is off beyond doubt.
        subject: Name of the person, where several were recorded.
        body_model: File of SMPL, SMPL-H or SMPL-X, for poses without joints.
        robot: The robot, where the recording is a robot's motion: a built-in one by
            name, or a robot.yaml.

    Raises:
        InputError: The name is unknown, or the file, or one that it names, or a field
            cannot be used.
    """
    path = Path(path_or_name)
    if str(path_or_name) in BUILT_IN:
        demo = load_built_in(str(path_or_name))
        return fit_levels(demo) if fit_floor else demo
    if path.suffix.lower() in SUFFIXES or path.is_file():
        if path.suffix.lower() in YAML:
            given = read_yaml(path)
        else:
            if isinstance(names, (str, Path)):
                names = str(Path(names).absolute())
            elif names is not None:
                names = list(names)
            given = {"file": path.name, "names": names, "rate": rate}
        said = validated(RecordingFile, given, path)
        more = {"subject": subject}
        if body_model is not None:
            more["body_model"] = str(Path(body_model).absolute())
        if robot is not None:
            is_file = Path(robot).suffix != ""
            more["robot"] = str(Path(robot).absolute() if is_file else robot)
        more = {k: v for k, v in more.items() if v is not None}
        said = said.model_copy(update=more) if more else said
        given = None if scene is None else load_scene(scene)
        demo = _build(path, said, given, span or said.span)
        if fit_floor:
            return fit_levels(demo)
        return demo if said.offset is not None else settle(demo)
    expected = (
        f"one of the built-in demonstrations {list(BUILT_IN)} or a file "
        f"that ends in {', '.join(SUFFIXES)}"
    )
    raise InputError(expected, "recording", value=str(path_or_name))


def read_points(
    path: Path,
    *,
    names: Sequence[str] | None = None,
    rate: float | None = None,
    subject: str | None = None,
    body_model: Path | None = None,
    robot: str | None = None,
) -> Points:
    """Named points of a file, by the reader that its content, or its suffix, calls for.

    Args:
        path: The file.
        names: Of the columns of a bare array.
        rate: In place of the file's own, where it has one [Hz].
        subject: Which of several motions in a pickle.
        body_model: SMPL's file, for poses without joints.
        robot: Whose motion it is, where it is a robot's.

    Raises:
        InputError: No reader knows such a file, or it is damaged.
    """
    start = check_kind(path, "a recording", "npz", "npy", "bvh", "trc", "csv", "pickle")
    plain = start.lstrip(b'\xef\xbb\xbf" \t\r\n')
    by_content = [
        r for _, at, magic, r in _READERS
        if (plain if at == 0 else start)[at:].startswith(magic)
    ]  # fmt: skip
    by_suffix = [r for suffixes, *_, r in _READERS if path.suffix.lower() in suffixes]
    # One byte tells little: a C3D file must be called one or send us to its parameters.
    certain = [
        r
        for r in by_content
        if r is not c3d.read_c3d or r in by_suffix or c3d.is_c3d(start, path)
    ]
    reader = next(iter([*certain, *by_suffix]), None)
    if reader is None:
        kinds = ", ".join(s for s in SUFFIXES if s not in YAML)
        then = "of another format save positions, names and rate as .npz"
        raise InputError(f"a recording: {kinds}; {then}", path)
    if reader in (arrays.read_array, arrays.read_pickled):
        given = arrays.Given(
            names=names, rate=rate, subject=subject, body_model=body_model, robot=robot
        )
        reader = partial(reader, given=given)
    points = read_safely(reader, path)
    return points if rate is None else replace(points, rate=rate)


def _build(
    path: Path,
    said: RecordingFile,
    scene: Scene | None,
    span: tuple[float, float] | None,
) -> Demonstration:
    """The record, in the coordinates in which the chosen ground is z = 0."""
    folder = path.parent
    names = _read_names(said.names, folder, path) if said.names else None
    robot = said.robot
    points = read_points(
        folder / said.file,
        names=names,
        rate=said.rate,
        subject=said.subject,
        body_model=folder / said.body_model if said.body_model else None,
        robot=str(folder / robot) if robot and Path(robot).suffix else robot,
    )
    first, last = _span(span, len(points.position), points.rate, path)
    labels, fixed = list(points.names), {}
    parts: dict[str, str | list[str]] = {}
    for part, what in (said.parts or {}).items():
        if isinstance(what, FixedPoint):
            fixed[len(labels)] = what
            label = f"{part} fixed to {what.body}"
            parts[part] = label
            labels.append(label)
        else:
            parts[part] = what
    is_pickle = Path(said.file).suffix.lower() in (".pkl", ".pickle")
    subject = None if is_pickle else said.subject  # it has chosen the motion already
    found = recognise(labels, parts=parts, subject=subject, source=path)
    with np.errstate(invalid="ignore"):  # NaN of any kind
        raw = {
            c: points.position[first:last, c].astype(float)
            for c in found.used()
            if c not in fixed
        }
    unit, why_unit = _unit(said, points, found, raw, path)
    for column, what in fixed.items():
        raw[column] = _fixed(points, what, unit, path)[first:last]
    up, why_up = _up(said, points, found, raw)
    R, offset = _moved(said)
    track = {c: unit * to_z_up(x, up) for c, x in raw.items()}
    if R is not None:
        track = {c: x @ R.T + offset for c, x in track.items()}
    solved = solve_centres(found, track)
    position = np.stack(list(solved.values()), axis=1)

    given = _boxes(said, folder, unit, up) if scene is None else scene
    if R is not None and scene is None and (said.boxes or "").lower().endswith(".obj"):
        turned = [
            replace(b, centre=R @ b.centre + offset, rotation=R @ b.rotation)
            for b in given.boxes
        ]
        given = replace(given, boxes=tuple(turned))
    boxes, level = lower_to_ground(given.boxes, said.ground, path)
    position[..., 2] -= level
    start = _start(position, list(solved))
    return build_demonstration(
        RawTracks(
            source=str(path),
            names=tuple(solved),
            position=position,
            rate=points.rate,
            t0=first / points.rate,
            scene=replace(given, boxes=boxes, start=start, goal=None),
            max_gap=said.max_gap,
            offsets={**points.offsets, **(said.offsets or {})},
            raised=found.raised,
            notes=(
                f"recognised: {found.name} ({len(points.names)} points at "
                f"{points.rate:g} Hz)",
                f"unit: {unit:g} m ({why_unit}); up: {up} ({why_up})",
                *points.notes,
            ),
        )
    )


def _moved(said: RecordingFile) -> tuple[np.ndarray | None, np.ndarray]:
    """Rotation (3, 3) and offset (3,) of what was recorded; None for neither."""
    if said.offset is None and said.rotation is None:
        return None, np.zeros(3)
    offset = (0.0, 0.0, 0.0) if said.offset is None else said.offset
    if isinstance(offset, float):
        offset = (0.0, 0.0, offset)
    return matrix_from_rpy(said.rotation or (0.0, 0.0, 0.0)), np.array(offset)


# Where a file does not say its unit the shank does: no two of these agree.
_SHANK = (0.28, 0.56)  # [m] of a person's, from a small one's to a tall one's
_GUESSES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inches": 0.0254, "CMU's": 0.0254 / 0.45}
# Where there are markers on the skin instead of a joint.
_ON_SKIN = {
    "Foot": "AnkleOut",
    "Knee": "KneeOut",
    "Hip": "Asis",
    "Shoulder": "Acromion",
}


def _columns(found: Recognised, point: str) -> tuple[int, ...]:
    """Columns near a canonical point, before any centre is computed."""
    place = point[0] + _ON_SKIN[point[1:]]
    return found.columns[point if point in found.columns else place]


def _near(
    found: Recognised, raw: Mapping[int, np.ndarray], joint: str
) -> dict[str, np.ndarray]:
    return {
        s: np.mean([raw[c] for c in _columns(found, s + joint) if c in raw], axis=0)
        for s in SIDES
        if any(c in raw for c in _columns(found, s + joint))
    }


def _unit(
    said: RecordingFile,
    points: Points,
    found: Recognised,
    raw: Mapping[int, np.ndarray],
    path: Path,
) -> tuple[float, str]:
    """Metres per unit, and who says so."""
    if said.unit is not None:
        unit = METRES[said.unit] if isinstance(said.unit, str) else said.unit
        return unit, "recording.yaml"
    if points.unit is not None:
        return points.unit, "the file"
    knee, ankle = (_near(found, raw, j) for j in ("Knee", "Foot"))
    both = [s for s in SIDES if s in knee and s in ankle]
    lengths = [np.linalg.norm(knee[s] - ankle[s], axis=1) for s in both]
    known = [x[np.isfinite(x)] for x in lengths]
    if not any(len(x) for x in known):
        return 1.0, "nothing says otherwise"  # never seen: the next step says so
    shank = float(np.median(np.concatenate(known)))
    for name, unit in _GUESSES.items():
        if _SHANK[0] <= shank * unit <= _SHANK[1]:
            return unit, f"the shank is {shank:.4g} long, so these are {name}"
    expected = (
        "the unit of length (m, cm, mm or metres per unit): the shank is "
        f"{shank:.4g} units long"
    )
    raise InputError(expected, path, "unit")


_UPRIGHT = 0.85  # of the length from ankles over knees and hips to shoulders: it stands


def _up(
    said: RecordingFile,
    points: Points,
    found: Recognised,
    raw: Mapping[int, np.ndarray],
) -> tuple[str, str]:
    """The axis that points up, and who says so.

    It is what the file says, or else what is usual for the format, unless the person
    stands straight along another axis at some time and never along this one.
    """
    if said.up is not None:
        return said.up, "recording.yaml"
    usual = points.usual_up if points.up is None else points.up
    chain = [_near(found, raw, j) for j in ("Foot", "Knee", "Hip", "Shoulder")]
    both = [s for s in SIDES if all(s in joint for joint in chain)]
    if both:
        middle = [np.mean([joint[s] for s in both], axis=0) for joint in chain]
        body = sum(median_length(b - a) for a, b in pairwise(middle))
        way = middle[-1] - middle[0]
        way = way[np.isfinite(way).all(axis=1)]
        if len(way):
            reach = {
                sign + a: float(np.percentile((-1 if sign else 1) * way[:, k], 95))
                for k, a in enumerate("xyz")
                for sign in ("", "-")
            }
            best = max(reach, key=lambda a: reach[a])
            if reach[usual] < _UPRIGHT * body <= reach[best]:
                return best, f"the person stands along it, not along {usual}"
    return usual, "usual" if points.up is None else "the file"


def _fixed(points: Points, what: FixedPoint, unit: float, path: Path) -> np.ndarray:
    """(T, 3) of a point fixed to a body, in the file's unit and axes."""
    if what.body not in points.orientation:
        known = f"a rigid body or bone with rotations: {sorted(points.orientation)}"
        raise InputError(known, path, "parts: body", what.body)
    quaternion = points.orientation[what.body]
    length = np.linalg.norm(quaternion, axis=1, keepdims=True)
    R = matrix_from_quat(quaternion / np.where(length > 0, length, np.nan))
    place = points.position[:, points.names.index(what.body)]
    return place + R @ (np.array(what.at) / unit)


def _read_names(names: str | list[str], folder: Path, source: Path) -> list[str]:
    """Names as they are listed, or from the JSON file that lists them."""
    if isinstance(names, str):
        path = folder / names
        try:
            names = json.loads(path.read_text())
        except OSError as e:
            raise unreadable(path, e) from e
        except (ValueError, RecursionError) as e:
            raise InputError("a JSON list of names", path) from e
        source = path
    if not isinstance(names, list) or not all(isinstance(n, str) for n in names):
        raise InputError("a list of names", source, "names")
    return names


def _span(
    span: tuple[float, float] | None, n: int, rate: float, source: Path
) -> tuple[int, int]:
    """Half-open range of samples of a span [s]."""
    if span is None:
        return 0, n
    end = (n - 1) / rate
    first = int(np.ceil(min(span[0], end + 1.0) * rate - 1e-6))
    last = min(int(np.floor(min(span[1], end) * rate + 1e-6)) + 1, n)
    if span[0] < 0 or last - first < 2:
        expected = f"a stretch between 0 and {end:.2f} s with at least two samples"
        raise InputError(expected, source, "span", list(span))
    return first, last


def _boxes(said: RecordingFile, folder: Path, unit: float, up: str) -> Scene:
    """The scene that `boxes` names, without a start of its own yet."""
    if said.boxes is None:
        return Scene(start=np.zeros(3))
    path = folder / said.boxes
    if path.suffix.lower() in (*YAML, *DRAWN) and path.suffix.lower() != ".obj":
        return load_scene(path)
    if path.suffix.lower() != ".obj":
        expected = f"a scene.yaml, or boxes as {', '.join(DRAWN)}"
        raise InputError(expected, path, "boxes")
    return Scene(boxes=tuple(read_obj(path, unit, up)), start=np.zeros(3))


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


def lower_to_ground(
    boxes: Sequence[Box], ground: str, source: object
) -> tuple[tuple[Box, ...], float]:
    """Boxes cut at the chosen ground, and that ground's height before [m].

    Raises:
        InputError: No box has that name.
    """
    names = [b.name for b in boxes]
    if ground == FLOOR:
        level = 0.0
    elif ground in names:
        level = float(boxes[names.index(ground)].top.position[2])
    else:
        expected = f"{FLOOR} or one of the boxes {names}"
        raise InputError(expected, source, "ground", ground)
    kept = []
    for b in boxes:
        top = float(b.top.position[2]) - level
        if b.name == ground or top < _THIN:
            continue
        if abs(b.rotation[2, 2]) < 1 - 1e-9:  # a tilted box is lowered, never cut
            kept.append(replace(b, centre=b.centre - [0.0, 0.0, level]))
            continue
        bottom = max(float(b.centre[2] - b.size[2] / 2) - level, 0.0)
        size = np.array([b.size[0], b.size[1], top - bottom])
        centre = np.array([b.centre[0], b.centre[1], (top + bottom) / 2])
        kept.append(replace(b, size=size, centre=centre))
    return tuple(kept), level
