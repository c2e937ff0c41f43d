"""The fastest time law: known optima, and limits checked by other means."""

from __future__ import annotations

from copy import copy

import mujoco
import numpy as np
import pytest
from scipy.optimize import linprog

from clamber.planning.timing import (
    SMOOTHING,
    TOUCH_SPEED,
    bearable,
    demand_at,
    fastest,
    least_torques,
    sample_law,
)
from clamber.planning.trajectory import (
    HOLD_END,
    HOLD_START,
    RATE,
    build_trajectory,
    holding_torque,
)
from clamber.step.stability import statics_at
from clamber.step.statics import cone_generators


@pytest.fixture(scope="module")
def knee_phases(demo_plan):
    path = next(p for p in demo_plan.changes if "LFoot" in p.step.breaks)
    return path.phases


@pytest.fixture(scope="module")
def fast(demo_plan, knee_phases):
    return build_trajectory(demo_plan.world, knee_phases, speed="max")


def box(u: float, x: float) -> np.ndarray:
    return np.array([[-u, 0.0], [u, 0.0], [u, x], [-u, x]])


def test_a_double_integrator_takes_its_known_least_time():
    s = np.linspace(0.0, 1.0, 101)
    x = fastest(s, [box(4.0, 100.0)] * 101, np.full(101, 100.0))
    assert np.allclose(x, 8.0 * np.minimum(s, 1.0 - s), atol=0.02)
    rows, _ = sample_law(s, x)
    assert len(rows) / RATE == pytest.approx(1.0 + SMOOTHING, abs=0.02)


def test_a_speed_limit_makes_it_a_trapezium():
    s = np.linspace(0.0, 1.0, 201)
    x = fastest(s, [box(4.0, 100.0)] * 201, np.full(201, 1.0))
    assert np.allclose(x, np.minimum(8.0 * np.minimum(s, 1.0 - s), 1.0), atol=0.02)


def test_wider_limits_are_never_slower(rng):
    s = np.linspace(0.0, 1.0, 41)
    for _ in range(5):
        u, bound = rng.uniform(0.5, 5.0, 41), rng.uniform(0.3, 5.0, 41)
        slow = fastest(s, [box(a, 50.0) for a in u], bound)
        quick = fastest(s, [box(1.3 * a, 50.0) for a in u], 1.3 * bound)
        assert np.all(quick >= slow - 1e-4)


def test_the_rate_of_a_smoothed_law_is_its_derivative():
    s = np.linspace(0.0, 1.0, 101)
    x = fastest(s, [box(4.0, 100.0)] * 101, np.full(101, 100.0))
    way, rate = sample_law(s, x)
    assert np.abs((way[2:] - way[:-2]) * RATE / 2 - rate[1:-1]).max() < 1e-3
    assert way[-1] == pytest.approx(1.0, abs=1e-12)
    assert rate[-1] == pytest.approx(0.0, abs=1e-12)
    assert np.abs(np.diff(rate)).max() * RATE < 4.0 * 1.05


def test_demand_is_inverse_dynamics(demo_plan, demo_kinematics, rng):
    kin, key = demo_kinematics, demo_plan.keyframes[1]
    m = copy(kin.world.model)
    slope, bend = rng.normal(0.0, 1.0, (2, m.nv))
    d = demand_at(kin, key.q, slope, bend, key.stance)
    u, x = 1.7, 2.3
    data = mujoco.MjData(m)
    data.qpos[:] = key.q
    data.qvel[:] = np.sqrt(x) * slope
    data.qacc[:] = u * slope + x * bend
    m.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    mujoco.mj_inverse(m, data)
    expected = data.qfrc_inverse + data.qfrc_passive
    assert np.allclose(d.rest + u * d.inertia + x * d.velocity, expected, atol=1e-8)


def holds(kin, q, force, contacts, effort: float) -> bool:
    """Whether cones and efforts can bring up a generalised force: an LP of its own."""
    w = kin.world
    kin.update(q)
    points, _, torque = statics_at(kin, q, contacts)
    cones = cone_generators(points.normals, points.mu, 8)
    J = torque.jacobian.reshape(len(cones), 3, -1)
    E = np.concatenate([j.T @ g.T for j, g in zip(J, cones, strict=True)], axis=1)
    load, tau = E[w.dadr], force[w.dadr]
    limit = effort * w.tau_max
    found = linprog(
        np.ones(E.shape[1]),
        np.concatenate([-load, load]),
        np.concatenate([limit - tau, limit + tau]),
        E[:6],
        force[:6],
    )
    return found.status == 0


def test_what_is_called_bearable_is_borne(demo_plan, demo_kinematics, rng):
    kin, key = demo_kinematics, demo_plan.keyframes[0]
    slope = rng.normal(0.0, 0.3, kin.world.model.nv)
    d = demand_at(kin, key.q, slope, np.zeros_like(slope), key.stance)
    corners = bearable(kin, d, slope, 30.0, 30.0)
    assert corners is not None
    assert np.ptp(corners[:, 0]) > 0.1
    for u, x in 0.99 * corners:
        force = d.rest + u * d.inertia + x * d.velocity
        assert holds(kin, key.q, force, key.stance, 1.0)
    u, x = 3.0 * corners[np.argmax(corners[:, 0])]
    force = d.rest + u * d.inertia + x * d.velocity
    assert not holds(kin, key.q, force, key.stance, 1.0)


def test_at_rest_torques_are_those_that_hold_the_posture(demo_plan, demo_kinematics):
    kin = demo_kinematics
    for key in demo_plan.keyframes[:3]:
        zero = np.zeros(kin.world.model.nv)
        d = demand_at(kin, key.q, zero, zero, key.stance)
        tau = least_torques(kin, d, 0.0, 0.0)
        assert np.abs(tau - holding_torque(kin, key.q, key.stance)).max() < 3.0


def test_along_the_motion_forces_stay_in_the_cones_and_torques_in_their_limits(
    demo_plan, demo_kinematics, knee_phases, fast
):
    kin, m = demo_kinematics, copy(demo_plan.world.model)
    data = mujoco.MjData(m)
    m.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    changes = np.flatnonzero(np.diff(fast.contact, axis=0).any(axis=1)) + 1
    bounds = [0, *changes, len(fast.time)]
    held = 0
    for phase, a, b in zip(knee_phases, bounds[:-1], bounds[1:], strict=True):
        for k in range(a + 10, b - 10, 37):
            data.qpos[:], data.qvel[:] = fast.q[k], fast.v[k]
            data.qacc[:] = (fast.v[k + 1] - fast.v[k - 1]) * RATE / 2
            mujoco.mj_inverse(m, data)
            assert holds(kin, fast.q[k], data.qfrc_inverse, phase.contacts, 1.0), k
            held += 1
    assert held > 20


def test_a_contact_is_made_gently(demo_plan, demo_kinematics, knee_phases, fast):
    kin = demo_kinematics
    made = next(c for c in knee_phases[2].contacts if c.surface == "LKnee")
    open_ = ~fast.contact[:, fast.surfaces.index("LKnee")]
    heights = []
    for k in np.flatnonzero(open_):
        kin.update(fast.q[k])
        p = kin.contact_point("LKnee", np.array([0.0, 0.0, 1.0]))
        heights.append((p - made.position)[2])
    heights = np.array(heights)
    near = np.flatnonzero(heights > 0.006)[-1]
    assert np.abs(np.diff(heights[near:])).max() * RATE < 1.3 * TOUCH_SPEED


def test_it_is_faster_than_any_cruise_and_the_same_every_time(
    demo_plan, demo_kinematics, knee_phases, fast
):
    again = build_trajectory(demo_plan.world, knee_phases, speed="max")
    assert np.array_equal(fast.q, again.q)
    assert np.array_equal(fast.tau, again.tau)
    slow = build_trajectory(demo_plan.world, knee_phases, speed=3.0)
    hold = HOLD_START + HOLD_END
    assert fast.time[-1] - hold < 0.8 * (slow.time[-1] - hold)
    for k in range(1, len(fast.time) - 1, 7):
        v = demo_kinematics.difference(fast.q[k - 1], fast.q[k + 1]) * RATE / 2
        assert np.abs(v - fast.v[k]).max() < 2e-3


def test_a_run_folder_keeps_the_word_max_and_numbers():
    from pydantic import TypeAdapter

    from clamber.planning.records import PlanOptions

    adapter = TypeAdapter(PlanOptions)
    for speed in ("max", 0.3):
        written = adapter.dump_json(PlanOptions(speed=speed))
        assert adapter.validate_json(written).speed == speed
