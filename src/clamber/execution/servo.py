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

from typing import Literal

import numpy as np

from clamber import _core
from clamber.model.world import PHYSICS_STEP, World, chain_up, with_gains
from clamber.planning.timing import Speed

ControlMode = Literal["pid", "mixed"]
INTEGRAL_LIMIT = 5.0  # [N m] the integral term saturates here
EASING = 0.5  # [s] from held to self-positioned
SLOW = 0.5  # [rad/s] the fastest motion in which ankles do not have to balance


def driven_world(world: World, mode: ControlMode) -> World:
    """The world whose joint servos have the gains of a control mode.

    `pid` is the world itself; `mixed` has the impedance of `Robot.impedance` at those
    joints, and no integral there.
    """
    soft = world.robot.impedance
    if mode == "pid" or not soft:
        return world
    return with_gains(world, {name: (*g, 0.0) for name, g in soft.items()})


def joint_servo(world: World) -> _core.JointServo:
    """The law above for all joints of a world, with its integral."""
    limit = np.zeros_like(world.ki)
    np.divide(INTEGRAL_LIMIT, world.ki, out=limit, where=world.ki > 0)
    return _core.JointServo(
        kp=world.kp.tolist(),
        damping=(world.kd + world.model.dof_damping[world.dadr]).tolist(),
        ki=world.ki.tolist(),
        limit=limit.tolist(),
        dt=PHYSICS_STEP,
    )


def self_positioning(world: World, speed: Speed) -> _core.SelfPositioning:
    """The share to which ankles of planted feet position themselves (4.32).

    From when both arms are loaded until a foot must step again; eased in and out. Of
    the joints that the robot's description says so of, in motion that is slow.

    Args:
        world: With the robot.
        speed: Of its fastest joint [rad/s].
    """
    surfaces, limbs = list(world.surfaces), world.robot.limbs.values()
    slow = speed != "max" and speed <= SLOW
    ankles = self_positioning_joints(world) if slow else {}
    return _core.SelfPositioning(
        arms=[[surfaces.index(s) for s in x.surfaces] for x in limbs if x.is_arm],
        ankles=[
            (surfaces.index(foot), np.flatnonzero(joints).tolist())
            for foot, joints in ankles.items()
        ],
        joints=len(world.joints),
        rate=PHYSICS_STEP / EASING,
    )


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
