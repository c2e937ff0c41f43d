"""Whole-body inverse kinematics: a sequence of QPs with hard and soft tasks.

At a configuration q, with the step `dq` in the tangent space as the variable,

    min   1/2 sum_k w_k^2 || J_k dq + e_k ||^2 + 1/2 mu || dq ||^2      soft tasks
    s.t.  J_c dq = -e_c                                                 contacts
          max(-step, q_min - q) <= dq <= min(step, q_max - q)           joints
          A (p_G + J_G dq) <= b - margin                                balance
          d_i + n_i' (J_2 - J_1) dq >= clearance_i                      distances

then q <- q (+) dq. Joint limits are hard. Contacts, balance and distances weigh 1e6
against the soft tasks, in the QP as in the merit by which a step is judged: they give
way by micrometres, or visibly where nothing satisfies them (`residuals` tells, without
the solver), and each step lowers the merit to first order. With contacts as equalities
it would not: a step that closed them at the cost of a distance was taken back, and
solves stalled where everything is tight.

Shapes: nv tangent dimensions, m rows of a task, P collision pairs of the world.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import daqp
import mujoco
import numpy as np

from clamber.errors import Status
from clamber.model.kinematics import Balls, Kinematics
from clamber.model.scene import Support
from clamber.model.se3 import frame_from_normal, matrix_from_quat, rotation_vector
from clamber.model.world import Surface, World
from clamber.step.statics import (
    com_margin,
    polygon_halfplanes,
    support_ellipse,
    support_polygon,
)

STEP_ROTATION = 0.15  # [rad] largest joint step of one iteration
STEP_TRANSLATION = 0.08  # [m] largest step of the base
RECOVERY_STEP = 0.05  # [m, rad] of a violation that one step is asked to make good
ACTIVE_RANGE = 0.10  # [m] farther pairs have no row
DAMPING = 2e-4  # mu
NEAR_RANGE = 0.03  # [m] pairs this near always have a row
SLOW = 0.01  # share of the merit; three steps that gain less end the solve
MIN_RADIUS = 1e-3  # of the trust region, where the solve has stalled
PENALTY = 1e6  # of violations against the soft cost, in the QP and in the merit
CONTACT_TOL = 5e-4  # [m, rad] a contact is closed
DISTANCE_TOL = 2e-3  # [m] a distance may fall short by this
BALANCE_TOL = 2e-3  # [m]
FLAT_WEIGHT = 0.3  # of a rolling surface to lie flat all the same
FURTHER_CLEARANCE = 0.004  # [m] a shin beside its knee, a forearm beside its elbow
ROUGHNESS_WEIGHT = 10.0  # soft task: more distance from what is rough
EDGE_INSET = 0.015  # [m] contacts stay this far inside the support's border
EDGE_RANGE = 0.15  # [m] ... and have a row where they are nearer to it
EDGE_ROOM = 0.045  # [m] ... and round ones should, where it costs nothing else
EDGE_WEIGHT = 3.0
# How much farther than its clearance a part stays from a support [m], by geom and name.
Wary = Mapping[tuple[int, str], float]
NO_WARINESS: Wary = MappingProxyType({})
# Points in the world with the body that each moves with.
_Places = Sequence[tuple[int, np.ndarray]]
SOFT = 8  # daqp's type of a constraint that may give way


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class ContactGoal:
    """What a posture wants of one surface.

    Attributes:
        surface, support: Names.
        position: (3,) where the contact holds (`free` False), or where it would be
        liked.
        rotation: (3, 3) R_WC of a flat surface in contact.
        free: The position along the support is left to the optimiser.
        hard: In contact; False for a surface that moves there (a soft target in the
        air).
        loaded: It may bear force, and counts for the support polygon.
        stability: Weight of (4.25), the horizontal distance from the contact to the
        mass
            it supports; only for free contacts.
        reference: Weight of the distance to `position`; free contacts and moving ones.
        edge: The edge that a held flat surface may roll on; None keeps it flat.
        link: (4,) orientation of the link from which a held round surface rolls; None
            keeps its centre over `position`.
    """

    surface: str
    support: str
    position: np.ndarray
    rotation: np.ndarray
    free: bool = False
    hard: bool = True
    loaded: bool = True
    stability: float = 0.0
    reference: float = 0.0
    edge: int | None = None
    link: np.ndarray | None = None


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class PostureProblem:
    """All that a posture must and should satisfy; see the module docstring.

    Attributes:
        goals: Contacts and moving surfaces.
        q_reference: (nq,) preferred posture; its weight acts on the joints alone.
        directions: Unit vectors (3,) of body segments in the world, by name.
        base_rotation: (3, 3) preferred R_WB of the pelvis, or None.
        clearance: (P,) least distance of each pair [m]; -inf where a pair does not
        count.
        balance: Keep the centre of mass over the loaded contacts.
        balance_margin: [m] from the border of the support polygon.
        com_target: (2,) preferred centre of mass; None is the middle of the polygon.
        posture_weight, direction_weight, base_weight, com_weight: Of the soft tasks.
        ellipse_weight: Of holding the centre of mass in the support ellipse (4.28).
        lean: (surface, unit vector (3,) from its contact to the mass it will support,
            weight), the orientation of reach-to-support (4.27).
    """

    goals: tuple[ContactGoal, ...]
    q_reference: np.ndarray
    clearance: np.ndarray
    directions: Mapping[str, np.ndarray] = field(
        default_factory=lambda: MappingProxyType({})
    )
    base_rotation: np.ndarray | None = None
    balance: bool = True
    balance_margin: float = 0.025
    com_target: np.ndarray | None = None
    posture_weight: float = 0.08
    direction_weight: float = 0.0
    base_weight: float = 0.15
    com_weight: float = 0.3
    ellipse_weight: float = 0.0
    lean: tuple[str, np.ndarray, float] | None = None


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Residuals:
    """How well a configuration satisfies a problem, computed without the solver.

    Attributes:
        contact: Largest distance or angle by which a hard contact is open [m, rad].
        distance: Largest shortfall of a clearance [m]; 0 where all hold.
        balance: Shortfall of the centre of mass's margin [m]; 0 where it holds.
        limits: Largest joint-limit violation [rad].
        worst_pair: Index into the world's pairs of the largest shortfall, -1 for none.
        com_margin: Signed distance of the centre of mass to the polygon's border [m].
    """

    contact: float
    distance: float
    balance: float
    limits: float
    worst_pair: int
    com_margin: float

    @property
    def worst(self) -> float:
        """The largest shortfall of all [m, rad]."""
        return max(self.contact, self.distance, self.balance, self.limits)

    @property
    def status(self) -> Status:
        """The first thing that is wrong, or SOLVED."""
        if self.contact > CONTACT_TOL or self.limits > 1e-6:
            return Status.UNREACHABLE
        if self.distance > DISTANCE_TOL:
            return Status.COLLIDING
        if self.balance > BALANCE_TOL:
            return Status.UNBALANCED
        return Status.SOLVED


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Solution:
    """A configuration, how it was found and how good it is.

    Attributes:
        q: (nq,).
        iterations: QPs solved.
        residuals: Recomputed at `q`.
        converged: The last step was small.
    """

    q: np.ndarray
    iterations: int
    residuals: Residuals
    converged: bool

    @property
    def status(self) -> Status:
        """SOLVED, or the first thing that is wrong."""
        return self.residuals.status


# Body segments by name: (limb, from, to); the trunk is the mean of hips and shoulders.
_SEGMENTS = {
    f"{side}_{part}": (f"{side}_{limb}", a, b)
    for side in ("left", "right")
    for part, limb, a, b in (
        ("upper_arm", "arm", "root", "middle"),
        ("forearm", "arm", "middle", "end"),
        ("thigh", "leg", "root", "middle"),
        ("shank", "leg", "middle", "end"),
    )
}


def base_clearance(world: World, margin: float) -> np.ndarray:
    """(P,) the same clearance [m] for every pair."""
    return np.full(len(world.pairs), margin)


def contact_clearance(
    world: World,
    clearance: np.ndarray,
    contacts: Mapping[str, str],
    rolling: Collection[str] = (),
) -> np.ndarray:
    """Let surfaces touch the supports they stand on.

    Args:
        world: Robot and scene.
        clearance: (P,) to start from.
        contacts: Support by surface.
        rolling: Flat surfaces on an edge, whose other edges may touch but not enter.

    Returns:
        (P,): the planning geom of a contact pair is left to the contact task; further
        geoms of the surface keep `FURTHER_CLEARANCE`.
    """
    out = clearance.copy()
    for surface, support in contacts.items():
        planned, further = world.touching[surface, support]
        out[further] = FURTHER_CLEARANCE
        out[planned] = 0.0 if surface in rolling else -np.inf
    return out


class _Rows:
    """Preallocated rows `J x (sense) b`, filled from the top."""

    def __init__(self, capacity: int, nv: int) -> None:
        self.J = np.zeros((capacity, nv))
        self.lo = np.zeros(capacity)
        self.hi = np.zeros(capacity)
        self.n = 0

    def take(self, m: int) -> slice:
        if self.n + m > len(self.J):
            grow = max(len(self.J), m)
            self.J = np.concatenate([self.J, np.zeros((grow, self.J.shape[1]))])
            self.lo = np.concatenate([self.lo, np.zeros(grow)])
            self.hi = np.concatenate([self.hi, np.zeros(grow)])
        s = slice(self.n, self.n + m)
        self.n += m
        return s


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class QP:
    """min 1/2 x'Hx + c'x with bounds on x first, then rows `lo <= A x <= hi`.

    Contacts are the rows `C x = e`; `merit` is the penalised cost of the configuration
    it was built at.
    """

    H: np.ndarray
    c: np.ndarray
    C: np.ndarray
    e: np.ndarray
    A: np.ndarray
    lo: np.ndarray
    hi: np.ndarray
    sense: np.ndarray
    merit: float


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class _Held:
    """Goals of a problem that are looked at together: round contacts in their places.

    Attributes:
        of_goal: Which of the K each goal is, None for the others.
        balls: All of them.
        bodies: Of each.
        offset: (K, 3) from the contact to the centre.
        position: (K, 3) where they hold.
        A, b: (K, m, 3), (K, m) half-planes that they stay in, on their supports.
        bears: (n,) those that bear load; None where other goals do as well.
    """

    of_goal: list[int | None]
    balls: Balls
    bodies: list[int]
    offset: np.ndarray
    position: np.ndarray
    A: np.ndarray
    b: np.ndarray
    bears: list[int] | None


class IK:
    """Workspace of the solver: one per world, used again for every posture."""

    def __init__(self, world: World, wary: Wary = NO_WARINESS) -> None:
        """Allocate rows once.

        Args:
            world: Robot and scene.
            wary: As a task, like the roughness of a box.
        """
        self.world = world
        self.kin = Kinematics(world)
        nv = world.model.nv
        self._soft = _Rows(96, nv)
        self._hard = _Rows(32, nv)
        self._ineq = _Rows(96, nv)
        self._jac = np.zeros((3, nv))
        self._jac2 = np.zeros((3, nv))
        self._step = np.full(nv, STEP_ROTATION)
        self._step[:3] = STEP_TRANSLATION
        self._joints = np.zeros(nv)
        self._joints[world.dadr] = 1.0
        self._dofs, self._angles = _as_slice(world.dadr), _as_slice(world.qadr)
        self._q_min = np.maximum(world.q_min[world.dadr], -1e30)
        self._q_max = np.minimum(world.q_max[world.dadr], 1e30)
        self._senses: dict[int, np.ndarray] = {}
        self._violation = 0.0
        self._fills: list[Callable[[], object]] = []
        self._edges = {n: s.edges() for n, s in world.supports.items()}
        self._insets = {n: (A, b - EDGE_INSET) for n, (A, b) in self._edges.items()}
        self._rough = np.zeros(len(world.pairs))
        for box in world.scene.boxes:
            of_box = world.pairs == world.support_geom[box.name]
            self._rough[of_box.any(axis=1)] = box.roughness
        self._geom_body = world.model.geom_bodyid
        self._wary = np.zeros(len(world.pairs), dtype=bool)
        for (geom, support), more in wary.items():
            pair = geom, world.support_geom[support]
            mine = np.isin(world.pairs, pair).all(axis=1)
            self._rough[mine] = np.maximum(self._rough[mine], more)
            self._wary |= mine
        self._is_rough = bool(self._rough.any())
        self._clearance, self._counts = b"", np.zeros(0, dtype=bool)
        self._motion = np.zeros((0, 3, nv))
        self._problem: PostureProblem | None = None
        self._held: _Held | None = None
        self._at = self._open = np.zeros((0, 3))

    def build(
        self, problem: PostureProblem, q: np.ndarray, reach: float = ACTIVE_RANGE
    ) -> QP:
        """The QP at `q`; `Kinematics` of this workspace is left at `q`.

        Args:
            problem: What is wanted.
            q: (nq,).
            reach: Pairs farther apart than this have no row [m].
        """
        merit = self._errors(problem, q, reach)
        return self._linearise(problem, q, merit)

    def _errors(self, problem: PostureProblem, q: np.ndarray, reach: float) -> float:
        """The merit at `q`, and what all rows but their Jacobians hold there.

        A third of the configurations that a solve looks at are judged by it alone: they
        are taken back, or the last.
        """
        self.kin.update(q)
        self._soft.n = self._hard.n = self._ineq.n = 0
        self._violation = 0.0
        self._fills.clear()
        self._look(problem)
        self._contact_rows(problem)
        self._direction_rows(problem)
        if problem.base_rotation is not None and problem.base_weight > 0:
            self._base_rows(problem.base_rotation, problem.base_weight)
        if problem.lean is not None:
            self._lean_rows(*problem.lean)
        self._balance_rows(problem)
        if self._is_rough:
            self._roughness_rows(problem)
        self._distance_rows(problem.clearance, reach)
        e = self._soft.lo[: self._soft.n]
        cost = 0.5 * float(e @ e)
        weight = problem.posture_weight**2
        if weight > 0:
            off = q[self._angles] - problem.q_reference[self._angles]
            cost += 0.5 * weight * float(off @ off)
        return cost + 0.5 * PENALTY * self._violation

    def _linearise(self, problem: PostureProblem, q: np.ndarray, merit: float) -> QP:
        """The QP where `_errors` has just been asked for."""
        for fill in self._fills:
            fill()
        soft, hard, ineq = self._soft, self._hard, self._ineq
        nv = self.world.model.nv
        J, e = soft.J[: soft.n], soft.lo[: soft.n]
        H = J.T @ J
        c = J.T @ e
        weight = problem.posture_weight**2
        H.reshape(-1)[:: nv + 1] += DAMPING + weight * self._joints
        now = q[self._angles]
        if weight > 0:
            c[self._dofs] += weight * (now - problem.q_reference[self._angles])

        lo, hi = np.empty(nv + ineq.n), np.empty(nv + ineq.n)
        lo[:nv], hi[:nv] = -1e30, 1e30
        lo[self._dofs] = np.minimum(self._q_min - now, 0.0)
        hi[self._dofs] = np.maximum(self._q_max - now, 0.0)
        lo[nv:], hi[nv:] = ineq.lo[: ineq.n], ineq.hi[: ineq.n]
        return QP(
            H=H,
            c=c,
            C=hard.J[: hard.n].copy(),
            e=hard.lo[: hard.n].copy(),
            A=ineq.J[: ineq.n].copy(),
            lo=lo,
            hi=hi,
            sense=self._sense(ineq.n),
            merit=merit,
        )

    def _sense(self, rows: int) -> np.ndarray:
        """(nv + m,) daqp's constraint types: bounds, then softened rows."""
        if rows not in self._senses:
            counts = (self.world.model.nv, rows)
            self._senses[rows] = np.repeat(np.array([0, SOFT], np.int32), counts)
        return self._senses[rows]

    def step(self, qp: QP, radius: float = 1.0) -> np.ndarray:
        """Solve; what cannot all be satisfied is shared out by least squares.

        Args:
            qp: From `build`.
            radius: Share of the largest step that this one may take.
        """
        nv = len(qp.c)
        reach, step = radius * RECOVERY_STEP, radius * self._step
        # What is violated is asked to recover only as far as such a step can reach:
        # then every step, however short, points the right way.
        lo, hi = np.minimum(qp.lo, reach), np.maximum(qp.hi, -reach)
        np.maximum(lo[:nv], -step, out=lo[:nv])
        np.minimum(hi[:nv], step, out=hi[:nv])
        heavy = PENALTY * qp.C.T
        e = np.minimum(np.maximum(qp.e, -reach), reach)
        H, c = qp.H + heavy @ qp.C, qp.c - heavy @ e
        x, _, flag, _ = daqp.solve(H, c, qp.A, hi, lo, qp.sense, rho_soft=1.0 / PENALTY)
        if flag <= 0:
            return np.zeros(nv)
        return np.minimum(np.maximum(x, lo[:nv]), hi[:nv])

    def solve(
        self,
        problem: PostureProblem,
        q: np.ndarray,
        *,
        iterations: int = 60,
        tolerance: float = 2e-3,
    ) -> Solution:
        """Iterate from `q` until the step is below `tolerance`.

        A trust region on an exact penalty: a step that raises the merit is taken back
        and tried again a quarter as long. The first step is taken all the same: a limb
        that sets out pays for it at first. Where that has not paid off in the end, the
        solve begins again without.
        """
        start = self.build(problem, q)
        n, converged, x, merit = self._descend(
            problem, q, start, iterations, tolerance, leap=True
        )
        if merit > start.merit:
            more, converged, x, _ = self._descend(
                problem, q, start, iterations, tolerance, leap=False
            )
            n += more
        return Solution(
            q=x, iterations=n, residuals=self.residuals(problem, x), converged=converged
        )

    def _descend(
        self,
        problem: PostureProblem,
        q: np.ndarray,
        qp: QP,
        iterations: int,
        tolerance: float,
        *,
        leap: bool,
    ) -> tuple[int, bool, np.ndarray, float]:
        """Iterations, whether they converged, and where they ended, with its merit."""
        n, converged, radius, slow, merit = 0, False, 1.0, 0, qp.merit
        for n in range(1, iterations + 1):
            dq = self.step(qp, radius)
            size = float(np.abs(dq).max())
            trial = self.kin.integrate(q, dq)
            # The next step will hardly be much longer than this one.
            reach = min(NEAR_RANGE + size, ACTIVE_RANGE)
            new = self._errors(problem, trial, reach)
            if (leap and n == 1) or new <= merit:
                gain = merit - new
                slow = slow + 1 if gain < SLOW * new else 0
                small = size < tolerance and size < 0.9 * radius * STEP_ROTATION
                converged = small or slow >= 3
                q, merit = trial, new
                if not converged and n < iterations:
                    qp = self._linearise(problem, q, merit)
                radius = min(2.0 * radius, 1.0)
            else:
                radius *= 0.25
            if converged or radius < MIN_RADIUS:
                break
        return n, converged, q, merit

    def solve_hard(
        self,
        problem: PostureProblem,
        q: np.ndarray,
        *,
        hint: np.ndarray | None = None,
    ) -> Solution:
        """`solve` for postures far from `q`, with more than one way to get there.

        Distances make the problem non-convex: from `q`, a limb may be on the wrong side
        of an edge. Where the straight way stalls, the solve is tried again from where
        it stalled, and from the posture that would do if nothing could collide.

        Args:
            problem: What is wanted.
            q: (nq,) to start from.
            hint: (nq,) a posture that solves a similar problem, tried first.
        """
        best = self.solve(problem, q if hint is None else hint)
        iterations = best.iterations
        for start in (best.q, None) if hint is None else (q, best.q, None):
            if best.status is Status.SOLVED:
                break
            if start is None:
                nothing = np.full(len(problem.clearance), -np.inf)
                free = self.solve(replace(problem, clearance=nothing), q)
                iterations += free.iterations
                start = free.q
            trial = self.solve(problem, start)
            iterations += trial.iterations
            if trial.residuals.worst < best.residuals.worst:
                best = trial
        return replace(best, iterations=iterations)

    def residuals(self, problem: PostureProblem, q: np.ndarray) -> Residuals:
        """Recompute everything from the model at `q`."""
        kin, w = self.kin, self.world
        kin.update(q)
        self._look(problem)
        contact = 0.0
        for g in problem.goals:
            if not g.hard:
                continue
            s, support = w.surfaces[g.surface], w.supports[g.support]
            p = kin.contact_point(g.surface, support.normal, g.edge)
            if g.free:
                error = abs(float(support.height(p)))
                points = kin.bearing_points(g.surface, support.normal)
                A, b = self._edges[g.support]
                error = max(error, float((points @ A.T - b).max()))
            else:
                target = g.position + kin.roll(g.surface, support.normal, g.link)
                error = float(np.linalg.norm(p - target))
            if s.is_flat:
                turn = kin.flat_error(g.surface, g.rotation)
                if g.free:
                    turn = turn - support.normal * (turn @ support.normal)
                if g.edge is not None:
                    axis = self._edge_axis(g)
                    turn = turn - axis * (turn @ axis)
                error = max(error, float(np.linalg.norm(turn)))
            contact = max(contact, error)
        finite = self._counted(problem.clearance)
        reach = float(problem.clearance.max(initial=0.02, where=finite))
        near = kin.proximity(reach, finite)
        short = problem.clearance.take(near.pairs) - near.distance
        worst = int(np.argmax(short)) if len(short) else -1
        points = self._bearing(problem)[1]
        margin = (
            com_margin(kin.com[:2], support_polygon(points[:, :2]))
            if len(points)
            else -np.inf
        )
        dof = w.dadr
        over = np.maximum(w.q_min[dof] - q[w.qadr], q[w.qadr] - w.q_max[dof])
        return Residuals(
            contact=contact,
            distance=max(float(short[worst]), 0.0) if worst >= 0 else 0.0,
            balance=max(problem.balance_margin - margin, 0.0)
            if problem.balance
            else 0.0,
            limits=max(float(over.max()), 0.0),
            worst_pair=int(near.pairs[worst])
            if worst >= 0 and short[worst] > 0
            else -1,
            com_margin=float(margin),
        )

    # Rows, one method for each kind of task. What a row asks for is put down at once;
    # its Jacobian is left to a function that `_linearise` calls where it is needed.

    def _look(self, problem: PostureProblem) -> None:
        """Where the held round contacts of this problem are, all of them at once."""
        if problem is not self._problem:
            self._problem = problem
            self._held = _held(self.world, problem.goals, self._insets)
        if self._held is not None:
            self._at, roll = self.kin.rolled(self._held.balls)
            self._open = self._held.position + roll - self._at

    def _contact_rows(self, problem: PostureProblem) -> None:
        held = self._held
        if held is None:
            for goal in problem.goals:
                self._goal_rows(goal)
            return
        kin, p, e, rows = self.kin, self._at, self._open, []
        centre = p + held.offset
        sizes = (e[:, None] @ e[:, :, None]).ravel().tolist()
        room = held.b - (held.A @ p[:, :, None])[:, :, 0]
        near = room < EDGE_RANGE
        least = [min(x) for x in room.tolist()]
        for goal, i in zip(problem.goals, held.of_goal, strict=True):
            if i is None:
                self._goal_rows(goal)
                continue
            k = self._hard.take(3)
            self._hard.lo[k] = e[i]
            self._violation += sizes[i]
            if least[i] < 0.0:
                self._violation += _size(np.minimum(room[i], 0.0))
            inside = None
            if least[i] < EDGE_RANGE:
                hi = room[i].take(near[i].nonzero()[0])
                inside = self._ineq.take(len(hi))
                self._ineq.hi[inside] = hi
                self._ineq.lo[inside] = -1e30
            rows.append((i, held.bodies[i], k, inside))

        def fill() -> None:
            for i, body, k, inside in rows:
                kin.point_jacobian(body, p[i], self._hard.J[k])
                if inside is not None:
                    jac = kin.point_jacobian(body, centre[i])
                    self._ineq.J[inside] = held.A[i].compress(near[i], axis=0) @ jac

        self._later(fill)

    def _goal_rows(self, g: ContactGoal) -> None:
        s, support = self.world.surfaces[g.surface], self.world.supports[g.support]
        p = self.kin.contact_point(g.surface, support.normal, g.edge)
        if not g.hard:
            self._moving_rows(g, s, p, support.normal)
        elif g.edge is not None:
            self._rolling_rows(g, s, p, support.normal)
        elif g.free:
            self._free_rows(g, s, p, support)
        elif s.is_flat:
            self._flat_rows(g, s, p)
        else:
            self._round_rows(g, s, p, support.normal)

    def _moving_rows(
        self, g: ContactGoal, s: Surface, p: np.ndarray, n: np.ndarray
    ) -> None:
        """A surface in the air, on its way."""
        kin, centre = self.kin, p + s.radius * n
        k = self._target(p - g.position, g.reference)
        if not s.is_flat:
            self._later(
                lambda: self._aim(k, kin.point_jacobian(s.body, centre), g.reference)
            )
            return
        turn = kin.flat_error(g.surface, g.rotation)
        turned = self._target(-turn, 0.3 * g.reference)

        def fill() -> None:
            jac, rot = kin.jacobians(s.body, p)
            self._aim(k, jac, g.reference)
            self._aim(turned, rot, 0.3 * g.reference)

        self._later(fill)

    def _flat_rows(self, g: ContactGoal, s: Surface, p: np.ndarray) -> None:
        """A flat surface in its place."""
        kin, k = self.kin, self._hard.take(6).start
        e = self._hard.lo[k : k + 6]
        e[:3] = g.position - p
        e[3:] = kin.flat_error(g.surface, g.rotation)
        self._violation += _size(e)

        def fill() -> None:
            jac, rot = self._hard.J[k : k + 3], self._hard.J[k + 3 : k + 6]
            mujoco.mj_jac(kin.world.model, kin.data, jac, rot, p, s.body)

        self._later(fill)

    def _round_rows(
        self, g: ContactGoal, s: Surface, p: np.ndarray, n: np.ndarray
    ) -> None:
        """A round surface in its place that does not roll.

        It touches under its centre: it moves as that does.
        """
        kin, k, centre = self.kin, self._hard.take(3), p + s.radius * n
        e = g.position - p
        self._hard.lo[k] = e
        self._violation += _size(e)
        self._later(lambda: kin.point_jacobian(s.body, centre, self._hard.J[k]))

    def _rolling_rows(
        self, g: ContactGoal, s: Surface, p: np.ndarray, n: np.ndarray
    ) -> None:
        """A flat surface on one of its edges."""
        kin, k = self.kin, self._hard.take(5).start
        turn, axis = kin.flat_error(g.surface, g.rotation), self._edge_axis(g)
        across = np.stack([n, np.cross(n, axis)])
        self._hard.lo[k : k + 3] = g.position - p
        self._hard.lo[k + 3 : k + 5] = across @ turn
        self._violation += _size(g.position - p) + _size(across @ turn)
        flat = self._target(-(axis @ turn)[None], FLAT_WEIGHT)

        def fill() -> None:
            jac, rot = kin.jacobians(s.body, p)
            self._hard.J[k : k + 3] = jac
            self._hard.J[k + 3 : k + 5] = across @ rot
            self._aim(flat, axis[None] @ rot, FLAT_WEIGHT)

        self._later(fill)

    def _free_rows(
        self, g: ContactGoal, s: Surface, p: np.ndarray, support: Support
    ) -> None:
        """A contact wherever it is on its support."""
        kin, n, T = self.kin, support.normal, support.rotation[:, :2].T
        k, centre = self._hard.take(3 if s.is_flat else 1), p + s.radius * n
        height = float(support.height(p))
        self._hard.lo[k.start] = -height
        self._violation += height**2
        if s.is_flat:
            turn = kin.flat_error(g.surface, g.rotation)
            self._hard.lo[k.start + 1 : k.stop] = T @ turn
            self._violation += _size(T @ turn)
            aside, weight = n[None], 0.3
            soft = self._target(-(n @ turn)[None], weight)
            for corner in kin.bearing_points(g.surface, n):
                self._inside(g.support, corner, s.body, corner)
        else:
            self._inside(g.support, p, s.body, centre)
            # As a task, room to slip before it is over the border.
            A, b = self._edges[g.support]
            room = b - EDGE_ROOM - A @ p
            aside, weight = A[room < 0.0], EDGE_WEIGHT
            soft = self._target(-room[room < 0.0], weight)
        wanted = under = None
        if g.reference > 0:
            wanted = self._target(T @ (p - g.position), g.reference)
        body, mass = kin.landmark(self.world.robot.limb_of(g.surface).root)
        stability = np.sqrt(2.0 * g.stability)
        if g.stability > 0:
            under = self._target((p - mass)[:2], stability)

        def fill() -> None:
            jac, rot = kin.jacobians(s.body, centre)
            self._hard.J[k.start] = n @ jac
            if s.is_flat:
                self._hard.J[k.start + 1 : k.stop] = T @ rot
            self._aim(soft, aside @ (rot if s.is_flat else jac), weight)
            if wanted is not None:
                self._aim(wanted, T @ jac, g.reference)
            if under is not None:
                kin.point_jacobian(body, mass, self._jac)
                self._aim(under, jac[:2] - self._jac[:2], stability)

        self._later(fill)

    def _edge_axis(self, g: ContactGoal) -> np.ndarray:
        """(3,) unit vector along the edge, where the surface lay flat."""
        s = self.world.surface(g.surface, g.edge)
        assert s.rotation is not None
        along = g.rotation @ s.rotation.T @ (s.corners[1] - s.corners[0])
        return along / np.linalg.norm(along)

    def _inside(
        self, support: str, p: np.ndarray, body: int, moves: np.ndarray
    ) -> None:
        """Keep `p` on its support; it moves as the body's point at `moves` does."""
        A, b = self._insets[support]
        room = b - A @ p
        near = room < EDGE_RANGE
        if not near.any():
            return
        self._violation += _size(np.minimum(room[near], 0.0))
        k = self._ineq.take(int(np.count_nonzero(near)))
        self._ineq.hi[k] = room[near]
        self._ineq.lo[k] = -1e30

        def fill() -> None:
            self._ineq.J[k] = A[near] @ self.kin.point_jacobian(body, moves)

        self._later(fill)

    def _later(self, fill: Callable[[], object]) -> None:
        self._fills.append(fill)

    def _target(self, e: np.ndarray, weight: float) -> slice:
        """Rows of a soft task, `_aim` gives them their Jacobian."""
        k = self._soft.take(len(e))
        np.multiply(e, weight, out=self._soft.lo[k])
        return k

    def _aim(self, k: slice, J: np.ndarray, weight: float) -> None:
        np.multiply(J, weight, out=self._soft.J[k])

    def _base_rows(self, R_WB: np.ndarray, weight: float) -> None:
        kin, base = self.kin, self.world.base
        k = self._target(-rotation_vector(R_WB @ kin.rotation(base).T), weight)
        at = kin.data.xpos[base]
        self._later(lambda: self._aim(k, kin.jacobians(base, at)[1], weight))

    def _direction_rows(self, problem: PostureProblem) -> None:
        if problem.direction_weight <= 0:
            return
        limbs, landmark = self.world.robot.limbs, self.kin.landmark
        for name, u in problem.directions.items():
            if name == "trunk":
                start = [landmark(limbs[x].root) for x in ("left_leg", "right_leg")]
                end = [landmark(limbs[x].root) for x in ("left_arm", "right_arm")]
            else:
                limb, first, second = _SEGMENTS[name]
                start = [landmark(getattr(limbs[limb], first))]
                end = [landmark(getattr(limbs[limb], second))]
            self._segment_rows(start, end, u, problem.direction_weight)

    def _segment_rows(
        self, start: _Places, end: _Places, direction: np.ndarray, weight: float
    ) -> None:
        """From the middle of some places to that of others, in a direction (3,)."""
        a, b = _middle(start), _middle(end)
        length = float(np.linalg.norm(b - a))
        k = self._target((b - a) / length - direction, weight)

        def fill() -> None:
            J = self._middle_jacobian(end, self._jac)
            J -= self._middle_jacobian(start, self._jac2)
            self._aim(k, J / length, weight)

        self._later(fill)

    def _middle_jacobian(self, places: _Places, out: np.ndarray) -> np.ndarray:
        """(3, nv): each place moves with its own body."""
        (body, p), *more = places
        self.kin.point_jacobian(body, p, out)
        for body, p in more:
            out += self.kin.point_jacobian(body, p)
        if more:
            out *= 1.0 / len(places)
        return out

    def _lean_rows(self, surface: str, direction: np.ndarray, weight: float) -> None:
        s = self.world.surfaces[surface]
        start = [(s.body, self.kin.point(s.body, s.centre))]
        end = [self.kin.landmark(self.world.robot.limb_of(surface).root)]
        self._segment_rows(start, end, direction, weight)

    def _bearing(
        self, problem: PostureProblem
    ) -> tuple[Sequence[int | None], np.ndarray, np.ndarray]:
        """The points (n, 3) that bear load, and what moves each of them.

        A body moves it, None where it stays put, as it moves what is at the last array:
        a ball's contact stays under its centre.
        """
        held = self._held
        if held is not None and held.bears is not None:
            p = self._at.take(held.bears, axis=0)
            bodies = [held.bodies[i] for i in held.bears]
            return bodies, p, p + held.offset.take(held.bears, axis=0)
        bodies: list[int | None] = []
        points, centres = [], []
        for g in problem.goals:
            if not (g.hard and g.loaded):
                continue
            n = self.world.supports[g.support].normal
            p = self.kin.bearing_points(g.surface, n, g.edge)
            s = self.world.surfaces[g.surface]
            bodies += [None if s.is_flat and not g.free else s.body] * len(p)
            points.append(p)
            centres.append(p + s.radius * n)
        if not points:
            return bodies, np.zeros((0, 3)), np.zeros((0, 3))
        return bodies, np.concatenate(points), np.concatenate(centres)

    def _polygon_motion(
        self,
        A: np.ndarray,
        polygon: np.ndarray,
        com: np.ndarray,
        bearing: tuple[Sequence[int | None], np.ndarray, np.ndarray],
        rows: np.ndarray,
    ) -> None:
        """Let the polygon's edges move with contacts that slide or roll.

        The distance of c from the line through p and q changes by
        n'((1 - t) dp + t dq - dc), t the share of the edge at which c lies abreast.
        """
        bodies, points, centres = bearing
        corners, (x, y) = polygon.tolist(), com.tolist()
        places = points[:, :2].tolist()
        if len(self._motion) < len(corners):
            self._motion = np.zeros((len(corners), *self._motion.shape[1:]))
        moves, shares = self._motion[: len(corners)], []
        for move, a, b in zip(moves, corners, [*corners[1:], corners[0]], strict=True):
            (ax, ay), (bx, by) = a, b
            gaps = [abs(ax - px) + abs(ay - py) for px, py in places]
            o = gaps.index(min(gaps))
            body = bodies[o]
            if body is None:
                move[:] = 0.0
            else:
                self.kin.point_jacobian(body, centres[o], move)
            ex, ey = bx - ax, by - ay
            shares.append(((x - ax) * ex + (y - ay) * ey) / (ex * ex + ey * ey))
        t = np.array(shares)[:, None]
        following = np.concatenate([moves[1:, :2], moves[:1, :2]])
        rows -= (((1.0 - t) * A)[:, None] @ moves[:, :2])[:, 0]
        rows -= ((t * A)[:, None] @ following)[:, 0]

    def _balance_rows(self, problem: PostureProblem) -> None:
        kin, com = self.kin, self.kin.com[:2].copy()
        target, weight = problem.com_target, problem.com_weight
        if target is not None and weight > 0:
            aimed = self._target(com - target, weight)
            self._later(lambda: self._aim(aimed, kin.com_jacobian()[:2], weight))
        if not problem.balance:
            return
        bearing = self._bearing(problem)
        bodies, points, _ = bearing
        if not bodies:
            return
        polygon = support_polygon(points[:, :2])
        A, b = polygon_halfplanes(polygon)
        room = b - problem.balance_margin - A @ com
        self._violation += _size(np.minimum(room, 0.0))
        k = self._ineq.take(len(b))
        self._ineq.hi[k] = room
        self._ineq.lo[k] = -1e30
        middle = drawn = None
        if target is None and weight > 0:
            middle = self._target(
                com - np.add.reduce(polygon, axis=0) / len(polygon), weight
            )
        excess, gradient = 0.0, com
        if problem.ellipse_weight > 0:
            excess, gradient = support_ellipse(polygon).excess(com)
        if excess > 0:
            drawn = self._target(np.array([excess]), problem.ellipse_weight)

        def fill() -> None:
            J = kin.com_jacobian()[:2]
            self._ineq.J[k] = A @ J
            if middle is not None:
                self._aim(middle, J, weight)
            if drawn is not None:
                self._aim(drawn, (gradient @ J)[None], problem.ellipse_weight)
            if len(polygon) == len(b) and any(bodies):
                self._polygon_motion(A, polygon, com, bearing, self._ineq.J[k])

        self._later(fill)

    def _distance_rows(self, clearance: np.ndarray, reach: float) -> None:
        kin = self.kin
        near = kin.proximity(reach, self._counted(clearance))
        if len(near.pairs) == 0:
            return
        short = clearance.take(near.pairs) - near.distance
        self._violation += _size(np.maximum(short, 0.0))
        k = self._ineq.take(len(short))
        self._ineq.lo[k] = short
        self._ineq.hi[k] = 1e30

        def fill() -> None:
            self._ineq.J[k] = kin.distance_jacobian(near.pairs, near.first, near.normal)

        self._later(fill)

    def _counted(self, clearance: np.ndarray) -> np.ndarray:
        """(P,) bool: pairs that count; the same array for the same clearances."""
        known = clearance.tobytes()
        if known != self._clearance:
            self._clearance, self._counts = known, np.isfinite(clearance)
        return self._counts

    def _roughness_rows(self, problem: PostureProblem) -> None:
        """Keep farther from what is rough, as a task for each pair that is too near.

        The links in contact with it are as near as their contact is: of those, only
        what is known to have touched.
        """
        w, kin = self.world, self.kin
        counts = self._counted(problem.clearance) & (self._rough > 0)
        for g in problem.goals:
            if g.hard:
                of_link = self._geom_body[w.pairs] == w.surfaces[g.surface].body
                of_support = w.pairs == w.support_geom[g.support]
                counts &= ~(of_link.any(axis=1) & of_support.any(axis=1)) | self._wary
        wanted = problem.clearance + self._rough
        near = kin.proximity(float(wanted.max(initial=0.0, where=counts)), counts)
        short = np.maximum(wanted[near.pairs] - near.distance, 0.0)
        if not short.any():
            return
        k = self._target(-short, ROUGHNESS_WEIGHT)

        def fill() -> None:
            J = kin.distance_jacobian(near.pairs, near.first, near.normal)
            J[short == 0.0] = 0.0
            self._aim(k, J, ROUGHNESS_WEIGHT)

        self._later(fill)


def _held(
    world: World,
    goals: Sequence[ContactGoal],
    insets: Mapping[str, tuple[np.ndarray, np.ndarray]],
) -> _Held | None:
    """Those goals that are round contacts in their places; None: there are none."""
    of_goal: list[int | None] = [None] * len(goals)
    held: list[tuple[ContactGoal, Surface, Support, np.ndarray]] = []
    for i, g in enumerate(goals):
        s = world.surfaces[g.surface]
        if g.hard and not g.free and not s.is_flat and g.link is not None:
            of_goal[i] = len(held)
            held.append((g, s, world.supports[g.support], g.link))
    if not held:
        return None
    radii = np.array([[s.radius] for _, s, _, _ in held])
    normals = np.array([support.normal for _, _, support, _ in held])
    bodies = [s.body for _, s, _, _ in held]
    planes = [insets[g.support] for g, _, _, _ in held]
    m = max(len(b) for _, b in planes)
    A, b = np.zeros((len(held), m, 3)), np.full((len(held), m), np.inf)
    for i, (normal, bound) in enumerate(planes):
        A[i, : len(bound)], b[i, : len(bound)] = normal, bound
    others = [g for g, i in zip(goals, of_goal, strict=True) if i is None]
    alone = not any(g.hard and g.loaded for g in others)
    return _Held(
        of_goal=of_goal,
        balls=Balls(
            bodies=np.array(bodies),
            centres=np.array([s.centre for _, s, _, _ in held])[:, :, None],
            radii=radii,
            normals=normals,
            links=np.array([link for _, _, _, link in held]),
        ),
        bodies=bodies,
        offset=radii * normals,
        position=np.array([g.position for g, _, _, _ in held]),
        A=A,
        b=b,
        bears=[i for i, x in enumerate(held) if x[0].loaded] if alone else None,
    )


def _as_slice(indices: np.ndarray) -> slice | np.ndarray:
    """The same indices as a slice where they are consecutive: indexing is cheaper."""
    first = int(indices[0])
    if np.array_equal(indices, np.arange(first, first + len(indices))):
        return slice(first, first + len(indices))
    return indices


def _middle(places: _Places) -> np.ndarray:
    """(3,) of one place, or midway between two."""
    points = [p for _, p in places]
    return points[0] if len(points) == 1 else 0.5 * (points[0] + points[1])


def _size(e: np.ndarray) -> float:
    """Squared Euclidean length."""
    return float(e @ e)


def support_rotation(support: Support, quaternion: np.ndarray) -> np.ndarray:
    """R_WC: z along the support's normal, x as near to the quaternion's as it can."""
    return frame_from_normal(support.normal, matrix_from_quat(quaternion)[:, 0])
