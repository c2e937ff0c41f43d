"""Recordings of every format give the same person, and their true contacts."""

from __future__ import annotations

import csv
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from clamber.contact.contact import ContactInterval
from clamber.errors import InputError
from clamber.model.boxes import AXES, to_z_up
from clamber.model.scene import GROUND, Scene
from clamber.recording.bvh import read_bvh
from clamber.recording.demonstration import (
    Demonstration,
    estimate_offsets,
)
from clamber.recording.detect import SEAT, detect_contacts
from clamber.recording.levels import find_levels, fit_levels
from clamber.recording.points import unique_names
from clamber.recording.recording import load_demo, read_points
from clamber.recording.skeleton import recognise, solve_centres
from conftest import ROOT
from support.climb import ClimbOptions, synthesize_climb
from support.files import (
    MOTIVE,
    bvh_text,
    c3d_bytes,
    from_z_up,
    holed,
    motive_csv,
    renamed,
    skin_markers,
    smpl_joints,
    write_take,
)

DATA = ROOT / "tests" / "data"
UP = np.array([0.0, 0.0, 1.0])
METRE = {"mm": 1000.0, "cm": 100.0, "m": 1.0, "in": 1.0 / 0.0254}


@cache
def climb(**options) -> tuple[Demonstration, list[ContactInterval]]:
    rng = np.random.default_rng(7)
    return synthesize_climb(rng, options=ClimbOptions(**options))


def check_contacts(demo: Demonstration, truth, within: float = 0.06) -> None:
    """The very same contacts, at the same times, at the same places."""
    found = {(i.part, i.contact.support): i for i in detect_contacts(demo).intervals}
    true = {(i.part, i.contact.support): i for i in truth}
    assert set(found) == set(true)
    for key, i in true.items():
        assert abs(found[key].t0 - i.t0) < within, key
        assert abs(found[key].t1 - i.t1) < within, key
        there = found[key].contact.position
        np.testing.assert_allclose(there, i.contact.position, atol=0.03)


# Every format gives the true contacts back.


@pytest.mark.parametrize(
    ("options", "unit", "up"),
    [
        ({}, "mm", "z"),
        ({"rate": 240.0, "noise": 0.004}, "cm", "-y"),
        ({"rate": 100.0, "mirrored": True, "gaps": 20}, "m", "x"),
    ],
    ids=str,
)
def test_an_array_gives_the_true_contacts_whatever_its_unit_axis_and_rate(
    tmp_path, options, unit, up
):
    demo, truth = climb(**options)
    p = from_z_up(holed(demo), up) * METRE[unit]
    np.savez(tmp_path / "a.npz", positions=p, names=demo.names, rate=demo.rate)
    back = load_demo(tmp_path / "a.npz", scene=demo.scene)
    check_contacts(back, truth)
    assert f"up: {up} (" in " ".join(back.notes)


def test_arrays_of_half_precision_are_read(tmp_path):
    """They end at 65504: not a number that the limits on coordinates could be."""
    demo, _ = climb()
    back = []
    for name, kind in (("half", np.float16), ("full", np.float32)):
        p = demo.position.astype(kind)
        np.savez(
            tmp_path / f"{name}.npz", positions=p, names=demo.names, rate=demo.rate
        )
        back.append(load_demo(tmp_path / f"{name}.npz", scene=demo.scene).position)
    np.testing.assert_allclose(*back, atol=2e-3)


@pytest.mark.parametrize(
    ("suffix", "options"),
    [("c3d", {}), ("trc", {"rate": 200.0, "gaps": 20, "noise": 0.004})],
)
def test_markers_of_a_file_give_the_true_contacts(tmp_path, suffix, options):
    demo, truth = climb(**options)
    valid = demo.valid.copy()
    valid[300:500, demo.names.index("LHand.tip")] = False
    demo = replace(demo, valid=valid)
    path = tmp_path / f"take.{suffix}"
    write_take(demo, path)
    back = load_demo(path, scene=demo.scene)
    assert set(back.names) == set(demo.names)
    assert back.rate == pytest.approx(demo.rate, rel=1e-6)
    for k, name in enumerate(demo.names):
        seen = demo.valid[:, k]
        np.testing.assert_array_equal(back.valid[:, back.names.index(name)], seen)
        np.testing.assert_allclose(
            back.point(name)[seen], demo.point(name)[seen], atol=1e-6
        )
    check_contacts(back, truth)


@pytest.mark.parametrize(
    ("unit", "word", "parent"), [("m", "Meters", False), ("in", "Inches", True)]
)
def test_motive_bones_give_the_true_contacts(tmp_path, unit, word, parent):
    demo, truth = climb(rate=100.0, gaps=15)
    p = from_z_up(holed(demo), "y") * METRE[unit]
    names = [f"Anna:{n}" for n in renamed(demo, MOTIVE)]
    text = motive_csv(names, p, rate=100.0, unit=word, parent=parent)
    (tmp_path / "take.csv").write_bytes(text.encode())
    back = load_demo(tmp_path / "take.csv", scene=demo.scene)
    assert "Motive skeleton" in back.notes[0]
    check_contacts(back, truth)


@pytest.mark.parametrize(
    ("order", "unit", "scale"),
    [
        ("ZXY", "cm", 100.0),
        ("YZX", "inches", 1 / 0.0254),
        ("ZYX", "CMU's", 0.45 / 0.0254),
    ],
)
def test_a_bvh_gives_the_true_contacts_whatever_its_order_of_angles(
    tmp_path, order, unit, scale
):
    demo, truth = climb(rate=60.0, gaps=0)
    p = scale * from_z_up(demo.position, "y")
    (tmp_path / "take.bvh").write_text(bvh_text(demo, p, order))
    back = load_demo(tmp_path / "take.bvh", scene=demo.scene)
    for name in demo.names:
        np.testing.assert_allclose(back.point(name), demo.point(name), atol=2e-5)
    assert f"so these are {unit}" in back.notes[1]
    check_contacts(back, truth)


def test_skin_markers_in_a_c3d_give_joint_centres_and_the_true_contacts(tmp_path):
    demo, truth = climb(gaps=0)
    names, p = skin_markers(demo)
    called = [f"Anna:{n}" for n in names]
    raw = c3d_bytes(1000.0 * p, called, rate=demo.rate, screen="+Z")
    (tmp_path / "take.c3d").write_bytes(raw)
    back = load_demo(tmp_path / "take.c3d", scene=demo.scene)
    assert "Plug-in Gait markers" in back.notes[0]
    for joint in ("Hip", "Knee", "Foot", "Shoulder", "Elbow", "Hand"):
        for s in "LR":
            off = np.linalg.norm(back.point(s + joint) - demo.point(s + joint), axis=1)
            assert np.percentile(off, 95) < 0.015, s + joint
    check_contacts(back, truth, within=0.1)


# Joint centres from the skin.


def test_markers_on_both_sides_of_a_joint_are_averaged():
    names = [
        f.format(s=s) for s in "LR" for f in (
            "{s}ASI", "{s}PSI", "{s}KNE", "{s}KNM", "{s}ANK", "{s}ANM", "{s}TOE",
            "{s}SHO", "{s}ELB", "{s}WRA", "{s}WRB", "{s}FIN",
        )
    ]  # fmt: skip
    found = recognise(names)
    assert found.on_skin
    rng = np.random.default_rng(0)
    track = {i: rng.normal(size=(4, 3)) for i in range(len(names))}
    points = solve_centres(found, track)
    for joint, a, b in (("LKnee", "LKNE", "LKNM"), ("RFoot", "RANK", "RANM")):
        middle = (track[names.index(a)] + track[names.index(b)]) / 2
        np.testing.assert_allclose(points[joint], middle)


def test_parts_go_before_the_joints_of_a_marker_set():
    found = recognise(GAIT, parts={"LKnee": "LTIB", "RHand": ["RFIN", "RWRA"]})
    assert found.on_skin
    assert "`parts`" in found.name
    track = {i: np.full((2, 3), float(i)) + np.eye(3)[:2] * i for i in found.used()}
    points = solve_centres(found, track)
    np.testing.assert_array_equal(points["LKnee"], track[GAIT.index("LTIB")])
    np.testing.assert_array_equal(points["RHand"], track[GAIT.index("RFIN")])
    np.testing.assert_array_equal(points["RHand.1"], track[GAIT.index("RWRA")])


def test_hips_are_where_the_regression_puts_them():
    """Harrington's numbers, for a pelvis 250 mm wide and 150 mm deep at the origin."""
    place = {"ASI": [0, 0.125, 0], "PSI": [-0.15, 0.04, 0], "SHO": [0, 0.2, 0.5]}
    track = {}
    for k, name in enumerate(GAIT):
        x, y, z = place.get(name[1:], [0.01 * k, 0.1, -0.01 * k])
        track[k] = np.array([[x, y if name[0] == "L" else -y, z]], dtype=float)
    points = solve_centres(recognise(GAIT), track)
    expected = [-0.24 * 0.15 - 0.0099, 0.33 * 0.25 + 0.0073, -0.30 * 0.25 - 0.0109]
    np.testing.assert_allclose(points["LHip"][0], expected, atol=1e-12)
    np.testing.assert_allclose(points["RHip"][0] * [1, -1, 1], expected, atol=1e-12)


# Names.

JOINTS = ("Shoulder", "Elbow", "Hand", "Hip", "Knee", "Foot", "Foot.toe")
SKELETONS = {
    "Motive skeleton": (
        "Hip Ab Chest Neck Head LShoulder LUArm LFArm LHand RShoulder RUArm RFArm "
        "RHand LThigh LShin LFoot LToe RThigh RShin RFoot RToe",
        "{s}UArm {s}FArm {s}Hand {s}Thigh {s}Shin {s}Foot {s}Toe", "Hip",
    ),
    "CMU skeleton": (
        "Hips LHipJoint LeftUpLeg LeftLeg LeftFoot LeftToeBase RHipJoint RightUpLeg "
        "RightLeg RightFoot RightToeBase LowerBack Spine Spine1 Neck Neck1 Head "
        "LeftShoulder LeftArm LeftForeArm LeftHand LeftFingerBase LeftHandIndex1 "
        "LThumb RightShoulder RightArm RightForeArm RightHand RightFingerBase "
        "RightHandIndex1 RThumb",
        "{side}Arm {side}ForeArm {side}Hand {side}UpLeg {side}Leg {side}Foot "
        "{side}ToeBase", "Hips",
    ),
    "LAFAN skeleton": (
        "Hips LeftUpLeg LeftLeg LeftFoot LeftToe RightUpLeg RightLeg RightFoot "
        "RightToe Spine Spine1 Spine2 Neck Head LeftShoulder LeftArm LeftForeArm "
        "LeftHand RightShoulder RightArm RightForeArm RightHand",
        "{side}Arm {side}ForeArm {side}Hand {side}UpLeg {side}Leg {side}Foot "
        "{side}Toe", "Hips",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", SKELETONS)
@pytest.mark.parametrize("prefix", ["", "Take 3:Anna:"])
def test_skeletons_are_recognised_by_their_names(name, prefix):
    text, joints, pelvis = SKELETONS[name]
    names = [prefix + n for n in text.split()]
    found = recognise(names)
    assert found.name == name
    assert not found.on_skin
    for s, side in (("L", "Left"), ("R", "Right")):
        wanted = joints.format(s=s, side=side).split()
        for joint, n in zip(JOINTS, wanted, strict=True):
            assert found.columns[s + joint] == (names.index(prefix + n),), joint
    assert found.columns["Pelvis"] == (names.index(prefix + pelvis),)


BASELINE_37 = [
    *("WaistLFront WaistRFront WaistLBack WaistRBack BackTop Chest BackLeft BackRight "
      "HeadTop HeadFront HeadSide").split(),
    *(s + n for s in "LR" for n in (
        "ShoulderBack ShoulderTop ElbowOut UArmHigh HandOut WristOut WristIn KneeOut "
        "Thigh AnkleOut Shin ToeOut ToeIn").split()),
]  # fmt: skip
BASELINE_41 = [*BASELINE_37, *(s + n for s in "LR" for n in ("Heel", "ToeTip"))]
GAIT = (
    "LFHD RFHD LBHD RBHD C7 T10 CLAV STRN RBAK LSHO LUPA LELB LFRM LWRA LWRB LFIN RSHO "
    "RUPA RELB RFRM RWRA RWRB RFIN LASI RASI LPSI RPSI LTHI LKNE LTIB LANK LHEE LTOE "
    "RTHI RKNE RTIB RANK RHEE RTOE"
).split()


@pytest.mark.parametrize(
    ("names", "called", "knee"),
    [
        (BASELINE_37, "Motive Baseline", "KneeOut"),
        (BASELINE_41, "Motive Baseline", "KneeOut"),
        (GAIT, "Plug-in Gait", "KNE"),
    ],
    ids=["baseline 37", "baseline 41", "plug-in gait"],
)
@pytest.mark.parametrize("prefix", ["", "Anna_"])
def test_marker_sets_are_recognised_by_their_names(names, called, knee, prefix):
    assert len(names) in (37, 39, 41)
    names = [prefix + n for n in names]
    found = recognise(names)
    assert found.on_skin
    assert found.name == f"{called} markers"
    assert found.columns["LKneeOut"] == (names.index(f"{prefix}L{knee}"),)
    assert {s + p for s in "LR" for p in ("Toe", "HandBack")} <= set(found.columns)


def test_bones_go_before_the_markers_of_the_same_take():
    both = [*SKELETONS["Motive skeleton"][0].split(), *BASELINE_37]
    assert not recognise(unique_names(both)).on_skin


def test_of_two_people_one_must_be_named():
    names = [p + n for p in ("Anna:", "Ben:") for n in BASELINE_37]
    with pytest.raises(InputError, match=r"subject.*'Anna', 'Ben'"):
        recognise(names)
    ben = recognise(names, subject="Ben")
    assert ben.columns["LKneeOut"] == (names.index("Ben:LKneeOut"),)
    with pytest.raises(InputError, match="subject"):
        recognise(names, subject="Carl")


@pytest.mark.parametrize(("joints", "name"), [(22, "SMPL"), (24, "SMPL"), (55, "SMPL")])
def test_smpl_joints_need_no_names(tmp_path, joints, name):
    demo, truth = climb(gaps=0)
    p = smpl_joints(demo, joints)
    np.savez(tmp_path / "smpl.npz", joints=from_z_up(p, "y"), fps=120)
    back = load_demo(tmp_path / "smpl.npz", scene=demo.scene)
    assert name in back.notes[0]
    check_contacts(back, truth, within=0.1)


def test_names_that_come_twice_are_told_apart():
    assert unique_names(["a", "b", "a", "a (2)", "a"]) == (
        "a", "b", "a (3)", "a (2)", "a (4)",
    )  # fmt: skip
    assert unique_names(["a\nb", "\x00c"]) == ("a?b", "?c")


# What recording.yaml says.


def described(tmp_path, **fields) -> Path:
    path = tmp_path / "recording.yaml"
    path.write_text(yaml.safe_dump(fields))
    return path


def test_a_point_may_be_fixed_to_a_rigid_body(tmp_path):
    """The wrist hangs at a known place of a turning cuff; only its quaternions tell."""
    demo, _ = climb(rate=60.0, gaps=0)
    t = demo.t[:, None]
    R = Rotation.from_rotvec(np.sin(t * [0.7, 1.1, 1.3]))
    at = np.array([0.03, -0.05, 0.08])
    names = renamed(demo, MOTIVE)
    p = from_z_up(demo.position, "y")
    hand = demo.names.index("LHand")
    p[:, hand] -= R.apply(at)
    names[hand] = "Cuff"
    q = np.tile([1.0, 0.0, 0.0, 0.0], (len(t), len(names), 1))
    q[:, hand] = R.as_quat(scalar_first=True)
    text = motive_csv(names, p, rate=60.0, quaternion=q, kind="Rigid Body")
    (tmp_path / "take.csv").write_text(text)
    path = described(
        tmp_path, file="take.csv", parts={"LHand": {"body": "Cuff", "at": at.tolist()}}
    )
    np.testing.assert_allclose(
        load_demo(path).point("LHand"), demo.point("LHand"), atol=1e-5
    )
    wrong = {"LHand": {"body": "Nose", "at": [0, 0, 0]}}
    with pytest.raises(InputError, match="Nose"):
        load_demo(described(tmp_path, file="take.csv", parts=wrong))


def test_what_recording_yaml_says_goes_before_what_the_file_says(tmp_path):
    demo, _ = climb(rate=60.0, gaps=0)
    write_take(demo, tmp_path / "take.c3d")
    said = {"file": "take.c3d", "unit": 0.0005, "rate": 30, "offsets": {"Knee": 0.09}}
    back = load_demo(described(tmp_path, **said))
    np.testing.assert_allclose(back.point("Neck"), demo.point("Neck") / 2, atol=1e-6)
    assert back.rate == pytest.approx(30.0)
    assert back.offsets["Knee"] == 0.09
    assert "0.0005 m (recording.yaml)" in back.notes[1]
    assert load_demo(tmp_path / "take.c3d", rate=50.0).rate == pytest.approx(50.0)


def test_a_file_is_known_by_its_content_where_its_name_says_nothing(tmp_path):
    demo, _ = climb(rate=60.0)
    write_take(demo, tmp_path / "take.trc")
    (tmp_path / "take.trc").rename(tmp_path / "take.txt")
    assert load_demo(tmp_path / "take.txt").rate == pytest.approx(60.0)
    write_take(demo, tmp_path / "take.c3d")
    points = read_points(tmp_path / "take.c3d")
    assert points.up == "z"
    (tmp_path / "take.json").write_text("{}")
    with pytest.raises(InputError, match="a recording"):
        load_demo(tmp_path / "take.json")


def test_who_never_stands_up_does_not_turn_the_world(tmp_path):
    """On all fours shoulders are far ahead of the ankles: up is up all the same."""
    demo, _ = climb(gaps=0)
    p = demo.position[demo.t > 17.0]
    way = demo.point("LShoulder")[-1] - demo.point("LFoot")[-1]
    assert way[0] > 1.5 * way[2]  # the case that might mislead
    np.savez(tmp_path / "a.npz", positions=p, names=demo.names, rate=demo.rate)
    back = load_demo(tmp_path / "a.npz")
    assert "up: z (usual)" in back.notes[1]
    y_up = from_z_up(p, "y")
    np.savez(tmp_path / "a.npz", positions=y_up, names=demo.names, rate=demo.rate)
    path = described(tmp_path, file="a.npz", up="y")
    np.testing.assert_allclose(load_demo(path).position, back.position, atol=1e-12)


def test_a_person_who_stands_is_believed_before_the_file(tmp_path):
    """C3D files that say y though z is up, or -Z as some programs do."""
    demo, _ = climb(rate=60.0, gaps=0)
    path = tmp_path / "take.c3d"
    write_take(demo, path)
    raw = path.read_bytes()
    for word, said in ((b"+Y", "the person stands along it, not along y"),
                       (b"-Z", "up: z (the file)")):  # fmt: skip
        path.write_bytes(raw.replace(b"+Z", word))
        back = load_demo(path)
        assert said in back.notes[1]
        np.testing.assert_allclose(back.point("Neck"), demo.point("Neck"), atol=1e-6)


@pytest.mark.parametrize("up", AXES)
def test_axes_are_turned_and_never_mirrored(up):
    R = to_z_up(np.eye(3), up).T  # columns: where x, y, z go
    assert np.linalg.det(R) == pytest.approx(1.0)
    axis = np.eye(3)["xyz".index(up[-1])] * (-1 if up[0] == "-" else 1)
    np.testing.assert_array_equal(to_z_up(axis, up), [0, 0, 1])


# BVH's kinematics against an independent computation.


@pytest.mark.parametrize("order", ["XYZ", "YXZ", "ZYX", "ZXZ"])
def test_bvh_rotations_multiply_in_the_order_in_which_they_are_listed(
    tmp_path, order, rng
):
    a, b, end = rng.normal(size=(3, 3))
    words = " ".join(f"{x}rotation" for x in order)
    text = f"""HIERARCHY
ROOT Hips
{{
  OFFSET 9 9 9
  CHANNELS 6 Zposition Xposition Yposition {words}
  JOINT Spine
  {{
    OFFSET {a[0]} {a[1]} {a[2]}
    CHANNELS 3 {words}
    JOINT Head
    {{
      OFFSET {b[0]} {b[1]} {b[2]}
      CHANNELS 1 Yrotation
      End Site
      {{
        OFFSET {end[0]} {end[1]} {end[2]}
      }}
    }}
  }}
}}
MOTION
Frames: 5
Frame Time: 0.0083333
"""
    rows = rng.uniform(-180, 180, size=(5, 10))
    text += "\n".join(" ".join(map(repr, r)) for r in rows.tolist())
    (tmp_path / "a.bvh").write_text(text)
    points = read_bvh(tmp_path / "a.bvh")
    assert points.names == ("Hips", "Spine", "Head", "Head_end")
    assert points.rate == pytest.approx(120.0, rel=1e-4)
    root = rows[:, [1, 2, 0]]
    R1, R2 = (
        Rotation.from_euler(order, rows[:, k : k + 3], degrees=True) for k in (3, 6)
    )
    R3 = Rotation.from_euler("Y", rows[:, 9:], degrees=True)
    spine = root + R1.apply(a)
    head = spine + (R1 * R2).apply(b)
    tip = head + (R1 * R2 * R3).apply(end)
    expected = np.stack([root, spine, head, tip], axis=1)
    np.testing.assert_allclose(points.position, expected, atol=1e-12)


# Files of other programs.


def test_a_c3d_that_ezc3d_wrote_is_read(tmp_path):
    ezc3d = pytest.importorskip("ezc3d")
    demo, _ = climb(gaps=3)
    p = 1000.0 * np.moveaxis(demo.position, 0, -1)  # (F, 3, T)
    p[2, :, 50:90] = np.nan
    theirs = ezc3d.c3d()
    point = theirs["parameters"]["POINT"]
    point["LABELS"]["value"], point["UNITS"]["value"] = list(demo.names), ["mm"]
    point["RATE"]["value"] = [demo.rate]
    homogeneous = [*p.swapaxes(0, 1), np.ones((len(p), len(demo.t)))]
    theirs["data"]["points"] = np.stack(homogeneous)
    theirs.write(str(tmp_path / "theirs.c3d"))
    points = read_points(tmp_path / "theirs.c3d")
    assert points.names == demo.names
    assert points.rate == pytest.approx(demo.rate)
    assert points.unit == 0.001
    np.testing.assert_allclose(np.moveaxis(points.position, 0, -1), p, rtol=1e-6)


@pytest.mark.parametrize("order", ["intel", "dec", "mips"])
@pytest.mark.parametrize("scale", [-1.0, 0.1])
@pytest.mark.parametrize("analog", [0, 6])
def test_every_dialect_of_c3d_is_read(tmp_path, order, scale, analog, rng):
    p = np.round(rng.uniform(-2000, 2000, size=(20, 4, 3)), 1)
    p[3:6, 1] = np.nan
    said = {"order": order, "scale": scale, "analog": analog, "results": ["AAngle"]}
    raw = c3d_bytes(p, ["A", "B", "C", "AAngle"], **said)
    (tmp_path / "a.c3d").write_bytes(raw)
    points = read_points(tmp_path / "a.c3d")
    assert points.names == ("A", "B", "C")  # angles are no markers
    assert points.unit == 0.001
    assert points.up is None
    assert points.rate == 50.0
    np.testing.assert_allclose(points.position, p[:, :3], rtol=1e-6, atol=1e-4)


def test_more_samples_than_16_bits_hold_are_read(tmp_path, rng):
    p = rng.uniform(-2000, 2000, size=(70_001, 3, 3))
    (tmp_path / "long.c3d").write_bytes(c3d_bytes(p, "abc"))
    points = read_points(tmp_path / "long.c3d")
    np.testing.assert_allclose(points.position, p, rtol=1e-6)


def test_a_real_motive_file_is_read(shared, tmp_path):
    path = shared / "demos" / "motive-sample" / "pathviewr_motive_example_data.csv"
    with pytest.raises(InputError, match=r"line 637: .* found 72838 and then 76400"):
        read_points(path)  # it was put together from several stretches
    lines = path.read_bytes().splitlines(keepends=True)
    path = tmp_path / "first.csv"
    path.write_bytes(b"".join(lines[:636]))
    points = read_points(path)
    assert points.names == ("device02", "device03", "device05")
    assert points.rate == 100.0
    assert points.unit == 1.0
    np.testing.assert_allclose(points.position[0, 0], [0.142319, 0.160392, 2.000101])
    q = points.orientation["device02"]
    np.testing.assert_allclose(q[0], [0.121543, 0.134648, -0.97705, -0.111668])
    length = np.linalg.norm(q, axis=1)
    np.testing.assert_array_equal(np.isnan(length), np.isnan(points.position[:, 0, 0]))
    np.testing.assert_allclose(length[np.isfinite(length)], 1.0, atol=1e-4)
    with pytest.raises(InputError, match="parts"):
        load_demo(path)


def test_samples_that_a_file_leaves_out_are_gaps(tmp_path):
    demo, _ = climb(rate=60.0, gaps=0)
    p = from_z_up(demo.position, "y")
    lines = motive_csv(renamed(demo, MOTIVE), p, rate=60.0).splitlines(keepends=True)
    (tmp_path / "take.csv").write_text("".join(lines[:107] + lines[117:]))
    back = load_demo(tmp_path / "take.csv")
    assert back.t[-1] == pytest.approx(demo.t[-1])
    assert {g.point for g in back.gaps} == set(back.names)
    for g in back.gaps:
        assert (g.t0, g.t1) == pytest.approx((100 / 60, 109 / 60))
    np.testing.assert_allclose(
        back.point("Neck")[200], demo.point("Neck")[200], atol=2e-6
    )


def test_trc_of_other_programs_are_read(tmp_path):
    """A line between heading and rows, trailing tabs, CRLF, empty cells or `nan`."""
    head = "PathFileType\t4\t(X/Y/Z)\tx.trc\r\nDataRate\tNumMarkers\tUnits\r\n"
    head += (
        "100\t2\tcm\r\nFrame#\tTime\tA\t\t\tB\t\t\t\r\n\t\tX1\tY1\tZ1\tX2\tY2\tZ2\r\n"
    )
    rows = "1\t0.00\t1\t2\t3\t4\t5\t6\t\r\n2\t0.01\t\t\t\t7\t8\t9\t\r\n"
    rows += "3\t0.02\tnan\tnan\tnan\t-1e1\t.5\t6\t\r\n"
    for between in ("\r\n", "", "\t\t\t\r\n"):
        (tmp_path / "x.trc").write_text(head + between + rows, newline="")
        points = read_points(tmp_path / "x.trc")
        assert points.names == ("A", "B")
        assert points.unit == 0.01
        np.testing.assert_array_equal(np.isnan(points.position[:, 0, 0]), [0, 1, 1])
        np.testing.assert_array_equal(points.position[2, 1], [-10, 0.5, 6])
    ragged = rows.replace("6\t\r\n2", "6\r\n2")  # one row without its last tab
    (tmp_path / "x.trc").write_text(head + ragged, newline="")
    np.testing.assert_array_equal(
        read_points(tmp_path / "x.trc").position[1, 1], [7, 8, 9]
    )


# The heights of floor and boxes.


@pytest.mark.parametrize(("floor", "top"), [(0.035, 0.0), (-0.04, 0.03), (0.0, -0.035)])
def test_a_floor_and_a_box_that_are_off_are_put_right(floor, top):
    demo, truth = climb(noise=0.002)
    ideal = estimate_offsets(demo.subject, {})
    level = {x.support: x.correction for x in find_levels(demo)}
    # What the estimate of the offsets itself is wrong by, on true heights.
    assert level["ground"] == pytest.approx(0.035 - ideal["Foot.toe"], abs=2e-3)
    assert level["table"] == pytest.approx(0.11 - ideal["Knee"], abs=2e-3)

    box = demo.scene.boxes[0]
    wrong = replace(box, size=box.size + top * UP, centre=box.centre + top / 2 * UP)
    off = replace(
        demo, position=demo.position + floor * UP,
        scene=replace(demo.scene, boxes=(wrong,)),
        offsets={**ideal, "Foot.toe": 0.035, "Knee": 0.11},
    )  # fmt: skip
    right = fit_levels(off)
    for name in demo.names:
        np.testing.assert_allclose(right.point(name), demo.point(name), atol=3e-3)
    table = right.scene.boxes[0]
    assert table.size[2] == pytest.approx(box.size[2], abs=5e-3)
    assert table.centre[2] - table.size[2] / 2 == pytest.approx(0.0, abs=1e-9)
    assert any(f"ground {1000 * floor:+.0f} mm" in n for n in right.notes) or floor == 0
    check_contacts(right, truth)


def test_a_thin_box_is_never_turned_inside_out():
    demo, _ = climb()
    box = demo.scene.boxes[0]
    size, lower = np.array([*box.size[:2], 0.02]), (box.size[2] / 2 - 0.01) * UP
    thin = replace(box, size=size, centre=box.centre + lower)
    offsets = {**demo.offsets, "Knee": demo.offsets["Knee"] + 0.05}
    scene = replace(demo.scene, boxes=(thin,))
    fitted = fit_levels(replace(demo, scene=scene, offsets=offsets)).scene.boxes[0]
    assert fitted.size[2] == pytest.approx(1e-3)


def test_what_nobody_rests_on_is_not_fitted():
    demo, _ = climb()
    far = replace(demo.scene.boxes[0], name="far", centre=np.array([9.0, 0.0, 0.25]))
    scene = replace(demo.scene, boxes=(*demo.scene.boxes, far))
    fitted = fit_levels(replace(demo, scene=scene))
    assert fitted.scene.boxes[1].centre[2] == 0.25
    assert "not fitted: far, nothing rests on it" in fitted.notes
    walked = replace(demo, position=demo.position + 0.5 * UP)
    assert not find_levels(replace(walked, scene=Scene(start=np.zeros(3))))


def test_a_real_floor_is_found_where_it_was_raised(shared, tmp_path):
    for folder in ("climb-0", "climb-1"):
        demo = real(shared, folder, tmp_path)
        true = {x.support: x.correction for x in find_levels(demo)}
        assert all(abs(x) < 0.01 for x in true.values())
        lifted = replace(demo, position=demo.position + 0.035 * UP)
        found = {x.support: x.correction for x in find_levels(lifted)}
        for name in true:
            assert found[name] - true[name] == pytest.approx(0.035, abs=2e-3)


# Detection in real recordings, held against labels made by eye.


def real(shared: Path, folder: str, tmp_path: Path, **more) -> Demonstration:
    at = shared / "demos"
    said = {
        "file": str(at / folder / "joints.npy"), "names": str(at / "joint_names.json"),
        "boxes": str(at / folder / "boxes.obj"), "rate": 120, **more,
    }  # fmt: skip
    return load_demo(described(tmp_path, **said))


def labels(folder: str) -> list[tuple[str, str, float, float]]:
    text = (DATA / f"{folder}-contacts.csv").read_text().splitlines()
    rows = csv.DictReader(line for line in text if not line.startswith("#"))
    return [(r["part"], r["support"], float(r["t0"]), float(r["t1"])) for r in rows]


@pytest.mark.parametrize("folder", ["climb-0", "climb-1"])
def test_real_contacts_are_found_with_precision_and_recall(shared, tmp_path, folder):
    demo = real(shared, folder, tmp_path)
    found = [
        (i.part, i.contact.support, i.t0, i.t1)
        for i in detect_contacts(demo).intervals
        if i.is_surface
    ]
    rows = labels(folder)
    sure = [r for r in rows if r[1] != "maybe"]
    vague = [r for r in rows if r[1] == "maybe"]
    t = np.arange(0.0, demo.t[-1], 0.01)

    def during(several, part, support):
        mask = np.zeros(len(t), dtype=bool)
        for p, s, t0, t1 in several:
            mask |= (p == part) & (s == support) & (t >= t0) & (t < t1)
        return mask

    both = said = there = 0
    for part, support in {r[:2] for r in (*sure, *found)}:
        counts = ~during(vague, part, "maybe")
        true, claimed = during(sure, part, support), during(found, part, support)
        both += int(np.sum(true & claimed & counts))
        said += int(np.sum(claimed & counts))
        there += int(np.sum(true & counts))
    assert both / said > 0.95, "precision"
    assert both / there > 0.95, "recall"

    off = [
        min((abs(f[2] - t0) for f in found if f[:2] == (part, support)), default=9.0)
        for part, support, t0, _ in sure
        if t0 > 0.0 and not any(p == part and a <= t0 <= b for p, _, a, b in vague)
    ]
    assert np.mean(np.array(off) < 0.1) > 0.93
    assert max(off) < 0.15


def test_a_real_person_kneels_on_a_box_and_sits_down_without_kneeling(shared, tmp_path):
    whole = detect_contacts(real(shared, "climb-0", tmp_path)).intervals
    (seat,) = [i for i in whole if not i.is_surface]
    assert (seat.part, seat.t0) == (SEAT, pytest.approx(16.05, abs=0.3))
    assert seat.t1 == pytest.approx(18.5, abs=0.3)
    assert not [i for i in whole if i.t0 > 11.0 and i.part.endswith(("Knee", "Elbow"))]
    cut = {"ground": "box2", "span": [3.5, 8.45]}
    sequence = detect_contacts(real(shared, "climb-0", tmp_path, **cut))
    assert set(sequence.stances[-1].surfaces) == {"LHand", "RHand", "LKnee", "RKnee"}
    assert sequence.stances[0].region == "G"
    leaves = {i.part: i.t1 for i in sequence.intervals if i.contact.support == GROUND}
    assert leaves["RFoot"] == pytest.approx(6.04, abs=0.2)
    assert leaves["LFoot"] == pytest.approx(7.43, abs=0.2)
