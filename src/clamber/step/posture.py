"""Shared by the three optimisers: the task, its cost and the verified result.

The cost is the contact-stability cost of the new contacts, (4.19) with (4.25),

    L_s = sum_i w || X_i - S_i ||^2        over the horizontal,

X_i the contact and S_i the projection of the mass that its limb supports. Each method
finds new contact positions on their supports, inside the supports' bounds (4.21), and a
posture that closes every contact, balanced and free of collisions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np

from clamber import _core
from clamber.contact.contact import Contact
from clamber.errors import Status
from clamber.model.kinematics import Kinematics
from clamber.model.records import short_repr
from clamber.model.se3 import quat_from_matrix
from clamber.model.world import World
from clamber.step.ik import (
    IK,
    PostureProblem,
    Residuals,
    contact_clearance,
)
from clamber.step.stability import ContactState, contact_state, is_stable
from clamber.step.tasks import SurfaceTask, closed, sliding, support_rotation

STABILITY_WEIGHT = 5.0  # w of (4.25)
CLEARANCE: float = _core.CLEARANCE  # [m] p_safe: of links from links and the scene
# [m] balance margin of a robust plan: on level supports, what is off takes 3 cm of it.
ROBUST_BALANCE = 0.031
HOLD_WEIGHT = 40.0  # of a new contact at a position that an outer method prescribes


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class KeyframeTask:
    """One stance to find a stable posture for.

    Attributes:
        held: Contacts that keep their place.
        new: Contacts to optimise; their positions are the references.
        directions: Demonstrated body segments, unit vectors in the world.
        q_reference: (nq,) the posture to stay close to where nothing else decides.
        base_rotation: (3, 3) preferred R_WB.
        fixed: The new contacts' positions are prescribed, not references.
    """

    held: tuple[Contact, ...]
    new: tuple[Contact, ...]
    q_reference: np.ndarray
    fixed: bool = False
    directions: Mapping[str, np.ndarray] = field(
        default_factory=lambda: MappingProxyType({})
    )
    base_rotation: np.ndarray | None = None

    __repr__ = short_repr


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class KeyframeOptions:
    """How postures are optimised.

    Attributes:
        stability_weight: w of (4.25). Larger: contacts under the masses they support,
            farther from the demonstration.
        reference_weight: Weight of the distance to the demonstrated contact (`direct`).
        direction_weight: Weight of the demonstrated directions of body segments.
            Larger: looks more like the person; too large: contacts are missed.
        balance_margin: Least distance of the centre of mass from the border of the
            support polygon [m]; of a robot with short legs less, in proportion.
        robust: Accept only changes throughout which the `robust_margin` is positive.
        delta_stop: Stop when the cost changes by less (`lbfgs`, `gradient`).
        gradient_stop: Stop when the gradient's norm is below (`lbfgs`, `gradient`).
        max_iterations: Largest number of outer iterations.
        learning_rate: Step size alpha of (4.23) (`gradient`).
    """

    stability_weight: float = STABILITY_WEIGHT
    reference_weight: float = 1.5
    direction_weight: float = 0.2
    balance_margin: float = 0.025
    robust: bool = False
    delta_stop: float = 1e-6
    gradient_stop: float = 1e-3
    max_iterations: int = 200
    learning_rate: float = 0.1

    __repr__ = short_repr


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Keyframe:
    """An optimised posture and the evidence that it is stable.

    With how much in reserve, `Plan.equilibria` tells.
    """

    q: np.ndarray
    contacts: tuple[ContactState, ...]
    com: np.ndarray
    com_margin: float
    residuals: Residuals
    status: Status
    method: str
    iterations: int
    cost_before: float
    cost_after: float

    __repr__ = short_repr

    @property
    def stance(self) -> tuple[Contact, ...]:
        """The contacts alone."""
        return tuple(c.contact for c in self.contacts)


def keyframe_problem(
    world: World,
    task: KeyframeTask,
    options: KeyframeOptions,
    new: tuple[SurfaceTask, ...],
) -> PostureProblem:
    """The posture problem of a stance, with `new` as tasks of the new contacts."""
    where = {c.surface: c.support for c in (*task.held, *task.new)}
    rolling = [c.surface for c in task.held if c.edge is not None]
    return PostureProblem(
        tasks=(*(closed(world, c) for c in task.held), *new),
        q_reference=task.q_reference,
        clearance=contact_clearance(
            world, CLEARANCE * world.length_scale, where, rolling
        ),
        directions=task.directions,
        direction_weight=options.direction_weight,
        base_rotation=task.base_rotation,
        balance_margin=max(
            options.balance_margin * world.length_scale, ROBUST_BALANCE * options.robust
        ),
    )


def prescribed(
    world: World, task: KeyframeTask, positions: np.ndarray
) -> tuple[SurfaceTask, ...]:
    """New contacts wanted at `positions` (n, 3), closed on their supports."""
    return tuple(
        sliding(world, replace(c, position=p), HOLD_WEIGHT)
        for c, p in zip(task.new, positions, strict=True)
    )


def stability_cost(
    kin: Kinematics, task: KeyframeTask, positions: np.ndarray, weight: float
) -> tuple[float, np.ndarray]:
    """L_s and its gradient (n, 2) in the horizontal contact positions (4.24).

    `kin` is at the posture that goes with the positions (n, 3); the gradient holds the
    supported masses still, as the method does.
    """
    cost, grad = 0.0, np.zeros((len(task.new), 2))
    for i, (c, x) in enumerate(zip(task.new, positions, strict=True)):
        mass = kin.landmark(kin.world.robot.limb_of(c.surface).root)[1]
        e = x[:2] - mass[:2]
        cost += weight * float(e @ e)
        grad[i] = 2.0 * weight * e
    return cost, grad


def new_positions(kin: Kinematics, task: KeyframeTask) -> np.ndarray:
    """(n, 3) where the new contacts touch at the present posture."""
    supports = kin.world.supports
    return np.array(
        [kin.contact_point(c.surface, supports[c.support].normal) for c in task.new]
    ).reshape(-1, 3)


def finish(
    ik: IK,
    task: KeyframeTask,
    options: KeyframeOptions,
    q: np.ndarray,
    *,
    method: str,
    iterations: int,
    cost_before: float,
) -> Keyframe:
    """Measure a posture: contacts where they are, margin, status.

    Geometry proposes and statics verifies: a posture counts as stable when every
    constraint holds and forces within friction cones and torque limits exist. Where
    they do not and a new contact is past its contact angle, that is named as the
    reason.
    """
    world = ik.world
    kin = ik.kin
    kin.update(q)
    places = new_positions(kin, task)
    new = tuple(
        Contact(
            surface=c.surface,
            support=c.support,
            position=world.supports[c.support].project(p),
            quaternion=orientation_at(kin, c),
            link=quat_from_matrix(kin.rotation(world.surfaces[c.surface].body)),
        )
        for c, p in zip(task.new, places, strict=True)
    )
    measured = KeyframeTask(
        held=(*task.held, *new), new=(), q_reference=q, directions=task.directions
    )
    residuals = ik.residuals(keyframe_problem(world, measured, options, ()), q)
    states = tuple(contact_state(kin, c) for c in measured.held)
    cost_after, _ = stability_cost(kin, task, places, options.stability_weight)
    com = kin.com.copy()
    status = residuals.status
    fresh = {c.surface for c in task.new}
    if status is Status.SOLVED and not is_stable(kin, q, measured.held):
        slides = any(
            s.phase == "sliding" and s.contact.surface in fresh for s in states
        )
        status = Status.SLIDING if slides else Status.OVERLOADED
    return Keyframe(
        q=q,
        contacts=states,
        com=com,
        com_margin=residuals.com_margin,
        residuals=residuals,
        status=status,
        method=method,
        iterations=iterations,
        cost_before=cost_before,
        cost_after=cost_after,
    )


def orientation_at(kin: Kinematics, c: Contact) -> np.ndarray:
    """The contact's orientation: as reached by a flat surface, else as demonstrated."""
    s = kin.world.surfaces[c.surface]
    if s.rotation is None:
        return quat_from_matrix(
            support_rotation(kin.world.supports[c.support], c.quaternion)
        )
    R = kin.rotation(s.body) @ s.rotation
    return quat_from_matrix(
        support_rotation(kin.world.supports[c.support], quat_from_matrix(R))
    )
