"""Sensors with noise and delay.

Sensed are the joint encoders, the pose of the base (as an estimator gives it from an
inertial unit and the kinematics) and the contact force on each surface (from force
sensors in the limbs, or from joint torques). Noise is white; there is no bias and no
drift.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from clamber import _core
from clamber.model.records import short_repr
from clamber.model.world import PHYSICS_STEP, World

ANGLE_NOISE = 5e-4  # [rad] rms of a joint encoder
POSITION_NOISE = 2e-3  # [m] rms of the base
ROTATION_NOISE = 3e-3  # [rad] rms of the base
FORCE_NOISE = 2.0  # [N] rms of a contact force; less in robots that are light
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
    """Reads the state of a simulation through noise and delay.

    Attributes:
        core: Reads; its noise must be drawn anew after `BLOCK` steps.
        forces: Those of the contacts.
    """

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
        self._force_noise = FORCE_NOISE * world.force_scale
        self._nq, self._surfaces = world.model.nq, len(world.surfaces)
        self._noise, self._rng, self._qadr = noise, rng, world.qadr
        self._k = 0
        self.core = _core.Sensors(
            nq=self._nq,
            surfaces=self._surfaces,
            late=round(delay / PHYSICS_STEP),
            force_stride=FORCE_STRIDE,
            block=BLOCK,
        )
        self.forces = contact_forces(world)

    def draw(self) -> None:
        """The noise of the next `BLOCK` steps."""
        normal, n = self._rng.normal, BLOCK // FORCE_STRIDE + 1
        offset = np.zeros((BLOCK, self._nq))
        offset[:, self._qadr] = normal(0.0, ANGLE_NOISE, (BLOCK, len(self._qadr)))
        offset[:, :3] = normal(0.0, POSITION_NOISE, (BLOCK, 3))
        tilt = normal(0.0, ROTATION_NOISE, (BLOCK, 3))
        pull = normal(0.0, self._force_noise, (n, self._surfaces, 3))
        gain = normal(0.0, FORCE_SCALE_NOISE, (n, self._surfaces))
        for x in offset, tilt, gain, pull:
            x *= self._noise
        self.core.draw(offset, tilt, gain, pull)

    def read(self, data: mujoco.MjData) -> Measurement:
        """Measurement at this physics step; call once for each."""
        if self._k % BLOCK == 0:
            self.draw()
        self._k += 1
        self.forces.update(data)
        return Measurement(*self.core.read(data.qpos, self.forces.surface))


def contact_forces(world: World) -> _core.ContactForces:
    """Contact forces of the scene on the robot, by its surfaces in order."""
    m = world.model
    rows = np.where(m.body_weldid[m.geom_bodyid] == 0, _core.SCENE, _core.OTHER)
    for i, surface in enumerate(world.surfaces.values()):
        rows[list(surface.geoms)] = i
    return _core.ContactForces(rows.tolist(), len(world.surfaces))
