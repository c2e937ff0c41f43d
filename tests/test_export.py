"""Exported files, read back by the libraries that their users read them with."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pandas
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from scipy.interpolate import CubicHermiteSpline

import clamber
from clamber import cli
from clamber.errors import InputError, MissingDependency
from clamber.execution.simulation import Rollout
from clamber.model.kinematics import Kinematics
from clamber.planning.records import Plan
from clamber.planning.trajectory import Trajectory
from clamber.run import export
from clamber.run.folder import save_plan, save_rollout

TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"


@pytest.fixture(scope="module")
def t(plan: Plan) -> Trajectory:
    assert plan.trajectory is not None
    return plan.trajectory


@pytest.fixture(scope="module")
def planned(plan: Plan, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("planned")
    save_plan(plan, folder)
    return folder


@pytest.fixture(scope="module")
def run(plan: Plan, rollout: Rollout, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    save_plan(plan, folder)
    save_rollout(plan, rollout, folder)
    return folder


@pytest.fixture
def home(plan: Plan) -> dict[str, float]:
    w = plan.world
    return dict(zip(w.joints, w.home[w.qadr].tolist(), strict=True))


# CSV.


def test_a_csv_has_every_number_of_the_run_by_name_and_unit(
    t: Trajectory, plan: Plan, rollout: Rollout, run: Path, tmp_path: Path
):
    done = clamber.export_run(run, to="csv", out=tmp_path / "a.csv")
    table = pandas.read_csv(done.file)
    w = plan.world
    k = np.arange(0, len(t.time), 10)  # 100 Hz
    assert len(table) == done.samples == len(k)
    assert not table.isna().any().any()
    assert np.allclose(table["time [s]"], t.time[k], atol=1e-12)
    for i, name in enumerate(w.joints):
        assert np.array_equal(table[f"{name} position [rad]"], t.q[k, w.qadr[i]])
        assert np.array_equal(table[f"{name} velocity [rad/s]"], t.v[k, w.dadr[i]])
        assert np.array_equal(table[f"{name} torque [N m]"], t.tau[k, i])
    for i, name in enumerate(t.surfaces):
        assert np.array_equal(table[f"{name} contact [-]"], t.contact[k, i])
        for j, axis in enumerate("xyz"):
            force = table[f"{name} force {axis} [N]"]
            assert np.array_equal(force, rollout.contact_force[: len(k), i, j])
    base = ["base x [m]", "base y [m]", "base z [m]"]
    assert np.array_equal(table[base], t.q[k, :3])
    assert np.array_equal(table[[f"base q{a} [-]" for a in "wxyz"]], t.q[k, 3:7])
    assert np.array_equal(table[[f"base v{a} [m/s]" for a in "xyz"]], t.v[k, :3])
    assert np.array_equal(table[[f"base w{a} [rad/s]" for a in "xyz"]], t.v[k, 3:6])


def test_a_plan_that_was_not_simulated_has_no_forces(planned: Path, tmp_path: Path):
    done = clamber.export_run(planned, to="csv", out=tmp_path / "a.csv")
    assert not done.forces
    names = list(pandas.read_csv(done.file).columns)
    assert "LFoot contact [-]" in names
    assert not [n for n in names if "force" in n]
    npz = clamber.export_run(planned, to="npz", out=tmp_path / "a.npz").file
    assert "contact_force" not in np.load(npz, allow_pickle=False)


def test_a_run_that_fell_ends_where_it_fell(plan: Plan, rollout: Rollout, tmp_path):
    n = 1234
    kept = -(-n // rollout.stride)
    fell = replace(
        rollout,
        ctrl=rollout.ctrl[:n],
        fell=True,
        **{
            x: getattr(rollout, x)[:kept]
            for x in (
                *("time", "qpos", "qvel", "actuator_force"),
                *("contact_force", "unintended", "penetration"),
            )
        },
    )
    save_plan(plan, tmp_path)
    save_rollout(plan, fell, tmp_path)
    motion = export.load_motion(tmp_path, rate=1000)
    assert len(motion.reference.q) == n
    held = np.repeat(rollout.contact_force[:kept], rollout.stride, axis=0)
    assert np.array_equal(motion.force, held[:n])  # between the recorded states


# MCAP.


def messages(path: Path) -> dict[str, list]:
    """(schema, log time, message) of each topic."""
    out: dict[str, list] = {}
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for schema, channel, raw, message in reader.iter_decoded_messages():
            assert schema.encoding == "ros2msg"
            assert channel.message_encoding == "cdr"
            row = (schema.name, raw.log_time, message)
            out.setdefault(channel.topic, []).append(row)
    return out


@pytest.fixture(scope="module")
def topics(run: Path) -> dict[str, list]:
    return messages(clamber.export_run(run, to="mcap", out=run / "a.mcap").file)


def seconds(stamp) -> float:
    return stamp.sec + 1e-9 * stamp.nanosec


@pytest.mark.parametrize("effort", [False, True])
def test_the_joint_trajectory_is_one_message_with_the_same_numbers(
    t: Trajectory, plan: Plan, topics: dict[str, list], effort: bool
):
    topic = "/joint_trajectory" + "_with_torques" * effort
    ((schema, log_time, message),) = topics[topic]
    w = plan.world
    assert schema == TRAJECTORY
    assert log_time == 0
    assert tuple(message.joint_names) == w.joints
    assert seconds(message.header.stamp) == 0.0  # starts at once
    k = np.arange(0, len(t.time), 10)
    points = message.points
    assert np.array_equal([p.positions for p in points], t.q[np.ix_(k, w.qadr)])
    assert np.array_equal([p.velocities for p in points], t.v[np.ix_(k, w.dadr)])
    assert not any(p.accelerations for p in points)
    if effort:
        assert np.array_equal([p.effort for p in points], t.tau[k])
    else:  # controllers of positions refuse a trajectory with efforts
        assert not any(p.effort for p in points)
    times = [seconds(p.time_from_start) for p in points]
    assert np.allclose(times, t.time[k], atol=1e-9)
    assert np.all(np.diff(times) > 0)
    assert not np.any(points[-1].velocities)  # which controllers ask for


def test_cubic_splines_through_the_points_are_the_1_khz_trajectory(
    t: Trajectory, plan: Plan, topics: dict[str, list]
):
    """What `joint_trajectory_controller` makes of positions and velocities."""
    w = plan.world
    points = topics["/joint_trajectory"][0][2].points
    spline = CubicHermiteSpline(
        [seconds(p.time_from_start) for p in points],
        [p.positions for p in points],
        [p.velocities for p in points],
    )
    inside = t.time <= seconds(points[-1].time_from_start)
    off = np.abs(spline(t.time[inside]) - t.q[inside][:, w.qadr]).max()
    assert off < 1e-5


def test_states_forces_and_contacts_are_those_of_the_run(
    t: Trajectory, plan: Plan, rollout: Rollout, topics: dict[str, list]
):
    w, m = plan.world, rollout.world.model
    states = topics["/joint_states"]
    n = len(states)
    assert n == len(t.time[::10])
    assert {row[0] for row in states} == {"sensor_msgs/msg/JointState"}
    assert [row[1] for row in states] == [10_000_000 * k for k in range(n)]
    assert all(row[1] == 1e9 * row[2].header.stamp.sec + row[2].header.stamp.nanosec
               for row in states)  # fmt: skip
    assert np.array_equal([x.position for *_, x in states], rollout.qpos[:n, w.qadr])
    assert np.array_equal([x.velocity for *_, x in states], rollout.qvel[:n, w.dadr])
    servo = [m.actuator(j).id for j in w.joints]
    efforts = [x.effort for *_, x in states]
    assert np.array_equal(efforts, rollout.actuator_force[:n, servo])

    moved = [x.transforms[0] for *_, x in topics["/tf"]]
    assert {x.header.frame_id for x in moved} == {"world"}
    assert {x.child_frame_id for x in moved} == {m.body(w.base).name}
    at = [(x.transform.translation, x.transform.rotation) for x in moved]
    pose = [[p.x, p.y, p.z, r.w, r.x, r.y, r.z] for p, r in at]
    assert np.array_equal(pose, rollout.qpos[:n, :7])

    for i, surface in enumerate(rollout.surfaces):
        closed = [x.data for *_, x in topics[f"/contact/{surface}"]]
        assert np.array_equal(closed, t.contact[::10, i])
        wrenches = [x.wrench for *_, x in topics[f"/force/{surface}"]]
        force = [[x.force.x, x.force.y, x.force.z] for x in wrenches]
        assert np.array_equal(force, rollout.contact_force[:n, i])
    weight = 9.81 * rollout.world.mass
    feet = sum(topics[f"/force/{s}"][100][2].wrench.force.z for s in ("LFoot", "RFoot"))
    assert feet == pytest.approx(weight, rel=0.05)


def test_without_a_rollout_the_reference_moves(
    t: Trajectory, plan: Plan, planned: Path, tmp_path
):
    done = clamber.export_run(planned, to="mcap", out=tmp_path / "a.mcap", rate=50)
    topics = messages(done.file)
    w = plan.world
    states = [x.position for *_, x in topics["/joint_states"]]
    assert np.array_equal(states, t.q[::20][:, w.qadr])
    assert not [topic for topic in topics if topic.startswith("/force")]


def test_mcap_without_its_package_says_what_brings_it(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setitem(sys.modules, "mcap_ros2.writer", None)
    with pytest.raises(MissingDependency, match=r"clamber\[export\]"):
        clamber.export_run(run, to="mcap", out=tmp_path / "a.mcap")
    assert list(tmp_path.iterdir()) == []


# npz.


def finite_twists(world, q: np.ndarray, v: np.ndarray, h: float):
    """Velocities of the robot's bodies by central differences along `v`."""
    ends = []
    for sign in (-1, 1):
        kin = Kinematics(world)
        kin.update(kin.integrate(q, sign * h * v))
        ends.append((kin.data.xpos.copy(), kin.data.xquat.copy()))
    (p0, r0), (p1, r1) = ends
    linear, angular = (p1 - p0) / (2 * h), np.zeros_like(p0)
    for b in range(len(p0)):
        turn = np.zeros(3)
        mujoco.mju_subQuat(turn, r1[b], r0[b])  # in the first one's frame
        mujoco.mju_rotVecQuat(angular[b], turn / (2 * h), r0[b])
    return linear, angular


def test_velocities_of_bodies_are_the_derivatives_of_their_poses(
    plan: Plan, rng: np.random.Generator
):
    w = plan.world
    kin = Kinematics(w)
    q = np.array([kin.integrate(w.home, 0.3 * rng.normal(size=w.model.nv))])
    v = rng.normal(size=(1, w.model.nv))
    names, _, _, linear, angular = export.body_states(w, q, v)
    want_linear, want_angular = finite_twists(w, q[0], v[0], 1e-5)
    ids = [w.model.body(n).id for n in names]
    assert np.allclose(linear[0], want_linear[ids], atol=1e-7)
    assert np.allclose(angular[0], want_angular[ids], atol=2e-5)


def test_an_npz_is_what_mjlab_reads(
    t: Trajectory, plan: Plan, rollout: Rollout, run: Path, tmp_path: Path
):
    done = clamber.export_run(run, to="npz", out=tmp_path / "a.npz")
    f = np.load(done.file, allow_pickle=False)
    w = plan.world
    n, na = len(t.time[::20]), len(w.joints)
    assert f["fps"].tolist() == [50]
    assert f["joint_pos"].shape == f["joint_vel"].shape == (n, na)
    assert np.array_equal(f["qpos"], t.q[::20])
    assert np.array_equal(f["qvel"], t.v[::20])
    assert np.array_equal(f["joint_pos"], t.q[::20][:, w.qadr])
    assert np.array_equal(f["joint_vel"], t.v[::20][:, w.dadr])
    assert np.array_equal(f["joint_torque"], t.tau[::20])
    assert tuple(f["joint_names"]) == w.joints
    assert np.array_equal(f["contact"], t.contact[::20])
    assert np.array_equal(f["contact_force"], rollout.contact_force[: 2 * n : 2])
    # joints and bodies in the order of the robot's own model, the world not among them
    alone = mujoco.MjModel.from_xml_path(str(w.robot.path))
    hinges = [alone.joint(i) for i in range(alone.njnt)]
    order = [j.name for j in hinges if j.type[0] == mujoco.mjtJoint.mjJNT_HINGE]
    assert f["joint_names"].tolist() == order
    bodies = [alone.body(i).name for i in range(1, alone.nbody)]
    assert f["body_names"].tolist() == bodies
    assert f["body_pos_w"].shape == (n, len(bodies), 3)
    assert not [k for k in f.files if f[k].dtype.kind == "f" and np.isnan(f[k]).any()]
    # poses by the scene that the run folder holds, in plain MuJoCo
    model = mujoco.MjModel.from_xml_path(str(run / "scene.xml"))
    data = mujoco.MjData(model)
    for k in range(0, n, 29):
        data.qpos[:] = f["qpos"][k]
        mujoco.mj_forward(model, data)
        for i, name in enumerate(bodies):
            assert np.allclose(f["body_pos_w"][k, i], data.body(name).xpos, atol=1e-12)
            same = abs(f["body_quat_w"][k, i] @ data.body(name).xquat)
            assert same == pytest.approx(1.0, abs=1e-12)
    # velocities against the poses of the file itself
    slope = np.gradient(f["body_pos_w"], 1 / 50, axis=0)[1:-1]
    speed = f["body_lin_vel_w"][1:-1]
    assert np.abs(speed).max() > 0.1
    assert np.abs(slope - speed).max() < 0.05 * np.abs(speed).max()


def test_an_npz_is_what_holosoma_reads(plan: Plan, run: Path, tmp_path: Path):
    done = clamber.export_run(run, to="npz", layout="holosoma", out=tmp_path / "a.npz")
    f = np.load(done.file, allow_pickle=False)
    n, w = done.samples, plan.world
    assert f["joint_pos"].shape == (n, 7 + len(w.joints))
    assert f["joint_vel"].shape == (n, 6 + len(w.joints))
    root = f["body_names"].tolist().index(w.model.body(w.base).name)
    assert np.allclose(f["joint_pos"][:, :3], f["body_pos_w"][:, root], atol=1e-12)
    along = np.sum(f["joint_pos"][:, 3:7] * f["body_quat_w"][:, root], axis=1)
    assert np.allclose(np.abs(along), 1.0, atol=1e-12)
    assert np.allclose(f["joint_vel"][:, :3], f["body_lin_vel_w"][:, root], atol=1e-9)


def test_a_base_that_execution_moved_gets_its_velocity_from_its_poses(
    plan: Plan, tmp_path: Path
):
    """With contacts felt, what was followed has velocities of joints only."""
    lower = clamber.Disturbance(height=-0.02)
    felt = clamber.simulate(plan, controller="mixed", disturbance=lower)
    assert felt.followed is not None
    save_plan(plan, tmp_path)
    save_rollout(plan, felt, tmp_path)
    x = export.load_motion(tmp_path, rate=50).reference
    kin = Kinematics(plan.world)
    assert np.array_equal(x.q, felt.followed.q[::20])
    assert np.array_equal(x.v[:, 6:], felt.followed.v[::20, 6:])
    assert np.abs(x.v[:, :6]).max() > 0.01
    for k in range(1, len(x.q) - 1, 17):
        want = kin.difference(x.q[k - 1], x.q[k + 1]) * 25
        assert np.allclose(x.v[k, :6], want[:6], atol=1e-12)


# Lead-in.


def test_a_lead_in_goes_smoothly_from_the_measured_posture_to_the_first(
    plan: Plan, run: Path, home: dict[str, float], tmp_path: Path
):
    measured = home | {"RElbj": -0.6, "LShSag": 0.2, "WaistYaw": 0.15}
    path = tmp_path / "measured.json"
    path.write_text(json.dumps(measured))
    m = export.load_motion(run, rate=1000, lead_in=path, lead_in_speed=0.4)
    bare = export.load_motion(run, rate=1000)
    n, w, x, after = m.lead_in, plan.world, m.reference, bare.reference
    assert np.array_equal(x.q[n:], after.q)
    assert np.array_equal(x.v[n:], after.v)
    assert np.array_equal(x.q[0, w.qadr], [measured[j] for j in w.joints])
    assert np.array_equal(x.q[:n, :7], np.tile(after.q[0, :7], (n, 1)))  # base held
    speed = np.abs(x.v[: n + 1]).max(axis=0)
    assert speed.max() == pytest.approx(0.4, rel=1e-3)
    assert speed.max() <= 0.4
    # at rest, without a jump, at both ends; v is the derivative of q
    joints = x.q[: n + 100, w.qadr]
    assert not x.v[0].any()
    slope = (joints[2:] - joints[:-2]) * 500
    assert np.allclose(slope, x.v[1 : n + 99, w.dadr], atol=1e-5)
    assert np.abs(np.diff(slope, axis=0)).max() < 2e-3  # 2 rad/s^2
    assert np.abs(np.diff(x.tau[: n + 1], axis=0)).max() < 0.1
    assert m.contact[:n].tolist() == [bare.contact[0].tolist()] * n
    assert m.force is not None
    assert not m.force[:n].any()
    assert np.array_equal(m.states.q[:n], x.q[:n])


def test_the_torques_of_a_lead_in_hold_the_measured_posture(
    plan: Plan, planned: Path, home: dict[str, float]
):
    """A right arm stretched forward loads its shoulder by its weight and lever."""
    w = plan.world
    m = export.load_motion(planned, rate=100, lead_in=home | {"RShSag": -1.5})
    kin = Kinematics(w)
    kin.update(m.reference.q[0])
    joint = w.joints.index("RShSag")
    torque = m.reference.tau[:, joint]
    assert torque[0] == pytest.approx(kin.gravity()[w.dadr[joint]], abs=1e-9)
    assert abs(torque[0]) > abs(torque[m.lead_in])


def test_a_lead_in_is_in_every_format(run: Path, home: dict[str, float], tmp_path):
    measured = home | {"RElbj": -1.0}
    sizes = set()
    for to in ("csv", "mcap", "npz"):
        out = tmp_path / f"a.{to}"
        done = clamber.export_run(run, to=to, out=out, rate=50, lead_in=measured)
        sizes.add((done.samples, done.lead_in))
    ((samples, lead_in),) = sizes
    assert lead_in == pytest.approx(1.875 * 0.5708 / 0.5, abs=0.02)
    table = pandas.read_csv(tmp_path / "a.csv")
    f = np.load(tmp_path / "a.npz")
    points = messages(tmp_path / "a.mcap")["/joint_trajectory"][0][2].points
    assert len(table) == len(f["qpos"]) == len(points) == samples
    elbow = f["joint_names"].tolist().index("RElbj")
    assert table["RElbj position [rad]"][0] == f["joint_pos"][0, elbow] == -1.0
    assert points[0].positions[elbow] == -1.0


def test_a_robot_that_stands_at_home_needs_no_lead_in(run: Path):
    assert export.load_motion(run, rate=50, lead_in="home").lead_in == 0


def test_legs_that_are_bent_otherwise_stand_on_the_ground_all_the_same(
    run: Path, home: dict[str, float]
):
    """The base, which is held, would have to rise: that is not a collision."""
    bent = home | {"LKneeSag": 0.7, "RKneeSag": 0.7}
    assert export.load_motion(run, rate=50, lead_in=bent).lead_in > 0


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"RElbow": 0.1}, "RElbow"),
        ({"RElbj": None}, "RElbj"),
        ({"RElbj": 1.0}, "RElbj"),
        ({"RElbj": float("nan")}, "RElbj"),
        ({"RElbj": True}, "RElbj"),
        ("LAnkLat", "LAnkLat"),  # not measured
    ],
)
def test_a_measured_posture_that_cannot_be_is_refused(
    run: Path, home: dict[str, float], change: dict | str, field: str
):
    measured = {k: x for k, x in home.items() if k != change}
    if isinstance(change, dict):
        measured |= change
    with pytest.raises(InputError) as e:
        export.load_motion(run, rate=50, lead_in=measured)
    assert e.value.field == field


@pytest.mark.parametrize(
    ("change", "said"),
    [
        # A turned upper arm has the hand before the waist: apart now, not on the way.
        ({"LShYaw": -1.5}, r"after \d+ % of the way"),
        ({"LShLat": -0.3}, "would meet in it"),
        ({"LHipSag": -1.3, "LKneeSag": 0.3}, r"\bbox\b"),
    ],
)
def test_a_lead_in_on_which_links_meet_is_refused(
    plan: Plan, run: Path, home: dict[str, float], change: dict, said: str
):
    with pytest.raises(InputError, match=said) as refusal:
        export.load_motion(run, rate=50, lead_in=home | change)
    a, b = str(refusal.value).split("line: ")[1].split(" would")[0].split(" and ")
    names = {plan.world.model.geom(i).name for i in range(plan.world.model.ngeom)}
    assert {a, b} <= names


@pytest.mark.parametrize("speed", [0.0, -1.0, float("nan"), float("inf")])
def test_a_lead_in_without_a_speed_is_refused(
    run: Path, home: dict[str, float], speed: float
):
    bent = home | {"RElbj": -1.0}
    with pytest.raises(InputError) as e:
        export.load_motion(run, rate=50, lead_in=bent, lead_in_speed=speed)
    assert e.value.source == "--lead-in-speed"


# Files and mistakes.


@pytest.mark.parametrize("to", ["csv", "mcap", "npz"])
def test_the_same_run_gives_the_same_bytes(run: Path, tmp_path: Path, to):
    a, b = (
        clamber.export_run(run, to=to, out=tmp_path / f"{i}.{to}", rate=20).file
        for i in "ab"
    )
    assert a.read_bytes() == b.read_bytes()


@pytest.mark.parametrize(
    ("options", "source", "value"),
    [
        ({"to": "bvh"}, "export_run()", "bvh"),
        ({"to": "csv", "rate": 0}, "--rate", 0),
        ({"to": "csv", "rate": 300}, "--rate", 300),
        ({"to": "csv", "rate": 2000}, "--rate", 2000),
        ({"to": "csv", "layout": "mjlab"}, "--layout", "mjlab"),
        ({"to": "npz", "layout": "gmr"}, "export_run()", "gmr"),
        ({"to": "csv", "lead_in": "nowhere.yaml"}, Path("nowhere.yaml"), None),
        ({"to": "csv", "out": "no/folder/a.csv"}, "--out", "no/folder/a.csv"),
    ],
)
def test_what_cannot_be_exported_is_named(
    run: Path, options: dict, source: object, value: object
):
    with pytest.raises(InputError) as e:
        clamber.export_run(run, **options)
    assert (e.value.source, e.value.value) == (source, value)
    assert "\n" not in str(e.value)


def test_a_folder_without_a_plan_or_without_a_trajectory_is_refused(
    plan: Plan, tmp_path: Path
):
    with pytest.raises(InputError, match=r"plan\.json"):
        clamber.export_run(tmp_path, to="csv")
    save_plan(replace(plan, trajectory=None, complete=False), tmp_path)
    with pytest.raises(InputError, match="as far as a trajectory"):
        clamber.export_run(tmp_path, to="csv")


def test_the_command_says_what_it_wrote(run: Path, capsys: pytest.CaptureFixture[str]):
    assert cli.main(["export", str(run), "--to", "npz", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    f = np.load(said["file"], allow_pickle=False)
    assert said["file"] == str(run / "motion.npz")
    assert said["samples"] == len(f["qpos"])
    assert said["rate"] == f["fps"].item()
    assert said["forces"] is True
