"""Pictures, plots and a video of a run: to look at, never to compute with.

Pictures come from MuJoCo's own renderer without a screen: EGL where there is one, else
OSMesa. What is drawn depends on the records alone; the same run gives the same picture.

Shapes: T samples, M recorded states, nS surfaces.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import importlib.util
import itertools
import math
import os
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import mujoco
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont

from clamber.contact.contact import Contact, ContactSequence
from clamber.errors import ClamberError, InputError, MissingDependency
from clamber.execution.simulation import Rollout
from clamber.model.kinematics import Kinematics
from clamber.model.robot import Robot
from clamber.model.scene import GROUND, Scene, Support
from clamber.model.world import World, build_world
from clamber.planning.records import Plan
from clamber.planning.trajectory import Samples
from clamber.recording.demonstration import Demonstration
from clamber.run.folder import (
    ROLLOUT,
    TIMINGS,
    TRAJECTORY,
    load_plan,
    load_rollout,
    trajectory_of,
    whole_file,
)
from clamber.step.posture import STABILITY_WEIGHT, Keyframe
from clamber.step.statics import (
    com_margin,
    projected_distance,
    support_polygon,
    theta_max,
)

Preset = Literal["corner", "side", "front", "behind", "top"]
FROM_ABOVE = -70.0  # [deg] elevation from which the camera's light whitens the ground
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
EDGE_SHOWN = 0.30  # [m] of the near edge, to either side
GROUND_SHOWN = 5.5  # [m] half width of the ground in pictures
LOADED = 0.01  # [weights] a surface that bears more is loaded
TOUCHING = 0.005  # [m] a bearing point nearer to its support than this bears
SAMPLES = 400  # of a plot over time
FPS = 25
VIDEO_SIZE, WEBP_SIZE = (640, 480), (480, 360)
FRAME_SIZE = (1920, 1080)
TILE = (400, 330)  # of the sheet of keyframes
VIDEO_SECONDS = 15.0  # at most, for runs that a power of two brings below
SPEEDUP_AFTER = 12.0  # [s] shorter runs are shown in real time

FORCE_LENGTH = 0.35  # [m] of the arrow of the robot's weight
PHASE_COLOURS = {
    "supporting": (22, 163, 74),
    "reach-to-supportable": (234, 179, 8),
    "sliding": (220, 38, 38),
}
CYCLE_COLOURS = ("#fde68a", "#bfdbfe", "#bbf7d0", "#fecaca", "#e9d5ff")  # in order
DARK, PALE, LINE = (35, 40, 48), (248, 249, 250), (205, 209, 214)
SURFACE_COLOURS = ("#c2410c", "#1d4ed8")  # of a limb's surfaces, the outer one first
Report = Callable[[str, float, str], None]


# Drawing without a screen.

_PROBE = (
    "import mujoco; c = mujoco.GLContext(8, 8); c.make_current(); "
    "mujoco.MjrContext(mujoco.MjModel.from_xml_string('<mujoco/>'), 100)"
)


@functools.cache
def gl_backend() -> str | None:
    """`egl` or `osmesa`, whichever draws here; that of MUJOCO_GL alone where it is set.

    Tried out in a process of its own: a library that fails to load, or crashes, would
    spoil the next attempt in this one.
    """
    wanted = os.environ.get("MUJOCO_GL", "").lower().strip()
    candidates = (wanted,) if wanted else ("egl", "osmesa")
    if sys.platform != "linux":
        candidates = ("",)
    for name in candidates:
        environment = {k: v for k, v in os.environ.items() if k != "PYOPENGL_PLATFORM"}
        trial = subprocess.run(
            [sys.executable, "-c", _PROBE],
            env=environment | {"MUJOCO_GL": name},
            capture_output=True,
            check=False,
        )
        if trial.returncode == 0:
            return name
    return None


def _gl_context(width: int, height: int) -> Any:
    """An OpenGL context of the backend that works.

    Raises:
        ClamberError: There is none.
    """
    backend = gl_backend()
    if backend is None:
        raise ClamberError(
            "pictures need OpenGL without a screen and there is none: "
            "`apt-get install libegl1 libgl1-mesa-dri` (or libosmesa6) brings it; "
            "plots, plan and physics do without"
        )
    if backend == "egl":
        from mujoco.egl import GLContext
    elif backend == "osmesa":
        from mujoco.osmesa import GLContext
    else:
        from mujoco import GLContext
    return GLContext(width, height)


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


class Camera:
    """Draws configurations of a world; closed as a context manager."""

    def __init__(
        self,
        world: World,
        size: tuple[int, int],
        *,
        smooth: bool = True,
        cutout: bool = False,
    ) -> None:
        """Open a context.

        Args:
            world: What to draw.
            size: Width and height in pixels.
            smooth: Edges are smoothed; costs three times the time in software.
            cutout: For `cutout`, which smooths edges by itself; `shot` then lacks the
                ground.
        """
        self._gl: Any = None
        self._context: Any = None
        width, height = size if not cutout else (2 * size[0], 2 * size[1])
        model = copy.copy(world.model)  # looks are set here, the world's stay
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        model.vis.quality.offsamples = 4 if smooth and not cutout else 0
        model.vis.quality.shadowsize = 2048 if height < 700 else 8192  # no steps seen
        if not smooth:
            model.vis.quality.numslices, model.vis.quality.numstacks = 16, 8
        # A ground without end is shaded with speckles where the shadow map ends.
        model.vis.map.shadowclip = 4.0
        model.geom_size[world.support_geom[GROUND], :2] = GROUND_SHOWN
        if cutout:
            model.geom_matid[world.support_geom[GROUND]] = -1
            model.geom_rgba[world.support_geom[GROUND], 3] = 0.0
        self._model, self._data = model, mujoco.MjData(model)
        self._gl = _gl_context(width, height)
        self._gl.make_current()
        self._context = mujoco.MjrContext(
            model, mujoco.mjtFontScale.mjFONTSCALE_100.value
        )
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        self._scene = mujoco.MjvScene(model, maxgeom=model.ngeom + 200)
        self._option, self._camera = mujoco.MjvOption(), mujoco.MjvCamera()
        self._rect = mujoco.MjrRect(0, 0, width, height)
        self._pixels = np.zeros((height, width, 3), dtype=np.uint8)

    def __enter__(self) -> Camera:
        """Itself."""
        return self

    def __exit__(self, *error: object) -> None:
        """Free the context."""
        if self._context is not None:
            self._context.free()
        if self._gl is not None:
            self._gl.free()

    def shot(self, q: np.ndarray, view: View) -> Image.Image:
        """A picture of the configuration `q` (nq,)."""
        self._update(q, view)
        return Image.fromarray(self._drawn())

    def cutout(self, q: np.ndarray, view: View) -> Image.Image:
        """Robot and obstacles alone (RGBA), on nothing.

        Drawn twice as large without smoothing, so that no pixel mixes with what lies
        behind it, and averaged with its mask: edges keep their own colour.
        """
        self._update(q, view)
        colour = self._drawn().astype(float)
        flags = (
            mujoco.mjtRndFlag.mjRND_SEGMENT.value,
            mujoco.mjtRndFlag.mjRND_IDCOLOR.value,
        )
        self._scene.flags[list(flags)] = 1
        there = np.any(self._drawn() > 0, axis=2)[..., None].astype(float)
        self._scene.flags[list(flags)] = 0
        height, width = there.shape[0] // 2, there.shape[1] // 2

        def halved(x: np.ndarray) -> np.ndarray:
            return x.reshape(height, 2, width, 2, -1).mean(axis=(1, 3))

        share = halved(there)
        colour = halved(colour * there) / np.maximum(share, 1e-9)
        pixels = np.concatenate([colour, 255 * share], axis=2)
        return Image.fromarray(pixels.round().astype(np.uint8), "RGBA")

    def _update(self, q: np.ndarray, view: View) -> None:
        self._data.qpos[:] = q
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        self._camera.lookat[:] = view.lookat
        self._camera.distance = view.distance
        self._camera.azimuth, self._camera.elevation = view.azimuth, view.elevation
        mujoco.mjv_updateScene(
            self._model,
            self._data,
            self._option,
            None,
            self._camera,
            mujoco.mjtCatBit.mjCAT_ALL.value,
            self._scene,
        )
        if view.elevation < FROM_ABOVE:  # the sun alone lights the ground enough
            for light in self._scene.lights[: self._scene.nlight]:
                if light.headlight:
                    light.diffuse = light.specular = np.zeros(3)

    def _drawn(self) -> np.ndarray:
        """(height, width, 3) uint8 of the scene as it was last updated."""
        mujoco.mjr_render(self._rect, self._scene, self._context)
        mujoco.mjr_readPixels(self._pixels, None, self._rect, self._context)
        return self._pixels[::-1].copy()


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
    postures: Iterable[np.ndarray],
    aspect: float,
    camera: Preset = "corner",
) -> View:
    """A view with the robot in all postures, and the near edge of the first box."""
    kin = Kinematics(world)
    points = []
    for q in postures:
        kin.update(q)
        points.append(robot_corners(kin))
    points += [near_edge_points(world.scene)]
    fovy = float(world.model.vis.global_.fovy)
    seen = np.concatenate(points)
    yaw = float(world.scene.start[2])
    return frame_view(seen, aspect, yaw=yaw, fovy=fovy, camera=camera)


def near_edge_points(scene: Scene) -> np.ndarray:
    """(n, 3) where the first box's top begins, seen from the start, and below it."""
    if not scene.boxes:
        return np.zeros((0, 3))
    top = scene.boxes[0].top
    start = np.array([*scene.start[:2], 0.0])
    A, b = top.edges()
    facing = int(np.argmax(A @ start - b))
    corners = top.position + top.polygon @ top.rotation[:, :2].T
    c, d = corners[facing], corners[(facing + 1) % len(corners)]
    way = (d - c) / np.linalg.norm(d - c)
    foot = float(np.clip((start - c) @ way, 0.0, np.linalg.norm(d - c)))
    span = np.clip([foot - EDGE_SHOWN, foot + EDGE_SHOWN], 0, np.linalg.norm(d - c))
    edge = c + span[:, None] * way
    return np.concatenate([edge, edge * [1.0, 1.0, 0.0]])


def draw_scene(
    robot: Robot, scene: Scene, path: str | Path, *, tile: tuple[int, int] = (760, 560)
) -> Path:
    """Draw a scene with the robot at its start, its supports named, the goal marked."""
    world = build_world(robot, scene)
    kin = Kinematics(world)
    kin.update(world.home)
    tops = [s for s in scene.supports if s.name != GROUND]
    seen = [robot_corners(kin)]
    seen += [s.position + s.polygon @ s.rotation[:, :2].T for s in tops]
    yaw, fovy = float(scene.start[2]), float(world.model.vis.global_.fovy)
    view = frame_view(np.concatenate(seen), tile[0] / tile[1], yaw=yaw, fovy=fovy)
    with Camera(world, tile) as camera:
        picture = camera.shot(world.home, view)
    draw = ImageDraw.Draw(picture)
    for s in tops:
        at, tip = view.project(
            np.stack([s.position, s.position + 0.15 * s.normal]), tile
        )
        _arrow(draw, at, tip, DARK)
        draw.text((at[0] + 8, at[1] + 4), s.name, font=_font(15), fill=DARK)
    if scene.goal is not None:
        at = tuple(view.project(np.array([*scene.goal[:2], 0.0]), tile))
        _dot(draw, at, 6, PHASE_COLOURS["supporting"])
        draw.text((at[0] + 8, at[1] - 8), "goal", font=_font(15), fill=DARK)
    caption = f"{len(tops)} boxes, {robot.name} at the start"
    return _save_sheet([(picture, [caption])], path, columns=1)


# Sheets of pictures.


def draw_robot(
    robot: Robot, path: str | Path, *, tile: tuple[int, int] = (560, 640)
) -> Path:
    """Draw the robot as it stands, from behind and from ahead, its surfaces named.

    A dot marks where each surface touches, a ring the mass that its limb supports.
    """
    world = build_world(robot, Scene(start=np.zeros(3)))
    kin = Kinematics(world)
    kin.update(world.home)
    corners, up = robot_corners(kin), np.array([0.0, 0.0, 1.0])
    fovy = float(world.model.vis.global_.fovy)
    tiles = []
    with Camera(world, tile) as camera:
        for caption, turn in (("from behind", 0.0), ("from ahead", 2.4)):
            view = frame_view(corners, tile[0] / tile[1], yaw=turn, fovy=fovy)
            picture = camera.shot(world.home, view)
            draw = ImageDraw.Draw(picture)
            for limb in world.robot.limbs.values():
                x, y = view.project(kin.landmark(limb.root)[1], tile)
                draw.ellipse((x - 6, y - 6, x + 6, y + 6), outline=DARK, width=2)
                for surface, colour in zip(
                    limb.surfaces, ((194, 65, 12), (29, 78, 216)), strict=False
                ):
                    at = tuple(view.project(kin.contact_point(surface, up), tile))
                    _dot(draw, at, 5, colour)
                    draw.text(
                        (at[0] + 8, at[1] - 8), surface, font=_font(15), fill=DARK
                    )
            tiles.append((picture, [f"{world.robot.name}, {caption}"]))
    return _save_sheet(tiles, path, columns=2)


def keyframe_sheet(
    plan: Plan,
    path: str | Path,
    *,
    tile: tuple[int, int] = TILE,
    camera: Preset = "corner",
) -> Path:
    """Draw each keyframe with its contacts, forces and margins.

    A dot marks each contact, seen through the robot: green while it supports, yellow
    within reach of that, red where geometry alone would have it slide. Arrows are the
    contact forces; a line falls from the centre of mass.
    """
    world = plan.world
    view = view_of(world, [k.q for k in plan.keyframes], tile[0] / tile[1], camera)
    tiles = []
    with Camera(world, tile) as drawing:
        for i, key in enumerate(plan.keyframes):
            picture = drawing.shot(key.q, view)
            mark_keyframe(picture, view, world, key)
            before = plan.keyframes[i - 1] if i else None
            tiles.append((picture, keyframe_caption(i, key, before)))
    return _save_sheet(tiles, path, columns=min(4, len(tiles)))


def mark_keyframe(
    picture: Image.Image, view: View, world: World, key: Keyframe
) -> None:
    """Draw contacts, forces and the centre of mass over a picture."""
    draw = ImageDraw.Draw(picture)
    size, weight = picture.size, world.mass * 9.81
    floor = max(
        (s.position[2] for s in world.supports.values() if s.inside(key.com)),
        default=0.0,
    )
    foot = np.array([*key.com[:2], floor])
    a, b = (tuple(x) for x in view.project(np.array([key.com, foot]), size))
    draw.line((a, b), fill=DARK, width=1)
    _dot(draw, a, 5, DARK)
    draw.line((b[0] - 5, b[1], b[0] + 5, b[1]), fill=DARK, width=2)
    for state, force in zip(key.contacts, _force_by_contact(world, key), strict=True):
        colour = PHASE_COLOURS[state.phase]
        at = state.contact.position
        ends = np.array([at, at + FORCE_LENGTH / weight * force])
        tail, tip = view.project(ends, size)
        if np.linalg.norm(tip - tail) > 8:
            _arrow(draw, tail, tip, colour)
        _dot(draw, tuple(tail), 5, colour)


def _dot(
    draw: ImageDraw.ImageDraw, at: tuple, radius: int, colour: tuple[int, int, int]
) -> None:
    draw.circle(at, radius, fill=colour, outline=(255, 255, 255), width=1)


def _arrow(
    draw: ImageDraw.ImageDraw, tail: np.ndarray, tip: np.ndarray, colour: tuple
) -> None:
    way = (tip - tail) / np.linalg.norm(tip - tail)
    side = np.array([-way[1], way[0]])
    neck = tip - 9 * way
    for width, fill in ((5, (255, 255, 255)), (3, colour)):
        draw.line((*tail, *neck), fill=fill, width=width)
    head = [tuple(tip), tuple(neck + 5 * side), tuple(neck - 5 * side)]
    draw.polygon(head, fill=colour, outline=(255, 255, 255))


def _force_by_contact(world: World, key: Keyframe) -> list[np.ndarray]:
    """(3,) [N] of each contact, over all its bearing points; zeros where unknown."""
    kin = Kinematics(world)
    kin.update(key.q)
    counts = []
    for c in key.stance:
        normal = world.supports[c.support].normal
        counts.append(len(kin.bearing_points(c.surface, normal, c.edge)))
    if sum(counts) != len(key.equilibrium.forces):
        return [np.zeros(3)] * len(counts)
    ends = np.cumsum([0, *counts])
    return [key.equilibrium.forces[a:b].sum(axis=0) for a, b in pairwise(ends)]


def describe_move(before: Sequence[Contact], after: Sequence[Contact]) -> str:
    """What changed between two stances, such as `LElbow on box for LHand`."""
    was = {c.surface: c for c in before}
    now = {c.surface: c for c in after}
    made = [
        s
        for s, c in now.items()
        if s not in was or np.linalg.norm(c.position - was[s].position) > 0.01
    ]
    broken = [s for s in was if s not in now]
    if made:
        text = ", ".join(f"{s} on {now[s].support}" for s in made)
        return f"{text} for {', '.join(broken)}" if broken else text
    return f"{', '.join(broken)} in the air" if broken else "no change"


def keyframe_caption(i: int, key: Keyframe, before: Keyframe | None) -> list[str]:
    """Three lines: the move, geometry and balance, forces."""
    if before is None:
        title = "start, on " + ", ".join(c.surface for c in key.stance)
        new = {c.surface for c in key.stance}
    else:
        title = describe_move(before.stance, key.stance)
        old = {c.surface: c.position for c in before.stance}
        new = {
            c.surface
            for c in key.stance
            if c.surface not in old
            or np.linalg.norm(c.position - old[c.surface]) > 0.01
        }
    d = ", ".join(
        f"d {c.contact.surface} {1000 * c.projected_distance:.0f} mm"
        for c in key.contacts
        if c.contact.surface in new
    )
    e = key.equilibrium
    push = f"holds a push of {e.margin:.2f} weights" if e.feasible else "cannot hold"
    limit = f", limit {e.limiting}" if e.limiting else ""
    return [
        f"{i}  {title}",
        f"{d + '; ' if d else ''}CoM margin {1000 * key.com_margin:.0f} mm",
        push + limit,
    ]


def climb_sheet(
    plan: Plan,
    rollout: Rollout,
    path: str | Path,
    *,
    frames: int = 12,
    tile: tuple[int, int] = (300, 250),
) -> Path:
    """Draw what physics did, in pictures evenly spaced in time."""
    rows = np.linspace(0, len(rollout.time) - 1, frames).round().astype(int)
    view = view_of(rollout.world, _some(rollout.qpos, 60), tile[0] / tile[1])
    tiles = []
    with Camera(rollout.world, tile) as camera:
        for row in rows:
            picture = camera.shot(rollout.qpos[row], view)
            tiles.append((picture, [f"{rollout.time[row]:.1f} s"]))
    return _save_sheet(tiles, path, columns=4, colours=200)


def _some(x: np.ndarray | Samples, n: int) -> np.ndarray:
    """About `n` rows, evenly spaced, the last one among them."""
    return x[np.unique(np.linspace(0, len(x) - 1, min(n, len(x))).round().astype(int))]


@functools.cache
def _font(size: int) -> Any:
    return ImageFont.load_default(size=size)


def _save_sheet(
    tiles: Sequence[tuple[Image.Image, list[str]]],
    path: str | Path,
    *,
    columns: int,
    colours: int | None = None,
    gap: int = 6,
) -> Path:
    """Tiles in rows, each over its caption; with a palette the file is small."""
    width, height = tiles[0][0].size
    lines = max(len(c) for _, c in tiles)
    band = 8 + 18 * lines
    rows = -(-len(tiles) // columns)
    size = (columns * (width + gap) + gap, rows * (height + band + gap) + gap)
    sheet = Image.new("RGB", size, PALE)
    draw = ImageDraw.Draw(sheet)
    for i, (picture, caption) in enumerate(tiles):
        row, column = divmod(i, columns)
        x, y = gap + column * (width + gap), gap + row * (height + band + gap)
        sheet.paste(picture, (x, y))
        draw.rectangle((x, y, x + width - 1, y + height + band - 1), outline=LINE)
        for k, text in enumerate(caption):
            at = (x + 7, y + height + 4 + 18 * k)
            draw.text(at, text, font=_font(15 if k == 0 else 13), fill=DARK)
    if colours is not None:
        sheet = sheet.quantize(colours, dither=Image.Dither.NONE)
    path = Path(path)
    with whole_file(path) as draft:
        sheet.save(draft, optimize=True)
    return path


# Plots over time.


def demonstration_plot(
    demonstration: Demonstration, sequence: ContactSequence, path: str | Path
) -> Path:
    """Heights of the person's parts over time, what was found to be contact in bold."""
    t = demonstration.t
    tracks = {p: demonstration.point(p)[:, 2] for p in _PARTS.values() for p in p}
    contact = {
        p: [(x.t0, x.t1) for x in sequence.intervals if x.part == p] for p in tracks
    }
    fig = _height_figure(t, tracks, contact, _PARTS, sequence.scene)
    fig.suptitle(f"The person: {sequence.source}", fontsize=10)
    return save_plot(fig, path)


def contact_plot(plan: Plan, rollout: Rollout, path: str | Path) -> Path:
    """Heights of the robot's surfaces in physics, bold where they bear load."""
    world, kin = plan.world, Kinematics(plan.world)
    rows = _some(np.arange(len(rollout.time)), SAMPLES)
    up = np.array([0.0, 0.0, 1.0])
    heights = np.zeros((len(rows), len(rollout.surfaces)))
    for i, row in enumerate(rows):
        kin.update(rollout.qpos[row])
        heights[i] = [kin.contact_point(s, up)[2] for s in rollout.surfaces]
    loaded = loaded_surfaces(world, rollout)
    tracks = {s: heights[:, i] for i, s in enumerate(rollout.surfaces)}
    contact = {
        s: [(rollout.time[a], rollout.time[b - 1]) for a, b in runs_of(loaded[:, i])]
        for i, s in enumerate(rollout.surfaces)
    }
    panels = _limb_panels(world.robot)
    fig = _height_figure(rollout.time[rows], tracks, contact, panels, world.scene)
    fig.suptitle(f"{world.robot.name} in physics", fontsize=10)
    return save_plot(fig, path)


_PARTS = {
    "left arm": ("LHand", "LElbow"),
    "right arm": ("RHand", "RElbow"),
    "left leg": ("LFoot", "LKnee"),
    "right leg": ("RFoot", "RKnee"),
}


def _limb_panels(robot: Robot) -> dict[str, tuple[str, ...]]:
    return {n.replace("_", " "): limb.surfaces for n, limb in robot.limbs.items()}


def loaded_surfaces(world: World, rollout: Rollout) -> np.ndarray:
    """(M, nS) bool, which surfaces bear more than a hundredth of the weight."""
    force = np.linalg.norm(rollout.contact_force, axis=2)
    return force > LOADED * world.mass * 9.81


def runs_of(mask: np.ndarray) -> list[tuple[int, int]]:
    """Half-open ranges in which a boolean (M,) mask is true."""
    steps = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    return list(zip(steps[::2].tolist(), steps[1::2].tolist(), strict=True))


def _height_figure(
    t: np.ndarray,
    tracks: dict[str, np.ndarray],
    contact: dict[str, list[tuple[float, float]]],
    panels: dict[str, tuple[str, ...]],
    scene: Scene,
) -> Figure:
    """One panel a limb: heights thin, contacts bold, tops of boxes dotted."""
    fig = Figure(figsize=(10, 5.4), layout="constrained")
    axes = fig.subplots(2, 2, sharex=True, sharey=True).ravel().tolist()
    for ax, (limb, surfaces) in zip(axes, panels.items(), strict=True):
        for box in scene.boxes:
            ax.axhline(box.top.position[2], color="0.45", ls=":", lw=1)
        ax.axhline(0.0, color="0.45", ls=":", lw=1)
        for s, colour in zip(surfaces, SURFACE_COLOURS, strict=False):
            ax.plot(t, tracks[s], color=colour, lw=0.9, alpha=0.8, label=s)
            for t0, t1 in contact[s]:
                inside = (t >= t0) & (t <= t1)
                ax.plot(t[inside], tracks[s][inside], color=colour, lw=3.5)
        ax.set_title(limb, fontsize=9, loc="left")
        finish_axes(ax)
    for ax in axes[2:]:
        ax.set_xlabel("time [s]")
    for ax in axes[::2]:
        ax.set_ylabel("height [m]")
    return fig


def finish_axes(ax: Axes) -> None:
    """Legend, two spines, small labels."""
    ax.legend(fontsize=8, frameon=False, loc="upper right")
    ax.spines[["top", "right"]].set_visible(False)
    ax.tick_params(labelsize=8)


def stability_plot(plan: Plan, rollout: Rollout, path: str | Path) -> Path:
    """Projected distances of loaded contacts, and the CoM's margin, with limits."""
    world = plan.world
    rows = _some(np.arange(len(rollout.time)), SAMPLES)
    t = rollout.time[rows]
    d, limit, margin = stability_over_time(world, rollout, rows)
    fig = Figure(figsize=(10, 7.2), layout="constrained")
    grid = fig.add_gridspec(3, 2)
    index = {s: i for i, s in enumerate(rollout.surfaces)}
    for k, (limb, surfaces) in enumerate(_limb_panels(world.robot).items()):
        ax = fig.add_subplot(grid[k // 2, k % 2])
        for s, colour in zip(surfaces, SURFACE_COLOURS, strict=False):
            ax.plot(t, d[:, index[s]], color=colour, lw=1.4, label=s)
            ax.plot(t, limit[:, index[s]], color=colour, lw=0.9, ls="--")
        top = "supported mass: shoulder" if "arm" in limb else "supported mass: hip"
        ax.set_title(f"{limb} ({top})", fontsize=9, loc="left")
        ax.set_xlim(t[0], t[-1])
        ax.set_ylim(0.0, 1.3 * max(0.1, float(np.nanmax(np.append(limit, d)))))
        ax.set_ylabel("d [m]; dashed: limit", fontsize=8)
        finish_axes(ax)
    ax = fig.add_subplot(grid[2, :])
    ax.plot(t, margin, color="0.15", lw=1.2, label="CoM inside the support polygon")
    ax.axhline(0.0, color="#b91c1c", lw=1, ls="--", label="its border")
    wanted = plan.options.keyframe.balance_margin
    ax.axhline(wanted, color="#15803d", lw=1, ls="--", label="asked of keyframes")
    ax.set_xlim(t[0], t[-1])
    ax.set_xlabel("time [s]")
    ax.set_ylabel("margin [m]", fontsize=8)
    ax.set_ylim(top=1.3 * max(0.05, float(np.nanmax(np.append(margin, 0.0)))))
    finish_axes(ax)
    return save_plot(fig, path)


def cost_to_go_plot(plan: Plan, path: str | Path) -> Path:
    """Draw the distance left to the goal after each contact change, by cycle."""
    fig = Figure(figsize=(7.0, 3.2), layout="constrained")
    ax = fig.subplots()
    names = list(dict.fromkeys(i.option for i in plan.iterations))
    colours = dict(zip(names, itertools.cycle(CYCLE_COLOURS), strict=False))
    labelled = set()
    for k, i in enumerate(plan.iterations):
        label = None if i.option in labelled else i.option
        labelled.add(i.option)
        ax.axvspan(k + 0.5, k + 1.5, color=colours[i.option], lw=0, label=label)
    costs = [i.cost for i in plan.iterations]
    ax.plot(range(1, len(costs) + 1), costs, color="black", lw=1.2)
    ax.set_xlim(0.5, len(costs) + 0.5)
    ax.set_ylim(0.0, None)
    ax.set_xlabel("contact change")
    ax.set_ylabel("cost-to-go [m]")
    finish_axes(ax)
    return save_plot(fig, path)


def stability_over_time(
    world: World, rollout: Rollout, rows: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Geometric stability (4.17) of what physics did.

    Returns:
        d: (n, nS) projected distances [m], NaN where a surface is not loaded.
        limit: (n, nS) l sin(theta_max) in the present posture [m].
        margin: (n,) of the centre of mass [m], NaN where nothing is loaded.
    """
    loaded = loaded_surfaces(world, rollout)[rows]
    return stability_of(world, rollout.qpos[rows], loaded, rollout.surfaces)


def stability_of(
    world: World, postures: np.ndarray, loaded: np.ndarray, surfaces: Sequence[str]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Geometric stability (4.17) of postures (n, nq) on the surfaces that bear.

    Args:
        world: Robot and supports.
        postures: (n, nq).
        loaded: (n, nS) bool, the surfaces that bear.
        surfaces: Names of the nS surfaces.

    Returns:
        As `stability_over_time`.
    """
    kin = Kinematics(world)
    d = np.full(loaded.shape, np.nan)
    limit, margin = d.copy(), np.full(len(postures), np.nan)
    for i, q in enumerate(postures):
        kin.update(q)
        bearing = []
        for j in np.flatnonzero(loaded[i]):
            surface = surfaces[int(j)]
            support = support_below(world, kin, surface)
            point = kin.contact_point(surface, support.normal)
            mass = kin.landmark(world.robot.limb_of(surface).root)[1]
            d[i, j] = projected_distance(point, mass)
            length = float(np.linalg.norm(mass - point))
            limit[i, j] = length * math.sin(theta_max(support.friction))
            bearing.append(bearing_of(kin, surface, support))
        if bearing:
            polygon = support_polygon(np.concatenate(bearing)[:, :2])
            margin[i] = com_margin(kin.com, polygon)
    return d, limit, margin


def row_at(times: np.ndarray, t: float) -> int:
    """Index of the last of rising times (n,) up to `t` [s]; 0 before the first."""
    return max(0, int(np.searchsorted(times, t + 1e-9, side="right")) - 1)


def bearing_of(kin: Kinematics, surface: str, support: Support) -> np.ndarray:
    """(k, 3) points of a surface that bear on a support; the nearest one at least."""
    points = kin.bearing_points(surface, support.normal)
    gaps = support.height(points)
    return points[gaps <= max(TOUCHING, float(gaps.min()))]


def support_below(world: World, kin: Kinematics, surface: str) -> Support:
    """The support that a surface is nearest to at the present posture."""

    def gap(s: Support) -> float:
        point = kin.contact_point(surface, s.normal)
        outside = 0.0 if s.inside(point, -0.05) else math.inf
        return abs(float(s.height(point))) + outside

    return min(world.supports.values(), key=gap)


def cost_shapes(path: str | Path) -> Path:
    """Cost of one contact along x: the norm, and weighted with w = 5 (4.25)."""
    x = np.linspace(-0.5, 0.5, 401)
    fig = Figure(figsize=(6, 3.6), layout="constrained")
    ax = fig.subplots()
    ax.plot(
        x, STABILITY_WEIGHT * np.abs(x), color="#1d4ed8", label="weighted norm, w = 5"
    )
    ax.plot(x, np.abs(x), color="#b91c1c", label="norm")
    ax.plot(
        x,
        STABILITY_WEIGHT * x**2,
        color="0.4",
        ls="--",
        lw=1,
        label="w times its square",
    )
    ax.set_xlabel("contact against the projection of its supported mass, x [m]")
    ax.set_ylabel("cost")
    finish_axes(ax)
    ax.legend(fontsize=8, frameon=False, loc="upper center")
    return save_plot(fig, path)


def save_plot(fig: Figure, path: str | Path) -> Path:
    """Write a figure whole, without the date or version of what drew it."""
    path = Path(path)
    with whole_file(path) as draft:
        fig.savefig(draft, dpi=110, metadata={"Software": None})
    return path


# Video.


def speedup_of(duration: float) -> int:
    """How much faster than it was a run of that many seconds is shown."""
    speedup = 1
    while duration > SPEEDUP_AFTER and duration / speedup > VIDEO_SECONDS:
        speedup *= 2
    return speedup


def video(
    plan: Plan,
    rollout: Rollout,
    folder: str | Path,
    *,
    out: str | Path | None = None,
    size: tuple[int, int] | None = None,
    camera: Preset = "corner",
    report: Report | None = None,
) -> Path:
    """Draw the rollout as a time-lapse: `video.mp4`, or `video.webp` without ffmpeg.

    Args:
        plan: What was to be done.
        rollout: What physics made of it.
        folder: Where the video goes under its usual name.
        out: The file instead, an `.mp4` or a `.webp`.
        size: Width and height in pixels, even numbers.
        camera: From where.
        report: Told of the share done.

    Raises:
        InputError: Another ending.
        MissingDependency: An `.mp4` was asked for and there is no ffmpeg.
    """
    has_ffmpeg = importlib.util.find_spec("imageio_ffmpeg") is not None
    if out is None:
        out = Path(folder) / ("video.mp4" if has_ffmpeg else "video.webp")
    path = Path(out)
    if path.suffix not in (".mp4", ".webp"):
        raise InputError("a name that ends in .mp4 or .webp", source=path)
    if path.suffix == ".mp4" and not has_ffmpeg:
        raise MissingDependency("imageio-ffmpeg", "video")
    fps, usual = (FPS, VIDEO_SIZE) if path.suffix == ".mp4" else (FPS / 2, WEBP_SIZE)
    size = size or usual
    frames = _frames(
        plan, rollout, fps, size, camera, report or (lambda stage, share, note: None)
    )
    with whole_file(path) as draft:
        if path.suffix == ".mp4":
            _write_mp4(frames, draft, size)
        else:
            first, *rest = frames
            options: dict[str, Any] = {"quality": 70, "method": 0, "loop": 0}
            first.save(
                draft,
                save_all=True,
                append_images=rest,
                duration=round(1000 / fps),
                **options,
            )
    return path


def _frames(
    plan: Plan,
    rollout: Rollout,
    fps: float,
    size: tuple[int, int],
    camera: Preset,
    report: Report,
) -> Iterator[Image.Image]:
    """Pictures of the rollout with its clock and the move under way."""
    duration = float(rollout.time[-1])
    speedup = speedup_of(duration)
    times = np.arange(0.0, duration, speedup / fps)
    rows = np.searchsorted(rollout.time, times)
    moves = _move_names(plan)
    starts = plan.trajectory.keyframes if plan.trajectory is not None else np.zeros(1)
    drawn = (
        size[0] * 5 // 4,
        size[1] * 5 // 4,
    )  # smoother edges at a third of the price
    view = view_of(rollout.world, _some(rollout.qpos, 60), size[0] / size[1], camera)
    letters = max(18, round(size[1] / 30))
    with Camera(rollout.world, drawn, smooth=False) as drawing:
        for i, (row, t) in enumerate(zip(rows, times, strict=True)):
            if i % 10 == 0:
                report("video", i / len(rows), "")
            picture = drawing.shot(rollout.qpos[row], view)
            picture = picture.resize(size, Image.Resampling.BILINEAR)
            # On its way to where the first move begins, it is that one's.
            move = max(int(np.searchsorted(starts, t, side="right")), 1)
            text = moves[move - 1] if move <= len(moves) else "done"
            clock = f"{t:5.1f} s" + (f"   {speedup}x" if speedup > 1 else "")
            draw = ImageDraw.Draw(picture)
            line = size[1] - letters - 10
            draw.text((12, line), clock, font=_font(letters), fill=DARK)
            at = (size[0] - 12, line)
            draw.text(at, text, font=_font(letters), fill=DARK, anchor="ra")
            yield picture
    report("video", 1.0, "")


def _move_names(plan: Plan) -> list[str]:
    keys = plan.keyframes
    return [describe_move(a.stance, b.stance) for a, b in pairwise(keys)]


def _write_mp4(
    frames: Iterable[Image.Image], path: Path, size: tuple[int, int]
) -> None:
    import imageio_ffmpeg

    writer = imageio_ffmpeg.write_frames(
        str(path),
        size,
        fps=FPS,
        codec="libx264",
        quality=5,
        macro_block_size=2,
        output_params=[
            "-preset", "veryfast", "-movflags", "+faststart",
            "-fflags", "+bitexact", "-flags:v", "+bitexact", "-map_metadata", "-1",
        ],
    )  # fmt: skip
    writer.send(None)
    try:
        for frame in frames:
            writer.send(frame.tobytes())
    finally:
        writer.close()


# A whole run.


def render_run(
    folder: str | Path,
    *,
    with_video: bool = True,
    demonstration: tuple[Demonstration, ContactSequence] | None = None,
    report: Report | None = None,
) -> list[Path]:
    """Draw all there is to draw of a run folder, plots first.

    Args:
        folder: With a plan; with a rollout there is more to see.
        with_video: Also the video, which takes the longest.
        demonstration: The recording and what was found in it.
        report: Told of stage, share done and a note.

    Raises:
        InputError: A file of the folder is missing or broken; what does without it is
            drawn by then.
        ClamberError: There is no OpenGL for pictures; the plots are done by then.
    """
    folder = Path(folder)
    tell = report or (lambda stage, share, note: None)
    plan, rollout, broken = _readable(folder)
    files: list[Path] = []
    tell("pictures", 0.0, "plots")
    if demonstration is not None:
        files.append(demonstration_plot(*demonstration, folder / "demonstration.png"))
    if rollout is not None:
        files.append(contact_plot(plan, rollout, folder / "contacts.png"))
        files.append(stability_plot(plan, rollout, folder / "stability.png"))
    if plan.iterations:
        files.append(cost_to_go_plot(plan, folder / "cost-to-go.png"))
    tell("pictures", 0.4, "keyframes")
    files.append(keyframe_sheet(plan, folder / "keyframes.png"))
    if rollout is not None:
        tell("pictures", 0.7, "climb")
        files.append(climb_sheet(plan, rollout, folder / "climb.png"))
        tell("pictures", 1.0, "")
        if with_video:
            files.append(video(plan, rollout, folder, report=tell))
    if broken is not None:
        raise broken
    return files


def _readable(folder: Path) -> tuple[Plan, Rollout | None, InputError | None]:
    """A plan, a rollout, and why that is not all of a run folder that is broken.

    Raises:
        InputError: Of the plan.
    """
    broken, rollout = None, None
    try:
        plan = load_plan(folder)
    except InputError as e:
        broken, plan = e, load_plan(folder, without=(TIMINGS, TRAJECTORY))
    if (folder / ROLLOUT).exists():
        try:
            rollout = load_rollout(folder)
        except InputError as e:
            broken = broken or e
            with contextlib.suppress(InputError):
                rollout = load_rollout(folder, with_events=False)
    return plan, rollout, broken


def render_frame(
    folder: str | Path,
    time: float,
    *,
    out: str | Path | None = None,
    size: tuple[int, int] = FRAME_SIZE,
    camera: Preset = "corner",
    transparent: bool = False,
) -> Path:
    """Draw a run at one time as a PNG.

    Args:
        folder: A run folder; the plan is drawn where physics has not run.
        time: [s]; the state at that time, or the last one before.
        out: The file; `frame-<time>.png` in the run folder by default.
        size: Width and height in pixels.
        camera: From where.
        transparent: Robot and obstacles alone, on nothing.

    Raises:
        InputError: A file is missing or broken, or there is no such time.
        ClamberError: There is no OpenGL.
    """
    folder = Path(folder)
    if (folder / ROLLOUT).exists():
        motion = load_rollout(folder, with_events=False)
        world, t, q = motion.world, motion.time, motion.qpos
    else:
        plan = load_plan(folder)
        trajectory = trajectory_of(plan, folder)
        world, t, q = plan.world, trajectory.time, trajectory.q
    if not t[0] <= time <= t[-1]:
        raise InputError(
            f"a time from {t[0]:g} to {t[-1]:.2f} s", source="--frame", value=time
        )
    row = row_at(t, time)
    path = folder / f"frame-{time:g}.png" if out is None else Path(out)
    if path.suffix != ".png":
        raise InputError("a name that ends in .png", source=path)
    view = view_of(world, _some(q, 60), size[0] / size[1], camera)
    with Camera(world, size, cutout=transparent) as drawing:
        draw = drawing.cutout if transparent else drawing.shot
        picture = draw(q[row], view)
    with whole_file(path) as draft:
        picture.save(draft)
    return path
