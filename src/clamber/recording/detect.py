"""Which part of the person bears load on which support, and when.

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
from clamber.model.scene import Scene, Support
from clamber.model.se3 import frame_from_normal, quat_from_matrix
from clamber.recording.demonstration import (
    SIDES,
    Demonstration,
    estimate_offsets,
    runs,
    wrist,
)

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
_THIGH_UP = 0.1  # sine of a kneeling thigh's slope, at least: the hip is over the knee
_SHANK_LIES = 0.6  # sine of a kneeling shank's slope, at most
_SHANK_UP = (
    0.3  # sine of a standing shank's slope, at least: else the instep lies there
)
_SEAT_SPEED = 1.5  # a seat may be that much faster than a hand: hips are never still
_JOIN_DISTANCE = 0.03  # [m]
_MOVED = 0.06  # [m] what rests so far away is another contact, lifted or slid


@dataclass(frozen=True, eq=False, slots=True)
class _Tracks:
    """Smoothed tracks of a demonstration and what one may read off them."""

    demo: Demonstration
    position: np.ndarray  # (T, F, 3) [m]
    speed: np.ndarray  # (T, F) [m/s]

    def at(self, name: str) -> np.ndarray:
        """(T, 3) smoothed track of a point."""
        return self.position[:, self.demo.names.index(name)]

    def valid(self, *names: str) -> np.ndarray:
        """(T,) whether all these points are seen."""
        return _all(self.demo.valid[:, [self.demo.names.index(n) for n in names]].T)


def detect_contacts(
    demo: Demonstration,
    *,
    scene: Scene | None = None,
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
    options = options or DetectOptions()
    scene = scene or demo.scene
    tracks = _smooth(demo, options)
    seats = _find_seats(tracks, scene, options)
    near = {p: _nearness(tracks, p, scene, seats, options) for p in _counting(demo)}
    windows = _calibrate(tracks, near, options)
    found = [
        interval
        for part in PARTS
        for interval in _apart(
            _part_intervals(tracks, part, near, windows, scene, options)
        )
    ]
    if not found:
        raise InputError(
            "at least one contact: check unit, up and the boxes", source=demo.source
        )
    found.sort(key=lambda i: (i.t0, i.part))
    t, stances = _stances(tracks, found, options)
    seated = [
        _interval(tracks, SEAT, "Pelvis", support, i, j, demo.t[[i, j]])
        for support, _, spans in seats
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


def _any(rows: np.ndarray) -> np.ndarray:
    """(T,) whether any of the rows (N, T) is true."""
    return np.logical_or.reduce(rows, axis=0)


def _all(rows: np.ndarray) -> np.ndarray:
    """(T,) whether all of the rows (N, T) are true."""
    return np.logical_and.reduce(rows, axis=0)


def _samples(seconds: float, rate: float) -> int:
    """An odd number of samples, enough for a quadratic."""
    return max(5, 2 * round(seconds * rate / 2) + 1)


def _smooth(demo: Demonstration, options: DetectOptions) -> _Tracks:
    from scipy.signal import savgol_filter

    longest = (len(demo.t) - 1) // 2 * 2 + 1
    if longest < 5:
        raise InputError("five samples at least", source=demo.source, value=longest)
    n = min(_samples(options.smoothing, demo.rate), longest)
    short = min(_samples(options.smoothing / 2, demo.rate), longest)
    p, dt = demo.position, 1.0 / demo.rate
    velocity = np.asarray(savgol_filter(p, n, 2, deriv=1, delta=dt, axis=0))
    return _Tracks(
        demo=demo,
        position=np.asarray(savgol_filter(p, short, 2, axis=0)),
        speed=np.linalg.norm(velocity, axis=2),
    )


def _counting(demo: Demonstration) -> list[str]:
    """Points that are evidence of a contact; a wrist only without fingers."""
    out = []
    for part in PARTS:
        points = demo.points_of(part)
        out += points[1:] if part.endswith("Hand") and len(points) > 1 else points
    return out


def _kind(point: str) -> str:
    """Point without its side: what both sides share."""
    return point[1:]


def _window(demo: Demonstration, point: str) -> _Window:
    kind = _kind(point)
    part, dot, _ = kind.partition(".")
    usual = estimate_offsets(_SIZE, {}).get(kind, 0.0)
    shift = demo.offsets.get(kind, usual) - usual
    w = _WINDOWS[part + dot]
    return _Window(w.low + shift, w.high + shift, w.spread)


@dataclass(frozen=True, eq=False, slots=True)
class _Nearness:
    """Of one point over one support: height (T,), and where it could be in contact."""

    support: Support
    height: np.ndarray
    possible: np.ndarray


def _nearness(
    tracks: _Tracks, point: str, scene: Scene, seats: list, options: DetectOptions
) -> list[_Nearness]:
    """Heights over all supports; only the highest support below a point counts."""
    p, part = tracks.at(point), point.split(".")[0]
    seen = tracks.valid(point)
    shape = _holds_shape(tracks, part)
    over = [
        (s, s.height(p), s.inside(p, -options.edge_slack) & (s.height(p) > _UNDER))
        for s in scene.supports
    ]
    out = []
    for support, height, above in over:
        covered = np.zeros(len(p), dtype=bool)
        for other, other_height, other_above in over:
            if other is not support:
                covered |= other_above & (other_height < height)
        seated = np.zeros(len(p), dtype=bool)
        if part.endswith("Knee"):
            for other, mask, _ in seats:
                seated |= mask & (other.name == support.name)
        out.append(
            _Nearness(support, height, above & ~covered & seen & shape & ~seated)
        )
    return out


def _holds_shape(tracks: _Tracks, part: str) -> np.ndarray:
    """(T,) whether the leg is in a shape in which its knee or foot can bear load.

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


def _find_seats(tracks: _Tracks, scene: Scene, options: DetectOptions) -> list:
    """Each support with the mask (T,) and the index ranges of sitting on it."""
    hips = (tracks.at("LHip") + tracks.at("RHip")) / 2
    names = [tracks.demo.names.index(n) for n in ("LHip", "RHip")]
    speed = tracks.speed[:, names].mean(axis=1)
    out = []
    for support in scene.supports:
        height = support.height(hips)
        low = support.inside(hips, -options.edge_slack) & (height > -0.05)
        low &= tracks.valid("LHip", "RHip")
        loose = low & (height < options.seat_height + options.height_slack)
        loose &= speed < _SEAT_SPEED * options.exit_speed
        strict = loose & (height < options.seat_height)
        strict &= speed < _SEAT_SPEED * options.enter_speed
        spans = _hysteresis(strict, loose, options.min_duration * tracks.demo.rate)
        mask = np.zeros(len(hips), dtype=bool)
        for i, j in spans:
            mask[i:j] = True
        out.append((support, mask, [(i, j - 1) for i, j in spans]))
    return out


def _hysteresis(
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


def _calibrate(
    tracks: _Tracks, near: dict[str, list[_Nearness]], options: DetectOptions
) -> dict[str, _Window]:
    """Windows by kind of point, narrowed to the lowest plateau of either side."""
    resting: dict[str, list[np.ndarray]] = {}
    for point, over in near.items():
        w = _window(tracks.demo, point)
        slow = tracks.speed[:, tracks.demo.names.index(point)] < options.enter_speed
        for n in over:
            at_rest = n.possible & slow & (n.height > w.low) & (n.height < w.high)
            resting.setdefault(_kind(point), []).append(n.height[at_rest])
    enough = options.min_duration * tracks.demo.rate
    out = {}
    for kind, several in resting.items():
        w, heights = _window(tracks.demo, "L" + kind), np.concatenate(several)
        if len(heights) >= enough:
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
    scene: Scene,
    options: DetectOptions,
) -> Iterable[ContactInterval]:
    """Contacts of one part, its points taken together, on one support at a time."""
    demo = tracks.demo
    points = [p for p in demo.points_of(part) if p in near]
    for k, support in enumerate(scene.supports):
        loose = np.zeros((len(points), len(demo.t)), dtype=bool)
        strict = np.zeros_like(loose)
        for row, point in enumerate(points):
            n, w = near[point][k], windows[_kind(point)]
            speed = tracks.speed[:, demo.names.index(point)]
            slack = options.height_slack
            loose[row] = n.possible & (speed < options.exit_speed)
            loose[row] &= (n.height > w.low - slack) & (n.height < w.high + slack)
            strict[row] = loose[row] & (speed < options.enter_speed)
            strict[row] &= (n.height > w.low) & (n.height < w.high)
        either = _join(tracks, part, _any(loose), options)
        least = options.min_duration * demo.rate
        whole = _hysteresis(_any(strict), either, least)
        rests = [
            s for i, j in whole for s in _places(tracks, points, strict, (i, j), least)
        ]
        for i, j in rests:
            some = round(options.smoothing * demo.rate)
            firsts, lasts = (
                [p for p, ok in zip(points, _any(loose[:, m].T), strict=True) if ok]
                for m in (slice(i, min(i + some, j)), slice(max(j - some, i), j))
            )
            t0, t1 = float(demo.t[0]), float(demo.t[-1])
            if i > 0:  # the part touches with the first of its points
                t0 = min(
                    _refine(tracks, p, support, i, j, leaving=False) for p in firsts
                )
            if j < len(demo.t):
                t1 = max(_refine(tracks, p, support, i, j, leaving=True) for p in lasts)
            if t1 - t0 < options.min_duration:
                continue
            ends, t = _limb_ends(demo, part), np.array([t0, t1])
            yield _interval(tracks, part, part, support, i, j - 1, t, ends)


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
    still = [(a + i, b + i) for a, b in runs(_any(strict[:, i:j])) if b - a >= least]
    out, first = [], i
    for (a0, a1), (b0, b1) in pairwise(still):
        moved = []
        for row, point in enumerate(points):
            p = tracks.at(point)
            before, after = (
                p[m][strict[row, m]] for m in (slice(a0, a1), slice(b0, b1))
            )
            if len(before) and len(after):
                gap = np.median(after, axis=0) - np.median(before, axis=0)
                moved.append(float(np.linalg.norm(gap)) > _MOVED)
        if moved and all(moved):
            out.append((first, a1))
            first = b0
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


def _join(
    tracks: _Tracks, part: str, mask: np.ndarray, options: DetectOptions
) -> np.ndarray:
    """Close interruptions that are short, seen and end where they began."""
    mask, p = mask.copy(), tracks.at(part)
    seen = tracks.valid(part)
    for i, j in runs(~mask):
        inside = i > 0 and j < len(mask)
        if inside and (j - i) <= options.join * tracks.demo.rate and seen[i:j].all():
            mask[i:j] = np.linalg.norm(p[j] - p[i - 1]) < _JOIN_DISTANCE
    return mask


_REST = 0.3  # [s] from whose median a resting place is read
_SEARCH = 0.5  # [s] a change lies at most so far inside its coarse interval
_AROUND = 0.1  # [s] half the stretch of track that the fit looks at
_STILL = 0.015  # [m] a part that rolls in place changes height by less than this


def _refine(
    tracks: _Tracks, point: str, support: Support, i: int, j: int, *, leaving: bool
) -> float:
    """Instant [s] at which a point comes to rest at the start of [i, j), or leaves.

    First the last sample that is not at the height at which the point rests, then the
    least-squares instant t of `p(t + s) = rest + a max(-s, 0)`: a straight way in, then
    stillness. Over 0.1 s no path is so curved that more terms would tell.
    Leaving is the same seen backwards in time.
    """
    demo, column = tracks.demo, tracks.demo.names.index(point)
    raw, smooth = demo.position[:, column], tracks.position[:, column]
    valid, n, rate = demo.valid[:, column], len(demo.t), demo.rate
    if leaving:
        raw, smooth, valid = raw[::-1], smooth[::-1], valid[::-1]
        i, j = n - j, n - i
    if not valid[max(i - 1, 0)]:  # the view begins here, not the contact
        return float(demo.t[n - 1 - i] if leaving else demo.t[i])
    ahead = min(i + round(_SEARCH * rate), (i + j) // 2)
    raw_height, height = support.height(raw), support.height(smooth)
    rest = np.median(raw_height[ahead : min(ahead + round(_REST * rate), j)])
    still = max(_STILL, 4.5 * _noise(raw) / 2.0)  # smoothing halves the noise
    start = max(i - round(_AROUND * rate), 0)
    away = height[start : ahead + 1] - rest > still  # no part rests above its place
    moving = np.flatnonzero(away)
    k = start + int(moving[-1]) if len(moving) else i
    k = _fit_instant(raw, min(k, ahead), round(_AROUND * rate))
    return float(np.interp(n - 1 - k if leaving else k, np.arange(n), demo.t))


def _noise(x: np.ndarray) -> float:
    """Standard deviation of white noise on a smooth track (T, 3) [m].

    Third differences of white noise have 20 times its variance; the median spares them
    from the jolts of impacts.
    """
    jerk = np.diff(x, n=3, axis=0)
    return float(1.4826 * np.median(np.abs(jerk)) / np.sqrt(20.0))


def _fit_instant(p: np.ndarray, k: int, half: int) -> int:
    """Index within `half` of k at which rest begins, by least squares."""
    low, high = max(k - 3 * half // 2, 0), min(k + 4 * half + 1, len(p))
    y, s = p[low:high], np.arange(low, high)
    best = (np.inf, k)
    for c in range(max(k - half, low + 3), min(k + half, high - 4) + 1):
        A = np.stack([np.ones(len(s)), np.maximum(c - s, 0.0) / half], axis=1)
        x, *_ = np.linalg.lstsq(A, y, rcond=None)
        cost = float(np.sum((A @ x - y) ** 2))
        best = min(best, (cost, c))
    return best[1]


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
    point: str,
    support: Support,
    i: int,
    j: int,
    t: np.ndarray,
    ends: tuple[str, str] | None = None,
) -> ContactInterval:
    """A contact with the pose it has over samples i to j, both included.

    The place is the median of the part's reference point, on the support; the heading
    is that from the first to the second of `ends`; without, the way the hips face.
    """
    ok = np.zeros(len(tracks.demo.t), dtype=bool)
    ok[i : j + 1] = True
    if np.any(ok & tracks.valid(point)):
        ok &= tracks.valid(point)
    p = np.median(tracks.demo.point(point)[ok], axis=0)
    p = p - support.normal * support.height(p)
    A, b = support.edges()
    for row, limit in zip(A, b, strict=True):  # a wrist may hang over the edge
        p = p - row * max(float(row @ p - limit), 0.0)
    if ends is None:
        left = np.mean((tracks.at("LHip") - tracks.at("RHip"))[ok], axis=0)
        heading = np.array([left[1], -left[0], 0.0])
    else:
        heading = np.mean((tracks.at(ends[1]) - tracks.at(ends[0]))[ok], axis=0)
    contact = Contact(
        surface=part,
        support=support.name,
        position=p,
        quaternion=quat_from_matrix(frame_from_normal(support.normal, heading)),
    )
    t0, t1 = float(t[0]), float(t[1])
    return ContactInterval(
        part=part, is_surface=part != SEAT, t0=t0, t1=t1, contact=contact
    )


def _stances(
    tracks: _Tracks, intervals: list[ContactInterval], options: DetectOptions
) -> tuple[np.ndarray, tuple[Stance, ...]]:
    """Stances between the instants at which something changes.

    Instants closer than `merge` become their mean. Where nothing is in contact the
    stance before goes on.
    """
    end = float(tracks.demo.t[-1])
    changes = sorted({x for i in intervals for x in (i.t0, i.t1)} | {end})
    groups: list[list[float]] = []
    for x in changes:
        if groups and x - groups[-1][0] < options.merge:
            groups[-1].append(x)
        else:
            groups.append([x])
    instant = {x: float(np.mean(g)) for g in groups for x in g}
    for x in groups[0]:
        instant[x] = groups[0][0]
    for x in groups[-1]:
        instant[x] = end
    cuts = sorted(set(instant.values()))
    times: list[float] = []
    held: list[tuple[Contact, ...]] = []
    for a, b in pairwise(cuts):
        now = tuple(
            i.contact
            for i in sorted(intervals, key=lambda i: PARTS.index(i.part))
            if instant[i.t0] <= a and instant[i.t1] >= b
        )
        if not now or (held and [id(c) for c in now] == [id(c) for c in held[-1]]):
            continue
        times.append(a)
        held.append(now)
    times.append(cuts[-1])
    stances = tuple(
        Stance(
            contacts=contacts,
            posture=_posture(tracks, a, b),
            pelvis=_pelvis(tracks, a, b),
        )
        for contacts, a, b in zip(held, times[:-1], times[1:], strict=True)
    )
    return np.array(times), stances


def _middle(tracks: _Tracks, t0: float, t1: float) -> np.ndarray:
    """(T,) the middle half of a stance, one sample at least."""
    quarter = (t1 - t0) / 4.0
    t = tracks.demo.t
    middle = (t >= t0 + quarter) & (t <= t1 - quarter)
    middle[np.argmin(np.abs(t - (t0 + t1) / 2.0))] = True
    return middle


def _pelvis(tracks: _Tracks, t0: float, t1: float) -> np.ndarray | None:
    """Mean pose (7,) of the pelvis over the middle half of a stance, where seen.

    Between the hips, y to the left one, z along the trunk as far as it is square to y:
    markers on hips and shoulders tell no more.
    """
    names = ("LHip", "RHip", "LShoulder", "RShoulder")
    ok = _middle(tracks, t0, t1) & tracks.valid(*names)
    if not ok.any():
        return None
    hips, shoulders = (
        [np.mean(tracks.at(n)[ok], axis=0) for n in pair]
        for pair in (names[:2], names[2:])
    )
    y = hips[0] - hips[1]
    y = y / np.linalg.norm(y)
    position = np.mean(hips, axis=0)
    z = np.mean(shoulders, axis=0) - position
    z = z - y * (y @ z)
    z = z / np.linalg.norm(z)
    R = np.stack([np.cross(y, z), y, z], axis=1)
    return np.concatenate([position, quat_from_matrix(R)])


def _posture(tracks: _Tracks, t0: float, t1: float) -> dict[str, np.ndarray]:
    """Mean directions of the segments over the middle half of a stance."""
    middle = _middle(tracks, t0, t1)
    segments: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
        "trunk": (("LHip", "RHip"), ("LShoulder", "RShoulder"))
    }
    for s, side in zip(SIDES, ("left", "right"), strict=True):
        hand = wrist(tracks.demo.names, s)
        segments[f"{side}_upper_arm"] = ((s + "Shoulder",), (s + "Elbow",))
        segments[f"{side}_forearm"] = ((s + "Elbow",), (hand,))
        segments[f"{side}_thigh"] = ((s + "Hip",), (s + "Knee",))
        segments[f"{side}_shank"] = ((s + "Knee",), (s + "Foot",))
    out = {}
    for name, (base, tip) in segments.items():
        ok = middle & tracks.valid(*base, *tip)
        if not ok.any():
            continue
        ends = [
            np.mean([tracks.at(n)[ok] for n in x], axis=(0, 1)) for x in (base, tip)
        ]
        direction = ends[1] - ends[0]
        out[name] = direction / np.linalg.norm(direction)
    return out
