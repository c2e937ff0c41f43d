"""A stick figure whose body gives way to what its limbs hold on to.

The body is a pelvis and a chest, (12,): position (3,) and rotation vector (3,) each.
Limbs follow by two-bone inverse kinematics with constant lengths. Shapes: T samples.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from clamber.contact.contact import Contact, ContactInterval
from clamber.model.scene import GROUND, Box, Scene
from clamber.model.se3 import frame_from_normal, quat_from_matrix
from clamber.recording.demonstration import (
    Demonstration,
    RawTracks,
    build_demonstration,
)

TABLE = "table"
Tracks = dict[str, np.ndarray]

THIGH, SHANK, UPPER_ARM, FOREARM = 0.373, 0.453, 0.311, 0.254  # [m]
HIP, SHOULDER = 0.0975, 0.155  # [m] half widths
TRUNK = 0.527  # [m] from the hips' middle to the shoulders'
ANKLE, TOE = 0.08, 0.035  # [m] heights standing
FOOT = 0.15  # [m] from ankle to toe along the sole
KNEE_HEIGHT = ANKLE + SHANK
# Heights [m] of a joint's centre over what its part rests on.
WRIST, ELBOW, KNEE = 0.03, 0.05, 0.11
SWAYS = 24  # numbers that `sway` draws
REACH = 0.985  # of a limb's length: no one locks a loaded joint
SIGN = {"L": 1.0, "R": -1.0}


@dataclass(frozen=True, slots=True)
class Held:
    """What keeps the body where it is: points and the limb's length to them.

    `exact` are distances from a hip or shoulder; `within` are upper bounds.
    """

    exact: tuple[tuple[str, np.ndarray, float], ...] = ()
    within: tuple[tuple[str, np.ndarray, float], ...] = ()


_JOINTS = {
    "LHip": (0, np.array([0.0, HIP, 0.0])),
    "RHip": (0, np.array([0.0, -HIP, 0.0])),
    "LShoulder": (6, np.array([0.0, SHOULDER, 0.0])),
    "RShoulder": (6, np.array([0.0, -SHOULDER, 0.0])),
}


def rotate(rotvec: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) turned by rotation vectors (..., 3), Rodrigues' formula."""
    angle = np.linalg.norm(rotvec, axis=-1, keepdims=True)
    axis = rotvec / np.maximum(angle, 1e-12)
    v = np.broadcast_to(v, rotvec.shape)
    along = np.sum(axis * v, axis=-1, keepdims=True) * axis
    return along + np.cos(angle) * (v - along) + np.sin(angle) * np.cross(axis, v)


def joint_of(body: np.ndarray, name: str) -> np.ndarray:
    """(..., 3) position of a hip or shoulder of bodies (..., 12)."""
    k, offset = _JOINTS[name]
    return body[..., k : k + 3] + rotate(body[..., k + 3 : k + 6], offset)


def settle(wanted: np.ndarray, held: Held, *, trunk: bool) -> np.ndarray:
    """Bodies (T, 12) nearest to `wanted` that keep what is held.

    Gauss-Newton on the weighted squares of deviation, trunk length (where asked for)
    and, a thousand times heavier, distances. What satisfies them comes back unchanged.
    """
    soft = np.array([3.0] * 3 + [1.0] * 3 + [3.0] * 3 + [1.0] * 3)

    def residual(x: np.ndarray) -> np.ndarray:
        rows = [soft * (x - wanted)]
        if trunk:
            chord = np.linalg.norm(x[..., 6:9] - x[..., 0:3], axis=-1)
            bent = np.clip(chord, 0.9 * TRUNK, TRUNK)  # a rounded back is shorter
            rows.append(8.0 * (chord - bent)[..., None])
        for name, point, length in held.exact:
            rows.append(1e3 * _beyond(x, name, point, length)[..., None])
        for name, point, length in held.within:
            d = _beyond(x, name, point, length)
            rows.append(1e3 * np.maximum(d, 0.0)[..., None])
        return np.concatenate(rows, axis=-1)

    x = wanted.copy()
    step = 1e-6 * np.concatenate([np.zeros((1, 12)), np.eye(12)])[:, None, :]
    for _ in range(20):
        moved = residual(x + step)  # (13, T, rows): as it is, then moved
        r = moved[0]
        J = np.stack(list((moved[1:] - r) / 1e-6), axis=2)
        H = J.transpose(0, 2, 1) @ J
        g = np.einsum("tri,tr->ti", J, r)
        change = np.linalg.solve(H, g[:, :, None])[:, :, 0]
        x = x - change
        if np.abs(change).max() < 1e-10:
            break
    return x


def _beyond(x: np.ndarray, name: str, point: np.ndarray, length: float) -> np.ndarray:
    """How much farther than `length` a joint of bodies (..., 12) is from a point."""
    return np.linalg.norm(joint_of(x, name) - point, axis=-1) - length


def sway(rng: np.random.Generator, t: np.ndarray) -> np.ndarray:
    """(T, 12) slow unrest of a few millimetres: nobody stands like a statue."""
    out = np.zeros((len(t), 12))
    for column in (0, 1, 2, 6, 7, 8):
        for frequency in rng.uniform(0.2, 0.6, size=2):
            phase = rng.uniform(0.0, 2.0 * np.pi)
            out[:, column] += 0.002 * np.sin(2.0 * np.pi * frequency * t + phase)
    return out


def ease(tau: np.ndarray) -> np.ndarray:
    """Minimum-jerk profile from 0 to 1."""
    tau = np.clip(tau, 0.0, 1.0)
    return tau**3 * (10.0 - 15.0 * tau + 6.0 * tau**2)


def hit(tau: np.ndarray, slope: float = 1.4) -> np.ndarray:
    """From rest at 0 to 1 that still moves on arrival: the support stops it."""
    tau = np.clip(tau, 0.0, 1.0)
    return (3.0 - slope) * tau**2 + (slope - 2.0) * tau**3


def hop(tau: np.ndarray) -> np.ndarray:
    """A bump of height 1: off within a few per cent of the time, down with speed."""
    tau = np.clip(tau, 0.0, 1.0)
    return 4.0 * tau * (1.0 - tau) * (1.0 - np.exp(-tau / 0.03))


def kick(tau: np.ndarray) -> np.ndarray:
    """From 0, fast within a few per cent of the time, to rest at 1."""
    tau = np.clip(tau, 0.0, 1.0)
    return tau * (2.0 - tau) * (1.0 - np.exp(-tau / 0.03))


def unit(v: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) of length 1."""
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def blend(a: np.ndarray, b: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Unit vectors (T, 3) on the great circle from a to b."""
    a, b = np.broadcast_arrays(unit(a), unit(b))
    angle = np.arccos(np.clip(np.sum(a * b, axis=-1, keepdims=True), -1.0, 1.0))
    w = np.asarray(w)[..., None]
    wide = np.maximum(np.sin(angle), 1e-9)
    arc = (np.sin((1 - w) * angle) * a + np.sin(w * angle) * b) / wide
    return unit(np.where(angle < 1e-6, a, arc))


def bend(
    root: np.ndarray, end: np.ndarray, upper: float, lower: float, pole: np.ndarray
) -> np.ndarray:
    """Middle joint (T, 3) of a two-bone limb, bent towards `pole`."""
    line = end - root
    d = np.linalg.norm(line, axis=-1, keepdims=True)
    u = line / d
    along = (d**2 + upper**2 - lower**2) / (2.0 * d)
    out = np.sqrt(np.maximum(upper**2 - along**2, 0.0))
    side = unit(pole - u * np.sum(u * pole, axis=-1, keepdims=True))
    return root + along * u + out * side


def reach(root: np.ndarray, end: np.ndarray, length: float) -> np.ndarray:
    """The end (T, 3) drawn in to within a limb's reach."""
    line = end - root
    d = np.linalg.norm(line, axis=-1, keepdims=True)
    return root + line * np.minimum(1.0, length / d)


def toe_pivot(toe: np.ndarray, ankle: np.ndarray, pitch: np.ndarray) -> np.ndarray:
    """Ankle (T, 3) of a foot that has rolled by `pitch` (T,) about its toe."""
    back = ankle - toe
    left = np.array([-back[1], back[0], 0.0])
    left = -left / np.linalg.norm(left)
    return toe + rotate(pitch[..., None] * left, back)


def _swap(name: str) -> str:
    return {"L": "R", "R": "L"}[name[0]] + name[1:] if name[0] in "LR" else name


def mirror_tracks(tracks: Tracks) -> Tracks:
    """The same motion in a mirror that keeps the x-z plane."""
    return {_swap(n): x * [1.0, -1.0, 1.0] for n, x in tracks.items()}


def mirror_contact(i: ContactInterval) -> ContactInterval:
    """The same contact in that mirror."""
    w, x, y, z = i.contact.quaternion
    contact = replace(
        i.contact,
        surface=_swap(i.part),
        position=i.contact.position * [1.0, -1.0, 1.0],
        quaternion=np.array([w, -x, y, -z]),
    )
    return replace(i, part=_swap(i.part), contact=contact)


def touched(
    part: str, p: np.ndarray, heading: np.ndarray, t0: float, t1: float, top: float
) -> ContactInterval:
    """A true contact at the depth and side of p (3,): feet's on the ground."""
    on_ground = part.endswith("Foot")
    R = frame_from_normal(np.array([0.0, 0.0, 1.0]), heading)
    contact = Contact(
        surface=part,
        support=GROUND if on_ground else TABLE,
        position=np.array([p[0], p[1], 0.0 if on_ground else top]),
        quaternion=quat_from_matrix(R),
    )
    return ContactInterval(
        part=part, is_surface=True, t0=float(t0), t1=float(t1), contact=contact
    )


class Options(Protocol):
    """What synthetic demonstrations have in common."""

    @property
    def mirrored(self) -> bool: ...
    @property
    def noise(self) -> float: ...
    @property
    def gaps(self) -> int: ...
    @property
    def rate(self) -> float: ...


def recorded(
    kind: str,
    motion: tuple[Tracks, list[ContactInterval]],
    table: tuple[np.ndarray, float],
    rng: np.random.Generator,
    o: Options,
) -> tuple[Demonstration, list[ContactInterval]]:
    """The demonstration that cameras see of a clean motion, and its true contacts.

    Args:
        kind: What it is called.
        motion: Exact tracks and true contacts.
        table: Its size, and the depth of its near face [m].
        rng: Drives noise and gaps.
        o: How it is recorded.
    """
    tracks, truth = motion
    if o.mirrored:
        tracks, truth = mirror_tracks(tracks), [mirror_contact(i) for i in truth]
    size, face = table
    position = np.array([face + size[0] / 2, 0.0, size[2] / 2])
    box = Box(name=TABLE, size=size, centre=position, rotation=np.eye(3))
    demo = build_demonstration(
        RawTracks(
            source=f"built-in {kind}, synthetic (noise {1e3 * o.noise:g} mm)",
            synthetic=True,
            names=tuple(tracks),
            position=corrupt(tracks, rng, o.noise, o.gaps, o.rate),
            rate=o.rate,
            scene=Scene(boxes=(box,), start=np.zeros(3)),
        )
    )
    return demo, sorted(truth, key=lambda i: (i.t0, i.part))


def corrupt(
    tracks: Tracks, rng: np.random.Generator, noise: float, gaps: int, rate: float
) -> np.ndarray:
    """Tracks (T, F, 3) as cameras see them: noisy [m], with short stretches missing."""
    raw = np.stack(list(tracks.values()), axis=1)
    raw += noise * rng.standard_normal(raw.shape)
    for first, count, point in draw_gaps(rng, gaps, rate, raw.shape):
        raw[first : first + count, point] = np.nan
    return raw


def draw_gaps(
    rng: np.random.Generator, gaps: int, rate: float, shape: tuple[int, ...]
) -> list[tuple[int, int, int]]:
    """First sample, samples and point of each."""
    return [
        (
            int(rng.integers(1, shape[0] - 30)),
            int(rng.integers(4, 20) * rate / 120.0),
            int(rng.integers(shape[1])),
        )
        for _ in range(gaps)
    ]
