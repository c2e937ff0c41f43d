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
    contact_clearance,
)
from clamber.step.posture import CLEARANCE, Keyframe
from clamber.step.stability import is_stable, limiting_joint
from clamber.step.tasks import SurfaceTask, closed, sliding

REACH_ANGLE = np.radians(25.0)  # phi of (4.27)
MARGINS = (0.045, 0.025)  # [m] of the centre of mass while a contact moves: the first
# that can be kept
ELLIPSE_WEIGHT = 2.0  # soft task (4.28)
LEAN_WEIGHT = 0.5  # soft task (4.27)
APPROACH_WEIGHT = 20.0  # of the moving surface, where the contact may still give way


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
        status: Of the worst of its postures, with its residuals; OVERLOADED where the
            contacts that stay and the joints cannot hold one of them.
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
    iterations: int
    status: Status
    residuals: Residuals
    note: str = ""

    __repr__ = short_repr

    @property
    def leaving(self) -> tuple[Contact, ...]:
        """Contacts that are broken, as they were."""
        return tuple(c for c in self.stance if c.surface in self.step.breaks)


def reach_to_support(p1: np.ndarray, p2: np.ndarray, R_WB: np.ndarray) -> np.ndarray:
    """(pitch, roll, yaw) of the moving link at its contact (4.26, 4.27) [rad].

    Args:
        p1: (3,) present contact point in the world.
        p2: (3,) goal contact point in the world.
        R_WB: (3, 3) the pelvis in the world.
    """
    p = p1 - p2
    n = np.linalg.norm(p)
    return REACH_ANGLE * (R_WB.T @ (p / n)) if n > 1e-9 else np.zeros(3)


def lean_direction(p1: np.ndarray, p2: np.ndarray, R_WB: np.ndarray) -> np.ndarray:
    """(3,) unit vector from the new contact to the mass it will support.

    The first two angles of (4.27) lean it from the vertical towards where the contact
    comes from, so that the mass arrives behind its contact and moves over it as load
    comes on.
    """
    pitch, roll, _ = reach_to_support(p1, p2, R_WB)
    horizontal = R_WB @ np.array([pitch, roll, 0.0])
    horizontal[2] = 0.0
    angle = float(np.linalg.norm(horizontal))
    horizontal *= np.sin(angle) / max(angle, 1e-9)
    return horizontal + np.array(
        [0.0, 0.0, np.sqrt(max(1.0 - horizontal @ horizontal, 0.0))]
    )


def rolled(ik: IK, q: np.ndarray, c: Contact, towards: np.ndarray) -> Contact:
    """A flat contact on the edge that lies farthest `towards` (3,); others as they are.

    A foot that is about to leave may lift its heel: what it gains in reach is what a
    person gains on tiptoe.
    """
    edges = ik.world.edges[c.surface]
    if not edges or c.edge is not None:
        return c
    ik.kin.update(q)
    normal = ik.world.supports[c.support].normal
    points = np.array(
        [ik.kin.contact_point(c.surface, normal, i) for i in range(len(edges))]
    )
    i = int(np.argmax(points @ (towards - c.position)))
    return replace(c, edge=i, position=points[i])


def balance_problem(
    world: World,
    *,
    held: tuple[Contact, ...],
    unloaded: tuple[Contact, ...] = (),
    q_reference: np.ndarray,
    extra: tuple[SurfaceTask, ...] = (),
    posture_weight: float = 0.08,
    touching: Mapping[str, str] | None = None,
    margin: float = MARGINS[-1],
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
        margin: Of the centre of mass to the border of its polygon [m].
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
        clearance=contact_clearance(world, CLEARANCE, where, rolling),
        balance_margin=margin,
        posture_weight=posture_weight,
        ellipse_weight=ELLIPSE_WEIGHT,
        com_weight=0.3,
        base_weight=0.0,
    )


def plan_transition(
    ik: IK,
    before: Keyframe,
    after: Keyframe,
    step: Step,
    *,
    margin: float,
) -> Transition:
    """Shift, touch and settle between two keyframes.

    Args:
        ik: Workspace.
        before: Keyframe it starts from.
        after: Keyframe it leads to.
        step: What changes between them.
        margin: Of the centre of mass to the border of its polygon [m].
    """
    world = ik.world
    new = step.makes.surface if step.makes is not None else None
    held = tuple(c for c in after.stance if c.surface != new)
    leaving = tuple(c for c in before.stance if c.surface in step.breaks)
    middle = np.mean([c.position for c in held], axis=0)
    rolling = tuple(rolled(ik, before.q, c, middle) for c in leaving)
    shift = ik.solve_hard(
        balance_problem(
            world, held=held, unloaded=rolling, q_reference=before.q, margin=margin
        ),
        before.q,
        hint=step.seeds.shifted,
    )
    solutions, touching = [shift], after.q
    if step.makes is not None:
        made = next(c for c in after.stance if c.surface == step.makes.surface)
        step = replace(step, makes=made)
        if shift.status is Status.SOLVED:
            touch = _touch(
                ik, held, made, shift.q, after.q, margin, step.seeds.touching
            )
            solutions.append(touch)
            touching = touch.q
    worst = max(solutions, key=lambda s: list(Status).index(s.status))
    status, note = worst.status, ""
    for s in solutions if status is Status.SOLVED else ():
        if not is_stable(ik.kin, s.q, held):
            status, note = Status.OVERLOADED, limiting_joint(ik.kin, s.q, held)
    return Transition(
        step=step,
        before=before.q,
        shifted=shift.q,
        touching=touching,
        after=after.q,
        stance=before.stance,
        held=held,
        rolling=rolling,
        margin=margin,
        iterations=sum(s.iterations for s in solutions),
        status=status,
        note=note,
        residuals=worst.residuals,
    )


def _touch(
    ik: IK,
    held: tuple[Contact, ...],
    made: Contact,
    shifted: np.ndarray,
    after: np.ndarray,
    margin: float,
    hint: np.ndarray | None,
) -> Solution:
    """Close the new contact from the loaded posture, the weight still on the rest."""
    world, kin = ik.world, ik.kin
    kin.update(shifted)
    support = world.supports[made.support]
    p1 = kin.contact_point(made.surface, support.normal)
    lean = lean_direction(p1, made.position, kin.rotation(world.base))
    problem = balance_problem(
        world,
        held=held,
        unloaded=(made,),
        q_reference=0.5 * (shifted + after),
        margin=margin,
    )
    problem = replace(problem, lean=(made.surface, lean, LEAN_WEIGHT))
    return ik.solve_hard(problem, after, hint=hint)


def eased_contacts(
    ik: IK,
    before: Keyframe,
    step: Step,
    surfaces: Collection[str],
    *,
    margin: float = MARGINS[-1],
) -> tuple[tuple[Contact, ...], Seeds] | None:
    """Where earlier contacts should have been for a move to work.

    Solves the move's weight shift with these contacts free on their supports; where
    that works as they are, the posture in which the new contact closes.

    Args:
        ik: Workspace.
        before: Keyframe it starts from.
        step: That does not work.
        surfaces: Whose contacts are free.
        margin: Of the centre of mass to the border of its polygon [m].

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
    """The nearest contact to `wanted` that closes while the others bear the weight.

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
