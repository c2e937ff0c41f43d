"""Where a plan begins: the state of a robot, the posture that it settles into.

Contacts are where they are measured, the supports as they are believed to be. From the
measured posture the robot settles into an optimised one in the same stance, and what a
plan has left to do goes on from there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from clamber.contact.contact import Contact, ContactSequence, Stance
from clamber.contact.steps import Step, split_steps
from clamber.errors import InputError, Status
from clamber.model.arguments import checks_types
from clamber.model.kinematics import Kinematics
from clamber.model.scene import GROUND
from clamber.model.se3 import quat_from_matrix
from clamber.model.terrain import SceneLike
from clamber.model.world import World, build_world
from clamber.planning.records import Plan, PlanOptions, State
from clamber.step.change import standing
from clamber.step.ik import IK
from clamber.step.methods import direct
from clamber.step.path import Phase, bridge, can_be_gone
from clamber.step.posture import Keyframe, KeyframeTask, finish
from clamber.step.tasks import support_rotation
from clamber.step.transition import balance_problem

TOUCHING = 0.005  # [m] a surface that is nearer to a support is in contact
NEAR = 0.03  # [m] a contact that is named is no farther from its support


def measured_contact(kin: Kinematics, c: Contact) -> Contact:
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


def settle(
    ik: IK, now: State, options: PlanOptions
) -> tuple[Keyframe, tuple[Phase, ...]]:
    """The optimised posture of a stance as it is, and the way there.

    Where there is no such posture, its status says so, and there is no way.

    Args:
        ik: Workspace, of the world as it is believed to be.
        now: Where the robot is; the way begins in its joints.
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
    # Where it is, whatever is near: to keep a clearance it would have to move first.
    problem = replace(
        problem,
        clearance=np.minimum(problem.clearance, 0.0),
        ellipse_weight=0.0,
        com_weight=0.0,
    )
    here = ik.solve_hard(problem, now.q)
    task = KeyframeTask(held=now.stance, new=(), q_reference=here.q)
    key = direct(ik, task, here.q, options.keyframe)
    if key.status is not Status.SOLVED:
        return key, ()
    way = bridge(ik, here.q, key.q, now.stance)
    if here.status is Status.SOLVED and not can_be_gone(ik, way, now.stance):
        # The better posture lies elsewhere: what follows begins where the robot is.
        key = finish(
            ik,
            task,
            options.keyframe,
            here.q,
            method=key.method,
            iterations=here.iterations,
            cost_before=key.cost_before,
        )
        key = replace(key, status=Status.SOLVED)
        way = np.stack([here.q, here.q])
    begin = here.q.copy()
    begin[world.qadr] = now.q[world.qadr]
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
            q=way,
            contacts=now.stance,
            load_before=now.loaded,
            load_after=now.stance,
        ),
    )
    return key, lead


@checks_types
def state_of(
    plan: Plan,
    scene: SceneLike,
    q: np.ndarray,
    touching: Mapping[str, str] | None = None,
    *,
    source: object = "state",
) -> State:
    """The state of a robot, with its progress along a plan, from its posture.

    Args:
        plan: The plan that it was executing.
        scene: The scene as it is now.
        q: (nq,) posture.
        touching: Support of each surface in contact; None: surfaces within 5 mm of a
            support are. Of a limb's surfaces the one nearest to the trunk counts.
        source: Where the posture comes from, for error messages.

    Raises:
        InputError: A surface or support is unknown, or they are not in contact.
    """
    world = build_world(plan.world.robot, scene)
    kin = Kinematics(world)
    kin.update(q)
    for surface, support in (touching or {}).items():
        _check_named(kin, surface, support, source)
    contacts = []
    for limb in world.robot.limbs.values():
        for surface in reversed(limb.surfaces):
            support = _support_below(kin, surface, touching)
            if support is not None:
                R = kin.rotation(world.surfaces[surface].body)
                c = Contact(
                    surface=surface,
                    support=support,
                    position=np.zeros(3),
                    quaternion=quat_from_matrix(R),
                )
                contacts.append(measured_contact(kin, c))
                break
    if not contacts:
        raise InputError(
            "a posture with a surface on a support", source=source, field="contacts"
        )
    stance = tuple(contacts)
    steps = split_steps(plan.sequence, plan.world)[0]
    done = steps_done(plan.sequence, steps, stance, plan.world)
    return State(stance=stance, loaded=stance, q=q, done=done)


def _support_below(
    kin: Kinematics, surface: str, touching: Mapping[str, str] | None
) -> str | None:
    """The support that a surface is in contact with."""
    if touching is not None:
        return touching.get(surface)
    for name, support in kin.world.supports.items():
        p = kin.contact_point(surface, support.normal)
        if abs(support.height(p)) < TOUCHING and support.inside(p):
            return name
    return None


def _check_named(kin: Kinematics, surface: str, support: str, source: object) -> None:
    world = kin.world
    for name, known in ((surface, world.surfaces), (support, world.supports)):
        if name not in known:
            raise InputError(
                f"one of {', '.join(known)}",
                source=source,
                field=f"contacts.{surface}",
                value=name,
            )
    s = world.supports[support]
    p = kin.contact_point(surface, s.normal)
    off = float(s.height(p))
    if abs(off) > NEAR or not s.inside(p):
        where = f"{1e3 * off:.0f} mm above {support}" if s.inside(p) else "beside it"
        raise InputError(
            f"a surface on {support}: it is {where}",
            source=source,
            field=f"contacts.{surface}",
            value=support,
        )


def steps_done(
    sequence: ContactSequence,
    steps: Sequence[Step],
    stance: Sequence[Contact],
    world: World,
) -> int:
    """Number of steps of a sequence that a stance has completed.

    The number after which most limbs are on the surfaces that they are on; a step that
    makes a contact is done only if the contact is there. Of several, the one whose
    contacts lie nearest.

    Args:
        sequence: In the world of the plan.
        steps: Of the sequence.
        stance: The contacts that hold.
        world: Of the plan.
    """
    limb_of = world.robot.limb_of
    now = {limb_of(c.surface).name: c for c in stance}
    on: dict[str, Contact | None] = {
        n: sequence.stances[0].contact(x.surfaces[0]) if not x.is_arm else None
        for n, x in world.robot.limbs.items()
    }
    best, done = _alike(on, now), 0  # more limbs first, then nearer
    for k, step in enumerate(steps, start=1):
        on[step.limb] = step.makes
        if step.makes is not None and not _same(step.makes, now.get(step.limb)):
            continue
        score = _alike(on, now)
        if score > best:
            best, done = score, k
    return done


def _alike(
    on: Mapping[str, Contact | None], now: Mapping[str, Contact]
) -> tuple[int, float]:
    """Limbs on the same surface, and how near their contacts are [m], negative."""
    pairs = [(c, now.get(limb)) for limb, c in on.items()]
    same = [(a, b) for a, b in pairs if a and b and _same(a, b)]
    away = sum(float(np.linalg.norm(a.position - b.position)) for a, b in same)
    return len(same), -away


def _same(a: Contact, b: Contact | None) -> bool:
    """The same surface on the same support, wherever."""
    return b is not None and (a.surface, a.support) == (b.surface, b.support)


def from_here(
    steps: Sequence[Step], done: int, stance: Sequence[Contact], world: World
) -> list[Step]:
    """The steps that are left, where each limb leaves what it is really on.

    That may be a surface that the steps do without. Of a limb that is on another
    support than its last step led to, a foot that has slipped back to the ground, that
    step is left, too.
    """
    now = {world.robot.limb_of(c.surface).name: c for c in stance}
    led = {s.limb: s for s in steps[:done] if s.makes is not None}
    again = [
        s
        for limb, s in led.items()
        if limb in now and s.makes is not None and s.makes.support != now[limb].support
    ]
    on = {limb: (c.surface,) for limb, c in now.items()}
    return [
        replace(step, breaks=on.pop(step.limb, step.breaks))
        for step in (*again, *steps[done:])
    ]


def from_standing(
    ik: IK, sequence: ContactSequence, options: PlanOptions
) -> tuple[ContactSequence, int]:
    """A sequence from the middle with steps before it, from standing, and how many.

    As if the robot had got to the first stance one limb after the other.
    """
    limb_of = ik.world.robot.limb_of
    contacts = list(standing(ik, options.keyframe).stance)
    stances = [Stance(contacts=tuple(contacts))]
    for c in sequence.stances[0].contacts:
        limb = limb_of(c.surface)
        contacts = [x for x in contacts if limb_of(x.surface) is not limb] + [c]
        stances.append(Stance(contacts=tuple(contacts)))
    before = len(stances)
    stances += sequence.stances
    whole = replace(
        sequence, stances=tuple(stances), t=np.arange(len(stances) + 1, dtype=float)
    )
    steps = split_steps(whole, ik.world)[0]
    return whole, sum(s.stance <= before for s in steps)
