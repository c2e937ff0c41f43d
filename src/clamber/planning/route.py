"""Scene -> what lies between start and goal, and where a contact can be made on it.

Along the straight line from start to goal, boxes that are close together make one
platform, which is climbed up at one edge and, unless the goal is on it, down at
another.
Other boxes are walls: nothing stands on them, and nothing comes close to them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from clamber.contact.contact import Contact
from clamber.errors import InputError
from clamber.model.records import short_repr
from clamber.model.scene import GROUND_HALF_SIZE, Edge, Scene, Support
from clamber.model.se3 import quat_from_matrix, turn_about_z

GAP = 0.40  # [m] a narrower gap is crossed on top, a wider one on the ground
JOINT = 0.02  # [m] a narrower gap is none
BESIDE = 0.25  # [m] an edge is climbed so far from its ends, where it is that long
ARRIVED = 0.05  # [m] from where it shall get to, the body is there
FACING = 0.15  # [rad] from how it shall face
BORDER = 0.02  # [m] contacts stay so far inside a top's border
GRID = 0.02  # [m] of the search for a place: coarser, and it misses narrow ones
# [m] A place is looked for this far around where it is wanted: less than half of `GAP`,
# and there is none over the middle of a gap.
SPAN = 0.24


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Platform:
    """Boxes that are crossed without coming down between them.

    Attributes:
        boxes: Names, in the order in which the line from start to goal meets them.
        entry: Edge that is climbed up; its point is where.
        exit: Edge that is climbed down; None: the goal is on top.
        gaps: Between boxes, (2, 2) each: on the line, where it begins and ends [m].
    """

    boxes: tuple[str, ...]
    entry: Edge
    exit: Edge | None
    gaps: tuple[np.ndarray, ...] = ()

    __repr__ = short_repr

    @property
    def edges(self) -> tuple[Edge, ...]:
        """The edge that is climbed up, and that which is climbed down, if any."""
        return (self.entry,) if self.exit is None else (self.entry, self.exit)

    def is_passed(self, xy: np.ndarray) -> bool:
        """Whether a point (2,) is behind its far edge."""
        edge = self.exit
        return edge is not None and edge.distance(xy) < 0 < self.entry.distance(xy)


@dataclass(frozen=True, eq=False, slots=True)
class Frame:
    """Planar pose of the body over its contacts: x, y [m] and yaw [rad]."""

    xy: np.ndarray
    yaw: float

    __repr__ = short_repr

    @classmethod
    def behind(cls, edge: Edge, distance: float = 0.0) -> Frame:
        """Facing inwards, so far behind an edge [m]; negative: before it."""
        return cls(edge.point[:2] + distance * edge.inward, edge.yaw)

    def at(self, offset: np.ndarray) -> np.ndarray:
        """(2,) in the world of a point of the frame."""
        return self.xy + turn_about_z(self.yaw) @ offset

    def local(self, p: np.ndarray) -> np.ndarray:
        """(2,) in the frame of a point of the world."""
        return turn_about_z(self.yaw).T @ (p[:2] - self.xy)

    def away(self, other: Frame) -> float:
        """Distance [m]."""
        return float(np.linalg.norm(self.xy - other.xy))

    def turn_to(self, other: Frame) -> float:
        """Angle to how the other one faces, the short way [rad]."""
        return math.remainder(other.yaw - self.yaw, 2.0 * math.pi)

    def is_at(self, other: Frame) -> bool:
        """Near enough to have arrived."""
        return self.away(other) <= ARRIVED and abs(self.turn_to(other)) <= FACING

    def part_way(self, other: Frame, share: float) -> Frame:
        """A part of the way to another one."""
        xy = self.xy + share * (other.xy - self.xy)
        return Frame(xy, self.yaw + share * (other.yaw - self.yaw))

    def towards(self, other: Frame, step: float, turn: float) -> Frame:
        """After one cycle: the way comes first, the turn as late as it can be."""
        way, angle = other.xy - self.xy, self.turn_to(other)
        away = float(np.linalg.norm(way)) / step
        turns = abs(angle) / turn
        cycles = max(away, turns, 1.0)
        share = angle / cycles if away <= turns + 1.0 or turns == 0 else 0.0
        return Frame(self.xy + way / cycles, self.yaw + share)


def goal_of(scene: Scene) -> np.ndarray:
    """(2,) where the pelvis shall get to: on top of the first box where none is named.

    Raises:
        InputError: There is no goal and no box, or the goal is off the ground.
    """
    if scene.goal is not None:
        goal = scene.goal[:2]
        if np.abs(goal).max() > GROUND_HALF_SIZE:
            raise InputError(
                f"a goal on the ground, which reaches {GROUND_HALF_SIZE:g} m from the"
                " origin",
                field="scene.goal",
                value=[float(x) for x in goal],
            )
        return goal
    if not scene.tops:
        raise InputError("a goal, or a box to get on top of", field="scene.goal")
    return scene.tops[0].position[:2]


def find_platforms(scene: Scene, goal: np.ndarray) -> tuple[Platform, ...]:
    """The platforms between the scene's start and `goal` (2,), in order."""
    start = scene.start[:2]
    length = float(np.linalg.norm(goal - start))
    crossed = [(crossing(top, start, goal), top) for top in scene.tops]
    met = sorted(((*c, top) for c, top in crossed if c), key=lambda m: m[0])
    groups: list[list[tuple[float, float, Support]]] = []
    end = -math.inf
    for t0, t1, top in met:
        if (t0 - end) * length > GAP + 1e-9 or not groups:
            groups.append([])
            end = -math.inf
        groups[-1].append((t0, t1, top))
        end = max(end, t1)
    out = []
    for group in groups:
        gaps, end = [], group[0][1]
        for t0, t1, _ in group[1:]:
            if (t0 - end) * length > JOINT:
                gaps.append(start + np.outer((end, t0), goal - start))
            end = max(end, t1)
        _, end, last = max(group, key=lambda m: m[1])
        out.append(
            Platform(
                boxes=tuple(top.name for _, _, top in group),
                entry=_gate(group[0][2], start, goal, group[0][0]),
                exit=_gate(last, goal, start, 1.0 - end) if end < 1.0 else None,
                gaps=tuple(gaps),
            )
        )
    return tuple(out)


def _sides(top: Support) -> tuple[np.ndarray, np.ndarray]:
    """Half-planes `A p <= b` of a top seen from above, side i from corner i on."""
    corners = top.vertices[:, :2]
    along = np.roll(corners, -1, axis=0) - corners
    A = np.stack([along[:, 1], -along[:, 0]], axis=1)
    A /= np.linalg.norm(A, axis=1, keepdims=True)
    return A, np.sum(A * corners, axis=1)


def crossing(
    top: Support, start: np.ndarray, goal: np.ndarray
) -> tuple[float, float] | None:
    """Shares of the way at which it enters and leaves a top; None: it misses it."""
    A, b = _sides(top)
    rate, room = A @ (goal - start), b - A @ start
    t0, t1 = 0.0, math.inf
    for r, x in zip(rate, room, strict=True):
        if abs(r) < 1e-12:
            if x < 0:
                return None
        elif r > 0:
            t1 = min(t1, x / r)
        else:
            t0 = max(t0, x / r)
    return (float(t0), float(t1)) if t0 < min(t1, 1.0) else None


def _gate(top: Support, start: np.ndarray, goal: np.ndarray, share: float) -> Edge:
    """Edge where the line from start to goal enters a top, away from its corners."""
    corners, (A, b) = top.vertices[:, :2], _sides(top)
    p = start + share * (goal - start)
    facing = A @ (goal - start) < 0
    i = int(np.argmin(np.where(facing, np.abs(A @ p - b), np.inf)))
    first, second = corners[i], corners[(i + 1) % len(corners)]
    length = float(np.linalg.norm(second - first))
    along = (second - first) / length
    beside = min(BESIDE, length / 2)
    s = float(np.clip((p - first) @ along, beside, length - beside))
    p = first + s * along
    return Edge(point=np.array([*p, top.level(p)]), inward=-A[i])


def contact_at(surface: str, top: Support, point: np.ndarray, yaw: float) -> Contact:
    """A surface on a support, over or under a point (3,), turned about the vertical."""
    R = np.eye(3)
    R[:2, :2] = turn_about_z(yaw)
    return Contact(
        surface=surface,
        support=top.name,
        position=top.project(point),
        quaternion=quat_from_matrix(R),
    )


def find_place(
    scene: Scene, boxes: tuple[str, ...], wanted: np.ndarray, beside: float
) -> tuple[str, np.ndarray] | None:
    """The place nearest to `wanted` (2,) on the tops of some boxes; None: nowhere.

    Args:
        scene: With all of its boxes.
        boxes: On whose tops.
        wanted: x, y in the world [m].
        beside: Distance from whatever is higher than the top [m].

    Returns:
        The box, and where (3,) on its top.
    """
    steps = np.arange(-SPAN, SPAN + GRID / 2, GRID)
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    order = np.argsort(np.linalg.norm(grid, axis=1), kind="stable")
    points = wanted + grid[order]
    tops = scene.tops
    gap = np.array([(points @ A.T - b).max(axis=1) for A, b in map(_sides, tops)])
    height = np.array([top.level(points) for top in tops])
    best = None
    for i, top in enumerate(tops):
        if top.name not in boxes:
            continue
        good = gap[i] <= -BORDER
        for k in range(len(tops)):
            if k != i:
                good &= (gap[k] > beside) | (height[k] <= height[i] + 1e-6)
        found = np.flatnonzero(good)
        if len(found) and (best is None or found[0] < best[0]):
            best = (int(found[0]), top.name, float(height[i][found[0]]))
    if best is None:
        return None
    k, name, z = best
    return name, np.array([*points[k], z])


def room_on(scene: Scene, boxes: tuple[str, ...], xy: np.ndarray) -> float:
    """From a point (2,) on some boxes to the nearest other one; inf: there is none."""
    room = math.inf
    for top in (s for s in scene.tops if s.name not in boxes):
        corners, (A, b) = top.vertices[:, :2], _sides(top)
        if (A @ xy - b).max() <= 0.0:
            return 0.0
        for p, q in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            share = np.clip((xy - p) @ (q - p) / ((q - p) @ (q - p)), 0.0, 1.0)
            room = min(room, float(np.linalg.norm(p + share * (q - p) - xy)))
    return room
