"""Plain shapes for the links of a description, its contact surfaces, and its model.

Collision shapes stay where they are spheres, capsules, cylinders, ellipsoids, boxes; a
mesh becomes a capsule as long as it and of its volume, or a box. Surfaces are added
where a person rests on: a ball at the end of each hand, at each elbow and knee,
standing out a little; under each foot the largest rectangle of its sole.

The model is built anew: links that are fixed to one another become one body, with the
mass, the joints and the plain shapes that planning and physics need and nothing else of
the description. What is seen of a link is kept as it is, and only seen.

Shapes: K points.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import mujoco
import numpy as np
from scipy.optimize import brentq
from scipy.spatial import ConvexHull, QhullError

from clamber.errors import InputError
from clamber.model.description import MESHES, coarser
from clamber.model.facing import sole_points
from clamber.model.limbs import DENSEST, Anatomy
from clamber.model.records import short_repr
from clamber.model.robot import length_scale
from clamber.model.se3 import quat_from_matrix
from clamber.model.tree import Chain, Tree, geom_points, geom_volume

HEAVY = 1.0  # [kg] a link this heavy without collision shape gets one
# [m] of the robot's size, as planning's clearance is:
PAD = 0.006  # balls stand out of their links: the link does not touch before them
TOUCHING = 0.02  # links two joints apart that are nearer are not kept apart
ROOM = 0.01  # around links as the robot stands
FLAT = 0.4  # a mesh flatter than this share of its width becomes a box
NEAR = 0.05  # share of thigh or upper arm: as far past the joint its ball holds all
FOREARM = 0.4  # share of the upper arm: shapes that reach less far are no forearm
LEAST_BALL, LARGEST_BALL = 0.12, 0.3  # ... radius at knee and elbow
MAX_FRICTION = 1.0  # [N m] dry friction of a joint
THINNER = 0.2  # share of its size
ROUNDING = 2e-5  # share of a moment of inertia that is lost where it is written
MESH_FOLDER = "meshes"  # beside the model
MAX_FACES = 50_000  # of a mesh; MuJoCo loads four times as many
SEEN, HIDDEN = 2, 3  # groups of geoms that MuJoCo's viewer shows, and does not
SHELL, ORANGE = (0.82, 0.84, 0.86, 1.0), (0.93, 0.45, 0.13, 1.0)  # links, surfaces
_KINDS = {
    mujoco.mjtGeom.mjGEOM_SPHERE: 1,
    mujoco.mjtGeom.mjGEOM_CAPSULE: 2,
    mujoco.mjtGeom.mjGEOM_CYLINDER: 2,
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: 3,
    mujoco.mjtGeom.mjGEOM_BOX: 3,
}  # and how many numbers are their size
SURFACES = {"arm": ("Hand", "Elbow"), "leg": ("Foot", "Knee")}  # far, near
_SPHERE, _BOX = mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_BOX


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Shape:
    """A collision shape of a link, where it is at the zero posture.

    Attributes:
        name: Of the geom.
        link: First body of the link.
        kind: Of the geom.
        size: As MuJoCo has it.
        position: (3,) in the world; rotation: (3, 3).
        surface: It is part of a contact surface.
    """

    name: str
    link: int
    kind: mujoco.mjtGeom
    size: tuple[float, ...]
    position: np.ndarray
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    surface: bool = False

    __repr__ = short_repr


def link_shapes(tree: Tree) -> tuple[list[Shape], list[str]]:
    """Collision shapes of all links, and notes on those that had to be made up."""
    model, data, links = tree.model, tree.data, tree.links
    shapes, notes, thin = [], [], []
    for link in sorted(set(links[1:].tolist())):
        body, mass = model.body(link).name, float(model.body_mass[links == link].sum())
        geoms = np.flatnonzero(links[model.geom_bodyid] == link).tolist()
        solid = [g for g in geoms if model.geom_contype[g] or model.geom_conaffinity[g]]
        bulk = sum(geom_volume(model, g) for g in solid)
        seen = sum(geom_volume(model, g) for g in geoms if g not in solid)
        if (solid or mass >= HEAVY) and mass > DENSEST * bulk and seen > bulk:
            points = np.concatenate([geom_points(model, data, g) for g in geoms])
            shapes.append(_around(f"link_{body}_0", link, points))
            thin.append(body)
            continue
        for g in solid:
            name = f"link_{body}_{len(shapes)}"
            kind = mujoco.mjtGeom(int(model.geom_type[g]))
            if kind in _KINDS:
                size = model.geom_size[g, : _KINDS[kind]]
                pose = data.geom_xpos[g], data.geom_xmat[g]
                shapes.append(_shape(name, link, kind, size, *pose))
            elif kind == mujoco.mjtGeom.mjGEOM_MESH:
                points = geom_points(model, data, g)
                shapes.append(_around(name, link, points))
        if not solid and mass >= HEAVY:
            shapes.append(_of_inertia(tree, f"link_{body}_0", link))
            notes.append(f"{body} has no geometry: a box of its inertia is taken")
    if thin:
        notes.append(
            "no collision geometry, or too little for its mass: visual geometry is "
            f"taken for {', '.join(thin)}"
        )
    return shapes, notes


def _shape(
    name: str,
    link: int,
    kind: mujoco.mjtGeom,
    size: Sequence[float] | np.ndarray,
    position: np.ndarray,
    rotation: np.ndarray,
) -> Shape:
    return Shape(
        name=name,
        link=link,
        kind=kind,
        size=tuple(float(x) for x in size),
        position=position.copy(),
        rotation=rotation.reshape(3, 3).copy(),
    )


def _around(name: str, link: int, points: np.ndarray) -> Shape:
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
        return _shape(name, link, _BOX, (a, b, c), centre, R)
    # Half length a and radius r hold pi r^2 (2 (a - r) + 4/3 r), growing up to r = a.
    r = float(np.sqrt(b * c))
    if np.isfinite(volume) and volume < 4 / 3 * np.pi * a**3:
        r = _root(lambda r: np.pi * r**2 * (2 * a - 2 / 3 * r) - volume, 0.0, a)
    R = np.stack([R[:, 1], R[:, 2], R[:, 0]], axis=1)
    if a - r < 1e-3:
        return _shape(name, link, _SPHERE, (r,), centre, R)
    kind = mujoco.mjtGeom.mjGEOM_CAPSULE
    return _shape(name, link, kind, (r, a - r), centre, R)


def _root(f: Callable[[float], float], low: float, high: float) -> float:
    return float(np.asarray(brentq(f, low, high)))


def _of_inertia(tree: Tree, name: str, link: int) -> Shape:
    """The box with a link's mass and inertia, half as large: geometry is unknown."""
    I, m = tree.model.body_inertia[link], float(tree.model.body_mass[link])
    half = 0.5 * np.sqrt(np.maximum(6.0 * (I.sum() - 2.0 * I) / m, 1e-4))
    pose = tree.data.xipos[link], tree.data.ximat[link]
    return _shape(name, link, _BOX, half * 0.7, *pose)


# Surfaces.


def with_surfaces(
    tree: Tree, found: Anatomy, shapes: Sequence[Shape]
) -> tuple[list[Shape], dict]:
    """Shapes with those of the surfaces, and `limbs` of the robot's file.

    Raises:
        InputError: A foot has no sole that is level at the zero posture.
    """
    model, limbs, shapes = tree.model, {}, list(shapes)
    pad = PAD * _scale(tree, found)
    for name, chain in found.limbs.items():
        side, arm = name[0].upper(), name.endswith("arm")
        middle, end = int(tree.links[chain.middle]), int(tree.links[chain.end])
        outer, inner = (f"{side}{x}" for x in SURFACES["arm" if arm else "leg"])
        if arm:
            own = [_hand(tree, outer, chain, shapes, pad)]
        else:
            own = [_sole(tree, outer, chain)]
            shapes = [s for s in shapes if not tree.hangs_on(s.link, end)]
        own.append(_joint_ball(tree, inner, chain, shapes, pad))
        prefix = {end: outer, middle: inner}
        shapes = [
            s
            if s.surface or s.link not in prefix
            else replace(s, name=f"{prefix[s.link]}_{s.name.removeprefix('link_')}")
            for s in shapes
        ] + [replace(s, surface=True) for s in own]
        limbs[name] = {
            "root": model.body(chain.root).name,
            "middle": model.body(chain.middle).name,
            "end": outer if arm else model.body(chain.end).name,
            "surfaces": [outer, inner],
        }
    order = ("left_arm", "right_arm", "left_leg", "right_leg")
    return shapes, {n: limbs[n] for n in order}


def _points_of(shapes: Sequence[Shape], links: set[int]) -> np.ndarray:
    """(K, 3) points in the world on the shapes of links."""
    spec = mujoco.MjSpec()
    for s in shapes:
        if s.link in links:
            spec.worldbody.add_geom(
                type=s.kind,
                size=[*s.size, 0, 0][:3],
                pos=s.position,
                quat=quat_from_matrix(s.rotation),
            )
    model = spec.compile()
    alone = mujoco.MjData(model)
    mujoco.mj_kinematics(model, alone)
    points = [geom_points(model, alone, g) for g in range(model.ngeom)]
    return np.concatenate(points) if points else np.zeros((0, 3))


def _scale(tree: Tree, found: Anatomy) -> float:
    leg = found.limbs["left_leg"]
    return length_scale(*(tree.data.xpos[b] for b in (leg.root, leg.middle, leg.end)))


def _ball(name: str, link: int, centre: np.ndarray, radius: float) -> Shape:
    return Shape(name=name, link=link, kind=_SPHERE, size=(radius,), position=centre)


def _hand(
    tree: Tree, name: str, chain: Chain, shapes: Sequence[Shape], pad: float
) -> Shape:
    """A ball at the far end of the hand, fingers and all, that protrudes by `pad`."""
    end, elbow = int(tree.links[chain.end]), tree.data.xanchor[chain.elbow]
    hand = {b for b in tree.links.tolist() if tree.hangs_on(b, end)}
    points = _points_of(shapes, hand)
    least = FOREARM * float(np.linalg.norm(tree.data.xpos[chain.root] - elbow))
    centre = tree.data.xipos[end]
    alone = end == int(tree.links[chain.middle])  # a forearm: its mass is halfway out
    for other in (
        tree.points(end, below=True),
        (centre + alone * (centre - elbow))[None],
    ):
        if np.linalg.norm(points - elbow, axis=1).max(initial=0.0) < least:
            points = other
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
    return _ball(name, end, centre, radius + pad)


def _joint_ball(
    tree: Tree, name: str, chain: Chain, shapes: Sequence[Shape], pad: float
) -> Shape:
    """A ball around knee or elbow that holds all of the limb past it, on the near side.

    The forearm may be a link of its own, that turns past the elbow and is no part of
    the surface. Then the ball reaches as far as it away from where the limb folds: the
    forearm comes to lie flat.
    """
    model, data, links = tree.model, tree.data, tree.links
    link = int(links[chain.middle])
    past = {int(links[model.jnt_bodyid[j]]) for j in chain.joints[chain.bend :]}
    anchor, axis = data.xanchor[chain.elbow], data.xaxis[chain.elbow]
    points = _points_of(shapes, past)
    length = float(np.linalg.norm(data.xpos[chain.root] - anchor))
    on = tree.far(chain) - anchor
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
    others = _points_of(shapes, past - {link}) - anchor
    depth = (others[others @ on < 0.5 * reach] @ beneath).max(initial=radius)
    middle = middle + (depth - radius) * beneath
    return _ball(name, link, anchor + middle, radius + pad)


def _sole(tree: Tree, name: str, chain: Chain) -> Shape:
    """A box whose lower face is the largest rectangle within the sole's outline.

    The sole is level at the zero posture; the rectangle's sides are along and across,
    and it reaches under the ankle where the sole does.
    """
    end = int(tree.links[chain.end])
    where = f"body {tree.model.body(end).name!r}"
    points = tree.points(end, below=True)
    if len(points) < 4:
        expected = f"geometry, meshes of {', '.join(MESHES)} included, for its sole"
        raise InputError(expected, tree.source, where)
    low = float(points[:, 2].min())
    try:
        outline = sole_points(tree, chain)[:, :2]
        (x0, x1), (y0, y1) = _largest_rectangle(outline, tree.data.xpos[chain.end][0])
    except QhullError as e:
        expected = "a sole with an area, level at the zero posture"
        raise InputError(expected, tree.source, where) from e
    ankle = float(tree.data.xpos[chain.end][2])
    thick = max(0.5 * (ankle - low), 0.1 * (x1 - x0))
    centre = np.array([(x0 + x1) / 2, (y0 + y1) / 2, low + thick / 2])
    size = ((x1 - x0) / 2, (y1 - y0) / 2, thick / 2)
    return _shape(name, end, _BOX, size, centre, np.eye(3))


def _largest_rectangle(
    points: np.ndarray, ankle: float, steps: int = 24
) -> tuple[tuple[float, float], tuple[float, float]]:
    """X and y range of the largest upright rectangle in the hull of points (K, 2).

    Its x range holds the ankle's x, where the hull's does.
    """
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
    held = bool(xs[0] <= ankle <= xs[-1])
    for i in range(len(xs)):
        for j in range(i + 1, len(xs)):
            if held and not xs[i] <= ankle <= xs[j]:
                continue
            # The hull is convex: between two sections it is no narrower than both.
            low, high = max(at[i][0], at[j][0]), min(at[i][1], at[j][1])
            area = float(xs[j] - xs[i]) * (high - low)
            if high > low and area > best:
                best, out = area, ((float(xs[i]), float(xs[j])), (low, high))
    return out


# Room between links as the robot stands.


def with_room(
    tree: Tree, found: Anatomy, shapes: Sequence[Shape], home: Mapping[str, float]
) -> tuple[list[Shape], list[tuple[str, str]], list[str]]:
    """Shapes with `ROOM` as clearance in the nominal posture.

    Links that pass each other by less are built to; whoever plans keeps that room. What
    is no surface gives way, by `THINNER` of its size at most, and so do the balls of
    surfaces where they overlap something. Links that overlap by more than that makes
    up for, or by more than `ROOM` without these balls, are not kept apart, and those
    two joints apart, as in a hip, where they are nearer than `TOUCHING`: they are built
    around each other, and the shapes stand for more than is there.

    Returns:
        The shapes, names of links that are not kept apart, and of shapes made thinner.
    """
    scale = _scale(tree, found)
    room, touching = ROOM * scale, TOUCHING * scale
    spec, _ = build_spec("trial", tree, found, shapes, looks=False)
    trial = spec.compile()
    data = mujoco.MjData(trial)
    for name, angle in home.items():
        data.qpos[trial.joint(name).qposadr[0]] = angle
    mujoco.mj_kinematics(trial, data)
    parent, turns, near = trial.body_parentid, trial.body_jntnum, []
    most = {s.name: THINNER * min(s.size[: _sizes(s)]) for s in shapes}
    balls = {s.name for s in shapes if s.surface and s.kind == _SPHERE}
    links_only = {s.name for s in shapes if not s.surface}
    for a in range(trial.ngeom):
        for b in range(a + 1, trial.ngeom):
            i, j = sorted((int(trial.geom_bodyid[a]), int(trial.geom_bodyid[b])))
            if i != j and (parent[j] != i or turns[j] > 2):
                d = mujoco.mj_geomDistance(trial, data, a, b, 1.0, None)
                beside = parent[i] == parent[j]
                joints = turns[j] + turns[i if beside else int(parent[j])]
                two = joints <= 2 and (beside or parent[parent[j]] == i)
                links = trial.body(i).name, trial.body(j).name
                names = trial.geom(a).name, trial.geom(b).name
                gives = [n for n in names if n in links_only]
                deepest = -room
                if d <= 0.0 and balls.intersection(names):
                    gives, deepest = [n for n in names if n in links_only | balls], -1.0
                won = sum(most[n] for n in gives)
                limit = touching if two else min(0.0, max(deepest, room - won))
                near.append((d, limit, links, gives))
    apart = {links: None for d, limit, links, _ in near if d <= limit}
    lack: dict[str, float] = {}
    for d, _, links, gives in near:
        if links not in apart and d < room:
            for n in gives:
                lack[n] = max(lack.get(n, 0.0), (room - d) / len(gives))
    out = []
    for s in shapes:
        less, n = min(lack.get(s.name, 0.0), most[s.name]), _sizes(s)
        size = tuple(x - less if k < n else x for k, x in enumerate(s.size))
        out.append(replace(s, size=size))
    return out, list(apart), sorted(lack)


def _sizes(shape: Shape) -> int:
    """Number of a shape's sizes that are thickness: a capsule keeps its length."""
    return 1 if shape.kind == mujoco.mjtGeom.mjGEOM_CAPSULE else len(shape.size)


# The model.


def build_spec(
    name: str,
    tree: Tree,
    found: Anatomy,
    shapes: Sequence[Shape],
    apart: Sequence[tuple[str, str]] = (),
    drives: Mapping[int, tuple[float, float]] | None = None,
    *,
    looks: bool = True,
) -> tuple[mujoco.MjSpec, dict[str, bytes]]:
    """The model with its links as bodies, their shapes, and the joints that stay.

    Args:
        name: Of the model.
        tree: The description.
        found: Its limbs: other joints are locked at zero.
        shapes: Of its links.
        apart: Names of links that may overlap.
        drives: Armature and damping by joint.
        looks: Whether visual geometry is part of it.

    Returns:
        The spec, and the files of its meshes by name, in `MESH_FOLDER`.
    """
    model, data = tree.model, tree.data
    spec, keep = mujoco.MjSpec(), set(found.moving)
    spec.modelname, spec.meshdir, spec.compiler.degree = name, MESH_FOLDER, False
    # What hangs on a locked joint is part of the link before it.
    links, bodies = np.arange(model.nbody), {}
    for b in range(1, model.nbody):
        if b != found.base and not keep & set(tree.joints(b)):
            links[b] = links[model.body_parentid[b]]
        if links[b] != b or not tree.hangs_on(b, found.base):
            continue
        parent = int(links[model.body_parentid[b]])
        p, R = tree.in_link(parent, data.xpos[b], data.xmat[b])
        if b == found.base:
            p = np.array([0.0, 0.0, float(data.xpos[b][2])])
        on = bodies.get(parent, spec.worldbody)
        bodies[b] = on.add_body(
            name=model.body(b).name, pos=p, quat=quat_from_matrix(R)
        )
        if b == found.base:
            bodies[b].add_freejoint(name="root")
        for j in sorted(keep & set(tree.joints(b))):
            _add_joint(bodies[b], model, j, *(drives or {}).get(j, (0.0, 0.0)))
    files: dict[str, bytes] = {}
    for b, body in bodies.items():
        _set_inertia(body, tree, b, np.flatnonzero(links == b))
        seen = looks and _add_looks(spec, body, tree, b, links, files)
        for s in shapes:
            if links[s.link] == b:
                p, R = tree.in_link(b, s.position, s.rotation)
                body.add_geom(
                    name=s.name,
                    type=s.kind,
                    size=[*s.size, 0, 0][:3],
                    pos=p,
                    quat=quat_from_matrix(R),
                    condim=4,
                    friction=[0.8, 0.02, 0.001],
                    solref=[0.005, 1.0],
                    rgba=ORANGE if s.surface else SHELL,
                    group=HIDDEN if seen and not s.surface else 0,
                )
    for a, b in apart:
        spec.add_exclude(bodyname1=a, bodyname2=b)
    spec.assets = files
    return spec, files


def _set_inertia(
    body: mujoco.MjsBody, tree: Tree, link: int, parts: np.ndarray
) -> None:
    """Mass, centre and inertia of all bodies that make up a link."""
    model, data = tree.model, tree.data
    mass = model.body_mass[parts]
    centre = (mass[:, None] * data.xipos[parts]).sum(axis=0) / mass.sum()
    I = np.zeros((3, 3))
    for b, m in zip(parts, mass, strict=True):
        R, r = data.ximat[b].reshape(3, 3), data.xipos[b] - centre
        I += R @ np.diag(model.body_inertia[b]) @ R.T
        I += m * (float(r @ r) * np.eye(3) - np.outer(r, r))
    # The largest moment of a body is no more than the two others together, also when
    # it is written.
    moments = np.linalg.eigvalsh(I)
    I += max(moments[2] * (1 + ROUNDING) - moments[0] - moments[1], 0.0) * np.eye(3)
    R = data.xmat[link].reshape(3, 3)
    I = R.T @ I @ R
    body.explicitinertial = True
    body.mass, body.ipos = float(mass.sum()), R.T @ (centre - data.xpos[link])
    body.fullinertia = [I[0, 0], I[1, 1], I[2, 2], I[0, 1], I[0, 2], I[1, 2]]


def _add_joint(
    body: mujoco.MjsBody,
    model: mujoco.MjModel,
    joint: int,
    armature: float,
    damping: float,
) -> None:
    added = body.add_joint(
        name=model.joint(joint).name,
        type=mujoco.mjtJoint.mjJNT_HINGE,
        pos=model.jnt_pos[joint],
        axis=model.jnt_axis[joint],
        armature=armature,
        damping=[damping, 0, 0],
        frictionloss=min(
            float(model.dof_frictionloss[model.jnt_dofadr[joint]]), MAX_FRICTION
        ),
    )
    if model.jnt_limited[joint]:
        added.range = model.jnt_range[joint]


def _add_looks(
    spec: mujoco.MjSpec,
    body: mujoco.MjsBody,
    tree: Tree,
    link: int,
    links: np.ndarray,
    files: dict[str, bytes],
) -> bool:
    """Add the visual geometry of a link, else its collision meshes; is there any?"""
    model, data = tree.model, tree.data
    meshes = model.geom_type == mujoco.mjtGeom.mjGEOM_MESH
    solid = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    mine = links[model.geom_bodyid] == link
    seen = np.flatnonzero(mine & ~solid)
    if not meshes[seen].any():
        seen = np.flatnonzero(mine & (~solid | meshes))
    for g in seen.tolist():
        kind = mujoco.mjtGeom(int(model.geom_type[g]))
        if kind not in _KINDS and kind != mujoco.mjtGeom.mjGEOM_MESH:
            continue
        p, R = tree.in_link(link, data.geom_xpos[g], data.geom_xmat[g])
        material = int(model.geom_matid[g])
        rgba = model.geom_rgba[g] if material < 0 else model.mat_rgba[material]
        added = body.add_geom(
            type=kind,
            pos=p,
            quat=quat_from_matrix(R),
            contype=0,
            conaffinity=0,
            group=SEEN,
            rgba=rgba if rgba[:3].any() else SHELL,  # exporters leave black behind
        )
        if kind in _KINDS:
            added.size = model.geom_size[g]
            continue
        added.meshname = _add_mesh(spec, model, int(model.geom_dataid[g]), files)
    return len(seen) > 0


def _add_mesh(
    spec: mujoco.MjSpec, model: mujoco.MjModel, mesh: int, files: dict[str, bytes]
) -> str:
    """Add a mesh once, and its file: STL, which is read everywhere; its name."""
    name = f"{plain(model.mesh(mesh).name)}_{mesh}"
    file = f"{name}.stl"
    if file not in files:
        first, n = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
        begin, m = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
        corners = model.mesh_vert[first : first + n], model.mesh_face[begin : begin + m]
        files[file] = _stl(coarser(*corners, MAX_FACES))
        added = spec.add_mesh(name=name, file=file)
        added.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # may be open
    return name


def _stl(corners: np.ndarray) -> bytes:
    """A binary STL of triangles (F, 3, 3); normals are for whoever reads it."""
    face = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")])
    out = np.zeros(len(corners), dtype=face)
    out["corners"] = corners
    return bytes(80) + np.uint32(len(corners)).tobytes() + out.tobytes()


def plain(name: str) -> str:
    """A name that is safe as that of a file."""
    return "".join(c if c.isalnum() or c in "_-" else "_" for c in name) or "robot"
