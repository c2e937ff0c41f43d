"""Offscreen rendering of a world, and cameras that have all of it in view.

MuJoCo's own renderer draws, through EGL where there is one, else OSMesa. What is drawn
depends on the records alone; the same run gives the same picture.

Shapes: T samples, nq coordinates.
"""

from __future__ import annotations

import copy
import functools
import itertools
import math
import os
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import mujoco
import numpy as np
from PIL import Image, ImageChops, ImageFilter

from clamber.errors import ClamberError
from clamber.model.kinematics import Kinematics
from clamber.model.scene import GROUND, Scene
from clamber.model.se3 import matrix_from_quat
from clamber.model.world import World
from clamber.planning.trajectory import Samples
from clamber.show.meshes import SHOWN_GROUPS, geom_colour
from clamber.show.sample import thinned

Preset = Literal["corner", "side", "front", "behind", "top"]
STEEP = 70.0  # [deg] elevation from which a camera has no ahead of its own
PRESETS: Mapping[Preset, tuple[float, float]] = {  # [deg] azimuth and elevation, of a
    # robot that faces along x. From the left and a little behind, the box hides neither
    # the feet on the ground nor the hands on its top.
    "corner": (288.0, -17.0),
    "side": (270.0, -8.0),
    "front": (180.0, -14.0),
    "behind": (0.0, -20.0),
    "top": (270.0, -89.0),
}
Colour = tuple[float, float, float, float]  # in [0, 1]
Shape = Callable[[mujoco.MjvGeom], None]  # makes itself of a geom that is drawn
MARGIN = 0.08  # share of the picture left free around what must be seen
SEEN_POSTURES = 60  # of a motion, of which all is in the picture
NEAR = 0.35  # [height of the motion] around it boxes are in the picture
GROUND_SHOWN = 60.0  # [m] half width of the ground in pictures
FOG = (1.3, 4.0)  # [distance of the camera] where the ground begins and ends to fade
HORIZON, GROUND_COLOUR, GRID_COLOUR = (
    (0.965, 0.972, 0.98),
    (226, 229, 233),
    (203, 208, 214),
)
GRID_LINE = 3  # of the 256 texels of a square
BOX_COLOUR: Colour = (0.80, 0.68, 0.53, 1.0)
PAD_COLOUR: Colour = (0.13, 0.14, 0.16, 1.0)
CAP_DARK: Colour = (0.16, 0.17, 0.20, 1.0)
CAP_PALE: Colour = (0.66, 0.69, 0.73, 1.0)
CAP_NEAR, CAP_REACH, CAP_SHARE = 0.8, 0.95, 0.5  # [radius of the shape around a joint]
EDGE_COLOUR: Colour = (0.32, 0.26, 0.20, 1.0)
EDGE_LIFT, EDGE_WIDTH = 0.002, 1.5  # [m], [pixels]
MOST_EDGED = 40  # boxes, or supports of a mesh: of more the edges are left out
EXTRA_SHAPES = 1500  # beside those of the model
SUN, FILL, AMBIENT = 0.62, 0.26, 0.34  # of the light, colourless
DOWN = np.array([0.0, 0.0, -1.0])
SHADOW_MAP = 2048  # texels along a side
SHADED = 1.0  # [distance of the camera] around what it looks at there are shadows
PENUMBRA = 0.0035  # [height of the picture] standard deviation of a shadow's edge
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
    """Draws configurations of a world; closed as a context manager.

    Shadows are soft: a picture without them is darkened by the share of light that a
    smaller one with them has lost, which is blurred first. That costs less than a map
    of shadows fine enough not to show its steps.
    """

    def __init__(
        self,
        world: World,
        size: tuple[int, int],
        *,
        fine: bool = True,
        cutout: bool = False,
    ) -> None:
        """Open a context.

        Args:
            world: What to draw.
            size: Width and height in pixels.
            fine: Edges and shadows are drawn at twice the size, as for a picture that
                is looked at for long; half as long without, as for those of a video.
            cutout: For `cutout`; `shot` then lacks the ground.
        """
        self._gl: Any = None
        self._context: Any = None
        self._size = size
        scale = 2.0 if fine or cutout else 1.25
        width, height = round(scale * size[0]), round(scale * size[1])
        model = _dressed(world, (width, height))
        if not fine:
            model.vis.quality.numslices, model.vis.quality.numstacks = 20, 10
            model.vis.quality.shadowsize = SHADOW_MAP // 2
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
        self._scene = mujoco.MjvScene(model, maxgeom=model.ngeom + EXTRA_SHAPES)
        self._option, self._camera = mujoco.MjvOption(), mujoco.MjvCamera()
        boxes = world.scene.boxes if not cutout else ()
        self._edges = [
            edge
            for b in (boxes if len(boxes) <= MOST_EDGED else ())
            for edge in _edges(b.size, b.position, b.rotation)
        ]
        for mesh in () if cutout else world.scene.meshes:
            for s in mesh.supports[:MOST_EDGED]:
                self._edges += outline(s.vertices + EDGE_LIFT * s.normal, EDGE_COLOUR)
        self._caps = _joint_caps(model, world)
        self._frame = (width, height)
        self._shade = (width, height) if fine else (size[0] // 2, size[1] // 2)

    def __enter__(self) -> Camera:
        """Itself."""
        return self

    def __exit__(self, *error: object) -> None:
        """Free the context."""
        if self._context is not None:
            self._context.free()
        if self._gl is not None:
            self._gl.free()

    def shot(
        self, q: np.ndarray, view: View, shapes: Iterable[Shape] = ()
    ) -> Image.Image:
        """A picture of the configuration `q` (nq,), and of shapes beside it."""
        self._update(q, view, shapes)
        picture = self._drawn(self._frame).resize(self._size, Image.Resampling.BOX)
        lit = np.asarray(self._drawn(self._shade), dtype=np.float32)
        shaded = np.asarray(self._drawn(self._shade, shadows=True), dtype=np.float32)
        left = (shaded.sum(axis=2) + 1.0) / (lit.sum(axis=2) + 1.0)
        left = Image.fromarray((255 * np.minimum(left, 1.0)).astype(np.uint8))
        blur = ImageFilter.GaussianBlur(PENUMBRA * left.height)
        left = left.filter(blur).resize(self._size, Image.Resampling.BILINEAR)
        return ImageChops.multiply(picture, Image.merge("RGB", (left,) * 3))

    def cutout(self, q: np.ndarray, view: View) -> Image.Image:
        """Robot and obstacles alone (RGBA), on nothing.

        Averaged with its mask, so that no pixel mixes with what lies behind it: edges
        keep their own colour.
        """
        self._update(q, view, ())
        colour = np.asarray(self._drawn(self._frame), dtype=float)
        flags = (
            mujoco.mjtRndFlag.mjRND_SEGMENT.value,
            mujoco.mjtRndFlag.mjRND_IDCOLOR.value,
        )
        self._scene.flags[list(flags)] = 1
        drawn = np.asarray(self._drawn(self._frame))
        there = np.any(drawn > 0, axis=2)[..., None].astype(float)
        self._scene.flags[list(flags)] = 0
        width, height = self._size

        def halved(x: np.ndarray) -> np.ndarray:
            return x.reshape(height, 2, width, 2, -1).mean(axis=(1, 3))

        share = halved(there)
        colour = halved(colour * there) / np.maximum(share, 1e-9)
        pixels = np.concatenate([colour, 255 * share], axis=2)
        return Image.fromarray(pixels.round().astype(np.uint8), "RGBA")

    def _update(self, q: np.ndarray, view: View, shapes: Iterable[Shape]) -> None:
        self._data.qpos[:] = q
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        self._camera.lookat[:] = view.lookat
        self._camera.distance = view.distance
        self._camera.azimuth, self._camera.elevation = view.azimuth, view.elevation
        scene = self._scene
        mujoco.mjv_updateScene(
            self._model,
            self._data,
            self._option,
            None,
            self._camera,
            mujoco.mjtCatBit.mjCAT_ALL.value,
            scene,
        )
        for shape in (
            *shapes,
            *self._edges,
            *(c.shape(self._data) for c in self._caps),
        ):
            if scene.ngeom < scene.maxgeom:
                shape(scene.geoms[scene.ngeom])
                scene.ngeom += 1
        self._light(view)

    def _light(self, view: View) -> None:
        """The sun over the left shoulder, a fill from the right; fog at the horizon."""
        scene, context, size = self._scene, self._context, view.distance
        right, _, forward = view.axes
        ahead = forward * [1.0, 1.0, 0.0]
        ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-9)
        if abs(view.elevation) > STEEP:
            ahead = np.cross([0.0, 0.0, 1.0], right)
        scene.nlight = 2
        for light, way, strength in (
            (scene.lights[0], 0.5 * ahead + 0.45 * right + DOWN, SUN),
            (scene.lights[1], 0.7 * ahead - 0.8 * right + 0.7 * DOWN, FILL),
        ):
            way = way / np.linalg.norm(way)
            light.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL.value
            light.headlight, light.castshadow = 0, int(strength is SUN)
            light.dir[:], light.pos[:] = way, view.lookat - 1.5 * size * way
            light.diffuse[:] = strength
            # In the shadow of a light there is not even its ambient part.
            light.ambient[:] = 0.0 if strength is SUN else AMBIENT
            light.specular[:] = 0.25 if strength is SUN else 0.0
        context.shadowClip = SHADED * size
        context.fogStart, context.fogEnd = FOG[0] * size, FOG[1] * size
        scene.flags[mujoco.mjtRndFlag.mjRND_FOG.value] = 1

    def _drawn(self, size: tuple[int, int], *, shadows: bool = False) -> Image.Image:
        """The scene as it was last updated."""
        rect = mujoco.MjrRect(0, 0, *size)
        pixels = np.empty((size[1], size[0], 3), dtype=np.uint8)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW.value] = int(shadows)
        mujoco.mjr_render(rect, self._scene, self._context)
        mujoco.mjr_readPixels(pixels, None, rect, self._context)
        return Image.fromarray(pixels[::-1])


def bar(kind: mujoco.mjtGeom, ends: np.ndarray, width: float, colour: Colour) -> Shape:
    """A capsule, a cylinder or a line from one of its ends (2, 3) [m] to the other.

    `width`: radius [m]; of a line [pixels].
    """

    def put(geom: mujoco.MjvGeom) -> None:
        _plain(geom, kind, np.full(3, width), np.zeros(3), np.eye(3), colour)
        mujoco.mjv_connector(geom, kind, width, *ends)

    return put


def ball(centre: np.ndarray, radius: float, colour: Colour) -> Shape:
    """A ball at a point (3,) [m]."""
    kind, size = mujoco.mjtGeom.mjGEOM_SPHERE, np.full(3, radius)
    return lambda geom: _plain(geom, kind, size, centre, np.eye(3), colour)


def block(
    size: np.ndarray, centre: np.ndarray, rotation: np.ndarray, colour: Colour
) -> list[Shape]:
    """A box of edges (3,) [m] and the lines along them."""
    kind = mujoco.mjtGeom.mjGEOM_BOX
    solid = lambda geom: _plain(geom, kind, size / 2, centre, rotation, colour)  # noqa: E731
    return [solid, *_edges(size, centre, rotation)]


def _plain(
    geom: mujoco.MjvGeom,
    kind: mujoco.mjtGeom,
    size: np.ndarray,
    centre: np.ndarray,
    rotation: np.ndarray,
    colour: Colour,
) -> None:
    rgba = np.array(colour, dtype=np.float32)
    mujoco.mjv_initGeom(geom, kind, size, centre, rotation.ravel(), rgba)
    geom.specular, geom.shininess = 0.1, 0.2


def outline(corners: np.ndarray, colour: Colour) -> Iterator[Shape]:
    """The lines around a polygon of corners (K, 3) [m]."""
    for ends in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        yield bar(mujoco.mjtGeom.mjGEOM_LINE, np.array(ends), EDGE_WIDTH, colour)


def _edges(
    size: np.ndarray, centre: np.ndarray, rotation: np.ndarray
) -> Iterator[Shape]:
    """The twelve edges of a box, a little outside of it so that they are seen."""
    half = (size + EDGE_LIFT) / 2
    for axis in range(3):
        for a, b in itertools.product((-1.0, 1.0), repeat=2):
            ends = np.empty((2, 3))
            ends[:, axis] = -half[axis], half[axis]
            ends[:, (axis + 1) % 3] = a * half[(axis + 1) % 3]
            ends[:, (axis + 2) % 3] = b * half[(axis + 2) % 3]
            ends = centre + ends @ rotation.T
            yield bar(mujoco.mjtGeom.mjGEOM_LINE, ends, EDGE_WIDTH, EDGE_COLOUR)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class _Cap:
    """The ends of a joint's axle, seen on both sides of the shape around it.

    Attributes:
        body: Body id.
        ends: (2, 3) in its frame [m].
        radius: [m].
        colour: Other than that of the shape.
    """

    body: int
    ends: np.ndarray
    radius: float
    colour: Colour

    def shape(self, data: mujoco.MjData) -> Shape:
        """As it is drawn at the present posture."""
        R = data.xmat[self.body].reshape(3, 3)
        ends = data.xpos[self.body] + self.ends @ R.T
        return bar(mujoco.mjtGeom.mjGEOM_CYLINDER, ends, self.radius, self.colour)


def _joint_caps(model: mujoco.MjModel, world: World) -> list[_Cap]:
    """Axles of the hinges that lie in a ball or a capsule of their link.

    A robot drawn with meshes has its own.
    """
    own = model.body_rootid[model.geom_bodyid] == model.body_rootid[world.base]
    if np.any(own & (model.geom_type == mujoco.mjtGeom.mjGEOM_MESH)):
        return []
    round_ones = (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE)
    round_ones = own & np.isin(model.geom_type, [k.value for k in round_ones])
    caps = []
    for j in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE):
        body, at, axis = int(model.jnt_bodyid[j]), model.jnt_pos[j], model.jnt_axis[j]
        for g in np.flatnonzero(round_ones & (model.geom_bodyid == body)):
            radius, half = float(model.geom_size[g, 0]), 0.0
            along = matrix_from_quat(model.geom_quat[g])[:, 2]
            if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_CAPSULE:
                half = float(model.geom_size[g, 1])
            centre, reach = model.geom_pos[g], CAP_REACH * radius
            foot = centre + np.clip((at - centre) @ along, -half, half) * along
            if np.linalg.norm(at - foot) > CAP_NEAR * radius:
                continue
            if abs(float(along @ axis)) > 0.8:
                reach += half  # the capsule is the axle's own
            else:
                centre = foot
            dark = geom_colour(model, int(g))[:3].mean() < 0.4
            caps.append(
                _Cap(
                    body=body,
                    ends=centre + np.outer([-reach, reach], axis),
                    radius=CAP_SHARE * radius,
                    colour=CAP_PALE if dark else CAP_DARK,
                )
            )
            break
    return caps


def _dressed(world: World, size: tuple[int, int]) -> mujoco.MjModel:
    """The world's model as it is drawn: its looks are changed, the world's stay."""
    model = copy.copy(world.model)
    model.vis.global_.offwidth, model.vis.global_.offheight = size
    model.vis.quality.offsamples = 0  # drawn larger and averaged instead
    model.vis.quality.shadowsize = SHADOW_MAP
    model.vis.rgba.fog = [*HORIZON, 1.0]
    ground = world.support_geom[GROUND]
    model.geom_size[ground, :2] = GROUND_SHOWN
    for texture in range(model.ntex):
        first, n = int(model.tex_adr[texture]), int(model.tex_nchannel[texture])
        wide, high = int(model.tex_width[texture]), int(model.tex_height[texture])
        texels = np.empty((high, wide, n), dtype=np.uint8)
        name = model.texture(texture).name
        if name == "clamber_ground":
            texels[:] = GROUND_COLOUR
            texels[:GRID_LINE] = texels[:, :GRID_LINE] = GRID_COLOUR
        elif name == "clamber_sky":
            texels[:] = np.round(255 * np.array(HORIZON))
        else:
            continue
        model.tex_data[first : first + texels.size] = texels.ravel()
    kinds = (mujoco.mjtGeom.mjGEOM_BOX.value, mujoco.mjtGeom.mjGEOM_MESH.value)
    boxes = (model.geom_bodyid == 0) & np.isin(model.geom_type, kinds)
    model.geom_rgba[boxes] = BOX_COLOUR
    # Shapes that bear on something stand out of a robot's own meshes like balls; as
    # pads of rubber they belong to it.
    own = model.body_rootid[model.geom_bodyid] == model.body_rootid[world.base]
    meshes = own & (model.geom_type == mujoco.mjtGeom.mjGEOM_MESH)
    if np.any(meshes & np.isin(model.geom_group, SHOWN_GROUPS)):
        pads = [g for s in world.surfaces.values() for g in s.geoms]
        model.geom_matid[pads], model.geom_rgba[pads] = -1, PAD_COLOUR
    return model


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
    boxes = (box_corners(b.size, b.position, b.rotation) for b in scene.boxes)
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
