"""Tables, plots and the clock of the view: what stands there is what was measured."""

from __future__ import annotations

import math
import re
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import clamber
from clamber.contact.contact import ContactSequence
from clamber.model.kinematics import Kinematics
from clamber.planning.records import Plan
from clamber.show.pictures import PHASE_COLOURS
from clamber.show.renderer import frame_view
from clamber.show.sample import stance_rows
from clamber.show.view import charts
from clamber.show.view.charts import Line
from clamber.show.view.person import Person, show_person
from clamber.show.view.shown import Shown, frame_at, show_run

TIME = np.linspace(0.0, 8.0, 801)


@pytest.fixture(scope="module")
def person(demo_sequence: ContactSequence) -> Person:
    return show_person(clamber.load_demo("climb"), demo_sequence, np.zeros(3))


def paths(text: str) -> list[list[np.ndarray]]:
    """Points of each unbroken piece of each line of a plot."""
    out = []
    for d in re.findall(r'<path [^>]*d="([^"]*)"', text):
        pieces = [re.findall(r"-?[\d.]+", piece) for piece in d.split("M") if piece]
        out.append([np.array(p, dtype=float).reshape(-1, 2) for p in pieces])
    return out


def scale_of(text: str) -> tuple[float, float]:
    """Slope and offset from heights on the plot [px] to values, by its ticks."""
    ticks = re.findall(r'<span style="top:(-?[\d.]+)%">(-?[\d.e+]+)</span>', text)
    top, value = np.array(ticks, dtype=float).T
    slope, offset = np.polyfit(top / 100 * charts.HEIGHT, value, 1)
    return float(slope), float(offset)


# Plots.


def test_a_line_is_where_the_ticks_say_it_is():
    values = 3.0 * TIME - 5.0
    text = charts.plot("x [mm]", TIME, [Line(name="x", values=values)], {"top": 12.5})
    ((points,),) = paths(text)
    slope, offset = scale_of(text)
    assert points[0, 0] == 0.0
    assert points[-1, 0] == 1000.0
    t = TIME[0] + points[:, 0] / 1000 * (TIME[-1] - TIME[0])
    np.testing.assert_allclose(slope * points[:, 1] + offset, 3 * t - 5, atol=0.1)
    limit = re.search(r'class="limit" x1="0" x2="1000" y1="([\d.]+)"', text)
    assert limit
    assert slope * float(limit[1]) + offset == pytest.approx(12.5, abs=0.1)
    assert 'data-begin="0.000" data-end="8.000"' in text


def test_a_peak_between_two_points_is_drawn():
    values = np.zeros(5001)
    values[3333] = -40.0
    text = charts.plot(
        "x", np.linspace(0.0, 50.0, 5001), [Line(name="x", values=values)], {}
    )
    ((points,),) = paths(text)
    slope, offset = scale_of(text)
    assert (slope * points[:, 1] + offset).min() == pytest.approx(-40.0, abs=0.5)
    assert len(points) == charts.POINTS


def test_what_is_not_known_is_not_drawn():
    values = np.ones(801)
    values[200:400] = np.nan
    text = charts.plot("x", TIME, [Line(name="x", values=values)], {})
    (pieces,) = paths(text)
    assert [round(p[0, 0], -1) for p in pieces] == [0, 500]
    assert pieces[0][-1, 0] == pytest.approx(250, abs=4)
    none = charts.plot("x", TIME, [Line(name="x", values=np.full(801, np.nan))], {})
    assert paths(none) == [[]]
    assert "nan" not in none


def test_a_plot_of_nothing_but_zero_and_of_one_sample_has_a_scale():
    for samples, n in ((TIME, 801), (np.zeros(1), 1)):
        text = charts.plot("x", samples, [Line(name="x", values=np.zeros(n))], {})
        assert "nan" not in text
        slope, offset = scale_of(text)
        ((points,),) = paths(text)
        np.testing.assert_allclose(slope * points[:, 1] + offset, 0.0, atol=0.02)


def test_an_area_is_closed_at_zero():
    line = Line(name="x", values=np.full(801, 4.0), area=True)
    text = charts.plot("x", TIME, [line], {"limit": 10.0})
    ((points,),) = paths(text)
    slope, offset = scale_of(text)
    first, last = points[0], points[-1]
    assert slope * first[1] + offset == pytest.approx(0.0, abs=0.1)
    assert (first[0], last[0]) == (0.0, 1000.0)
    assert slope * last[1] + offset == pytest.approx(0.0, abs=0.1)


@pytest.mark.parametrize("span", [1e-4, 0.03, 1.0, 7.0, 19.0, 260.0, 4e5])
@pytest.mark.parametrize("low", [-3.0, 0.0, 0.4])
def test_ticks_are_round_few_and_inside(low: float, span: float):
    ticks = charts._ticks(low, low + span)
    assert 1 <= len(ticks) <= 4
    assert min(ticks) >= low - 1e-9 * span
    assert max(ticks) <= low + span * (1 + 1e-9)
    steps = np.diff(ticks)
    if len(steps):
        digit = steps[0] / 10 ** math.floor(math.log10(steps[0]) + 1e-9)
        assert round(digit, 6) in (1, 2, 5, 10)
        np.testing.assert_allclose(steps, steps[0])


def test_bars_lie_along_the_time_that_they_mean():
    text = charts.timeline(
        TIME, ["LHand", "RHand"], [[(2.0, 4.0)], []], [[(2.5, 3.0), (6.0, 8.0)], []]
    )
    bars = re.findall(
        r'<rect x="([\d.]+)" y="(\d+)" height="(\d+)" width="([\d.]+)"', text
    )
    thin, *bold = [[float(x) for x in bar] for bar in bars]
    assert (thin[0], thin[3]) == (250.0, 250.0)
    assert [(b[0], b[3]) for b in bold] == [(312.5, 62.5), (750.0, 250.0)]
    assert thin[2] < bold[0][2]
    assert all(b[1] < charts.ROW for b in bold)  # the second surface never touches
    alone = charts.timeline(TIME, ["LHand"], [[(2.0, 4.0)]], None)
    assert "bold" not in alone
    assert alone.count("<rect") == 1


def test_torques_are_shares_and_the_boldest_lines_are_the_largest(ran: Shown):
    m = ran.motion
    assert m.effort is not None
    text = charts.plots(ran)
    largest = np.abs(m.effort).max(axis=0).argsort()[::-1][: charts.BOLD_JOINTS]
    for j in largest:
        assert f"{m.world.joints[j]} ({m.world.tau_max[j]:g} N m)" in text
    section = text[text.index("Joint torque") : text.index("Centre of mass")]
    slope, offset = scale_of(section)
    lines = paths(section)
    assert len(lines) == charts.BOLD_JOINTS + 1  # and the others
    top = max(float((slope * p[:, 1] + offset).max()) for (p,) in lines[1:])
    assert top == pytest.approx(100 * np.abs(m.effort).max(), abs=0.5)


def test_a_plan_that_has_not_run_has_no_torques_and_no_tracking(one_hand_plan: Plan):
    text = charts.plots(show_run(one_hand_plan, None))
    assert "Joint torque" not in text
    assert "Tracking" not in text
    assert "Centre of mass" in text
    assert "planned" in text


# The clock.


def test_the_cursor_stands_where_time_does(ran: Shown):
    kin = Kinematics(ran.world)
    for share in (0.05, 0.25, 1.0):
        frame = frame_at(ran, kin, share * ran.duration)
        text = charts.clock(ran, frame)
        assert f"--clamber-at:{100 * share:.2f}%" in text
        assert f".clamber-s{frame.stance}{{" in text
        assert f"CoM margin</span><b>{1000 * frame.margin:.0f} mm</b>" in text
    late = charts.clock(ran, frame_at(ran, kin, 2 * ran.duration))
    assert "--clamber-at:100.00%" in late


def test_the_clock_names_the_joint_with_the_largest_share(ran: Shown):
    m, kin = ran.motion, Kinematics(ran.world)
    assert m.effort is not None
    row = len(m.time) // 3
    text = charts.clock(ran, frame_at(ran, kin, float(m.time[row])))
    j = int(np.abs(m.effort[row]).argmax())
    share = 100 * abs(float(m.effort[row, j]))
    assert f"torque, {m.world.joints[j]}</span><b>{share:.0f} %</b>" in text


def test_a_robot_in_the_air_has_no_margin(ran: Shown):
    frame = replace(frame_at(ran, Kinematics(ran.world), 0.0), margin=math.nan)
    assert "CoM margin" not in charts.clock(ran, frame)


def test_keyframes_without_motion_are_counted(one_hand_plan: Plan):
    bare = show_run(replace(one_hand_plan, trajectory=None, complete=False), None)
    text = charts.clock(bare, frame_at(bare, Kinematics(bare.world), 1.0))
    assert "keyframe 1" in text
    assert "torque" not in text


# Tables.


def test_a_stance_says_distance_angle_force_and_margin(ran: Shown):
    text = charts.stance_table(ran.stances)
    bodies = re.findall(r"<tbody.*?</tbody>", text, re.S)
    assert len(bodies) == len(ran.stances) == 2
    for body, row in zip(bodies, ran.stances, strict=True):
        assert f'data-t="{row["time"]:.3f}"' in body
        assert f"CoM margin {1000 * row['com_margin']:.0f} mm" in body
        for c in row["contacts"]:
            cells = (
                f"<td>{1000 * c['projected_distance']:.0f}</td>"
                f"<td>{math.degrees(c['contact_angle']):.0f}</td>"
                f"<td>{np.linalg.norm(c['force']):.0f}</td>"
            )
            assert cells in body
            assert f"rgb{PHASE_COLOURS[c['phase']]}" in body
    total = sum(np.array(c["force"])[2] for c in ran.stances[1]["contacts"])
    assert total == pytest.approx(ran.world.mass * 9.81, rel=1e-3)


def test_a_stance_that_is_never_reached_is_not_to_be_clicked(ran: Shown):
    rows = [{**ran.stances[0], "time": None, "com_margin": None, "limiting": ""}]
    rows[0]["contacts"] = [{**c, "force": None} for c in rows[0]["contacts"]]
    text = charts.stance_table(rows)
    assert "data-t=" not in text
    assert "never" in text
    assert "CoM margin -" in text
    assert "<td>-</td>" in text


def test_a_plan_of_no_keyframe_is_an_empty_table():
    assert stance_rows({}, []) == []
    assert "<tbody" not in charts.stance_table([])


def test_a_verdict_marks_what_failed():
    criteria = {
        "did not fall": {"value": 1.0, "limit": 1.0, "ok": True},
        "tilt [rad]": {"value": 0.51234567, "limit": 0.3491, "ok": False},
        "unknown": {"value": None, "limit": 0.1, "ok": False},
    }
    text = charts.verdict_table({"reached": False, "criteria": criteria})
    assert "did not make it" in text
    assert '<tr class="bad"><td>tilt [rad]</td><td>0.5123</td><td>0.3491</td>' in text
    assert '<tr class=""><td>did not fall</td>' in text
    assert "<td>unknown</td><td>-</td>" in text
    good = charts.verdict_table({"reached": True, "criteria": {}})
    assert "reached the goal" in good
    assert "not run in physics" in charts.verdict_table({})


def test_nothing_to_say_is_nothing():
    assert charts.notes(()) == ""
    assert charts.notes((), "", "") == ""
    assert charts.notes(("a",), "b").count("<p") == 2


# A recording.


def test_the_clock_of_a_recording_marks_its_stance(person: Person):
    sequence = person.sequence
    assert sequence is not None
    for i in (0, 2, len(sequence.stances) - 1):
        middle = float(sequence.t[i : i + 2].mean())
        text = charts.recording_clock(person, middle)
        assert f".clamber-s{i}{{" in text
        t = person.demo.t
        share = 100 * (middle - t[0]) / (t[-1] - t[0])
        assert f"--clamber-at:{share:.2f}%" in text
    late = charts.recording_clock(person, float(person.demo.t[-1]))
    assert f".clamber-s{len(sequence.stances) - 1}{{" in late
    bare = charts.recording_clock(replace(person, sequence=None), 1.0)
    assert ".clamber-s-1{" in bare


def test_stances_of_a_recording_jump_only_on_its_own_clock(person: Person):
    sequence = person.sequence
    assert sequence is not None
    jumping = charts.sequence_table(sequence, jumps=True)
    assert [float(t) for t in re.findall(r'data-t="([\d.]+)"', jumping)] == [
        pytest.approx(t, abs=1e-3) for t in sequence.t[:-1]
    ]
    assert "data-t=" not in charts.sequence_table(sequence, jumps=False)


def test_heights_of_a_recording_are_those_of_its_points(person: Person):
    text = charts.recording_plots(person)
    section = text[text.index("Height of the hands") : text.index("of the elbows")]
    slope, offset = scale_of(section)
    (left,), (right,) = paths(section)
    for points, name in ((left, "LHand"), (right, "RHand")):
        heights = slope * points[:, 1] + offset
        top = person.demo.point(name)[:, 2].max()
        assert heights.max() == pytest.approx(top, abs=0.01)
    box = person.demo.scene.boxes[0]
    limit = re.search(r'class="limit" [^>]*y1="([\d.]+)"', section)
    assert limit
    top = box.position[2] + box.size[2] / 2
    assert slope * float(limit[1]) + offset == pytest.approx(top, abs=0.01)


# Time that plays.


@pytest.fixture
def told() -> list[float]:
    return []


@pytest.fixture
def clock(told: list[float]) -> Any:
    pytest.importorskip("viser")
    from clamber.show.view.page import Clock

    clock = Clock(told.append)
    clock.span(1.0, 5.0, [4.0, 1.0, 2.0, 5.0])
    return clock


def test_time_stays_between_its_ends(clock: Any, told: list[float]):
    for asked, shown in ((-3.0, 1.0), (2.5, 2.5), (9.0, 5.0)):
        clock.go(asked)
        assert clock.t == told[-1] == shown
    clock.span(0.0, 2.0, [0.0, 2.0])
    assert clock.t == 2.0


def test_steps_go_from_event_to_event_and_stop_at_the_ends(clock: Any):
    clock.playing = True
    seen = []
    for way in (1, 1, 1, 1, -1, -1, -1, -1):
        clock.step(way)
        seen.append(clock.t)
    assert seen == [2.0, 4.0, 5.0, 5.0, 4.0, 2.0, 1.0, 1.0]
    assert not clock.playing
    clock.go(2.01)  # as good as there
    clock.step(1)
    assert clock.t == 4.0


def test_playing_follows_the_speed_and_ends_at_the_end(clock: Any):
    clock.advance(1.0)
    assert clock.t == 1.0  # it does not play
    clock.toggle()
    clock.advance(0.5)
    assert clock.t == pytest.approx(1.5)
    clock.speed = 4.0
    clock.advance(0.5)
    assert clock.t == pytest.approx(3.5)
    clock.advance(0.5)
    assert (clock.t, clock.playing) == (5.0, False)
    clock.toggle()  # once more from the beginning
    assert (clock.t, clock.playing) == (1.0, True)
    clock.toggle()
    assert not clock.playing


def test_a_run_of_one_instant_does_not_play(clock: Any):
    clock.span(0.0, 0.0, [0.0])
    clock.toggle()
    assert (clock.t, clock.playing) == (0.0, False)
    clock.step(1)
    clock.step(-1)
    assert clock.t == 0.0


def test_the_scene_is_told_of_each_frame_and_the_panel_of_some():
    pytest.importorskip("viser")
    from clamber.show.view.page import PANEL_SECONDS, Page

    page = Page("127.0.0.1", 18110, "test")
    try:
        scene: list[float] = []
        panel: list[float] = []
        page.watch(scene.append)
        page.watch(panel.append, panel=True)
        page.span(0.0, 100.0, [0.0, 100.0])
        page.clock.toggle()
        began = time.perf_counter()
        for i in range(200):
            page.clock.go(0.01 * i)
            time.sleep(0.002)
        took = time.perf_counter() - began
        assert len(scene) >= 200
        assert 1 <= len(panel) <= 3 + took / PANEL_SECONDS
        page.clock.toggle()
        assert panel[-1] == scene[-1] == page.clock.t  # standing still: both
    finally:
        page.close()


@pytest.mark.parametrize(
    ("host", "url"),
    [
        ("127.0.0.1", "http://127.0.0.1:7"),
        ("0.0.0.0", "http://localhost:7"),
        ("::1", "http://[::1]:7"),
        ("::", "http://localhost:7"),
        ("box.example", "http://box.example:7"),
    ],
)
def test_the_address_is_one_that_a_browser_takes(host: str, url: str):
    pytest.importorskip("viser")
    from clamber.show.view.page import Page

    address: Any = Page.url
    assert address.fget(SimpleNamespace(host=host, port=7)) == url


def test_lines_on_the_ground_make_squares_of_one_size():
    pytest.importorskip("viser")
    from clamber.show.view import page

    vertices, faces = page._ground_lines()
    strips = vertices.reshape(-1, 4, 3)
    assert len(faces) == 2 * len(strips)
    assert np.all(vertices[:, 2] == 0.0)
    middles = strips.mean(axis=1)
    along_y = np.ptp(strips[:, :, 1], axis=1) > 1.0
    for which, axis in ((along_y, 0), (~along_y, 1)):
        at = np.sort(middles[which, axis])
        np.testing.assert_allclose(np.diff(at), page.GROUND_CELL)
        assert (at[0], at[-1]) == (-page.GROUND_SIZE / 2, page.GROUND_SIZE / 2)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    assert np.all(np.cross(b - a, c - a)[:, 2] > 0)  # seen from above


@pytest.mark.parametrize("camera", ["corner", "side", "front", "behind", "top"])
def test_a_camera_has_all_points_in_its_picture(camera: Any, rng: np.random.Generator):
    pytest.importorskip("viser")
    from clamber.show.view.page import ASPECT, eye_of

    points = rng.normal(size=(40, 3)) * [0.6, 0.3, 0.4] + [0.5, 0.0, 0.5]
    view = frame_view(points, ASPECT, yaw=0.7, fovy=45.0, camera=camera)
    off = points - eye_of(view)
    right, up, back = view.axes
    depth = off @ -back if (off @ -back).mean() > 0 else off @ back
    assert depth.min() > 0
    high = math.tan(math.radians(view.fovy) / 2)
    assert np.abs(off @ up / depth).max() <= high
    assert np.abs(off @ right / depth).max() <= high * ASPECT


def test_the_file_names_of_a_run_are_no_markup(tmp_path: Path):
    nasty = "<b onclick=x>"
    for text in (
        charts.plot(nasty, TIME, [Line(name=nasty, values=TIME)], {nasty: 1.0}),
        charts.timeline(TIME, [nasty], [[(0.0, 1.0)]], None),
        charts.verdict_table(
            {
                "reached": False,
                "criteria": {nasty: {"value": 1.0, "limit": 1.0, "ok": True}},
            }
        ),
    ):
        assert nasty not in text
        assert "&lt;b onclick=x&gt;" in text
