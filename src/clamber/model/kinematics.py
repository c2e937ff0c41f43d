"""A configuration of a world for which forward kinematics have been run.

Shapes: nq, nv of the world's model; the first 7 of `q` and 6 of `v` are the floating
base.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import mujoco
import numpy as np

from clamber import _core
from clamber.model.arguments import checks_types
from clamber.model.core import core_of, near_pairs
from clamber.model.records import short_repr
from clamber.model.world import World


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

    __repr__ = short_repr


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
        self._turn = np.zeros(3)
        # Views of the data: asking for them anew at each use costs more than the use.
        self._xpos = self.data.xpos
        self._xmat = self.data.xmat.reshape(-1, 3, 3)
        self._xquat = self.data.xquat
        self._com = self.data.subtree_com[world.base]
        self._landmarks: dict[str, tuple[int, np.ndarray]] = {}

    @functools.cached_property
    def core(self) -> _core.Workspace:
        """A workspace of the native core, without clearances beyond those asked for."""
        nothing = np.zeros(len(self.world.pairs))
        return _core.Workspace(core_of(self.world), nothing, nothing.astype(np.uint8))

    @functools.cached_property
    def _near(self) -> _core.Proximity:
        return near_pairs(self.world.model, self.world.pairs)

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
        """(K, 3) the points that carry force on a support with that normal."""
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

    def proximity(self, reach: float, active: np.ndarray | None = None) -> Proximity:
        """Pairs nearer than `reach` [m]; `active` (P,) bool restricts them."""
        d = self.data
        pairs, distance, normal, first, second = self._near.query(
            d.geom_xpos, d.geom_xmat, reach, active
        )
        return Proximity(
            pairs=pairs, distance=distance, normal=normal, first=first, second=second
        )

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


@checks_types
def limb_lengths(kin: Kinematics) -> dict[str, float]:
    """Segment lengths of the robot by the names of a subject's [m].

    Args:
        kin: Kinematics of the robot's world, in any posture.
    """
    out: dict[str, list[float]] = {}
    for limb in kin.world.robot.limbs.values():
        a, b, c = (kin.landmark(n)[1] for n in (limb.root, limb.middle, limb.end))
        near, far = ("upper_arm", "forearm") if limb.is_arm else ("thigh", "shank")
        out.setdefault(near, []).append(float(np.linalg.norm(b - a)))
        out.setdefault(far, []).append(float(np.linalg.norm(c - b)))
    return {part: float(np.mean(lengths)) for part, lengths in out.items()}
