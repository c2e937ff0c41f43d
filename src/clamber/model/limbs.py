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
from clamber.model.records import short_repr

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

    @property
    def elbow(self) -> int:
        """Id of the joint that folds it, elbow or knee."""
        return self.joints[self.bend]


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

    __repr__ = short_repr

    def pair(self, kind: str) -> list[Chain]:
        """Left and right `arm` or `leg`."""
        return [self.limbs[f"{side}_{kind}"] for side in ("left", "right")]

    @property
    def moving(self) -> list[int]:
        """Ids of the joints of limbs and trunk, in the order of the model."""
        return sorted(
            [*self.trunk, *(j for c in self.limbs.values() for j in c.joints)]
        )


class Tree:
    """A description at its zero posture, and what hangs on what in it.

    Attributes:
        model: With one floating body.
        data: Kinematics and centres of mass at the zero posture.
        source: Named in errors.
        links: (nb,) the first body of the link that each body is part of.
        base: Body that floats.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        source: object,
        mimics: Mapping[str, str] | None = None,
    ) -> None:
        """Look at the zero posture.

        Args:
            model: As above.
            source: As above.
            mimics: Joint that each coupled joint follows, by name: they move grippers.

        Raises:
            InputError: There is not one floating body.
        """
        self.model, self.source, self.data = model, source, mujoco.MjData(model)
        mujoco.mj_kinematics(model, self.data)
        mujoco.mj_comPos(model, self.data)
        self.links = np.arange(model.nbody)
        for b in range(1, model.nbody):
            if model.body_jntnum[b] == 0:
                self.links[b] = self.links[model.body_parentid[b]]
        free = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
        if len(free) != 1:
            expected = "one floating body, the robot"
            raise InputError(expected, source, "free joints", len(free))
        self.root = int(free[0])
        self.base = int(model.jnt_bodyid[self.root])
        coupled = {*(mimics or {}), *(mimics or {}).values()}
        alone = [
            int(model.jnt_bodyid[j])
            for j in range(model.njnt)
            if model.joint(j).name not in coupled
        ]
        # Grippers: bodies on whose joints nothing hangs that moves on its own.
        self._grips = {
            b
            for b in range(1, model.nbody)
            if model.body_jntnum[b] and not any(self.hangs_on(x, b) for x in alone)
        }

    def name(self, joint: int) -> str:
        """Of a joint."""
        return self.model.joint(joint).name

    def joints(self, body: int) -> list[int]:
        """Ids of a body's joints."""
        first = int(self.model.body_jntadr[body])
        return list(range(first, first + int(self.model.body_jntnum[body])))

    def hangs_on(self, body: int, ancestor: int) -> bool:
        """Whether a body is another, or hangs on it."""
        while body and body != ancestor:
            body = int(self.model.body_parentid[body])
        return body == ancestor

    def below(self, body: int) -> list[int]:
        """A body and all that hang on it."""
        return [b for b in range(1, self.model.nbody) if self.hangs_on(b, body)]

    def count(self, body: int) -> int:
        """Joints of a body and of all that hang on it."""
        return int(self.model.body_jntnum[self.below(body)].sum())

    def children(self, link: int) -> list[int]:
        """Bodies with joints that hang on a link."""
        m = self.model
        return [
            b
            for b in range(1, m.nbody)
            if m.body_jntnum[b] and self.links[m.body_parentid[b]] == link and b != link
        ]

    def way_out(self, body: int) -> list[int]:
        """Bodies with joints from one on, until the chain ends or becomes fingers."""
        way = [body]
        while True:
            children = self.children(way[-1])
            onward = [b for b in children if b not in self._grips]
            if not onward:
                return way
            # Fingers are alike: the limb goes on where one child has most joints.
            joints = [self.count(c) for c in onward]
            if max(joints) < 0.6 * sum(self.count(c) for c in children):
                return way
            way.append(onward[int(np.argmax(joints))])

    def points(
        self, link: int, *, below: bool = False, data: mujoco.MjData | None = None
    ) -> np.ndarray:
        """(K, 3) points in the world on the geometry of a link.

        Its collision geometry; what is only seen where it has none.

        Args:
            link: Its first body.
            below: With the links that hang on it.
            data: Another posture, with kinematics.
        """
        m = self.model
        bodies = self.below(link) if below else []
        geoms = [
            g
            for g in range(m.ngeom)
            if self.links[m.geom_bodyid[g]] == link or int(m.geom_bodyid[g]) in bodies
        ]
        solid = [g for g in geoms if m.geom_contype[g] or m.geom_conaffinity[g]]
        points = [geom_points(m, data or self.data, g) for g in solid or geoms]
        return np.concatenate(points) if points else np.zeros((0, 3))

    def far(self, chain: Chain, data: mujoco.MjData | None = None) -> np.ndarray:
        """(3,) middle of a limb's end, away from its knee or elbow."""
        here = self.data if data is None else data
        points = self.points(int(self.links[chain.end]), below=True, data=here)
        return points.mean(axis=0) if len(points) else here.xipos[chain.end]

    def in_link(
        self, link: int, p: np.ndarray, R: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """A pose in the world, at the zero posture, as one in a link."""
        R_WL = self.data.xmat[link].reshape(3, 3)
        return R_WL.T @ (p - self.data.xpos[link]), R_WL.T @ R.reshape(3, 3)

    def must_be_hinge(self, joint: int) -> None:
        """Refuse other joints than hinges, by name."""
        kind = mujoco.mjtJoint(int(self.model.jnt_type[joint]))
        if kind != mujoco.mjtJoint.mjJNT_HINGE:
            expected, where = "hinges alone in limbs and trunk", self.name(joint)
            what = kind.name.removeprefix("mjJNT_").lower()
            raise InputError(expected, self.source, f"joint {where!r}", what)


def find_limbs(tree: Tree) -> Anatomy:
    """Find the limbs.

    Raises:
        InputError: It has not two arms and two legs, or a limb has other than hinges.
    """
    model, data = tree.model, tree.data
    pairs = _paired(tree)
    if len(pairs) < 2:
        raise InputError(
            "two legs and two arms, mirror images of each other at the zero posture, z"
            f" up, of {LEAST_JOINTS} joints or more ({_found(tree, pairs)})",
            tree.source,
            "kinematic tree",
        )
    low = [min(data.xpos[tree.way_out(b)[-1], 2] for b in p) for p in pairs]
    legs = pairs[int(np.argmin(low))]
    rest = [p for p in pairs if p is not legs]
    arms = max(rest, key=lambda p: float(model.body_subtreemass[list(p)].sum()))
    left = data.xpos[legs[0]] - data.xpos[legs[1]]
    forward = np.cross([left[0], left[1], 0.0], [0.0, 0.0, 1.0])
    forward /= np.linalg.norm(forward)
    chains = {
        name: [_chain(tree, b, name) for b in pair]
        for name, pair in (("arm", arms), ("leg", legs))
    }
    if _faces_back(tree, chains["leg"], forward):
        forward = -forward
        chains = {n: c[::-1] for n, c in chains.items()}
    across = np.cross([0.0, 0.0, 1.0], forward)
    limbs = {}
    for name, pair in chains.items():
        sides = sorted(pair, key=lambda c: -float(data.xpos[c.end] @ across))
        limbs[f"left_{name}"], limbs[f"right_{name}"] = sides
    used = {j for c in limbs.values() for j in c.joints} | {tree.root}
    carrying = set()
    for chain in limbs.values():
        b = int(model.jnt_bodyid[chain.joints[0]])
        while b:
            b = int(model.body_parentid[b])
            carrying |= set(tree.joints(b))
    carrying -= used
    for j in carrying:
        tree.must_be_hinge(j)
    return Anatomy(
        base=tree.base,
        limbs={n: limbs[n] for n in sorted(limbs)},
        trunk=tuple(sorted(carrying)),
        locked=tuple(sorted(set(range(model.njnt)) - used - carrying)),
        forward=forward,
    )


def _found(tree: Tree, pairs: list[tuple[int, int]]) -> str:
    """Which limbs there are, and which joints are left that could make others."""
    model = tree.model
    limbs = [b for p in pairs for b in p]
    rest = [
        tree.name(j)
        for j in range(model.njnt)
        if j != tree.root
        and not any(tree.hangs_on(int(model.jnt_bodyid[j]), b) for b in limbs)
    ]
    names = [f"{model.body(a).name} and {model.body(b).name}" for a, b in pairs]
    return (
        f"found {', '.join(names) or 'none'}; other joints that move: "
        + (", ".join(rest[:NAMED]) or "none")
        + (f" and {len(rest) - NAMED} more" if len(rest) > NAMED else "")
    )


def _paired(tree: Tree) -> list[tuple[int, int]]:
    """First bodies of limbs that are mirror images, the legs' pair among them.

    Walks outwards from the base: where a body's children have mirror images among one
    another, they are limbs; the others are part of the trunk and are walked on.
    """
    pairs, trunk = [], [tree.base]
    while trunk:
        children = tree.children(trunk.pop())
        taken = set()
        for i, a in enumerate(children):
            for b in children[i + 1 :]:
                if a in taken or b in taken or not _alike(tree, a, b):
                    continue
                taken |= {a, b}
                joints = [tree.model.body_jntnum[tree.way_out(c)].sum() for c in (a, b)]
                if min(joints) >= LEAST_JOINTS:
                    pairs.append((a, b))
        trunk += [c for c in children if c not in taken]
    return pairs


def _alike(tree: Tree, a: int, b: int) -> bool:
    """Same joints, mass and height, and not in the same place."""
    if tree.count(a) != tree.count(b):
        return False
    mass = tree.model.body_subtreemass[[a, b]]
    if abs(mass[0] - mass[1]) > 0.1 * mass.max():
        return False
    near = MIRRORED * (float(np.ptp(tree.data.xipos[1:, 2])) or 1.0)
    p, q = tree.data.subtree_com[a], tree.data.subtree_com[b]
    return abs(float(p[2] - q[2])) < near < float(np.linalg.norm((p - q)[:2]))


def _chain(tree: Tree, body: int, name: str) -> Chain:
    """The limb that begins with a body."""
    way = tree.way_out(body)
    joints = [j for b in way for j in tree.joints(b)]
    for j in joints:
        tree.must_be_hinge(j)
    bend, sign = _bending(tree, joints, way[-1])
    middle = int(tree.model.jnt_bodyid[joints[bend]])
    before = way[: way.index(middle)]
    if not before:
        expected = f"a joint between the trunk and the {name}'s middle joint"
        where = f"joint {tree.name(joints[bend])!r}"
        raise InputError(expected, tree.source, where)
    past = [j for b in tree.below(way[0]) for j in tree.joints(b)]
    return Chain(
        root=before[min(1, len(before) - 1)],
        middle=middle,
        end=way[-1],
        joints=tuple(joints),
        bend=bend,
        sign=sign,
        beyond=tuple(j for j in past if j not in joints),
    )


def joint_range(model: mujoco.MjModel, joint: int) -> tuple[float, float]:
    """Limits of a hinge [rad]; a turn where it has none."""
    if not model.jnt_limited[joint]:
        return -UNLIMITED, UNLIMITED
    low, high = model.jnt_range[joint].tolist()
    return low, high


def _bending(tree: Tree, joints: list[int], end: int) -> tuple[int, float]:
    """Which hinge is the knee or elbow, and which way it shortens the limb.

    That with the largest product of levers: distance of its axis from the limb's second
    joint, the middle of shoulder or hip, times that from its tip. A twist has none on
    one side, an ankle a short one.
    """
    model, data = tree.model, tree.data
    first = data.xanchor[joints[1]]
    points = tree.points(end, below=True)
    if len(points) == 0:
        points = data.xipos[end][None]
    far = points[int(np.argmax(np.linalg.norm(points - first, axis=1)))]
    tip = 0.5 * (far + data.xpos[end])  # fingers do not make a wrist an elbow

    def lever(j: int, p: np.ndarray) -> float:
        return float(np.linalg.norm(np.cross(p - data.xanchor[j], data.xaxis[j])))

    bend = int(np.argmax([lever(j, first) * lever(j, tip) for j in joints]))
    local = data.xmat[end].reshape(3, 3).T @ (tip - data.xpos[end])
    angles = np.linspace(*joint_range(model, joints[bend]), SWEEP)
    lengths = []
    for angle in angles:
        turned = _turned(model, joints[bend], float(angle))
        p = turned.xpos[end] + turned.xmat[end].reshape(3, 3) @ local
        lengths.append(float(np.linalg.norm(p - first)))
    fold = angles[int(np.argmin(lengths))] - angles[int(np.argmax(lengths))]
    return bend, float(np.sign(fold)) or 1.0


def _turned(model: mujoco.MjModel, joint: int, angle: float) -> mujoco.MjData:
    """The zero posture but for one joint."""
    data = mujoco.MjData(model)
    data.qpos[model.jnt_qposadr[joint]] = angle
    mujoco.mj_kinematics(model, data)
    return data


def _faces_back(tree: Tree, legs: list[Chain], forward: np.ndarray) -> bool:
    """Whether the knees fold the feet forward: then forward is the other way."""
    out = 0.0
    for leg in legs:
        low, high = joint_range(tree.model, leg.elbow)
        turned = _turned(tree.model, leg.elbow, high if leg.sign > 0 else low)
        out += float((turned.xpos[leg.end] - tree.data.xpos[leg.end]) @ forward)
    return out > 0


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
