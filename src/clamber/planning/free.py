"""Best-first search for contacts where the demonstrated ones do not reach the goal.

A state is a stance with its posture, and the paths that lead to it; an action moves one
limb to a contact: a surface of it, on a support, at a place. An action costs

    -ln p(surface | region)  +  max(0, r - 1)

with p how often a demonstration takes it in such a region (what it never does is
unlikely, not out of the question), and r the distance from shoulder or hip to the
place, in lengths of the limb. What is left to do is reckoned from the limbs that have
yet to get to where the demonstration ends, and from how far away they are. The least
sum of both comes first. Whether a step is possible is known when it has been planned;
only what comes first is.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from clamber.contact.contact import Contact, ContactSequence, Region, Stance, region_of
from clamber.contact.policy import GeneralPolicy
from clamber.contact.steps import MOVED, Step, on_feet, split_steps
from clamber.model.kinematics import Kinematics
from clamber.model.scene import GROUND
from clamber.model.se3 import quat_from_matrix
from clamber.model.world import World
from clamber.planning.records import Route
from clamber.planning.search import Search
from clamber.step.change import Change, Failure
from clamber.step.posture import Keyframe
from clamber.step.stability import STANDING_SHARE, standing_share

Counts = Mapping[tuple[Region, str], float]

INSET = 0.05  # [m] of a place from the border of its support
TRUNK_GIVE = 1.1  # a bent waist: longest over present distance of shoulders and hips
FAR = 0.25  # of what a limb has left: each length of it that it is away
AGAIN = 0.7  # cost of each step to the same surfaces on the same supports before
EAGER = 1.25  # weight of what is left: a sequence soon rather than the likeliest
UNSEEN = 0.25  # times that every action counts as seen besides
CELL = 0.05  # [m] contacts as near to one another make the same state
GOAL_TOL = 0.15  # [m] pelvis against a goal in the scene
BACK_TOL = 0.30  # [m] mean of the contacts, where the way leads back to where it began


def policy_counts(policy: GeneralPolicy) -> Counts:
    """How often the demonstrations of a policy take each action in each region."""
    return Counter(
        (state.region, action)
        for demo in policy.demos
        for state, action in zip(demo.states, demo.actions, strict=False)
        if action is not None
    )


def action_counts(sequence: ContactSequence, world: World) -> Counts:
    """How often each surface makes a contact in each region, in a sequence.

    Args:
        sequence: In the robot's scene.
        world: Robot and scene.
    """
    counts: Counter[tuple[Region, str]] = Counter()
    stance = sequence.stances[0].contacts
    for step in split_steps(sequence, world)[0]:
        if step.makes is not None:
            counts[region_of(stance), step.makes.surface] += 1
        stance = _after(stance, step)
    return counts


def search_contacts(
    search: Search, start: Route, sequence: ContactSequence, counts: Counts
) -> Route:
    """Search for contacts that lead to where a sequence ends.

    Args:
        search: That tries them.
        start: What to go on from; it is part of what is found.
        sequence: In the robot's scene. It ends on the same supports, or at the scene's
            goal; its contacts are the first places that are tried, its postures guide
            those of like stances.
        counts: How often a demonstration takes an action.
    """
    free = _Free(search, _Guidance(search.ik.world, sequence, counts), start)
    if free.guidance.arrived(start.end):
        return replace(start, failures=(), arrived=True)
    most = search.budget.tries
    entry, failure = search.best_first(free.actions(start, 0.0), most)
    if failure is None and entry is not None:
        return replace(entry.route, failures=(), arrived=True)
    return replace(start, failures=() if failure is None else (failure,), arrived=False)


class _Free:
    """State shared by the entries of one search."""

    def __init__(self, search: Search, guidance: _Guidance, start: Route) -> None:
        self.search, self.guidance, self._start = search, guidance, start
        self.seen: set[frozenset] = set()
        self.often: Counter[frozenset] = Counter()  # like steps that were tried
        self.began = time.monotonic()

    def actions(self, route: Route, cost: float) -> list[_Action]:
        """All that may be done after a route."""
        if len(route.changes) - len(self._start.changes) >= self.search.budget.depth:
            return []
        out = []
        for step, price in self.guidance.actions(self.search.ik.kin, route.end):
            after = _after(route.end.stance, step)
            paid = cost + price
            base = paid + EAGER * self.guidance.left(after)
            out.append(
                _Action(self, route, paid, step, base, _key(after), _kind(after))
            )
        return out


@dataclass(frozen=True, eq=False, slots=True)
class _Action:
    """An entry of the search: a step after a route; without one, it has arrived.

    Attributes:
        paid: For the route and the step.
        base: That and what is left to do.
        key, kind: Of the stance that it leads to.
    """

    free: _Free
    route: Route
    paid: float
    step: Step | None
    base: float = -math.inf
    key: frozenset = frozenset()
    kind: frozenset = frozenset()

    @property
    def price(self) -> float:
        """It rises with each like step that was tried."""
        return self.base + AGAIN * self.free.often[self.kind]

    @property
    def ended(self) -> bool:
        """Whether it has arrived."""
        return self.step is None

    @property
    def idle(self) -> bool:
        """Whether its stance has been reached meanwhile, at less cost."""
        return self.key in self.free.seen

    def look(self, search: Search) -> Change | Failure:
        """Try the step."""
        assert self.step is not None  # it has not ended
        n, tries = 1 + sum(self.free.often.values()), search.budget.tries
        left = (time.monotonic() - self.free.began) / n * (tries - n + 1)
        if search.left is not None:
            left = min(left, search.left)
        bound = f", {left:.0f} s more at this pace" if n > 1 else ""
        note = f"step {n} of at most {tries}{bound}: {self.step}"
        search.report("search", (n - 1) / tries, note)
        return search.change("search", self.route.end, self.step)

    def after(self, found: Change | Failure) -> list[_Action]:
        """Actions that may follow a feasible step."""
        free = self.free
        free.often[self.kind] += 1
        if isinstance(found, Failure):
            return []
        free.seen |= {self.key, _key(found.keyframe.stance)}
        route = replace(self.route, changes=(*self.route.changes, found))
        if free.guidance.arrived(route.end):
            return [_Action(free, route, self.paid, None)]
        return free.actions(route, self.paid)


def _after(stance: Sequence[Contact], step: Step) -> tuple[Contact, ...]:
    """The stance after a step, the new contact where it is wanted."""
    kept = tuple(c for c in stance if c.surface not in step.breaks)
    return kept if step.makes is None else (*kept, step.makes)


def _key(stance: Sequence[Contact]) -> frozenset:
    """Equal for stances with the same contacts, to the `CELL`."""
    return frozenset(
        (c.surface, c.support, *np.round(c.position[:2] / CELL).astype(int).tolist())
        for c in stance
    )


def _kind(stance: Sequence[Contact]) -> frozenset:
    """Equal for stances with the same surfaces on the same supports."""
    return frozenset((c.surface, c.support) for c in stance)


def sequence_of(world: World, route: Route) -> ContactSequence:
    """The stances that a route comes through, one a second.

    A contact is where it was made: a foot that goes on tiptoe later has not moved.
    """
    contacts = route.start.stance
    stances = [Stance(contacts=contacts)]
    for change in route.changes:
        contacts = _after(contacts, change.step)
        posture = change.step.target.posture
        stances.append(Stance(contacts=contacts, posture=posture))
    return ContactSequence(
        source="search",
        subject=None,
        scene=world.scene,
        stances=tuple(stances),
        t=np.arange(len(stances) + 1, dtype=float),
    )


class _Guidance:
    """Goal supports and action frequencies of a demonstration."""

    def __init__(self, world: World, sequence: ContactSequence, counts: Counts) -> None:
        self._world, self._sequence, self._counts = world, sequence, counts
        goal = sequence.stances[-1].contacts
        limb_of = world.robot.limb_of
        self._goal = {limb_of(c.surface).name: c.support for c in goal}
        self._stands = on_feet(world, goal)
        self._middle = np.mean([c.position[:2] for c in goal], axis=0)
        begin = {c.support for c in sequence.stances[0].contacts}
        self._leads_back = set(self._goal.values()) <= begin
        self._kin = Kinematics(world)
        self._kin.update(world.home)
        self._length = {s: self._longest(s) for s in world.surfaces}
        self._places: dict[tuple[str, str], list[Contact]] = {}
        for c in (c for s in sequence.stances for c in s.contacts):
            known = self._places.setdefault((c.surface, c.support), [])
            if all(_apart(c, k) > CELL for k in known):
                known.append(c)
        self._turns = {
            name: quat_from_matrix(
                np.eye(3)
                if name == GROUND
                else support.edge_towards(world.scene.start[:2]).rotation
            )
            for name, support in world.supports.items()
        }
        self._even = math.log(len(world.surfaces))  # what an action costs unguided

    def arrived(self, key: Keyframe) -> bool:
        """Is every limb where the demonstration ends, and the pelvis at the goal?

        Where it ends on feet alone, the robot must stand, too.
        """
        if self.left(key.stance) > 0:
            return False
        if self._stands:
            share = standing_share(self._world, key.stance, key.q)
            if not on_feet(self._world, key.stance) or share < STANDING_SHARE:
                return False
        if self._world.scene.goal is not None:
            off = key.q[:2] - self._world.scene.goal[:2]
            return float(np.linalg.norm(off)) <= GOAL_TOL
        middle = np.mean([c.position[:2] for c in key.stance], axis=0)
        near = float(np.linalg.norm(middle - self._middle)) <= BACK_TOL
        return near or not self._leads_back

    def left(self, stance: Sequence[Contact]) -> float:
        """Cost-to-go: of bringing the limbs to the supports on which they end.

        To stand, a leg must be on its foot, and then the arms must let go: until both
        feet are up they are help, and cost nothing.
        """
        on = {self._world.robot.limb_of(c.surface).name: c for c in stance}
        ends = set(self._goal.values())
        total = 0.0
        for limb in self._world.robot.limbs.values():
            c = on.get(limb.name)
            goal = self._goal.get(limb.name)
            if goal is None:  # in the air at the end, or on what the others end on
                if c is None or c.support in ends:
                    continue
                goal = min(ends)
            elif c is not None and c.support == goal and self._ends_on(c):
                continue
            lengths = 1.0
            if c is not None:
                top = self._world.supports[goal]
                away = c.position - top.nearest(c.position, INSET)
                length = max(self._length[s] for s in limb.surfaces)
                lengths = float(np.linalg.norm(away)) / length
            total += 1.0 + FAR * lengths
        if self._stands and total == 0.0:
            total += sum(not on_feet(self._world, [c]) for c in stance)
        return total * self._even

    def _ends_on(self, c: Contact) -> bool:
        """Whether its surface may be the one that a limb ends on."""
        return not self._stands or on_feet(self._world, [c])

    def actions(self, kin: Kinematics, key: Keyframe) -> list[tuple[Step, float]]:
        """All that may be done from a keyframe, and what it costs."""
        world = self._world
        region = region_of(key.stance)
        kin.update(key.q)
        out = []
        for limb in world.robot.limbs.values():
            present = next((c for c in key.stance if c.surface in limb.surfaces), None)
            others = [c for c in key.stance if c is not present]
            root = kin.landmark(limb.root)[1].copy()
            if self._stands and limb.is_arm and present is not None:
                leaves = Step(limb=limb.name, breaks=(present.surface,), makes=None)
                out.append((self._aimed(key, leaves), self._even))
            for surface in limb.surfaces:
                for support in world.supports:
                    for c in self._contacts(surface, support, root):
                        if present is not None and _same(c, present):
                            continue
                        if not all(self._within_reach(c, o) for o in others):
                            continue
                        step = Step(
                            limb=limb.name,
                            breaks=() if present is None else (present.surface,),
                            makes=c,
                        )
                        r = float(np.linalg.norm(c.position - root))
                        stretch = max(0.0, r / self._length[surface] - 1.0)
                        price = self._surprise(region, surface) + stretch
                        out.append((self._aimed(key, step), price))
        return out

    def _surprise(self, region: Region, surface: str) -> float:
        """-ln p(surface | region)."""
        names = self._world.surfaces
        count = self._counts.get((region, surface), 0.0)
        total = sum(self._counts.get((region, s), 0.0) for s in names)
        return -math.log((count + UNSEEN) / (total + UNSEEN * len(names)))

    def _contacts(self, surface: str, support: str, root: np.ndarray) -> list[Contact]:
        """Candidate contacts of a surface: demonstrated, or below its mass."""
        below = Contact(
            surface=surface,
            support=support,
            position=self._world.supports[support].nearest(root, INSET),
            quaternion=self._turns[support],
        )
        known = self._places.get((surface, support), [])
        return [*known, *([below] if all(not _same(below, k) for k in known) else [])]

    def _aimed(self, key: Keyframe, step: Step) -> Step:
        """With the demonstrated stance most like the one it leads to."""
        contacts = _after(key.stance, step)
        after = {(c.surface, c.support) for c in contacts}

        def unlike(i: int) -> int:
            there = self._sequence.stances[i].contacts
            return len(after ^ {(c.surface, c.support) for c in there})

        i = min(range(len(self._sequence.stances)), key=unlike)
        return replace(
            step,
            stance=i,
            target=self._sequence.stances[i],
            stands_up=on_feet(self._world, contacts) and self.left(contacts) == 0,
        )

    def _longest(self, surface: str) -> float:
        """From shoulder or hip to a surface, the limb stretched [m]."""
        limb = self._world.robot.limb_of(surface)
        a, b, c = (self._kin.landmark(n)[1] for n in (limb.root, limb.middle, limb.end))
        p = self._kin.contact_point(surface, np.array([0.0, 0.0, 1.0]))
        upper, lower = np.linalg.norm(b - a), np.linalg.norm(c - b)
        by_middle, by_end = np.linalg.norm(p - b), lower + np.linalg.norm(p - c)
        nearer = np.linalg.norm(p - b) < np.linalg.norm(p - c)
        return float(upper + (by_middle if nearer else by_end))

    def _within_reach(self, a: Contact, b: Contact) -> bool:
        """Whether some posture may close both contacts."""
        limb_of = self._world.robot.limb_of
        roots = [self._kin.landmark(limb_of(x.surface).root)[1] for x in (a, b)]
        trunk = TRUNK_GIVE * float(np.linalg.norm(roots[0] - roots[1]))
        longest = trunk + self._length[a.surface] + self._length[b.surface]
        return _apart(a, b) <= longest


def _apart(a: Contact, b: Contact) -> float:
    return float(np.linalg.norm(a.position - b.position))


def _same(a: Contact, b: Contact) -> bool:
    at = (a.surface, a.support) == (b.surface, b.support)
    return at and _apart(a, b) < MOVED.searched
