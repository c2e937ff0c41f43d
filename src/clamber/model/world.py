"""Robot and world: one MuJoCo model serves planning and physics.

A `Robot` is a description (MJCF or URDF) with what a planner must know beyond it: which
geoms are surfaces, which chain is a limb, where it stands at the start. `World` is
robot and scene compiled together; `Kinematics` is a configuration of it for which
forward kinematics have been run.

Shapes: nq, nv of the world's model; na actuated joints; the first 7 of `q` and 6 of `v`
are the floating base.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import mujoco
import numpy as np

from clamber.errors import InputError
from clamber.model.arguments import checks_types
from clamber.model.description import read_description
from clamber.model.records import short_repr
from clamber.model.robot import (
    Robot,
    RobotLike,
    has_prefix,
    length_scale,
    load_robot,
    world_name,
)
from clamber.model.scene import GROUND, Mesh, Scene, Support
from clamber.model.se3 import matrix_from_quat, quat_from_yaw
from clamber.model.terrain import SceneLike, load_scene

OBSTACLE = (0.76, 0.60, 0.42, 1.0)  # its colour
PHYSICS_STEP = 0.001  # [s]
SOLREF = (0.005, 1.0)  # contacts of supports: time constant [s], damping ratio
IMPRATIO = 10.0  # friction stiffer than normal force: no creep while standing
NEAR_SUPPORT = 0.25  # [m] a surface in contact with a support touches no farther
UNEVEN = 0.012  # [m] what rises less from a support belongs to it
GENTLE = 1.0  # tangent of the steepest rise beside a support that may be touched
BENDS = (1.0, 0.75, 0.5, 0.25)  # shares of home's bend that legs stand with
CLEAR = 0.002  # [m] that they keep from boxes at the start
FULL_MASS = 20.0  # [kg] of a robot on which 10 N are little
DEFAULT_ARMATURE = 0.05  # [kg m^2] where the description has none
DEFAULT_DAMPING = 3.0  # [N m s/rad] where the description has none


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Surface:
    """Contact geometry of a surface, in the frame of its one body.

    Attributes:
        body: Body id.
        geoms: Ids of all its geoms.
        centre: (3,) point surface: centre of the ball; flat one: middle of the face.
        radius: Radius of the ball; 0 for a flat surface.
        rotation: (3, 3) R_BC of a flat surface in contact: z into the link, x along its
            length; None for a point surface.
        corners: (K, 3) points that can bear force (K = 1 or 4), ball centres or
        corners.
    """

    name: str
    body: int
    geoms: tuple[int, ...]
    centre: np.ndarray
    radius: float
    rotation: np.ndarray | None
    corners: np.ndarray

    __repr__ = short_repr

    @property
    def is_flat(self) -> bool:
        """A flat surface fixes orientation, a point surface does not."""
        return self.rotation is not None

    def edge(self, i: int) -> Surface:
        """Edge `i` of a flat surface, from corner i to the next, as a surface."""
        ends = self.corners[[i, (i + 1) % len(self.corners)]]
        return replace(self, centre=ends.mean(axis=0), corners=ends)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True, weakref_slot=True)
class World:
    """Robot and scene as one compiled model, with indices and limits.

    Attributes:
        model: The compiled model, with the physics time step.
        xml: Its MJCF text; names of a surface's geoms begin with the surface's.
        robot: The robot as its files describe it.
        scene: The scene that it stands in.
        home: (nq,) standing at the scene's start, soles on the ground.
        surfaces: The contact surfaces by name.
        edges: For each flat surface, the four edges that it may roll onto.
        joints: (na,) names of the actuated ones.
        qadr, dadr: (na,) indices of the actuated joints in q and v.
        q_min, q_max: (nv,) joint limits aligned with `v`; infinite for the base.
        tau_max: (na,) effort limits [N m].
        kp, kd, ki: (na,) servo gains [N m/rad], [N m s/rad], [N m/(rad s)].
        pairs: (P, 2) geom pairs that may collide: robot and scene, robot and itself.
        support_geom: Geom id of each support, by name.
        support_of_geom: Support of each geom id, tiles of an uneven top included.
        supports: The supports by name.
        touching: By surface and support, indices of the pairs that touch in that
            contact: those that define it, and those of the surface's further geoms.
        base: Id of the pelvis body.
        mass: Mass of the whole robot [kg].
        length_scale: Factor on planning's clearances and margins, see
            `robot.length_scale`.
    """

    model: mujoco.MjModel
    xml: str
    robot: Robot
    scene: Scene
    home: np.ndarray
    surfaces: Mapping[str, Surface]
    edges: Mapping[str, tuple[Surface, ...]]
    joints: tuple[str, ...]
    qadr: np.ndarray
    dadr: np.ndarray
    q_min: np.ndarray
    q_max: np.ndarray
    tau_max: np.ndarray
    kp: np.ndarray
    kd: np.ndarray
    ki: np.ndarray
    pairs: np.ndarray
    support_geom: Mapping[str, int]
    support_of_geom: Mapping[int, str]
    supports: Mapping[str, Support]
    touching: Mapping[tuple[str, str], tuple[np.ndarray, np.ndarray]]
    base: int
    mass: float
    length_scale: float

    __repr__ = short_repr

    def surface(self, name: str, edge: int | None = None) -> Surface:
        """A surface, or one edge of it where it has rolled onto that."""
        return self.surfaces[name] if edge is None else self.edges[name][edge]

    @property
    def force_scale(self) -> float:
        """Factor on contact-force thresholds: 1, less for robots below `FULL_MASS`."""
        return min(1.0, self.mass / FULL_MASS)

    def landmark(self, name: str) -> tuple[int, np.ndarray]:
        """Body id and point (3,) in its frame of a body or, failing that, a geom."""
        return _landmark(self.model, self.robot, self.surfaces, name)


def _landmark(
    model: mujoco.MjModel, robot: Robot, surfaces: Mapping[str, Surface], name: str
) -> tuple[int, np.ndarray]:
    b = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
    if b >= 0:
        return b, np.zeros(3)
    if name in surfaces:
        return surfaces[name].body, surfaces[name].centre
    g = model.geom(world_name(robot, name)).id
    return int(model.geom_bodyid[g]), model.geom_pos[g].copy()


@checks_types
def build_world(robot: RobotLike, scene: SceneLike) -> World:
    """Compile robot and scene into one model, the robot standing at the start.

    Actuators of the description are replaced by one joint servo per hinge, saturated at
    its effort limit. Supports have contact priority, so that their friction counts.

    Args:
        robot: A robot, its name, or its `robot.yaml`.
        scene: A scene, its file, or the height of one box [m].

    Raises:
        InputError: The robot or the scene cannot be used.
    """
    robot, scene = load_robot(robot), load_scene(scene)
    spec = _prepared(robot).copy()
    spec.option.timestep = PHYSICS_STEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = IMPRATIO
    spec.option.gravity = [0, 0, -9.81]
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 1280, 960
    spec.visual.headlight.ambient = [0.35, 0.35, 0.35]
    spec.visual.quality.shadowsize = 4096
    _add_scene(spec, scene)
    return index_world(*_written(spec, robot), robot, scene)


def recompiled(world: World, edit: Callable[[mujoco.MjSpec], None]) -> World:
    """The world whose model is edited, which stays as it is."""
    return index_world(*_edited(world, edit), world.robot, world.scene)


def with_gains(world: World, gains: Mapping[str, tuple[float, float, float]]) -> World:
    """The world with other servos at some joints: kp, kd and ki by name."""

    def retuned(spec: mujoco.MjSpec) -> None:
        for name, (kp, kd, _) in gains.items():
            spec.actuator(name).set_to_position(kp=kp, kv=kd)

    model, xml = _edited(world, retuned)
    old = zip(world.joints, world.kp, world.kd, world.ki, strict=True)
    kp, kd, ki = np.array([gains.get(name, now) for name, *now in old]).T
    return replace(world, model=model, xml=xml, kp=kp, kd=kd, ki=ki)


def _edited(
    world: World, edit: Callable[[mujoco.MjSpec], None]
) -> tuple[mujoco.MjModel, str]:
    spec = mujoco.MjSpec.from_string(world.xml)
    spec.modelfiledir = str(world.robot.path.parent)
    edit(spec)
    return _written(spec, world.robot)


def _written(spec: mujoco.MjSpec, robot: Robot) -> tuple[mujoco.MjModel, str]:
    """The model of the MJCF that a spec is written as, and that.

    Written numbers are rounded: whoever plans or simulates uses what a reader of the
    file will.
    """
    spec.compile()
    xml = spec.to_xml()
    again = mujoco.MjSpec.from_string(xml)
    again.modelfiledir = str(robot.path.parent)
    return again.compile(), xml


@lru_cache(maxsize=4)
def _prepared(robot: Robot) -> mujoco.MjSpec:
    """Free joint at the pelvis, servos on the hinges, geoms by surfaces' names.

    Kept, since a robot is planned for in many scenes: only to be copied.
    """
    spec = read_description(robot.path).spec
    for a in list(spec.actuators):
        spec.delete(a)
    for k in list(spec.keys):
        spec.delete(k)
    base = spec.body(robot.base)
    if not any(j.type == mujoco.mjtJoint.mjJNT_FREE for j in base.joints):
        base.add_freejoint(name="root")
    for g in spec.geoms:
        g.name = world_name(robot, g.name)
    for j in spec.joints:
        if j.type != mujoco.mjtJoint.mjJNT_HINGE:
            continue
        if np.max(j.armature) <= 0:
            j.armature = DEFAULT_ARMATURE
        if np.max(j.damping) <= 0:
            j.damping = [DEFAULT_DAMPING, 0, 0]
        kp, kd, _ = robot.gains.get(j.name, robot.gains["default"])
        a = spec.add_actuator(name=j.name, target=j.name)
        a.trntype = mujoco.mjtTrn.mjTRN_JOINT
        a.set_to_position(kp=kp, kv=kd)
        limit = float(np.max(np.abs(j.actfrcrange)))
        if j.name in robot.effort:
            limit = robot.effort[j.name]
            j.actfrcrange = [-limit, limit]
            j.actfrclimited = mujoco.mjtLimited.mjLIMITED_TRUE
        a.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
        a.forcerange = [-limit, limit]
    return spec


def _add_scene(spec: mujoco.MjSpec, scene: Scene) -> None:
    """Ground plane, boxes and lights."""
    spec.add_texture(
        name="clamber_ground",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        width=256,
        height=256,
        rgb1=[0.86, 0.87, 0.88],
        rgb2=[0.80, 0.81, 0.83],
    )
    material = spec.add_material(
        name="clamber_ground", texrepeat=[2, 2], texuniform=True
    )
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "clamber_ground"
    spec.add_texture(
        name="clamber_sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        width=32,
        height=192,
        rgb1=[0.93, 0.95, 0.97],
        rgb2=[0.75, 0.80, 0.86],
    )
    world = spec.worldbody
    light = world.add_light(
        pos=[-1.0, -2.0, 4.0], dir=[0.35, 0.5, -1.0], castshadow=True
    )
    light.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    light.diffuse = [0.6, 0.6, 0.6]
    common = {"priority": 1, "solref": [*SOLREF], "condim": 4}
    world.add_geom(
        name=GROUND,
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0, 0, 0.05],
        friction=[scene.ground_friction, 0.02, 0.001],
        material="clamber_ground",
        **common,
    )
    for b in scene.boxes:
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, np.ascontiguousarray(b.rotation).ravel())
        world.add_geom(
            name=b.name,
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=b.size / 2,
            pos=b.centre,
            quat=quat,
            friction=[b.friction, 0.02, 0.001],
            rgba=list(OBSTACLE),
            **common,
        )
    for mesh in scene.meshes:
        for i, piece in enumerate(mesh.pieces):
            name = mesh.piece_name(i)
            asset = spec.add_mesh(name=name, uservert=piece.ravel())
            asset.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
            world.add_geom(
                name=name,
                type=mujoco.mjtGeom.mjGEOM_MESH,
                meshname=name,
                friction=[mesh.friction, 0.02, 0.001],
                rgba=list(OBSTACLE),
                **common,
            )


def index_world(model: mujoco.MjModel, xml: str, robot: Robot, scene: Scene) -> World:
    """The world of a compiled model, everything looked up once.

    Args:
        model: Of `xml`.
        xml: As `build_world` wrote it.
        robot: That is in it.
        scene: That is around it.
    """
    base = model.body(robot.base).id
    hinges = [
        j for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE
    ]
    qadr, dadr = model.jnt_qposadr[hinges].copy(), model.jnt_dofadr[hinges].copy()
    q_min, q_max = np.full(model.nv, -np.inf), np.full(model.nv, np.inf)
    for j in hinges:
        if model.jnt_limited[j]:
            q_min[model.jnt_dofadr[j]], q_max[model.jnt_dofadr[j]] = model.jnt_range[j]
    joints = tuple(model.joint(j).name for j in hinges)
    tau_max = np.array([model.actuator(n).forcerange[1] for n in joints])
    gains = np.array([robot.gains.get(n, robot.gains["default"]) for n in joints])
    data = mujoco.MjData(model)
    home = model.qpos0.copy()
    for name, angle in robot.home.items():
        home[model.joint(name).qposadr[0]] = angle
    data.qpos[:] = home
    mujoco.mj_kinematics(model, data)
    names = [model.geom(g).name for g in range(model.ngeom)]
    surfaces = {s: _surface(model, data, names, s) for s in robot.surfaces}
    pairs = _pairs(model, data, base)
    home = _stand_clear(model, data, robot, scene, home, surfaces, pairs)
    supports, leg = {s.name: s for s in scene.supports}, robot.limbs["left_leg"]
    geoms = _support_geoms(model, scene)
    named = {g: name for name, g in reversed(geoms.items())}
    fixed = np.flatnonzero(model.geom_bodyid == 0).tolist()
    return World(
        model=model,
        xml=xml,
        robot=robot,
        scene=scene,
        home=home,
        surfaces=surfaces,
        edges={
            n: tuple(s.edge(i) for i in range(len(s.corners))) if s.is_flat else ()
            for n, s in surfaces.items()
        },
        joints=joints,
        qadr=qadr,
        dadr=dadr,
        q_min=q_min,
        q_max=q_max,
        tau_max=tau_max,
        kp=gains[:, 0],
        kd=gains[:, 1],
        ki=gains[:, 2],
        pairs=pairs,
        support_geom=geoms,
        support_of_geom={
            g: name for name in supports for g in fixed if has_prefix(names[g], name)
        }
        | named,
        supports=supports,
        touching=_touching(model, scene, pairs, names, surfaces, geoms),
        base=base,
        mass=float(model.body_subtreemass[base]),
        length_scale=length_scale(
            *(
                _place(model, data, robot, surfaces, n)
                for n in (leg.root, leg.middle, leg.end)
            )
        ),
    )


def _surface(
    model: mujoco.MjModel, data: mujoco.MjData, names: Sequence[str], name: str
) -> Surface:
    """Contact geometry from the geoms that bear the surface's name.

    The geom with the bare name (else the first) is the one that plans: a sphere is a
    point surface, a capsule one at its lower end, a box or any other a flat surface,
    its face the one that looks down at home.
    """
    geoms = [g for g, n in enumerate(names) if has_prefix(n, name)]
    main = next((g for g in geoms if names[g] == name), geoms[0])
    body = int(model.geom_bodyid[main])
    bodies = {int(model.geom_bodyid[g]) for g in geoms}
    if len(bodies) > 1:
        several = sorted(model.body(b).name for b in bodies)
        raise InputError("one body for each surface", None, name, several)
    kind, size = mujoco.mjtGeom(int(model.geom_type[main])), model.geom_size[main]
    p_BG, R_BG = model.geom_pos[main].copy(), matrix_from_quat(model.geom_quat[main])
    R_WB = data.xmat[body].reshape(3, 3)
    out = Surface(
        name=name,
        body=body,
        geoms=tuple(geoms),
        centre=p_BG,
        radius=0.0,
        rotation=None,
        corners=p_BG[None],
    )
    if kind in (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE):
        if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
            ends = p_BG + np.outer([-1.0, 1.0], R_BG[:, 2] * size[1])
            p_BG = ends[np.argmin((ends @ R_WB.T)[:, 2])]
        return replace(out, centre=p_BG, radius=float(size[0]), corners=p_BG[None])
    if kind != mujoco.mjtGeom.mjGEOM_BOX:
        p_BG = p_BG + R_BG @ model.geom_aabb[main, :3]
        size = model.geom_aabb[main, 3:]
    down = (R_WB @ R_BG)[2]  # world's z in the geom's frame
    axis = int(np.argmax(np.abs(down)))
    sign = -np.sign(down[axis])  # the outward face looks down
    normal = np.zeros(3)
    normal[axis] = -sign
    rest = [i for i in range(3) if i != axis]
    length = max(rest, key=lambda i: size[i])
    x = np.zeros(3)
    x[length] = np.sign((R_WB @ R_BG)[0, length]) or 1.0
    R_GC = np.stack([x, np.cross(normal, x), normal], axis=1)
    other = next(i for i in rest if i != length)
    half = np.zeros(3)
    half[axis] = sign * size[axis]
    centre = p_BG + R_BG @ half
    corners = []
    for a, b in ((1, 1), (-1, 1), (-1, -1), (1, -1)):
        offset = half.copy()
        offset[length], offset[other] = a * size[length], b * size[other]
        corners.append(p_BG + R_BG @ offset)
    rotation, corners = R_BG @ R_GC, np.array(corners)
    return replace(out, centre=centre, rotation=rotation, corners=corners)


def _place(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    robot: Robot,
    surfaces: Mapping[str, Surface],
    name: str,
) -> np.ndarray:
    """Position of a landmark (3,) [m]."""
    body, point = _landmark(model, robot, surfaces, name)
    if not point.any():
        return data.xpos[body]
    return data.xpos[body] + data.xmat[body].reshape(3, 3) @ point


def _stand(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    robot: Robot,
    scene: Scene,
    home: np.ndarray,
    surfaces: Mapping[str, Surface],
) -> np.ndarray:
    """Put the ankles' midpoint at the start and the soles on the ground."""
    ends = [robot.limbs[n].end for n in ("left_leg", "right_leg")]
    ankles = [_place(model, data, robot, surfaces, n) for n in ends]
    low = np.inf
    for s in surfaces.values():
        z = data.xpos[s.body] + s.corners @ data.xmat[s.body].reshape(3, 3).T
        low = min(low, float(z[:, 2].min() - s.radius))
    x, y, yaw = scene.start
    c, s = np.cos(yaw), np.sin(yaw)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    mid = np.mean(ankles, axis=0)
    out = home.copy()
    out[:3] = R @ (home[:3] - [mid[0], mid[1], low]) + [x, y, 0.0]
    mujoco.mju_mulQuat(out[3:7], quat_from_yaw(yaw), home[3:7])
    return out


def _stand_clear(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    robot: Robot,
    scene: Scene,
    home: np.ndarray,
    surfaces: Mapping[str, Surface],
    pairs: np.ndarray,
) -> np.ndarray:
    """Stand at the start, the legs straighter where bent knees would be in a box.

    Where they are in it even so, the posture is that of `home`.
    """
    fixed = model.body_weldid[model.geom_bodyid] == 0
    plane = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
    boxes = pairs[(fixed & ~plane)[pairs].any(axis=1)]
    legs, fromto = _leg_joints(model, robot, surfaces), np.zeros(6)
    tried = []
    for bend in BENDS:
        bent = home.copy()
        bent[model.jnt_qposadr[legs]] *= bend
        data.qpos[:] = bent
        mujoco.mj_kinematics(model, data)
        posture = _stand(model, data, robot, scene, bent, surfaces)
        data.qpos[:] = posture
        mujoco.mj_kinematics(model, data)
        if all(
            mujoco.mj_geomDistance(model, data, int(a), int(b), CLEAR, fromto) >= CLEAR
            for a, b in boxes
        ):
            return posture
        tried.append(posture)
    return tried[0]


def chain_up(model: mujoco.MjModel, body: int, top: int = 0) -> list[int]:
    """A body and those it hangs on, up to `top` or the world, which are left out."""
    chain = []
    while body not in (0, top):
        chain.append(body)
        body = int(model.body_parentid[body])
    return chain


def limb_links(world: World, surface: str) -> set[int]:
    """Bodies of the limb of a surface, from below its root to its surfaces."""
    limb = world.robot.limb_of(surface)
    root = world.landmark(limb.root)[0]
    out = set()
    for s in limb.surfaces:
        out.update(chain_up(world.model, world.surfaces[s].body, root))
    return out


def _leg_joints(
    model: mujoco.MjModel, robot: Robot, surfaces: Mapping[str, Surface]
) -> list[int]:
    """Hinges between the base and the soles."""
    base, links = model.body(robot.base).id, set()
    for limb in robot.limbs.values():
        if not limb.is_arm:
            links.update(chain_up(model, surfaces[limb.surfaces[0]].body, base))
    return [
        j
        for j in range(model.njnt)
        if int(model.jnt_bodyid[j]) in links
        and model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE
    ]


def _pairs(model: mujoco.MjModel, data: mujoco.MjData, base: int) -> np.ndarray:
    """Geom pairs that can meet and are apart at home.

    Those whose contacts MuJoCo would compute, and links on more than two joints in one
    place, such as a trunk that bends and turns on its pelvis.
    """
    body = model.geom_bodyid
    robot = model.body_rootid[body] == model.body_rootid[base]
    weld = model.body_weldid[body]
    parent = model.body_weldid[model.body_parentid[weld]]
    kind, meets = model.geom_contype, model.geom_conaffinity
    a, b = np.triu_indices(model.ngeom, 1)
    keep = ((kind[a] & meets[b]) | (kind[b] & meets[a])) != 0
    keep &= (robot[a] | robot[b]) & (weld[a] != weld[b])
    field = model.geom_type == mujoco.mjtGeom.mjGEOM_HFIELD  # without distances
    keep &= ~(field[a] | field[b])
    own = robot[a] & robot[b]
    excluded = np.concatenate([model.exclude_signature, [-1]])
    low, high = np.minimum(body[a], body[b]), np.maximum(body[a], body[b])
    few = model.body_jntnum[weld] <= 2
    joined = (few[b] & (parent[b] == weld[a])) | (few[a] & (parent[a] == weld[b]))
    joined |= np.isin((low << 16) + high, excluded)
    joined |= np.isin((high << 16) + low, excluded)
    keep &= ~(own & joined)
    fromto = np.zeros(6)
    out = [
        (i, j)
        for i, j in zip(a[keep].tolist(), b[keep].tolist(), strict=True)
        if not (robot[i] and robot[j])
        or mujoco.mj_geomDistance(model, data, i, j, 1.0, fromto) > 0
    ]
    return np.array(out, dtype=np.int32).reshape(-1, 2)


def _support_geoms(model: mujoco.MjModel, scene: Scene) -> dict[str, int]:
    """The geom of each support, and of each piece of a mesh, by name."""
    names = {s.name: s.name for s in (scene.ground, *(b.top for b in scene.boxes))}
    for m in scene.meshes:
        for s, i in zip(m.supports, m.under, strict=True):
            names[s.name] = m.piece_name(i)
    for m in scene.meshes:
        if _has_field(model, m):
            of_it = (n for n in names if scene.owner(n) == m.name)
            names |= dict.fromkeys(of_it, m.piece_name(0))
        else:
            names |= {n: n for n in map(m.piece_name, range(len(m.pieces)))}
    return {name: model.geom(geom).id for name, geom in names.items()}


def _has_field(model: mujoco.MjModel, mesh: Mesh) -> bool:
    """Whether a mesh is its height field in a model, not its pieces."""
    kind = model.geom_type[model.geom(mesh.piece_name(0)).id]
    return kind == mujoco.mjtGeom.mjGEOM_HFIELD


def _touching(
    model: mujoco.MjModel,
    scene: Scene,
    pairs: np.ndarray,
    names: Sequence[str],
    surfaces: Mapping[str, Surface],
    geoms: Mapping[str, int],
) -> dict[tuple[str, str], tuple[np.ndarray, np.ndarray]]:
    """By surface and support, indices of the pairs that touch: planned, further.

    A support of a mesh goes on in the pieces beside it: those that do not rise from it
    may touch like its own; those that rise gently, like further geoms of the surface.
    """
    index = {(a, b): i for i, (a, b) in enumerate(pairs.tolist())}
    pieces = [
        (m.piece_name(i), p)
        for m in scene.meshes
        for i, p in enumerate(() if _has_field(model, m) else m.pieces)
    ]
    out = {}
    for support in scene.supports:
        own, gentle = [geoms[support.name]], []
        for name, corners in pieces if support.name != GROUND else ():
            rise = _rise(support, corners)
            if geoms[name] != own[0] and rise is not None and rise < GENTLE:
                (own if rise <= 0.0 else gentle).append(geoms[name])
        for name, surface in surfaces.items():
            main = [g for g in surface.geoms if names[g] == surface.name]
            if surface.is_flat:
                main = list(surface.geoms)

            def of(mine: Sequence[int], theirs: Sequence[int]) -> list[int]:
                keys = [(min(a, b), max(a, b)) for a in mine for b in theirs]
                return sorted(index[k] for k in keys if k in index)

            rest = [g for g in surface.geoms if g not in main]
            further = sorted({*of(rest, own), *of(surface.geoms, gentle)})
            out[name, support.name] = (
                np.array(of(main, own), dtype=np.int64),
                np.array(further, dtype=np.int64),
            )
    return out


def _rise(support: Support, piece: np.ndarray) -> float | None:
    """Slope (tangent) at which a piece (K, 3) rises beside a support; None: far off.

    What rises over the support itself is as steep as can be, but for unevenness.
    """
    height = support.height(piece)
    A, b = support.edges()
    beside = (piece @ A.T - b).max(axis=1)
    if beside.min() > NEAR_SUPPORT or height.max() < -NEAR_SUPPORT:
        return None
    over = height - UNEVEN
    if over.max() <= 0.0:
        return 0.0
    return float((over / np.maximum(beside, 1e-9))[over > 0.0].max())
