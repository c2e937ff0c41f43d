"""A description -> a proposal of a robot: `robot.yaml` and a model of plain shapes.

Links keep their frames, masses, inertias and joints. Their collision shapes stay where
they are spheres, capsules, cylinders, boxes; a mesh becomes a capsule as long as it and
of its volume, or a box. Surfaces are added where a person rests on: a ball at the end
of each hand, at each elbow and knee, standing out a little; under each foot the largest
rectangle of its sole. Everything is to be looked at, and corrected, by the user.
"""

from __future__ import annotations

import contextlib
import textwrap
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated
from xml.etree import ElementTree

import mujoco
import numpy as np
import pydantic
import yaml
from scipy.optimize import brentq, least_squares
from scipy.spatial import ConvexHull, QhullError

from clamber.errors import InputError, read_yaml, validated
from clamber.model.description import (
    MESHES,
    Description,
    compile_description,
    read_description,
)
from clamber.model.limbs import (
    DENSEST,
    Anatomy,
    Chain,
    find_limbs,
    geom_points,
    geom_volume,
    hangs_on,
    joint_range,
    link_points,
    links_of,
)
from clamber.model.se3 import matrix_from_quat, quat_from_matrix, rotation_vector

HEAVY = 1.0  # [kg] a link this heavy without collision shape gets one
PAD = 0.006  # [m] balls stand out of their links: the link does not touch before them
FLAT = 0.4  # a mesh flatter than this share of its width becomes a box
SOLE_DEPTH = 0.04  # share of the shank: points this near to the lowest are the sole
NEAR = 0.05  # share of thigh or upper arm: as far past the joint its ball holds all
LEAST_BALL, LARGEST_BALL = 0.12, 0.3  # ... radius at knee and elbow
TOUCHING = 0.02  # [m] links two joints apart that are nearer are not kept apart
ROOM = 0.01  # [m] around links as the robot stands
THINNER = 0.2  # share of its size
KNEE_BEND = 0.9  # [rad] of the nominal posture, or this share of the range:
KNEE_SHARE = 0.5
LESS_BENT = (1.0, 0.9, 0.8, 0.7, 0.6, 0.5)  # ... or less, where an ankle limits it
LEVEL = 2e-3  # [rad] of soles
# Directions of upper arm and forearm of the nominal left arm: x forward, y left.
UPPER_ARM, FOREARM = (-0.355, 0.456, -0.816), (0.737, -0.223, -0.638)
ANKLE_SHARE = 0.5  # of the ankles' effort, at most, that the nominal posture asks for
LIMIT_ROOM = 0.05  # [rad] that the nominal posture keeps from joint limits
# Gains and inertia of a joint by the robot's weight times height, as the built-in
# robot's are.
REFERENCE_MOMENT = 28.9 * 0.512  # [kg m] mass times height of its centre of mass
REFERENCE_INERTIA = 28.9 * 0.512**2  # [kg m^2]
REFERENCE_KP, REFERENCE_KD, REFERENCE_KI = 600.0, 20.0, 9.0
ARMATURE, DAMPING = 0.05, 3.0  # of a joint whose description has none
WEAK = 0.05  # share of weight times height: weaker joints have a light drive
WEAK_KP, WEAK_KD, WEAK_ARMATURE, WEAK_DAMPING = 1 / 3, 0.1, 0.1, 0.01
MAX_ARMATURE, MAX_DAMPING = 0.3, 5.0
COMPLIANT_KP, COMPLIANT_KD = 0.31, 0.8  # of the stiff gains: trunk, knees, elbows
HAND_SHARE = 0.25  # of the weight, that a hand bears for ankles to position themselves
ROUNDING = 1e-6  # share of a moment of inertia
GUESSED_EFFORT = {"leg": 0.8, "trunk": 0.6, "arm": 0.25}  # of weight times thigh
_Efforts = dict[str, Annotated[float, pydantic.Field(gt=0)]]


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Shape:
    """A collision shape in the frame of its link.

    Attributes:
        name: Of the geom.
        link: First body of the link.
        kind: MJCF type.
        size: As MJCF has it.
        position: (3,); quaternion: (4,).
        surface: It is part of a contact surface.
    """

    name: str
    link: int
    kind: str
    size: tuple[float, ...]
    position: np.ndarray
    quaternion: np.ndarray = field(
        default_factory=lambda: np.array([1.0, 0.0, 0.0, 0.0])
    )
    surface: bool = False


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Proposal:
    """What is proposed.

    Attributes:
        name: Of the robot.
        mjcf: Text of its model of plain shapes.
        fields: Of `robot.yaml`.
        guessed: Joints whose effort limit is a guess: the description has none.
        notes: What the user should know, a sentence each.
    """

    name: str
    mjcf: str
    fields: dict
    guessed: tuple[str, ...]
    notes: tuple[str, ...]


def propose_robot(
    path: str | Path, *, effort_from: str | Path | None = None
) -> Proposal:
    """Propose limbs, surfaces, nominal posture, limits and gains of a description.

    Args:
        path: MJCF or URDF.
        effort_from: Where effort limits are that this description lacks: another
            description with the same joint names, or a YAML mapping of joints to N m.

    Raises:
        InputError: It cannot be read, or is no humanoid; see `find_limbs`.
    """
    path = Path(path)
    description = read_description(path, lenient=True)
    model, found, notes = _upright(description, path)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    _check_mimics(model, found, description, path)
    shapes, more = link_shapes(model, data)
    notes += more
    shapes, limbs = _with_surfaces(model, data, found, shapes, path)
    known = {} if effort_from is None else _known_efforts(Path(effort_from))
    effort, guessed = _efforts(model, data, found, known)
    home = nominal_posture(model, found, effort)
    if guessed:
        notes.append(
            f"no effort limit in the description for {len(guessed)} joints: those under"
            " effort are guesses from the robot's weight"
        )
    if found.locked:
        names = ", ".join(model.joint(j).name for j in found.locked)
        notes.append(f"locked at zero, since no limb needs them: {names}")
    overlaps = _overlaps(model, found, shapes, home)
    if overlaps:
        notes.append(
            "links that overlap, or nearly, in the nominal posture are not kept apart: "
            + ", ".join(f"{a} and {b}" for a, b in overlaps)
        )
    shapes, thin = _thinned(model, found, shapes, home, overlaps)
    if thin:
        notes.append(f"thinner, for room beside other links: {', '.join(thin)}")
    gains, drives, impedance = _gains(model, data, found, effort)
    bears = _hand_load(model, data, found, shapes, effort)
    ankles = []
    if bears >= HAND_SHARE * float(model.body_subtreemass[found.base]) * 9.81:
        ankles = [
            model.joint(j).name
            for n in ("left_leg", "right_leg")
            for j in found.limbs[n].joints[found.limbs[n].bend + 1 :]
        ]
    else:
        notes.append(
            f"across its wrists a hand bears {bears:.0f} N: too little for ankles to"
            " give way, so none positions itself"
        )
    name = _plain(path.stem)
    fields = {
        "version": 1,
        "name": name,
        "model": "robot.xml",
        "base": model.body(found.base).name,
        "home": home,
        "limbs": limbs,
        "surfaces": {},
        "effort": effort,
        "gains": gains,
        "impedance": impedance,
        "self_positioning": ankles,
    }
    return Proposal(
        name=name,
        mjcf=_mjcf(name, model, found, shapes, overlaps, drives),
        fields=fields,
        guessed=guessed,
        notes=(*description.notes, *notes),
    )


def _plain(name: str) -> str:
    return "".join(c if c.isalnum() or c in "_-" else "_" for c in name) or "robot"


def _upright(
    description: Description, path: Path
) -> tuple[mujoco.MjModel, Anatomy, list[str]]:
    """The model with a floating base that faces along x at its zero posture."""
    spec, notes = description.spec, []
    for a in list(spec.actuators):  # they are looked at below, in the other model
        if not a.name:
            a.name = f"actuator_{len(notes)}_{a.target}"
    bodies = [b for b in spec.bodies if b.parent is spec.worldbody or _at_root(spec, b)]
    # Of a scene that is not there, or what is worked out anew below.
    for x in [*spec.keys, *spec.pairs, *spec.excludes, *spec.sensors]:
        spec.delete(x)
    free = [j for j in spec.joints if j.type == mujoco.mjtJoint.mjJNT_FREE]
    if not free:
        if len(bodies) != 1:
            raise InputError(
                "one body in the world, the robot",
                source=path,
                field="worldbody",
                value=[b.name for b in bodies],
            )
        held = _release(spec, bodies[0], path)
        bodies[0].add_freejoint(name="root")
        notes.append(f"{bodies[0].name} was {held}: it floats now")
    for i, b in enumerate(spec.bodies):
        if not b.name:
            b.name = f"body_{i}"
    for i, j in enumerate(spec.joints):
        if not j.name:
            j.name = f"joint_{i}"
    spec.compiler.boundmass, spec.compiler.boundinertia = 1e-3, 1e-6
    spec.compiler.balanceinertia = True
    model = compile_description(description, path)
    for b in range(1, model.nbody):
        if model.body_jntnum[b] and model.body_mass[b] <= 1e-3:
            notes.append(
                f"{model.body(b).name} has no inertia in the description: 1 g is taken"
            )
    found = find_limbs(model, path, description.mimics)
    model.qpos0[:] = model.qpos0
    x, y = found.forward[:2]
    if x < 1 - 1e-9:
        turn = np.arctan2(-y, x)
        half = np.array([np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2)])
        start = int(model.jnt_qposadr[model.body_jntadr[found.base]])
        quat = np.zeros(4)
        mujoco.mju_mulQuat(quat, half, model.qpos0[start + 3 : start + 7])
        model.qpos0[start + 3 : start + 7] = quat
        model.body_quat[found.base] = quat
        notes.append(f"turned by {np.degrees(turn):.0f} degrees to face along x")
        found = find_limbs(model, path, description.mimics)
    return model, found, notes


def _release(spec: mujoco.MjSpec, base: mujoco.MjsBody, path: Path) -> str:
    """Take away the joints that a base moves on freely; how it was held, in words."""
    joints = list(base.joints)
    if not joints:
        return "fixed to the world"
    kinds = [j.type for j in joints]
    slide, hinge = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
    if (len(kinds), kinds.count(slide), kinds.count(hinge)) != (6, 3, 3):
        raise InputError(
            "a base that floats, is fixed, or moves on three slides and three hinges",
            source=path,
            field=f"body {base.name!r}",
            value=[j.name for j in joints],
        )
    names = {j.name for j in joints}
    for a in [a for a in spec.actuators if a.target in names]:
        spec.delete(a)
    for j in joints:
        spec.delete(j)
    return "on three slides and three hinges"


def _at_root(spec: mujoco.MjSpec, body: mujoco.MjsBody) -> bool:
    return body.parent is not None and body.parent.name == spec.worldbody.name


def _check_mimics(
    model: mujoco.MjModel, found: Anatomy, description: Description, path: Path
) -> None:
    limbs = {j for c in found.limbs.values() for j in c.joints} | set(found.trunk)
    for j in limbs:
        name = model.joint(j).name
        if name in description.mimics:
            raise InputError(
                "joints of limbs and trunk that move on their own"
                f" (it follows {description.mimics[name]!r})",
                source=path,
                field=f"joint {name!r}",
            )


def robot_yaml(proposal: Proposal) -> str:
    """The text of `robot.yaml`, with what there is to look at as comments."""
    f = proposal.fields
    guessed = set(proposal.guessed)
    effort = [
        f"  {n}: {x:g}" + ("  # a guess" if n in guessed else "")
        for n, x in f["effort"].items()
    ]

    def block(name: str, note: str = "") -> list[str]:
        text = yaml.safe_dump({name: f[name]}, sort_keys=False, width=88)
        return ["", *(f"# {x}" for x in textwrap.wrap(note, 84)), text.rstrip()]

    lines = [
        f"version: {f['version']}",
        *(yaml.safe_dump({k: f[k]}).rstrip() for k in ("name", "model", "base")),
        *block(
            "home",
            "Nominal posture [rad]: soles level under the centre of mass, no limb"
            " straight, hands ready. Joints not named are 0.",
        ),
        *block(
            "limbs",
            "Landmarks are bodies, else geoms; the root is the mass that the contacts"
            " support. Surfaces are the orange geoms of the model.",
        ),
        "",
        "# Largest torque of each joint [N m].",
        "effort:",
        *effort,
        *block(
            "gains",
            "[N m/rad], [N m s/rad], [N m/(rad s)]: those of the built-in robot by"
            " weight times height; weak joints have a light drive.",
        ),
        *block("impedance", "Joints that mixed control makes compliant."),
        *block(
            "self_positioning",
            "Joints that follow their terrain while the arms bear load: ankles.",
        ),
    ]
    return "\n".join(lines) + "\n"


# Shapes.


def link_shapes(
    model: mujoco.MjModel, data: mujoco.MjData
) -> tuple[list[Shape], list[str]]:
    """Collision shapes of all links, and notes on those that had to be made up."""
    links, shapes, notes, thin = links_of(model), [], [], []
    kinds = {
        mujoco.mjtGeom.mjGEOM_SPHERE: ("sphere", 1),
        mujoco.mjtGeom.mjGEOM_CAPSULE: ("capsule", 2),
        mujoco.mjtGeom.mjGEOM_CYLINDER: ("cylinder", 2),
        mujoco.mjtGeom.mjGEOM_ELLIPSOID: ("ellipsoid", 3),
        mujoco.mjtGeom.mjGEOM_BOX: ("box", 3),
    }
    for link in sorted(set(links[1:].tolist())):
        body, mass = model.body(link).name, float(model.body_mass[links == link].sum())
        geoms = np.flatnonzero(links[model.geom_bodyid] == link)
        solid = [g for g in geoms if model.geom_contype[g] or model.geom_conaffinity[g]]
        drawn = [g for g in geoms if g not in solid]
        bulk, seen = (
            sum(geom_volume(model, int(g)) for g in x) for x in (solid, drawn)
        )
        if (solid or mass >= HEAVY) and mass > DENSEST * bulk and seen > bulk:
            points = np.concatenate([geom_points(model, data, int(g)) for g in geoms])
            shapes.append(_around(f"link_{body}_0", link, points, data))
            thin.append(body)
            continue
        for g in solid:
            name = f"link_{body}_{len(shapes)}"
            kind = mujoco.mjtGeom(int(model.geom_type[g]))
            if kind in kinds:
                word, n = kinds[kind]
                p, R = _in_link(data, link, data.geom_xpos[g], data.geom_xmat[g])
                size = tuple(model.geom_size[g, :n].tolist())
                shapes.append(_shape(name, link, word, size, p, R))
            elif kind == mujoco.mjtGeom.mjGEOM_MESH:
                points = geom_points(model, data, int(g))
                shapes.append(_around(name, link, points, data))
        if not solid and mass >= HEAVY:
            shapes.append(_of_inertia(f"link_{body}_0", link, model, data))
            notes.append(f"{body} has no geometry: a box of its inertia is taken")
    if thin:
        notes.append(
            "no collision geometry, or too little for its mass, so that what is seen is"
            f" taken: {', '.join(thin)}"
        )
    return shapes, notes


def _in_link(
    data: mujoco.MjData, link: int, p: np.ndarray, R: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    R_WL = data.xmat[link].reshape(3, 3)
    return R_WL.T @ (p - data.xpos[link]), R_WL.T @ R.reshape(3, 3)


def _shape(
    name: str,
    link: int,
    kind: str,
    size: Sequence[float],
    p: np.ndarray,
    R: np.ndarray,
    surface: bool = False,
) -> Shape:
    return Shape(
        name=name,
        link=link,
        kind=kind,
        size=tuple(float(x) for x in size),
        position=p,
        quaternion=quat_from_matrix(R),
        surface=surface,
    )


def _around(name: str, link: int, points: np.ndarray, data: mujoco.MjData) -> Shape:
    """The capsule as long as the hull of points (K, 3) and of its volume.

    What is flat becomes the box around it instead, along the same principal axes.
    """
    volume = np.inf
    with contextlib.suppress(QhullError):
        hull = ConvexHull(points)
        points, volume = points[hull.vertices], float(hull.volume)
    middle = points.mean(axis=0)
    _, _, axes = np.linalg.svd(points - middle, full_matrices=False)
    local = (points - middle) @ axes.T
    low, high = local.min(axis=0), local.max(axis=0)
    half = np.maximum((high - low) / 2, 1e-3)
    centre = middle + ((low + high) / 2) @ axes
    order = np.argsort(half)[::-1]
    R = axes[order].T
    R[:, 2] = np.cross(R[:, 0], R[:, 1])
    a, b, c = half[order]
    if c < FLAT * b:
        p, R = _in_link(data, link, centre, R)
        return _shape(name, link, "box", (a, b, c), p, R)
    # Half length a and radius r hold pi r^2 (2 (a - r) + 4/3 r), growing up to r = a.
    r = float(np.sqrt(b * c))
    if np.isfinite(volume) and volume < 4 / 3 * np.pi * a**3:
        r = _root(lambda r: np.pi * r**2 * (2 * a - 2 / 3 * r) - volume, 0.0, a)
    R = np.stack([R[:, 1], R[:, 2], R[:, 0]], axis=1)
    p, R = _in_link(data, link, centre, R)
    if a - r < 1e-3:
        return _shape(name, link, "sphere", (r,), p, R)
    return _shape(name, link, "capsule", (r, a - r), p, R)


def _root(f: Callable[[float], float], low: float, high: float) -> float:
    return float(np.asarray(brentq(f, low, high)))


def _of_inertia(
    name: str, link: int, model: mujoco.MjModel, data: mujoco.MjData
) -> Shape:
    """The box with a link's mass and inertia, half as large: geometry is unknown."""
    I, m = model.body_inertia[link], float(model.body_mass[link])
    half = 0.5 * np.sqrt(np.maximum(6.0 * (I.sum() - 2.0 * I) / m, 1e-4))
    p, R = _in_link(data, link, data.xipos[link], data.ximat[link])
    return _shape(name, link, "box", half * 0.7, p, R)


# Surfaces.


def _with_surfaces(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    found: Anatomy,
    shapes: list[Shape],
    source: object,
) -> tuple[list[Shape], dict]:
    """Shapes with those of the surfaces, and `limbs` of the robot's file."""
    links, limbs = links_of(model), {}
    for name, chain in found.limbs.items():
        side = name[0].upper()
        middle, end = int(links[chain.middle]), int(links[chain.end])
        if name.endswith("arm"):
            outer, inner = f"{side}Hand", f"{side}Elbow"
            own = [_hand(outer, model, data, chain, shapes)]
        else:
            outer, inner = f"{side}Foot", f"{side}Knee"
            own = [_sole(outer, model, data, chain, source)]
            shapes = [s for s in shapes if s.link != end]
        own.append(_joint_ball(inner, model, data, chain, shapes))
        prefix = {end: outer, middle: inner}
        shapes = [
            s
            if s.surface or s.link not in prefix
            else Shape(
                name=f"{prefix[s.link]}_{s.name.removeprefix('link_')}",
                link=s.link,
                kind=s.kind,
                size=s.size,
                position=s.position,
                quaternion=s.quaternion,
            )
            for s in shapes
        ] + own
        limbs[name] = {
            "root": model.body(chain.root).name,
            "middle": model.body(chain.middle).name,
            "end": outer if name.endswith("arm") else model.body(chain.end).name,
            "surfaces": [outer, inner],
        }
    order = ("left_arm", "right_arm", "left_leg", "right_leg")
    return shapes, {n: limbs[n] for n in order}


def _points_of(
    shapes: Sequence[Shape], links: Sequence[int], data: mujoco.MjData
) -> np.ndarray:
    """(K, 3) points in the world on the shapes of links."""
    spec = mujoco.MjSpec()
    for s in shapes:
        if s.link in links:
            R_WL = data.xmat[s.link].reshape(3, 3)
            spec.worldbody.add_geom(
                type=_KINDS[s.kind],
                size=[*s.size, 0, 0][:3],
                pos=data.xpos[s.link] + R_WL @ s.position,
                quat=quat_from_matrix(R_WL @ matrix_from_quat(s.quaternion)),
            )
    model = spec.compile()
    alone = mujoco.MjData(model)
    mujoco.mj_kinematics(model, alone)
    points = [geom_points(model, alone, g) for g in range(model.ngeom)]
    return np.concatenate(points) if points else np.zeros((0, 3))


_KINDS = {
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "ellipsoid": mujoco.mjtGeom.mjGEOM_ELLIPSOID,
    "box": mujoco.mjtGeom.mjGEOM_BOX,
}


def _hand(
    name: str,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    chain: Chain,
    shapes: Sequence[Shape],
) -> Shape:
    """A ball at the far end of the hand, fingers and all."""
    links = links_of(model)
    end, elbow = int(links[chain.end]), data.xanchor[chain.joints[chain.bend]]
    hand = [b for b in set(links.tolist()) if hangs_on(model, b, end)]
    points = _points_of(shapes, hand, data)
    if len(points) == 0:
        points = data.xipos[end][None]
    away = np.linalg.norm(points - elbow, axis=1)
    length = float(away.max())
    u = (points[int(np.argmax(away))] - elbow) / length
    along = (points - elbow) @ u
    slab = points[along > along.max() - 0.2 * length]
    across = slab - elbow - ((slab - elbow) @ u)[:, None] * u
    middle = 0.5 * (across.max(axis=0) + across.min(axis=0))
    spread = np.linalg.norm(across - middle, axis=1)
    radius = float(np.clip(np.median(spread), 0.08 * length, 0.16 * length))
    centre = elbow + middle + (float(along.max()) - radius) * u
    tip = points[along > along.max() - radius]
    radius = float(np.linalg.norm(tip - centre, axis=1).max())
    p, _ = _in_link(data, end, centre, np.eye(3))
    return _shape(name, end, "sphere", (radius + PAD,), p, np.eye(3), surface=True)


def _joint_ball(
    name: str,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    chain: Chain,
    shapes: Sequence[Shape],
) -> Shape:
    """A ball around knee or elbow that holds all of the limb past it, on the near side.

    The forearm may be a link of its own, that turns past the elbow and is no part of
    the surface. Then the ball reaches as far as it away from where the limb folds: the
    forearm comes to lie flat.
    """
    links = links_of(model)
    link = int(links[chain.middle])
    past = {int(links[model.jnt_bodyid[j]]) for j in chain.joints[chain.bend :]}
    anchor = data.xanchor[chain.joints[chain.bend]]
    axis = data.xaxis[chain.joints[chain.bend]]
    points = _points_of(shapes, sorted(past), data)
    length = float(np.linalg.norm(data.xpos[chain.root] - anchor))
    on = _far(model, data, chain) - anchor
    reach = max(float(np.linalg.norm(on)), 1e-9)
    on /= reach
    near = points[(points - anchor) @ on < NEAR * length]
    middle, radius = np.zeros(3), LEAST_BALL * length
    if len(near):
        aside = (near - anchor) @ axis
        middle = 0.5 * (aside.max() + aside.min()) * axis
        radius = float(np.linalg.norm(near - anchor - middle, axis=1).max())
    radius = float(np.clip(radius, LEAST_BALL * length, LARGEST_BALL * length))
    beneath = -chain.sign * np.cross(axis, on)
    others = _points_of(shapes, sorted(past - {link}), data) - anchor
    depth = (others[others @ on < 0.5 * reach] @ beneath).max(initial=radius)
    middle = middle + (depth - radius) * beneath
    p, _ = _in_link(data, link, anchor + middle, np.eye(3))
    return _shape(name, link, "sphere", (radius + PAD,), p, np.eye(3), surface=True)


def _far(model: mujoco.MjModel, data: mujoco.MjData, chain: Chain) -> np.ndarray:
    """(3,) middle of the limb's end, away from its knee or elbow."""
    links = links_of(model)
    points = link_points(model, data, int(links[chain.end]), below=True)
    return points.mean(axis=0) if len(points) else data.xipos[chain.end]


def _sole(
    name: str,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    chain: Chain,
    source: object,
) -> Shape:
    """A box whose lower face is the largest rectangle within the sole's outline.

    The sole is level at the zero posture; the rectangle's sides are along and across.
    """
    links = links_of(model)
    end = int(links[chain.end])
    points = link_points(model, data, end, below=True)
    if len(points) < 4:
        raise InputError(
            f"geometry, meshes of {', '.join(MESHES)} included, for its sole",
            source=source,
            field=f"body {model.body(end).name!r}",
        )
    knee = data.xanchor[chain.joints[chain.bend]]
    low = float(points[:, 2].min())
    shank = float(knee[2] - low)
    sole = points[points[:, 2] < low + SOLE_DEPTH * shank, :2]
    try:
        (x0, x1), (y0, y1) = _largest_rectangle(sole)
    except QhullError as e:
        raise InputError(
            "a sole with an area, level at the zero posture",
            source=source,
            field=f"body {model.body(end).name!r}",
        ) from e
    ankle = float(data.xpos[chain.end][2])
    thick = max(0.5 * (ankle - low), 0.1 * (x1 - x0))
    centre = np.array([(x0 + x1) / 2, (y0 + y1) / 2, low + thick / 2])
    p, R = _in_link(data, end, centre, np.eye(3))
    size = ((x1 - x0) / 2, (y1 - y0) / 2, thick / 2)
    return _shape(name, end, "box", size, p, R, surface=True)


def _largest_rectangle(
    points: np.ndarray, steps: int = 24
) -> tuple[tuple[float, float], tuple[float, float]]:
    """X and y range of the largest upright rectangle in the hull of points (K, 2)."""
    hull = ConvexHull(points)
    A, b = hull.equations[:, :2], -hull.equations[:, 2]
    xs = np.linspace(points[:, 0].min(), points[:, 0].max(), steps + 1)
    best, out = -1.0, ((0.0, 0.0), (0.0, 0.0))

    def sides(x: float) -> tuple[float, float]:
        room = b - A[:, 0] * x
        up, down = A[:, 1] > 1e-12, A[:, 1] < -1e-12
        high = float(np.min(room[up] / A[up, 1], initial=np.inf))
        return float(np.max(room[down] / A[down, 1], initial=-np.inf)), high

    at = [sides(float(x)) for x in xs]
    for i in range(len(xs)):
        for j in range(i + 1, len(xs)):
            # The hull is convex: between two sections it is no narrower than both.
            low, high = max(at[i][0], at[j][0]), min(at[i][1], at[j][1])
            area = float(xs[j] - xs[i]) * (high - low)
            if high > low and area > best:
                best, out = area, ((float(xs[i]), float(xs[j])), (low, high))
    return out


# Posture.


def nominal_posture(
    model: mujoco.MjModel, found: Anatomy, effort: dict[str, float]
) -> dict[str, float]:
    """Knees bent, soles level under the centre of mass, hands ready; joint angles.

    Legs are solved for a level foot, abreast of where it is at the zero posture and
    ahead so that the centre of mass is over the middle of the soles, or as near to it
    as leaves ankles half of their effort; arms for the directions of upper arm and
    forearm that the built-in robot has.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    zero = {n: _foot(model, data, c) for n, c in found.limbs.items() if "leg" in n}
    q = model.qpos0.copy()
    for name, chain in found.limbs.items():
        if name.endswith("arm"):
            side = 1.0 if name.startswith("left") else -1.0
            _solve_arm(model, q, chain, side)
    ahead = 0.0
    for _ in range(4):
        for name, chain in found.limbs.items():
            if name.endswith("leg"):
                _solve_leg(model, q, chain, zero[name], ahead)
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        middle = np.mean(
            [_foot(model, data, found.limbs[n])[0][0] for n in zero], axis=0
        )
        low, high = _over_ankles(model, data, found, effort)
        ahead += float(data.subtree_com[found.base][0] - np.clip(middle, low, high))
    out = {}
    for name in ("left_arm", "right_arm", "left_leg", "right_leg"):
        for j in found.limbs[name].joints:
            angle = float(q[model.jnt_qposadr[j]])
            if abs(angle) > 5e-4:
                out[model.joint(j).name] = round(angle, 4)
    return out


def _over_ankles(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    found: Anatomy,
    effort: dict[str, float],
) -> tuple[float, float]:
    """How far back and ahead ankles hold the centre of mass with half of their effort.

    [m] along x; each leg bears half of the weight.
    """
    weight = 9.81 * float(model.body_subtreemass[found.base])
    low, high = -np.inf, np.inf
    for chain in (c for n, c in found.limbs.items() if n.endswith("leg")):
        for j in chain.joints[chain.bend + 1 :]:
            torque = ANKLE_SHARE * effort[model.joint(j).name]
            reach = torque / (0.5 * weight * max(abs(float(data.xaxis[j, 1])), 1e-9))
            x = float(data.xanchor[j, 0])
            low, high = max(low, x - reach), min(high, x + reach)
    return low, high


def _foot(
    model: mujoco.MjModel, data: mujoco.MjData, chain: Chain
) -> tuple[np.ndarray, np.ndarray]:
    """Middle of the sole's points (3,), and the foot's rotation (3, 3)."""
    end = int(links_of(model)[chain.end])
    points = link_points(model, data, end, below=True)
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    return middle, data.xmat[end].reshape(3, 3).copy()


def _bounds(
    model: mujoco.MjModel, joints: Sequence[int]
) -> tuple[np.ndarray, np.ndarray]:
    ranges = np.array([joint_range(model, j) for j in joints])
    room = np.minimum(LIMIT_ROOM, 0.25 * (ranges[:, 1] - ranges[:, 0]))
    return ranges[:, 0] + room, ranges[:, 1] - room


def _solve_leg(
    model: mujoco.MjModel,
    q: np.ndarray,
    chain: Chain,
    zero: tuple[np.ndarray, np.ndarray],
    ahead: float,
) -> None:
    """Put a leg's angles into `q`: foot level, the knee bent as far as that lets."""
    data = mujoco.MjData(model)
    knee = chain.joints[chain.bend]
    low, high = joint_range(model, knee)
    room = (high if chain.sign > 0 else -low) * KNEE_SHARE
    free = [j for j in chain.joints if j != knee]
    address = model.jnt_qposadr[free]
    lo, hi = _bounds(model, free)

    def tilt(R: np.ndarray) -> np.ndarray:
        return rotation_vector(R @ zero[1].T)

    def error(x: np.ndarray) -> np.ndarray:
        data.qpos[:] = q
        data.qpos[address] = x
        mujoco.mj_kinematics(model, data)
        middle, R = _foot(model, data, chain)
        place = 10.0 * (middle[:2] - zero[0][:2] - [ahead, 0.0])
        return np.concatenate([place, 5.0 * tilt(R), 0.01 * x])

    x = start = np.clip(q[address], lo, hi)
    for less in LESS_BENT:
        q[model.jnt_qposadr[knee]] = less * chain.sign * min(KNEE_BEND, room)
        x = least_squares(error, start, bounds=(lo, hi)).x
        error(x)
        if np.linalg.norm(tilt(_foot(model, data, chain)[1])) < LEVEL:
            break
    q[address] = x


def _solve_arm(model: mujoco.MjModel, q: np.ndarray, chain: Chain, side: float) -> None:
    data = mujoco.MjData(model)
    mirror = np.array([1.0, side, 1.0])
    upper, fore = np.array(UPPER_ARM) * mirror, np.array(FOREARM) * mirror
    elbow = chain.joints[chain.bend]
    address = model.jnt_qposadr[list(chain.joints)]
    lo, hi = _bounds(model, chain.joints)
    wrist = np.arange(len(chain.joints)) > chain.bend

    def error(x: np.ndarray) -> np.ndarray:
        data.qpos[:] = q
        data.qpos[address] = x
        mujoco.mj_kinematics(model, data)
        shoulder, at = data.xpos[chain.root], data.xanchor[elbow]
        far = _far(model, data, chain)
        a = (at - shoulder) / np.linalg.norm(at - shoulder)
        b = (far - at) / np.linalg.norm(far - at)
        return np.concatenate([a - upper, b - fore, np.where(wrist, 0.3, 0.03) * x])

    starts = [np.clip(np.zeros(len(lo)), lo, hi)]
    bent = starts[0].copy()
    bent[chain.bend] = np.clip(chain.sign * 1.5, lo[chain.bend], hi[chain.bend])
    solved = [least_squares(error, s, bounds=(lo, hi)) for s in (*starts, bent)]
    q[address] = min(solved, key=lambda s: s.cost).x


# Limits and gains.


def _known_efforts(path: Path) -> dict[str, float]:
    """Effort limits by joint of a YAML mapping or of another description."""
    if path.suffix in (".yaml", ".yml", ".json"):
        return validated(_Efforts, read_yaml(path), path)
    description = read_description(path, lenient=True)
    description.spec.compiler.boundmass = 1e-3
    description.spec.compiler.boundinertia = 1e-6
    model = compile_description(description, path)
    limits = {model.joint(j).name: effort_of(model, j) for j in range(model.njnt)}
    return {n: x for n, x in limits.items() if x is not None}


def _efforts(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    found: Anatomy,
    known: dict[str, float],
) -> tuple[dict[str, float], tuple[str, ...]]:
    """Largest torque of each joint [N m], and the joints for which it is a guess."""
    mass = float(model.body_subtreemass[found.base])
    leg = found.limbs["left_leg"]
    thigh = float(np.linalg.norm(data.xpos[leg.root] - data.xpos[leg.middle]))
    out, guessed = {}, []
    for j in _moving(found):
        limit = known.get(model.joint(j).name, effort_of(model, j))
        if limit is None:
            part = next(
                (n.split("_")[1] for n, c in found.limbs.items() if j in c.joints),
                "trunk",
            )
            limit = GUESSED_EFFORT[part] * mass * 9.81 * thigh
            guessed.append(model.joint(j).name)
        out[model.joint(j).name] = float(f"{limit:.4g}")
    return out, tuple(guessed)


def _moving(found: Anatomy) -> list[int]:
    """Ids of the joints that stay, in the order of the model."""
    return sorted({j for c in found.limbs.values() for j in c.joints} | {*found.trunk})


def effort_of(model: mujoco.MjModel, joint: int) -> float | None:
    """Largest torque of a joint by its description [N m]; None where it has none."""
    found = []
    if model.jnt_actfrclimited[joint]:
        found.append(float(np.abs(model.jnt_actfrcrange[joint]).max()))
    for a in range(model.nu):
        if (
            model.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_JOINT
            and model.actuator_trnid[a, 0] == joint
        ):
            gear = abs(float(model.actuator_gear[a, 0]))
            if model.actuator_forcelimited[a]:
                found.append(gear * float(np.abs(model.actuator_forcerange[a]).max()))
            elif (
                model.actuator_ctrllimited[a]
                and model.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_NONE
            ):
                gain = abs(float(model.actuator_gainprm[a, 0]))
                found.append(
                    gear * gain * float(np.abs(model.actuator_ctrlrange[a]).max())
                )
    found = [x for x in found if x > 0]
    return min(found) if found else None


def _hand_load(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    found: Anatomy,
    shapes: list[Shape],
    effort: dict[str, float],
) -> float:
    """What each hand bears whichever way it is turned about its wrists [N]."""
    balls = {s.name: s for s in shapes if s.surface}
    out = np.inf
    for name, chain in found.limbs.items():
        if not name.endswith("arm"):
            continue
        ball = balls[f"{name[0].upper()}Hand"]
        p = data.xpos[ball.link] + data.xmat[ball.link].reshape(3, 3) @ ball.position
        for j in chain.joints[chain.bend + 1 :]:
            arm = np.cross(data.xaxis[j], p - data.xanchor[j])
            lever = max(float(np.linalg.norm(arm)), ball.size[0])
            out = min(out, effort[model.joint(j).name] / lever)
    return float(out)


def _two_digits(x: float) -> float:
    return float(f"{x:.2g}")


def _gains(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    found: Anatomy,
    effort: dict[str, float],
) -> tuple[dict, dict[int, tuple[float, float]], dict]:
    """Gains, (armature, damping) where the description has none, impedances."""
    mujoco.mj_comPos(model, data)
    mass = float(model.body_subtreemass[found.base])
    lowest = min(
        float(link_points(model, data, int(links_of(model)[c.end]))[:, 2].min())
        for n, c in found.limbs.items()
        if n.endswith("leg")
    )
    height = float(data.subtree_com[found.base][2]) - lowest
    stiff = mass * height / REFERENCE_MOMENT
    inertia = mass * height**2 / REFERENCE_INERTIA
    kp = REFERENCE_KP * stiff
    kd = REFERENCE_KD * np.sqrt(stiff * inertia)
    ki = REFERENCE_KI * stiff
    gains = {
        "default": {
            "kp": _two_digits(kp),
            "kd": _two_digits(kd),
            "ki": _two_digits(ki),
        }
    }
    drives, impedance = {}, {}
    for j in _moving(found):
        weak = effort[model.joint(j).name] < WEAK * mass * 9.81 * height
        if weak:
            gains[model.joint(j).name] = {
                "kp": _two_digits(WEAK_KP * kp),
                "kd": _two_digits(WEAK_KD * kd),
                "ki": _two_digits(WEAK_KD * ki),
            }
        d = int(model.jnt_dofadr[j])
        armature, damping = float(model.dof_armature[d]), float(model.dof_damping[d])
        if armature <= 0:
            armature = ARMATURE * inertia * (WEAK_ARMATURE if weak else 1.0)
            armature = min(_two_digits(armature), MAX_ARMATURE)
        if damping <= 0:
            damping = DAMPING * inertia * (WEAK_DAMPING if weak else 1.0)
            damping = min(_two_digits(damping), MAX_DAMPING)
        drives[j] = (armature, damping)
    soft = [c.joints[c.bend] for c in found.limbs.values()]
    soft += [j for j in found.trunk if abs(float(data.xaxis[j, 1])) < 0.7]
    for j in sorted(soft):
        impedance[model.joint(j).name] = {
            "kp": _two_digits(COMPLIANT_KP * kp),
            "kd": _two_digits(COMPLIANT_KD * kd),
        }
    return gains, drives, impedance


# Writing.


def _near(
    model: mujoco.MjModel, found: Anatomy, shapes: list[Shape], home: dict[str, float]
) -> Iterator[tuple[str, str, str, str, float, bool]]:
    """Pairs of links, their shapes, how far apart these are as the robot stands [m].

    Of neighbours none, of others those nearer than `TOUCHING`; and whether two joints
    are between the links.
    """
    text = _mjcf("trial", model, found, shapes, [], {})
    trial = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(trial)
    for name, angle in home.items():
        data.qpos[trial.joint(name).qposadr[0]] = angle
    mujoco.mj_kinematics(trial, data)
    parent, fromto = trial.body_parentid, np.zeros(6)
    for a in range(trial.ngeom):
        for b in range(a + 1, trial.ngeom):
            i, j = sorted((int(trial.geom_bodyid[a]), int(trial.geom_bodyid[b])))
            if i == j or parent[j] == i:
                continue
            d = mujoco.mj_geomDistance(trial, data, a, b, 1.0, fromto)
            if d < TOUCHING:
                p, q = trial.body(i).name, trial.body(j).name
                two = parent[parent[j]] == i or parent[i] == parent[j]
                yield p, q, trial.geom(a).name, trial.geom(b).name, d, bool(two)


def _overlaps(
    model: mujoco.MjModel, found: Anatomy, shapes: list[Shape], home: dict[str, float]
) -> list[tuple[str, str]]:
    """Names of links that overlap in the nominal posture, neighbours aside.

    Links two joints apart, as in a hip, count when they are nearer than `TOUCHING`:
    they are built around each other, and the shapes stand for more than is there.
    """
    out = {
        (i, j): None
        for i, j, _, _, d, two in _near(model, found, shapes, home)
        if two or d <= 0.0
    }
    return list(out)


def _thinned(
    model: mujoco.MjModel,
    found: Anatomy,
    shapes: list[Shape],
    home: dict[str, float],
    overlaps: Sequence[tuple[str, str]],
) -> tuple[list[Shape], list[str]]:
    """Shapes with `ROOM` around them in the nominal posture, and names of the thinned.

    Links that pass each other by less are built to; whoever plans keeps that room. What
    is no surface gives way, by `THINNER` of its size at most.
    """
    fixed = {s.name for s in shapes if s.surface}
    lack: dict[str, float] = {}
    for i, j, a, b, d, _ in _near(model, found, shapes, home):
        gives = [n for n in (a, b) if n not in fixed]
        if (i, j) in overlaps or d >= ROOM:
            continue
        for n in gives:
            lack[n] = max(lack.get(n, 0.0), (ROOM - d) / len(gives))
    out = []
    for s in shapes:
        n = len(s.size) if s.kind != "capsule" else 1
        less = min(lack.get(s.name, 0.0), THINNER * min(s.size[:n]))
        size = tuple(x - less if k < n else x for k, x in enumerate(s.size))
        out.append(replace(s, size=size))
    return out, sorted(lack)


def _numbers(x: Sequence[float] | np.ndarray) -> str:
    return " ".join(f"{float(v):.9g}" for v in x)


def _mjcf(
    name: str,
    model: mujoco.MjModel,
    found: Anatomy,
    shapes: Sequence[Shape],
    overlaps: Sequence[tuple[str, str]],
    drives: dict[int, tuple[float, float]],
) -> str:
    """The model with its links as bodies, their shapes, and the joints that stay."""
    root = ElementTree.Element("mujoco", model=name)
    ElementTree.SubElement(root, "compiler", angle="radian", autolimits="true")
    default = ElementTree.SubElement(root, "default")
    ElementTree.SubElement(
        default,
        "geom",
        condim="4",
        friction="0.8 0.02 0.001",
        solref="0.005 1",
        rgba="0.82 0.84 0.86 1",
    )
    world = ElementTree.SubElement(root, "worldbody")
    keep = set(_moving(found))
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    # What hangs on a locked joint is part of the link before it.
    links = np.arange(model.nbody)
    for b in range(1, model.nbody):
        joints = range(
            int(model.body_jntadr[b]),
            int(model.body_jntadr[b]) + int(model.body_jntnum[b]),
        )
        if b != found.base and not keep & set(joints):
            links[b] = links[model.body_parentid[b]]
    elements: dict[int, ElementTree.Element] = {0: world}
    for b in range(1, model.nbody):
        if links[b] != b or not hangs_on(model, b, found.base):
            continue
        parent = int(links[model.body_parentid[b]])
        R_WP = data.xmat[parent].reshape(3, 3)
        p = R_WP.T @ (data.xpos[b] - data.xpos[parent])
        R = R_WP.T @ data.xmat[b].reshape(3, 3)
        if b == found.base:
            p = np.array([0.0, 0.0, float(data.xpos[b][2])])
        element = ElementTree.SubElement(
            elements[parent],
            "body",
            name=model.body(b).name,
            pos=_numbers(p),
            quat=_numbers(quat_from_matrix(R)),
        )
        elements[b] = element
        if b == found.base:
            ElementTree.SubElement(element, "freejoint", name="root")
        _add_inertia(element, model, data, b, np.flatnonzero(links == b))
        for j in sorted(keep):
            if model.jnt_bodyid[j] == b:
                _add_joint(element, model, j, drives.get(j))
        for s in shapes:
            if links[s.link] == b:
                _add_shape(element, data, b, s)
    if overlaps:
        contact = ElementTree.SubElement(root, "contact")
        for a, b in overlaps:
            ElementTree.SubElement(contact, "exclude", body1=a, body2=b)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _add_inertia(
    element: ElementTree.Element,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    link: int,
    bodies: np.ndarray,
) -> None:
    """Mass, centre and inertia of all bodies that make up a link."""
    mass = model.body_mass[bodies]
    total = float(mass.sum())
    centre = (mass[:, None] * data.xipos[bodies]).sum(axis=0) / total
    I = np.zeros((3, 3))
    for b, m in zip(bodies, mass, strict=True):
        R, r = data.ximat[b].reshape(3, 3), data.xipos[b] - centre
        I += R @ np.diag(model.body_inertia[b]) @ R.T
        I += m * (float(r @ r) * np.eye(3) - np.outer(r, r))
    # The largest moment of a body is no more than the two others together, also when
    # written in nine digits.
    moments = np.linalg.eigvalsh(I)
    I += max(moments[2] * (1 + ROUNDING) - moments[0] - moments[1], 0.0) * np.eye(3)
    R = data.xmat[link].reshape(3, 3)
    I = R.T @ I @ R
    ElementTree.SubElement(
        element,
        "inertial",
        mass=f"{total:.9g}",
        pos=_numbers(R.T @ (centre - data.xpos[link])),
        fullinertia=_numbers([I[0, 0], I[1, 1], I[2, 2], I[0, 1], I[0, 2], I[1, 2]]),
    )


def _add_joint(
    element: ElementTree.Element,
    model: mujoco.MjModel,
    joint: int,
    drive: tuple[float, float] | None,
) -> None:
    d = int(model.jnt_dofadr[joint])
    armature, damping = drive or (0.0, 0.0)
    fields = {
        "name": model.joint(joint).name,
        "pos": _numbers(model.jnt_pos[joint]),
        "axis": _numbers(model.jnt_axis[joint]),
        "armature": f"{armature:.9g}",
        "damping": f"{damping:.9g}",
    }
    if model.jnt_limited[joint]:
        fields["range"] = _numbers(model.jnt_range[joint])
    if model.dof_frictionloss[d] > 0:
        fields["frictionloss"] = f"{float(model.dof_frictionloss[d]):.9g}"
    ElementTree.SubElement(element, "joint", fields)


def _add_shape(
    element: ElementTree.Element, data: mujoco.MjData, link: int, s: Shape
) -> None:
    R_WS = data.xmat[s.link].reshape(3, 3)
    p = data.xpos[s.link] + R_WS @ s.position
    p, R = _in_link(data, link, p, R_WS @ matrix_from_quat(s.quaternion))
    fields = {
        "name": s.name,
        "type": s.kind,
        "size": _numbers(s.size),
        "pos": _numbers(p),
        "quat": _numbers(quat_from_matrix(R)),
    }
    if s.surface:
        fields["rgba"] = "0.93 0.45 0.13 1"
    ElementTree.SubElement(element, "geom", fields)
