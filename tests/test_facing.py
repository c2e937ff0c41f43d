"""Which way a description faces and stands, and what `check` sees of it."""

from __future__ import annotations

import re
from dataclasses import replace

import mujoco
import numpy as np
import pytest

import humanoids
from clamber.errors import InputError
from clamber.model.facing import side_told
from clamber.model.kinematics import Kinematics
from clamber.model.propose import Proposal, propose_robot
from clamber.model.robot import Robot, load_robot
from clamber.model.scene import Scene
from clamber.model.world import build_world
from clamber.planning.diagnose import check_robot
from clamber.run.proposal import save_proposal

BOTH_WAYS = ('range="-2.3 0.0"', 'range="-2.3 2.3"')


def proposed(folder, text: str) -> tuple[Proposal, Robot]:
    path = folder / "small.xml"
    path.write_text(text)
    made = propose_robot(path)
    (folder / "robot").mkdir()
    save_proposal(made, folder / "robot")
    return made, load_robot(folder / "robot" / "robot.yaml")


def limb_bodies(robot: Robot) -> dict[str, str]:
    return {n: limb.middle for n, limb in robot.limbs.items()}


AS_IT_IS = {"left_arm": "v2", "right_arm": "w2", "left_leg": "t2", "right_leg": "u2"}


@pytest.mark.parametrize(
    ("left", "right", "told"),
    [
        ("left_knee", "right_knee", 1),
        ("KneeLeft", "KneeRight", 1),
        ("thigh_r", "thigh_l", -1),
        ("rfemur", "lfemur", -1),
        ("RR_HIP", "LR_HIP", -1),
        ("leg1", "leg2", 0),
        ("knee", "knee", 0),
    ],
)
def test_a_pair_of_names_tells_left_and_right(left, right, told):
    assert side_told(left, right) == told


def test_knees_that_may_bend_both_ways_follow_soles_and_elbows(tmp_path):
    text = humanoids.mjcf().replace(*BOTH_WAYS)
    made, robot = proposed(tmp_path, text)
    assert limb_bodies(robot) == AS_IT_IS
    assert robot.home["td"] < -0.5  # turned so, it folds the foot back
    assert any("turned by -90" in n for n in made.notes)
    assert check_robot(robot).faults == ()


def test_names_outweigh_soles_and_a_close_vote_is_said(tmp_path):
    # Soles reach back, knees and elbows tell nothing: names say which side is which.
    text = humanoids.mjcf().replace(*BOTH_WAYS)
    text = text.replace('range="0.0 2.4"', 'range="-2.4 2.4"')
    text = text.replace('pos="0 0.03 ', 'pos="0 -0.03 ')
    for tag, side in (("t", "left_leg"), ("u", "right_leg")):
        text = re.sub(rf'name="{tag}(\w)"', rf'name="{side}_\1"', text)
    made, robot = proposed(tmp_path, text)
    assert robot.limbs["left_leg"].middle == "left_leg_2"
    assert any("close vote" in n and "soles" in n for n in made.notes)
    assert any("points back" in x for x in check_robot(robot).faults)


def test_sides_against_the_names_are_never_silent(tmp_path):
    text = humanoids.mjcf()  # knees, soles and elbows all say that it faces along y
    for tag, side in (("t", "right_leg"), ("u", "left_leg")):
        text = re.sub(rf'name="{tag}(\w)"', rf'name="{side}_\1"', text)
    made, robot = proposed(tmp_path, text)
    assert robot.limbs["left_leg"].middle == "right_leg_2"
    assert any("left and right are the other way round" in n for n in made.notes)
    assert any("swapped" in x for x in check_robot(robot).faults)


def test_check_sees_knees_bent_backward_and_arms_crossed(tmp_path):
    _, robot = proposed(tmp_path, humanoids.mjcf().replace(*BOTH_WAYS))
    back = {"td": 0.9, "ud": 0.9, "tc": -0.45, "uc": -0.45, "te": -0.45, "ue": -0.45}
    faults = check_robot(replace(robot, home={**robot.home, **back})).faults
    assert sum("bends backward" in x for x in faults) == 2
    limbs = dict(robot.limbs)
    limbs["left_arm"], limbs["right_arm"] = limbs["right_arm"], limbs["left_arm"]
    crossed = [replace(limbs[n], name=n) for n in limbs]
    faults = check_robot(replace(robot, limbs={x.name: x for x in crossed})).faults
    assert any("arms cross" in x for x in faults)


@pytest.mark.parametrize(
    ("quat", "up"),
    [("0.70711 -0.70711 0 0", "y"), ("0.70711 0 0.70711 0", "x"), ("0 1 0 0", "-z")],
)
def test_a_model_with_another_axis_up_is_stood_up(tmp_path, quat, up):
    text = humanoids.mjcf().replace('name="b0"', f'name="b0" quat="{quat}"')
    made, robot = proposed(tmp_path, text)
    assert limb_bodies(robot) == AS_IT_IS
    assert check_robot(robot).faults == ()
    assert any("stood up" in n for n in made.notes)


def test_legs_may_begin_in_one_point(tmp_path):
    text = humanoids.mjcf()
    for tag, x in (("t", -0.08), ("u", 0.08)):
        text = text.replace(
            f'name="{tag}1" pos="{x} 0 0"', f'name="{tag}1" pos="0 0 0"'
        )
        text = text.replace(
            f'name="{tag}2" pos="0 0 {-humanoids.THIGH}"',
            f'name="{tag}2" pos="{x} 0 {-humanoids.THIGH}"',
        )
    _, robot = proposed(tmp_path, text)
    assert limb_bodies(robot) == AS_IT_IS


def test_toes_of_their_own_are_part_of_the_sole_and_locked(tmp_path):
    text = humanoids.mjcf()
    for tag in "tu":
        toe = (
            f'<body name="{tag}toe" pos="0 0.115 -0.05">'
            f'<joint name="{tag}toe" axis="1 0 0" range="-0.5 0.5"/>'
            '<geom type="box" size="0.04 0.03 0.01" pos="0 0.03 0" mass="0.1"/></body>'
        )
        end = text.index("/>", text.index("<geom", text.index(f'name="{tag}3"'))) + 2
        text = text[:end] + toe + text[end:]
    made, robot = proposed(tmp_path, text)
    assert limb_bodies(robot) == AS_IT_IS
    assert robot.limbs["left_leg"].end == "t3"
    assert any("locked" in n and "ttoe" in n for n in made.notes)
    model = mujoco.MjModel.from_xml_path(str(robot.path))
    foot = [model.geom(g) for g in range(model.ngeom) if "LFoot" in model.geom(g).name]
    assert len(foot) == 1
    assert 2 * np.max(foot[0].size) == pytest.approx(0.23, abs=0.012)  # foot and toe


def test_a_rod_that_drives_an_ankle_is_no_part_of_the_leg(tmp_path):
    text, ties = humanoids.mjcf(), ""
    for tag in "tu":
        rod = (
            f'<body name="{tag}rod" pos="0 -0.05 -0.02">'
            f'<joint name="{tag}rod" axis="1 0 0"/>'
            '<geom type="capsule" size="0.005" fromto="0 0 0 0 0 -0.2" mass="0.05"/>'
            f'<body name="{tag}tip" pos="0 0 -0.2">'
            f'<joint name="{tag}tip" axis="1 0 0"/>'
            '<geom type="sphere" size="0.006" mass="0.02"/></body></body>'
        )
        at = text.index(f'<body name="{tag}3"')
        text = text[:at] + rod + text[at:]
        ties += f'<connect body1="{tag}tip" body2="{tag}3" anchor="0 0 0"/>'
    text = text.replace("</mujoco>", f"<equality>{ties}</equality></mujoco>")
    _, robot = proposed(tmp_path, text)
    assert limb_bodies(robot) == AS_IT_IS
    assert robot.limbs["left_leg"].end == "t3"
    assert check_robot(robot).faults == ()


def test_a_forearm_whose_only_shape_is_a_ball_on_its_joint_is_bent(tmp_path):
    text = humanoids.mjcf()
    for tag in "vw":
        start = text.index("<geom", text.index(f'name="{tag}2"'))
        end = text.index("/>", start) + 2
        ball = (
            '<geom type="sphere" size="0.04" mass="0"/>'
            '<inertial pos="0 0 -0.1" mass="1.2" diaginertia="0.004 0.004 0.001"/>'
        )
        text = text[:start] + ball + text[end:]
    _, robot = proposed(tmp_path, text)
    assert check_robot(robot).faults == ()
    model = mujoco.MjModel.from_xml_path(str(robot.path))
    assert model.geom("LHand").pos[2] < -0.15


def test_arms_that_may_fold_any_way_are_mirror_images(tmp_path):
    """Stretched out aside, as of a toy whose joints all turn around."""
    text, around = humanoids.mjcf(), f'range="{-np.pi} {np.pi}"'
    for tag, turn in (("v", "0.7071 0 0.7071 0"), ("w", "0.7071 0 -0.7071 0")):
        start = text.index(f'<body name="{tag}1"')
        end = text.index("</body>", text.index("</body>", start) + 1)
        arm = re.sub(rf'<joint name="{tag}c".*/>', "", text[start:end])
        arm = re.sub(r'range="[^"]*"', around, arm)
        arm = arm.replace("<body", f'<body quat="{turn}"', 1)
        arm = arm.replace(f'"{tag}a" axis="1 0 0"', f'"{tag}a" axis="0 0 1"')
        arm = arm.replace(f'"{tag}d" axis="1 0 0"', f'"{tag}d" axis="0 1 0"')
        elbow = f'name="{tag}2" pos="0 0'  # ahead of the shoulder
        arm = arm.replace(elbow, elbow.replace("0 0", "0 0.03"))
        text = text[:start] + arm + text[end:]
    _, robot = proposed(tmp_path, text)
    kin = Kinematics(build_world(robot, Scene(start=np.zeros(3))))
    kin.update(kin.world.home)
    for part in ("Hand", "Elbow"):
        left, right = (kin.landmark(side + part)[1] for side in "LR")
        np.testing.assert_allclose(left * [1, -1, 1], right, atol=5e-3)


def test_a_collarbone_is_no_elbow(tmp_path):
    text = humanoids.mjcf()
    for tag, x, out in (("v", -0.17, -1), ("w", 0.17, 1)):
        bone = (
            f'<body name="{tag}0" pos="{x - 0.12 * out} 0 0.2">'
            f'<joint name="{tag}0" axis="0 1 0" range="-0.3 0.3"'
            ' actuatorfrcrange="-50 50"/>'
            '<geom type="sphere" size="0.02" mass="0.3"/>'
        )
        start = text.index(f'<body name="{tag}1"')
        end = text.index("</body>", text.index("</body>", start) + 1) + len("</body>")
        arm = text[start:end].replace(f'pos="{x} 0 0.2"', f'pos="{0.12 * out} 0 0"')
        text = text[:start] + bone + arm + "</body>" + text[end:]
    _, robot = proposed(tmp_path, text)
    assert limb_bodies(robot) == AS_IT_IS


@pytest.mark.parametrize("beside", [True, False])
def test_a_knee_driven_by_a_motor_beside_it_is_a_joint_of_its_own(tmp_path, beside):
    text, ties = humanoids.mjcf(), ""
    for tag in "tu":
        motor = (
            f'<body name="{tag}m"><joint name="{tag}m" axis="1 0 0"/>'
            '<geom type="sphere" size="0.01" mass="0.1"/></body>'
        )
        at = text.index(f'<body name="{tag}2"')
        text = text[:at] + motor + text[at:]
        ties += f'<joint joint1="{tag}d" joint2="{tag}{"m" if beside else "c"}"/>'
    text = text.replace("</mujoco>", f"<equality>{ties}</equality></mujoco>")
    if beside:
        made, robot = proposed(tmp_path, text)
        assert limb_bodies(robot) == AS_IT_IS
        assert any("td (by tm)" in n for n in made.notes)
    else:
        with pytest.raises(InputError, match=r"'td'.*follows 'tc'"):
            proposed(tmp_path, text)
