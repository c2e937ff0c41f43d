"""Execution by feel: in physics, and action by action on what it is told."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import ClassVar

import mujoco
import numpy as np
import pytest

from clamber.errors import Status
from clamber.execution import executive as execution
from clamber.execution import simulation
from clamber.execution.disturbance import Disturbance
from clamber.execution.executive import (
    AHEAD,
    BLEND,
    DEVIATION,
    EASING,
    FALLBACK,
    FORCE_SMOOTHING,
    LEANING,
    LOOK,
    LOST,
    MASS_CHANGE,
    NEAR,
    SAME_PLACE,
    SEARCHES,
    START_DRIFT,
    THINKING,
    TOUCH,
    Execution,
    Tracking,
    _ankles,
    _legs,
)
from clamber.execution.leaning import Lean
from clamber.execution.sensors import Measurement
from clamber.execution.servo import JointLaw
from clamber.execution.simulation import (
    FALLEN_HEIGHT,
    FALLEN_TILT,
    has_fallen,
    simulate,
)
from clamber.execution.verdict import END_SPEED, Figure, judge, measure
from clamber.model.kinematics import Kinematics
from clamber.model.world import PHYSICS_STEP
from clamber.planning.adaptation import FEELING_SPEED, REACH
from clamber.planning.records import Plan
from clamber.planning.trajectory import HOLD_END, HOLD_START
from clamber.step.change import Failure

EXACT = {"noise": 0.0, "delay": 0.0}
TOP = 0.275  # [m] the box that was planned for


class Watched(Execution):
    """Keeps what it measured and how its ankles were held."""

    made: ClassVar[list[Watched]] = []

    def __init__(self, plan, world):
        super().__init__(plan, world)
        self.ankles, self.loads = [], []
        Watched.made.append(self)

    def command(self, measured):
        out = super().command(measured)
        self.ankles.append(self._positioned.copy())
        self.loads.append(self._load.copy())
        return out


def run(plan, **disturbance):
    """What physics made of it, and the pilot as it was at the end."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulation, "Execution", Watched)
        rollout = simulate(plan, disturbance=Disturbance(**disturbance))
    return rollout, Watched.made.pop()


def texts(rollout) -> list[str]:
    return [str(e) for e in rollout.events]


def event(rollout, pattern: str) -> tuple[float, re.Match]:
    """Time and match of the first event like that."""
    for e in rollout.events:
        if found := re.search(pattern, str(e)):
            return e.time, found
    raise AssertionError(f"no {pattern!r} in {texts(rollout)}")


def described(contacts) -> list[str]:
    return sorted(f"{c.surface}@{c.support}" for c in contacts)


def point_at(rollout, time: float, surface: str) -> np.ndarray:
    """(3,) where a ball of the real robot was lowest."""
    kin = Kinematics(rollout.world)
    kin.update(rollout.qpos[round(time / rollout.time[1])])
    return kin.contact_point(surface, np.array([0.0, 0.0, 1.0]))


def load(rollout, time: float) -> dict[str, float]:
    row = rollout.contact_force[round(time / rollout.time[1])]
    return dict(zip(rollout.surfaces, row[:, 2].tolist(), strict=True))


@pytest.fixture(scope="module")
def still(fast_plan):
    """The whole climb, nothing disturbed."""
    return run(fast_plan, **EXACT)


@pytest.fixture(scope="module", params=[-0.03, 0.03], ids=["lower", "higher"])
def other_height(request, hands_plan):
    return request.param, *run(hands_plan, height=request.param, **EXACT)


@pytest.fixture(scope="module")
def climbed(fast_plan):
    """The whole climb onto a box that is lower than was planned."""
    return run(fast_plan, height=-0.03, **EXACT)


@pytest.fixture(scope="module")
def gone(hands_plan):
    """The top is far below where it was planned."""
    return run(hands_plan, height=-0.2, **EXACT)


@pytest.fixture(scope="module")
def aside(hands_plan):
    return run(hands_plan, x=-0.02, y=0.02, yaw=0.08, **EXACT)


@pytest.fixture
def pilot(hands_plan) -> Execution:
    """At the beginning, nothing measured."""
    return Execution(hands_plan, hands_plan.world)


def feel(pilot, **newtons: float) -> None:
    """Let the pilot believe these vertical forces."""
    for surface, f in newtons.items():
        pilot._load[pilot._surfaces.index(surface)] = [0.0, 0.0, f]


def exhaust(actions) -> int:
    return sum(1 for _ in actions)


# Nothing disturbed.


def test_undisturbed_nothing_is_to_be_said(fast_plan, still):
    rollout, pilot = still
    assert rollout.events == ()
    assert rollout.stopped == ""
    assert not rollout.fell
    assert judge(fast_plan, rollout).reached
    assert pilot._made == len(pilot._steps) == 6
    assert sorted(rollout.rests_on) == described(fast_plan.keyframes[-1].stance)
    assert pilot._scale == 1.0


def test_undisturbed_the_plan_itself_is_followed_up_to_the_first_touch(
    fast_plan, still
):
    """Then contacts may be waited for: what is followed is the plan, later."""
    rollout, _ = still
    touch = _legs(fast_plan.trajectory, fast_plan.keyframes)[0].touch
    t = fast_plan.trajectory
    assert np.array_equal(rollout.followed.q[: touch - 1], t.q[1:touch])
    assert np.array_equal(rollout.followed.tau[: touch - 1], t.tau[1:touch])
    late = len(rollout.followed.time) - len(t.time)
    assert 0 <= late * PHYSICS_STEP < 6 * 0.5
    assert np.abs(rollout.followed.q[-1] - t.q[-1]).max() < 0.02


def test_two_runs_are_the_same_to_the_last_bit(hands_plan):
    """With noise, delay and planning anew on the way."""
    a, b = (run(hands_plan, height=0.02, seed=3)[0] for _ in range(2))
    assert texts(a) == texts(b)
    assert "replanned: 1 contact change" in texts(a)
    for name in ("ctrl", "qpos", "qvel", "contact_force"):
        assert np.array_equal(getattr(a, name), getattr(b, name))
    assert [e.time for e in a.events] == [e.time for e in b.events]


# A box that is elsewhere.


def test_the_hand_stops_where_it_touches(hands_plan, other_height):
    height, rollout, _ = other_height
    time, _ = event(rollout, "LHand touches")
    k = round(time / PHYSICS_STEP)
    still = round((LOOK + THINKING) / PHYSICS_STEP)
    q = rollout.followed.q[k : k + still]
    assert np.all(q == q[0])
    assert not rollout.followed.v[k + 1 : k + still].any()
    p = point_at(rollout, time + 0.1, "LHand")
    assert p[2] == pytest.approx(TOP + height, abs=2e-3)
    # It is felt between two recorded states.
    felt = max(load(rollout, time + t)["LHand"] for t in (0.0, rollout.time[1]))
    assert felt > 0.5 * TOUCH
    moved = point_at(rollout, time + LOOK + THINKING, "LHand") - p
    # A hand that lands fast may bounce; it stays near, and the reference is still.
    assert np.linalg.norm(moved) < 0.02
    # Up to there it was the plan that was followed; then it was felt for.
    t = hands_plan.trajectory
    before = min(k, _legs(t, hands_plan.keyframes)[0].touch)
    assert np.array_equal(rollout.followed.q[: before - 1], t.q[1:before])


def test_an_event_says_where_it_touches_and_what_was_done(other_height):
    height, rollout, _ = other_height
    time, found = event(
        rollout, r"LHand touches (\d+) mm (above|below), (\d+) mm beside"
    )
    assert float(found[1]) == pytest.approx(1e3 * abs(height), abs=4)
    assert found[2] == ("above" if height > 0 else "below")
    assert float(found[3]) < 15
    again, _ = event(rollout, "replanned: 1 contact change$")
    assert again - time == pytest.approx(LOOK + THINKING, abs=0.01)


def test_the_box_is_believed_where_it_is(other_height):
    height, _, pilot = other_height
    top = pilot._world.supports["box"]
    for support, p in pilot._felt.values():
        assert support == "box"
        assert p[2] == pytest.approx(TOP + height, abs=2e-3)
        assert abs(top.height(p)) < 5e-3


def test_what_is_left_is_made_on_the_top_as_it_is(other_height):
    height, rollout, pilot = other_height
    assert rollout.stopped == ""
    assert not rollout.fell
    assert pilot._made == len(pilot._steps) == 2
    stance = pilot._keyframes[-1].stance
    assert described(stance) == sorted(rollout.rests_on)
    hands = [c for c in stance if c.support == "box"]
    assert {c.surface for c in hands} == {"LHand", "RHand"}
    end = load(rollout, rollout.time[-1])
    for c in hands:
        assert c.position[2] == pytest.approx(TOP + height, abs=5e-3)
        there = point_at(rollout, rollout.time[-1], c.surface)
        assert there[2] == pytest.approx(TOP + height, abs=2e-3)
        assert end[c.surface] > LOST


def test_the_whole_climb_ends_on_top_of_a_lower_box(fast_plan, climbed):
    rollout, pilot = climbed
    assert judge(fast_plan, rollout).reached
    assert texts(rollout)[1] == "replanned: 5 contact changes"
    assert pilot._made == len(pilot._steps) == 6
    assert sorted(rollout.rests_on) == described(fast_plan.keyframes[-1].stance)
    for key in pilot._keyframes:
        for c in key.stance:
            if c.support == "box":
                # A contact that is off by less than that is taken as planned.
                assert c.position[2] == pytest.approx(TOP - 0.03, abs=DEVIATION)
    for c in pilot._keyframes[-1].stance:
        there = point_at(rollout, rollout.time[-1], c.surface)
        assert there[2] == pytest.approx(TOP - 0.03, abs=5e-3)
    assert rollout.qpos[-1, 2] == pytest.approx(
        fast_plan.trajectory.q[-1, 2] - 0.03, abs=0.02
    )


def test_what_was_followed_is_written_down_step_by_step(climbed):
    """The commands are those of the joint law on what is said to be followed."""
    rollout, _ = climbed
    t = rollout.followed
    assert len(t.time) == len(rollout.ctrl)
    assert np.array_equal(t.time, np.arange(len(t.time)) * PHYSICS_STEP)
    assert not t.v[:, :6].any()
    w = rollout.world
    order = [w.model.actuator(j).id for j in w.joints]
    stiff = w.ki > 0
    push = w.kp * (rollout.ctrl[:, order] - t.q[:, w.qadr])
    damping = w.kd + w.model.dof_damping[w.dadr]
    rest = push - damping * t.v[:, w.dadr] - t.tau
    ankles = np.any(list(_ankles(w).values()), axis=0)
    # What is left is the integral: bounded, and absent where joints are compliant.
    assert np.abs(rest[:, stiff & ~ankles]).max() < 5.0 + 1e-6
    assert np.abs(rest[:, ~stiff]).max() < 1e-6


def test_there_are_no_jumps_in_what_is_followed(climbed):
    """Also where one plan takes over from another."""
    t = climbed[0].followed
    w = climbed[0].world
    assert np.abs(np.diff(t.q[:, w.qadr], axis=0)).max() < 5e-3  # [rad] in 1 ms
    assert np.abs(np.diff(t.q[:, w.qadr], 2, axis=0)).max() < 5e-3


# A box that is not there.


def test_where_nothing_is_felt_the_robot_stops_and_says_why(hands_plan, gone):
    """Once it has looked in a few other places, each from the stance that holds."""
    rollout, pilot = gone
    assert rollout.stopped == (
        f"LHand finds no support within {1e3 * REACH:.0f} mm of its planned position"
    )
    tries = [rollout.stopped, "replanned: 2 contact changes"] * SEARCHES
    assert texts(rollout) == [*tries, f"stopped: {rollout.stopped}"]
    assert pilot._made == 0
    failed = [n for n, c in judge(hands_plan, rollout).criteria.items() if not c.ok]
    assert Figure.WENT_ON in failed


def test_it_has_felt_as_far_as_it_may(gone):
    rollout, _ = gone
    time = rollout.events[0].time
    before = np.arange(time - REACH / FEELING_SPEED - 1.0, time, 0.02)
    low = min(point_at(rollout, t, "LHand")[2] for t in before)
    assert low == pytest.approx(TOP - REACH, abs=0.01)
    assert low > TOP - REACH - 5e-3
    # Another place is looked for from where it began to feel.
    assert point_at(rollout, time, "LHand")[2] == pytest.approx(TOP, abs=0.01)


def test_it_stands_stably_in_the_stance_that_it_had(gone):
    rollout, pilot = gone
    assert sorted(rollout.rests_on) == ["LFoot@ground", "RFoot@ground"]
    assert not rollout.fell
    assert rollout.end_speed.max() < END_SPEED
    weight = 9.81 * rollout.world.mass
    end = load(rollout, rollout.time[-1])
    assert end["LFoot"] + end["RFoot"] == pytest.approx(weight, rel=0.01)
    assert not has_fallen(rollout.qpos[-1], pilot.reference)
    held = round((rollout.time[-1] - rollout.events[-1].time) / PHYSICS_STEP)
    assert held * PHYSICS_STEP == pytest.approx(HOLD_END, abs=0.02)
    assert np.abs(rollout.qvel[-1]).max() < 0.05


# Start and weight.


def test_a_start_that_is_off_is_seen_and_the_whole_plan_made_anew(hands_plan, aside):
    rollout, pilot = aside
    time, found = event(rollout, r"starts (\d+) mm and (-?\d+) degrees from where")
    assert time == pytest.approx(HOLD_START, abs=0.01)
    assert float(found[1]) == pytest.approx(28, abs=3)
    assert float(found[2]) == pytest.approx(np.degrees(0.08), abs=0.6)
    assert texts(rollout)[1] == "replanned: 2 contact changes"
    off = pilot._world.scene.start - hands_plan.world.scene.start
    assert np.allclose(off, [-0.02, 0.02, 0.08], atol=4e-3)
    assert pilot._made == 2
    assert rollout.stopped == ""
    for c in pilot._keyframes[-1].stance:
        if c.support == "box":
            there = point_at(rollout, rollout.time[-1], c.surface)
            assert np.linalg.norm(there - c.position) < 0.015


def test_a_start_that_is_hardly_off_is_left_alone(hands_plan):
    t = hands_plan.trajectory
    pilot = Execution(hands_plan, hands_plan.world)
    for share, noticed in ((0.9, False), (1.1, True)):
        pilot.events.clear()
        pilot._pose = t.q[0].copy()
        pilot._pose[0] += share * START_DRIFT
        feel(pilot, LFoot=0.5 * 9.81 * pilot._world.mass)
        feel(pilot, RFoot=0.5 * 9.81 * pilot._world.mass)
        pilot._follow = lambda found, off: iter(())
        exhaust(pilot._check_start())
        assert bool(pilot.events) == noticed


@pytest.mark.parametrize("turn", [0.02, -0.06])
def test_a_turn_of_the_start_counts_by_what_it_does_to_the_arms(hands_plan, turn):
    """Turned about the ankles, the place is the same: 0.3 m of reach times the turn."""
    pilot = Execution(hands_plan, hands_plan.world)
    q = hands_plan.trajectory.q[0].copy()
    c, s = np.cos(turn), np.sin(turn)
    x, y, _ = hands_plan.world.scene.start
    q[:2] = [x, y] + np.array([[c, -s], [s, c]]) @ (q[:2] - [x, y])
    half = np.array([np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2)])
    w, xyz = q[3], q[4:7].copy()
    q[3:7] = [
        half[0] * w - half[3] * xyz[2],
        half[0] * xyz[0] - half[3] * xyz[1],
        half[0] * xyz[1] + half[3] * xyz[0],
        half[0] * xyz[2] + half[3] * w,
    ]
    pilot._pose = q
    feel(pilot, LFoot=9.81 * pilot._world.mass)
    pilot._follow = lambda found, off: iter(())
    exhaust(pilot._check_start())
    noticed = 0.3 * abs(turn) > START_DRIFT
    assert [str(e) for e in pilot.events] == (
        [f"starts 0 mm and {np.degrees(turn):.0f} degrees from where it was planned"]
        if noticed
        else []
    )


@pytest.mark.parametrize("mass", [0.9, 1.1])
def test_torques_follow_the_mass_that_is_felt(hands_plan, mass):
    rollout, pilot = run(hands_plan, mass=mass, **EXACT)
    time, found = event(rollout, r"weighs (\d+) % of what its description says")
    assert time == pytest.approx(HOLD_START, abs=0.01)
    assert float(found[1]) == pytest.approx(100 * mass, abs=1)
    assert pilot._scale == pytest.approx(mass, abs=0.01)
    assert pilot._made == 2
    # The feed-forward of a compliant joint is all of its torque while it is still.
    w = rollout.world
    j = int(np.flatnonzero((w.ki == 0) & (np.abs(rollout.followed.tau[1000]) > 1.0))[0])
    a = w.model.actuator(w.joints[j]).id
    k = round(time / PHYSICS_STEP) + 2
    push = w.kp * (rollout.ctrl[k, [w.model.actuator(n).id for n in w.joints]])
    t = rollout.followed
    damping = w.kd[j] + w.model.dof_damping[w.dadr[j]]
    left = (
        w.kp[j] * (rollout.ctrl[k, a] - t.q[k, w.qadr[j]]) - damping * t.v[k, w.dadr[j]]
    )
    assert left == pytest.approx(pilot._scale * t.tau[k, j], rel=1e-6)
    assert len(push) == len(w.joints)


@pytest.mark.parametrize("share", [0.9, 1.1])
def test_a_weight_within_what_sensors_tell_is_taken_for_the_description(pilot, share):
    ratio = 1.0 + share * MASS_CHANGE
    feel(pilot, LFoot=ratio * 9.81 * pilot._world.mass)
    exhaust(pilot._check_start())
    assert pilot._scale == pytest.approx(ratio if share > 1 else 1.0)
    assert len(pilot.events) == (share > 1)


# A push.


def test_a_push_acts_from_when_it_begins_and_not_before(hands_plan):
    calm = run(hands_plan, seed=2)[0]
    pushed = run(hands_plan, seed=2, push=40.0)[0]
    assert calm.push is None
    assert len(pushed.push) == len(pushed.ctrl)
    first = int(np.flatnonzero(pushed.push.any(axis=1))[0])
    row = first // 10
    assert np.array_equal(pushed.qpos[: row + 1], calm.qpos[: row + 1])
    n = min(len(pushed.qpos), len(calm.qpos))
    off = pushed.qpos[row + 20 : n, :2] - calm.qpos[row + 20 : n, :2]
    along = off @ pushed.push[first, :2] / 40.0
    assert along[0] > 1e-3
    assert not pushed.fell


def test_a_push_that_fells_the_robot_ends_the_run(hands_plan):
    rollout, pilot = run(hands_plan, push=1000.0, seed=2, **EXACT)
    assert rollout.fell
    assert has_fallen(rollout.qpos[-1], pilot.reference)
    assert not has_fallen(rollout.qpos[-2], pilot.reference)
    assert len(rollout.ctrl) < len(hands_plan.trajectory.time)
    assert pilot.left > 0
    assert rollout.rests_on == ()
    assert not judge(hands_plan, rollout).criteria[Figure.UPRIGHT].ok


@pytest.mark.parametrize("share", [0.99, 1.01])
def test_it_has_fallen_where_the_pelvis_is_far_from_its_reference(hands_plan, share):
    q = hands_plan.trajectory.q[0]
    low, high = q.copy(), q.copy()
    low[2] -= share * FALLEN_HEIGHT
    high[2] += 10 * FALLEN_HEIGHT
    assert has_fallen(low, q) == (share > 1)
    assert not has_fallen(high, q)
    for axis in (0, 1, 2):
        a = share * FALLEN_TILT
        tilted, upright = q.copy(), q.copy()
        upright[3:7] = [1.0, 0.0, 0.0, 0.0]
        tilted[3:7] = 0.0
        tilted[3], tilted[4 + axis] = np.cos(a / 2), np.sin(a / 2)
        assert has_fallen(tilted, upright) == (share > 1 and axis < 2)


# What it knows.


def test_forces_and_postures_are_smoothed_with_their_time_constants(pilot):
    q = pilot._pose.copy()
    target = q.copy()
    target[0] += 0.1
    force = np.zeros((len(pilot._surfaces), 3))
    force[2] = [3.0, -4.0, 100.0]
    n = round(FORCE_SMOOTHING / PHYSICS_STEP)
    for _ in range(n):
        pilot._sense(Measurement(target, force))
    share = 1.0 - np.exp(-1.0)
    assert np.allclose(pilot._load[2], share * force[2], rtol=0.02)
    assert not np.delete(pilot._load, 2, axis=0).any()
    assert pilot._pose[0] - q[0] == pytest.approx(0.1 * (1 - np.exp(-3.0)), rel=0.02)
    for _ in range(20 * n):
        pilot._sense(Measurement(target, force))
    assert np.allclose(pilot._load[2], force[2])
    assert np.allclose(pilot._pose, target)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_both_quaternions_of_a_rotation_are_the_same_posture(pilot, sign):
    target = pilot._pose.copy()
    target[3:7] = [np.cos(0.1), 0.0, np.sin(0.1), 0.0]
    there = target.copy()
    there[3:7] *= sign
    near = [abs(pilot._pose[3:7] @ target[3:7])]
    for _ in range(200):
        pilot._sense(Measurement(there, pilot._load))
        near.append(abs(pilot._pose[3:7] @ target[3:7]))
    assert np.all(np.diff(near) > -1e-12)  # by the short way
    assert abs(pilot._pose[3:7] @ target[3:7]) == pytest.approx(1.0, abs=1e-9)


def test_a_posture_to_plan_from_has_joints_as_commanded_and_base_as_measured(pilot):
    pilot._pose = pilot.reference + 0.01
    q = pilot._rebased()
    assert np.array_equal(q[:7], pilot._pose[:7])
    assert np.array_equal(q[7:], pilot.reference[7:])


def test_what_is_believed_begins_where_the_robot_began(pilot):
    start = np.array([0.03, -0.02, 0.1])
    scene = replace(pilot._world.scene, start=start)
    pilot._world = replace(pilot._world, scene=scene)
    assert np.array_equal(pilot._believed().start, start)


def test_a_contact_that_has_rolled_is_where_it_was_planned(pilot, hands_plan):
    """The ball turns with its link about a horizontal axis and moves by r theta."""
    c = placed(pilot, hands_plan, 1)
    radius = hands_plan.world.surfaces["LHand"].radius
    theta = 0.3
    turn = np.array([np.cos(theta / 2), 0.0, np.sin(theta / 2), 0.0])
    kin = Kinematics(hands_plan.world)
    kin.update(pilot._pose)
    up = np.array([0.0, 0.0, 1.0])
    before = kin.contact_point("LHand", up)
    q = pilot._pose
    mujoco.mju_mulQuat(q[3:7], turn, q[3:7].copy())
    kin.update(q)
    q[:3] += before + radius * theta * np.eye(3)[0] - kin.contact_point("LHand", up)
    assert radius * theta > 5e-3
    assert pilot._off(c) == pytest.approx((0.0, 0.0), abs=1.5e-3)


def placed(pilot, plan, keyframe: int, up: float = 0.0, side: float = 0.0):
    """The pilot in a keyframe's posture, moved; the contact of its left hand."""
    pilot._pose = plan.keyframes[keyframe].q.copy()
    pilot._pose[:3] += [0.0, side, up]
    return next(c for c in plan.keyframes[keyframe].stance if c.surface == "LHand")


@pytest.mark.parametrize(("up", "side"), [(0.02, 0.0), (-0.03, 0.01), (0.0, -0.04)])
def test_how_far_a_contact_is_off(pilot, hands_plan, up, side):
    c = placed(pilot, hands_plan, 1, up, side)
    assert np.allclose(pilot._off(c), (up, abs(side)), atol=1e-3)


@pytest.mark.parametrize(
    ("newtons", "up", "side", "touches"),
    [
        (1.1 * TOUCH, 0.0, 0.0, True),
        (0.9 * TOUCH, 0.0, 0.0, False),
        (50.0, 0.0, 0.9 * NEAR, True),
        (50.0, 0.0, 1.1 * NEAR, False),
        (50.0, -0.95 * REACH, 0.0, True),
        (50.0, REACH + 0.03, 0.0, False),
    ],
)
def test_a_touch_is_a_force_near_the_planned_place(
    pilot, hands_plan, newtons, up, side, touches
):
    c = placed(pilot, hands_plan, 1, up, side)
    feel(pilot, LHand=newtons)
    assert pilot._touches(c) == touches


def test_what_is_felt_for_may_be_met_further_aside(pilot, hands_plan):
    """A limb that rolled while it felt its way down has its contact where it is."""
    c = placed(pilot, hands_plan, 1, 0.0, 1.5 * NEAR)
    feel(pilot, LHand=50.0)
    assert pilot._touches(c, REACH)
    assert not pilot._touches(placed(pilot, hands_plan, 1, 0.0, 1.1 * REACH), REACH)


def test_a_force_along_the_support_is_no_touch(pilot, hands_plan):
    c = placed(pilot, hands_plan, 1)
    pilot._load[pilot._surfaces.index("LHand")] = [80.0, 60.0, 0.0]
    assert not pilot._touches(c)


def test_another_surface_of_the_limb_may_bear_in_place_of_the_planned_one(
    pilot, demo_plan
):
    """An elbow where a hand was planned; not while the hand bears as well."""
    key = demo_plan.keyframes[3]
    elbow = next(c for c in key.stance if c.surface == "LElbow")
    hand = replace(elbow, surface="LHand")
    pilot._pose = key.q.copy()
    feel(pilot, LElbow=1.1 * TOUCH)
    found = pilot._other(hand)
    assert found.surface == "LElbow"
    assert found.support == "box"
    assert np.linalg.norm(found.position - elbow.position) < 2e-3
    feel(pilot, LHand=1.1 * LOST)
    assert pilot._other(hand) is None
    feel(pilot, LHand=0.0, LElbow=0.9 * TOUCH)
    assert pilot._other(hand) is None
    feel(pilot, LElbow=0.0, RElbow=100.0)  # another limb's
    assert pilot._other(hand) is None
    feel(pilot, LElbow=100.0)
    pilot._pose[2] += REACH + 0.02
    assert pilot._other(hand) is None
    pilot._pose = key.q.copy()
    pilot._pose[0] -= 0.5  # before the box
    assert pilot._other(hand) is None


def test_a_felt_contact_is_where_the_surface_is(pilot, hands_plan):
    c = placed(pilot, hands_plan, 1, -0.03, 0.01)
    felt, kin = pilot._as_felt(c), Kinematics(hands_plan.world)
    kin.update(pilot._pose)
    p = kin.contact_point("LHand", np.array([0.0, 0.0, 1.0]))
    assert np.allclose(felt.position, p, atol=1e-12)
    assert pilot._off(felt) == pytest.approx((0.0, 0.0), abs=1e-9)
    assert (felt.surface, felt.support, felt.edge) == ("LHand", "box", None)


def test_a_felt_foot_lies_on_the_ground_as_it_is_turned(pilot, hands_plan):
    """The ground is where it is: what the sensors say of its height is their error."""
    foot = next(c for c in hands_plan.keyframes[0].stance if c.surface == "LFoot")
    pilot._pose = hands_plan.keyframes[0].q.copy()
    pilot._pose[:3] += [0.01, 0.02, 0.004]
    felt = pilot._as_felt(foot)
    assert felt.position[2] == pytest.approx(0.0, abs=1e-12)
    assert np.allclose(felt.position[:2] - foot.position[:2], [0.01, 0.02], atol=1e-4)
    assert abs(felt.quaternion @ foot.quaternion) == pytest.approx(1.0, abs=1e-6)


def test_a_felt_foot_on_tiptoe_is_on_its_edge(pilot, hands_plan):
    """It is where its edge is, and need not lie flat there."""
    foot = next(c for c in hands_plan.keyframes[0].stance if c.surface == "LFoot")
    q = hands_plan.keyframes[0].q.copy()
    pilot._kin.update(q)
    middle = pilot._kin.contact_point("LFoot", np.array([0.0, 0.0, 1.0]), 0)
    pilot._pose = q.copy()
    pilot._pose[:3] += [0.01, 0.02, 0.004]
    felt = pilot._as_felt(replace(foot, edge=0, position=middle))
    assert felt.edge == 0
    assert np.allclose(felt.position - middle, [0.01, 0.02, 0.0], atol=1e-4)


def test_places_that_were_felt_are_kept_and_renewed(pilot, hands_plan):
    c = placed(pilot, hands_plan, 1)
    feet = [x for x in hands_plan.keyframes[1].stance if x is not c]
    pilot._remember((*feet, c))
    ((key, (support, first)),) = pilot._felt.items()
    assert (key, support) == (("LHand", 0), "box")  # the ground is not felt for
    pilot._made = 1
    pilot._pose[0] += 0.9 * SAME_PLACE
    pilot._remember([c])
    ((key, (_, p)),) = pilot._felt.items()
    assert np.allclose(p - first, [0.9 * SAME_PLACE, 0.0, 0.0], atol=1e-9)
    pilot._pose[0] += 1.1 * SAME_PLACE
    pilot._remember([c])
    assert set(pilot._felt) == {("LHand", 0), ("LHand", 1)}
    believed = pilot._believed()
    assert believed.boxes[0].roughness > 0
    assert np.array_equal(believed.start, hands_plan.world.scene.start)


def test_it_rests_on_all_surfaces_that_bear_at_the_end(fast_plan):
    """Hand and elbow of a limb may both be down, where one of them was planned."""
    pilot = Execution(fast_plan, fast_plan.world)
    pilot._leg = len(pilot._legs)
    planned = ["LElbow@box", "LKnee@box", "RElbow@box", "RKnee@box"]
    pilot._sum_up()
    assert sorted(pilot.rests_on) == planned
    feel(pilot, LHand=1.1 * LOST, RHand=0.9 * LOST, LElbow=40.0, LFoot=2.0)
    pilot._sum_up()
    assert sorted(pilot.rests_on) == sorted(["LHand@box", "LFoot@box", *planned])


def test_the_share_at_the_end_is_that_of_what_it_rests_on(fast_plan, still):
    rollout, _ = still
    name = Figure.LOAD_ON_PLAN
    value = judge(fast_plan, rollout).criteria[name].value
    assert value == pytest.approx(1.0, abs=0.02)
    share = measure(rollout).end_load
    fewer = tuple(k for k in rollout.rests_on if k != "LKnee@box")
    there = judge(fast_plan, replace(rollout, rests_on=fewer)).criteria[name]
    assert there.value == pytest.approx(value - share["LKnee@box"])
    assert not there.ok


# Actions.


def test_the_way_back_to_a_trajectory_is_smooth_and_its_rate_its_derivative(pilot):
    t, i = pilot._trajectory, 800
    kin = Kinematics(pilot._plan.world)
    offset = np.zeros(pilot._nv)
    offset[pilot._dadr] = 0.02 * np.cos(np.arange(len(pilot._dadr)))
    pilot._i = i
    pilot.reference = kin.integrate(t.q[i], offset)
    pilot._torque = t.tau[i] + 3.0
    pilot._resume()
    start = pilot.reference.copy()
    n = round(BLEND / PHYSICS_STEP)
    q, v, tau = [], [], []
    for _ in pilot._play(i + n + 20):
        q.append(pilot.reference)
        v.append(pilot._velocity)
        tau.append(pilot._torque)
    q, v, tau = np.array(q), np.array(v), np.array(tau)
    assert np.abs(kin.difference(start, q[0])).max() < 1e-3
    assert np.allclose(q[n + 1 :], t.q[i + n + 2 : i + n + 21], atol=1e-12)
    assert np.allclose(tau[n + 1 :], t.tau[i + n + 2 : i + n + 21])
    assert np.allclose(tau[0], t.tau[i + 1] + 3.0)
    joints = q[:, pilot._qadr]
    numeric = (joints[2:] - joints[:-2]) / (2 * PHYSICS_STEP)
    assert np.allclose(v[1:-1], numeric, atol=1e-3)
    left = [kin.difference(a, b) for a, b in zip(t.q[i + 1 :], q, strict=False)]
    size = np.abs(np.array(left)).max(axis=1)
    assert np.all(np.diff(size) < 1e-9)


def test_playing_goes_to_a_sample_or_until_something_happens(pilot):
    t = pilot._trajectory
    assert exhaust(pilot._play(700)) == 700
    assert pilot._i == 700
    assert np.array_equal(pilot.reference, t.q[700])
    assert np.array_equal(pilot._torque, t.tau[700])
    assert np.array_equal(pilot._velocity, t.v[700, pilot._dadr])
    assert exhaust(pilot._play(900, until=lambda: pilot._i >= 750)) == 50
    assert exhaust(pilot._play(740)) == 0


def test_resting_holds_the_reference_without_velocity(pilot):
    exhaust(pilot._play(900))
    q = pilot.reference
    assert pilot.followed is None
    assert exhaust(pilot._rest(0.25)) == 250
    assert np.array_equal(pilot.reference, q)
    assert not pilot._velocity.any()


NOTHING = "no way"
NO_WAY = Failure(status=Status.STUCK, detail=NOTHING)


def nothing_found(pilot) -> Plan:
    return replace(
        pilot._plan, changes=(), trajectory=None, complete=False, failures=(NO_WAY,)
    )


@pytest.mark.parametrize("share", [0.9, 1.1])
def test_where_no_other_plan_is_found_the_one_at_hand_may_do(pilot, share):
    """As far as contacts are not too far off; else it stays where it is."""
    pilot._i = pilot._legs[0].end
    exhaust(pilot._follow(nothing_found(pilot), share * FALLBACK))
    if share < 1:
        assert [str(e) for e in pilot.events] == [f"goes on as planned ({NOTHING})"]
        assert pilot.stopped == ""
    else:
        assert pilot.stopped == NOTHING
        assert [str(e) for e in pilot.events] == [f"stopped: {NOTHING}"]


def test_with_all_steps_made_there_is_no_need_of_another_plan(pilot):
    pilot._made = len(pilot._steps)
    exhaust(pilot._follow(nothing_found(pilot), 1.0))
    assert pilot.stopped == ""
    assert pilot._leg == len(pilot._legs)
    assert [str(e) for e in pilot.events] == [f"stays in this stance ({NOTHING})"]


def test_a_plan_without_a_step_is_no_plan(pilot, hands_plan):
    found = replace(hands_plan, changes=(), complete=False, failures=(NO_WAY,))
    exhaust(pilot._follow(found, 1.1 * FALLBACK))
    assert pilot.stopped == NOTHING


def test_a_plan_that_goes_less_far_is_taken_where_the_one_at_hand_will_not_do(
    pilot, hands_plan
):
    """And its end is said when it is reached."""
    t = hands_plan.trajectory
    found = replace(
        hands_plan,
        trajectory=replace(t, keyframes=t.keyframes[:2]),
        changes=hands_plan.changes[:1],
        complete=False,
        failures=(NO_WAY,),
    )
    exhaust(pilot._follow(found, 0.9 * FALLBACK))
    assert [str(e) for e in pilot.events] == [f"goes on as planned ({NOTHING})"]
    pilot.events.clear()
    exhaust(pilot._follow(found, 1.1 * FALLBACK))
    assert [str(e) for e in pilot.events] == ["replanned: 1 contact change"]
    assert len(pilot._legs) == 1
    assert pilot._missed == NOTHING


# Legs, ankles.


def test_legs_are_the_steps_by_the_contact_flags(fast_plan):
    t = fast_plan.trajectory
    legs = _legs(t, fast_plan.keyframes)
    assert [leg.made.surface for leg in legs] == [
        *("LHand", "RHand", "LElbow", "RElbow", "LKnee", "RKnee")
    ]
    ends = [t.at(x) for x in t.keyframes[1:]]
    assert [leg.end for leg in legs[:-1]] == ends[:-1]
    assert legs[-1].end == len(t.time) - 1 - round(HOLD_END / PHYSICS_STEP)
    start = 0
    for leg, before in zip(legs, fast_plan.keyframes, strict=False):
        made = t.contact[:, t.surfaces.index(leg.made.surface)]
        assert start <= leg.swing < leg.touch < leg.end
        assert not made[leg.swing : leg.touch + 1].any()
        assert made[leg.touch + 1 : leg.end + 1].all()
        gone = {c.surface for c in before.stance} - {
            s for s, c in zip(t.surfaces, t.contact[leg.end], strict=True) if c
        }
        for surface in gone:
            column = t.contact[:, t.surfaces.index(surface)]
            assert column[leg.swing - 1]
            assert not column[leg.swing : leg.end + 1].any()
        start = leg.end


def test_ankles_are_those_of_each_foot(fast_plan):
    world = fast_plan.world
    found = {
        foot: {n for n, own in zip(world.joints, joints, strict=True) if own}
        for foot, joints in _ankles(world).items()
    }
    assert found == {"LFoot": {"LAnkLat", "LAnkSag"}, "RFoot": {"RAnkLat", "RAnkSag"}}
    plain = replace(world, robot=replace(world.robot, self_positioning=()))
    assert _ankles(plain) == {}
    assert Execution(fast_plan, plain)._self_positioning() is None


def at_rest_on_hands(fast_plan) -> Execution:
    """Both hands and feet down, no foot about to step."""
    pilot = Execution(fast_plan, fast_plan.world)
    pilot._i = pilot._legs[1].end
    pilot._set(pilot._trajectory, pilot._i)
    return pilot


def test_ankles_position_themselves_only_while_both_arms_bear(fast_plan):
    pilot = at_rest_on_hands(fast_plan)
    free = np.any(list(pilot._ankles.values()), axis=0)
    n = round(EASING / PHYSICS_STEP)
    feel(pilot, LHand=50.0)
    for _ in range(n):
        assert not pilot._self_positioning().any()
    feel(pilot, RHand=1.1 * TOUCH)
    for k in range(n):
        share = pilot._self_positioning()
        assert np.allclose(share[free], (k + 1) / n)
        assert not share[~free].any()
    for _ in range(10):
        assert np.all(pilot._self_positioning()[free] == 1.0)
    feel(pilot, LHand=0.9 * TOUCH)
    for k in range(n):
        assert np.allclose(pilot._self_positioning()[free], 1.0 - (k + 1) / n)
    feel(pilot, LHand=0.0, LElbow=50.0)  # any surface of the arm
    assert pilot._self_positioning()[free].min() > 0.0


def test_before_a_foot_steps_its_ankle_is_held_and_the_other_goes_on(fast_plan):
    pilot = at_rest_on_hands(fast_plan)
    feel(pilot, LElbow=50.0, RElbow=50.0)
    swing = pilot._legs[4].swing  # LFoot -> LKnee
    left, right = (pilot._ankles[f] for f in ("LFoot", "RFoot"))
    t = pilot._trajectory
    lifts = int(np.flatnonzero(~t.contact[:, t.surfaces.index("LFoot")])[0])
    assert lifts <= swing
    for ahead, held in ((1.05 * AHEAD, False), (0.95 * AHEAD, True)):
        pilot._i = lifts - round(ahead / PHYSICS_STEP)
        pilot._set(t, pilot._i)
        pilot._positioned[:] = 0.5
        share = pilot._self_positioning()
        assert np.all((share[left] < 0.5) == held)
        assert np.all(share[right] > 0.5)


def test_in_a_climb_ankles_are_free_where_both_arms_bore_and_feet_were_down(still):
    rollout, pilot = still
    share, loads = np.array(pilot.ankles), np.array(pilot.loads)
    column = {s: i for i, s in enumerate(pilot._surfaces)}
    up = loads[:, :, 2]
    arms = np.minimum(
        np.maximum(up[:, column["LHand"]], up[:, column["LElbow"]]),
        np.maximum(up[:, column["RHand"]], up[:, column["RElbow"]]),
    )
    more = np.diff(share, axis=0) > 0
    assert more.any()
    assert share.max() == 1.0
    for foot, joints in pilot._ankles.items():
        rising = more[:, joints].any(axis=1)
        assert np.all(arms[1:][rising] > TOUCH)
        closed = rollout.followed.contact[:, column[foot]]
        assert np.all(closed[1:][rising])
        assert not share[~closed][:, joints].any()  # held again before it steps
    assert not share[: round(3.0 / PHYSICS_STEP)].any()  # before hands are down


# Open loop.


def test_open_loop_the_trajectory_is_tracked_sample_by_sample(demo_plan, rng):
    world, t = demo_plan.world, demo_plan.trajectory
    pilot, law = Tracking(demo_plan, world), JointLaw(world)
    force = np.full((len(world.surfaces), 3), 500.0)  # which it does not feel
    for k in range(300):
        q = t.q[k] + rng.normal(0.0, 1e-3, len(t.q[k]))
        expected = law.command(
            t.q[k, world.qadr], t.v[k, world.dadr], t.tau[k], q[world.qadr]
        )
        assert np.array_equal(pilot.command(Measurement(q, force)), expected)
        assert pilot.left == len(t.time) - 1 - k
        assert np.array_equal(pilot.reference, t.q[k])
    assert pilot.events == []
    assert pilot.stopped == ""
    assert pilot.followed is None
    assert sorted(pilot.rests_on) == described(demo_plan.keyframes[-1].stance)


def test_open_loop_nothing_is_noticed(hands_plan):
    d = Disturbance(height=-0.01, mass=1.05, **EXACT)
    rollout = simulate(hands_plan, controller="pid", disturbance=d)
    assert rollout.events == ()
    assert rollout.stopped == ""
    assert rollout.followed is None
    assert len(rollout.ctrl) == len(hands_plan.trajectory.time)


# Measurements are all that is looked at.


def scales(pilot) -> np.ndarray:
    """(nS, 3) of a robot of thin air: what is closed, or soon will be, bears alike."""
    t = pilot._trajectory
    closed = pilot._closed | t.contact[min(pilot._i + 60, len(t.time) - 1)]
    force = np.zeros((len(pilot._surfaces), 3))
    force[closed, 2] = 9.81 * pilot._world.mass / closed.sum()
    return force


def test_without_looking_at_physics_it_follows_what_it_is_told(hands_plan):
    """A robot that is always where it should be, on scales that agree."""
    pilot = Execution(hands_plan, hands_plan.world)
    while pilot.left:
        pilot.command(Measurement(pilot.reference.copy(), scales(pilot)))
    assert pilot.events == []
    assert pilot._made == 2
    assert pilot.followed is None
    assert sorted(pilot.rests_on) == described(hands_plan.keyframes[-1].stance)


@pytest.mark.parametrize("found", [True, False])
def test_a_contact_that_bears_nothing_is_felt_for_again(fast_plan, found):
    """The left hand is told that it bears nothing once both hands are down."""
    pilot = Execution(fast_plan, fast_plan.world)
    kin, up = Kinematics(fast_plan.world), np.array([0.0, 0.0, 1.0])
    hand, top = pilot._surfaces.index("LHand"), fast_plan.world.supports["box"]
    leg = pilot._legs[1]
    low = 0.0  # how far below the top the hand has been
    while pilot._i < leg.end + 100 and len(pilot.events) < 2 and pilot._k < 12_000:
        force = scales(pilot)
        kin.update(pilot.reference)
        below = -float(top.height(kin.contact_point("LHand", up)))
        if pilot._i > leg.touch + 50:
            there = found and below > 0.5 * DEVIATION
            force[hand] = [0.0, 0.0, 30.0] if there else 0.0
            low = max(low, below)
        pilot.command(Measurement(pilot.reference.copy(), force))
    said = [str(e) for e in pilot.events]
    assert said[0] == "LHand carries no load: probed for again"
    assert said[1:2] == (
        [] if found else ["LHand finds no support: the others carry the robot"]
    )
    # Found a little lower, the plan goes on; else it was felt for as far as may be.
    assert low == pytest.approx(0.5 * DEVIATION if found else REACH, abs=2e-3)
    assert (pilot._i > leg.end) == found
    assert pilot.stopped == ""
    if found:
        return
    # The hand is no part of the stance any more, nor of what is believed of the box.
    while len(pilot.events) == 2 and pilot._k < 20_000:
        force = scales(pilot)
        force[hand] = 0.0
        pilot.command(Measurement(pilot.reference.copy(), force))
    assert pilot.stopped or "replanned" in str(pilot.events[2])
    assert "LHand" not in {c.surface for c in pilot._keyframes[pilot._leg].stance} or (
        pilot.stopped
    )
    believed = pilot._believed().boxes[0].top
    assert abs(float(top.height(believed.position))) < 3e-3
    assert float(top.normal @ believed.normal) > np.cos(0.02)


def test_a_limb_on_its_way_may_graze_an_edge(pilot):
    """The others are kept farther away from what they lean on."""
    m = pilot._world.model
    made = pilot._legs[0].made
    side = made.surface[0]
    other = "R" if side == "L" else "L"
    assert pilot._moves(m.geom(f"{side}UpperArm").id)
    assert not pilot._moves(m.geom(f"{other}UpperArm").id)
    assert not pilot._moves(m.geom(f"{side}Thigh").id)
    pilot._leg = len(pilot._legs)
    assert not pilot._moves(m.geom(f"{side}UpperArm").id)


def lean(pilot, begin: int = 0) -> None:
    """Let the right arm seem to bear what the surfaces do not, from a sample on."""
    arm = pilot._world.model.geom("RUpperArm").id

    def leans() -> bool:
        if pilot._i >= begin:
            pilot._lean = Lean(arm, "box", 0.01)
        return pilot._lean is not None

    pilot._leans = leans


def test_on_the_way_to_where_a_leg_begins_a_lean_may_end(pilot):
    """There the new plan lifts off what leant; back would be where it did."""
    leg = pilot._legs[0]
    pilot._legs[0] = replace(leg, begin=leg.swing - 1)
    lean(pilot)
    step = pilot._step()
    for _ in range(leg.swing - 1 - pilot._i):
        next(step)
        assert pilot.events == []
    next(step)
    next(step)
    assert [str(e) for e in pilot.events] == [
        "unintended contact of RShy with box: back, and on with extra clearance"
    ]
    assert pilot._i >= leg.swing - 1


def test_what_bears_in_place_of_contacts_is_lifted_before_they_are_called_lost(pilot):
    exhaust(pilot._play(pilot._legs[0].end))
    pilot._leg = 1
    pilot._load[:] = 0.0  # nothing bears
    lean(pilot)
    next(pilot._check_stance())
    assert len(pilot.events) == 1
    assert "contact of RShy" in str(pilot.events[0])
    assert pilot._wary


def test_what_leans_while_a_contact_is_loaded_takes_it_back_to_its_touch(pilot):
    """The contact is made, and bears nothing as yet."""
    leg = pilot._legs[0]
    pilot._i = leg.touch
    pilot._set(pilot._trajectory, pilot._i)
    pilot._touches = lambda c, aside=0.0: True
    asked = []

    def replan(contacts, loaded):
        asked.append(({c.surface for c in contacts}, {c.surface for c in loaded}))
        yield

    pilot._replan = replan
    lean(pilot, leg.touch + 5)
    step = pilot._step()
    while not asked:
        next(step)
    assert pilot._i == leg.touch
    assert pilot._leg == 1
    both = {c.surface for c in pilot._keyframes[1].stance}
    assert asked == [(both, both - {leg.made.surface})]


@pytest.mark.parametrize("bears", ["LHand", "LElbow"])
def test_what_bears_in_place_of_a_contact_strikes_no_side(pilot, bears):
    """A hand in the stance, or the elbow that has come to lie there instead."""
    pilot._i = pilot._legs[0].end
    pilot._leg = 1
    pilot._pose = pilot._keyframes[1].q.copy()
    top = pilot._world.supports["box"]
    pilot._kin.update(pilot._pose)
    elbow = pilot._kin.contact_point("LElbow", top.normal)
    pilot._load[:] = 0.0
    pilot._load[pilot._surfaces.index(bears)] = [2.0 * TOUCH, 0.0, 1.5 * TOUCH]
    pilot._pose[2] -= 0.0 if bears == "LHand" else top.height(elbow)
    assert pilot._struck() == []
    # A knee bears in place of no contact: it strikes.
    pilot._load[pilot._surfaces.index("LKnee")] = [2.0 * TOUCH, 0.0, 0.0]
    assert pilot._struck() == ["LKnee"]


@pytest.mark.parametrize("found", [True, False])
def test_where_no_way_without_it_is_found_it_may_lean(pilot, found):
    """Back and forth on the plan at hand would end no lean."""
    arm = pilot._world.model.geom("RUpperArm").id

    def replan(contacts, loaded):
        if found:
            pilot._trajectory = replace(pilot._trajectory)
        yield

    pilot._replan = replan
    pilot._lean = Lean(arm, "box", 0.01)
    exhaust(pilot._withdraw(pilot._i))
    pilot._weight, pilot._leaning = 300.0, LEANING  # nothing bears it
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(execution, "leaning_part", lambda *_: Lean(arm, "box", 0.01))
        pilot._leg = len(pilot._legs)
        assert pilot._leans() == found
