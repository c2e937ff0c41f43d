"""Files that are not quite as their formats say open all the same, with a note."""

from __future__ import annotations

import itertools
import pickle
import struct
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import yaml

from clamber.errors import InputError
from clamber.model.robot import load_robot
from clamber.model.scene import Box, Scene
from clamber.model.terrain import load_scene
from clamber.model.world import build_world
from clamber.planning.planner import plan
from clamber.recording.demonstration import Demonstration
from clamber.recording.detect import detect_contacts
from clamber.recording.levels import find_floor
from clamber.recording.pickles import as_array, read_pickle
from clamber.recording.recording import load_demo, read_points
from clamber.run.folder import load_sequence
from support.bodies import REST, body_model, body_motion, robot_motion
from support.climb import ClimbOptions, synthesize_climb
from support.files import bvh_text, c3d_bytes, from_z_up, trc_text

UP = np.array([0.0, 0.0, 1.0])
FLOOR = Scene(start=np.zeros(3))


@cache
def climb(**options) -> tuple[Demonstration, list]:
    options = {"rate": 30.0, "gaps": 0, **options}
    return synthesize_climb(np.random.default_rng(7), options=ClimbOptions(**options))


def npz(path: Path, demo: Demonstration, up: float = 0.0, **more) -> Path:
    """The demonstration as an array, moved."""
    p = demo.position + up * UP
    np.savez(path, positions=p, names=demo.names, rate=demo.rate, **more)
    return path


def described(path: Path, **said) -> Path:
    path.write_text(yaml.safe_dump(said))
    return path


def found(demo: Demonstration, scene: Scene | None = None) -> set[tuple[str, str]]:
    intervals = detect_contacts(demo, scene=scene).intervals
    return {(i.part, i.contact.support) for i in intervals}


# TRC.


def lines() -> list[str]:
    demo, _ = climb()
    p = from_z_up(1000.0 * demo.position[:40], "y")
    return trc_text(p, demo.names, 30.0).splitlines()


def doubled(x: list[str]) -> list[str]:
    return [x[0], *(line.replace("\t", "\t\t") for line in x[1:3]), *x[3:]]


def blanks(x: list[str]) -> list[str]:
    return [x[0], x[1], "  " + x[2].replace("\t", " \t  "), x[3].replace("\t", "\t "),
            *x[4:]]  # fmt: skip


def surplus(x: list[str]) -> list[str]:
    return [*x[:6], *(line + "\t" * (k % 7) for k, line in enumerate(x[6:]))]


def ragged(x: list[str]) -> list[str]:
    return [*x[:6], *("\t".join(line.split("\t")[:-3]) for line in x[6:])]


def count(key: str, said: str):
    def change(x: list[str]) -> list[str]:
        cells = x[2].split("\t")
        cells[x[1].split("\t").index(key)] = said
        return [*x[:2], "\t".join(cells), *x[3:]]

    return change


def comma_decimal(x: list[str]) -> list[str]:
    return [
        *x[:2],
        x[2].replace(".", ","),
        *x[3:6],
        *(s.replace(".", ",") for s in x[6:]),
    ]


def semicolons(x: list[str]) -> list[str]:
    return [line.replace("\t", ";") for line in comma_decimal(x)]


def commas(x: list[str]) -> list[str]:
    return [line.replace("\t", ",") for line in x]


def no_rate(x: list[str]) -> list[str]:
    return [x[0], x[1].replace("DataRate", "Rate"), *x[2:]]


@pytest.mark.parametrize(
    ("change", "note"),
    [
        (doubled, None), (blanks, None), (surplus, None), (ragged, None),
        (comma_decimal, None), (semicolons, None), (commas, None),
        (count("NumFrames", "41"), "NumFrames says 41, the file has 40 rows"),
        (count("NumFrames", "7"), "NumFrames says 7, the file has 40 rows"),
        (count("NumMarkers", "20"), "NumMarkers says 20, the file has 21 names"),
        (count("Units", "furlong"), "'furlong' is no unit of length: ignored"),
        (count("Units", "[mm]"), None), (count("Units", "Millimeters"), None),
        (no_rate, "30 Hz by the times"),
    ],
    ids=[
        "doubled tabs", "blanks", "surplus cells", "gaps left out", "decimal commas",
        "semicolons", "commas", "a frame fewer", "frames more", "markers more",
        "an odd unit", "a unit in brackets", "a unit written out", "no rate",
    ],
)  # fmt: skip
def test_a_trc_of_another_program_is_read(tmp_path, change, note):
    demo, _ = climb()
    path = tmp_path / "a.trc"
    path.write_text("\n".join(change(lines())) + "\n")
    back = load_demo(path)
    assert back.rate == pytest.approx(30.0, rel=1e-5)
    np.testing.assert_allclose(back.point("LKnee"), demo.point("LKnee")[:40], atol=1e-6)
    last = demo.names[-1]
    assert (last in back.names) == (change is not ragged)
    said = [n for n in back.notes[2:] if "gap" not in n]
    assert len(said) == (note is not None)
    assert note is None or note in said[0]


def test_a_marker_without_a_name_does_not_shift_the_others(tmp_path):
    demo, _ = climb()
    x = lines()
    x[3] = x[3].replace("Neck", "")
    (tmp_path / "a.trc").write_text("\n".join(x))
    points = read_points(tmp_path / "a.trc")
    assert "Neck" not in points.names
    at = points.names.index("RKnee")
    expected = from_z_up(1000.0 * demo.point("RKnee")[:40], "y")
    np.testing.assert_allclose(points.position[:, at], expected, atol=1e-3)


# C3D.


def test_a_c3d_one_frame_short_is_read_and_one_cut_in_half_is_not(tmp_path):
    demo, _ = climb()
    p = 1000.0 * demo.position[:50]
    raw = c3d_bytes(p, demo.names, rate=30.0, screen="+Z")
    row = 16 * len(demo.names)
    path = tmp_path / "a.c3d"
    path.write_bytes(raw[:-row])
    back = load_demo(path)
    assert len(back.t) == 49
    assert "it says 50 samples and ends after 49" in back.notes
    path.write_bytes(raw[: -25 * row])
    with pytest.raises(InputError, match="the file ends after 25"):
        load_demo(path)


def test_an_odd_unit_of_a_c3d_is_told_from_the_person_unless_it_is_said(tmp_path):
    demo, _ = climb()
    raw = c3d_bytes(1000.0 * demo.position[:50], demo.names, rate=30.0, screen="+Z")
    (tmp_path / "a.c3d").write_bytes(raw.replace(b"\x02mm", b"\x02qq"))
    back = load_demo(tmp_path / "a.c3d")
    np.testing.assert_allclose(back.point("Neck"), demo.point("Neck")[:50], atol=1e-6)
    assert any("'qq' is no unit" in n for n in back.notes)
    said = described(tmp_path / "r.yaml", file="a.c3d", unit=0.0008)
    np.testing.assert_allclose(
        load_demo(said).point("Neck"), 0.8 * demo.point("Neck")[:50], atol=1e-6
    )


@pytest.mark.parametrize("by_rows", [False, True])
def test_rigid_bodies_of_a_c3d_without_points_are_read(tmp_path, by_rows):
    """As Theia writes them: a block of 4 x 4 matrices, each with a 17th number."""
    demo, truth = climb()
    p = 1000.0 * demo.position
    words = {"Hip": "thigh", "Knee": "shank", "Foot": "foot", "Foot.toe": "toes",
             "Shoulder": "uarm", "Elbow": "larm", "Hand": "hand"}  # fmt: skip
    kept = [n for n in demo.names if n[1:] in words or n == "Pelvis"]
    labels = [
        "pelvis_4X4" if n == "Pelvis" else f"{n[0].lower()}_{words[n[1:]]}_4X4"
        for n in kept
    ]
    matrix = np.tile(np.eye(4), (len(p), len(kept), 1, 1))
    matrix[..., :3, 3] = p[:, [demo.names.index(n) for n in kept]]
    x = np.zeros((len(p), len(kept), 17))
    matrix = matrix if by_rows else np.swapaxes(matrix, 2, 3)
    x[..., :16] = matrix.reshape(len(p), len(kept), 16)
    (tmp_path / "a.c3d").write_bytes(bodies_c3d(x, labels, demo.rate))
    back = load_demo(tmp_path / "a.c3d", scene=demo.scene)
    assert "Theia segments" in back.notes[0]
    np.testing.assert_allclose(back.point("LKnee"), demo.point("LKnee"), atol=1e-6)
    feet = {(i.part, i.contact.support) for i in truth if i.part.endswith("Foot")}
    assert feet <= found(back)


def bodies_c3d(x: np.ndarray, labels: list[str], rate: float) -> bytes:
    """A C3D of rotations (T, K, 17) and nothing else."""

    def parameter(name: str, group: int, kind: int, sizes: list[int], data: bytes):
        body = struct.pack("bB", kind, len(sizes)) + bytes(sizes) + data + b"\0"
        step = struct.pack("<h", len(body) + 2)
        return struct.pack("bb", len(name), group) + name.encode() + step + body

    def group(name: str, number: int) -> bytes:
        head = struct.pack("bb", len(name), -number) + name.encode()
        return head + struct.pack("<h", 3) + b"\0"

    wide = max(map(len, labels))
    parts = group("POINT", 1) + parameter("UNITS", 1, -1, [2], b"mm")
    parts += parameter("USED", 1, 2, [], struct.pack("<h", 0))
    parts += group("ROTATION", 2)
    parts += parameter("USED", 2, 2, [], struct.pack("<h", len(labels)))
    text = b"".join(n.encode().ljust(wide) for n in labels)
    parts += parameter("LABELS", 2, -1, [wide, len(labels)], text)
    blocks = -(-(4 + len(parts) + 40) // 512)
    parts += parameter("DATA_START", 2, 2, [], struct.pack("<h", 2 + blocks))
    parts += parameter("RATE", 2, 4, [], struct.pack("<f", rate))
    section = (bytes([1, 0x50, blocks, 84]) + parts).ljust(512 * blocks, b"\0")
    head = bytes([2, 0x50]) + struct.pack("<HHHHH", 0, 0, 1, len(x), 0)
    head += struct.pack("<fHH", -1.0, 2 + blocks, 0) + struct.pack("<f", rate)
    return head.ljust(512, b"\0") + section + x.astype("<f4").tobytes()


def test_a_c3d_by_another_name_and_a_trc_called_c3d_are_told_by_what_they_hold(
    tmp_path,
):
    demo, _ = climb()
    raw = c3d_bytes(1000.0 * demo.position[:9], demo.names, rate=30.0)
    (tmp_path / "a.trc").write_bytes(raw)
    assert read_points(tmp_path / "a.trc").names == demo.names
    (tmp_path / "b.c3d").write_text("\n".join(lines()))
    assert read_points(tmp_path / "b.c3d").names == demo.names


# Several people.


def test_two_people_of_a_bvh_are_told_apart(tmp_path):
    demo, _ = climb()
    few = replace(demo, t=demo.t[:9], position=demo.position[:9], valid=demo.valid[:9])
    head, _, rows = bvh_text(few, 100 * from_z_up(few.position, "y"), "ZXY").partition(
        "MOTION\n"
    )
    frames, step, *data = rows.splitlines()
    both = [f"{r} {r}" for r in data]
    text = head + head.removeprefix("HIERARCHY\n") + "MOTION\n" + frames + "\n" + step
    (tmp_path / "a.bvh").write_text("\n".join([text, *both]))
    with pytest.raises(InputError, match=r"subject.*'1', '2'"):
        load_demo(tmp_path / "a.bvh")
    back = load_demo(tmp_path / "a.bvh", subject="2")
    np.testing.assert_allclose(back.point("LKnee"), few.point("LKnee"), atol=1e-5)


def test_landmarks_of_mediapipe_need_no_names(tmp_path):
    """FreeMoCap's array: 33 points in millimetres."""
    demo, _ = climb()
    order = {"Shoulder": 11, "Elbow": 13, "Hand": 15, "Hip": 23, "Knee": 25, "Foot": 27,
             "Foot.toe": 31}  # fmt: skip
    p = np.zeros((len(demo.t), 33, 3))
    for word, k in order.items():
        p[:, k], p[:, k + 1] = (1000.0 * demo.point(s + word) for s in "LR")
    np.save(tmp_path / "a.npy", p)
    back = load_demo(tmp_path / "a.npy", rate=30.0)
    assert "MediaPipe landmarks" in back.notes[0]
    np.testing.assert_allclose(back.point("RKnee"), demo.point("RKnee"))


# Floors.


@pytest.mark.parametrize("off", [0.034, -0.05, 0.09])
def test_a_floor_centimetres_off_is_mended_unasked_and_said(tmp_path, off):
    demo, truth = climb(noise=0.001)
    true = {(i.part, i.contact.support) for i in truth}
    plain = load_demo(npz(tmp_path / "a.npz", demo), scene=demo.scene)
    back = load_demo(npz(tmp_path / "b.npz", demo, off), scene=demo.scene)
    np.testing.assert_allclose(back.position, plain.position, atol=5e-3)
    assert not any("floor" in n for n in plain.notes)
    way = "above" if off > 0 else "below"
    assert any(f"{abs(off):.3f} m {way} the floor" in n for n in back.notes)
    assert true <= found(back)
    kept = described(tmp_path / "r.yaml", file="b.npz", offset=0.0)
    np.testing.assert_allclose(
        load_demo(kept).point("LKnee"), back.point("LKnee") + off * UP, atol=5e-3
    )


@pytest.mark.parametrize("off", [0.15, 0.6, -0.15, -0.9])
def test_a_floor_far_off_is_said_and_mended_when_asked(tmp_path, off):
    demo, _ = climb()
    path = npz(tmp_path / "a.npz", demo, off)
    way = "above" if off > 0 else "below"
    with pytest.raises(InputError) as e:
        detect_contacts(load_demo(path))
    said = str(e.value)
    assert f"{abs(off):.3f} m {way} the floor" in said
    assert "--fit-floor" in said
    assert f"offset: {-off:.3f} in a recording.yaml" in said
    plain = load_demo(npz(tmp_path / "b.npz", demo))
    fitted = load_demo(path, fit_floor=True)
    np.testing.assert_allclose(fitted.position, plain.position, atol=5e-3)
    moved = load_demo(described(tmp_path / "r.yaml", file="a.npz", offset=-off))
    np.testing.assert_allclose(moved.position, plain.position, atol=1e-9)
    assert found(moved) == found(plain)


def test_one_hand_on_the_ground_is_no_person_under_the_floor(tmp_path):
    demo, _ = climb()
    p = demo.position - 0.9 * UP
    p[:, [demo.names.index(n) for n in demo.names if n.startswith("LHand")], 2] = 0.02
    np.savez(tmp_path / "a.npz", positions=p, names=demo.names, rate=demo.rate)
    with pytest.raises(InputError, match=r"a person over the floor.*0\.900 m below"):
        load_demo(tmp_path / "a.npz")


def test_who_never_rests_is_told_how_high_the_feet_are(tmp_path):
    demo, _ = climb()
    t = np.arange(60) / 30.0
    p = np.repeat(demo.position[:1], 60, axis=0)
    p[..., 0] += 2.0 * t[:, None]
    p[..., 2] += 3.0
    np.savez(tmp_path / "a.npz", positions=p, names=demo.names, rate=30.0)
    back = load_demo(tmp_path / "a.npz")
    assert find_floor(back) is None
    with pytest.raises(InputError, match=r"feet never rest, and are 3\.0. to 3\.\d+ m"):
        detect_contacts(back)


def test_offset_and_rotation_move_the_person_and_the_boxes_drawn_with_it(tmp_path):
    demo, _ = climb()
    npz(tmp_path / "a.npz", demo)
    corners = itertools.product((0.5, 1.5), (-0.5, 0.5), (0.0, 0.4))
    obj = "\n".join("v {} {} {}".format(*c) for c in corners)
    (tmp_path / "b.obj").write_text(obj)
    said = {"file": "a.npz", "boxes": "b.obj", "offset": [0.1, 0.2, 0.0],
            "rotation": [0.0, 0.0, np.pi / 2]}  # fmt: skip
    back = load_demo(described(tmp_path / "r.yaml", **said))
    p = demo.point("Neck")
    expected = np.stack([0.1 - p[:, 1], 0.2 + p[:, 0], p[:, 2]], axis=1)
    np.testing.assert_allclose(back.point("Neck"), expected, atol=1e-9)
    (box,) = back.scene.boxes
    np.testing.assert_allclose(box.centre, [0.1, 1.2, 0.2], atol=1e-9)


# What is no recording at all.

DISGUISED = {
    "a Git LFS pointer": b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n",
    "a web page": b"\n<!DOCTYPE html><html><head></head></html>",
    "a gzip archive": b"\x1f\x8b\x08\0\0\0\0\0",
    "an HDF5 or MATLAB file": b"\x89HDF\r\n\x1a\n",
    "an FBX file": b"Kaydara FBX Binary  \0",
    "a picture": b"\x89PNG\r\n\x1a\n",
}


@pytest.mark.parametrize("kind", [*DISGUISED, "empty"])
@pytest.mark.parametrize(
    "suffix", ["bvh", "c3d", "trc", "csv", "npy", "npz", "pkl", "yaml", "obj", "xml",
               "urdf", "sdf"],
)  # fmt: skip
def test_another_kind_of_file_is_told_from_its_first_bytes(tmp_path, kind, suffix):
    path = tmp_path / f"a.{suffix}"
    path.write_bytes(DISGUISED.get(kind, b""))
    drawn = suffix in ("obj", "xml", "urdf", "sdf")
    with pytest.raises(InputError, match=kind) as e:
        (load_scene if drawn else load_demo)(path)
    assert str(path) in str(e.value)


@pytest.mark.parametrize(
    ("name", "content", "told"),
    [
        ("a.tsv", "NO_OF_FRAMES\t2\nNO_OF_CAMERAS\t8\n", "Qualisys: export it as C3D"),
        ("a.csv", "Trajectories\n100\n,,Anna:LASI,,\n", "Nexus: export it as C3D"),
        ("a.mot", "Coordinates\nversion=1\nnRows=2\n", "give the markers' TRC"),
        ("a.sto", "Coordinates\nversion=1\nnRows=2\n", "give the markers' TRC"),
        ("a.amc", "#!OML:ASF\n:FULLY-SPECIFIED\n", "with its ASF to BVH"),
        ("a.asf", "# AST/ASF file\n:version 1.10\n", "with its AMC to BVH"),
        ("a.usd", "PXR-USDC\0\0", "a USD file: export it"),
        ("a.mat", "MATLAB 7.3 MAT-file, Platform", "positions, names and rate"),
        ("a.qtm", b"\xd0\xcf\x11\xe0\xa1\xb1", "export it as C3D"),
        ("a.json", '{"version": 1.3, "people": []}', "positions, names and rate"),
        ("a.csv", "nose_x,nose_y,nose_z\n0,1,2\n", "positions.*, names and rate"),
    ],
)
def test_recordings_that_are_not_read_say_what_to_do(tmp_path, name, content, told):
    raw = content if isinstance(content, bytes) else content.encode()
    (tmp_path / name).write_bytes(raw)
    with pytest.raises(InputError, match=told) as e:
        read_points(tmp_path / name)
    assert "\n" not in str(e.value)


def test_a_zip_and_a_file_of_another_kind_are_told(tmp_path):
    (tmp_path / "a.bvh").write_bytes(b"PK\x03\x04" + b"\0" * 30)
    with pytest.raises(InputError):
        load_demo(tmp_path / "a.bvh")
    (tmp_path / "s.yaml").write_text("HIERARCHY\nROOT Hips\n")
    with pytest.raises(InputError, match="YAML; this is a BVH recording"):
        load_scene(tmp_path / "s.yaml")
    (tmp_path / "s.obj").write_text("<robot name='a'/>")
    with pytest.raises(InputError, match="an OBJ; this is a URDF"):
        load_scene(tmp_path / "s.obj")
    (tmp_path / "robot.yaml").write_bytes(DISGUISED["a Git LFS pointer"])
    with pytest.raises(InputError, match="Git LFS"):
        load_robot(tmp_path / "robot.yaml")


def test_meshes_and_files_of_runs_are_told_too(tmp_path):
    pointer = DISGUISED["a Git LFS pointer"]
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "m.stl").write_bytes(pointer)
    (tmp_path / "s.xml").write_text(
        """<mujoco><compiler meshdir="meshes"/><asset><mesh name="m" file="m.stl"/>
        </asset><worldbody><geom type="mesh" mesh="m"/></worldbody></mujoco>"""
    )
    (tmp_path / "s.urdf").write_text(
        """<robot name="r"><link name="top"><collision><geometry>
        <mesh filename="meshes/m.stl"/></geometry></collision></link></robot>"""
    )
    for name in ("s.xml", "s.urdf"):
        with pytest.raises(InputError, match=r"m\.stl.*Git LFS pointer"):
            load_scene(tmp_path / name)
    (tmp_path / "sequence.json").write_bytes(pointer)
    with pytest.raises(InputError, match="a JSON file; this is a Git LFS pointer"):
        load_sequence(tmp_path / "sequence.json")


# SMPL.


def test_poses_alone_say_what_is_needed(tmp_path):
    np.savez(tmp_path / "a.npz", **body_motion())
    with pytest.raises(InputError, match=r"poses, trans and betas alone.*--body-model"):
        load_demo(tmp_path / "a.npz")


@pytest.mark.parametrize("kind", ["npz", "pkl 2", "pkl 5"])
@pytest.mark.parametrize("joints", [22, 24])
def test_joints_follow_from_poses_and_the_model(tmp_path, kind, joints):
    model, motion = body_model(joints), body_motion(joints)
    file = tmp_path / ("m.npz" if kind == "npz" else "m.pkl")
    if kind == "npz":
        np.savez(file, **model)
    else:
        file.write_bytes(pickle.dumps(model, protocol=int(kind[-1])))
    np.savez(tmp_path / "a.npz", **motion)
    demo = load_demo(tmp_path / "a.npz", body_model=file)
    rest = REST * (1.0 + 0.05) + REST * [-0.05, 0, 0]  # of betas 0.5, -0.5
    upright = np.stack([rest[:, 0], -rest[:, 2], rest[:, 1]], axis=1)
    place = upright - upright[0] + rest[0] + [0.5, 0.1, 1.01]
    for name, k in (("LKnee", 4), ("LFoot", 7), ("RHand", 21), ("RFoot", 8)):
        np.testing.assert_allclose(demo.point(name)[0], place[k], atol=1e-6)
    shin = place[7] - place[4]
    c, s = np.cos(0.8), np.sin(0.8)  # the left knee bends at last about its own x
    bent = place[4] + [shin[0], c * shin[1] - s * shin[2], s * shin[1] + c * shin[2]]
    np.testing.assert_allclose(demo.point("LFoot")[-1], bent, atol=1e-6)
    assert ("RFoot", "ground") in found(demo)
    said = described(tmp_path / "r.yaml", file="a.npz", body_model=file.name)
    np.testing.assert_array_equal(load_demo(said).position, demo.position)


def test_joints_in_the_file_need_no_model(tmp_path):
    demo, _ = climb()
    more = {k: v for k, v in body_motion().items() if k != "mocap_framerate"}
    back = load_demo(npz(tmp_path / "a.npz", demo, **more))
    np.testing.assert_allclose(back.point("LKnee"), demo.point("LKnee"))


def test_a_wrong_body_model_is_named(tmp_path):
    np.savez(tmp_path / "a.npz", **body_motion())
    model = body_model()
    for change in ({"J_regressor": np.eye(3)}, {"kintree_table": np.ones((2, 24), int)},
                   {"v_template": np.zeros((5, 3))}):  # fmt: skip
        np.savez(tmp_path / "m.npz", **{**model, **change})
        with pytest.raises(InputError, match=r"m\.npz"):
            load_demo(tmp_path / "a.npz", body_model=tmp_path / "m.npz")
    model.pop("shapedirs")
    np.savez(tmp_path / "m.npz", **model)
    with pytest.raises(InputError, match="shapedirs"):
        load_demo(tmp_path / "a.npz", body_model=tmp_path / "m.npz")


# Pickles.


class Evil:
    """Would run a program, were it unpickled."""

    def __reduce__(self):
        return Path.touch, (Path("/nowhere/touched"),)


def test_a_pickle_that_calls_anything_is_refused_without_calling_it(tmp_path):
    flag = tmp_path / "touched"
    for call in (b"cposix\nsystem\n", b"cbuiltins\neval\n", b"cos\nsystem\n",
                 b"cnumpy\nload\n", b"cbuiltins\ngetattr\n"):  # fmt: skip
        raw = b"\x80\x02" + call + f"(S'touch {flag}'\ntR.".encode()
        (tmp_path / "a.pkl").write_bytes(raw)
        with pytest.raises(InputError, match="not allowed"):
            read_pickle(tmp_path / "a.pkl")
    (tmp_path / "a.pkl").write_bytes(pickle.dumps({"poses": Evil()}))
    with pytest.raises(InputError, match="not allowed"):
        load_demo(tmp_path / "a.pkl")
    assert not flag.exists()


def test_a_pickle_cut_anywhere_is_refused(tmp_path):
    raw = pickle.dumps({"a": 2.5, "b": np.arange(3), "c": ["x", 1]}, protocol=2)
    for k in range(2, len(raw)):
        (tmp_path / "a.pkl").write_bytes(raw[:k])
        with pytest.raises(InputError, match="a pickle"):
            read_pickle(tmp_path / "a.pkl")


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_arrays_come_back_as_they_were(tmp_path, protocol):
    there = {
        "f": np.arange(12.0).reshape(3, 4), "F": np.asfortranarray(np.eye(3)[:, :2]),
        "i": np.arange(5, dtype=">i2"), "b": np.array([True, False]),
        "s": np.array(["a", "bc"]), "one": np.float32(2.5), "list": [1, (2.0, "x")],
        "none": None,
    }  # fmt: skip
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(there, protocol=protocol))
    back = read_pickle(tmp_path / "a.pkl")
    for key in "fFibs":
        np.testing.assert_array_equal(back[key], there[key])
    assert back["one"] == 2.5
    assert back["list"] == [1, [2.0, "x"]]


def test_sparse_matrices_are_read_as_what_they_hold(tmp_path):
    sparse = pytest.importorskip("scipy.sparse")
    dense = np.array([[0, 1.5, 0], [2, 0, 0], [0, 0, 0], [0, 3, 4]])
    for made in (sparse.csc_matrix(dense), sparse.csr_matrix(dense)):
        (tmp_path / "a.pkl").write_bytes(pickle.dumps({"J": made}, protocol=2))
        np.testing.assert_array_equal(
            as_array(read_pickle(tmp_path / "a.pkl")["J"]), dense
        )


# A robot's motion.


def test_a_robots_motion_is_a_demonstration(tmp_path):
    motion = robot_motion("coman")
    path = tmp_path / "a.pkl"
    path.write_bytes(pickle.dumps(motion))
    with pytest.raises(InputError, match="--demo-robot"):
        load_demo(path)
    demo = load_demo(path, robot="coman")
    assert any("quaternions x y z w" in n for n in demo.notes)
    left = demo.point("LHip")[0] - demo.point("RHip")[0]
    assert np.arctan2(-left[0], left[1]) == pytest.approx(1.0, abs=1e-3)  # its yaw
    middle = (demo.point("LFoot")[0] + demo.point("RFoot")[0]) / 2
    np.testing.assert_allclose(middle[:2], [0.3, 0.2], atol=5e-3)
    assert found(demo) == {("LFoot", "ground"), ("RFoot", "ground")}


@pytest.mark.parametrize(
    "form", ["qpos", "frames", "bodies", "named", "whole", "nested"]
)
def test_the_words_of_other_tools_say_the_same(tmp_path, form):
    motion = robot_motion("coman", samples=8)
    root, turn, dof = (motion[k] for k in ("root_pos", "root_rot", "dof_pos"))
    w_first = turn[:, [3, 0, 1, 2]]
    angle = 2 * np.arctan2(turn[:, 2], turn[:, 3])
    names = None
    (tmp_path / "plain.pkl").write_bytes(pickle.dumps(motion))
    expected = load_demo(tmp_path / "plain.pkl", robot="coman").position
    path = tmp_path / (
        "a.npz" if form in ("qpos", "bodies", "named", "whole") else "a.pkl"
    )
    if form == "qpos":
        np.savez(path, qpos=np.hstack([root, w_first, dof]), fps=30)
    elif form == "bodies":
        np.savez(path, joint_pos=dof, body_pos_w=root[:, None].repeat(2, axis=1),
                 body_quat_w=w_first[:, None].repeat(2, axis=1), fps=[30])  # fmt: skip
    elif form == "whole":  # and the first of its bodies is the world
        names = np.array(build_world(load_robot("coman"), FLOOR).joints)
        world = np.zeros((len(root), 2, 3)), np.tile([1.0, 0, 0, 0], (len(root), 2, 1))
        np.savez(path, joint_pos=np.hstack([root, w_first, dof]), joint_names=names,
                 body_pos_w=world[0], body_quat_w=world[1], fps=[30])  # fmt: skip
    elif form == "named":
        names = np.array(build_world(load_robot("coman"), FLOOR).joints)
        np.savez(path, root_pos=root, root_quat=w_first, dof_pos=dof[:, ::-1],
                 dof_names=names[::-1], fps=30)  # fmt: skip
    elif form == "frames":
        vector = np.stack([0 * angle, 0 * angle, angle], axis=1)
        frames = np.hstack([root, vector, dof]).tolist()
        path.write_bytes(pickle.dumps({"loop_mode": 0, "fps": 30, "frames": frames}))
    else:
        plain = {"root_trans_offset": root, "root_rot": turn, "dof": dof, "fps": 30}
        path.write_bytes(pickle.dumps({"walk": plain, "run": plain}))
        with pytest.raises(InputError, match=r"subject.*'run', 'walk'"):
            load_demo(path, robot="coman")
    subject = "walk" if form == "nested" else None
    back = load_demo(path, robot="coman", subject=subject)
    np.testing.assert_allclose(back.position, expected, atol=1e-5)


@pytest.mark.slow
def test_the_motion_of_a_climb_says_which_contacts_it_makes(
    tmp_path, coman, demo_sequence
):
    """A plan's own motion gives its contacts back in their order, and a plan again."""
    scene = Scene.from_height(0.2)
    made = plan(demo_sequence, coman, scene)
    t, world = made.trajectory.time, made.world
    q = made.trajectory.q[np.searchsorted(t, np.arange(0.0, t[-1], 1 / 30))]
    motion = {"fps": 30, "root_pos": q[:, :3], "root_rot": q[:, [4, 5, 6, 3]],
              "dof_pos": q[:, world.qadr]}  # fmt: skip
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(motion))
    sequence = detect_contacts(
        load_demo(tmp_path / "a.pkl", robot="coman", scene=scene)
    )
    first = {}
    for i in sorted(sequence.intervals, key=lambda i: i.t0):
        first.setdefault((i.part, i.contact.support), i.t0)
    wanted: list[tuple[str, str]] = []
    for change in made.changes:
        for c in change.keyframe.stance:
            if c.support == "box" and (c.surface, "box") not in wanted:
                wanted.append((c.surface, "box"))
    assert [k for k in first if k[1] == "box"] == wanted
    assert plan(sequence, coman, scene).complete


def test_another_robots_motion_is_refused_with_both_counts(tmp_path):
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(robot_motion("coman", samples=4)))
    with pytest.raises(
        InputError, match="joints is 23; expected 29 joints, as coman29"
    ):
        load_demo(tmp_path / "a.pkl", robot="coman29")


# Small inputs from outside, where they are there.

CASES = {
    "plain.trc": 2, "doubled-tabs.trc": 2, "more-empty-cells.trc": 2,
    "one-frame-fewer.trc": 3, "names-ue.npz": 2, "names-kinect.npz": 2,
    "names-soma.npz": 2,
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_outside_recordings_open(shared, name):
    path = shared / "cases" / "recordings" / name
    if not path.is_file():
        pytest.skip("the inputs are not there")
    demo = load_demo(path)
    assert len(demo.notes) == CASES[name]
    assert {("LFoot", "ground"), ("RFoot", "ground")} <= found(demo)


def test_outside_files_that_cannot_be_used_say_why(shared):
    cases = shared / "cases"
    if not cases.is_dir():
        pytest.skip("the inputs are not there")
    with pytest.raises(InputError, match="Git LFS pointer"):
        load_demo(cases / "recordings" / "lfs.bvh")
    high = cases / "recordings" / "floor-up01.npz"
    with pytest.raises(InputError, match=r"0\.150 m above the floor"):
        detect_contacts(load_demo(high))
    assert ("LFoot", "ground") in found(load_demo(high, fit_floor=True))
    with pytest.raises(InputError, match="up: y"):
        load_scene(cases / "scenes" / "yup.obj")
    for name, top in (("box24.obj", 0.28), ("table4.urdf", 0.29)):
        (box,) = load_scene(cases / "scenes" / name).boxes
        assert isinstance(box, Box)
        assert box.top.position[2] == pytest.approx(top)
