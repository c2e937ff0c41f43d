"""Whether this robot stands: the measures of `statics` at its postures.

Geometry proposes (where each contact lies under the mass that it supports), forces
verify (friction cones and the torques that joints are counted on to hold).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from clamber import _core
from clamber.contact.contact import Contact
from clamber.errors import Status
from clamber.model.kinematics import Kinematics
from clamber.model.records import short_repr
from clamber.model.world import World, limb_links
from clamber.step.statics import (
    ContactPoints,
    Load,
    Phase,
    StaticEquilibrium,
    TorqueLimits,
    contact_angle,
    contact_phase,
    projected_distance,
    static_equilibrium,
    strength_needed,
    theta_max,
)
from clamber.step.tasks import packed_contacts

EFFORT_SHARE: float = _core.EFFORT_SHARE  # of the effort limits, for holding
# [m] of the centre of mass of a shifted or touching posture, from what joints bear, of
# the robot's size.
LEAST_ROOM: float = _core.LEAST_ROOM
MISSED = 0.001  # [m] a surface that stays as far from its support has not reached it
STRETCHED = 0.99  # of a limb's length, from root to end
AT_LIMIT = 0.01  # [rad] a joint that is nearer to its limit is at it
STANDING_SHARE = 0.8  # of its height as it starts: a pelvis as high stands


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

    __repr__ = short_repr


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
    if support.normal[2] < 1.0:
        slope = contact_angle(c.position, mass, support.normal)
        phase = "sliding" if slope > math.atan(support.friction) else phase
    return ContactState(
        contact=c,
        projected_distance=d,
        contact_angle=theta,
        phase=phase,
    )


def statics_at(
    kin: Kinematics, q: np.ndarray, contacts: Sequence[Contact]
) -> tuple[ContactPoints, Load, TorqueLimits]:
    """Contact points, weight and torque limits for the statics at `q` (nq,).

    The torques that are counted on to hold a posture are nine tenths of the effort
    limits; of joints that a contact loads, less what one costs that lies beside where
    it was planned: 4 mm times the weight is 16 mm for one that bears a quarter. To a
    strong joint that is nothing, to a weak wrist much. A quarter of its limit a joint
    always has.
    """
    w = kin.world
    points, normals, mu, of, com, jacobian, gravity, limits = kin.core.statics(
        *packed_contacts(w, contacts), q
    )
    return (
        ContactPoints(
            points=points,
            normals=normals,
            mu=mu,
            names=[contacts[int(i)].surface for i in of],
        ),
        Load(com=com, mass=w.mass),
        TorqueLimits(
            jacobian=jacobian,
            gravity=gravity,
            dofs=w.dadr,
            limits=limits,
            names=w.joints,
        ),
    )


def equilibrium_at(
    kin: Kinematics, q: np.ndarray, contacts: Sequence[Contact]
) -> StaticEquilibrium:
    """Static equilibrium at `q` (nq,) with the planner's cones and torque limits."""
    points, load, torque = statics_at(kin, q, contacts)
    return static_equilibrium(points, load, torque=torque)


def is_stable(kin: Kinematics, q: np.ndarray, contacts: Sequence[Contact]) -> bool:
    """Whether forces within cones and torque limits hold the robot at `q` (nq,).

    What `equilibrium_at` says without a margin, at a tenth of the cost.
    """
    return kin.core.is_stable(*packed_contacts(kin.world, contacts), q)


def limiting_joint(kin: Kinematics, q: np.ndarray, contacts: Sequence[Contact]) -> str:
    """Joint whose effort limit prevents static equilibrium at `q` (nq,)."""
    points, load, torque = statics_at(kin, q, contacts)
    needed = strength_needed(points, load, torque)
    if needed is None:
        return f"{Status.OVERLOADED.value}, however strong its joints"
    share, j = needed
    if share <= 1.0:  # as it stands, but `LEAST_ROOM` is asked for
        return (
            f"{Status.OVERLOADED.value} with {1e3 * LEAST_ROOM:.0f} mm to spare for the"
            f" centre of mass: {torque.names[j]} is near its limit of"
            f" {float(kin.world.tau_max[j]):g} N m"
        )
    counted = float(torque.limits[j])
    return (
        f"{Status.OVERLOADED.value}: {torque.names[j]} would need"
        f" {share * counted:.1f} N m; {counted:.1f} N m of its limit of"
        f" {float(kin.world.tau_max[j]):g} N m are available to the planner"
    )


def out_of_reach(kin: Kinematics, q: np.ndarray, c: Contact, pair: int = -1) -> str:
    """Why a contact cannot be made, as far as the best posture `q` (nq,) tells.

    How far its surface stays from its support, whether its limb is stretched, which of
    its joints are at a limit, and which two shapes cannot come nearer.

    Args:
        kin: Workspace.
        q: The posture.
        c: The contact.
        pair: Of shapes that are as near as they may be; -1: none.
    """
    w = kin.world
    kin.update(q)
    support, limb = w.supports[c.support], w.robot.limb_of(c.surface)
    p = kin.contact_point(c.surface, support.normal)
    away = float(np.linalg.norm(p - support.nearest(p)))
    said = [f"stays {1e3 * away:.0f} mm from {c.support}"] if away >= MISSED else []
    a, b, end = (kin.landmark(x)[1] for x in (limb.root, limb.middle, limb.end))
    length = float(np.linalg.norm(b - a) + np.linalg.norm(end - b))
    if float(np.linalg.norm(end - a)) > STRETCHED * length:
        said.append(f"the {limb.name.replace('_', ' ')}, {length:.2f} m, is stretched")
    links, m = limb_links(w, c.surface), w.model
    room = np.minimum(q[w.qadr] - w.q_min[w.dadr], w.q_max[w.dadr] - q[w.qadr])
    mine = np.isin(m.dof_bodyid[w.dadr], list(links))
    ends = [w.joints[i] for i in np.flatnonzero(mine & (room < AT_LIMIT))]
    said += [f"{', '.join(ends)} at a limit"] if ends else []
    if pair >= 0:
        shapes = (m.geom(int(g)).name for g in w.pairs[pair])
        said.append(f"{' and '.join(shapes)} keep their distance")
    why = ", ".join(said)
    return f"{Status.UNREACHABLE.value} ({c.surface}: {why})" if why else ""


def standing_share(world: World, stance: Sequence[Contact], q: np.ndarray) -> float:
    """Height of the pelvis over its supports, against that over the ground at first.

    Over the nearest of them, along its normal. A robot on its feet alone stands from
    `STANDING_SHARE` on; below, it squats.
    """
    over = [float(world.supports[c.support].height(q[:3])) for c in stance]
    return min(over) / float(world.home[2])
