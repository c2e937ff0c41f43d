"""Paths -> one timed trajectory, 1 kHz, velocity the exact derivative.

All phases together are one path: cubic splines through their postures, that join with
one tangent, along which no contact moves that is closed before or after. It is
parametrised by the largest joint angle travelled, and time runs along all of it at once
(`timing`): the robot rests at the start and at the end, and nowhere else. The base's
rotation is the normalised spline of its quaternion, so that the angular velocity is its
derivative on the manifold.

Feed-forward torques balance gravity and inertia with the contact forces of least norm,
those of leaving contacts ever dearer, and are interpolated along the spline.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from clamber.contact.contact import Contact
from clamber.model.kinematics import Kinematics
from clamber.model.records import short_repr
from clamber.planning.samples import (
    RATE,
    Run,
    Samples,
    Spline,
    sampled,
    spline_through,
)
from clamber.planning.timing import (
    Course,
    Speed,
    fastest,
    inertia_along,
    largest,
    sample_law,
)
from clamber.step.change import Change
from clamber.step.ik import IK
from clamber.step.path import Phase, straightened
from clamber.step.tasks import packed_contacts

HOLD_START = 0.3  # [s]
HOLD_END = 2.0  # [s] the last posture is held
LEAST_SHARE = 1e-3  # of its load: a contact that has less bears none
INTERVAL = 0.06  # [rad] of a path, at most; two of them between two postures, at least
_SHARES = np.linspace(0.0, 1.0, 5)  # of an interval, where its limits are looked at
STEEPER = 2.0  # times the slower side: a tangent there, or the spline swings over


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Segment:
    """A stretch of a trajectory while the same contacts are closed.

    Attributes:
        kind: `hold` of the first or last posture, or that of a phase.
        change: Which contact change it is part of, counted from 0; None before the
            first of them, and where a posture is held.
        begin, end: Its first sample, and the first one after it.
        makes: The contact that is closed from `end` on, if any.
        edges: Flat surfaces that are in contact with an edge: feet on tiptoe.
    """

    kind: str
    change: int | None
    begin: int
    end: int
    makes: Contact | None = None
    edges: tuple[str, ...] = ()

    __repr__ = short_repr


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Trajectory:
    """A timed reference.

    Attributes:
        time: (T,) sample times [s].
        q: (T, nq) configuration.
        v: (T, nv) its derivative, in the tangent space.
        tau: (T, na) feed-forward joint torques [N m]. Of a fresh plan, q, v and tau are
            computed when they are asked for.
        contact: (T, nS) bool, closed contacts.
        surfaces, joints: (nS,), (na,) names.
        keyframes: (K,) time at which each keyframe is reached [s].
        segments: The phases that the samples belong to, in order; empty where these
            are not known.
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
    inertia: np.ndarray | None = None,
) -> np.ndarray:
    """(n, na) joint torques that balance gravity with the least contact forces.

    Where these ask more of a joint than its `holding_limits`, those that do not:
    a weak wrist leaves the load to the feet.

    Args:
        kin: Workspace.
        q: (n, nq).
        contacts: k that may bear.
        prices: (n, k) of the force of each, 0 where it does not bear; None: 1 each.
        inertia: (n, nv) generalised forces besides gravity's; None: at rest.
    """
    if prices is None:
        prices = np.ones((len(q), len(contacts)))
    if inertia is None:
        inertia = np.zeros((0, 0))
    packed = packed_contacts(kin.world, contacts)
    return kin.core.holding_torques(*packed, prices, q, inertia)


def holding_torque(
    kin: Kinematics, q: np.ndarray, contacts: Sequence[Contact]
) -> np.ndarray:
    """(na,) `holding_torques` of one posture (nq,)."""
    return holding_torques(kin, q[None], contacts)[0]


def _path(kin: Kinematics, phases: Sequence[Phase]) -> list[Spline]:
    """The splines of phases, without torques.

    Raises:
        ValueError: Two phases do not join.
    """
    postures: list[np.ndarray] = []
    for i, phase in enumerate(phases):
        last = postures[-1][-1] if i else phase.q[0]
        if np.abs(kin.difference(last, phase.q[0])).max() > 1e-9:
            raise ValueError(
                f"phase {i} ({phase.kind}) does not begin where the last one ended"
            )
        rows = np.concatenate([last[None], phase.q])  # quaternions of one sign
        turns = np.sum(rows[1:, 3:7] * rows[:-1, 3:7], axis=1) < 0
        rows[1:][np.cumsum(turns) % 2 == 1, 3:7] *= -1
        postures.append(rows[1:])
    parameters = [_arclength(kin, q) for q in postures]
    slopes = np.zeros((len(phases) + 1, 2, phases[0].q.shape[1]))
    for i in range(1, len(phases)):
        closed = {c.surface: c for p in phases[i - 1 : i + 1] for c in p.contacts}
        slopes[i] = kin.core.tangents(
            np.concatenate([postures[i - 1][-2:], postures[i][:2]]),
            parameters[i - 1][-1] - parameters[i - 1][-2],
            parameters[i][1],
            STEEPER,
            *packed_contacts(kin.world, list(closed.values())),
        )
    unknown = np.zeros(0), np.zeros((0, 0))
    return [
        spline_through(s, q, np.stack([slopes[i, 1], slopes[i + 1, 0]]), *unknown)
        for i, (s, q) in enumerate(zip(parameters, postures, strict=True))
    ]


def _arclength(kin: Kinematics, nodes: np.ndarray) -> np.ndarray:
    """(n,) path parameter: the largest joint angle travelled, base included, scaled."""
    ways = largest(kin.core.differences(nodes))
    return np.cumsum([0.0, *np.maximum(ways, 1e-4)])


def _made(phases: Sequence[Phase], i: int) -> Contact | None:
    """The contact that is made at the end of a phase, if any."""
    if i + 1 == len(phases):
        return None
    before = {(c.surface, c.support) for c in phases[i].contacts}
    after = phases[i + 1].contacts
    return next((c for c in after if (c.surface, c.support) not in before), None)


def build_trajectory(
    kin: Kinematics,
    phases: Sequence[Phase],
    *,
    speed: Speed,
    keyframe_after: Sequence[int] = (0,),
) -> Trajectory:
    """Time the phases, all of them together.

    Args:
        kin: Workspace.
        phases: In order; each begins with the last posture of the one before.
        speed: Largest joint speed [rad/s]; `max`: as fast as joints and contacts allow.
        keyframe_after: How many phases end before each keyframe is reached.

    Raises:
        ValueError: Two phases do not join.
    """
    world = kin.world
    surfaces = tuple(world.surfaces)
    runs = _runs(kin, phases, speed)
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


def _course(
    phases: Sequence[Phase], path: Sequence[Spline], starts: np.ndarray
) -> tuple[Course, list[np.ndarray]]:
    """Phases in intervals, and the middles of each one's by its path parameter.

    Args:
        phases: In order.
        path: Their splines.
        starts: (n + 1,) path parameter of all where each begins, and of the end.
    """
    edges, middles, looked, makes = [], [], [], []
    for i, spline in enumerate(path):
        s = spline.nodes
        parts = np.maximum(np.ceil(np.diff(s) / INTERVAL), 2).astype(int)
        edge = np.interp(np.arange(parts.sum() + 1), np.cumsum([0, *parts]), s)
        middle = 0.5 * (edge[1:] + edge[:-1])
        fine = (edge[:-1, None] + np.diff(edge)[:, None] * _SHARES).ravel()
        most = [
            largest(x).reshape(-1, len(_SHARES)).max(axis=1)
            for x in spline.along(fine)[1:]
        ]
        looked.append((*spline.along(middle), *most))
        edges.append(starts[i] + edge[1:])
        middles.append(middle)
        made = _made(phases, i)
        makes += [made if m > 0.5 * spline.length else None for m in middle]
    q, slope, bend, steep, sharp = map(np.concatenate, zip(*looked, strict=True))
    course = Course(
        s=np.concatenate([[0.0], *edges]),
        q=q,
        slope=slope,
        bend=bend,
        steep=steep,
        sharp=sharp,
        stance=np.repeat(np.arange(len(phases)), [len(m) for m in middles]),
        stances=[p.contacts for p in phases],
        makes=makes,
    )
    return course, middles


def _runs(kin: Kinematics, phases: Sequence[Phase], speed: Speed) -> list[Run]:
    """The phases in time."""
    path = _path(kin, phases)
    starts = np.cumsum([0.0, *(spline.length for spline in path)])
    course, middles = _course(phases, path, starts)
    inertia = of_u, of_x = inertia_along(kin, course)
    x = fastest(kin, course, inertia, speed)
    u = np.diff(x) / (2.0 * np.diff(course.s))
    forces = u[:, None] * of_u + 0.5 * (x[1:] + x[:-1])[:, None] * of_x
    law = sample_law(course.s, x)
    # A phase has at least one sample, however short it is.
    each = np.arange(len(phases) - 1)
    cuts = np.searchsorted(law[0], starts[1:-1], side="right") - each
    timings = np.split(law, np.maximum.accumulate(np.maximum(cuts, 1)) + each, axis=1)
    taus = []
    for i, (phase, middle, spline) in enumerate(
        zip(phases, middles, path, strict=True)
    ):
        mine = course.stance == i
        contacts, prices = handed_over(phase, middle / spline.length)
        q, force = course.q[mine], forces[mine]
        taus.append(holding_torques(kin, q, contacts, prices, force))
    # Where phases join, what lies between both sides: torques have no steps.
    joints = [
        holding_torque(kin, phases[0].q[0], phases[0].load_before),
        *(0.5 * (a[-1] + b[0]) for a, b in itertools.pairwise(taus)),
        holding_torque(kin, phases[-1].q[-1], phases[-1].load_after),
    ]
    out = []
    for i, spline in enumerate(path):
        grid = np.concatenate([[0.0], middles[i], spline.nodes[-1:]])
        tau = np.stack([joints[i], *taus[i], joints[i + 1]])
        timing = timings[i].copy()
        timing[0] -= starts[i]
        lead = 0 if i else round(HOLD_START * RATE)
        rest = round(HOLD_END * RATE) if i == len(phases) - 1 else 0
        out.append(Run(replace(spline, grid=grid, tau=tau), timing, lead, rest))
    return out


def timed(
    ik: IK,
    changes: Sequence[Change],
    speed: Speed,
    lead: Sequence[Phase] = (),
) -> Trajectory | None:
    """The trajectory of `lead`, which leads to the first keyframe, and the changes.

    Args:
        ik: Workspace.
        changes: One after the other.
        speed: Largest joint speed [rad/s], or `max`.
        lead: Phases before the first change.

    Returns:
        None where nothing moves.
    """
    phases = [*lead, *(p for change in changes for p in change.phases)]
    if not phases:
        return None
    for i in range(len(lead), len(phases) - 1):
        if (phases[i].kind, phases[i + 1].kind) == ("settle", "shift"):
            both = phases[i : i + 2]
            phases[i : i + 2] = straightened(ik, *both) or both
    ends = np.cumsum([len(lead), *(len(change.phases) for change in changes)])
    return build_trajectory(ik.kin, phases, speed=speed, keyframe_after=ends.tolist())


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
                edges=tuple(c.surface for c in phase.contacts if c.edge is not None),
            )
        )
    out.append(Segment(kind="hold", change=None, begin=still, end=stops[-1]))
    return tuple(out)
