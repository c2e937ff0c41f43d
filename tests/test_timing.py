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
    Course,
    inertia_along,
    sample_law,
)
from clamber.planning.trajectory import (
    HOLD_END,
    HOLD_START,
    RATE,
    build_trajectory,
    timed,
)
from clamber.step.stability import statics_at
from clamber.step.statics import cone_generators
from clamber.step.tasks import packed_contacts


UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def knee_phases(demo_plan):
    path = next(p for p in demo_plan.changes if "LFoot" in p.step.breaks)
    return path.phases


@pytest.fixture(scope="module")
def fast(demo_plan, knee_phases):
    return build_trajectory(demo_plan.world, knee_phases, speed="max")


def law(kin, key, s, u_max, x_max, inertia=None) -> np.ndarray:
    """The fastest law where the robot stays in a posture, and (n, nv) presses on it."""
    n, nv = len(s) - 1, kin.world.model.nv
    still = np.zeros((n, nv))
    push = still if inertia is None else np.tile(inertia, (n, 1))
    limits = [np.diff(s), *(np.broadcast_to(x, n) for x in (u_max, x_max))]
    return kin.core.time_law(
        [packed_contacts(kin.world, key.stance)],
        np.zeros(n, np.int32),
        np.tile(key.q, (n, 1)),
        still,
        push,
        still,
        np.stack([*limits, np.full(n, 1e-6), np.full(n, 1e-6)]),
        np.zeros(nv),
        1.0,
    )


def test_a_double_integrator_takes_its_known_least_time(demo_plan, demo_kinematics):
    s = np.linspace(0.0, 1.0, 101)
    x = law(demo_kinematics, demo_plan.keyframes[0], s, 4.0, 100.0)
    assert np.allclose(x, 8.0 * np.minimum(s, 1.0 - s), atol=0.02)
    rows, _ = sample_law(s, x)
    assert len(rows) / RATE == pytest.approx(1.0 + SMOOTHING, abs=0.02)


def test_a_speed_limit_makes_it_a_trapezium(demo_plan, demo_kinematics):
    s = np.linspace(0.0, 1.0, 201)
    x = law(demo_kinematics, demo_plan.keyframes[0], s, 4.0, 1.0)
    assert np.allclose(x, np.minimum(8.0 * np.minimum(s, 1.0 - s), 1.0), atol=0.05)


def test_friction_limits_how_fast_the_robot_may_be_pushed(demo_plan, demo_kinematics):
    """Standing, a sideways force F u is borne while it stays over the feet's border."""
    kin, key = demo_kinematics, demo_plan.keyframes[0]
    s, forward = np.linspace(0.0, 1.0, 101), np.eye(kin.world.model.nv)[0]
    kin.update(key.q)
    weight, com = kin.world.mass * 9.81, kin.com.copy()
    points = np.concatenate([kin.bearing_points(c.surface, UP) for c in key.stance])
    # A force at the base's origin, at height h, moves the pressure by F h / weight.
    ahead, behind = points[:, 0].max() - com[0], com[0] - points[:, 0].min()
    most = np.array([ahead, behind]) * weight / key.q[2]
    x = law(kin, key, s, 1e3, 1e6, forward)
    u = np.diff(x) / (2.0 * np.diff(s))
    # Inertia is what contacts must bring up besides the weight: it is the other way.
    assert u[:40].min() == pytest.approx(most[1], rel=0.05) or u[:40].min() == (
        pytest.approx(most[0], rel=0.05)
    )
    assert -u[-40:].max() == pytest.approx(most.sum() - u[:40].min(), rel=0.05)


def test_wider_limits_are_never_slower(demo_plan, demo_kinematics, rng):
    s, key = np.linspace(0.0, 1.0, 42), demo_plan.keyframes[0]
    for _ in range(5):
        u, bound = rng.uniform(0.5, 5.0, 41), rng.uniform(0.3, 5.0, 41)
        slow = law(demo_kinematics, key, s, u, bound)
        quick = law(demo_kinematics, key, s, 1.3 * u, 1.3 * bound)
        assert np.all(quick >= slow - 1e-4)


def test_the_rate_of_a_smoothed_law_is_its_derivative():
    s = np.linspace(0.0, 1.0, 101)
    way, rate = sample_law(s, 8.0 * np.minimum(s, 1.0 - s))
    assert np.abs((way[2:] - way[:-2]) * RATE / 2 - rate[1:-1]).max() < 1e-3
    assert way[-1] == pytest.approx(1.0, abs=1e-12)
    assert rate[-1] == pytest.approx(0.0, abs=1e-12)
    assert np.abs(np.diff(rate)).max() * RATE < 4.0 * 1.05


def test_inertia_is_inverse_dynamics_less_gravity(demo_plan, demo_kinematics, rng):
    kin, key = demo_kinematics, demo_plan.keyframes[1]
    m = copy(kin.world.model)
    slope, bend = rng.normal(0.0, 1.0, (2, 1, m.nv))
    course = Course(
        s=np.array([0.0, 1.0]),
        q=key.q[None],
        slope=slope,
        bend=bend,
        stance=np.zeros(1, int),
        stances=[key.stance],
        makes=np.full(1, -1),
        made=[],
    )
    of_u, of_x = inertia_along(kin, course)
    u, x = 1.7, 2.3
    data = mujoco.MjData(m)
    m.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    forces = []
    for rate, change in ((0.0, 0.0), (x, u)):
        data.qpos[:] = key.q
        data.qvel[:] = np.sqrt(rate) * slope[0]
        data.qacc[:] = change * slope[0] + rate * bend[0]
        mujoco.mj_inverse(m, data)
        forces.append(data.qfrc_inverse + data.qfrc_passive)
    assert np.allclose(u * of_u[0] + x * of_x[0], forces[1] - forces[0], atol=1e-8)


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


def test_it_is_faster_than_any_limit_and_the_same_every_time(
    demo_plan, demo_kinematics, knee_phases, fast
):
    again = build_trajectory(demo_plan.world, knee_phases, speed="max")
    assert np.array_equal(fast.q, again.q)
    assert np.array_equal(fast.tau, again.tau)
    last = fast.time[-1] - HOLD_START - HOLD_END
    for speed in (2.0, 1.0, 0.3):
        slow = build_trajectory(demo_plan.world, knee_phases, speed=speed)
        assert slow.time[-1] - HOLD_START - HOLD_END > 1.02 * last
        last = slow.time[-1] - HOLD_START - HOLD_END
    for k in range(1, len(fast.time) - 1, 7):
        v = demo_kinematics.difference(fast.q[k - 1], fast.q[k + 1]) * RATE / 2
        assert np.abs(v - fast.v[k]).max() < 0.02


def test_the_robot_moves_on_while_contacts_change(demo_plan):
    """It rests at the start and at the end, and nowhere else."""
    t = timed(demo_plan.world, demo_plan.changes, "max")
    assert t is not None
    speed = np.abs(np.asarray(t.v)).max(axis=1)
    a, b = round((HOLD_START + 0.1) * RATE), len(t.time) - round((HOLD_END + 0.1) * RATE)
    assert speed[a:b].min() > 0.02
    apart = (
        build_trajectory(demo_plan.world, change.phases, speed="max")
        for change in demo_plan.changes
    )
    moving = sum(x.time[-1] - HOLD_START - HOLD_END for x in apart)
    assert t.time[-1] - HOLD_START - HOLD_END < 0.85 * moving


def test_a_run_folder_keeps_the_word_max_and_numbers():
    from pydantic import TypeAdapter

    from clamber.planning.records import PlanOptions

    adapter = TypeAdapter(PlanOptions)
    for speed in ("max", 0.3):
        written = adapter.dump_json(PlanOptions(speed=speed))
        assert adapter.validate_json(written).speed == speed
