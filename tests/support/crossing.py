"""The second built-in demonstration: a person crosses a table on elbows and knees.

Up onto the table, hands and elbows set down twice each; along it, with a turn midway,
so that the far edge is climbed down backwards; then back to standing, a few steps away.
Like the climb it is made here, says so in its source and knows its true contacts.

A script of phases says what each limb holds on to and which one moves. Each phase ends
in a key pose, moved the least that lets the limbs reach what they hold; between key
poses the body is corrected in the same way, so that what is in contact keeps still.

World: origin between the ankles, x towards the table, z up. The body's positions are in
the world, its rotation vectors in a frame that has turned by `yaw` about z: the figure
faces x there, and rotation vectors stay small while it turns around.
Shapes: T samples.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from clamber.contact.contact import ContactInterval
from clamber.model.se3 import matrix_from_rpy, rotation_vector
from clamber.recording.demonstration import SIDES, Demonstration
from support.figure import (
    ANKLE,
    ELBOW,
    FOOT,
    FOREARM,
    KNEE,
    SHANK,
    SIGN,
    THIGH,
    TOE,
    TRUNK,
    UPPER_ARM,
    WRIST,
    Held,
    Tracks,
    bend,
    blend,
    ease,
    hit,
    hop,
    joint_of,
    kick,
    reach,
    recorded,
    rotate,
    settle,
    sway,
    toe_pivot,
    touched,
    unit,
)

NEAR_FACE = 0.42  # [m] from the ankles to the table
STRETCH = 0.995  # of a limb's length: no one locks a joint
UP = np.array([0.0, 0.0, 1.0])
TALL = ANKLE + SHANK + THIGH


@dataclass(frozen=True, slots=True, kw_only=True)
class CrossingOptions:
    """What the crossing is like.

    Attributes:
        length: Of the table along the way [m], 1.5 or more.
        width: Of the table [m], 0.85 or more: it must bear knees and hands while the
            person turns.
        height: Of the table [m]; 0.5 to 0.62 look credible.
        sets: How often each hand and each elbow is set down on the way up and on the
            way down, and each foot while stepping away.
        mirrored: The right side goes first.
        speed: Twice as fast at 2.
        noise: Standard deviation of a marker's coordinates [m].
        gaps: How many short stretches of markers are missing.
        rate: [Hz].
    """

    length: float = 1.7
    width: float = 0.9
    height: float = 0.6
    sets: int = 2
    mirrored: bool = False
    speed: float = 1.0
    noise: float = 0.002
    gaps: int = 12
    rate: float = 120.0


def synthesize_crossing(
    rng: np.random.Generator, *, options: CrossingOptions | None = None
) -> tuple[Demonstration, list[ContactInterval]]:
    """Make the crossing and say what really was in contact.

    Args:
        rng: Drives noise, gaps and the body's sway.
        options: What the crossing is like.

    Returns:
        The recording and its true contacts by start time.
    """
    o = options or CrossingOptions()
    size = np.array([o.length, o.width, o.height])
    return recorded("crossing", clean_motion(rng, o), (size, NEAR_FACE), rng, o)


# What limbs hold on to.


@dataclass(frozen=True, slots=True)
class _Hold:
    """A limb's contact, by joint centres (3,) [m].

    `a` and `b` are: wrist and nothing (`hand`), wrist and elbow (`forearm`), ankle and
    toe of a flat foot (`foot`), knee and the shank's direction from there (`knee`).
    """

    kind: Literal["hand", "forearm", "foot", "knee"]
    yaw: float
    a: np.ndarray
    b: np.ndarray


_PARTS = {
    "hand": ("Hand",),
    "forearm": ("Elbow", "Hand"),
    "foot": ("Foot",),
    "knee": ("Knee",),
}
_Holds = dict[str, _Hold | None]  # by limb: side and `Arm` or `Leg`


@dataclass(frozen=True, slots=True)
class _Frame:
    """Depth, side and height seen from `origin` (3,) by somebody who faces `yaw`."""

    origin: np.ndarray
    yaw: float

    def __call__(self, depth: float, side: float, z: float) -> np.ndarray:
        return self.origin + _turn(self.yaw, np.array([depth, side, z]))


def _turn(yaw: np.ndarray | float, v: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) turned about z by angles (...)."""
    c, s, x, y = np.cos(yaw), np.sin(yaw), v[..., 0], v[..., 1]
    z = np.broadcast_to(v[..., 2], np.shape(c * x))
    return np.stack([c * x - s * y, s * x + c * y, z], axis=-1)


def _hand(f: _Frame, s: str, depth: float, side: float, h: float) -> _Hold:
    wrist = f(depth, SIGN[s] * side, h + WRIST)
    return _Hold("hand", f.yaw, wrist, np.zeros(3))


def _forearm(
    f: _Frame, s: str, depth: float, side: float, h: float, across: float
) -> _Hold:
    """The elbow at that depth and side; its hand lies `across` nearer to the middle."""
    along = np.sqrt(FOREARM**2 - across**2 - (ELBOW - WRIST) ** 2)
    wrist = f(depth + along, SIGN[s] * (side - across), h + WRIST)
    return _Hold("forearm", f.yaw, wrist, f(depth, SIGN[s] * side, h + ELBOW))


def _foot(f: _Frame, s: str, depth: float) -> _Hold:
    sign = SIGN[s]
    toe = f(depth + FOOT, sign * 0.13, TOE)
    return _Hold("foot", f.yaw, f(depth, sign * 0.11, ANKLE), toe)


def _knee(f: _Frame, s: str, depth: float, side: float, h: float) -> _Hold:
    lies = unit(np.array([-1.0, 0.0, -0.09]))
    knee = f(depth, SIGN[s] * side, h + KNEE)
    return _Hold("knee", f.yaw, knee, _turn(f.yaw, lies))


# The script.


@dataclass(frozen=True, slots=True)
class _Phase:
    """A stretch of time at whose end the body is as wanted.

    Attributes:
        seconds: How long it takes.
        move: The limb that moves and what it holds in the end (None: it hangs).
        yaw: Which way the figure faces in the end [rad].
        body: (12,) wanted in the end.
        heels: By side, how far the heels are up in the end [rad].
        drops: The body falls onto its elbow, rather than being set down.
    """

    seconds: float
    move: tuple[str, _Hold | None] | None
    yaw: float
    body: np.ndarray
    heels: Mapping[str, float]
    drops: bool = False


def _posed(
    f: _Frame,
    pelvis: tuple[float, float, float, float],
    chest: tuple[float, float, float, float],
    roll: float = 0.0,
) -> np.ndarray:
    """Body (12,) of depth, side, height and pitch each; `roll` is the chest's."""
    return np.array(
        [*f(*pelvis[:3]), 0.0, pelvis[3], 0.0, *f(*chest[:3]), roll, chest[3], 0.0]
    )


_STAND = 0.40  # [m] hips are so far from the edge
_REACH_FROM, _REACH_TO = 0.25, 0.36  # [m] depth of the wrists, first and last
_LIE_TO = 0.10  # [m] by so much the elbows go on
_KNEES = 0.13  # [m] depth of the knees at the edges
_BENT, _LYING = 0.195, 0.15  # [m] across the forearms lie, climbing and crawling
_AHEAD, _BEHIND = 0.20, -0.20  # [m] elbows and knees from the middle, crawling
_HAND = 0.157  # [m] from the wrist to the fingers' tips
_STRIDE, _SWIVEL = 0.22, np.pi / 6  # [m], [rad] of a cycle
_MOVE, _REST = 0.65, 0.3  # [s] of a crawling limb


class _Script:
    """Phases as they are written, with what is held at their end."""

    def __init__(self, o: CrossingOptions) -> None:
        self.o, self.h = o, o.height
        self.phases: list[_Phase] = []
        self.yaw = 0.0
        self.heels: dict[str, float] = dict.fromkeys(SIDES, 0.0)
        start = _Frame(np.zeros(3), 0.0)
        self.holds: _Holds = {s + "Arm": None for s in SIDES}
        self.holds |= {s + "Leg": _foot(start, s, 0.0) for s in SIDES}

    def add(
        self,
        seconds: float,
        body: np.ndarray,
        limb: str | None = None,
        hold: _Hold | None = None,
        *,
        heels: tuple[float, float] | None = None,
        drops: bool = False,
    ) -> None:
        """The body moves, and a limb where one is named."""
        if heels is not None:
            self.heels = dict(zip(SIDES, heels, strict=True))
        move = None if limb is None else (limb, hold)
        if move is not None:
            self.holds = {**self.holds, move[0]: move[1]}
        self.phases.append(
            _Phase(seconds, move, self.yaw, body, dict(self.heels), drops)
        )

    def rest(self, seconds: float) -> None:
        """Nothing moves."""
        self.add(seconds, self.phases[-1].body)

    def crawling(self) -> np.ndarray:
        """Body over knees and elbows, which also say which way it faces."""
        points = {}
        for limb, n in (("Leg", 0), ("Arm", 1)):
            for s in SIDES:
                hold = self.holds[s + limb]
                assert hold is not None
                points[s + limb] = hold.b if n else hold.a
        knees = (points["LLeg"] + points["RLeg"]) / 2
        elbows = (points["LArm"] + points["RArm"]) / 2
        ahead = elbows - knees
        self.yaw += _wrapped(np.arctan2(ahead[1], ahead[0]) - self.yaw)
        f = _Frame(np.zeros(3), self.yaw)
        out = np.zeros(12)
        for k, middle, left, offset, z, pitch in (
            (0, knees, points["LLeg"] - points["RLeg"], -0.03, KNEE + 0.35, 1.15),
            (6, elbows, points["LArm"] - points["RArm"], -0.01, ELBOW + 0.29, 1.45),
        ):
            twist = _wrapped(np.arctan2(-left[0], left[1]) - self.yaw)
            out[k : k + 3] = middle + f(offset, 0.0, 0.0)
            out[k + 2] = self.h + z
            R = matrix_from_rpy([0.0, pitch, twist])
            out[k + 3 : k + 6] = rotation_vector(R)
        return out


def _wrapped(angle: float) -> float:
    return float((angle + np.pi) % (2.0 * np.pi) - np.pi)


def _script(o: CrossingOptions) -> list[_Phase]:
    """The whole crossing; the left side goes first."""
    script = _Script(o)
    up = _Frame(np.array([NEAR_FACE, 0.0, 0.0]), 0.0)
    down = _Frame(np.array([NEAR_FACE + o.length, 0.0, 0.0]), np.pi)
    _climb_up(script, up)
    _crawl(script, up, o)
    _climb_down(script, down)
    return script.phases


def _standing(f: _Frame, depth: float) -> np.ndarray:
    """Upright, the feet at about that depth."""
    hips, shoulders = TALL - 0.006, TALL + TRUNK - 0.012
    return _posed(f, (depth, 0.0, hips, 0.0), (depth, 0.0, shoulders, 0.0))


def _bent_over(f: _Frame, h: float, wrist: float) -> np.ndarray:
    """Standing, hands on the table, hips as far back as the trunk is long."""
    share = (wrist - _REACH_FROM) / (_REACH_TO - _REACH_FROM)
    hips, chest = min(0.85, h + 0.38), h + 0.54 - 0.04 * share
    back = np.sqrt((0.95 * TRUNK) ** 2 - (chest - hips) ** 2)
    return _posed(
        f,
        (wrist - 0.22 - back, 0.0, hips, 0.6 + 0.2 * share),
        (wrist - 0.22, 0.0, chest, 1.0 + 0.2 * share),
    )


def _lying_over(f: _Frame, h: float, wrist: float, side: int = 0) -> np.ndarray:
    """Standing, the chest on both elbows, or on the one of that side (1 is left)."""
    hips = min(0.85, h + 0.38)
    z, lag = (h + 0.43, 0.12) if side else (h + 0.32, 0.10)
    return _posed(
        f,
        (-0.22, 0.0, hips, 0.95),
        (wrist - lag, 0.0, z, 1.45),
        -0.6 * side,
    )


def _on_knees(
    f: _Frame, h: float, wrist: float, late: float, side: float
) -> np.ndarray:
    """From both toes on the ground (0) to both knees on the table (1)."""
    hips = min(0.85, h + 0.38)
    return _posed(
        f,
        (
            -0.23 + 0.14 * late,
            side,
            hips + (h + 0.385 - hips) * min(1.0, 2.0 * late),
            1.0,
        ),
        (wrist - 0.07 + 0.06 * late, 0.0, h + 0.32 - 0.03 * late, 1.5),
    )


def _climb_up(script: _Script, f: _Frame) -> None:
    """Hands, elbows and knees, from standing before the edge."""
    h, n = script.h, script.o.sets
    script.add(1.2, _standing(f, -_STAND))
    for i, wrist in enumerate(np.linspace(_REACH_FROM, _REACH_TO, n)):
        for s in SIDES:
            hold = _hand(f, s, wrist, 0.06 if i == n - 1 else 0.12, h)
            script.add(0.9 if i else 1.5, _bent_over(f, h, wrist), s + "Arm", hold)
            script.rest(0.4)
    along = np.sqrt(FOREARM**2 - _BENT**2 - (ELBOW - WRIST) ** 2)
    for i, wrist in enumerate(_REACH_TO + np.linspace(0.0, _LIE_TO, n)):
        for s in SIDES:
            both = i > 0 or s == SIDES[1]
            body = _lying_over(f, h, wrist, 0 if both else 1)
            hold = _forearm(f, s, wrist - along, 0.255, h, _BENT)
            script.add(0.8, body, s + "Arm", hold, drops=i == 0)
            script.rest(0.5)
    wrist = _REACH_TO + _LIE_TO
    heels = ((0.65, 0.15), (0.9, 0.6)), ((0.9, 0.9), (0.9, 0.9))
    for i, s in enumerate(SIDES):
        side, (off, on) = -0.04 * SIGN[s], heels[i]
        script.add(0.9, _on_knees(f, h, wrist, 0.5 * i, side), heels=off)
        hold = _knee(f, s, _KNEES, 0.165, h)
        body = _on_knees(f, h, wrist, 0.5 * (i + 1), side / 2)
        script.add(1.4, body, s + "Leg", hold, heels=on)
        script.rest(0.3)


def _crawl(script: _Script, f: _Frame, o: CrossingOptions) -> None:
    """To the middle, around, and backwards to the far edge: elbows, then knees."""
    h, middle = script.h, o.length / 2
    first = _KNEES - _BEHIND + 0.10
    ahead = max(1, round((middle - first) / _STRIDE))
    centres = [(x, 0.0) for x in np.linspace(first, middle, ahead + 1)]
    turns = round(np.pi / _SWIVEL)
    centres += [(middle, (i + 1) * np.pi / turns) for i in range(turns)]
    last = o.length - (_KNEES - _BEHIND)
    back = max(1, round((last - middle) / _STRIDE))
    centres += [(x, np.pi) for x in np.linspace(middle, last, back + 1)[1:]]
    along = np.sqrt(FOREARM**2 - _LYING**2 - (ELBOW - WRIST) ** 2)
    spare = o.width / 2 - 0.02 - (_AHEAD + along + _HAND)  # in front of the fingers
    for x, yaw in centres:
        y = min(0.0, spare) * np.sin(yaw)
        here = _Frame(f.origin + np.array([x, y, 0.0]), yaw)
        for limb in ("Arm", "Leg"):
            for s in SIDES:
                hold = (
                    _forearm(here, s, _AHEAD, 0.20, h, _LYING)
                    if limb == "Arm"
                    else _knee(here, s, _BEHIND, 0.15, h)
                )
                script.holds = {**script.holds, s + limb: hold}
                script.add(_MOVE, script.crawling(), s + limb, hold)
                script.rest(_REST)


def _climb_down(script: _Script, f: _Frame) -> None:
    """Feet, elbows and hands, then steps away from the edge."""
    h, n = script.h, script.o.sets
    script.yaw = f.yaw
    along = np.sqrt(FOREARM**2 - _BENT**2 - (ELBOW - WRIST) ** 2)
    start = _KNEES - _BEHIND + _AHEAD + along  # where the wrists would be, lying bent
    for i, s in enumerate(SIDES):
        side = -0.04 * SIGN[s]
        script.add(0.9, _on_knees(f, h, start - 0.08, 1.0 - 0.4 * i, side))
        hold = _foot(f, s, -NEAR_FACE)
        heels = (0.9, 0.9 * i)
        body = _on_knees(f, h, start - 0.12, 0.5 - 0.5 * i, side / 2)
        script.add(1.4, body, s + "Leg", hold, heels=heels)
        script.rest(0.3)
    script.add(0.9, _lying_over(f, h, start - 0.12), heels=(0.2, 0.2))
    for wrist in np.linspace(_REACH_TO + 0.06, _REACH_TO - 0.02, n):
        for s in SIDES:
            hold = _forearm(f, s, wrist - along, 0.255, h, _BENT)
            body = _lying_over(f, h, wrist)
            script.add(0.8, body, s + "Arm", hold, heels=(0.0, 0.0))
            script.rest(0.4)
    for i, wrist in enumerate(np.linspace(_REACH_TO - 0.02, _REACH_FROM, n)):
        for s in SIDES:
            hold = _hand(f, s, wrist, 0.12, h)
            up = i > 0 or s == SIDES[1]
            body = _bent_over(f, h, wrist) if up else _lying_over(f, h, wrist, -1)
            script.add(0.9, body, s + "Arm", hold)
            script.rest(0.4)
    for s in SIDES:
        body = _standing(f, -_STAND) if s == SIDES[1] else _bent_over(f, h, _REACH_FROM)
        script.add(1.2, body, s + "Arm")
    for i in range(n):
        for s in SIDES:
            hold = _foot(f, s, -NEAR_FACE - 0.22 * (i + 1))
            back = -0.22 * (i + 0.5 + 0.5 * (s == SIDES[1]))
            script.add(0.8, _standing(f, back - _STAND), s + "Leg", hold)
            script.rest(0.4)
    script.rest(1.0)


# The motion.


def clean_motion(
    rng: np.random.Generator, o: CrossingOptions
) -> tuple[Tracks, list[ContactInterval]]:
    """Exact tracks (T, 3) and true contacts; the left side goes first."""
    phases = _script(o)
    lasts = np.array([0.0, *(p.seconds for p in phases)]) / o.speed
    at = np.cumsum(lasts)
    t = np.arange(int(at[-1] * o.rate) + 1) / o.rate
    index = np.clip(np.searchsorted(at, t, side="right") - 1, 0, len(phases) - 1)
    unrest = sway(rng, t)
    holds = _Script(o).holds
    heels: Mapping[str, float] = dict.fromkeys(SIDES, 0.0)
    key, yaw = phases[0].body, 0.0
    pieces: list[Tracks] = []
    began = {p: (0.0, h) for n, x in holds.items() for p, h in _parts(n, x).items()}
    truth: list[ContactInterval] = []
    for k, phase in enumerate(phases):
        tau = (t[index == k] - at[k]) / (at[k + 1] - at[k])
        limb = None if phase.move is None else phase.move[0]
        after = holds if phase.move is None else {**holds, phase.move[0]: phase.move[1]}
        stay = {n: x for n, x in holds.items() if n != limb}

        ends = _held(after, {s: np.array([x]) for s, x in phase.heels.items()})
        end = _key_pose(phase, ends)
        share = hit(tau) if phase.drops else ease(tau)
        yaws = yaw + (phase.yaw - yaw) * share
        pitch = {s: heels[s] + (phase.heels[s] - heels[s]) * ease(tau) for s in SIDES}
        body = key + (end - key) * share[:, None]
        body += np.sin(np.pi * tau)[:, None] ** 2 * unrest[index == k]
        if limb is not None and _slides(holds[limb], after[limb]):
            body += hop(tau)[:, None] * _lift(limb)
        body = _settle(body, _held(stay, pitch), yaws, trunk=False)

        figure = _Figure(tau, body, yaws, (key, yaw), (end, phase.yaw))
        piece = figure.trunk()
        for s in SIDES:
            was, now = holds[s + "Arm"], after[s + "Arm"]
            piece |= figure.arm(s, was, now, moves=limb == s + "Arm")
            was, now = holds[s + "Leg"], after[s + "Leg"]
            assert was is not None
            assert now is not None
            lifts = (pitch[s], heels[s], phase.heels[s])
            piece |= figure.leg(s, was, now, lifts, moves=limb == s + "Leg")
        pieces.append(piece)
        if limb is not None:
            # A hand around which the forearm lies down stays where it is.
            was, now = _parts(limb, holds[limb]), _parts(limb, after[limb])
            stays = (
                set(was) & set(now) if _in_place(holds[limb], after[limb]) else set()
            )
            for part in was.keys() - stays:
                since, hold = began.pop(part)
                truth.append(_contact(part, hold, since, at[k], o.height))
            began |= {p: (at[k + 1], now[p]) for p in now.keys() - stays}
        holds, heels, key, yaw = after, phase.heels, end, phase.yaw
    for part, (since, hold) in began.items():
        truth.append(_contact(part, hold, since, float(t[-1]), o.height))
    tracks = {n: np.concatenate([p[n] for p in pieces]) for n in pieces[0]}
    return tracks, truth


def _parts(limb: str, hold: _Hold | None) -> dict[str, _Hold]:
    """The limb's parts that are in contact."""
    return {} if hold is None else {limb[0] + p: hold for p in _PARTS[hold.kind]}


def _in_place(a: _Hold | None, b: _Hold | None) -> bool:
    return a is not None and b is not None and bool(np.allclose(a.a, b.a))


def _held(holds: _Holds, pitch: Mapping[str, np.ndarray]) -> Held:
    exact, within = [], []
    for limb, hold in holds.items():
        s = limb[0]
        if hold is None:
            continue
        if hold.kind == "hand":
            within.append((f"{s}Shoulder", hold.a, STRETCH * (UPPER_ARM + FOREARM)))
        elif hold.kind == "forearm":
            exact.append((f"{s}Shoulder", hold.b, UPPER_ARM))
        elif hold.kind == "knee":
            exact.append((f"{s}Hip", hold.a, THIGH))
        else:
            ankle = toe_pivot(hold.b, hold.a, pitch[s])
            within.append((f"{s}Hip", ankle, STRETCH * (THIGH + SHANK)))
    return Held(exact=tuple(exact), within=tuple(within))


def _slides(a: _Hold | None, b: _Hold | None) -> bool:
    """Whether a limb would hardly leave the table by itself."""
    return a is not None and b is not None and a.kind == b.kind in ("forearm", "knee")


def _lift(limb: str) -> np.ndarray:
    """Body (12,) raised and rolled, so that an elbow or a knee comes off the table."""
    out, sign = np.zeros(12), SIGN[limb[0]]
    k = 6 if limb.endswith("Arm") else 0
    out[k + 2], out[k + 3] = 0.02, 0.3 * sign
    return out


def _key_pose(phase: _Phase, ends: Held) -> np.ndarray:
    """The body (12,) at the end of a phase; limbs too short at first are stretched."""
    yaw = np.array([phase.yaw])
    end = _settle(phase.body[None], ends, yaw, trunk=True)
    short = tuple(
        (name, point, length)
        for name, point, length in ends.within
        if np.linalg.norm(_joint(end, yaw, name) - point) > length + 1e-6
    )
    if short:
        stretched = Held(exact=ends.exact + short, within=ends.within)
        end = _settle(phase.body[None], stretched, yaw, trunk=True)
    return end[0]


def _settle(
    body: np.ndarray, held: Held, yaw: np.ndarray, *, trunk: bool
) -> np.ndarray:
    """Bodies (T, 12) settled in frames turned by `yaw` (T,)."""

    def turned(x: np.ndarray, angle: np.ndarray) -> np.ndarray:
        x = x.copy()
        x[:, 0:3], x[:, 6:9] = _turn(angle, x[:, 0:3]), _turn(angle, x[:, 6:9])
        return x

    local = Held(
        exact=tuple((n, _turn(-yaw, np.asarray(p)), d) for n, p, d in held.exact),
        within=tuple((n, _turn(-yaw, np.asarray(p)), d) for n, p, d in held.within),
    )
    return turned(settle(turned(body, -yaw), local, trunk=trunk), yaw)


@dataclass(frozen=True, slots=True)
class _Figure:
    """The figure in one phase: share of it past (T,), bodies, yaws, and its ends."""

    tau: np.ndarray
    body: np.ndarray
    yaw: np.ndarray
    start: tuple[np.ndarray, float]
    end: tuple[np.ndarray, float]

    def _joint(self, name: str) -> np.ndarray:
        return _joint(self.body, self.yaw, name)

    def _joint_at(self, key: tuple[np.ndarray, float], name: str) -> np.ndarray:
        return _joint(key[0][None], np.array([key[1]]), name)

    def trunk(self) -> Tracks:
        """Pelvis, neck and head."""
        up = _spin(self.body[:, 9:12], self.yaw, UP)
        ahead = _turn(self.yaw, np.array([0.35, 0.0, 0.25]))
        neck = self.body[:, 6:9] + 0.05 * up
        return {
            "Pelvis": self.body[:, 0:3].copy(),
            "Neck": neck,
            "Head": neck + 0.19 * unit(up + ahead),
        }

    def arm(
        self, s: str, was: _Hold | None, now: _Hold | None, *, moves: bool
    ) -> Tracks:
        """Shoulder, elbow and hand."""
        tau, shoulder = self.tau, self._joint(f"{s}Shoulder")
        hanging = shoulder + _hanging(self.body, self.yaw, s)
        if not moves:
            wrist = hanging if was is None else _wide(was.a, tau)
            if was is not None and was.kind == "forearm":
                elbow = _wide(was.b, tau)
            else:
                pole = self._pole(s, was, self.start)
                elbow = bend(shoulder, wrist, UPPER_ARM, FOREARM, pole)
        elif was is not None and now is not None and was.kind == now.kind == "forearm":
            path = was.b + (now.b - was.b) * hit(tau)[:, None] + 0.08 * _up(hop(tau))
            elbow = shoulder + UPPER_ARM * unit(path - shoulder)
            wrist = elbow + FOREARM * blend(was.a - was.b, now.a - now.b, ease(tau))
        else:
            left = self._joint_at(self.start, f"{s}Shoulder")
            hung = _hanging(self.start[0][None], np.array([self.start[1]]), s)
            a = left + hung if was is None else was.a
            b = hanging if now is None else now.a
            lands = now is not None
            share = hit(tau) if lands else ease(tau)
            wrist = a + (b - a) * share[:, None]
            if not _in_place(was, now):
                height = 0.24 if was is None or now is None else 0.08
                wrist = wrist + height * _up(hop(tau) * (1.0 if lands else 1.0 - tau))
            wrist = reach(shoulder, wrist, 0.999 * (UPPER_ARM + FOREARM))
            turn = hit(tau) if lands and now.kind == "forearm" else kick(tau)
            poles = self._pole(s, was, self.start), self._pole(s, now, self.end)
            pole = blend(*poles, np.clip(turn, 0.0, 1.0))
            elbow = bend(shoulder, wrist, UPPER_ARM, FOREARM, pole)
        ends = [
            unit(wrist - elbow) if x is None else _wide(_palm(s, x.yaw), tau)
            for x in (was, now)
        ]
        along = blend(ends[0], ends[1], ease(1.2 * tau))
        return {
            f"{s}Shoulder": shoulder,
            f"{s}Elbow": elbow,
            f"{s}Hand": wrist,
            f"{s}Hand.knuckle": wrist + 0.084 * along,
            f"{s}Hand.tip": wrist + _HAND * along,
        }

    def _pole(
        self, s: str, hold: _Hold | None, key: tuple[np.ndarray, float]
    ) -> np.ndarray:
        """(1, 3) where the elbow points at a key pose."""
        if hold is not None and hold.kind == "forearm":
            shoulder = self._joint_at(key, f"{s}Shoulder")
            return hold.b - (shoulder + hold.a) / 2
        out = [-1.0, SIGN[s] * 0.3, 0.0] if hold is None else [-0.35, SIGN[s], 1.3]
        return _turn(key[1], np.array(out))[None]

    def leg(
        self,
        s: str,
        was: _Hold,
        now: _Hold,
        pitch: tuple[np.ndarray, float, float],
        *,
        moves: bool,
    ) -> Tracks:
        """Hip, knee and foot; `pitch` of the foot is (T,), then at both ends."""
        tau, hip = self.tau, self._joint(f"{s}Hip")
        if not moves:
            knee, ankle, toe = _legged(was, hip, pitch[0], self._ahead(s, self.yaw))
        elif was.kind == now.kind == "foot":
            share = hit(tau)[:, None]
            rise = 0.10 * _up(hop(tau))
            ankle = was.a + (now.a - was.a) * share + rise
            toe = was.b + (now.b - was.b) * share + rise
            knee = bend(hip, ankle, THIGH, SHANK, self._ahead(s, self.yaw))
        else:
            a, b = (
                _legged(
                    hold,
                    self._joint_at(key, f"{s}Hip"),
                    np.array([angle]),
                    self._ahead(s, np.array([key[1]])),
                )
                for hold, key, angle in (
                    (was, self.start, pitch[1]),
                    (now, self.end, pitch[2]),
                )
            )
            knee, ankle, toe = self._swing(s, was, now, hip, a, b)
        return {
            f"{s}Hip": hip,
            f"{s}Knee": knee,
            f"{s}Foot": ankle,
            f"{s}Foot.toe": toe,
        }

    def _ahead(self, s: str, yaw: np.ndarray) -> np.ndarray:
        """Where the knee points."""
        return _turn(yaw, np.array([1.0, 0.4 * SIGN[s], 0.2]))

    def _swing(
        self,
        s: str,
        was: _Hold,
        now: _Hold,
        hip: np.ndarray,
        a: tuple[np.ndarray, ...],
        b: tuple[np.ndarray, ...],
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Knee, ankle and toe from one place `a` to another one `b`, at a thigh."""
        tau = self.tau
        out = _turn(self.yaw, np.array([0.0, SIGN[s], 0.0]))
        if was.kind == now.kind:  # along the table
            path = a[0] + (b[0] - a[0]) * hit(tau)[:, None] + 0.06 * _up(hop(tau))
            shank = foot = ease(tau)
        elif now.kind == "knee":  # up before it goes forward, and around the edge
            share = np.stack([hit((tau - 0.2) / 0.8)] * 2 + [hit(tau)], axis=1)
            path = a[0] + (b[0] - a[0]) * share
            path = path + out * 0.2 * hop(tau)[:, None] + 0.28 * _up(hop(tau))
            shank, foot = kick(tau), ease(tau)
        else:  # out and back, then down
            path = a[0] + (b[0] - a[0]) * ease(1.2 * tau)[:, None]
            bump = hop(tau) * (1.0 - tau)
            path = path + out * 0.4 * bump[:, None] + 0.30 * _up(bump)
            shank, foot = hit((tau - 0.25) / 0.75), ease(tau)
        knee = hip + THIGH * unit(path - hip)
        ankle = knee + SHANK * blend(a[1] - a[0], b[1] - b[0], shank)
        length = np.linalg.norm(b[2] - b[1])
        return knee, ankle, ankle + length * blend(a[2] - a[1], b[2] - b[1], foot)


def _wide(x: np.ndarray, tau: np.ndarray) -> np.ndarray:
    return np.broadcast_to(x, (len(tau), 3)).copy()


def _up(height: np.ndarray) -> np.ndarray:
    return height[:, None] * UP


def _spin(rotvec: np.ndarray, yaw: np.ndarray, v: np.ndarray) -> np.ndarray:
    return _turn(yaw, rotate(rotvec, v))


def _joint(body: np.ndarray, yaw: np.ndarray, name: str) -> np.ndarray:
    """(T, 3) position of a hip or shoulder in the world."""
    k = 0 if name.endswith("Hip") else 6
    centred = body.copy()
    centred[:, 0:3] = centred[:, 6:9] = 0.0
    return body[:, k : k + 3] + _turn(yaw, joint_of(centred, name))


def _hanging(body: np.ndarray, yaw: np.ndarray, s: str) -> np.ndarray:
    """(T, 3) from the shoulder to the wrist of an arm that holds nothing.

    It swings back as the chest leans forward, past the edge of the table.
    """
    return _spin(0.6 * body[:, 9:12], yaw, np.array([0.05, SIGN[s] * 0.05, -0.54]))


def _palm(s: str, yaw: float) -> np.ndarray:
    """Where a hand that lies on a support points, knuckles lower than the wrist."""
    flat = unit(np.array([1.0, -SIGN[s] * 0.35, 0.0]))
    return _turn(yaw, unit(flat - [0.0, 0.0, (WRIST - 0.02) / 0.084]))


def _legged(
    hold: _Hold, hip: np.ndarray, pitch: np.ndarray, pole: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Knee, ankle and toe (T, 3) of a leg that holds on."""
    n = (len(hip), 3)
    if hold.kind == "foot":
        ankle = toe_pivot(hold.b, hold.a, pitch)
        knee = bend(hip, ankle, THIGH, SHANK, pole)
        return knee, ankle, np.broadcast_to(hold.b, n).copy()
    ankle = hold.a + SHANK * hold.b
    foot = unit(hold.b * [1.0, 1.0, 0.0] - [0.0, 0.0, 0.22])
    toe = ankle + np.linalg.norm([FOOT, 0.02, ANKLE - TOE]) * foot
    knee, ankle, toe = (np.broadcast_to(x, n).copy() for x in (hold.a, ankle, toe))
    return knee, ankle, toe


def _contact(
    part: str, hold: _Hold, t0: float, t1: float, height: float
) -> ContactInterval:
    """A true contact."""
    kind = part[1:]
    p = hold.b if kind == "Elbow" else hold.a
    heading = {
        "Hand": _palm(part[0], hold.yaw),
        "Elbow": hold.a - hold.b,
        "Foot": hold.b - hold.a,
        "Knee": -hold.b,
    }[kind]
    return touched(part, p, heading, t0, t1, height)
