"""The live view in a real browser: the robot is in the picture, whatever is done.

Judged by pixels: of COMAN's colours only its orange is nowhere else in the scene, and
only a recording's person is of its blue.
"""

from __future__ import annotations

import contextlib
import io
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import clamber
from clamber.execution.simulation import Rollout
from clamber.planning.records import Plan
from clamber.show.live import LAYERS, open_view
from clamber.show.renderer import PRESETS

pytest.importorskip("viser")
BROWSER_FLAGS: list[str] = []  # as Chromium draws by itself where there is no card
SIZE = {"width": 900, "height": 620}
SCENE = {"x": 0, "y": 0, "width": 520, "height": 620}  # beside the panel
# Where a point of the world is on the screen [px]; three.js has y up, we have z.
ON_SCREEN = """([name, x, y, z]) => {
  const m = window.__viserMutable, camera = m.camera;
  const p = camera.position.clone().set(x, y, z);
  p.applyMatrix4(m.nodeRefFromName[name].matrixWorld).project(camera);
  const b = m.canvas.getBoundingClientRect();
  return [b.left + (p.x + 1) / 2 * b.width, b.top + (1 - p.y) / 2 * b.height] }"""


@dataclass(frozen=True, kw_only=True)
class Opened:
    """A page, the browser's tab on it, and what that has complained of."""

    page: Any
    tab: Any
    complaints: list[str]

    def until(self, met: Callable[[], Any], told: object = "") -> None:
        for _ in range(400):
            if met():
                return
            self.tab.wait_for_timeout(50)
        pytest.fail(f"it never came: {told}")

    def row(self, label: str) -> Any:
        """What belongs to a label of the panel."""
        found = self.tab.locator("label", has_text=re.compile(f"^{label}$")).first
        return found.locator("xpath=../../..").locator("input").first

    def switch(self, label: str, on: bool) -> None:
        if self.row(label).is_checked() != on:
            self.row(label).click()

    def click(self, button: str) -> None:
        self.tab.get_by_role("button", name=button, exact=True).click()

    def picture(self) -> np.ndarray:
        """(height, width, 3) of the scene."""
        shot = self.tab.screenshot(clip=SCENE)
        return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB")).astype(int)

    def orange(self) -> int:
        """Pixels of the robot."""
        r, g, b = np.moveaxis(self.picture(), 2, 0)
        return int(np.sum((r > 100) & (r > 2.5 * b) & (r > 1.3 * g)))

    def blue(self) -> int:
        """Pixels of the person."""
        r, g, b = np.moveaxis(self.picture(), 2, 0)
        return int(np.sum((b > 1.2 * r) & (b > 1.05 * g) & (r > 60)))


@contextlib.contextmanager
def served(browser: Any, source: Any, query: str = "", **options: Any):
    page, complaints = open_view(source, port=18090), []
    tab = browser.new_context(viewport=SIZE, **options).new_page()
    tab.set_default_timeout(40_000)
    tab.on("pageerror", lambda e: complaints.append(str(e)))
    tab.on("console", lambda m: m.type == "error" and complaints.append(m.text))

    def allow(route: Any) -> None:
        if route.request.url.startswith((page.url, "blob:", "data:")):
            route.continue_()
        else:
            complaints.append(route.request.url)
            route.abort()

    try:
        tab.route("**/*", allow)
        tab.goto(page.url + query)
        tab.wait_for_selector("text=speed")
        tab.add_style_tag(content=".mantine-Notification-root {display: none}")
        opened = Opened(page=page, tab=tab, complaints=complaints)
        yield opened
        assert complaints == []
        tab.context.close()
    finally:
        page.close()


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
    view.click(camera)
    view.tab.wait_for_timeout(800)
    assert view.orange() > ENOUGH
    if camera != "corner":
        assert np.mean(np.abs(before - view.picture()).max(axis=2) > 20) > 0.05
    view.click("corner")
    view.tab.wait_for_timeout(500)


@pytest.mark.parametrize("mode", ["shadows", *list(LAYERS)[:-1]])
def test_each_mode_changes_the_picture_and_leaves_the_robot_in_it(
    view: Opened, mode: str
):
    """Half way, where all of them have something to show; at rest and in motion."""
    clock, on = view.page.clock, not LAYERS.get(mode, False)
    view.click("top" if mode == "planned posture" else "corner")
    clock.go(0.4 * clock.end)
    view.tab.wait_for_timeout(600)
    before = view.picture()
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
    view.until(
        lambda: np.sum(np.abs(before - view.picture()).max(axis=2) > 12) <= changed,
        "as it was",
    )


def test_the_robot_is_there_in_the_dark(browser: Any, whole: Path):
    with served(browser, whole, "/?darkMode") as view:
        view.until(lambda: view.orange() > ENOUGH, "the robot")
        assert np.median(view.picture()) < 60
        view.click("play")
        counts = [view.orange() for _ in range(4)]
        assert min(counts) > ENOUGH, counts


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


def test_the_report_is_handed_out(view: Opened):
    view.click("Report: plots, tables, criteria")
    link = view.tab.locator("a[download]").first
    link.wait_for(state="attached")
    assert link.get_attribute("download").endswith(".html")


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
        points = [
            tab.evaluate(ON_SCREEN, ["/edit/contact", 0.0, s, 0.0])
            for s in (0.15, 0.21)
        ]
        tab.mouse.move(*points[0])
        tab.wait_for_timeout(300)
        tab.mouse.down()
        tab.mouse.move(*points[1], steps=6)
        tab.wait_for_timeout(300)
        tab.mouse.up()
        tab.wait_for_selector("text=LHand on box, stance 1: moved by")
        view.until(lambda: gizmo.position[1] > start[1] + 0.02)
        place = np.array(gizmo.position)
        assert abs(place[0] - start[0]) < 1e-3  # along the arrow alone
        view.click("Re-plan")
        tab.wait_for_selector("text=Planned to the last stance: 1 changes")
        view.until(lambda: view.orange() > ENOUGH, "the robot of the new plan")
        view.click("Simulate")
        tab.wait_for_selector("text=Physics: failed")
        view.until(lambda: view.orange() > ENOUGH, "the robot of the new run")
        view.click("Save")
        tab.wait_for_selector("text=Saved as")
        assert all((run / n).read_bytes() == x for n, x in before.items())
        saved = clamber.load_plan(run / "edited")
        hand = next(c for c in saved.keyframes[1].stance if c.surface == "LHand")
        np.testing.assert_allclose(hand.position[:2], place[:2], atol=0.005)
        assert (run / "edited" / "verdict.json").is_file()
        view.click("Undo all")
        tab.get_by_text("use LHand").first.click()
        tab.wait_for_selector("text=without LHand")
        view.click("Re-plan")
        tab.wait_for_selector("text=No plan to the last stance")


def test_a_recording_is_shown_in_the_dark(browser: Any):
    with served(browser, "climb", "/?darkMode") as view:
        clock = view.page.clock
        view.until(lambda: view.blue() > 500, "the person")
        assert np.median(view.picture()) < 60  # it is dark
        view.click("contact >")
        view.until(lambda: clock.t == clock.events[1])
        view.click("play")
        view.until(lambda: clock.t > clock.events[1] + 0.3)
        assert view.blue() > 500


def test_a_phone_shows_the_robot(browser: Any, whole: Path):
    size = {"width": 390, "height": 780}
    with served(browser, whole) as view:
        view.tab.set_viewport_size(size)
        view.tab.wait_for_timeout(1500)
        wide = view.tab.evaluate("document.documentElement.scrollWidth")
        assert wide <= size["width"]
