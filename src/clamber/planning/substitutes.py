r"""Other contacts than the demonstrated ones [thesis 5.3, algorithm 4].

What a demonstration touches beyond its first stance, stance by stance, is

    Cd_i = C_(i+1) \ C_0.

Where a limb offers several surfaces in one of these sets, it can do with one: there is
an alternative for each combination, and a combination is kept through the whole plan.
Of those that are stable, the best has the least

    sum over the contacts that are made of (swing distance of the surface + d)

with d the projected distance (4.17) of the new contact. Besides, elbows can stand in
for hands (`stand_ins`): no wrist has to bear.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np

from clamber.contact.contact import Contact, ContactSequence
from clamber.model.arguments import checks_types
from clamber.model.kinematics import Kinematics
from clamber.model.records import short_repr
from clamber.model.robot import Robot, RobotLike, load_robot
from clamber.model.scene import GROUND
from clamber.planning.records import Plan
from clamber.step.statics import projected_distance


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Alternative:
    """A sequence in which each limb keeps to one of its surfaces.

    Attributes:
        surfaces: The one chosen for each limb that offers several.
        sequence: The demonstrated sequence without contacts on the others.
    """

    surfaces: tuple[str, ...]
    sequence: ContactSequence

    __repr__ = short_repr


@checks_types
def contact_differences(sequence: ContactSequence) -> tuple[tuple[str, ...], ...]:
    """For each stance after the first, the surfaces that the first has not: Cd_i.

    Args:
        sequence: As demonstrated.
    """
    first = set(sequence.stances[0].surfaces)
    return tuple(
        tuple(s for s in stance.surfaces if s not in first)
        for stance in sequence.stances[1:]
    )


@checks_types
def contact_alternatives(
    sequence: ContactSequence, robot: RobotLike
) -> tuple[Alternative, ...]:
    """One for each combination of surfaces, of the limbs that offer several at once.

    Args:
        sequence: As demonstrated.
        robot: The robot whose limbs have the surfaces, or its name.
    """
    robot = load_robot(robot)
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


@checks_types
def plan_cost(made: Plan) -> float:
    """Swing distances of the surfaces, and projected distances, summed [m].

    A swing distance is that of the straight line from where the surface was to where
    its new contact is. A step without a path counts with its reference contact, from
    the last keyframe on.

    Args:
        made: The plan, whole or not.
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
