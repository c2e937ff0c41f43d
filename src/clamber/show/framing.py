"""Cameras that have all in view that has to be seen.

Shapes: n, m points; nq coordinates.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from clamber.model.kinematics import Kinematics
from clamber.model.scene import Scene
from clamber.model.world import World
from clamber.planning.trajectory import Samples
from clamber.show.sample import thinned

Preset = Literal["corner", "side", "front", "behind", "top"]
PRESETS: Mapping[Preset, tuple[float, float]] = {  # [deg] azimuth and elevation, of a
    # robot that faces along x. From the left and a little behind, the box hides neither
    # the feet on the ground nor the hands on its top.
    "corner": (288.0, -17.0),
    "side": (270.0, -8.0),
    "front": (180.0, -14.0),
    "behind": (0.0, -20.0),
    "top": (270.0, -89.0),
}
MARGIN = 0.08  # share of the picture left free around what must be seen
SEEN_POSTURES = 60  # of a motion, of which all is in the picture
NEAR = 0.35  # [height of the motion] around it boxes are in the picture


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """A camera: what it looks at [m], from how far [m] and from where [deg]."""

    lookat: np.ndarray
    distance: float
    azimuth: float
    elevation: float
    fovy: float

    @property
    def axes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Unit vectors to the right, up and forward, in the world."""
        return _camera_axes(self.azimuth, self.elevation)

    def project(self, points: np.ndarray, size: tuple[int, int]) -> np.ndarray:
        """(..., 2) pixels from the top left of points (..., 3) in the world."""
        right, up, forward = self.axes
        p = points - (self.lookat - self.distance * forward)
        scale = size[1] / 2 / math.tan(math.radians(self.fovy) / 2) / (p @ forward)
        x, y = size[0] / 2 + (p @ right) * scale, size[1] / 2 - (p @ up) * scale
        return np.stack([x, y], axis=-1)


def _camera_axes(
    azimuth: float, elevation: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    a, e = math.radians(azimuth), math.radians(elevation)
    forward = np.array(
        [math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)]
    )
    right = np.array([math.sin(a), -math.cos(a), 0.0])
    return right, np.cross(right, forward), forward


def frame_view(
    points: np.ndarray,
    aspect: float,
    *,
    yaw: float = 0.0,
    fovy: float = 45.0,
    camera: Preset = "corner",
) -> View:
    """The nearest view that has all of the points (N, 3) in the picture.

    With camera axes r (right), u (up), f (forward) and the picture's half widths t_r,
    t_u at unit depth, a point p is seen from P where |(p - P) r| <= t_r (p - P) f, and
    likewise for u: linear in P, and solved for the P farthest forward.

    Args:
        points: [m] in the world.
        aspect: Width over height of the picture.
        yaw: Way the robot faces at its start [rad].
        fovy: Vertical field of view [deg].
        camera: From where.
    """
    azimuth, elevation = PRESETS[camera]
    azimuth += math.degrees(yaw)
    right, up, forward = _camera_axes(azimuth, elevation)
    depth = points @ forward
    half = math.tan(math.radians(fovy) / 2) * (1 - MARGIN)
    ends, nearest = [], math.inf
    for axis, t in ((right, half * aspect), (up, half)):
        x = points @ axis
        low, high = float(np.max(x - t * depth)), float(np.min(x + t * depth))
        ends.append((low + high) / 2)
        nearest = min(nearest, (high - low) / (2 * t))
    distance = float(depth.mean()) - nearest
    position = ends[0] * right + ends[1] * up + nearest * forward
    return View(
        lookat=position + distance * forward,
        distance=distance,
        azimuth=azimuth,
        elevation=elevation,
        fovy=fovy,
    )


def robot_corners(kin: Kinematics) -> np.ndarray:
    """(8 G, 3) corners of the boxes around the robot's geoms, in the world [m]."""
    m, d = kin.world.model, kin.data
    own = np.flatnonzero(m.body_rootid[m.geom_bodyid] == m.body_rootid[kin.world.base])
    signs = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(8, 3)
    local = m.geom_aabb[own, None, :3] + signs * m.geom_aabb[own, None, 3:]
    R = d.geom_xmat[own].reshape(-1, 3, 3)
    return (np.einsum("gij,gkj->gki", R, local) + d.geom_xpos[own, None]).reshape(-1, 3)


def view_of(
    world: World,
    seen: np.ndarray,
    aspect: float,
    camera: Preset = "corner",
    beside: np.ndarray | None = None,
) -> View:
    """A view of what has to be seen of a world.

    Args:
        world: Robot and scene.
        seen: (n, 3) as `seen_points` has them [m].
        aspect: Width over height of the picture.
        camera: From where.
        beside: (m, 3) what has to be seen too [m].
    """
    points = seen if beside is None else np.concatenate([seen, beside])
    fovy = float(world.model.vis.global_.fovy)
    yaw = float(world.scene.start[2])
    return frame_view(points, aspect, yaw=yaw, fovy=fovy, camera=camera)


def flat_axes(world: World, camera: Preset) -> tuple[np.ndarray, np.ndarray]:
    """Level unit vectors to the right in a picture, and away from the camera."""
    azimuth, elevation = PRESETS[camera]
    yaw = math.degrees(float(world.scene.start[2]))
    right = _camera_axes(azimuth + yaw, elevation)[0]
    return right, np.cross([0.0, 0.0, 1.0], right)


def obstacle_points(scene: Scene, points: np.ndarray, near: float = NEAR) -> np.ndarray:
    """(n, 3) corners of the boxes [m], of each as much as is near points (m, 3).

    A box may be as large as a street, or far from where the robot goes: what is farther
    than `near` times the height of all the points from them is left out.
    """
    room = near * float(np.ptp(points[:, 2])) * np.array([1.0, 1.0, 0.0])
    low, high = points.min(axis=0) - room, points.max(axis=0) + room
    found = [np.zeros((0, 3))]
    boxes = (box_corners(b.size, b.centre, b.rotation) for b in scene.boxes)
    for corners in (*boxes, *(p.copy() for m in scene.meshes for p in m.pieces)):
        if np.all(corners.max(axis=0)[:2] >= low[:2]) and np.all(
            corners.min(axis=0)[:2] <= high[:2]
        ):
            corners[:, :2] = np.clip(corners[:, :2], low[:2], high[:2])
            corners[:, 2] = np.maximum(corners[:, 2], min(low[2], 0.0))
            found.append(corners)
    return np.concatenate(found)


def box_corners(
    size: np.ndarray, centre: np.ndarray, rotation: np.ndarray
) -> np.ndarray:
    """(8, 3) of a box [m]."""
    signs = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
    return centre + (signs * size) @ rotation.T


def seen_points(
    kin: Kinematics, q: np.ndarray | Samples, near: float = NEAR
) -> np.ndarray:
    """(m, 3) points that a camera has to have in view [m].

    They are the corners of boxes around some of the postures (n, nq), and the obstacles
    around them.
    """
    corners = []
    for posture in thinned(q, SEEN_POSTURES):
        kin.update(posture)
        points = robot_corners(kin)
        low, high = points.min(axis=0), points.max(axis=0)
        corners.append(box_corners(high - low, (low + high) / 2, np.eye(3)))
    seen = np.concatenate(corners)
    return np.concatenate([seen, obstacle_points(kin.world.scene, seen, near)]).round(3)
