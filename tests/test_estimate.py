"""What is known of the robot, from measurements alone."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from clamber.contact.steps import MOVED
from clamber.execution.estimate import (
    DEVIATION,
    FORCE_SMOOTHING,
    LOST,
    NEAR,
    PRESSED,
    TOUCH,
    YIELDS,
    Estimate,
)
from clamber.execution.probe import REACH
from clamber.execution.sensors import Measurement
from clamber.model.kinematics import Kinematics
from clamber.model.world import PHYSICS_STEP

UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture
def estimate(hands_plan) -> Estimate:
    """At the beginning, nothing measured."""
    return Estimate(hands_plan.world, hands_plan.keyframes[0].q)


def settle(estimate, q=None, **newtons: float | list[float]) -> None:
    """Measure a posture and forces, vertical ones as numbers, until both are known."""
    force = np.zeros_like(estimate.load)
    for surface, f in newtons.items():
        force[estimate.row(surface)] = [0.0, 0.0, f] if np.isscalar(f) else f
    for _ in range(2000):
        estimate.update(Measurement(estimate.q if q is None else q, force))


def placed(estimate, plan, keyframe: int, up=0.0, side=0.0, **newtons):
    """The contact of the left hand in a keyframe, measured where it is moved to."""
    q = plan.keyframes[keyframe].q.copy()
    q[:3] += [0.0, side, up]
    settle(estimate, q, **newtons)
    return next(c for c in plan.keyframes[keyframe].stance if c.surface == "LHand")


def test_forces_and_postures_are_smoothed_with_their_time_constants(estimate):
    q = estimate.q.copy()
    target, force = q.copy(), np.zeros_like(estimate.load)
    target[0] += 0.1
    force[2] = [3.0, -4.0, 100.0]
    n = round(FORCE_SMOOTHING / PHYSICS_STEP)
    for _ in range(n):
        estimate.update(Measurement(target, force))
    share = 1.0 - np.exp(-1.0)
    assert np.allclose(estimate.load[2], share * force[2], rtol=0.02)
    assert not np.delete(estimate.load, 2, axis=0).any()
    assert estimate.q[0] - q[0] == pytest.approx(0.1 * (1 - np.exp(-3.0)), rel=0.02)
    for _ in range(20 * n):
        estimate.update(Measurement(target, force))
    assert np.allclose(estimate.load[2], force[2])
    assert np.allclose(estimate.q, target)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_both_quaternions_of_a_rotation_are_the_same_posture(estimate, sign):
    target = estimate.q.copy()
    target[3:7] = [np.cos(0.1), 0.0, np.sin(0.1), 0.0]
    there = target.copy()
    there[3:7] *= sign
    near = [abs(estimate.q[3:7] @ target[3:7])]
    for _ in range(200):
        estimate.update(Measurement(there, estimate.load))
        near.append(abs(estimate.q[3:7] @ target[3:7]))
    assert np.all(np.diff(near) > -1e-12)  # by the short way
    assert near[-1] == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize(("up", "side"), [(0.02, 0.0), (-0.03, 0.01), (0.0, -0.04)])
def test_how_far_a_contact_deviates(estimate, hands_plan, up, side):
    c = placed(estimate, hands_plan, 1, up, side)
    assert np.allclose(estimate.deviation(c), (up, abs(side)), atol=1e-3)


def test_a_contact_that_has_rolled_is_where_it_was_planned(estimate, hands_plan):
    """The ball turns with its link about a horizontal axis and moves by r theta."""
    c = placed(estimate, hands_plan, 1)
    radius, theta = hands_plan.world.surfaces["LHand"].radius, 0.3
    turn = np.array([np.cos(theta / 2), 0.0, np.sin(theta / 2), 0.0])
    kin, q = Kinematics(hands_plan.world), estimate.q.copy()
    kin.update(q)
    before = kin.contact_point("LHand", UP)
    mujoco.mju_mulQuat(q[3:7], turn, q[3:7].copy())
    kin.update(q)
    q[:3] += before + radius * theta * np.eye(3)[0] - kin.contact_point("LHand", UP)
    assert radius * theta > 5e-3
    settle(estimate, q)
    assert estimate.deviation(c) == pytest.approx((0.0, 0.0), abs=1.5e-3)


@pytest.mark.parametrize(
    ("force", "up", "side", "touches"),
    [
        (1.1 * TOUCH, 0.0, 0.0, True),
        (0.9 * TOUCH, 0.0, 0.0, False),
        ([80.0, 60.0, 0.0], 0.0, 0.0, False),  # along the support
        (50.0, 0.0, 0.9 * NEAR, True),
        (50.0, 0.0, 1.1 * NEAR, False),
        (50.0, -0.95 * REACH, 0.0, True),
        (50.0, REACH + 0.03, 0.0, False),
    ],
)
def test_a_touch_is_a_normal_force_near_the_planned_place(
    estimate, hands_plan, force, up, side, touches
):
    c = placed(estimate, hands_plan, 1, up, side, LHand=force)
    assert estimate.touches(c) == touches


@pytest.mark.parametrize(
    ("force", "up", "side", "there"),
    [
        (1.1 * PRESSED, 0.0, 0.0, True),
        (0.9 * PRESSED, 0.0, 0.0, False),
        (1.1 * PRESSED, -0.9 * DEVIATION, 0.0, True),
        (50.0, -1.2 * DEVIATION, 0.0, False),
        (50.0, 1.2 * DEVIATION, 0.0, False),
        (50.0, 0.0, 1.1 * NEAR, False),
    ],
)
def test_a_contact_in_place_may_be_pressed_lightly(
    estimate, hands_plan, force, up, side, there
):
    c = placed(estimate, hands_plan, 1, up, side, LHand=force)
    assert estimate.is_in_place(c) == there


def test_what_is_probed_for_may_be_met_further_aside(estimate, hands_plan):
    """A limb that rolled on its way down has its contact where it is."""
    c = placed(estimate, hands_plan, 1, 0.0, 1.5 * NEAR, LHand=50.0)
    assert not estimate.touches(c)
    assert estimate.touches(c, REACH)
    c = placed(estimate, hands_plan, 1, 0.0, 1.1 * REACH, LHand=50.0)
    assert not estimate.touches(c, REACH)


def test_another_surface_of_the_limb_may_be_loaded_in_place_of_the_planned_one(
    estimate, demo_plan
):
    """An elbow where a hand was planned; not while the hand is loaded as well."""
    key = demo_plan.keyframes[3]
    elbow = next(c for c in key.stance if c.surface == "LElbow")
    hand = replace(elbow, surface="LHand")
    settle(estimate, key.q, LElbow=1.1 * TOUCH)
    found = estimate.substitute(hand)
    assert found is not None
    assert (found.surface, found.support) == ("LElbow", "box")
    assert np.linalg.norm(found.position - elbow.position) < 2e-3
    assert not estimate.is_lost(hand)
    for newtons in (
        {"LElbow": 1.1 * TOUCH, "LHand": 1.1 * LOST},
        {"LElbow": 0.9 * TOUCH},
        {"RElbow": 100.0},  # another limb's
    ):
        settle(estimate, key.q, **newtons)
        assert estimate.substitute(hand) is None
        assert estimate.is_lost(hand) == ("LHand" not in newtons)
    for move in ([0.0, 0.0, REACH + 0.02], [-0.5, 0.0, 0.0]):  # above it, before it
        q = key.q.copy()
        q[:3] += move
        settle(estimate, q, LElbow=100.0)
        assert estimate.substitute(hand) is None


def test_a_limb_may_be_back_on_another_support(estimate, demo_plan):
    """A foot bears on the ground, however tilted, where its knee was on the box."""
    start, end = demo_plan.keyframes[0], demo_plan.keyframes[-1]
    knee = next(c for c in end.stance if c.surface == "LKnee")
    q = start.q.copy()
    ankle = demo_plan.world.model.joint("LAnkSag").qposadr[0]
    for turned in (0.0, 0.5):
        q[ankle] = start.q[ankle] + turned
        settle(estimate, q, LFoot=1.1 * TOUCH)
        found = estimate.substitute(knee)
        assert found is not None
        assert (found.surface, found.support) == ("LFoot", "ground")
        assert np.allclose(found.position, estimate.point(found))
        assert estimate.substitute(knee, there=True) is None
        assert not estimate.is_lost(knee)
    q[:3] += [0.0, 0.0, REACH + 0.05]
    settle(estimate, q, LFoot=100.0)
    assert estimate.substitute(knee) is None
    assert estimate.is_lost(knee)


def test_a_measured_contact_is_where_the_surface_is(estimate, hands_plan):
    c = placed(estimate, hands_plan, 1, -0.03, 0.01)
    found, kin = estimate.measured(c), Kinematics(hands_plan.world)
    kin.update(estimate.q)
    assert np.allclose(found.position, kin.contact_point("LHand", UP), atol=1e-12)
    assert estimate.deviation(found) == pytest.approx((0.0, 0.0), abs=1e-9)
    assert (found.surface, found.support, found.edge) == ("LHand", "box", None)


@pytest.mark.parametrize("off", [0.003, 0.02])
def test_a_contact_yields_to_its_load_by_millimetres(estimate, hands_plan, off):
    """It is taken where the joints aim, as far as a load explains the difference."""
    c = placed(estimate, hands_plan, 1)
    q = estimate.q.copy()
    q[:3] += [0.0, off, 0.0]
    way = estimate.aimed(c, q).position - estimate.measured(c).position
    assert np.allclose(way, [0.0, min(off, YIELDS), 0.0], atol=1e-9)


def test_a_measured_foot_lies_on_the_ground_as_it_is_turned(estimate, hands_plan):
    """The ground is where it is: what the sensors say of its height is their error."""
    key = hands_plan.keyframes[0]
    foot = next(c for c in key.stance if c.surface == "LFoot")
    q = key.q.copy()
    q[:3] += [0.01, 0.02, 0.004]
    settle(estimate, q)
    found = estimate.measured(foot)
    assert found.position[2] == pytest.approx(0.0, abs=1e-12)
    assert np.allclose(found.position[:2] - foot.position[:2], [0.01, 0.02], atol=1e-4)
    assert abs(found.quaternion @ foot.quaternion) == pytest.approx(1.0, abs=1e-6)
    # On tiptoe it is where its edge is, and need not lie flat there.
    kin = Kinematics(hands_plan.world)
    kin.update(key.q)
    middle = kin.contact_point("LFoot", UP, 0)
    found = estimate.measured(replace(foot, edge=0, position=middle))
    assert found.edge == 0
    assert np.allclose(found.position - middle, [0.01, 0.02, 0.0], atol=1e-4)


def test_measured_places_make_the_scene_and_are_renewed(estimate, hands_plan):
    planned = hands_plan.world.scene
    c = placed(estimate, hands_plan, 1, -0.03)
    feet = [x for x in hands_plan.keyframes[1].stance if x is not c]

    def top() -> float:
        return float(estimate.scene(planned).boxes[0].top.height(c.position))

    assert top() == pytest.approx(0.0, abs=1e-9)
    estimate.remember(feet, 0)  # the ground is known
    assert top() == pytest.approx(0.0, abs=1e-9)
    estimate.remember([c], 0)
    assert top() == pytest.approx(0.03, abs=3e-3)
    # Again near there takes its place; farther off is another place.
    q = estimate.q.copy()
    q[:3] += [0.9 * MOVED.measured, 0.0, 0.03]
    settle(estimate, q)
    estimate.remember([c], 1)
    assert top() == pytest.approx(0.0, abs=1e-3)
    assert estimate.scene(planned).boxes[0].roughness == pytest.approx(0.02)
    q[:3] += [1.1 * MOVED.measured, 0.0, -0.03]
    settle(estimate, q)
    estimate.remember([c], 1)
    assert estimate.scene(planned).boxes[0].roughness > 0.02


def test_the_start_of_the_scene_is_the_one_that_is_believed(estimate, hands_plan):
    start = np.array([0.03, -0.02, 0.1])
    world = hands_plan.world
    estimate.believe(replace(world, scene=replace(world.scene, start=start)))
    assert np.array_equal(estimate.scene(world.scene).start, start)
