"""The live view in a real browser: the robot is in the picture, whatever is done."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from clamber.show.chart import COLOURS
from clamber.show.framing import PRESETS
from clamber.show.live import LAYERS, PERSON_LAYER
from clamber.show.scene3d import BEFORE_EDITING
from support.view import ENOUGH, SCENE, Opened, client_of, orange_in, served

pytest.importorskip("viser")
BROWSER_FLAGS: list[str] = []  # as Chromium draws by itself where there is no card


@pytest.fixture(scope="module")
def shared_view(browser: Any, off_plan: Path) -> Iterator[Opened]:
    with served(browser, off_plan) as opened:
        opened.until(lambda: opened.orange() > ENOUGH, "the robot")
        opened.tab.get_by_text("Show", exact=True).click()
        yield opened


@pytest.fixture
def view(shared_view: Opened) -> Opened:
    """At its beginning, standing still."""
    shared_view.go(0.0)
    return shared_view


def test_the_robot_is_there_at_rest_at_every_time(view: Opened):
    clock, seen = view.page.clock, []
    for share in (0.0, 0.3, 0.6, 1.0):
        seen.append(view.go(share * clock.end))
        assert np.sum(orange_in(seen[-1])) > ENOUGH
    assert np.mean(np.abs(seen[0] - seen[-1]).max(axis=2) > 30) > 0.005  # it moved


def test_the_robot_never_vanishes_while_it_plays(view: Opened):
    clock = view.page.clock
    view.click("play")
    view.until(lambda: clock.playing)
    times, counts = [], []
    while clock.playing:
        counts.append(view.orange())
        times.append(clock.t)
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

    def turned() -> bool:
        return np.mean(np.abs(before - view.picture()).max(axis=2) > 20) > 0.05

    view.click(camera)
    if camera != "corner":
        view.until(turned, camera)
    seen = view.still()
    assert np.sum(orange_in(seen)) > (ENOUGH / 4 if camera == "top" else ENOUGH)
    view.click("corner")
    view.until(lambda: not turned(), "from where it was")


MODES = [n for n in LAYERS if n not in (BEFORE_EDITING, PERSON_LAYER)]


@pytest.mark.parametrize("mode", ["shadows", *MODES])
def test_each_mode_changes_the_picture_and_leaves_the_robot_in_it(
    view: Opened, mode: str
):
    """Half way, where all of them have something to show; at rest and in motion."""
    clock, on = view.page.clock, not LAYERS.get(mode, False)
    view.page.aim(client_of(view), "front" if mode == "planned posture" else "corner")
    before = view.go(0.4 * clock.end)
    view.switch(mode, on)
    changed = 200 if mode in ("shadows", "see-through robot") else 8
    view.until(
        lambda: np.sum(np.abs(before - view.picture()).max(axis=2) > 12) > changed, mode
    )
    faded = 4 if mode == "see-through robot" else 1
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
    """The file that a button makes."""
    view.click(button)
    link = view.tab.locator(", ".join(f"a[download$='{x}']" for x in endings)).first
    link.wait_for(state="attached")
    name = link.get_attribute("download")
    content = view.tab.evaluate(
        """async a => { const x = await (await fetch(a.href)).arrayBuffer();
           return btoa([...new Uint8Array(x)].map(c => String.fromCharCode(c)).join(""))
        }""",
        link.element_handle(),
    )
    assert name.startswith("off_plan")
    return base64.b64decode(content)


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
