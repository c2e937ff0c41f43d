"""Servo commands that make the joints follow the PID law."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from clamber.execution.servo import (
    EASING,
    INTEGRAL_LIMIT,
    driven_world,
    joint_servo,
    self_positioning,
    self_positioning_joints,
)
from clamber.model.world import PHYSICS_STEP


class PID:
    """The law on the samples of a trajectory."""

    def __init__(self, world, trajectory):
        self.law, self.world, self.trajectory = joint_servo(world), world, trajectory

    def command(self, k: int, q: np.ndarray) -> np.ndarray:
        w, t = self.world, self.trajectory
        held = np.zeros(len(q))
        return self.law.command(t.q[k, w.qadr], t.v[k, w.dadr], t.tau[k], q, held)


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


# Mixed control


def test_compliant_joints_have_the_impedance_at_their_drives(demo_plan):
    """(4.31) by MuJoCo itself: stiffness and damping of each joint by differences."""
    world = driven_world(demo_plan.world, "mixed")
    soft = world.robot.impedance
    assert set(soft) == {
        *("WaistYaw", "WaistLat", "RKneeSag", "LKneeSag", "RElbj", "LElbj")
    }
    data = mujoco.MjData(world.model)
    q = world.home.copy()

    def torque(dq: float, dv: float, joint: int) -> float:
        data.qpos[:], data.qvel[:] = q, 0.0
        data.qpos[world.qadr[joint]] += dq
        data.qvel[world.dadr[joint]] = dv
        for j, name in enumerate(world.joints):
            data.ctrl[world.model.actuator(name).id] = q[world.qadr[j]]
        mujoco.mj_forward(world.model, data)
        return float(data.qfrc_actuator[world.dadr[joint]])

    for j, name in enumerate(world.joints):
        kp, kd = soft.get(name, world.robot.gains["default"][:2])
        assert torque(1e-3, 0.0, j) == pytest.approx(-kp * 1e-3), name
        assert torque(0.0, 1e-2, j) == pytest.approx(-kd * 1e-2), name
        assert world.kp[j] == pytest.approx(kp)
        assert world.ki[j] == (0.0 if name in soft else 9.0)


def test_pid_runs_the_planned_world_itself(demo_plan):
    assert driven_world(demo_plan.world, "pid") is demo_plan.world


def test_a_robot_without_impedance_is_driven_as_it_is(demo_plan):
    world = demo_plan.world
    stiff = replace(world, robot=replace(world.robot, impedance={}))
    assert driven_world(stiff, "mixed") is stiff


def test_only_servos_differ_between_the_worlds_of_the_modes(demo_plan):
    a, b = demo_plan.world, driven_world(demo_plan.world, "mixed")
    assert np.array_equal(a.home, b.home)
    assert np.array_equal(a.model.body_mass, b.model.body_mass)
    assert np.array_equal(a.model.actuator_forcerange, b.model.actuator_forcerange)
    assert np.array_equal(a.model.geom_size, b.model.geom_size)
    assert a.joints == b.joints


def test_a_joint_that_positions_itself_is_left_its_feed_forward(demo_plan):
    """(4.32): the measured angle is the reference, whatever the error has been."""
    world = demo_plan.world
    law, n = joint_servo(world), len(world.joints)
    free = np.zeros(n)
    free[3] = 1.0
    q, tau = np.zeros(n), np.full(n, 2.0)
    for _ in range(500):
        u = law.command(np.full(n, 0.1), np.full(n, 0.3), tau, q, free)
    assert world.kp[3] * (u[3] - q[3]) == pytest.approx(2.0)
    assert np.all(world.kp[:3] * (u[:3] - q[:3]) > 50.0)
    # The error of that time does not come back when the joint is held again.
    u = law.command(q, np.zeros(n), tau, q, np.zeros(n))
    assert world.kp[3] * (u[3] - q[3]) == pytest.approx(2.0)


# Joints that position themselves: which, and when.


def test_ankles_are_those_of_each_foot(demo_plan):
    world = demo_plan.world
    found = {
        foot: {n for n, own in zip(world.joints, joints, strict=True) if own}
        for foot, joints in self_positioning_joints(world).items()
    }
    assert found == {"LFoot": {"LAnkLat", "LAnkSag"}, "RFoot": {"RAnkLat", "RAnkSag"}}
    plain = replace(world, robot=replace(world.robot, self_positioning=()))
    assert self_positioning_joints(plain) == {}
    nothing = np.zeros(len(world.surfaces), dtype=bool)
    on = ~nothing
    assert not self_positioning(plain, 0.3).share(on, on, on).any()


@pytest.mark.parametrize(
    ("speed", "acts"), [(0.05, True), (0.6, False), ("max", False)]
)
def test_in_fast_motion_ankles_are_held(demo_plan, speed, acts):
    on = np.ones(len(demo_plan.world.surfaces), dtype=bool)
    assert self_positioning(demo_plan.world, speed).share(on, on, on).any() == acts


def test_ankles_position_themselves_only_while_both_arms_are_loaded(demo_plan):
    """Eased in and out; before a foot steps its ankle is held, the other goes on."""
    world = demo_plan.world
    ankles, feet = self_positioning(world, 0.3), self_positioning_joints(world)
    free = np.any(list(feet.values()), axis=0)
    down = np.ones(len(world.surfaces), dtype=bool)
    n = round(EASING / PHYSICS_STEP)

    def share(*loaded: str, ahead: np.ndarray = down) -> np.ndarray:
        on = [s in loaded for s in world.surfaces]
        return ankles.share(np.array(on), down, ahead)

    for _ in range(n):
        assert not share("LHand").any()
    for k in range(n):
        now = share("LHand", "RElbow")  # any surface of an arm
        assert np.allclose(now[free], (k + 1) / n)
        assert not now[~free].any()
    assert np.all(share("LElbow", "RElbow")[free] == 1.0)
    lifts = down.copy()
    lifts[list(world.surfaces).index("LFoot")] = False
    for k in range(n):
        now = share("LElbow", "RElbow", ahead=lifts)
        assert np.allclose(now[feet["LFoot"]], 1.0 - (k + 1) / n)
        assert np.all(now[feet["RFoot"]] == 1.0)
    assert np.allclose(share("RElbow")[feet["RFoot"]], 1.0 - 1.0 / n)
