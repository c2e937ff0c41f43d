"""What physics makes of a plan, and what the verdict says about it."""

from __future__ import annotations

import gc
import weakref
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from clamber import _core
from clamber.execution.disturbance import Disturbance
from clamber.execution.events import Replanned, Stopped
from clamber.execution.executive import Executive
from clamber.execution.simulation import (
    FALLEN_HEIGHT,
    FALLEN_TILT,
    has_fallen,
    simulate,
)
from clamber.execution.verdict import (
    END_SPEED,
    GOAL_TOL,
    HEIGHT_TOL,
    LOAD_ON_PLAN,
    PENETRATION_TOL,
    TILT_TOL,
    UNINTENDED_TOL,
    YAW_TOL,
    Criterion,
    Figure,
    Verdict,
    judge,
    measure,
    self_penetration,
    strained_joint,
)
from clamber.model.scene import Scene
from clamber.model.world import PHYSICS_STEP, build_world


@pytest.fixture(scope="module")
def start_only(demo_plan):
    """A plan whose trajectory ends after two seconds: quick to run."""
    t = demo_plan.trajectory
    cut = {n: getattr(t, n)[:2000] for n in ("time", "q", "v", "tau", "contact")}
    return replace(demo_plan, trajectory=replace(t, **cut))


@pytest.fixture(scope="module")
def figures(demo_rollout):
    return measure(demo_rollout)


def test_a_run_lets_go_of_its_buffers_when_it_is_over(one_hand_plan, monkeypatch):
    """Without waiting for the garbage collector: a sweep makes thousands."""
    made, plain = [], Executive.__init__

    def noted(self, *args, **more):
        plain(self, *args, **more)
        made.append(weakref.ref(self))

    monkeypatch.setattr(Executive, "__init__", noted)
    gc.collect()
    gc.disable()
    try:
        simulate(one_hand_plan)
        assert [x() for x in made] == [None]
    finally:
        gc.enable()


def failed(plan, rollout, figures) -> set[Figure]:
    return {n for n, c in judge(plan, rollout, figures).criteria.items() if not c.ok}


def turned(q: np.ndarray, axis: int, angle: float) -> np.ndarray:
    """The base rotated about an axis of the world."""
    out, turn = q.copy(), np.zeros(4)
    turn[0], turn[1 + axis] = np.cos(angle / 2), np.sin(angle / 2)
    mujoco.mju_mulQuat(out[3:7], turn, q[3:7])
    return out


def with_last(rollout, q):
    return replace(rollout, qpos=np.vstack([rollout.qpos[:-1], q]))


# The rollout is physics and nothing else.


def test_plain_mujoco_arrives_at_the_same_states_from_the_written_scene(
    demo_plan, demo_rollout
):
    model = mujoco.MjModel.from_xml_string(demo_rollout.world.xml)
    data = mujoco.MjData(model)
    data.qpos[:] = demo_rollout.qpos[0]
    for k, ctrl in enumerate(demo_rollout.ctrl):
        row, rest = divmod(k, demo_rollout.stride)
        if rest == 0:
            assert np.array_equal(np.float32(data.qpos), demo_rollout.qpos[row])
            assert np.array_equal(np.float32(data.qvel), demo_rollout.qvel[row])
        data.ctrl[:] = ctrl
        mujoco.mj_step(model, data)


class Passive:
    """Decides nothing."""

    def decide(self, look: bool) -> None: ...

    def balance(self) -> None: ...


def test_the_deepest_contact_is_found_however_many_there_are():
    model = mujoco.MjModel.from_xml_string("""
    <mujoco><worldbody>
      <geom type="plane" size="2 2 0.1"/>
      <body pos="0 0 0.2" euler="20 10 0">
        <freejoint/> <geom type="box" size="0.1 0.1 0.1"/>
      </body>
    </worldbody></mujoco>""")
    data, none, steps = mujoco.MjData(model), np.zeros((1, 0)), 1500
    q, flags = data.qpos[None].copy(), np.zeros((1, 0), dtype=bool)
    track = _core.Track(7, 0, 0)
    track.load(q, none, none, flags, flags, steps)
    share = {"pose_share": 1.0, "force_share": 1.0}
    follower = _core.Follower(
        _core.Filter(q[0].tolist(), 0, **share),
        track,
        _core.JointServo(kp=[], damping=[], ki=[], limit=[], dt=PHYSICS_STEP),
        _core.SelfPositioning(arms=[], ankles=[], joints=0, rate=1.0),
        **{"qadr": [], "period": 10, "touch": 1.0, "shift_share": 1.0},
    )
    follower.ends = True
    sensors = _core.Sensors(nq=7, surfaces=0, late=0, force_stride=5, block=steps)
    n = steps // 5
    sensors.draw(*map(np.zeros, ((steps, 7), (steps, 3), (n, 0), (n, 0, 3))))
    loop = _core.Loop(
        data,
        follower,
        sensors,
        _core.ContactForces([_core.SCENE, _core.OTHER], 0),
        **{"order": [], "step_size": 1.0, "base": 1, "stride": 1, "tail": 0},
        **{"tilt": np.pi, "height": 1.0, "push": None, "steps": 10},
    )
    depth, listed = [], []
    while loop.step(Passive()):
        mujoco.mj_step(model, data)
        depth.append(max(0.0, *-data.contact.dist, 0.0))
        listed.append(data.ncon)
    assert {0, 1, 2, 4} <= set(listed)
    assert np.array_equal(loop.recorded()["penetration"], depth)


def test_it_starts_at_rest_where_the_plan_does(demo_plan, demo_rollout):
    assert np.array_equal(demo_rollout.qpos[0], np.float32(demo_plan.trajectory.q[0]))
    assert not demo_rollout.qvel[0].any()


def test_there_is_a_command_for_every_sample_and_a_state_for_every_tenth(
    demo_plan, demo_rollout
):
    n = len(demo_plan.trajectory.time)
    assert demo_rollout.ctrl.shape == (n, demo_plan.world.model.nu)
    assert demo_rollout.stride == 10
    assert len(demo_rollout.time) == len(demo_rollout.qpos) == -(-n // 10)
    assert np.allclose(np.diff(demo_rollout.time), 10 * PHYSICS_STEP)


def test_two_runs_are_the_same_to_the_last_bit(start_only):
    a, b = (simulate(start_only, controller="pid") for _ in range(2))
    for name in ("ctrl", "qpos", "qvel", "actuator_force", "contact_load"):
        assert np.array_equal(getattr(a, name), getattr(b, name))


def test_the_beginning_does_not_depend_on_the_end(start_only, demo_rollout):
    exact = Disturbance(noise=0.0, delay=0.0)
    short = simulate(start_only, controller="pid", disturbance=exact)
    assert np.array_equal(short.qpos, demo_rollout.qpos[: len(short.qpos)])


def test_the_robot_follows_the_plan(demo_plan, demo_rollout):
    world, planned = demo_plan.world, demo_plan.trajectory.q[:: demo_rollout.stride]
    off = np.abs(demo_rollout.qpos[:, world.qadr] - planned[:, world.qadr])
    assert off.max() < 0.03  # [rad]
    base = np.linalg.norm(demo_rollout.qpos[:, :3] - planned[:, :3], axis=1)
    assert base.max() < 0.03  # [m]


def test_progress_goes_from_nothing_to_all(start_only):
    seen = []

    def note(stage, share, _):
        seen.append(share)

    simulate(start_only, controller="pid", progress=note)
    assert seen[0] == 0.0
    assert seen[-1] == 1.0
    assert seen == sorted(seen)


def test_progress_is_the_share_of_the_motion_that_is_done(one_hand_plan):
    seen = []
    simulate(one_hand_plan, progress=lambda _, share, note: seen.append((share, note)))
    even = np.linspace(0.0, 1.0, len(seen))
    assert np.abs(np.array([s for s, _ in seen]) - even).max() < 0.1


def test_a_plan_without_a_trajectory_cannot_be_simulated(demo_plan):
    with pytest.raises(ValueError, match="no trajectory"):
        simulate(replace(demo_plan, trajectory=None))


@pytest.mark.parametrize("share", [0.99, 1.01])
def test_it_has_fallen_where_the_pelvis_is_far_from_its_reference(demo_plan, share):
    q = demo_plan.trajectory.q[0]
    low, high = q.copy(), q.copy()
    low[2] -= share * FALLEN_HEIGHT
    high[2] += 10 * FALLEN_HEIGHT
    assert has_fallen(low, q) == (share > 1)
    assert not has_fallen(high, q)
    upright = q.copy()
    upright[3:7] = [1.0, 0.0, 0.0, 0.0]
    for axis in (0, 1, 2):
        tilted = turned(upright, axis, share * FALLEN_TILT)
        assert has_fallen(tilted, upright) == (share > 1 and axis < 2)


# Forces.


def test_contact_forces_carry_the_weight_while_it_stands(demo_plan, demo_rollout):
    weight = 9.81 * demo_plan.world.mass
    for rows in (slice(15, 30), slice(-100, None)):
        total = demo_rollout.contact_force[rows].sum(axis=1).mean(axis=0)
        assert total[2] == pytest.approx(weight, rel=0.02)
        assert np.abs(total[:2]).max() < 0.02 * weight


def test_over_the_whole_run_contacts_give_back_what_gravity_takes(
    demo_plan, demo_rollout
):
    """Momentum: at rest before and after, the mean force is the weight."""
    total = demo_rollout.contact_force.sum(axis=1).mean(axis=0)
    weight = 9.81 * demo_plan.world.mass
    assert total[2] == pytest.approx(weight, rel=0.02)
    assert np.abs(total[:2]).max() < 0.02 * weight


def test_surfaces_bear_load_when_the_plan_says_so(demo_plan, demo_rollout):
    trajectory, weight = demo_plan.trajectory, 9.81 * demo_plan.world.mass
    planned = trajectory.contact[:: demo_rollout.stride]
    force = np.linalg.norm(demo_rollout.contact_force, axis=2)
    assert force[~planned].max(initial=0.0) < weight  # brief touches on landing
    open_share = (force[~planned] > 0.02 * weight).mean()
    assert open_share < 0.02


def test_feet_are_off_the_ground_and_knees_on_the_box_at_the_end(demo_rollout):
    last = demo_rollout.contact_force[-1]
    by_name = dict(zip(demo_rollout.surfaces, last, strict=True))
    assert not by_name["LFoot"].any()
    assert not by_name["RFoot"].any()
    assert by_name["LKnee"][2] > 10.0
    assert by_name["RKnee"][2] > 10.0


def test_the_demonstration_needs_no_link_that_is_no_surface(demo_rollout, figures):
    assert figures.unintended == 0.0
    assert not demo_rollout.unintended.any()
    assert figures.unintended_by == {}


def test_the_loads_at_the_end_add_up_to_the_weight(figures):
    assert sum(figures.end_load.values()) == pytest.approx(1.0, abs=0.01)
    assert {k.split("@")[1] for k in figures.end_load} == {"box"}


def test_contacts_as_listed_are_the_forces_on_surfaces(demo_plan, demo_rollout):
    """And every step of the last second is listed, not only the recorded ones."""
    r, stride = demo_rollout, demo_rollout.stride
    at = r.contact_step % stride == 0
    total = np.bincount(r.contact_step[at] // stride, weights=r.contact_load[at, 1])
    assert np.allclose(total, r.contact_force[: len(total), :, 2].sum(axis=1))
    assert np.all(np.diff(r.contact_step) >= 0)
    assert set(range(len(r.ctrl) - 1000, len(r.ctrl))) <= {*r.contact_step.tolist()}
    ground = demo_plan.world.model.geom("ground").id
    box = demo_plan.world.support_geom["box"]
    assert {*np.unique(r.contact_geoms[:, 1]).tolist()} == {ground, box}


def test_no_motor_ever_exceeds_its_limit(demo_plan, demo_rollout):
    order = [demo_plan.world.model.actuator(j).id for j in demo_plan.world.joints]
    effort = np.abs(demo_rollout.actuator_force[:, order])
    assert np.all(effort <= demo_plan.world.tau_max + 1e-9)
    assert effort.max() > 1.0  # and they do work


def test_a_part_that_is_no_surface_is_counted_as_unintended(demo_plan, start_only):
    """Dropped onto its bottom: what bears the weight is none of the surfaces."""
    t = start_only.trajectory
    q = t.q.copy()
    q[:, :3] = [-1.0, 0.0, 0.30]
    sitting = turned(q[0], 1, -1.2)
    q[:, 3:7] = sitting[3:7]
    world = replace(start_only.world, home=q[0])
    dropped = replace(start_only, world=world, trajectory=replace(t, q=q))
    rollout = simulate(dropped, controller="pid")
    assert rollout.unintended.max() > 100.0
    figures = measure(rollout)
    assert figures.unintended > 0.3
    assert sum(figures.unintended_by.values()) == pytest.approx(figures.unintended)
    assert not judge(dropped, rollout, figures).reached


def test_self_penetration_is_what_mujoco_measures(demo_plan):
    world, q = demo_plan.world, demo_plan.world.home.copy()
    assert self_penetration(world, q[None]) == (0.0, "")
    for side, sign in (("R", 1.0), ("L", -1.0)):
        q[world.qadr[world.joints.index(f"{side}HipLat")]] = 0.35 * sign
    depth, pair = self_penetration(world, q[None])
    data, fromto = mujoco.MjData(world.model), np.zeros(6)
    data.qpos[:] = q
    mujoco.mj_kinematics(world.model, data)
    a, b = pair.split(" and ")
    ids = world.model.geom(a).id, world.model.geom(b).id
    assert depth > 0.005
    assert depth == pytest.approx(
        -mujoco.mj_geomDistance(world.model, data, *ids, 0.1, fromto)
    )


def test_physics_decides_a_box_lower_than_the_plan_believes(demo_plan):
    world = build_world(demo_plan.world.robot, Scene.from_height(0.18))
    believer = replace(demo_plan, world=world)
    assert not judge(believer, simulate(believer, controller="pid")).reached


# The verdict.


def test_the_demonstration_reaches_the_top(demo_plan, demo_rollout, figures):
    verdict = judge(demo_plan, demo_rollout)
    assert verdict.reached
    assert all(c.ok for c in verdict.criteria.values())
    for c in verdict.criteria.values():
        assert np.isfinite([c.value, c.limit]).all()
    again = judge(demo_plan, demo_rollout, figures)
    for name, c in again.criteria.items():
        assert c.value == verdict.criteria[name].value


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"end_speed": 1.01 * END_SPEED}, Figure.END_SPEED),
        ({"unintended": 1.01 * UNINTENDED_TOL}, Figure.UNINTENDED),
        ({"penetration": 1.01 * PENETRATION_TOL}, Figure.PENETRATION),
        ({"self_penetration": 1.01 * PENETRATION_TOL}, Figure.SELF_PENETRATION),
        ({"effort": 1.01}, Figure.EFFORT),
    ],
)
def test_each_figure_beyond_its_limit_fails_its_criterion_alone(
    demo_plan, demo_rollout, figures, change, name
):
    assert failed(demo_plan, demo_rollout, replace(figures, **change)) == {name}


def test_figures_are_those_of_the_arrays(demo_rollout, figures):
    """Each array that a figure is read from, made worse at one place."""
    r = demo_rollout
    speed, depth, effort = r.end_speed.copy(), r.penetration.copy(), r.actuator_force
    assert figures.end_speed == speed.max()
    assert figures.penetration == depth.max()
    speed[-3], depth[7] = 0.2, 0.03
    effort = effort.copy()
    effort[5, 3] = -1.5 * r.world.model.actuator(3).forcerange[1]
    worse = measure(
        replace(r, end_speed=speed, penetration=depth, actuator_force=effort)
    )
    assert (worse.end_speed, worse.penetration) == (0.2, 0.03)
    assert worse.effort == pytest.approx(1.5)
    assert figures.effort < 1.0
    last = r.contact_step == r.contact_step[-1]
    load = np.where(last[:, None], 2.0 * r.contact_load, r.contact_load)
    heavier = measure(replace(r, contact_load=load))
    assert sum(heavier.end_load.values()) == pytest.approx(
        sum(figures.end_load.values())
        + r.contact_load[last, 1].sum() / (9.81 * r.world.mass * 1000)
    )


def test_an_incomplete_plan_is_no_success(demo_plan, demo_rollout, figures):
    short = replace(demo_plan, complete=False)
    assert failed(short, demo_rollout, figures) == {Figure.COMPLETE}


def test_the_joint_that_was_at_its_limit_for_longest_is_named(demo_rollout):
    world, force = demo_rollout.world, 0.0 * demo_rollout.actuator_force
    assert strained_joint(replace(demo_rollout, actuator_force=force)) is None
    for joint, seconds, sign in (("LElbj", 0.5, 1.0), ("RShSag", 1.2, -1.0)):
        j = world.joints.index(joint)
        rows = round(seconds / (demo_rollout.stride * 1e-3))
        force[:rows, world.model.actuator(joint).id] = sign * world.tau_max[j]
    found = strained_joint(replace(demo_rollout, actuator_force=force))
    assert found == ("RShSag", world.tau_max[j], pytest.approx(1.2))


def test_who_stopped_or_fell_did_not_make_it(demo_plan, demo_rollout, figures):
    fell = replace(demo_rollout, fell=True)
    assert failed(demo_plan, fell, figures) == {Figure.UPRIGHT}
    events = (Replanned(time=1.0, changes=2), Stopped(time=3.0, why="no way"))
    stopped = replace(demo_rollout, events=events)
    assert stopped.stopped == "no way"
    assert failed(demo_plan, stopped, figures) == {Figure.WENT_ON}


@pytest.mark.parametrize("share", [0.9, 1.1])
def test_the_pelvis_may_be_a_little_off_at_the_end_but_not_much(
    demo_plan, demo_rollout, figures, share
):
    last = demo_plan.trajectory.q[-1]
    low = last.copy()
    low[2] -= share * HEIGHT_TOL
    names = failed(demo_plan, with_last(demo_rollout, low), figures)
    assert (Figure.HEIGHT in names) == (share > 1)
    for axis in (0, 1):
        q = turned(last, axis, share * TILT_TOL)
        names = failed(demo_plan, with_last(demo_rollout, q), figures)
        assert names == ({Figure.TILT} if share > 1 else set())
    about = with_last(demo_rollout, turned(last, 2, 1.0))  # that is no tilt
    assert failed(demo_plan, about, figures) == set()


def test_weight_on_other_surfaces_than_planned_is_no_success(
    demo_plan, demo_rollout, figures
):
    load, moved = dict(figures.end_load), 1.1 * (1 - LOAD_ON_PLAN)
    load["LKnee@box"] -= moved
    for where, names in (
        ("other@box", {Figure.LOAD_ON_PLAN}),
        ("LFoot@ground", {Figure.LOAD_ON_PLAN, Figure.LOAD_ON_OBSTACLES}),
    ):
        there = replace(figures, end_load=load | {where: moved})
        assert failed(demo_plan, demo_rollout, there) == names
    # What the robot came to rest on, as executed, is what counts.
    rests = (*demo_rollout.rests_on, "other@box")
    there = replace(figures, end_load=load | {"other@box": moved})
    assert failed(demo_plan, replace(demo_rollout, rests_on=rests), there) == set()


def test_lying_on_the_top_is_not_kneeling_on_it(demo_plan, demo_rollout, figures):
    q = demo_rollout.qpos[-1].copy()
    q[2] = 0.275 + 0.04
    names = failed(demo_plan, with_last(demo_rollout, q), figures)
    assert Figure.ABOVE_SUPPORT in names


@pytest.mark.parametrize("share", [0.9, 1.1])
def test_a_goal_in_the_scene_is_reached_within_its_tolerance(
    demo_plan, demo_rollout, figures, share
):
    goal = demo_rollout.qpos[-1, :2] + [0.0, share * GOAL_TOL]
    world = demo_plan.world
    there = replace(world, scene=replace(world.scene, goal=goal))
    names = failed(replace(demo_plan, world=there), demo_rollout, figures)
    assert names == ({Figure.GOAL} if share > 1 else set())


@pytest.mark.parametrize("share", [-1.1, -0.9, 0.9, 1.1])
@pytest.mark.parametrize("facing", [0.0, 3.3])
def test_a_goal_with_a_heading_wants_that_heading(
    demo_plan, demo_rollout, figures, share, facing
):
    """Also across the cut at half a turn."""
    world = demo_plan.world
    q = turned(world.home, 2, facing)
    goal = np.array([*q[:2], facing + share * YAW_TOL])
    there = replace(world, scene=replace(world.scene, goal=goal))
    names = failed(replace(demo_plan, world=there), with_last(demo_rollout, q), figures)
    assert (Figure.YAW in names) == (abs(share) > 1)


def test_a_box_that_is_not_there_is_no_crash_of_the_judge(start_only):
    nothing = Scene(start=np.zeros(3))
    rollout = simulate(start_only, controller="pid", true_scene=nothing)
    assert not judge(start_only, rollout).reached


def test_a_verdict_is_shown_in_percent_millimetres_and_degrees() -> None:
    heavy = Figure.UNINTENDED
    figures = {
        Figure.UPRIGHT: (1.0, 1.0, "did not fall", "yes", "yes"),
        Figure.WENT_ON: (0.0, 1.0, "did not stop on the way", "no", "yes"),
        heavy: (0.0123, 0.01, "load on non-contact links", "1.2 %", "at most 1.0 %"),
        Figure.PENETRATION: (
            0.00026, 0.01,
            "deepest penetration of the scene", "0.3 mm", "at most 10.0 mm",
        ),
        Figure.END_SPEED: (
            0.002, 0.05, "pelvis speed at the end", "2.0 mm/s", "at most 50.0 mm/s"
        ),
        Figure.TILT: (
            np.pi / 36, np.pi / 9,
            "pelvis tilt error at the end", "5.0 deg", "at most 20.0 deg",
        ),
    }  # fmt: skip
    criteria = {
        f: Criterion(value=row[0], limit=row[1], ok=f is not heavy)
        for f, row in figures.items()
    }
    verdict = Verdict(reached=False, criteria=criteria)
    shown = [row[2:] for row in figures.values()]
    assert [row[:3] for row in verdict.rows()] == shown
    assert [row[3] for row in verdict.rows()] == [c.ok for c in criteria.values()]
    assert verdict.failed() == "load on non-contact links"
    for figure in Figure:  # none has a unit that nobody knows
        assert figure.in_words(0.0)
        assert "[" not in figure.label


def test_a_limit_is_said_to_be_the_least_or_the_most_as_it_is_judged(
    demo_plan, demo_rollout
):
    for figure, c in judge(demo_plan, demo_rollout).criteria.items():
        if figure.in_words(c.limit) != "yes":
            least = "at least" in figure.limit_in_words(c.limit)
            assert (c.value >= c.limit) if least else (c.value <= c.limit), figure


def test_who_ends_on_the_feet_alone_must_stand(demo_plan, demo_rollout, figures):
    on_feet = replace(demo_plan, changes=())
    home = demo_plan.world.home
    for lower, stands in ((0.0, True), (0.1, True), (0.3, False)):
        q = home.copy()
        q[2] *= 1.0 - lower
        verdict = judge(on_feet, with_last(demo_rollout, q), figures)
        c = verdict.criteria[Figure.STANDING]
        assert c.value == pytest.approx(1.0 - lower, abs=1e-6)
        assert c.ok is stands
    kneels = judge(demo_plan, demo_rollout, figures)
    assert Figure.STANDING not in kneels.criteria
