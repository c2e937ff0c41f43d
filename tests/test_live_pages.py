"""The live view in a real browser: pages of their own, edited, sized, side by side.

What looks at one page is in `test_live_browser`: a tab that stays open draws on, beside
whatever is tested meanwhile.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import clamber
from clamber.show.live import open_view
from support.view import ENOUGH, ON_SCREEN, client_of, orange_in, served

pytest.importorskip("viser")
BROWSER_FLAGS: list[str] = []  # as Chromium draws by itself where there is no card
HEIGHT = re.escape("height [m]")


@pytest.fixture(scope="module")
def whole_page(whole: Path) -> Iterator[Any]:
    """A page of that run, for tabs that only look at it."""
    page = open_view(whole, port=18090)
    yield page
    page.close()


SIZES = {
    "desktop": ({"width": 1280, "height": 800}, {"x": 0, "y": 0, "width": 900}),
    "small": ({"width": 760, "height": 480}, {"x": 0, "y": 0, "width": 390}),
    "phone": ({"width": 390, "height": 780}, {"x": 0, "y": 0, "width": 390}),
}


@pytest.mark.parametrize("theme", ["light", "dark"])
@pytest.mark.parametrize("name", SIZES)
def test_the_robot_is_there_in_every_size_and_theme(
    browser: Any, whole_page: Any, name: str, theme: str
):
    """All of it, above the sheet of a phone; at rest and in motion."""
    size, clip = SIZES[name]
    height = 310 if name == "phone" else size["height"]
    query = "/?darkMode" if theme == "dark" else ""
    whole_page.clock.go(0.0)
    with served(browser, page=whole_page, query=query, size=size) as view:
        clip = {**clip, "height": height}

        def whole_robot() -> bool:  # neither its feet nor its sides are cut off
            seen = orange_in(view.picture(clip))
            edges = seen[-2:].any() or seen[:, [0, 1, -2, -1]].any()
            return np.sum(seen) > ENOUGH and not edges

        view.until(whole_robot, "all of the robot")
        assert (np.median(view.picture(clip)) < 60) == (theme == "dark")
        view.page.clock.toggle()
        counts = [int(np.sum(orange_in(view.picture(clip)))) for _ in range(3)]
        assert min(counts) > ENOUGH, counts
        wide = view.tab.evaluate("document.documentElement.scrollWidth")
        assert wide <= size["width"]


def test_a_closed_tab_says_nothing_on_the_terminal(
    browser: Any, whole_page: Any, capfd: pytest.CaptureFixture[str]
):
    with served(browser, page=whole_page) as view:
        view.until(lambda: view.orange() > ENOUGH)
        for _ in range(2):
            tab = view.tab.context.new_page()
            tab.goto(view.page.url)
            tab.wait_for_selector('text="speed"')
            view.page.clock.go(0.0, playing=True)
            tab.close()
        view.tab.wait_for_timeout(500)
    assert capfd.readouterr() == ("", "")


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
    """Seen from the front there is a gap between two, and none in one."""
    gaps = []
    for sources in ((whole,), (whole, off_plan)):
        with served(browser, *sources) as view:
            view.until(lambda view=view: view.orange() > ENOUGH)
            view.tab.locator("canvas").first.focus()
            view.tab.keyboard.press("3")
            view.tab.wait_for_timeout(1000)
            columns = np.flatnonzero(orange_in(view.picture()).any(axis=0))
            gaps.append(np.diff(columns).max() / np.ptp(columns))
            for folder in sources[1:]:
                assert str(folder) in view.tab.inner_text("body")
    assert gaps[0] < 0.35 < gaps[1], gaps


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
        view.choose("move", "the box box")
        view.until(
            lambda: np.any(pink_or_blue(view.picture())), "the box that is moved"
        )
        view.row(HEIGHT).fill("0.3")
        view.row(HEIGHT).press("Enter")
        tab.wait_for_selector("text=box: 0.300 m high, moved by 0 mm")
        view.choose("move", "LHand on box, stance 1")
        view.choose("onto", "ground")
        tab.wait_for_selector("text=onto ground")
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
