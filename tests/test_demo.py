"""Recordings are read as they are meant; what cannot be used is refused and named."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from clamber.contact.contact import PARTS
from clamber.errors import InputError
from clamber.model.boxes import read_obj
from clamber.model.scene import Scene
from clamber.model.se3 import matrix_from_rpy
from clamber.recording.demonstration import (
    Demonstration,
    RawTracks,
    build_demonstration,
    runs,
)
from clamber.recording.recording import load_demo, read_points
from clamber.recording.skeleton import recognise
from support.files import box_obj

NAMES = [
    "Hips",
    *(side + n for side in ("Left", "Right")
      for n in ("Arm", "ForeArm", "Hand", "UpLeg", "Leg", "Foot", "ToeBase")),
]  # fmt: skip
PLACE = {
    "Hips": (0, 0, 0.907), "Arm": (0, 0.155, 1.43), "ForeArm": (0, 0.155, 1.119),
    "Hand": (0, 0.155, 0.865), "UpLeg": (0, 0.0975, 0.906), "Leg": (0, 0.0975, 0.533),
    "Foot": (0, 0.0975, 0.08), "ToeBase": (0.15, 0.0975, 0.035),
}  # fmt: skip
SEGMENTS = {
    "thigh": ("Hip", "Knee", 0.373),
    "shank": ("Knee", "Foot", 0.453),
    "upper_arm": ("Shoulder", "Elbow", 0.311),
    "forearm": ("Elbow", "Hand", 0.254),
}


def standing(samples: int = 60) -> np.ndarray:
    """(T, F, 3) of a person who stands still at the origin and looks along x."""
    out = np.zeros((samples, len(NAMES), 3))
    for f, name in enumerate(NAMES):
        side = next((s for s in ("Left", "Right") if name.startswith(s)), "")
        x, y, z = PLACE[name.removeprefix(side)]
        out[:, f] = [x, -y if side == "Right" else y, z]
    return out


@pytest.fixture
def write(tmp_path):
    """Write a recording with these fields changed; None leaves a field out."""

    def write(array: np.ndarray | None = None, **fields) -> Path:
        np.save(tmp_path / "joints.npy", standing() if array is None else array)
        (tmp_path / "names.json").write_text(json.dumps(NAMES))
        said = {"file": "joints.npy", "names": "names.json", "rate": 30, **fields}
        path = tmp_path / "recording.yaml"
        path.write_text(
            yaml.safe_dump({k: v for k, v in said.items() if v is not None})
        )
        return path

    return write


def test_a_recording_is_read_with_its_points_times_and_lengths(write):
    demo = load_demo(write())
    assert set(PARTS) <= set(demo.names)
    assert demo.rate == pytest.approx(30.0)
    assert not demo.synthetic
    for segment, (_, _, length) in SEGMENTS.items():
        assert demo.subject[segment] == pytest.approx(length, abs=1e-9)
    assert demo.subject["knee_height"] == pytest.approx(0.533, abs=1e-9)
    assert demo.subject["hip_height"] == pytest.approx(0.906, abs=1e-9)
    np.testing.assert_allclose(demo.scene.start, [0, 0, 0], atol=1e-12)
    np.testing.assert_allclose(demo.point("LElbow")[0], [0, 0.155, 1.119])
    assert demo.points_of("LFoot") == ("LFoot", "LFoot.toe")


def test_a_span_keeps_the_recordings_own_times(write):
    moving = standing()
    moving[:, :, 0] += np.arange(60)[:, None] / 30
    demo = load_demo(write(moving, span=[0.5, 1.0]))
    assert demo.t[0] == pytest.approx(0.5)
    assert demo.t[-1] == pytest.approx(1.0)
    assert demo.point("Pelvis")[0, 0] == pytest.approx(0.5)
    assert demo.scene.start[0] == pytest.approx(0.5)


def test_the_start_has_the_yaw_of_the_hips(write):
    R = matrix_from_rpy([0, 0, 2.0])
    start = load_demo(write(standing() @ R.T + [1.0, 2.0, 0.0])).scene.start
    np.testing.assert_allclose(start, [1.0, 2.0, 2.0], atol=1e-9)


def test_objects_of_an_obj_give_boxes_their_names_and_others_numbers(tmp_path):
    text = box_obj([1, 2, 0.5], [0, 0, 0.25], 0.3)
    text += box_obj([1, 1, 1], [3, 0, 0.5], 0.0, name="table")
    (tmp_path / "b.obj").write_text(text)
    boxes = read_obj(tmp_path / "b.obj")
    assert [b.name for b in boxes] == ["box1", "table"]
    np.testing.assert_allclose(np.sort(boxes[0].size[:2]), [1.0, 2.0], atol=1e-7)
    np.testing.assert_allclose(boxes[0].centre, [0, 0, 0.25], atol=1e-7)


def test_a_box_that_is_the_ground_lowers_the_world_to_its_top(write, tmp_path):
    (tmp_path / "b.obj").write_text(
        box_obj([1, 1, 0.95], [1, 0, 0.475], 0.2)
        + box_obj([1, 1, 0.47], [0, 0, 0.235], 0.1)
        + box_obj([1, 1, 0.18], [-1, 0, 0.09], 0.0)
    )
    on_step = standing() + np.array([0, 0, 0.47])
    floor = load_demo(write(on_step, boxes="b.obj"))
    demo = load_demo(write(on_step, boxes="b.obj", ground="box2"))
    assert [b.name for b in floor.scene.boxes] == ["box1", "box2", "box3"]
    assert [b.name for b in demo.scene.boxes] == ["box1"]
    box = demo.scene.boxes[0]
    assert box.top.position[2] == pytest.approx(0.48, abs=1e-7)
    assert box.centre[2] - box.size[2] / 2 == pytest.approx(0.0, abs=1e-7)
    assert demo.point("LFoot")[0, 2] == pytest.approx(0.08, abs=1e-7)
    assert floor.subject["knee_height"] == pytest.approx(0.533, abs=1e-6)


def test_short_gaps_are_filled_smoothly_and_long_ones_are_reported(write):
    p = standing(120)
    p[:, :, 0] += (np.linspace(0, 1, 120) ** 2)[:, None]
    holed = p.copy()
    elbow, knee = NAMES.index("LeftForeArm"), NAMES.index("RightLeg")
    holed[40:45, elbow] = np.nan
    holed[60:90, knee, 1] = np.nan
    holed[:3, elbow] = np.nan
    demo = load_demo(write(holed))
    np.testing.assert_allclose(demo.point("LElbow")[40:45], p[40:45, elbow], atol=1e-3)
    valid = dict(zip(demo.names, demo.valid.T, strict=True))
    assert valid["LElbow"][3:].all()
    assert not valid["LElbow"][:3].any()
    assert not valid["RKnee"][60:90].any()
    assert valid["RKnee"].sum() == 90
    assert [(g.point, g.filled) for g in demo.gaps] == [
        ("LElbow", False), ("LElbow", True), ("RKnee", False)
    ]  # fmt: skip
    assert (demo.gaps[2].t0, demo.gaps[2].t1) == pytest.approx((2.0, 89 / 30))
    assert load_demo(write(holed, max_gap=1.5)).valid[60:90].all()


def test_parts_name_points_that_are_not_recognised(write, tmp_path):
    path = write(parts={"LHand": "glove", "RHand": ["RightHand", "RightToeBase"]})
    names = ["glove" if n == "LeftHand" else n for n in NAMES]
    (tmp_path / "names.json").write_text(json.dumps(names))
    demo = load_demo(path)
    np.testing.assert_allclose(demo.point("LHand")[0], [0, 0.155, 0.865])
    assert demo.points_of("RHand") == ("RHand", "RHand.1")


def test_a_finger_that_stands_for_the_hand_does_not_lengthen_the_forearm(write):
    p = standing()
    tip = p[:, NAMES.index("LeftHand")] + [0.16, 0, 0]
    array = np.concatenate([p, tip[:, None]], axis=1)
    path = write(array, names=[*NAMES, "LeftTip"], parts={"LHand": "LeftTip"})
    demo = load_demo(path)
    assert "LWrist" in demo.names
    assert demo.subject["forearm"] == pytest.approx(0.254)


@pytest.mark.parametrize(
    "names",
    [
        NAMES,
        ["pelvis", *(f"{s}_{n}" for s in ("left", "right") for n in (
            "shoulder", "elbow", "wrist", "hip", "knee", "ankle", "foot"))],
        ["Pelvis", *(s + n for s in "LR" for n in (
            "Shoulder", "Elbow", "Wrist", "Hip", "Knee", "Ankle", "Toe"))],
    ],
    ids=["mixamo", "smpl", "short"],
)  # fmt: skip
def test_common_skeletons_are_recognised(names):
    columns = {k: c[0] for k, c in recognise(names).columns.items()}
    for s, k in (("L", 1), ("R", 8)):
        order = ("Shoulder", "Elbow", "Hand", "Hip", "Knee", "Foot", "Foot.toe")
        assert [columns[s + n] for n in order] == list(range(k, k + 7))
    assert columns["Pelvis"] == 0


@pytest.mark.parametrize(
    ("fields", "field"),
    [
        ({"speed": 3}, "speed"),
        ({"rate": 0}, "rate"),
        ({"rate": None}, "rate"),
        ({"names": None}, "names"),
        ({"names": NAMES[:-1]}, "names"),
        ({"names": [*NAMES[:-1], NAMES[0]]}, "names"),
        ({"names": ["X" if n == "LeftLeg" else n for n in NAMES]}, "names"),
        ({"unit": "inch"}, "unit"),
        ({"span": [1.0, 1.0]}, "span"),
        ({"span": [50.0, 60.0]}, "span"),
        ({"ground": "sofa"}, "ground"),
        ({"parts": {"LHand": "Nose"}}, "parts.LHand"),
        ({"parts": {"LTail": "LeftLeg"}}, "parts"),
        ({"offsets": {"Nose": 0.1}}, "offsets"),
        ({"offsets": {"Knee": 7}}, "offsets.Knee"),
        ({"subject": "Nobody"}, "subject"),
        ({"up": "w"}, "up"),
    ],
    ids=str,
)
def test_a_wrong_field_is_named(write, fields, field):
    path = write(**fields)
    with pytest.raises(InputError) as e:
        load_demo(path)
    assert e.value.field == field
    assert str(e.value.source) in (str(path), str(path.with_name("joints.npy")))


@pytest.mark.parametrize("key", ["file", "names", "boxes"])
def test_a_file_that_is_not_there_is_named(write, tmp_path, key):
    with pytest.raises(InputError) as e:
        load_demo(write(**{key: "none.obj"}))
    assert e.value.source == tmp_path / "none.obj"


def test_an_error_says_in_one_sentence_where_what_and_what_was_expected(write):
    path = write(ground="sofa")
    with pytest.raises(InputError) as e:
        load_demo(path)
    assert str(e.value) == (
        f"{path}: ground is 'sofa'; expected floor or one of the boxes []"
    )


@pytest.mark.parametrize(
    ("array", "field"),
    [
        (np.zeros((10, 15)), "shape"),
        (np.zeros((0, 15, 3)), "shape"),
        (np.full((30, 15, 3), np.nan), "LHand"),
        (np.full((30, 15, 3), "x"), "dtype"),
        (2.5 * standing(), "unit"),
    ],
    ids=["flat", "empty", "nan", "text", "giant"],
)
def test_a_wrong_array_is_refused_with_the_reason(write, array, field):
    with pytest.raises(InputError) as e:
        load_demo(write(array))
    assert e.value.field == field


@pytest.mark.parametrize(("unit", "scale"), [("mm", 1000.0), ("cm", 100.0)])
def test_a_unit_that_is_not_said_is_told_from_the_shank(write, unit, scale):
    demo = load_demo(write(scale * standing()))
    np.testing.assert_allclose(demo.position, load_demo(write()).position, atol=1e-9)
    assert any(f"so these are {unit}" in n for n in demo.notes)
    with pytest.raises(InputError, match=f"unit: {unit}"):
        load_demo(write(scale * standing(), unit="m"))


@pytest.mark.parametrize(
    "text",
    ["", "v 0 0 0\n", "v 0 zero 0\n",
     box_obj([1, 1, 1], [0, 0, 0.5], 0.0).replace("0.5", "0.8", 1)],
    ids=["empty", "a point", "a word", "no box"],
)  # fmt: skip
def test_an_obj_of_no_boxes_is_refused(tmp_path, text):
    (tmp_path / "b.obj").write_text(text)
    with pytest.raises(InputError):
        read_obj(tmp_path / "b.obj")


@pytest.mark.parametrize("name", ["clmb", "recording.csv", "none.yaml", "none.npy"])
def test_an_unknown_recording_is_refused(name):
    with pytest.raises(InputError, match=name):
        load_demo(name)


def test_bare_arrays_are_read_with_names_and_rate(tmp_path):
    np.save(tmp_path / "a.npy", standing())
    np.savez(tmp_path / "b.npz", positions=standing(), names=NAMES, rate=30.0)
    a = load_demo(tmp_path / "a.npy", names=NAMES, rate=30.0)
    b = load_demo(tmp_path / "b.npz")
    np.testing.assert_array_equal(a.position, b.position)
    np.testing.assert_array_equal(a.t, b.t)
    with pytest.raises(InputError, match="rate"):
        load_demo(tmp_path / "a.npy", names=NAMES)


def test_a_demonstration_keeps_its_arrays(write):
    demo = load_demo(write())
    with pytest.raises(ValueError, match="read-only"):
        demo.position[0, 0, 0] = 1.0
    with pytest.raises(ValueError, match="increase"):
        Demonstration(
            source="x", t=demo.t[::-1], names=demo.names, position=demo.position,
            valid=demo.valid, scene=demo.scene, subject={},
        )  # fmt: skip


def test_a_demonstration_says_itself_shortly(write):
    demo = load_demo(write())
    assert len(repr(demo)) < 300
    points = read_points(write().with_name("joints.npy"), names=NAMES, rate=30.0)
    assert "position=array(60, 15, 3)" in repr(points)


def test_a_point_never_seen_is_dropped_unless_it_is_needed():
    p = standing()
    p[:, NAMES.index("LeftToeBase")] = np.nan
    columns = {k: c[0] for k, c in recognise(NAMES).columns.items()}
    demo = build_demonstration(
        RawTracks(
            source="x",
            names=tuple(columns),
            position=p[:, list(columns.values())],
            rate=30.0,
            scene=Scene(start=np.zeros(3)),
        )
    )
    assert "LFoot.toe" not in demo.names
    assert "RFoot.toe" in demo.names


def test_runs_are_half_open_ranges():
    assert runs(np.array([1, 0, 1, 1, 0, 1], dtype=bool)) == [(0, 1), (2, 4), (5, 6)]
    assert runs(np.zeros(3, dtype=bool)) == []


def test_importing_demonstrations_does_not_import_scipy():
    code = "import sys, clamber.recording.recording; sys.exit('scipy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_the_real_climb_of_the_examples_is_0_48_m_high(shared):
    if not (shared / "demos/climb-0").is_dir():
        pytest.skip("the recording is not there")
    demo = load_demo(Path(__file__).parents[1] / "examples/recordings/climb-0.yaml")
    assert demo.scene.boxes[0].top.position[2] == pytest.approx(0.48, abs=1e-6)
    np.testing.assert_allclose(demo.scene.boxes[0].size, [1.6, 0.48, 0.48], atol=1e-3)
    for segment, (_, _, length) in SEGMENTS.items():
        assert demo.subject[segment] == pytest.approx(length, abs=1e-3)
    assert demo.subject["knee_height"] == pytest.approx(0.533, abs=0.01)
