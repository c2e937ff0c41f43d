"""Run folders: what is saved comes back, the same bytes each time, whole or not."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

import clamber
from clamber.cli.output import plan_record
from clamber.contact.contact import ContactSequence
from clamber.contact.steps import Skipped
from clamber.errors import InputError, Status
from clamber.execution.disturbance import Disturbance
from clamber.execution.reference import STEPS
from clamber.execution.simulation import Rollout
from clamber.execution.verdict import Verdict
from clamber.model.robot import ROBOTS
from clamber.model.scene import Box, Scene
from clamber.model.se3 import matrix_from_rpy
from clamber.model.world import recompiled
from clamber.planning.records import Plan
from clamber.planning.trajectory import Samples, timed
from clamber.run.folder import (
    EXECUTION,
    PLAN,
    PLANNED_SCENE,
    PLANNED_TRAJECTORY,
    ROLLOUT,
    SCENE,
    SEQUENCE,
    TIMINGS,
    TRAJECTORY,
    load_plan,
    load_rollout,
    load_sequence,
    load_trajectory,
    load_verdict,
    new_run_folder,
    save_plan,
    save_rollout,
    save_sequence,
    save_timings,
    save_trajectory,
    save_verdict,
)
from clamber.step.change import Failure
from clamber.step.ik import IK
from records import differences, same
from support.files import box_obj

PLAN_FILES = {
    *("sequence.json", "plan.json", "planned.xml", "planned.npz", "timings.json"),
    *("scene.xml", "trajectory.npz"),
}


@pytest.fixture(scope="module")
def saved(plan: Plan, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    save_sequence(plan.sequence, folder / SEQUENCE)
    save_plan(plan, folder)
    return folder


@pytest.fixture
def copied(saved: Path, tmp_path: Path) -> Path:
    return shutil.copytree(saved, tmp_path / "copied")


def bytes_of(folder: Path) -> dict[str, bytes]:
    files = (p for p in sorted(folder.rglob("*")) if p.is_file())
    return {p.name: p.read_bytes() for p in files if p.name != TIMINGS}


# Folders.


def test_run_folders_are_numbered_when_the_name_is_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    made = [new_run_folder(None, "climb") for _ in range(3)]
    assert [str(p) for p in made] == ["runs/climb", "runs/climb-2", "runs/climb-3"]
    assert str(new_run_folder(None, "plan")) == "runs/plan"


def test_a_folder_that_is_asked_for_may_exist_and_may_be_deep(tmp_path: Path):
    deep = tmp_path / "a" / "b"
    assert new_run_folder(deep, "climb") == deep
    assert new_run_folder(deep, "climb") == deep
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
        new_run_folder(taken / "below" if inside else taken, "climb")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_without_permission_to_write_is_refused(tmp_path: Path):
    tmp_path.chmod(0o500)
    with pytest.raises(InputError, match="Permission denied"):
        new_run_folder(tmp_path / "run", "climb")


# Sequences.


def test_a_sequence_survives_the_disk_to_the_last_bit(
    one_hand: ContactSequence, tmp_path: Path
):
    third = replace(one_hand, scene=Scene.from_height(1 / 3))
    sequence = replace(third, subject={"thigh": 0.1 + 0.2}, source="\u00dcbung")
    save_sequence(sequence, tmp_path / SEQUENCE)
    for path in (tmp_path, tmp_path / SEQUENCE):
        assert not list(differences(load_sequence(path), sequence))


def test_a_sequence_of_version_1_is_read(one_hand: ContactSequence, tmp_path: Path):
    path = tmp_path / SEQUENCE
    save_sequence(one_hand, path)
    edit(path, lambda c: c.update(version=1))
    assert same(load_sequence(path), one_hand)


@pytest.mark.parametrize(
    "rpy",
    [(0.3, -0.2, 1.1), (0.0, 0.0, -3.0), (0.4, np.pi / 2, 0.0), (0.1, -1.57, 2.0)],
)
def test_a_turned_and_raised_box_survives_the_disk(
    rpy: tuple, one_hand: ContactSequence, tmp_path: Path
):
    box = Box(
        name="Cube.001",
        size=np.array([0.4, 0.5, 0.6]),
        centre=np.array([1.0, -0.2, 0.45]),
        rotation=matrix_from_rpy(rpy),
        friction=0.35,
    )
    scene = Scene(
        boxes=(*one_hand.scene.boxes, box),
        start=np.array([0.1, 0.2, 0.3]),
        goal=np.array([2.0, 0.0]),
    )
    save_sequence(replace(one_hand, scene=scene), tmp_path / "s.json")
    back = load_sequence(tmp_path / "s.json").scene
    np.testing.assert_allclose(back.boxes[1].centre, box.centre, atol=1e-15)
    np.testing.assert_allclose(back.boxes[1].rotation, box.rotation, atol=1e-15)
    exact = np.array_equal(back.boxes[1].rotation, box.rotation)
    assert exact or rpy[1] == np.pi / 2  # as a person wrote it
    left = [".boxes.1.centre", ".boxes.1.rotation"]
    assert not [d for d in differences(back, scene) if d not in left]


def test_a_stance_says_its_region_and_times(one_hand: ContactSequence, tmp_path: Path):
    save_sequence(one_hand, tmp_path / "s.json")
    content = json.loads((tmp_path / "s.json").read_text())
    assert content["version"] == 2
    assert [s["region"] for s in content["stances"]] == ["G", "M"]
    assert [(s["t0"], s["t1"]) for s in content["stances"]] == [(0.0, 1.0), (1.0, 2.0)]
    hand = content["stances"][1]["contacts"][2]
    assert hand["surface"] == "LHand"
    assert hand["position"] == [0.43, 0.17, 0.25]
    assert not {"edge", "link", "firm"} & set(hand)


def edit(path: Path, change: Callable[[dict], object]) -> None:
    """Change a JSON file."""
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


@pytest.mark.parametrize(
    ("change", "field"),
    [
        (lambda c: c.update(stances=[]), "stances"),
        (lambda c: c["stances"][1]["contacts"][0].update(support="moon"), None),
        (lambda c: c["stances"][1]["contacts"][1].update(surface="LFoot"), "stances.1"),
        (lambda c: c["stances"][1].update(t0=0.2), "stances.1.t0"),
    ],
)
def test_a_mistake_in_a_sequence_is_named_with_its_file_and_field(
    change: Callable[[dict], object],
    field: str | None,
    one_hand: ContactSequence,
    tmp_path: Path,
):
    path = tmp_path / "s.json"
    save_sequence(one_hand, path)
    edit(path, change)
    with pytest.raises(InputError) as e:
        load_sequence(path)
    assert (e.value.source, e.value.field) == (path, field)
    assert "\n" not in str(e.value)


# Plans.


def test_a_loaded_plan_is_the_one_that_was_made(plan: Plan, saved: Path):
    assert plan.complete
    assert len(plan.changes) == 1
    assert not list(differences(load_plan(saved), plan))


def test_a_plan_is_saved_as_it_was_loaded(saved: Path, tmp_path: Path):
    save_sequence(load_sequence(saved), tmp_path / SEQUENCE)
    save_plan(load_plan(saved), tmp_path)
    assert bytes_of(tmp_path) == bytes_of(saved)


def test_a_loaded_plan_is_run_planned_again_and_told_as_the_one_that_was_made(
    plan: Plan, saved: Path, rollout: Rollout, tmp_path: Path
):
    loaded = load_plan(saved)
    again = clamber.simulate(loaded, controller="pid")
    assert not list(differences(again, rollout))
    assert plan_record(loaded) == plan_record(plan)
    assert plan_record(loaded)["keyframes"][1]["move"] == "air -> LHand on box"
    q, scene, robot = rollout.qpos[0], plan.world.scene, plan.world.robot
    rest, other = (
        clamber.plan(x.sequence, robot, scene, start=clamber.state_of(x, scene, q))
        for x in (loaded, plan)
    )
    assert len(rest.changes) == 1
    assert not [d for d in differences(rest, other) if "timings" not in d]
    save_plan(rest, tmp_path)  # from a state in the middle
    back = load_plan(tmp_path)
    assert not list(differences(back, rest))
    assert back.state is not None
    assert all(c in back.state.stance for c in back.state.loaded)  # the very same


def test_two_runs_leave_the_same_bytes(
    one_hand: ContactSequence, plan: Plan, saved: Path, rollout: Rollout, tmp_path: Path
):
    again = clamber.plan(
        one_hand, clamber.load_robot("coman"), one_hand.scene, options=plan.options
    )
    folder = new_run_folder(tmp_path / "a", "plan")
    save_sequence(again.sequence, folder / SEQUENCE)
    save_plan(again, folder)
    assert bytes_of(folder) == bytes_of(saved)
    assert {p.name for p in saved.iterdir()} == PLAN_FILES
    for folder in ("b", "c"):
        shutil.copytree(saved, tmp_path / folder)
        save_rollout(plan, rollout, tmp_path / folder)
    assert bytes_of(tmp_path / "b") == bytes_of(tmp_path / "c")


def test_plain_mujoco_loads_the_scene_and_the_trajectory_fits(plan: Plan, saved: Path):
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
    assert model.geom("box").size[2] == pytest.approx(0.25 / 2)
    assert model.geom("ground").type == mujoco.mjtGeom.mjGEOM_PLANE
    assert (saved / "scene.xml").read_bytes() == (saved / "planned.xml").read_bytes()
    ran, t = load_trajectory(saved / "trajectory.npz", plan.world), plan.trajectory
    for name in ("q", "v", "tau"):
        off = np.abs(getattr(ran, name) - np.asarray(getattr(t, name))).max()
        assert off <= 0.51 * STEPS[name]
    assert np.array_equal(ran.contact, t.contact)


def test_a_plan_takes_no_more_than_what_gives_its_samples(plan: Plan, copied: Path):
    """A tenth of them; samples that nothing gives are all written."""
    path, t = copied / PLANNED_TRAJECTORY, plan.trajectory
    assert path.stat().st_size < 0.1 * np.asarray(t.q).nbytes
    for name in ("q", "v", "tau"):
        changed = replace(t, **{name: np.array(getattr(t, name)) + 0.1})
        save_trajectory(changed, path)
        assert same(load_trajectory(path, plan.world), changed)


@pytest.mark.parametrize("speed", [0.5, "max"])
def test_runs_of_any_speed_survive_the_disk(plan: Plan, tmp_path: Path, speed):
    t = timed(IK(plan.world), plan.changes, speed)
    save_trajectory(t, tmp_path / "t.npz")
    back = load_trajectory(tmp_path / "t.npz", plan.world)
    assert isinstance(back.q, Samples)
    assert same(back, t)


@pytest.mark.parametrize("name", ["run_sizes", "node_s", "node_qpos", "run_ends"])
def test_runs_that_do_not_fit_together_are_named(plan: Plan, copied: Path, name: str):
    path = copied / PLANNED_TRAJECTORY
    with np.load(path) as f:
        arrays = dict(f)
    for change in ({name: arrays[name][1:]}, {name: np.array("x")}):
        np.savez(path, **{**arrays, **change})
        with pytest.raises(InputError) as e:
            load_plan(copied)
        assert e.value.source == path


def test_the_plan_names_what_it_was_made_of(plan: Plan, saved: Path):
    content = json.loads((saved / "plan.json").read_text())
    assert content["version"] == 2
    assert content["options"]["speed"] == 1.0
    assert content["versions"]["mujoco"] == mujoco.__version__
    assert set(content["inputs"]) == {"robot", "robot_model", "sequence"}
    sequence = (saved / SEQUENCE).read_bytes()
    assert content["inputs"]["sequence"] == hashlib.sha256(sequence).hexdigest()
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


def test_durations_are_in_one_file_alone(plan: Plan, copied: Path):
    before = bytes_of(copied)
    save_plan(replace(plan, timings={"keyframes": 99.0}), copied)
    assert bytes_of(copied) == before
    save_timings(copied, {"simulate": 2.0})
    content = json.loads((copied / "timings.json").read_text())
    assert content == {"version": 2, "seconds": {"keyframes": 99.0, "simulate": 2.0}}
    assert load_plan(copied).timings == content["seconds"]


def test_results_of_an_earlier_plan_do_not_stay(
    plan: Plan, rollout: Rollout, tmp_path: Path
):
    run = tmp_path / "runs" / "climb"  # which it makes
    save_plan(plan, run)
    save_rollout(plan, rollout, run)
    save_verdict(Verdict(reached=True, criteria={}), run)
    nothing = replace(plan, trajectory=None, complete=False)
    save_plan(nothing, run)
    left = {p.name for p in run.iterdir()}
    assert left == {PLAN, PLANNED_SCENE, SCENE, TIMINGS}
    assert same(load_plan(run), nothing)


def test_what_a_solver_could_not_say_survives_as_null(plan: Plan, tmp_path: Path):
    key = replace(
        plan.keyframes[-1],
        status=Status.OVERLOADED,
        com_margin=-np.inf,
        residuals=replace(plan.keyframes[-1].residuals, com_margin=-np.inf),
    )
    skipped = (Skipped(stance=4, reason="out of reach"),)
    failed = (Failure(status=Status.UNREACHABLE, step=plan.changes[0].step),)
    stuck = replace(plan, start=key, changes=(), skipped=skipped, failures=failed)
    save_plan(stuck, tmp_path)
    assert "Infinity" not in (tmp_path / PLAN).read_text()
    assert same(load_plan(tmp_path), stuck)


@pytest.mark.parametrize(
    ("change", "field"),
    [
        (lambda c: c["keyframes"][0]["qpos"].pop(), "keyframes.0.qpos"),
        (lambda c: c["changes"].pop(), "keyframes"),
        (lambda c: c["changes"][0]["phases"][1]["q"].clear(), "changes.0.phases.1.q"),
        (
            lambda c: c["keyframes"][0]["contacts"][0].update(surface="Tail"),
            "keyframes.0.contacts",
        ),
        (lambda c: c["robot"].update(gains=3), "gains"),
    ],
)
def test_a_mistake_in_a_plan_is_named(
    change: Callable[[dict], object], field: str, copied: Path
):
    edit(copied / PLAN, change)
    with pytest.raises(InputError) as e:
        load_plan(copied)
    assert (e.value.source, e.value.field) == (copied / PLAN, field)
    assert "\n" not in str(e.value)


def test_a_plan_of_the_first_version_says_who_made_it(copied: Path):
    edit(copied / PLAN, lambda c: c.update(version=1))
    with pytest.raises(InputError, match=r"clamber 0\.1 .* `clamber plan` writes it"):
        load_plan(copied)


@pytest.mark.parametrize(
    "change",
    [
        lambda xml: xml[:500],
        lambda xml: xml.replace('name="box"', 'name="crate"'),
        lambda xml: xml.replace("LHand", "Hook"),
    ],
)
def test_a_world_that_does_not_fit_the_plan_is_named(
    change: Callable[[str], str], copied: Path
):
    path = copied / PLANNED_SCENE
    path.write_text(change(path.read_text()))
    with pytest.raises(InputError) as e:
        load_plan(copied)
    assert e.value.source == path
    assert "\n" not in str(e.value)


@pytest.mark.parametrize("name", [PLAN, PLANNED_TRAJECTORY, PLANNED_SCENE])
def test_a_missing_file_of_a_plan_is_named(name: str, copied: Path):
    (copied / name).unlink()
    with pytest.raises(InputError) as e:
        load_plan(copied)
    assert e.value.source == copied / name


def test_a_folder_that_is_none_is_named(tmp_path: Path):
    with pytest.raises(InputError, match="nowhere: expected a run folder"):
        load_plan(tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"qpos": np.zeros((7, 3))}, "qpos"),
        ({"joint_names": np.array(["Tail"] * 23)}, "joint_names"),
        ({"qvel": None}, "qvel"),
    ],
)
def test_another_robots_trajectory_is_named(
    change: dict, field: str, plan: Plan, copied: Path
):
    path = copied / "other.npz"
    with np.load(copied / TRAJECTORY) as f:
        arrays = {**f, **change}
    np.savez(path, **{k: v for k, v in arrays.items() if v is not None})
    with pytest.raises(InputError) as e:
        load_trajectory(path, plan.world)
    assert (e.value.source, e.value.field) == (path, field)


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
    save_plan(replace(plan, world=replace(plan.world, xml=xml, robot=robot)), out)
    for p in (source / "b" / "a.obj", source / "a.obj"):
        p.unlink()
    model = mujoco.MjModel.from_xml_path(str(out / "scene.xml"))
    assert model.nmesh == 2
    assert {p.name for p in (out / "assets").iterdir()} == {"a.obj", "a-2.obj"}


def test_a_run_of_a_robot_with_meshes_is_simulated_from_its_folder(
    plan: Plan, tmp_path: Path
):
    path = tmp_path / "robot" / "a.obj"
    path.parent.mkdir()
    path.write_text(box_obj([0.1, 0.1, 0.1], [0, 0, 0], 0.0))
    robot = replace(plan.world.robot, path=path.parent / "robot.xml")

    def add_mesh(spec: mujoco.MjSpec) -> None:
        spec.add_mesh(name="a", file="a.obj")
        kind = {"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": "a"}
        spec.body("Waist").add_geom(**kind, contype=0, conaffinity=0, mass=0.0)

    world = recompiled(replace(plan.world, robot=robot), add_mesh)
    save_plan(replace(plan, world=world), tmp_path / "run")
    save_sequence(plan.sequence, tmp_path / "run" / SEQUENCE)
    shutil.rmtree(path.parent)
    found = load_plan(tmp_path / "run")
    assert recompiled(found.world, lambda spec: None).model.nmesh == 1
    save_plan(found, tmp_path / "again")
    assert (tmp_path / "again" / "assets" / "a.obj").is_file()


# Rollouts and verdicts.


def test_a_rollout_survives_the_disk_to_the_last_bit(
    plan: Plan, rollout: Rollout, copied: Path
):
    save_rollout(plan, rollout, copied)
    assert not list(differences(load_rollout(copied), replace(rollout, plan=None)))


def test_what_ran_and_what_was_planned_are_both_kept(plan: Plan, copied: Path):
    """A lower box and a push: other physics, another reference, the same plan."""
    lower = Disturbance(height=-0.02, push=20.0, seed=3)
    ran = clamber.simulate(plan, controller="mixed", disturbance=lower)
    assert ran.followed is not None
    assert ran.events
    planned = bytes_of(copied)
    save_rollout(plan, ran, copied)
    now = bytes_of(copied)
    for name in (PLAN, PLANNED_SCENE, PLANNED_TRAJECTORY):
        assert now[name] == planned[name]
    for name in (SCENE, TRAJECTORY):
        assert now[name] != planned[name]
    back = load_rollout(copied)
    assert back.world.xml == ran.world.xml
    assert same(
        replace(back, world=plan.world), replace(ran, world=plan.world, plan=None)
    )
    assert back.world.scene.boxes[0].size[2] == pytest.approx(0.25 - 0.02)
    assert same(load_plan(copied), plan)
    # The next run, open loop in the planned world, leaves none of that behind.
    save_rollout(plan, clamber.simulate(plan, controller="pid"), copied)
    again = bytes_of(copied)
    assert {n: again[n] for n in planned} == planned
    assert load_rollout(copied).followed is None


def test_plain_mujoco_replays_the_rollout(plan: Plan, rollout: Rollout, copied: Path):
    save_rollout(plan, rollout, copied)
    model = mujoco.MjModel.from_xml_path(str(copied / "scene.xml"))
    data = mujoco.MjData(model)
    with np.load(copied / "rollout.npz", allow_pickle=False) as f:
        assert {f[n].dtype for n in ("ctrl", "qpos", "qvel")} == {np.dtype("<f4")}
        assert f["contact_force"].shape == (len(f["time"]), len(f["surfaces"]), 3)
        data.qpos[:] = f["qpos"][0]
        for k, ctrl in enumerate(f["ctrl"][:1000]):
            if k % int(f["stride"]) == 0:
                state = f["qpos"][k // int(f["stride"])]
                assert np.array_equal(data.qpos.astype(np.float32), state)
            data.ctrl[:] = ctrl
            mujoco.mj_step(model, data)


def test_a_broken_rollout_is_named(plan: Plan, rollout: Rollout, copied: Path):
    def fault() -> tuple[object, str | None]:
        with pytest.raises(InputError) as e:
            load_rollout(copied)
        return e.value.source, e.value.field

    assert fault() == (copied / ROLLOUT, None)
    save_rollout(plan, replace(rollout, qpos=rollout.qpos[1:]), copied)
    assert fault() == (copied / ROLLOUT, "qpos")
    save_rollout(plan, rollout, copied)
    (copied / TRAJECTORY).unlink()
    assert fault() == (copied / TRAJECTORY, None)
    (copied / EXECUTION).write_text('{"version": 2}')
    assert fault() == (copied / EXECUTION, "scene")


def test_a_verdict_survives_the_disk(plan: Plan, rollout: Rollout, tmp_path: Path):
    verdict = clamber.judge(plan, rollout)
    save_verdict(verdict, tmp_path)
    assert same(load_verdict(tmp_path), verdict)
    content = json.loads((tmp_path / "verdict.json").read_text())
    assert content["reached"] == verdict.reached
    speed = content["criteria"]["pelvis speed at the end [m/s]"]
    assert set(speed) == {"value", "limit", "ok"}
    (tmp_path / "verdict.json").write_text('{"version": 2}')
    with pytest.raises(InputError, match="reached: expected a value"):
        load_verdict(tmp_path)
