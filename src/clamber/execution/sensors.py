"""What a robot knows of itself: late, and with noise.

Sensed are the joint encoders, the pose of the base (as an estimator gives it from an
inertial unit and the kinematics) and the contact force on each surface (from force
sensors in the limbs, or from joint torques). Noise is white; there is no bias and no
drift.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from clamber.model.records import short_repr
from clamber.model.world import PHYSICS_STEP, World

ANGLE_NOISE = 5e-4  # [rad] rms of a joint encoder
POSITION_NOISE = 2e-3  # [m] rms of the base
ROTATION_NOISE = 3e-3  # [rad] rms of the base
FORCE_NOISE = 2.0  # [N] rms of a contact force
FORCE_SCALE_NOISE = 0.02  # share of the force, rms
FORCE_STRIDE = 5  # physics steps between two readings of forces: 200 Hz
BLOCK = 512  # steps whose noise is drawn at once


@dataclass(frozen=True, eq=False, slots=True)
class Measurement:
    """One reading.

    Attributes:
        q: (nq,) base pose and joint angles.
        force: (nS, 3) on each surface [N], in the world.
    """

    q: np.ndarray
    force: np.ndarray

    __repr__ = short_repr


class Sensors:
    """Reads the state of a simulation through noise and delay."""

    def __init__(
        self, world: World, *, noise: float, delay: float, rng: np.random.Generator
    ) -> None:
        """Prepare.

        Args:
            world: That is simulated.
            noise: Factor on all noise.
            delay: From sensing to use [s]; whole physics steps.
            rng: Of the noise.
        """
        m = world.model
        self._model = m
        self._noise, self._rng = noise, rng
        self._qadr = world.qadr
        self._row = rows_of_geoms(world)
        self._surfaces = len(world.surfaces)
        self._late = round(delay / PHYSICS_STEP)
        self._ring: list[Measurement] = []
        self._k = 0
        self._force = np.zeros((self._surfaces, 3))
        self._off = np.zeros((BLOCK, m.nq))  # of base's place and joints

    def read(self, data: mujoco.MjData) -> Measurement:
        """What is known at this physics step; call once for each."""
        i = self._k % BLOCK
        if i == 0:
            angle = self._rng.normal(0.0, ANGLE_NOISE, (BLOCK, len(self._qadr)))
            self._off[:, self._qadr] = self._noise * angle
            self._off[:, :3] = self._noise * self._rng.normal(
                0.0, POSITION_NOISE, (BLOCK, 3)
            )
            self._tilt = self._noise * self._rng.normal(0.0, ROTATION_NOISE, (BLOCK, 3))
            n = BLOCK // FORCE_STRIDE + 1
            self._pull = self._rng.normal(0.0, FORCE_NOISE, (n, self._surfaces, 3))
            self._gain = self._rng.normal(
                0.0, FORCE_SCALE_NOISE, (n, self._surfaces, 1)
            )
        q = data.qpos + self._off[i]
        if self._noise > 0:
            mujoco.mju_quatIntegrate(q[3:7], self._tilt[i], 1.0)
        if self._k % FORCE_STRIDE == 0:
            j = i // FORCE_STRIDE
            f = surface_forces(data, self._row, self._surfaces)
            self._force = (
                f * (1.0 + self._noise * self._gain[j]) + self._noise * self._pull[j]
            )
        self._k += 1
        now = Measurement(q, self._force)
        if self._late == 0:
            return now
        if len(self._ring) <= self._late:
            self._ring.append(now)
            return self._ring[0]
        slot = (self._k - 1) % (self._late + 1)
        self._ring[slot] = now
        return self._ring[self._k % (self._late + 1)]


def rows_of_geoms(world: World) -> np.ndarray:
    """(ngeom,) the index of a geom's surface; -1: of another link; -2: of the scene."""
    m = world.model
    out = np.where(m.body_weldid[m.geom_bodyid] == 0, -2, -1)
    for i, surface in enumerate(world.surfaces.values()):
        out[list(surface.geoms)] = i
    return out


def contact_forces(
    data: mujoco.MjData, row_of_geom: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Contacts of the robot with the scene, and the force of each on the robot.

    Elliptic cones: the rows of a contact begin with its normal force, then the two
    tangential ones, along the axes of its frame.

    Args:
        data: After a step.
        row_of_geom: (ngeom,) as `rows_of_geoms` gives it.

    Returns:
        (k, 2) geoms of the robot and of the scene, (k,) normal forces [N] and (k, 3)
        forces on the robot in the world [N].
    """
    if data.ncon == 0:
        return np.zeros((0, 2), dtype=int), np.zeros(0), np.zeros((0, 3))
    c = data.contact
    of_scene = row_of_geom[c.geom] == -2
    use = (c.efc_address >= 0) & (of_scene[:, 0] != of_scene[:, 1])
    address, frame = c.efc_address[use], c.frame[use].reshape(-1, 3, 3)
    f = data.efc_force[address[:, None] + np.arange(3)]
    second = of_scene[use, 0]  # the force acts on the second geom
    sign = np.where(second, 1.0, -1.0)[:, None]
    geoms = np.where(second[:, None], c.geom[use][:, ::-1], c.geom[use])
    return geoms, f[:, 0], sign * np.einsum("ij,ijk->ik", f, frame)


def surface_forces(
    data: mujoco.MjData, row_of_geom: np.ndarray, surfaces: int
) -> np.ndarray:
    """(surfaces, 3) forces of the scene on each surface, of that many [N], world."""
    geoms, _, force = contact_forces(data, row_of_geom)
    row = row_of_geom[geoms[:, 0]]
    out = np.zeros((surfaces, 3))
    np.add.at(out, row[row >= 0], force[row >= 0])
    return out
