"""A contact sequence as steps: one limb at a time changes its contact."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from clamber.contact.contact import Contact, ContactSequence, Stance
from clamber.model.records import short_repr
from clamber.model.world import World

NOT_SHOWN = Stance(contacts=())  # of a step that no demonstration shows


@dataclass(frozen=True, slots=True, kw_only=True)
class StepTolerances:
    """Distances below which a contact counts as unmoved [m], by purpose.

    Larger: fewer steps; too large: steps that matter are missed. Too small: a shuffle
    counts as a step.

    Attributes:
        shown: Of a demonstration: as far as a foot shuffles.
        searched: Of a search for contacts, which shall try what differs.
        wanted: Of a policy.
        measured: Of execution; a touch this near replaces what was measured there.
        eased: Of contacts that are planned elsewhere for a later one's sake.
    """

    shown: float = 0.03
    searched: float = 0.08
    wanted: float = 0.02
    measured: float = 0.05
    eased: float = 0.005


MOVED = StepTolerances()


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Seeds:
    """Postures (nq,) near those that a step goes through, as far as they are known.

    Attributes:
        shifted: The weight on the contacts that stay.
        touching: The new contact closed, not loaded.
    """

    shifted: np.ndarray | None = None
    touching: np.ndarray | None = None

    __repr__ = short_repr


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Step:
    """One limb's change of contact.

    Attributes:
        limb: Its name.
        breaks: Surfaces whose contacts are broken.
        makes: The contact that is made, its position a reference until optimised.
        fixed: The position is prescribed, or as near to it as can be reached.
        turns: A flat surface may lie turned on its support where nothing else helps.
        target: The stance of the demonstration that it leads to.
        stance: Index of that stance in the sequence.
        seeds: Postures from which its own may be found.
        base_rotation: (3, 3) R_WB of the pelvis that is preferred, or None.
        reference: (nq,) the posture to stay close to; None: the one before.
        stands_up: It is the last step and ends on the feet, in the robot's nominal
            posture, which then takes the place of reference and preferred rotation: a
            person who has just got up is still bent.
        index: Number of the step in its sequence; None: it belongs to none.
    """

    limb: str
    breaks: tuple[str, ...]
    makes: Contact | None
    fixed: bool = False
    turns: bool = False
    target: Stance = NOT_SHOWN
    stance: int = 0
    seeds: Seeds = Seeds()
    base_rotation: np.ndarray | None = None
    reference: np.ndarray | None = None
    stands_up: bool = False
    index: int | None = None

    __repr__ = short_repr

    def __str__(self) -> str:
        """Such as `LHand -> LElbow on box`."""
        made = f"{self.makes.surface} on {self.makes.support}" if self.makes else "air"
        return f"{', '.join(self.breaks) or 'air'} -> {made}"


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Skipped:
    """A stance of the demonstration that takes no step, and why.

    Attributes:
        stance: Its index in the sequence.
        reason: For people.
    """

    stance: int
    reason: str

    __repr__ = short_repr


def split_steps(
    sequence: ContactSequence, world: World
) -> tuple[list[Step], list[Skipped]]:
    """Split each change of stance into steps of one limb, or say why there is none.

    A limb that only leaves its contact is part of its next step where it has one. Where
    two surfaces of a limb are down at once, the one nearer to the trunk bears the load.

    Args:
        sequence: In the robot's scene.
        world: Robot and scene.
    """
    first = sequence.stances[0]
    closed: dict[str, Contact | None] = {}
    for limb in world.robot.limbs.values():
        # The robot starts on its feet, wherever the recording's first stance is.
        closed[limb.name] = None if limb.is_arm else first.contact(limb.surfaces[0])
    standing = {x.name for x in world.robot.limbs.values() if not x.is_arm}
    steps: list[Step] = []
    skipped: list[Skipped] = []
    for i, stance in enumerate(sequence.stances[1:], start=1):
        reasons, before = [], len(steps)
        for limb in world.robot.limbs.values():
            wanted = [c for c in stance.contacts if c.surface in limb.surfaces]
            has = closed[limb.name]
            down = has.surface if has is not None else None
            if limb.name in standing:
                down = down or limb.surfaces[0]
            if not wanted:
                if down is None:
                    continue
                if _comes_back(sequence, i, limb.surfaces):
                    side = limb.name.replace("_", " ")
                    reasons.append(f"{side} in the air: part of its next step")
                    continue
                makes, breaks = None, (down,)
            else:
                makes = max(wanted, key=lambda c: limb.surfaces.index(c.surface))
                if has is not None and same_place(has, makes):
                    continue
                if has is None and makes.surface == down:
                    closed[limb.name] = makes
                    continue
                breaks = (down,) if down is not None else ()
            closed[limb.name] = makes
            standing.discard(limb.name)
            steps.append(
                Step(
                    limb=limb.name,
                    breaks=breaks,
                    makes=makes,
                    fixed=makes is not None and makes.fixed,
                    target=stance,
                    stance=i,
                    index=len(steps),
                )
            )
        if len(steps) == before:
            none = "no limb makes or breaks a load-bearing contact"
            reason = "; ".join(reasons) or none
            skipped.append(Skipped(stance=i, reason=reason))
    if steps:
        last = [c for c in closed.values() if c is not None]
        steps[-1] = replace(steps[-1], stands_up=on_feet(world, last))
    return steps, skipped


def on_feet(world: World, stance: Sequence[Contact]) -> bool:
    """Whether a stance is on feet alone: a motion that ends so is meant to stand."""
    limb_of = world.robot.limb_of
    limbs = [(limb_of(c.surface), c.surface) for c in stance]
    return bool(limbs) and all(
        not limb.is_arm and surface == limb.surfaces[0] for limb, surface in limbs
    )


def same_place(a: Contact, b: Contact) -> bool:
    """Whether a surface is where it was, within what a demonstration shows."""
    near = float(np.linalg.norm(a.position - b.position)) < MOVED.shown
    return a.surface == b.surface and a.support == b.support and near


def _comes_back(sequence: ContactSequence, i: int, surfaces: tuple[str, ...]) -> bool:
    later = sequence.stances[i + 1 :]
    return any(c.surface in surfaces for s in later for c in s.contacts)
