"""A contact sequence or a policy becomes a trajectory, from wherever the robot is.

sequence -> robot's scale -> steps -> contact changes -> trajectory

A sequence is planned as it was demonstrated; where that does not lead to its end, with
other surfaces of the same limbs (`substitutes`): the best of the alternatives; elbows
in place of hands; contacts that are searched for (`free`), from where the plan that
came farthest is stuck, and from the start. A policy proposes contacts by itself.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Literal

import numpy as np

from clamber.contact.contact import ContactSequence, Stance
from clamber.contact.policy import GeneralPolicy
from clamber.contact.scaling import retarget
from clamber.contact.steps import split_steps
from clamber.errors import InputError, Status
from clamber.model.arguments import checks_types
from clamber.model.progress import Progress, silent
from clamber.model.records import short_repr
from clamber.model.robot import RobotLike, load_robot
from clamber.model.scene import Scene
from clamber.model.terrain import SceneLike, load_scene
from clamber.model.world import build_world
from clamber.planning.demonstrated import VARIATIONS, follow_steps
from clamber.planning.diagnose import check_reach, check_start
from clamber.planning.free import Counts, action_counts, search_contacts, sequence_of
from clamber.planning.records import (
    Budget,
    Fallback,
    Plan,
    PlanOptions,
    Route,
    Source,
    State,
    Tried,
    numbered,
    summary,
)
from clamber.planning.search import Search
from clamber.planning.start import from_here, from_standing, settle, steps_done
from clamber.planning.substitutes import (
    Alternative,
    contact_alternatives,
    contact_differences,
    plan_cost,
    stand_ins,
)
from clamber.planning.trajectory import timed
from clamber.planning.traverse import follow, followers_of
from clamber.step.change import Failure, standing
from clamber.step.ik import IK, NO_EXTRA, ExtraClearance
from clamber.step.path import Phase
from clamber.step.posture import Keyframe

Start = State | Keyframe

# [rad/s] At this speed a climb takes an hour, and 1000 samples a second of it are kept.
SLOWEST = 0.003


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Ranked:
    """A planned alternative.

    Attributes:
        surfaces: The surfaces that were chosen; for a plan found by search, those that
            make contacts, in order.
        source: Where the contacts come from.
        plan: The plan, complete or not.
        cost: Swing distances plus projected distances, see `plan_cost` [m].
    """

    surfaces: tuple[str, ...]
    source: Source
    plan: Plan
    cost: float

    __repr__ = short_repr

    @property
    def stable(self) -> bool:
        """Every step has a stable posture and a path."""
        return self.plan.complete


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Replanned:
    """The alternatives to the demonstrated contacts, planned and ranked.

    Attributes:
        differences: For each stance after the first, the surfaces that the first has
            not.
        ranked: The alternatives, the best first.
        tried: Each proposer, with the number of steps that it tried.
    """

    differences: tuple[tuple[str, ...], ...]
    ranked: tuple[Ranked, ...]
    tried: tuple[Tried, ...]

    __repr__ = short_repr

    @property
    def best(self) -> Ranked:
        """The first one."""
        return self.ranked[0]


@checks_types
def plan(
    goal: ContactSequence | GeneralPolicy,
    robot: RobotLike,
    scene: SceneLike,
    *,
    start: Start | None = None,
    options: PlanOptions | None = None,
    contacts: Literal["any", "demonstrated"] = "any",
    budget: Budget | None = None,
    counts: Counts | None = None,
    clearance: ExtraClearance = NO_EXTRA,
    progress: Progress | None = None,
) -> Plan:
    """Plan the whole motion, or what is left of it.

    Args:
        goal: A demonstrated contact sequence, or a policy that leads to the goal of the
            scene.
        robot: A robot, its name, or its `robot.yaml`.
        scene: A scene, its file, or the height of one box [m]; in the middle of a
            climb, the scene as it is believed to be.
        start: The state of a robot in the middle of a climb, or the keyframe to go on
            from; None: it stands at the scene's start. From the middle of a climb,
            extra clearance for roughness or by `clearance` is given up where there is
            no path that keeps it.
        options: How it is planned.
        contacts: `any`: other contacts where the demonstrated ones do not lead to the
            end, `Plan.fallback` says which, or what was tried; `demonstrated`: none.
        budget: How much is tried in search of other contacts.
        counts: How often demonstrations take each action, which guides that search;
            None: as often as this one does.
        clearance: Extra distance [m] of links from supports, see `IK`.
        progress: Called with stage, share and note.

    Raises:
        InputError: The scene does not fit the sequence or the policy, or is out of the
            robot's reach; the robot cannot stand there.
    """
    options, robot, scene = _checked(options), load_robot(robot), load_scene(scene)
    report, budget, clock = progress or silent, budget or Budget(), _Clock()

    def task(scene: Scene, clearance: ExtraClearance) -> _Task:
        ik = IK(build_world(robot, scene), clearance)
        return _Task(goal, Search(ik, options, budget, report), start, counts, clock)

    here = task(scene, clearance)
    found = here.asked_for()
    rough = any(b.roughness > 0 for b in (*scene.boxes, *scene.meshes))
    if found.failures and start is not None and (clearance or rough):
        boxes = tuple(replace(b, roughness=0.0) for b in scene.boxes)
        meshes = tuple(replace(m, roughness=0.0) for m in scene.meshes)
        nearer = task(replace(scene, boxes=boxes, meshes=meshes), NO_EXTRA)
        other = nearer.asked_for()
        if not other.failures or len(other.changes) > len(found.changes):
            here, found = nearer, other
    if contacts == "any" and found.failures:
        found = here.fallback(found)
    return here.timed(found)


@checks_types
def replan(
    sequence: ContactSequence,
    robot: RobotLike,
    scene: SceneLike,
    *,
    options: PlanOptions | None = None,
    budget: Budget | None = None,
    counts: Counts | None = None,
    progress: Progress | None = None,
) -> Replanned:
    """Plan every alternative and rank them; search where none is stable.

    Args:
        sequence: The demonstrated contact sequence.
        robot: A robot, its name, or its `robot.yaml`.
        scene: A scene, its file, or the height of one box [m].
        options: How each is planned.
        budget: How much the search tries.
        counts: As in `plan`.
        progress: Called with stage, share and note.

    Raises:
        InputError: The scene does not fit the sequence, or is out of the robot's reach.
    """
    clock, ik = _Clock(), IK(build_world(robot, scene))
    search = Search(ik, _checked(options), budget, progress or silent)
    task = _Task(sequence, search, None, counts, clock)
    ranked = [replace(r, plan=task.timed(r.plan)) for r in task.ranked(None)]
    return Replanned(
        differences=contact_differences(sequence),
        ranked=tuple(ranked),
        tried=summary(search.attempts),
    )


def _checked(options: PlanOptions | None) -> PlanOptions:
    """The options, or the usual ones.

    Raises:
        InputError: The speed or an option of the keyframes is none to plan with.
    """
    options = options or PlanOptions()
    if options.speed != "max" and not options.speed >= SLOWEST:
        text = f"a joint speed of at least {SLOWEST} rad/s, or max"
        raise InputError(text, field="speed", value=options.speed)
    for f in fields(options.keyframe):
        value = getattr(options.keyframe, f.name)
        if not 0 <= value < math.inf:
            raise InputError("a number of 0 or more", field=f.name, value=value)
    return options


class _Task:
    """What is to be planned in one world, and where it begins.

    Its plans have no trajectory until one of them is chosen (`timed`).
    """

    def __init__(
        self,
        goal: ContactSequence | GeneralPolicy,
        search: Search,
        start: Start | None,
        counts: Counts | None,
        clock: _Clock,
    ) -> None:
        """Stand up, or settle in the stance as it is."""
        self._goal, self._search, self._counts = goal, search, counts
        self._ik, self._options = search.ik, search.options
        self._state = start if isinstance(start, State) else None
        self._from_standing = start is None
        self._lead: tuple[Phase, ...] = ()
        self._unsettled: tuple[Failure, ...] = ()
        self._clock = clock
        if isinstance(start, State):
            self._start, self._lead = settle(self._ik, start, self._options)
            status = self._start.status
            if status is not Status.SOLVED:
                why = f"no stable posture here: {status.value}"
                self._unsettled = (Failure(status=status, detail=why),)
        elif start is not None:
            self._start = start
        else:
            if isinstance(goal, ContactSequence):
                check_reach(self._ik)
            self._start = standing(self._ik, self._options.keyframe)
            check_start(self._ik, self._start)

    def asked_for(self) -> Plan:
        """As demonstrated, or as the policy has it."""
        if isinstance(self._goal, GeneralPolicy):
            return self._followed(self._goal)
        return self._planned(self._search, self._goal)

    def timed(self, found: Plan) -> Plan:
        """A plan with its trajectory."""
        self._search.part = ""
        self._search.report("trajectory", 0.0, "")
        self._clock.lap("search")
        speed = self._options.speed
        trajectory = timed(self._ik, found.changes, speed, self._lead)
        self._clock.lap("trajectory")
        return replace(found, trajectory=trajectory, timings={**self._clock.laps})

    def _plan(
        self, sequence: ContactSequence, route: Route, state: State | None
    ) -> Plan:
        moves = bool(route.changes) or not self._from_standing
        return Plan(
            world=self._ik.world,
            options=self._options,
            sequence=sequence,
            start=route.start,
            changes=route.changes,
            failures=route.failures,
            trajectory=None,
            complete=route.arrived and moves,
            state=state,
        )

    def _planned(
        self,
        search: Search,
        sequence: ContactSequence,
        proposer: str = "demonstrated",
        weights: int | None = None,
    ) -> Plan:
        """The steps of a sequence that are left, with so many of the weights."""
        world, state = self._ik.world, self._state
        goal = retarget(sequence, search.ik.kin)
        steps, skipped = split_steps(goal, world)
        if state is not None:
            if proposer != "demonstrated":
                done = steps_done(goal, steps, state.stance, world)
                state = replace(state, done=done)
            steps, skipped = from_here(steps, state.done, state.stance, world), []
        if self._unsettled:
            route = Route(start=self._start, failures=self._unsettled)
            return self._plan(goal, route, state)
        variations = VARIATIONS[:weights]
        route, used = follow_steps(search, self._start, steps, proposer, variations)
        found = self._plan(goal, route, state)
        return replace(found, options=used, skipped=tuple(skipped))

    def _followed(self, policy: GeneralPolicy) -> Plan:
        """A policy from the stance that the robot is in."""
        options, search = self._options, self._search
        followers = followers_of(search, policy)
        if self._from_standing:
            followers[0].gait.check_route()
        most, ahead = options.max_changes, search.budget.ahead
        most = 0 if self._unsettled else most if ahead is None else ahead
        found = follow(followers, self._start, most)
        stances = tuple(Stance(contacts=k.stance) for k in found.route.keyframes)
        sequence = ContactSequence(
            source="; ".join(policy.sources) or "a policy",
            subject=None,
            scene=self._ik.world.scene,
            stances=stances,
            t=np.arange(len(stances) + 1.0),
        )
        failures = (*self._unsettled, *found.route.failures)
        changes = numbered(found.route.changes)
        route = replace(found.route, changes=changes, failures=failures)
        return replace(
            self._plan(sequence, route, self._state),
            fallback=found.fallback,
            policy=policy,
            iterations=found.iterations,
        )

    def fallback(self, first: Plan) -> Plan:
        """The best of other contacts; else `first`, and what was tried."""
        if isinstance(self._goal, GeneralPolicy):
            return first  # it has its own
        if self._unsettled:
            return first
        reason = f"no stable plan as demonstrated ({first.failures[0]})"
        best = self.ranked(first)[0]
        tried = summary(self._search.attempts)
        if not best.stable:
            if self._search.late:
                seconds, n = self._search.budget.seconds, len(self._search.attempts)
                reason += f"; the {seconds:g} s allowed are spent, {n} steps tried"
            return replace(first, fallback=Fallback(reason=reason, tried=tried))
        fallback = Fallback(
            reason=reason, source=best.source, surfaces=best.surfaces, tried=tried
        )
        return replace(best.plan, fallback=fallback)

    def ranked(self, first: Plan | None) -> list[Ranked]:
        """Alternatives; where none is stable, stand-ins; then what the search finds.

        What is stable comes first, by cost; equal ones as they were planned.

        Args:
            first: The plan of the demonstrated contacts, where there is one. Where no
                limb offers several surfaces, that is the only alternative.
        """
        out = list(self._others(first))
        return sorted(out, key=lambda r: (not r.stable, r.cost))

    def _others(self, first: Plan | None) -> Iterator[Ranked]:
        sequence, robot = self._goal, self._ik.world.robot
        assert isinstance(sequence, ContactSequence)
        others = contact_alternatives(sequence, robot)
        if first is not None and not others[0].surfaces:
            planned = [first]  # it is the only one
        else:
            jobs = [
                self._job(a, f"alternative {k} of {len(others)}")
                for k, a in enumerate(others, start=1)
            ]
            planned = self._search.each(jobs)
        for a, found in zip(others, planned, strict=True):
            yield _ranked(a.surfaces, "alternatives", found)
        if any(p.complete for p in planned):
            return
        for a in stand_ins(sequence, robot):
            job = self._job(a, "elbows in place of hands", 1)
            planned.append(job(self._search))
            yield _ranked(a.surfaces, "alternatives", planned[-1])
            if planned[-1].complete:
                return
        if self._search.budget.tries > 0:
            yield from self._searched(planned)

    def _job(
        self, a: Alternative, part: str, weights: int | None = None
    ) -> Callable[[Search], Plan]:
        """Planning an alternative, which is a part of all that is tried."""
        name = ", ".join(a.surfaces) or "demonstrated"

        def job(search: Search) -> Plan:
            search.part = f"{part} ({name})"
            return self._planned(search, a.sequence, name, weights)

        return job

    def _searched(self, made: Sequence[Plan]) -> Iterator[Ranked]:
        """What is found from where the farthest plan is stuck, or from the start."""
        assert isinstance(self._goal, ContactSequence)
        goal = retarget(self._goal, self._ik.kin)
        counts = self._counts
        if counts is None:
            counts = action_counts(goal, self._ik.world)
        stuck = max(map(_before_failure, made), key=lambda x: len(x.changes))
        begin = Route(start=self._start)
        starts = (stuck, begin) if stuck.changes else (begin,)
        for k, start in enumerate(starts, start=1):
            self._search.part = f"other contacts, search {k} of {len(starts)}"
            route = search_contacts(self._search, start, goal, counts)
            if route.arrived:
                found = self._searched_for(route)
                makes = [c.step.makes for c in found.changes]
                surfaces = tuple(c.surface for c in makes if c is not None)
                yield _ranked(surfaces, "search", found)
                return

    def _searched_for(self, route: Route) -> Plan:
        """The plan of contacts that were searched for, with a sequence of its own."""
        sequence, state, k = sequence_of(self._ik.world, route), self._state, 0
        if state is not None:
            sequence, k = from_standing(self._ik, sequence, self._options)
            state = replace(state, done=k)
        first = len(sequence.stances) - len(route.changes)
        route = replace(route, changes=numbered(route.changes, k, first))
        return self._plan(sequence, route, state)


def _ranked(surfaces: tuple[str, ...], source: Source, found: Plan) -> Ranked:
    return Ranked(surfaces=surfaces, source=source, plan=found, cost=plan_cost(found))


def _before_failure(made: Plan) -> Route:
    """What a plan does before the first step that it misses."""
    steps = [f.step for f in made.failures if f.step is not None]
    first = min((s.index for s in steps if s.index is not None), default=math.inf)
    changes = [c for c in made.changes if (c.step.index or 0) < first]
    return Route(start=made.start, changes=tuple(changes))


class _Clock:
    """Seconds by stage."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self.laps[stage] = self.laps.get(stage, 0.0) + now - self._last
        self._last = now
