"""General policy + scene -> plan: climb up, crawl, turn, climb down, step to the goal.

Algorithm 3 of the thesis: the policy's cycles are run from the initial state until the
goal; contacts start at the obstacle's closest points and go on by a third of what the
limb reaches, towards the goal; each of them is planned by the ordinary search. What
comes next is read off the stance alone, so that a plan can go on from any stance, as it
is felt. Stairs are climbed on hands and feet (`stairs`), the last riser on knees.

The way down is a way up: a climb that is statically stable is so backwards as well. The
ascent is planned from where the robot will stand behind the far edge; each of its
moves, reversed, is where a move of the descent is looked for.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from clamber.contact.contact import Contact, ContactSequence, Stance
from clamber.contact.policy import (
    Edge,
    GeneralPolicy,
    Option,
    pelvis_angles,
    pelvis_distribution,
    pelvis_rotation,
)
from clamber.contact.steps import Seeds, Step
from clamber.errors import InputError, Status
from clamber.model.robot import Robot
from clamber.model.scene import GROUND, Scene
from clamber.model.se3 import matrix_from_quat, quat_from_matrix, turn_about_z
from clamber.model.world import World, build_world
from clamber.planning.planner import check_start, search_steps, timed
from clamber.planning.proportions import DEPTH, STAND, Build, build_of
from clamber.planning.records import (
    Fallback,
    Iteration,
    Plan,
    PlanOptions,
    Progress,
    Route,
    numbered,
)
from clamber.planning.route import (
    Place,
    Platform,
    find_place,
    find_platforms,
    goal_of,
    room_on,
)
from clamber.planning.stairs import CLEAR, FLUSH, is_flight, next_contacts
from clamber.step.change import Change, Failure, change_contact, home_at, standing
from clamber.step.ik import IK, PostureProblem, base_clearance, contact_clearance
from clamber.step.posture import CLEARANCE, Keyframe, held_goal

TURN = 0.25  # [rad] of the body in one cycle on all fours
STEP_TURN = 0.30  # [rad] of the body in one cycle on its feet
CYCLES = (1.0, 0.5, 0.25)  # a cycle over a riser that fails is tried shorter
SHRUNK = (1.0, 0.6, 0.3)  # a step that fails is tried shorter
NEARER = (0.0, 0.4)  # share of the way to a limb that is stuck, to stand around it
SAME = 0.02  # [m] a contact wanted nearer to where it is does not move
ARRIVED = 0.05  # [m] from where it shall get to, the body is there
NEARLY = 0.12  # [m] ... where it gets no nearer, it may climb down from here
FACING = 0.15  # [rad] from how it shall face
# Cycles in a row that bring the goal nearer by less than the second [m] are given up:
# to turn around on the spot takes 13.
PATIENCE, NEARER_BY = 20, 0.01
STAND_TOL = 0.12  # lengths of a leg, from where the body stands before an edge
BESIDE_TOL = 0.10  # [m] along the edge
LEAN = np.radians(80.0)  # of the trunk on all fours
# Knees stay so far from a riser, in lengths of a thigh: nearer to it, the thigh meets
# its upper edge before it leans far enough for the weight to get past the other knee.
BEFORE_RISER = 0.5
OVER_MIDDLE = 3.0  # weight of the centre of mass between hands and feet


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Followed:
    """What following a policy gave.

    Attributes:
        route: As far as it goes; neither arrived nor failed where it was cut short.
        iterations: One for each change.
        instead: Where a secondary policy was followed, and why; empty: nowhere.
    """

    route: Route
    iterations: tuple[Iteration, ...]
    instead: str


@dataclass(frozen=True, eq=False, slots=True)
class _Frame:
    """Where the body is over its contacts: x, y [m] and yaw [rad]."""

    xy: np.ndarray
    yaw: float

    def at(self, offset: np.ndarray) -> np.ndarray:
        return self.xy + turn_about_z(self.yaw) @ offset

    def local(self, p: np.ndarray) -> np.ndarray:
        return turn_about_z(self.yaw).T @ (p[:2] - self.xy)


@dataclass(frozen=True, eq=False, slots=True)
class _Task:
    """All that does not change on the way."""

    ik: IK
    policy: GeneralPolicy
    options: PlanOptions
    platforms: tuple[Platform, ...]
    goal: np.ndarray
    goal_yaw: float | None
    build: Build
    fours: np.ndarray


_Made = tuple[Change, str]


def plan_traverse(
    policy: GeneralPolicy,
    robot: Robot,
    scene: Scene,
    *,
    options: PlanOptions | None = None,
    progress: Progress | None = None,
) -> Plan:
    """Plan the way to the scene's goal with a general policy.

    Raises:
        InputError: The scene is out of the robot's reach, its goal cannot be, or the
            policy does not say how to climb.
    """
    options = options or PlanOptions()
    report = progress or (lambda stage, share, note: None)
    world = build_world(robot, scene)
    ik = IK(world)
    tasks = _tasks(ik, policy, options)
    start = standing(ik, options.keyframe)
    check_start(ik, start)
    _check_route(tasks[0])
    found = _follow(tasks, start, options.max_changes, report)
    report("trajectory", 1.0, "")
    route = found.route
    trajectory = timed(world, route.changes, options.speed)
    stances = tuple(Stance(contacts=k.stance) for k in route.keyframes)
    fallback = None
    if found.instead:
        reason = "; ".join(map(str, route.failures))
        fallback = Fallback(reason=reason, source="secondary", tried=found.instead)
    return Plan(
        world=world,
        options=options,
        sequence=ContactSequence(
            source="; ".join(policy.sources) or "a policy",
            subject=None,
            scene=scene,
            stances=stances,
            t=np.arange(len(stances) + 1.0),
        ),
        start=route.start,
        changes=numbered(route.changes),
        failures=route.failures,
        trajectory=trajectory,
        complete=route.arrived and bool(route.changes),
        fallback=fallback,
        policy=policy,
        iterations=found.iterations,
    )


def follow_policy(
    ik: IK, policy: GeneralPolicy, key: Keyframe, options: PlanOptions, changes: int
) -> Followed:
    """Go on with a policy from a keyframe.

    Args:
        ik: Workspace.
        policy: The policy; where it has no stable step, its secondary ones are tried.
        key: Where to go on from.
        options: Of the plan.
        changes: Contact changes at most, then to the end of what was begun.
    """
    tasks = _tasks(ik, policy, options)
    return _follow(tasks, key, changes, lambda stage, share, note: None)


def _follow(
    tasks: Sequence[_Task], start: Keyframe, most: int, report: Progress
) -> Followed:
    changes: list[Change] = []
    iterations, instead = [], []
    task = tasks[0]
    first = cost_to_go(start.stance, task.goal)
    missed, arrived = "", False
    best = math.inf
    since: list[tuple[Contact, ...]] = []  # stances since it last got nearer
    while len(changes) < most:
        key = changes[-1].keyframe if changes else start
        to_go = cost_to_go(key.stance, task.goal)
        nearer = to_go <= best - NEARER_BY
        best = to_go if nearer else min(best, to_go)
        since = [*(() if nearer else since), key.stance]
        if len(since) > PATIENCE + 1:
            missed = f"{PATIENCE} cycles bring it no nearer to the goal, {to_go:.2f} m"
            break
        if any(_same(since[-1], stance) for stance in since[:-1]):
            missed = f"it only goes to and fro, {to_go:.2f} m from the goal"
            break
        share = 1.0 - min(to_go / max(first, 1e-9), 1.0)
        report("plan", share, f"{to_go:.2f} m to go, {len(changes)} contact changes")
        made, missed = _manoeuvre(task, key)
        name = ""
        for k, other in enumerate(tasks[1:], start=1):
            if made or not missed:
                break
            made, _ = _manoeuvre(other, key)
            if made:
                name = f"secondary {k}"
                instead.append(f"{name} from change {len(changes) + 1} on ({missed})")
        for change, option in made:
            changes.append(change)
            iterations.append(
                Iteration(
                    option=f"{option}, {name}" if name else option,
                    cost=cost_to_go(change.keyframe.stance, task.goal),
                )
            )
        if not made:
            arrived = not missed
            break
        missed = ""
    else:
        if len(changes) >= task.options.max_changes:
            missed = f"{task.options.max_changes} contact changes were not enough"
    failures = (Failure(status=Status.STUCK, detail=missed),) if missed else ()
    return Followed(
        route=Route(
            start=start, changes=tuple(changes), failures=failures, arrived=arrived
        ),
        iterations=tuple(iterations),
        instead="; ".join(instead),
    )


def _same(a: Sequence[Contact], b: Sequence[Contact]) -> bool:
    """The same surfaces are where they were: what came next will come again."""
    there = {c.surface: c.position for c in b}
    return {c.surface for c in a} == set(there) and all(
        np.linalg.norm(c.position - there[c.surface]) < NEARER_BY for c in a
    )


def cost_to_go(stance: Sequence[Contact], goal: np.ndarray) -> float:
    """From the mean of all contacts to the goal (2,) [m] [algorithm 3, step 11]."""
    middle = np.mean([c.position[:2] for c in stance], axis=0)
    return float(np.linalg.norm(goal - middle))


# What comes next.


def _manoeuvre(task: _Task, key: Keyframe) -> tuple[list[_Made], str]:
    """The next contacts, and why there are no more; neither where it has arrived."""
    platform = _platform_of(task, key.stance)
    if platform is None:
        return _on_feet(task, key)
    grounded = [c for c in key.stance if c.support == GROUND]
    if grounded:
        feet = np.mean([c.position for c in grounded], axis=0)
        if platform.exit is not None and platform.exit.distance(feet) < 0:
            return _climb_down(task, key, platform)
        return _climb(task, key, platform)
    if _is_flight(task, platform):
        made, why = _up_stairs(task, key, platform)
        if made or why:
            return made, why
    return _on_fours(task, key, platform)


def _platform_of(task: _Task, stance: Sequence[Contact]) -> Platform | None:
    for platform in task.platforms:
        if any(c.support in platform.boxes for c in stance):
            return platform
    return None


# On its feet.


def _on_feet(task: _Task, key: Keyframe) -> tuple[list[_Made], str]:
    frame = _feet_frame(task, key.stance)
    ahead = next((p for p in task.platforms if not _passed(p, frame.xy)), None)
    if ahead is not None:
        wanted = _before(task, ahead.entry)
        local = wanted.local(frame.xy)
        near = (
            abs(local[0]) <= STAND_TOL * task.build.stand / STAND
            and abs(local[1]) <= BESIDE_TOL
            and abs(_apart(frame.yaw, wanted.yaw)) <= FACING
        )
        if near:
            return _climb(task, key, ahead)
        return _walk(task, key, frame, wanted)
    wanted = _Frame(task.goal, frame.yaw if task.goal_yaw is None else task.goal_yaw)
    if _there(frame, wanted):
        return [], ""
    return _walk(task, key, frame, wanted)


def _passed(platform: Platform, xy: np.ndarray) -> bool:
    return (
        platform.exit is not None
        and platform.exit.distance(xy) < 0
        and (platform.entry.distance(xy) > 0)
    )


def _before(task: _Task, edge: Edge) -> _Frame:
    """Where the feet stand before an edge."""
    return _Frame(edge.point - task.build.stand * edge.inward, edge.yaw)


def _there(frame: _Frame, wanted: _Frame) -> bool:
    away = float(np.linalg.norm(frame.xy - wanted.xy))
    return away <= ARRIVED and abs(_apart(frame.yaw, wanted.yaw)) <= FACING


def _feet_frame(task: _Task, stance: Sequence[Contact]) -> _Frame:
    """Midpoint of the feet, and the mean of how they are turned."""
    feet = [c for c in stance if _is_foot(task, c)]
    ways = np.sum([matrix_from_quat(c.quaternion)[:2, 0] for c in feet], axis=0)
    middle = np.mean([c.position[:2] for c in feet], axis=0)
    return _Frame(middle, float(np.arctan2(ways[1], ways[0])))


def _is_foot(task: _Task, c: Contact) -> bool:
    limb = task.ik.world.robot.limb_of(c.surface)
    return not limb.is_arm and c.surface == limb.surfaces[0]


def _walk(
    task: _Task, key: Keyframe, frame: _Frame, wanted: _Frame
) -> tuple[list[_Made], str]:
    """One step of each foot towards where it shall stand."""
    legs = [x for x in task.ik.world.robot.limbs.values() if not x.is_arm]
    step = min(task.build.step[x.name] for x in legs)
    body = _between(frame, wanted, step, STEP_TURN)
    side = turn_about_z(frame.yaw).T @ (body.xy - frame.xy)
    turn = _apart(frame.yaw, body.yaw)
    left_first = side[1] + task.build.feet * turn > 0
    legs.sort(key=lambda x: x.name.startswith("left") != left_first)
    made: list[_Made] = []
    why = ""
    for leg in legs:
        sign = 1.0 if leg.name.startswith("left") else -1.0
        target = body.at(np.array([0.0, sign * task.build.feet]))
        place = Place(support=GROUND, position=np.array([*target, 0.0]))
        found = _attempt(task, key, leg.surfaces[0], place, body, _home(task, body))
        if isinstance(found, str):
            why = found
            continue
        key = found.keyframe
        made.append((found, task.policy.options[-1].name))
    return made, why


def _home(task: _Task, body: _Frame) -> np.ndarray:
    """(nq,) the posture that the robot starts from, over the feet."""
    return home_at(task.ik.world, _ankles(task, body))


def _ankles(task: _Task, body: _Frame) -> np.ndarray:
    """(3,) x, y and yaw of the ankles' midpoint where the feet are at the body's."""
    return np.array([*body.at(-task.build.ahead), body.yaw])


# Up and down.


def _climb(task: _Task, key: Keyframe, platform: Platform) -> tuple[list[_Made], str]:
    """The next contacts of a flight of stairs, or all that is left of a climb."""
    if _is_flight(task, platform):
        return _up_stairs(task, key, platform)
    return _climb_up(task, key, platform.entry, platform)


def _is_flight(task: _Task, platform: Platform) -> bool:
    return is_flight(task.ik.world, platform, task.goal, task.build.gait)


def _up_stairs(
    task: _Task, key: Keyframe, platform: Platform
) -> tuple[list[_Made], str]:
    """The next contacts, usually a pair; why there are none; neither where it is up.

    Where not all of a pair get to their places, all go to their next best.
    """
    wanted = next_contacts(
        task.ik.world, platform, key.stance, task.goal, task.build.gait
    )
    some: list[_Made] = []
    why = ""
    for rank in range(max((len(places) for _, places in wanted), default=0)):
        these = [(s, places[min(rank, len(places) - 1)]) for s, places in wanted]
        made, why = _set_all(task, key, platform, these)
        if not why:
            return made, ""
        some = some or made
    return some, "" if some else why


def _set_all(
    task: _Task,
    key: Keyframe,
    platform: Platform,
    wanted: Sequence[tuple[str, Place]],
) -> tuple[list[_Made], str]:
    """Surfaces set down at their places; why not the last of those that are not."""
    body = _Frame(platform.entry.point, platform.entry.yaw)
    made: list[_Made] = []
    why = ""
    for _ in range(2):  # what cannot move yet is tried again once the others have
        left, why = [], ""
        for surface, place in wanted:
            found = _attempt(
                task,
                key,
                surface,
                place,
                body,
                _upright(task, key, surface, place),
                shares=SHRUNK[:1],
                imposed=False,
            )
            if isinstance(found, str):
                left.append((surface, place))
                why = found
                continue
            key = found.keyframe
            made.append((found, _option_with(task, surface).name))
        wanted = left
    return made, why


def _upright(task: _Task, key: Keyframe, surface: str, place: Place) -> np.ndarray:
    """(nq,) with a surface at its place, the weight between the hands and the feet.

    What the postures on stairs stay near to: legs that come after the hands otherwise
    push the body over them.
    """
    world = task.ik.world
    new = _contact(world, surface, place, task.platforms[0].entry.yaw)
    limb = world.robot.limb_of(surface)
    stance = [c for c in key.stance if c.surface not in limb.surfaces]
    stance.append(new)
    where = {c.surface: c.support for c in stance}
    problem = PostureProblem(
        goals=tuple(held_goal(world, c) for c in stance),
        q_reference=key.q,
        clearance=contact_clearance(world, base_clearance(world, CLEARANCE), where),
        com_target=_middle(task, stance),
        com_weight=OVER_MIDDLE,
    )
    return task.ik.solve(problem, key.q).q


def _middle(task: _Task, stance: Sequence[Contact]) -> np.ndarray:
    """(2,) half-way between the arms' contacts and the legs'."""
    kinds: dict[bool, list[np.ndarray]] = {}
    for c in stance:
        arm = task.ik.world.robot.limb_of(c.surface).is_arm
        kinds.setdefault(arm, []).append(c.position[:2])
    return np.mean([np.mean(x, axis=0) for x in kinds.values()], axis=0)


def _option_with(task: _Task, surface: str) -> Option:
    """The first of the policy that moves a surface; else the last."""
    options = task.policy.options
    return next((o for o in options if surface in o.surfaces), options[-1])


def _climb_up(
    task: _Task, key: Keyframe, edge: Edge, platform: Platform
) -> tuple[list[_Made], str]:
    """All that is left of a climb."""
    rows = _ascent(task, edge, platform)
    steps, names = _left_of(task, key, rows)
    if not steps:
        return [], "nothing is left to climb with"
    found, _ = search_steps(task.ik, key, steps, task.options)
    if found.failures:
        return [], str(found.failures[0])
    return list(zip(found.changes, names, strict=True)), ""


def _ascent(task: _Task, edge: Edge, platform: Platform) -> list[tuple[Step, str]]:
    """The steps of a climb with the cycles that they belong to."""
    world, policy = task.ik.world, task.policy
    yaw = edge.yaw
    rows: list[tuple[Step, str]] = []
    at: dict[str, str] = {}
    for option in policy.options:
        for surface in option.surfaces:
            limb = world.robot.limb_of(surface)
            if at.get(limb.name) == surface:
                continue
            if option.region == "O" and limb.is_arm and limb.name in at:
                continue
            offset = _climb_offset(task, surface)
            wanted = _Frame(edge.point, yaw).at(offset)
            place = _place(task, platform, surface, wanted, platform.boxes)
            contact = _contact(world, surface, place, yaw)
            breaks = (at[limb.name],) if limb.name in at else ()
            if not limb.is_arm and not breaks:
                breaks = (limb.surfaces[0],)
            at[limb.name] = surface
            step = Step(limb=limb.name, breaks=breaks, makes=contact)
            rows.append((step, option.name))
        if option.region == "O":
            break
    return rows


def _climb_offset(task: _Task, surface: str) -> np.ndarray:
    """(2,) from the edge inwards and to the left."""
    limb = task.ik.world.robot.limb_of(surface)
    outer = surface == limb.surfaces[0]
    fours = task.build.fours[limb.name]
    if not limb.is_arm:
        return np.array([DEPTH["knee"] * task.build.step[limb.name], 0.9 * fours[1]])
    kind = "hand" if outer else "elbow"
    side = 0.36 * fours[1] if outer else fours[1]
    return np.array([DEPTH[kind] * task.build.step[limb.name], side])


def _left_of(
    task: _Task, key: Keyframe, rows: Sequence[tuple[Step, str]]
) -> tuple[list[Step], list[str]]:
    """The rows that come after the surfaces that each limb is on."""
    robot = task.ik.world.robot
    now = {robot.limb_of(c.surface).name: c.surface for c in key.stance}
    done = []
    for limb, surface in now.items():
        for i, (step, _) in enumerate(rows):
            makes = step.makes
            if step.limb == limb and makes and makes.surface == surface:
                done += [j for j in range(i + 1) if rows[j][0].limb == limb]
    left = [i for i in range(len(rows)) if i not in done]
    return [rows[i][0] for i in left], [rows[i][1] for i in left]


def _descent(
    task: _Task, platform: Platform
) -> tuple[tuple[Contact, ...], list[tuple[Step, str]]] | str:
    """The ascent from behind the far edge reversed, or why not.

    Its last stance, from which the descent begins, and the steps from there.
    """
    edge = platform.exit
    assert edge is not None
    world = task.ik.world
    at = _ankles(task, _before(task, edge))
    start = standing(task.ik, task.options.keyframe, at)
    rows = _ascent(task, edge, platform)
    steps = [s for s, _ in rows]
    found, _ = search_steps(task.ik, start, steps, task.options)
    if found.failures:
        return str(found.failures[0])
    home = home_at(world, at)
    out = []
    for up, (_, name) in zip(found.changes[::-1], rows[::-1], strict=True):
        made = up.step.makes
        assert made is not None
        before = up.leaving[0] if up.leaving else None
        seeds = Seeds(shifted=up.touching, touching=up.shifted)
        reference = home if before is None else None
        out.append(
            (
                Step(
                    limb=up.step.limb,
                    breaks=(made.surface,),
                    makes=before,
                    fixed=True,
                    seeds=seeds,
                    reference=reference,
                    stands_up=up is found.changes[0],
                ),
                name,
            )
        )
    return found.end.stance, out


def _climb_down(
    task: _Task, key: Keyframe, platform: Platform
) -> tuple[list[_Made], str]:
    """All that is left of a descent; where that cannot be, contacts move first."""
    reversed_ascent = _descent(task, platform)
    if isinstance(reversed_ascent, str):
        return [], reversed_ascent
    top, there = reversed_ascent
    robot = task.ik.world.robot
    now = {robot.limb_of(c.surface).name: c.surface for c in key.stance}
    steps, names = [], []
    for step, name in there:
        limb = step.limb
        if now.get(limb) not in step.breaks:
            continue
        if step.makes is None:
            del now[limb]
        else:
            now[limb] = step.makes.surface
        steps.append(step)
        names.append(name)
    if not steps:
        return [], "nothing is left to climb down with"
    found, _ = search_steps(task.ik, key, steps, task.options)
    if found.failures:
        why = str(found.failures[0])
        if any(c.support == GROUND for c in key.stance):
            return [], why
        return _rearranged(task, key, top), why
    return list(zip(found.changes, names, strict=True)), ""


def _rearranged(task: _Task, key: Keyframe, top: tuple[Contact, ...]) -> list[_Made]:
    """Contacts moved to where the reversed ascent ends: from there is a way down."""
    body = _fours_frame(task, top)
    made: list[_Made] = []
    option = next(o for o in task.policy.options if o.region == "O")
    for c in top:
        limb = task.ik.world.robot.limb_of(c.surface).name
        here = _by_limb(task, key.stance).get(limb)
        if here is not None and np.linalg.norm(c.position - here.position) < SAME:
            continue
        place = Place(support=c.support, position=c.position)
        found = _attempt(task, key, c.surface, place, body, task.fours)
        if not isinstance(found, str):
            key = found.keyframe
            made.append((found, option.name))
    return made


# On all fours.


def _on_fours(
    task: _Task, key: Keyframe, platform: Platform
) -> tuple[list[_Made], str]:
    """One cycle on top, or the descent where it begins."""
    frame = _fours_frame(task, key.stance)
    made = _set_down(task, key, platform, frame)
    if made:
        return made, ""
    if platform.exit is None:
        yaw = frame.yaw if task.goal_yaw is None else task.goal_yaw
        if task.goal_yaw is None and _rises(task, platform):
            yaw = platform.entry.yaw  # a riser is climbed square to it
        wanted = _Frame(task.goal, yaw)
        if _there(frame, wanted):
            return [], ""
        return _crawl(task, key, platform, frame, wanted)
    wanted = _behind(task, platform.exit)
    if _there(frame, wanted):
        return _climb_down(task, key, platform)
    made, why = _crawl(task, key, platform, frame, wanted)
    if not made and np.linalg.norm(frame.xy - wanted.xy) <= NEARLY:
        return _climb_down(task, key, platform)
    return made, why


def _set_down(
    task: _Task, key: Keyframe, platform: Platform, frame: _Frame
) -> list[_Made]:
    """Limbs that lost their contact: where they belong, else where they are."""
    option = next(o for o in task.policy.options if o.region == "O")
    robot, made = task.ik.world.robot, []
    on = _by_limb(task, key.stance)
    for surface in option.surfaces:
        limb = robot.limb_of(surface).name
        if limb in on:
            continue
        task.ik.kin.update(key.q)
        now = task.ik.kin.contact_point(surface, np.array([0.0, 0.0, 1.0]))
        for wanted in (frame.at(task.build.fours[limb]), now[:2]):
            place = _place(task, platform, surface, wanted, platform.boxes)
            found = _attempt(task, key, surface, place, frame, task.fours)
            if not isinstance(found, str):
                key = found.keyframe
                made.append((found, option.name))
                break
    return made


def _behind(task: _Task, edge: Edge) -> _Frame:
    """Where the body is on all fours before it climbs down: facing inwards."""
    knee = max(-o[0] for o in task.build.fours.values())
    depth = knee + DEPTH["knee"] * min(task.build.step.values())
    return _Frame(edge.point + 0.8 * depth * edge.inward, edge.yaw)


def _by_limb(task: _Task, stance: Sequence[Contact]) -> dict[str, Contact]:
    return {task.ik.world.robot.limb_of(c.surface).name: c for c in stance}


def _fours_frame(task: _Task, stance: Sequence[Contact]) -> _Frame:
    """The middle of the contacts; the yaw that fits them best to `fours`."""
    on = {n: c.position[:2] for n, c in _by_limb(task, stance).items()}
    middle = np.mean(list(on.values()), axis=0)
    offsets = {n: task.build.fours[n] for n in on}
    centre = np.mean(list(offsets.values()), axis=0)
    dot = cross = 0.0
    for n, p in on.items():
        a, b = offsets[n] - centre, p - middle
        dot += float(a @ b)
        cross += float(a[0] * b[1] - a[1] * b[0])
    return _Frame(middle, float(np.arctan2(cross, dot)))


def _rises(task: _Task, platform: Platform) -> bool:
    """There are stairs on it."""
    tops = [task.ik.world.supports[n].position[2] for n in platform.boxes]
    return max(tops) - min(tops) > FLUSH


def _crawl_step(task: _Task) -> float:
    return min(task.build.step.values())


def _between(a: _Frame, b: _Frame, step: float, turn: float) -> _Frame:
    """One cycle from `a` towards `b`: the way first, the turn as late as it can be."""
    way, angle = b.xy - a.xy, _apart(a.yaw, b.yaw)
    away = float(np.linalg.norm(way)) / step
    turns = abs(angle) / turn
    cycles = max(away, turns, 1.0)
    share = angle / cycles if away <= turns + 1.0 or turns == 0 else 0.0
    return _Frame(a.xy + way / cycles, a.yaw + share)


def _heading(task: _Task, platform: Platform, frame: _Frame, wanted: _Frame) -> _Frame:
    """`wanted`, or the part of the way there before or after the body can turn.

    Between walls it keeps its yaw; where it can turn now but not there, it does so now.
    """
    if abs(_apart(frame.yaw, wanted.yaw)) <= FACING:
        return wanted
    room, scene = task.build.round, task.ik.world.scene
    if room_on(scene, platform.boxes, frame.xy) < room:
        if np.linalg.norm(frame.xy - wanted.xy) > ARRIVED:
            return _Frame(wanted.xy, frame.yaw)
    elif room_on(scene, platform.boxes, wanted.xy) < room:
        return _Frame(frame.xy, wanted.yaw)
    return wanted


def _share(a: _Frame, b: _Frame, share: float) -> _Frame:
    """A part of the way from one to the other."""
    return _Frame(a.xy + share * (b.xy - a.xy), a.yaw + share * (b.yaw - a.yaw))


def _crawl(
    task: _Task,
    key: Keyframe,
    platform: Platform,
    frame: _Frame,
    wanted: _Frame,
) -> tuple[list[_Made], str]:
    """One cycle towards `wanted`."""
    option = next(o for o in task.policy.options if o.region == "O")
    step = _crawl_step(task)
    if _gaps_ahead(platform, key.stance, wanted.xy):
        wanted = _Frame(wanted.xy, platform.entry.yaw)
    heading = _heading(task, platform, frame, wanted)
    made = _over_gap(task, key, platform, option, frame, heading)
    if made:
        return made, ""
    full = _between(frame, heading, step, TURN)
    tries = (
        full,
        _share(frame, full, 0.5),
        _Frame(full.xy, frame.yaw),
        _Frame(frame.xy, full.yaw),
        frame,  # on the spot, as it should stand
    )
    why = ""
    leading = _leading_first(task, option, frame, full)
    if _rises(task, platform):
        bodies = [_share(frame, full, x) for x in CYCLES]
        made = _over_riser(task, key, platform, option, bodies, leading)
        if made:
            return made, ""
    stuck = []
    k = len(leading) // 2
    for body, order in (
        (full, leading),
        (full, leading[k:] + leading[:k]),
        *((x, leading) for x in tries[1:]),
    ):
        made, left, why = _twice(task, key, platform, option, body, order)
        if made and not left:
            return made, ""
        if made:
            stuck.append((body, made, left[0]))
    # The others have gone too far ahead: around the first that is left behind they
    # stand again as they should, and it may follow.
    for body, made, surface in stuck:
        made, why = _brought_back(task, platform, option, body, surface, made)
        if made:
            return made, ""
    return [], why or "no contact of the cycle moves"


def _brought_back(
    task: _Task,
    platform: Platform,
    option: Option,
    body: _Frame,
    stuck: str,
    made: Sequence[_Made],
) -> tuple[list[_Made], str]:
    """After `made`, the others around the surface that is stuck, which then follows.

    First where they stand around it on all fours; then nearer to it, so that they bear
    more of the weight and it is stretched less. Nothing, and why, where it is stuck
    even so.
    """
    key, why = made[-1][0].keyframe, ""
    limb = task.ik.world.robot.limb_of(stuck).name
    on = _by_limb(task, key.stance)
    if limb not in on:
        return [], "a limb without a contact finds no place"
    here = on[limb].position[:2]
    others = [s for s in option.surfaces if s != stuck]
    # Over a riser it may follow before all are back.
    groups = [[s] for s in others] if _rises(task, platform) else [others]
    for nearer in NEARER:
        out, now = list(made), key
        offset = (1.0 - nearer) * task.build.fours[limb]
        around = _Frame(here - turn_about_z(body.yaw) @ offset, body.yaw)
        for group in groups:
            _cycle(task, now, platform, option, around, group, out, back=True)
            now = out[-1][0].keyframe
            left, why = _cycle(task, now, platform, option, body, [stuck], out)
            if not left:
                return out, ""
    return [], why


def _over_riser(
    task: _Task,
    key: Keyframe,
    platform: Platform,
    option: Option,
    bodies: Sequence[_Frame],
    leading: tuple[str, ...],
) -> list[_Made]:
    """One cycle in which every contact gets to where it shall; empty: there is none.

    The second knee over a riser wants the elbows near, so that knees may have to go
    first; and where the next riser leaves elbows no room, hands bear the trunk higher.
    """
    robot = task.ik.world.robot
    arms = {s: robot.limb_of(s).surfaces[0] for s in leading if robot.limb_of(s).is_arm}
    k = len(leading) // 2
    for surfaces in (leading, tuple(arms.get(s, s) for s in leading)):
        for body in bodies:
            for order in (surfaces, surfaces[k:] + surfaces[:k]):
                made, left, _ = _twice(task, key, platform, option, body, order)
                if made and not left:
                    return made
    return []


def _gaps_ahead(
    platform: Platform, stance: Sequence[Contact], wanted: np.ndarray
) -> list[tuple[float, float]]:
    """Gaps that not all contacts have passed on the way to `wanted` (2,).

    Where each begins and ends, from the contact that is last on the way [m].
    """
    points = np.array([c.position[:2] for c in stance])
    way = wanted - points.mean(axis=0)
    way /= max(float(np.linalg.norm(way)), 1e-9)
    last = points[np.argmin(points @ way)]
    spans = [tuple(map(float, (gap - last) @ way)) for gap in platform.gaps]
    return [
        (near, far) for near, far in spans if far > 0.0 and near < (wanted - last) @ way
    ]


def _over_gap(
    task: _Task,
    key: Keyframe,
    platform: Platform,
    option: Option,
    frame: _Frame,
    wanted: _Frame,
) -> list[_Made]:
    """One cycle near a gap; empty: there is none, or no way.

    Where elbows and knees do not reach across, hands do, and knees do from a stand on
    both feet.
    """
    if abs(_apart(frame.yaw, wanted.yaw)) > FACING:
        return []
    limbs = task.ik.world.robot.limbs
    surfaces = {task.ik.world.robot.limb_of(s).name: s for s in option.surfaces}
    on = _by_limb(task, key.stance)
    walks, hops = _due_near_gap(task, platform, on, surfaces, frame, wanted)
    walked: list[_Made] = []
    for n, place in walks.items():
        own = (surfaces[n],)
        if limbs[n].is_arm:
            own = sorted(limbs[n].surfaces, key=lambda s: s != on[n].surface)
        _make(task, key, option, wanted, own, place, walked)
    for outer in (False, True):
        made = list(walked)
        for n in hops if outer else ():
            if not limbs[n].is_arm and on[n].surface == surfaces[n]:
                here = Place(support=on[n].support, position=on[n].position)
                _make(task, key, option, wanted, limbs[n].surfaces[:1], here, made)
        before = len(made)
        for n, place in hops.items():
            own = (surfaces[n],)
            if outer:
                own = limbs[n].surfaces[:: 1 if limbs[n].is_arm else -1]
            _make(task, key, option, wanted, own, place, made)
        if len(made) == before + len(hops):
            return made
    return made if len(made) > before else walked


def _due_near_gap(
    task: _Task,
    platform: Platform,
    on: Mapping[str, Contact],
    surfaces: Mapping[str, str],
    frame: _Frame,
    wanted: _Frame,
) -> tuple[dict[str, Place], dict[str, Place]]:
    """The limbs that are next near a gap, which step on a box, and which across.

    Each limb has its place in a body that is stretched, and goes on along the way. Over
    a gap, its place is the nearer border: it waits at the one until it is due at the
    other. The body goes on by a step from where the first limb is due, or until some
    are due across; what is due first steps first. Both are empty far from a gap.
    """
    step = _crawl_step(task)
    length = float(np.linalg.norm(wanted.xy - frame.xy))
    way = (wanted.xy - frame.xy) / max(length, 1e-9)
    at = {n: float((c.position[:2] - frame.xy) @ way) for n, c in on.items()}
    gaps = _gaps_ahead(platform, tuple(on.values()), wanted.xy)
    if len(on) < len(surfaces) or not gaps:
        return {}, {}
    if gaps[0][0] > max(at.values()) - min(at.values()) + step:
        return {}, {}
    offsets = {
        n: np.array([math.copysign(task.build.stretch, o[0]), o[1]])
        for n, o in task.build.fours.items()
    }

    def place(n: str, x: float) -> Place:
        xy = _Frame(frame.xy + x * way, wanted.yaw).at(offsets[n])
        return _place(task, platform, surfaces[n], xy, platform.boxes)

    x = min(at[n] - offsets[n][0] for n in surfaces)
    walks: dict[str, float] = {}
    hops: dict[str, float] = {}
    last = math.inf
    while x < min(length, last):
        x += SAME
        for n in surfaces:
            to = place(n, x)
            ahead = float((to.position[:2] - frame.xy) @ way) - at[n]
            if ahead > SAME and to.support != on[n].support:
                hops.setdefault(n, x)
            elif ahead > SAME and n not in hops:
                walks.setdefault(n, x)
            if ahead > SAME:  # where the first is due, it is that far ahead already
                last = min(last, x + step - 2.0 * SAME)
    if hops:  # those of the first that is due, both arms or both legs
        x, first = min((d, n) for n, d in hops.items())
        limbs = task.ik.world.robot.limbs
        arms = limbs[first].is_arm
        hops = {n: d for n, d in hops.items() if limbs[n].is_arm == arms}
    walks = {n: d for n, d in walks.items() if d <= x and n not in hops}
    return (
        {n: place(n, x) for n in sorted(walks, key=lambda n: walks[n])},
        {n: place(n, hops[n]) for n in sorted(hops, key=lambda n: hops[n])},
    )


def _make(
    task: _Task,
    key: Keyframe,
    option: Option,
    body: _Frame,
    surfaces: Sequence[str],
    place: Place,
    made: list[_Made],
) -> None:
    """Add to `made`, which begins at `key`, a contact by the first surface that can."""
    key = made[-1][0].keyframe if made else key
    for surface in surfaces:
        found = _attempt(task, key, surface, place, body, task.fours, imposed=False)
        if not isinstance(found, str):
            made.append((found, option.name))
            return


def _twice(
    task: _Task,
    key: Keyframe,
    platform: Platform,
    option: Option,
    body: _Frame,
    surfaces: Sequence[str],
) -> tuple[list[_Made], list[str], str]:
    """A cycle whose surfaces that cannot move yet are tried again once others have.

    Then shorter too. What was made, which surfaces are left, and why the last of them.
    """
    made: list[_Made] = []
    left, why = _cycle(task, key, platform, option, body, surfaces, made, first=True)
    if left:
        now = made[-1][0].keyframe if made else key
        left, why = _cycle(task, now, platform, option, body, left, made)
    return made, left, why


def _cycle(
    task: _Task,
    key: Keyframe,
    platform: Platform,
    option: Option,
    body: _Frame,
    surfaces: Sequence[str],
    made: list[_Made],
    *,
    first: bool = False,
    back: bool = False,
) -> tuple[list[str], str]:
    """Move some contacts of a cycle; those that cannot be, and why the last of them.

    Args:
        task: What does not change.
        key: Where to go on from.
        platform: On which.
        option: The cycle.
        body: Where the body shall get to.
        surfaces: To move, in order.
        made: Receives what was found.
        first: All the way or not at all, the pelvis as the policy has it.
        back: Those that climbed a riser stay above it.
    """
    left, why = [], ""
    tops = {n: task.ik.world.supports[n].position[2] for n in platform.boxes}
    for surface in surfaces:
        limb = task.ik.world.robot.limb_of(surface).name
        here = _by_limb(task, key.stance).get(limb)
        low = tops[here.support] - FLUSH if back and here else -math.inf
        boxes = [n for n in platform.boxes if tops[n] >= low]
        wanted = body.at(task.build.fours[limb])
        place = _place(task, platform, surface, wanted, boxes)
        if (
            here is not None
            and surface == here.surface
            and np.linalg.norm(place.position - here.position) < SAME
        ):
            continue
        found = _attempt(
            task,
            key,
            surface,
            place,
            body,
            task.fours,
            shares=SHRUNK[:1] if first else SHRUNK,
            imposed=first,
        )
        if isinstance(found, str):
            left.append(surface)
            why = found
            continue
        key = found.keyframe
        made.append((found, option.name))
    return left, why


def _leading_first(
    task: _Task, option: Option, frame: _Frame, full: _Frame
) -> tuple[str, ...]:
    """The cycle, begun with the limbs that are ahead on the way: arms, or legs.

    Where elbows follow knees and step first, what bears the robot shrinks.
    """
    way = turn_about_z(frame.yaw).T @ (full.xy - frame.xy)
    arms_lead = way[0] > -1e-6
    robot = task.ik.world.robot
    leads = [robot.limb_of(s).is_arm == arms_lead for s in option.surfaces]
    k = leads.index(True) if True in leads else 0
    return option.surfaces[k:] + option.surfaces[:k]


# One contact.


def _attempt(
    task: _Task,
    key: Keyframe,
    surface: str,
    place: Place,
    body: _Frame,
    reference: np.ndarray | None,
    *,
    shares: Sequence[float] = SHRUNK,
    imposed: bool = True,
) -> Change | str:
    """Move one contact to a place, or part of the way there; or why not.

    A limb without a contact is set down there.
    """
    world = task.ik.world
    limb = world.robot.limb_of(surface)
    here = _by_limb(task, key.stance).get(limb.name)
    why = ""
    for share in shares:
        position = place.position
        if share < 1.0:
            if here is None or here.support != place.support:
                break
            position = here.position + share * (place.position - here.position)
        contact = _contact(
            world, surface, Place(support=place.support, position=position), body.yaw
        )
        breaks = () if here is None else (here.surface,)
        step = Step(
            limb=limb.name,
            breaks=breaks,
            makes=contact,
            fixed=True,
            base_rotation=_pelvis(task, key, body) if imposed else None,
            reference=reference,
        )
        options = task.options
        found = change_contact(task.ik, key, step, options.keyframe, options.method)
        if isinstance(found, Change):
            return found
        why = str(found)
    return why


def _pelvis(task: _Task, key: Keyframe, body: _Frame) -> np.ndarray | None:
    """(3, 3) how the pelvis should be held [algorithm 3, step 14]; None on the ground.

    As it is, turned the way that the body faces, its roll within what the policy
    imposes. Pitch is left to the robot: a person, whose thighs are longer than the
    upper arms, crawls with the hips high, and a robot of another build that is held so
    has its weight on its elbows and cannot lift them.
    """
    platform = _platform_of(task, key.stance)
    if platform is None:
        return None
    kin = task.ik.kin
    kin.update(key.q)
    R = kin.rotation(task.ik.world.base)
    position = np.array([*body.xy, key.q[2]])
    held = pelvis_distribution(
        task.policy, platform.edges, position, near=task.build.thigh
    )
    angles = pelvis_angles(R)
    if held is not None:
        angles[0] = held.clip(angles)[0]
    return pelvis_rotation(np.array([angles[0], angles[1], body.yaw]))


def _contact(world: World, surface: str, place: Place, yaw: float) -> Contact:
    R = np.eye(3)
    R[:2, :2] = turn_about_z(yaw)
    return Contact(
        surface=surface,
        support=place.support,
        position=world.supports[place.support].project(place.position),
        quaternion=quat_from_matrix(R),
    )


def _place(
    task: _Task,
    platform: Platform,
    surface: str,
    wanted: np.ndarray,
    boxes: Sequence[str],
) -> Place:
    """Where on some boxes of the platform a surface can rest, nearest to `wanted`."""
    world = task.ik.world
    beside = world.surfaces[surface].radius + CLEAR
    if _rises(task, platform) and not world.robot.limb_of(surface).is_arm:
        beside = max(beside, BEFORE_RISER * task.build.thigh)
    place = find_place(world.scene, tuple(boxes), wanted, beside)
    if place is not None:
        return place
    top = world.supports[boxes[0]]
    return Place(support=top.name, position=top.project(np.array([*wanted, 0.0])))


def _apart(a: float, b: float) -> float:
    """From one yaw to another, the short way [rad]."""
    return math.remainder(b - a, 2.0 * math.pi)


# The robot's build, and what cannot be.


def _tasks(ik: IK, policy: GeneralPolicy, options: PlanOptions) -> tuple[_Task, ...]:
    """Of the policy, and of its secondary ones that know how to go on on top."""
    others = (p for p in policy.secondary if any(o.region == "O" for o in p.options))
    return tuple(_task(ik, p, options) for p in (policy, *others))


def _task(ik: IK, policy: GeneralPolicy, options: PlanOptions) -> _Task:
    scene = ik.world.scene
    goal = goal_of(scene)
    yaw = scene.goal
    build = build_of(ik, policy)
    return _Task(
        ik=ik,
        policy=policy,
        options=options,
        platforms=find_platforms(scene, goal),
        goal=goal,
        goal_yaw=float(yaw[2]) if yaw is not None and len(yaw) == 3 else None,
        build=build,
        fours=_posture_on_fours(ik, policy, build),
    )


def _posture_on_fours(ik: IK, policy: GeneralPolicy, build: Build) -> np.ndarray:
    """(nq,) the robot on elbows and knees, held as the policy holds its pelvis.

    What steps on all fours stay near to, so that twists do not add up.
    """
    world = ik.world
    option = next((o for o in policy.options if o.region == "O"), None)
    if option is None:
        return world.home
    frame = _Frame(world.scene.start[:2], float(world.scene.start[2]))
    up = {}
    for surface in option.surfaces:
        xy = frame.at(build.fours[world.robot.limb_of(surface).name])
        place = Place(support=GROUND, position=np.array([*xy, 0.0]))
        up[surface] = _contact(world, surface, place, frame.yaw)
    held = pelvis_rotation(np.array([0.0, LEAN, frame.yaw]))
    q = world.home.copy()
    q[3:7] = quat_from_matrix(held)
    q[2] *= 0.7
    problem = PostureProblem(
        goals=tuple(held_goal(world, c) for c in up.values()),
        q_reference=world.home,
        clearance=_own_clearance(world),
        base_rotation=held,
    )
    return ik.solve_hard(problem, q).q


def _own_clearance(world: World) -> np.ndarray:
    """(P,) the robot keeps off itself; the scene does not count."""
    own = (world.model.geom_bodyid[world.pairs] > 0).all(axis=1)
    return np.where(own, CLEARANCE, -np.inf)


def _check_route(task: _Task) -> None:
    """A scene that cannot be crossed from where the robot stands.

    Raises:
        InputError: The policy has no cycle on top, or the first obstacle is too far.
    """
    world = task.ik.world
    regions = [o.region for o in task.policy.options]
    if task.platforms and "O" not in regions:
        raise InputError(
            "a policy with a cycle on the obstacle (region O)",
            field="policy.options",
            value=regions,
        )
    for name in (b for p in task.platforms for b in p.boxes):
        top = float(world.supports[name].position[2])
        if top > task.build.tall:
            raise InputError(
                f"a top within {task.build.tall:.2f} m, what the robot reaches, between"
                " start and goal",
                field=f"scene.boxes.{name}",
                value=f"{top:.2f} m high",
            )
    if not task.platforms:
        return
    first = task.platforms[0].entry
    away = -first.distance(np.array([*world.scene.start[:2], 0.0]))
    if away > task.build.reach:
        walk = away - task.build.stand
        raise InputError(
            f"an obstacle within {task.build.reach:.2f} m, the robot's reach: it must"
            f" first walk {walk:.2f} m",
            field=f"scene.boxes.{task.platforms[0].boxes[0]}",
            value=f"{away:.2f} m away",
        )
