"""The live view without a browser: what is served, what is edited, what is refused."""

from __future__ import annotations

import shutil
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import clamber
from clamber import cli
from clamber.contact.contact import region_of
from clamber.errors import InputError, MissingDependency
from clamber.execution.simulation import Rollout
from clamber.model.scene import Scene
from clamber.planning.records import Plan
from clamber.show import editor, scene3d
from clamber.show.editor import Edits
from clamber.show.live import LAYERS, open_view
from clamber.show.page import Clock, paragraphs
from clamber.show.sample import keyframe_times, sample_motion
from clamber.show.scene3d import Stage
from clamber.show.skeleton import (
    Skeleton,
    paired_times,
    skeleton_of,
    to_the_right,
)
from test_gait import POLICY

NASTY = "<img src=x onerror=alert(1)>"


# The person.


@pytest.fixture(scope="module")
def climber() -> Skeleton:
    demo = clamber.load_demo("climb")
    return skeleton_of(demo, clamber.detect_contacts(demo))


def test_a_skeleton_stands_where_it_was_recorded(demo_sequence: Any):
    demo = clamber.load_demo("climb")
    skeleton = skeleton_of(demo, demo_sequence)
    t = float(demo.t[100])
    p, seen = skeleton.at(t)
    ends = p[skeleton.bones[seen[skeleton.bones].all(axis=1)]]
    knee = demo.point("LKnee")[100]
    assert np.linalg.norm(ends - knee, axis=2).min() < 1e-9
    contacts = skeleton.contacts(t)
    assert {x.part for x in contacts} == {"LFoot", "RFoot"}
    for x in contacts:
        off = x.contact.position - demo.point(x.part)[100]
        assert np.linalg.norm(off[:2]) < 0.1
    np.testing.assert_array_equal(skeleton.at(1e9)[0], skeleton.position[-1])
    np.testing.assert_array_equal(skeleton.at(-1.0)[0], skeleton.position[0])
    assert skeleton.changes()[0] == demo.t[0]


def test_what_is_put_to_the_right_leaves_a_gap_between_the_boxes():
    a, b = Scene.from_height(0.25), Scene.from_height(0.5)
    points = np.zeros((1, 3))
    way = to_the_right(a, points, b, points)
    assert way[1] == pytest.approx(-(0.6 + 0.6 + 0.3))
    assert way[0] == pytest.approx(0.0)


def test_the_person_makes_its_contacts_when_the_robot_does(
    one_hand_plan: Plan, climber: Skeleton
):
    reached = keyframe_times(one_hand_plan, None)
    robot, person = paired_times(one_hand_plan, reached, 99.0, climber)
    assert np.interp(reached[1] or 0.0, robot, person) == pytest.approx(1.0)
    assert np.all(np.diff(robot) > 0)
    assert np.all(np.diff(person) >= 0)


def test_by_a_policy_robot_and_person_come_onto_the_box_at_the_same_time(
    demo_plan: Plan, climber: Skeleton
):
    assert climber.sequence is not None
    own = demo_plan.sequence.t  # of a plan by a policy, no time of the person's
    invented = replace(demo_plan.sequence, t=np.arange(float(len(own))))
    plan = replace(demo_plan, policy=POLICY, sequence=invented)
    reached = [100.0 + 10.0 * i for i in range(len(plan.keyframes))]
    reached[0] = 0.0
    began = list(climber.sequence.t[:-1])
    regions = [s.region for s in climber.sequence.stances]
    mine = [region_of(k.stance) for k in plan.keyframes]
    robot, person = paired_times(plan, [*reached], 999.0, climber)
    for region in ("M", "O"):
        at, t = reached[mine.index(region)], began[regions.index(region)]
        assert np.interp(at, robot, person) == pytest.approx(t)
    assert np.interp(999.0, robot, person) == climber.sequence.t[-1]
    # A robot that never comes wholly on top: nor does the person.
    stuck = [t if r != "O" else None for t, r in zip(reached, mine, strict=True)]
    robot, person = paired_times(plan, stuck, 999.0, climber)
    assert person[-1] == pytest.approx(began[regions.index("O")])


def test_a_long_run_is_sampled_no_finer_than_it_can_be_opened_at_once(
    whole: Path, monkeypatch: pytest.MonkeyPatch
):
    sampled = []

    def noted(*args: Any) -> Any:
        sampled.append(sample_motion(*args))
        return sampled[-1]

    monkeypatch.setattr(scene3d, "MOST", 20)
    monkeypatch.setattr(scene3d, "sample_motion", noted)
    page = open_view(whole, port=18090)
    page.close()
    assert [len(m.time) <= 20 for m in sampled] == [True]


# Edits.


def test_a_contact_that_is_moved_is_planned_where_it_was_put(one_hand_plan: Plan):
    ((name, hand),) = editor.intervals_of(one_hand_plan).items()
    assert hand.contact.surface == "LHand"
    place = hand.planned + np.array([0.04, 0.03, 0.1])
    again = editor.plan_edited(one_hand_plan, Edits(moved={name: ("box", place)}))
    assert again.complete
    made = next(c for c in again.keyframes[1].stance if c.surface == "LHand")
    np.testing.assert_allclose(made.position[:2], place[:2], atol=0.005)
    assert made.position[2] == pytest.approx(0.25, abs=1e-3)


def test_a_contact_that_is_moved_to_another_support_is_made_there(one_hand_plan: Plan):
    (name,) = editor.intervals_of(one_hand_plan)
    edits = Edits(moved={name: ("ground", np.array([0.15, 0.2, 0.1]))})
    stance = editor.edited_sequence(one_hand_plan, edits).stances[1]
    (hand,) = (c for c in stance.contacts if c.surface == "LHand")
    assert hand.support == "ground"
    np.testing.assert_allclose(hand.position, [0.15, 0.2, 0.0], atol=1e-9)


def test_contacts_go_with_a_box_that_is_moved(one_hand_plan: Plan):
    (box,) = one_hand_plan.world.scene.boxes
    there = replace(box, centre=box.centre + 0.02 * np.eye(3)[0])
    again = editor.plan_edited(one_hand_plan, Edits(boxes={"box": there}))
    assert again.complete
    assert again.world.scene.boxes[0].centre[0] == pytest.approx(there.centre[0])
    a, b = (
        next(c for c in p.sequence.stances[1].contacts if c.surface == "LHand")
        for p in (one_hand_plan, again)
    )
    np.testing.assert_allclose(b.position - a.position, [0.02, 0, 0], atol=1e-6)


def test_no_edit_is_the_same_plan(one_hand_plan: Plan):
    again = editor.plan_edited(one_hand_plan, Edits())
    for a, b in zip(again.keyframes, one_hand_plan.keyframes, strict=True):
        np.testing.assert_array_equal(a.q, b.q)


def test_a_surface_that_is_off_makes_no_contact(one_hand_plan: Plan):
    sequence = editor.edited_sequence(one_hand_plan, Edits(off=frozenset({"LHand"})))
    assert not any("LHand" in s.surfaces for s in sequence.stances)
    without = Edits(off=frozenset({"LHand"}))
    assert not editor.plan_edited(one_hand_plan, without).complete


def test_saving_writes_a_run_of_its_own_and_overwrites_nothing(
    one_hand_plan: Plan, tmp_path: Path
):
    ((name, hand),) = editor.intervals_of(one_hand_plan).items()
    again = editor.plan_edited(
        one_hand_plan, Edits(moved={name: ("box", hand.planned)})
    )
    first, second = (editor.save_edited(tmp_path, again) for _ in range(2))
    assert [first.name, second.name] == ["edited", "edited-2"]
    elsewhere = tmp_path.parent / f"{tmp_path.name}-elsewhere"
    elsewhere.mkdir()
    for n, target in ((3, elsewhere), (4, tmp_path / "nowhere")):
        (tmp_path / f"edited-{n}").symlink_to(target)  # nobody's way out of the folder
    assert editor.save_edited(tmp_path, again).name == "edited-5"
    assert not list(elsewhere.iterdir())
    assert not (tmp_path / "nowhere").exists()
    assert clamber.load_plan(first).complete
    hand_on = clamber.load_sequence(first).stances[1].contact("LHand")
    assert hand_on is not None
    assert hand_on.fixed


# Time.


def test_time_plays_to_its_end_and_is_stepped_through():
    told: list[float] = []
    clock = Clock(told.append)
    clock.span(0.0, 2.0, [2.0, 0.5, 0.0])
    clock.step(1)
    assert clock.t == 0.5
    clock.step(1)
    assert clock.t == 2.0
    clock.step(-1)
    assert clock.t == 0.5
    clock.advance(0.3)
    assert clock.t == 0.5  # it stands still
    clock.toggle()
    clock.speed = 2.0
    clock.advance(0.25)
    assert clock.t == told[-1] == 1.0
    clock.step(-1)
    assert not clock.playing
    clock.toggle()
    clock.advance(9.0)
    assert (clock.t, clock.playing) == (2.0, False)
    clock.toggle()
    assert (clock.t, clock.playing) == (0.0, True)  # from the beginning again
    clock.span(0.0, 0.0, [0.0])
    clock.toggle()
    assert not clock.playing  # there is nothing to play


# What is served, and what is refused.


def test_names_are_escaped():
    assert NASTY not in paragraphs([NASTY])
    assert "&lt;img" in paragraphs([NASTY])


def test_without_viser_the_pip_command_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(MissingDependency, match=r"pip install 'clamber\[view\]'"):
        open_view(tmp_path)


@pytest.mark.whole
def test_help_and_import_do_without_viser():
    code = (
        "import sys, contextlib; from clamber.cli import main\n"
        "import clamber.show.live\n"
        "with contextlib.suppress(SystemExit): main(['view', '--help'])\n"
        "assert 'viser' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


@pytest.mark.parametrize(
    ("options", "source"),
    [
        ({"source": "nowhere.c4d"}, "recording"),
        ({"source": "climb", "host": "203.0.113.7"}, "--host"),
        ({"source": "climb", "port": 70000}, "--port"),
        ({"source": "climb", "demo": "climb"}, "climb"),
        ({"source": "climb", "beside": ["climb"]}, "climb"),
        ({"demo": "climb"}, "climb"),
    ],
)
def test_what_cannot_be_served_is_named(options: dict[str, Any], source: str):
    pytest.importorskip("viser")
    with pytest.raises(InputError) as e:
        open_view(**options)
    assert str(e.value.source) == source


def test_an_empty_folder_is_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    pytest.importorskip("viser")
    assert cli.main(["view", str(tmp_path)]) == 2
    err = capsys.readouterr().err
    assert "a run folder with plan.json or sequence.json" in err
    assert err.count("\n") == 1


@pytest.mark.parametrize("name", ["plan.json", "planned.xml", "rollout.npz"])
def test_what_is_broken_is_named_and_the_rest_is_served(
    name: str, whole: Path, tmp_path: Path
):
    pytest.importorskip("viser")
    run = Path(shutil.copytree(whole, tmp_path / "run"))
    file = run / name
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    page = open_view(run, port=18080)
    page.close()
    assert any(m.startswith(name) for m in page.missing), page.missing


def test_a_plan_without_trajectory_is_served_by_its_keyframes(
    one_hand_plan: Plan, tmp_path: Path
):
    pytest.importorskip("viser")
    clamber.save_plan(replace(one_hand_plan, trajectory=None, complete=False), tmp_path)
    page = open_view(tmp_path, port=18080)
    assert page.clock.events == [0.0, 1.0]
    page.close()


def test_a_run_beside_a_longer_one_says_that_it_is_done(
    one_hand_plan: Plan, one_hand_rollout: Rollout
):
    viser = pytest.importorskip("viser")
    server = viser.ViserServer(host="127.0.0.1", port=18080, verbose=False)
    stage = Stage(server, one_hand_plan, one_hand_rollout, "/run")
    end = stage.duration
    assert f"{end:.2f} of {end:.1f} s; " in stage.show(end, dict(LAYERS))
    assert f"{end + 9:.2f} s; done after {end:.1f} s" in stage.show(
        end + 9, dict(LAYERS)
    )
    server.stop()


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
    ("words", "source", "beside"),
    [((), None, []), (("a",), "a", []), (("a", "b", "c"), "a", ["b", "c"])],
)
def test_the_command_shows_one_run_others_beside_it_or_how_to_begin(
    words: tuple[str, ...],
    source: str | None,
    beside: list[str],
    monkeypatch: pytest.MonkeyPatch,
):
    asked: list[tuple[str | None, list[str]]] = []

    def opened(source: str | None, *, beside: list[str], **_: Any) -> None:
        asked.append((source, beside))
        raise InputError("nothing more")

    monkeypatch.setattr("clamber.show.live.open_view", opened)
    assert cli.main(["view", *words]) == 2
    assert asked == [(source, beside)]


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
    monkeypatch.setattr("clamber.show.live.open_view", lambda *_, **__: page)

    def interrupted(_: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("time.sleep", interrupted)
    assert cli.main(["view", "climb"]) == 0
    out = capsys.readouterr().out
    assert all(text in out for text in said), out
    assert not any(text in out for text in not_said), out
