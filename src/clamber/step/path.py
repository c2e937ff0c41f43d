"""Transition -> collision-free path: control points and the postures at them.

The moving surface follows an arc (4.29). At each control point the posture is solved
from the one before, balanced on the contacts that stay; a control point nearer to
anything than `p_safe`, itself or through the links below it, is pushed along the normal
until it keeps that distance (4.30): in the QP the arc is a soft target and every
distance a constraint, so the push is the constraint's doing.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from clamber.contact.contact import Contact
from clamber.errors import Status
from clamber.model.kinematics import Kinematics
from clamber.model.records import short_repr
from clamber.model.scene import Support
from clamber.model.world import World
from clamber.step.ik import IK, PostureProblem
from clamber.step.stability import contact_drift, is_stable, limiting_joint
from clamber.step.tasks import reaching
from clamber.step.transition import CLEARANCE, Transition, balance_problem

SAFE_HEIGHT = 0.05  # [m] h_safe of (4.29)
TOP_RISE = 0.05  # [m] both ends on top: the apex is this and h_safe above them
ARC_POINTS = 12  # control points of an arc, its ends included; at least five
BRIDGE_POINTS = 3  # between shift, touch and keyframe, where nothing moves far; at most
BRIDGE_STEP = 0.1  # [rad, m] of the way from one to the next
ARC_WEIGHT = 40.0  # of the arc, against posture 0.3 and constraints
LOOSE_ARC_WEIGHT = 1.0  # ... where a gap is halved, against posture 1
NODE_ITERATIONS = 25
NODE_STEP = 0.01  # [rad] a shorter last step leaves nothing of first order to mend
BRIDGE_MARGIN = 0.01  # [m] of the centre of mass between two balanced postures
DRIFT_TOL = 0.002  # [m] contacts that drift by more between two postures refine them
DRIFT_LIMIT = 0.01  # [m] at most, anywhere on the path
OVERLAP_TOL = 0.001  # [m] links that enter another by more refine the path
OVERLAP_LIMIT = 0.004  # [m] at most, anywhere on the path
MAX_REFINEMENTS = 4  # halvings between two postures
ENDS = 5.0  # a swing's first and last fifth: supports of what moves may be touched


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

    __repr__ = short_repr


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Path:
    """The phases of one transition; end points equal its postures."""

    transition: Transition
    phases: tuple[Phase, ...]
    status: Status
    note: str = ""

    __repr__ = short_repr


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


def highest(support: Support, p1: np.ndarray, p2: np.ndarray) -> float:
    """Height of a support's highest point below the way from `p1` to `p2` (3,) [m].

    That of its origin where the way passes it by, or it is level.
    """
    n = support.normal
    if n[2] >= 1.0:
        return float(support.position[2])
    way = p1 + np.linspace(0.0, 1.0, 4 * ARC_POINTS)[:, None] * (p2 - p1)
    way[:, 2] -= support.height(way) / n[2]
    over = way[support.inside(way), 2]
    return float(over.max(initial=-np.inf)) if len(over) else float(support.position[2])


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
    swing, control = _swing(ik, t, adapt)
    closed, loaded = (*t.held, *t.rolling), t.stance
    made = t.held if t.step.makes is None else (*t.held, t.step.makes)
    postures = (
        bridge(ik, t.before, t.shifted, closed, loaded),
        swing,
        bridge(ik, t.touching, t.after, made, made),
    )
    phases = contact_phases(
        t.stance, t.held, t.rolling, t.step.makes, postures, control
    )
    status, note = check_phases(ik, phases, t)
    return Path(transition=t, phases=phases, status=status, note=note)


def contact_phases(
    stance: tuple[Contact, ...],
    held: tuple[Contact, ...],
    rolling: tuple[Contact, ...],
    made: Contact | None,
    postures: Sequence[np.ndarray],
    arc: np.ndarray,
) -> tuple[Phase, Phase, Phase]:
    """The phases that change one contact: shift, swing and settle.

    Args:
        stance: Contacts before it.
        held: Those that stay; a foot that goes on tiptoe is on its edge here.
        rolling: Those that are broken, as they are let go.
        made: The new contact, if any.
        postures: (n, nq) of each phase.
        arc: (m, 3) control points of the swing.
    """
    after = held if made is None else (*held, made)
    shift, swing, settle = postures
    return (
        Phase(
            kind="shift",
            q=shift,
            contacts=(*held, *rolling),
            load_before=stance,
            load_after=held,
        ),
        Phase(
            kind="swing",
            q=swing,
            contacts=held,
            load_before=held,
            load_after=held,
            arc=arc,
        ),
        Phase(
            kind="settle",
            q=settle,
            contacts=after,
            load_before=held,
            load_after=after,
        ),
    )


def interpolate(kin: Kinematics, a: np.ndarray, b: np.ndarray, s: float) -> np.ndarray:
    """(nq,) at share `s` of the geodesic from `a` to `b`."""
    return kin.integrate(a, s * kin.difference(a, b))


def bridge(
    ik: IK,
    a: np.ndarray,
    b: np.ndarray,
    contacts: tuple[Contact, ...],
    loaded: tuple[Contact, ...],
) -> np.ndarray:
    """Postures from `a` to `b` with all contacts closed, near the straight way."""
    bearing = {c.surface for c in loaded}

    def node(share: float, last: np.ndarray, between: bool) -> np.ndarray:
        q = last if between else interpolate(ik.kin, a, b, share)
        problem = balance_problem(
            ik.world,
            held=tuple(c for c in contacts if c.surface in bearing),
            unloaded=tuple(c for c in contacts if c.surface not in bearing),
            q_reference=q,
            posture_weight=1.0,
        )
        problem = replace(
            problem, ellipse_weight=0.0, com_weight=0.0, balance_margin=BRIDGE_MARGIN
        )
        return _solve_node(ik, problem, q, last)

    way = float(np.abs(ik.kin.difference(a, b)).max())
    points = min(int(way / BRIDGE_STEP), BRIDGE_POINTS)
    return _fill(ik, a, b, points + 2, node, contacts, ())


def _swing(ik: IK, t: Transition, adapt: bool) -> tuple[np.ndarray, np.ndarray]:
    """Postures from the shifted to the touching one, the surface along its arc."""
    world, kin = ik.world, ik.kin
    made = t.step.makes
    if made is None:
        return bridge(ik, t.shifted, t.touching, t.held, t.held), np.zeros((0, 3))
    kin.update(t.shifted)
    support = world.supports[made.support]
    p1 = kin.contact_point(made.surface, support.normal)
    slides = any(
        c.surface == made.surface and c.support == made.support for c in t.leaving
    )
    top = highest(support, p1, made.position)
    control = arc(p1, made.position, top, slides, ARC_POINTS)
    shares = np.linspace(0.0, 1.0, len(control))

    def node(share: float, last: np.ndarray, between: bool) -> np.ndarray:
        at = np.array([np.interp(share, shares, x) for x in control.T])
        weight = LOOSE_ARC_WEIGHT if between else ARC_WEIGHT
        reference = last if between else interpolate(kin, t.shifted, t.touching, share)
        problem = balance_problem(
            world,
            held=t.held,
            q_reference=reference,
            extra=(reaching(world, made, at, weight=weight),),
            posture_weight=1.0 if between else 0.3,
            margin=t.margin if made else BRIDGE_MARGIN,
        )
        if not adapt:
            nothing = np.full(len(world.pairs), -np.inf)
            free = replace(problem, clearance=nothing)
            return ik.solve(free, last, iterations=NODE_ITERATIONS).q
        clearance = _swing_clearance(ik, problem.clearance, t, share)
        problem = replace(problem, clearance=clearance)
        return _solve_node(ik, problem, last, reference)

    moving = (*t.leaving, made)
    n = len(control)
    q = _fill(ik, t.shifted, t.touching, n, node, t.held, moving, refine=adapt)
    return q, control


def _swing_clearance(
    ik: IK, clearance: np.ndarray, t: Transition, s: float
) -> np.ndarray:
    """Let clearances grow from, and shrink to, what the end postures have.

    At lift-off and touch-down the limb is as near to the supports as the end postures
    are; asking for the full distance at once would tear it off them sideways.
    """
    ramp = min(1.0, ENDS * s, ENDS * (1.0 - s))
    if ramp >= 1.0:
        return clearance
    ik.kin.update(t.shifted if s < 0.5 else t.touching)
    near = ik.kin.proximity(CLEARANCE, np.isfinite(clearance))
    floor = np.clip(near.distance, 0.0, CLEARANCE)
    out = clearance.copy()
    eased = floor * (1 - ramp) + ramp * CLEARANCE
    out[near.pairs] = np.minimum(out[near.pairs], eased)
    return out


def _solve_node(
    ik: IK, problem: PostureProblem, q: np.ndarray, other: np.ndarray
) -> np.ndarray:
    """Solve from `q`; where that stalls, the better of that and from `other`."""
    first = ik.solve(problem, q, iterations=NODE_ITERATIONS, tolerance=NODE_STEP)
    if first.status is Status.SOLVED:
        return first.q
    second = ik.solve(problem, other)
    return min((first, second), key=lambda s: s.residuals.worst).q


def _fill(
    ik: IK,
    a: np.ndarray,
    b: np.ndarray,
    points: int,
    node: Callable[[float, np.ndarray, bool], np.ndarray],
    contacts: tuple[Contact, ...],
    moving: tuple[Contact, ...],
    *,
    refine: bool = True,
) -> np.ndarray:
    """(n, nq) postures from `a` to `b`, closer together where it matters.

    A gap is halved while, in its middle, a contact has drifted or links overlap. The
    posture put there is the nearest to the middle that satisfies the constraints: where
    the limb must pause while the trunk rises, the way leaves the arc.

    Args:
        ik: Workspace.
        a: (nq,) first posture.
        b: (nq,) last posture.
        points: Number of postures to begin with, ends included.
        node: Posture at a share of the way, given the one before, or given the middle
            of a gap (True) that it should stay near.
        contacts: Closed all the way.
        moving: Contacts at either end of the way, which may touch their supports there.
        refine: Halve gaps at all.
    """
    aloft = watched_pairs(ik.world, contacts)
    low = watched_pairs(ik.world, (*contacts, *moving))
    nodes = [(0.0, a)]
    for share in np.linspace(0.0, 1.0, points)[1:-1]:
        nodes.append((float(share), node(float(share), nodes[-1][1], False)))
    nodes.append((1.0, b))
    for _ in range(MAX_REFINEMENTS if refine else 0):
        out = [nodes[0]]
        for (s0, q0), (s1, q1) in itertools.pairwise(nodes):
            middle, share = interpolate(ik.kin, q0, q1, 0.5), 0.5 * (s0 + s1)
            inner = ENDS * min(share, 1.0 - share) >= 1.0
            depth, _ = overlap(ik, middle, aloft if inner else low)
            if _drift(ik, middle, contacts) > DRIFT_TOL or depth > OVERLAP_TOL:
                out.append((share, node(share, middle, True)))
            out.append((s1, q1))
        if len(out) == len(nodes):
            break
        nodes = out
    return np.array([q for _, q in nodes])


def watched_pairs(world: World, contacts: Sequence[Contact]) -> np.ndarray:
    """(P,) bool: pairs that must not overlap; those of the contacts may."""
    out = np.ones(len(world.pairs), bool)
    for c in contacts:
        mine = np.isin(world.pairs, world.surfaces[c.surface].geoms).any(axis=1)
        support = np.isin(world.pairs, world.support_geom[c.support]).any(axis=1)
        out &= ~(mine & support)
    return out


def overlap(ik: IK, q: np.ndarray, watched: np.ndarray) -> tuple[float, int]:
    """Deepest overlap at `q` [m] among the watched pairs, and which pair; 0, -1: none.

    Leaves the kinematics at `q`.
    """
    ik.kin.update(q)
    near = ik.kin.proximity(0.0, watched)
    if len(near.distance) == 0:
        return 0.0, -1
    i = int(np.argmin(near.distance))
    return -float(near.distance[i]), int(near.pairs[i])


def _drift(ik: IK, q: np.ndarray, contacts: tuple[Contact, ...]) -> float:
    """Largest distance of a contact from its place at `q` (nq,) [m]."""
    ik.kin.update(q)
    return max((contact_drift(ik.kin, c) for c in contacts), default=0.0)


def check_phases(
    ik: IK, phases: tuple[Phase, ...], t: Transition
) -> tuple[Status, str]:
    """Overlaps and contacts at all postures and half-way between, solver aside.

    Whether the contacts hold the robot at the postures of a swing, too: those at its
    ends the transition has looked at, and while weight shifts more contacts bear.
    """
    kin, world = ik.kin, ik.world
    worst, weak, note = 0.0, "", ""
    moving = (*t.leaving, t.step.makes) if t.step.makes else t.leaving
    for phase in phases:
        watched = watched_pairs(world, (*phase.contacts, *moving))
        for a, b in itertools.pairwise(phase.q):
            for q in (interpolate(kin, a, b, 0.5), b):
                depth, pair = overlap(ik, q, watched)
                if depth > worst:
                    worst = depth
                    names = [world.model.geom(int(g)).name for g in world.pairs[pair]]
                    where = f"{1e3 * depth:.1f} mm ({phase.kind})"
                    note = f"{' and '.join(names)} overlap by {where}"
                drift = _drift(ik, q, phase.contacts)
                if drift > DRIFT_LIMIT:
                    where = f"{1e3 * drift:.0f} mm ({phase.kind})"
                    return Status.UNREACHABLE, f"a contact opens by {where}"
            if phase.kind == "swing" and not weak:
                if not is_stable(kin, b, phase.load_after):
                    weak = limiting_joint(kin, b, phase.load_after)
    if worst > OVERLAP_LIMIT:
        return Status.COLLIDING, note
    return (Status.OVERLOADED, weak) if weak else (Status.SOLVED, note)
