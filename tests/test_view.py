"""The view: what is shown is what the run holds, edits reach the plan, and a browser
without any other network shows it."""

from __future__ import annotations

import json
import shutil
import socket
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import clamber
from clamber import cli
from clamber.errors import MissingDependency
from clamber.model.kinematics import Kinematics
from clamber.model.scene import Scene
from clamber.planning.records import Plan
from clamber.show.view import charts, edits, open_view
from clamber.show.view.person import beside, figure_at, show_person
from clamber.show.view.shown import (
    Shown,
    force_arrow,
    frame_at,
    person_times,
    show_run,
    tube,
    way_at,
    weight_of,
)

NASTY = "<img src=x onerror=alert(1)>"


# What is shown at a time.


def test_a_disc_lies_where_the_surface_is(ran: Shown):
    kin = Kinematics(ran.world)
    frame = frame_at(ran, kin, ran.duration)
    assert {x.surface for x in frame.touches} == {"LFoot", "RFoot", "LHand"}
    kin.update(ran.q[-1])
    for touch in frame.touches:
        support = ran.world.supports[touch.support]
        where = kin.contact_point(touch.surface, support.normal)
        np.testing.assert_allclose(touch.position, where)
        assert abs(support.height(touch.position)) < 3e-3
    hand = next(x for x in frame.touches if x.surface == "LHand")
    assert hand.support == "box"
    assert hand.friction == ran.world.supports["box"].friction


def test_forces_sum_to_the_weight_at_rest(ran: Shown, planned: Shown):
    for shown in (ran, planned):
        frame = frame_at(shown, Kinematics(shown.world), shown.duration)
        if shown is planned:
            last = shown.reached[-1]
            assert last is not None
            frame = frame_at(shown, Kinematics(shown.world), last)
        total = np.sum([x.force for x in frame.touches if x.force is not None], axis=0)
        weight = weight_of(shown.world)
        np.testing.assert_allclose(total, [0, 0, weight], atol=0.02 * weight)


def test_an_arrow_points_along_its_force_and_grows_with_it(ran: Shown):
    frame = frame_at(ran, Kinematics(ran.world), ran.duration)
    touch = next(x for x in frame.touches if x.force is not None)
    one, two = (
        force_arrow(ran.world, replace(touch, force=k * np.array([0.0, 0.0, 100.0])))
        for k in (1, 2)
    )
    assert one is not None
    assert two is not None
    np.testing.assert_allclose(one[0], touch.position)
    np.testing.assert_allclose(two[1] - two[0], 2 * (one[1] - one[0]))
    assert force_arrow(ran.world, replace(touch, force=np.zeros(3))) is None
    assert force_arrow(ran.world, replace(touch, force=None)) is None


def test_poses_are_those_of_physics_and_the_ghost_is_the_plan(ran: Shown):
    kin = Kinematics(ran.world)
    t = float(ran.time[len(ran.time) // 2])
    frame = frame_at(ran, kin, t)
    bodies = [m.body for m in ran.meshes]
    row = int(np.argmin(np.abs(ran.time - t)))
    for poses, q in ((frame.poses, ran.q), (frame.ghost, ran.reference)):
        assert poses is not None
        assert q is not None
        kin.update(q[row])
        np.testing.assert_allclose(poses[:, :3], kin.data.xpos[bodies])
        np.testing.assert_allclose(poses[:, 3:], kin.data.xquat[bodies])


def test_the_centre_of_mass_is_inside_polygon_and_margin(ran: Shown):
    frame = frame_at(ran, Kinematics(ran.world), ran.duration)
    assert frame.margin > 0
    side = np.roll(frame.polygon, -1, axis=0) - frame.polygon
    gap = frame.foot - frame.polygon
    across = side[:, 0] * gap[:, 1] - side[:, 1] * gap[:, 0]
    inside = across / np.linalg.norm(side[:, :2], axis=1)
    assert inside.min() == pytest.approx(frame.margin, abs=1e-6)
    for point in frame.ellipse:
        gap = point - frame.polygon
        assert np.all(side[:, 0] * gap[:, 1] - side[:, 1] * gap[:, 0] >= -1e-9)
    np.testing.assert_allclose(frame.foot[:2], frame.com[:2])


def test_stances_are_reached_in_order_and_stepped_through(ran: Shown):
    kin = Kinematics(ran.world)
    assert frame_at(ran, kin, 0.0).stance == 0
    assert frame_at(ran, kin, ran.duration).stance == 1
    events = ran.events()
    assert events[0] == 0.0
    assert events[-1] == ran.duration
    assert events == sorted(events)


def test_the_way_of_the_hand_ends_at_its_contact(planned: Shown):
    way = way_at(planned, 0.0)
    assert way is not None
    assert way.surface == "LHand"
    end = planned.plan.keyframes[1].stance[-1].position
    radius = planned.world.surfaces["LHand"].radius
    assert np.linalg.norm(way.points[-1] - end) == pytest.approx(radius, abs=0.01)
    assert way.radius > radius
    steps = np.linalg.norm(np.diff(way.points, axis=0), axis=1)
    assert steps.max() < 1.2 * steps.mean()
    assert way_at(planned, planned.duration) is None


def test_a_tube_keeps_its_radius_around_a_line():
    line = np.stack([np.linspace(0, 1, 9), np.zeros(9), np.zeros(9)], axis=1)
    vertices, faces = tube(line, 0.1)
    inner = vertices[(vertices[:, 0] > 0.01) & (vertices[:, 0] < 0.99)]
    np.testing.assert_allclose(np.hypot(inner[:, 1], inner[:, 2]), 0.1, atol=1e-9)
    assert vertices[:, 0].min() == pytest.approx(-0.1)
    assert faces.max() == len(vertices) - 1


def test_a_plan_without_trajectory_shows_its_keyframes(one_hand_plan: Plan):
    bare = show_run(replace(one_hand_plan, trajectory=None, complete=False), None)
    assert bare.duration == 1.0
    frame = frame_at(bare, Kinematics(bare.world), 1.0)
    assert frame.stance == 1
    assert frame.ghost is None
    assert any(x.force is not None for x in frame.touches)
    assert "No motion" in charts.plots(bare)


# The person.


def test_the_person_makes_its_contacts_when_the_robot_does(planned: Shown):
    robot, person = person_times(planned)
    assert np.interp(planned.reached[1] or 0.0, robot, person) == pytest.approx(1.0)
    assert np.all(np.diff(robot) > 0)
    assert np.all(np.diff(person) >= 0)


def test_a_stick_figure_stands_where_it_was_recorded(demo_sequence: Any):
    demo = clamber.load_demo("climb")
    offset = np.array([0.0, -2.0, 0.0])
    person = show_person(demo, demo_sequence, offset)
    figure = figure_at(person, float(demo.t[100]))
    knee = demo.point("LKnee")[100] + offset
    assert np.linalg.norm(figure.bones - knee, axis=2).min() < 1e-9
    assert {x.surface for x in figure.touches} == {"LFoot", "RFoot"}
    for touch in figure.touches:
        foot = demo.point(touch.surface)[100] + offset
        assert np.linalg.norm((touch.position - foot)[:2]) < 0.1
    late = figure_at(person, 1e9)
    np.testing.assert_allclose(late.joints, person.position[-1, person.joints])


def test_beside_leaves_a_gap_between_the_boxes():
    a, b = Scene.from_height(0.25), Scene.from_height(0.5)
    points = np.zeros((1, 3))
    way = beside(a, points, b, points)
    assert way[1] == pytest.approx(-(0.6 + 0.6 + 0.3))
    assert way[0] == pytest.approx(0.0)


# Edits.


def test_a_contact_that_is_moved_is_planned_where_it_was_put(one_hand_plan: Plan):
    spells = edits.spells_of(one_hand_plan)
    assert [s.contact.surface for s in spells] == ["LHand"]
    place = spells[0].planned + np.array([0.04, 0.03, 0.1])
    again = edits.plan_edited(one_hand_plan, edits.Edits(moved={0: place}))
    assert again.complete
    hand = next(c for c in again.keyframes[1].stance if c.surface == "LHand")
    np.testing.assert_allclose(hand.position[:2], place[:2], atol=0.005)
    assert hand.position[2] == pytest.approx(0.25, abs=1e-3)


def test_no_edit_is_the_same_plan(one_hand_plan: Plan):
    again = edits.plan_edited(one_hand_plan, edits.Edits())
    for a, b in zip(again.keyframes, one_hand_plan.keyframes, strict=True):
        np.testing.assert_array_equal(a.q, b.q)


def test_a_surface_that_is_off_makes_no_contact(one_hand_plan: Plan):
    off = edits.Edits(off=frozenset({"LHand"}))
    sequence = edits.edited_sequence(one_hand_plan, off)
    assert not any("LHand" in s.surfaces for s in sequence.stances)
    assert not edits.plan_edited(one_hand_plan, off).complete


@pytest.mark.parametrize("x", [-9.0, 0.5, 9.0])
@pytest.mark.parametrize("y", [-9.0, 0.1, 9.0])
def test_a_contact_stays_on_its_support(x: float, y: float):
    top = Scene.from_height(0.25).supports[1]
    point = edits.clamped(top, np.array([x, y, 3.0]))
    assert abs(top.height(point)) < 1e-12
    assert top.inside(point, 0.0)
    if x == 0.5 and y == 0.1:
        np.testing.assert_allclose(point[:2], [x, y])


def test_saving_writes_a_run_of_its_own_and_overwrites_nothing(
    one_hand_plan: Plan, tmp_path: Path
):
    spells = edits.spells_of(one_hand_plan)
    moved = edits.Edits(moved={0: spells[0].planned})
    again = edits.plan_edited(one_hand_plan, moved)
    first, second = (edits.save_edited(tmp_path, again) for _ in range(2))
    assert [first.name, second.name] == ["edited", "edited-2"]
    assert {p.name for p in tmp_path.iterdir()} == {"edited", "edited-2"}
    elsewhere = tmp_path.parent / f"{tmp_path.name}-elsewhere"
    elsewhere.mkdir()
    for n, target in ((3, elsewhere), (4, tmp_path / "nowhere")):
        (tmp_path / f"edited-{n}").symlink_to(target)  # nobody's way out of the folder
    assert edits.save_edited(tmp_path, again).name == "edited-5"
    assert not list(elsewhere.iterdir())
    assert not (tmp_path / "nowhere").exists()
    assert clamber.load_plan(first).complete
    back = clamber.load_sequence(first)
    assert [c.fixed for c in back.stances[1].contacts] == [False, False, True]


# Bad input.


def test_names_are_escaped(planned: Shown):
    row = {**planned.stances[1], "move": NASTY, "limiting": NASTY}
    for text in (charts.stance_table([row]), charts.notes([NASTY], NASTY)):
        assert NASTY not in text
        assert "&lt;img" in text


def test_without_viser_the_pip_command_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(MissingDependency, match=r"pip install 'clamber\[view\]'"):
        open_view(tmp_path)


def test_help_and_import_do_without_viser():
    import subprocess

    code = (
        "import sys, contextlib; from clamber.cli import main\n"
        "with contextlib.suppress(SystemExit): main(['view', '--help'])\n"
        "assert 'viser' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["nowhere.c4d"], "expected one of the built-in demonstrations"),
        (["climb", "--host", "203.0.113.7"], "--host is '203.0.113.7'"),
        (["climb", "--port", "70000"], "--port is 70000"),
        (["climb", "--demo", "climb"], "--demo goes with one"),
    ],
)
def test_wrong_flags_are_one_sentence(
    flags: list[str], said: str, capsys: pytest.CaptureFixture[str]
):
    pytest.importorskip("viser")
    assert cli.main(["view", *flags]) == 2
    err = capsys.readouterr().err
    assert said in err
    assert err.count("\n") == 1


def test_an_empty_folder_is_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    pytest.importorskip("viser")
    assert cli.main(["view", str(tmp_path)]) == 2
    assert "a run folder with plan.json or sequence.json" in capsys.readouterr().err


@pytest.mark.parametrize(
    "name", ["plan.json", "scene.xml", "trajectory.npz", "rollout.npz", "verdict.json"]
)
@pytest.mark.parametrize("how", ["cut", "foreign"])
def test_what_is_broken_is_named_and_the_rest_is_served(
    name: str, how: str, whole: Path, tmp_path: Path
):
    pytest.importorskip("viser")
    run = Path(shutil.copytree(whole, tmp_path / "run"))
    file = run / name
    if how == "cut":
        file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    elif name.endswith(".npz"):
        np.savez(file, time=np.zeros(3))
    else:
        file.write_text(json.dumps({"hello": "world"}))
    page = open_view(run, port=18080)
    page.close()
    assert any(m.startswith(name) for m in page.missing), page.missing


def test_a_port_in_use_takes_the_next_one(whole: Path):
    pytest.importorskip("viser")
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        taken = other.getsockname()[1]
        page = open_view(whole, port=taken)
        page.close()
    assert page.host == "127.0.0.1"
    assert page.wanted == taken < page.port < taken + 50


@pytest.mark.parametrize(
    ("host", "port", "said", "not_said"),
    [
        ("127.0.0.1", 8080, ["ssh -L 8080:127.0.0.1:8080 "], ["in use", "can edit"]),
        ("127.0.0.1", 8083, ["port 8080 is in use: 8083", "ssh -L 8083"], []),
        ("0.0.0.0", 8080, [f"http://{socket.gethostname()}:8080; ", "save"], ["ssh"]),
        ("10.0.0.7", 8080, ["http://10.0.0.7:8080"], ["ssh", "can edit"]),
    ],
)
def test_the_command_says_how_to_get_to_the_page(
    host: str,
    port: int,
    said: list[str],
    not_said: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    page = SimpleNamespace(
        host=host, port=port, wanted=8080, missing=[], url=f"http://{host}:{port}"
    )
    page.close = lambda: None
    monkeypatch.setattr("clamber.show.view.open_view", lambda *_, **__: page)

    def interrupted(_: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("time.sleep", interrupted)
    assert cli.main(["view", "climb"]) == 0
    out = capsys.readouterr().out
    assert all(text in out for text in said), out
    assert not any(text in out for text in not_said), out
