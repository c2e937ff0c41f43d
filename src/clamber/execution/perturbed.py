"""The true world of a run: what was planned for, disturbed.

A disturbed world is a world of its own, compiled from its own MJCF, so that whoever
loads that file simulates the same physics.
"""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np

from clamber.errors import InputError
from clamber.execution.disturbance import Disturbance
from clamber.model.scene import Box, Mesh, Scene
from clamber.model.se3 import matrix_from_rpy, quat_from_yaw
from clamber.model.world import PHYSICS_STEP, World, build_world, recompiled

BASE = 0.4  # [m] of a height field under its lowest height
TILE = 0.1  # [m] side of the tiles of an uneven top, about
SWELL = 0.15  # [m] standard deviation of the kernel that their heights are smoothed by
PUSH_TIME = 0.2  # [s]
PUSH_MARGIN = 0.5  # [s] no push begins earlier, or ends later before the end


def perturbed_world(
    world: World, disturbance: Disturbance, truth: Scene | None = None
) -> World:
    """The world that physics runs.

    Args:
        world: As it was planned for.
        disturbance: What differs.
        truth: The true scene, disturbed in its turn; None: the planned one.

    Raises:
        InputError: A box would vanish.
    """
    d, base, scene = disturbance, world, world.scene
    if truth is not None or d.changes_world:
        scene = perturbed_scene(world.scene if truth is None else truth, d)
        base = build_world(world.robot, scene)
    scanned = [m for m in scene.meshes if m.field is not None]
    if d.unevenness == 0 and d.mass == 1 and d.effort == 1 and not scanned:
        return base

    def perturb(spec: mujoco.MjSpec) -> None:
        rng = np.random.default_rng([d.seed, 2])
        if d.unevenness > 0:
            for b in scene.boxes:
                _tile(spec, b, d.unevenness, rng)
        for m in scanned:
            _measured(spec, m)
        for a in spec.actuators:
            a.forcerange = [d.effort * float(x) for x in a.forcerange]
        if d.mass != 1:
            _weigh(spec, base.model, d.mass)

    out = recompiled(base, perturb)
    return replace(out, home=base.home) if scanned else out  # clear of its pieces


def perturbed_scene(scene: Scene, d: Disturbance) -> Scene:
    """The scene with other heights, tilts, friction and start; tiles aside."""
    boxes = []
    for b in map(_upright, scene.boxes):
        size = b.size + np.array([0.0, 0.0, d.height])
        if size[2] <= 0.01:
            raise InputError(
                f"a box higher than 0.01 m ({b.name} is {b.size[2]:g} m high)",
                field="disturb.height",
                value=d.height,
            )
        up = b.rotation[:, 2]
        centre = b.centre + 0.5 * d.height * up
        turn = matrix_from_rpy((d.roll, d.pitch, 0.0))
        turn = b.rotation @ turn @ b.rotation.T
        edge = centre + b.rotation @ (size * [-0.5, 0.0, 0.5])
        boxes.append(
            replace(
                b,
                size=size,
                rotation=turn @ b.rotation,
                centre=edge + turn @ (centre - edge),
                friction=b.friction if d.friction is None else d.friction,
            )
        )
    x, y, yaw = scene.start
    return replace(
        scene,
        boxes=tuple(boxes),
        meshes=tuple(_raised(m, d) for m in scene.meshes),
        ground_friction=scene.ground_friction if d.friction is None else d.friction,
        start=np.array([x + d.x, y + d.y, yaw + d.yaw]),
    )


def _raised(mesh: Mesh, d: Disturbance) -> Mesh:
    """A mesh with another height and friction."""
    up = np.array([0.0, 0.0, d.height])
    mu = mesh.friction if d.friction is None else d.friction
    supports = (
        replace(s, position=s.position + up, friction=mu) for s in mesh.supports
    )
    pieces = tuple(p + up for p in mesh.pieces)
    field = mesh.field
    if field is not None:
        field = replace(field, heights=field.heights + d.height)
    return replace(
        mesh, pieces=pieces, supports=tuple(supports), field=field, friction=mu
    )


def _measured(spec: mujoco.MjSpec, mesh: Mesh) -> None:
    """Put the height field of a mesh in the place of its pieces, with their contact."""
    field = mesh.field
    assert field is not None
    geom = spec.geom(mesh.piece_name(0))
    look = {k: getattr(geom, k) for k in ("priority", "condim")}
    look |= {k: list(getattr(geom, k)) for k in ("friction", "rgba", "solref")}
    for i in range(len(mesh.pieces)):
        spec.delete(spec.geom(mesh.piece_name(i)))
        spec.delete(spec.mesh(mesh.piece_name(i)))
    low = float(field.heights.min())
    rise = max(float(field.heights.max()) - low, 1e-3)
    rows, columns = field.heights.shape
    name = mesh.piece_name(0)
    spec.add_hfield(
        name=name,
        nrow=rows,
        ncol=columns,
        size=[*(field.size / 2), rise, BASE],
        userdata=((field.heights - low) / rise).ravel(),
    )
    spec.worldbody.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_HFIELD,
        hfieldname=name,
        pos=[*field.position, low],
        quat=quat_from_yaw(field.yaw),
        **look,
    )


def _upright(box: Box) -> Box:
    """The same box with its own z axis up, as near as can be."""
    top = box.top
    up = int(np.argmax(np.abs(box.rotation.T @ top.normal)))
    size = box.size[[(up + 1) % 3, (up + 2) % 3, up]]
    return replace(box, rotation=top.rotation, size=size)


def _tile(
    spec: mujoco.MjSpec, box: Box, unevenness: float, rng: np.random.Generator
) -> None:
    """Sink the box to its lowest tile and put tiles on it, without gaps.

    Heights are smoothed white noise: like warped boards, higher here and lower there.
    """
    from scipy.ndimage import gaussian_filter  # slow to import, and rarely needed

    geom = spec.geom(box.name)
    n = np.maximum(np.round(box.size[:2] / TILE), 1).astype(int)
    side = box.size[:2] / n
    off = gaussian_filter(rng.normal(size=n), SWELL / side)
    off *= unevenness / np.abs(off).max()
    depth = min(2.0 * unevenness + 0.02, 0.5 * float(box.size[2]))
    base = box.size[2] - depth
    geom.size = [*(box.size[:2] / 2), base / 2]
    geom.pos = box.centre - box.rotation[:, 2] * depth / 2
    for i in range(n[0]):
        for j in range(n[1]):
            height = max(depth + float(off[i, j]), 0.002)
            local = np.array(
                [
                    (i + 0.5) * side[0] - box.size[0] / 2,
                    (j + 0.5) * side[1] - box.size[1] / 2,
                    -box.size[2] / 2 + base + height / 2,
                ]
            )
            spec.worldbody.add_geom(
                name=f"{box.name}_tile_{i}_{j}",
                type=mujoco.mjtGeom.mjGEOM_BOX,
                size=[*(side / 2), height / 2],
                pos=box.centre + box.rotation @ local,
                quat=list(geom.quat),
                friction=list(geom.friction),
                rgba=list(geom.rgba),
                priority=geom.priority,
                solref=list(geom.solref),
                condim=geom.condim,
            )


def _weigh(spec: mujoco.MjSpec, model: mujoco.MjModel, factor: float) -> None:
    """Multiply masses and inertias of all bodies."""
    for body in spec.bodies:
        b = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, body.name)
        if b <= 0 or model.body_mass[b] == 0:
            continue
        body.explicitinertial = True
        body.mass = factor * float(model.body_mass[b])
        body.ipos = model.body_ipos[b]
        body.iquat = model.body_iquat[b]
        body.inertia = factor * model.body_inertia[b]
        body.fullinertia = np.full(6, np.nan)


def push_of(d: Disturbance, duration: float) -> np.ndarray | None:
    """(N, 3) force on the pelvis [N] for each physics step; None where there is none.

    Args:
        d: With the force, and the seed of its time and direction.
        duration: Of the motion [s].
    """
    if d.push == 0:
        return None
    rng = np.random.default_rng([d.seed, 3])
    last = max(duration - PUSH_TIME - PUSH_MARGIN, PUSH_MARGIN)
    begin = round(rng.uniform(PUSH_MARGIN, last) / PHYSICS_STEP)
    angle = rng.uniform(0.0, 2.0 * np.pi)
    out = np.zeros((begin + round(PUSH_TIME / PHYSICS_STEP), 3))
    out[begin:] = d.push * np.array([np.cos(angle), np.sin(angle), 0.0])
    return out
