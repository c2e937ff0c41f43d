"""A contact that was not where it was planned: probing for it, a guarded move."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from clamber.contact.contact import Contact
from clamber.errors import Status
from clamber.model.world import World, limb_links
from clamber.planning.trajectory import Trajectory, build_trajectory
from clamber.step.ik import IK
from clamber.step.path import Phase
from clamber.step.polygon import com_margin, support_polygon
from clamber.step.stability import statics_at
from clamber.step.tasks import reaching
from clamber.step.transition import balance_problem

REACH = 0.12  # [m] a contact is probed for this far from where it was planned
PROBE_SPEED = 0.06  # [m/s] along the normal
PROBE_MARGIN = (0.01, 0.045)  # [m] of the centre of mass: what there is, within this
WAY_WEIGHT = 40.0  # of the way along the normal, against posture 0.3
DEPTHS = (0.006, 0.015, 0.03, 0.045, 0.06, 0.075, 0.09, 0.105, REACH)
FOLLOWED = 0.010  # [m] of the normal that a posture may fall short of its node


def guarded_move(
    world: World, held: tuple[Contact, ...], contact: Contact, q: np.ndarray
) -> Trajectory | None:
    """A reference that goes on along the normal beyond where a contact was planned.

    Args:
        world: As it is believed to be.
        held: Contacts that bear load meanwhile.
        contact: That was not there.
        q: (nq,) reference to begin from.

    Returns:
        As far as can be reached, at most `REACH`; None where that is nowhere, or the
        others do not balance the robot alone.
    """
    ik = IK(world)
    free = _limb_over(world, contact)
    points, load, _ = statics_at(ik.kin, q, held)
    room = com_margin(load.com[:2], support_polygon(points.points[:, :2]))
    if room <= 0:
        return None
    low, high = (m * world.length_scale for m in PROBE_MARGIN)
    margins = (float(np.clip(room, low, high)), low)
    nodes, depths = nodes_below(ik, held, contact, q, free, margins)
    if len(nodes) == 1:
        return None
    phase = Phase(
        kind="swing",
        q=np.array(nodes),
        contacts=held,
        load_before=held,
        load_after=held,
    )
    # No part of the way is faster than it should be, however far its nodes are apart.
    travel = np.abs(np.diff(phase.q[:, world.qadr], axis=0)).max(axis=1)
    speed = max(PROBE_SPEED * float((travel / np.diff(depths)).min()), 1e-3)
    t = build_trajectory(ik.kin, [phase], speed=speed)
    a, b = t.segments[1].begin, t.segments[1].end  # without what is held
    cut = {n: getattr(t, n)[a:b] for n in ("q", "v", "tau", "contact")}
    # Between two postures at a joint's limit the spline passes it by a little.
    low, high = world.q_min[world.dadr], world.q_max[world.dadr]
    q, v = cut["q"].copy(), cut["v"].copy()
    inside = np.clip(q[:, world.qadr], low, high)
    v[:, world.dadr] *= inside == q[:, world.qadr]
    q[:, world.qadr] = inside
    cut |= {"q": q, "v": v}
    return replace(t, time=t.time[: b - a], segments=(), **cut)


def nodes_below(
    ik: IK,
    held: tuple[Contact, ...],
    contact: Contact,
    q: np.ndarray,
    free: np.ndarray,
    margins: tuple[float, ...],
) -> tuple[list[np.ndarray], list[float]]:
    """Postures from `q` on, and how deep the contact is in each, as far as it goes.

    The centre of mass keeps the first of `margins`: the robot must not lean after the
    contact. Where a depth is not reached so, it may, to the next of them.
    """
    support = ik.world.supports[contact.support]
    # Straight down from where the limb is: a round surface has rolled since its plan.
    ik.kin.update(q)
    p = ik.kin.contact_point(contact.surface, support.normal)
    top = p - support.normal * float((p - contact.position) @ support.normal)
    nodes, depths = [q], [0.0]
    for depth in DEPTHS:
        node = None
        while node is None and margins:
            wanted = top - depth * support.normal
            node = _node_below(ik, held, contact, wanted, nodes[-1], free, margins[0])
            if node is None or node[1] > min(FOLLOWED, 0.5 * depth):
                node, margins = None, margins[1:]
        if node is None:
            break
        nodes.append(node[0])
        depths.append(depth)
    return nodes, depths


def _node_below(
    ik: IK,
    held: tuple[Contact, ...],
    contact: Contact,
    wanted: np.ndarray,
    q: np.ndarray,
    free: np.ndarray,
    margin: float,
) -> tuple[np.ndarray, float] | None:
    """The posture near `q` with a contact at `wanted` (3,), and how far it is short."""
    world = ik.world
    support = world.supports[contact.support]
    goal = reaching(world, contact, wanted, weight=WAY_WEIGHT)
    problem = balance_problem(
        world,
        held=held,
        q_reference=q,
        extra=(goal,),
        touching={contact.surface: contact.support},
        posture_weight=0.3,
        margin=margin,
    )
    problem = replace(
        problem,
        ellipse_weight=0.0,
        com_weight=0.0,
        clearance=np.where(free, -np.inf, problem.clearance),
    )
    solution = ik.solve(problem, q, iterations=25)
    if solution.status is not Status.SOLVED:
        return None
    ik.kin.update(solution.q)
    p = ik.kin.contact_point(contact.surface, support.normal)
    return solution.q, float((p - wanted) @ support.normal)


def _limb_over(world: World, contact: Contact) -> np.ndarray:
    """(P,) bool: pairs of a contact's limb with its support, believed to be lower.

    The other limbs stay where the support was found to be.
    """
    links = list(limb_links(world, contact.surface))
    mine = np.isin(world.model.geom_bodyid[world.pairs], links).any(axis=1)
    return mine & (world.pairs == world.support_geom[contact.support]).any(axis=1)
