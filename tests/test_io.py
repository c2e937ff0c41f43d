"""Run folders: what is saved comes back, the same bytes each time, whole or not."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

import clamber
from clamber.contact.contact import Contact, ContactInterval, ContactSequence, Stance
from clamber.contact.steps import Skipped
from clamber.errors import InputError, Status
from clamber.execution.disturbance import Disturbance
from clamber.execution.simulation import Rollout
from clamber.execution.verdict import Criterion, Verdict
from clamber.model.robot import ROBOTS
from clamber.model.scene import Box, Scene
from clamber.model.se3 import matrix_from_rpy
from clamber.model.world import World
from clamber.planning.records import Plan
from clamber.planning.trajectory import Samples
from clamber.run import folder as io

HEIGHT = 0.25


def contact(surface: str, support: str, x: float, y: float, z: float) -> Contact:
    return Contact(
        surface=surface,
        support=support,
        position=np.array([x, y, z]),
        quaternion=np.array([1.0, 0.0, 0.0, 0.0]),
    )


def reach_with_one_hand(height: float) -> ContactSequence:
    """Standing before a box, then the left hand on it."""
    feet = (
        contact("LFoot", "ground", 0.03, 0.07, 0.0),
        contact("RFoot", "ground", 0.03, -0.07, 0.0),
    )
    hand = contact("LHand", "box", 0.43, 0.17, height)
    trunk = {"trunk": np.array([0.6, 0.0, 0.8])}
    return ContactSequence(
        source="made up",
        subject=None,
        scene=Scene.from_height(height),
        stances=(Stance(contacts=feet), Stance(contacts=(*feet, hand), posture=trunk)),
        t=np.array([0.0, 0.1, 0.3]),
        intervals=(
            ContactInterval(
                part="LHand", is_surface=True, t0=0.1, t1=0.3, contact=hand
            ),
        ),
    )


@pytest.fixture(scope="module")
def plan() -> Plan:
    robot, scene = clamber.load_robot("coman"), Scene.from_height(HEIGHT)
    options = clamber.PlanOptions(speed=1.0)
    return clamber.plan(reach_with_one_hand(HEIGHT), robot, scene, options=options)


@pytest.fixture(scope="module")
def saved(plan: Plan, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    io.save_plan(plan, folder)
    return folder


@pytest.fixture(scope="module")
def rollout(plan: Plan) -> Rollout:
    return clamber.simulate(plan, controller="pid")


def same(a: object, b: object) -> bool:
    """Whether two records hold the same, to the last bit."""
    a, b = (np.asarray(x) if isinstance(x, Samples) else x for x in (a, b))
    if isinstance(a, np.ndarray):
        return (
            isinstance(b, np.ndarray)
            and a.dtype == b.dtype
            and a.shape == b.shape
            and np.array_equal(a, b)
        )
    if hasattr(a, "__dataclass_fields__"):
        if isinstance(a, World):  # compiled models are compared by their source
            return isinstance(b, World) and a.xml == b.xml
        return type(a) is type(b) and all(
            same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a)
        )
    if isinstance(a, (tuple, list)):
        return isinstance(b, (tuple, list)) and (
            len(a) == len(b) and all(map(same, a, b))
        )
    if isinstance(a, dict) and isinstance(b, dict):
        return a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    return a == b


def bytes_of(folder: Path) -> dict[str, bytes]:
    files = (p for p in sorted(folder.rglob("*")) if p.is_file())
    return {p.name: p.read_bytes() for p in files if p.name != io.TIMINGS}


# Folders.


def test_run_folders_are_numbered_when_the_name_is_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    made = [io.new_run_folder(None, "climb") for _ in range(3)]
    assert [str(p) for p in made] == ["runs/climb", "runs/climb-2", "runs/climb-3"]
    assert str(io.new_run_folder(None, "plan")) == "runs/plan"


def test_a_folder_that_is_asked_for_may_exist_and_may_be_deep(tmp_path: Path):
    deep = tmp_path / "a" / "b"
    assert io.new_run_folder(deep, "climb") == deep
    assert io.new_run_folder(deep, "climb") == deep
    assert list(deep.iterdir()) == []


@pytest.mark.parametrize("inside", [False, True])
def test_a_folder_that_cannot_be_made_is_named_with_the_flag(
    inside: bool, tmp_path: Path
):
    taken = tmp_path / "taken"
    taken.write_text("a file")
    with pytest.raises(
        InputError, match=r"--out is '.*taken.*; expected a folder that"
    ):
        io.new_run_folder(taken / "below" if inside else taken, "climb")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_without_permission_to_write_is_refused(tmp_path: Path):
    tmp_path.chmod(0o500)
    with pytest.raises(InputError, match="Permission denied"):
        io.new_run_folder(tmp_path / "run", "climb")


def test_an_interrupted_write_leaves_the_last_whole_file(tmp_path: Path):
    path = tmp_path / "a.json"
    path.write_text("whole")

    def interrupted() -> None:
        with io.whole_file(path) as draft:
            assert draft.suffix == path.suffix
            draft.write_text("ha")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert path.read_text() == "whole"
    assert list(tmp_path.iterdir()) == [path]
    with io.whole_file(path) as draft:
        draft.write_text("new")
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


# Sequences.


def test_a_sequence_survives_the_disk_to_the_last_bit(tmp_path: Path):
    third = reach_with_one_hand(1 / 3)
    sequence = replace(third, subject={"thigh": 0.1 + 0.2}, source="\u00dcbung")
    io.save_sequence(sequence, tmp_path / "sequence.json")
    back = io.load_sequence(tmp_path / "sequence.json")
    assert back.source == sequence.source
    assert back.subject == sequence.subject
    assert same(back.stances, sequence.stances)
    assert same(back.t, sequence.t)
    assert same(back.intervals, sequence.intervals)
    assert same(io.load_sequence(tmp_path).stances, sequence.stances)


@pytest.mark.parametrize(
    "rpy",
    [(0.3, -0.2, 1.1), (0.0, 0.0, -3.0), (0.4, np.pi / 2, 0.0), (0.1, -1.57, 2.0)],
)
def test_a_turned_and_raised_box_survives_the_disk(rpy: tuple, tmp_path: Path):
    box = Box(
        name="Cube.001",
        size=np.array([0.4, 0.5, 0.6]),
        position=np.array([1.0, -0.2, 0.45]),
        rotation=matrix_from_rpy(rpy),
        friction=0.35,
    )
    scene = Scene(
        boxes=(box,), start=np.array([0.1, 0.2, 0.3]), goal=np.array([2.0, 0.0])
    )
    stance = Stance(contacts=(contact("LFoot", "ground", 0.0, 0.0, 0.0),))
    sequence = ContactSequence(
        source="", subject=None, scene=scene, stances=(stance,), t=np.array([0.0, 1.0])
    )
    io.save_sequence(sequence, tmp_path / "s.json")
    back = io.load_sequence(tmp_path / "s.json").scene
    np.testing.assert_allclose(back.boxes[0].rotation, box.rotation, atol=1e-9)
    np.testing.assert_allclose(back.boxes[0].position, box.position, atol=1e-15)
    np.testing.assert_array_equal(back.boxes[0].size, box.size)
    assert (back.boxes[0].name, back.boxes[0].friction) == ("Cube.001", 0.35)
    np.testing.assert_array_equal(back.start, scene.start)
    np.testing.assert_array_equal(back.goal, [2.0, 0.0])


def test_a_stance_says_its_region_and_times(tmp_path: Path):
    io.save_sequence(reach_with_one_hand(0.3), tmp_path / "s.json")
    content = json.loads((tmp_path / "s.json").read_text())
    assert content["version"] == 1
    assert [s["region"] for s in content["stances"]] == ["G", "M"]
    assert [(s["t0"], s["t1"]) for s in content["stances"]] == [(0.0, 0.1), (0.1, 0.3)]
    hand = content["stances"][1]["contacts"][2]
    assert hand["surface"] == "LHand"
    assert hand["position"] == [0.43, 0.17, 0.3]
    assert "edge" not in hand


def edit(change: Callable[[dict], object]) -> Callable[[str], str]:
    def edited(text: str) -> str:
        content = json.loads(text)
        change(content)
        return json.dumps(content)

    return edited


@pytest.mark.parametrize(
    ("mistake", "said"),
    [
        (lambda text: text[: len(text) // 2], "expected a whole JSON file"),
        (lambda text: "[1]", "is 'list'; expected an object"),
        (edit(lambda c: c.update(version=2)), "version is 2; expected version 1"),
        (edit(lambda c: c.pop("version")), "version is 'absent'; expected version 1"),
        (edit(lambda c: c.pop("stances")), "stances: expected a value"),
        (edit(lambda c: c.update(stances=[])), "stances"),
        (
            edit(lambda c: c["stances"][1]["contacts"][0].update(position=[0, "a", 0])),
            "stances.1.contacts.0.position.1 is 'a'; expected a valid number",
        ),
        (
            edit(lambda c: c["stances"][1]["contacts"][0].update(support="moon")),
            "no support 'moon'; there are",
        ),
        (
            edit(lambda c: c["stances"][1]["contacts"][1].update(surface="LFoot")),
            "a surface appears twice",
        ),
        (edit(lambda c: c["stances"][1].update(t0=0.2)), "stances.1.t0 is 0.2"),
        (edit(lambda c: c["stances"][1].update(t1=0.1)), "times must increase"),
        (
            edit(lambda c: c["stances"][1].update(posture={"tail": [0, 0, 1]})),
            "unknown directions",
        ),
    ],
)
def test_a_mistake_in_a_sequence_is_named_with_its_file_and_field(
    mistake: Callable[[str], str], said: str, tmp_path: Path
):
    path = tmp_path / "s.json"
    io.save_sequence(reach_with_one_hand(0.3), path)
    path.write_text(mistake(path.read_text()))
    with pytest.raises(InputError) as e:
        io.load_sequence(path)
    assert str(path) in str(e.value)
    assert said in str(e.value)
    assert "\n" not in str(e.value)


def test_a_missing_sequence_is_one_sentence(tmp_path: Path):
    with pytest.raises(InputError, match=r"no\.json: expected a readable file"):
        io.load_sequence(tmp_path / "no.json")
    with pytest.raises(InputError, match=r"sequence\.json: expected a readable file"):
        io.load_sequence(tmp_path)


# Plans.


def test_a_plan_survives_the_disk(plan: Plan, saved: Path):
    back = io.load_plan(saved)
    assert plan.complete
    for field in fields(Plan):
        if field.name != "world":
            a, b = getattr(back, field.name), getattr(plan, field.name)
            assert same(a, b), field.name


def test_the_world_of_a_loaded_plan_is_the_one_that_planned(plan: Plan, saved: Path):
    a, b = plan.world, io.load_plan(saved).world
    assert a.xml == b.xml
    for name in ("home", "qadr", "tau_max", "kp", "kd", "ki", "pairs", "q_min", "mass"):
        assert same(getattr(a, name), getattr(b, name)), name
    assert same(dict(a.surfaces), dict(b.surfaces))
    assert a.robot.path == b.robot.path
    assert (a.robot.name, a.robot.limbs) == (b.robot.name, b.robot.limbs) or same(
        dict(a.robot.limbs), dict(b.robot.limbs)
    )


def test_a_loaded_plan_simulates_to_the_same_bits(saved: Path, rollout: Rollout):
    again = clamber.simulate(io.load_plan(saved), controller="pid")
    assert same(again, rollout)


def test_two_runs_leave_the_same_bytes(tmp_path: Path, saved: Path, rollout: Rollout):
    robot, scene = clamber.load_robot("coman"), Scene.from_height(HEIGHT)
    options = clamber.PlanOptions(speed=1.0)
    plan = clamber.plan(reach_with_one_hand(HEIGHT), robot, scene, options=options)
    io.save_plan(plan, tmp_path)
    first, second = bytes_of(saved), bytes_of(tmp_path)
    for name in (io.PLAN, io.TRAJECTORY, io.SCENE):
        assert first[name] == second[name], name
    for folder in (saved, tmp_path):
        io.save_rollout(plan, rollout, folder)
    assert (saved / io.ROLLOUT).read_bytes() == (tmp_path / io.ROLLOUT).read_bytes()


def test_plain_mujoco_loads_the_scene_and_the_trajectory_fits(saved: Path):
    model = mujoco.MjModel.from_xml_path(str(saved / "scene.xml"))
    with np.load(saved / "trajectory.npz", allow_pickle=False) as f:
        n = len(f["time"])
        assert f["qpos"].shape == (n, model.nq)
        assert f["qvel"].shape == (n, model.nv)
        assert f["contact"].shape == (n, len(f["surfaces"]))
        assert f["contact"].dtype == bool
        np.testing.assert_allclose(np.diff(f["time"]), 0.001)
        joints = [model.joint(str(j)).qposadr[0] for j in f["joint_names"]]
        assert len(joints) == model.nu
    assert model.geom("box").size[2] == pytest.approx(HEIGHT / 2)
    assert model.geom("ground").type == mujoco.mjtGeom.mjGEOM_PLANE


def test_the_plan_names_what_it_was_made_of(plan: Plan, saved: Path):
    content = json.loads((saved / "plan.json").read_text())
    assert content["version"] == 1
    assert content["options"]["speed"] == 1.0
    assert content["versions"]["mujoco"] == mujoco.__version__
    assert set(content["inputs"]) >= {"robot", "robot_model"}
    assert all(len(h) == 64 for h in content["inputs"].values())
    assert content["prefixes"]["LKnee"] == "LKnee"
    assert str(ROBOTS) not in (saved / "plan.json").read_text()
    assert content["changes"][0]["step"]["makes"]["surface"] == "LHand"
    key = content["keyframes"][-1]
    assert {c["surface"] for c in key["contacts"]} == {"LFoot", "RFoot", "LHand"}
    for c in key["contacts"]:
        assert c["projected_distance"] >= 0.0
        assert 0.0 <= c["contact_angle"] <= np.pi
        assert c["phase"] in ("supporting", "reach-to-supportable", "sliding")
    balance = key["static_equilibrium"]
    assert len(balance["forces"]) == len(balance["points"]) == len(balance["surfaces"])
    up = np.sum(balance["forces"], axis=0)[2]
    assert up == pytest.approx(plan.world.mass * 9.81, rel=1e-3)


def test_the_hash_of_the_sequence_is_that_of_its_file(plan: Plan, tmp_path: Path):
    import hashlib

    io.save_sequence(reach_with_one_hand(HEIGHT), tmp_path / io.SEQUENCE)
    io.save_plan(plan, tmp_path)
    inputs = json.loads((tmp_path / "plan.json").read_text())["inputs"]
    content = (tmp_path / io.SEQUENCE).read_bytes()
    assert inputs["sequence"] == hashlib.sha256(content).hexdigest()


def test_durations_are_in_one_file_alone(plan: Plan, tmp_path: Path):
    io.save_plan(plan, tmp_path)
    io.save_timings(tmp_path, {"simulate": 2.0})
    content = json.loads((tmp_path / "timings.json").read_text())
    assert content["version"] == 1
    assert content["seconds"] == {**plan.timings, "simulate": 2.0}
    slower = replace(plan, timings={"keyframes": 99.0})
    before = bytes_of(tmp_path)
    io.save_plan(slower, tmp_path)
    assert bytes_of(tmp_path) == before


def test_results_of_an_earlier_plan_do_not_stay(
    plan: Plan, rollout: Rollout, tmp_path: Path
):
    io.save_plan(plan, tmp_path)
    io.save_rollout(plan, rollout, tmp_path)
    io.save_verdict(Verdict(reached=True, criteria={}), tmp_path)
    io.save_plan(replace(plan, trajectory=None, complete=False), tmp_path)
    left = {p.name for p in tmp_path.iterdir()}
    assert left == {io.PLAN, io.SCENE, io.TIMINGS}
    back = io.load_plan(tmp_path)
    assert back.trajectory is None
    assert not back.complete


def test_what_a_solver_could_not_say_survives_as_null(plan: Plan, tmp_path: Path):
    key = replace(
        plan.keyframes[-1],
        status=Status.OVERLOADED,
        com_margin=-np.inf,
        residuals=replace(plan.keyframes[-1].residuals, com_margin=-np.inf),
    )
    skipped = (Skipped(stance=4, reason="out of reach"),)
    io.save_plan(replace(plan, start=key, changes=(), skipped=skipped), tmp_path)
    assert "Infinity" not in (tmp_path / io.PLAN).read_text()
    back = io.load_plan(tmp_path)
    assert same(back.keyframes[0], key)
    assert same(back.skipped, skipped)


@pytest.mark.parametrize(
    ("name", "mistake", "said"),
    [
        ("plan.json", edit(lambda c: c.update(version=7)), "version is 7"),
        (
            "plan.json",
            edit(lambda c: c["keyframes"][0]["qpos"].pop()),
            "keyframes.0.qpos is '29 numbers'; expected 30 numbers",
        ),
        (
            "plan.json",
            edit(lambda c: c["keyframes"][1].update(status="FINE")),
            "keyframes.1.status is 'FINE'; expected one of SOLVED",
        ),
        (
            "plan.json",
            edit(lambda c: c["options"].update(method="luck")),
            "method is 'luck'; expected 'direct'",
        ),
        (
            "plan.json",
            edit(lambda c: c["keyframes"][0]["contacts"][0].update(surface="Tail")),
            "is 'Tail on ground'; expected a surface of the robot",
        ),
        (
            "plan.json",
            edit(lambda c: c["robot"]["limbs"]["left_arm"].update(root="Wing")),
            "scene.xml: expected the robot and the boxes of plan.json as MJCF",
        ),
        ("scene.xml", lambda text: text[:500], "scene.xml: expected the robot"),
        (
            "scene.xml",
            lambda text: text.replace('name="box"', 'name="crate"'),
            "scene.xml: expected the robot and the boxes",
        ),
    ],
)
def test_a_mistake_in_a_run_folder_is_named(
    name: str, mistake: Callable[[str], str], said: str, saved: Path, tmp_path: Path
):
    for p in saved.iterdir():
        (tmp_path / p.name).write_bytes(p.read_bytes())
    (tmp_path / name).write_text(mistake((tmp_path / name).read_text()))
    with pytest.raises(InputError) as e:
        io.load_plan(tmp_path)
    assert said in str(e.value)
    assert "\n" not in str(e.value)


@pytest.mark.parametrize("name", ["plan.json", "trajectory.npz", "scene.xml"])
def test_a_missing_file_of_a_plan_is_named(name: str, saved: Path, tmp_path: Path):
    for p in saved.iterdir():
        if p.name != name:
            (tmp_path / p.name).write_bytes(p.read_bytes())
    with pytest.raises(InputError, match=name):
        io.load_plan(tmp_path)


def test_a_folder_that_is_none_is_named(tmp_path: Path):
    with pytest.raises(InputError, match="nowhere: expected a run folder"):
        io.load_plan(tmp_path / "nowhere")


def test_a_broken_trajectory_is_named(plan: Plan, saved: Path, tmp_path: Path):
    path = tmp_path / "trajectory.npz"
    whole = (saved / "trajectory.npz").read_bytes()
    for content in (b"", b"no zip", whole[: len(whole) // 2]):
        path.write_bytes(content)
        with pytest.raises(
            InputError, match=r"trajectory\.npz: expected a whole \.npz"
        ):
            io.load_trajectory(path, plan.world)
    with path.open("wb") as stream:
        np.save(stream, np.zeros(3))
    with pytest.raises(InputError, match="expected a whole"):
        io.load_trajectory(path, plan.world)
    with np.load(saved / "trajectory.npz") as f:
        arrays = dict(f)
    np.savez(path, **{**arrays, "qpos": arrays["qpos"][:, 1:]})
    with pytest.raises(InputError, match="shape of qpos is"):
        io.load_trajectory(path, plan.world)
    np.savez(path, **{**arrays, "joint_names": arrays["joint_names"][::-1]})
    with pytest.raises(InputError, match="joint_names is"):
        io.load_trajectory(path, plan.world)
    np.savez(path, **{**arrays, "qvel": arrays["qvel"] * np.nan})
    with pytest.raises(InputError, match="qvel: expected finite numbers"):
        io.load_trajectory(path, plan.world)
    del arrays["tau"]
    np.savez(path, **arrays)
    with pytest.raises(InputError, match="tau: expected an array"):
        io.load_trajectory(path, plan.world)


def test_meshes_travel_with_the_scene(plan: Plan, tmp_path: Path):
    source = tmp_path / "robot" / "shapes"
    source.mkdir(parents=True)
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
    faces = "f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    (source / "a.obj").write_text(corners + faces)
    (source / "b").mkdir()
    (source / "b" / "a.obj").write_text(corners.replace("1", "2") + faces)
    xml = """<mujoco><compiler meshdir="shapes"/><asset><mesh name="a" file="a.obj"/>
    <mesh name="b" file="b/a.obj"/></asset><worldbody><geom type="mesh" mesh="a"/>
    <geom type="mesh" mesh="b"/></worldbody></mujoco>"""
    robot = replace(plan.world.robot, path=tmp_path / "robot" / "robot.xml")
    out = tmp_path / "out"
    out.mkdir()
    io.save_plan(replace(plan, world=replace(plan.world, xml=xml, robot=robot)), out)
    for p in (source / "b" / "a.obj", source / "a.obj"):
        p.unlink()
    model = mujoco.MjModel.from_xml_path(str(out / "scene.xml"))
    assert model.nmesh == 2
    assert {p.name for p in (out / "assets").iterdir()} == {"a.obj", "a-2.obj"}


# Rollouts and verdicts.


def test_a_rollout_survives_the_disk_to_the_last_bit(
    plan: Plan, rollout: Rollout, tmp_path: Path
):
    io.save_plan(plan, tmp_path)
    io.save_rollout(plan, rollout, tmp_path)
    back = io.load_rollout(tmp_path)
    assert same(back, rollout)
    for f in fields(Rollout):
        assert isinstance(getattr(rollout, f.name), type(getattr(back, f.name))), f.name


def test_what_ran_and_what_was_planned_are_both_kept(plan: Plan, tmp_path: Path):
    """A lower box and a push, felt: other physics, another reference, the same plan."""
    truth = Disturbance(height=-0.02, push=20.0, seed=3)
    felt = clamber.simulate(plan, controller="mixed", disturbance=truth)
    assert felt.followed is not None
    assert felt.events
    io.save_plan(plan, tmp_path)
    planned = {n: (tmp_path / n).read_bytes() for n in (io.SCENE, io.TRAJECTORY)}
    io.save_rollout(plan, felt, tmp_path)
    assert (tmp_path / io.PLANNED_SCENE).read_bytes() == planned[io.SCENE]
    assert (tmp_path / io.PLANNED_TRAJECTORY).read_bytes() == planned[io.TRAJECTORY]
    back = io.load_rollout(tmp_path)
    assert same(back, felt)
    assert back.world.scene.boxes[0].size[2] == pytest.approx(HEIGHT - 0.02)
    again = io.load_plan(tmp_path)
    assert same(again.trajectory, plan.trajectory)
    assert again.world.xml == plan.world.xml
    # The next run, open loop in the planned world, leaves none of that behind.
    io.save_rollout(plan, clamber.simulate(plan, controller="pid"), tmp_path)
    assert {n: (tmp_path / n).read_bytes() for n in planned} == planned
    assert not (tmp_path / io.PLANNED_SCENE).exists()
    assert not (tmp_path / io.PLANNED_TRAJECTORY).exists()


def test_plain_mujoco_replays_the_rollout(
    plan: Plan, saved: Path, rollout: Rollout, tmp_path: Path
):
    io.save_rollout(plan, rollout, tmp_path)
    model = mujoco.MjModel.from_xml_path(str(saved / "scene.xml"))
    data = mujoco.MjData(model)
    with np.load(tmp_path / "rollout.npz", allow_pickle=False) as f:
        assert f["ctrl"].dtype == np.float64
        assert f["contact_force"].shape == (len(f["time"]), len(f["surfaces"]), 3)
        data.qpos[:] = f["qpos"][0]
        for k, ctrl in enumerate(f["ctrl"][:1000]):
            if k % int(f["stride"]) == 0:
                assert np.array_equal(data.qpos, f["qpos"][k // int(f["stride"])])
            data.ctrl[:] = ctrl
            mujoco.mj_step(model, data)


def test_a_broken_rollout_is_named(plan: Plan, rollout: Rollout, tmp_path: Path):
    with pytest.raises(InputError, match=r"rollout\.npz: expected a whole"):
        io.load_rollout(tmp_path)
    io.save_rollout(plan, replace(rollout, qpos=rollout.qpos[1:]), tmp_path)
    with pytest.raises(InputError, match="shape of qpos"):
        io.load_rollout(tmp_path)


def test_a_verdict_survives_the_disk(tmp_path: Path):
    verdict = Verdict(
        reached=False,
        criteria={"speed [m/s]": Criterion(value=1 / 3, limit=0.05, ok=False)},
    )
    io.save_verdict(verdict, tmp_path)
    assert same(io.load_verdict(tmp_path), verdict)
    content = json.loads((tmp_path / "verdict.json").read_text())
    assert content["version"] == 1
    assert content["reached"] is False
    assert content["criteria"]["speed [m/s]"] == {
        "value": 1 / 3,
        "limit": 0.05,
        "ok": False,
    }
    (tmp_path / "verdict.json").write_text('{"version": 1}')
    with pytest.raises(InputError, match="reached: expected a value"):
        io.load_verdict(tmp_path)
