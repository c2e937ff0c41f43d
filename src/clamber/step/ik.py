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

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import daqp
import numpy as np

from clamber.errors import Status
from clamber.model.kinematics import Kinematics
from clamber.model.records import short_repr
from clamber.model.world import World
from clamber.step.polygon import com_margin, support_polygon
from clamber.step.tasks import (
    FAR,
    Apart,
    Balance,
    Distance,
    Over,
    Reaching,
    Rows,
    SurfaceTask,
    Task,
    Turned,
    leaning,
    pointing,
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
FURTHER_CLEARANCE = 0.004  # [m] a shin beside its knee, a forearm beside its elbow
# How much farther than its clearance a part stays from a support [m], by geom and name.
ExtraClearance = Mapping[tuple[int, str], float]
NO_EXTRA: ExtraClearance = MappingProxyType({})
SOFT = 8  # daqp's type of a constraint that may give way


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class PostureProblem:
    """All that a posture must and should satisfy; see the module docstring.

    Attributes:
        tasks: Contacts, closed or moving.
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

    tasks: tuple[SurfaceTask, ...]
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

    __repr__ = short_repr


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

    __repr__ = short_repr

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

    __repr__ = short_repr

    @property
    def status(self) -> Status:
        """SOLVED, or the first thing that is wrong."""
        return self.residuals.status


def contact_clearance(
    world: World,
    margin: float,
    contacts: Mapping[str, str],
    rolling: Collection[str] = (),
) -> np.ndarray:
    """The clearance of each pair: surfaces may touch the supports they stand on.

    Args:
        world: Robot and scene.
        margin: Of all other pairs [m].
        contacts: Support by surface.
        rolling: Flat surfaces on an edge, whose other edges may touch but not enter.

    Returns:
        (P,): the planning geom of a contact pair is left to the contact task; further
        geoms of the surface keep `FURTHER_CLEARANCE`.
    """
    out = np.full(len(world.pairs), margin)
    for surface, support in contacts.items():
        planned, further = world.touching[surface, support]
        out[further] = FURTHER_CLEARANCE
        out[planned] = 0.0 if surface in rolling else -np.inf
    return out


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

    __repr__ = short_repr


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class _Asked:
    """A problem as tasks; `balance` is one of them only where it is asked for."""

    problem: PostureProblem
    tasks: list[Task]
    balance: Balance
    distance: Distance

    __repr__ = short_repr


class IK:
    """Workspace of the solver: one per world, used again for every posture."""

    def __init__(self, world: World, extra: ExtraClearance = NO_EXTRA) -> None:
        """Allocate rows once.

        Args:
            world: Robot and scene.
            extra: Clearance as a task, like the roughness of a box.
        """
        self.world, self.extra = world, extra
        self.kin = Kinematics(world)
        nv = world.model.nv
        self._rows = Rows(world)
        self._step = np.full(nv, STEP_ROTATION)
        self._step[:3] = STEP_TRANSLATION
        self._joints = np.zeros(nv)
        self._joints[world.dadr] = 1.0
        self._dofs, self._angles = _as_slice(world.dadr), _as_slice(world.qadr)
        self._q_min = np.maximum(world.q_min[world.dadr], -FAR)
        self._q_max = np.minimum(world.q_max[world.dadr], FAR)
        self._senses: dict[int, np.ndarray] = {}
        # What each pair keeps besides its clearance, and whether a part was told to.
        self._rough = np.zeros(len(world.pairs))
        for box in world.scene.boxes:
            of_box = world.pairs == world.support_geom[box.name]
            self._rough[of_box.any(axis=1)] = box.roughness
        self._told = np.zeros(len(world.pairs), dtype=bool)
        for (geom, support), more in extra.items():
            pair = geom, world.support_geom[support]
            mine = np.isin(world.pairs, pair).all(axis=1)
            self._rough[mine] = np.maximum(self._rough[mine], more)
            self._told |= mine
        self._asked: _Asked | None = None

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
        rows = self._rows
        rows.clear(reach)
        for task in self._ask(problem).tasks:
            task.add(self.kin, rows)
        e = rows.soft.lo[: rows.soft.n]
        cost = 0.5 * float(e @ e)
        weight = problem.posture_weight**2
        if weight > 0:
            off = q[self._angles] - problem.q_reference[self._angles]
            cost += 0.5 * weight * float(off @ off)
        return cost + 0.5 * PENALTY * rows.violation

    def _linearise(self, problem: PostureProblem, q: np.ndarray, merit: float) -> QP:
        """The QP where `_errors` has just been asked for."""
        self._rows.fill()
        soft, closed, kept = self._rows.soft, self._rows.closed, self._rows.kept
        nv = self.world.model.nv
        J, e = soft.J[: soft.n], soft.lo[: soft.n]
        H = J.T @ J
        c = J.T @ e
        weight = problem.posture_weight**2
        H.reshape(-1)[:: nv + 1] += DAMPING + weight * self._joints
        now = q[self._angles]
        if weight > 0:
            c[self._dofs] += weight * (now - problem.q_reference[self._angles])

        lo, hi = np.empty(nv + kept.n), np.empty(nv + kept.n)
        lo[:nv], hi[:nv] = -1e30, 1e30
        lo[self._dofs] = np.minimum(self._q_min - now, 0.0)
        hi[self._dofs] = np.maximum(self._q_max - now, 0.0)
        lo[nv:], hi[nv:] = kept.lo[: kept.n], kept.hi[: kept.n]
        return QP(
            H=H,
            c=c,
            C=closed.J[: closed.n].copy(),
            e=closed.lo[: closed.n].copy(),
            A=kept.J[: kept.n].copy(),
            lo=lo,
            hi=hi,
            sense=self._sense(kept.n),
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
        kin, w, asked = self.kin, self.world, self._ask(problem)
        kin.update(q)
        contact = max(
            (x.opened(kin) for x in problem.tasks if not isinstance(x, Reaching)),
            default=0.0,
        )
        counts = asked.distance.counts
        reach = float(problem.clearance.max(initial=0.02, where=counts))
        near = kin.proximity(reach, counts)
        short = problem.clearance.take(near.pairs) - near.distance
        worst = int(np.argmax(short)) if len(short) else -1
        distance = float(short[worst]) if len(short) else 0.0
        points = asked.balance.points(kin)
        margin = com_margin(kin.com[:2], support_polygon(points[:, :2]))
        balance = max(problem.balance_margin - margin, 0.0)
        over = np.maximum(w.q_min[w.dadr] - q[w.qadr], q[w.qadr] - w.q_max[w.dadr])
        return Residuals(
            contact=contact,
            distance=max(distance, 0.0),
            balance=balance if problem.balance else 0.0,
            limits=max(float(over.max()), 0.0),
            worst_pair=int(near.pairs[worst]) if distance > 0 else -1,
            com_margin=margin,
        )

    def _ask(self, problem: PostureProblem) -> _Asked:
        """The tasks of a problem; those of the last one are kept."""
        if self._asked is None or self._asked.problem is not problem:
            self._asked = self._tasks_of(problem)
        return self._asked

    def _tasks_of(self, problem: PostureProblem) -> _Asked:
        world, p = self.world, problem
        tasks: list[Task] = [*p.tasks]
        if p.direction_weight > 0:
            weight = p.direction_weight
            tasks += [pointing(world, n, u, weight) for n, u in p.directions.items()]
        if p.base_rotation is not None and p.base_weight > 0:
            tasks.append(Turned(rotation=p.base_rotation, weight=p.base_weight))
        if p.lean is not None:
            tasks.append(leaning(world, *p.lean))
        if p.com_target is not None and p.com_weight > 0:
            tasks.append(Over(target=p.com_target, weight=p.com_weight))
        balance = Balance(
            contacts=[x for x in p.tasks if not isinstance(x, Reaching) and x.loaded],
            margin=p.balance_margin,
            middle_weight=p.com_weight if p.com_target is None else 0.0,
            ellipse_weight=p.ellipse_weight,
        )
        if p.balance:
            tasks.append(balance)
        counts = np.isfinite(p.clearance)
        if self._rough.any():
            apart = counts & (self._rough > 0) & ~self._touching(p.tasks)
            tasks.append(Apart(wanted=p.clearance + self._rough, counts=apart))
        distance = Distance(clearance=p.clearance, counts=counts)
        tasks.append(distance)
        return _Asked(problem=p, tasks=tasks, balance=balance, distance=distance)

    def _touching(self, tasks: Collection[SurfaceTask]) -> np.ndarray:
        """(P,) bool: pairs of links in contact with their supports.

        They are as near as their contact is: of those, only what was told keeps apart.
        """
        w = self.world
        out, bodies = np.zeros(len(w.pairs), dtype=bool), w.model.geom_bodyid[w.pairs]
        for x in tasks:
            if not isinstance(x, Reaching):
                of_link = bodies == w.surfaces[x.contact.surface].body
                of_support = w.pairs == w.support_geom[x.contact.support]
                out |= of_link.any(axis=1) & of_support.any(axis=1)
        return out & ~self._told


def _as_slice(indices: np.ndarray) -> slice | np.ndarray:
    """The same indices as a slice where they are consecutive: indexing is cheaper."""
    first = int(indices[0])
    if np.array_equal(indices, np.arange(first, first + len(indices))):
        return slice(first, first + len(indices))
    return indices
