"""Trajectory -> joint commands.

Every joint has a servo, tau = kp (u - q) - kd qdot, saturated at its effort limit by
the physics. The PID law with feed-forward

    tau = kp (q_ref - q) + kd (qdot_ref - qdot) + ki int(q_ref - q) dt + tau_ff

is therefore the command u = q_ref + (kd qdot_ref + ki int(q_ref - q) dt + tau_ff) / kp.
"""

from __future__ import annotations

import numpy as np

from clamber.model import PHYSICS_STEP, World
from clamber.trajectory import Trajectory

INTEGRAL_LIMIT = 5.0  # [N m] the integral term saturates here


class PID:
    """PID on every joint, with the trajectory's velocities and torques fed forward."""

    def __init__(self, world: World, trajectory: Trajectory) -> None:
        """Precompute all that does not depend on the state."""
        self._ki = world.ki
        self._limit = np.divide(
            INTEGRAL_LIMIT, world.ki, out=np.zeros_like(world.ki), where=world.ki > 0
        )
        self._kp = world.kp
        damping = world.kd + world.model.dof_damping[world.dadr]
        self._reference = trajectory.q[:, world.qadr]
        self._feedforward = (
            self._reference
            + (damping * trajectory.v[:, world.dadr] + trajectory.tau) / world.kp
        )
        self._integral = np.zeros(len(world.kp))

    def command(self, k: int, q: np.ndarray) -> np.ndarray:
        """(na,) servo command of step `k` for the measured joint angles `q` (na,)."""
        self._integral += (self._reference[k] - q) * PHYSICS_STEP
        np.clip(self._integral, -self._limit, self._limit, out=self._integral)
        return self._feedforward[k] + self._ki * self._integral / self._kp
