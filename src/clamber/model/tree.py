"""The kinematic tree of a description at zero: links, children, points.

Links are groups of bodies that are fixed to one another; a link is named after its
first body.

Shapes: nb bodies of the model, K points.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import mujoco
import numpy as np

from clamber.errors import InputError

AT_JOINT = 0.15  # of upper arm or thigh: shapes past it that are nearer tell no length
UNLIMITED = np.pi  # [rad] sweep of a joint without limits


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Chain:
    """A limb of the tree.

    Attributes:
        root: Body at the shoulder or hip: the mass that its contacts support.
        middle: Body whose joint is the elbow or knee.
        end: Body of the hand or foot.
        bodies: Those of its way out with joints, from the trunk outwards.
        joints: Ids of its hinges, from the trunk outwards.
        bend: Index into `joints` of the elbow or knee.
        sign: Which way that joint folds the limb, +1 or -1.
        beyond: Ids of joints past the end, or beside the limb: fingers, toes, rods.
    """

    root: int
    middle: int
    end: int
    bodies: tuple[int, ...]
    joints: tuple[int, ...]
    bend: int
    sign: float
    beyond: tuple[int, ...]

    @property
    def elbow(self) -> int:
        """Id of the joint that folds it, elbow or knee."""
        return self.joints[self.bend]


class Tree:
    """A description at its zero posture, and its parent-child relations.

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
        ties = (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD))
        site = int(mujoco.mjtObj.mjOBJ_SITE)
        self._tied = {
            int(model.site_bodyid[x] if model.eq_objtype[e] == site else x)
            for e in range(model.neq)
            if int(model.eq_type[e]) in ties
            for x in (model.eq_obj1id[e], model.eq_obj2id[e])
            if x > 0
        }
        # Grippers: bodies on whose joints nothing hangs that moves on its own.
        self._grips = {
            b
            for b in range(1, model.nbody)
            if model.body_jntnum[b] and not any(self.hangs_on(x, b) for x in alone)
        }

    def name(self, joint: int) -> str:
        """Name of a joint."""
        return self.model.joint(joint).name

    def joints(self, body: int) -> list[int]:
        """Ids of a body's joints."""
        first = int(self.model.body_jntadr[body])
        return list(range(first, first + int(self.model.body_jntnum[body])))

    def hangs_on(self, body: int, ancestor: int) -> bool:
        """Whether a body is another, or a descendant of it."""
        while body and body != ancestor:
            body = int(self.model.body_parentid[body])
        return body == ancestor

    def below(self, body: int) -> list[int]:
        """A body and its descendants."""
        return [b for b in range(1, self.model.nbody) if self.hangs_on(b, body)]

    def count(self, body: int) -> int:
        """Number of joints of a body and of its descendants."""
        return int(self.model.body_jntnum[self.below(body)].sum())

    def children(self, link: int) -> list[int]:
        """Child bodies of a link that have joints."""
        m = self.model
        return [
            b
            for b in range(1, m.nbody)
            if m.body_jntnum[b] and self.links[m.body_parentid[b]] == link and b != link
        ]

    def way_out(self, body: int) -> list[int]:
        """Bodies with joints outward from one, to the end of the chain or fingers."""
        way = [body]
        while True:
            children = self.children(way[-1])
            onward = [b for b in children if b not in self._grips]
            if not onward:
                return way
            # Rods are tied to what they drive: the limb is the heaviest branch.
            limb = max(onward, key=lambda c: float(self.model.body_subtreemass[c]))
            rods = {c for c in onward if c != limb and self._tied & set(self.below(c))}
            onward = [c for c in onward if c not in rods]
            children = [c for c in children if c not in rods]
            # Fingers are alike: the limb goes on where one child has most joints.
            joints = [self.count(c) for c in onward]
            if max(joints) < 0.6 * sum(self.count(c) for c in children):
                return way
            way.append(onward[int(np.argmax(joints))])

    def points(
        self, link: int, *, below: bool = False, data: mujoco.MjData | None = None
    ) -> np.ndarray:
        """(K, 3) points in the world on the geometry of a link.

        Its collision geometry; visual geometry where it has none.

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
        """(3,) middle of a limb's end, away from its knee or elbow.

        Where no shape of it is away from there, its centre of mass is.
        """
        here = self.data if data is None else data
        points = self.points(int(self.links[chain.end]), below=True, data=here)
        anchor, middle = here.xanchor[chain.elbow], here.xipos[chain.end]
        if len(points) == 0:
            return middle
        shapes = points.mean(axis=0)
        length = float(np.linalg.norm(anchor - here.xanchor[chain.joints[1]]))
        near = float(np.linalg.norm(shapes - anchor)) < AT_JOINT * length
        return middle if near else shapes

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


def joint_range(model: mujoco.MjModel, joint: int) -> tuple[float, float]:
    """Limits of a hinge [rad]; a turn where it has none."""
    if not model.jnt_limited[joint]:
        return -UNLIMITED, UNLIMITED
    low, high = model.jnt_range[joint].tolist()
    return low, high


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
