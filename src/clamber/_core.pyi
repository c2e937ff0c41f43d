"""Native core: inner loops of kinematics, distances, postures, paths, statics."""

from typing import Any

import numpy as np

def support_polygon(points: np.ndarray) -> np.ndarray:
    """(K, 2) convex hull of points (N, 2)."""

def polygon_halfplanes(polygon: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A, b of half-planes `A p <= b` of a polygon (K, 2)."""

def com_margin(x: float, y: float, polygon: np.ndarray) -> float:
    """Signed distance to the border, positive inside."""

def com_margins(com: np.ndarray, polygon: np.ndarray) -> np.ndarray:
    """(n,) `com_margin` of many (n, 2)."""

def support_ellipse(
    polygon: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Centre (2,), semi-axes (2,), foci (2, 2) and string length."""

def ellipse_excess(
    foci: np.ndarray, string_length: float, x: float, y: float
) -> tuple[float, np.ndarray]:
    """Summed distance to the foci less the string length, and its gradient (2,)."""

class Proximity:
    """Which of many pairs of shapes are near, asked again and again as they move."""

    def __init__(
        self,
        kinds: np.ndarray,
        sizes: np.ndarray,
        vertices: list[np.ndarray],
        pairs: np.ndarray,
    ) -> None:
        """Kinds (n,) int32 and sizes (n, 3) of shapes, hull vertices of each (k, 3)."""

    def query(
        self,
        xpos: np.ndarray,
        xmat: np.ndarray,
        reach: float,
        active: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Pairs (m,), distances (m,), normals, first and second points (m, 3)."""

def grow_planes(
    corners: np.ndarray,
    normals: np.ndarray,
    weights: np.ndarray,
    first: np.ndarray,
    next: np.ndarray,
    order: np.ndarray,
    reach: float,
    cosine: float,
) -> np.ndarray:
    """(n,) int32 labels: of elements in one plane; neighbours are `next[first:...]`."""

# Statics: points and normals (nc, 3), mu (nc,), edges of a pyramid, com (3,), mass;
# torque: jacobian (3 nc, nv), gravity (nv,), dofs (na,), limits (na,) or None.

BALANCE_TOL: float
PUSH_TOL: float

_Torque = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None

def contact_frames(normals: np.ndarray) -> np.ndarray:
    """(nc, 3, 3) smallest rotations of the world's x to normals (nc, 3), as z."""

def cone_generators(normals: np.ndarray, mu: np.ndarray, edges: int) -> np.ndarray:
    """(nc, edges, 3) edges of the pyramids inside the friction cones."""

def load_rows(
    points: np.ndarray,
    normals: np.ndarray,
    mu: np.ndarray,
    edges: int,
    com: np.ndarray,
    torque: _Torque,
) -> np.ndarray:
    """(6 + na, nc * edges) wrenches and torques of unit forces along the edges."""

def contact_forces(
    points: np.ndarray,
    normals: np.ndarray,
    mu: np.ndarray,
    edges: int,
    com: np.ndarray,
    mass: float,
    torque: _Torque,
    price: np.ndarray | None,
) -> tuple[np.ndarray, float]:
    """The least forces (nc, 3) [N], and what they leave unbalanced [weights]."""

def com_room(
    points: np.ndarray,
    normals: np.ndarray,
    mu: np.ndarray,
    edges: int,
    com: np.ndarray,
    mass: float,
    torque: _Torque,
) -> float:
    """Margin of the centre of mass [m], in the worst direction.

    Negative: how far it has to, -1 where no place would do.
    """

def push_margin(
    points: np.ndarray,
    normals: np.ndarray,
    mu: np.ndarray,
    edges: int,
    com: np.ndarray,
    mass: float,
    torque: _Torque,
) -> tuple[float, np.ndarray]:
    """Margin [weights], and how fast points and joints (nc + na,) give way there."""

def is_statically_stable(
    points: np.ndarray,
    normals: np.ndarray,
    mu: np.ndarray,
    edges: int,
    com: np.ndarray,
) -> bool:
    """Whether forces within the friction cones balance gravity."""

# What is done at every physics step.

SCENE: int
OTHER: int

class JointServo:
    """PID with feed-forward as commands of joint servos, with its integral."""

    def __init__(
        self,
        *,
        kp: list[float],
        damping: list[float],
        ki: list[float],
        limit: list[float],
        dt: float,
    ) -> None:
        """Gains of na joints; `limit` of the integral [rad s], time step `dt` [s]."""

    def command(
        self,
        reference: np.ndarray,
        velocity: np.ndarray,
        torque: np.ndarray,
        measured: np.ndarray,
        follow: np.ndarray,
    ) -> np.ndarray:
        """(na,) of one step; `follow` in [0, 1]: the joint's reference is its angle."""

class SelfPositioning:
    """The share to which ankles of planted feet position themselves."""

    def __init__(
        self,
        *,
        arms: list[list[int]],
        ankles: list[tuple[int, list[int]]],
        joints: int,
        rate: float,
    ) -> None:
        """Surfaces of each arm; of each foot, with its joints; change per step."""

    def share(
        self, loaded: np.ndarray, closed: np.ndarray, ahead: np.ndarray
    ) -> np.ndarray:
        """(na,) one step later; flags (nS,): loaded, in contact now, and soon."""

class Filter:
    """Low passes of the measured configuration and forces."""

    q: np.ndarray
    load: np.ndarray
    least: float

    def __init__(
        self, q: list[float], surfaces: int, *, pose_share: float, force_share: float
    ) -> None:
        """Begin at `q`, nothing loaded; the share of what is new in each step."""

    def update(self, q: np.ndarray, force: np.ndarray) -> None:
        """Take in one step's measurement."""

    def watch(self, surfaces: list[int], normals: np.ndarray, pressed: float) -> None:
        """Have a controller decide where a surface is pressed along its normal [N]."""

    def bear(self, surfaces: list[int], normals: np.ndarray) -> None:
        """Have `least` be the least force on one of them along its normal [N]."""

class Track:
    """Rows of a reference, one for each step; the present one."""

    q: np.ndarray
    velocity: np.ndarray
    torque: np.ndarray
    closed: np.ndarray
    ahead: np.ndarray
    done: int
    left: int

    def __init__(self, nq: int, joints: int, surfaces: int) -> None:
        """No rows as yet."""

    def load(
        self,
        q: np.ndarray,
        velocity: np.ndarray,
        torque: np.ndarray,
        closed: np.ndarray,
        ahead: np.ndarray,
        steps: int,
    ) -> None:
        """Rows of the next steps; a single row is held for all of them."""

    def advance(self) -> bool:
        """Be at the next row; False where there is none."""

class Follower:
    """Filters, follows a track on servos, has its owner `decide` and `balance`."""

    scale: float
    ends: bool
    steps: int
    goal: np.ndarray
    commanded: np.ndarray

    def __init__(
        self,
        filter: Filter,
        track: Track,
        servo: JointServo,
        ankles: SelfPositioning,
        *,
        qadr: list[int],
        period: int,
        touch: float,
        shift_share: float,
    ) -> None:
        """`touch` [N] loads an arm; `shift_share` of a step eases `goal` in."""

    def command(self, q: np.ndarray, force: np.ndarray, owner: object) -> np.ndarray:
        """(na,) of one step, for what is measured."""

class Sensors:
    """Readings through noise and delay."""

    def __init__(
        self, *, nq: int, surfaces: int, late: int, force_stride: int, block: int
    ) -> None:
        """`late` steps; forces anew every `force_stride`; noise for `block` steps."""

    def draw(
        self, offset: np.ndarray, tilt: np.ndarray, gain: np.ndarray, pull: np.ndarray
    ) -> None:
        """(block, nq), (block, 3); of each reading of forces (n, nS), (n, nS, 3)."""

    def read(
        self, qpos: np.ndarray, force: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Configuration and forces (nS, 3) as they are known at this step."""

class ContactForces:
    """Contacts of the robot with the scene."""

    surface: np.ndarray

    def __init__(self, row_of_geom: list[int], surfaces: int) -> None:
        """The index of each geom's surface, or `SCENE`, or `OTHER`."""

    def update(self, data: object) -> None:
        """Reads forces of an `MjData` after a step; `surface` (nS, 3): sums [N]."""

class Balance:
    """Where to move a centre of mass that is near the border of its support."""

    shift: np.ndarray

    def __init__(
        self,
        model: Model,
        *,
        sag: float,
        p: float,
        d: float,
        t: float,
        most: float,
        smoothing: float,
        settled: float,
        period: float,
    ) -> None:
        """Margins [m], gains, bounds and times [s] of the law."""

    def hold(
        self,
        bodies: list[int],
        local: np.ndarray,
        sole: np.ndarray,
        *,
        high: float,
        fade: float,
    ) -> None:
        """Points (n, 3) of links bear, each `sole` (n, 3) farther in the world.

        Args:
            bodies: (n) their links.
            local: (n, 3) where they are on them.
            sole: (n, 3) of what bears, from there.
            high: The margin at which feedback sets in [m].
            fade: Within how much less it is whole [m].
        """

    def update(self, q: np.ndarray, reference: np.ndarray) -> bool:
        """Whether to move by `shift` (2,); postures (nq,) as measured, as planned."""

class Loop:
    """The steps of a simulation, all but `mj_step` itself, and what is recorded."""

    count: int
    fell: bool

    def __init__(
        self,
        data: object,
        follower: Follower,
        sensors: Sensors,
        forces: ContactForces,
        *,
        order: list[int],
        step_size: float,
        base: int,
        stride: int,
        tail: int,
        tilt: float,
        height: float,
        push: np.ndarray | None,
        steps: int,
    ) -> None:
        """Actuators of the joints; the last `tail` steps are recorded one by one.

        Memory is laid by for as many `steps`; there may be more.
        """

    def step(self, owner: object) -> bool:
        """All that is due before the next `mj_step`; False where there is none."""

    def recorded(self) -> dict[str, np.ndarray]:
        """Recorded arrays, by the names of a rollout; may be called once."""

def load_is_missing(load: np.ndarray, weight: float, share: float) -> bool:
    """Whether forces (nS, 3) are less than the weight by a share of it."""

def hit_sideways(load: np.ndarray, least: float) -> list[int]:
    """Rows of forces (nS, 3) that are sideways more than upwards and than `least`."""

def has_fallen(
    q: np.ndarray, reference: np.ndarray, tilt: float, height: float
) -> bool:
    """The base has tilted [rad] or sunk [m] that far from its reference."""

EDGE_INSET: float
EDGE_ROOM: float
EDGE_WEIGHT: float
ROUGHNESS_WEIGHT: float
STEP_ROTATION: float
STEP_TRANSLATION: float
ACTIVE_RANGE: float
DAMPING: float
PENALTY: float
CONTACT_TOL: float
LIMIT_TOL: float
DISTANCE_TOL: float
MARGIN_TOL: float
CLEARANCE: float
FURTHER_CLEARANCE: float
EFFORT_SHARE: float
LEAST_ROOM: float
MAX_ITERATIONS: int
STEP_TOL: float
COM_WEIGHT: float
ELLIPSE_WEIGHT: float
DRIFT_LIMIT: float
OVERLAP_LIMIT: float
PATH_OPENS: int
PATH_OVERLAPS: int
PATH_WEAK: int

# Contact, distance, balance, limits, worst pair, margin of the centre of mass.
_Residuals = tuple[float, float, float, float, int, float]
_Solution = tuple[np.ndarray, int, bool, _Residuals]
# Status, phase, depth or opening, pair, the posture that cannot be held.
_Verdict = tuple[int, int, float, int, np.ndarray]

def smooth_slopes(x: np.ndarray, y: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Slopes (n, k) at x (n,) of the spline through y (n, k) without steps of bend.

    Args:
        x: Increasing.
        y: At the nodes.
        ends: (2, k) slopes at the first and the last of them.

    Raises:
        ValueError: Nodes do not increase, or a number is not finite.
    """

def along_spline(
    c: np.ndarray, nodes: np.ndarray, s: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Along a cubic spline at s (n,): q (n, nq), dq/ds and d2q/ds2 (n, nv).

    Of the raw coordinates, c (4, k - 1, nq) as SciPy's `PPoly` has them between nodes
    (k,); rotations are normalised. The end pieces go on beyond the nodes.
    """

def between_rows(rows: np.ndarray, nodes: np.ndarray, s: np.ndarray) -> np.ndarray:
    """(n, m) at s (n,), linear between rows (k, m); beyond the nodes the end ones."""

def lean_direction(p1: np.ndarray, p2: np.ndarray, R_WB: np.ndarray) -> np.ndarray:
    """Unit vector from a new contact to the mass it will support (4.26, 4.27)."""

def highest(
    position: np.ndarray,
    normal: np.ndarray,
    A: np.ndarray,
    b: np.ndarray,
    p1: np.ndarray,
    p2: np.ndarray,
) -> float:
    """Height of a support's highest point below the way from p1 to p2 (3,)."""

def arc(
    p1: np.ndarray,
    p2: np.ndarray,
    top: float,
    on_top: bool,
    points: int,
    scale: float = 1.0,
) -> np.ndarray:
    """Control points (n, 3) of the arc between two contact points (4.29)."""

class Model:
    """Constants of a robot in a scene."""

    def __init__(self, constants: dict[str, Any]) -> None:
        """As `clamber.model.core` puts them together."""

class Problem:
    """What a posture must and should satisfy."""

    def __init__(
        self,
        model: Model,
        tasks: np.ndarray,
        task_values: np.ndarray,
        pointing: np.ndarray,
        pointing_values: np.ndarray,
        q_reference: np.ndarray,
        clearance: np.ndarray,
        base_rotation: np.ndarray | None,
        com_target: np.ndarray | None,
        balance: bool,
        weights: np.ndarray,
    ) -> None:
        """Rows of tasks as `clamber.step.tasks` packs them; five weights."""

class Workspace:
    """Solves postures and paths, one at a time."""

    def __init__(self, model: Model, rough: np.ndarray, told: np.ndarray) -> None:
        """Further clearance (P,) [m] of pairs, and (P,) uint8: those told to."""

    def solve(
        self, problem: Problem, q: np.ndarray, iterations: int, tolerance: float
    ) -> _Solution:
        """Iterate from q: q, iterations, whether it converged, residuals."""

    def solve_hard(
        self, problem: Problem, q: np.ndarray, hint: np.ndarray | None
    ) -> _Solution:
        """Solve with more than one way to get there."""

    def residuals(self, problem: Problem, q: np.ndarray) -> _Residuals:
        """How well q satisfies a problem."""

    def build(
        self, problem: Problem, q: np.ndarray, reach: float
    ) -> tuple[
        np.ndarray,
        np.ndarray,
        np.ndarray,
        np.ndarray,
        np.ndarray,
        np.ndarray,
        np.ndarray,
        float,
    ]:
        """The QP at q: H, c, closed rows and errors, kept rows, bounds, merit."""

    def step(self, problem: Problem, q: np.ndarray, radius: float) -> np.ndarray:
        """The solution of the QP at q, with steps up to a share of the largest."""

    def is_stable(
        self, contacts: np.ndarray, contact_values: np.ndarray, q: np.ndarray
    ) -> bool:
        """Whether forces and torques that are counted on hold the robot at q."""

    def statics(
        self, contacts: np.ndarray, contact_values: np.ndarray, q: np.ndarray
    ) -> tuple[
        np.ndarray,
        np.ndarray,
        np.ndarray,
        np.ndarray,
        np.ndarray,
        np.ndarray,
        np.ndarray,
        np.ndarray,
    ]:
        """Points that bear, normals, friction, contact of each; load and torques."""

    def centres_of_mass(self, q: np.ndarray) -> np.ndarray:
        """(n, 3) of the robot at postures (n, nq)."""

    def differences(self, q: np.ndarray) -> np.ndarray:
        """(n - 1, nv) tangent vectors from each posture (n, nq) to the next."""

    def kinematics(
        self, q: np.ndarray, body: int, point: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Positions, rotations; Jacobians of the centre of mass, of a body's point."""

    def holding_torques(
        self,
        contacts: np.ndarray,
        contact_values: np.ndarray,
        prices: np.ndarray,
        q: np.ndarray,
        inertia: np.ndarray,
    ) -> np.ndarray:
        """(n, na) torques that hold postures (n, nq); prices (n, k), or 0.

        Against generalised forces (n, nv) of inertia besides gravity's, or (0, 0).
        """

    def tangents(
        self,
        q: np.ndarray,
        ha: float,
        hb: float,
        steeper: float,
        what: np.ndarray,
        where: np.ndarray,
    ) -> np.ndarray:
        """Slopes (2, nq) where one path ends and the next begins; contacts stay closed.

        Args:
            q: (4, nq) the last two postures of the one, the first two of the other.
            ha: Path parameter between the first two.
            hb: ... between the others.
            steeper: Times the slower side, at most.
            what: Closed contacts, packed.
            where: Their numbers.
        """

    def time_law(
        self,
        contacts: list[tuple[np.ndarray, np.ndarray]],
        stance: np.ndarray,
        q: np.ndarray,
        slope: np.ndarray,
        inertia: np.ndarray,
        velocity: np.ndarray,
        limits: np.ndarray,
        damping: np.ndarray,
        share: float,
    ) -> np.ndarray:
        """(n + 1,) squared rate of the fastest law between n intervals of a path.

        Limits (5, n): lengths, bounds of |u| and x, and those that are always borne.
        """

    def bridge(
        self,
        a: np.ndarray,
        b: np.ndarray,
        contacts: np.ndarray,
        contact_values: np.ndarray,
    ) -> np.ndarray:
        """Postures from one to another with contacts closed, near the straight way."""

    def rolled(
        self,
        contact: np.ndarray,
        contact_values: np.ndarray,
        q: np.ndarray,
        towards: np.ndarray,
    ) -> tuple[int, np.ndarray]:
        """The edge, -1 for none, on which it comes nearest to a point; its middle."""

    def shift(
        self,
        before: np.ndarray,
        contacts: list[tuple[np.ndarray, np.ndarray]],
        margin: float,
        hint: np.ndarray | None,
    ) -> tuple[list[tuple[int, np.ndarray]], _Solution, bool]:
        """Edges of contacts that are let go; weight on the others; does that hold?"""

    def touch(
        self,
        shifted: np.ndarray,
        after: np.ndarray,
        contacts: list[tuple[np.ndarray, np.ndarray]],
        margin: float,
        hint: np.ndarray | None,
    ) -> tuple[_Solution, bool]:
        """The new contact closed and not loaded; does that hold?"""

    def path(
        self,
        postures: list[np.ndarray],
        contacts: list[tuple[np.ndarray, np.ndarray]],
        margin: float,
        adapt: bool,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, _Verdict]:
        """Postures of shift, swing, settle, the arc's control points, a verdict."""

    def check_path(
        self,
        phases: list[np.ndarray],
        contacts: list[tuple[np.ndarray, np.ndarray]],
    ) -> _Verdict:
        """What is wrong with the postures of a path."""
