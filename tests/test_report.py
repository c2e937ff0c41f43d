"""The report: what is packed is what was run, what is broken is named, and a browser
without a network shows all of it."""

from __future__ import annotations

import base64
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from clamber import cli
from clamber.errors import InputError
from clamber.execution.events import Lost, Stopped
from clamber.execution.simulation import STRIDE, Rollout
from clamber.model.kinematics import Kinematics
from clamber.model.world import PHYSICS_STEP
from clamber.planning.records import Fallback, Plan
from clamber.run import folder as run_files
from clamber.show import report
from clamber.step.robust import robust_margin

NASTY = "</script><script>document.title='taken'</script><img src=x onerror=alert(1)>"


@pytest.fixture(scope="module")
def planned(plan: Plan, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("planned")
    run_files.save_plan(plan, folder)
    return folder


@pytest.fixture
def run(whole: Path, tmp_path: Path) -> Path:
    """A copy to break."""
    return Path(shutil.copytree(whole, tmp_path / "run"))


def record_of(page: str) -> dict[str, Any]:
    found = re.search(r'id="data">(.*?)</script>', page, re.S)
    assert found
    return json.loads(found[1])


def unpacked(x: dict[str, Any]) -> np.ndarray:
    whole = np.frombuffer(base64.b64decode(x["data"]), dtype="<i2")
    values = whole.reshape(-1, x["columns"]).astype(float) * x["scale"]
    values[whole.reshape(values.shape) == -32768] = np.nan
    return values


def series(record: dict[str, Any], name: str) -> np.ndarray:
    return unpacked(record["motion"]["arrays"][name])


def times(record: dict[str, Any]) -> np.ndarray:
    return np.frombuffer(base64.b64decode(record["motion"]["times"]), dtype="<f4")


# What is packed.


def test_packed_numbers_are_off_by_half_a_step_at_most(rng: np.random.Generator):
    x = rng.normal(size=(50, 4, 2)) * 300
    x[3, 1, 0], x[4, 0, 1] = np.nan, -np.inf
    back = unpacked(report.packed(x)).reshape(x.shape)
    known = np.isfinite(x)
    assert np.array_equal(np.isnan(back), ~known)
    step = np.abs(x[known]).max() / 32767
    assert np.abs(back - x)[known].max() <= 0.5001 * step
    assert np.isnan(unpacked(report.packed(np.full((3, 1), np.nan)))).all()
    assert not unpacked(report.packed(np.zeros((3, 2)))).any()


def test_poses_are_those_of_the_recorded_states(whole: Path, rollout: Rollout):
    record = report.run_record(whole)
    motion, t = record["motion"], times(record)
    poses = series(record, "poses").reshape(len(t), -1, 7)
    bodies = [m["body"] for m in motion["meshes"]]
    kin = Kinematics(rollout.world)
    for k in (0, len(t) // 2, len(t) - 1):
        row = int(np.argmin(np.abs(rollout.time - t[k])))
        kin.update(rollout.qpos[row])
        place = poses[k, :, :3] * motion["reach"]
        np.testing.assert_allclose(place, kin.data.xpos[bodies], atol=1e-4)
        np.testing.assert_allclose(poses[k, :, 3:], kin.data.xquat[bodies], atol=1e-4)
    assert t[-1] == pytest.approx(rollout.time[-1], abs=1e-4)


def test_the_ghost_is_the_reference_and_the_error_is_between_them(
    whole: Path, plan: Plan, rollout: Rollout
):
    record = report.run_record(whole)
    t, error = times(record), series(record, "error")
    reference = plan.trajectory
    assert reference is not None
    for k in (0, len(t) // 3, len(t) - 1):
        row = int(np.argmin(np.abs(rollout.time - t[k])))
        q_ref = reference.q[min(row * rollout.stride, len(reference.q) - 1)]
        off = np.abs(rollout.qpos[row] - q_ref)[plan.world.qadr]
        base = np.linalg.norm(rollout.qpos[row, :3] - q_ref[:3])
        wanted = [off.max(), np.sqrt((off**2).mean()), base]
        np.testing.assert_allclose(error[k], wanted, atol=1e-5)
    assert not np.allclose(series(record, "ghost"), series(record, "poses"))


def test_forces_and_torques_keep_their_units(whole: Path, rollout: Rollout):
    record = report.run_record(whole)
    effort = series(record, "effort")
    world = rollout.world
    order = [world.model.actuator(n).id for n in world.joints]
    share = np.abs(rollout.actuator_force[:, order] / world.tau_max).max(axis=0)
    np.testing.assert_allclose(np.abs(effort).max(axis=0), share, atol=1e-4)
    force = series(record, "force").reshape(len(effort), -1, 3)
    assert force[-1].sum(axis=0)[2] == pytest.approx(
        record["motion"]["weight"], rel=0.02
    )
    assert series(record, "size").max() == pytest.approx(
        np.linalg.norm(rollout.contact_force, axis=2).max(), rel=1e-4
    )


def test_the_last_stability_is_that_of_the_last_keyframe(whole: Path, plan: Plan):
    record = report.run_record(whole)
    assert series(record, "margin")[-1, 0] == pytest.approx(
        plan.keyframes[-1].com_margin, abs=0.015
    )
    j = record["motion"]["surfaces"].index("LHand")
    planned = np.flatnonzero(series(record, "planned")[:, j] > 0)
    assert np.isfinite(series(record, "ratio")[planned, j]).all()
    lifted = series(record, "points")[:, 3 * j + 2]
    assert lifted[-1] == pytest.approx(0.25, abs=0.01)


# The file.


def test_a_report_is_one_small_file_that_fetches_nothing(whole: Path):
    done = report.write_report(whole)
    assert done.file == whole / "report.html"
    assert done.missing == ()
    text = done.file.read_text()
    assert len(text) < 3_000_000
    urls = set(re.findall(r"https?://[^\"' ]*", text))
    assert urls == {"http://www.w3.org/2000/svg"}  # the name of a format
    assert "$" not in re.sub(r"<script>.*?</script>", "", text, flags=re.S)
    again = report.write_report(whole, out=whole / "again.html")
    assert again.file.read_bytes() == done.file.read_bytes()


def test_nothing_in_the_record_can_end_its_element():
    text = report.embedded({"a": NASTY, "b": [float("nan"), 1.5], NASTY: "\u2028&"})
    assert not set("<>&") & set(text)
    assert json.loads(text) == {"a": NASTY, "b": [None, 1.5], NASTY: "\u2028&"}
    page = report.page([{"title": NASTY, "missing": []}])
    assert page.count("<script") == 2
    assert page.count("</script>") == 2


def test_two_runs_lie_side_by_side(whole: Path, planned: Path, tmp_path: Path):
    done = report.write_report(whole, compare=planned, out=tmp_path / "both.html")
    a, b = record_of(done.file.read_text())["runs"]
    assert a["reached"] is False  # the hand alone is on the box
    assert b["reached"] is None
    assert "title" in a
    assert done.missing == ("no rollout.npz: the plan has not been run in physics",)


def test_a_plan_alone_is_animated_without_forces(planned: Path):
    record = report.run_record(planned)
    arrays = record["motion"]["arrays"]
    assert arrays["force"] is None
    assert arrays["ghost"] is None
    assert record["motion"]["loads"] is None
    assert np.isfinite(series(record, "margin")).all()
    assert record["criteria"] is None
    assert [k["move"] for k in record["keyframes"]][1] == "air -> LHand on box"


def test_a_plan_that_got_no_trajectory_shows_its_keyframes(plan: Plan, tmp_path: Path):
    run_files.save_plan(replace(plan, trajectory=None, complete=False), tmp_path)
    record = report.run_record(tmp_path)
    assert record["motion"]["stills"]
    assert times(record).tolist() == [0.0, 1.0]
    assert [k["time"] for k in record["keyframes"]] == [0.0, 1.0]


def test_a_plan_with_other_contacts_says_so(plan: Plan, tmp_path: Path):
    run_files.save_plan(
        replace(plan, fallback=Fallback(reason="hands instead of elbows")), tmp_path
    )
    assert report.run_record(tmp_path)["instead"] == "hands instead of elbows"
    run_files.save_plan(plan, tmp_path)
    assert report.run_record(tmp_path)["instead"] == ""


def test_the_table_of_stances_has_the_figures_of_the_plan(whole: Path, plan: Plan):
    rows = report.run_record(whole)["keyframes"]
    for row, key, held in zip(rows, plan.keyframes, plan.equilibria, strict=True):
        assert row["com_margin"] == pytest.approx(key.com_margin)
        robust = robust_margin(Kinematics(plan.world), key.q, key.stance)
        assert row["robust_margin"] == pytest.approx(robust)
        assert row["margin"] == pytest.approx(held.margin)
        total = np.sum([c["force"] for c in row["contacts"]], axis=0)
        np.testing.assert_allclose(total, [0, 0, plan.world.mass * 9.81], atol=0.5)
        for c, state in zip(row["contacts"], key.contacts, strict=True):
            assert c["surface"] == state.contact.surface
            assert c["projected_distance"] == pytest.approx(state.projected_distance)


def test_a_fall_and_a_stop_and_what_was_felt_are_told(
    plan: Plan, rollout: Rollout, tmp_path: Path
):
    events = (Lost(time=0.5, surface="LHand"), Stopped(time=0.5, why="nothing to hold"))
    run_files.save_plan(plan, tmp_path)
    fallen = replace(rollout, fell=True, events=events)
    run_files.save_rollout(plan, fallen, tmp_path)
    record = report.run_record(tmp_path)
    assert record["fell"]
    assert record["stopped"] == "nothing to hold"
    assert [e["text"] for e in record["events"]] == [str(e) for e in events]
    assert record["motion"]["felt"] == [0.5, 0.5]
    assert [m for m in record["missing"] if m.startswith("verdict.json")]


# Broken folders.


ALL = {"criteria", "keyframes", "motion"}
KEPT = {
    "plan.json": {"criteria"},
    "planned.xml": {"criteria", "keyframes"},
    "planned.npz": ALL,
    "scene.xml": ALL,
    "trajectory.npz": ALL,
    "rollout.npz": ALL,
    "execution.json": ALL,
    "verdict.json": {"keyframes", "motion"},
    "timings.json": ALL,
}
BROKEN = [
    *((name, "cut") for name in KEPT),
    *((name, "gone") for name in ("plan.json", "planned.xml", "rollout.npz")),
    *((name, "foreign") for name in ("plan.json", "planned.npz", "rollout.npz")),
]


@pytest.mark.parametrize(("name", "how"), BROKEN)
def test_what_is_broken_is_named_and_the_rest_is_shown(run: Path, name: str, how: str):
    file = run / name
    if how == "gone":
        file.unlink()
    elif how == "cut":
        file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    elif name.endswith(".npz"):
        np.savez(file, time=np.zeros(3), qpos=np.zeros((3, 4)))
    else:
        file.write_text('{"hello": "world"}')
    record = report.run_record(run)
    named = f"no {name}" if (name, how) == ("rollout.npz", "gone") else name
    said = [m for m in record["missing"] if m.startswith(named)]
    assert said, record["missing"]
    if how != "foreign":
        assert all("writes it" in m for m in said if name != "timings.json"), said
    assert all("\n" not in m for m in record["missing"])
    shown = {k for k in ("criteria", "keyframes", "motion") if record[k]}
    assert shown == KEPT[name]
    assert len(report.page([record])) > 10_000


def test_another_robots_rollout_is_not_mistaken_for_this_ones(run: Path):
    arrays = dict(np.load(run / "rollout.npz"))
    arrays["qpos"] = arrays["qpos"][:, :-3]
    np.savez(run / "rollout.npz", **arrays)
    record = report.run_record(run)
    assert record["missing"][0].startswith("rollout.npz: qpos is")
    assert record["motion"]["loads"] is None


@pytest.mark.parametrize(
    ("name", "before", "after"),
    [
        ("plan.json", '"com_margin": ', '"com_margin": "x", "was": '),
        ("plan.json", '"friction": 0.8', '"friction": "0.8"'),
        ("verdict.json", '"limit": 1.0', '"limit": "1.0"'),
        ("execution.json", '"fell": false', '"fell": []'),
    ],
)
def test_a_field_that_does_not_fit_is_named(
    run: Path, name: str, before: str, after: str
):
    text = (run / name).read_text()
    assert before in text
    (run / name).write_text(text.replace(before, after, 1))
    missing = report.run_record(run)["missing"]
    field = before.split('"')[1]
    assert [m for m in missing if m.startswith(f"{name}: ") and field in m]


def test_a_picture_that_is_none_is_left_out(run: Path):
    picture = run / "demonstration.png"
    Image.new("RGB", (8, 8)).save(picture)
    assert report.run_record(run)["picture"].startswith("data:image/png;base64,")
    picture.write_bytes(b"<svg onload='alert(1)'>")
    record = report.run_record(run)
    assert record["picture"] is None
    assert record["missing"] == ["demonstration.png: expected a whole PNG picture"]


@pytest.mark.parametrize("content", [None, "{", '{"version": 2}'])
def test_a_folder_with_nothing_in_it_is_one_sentence(
    content: str | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    if content is not None:
        (tmp_path / "plan.json").write_text(content)
    assert cli.main(["report", str(tmp_path)]) == 2
    err = capsys.readouterr().err
    assert "expected a run folder with a whole plan.json or verdict.json" in err
    assert "Traceback" not in err
    with pytest.raises(InputError, match="expected a run folder"):
        report.write_report(tmp_path / "nowhere")


def test_the_command_names_the_file_and_on_stderr_what_is_missing(
    run: Path, capsys: pytest.CaptureFixture[str]
):
    (run / "trajectory.npz").unlink()
    out = run / "page.html"
    assert cli.main(["report", str(run), "--out", str(out), "--json"]) == 0
    said = capsys.readouterr()
    result = json.loads(said.out)
    assert result["file"] == str(out)
    assert [m for m in result["missing"] if m.startswith("trajectory.npz")]
    assert "clamber: trajectory.npz" in said.err
    nowhere = str(run / "no" / "page.html")
    assert cli.main(["report", str(run), "--out", nowhere, "--quiet"]) == 2
    assert "--out is" in capsys.readouterr().err


def test_a_report_says_how_far_it_is(whole: Path, planned: Path, tmp_path: Path):
    told: list[float] = []
    report.write_report(
        whole,
        compare=planned,
        out=tmp_path / "both.html",
        progress=lambda stage, share, note: told.append(share),
    )
    assert told == sorted(told)
    assert told[0] == 0.0
    assert max(np.diff([*told, 1.0])) < 0.35


# In a browser.


def opened(browser: Any, file: Path, **options: Any) -> tuple[Any, list[str]]:
    """The page, without a network, and a list to which its complaints are added."""
    context = browser.new_context(
        viewport={"width": 900, "height": 700}, offline=True, **options
    )
    page, complaints = context.new_page(), []
    page.on("console", lambda m: complaints.append(f"{m.type}: {m.text}"))
    page.on("pageerror", lambda e: complaints.append(str(e)))
    page.on(
        "request",
        lambda r: r.url.startswith(("file:", "data:")) or complaints.append(r.url),
    )
    page.goto(file.as_uri())
    settled(page)
    settled(page)
    return page, complaints


def until(page: Any, condition: str) -> None:
    """Wait for an expression; the page's policy forbids that Playwright does."""
    for _ in range(1800):  # a busy machine is waited for
        if page.evaluate(condition):
            return
        page.wait_for_timeout(50)
    pytest.fail(f"never: {condition}")


def settled(page: Any) -> None:
    """Two frames later."""
    page.evaluate(
        "() => new Promise((r) => requestAnimationFrame("
        "() => requestAnimationFrame(r)))"
    )


def read_through(page: Any) -> None:
    """Scroll to the end, and back."""
    for y in range(0, page.evaluate("document.documentElement.scrollHeight"), 500):
        page.evaluate(f"window.scrollTo(0, {y})")
        settled(page)
    page.evaluate("window.scrollTo(0, 0)")


def drawn(page: Any, which: int = 0) -> str:
    """The pixels of an animation, as a data URL."""
    settled(page)
    return page.evaluate(f"SCENES[{which}].canvas.toDataURL()")


@pytest.fixture(scope="module")
def page(browser: Any, whole: Path) -> tuple[Any, list[str]]:
    done = report.write_report(whole, out=whole / "browser.html")
    return opened(browser, done.file)


def test_the_animation_plays_and_scrubs(page: tuple[Any, list[str]]):
    p, complaints = page
    before = drawn(p)
    p.click("#play")
    until(p, "state.t > 0.2")
    p.click("#play")
    t = p.evaluate("state.t")
    settled(p)
    assert p.evaluate("state.t") == t  # it has stopped
    assert drawn(p) != before
    p.evaluate("go(0)")
    assert drawn(p) == before
    p.fill("input[type=range]", "1")
    assert p.evaluate("state.t") == 1
    assert p.inner_text("#clock").startswith("1.00 /")
    assert p.evaluate("[-0.0002, -0.2].map(x => fixed(x, 1))") == ["0.0", "-0.2"]
    assert complaints == []


def test_the_picture_is_turned_zoomed_and_reset(page: tuple[Any, list[str]]):
    p, _ = page
    p.evaluate("window.scrollTo(0, 0)")
    before = drawn(p)
    p.mouse.move(400, 300)
    p.mouse.down()
    p.mouse.move(480, 320)
    p.mouse.up()
    turned = drawn(p)
    assert turned != before
    distance = p.evaluate("state.camera.distance")
    p.mouse.wheel(0, -300)
    assert drawn(p) != turned
    assert p.evaluate("state.camera.distance") < distance
    p.dblclick("canvas.view")
    assert drawn(p) == before
    p.click("text=top")
    assert drawn(p) != before
    p.click("text=corner")
    assert drawn(p) == before


def test_the_planned_posture_is_shown_on_request(page: tuple[Any, list[str]]):
    p, _ = page
    p.evaluate("go(END / 2)")
    before = drawn(p)
    p.check("#ghost")
    assert drawn(p) != before
    p.uncheck("#ghost")
    assert drawn(p) == before


def test_a_click_on_a_stance_jumps_there(page: tuple[Any, list[str]], plan: Plan):
    p, _ = page
    assert plan.trajectory is not None
    p.evaluate("go(0)")
    p.click("tr[data-stance='1']")
    # To the nearest recorded state.
    assert p.evaluate("state.t") == pytest.approx(
        plan.trajectory.keyframes[1], abs=0.5 * STRIDE * PHYSICS_STEP + 1e-9
    )
    p.click("figure.tile >> nth=0")
    assert p.evaluate("state.t") == 0
    p.click("#next")
    assert p.evaluate("EVENTS.includes(state.t)")
    p.click("#previous")
    assert p.evaluate("state.t") == 0


def test_the_cursors_of_the_plots_follow_the_time(page: tuple[Any, list[str]]):
    p, _ = page
    read_through(p)
    until(p, "document.querySelectorAll('.plot').length === 8")
    p.evaluate("go(END / 4)")
    left = p.eval_on_selector_all(".cursor", "all => all.map((c) => c.style.left)")
    assert len(left) == 9  # the timeline and eight plots
    assert {round(float(x.rstrip("%"))) for x in left} == {25}
    chart = p.locator(".plot .chart").first
    middle = chart.bounding_box()["width"] / 2
    chart.click(position={"x": middle, "y": 60})
    assert p.evaluate("state.t / END") == pytest.approx(0.5, abs=0.01)


LONG = 40  # times as long as the run of one hand


@pytest.fixture(scope="module")
def long_run(whole: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of that run, over and over."""
    record = report.run_record(whole)
    motion, keys = record["motion"], record["keyframes"]
    t = times(record)
    every = float(t[-1] + t[1] - t[0])

    def over(data: str, kind: str, step: float = 0.0) -> str:
        x = np.frombuffer(base64.b64decode(data), kind)
        again = np.concatenate([x + x.dtype.type(k * step) for k in range(LONG)])
        return base64.b64encode(again.tobytes()).decode()

    motion["times"] = over(motion["times"], "<f4", every)
    for x in motion["arrays"].values():
        if x is not None:
            x["data"] = over(x["data"], "<i2")
    record["keyframes"] = [
        k | {"time": k["time"] + n * every} for n in range(LONG) for k in keys
    ]
    record["events"] = [{"time": 0.1 * k, "text": f"event {k}"} for k in range(100)]
    file = tmp_path_factory.mktemp("long") / "report.html"
    file.write_text(report.page([record]))
    return file


COUNTED = """() => ({
  nodes: document.querySelectorAll("*").length,
  stills: document.querySelectorAll("canvas[data-drawn]").length,
  plots: document.querySelectorAll(".plot").length })"""
MOST_POINTS = """() => Math.max(...[...document.querySelectorAll("path")].map(
  p => (p.getAttribute("d").match(/[ML]/g) || []).length))"""


def test_a_long_run_opens_with_what_is_on_the_screen_alone(
    browser: Any, long_run: Path
):
    """Its stills and plots are made when they are seen; a plot has a column a pixel."""
    p, complaints = opened(browser, long_run)
    assert p.evaluate("MOTIONS[0].times.length") > 2000
    counted = p.evaluate(COUNTED)
    assert counted["stills"] < 12
    assert counted["plots"] < 8
    assert counted["nodes"] < 2000
    read_through(p)
    until(p, "document.querySelectorAll('.plot').length === 8")
    until(p, "document.querySelectorAll('canvas[data-drawn]').length === 12")
    assert 500 < p.evaluate(MOST_POINTS) <= 1010
    assert complaints == []


def test_a_long_list_is_turned_page_by_page(browser: Any, long_run: Path):
    p, complaints = opened(browser, long_run)
    sheet, stances, events = p.locator(".pager").all()
    assert sheet.inner_text().split()[1:5] == ["0", "to", "11", "of"]
    assert sheet.locator("button").first.is_disabled()
    sheet.locator("button").last.click()
    first = p.locator(".tile b").first
    assert first.inner_text().startswith("12 ")
    first.scroll_into_view_if_needed()
    until(p, "document.querySelector('.tile canvas').dataset.drawn === ''")
    for _ in range(3):  # to the last of 80, by 20; the page moves as it is filled
        stances.locator("button").last.dispatch_event("click")
    assert stances.locator("button").last.is_disabled()
    assert p.locator(f"tr[data-stance='{2 * LONG - 1}']").count() == 1
    assert p.locator(".events tbody tr").count() == 40
    events.locator("button").last.dispatch_event("click")
    assert p.locator(".events tbody td").nth(1).inner_text() == "event 40"
    assert complaints == []


def test_it_prints(page: tuple[Any, list[str]]):
    p, complaints = page
    pdf = p.pdf(format="A4")
    assert pdf.startswith(b"%PDF")
    assert len(pdf) > 50_000
    assert complaints == []


def test_a_run_that_ended_at_once_opens(
    browser: Any, plan: Plan, rollout: Rollout, tmp_path: Path
):
    run_files.save_plan(plan, tmp_path)
    arrays = ("time", "qpos", "qvel", "actuator_force", "contact_force", "unintended")
    first = {name: getattr(rollout, name)[:1] for name in arrays}
    run_files.save_rollout(plan, replace(rollout, **first, fell=True), tmp_path)
    p, complaints = opened(browser, report.write_report(tmp_path).file)
    assert "The robot fell" in p.inner_text("header")
    assert complaints == []


def test_names_are_text_and_no_script(browser: Any, run: Path):
    content = json.loads((run / "plan.json").read_text())
    content["robot"]["name"] = NASTY
    content["versions"] = {NASTY: NASTY}
    (run / "plan.json").write_text(json.dumps(content))
    execution = json.loads((run / "execution.json").read_text())
    execution["events"] = [{"time": 0.5, "text": NASTY}]
    (run / "execution.json").write_text(json.dumps(execution))
    p, complaints = opened(browser, report.write_report(run).file)
    assert NASTY in p.title()
    assert p.inner_text("h1").startswith(NASTY)
    assert p.locator("img, body script").count() == 2  # the data and our own
    assert complaints == []


def test_the_policy_runs_no_script_but_ours(browser: Any, whole: Path, tmp_path: Path):
    text = report.page([report.run_record(whole)])
    file = tmp_path / "page.html"
    file.write_text(
        text.replace("</body>", "<script>document.title = 'taken'</script></body>")
    )
    p, complaints = opened(browser, file)
    assert p.title() != "taken"
    assert any("Content Security Policy" in c for c in complaints)


def test_two_runs_play_together(browser: Any, whole: Path, planned: Path):
    done = report.write_report(whole, compare=planned, out=whole / "two.html")
    p, complaints = opened(browser, done.file, color_scheme="dark")
    before = drawn(p, 0), drawn(p, 1)
    p.evaluate("go(END / 2)")
    assert drawn(p, 0) != before[0]
    assert drawn(p, 1) != before[1]
    assert complaints == []


def test_a_phone_sees_all_of_it_without_scrolling_sideways(browser: Any, whole: Path):
    done = report.write_report(whole, out=whole / "phone.html")
    p, complaints = opened(browser, done.file, has_touch=True, is_mobile=True)
    p.set_viewport_size({"width": 390, "height": 844})
    settled(p)
    assert p.evaluate("document.documentElement.scrollWidth") <= 390
    p.tap("#next")
    assert p.evaluate("state.t") > 0
    assert complaints == []


@pytest.mark.parametrize("lost", ["plan.json", "planned.xml"])
def test_a_broken_run_opens_and_says_what_is_missing(
    browser: Any, run: Path, lost: str
):
    (run / lost).unlink()
    p, complaints = opened(browser, report.write_report(run).file)
    assert lost in p.inner_text(".missing >> nth=0")
    assert "Nothing to animate" in p.inner_text("main")
    assert "did not fall" in p.inner_text("main")
    assert complaints == []
