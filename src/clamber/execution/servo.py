"""Reference -> servo commands.

Every joint has a servo at its drive, tau = kp (u - q) - kd qdot, saturated at its
effort limit by the physics. The PID law with feed-forward

    tau = kp (q_ref - q) + kd (qdot_ref - qdot) + ki int(q_ref - q) dt + tau_ff

is therefore the command u = q_ref + (kd qdot_ref + ki int(q_ref - q) dt + tau_ff) / kp.
The servo is fast; what comes through the command (integral, self-positioning) acts on
measurements that are late.

Mixed control gives some joints the impedance (4.31): a lower stiffness at the drive and
no integral. A joint that positions itself (4.32) has its measured angle as reference:
what is left to it is its feed-forward torque and its damping.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import mujoco
import numpy as np

from clamber.model.world import PHYSICS_STEP, World, recompiled

ControlMode = Literal["pid", "mixed"]
INTEGRAL_LIMIT = 5.0  # [N m] the integral term saturates here


def driven_world(world: World, mode: ControlMode) -> World:
    """The world whose joint servos have the gains of a control mode.

    `pid` is the world itself; `mixed` has the impedance of `Robot.impedance` at those
    joints, and no integral there.
    """
    soft = world.robot.impedance
    if mode == "pid" or not soft:
        return world

    def soften(spec: mujoco.MjSpec) -> None:
        for name, (kp, kd) in soft.items():
            spec.actuator(name).set_to_position(kp=kp, kv=kd)

    gains = {**world.robot.gains, **{n: (*g, 0.0) for n, g in soft.items()}}
    robot = replace(world.robot, gains=gains)
    return replace(recompiled(world, soften, robot), robot=world.robot)


class JointLaw:
    """The law above for all joints of a world, with its integral."""

    def __init__(self, world: World) -> None:
        """Precompute all that does not depend on the state."""
        self._kp = world.kp
        self._damping = world.kd + world.model.dof_damping[world.dadr]
        self._ki = world.ki
        self._limit = np.divide(
            INTEGRAL_LIMIT, world.ki, out=np.zeros_like(world.ki), where=world.ki > 0
        )
        self._integral = np.zeros(len(world.kp))

    def command(
        self,
        reference: np.ndarray,
        velocity: np.ndarray,
        torque: np.ndarray,
        measured: np.ndarray,
        follow: np.ndarray | None = None,
    ) -> np.ndarray:
        """(na,) servo command of one physics step.

        Args:
            reference: (na,) joint angles [rad].
            velocity: (na,) joint velocities [rad/s].
            torque: (na,) feed-forward [N m].
            measured: (na,) joint angles as sensed [rad].
            follow: (na,) in [0, 1], the share to which a joint positions itself: at 1
                its reference is its measured angle (4.32).
        """
        error = reference - measured
        if follow is not None:
            reference = reference - follow * error
            velocity = (1.0 - follow) * velocity
            error = (1.0 - follow) * error
        self._integral += error * PHYSICS_STEP
        np.maximum(self._integral, -self._limit, out=self._integral)
        np.minimum(self._integral, self._limit, out=self._integral)
        push = self._damping * velocity + torque + self._ki * self._integral
        return reference + push / self._kp
