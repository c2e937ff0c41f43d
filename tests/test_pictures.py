"""Pictures: everything in view, marks where they belong, plots that say what is so."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import subprocess
import sys
import threading
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import clamber
from clamber.errors import ClamberError, InputError
from clamber.execution.simulation import Rollout
from clamber.model.kinematics import Kinematics
from clamber.model.scene import Box, Scene
from clamber.model.world import World, build_world
from clamber.planning.records import Plan
from clamber.recording.built_in import source_of
from clamber.run import folder as run_files
from clamber.show import film, framing, marks, pictures, renderer
from clamber.show.sample import force_by_contact, planned_forces
from clamber.show.skeleton import skeleton_of
from test_gait import POLICY

SIZE = (160, 120)


@pytest.fixture
def opengl() -> None:
    if renderer.gl_backend() is None:
        pytest.skip("no OpenGL here")


def in_view(world: World, postures: np.ndarray) -> np.ndarray:
    return framing.seen_points(Kinematics(world), postures)


def pixels(path: Path) -> np.ndarray:
    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB")).astype(int)


# Views.


@pytest.mark.parametrize("aspect", [0.7, 1.0, 16 / 9])
@pytest.mark.parametrize("yaw", [0.0, 2.0])
def test_the_nearest_view_has_every_point_in_and_one_on_the_border(
    aspect: float, yaw: float, rng: np.random.Generator
):
    points = rng.uniform(-1, 1, (50, 3)) * [0.4, 0.3, 0.9] + [3.0, -2.0, 0.5]
    view = framing.frame_view(points, aspect, yaw=yaw)
    size = (round(1000 * aspect), 1000)
    seen = view.project(points, size)
    free = framing.MARGIN / 2 * np.array(size)
    off = np.abs(seen - np.array(size) / 2) / (np.array(size) / 2 - free)
    assert off.max() == pytest.approx(1.0, abs=2e-3)


def test_points_are_drawn_where_the_projection_says(plan: Plan, opengl: None):
    size = (320, 240)
    world = plan.world
    view = framing.view_of(world, in_view(world, world.home[None]), size[0] / size[1])
    kin = Kinematics(world)
    kin.update(world.home)
    with renderer.Camera(world, size) as camera:
        picture = np.asarray(camera.shot(world.home, view)).astype(int)
    x, y = view.project(kin.point(*foot_of(plan)), size).round().astype(int)
    r, g, b = picture[y, x]  # the feet are orange
    assert r > 1.5 * g > 1.5 * b


def foot_of(plan: Plan) -> tuple[int, np.ndarray]:
    s = plan.world.surfaces["LFoot"]
    left = s.corners[s.corners[:, 1] > s.corners[:, 1].mean()]
    return s.body, left.mean(axis=0) + np.array([0.0, 0.0, 0.012])


def test_the_whole_robot_is_in_view_in_every_posture(plan: Plan, rollout: Rollout):
    postures = rollout.qpos[::50]
    view = framing.view_of(plan.world, in_view(plan.world, postures), 4 / 3)
    kin = Kinematics(plan.world)
    for q in postures:
        kin.update(q)
        seen = view.project(framing.robot_corners(kin), (640, 480))
        assert np.all(seen > 0)
        assert np.all(seen < [640, 480])


def test_all_of_a_near_box_is_seen_and_of_a_large_one_what_is_near():
    motion = np.array([[0.0, -0.3, 0.0], [0.5, 0.3, 1.0]])
    scene = Scene.from_height(0.3)
    corners = framing.obstacle_points(scene, motion)
    near = framing.NEAR * 1.0
    assert corners[:, 0].min() == pytest.approx(0.23)
    assert corners[:, 0].max() == pytest.approx(0.5 + near)  # of 1.23
    np.testing.assert_allclose(sorted(set(corners[:, 2].round(9))), [0.0, 0.3])
    np.testing.assert_allclose(np.abs(corners[:, 1]), 0.6)
    far = motion + np.array([0.0, 5.0, 0.0])
    assert len(framing.obstacle_points(scene, far)) == 0
    nothing = Scene(start=np.zeros(3))
    assert framing.obstacle_points(nothing, motion).shape == (0, 3)


# Words.


def test_a_caption_gives_the_figures_of_the_keyframe(plan: Plan):
    first, last = plan.keyframes[0], plan.keyframes[-1]
    held, step = plan.equilibria, plan.changes[0].step
    title, geometry, balance = pictures.keyframe_caption(1, last, held[-1], step)
    assert title == "1  air -> LHand on box"
    d = next(c for c in last.contacts if c.contact.surface == "LHand")
    assert f"d LHand {1000 * d.projected_distance:.0f} mm" in geometry
    assert f"CoM margin {1000 * last.com_margin:.0f} mm" in geometry
    assert f"{held[-1].margin:.2f} m g" in balance
    assert str(held[-1].limiting) in balance
    assert (
        pictures.keyframe_caption(0, first, held[0], None)[0]
        == "0  start, on LFoot, RFoot"
    )


def test_forces_of_the_contacts_carry_the_weight(plan: Plan):
    for key in plan.keyframes:
        total = np.sum(list(force_by_contact(plan.world, key).values()), axis=0)
        weight = [0.0, 0.0, plan.world.mass * 9.81]
        np.testing.assert_allclose(total, weight, atol=0.5)


@pytest.mark.parametrize(
    ("seconds", "speedup"), [(3.0, 1), (12.0, 1), (14.0, 1), (46.0, 4), (270.0, 32)]
)
def test_long_runs_are_shown_faster_by_a_power_of_two(seconds: float, speedup: int):
    assert film.speedup_of(seconds) == speedup
    assert seconds / speedup <= film.VIDEO_SECONDS


# Files.


def test_a_run_is_drawn_whole_and_twice_the_same(
    plan: Plan, rollout: Rollout, tmp_path: Path, opengl: None
):
    run_files.save_plan(plan, tmp_path)
    run_files.save_rollout(plan, rollout, tmp_path)
    told: list[tuple[str, float]] = []
    files = pictures.render_run(
        tmp_path,
        with_video=False,
        report=lambda s, share, note: told.append((s, share)),
    )
    names = ["contacts.png", "stability.png", "keyframes.png", "climb.png"]
    assert [f.name for f in files] == names
    assert told[0] == ("pictures", 0.0)
    assert told[-1] == ("pictures", 1.0)
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]
    assert (tmp_path / "climb.png").stat().st_size < 300_000
    for f in files:
        assert pixels(f).std() > 10, f
    before = {f: f.read_bytes() for f in files}
    pictures.render_run(tmp_path, with_video=False)
    assert {f: f.read_bytes() for f in files} == before


def test_a_plan_alone_shows_its_keyframes_with_their_contacts(
    plan: Plan, tmp_path: Path, opengl: None
):
    run_files.save_plan(plan, tmp_path)
    assert [f.name for f in pictures.render_run(tmp_path)] == ["keyframes.png"]
    green = marks.PHASE_COLOURS["supporting"]
    sheet = pixels(tmp_path / "keyframes.png")
    assert np.all(sheet == green, axis=2).sum() > 100


def test_the_picture_of_another_posture_differs(plan: Plan, opengl: None):
    view = framing.view_of(
        plan.world, in_view(plan.world, np.array([k.q for k in plan.keyframes])), 4 / 3
    )
    with renderer.Camera(plan.world, SIZE) as camera:
        a, b, c = (
            np.asarray(camera.shot(plan.keyframes[i].q, view)) for i in (0, -1, 0)
        )
    assert np.array_equal(a, c)
    assert np.mean(np.any(a != b, axis=2)) > 0.02


def short(rollout: Rollout) -> Rollout:
    """Its last second, ten times slower: a video of a few pictures."""
    rows = slice(-20, None)
    return replace(
        rollout,
        time=np.arange(20) * 0.02,
        qpos=rollout.qpos[rows],
        qvel=rollout.qvel[rows],
    )


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_video_has_as_many_pictures_as_its_length_asks(
    plan: Plan, rollout: Rollout, tmp_path: Path, opengl: None
):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    path = film.video(plan, short(rollout), tmp_path)
    assert path.name == "video.mp4"
    frames = ffmpeg.read_frames(str(path))
    about = next(frames)
    assert about["size"] == (1280, 720)
    assert about["fps"] == film.FPS
    assert len(list(frames)) == 8
    assert len(path.read_bytes()) > 1000


def test_without_ffmpeg_the_video_is_a_webp(
    plan: Plan,
    rollout: Rollout,
    tmp_path: Path,
    opengl: None,
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    path = film.video(plan, short(rollout), tmp_path)
    assert path.name == "video.webp"
    with Image.open(path) as picture:
        assert picture.n_frames == 4
        assert picture.size == film.WEBP_SIZE


def test_without_opengl_plots_are_drawn_and_the_reason_is_one_sentence(
    plan: Plan, rollout: Rollout, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    run_files.save_plan(plan, tmp_path)
    run_files.save_rollout(plan, rollout, tmp_path)
    monkeypatch.setattr(renderer, "gl_backend", lambda: None)
    with pytest.raises(ClamberError, match="apt-get install libegl1") as e:
        pictures.render_run(tmp_path)
    assert "\n" not in str(e.value)
    drawn = {p.name for p in tmp_path.glob("*.png")}
    assert drawn == {"contacts.png", "stability.png"}


def test_a_backend_that_does_not_work_is_not_chosen(monkeypatch: pytest.MonkeyPatch):
    renderer.gl_backend.cache_clear()
    monkeypatch.setenv("MUJOCO_GL", "off")
    assert renderer.gl_backend() is None
    renderer.gl_backend.cache_clear()


@pytest.mark.parametrize(
    ("name", "drawn"),
    [
        ("rollout.npz", {"keyframes.png"}),
        ("execution.json", {"contacts.png", "stability.png", "keyframes.png"}),
        ("timings.json", {"contacts.png", "stability.png", "keyframes.png"}),
    ],
)
def test_what_does_without_a_broken_file_is_drawn_before_that_is_named(
    name: str,
    drawn: set[str],
    plan: Plan,
    rollout: Rollout,
    tmp_path: Path,
    opengl: None,
):
    run_files.save_plan(plan, tmp_path)
    run_files.save_rollout(plan, rollout, tmp_path)
    run_files.save_timings(tmp_path, {"plan": 1.0})
    (tmp_path / name).write_bytes((tmp_path / name).read_bytes()[:100])
    with pytest.raises(InputError, match=name):
        pictures.render_run(tmp_path, with_video=False)
    assert drawn <= {p.name for p in tmp_path.glob("*.png")}


def test_a_folder_without_a_plan_is_not_drawn(tmp_path: Path):
    with pytest.raises(InputError, match=r"plan\.json: expected a readable file"):
        pictures.render_run(tmp_path)


@pytest.mark.whole
def test_loading_the_module_changes_no_setting():
    code = "import os, json; a = dict(os.environ); import clamber.show.pictures; "
    code += "print(json.dumps({k: v for k, v in os.environ.items() if a.get(k) != v}))"
    out = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True,
        env={k: v for k, v in os.environ.items() if k != "MUJOCO_GL"},
    )  # fmt: skip
    assert json.loads(out.stdout) == {}


# One picture, from where it is wanted.


@pytest.fixture(scope="module")
def run(whole: Path) -> Path:
    return whole


@pytest.mark.parametrize(
    ("camera", "way"),
    [
        ("side", [0, -1, 0]),
        ("front", [-1, 0, 0]),
        ("behind", [1, 0, 0]),
        ("top", [0, 0, -1]),
    ],
)
def test_cameras_look_from_where_their_name_says(
    camera: framing.Preset, way: list[float]
):
    """Of a robot that faces along x; turned with it."""
    points = np.random.default_rng(3).normal(size=(20, 3))
    forward = framing.frame_view(points, 1.5, camera=camera).axes[2]
    assert forward @ way > 0.9
    turned = framing.frame_view(points, 1.5, yaw=np.pi / 2, camera=camera).axes[2]
    np.testing.assert_allclose(turned, [-forward[1], forward[0], forward[2]], atol=1e-9)


@pytest.mark.parametrize("camera", ["corner", "top"])
def test_from_no_side_is_the_ground_white(
    run: Path, tmp_path: Path, camera: framing.Preset, opengl: None
):
    """Its chequers are to be seen."""
    made = pictures.render_frame(
        run, 1.0, size=SIZE, camera=camera, out=tmp_path / "a.png"
    )
    assert np.mean(pixels(made).min(axis=2) > 250) < 0.02


def test_a_frame_shows_the_state_at_its_time(
    run: Path, rollout: Rollout, tmp_path: Path, opengl: None
):
    a = pictures.render_frame(run, 1.0, size=SIZE, marks="none", out=tmp_path / "a.png")
    size = SIZE[0] / SIZE[1]
    view = framing.view_of(rollout.world, in_view(rollout.world, rollout.qpos), size)
    row = int(np.argmin(np.abs(rollout.time - 1.0)))
    with renderer.Camera(rollout.world, SIZE) as camera:
        wanted = np.asarray(camera.shot(rollout.qpos[row], view)).astype(int)
    assert np.array_equal(pixels(a), wanted)
    b = pictures.render_frame(
        run, 1.0, size=SIZE, camera="front", out=tmp_path / "b.png"
    )
    assert np.mean(np.any(pixels(a) != pixels(b), axis=2)) > 0.2


def test_a_frame_of_a_plan_needs_no_physics(plan: Plan, tmp_path: Path, opengl: None):
    run_files.save_plan(plan, tmp_path)
    path = pictures.render_frame(tmp_path, 0.5, size=SIZE)
    assert path == tmp_path / "frame-0.5.png"
    assert pixels(path).std() > 10


def test_a_frame_of_a_plan_shows_the_forces_that_hold_it(
    plan: Plan, tmp_path: Path, opengl: None
):
    """Over each contact an arrow; together they are the weight, at any time."""
    run_files.save_plan(plan, tmp_path)
    weight = 9.81 * plan.world.mass
    for row in (0, len(plan.trajectory.time) // 2, -1):
        closed, forces = planned_forces(plan, plan.trajectory, row)
        assert np.all(closed == plan.trajectory.contact[row])
        assert forces.sum(axis=0) == pytest.approx([0, 0, weight], abs=1e-3 * weight)
        assert np.all(forces[closed, 2] > 0)
        assert not forces[~closed].any()
    end = float(plan.trajectory.time[-1])
    seen = [
        pixels(
            pictures.render_frame(
                tmp_path, end, size=SIZE, marks=marks, out=tmp_path / f"{marks}.png"
            )
        )
        for marks in ("contacts", "forces")
    ]
    assert np.any(seen[0] != seen[1], axis=2).sum() > 40  # two arrows of 30 pixels


def test_a_transparent_frame_has_the_robot_and_nothing_behind_it(
    run: Path, rollout: Rollout, tmp_path: Path, opengl: None
):
    size = (320, 240)
    path = pictures.render_frame(
        run, 0.0, size=size, transparent=True, out=tmp_path / "t.png"
    )
    with Image.open(path) as picture:
        assert picture.mode == "RGBA"
        assert picture.size == size
        rgba = np.asarray(picture).astype(int)
    alpha = rgba[..., 3]
    world = rollout.world
    view = framing.view_of(world, in_view(world, rollout.qpos), size[0] / size[1])
    kin = Kinematics(world)
    kin.update(rollout.qpos[0])
    x, y = view.project(kin.com, size).round().astype(int)
    assert alpha[y, x] == 255
    assert alpha[0].max() == 0  # the sky
    assert 0.1 < np.mean(alpha == 0) < 0.9
    edge = (alpha > 0) & (alpha < 255)
    assert 0.001 < edge.mean() < 0.05  # smooth, and thin
    ground = np.array([[0.0, 1.5, 0.0], [0.0, -0.6, 0.0]])
    for x, y in view.project(ground, size).round().astype(int):
        if 0 <= x < size[0] and 0 <= y < size[1]:
            assert alpha[y, x] == 0


@pytest.mark.parametrize("time", [-0.1, 1e6, float("nan")])
def test_a_time_that_the_run_has_not_is_one_sentence(run: Path, time: float):
    with pytest.raises(InputError, match="expected a time from 0 to"):
        pictures.render_frame(run, time, size=SIZE)


def test_a_picture_has_the_ending_of_its_format(
    run: Path, plan: Plan, rollout: Rollout
):
    with pytest.raises(InputError, match=r"ends in \.png"):
        pictures.render_frame(run, 0.0, out=run / "a.gif")
    with pytest.raises(InputError, match=r"\.mp4 or \.webp"):
        film.video(plan, rollout, run, out=run / "a.avi")


def test_an_mp4_without_ffmpeg_says_what_brings_it(
    run: Path, plan: Plan, rollout: Rollout, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(clamber.MissingDependency, match=r"clamber\[video\]"):
        film.video(plan, rollout, run, out=run / "a.mp4")


def test_a_video_has_the_size_and_side_that_was_asked(
    plan: Plan, rollout: Rollout, tmp_path: Path, opengl: None
):
    frames = {}
    for camera in ("corner", "behind"):
        path = film.video(
            plan,
            short(rollout),
            tmp_path,
            out=tmp_path / f"{camera}.webp",
            size=(200, 120),
            camera=camera,
        )
        with Image.open(path) as picture:
            assert picture.size == (200, 120)
            frames[camera] = np.asarray(picture.convert("RGB")).astype(int)
    assert np.abs(frames["corner"] - frames["behind"]).mean() > 5


# What is seen.


def orange(picture: np.ndarray) -> np.ndarray:
    """(h, w) bool, where the accent of a COMAN's surfaces is."""
    r, g, b = (picture[..., k].astype(int) for k in range(3))
    return (r > 1.5 * g) & (g > 1.3 * b) & (r > 70)


SCENES = {
    "low": Scene.from_height(0.1),
    "usual": Scene.from_height(0.275),
    "wide": Scene(
        start=np.zeros(3),
        boxes=(
            Box(
                name="street",
                size=np.array([30.0, 20.0, 0.4]),
                centre=np.array([15.3, 0.0, 0.2]),
                rotation=np.eye(3),
            ),
        ),
    ),
}


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("robot", ["coman", "coman29"])
def test_the_whole_robot_is_in_the_picture_and_fills_its_share(
    scene: str, robot: str, opengl: None
):
    """At the start, half way and at the end of a way of a metre and a half."""
    world = build_world(clamber.load_robot(robot), SCENES[scene])
    ways = np.tile(world.home, (3, 1))
    ways[:, 0] += np.linspace(0.0, 1.5, 3)
    ways[:, 2] += np.linspace(0.0, 0.4, 3)
    size = (320, 180)
    view = framing.view_of(world, in_view(world, ways), size[0] / size[1])
    with renderer.Camera(world, size) as camera:
        for q in ways:
            found = np.asarray(camera.cutout(q, view))
            accent = orange(found) & (found[..., 3] > 200)
            assert accent.sum() > 12, "the robot is not there"
            rows, columns = np.nonzero(accent)
            kin = Kinematics(world)
            kin.update(q)
            at = view.project(framing.robot_corners(kin), size)
            assert at.min() > 0
            assert np.all(at.max(axis=0) < size)
            assert np.all(at.min(axis=0)[1] - 2 <= rows.min())
            assert np.ptp(at[:, 1]) > 0.18 * size[1]
            assert columns.max() < size[0] - 1


def test_a_frame_shows_its_contacts_and_their_forces_on_request(
    run: Path, tmp_path: Path, opengl: None
):
    size, green = (480, 360), marks.PHASE_COLOURS["supporting"]
    count = {}
    for which in ("none", "contacts", "forces"):
        path = pictures.render_frame(
            run, 0.3, size=size, marks=which, out=tmp_path / f"{which}.png"
        )
        count[which] = int(np.all(pixels(path) == green, axis=2).sum())
    assert count["none"] == 0
    assert count["contacts"] > 60
    assert count["forces"] > 1.2 * count["contacts"]
    usual = pictures.render_frame(run, 0.3, size=size, out=tmp_path / "usual.png")
    assert np.array_equal(pixels(usual), pixels(tmp_path / "contacts.png"))


def test_the_person_is_beside_the_robot_in_a_video_and_called_synthetic(
    plan: Plan, rollout: Rollout, opengl: None
):
    demo = clamber.load_demo("climb")
    skeleton = skeleton_of(demo, clamber.detect_contacts(demo))
    size = (320, 180)
    frames = [
        np.asarray(x)
        for x in film._frames(
            plan, short(rollout), 20.0, size, "corner", "none", skeleton, _silent
        )
    ]
    for picture in (frames[0], frames[-1]):
        r, g, b = (picture[..., k].astype(int) for k in range(3))
        person = (b > 1.3 * g) & (g > 1.15 * r)
        assert person.sum() > 100
        columns = np.nonzero(person)[1]
        assert columns.min() > 0
        robot = np.nonzero(orange(picture))[1]
        assert len(robot) > 20
        assert np.median(columns) < np.median(robot) - 0.15 * size[0]
    points = in_view(rollout.world, rollout.qpos)
    who = film.Person(skeleton, rollout.world, points, "corner")
    assert who.name == "person (synthetic)"


def test_the_person_is_whom_the_plan_goes_back_to_by_way_of_a_policy_too(
    plan: Plan,
):
    shown = replace(plan, sequence=replace(plan.sequence, source=source_of("climb")))
    person = film.skeleton_of_plan(shown)
    assert person is not None
    assert person.demo.synthetic
    assert film.skeleton_of_plan(plan) is None  # of nothing that is at hand
    assert film.skeleton_of_plan(replace(shown, policy=POLICY)) is not None


def _silent(stage: str, share: float, note: str) -> None:
    pass


def test_shadows_are_soft_and_lie_on_the_ground(plan: Plan, opengl: None):
    world, size = plan.world, (320, 240)
    view = framing.view_of(world, in_view(world, world.home[None]), size[0] / size[1])
    with renderer.Camera(world, size) as camera:
        shaded = np.asarray(camera.shot(world.home, view)).astype(int)
        plain = camera._drawn(camera._frame, (0, 0, *size)).picture.resize(size)
        plain = np.asarray(plain).astype(int)
    darker = 1.0 - shaded.sum(axis=2) / np.maximum(plain.sum(axis=2), 1)
    assert darker.max() > 0.25
    assert np.mean(darker > 0.25) > 0.005
    edge = (darker > 0.04) & (darker < 0.2)
    assert edge.sum() > 0.1 * (darker > 0.25).sum()  # not a step


@pytest.mark.parametrize("robot", ["coman", "coman29"])
@pytest.mark.parametrize("size", [(640, 360), (322, 182)])
@pytest.mark.parametrize("glass", [False, True])
def test_what_is_drawn_over_what_stands_still_is_the_whole_picture(
    robot: str, size: tuple[int, int], glass: bool, opengl: None
):
    """Shadows that move are moved, those that stay are kept."""
    scene = clamber.Scene.from_height(0.3)
    world = build_world(clamber.load_robot(robot), scene)
    ways = np.tile(world.home, (3, 1))
    ways[:, 0] += np.linspace(0.0, 1.0, 3)
    ways[:, 2] += np.linspace(0.0, 0.5, 3)
    seen = in_view(world, ways)
    at = seen.max(axis=0)
    view = framing.view_of(world, seen, size[0] / size[1])
    post = renderer.block(np.full(3, 0.2), at, np.eye(3), (0.2, 0.4, 0.9, 1.0))
    colour = (0.9, 0.4, 0.2, 0.5 if glass else 1.0)
    ball = renderer.ball(at - [0.0, 0.4, 0.3], 0.1, colour)
    with renderer.Camera(world, size, fine=False) as camera:
        still = camera.still(view, post)
        for q in ways:
            whole = np.asarray(camera.shot(q, view, [ball, *post])).astype(int)
            over = np.asarray(camera.shot(q, view, [ball], still)).astype(int)
            assert np.mean(np.abs(whole - over).max(axis=2) > 6) < 1e-3
            part = camera._covered(view)[1]
            is_whole = part == (0, 0, *size)
            assert is_whole == (size != (640, 360))  # of odd pixels there is no part


def test_of_a_frame_only_what_moves_is_drawn_anew(plan: Plan, opengl: None):
    """Ground and boxes cost most of a picture; they are kept, with their depth."""
    world, size = plan.world, (640, 360)
    view = framing.view_of(world, in_view(world, world.home[None]), size[0] / size[1])
    drawn: list[tuple[int, bool]] = []
    with renderer.Camera(world, size, fine=False) as camera:
        still, draw = camera.still(view), camera._drawn

        def counted(size, part, *, movers=False, shadows=False):
            drawn.append((size[0], movers or shadows))
            return draw(size, part, movers=movers, shadows=shadows)

        camera._drawn = counted
        camera.shot(world.home, view, still=still)
        assert drawn == [(800, True), (320, True), (320, True)]
        assert len(camera._moving) < camera._scene.ngeom - 12


def test_two_cameras_draw_the_video_of_one(
    plan: Plan,
    rollout: Rollout,
    tmp_path: Path,
    opengl: None,
    monkeypatch: pytest.MonkeyPatch,
):
    files = []
    for cameras in (1, 2):
        monkeypatch.setattr(film, "CAMERAS", cameras)
        out = tmp_path / f"{cameras}.webp"
        files.append(film.video(plan, rollout, tmp_path, out=out, size=SIZE))
    assert files[0].read_bytes() == files[1].read_bytes()


def test_what_threads_make_in_turns_is_in_order_and_ends_with_its_reader():
    made: list[int] = []

    def share(of: range):
        for i in of:
            made.append(i)
            yield i
            if i == 40:
                raise ValueError("no picture")

    assert list(film.taking_turns(share, 9, 2)) == list(range(9))
    with pytest.raises(ValueError, match="no picture"):
        list(film.taking_turns(share, 60, 2))
    before = threading.active_count()
    turns = film.taking_turns(share, 10_000, 3)
    assert next(turns) == 0
    turns.close()
    assert threading.active_count() == before
    assert max(made) < 100  # none runs ahead of its reader


def test_no_phase_of_a_contact_is_red():
    """What the thesis calls sliding is held by friction in a run that succeeds."""
    for r, g, b in marks.PHASE_COLOURS.values():
        assert not (r > 180 and g < 100 and b < 100)
    text = (files("clamber.show") / "web" / "report.js").read_text()
    line = next(x for x in text.splitlines() if x.startswith("const PHASES ="))
    said = dict(re.findall(r'"?([\w-]+)"?: "#(\w{6})"', line))
    told = {k: bytes.fromhex(v) for k, v in said.items()}
    assert told == {k: bytes(v) for k, v in marks.PHASE_COLOURS.items()}
