"""What a posture may be asked for: small tasks, each with its errors and Jacobian rows.

`add(kin, rows)` puts down what holds at the present posture of `kin` and leaves the
Jacobians to functions that are called only where a QP is built: a third of the
configurations that a solve looks at are judged by their errors alone. A task of a
surface says besides, without the solver, by how much its contact is `opened`.

A round surface touches under its centre. Where it is closed on its support it rolls:
the contact moves with the link, and the link's material point with it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from clamber.contact.contact import Contact
from clamber.model.kinematics import Kinematics
from clamber.model.records import short_repr
from clamber.model.scene import Support
from clamber.model.se3 import frame_from_normal, matrix_from_quat, rotation_vector
from clamber.model.world import Surface, World
from clamber.step.polygon import polygon_halfplanes, support_ellipse, support_polygon

FLAT_WEIGHT = 0.3  # of a flat surface's turn, against its place
EDGE_INSET = 0.015  # [m] contacts stay this far inside the support's border
EDGE_RANGE = 0.15  # [m] ... and have a row where they are nearer to it
EDGE_ROOM = 0.045  # [m] ... and round ones should, where it costs nothing else
EDGE_WEIGHT = 3.0
ROUGHNESS_WEIGHT = 10.0  # soft task: more distance from what is rough
FAR = 1e30  # no bound

# Points in the world with the body that each moves with.
_Places = Sequence[tuple[int, np.ndarray]]
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


class Block:
    """Preallocated rows `lo <= J x <= hi`, filled from the top."""

    def __init__(self, capacity: int, nv: int) -> None:
        """Of so many rows; it grows where more are taken."""
        self.J = np.zeros((capacity, nv))
        self.lo = np.zeros(capacity)
        self.hi = np.zeros(capacity)
        self.n = 0

    def take(self, m: int) -> slice:
        """The next `m` rows."""
        if self.n + m > len(self.J):
            grow = max(len(self.J), m)
            self.J = np.concatenate([self.J, np.zeros((grow, self.J.shape[1]))])
            self.lo = np.concatenate([self.lo, np.zeros(grow)])
            self.hi = np.concatenate([self.hi, np.zeros(grow)])
        s = slice(self.n, self.n + m)
        self.n += m
        return s


class Rows:
    """All rows of a posture's QP at one configuration.

    Attributes:
        soft: Wanted, J dq = -lo, in the least-squares sense, times their weights.
        closed: J dq = lo.
        kept: lo <= J dq <= hi.
        violation: Squared norm of what `closed` and `kept` ask for [m, rad].
        reach: Pairs farther apart than this have no row [m].
        edges, insets: Half-planes of each support's border, and `EDGE_INSET` inside.
    """

    def __init__(self, world: World) -> None:
        """Allocate once."""
        nv = world.model.nv
        self.soft, self.closed, self.kept = Block(96, nv), Block(32, nv), Block(96, nv)
        self.violation, self.reach = 0.0, 0.0
        self.edges = {n: s.edges() for n, s in world.supports.items()}
        self.insets = {n: (A, b - EDGE_INSET) for n, (A, b) in self.edges.items()}
        self._fills: list[Callable[[], object]] = []

    def clear(self, reach: float) -> None:
        """Begin anew, at another configuration."""
        self.reach = reach
        self.soft.n = self.closed.n = self.kept.n = 0
        self.violation = 0.0
        self._fills.clear()

    def fill(self) -> None:
        """Ask for the Jacobians of all rows."""
        for fill in self._fills:
            fill()

    def later(self, fill: Callable[[], object]) -> None:
        """Have Jacobians written by `fill`, where they are needed."""
        self._fills.append(fill)

    def want(self, e: np.ndarray, weight: float) -> slice:
        """Soft rows; `aim` gives them their Jacobian."""
        k = self.soft.take(len(e))
        np.multiply(e, weight, out=self.soft.lo[k])
        return k

    def aim(self, k: slice, J: np.ndarray, weight: float) -> None:
        """The Jacobian of soft rows."""
        np.multiply(J, weight, out=self.soft.J[k])

    def close(self, *errors: np.ndarray) -> slice:
        """Rows that are to vanish: J dq = e for each of the errors in turn."""
        self.violation += sum(_size(e) for e in errors)
        e = errors[0] if len(errors) == 1 else np.concatenate(errors)
        k = self.closed.take(len(e))
        self.closed.lo[k] = e
        return k

    def at_most(self, room: np.ndarray) -> slice:
        """J dq <= room."""
        self.violation += _size(np.minimum(room, 0.0))
        return self._keep(-FAR, room)

    def at_least(self, short: np.ndarray) -> slice:
        """J dq >= short."""
        self.violation += _size(np.maximum(short, 0.0))
        return self._keep(short, FAR)

    def _keep(self, lo: np.ndarray | float, hi: np.ndarray | float) -> slice:
        k = self.kept.take(np.size(lo if isinstance(hi, float) else hi))
        self.kept.lo[k], self.kept.hi[k] = lo, hi
        return k

    def inside(
        self, kin: Kinematics, support: str, p: np.ndarray, body: int, moves: np.ndarray
    ) -> None:
        """Keep `p` on a support; it moves as the body's point at `moves` does."""
        A, b = self.insets[support]
        room = b - A @ p
        near = room < EDGE_RANGE
        if not near.any():
            return
        k = self.at_most(room[near])

        def fill() -> None:
            self.kept.J[k] = A[near] @ kin.point_jacobian(body, moves)

        self.later(fill)


class Task(Protocol):
    """Something that a posture is asked for."""

    def add(self, kin: Kinematics, rows: Rows) -> None:
        """Put down what holds at the present posture."""
        ...


# Of a surface on, or on its way to, a support. `rotation` is R_WC (3, 3) of a flat
# surface in contact: that of the contact, its z along the support's normal.


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Closed:
    """A contact in its place.

    Attributes:
        contact: Where it holds. A round surface rolls from its `link`; without, its
            centre stays over the contact's position.
        rotation: Of a flat surface.
        loaded: It may bear force, and counts for the support polygon.
    """

    contact: Contact
    rotation: np.ndarray
    loaded: bool = True

    __repr__ = short_repr

    def add(self, kin: Kinematics, rows: Rows) -> None:
        """Position, and the turn of a flat surface."""
        c, (s, n, p) = self.contact, _touch(kin, self.contact)
        if s.is_flat:
            turn = kin.flat_error(c.surface, self.rotation)
            k = rows.close(np.concatenate([c.position - p, turn]))

            def fill() -> None:
                rows.closed.J[k] = np.concatenate(kin.jacobians(s.body, p))

        else:
            k = rows.close(c.position + kin.roll(c.surface, n, c.link) - p)
            moves = centre = p + s.radius * n
            if c.link is not None:
                moves = p
                rows.inside(kin, c.support, p, s.body, centre)

            def fill() -> None:
                kin.point_jacobian(s.body, moves, rows.closed.J[k])

        rows.later(fill)

    def opened(self, kin: Kinematics) -> float:
        """Largest distance or angle by which it is open [m, rad]."""
        c, (s, n, p) = self.contact, _touch(kin, self.contact)
        gap = p - (c.position + kin.roll(c.surface, n, c.link))
        turn = kin.flat_error(c.surface, self.rotation) if s.is_flat else gap
        return max(float(np.linalg.norm(gap)), float(np.linalg.norm(turn)))


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class OnEdge:
    """A flat surface that has rolled onto its contact's edge, which is in its place.

    Attributes:
        contact: Where the edge's middle holds; the surface may turn about it.
        rotation: As it lay flat.
        loaded: It may bear force, and counts for the support polygon.
    """

    contact: Contact
    rotation: np.ndarray
    loaded: bool = True

    __repr__ = short_repr

    def add(self, kin: Kinematics, rows: Rows) -> None:
        """Position and two angles; softly, it would rather lie flat."""
        c, (s, n, p) = self.contact, _touch(kin, self.contact)
        turn, axis = kin.flat_error(c.surface, self.rotation), self._axis(kin.world)
        across = np.stack([n, np.cross(n, axis)])
        k = rows.close(c.position - p, across @ turn)
        flat = rows.want(-(axis @ turn)[None], FLAT_WEIGHT)

        def fill() -> None:
            jac, rot = kin.jacobians(s.body, p)
            rows.closed.J[k] = np.concatenate([jac, across @ rot])
            rows.aim(flat, axis[None] @ rot, FLAT_WEIGHT)

        rows.later(fill)

    def opened(self, kin: Kinematics) -> float:
        """Largest distance or angle by which it is open [m, rad]."""
        c, (_, _, p) = self.contact, _touch(kin, self.contact)
        turn, axis = kin.flat_error(c.surface, self.rotation), self._axis(kin.world)
        turn = turn - axis * (turn @ axis)
        return max(float(np.linalg.norm(p - c.position)), float(np.linalg.norm(turn)))

    def _axis(self, world: World) -> np.ndarray:
        """(3,) unit vector along the edge, where the surface lay flat."""
        s = world.surface(self.contact.surface, self.contact.edge)
        assert s.rotation is not None
        along = self.rotation @ s.rotation.T @ (s.corners[1] - s.corners[0])
        return along / np.linalg.norm(along)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Sliding:
    """A contact that is closed wherever it is on its support.

    Attributes:
        contact: Where it would be liked.
        rotation: Of a flat surface, up to a turn about the normal.
        reference: Weight of the distance to the contact's position.
        stability: Weight of (4.25), the horizontal distance from the contact to the
            mass it supports.
        loaded: It may bear force, and counts for the support polygon.
    """

    contact: Contact
    rotation: np.ndarray
    reference: float = 0.0
    stability: float = 0.0
    loaded: bool = True

    __repr__ = short_repr

    def add(self, kin: Kinematics, rows: Rows) -> None:
        """Height, flatness and the border; softly, the place along the support."""
        c, (s, n, p) = self.contact, _touch(kin, self.contact)
        support = kin.world.supports[c.support]
        T, centre = support.rotation.T[:2], p + s.radius * n
        k = lies = rows.close(np.array([-float(support.height(p))]))
        if s.is_flat:
            turn = kin.flat_error(c.surface, self.rotation)
            lies = rows.close(T @ turn)
            aside, weight = n[None], FLAT_WEIGHT
            soft = rows.want(-(n @ turn)[None], weight)
            for corner in kin.bearing_points(c.surface, n):
                rows.inside(kin, c.support, corner, s.body, corner)
        else:
            rows.inside(kin, c.support, p, s.body, centre)
            # As a task, room to slip before it is over the border.
            A, b = rows.edges[c.support]
            room = b - EDGE_ROOM - A @ p
            aside, weight = A[room < 0.0], EDGE_WEIGHT
            soft = rows.want(-room[room < 0.0], weight)
        wanted = under = None
        if self.reference > 0:
            wanted = rows.want(T @ (p - c.position), self.reference)
        body, mass = kin.landmark(kin.world.robot.limb_of(c.surface).root)
        stability = np.sqrt(2.0 * self.stability)
        if self.stability > 0:
            under = rows.want((p - mass)[:2], stability)

        def fill() -> None:
            jac, rot = kin.jacobians(s.body, centre)
            rows.closed.J[k] = n @ jac
            if s.is_flat:
                rows.closed.J[lies] = T @ rot
            rows.aim(soft, aside @ (rot if s.is_flat else jac), weight)
            if wanted is not None:
                rows.aim(wanted, T @ jac, self.reference)
            if under is not None:
                jac = jac[:2].copy()
                rows.aim(under, jac - kin.point_jacobian(body, mass)[:2], stability)

        rows.later(fill)

    def opened(self, kin: Kinematics) -> float:
        """Largest distance or angle by which it is open, or over the border."""
        c, (s, n, p) = self.contact, _touch(kin, self.contact)
        support = kin.world.supports[c.support]
        A, b = support.edges()
        over = float((kin.bearing_points(c.surface, n) @ A.T - b).max())
        error = max(abs(float(support.height(p))), over)
        if s.is_flat:
            turn = kin.flat_error(c.surface, self.rotation)
            error = max(error, float(np.linalg.norm(turn - n * (turn @ n))))
        return error


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Reaching:
    """A surface in the air, on its way.

    Attributes:
        contact: Where it should be, and what it goes to.
        rotation: Of a flat surface.
        weight: Of the distance; of a turn, 0.3 of it.
    """

    contact: Contact
    rotation: np.ndarray
    weight: float

    __repr__ = short_repr

    def add(self, kin: Kinematics, rows: Rows) -> None:
        """Position, and the turn of a flat surface."""
        c, (s, n, p) = self.contact, _touch(kin, self.contact)
        centre, turned = p + s.radius * n, None
        k = rows.want(p - c.position, self.weight)
        if s.is_flat:
            turn = kin.flat_error(c.surface, self.rotation)
            turned = rows.want(-turn, FLAT_WEIGHT * self.weight)

        def fill() -> None:
            jac, rot = kin.jacobians(s.body, centre)
            rows.aim(k, jac, self.weight)
            if turned is not None:
                rows.aim(turned, rot, FLAT_WEIGHT * self.weight)

        rows.later(fill)


ClosedTask = Closed | OnEdge | Sliding
SurfaceTask = ClosedTask | Reaching


def closed(world: World, c: Contact, *, loaded: bool = True) -> Closed | OnEdge:
    """A contact that keeps its place."""
    task = Closed if c.edge is None else OnEdge
    return task(contact=c, rotation=_rotation(world, c), loaded=loaded)


def sliding(world: World, c: Contact, reference: float, **more: Any) -> Sliding:
    """A contact that is closed on its support, and liked where it is."""
    flat, R = replace(c, edge=None), _rotation(world, c)
    return Sliding(contact=flat, rotation=R, reference=reference, **more)


def reaching(world: World, c: Contact, at: np.ndarray, *, weight: float) -> Reaching:
    """A contact's surface at a point (3,), turned as in contact."""
    there = replace(c, position=at, edge=None)
    return Reaching(contact=there, rotation=_rotation(world, c), weight=weight)


def support_rotation(support: Support, quaternion: np.ndarray) -> np.ndarray:
    """R_WC: z along the support's normal, x as near to the quaternion's as it can."""
    return frame_from_normal(support.normal, matrix_from_quat(quaternion)[:, 0])


def _rotation(world: World, c: Contact) -> np.ndarray:
    return support_rotation(world.supports[c.support], c.quaternion)


def _touch(kin: Kinematics, c: Contact) -> tuple[Surface, np.ndarray, np.ndarray]:
    """The surface, the normal (3,) and the point (3,) at which they touch."""
    n = kin.world.supports[c.support].normal
    surface, p = kin.world.surfaces[c.surface], kin.contact_point(c.surface, n, c.edge)
    return surface, n, p


# Of the whole body.


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Turned:
    """A pelvis turned as R_WB (3, 3)."""

    rotation: np.ndarray
    weight: float

    __repr__ = short_repr

    def add(self, kin: Kinematics, rows: Rows) -> None:
        """The turn that is left."""
        base = kin.world.base
        turn = rotation_vector(self.rotation @ kin.rotation(base).T)
        k, at = rows.want(-turn, self.weight), kin.data.xpos[base]
        rows.later(lambda: rows.aim(k, kin.jacobians(base, at)[1], self.weight))


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Pointing:
    """From the middle of some places to that of others, in a direction.

    Attributes:
        start, end: Bodies with points (3,) in their frames.
        direction: (3,) unit vector in the world.
        weight: Of the difference between unit vectors.
    """

    start: _Places
    end: _Places
    direction: np.ndarray
    weight: float

    __repr__ = short_repr

    def add(self, kin: Kinematics, rows: Rows) -> None:
        """The length is held still while a step is taken."""
        start, end = (
            [(body, kin.point(body, p)) for body, p in x]
            for x in (self.start, self.end)
        )
        way = _middle([p for _, p in end]) - _middle([p for _, p in start])
        length = float(np.linalg.norm(way))
        k = rows.want(way / length - self.direction, self.weight)

        def fill() -> None:
            J = _middle([kin.point_jacobian(*x).copy() for x in end])
            J = J - _middle([kin.point_jacobian(*x).copy() for x in start])
            rows.aim(k, J / length, self.weight)

        rows.later(fill)


def pointing(world: World, segment: str, direction: np.ndarray, w: float) -> Pointing:
    """A body segment by name, such as `left_thigh` or `trunk`, in a direction (3,)."""
    limbs = world.robot.limbs
    if segment == "trunk":
        start = [limbs[x].root for x in ("left_leg", "right_leg")]
        end = [limbs[x].root for x in ("left_arm", "right_arm")]
    else:
        limb, first, second = _SEGMENTS[segment]
        start, end = [getattr(limbs[limb], first)], [getattr(limbs[limb], second)]
    return Pointing(
        start=[world.landmark(x) for x in start],
        end=[world.landmark(x) for x in end],
        direction=direction,
        weight=w,
    )


def leaning(world: World, surface: str, direction: np.ndarray, w: float) -> Pointing:
    """From a surface to the mass that its limb supports, in a direction (3,)."""
    s = world.surfaces[surface]
    return Pointing(
        start=[(s.body, s.centre)],
        end=[world.landmark(world.robot.limb_of(surface).root)],
        direction=direction,
        weight=w,
    )


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Over:
    """The centre of mass over `target` (2,)."""

    target: np.ndarray
    weight: float

    __repr__ = short_repr

    def add(self, kin: Kinematics, rows: Rows) -> None:
        """The horizontal distance."""
        k = rows.want(kin.com[:2] - self.target, self.weight)
        rows.later(lambda: rows.aim(k, kin.com_jacobian()[:2], self.weight))


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Balance:
    """The centre of mass inside the polygon of the contacts that bear.

    Attributes:
        contacts: Those that bear.
        margin: From the polygon's border [m].
        middle_weight: Of the distance to the mean of its vertices.
        ellipse_weight: Of holding it in the support ellipse (4.28).
    """

    contacts: Sequence[ClosedTask]
    margin: float
    middle_weight: float
    ellipse_weight: float

    __repr__ = short_repr

    def add(self, kin: Kinematics, rows: Rows) -> None:
        """A row for each edge of the polygon."""
        if not self.contacts:
            return
        com = kin.com[:2].copy()
        bodies, points, centres = _bearing(kin, self.contacts)
        polygon = support_polygon(points[:, :2])
        A, b = polygon_halfplanes(polygon)
        k = rows.at_most(b - self.margin - A @ com)
        middle = drawn = None
        if self.middle_weight > 0:
            off = com - np.add.reduce(polygon, axis=0) / len(polygon)
            middle = rows.want(off, self.middle_weight)
        excess, gradient = 0.0, com
        if self.ellipse_weight > 0:
            excess, gradient = support_ellipse(polygon).excess(com)
        if excess > 0:
            drawn = rows.want(np.array([excess]), self.ellipse_weight)

        def fill() -> None:
            J = kin.com_jacobian()[:2].copy()
            rows.kept.J[k] = A @ J
            if middle is not None:
                rows.aim(middle, J, self.middle_weight)
            if drawn is not None:
                rows.aim(drawn, (gradient @ J)[None], self.ellipse_weight)
            if len(polygon) == len(b) and any(bodies):
                _follow_edges(
                    kin, (A, polygon), com, (bodies, points, centres), rows.kept.J[k]
                )

        rows.later(fill)

    def points(self, kin: Kinematics) -> np.ndarray:
        """(n, 3) the points that bear load."""
        return _bearing(kin, self.contacts)[1]


def _bearing(
    kin: Kinematics, contacts: Sequence[ClosedTask]
) -> tuple[list[int | None], np.ndarray, np.ndarray]:
    """The points (n, 3) that bear load, and what moves each of them.

    A body moves it, None where it stays put, as it moves what is at the last array: a
    ball's contact stays under its centre.
    """
    bodies: list[int | None] = []
    points, centres = [np.zeros((0, 3))], [np.zeros((0, 3))]
    for c in contacts:
        surface, n = c.contact.surface, kin.world.supports[c.contact.support].normal
        s, p = (
            kin.world.surfaces[surface],
            kin.bearing_points(surface, n, c.contact.edge),
        )
        stays = s.is_flat and not isinstance(c, Sliding)
        bodies += [None if stays else s.body] * len(p)
        points.append(p)
        centres.append(p + s.radius * n)
    return bodies, np.concatenate(points), np.concatenate(centres)


def _follow_edges(
    kin: Kinematics,
    edges: tuple[np.ndarray, np.ndarray],
    com: np.ndarray,
    bearing: tuple[list[int | None], np.ndarray, np.ndarray],
    J: np.ndarray,
) -> None:
    """Let the polygon's edges move with contacts that slide or roll, in rows J (K, nv).

    The distance of c from the line through p and q changes by
    n'((1 - t) dp + t dq - dc), t the share of the edge at which c lies abreast.
    """
    (A, polygon), (bodies, points, centres) = edges, bearing
    corners, (x, y) = polygon.tolist(), com.tolist()
    places = points[:, :2].tolist()
    moves = np.zeros((len(corners), 3, kin.world.model.nv))
    shares = []
    for move, a, b in zip(moves, corners, [*corners[1:], corners[0]], strict=True):
        (ax, ay), (bx, by) = a, b
        gaps = [abs(ax - px) + abs(ay - py) for px, py in places]
        o = gaps.index(min(gaps))
        body = bodies[o]
        if body is not None:
            kin.point_jacobian(body, centres[o], move)
        ex, ey = bx - ax, by - ay
        shares.append(((x - ax) * ex + (y - ay) * ey) / (ex * ex + ey * ey))
    t = np.array(shares)[:, None]
    following = np.concatenate([moves[1:, :2], moves[:1, :2]])
    J -= (((1.0 - t) * A)[:, None] @ moves[:, :2])[:, 0]
    J -= ((t * A)[:, None] @ following)[:, 0]


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Distance:
    """Pairs no nearer than their clearances.

    Attributes:
        clearance: (P,) [m].
        counts: (P,) bool, the pairs that are looked at.
    """

    clearance: np.ndarray
    counts: np.ndarray

    __repr__ = short_repr

    def add(self, kin: Kinematics, rows: Rows) -> None:
        """A row for each pair nearer than `rows.reach`."""
        near = kin.proximity(rows.reach, self.counts)
        if len(near.pairs) == 0:
            return
        k = rows.at_least(self.clearance.take(near.pairs) - near.distance)

        def fill() -> None:
            rows.kept.J[k] = kin.distance_jacobian(near.pairs, near.first, near.normal)

        rows.later(fill)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Apart:
    """Pairs that would rather keep farther from one another, where either is rough.

    Attributes:
        wanted: (P,) [m].
        counts: (P,) bool, the pairs that are looked at.
    """

    wanted: np.ndarray
    counts: np.ndarray

    __repr__ = short_repr

    def add(self, kin: Kinematics, rows: Rows) -> None:
        """A soft row for each pair nearer than the farthest that is wanted."""
        reach = float(self.wanted.max(initial=0.0, where=self.counts))
        near = kin.proximity(reach, self.counts)
        short = np.maximum(self.wanted[near.pairs] - near.distance, 0.0)
        if not short.any():
            return
        k = rows.want(-short, ROUGHNESS_WEIGHT)

        def fill() -> None:
            J = kin.distance_jacobian(near.pairs, near.first, near.normal)
            J[short == 0.0] = 0.0
            rows.aim(k, J, ROUGHNESS_WEIGHT)

        rows.later(fill)


def _middle(x: Sequence[np.ndarray]) -> np.ndarray:
    """Of one or two."""
    return x[0] if len(x) == 1 else 0.5 * (x[0] + x[1])


def _size(e: np.ndarray) -> float:
    """Squared Euclidean length."""
    return float(e @ e)
