"""What the three optimisers share: the task, its cost and the verified result.

The cost is the contact-stability cost of the new contacts, (4.19) with (4.25),

    L_s = sum_i w || X_i - S_i ||^2        over the horizontal,

X_i the contact and S_i the projection of the mass that its limb supports. Each method
finds new contact positions on their supports, inside the supports' bounds (4.21), and a
posture that closes every contact, balanced and free of collisions.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np

from clamber.contact.contact import Contact
from clamber.errors import Status
from clamber.model.kinematics import Kinematics
from clamber.model.se3 import quat_from_matrix
from clamber.model.world import World
from clamber.step.ik import (
    IK,
    ContactGoal,
    PostureProblem,
    Residuals,
    base_clearance,
    contact_clearance,
    support_rotation,
)
from clamber.step.statics import (
    BALANCE_TOL,
    GRAVITY,
    Phase,
    StaticEquilibrium,
    TorqueLimits,
    contact_angle,
    contact_forces,
    contact_phase,
    projected_distance,
    static_equilibrium,
    strength_needed,
    theta_max,
)

STABILITY_WEIGHT = 5.0  # w of (4.25)
EFFORT_SHARE = 0.9  # of the effort limits, for holding: servos need the rest
SPARED_ARM = 0.004  # [m] times the weight: torque that is not counted on for holding
LEAST_SHARE = 0.25  # of the effort limits that is, all the same
CLEARANCE = 0.010  # [m] p_safe: between links, and between links and the scene
STANDING_SHARE = 0.8  # of its height as it starts: a pelvis as high stands
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
        fixed: The new contacts' positions are not references but where they are.
    """

    held: tuple[Contact, ...]
    new: tuple[Contact, ...]
    q_reference: np.ndarray
    fixed: bool = False
    directions: Mapping[str, np.ndarray] = field(
        default_factory=lambda: MappingProxyType({})
    )
    base_rotation: np.ndarray | None = None


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class KeyframeOptions:
    """How postures are optimised.

    Attributes:
        stability_weight: w of (4.25). Larger: contacts under the masses they support,
            farther from the demonstration.
        reference_weight: Of the distance to the demonstrated contact (`direct`).
        direction_weight: Of the demonstrated directions. Larger: looks more like the
            person; too large: contacts are missed.
        balance_margin: [m] the centre of mass stays this far inside the polygon.
        delta_stop: Stop when the cost changes by less (`lbfgs`, `gradient`).
        gradient_stop: Stop when the gradient's norm is below (`lbfgs`, `gradient`).
        max_iterations: Cap of the outer iterations.
        learning_rate: alpha of (4.23) (`gradient`).
    """

    stability_weight: float = STABILITY_WEIGHT
    reference_weight: float = 1.5
    direction_weight: float = 0.2
    balance_margin: float = 0.025
    delta_stop: float = 1e-6
    gradient_stop: float = 1e-3
    max_iterations: int = 200
    learning_rate: float = 0.1


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class ContactState:
    """A contact with its geometric stability (4.17).

    Attributes:
        contact: Where it is.
        projected_distance: d, horizontal, to the mass it supports [m].
        contact_angle: theta, from the vertical to the line to that mass [rad].
        phase: supporting, reach-to-supportable or sliding.
    """

    contact: Contact
    projected_distance: float
    contact_angle: float
    phase: Phase


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Keyframe:
    """An optimised posture and the evidence that it is stable."""

    q: np.ndarray
    contacts: tuple[ContactState, ...]
    com: np.ndarray
    com_margin: float
    equilibrium: StaticEquilibrium
    residuals: Residuals
    status: Status
    method: str
    iterations: int
    cost_before: float
    cost_after: float

    @property
    def stance(self) -> tuple[Contact, ...]:
        """The contacts alone."""
        return tuple(c.contact for c in self.contacts)


def held_goal(world: World, c: Contact, *, loaded: bool = True) -> ContactGoal:
    """A contact that keeps its place."""
    return ContactGoal(
        surface=c.surface,
        support=c.support,
        position=c.position,
        rotation=support_rotation(world.supports[c.support], c.quaternion),
        loaded=loaded,
        edge=c.edge,
        link=c.link,
    )


def keyframe_problem(
    world: World,
    task: KeyframeTask,
    options: KeyframeOptions,
    new: tuple[ContactGoal, ...],
) -> PostureProblem:
    """The posture problem of a stance, with `new` as goals of the new contacts."""
    where = {c.surface: c.support for c in (*task.held, *task.new)}
    rolling = [c.surface for c in task.held if c.edge is not None]
    return PostureProblem(
        goals=(*(held_goal(world, c) for c in task.held), *new),
        q_reference=task.q_reference,
        clearance=contact_clearance(
            world, base_clearance(world, CLEARANCE), where, rolling
        ),
        directions=task.directions,
        direction_weight=options.direction_weight,
        base_rotation=task.base_rotation,
        balance_margin=options.balance_margin,
    )


def prescribed_goals(
    world: World, task: KeyframeTask, positions: np.ndarray
) -> tuple[ContactGoal, ...]:
    """New contacts wanted at `positions` (n, 3), closed on their supports."""
    return tuple(
        ContactGoal(
            surface=c.surface,
            support=c.support,
            position=p,
            rotation=support_rotation(world.supports[c.support], c.quaternion),
            free=True,
            reference=HOLD_WEIGHT,
        )
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


def contact_state(kin: Kinematics, c: Contact, *, loaded: bool = True) -> ContactState:
    """Geometric stability of a contact at the present posture."""
    mass = kin.landmark(kin.world.robot.limb_of(c.surface).root)[1]
    d = projected_distance(c.position, mass)
    theta = contact_angle(c.position, mass)
    length = float(np.linalg.norm(mass - c.position))
    support = kin.world.supports[c.support]
    limit = theta_max(support.friction)
    phase = contact_phase(d, length, limit, loaded=loaded)
    # On a slope the line to the mass must lie within the cone about the normal too.
    slope = contact_angle(c.position, mass, support.normal)
    if support.normal[2] < 1.0 and slope > math.atan(support.friction):
        phase = "sliding"
    return ContactState(
        contact=c,
        projected_distance=d,
        contact_angle=theta,
        phase=phase,
    )


def bearing_frames(
    kin: Kinematics, contacts: Sequence[Contact]
) -> tuple[list[str], np.ndarray, np.ndarray, np.ndarray]:
    """Names, points (n, 3), normals (n, 3), friction (n,) of all bearing points."""
    names, points, normals, mu = [], [], [], []
    for c in contacts:
        support = kin.world.supports[c.support]
        p = kin.bearing_points(c.surface, support.normal, c.edge)
        names += [c.surface] * len(p)
        points.append(p)
        normals.append(np.tile(support.normal, (len(p), 1)))
        mu += [support.friction] * len(p)
    return names, np.concatenate(points), np.concatenate(normals), np.array(mu)


def equilibrium_at(kin: Kinematics, contacts: tuple[Contact, ...]) -> StaticEquilibrium:
    """Static equilibrium with cones and `holding_limits` at the present posture."""
    names, points, normals, mu = bearing_frames(kin, contacts)
    return static_equilibrium(
        points,
        normals,
        mu,
        kin.com.copy(),
        kin.world.mass,
        names=names,
        torque=torque_limits(kin, names, points),
    )


def holds(kin: Kinematics, contacts: tuple[Contact, ...]) -> bool:
    """Whether forces within cones and torque limits hold the present posture.

    What `equilibrium_at` says without a margin, at a hundredth of the cost.
    """
    names, points, normals, mu = bearing_frames(kin, contacts)
    torque = torque_limits(kin, names, points)
    com, mass = kin.com.copy(), kin.world.mass
    found = contact_forces(points, normals, mu, com, mass, torque=torque)
    return found.residual <= BALANCE_TOL


def weakness(kin: Kinematics, contacts: tuple[Contact, ...]) -> str:
    """Which joint is too weak where contacts do not hold the present posture."""
    names, points, normals, mu = bearing_frames(kin, contacts)
    torque = torque_limits(kin, names, points)
    needed = strength_needed(
        points, normals, mu, kin.com.copy(), kin.world.mass, torque=torque
    )
    if needed is None:
        return f"{Status.OVERLOADED.value}, however strong its joints"
    share, j = needed
    counted = float(torque.limits[j])
    return (
        f"{Status.OVERLOADED.value}: {torque.names[j]} would have to bear"
        f" {share * counted:.1f} N m; {counted:.1f} of its"
        f" {float(kin.world.tau_max[j]):g} are counted on"
    )


def holding_limits(world: World, bearing: np.ndarray) -> np.ndarray:
    """(na,) torques that are counted on to hold a posture [N m].

    `EFFORT_SHARE` of the effort limits; of joints that a contact loads, less what one
    costs that lies beside where it was planned: `SPARED_ARM` times the weight is 16 mm
    for one that bears a quarter. To a strong joint that is nothing, to a weak wrist
    much.

    Args:
        world: Robot and scene.
        bearing: (na,) bool, joints that a contact loads.
    """
    spared = SPARED_ARM * world.mass * GRAVITY * bearing
    least = LEAST_SHARE * world.tau_max
    return np.maximum(EFFORT_SHARE * world.tau_max - spared, least)


def torque_limits(
    kin: Kinematics, names: Sequence[str], points: np.ndarray
) -> TorqueLimits:
    """What the joints bear, `holding_limits`, with forces at bearing points.

    Args:
        kin: At the posture.
        names: Surface of each point.
        points: (n, 3) in the world.
    """
    w = kin.world
    J = np.concatenate(
        [
            kin.point_jacobian(w.surfaces[n].body, p).copy()
            for n, p in zip(names, points, strict=True)
        ]
    )
    return TorqueLimits(
        jacobian=J,
        gravity=kin.gravity(),
        dofs=w.dadr,
        limits=holding_limits(w, np.abs(J[:, w.dadr]).max(axis=0) > 0.0),
        names=w.joints,
    )


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
    """Measure a posture: contacts where they are, margins, equilibrium, status.

    Geometry proposes and statics verifies: a posture counts as stable when every
    constraint holds and forces within friction cones and torque limits exist. Where
    they do not and a new contact is past its contact angle, that is named as the
    reason.
    """
    world = ik.world
    kin = ik.kin
    kin.update(q)
    new = tuple(
        Contact(
            surface=c.surface,
            support=c.support,
            position=world.supports[c.support].project(p),
            quaternion=_orientation(kin, c),
            link=quat_from_matrix(kin.rotation(world.surfaces[c.surface].body)),
        )
        for c, p in zip(task.new, new_positions(kin, task), strict=True)
    )
    measured = KeyframeTask(
        held=(*task.held, *new), new=(), q_reference=q, directions=task.directions
    )
    residuals = ik.residuals(keyframe_problem(world, measured, options, ()), q)
    states = tuple(contact_state(kin, c) for c in measured.held)
    cost_after, _ = stability_cost(
        kin, task, new_positions(kin, task), options.stability_weight
    )
    com = kin.com.copy()
    equilibrium = equilibrium_at(kin, measured.held)
    status = residuals.status
    fresh = {c.surface for c in task.new}
    if status is Status.SOLVED and not equilibrium.feasible:
        slides = any(
            s.phase == "sliding" and s.contact.surface in fresh for s in states
        )
        status = Status.SLIDING if slides else Status.OVERLOADED
    return Keyframe(
        q=q,
        contacts=states,
        com=com,
        com_margin=residuals.com_margin,
        equilibrium=equilibrium,
        residuals=residuals,
        status=status,
        method=method,
        iterations=iterations,
        cost_before=cost_before,
        cost_after=cost_after,
    )


def standing_share(world: World, stance: Sequence[Contact], q: np.ndarray) -> float:
    """Height of the pelvis over its supports, against that over the ground at first.

    Over the nearest of them, along its normal. A robot on its feet alone stands from
    `STANDING_SHARE` on; below, it squats.
    """
    over = [float(world.supports[c.support].height(q[:3])) for c in stance]
    return min(over) / float(world.home[2])


def contact_drift(kin: Kinematics, c: Contact) -> float:
    """Distance of a contact from where it should be at the present posture [m]."""
    n = kin.world.supports[c.support].normal
    p = kin.contact_point(c.surface, n, c.edge)
    return float(np.linalg.norm(p - c.position - kin.roll(c.surface, n, c.link)))


def _orientation(kin: Kinematics, c: Contact) -> np.ndarray:
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
