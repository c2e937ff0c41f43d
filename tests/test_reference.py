"""Following a trajectory, leaving it, and coming back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from clamber.execution.reference import BLEND, Reference
from clamber.model.kinematics import Kinematics
from clamber.model.world import PHYSICS_STEP


@pytest.fixture
def ref(hands_plan) -> Reference:
    return Reference(hands_plan.trajectory, hands_plan.world)


def exhaust(actions) -> int:
    return sum(1 for _ in actions)


def test_playing_goes_to_a_sample_or_until_something_happens(ref, hands_plan):
    t, dadr = hands_plan.trajectory, hands_plan.world.dadr
    assert exhaust(ref.play(700)) == 700
    assert ref.i == 700
    assert np.array_equal(ref.q, t.q[700])
    assert np.array_equal(ref.torque, t.tau[700])
    assert np.array_equal(ref.velocity, t.v[700, dadr])
    assert np.array_equal(ref.closed, t.contact[700])
    assert exhaust(ref.play(900, until=lambda: ref.i >= 750)) == 50
    assert exhaust(ref.play(740)) == 0
    assert np.array_equal(ref.closed_ahead(0.2), t.contact[950])
    assert np.array_equal(ref.closed_ahead(1e3), t.contact[-1])
    assert not ref.left_plan


def test_going_back_is_the_way_in_reverse(ref, hands_plan):
    t, dadr = hands_plan.trajectory, hands_plan.world.dadr
    exhaust(ref.play(900))
    assert exhaust(ref.back(800)) == 100
    assert np.array_equal(ref.q, t.q[800])
    assert np.array_equal(ref.velocity, -t.v[800, dadr])
    assert ref.left_plan


def test_resting_holds_the_reference_without_velocity(ref):
    exhaust(ref.play(900))
    q = ref.q
    assert exhaust(ref.rest(0.25)) == 250
    assert np.array_equal(ref.q, q)
    assert not ref.velocity.any()
    assert ref.left_plan


@pytest.mark.parametrize("found", [True, False])
def test_aside_goes_until_something_happens_or_there_and_back(ref, hands_plan, found):
    t = hands_plan.trajectory
    way = replace(
        t, **{n: getattr(t, n)[900:1000] for n in ("time", "q", "v", "tau", "contact")}
    )
    exhaust(ref.play(900))
    ticks = exhaust(ref.aside(way, lambda: found and ref.q[0] == way.q[60][0]))
    assert ticks == (61 if found else 200)
    assert np.array_equal(ref.q, way.q[60 if found else 0])
    if found:
        assert not ref.velocity.any()
    assert ref.i == 900  # the trajectory is where it was left
    assert ref.left_plan


def test_the_way_back_to_a_trajectory_is_smooth_and_its_rate_its_derivative(
    ref, hands_plan
):
    t, i, n = hands_plan.trajectory, 800, round(BLEND / PHYSICS_STEP)
    world, kin = hands_plan.world, Kinematics(hands_plan.world)
    offset = np.zeros(world.model.nv)
    offset[world.dadr] = 0.02 * np.cos(np.arange(len(world.dadr)))
    away = replace(
        t,
        time=t.time[:1],
        q=kin.integrate(t.q[i], offset)[None],
        v=t.v[i][None],
        tau=(t.tau[i] + 3.0)[None],
        contact=t.contact[i][None],
    )
    exhaust(ref.play(i))
    next(ref.aside(away, lambda: False))
    ref.resume()
    start, rows = ref.q.copy(), []
    for _ in ref.play(i + n + 20):
        rows.append((ref.q, ref.velocity, ref.torque))
    q, v, tau = (np.array(x) for x in zip(*rows, strict=True))
    assert np.abs(kin.difference(start, q[0])).max() < 1e-3
    assert np.allclose(q[n + 1 :], t.q[i + n + 2 : i + n + 21], atol=1e-12)
    assert np.allclose(tau[n + 1 :], t.tau[i + n + 2 : i + n + 21])
    assert np.allclose(tau[0], t.tau[i + 1] + 3.0)
    joints = q[:, world.qadr]
    numeric = (joints[2:] - joints[:-2]) / (2 * PHYSICS_STEP)
    assert np.allclose(v[1:-1], numeric, atol=1e-3)
    left = [kin.difference(a, b) for a, b in zip(t.q[i + 1 :], q, strict=False)]
    assert np.all(np.diff(np.abs(np.array(left)).max(axis=1)) < 1e-9)


def test_what_was_commanded_is_kept_where_it_is_not_the_trajectory(ref, hands_plan):
    t, world = hands_plan.trajectory, hands_plan.world
    for _ in ref.play(500):
        ref.record(ref.q)
    assert ref.seconds == pytest.approx(0.499)
    assert ref.followed(t.keyframes) is None
    for _ in ref.rest(0.1):
        ref.record(ref.q + 1e-3)
    done = ref.followed(t.keyframes[:1])
    assert len(done.time) == 600
    assert np.array_equal(done.q[:500], t.q[1:501])
    assert np.array_equal(done.q[500:], np.tile(t.q[500] + 1e-3, (100, 1)))
    assert np.array_equal(done.v[:500, world.dadr], t.v[1:501, world.dadr])
    assert not done.v[:, :6].any()
    assert np.array_equal(done.contact[:500], t.contact[1:501])
