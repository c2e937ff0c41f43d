"""Marker sets and skeletons, recognised by names, and their joint centres.

A *skeleton* has a point at each joint's centre: what is called what is enough. A
*marker set* lies on the skin: centres are computed from it, by regression where the
joint lies deep (hips after [Harrington07], shoulders after [Rab02]) and by half the
width of the joint where a marker lies at its side.

Shapes: T samples.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from clamber.contact.contact import PARTS
from clamber.errors import InputError
from clamber.model.records import short_repr
from clamber.recording.demonstration import REQUIRED, SIDES
from clamber.recording.names import (
    JOINTS,
    MIDDLE,
    PLACES,
    plain_name,
    prefixes_of,
    read_names,
    set_name,
)

# What is needed of a set of markers; `raised`: a marker on top of a bone is so much
# higher than its centre [m].
_NEEDED = ("Asis", "Psis", "KneeOut", "AnkleOut", "Acromion", "ElbowOut", "Wrist")
_RAISED = {"Foot.toe": 0.02, "Hand.knuckle": 0.02}
_POINTS = (*PARTS, *REQUIRED, *MIDDLE, "LWrist", "RWrist")  # that `parts` may name
_SIDED_PLACES = tuple(p for p in PLACES if p not in MIDDLE)

MARKER_RADIUS = 0.007  # [m] of the usual 14 mm balls
# Half the width of a joint, as a share of the segment that ends there.
_HALF_WIDTH = {"Knee": 0.125, "Ankle": 0.08, "Elbow": 0.13}


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Recognised:
    """Body parts and landmarks recognised by the names of a recording's points.

    Attributes:
        name: Of the marker set or skeleton, for people.
        columns: Of each canonical point, or place on the skin, those to average.
        on_skin: Whether places are on the skin, so that centres are to be computed.
        raised: How much higher a point is than the bone's centre, by kind [m].
    """

    name: str
    columns: Mapping[str, tuple[int, ...]]
    on_skin: bool = False
    raised: Mapping[str, float] = field(default_factory=dict)

    __repr__ = short_repr

    def used(self) -> list[int]:
        """Columns that matter, each once."""
        return sorted({c for several in self.columns.values() for c in several})


def recognise(
    names: Sequence[str],
    parts: Mapping[str, str | Sequence[str]] | None = None,
    subject: str | None = None,
    source: object = None,
) -> Recognised:
    """Find out which point is which part of the person.

    Args:
        names: Of the columns. A prefix that belongs to the subject (`Anna:LFArm`,
            `Anna_LFArm`) is ignored.
        parts: Canonical point to the recording's name, or to several: the first is
            the part's reference point. They go before what is recognised.
        subject: The prefix to take, where several people were recorded.
        source: The file, for messages.

    Raises:
        InputError: A needed point is neither given nor recognised, or there are two
            people and nothing says which is meant.
    """
    index = {n: i for i, n in enumerate(names)}
    given: dict[str, tuple[int, ...]] = {}
    for point, wanted in (parts or {}).items():
        several = [wanted] if isinstance(wanted, str) else list(wanted)
        for name in several:
            if name not in index:
                expected = f"one of the names of the recording: {_listed(names)}"
                raise InputError(expected, source, f"parts.{point}", name)
        columns = [index[name] for name in several]
        if _is_place(point):
            given[point] = tuple(columns)
            continue
        for k, column in enumerate(columns):
            given[point if k == 0 else f"{point}.{k}"] = (column,)
    prefixes = prefixes_of(names)
    if subject is not None:
        prefixes = [p for p in prefixes if f":{_person(p)}".endswith(f":{subject}")]
        if not prefixes:
            expected = f"the beginning of names such as {_listed(names)}"
            raise InputError(expected, source, "subject", subject)
    complete: dict[str, Recognised] = {}
    incomplete: list[tuple[list[str], Recognised]] = []
    for prefix in prefixes:
        found, lacking = _recognise_one(names, prefix, given)
        if lacking:
            incomplete.append((lacking, found))
        elif not any(p.startswith(prefix) for p in complete):  # of a person found
            complete[prefix] = found
            if prefix == "":
                break
    if len(complete) > 1:
        people = sorted(_person(p) for p in complete)
        raise InputError(f"which person is meant: one of {people}", source, "subject")
    if not complete:
        lacking, found = min(incomplete, key=lambda x: len(x[0]))
        taken = {c for columns in found.columns.values() for c in columns}
        left = [n for i, n in enumerate(names) if i not in taken]
        over = f"left over are {_listed(left, 24)}" if left else "no name is left over"
        expected = (
            f"a joint or markers for {', '.join(lacking)}: name them under `parts` of "
            f"a recording.yaml; {over}"
        )
        raise InputError(expected, source, "names")
    return next(iter(complete.values()))


def known_point(point: str) -> bool:
    """Whether `parts` may name this point, or place on the skin."""
    return point.split(".")[0] in _POINTS or _is_place(point)


def _is_place(point: str) -> bool:
    """Whether it is a place of markers only, such as `LKneeOut`."""
    return point[:1] in SIDES and point[1:] in _SIDED_PLACES and point not in _POINTS


def _person(prefix: str) -> str:
    return prefix.rstrip(" _.-:/|#")


def _recognise_one(
    names: Sequence[str], prefix: str, given: Mapping[str, tuple[int, ...]]
) -> tuple[Recognised, list[str]]:
    """Parts and landmarks of one person's names, and the missing ones."""
    own = {n[len(prefix) :]: i for i, n in enumerate(names) if n.startswith(prefix)}
    said, plain = read_names(own)
    more = " and `parts`" * bool(given)
    columns = _joints(said, {p: c for p, c in given.items() if not _is_place(p)})
    name = set_name("joints", [*plain, *map(plain_name, names)]) + more
    joints = Recognised(name=name, columns=columns)
    lacking = [p for p in REQUIRED if p not in columns and p != "Pelvis"]
    if not lacking:
        return joints, []
    columns = {**_places(said), **given}
    name = set_name("markers", list(plain)) + more
    markers = Recognised(name=name, columns=columns, on_skin=True, raised=_RAISED)
    wanted = [s + p for s in SIDES for p in _NEEDED if s + p not in columns]
    if len(wanted) < len(lacking) or not wanted:
        return markers, wanted
    return joints, lacking


def _joints(
    said: Mapping[str, Mapping[str, int]], given: Mapping[str, tuple[int, ...]]
) -> dict[str, tuple[int, ...]]:
    """Columns of canonical points, as many as the names tell."""
    columns = dict(given)
    given_parts = {p.split(".")[0] for p in given}
    for side in SIDES:
        for point, words in JOINTS.items():
            if (side + point).split(".")[0] in given_parts:
                continue
            taken = {c for several in columns.values() for c in several}
            candidates = (said[side].get(w, -1) for w in words)
            found = next((c for c in candidates if c >= 0 and c not in taken), None)
            if found is not None:
                columns[side + point] = (found,)
    for point, words in MIDDLE.items():
        found = next((said[""][w] for w in words if w in said[""]), None)
        if point not in columns and found is not None:
            columns[point] = (found,)
    for side in SIDES:
        words = (w for w in JOINTS["Hand"] if w in said[side])
        found = next((said[side][w] for w in words), None)
        if found is not None and (found,) != columns.get(side + "Hand"):
            columns.setdefault(side + "Wrist", (found,))  # the hand was named otherwise
    return columns


def _places(said: Mapping[str, Mapping[str, int]]) -> dict[str, tuple[int, ...]]:
    """Columns of the places on the skin, as many as there are."""
    columns: dict[str, tuple[int, ...]] = {}
    for place, alternatives in PLACES.items():
        for side in ("",) if place in MIDDLE else SIDES:
            for several in alternatives:
                words = [("" if w[0] == "*" else side, w.lstrip("*")) for w in several]
                if all(w in said[s] for s, w in words):
                    columns[side + place] = tuple(said[s][w] for s, w in words)
                    break
    return columns


def _listed(names: Sequence[str], most: int = 12) -> str:
    shown = ", ".join(names[:most])
    return shown if len(names) <= most else f"{shown} ... ({len(names)})"


# Joint centres.


def solve_centres(found: Recognised, track: Mapping[int, np.ndarray]) -> dict:
    """Canonical points (T, 3) of what was recognised.

    Args:
        found: What the columns mean.
        track: (T, 3) of each column that matters [m], z up.

    Returns:
        By canonical name; NaN where a marker that is needed was not seen.
    """
    at = {
        place: np.mean([track[c] for c in columns], axis=0)
        for place, columns in found.columns.items()
    }
    points = _centres(at) if found.on_skin else at
    if "Pelvis" not in points:
        points["Pelvis"] = (points["LHip"] + points["RHip"]) / 2
    return points


def _centres(at: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Joint centres from markers on the skin; what `parts` gave stays as it is."""
    out: dict[str, np.ndarray] = {}
    left = _filled(_unit(at["LAsis"] - at["RAsis"]))
    hips = _hips(at)
    across = at["LAcromion"] - at["RAcromion"]
    lower = 0.17 * median_length(across)  # [Rab02]
    trunk = _unit((at["LAcromion"] + at["RAcromion"] - hips["L"] - hips["R"]) / 2)
    for s, sign in zip(SIDES, (1.0, -1.0), strict=True):
        out[f"{s}Hip"] = hips[s]
        inward = -sign * left
        out[f"{s}Knee"] = _between(at, s, "Knee", hips[s], inward)
        out[f"{s}Foot"] = _between(at, s, "Ankle", out[f"{s}Knee"], inward)
        out[f"{s}Shoulder"] = at[f"{s}Acromion"] - lower * trunk
        out[f"{s}Elbow"] = at[f"{s}ElbowOut"]
        if f"{s}ElbowIn" in at:
            out[f"{s}Elbow"] = (at[f"{s}ElbowOut"] + at[f"{s}ElbowIn"]) / 2
        out[f"{s}Hand"] = at[f"{s}Wrist"]
        for point, place in (("Foot.toe", "Toe"), ("Hand.knuckle", "HandBack")):
            if s + place in at:
                out[s + point] = at[s + place]
    for point in ("Head", "Neck"):
        if point in at:
            out[point] = at[point]
    own = (p for p in at if p.split(".")[0] in _POINTS and p not in ("Head", "Neck"))
    out |= {p: at[p] for p in own}
    return out


def _hips(at: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Hip centres by regression on the pelvis' width and depth [Harrington07].

    In the pelvis' frame (forward, left, up) from the middle of its front spines:
    (-0.24 depth - 9.9 mm, +-(0.33 width + 7.3 mm), -0.30 width - 10.9 mm).
    """
    front = (at["LAsis"] + at["RAsis"]) / 2
    left = _unit(at["LAsis"] - at["RAsis"])
    width = median_length(at["LAsis"] - at["RAsis"])
    forward = front - (at["LPsis"] + at["RPsis"]) / 2
    depth = median_length(forward)
    up = _unit(np.cross(forward, left))
    forward = np.cross(left, up)
    middle = front - (0.24 * depth + 0.0099) * forward - (0.30 * width + 0.0109) * up
    side = (0.33 * width + 0.0073) * left
    return {"L": middle + side, "R": middle - side}


def _between(
    at: Mapping[str, np.ndarray],
    s: str,
    joint: str,
    above: np.ndarray,
    inward: np.ndarray,
) -> np.ndarray:
    """Centre between the markers of both sides, or inward from the outer one.

    Inward is the pelvis' lateral axis, square to the line from the joint above.
    """
    outer = at[f"{s}{joint}Out"]
    if f"{s}{joint}In" in at:
        return (outer + at[f"{s}{joint}In"]) / 2
    bone = _unit(outer - above)
    way = _unit(inward - bone * np.sum(inward * bone, axis=1, keepdims=True))
    half = _HALF_WIDTH[joint] * median_length(outer - above) + MARKER_RADIUS
    return outer + half * way


def _unit(v: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(v, axis=1, keepdims=True)
    return v / np.where(length > 0, length, np.nan)


def median_length(v: np.ndarray) -> float:
    """Median length of vectors (T, 3) where they are known; NaN where none is."""
    length = np.linalg.norm(v, axis=1)
    length = length[np.isfinite(length)]
    return float(np.median(length)) if len(length) else np.nan


def _filled(v: np.ndarray) -> np.ndarray:
    """Directions (T, 3), interpolated where unknown: they turn slowly."""
    known = np.isfinite(v).all(axis=1)
    if known.all() or not known.any():
        return v
    k = np.arange(len(v))
    columns = [np.interp(k, k[known], x[known]) for x in v.T]
    return _unit(np.stack(columns, axis=1))
