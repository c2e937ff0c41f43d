"""Contact detection: which part of the person is loaded on which support, when.

A part is in contact while one of its points is near a support, inside its outline and
slow, with hysteresis in height and speed and a minimum duration. Joint centres lie
above the skin by an amount that depends on the part, the skeleton and the marker set:
wide windows find where a point comes to rest, and the lowest such plateau of the
recording narrows them (`_calibrate`). The instants of touching and leaving come from a
fit to the track around them (`_refine`), so that they do not depend on the thresholds.

Positions are smoothed by local quadratics (Savitzky-Golay), whose derivative is the
speed: at 120 Hz and over 0.2 s, 5 mm of marker noise leave 0.02 m/s.

Shapes: T samples.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from clamber.contact.contact import (
    PARTS,
    Contact,
    ContactInterval,
    ContactSequence,
    Stance,
)
from clamber.errors import InputError
from clamber.model.arguments import checks_types
from clamber.model.records import short_repr
from clamber.model.scene import Scene, Support
from clamber.model.se3 import frame_from_normal, quat_from_matrix
from clamber.model.terrain import SceneLike, load_scene
from clamber.recording.demonstration import (
    SIDES,
    Demonstration,
    estimate_offsets,
    runs,
    wrist,
)
from clamber.recording.levels import find_floor, say_floor

SEAT = "Seat"


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectOptions:
    """Thresholds of the detection.

    Attributes:
        enter_speed: A contact has been slower than this [m/s]; too low and a rolling
            hand is missed, too high and a slow pass counts.
        exit_speed: It lasts while slower than this [m/s].
        height_slack: By so much the windows widen once in contact [m].
        edge_slack: A joint's centre may lie so far outside the outline [m].
        smoothing: Length of the filter for speeds [s]; shorter follows faster changes,
            longer stands more noise.
        min_duration: Shorter contacts are dropped [s].
        join: Interruptions shorter than this that come back to the same place are
            none [s].
        merge: Changes closer than this are one change of stance [s].
        seat_height: Hips lower than this over a support sit on it [m].
    """

    enter_speed: float = 0.12
    exit_speed: float = 0.25
    height_slack: float = 0.02
    edge_slack: float = 0.02
    smoothing: float = 0.2
    min_duration: float = 0.2
    join: float = 0.15
    merge: float = 0.12
    seat_height: float = 0.16


@dataclass(frozen=True, slots=True)
class _Window:
    """Heights [m] at which a point may rest, and how far over the lowest plateau."""

    low: float
    high: float
    spread: float

    def holds(self, height: np.ndarray, slack: float = 0.0) -> np.ndarray:
        """Whether heights (T,) are within, by `slack` widened [m]."""
        return (height > self.low - slack) & (height < self.high + slack)


# By part without side and, after the dot, by point. `Hand` alone stands for a wrist, or
# for whatever single point there is of a hand; with fingers, the fingers count.
# For a person of `_SIZE`; another's windows move as much as the offsets differ.
# A rigid hand's fingertips dip below the surface when the palm is bent back.
_WINDOWS = {
    "Hand": _Window(-0.10, 0.17, 0.07),
    "Hand.": _Window(-0.10, 0.06, 0.10),
    "Elbow": _Window(-0.03, 0.10, 0.06),
    "Knee": _Window(0.02, 0.16, 0.07),
    "Foot": _Window(0.0, 0.13, 0.05),
    "Foot.": _Window(-0.04, 0.09, 0.05),
}
_SIZE = {"forearm": 0.254, "thigh": 0.373, "shank": 0.453}  # [m]
_PLATEAU = 10  # [%] the percentile of resting heights that is the lowest plateau
_BELOW = 0.04  # [m] under the plateau it is no longer the same thing at rest
_UNDER = -0.15  # [m] deeper than this, a point is under the support, not on it
_SEAT_UNDER = -0.05  # [m] deeper than this, hips are under the support
_THIGH_UP = 0.1  # sine of a kneeling thigh's slope, at least: the hip is over the knee
_SHANK_LIES = 0.6  # sine of a kneeling shank's slope, at most
_SHANK_UP = 0.3  # sine of a standing shank's slope, at least: else the instep lies
_SEAT_SPEED = 1.5  # a seat may be that much faster than a hand: hips are never still
_JOIN_DISTANCE = 0.03  # [m] an interruption that ends so near is none
_MOVED = 0.06  # [m] what rests so far away is another contact, lifted or slid
_REST = 0.3  # [s] from whose median a resting place is read
_SEARCH = 0.5  # [s] a change lies at most so far inside its coarse interval
_AROUND = 0.1  # [s] half the stretch of track that the fit looks at
_STILL = 0.015  # [m] a part that rolls in place changes height by less than this
_SIGMAS = 4.5  # so many standard deviations of a smoothed track are no motion


@dataclass(frozen=True, eq=False, slots=True)
class _Tracks:
    """Smoothed tracks of a demonstration, over supports, with the thresholds."""

    demo: Demonstration
    supports: tuple[Support, ...]
    options: DetectOptions
    position: np.ndarray  # (T, F, 3) [m]
    speeds: np.ndarray  # (T, F) [m/s]
    noise: dict[str, float]  # of each point [m]

    __repr__ = short_repr

    def at(self, name: str) -> np.ndarray:
        """(T, 3) smoothed track of a point."""
        return self.position[:, self.demo.names.index(name)]

    def speed(self, name: str) -> np.ndarray:
        """(T,) of a point."""
        return self.speeds[:, self.demo.names.index(name)]

    def valid(self, *names: str) -> np.ndarray:
        """(T,) whether all these points are seen."""
        columns = [self.demo.names.index(n) for n in names]
        return np.all(self.demo.valid[:, columns], axis=1)

    def samples(self, seconds: float) -> int:
        """So many samples last that long."""
        return round(seconds * self.demo.rate)


@checks_types
def detect_contacts(
    demo: Demonstration,
    *,
    scene: SceneLike | None = None,
    options: DetectOptions | None = None,
) -> ContactSequence:
    """Find contacts and the stances that they make [thesis 5.1, algorithm 1].

    Args:
        demo: The recording.
        scene: In place of the recording's own, in the same coordinates.
        options: Thresholds.

    Returns:
        Stances in order; seats are among the intervals only.

    Raises:
        InputError: Nothing is in contact at any time.
    """
    scene = demo.scene if scene is None else load_scene(scene)
    tracks = _smooth(demo, scene, options or DetectOptions())
    seats = _find_seats(tracks)
    near = {p: _nearness(tracks, p, seats) for p in _evidence(demo)}
    windows = _calibrate(tracks, near)
    found = [
        interval
        for part in PARTS
        for interval in _apart(_part_intervals(tracks, part, near, windows))
    ]
    if not found:
        raise InputError(
            f"at least one contact: {_apart_from_floor(demo)}", demo.source
        )
    found.sort(key=lambda i: (i.t0, i.part))
    t, stances = _stances(tracks, found)
    seated = [
        _interval(tracks, SEAT, support, (i, j - 1), *demo.t[[i, j - 1]])
        for support, spans in zip(scene.supports, seats, strict=True)
        for i, j in spans
    ]
    return ContactSequence(
        source=demo.source,
        subject=dict(demo.subject),
        scene=scene,
        stances=stances,
        t=t,
        intervals=tuple(sorted([*found, *seated], key=lambda i: (i.t0, i.part))),
    )


def _apart_from_floor(demo: Demonstration) -> str:
    """Why no contact was found: how far, and which way, feet and floor are apart."""
    floor = find_floor(demo)
    if floor is not None:
        return say_floor(floor)
    feet = [p for s in SIDES for p in demo.points_of(s + "Foot")]
    seen = demo.valid[:, [demo.names.index(p) for p in feet]]
    z = np.stack([demo.point(p)[:, 2] for p in feet], axis=1)[seen]
    if not len(z):
        return "the feet are never seen"
    return (
        f"the feet never rest, and are {np.min(z):.2f} to {np.max(z):.2f} m over the "
        "floor: check unit, up and the boxes"
    )


def _smooth(demo: Demonstration, scene: Scene, options: DetectOptions) -> _Tracks:
    longest = (len(demo.t) - 1) // 2 * 2 + 1
    if longest < 5:
        raise InputError("five samples at least", demo.source, value=longest)

    def samples(seconds: float) -> int:
        """An odd number, enough for a quadratic."""
        return min(max(5, 2 * round(seconds * demo.rate / 2) + 1), longest)

    p, dt = demo.position, 1.0 / demo.rate
    n, short = samples(options.smoothing), samples(options.smoothing / 2)
    velocity, position = local_quadratics(p, n, 1) / dt, local_quadratics(p, short, 0)
    speeds = np.linalg.norm(velocity, axis=2)
    noise = {n: noise_of(demo.point(n)) for n in demo.names}
    return _Tracks(demo, scene.supports, options, position, speeds, noise)


def local_quadratics(x: np.ndarray, n: int, order: int) -> np.ndarray:
    """Tracks (T, ...), or their derivative by samples, smoothed (Savitzky-Golay).

    Each value is that of the quadratic that fits the odd number `n` of samples around
    it best; near the ends, that of the first or last `n`.

    Args:
        x: The tracks, T >= n.
        n: Samples.
        order: 0, or 1 for the derivative.
    """
    half = n // 2
    powers = np.linspace(-1.0, 1.0, n)[:, None] ** np.arange(3)
    fit = np.linalg.pinv(powers)  # coefficients of the quadratic, from the samples
    slopes = np.column_stack([np.zeros(n), np.ones(n), 2.0 * powers[:, 1]])
    at = (powers, slopes / half)[order] @ fit  # (n, n) values from the samples
    out = np.empty_like(x)
    out[half : len(x) - half] = correlated(x, at[half])
    for ends, rows in (
        (slice(None, n), slice(half)),
        (slice(-n, None), slice(-half, None)),
    ):
        out[ends][rows] = np.tensordot(at[rows], x[ends], axes=1)
    return out


def correlated(x: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(T - n + 1, ...) sums of n weights, an odd number, times the samples of tracks.

    To the last bit those of SciPy, which is slow to import.
    """
    n = len(weights)
    half, last = n // 2, len(x) - n + 1
    for mirror in (1.0, -1.0):
        if np.abs(weights - mirror * weights[::-1]).max() <= np.finfo(float).eps:
            out = weights[half] * x[half:][:last]
            for k in range(half):
                both = x[k:][:last] + mirror * x[n - 1 - k :][:last]
                out += both * weights[k]
            return out
    out = weights[-1] * x[n - 1 :]
    for k in range(n - 1):
        out += weights[k] * x[k:][:last]
    return out


def _evidence(demo: Demonstration) -> list[str]:
    """Points that are evidence of a contact; a wrist only without fingers."""
    out = []
    for part in PARTS:
        points = demo.points_of(part)
        out += points[1:] if part.endswith("Hand") and len(points) > 1 else points
    return out


def _window(demo: Demonstration, kind: str) -> _Window:
    """Detection window of a kind of point, left or right."""
    part, dot, _ = kind.partition(".")
    usual = estimate_offsets(_SIZE, {}).get(kind, 0.0)
    shift = demo.offsets.get(kind, usual) - usual
    w = _WINDOWS[part + dot]
    return _Window(w.low + shift, w.high + shift, w.spread)


@dataclass(frozen=True, eq=False, slots=True)
class _Nearness:
    """One point over one support: height (T,) [m], and samples of possible contact."""

    height: np.ndarray
    possible: np.ndarray


def _nearness(
    tracks: _Tracks, point: str, seats: list[list[tuple[int, int]]]
) -> list[_Nearness]:
    """Heights over all supports; only the highest support below a point counts."""
    p, part = tracks.at(point), point.split(".")[0]
    able = tracks.valid(point) & _in_shape(tracks, part)
    slack = tracks.options.edge_slack
    supports = tracks.supports
    height = np.array([s.height(p) for s in supports])
    above = np.array([s.inside(p, -slack) for s in supports]) & (height > _UNDER)
    out = []
    for k, spans in enumerate(seats):
        covered = np.any(above & (height < height[k]), axis=0)
        possible = above[k] & ~covered & able
        if part.endswith("Knee"):
            for i, j in spans:
                possible[i:j] = False
        out.append(_Nearness(height[k], possible))
    return out


def _in_shape(tracks: _Tracks, part: str) -> np.ndarray:
    """(T,) whether the leg is in a shape in which its knee or foot can be loaded.

    Kneeling, the shank lies and the hip is over the knee; standing, the shank is up.
    Where a joint is not seen the shape is unknown and speaks against nothing.
    """
    side, kind = part[0], part[1:]
    names = [side + j for j in ("Hip", "Knee", "Foot")]
    if kind not in ("Knee", "Foot"):
        return np.ones(len(tracks.demo.t), dtype=bool)
    hip, knee, ankle = (tracks.at(n)[:, 2] for n in names)
    subject = tracks.demo.subject
    rise = (knee - ankle) / subject["shank"]
    if kind == "Foot":
        return (rise > _SHANK_UP) | ~tracks.valid(*names[1:])
    kneels = (rise < _SHANK_LIES) & (hip - knee > _THIGH_UP * subject["thigh"])
    return kneels | ~tracks.valid(*names)


def _find_seats(tracks: _Tracks) -> list[list[tuple[int, int]]]:
    """Index ranges [i, j) of sitting on each support."""
    options = tracks.options
    hips = (tracks.at("LHip") + tracks.at("RHip")) / 2
    speed = (tracks.speed("LHip") + tracks.speed("RHip")) / 2
    enter, leave = (_SEAT_SPEED * v for v in (options.enter_speed, options.exit_speed))
    seen = tracks.valid("LHip", "RHip")
    out = []
    for support in tracks.supports:
        height = support.height(hips)
        over = support.inside(hips, -options.edge_slack) & (height > _SEAT_UNDER) & seen
        loose = over & (height < options.seat_height + options.height_slack)
        loose &= speed < leave
        strict = loose & (height < options.seat_height) & (speed < enter)
        out.append(hysteresis(strict, loose, options.min_duration * tracks.demo.rate))
    return out


def hysteresis(
    strict: np.ndarray, loose: np.ndarray, shortest: float
) -> list[tuple[int, int]]:
    """Ranges [i, j), long enough, from `strict` until no longer `loose`.

    What is `loose` from the very beginning of the recording began out of sight.
    """
    out = []
    for i, j in runs(loose):
        if np.any(strict[i:j]):
            first = i + int(np.argmax(strict[i:j])) if i > 0 else i
            if j - first >= shortest:
                out.append((first, j))
    return out


def _calibrate(tracks: _Tracks, near: dict[str, list[_Nearness]]) -> dict[str, _Window]:
    """Windows by kind of point, narrowed to the lowest plateau of either side."""
    resting: dict[str, list[np.ndarray]] = {}
    for point, over in near.items():
        w = _window(tracks.demo, point[1:])
        slow = tracks.speed(point) < tracks.options.enter_speed
        resting.setdefault(point[1:], []).extend(
            n.height[n.possible & slow & w.holds(n.height)] for n in over
        )
    out = {}
    for kind, several in resting.items():
        w, heights = _window(tracks.demo, kind), np.concatenate(several)
        if len(heights) >= tracks.options.min_duration * tracks.demo.rate:
            plateau = float(np.percentile(heights, _PLATEAU))
            low = max(w.low, plateau - _BELOW)
            w = _Window(low, min(w.high, plateau + w.spread), w.spread)
        out[kind] = w
    return out


def _part_intervals(
    tracks: _Tracks,
    part: str,
    near: dict[str, list[_Nearness]],
    windows: dict[str, _Window],
) -> Iterable[ContactInterval]:
    """Contacts of one part, its points taken together, on one support at a time."""
    demo, options = tracks.demo, tracks.options
    points = [p for p in demo.points_of(part) if p in near]
    least, about = options.min_duration * demo.rate, tracks.samples(options.smoothing)
    for k, support in enumerate(tracks.supports):
        loose = np.zeros((len(points), len(demo.t)), dtype=bool)
        strict = np.zeros_like(loose)
        for row, point in enumerate(points):
            n, w, speed = near[point][k], windows[point[1:]], tracks.speed(point)
            loose[row] = n.possible & (speed < options.exit_speed)
            loose[row] &= w.holds(n.height, options.height_slack)
            strict[row] = loose[row] & (speed < options.enter_speed)
            strict[row] &= w.holds(n.height)
        either = _join(tracks, part, np.any(loose, axis=0))
        for whole in hysteresis(np.any(strict, axis=0), either, least):
            for i, j in _places(tracks, points, strict, whole, least):
                ends = {
                    leaving: [
                        _refine(tracks, p, support, i, j, leaving)
                        for p, ok in zip(
                            points, np.any(loose[:, some], axis=1), strict=True
                        )
                        if ok
                    ]
                    for leaving, some in (
                        (False, slice(i, min(i + about, j))),
                        (True, slice(max(j - about, i), j)),
                    )
                }
                # A part touches with the first of its points and leaves with the last.
                t0 = min(ends[False]) if i > 0 else float(demo.t[0])
                t1 = max(ends[True]) if j < len(demo.t) else float(demo.t[-1])
                if t1 - t0 >= options.min_duration:
                    yield _interval(tracks, part, support, (i, j - 1), t0, t1)


def _places(
    tracks: _Tracks,
    points: list[str],
    strict: np.ndarray,
    whole: tuple[int, int],
    least: float,
) -> list[tuple[int, int]]:
    """Ranges within [i, j) in each of which a part rests at one place.

    A part that slides, or is lifted no more than a point may rise in contact, comes to
    rest elsewhere without leaving its window. It has not moved where one of its points
    has not (a hand rolls, a heel rises); so an ankle without toes says nothing.

    Args:
        tracks: Of the demonstration.
        points: P, of the part.
        strict: (P, T) where each is slow and within its window.
        whole: i, j.
        least: Shorter rests count for nothing [samples].
    """
    i, j = whole
    if points == [points[0][0] + "Foot"]:
        return [(i, j)]
    resting = runs(np.any(strict[:, i:j], axis=0))
    still = [slice(a + i, b + i) for a, b in resting if b - a >= least]
    out, first = [], i
    for a, b in pairwise(still):
        moved = []
        for p, ok in zip(map(tracks.at, points), strict, strict=True):
            before, after = p[a][ok[a]], p[b][ok[b]]
            if len(before) and len(after):
                gap = np.median(after, axis=0) - np.median(before, axis=0)
                moved.append(float(np.linalg.norm(gap)) > _MOVED)
        if moved and all(moved):
            out.append((first, a.stop))
            first = b.start
    return [*out, (first, j)]


def _apart(intervals: Iterable[ContactInterval]) -> list[ContactInterval]:
    """Intervals of one part by start time; where two overlap they meet halfway."""
    out: list[ContactInterval] = []
    for b in sorted(intervals, key=lambda i: (i.t0, i.t1)):
        if out and out[-1].t1 > b.t0:
            if b.t1 <= out[-1].t1:
                continue
            middle = (out[-1].t1 + b.t0) / 2.0
            out[-1], b = replace(out[-1], t1=middle), replace(b, t0=middle)
        out.append(b)
    return out


def _join(tracks: _Tracks, part: str, mask: np.ndarray) -> np.ndarray:
    """Close interruptions that are short, seen and end where they began."""
    mask, p, seen = mask.copy(), tracks.at(part), tracks.valid(part)
    longest = tracks.options.join * tracks.demo.rate
    for i, j in runs(~mask):
        inside = i > 0 and j < len(mask)
        if inside and (j - i) <= longest and seen[i:j].all():
            mask[i:j] = np.linalg.norm(p[j] - p[i - 1]) < _JOIN_DISTANCE
    return mask


def _refine(
    tracks: _Tracks, point: str, support: Support, i: int, j: int, leaving: bool
) -> float:
    """Instant [s] at which a point comes to rest at the start of [i, j), or leaves.

    First the last sample that is not at the height at which the point rests, then the
    least-squares instant t of `p(t + s) = rest + a max(-s, 0)`: a straight way in, then
    stillness. Over 0.1 s no path is so curved that more terms would tell.
    Leaving is the same seen backwards in time.
    """
    demo, n = tracks.demo, len(tracks.demo.t)
    raw, smooth, valid = demo.point(point), tracks.at(point), tracks.valid(point)
    if leaving:
        raw, smooth, valid = raw[::-1], smooth[::-1], valid[::-1]
        i, j = n - j, n - i
    if not valid[max(i - 1, 0)]:  # the view begins here, not the contact
        return float(demo.t[n - 1 - i] if leaving else demo.t[i])
    around = tracks.samples(_AROUND)
    ahead = min(i + tracks.samples(_SEARCH), (i + j) // 2)
    resting = support.height(raw)[ahead : min(ahead + tracks.samples(_REST), j)]
    still = max(_STILL, _SIGMAS * tracks.noise[point] / 2)  # smoothing halves the noise
    start = max(i - around, 0)
    # No part rests above its place.
    away = support.height(smooth)[start : ahead + 1] - np.median(resting) > still
    moving = np.flatnonzero(away)
    k = start + int(moving[-1]) if len(moving) else i
    k = fit_instant(raw, min(k, ahead), around)
    return float(demo.t[n - 1 - k if leaving else k])


def noise_of(x: np.ndarray) -> float:
    """Standard deviation of white noise on a smooth track (T, 3) [m].

    Third differences of white noise have 20 times its variance; the median spares them
    from the jolts of impacts.
    """
    jerk = np.diff(x, n=3, axis=0)
    return float(1.4826 * np.median(np.abs(jerk)) / np.sqrt(20.0))


def fit_instant(p: np.ndarray, k: int, half: int) -> int:
    """Index within `half` of k at which rest begins, by least squares.

    For each index c in question the track (N, 3) is a constant and a multiple of
    max(c - s, 0), both free; the one with the smallest residual is the answer.
    """
    low, high = max(k - 3 * half // 2, 0), min(k + 4 * half + 1, len(p))
    c = np.arange(max(k - half, low + 3), min(k + half, high - 4) + 1)
    if not len(c):
        return k
    y = p[low:high] - p[low:high].mean(axis=0)
    way = np.maximum(c[:, None] - np.arange(low, high), 0)  # (C, N)
    way = way - way.mean(axis=1, keepdims=True)
    slope = way @ y / np.sum(way**2, axis=1, keepdims=True)  # (C, 3)
    left = y - way[:, :, None] * slope[:, None, :]
    return int(c[np.argmin(np.sum(left**2, axis=(1, 2)))])


def _limb_ends(demo: Demonstration, part: str) -> tuple[str, str]:
    """Two points whose line is the part's heading."""
    side, kind = part[0], part[1:]
    if kind == "Hand":
        return (side + "Elbow", wrist(demo.names, side))
    if kind == "Elbow":
        return (part, wrist(demo.names, side))
    if kind == "Knee":
        return (side + "Foot", part)
    more = demo.points_of(part)[1:]
    return (part, more[0]) if more else (side + "Hip", side + "Knee")


def _interval(
    tracks: _Tracks,
    part: str,
    support: Support,
    span: tuple[int, int],
    t0: float,
    t1: float,
) -> ContactInterval:
    """A contact from t0 to t1 [s] with the pose it has over a span of samples.

    The place is the median of the part's reference point, on the support; the heading
    is the limb's, that of a seat the way the hips face.
    """
    point = "Pelvis" if part == SEAT else part
    ok = np.zeros(len(tracks.demo.t), dtype=bool)
    ok[span[0] : span[1] + 1] = True
    if np.any(ok & tracks.valid(point)):
        ok &= tracks.valid(point)
    p = np.median(tracks.demo.point(point)[ok], axis=0)
    p = p - support.normal * support.height(p)
    A, b = support.edges()
    for row, limit in zip(A, b, strict=True):  # a wrist may hang over the edge
        p = p - row * max(float(row @ p - limit), 0.0)
    if part == SEAT:
        left = np.mean((tracks.at("LHip") - tracks.at("RHip"))[ok], axis=0)
        heading = np.array([left[1], -left[0], 0.0])
    else:
        base, tip = _limb_ends(tracks.demo, part)
        heading = np.mean((tracks.at(tip) - tracks.at(base))[ok], axis=0)
    R = frame_from_normal(support.normal, heading)
    contact = Contact(
        surface=part, support=support.name, position=p, quaternion=quat_from_matrix(R)
    )
    return ContactInterval(
        part=part, is_surface=part != SEAT, t0=float(t0), t1=float(t1), contact=contact
    )


def _stances(
    tracks: _Tracks, intervals: list[ContactInterval]
) -> tuple[np.ndarray, tuple[Stance, ...]]:
    """Stances between the instants at which something changes.

    Instants closer than `merge` become their mean. Where nothing is in contact the
    stance before goes on.
    """
    end = float(tracks.demo.t[-1])
    groups: list[list[float]] = []
    for x in sorted({x for i in intervals for x in (i.t0, i.t1)} | {end}):
        if groups and x - groups[-1][0] < tracks.options.merge:
            groups[-1].append(x)
        else:
            groups.append([x])
    means = [groups[0][0], *(float(np.mean(g)) for g in groups[1:-1]), end]
    if len(groups) == 1:
        means = [end]
    instant = {x: m for g, m in zip(groups, means, strict=True) for x in g}
    cuts = sorted(set(means))
    by_part = sorted(intervals, key=lambda i: PARTS.index(i.part))
    times: list[float] = []
    held: list[tuple[Contact, ...]] = []
    for a, b in pairwise(cuts):
        now = tuple(
            i.contact for i in by_part if instant[i.t0] <= a and instant[i.t1] >= b
        )
        if now and (not held or [*map(id, now)] != [*map(id, held[-1])]):
            times.append(a)
            held.append(now)
    times.append(cuts[-1])
    stances = []
    for contacts, a, b in zip(held, times[:-1], times[1:], strict=True):
        middle = _middle(tracks, a, b)
        posture, pelvis = _posture(tracks, middle), _pelvis(tracks, middle)
        stances.append(Stance(contacts=contacts, posture=posture, pelvis=pelvis))
    return np.array(times), tuple(stances)


def _middle(tracks: _Tracks, t0: float, t1: float) -> np.ndarray:
    """(T,) the middle half of a stance, one sample at least."""
    quarter = (t1 - t0) / 4.0
    t = tracks.demo.t
    middle = (t >= t0 + quarter) & (t <= t1 - quarter)
    middle[np.argmin(np.abs(t - (t0 + t1) / 2.0))] = True
    return middle


def _pelvis(tracks: _Tracks, middle: np.ndarray) -> np.ndarray | None:
    """Mean pose (7,) of the pelvis over samples, where it is seen.

    Between the hips, y to the left one, z along the trunk as far as it is square to y:
    markers on hips and shoulders tell no more.
    """
    names = ("LHip", "RHip", "LShoulder", "RShoulder")
    ok = middle & tracks.valid(*names)
    if not ok.any():
        return None
    left, right, *shoulders = (np.mean(tracks.at(n)[ok], axis=0) for n in names)
    y = left - right
    y = y / np.linalg.norm(y)
    position = np.mean([left, right], axis=0)
    z = np.mean(shoulders, axis=0) - position
    z = z - y * (y @ z)
    z = z / np.linalg.norm(z)
    R = np.stack([np.cross(y, z), y, z], axis=1)
    return np.concatenate([position, quat_from_matrix(R)])


def _posture(tracks: _Tracks, middle: np.ndarray) -> dict[str, np.ndarray]:
    """Mean directions of the segments over samples."""
    segments: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
        "trunk": (("LHip", "RHip"), ("LShoulder", "RShoulder"))
    }
    for s, side in zip(SIDES, ("left", "right"), strict=True):
        arm = (s + "Shoulder", s + "Elbow", wrist(tracks.demo.names, s))
        leg = (s + "Hip", s + "Knee", s + "Foot")
        for (a, b, c), upper, lower in (
            (arm, "upper_arm", "forearm"),
            (leg, "thigh", "shank"),
        ):
            segments[f"{side}_{upper}"] = ((a,), (b,))
            segments[f"{side}_{lower}"] = ((b,), (c,))
    out = {}
    for name, (base, tip) in segments.items():
        ok = middle & tracks.valid(*base, *tip)
        if ok.any():
            a, b = (
                np.mean([tracks.at(n)[ok] for n in x], axis=(0, 1)) for x in (base, tip)
            )
            out[name] = (b - a) / np.linalg.norm(b - a)
    return out
