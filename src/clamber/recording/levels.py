"""Heights of floor and boxes, from what rests on them.

In real takes the floor is off by centimetres: the origin was set on a plate, the boxes
were measured by hand. A foot that stands tells better, given how high its joints are
over the sole (`Demonstration.offsets`), and so does a knee that kneels.

Shapes: T samples.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from clamber.errors import InputError
from clamber.model.scene import Box, Scene, Support
from clamber.recording.demonstration import SIDES, Demonstration, runs

_EVIDENCE = ("Foot", "Knee", "Hand")
_LEGS = ("Foot", "Knee")  # that tell more than a hand
_SEARCH = 0.10  # [m] further off may be another surface
_FAR = 1.5  # [m] but the floor is looked for so far, where nothing rests nearer
_CLUSTER = 0.02  # [m] what rests at one height is within this
_OFF = 0.02  # [m] the estimate of offsets is no better: a floor so near is right
_ANKLE_OFF = 0.03  # [m] the same of ankles alone
_SURE, _SPREAD = 1.0, 0.01  # [s], [m] of evidence on which the floor is moved unasked
_SPEED = 0.10  # [m/s] slower is at rest
_THIN = 1e-3  # [m] a box is never lowered to less
_REST = 0.3  # [s] at least
_SMOOTH = 0.2  # [s] length of the filter for speeds
_UP = np.array([0.0, 0.0, 1.0])
_SHANK_UP, _SHANK_LIES, _THIGH_UP = 0.6, 0.5, 0.1  # sines of slopes: stands; kneels


@dataclass(frozen=True, slots=True)
class Level:
    """By how much a support was off.

    Attributes:
        support: Its name.
        correction: To be added to its height [m].
        part: What rested on it: feet, else knees, else hands.
        seconds: For how long altogether.
        spread: Half the range that holds the middle half of these seconds [m].
    """

    support: str
    correction: float
    part: str
    seconds: float
    spread: float


def find_levels(demo: Demonstration) -> tuple[Level, ...]:
    """Heights of the supports, from what rests on them; only those with evidence."""
    levels = (_level(demo, support, _SEARCH) for support in demo.scene.supports)
    return tuple(x for x in levels if x is not None)


def _level(demo: Demonstration, support: Support, reach: float) -> Level | None:
    """Height of a support, by points at rest within `reach` [m]; None without any."""
    for part in _EVIDENCE if reach <= _SEARCH else _LEGS:
        both = [_resting(demo, s + part, support, reach) for s in SIDES]
        clearance = np.concatenate(both)
        if reach > _SEARCH:
            clearance = _lowest(clearance)
        if len(clearance) >= _REST * demo.rate:
            low, middle, high = np.percentile(clearance, [25, 50, 75])
            seconds, spread = len(clearance) / demo.rate, float(high - low) / 2
            return Level(support.name, float(middle), part, seconds, spread)
    return None


def _lowest(clearance: np.ndarray) -> np.ndarray:
    """The clearances at the lowest height at which a fair share of them lie."""
    x = np.sort(clearance)
    count = np.searchsorted(x, x + _CLUSTER, side="right") - np.arange(len(x))
    if not len(x):
        return x
    first = int(np.argmax(count >= 0.2 * count.max()))
    first += int(np.argmax(count[first : first + count[first]]))
    return x[first : first + count[first]]


def find_floor(demo: Demonstration) -> Level | None:
    """Height of the floor, by points at rest on it; None if nothing rests."""
    ground = demo.scene.supports[0]
    near = _level(demo, ground, _SEARCH)
    if near is not None and near.part in _LEGS:
        return near
    return _level(demo, ground, _FAR) or near


def settle(demo: Demonstration) -> Demonstration:
    """The demonstration with its floor where the person stands, on strong evidence.

    Strong is a second of standing feet whose toes and ankles agree within millimetres
    on a floor that is centimetres off. Of a floor that is further off, or of weaker
    evidence, the notes tell.

    Raises:
        InputError: The person is under the floor.
    """
    floor = find_floor(demo)
    if floor is None or abs(floor.correction) < _OFF:
        return demo
    said = say_floor(floor)
    if abs(floor.correction) <= _SEARCH:
        sure = floor.seconds >= _SURE and floor.spread <= _SPREAD
        if not (sure and floor.part == "Foot" and _ankles_agree(demo, floor)):
            return replace(demo, notes=(*demo.notes, f"the floor may be off: {said}"))
        note = (
            f"{said.partition(':')[0]}: the floor was moved there (offset: 0 in a "
            "recording.yaml keeps it)"
        )
        fitted = fit_levels(demo)
        return replace(fitted, notes=(*fitted.notes, note))
    if floor.correction < 0 and not any(x.part in _LEGS for x in find_levels(demo)):
        raise InputError(f"a person over the floor: {said}", demo.source, "offset")
    return replace(demo, notes=(*demo.notes, f"the floor may be off: {said}"))


def say_floor(floor: Level) -> str:
    """A sentence: the offset of feet and floor, its sign, and how to correct it."""
    way = "above" if floor.correction > 0 else "below"
    what = {"Foot": "the feet rest", "Knee": "the knees rest", "Hand": "hands rest"}
    return (
        f"{what[floor.part]} {abs(floor.correction):.3f} m {way} the floor for "
        f"{floor.seconds:.1f} s: --fit-floor corrects it, or offset: "
        f"{-floor.correction:.3f} in a recording.yaml"
    )


def _ankles_agree(demo: Demonstration, floor: Level) -> bool:
    """Whether ankles, where toes told, are off the same way by half as much or more."""
    ground = demo.scene.supports[0]
    found = []
    for s in SIDES:
        if _telling(demo, s + "Foot") == s + "Foot":
            return abs(floor.correction) > _ANKLE_OFF
        found.append(_resting(demo, s + "Foot", ground, 2 * _SEARCH, ankle=True))
    off = np.concatenate(found)
    return bool(len(off)) and float(np.median(off)) / floor.correction > 0.5


def fit_levels(demo: Demonstration) -> Demonstration:
    """The same demonstration with floor and boxes where the person rests on them.

    The ground stays z = 0, so that the person is moved instead; a box that nobody
    rests on keeps its height over the ground. What was done is in the notes.
    """
    floor = find_floor(demo)
    if floor is not None and abs(floor.correction) >= _SEARCH:
        moved = demo.position - floor.correction * _UP
        note = f"moved by {-floor.correction:+.3f} m onto the floor before fitting"
        return fit_levels(replace(demo, position=moved, notes=(*demo.notes, note)))
    levels = {x.support: x for x in find_levels(demo)}
    ground = demo.scene.supports[0].name
    lift = levels[ground].correction if ground in levels else 0.0
    position = demo.position.copy()
    position[..., 2] -= lift
    boxes = tuple(
        _raised(b, levels[b.name].correction - lift) if b.name in levels else b
        for b in demo.scene.boxes
    )
    notes = [
        f"fitted: {name} {1000 * x.correction:+.0f} mm ({x.part.lower()} at rest for "
        f"{x.seconds:.1f} s, spread {1000 * x.spread:.0f} mm)"
        for name, x in levels.items()
    ]
    unknown = [s.name for s in demo.scene.supports if s.name not in levels]
    notes += [f"not fitted: {n}, nothing rests on it" for n in unknown]
    return replace(
        demo,
        position=position,
        scene=replace(demo.scene, boxes=boxes),
        notes=(*demo.notes, *notes),
    )


def _raised(box: Box, lift: float) -> Box:
    """The box with its top higher; its foot stays, unless it is tilted."""
    if abs(box.rotation[2, 2]) < 1 - 1e-9:
        return replace(box, centre=box.centre + lift * _UP)
    lift = max(lift, _THIN - box.size[2])
    size = box.size + lift * _UP
    return replace(box, size=size, centre=box.centre + lift / 2 * _UP)


def _resting(
    demo: Demonstration, part: str, support: Support, reach: float, ankle: bool = False
) -> np.ndarray:
    """(N,) clearances [m] of a part at its samples at rest."""
    point = part if ankle else _telling(demo, part)
    if point is None or point[1:] not in demo.offsets:
        return np.empty(0)
    p, seen = demo.point(point), demo.valid[:, demo.names.index(point)]
    clearance = support.height(p) - demo.offsets[point[1:]]
    ok = seen & (np.abs(clearance) < reach) & support.inside(p)
    ok &= ~_covered(demo.scene, support, p, clearance)
    ok &= _in_support(demo, part) & (_speed(demo, point) < _SPEED)
    shortest = _REST * demo.rate
    kept = [clearance[i:j] for i, j in runs(ok) if j - i >= shortest]
    return np.concatenate(kept) if kept else np.empty(0)


def _telling(demo: Demonstration, part: str) -> str | None:
    """The point whose height is evidence: toe, knee or knuckle; no wrist."""
    best = {"Foot": part + ".toe", "Hand": part + ".knuckle"}.get(part[1:], part)
    if best in demo.names:
        return best
    return None if part[1:] == "Hand" else part


def _covered(
    scene: Scene, support: Support, p: np.ndarray, clearance: np.ndarray
) -> np.ndarray:
    """(T,) whether another support lies between, or rather explains the height."""
    out = np.zeros(len(p), dtype=bool)
    for other in scene.supports:
        if other.name != support.name:
            gap = support.height(p) - other.height(p)
            out |= other.inside(p) & (gap > 0) & (clearance - gap > -_SEARCH)
    return out


def _in_support(demo: Demonstration, part: str) -> np.ndarray:
    """(T,) whether the leg stands, or kneels; of other parts always."""
    side, kind = part[0], part[1:]
    hip, knee, ankle = (demo.point(side + j)[:, 2] for j in ("Hip", "Knee", "Foot"))
    rise = (knee - ankle) / demo.subject["shank"]
    if kind == "Foot":
        return rise > _SHANK_UP
    if kind == "Knee":
        return (rise < _SHANK_LIES) & (hip - knee > _THIGH_UP * demo.subject["thigh"])
    return np.ones(len(demo.t), dtype=bool)


def _speed(demo: Demonstration, point: str) -> np.ndarray:
    """(T,) of a point [m/s]."""
    from scipy.signal import savgol_filter

    n = min(
        max(5, 2 * round(_SMOOTH * demo.rate / 2) + 1), (len(demo.t) - 1) // 2 * 2 + 1
    )
    if n < 5:
        return np.full(len(demo.t), np.inf)  # too short to tell rest from motion
    velocity = savgol_filter(
        demo.point(point), n, 2, deriv=1, delta=1.0 / demo.rate, axis=0
    )
    return np.linalg.norm(np.asarray(velocity), axis=1)
