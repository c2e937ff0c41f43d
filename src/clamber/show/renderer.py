"""Offscreen rendering of a world.

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
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from PIL import Image, ImageChops, ImageFilter

from clamber.errors import ClamberError
from clamber.model.scene import GROUND
from clamber.model.se3 import matrix_from_quat
from clamber.model.world import World
from clamber.show.framing import View
from clamber.show.meshes import (
    PAD_COLOUR,
    geom_colour,
    own_geoms,
    own_meshes,
    pads_of,
)

STEEP = 70.0  # [deg] elevation from which a camera has no ahead of its own
Colour = tuple[float, float, float, float]  # in [0, 1]
Shape = Callable[[mujoco.MjvGeom], None]  # makes itself of a geom that is drawn
_Part = tuple[int, int, int, int]  # left, top, right and bottom [pixels]
GROUND_SHOWN = 60.0  # [m] half width of the ground in pictures
FOG = (1.3, 4.0)  # [distance of the camera] where the ground begins and ends to fade
HORIZON, GROUND_COLOUR, GRID_COLOUR = (
    (0.965, 0.972, 0.98),
    (226, 229, 233),
    (203, 208, 214),
)
GRID_LINE = 3  # of the 256 texels of a square
BOX_COLOUR: Colour = (0.80, 0.68, 0.53, 1.0)
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
SMALL = 1000  # lines of what is drawn, up to which a map of half the size will do
SHADED = 1.0  # [distance of the camera] around what it looks at there are shadows
SOFT = 0.012  # [height of the picture] how far a shadow's edge, or a line's, is seen
WHOLE = 4  # pixels that are whole numbers of pixels of what is drawn for a video
FAR_AWAY = 1000.0  # [m] where nothing is seen, nor its shadow
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


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Layer:
    """A rendered layer of a scene: colours and depth.

    Attributes:
        picture: Of the size of what is drawn, not of what is seen.
        depth: (height, width) in [0, 1], 0 at the camera.
    """

    picture: Image.Image
    depth: np.ndarray


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Still:
    """The static part of a scene, rendered from one view.

    Attributes:
        shapes: Beside the scene.
        colour: Without shadows.
        lit: The same in the size in which shadows are drawn.
        plain: `colour` in the size that is seen.
        left: Share of the light that shadows leave.
        picture: All of it.
    """

    shapes: Sequence[Shape]
    colour: Layer
    lit: Layer
    plain: Image.Image
    left: Image.Image
    picture: Image.Image


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
        """Open a context of this thread.

        Args:
            world: What to draw.
            size: Width and height in pixels.
            fine: Edges are drawn at twice the size, as for a picture that is looked at
                for long; half as long without, as for those of a video.
            cutout: For `cutout`; `shot` then lacks the ground.
        """
        self._gl: Any = None
        self._contexts: list[mujoco.MjrContext] = []
        self._size = size
        self._whole = 1 if fine else WHOLE
        scale = 2.0 if fine or cutout else 1.25
        self._frame = round(scale * size[0]), round(scale * size[1])
        small = self._frame[1] <= SMALL
        self._shade = size if small else self._frame
        if not fine:
            self._shade = size[0] // 2, size[1] // 2
        model = _dressed(world, self._frame)
        if small:
            model.vis.quality.numslices, model.vis.quality.numstacks = 20, 10
            model.vis.quality.shadowsize = SHADOW_MAP // 2
        if cutout:
            model.geom_matid[world.support_geom[GROUND]] = -1
            model.geom_rgba[world.support_geom[GROUND], 3] = 0.0
        self._model, self._data = model, mujoco.MjData(model)
        self._fovy = float(model.vis.global_.fovy)
        self._low = _lowest(model)
        self._gl = _gl_context(*self._frame)
        self._gl.make_current()
        self._contexts.append(_context(model))
        if small and not own_meshes(world).any():
            # Shadows are blurred: round shapes may have corners in them.
            model.vis.quality.numslices, model.vis.quality.numstacks = 12, 6
            model.vis.global_.offwidth, model.vis.global_.offheight = self._shade
            self._contexts.append(_context(model))
        self._scene = mujoco.MjvScene(model, maxgeom=model.ngeom + EXTRA_SHAPES)
        self._movers = mujoco.MjvScene(model, maxgeom=model.ngeom + EXTRA_SHAPES)
        self._option, self._camera = mujoco.MjvOption(), mujoco.MjvCamera()
        boxes = world.scene.boxes if not cutout else ()
        self._edges = [
            edge
            for b in (boxes if len(boxes) <= MOST_EDGED else ())
            for edge in _edges(b.size, b.centre, b.rotation)
        ]
        for mesh in () if cutout else world.scene.meshes:
            for s in mesh.supports[:MOST_EDGED]:
                self._edges += outline(s.vertices + EDGE_LIFT * s.normal, EDGE_COLOUR)
        self._caps = _joint_caps(model, world)

    def __enter__(self) -> Camera:
        """Itself."""
        return self

    def __exit__(self, *error: object) -> None:
        """Free the context."""
        for context in self._contexts:
            context.free()
        if self._gl is not None:
            self._gl.free()

    def shot(
        self,
        q: np.ndarray,
        view: View,
        shapes: Iterable[Shape] = (),
        still: Still | None = None,
    ) -> Image.Image:
        """A picture of the configuration `q` (nq,), and of shapes beside it.

        Args:
            q: Of the robot.
            view: From where.
            shapes: Beside the robot.
            still: What `still` drew from there. Only robot and shapes are drawn anew,
                and what they put in shadow, in a fraction of the time.
        """
        self._update(q, view, shapes, () if still is None else still.shapes)
        if still is None:
            return self._entire().picture
        near, around = self._covered(view)
        plain = still.plain.copy()
        piece = self._over(still.colour, self._frame, near)
        wide, high = near[2] - near[0], near[3] - near[1]
        plain.paste(piece.resize((wide, high), Image.Resampling.BOX), near[:2])
        left = still.left.copy()
        lit = self._over(still.lit, self._shade, around)
        at = _scaled(around, self._size, self._shade)
        left.paste(self._left(around, lit), at[:2])
        picture = still.picture.copy()
        soft = self._soft(left, around)
        picture.paste(ImageChops.multiply(plain.crop(around), soft), around[:2])
        return picture

    def still(self, view: View, shapes: Sequence[Shape] = ()) -> Still:
        """The scene without its robot, and shapes: what does not move in a video."""
        q = self._model.qpos0.copy()
        q[:3] = view.lookat + FAR_AWAY * view.axes[0]
        self._update(q, view, (), shapes)
        return self._entire(shapes)

    def _entire(self, shapes: Sequence[Shape] = ()) -> Still:
        """The scene as it was last updated; `shapes` of it stand still."""
        whole = (0, 0, *self._size)
        colour = lit = self._drawn(self._frame, whole)
        if self._shade != self._frame:
            lit = self._drawn(self._shade, whole)
        left = self._left(whole, lit.picture)
        plain = colour.picture.resize(self._size, Image.Resampling.BOX)
        return Still(
            shapes=shapes,
            colour=colour,
            lit=lit,
            plain=plain,
            left=left,
            picture=ImageChops.multiply(plain, self._soft(left, whole)),
        )

    def _over(self, still: Layer, size: tuple[int, int], part: _Part) -> Image.Image:
        """Part of a picture of that size, what moves drawn over what stands still."""
        if any(g.rgba[3] < 1.0 for g in self._moving):  # what is behind shines through
            return self._drawn(size, part).picture
        over = self._drawn(size, part, movers=True)
        x0, y0, x1, y1 = at = _scaled(part, self._size, size)
        nearer = over.depth < still.depth[y0:y1, x0:x1]
        picture = still.picture.crop(at)
        picture.paste(over.picture, (0, 0), Image.fromarray(nearer))
        return picture

    def _left(self, part: _Part, lit: Image.Image) -> Image.Image:
        """The share of light that shadows leave of what is lit there."""
        shaded = self._drawn(self._shade, part, shadows=True).picture
        with_, without = (np.asarray(x, dtype=np.float32) for x in (shaded, lit))
        left = (with_.sum(axis=2) + 1.0) / (without.sum(axis=2) + 1.0)
        return Image.fromarray((255 * np.minimum(left, 1.0)).astype(np.uint8))

    def _soft(self, left: Image.Image, part: _Part) -> Image.Image:
        """A factor for each colour of a part: shares of light with soft edges."""
        sigma = PENUMBRA * left.height
        pad = math.ceil(4 * sigma)
        x0, y0, x1, y1 = _scaled(part, self._size, left.size)
        u0, v0 = max(x0 - pad, 0), max(y0 - pad, 0)
        around = (u0, v0, min(x1 + pad, left.width), min(y1 + pad, left.height))
        soft = left.crop(around).filter(ImageFilter.GaussianBlur(sigma))
        size = part[2] - part[0], part[3] - part[1]
        box = (x0 - u0, y0 - v0, x1 - u0, y1 - v0)
        soft = soft.resize(size, Image.Resampling.BILINEAR, box=box)
        return Image.merge("RGB", (soft,) * 3)

    @property
    def _moving(self) -> Sequence[mujoco.MjvGeom]:
        return self._movers.geoms[: self._movers.ngeom]

    def _covered(self, view: View) -> tuple[_Part, _Part]:
        """Regions of the picture with the moving parts, and with their shadows.

        Both are whole pixels of each layer. A shadow lies between what casts it and
        where its light meets the lowest height.
        """
        geoms = self._moving
        centre = np.array([g.pos for g in geoms])
        sizes = np.array([g.size for g in geoms])
        radius = np.maximum(
            np.linalg.norm(sizes, axis=1), [g.modelrbound for g in geoms]
        )
        down = np.maximum((self._low - centre[:, 2]) / self._sun[2], 0.0)
        shadow = centre + down[:, None] * self._sun
        near = self._around(centre, radius, view)
        across = self._around(shadow, radius / -self._sun[2], view)
        low, high = np.minimum(near, across)[:2], np.maximum(near, across)[2:]
        return near, (int(low[0]), int(low[1]), int(high[0]), int(high[1]))

    def _around(self, centre: np.ndarray, radius: np.ndarray, view: View) -> _Part:
        """The part of a picture that balls are in; all of it where that is not easy."""
        whole = self._whole
        depth = (centre - view.lookat) @ view.axes[2] + view.distance - radius
        if np.any(depth < 0.1 * view.distance) or np.any(np.mod(self._size, whole)):
            return 0, 0, *self._size
        at = view.project(centre, self._size)
        span = radius / depth * self._size[1] / 2
        span = span / math.tan(math.radians(view.fovy) / 2) + SOFT * self._size[1]
        low = np.floor((at - span[:, None]).min(axis=0) / whole) * whole
        high = np.ceil((at + span[:, None]).max(axis=0) / whole) * whole
        high = np.maximum(high, low + whole)
        low = np.clip(low, 0, np.array(self._size) - whole).astype(int)
        high = np.clip(high, low + whole, self._size).astype(int)
        return int(low[0]), int(low[1]), int(high[0]), int(high[1])

    def cutout(self, q: np.ndarray, view: View) -> Image.Image:
        """Robot and obstacles alone (RGBA), on a transparent background.

        Averaged with its mask, so that no pixel mixes with what lies behind it: edges
        keep their own colour.
        """
        self._update(q, view)
        whole = (0, 0, *self._size)
        colour = np.asarray(self._drawn(self._frame, whole).picture, dtype=float)
        flags = (
            mujoco.mjtRndFlag.mjRND_SEGMENT.value,
            mujoco.mjtRndFlag.mjRND_IDCOLOR.value,
        )
        self._scene.flags[list(flags)] = 1
        drawn = np.asarray(self._drawn(self._frame, whole).picture)
        there = np.any(drawn > 0, axis=2)[..., None].astype(float)
        self._scene.flags[list(flags)] = 0
        width, height = self._size

        def halved(x: np.ndarray) -> np.ndarray:
            return x.reshape(height, 2, width, 2, -1).mean(axis=(1, 3))

        share = halved(there)
        colour = halved(colour * there) / np.maximum(share, 1e-9)
        pixels = np.concatenate([colour, 255 * share], axis=2)
        return Image.fromarray(pixels.round().astype(np.uint8), "RGBA")

    def _update(
        self,
        q: np.ndarray,
        view: View,
        shapes: Iterable[Shape] = (),
        still: Iterable[Shape] = (),
    ) -> None:
        self._data.qpos[:] = q
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        self._camera.lookat[:] = view.lookat
        self._camera.distance = view.distance
        self._camera.azimuth, self._camera.elevation = view.azimuth, view.elevation
        moving = [*shapes, *(c.shape(self._data) for c in self._caps)]
        kinds = mujoco.mjtCatBit
        for scene, kind, shown in (
            (self._scene, kinds.mjCAT_ALL, [*moving, *still, *self._edges]),
            (self._movers, kinds.mjCAT_DYNAMIC, moving),
        ):
            mujoco.mjv_updateScene(
                self._model,
                self._data,
                self._option,
                None,
                self._camera,
                kind.value,
                scene,
            )
            for shape in shown[: scene.maxgeom - scene.ngeom]:
                shape(scene.geoms[scene.ngeom])
                scene.ngeom += 1
            self._light(scene, view)
        self._movers.flags[mujoco.mjtRndFlag.mjRND_SKYBOX.value] = 0

    def _light(self, scene: mujoco.MjvScene, view: View) -> None:
        """The sun over the left shoulder, a fill from the right; fog at the horizon."""
        size = view.distance
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
            if strength is SUN:
                self._sun = way
            light.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL.value
            light.headlight, light.castshadow = 0, int(strength is SUN)
            light.dir[:], light.pos[:] = way, view.lookat - 1.5 * size * way
            light.diffuse[:] = strength
            # In the shadow of a light there is not even its ambient part.
            light.ambient[:] = 0.0 if strength is SUN else AMBIENT
            light.specular[:] = 0.25 if strength is SUN else 0.0
        for context in self._contexts:
            context.shadowClip = SHADED * size
            context.fogStart, context.fogEnd = FOG[0] * size, FOG[1] * size
        scene.flags[mujoco.mjtRndFlag.mjRND_FOG.value] = 1

    def _drawn(
        self,
        size: tuple[int, int],
        part: _Part,
        *,
        movers: bool = False,
        shadows: bool = False,
    ) -> Layer:
        """The scene as it was last updated, a part of a picture of that size.

        Args:
            size: Width and height of all of it.
            part: In pixels of `shot`.
            movers: What moves alone.
            shadows: With them.
        """
        scene = self._movers if movers else self._scene
        x0, y0, x1, y1 = _scaled(part, self._size, size)
        half = math.tan(math.radians(self._fovy) / 2)  # of the height, at unit depth
        for camera in scene.camera:
            unit = half * camera.frustum_near * 2 / size[1]  # of a pixel
            camera.frustum_center = unit * ((x0 + x1) - size[0]) / 2
            camera.frustum_top = unit * (size[1] / 2 - y0)
            camera.frustum_bottom = unit * (size[1] / 2 - y1)
        rect = mujoco.MjrRect(0, 0, x1 - x0, y1 - y0)
        pixels = np.empty((rect.height, rect.width, 3), dtype=np.uint8)
        depth = np.empty((rect.height, rect.width), dtype=np.float32)
        scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW.value] = int(shadows)
        context = self._contexts[-1 if size == self._shade else 0]
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, context)
        mujoco.mjr_render(rect, scene, context)
        mujoco.mjr_readPixels(pixels, depth, rect, context)
        return Layer(picture=Image.fromarray(pixels[::-1]), depth=depth[::-1])


def _scaled(part: _Part, seen: tuple[int, int], size: tuple[int, int]) -> _Part:
    """A part of what is seen, in pixels of a picture of another size."""
    x0, y0, x1, y1 = (round(part[i] * size[i % 2] / seen[i % 2]) for i in range(4))
    return x0, y0, x1, y1


def _context(model: mujoco.MjModel) -> mujoco.MjrContext:
    return mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)


def _lowest(model: mujoco.MjModel) -> float:
    """Height of the ground [m], or of the lowest of what stands there below it."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    solid = (model.geom_bodyid == 0) & (
        model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE.value
    )
    R = data.geom_xmat.reshape(-1, 3, 3)[solid]
    centre, half = np.split(model.geom_aabb[solid], 2, axis=1)
    z = data.geom_xpos[solid, 2] + np.einsum("ij,ij->i", R[:, 2], centre)
    low = z - np.einsum("ij,ij->i", np.abs(R[:, 2]), half)
    return float(np.min(low, initial=0.0))


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
    if own_meshes(world).any():
        return []
    round_ones = (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE)
    round_ones = own_geoms(model, world) & np.isin(
        model.geom_type, [k.value for k in round_ones]
    )
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
    pads = pads_of(world)
    model.geom_matid[pads], model.geom_rgba[pads] = -1, PAD_COLOUR
    return model
