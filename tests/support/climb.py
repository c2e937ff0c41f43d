"""A person climbs a box on hands, elbows and knees; the true contacts are known.

No recording of this climb is free to ship, so that the built-in one is made here. Key
poses of pelvis and chest are moved the least that lets the limbs reach what they hold
on to; between key poses they move with minimum jerk, corrected in the same way, so that
what is in contact keeps still to the last digit. Limbs follow by two-bone inverse
kinematics with constant lengths.

World: origin between the ankles, x towards the box, z up. Shapes: T samples.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from clamber.contact.contact import ContactInterval
from clamber.recording.demonstration import SIDES, Demonstration
from support.figure import (
    ANKLE,
    ELBOW,
    FOOT,
    FOREARM,
    KNEE,
    KNEE_HEIGHT,
    REACH,
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

BOX_LENGTH, BOX_WIDTH = 1.7, 0.9  # [m] across and along the climb, a table


@dataclass(frozen=True, slots=True, kw_only=True)
class ClimbOptions:
    """What the climb is like.

    Attributes:
        height_ratio: Box height over knee height; 0.55 to 1.15 look credible.
        mirrored: The right side goes first.
        speed: Twice as fast at 2.
        noise: Standard deviation of a marker's coordinates [m].
        gaps: How many short stretches of markers are missing.
        rate: [Hz].
        hand: Wrist's depth behind the near edge and distance to the side [m].
        elbow_side: Elbow's distance to the side [m]; its depth follows, since the
            forearm lies down around the hand, which stays where it is.
        knee: Knee's depth behind the edge and distance to the side [m].
    """

    height_ratio: float = 0.94
    mirrored: bool = False
    speed: float = 1.0
    noise: float = 0.002
    gaps: int = 6
    rate: float = 120.0
    hand: tuple[float, float] = (0.41, 0.06)
    elbow_side: float = 0.255
    knee: tuple[float, float] = (0.15, 0.165)

    @property
    def height(self) -> float:
        """Of the box [m]."""
        return self.height_ratio * KNEE_HEIGHT

    @property
    def edge(self) -> float:
        """Depth of the near edge [m]: knees that bend before a low box need room."""
        return 0.42 + 0.6 * max(0.0, 0.47 - self.height)


# Names of the key poses, when each is reached [s] and what has just happened.
_KEYS = (
    ("stand", 0.0),
    ("ready", 1.4),
    ("first hand", 3.2),
    ("second hand", 5.0),
    ("first lean", 6.2),
    ("first elbow", 7.0),
    ("second lean", 8.2),
    ("second elbow", 9.0),
    ("first toe-off", 10.5),
    ("first knee", 12.2),
    ("second toe-off", 13.9),
    ("second knee", 15.6),
    ("settled", 17.6),
    ("end", 21.5),
)
_KEY = {name: i for i, (name, _) in enumerate(_KEYS)}


def synthesize_climb(
    rng: np.random.Generator, *, options: ClimbOptions | None = None
) -> tuple[Demonstration, list[ContactInterval]]:
    """Make the climb and say what really was in contact.

    Args:
        rng: Drives noise, gaps and the body's sway.
        options: What the climb is like.

    Returns:
        The recording and its true contacts by start time.
    """
    o = options or ClimbOptions()
    size = np.array([BOX_WIDTH, BOX_LENGTH, o.height])
    return recorded("climb", clean_motion(rng, o), (size, o.edge), rng, o)


# Where parts rest.


@dataclass(frozen=True, slots=True)
class _Holds:
    """Joint centres (3,) while in contact; `heading` the way a hand points."""

    wrist: dict[str, np.ndarray]
    elbow: dict[str, np.ndarray]
    knee: dict[str, np.ndarray]
    ankle: dict[str, np.ndarray]
    toe: dict[str, np.ndarray]
    heading: dict[str, np.ndarray] = field(default_factory=dict)


def _holds(o: ClimbOptions) -> _Holds:
    """Contacts of both sides; the elbow lies a forearm's length from the wrist."""
    h, edge = o.height, o.edge
    across = o.elbow_side - o.hand[1]
    along = np.sqrt(FOREARM**2 - across**2 - (ELBOW - WRIST) ** 2)
    holds = _Holds({}, {}, {}, {}, {})
    for s, sign in SIGN.items():
        holds.wrist[s] = np.array([edge + o.hand[0], sign * o.hand[1], h + WRIST])
        holds.elbow[s] = np.array(
            [edge + o.hand[0] - along, sign * o.elbow_side, h + ELBOW]
        )
        holds.knee[s] = np.array([edge + o.knee[0], sign * o.knee[1], h + KNEE])
        holds.ankle[s] = np.array([0.0, sign * 0.11, ANKLE])
        holds.toe[s] = holds.ankle[s] + [FOOT, sign * 0.02, TOE - ANKLE]
        forward = holds.wrist[s] - holds.elbow[s]
        heading = np.array([forward[0] + 0.1, forward[1] * 0.6, 0.0])
        holds.heading[s] = heading / np.linalg.norm(heading)
    return holds


# The body: pelvis and chest, (3,) position and (3,) rotation vector each.


def _wanted(o: ClimbOptions, first: str) -> np.ndarray:
    """(K, 12) bodies as one would like them at the key poses.

    Depths are from the ankles, heights relative to the box as far as legs allow.
    """
    h, sign = o.height, SIGN[first]
    x = o.edge
    wrist = x + o.hand[0]
    tall = ANKLE + SHANK + THIGH
    hips = min(0.85, h + 0.38)
    # pelvis x, y, z, pitch; chest x, y, z, pitch, roll towards the first side
    rows = {
        "stand": (0.02, 0, tall - 0.004, 0.0, 0.02, 0, tall + TRUNK - 0.01, 0.0, 0),
        "ready": (0.02, 0, tall - 0.004, 0.0, 0.02, 0, tall + TRUNK - 0.01, 0.0, 0),
        "first hand": (0.12, 0, hips, 0.7, wrist - 0.24, 0, h + 0.54, 1.1, 0.12),
        "second hand": (0.14, 0, hips, 0.8, wrist - 0.21, 0, h + 0.50, 1.2, 0),
        "first elbow": (0.18, 0, hips, 0.9, wrist - 0.12, 0, h + 0.43, 1.4, 0.6),
        "second elbow": (0.21, 0, hips, 1.0, wrist - 0.10, 0, h + 0.32, 1.5, 0),
        "first toe-off": (0.19, -0.04, hips, 1.0, wrist - 0.07, 0, h + 0.32, 1.5, 0),
        "first knee": (0.29, -0.02, h + 0.37, 1.0, wrist - 0.04, 0, h + 0.31, 1.5, 0),
        "second toe-off": (0.31, 0.04, h + 0.38, 1.0, wrist - 0.03, 0, h + 0.3, 1.5, 0),
        "second knee": (0.33, 0.01, h + 0.39, 1.0, wrist - 0.01, 0, h + 0.29, 1.5, 0),
        "settled": (0.31, 0, h + 0.375, 1.0, wrist - 0.03, 0, h + 0.30, 1.45, 0),
        "end": (0.31, 0, h + 0.375, 1.0, wrist - 0.03, 0, h + 0.30, 1.45, 0),
    }
    rows["first lean"], rows["second lean"] = rows["second hand"], rows["first elbow"]
    out = np.zeros((len(_KEYS), 12))
    for name, (px, py, pz, pp, cx, cy, cz, cp, roll) in rows.items():
        late = x - 0.42 if _KEY[name] >= _KEY["first knee"] else 0.0
        out[_KEY[name]] = [
            *(px + late, sign * py, pz, 0.0, pp, 0.0),
            *(cx, sign * cy, cz, -sign * roll, cp, 0.0),
        ]
    return out


_FOOT_PITCH = {  # [rad] heels rise: (first side, second side) at the key poses
    "first elbow": (0.0, 0.0),
    "second elbow": (0.1, 0.1),
    "first toe-off": (0.65, 0.15),
    "first knee": (0.9, 0.6),
    "second toe-off": (0.9, 0.9),
}


def _held_from(
    key: int,
    o: ClimbOptions,
    first: str,
    pitch: Mapping[str, np.ndarray],
    leaving: bool,
) -> Held:
    """What is held on to from a key pose on.

    Args:
        key: Index of the key pose.
        o: What the climb is like.
        first: The side that goes first.
        pitch: (T,) of each side's foot.
        leaving: Whether a foot that lifts off at this pose counts.
    """
    holds = _holds(o)
    exact, within = [], []
    for s, order in _orders(first):
        if key >= _KEY[f"{order} elbow"]:
            exact.append((f"{s}Shoulder", holds.elbow[s], UPPER_ARM))
        elif key >= _KEY[f"{order} hand"]:
            reach = REACH * (UPPER_ARM + FOREARM)
            within.append((f"{s}Shoulder", holds.wrist[s], reach))
        off = _KEY[f"{order} toe-off"]
        if key >= _KEY[f"{order} knee"]:
            exact.append((f"{s}Hip", holds.knee[s], THIGH))
        elif key < off or (key == off and leaving):
            ankle = toe_pivot(holds.toe[s], holds.ankle[s], pitch[s])
            reach = REACH if key >= _KEY["first hand"] else 0.9995
            within.append((f"{s}Hip", ankle, reach * (THIGH + SHANK)))
    return Held(exact=tuple(exact), within=tuple(within))


def _orders(first: str) -> tuple[tuple[str, str], ...]:
    return (first, "first"), ("R" if first == "L" else "L", "second")


def clean_motion(
    rng: np.random.Generator, o: ClimbOptions
) -> tuple[Tracks, list[ContactInterval]]:
    """Exact tracks (T, 3) and true contacts; the left side goes first."""
    first = "L"
    at = np.array([when for _, when in _KEYS]) / o.speed
    t = np.arange(int(at[-1] * o.rate) + 1) / o.rate
    phase = np.clip(np.searchsorted(at, t, side="right") - 1, 0, len(at) - 2)
    tau = (t - at[phase]) / np.diff(at)[phase]

    key_pitch = {s: np.zeros(len(at)) for s in SIDES}
    tall = np.clip((o.height - 0.1) / 0.4, 0.0, 1.0)  # low boxes need no tiptoes
    for name, angles in _FOOT_PITCH.items():
        for (s, _), angle in zip(_orders(first), angles, strict=True):
            key_pitch[s][_KEY[name]] = tall * angle
    pitch = {
        s: k[phase] + (k[phase + 1] - k[phase]) * ease(tau)
        for s, k in key_pitch.items()
    }

    keys = _wanted(o, first)
    for k in range(len(at)):
        now = {s: x[k : k + 1] for s, x in key_pitch.items()}
        held = _held_from(k, o, first, now, leaving=True)
        keys[k] = settle(keys[k : k + 1], held, trunk=True)[0]
    drops = np.isin(phase + 1, [_KEY["first elbow"], _KEY["second elbow"]])
    share = np.where(drops, hit(tau), ease(tau))  # the elbow catches the chest
    body = keys[phase] + (keys[phase + 1] - keys[phase]) * share[:, None]
    body += np.sin(np.pi * tau)[:, None] ** 2 * sway(rng, t)
    for k in range(len(at) - 1):
        m = phase == k
        now = {s: x[m] for s, x in pitch.items()}
        held = _held_from(k, o, first, now, leaving=False)
        body[m] = settle(body[m], held, trunk=False)

    tracks: Tracks = {"Pelvis": body[:, 0:3]}
    up = rotate(body[:, 9:12], np.array([0.0, 0.0, 1.0]))
    tracks["Neck"] = body[:, 6:9] + 0.05 * up
    tracks["Head"] = tracks["Neck"] + 0.19 * unit(up + np.array([0.35, 0.0, 0.25]))
    clock = _Clock(t=t, at=at)
    for s, order in _orders(first):
        tracks |= _arm(s, order, clock, body, keys, _holds(o))
        tracks |= _leg(s, order, clock, body, keys, pitch[s], key_pitch[s], _holds(o))
    return tracks, _true_contacts(o, first, at, float(t[-1]))


@dataclass(frozen=True, slots=True)
class _Clock:
    """Sample times and key times, asked for by the keys' names."""

    t: np.ndarray
    at: np.ndarray

    def since(self, name: str) -> np.ndarray:
        """(T,) whether the key pose is past."""
        return self.t >= self.at[_KEY[name]] - 1e-9

    def part(self, start: str, end: str) -> np.ndarray:
        """(T,) share of the time from one key pose to another that is past."""
        a, b = self.at[_KEY[start]], self.at[_KEY[end]]
        return np.clip((self.t - a) / (b - a), 0.0, 1.0)


def _arm(
    s: str, order: str, clock: _Clock, body: np.ndarray, keys: np.ndarray, holds: _Holds
) -> Tracks:
    """Shoulder, elbow and hand: hang, reach for the box, lie down around the wrist."""
    sign = SIGN[s]
    shoulder = joint_of(body, f"{s}Shoulder")
    hand, elbow = f"{order} hand", f"{order} elbow"
    hold = holds.wrist[s]
    hang = np.array([0.05, sign * 0.05, -0.54])
    wrist = shoulder + hang
    lift = joint_of(keys[_KEY["ready"]], f"{s}Shoulder") + hang
    if order == "first":
        goes = clock.part("ready", hand)
    else:  # wait over the box until the other hand has arrived
        goes = clock.part("first hand", hand)
        wait = hold + np.array([-0.12, sign * 0.08, 0.20])
        ready = clock.part("ready", "first hand")
        path = lift + (wait - lift) * ease(ready)[:, None]
        path[:, 2] += 0.10 * np.sin(np.pi * ease(ready))
        wrist = np.where(clock.since("ready")[:, None], path, wrist)
        lift = wait
    path = lift + (hold - lift) * hit(goes)[:, None]
    path[:, 2] += 0.13 * hop(goes)
    wrist = np.where((goes > 0)[:, None], path, wrist)
    wrist = reach(shoulder, wrist, 0.995 * (UPPER_ARM + FOREARM))
    wrist[clock.since(hand)] = hold

    propped = np.array([-0.35, sign * 1.0, 1.3])
    middle = (joint_of(keys[_KEY[elbow]], f"{s}Shoulder") + hold) / 2
    pole = blend(
        np.array([-1.0, sign * 0.3, 0.0]), propped, ease(clock.part("ready", hand))
    )
    down = hit(clock.part(f"{order} lean", elbow))
    pole = blend(pole, holds.elbow[s] - middle, down)
    joint = bend(shoulder, wrist, UPPER_ARM, FOREARM, pole)
    joint[clock.since(elbow)] = holds.elbow[s]

    flat = unit(holds.heading[s] - [0.0, 0.0, (WRIST - 0.02) / 0.084])
    along = blend(unit(wrist - joint), flat, ease(1.2 * clock.part("ready", hand)))
    return {
        f"{s}Shoulder": shoulder,
        f"{s}Elbow": joint,
        f"{s}Hand": wrist,
        f"{s}Hand.knuckle": wrist + 0.084 * along,
        f"{s}Hand.tip": wrist + 0.157 * along,
    }


def _leg(
    s: str,
    order: str,
    clock: _Clock,
    body: np.ndarray,
    keys: np.ndarray,
    pitch: np.ndarray,
    key_pitch: np.ndarray,
    holds: _Holds,
) -> Tracks:
    """Hip, knee and foot: stand, roll onto the toes, swing the knee onto the box."""
    off, on = f"{order} toe-off", f"{order} knee"
    hip = joint_of(body, f"{s}Hip")
    pole = np.array([1.0, 0.4 * SIGN[s], 0.2])

    def stand(
        hips: np.ndarray, angle: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        ankle = toe_pivot(holds.toe[s], holds.ankle[s], angle)
        knee = bend(hips, ankle, THIGH, SHANK, pole)
        return knee, ankle, np.broadcast_to(holds.toe[s], ankle.shape)

    knee, ankle, toe = stand(hip, pitch)
    left = joint_of(keys[_KEY[off]][None], f"{s}Hip")
    knee0, ankle0, toe0 = stand(left, key_pitch[[_KEY[off]]])

    goes = clock.part(off, on)
    share = np.stack([hit((goes - 0.2) / 0.8)] * 2 + [hit(goes)], axis=1)
    path = knee0 + (holds.knee[s] - knee0) * share  # up before it goes forward
    path[:, 1] += SIGN[s] * 0.2 * hop(goes)  # around the edge, rather than over it
    path[:, 2] += 0.28 * hop(goes)
    swing = hip + THIGH * unit(path - hip)
    swing[clock.since(on)] = holds.knee[s]
    lying = np.array([-1.0, 0.0, -0.12])
    swing_ankle = swing + SHANK * blend(ankle0 - knee0, lying, kick(goes))
    length = np.linalg.norm(holds.toe[s] - holds.ankle[s])
    hanging = np.array([-0.45, 0.0, -0.9])
    swing_toe = swing_ankle + length * blend(toe0 - ankle0, hanging, ease(goes))
    past = clock.since(off)[:, None]
    return {
        f"{s}Hip": hip,
        f"{s}Knee": np.where(past, swing, knee),
        f"{s}Foot": np.where(past, swing_ankle, ankle),
        f"{s}Foot.toe": np.where(past, swing_toe, toe),
    }


def _true_contacts(
    o: ClimbOptions, first: str, at: np.ndarray, end: float
) -> list[ContactInterval]:
    """What is in contact by construction."""
    holds, out = _holds(o), []
    for s, order in _orders(first):
        steps = ("hand", "elbow", "toe-off", "knee")
        hand, elbow, off, knee = (at[_KEY[f"{order} {k}"]] for k in steps)
        sole, forearm = holds.toe[s] - holds.ankle[s], holds.wrist[s] - holds.elbow[s]
        shank = np.array([1.0, 0.0, 0.0])
        out += [
            touched(s + "Foot", holds.ankle[s], sole, 0.0, off, o.height),
            touched(s + "Hand", holds.wrist[s], holds.heading[s], hand, end, o.height),
            touched(s + "Elbow", holds.elbow[s], forearm, elbow, end, o.height),
            touched(s + "Knee", holds.knee[s], shank, knee, end, o.height),
        ]
    return out
