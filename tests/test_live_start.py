"""The page on which a climb begins, in a real browser."""

from __future__ import annotations

import shutil
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import clamber
from clamber.model.scene import NEAR_FACE
from clamber.planning.records import Plan
from clamber.show import start
from clamber.study.climb import Climb, ClimbResult, run_climb
from support.view import ON_SCREEN, Opened, orange_in, served

pytest.importorskip("viser")
BROWSER_FLAGS: list[str] = []
READY = 'text="Climb"'
ENOUGH = 300  # pixels of the robot
BOX = "boxes: [{name: step, size: [0.6, 0.8, 0.2], position: [0.6, 0.0]}]\n"
# Files as a mouse brings them.
DROP = """([label, name, text]) => {
  const zone = [...document.querySelectorAll("div[ondrop]")]
    .find(x => x.textContent.includes(label));
  const dataTransfer = new DataTransfer();
  dataTransfer.items.add(new File([text], name));
  zone.dispatchEvent(new DragEvent("drop", {dataTransfer, bubbles: true})) }"""


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of one's own, in which runs are made."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def told(view: Opened, text: str) -> None:
    view.tab.get_by_text(text).first.wait_for(state="attached")


def test_what_is_chosen_is_climbed_and_the_run_opens(
    browser: Any, whole: Path, here: Path, monkeypatch: pytest.MonkeyPatch
):
    """The work is `run_climb`'s; here it is told of, and finds a run that is made."""
    asked: list[Climb] = []

    def climbed(climb: Climb, *, folder: Path, progress: Any) -> ClimbResult:
        asked.append(climb)
        progress("plan", 0.4, "LHand on box")
        seen.wait(60.0)
        shutil.copytree(whole, folder, dirs_exist_ok=True)
        return ClimbResult(reached=False, why="fell")

    seen = threading.Event()
    monkeypatch.setattr(start, "run_climb", climbed)
    with served(browser, ready=READY) as view:
        view.until(lambda: view.orange() > ENOUGH, "the robot that is chosen")
        assert (
            view.tab.get_by_text("climb (synthetic)")
            .or_(view.tab.locator("input[value='climb (synthetic)']"))
            .count()
        )
        view.click("Climb")
        told(view, "plan: LHand on box")
        bar = view.tab.get_by_role("progressbar")
        view.until(lambda: float(bar.get_attribute("aria-valuenow")) > 0, "the bar")
        seen.set()
        view.tab.wait_for_selector('text="speed"')
        assert asked == [Climb(robot="coman", height=0.275)]
        told(view, "failed")  # the verdict of the run
        told(view, "Failed: fell.")
        told(view, "clamber climb --robot coman --height 0.275")
        view.until(lambda: view.orange() > ENOUGH, "the robot of the run")
        assert (here / "runs" / "climb" / "plan.json").is_file()
        view.click("New climb")
        view.tab.wait_for_selector(READY)
        view.until(lambda: view.orange() > ENOUGH, "the robot, once more")


def test_the_box_is_set_by_sliders_and_by_its_gizmo(
    browser: Any, here: Path, monkeypatch: pytest.MonkeyPatch
):
    asked: list[tuple[Climb, Any]] = []

    def climbed(climb: Climb, *, folder: Path, progress: Any) -> ClimbResult:
        asked.append((climb, yaml.safe_load((folder / "box.yaml").read_text())))
        return ClimbResult(reached=False, why="nothing was done")

    monkeypatch.setattr(start, "run_climb", climbed)
    with served(browser, ready=READY) as view:
        view.until(lambda: view.orange() > ENOUGH)
        view.tab.wait_for_timeout(1000)
        gizmo: Any = view.page.server.scene.get_handle_by_name("/start/gizmo")
        assert gizmo.position[0] == pytest.approx(NEAR_FACE)
        before = view.picture()
        points = [
            view.tab.evaluate(ON_SCREEN, ["/start/gizmo", 0.0, 0.0, s])
            for s in (0.17, 0.23)
        ]
        view.tab.mouse.move(*points[0])
        view.tab.wait_for_timeout(300)
        view.tab.mouse.down()
        view.tab.mouse.move(*points[1], steps=6)
        view.tab.wait_for_timeout(300)
        view.tab.mouse.up()
        view.until(lambda: gizmo.position[2] > 0.29, "a higher box")
        view.until(
            lambda: np.mean(np.abs(before - view.picture()).max(axis=2) > 20) > 0.005
        )
        distance = view.row(r"distance \[m\]")
        box = view.tab.locator("input[type=text], input[inputmode]").last
        box.fill("0.3")
        box.press("Enter")
        assert distance is not None
        view.until(lambda: abs(gizmo.position[0] - 0.3) < 1e-6, "a box farther away")
        view.click("Climb")
        view.until(lambda: asked)
        climb, written = asked[0]
        assert climb.height is None
        (step,) = written["boxes"]
        assert step["position"] == [pytest.approx(0.8), 0.0]
        assert step["size"][2] == pytest.approx(gizmo.position[2], abs=0.003)


def test_files_are_dropped_and_what_cannot_be_used_is_said(browser: Any, here: Path):
    with served(browser, ready=READY) as view:
        view.until(lambda: view.orange() > ENOUGH)
        before = view.picture()
        view.tab.evaluate(DROP, ["scene", "step.yaml", BOX])
        view.until(lambda: view.tab.locator("input[value='step.yaml']").count())
        view.until(
            lambda: np.mean(np.abs(before - view.picture()).max(axis=2) > 20) > 0.05,
            "the scene that was dropped",
        )
        assert np.sum(orange_in(view.picture())) > ENOUGH
        assert [p.name for p in here.glob("runs/uploads/*/*")] == ["step.yaml"]
        view.tab.evaluate(DROP, ["recording", "take.csv", "nothing of use\n"])
        told(view, "line 1: expected Motive's CSV")
        view.tab.evaluate(DROP, ["robot", "mine.yaml", "name: mine\n"])
        told(view, "model: expected a value: it is missing")
        assert view.tab.locator("input[value='coman']").count()
        view.tab.evaluate(DROP, ["scene", "other.yaml", BOX.replace("0.6", "-1")])
        told(view, "boxes.0.size.0 is -1; expected a positive length")
        assert view.tab.locator("input[value='step.yaml']").count()


# The work.


@pytest.mark.slow
def test_a_climb_saves_what_it_made_and_is_the_one_without_a_folder(
    tmp_path: Path, demo_plan: Plan
):
    stages: list[str] = []
    climb = Climb(height=0.275, robot="coman")
    result = run_climb(
        climb, folder=tmp_path, progress=lambda stage, *_: stages.append(stage)
    )
    assert result.reached
    assert result == run_climb(climb)
    assert list(dict.fromkeys(stages))[:2] == ["detect", "plan"]
    assert "simulate" in stages
    again = clamber.load_plan(tmp_path)
    np.testing.assert_array_equal(again.keyframes[-1].q, demo_plan.keyframes[-1].q)
    assert (tmp_path / "verdict.json").is_file()


def test_a_climb_that_is_not_planned_is_a_result_and_leaves_its_plan(tmp_path: Path):
    result = run_climb(Climb(height=3.0), folder=tmp_path)
    assert not result.reached
    assert result.why.startswith("no plan")
