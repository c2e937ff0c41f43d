"""Paths -> one timed trajectory, 1 kHz, velocity the exact derivative.

Each phase is a cubic spline through its postures, at rest at both ends, parametrised by
the largest joint angle travelled; time runs along it under a velocity profile that
accelerates, cruises at the speed limit and brakes (`samples`). The base's rotation is
the normalised spline of its quaternion, so that the angular velocity is its derivative
on the manifold.

Feed-forward torques balance gravity with the contact forces of least norm at every
posture, those of leaving contacts ever dearer, and are interpolated along the spline.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.interpolate import CubicSpline

from clamber.contact.contact import Contact
from clamber.model.kinematics import Kinematics
from clamber.model.records import short_repr
from clamber.model.se3 import quat_conjugate, quat_multiply
from clamber.model.world import World
from clamber.planning.samples import (
    ACCELERATION,
    RATE,
    Run,
    Samples,
    Spline,
    profile,
    profile_samples,
    sampled,
    spline_through,
)
from clamber.planning.timing import GRID, demand_at, least_torques, retime
from clamber.step.change import Change
from clamber.step.path import Phase
from clamber.step.polygon import com_margins, support_polygon
from clamber.step.stability import contact_points
from clamber.step.statics import GRAVITY
from clamber.step.tasks import packed_contacts

REST = 0.10  # [s] at rest between two phases
TOUCH_REST, MIN_REST = 0.08, 0.02  # [s] ... of a fast motion: after a touch, elsewhere
HOLD_START = 0.3  # [s]
HOLD_END = 2.0  # [s] the last posture is held
BASE_LENGTH = 0.3  # [m] of base translation count as one radian
INERTIA_SHARE = 0.6  # of the balance margin that inertia may use up
BALANCE_SAMPLES = 24  # of the centre of mass along a phase
BALANCE_STRIDE = 20  # samples of the profile between two looks at the balance
SLOWING, MAX_SLOWINGS = 0.85, 16  # factor of one reduction of speed, and how many
LEAST_SHARE = 1e-3  # of its load: a contact that has less bears none
TORQUE_STRIDE = 20  # samples of a fast motion between two looks at its torques
SAMPLES = 24  # per gap between two postures, to find the largest speed


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Segment:
    """A stretch of a trajectory while the same contacts are closed.

    Attributes:
        kind: `hold` of the first or last posture, or that of a phase.
        change: Which contact change it is part of, counted from 0; None before the
            first of them, and where a posture is held.
        begin, end: Its first sample, and the first one after it.
        makes: The contact that is closed from `end` on, if any.
    """

    kind: str
    change: int | None
    begin: int
    end: int
    makes: Contact | None = None

    __repr__ = short_repr


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Trajectory:
    """A timed reference.

    Attributes:
        time: (T,) [s]; q: (T, nq); v: (T, nv) the derivative of q on the manifold.
        tau: (T, na) feed-forward joint torques [N m]. As planned, these three are
            sampled when they are asked for.
        contact: (T, nS) bool, closed contacts.
        surfaces, joints: (nS,), (na,) names.
        keyframes: (K,) time at which each keyframe is reached [s].
        segments: What the samples are part of, in order; empty where nobody knows.
    """

    time: np.ndarray
    q: np.ndarray | Samples
    v: np.ndarray | Samples
    tau: np.ndarray | Samples
    contact: np.ndarray
    surfaces: tuple[str, ...]
    joints: tuple[str, ...]
    keyframes: np.ndarray
    segments: tuple[Segment, ...] = ()

    __repr__ = short_repr

    def __post_init__(self) -> None:
        """Check shapes, make arrays read-only."""
        n = len(self.time)
        for name in ("q", "v", "tau", "contact"):
            x = getattr(self, name)
            if len(x) != n:
                raise ValueError(f"{name} has {len(x)} rows, expected {n}")
            if isinstance(x, np.ndarray):
                x.setflags(write=False)

    def at(self, t: float) -> int:
        """Index of the sample at time `t` [s], clipped to the ends."""
        return int(np.clip(round(t * RATE), 0, len(self.time) - 1))


def phase_torques(kin: Kinematics, phase: Phase) -> np.ndarray:
    """(n, na) torques that hold each posture of a phase, load handed over along it."""
    share = _arclength(kin, phase.q)
    share = share / share[-1] if share[-1] > 0 else share
    contacts, prices = handed_over(phase, share)
    return holding_torques(kin, phase.q, contacts, prices)


def handed_over(
    phase: Phase, share: np.ndarray
) -> tuple[tuple[Contact, ...], np.ndarray]:
    """Contacts (k of them) that may bear, and prices of force (n, k), at shares (n,).

    The price of a contact that only bears at the start is 1 / (1 - share), of one that
    only bears at the end 1 / share, of others 1, and 0 where it does not bear: load
    passes from the ones to the others, but only as far as the robot's balance allows.
    While the centre of mass is not yet over the contacts that stay, those that leave go
    on bearing.
    """
    before = {(c.surface, c.edge): c for c in phase.load_before}
    after = {(c.surface, c.edge): c for c in phase.load_after}
    both = {**before, **after}
    left = np.ones((len(share), len(both)))
    for k, key in enumerate(both):
        left[:, k] -= share * (key not in after) + (1.0 - share) * (key not in before)
    bears = left > LEAST_SHARE
    return tuple(both.values()), np.divide(1.0, left, where=bears, out=0.0 * left)


def holding_torques(
    kin: Kinematics,
    q: np.ndarray,
    contacts: Sequence[Contact],
    prices: np.ndarray | None = None,
) -> np.ndarray:
    """(n, na) joint torques that balance gravity with the least contact forces.

    Where these ask more of a joint than its `holding_limits`, those that do not:
    a weak wrist leaves the load to the feet.

    Args:
        kin: Workspace.
        q: (n, nq).
        contacts: k that may bear.
        prices: (n, k) of the force of each, 0 where it does not bear; None: 1 each.
    """
    if prices is None:
        prices = np.ones((len(q), len(contacts)))
    return kin.core.holding_torques(*packed_contacts(kin.world, contacts), prices, q)


def holding_torque(
    kin: Kinematics, q: np.ndarray, contacts: Sequence[Contact]
) -> np.ndarray:
    """(na,) `holding_torques` of one posture (nq,)."""
    return holding_torques(kin, q[None], contacts)[0]


def point_prices(
    kin: Kinematics, contacts: Sequence[Contact], price: np.ndarray
) -> np.ndarray:
    """(nc,) the price of each bearing point, from those of the contacts (n,)."""
    up = [kin.world.supports[c.support].normal for c in contacts]
    count = [
        len(kin.bearing_points(c.surface, n, c.edge))
        for c, n in zip(contacts, up, strict=True)
    ]
    return np.repeat(price, count)


def _arclength(kin: Kinematics, nodes: np.ndarray) -> np.ndarray:
    """(n,) path parameter: the largest joint angle travelled, base included, scaled."""
    ways = np.abs(kin.core.differences(nodes))
    ways[:, :3] /= BASE_LENGTH
    return np.cumsum([0.0, *np.maximum(ways.max(axis=1), 1e-6)])


def _spline(kin: Kinematics, phase: Phase, speed: float) -> Spline:
    nodes = phase.q.copy()
    for k in range(1, len(nodes)):
        if nodes[k, 3:7] @ nodes[k - 1, 3:7] < 0:
            nodes[k, 3:7] *= -1
    s = _arclength(kin, nodes)
    spline = spline_through(s, nodes, phase_torques(kin, phase), np.inf)
    _, slope = spline.along(np.linspace(0.0, s[-1], SAMPLES * len(nodes)))
    slope = np.abs(slope)
    slope[:, :3] /= BASE_LENGTH
    cruise = float((speed / np.maximum(slope.max(axis=0), 1e-9)).min())
    if np.isfinite(cruise):
        cruise = _balanced_cruise(kin, phase, spline, cruise)
    return replace(spline, cruise=cruise)


def zero_moment_point(
    com: np.ndarray, acceleration: np.ndarray, z: float
) -> np.ndarray:
    """(n, 2) where the ground force acts if all mass were at the centre of mass.

    p = c - (c_z - z) / (g + a_z) a, over the horizontal: what the inertia of a fast
    motion adds to the projection of the centre of mass [Vukobratovic04].

    Args:
        com: (n, 3) [m].
        acceleration: (n, 3) of the centre of mass [m/s^2].
        z: Height of the contacts [m].
    """
    lever = (com[:, 2] - z) / (GRAVITY + acceleration[:, 2])
    return com[:, :2] - lever[:, None] * acceleration[:, :2]


def _balanced_cruise(
    kin: Kinematics, phase: Phase, spline: Spline, cruise: float
) -> float:
    """The cruise speed, reduced until inertia leaves the robot its balance.

    The zero-moment point may use up `INERTIA_SHARE` of the distance that the centre of
    mass has to the border of the support polygon.
    """
    length = spline.length
    fine = np.linspace(0.0, length, BALANCE_SAMPLES)
    q, _ = spline.along(fine)
    com = kin.core.centres_of_mass(q)
    kin.update(q[-1])
    points = contact_points(kin, phase.contacts).points
    polygon = support_polygon(points[:, :2])
    low = float(points[:, 2].min())
    room = np.maximum(com_margins(com[:, :2], polygon), 0.0)
    # Most motion is so slow that inertia could not use up its share however it went:
    # three times what the samples say, and the steepest rise of the speed.
    speed, bend = (np.diff(com, k, axis=0) / fine[1] ** k for k in (1, 2))
    steepest = 0.35 * np.pi * ACCELERATION * cruise
    most = 3.0 * float(
        np.linalg.norm(bend, axis=1).max() * cruise**2
        + np.linalg.norm(speed, axis=1).max() * steepest
    )
    high = float(com[:, 2].max()) - low
    if high * most <= INERTIA_SHARE * float(room.min()) * (GRAVITY - most):
        return cruise
    path = CubicSpline(fine, com)
    for _ in range(MAX_SLOWINGS):
        s, rate = profile(length, cruise, BALANCE_STRIDE)
        change = np.gradient(rate, BALANCE_STRIDE / RATE)
        acceleration = path(s, 2) * rate[:, None] ** 2 + path(s, 1) * change[:, None]
        p = zero_moment_point(path(s), acceleration, low)
        margin = com_margins(p, polygon)
        if np.all(margin >= (1.0 - INERTIA_SHARE) * np.interp(s, fine, room)):
            break
        cruise *= SLOWING
    return cruise


def _made(phases: Sequence[Phase], i: int) -> Contact | None:
    """The contact that is made at the end of a phase, if any."""
    if i + 1 == len(phases):
        return None
    before = {(c.surface, c.support) for c in phases[i].contacts}
    after = phases[i + 1].contacts
    return next((c for c in after if (c.surface, c.support) not in before), None)


def _fastest(
    kin: Kinematics, phase: Phase, spline: Spline, made: Contact | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """s, ds/dt (n,) and torques (n, na) of the fastest motion along a phase."""
    grid = np.linspace(0.0, spline.length, GRID)
    q, slope = spline.along(grid)
    s, rate = retime(
        kin, grid, q, slope, _bend(spline.curve, grid), phase.contacts, made
    )
    change = np.gradient(rate, 1.0 / RATE) if len(rate) > 1 else np.zeros(1)
    look = np.unique([*range(0, len(s), TORQUE_STRIDE), len(s) - 1])
    q, slope = spline.along(s[look])
    bend = _bend(spline.curve, s[look])
    tau = []
    every, price_of = handed_over(phase, s[look] / spline.length)
    for i, k in enumerate(look):
        bears = np.flatnonzero(price_of[i])
        contacts = tuple(every[j] for j in bears)
        demand = demand_at(kin, q[i], slope[i], bend[i], contacts)
        prices = point_prices(kin, contacts, price_of[i, bears])
        squared = float(rate[k] ** 2)
        tau.append(least_torques(kin, demand, float(change[k]), squared, prices))
    between = [np.interp(np.arange(len(s)), look, x) for x in np.transpose(tau)]
    return s, rate, np.stack(between, axis=1)


def _bend(curve: CubicSpline, s: np.ndarray) -> np.ndarray:
    """(n, nv) derivative of the tangent vector along the path."""
    raw, slope, bend = curve(s), curve(s, 1), curve(s, 2)
    norm = np.sum(raw[:, 3:7] ** 2, axis=1, keepdims=True)
    inverse = quat_conjugate(raw[:, 3:7])
    omega = 2.0 * quat_multiply(inverse, slope[:, 3:7])[:, 1:] / norm
    stretch = 2.0 * np.sum(raw[:, 3:7] * slope[:, 3:7], axis=1, keepdims=True) / norm
    turn = 2.0 * quat_multiply(inverse, bend[:, 3:7])[:, 1:] / norm - stretch * omega
    return np.concatenate([bend[:, :3], turn, bend[:, 7:]], axis=1)


def build_trajectory(
    world: World,
    phases: Sequence[Phase],
    *,
    speed: float | Literal["max"],
    keyframe_after: Sequence[int] = (0,),
) -> Trajectory:
    """Time the phases one after the other.

    Args:
        world: Robot and scene.
        phases: In order; each begins with the last posture of the one before.
        speed: Largest joint speed [rad/s]; `max`: as fast as joints and contacts bear.
        keyframe_after: How many phases end before each keyframe is reached.

    Raises:
        ValueError: Two phases do not join.
    """
    kin = Kinematics(world)
    surfaces = tuple(world.surfaces)
    runs = [_run(kin, phases, i, speed) for i in range(len(phases))]
    lengths = [x.samples for x in runs]
    stops, n = np.cumsum(lengths), sum(lengths)
    closed = [{c.surface for c in phase.contacts} for phase in phases]
    flags = np.array([[s in c for s in surfaces] for c in closed])
    ends = [0, *(stops - 1).tolist()]
    return Trajectory(
        time=np.arange(n) / RATE,
        **sampled(runs),
        contact=np.repeat(flags, lengths, axis=0),
        surfaces=surfaces,
        joints=world.joints,
        keyframes=np.array([ends[i] for i in keyframe_after]) / RATE,
        segments=_segments(phases, stops.tolist(), keyframe_after),
    )


def timed(
    world: World,
    changes: Sequence[Change],
    speed: float | Literal["max"],
    lead: Sequence[Phase] = (),
) -> Trajectory | None:
    """The trajectory of `lead`, which leads to the first keyframe, and the changes.

    Args:
        world: Robot and scene.
        changes: One after the other.
        speed: Largest joint speed [rad/s], or `max`.
        lead: Phases before the first change.

    Returns:
        None where nothing moves.
    """
    phases = [*lead, *(p for change in changes for p in change.phases)]
    if not phases:
        return None
    ends = np.cumsum([len(lead), *(len(change.phases) for change in changes)])
    return build_trajectory(world, phases, speed=speed, keyframe_after=ends.tolist())


def _segments(
    phases: Sequence[Phase], stops: Sequence[int], keyframe_after: Sequence[int]
) -> tuple[Segment, ...]:
    """The stretches of phases that end before the samples `stops`."""
    start, still = round(HOLD_START * RATE), stops[-1] - round(HOLD_END * RATE)
    out = [Segment(kind="hold", change=None, begin=0, end=start)]
    for i, phase in enumerate(phases):
        # As many keyframes as are reached before it, less the first.
        change = int(np.searchsorted(keyframe_after, i, side="right")) - 1
        out.append(
            Segment(
                kind=phase.kind,
                change=change if change >= 0 else None,
                begin=out[-1].end,
                end=min(stops[i], still),
                makes=_made(phases, i),
            )
        )
    out.append(Segment(kind="hold", change=None, begin=still, end=stops[-1]))
    return tuple(out)


def _run(
    kin: Kinematics,
    phases: Sequence[Phase],
    i: int,
    speed: float | Literal["max"],
) -> Run:
    phase = phases[i]
    if i and np.abs(kin.difference(phases[i - 1].q[-1], phase.q[0])).max() > 1e-9:
        raise ValueError(
            f"phase {i} ({phase.kind}) does not begin where the last one ended"
        )
    cruise = np.inf if speed == "max" else speed
    spline = _spline(kin, phase, cruise)
    timing = torque = None
    if speed == "max":
        made = _made(phases, i)
        s, rate, torque = _fastest(kin, phase, spline, made)
        timing, n = np.stack([s, rate]), len(s)
        rest = TOUCH_REST if made else MIN_REST
    else:
        n, rest = profile_samples(spline.length, spline.cruise), REST
    if i == len(phases) - 1:
        rest = HOLD_END
    lead = 0 if i else round(HOLD_START * RATE)
    return Run(spline, n, timing, torque, lead, round(rest * RATE))
