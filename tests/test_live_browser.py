"""The live view in a real browser: the robot is in the picture, whatever is done."""

from __future__ import annotations

import base64
import io
import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import clamber
from clamber.execution.simulation import Rollout
from clamber.model.scene import NEAR_FACE
from clamber.planning.records import Plan
from clamber.show.chart import COLOURS
from clamber.show.framing import PRESETS
from clamber.show.live import LAYERS, PERSON_LAYER
from clamber.show.scene3d import BEFORE_EDITING
from support.view import ON_SCREEN, SCENE, Opened, orange_in, served

pytest.importorskip("viser")
BROWSER_FLAGS: list[str] = []  # as Chromium draws by itself where there is no card


@pytest.fixture(scope="module")
def off_plan(
    one_hand_plan: Plan,
    one_hand_rollout: Rollout,
    tmp_path_factory: pytest.TempPathFactory,
) -> Path:
    """The run, to the left of where it was planned."""
    folder = tmp_path_factory.mktemp("off_plan")
    qpos = one_hand_rollout.qpos + 0.08 * (
        np.arange(one_hand_rollout.qpos.shape[1]) == 1
    )
    clamber.save_plan(one_hand_plan, folder)
    rollout = replace(one_hand_rollout, qpos=qpos)
    clamber.save_rollout(one_hand_plan, rollout, folder)
    return folder


@pytest.fixture(scope="module")
def shared_view(browser: Any, off_plan: Path) -> Iterator[Opened]:
    with served(browser, off_plan) as opened:
        opened.until(lambda: opened.orange() > ENOUGH, "the robot")
        opened.tab.get_by_text("Show", exact=True).click()
        yield opened


@pytest.fixture
def view(shared_view: Opened) -> Opened:
    """At its beginning, standing still."""
    shared_view.page.clock.go(0.0)
    shared_view.tab.wait_for_timeout(300)
    return shared_view


def client_of(view: Opened) -> Any:
    """The tab's connection: the last, where a busy browser had to connect again."""
    return list(view.page.server.get_clients().values())[-1]


HEIGHT = re.escape("height [m]")
ENOUGH = 300  # pixels of orange: feet, hands, elbows and knees from any side


def test_the_robot_is_there_at_rest_at_every_time(view: Opened):
    clock, seen = view.page.clock, []
    for share in (0.0, 0.3, 0.6, 1.0):
        clock.go(share * clock.end)
        view.tab.wait_for_timeout(400)
        assert view.orange() > ENOUGH
        seen.append(view.picture())
    assert np.mean(np.abs(seen[0] - seen[-1]).max(axis=2) > 30) > 0.005  # it moved


def test_the_robot_never_vanishes_while_it_plays(view: Opened):
    clock = view.page.clock
    usual, clock.speed = clock.speed, 0.25  # a picture takes seconds on a busy machine
    view.click("play")
    view.until(lambda: clock.playing)
    times, counts = [], []
    while clock.playing and len(counts) < 20:
        counts.append(view.orange())
        times.append(clock.t)
    clock.speed = usual
    if clock.playing:
        view.click("play")
        view.until(lambda: not clock.playing)
    assert len(counts) > 2
    assert min(counts) > ENOUGH, dict(zip(times, counts, strict=True))
    assert times[-1] > times[0]


def test_the_robot_never_vanishes_while_it_is_turned(view: Opened):
    mouse, counts = view.tab.mouse, []
    mouse.move(200, 300)
    mouse.down()
    for x in range(205, 305, 10):
        mouse.move(x, 300)
        counts.append(view.orange())
    mouse.up()
    for _ in range(5):
        counts.append(view.orange())
        view.tab.wait_for_timeout(200)
    assert min(counts) > ENOUGH, counts
    view.click("corner")


@pytest.mark.parametrize("camera", PRESETS)
def test_the_robot_is_in_view_of_every_camera(view: Opened, camera: str):
    before = view.picture()
    view.click(camera)
    view.tab.wait_for_timeout(800)
    assert view.orange() > (ENOUGH / 4 if camera == "top" else ENOUGH)
    if camera != "corner":
        assert np.mean(np.abs(before - view.picture()).max(axis=2) > 20) > 0.05
    view.click("corner")
    view.tab.wait_for_timeout(500)


MODES = [n for n in LAYERS if n not in (BEFORE_EDITING, PERSON_LAYER)]


@pytest.mark.parametrize("mode", ["shadows", *MODES])
def test_each_mode_changes_the_picture_and_leaves_the_robot_in_it(
    view: Opened, mode: str
):
    """Half way, where all of them have something to show; at rest and in motion."""
    clock, on = view.page.clock, not LAYERS.get(mode, False)
    view.page.aim(client_of(view), "front" if mode == "planned posture" else "corner")
    clock.go(0.4 * clock.end)
    view.tab.wait_for_timeout(1500)
    before = view.still()
    view.switch(mode, on)
    changed = 200 if mode in ("shadows", "transparent robot") else 8
    view.until(
        lambda: np.sum(np.abs(before - view.picture()).max(axis=2) > 12) > changed, mode
    )
    faded = 4 if mode == "transparent robot" else 1
    counts = [view.orange()]
    clock.toggle()
    view.tab.wait_for_timeout(300)
    counts.append(view.orange())
    clock.go(0.4 * clock.end)
    view.switch(mode, not on)
    assert min(counts) > ENOUGH / faded, counts
    view.until(lambda: alike(before, view.picture()), "as it was")


def alike(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether pictures are, in blocks: a busy browser draws them less sharply."""
    blocks = (x[:600].reshape(30, 20, 26, 20, 3).mean(axis=(1, 3)) for x in (a, b))
    return bool(np.abs(next(blocks) - next(blocks)).max() < 12)


SIZES = {
    "desktop": ({"width": 1280, "height": 800}, {"x": 0, "y": 0, "width": 900}),
    "small": ({"width": 760, "height": 480}, {"x": 0, "y": 0, "width": 390}),
    "phone": ({"width": 390, "height": 780}, {"x": 0, "y": 0, "width": 390}),
}


def all_of_it(picture: np.ndarray) -> bool:
    """Whether the robot is in a picture, neither its feet nor its sides cut off."""
    seen = orange_in(picture)
    edges = seen[-2:].any() or seen[:, [0, 1, -2, -1]].any()
    return bool(np.sum(seen) > ENOUGH and not edges)


@pytest.mark.parametrize("theme", ["light", "dark"])
@pytest.mark.parametrize("name", SIZES)
def test_the_robot_is_there_in_every_size_and_theme(
    browser: Any, whole: Path, name: str, theme: str
):
    """All of it, above the sheet of a phone; at rest and in motion."""
    size, clip = SIZES[name]
    height = 310 if name == "phone" else size["height"]
    query = "/?darkMode" if theme == "dark" else ""
    with served(browser, whole, query=query, size=size) as view:
        clip = {**clip, "height": height}
        view.until(lambda: all_of_it(view.picture(clip)), "all of the robot")
        assert (np.median(view.picture(clip)) < 60) == (theme == "dark")
        view.page.clock.toggle()
        counts = [int(np.sum(orange_in(view.picture(clip)))) for _ in range(3)]
        assert min(counts) > ENOUGH, counts
        wide = view.tab.evaluate("document.documentElement.scrollWidth")
        assert wide <= size["width"]
        view.folder("Verdict: value, limit")
        rights = """() => [...document.querySelectorAll('td')].map(
          cell => cell.getBoundingClientRect().right)"""
        assert 0 < max(view.tab.evaluate(rights)) <= size["width"]


def test_a_screen_that_turns_upright_still_has_the_whole_robot(
    browser: Any, whole: Path
):
    with served(browser, whole) as view:
        view.until(lambda: view.orange() > ENOUGH, "the robot")
        size, clip = SIZES["phone"]
        view.tab.set_viewport_size(size)
        view.tab.wait_for_timeout(500)
        clip = {**clip, "height": 310}
        view.until(lambda: all_of_it(view.picture(clip)), "all of the robot")


def test_every_frame_that_is_drawn_while_it_plays_has_the_robot_in_it(view: Opened):
    """Frames as the browser has drawn them: not those that a screenshot waits for."""
    frames: list[bytes] = []
    session = view.tab.context.new_cdp_session(view.tab)

    def keep(frame: dict[str, Any]) -> None:
        frames.append(base64.b64decode(frame["data"]))
        session.send("Page.screencastFrameAck", {"sessionId": frame["sessionId"]})

    session.on("Page.screencastFrame", keep)
    session.send("Page.startScreencast", {"format": "png"})
    view.page.clock.go(0.0, playing=True)
    view.until(lambda: not view.page.clock.playing)
    session.send("Page.stopScreencast")
    session.detach()
    counts = []
    for content in frames:
        picture = np.asarray(Image.open(io.BytesIO(content)).convert("RGB")).astype(int)
        counts.append(int(np.sum(orange_in(picture[:, : SCENE["width"]]))))
    assert len(counts) >= 5
    assert min(counts) > ENOUGH, counts
    assert len(set(counts)) > 1  # it moves


def test_contacts_are_stepped_through_by_buttons_and_keys(view: Opened):
    clock, tab = view.page.clock, view.tab
    assert len(clock.events) > 2
    view.click("contact >")
    view.until(lambda: clock.t == clock.events[1])
    tab.keyboard.press("PageDown")
    view.until(lambda: clock.t == clock.events[2])
    tab.keyboard.press("PageUp")
    view.until(lambda: clock.t == clock.events[1])
    view.click("< contact")
    view.until(lambda: clock.t == 0.0)
    tab.locator("canvas").first.focus()
    tab.keyboard.press("Space")
    view.until(lambda: clock.playing)
    tab.keyboard.press("Space")
    view.until(lambda: not clock.playing)


def handed_out(view: Opened, button: str, *endings: str) -> bytes:
    """The file that a button makes, as the browser saves it."""
    with view.tab.expect_download() as download:
        view.click(button)
    name = download.value.suggested_filename
    assert name.startswith("off_plan")
    assert name.endswith(endings)
    view.tab.wait_for_selector(f"text=Downloaded as {name}")
    return Path(download.value.path()).read_bytes()


def test_report_and_picture_are_handed_out(view: Opened):
    view.folder("Export")
    assert b"<!DOCTYPE html>" in handed_out(
        view, "Report: plots, tables, criteria", ".html"
    )
    picture = Image.open(io.BytesIO(handed_out(view, "Picture of this view", ".png")))
    seen = np.asarray(picture.convert("RGB")).astype(int)
    assert picture.mode == "RGBA"  # on nothing
    assert np.sum(orange_in(seen)) > ENOUGH
    view.folder("Export")


@pytest.mark.slow
def test_a_video_is_handed_out(browser: Any, off_plan: Path):
    with served(browser, off_plan) as view:
        view.folder("Export")
        view.tab.set_default_timeout(300_000)
        video = handed_out(view, "Video", ".mp4", ".webp")
        assert video[:4] == b"RIFF" or video[4:8] == b"ftyp"  # WebP, or MP4


def test_a_closed_tab_says_nothing_on_the_terminal(
    browser: Any, whole: Path, capfd: pytest.CaptureFixture[str]
):
    with served(browser, whole) as view:
        view.until(lambda: view.orange() > ENOUGH)
        for _ in range(2):
            tab = view.tab.context.new_page()
            tab.goto(view.page.url)
            tab.wait_for_selector('text="speed"')
            view.page.clock.go(0.0, playing=True)
            tab.close()
        view.tab.wait_for_timeout(500)
    assert capfd.readouterr() == ("", "")


def test_values_are_read_off_a_plot_and_the_present_is_marked(view: Opened):
    page, tab = view.page, view.tab
    view.folder("Over time")
    view.choose("plot", "contact forces [N]")
    tab.wait_for_timeout(1000)
    plot = tab.locator(".u-over").last
    plot.scroll_into_view_if_needed()
    tab.wait_for_timeout(800)
    box = plot.bounding_box()
    tab.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"])
    read = tab.locator(".u-legend .u-value").all_inner_texts
    view.until(lambda: "--" not in read()[:3], "values under the pointer")
    time, *forces = (float(x) for x in read()[:9] if x != "--")
    assert abs(time - 0.5 * page.clock.end) < 0.1 * page.clock.end
    assert sum(forces) > 0.5 * 26 * 9.81  # it is carried
    assert "NaN" not in tab.locator(".u-legend").first.inner_text()
    marks = """() => Object.values(window.__viserTestpoints.uplots)[0].chart
      .data.at(-1).findIndex(x => !Number.isNaN(x))"""
    first = tab.evaluate(marks)
    page.clock.go(page.clock.end)
    view.until(lambda: tab.evaluate(marks) > first, "a mark that has moved")
    drawn = view.picture({k: round(v) for k, v in box.items()})
    for colour in (COLOURS[4], COLOURS[6]):  # of the feet
        rgb = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
        assert np.sum(np.abs(drawn - rgb).max(axis=2) < 40) > 30, colour
    view.folder("Over time")


def test_keys_do_what_their_list_says(view: Opened):
    tab, clock = view.tab, view.page.clock
    view.folder("Keys")
    assert "Play or pause" in tab.inner_text("body")
    view.folder("Keys")
    tab.locator("canvas").first.focus()
    tab.keyboard.press("End")
    view.until(lambda: clock.t == clock.end)
    tab.keyboard.press("Home")
    view.until(lambda: clock.t == 0.0)
    tab.keyboard.press("1")
    tab.wait_for_timeout(800)
    before = view.picture()

    def other() -> float:
        return float(np.mean(np.abs(before - view.picture()) > 20))

    tab.keyboard.press("5")
    view.until(lambda: other() > 0.05, "from above")
    tab.keyboard.press("1")
    view.until(lambda: other() < 0.02, "as before")


def test_the_camera_goes_with_the_robot(browser: Any, whole: Path):
    """Where it is followed, it stays where it is in the picture."""
    with served(browser, whole) as view:
        view.until(lambda: view.orange() > ENOUGH)
        clock, client = view.page.clock, client_of(view)
        view.tab.locator("canvas").first.focus()
        view.tab.keyboard.press("F")
        view.folder("Show")
        view.until(lambda: view.row("follow the robot").is_checked())
        eye, target = np.array(client.camera.position), np.array(client.camera.look_at)
        clock.go(clock.end)
        view.tab.wait_for_timeout(500)
        way = np.array(client.camera.position) - eye
        assert np.linalg.norm(way[:2]) > 0.003
        assert abs(way[2]) < 1e-9
        np.testing.assert_allclose(client.camera.look_at - target, way, atol=1e-6)
        clock.go(0.0)
        np.testing.assert_allclose(client.camera.position, eye, atol=1e-6)


def test_runs_stand_beside_each_other(browser: Any, whole: Path, off_plan: Path):
    """Seen from behind there is a gap between two, and none in one."""
    gaps = []
    for sources in ((whole,), (whole, off_plan)):
        with served(browser, *sources) as view:
            view.until(lambda view=view: view.orange() > ENOUGH)
            if len(sources) == 1:  # several are seen from there at once
                view.page.aim(client_of(view), "behind")
            view.tab.wait_for_timeout(1000)
            columns = np.flatnonzero(orange_in(view.picture()).any(axis=0))
            gaps.append(np.diff(columns).max() / np.ptp(columns))
            for folder in sources[1:]:
                assert f"{folder}: no verdict" in view.tab.inner_text("body")
    assert gaps[0] < 0.35 < gaps[1], gaps


def drag_sideways(view: Opened) -> None:
    """By the mouse on the gizmo's second arrow, along it."""
    tab = view.tab
    points = [
        tab.evaluate(ON_SCREEN, ["/edit/contact", 0.0, s, 0.0]) for s in (0.15, 0.21)
    ]
    tab.mouse.move(*points[0])
    tab.wait_for_timeout(300)
    tab.mouse.down()
    tab.mouse.move(*points[1], steps=6)
    tab.wait_for_timeout(300)
    tab.mouse.up()


def test_a_contact_is_dragged_planned_simulated_and_saved(
    browser: Any, whole: Path, tmp_path: Path
):
    """With the mouse, on the arrow of the gizmo; what is beside the folder stays."""
    run = Path(shutil.copytree(whole, tmp_path / "run"))
    before = {p.name: p.read_bytes() for p in run.iterdir() if p.is_file()}
    with served(browser, run) as view:
        tab, page = view.tab, view.page
        view.until(lambda: view.orange() > ENOUGH)
        tab.get_by_text("Edit", exact=True).click()
        view.row("move").click()
        tab.get_by_role("option", name="LHand on box, stance 1").click()
        gizmo: Any = page.server.scene.get_handle_by_name("/edit/contact")
        view.until(lambda: gizmo.visible)
        tab.wait_for_timeout(800)
        start = np.array(gizmo.position)
        drag_sideways(view)
        tab.wait_for_selector("text=LHand on box, stance 1: moved by")
        view.until(lambda: gizmo.position[1] > start[1] + 0.02)
        place = np.array(gizmo.position)
        assert abs(place[0] - start[0]) < 1e-3  # along the arrow alone
        view.click("Re-plan")
        tab.wait_for_selector("text=Planned to the last stance: 1 changes")
        tab.wait_for_selector("text=edited plan: no verdict yet")
        view.until(lambda: view.orange() > ENOUGH, "the robot of the new plan")
        view.click("Simulate")
        tab.wait_for_selector("text=Physics: failed")
        tab.wait_for_selector("text=edited plan: failed")
        view.until(lambda: view.orange() > ENOUGH, "the robot of the new run")
        view.click("Save")
        tab.wait_for_selector("text=Saved as")
        assert all((run / n).read_bytes() == x for n, x in before.items())
        saved = clamber.load_plan(run / "edited")
        hand = next(c for c in saved.keyframes[1].stance if c.surface == "LHand")
        np.testing.assert_allclose(hand.position[:2], place[:2], atol=0.005)
        assert (run / "edited" / "verdict.json").is_file()
        view.click("Undo all")
        tab.wait_for_selector("text=edited plan", state="detached")
        view.folder("Surfaces")
        tab.get_by_text("use LHand").first.click()
        tab.wait_for_selector("text=without LHand")
        view.click("Re-plan")
        tab.wait_for_selector("text=No plan to the last stance")


def test_edits_are_undone_one_by_one_and_the_old_plan_stays_in_sight(
    browser: Any, whole: Path
):
    with served(browser, whole) as view:
        tab, page = view.tab, view.page
        view.until(lambda: view.orange() > ENOUGH)
        assert "stance 1: air -> LHand on box" in tab.inner_text("body")
        view.folder("Edit")
        view.choose("move", "obstacle box")
        view.until(
            lambda: np.any(pink_or_blue(view.picture())), "the box that is moved"
        )
        view.row(HEIGHT).fill("0.3")
        view.row(HEIGHT).press("Enter")
        tab.wait_for_selector("text=box: 0.300 m high, moved by 0 mm")
        drag_sideways(view)
        tab.wait_for_selector("text=box: 0.300 m high, moved by 0 mm", state="detached")
        moved = tab.get_by_text("box: 0.300 m high, moved by").inner_text()
        assert 20 < int(re.findall(r"(\d+) mm", moved)[0]) < 150
        view.click("Undo")
        tab.wait_for_selector("text=box: 0.300 m high, moved by 0 mm")
        view.choose("move", "LHand on box, stance 1")
        view.choose("onto", "ground")
        tab.wait_for_selector("text=onto ground")
        gizmo: Any = page.server.scene.get_handle_by_name("/edit/contact")
        view.until(lambda: gizmo.position[2] < 0.01, "the contact on the ground")
        assert gizmo.position[0] < NEAR_FACE - 0.04  # in front of the box, not in it
        view.click("Undo")
        tab.wait_for_selector("text=onto ground", state="detached")
        assert tab.get_by_text("0.300 m high").count() == 1
        view.click("Re-plan")
        tab.wait_for_selector("text=Planned to the last stance: 1 changes")
        page.clock.go(page.clock.end)
        tab.wait_for_timeout(500)
        view.choose("move", "none")
        without = np.sum(pink_or_blue(view.picture()))
        view.folder("Edit")
        view.folder("Show")
        view.switch("before editing", True)
        view.until(lambda: np.sum(pink_or_blue(view.picture())) > without + 50)
        view.folder("Show")
        view.folder("Edit")
        view.click("Undo")
        tab.wait_for_selector("text=0.300 m high", state="detached")


def pink_or_blue(picture: np.ndarray) -> np.ndarray:
    """(height, width) bool, where a ghost is seen."""
    _, g, b = np.moveaxis(picture, 2, 0)
    return (b > 1.15 * g) & (b > 90)


def test_a_recording_is_shown_in_the_dark(browser: Any):
    with served(browser, "climb", query="/?darkMode") as view:
        clock = view.page.clock
        view.until(lambda: view.blue() > 500, "the person")
        assert np.median(view.picture()) < 60  # it is dark
        view.click("contact >")
        view.until(lambda: clock.t == clock.events[1])
        view.click("play")
        view.until(lambda: clock.t > clock.events[1] + 0.3)
        assert view.blue() > 500
