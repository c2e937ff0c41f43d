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
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np

from clamber import _core
from clamber.errors import Status
from clamber.model.core import core_of
from clamber.model.kinematics import Kinematics
from clamber.model.records import short_repr
from clamber.model.world import World, limb_links
from clamber.step.tasks import (
    Places,
    SurfaceTask,
    leaning,
    packed_pointing,
    packed_tasks,
    segment_ends,
)

# The core's constants, where a reader of results needs them.
STEP_ROTATION: float = _core.STEP_ROTATION  # [rad] largest joint step of an iteration
STEP_TRANSLATION: float = _core.STEP_TRANSLATION  # [m] largest step of the base
ACTIVE_RANGE: float = _core.ACTIVE_RANGE  # [m] farther pairs have no row
DAMPING: float = _core.DAMPING  # mu
PENALTY: float = _core.PENALTY  # of violations against the soft cost
CONTACT_TOL: float = _core.CONTACT_TOL  # [m, rad] a contact is closed
LIMIT_TOL: float = _core.LIMIT_TOL  # [rad] beyond a joint's limit
DISTANCE_TOL: float = _core.DISTANCE_TOL  # [m] a distance may fall short by this
BALANCE_TOL: float = _core.MARGIN_TOL  # [m]
FURTHER_CLEARANCE: float = _core.FURTHER_CLEARANCE  # [m] a shin beside its knee
# [m] Arms stay farther from legs than their clearance, of the robot's size, where that
# costs little: hands and knees that slip by so much come no nearer than planned.
ARMS_FROM_LEGS = 0.02
# How much farther than its clearance a part stays from a support [m], by geom and name.
ExtraClearance = Mapping[tuple[int, str], float]
NO_EXTRA: ExtraClearance = MappingProxyType({})


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
        balance_margin: Least distance of the centre of mass from the border of the
            support polygon [m].
        com_target: (2,) preferred centre of mass; None is the middle of the polygon.
        posture_weight, direction_weight, base_weight, com_weight: Weights of the soft
            tasks.
        ellipse_weight: Weight of holding the centre of mass in the support ellipse
            (4.28).
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
    """Residuals of a configuration, computed without the solver.

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
        if self.contact > CONTACT_TOL or self.limits > LIMIT_TOL:
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
        margin: Clearance of all other pairs [m].
        contacts: Support of each surface in contact.
        rolling: Flat surfaces on an edge, whose other edges may touch but not enter.

    Returns:
        (P,): the planning geom of a contact pair is left to the contact task; further
        geoms of the surface keep `FURTHER_CLEARANCE`, of the robot's size.
    """
    out = np.full(len(world.pairs), margin)
    for surface, support in contacts.items():
        planned, further = world.touching[surface, support]
        out[further] = FURTHER_CLEARANCE * world.length_scale
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
    merit: float

    __repr__ = short_repr


def _arms_and_legs(world: World) -> np.ndarray:
    """(P,) bool: pairs of a link of an arm and one of a leg."""
    links: dict[bool, set[int]] = {True: set(), False: set()}
    for limb in world.robot.limbs.values():
        links[limb.is_arm] |= limb_links(world, limb.surfaces[0])
    bodies = world.model.geom_bodyid[world.pairs]
    arms, legs = (np.isin(bodies, list(links[k])) for k in (True, False))
    return np.logical_and(arms.any(axis=1), legs.any(axis=1))


class IK:
    """Workspace of the solver: one per world, used again for every posture."""

    def __init__(self, world: World, extra: ExtraClearance = NO_EXTRA) -> None:
        """Allocate once.

        Args:
            world: Robot and scene.
            extra: Clearance as a task, like the roughness of a box.
        """
        self.world, self.extra = world, extra
        self.kin = Kinematics(world)
        # What each pair keeps besides its clearance, and whether a part was told to.
        rough = ARMS_FROM_LEGS * world.length_scale * _arms_and_legs(world)
        told = np.zeros(len(world.pairs), dtype=np.uint8)
        for box in world.scene.boxes:
            of_box = world.pairs == world.support_geom[box.name]
            rough[of_box.any(axis=1)] = box.roughness
        for mesh in world.scene.meshes:
            names = map(mesh.piece_name, range(len(mesh.pieces)))
            own = [world.support_geom[n] for n in names]
            rough[np.isin(world.pairs, own).any(axis=1)] = mesh.roughness
        for (geom, support), more in extra.items():
            pair = geom, world.support_geom[support]
            mine = np.isin(world.pairs, pair).all(axis=1)
            rough[mine] = np.maximum(rough[mine], more)
            told |= mine
        self._model = core_of(world)
        self.core = _core.Workspace(self._model, rough, told)
        # The last problem, as the core has it.
        self._asked: tuple[PostureProblem, _core.Problem] | None = None
        self._segments: dict[str, tuple[Places, Places]] = {}

    def build(
        self, problem: PostureProblem, q: np.ndarray, reach: float = ACTIVE_RANGE
    ) -> QP:
        """The QP at `q`.

        Args:
            problem: What is wanted.
            q: (nq,).
            reach: Pairs farther apart than this have no row [m].
        """
        H, c, C, e, A, lo, hi, merit = self.core.build(self._ask(problem), q, reach)
        return QP(H=H, c=c, C=C, e=e, A=A, lo=lo, hi=hi, merit=merit)

    def step(
        self, problem: PostureProblem, q: np.ndarray, radius: float = 1.0
    ) -> np.ndarray:
        """The step (nv,) that the QP at `q` asks for.

        What cannot all be satisfied is shared out by least squares.

        Args:
            problem: What is wanted.
            q: (nq,).
            radius: Share of the largest step that this one may take.
        """
        return self.core.step(self._ask(problem), q, radius)

    def solve(
        self,
        problem: PostureProblem,
        q: np.ndarray,
        *,
        iterations: int = _core.MAX_ITERATIONS,
        tolerance: float = _core.STEP_TOL,
    ) -> Solution:
        """Iterate from `q` until the step is below `tolerance`.

        A trust region on an exact penalty: a step that raises the merit is taken back
        and tried again a quarter as long. The first step is taken all the same: a limb
        that sets out pays for it at first. Where that has not paid off in the end, the
        solve begins again without.
        """
        return as_solution(
            self.core.solve(self._ask(problem), q, iterations, tolerance)
        )

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
        return as_solution(self.core.solve_hard(self._ask(problem), q, hint))

    def residuals(self, problem: PostureProblem, q: np.ndarray) -> Residuals:
        """Recompute everything from the model at `q`."""
        return _residuals(self.core.residuals(self._ask(problem), q))

    def _ends(self, segment: str) -> tuple[Places, Places]:
        """End points of a body segment; names are looked up once."""
        if segment not in self._segments:
            self._segments[segment] = segment_ends(self.world, segment)
        return self._segments[segment]

    def _ask(self, p: PostureProblem) -> _core.Problem:
        """A problem as the core has it; the last one is kept."""
        if self._asked is not None and self._asked[0] is p:
            return self._asked[1]
        world, turns = self.world, p.base_rotation if p.base_weight > 0 else None
        points = []
        if p.direction_weight > 0:
            weight = p.direction_weight
            points = [(*self._ends(n), u, weight) for n, u in p.directions.items()]
        if p.lean is not None:
            points.append(leaning(world, *p.lean))
        asked = _core.Problem(
            self._model,
            *packed_tasks(world, p.tasks),
            *packed_pointing(points),
            p.q_reference,
            p.clearance,
            None if turns is None else np.ascontiguousarray(turns).ravel(),
            p.com_target,
            p.balance,
            np.array(
                [
                    p.balance_margin,
                    p.posture_weight,
                    p.base_weight,
                    p.com_weight,
                    p.ellipse_weight,
                ]
            ),
        )
        self._asked = p, asked
        return asked


def as_solution(found: tuple[np.ndarray, int, bool, tuple]) -> Solution:
    """The core's result of a solve, as a record."""
    q, iterations, converged, residuals = found
    return Solution(
        q=q,
        iterations=iterations,
        residuals=_residuals(residuals),
        converged=converged,
    )


def _residuals(found: tuple) -> Residuals:
    contact, distance, balance, limits, worst_pair, com_margin = found
    return Residuals(
        contact=contact,
        distance=distance,
        balance=balance,
        limits=limits,
        worst_pair=worst_pair,
        com_margin=com_margin,
    )
