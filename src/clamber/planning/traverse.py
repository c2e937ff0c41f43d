"""General policy + scene -> plan: what its gait proposes is tried, one after the other.

Each proposal is tried by the ordinary search, the first one that is accepted is taken,
and the gait is asked again from the stance that it leads to, until it has arrived.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from clamber.contact.contact import Contact
from clamber.contact.policy import GeneralPolicy, pelvis_rotation
from clamber.contact.steps import Step
from clamber.errors import Status
from clamber.model.records import short_repr
from clamber.model.scene import GROUND
from clamber.model.se3 import quat_from_matrix
from clamber.model.world import World
from clamber.planning.demonstrated import follow_steps
from clamber.planning.gait import Gait
from clamber.planning.proposals import (
    Climb,
    Goal,
    Made,
    Outcome,
    Proposal,
    Round,
    pursue,
    stuck,
)
from clamber.planning.records import Fallback, Iteration, Route
from clamber.planning.route import Frame, contact_at
from clamber.planning.search import Search
from clamber.step.change import Change, Failure, home_at, standing
from clamber.step.ik import IK, PostureProblem, contact_clearance
from clamber.step.posture import CLEARANCE, Keyframe
from clamber.step.tasks import closed

# Manoeuvres in a row that bring the goal nearer by less than the second [m] are given
# up: to turn around on the spot takes 13.
PATIENCE, NEARER_BY = 20, 0.01
LEAN = np.radians(80.0)  # of the trunk on all fours
OVER_MIDDLE = 3.0  # weight of the centre of mass between hands and feet, on stairs


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Followed:
    """Result of following a policy.

    Attributes:
        route: As far as it goes; neither arrived nor failed where it was cut short.
        iterations: One for each change.
        fallback: Where a secondary policy was followed, and why; None: nowhere.
    """

    route: Route
    iterations: tuple[Iteration, ...]
    fallback: Fallback | None

    __repr__ = short_repr


def cost_to_go(stance: Sequence[Contact], goal: np.ndarray) -> float:
    """From the mean of all contacts to the goal (2,) [m] [algorithm 3, step 11]."""
    middle = np.mean([c.position[:2] for c in stance], axis=0)
    return float(np.linalg.norm(goal - middle))


class Follower:
    """A gait whose proposals are tried.

    Attributes:
        search: What tries.
        gait: What proposes.
    """

    def __init__(self, search: Search, gait: Gait) -> None:
        """Look at the robot on all fours once."""
        self.search, self.gait = search, gait
        self._quadrupedal = quadrupedal_posture(search.ik, gait)

    def next_changes(self, key: Keyframe) -> tuple[Made, Failure | None]:
        """The next contact changes, or why there are none; neither at the goal."""

        def attempt(proposal: Proposal | Climb) -> Outcome:
            is_climb = isinstance(proposal, Climb)
            return self._climb(proposal) if is_climb else self._make(proposal)

        return pursue(self.gait.propose(Outcome(key=key)), attempt)

    def _climb(self, climb: Climb) -> Outcome:
        """All steps of a climb, or none."""
        start, steps = climb.after.key, [step for step, _ in climb.steps]
        if climb.start is not None:
            options = self.search.options.keyframe
            start = standing(self.search.ik, options, climb.start)
        route, _ = follow_steps(self.search, start, steps, "gait")
        failure = next(iter(route.failures), None)
        if not steps:
            failure = stuck("no steps up the obstacle are left to try")
        if failure is not None:
            return Outcome(key=route.end, failure=failure)
        options = (option for _, option in climb.steps)
        made = zip(route.changes, options, strict=True)
        return Outcome(key=route.end, changes=tuple(made))

    def _make(self, proposal: Proposal) -> Outcome:
        """The goals of a proposal that can be made."""
        key, changes = proposal.after.key, [*proposal.after.changes]
        left, failure = list(proposal.goals), None
        for how in proposal.rounds:
            goals, left, failure = left, [], None
            for goal in goals:
                found = self._reach(key, goal, proposal, how)
                if isinstance(found, Change):
                    key = found.keyframe
                    changes.append((found, goal.option))
                else:
                    left.append(goal)
                    failure = found
        surfaces = tuple(goal.contacts[0].surface for goal in left)
        return Outcome(key=key, changes=tuple(changes), left=surfaces, failure=failure)

    def _reach(
        self, key: Keyframe, goal: Goal, proposal: Proposal, how: Round
    ) -> Change | Failure | None:
        """The first contact of a goal that can be made, or why not the last."""
        found, ik, world = None, self.search.ik, self.search.ik.world
        limb = world.robot.limb_of(goal.contacts[0].surface)
        breaks = tuple(c.surface for c in key.stance if c.surface in limb.surfaces)
        pelvis = self.gait.pelvis(key, proposal.body) if how.pelvis else None
        reference = self._quadrupedal
        if proposal.posture == "home":
            reference = home_at(world, self.gait.ankles(proposal.body))
        for contact in goal.contacts[: 1 if how.first else None]:
            self.search.note(f"{goal.option}: {contact.surface} on {contact.support}")
            if proposal.posture == "upright":
                reference = upright_posture(ik, key, contact)
            step = Step(
                limb=limb.name,
                breaks=breaks,
                makes=contact,
                fixed=True,
                base_rotation=pelvis,
                reference=reference,
            )
            found = self.search.change("gait", key, step)
            if isinstance(found, Change):
                return found
        return found


def followers_of(search: Search, policy: GeneralPolicy) -> list[Follower]:
    """Followers of a policy and of its secondary policies that have a cycle on top."""
    others = [p for p in policy.secondary if any(o.region == "O" for o in p.options)]
    world = search.ik.world
    return [Follower(search, Gait(world, p)) for p in (policy, *others)]


def follow(followers: Sequence[Follower], start: Keyframe, most: int) -> Followed:
    """Go on from a keyframe, by so many contact changes at most.

    Where the first of the followers has no stable step, the others are asked; then the
    first is asked again.
    """
    goal, search = followers[0].gait.goal, followers[0].search
    changes: list[Change] = []
    iterations: list[Iteration] = []
    others: list[str] = []
    failure: Failure | None = None
    first, best, arrived = cost_to_go(start.stance, goal), math.inf, False
    since: list[tuple[Contact, ...]] = []  # stances since it last got nearer
    while not arrived and failure is None and len(changes) < most:
        key = changes[-1].keyframe if changes else start
        to_go = cost_to_go(key.stance, goal)
        nearer = to_go <= best - NEARER_BY
        best = to_go if nearer else min(best, to_go)
        since = [*(() if nearer else since), key.stance]
        if len(since) > PATIENCE + 1:
            why = f"{PATIENCE} cycles bring it no nearer to the goal, {to_go:.2f} m"
            failure = stuck(why)
            break
        if any(_is_same(since[-1], stance) for stance in since[:-1]):
            why = f"it moves back and forth, {to_go:.2f} m from the goal"
            failure = stuck(why)
            break
        if search.late:
            failure = Failure(status=Status.BUDGET)
            break
        note = f"{to_go:.2f} m to go, {len(changes)} contact changes"
        search.report("plan", 1.0 - min(to_go / max(first, 1e-9), 1.0), note)
        made, failure = followers[0].next_changes(key)
        arrived = not made and failure is None
        name = ""
        for k, other in enumerate(followers[1:], start=1):
            if failure is None:
                break
            made, _ = other.next_changes(key)
            if made:
                name = f"secondary {k}"
                others.append(f"{name} from change {len(changes) + 1} on ({failure})")
                failure = None
        for change, option in made:
            changes.append(change)
            cost = cost_to_go(change.keyframe.stance, goal)
            label = f"{option}, {name}" if name else option
            iterations.append(Iteration(option=label, cost=cost))
    limit = search.options.max_changes
    if not arrived and failure is None and len(changes) >= limit:
        failure = stuck(f"{limit} contact changes were not enough")
    route = Route(
        start=start,
        changes=tuple(changes),
        failures=() if failure is None else (failure,),
        arrived=arrived,
    )
    fallback = None
    if others:
        reason = "" if failure is None else str(failure)
        detail = "; ".join(others)
        fallback = Fallback(reason=reason, source="secondary", detail=detail)
    return Followed(route=route, iterations=tuple(iterations), fallback=fallback)


def _is_same(a: Sequence[Contact], b: Sequence[Contact]) -> bool:
    """The same surfaces are where they were: what came next will come again."""
    there = {c.surface: c.position for c in b}
    return {c.surface for c in a} == set(there) and all(
        np.linalg.norm(c.position - there[c.surface]) < NEARER_BY for c in a
    )


def quadrupedal_posture(ik: IK, gait: Gait) -> np.ndarray:
    """(nq,) the robot on elbows and knees, its trunk level.

    What steps on all fours stay near to, so that twists do not add up.
    """
    world = ik.world
    if gait.cycle.region != "O":
        return world.home
    frame = Frame(world.scene.start[:2], float(world.scene.start[2]))
    contacts = []
    for surface in gait.cycle.surfaces:
        xy = frame.at(gait.proportions.offsets[world.robot.limb_of(surface).name])
        point = np.array([*xy, 0.0])
        contacts.append(contact_at(surface, world.supports[GROUND], point, frame.yaw))
    held = pelvis_rotation(np.array([0.0, LEAN, frame.yaw]))
    q = world.home.copy()
    q[3:7] = quat_from_matrix(held)
    q[2] *= 0.7
    # The robot keeps off itself; the scene does not count.
    own = (world.model.geom_bodyid[world.pairs] > 0).all(axis=1)
    problem = PostureProblem(
        tasks=tuple(closed(world, c) for c in contacts),
        q_reference=world.home,
        clearance=np.where(own, CLEARANCE * world.length_scale, -np.inf),
        base_rotation=held,
    )
    return ik.solve_hard(problem, q).q


def upright_posture(ik: IK, key: Keyframe, new: Contact) -> np.ndarray:
    """(nq,) with a contact made, the weight between the arms' contacts and the legs'.

    What the postures on stairs stay near to: legs that come after the hands otherwise
    push the body over them.
    """
    world = ik.world
    limb = world.robot.limb_of(new.surface)
    stance = [c for c in key.stance if c.surface not in limb.surfaces]
    stance.append(new)
    where = {c.surface: c.support for c in stance}
    problem = PostureProblem(
        tasks=tuple(closed(world, c) for c in stance),
        q_reference=key.q,
        clearance=contact_clearance(world, CLEARANCE * world.length_scale, where),
        com_target=middle_of(world, stance),
        com_weight=OVER_MIDDLE,
    )
    return ik.solve(problem, key.q).q


def middle_of(world: World, stance: Sequence[Contact]) -> np.ndarray:
    """(2,) half-way between the arms' contacts and the legs'."""
    kinds: dict[bool, list[np.ndarray]] = {}
    for c in stance:
        arm = world.robot.limb_of(c.surface).is_arm
        kinds.setdefault(arm, []).append(c.position[:2])
    return np.mean([np.mean(x, axis=0) for x in kinds.values()], axis=0)
