"""Robots smaller than the built-in one: what is in proportion to them, what is not."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

import humanoids
from clamber import _core
from clamber.execution.estimate import LOST, PRESSED, TOUCH, Estimate
from clamber.execution.sensors import FORCE_NOISE, FORCE_STRIDE, Sensors
from clamber.model.boxes import Box
from clamber.model.propose import propose_robot
from clamber.model.robot import FULL_LEG, Robot, load_robot
from clamber.model.scene import GROUND, Scene
from clamber.model.world import FULL_MASS, World, build_world
from clamber.planning.diagnose import check_robot
from clamber.planning.planner import plan
from clamber.run.proposal import save_proposal
from clamber.step.change import standing
from clamber.step.ik import FURTHER_CLEARANCE, IK
from clamber.step.posture import (
    CLEARANCE,
    KeyframeOptions,
    KeyframeTask,
    keyframe_problem,
)
from clamber.step.transition import MARGINS, balance_problem, margins_of

LEG = humanoids.THIGH + humanoids.SHANK


def humanoid(folder, text: str) -> Robot:
    path = folder / "small.xml"
    path.write_text(text)
    save_proposal(propose_robot(path), folder / "robot")
    return load_robot(folder / "robot" / "robot.yaml")


def beside_a_box(robot: Robot, scale: float) -> tuple[Scene, float]:
    """The box of `Scene.from_height` at a scale, 0.95 of the knees high."""
    height = round(0.95 * check_robot(robot).knee_height, 3)
    box = Box(
        name="box",
        size=np.array([scale, 1.2 * scale, height]),
        centre=np.array([0.73 * scale, 0.0, height / 2]),
        rotation=np.eye(3),
    )
    return Scene(boxes=(box,), start=np.zeros(3)), height


@pytest.fixture(scope="module")
def half(tmp_path_factory) -> Robot:
    return humanoid(tmp_path_factory.mktemp("half"), humanoids.mjcf(0.5))


@pytest.fixture(scope="module")
def world(half) -> World:
    return build_world(half, beside_a_box(half, 0.5)[0])


@pytest.fixture(scope="module")
def full() -> World:
    return build_world("coman", 0.2)


def test_clearances_and_margins_are_in_proportion_to_legs(world, full):
    share = 0.5 * LEG / FULL_LEG
    assert world.length_scale == pytest.approx(share, rel=1e-6)
    assert full.length_scale == 1.0
    for w, s in ((world, share), (full, 1.0)):
        stance = standing(IK(w), KeyframeOptions()).stance
        task = KeyframeTask(held=stance, new=(), q_reference=w.home)
        a = keyframe_problem(w, task, KeyframeOptions(), ())
        b = balance_problem(w, held=stance, q_reference=w.home)
        for clearance in (a.clearance, b.clearance):
            finite = clearance[np.isfinite(clearance)]
            assert finite.max() == pytest.approx(CLEARANCE * s)
        assert a.balance_margin == pytest.approx(0.025 * s)
        assert b.balance_margin == pytest.approx(MARGINS[-1] * s)
        assert margins_of(w) == pytest.approx([m * s for m in MARGINS])
        knee = replace(stance[0], surface="LKnee", support=GROUND)
        c = balance_problem(w, held=(knee,), q_reference=w.home).clearance
        further = w.touching["LKnee", GROUND][1]
        assert c[further] == pytest.approx(FURTHER_CLEARANCE * s)


def test_an_arc_is_lower_over_an_obstacle():
    ends = np.zeros(3), np.array([0.1, 0.0, 0.4])
    whole, half = (
        _core.arc(*ends, 0.4, False, 4001, scale)[:, 2].max() - 0.4
        for scale in (1.0, 0.5)
    )
    assert half == pytest.approx(0.5 * whole, abs=1e-5)


def test_a_small_robot_climbs_a_box_that_is_small_for_it_as_well(half, demo_sequence):
    scene, _ = beside_a_box(half, 0.5)
    made = plan(demo_sequence, half, scene)
    assert made.complete, [str(f) for f in made.failures]


def test_a_light_robot_tells_lighter_forces_apart(world, full):
    for w, share in ((world, world.mass / FULL_MASS), (full, 1.0)):
        assert w.force_scale == pytest.approx(share)
        e = Estimate(w, w.home)
        told = [e.touch, e.pressed, e.lost]
        assert told == pytest.approx([share * x for x in (TOUCH, PRESSED, LOST)])
    assert world.mass < 0.3 * FULL_MASS


def test_sensors_of_a_light_robot_measure_lighter_forces(world, rng):
    import mujoco

    sensors = Sensors(world, noise=1.0, delay=0.0, rng=rng)
    data = mujoco.MjData(world.model)
    data.qpos[:3] = [0.0, 0.0, 2.0]  # nothing touches
    mujoco.mj_forward(world.model, data)
    read = [sensors.read(data).force.copy() for _ in range(400 * FORCE_STRIDE)]
    rms = np.std(read[::FORCE_STRIDE])
    assert rms == pytest.approx(FORCE_NOISE * world.force_scale, rel=0.1)


def test_balls_stand_out_of_links_in_proportion(tmp_path):
    """Knee balls: 0.042 s about the shank, and what they stand out by."""
    radius = {}
    for scale in (1.0, 0.5):
        (tmp_path / str(scale)).mkdir()
        robot = humanoid(tmp_path / str(scale), humanoids.mjcf(scale))
        radius[scale] = build_world(robot, 0.1).surfaces["LKnee"].radius
    share = 0.5 * LEG / FULL_LEG
    bare = radius[1.0] - 0.006
    assert radius[0.5] == pytest.approx(0.5 * bare + 0.006 * share, abs=1e-4)


def test_a_base_whose_frame_is_on_the_floor_has_it_between_the_hips(tmp_path):
    text = humanoids.mjcf()
    low = humanoids.THIGH + humanoids.SHANK + humanoids.ANKLE
    moved = text.replace(f'<body name="b0" pos="0 0 {low}">', '<body name="b0">')
    assert moved != text

    def raised(match: re.Match) -> str:
        x, y, z = (float(v) for v in match[2].split())
        return f'{match[1]}pos="{x} {y} {z + low}"'

    # What hangs on the pelvis, and its own shape, are as much higher in its frame.
    for body in ("b1", "t1", "u1"):
        moved = re.sub(rf'(<body name="{body}" )pos="([^"]*)"', raised, moved)
    ends = 'fromto="-0.05 0.0 0.03 0.05 0.0 0.03"'
    assert moved.count(ends) == 1
    moved = moved.replace(ends, f'fromto="-0.05 0 {0.03 + low} 0.05 0 {0.03 + low}"')
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    was, now = humanoid(tmp_path / "a", text), humanoid(tmp_path / "b", moved)
    path = tmp_path / "b" / "small.xml"
    assert any("frame under the knees" in n for n in propose_robot(path).notes)
    before, after = (build_world(r, 0.2) for r in (was, now))
    np.testing.assert_allclose(after.home[:3], before.home[:3], atol=1e-3)
    np.testing.assert_allclose(after.home[7:], before.home[7:], atol=1e-3)
    a, b = before.model, after.model
    assert b.body_mass[after.base] == pytest.approx(a.body_mass[before.base])
    np.testing.assert_allclose(
        b.body_ipos[after.base], a.body_ipos[before.base], atol=1e-4
    )


@pytest.mark.parametrize(("armature", "quicker"), [(0.0, 1.0), (0.05, 1.72)])
def test_a_motor_that_is_heavy_for_its_robot_is_as_quick_as_the_built_in_ones(
    tmp_path, armature, quicker
):
    """kp over inertia is no less than 600 / (0.05 + 0.5)."""
    text = humanoids.mjcf(0.5)
    if armature:
        text = text.replace('<joint name="', f'<joint armature="{armature}" name="')
    (tmp_path / "small.xml").write_text(text)
    fields = propose_robot(tmp_path / "small.xml").fields
    plain = fields["gains"]["default"]["kp"]
    kp = fields["gains"].get("td", fields["gains"]["default"])["kp"]
    assert kp / plain == pytest.approx(quicker, rel=0.1)
    soft = fields["impedance"]["td"]["kp"]
    assert soft / kp == pytest.approx(0.31, rel=0.05)


def test_arms_with_hinges_anywhere_on_their_axes_are_mirror_images(tmp_path):
    """Elbows turn about x; the left one is described 3 cm along it."""
    text = humanoids.mjcf()
    elbow = '<joint name="vd" axis="1 0 0"'
    assert text.count(elbow) == 1
    text = text.replace(elbow, '<joint name="vd" pos="0.03 0 0" axis="1 0 0"')
    (tmp_path / "small.xml").write_text(text)
    home = propose_robot(tmp_path / "small.xml").fields["home"]
    for joint, sign in zip("abcd", (1, -1, -1, 1), strict=True):
        left, right = home.get(f"v{joint}", 0.0), home.get(f"w{joint}", 0.0)
        assert left == pytest.approx(sign * right, abs=1e-3)
        assert joint == "c" or abs(left) > 0.05
