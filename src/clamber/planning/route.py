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

from clamber.contact.policy import Edge
from clamber.errors import InputError
from clamber.model.scene import GROUND_HALF_SIZE, Scene, Support

GAP = 0.40  # [m] a narrower gap is crossed on top, a wider one on the ground
JOINT = 0.02  # [m] a narrower gap is none
BESIDE = (
    0.25  # [m] a gate keeps so far from the ends of its edge, where it is that long
)
BORDER = 0.02  # [m] contacts stay so far inside a top's border
GRID = 0.02  # [m] of the search for a place
SPAN = 0.24  # [m] a place is looked for this far around where it is wanted


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

    @property
    def edges(self) -> tuple[Edge, ...]:
        """The edge that is climbed up, and that which is climbed down, if any."""
        return (self.entry,) if self.exit is None else (self.entry, self.exit)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Place:
    """A point (3,) on a support where a contact can be made."""

    support: str
    position: np.ndarray


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
    if not scene.boxes:
        raise InputError("a goal, or a box to get on top of", field="scene.goal")
    return scene.boxes[0].top.position[:2]


def find_platforms(scene: Scene, goal: np.ndarray) -> tuple[Platform, ...]:
    """The platforms between the scene's start and `goal` (2,), in order."""
    start = scene.start[:2]
    met = []
    for box in scene.boxes:
        crossed = crossing(box.top, start, goal)
        if crossed is not None:
            met.append((*crossed, box.top))
    met.sort(key=lambda m: m[0])
    length = float(np.linalg.norm(goal - start))
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
        last = max(group, key=lambda m: m[1])
        up = _edge(group[0][2], start, goal, group[0][0])
        down = None
        if last[1] < 1.0:
            down = _edge(last[2], goal, start, 1.0 - last[1])
        boxes = tuple(top.name for _, _, top in group)
        shares, end = [], group[0][1]
        for t0, t1, _ in group[1:]:
            if (t0 - end) * length > JOINT:
                shares.append((end, t0))
            end = max(end, t1)
        gaps = tuple(start + np.outer(x, goal - start) for x in shares)
        out.append(Platform(boxes=boxes, entry=up, exit=down, gaps=gaps))
    return tuple(out)


def _corners(top: Support) -> np.ndarray:
    """(K, 2) of a support in the world, counter-clockwise."""
    return (top.position + top.polygon @ top.rotation[:, :2].T)[:, :2]


def _sides(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Half-planes `A p <= b` of a polygon (K, 2), side i from corner i to the next."""
    along = np.roll(corners, -1, axis=0) - corners
    A = np.stack([along[:, 1], -along[:, 0]], axis=1)
    A /= np.linalg.norm(A, axis=1, keepdims=True)
    return A, np.sum(A * corners, axis=1)


def crossing(
    top: Support, start: np.ndarray, goal: np.ndarray
) -> tuple[float, float] | None:
    """Shares of the way at which it enters and leaves a top; None: it misses it."""
    A, b = _sides(_corners(top))
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


def _edge(top: Support, start: np.ndarray, goal: np.ndarray, share: float) -> Edge:
    """The side through which the line from start to goal enters at that share."""
    corners = _corners(top)
    A, b = _sides(corners)
    p = start + share * (goal - start)
    facing = A @ (goal - start) < 0
    i = int(np.argmin(np.where(facing, np.abs(A @ p - b), np.inf)))
    first, second = corners[i], corners[(i + 1) % len(corners)]
    length = float(np.linalg.norm(second - first))
    along = (second - first) / length
    beside = min(BESIDE, length / 2)
    s = float(np.clip((p - first) @ along, beside, length - beside))
    return Edge(point=first + s * along, inward=-A[i])


def find_place(
    scene: Scene, boxes: tuple[str, ...], wanted: np.ndarray, beside: float
) -> Place | None:
    """The place nearest to `wanted` (2,) on the tops of some boxes; None: nowhere.

    Args:
        scene: With all of its boxes.
        boxes: On whose tops.
        wanted: x, y in the world [m].
        beside: Distance from whatever is higher than the top [m].
    """
    steps = np.arange(-SPAN, SPAN + GRID / 2, GRID)
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    order = np.argsort(np.linalg.norm(grid, axis=1), kind="stable")
    points = wanted + grid[order]
    supports = {s.name: s for s in scene.supports}
    names = [b.name for b in scene.boxes]
    sides = [_sides(_corners(supports[n])) for n in names]
    gap = np.array([(points @ A.T - b).max(axis=1) for A, b in sides])
    height = np.array([_height(supports[n], points) for n in names])
    best = None
    for i, name in enumerate(names):
        if name not in boxes:
            continue
        good = gap[i] <= -BORDER
        for k in range(len(names)):
            if k != i:
                good &= (gap[k] > beside) | (height[k] <= height[i] + 1e-6)
        found = np.flatnonzero(good)
        if len(found) and (best is None or found[0] < best[0]):
            best = (int(found[0]), name, float(height[i][found[0]]))
    if best is None:
        return None
    k, name, z = best
    return Place(support=name, position=np.array([*points[k], z]))


def room_on(scene: Scene, boxes: tuple[str, ...], xy: np.ndarray) -> float:
    """From a point (2,) on some boxes to the nearest other one; inf: there is none."""
    room = math.inf
    for box in scene.boxes:
        if box.name not in boxes:
            corners = _corners(box.top)
            A, b = _sides(corners)
            if (A @ xy - b).max() <= 0.0:
                return 0.0
            for p, q in zip(corners, np.roll(corners, -1, axis=0), strict=True):
                share = np.clip((xy - p) @ (q - p) / ((q - p) @ (q - p)), 0.0, 1.0)
                room = min(room, float(np.linalg.norm(p + share * (q - p) - xy)))
    return room


def _height(top: Support, points: np.ndarray) -> np.ndarray:
    """(n,) of a support's plane over points (n, 2) [m]."""
    n = top.normal
    off = points - top.position[:2]
    return top.position[2] - off @ n[:2] / n[2]
