"""A flight of stairs -> where hands, feet and knees go next, tread after tread.

A robot that kneels on a narrow tread cannot get up the next riser: with one knee up,
the thigh of the other meets the riser's upper edge before the weight is past the first.
A foot that stays behind lets the body get past. So stairs are climbed on hands and
feet, the hands as far ahead as on a box that is climbed from the ground, and the last
riser is climbed like that box, on knees.

Lengths along the flight count from the edge where it begins, inwards.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from clamber.contact.contact import Contact
from clamber.model.records import short_repr
from clamber.model.world import Surface, World
from clamber.planning.proportions import StairSteps
from clamber.planning.route import BORDER, Platform, contact_at, crossing

FLUSH = 0.01  # [m] tops that differ by less are no stairs
CLEAR = 0.02  # [m] between a surface and what is higher than its support
FAR = 100.0  # [m] longer than any flight
WORTH = 0.05  # [m] a limb that gets on by less stays where it is


@dataclass(frozen=True, eq=False, slots=True)
class _Tread:
    """A tread that begins at `edge`, and where a surface's middle may be on it [m]."""

    name: str
    edge: float
    low: float
    high: float

    def near(self, x: float) -> float:
        return float(np.clip(x, self.low, self.high))

    def up_to(self, x: float) -> tuple[float, ...]:
        """The farthest place that is no farther than x, and the nearest one."""
        if x < self.low:
            return ()
        return tuple(dict.fromkeys((min(x, self.high), self.low)))


@dataclass(frozen=True, eq=False, slots=True)
class Flight:
    """A platform as stairs, on the way from its first edge to a goal (2,)."""

    world: World
    platform: Platform
    goal: np.ndarray
    steps: StairSteps

    __repr__ = short_repr

    def is_climbable(self) -> bool:
        """Whether each box is higher than the one before, with room for what steps.

        Hands and feet on every tread, but no feet on the last, where the knees come.
        """
        boxes = self.platform.boxes
        tops = [self.world.supports[n].position[2] for n in boxes]
        if len(tops) < 2 or not np.all(np.diff(tops) > FLUSH):
            return False
        for limb in self.world.robot.limbs.values():
            wanted = [(limb.surfaces[0], boxes)]
            if not limb.is_arm:
                wanted = [(limb.surfaces[0], boxes[:-1])]
                wanted += [(limb.surfaces[-1], boxes[-1:])]
            for surface, on in wanted:
                if not {t.name for t in self._treads(surface)}.issuperset(on):
                    return False
        return True

    def next_contacts(self, stance: Sequence[Contact]) -> list[tuple[Contact, ...]]:
        """The next contacts to be made, each at its places, the best one first.

        Read off the stance alone, on the ground and the treads or on some of them:
        limbs without a contact; else both hands, where the feet have come after them;
        else both feet; else, the feet before the last riser, the knees. None where both
        knees are on the last tread.
        """
        robot, steps = self.world.robot, self.steps
        at = {robot.limb_of(c.surface).name: c for c in stance}
        x = {limb: self._along(c) for limb, c in at.items()}
        arms = [b for b in robot.limbs.values() if b.is_arm]
        legs = [b for b in robot.limbs.values() if not b.is_arm]
        on = [b for b in legs if b.name in at and at[b.name].surface == b.surfaces[0]]
        if not on:
            return []
        behind = min(x[b.name] for b in on)
        hands = []
        for arm in arms:
            hand = arm.surfaces[0]
            room = self._treads(hand)
            ahead = min(behind + steps.lead, self._end(room[-1]) + steps.span)
            tread = min(room, key=lambda t: abs(t.near(ahead) - ahead))
            to = tread.near(ahead)
            held = arm.name in at and at[arm.name].surface == hand
            if not held or (on == legs and to - x[arm.name] >= WORTH):
                hands.append((self._contact(hand, tread.name, to),))
        lost = [b.surfaces[0] for b in legs if b.name not in at]
        if lost:
            other = on[0].name
            return [(self._contact(s, at[other].support, x[other]),) for s in lost]
        if hands:
            return hands
        feet = []
        before = min(x[b.name] for b in arms) - steps.gap
        for leg in on if on == legs else ():
            foot = leg.surfaces[0]
            below = [t for t in self._treads(foot) if t.name != self.platform.boxes[-1]]
            places = tuple(
                self._contact(foot, t.name, to)
                for t in below[::-1]
                for to in t.up_to(before)
                if to - x[leg.name] >= WORTH
            )
            if places:
                feet.append(places)
        if feet:
            return feet
        knees = [(b.surfaces[-1], self._treads(b.surfaces[-1])[-1]) for b in on]
        return [(self._contact(k, t.name, t.near(self._end(t))),) for k, t in knees]

    def _end(self, last: _Tread) -> float:
        """Place of the knees on the last tread [m]: around the goal, if it is near."""
        first = last.edge + self.steps.knee
        middle = self.platform.entry.distance(self.goal) - self.steps.span / 2
        return float(np.clip(middle, first, first + self.steps.gap))

    def _line(self, surface: str) -> tuple[np.ndarray, np.ndarray]:
        """The line that a surface follows, on its side of that to the goal.

        Returns:
            (2,) where it crosses the edge, and (2,) the way for each metre of the
            flight.
        """
        edge = self.platform.entry
        left = np.array([-edge.inward[1], edge.inward[0]])
        way = (self.goal - edge.point[:2]) / edge.distance(self.goal)
        return edge.point[:2] + self.steps.sides[surface] * left, way

    def _contact(self, surface: str, support: str, x: float) -> Contact:
        origin, way = self._line(surface)
        top, p = self.world.supports[support], np.array([*(origin + x * way), 0.0])
        return contact_at(surface, top, p, self.platform.entry.yaw)

    def _along(self, c: Contact) -> float:
        """Distance of a contact's centre from the edge, inwards [m]."""
        x = self.platform.entry.distance(c.position)
        # A foot on tiptoe is where its toes are.
        return x if c.edge is None else x - _half(self.world.surfaces[c.surface])

    def _treads(self, surface: str) -> list[_Tread]:
        """The treads on which a surface finds room, on its side of the way."""
        s = self.world.surfaces[surface]
        half = _half(s)
        origin, way = self._line(surface)
        start = origin - way
        met = []
        for name in self.platform.boxes:
            over = crossing(self.world.supports[name], start, start + FAR * way)
            if over is not None:
                met.append((name, FAR * over[0] - 1.0, FAR * over[1] - 1.0))
        risers = [begin for _, begin, _ in met[1:]] + [np.inf]
        out = []
        for (name, begin, end), riser in zip(met, risers, strict=False):
            low = begin + half + BORDER
            high = min(end - half - BORDER, riser - max(s.radius, half) - CLEAR)
            if low <= high:
                out.append(_Tread(name, begin, low, high))
        return out


def _half(surface: Surface) -> float:
    """Half the length of a flat surface, 0 of a ball [m]."""
    if surface.rotation is None:
        return 0.0
    return 0.5 * float(np.ptp(surface.corners @ surface.rotation[:, 0]))
