"""From demonstrations to a general policy.

First the table of states and actions that a demonstration shows [thesis 5.1, algorithm
1]; then the cycles that repeat in it [5.2, algorithm 2], each with the region in which
it does, and the distributions of the pelvis's angles over the top and near the edge.
Several demonstrations are pooled where they show the same cycles in the same order.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import median

import numpy as np

from clamber.contact.contact import (
    LIMBS,
    PARTS,
    Contact,
    ContactSequence,
    Region,
    Stance,
)
from clamber.contact.policy import (
    DemoPolicy,
    GeneralPolicy,
    Option,
    PelvisDistribution,
    Place,
    climbed_edges,
    pelvis_angles,
)
from clamber.contact.steps import MOVED
from clamber.errors import InputError
from clamber.model.arguments import checks_types
from clamber.model.scene import GROUND
from clamber.model.se3 import matrix_from_quat, wrap

NEAR_EDGE = 1.0  # thighs' lengths: nearer than this, the pelvis is near an edge
REGIONS: tuple[Region, ...] = ("G", "M", "O")
_INNER = {  # where both are down, the surface nearer to the trunk bears the load
    s + outer: s + inner
    for s in ("L", "R")
    for outer, inner in (("Hand", "Elbow"), ("Foot", "Knee"))
}
_SEGMENTS = {"arm": ("upper_arm", "forearm"), "leg": ("thigh", "shank")}


@checks_types
def learn_policy(sequences: Sequence[ContactSequence]) -> GeneralPolicy:
    """Learn the general policy that demonstrated contact sequences have in common.

    Args:
        sequences: As detected, at the scale of each person.

    Raises:
        InputError: There is no sequence, or one is a robot's own or shows no repeated
            cycle.
    """
    return contract_policies([build_demo_policy(s) for s in sequences])


# The demo policy.


def build_demo_policy(sequence: ContactSequence) -> DemoPolicy:
    """The table of states and actions of a demonstration [algorithm 1].

    A surface newly in contact is an action. Where the contacts are the same as before,
    the one that has moved furthest is; a hand that moves along with its elbow counts as
    the elbow. That a limb leaves its contact is part of its next action; contacts given
    up while another limb acts are a state of their own. States that repeat are merged:
    a contact made again at its place is none.

    Args:
        sequence: As detected.

    Raises:
        InputError: It is a robot's own plan: nothing says how large the person is.
    """
    if sequence.subject is None:
        raise InputError(
            "the segment lengths of a person: a robot's own plan has none",
            source=sequence.source,
            field="subject",
        )
    states: list[Stance] = [sequence.stances[0]]
    actions: list[str | None] = []
    # Contacts of each limb while it held on to anything.
    last: dict[str, dict[str, Contact]] = {}

    def leave(stance: Stance, limbs: set[str]) -> None:
        """Break contacts that no longer hold, but for limbs that are about to act."""
        held = states[-1].contacts
        kept = tuple(
            c for c in held if stance.contact(c.surface) or _limb(c.surface) in limbs
        )
        if len(kept) < len(held):
            states.append(replace(stance, contacts=kept))
            actions.append(None)

    for i, stance in enumerate(sequence.stances):
        previous = sequence.stances[max(i - 1, 0)]
        acting = _acting(stance, previous, last) if i else []
        if acting:
            leave(previous, {_limb(n) for n in acting})
        for k, surface in enumerate(acting):
            later = acting[k + 1 :]  # touch in the same instant: one after the other
            now = tuple(c for c in stance.contacts if c.surface not in later)
            states.append(replace(stance, contacts=now))
            actions.append(surface)
        for limb in {_limb(n) for n in stance.surfaces}:
            last[limb] = {
                c.surface: c for c in stance.contacts if _limb(c.surface) == limb
            }
    leave(sequence.stances[-1], set())
    return DemoPolicy(
        source=sequence.source,
        scene=sequence.scene,
        subject=sequence.subject,
        states=tuple(states),
        actions=tuple(actions),
    )


def _limb(surface: str) -> str:
    """The limb of a surface; what is none of `PARTS` is one of its own."""
    return LIMBS.get(surface, surface)


def _acting(
    stance: Stance, previous: Stance, last: Mapping[str, Mapping[str, Contact]]
) -> list[str]:
    """Surfaces whose actions lead to a stance."""
    moved = {
        c.surface: _moved(c, last.get(_limb(c.surface), {}).get(c.surface))
        for c in stance.contacts
    }
    far = {n: d for n, d in moved.items() if d > MOVED.shown}
    new = [n for n in far if previous.contact(n) is None]
    if new:
        return new
    bearing = {n: d for n, d in far.items() if _INNER.get(n) not in stance.surfaces}
    return [max(bearing, key=lambda n: bearing[n])] if bearing else []


def _moved(c: Contact, was: Contact | None) -> float:
    """Distance between contacts of a surface [m]; infinite on another support."""
    if was is None or was.support != c.support:
        return math.inf
    return float(np.linalg.norm(c.position - was.position))


# Cycles.


@dataclass(frozen=True, slots=True, kw_only=True)
class _Action:
    """A dominant action: where it is taken, what it makes, to which region it leads."""

    taken: Stance
    makes: Contact
    leads: Region

    @property
    def surface(self) -> str:
        """Surface that makes the contact."""
        return self.makes.surface


@dataclass(frozen=True, slots=True, kw_only=True)
class _Cycle:
    """A cycle as one demonstration shows it, and the state in which it begins."""

    place: Place
    surfaces: tuple[str, ...]
    repeats: int
    begins: Stance

    @property
    def key(self) -> tuple[Place, frozenset[str]]:
        """What makes it the same cycle in another demonstration."""
        return self.place, frozenset(self.surfaces)


def dominant_actions(demo: DemoPolicy) -> list[int]:
    """Indices of the actions whose surfaces carry their limbs' load.

    A hand set down while its elbow bears, or just before its elbow is set down again,
    bears nothing.
    """
    making = [i for i, action in enumerate(demo.actions) if action is not None]
    out = []
    for i, following in zip(making, [*making[1:], None], strict=True):
        before, after = demo.states[i : i + 2]
        inner = _INNER.get(str(demo.actions[i]), "")
        lands = (
            following is not None
            and demo.actions[following] == inner
            and before.contact(inner) is not None
        )
        if not lands and after.contact(inner) is None:
            out.append(i)
    return out


def _dominant(demo: DemoPolicy) -> list[_Action]:
    """Those actions; where a hand lands before its elbow, taken before the hand's."""
    ruling = dominant_actions(demo)
    out = []
    for i in ruling:
        surface, began = str(demo.actions[i]), i
        while (
            began and began - 1 not in ruling and _same_limb(demo, began - 1, surface)
        ):
            began -= 1
        after = demo.states[i + 1]
        makes = after.contact(surface)
        assert makes is not None
        out.append(_Action(taken=demo.states[began], makes=makes, leads=after.region))
    return out


def _same_limb(demo: DemoPolicy, i: int, surface: str) -> bool:
    action = demo.actions[i]
    return action is not None and _limb(action) == _limb(surface)


def find_cycles(names: Sequence[str], *, first: int = 0) -> tuple[int, int, int] | None:
    """The first cycle that repeats at once [ACTION-CYCLE of algorithm 2].

    As many different names as there are before one comes again, followed by the same
    ones, in whatever order: people are not strict about it.

    Args:
        names: Of actions.
        first: Where to begin.

    Returns:
        Where it starts, its length, how often it is there; None where nothing repeats.
    """
    for start in range(first, len(names)):
        for n in range(2, (len(names) - start) // 2 + 1):
            if len(set(names[start : start + n])) < n:
                break
            repeats = _repeats(names, start, n)
            if repeats > 1:
                return start, n, repeats
    return None


def _repeats(names: Sequence[str], start: int, n: int) -> int:
    """Number of successive occurrences of the first `n` names as a set."""
    cycle, k = set(names[start : start + n]), 1
    if len(cycle) < n:
        return 0
    while set(names[start + k * n : start + (k + 1) * n]) == cycle:
        k += 1
    return k


def _cycles(demo: DemoPolicy) -> list[_Cycle]:
    """Cycles of a demonstration in order, each within one region.

    Where a cycle may begin with any of its actions, it begins with the first one that
    leaves out none of its repeats and is taken in the region to which it leads.
    """
    actions = _dominant(demo)
    out: list[_Cycle] = []
    i = 0
    while i < len(actions):
        region, j = actions[i].leads, i
        while j < len(actions) and actions[j].leads == region:
            j += 1
        arrives = j == len(actions) and any(a.leads != "G" for a in actions[:i])
        place: Place = "goal" if region == "G" and arrives else region
        names = [a.surface for a in actions[i:j]]
        at = 0
        while (found := find_cycles(names, first=at)) is not None:
            start, n, _ = found
            often = {s: _repeats(names, s, n) for s in range(start, start + n)}
            starts = [s for s, k in often.items() if k == max(often.values())]
            inside = [s for s in starts if actions[i + s].taken.region == region]
            start = (inside or starts)[0]
            at = start + often[start] * n
            cycle = _Cycle(
                place=place,
                surfaces=tuple(names[start : start + n]),
                repeats=often[start],
                begins=actions[i + start].taken,
            )
            if out and out[-1].key == cycle.key:  # it goes on after something else
                before = out.pop()
                cycle = replace(before, repeats=before.repeats + cycle.repeats)
            out.append(cycle)
        i = j
    return out


# The general policy.


def contract_policies(demos: Sequence[DemoPolicy]) -> GeneralPolicy:
    """Contract demo policies to the general policy that they share [algorithm 2].

    Those fit together whose cycles come in the same order, even where one leaves some
    of them out. The policy is that of the cycles into which most demonstrations fit;
    those that do not fit become secondary policies.

    Args:
        demos: One or more.

    Raises:
        InputError: There is none, or one shows no repeated cycle.
    """
    if not demos:
        raise InputError("at least one demonstration")
    cycles = [_cycles(d) for d in demos]
    for demo, found in zip(demos, cycles, strict=True):
        if not found:
            raise InputError(
                "a demonstration in which a cycle of contacts repeats, such as LHand, "
                "RHand, LHand, RHand; this one has no repeated cycle",
                source=demo.source,
                field="actions",
                value=" ".join(a.surface for a in _dominant(demo)) or "none",
            )
    rest = list(zip(demos, cycles, strict=True))
    policies: list[GeneralPolicy] = []
    while rest:
        fits = [[_fit(x[1], leader[1]) is not None for x in rest] for leader in rest]
        best = max(range(len(rest)), key=lambda k: sum(fits[k]))
        members = [x for x, fit in zip(rest, fits[best], strict=True) if fit]
        policies.append(_pool(rest[best][1], members))
        rest = [x for x, fit in zip(rest, fits[best], strict=True) if not fit]
    return replace(policies[0], secondary=tuple(policies[1:]))


def _fit(cycles: list[_Cycle], leader: list[_Cycle]) -> list[int] | None:
    """Index of the leader's matching cycle for each, in order; None if one has none."""
    out: list[int] = []
    for cycle in cycles:
        first = out[-1] + 1 if out else 0
        later = (k for k in range(first, len(leader)) if leader[k].key == cycle.key)
        k = next(later, None)
        if k is None:
            return None
        out.append(k)
    return out


def _pool(
    leader: list[_Cycle], members: list[tuple[DemoPolicy, list[_Cycle]]]
) -> GeneralPolicy:
    """One policy of demonstrations that fit together."""
    shown: list[list[_Cycle]] = [[] for _ in leader]
    notes = []
    for demo, cycles in members:
        places = _fit(cycles, leader) or []
        for k, cycle in zip(places, cycles, strict=True):
            shown[k].append(cycle)
        for k in sorted(set(range(len(leader))) - set(places)):
            missing = ", ".join(leader[k].surfaces)
            notes.append(f"{demo.source} does not show {missing} in {leader[k].place}")
    names: dict[tuple[Place, frozenset[str]], str] = {}
    for cycle in leader:
        names.setdefault(cycle.key, f"ac{len(names) + 1}")
    options = []
    for k, (cycle, several) in enumerate(zip(leader, shown, strict=True)):
        orders = Counter(c.surfaces for c in several)
        surfaces, most = orders.most_common(1)[0]
        if len(orders) > 1:
            notes.append(
                f"{names[cycle.key]} in {cycle.place}: {', '.join(surfaces)} in that "
                f"order in {most} of {len(several)} demonstrations"
            )
        regions = {c.begins.region for c in several}
        held = [set(c.begins.surfaces) for c in several]
        options.append(
            Option(
                name=names[cycle.key],
                region=cycle.place,
                surfaces=surfaces,
                repeats=round(median(c.repeats for c in several)),
                initiation=tuple(r for r in REGIONS if r in regions),
                held=tuple(
                    n
                    for n in several[0].begins.surfaces
                    if n in set.intersection(*held)
                ),
                termination=leader[k + 1].place if k + 1 < len(leader) else "goal",
            )
        )
    demos = tuple(demo for demo, _ in members)
    ends = Counter(tuple(sorted(d.states[-1].surfaces)) for d in demos)
    goal = ends.most_common(1)[0][0]
    if len(ends) > 1:
        notes.append(f"{ends[goal]} of {len(demos)} end on {', '.join(goal)}")
    notes += [
        f"{d.source} does not say how the pelvis is held"
        for d in demos
        if all(s.pelvis is None for s in d.states)
    ]
    top, edge = (
        np.concatenate(x) for x in zip(*map(pelvis_samples, demos), strict=True)
    )
    return GeneralPolicy(
        options=tuple(options),
        over_top=fit_distribution(top),
        near_edge=fit_distribution(edge),
        goal=goal,
        reach=_reach(demos, {n for o in options for n in o.surfaces}),
        demos=demos,
        notes=tuple(dict.fromkeys(notes)),
    )


def fit_distribution(angles: np.ndarray) -> PelvisDistribution:
    """Mean and standard deviation of angles (n, 3) on the circle [rad] (5.5, 5.6)."""
    n = len(angles)
    if n == 0:
        mean, sigma = np.zeros(3), np.full(3, np.inf)
    else:
        mean = np.arctan2(np.sin(angles).mean(axis=0), np.cos(angles).mean(axis=0))
        off = wrap(angles - mean)
        sigma = np.sqrt(np.sum(off**2, axis=0) / max(n - 1, 1))
        sigma = sigma if n > 1 else np.full(3, np.inf)
    return PelvisDistribution(mean=mean, sigma=sigma, samples=n)


def pelvis_samples(demo: DemoPolicy) -> tuple[np.ndarray, np.ndarray]:
    """Angles (n, 3) of the pelvis over the top and near an edge, a row a state.

    Over the top yaw is against the edge that was climbed up, near an edge against that
    edge; within a thigh's length behind an edge, a state counts for both.
    """
    known = [s.pelvis for s in demo.states if s.pelvis is not None]
    touched = {c.support for s in demo.states for c in s.contacts} - {GROUND}
    tops = [s for s in demo.scene.supports if s.name in touched]
    top: list[np.ndarray] = []
    edge: list[np.ndarray] = []
    near = NEAR_EDGE * demo.subject["thigh"]
    for pelvis in known:
        angles = pelvis_angles(matrix_from_quat(pelvis[3:]))
        several = [climbed_edges(s, known[0], known[-1]) for s in tops]
        over = [min(edges, key=lambda e: e.distance(pelvis)) for edges in several]
        k = max(range(len(tops)), key=lambda k: over[k].distance(pelvis))
        distance = over[k].distance(pelvis)
        if distance >= 0.0:
            top.append(wrap(angles - [0.0, 0.0, several[k][0].yaw]))
        if abs(distance) <= near:
            edge.append(wrap(angles - [0.0, 0.0, over[k].yaw]))
    return np.reshape(top, (-1, 3)), np.reshape(edge, (-1, 3))


def _reach(demos: Sequence[DemoPolicy], surfaces: set[str]) -> dict[str, float]:
    """Longest step of each surface, in lengths of its limb (5.9).

    A step goes from one contact of a surface to the next one on the same support, with
    no other surface of the limb bearing in between.
    """
    out: dict[str, float] = {}
    for demo in demos:
        bearing = {_limb(c.surface): c for c in demo.states[0].contacts}
        for action in _dominant(demo):
            limb = _limb(action.surface)
            was, now = bearing.get(limb), action.makes
            bearing[limb] = now
            if was is None or was.surface != now.surface or now.surface not in surfaces:
                continue
            step = _moved(now, was)
            if MOVED.shown < step < math.inf:
                length = sum(demo.subject[x] for x in _SEGMENTS[limb.split("_")[1]])
                out[now.surface] = max(out.get(now.surface, 0.0), step / length)
    return {n: out[n] for n in PARTS if n in out}
