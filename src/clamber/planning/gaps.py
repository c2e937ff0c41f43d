"""Gaps between the boxes of a platform -> which limbs step next on all fours.

Near a gap the body is stretched: with the knees brought up to the elbows, as in a
crawl, neither could let go. A limb waits at the gap's near border until its place is
beyond the middle, and then steps to the other border in one go.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from clamber.contact.contact import Contact
from clamber.contact.steps import MOVED
from clamber.planning.proportions import Proportions
from clamber.planning.route import Frame, Platform


def gaps_ahead(
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
    end = (wanted - last) @ way
    return [(near, far) for near, far in spans if far > 0.0 and near < end]


def due_near_gap(
    proportions: Proportions,
    platform: Platform,
    on: Mapping[str, Contact],
    frame: Frame,
    wanted: Frame,
    place: Callable[[str, Frame, np.ndarray], Contact],
) -> tuple[dict[str, Contact], dict[str, Contact]]:
    """The limbs that are next near a gap: which step on a box, and which across.

    The body goes on by a step from where the first limb is due, or until some are due
    across: both arms or both legs together. What is due first comes first. Both are
    empty far from a gap.

    Args:
        proportions: The robot's.
        platform: With gaps.
        on: Contacts of all limbs, by limb, in the order in which they step.
        frame: Where the body is.
        wanted: Where it shall get to.
        place: Where a limb finds a place, nearest to a point (2,) of a frame.
    """
    step = min(proportions.step.values())
    length = frame.away(wanted)
    way = (wanted.xy - frame.xy) / max(length, 1e-9)
    at = {n: float((c.position[:2] - frame.xy) @ way) for n, c in on.items()}
    gaps = gaps_ahead(platform, tuple(on.values()), wanted.xy)
    if not gaps or gaps[0][0] > max(at.values()) - min(at.values()) + step:
        return {}, {}
    offsets = {
        n: np.array([math.copysign(proportions.stretch, o[0]), o[1]])
        for n, o in proportions.offsets.items()
    }

    def stretched(n: str, x: float) -> Contact:
        return place(n, Frame(frame.xy + x * way, wanted.yaw), offsets[n])

    x = min(at[n] - offsets[n][0] for n in on)
    walks: dict[str, float] = {}
    hops: dict[str, float] = {}
    last = math.inf
    while x < min(length, last):
        x += MOVED.wanted
        for n in on:
            to = stretched(n, x)
            if float((to.position[:2] - frame.xy) @ way) - at[n] <= MOVED.wanted:
                continue
            if to.support != on[n].support:
                hops.setdefault(n, x)
            elif n not in hops:
                walks.setdefault(n, x)
            # Where the first is due, it is that far ahead already.
            last = min(last, x + step - 2.0 * MOVED.wanted)
    if hops:  # those of the first that is due, both arms or both legs
        x, first = min((d, n) for n, d in hops.items())
        arms = first.endswith("arm")
        hops = {n: d for n, d in hops.items() if n.endswith("arm") == arms}
    walks = {n: d for n, d in walks.items() if d <= x and n not in hops}
    return (
        {n: stretched(n, x) for n in sorted(walks, key=lambda n: walks[n])},
        {n: stretched(n, hops[n]) for n in sorted(hops, key=lambda n: hops[n])},
    )
