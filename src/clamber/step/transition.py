"""Neighbouring keyframes -> the postures that move one contact.

A move makes, breaks or replaces the contact of one limb. Its transition first shifts
the weight onto the contacts that stay, then closes the new contact, unloaded, in reach-
to-support mode (4.26, 4.27), and ends in the next keyframe, loaded. The shift holds the
centre of mass inside the ellipse of the remaining contacts (4.28).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np

from clamber import _core
from clamber.contact.contact import Contact
from clamber.contact.steps import MOVED, Seeds, Step
from clamber.errors import Status
from clamber.model.records import short_repr
from clamber.model.world import World
from clamber.step.ik import (
    IK,
    PostureProblem,
    Residuals,
    Solution,
    as_solution,
    contact_clearance,
)
from clamber.step.posture import CLEARANCE, Keyframe
from clamber.step.stability import limiting_joint
from clamber.step.tasks import (
    SurfaceTask,
    closed,
    packed_contacts,
    packed_parts,
    sliding,
)

# [m] of the centre of mass while a contact moves, of the robot's size: the first that
# can be kept.
MARGINS = (0.045, 0.025)
# As the core asks for the postures of a change: of the polygon's middle, of (4.28).
COM_WEIGHT: float = _core.COM_WEIGHT
ELLIPSE_WEIGHT: float = _core.ELLIPSE_WEIGHT
APPROACH_WEIGHT = 20.0  # of the moving surface, where the contact may still give way


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Shift:
    """A posture with the weight on the contacts that stay, or as near as there is.

    Attributes:
        before: Keyframe it starts from.
        held: Contacts that stay; a foot that goes on tiptoe is on its edge here.
        rolling: Contacts that are broken, as they are let go.
        margin: Of the centre of mass to the border of its polygon [m].
        solution: The posture.
        status: SOLVED where it was found and the joints can hold it.
        note: Which joint cannot.
    """

    before: Keyframe
    held: tuple[Contact, ...]
    rolling: tuple[Contact, ...]
    margin: float
    solution: Solution
    status: Status
    note: str = ""

    __repr__ = short_repr


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Transition:
    """The postures that move one contact.

    Attributes:
        step: With the contact where it is made.
        before, after: Configurations (nq,) of the keyframes.
        shifted: (nq,) all old contacts closed, weight on those that stay.
        touching: (nq,) the new contact closed, not loaded.
        stance: Contacts at its start.
        held: Contacts that stay; a foot that goes on tiptoe is on its edge here.
        rolling: Contacts that are broken, as they are let go.
        margin: Of the centre of mass to the border of its polygon, throughout [m].
        status: Of the first of its postures that fails, with its residuals; OVERLOADED
            where the contacts that stay and the joints cannot hold it.
        note: Which joint cannot.
    """

    step: Step
    before: np.ndarray
    shifted: np.ndarray
    touching: np.ndarray
    after: np.ndarray
    stance: tuple[Contact, ...]
    held: tuple[Contact, ...]
    rolling: tuple[Contact, ...]
    margin: float
    status: Status
    residuals: Residuals
    note: str = ""

    __repr__ = short_repr

    @property
    def leaving(self) -> tuple[Contact, ...]:
        """Contacts that are broken, as they were."""
        return tuple(c for c in self.stance if c.surface in self.step.breaks)


def margins_of(world: World) -> tuple[float, ...]:
    """`MARGINS` of a robot [m], the first one the widest."""
    return tuple(m * world.length_scale for m in MARGINS)


def rolled(ik: IK, q: np.ndarray, c: Contact, towards: np.ndarray) -> Contact:
    """A flat contact on the edge that lies farthest `towards` (3,); others as they are.

    A foot that is about to leave may lift its heel: what it gains in reach is what a
    person gains on tiptoe.
    """
    packed = packed_contacts(ik.world, (c,))
    return on_edge(c, *ik.core.rolled(*packed, q, towards))


def on_edge(c: Contact, edge: int, middle: np.ndarray) -> Contact:
    """A contact on an edge, whose middle (3,) is there; as it is on none (-1)."""
    if edge < 0 or edge == c.edge:
        return c
    return replace(c, edge=edge, position=middle)


def balance_problem(
    world: World,
    *,
    held: tuple[Contact, ...],
    unloaded: tuple[Contact, ...] = (),
    q_reference: np.ndarray,
    extra: tuple[SurfaceTask, ...] = (),
    posture_weight: float = 0.08,
    touching: Mapping[str, str] | None = None,
    margin: float | None = None,
) -> PostureProblem:
    """Balance on `held`, with `unloaded` in contact but not loaded.

    Args:
        world: Robot and scene.
        held: Contacts that bear load.
        unloaded: Contacts that do not.
        q_reference: (nq,) preferred posture.
        extra: Further tasks.
        posture_weight: Of the preferred posture.
        touching: Support by surface, of what may touch besides.
        margin: Of the centre of mass to the border of its polygon [m]; None: the
            least of `MARGINS`.
    """
    where = {c.surface: c.support for c in (*held, *unloaded)} | dict(touching or {})
    rolling = [c.surface for c in (*held, *unloaded) if c.edge is not None]
    return PostureProblem(
        tasks=(
            *(closed(world, c) for c in held),
            *(closed(world, c, loaded=False) for c in unloaded),
            *extra,
        ),
        q_reference=q_reference,
        clearance=contact_clearance(
            world, CLEARANCE * world.length_scale, where, rolling
        ),
        balance_margin=margins_of(world)[-1] if margin is None else margin,
        posture_weight=posture_weight,
        ellipse_weight=ELLIPSE_WEIGHT,
        com_weight=COM_WEIGHT,
        base_weight=0.0,
    )


def plan_shift(
    ik: IK,
    before: Keyframe,
    step: Step,
    held: tuple[Contact, ...],
    *,
    margin: float,
) -> Shift:
    """Put the weight on the contacts that stay; those that are broken still touch.

    Args:
        ik: Workspace.
        before: Keyframe it starts from.
        step: What changes; where its new contact goes plays no part.
        held: Contacts that stay.
        margin: Of the centre of mass to the border of its polygon [m].
    """
    leaving = tuple(c for c in before.stance if c.surface in step.breaks)
    edges, found, holds = ik.core.shift(
        before.q,
        packed_parts(ik.world, held, leaving, None),
        margin,
        step.seeds.shifted,
    )
    solution = as_solution(found)
    status, note = _verdict(ik, solution, held, holds=holds)
    return Shift(
        before=before,
        held=held,
        rolling=tuple(on_edge(c, *x) for c, x in zip(leaving, edges, strict=True)),
        margin=margin,
        solution=solution,
        status=status,
        note=note,
    )


def plan_transition(ik: IK, shift: Shift, after: Keyframe, step: Step) -> Transition:
    """Touch and settle between a shift and the next keyframe.

    Args:
        ik: Workspace.
        shift: Of the weight, from the keyframe before.
        after: Keyframe it leads to, on the contacts that the shift holds.
        step: What changes between the keyframes.
    """
    world, before, found = ik.world, shift.before, shift.solution
    touching, status, note = after.q, shift.status, shift.note
    if step.makes is not None:
        made = next(c for c in after.stance if c.surface == step.makes.surface)
        step = replace(step, makes=made)
        if status is Status.SOLVED:
            parts = packed_parts(world, shift.held, (), made)
            packed, holds = ik.core.touch(
                shift.solution.q, after.q, parts, shift.margin, step.seeds.touching
            )
            found = as_solution(packed)
            touching = found.q
            status, note = _verdict(ik, found, shift.held, holds=holds)
    return Transition(
        step=step,
        before=before.q,
        shifted=shift.solution.q,
        touching=touching,
        after=after.q,
        stance=before.stance,
        held=shift.held,
        rolling=shift.rolling,
        margin=shift.margin,
        status=status,
        note=note,
        residuals=found.residuals,
    )


def _verdict(
    ik: IK, found: Solution, held: tuple[Contact, ...], *, holds: bool
) -> tuple[Status, str]:
    """Of a posture on the contacts that stay, and which joint cannot hold it."""
    if found.status is Status.SOLVED and not holds:
        return Status.OVERLOADED, limiting_joint(ik.kin, found.q, held)
    return found.status, ""


def eased_contacts(
    ik: IK,
    before: Keyframe,
    step: Step,
    surfaces: Collection[str],
    *,
    margin: float | None = None,
) -> tuple[tuple[Contact, ...], Seeds] | None:
    """Positions of earlier contacts for which a step is feasible.

    Solves the move's weight shift with these contacts free on their supports; where
    that works as they are, the posture in which the new contact closes.

    Args:
        ik: Workspace.
        before: Keyframe it starts from.
        step: That does not work.
        surfaces: Whose contacts are free.
        margin: Of the centre of mass to the border of its polygon [m]; None: the
            least of `MARGINS`.

    Returns:
        The contacts at their better places, and the posture found with them; None where
        that does not help either.
    """
    held = tuple(c for c in before.stance if c.surface not in {*step.breaks, *surfaces})
    moved = tuple(c for c in before.stance if c.surface in surfaces)
    leaving = tuple(c for c in before.stance if c.surface in step.breaks)
    middle = np.mean([c.position for c in (*held, *moved)], axis=0)
    rolling = tuple(rolled(ik, before.q, c, middle) for c in leaving)
    free = tuple(sliding(ik.world, c, 1.0) for c in moved)
    touching = {c.surface: c.support for c in moved}
    shift = balance_problem(
        ik.world,
        held=held,
        unloaded=rolling,
        q_reference=before.q,
        extra=free,
        touching=touching,
        margin=margin,
    )
    problems = {"shifted": shift}
    if step.makes is not None:
        new, at = step.makes, step.makes.position
        problems["touching"] = balance_problem(
            ik.world,
            held=tuple(rolled(ik, before.q, c, at) for c in held),
            q_reference=before.q,
            extra=(*free, sliding(ik.world, new, 1.0, loaded=False)),
            touching=touching | {new.surface: new.support},
            margin=margin,
        )
    for posture, problem in problems.items():
        solution = ik.solve_hard(problem, before.q)
        if solution.status is not Status.SOLVED:
            return None
        ik.kin.update(solution.q)
        eased = tuple(_touching_at(ik, c) for c in moved)
        if any(
            np.linalg.norm(a.position - b.position) > MOVED.eased
            for a, b in zip(eased, moved, strict=True)
        ):
            return eased, Seeds(**{posture: solution.q})
    return None


def _touching_at(ik: IK, c: Contact) -> Contact:
    """The contact where its surface touches the support at the present posture.

    It has not rolled: the posture in which it is made is yet to be found.
    """
    support = ik.world.supports[c.support]
    p = ik.kin.contact_point(c.surface, support.normal)
    return replace(c, position=support.project(p), link=None)


def approach_contact(
    ik: IK,
    held: tuple[Contact, ...],
    wanted: Contact,
    q: np.ndarray,
    hint: np.ndarray | None = None,
) -> tuple[Contact, Solution]:
    """The nearest contact to `wanted` that closes while the others carry the weight.

    Args:
        ik: Workspace.
        held: Contacts that stay.
        wanted: Where the contact would be liked.
        q: (nq,) to start from.
        hint: (nq,) a posture in which a similar contact closes.
    """
    problem = balance_problem(
        ik.world,
        held=held,
        q_reference=q,
        extra=(sliding(ik.world, wanted, APPROACH_WEIGHT, loaded=False),),
        touching={wanted.surface: wanted.support},
    )
    solution = ik.solve_hard(problem, q, hint=hint)
    ik.kin.update(solution.q)
    return _touching_at(ik, wanted), solution
