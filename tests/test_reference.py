"""Following a trajectory, leaving it, and coming back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from clamber.execution.reference import (
    BLEND,
    RAMP,
    STEPS,
    UNHURRIED,
    Reference,
    ramped,
)
from clamber.model.kinematics import Kinematics
from clamber.model.world import PHYSICS_STEP


@pytest.fixture
def ref(hands_plan) -> Reference:
    return Reference(hands_plan.trajectory, hands_plan.world)


PERIOD = 10  # steps after which a controller looks around


def steps(ref: Reference, actions):
    """The steps of actions, which go on as a controller has them go on."""
    for _ in actions:
        while ref.track.advance():
            yield
            if not ref.track.done % PERIOD:
                break


def exhaust(ref: Reference, actions) -> int:
    return sum(1 for _ in steps(ref, actions))


def test_playing_goes_to_a_sample_or_until_something_happens(ref, hands_plan):
    t, dadr = hands_plan.trajectory, hands_plan.world.dadr
    assert exhaust(ref, ref.play(700)) == 700
    assert ref.i == 700
    assert np.array_equal(ref.q, t.q[700])
    assert np.array_equal(ref.torque, t.tau[700])
    assert np.array_equal(ref.velocity, t.v[700, dadr])
    assert np.array_equal(ref.closed, t.contact[700])
    assert exhaust(ref, ref.play(900, until=lambda: ref.i >= 750)) == 50
    assert exhaust(ref, ref.play(740)) == 0
    assert not ref.left_plan


def test_going_back_is_the_way_in_reverse_from_rest_to_rest(ref, hands_plan):
    """Slowed down along the trajectory at first: the robot was moving."""
    t, kin = hands_plan.trajectory, Kinematics(hands_plan.world)
    exhaust(ref, ref.play(900))
    ramp = round(RAMP / PHYSICS_STEP)
    rows = [(ref.q.copy(), ref.velocity.copy()) for _ in steps(ref, ref.back(700))]
    # The 200 samples and those of slowing down, in less of a hurry than they came.
    away = 200 + ramp // 2
    slower = max(away, round(UNHURRIED / PHYSICS_STEP))
    assert len(rows) == ramp + slower + ramp
    assert np.abs(rows[ramp - 1][1]).max() < 1e-3
    assert np.abs(kin.difference(rows[ramp - 1][0], t.q[900 + ramp // 2])).max() < 1e-9
    assert ref.i == 700
    assert np.abs(kin.difference(ref.q, t.q[700])).max() < 1e-9
    assert np.abs(ref.velocity).max() < 1e-3
    assert ref.left_plan
    joints = np.array([q[hands_plan.world.qadr] for q, _ in rows])
    numeric = (joints[2:] - joints[:-2]) / (2 * PHYSICS_STEP)
    assert np.abs(numeric - np.array([v for _, v in rows])[1:-1]).max() < 0.02


def test_it_stops_before_a_limb_leaves_and_starts_again_as_smoothly(ref, hands_plan):
    t = hands_plan.trajectory
    leaves = [x.begin for x in t.segments if x.kind == "swing"]
    exhaust(ref, ref.play(leaves[1] - 40))
    assert exhaust(ref, ref.stop()) == 78
    assert ref.i == leaves[1] - 1
    assert not ref.moves
    assert exhaust(ref, ref.stop()) == 0
    i, ramp = ref.i, round(RAMP / PHYSICS_STEP)
    rows = [ref.velocity.copy() for _ in steps(ref, ref.play(i + 300))]
    assert len(rows) == 300 + ramp // 2
    assert np.abs(rows[0]).max() < 1e-2
    assert np.array_equal(rows[-1], t.v[i + 300, hands_plan.world.dadr])


def test_slowing_down_it_goes_on_without_having_stopped(ref, hands_plan):
    t, dadr = hands_plan.trajectory, hands_plan.world.dadr
    begin = next(x.begin for x in t.segments if x.kind == "swing") + 200
    exhaust(ref, ref.play(begin))
    q = [ref.q.copy()]
    for _ in steps(ref, ref.stop(until=lambda: ref.i >= begin + 40)):
        q.append(ref.q.copy())
    rate = ref.rate
    assert 0.2 < rate < 0.95
    q += [ref.q.copy() for _ in steps(ref, ref.play(begin + 300))]
    assert ref.rate == pytest.approx(1.0, abs=0.01)
    assert np.allclose(ref.velocity, t.v[begin + 300, dadr], rtol=0.01)
    # No step in velocity where it turns: it is never slower than it was there.
    speed = np.abs(np.diff(np.array(q)[:, hands_plan.world.qadr], axis=0)).max(axis=1)
    planned = np.abs(t.v[begin : begin + 300, dadr]).max(axis=1) * PHYSICS_STEP
    assert speed[20:].min() > 0.9 * rate * planned.min()
    assert exhaust(ref, ref.stop(until=lambda: True)) == 0  # it has happened already


def test_a_pause_is_slowed_down_for_and_gone_on_from(ref, hands_plan):
    t, dadr = hands_plan.trajectory, hands_plan.world.dadr
    (begin, end), *_ = [(x.begin, x.end) for x in t.segments if x.kind == "swing"]
    exhaust(ref, ref.play(begin))
    ref.pause = 0.5
    rows = [ref.velocity.copy() for _ in steps(ref, ref.play(end))]
    still = [not v.any() for v in rows]
    assert sum(still) == 500
    first = still.index(True)
    assert all(still[first : first + 500])
    assert np.abs(rows[first - 1]).max() < 0.01
    assert np.abs(rows[first + 500]).max() < 0.01
    assert ref.pause == 0.0
    assert ref.i == end
    assert np.array_equal(ref.velocity, t.v[end, dadr])
    assert ref.left_plan


@pytest.mark.parametrize("distance", [1, 2, 7, 100, 1000])
@pytest.mark.parametrize("rate", [0.1, 0.5, 0.9])
def test_a_ramp_goes_on_from_any_rate(distance, rate):
    done, rates = ramped(distance, up=rate)
    assert done[-1] == distance
    assert np.all(np.diff(rates) >= 0)
    if distance > 100:
        assert rates[0] == pytest.approx(rate, abs=0.03)
        assert rates[-1] == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("distance", [1, 2, 7, 100, 1000])
@pytest.mark.parametrize("ends", [(), ("up",), ("down",), ("up", "down")])
def test_a_ramp_covers_its_distance_and_its_rate_is_never_above_one(distance, ends):
    done, rate = ramped(distance, **{n: {"up": 0.0, "down": True}[n] for n in ends})
    assert done[-1] == distance
    assert np.all(np.diff(done) > 0)
    assert rate.min() >= 0.0
    assert rate.max() <= 1.0
    assert np.sum(rate) == pytest.approx(distance)


def test_resting_holds_the_reference_without_velocity(ref):
    exhaust(ref, ref.play(900))
    q = ref.q.copy()
    assert exhaust(ref, ref.rest(0.25)) == 250
    assert np.array_equal(ref.q, q)
    assert not ref.velocity.any()
    assert ref.left_plan


@pytest.mark.parametrize("found", [True, False])
def test_aside_goes_until_something_happens_or_there_and_back(ref, hands_plan, found):
    t = hands_plan.trajectory
    way = replace(
        t, **{n: getattr(t, n)[900:1000] for n in ("time", "q", "v", "tau", "contact")}
    )
    exhaust(ref, ref.play(900))
    ticks = exhaust(
        ref, ref.aside(way, lambda: found and ref.q[0] == way.q[59][0], lambda: False)
    )
    assert ticks == (60 if found else 200)
    assert np.array_equal(ref.q, way.q[59 if found else 0])
    assert ref.i == 900  # the trajectory is where it was left
    assert ref.left_plan


def test_aside_is_left_at_once_where_something_else_happens(ref, hands_plan):
    """Back over what was done, no farther."""
    t = hands_plan.trajectory
    way = replace(
        t, **{n: getattr(t, n)[900:1000] for n in ("time", "q", "v", "tau", "contact")}
    )
    exhaust(ref, ref.play(900))
    went = []
    gen = ref.aside(way, lambda: False, lambda: bool(ref.q[0] == way.q[59][0]))
    for _ in steps(ref, gen):
        went.append(ref.q.copy())
    assert len(went) == 120
    assert np.array_equal(went[60:], went[59::-1])
    assert np.array_equal(ref.q, way.q[0])


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
    exhaust(ref, ref.play(i))
    next(steps(ref, ref.aside(away, lambda: False, lambda: False)))
    ref.resume()
    rows = []
    start = ref.q.copy()
    for _ in steps(ref, ref.play(i + n + 20)):
        rows.append((ref.q.copy(), ref.velocity.copy(), ref.torque.copy()))
    q, v, tau = (np.array(x) for x in zip(*rows, strict=True))
    assert np.abs(kin.difference(start, q[0])).max() < 1e-3
    assert np.allclose(q[-19:], t.q[i + n + 2 : i + n + 21], atol=1e-12)
    assert np.allclose(tau[-19:], t.tau[i + n + 2 : i + n + 21])
    assert np.allclose(tau[0], t.tau[i] + 3.0, atol=0.05)
    joints = q[:, world.qadr]
    numeric = (joints[2:] - joints[:-2]) / (2 * PHYSICS_STEP)
    assert np.allclose(v[1:-1], numeric, atol=0.02)
    late = len(q) - (n + 20)  # of a start from rest
    there = t.q[i + 1 : i + n + 21]
    left = [kin.difference(a, b) for a, b in zip(there, q[late:], strict=True)]
    assert np.abs(left[-19:]).max() < 1e-9


def test_what_was_commanded_is_kept_where_it_is_not_the_trajectory(ref, hands_plan):
    t, world = hands_plan.trajectory, hands_plan.world
    q = [ref.q.copy() for _ in steps(ref, ref.play(500))]
    assert ref.followed(np.array(q), t.keyframes) is None
    q += [ref.q + 1e-3 for _ in steps(ref, ref.rest(0.1))]
    done = ref.followed(np.array(q), t.keyframes[:1])
    assert len(done.time) == 600
    assert np.allclose(done.q[:500], t.q[1:501], rtol=0.0, atol=STEPS["q"])
    assert np.allclose(done.q[500:], t.q[500] + 1e-3, rtol=0.0, atol=STEPS["q"])
    there = t.v[1:501, world.dadr]
    assert np.allclose(done.v[:500, world.dadr], there, rtol=0.0, atol=STEPS["v"])
    assert not done.v[500:].any()
    assert not done.v[:, :6].any()
    assert np.array_equal(done.contact[:500], t.contact[1:501])


def test_what_was_left_in_the_middle_is_kept_as_far_as_it_was_followed(ref, hands_plan):
    """Forwards, back and forwards again."""
    t = hands_plan.trajectory
    q = [ref.q.copy() for _ in steps(ref, ref.play(900, until=lambda: ref.i == 850))]
    q += [ref.q.copy() for _ in steps(ref, ref.back(840))]
    q += [ref.q.copy() for _ in steps(ref, ref.play(845))]
    done = ref.followed(np.array(q), t.keyframes)
    assert np.allclose(done.tau[:850], t.tau[1:851], rtol=0.0, atol=STEPS["tau"])
    assert np.allclose(done.tau[-1], t.tau[845], rtol=0.0, atol=STEPS["tau"])
    for x in (done.q, done.v, done.tau):  # as files have it
        assert np.array_equal(x, x.astype(np.float32))
    assert len(done.contact) == len(q)


def test_foot_contacts_are_told_a_second_ahead(hands_plan):
    """That ankles are held again before a foot steps."""
    t = hands_plan.trajectory
    later = replace(t, contact=np.arange(len(t.time))[:, None] < [1500] * 8)
    ref = Reference(later, hands_plan.world)
    ahead = [ref.track.ahead[0] for _ in steps(ref, ref.play(600))]
    assert ahead.index(False) == 1500 - 1000 - 1
    exhaust(ref, ref.rest(0.01))
    assert not ref.track.ahead.any()
    exhaust(ref, ref.back(499))
    assert ref.track.ahead.all()
