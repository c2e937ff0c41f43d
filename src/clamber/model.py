"""Robot and world: one MuJoCo model serves planning and physics.

A `Robot` is a description (MJCF or URDF) with what a planner must know beyond it: which
geoms are surfaces, which chain is a limb, where it stands at the start. `World` is
robot and scene compiled together; `Kinematics` is a configuration of it for which
forward kinematics have been run.

Shapes: nq, nv of the world's model; na actuated joints; the first 7 of `q` and 6 of `v`
are the floating base.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Literal

import mujoco
import numpy as np
import pydantic

from clamber.description import Description, compile_description, read_description
from clamber.errors import InputError
from clamber.scene import GROUND, Scene, Support, input_error, read_yaml
from clamber.se3 import matrix_from_quat, rotation_vector

ROBOTS = Path(__file__).parent / "robots"
LIMBS = ("left_arm", "right_arm", "left_leg", "right_leg")
PHYSICS_STEP = 0.001  # [s]
SOLREF = (0.005, 1.0)  # contacts of supports: time constant [s], damping ratio
IMPRATIO = 10.0  # friction stiffer than normal force: no creep while standing
BENDS = (1.0, 0.75, 0.5, 0.25)  # shares of home's bend that legs stand with
LOOK_RANGE = 0.12  # [m] to which distances are looked at, to know when to look again
ROUNDING = 1e-6  # [m] by which squared distances may be wrong, near 0
FEW_PAIRS = 40  # that are quicker looked at than bounded
_YZX, _ZXY = np.array([1, 2, 0]), np.array([2, 0, 1])
_ONES = np.ones(9)
CLEAR = 0.002  # [m] that they keep from boxes at the start
DEFAULT_ARMATURE = 0.05  # [kg m^2] where the description has none
DEFAULT_DAMPING = 3.0  # [N m s/rad] where the description has none


class _Strict(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(extra="forbid")


class LimbFile(_Strict):
    """One of `limbs` of a robot file: landmarks are bodies, else geoms."""

    root: str
    middle: str
    end: str
    surfaces: list[str]


class GainsFile(_Strict):
    """Joint gains: [N m/rad], [N m s/rad], [N m/(rad s)]."""

    kp: float = pydantic.Field(default=600.0, gt=0)
    kd: float = pydantic.Field(default=20.0, ge=0)
    ki: float = pydantic.Field(default=9.0, ge=0)


class ImpedanceFile(_Strict):
    """Stiffness and damping of a compliant joint: [N m/rad], [N m s/rad]."""

    kp: float = pydantic.Field(gt=0)
    kd: float = pydantic.Field(ge=0)


class RobotFile(_Strict):
    """A robot as a person writes it (`robot.yaml`)."""

    version: int = 1
    name: str
    model: str
    base: str
    home: dict[str, float] = {}
    limbs: dict[Literal["left_arm", "right_arm", "left_leg", "right_leg"], LimbFile]
    surfaces: dict[str, str] = {}
    effort: dict[str, Annotated[float, pydantic.Field(gt=0)]] = {}
    gains: dict[str, GainsFile] = {"default": GainsFile()}
    impedance: dict[str, ImpedanceFile] = {}
    self_positioning: list[str] = []


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Limb:
    """A chain with its surfaces; `root` is the mass that its contacts support."""

    name: str
    root: str
    middle: str
    end: str
    surfaces: tuple[str, ...]

    @property
    def is_arm(self) -> bool:
        """Arms carry the shoulders, legs the hips."""
        return self.name.endswith("arm")


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Robot:
    """A humanoid as its files describe it.

    Attributes:
        path: The MJCF or URDF file.
        base: Name of the pelvis body.
        home: Joint angles of the posture it starts from [rad].
        limbs: By name, from `LIMBS`.
        prefixes: Prefix of the geom names of each surface.
        effort: Largest torque [N m] of joints whose description has none, or another.
        gains: (kp, kd, ki) by joint name, and `default`.
        impedance: (kp, kd) of the joints that mixed control makes compliant (4.31).
        self_positioning: Joints that follow their terrain while the arms bear load
            (4.32): the ankles.
    """

    name: str
    path: Path
    base: str
    home: Mapping[str, float]
    limbs: Mapping[str, Limb]
    prefixes: Mapping[str, str]
    gains: Mapping[str, tuple[float, float, float]]
    effort: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    impedance: Mapping[str, tuple[float, float]] = field(
        default_factory=lambda: MappingProxyType({})
    )
    self_positioning: tuple[str, ...] = ()

    @property
    def surfaces(self) -> tuple[str, ...]:
        """Names of all surfaces, limb by limb."""
        return tuple(s for limb in self.limbs.values() for s in limb.surfaces)

    def limb_of(self, surface: str) -> Limb:
        """The limb that bears a surface."""
        for limb in self.limbs.values():
            if surface in limb.surfaces:
                return limb
        raise KeyError(f"no surface {surface!r}; there are {list(self.surfaces)}")


def load_robot(name_or_path: str | Path) -> Robot:
    """Read a built-in robot by name, or a `robot.yaml`.

    Raises:
        InputError: No such robot, or a field of its file cannot be used.
    """
    path = Path(name_or_path)
    if not path.suffix:
        known = sorted(p.parent.name for p in ROBOTS.glob("*/robot.yaml"))
        if str(name_or_path) not in known:
            raise InputError(
                f"a robot.yaml, or one of {', '.join(known)}",
                source="--robot",
                value=str(name_or_path),
            )
        path = ROBOTS / str(name_or_path) / "robot.yaml"
    elif path.suffix not in (".yaml", ".yml"):
        raise InputError(
            "a robot.yaml beside the model, which names its limbs and surfaces",
            source="--robot",
            value=str(path),
        )
    try:
        file = RobotFile.model_validate(read_yaml(path))
    except pydantic.ValidationError as e:
        raise input_error(e, path) from e
    missing = set(LIMBS) - set(file.limbs)
    if missing:
        raise InputError(
            "all four limbs", source=path, field="limbs", value=sorted(missing)
        )
    model_path = path.parent / file.model
    if not model_path.is_file():
        raise InputError(
            "an MJCF or URDF file", source=path, field="model", value=file.model
        )
    limbs = {
        n: Limb(
            name=n, root=f.root, middle=f.middle, end=f.end, surfaces=tuple(f.surfaces)
        )
        for n in LIMBS
        for f in (file.limbs[n],)
    }
    gains = {"default": GainsFile(), **file.gains}
    robot = Robot(
        name=file.name,
        path=model_path,
        base=file.base,
        home=dict(file.home),
        limbs=limbs,
        prefixes={
            s: file.surfaces.get(s, s) for limb in limbs.values() for s in limb.surfaces
        },
        effort=dict(file.effort),
        gains={n: (g.kp, g.kd, g.ki) for n, g in gains.items()},
        impedance={n: (g.kp, g.kd) for n, g in file.impedance.items()},
        self_positioning=tuple(file.self_positioning),
    )
    _check(robot, path)
    return robot


def _check(robot: Robot, source: Path) -> None:
    """Compile the robot alone and look up every name that its file mentions."""
    description = read_description(robot.path)
    model = compile_description(description, robot.path)
    bodies = {model.body(i).name for i in range(model.nbody)}
    geoms = {model.geom(i).name for i in range(model.ngeom)}
    joints = {model.joint(i).name for i in range(model.njnt)}
    if robot.base not in bodies:
        raise InputError(
            f"a body of {robot.path.name}",
            source=source,
            field="base",
            value=robot.base,
        )
    named = {
        "home": robot.home,
        "effort": robot.effort,
        "gains": [n for n in robot.gains if n != "default"],
        "impedance": robot.impedance,
        "self_positioning": robot.self_positioning,
    }
    for where, names in named.items():
        for name in names:
            if name not in joints:
                raise InputError(
                    f"a joint of {robot.path.name}",
                    source=source,
                    field=where,
                    value=name,
                )
    _check_joints(robot, model, description, source)
    for limb in robot.limbs.values():
        for place in ("root", "middle", "end"):
            if getattr(limb, place) not in bodies | geoms | set(robot.surfaces):
                raise InputError(
                    f"a body or geom of {robot.path.name}",
                    source=source,
                    field=f"limbs.{limb.name}.{place}",
                    value=getattr(limb, place),
                )
        for s in limb.surfaces:
            if not any(_bears(g, robot.prefixes[s]) for g in geoms):
                raise InputError(
                    f"a surface that geoms of {robot.path.name} bear by the prefix"
                    f" {robot.prefixes[s]!r}",
                    source=source,
                    field=f"limbs.{limb.name}.surfaces",
                    value=s,
                )


def _check_joints(
    robot: Robot, model: mujoco.MjModel, description: Description, source: Path
) -> None:
    """Hinges with effort limits, each on its own, below one floating base."""
    kinds = mujoco.mjtJoint
    for j in range(model.njnt):
        name, kind = model.joint(j).name, kinds(int(model.jnt_type[j]))
        if kind == kinds.mjJNT_FREE:
            owner = model.body(int(model.jnt_bodyid[j])).name
            if owner != robot.base:
                raise InputError(
                    f"the body that floats, {owner}",
                    source=source,
                    field="base",
                    value=robot.base,
                )
            continue
        if kind != kinds.mjJNT_HINGE:
            raise InputError(
                "hinges alone; lock other joints by leaving them out",
                source=robot.path,
                field=f"joint {name!r}",
                value=kind.name.removeprefix("mjJNT_").lower(),
            )
        if name in description.mimics:
            raise InputError(
                "joints that move on their own (it follows"
                f" {description.mimics[name]!r}): leave it out",
                source=robot.path,
                field=f"joint {name!r}",
            )
        if name not in robot.effort and not np.any(model.jnt_actfrcrange[j]):
            raise InputError(
                "its largest torque [N m]: the description has none"
                " (actuatorfrcrange, or a URDF's effort)",
                source=source,
                field=f"effort.{name}",
            )


def _bears(geom: str, prefix: str) -> bool:
    return geom == prefix or geom.startswith(prefix + "_")


def _renamed(robot: Robot, geom: str) -> str:
    """Name that a geom of the description has in the world."""
    for surface, prefix in robot.prefixes.items():
        if prefix != surface and _bears(geom, prefix):
            return surface + geom.removeprefix(prefix)
    return geom


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

    @property
    def is_flat(self) -> bool:
        """A flat surface fixes orientation, a point surface does not."""
        return self.rotation is not None

    def edge(self, i: int) -> Surface:
        """Edge `i` of a flat surface, from corner i to the next, as a surface."""
        ends = self.corners[[i, (i + 1) % len(self.corners)]]
        return replace(self, centre=ends.mean(axis=0), corners=ends)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class World:
    """Robot and scene as one compiled model, with indices and limits.

    Attributes:
        xml: The MJCF text, geoms of surfaces renamed to begin with the surface's name.
        home: (nq,) standing at the scene's start, soles on the ground.
        q_min, q_max: (nv,) joint limits aligned with `v`; infinite for the base.
        v_max: (nv,) speed limits; infinite for the base.
        tau_max: (na,) effort limits; joints: (na,) names.
        qadr, dadr: (na,) indices of the actuated joints in q and v.
        pairs: (P, 2) geom pairs that can meet: robot and scene, robot and itself.
        support_geom: Geom of each support; support_of_geom: the other way, with the
            tiles of an uneven top.
        touching: By surface and support, the pairs that touch in their contact: those
            that plan it, and those of the surface's further geoms.
    """

    model: mujoco.MjModel
    xml: str
    assets: Mapping[str, bytes]
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
    v_max: np.ndarray
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

    def surface(self, name: str, edge: int | None = None) -> Surface:
        """A surface, or one edge of it where it has rolled onto that."""
        return self.surfaces[name] if edge is None else self.edges[name][edge]

    def landmark(self, name: str) -> tuple[int, np.ndarray]:
        """Body id and point (3,) in its frame of a body or, failing that, a geom."""
        b = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_BODY, name)
        if b >= 0:
            return b, np.zeros(3)
        if name in self.surfaces:
            return self.surfaces[name].body, self.surfaces[name].centre
        g = self.model.geom(_renamed(self.robot, name)).id
        return int(self.model.geom_bodyid[g]), self.model.geom_pos[g].copy()


def build_world(robot: Robot, scene: Scene) -> World:
    """Compile robot and scene into one model, the robot standing at the start.

    Actuators of the description are replaced by one joint servo per hinge, saturated at
    its effort limit. Supports have contact priority, so that their friction counts.
    """
    spec = read_description(robot.path).spec
    _prepare_robot(spec, robot)
    spec.option.timestep = PHYSICS_STEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = IMPRATIO
    spec.option.gravity = [0, 0, -9.81]
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 1280, 960
    spec.visual.headlight.ambient = [0.35, 0.35, 0.35]
    spec.visual.quality.shadowsize = 4096
    _add_scene(spec, scene)
    spec.compile()
    xml = spec.to_xml()
    # Written numbers are rounded: plan with what a reader of the file will simulate.
    again = mujoco.MjSpec.from_string(xml)
    again.modelfiledir = str(robot.path.parent)
    model = again.compile()
    return index_world(model, xml, robot, scene)


def _prepare_robot(spec: mujoco.MjSpec, robot: Robot) -> None:
    """Free joint at the pelvis, servos on the hinges, geoms by surfaces' names."""
    for a in list(spec.actuators):
        spec.delete(a)
    for k in list(spec.keys):
        spec.delete(k)
    base = spec.body(robot.base)
    if not any(j.type == mujoco.mjtJoint.mjJNT_FREE for j in base.joints):
        base.add_freejoint(name="root")
    for g in spec.geoms:
        g.name = _renamed(robot, g.name)
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
        width=128,
        height=768,
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
            pos=b.position,
            quat=quat,
            friction=[b.friction, 0.02, 0.001],
            rgba=[0.76, 0.60, 0.42, 1.0],
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
    surfaces = {s: _surface(model, data, s) for s in robot.surfaces}
    pairs = _pairs(model, data, base)
    home = _stand_clear(model, data, robot, scene, home, surfaces, pairs)
    return World(
        model=model,
        xml=xml,
        assets={},
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
        v_max=np.full(model.nv, np.inf),
        kp=gains[:, 0],
        kd=gains[:, 1],
        ki=gains[:, 2],
        pairs=pairs,
        support_geom={s.name: model.geom(s.name).id for s in scene.supports},
        support_of_geom={
            g: s.name
            for s in scene.supports
            for g in range(model.ngeom)
            if model.geom_bodyid[g] == 0
            and (model.geom(g).name == s.name or _bears(model.geom(g).name, s.name))
        },
        supports={s.name: s for s in scene.supports},
        touching={
            (name, s.name): _touching(model, pairs, surface, model.geom(s.name).id)
            for name, surface in surfaces.items()
            for s in scene.supports
        },
        base=base,
        mass=float(model.body_subtreemass[base]),
    )


def _surface(model: mujoco.MjModel, data: mujoco.MjData, name: str) -> Surface:
    """Contact geometry from the geoms that bear the surface's name.

    The geom with the bare name (else the first) is the one that plans: a sphere is a
    point surface, a capsule one at its lower end, a box or any other a flat surface,
    its face the one that looks down at home.
    """
    geoms = [g for g in range(model.ngeom) if _bears(model.geom(g).name, name)]
    main = next((g for g in geoms if model.geom(g).name == name), geoms[0])
    body = int(model.geom_bodyid[main])
    bodies = {int(model.geom_bodyid[g]) for g in geoms}
    if len(bodies) > 1:
        raise InputError(
            "one body for each surface",
            field=name,
            value=sorted(model.body(b).name for b in bodies),
        )
    kind, size = mujoco.mjtGeom(int(model.geom_type[main])), model.geom_size[main]
    p_BG, R_BG = model.geom_pos[main].copy(), matrix_from_quat(model.geom_quat[main])
    R_WB = data.xmat[body].reshape(3, 3)
    if kind in (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE):
        if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
            ends = p_BG + np.outer([-1.0, 1.0], R_BG[:, 2] * size[1])
            p_BG = ends[np.argmin((ends @ R_WB.T)[:, 2])]
        return Surface(
            name=name,
            body=body,
            geoms=tuple(geoms),
            centre=p_BG,
            radius=float(size[0]),
            rotation=None,
            corners=p_BG[None],
        )
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
    return Surface(
        name=name,
        body=body,
        geoms=tuple(geoms),
        centre=centre,
        radius=0.0,
        rotation=R_BG @ R_GC,
        corners=np.array(corners),
    )


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
    low, ankles = np.inf, []
    for name in ends:
        if (b := mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)) >= 0:
            ankles.append(data.xpos[b])
        elif foot := surfaces.get(name):
            R_WB = data.xmat[foot.body].reshape(3, 3)
            ankles.append(data.xpos[foot.body] + R_WB @ foot.centre)
        else:
            ankles.append(data.geom(_renamed(robot, name)).xpos)
    for s in surfaces.values():
        z = data.xpos[s.body] + s.corners @ data.xmat[s.body].reshape(3, 3).T
        low = min(low, float(z[:, 2].min() - s.radius))
    x, y, yaw = scene.start
    c, s = np.cos(yaw), np.sin(yaw)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    mid = np.mean(ankles, axis=0)
    out = home.copy()
    out[:3] = R @ (home[:3] - [mid[0], mid[1], low]) + [x, y, 0.0]
    turn = np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])
    mujoco.mju_mulQuat(out[3:7], turn, home[3:7])
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
    """Geom pairs whose contacts MuJoCo would compute and that are apart at home."""
    robot = model.body_rootid[model.geom_bodyid] == model.body_rootid[base]
    excluded = set(model.exclude_signature.tolist())
    fromto = np.zeros(6)
    out = []
    for a in range(model.ngeom):
        for b in range(a + 1, model.ngeom):
            if not (robot[a] or robot[b]):
                continue
            masks = (model.geom_contype[a] & model.geom_conaffinity[b]) | (
                model.geom_contype[b] & model.geom_conaffinity[a]
            )
            ba, bb = int(model.geom_bodyid[a]), int(model.geom_bodyid[b])
            wa, wb = int(model.body_weldid[ba]), int(model.body_weldid[bb])
            if not masks or wa == wb:
                continue
            if robot[a] and robot[b]:
                parents = (
                    model.body_weldid[model.body_parentid[wa]],
                    model.body_weldid[model.body_parentid[wb]],
                )
                if wb == parents[0] or wa == parents[1]:
                    continue
                lo, hi = min(ba, bb), max(ba, bb)
                if (lo << 16) + hi in excluded or (hi << 16) + lo in excluded:
                    continue
                if mujoco.mj_geomDistance(model, data, a, b, 1.0, fromto) <= 0:
                    continue
            out.append((a, b))
    return np.array(out, dtype=np.int32).reshape(-1, 2)


def _touching(
    model: mujoco.MjModel, pairs: np.ndarray, surface: Surface, support: int
) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the pairs of a surface with a support's geom: planned, further."""
    mine = np.isin(pairs, surface.geoms).any(axis=1)
    here = mine & (pairs == support).any(axis=1)
    main = [g for g in surface.geoms if model.geom(g).name == surface.name]
    planned = np.isin(pairs, main).any(axis=1) | surface.is_flat
    return np.flatnonzero(here & planned), np.flatnonzero(here & ~planned)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Balls:
    """Round surfaces that roll on supports, K of them, to be looked at together.

    Attributes:
        bodies: (K,) ids; centres: (K, 3, 1) in their frames; radii: (K, 1) [m].
        normals: (K, 3) of the supports.
        links: (K, 4) orientation of each link where its contact was taken.
    """

    bodies: np.ndarray
    centres: np.ndarray
    radii: np.ndarray
    normals: np.ndarray
    links: np.ndarray


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Proximity:
    """Pairs nearer than the range asked for.

    Attributes:
        pairs: (m,) indices into `World.pairs`.
        distance: (m,) signed [m].
        normal: (m, 3) from the first geom to the second.
        first, second: (m, 3) nearest points in the world.
    """

    pairs: np.ndarray
    distance: np.ndarray
    normal: np.ndarray
    first: np.ndarray
    second: np.ndarray


def _nearer_than(near: Proximity, reach: float) -> Proximity:
    keep = (near.distance < reach).nonzero()[0]
    return Proximity(
        pairs=near.pairs.take(keep),
        distance=near.distance.take(keep),
        normal=near.normal.take(keep, axis=0),
        first=near.first.take(keep, axis=0),
        second=near.second.take(keep, axis=0),
    )


class Kinematics:
    """A configuration of a world for which forward kinematics have been run.

    The object is a workspace: `update` overwrites it. Jacobians are (3, nv), linear
    velocity of a point in the world.
    """

    def __init__(self, world: World) -> None:
        """Allocate once; `update` fills."""
        m = world.model
        self.world = world
        self.data = mujoco.MjData(m)
        self._jacp = np.zeros((3, m.nv))
        self._jacr = np.zeros((3, m.nv))
        self._fromto = np.zeros((len(world.pairs), 6))
        self._fromto_rows = list(self._fromto)
        self._pairs = world.pairs.tolist()
        self._turn = np.zeros(3)
        # Views of the data: asking for them anew at each use costs more than the use.
        self._xpos = self.data.xpos
        self._xmat = self.data.xmat.reshape(-1, 3, 3)
        self._xquat = self.data.xquat
        self._com = self.data.subtree_com[world.base]
        first, second = world.pairs.T
        self._first, self._second = first, second
        radius = m.geom_rbound.copy()
        self._planes = np.flatnonzero(m.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)
        box = m.geom_type == mujoco.mjtGeom.mjGEOM_BOX
        self._boxes = np.flatnonzero(box & (m.body_weldid[m.geom_bodyid] == 0))
        self._radius, self._spheres = radius, radius[:, None] + radius
        self._size = m.geom_size.copy()
        self._of_pair = first * m.ngeom + second
        # No point moves farther by a turn than the radius times its matrix's 2-norm:
        # the Frobenius norm over the root of two.
        self._swing = radius / np.sqrt(2.0)
        # What is known of each pair's distance, and where the geoms were then.
        self._least = np.full(len(world.pairs), -np.inf)
        self._seen = b"", b""
        self._seen_x, self._seen_R = np.zeros((m.ngeom, 3)), np.zeros((m.ngeom, 9))
        self._geom_x, self._geom_R = self.data.geom_xpos, self.data.geom_xmat
        # What was asked for last, and the answer.
        self._asked: tuple[float, np.ndarray | None] = (-np.inf, None)
        self._near = Proximity(
            pairs=np.zeros(0, dtype=int),
            distance=np.zeros(0),
            normal=np.zeros((0, 3)),
            first=np.zeros((0, 3)),
            second=np.zeros((0, 3)),
        )
        # (nbody, nv): the dofs that move a body.
        self._moves = np.zeros((m.nbody, m.nv))
        for body in range(m.nbody):
            for b in chain_up(m, body):
                first = int(m.body_dofadr[b])
                self._moves[body, first : first + int(m.body_dofnum[b])] = 1.0
        body = m.geom_bodyid[world.pairs]
        self._pair_moves = self._moves[body[:, 1]] - self._moves[body[:, 0]]
        # Motion of the dofs about `_root`, as MuJoCo keeps it.
        self._cdof = self.data.cdof
        self._root = self.data.subtree_com[m.body_rootid[world.base]]
        self._landmarks: dict[str, tuple[int, np.ndarray]] = {}

    def update(self, q: np.ndarray) -> None:
        """Run forward kinematics for `q` (nq,)."""
        d, m = self.data, self.world.model
        d.qpos[:] = q
        mujoco.mj_kinematics(m, d)
        mujoco.mj_comPos(m, d)

    @property
    def q(self) -> np.ndarray:
        """(nq,) a copy of the configuration."""
        return self.data.qpos.copy()

    @property
    def com(self) -> np.ndarray:
        """(3,) centre of mass of the robot in the world."""
        return self._com

    def com_jacobian(self) -> np.ndarray:
        """(3, nv), valid until the next call."""
        mujoco.mj_jacSubtreeCom(
            self.world.model, self.data, self._jacp, self.world.base
        )
        return self._jacp

    def rotation(self, body: int) -> np.ndarray:
        """(3, 3) R_WB."""
        return self._xmat[body]

    def point(self, body: int, p_B: np.ndarray) -> np.ndarray:
        """(..., 3) world position of points (..., 3) of a body."""
        return self._xpos[body] + p_B @ self._xmat[body].T

    def point_jacobian(
        self, body: int, point: np.ndarray, out: np.ndarray | None = None
    ) -> np.ndarray:
        """(3, nv) of the body's point that is at `point` in the world."""
        jac = self._jacp if out is None else out
        mujoco.mj_jac(self.world.model, self.data, jac, None, point, body)
        return jac

    def jacobians(self, body: int, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Linear and angular Jacobian, each (3, nv), valid until the next call."""
        mujoco.mj_jac(self.world.model, self.data, self._jacp, self._jacr, point, body)
        return self._jacp, self._jacr

    def landmark(self, name: str) -> tuple[int, np.ndarray]:
        """Body id and world position (3,) of a landmark."""
        if name not in self._landmarks:
            self._landmarks[name] = self.world.landmark(name)
        body, p = self._landmarks[name]
        return body, self.point(body, p)

    def contact_point(
        self, surface: str, normal: np.ndarray, edge: int | None = None
    ) -> np.ndarray:
        """(3,) the surface's point that touches a support with that normal."""
        s = self.world.surface(surface, edge)
        p = self._xpos[s.body] + self._xmat[s.body] @ s.centre
        return p - s.radius * normal if s.radius else p

    def bearing_points(
        self, surface: str, normal: np.ndarray, edge: int | None = None
    ) -> np.ndarray:
        """(K, 3) the points that bear force on a support with that normal."""
        s = self.world.surface(surface, edge)
        p = self.point(s.body, s.corners)
        return p - s.radius * normal if s.radius else p

    def roll(
        self, surface: str, normal: np.ndarray, link: np.ndarray | None
    ) -> np.ndarray:
        """(3,) how far a round surface's contact has rolled from where its link was.

        For a turn theta of the link, r theta x n: exact about one axis.

        Args:
            surface: Its name.
            normal: (3,) of the support.
            link: (4,) orientation of the link where the contact was taken, or None.
        """
        s = self.world.surfaces[surface]
        if link is None or s.radius == 0.0:
            return np.zeros(3)
        mujoco.mju_subQuat(self._turn, self._xquat[s.body], link)
        x, y, z = (s.radius * (self.rotation(s.body) @ self._turn)).tolist()
        nx, ny, nz = normal.tolist()
        return np.array([y * nz - z * ny, z * nx - x * nz, x * ny - y * nx])

    def rolled(self, balls: Balls) -> tuple[np.ndarray, np.ndarray]:
        """(K, 3) `contact_point` and (K, 3) `roll` of all of them."""
        R, n = self._xmat.take(balls.bodies, axis=0), balls.normals
        turns = np.empty((len(n), 3, 1))
        for turn, body, link in zip(turns, balls.bodies, balls.links, strict=True):
            mujoco.mju_subQuat(turn[:, 0], self._xquat[body], link)
        x = self._xpos.take(balls.bodies, axis=0)
        p = x + (R @ balls.centres)[:, :, 0] - balls.radii * n
        return p, _cross(balls.radii * (R @ turns)[:, :, 0], n)

    def flat_error(self, surface: str, R_WC: np.ndarray) -> np.ndarray:
        """(3,) world rotation vector from the surface's frame to the contact frame."""
        s = self.world.surfaces[surface]
        if s.rotation is None:
            raise ValueError(f"{surface} is a point surface: it has no orientation")
        return rotation_vector(R_WC @ (self._xmat[s.body] @ s.rotation).T)

    def proximity(self, reach: float, active: np.ndarray | None = None) -> Proximity:
        """Pairs nearer than `reach` [m]; `active` (P,) bool restricts them.

        The same array asks for the same pairs: it must not be written to meanwhile.
        A pair is looked at only where neither its bounds nor its last distance, less
        what its geoms have moved since, say that it is farther.
        """
        m, d = self.world.model, self.data
        least, moved = self._least, self._moved()
        if moved is None and active is self._asked[1] and reach <= self._asked[0]:
            return _nearer_than(self._near, reach)
        if moved is not None:
            least -= moved
        idx = self._nearer(reach, active)
        if len(idx) > FEW_PAIRS:
            np.maximum(least, self._gaps(), out=least)
            idx = self._nearer(reach, active)
        far = max(reach, LOOK_RANGE)
        look, pairs = mujoco.mj_geomDistance, self._pairs
        distance = np.array(
            [
                look(m, d, *pairs[i], far, row)
                for i, row in zip(idx.tolist(), self._fromto_rows, strict=False)
            ]
        )
        least.put(idx, distance)
        keep = (distance < reach).nonzero()[0]
        # `take` is four times as fast as an index array.
        distance, idx = distance.take(keep), idx.take(keep)
        p = self._fromto.take(keep, axis=0)
        apart, touching = distance[:, None], (np.abs(distance) < 1e-9).nonzero()[0]
        if len(touching):
            apart = apart.copy()
            apart[touching] = 1.0
        normal = (p[:, 3:] - p[:, :3]) / apart
        for i in touching:
            normal[i] = self._touching_normal(idx[i])
        self._asked = reach, active
        self._near = Proximity(
            pairs=idx,
            distance=distance,
            normal=normal,
            first=p[:, :3],
            second=p[:, 3:],
        )
        return self._near

    def _nearer(self, reach: float, active: np.ndarray | None) -> np.ndarray:
        """Indices of the pairs that may be nearer than `reach` [m]."""
        near = self._least < reach
        if active is not None:
            near &= active
        return near.nonzero()[0]

    def _gaps(self) -> np.ndarray:
        """(P,) what bounding spheres, planes and boxes say that is between pairs."""
        x = self._geom_x - self._root
        square = (x * x) @ _ONES[:3]
        gap = square[:, None] + square - 2.0 * (x @ x.T)
        gap = np.sqrt(np.maximum(gap, 0.0)) - ROUNDING - self._spheres
        for plane in self._planes:
            gap[plane] = gap[:, plane] = x[:, 2] - x[plane, 2] - self._radius
        for box in self._boxes:
            R = self._geom_R[box].reshape(3, 3)
            outside = np.abs((x - x[box]) @ R) - self._size[box]
            outside = np.maximum(outside, 0.0) ** 2
            away = np.sqrt(outside @ _ONES[:3]) - self._radius
            gap[box] = gap[:, box] = away
        return gap.take(self._of_pair)

    def _moved(self) -> np.ndarray | None:
        """(P,) the most that pairs can have come nearer since this was last asked.

        None where nothing has moved.
        """
        seen = self._geom_x.tobytes(), self._geom_R.tobytes()
        if seen == self._seen:
            return None
        self._seen = seen
        x, R = self._geom_x - self._seen_x, self._geom_R - self._seen_R
        way = np.sqrt((x * x) @ _ONES[:3]) + 1e-9
        way += self._swing * np.sqrt((R * R) @ _ONES)
        self._seen_x[:], self._seen_R[:] = self._geom_x, self._geom_R
        return way.take(self._first) + way.take(self._second)

    def distance_jacobian(
        self, pairs: np.ndarray, points: np.ndarray, normals: np.ndarray
    ) -> np.ndarray:
        """(m, nv) how distances change with the configuration.

        The points of a pair lie on one normal, about which turning moves neither
        along it: one wrench serves both, of each body where its dofs move it.

        Args:
            pairs: (m,) indices into `World.pairs`.
            points: (m, 3) on one of the geoms, in the world.
            normals: (m, 3) from the first geom to the second.
        """
        arm = points - self._root
        wrench = np.concatenate([_cross(arm, normals), normals], axis=1)
        return (wrench @ self._cdof.T) * self._pair_moves.take(pairs, axis=0)

    def _touching_normal(self, pair: int) -> np.ndarray:
        """(3,) from the first geom to the second where their distance is zero."""
        a, b = self._first[pair], self._second[pair]
        x, R = self.data.geom_xpos, self.data.geom_xmat
        if a in self._planes:
            return R[a].reshape(3, 3)[:, 2]
        if b in self._planes:
            return -R[b].reshape(3, 3)[:, 2]
        n = x[b] - x[a]
        return n / np.linalg.norm(n)

    def integrate(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """(nq,) `q` moved along the tangent vector `v` (nv,) for unit time."""
        out = q.copy()
        mujoco.mj_integratePos(self.world.model, out, v, 1.0)
        return out

    def difference(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """(nv,) the tangent vector from `a` to `b`."""
        out = np.zeros(self.world.model.nv)
        mujoco.mj_differentiatePos(self.world.model, out, 1.0, a, b)
        return out

    def gravity(self) -> np.ndarray:
        """(nv,) generalised gravity force that joints and contacts must balance."""
        m, d = self.world.model, self.data
        d.qvel[:] = 0.0
        mujoco.mj_comVel(m, d)
        out = np.empty(m.nv)
        mujoco.mj_rne(m, d, 0, out)
        return out


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(m, 3) vector products; `np.cross` costs ten times as much on a few rows."""
    return a.take(_YZX, 1) * b.take(_ZXY, 1) - a.take(_ZXY, 1) * b.take(_YZX, 1)


def limb_lengths(kin: Kinematics) -> dict[str, float]:
    """Segment lengths of the robot by the names of a subject's [m]."""
    out = {}
    for part, names in (
        ("upper_arm", ("root", "middle")),
        ("forearm", ("middle", "end")),
        ("thigh", ("root", "middle")),
        ("shank", ("middle", "end")),
    ):
        limbs = [
            x
            for x in kin.world.robot.limbs.values()
            if x.is_arm == (part in ("upper_arm", "forearm"))
        ]
        ends = [[kin.landmark(getattr(x, n))[1] for n in names] for x in limbs]
        out[part] = float(np.mean([np.linalg.norm(b - a) for a, b in ends]))
    return out
