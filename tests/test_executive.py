"""Execution that reacts to its contacts: in physics, and on made-up measurements."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from clamber.errors import InputError, Status
from clamber.execution import executive, progress, unintended
from clamber.execution.disturbance import Disturbance
from clamber.execution.estimate import LOST, TOUCH
from clamber.execution.events import (
    ContactMoved,
    GivenUp,
    Heavier,
    KeptPlan,
    KeptStance,
    Lost,
    Missing,
    Paused,
    Replanned,
    StartsElsewhere,
    Stopped,
    Unintended,
)
from clamber.execution.executive import (
    DEVIATION,
    FALLBACK,
    LOOK,
    MASS_CHANGE,
    SEARCHES,
    SEARCHING,
    START_DRIFT,
    THINKING,
    Executive,
)
from clamber.execution.open_loop import OpenLoop
from clamber.execution.probe import PROBE_SPEED, REACH
from clamber.execution.reference import RAMP, STEPS
from clamber.execution.sensors import Measurement
from clamber.execution.servo import joint_servo, self_positioning_joints
from clamber.execution.simulation import has_fallen, simulate
from clamber.execution.unintended import LASTS, RETREATS, UnintendedContact
from clamber.execution.verdict import END_SPEED, Figure, judge
from clamber.model.kinematics import Kinematics
from clamber.model.scene import GROUND
from clamber.model.se3 import quat_from_yaw, quat_multiply
from clamber.model.world import PHYSICS_STEP
from clamber.planning.planner import timed
from clamber.planning.records import Fallback, PlanOptions, State, numbered
from clamber.planning.trajectory import HOLD_END, HOLD_START
from clamber.step.change import Failure
from clamber.step.ik import IK
from test_gait import POLICY

EXACT = {"noise": 0.0, "delay": 0.0}
TOP = 0.275  # [m] the box that was planned for
UP = np.array([0.0, 0.0, 1.0])


def run(plan, **disturbance):
    """What physics made of it."""
    return simulate(plan, disturbance=Disturbance(**disturbance))


def kinds(events) -> list[type]:
    return [type(e) for e in events]


def first(rollout, kind):
    return next(e for e in rollout.events if isinstance(e, kind))


def described(contacts) -> list[str]:
    return sorted(f"{c.surface}@{c.support}" for c in contacts)


def point_at(rollout, time: float, surface: str) -> np.ndarray:
    """(3,) where a ball of the real robot was lowest."""
    kin = Kinematics(rollout.world)
    kin.update(rollout.qpos[round(time / rollout.time[1])])
    return kin.contact_point(surface, UP)


def load(rollout, time: float) -> dict[str, float]:
    row = rollout.contact_force[round(time / rollout.time[1])]
    return dict(zip(rollout.surfaces, row[:, 2].tolist(), strict=True))


def touches_early(told, touch, up, **loads):
    """Surfaces are loaded where the contact of `touch` is so much higher [m]."""
    told.to(touch - 100)
    told.up = up
    told.to(touch, **loads)


def touch_of(plan, change: int) -> int:
    """The last sample before the contact of a change is closed."""
    parts = [s for s in plan.trajectory.segments if s.change == change]
    return next(s.end for s in parts if s.makes is not None) - 1


def end_of(plan, change: int) -> int:
    """The last sample of a change."""
    return [s.end for s in plan.trajectory.segments if s.change == change][-1] - 1


@pytest.fixture(scope="module")
def fast_plan(demo_plan):
    """The plan at the default speed."""
    return demo_plan


@pytest.fixture(scope="module")
def hands_plan(hands_plan):
    """The same postures at the default speed."""
    speed = PlanOptions().speed
    trajectory = timed(IK(hands_plan.world), hands_plan.changes, speed)
    options = replace(hands_plan.options, speed=speed)
    return replace(hands_plan, options=options, trajectory=trajectory)


@pytest.fixture(scope="module")
def still(fast_plan):
    """The whole climb, nothing disturbed."""
    return run(fast_plan, **EXACT)


@pytest.fixture(scope="module", params=[-0.03, 0.03], ids=["lower", "higher"])
def other_height(request, hands_plan):
    return request.param, run(hands_plan, height=request.param, **EXACT)


@pytest.fixture(scope="module")
def climbed(fast_plan):
    """The whole climb onto a box that is lower than was planned."""
    return run(fast_plan, height=-0.03, **EXACT)


@pytest.fixture(scope="module")
def gone(hands_plan):
    """The top is far below where it was planned."""
    return run(hands_plan, height=-0.2, **EXACT)


@pytest.fixture(scope="module")
def noisy(hands_plan):
    return run(hands_plan, height=0.02, seed=3)


# Nothing disturbed.


def test_undisturbed_there_is_nothing_to_report(fast_plan, still):
    assert still.events == ()
    assert not still.fell
    assert judge(fast_plan, still).reached
    assert sorted(still.rests_on) == described(fast_plan.keyframes[-1].stance)


def test_undisturbed_the_plan_itself_is_followed_up_to_the_first_touch(
    fast_plan, still
):
    """Then contacts may be waited for: what is followed is the plan, later."""
    t, followed, touch = fast_plan.trajectory, still.followed, touch_of(fast_plan, 0)
    for name, step in ("q", STEPS["q"]), ("tau", STEPS["tau"]):
        was, planned = getattr(followed, name), getattr(t, name)
        assert np.abs(was[: touch - 1] - planned[1:touch]).max() <= 0.51 * step
    late = (len(followed.time) - len(t.time)) * PHYSICS_STEP
    assert 0 <= late < 6 * 0.5
    assert np.abs(followed.q[-1] - t.q[-1]).max() < 0.02
    # When keyframes were reached: each as planned, as late as contacts were waited for.
    assert len(followed.keyframes) == len(t.keyframes)
    assert np.all(np.diff(followed.keyframes) > 0)
    ends = [*t.keyframes[:-1], t.time[-1] - HOLD_END]
    assert np.all(np.abs(followed.keyframes - ends) < late + 2e-3)


def test_two_runs_are_the_same_to_the_last_bit(hands_plan, noisy):
    """With noise, delay and planning anew on the way."""
    again = run(hands_plan, height=0.02, seed=3)
    assert noisy.events == again.events
    assert Replanned in kinds(noisy.events)
    for name in ("ctrl", "qpos", "qvel", "contact_load"):
        assert np.array_equal(getattr(noisy, name), getattr(again, name))


# A box that is elsewhere.


def test_the_hand_stops_where_it_touches(hands_plan, other_height):
    height, rollout = other_height
    event, again = first(rollout, ContactMoved), first(rollout, Replanned)
    assert event.surface == event.planned == "LHand"
    assert event.above == pytest.approx(height, abs=4e-3)
    assert event.aside < 0.015
    assert again.changes == 1
    wait = again.time - event.time  # until it has come to rest, too
    assert LOOK + THINKING - 0.01 < wait < RAMP + LOOK + THINKING + 0.01
    n = round((LOOK + THINKING) / PHYSICS_STEP)
    k = round(again.time / PHYSICS_STEP) - n
    q = rollout.followed.q[k + 5 : k + n - 5]
    assert np.ptp(q, axis=0).max() < 0.03  # but for what balance adds
    assert not rollout.followed.v[k + 5 : k + n - 5].any()
    k = round(event.time / PHYSICS_STEP)
    p = point_at(rollout, event.time + 0.1, "LHand")
    assert p[2] == pytest.approx(TOP + height, abs=0.01)  # it may bounce
    # It is measured between two recorded states.
    around = np.arange(-6, 2) * rollout.time[1]
    hand = [load(rollout, event.time + t)["LHand"] for t in around]
    assert max(hand) > 0.5 * TOUCH
    # A hand that lands fast may bounce; it stays near, and the reference is still.
    moved = point_at(rollout, event.time + LOOK + THINKING, "LHand") - p
    assert np.linalg.norm(moved) < 0.02
    # Up to there it was the plan that was followed; then it was probed for.
    t, before = hands_plan.trajectory, min(k, touch_of(hands_plan, 0))
    away = np.abs(rollout.followed.q[: before - 1] - t.q[1:before])
    assert away.max() <= 0.51 * STEPS["q"]


def test_what_is_left_is_done_on_the_top_as_it_is(hands_plan, other_height):
    height, rollout = other_height
    assert rollout.stopped == ""
    assert sorted(rollout.rests_on) == described(hands_plan.keyframes[-1].stance)
    end = load(rollout, rollout.time[-1])
    for hand in ("LHand", "RHand"):
        there = point_at(rollout, rollout.time[-1], hand)
        assert there[2] == pytest.approx(TOP + height, abs=2e-3)
        assert end[hand] > LOST


def test_the_whole_climb_ends_on_top_of_a_lower_box(fast_plan, climbed):
    assert judge(fast_plan, climbed).reached
    assert kinds(climbed.events[:2]) == [ContactMoved, Replanned]
    assert climbed.events[1].changes == 5
    final = fast_plan.keyframes[-1].stance
    assert sorted(climbed.rests_on) == described(final)
    for c in final:
        there = point_at(climbed, climbed.time[-1], c.surface)
        assert there[2] == pytest.approx(TOP - 0.03, abs=5e-3)
    planned = fast_plan.trajectory.q[-1, 2]
    assert climbed.qpos[-1, 2] == pytest.approx(planned - 0.03, abs=0.02)


def test_what_was_followed_is_written_down_step_by_step(climbed):
    """The commands are those of the servo law on what is said to be followed."""
    t, w = climbed.followed, climbed.world
    assert len(t.time) == len(climbed.ctrl)
    assert np.array_equal(t.time, np.arange(len(t.time)) * PHYSICS_STEP)
    assert len(t.keyframes) == 7
    assert not t.v[:, :6].any()
    order = [w.model.actuator(j).id for j in w.joints]
    stiff = w.ki > 0
    push = w.kp * (climbed.ctrl[:, order] - t.q[:, w.qadr])
    damping = w.kd + w.model.dof_damping[w.dadr]
    rest = push - damping * t.v[:, w.dadr] - t.tau
    ankles = np.any(list(self_positioning_joints(w).values()), axis=0)
    # What is left is the integral: bounded, and absent where joints are compliant.
    assert np.abs(rest[:, stiff & ~ankles]).max() < 5.0 + 5e-3
    assert np.abs(rest[:, ~stiff]).max() < 5e-3  # [N m], of numbers rounded
    # No jumps, also where one plan takes over from another.
    joints = t.q[:, w.qadr]
    assert np.abs(np.diff(joints, axis=0)).max() < 5e-3  # [rad] in 1 ms
    assert np.abs(np.diff(joints, 2, axis=0)).max() < 5e-3


# A box that is not there.


def test_where_nothing_is_found_the_robot_stops_and_says_why(hands_plan, gone):
    """Once it has looked in a few other places, each from the stance that holds."""
    assert kinds(gone.events) == [Missing, Replanned] * SEARCHES + [Stopped]
    missing = gone.events[0]
    assert (missing.surface, missing.depth) == ("LHand", REACH)
    assert {e.changes for e in gone.events if isinstance(e, Replanned)} == {2}
    assert gone.stopped == str(missing)
    assert not judge(hands_plan, gone).criteria[Figure.WENT_ON].ok
    # It has probed as deep as it may.
    time = missing.time
    before = np.arange(time - REACH / PROBE_SPEED - 1.0, time, 0.02)
    low = min(point_at(gone, t, "LHand")[2] for t in before)
    assert TOP - REACH - 5e-3 < low < TOP - REACH + 0.01
    # Another place is looked for from where it began to probe.
    assert point_at(gone, time, "LHand")[2] == pytest.approx(TOP, abs=0.01)


def test_it_stands_stably_in_the_stance_that_it_had(gone):
    assert sorted(gone.rests_on) == ["LFoot@ground", "RFoot@ground"]
    assert not gone.fell
    assert gone.end_speed.max() < END_SPEED
    end = load(gone, gone.time[-1])
    weight = 9.81 * gone.world.mass
    assert end["LFoot"] + end["RFoot"] == pytest.approx(weight, rel=0.01)
    assert not has_fallen(gone.qpos[-1], gone.followed.q[-1])
    held = gone.time[-1] - gone.events[-1].time
    assert held == pytest.approx(HOLD_END, abs=0.02)
    assert np.abs(gone.qvel[-1]).max() < 0.05


# Start, weight, push.


def test_a_start_that_is_off_is_measured_and_the_whole_plan_made_anew(hands_plan):
    off, said = Disturbance(x=-0.02, y=0.02, yaw=0.08, **EXACT), []
    rollout = simulate(
        hands_plan, disturbance=off, progress=lambda *x: said.append(x[::2])
    )
    again = [note for stage, note in said if note.startswith("planning again: ")]
    assert {stage for stage, _ in said} == {"simulate"}
    assert "planning again: air -> RHand on box" in again
    event = first(rollout, StartsElsewhere)
    assert event.time == pytest.approx(HOLD_START, abs=0.01)
    assert event.distance == pytest.approx(0.028, abs=3e-3)
    assert event.yaw == pytest.approx(0.08, abs=0.01)
    assert kinds(rollout.events[:2]) == [StartsElsewhere, Replanned]
    assert rollout.events[1].changes == 2
    assert rollout.stopped == ""
    end = load(rollout, rollout.time[-1])
    assert min(end["LHand"], end["RHand"]) > LOST


@pytest.mark.parametrize("share", [0.2, 0.45, 0.7])
def test_it_pauses_anywhere_and_goes_on(hands_plan, share):
    """Ten seconds on the way, also with a limb in the air; then as planned."""
    t = hands_plan.trajectory
    told = share * float(t.time[-1])
    rollout = simulate(hands_plan, pause=told, disturbance=Disturbance(**EXACT))
    assert first(rollout, Paused).time == pytest.approx(told, abs=0.011)
    assert not rollout.fell
    assert rollout.stopped == ""
    assert len(rollout.ctrl) - len(t.time) == pytest.approx(10_600, abs=700)
    stride, joints = rollout.stride, rollout.world.qadr
    begin = round((told + 2.5) / PHYSICS_STEP / stride)
    still = rollout.qpos[begin : begin + round(7.0 / PHYSICS_STEP / stride)]
    assert np.abs(still[:, joints] - still[0, joints]).max() < 0.01
    assert np.linalg.norm(still[:, :3] - still[0, :3], axis=1).max() < 0.004


@pytest.mark.parametrize("pause", [-1.0, np.nan])
def test_a_pause_has_a_time(hands_plan, pause):
    with pytest.raises(InputError, match="pause"):
        simulate(hands_plan, pause=pause)


def test_open_loop_does_not_pause(hands_plan):
    with pytest.raises(InputError, match="pid"):
        simulate(hands_plan, pause=1.0, controller="pid")


def test_torques_follow_the_mass_that_is_measured(hands_plan):
    rollout = run(hands_plan, mass=1.1, **EXACT)
    event = first(rollout, Heavier)
    assert event.time == pytest.approx(HOLD_START, abs=0.01)
    assert event.factor == pytest.approx(1.1, abs=0.01)
    assert rollout.stopped == ""
    # The feed-forward of a compliant joint is all of its torque while it is still.
    w, t = rollout.world, rollout.followed or hands_plan.trajectory
    k = round(event.time / PHYSICS_STEP) + 2
    j = int(np.flatnonzero((w.ki == 0) & (np.abs(t.tau[k]) > 1.0))[0])
    u = rollout.ctrl[k, w.model.actuator(w.joints[j]).id]
    damping = w.kd[j] + w.model.dof_damping[w.dadr[j]]
    left = w.kp[j] * (u - t.q[k, w.qadr[j]]) - damping * t.v[k, w.dadr[j]]
    assert left == pytest.approx(event.factor * t.tau[k, j], abs=5e-3)


def test_a_push_acts_from_when_it_begins_and_not_before(hands_plan, noisy):
    pushed = run(hands_plan, height=0.02, seed=3, push=40.0)
    assert noisy.push is None
    assert len(pushed.push) == len(pushed.ctrl)
    start = int(np.flatnonzero(pushed.push.any(axis=1))[0])
    row = start // 10
    assert np.array_equal(pushed.qpos[: row + 1], noisy.qpos[: row + 1])
    off = pushed.qpos[row + 20, :2] - noisy.qpos[row + 20, :2]
    assert off @ pushed.push[start, :2] / 40.0 > 1e-3
    assert not pushed.fell


def test_a_push_that_fells_the_robot_ends_the_run(hands_plan):
    rollout = run(hands_plan, push=1000.0, seed=2, **EXACT)
    assert rollout.fell
    assert len(rollout.ctrl) < len(hands_plan.trajectory.time)
    assert rollout.rests_on == ()
    assert not judge(hands_plan, rollout).criteria[Figure.UPRIGHT].ok


# On made-up measurements: all that is looked at.


class Told:
    """A robot of thin air, on scales: it is where it should be, but for what is said.

    What is closed, or soon will be, is loaded alike; from an event on, as it was then.

    Attributes:
        k: Sample of the trajectory that it is at.
        up: How much higher than it should be it is [m].
    """

    def __init__(self, plan, world=None):
        self.executive = Executive(plan, world or plan.world)
        self.world, self.surfaces = plan.world, list(plan.world.surfaces)
        self.trajectory, self.k, self.up, self.moves = plan.trajectory, 0, 0.0, True

    @property
    def events(self):
        return self.executive.events

    def scales(self, share: float = 1.0, **newtons: float) -> np.ndarray:
        """(nS, 3) forces, a share of the weight; some as they are said."""
        t = self.trajectory
        rows = [min(self.k + n, len(t.time) - 1) for n in (0, 40)]
        closed = t.contact[rows].any(axis=0)
        force = np.zeros((len(self.surfaces), 3))
        force[closed, 2] = share * 9.81 * self.world.mass / closed.sum()
        for surface, f in newtons.items():
            force[self.surfaces.index(surface)] = [0.0, 0.0, f]
        return force

    def tick(self, q=None, force=None) -> np.ndarray:
        seen = len(self.events)
        self.k += self.moves
        if q is None:
            q = self.executive.reference.copy()
            q[2] += self.up
        force = self.scales() if force is None else force
        out = self.executive.command(Measurement(q, force))
        self.moves &= len(self.events) == seen
        return out

    def to(self, k: int, share: float = 1.0, **newtons: float) -> None:
        """Up to a sample of the plan, or the next event."""
        seen = len(self.events)
        while self.k < k and len(self.events) == seen:
            self.tick(force=self.scales(share, **newtons))

    def until(self, events: int, force=None) -> None:
        """Up to so many events."""
        for _ in range(20_000):
            if len(self.events) >= events:
                return
            self.tick(force=force)
        raise AssertionError(f"only {self.events}")

    def finish(self) -> None:
        for _ in range(200_000):
            if not self.executive.left:
                return
            self.tick()
        raise AssertionError("no end")


@pytest.fixture
def nothing_found(monkeypatch):
    """Planning again finds no way; what it was asked for is in this list."""
    asked = []

    def nothing(*_, start, **__):
        asked.append(start)
        raise InputError("no way")

    monkeypatch.setattr(progress, "plan", nothing)
    return asked


def test_without_looking_at_physics_it_follows_what_it_is_told(hands_plan):
    """A robot that is always where it should be, on scales that agree."""
    told = Told(hands_plan)
    told.finish()
    assert told.events == []
    assert told.executive.done == 2
    assert told.executive.followed is None
    assert sorted(told.executive.rests_on) == described(hands_plan.keyframes[-1].stance)


@pytest.mark.parametrize(
    ("forward", "turn", "noticed"),
    [
        (0.9 * START_DRIFT, 0.0, False),
        (1.1 * START_DRIFT, 0.0, True),
        (0.0, 0.02, False),
        (0.0, -0.06, True),  # by what it does to the arms
    ],
)
def test_a_start_that_is_hardly_off_is_left_alone(
    hands_plan, nothing_found, forward, turn, noticed
):
    told = Told(hands_plan)
    q = hands_plan.trajectory.q[0].copy()
    c, s = np.cos(turn), np.sin(turn)
    at = hands_plan.world.scene.start[:2]  # turned about the ankles
    q[:2] = at + np.array([[c, -s], [s, c]]) @ (q[:2] - at) + [forward, 0.0]
    q[3:7] = quat_multiply(quat_from_yaw(turn), q[3:7])
    for _ in range(round(HOLD_START / PHYSICS_STEP) + 1):
        told.tick(q)
    assert kinds(told.events) == [StartsElsewhere] * noticed
    if noticed:
        assert told.events[0].distance == pytest.approx(forward, abs=1e-4)
        assert told.events[0].yaw == pytest.approx(turn, abs=1e-4)


@pytest.mark.parametrize("share", [0.9, 1.1])
def test_a_weight_within_what_sensors_tell_is_taken_for_the_description(
    hands_plan, share
):
    told, ratio = Told(hands_plan), 1.0 + share * MASS_CHANGE
    for _ in range(310):
        told.tick(force=ratio * told.scales())
    assert kinds(told.events) == [Heavier] * (share > 1)


@pytest.mark.parametrize("share", [0.9, 1.1])
def test_where_no_other_plan_is_found_the_one_at_hand_may_do(
    hands_plan, nothing_found, share
):
    """As far as contacts are not too far off; else it stays where it is."""
    told, touch = Told(hands_plan), touch_of(hands_plan, 0)
    touches_early(told, touch, share * FALLBACK, LHand=50.0)
    assert kinds(told.events) == [ContactMoved]
    assert told.events[0].made
    told.until(2)
    q = told.executive.reference.copy()
    told.tick()
    assert np.array_equal(told.executive.reference[7:], q[7:]) or share < 1
    assert kinds(told.events[1:]) == [KeptPlan if share < 1 else Stopped]
    assert told.executive.stopped == ("" if share < 1 else "no way")
    (now,) = nothing_found
    assert {c.surface for c in now.stance} == {"LFoot", "RFoot", "LHand"}
    assert {c.surface for c in now.loaded} == {"LFoot", "RFoot"}
    assert now.done == told.executive.done == 1


def test_with_all_steps_done_there_is_no_need_of_another_plan(
    hands_plan, nothing_found
):
    told, touch = Told(hands_plan), touch_of(hands_plan, 1)
    touches_early(told, touch, 3.0 * FALLBACK, RHand=50.0)
    assert kinds(told.events) == [ContactMoved]
    told.finish()
    assert kinds(told.events) == [ContactMoved, KeptStance]
    assert told.executive.stopped == ""


def test_a_plan_that_goes_less_far_is_taken_where_the_one_at_hand_will_not_do(
    hands_plan, monkeypatch
):
    """And its end is said when it is reached; one without a change is no plan."""
    failure = Failure(status=Status.UNREACHABLE, detail="no way")
    for n, said in ((1, [Replanned, Stopped]), (0, [Stopped])):
        changes = hands_plan.changes[1 : 1 + n]
        found = replace(
            hands_plan,
            start=hands_plan.keyframes[1],
            changes=changes,
            failures=(failure,),
            complete=False,
            trajectory=timed(
                IK(hands_plan.world), changes or hands_plan.changes, "max"
            ),
        )
        monkeypatch.setattr(progress, "plan", lambda *_, found=found, **__: found)
        told, touch = Told(hands_plan), touch_of(hands_plan, 0)
        touches_early(told, touch, 1.1 * FALLBACK, LHand=50.0)
        told.until(2)
        if n:  # what it stands on from there on
            told.trajectory, told.k, told.moves = found.trajectory, 299, True
        told.up = 0.0
        told.finish()
        assert kinds(told.events[1:]) == said
        assert told.executive.stopped == "no way"


def test_with_other_contacts_what_is_done_is_counted_by_their_steps(
    hands_plan, monkeypatch
):
    """A search numbers its steps anew: those of the first plan say nothing then."""
    state = State(stance=(), loaded=(), q=hands_plan.world.home, done=0)
    other = replace(
        hands_plan,
        start=hands_plan.keyframes[1],
        sequence=replace(hands_plan.sequence, source="others"),
        changes=numbered(hands_plan.changes[1:], 1),
        trajectory=timed(IK(hands_plan.world), hands_plan.changes[1:], "max"),
        fallback=Fallback(reason="", source="search"),
    )
    asked = []

    def found(goal, *_, start, **__):
        asked.append((goal, start.done))
        done = 4  # the search takes more steps to where the robot stands
        return replace(
            other,
            changes=numbered(hands_plan.changes[1:], done),
            state=replace(state, done=done),
        )

    monkeypatch.setattr(progress, "plan", found)
    told, touch = Told(hands_plan), touch_of(hands_plan, 0)
    touches_early(told, touch, 1.1 * FALLBACK, LHand=50.0)
    told.until(2)
    assert kinds(told.events) == [ContactMoved, Replanned]
    told.trajectory, told.k, told.moves = other.trajectory, 299, True
    told.up = 0.0
    there = other.trajectory.segments[1].end
    touches_early(told, there, 1.1 * FALLBACK, RHand=50.0)
    told.until(4)
    (first, begun), (second, done) = asked
    assert (first.source, begun) == (hands_plan.sequence.source, 1)
    assert (second.source, done) == ("others", 5)


@pytest.mark.parametrize(
    ("again", "when"),
    [
        pytest.param([1], [0, 1, 2], id="the rest"),
        pytest.param([0, 1], [0, 2, 3], id="one step again"),
        pytest.param([0], [0, 2, 2], id="one step less"),
    ],
)
def test_a_policy_followed_anew_reaches_the_keyframes_of_the_plan(
    hands_plan, monkeypatch, again, when
):
    """Its steps begin at 0 again; `when`: after so many changes each was reached."""
    made = replace(hands_plan, policy=POLICY)
    changes = numbered([hands_plan.changes[i] for i in again])
    t = timed(IK(made.world), changes, "max")
    found = replace(made, start=made.keyframes[1], changes=changes, trajectory=t)
    monkeypatch.setattr(progress, "plan", lambda *_, **__: found)
    told, touch = Told(made), touch_of(made, 0)
    touches_early(told, touch, 1.1 * FALLBACK, LHand=50.0)
    told.until(2)
    assert kinds(told.events) == [ContactMoved, Replanned]
    replanned = told.executive.core.steps - 1
    told.trajectory, told.k, told.moves, told.up = t, 299, True, 0.0
    told.finish()
    assert told.executive.stopped == ""
    before = replanned - round((RAMP + LOOK + SEARCHING) / PHYSICS_STEP)
    ends = replanned + np.array([end_of(found, i) for i in range(len(again))]) - 299
    steps = np.array([0, before, *ends])
    reached = told.executive.followed.keyframes / PHYSICS_STEP
    assert reached == pytest.approx(steps[when], abs=2.0)


@pytest.mark.parametrize("found", [True, False])
def test_a_contact_that_carries_nothing_is_probed_for_again(fast_plan, found):
    """The left hand is told that it carries nothing once both hands are down."""
    told, kin = Told(fast_plan), Kinematics(fast_plan.world)
    hand, top = told.surfaces.index("LHand"), fast_plan.world.supports["box"]
    touch, end = touch_of(fast_plan, 1), end_of(fast_plan, 1)
    low, since = 0.0, 0  # how far below the top the hand has been, and since when
    for _ in range(end + 8000):
        kin.update(told.executive.reference)
        below = -float(top.height(kin.contact_point("LHand", UP)))
        force = told.scales()
        if told.k > touch + 50:
            there = found and below > 0.5 * DEVIATION
            weight = force[:, 2].sum()
            force[hand] = [0.0, 0.0, 30.0] if there else 0.0
            force *= weight / force[:, 2].sum()  # the others bear the rest
            low = max(low, below)
        told.tick(force=force)
        since += found and low > 0.5 * DEVIATION
        if len(told.events) == 2 or since == 200:
            break
    assert kinds(told.events) == ([Lost] if found else [Lost, GivenUp])
    assert {e.surface for e in told.events} == {"LHand"}
    # Found a little lower, the plan goes on; else it was probed as deep as may be.
    assert low == pytest.approx(0.5 * DEVIATION if found else REACH, abs=2e-3)
    assert told.executive.stopped == ""
    if found:
        return
    # The hand is no part of the stance any more, nor of what is believed of the box.
    told.until(3, force=force)
    assert kinds(told.events[2:]) in ([Replanned], [Stopped])
    if told.executive.stopped == "":
        assert "LHand" not in {c.surface for c in told.executive.stance}
    believed = told.executive.estimate.scene(fast_plan.world.scene).boxes[0].top
    assert abs(float(top.height(believed.position))) < 3e-3
    assert float(top.normal @ believed.normal) > np.cos(0.02)


def test_all_surfaces_that_are_loaded_at_the_end_are_rested_on(fast_plan):
    """Hand and elbow of a limb may both be down, where one of them was planned."""
    told, hold = Told(fast_plan), fast_plan.trajectory.segments[-1]
    told.to(hold.begin)
    while told.executive.left:
        told.tick(force=told.scales(LHand=1.1 * LOST, RHand=0.9 * LOST))
    planned = ["LElbow@box", "LKnee@box", "RElbow@box", "RKnee@box"]
    assert sorted(told.executive.rests_on) == sorted(["LHand@box", *planned])


def test_ankles_position_themselves_while_both_arms_are_loaded(fast_plan):
    """Then their command goes with the measured angle: a deviation is let alone."""
    slow = timed(IK(fast_plan.world), fast_plan.changes, 0.3)
    options = replace(fast_plan.options, speed=0.3)
    fast_plan = replace(fast_plan, trajectory=slow, options=options)
    told, w = Told(fast_plan), fast_plan.world
    feet = self_positioning_joints(w)
    off = np.where(np.any(list(feet.values()), axis=0), 0.01, 0.0)

    def holds(k: int) -> dict[str, bool]:
        """Whether a deviation of the ankles is commanded back at a sample."""
        told.to(k - 1)
        before = told.tick() - told.executive.reference[w.qadr]
        q = told.executive.reference.copy()
        q[w.qadr] += off
        after = told.tick(q) - told.executive.reference[w.qadr] - off
        return {f: bool(np.all((before - after)[j] > 5e-3)) for f, j in feet.items()}

    foot = fast_plan.trajectory.contact[:, told.surfaces.index("LFoot")]
    lifts = int(np.flatnonzero(~foot)[0])
    assert holds(touch_of(fast_plan, 1)) == {"LFoot": True, "RFoot": True}
    assert holds(lifts - 1200) == {"LFoot": False, "RFoot": False}
    assert holds(lifts - 200) == {"LFoot": True, "RFoot": False}  # before it steps


# A limb that slips back.


@pytest.mark.parametrize("at", ["swing", "end"])
def test_a_limb_that_bears_on_another_support_is_planned_on_from_there(
    demo_plan, nothing_found, monkeypatch, at
):
    """The left knee bears nothing; its foot does, on the ground, for a while.

    It has slipped while the right knee is on its way, or when all is done.
    """
    monkeypatch.setattr(executive.Estimate, "_bears", bears_somewhere)
    end = demo_plan.trajectory.segments[-1].begin
    told = Told(demo_plan)
    told.to(touch_of(demo_plan, 5) - 600 if at == "swing" else end)
    assert told.events == []
    since, told.moves = told.executive.core.steps, False
    knee, foot = (told.surfaces.index(x) for x in ("LKnee", "LFoot"))
    for _ in range(2000):
        force = told.scales()
        force[foot], force[knee] = force[knee].copy(), 0.0
        told.tick(force=force)
        if nothing_found:
            break
    moved = told.events[0]
    assert kinds(told.events[:1]) == [ContactMoved]
    assert (moved.surface, moved.planned) == ("LFoot", "LKnee")
    waited = moved.time - since * PHYSICS_STEP - 0.12  # until the forces are known
    assert waited == pytest.approx(LASTS if at == "swing" else LOOK - 0.12, abs=0.06)
    on = {c.surface: c.support for c in nothing_found[0].stance}
    right = {"RKnee": "box"} if at == "end" else {}
    assert on == {"LElbow": "box", "RElbow": "box", "LFoot": "ground", **right}


def bears_somewhere(estimate, c) -> bool:
    """Feet on the ground, the rest on the box: a robot of thin air stays in the air."""
    return estimate.force(c) >= TOUCH and ("Foot" in c.surface) == (c.support == GROUND)


# Unintended contacts.


@pytest.fixture
def arm_on_box(demo_plan, monkeypatch):
    """What seems to carry the load that is missing: this link of the robot."""
    geom = {"name": "RUpperArm"}
    m = demo_plan.world.model

    def loaded_link(kin, load, weight):
        return UnintendedContact(m.geom(geom["name"]).id, "box", 0.01)

    monkeypatch.setattr(unintended, "loaded_link", loaded_link)
    return geom


@pytest.mark.parametrize("side", ["L", "R"])
def test_a_limb_on_its_way_may_graze_an_edge(
    demo_plan, nothing_found, arm_on_box, side
):
    """The others are kept farther away from what they touch."""
    assert demo_plan.changes[0].step.makes.surface == "LHand"
    arm_on_box["name"] = f"{side}UpperArm"
    told = Told(demo_plan)
    swing = next(s for s in demo_plan.trajectory.segments if s.kind == "swing")
    third = (swing.end - swing.begin) // 3
    told.to(swing.begin + third)
    told.to(swing.end - third, share=0.8)
    assert kinds(told.events) == [Unintended] * (side == "R")
    if side == "R":
        assert told.events[0].support == "box"
        assert list(told.executive.watch.clearance.values()) == [pytest.approx(0.03)]


@pytest.mark.parametrize("before", [True, False])
def test_on_the_way_to_where_a_change_begins_an_unintended_contact_may_end(
    demo_plan, nothing_found, arm_on_box, monkeypatch, before
):
    """There a new plan lifts off what touched; back would be where it did.

    One that was not there before comes on the way.
    """
    t = demo_plan.trajectory
    later = replace(t, keyframes=np.array([0.8, *t.keyframes[1:]]))
    told = Told(replace(demo_plan, trajectory=later))
    if before:
        monkeypatch.setattr(unintended.Watch, "seems_so", True)
    told.to(301)
    told.to(800, share=0.8)
    assert kinds(told.events) == ([] if before else [Unintended])
    if not before:
        assert told.events[0].time == pytest.approx(0.3 + LASTS, abs=0.05)
        return
    told.to(900, share=0.8)
    assert kinds(told.events) == [Unintended]


def test_while_a_contact_is_loaded_it_goes_back_to_its_touch(
    demo_plan, nothing_found, arm_on_box
):
    """The contact is made, and carries nothing as yet."""
    told, touch = Told(demo_plan), touch_of(demo_plan, 0)
    told.to(touch + 30)
    told.to(touch + 290, share=0.8)
    assert kinds(told.events) == [Unintended]
    for _ in range(3000):
        if not nothing_found:
            told.tick()
    (now,) = nothing_found
    assert np.array_equal(told.executive.reference, demo_plan.trajectory.q[touch])
    both = {"LFoot", "RFoot", "LHand"}
    assert {c.surface for c in now.stance} == both
    assert {c.surface for c in now.loaded} == both - {"LHand"}


@pytest.mark.parametrize("found", [True, False])
def test_where_there_is_no_way_without_it_it_is_accepted(
    demo_plan, monkeypatch, arm_on_box, nothing_found, found
):
    """Back and forth on the plan at hand would end nothing."""
    if found:

        def again():
            return replace(demo_plan, trajectory=replace(demo_plan.trajectory))

        monkeypatch.setattr(progress, "plan", lambda *_, **__: again())
    told = Told(demo_plan)
    told.to(500)
    told.moves = False
    for _ in range(8 * 2500):
        told.tick(force=told.scales(share=0.8))
    times = kinds(told.events).count(Unintended)
    assert times == (RETREATS if found else 1)


@pytest.mark.parametrize(
    ("surface", "hits"), [("LHand", False), ("LElbow", False), ("LKnee", True)]
)
def test_what_is_loaded_in_place_of_a_contact_hits_no_side(
    demo_plan, monkeypatch, surface, hits
):
    """A hand in the stance, or the elbow that has come to lie there instead."""
    asked = []
    monkeypatch.setattr(
        unintended, "nearest_of", lambda kin, names: asked.append(names)
    )
    told, end = Told(demo_plan), end_of(demo_plan, 0)
    told.to(end)
    kin, top = Kinematics(demo_plan.world), demo_plan.world.supports["box"]
    row = told.surfaces.index
    for _ in range(400):
        q, force = told.executive.reference.copy(), told.scales()
        if surface == "LElbow":
            kin.update(q)
            q[2] -= top.height(kin.contact_point("LElbow", UP))
            force[row("LHand")] = 0.0
        force[row(surface)] = [2.0 * TOUCH, 0.0, 1.5 * TOUCH * (surface != "LKnee")]
        force[row("LFoot"), 2] += 60.0  # nothing is missing
        told.tick(q, force)
    assert [*asked[:1]] == ([["LKnee"]] if hits else [])


# Open loop.


def test_open_loop_the_trajectory_is_followed_sample_by_sample(demo_plan, rng):
    world, t = demo_plan.world, demo_plan.trajectory
    follower, servo = OpenLoop(demo_plan, world), joint_servo(world)
    force = np.full((len(world.surfaces), 3), 500.0)  # at which it does not look
    for k in range(300):
        q = t.q[k] + rng.normal(0.0, 1e-3, len(t.q[k]))
        expected = servo.command(
            *(t.q[k, world.qadr], t.v[k, world.dadr], t.tau[k], q[world.qadr]),
            np.zeros(len(world.qadr)),
        )
        assert np.array_equal(follower.command(Measurement(q, force)), expected)
        assert follower.left == len(t.time) - 1 - k
        assert np.array_equal(follower.reference, t.q[k])
    assert follower.events == []
    assert follower.followed is None
    assert sorted(follower.rests_on) == described(demo_plan.keyframes[-1].stance)


def test_where_nothing_robust_is_left_to_do_the_rest_need_not_be(
    hands_plan, monkeypatch
):
    """A top that is elsewhere leaves no robust rest: that is no reason to stop."""
    options = replace(hands_plan.options, robust=True)
    monkeypatch.setattr("clamber.step.robust.COM", 0.5)
    rollout = run(replace(hands_plan, options=options), height=0.05, **EXACT)
    assert Replanned in kinds(rollout.events)
    assert Stopped not in kinds(rollout.events)
