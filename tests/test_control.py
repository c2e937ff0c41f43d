"""Servo commands that make the joints follow the PID law."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from clamber.control import INTEGRAL_LIMIT, PID
from clamber.model import PHYSICS_STEP


@pytest.fixture
def pid(demo_plan) -> PID:
    return PID(demo_plan.world, demo_plan.trajectory)


def moving_sample(plan) -> int:
    """A sample at which many joints move."""
    return int(np.argmax(np.abs(plan.trajectory.v[:, 6:]).sum(axis=1)))


def test_servo_and_joint_damping_together_are_the_pid_law(demo_plan, pid, rng):
    """MuJoCo's own actuator and damping forces at a random state, unsaturated."""
    world, trajectory = demo_plan.world, demo_plan.trajectory
    k = moving_sample(demo_plan)
    data = mujoco.MjData(world.model)
    data.qpos[:] = trajectory.q[k]
    data.qpos[world.qadr] += rng.normal(0, 2e-3, len(world.qadr))
    data.qvel[world.dadr] = rng.normal(0, 0.05, len(world.dadr))
    q, v = data.qpos[world.qadr].copy(), data.qvel[world.dadr].copy()
    data.ctrl[[world.model.actuator(j).id for j in world.joints]] = pid.command(k, q)
    mujoco.mj_forward(world.model, data)
    tau = (data.qfrc_actuator + data.qfrc_passive)[world.dadr]

    error = trajectory.q[k, world.qadr] - q
    damping = world.kd + world.model.dof_damping[world.dadr]
    expected = (
        world.kp * error
        + damping * (trajectory.v[k, world.dadr] - v)
        + world.ki * error * PHYSICS_STEP
        + trajectory.tau[k]
    )
    servo = expected + world.model.dof_damping[world.dadr] * v
    free = np.abs(servo) < world.tau_max
    assert free.sum() > 0.8 * len(free)
    assert np.allclose(tau[free], expected[free], atol=1e-9)


def test_the_servo_alone_is_what_the_docstring_says(demo_plan, pid, rng):
    """tau = kp (u - q) - kd qdot turns u back into the law, joint by joint."""
    world, trajectory = demo_plan.world, demo_plan.trajectory
    k = moving_sample(demo_plan)
    q = trajectory.q[k, world.qadr] + rng.normal(0, 0.01, len(world.qadr))
    u = pid.command(k, q)
    error = trajectory.q[k, world.qadr] - q
    damping = world.kd + world.model.dof_damping[world.dadr]
    assert np.allclose(
        world.kp * (u - q),
        world.kp * error
        + damping * trajectory.v[k, world.dadr]
        + world.ki * error * PHYSICS_STEP
        + trajectory.tau[k],
    )


def test_the_integral_grows_with_time_and_error(demo_plan, pid):
    world, q = demo_plan.world, demo_plan.trajectory.q[0, demo_plan.world.qadr]
    error = np.linspace(-0.02, 0.02, len(q))
    first = pid.command(0, q - error)
    for _ in range(99):
        last = pid.command(0, q - error)
    assert np.allclose(world.kp * (last - first), world.ki * error * 99 * PHYSICS_STEP)


def test_the_integral_saturates_and_comes_back_at_once(demo_plan, pid):
    world, q = demo_plan.world, demo_plan.trajectory.q[0, demo_plan.world.qadr]
    start = pid.command(0, q)
    for _ in range(2000):
        high = pid.command(0, q - 0.5)
    share = np.where(world.ki > 0, INTEGRAL_LIMIT, 0.0)
    assert np.allclose(world.kp * (high - start), share)
    low = pid.command(0, q + 0.5)  # no memory of what was beyond the limit
    step = np.where(world.ki > 0, world.ki * 0.5 * PHYSICS_STEP, 0.0)
    assert np.allclose(world.kp * (low - start), share - step)


def test_without_error_the_command_is_reference_and_feed_forward(demo_plan, pid):
    world, trajectory = demo_plan.world, demo_plan.trajectory
    k = len(trajectory.time) - 1  # at rest
    q = trajectory.q[k, world.qadr]
    assert np.allclose(world.kp * (pid.command(k, q) - q), trajectory.tau[k])


def test_the_integral_holds_what_feed_forward_does_not_know(demo_plan):
    """A constant load on each joint: after a while no error is left."""
    from dataclasses import replace

    world = demo_plan.world
    trajectory = replace(
        demo_plan.trajectory,
        tau=np.zeros_like(demo_plan.trajectory.tau),
        v=np.zeros_like(demo_plan.trajectory.v),
    )
    pid = PID(world, trajectory)
    reference = trajectory.q[0, world.qadr]
    load, q = 2.0, reference - 0.01
    damping = world.kd + world.model.dof_damping[world.dadr]
    with_integral = world.ki > 0
    for _ in range(100_000):
        u = pid.command(0, q)
        q = q + PHYSICS_STEP * (world.kp * (u - q) - load) / damping
    assert np.abs(q - reference)[with_integral].max() < 0.4 * load / world.kp.min()
