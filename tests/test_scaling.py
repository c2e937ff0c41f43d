"""A person's contacts in the robot's scene: edges, limbs' scales, invariance."""

from dataclasses import replace

import numpy as np
import pytest

from clamber.contact.contact import Contact, ContactSequence, Stance
from clamber.contact.scaling import limb_scales, retarget
from clamber.errors import InputError
from clamber.model.kinematics import Kinematics, limb_lengths
from clamber.model.robot import load_robot
from clamber.model.scene import GROUND, Box, Scene
from clamber.model.se3 import matrix_from_quat, matrix_from_rpy, quat_from_matrix
from clamber.model.world import World, build_world

UP = np.array([0.0, 0.0, 1.0])
PERSON = {"upper_arm": 0.30, "forearm": 0.26, "thigh": 0.42, "shank": 0.40}


@pytest.fixture(scope="module")
def world() -> World:
    return build_world(load_robot("coman"), Scene.from_height(0.275))


@pytest.fixture(scope="module")
def kin(world) -> Kinematics:
    k = Kinematics(world)
    k.update(world.home)
    return k


def box(yaw=0.0, size=(1.0, 1.2, 0.5), at=(0.9, 0.0), name="table", rp=(0.0, 0.0)):
    return Box(
        name=name,
        size=np.array(size),
        centre=np.array([*at, size[2] / 2]),
        rotation=matrix_from_rpy([*rp, yaw]),
    )


def scene_of(*boxes: Box, start=(0.0, 0.0, 0.0)) -> Scene:
    return Scene(boxes=boxes, start=np.array(start))


def contact(surface: str, support: str, x: float, y: float, z=0.0, yaw=0.0) -> Contact:
    return Contact(
        surface=surface,
        support=support,
        position=np.array([x, y, z]),
        quaternion=quat_from_matrix(matrix_from_rpy([0.0, 0.0, yaw])),
    )


def sequence(scene: Scene, *stances: Stance, subject=PERSON) -> ContactSequence:
    return ContactSequence(
        source="test",
        subject=subject,
        scene=scene,
        stances=stances,
        t=np.arange(len(stances) + 1.0),
    )


def climb(scene: Scene | None = None, subject=PERSON) -> ContactSequence:
    """Feet on the ground, hands behind the edge at x = 0.4, a knee, a foot moved."""
    feet = contact("LFoot", GROUND, 0.0, 0.15), contact("RFoot", GROUND, 0.0, -0.15)
    left, right = (
        contact("LHand", "table", 0.6, 0.25, 0.5),
        contact("RHand", "table", 0.65, -0.2, 0.5, yaw=0.3),
    )
    knee = contact("LKnee", "table", 0.5, 0.15, 0.5)
    trunk = {"trunk": np.array([0.6, 0.0, 0.8])}
    return sequence(
        scene or scene_of(box()),
        Stance(contacts=feet),
        Stance(contacts=(*feet, left, right), posture=trunk),
        Stance(contacts=(left, right, knee, contact("RFoot", GROUND, 0.2, -0.1))),
        subject=subject,
    )


# Scales.


def test_a_limb_is_scaled_by_its_length(kin):
    robot = limb_lengths(kin)
    scales = limb_scales(PERSON, kin)
    assert scales["arm"] == pytest.approx(
        (robot["upper_arm"] + robot["forearm"]) / 0.56
    )
    assert scales["leg"] == pytest.approx((robot["thigh"] + robot["shank"]) / 0.82)
    assert limb_scales(robot, kin) == pytest.approx({"arm": 1.0, "leg": 1.0})
    assert limb_scales(None, kin) == {"arm": 1.0, "leg": 1.0}


def test_depth_and_side_are_scaled_height_is_that_of_the_robots_box(world, kin):
    robot = retarget(climb(), Kinematics(world))
    scales = limb_scales(PERSON, kin)
    for surface, i, depth, side in (
        ("LHand", 1, 0.2, 0.25),
        ("RHand", 1, 0.25, -0.2),
        ("LKnee", 2, 0.1, 0.15),
    ):
        c = robot.stances[i].contact(surface)
        assert c is not None
        k = scales["leg" if surface == "LKnee" else "arm"]
        expected = [0.23 + k * depth, k * side, 0.275]
        np.testing.assert_allclose(c.position, expected, atol=1e-9)
        assert c.support == "box"


def test_feet_start_where_the_robot_stands_and_move_by_scaled_offsets(world, kin):
    robot = retarget(climb(), Kinematics(world))
    leg = limb_scales(PERSON, kin)["leg"]
    for foot in ("LFoot", "RFoot"):
        c = robot.stances[0].contact(foot)
        assert c is not None
        home = kin.contact_point(foot, UP)
        np.testing.assert_allclose(c.position, [*home[:2], 0.0], atol=1e-12)
    first, later = (robot.stances[i].contact("RFoot") for i in (0, 2))
    assert first is not None
    assert later is not None
    np.testing.assert_allclose(
        later.position - first.position, [leg * 0.2, leg * 0.05, 0.0], atol=1e-12
    )


def test_a_plan_of_the_robot_itself_keeps_its_figures(world, kin):
    """Already in the robot's scene and at its scale, nothing moves."""
    feet = tuple(
        Contact(
            surface=f,
            support=GROUND,
            position=kin.contact_point(f, UP) * [1, 1, 0],
            quaternion=np.array([1.0, 0, 0, 0]),
        )
        for f in ("LFoot", "RFoot")
    )
    hand = contact("LHand", "box", 0.4, 0.15, 0.275, yaw=0.2)
    start = np.mean([f.position[:2] for f in feet], axis=0)
    scene = replace(world.scene, start=np.array([*start, 0.0]))
    own = sequence(
        scene, Stance(contacts=feet), Stance(contacts=(*feet, hand)), subject=None
    )
    again = retarget(own, Kinematics(world))
    for a, b in zip(own.stances, again.stances, strict=True):
        for c, d in zip(a.contacts, b.contacts, strict=True):
            np.testing.assert_allclose(d.position, c.position, atol=1e-9)
            np.testing.assert_allclose(d.quaternion, c.quaternion, atol=1e-9)


# Invariance.


@pytest.mark.parametrize("seed", range(6))
def test_where_the_recording_lay_and_looked_does_not_matter(world, seed):
    """Scene and contacts turned and shifted together give the same robot contacts."""
    rng = np.random.default_rng(seed)
    yaw, shift = rng.uniform(-3.1, 3.1), np.array([*rng.uniform(-5, 5, 2), 0.0])
    R = matrix_from_rpy([0.0, 0.0, yaw])
    there = climb()
    b = there.scene.boxes[0]
    moved = replace(b, centre=R @ b.centre + shift, rotation=R @ b.rotation)
    start = R @ np.array([*there.scene.start[:2], 0.0]) + shift
    stances = tuple(
        Stance(
            contacts=tuple(
                replace(
                    c,
                    position=R @ c.position + shift,
                    quaternion=quat_from_matrix(R @ matrix_from_quat(c.quaternion)),
                )
                for c in s.contacts
            ),
            posture={n: R @ u for n, u in s.posture.items()},
        )
        for s in there.stances
    )
    turned = sequence(scene_of(moved, start=(*start[:2], yaw)), *stances)
    for a, b in zip(
        retarget(there, Kinematics(world)).stances,
        retarget(turned, Kinematics(world)).stances,
        strict=True,
    ):
        assert a.surfaces == b.surfaces
        for c, d in zip(a.contacts, b.contacts, strict=True):
            assert c.support == d.support
            np.testing.assert_allclose(d.position, c.position, atol=1e-9)
            np.testing.assert_allclose(
                matrix_from_quat(d.quaternion),
                matrix_from_quat(c.quaternion),
                atol=1e-9,
            )
        for n, u in a.posture.items():
            np.testing.assert_allclose(b.posture[n], u, atol=1e-9)


@pytest.mark.parametrize("yaw", [0.7, -2.0])
def test_the_robots_contacts_turn_with_its_scene(yaw):
    """The same demonstration in a turned robot scene is the same climb, turned."""
    R, at = matrix_from_rpy([0.0, 0.0, yaw]), np.array([1.0, -2.0, 0.0])
    obstacle = box(0.0, (1.0, 1.2, 0.3), (0.73, 0.0), "crate")
    moved = replace(
        obstacle, centre=R @ obstacle.centre + at, rotation=R @ obstacle.rotation
    )
    robot = load_robot("coman")
    plain = retarget(climb(), Kinematics(build_world(robot, scene_of(obstacle))))
    turned = retarget(
        climb(),
        Kinematics(build_world(robot, scene_of(moved, start=(1.0, -2.0, yaw)))),
    )
    for a, b in zip(plain.stances, turned.stances, strict=True):
        for c, d in zip(a.contacts, b.contacts, strict=True):
            np.testing.assert_allclose(d.position, R @ c.position + at, atol=1e-8)
            R_c, R_d = matrix_from_quat(c.quaternion), matrix_from_quat(d.quaternion)
            np.testing.assert_allclose(R_d, R @ R_c, atol=1e-9)
        for n, u in a.posture.items():
            np.testing.assert_allclose(b.posture[n], R @ u, atol=1e-9)


@pytest.mark.parametrize("rp", [(0.0, 0.0), (0.15, -0.1)])
def test_contacts_lie_on_the_robots_support_however_it_is_tilted(rp):
    tilted = box(0.3, (1.0, 1.2, 0.3), (0.8, 0.0), "crate", rp)
    w = build_world(load_robot("coman"), scene_of(tilted))
    for s in retarget(climb(), Kinematics(w)).stances:
        for c in s.contacts:
            height = w.supports[c.support].height(c.position)
            assert height == pytest.approx(0.0, abs=1e-9)


# What does not fit.


def test_more_boxes_than_the_robots_scene_has_are_an_input_error(world):
    second = box(at=(2.5, 0.0), name="shelf")
    demo = climb(scene_of(box(), second))
    last = Stance(contacts=(contact("LHand", "shelf", 2.2, 0.1, 0.5),))
    demo = sequence(demo.scene, *demo.stances, last)
    with pytest.raises(InputError, match=r"scene\.boxes is \['box'\].*touches \(2\)"):
        retarget(demo, Kinematics(world))


def test_boxes_are_matched_in_the_order_in_which_they_are_touched():
    unused = box(at=(-2.0, 0.0), name="unused")
    second = box(at=(2.5, 0.0), name="shelf")
    demo = climb(scene_of(unused, second, box()))
    last = Stance(contacts=(contact("LHand", "shelf", 2.2, 0.1, 0.5),))
    demo = sequence(demo.scene, *demo.stances, last)
    a, b = box(size=(0.8, 1.0, 0.2), name="a"), box(at=(2.5, 0.0), name="b")
    w = build_world(load_robot("coman"), scene_of(a, b))
    supports = [
        c.support for s in retarget(demo, Kinematics(w)).stances for c in s.contacts
    ]
    assert set(supports[:-1]) == {GROUND, "a"}
    assert supports[-1] == "b"


def test_surfaces_that_the_robot_lacks_are_left_out(world):
    seat = contact("Seat", "table", 0.7, 0.0, 0.5)
    demo = climb()
    with_seat = sequence(
        demo.scene, *demo.stances, Stance(contacts=(seat, *demo.stances[1].contacts))
    )
    robot = retarget(with_seat, Kinematics(world))
    assert robot.stances[3].surfaces == robot.stances[1].surfaces
    assert robot.subject is None
    assert robot.scene is world.scene
    np.testing.assert_array_equal(robot.t, with_seat.t)


def test_how_the_person_held_the_pelvis_is_not_carried_over(coman):
    demo = climb()
    pelvis = np.array([0.0, 0.0, 0.9, 1.0, 0.0, 0.0, 0.0])
    posed = replace(
        demo, stances=tuple(replace(s, pelvis=pelvis) for s in demo.stances)
    )
    there = retarget(posed, Kinematics(build_world(coman, Scene.from_height(0.3))))
    assert all(s.pelvis is None for s in there.stances)
