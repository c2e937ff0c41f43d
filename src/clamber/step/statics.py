"""Static stability: by geometry, and by forces.

Geometry proposes (projected distance and contact angle of each contact), forces verify
(friction cones and joint torques). Everything here works on arrays, without a robot
model.

Shapes: nc contact points (a foot has four, all under its name), m edges of a friction
cone, nv velocities and na actuated joints of the robot.
Friction cones are replaced by pyramids from INSIDE: a verdict that a stance holds is on
the safe side, by up to 29 % of mu with four edges and 8 % with eight.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from clamber import _core
from clamber.model.records import short_repr

GRAVITY = 9.81  # [m/s^2]
MAX_CONTACT_ANGLE = math.radians(25.0)  # found by experiment in the thesis
CONE_EDGES = 4
BALANCE_TOL: float = _core.BALANCE_TOL  # 1e-6: wrench left over, in weights

_STAYS = 1e-4  # [m/s] slower contacts stay where the stance gives way

Phase = Literal["supporting", "reach-to-supportable", "sliding"]


# The geometric measure of one contact.


def projected_distance(
    contact_point: ArrayLike,
    supported_point: ArrayLike,
    normal: ArrayLike = (0.0, 0.0, 1.0),
) -> float:
    """Distance d along the surface from a contact to the mass it supports (4.17).

    Args:
        contact_point: (3,) the contact [m].
        supported_point: (3,) shoulder or hip [m].
        normal: (3,) unit normal of the surface; d is measured across it.

    Returns:
        d [m], not negative.
    """
    r = np.asarray(supported_point, dtype=float) - np.asarray(contact_point)
    n = np.asarray(normal, dtype=float)
    return float(np.linalg.norm(r - n * (r @ n)))


def contact_angle(
    contact_point: ArrayLike,
    supported_point: ArrayLike,
    normal: ArrayLike = (0.0, 0.0, 1.0),
) -> float:
    """Angle theta from the vertical to the line from a contact to its mass [rad].

    0 with the mass right above, pi where it hangs right below.

    Args:
        contact_point: (3,) the contact [m].
        supported_point: (3,) shoulder or hip [m].
        normal: (3,) unit vector to measure from in place of the vertical.
    """
    r = np.subtract(supported_point, contact_point, dtype=float)
    n = np.asarray(normal, dtype=float)
    along = float(r @ n)
    x, y, z = (r - along * n).tolist()
    return math.atan2(math.hypot(x, y, z), along)


def theta_max(mu: float) -> float:
    """Largest angle at which a contact does not slide: min(atan mu, 25 deg) [rad]."""
    return min(math.atan(mu), MAX_CONTACT_ANGLE)


def contact_phase(d: float, l: float, theta_max: float, *, loaded: bool) -> Phase:
    """Whether a contact supports its mass: d <= l sin(theta_max).

    Args:
        d: Projected distance [m].
        l: Length of the line from the contact to its mass [m].
        theta_max: Bound on the contact angle [rad].
        loaded: Whether the contact bears load already.
    """
    if d > l * math.sin(theta_max):
        return "sliding"
    return "supporting" if loaded else "reach-to-supportable"


# Forces.


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class ContactPoints:
    """Contact points with normals and friction.

    Attributes:
        points: (nc, 3) [m].
        normals: (nc, 3) unit normals out of the supports.
        mu: (nc,) friction coefficients, positive.
        names: (nc,) the contact that each point belongs to.
        cone_edges: m of the pyramids inside their friction cones.
    """

    points: np.ndarray
    normals: np.ndarray
    mu: np.ndarray
    names: Sequence[str]
    cone_edges: int = CONE_EDGES

    __repr__ = short_repr

    def __post_init__(self) -> None:
        """Check that the shapes agree."""
        n = len(self.points)
        if not n == len(self.normals) == len(self.mu) == len(self.names):
            raise ValueError(f"{n} points, but other numbers of normals, mu or names")

    @property
    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
        """Arrays in the form that the core takes."""
        return self.points, self.normals, self.mu, self.cone_edges


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Load:
    """The wrench that the contacts carry.

    Attributes:
        com: (3,) centre of mass [m].
        mass: [kg].
    """

    com: np.ndarray
    mass: float

    __repr__ = short_repr


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class TorqueLimits:
    """Torque limits: |g - J^T f| <= limits, joint by joint.

    Attributes:
        jacobian: (3 nc, nv) of the contact points, stacked, in the world frame.
        gravity: (nv,) generalized forces that hold the robot against gravity.
        dofs: (na,) columns of the joints to look at: all but those of the floating
            base, whose rows are the balance of the whole body; a joint without a motor
            comes in with limit 0.
        limits: (na,) [N m].
        names: (na,) joint names.
    """

    jacobian: np.ndarray
    gravity: np.ndarray
    dofs: np.ndarray
    limits: np.ndarray
    names: Sequence[str]

    __repr__ = short_repr

    def __post_init__(self) -> None:
        """Check that the shapes agree."""
        na = len(self.dofs)
        if len(self.limits) != na or len(self.names) != na:
            raise ValueError(f"{na} dofs, but other numbers of limits or names")
        if self.jacobian.ndim != 2 or self.jacobian.shape[1] != len(self.gravity):
            raise ValueError(
                f"jacobian {self.jacobian.shape}, expected (3 nc, {len(self.gravity)})"
            )

    @property
    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Arrays in the form that the core takes."""
        return self.jacobian, self.gravity, self.dofs, self.limits

    def torques(self, forces: np.ndarray) -> np.ndarray:
        """(na,) joint torques that go with contact forces (nc, 3) [N m]."""
        load = self.jacobian[:, self.dofs].T @ forces.ravel()
        return self.gravity[self.dofs] - load


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class ContactForces:
    """Forces that hold a stance, or come as near to it as they can.

    Attributes:
        forces: (nc, 3) on the robot, in the world frame, within the cones [N].
        residual: Norm of what they leave unbalanced, in weights (moments: in weights
            times a metre; joint torques beyond their limits included). Up to
            `BALANCE_TOL` where the stance holds with forces of the order of the weight;
            more where it must jam itself between walls with many times that. 1, and no
            forces, without contacts or of what is no number.
    """

    forces: np.ndarray
    residual: float

    __repr__ = short_repr


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class StaticEquilibrium:
    """Whether contact forces and joint torques can hold a posture, and how firmly.

    Attributes:
        feasible: Whether they can: `margin >= 0` but for rounding.
        margin: The push margin: the largest horizontal force on the base [m g], along
            a line through the centre of mass, that the stance holds in every direction.
            Negative: it falls unless a constant push of at least this size helps
            it; -1 where no push up to the weight does. At most 1.
        limiting: The contact or joint that limits it: in the motion with which the
            stance gives way to the weakest push, the one that yields fastest (m/s of a
            contact, rad/s of a joint; the duals of the LP). A slipping contact; where
            the robot tips over, the one that lifts off and would have to pull; a joint
            whose torque does not suffice; the pivot where nothing else moves. None
            where a push of the whole weight is held. Of several that yield alike, the
            first.
        forces: (nc, 3) least contact forces for the posture as it is [N].
        torques: (na,) joint torques with these forces [N m]; None without limits.
    """

    feasible: bool
    margin: float
    limiting: str | None
    forces: np.ndarray
    torques: np.ndarray | None = None

    __repr__ = short_repr


def contact_frames(normals: np.ndarray) -> np.ndarray:
    """Rotations (nc, 3, 3) whose last columns are the unit normals (nc, 3).

    The first two columns are the world's y and z after the smallest rotation that takes
    its x to the normal (for an upright normal: y and -x). Continuous except at -x.
    This is the basis that Klampt's friction cones start from.
    """
    return _core.contact_frames(normals)


def cone_generators(normals: np.ndarray, mu: np.ndarray, edges: int) -> np.ndarray:
    """Edges (nc, m, 3) of the pyramids INSIDE the friction cones, normal part 1."""
    return _core.cone_generators(normals, mu, edges)


def is_statically_stable(contacts: ContactPoints, com: np.ndarray) -> bool:
    """Whether forces within the friction cones can balance gravity: the quick test.

    Args:
        contacts: Where the supports push.
        com: (3,) centre of mass [m].
    """
    return _core.is_statically_stable(*contacts.arrays, com)


def contact_forces(
    contacts: ContactPoints,
    load: Load,
    *,
    torque: TorqueLimits | None = None,
    price: np.ndarray | None = None,
) -> ContactForces:
    """The least contact forces that hold the robot against gravity.

    Minimises `sum_i p_i (fn_i^2 + 4 ft_i^2) + 1e8 |residual|^2` over forces within the
    pyramids inside the friction cones; the residual is what is left of the balance of
    the whole body (and of joint torques beyond their limits). Strictly convex and
    always feasible: the forces are unique and continuous in every argument, and where
    the stance cannot hold they are the best effort.

    Args:
        contacts: Where the supports push.
        load: What they bear.
        torque: Joint torques to keep within their limits.
        price: (nc,) p, of a force at each point, positive; None: 1 each.
    """
    limits = None if torque is None else torque.arrays
    forces, residual = _core.contact_forces(
        *contacts.arrays, load.com, load.mass, limits, price
    )
    return ContactForces(forces=forces, residual=residual)


def static_equilibrium(
    contacts: ContactPoints, load: Load, *, torque: TorqueLimits | None = None
) -> StaticEquilibrium:
    """Judge a posture by forces, independently of how it was found.

    The horizontal pushes at the centre of mass that the stance can bear, within the
    friction cones and torque limits, are a convex polygon; the margin is the signed
    distance from no push at all to its border. The polygon is explored from inside, one
    LP for each direction, until the nearest edge is a true one: a fifth of a
    millisecond with the torques of 29 joints. `is_statically_stable` is the quick test,
    without margin and torques.

    Args:
        contacts: Where the supports push.
        load: What they bear.
        torque: Joint torques to keep within their limits. Their gravity and Jacobians
            must be those of the posture whose points and centre of mass are given.
    """
    held = contact_forces(contacts, load, torque=torque)
    limits = None if torque is None else torque.arrays
    margin, speeds = _core.push_margin(*contacts.arrays, load.com, load.mass, limits)
    names = [*contacts.names, *(() if torque is None else torque.names)]
    limiting = None
    if len(contacts.names):
        # The first of those equally fast: all points of a stance that slides as one.
        fastest = int(np.argmax(speeds >= (1.0 - 1e-5) * speeds.max()))
        limiting = names[fastest]
        if speeds[fastest] <= _STAYS:  # it turns about contacts that stay
            most = int(np.argmax(np.linalg.norm(held.forces, axis=1)))
            limiting = contacts.names[most] if margin < 1.0 - _core.PUSH_TOL else None
    return StaticEquilibrium(
        feasible=margin >= -_core.PUSH_TOL,
        margin=margin,
        limiting=limiting,
        forces=held.forces,
        torques=None if torque is None else torque.torques(held.forces),
    )


def strength_needed(
    contacts: ContactPoints, load: Load, torque: TorqueLimits
) -> tuple[float, int] | None:
    """Factor on all torque limits at which the load is held, and the limiting joint.

    The least s for which forces within the friction cones balance the weight with joint
    torques |tau| <= s limits: an LP. At most 1 where the posture holds.

    Args:
        contacts: Where the supports push.
        load: What they bear.
        torque: What the joints bear.

    Returns:
        s, and the index into `torque.names`; None where no strength would do.
    """
    from scipy.optimize import linprog  # slow to import, and rarely needed

    if len(contacts.points) == 0:
        return None
    weight = load.mass * GRAVITY
    rows = _core.load_rows(*contacts.arrays, load.com, torque.arrays)
    n, g = rows.shape[1], torque.gravity[torque.dofs] / weight
    limits = np.concatenate([torque.limits, torque.limits]) / weight
    found = linprog(
        np.append(np.zeros(n), 1.0),
        A_ub=np.column_stack([np.concatenate([rows[6:], -rows[6:]]), -limits]),
        b_ub=np.concatenate([g, -g]),
        A_eq=np.column_stack([rows[:6], np.zeros(6)]),
        b_eq=[0.0, 0.0, 1.0, 0.0, 0.0, 0.0],
    )
    if found.status != 0:
        return None
    price = np.abs(found.ineqlin.marginals) * limits
    return float(found.fun), int(np.argmax(price)) % len(torque.names)
