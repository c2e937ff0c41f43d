"""A world's constants as the native core takes them: arrays, once for each world."""

from __future__ import annotations

from typing import Any
from weakref import WeakKeyDictionary

import mujoco
import numpy as np

from clamber import _core
from clamber.errors import InputError
from clamber.model.world import World

# The core's kinds of shape, in its order.
SHAPES = (
    mujoco.mjtGeom.mjGEOM_PLANE,
    mujoco.mjtGeom.mjGEOM_SPHERE,
    mujoco.mjtGeom.mjGEOM_CAPSULE,
    mujoco.mjtGeom.mjGEOM_ELLIPSOID,
    mujoco.mjtGeom.mjGEOM_CYLINDER,
    mujoco.mjtGeom.mjGEOM_BOX,
    mujoco.mjtGeom.mjGEOM_MESH,
)
_MODELS: WeakKeyDictionary[World, _core.Model] = WeakKeyDictionary()
_NUMBERS: WeakKeyDictionary[World, tuple[dict[str, int], dict[str, int]]] = (
    WeakKeyDictionary()
)


def core_of(world: World) -> _core.Model:
    """The world's constants in the native core, handed over once."""
    if world not in _MODELS:
        _MODELS[world] = _core.Model(_constants(world))
    return _MODELS[world]


def numbers_of(world: World) -> tuple[dict[str, int], dict[str, int]]:
    """By name, which surface and which support it is to the core."""
    if world not in _NUMBERS:
        surfaces = {name: i for i, name in enumerate(world.surfaces)}
        supports = {name: i for i, name in enumerate(world.supports)}
        _NUMBERS[world] = surfaces, supports
    return _NUMBERS[world]


def _constants(world: World) -> dict[str, Any]:
    m, supports = world.model, list(world.supports)
    kinds, vertices = _shapes(m, world.pairs)
    landmarks = {s: world.landmark(world.robot.limb_of(s).root) for s in world.surfaces}
    return {
        "nq": m.nq,
        "nv": m.nv,
        "base": world.base,
        "mass": world.mass,
        "length_scale": world.length_scale,
        "body_parent": _whole(m.body_parentid),
        "body_pos": _real(m.body_pos),
        "body_quat": _real(m.body_quat),
        "body_mass": _real(m.body_mass),
        "body_ipos": _real(m.body_ipos),
        "body_joint": _whole(m.body_jntadr),
        "body_joints": _whole(m.body_jntnum),
        "joint_kind": _whole(m.jnt_type),
        "joint_body": _whole(m.jnt_bodyid),
        "joint_qadr": _whole(m.jnt_qposadr),
        "joint_dadr": _whole(m.jnt_dofadr),
        "joint_axis": _real(m.jnt_axis),
        "joint_pos": _real(m.jnt_pos),
        "joint_zero": _real(m.qpos0[m.jnt_qposadr]),
        "geom_shape": kinds,
        "geom_body": _whole(m.geom_bodyid),
        "geom_pos": _real(m.geom_pos),
        "geom_quat": _real(m.geom_quat),
        "geom_size": _real(m.geom_size),
        "geom_vertices": vertices,
        "pairs": _whole(world.pairs),
        "supports": [
            {
                "position": _real(s.position),
                "rotation": _real(s.rotation),
                "friction": s.friction,
                "geom": world.support_geom[name],
                "A": _real(s.edges()[0]),
                "b": _real(s.edges()[1]),
            }
            for name, s in world.supports.items()
        ],
        "surfaces": [
            {
                "body": s.body,
                "radius": s.radius,
                "flat": s.is_flat,
                "rotation": _real(np.eye(3) if s.rotation is None else s.rotation),
                "centre": _real(s.centre),
                "corners": _real(s.corners),
                "mass_body": landmarks[name][0],
                "mass_point": _real(landmarks[name][1]),
                "touching": [
                    {"planned": _whole(planned), "further": _whole(further)}
                    for planned, further in (
                        world.touching[name, support] for support in supports
                    )
                ],
            }
            for name, s in world.surfaces.items()
        ],
        "qadr": _whole(world.qadr),
        "dadr": _whole(world.dadr),
        "q_min": _real(world.q_min[world.dadr]),
        "q_max": _real(world.q_max[world.dadr]),
        "tau_max": _real(world.tau_max),
    }


def near_pairs(model: mujoco.MjModel, pairs: np.ndarray) -> _core.Proximity:
    """A workspace that finds which pairs (P, 2) of a model's geoms are near."""
    kinds, vertices = _shapes(model, pairs)
    return _core.Proximity(kinds, model.geom_size, vertices, _whole(pairs))


def _shapes(
    model: mujoco.MjModel, pairs: np.ndarray
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Kinds (ngeom,) of those geoms that are in pairs, and vertices (k, 3) of hulls."""
    kinds = np.zeros(model.ngeom, dtype=np.int32)
    vertices = [np.zeros((0, 3))] * model.ngeom
    for g in np.unique(pairs):
        kind = mujoco.mjtGeom(int(model.geom_type[g]))
        if kind not in SHAPES:
            known = [k.name for k in SHAPES]
            raise InputError("a shape with distances", None, kind.name, known)
        kinds[g] = SHAPES.index(kind)
        if kind == mujoco.mjtGeom.mjGEOM_MESH:
            vertices[g] = _hull(model, int(model.geom_dataid[g]))
    return kinds, vertices


def _hull(model: mujoco.MjModel, mesh: int) -> np.ndarray:
    """(k, 3) vertices of a mesh's convex hull, all of them where it has none."""
    first = model.mesh_vertadr[mesh]
    points = model.mesh_vert[first : first + model.mesh_vertnum[mesh]].astype(float)
    at = int(model.mesh_graphadr[mesh])
    if at < 0:
        return points
    n = int(model.mesh_graph[at])
    return points[model.mesh_graph[at + 2 + n : at + 2 + 2 * n]]


def _real(x: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(x, dtype=float)


def _whole(x: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(x, dtype=np.int32)
