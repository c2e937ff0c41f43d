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

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import mujoco
import numpy as np

from clamber.model.world import PHYSICS_STEP, World, chain_up, recompiled

ControlMode = Literal["pid", "mixed"]
INTEGRAL_LIMIT = 5.0  # [N m] the integral term saturates here
EASING = 0.5  # [s] from held to self-positioned


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


class JointServo:
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


class SelfPositioning:
    """The share to which ankles of planted feet position themselves (4.32).

    From when both arms are loaded until a foot must step again; eased in and out.
    """

    def __init__(self, world: World) -> None:
        """Of the joints that the robot's description says so of."""
        surfaces, robot = list(world.surfaces), world.robot
        self._arms = [
            [surfaces.index(s) for s in limb.surfaces]
            for limb in robot.limbs.values()
            if limb.is_arm
        ]
        ankles = self_positioning_joints(world)
        self._ankles = [(surfaces.index(s), joints) for s, joints in ankles.items()]
        self._share = np.zeros(len(world.joints))

    def share(
        self, loaded: Sequence[bool], closed: np.ndarray, ahead: np.ndarray
    ) -> np.ndarray | None:
        """(na,) in [0, 1], one physics step later; None where no joint ever does.

        Args:
            loaded: (nS,) surfaces that are loaded.
            closed: (nS,) bool, contacts now.
            ahead: (nS,) bool, contacts a little later.
        """
        if not self._ankles:
            return None
        on_arms = all(any(loaded[i] for i in rows) for rows in self._arms)
        rate = PHYSICS_STEP / EASING
        for row, joints in self._ankles:
            free = on_arms and closed[row] and ahead[row]
            share = float(self._share[joints][0]) + (rate if free else -rate)
            self._share[joints] = min(max(share, 0.0), 1.0)
        return self._share


def self_positioning_joints(world: World) -> dict[str, np.ndarray]:
    """(na,) bool by foot: the joints of its leg that position themselves."""
    m = world.model
    own = [j in world.robot.self_positioning for j in world.joints]
    bodies = [int(m.jnt_bodyid[m.joint(j).id]) for j in world.joints]
    out = {}
    for limb in world.robot.limbs.values():
        foot = limb.surfaces[0]
        chain = chain_up(m, world.surfaces[foot].body)
        joints = np.array([o and b in chain for o, b in zip(own, bodies, strict=True)])
        if joints.any() and not limb.is_arm:
            out[foot] = joints
    return out
