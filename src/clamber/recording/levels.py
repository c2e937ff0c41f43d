"""The floor and the boxes' tops at the heights at which the person rests on them.

In real takes the floor is off by centimetres: the origin was set on a plate, the boxes
were measured by hand. A foot that stands tells better, given how high its joints are
over the sole (`Demonstration.offsets`), and so does a knee that kneels.

Shapes: T samples.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from clamber.model.scene import Box, Scene, Support
from clamber.recording.demonstration import SIDES, Demonstration, runs

# Best evidence first: a sole is firm, fingers are not.
_EVIDENCE = ("Foot", "Knee", "Hand")
_SEARCH = 0.10  # [m] no take is further off; more is another surface
_SPEED = 0.10  # [m/s] slower is at rest
_THIN = 1e-3  # [m] a box is never lowered to less
_REST = 0.3  # [s] at least
_SMOOTH = 0.2  # [s] length of the filter for speeds
_UP = np.array([0.0, 0.0, 1.0])
_SHANK_UP, _SHANK_LIES, _THIGH_UP = 0.6, 0.5, 0.1  # sines of slopes: stands; kneels


@dataclass(frozen=True, slots=True, kw_only=True)
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
    out: list[Level] = []
    for support in demo.scene.supports:
        for part in _EVIDENCE:
            clearance = np.concatenate(
                [_resting(demo, s + part, support) for s in SIDES]
            )
            if len(clearance) >= _REST * demo.rate:
                low, middle, high = np.percentile(clearance, [25, 50, 75])
                out.append(
                    Level(
                        support=support.name,
                        correction=float(middle),
                        part=part,
                        seconds=len(clearance) / demo.rate,
                        spread=float(high - low) / 2,
                    )
                )
                break
    return tuple(out)


def fit_levels(demo: Demonstration) -> Demonstration:
    """The same demonstration with floor and boxes where the person rests on them.

    The ground stays z = 0, so that the person is moved instead; a box that nobody
    rests on keeps its height over the ground. What was done is in the notes.
    """
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
        return replace(box, position=box.position + lift * _UP)
    lift = max(lift, _THIN - box.size[2])
    size = box.size + lift * _UP
    return replace(box, size=size, position=box.position + lift / 2 * _UP)


def _resting(demo: Demonstration, part: str, support: Support) -> np.ndarray:
    """(N,) clearances [m] of a part, sample by sample, at rest."""
    point = _telling(demo, part)
    if point is None or point[1:] not in demo.offsets:
        return np.empty(0)
    p, seen = demo.point(point), demo.valid[:, demo.names.index(point)]
    clearance = support.height(p) - demo.offsets[point[1:]]
    ok = seen & (np.abs(clearance) < _SEARCH) & support.inside(p)
    ok &= ~_covered(demo.scene, support, p, clearance)
    ok &= _bears(demo, part) & (_speed(demo, point) < _SPEED)
    shortest = _REST * demo.rate
    kept = [clearance[i:j] for i, j in runs(ok) if j - i >= shortest]
    return np.concatenate(kept) if kept else np.empty(0)


def _telling(demo: Demonstration, part: str) -> str | None:
    """The point whose height tells: toe, knee or knuckle; a wrist tells nothing."""
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


def _bears(demo: Demonstration, part: str) -> np.ndarray:
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
