"""A stance as it was felt -> the rest of the plan from there.

Contacts are where they are, the supports as they are believed to be. From the measured
posture the robot settles into an optimised one in the same stance, and the steps that
are left are planned by the ordinary search. Feeling for a contact that was not where it
was planned is a trajectory of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from clamber.contact.contact import Contact
from clamber.contact.scaling import retarget
from clamber.contact.steps import Step, split_moves
from clamber.errors import InputError, Status
from clamber.model.kinematics import Kinematics
from clamber.model.scene import GROUND, Scene
from clamber.model.se3 import quat_from_matrix
from clamber.model.world import World, build_world, limb_links
from clamber.planning.planner import search_steps, timed
from clamber.planning.records import Plan, PlanOptions, State
from clamber.planning.trajectory import (
    HOLD_END,
    HOLD_START,
    RATE,
    Trajectory,
    build_trajectory,
)
from clamber.planning.traverse import follow_policy
from clamber.step.change import Failure, standing
from clamber.step.ik import IK, NO_EXTRA, ExtraClearance
from clamber.step.methods import direct
from clamber.step.path import ARC_WEIGHT, Phase, bridge
from clamber.step.posture import Keyframe, KeyframeTask
from clamber.step.stability import contact_points
from clamber.step.statics import com_margin, support_polygon
from clamber.step.tasks import reaching, support_rotation
from clamber.step.transition import balance_problem

REACH = 0.12  # [m] a contact is looked for this far from where it was planned
FEELING_SPEED = 0.06  # [m/s] along the normal
FEELING_MARGIN = (0.01, 0.045)  # [m] of the centre of mass: what there is, within this
FEELING_DEPTHS = (0.006, 0.015, 0.03, 0.045, 0.06, 0.075, 0.09, 0.105, REACH)
HORIZON = 6  # contact changes that a policy is followed ahead, before it goes on
FOLLOWED = 0.010  # [m] of the normal that a posture may fall short of its node


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
    now: State,
    commanded: np.ndarray,
    wary: ExtraClearance = NO_EXTRA,
) -> Plan:
    """Take a stance as it is and plan the steps that are left.

    Args:
        plan: The first one.
        scene: As it is believed to be. Where there is no way at the distance that its
            roughness asks for, that is not kept.
        now: Where the robot is.
        commanded: (nq,) reference at present; the new one begins there.
        wary: How much farther parts stay from supports, see `IK`; likewise.

    Returns:
        Where it ends before the last step without a failure, a policy goes on.
    """
    found = _adapt(plan, scene, now, commanded, wary)
    if found.failures and (wary or any(b.roughness > 0 for b in scene.boxes)):
        smooth = tuple(replace(b, roughness=0.0) for b in scene.boxes)
        other = _adapt(plan, replace(scene, boxes=smooth), now, commanded, NO_EXTRA)
        return _farther(found, other)
    return found


def _farther(found: Plan, other: Plan) -> Plan:
    """The other one where it gets farther, and the first misses something."""
    more = not other.failures or len(other.changes) > len(found.changes)
    return other if more else found


def _adapt(
    plan: Plan, scene: Scene, now: State, commanded: np.ndarray, wary: ExtraClearance
) -> Plan:
    ik = IK(build_world(plan.world.robot, scene), wary)
    key, lead = settle(ik, now, commanded, plan.options)
    return _rest(plan, ik, key, now, lead)


def settle(
    ik: IK, now: State, commanded: np.ndarray, options: PlanOptions
) -> tuple[Keyframe, tuple[Phase, ...]]:
    """The optimised posture of a stance as it is, and the way there.

    Where there is no such posture, its status says so, and there is no way.

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
        unloaded=tuple(c for c in now.stance if c not in now.loaded),
        q_reference=now.q,
        posture_weight=1.0,
        margin=0.005,
    )
    problem = replace(problem, ellipse_weight=0.0, com_weight=0.0)
    here = ik.solve_hard(problem, now.q)
    task = KeyframeTask(held=now.stance, new=(), q_reference=here.q)
    key = direct(ik, task, here.q, options.keyframe)
    if key.status is not Status.SOLVED:
        return key, ()
    begin = here.q.copy()
    begin[world.qadr] = commanded[world.qadr]
    lead = (
        Phase(
            kind="shift",
            q=np.array([begin, here.q]),
            contacts=now.stance,
            load_before=now.loaded,
            load_after=now.loaded,
        ),
        Phase(
            kind="settle",
            q=bridge(ik, here.q, key.q, now.stance, now.stance),
            contacts=now.stance,
            load_before=now.loaded,
            load_after=now.stance,
        ),
    )
    return key, lead


def start_again(plan: Plan, scene: Scene) -> Plan:
    """The whole plan anew, from where the scene says that the robot stands."""
    ik = IK(build_world(plan.world.robot, scene))
    return _rest(plan, ik, standing(ik, plan.options.keyframe))


def go_on(
    plan: Plan, world: World, key: Keyframe, wary: ExtraClearance = NO_EXTRA
) -> Plan:
    """A policy followed on from the last keyframe of what was planned ahead.

    Args:
        plan: Whose policy it is.
        world: As it is believed to be.
        key: The last keyframe.
        wary: As in `adapt_plan`.
    """
    found = _rest(plan, IK(world, wary), key)
    if found.failures and wary:
        return _farther(found, _rest(plan, IK(world), key))
    return found


def _rest(
    plan: Plan,
    ik: IK,
    key: Keyframe,
    now: State | None = None,
    lead: tuple[Phase, ...] = (),
) -> Plan:
    """What is left of a plan, from a keyframe that `lead` leads to.

    A policy needs no count of steps: it is followed from the stance, some ahead.
    """
    world, sequence, iterations = ik.world, plan.sequence, ()
    failure = None
    if key.status is not Status.SOLVED and now is not None:
        why = f"no stable posture here: {key.status.value}"
        failure = Failure(status=key.status, detail=why)
    elif plan.policy is None:
        try:
            sequence = retarget(plan.sequence, world)
        except InputError as e:
            failure = Failure(status=Status.UNREACHABLE, detail=str(e))
    if failure is not None:
        return Plan(
            world=world,
            options=plan.options,
            sequence=sequence,
            start=key,
            failures=(failure,),
            trajectory=None,
            complete=False,
            state=now,
            policy=plan.policy,
        )
    if plan.policy is not None:
        followed = follow_policy(ik, plan.policy, key, plan.options, HORIZON)
        found, iterations = followed.route, followed.iterations
    else:
        done = 0 if now is None else now.done
        steps = from_here(split_moves(sequence, world)[0][done:], key.stance, world)
        found, _ = search_steps(ik, key, steps, plan.options)
    return Plan(
        world=world,
        options=plan.options,
        sequence=sequence,
        start=key,
        changes=found.changes,
        failures=found.failures,
        trajectory=timed(world, found.changes, plan.options.speed, lead),
        complete=found.arrived,
        state=now,
        policy=plan.policy,
        iterations=iterations,
    )


def from_here(
    steps: Sequence[Step], stance: Sequence[Contact], world: World
) -> list[Step]:
    """The steps, where each limb leaves what it is really on.

    That may be a surface that the steps do without.
    """
    on = {world.robot.limb_of(c.surface).name: (c.surface,) for c in stance}
    out = []
    for step in steps:
        breaks = on.pop(step.limb, step.breaks)
        out.append(replace(step, breaks=breaks))
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
    goal = reaching(world, contact, wanted, weight=ARC_WEIGHT)
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
