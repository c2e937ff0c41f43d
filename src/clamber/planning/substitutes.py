r"""Other contacts than the demonstrated ones [thesis 5.3, algorithm 4].

What a demonstration touches beyond its first stance, stance by stance, is

    Cd_i = C_(i+1) \ C_0.

Where a limb offers several surfaces in one of these sets, it can do with one: there is
an alternative for each combination, and a combination is kept through the whole plan.
Each is planned; those that are stable come first, by the least of

    sum over the contacts that are made of (way of the surface to it + d)

with d the projected distance (4.17) of the new contact. Where none is stable, elbows
stand in for hands (`stand_ins`): no wrist has to bear. Where that is not stable either,
contacts are searched for (`exploration`), from where the alternative that came farthest
is stuck, then from the start. The rest of a climb is planned from its middle in the
same order: as it was, with other surfaces, by the search.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from clamber.contact.contact import Contact, ContactSequence, Stance
from clamber.contact.scaling import retarget
from clamber.contact.steps import split_moves
from clamber.errors import InputError, Status
from clamber.model.kinematics import Kinematics
from clamber.model.robot import Robot
from clamber.model.scene import GROUND, Scene
from clamber.model.se3 import quat_from_matrix
from clamber.model.world import World, build_world
from clamber.planning.adaptation import adapt_plan, felt_contact, from_here, settle
from clamber.planning.free import (
    Bounds,
    Counts,
    Explored,
    action_counts,
    explore,
)
from clamber.planning.planner import plan, search_steps, timed
from clamber.planning.records import (
    Fallback,
    Plan,
    PlanOptions,
    Progress,
    Route,
    State,
    numbered,
)
from clamber.planning.search import follow_steps
from clamber.step.change import standing
from clamber.step.ik import IK
from clamber.step.path import Phase
from clamber.step.statics import projected_distance

TOUCHING = 0.005  # [m] a surface that is nearer to a support is in contact
NEAR = 0.03  # [m] a contact that is named is no farther from its support


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Alternative:
    """A sequence in which each limb keeps to one of its surfaces.

    Attributes:
        surfaces: Those chosen, of the limbs that offer several.
        sequence: Without the others.
    """

    surfaces: tuple[str, ...]
    sequence: ContactSequence


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Ranked:
    """A planned alternative.

    Attributes:
        surfaces: By which its limbs differ; for a plan that was searched for, those
            that make contacts, in order.
        plan: As far as it goes.
        cost: Way to the contacts and their projected distances, summed [m].
    """

    surfaces: tuple[str, ...]
    plan: Plan
    cost: float

    @property
    def stable(self) -> bool:
        """Every step has a stable posture and a path."""
        return self.plan.complete


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Replanned:
    """What there is besides the demonstrated contacts.

    Attributes:
        differences: Surfaces of each stance after the first that the first has not.
        ranked: The best first.
        explored: What the search did; None where it was not needed, or not wanted.
    """

    differences: tuple[tuple[str, ...], ...]
    ranked: tuple[Ranked, ...]
    explored: Explored | None

    @property
    def best(self) -> Ranked:
        """The first one."""
        return self.ranked[0]


def contact_differences(sequence: ContactSequence) -> tuple[tuple[str, ...], ...]:
    """Surfaces of each stance after the first that the first has not: Cd_i."""
    first = set(sequence.stances[0].surfaces)
    return tuple(
        tuple(s for s in stance.surfaces if s not in first)
        for stance in sequence.stances[1:]
    )


def contact_alternatives(
    sequence: ContactSequence, robot: Robot
) -> tuple[Alternative, ...]:
    """One for each combination of surfaces, of the limbs that offer several at once.

    Args:
        sequence: As demonstrated.
        robot: Whose limbs have the surfaces; others are nobody's.
    """
    differences = contact_differences(sequence)
    offers = []
    for limb in robot.limbs.values():
        found = [[s for s in limb.surfaces if s in d] for d in differences]
        several = {s for names in found if len(names) > 1 for s in names}
        if several:
            offers.append([s for s in reversed(limb.surfaces) if s in several])
    out = []
    for chosen in itertools.product(*offers):
        dropped = {s for names in offers for s in names} - set(chosen)
        out.append(
            Alternative(surfaces=chosen, sequence=without_surfaces(sequence, dropped))
        )
    return tuple(out)


def stand_ins(sequence: ContactSequence, robot: Robot) -> tuple[Alternative, ...]:
    """One for each set of arms that use their next surface in place of the first.

    Of arms that touch obstacles with the first one alone, a hand: where an elbow takes
    its place, fewer joints and shorter levers bear. The most arms come first.

    Args:
        sequence: As demonstrated.
        robot: Whose arms they are.
    """
    used = {c.surface for s in sequence.stances for c in s.contacts}
    on_top = {
        c.surface for s in sequence.stances for c in s.contacts if c.support != GROUND
    }
    pairs = [
        limb.surfaces[:2]
        for limb in robot.limbs.values()
        if limb.is_arm
        and len(limb.surfaces) > 1
        and limb.surfaces[0] in on_top
        and used.isdisjoint(limb.surfaces[1:])
    ]
    out = []
    for n in range(len(pairs), 0, -1):
        for chosen in itertools.combinations(pairs, n):
            changed = dict(chosen)
            kept = tuple(a for a, _ in pairs if a not in changed)
            out.append(
                Alternative(
                    surfaces=(*kept, *changed.values()),
                    sequence=_with_surfaces(sequence, changed),
                )
            )
    return tuple(out)


def _with_surfaces(
    sequence: ContactSequence, changed: Mapping[str, str]
) -> ContactSequence:
    """The sequence with other surfaces at the same places, by those they replace."""
    return replace(
        sequence,
        stances=tuple(
            replace(
                s,
                contacts=tuple(
                    replace(c, surface=changed.get(c.surface, c.surface))
                    for c in s.contacts
                ),
            )
            for s in sequence.stances
        ),
        intervals=(),
    )


def without_surfaces(
    sequence: ContactSequence, surfaces: Collection[str]
) -> ContactSequence:
    """The sequence without the contacts of some surfaces."""
    return replace(
        sequence,
        stances=tuple(
            replace(
                s, contacts=tuple(c for c in s.contacts if c.surface not in surfaces)
            )
            for s in sequence.stances
        ),
    )


def plan_cost(made: Plan) -> float:
    """Way of the surfaces to their contacts, and projected distances, summed [m].

    The way is the straight line from where a surface is before the move, the shortest
    that there is. A step that has no path counts with what is wanted of it, from the
    last keyframe.
    """
    world = made.world
    kin = Kinematics(world)
    total = 0.0
    q = made.start.q
    for change in made.changes:
        c = change.step.makes
        if c is not None:
            d = next(
                s.projected_distance
                for s in change.keyframe.contacts
                if s.contact.surface == c.surface
            )
            total += _way(kin, q, c) + d
        q = change.keyframe.q
    for step in (f.step for f in made.failures):
        c = None if step is None else step.makes
        if c is not None:
            total += _way(kin, q, c)
            root = kin.landmark(world.robot.limb_of(c.surface).root)[1]
            total += projected_distance(c.position, root)
    return total


def _way(kin: Kinematics, q: np.ndarray, c: Contact) -> float:
    """From where a surface is in a posture to a contact [m]."""
    kin.update(q)
    p = kin.contact_point(c.surface, kin.world.supports[c.support].normal)
    return float(np.linalg.norm(p - c.position))


def replan(
    sequence: ContactSequence,
    robot: Robot,
    scene: Scene,
    *,
    options: PlanOptions | None = None,
    bounds: Bounds | None = None,
    counts: Counts | None = None,
    progress: Progress | None = None,
) -> Replanned:
    """Plan every alternative and rank them; search where none is stable.

    Args:
        sequence: As demonstrated.
        robot: Robot.
        scene: Where it climbs.
        options: How each is planned.
        bounds: Of the search.
        counts: How often a demonstration takes an action, for the search; None: as
            often as this one.
        progress: Called with stage, share and note.

    Raises:
        InputError: The scene does not fit the sequence, or is out of the robot's reach.
    """
    options = options or PlanOptions()
    report = progress or _silent
    return _replanned(sequence, robot, scene, options, bounds, counts, report, None)


def _replanned(
    sequence: ContactSequence,
    robot: Robot,
    scene: Scene,
    options: PlanOptions,
    bounds: Bounds | None,
    counts: Counts | None,
    report: Progress,
    first: Plan | None,
) -> Replanned:
    """`replan`; `first` is the plan of the demonstrated contacts, where there is one.

    Where no limb offers several surfaces, the only alternative is that one.
    """
    planned = []
    candidates = contact_alternatives(sequence, robot)
    for i, a in enumerate(candidates):
        report("replan", i / len(candidates), ", ".join(a.surfaces))
        made = first if not a.surfaces else None
        if made is None:
            made = plan(a.sequence, robot, scene, options=options)
        planned.append((a, made))
    report("replan", 1.0, "")
    explored = None
    if not any(made.complete for _, made in planned):
        ik = IK(build_world(robot, scene))
        for a in stand_ins(sequence, robot):
            report("replan", 1.0, ", ".join(a.surfaces))
            planned.append((a, _planned_once(ik, a.sequence, options)))
            if planned[-1][1].complete:
                break
        else:
            made = [p for _, p in planned]
            explored = _search_on(ik, sequence, made, options, bounds, counts, report)
            if explored is not None and explored.sequence is not None:
                found = Alternative(
                    surfaces=_surfaces(explored), sequence=explored.sequence
                )
                new = _plan_of(ik.world, options, found.sequence, explored.route)
                planned.append((found, replace(new, changes=numbered(new.changes))))
    ranked = _ranked(planned)
    return Replanned(
        differences=contact_differences(sequence), ranked=ranked, explored=explored
    )


def _search_on(
    ik: IK,
    sequence: ContactSequence,
    made: Sequence[Plan],
    options: PlanOptions,
    bounds: Bounds | None,
    counts: Counts | None,
    report: Progress,
) -> Explored | None:
    """What the search finds from where the plan that came farthest is stuck.

    Where that is nothing, or none came anywhere, what it finds from the start.
    """
    goal = retarget(sequence, ik.world)
    begin = Route(start=standing(ik, options.keyframe))
    stuck = max(map(_reached, made), key=lambda x: len(x.changes))
    explored = None
    for start in (stuck, begin) if stuck.changes else (begin,):
        explored = _explored(ik, goal, options, bounds, counts, start, report)
        if explored is None or explored.sequence is not None:
            break
    return explored


def _planned_once(ik: IK, sequence: ContactSequence, options: PlanOptions) -> Plan:
    """The plan of a sequence with these weights and no others."""
    goal = retarget(sequence, ik.world)
    steps, skipped = split_moves(goal, ik.world)
    start = standing(ik, options.keyframe)
    found = follow_steps(ik, start, steps, options, _silent)
    return replace(_plan_of(ik.world, options, goal, found), skipped=tuple(skipped))


def _reached(made: Plan) -> Route:
    """What a plan does before the first step that it misses."""
    steps = [f.step for f in made.failures if f.step is not None]
    first = min((s.index for s in steps if s.index is not None), default=math.inf)
    changes = [c for c in made.changes if (c.step.index or 0) < first]
    return Route(start=made.start, changes=tuple(changes))


def _made(c: Contact | None) -> tuple[str, str] | None:
    return None if c is None else (c.surface, c.support)


def _silent(stage: str, share: float, note: str) -> None:
    pass


def _ranked(planned: Sequence[tuple[Alternative, Plan]]) -> tuple[Ranked, ...]:
    """Stable ones first, by cost; equal ones as they came."""
    out = [Ranked(surfaces=a.surfaces, plan=p, cost=plan_cost(p)) for a, p in planned]
    return tuple(sorted(out, key=lambda r: (not r.stable, r.cost)))


def _explored(
    ik: IK,
    goal: ContactSequence,
    options: PlanOptions,
    bounds: Bounds | None,
    counts: Counts | None,
    start: Route,
    report: Progress,
) -> Explored | None:
    """What the search finds; None where it is not wanted."""
    bounds = bounds or Bounds()
    if bounds.tries == 0:
        return None
    if counts is None:
        counts = action_counts(goal, ik.world)
    return explore(ik, goal, options, counts, bounds, start, report=report)


def _plan_of(
    world: World,
    options: PlanOptions,
    sequence: ContactSequence,
    found: Route,
    state: State | None = None,
    lead: Sequence[Phase] = (),
) -> Plan:
    """The plan of a route."""
    return Plan(
        world=world,
        options=options,
        sequence=sequence,
        start=found.start,
        changes=found.changes,
        failures=found.failures,
        trajectory=timed(world, found.changes, options.speed, lead),
        complete=found.arrived,
        state=state,
    )


def _surfaces(explored: Explored) -> tuple[str, ...]:
    """Surfaces that make contacts, in order."""
    moves = (c.step for c in explored.route.changes)
    return tuple(m.makes.surface for m in moves if m.makes is not None)


def plan_or_replan(
    sequence: ContactSequence,
    robot: Robot,
    scene: Scene,
    *,
    options: PlanOptions | None = None,
    bounds: Bounds | None = None,
    counts: Counts | None = None,
    progress: Progress | None = None,
) -> Plan:
    """The demonstrated contacts; where they have no stable plan, the best others.

    `Plan.fallback` says so. Where there are no others either it is the plan of the
    demonstrated ones.

    Raises:
        InputError: The scene does not fit the sequence, or is out of the robot's reach.
    """
    options = options or PlanOptions()
    report = progress or _silent
    first = plan(sequence, robot, scene, options=options, progress=report)
    if first.complete or not first.failures:
        return first
    why = f"no stable plan as demonstrated ({first.failures[0]})"
    found = _replanned(sequence, robot, scene, options, bounds, counts, report, first)
    if not found.best.stable:
        return replace(first, fallback=Fallback(reason=why, tried=described(found)))
    fallback = Fallback(
        reason=why,
        source="alternatives" if found.explored is None else "search",
        surfaces=found.best.surfaces,
    )
    return replace(found.best.plan, fallback=fallback)


def described(found: Replanned) -> str:
    """One clause: what was tried, and why that was all."""
    n, e = len(found.ranked), found.explored
    tried = f"none of {n} alternatives has one" if n > 1 else "there is no alternative"
    if e is None:
        return tried
    return (
        f"{tried}; the search expanded {e.states} states and planned {e.tries} steps: "
        f"{e.stop.value}"
    )


# From the middle of a climb.


def replan_rest(
    made: Plan,
    now: State,
    scene: Scene,
    *,
    bounds: Bounds | None = None,
    counts: Counts | None = None,
    progress: Progress | None = None,
) -> Plan:
    """Plan what is left of a climb, from where the robot is.

    The steps that are left, as they were; where they have no stable plan, the best of
    the alternatives, or what the search finds.

    Args:
        made: The plan that the robot was following.
        now: Where it is (`state_of`).
        scene: As it is now.
        bounds: Of the search.
        counts: How often a demonstration takes an action, for the search.
        progress: Called with stage, share and note.

    Raises:
        InputError: The scene has fewer boxes than the sequence touches.
    """
    report = progress or _silent
    report("replan", 0.0, "the steps that are left")
    first = adapt_plan(made, scene, now, now.q)
    world, options = first.world, made.options
    sequence = retarget(made.sequence, world)
    if first.complete or not first.failures:
        return first
    ik = IK(world)
    start, lead = settle(ik, now, now.q, options)
    if start.status is not Status.SOLVED:
        return first
    why = f"no stable plan as demonstrated ({first.failures[0]})"
    planned = []
    candidates = contact_alternatives(sequence, world.robot)
    for i, a in enumerate(candidates if len(candidates) > 1 else ()):
        report("replan", i / len(candidates), ", ".join(a.surfaces))
        here = replace(now, done=steps_made(a.sequence, world, now.stance))
        steps = split_moves(a.sequence, world)[0][here.done :]
        steps = from_here(steps, now.stance, world)
        found, used = search_steps(ik, start, steps, options)
        planned.append((a, _plan_of(world, used, a.sequence, found, here, lead)))
    report("replan", 1.0, "")
    ranked = _ranked(planned)
    if ranked and ranked[0].stable:
        surfaces = ranked[0].surfaces
        fallback = Fallback(reason=why, source="alternatives", surfaces=surfaces)
        return replace(ranked[0].plan, fallback=fallback)
    begin = Route(start=start)
    explored = _explored(ik, sequence, options, bounds, counts, begin, report)
    if explored is None or explored.sequence is None:
        tried = Replanned(differences=(), ranked=ranked, explored=explored)
        return replace(first, fallback=Fallback(reason=why, tried=described(tried)))
    whole, k = _from_standing(ik, explored.sequence, options)
    found = _plan_of(world, options, whole, explored.route, replace(now, done=k), lead)
    first = len(whole.stances) - len(explored.route.changes)
    return replace(
        found,
        changes=numbered(found.changes, k, first),
        fallback=Fallback(reason=why, source="search", surfaces=_surfaces(explored)),
    )


def _from_standing(
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
    steps = split_moves(whole, ik.world)[0]
    return whole, sum(s.stance <= before for s in steps)


def state_of(
    plan: Plan,
    scene: Scene,
    q: np.ndarray,
    touching: Mapping[str, str] | None = None,
    *,
    source: object = "state",
) -> State:
    """Where a robot is in a plan, from its posture.

    Args:
        plan: That it was following.
        scene: As it is now.
        q: (nq,) posture.
        touching: Support of each surface in contact; None: whatever lies within 5 mm
            of a support. Of a limb's surfaces the one nearest to the trunk counts.
        source: Of the posture, for errors.

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
                contacts.append(felt_contact(kin, c))
                break
    if not contacts:
        raise InputError(
            "a posture with a surface on a support", source=source, field="contacts"
        )
    stance = tuple(contacts)
    return State(
        stance=stance,
        loaded=stance,
        q=q,
        done=steps_made(plan.sequence, plan.world, stance),
    )


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


def steps_made(
    sequence: ContactSequence, world: World, stance: Sequence[Contact]
) -> int:
    """How many steps of a sequence a stance has made.

    The number after which most limbs are on the surfaces that they are on; a step that
    makes a contact is made only if the contact is there. Of several, the one whose
    contacts lie nearest.

    Args:
        sequence: In the world of the plan.
        world: Of the plan.
        stance: The contacts that hold.
    """
    limb_of = world.robot.limb_of
    now = {limb_of(c.surface).name: c for c in stance}
    on: dict[str, Contact | None] = {
        n: sequence.stances[0].contact(x.surfaces[0]) if not x.is_arm else None
        for n, x in world.robot.limbs.items()
    }
    best, made = _alike(on, now), 0  # more limbs first, then nearer
    for k, step in enumerate(split_moves(sequence, world)[0], start=1):
        m = step
        on[m.limb] = m.makes
        if m.makes is not None and _made(now.get(m.limb)) != _made(m.makes):
            continue
        score = _alike(on, now)
        if score > best:
            best, made = score, k
    return made


def _alike(
    on: Mapping[str, Contact | None], now: Mapping[str, Contact]
) -> tuple[int, float]:
    """Limbs on the same surface, and how near their contacts are [m], negative."""
    same, away = 0, 0.0
    for limb, c in on.items():
        there = now.get(limb)
        if c is not None and there is not None and _made(c) == _made(there):
            same += 1
            away += float(np.linalg.norm(c.position - there.position))
    return same, -away
