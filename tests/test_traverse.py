"""Planning with a general policy, from its parts to a whole crossing."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from clamber.contact.contact import Contact
from clamber.contact.policy import GeneralPolicy, Option, PelvisDistribution
from clamber.errors import InputError
from clamber.model.kinematics import Kinematics
from clamber.model.robot import load_robot
from clamber.model.scene import GROUND, Box, Scene
from clamber.model.world import build_world
from clamber.planning import gait as module
from clamber.planning.gait import cost_to_go, follow_policy, plan_traverse
from clamber.planning.proportions import build_of
from clamber.planning.records import Plan, PlanOptions
from clamber.run.folder import load_plan, save_plan
from clamber.step import direct
from clamber.step.change import standing
from clamber.step.ik import IK
from clamber.step.posture import KeyframeTask
from clamber.step.stability import contact_drift
from conftest import stairs


def option(name: str, region, surfaces, until) -> Option:
    return Option(
        name=name,
        region=region,
        surfaces=surfaces,
        repeats=2,
        initiation=("M",),
        held=(),
        termination=until,
    )


HANDS, ELBOWS = ("LHand", "RHand"), ("LElbow", "RElbow")
FOURS = (*ELBOWS, "LKnee", "RKnee")
POLICY = GeneralPolicy(
    options=(
        option("ac1", "M", HANDS, "M"),
        option("ac2", "M", ELBOWS, "O"),
        option("ac3", "O", (*ELBOWS, "LKnee", "RKnee"), "M"),
        option("ac2", "M", ELBOWS, "M"),
        option("ac1", "M", HANDS, "goal"),
        option("ac4", "goal", ("LFoot", "RFoot"), "goal"),
    ),
    over_top=PelvisDistribution(
        mean=np.array([0.0, 1.4, 1.2]), sigma=np.array([0.1, 0.2, 1.3]), samples=9
    ),
    near_edge=PelvisDistribution(
        mean=np.array([0.0, 1.0, 0.0]), sigma=np.array([0.1, 0.4, 0.2]), samples=9
    ),
    goal=("LFoot", "RFoot"),
)


def scene(length=0.6, width=0.8, height=0.25, face=0.23, goal=None) -> Scene:
    box = Box(
        name="table",
        size=np.array([length, width, height]),
        position=np.array([face + length / 2, 0.0, height / 2]),
        rotation=np.eye(3),
    )
    goal = [face + length + 0.25, 0.0] if goal is None else goal
    return Scene(boxes=(box,), start=np.zeros(3), goal=np.array(goal))


def contact(surface: str, x: float, y: float, support="table") -> Contact:
    return Contact(
        surface=surface,
        support=support,
        position=np.array([x, y, 0.0]),
        quaternion=np.array([1.0, 0, 0, 0]),
    )


def assert_contacts_are_kept(plan: Plan) -> None:
    kin = Kinematics(plan.world)
    for path in plan.changes:
        for phase in path.phases:
            for q in phase.q:
                kin.update(q)
                assert max(contact_drift(kin, c) for c in phase.contacts) < 0.005


@pytest.fixture(scope="module")
def robot():
    return load_robot("coman")


@pytest.fixture(scope="module")
def task(robot):
    ik = IK(build_world(robot, scene()))
    return module._task(ik, POLICY, PlanOptions())


@pytest.fixture(scope="module")
def crossing(robot) -> Plan:
    return plan_traverse(POLICY, robot, scene())


def test_cost_to_go_is_the_distance_of_the_contacts_mean():
    stance = (contact("LKnee", 0.0, 1.0), contact("RKnee", 2.0, 1.0))
    assert cost_to_go(stance, np.array([1.0, 4.0])) == pytest.approx(3.0)


@pytest.mark.parametrize("yaw", [-3.0, -1.0, 0.4, 2.5])
def test_the_frame_on_all_fours_is_found_again_from_its_contacts(task, yaw):
    frame = module._Frame(np.array([0.4, -0.2]), yaw)
    surfaces = {
        "left_arm": "LElbow",
        "right_arm": "RElbow",
        "left_leg": "LKnee",
        "right_leg": "RKnee",
    }
    stance = [
        contact(surfaces[n], *frame.at(offset))
        for n, offset in task.build.fours.items()
    ]
    found = module._fours_frame(task, stance)
    np.testing.assert_allclose(found.xy, frame.xy, atol=1e-12)
    assert math.remainder(found.yaw - yaw, 2 * math.pi) == pytest.approx(0, abs=1e-9)


def test_a_cycle_goes_no_farther_and_turns_no_more_than_it_may():
    a = module._Frame(np.zeros(2), 3.0)
    b = module._Frame(np.array([1.0, 0.0]), -3.0)
    c = module._between(a, b, 0.1, 0.25)
    np.testing.assert_allclose(c.xy, [0.1, 0.0])
    assert c.yaw == 3.0  # there is time to turn
    turning = module._between(a, module._Frame(np.zeros(2), -2.0), 0.1, 0.25)
    assert turning.yaw == pytest.approx(3.25)  # the short way round
    last = module._between(a, module._Frame(np.array([0.05, 0.0]), 3.1), 0.1, 0.25)
    np.testing.assert_allclose([*last.xy, last.yaw], [0.05, 0.0, 3.1])


def test_legs_lead_backwards_and_arms_forwards(task):
    cycle = POLICY.options[2]
    here = module._Frame(np.zeros(2), math.pi)
    back = module._Frame(np.array([0.1, 0.0]), math.pi)  # facing the other way
    ahead = module._Frame(np.array([-0.1, 0.0]), math.pi)
    lead = module._leading_first
    assert lead(task, cycle, here, back) == ("LKnee", "RKnee", "LElbow", "RElbow")
    assert lead(task, cycle, here, ahead) == cycle.surfaces


def test_where_there_is_no_way_down_contacts_move_to_where_there_is(task, monkeypatch):
    """Only those that are elsewhere, each from the stance that the last one left."""
    top = tuple(contact(s, 0.8, y) for s, y in zip(FOURS, (0.1, -0.1) * 2, strict=True))
    off = (0.03, 0.01, 0.04, 0.0)
    here = tuple(
        replace(c, position=c.position + np.array([d, 0.0, 0.0]))
        for c, d in zip(top, off, strict=True)
    )
    seen = []

    def attempt(task, key, surface, place, body, reference):
        now = next(c for c in key.stance if c.surface == surface)
        seen.append((surface, now.position[0], len(key.stance), key.made))
        if surface in refused:
            return "out of reach"
        moved = tuple(
            replace(c, position=place.position) if c.surface == surface else c
            for c in key.stance
        )
        after = SimpleNamespace(stance=moved, made=key.made + 1)
        return SimpleNamespace(keyframe=after)

    monkeypatch.setattr(module, "_attempt", attempt)
    refused: list[str] = []
    for moved in (2, 1):
        seen.clear()
        made = module._rearranged(task, SimpleNamespace(stance=here, made=0), top)
        assert [s for s, *_ in seen] == ["LElbow", "LKnee"]
        assert [x for _, x, *_ in seen] == pytest.approx([0.83, 0.84])
        assert [k for *_, k in seen] == [0, 1]
        assert len(made) == moved
        assert made[-1][0].keyframe.stance[0].position[0] == pytest.approx(0.8)
        assert {name for *_, name in made} == {"ac3"}
        refused.append("LKnee")


def test_the_last_step_of_a_descent_rises(task):
    """A robot that stays bent has its weight near its toes, and tips over them."""
    _, rows = module._descent(task, task.platforms[0])
    assert [step.stands_up for step, _ in rows] == [False] * (len(rows) - 1) + [True]
    last = rows[-1][0]
    assert last.makes is None
    assert task.ik.world.robot.limb_of(last.breaks[0]).is_arm


def test_the_posture_on_all_fours_rests_on_them_level(task):
    world = task.ik.world
    kin = Kinematics(world)
    kin.update(task.fours)
    up = np.array([0.0, 0.0, 1.0])
    points = [kin.contact_point(s, up) for s in POLICY.options[2].surfaces]
    np.testing.assert_allclose([p[2] for p in points], 0.0, atol=1e-3)


def test_steps_are_a_third_of_a_limb_or_what_was_shown(robot):
    ik = IK(build_world(robot, scene()))
    far = build_of(ik, replace(POLICY, reach={"LElbow": 5.0}))
    near = build_of(ik, replace(POLICY, reach={"LElbow": 0.1}))
    assert near.step["left_arm"] == pytest.approx(0.3 * far.step["left_arm"])
    assert near.step["right_arm"] == far.step["right_arm"]


def test_a_part_of_a_cycle_goes_and_turns_by_that_part():
    a = module._Frame(np.array([1.0, 2.0]), 0.2)
    b = module._Frame(np.array([2.0, 0.0]), -0.2)
    part = module._share(a, b, 0.25)
    np.testing.assert_allclose([*part.xy, part.yaw], [1.25, 1.5, 0.1])


def test_on_stairs_knees_leave_their_thighs_room_before_a_riser(robot):
    task = module._task(
        IK(build_world(robot, stairs(3, 0.1, 0.4))), POLICY, PlanOptions()
    )
    (platform,) = task.platforms
    assert module._rises(task, platform)

    def placed(surface, x, boxes=platform.boxes):
        wanted = np.array([x, 0.1])
        return module._place(task, platform, surface, wanted, boxes)

    thigh = task.build.thigh
    riser = 0.63
    knee, elbow = placed("LKnee", riser - 0.07), placed("LElbow", riser - 0.07)
    assert (knee.support, elbow.support) == ("s1", "s1")
    assert knee.position[0] <= riser - module.BEFORE_RISER * thigh
    assert elbow.position[0] > knee.position[0]
    assert knee.position[2] == pytest.approx(0.1)
    # What has climbed a riser is not put down before it again.
    above = placed("LKnee", riser - 0.07, platform.boxes[1:])
    assert above.support == "s2"
    assert riser < above.position[0] < riser + 0.05


def test_boxes_of_one_height_are_no_stairs(robot, task):
    assert not module._rises(task, task.platforms[0])
    flat = replace(stairs(2, 0.1, 0.4).boxes[0], size=np.array([0.4, 0.8, 0.205]))
    level = Scene(
        boxes=(
            replace(flat, position=np.array([0.43, 0.0, 0.1025])),
            stairs(2, 0.1, 0.4).boxes[1],
        ),
        start=np.zeros(3),
        goal=np.array([1.0, 0.0]),
    )
    same = module._task(IK(build_world(robot, level)), POLICY, PlanOptions())
    assert len(same.platforms[0].boxes) == 2
    assert not module._rises(same, same.platforms[0])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("steps", "rise", "tread"),
    [(3, 0.1, 0.4), (2, 0.15, 0.4), (3, 0.1, 0.3), (6, 0.15, 0.25), (2, 0.08, 0.25)],
)
def test_stairs_are_climbed_until_all_weight_is_on_the_last(robot, steps, rise, tread):
    plan = plan_traverse(POLICY, robot, stairs(steps, rise, tread))
    assert plan.complete, plan.skipped
    assert {c.support for c in plan.keyframes[-1].stance} == {f"s{steps}"}
    used = {c.support for k in plan.keyframes for c in k.stance}
    assert used == {GROUND, *(f"s{i + 1}" for i in range(steps))}
    assert_contacts_are_kept(plan)


def test_an_obstacle_beyond_reach_says_how_far_to_walk(robot):
    with pytest.raises(InputError, match=r"must first walk 0\.77 m"):
        plan_traverse(POLICY, robot, scene(face=1.0))


def test_a_box_too_high_a_goal_on_it_and_a_policy_without_a_way_are_refused(robot):
    high = scene(height=2.0)
    with pytest.raises(InputError, match=r"boxes\.table is '2\.00 m high'"):
        plan_traverse(POLICY, robot, high)
    with pytest.raises(InputError, match=r"boxes\.table is '2\.00 m high'"):
        plan_traverse(POLICY, robot, scene(height=2.0, goal=[0.5, 0.0]))
    flat = replace(POLICY, options=POLICY.options[-1:])
    with pytest.raises(InputError, match="cycle on the obstacle"):
        plan_traverse(flat, robot, scene())


def row(gap: float, *lengths: float) -> Scene:
    """Boxes one behind the other, the first 0.23 m ahead."""
    boxes, x = [], 0.23
    for i, length in enumerate(lengths):
        boxes.append(
            Box(
                name=f"b{i + 1}",
                size=np.array([length, 0.8, 0.25]),
                position=np.array([x + length / 2, 0.0, 0.125]),
                rotation=np.eye(3),
            )
        )
        x += length + gap
    goal = np.array([x - gap + 0.5, 0.0])
    return Scene(boxes=tuple(boxes), start=np.zeros(3), goal=goal)


@pytest.fixture(scope="module")
def gap_task(robot):
    """From x = 0.83 to 1.13: contacts are made up to 0.81 and from 1.15 on."""
    ik = IK(build_world(robot, row(0.3, 0.6, 0.7)))
    return module._task(ik, POLICY, PlanOptions())


def due(task, arms: float, legs: float, *, outer=False):
    """What is due where elbows (or hands) and knees are at these x."""
    names = {"left_arm": "LElbow", "right_arm": "RElbow"}
    names |= {"left_leg": "LKnee", "right_leg": "RKnee"}
    on = {}
    for n, surface in names.items():
        x = arms if n.endswith("arm") else legs
        support = "b1" if x < 1.0 else "b2"
        on[n] = contact(surface, x, task.build.fours[n][1], support)
    frame = module._fours_frame(task, tuple(on.values()))
    wanted = module._Frame(np.array([1.6, 0.0]), 0.0)
    (platform,) = task.platforms
    found = module._due_near_gap(task, platform, on, names, frame, wanted)
    return tuple({n: float(p.position[0]) for n, p in x.items()} for x in found)


ARMS, LEGS = {"left_arm", "right_arm"}, {"left_leg", "right_leg"}


def test_far_from_a_gap_and_beyond_it_nothing_is_due_there(gap_task):
    assert due(gap_task, 0.55, 0.35) == ({}, {})
    assert due(gap_task, 1.40, 1.17) == ({}, {})


def test_arms_wait_at_a_gap_until_the_legs_are_near_enough(gap_task):
    stretched = 2.0 * gap_task.build.stretch
    walks, hops = due(gap_task, 0.80, 0.40)
    assert set(walks) == LEGS  # elbows are at the border already
    assert not hops
    assert max(walks.values()) <= 0.40 + gap_task.build.step["left_leg"] + module.SAME
    walks, hops = due(gap_task, 0.80, 0.98 - stretched + 0.01)
    assert set(hops) == ARMS
    for x in hops.values():
        assert 1.15 <= x <= 1.17
    # Knees any nearer to the elbows could not let go of them.
    for x in walks.values():
        assert x <= 0.98 - stretched + 2.0 * module.SAME


def test_legs_step_across_together_once_the_arms_are_far_enough(gap_task):
    stretched = 2.0 * gap_task.build.stretch
    walks, hops = due(gap_task, 1.20, 0.80)
    assert set(walks) == ARMS
    assert not hops
    walks, hops = due(gap_task, 0.98 + stretched, 0.80)
    assert set(hops) == LEGS
    assert all(1.15 <= x <= 1.17 for x in hops.values())


def test_a_gap_is_ahead_until_the_last_contact_is_over_it(gap_task):
    (platform,) = gap_task.platforms
    to = np.array([1.6, 0.0])

    def ahead(*x: float):
        stance = [contact(s, v, 0.0) for s, v in zip(FOURS, x, strict=True)]
        return module._gaps_ahead(platform, stance, to)

    ((near, far),) = ahead(0.7, 0.7, 0.5, 0.45)
    assert (near, far) == pytest.approx((0.38, 0.68))
    assert len(ahead(1.4, 1.4, 1.2, 0.8)) == 1
    assert ahead(1.4, 1.4, 1.2, 1.15) == []


def test_contacts_that_come_back_to_where_they_were_end_the_plan(task, monkeypatch):
    """To and fro, without getting nearer: it would go on so for ever."""
    places = {"ahead": 0.7, "back": 0.6}
    keys = {
        n: SimpleNamespace(stance=(contact("LKnee", x, 0.1), contact("RKnee", x, -0.1)))
        for n, x in places.items()
    }

    def manoeuvre(task, key):
        other = keys["back" if key is keys["ahead"] else "ahead"]
        return [(SimpleNamespace(keyframe=other), "ac3")], ""

    monkeypatch.setattr(module, "_manoeuvre", manoeuvre)
    found = module._follow((task,), keys["back"], 100, lambda *a: None)
    assert not found.route.arrived
    assert "to and fro" in str(found.route.failures[0])
    assert len(found.route.changes) == 3  # ahead, back, and ahead again
    same = module._same
    a, b = keys["back"].stance, keys["ahead"].stance
    assert same(a, a[::-1])
    assert not same(a, b)
    assert not same(a, a[:1])


@pytest.mark.slow
@pytest.mark.parametrize("gap", [0.1, 0.3])
def test_a_gap_between_boxes_is_crossed_on_top(robot, gap):
    scene = row(gap, 0.6, 0.6)
    plan = plan_traverse(POLICY, robot, scene)
    assert plan.complete, plan.skipped
    assert all(c.support == GROUND for c in plan.keyframes[-1].stance)
    assert plan.keyframes[-1].q[0] > 1.43 + gap
    tops = {b.name: b.top for b in scene.boxes}
    supports = [{c.support for c in k.stance} for k in plan.keyframes]
    up, down = supports.index({"b1"}), supports.index({"b2"})
    assert up < down
    assert not any(GROUND in s for s in supports[up:down])
    for c in (c for k in plan.keyframes[up:down] for c in k.stance):
        assert tops[c.support].inside(c.position, 0.01)
    assert_contacts_are_kept(plan)


@pytest.mark.slow
def test_on_bare_ground_it_steps_to_the_goal_and_stands(robot):
    bare = Scene(start=np.zeros(3), goal=np.array([0.3, 0.1, 0.5]))
    plan = plan_traverse(POLICY, robot, bare)
    assert plan.complete
    last = plan.keyframes[-1]
    assert {c.surface for c in last.stance} == {"LFoot", "RFoot"}
    assert np.linalg.norm(last.q[:2] - [0.3, 0.1]) < 0.1
    assert {i.option for i in plan.iterations} == {"ac4"}


@pytest.mark.slow
def test_changes_are_bounded_and_the_plan_says_so(robot):
    plan = plan_traverse(POLICY, robot, scene(), options=PlanOptions(max_changes=3))
    assert not plan.complete
    assert "3 contact changes were not enough" in plan.skipped[-1].reason


@pytest.mark.slow
def test_a_box_is_crossed_and_the_robot_stands_beyond_it(crossing):
    assert crossing.complete
    start, last = crossing.keyframes[0], crossing.keyframes[-1]
    assert all(c.support == GROUND for c in last.stance)
    assert {c.surface for c in last.stance} == {"LFoot", "RFoot"}
    assert last.q[0] > 0.83
    assert last.q[2] > 0.8 * start.q[2]
    on_top = [all(c.support == "table" for c in k.stance) for k in crossing.keyframes]
    assert any(on_top)


@pytest.mark.slow
def test_every_posture_of_a_crossing_keeps_its_contacts(crossing):
    kin = Kinematics(crossing.world)
    for before, path, after in zip(
        crossing.keyframes, crossing.changes, crossing.keyframes[1:], strict=False
    ):
        np.testing.assert_array_equal(path.phases[0].q[0], before.q)
        np.testing.assert_array_equal(path.phases[-1].q[-1], after.q)
        for phase in path.phases:
            for q in phase.q:
                kin.update(q)
                assert max(contact_drift(kin, c) for c in phase.contacts) < 0.005


@pytest.mark.slow
def test_cycles_follow_one_another_as_in_the_policy_and_the_cost_falls(crossing):
    assert len(crossing.iterations) == len(crossing.changes)
    names = [i.option for i in crossing.iterations]
    runs = [n for k, n in enumerate(names) if k == 0 or names[k - 1] != n]
    assert runs[:3] == ["ac1", "ac2", "ac3"]
    assert "ac1" in runs[3:]
    costs = [i.cost for i in crossing.iterations]
    assert costs[-1] < 0.1 < costs[0]


@pytest.mark.slow
def test_a_policy_goes_on_from_any_stance_on_the_way(crossing):
    middle = next(
        k
        for k in crossing.keyframes
        if all(c.support == "table" for c in k.stance) and len(k.stance) == 4
    )
    found = follow_policy(IK(crossing.world), POLICY, middle, PlanOptions(), changes=4)
    assert not found.route.failures
    assert not found.route.arrived
    assert len(found.route.changes) >= 4
    assert found.route.start is middle


@pytest.mark.slow
def test_a_plan_with_its_policy_survives_disk(crossing, tmp_path):
    save_plan(crossing, tmp_path)
    again = load_plan(tmp_path)
    assert again.policy is not None
    assert again.policy.options == POLICY.options
    assert again.iterations == crossing.iterations


def test_cycles_without_getting_nearer_are_given_up(robot, monkeypatch):
    world = build_world(robot, scene())
    ik = IK(world)
    key = standing(ik, PlanOptions().keyframe)

    def back(task, key):
        """Two centimetres farther away from the goal with every cycle."""
        away = np.array([-0.02, 0.0, 0.0])
        stance = tuple(replace(c, position=c.position + away) for c in key.stance)
        change = SimpleNamespace(keyframe=SimpleNamespace(stance=stance))
        return [(change, "ac3")], ""

    monkeypatch.setattr(module, "_manoeuvre", back)
    found = follow_policy(ik, POLICY, key, PlanOptions(), changes=1000)
    assert "no nearer to the goal" in str(found.route.failures[0])
    assert not found.route.arrived
    assert len(found.route.changes) == module.PATIENCE + 1


def test_a_secondary_policy_is_followed_where_the_first_has_no_stable_step(
    robot, monkeypatch
):
    lost = GeneralPolicy(
        options=(POLICY.options[-1],),
        over_top=POLICY.over_top,
        near_edge=POLICY.near_edge,
        goal=POLICY.goal,
    )
    other = replace(POLICY, reach={"LKnee": 0.1})
    policy = replace(POLICY, secondary=(lost, other))
    ik = IK(build_world(robot, scene()))
    key = standing(ik, PlanOptions().keyframe)
    asked = []

    def manoeuvre(task, key):
        asked.append(task.policy)
        stance = (contact("LKnee", 0.1 * len(asked), 0.0),)
        on = SimpleNamespace(keyframe=SimpleNamespace(stance=stance))
        if task.policy is policy:
            return ([(on, "ac3")], "") if len(asked) == 1 else ([], "stuck")
        return ([(on, "ac1")], "") if len(asked) < 5 else ([], "stuck too")

    monkeypatch.setattr(module, "_manoeuvre", manoeuvre)
    found = follow_policy(ik, policy, key, PlanOptions(), changes=9)
    # The first is asked first again after each; what cannot crawl is not asked at all.
    assert asked == [policy, policy, other, policy, other]
    names = [i.option for i in found.iterations]
    assert names == ["ac3", "ac1, secondary 1"]
    assert found.instead == "secondary 1 from change 2 on (stuck)"
    assert str(found.route.failures[0]) == "stuck"
    assert not found.route.arrived


@pytest.mark.slow
@pytest.mark.parametrize("lost", ["LKnee", "RElbow"])
def test_a_limb_that_lost_its_contact_is_set_down_first(crossing, lost):
    ik = IK(crossing.world)
    middle = next(
        k
        for k in crossing.keyframes
        if all(c.support == "table" for c in k.stance) and len(k.stance) == 4
    )
    held = tuple(c for c in middle.stance if c.surface != lost)
    task = KeyframeTask(held=held, new=(), q_reference=middle.q)
    key = direct.optimise(ik, task, middle.q, PlanOptions().keyframe)
    found = follow_policy(ik, POLICY, key, PlanOptions(), changes=2)
    assert not found.route.failures
    move = found.route.changes[0].step
    assert move.makes.surface == lost
    assert move.breaks == ()
    assert len(found.route.end.stance) == 4


@pytest.mark.slow
def test_a_foot_that_lost_the_ground_is_set_down(robot):
    bare = Scene(start=np.zeros(3), goal=np.array([0.3, 0.0]))
    ik = IK(build_world(robot, bare))
    both = standing(ik, PlanOptions().keyframe)
    left = tuple(c for c in both.stance if c.surface == "LFoot")
    task = KeyframeTask(held=left, new=(), q_reference=both.q)
    key = direct.optimise(ik, task, both.q, PlanOptions().keyframe)
    found = follow_policy(ik, POLICY, key, PlanOptions(), changes=2)
    assert not found.route.failures
    assert {c.surface for c in found.route.end.stance} == {"LFoot", "RFoot"}


def test_it_turns_only_where_walls_leave_it_room(robot):
    """A box of 2.4 m with a passage of 0.8 x 0.7 m in its middle, from x = 1.05 on."""
    height, walls = 0.25, []
    for name, y in (("left", 0.40), ("right", -0.40)):
        wall = Box(
            name=name,
            size=np.array([0.8, 0.1, 0.5]),
            position=np.array([1.45, y, height + 0.25]),
            rotation=np.eye(3),
        )
        walls.append(wall)
    open_ = scene(length=2.4, width=1.2, face=0.25, height=height)
    walled = replace(open_, boxes=(*open_.boxes, *walls), goal=np.array([3.0, 0.0]))
    task = module._task(IK(build_world(robot, walled)), POLICY, PlanOptions())
    (platform,) = task.platforms

    def heading(x, to, yaw=0.0):
        here = module._Frame(np.array([x, 0.0]), yaw)
        wanted = module._Frame(np.array([to, 0.0]), math.pi)
        return module._heading(task, platform, here, wanted)

    assert heading(0.5, 2.4).yaw == math.pi  # there is room at either end
    between = heading(1.4, 2.4)
    assert (between.yaw, between.xy[0]) == (0.0, 2.4)  # on, as it is
    on_the_spot = heading(0.5, 1.7)
    assert (on_the_spot.yaw, on_the_spot.xy[0]) == (math.pi, 0.5)
    assert heading(1.4, 2.4, math.pi - 0.05).yaw == math.pi  # it faces there already
