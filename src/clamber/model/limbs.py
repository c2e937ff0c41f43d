"""Kinematic tree -> limbs: which chains are arms and legs, and how they bend.

A humanoid is told by its symmetry. Limbs are chains that come in pairs, one on either
side of the sagittal plane; the pair that reaches lowest are the legs, the heaviest of
the others the arms. Within a limb, the knee or elbow is the hinge with long levers on
either side. Knees fold the feet backwards, which tells where forward is.

The description stands upright at its zero posture, z up. Links are groups of bodies
that are fixed to one another; a link is named after its first body.

Shapes: nb bodies of the model, K points.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import mujoco
import numpy as np

from clamber.errors import InputError

MIRRORED = 0.05  # share of the height: limbs this near to each other's mirror image
LEAST_JOINTS = 3  # of a limb
NAMED = 8  # joints, at most, in a message
SWEEP = 9  # samples of a joint's range
UNLIMITED = np.pi  # [rad] sweep of a joint without limits
DENSEST = 3000.0  # [kg/m^3] of mass over collision geometry: links are no ghosts


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Chain:
    """A limb of the tree.

    Attributes:
        root: Body at the shoulder or hip: the mass that its contacts support.
        middle: Body whose joint is the elbow or knee.
        end: Body of the hand or foot.
        joints: Ids of its hinges, from the trunk outwards.
        bend: Index into `joints` of the elbow or knee.
        sign: Which way that joint folds the limb, +1 or -1.
        beyond: Ids of joints past the end: fingers.
    """

    root: int
    middle: int
    end: int
    joints: tuple[int, ...]
    bend: int
    sign: float
    beyond: tuple[int, ...]


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Anatomy:
    """Limbs by name, and which way the robot faces.

    Attributes:
        base: Body that floats.
        limbs: By `left_arm` and so on.
        trunk: Ids of the hinges between the base and the limbs.
        locked: Ids of the joints that are in no limb and carry none.
        forward: (3,) unit vector in the world at the zero posture, horizontal.
    """

    base: int
    limbs: Mapping[str, Chain]
    trunk: tuple[int, ...]
    locked: tuple[int, ...]
    forward: np.ndarray


def links_of(model: mujoco.MjModel) -> np.ndarray:
    """(nb,) the first body of the link that each body is part of."""
    out = np.arange(model.nbody)
    for b in range(1, model.nbody):
        if model.body_jntnum[b] == 0:
            out[b] = out[model.body_parentid[b]]
    return out


def find_limbs(
    model: mujoco.MjModel, source: object, mimics: Mapping[str, str] | None = None
) -> Anatomy:
    """Find the limbs.

    Args:
        model: With one floating body, at its zero posture.
        source: Named in errors.
        mimics: Joint that each coupled joint follows, by name: they move grippers.

    Raises:
        InputError: It has not two arms and two legs, or a limb has other than hinges.
    """
    free = [
        j for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE
    ]
    if len(free) != 1:
        raise InputError(
            "one floating body, the robot",
            source=source,
            field="free joints",
            value=len(free),
        )
    base = int(model.jnt_bodyid[free[0]])
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    coupled = {*(mimics or {}), *(mimics or {}).values()}
    free_moving = [
        int(model.jnt_bodyid[j])
        for j in range(model.njnt)
        if model.joint(j).name not in coupled
    ]
    # Grippers: bodies on whose joints nothing hangs that moves on its own.
    grips = frozenset(
        b
        for b in range(1, model.nbody)
        if model.body_jntnum[b] and not any(hangs_on(model, x, b) for x in free_moving)
    )
    pairs = _paired(model, data, base, grips)
    if len(pairs) < 2:
        raise InputError(
            "two legs and two arms, mirror images of each other at the zero posture, z"
            f" up, of {LEAST_JOINTS} joints or more ({_found(model, pairs)})",
            source=source,
            field="kinematic tree",
        )
    low = [min(data.xpos[_way_out(model, b, grips)[-1], 2] for b in p) for p in pairs]
    legs = pairs[int(np.argmin(low))]
    rest = [p for p in pairs if p is not legs]
    arms = max(rest, key=lambda p: float(model.body_subtreemass[list(p)].sum()))
    left = data.xpos[legs[0]] - data.xpos[legs[1]]
    forward = np.cross([left[0], left[1], 0.0], [0.0, 0.0, 1.0])
    forward /= np.linalg.norm(forward)
    chains = {
        name: [_chain(model, data, b, name, source, grips) for b in pair]
        for name, pair in (("arm", arms), ("leg", legs))
    }
    if _faces_back(model, data, chains["leg"], forward):
        forward = -forward
        chains = {n: c[::-1] for n, c in chains.items()}
    across = np.cross([0.0, 0.0, 1.0], forward)
    limbs = {}
    for name, pair in chains.items():
        sides = sorted(pair, key=lambda c: -float(data.xpos[c.end] @ across))
        limbs[f"left_{name}"], limbs[f"right_{name}"] = sides
    used = {j for c in limbs.values() for j in c.joints}
    carrying = set()
    for chain in limbs.values():
        b = int(model.jnt_bodyid[chain.joints[0]])
        while b:
            b = int(model.body_parentid[b])
            carrying |= set(_joints_of(model, b))
    carrying -= used | {free[0]}
    for j in carrying:
        _must_be_hinge(model, j, source)
    return Anatomy(
        base=base,
        limbs={n: limbs[n] for n in sorted(limbs)},
        trunk=tuple(sorted(carrying)),
        locked=tuple(sorted(set(range(model.njnt)) - used - carrying - {free[0]})),
        forward=forward,
    )


def _found(model: mujoco.MjModel, pairs: list[tuple[int, int]]) -> str:
    """Which limbs there are, and which joints are left that could make others."""
    limbs = [b for p in pairs for b in p]
    rest = [
        model.joint(j).name
        for j in range(model.njnt)
        if model.jnt_type[j] != mujoco.mjtJoint.mjJNT_FREE
        and not any(hangs_on(model, int(model.jnt_bodyid[j]), b) for b in limbs)
    ]
    names = [f"{model.body(a).name} and {model.body(b).name}" for a, b in pairs]
    return (
        f"found {', '.join(names) or 'none'}; other joints that move: "
        + (", ".join(rest[:NAMED]) or "none")
        + (f" and {len(rest) - NAMED} more" if len(rest) > NAMED else "")
    )


def _joints_of(model: mujoco.MjModel, body: int) -> list[int]:
    first = int(model.body_jntadr[body])
    return list(range(first, first + int(model.body_jntnum[body])))


def _children(model: mujoco.MjModel) -> list[list[int]]:
    out: list[list[int]] = [[] for _ in range(model.nbody)]
    for b in range(1, model.nbody):
        out[int(model.body_parentid[b])].append(b)
    return out


def _moving_children(model: mujoco.MjModel, link: int) -> list[int]:
    """Bodies with joints that hang on a link, fixed bodies in between aside."""
    links = links_of(model)
    return [
        b
        for b in range(1, model.nbody)
        if model.body_jntnum[b] and links[model.body_parentid[b]] == link and b != link
    ]


def _way_out(model: mujoco.MjModel, body: int, grips: frozenset[int]) -> list[int]:
    """Bodies with joints from one on, until the chain ends or branches into fingers."""
    way = [body]
    while True:
        children = _moving_children(model, way[-1])
        onward = [b for b in children if b not in grips]
        if not onward:
            return way
        # Fingers are alike: the limb goes on where one child has most of the joints.
        joints = [_count(model, c) for c in onward]
        if max(joints) < 0.6 * sum(_count(model, c) for c in children):
            return way
        way.append(onward[int(np.argmax(joints))])


def _count(model: mujoco.MjModel, body: int) -> int:
    """Joints of a body and of all that hangs on it."""
    total = int(model.body_jntnum[body])
    return total + sum(_count(model, c) for c in _children(model)[body])


def _paired(
    model: mujoco.MjModel, data: mujoco.MjData, base: int, grips: frozenset[int]
) -> list[tuple[int, int]]:
    """First bodies of limbs that are mirror images, the legs' pair among them.

    Walks outwards from the base: where a body's children have mirror images among one
    another, they are limbs; the others are part of the trunk and are walked on.
    """
    height = float(np.ptp(data.xipos[1:, 2])) or 1.0
    pairs, trunk = [], [base]
    while trunk:
        link = trunk.pop()
        children = _moving_children(model, link)
        taken = set()
        for i, a in enumerate(children):
            for b in children[i + 1 :]:
                if a in taken or b in taken or not _alike(model, data, a, b, height):
                    continue
                taken |= {a, b}
                if all(
                    sum(int(model.body_jntnum[x]) for x in _way_out(model, c, grips))
                    >= LEAST_JOINTS
                    for c in (a, b)
                ):
                    pairs.append((a, b))
        trunk += [c for c in children if c not in taken]
    return pairs


def _alike(
    model: mujoco.MjModel, data: mujoco.MjData, a: int, b: int, height: float
) -> bool:
    """Same joints, mass and height, and not in the same place."""
    if _count(model, a) != _count(model, b):
        return False
    mass = model.body_subtreemass[[a, b]]
    if abs(mass[0] - mass[1]) > 0.1 * mass.max():
        return False
    p, q = data.subtree_com[a], data.subtree_com[b]
    apart = float(np.linalg.norm((p - q)[:2]))
    return abs(float(p[2] - q[2])) < MIRRORED * height and apart > MIRRORED * height


def _must_be_hinge(model: mujoco.MjModel, joint: int, source: object) -> None:
    if model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_HINGE:
        kind = mujoco.mjtJoint(int(model.jnt_type[joint])).name
        raise InputError(
            "hinges alone in limbs and trunk",
            source=source,
            field=f"joint {model.joint(joint).name!r}",
            value=kind.removeprefix("mjJNT_").lower(),
        )


def _chain(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    body: int,
    name: str,
    source: object,
    grips: frozenset[int],
) -> Chain:
    """The limb that begins with a body."""
    way = _way_out(model, body, grips)
    joints = [j for b in way for j in _joints_of(model, b)]
    for j in joints:
        _must_be_hinge(model, j, source)
    bend, sign = _bending(model, data, joints, way[-1])
    middle = int(model.jnt_bodyid[joints[bend]])
    before = way[: way.index(middle)]
    if not before:
        raise InputError(
            f"a joint between the trunk and the {name}'s middle joint",
            source=source,
            field=f"joint {model.joint(joints[bend]).name!r}",
        )
    mine = set(joints)
    beyond = tuple(
        j
        for b in range(1, model.nbody)
        if hangs_on(model, b, way[0])
        for j in _joints_of(model, b)
        if j not in mine
    )
    return Chain(
        root=before[min(1, len(before) - 1)],
        middle=middle,
        end=way[-1],
        joints=tuple(joints),
        bend=bend,
        sign=sign,
        beyond=beyond,
    )


def hangs_on(model: mujoco.MjModel, body: int, ancestor: int) -> bool:
    """Whether a body is another, or hangs on it."""
    while body:
        if body == ancestor:
            return True
        body = int(model.body_parentid[body])
    return False


def joint_range(model: mujoco.MjModel, joint: int) -> tuple[float, float]:
    """Limits of a hinge [rad]; a turn where it has none."""
    if not model.jnt_limited[joint]:
        return -UNLIMITED, UNLIMITED
    low, high = model.jnt_range[joint].tolist()
    return low, high


def _bending(
    model: mujoco.MjModel, data: mujoco.MjData, joints: list[int], end: int
) -> tuple[int, float]:
    """Which hinge is the knee or elbow, and which way it shortens the limb.

    That with the largest product of levers: distance of its axis from the limb's second
    joint, the middle of shoulder or hip, times that from its tip. A twist has none on
    one side, an ankle a short one.
    """
    first = data.xanchor[joints[1]]
    points = link_points(model, data, end, below=True)
    if len(points) == 0:
        points = data.xipos[end][None]
    far = points[int(np.argmax(np.linalg.norm(points - first, axis=1)))]
    tip = 0.5 * (far + data.xpos[end])  # fingers do not make a wrist an elbow

    def lever(j: int, p: np.ndarray) -> float:
        return float(np.linalg.norm(np.cross(p - data.xanchor[j], data.xaxis[j])))

    bend = int(np.argmax([lever(j, first) * lever(j, tip) for j in joints]))
    local = data.xmat[end].reshape(3, 3).T @ (tip - data.xpos[end])
    turned = mujoco.MjData(model)
    angles = np.linspace(*joint_range(model, joints[bend]), SWEEP)
    lengths = []
    for angle in angles:
        turned.qpos[:] = model.qpos0
        turned.qpos[model.jnt_qposadr[joints[bend]]] = angle
        mujoco.mj_kinematics(model, turned)
        p = turned.xpos[end] + turned.xmat[end].reshape(3, 3) @ local
        lengths.append(float(np.linalg.norm(p - first)))
    fold = angles[int(np.argmin(lengths))] - angles[int(np.argmax(lengths))]
    return bend, float(np.sign(fold)) or 1.0


def _faces_back(
    model: mujoco.MjModel, data: mujoco.MjData, legs: list[Chain], forward: np.ndarray
) -> bool:
    """Whether the knees fold the feet forward: then forward is the other way."""
    turned = mujoco.MjData(model)
    out = 0.0
    for leg in legs:
        knee = leg.joints[leg.bend]
        low, high = joint_range(model, knee)
        turned.qpos[:] = model.qpos0
        turned.qpos[model.jnt_qposadr[knee]] = high if leg.sign > 0 else low
        mujoco.mj_kinematics(model, turned)
        out += float((turned.xpos[leg.end] - data.xpos[leg.end]) @ forward)
    return out > 0


def link_points(
    model: mujoco.MjModel, data: mujoco.MjData, body: int, *, below: bool = False
) -> np.ndarray:
    """(K, 3) points in the world on the geometry of a link.

    Its collision geometry; what is only seen where it has none.

    Args:
        model: The description.
        data: With kinematics.
        body: First body of the link.
        below: With the links that hang on it.
    """
    links = links_of(model)
    geoms = [
        g
        for g in range(model.ngeom)
        if links[model.geom_bodyid[g]] == body
        or (below and hangs_on(model, int(model.geom_bodyid[g]), body))
    ]
    solid = [g for g in geoms if model.geom_contype[g] or model.geom_conaffinity[g]]
    points = [geom_points(model, data, g) for g in solid or geoms]
    return np.concatenate(points) if points else np.zeros((0, 3))


def geom_points(
    model: mujoco.MjModel, data: mujoco.MjData, geom: int, around: int = 16
) -> np.ndarray:
    """(K, 3) points in the world whose hull is a geom's, but for its roundness."""
    kind, size = mujoco.mjtGeom(int(model.geom_type[geom])), model.geom_size[geom]
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = int(model.geom_dataid[geom])
        first = int(model.mesh_vertadr[mesh])
        local = model.mesh_vert[first : first + int(model.mesh_vertnum[mesh])].astype(
            float
        )
    elif kind == mujoco.mjtGeom.mjGEOM_BOX:
        corners = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(8, 3)
        local = corners * size
    elif kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        a = np.linspace(0, 2 * np.pi, around, endpoint=False)
        ring = np.stack([np.cos(a), np.sin(a), 0 * a], axis=1) * size[0]
        local = np.concatenate([ring + np.array([0, 0, s * size[1]]) for s in (-1, 1)])
    elif kind == mujoco.mjtGeom.mjGEOM_PLANE:
        return np.zeros((0, 3))
    else:
        a, b = np.meshgrid(
            np.linspace(0, 2 * np.pi, around, endpoint=False),
            np.linspace(-np.pi / 2, np.pi / 2, around // 2 + 1),
        )
        ball = np.stack(
            [np.cos(b) * np.cos(a), np.cos(b) * np.sin(a), np.sin(b)], axis=-1
        ).reshape(-1, 3)
        if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
            local = ball * size
        else:
            half = size[1] if kind == mujoco.mjtGeom.mjGEOM_CAPSULE else 0.0
            local = np.concatenate(
                [ball * size[0] + [0, 0, s * half] for s in (-1.0, 1.0)]
            )
    R = data.geom_xmat[geom].reshape(3, 3)
    return local @ R.T + data.geom_xpos[geom]


def geom_volume(model: mujoco.MjModel, geom: int) -> float:
    """Volume of a geom [m^3], of a mesh half of its bounding box."""
    kinds, s = mujoco.mjtGeom, model.geom_size[geom]
    kind = kinds(int(model.geom_type[geom]))
    ball = 4 / 3 * np.pi
    if kind == kinds.mjGEOM_SPHERE:
        return float(ball * s[0] ** 3)
    if kind == kinds.mjGEOM_CAPSULE:
        return float(ball * s[0] ** 3 + 2 * np.pi * s[0] ** 2 * s[1])
    if kind == kinds.mjGEOM_CYLINDER:
        return float(2 * np.pi * s[0] ** 2 * s[1])
    if kind == kinds.mjGEOM_ELLIPSOID:
        return float(ball * s.prod())
    if kind == kinds.mjGEOM_BOX:
        return float(8 * s.prod())
    return float(4 * model.geom_aabb[geom, 3:].prod())
