"""The timed reference: smooth, exact, within limits, and balanced by its torques."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import nnls

from clamber.model.kinematics import Kinematics
from clamber.model.se3 import quat_conjugate, quat_multiply
from clamber.planning.samples import spline_through
from clamber.planning.timing import BASE_LENGTH
from clamber.planning.trajectory import (
    HOLD_END,
    HOLD_START,
    RATE,
    Samples,
    build_trajectory,
    handed_over,
    holding_torque,
    holding_torques,
    timed,
)
from clamber.step.ik import IK
from clamber.step.path import straightened
from clamber.step.stability import statics_at
from clamber.step.statics import Load, cone_generators, contact_forces
from clamber.step.tasks import contact_rows, packed_contacts


@pytest.fixture(scope="module")
def knee_phases(demo_plan):
    """Shift, swing and settle of the left knee."""
    path = next(p for p in demo_plan.changes if "LFoot" in p.step.breaks)
    return path.phases


def velocity_errors(kin, trajectory, step: int) -> np.ndarray:
    """Central differences over `step` samples either side, against v."""
    T = len(trajectory.time)
    return np.array(  # the same samples for every step
        [
            np.abs(
                kin.difference(trajectory.q[k - step], trajectory.q[k + step])
                * (RATE / (2 * step))
                - trajectory.v[k]
            ).max()
            for k in range(50, T - 50, 53)
        ]
    )


def test_the_bend_is_the_derivative_of_the_tangent(demo_kinematics):
    """Of a spline whose base turns fast: five places, central differences."""
    rng, nv = np.random.default_rng(3), demo_kinematics.world.model.nv
    q = np.tile(demo_kinematics.world.home, (4, 1))
    for a, b in itertools.pairwise(range(4)):
        q[b] = demo_kinematics.integrate(q[a], rng.normal(0.0, 0.5, nv))
    s, none = np.array([0.0, 0.7, 1.2, 2.0]), np.zeros((2, q.shape[1]))
    spline = spline_through(s, q, none, np.zeros(0), np.zeros((0, 0)))
    at, h = np.array([0.05, 0.5, 0.9, 1.5, 1.9]), 1e-5
    _, _, bend = spline.along(at)
    _, before, _ = spline.along(at - h)
    _, after, _ = spline.along(at + h)
    assert np.abs(bend[:, 3:6]).min(axis=1).max() > 0.1
    assert np.allclose(bend, (after - before) / (2.0 * h), atol=1e-6)


def test_where_phases_join_no_closed_contact_moves(demo_plan, demo_kinematics):
    """The tangent is the mean of both sides, less what would move a contact."""
    kin, world = demo_kinematics, demo_plan.world
    q, step = demo_plan.changes[2].phases[0].q[0], 0.2
    contacts = demo_plan.changes[2].phases[0].contacts
    rng = np.random.default_rng(5)
    v = rng.normal(0.0, 0.3, world.model.nv)
    rows = np.stack(
        [kin.integrate(q, -step * v), q, q, kin.integrate(q, step * v)]
    )  # the same speed on both sides
    slope = kin.core.tangents(rows, step, step, 2.0, *packed_contacts(world, contacts))
    assert np.array_equal(slope[0], slope[1])
    kin.update(q)
    A = contact_rows(kin, contacts)
    along = v - np.linalg.pinv(A) @ (A @ v)
    assert np.abs(A @ v).max() > 0.1
    assert np.allclose(np.delete(slope[0], range(3, 7)), np.delete(along, range(3, 6)))
    turn = quat_multiply(quat_conjugate(q[3:7]), 2.0 * slope[0, 3:7])
    assert np.allclose(turn, [0.0, *along[3:6]])
    # Another way, or far slower on one side: what both have, and twice that.
    rows[3] = kin.integrate(q, -step * v)
    turned = kin.core.tangents(rows, step, step, 2.0, *packed_contacts(world, ()))
    assert not turned.any()
    rows[3] = kin.integrate(q, 0.1 * step * v)
    slower = kin.core.tangents(rows, step, step, 2.0, *packed_contacts(world, ()))
    assert np.allclose(slower[1, 7:], 0.2 * v[6:])


def test_samples_are_a_millisecond_apart(demo_plan):
    time = demo_plan.trajectory.time
    assert np.allclose(np.diff(time), 1e-3, atol=1e-12)
    assert time[0] == 0.0


def test_velocity_is_the_derivative_on_the_manifold(demo_plan, demo_kinematics):
    # Where phases join, acceleration may have a step: half a millisecond of it.
    assert velocity_errors(demo_kinematics, demo_plan.trajectory, 1).max() < 1e-3


def test_difference_quotients_converge_to_the_velocity_with_second_order(
    demo_plan, demo_kinematics
):
    # An exact derivative: four times the step, sixteen times the error.
    near = velocity_errors(demo_kinematics, demo_plan.trajectory, 4)
    far = velocity_errors(demo_kinematics, demo_plan.trajectory, 16)
    moving = (far > 1e-6) & (near > 1e-8)
    assert np.median(far[moving] / near[moving]) == pytest.approx(16, rel=0.1)


def test_difference_quotients_see_a_velocity_in_the_wrong_frame(
    demo_plan, demo_kinematics
):
    """The base's angular velocity is in its own frame; in the world's it is wrong."""
    trajectory = demo_plan.trajectory
    wrong = np.array(trajectory.v)
    for k in range(len(wrong)):
        demo_kinematics.data.qpos[:] = trajectory.q[k]
        w, x, y, z = trajectory.q[k, 3:7]
        R = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        wrong[k, 3:6] = R @ wrong[k, 3:6]
    wrong = replace(trajectory, v=wrong)
    assert velocity_errors(demo_kinematics, wrong, 1).max() > 0.01


def test_velocity_integrates_to_the_last_posture(demo_plan, demo_kinematics):
    trajectory = demo_plan.trajectory
    q = trajectory.q[0].copy()
    for a, b in itertools.pairwise(trajectory.v):
        q = demo_kinematics.integrate(q, 0.5 * (a + b) / RATE)
    assert np.abs(demo_kinematics.difference(q, trajectory.q[-1])).max() < 1e-5


@pytest.mark.parametrize("speed", [0.05, 0.3, 1.0])
def test_no_joint_is_faster_than_the_limit_and_the_fastest_reaches_it(
    demo_plan, knee_phases, speed
):
    trajectory = build_trajectory(Kinematics(demo_plan.world), knee_phases, speed=speed)
    fastest = np.abs(trajectory.v[:, 6:]).max()
    assert fastest <= speed * 1.03  # between two looks at it
    if speed < 0.5:  # at 1 rad/s the phases are too short to cruise
        scaled = np.abs(trajectory.v).copy()
        scaled[:, :3] /= BASE_LENGTH
        assert scaled.max() >= 0.95 * speed


def test_it_starts_and_ends_at_rest(demo_plan):
    trajectory = demo_plan.trajectory
    start, end = round(HOLD_START * RATE), round(HOLD_END * RATE)
    assert not trajectory.v[:start].any()
    assert not trajectory.v[-end:].any()
    assert np.ptp(trajectory.q[-end:], axis=0).max() == 0.0


def test_where_contacts_change_none_of_them_moves(demo_plan, demo_kinematics):
    t, kin = demo_plan.trajectory, demo_kinematics
    world, up = demo_plan.world, np.array([0.0, 0.0, 1.0])
    changes = 1 + np.flatnonzero(np.diff(t.contact, axis=0).any(axis=1))
    assert len(changes) >= 2 * len(demo_plan.changes) - 2
    slides = []
    for k in changes:
        kin.update(t.q[k])
        closed = t.contact[k] | t.contact[k - 1]
        for s in (s for s, on in zip(t.surfaces, closed, strict=True) if on):
            p = kin.contact_point(s, up)
            J = kin.point_jacobian(world.surfaces[s].body, p)
            slides.append(np.linalg.norm(J @ t.v[k]))
    assert max(slides) < 0.02  # [m/s]
    assert np.abs(t.v[changes]).max() > 0.1  # while the robot moves


def test_velocity_has_no_jumps(demo_plan):
    # What may be gained in a millisecond, and what the spline bends by itself.
    steps = np.abs(np.diff(demo_plan.trajectory.v, axis=0)).max() * RATE
    assert steps < 30.0  # [rad/s^2]


def test_joint_limits_are_respected_at_every_sample(demo_plan):
    world, q = demo_plan.world, demo_plan.trajectory.q[:, demo_plan.world.qadr]
    over = np.maximum(world.q_min[world.dadr] - q, q - world.q_max[world.dadr])
    assert over.max() < 5e-3


def test_base_quaternions_are_unit_and_never_jump_to_the_other_sign(demo_plan):
    quat = demo_plan.trajectory.q[:, 3:7]
    assert np.abs(np.linalg.norm(quat, axis=1) - 1.0).max() < 1e-12
    assert np.sum(quat[1:] * quat[:-1], axis=1).min() > 0.999


def test_the_other_sign_of_a_posture_s_quaternion_changes_nothing(
    demo_plan, knee_phases
):
    shift = knee_phases[0]
    flipped = shift.q.copy()
    flipped[1::2, 3:7] *= -1
    a, b = (
        build_trajectory(Kinematics(demo_plan.world), (replace(shift, q=q),), speed=0.3)
        for q in (shift.q, flipped)
    )
    assert np.allclose(a.q, b.q, atol=1e-12)
    assert np.allclose(a.v, b.v, atol=1e-12)


def test_it_passes_through_every_posture_of_every_path_in_order(
    demo_plan, demo_kinematics
):
    phases = [p for change in demo_plan.changes for p in change.phases]
    trajectory, k = build_trajectory(Kinematics(demo_plan.world), phases, speed=0.3), 0
    for phase in phases:
        for node in phase.q:
            window = trajectory.q[k : k + 8000]
            far = np.abs(window[:, 7:] - node[7:]).max(axis=1)
            # within half a sample's way at the speed limit
            first = int(np.flatnonzero(far < 1.6e-4)[0])
            k += first
            d = demo_kinematics.difference(trajectory.q[k], node)
            assert np.abs(d).max() < 2e-3
    assert k <= len(trajectory.time)


def test_a_keyframe_is_reached_between_a_touch_and_the_next_lift_off(demo_plan):
    t = demo_plan.trajectory
    assert len(t.keyframes) == len(demo_plan.keyframes)
    assert np.all(np.diff(t.keyframes) > 0)
    ends = [demo_plan.keyframes[i].q for i in (0, -1)]
    for time, q in zip(t.keyframes[[0, -1]], ends, strict=True):
        assert np.allclose(t.q[t.at(time)], q, atol=1e-9)
    for time, key in zip(t.keyframes, demo_plan.keyframes, strict=True):
        flags = t.contact[t.at(time)]
        closed = {s for s, on in zip(t.surfaces, flags, strict=True) if on}
        assert closed == {c.surface for c in key.stance}


def test_the_way_to_the_next_lift_off_is_shorter_than_by_the_keyframe(demo_plan):
    ik, shorter = IK(demo_plan.world), []
    for a, b in itertools.pairwise(demo_plan.changes):
        settle, shift = a.phases[2], b.phases[0]
        found = straightened(ik, settle, shift)
        if found is None:
            continue
        assert np.array_equal(found[0].q[0], settle.q[0])
        assert np.array_equal(found[1].q[-1], shift.q[-1])
        assert np.array_equal(found[0].q[-1], found[1].q[0])
        ways = [
            np.abs(np.diff(np.concatenate([x.q, y.q])[:, 7:], axis=0)).sum()
            for x, y in ((settle, shift), found)
        ]
        shorter.append(ways[1] / ways[0])
    assert len(shorter) > 2
    assert max(shorter) < 1.0 + 1e-6
    # A foot that is let go on tiptoe stands otherwise: its phases stay as they are.
    on_edge = (replace(c, edge=0) if "Foot" in c.surface else c for c in shift.contacts)
    rolled = replace(shift, contacts=tuple(on_edge))
    assert rolled.contacts != shift.contacts
    assert straightened(ik, settle, rolled) is None


def test_at_is_clipped_to_the_ends(demo_plan):
    trajectory = demo_plan.trajectory
    assert trajectory.at(-1.0) == 0
    assert trajectory.at(1e6) == len(trajectory.time) - 1
    assert trajectory.at(0.5) == 500


def test_the_moving_surface_is_open_while_it_swings(demo_plan, knee_phases):
    trajectory = build_trajectory(Kinematics(demo_plan.world), knee_phases, speed=0.3)
    foot, knee = (trajectory.surfaces.index(n) for n in ("LFoot", "LKnee"))
    changes = np.flatnonzero(np.diff(trajectory.contact, axis=0).any(axis=1))
    lift, land = changes
    assert trajectory.contact[: lift + 1, foot].all()
    assert not trajectory.contact[lift + 1 :, foot].any()
    assert not trajectory.contact[: land + 1, knee].any()
    assert trajectory.contact[land + 1 :, knee].all()


def unbalanced(kin, q, contacts, tau) -> tuple[float, float]:
    """Least |J' f + S' tau - g| over forces in the friction cones, base and joints."""
    world = kin.world
    kin.update(q)
    points, _, torque = statics_at(kin, q, contacts)
    cones = cone_generators(points.normals, points.mu, 16)
    J = torque.jacobian.reshape(len(cones), 3, -1)
    columns = [j.T @ g.T for j, g in zip(J, cones, strict=True)]
    wanted = kin.gravity()
    wanted[world.dadr] -= tau
    A = np.concatenate(columns, axis=1)
    left = A @ nnls(A, wanted)[0] - wanted
    return float(np.abs(left[:6]).max()), float(np.abs(left[6:]).max())


def test_holding_torques_and_forces_in_the_cones_balance_gravity(
    demo_plan, demo_kinematics
):
    for key in demo_plan.keyframes:
        tau = holding_torque(demo_kinematics, key.q, key.stance)
        base, joints = unbalanced(demo_kinematics, key.q, key.stance, tau)
        assert base < 1e-2  # [N, N m] of 300 N
        assert joints < 1e-2


def handed_over_torques(kin, phase) -> np.ndarray:
    """(n, na) at rest in each posture of a phase, load handed over evenly."""
    contacts, prices = handed_over(phase, np.linspace(0.0, 1.0, len(phase.q)))
    return holding_torques(kin, phase.q, contacts, prices)


def test_feed_forward_balances_gravity_all_the_while_load_is_handed_over(
    demo_plan, demo_kinematics
):
    """Contacts that leave bear until the centre of mass is over those that stay."""
    for path in demo_plan.changes:
        for phase in path.phases:
            both = {
                (c.surface, c.edge): c for c in (*phase.load_before, *phase.load_after)
            }
            taus = handed_over_torques(demo_kinematics, phase)
            for q, tau in zip(phase.q, taus, strict=True):
                base, joints = unbalanced(demo_kinematics, q, tuple(both.values()), tau)
                assert base < 5e-2  # [N, N m] of 300 N
                assert joints < 5e-2


def test_a_contact_that_leaves_bears_less_and_less(demo_kinematics, knee_phases):
    shift = knee_phases[0]
    foot = next(c for c in shift.load_before if c.surface == "LFoot")
    shares = []
    every, prices = handed_over(shift, np.array([0.0, 0.25, 0.5, 0.75, 0.95, 1.0]))
    for row in prices:
        contacts = [c for c, p in zip(every, row, strict=True) if p]
        price = row[row > 0.0]
        assert np.all(price >= 1.0)
        if foot not in contacts:
            shares.append(0.0)
            continue
        kin = demo_kinematics
        kin.update(shift.q[0])  # the same posture: only the price differs
        points, *_ = statics_at(kin, shift.q[0], contacts)
        prices = [price[[c.surface for c in contacts].index(n)] for n in points.names]
        load = Load(com=kin.com.copy(), mass=kin.world.mass)
        f = contact_forces(points, load, price=np.array(prices)).forces
        mine = [n == "LFoot" for n in points.names]
        shares.append(float(f[mine, 2].sum()))
    assert np.all(np.diff(shares[:-1]) <= 1e-6)
    assert shares[0] > shares[-2] + 1.0
    assert shares[-1] == 0.0


def test_feed_forward_hands_the_load_over_from_old_to_new_contacts(
    demo_kinematics, knee_phases
):
    shift, swing, settle = knee_phases
    kin = demo_kinematics
    for phase in knee_phases:
        tau = handed_over_torques(kin, phase)
        first = holding_torque(kin, phase.q[0], phase.load_before)
        last = holding_torque(kin, phase.q[-1], phase.load_after)
        assert np.allclose(tau[0], first, atol=1e-9)
        assert np.allclose(tau[-1], last, atol=1e-9)
    assert shift.load_after == swing.load_before == settle.load_before


def test_feed_forward_torques_are_continuous_and_within_effort_limits(demo_plan):
    for speed in (1.0, demo_plan.options.speed):
        made = timed(IK(demo_plan.world), demo_plan.changes, speed)
        assert made is not None
        tau = made.tau
        assert np.all(np.abs(tau) <= demo_plan.world.tau_max + 1e-9)
        # [N m] in a millisecond
        assert np.abs(np.diff(tau, axis=0)).max() < 0.5 * max(1.0, speed)


def test_phases_that_do_not_join_are_refused(demo_plan, knee_phases):
    shift, _, settle = knee_phases
    with pytest.raises(ValueError, match="does not begin where the last one ended"):
        build_trajectory(Kinematics(demo_plan.world), (shift, settle), speed=0.3)


def test_arrays_of_different_length_are_refused(demo_plan):
    with pytest.raises(ValueError, match="tau has"):
        replace(demo_plan.trajectory, tau=demo_plan.trajectory.tau[:-1])


def test_arrays_are_read_only(demo_plan):
    row = demo_plan.trajectory.q[0]
    with pytest.raises(ValueError, match="read-only"):
        row[0] = 1.0
    arrays = replace(demo_plan.trajectory, q=np.array(demo_plan.trajectory.q))
    assert isinstance(arrays.q, np.ndarray)
    with pytest.raises(ValueError, match="read-only"):
        arrays.q[0, 0] = 1.0


@pytest.mark.parametrize("name", ["q", "v", "tau"])
def test_what_is_sampled_when_asked_for_is_indexed_as_an_array_is(demo_plan, name):
    x = getattr(demo_plan.trajectory, name)
    assert isinstance(x, Samples)
    every = np.concatenate(list(x.blocks()))
    assert every.shape == x.shape == (len(demo_plan.trajectory.time), x.shape[1])
    assert np.array_equal(np.asarray(x), every)
    assert np.array_equal(np.array(list(x)), every)
    rng, n = np.random.default_rng(1), len(x)
    for k in (0, -1, n - 1, -n, *rng.integers(0, n, 30).tolist(), np.int64(7)):
        assert np.array_equal(x[k], every[k])
        assert np.array_equal(x[k, [2, 1]], every[k, [2, 1]])
    rows = rng.integers(-n, n, 500)
    mask = rng.random(n) < 0.01
    for key in (slice(None), slice(5, None, 97), slice(-9, None, -1), rows, mask):
        assert np.array_equal(x[key], every[key])
        assert np.array_equal(x[key, 1:4], every[key, 1:4])
    for key in (np.ix_(rows, [2, 1]), (rows[:3], [3, 0, 2]), (rows[:9, None], 1)):
        assert np.array_equal(x[key], every[key])
    assert x[3:3].shape == (0, x.shape[1])
    with pytest.raises(IndexError):
        x[[0, n]]
    for k in (n, -n - 1):
        with pytest.raises(IndexError):
            x[k]


def test_a_planned_trajectory_holds_no_samples(demo_plan):
    """Twice the samples, no more memory: only the last block of them is kept."""
    t = demo_plan.trajectory
    longest = np.diff(t.keyframes).max() * RATE
    for x in (t.q, t.v, t.tau):
        assert isinstance(x, Samples)
        for k in range(0, len(x), 500):
            x[k]
        assert len(x._held[1]) <= longest < len(x) / 2
