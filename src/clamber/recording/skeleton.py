"""Marker sets and skeletons, told by their names, and the joint centres that they give.

A *skeleton* has a point at each joint's centre: what is called what is enough. A
*marker set* lies on the skin: centres are computed from it, by regression where the
joint lies deep (hips after [Harrington07], shoulders after [Rab02]) and by half the
width of the joint where a marker lies at its side.

Shapes: T samples.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from clamber.contact.contact import PARTS
from clamber.errors import InputError
from clamber.model.records import short_repr
from clamber.recording.demonstration import REQUIRED, SIDES

# Skeletons.

# Canonical point: names in order of preference, lower case without separators, after
# `left` or `l` (either side alike). The ankle is the reference point of a foot.
_SIDED = {
    "Hand": ("wrist", "hand", "wristjoint"),
    "Hand.knuckle": (
        "handmiddle1", "middle1", "middle01", "knuckle", "hand.knuckle",
        "fingerbase", "hand",
    ),
    "Hand.tip": (
        "handmiddle3", "middle3", "middle03", "tip", "hand.tip", "handindex1end",
        "handend", "fingers",
    ),
    "Hand.thumb": ("handthumb3", "thumb3", "thumb03", "thumb", "hand.thumb"),
    "Elbow": ("elbow", "forearm", "farm", "elbowjoint", "lowerarm", "radius"),
    "Shoulder": ("arm", "uarm", "upperarm", "humerus", "shoulder", "shoulderjoint"),
    "Hip": ("upleg", "femur", "hip", "thigh", "hipjoint"),
    "Knee": ("knee", "leg", "tibia", "kneejoint", "calf", "shin"),
    "Foot": ("ankle", "foot", "anklejoint"),
    "Foot.toe": ("toebase", "toe", "toes", "foot.toe", "ball", "foot", "footend"),
}  # fmt: skip
_PREFIXES = {"L": ("left", "l"), "R": ("right", "r")}
_MIDDLE = {
    "Pelvis": ("pelvis", "hips", "hip", "root"),
    "Head": ("head",),
    "Neck": ("neck", "neck1", "lowerneck"),
}
# What a skeleton is called, by names (lower case, no separators) that no other has.
_SIGNATURES = (
    ("Motive skeleton", ("luarm", "lfarm", "lshin")),
    ("SMPL joints", ("leftcollar", "spine3", "leftwrist")),
    ("CMU skeleton", ("lhipjoint", "leftupleg", "lowerback")),
    ("CMU skeleton", ("lfemur", "ltibia", "lhumerus")),
    ("LAFAN skeleton", ("leftupleg", "lefttoe", "spine2")),
    ("Mixamo-like skeleton", ("leftupleg", "leftforearm", "hips")),
    ("clamber's own points", ("lhand", "lelbow", "lfoot.toe")),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class MarkerSet:
    """Which marker lies where; `{s}` is L or R.

    Each place has alternatives; the first whose markers all exist counts, and is their
    mean. `raised`: a marker on top of a bone is so much higher than its centre [m].
    """

    name: str
    places: Mapping[str, tuple[tuple[str, ...], ...]]
    raised: Mapping[str, float] = field(
        default_factory=lambda: {"Foot.toe": 0.02, "Hand.knuckle": 0.02}
    )


_NEEDED = ("Asis", "Psis", "KneeOut", "AnkleOut", "Acromion", "ElbowOut", "Wrist")
MARKER_SETS = (
    MarkerSet(
        name="Plug-in Gait",
        places={
            "Asis": (("{s}ASI",), ("{s}ASIS",)),
            "Psis": (("{s}PSI",), ("{s}PSIS",), ("SACR",)),
            "KneeOut": (("{s}KNE",),),
            "KneeIn": (("{s}KNM",), ("{s}KNEM",), ("{s}MKNE",)),
            "AnkleOut": (("{s}ANK",),),
            "AnkleIn": (("{s}ANM",), ("{s}ANKM",), ("{s}MMED",), ("{s}MED",)),
            "Toe": (("{s}TOE",),),
            "Acromion": (("{s}SHO",),),
            "ElbowOut": (("{s}ELB",),),
            "ElbowIn": (("{s}ELBM",), ("{s}MELB",)),
            "Wrist": (("{s}WRA", "{s}WRB"),),
            "HandBack": (("{s}FIN",),),
            "Head": (("LFHD", "RFHD", "LBHD", "RBHD"),),
            "Neck": (("C7",),),
        },
    ),
    MarkerSet(
        name="Motive Baseline",
        places={
            "Asis": (("Waist{s}Front",),),
            "Psis": (("Waist{s}Back",),),
            "KneeOut": (("{s}KneeOut",),),
            "KneeIn": (("{s}KneeIn",),),
            "AnkleOut": (("{s}AnkleOut",),),
            "AnkleIn": (("{s}AnkleIn",),),
            "Toe": (
                ("{s}ToeIn", "{s}ToeOut"), ("{s}ForefootIn", "{s}ForefootOut"),
                ("{s}ToeOut",), ("{s}ForefootOut",), ("{s}ToeTip",),
            ),
            "Acromion": (("{s}ShoulderTop",),),
            "ElbowOut": (("{s}ElbowOut",),),
            "ElbowIn": (("{s}ElbowIn",),),
            "Wrist": (("{s}WristIn", "{s}WristOut"),),
            "HandBack": (("{s}HandIn", "{s}HandOut"), ("{s}HandOut",)),
            "Head": (("HeadTop",),),
            "Neck": (("BackTop",), ("SpineTop",)),
        },
    ),
)  # fmt: skip

MARKER_RADIUS = 0.007  # [m] of the usual 14 mm balls
# Half the width of a joint, as a share of the segment that ends there.
_HALF_WIDTH = {"Knee": 0.125, "Ankle": 0.08, "Elbow": 0.13}


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Recognised:
    """What the names of a recording's points mean.

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
        for k, name in enumerate(several):
            if name not in index:
                expected = f"one of the names of the recording: {_listed(names)}"
                raise InputError(expected, source, f"parts.{point}", name)
            given[point if k == 0 else f"{point}.{k}"] = (index[name],)
    prefixes = _prefixes(names)
    if subject is not None:
        prefixes = [p for p in prefixes if p[:-1] == subject]
        if not prefixes:
            expected = f"the beginning of names such as {_listed(names)}"
            raise InputError(expected, source, "subject", subject)
    complete: dict[str, Recognised] = {}
    missing: list[str] = []
    for prefix in prefixes:
        found = _recognise_one(names, prefix, given)
        lacking = [p for p in REQUIRED if p not in found.columns and p != "Pelvis"]
        if found.on_skin or not lacking:
            complete[prefix] = found
            if prefix == "":
                break
        elif not missing or len(lacking) < len(missing):
            missing = lacking
    if len(complete) > 1:
        people = sorted(p[:-1] for p in complete)
        raise InputError(f"which person is meant: one of {people}", source, "subject")
    if not complete:
        expected = (
            f"a joint or markers for each of {', '.join(missing)}: name them under "
            f"`parts`; the recording has {_listed(names)}"
        )
        raise InputError(expected, source, "names")
    return next(iter(complete.values()))


def known_point(point: str) -> bool:
    """Whether `parts` may name this point."""
    base = point.split(".")[0]
    return base in {*PARTS, *REQUIRED, *_MIDDLE, "LWrist", "RWrist"}


_MANY = 8  # names that begin alike before it is a person's name


def _prefixes(names: Sequence[str]) -> list[str]:
    """Beginnings that many names share, up to a colon or an underscore; first none."""
    count: dict[str, int] = {"": len(names)}
    for name in names:
        for end in {name.rfind(":"), name.find("_"), name.find(":")} - {-1}:
            count[name[: end + 1]] = count.get(name[: end + 1], 0) + 1
    return [p for p, n in count.items() if n >= _MANY or not p]


def _recognise_one(
    names: Sequence[str], prefix: str, given: Mapping[str, tuple[int, ...]]
) -> Recognised:
    """What one person's names mean, complete or not."""
    own = {n[len(prefix) :]: i for i, n in enumerate(names) if n.startswith(prefix)}
    plain: dict[str, int] = {}
    for n, i in own.items():
        plain.setdefault(re.sub(r"[\s_\-:]", "", n).lower(), i)
    joints = _joints(plain, given)
    if all(p in joints for p in REQUIRED if p != "Pelvis"):
        called = [n for n, words in _SIGNATURES if all(w in plain for w in words)]
        name = next(iter(called), "joints by their names")
        return Recognised(name=name + " and `parts`" * bool(given), columns=joints)
    for markers in MARKER_SETS:
        columns = _places(markers, own)
        if all(s + p in columns for p in _NEEDED for s in SIDES):
            return Recognised(
                name=f"{markers.name} markers" + " and `parts`" * bool(given),
                columns={**columns, **given},
                on_skin=True,
                raised=markers.raised,
            )
    return Recognised(name="", columns=joints)


def _joints(
    plain: Mapping[str, int], given: Mapping[str, tuple[int, ...]]
) -> dict[str, tuple[int, ...]]:
    """Columns of canonical points, as many as the names tell."""
    columns = dict(given)
    given_parts = {p.split(".")[0] for p in given}
    for side, prefixes in _PREFIXES.items():
        for point, words in _SIDED.items():
            if (side + point).split(".")[0] in given_parts:
                continue
            taken = {c for several in columns.values() for c in several}
            candidates = (plain.get(p + w, -1) for w in words for p in prefixes)
            found = next((c for c in candidates if c >= 0 and c not in taken), None)
            if found is not None:
                columns[side + point] = (found,)
    for point, words in _MIDDLE.items():
        found = next((plain[w] for w in words if w in plain), None)
        if point not in columns and found is not None:
            columns[point] = (found,)
    for side, prefixes in _PREFIXES.items():
        words = (p + w for w in _SIDED["Hand"] for p in prefixes)
        found = next((plain[w] for w in words if w in plain), None)
        if found is not None and (found,) != columns.get(side + "Hand"):
            columns.setdefault(side + "Wrist", (found,))  # the hand was named otherwise
    return columns


def _places(markers: MarkerSet, own: Mapping[str, int]) -> dict[str, tuple[int, ...]]:
    """Columns of the places of a marker set, as many as there are."""
    columns: dict[str, tuple[int, ...]] = {}
    for place, alternatives in markers.places.items():
        for side in SIDES if any("{s}" in a[0] for a in alternatives) else ("",):
            for several in alternatives:
                wanted = [n.format(s=side) for n in several]
                if all(n in own for n in wanted):
                    columns[side + place] = tuple(own[n] for n in wanted)
                    break
    return columns


def _listed(names: Sequence[str]) -> str:
    shown = ", ".join(names[:12])
    return shown if len(names) <= 12 else f"{shown} ... ({len(names)})"


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
    out |= {p: x for p, x in at.items() if known_point(p) and p not in ("Head", "Neck")}
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
