"""The view in a real browser: what is clicked, dragged and typed is what happens.

One server and one page for a run of two hands on a box; no other address answers.
"""

from __future__ import annotations

import contextlib
import io as streams
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageChops

import clamber
from clamber.contact.contact import ContactSequence, Stance
from clamber.model.kinematics import Kinematics
from clamber.planning.records import PlanOptions
from clamber.run import folder as io
from clamber.show.view import open_view
from clamber.show.view.shown import frame_at, show_run
from clamber.show.view.stage import LAYERS, RECORDING

pytest.importorskip("viser")
BROWSER_FLAGS: list[str] = []  # as Chromium draws by itself where there is no card
WIDTH, HEIGHT = 900, 620
# A node's matrix in the world of viser, of which z is up: three.js has y.
MATRIX = """name => { const all = window.__viserMutable.nodeRefFromName;
  const up = all[""].matrixWorld.clone().invert();
  return all[name] && up.multiply(all[name].matrixWorld).elements }"""
SEEN = """name => { let n = window.__viserMutable.nodeRefFromName[name];
  if (!n) return false;
  for (; n; n = n.parent) if (!n.visible) return false;
  return true }"""
# Where a point of a node is on the screen [px].
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
    run: Path

    def until(self, met: Callable[[], Any], told: object = "") -> None:
        for _ in range(800):
            if met():
                return
            self.tab.wait_for_timeout(50)
        pytest.fail(f"it never came: {told}")

    def switch(self, label: str, on: bool) -> None:
        """A checkbox, by its label."""
        row = self.tab.locator("label", has_text=re.compile(f"^{label}$")).first
        box = row.locator("xpath=../../..").locator("input")
        if box.is_checked() != on:
            box.click()

    def choose(self, label: str, option: str) -> None:
        row = self.tab.locator("label", has_text=label).first
        row.locator("xpath=../../..").locator("input").first.click()
        self.tab.get_by_role("option", name=option).click()

    def show(self, name: str) -> None:
        self.tab.get_by_role("tab", name=name).click()

    def node(self, name: str) -> str:
        """Of the stage that is shown at present."""
        names = self.tab.evaluate("Object.keys(window.__viserMutable.nodeRefFromName)")
        stages = [n.split("/")[1] for n in names if n.startswith("/run")]
        return f"/{max(stages, key=lambda s: int(s[3:]))}/{name}"

    def matrix(self, name: str) -> np.ndarray:
        return np.array(self.tab.evaluate(MATRIX, name)).reshape(4, 4).T

    def seen(self, name: str) -> bool:
        return self.tab.evaluate(SEEN, self.node(name))


def connected(browser: Any, page: Any, run: Path, **options: Any) -> Opened:
    options = {"viewport": {"width": WIDTH, "height": HEIGHT}, **options}
    tab, complaints = browser.new_context(**options).new_page(), []
    tab.set_default_timeout(40_000)
    tab.on("pageerror", lambda e: complaints.append(str(e)))
    tab.on(
        "console", lambda m: m.type == "error" and complaints.append(f"error: {m.text}")
    )

    def allow(route: Any) -> None:
        if route.request.url.startswith((page.url, "blob:", "data:")):
            route.continue_()
        else:
            complaints.append(route.request.url)
            route.abort()

    tab.route("**/*", allow)
    tab.goto(page.url)
    tab.wait_for_selector("text=go to", state="attached")
    tab.wait_for_function("window.clamberSoft !== undefined")
    return Opened(page=page, tab=tab, complaints=complaints, run=run)


@contextlib.contextmanager
def served(browser: Any, source: Any, **options: Any) -> Iterator[Opened]:
    page = open_view(source, port=18090)
    try:
        opened = connected(browser, page, Path(source), **options)
        yield opened
        assert opened.complaints == []
        opened.tab.context.close()
    finally:
        page.close()


@pytest.fixture(scope="module")
def two_hands(one_hand: ContactSequence, coman: Any) -> ContactSequence:
    """Standing, the left hand on the box, and then the right one."""
    left = one_hand.stances[1].contacts
    hand = left[-1]
    right = replace(
        hand, surface="RHand", position=hand.position * np.array([1.0, -1.0, 1.0])
    )
    return replace(
        one_hand,
        stances=(*one_hand.stances, Stance(contacts=(*left, right))),
        t=np.array([0.0, 1.0, 2.0, 3.0]),
    )


@pytest.fixture(scope="module")
def made(
    two_hands: ContactSequence, coman: Any, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    made = clamber.plan(
        two_hands, coman, two_hands.scene, options=PlanOptions(speed=1.0)
    )
    rollout = clamber.simulate(made, controller="pid")
    folder = tmp_path_factory.mktemp("made")
    io.save_plan(made, folder)
    io.save_rollout(made, rollout, folder)
    io.save_verdict(clamber.judge(made, rollout), folder)
    return folder


@pytest.fixture(scope="module")
def shared_page(browser: Any, made: Path) -> Iterator[Opened]:
    with served(browser, made) as opened:
        yield opened


@pytest.fixture
def view(shared_page: Opened) -> Opened:
    """At its beginning, standing still; what the last test clicked has arrived."""
    shared_page.tab.wait_for_timeout(300)
    with shared_page.page.clock.lock:
        shared_page.page.clock.playing = False
        shared_page.page.clock.go(0.0)
    return shared_page


def test_playing_moves_the_robot_as_physics_did(view: Opened):
    """Until the pause, on the screen too; each link is where the rollout has it."""
    clock, tab = view.page.clock, view.tab
    clock.go(0.3 * clock.end)
    tab.wait_for_timeout(600)
    scene = {"x": 0, "y": 0, "width": WIDTH - 400, "height": HEIGHT}
    before = tab.screenshot(clip=scene)
    began = clock.t
    tab.get_by_role("button", name="play", exact=True).click()
    view.until(lambda: clock.t > began + 0.8)
    tab.get_by_role("button", name="pause", exact=True).click()
    view.until(lambda: not clock.playing)
    tab.wait_for_timeout(600)
    pictures = [
        Image.open(streams.BytesIO(x)).convert("RGB")
        for x in (before, tab.screenshot(clip=scene))
    ]
    changed = np.asarray(ImageChops.difference(*pictures)).max(axis=2) > 30
    assert changed.mean() > 0.005
    plan, rollout = clamber.load_plan(view.run), clamber.load_rollout(view.run)
    shown = show_run(plan, rollout)
    frame = frame_at(shown, Kinematics(shown.world), clock.t)
    parents = {m.body: "" for m in shown.meshes}
    for m in shown.meshes:
        up = int(shown.world.model.body_parentid[m.body])
        while up and up not in parents:
            up = int(shown.world.model.body_parentid[up])
        if m.body:
            parents[m.body] = f"{parents[up] if up else view.node('robot')}/{m.body}"
    for m, pose in zip(shown.meshes, frame.poses, strict=True):
        if m.body:
            np.testing.assert_allclose(
                view.matrix(parents[m.body])[:3, 3], pose[:3], atol=1e-3
            )


def test_contacts_are_stepped_through_by_buttons_and_keys(view: Opened):
    clock, tab = view.page.clock, view.tab
    assert len(clock.events) > 3
    tab.get_by_role("button", name="contact >").click()
    view.until(lambda: clock.t == clock.events[1])
    tab.keyboard.press("PageDown")
    view.until(lambda: clock.t == clock.events[2])
    tab.keyboard.press("PageUp")
    view.until(lambda: clock.t == clock.events[1])
    tab.get_by_role("button", name="< contact").click()
    view.until(lambda: clock.t == 0.0)
    tab.locator("canvas").first.focus()
    tab.keyboard.press("Space")
    view.until(lambda: clock.playing)
    tab.keyboard.press("Space")
    view.until(lambda: not clock.playing)


def test_a_click_on_a_stance_goes_there_and_marks_it(view: Opened):
    view.show("Stances")
    reached = clamber.load_plan(view.run).trajectory
    assert reached is not None
    view.tab.click("tbody[data-stance='2']")
    clock = view.page.clock
    view.until(lambda: abs(clock.t - reached.keyframes[2]) < 0.01, "the time")
    colour = """i => getComputedStyle(document.querySelector(
      `tbody[data-stance='${i}']`)).backgroundColor"""
    view.until(
        lambda: (
            view.tab.evaluate(colour, 1) != view.tab.evaluate(colour, 2)
            and view.tab.evaluate(colour, 0) == view.tab.evaluate(colour, 1)
        )
    )


def test_a_click_in_a_plot_moves_time_and_all_cursors(view: Opened):
    view.show("Plots")
    plots = view.tab.locator(".plot")
    assert plots.count() == 4  # contacts, torques, balance, tracking
    box = plots.nth(1).bounding_box()
    plots.nth(1).click(position={"x": 0.75 * box["width"], "y": 10})
    clock = view.page.clock
    view.until(lambda: abs(clock.t / clock.end - 0.75) < 0.01)
    at = (
        "[...document.querySelectorAll('.plot')].map(p => parseFloat("
        "getComputedStyle(p, '::after').left) / p.getBoundingClientRect().width)"
    )
    view.until(lambda: np.allclose(view.tab.evaluate(at), 0.75, atol=0.02))
    plots.nth(2).scroll_into_view_if_needed()
    box = plots.nth(2).bounding_box()
    view.tab.mouse.move(box["x"] + 0.3 * box["width"], box["y"] + 40)
    view.tab.mouse.down()
    view.tab.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 40, steps=4)
    view.tab.mouse.up()
    view.until(lambda: abs(clock.t / clock.end - 0.5) < 0.01)


def test_each_layer_comes_and_goes(view: Opened):
    """In the middle of a move, where all of them have something to show."""
    reached = clamber.load_plan(view.run).trajectory
    assert reached is not None
    view.page.clock.go(float(reached.keyframes[1:3].mean()))
    view.show("Show")
    nodes = {
        "contacts": "contacts",
        "forces": "forces",
        "friction cones": "cones",
        "balance": "balance",
        "way of the limb": "way1",
        "planned posture": "ghost",
    }
    assert {*nodes, "see-through robot", RECORDING} == set(LAYERS)
    for label, name in nodes.items():
        for on in (not LAYERS[label], LAYERS[label]):
            view.switch(label, on)
            view.until(lambda name=name, on=on: view.seen(name) == on, (name, on))
    opacity = """name => { const out = [];
      window.__viserMutable.nodeRefFromName[name].traverse(
        n => n.material && out.push(n.material.opacity)); return out }"""
    for on in (True, False):
        view.switch("see-through robot", on)
        view.until(
            lambda on=on: (
                all(x < 1 for x in view.tab.evaluate(opacity, view.node("robot"))) == on
            )
        )


def test_what_moves_is_drawn_in_time_and_what_rests_finely(view: Opened):
    """A processor draws shadows, all faces and pixels of what is at rest alone."""
    shadows = """() => { let n = 0; window.__viserMutable.scene.traverse(
      x => n += x.isDirectionalLight && x.castShadow ? 1 : 0); return n }"""
    faces = """name => { let n = 0;
      window.__viserMutable.nodeRefFromName[name].traverse(
        x => n += x.isMesh ? x.geometry.index.count / 3 : 0); return n }"""
    pixels = """[...document.querySelectorAll('canvas')].find(
      c => c.dataset.engine).width"""
    robot = view.node("robot")
    clock, tab = view.page.clock, view.tab

    def drawn(finely: bool) -> bool:
        return (
            (tab.evaluate(shadows) > 0) == finely
            and (tab.evaluate(faces, robot) > 5000) == finely
            and (tab.evaluate(pixels) > 400) == finely
        )

    assert tab.evaluate("window.clamberSoft")
    assert tab.get_by_text("Software WebGL rendering detected").count() == 0
    view.until(lambda: drawn(True), "fine at rest")
    clock.toggle()
    view.until(lambda: drawn(False), "coarse while time plays")
    clock.toggle()
    view.until(lambda: drawn(True), "fine after the pause")
    clock.go(clock.t)  # no other time: nothing moves
    tab.wait_for_timeout(300)
    assert drawn(True)
    tab.mouse.move(150, 200)
    tab.mouse.down()
    tab.mouse.move(180, 210, steps=3)
    view.until(lambda: drawn(False), "coarse while the camera is turned")
    tab.mouse.move(150, 200, steps=3)
    tab.mouse.up()
    view.until(lambda: drawn(True), "fine after that")
    view.show("Show")
    view.switch("fine in motion", True)
    clock.go(0.2 * clock.end)
    tab.wait_for_timeout(300)
    assert drawn(True)
    view.switch("fine in motion", False)
    clock.go(0.0)
    view.until(lambda: drawn(False), "coarse in motion again")


def test_cameras_go_where_their_names_say(view: Opened):
    view.show("Show")
    client = next(iter(view.page.server.get_clients().values()))
    way = {"top": [0, 0, 1], "front": [1, 0, 0], "behind": [-1, 0, 0]}
    for name, direction in way.items():
        view.tab.get_by_role("button", name=name, exact=True).click()

        def there(direction: list[float] = direction) -> bool:
            off = np.asarray(client.camera.position) - client.camera.look_at
            return float(off @ direction) > 0.8 * float(np.linalg.norm(off))

        view.until(there)
    view.tab.get_by_role("button", name="corner", exact=True).click()


def test_it_is_light_and_dark_as_the_browser_is_and_as_it_is_told(view: Opened):
    scheme = "document.documentElement.dataset.mantineColorScheme"
    ink = "getComputedStyle(document.querySelector('.clamber b')).color"
    assert view.tab.evaluate(scheme) == "light"
    light = view.tab.evaluate(ink)
    view.switch("dark", True)
    view.until(lambda: view.tab.evaluate(scheme) == "dark")
    assert sum(_rgb(view.tab.evaluate(ink))) > 500 > sum(_rgb(light))
    view.switch("dark", False)
    view.until(lambda: view.tab.evaluate(scheme) == "light")


def test_a_contact_is_dragged_planned_simulated_and_saved(
    browser: Any, made: Path, tmp_path: Path
):
    """With the mouse, on the arrow of the gizmo; what is beside the folder stays."""
    run = Path(shutil.copytree(made, tmp_path / "run"))
    before = {p.name: p.read_bytes() for p in run.iterdir()}
    with served(browser, run) as view:
        tab, page = view.tab, view.page
        view.show("Edit")
        view.choose("move", "LHand on box, stance 1")
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
        tab.get_by_role("button", name="Re-plan").click()
        tab.wait_for_selector("text=Planned to the last stance: 2 moves")
        tab.get_by_role("button", name="Simulate").click()
        tab.wait_for_selector("text=Physics: it did not make it")
        view.show("Stances")  # two hands are not the whole robot on the box
        row = tab.locator("tr.bad", has_text="load on obstacles at the end")
        row.wait_for()
        assert 0.3 < float(row.locator("td").nth(1).inner_text()) < 0.7
        view.show("Edit")
        tab.get_by_role("button", name="Save", exact=True).click()
        tab.wait_for_selector("text=Saved as")
        assert set(tmp_path.iterdir()) == {run}
        after = {p.name for p in run.iterdir()}
        assert after - set(before) == {"edited"}
        assert all((run / n).read_bytes() == x for n, x in before.items())
        saved = clamber.load_plan(run / "edited")
        hand = next(c for c in saved.keyframes[1].stance if c.surface == "LHand")
        np.testing.assert_allclose(hand.position[:2], place[:2], atol=0.005)
        assert (run / "edited" / "rollout.npz").is_file()
        assert (run / "edited" / "verdict.json").is_file()


def test_a_surface_that_is_switched_off_is_planned_without(view: Opened):
    """The other hand alone; without both there is no plan; undoing brings all back."""
    tab = view.tab
    view.show("Edit")
    view.switch("use RHand", False)
    tab.wait_for_selector("text=without RHand")
    tab.get_by_role("button", name="Re-plan").click()
    tab.wait_for_selector("text=Planned to the last stance: 1 moves")
    view.show("Stances")
    tab.wait_for_selector("text=planned, not run in physics")
    assert tab.locator("tbody[data-stance]").count() == 2
    view.show("Edit")
    view.switch("use LHand", False)
    tab.get_by_role("button", name="Re-plan").click()
    tab.wait_for_selector("text=No plan to the last stance")
    tab.get_by_role("button", name="Undo all").click()
    view.show("Stances")
    tab.wait_for_selector("tbody[data-stance='2']")
    tab.wait_for_selector("text=did not make it")
    assert [p.name for p in view.run.iterdir() if p.is_dir()] == []


def test_a_phone_shows_the_robot_over_its_panel(browser: Any, shared_page: Opened):
    size = {"width": 390, "height": 780}
    opened = connected(
        browser, shared_page.page, shared_page.run, viewport=size, has_touch=True
    )
    tab = opened.tab
    tab.wait_for_timeout(1500)
    assert tab.evaluate("document.documentElement.scrollWidth") <= 390
    name = opened.node("robot")
    x, y = tab.evaluate(ON_SCREEN, [name, 0.0, 0.0, 0.4])
    assert 0 < x < 390
    top = tab.evaluate(
        "[...document.querySelectorAll('.clamber')].map("
        "e => e.getBoundingClientRect().top).filter(t => t > 0)[0]"
    )
    assert 0 < y < top
    assert opened.complaints == []
    tab.context.close()


def test_a_recording_is_shown_in_the_dark(browser: Any):
    with served(browser, "climb", color_scheme="dark") as opened:
        tab, page = opened.tab, opened.page
        tab.wait_for_selector("[data-mantine-color-scheme=dark]", state="attached")
        tab.click("tbody[data-stance='3']")
        start = clamber.detect_contacts(clamber.load_demo("climb")).t[3]
        opened.until(lambda: abs(page.clock.t - start) < 0.01)
        tab.get_by_role("button", name="play", exact=True).click()
        opened.until(lambda: page.clock.t > start + 0.2)


def _rgb(text: str) -> list[float]:
    return [float(x) for x in text[text.index("(") + 1 : -1].split(",")[:3]]
