"""Path -> the fastest time law that torque limits and friction cones allow.

With q(s) given, joint torques and contact forces are linear in u = d2s/dt2 and
x = (ds/dt)^2. What (u, x) some forces within the friction cones and some torques within
the effort limits can produce is therefore a convex polygon at each point of the path.
Polygons are found by small QPs from inside, shrunk towards rest, and handed to
`toppra`, which finds the fastest law from rest to rest within all of them.

Shapes: n points of the path, nc contact points, nv velocities, na actuated joints.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import daqp
import mujoco
import numpy as np

from clamber.contact.contact import Contact
from clamber.model.kinematics import Kinematics
from clamber.model.records import short_repr
from clamber.step.polygon import support_polygon
from clamber.step.stability import EFFORT_SHARE, statics_at
from clamber.step.statics import cone_generators

JOINT_SPEED = 4.0  # [rad/s] of a joint whose description has no lower limit
# [rad/s^2] of a joint: what servos of 600 N m/rad and 50 N m follow within 0.02 rad on
# links of half a kg m^2.
JOINT_ACCELERATION = 25.0
INERTIA_SHARE = 0.6  # of what is left between rest and the border of what can be borne
SLOW = 0.3  # [rad/s] where the limits leave nothing: as slow as this, as smooth
TOUCH_SPEED = 0.08  # [m/s] along the normal, near a contact to be made
TOUCH_ZONE = 0.012  # [m] what is near
SMOOTHING = 0.06  # [s] width of the kernel that rounds the acceleration's corners
GRID = 32  # points of a path
STEP = 0.001  # [s]
_RANK = 1e-4  # of a regularisation against a direction of length one
_SLACK = 1e8  # of an unbalanced force against a contact force, squared
# Directions in (u, x), each in units of its bound, in which polygons are explored.
_DIRECTIONS = [
    (math.sin(a), math.cos(a)) for a in np.linspace(-0.5 * np.pi, 0.5 * np.pi, 7)
]


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Demand:
    """Generalised forces at one point of a path, `rest + inertia u + velocity x`.

    Attributes:
        rest, inertia, velocity: (nv,).
        jacobian: (3 nc, nv) of the contact points.
        cones: (nc, m, 3) edges of the friction pyramids (inside the cones).
    """

    rest: np.ndarray
    inertia: np.ndarray
    velocity: np.ndarray
    jacobian: np.ndarray
    cones: np.ndarray

    __repr__ = short_repr


def demand_at(
    kin: Kinematics,
    q: np.ndarray,
    slope: np.ndarray,
    bend: np.ndarray,
    contacts: Sequence[Contact],
) -> Demand:
    """What a point of the path asks for.

    Args:
        kin: Workspace.
        q: (nq,).
        slope: (nv,) dq/ds on the manifold.
        bend: (nv,) its derivative, d2q/ds2.
        contacts: Those that may bear.
    """
    m, d = kin.world.model, kin.data
    kin.update(q)
    mujoco.mj_makeM(m, d)
    inertia, bent = np.zeros(m.nv), np.zeros(m.nv)
    mujoco.mj_mulM(m, d, inertia, slope)
    mujoco.mj_mulM(m, d, bent, bend)
    bias = []
    for v in (np.zeros(m.nv), slope):
        d.qvel[:] = v
        mujoco.mj_comVel(m, d)
        out = np.zeros(m.nv)
        mujoco.mj_rne(m, d, 0, out)
        bias.append(out)
    d.qvel[:] = 0.0
    points, _, torque = statics_at(kin, q, contacts)
    return Demand(
        rest=bias[0],
        inertia=inertia,
        velocity=bent + bias[1] - bias[0],
        jacobian=torque.jacobian,
        cones=cone_generators(points.normals, points.mu, 4),
    )


def _loads(demand: Demand, weight: float) -> np.ndarray:
    """(nv, 4 nc) generalised force of one weight along each edge of the pyramids."""
    nc, m, _ = demand.cones.shape
    J = demand.jacobian.reshape(nc, 3, -1)
    return weight * np.einsum("ikv,imk->vim", J, demand.cones).reshape(-1, nc * m)


def bearable(
    kin: Kinematics,
    demand: Demand,
    slope: np.ndarray,
    u_max: float,
    x_max: float,
) -> np.ndarray | None:
    """(K, 2) vertices of a polygon of feasible (u, x), rest among them.

    From inside: each corner is found with its contact forces. None where not even rest
    is within the limits.

    Args:
        kin: Workspace.
        demand: At this point.
        slope: (nv,) dq/ds, for the joints' viscous damping.
        u_max: Bound of |u|.
        x_max: Bound of x.
    """
    w = kin.world
    weight = w.mass * 9.81
    E = _loads(demand, weight)
    nf = E.shape[1]
    B = np.column_stack([demand.inertia * u_max, demand.velocity * x_max])
    # Damping grows with the root of x: its tangent at a quarter is above it everywhere.
    friction = w.model.dof_damping * slope * math.sqrt(x_max)
    B[:, 1] += friction
    rest = demand.rest + 0.25 * friction
    A = np.concatenate([B, -E], axis=1)  # A (u, x, shares) + rest = (0, tau)
    limits = EFFORT_SHARE * w.tau_max
    scale = np.concatenate([np.full(6, weight), np.ones(len(limits))])
    rows = np.concatenate([A[:6], A[w.dadr]]) / scale[:, None]
    lower = np.concatenate([-rest[:6], -limits - rest[w.dadr]]) / scale
    upper = np.concatenate([-rest[:6], limits - rest[w.dadr]]) / scale
    sense = np.zeros(2 + nf + len(rows), dtype=np.intc)
    sense[2 + nf : 2 + nf + 6] = 5
    lower = np.concatenate([[-1.0, 0.0], np.zeros(nf), lower])
    upper = np.concatenate([[1.0, 1.0], np.full(nf, 1e30), upper])
    H = np.diag(np.full(2 + nf, _RANK))
    corners = []
    still = upper.copy(), lower.copy()
    still[0][:2] = still[1][:2] = 0.0
    starting = upper.copy(), lower.copy()
    starting[0][1] = 0.0
    for bounds, direction in (
        (still, (0.0, 0.0)),
        (starting, (-1.0, 0.0)),
        (starting, (1.0, 0.0)),
        *(((upper, lower), d) for d in _DIRECTIONS),
    ):
        f = np.zeros(2 + nf)
        f[:2] = -np.asarray(direction)
        z, _, flag, _ = daqp.solve(H, f, rows, *bounds, sense.copy())
        if flag == 1:
            corners.append(z[:2] * [u_max, x_max])
        elif not corners:
            return None
    return np.array(corners)


def least_torques(
    kin: Kinematics,
    demand: Demand,
    u: float,
    x: float,
    price: np.ndarray | None = None,
) -> np.ndarray:
    """(na,) joint torques for (u, x) with the least contact forces in the cones.

    Viscous damping of the joints is left to the controller. `price` (nc,) is that of
    the force at each point; None: 1 each.
    """
    w = kin.world
    weight = w.mass * 9.81
    total = demand.rest + u * demand.inertia + x * demand.velocity
    E = _loads(demand, weight)
    edges = demand.cones.reshape(-1, 3)
    nc, m, _ = demand.cones.shape
    normal = np.repeat(demand.cones.mean(axis=1), m, axis=0)
    along = np.sum(edges * normal, axis=1)
    # Tangential forces count four times, as in `contact_forces`.
    metric = 4.0 * edges @ edges.T - 3.0 * np.outer(along, along) * (normal @ normal.T)
    prices = np.eye(nc) if price is None else np.diag(price)
    H = np.kron(prices, np.ones((m, m))) * metric + 1e-6 * np.eye(nc * m)
    H = H + _SLACK * (E[:6].T @ E[:6]) / weight**2
    f = -_SLACK * (E[:6].T @ total[:6]) / weight**2
    n = nc * m
    scale = 1.0 / math.sqrt(_SLACK)
    z, _, flag, _ = daqp.solve(
        H * scale, f * scale, np.zeros((0, n)), np.full(n, 1e30), np.zeros(n)
    )
    load = E @ z if flag == 1 else np.zeros(len(total))
    return np.clip((total - load)[w.dadr], -w.tau_max, w.tau_max)


def fastest(
    s: np.ndarray, polygons: Sequence[np.ndarray], x_max: np.ndarray
) -> np.ndarray:
    """(n,) squared rate (ds/dt)^2 of the fastest law from rest to rest.

    Args:
        s: (n,) grid, increasing.
        polygons: n of (K, 2) corners of what (u, x) may be, rest among them.
        x_max: (n,) bound of x.

    Raises:
        ValueError: There is none.
    """
    # Brings matplotlib with it: not before it is needed.
    from toppra import SplineInterpolator
    from toppra.algorithm import TOPPRA
    from toppra.constraint import LinearConstraint

    n = len(s)
    halves = [_half_planes(p) for p in polygons]
    k = max(len(h) for h in halves)
    F, g = np.zeros((n, k, 2)), np.ones((n, k))
    for i, h in enumerate(halves):
        F[i, : len(h)], g[i, : len(h)] = h[:, :2], h[:, 2]

    class _Polygons(LinearConstraint):
        def compute_constraint_params(
            self, path: object, gridpoints: np.ndarray, *args: object, **kwargs: object
        ) -> tuple[np.ndarray | None, ...]:
            a, b = np.tile([1.0, 0.0], (n, 1)), np.tile([0.0, 1.0], (n, 1))
            bound = np.column_stack([np.zeros(n), x_max])
            return a, b, np.zeros((n, 2)), F, g, None, bound

    path = SplineInterpolator(s, s[:, None])
    solver = TOPPRA([_Polygons()], path, gridpoints=s, solver_wrapper="seidel")
    rate = solver.compute_parameterization(0.0, 0.0)[1]
    if rate is None or np.isnan(rate).any():
        raise ValueError("no time law along the path")
    return rate**2


def _half_planes(corners: np.ndarray) -> np.ndarray:
    """(k, 3) rows (a, b, g) of a u + b x <= g, x >= 0 left out, rows of length one."""
    size = np.maximum(np.abs(corners).max(axis=0), 1e-9)
    hull = support_polygon(corners / size)
    if len(hull) < 3:
        return np.array([[1.0, 0.0, 1e-6], [-1.0, 0.0, 1e-6], [0.0, 1.0, 1e-6]])
    edge = np.roll(hull, -1, axis=0) - hull
    normal = np.column_stack([edge[:, 1], -edge[:, 0]])
    middle = hull.mean(axis=0)
    normal *= np.sign(np.sum((hull - middle) * normal, axis=1))[:, None]
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    g = np.sum(normal * hull, axis=1) + 1e-6
    keep = normal[:, 1] > -1.0 + 1e-9
    return np.column_stack([normal / size, g])[keep]


def sample_law(s: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Path s and ds/dt at each millisecond after the start, made smooth.

    Between grid points the acceleration is constant. The law is averaged over a window
    of time, so that its acceleration has no steps; the rate stays its derivative.

    Args:
        s: (n,) grid.
        x: (n,) squared rates, zero at both ends.
    """
    rate = np.sqrt(x)
    dt = 2.0 * np.diff(s) / np.maximum(rate[1:] + rate[:-1], 1e-9)
    knots = np.concatenate([[0.0], np.cumsum(dt)])
    m = round(SMOOTHING / STEP)
    kernel = 1.0 - np.cos(2.0 * np.pi * (np.arange(m) + 0.5) / m)
    kernel /= kernel.sum()
    n = math.ceil(knots[-1] / STEP) + m
    t = STEP * (np.arange(1 - m, n) + 1.0)
    i = np.clip(np.searchsorted(knots, t, side="right") - 1, 0, len(dt) - 1)
    tau = np.clip(t, 0.0, knots[-1]) - knots[i]
    u = np.diff(rate) / dt
    raw = s[i] + tau * (rate[i] + 0.5 * u[i] * tau)
    fast = np.where((t <= 0) | (t >= knots[-1]), 0.0, rate[i] + u[i] * tau)
    return np.convolve(raw, kernel, "valid"), np.convolve(fast, kernel, "valid")


def retime(
    kin: Kinematics,
    s: np.ndarray,
    q: np.ndarray,
    slope: np.ndarray,
    bend: np.ndarray,
    contacts: Sequence[Contact],
    touch: Contact | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """The fastest motion from rest to rest: s and ds/dt at each millisecond.

    Args:
        kin: Workspace.
        s: (n,) grid.
        q: (n, nq).
        slope: (n, nv) dq/ds on the manifold.
        bend: (n, nv) its derivative, d2q/ds2.
        contacts: Those that may bear all the way.
        touch: The contact to be made at the end: gently.
    """
    w = kin.world
    polygons, x_max = [], np.empty(len(s))
    for i in range(len(s)):
        steep = np.maximum(np.abs(slope[i, w.dadr]), 1e-9)
        x = float((JOINT_SPEED / steep).min()) ** 2
        kin.update(q[i])
        if touch is not None:
            n = w.supports[touch.support].normal
            p = kin.contact_point(touch.surface, n, touch.edge)
            if (p - touch.position) @ n < TOUCH_ZONE and s[i] > 0.5 * s[-1]:
                J = kin.point_jacobian(w.surfaces[touch.surface].body, p)
                x = min(x, (TOUCH_SPEED / max(abs(float(n @ J @ slope[i])), 1e-9)) ** 2)
        u = JOINT_ACCELERATION / float(steep.max())
        x = min(x, JOINT_ACCELERATION / max(float(np.abs(bend[i]).max()), 1e-9))
        corners = bearable(
            kin, demand_at(kin, q[i], slope[i], bend[i], contacts), slope[i], u, x
        )
        if corners is not None:
            corners = INERTIA_SHARE * corners
        if corners is None or len(support_polygon(corners / [u, x])) < 3:
            crawl = (SLOW / float(steep.max())) ** 2
            corners = np.array([[0, 0], [-crawl, 0], [crawl, 0], [0, crawl]])
        polygons.append(corners)
        x_max[i] = x
    return sample_law(s, fastest(s, polygons, x_max))
