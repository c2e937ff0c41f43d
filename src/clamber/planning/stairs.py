"""A flight of stairs -> where hands, feet and knees go next, tread after tread.

A robot that kneels on a narrow tread cannot get up the next riser: with one knee up,
the thigh of the other meets the riser's upper edge before the weight is past the first.
A foot that stays behind lets the body get past. So stairs are climbed on hands and
feet, the hands as far ahead as on a box that is climbed from the ground, and the last
riser is climbed like that box, on knees.

Lengths along the flight count from the edge where it begins, inwards.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from clamber.contact.contact import Contact
from clamber.contact.policy import Edge
from clamber.model.world import Surface, World
from clamber.planning.route import BORDER, Place, Platform, crossing

FLUSH = 0.01  # [m] tops that differ by less are no stairs
CLEAR = 0.02  # [m] between a surface and what is higher than its support
FAR = 100.0  # [m] longer than any flight
WORTH = 0.05  # [m] a limb that gets on by less stays where it is


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Gait:
    """Where limbs go on stairs, as a robot's build has it.

    Attributes:
        lead: Hands are set down so far ahead of the feet [m].
        gap: Feet come no nearer to the hands than this [m].
        knee: Knees come so far behind the last edge, at least [m].
        span: From knees to hands at the end [m].
        sides: Of each surface, to the left of the way [m].
    """

    lead: float
    gap: float
    knee: float
    span: float
    sides: Mapping[str, float]


@dataclass(frozen=True, eq=False, slots=True)
class _Spot:
    """On which support, and how far along the flight [m]."""

    support: str
    x: float


@dataclass(frozen=True, eq=False, slots=True)
class _Tread:
    """A tread that begins at `edge`, and where a surface's middle may be on it [m]."""

    name: str
    edge: float
    low: float
    high: float

    def near(self, x: float) -> _Spot:
        """The spot nearest to x."""
        return _Spot(self.name, float(np.clip(x, self.low, self.high)))

    def up_to(self, x: float) -> list[_Spot]:
        """The farthest spot that is no farther than x, and the nearest one."""
        if x < self.low:
            return []
        far = min(x, self.high)
        return [_Spot(self.name, p) for p in dict.fromkeys((far, self.low))]


def is_flight(world: World, platform: Platform, goal: np.ndarray, gait: Gait) -> bool:
    """Whether each box is higher than the one before, with room for what steps there.

    Hands and feet on every tread, but no feet on the last, where the knees come, on the
    way from its first edge to a goal (2,).
    """
    boxes = platform.boxes
    tops = [world.supports[n].position[2] for n in boxes]
    if len(tops) < 2 or not np.all(np.diff(tops) > FLUSH):
        return False

    def fits(surface: str, on: Sequence[str]) -> bool:
        found = {t.name for t in _treads(world, platform, surface, goal, gait)}
        return found.issuperset(on)

    return all(
        fits(limb.surfaces[0], boxes)
        if limb.is_arm
        else fits(limb.surfaces[0], boxes[:-1]) and fits(limb.surfaces[-1], boxes[-1:])
        for limb in world.robot.limbs.values()
    )


def next_contacts(
    world: World,
    platform: Platform,
    stance: Sequence[Contact],
    goal: np.ndarray,
    gait: Gait,
) -> list[tuple[str, tuple[Place, ...]]]:
    """The next surfaces to be set down, each with its places, the best one first.

    Read off the stance alone: limbs without a contact; else both hands, where the feet
    have come after them; else both feet; else, the feet before the last riser, the
    knees. None where both knees are on the last tread.

    Args:
        world: Robot and scene.
        platform: The flight.
        stance: On the ground and the treads, or on some of them.
        goal: (2,) where the body shall get to [m].
        gait: Of the robot.
    """
    edge = platform.entry
    goal_x = edge.distance(goal)
    at = {world.robot.limb_of(c.surface).name: c for c in stance}
    x = {limb: _along(world, edge, c) for limb, c in at.items()}
    arms = [b for b in world.robot.limbs.values() if b.is_arm]
    legs = [b for b in world.robot.limbs.values() if not b.is_arm]
    on = [b for b in legs if b.name in at and at[b.name].surface == b.surfaces[0]]
    if not on:
        return []

    def places(surface: str, spots: Sequence[_Spot]) -> tuple[str, tuple[Place, ...]]:
        out = []
        for s in spots:
            origin, way = _line(edge, goal, gait.sides[surface])
            p = origin + s.x * way
            q = world.supports[s.support].project(np.array([*p, 0.0]))
            out.append(Place(support=s.support, position=q))
        return surface, tuple(out)

    def treads(surface: str) -> list[_Tread]:
        return _treads(world, platform, surface, goal, gait)

    behind = min(x[b.name] for b in on)
    hands = []
    for arm in arms:
        hand = arm.surfaces[0]
        room = treads(hand)
        end = _end(room[-1], goal_x, gait) + gait.span
        spot = _nearest(room, min(behind + gait.lead, end))
        firm = arm.name in at and at[arm.name].surface == hand
        if not firm or (on == legs and spot.x - x[arm.name] >= WORTH):
            hands.append(places(hand, [spot]))
    lost = [b for b in legs if b.name not in at]
    if lost:
        other = on[0].name
        spot = _Spot(at[other].support, x[other])
        return [places(b.surfaces[0], [spot]) for b in lost]
    if hands:
        return hands
    feet = []
    before = min(x[b.name] for b in arms) - gait.gap
    for leg in on if on == legs else ():
        below = [t for t in treads(leg.surfaces[0]) if t.name != platform.boxes[-1]]
        spots = [s for t in below[::-1] for s in t.up_to(before)]
        spots = [s for s in spots if s.x - x[leg.name] >= WORTH]
        if spots:
            feet.append(places(leg.surfaces[0], spots))
    if feet:
        return feet
    knees = [(b.surfaces[-1], treads(b.surfaces[-1])[-1]) for b in on]
    return [places(k, [t.near(_end(t, goal_x, gait))]) for k, t in knees]


def _end(last: _Tread, goal: float, gait: Gait) -> float:
    """Where the knees come on the last tread: around the goal, if it is near enough."""
    first = last.edge + gait.knee
    return float(np.clip(goal - gait.span / 2, first, first + gait.gap))


def _line(edge: Edge, goal: np.ndarray, side: float) -> tuple[np.ndarray, np.ndarray]:
    """The line that a surface follows, `side` to the left of that to the goal.

    Returns:
        (2,) where it crosses the edge, and (2,) the way for each metre of the flight.
    """
    left = np.array([-edge.inward[1], edge.inward[0]])
    way = (goal - edge.point) / edge.distance(goal)
    return edge.point + side * left, way


def _along(world: World, edge: Edge, c: Contact) -> float:
    """Of a contact's middle, from the edge inwards [m]."""
    x = edge.distance(c.position)
    # A foot on tiptoe is where its toes are.
    return x if c.edge is None else x - _half(world.surfaces[c.surface])


def _half(surface: Surface) -> float:
    """Half the length of a flat surface, 0 of a ball [m]."""
    if surface.rotation is None:
        return 0.0
    return 0.5 * float(np.ptp(surface.corners @ surface.rotation[:, 0]))


def _treads(
    world: World, platform: Platform, surface: str, goal: np.ndarray, gait: Gait
) -> list[_Tread]:
    """The treads on which a surface finds room, on its side of the way."""
    s = world.surfaces[surface]
    half = _half(s)
    origin, way = _line(platform.entry, goal, gait.sides[surface])
    start = origin - way
    met = []
    for name in platform.boxes:
        over = crossing(world.supports[name], start, start + FAR * way)
        if over is not None:
            met.append((name, FAR * over[0] - 1.0, FAR * over[1] - 1.0))
    risers = [m[1] for m in (*met[1:], ("", np.inf))]
    out = []
    for (name, begin, end), riser in zip(met, risers, strict=False):
        low = begin + half + BORDER
        high = min(end - half - BORDER, riser - max(s.radius, half) - CLEAR)
        if low <= high:
            out.append(_Tread(name, begin, low, high))
    return out


def _nearest(treads: Sequence[_Tread], x: float) -> _Spot:
    return min((t.near(x) for t in treads), key=lambda s: abs(s.x - x))
