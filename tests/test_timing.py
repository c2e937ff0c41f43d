"""The fastest time law: known optima, and limits checked by other means."""

from __future__ import annotations

from copy import copy

import mujoco
import numpy as np
import pytest
from scipy.optimize import linprog

from clamber.model.kinematics import Kinematics
from clamber.planning.timing import (
    FASTEST,
    SMOOTHING,
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
from clamber.step.ik import IK
from clamber.step.stability import statics_at
from clamber.step.statics import cone_generators
from clamber.step.tasks import packed_contacts


@pytest.fixture(scope="module")
def knee_phases(demo_plan):
    path = next(p for p in demo_plan.changes if "LFoot" in p.step.breaks)
    return path.phases


@pytest.fixture(scope="module")
def fast(demo_plan, knee_phases):
    return build_trajectory(Kinematics(demo_plan.world), knee_phases, speed="max")


def law(kin, key, s, u_max, x_max, inertia=None, share=1.0) -> np.ndarray:
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
        share,
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


def most_borne(kin, key, push: np.ndarray) -> float:
    """Largest u for which gravity and u times a force are borne: an LP."""
    points, _, torque = statics_at(kin, key.q, key.stance)
    cones = cone_generators(points.normals, points.mu, 4)
    J = torque.jacobian.reshape(len(cones), 3, -1)
    E = np.concatenate([j.T @ g.T for j, g in zip(J, cones, strict=True)], axis=1)
    A, dadr = np.column_stack([push, -E]), kin.world.dadr
    found = linprog(
        np.eye(A.shape[1])[0] * -1.0,
        np.concatenate([A[dadr], -A[dadr]]),
        np.concatenate(
            [torque.limits - torque.gravity[dadr], torque.limits + torque.gravity[dadr]]
        ),
        A[:6],
        -torque.gravity[:6],
        bounds=[(None, None)] + [(0.0, None)] * E.shape[1],
    )
    return float(found.x[0])


@pytest.mark.parametrize("share", [1.0, 0.5])
def test_what_contacts_and_joints_bear_limits_it(demo_plan, demo_kinematics, share):
    """Standing, where all that moves is a force that is borne forwards so far."""
    kin, key = demo_kinematics, demo_plan.keyframes[0]
    push = np.zeros(kin.world.model.nv)
    push[:3] = 1.0, 0.3, 0.0
    ahead, behind = (most_borne(kin, key, sign * push) for sign in (1.0, -1.0))
    assert min(ahead, behind) > 5.0
    s = np.linspace(0.0, 1.0, 201)
    x = law(kin, key, s, 500.0, 1e3, push, share)
    u = np.diff(x) / (2.0 * np.diff(s))
    top = int(np.argmax(x))
    assert 0.2 < s[top] < 0.8
    assert np.allclose(u[3 : top - 3], share * ahead, rtol=0.03)
    assert np.allclose(u[top + 3 : -3], -share * behind, rtol=0.03)


def swept(step: float, u: np.ndarray, x_max: np.ndarray) -> np.ndarray:
    """The law where only |u| and x are limited, by a sweep back and one forwards."""
    n = len(u)
    most, x = np.zeros(n + 1), np.zeros(n + 1)
    for i in range(n - 1, -1, -1):
        most[i] = min(x_max[i], most[i + 1] + step * u[i])
    for i in range(n):
        x[i + 1] = min(most[i + 1], max(x[i], min(x[i] + step * u[i], x_max[i])))
    return x


def test_limits_that_differ_from_one_interval_to_the_next(
    demo_plan, demo_kinematics, rng
):
    s, key = np.linspace(0.0, 1.0, 42), demo_plan.keyframes[0]
    for _ in range(20):
        u, x_max = rng.uniform(0.5, 5.0, 41), rng.uniform(0.3, 5.0, 41)
        x = law(demo_kinematics, key, s, u, x_max)
        assert np.allclose(x, swept(2.0 / 41, u, x_max), atol=1e-6)


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
        steep=np.ones(1),
        sharp=np.ones(1),
        stance=np.zeros(1, int),
        stances=[key.stance],
        makes=[None],
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
    assert np.abs(np.diff(heights[near:])).max() * RATE < 1.3 * FASTEST.touch_speed


def test_it_is_faster_than_any_limit_and_the_same_every_time(
    demo_plan, demo_kinematics, knee_phases, fast
):
    again = build_trajectory(Kinematics(demo_plan.world), knee_phases, speed="max")
    assert np.array_equal(fast.q, again.q)
    assert np.array_equal(fast.tau, again.tau)
    last = fast.time[-1] - HOLD_START - HOLD_END
    for speed in (2.0, 1.0, 0.3):
        slow = build_trajectory(Kinematics(demo_plan.world), knee_phases, speed=speed)
        assert slow.time[-1] - HOLD_START - HOLD_END > 1.02 * last
        last = slow.time[-1] - HOLD_START - HOLD_END
    for k in range(1, len(fast.time) - 1, 7):
        v = demo_kinematics.difference(fast.q[k - 1], fast.q[k + 1]) * RATE / 2
        assert np.abs(v - fast.v[k]).max() < 0.02


def test_the_robot_moves_on_while_contacts_change(demo_plan):
    """It rests at the start and at the end, and nowhere else."""
    t = timed(IK(demo_plan.world), demo_plan.changes, "max")
    assert t is not None
    speed = np.abs(np.asarray(t.v)).max(axis=1)
    a, b = (round((x + 0.1) * RATE) for x in (HOLD_START, t.time[-1] - HOLD_END - 0.2))
    assert speed[a:b].min() > 0.005
    apart = (
        build_trajectory(Kinematics(demo_plan.world), change.phases, speed="max")
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
