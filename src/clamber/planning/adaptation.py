"""A stance as it was felt -> the rest of the plan from there.

Contacts are where they are, the supports as they are believed to be. From the measured
posture the robot settles into an optimised one in the same stance, and the steps that
are left are planned by the ordinary search. Feeling for a contact that was not where it
was planned is a trajectory of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from clamber.contact.contact import Contact
from clamber.contact.scaling import retarget
from clamber.contact.steps import Step, split_moves
from clamber.errors import InputError, Status
from clamber.model.kinematics import Kinematics
from clamber.model.scene import GROUND, Scene
from clamber.model.se3 import quat_from_matrix
from clamber.model.world import World, build_world, limb_links
from clamber.planning.gait import follow_policy
from clamber.planning.planner import search_steps, timed
from clamber.planning.records import Midway, Plan, PlanOptions
from clamber.planning.trajectory import (
    HOLD_END,
    HOLD_START,
    RATE,
    Trajectory,
    build_trajectory,
)
from clamber.step import direct
from clamber.step.change import standing
from clamber.step.ik import IK, NO_WARINESS, ContactGoal, Wary, support_rotation
from clamber.step.path import ARC_WEIGHT, Path, Phase, bridge
from clamber.step.posture import Keyframe, KeyframeTask
from clamber.step.stability import contact_points
from clamber.step.statics import com_margin, support_polygon
from clamber.step.transition import balance_problem

REACH = 0.12  # [m] a contact is looked for this far from where it was planned
FEELING_SPEED = 0.06  # [m/s] along the normal
FEELING_MARGIN = (0.01, 0.045)  # [m] of the centre of mass: what there is, within this
FEELING_DEPTHS = (0.006, 0.015, 0.03, 0.045, 0.06, 0.075, 0.09, 0.105, REACH)
HORIZON = 6  # contact changes that a policy is followed ahead, before it goes on
FOLLOWED = 0.010  # [m] of the normal that a posture may fall short of its node


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Adapted:
    """The rest of a plan.

    Attributes:
        world: As it is believed to be.
        trajectory: None where there is no way, or nothing left to do.
        keyframes: The present stance first; one more for each step.
        paths: Between them.
        missed: Why steps are missing; empty where none is.
        more: A policy goes on from the last keyframe.
    """

    world: World
    trajectory: Trajectory | None
    keyframes: tuple[Keyframe, ...]
    paths: tuple[Path, ...] = ()
    missed: str
    more: bool = False


def felt_contact(kin: Kinematics, c: Contact) -> Contact:
    """The contact where its surface is in the present posture, flat or on its edge.

    On the ground, which is known, it is exactly there.
    """
    support = kin.world.supports[c.support]
    p = kin.contact_point(c.surface, support.normal, c.edge)
    s = kin.world.surfaces[c.surface]
    R = kin.rotation(s.body)
    quaternion = c.quaternion
    if s.rotation is not None:
        flat = support_rotation(support, quat_from_matrix(R @ s.rotation))
        quaternion = quat_from_matrix(flat)
    if c.support == GROUND:
        p = support.project(p)
    return replace(c, position=p, quaternion=quaternion, link=quat_from_matrix(R))


def adapt_plan(
    plan: Plan,
    scene: Scene,
    now: Midway,
    commanded: np.ndarray,
    wary: Wary = NO_WARINESS,
) -> Adapted:
    """Take a stance as it is and plan the steps that are left.

    Args:
        plan: The first one.
        scene: As it is believed to be. Where there is no way at the distance that its
            roughness asks for, that is not kept.
        now: Where the robot is.
        commanded: (nq,) reference at present; the new one begins there.
        wary: How much farther parts stay from supports, see `IK`; likewise.
    """
    found = _adapt(plan, scene, now, commanded, wary)
    if found.missed and (wary or any(b.roughness > 0 for b in scene.boxes)):
        smooth = tuple(replace(b, roughness=0.0) for b in scene.boxes)
        other = _adapt(plan, replace(scene, boxes=smooth), now, commanded, NO_WARINESS)
        return _farther(found, other)
    return found


def _farther(found: Adapted, other: Adapted) -> Adapted:
    """The other one where it gets farther, and the first misses something."""
    more = not other.missed or len(other.keyframes) > len(found.keyframes)
    return other if more else found


def _adapt(
    plan: Plan,
    scene: Scene,
    now: Midway,
    commanded: np.ndarray,
    wary: Wary,
) -> Adapted:
    ik = IK(build_world(plan.world.robot, scene), wary)
    settled = settle(ik, now, commanded, plan.options)
    if isinstance(settled, str):
        return Adapted(world=ik.world, trajectory=None, keyframes=(), missed=settled)
    return _rest(plan, ik, now.made, *settled)


def settle(
    ik: IK, now: Midway, commanded: np.ndarray, options: PlanOptions
) -> tuple[Keyframe, tuple[Phase, ...]] | str:
    """The optimised posture of a stance as it is and the way there, or why not.

    Args:
        ik: Workspace, of the world as it is believed to be.
        now: Where the robot is.
        commanded: (nq,) reference at present; the way begins there.
        options: Of the plan.
    """
    world = ik.world
    problem = balance_problem(
        world,
        held=now.loaded,
        closed=tuple(c for c in now.contacts if c not in now.loaded),
        q_reference=now.q,
        posture_weight=1.0,
        margin=0.005,
    )
    problem = replace(problem, ellipse_weight=0.0, com_weight=0.0)
    here = ik.solve_hard(problem, now.q)
    task = KeyframeTask(held=now.contacts, new=(), q_reference=here.q)
    key = direct.optimise(ik, task, here.q, options.keyframe)
    if key.status is not Status.SOLVED:
        return f"no stable posture here: {key.status.value}"
    begin = here.q.copy()
    begin[world.qadr] = commanded[world.qadr]
    lead = (
        Phase(
            kind="shift",
            q=np.array([begin, here.q]),
            contacts=now.contacts,
            load_before=now.loaded,
            load_after=now.loaded,
        ),
        Phase(
            kind="settle",
            q=bridge(ik, here.q, key.q, now.contacts, now.contacts),
            contacts=now.contacts,
            load_before=now.loaded,
            load_after=now.contacts,
        ),
    )
    return key, lead


def start_again(plan: Plan, scene: Scene) -> Adapted:
    """The whole plan anew, from where the scene says that the robot stands."""
    ik = IK(build_world(plan.world.robot, scene))
    return _rest(plan, ik, 0, standing(ik, plan.options.keyframe), ())


def go_on(plan: Plan, world: World, key: Keyframe, wary: Wary = NO_WARINESS) -> Adapted:
    """A policy followed on from the last keyframe of what was planned ahead.

    Args:
        plan: Whose policy it is.
        world: As it is believed to be.
        key: The last keyframe.
        wary: As in `adapt_plan`.
    """
    found = _rest(plan, IK(world, wary), 0, key, ())
    if found.missed and wary:
        return _farther(found, _rest(plan, IK(world), 0, key, ()))
    return found


def _rest(
    plan: Plan, ik: IK, made: int, key: Keyframe, lead: tuple[Phase, ...]
) -> Adapted:
    """The steps after the first `made`, from a keyframe that `lead` leads to.

    A policy needs no count: it is followed from the stance, some steps ahead.
    """
    world, more = ik.world, False
    if plan.policy is not None:
        found = follow_policy(ik, plan.policy, key, plan.options, HORIZON)
        missed, more = found.missed, not (found.arrived or found.missed)
    else:
        try:
            sequence = retarget(plan.sequence, world)
        except InputError as e:
            missed = str(e)
            return Adapted(
                world=world, trajectory=None, keyframes=(key,), missed=missed
            )
        steps = from_here(split_moves(sequence, world)[0][made:], key.stance, world)
        found, _ = search_steps(ik, steps, plan.options, start=key)
        missed = found.missed[0].reason if found.missed else ""
    return Adapted(
        world=world,
        trajectory=timed(world, found.paths, plan.options.speed, lead),
        keyframes=found.keyframes,
        paths=found.paths,
        missed=missed,
        more=more,
    )


def from_here(steps: list[Step], stance: Sequence[Contact], world: World) -> list[Step]:
    """The steps, where each limb leaves the surface that it is really on."""
    on = {world.robot.limb_of(c.surface).name: c.surface for c in stance}
    out = []
    for step in steps:
        surface = on.pop(step.limb, None)
        if surface is not None and step.breaks:
            step = replace(step, breaks=(surface,))
        out.append(step)
    return out


def feeling(
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
    ik.kin.update(q)
    points = contact_points(ik.kin, held).points[:, :2]
    room = com_margin(ik.kin.com[:2], support_polygon(points))
    if room <= 0:
        return None
    low, high = FEELING_MARGIN
    margins = (float(np.clip(room, low, high)), low)
    nodes, depths = _nodes_below(ik, held, contact, q, free, margins)
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
    speed = max(FEELING_SPEED * float((travel / np.diff(depths)).min()), 1e-3)
    t = build_trajectory(world, [phase], speed=speed)
    a, b = round(HOLD_START * RATE), len(t.time) - round(HOLD_END * RATE)
    cut = {n: getattr(t, n)[a:b] for n in ("q", "v", "tau", "contact")}
    # Between two postures at a joint's limit the spline passes it by a little.
    low, high = world.q_min[world.dadr], world.q_max[world.dadr]
    q, v = cut["q"].copy(), cut["v"].copy()
    inside = np.clip(q[:, world.qadr], low, high)
    v[:, world.dadr] *= inside == q[:, world.qadr]
    q[:, world.qadr] = inside
    cut |= {"q": q, "v": v}
    return replace(t, time=t.time[: b - a], segments=(), **cut)


def _nodes_below(
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
    for depth in FEELING_DEPTHS:
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
    goal = ContactGoal(
        surface=contact.surface,
        support=contact.support,
        position=wanted,
        rotation=support_rotation(support, contact.quaternion),
        hard=False,
        reference=ARC_WEIGHT,
    )
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
