"""Transition -> collision-free path: control points and the postures at them.

The moving surface follows an arc (4.29). At each control point the posture is solved
from the one before, balanced on the contacts that stay; a control point nearer to
anything than `p_safe`, itself or through the links below it, is pushed along the normal
until it keeps that distance (4.30): in the QP the arc is a soft target and every
distance a constraint, so the push is the constraint's doing.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from clamber.contact import Contact
from clamber.errors import Status
from clamber.model import Kinematics, World
from clamber.posture.ik import IK, ContactGoal, PostureProblem, support_rotation
from clamber.posture.keyframe import contact_drift
from clamber.transition import CLEARANCE, Transition, balance_problem

SAFE_HEIGHT = 0.05  # [m] h_safe of (4.29)
TOP_RISE = 0.05  # [m] both ends on top: the apex is this and h_safe above them
ARC_POINTS = 12  # control points of an arc, its ends included; at least five
BRIDGE_POINTS = 3  # between shift, touch and keyframe, where nothing moves far
ARC_WEIGHT = 40.0  # of the arc, against posture 0.08 and constraints
NODE_ITERATIONS = 25
DRIFT_TOL = 0.004  # [m] contacts may drift by this between two postures
MAX_REFINEMENTS = 3  # halvings between two postures


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Phase:
    """Postures in order while the same contacts are closed.

    Attributes:
        kind: shift (the weight), swing (the limb) or settle (load on the new contact).
        q: (n, nq) postures; the first is the last of the phase before.
        contacts: Contacts closed.
        load_before, load_after: Contacts that bear load at its start and end.
        arc: (m, 3) control points of the moving surface before adaptation; empty where
            nothing moves.
    """

    kind: str
    q: np.ndarray
    contacts: tuple[Contact, ...]
    load_before: tuple[Contact, ...]
    load_after: tuple[Contact, ...]
    arc: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Path:
    """The phases of one transition; end points equal its postures."""

    transition: Transition
    phases: tuple[Phase, ...]
    status: Status
    note: str = ""


def arc(
    p1: np.ndarray, p2: np.ndarray, top: float, on_top: bool, points: int
) -> np.ndarray:
    """Control points (points, 3) of the arc from `p1` to `p2` (4.29).

    The apex is at `max(z_mid + ||p1 - p2|| / 2, h_obs + h_safe)` above the ground;
    where both ends are already on top it is capped to `z + 0.05 + h_safe`. The arc is
    the parabola in height through both ends and the apex, its horizontal part straight.

    Args:
        p1: (3,) present contact point.
        p2: (3,) goal contact point.
        top: Height of the highest support that the move starts or ends on [m].
        on_top: Both ends lie on obstacles.
        points: At least five.
    """
    apex = max(
        0.5 * (p1[2] + p2[2]) + 0.5 * float(np.linalg.norm(p1 - p2)), top + SAFE_HEIGHT
    )
    if on_top:
        apex = min(apex, max(p1[2], p2[2]) + TOP_RISE + SAFE_HEIGHT)
    s = np.linspace(0.0, 1.0, max(points, 5))
    out = p1 + s[:, None] * (p2 - p1)
    # Parabola with the given maximum: z = z1 (1-s) + z2 s + 4 c s (1-s).
    c = _bulge(p1[2], p2[2], apex)
    out[:, 2] += 4.0 * c * s * (1.0 - s)
    return out


def _bulge(z1: float, z2: float, apex: float) -> float:
    """Coefficient c of the parabola that peaks at `apex`; 0 where an end is higher."""
    a, b = apex - z1, apex - z2
    if a <= 0 or b <= 0:
        return 0.0
    return 0.25 * (np.sqrt(a) + np.sqrt(b)) ** 2


def plan_path(ik: IK, transition: Transition, *, adapt: bool = True) -> Path:
    """Postures along the whole transition.

    Args:
        ik: Workspace.
        transition: Its four postures.
        adapt: Push control points away from collisions (4.30); without it the arc is
            taken as it is, for comparison.
    """
    t = transition
    names = tuple(c.surface for c in t.held)
    before = (*t.held, *t.leaving)
    after = names + ((t.move.makes.surface,) if t.move.makes else ())
    closed = (*t.held, *t.rolling)
    shift = _bridge(ik, t.before, t.shifted, closed, tuple(c.surface for c in before))
    swing, control = _swing(ik, t, adapt)
    made = (*t.held, t.move.makes) if t.move.makes else t.held
    settle = _bridge(ik, t.touching, t.after, made, after)
    phases = (
        Phase(
            kind="shift",
            q=shift,
            contacts=closed,
            load_before=before,
            load_after=t.held,
        ),
        Phase(
            kind="swing",
            q=swing,
            contacts=t.held,
            load_before=t.held,
            load_after=t.held,
            arc=control,
        ),
        Phase(
            kind="settle", q=settle, contacts=made, load_before=t.held, load_after=made
        ),
    )
    status, note = check_phases(ik, phases, t)
    return Path(transition=t, phases=phases, status=status, note=note)


def interpolate(kin: Kinematics, a: np.ndarray, b: np.ndarray, s: float) -> np.ndarray:
    """(nq,) at share `s` of the geodesic from `a` to `b`."""
    return kin.integrate(a, s * kin.difference(a, b))


def _bridge_problem(
    world: World, contacts: tuple[Contact, ...], loaded: tuple[str, ...], q: np.ndarray
) -> PostureProblem:
    problem = balance_problem(
        world,
        held=tuple(c for c in contacts if c.surface in loaded),
        closed=tuple(c for c in contacts if c.surface not in loaded),
        q_reference=q,
        posture_weight=1.0,
    )
    return replace(problem, ellipse_weight=0.0, com_weight=0.0, balance_margin=0.01)


def _bridge(
    ik: IK,
    a: np.ndarray,
    b: np.ndarray,
    contacts: tuple[Contact, ...],
    loaded: tuple[str, ...],
) -> np.ndarray:
    """Postures from `a` to `b` with all contacts closed."""

    def between(q: np.ndarray) -> np.ndarray:
        return ik.solve(
            _bridge_problem(ik.world, contacts, loaded, q),
            q,
            iterations=NODE_ITERATIONS,
        ).q

    n = BRIDGE_POINTS + 1
    nodes = [a, *(between(interpolate(ik.kin, a, b, i / n)) for i in range(1, n)), b]
    return _refine(ik, nodes, contacts, between)


def _swing(ik: IK, t: Transition, adapt: bool) -> tuple[np.ndarray, np.ndarray]:
    """Postures from the shifted to the touching one, the surface along its arc."""
    world, kin = ik.world, ik.kin
    made = t.move.makes
    if made is None:
        return _free_swing(ik, t), np.zeros((0, 3))
    kin.update(t.shifted)
    support = world.supports[made.support]
    p1 = kin.contact_point(made.surface, support.normal)
    was_on_top = any(
        c.surface == made.surface and c.support == made.support for c in t.leaving
    )
    control = arc(p1, made.position, support.position[2], was_on_top, ARC_POINTS)
    rotation = support_rotation(support, made.quaternion)
    nodes = [t.shifted]
    q = t.shifted
    n = len(control) - 1
    for i in range(1, n):
        reference = interpolate(kin, t.shifted, t.touching, i / n)
        goal = ContactGoal(
            surface=made.surface,
            support=made.support,
            position=control[i],
            rotation=rotation,
            hard=False,
            reference=ARC_WEIGHT,
        )
        problem = balance_problem(
            world,
            held=t.held,
            q_reference=reference,
            extra=(goal,),
            posture_weight=0.3,
        )
        problem = replace(
            problem, clearance=_swing_clearance(ik, problem.clearance, t, i / n)
        )
        if not adapt:
            problem = replace(problem, clearance=np.full(len(world.pairs), -np.inf))
        q = ik.solve(problem, q, iterations=NODE_ITERATIONS).q
        nodes.append(q)
    nodes.append(t.touching)
    return np.array(nodes), control


def _swing_clearance(
    ik: IK, clearance: np.ndarray, t: Transition, s: float
) -> np.ndarray:
    """Let clearances grow from, and shrink to, what the end postures have.

    At lift-off and touch-down the limb is as near to the supports as the end postures
    are; asking for the full distance at once would tear it off them sideways.
    """
    out = clearance
    kin = ik.kin
    ramp = min(1.0, 5.0 * s, 5.0 * (1.0 - s))
    if ramp >= 1.0:
        return out
    kin.update(t.shifted if s < 0.5 else t.touching)
    near = kin.proximity(CLEARANCE, None)
    out = out.copy()
    floor = np.minimum(near.distance, CLEARANCE)
    finite = np.isfinite(out[near.pairs])
    k = near.pairs[finite]
    out[k] = np.minimum(
        out[k], np.maximum(floor[finite], 0.0) * (1 - ramp) + ramp * CLEARANCE
    )
    return out


def _free_swing(ik: IK, t: Transition) -> np.ndarray:
    """A contact is only broken: straight to the next posture, clear of everything."""

    def between(q: np.ndarray) -> np.ndarray:
        problem = _bridge_problem(ik.world, t.held, tuple(c.surface for c in t.held), q)
        return ik.solve(problem, q, iterations=NODE_ITERATIONS).q

    n = 5
    nodes = [t.shifted]
    nodes += [
        between(interpolate(ik.kin, t.shifted, t.touching, i / n)) for i in range(1, n)
    ]
    nodes.append(t.touching)
    return _refine(ik, nodes, t.held, between)


def _drift(ik: IK, q: np.ndarray, contacts: tuple[Contact, ...]) -> float:
    """Largest distance of a contact from where it should be at `q` [m]."""
    ik.kin.update(q)
    return max((contact_drift(ik.kin, c) for c in contacts), default=0.0)


def _refine(
    ik: IK,
    nodes: list[np.ndarray],
    contacts: tuple[Contact, ...],
    between: Callable[[np.ndarray], np.ndarray],
) -> np.ndarray:
    """Halve the gaps in whose middle a contact has drifted."""
    for _ in range(MAX_REFINEMENTS):
        out = [nodes[0]]
        for a, b in itertools.pairwise(nodes):
            mid = interpolate(ik.kin, a, b, 0.5)
            if _drift(ik, mid, contacts) > DRIFT_TOL:
                out.append(between(mid))
            out.append(b)
        if len(out) == len(nodes):
            break
        nodes = out
    return np.array(nodes)


def check_phases(
    ik: IK, phases: tuple[Phase, ...], t: Transition
) -> tuple[Status, str]:
    """Distances and contacts at all postures and half-way between, solver aside."""
    kin, world = ik.kin, ik.world
    worst, note = 0.0, ""
    moving = {s: None for s in t.move.breaks}
    if t.move.makes:
        moving[t.move.makes.surface] = None
    geoms = [g for s in moving for g in world.surfaces[s].geoms]
    for phase in phases:
        where = {c.surface: c.support for c in phase.contacts}
        skip = np.zeros(len(world.pairs), bool)
        for surface, support in where.items():
            mine = np.isin(world.pairs, world.surfaces[surface].geoms).any(axis=1)
            skip |= mine & (world.pairs == world.support_geom[support]).any(axis=1)
        skip |= np.isin(world.pairs, geoms).any(axis=1) & np.isin(
            world.pairs, list(world.support_geom.values())
        ).any(axis=1)
        for a, b in zip(phase.q, phase.q[1:], strict=False):
            for q in (interpolate(kin, a, b, 0.5), b):
                kin.update(q)
                near = kin.proximity(0.0, ~skip)
                if len(near.distance) and -near.distance.min() > worst:
                    i = int(np.argmin(near.distance))
                    worst = -float(near.distance[i])
                    pair = [
                        world.model.geom(int(g)).name
                        for g in world.pairs[near.pairs[i]]
                    ]
                    depth = f"{1e3 * worst:.1f} mm ({phase.kind})"
                    note = f"{' and '.join(pair)} overlap by {depth}"
                drift = _drift(ik, q, phase.contacts)
                if drift > 0.02:
                    return (
                        Status.UNREACHABLE,
                        f"contact open by {1e3 * drift:.0f} mm ({phase.kind})",
                    )
    return (Status.COLLIDING, note) if worst > 0.004 else (Status.SOLVED, note)
