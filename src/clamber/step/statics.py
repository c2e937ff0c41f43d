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

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import daqp
import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import linprog

from clamber import _core
from clamber.model.records import short_repr
from clamber.step.polygon import support_polygon

GRAVITY = 9.81  # [m/s^2]
MAX_CONTACT_ANGLE = math.radians(25.0)  # found by experiment in the thesis
CONE_EDGES = 4
BALANCE_TOL = 1e-6  # wrench left over, in weights (and weights times a metre)
TANGENTIAL_WEIGHT = 4.0  # of a tangential against a normal force, squared
SLACK_WEIGHT = 1e8  # of an unbalanced wrench against a contact force, squared
LP_WEIGHT = 1e-5  # of the square of an LP's variables
PUSH_TOL = 1e-6  # [weights] accuracy of the margin
PUSH_LIMIT = 1.0  # [weights] harder pushes are not looked at

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
    """Where the supports can push.

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

    def wrenches(self, com: np.ndarray) -> np.ndarray:
        """(nc * m, 6) of unit normal forces along the cones' edges, about `com`."""
        E = cone_generators(self.normals, self.mu, self.cone_edges)
        r = np.repeat(self.points - com, self.cone_edges, axis=0)
        return _wrenches(r, E.reshape(-1, 3))


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Load:
    """What the contacts bear.

    Attributes:
        com: (3,) centre of mass [m].
        mass: [kg].
    """

    com: np.ndarray
    mass: float

    __repr__ = short_repr


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class TorqueLimits:
    """What the joints can bear: |g - J^T f| <= limits, joint by joint.

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
            more where it must jam itself between walls with many times that.
    """

    forces: np.ndarray
    residual: float

    __repr__ = short_repr


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class StaticEquilibrium:
    """Whether contact forces and joint torques can hold a posture, and how firmly.

    Attributes:
        feasible: Whether they can: `margin >= 0` but for rounding.
        margin: The largest horizontal push on the base, in weights, along a line
            through the centre of mass, that the stance holds in every direction.
            Negative: the least steady push without which it falls; -1 where no push up
            to the weight helps. At most 1.
        limiting: The contact or joint that limits it: in the motion with which the
            stance gives way to the weakest push, the one that yields fastest (m/s of a
            contact, rad/s of a joint; the duals of the LP). A slipping contact; where
            the robot tips over, the one that lifts off and would have to pull; a joint
            whose torque does not suffice; the pivot where nothing else moves. None
            where a push of the whole weight is held.
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
    x, y, z = np.asarray(normals, dtype=float).T
    scale = 1.0 / np.maximum(1.0 + x, 1e-12)
    R = np.empty((len(x), 3, 3))
    R[:, 0, 0] = -y
    R[:, 1, 0] = x + scale * z * z
    R[:, 2, 0] = R[:, 1, 1] = -scale * y * z
    R[:, 0, 1] = -z
    R[:, 2, 1] = x + scale * y * y
    R[:, 0, 2], R[:, 1, 2], R[:, 2, 2] = x, y, z
    for i in np.flatnonzero(x < 1e-9 - 1.0):  # every half turn is a smallest rotation
        R[i] = [[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    return R


def cone_generators(normals: np.ndarray, mu: np.ndarray, edges: int) -> np.ndarray:
    """Edges (nc, m, 3) of the pyramids INSIDE the friction cones, normal part 1."""
    return np.matmul(
        _pyramid(np.asarray(mu), edges, 0.0), contact_frames(normals).transpose(0, 2, 1)
    )


def _pyramid(mu: np.ndarray, edges: int, start: float) -> np.ndarray:
    """(nc, m, 3) rows (mu cos, mu sin, 1) at m angles, the first `start` steps on."""
    out = np.ones((len(mu), edges, 3))
    np.multiply(mu[:, None, None], _circle(edges, start), out=out[:, :, :2])
    return out


@functools.lru_cache(maxsize=16)
def _circle(edges: int, start: float) -> np.ndarray:
    a = (np.arange(edges) + start) * (2 * math.pi / edges)
    circle = np.stack([np.cos(a), np.sin(a)], axis=1)
    circle.setflags(write=False)
    return circle


def _wrenches(r: np.ndarray, forces: np.ndarray) -> np.ndarray:
    """(N, 6) forces (N, 3) and their moments at lever arms r (N, 3)."""
    W = np.empty((len(r), 6))
    W[:, :3] = forces
    x, y, z = r.T
    fx, fy, fz = forces.T
    W[:, 3] = y * fz - z * fy
    W[:, 4] = z * fx - x * fz
    W[:, 5] = x * fy - y * fx
    return W


_WEIGHT = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
_EYE = np.eye(6)


def is_statically_stable(contacts: ContactPoints, com: np.ndarray) -> bool:
    """Whether forces within the friction cones can balance gravity: the quick test.

    The wrench of the weight, w, lies in the cone of the contact wrenches W iff its
    projection y on the polar cone, `min |y - w|^2  s.t.  W y <= 0`, is zero: a QP in
    six variables however many contacts there are. y is the part of the weight that no
    contact forces balance.

    Args:
        contacts: Where the supports push.
        com: (3,) centre of mass [m].
    """
    W = contacts.wrenches(com)
    if len(W) == 0:
        return False
    y, _, flag, _ = daqp.solve(_EYE, -_WEIGHT, W, np.zeros(len(W)), primal_tol=1e-8)
    return flag == 1 and float(y @ y) <= BALANCE_TOL**2


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
    nc, na = len(contacts.points), 0 if torque is None else len(torque.dofs)
    cone_edges = contacts.cone_edges
    if nc == 0:
        return ContactForces(forces=np.zeros((0, 3)), residual=1.0)
    weight = load.mass * GRAVITY
    R = contact_frames(contacts.normals)
    nf, ns = 3 * nc, 6 + na
    # x = (forces in contact frames [weights], residuals of balance and torques)
    H = np.zeros((nf + ns, nf + ns))
    scale = np.full(nf + ns, SLACK_WEIGHT)
    scale[:nf] = TANGENTIAL_WEIGHT
    scale[2:nf:3] = 1.0
    if price is not None:
        scale[:nf] *= np.repeat(price, 3)
    np.fill_diagonal(H, scale)
    A = np.zeros((ns + nc * cone_edges, nf + ns))
    upper, lower = np.zeros(len(A)), np.full(len(A), -1e30)
    sense = np.zeros(len(A), dtype=np.intc)
    r = np.repeat(contacts.points - load.com, 3, axis=0)
    A[:6, :nf] = _wrenches(r, R.transpose(0, 2, 1).reshape(nf, 3)).T
    A[:ns, nf:].flat[:: ns + 1] = 1.0
    upper[:6] = lower[:6] = _WEIGHT
    sense[:6] = 5  # equality
    if torque is not None:
        J = torque.jacobian[:, torque.dofs].T.reshape(na, nc, 1, 3)
        A[6:ns, :nf] = np.matmul(J, R).reshape(na, nf)
        g = torque.gravity[torque.dofs]
        upper[6:ns] = (g + torque.limits) / weight
        lower[6:ns] = (g - torque.limits) / weight
    facets = _pyramid(1.0 / contacts.mu, cone_edges, 0.5)
    facets[:, :, 2] = -math.cos(math.pi / cone_edges)
    for i in range(nc):
        rows = slice(ns + i * cone_edges, ns + (i + 1) * cone_edges)
        A[rows, 3 * i : 3 * i + 3] = facets[i]
    x, _, flag, _ = daqp.solve(H, np.zeros(nf + ns), A, upper, lower, sense)
    local = x[:nf] if flag == 1 else np.zeros(nf)
    forces = weight * np.einsum("nij,nj->ni", R, local.reshape(nc, 3))
    reached = A[:ns, :nf] @ local
    left = reached - np.clip(reached, lower[:ns], upper[:ns])
    return ContactForces(forces=forces, residual=float(np.linalg.norm(left)))


def static_equilibrium(
    contacts: ContactPoints, load: Load, *, torque: TorqueLimits | None = None
) -> StaticEquilibrium:
    """Judge a posture by forces: the check that does not depend on how it was found.

    The horizontal pushes at the centre of mass that the stance can bear, within the
    friction cones and torque limits, are a convex polygon; the margin is the signed
    distance from no push at all to its border. The polygon is explored from inside, one
    LP for each direction, until the nearest edge is a true one: one to two milliseconds
    with the torques of 29 joints. `is_statically_stable` is the quick test,
    without margin and torques.

    Args:
        contacts: Where the supports push.
        load: What they bear.
        torque: Joint torques to keep within their limits. Their gravity and Jacobians
            must be those of the posture whose points and centre of mass are given.
    """
    held = contact_forces(contacts, load, torque=torque)
    margin, limiting = -PUSH_LIMIT, None
    if len(contacts.points):
        lp = _build_push_lp(contacts, load, torque)
        margin, duals = _push_margin(lp)
        owners = [n for n in contacts.names for _ in range(contacts.cone_edges)]
        owners += () if torque is None else [*torque.names, *torque.names]
        yields: dict[str, float] = {}
        for name, dual in zip(owners, duals.tolist(), strict=True):
            yields[name] = max(yields.get(name, 0.0), dual)
        limiting = max(yields, key=lambda name: yields[name])
        if yields[limiting] <= 10 * LP_WEIGHT:  # it turns about contacts that stay
            most = int(np.argmax(np.linalg.norm(held.forces, axis=1)))
            limiting = contacts.names[most] if margin < PUSH_LIMIT - PUSH_TOL else None
    return StaticEquilibrium(
        feasible=margin >= -PUSH_TOL,
        margin=margin,
        limiting=limiting,
        forces=held.forces,
        torques=None if torque is None else torque.torques(held.forces),
    )


def strength_needed(
    contacts: ContactPoints, load: Load, torque: TorqueLimits
) -> tuple[float, int] | None:
    """How many times as strong all joints would have to be, and which one limits that.

    The least s for which forces within the friction cones balance the weight with joint
    torques |tau| <= s limits: an LP. At most 1 where the posture holds.

    Args:
        contacts: Where the supports push.
        load: What they bear.
        torque: What the joints bear.

    Returns:
        s, and the index into `torque.names`; None where no strength would do.
    """
    if len(contacts.points) == 0:
        return None
    lp = _build_push_lp(contacts, load, torque)
    limits = np.concatenate([torque.limits, torque.limits]) / (load.mass * GRAVITY)
    n = lp.A_eq.shape[1] - 2
    found = linprog(
        np.append(np.zeros(n), 1.0),
        A_ub=np.column_stack([lp.A_ub[:, :n], -limits]),
        b_ub=lp.b_ub - limits,
        A_eq=np.column_stack([lp.A_eq[:, :n], np.zeros(6)]),
        b_eq=lp.b_eq,
    )
    if found.status != 0:
        return None
    price = np.abs(found.ineqlin.marginals) * limits
    return float(found.fun), int(np.argmax(price)) % len(torque.names)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class _PushLP:
    """`A_eq x = b_eq, A_ub x <= b_ub`, x = (cone edges' shares >= 0, push (2,))."""

    A_eq: np.ndarray
    b_eq: np.ndarray
    A_ub: np.ndarray
    b_ub: np.ndarray

    __repr__ = short_repr


def _build_push_lp(
    contacts: ContactPoints, load: Load, torque: TorqueLimits | None
) -> _PushLP:
    weight, W = load.mass * GRAVITY, contacts.wrenches(load.com)
    n = len(W)
    A_eq = np.zeros((6, n + 2))
    A_eq[:, :n] = W.T
    A_eq[0, n] = A_eq[1, n + 1] = 1.0
    A_ub, b_ub = np.zeros((0, n + 2)), np.zeros(0)
    if torque is not None:
        na = len(torque.dofs)
        J = torque.jacobian[:, torque.dofs].T.reshape(na, -1, 1, 3)
        E = W[:, :3].reshape(-1, contacts.cone_edges, 3)
        turns = np.zeros((na, n + 2))
        turns[:, :n] = np.sum(J * E, axis=3).reshape(na, n)
        g = torque.gravity[torque.dofs]
        limits = np.concatenate([torque.limits, torque.limits]) / weight
        A_ub = np.concatenate([turns, -turns])
        b_ub = np.concatenate([g, -g]) / weight + limits
    return _PushLP(A_eq=A_eq, b_eq=_WEIGHT, A_ub=A_ub, b_ub=b_ub)


def _push_margin(lp: _PushLP) -> tuple[float, np.ndarray]:
    """Margin [weights] and the duals of the cone edges and torque rows there.

    Each LP is a QP with a weight on `x` so small that its solution is the LP's, that of
    least norm where there are several [Mangasarian79]: a tenth of the time.
    """
    n, m = lp.A_eq.shape[1] - 2, len(lp.b_ub)
    A = np.concatenate([lp.A_eq, lp.A_ub])
    upper = np.concatenate([np.full(n, 1e30), np.full(2, PUSH_LIMIT), lp.b_eq, lp.b_ub])
    lower = np.concatenate(
        [np.zeros(n), np.full(2, -PUSH_LIMIT), lp.b_eq, np.full(m, -1e30)]
    )
    sense = np.repeat(np.array([0, 5, 0], dtype=np.intc), [n + 2, 6, m])  # 5: equality
    H, cost = LP_WEIGHT * np.eye(n + 2), np.zeros(n + 2)
    found: list[np.ndarray] = []
    queue = [(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)]
    inner, out, duals = -math.inf, queue[0], np.zeros(n + m)
    for _ in range(60):
        u = np.array(queue.pop() if queue else out)
        cost[n:] = -u
        x, _, flag, info = daqp.solve(H, cost, A, upper, lower, sense, primal_tol=1e-8)
        if flag != 1:  # no push up to the weight helps
            return -PUSH_LIMIT, _unbalanced_duals(lp)
        push = x[n:]
        lam = np.abs(info["lam"])
        duals = np.append(lam[:n], lam[n + 8 :])
        if not queue and len(found) >= 4 and u @ push <= inner + PUSH_TOL:
            break
        found.append(push)
        polygon = support_polygon(np.array(found))
        inner, out = _core.nearest_border(0.0, 0.0, polygon)
    return max(-PUSH_LIMIT, min(PUSH_LIMIT, float(inner))), duals


def _unbalanced_duals(lp: _PushLP) -> np.ndarray:
    """What limits a stance that no push can hold: least squares instead of a push."""
    n, ns = lp.A_eq.shape[1] - 2, len(lp.A_eq) + len(lp.A_ub)
    A = np.zeros((ns, n + ns))
    A[:6, :n], A[6:, :n] = lp.A_eq[:, :n], lp.A_ub[:, :n]
    A[:, n:].flat[:: ns + 1] = 1.0
    upper = np.concatenate([np.full(n, 1e30), np.full(ns, 1e30), lp.b_eq, lp.b_ub])
    lower = np.concatenate([np.zeros(n), np.full(ns, -1e30), lp.b_eq, lp.b_ub])
    lower[n + ns + 6 :] = -1e30
    sense = np.zeros(len(upper), dtype=np.intc)
    sense[n + ns : n + ns + 6] = 5
    H = np.diag(np.concatenate([np.full(n, 1e-8), np.ones(ns)]))
    info = daqp.solve(H, np.zeros(n + ns), A, upper, lower, sense)[3]
    lam = np.abs(info["lam"])
    return np.append(lam[:n], lam[n + ns + 6 :])
