"""A recording of a person as points over time, with the gaps that it has.

A *part* is a surface of the person, such as `LHand`; it may have several points:
its reference point bears the part's name (`LHand`, the wrist), further ones extend it
(`LHand.tip`). Landmarks (`LShoulder`, `LHip`, `Pelvis` ...) are points too.

Shapes: T samples, F points.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np

from clamber.contact.contact import PARTS
from clamber.errors import InputError
from clamber.model import cubics
from clamber.model.records import short_repr
from clamber.model.scene import Scene
from clamber.model.shown import Shown

SIDES = ("L", "R")
LANDMARKS = ("LShoulder", "RShoulder", "LHip", "RHip", "Pelvis")
REQUIRED = PARTS + LANDMARKS
MAX_GAP = 0.2  # [s] longer gaps are reported, never filled
MAX_SEGMENT = 3.0  # [m] a longer thigh is a wrong unit
MIN_SEGMENT = 0.02  # [m] so is a shorter one


@dataclass(frozen=True, slots=True)
class Gap:
    """A stretch from `t0` to `t1` [s] in which a point was not seen."""

    point: str
    t0: float
    t1: float
    filled: bool


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Demonstration(Shown):
    """A person's motion among boxes.

    Attributes:
        source: Where it came from, for people; says so where it is synthetic.
        synthetic: Whether a program made it.
        t: (T,) increasing times [s].
        names: (F,) points: parts, their further points and landmarks.
        position: (T, F, 3) in the world [m], z up, the robot's ground at z = 0.
        valid: (T, F) False where the point was not seen for too long: the position
            there is a placeholder and no evidence of anything.
        scene: Ground and boxes around the person, in the same world.
        subject: Segment lengths by name [m].
        gaps: Every stretch that was missing, filled or not.
        offsets: Height of a point over what its part rests on, by kind of point, such
            as `Knee` or `Foot.toe` [m]: the bone's and the skin's radius.
        notes: What was recognised, assumed and corrected, for people.
    """

    source: str
    synthetic: bool = False
    t: np.ndarray
    names: tuple[str, ...]
    position: np.ndarray
    valid: np.ndarray
    scene: Scene
    subject: Mapping[str, float]
    gaps: tuple[Gap, ...] = ()
    offsets: Mapping[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    __repr__ = short_repr

    def __post_init__(self) -> None:
        """Copy the arrays, check shapes, that `t` increases and nothing is NaN."""
        n, f = len(self.t), len(self.names)
        shapes = {"t": (n,), "position": (n, f, 3), "valid": (n, f)}
        for name, shape in shapes.items():
            x = np.array(getattr(self, name), dtype=bool if name == "valid" else float)
            if x.shape != shape or not np.all(np.isfinite(x)):
                raise ValueError(f"{name}: shape {x.shape}, expected finite {shape}")
            x.setflags(write=False)
            object.__setattr__(self, name, x)
        if n < 2 or np.any(np.diff(self.t) <= 0):
            raise ValueError("times must increase")
        if len(set(self.names)) != f or set(REQUIRED) - set(self.names):
            raise ValueError(f"points {self.names}, expected at least {REQUIRED}")
        for name in ("subject", "offsets"):
            proxy = MappingProxyType(dict(getattr(self, name)))
            object.__setattr__(self, name, proxy)

    @property
    def rate(self) -> float:
        """Samples per second."""
        return (len(self.t) - 1) / float(self.t[-1] - self.t[0])

    def point(self, name: str) -> np.ndarray:
        """(T, 3) track of a point [m]."""
        return self.position[:, self.names.index(name)]

    def points_of(self, part: str) -> tuple[str, ...]:
        """The part's reference point, then its further points."""
        more = (n for n in self.names if n.startswith(part + "."))
        return (part, *more)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class RawTracks:
    """Points of a person as they were seen, gaps and all.

    Attributes:
        source: Where they came from.
        synthetic: Whether a program made them.
        names: (F,) canonical names.
        position: (T, F, 3) [m], z up, ground at z = 0; NaN where not seen.
        rate: Samples per second [Hz].
        t0: Time of the first sample [s].
        scene: In the same coordinates.
        max_gap: Longest gap to fill by interpolation [s].
        offsets: In place of those estimated, by kind of point [m].
        raised: Added to those estimated, by kind of point [m].
        notes: What was recognised and assumed on the way here.
    """

    source: str
    synthetic: bool = False
    names: tuple[str, ...]
    position: np.ndarray
    rate: float
    t0: float = 0.0
    scene: Scene
    max_gap: float = MAX_GAP
    offsets: Mapping[str, float] = field(default_factory=dict)
    raised: Mapping[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    __repr__ = short_repr


def build_demonstration(tracks: RawTracks) -> Demonstration:
    """Fill short gaps, mark long ones and measure the person.

    Raises:
        InputError: A needed point was never seen or the lengths are not metres.
    """
    raw = np.asarray(tracks.position, dtype=float)
    t = tracks.t0 + np.arange(len(raw)) / tracks.rate
    ever = np.any(np.all(np.isfinite(raw), axis=2), axis=0)
    if needed := [
        n for n, ok in zip(tracks.names, ever, strict=True) if not ok and n in REQUIRED
    ]:
        expected = "at least one sample that is not NaN"
        raise InputError(expected, tracks.source, needed[0])
    keep = np.flatnonzero(ever)
    names = tuple(tracks.names[i] for i in keep)
    position, valid, gaps = _fill(t, raw[:, keep], names, tracks.max_gap)
    subject = _measure(names, position, valid, tracks.scene)
    thigh = subject["thigh"]
    if not MIN_SEGMENT < thigh < MAX_SEGMENT:
        unit = "mm" if thigh > 100 else "cm" if thigh > 1 else "m"
        expected = (
            f"positions in metres: the thigh comes out {thigh:.4g} m long; "
            f"is unit: {unit} meant?"
        )
        raise InputError(expected, tracks.source, "unit")
    return Demonstration(
        source=tracks.source,
        synthetic=tracks.synthetic,
        t=t,
        names=names,
        position=position,
        valid=valid,
        scene=tracks.scene,
        subject=subject,
        gaps=tuple(gaps),
        offsets=estimate_offsets(subject, tracks.raised) | dict(tracks.offsets),
        notes=(*tracks.notes, *_say_gaps(gaps)),
    )


def _say_gaps(gaps: Sequence[Gap]) -> list[str]:
    """Notes: the number of filled gaps, and each gap that stays open."""
    short = sum(g.filled for g in gaps)
    out = [f"gaps: {short} short ones filled"] if short else []
    long = [f"{g.point} {g.t0:.2f} to {g.t1:.2f} s" for g in gaps if not g.filled]
    if long:
        more = f" and {len(long) - _SHOWN} more" if len(long) > _SHOWN else ""
        out.append(f"gaps left open: {', '.join(long[:_SHOWN])}{more}")
    return out


_SHOWN = 8  # gaps that a note lists


# By kind of point: the segment whose length it goes by, and the share of it. Knuckles,
# knees, ankles and toes are the median resting heights of one person (two recordings,
# 40 s of standing, 6 s of kneeling); the others are the bone's radius and some skin.
_OFFSETS = {
    "Hand": ("forearm", 0.12),
    "Hand.knuckle": ("forearm", 0.16),
    "Hand.tip": ("forearm", 0.04),
    "Hand.thumb": ("forearm", 0.08),
    "Elbow": ("forearm", 0.20),
    "Knee": ("thigh", 0.32),
    "Foot": ("shank", 0.21),
    "Foot.toe": ("shank", 0.078),
}


def estimate_offsets(
    subject: Mapping[str, float], raised: Mapping[str, float]
) -> dict[str, float]:
    """Heights of points over what their parts rest on, by the person's size [m]."""
    return {
        kind: share * subject[segment] + raised.get(kind, 0.0)
        for kind, (segment, share) in _OFFSETS.items()
    }


def runs(mask: np.ndarray) -> list[tuple[int, int]]:
    """Half-open index ranges [i, j) in which a boolean (T,) mask is true."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _fill(
    t: np.ndarray, raw: np.ndarray, names: tuple[str, ...], max_gap: float
) -> tuple[np.ndarray, np.ndarray, list[Gap]]:
    """Interpolate gaps monotonically (PCHIP), so that nothing overshoots."""
    position, gaps = raw.copy(), []
    seen = np.all(np.isfinite(raw), axis=2)
    valid = seen.copy()
    dt = t[1] - t[0]
    for f, name in enumerate(names):
        ok = seen[:, f]
        missing = runs(~ok)
        if not missing:
            continue
        if ok.sum() > 1:
            at, known = t[ok], raw[ok, f]
            curve = cubics.pieces(at, known, cubics.monotone_slopes(at, known))
            inside = np.clip(t[~ok], at[0], at[-1])
            position[~ok, f], *_ = cubics.along(curve, at, inside)
        else:
            position[~ok, f] = raw[ok, f]
        for i, j in missing:
            at_edge = i == 0 or j == len(t)
            filled = not at_edge and bool((j - i) * dt <= max_gap + 1e-9)
            valid[i:j, f] = filled
            gaps.append(Gap(name, float(t[i]), float(t[j - 1]), filled))
    gaps.sort(key=lambda g: (g.t0, g.point))
    return position, valid, gaps


def wrist(names: Sequence[str], side: str) -> str:
    """The point where that side's forearm ends: the hand's, where no other is."""
    return side + "Wrist" if side + "Wrist" in names else side + "Hand"


_SEGMENTS = {
    "upper_arm": ("Shoulder", "Elbow"),
    "forearm": ("Elbow", "Hand"),
    "thigh": ("Hip", "Knee"),
    "shank": ("Knee", "Foot"),
}
_UPRIGHT = 0.95  # cosine: a leg so straight up belongs to a standing person
_ANKLE_PER_SHANK = 0.18  # height of the ankle where nobody ever stands upright


def _measure(
    names: tuple[str, ...], position: np.ndarray, valid: np.ndarray, scene: Scene
) -> dict[str, float]:
    """Median segment lengths, and heights of knee and hip while standing [m]."""
    track = {n: position[:, i] for i, n in enumerate(names)}
    ok = {n: valid[:, i] for i, n in enumerate(names)}
    for s in SIDES:  # the arm ends at the wrist, whichever point stands for the hand
        track[s + "Hand"], ok[s + "Hand"] = (x[wrist(names, s)] for x in (track, ok))
    subject = {}
    for segment, (a, b) in _SEGMENTS.items():
        lengths = [
            np.linalg.norm(track[s + b] - track[s + a], axis=1)[ok[s + a] & ok[s + b]]
            for s in SIDES
        ]
        subject[segment] = float(np.median(np.concatenate(lengths)))
    for width, joint in (("shoulder_width", "Shoulder"), ("hip_width", "Hip")):
        across = np.linalg.norm(track["L" + joint] - track["R" + joint], axis=1)
        subject[width] = float(np.median(across))
    hips, shoulders = (
        (track["L" + j] + track["R" + j]) / 2 for j in ("Hip", "Shoulder")
    )
    subject["trunk"] = float(np.median(np.linalg.norm(shoulders - hips, axis=1)))

    ankle = []
    for s in SIDES:
        leg = track[s + "Hip"] - track[s + "Foot"]
        straight = leg[:, 2] > _UPRIGHT * (subject["thigh"] + subject["shank"])
        foot = track[s + "Foot"][straight & ok[s + "Foot"] & ok[s + "Hip"]]
        floor = np.zeros(len(foot))
        for support in scene.supports[1:]:
            z = foot[:, 2] - support.height(foot)
            under = support.inside(foot) & (z < foot[:, 2])
            floor = np.where(under, np.maximum(floor, z), floor)
        height = foot[:, 2] - floor
        ankle.append(height[height < 0.5 * subject["shank"]])
    heights = np.concatenate(ankle)
    low = _ANKLE_PER_SHANK * subject["shank"]
    if len(heights):
        low = float(np.median(heights))
    subject["ankle_height"] = low
    subject["knee_height"] = low + subject["shank"]
    subject["hip_height"] = low + subject["shank"] + subject["thigh"]
    return subject
