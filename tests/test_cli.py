"""The command line as a person meets it: help, results, tables, mistakes."""

from __future__ import annotations

import contextlib
import fcntl
import functools
import json
import os
import pty
import re
import struct
import subprocess
import sys
import termios
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args, get_type_hints

import numpy as np
import pytest

import clamber
from clamber import cli
from clamber.cli import flags, output, tools
from clamber.cli.output import closing
from clamber.execution.verdict import Figure, judge
from clamber.planning.records import Fallback
from conftest import ROOT
from support.files import write_take

COLUMNS = 80
CLAMBER = (sys.executable, "-m", "clamber")
SCENE = "boxes:\n- {name: table, size: [0.95, 0.6, 0.275], position: [0.705, 0.0]}\n"
NAMES = (
    *("climb", "contacts", "plan", "replan", "traverse", "simulate", "learn"),
    *("render", "report", "view", "export", "scene", "robot", "sweep"),
)
# What is quick of the commands that print a result; the others end with the table of
# simulate, or draw.
COMMANDS = {
    "contacts": "contacts climb --out {out}",
    "plan": "plan run/sequence.json --height 0.25 --speed max --out {out}",
    "replan": "replan run --from 1 --search.tries 0 --out {out}",
    "simulate": "simulate run --controller pid",
    "report": "report run --out {out}.html",
    "export": "export run --to npz --out {out}.npz",
    "scene": "scene scene.yaml",
    "robot": "robot check coman29",
}

Capture = pytest.CaptureFixture[str]
Patch = pytest.MonkeyPatch


@pytest.fixture(scope="module")
def folder(one_hand_plan, one_hand_rollout, tmp_path_factory) -> Path:
    """A run folder `run` of the shortest motion, a scene, and all that can be wrong."""
    folder = tmp_path_factory.mktemp("cli")
    run = folder / "run"
    clamber.new_run_folder(run, "run")
    clamber.save_sequence(one_hand_plan.sequence, run / "sequence.json")
    clamber.save_plan(one_hand_plan, run)
    clamber.save_rollout(one_hand_plan, one_hand_rollout, run)
    clamber.save_verdict(judge(one_hand_plan, one_hand_rollout), run)
    box = "boxes:\n- {name: t, size: [1, 1, 0.3], position: [%s, 0]%s}\n"
    for name, text in {
        "scene.yaml": SCENE,
        "spec.yaml": "grid: {disturb.seed: [0, 1]}\nbase: {height: 9.0}\n",
        "word.txt": "hello",
        "tab.yaml": "boxes:\n\t- a\n",
        "field.yaml": box % (0.73, ", colour: red"),
        "inside.yaml": box % (0.3, ""),
        "typo.yaml": "grid: {disturb.fricton: [1, 2]}\n",
        "unit.yaml": "file: a.npy\nrate: 120\nunit: ell\nnames: [LHand, RHand]\n",
        "cut/plan.json": (run / "plan.json").read_text()[:500],
        "half/plan.json": (run / "plan.json").read_text(),
        "half/planned.xml": (run / "planned.xml").read_text(),
        "empty/.keep": "",
    }.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text)
    return folder


@pytest.fixture
def here(folder: Path, monkeypatch: Patch) -> Path:
    monkeypatch.chdir(folder)
    return folder


def plain(text: str) -> list[str]:
    """Its lines, without bold and colours."""
    return re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", text).splitlines()


def words_of(name: str, folder: Path) -> list[str]:
    return COMMANDS[name].format(out=f"{name}{len(list(folder.iterdir()))}").split()


def record_of(args: Sequence[str], capsys: Capture) -> dict[str, Any]:
    cli.main([*args, "--json"])
    return json.loads(capsys.readouterr().out)


# Help, version, codes.


def test_help_names_every_command_without_loading_the_planner():
    code = "import sys; from clamber.cli import main\nmain(['--help'])\n"
    code += "print('LOADED', *sys.modules)"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    text, loaded = out.stdout.split("LOADED")
    heavy = {"mujoco", "numpy", "scipy", "clamber.planning.planner"}
    assert not heavy & set(loaded.split())
    assert all(name in text for name in NAMES)


@pytest.mark.whole
def test_every_command_explains_itself_and_has_json_and_quiet(capsys: Capture):
    for name in NAMES:
        assert cli.main([name, "--help"]) == 0
        text = capsys.readouterr().out
        assert f"clamber {name}" in text
        assert "--json" in text
        assert "--quiet" in text
        assert "None" not in text
        assert not re.search(r"default: *(False|unset)?\)", text)


def test_version_is_that_of_the_package(capsys: Capture):
    for args in (["--version"], ["climb", "--version"]):
        assert cli.main(args) == 0
        assert capsys.readouterr().out == f"clamber {clamber.__version__}\n"


@pytest.mark.whole
def test_the_process_ends_with_the_exit_code_and_a_reader_may_leave():
    out = subprocess.run([*CLAMBER, "scene", "no.yaml"], capture_output=True, text=True)
    assert out.returncode == output.BAD_INPUT
    assert out.stderr.startswith("clamber: no.yaml")
    line = f"set -o pipefail; {sys.executable} -m clamber --help | true"
    done = subprocess.run(["bash", "-c", line], capture_output=True, text=True)
    assert done.stderr == ""
    assert done.returncode in (0, output.READER_GONE)


def test_the_exit_codes_are_those_that_are_documented():
    text = (ROOT / "docs" / "terminal.md").read_text()
    table = re.findall(r"^\| (\d+) \|", text, re.M)
    codes = (output.REACHED, output.MISSED, output.BAD_INPUT, output.INTERRUPTED)
    assert [int(x) for x in table] == [*codes, output.READER_GONE]


def test_an_interrupt_is_one_sentence_and_exit_130(
    here: Path, monkeypatch: Patch, capsys: Capture
):
    def interrupt(self: object) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(tools.SceneCommand, "run", interrupt)
    assert cli.main(["scene", "scene.yaml"]) == output.INTERRUPTED
    assert capsys.readouterr().err.count("\n") == 1


def test_the_flags_of_planning_are_fields_of_its_options():
    from clamber.planning.records import Method, PlanOptions

    given = flags.PlanningFlags()
    assert repr(given.options()) == repr(PlanOptions())
    assert given.bound() == clamber.Budget()
    shown = get_type_hints(flags.PlanningFlags)["method"]
    assert get_args(shown) == get_args(Method)


# Results.


@pytest.mark.parametrize("name", COMMANDS)
def test_results_fit_into_80_columns_and_json_is_one_object(
    name: str, here: Path, monkeypatch: Patch, capsys: Capture
):
    monkeypatch.setenv("COLUMNS", str(COLUMNS))
    with monkeypatch.context() as seen:
        seen.setattr(sys.stdout, "isatty", lambda: True)
        code = cli.main(words_of(name, here))
    assert code in (output.REACHED, output.MISSED)
    lines = plain(capsys.readouterr().out)
    assert lines
    assert max(map(len, lines)) <= COLUMNS
    cut = [line for line in lines if "\N{HORIZONTAL ELLIPSIS}" in line]
    assert not cut, "a cell that is cut off says nothing"
    record = record_of(words_of(name, here), capsys)
    assert isinstance(record, dict)
    assert record


def test_quiet_says_nothing_and_flags_may_stand_before_the_command(
    here: Path, capsys: Capture
):
    assert cli.main(["--quiet", "contacts", "climb", "--out", "hushed"]) == 0
    assert capsys.readouterr() == ("", "")
    assert (here / "hushed" / "sequence.json").exists()
    assert cli.main(["--json", "scene", "scene.yaml"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert [s["name"] for s in record["supports"]] == ["ground", "table"]
    assert record["supports"][1]["centre"] == [0.705, 0.0, 0.275]


def test_a_real_terminal_gets_whole_lines(here: Path):
    """In a terminal of 80 columns, results alone."""
    pid, screen = pty.fork()
    if pid == 0:
        os.environ.pop("COLUMNS", None)
        os.environ["TERM"] = "xterm"
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # progress, which is not looked at
        os.execv(CLAMBER[0], [*CLAMBER, "contacts", "climb", "--out", "seen"])
    fcntl.ioctl(screen, termios.TIOCSWINSZ, struct.pack("HHHH", 24, COLUMNS, 0, 0))
    seen = b""
    with contextlib.suppress(OSError):  # the other end is closed
        while part := os.read(screen, 65536):
            seen += part
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
    lines = plain(seen.decode().replace("\r\n", "\n"))
    assert lines[0].split() == "stance region from [s] to [s] contacts".split()
    assert lines[2].rstrip().endswith("LHand on table, LFoot RFoot on ground")
    assert lines[-1].rstrip() == "the sequence is in seen"
    assert max(map(len, lines)) <= COLUMNS


def test_the_last_line_is_wrapped_for_a_person_and_whole_for_a_file(
    monkeypatch: Patch, capsys: Capture
):
    words = "word " * 40
    output.Output().show({}, note=words)
    assert capsys.readouterr().out.splitlines() == [words]
    monkeypatch.setenv("COLUMNS", str(COLUMNS))
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    output.Output().show({}, note=words)
    lines = plain(capsys.readouterr().out)
    assert len(lines) == 3
    assert max(map(len, lines)) <= COLUMNS


def test_the_clock_adds_up_what_was_tried_again(monkeypatch: Patch):
    now = iter([0.0, 1.0, 3.0, 6.0, 10.0])
    monkeypatch.setattr(time, "perf_counter", lambda: next(now))
    seen = []
    clock = output.Clock()
    report = clock.watching(lambda *step: seen.append(step))
    for step in (("a", 0.0), ("b", 0.5), ("a", 0.0), ("b", 0.5)):
        report("plan", step[1], step[0])
    report("simulate", 0.0, "")
    assert len(seen) == 5
    assert clock.stages() == {"plan": 10.0}
    assert (clock.of("a"), clock.of("b"), clock.of("c")) == (4.0, 6.0, None)


def test_contacts_says_by_how_much_the_floor_was_off(tmp_path: Path, capsys: Capture):
    demo = clamber.load_demo("climb")
    lifted = replace(demo, position=demo.position + np.array([0.0, 0.0, 0.035]))
    write_take(lifted, tmp_path / "take.c3d")
    out = ["--out", str(tmp_path / "out")]
    words = ["contacts", str(tmp_path / "take.c3d"), "--fit-floor", *out]
    notes = record_of(words, capsys)["notes"]
    assert any(n.startswith("fitted: ground +35 mm (foot at rest") for n in notes)


def test_a_plan_and_its_run_leave_the_files_of_the_format(
    here: Path, one_hand_plan, capsys: Capture
):
    """One hand on a box that is no goal yet: planned and held, but not on top."""
    words = ["plan", "run/sequence.json", "--height", "0.25", "--out", "made"]
    record = record_of(words, capsys)
    assert record["complete"] is True
    moves = [k["move"] for k in record["keyframes"]]
    assert moves == ["start", "air -> LHand on box"]
    assert record["keyframes"][1]["seconds"] > 0
    record = record_of(["simulate", "made", "--controller", "pid"], capsys)
    assert record["reached"] is False
    assert [k["move"] for k in record["keyframes"]] == moves, "loaded equals made"
    assert 0.0 < record["criteria"][Figure.LOAD_ON_OBSTACLES]["value"] < 0.5
    assert record["criteria"][Figure.LOAD_ON_PLAN]["ok"] is True
    wanted = {"sequence.json", "plan.json", "trajectory.npz", "scene.xml"}
    wanted |= {"timings.json", "rollout.npz", "verdict.json"}
    assert wanted <= {p.name for p in (here / "made").iterdir()}
    seconds = json.loads((here / "made" / "timings.json").read_text())["seconds"]
    assert sum(seconds.values()) > seconds["simulate"] > 0
    cli.main(["simulate", "made", "--controller", "pid"])
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith("failed: ")
    assert last.endswith("`clamber report made` shows how far it came")


@pytest.fixture
def quick_climb(one_hand_plan, one_hand_rollout, monkeypatch: Patch) -> SimpleNamespace:
    """A climb whose stages answer at once, and what was asked of them, in order."""
    said = SimpleNamespace(calls=[], plan=one_hand_plan, drawing={}, no_opengl=False)
    said.verdict = judge(one_hand_plan, one_hand_rollout)

    def note(name: str, answer: Callable[..., Any]) -> None:
        def stage(*args: Any, **options: Any) -> Any:
            said.calls.append(name)
            return answer(*args, **options)

        monkeypatch.setitem(vars(clamber), name, stage)

    def draw(*args: Any, **options: Any) -> list[Path]:
        said.drawing = options
        if said.no_opengl:
            raise clamber.ClamberError("no OpenGL")
        return [args[0] / "climb.png"]

    for name in ("save_sequence", "save_plan", "save_rollout", "save_verdict"):
        note(name, getattr(clamber, name))
    note("plan", lambda *_, **__: said.plan)
    note("simulate", lambda *_, **__: one_hand_rollout)
    note("judge", lambda *_: said.verdict)
    note("render_run", draw)
    return said


def test_a_climb_saves_each_result_before_the_next_stage_begins(
    quick_climb: SimpleNamespace, tmp_path: Path, capsys: Capture
):
    words = ["climb", "--height", "0.25", "--video"]
    cli.main([*words, "--out", str(tmp_path / "a")])
    out, err = capsys.readouterr()
    saved = ["save_sequence", "plan", "save_plan", "simulate", "save_rollout", "judge"]
    assert quick_climb.calls == [*saved, "save_verdict", "render_run"]
    assert "with_video" not in quick_climb.drawing  # all of it
    look = f"{tmp_path / 'a' / 'climb.png'} shows it; `clamber report {tmp_path / 'a'}`"
    assert err.splitlines()[-1].startswith(look)
    row = next(r for r in out.splitlines() if r.startswith("air -> LHand on box"))
    key = quick_climb.plan.keyframes[-1]
    for value in (
        key.iterations,
        f"{key.cost_after:.3f}",
        f"{1e3 * key.com_margin:.0f}",
    ):
        assert str(value) in row
    quick_climb.no_opengl = True  # a climb without pictures is a climb
    code = cli.main([*words, "--out", str(tmp_path / "b")])
    assert code == output.MISSED  # one hand is not on top
    assert capsys.readouterr().err.count("clamber: no OpenGL") == 1
    for part in ("a", "b"):
        assert (tmp_path / part / "timings.json").is_file()


def test_a_climb_draws_what_it_is_asked_to_and_says_how_to_draw_the_rest(
    quick_climb: SimpleNamespace, tmp_path: Path, capsys: Capture
):
    quick_climb.verdict = replace(quick_climb.verdict, reached=True)
    for name, words in (("a", []), ("b", ["--video"])):
        quick_climb.calls.clear()
        folder = tmp_path / name
        assert cli.main(["climb", *words, "--out", str(folder)]) == output.REACHED
        assert ("render_run" in quick_climb.calls) == bool(words)
        said = capsys.readouterr().out
        assert (f"`clamber render {folder}` draws it" in said) != bool(words)
        assert (folder / "timings.json").is_file()


def test_the_seconds_of_a_search_are_those_of_all_of_it(
    quick_climb: SimpleNamespace, tmp_path: Path, monkeypatch: Patch
):
    seconds = {"search": 100.0, "trajectory": 1.0}

    def plan(*_: object, progress: Callable[..., None], **__: object) -> clamber.Plan:
        progress("plan", 0.5, "as demonstrated")
        progress("search", 0.5, "the last part of it")
        progress("trajectory", 1.0, "")
        return replace(quick_climb.plan, timings=seconds)

    monkeypatch.setitem(vars(clamber), "plan", plan)
    cli.main(["climb", "--height", "0.25", "--out", str(tmp_path / "a")])
    written = json.loads((tmp_path / "a" / "timings.json").read_text())["seconds"]
    assert {k: written[k] for k in seconds} == seconds
    assert "plan" not in written


def test_a_plan_without_any_step_is_not_simulated(
    quick_climb: SimpleNamespace, tmp_path: Path, capsys: Capture
):
    quick_climb.plan = replace(quick_climb.plan, trajectory=None, complete=False)
    assert cli.main(["climb", "--height", "0.25", "--out", str(tmp_path / "a")]) == 1
    assert "simulate" not in quick_climb.calls
    assert "no plan: " in capsys.readouterr().out.splitlines()[-1]


# Mistakes: what is said of them, and what to do instead.

MISTAKES = {
    "": ("Expected one of {climb, contacts", "clamber --help"),
    "nonsense": ("'nonsense'", "climb, contacts, plan"),
    "clmb": ("'clmb'", "did you mean climb?"),
    "plan": ("SEQUENCE", "clamber plan --help"),
    "climb --hieght 0.3": ("--hieght", "--height METRES"),
    "climb --height abc": ("--height", "a number, got 'abc'"),
    "climb --budget soon": ("--budget", "a number, got 'soon'"),
    "climb --budget -1": ("--budget is -1.0", "expected 0 or more"),
    "sweep spec.yaml --workers 1.5": ("--workers", "a whole number, got '1.5'"),
    "climb --robot tals": ("--robot is 'tals'", "did you mean talos?"),
    "climb --speed fast": ("--speed", "'fast'"),
    "climb --method luck": ("'luck'", "gradient"),
    "climb --controller magic": ("'magic'", "'mixed'"),
    "export run": ("--to", "csv"),
    "export run --to xml": ("'xml'", "'mcap'"),
    "robot frob coman": ("'frob'", "'check'"),
    "view nothing": ("'nothing'", "a file that ends in"),
    "climb --height -1": ("--height is -1.0", "expected a positive length"),
    "climb --height nan": ("--height is nan", "expected a finite number"),
    "climb --height 9": ("9.00 m away", "within 1.15 m of the start"),
    "climb --scene a.yaml --height 1": ("--height, --scene", "give one of them alone"),
    "climb --robot nobody": ("--robot is 'nobody'", "a robot.yaml, or one of coman"),
    "climb --robot word.txt": ("'word.txt'", "a robot.yaml beside the model"),
    "climb --demo nobody": ("'nobody'", "['climb', 'crossing']"),
    "climb --demo no.c3d": ("no.c3d: expected a readable file", "check the path"),
    "climb --demo word.txt": ("word.txt", "expected a recording: .c3d"),
    "climb --demo unit.yaml": ("unit", "'ell'"),
    "climb --scene no.yaml": ("no.yaml: expected a readable file", "check the path"),
    "climb --scene tab.yaml": ("tab.yaml: expected YAML", "line 2"),
    "climb --scene field.yaml": ("boxes.0.colour", "correct its name, or leave it out"),
    "climb --scene inside.yaml": ("start is", "move the one or the other"),
    "climb --speed 0": ("--speed is 0.0", "expected a joint speed of at least"),
    "climb --disturb.friction 7": ("--disturb.friction is 7.0", "from 0.01 to 1"),
    "climb --search.tries -1": ("--search.tries is -1", "expected 0 or more"),
    "climb --out word.txt/x": ("--out is 'word.txt/x'", "a folder that can be written"),
    "contacts no.bvh": ("no.bvh: expected a readable file", "check the path"),
    "plan no.json": ("no.json: expected a readable file", "check the path"),
    "plan empty": ("empty/sequence.json", "`clamber contacts` writes it"),
    "plan word.txt": ("word.txt: expected whole JSON", "check the path"),
    "replan empty --from 3": ("empty/plan.json", "`clamber plan` writes it"),
    "replan run --from 99": ("--from is", "expected a time of the rollout, 0 to"),
    "simulate nowhere": ("nowhere: expected a run folder", "`clamber climb`"),
    "simulate cut": ("cut/plan.json: expected whole JSON", "`clamber plan`"),
    "traverse no.json --scene scene.yaml": ("no.json", "check the path"),
    "traverse empty/policy.json --scene scene.yaml": ("policy.json", "`clamber learn`"),
    "learn": ("no demonstration", "name at least one, such as crossing"),
    "learn climb": ("no repeated cycle", "a demonstration in which a cycle"),
    "learn crossing --out policy.txt": ("--out is 'policy.txt'", "ends in .json"),
    "render nowhere": ("nowhere: expected a run folder", "`clamber plan` makes one"),
    "render empty": ("empty/plan.json", "`clamber plan` writes it"),
    "render half --video": ("half/planned.npz", "`clamber plan` writes it"),
    "render run --frame 999": ("--frame is 999.0", "expected a time from 0 to"),
    "render run --frame 1 --sheet": ("--sheet, --frame", "give one of them alone"),
    "render run --transparent": ("--transparent", "give --frame too, or leave it out"),
    "render run --camera top": ("--camera", "give --video, --sheet or --frame too"),
    "render run --frame 1 --size big": ("--size is 'big'", "such as 1080p or 1280x720"),
    "render run --frame 1 --size 641x480": ("--size", "even numbers"),
    "render run --sheet --out x.jpg": ("x.jpg", "ends in .png"),
    "report nowhere": ("nowhere: expected a run folder", "`clamber climb`"),
    "report empty": ("a whole plan.json or verdict.json", "`clamber climb`"),
    "export run --to csv --rate 7": ("--rate is 7", "a divisor of 1000 Hz, as 50"),
    "export run --to csv --layout mjlab": ("--layout is", "it goes with --to npz"),
    "export half --to csv": ("half/planned.npz", "`clamber plan` writes it"),
    "scene word.txt": ("word.txt is 'str'", "expected a mapping of fields"),
    "robot check nobody": ("'nobody'", "a robot.yaml, or one of coman, coman29"),
    "robot init no.urdf": ("no.urdf: expected a readable file", "check the path"),
    "sweep no.yaml": ("no.yaml: expected a readable file", "check the path"),
    "sweep typo.yaml": ("not disturb.fricton", "there are demo, robot, height"),
    "sweep spec.yaml --workers 0": ("--workers is 0", "expected 1 or more"),
    "sweep spec.yaml --workers 1 --scheduler a:1": ("--workers", "one of them alone"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_names_what_is_wrong_and_what_to_do_instead(
    mistake: str, here: Path, capsys: Capture
):
    words = mistake.split()
    assert cli.main([*words, "--quiet"] if words else []) == output.BAD_INPUT
    out, err = capsys.readouterr()
    assert out == ""
    assert "Traceback" not in err
    if err.startswith("clamber: "):
        assert err.count("\n") == 1
    else:  # the parser of the flags has drawn a box
        err = " ".join(err.replace("│", " ").split())
    for said in MISTAKES[mistake]:
        assert said in err
    assert not (here / "x.jpg").exists()


def test_a_box_out_of_reach_is_named_with_its_file(here: Path, capsys: Capture):
    far = here / "far.yaml"
    far.write_text(SCENE.replace("[0.705, 0.0]", "[5.0, 0.0]"))
    words = ["plan", "run/sequence.json", "--quiet", "--out", "far"]
    assert cli.main([*words, "--scene", "far.yaml"]) == output.BAD_INPUT
    err = capsys.readouterr().err
    assert err.startswith("clamber: far.yaml: boxes.table is '4.5")
    assert "the robot's reach" in err


def test_a_robot_without_the_surface_it_names_is_one_sentence(
    tmp_path: Path, capsys: Capture
):
    from clamber.model.robot import ROBOTS

    for p in (ROBOTS / "coman").iterdir():
        (tmp_path / p.name).write_bytes(p.read_bytes())
    path = tmp_path / "robot.yaml"
    path.write_text(path.read_text().replace("[LHand, LElbow]", "[LHand, LTip]"))
    assert cli.main(["climb", "--robot", str(path), "--quiet"]) == output.BAD_INPUT
    err = capsys.readouterr().err
    for word in (str(path), "limbs.left_arm.surfaces", "LTip", "geoms of coman.xml"):
        assert word in err
    assert err.count("\n") == 1


# Pictures.


def test_render_passes_on_what_is_asked(here: Path, monkeypatch: Patch):
    asked: list[tuple] = []

    def note(home: str, name: str) -> None:
        def draw(*args: object, **options: object) -> Path:
            asked.append((name, args, options))
            return Path("there.png")

        monkeypatch.setattr(f"clamber.show.{home}.{name}", draw)

    note("pictures", "render_frame")
    note("pictures", "keyframe_sheet")
    note("film", "video")
    frame = ["--frame", "9.5", "--transparent", "--camera", "top", "--size", "720p"]
    assert cli.main(["render", "run", *frame, "--quiet"]) == 0
    wanted = {"out": None, "transparent": True, "camera": "top", "size": (1280, 720)}
    assert asked.pop() == ("render_frame", (Path("run"), 9.5), wanted)
    assert cli.main(["render", "run", "--sheet", "--size", "300x200", "--quiet"]) == 0
    name, args, options = asked.pop()
    assert (name, args[1]) == ("keyframe_sheet", Path("run/keyframes.png"))
    assert (options["camera"], options["tile"]) == ("corner", (300, 200))
    assert cli.main(["render", "run", "--video", "--out", "a.webp", "--quiet"]) == 0
    name, args, options = asked.pop()
    assert (name, args[2]) == ("video", Path("run"))
    assert (options["out"], options["size"]) == (Path("a.webp"), None)


# Learning.


@pytest.fixture(scope="module")
def learned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a policy, and the sequence that it was learned from."""
    folder = tmp_path_factory.mktemp("learn")
    sequence = clamber.detect_contacts(clamber.load_demo("crossing"))
    clamber.save_sequence(sequence, folder / "sequence.json")
    out = str(folder / "policy.json")
    assert cli.main(["learn", str(folder), "--out", out, "--quiet"]) == 0
    return folder


@pytest.mark.whole
def test_learn_writes_a_policy_that_is_read_again_and_two_pictures(learned: Path):
    policy = clamber.load_policy(learned / "policy.json")
    assert [o.name for o in policy.options] == "ac1 ac2 ac3 ac2 ac1 ac4".split()
    for name in ("policy.png", "policy-pelvis.png"):
        content = (learned / name).read_bytes()
        assert content.startswith(b"\x89PNG")
        assert len(content) < 1_000_000
    assert not [p for p in learned.iterdir() if p.name.startswith(".")]


@pytest.mark.whole
def test_learning_again_shows_the_options_and_writes_the_same_bytes(
    learned: Path, capsys: Capture
):
    words = ["learn", str(learned), "--out", str(learned / "again.json")]
    record = record_of(words, capsys)
    assert [o["region"] for o in record["options"]] == "M M O M M goal".split()
    assert record["options"][2]["surfaces"] == ["LElbow", "RElbow", "LKnee", "RKnee"]
    assert record["near_edge"]["samples"] > 10
    assert len(record["over_top"]["sigma"]) == 3
    for a, b in (("policy.json", "again.json"), ("policy.png", "again.png")):
        assert (learned / a).read_bytes() == (learned / b).read_bytes()
    assert cli.main(words) == 0
    out = capsys.readouterr().out
    for said in ("LElbow, RElbow, LKnee, RKnee", "near edge", "over top"):
        assert said in out


def test_a_folder_of_that_name_does_not_hide_a_built_in_demonstration(
    tmp_path: Path, monkeypatch: Patch, capsys: Capture
):
    monkeypatch.chdir(tmp_path)
    Path("climb").mkdir()  # which shows no cycle to learn from
    assert cli.main(["learn", "climb"]) == 2
    assert "sequence.json" not in capsys.readouterr().err


# Sweeps.


@pytest.fixture
def quick_sweep(tmp_path: Path, monkeypatch: Patch) -> list[str]:
    """The words of a sweep whose jobs are quick."""
    import sweep_jobs
    from clamber.study import sweep

    quick = functools.partial(sweep.run_sweep, job=sweep_jobs.breaks_at_friction)
    monkeypatch.setattr(sweep, "run_sweep", quick)
    monkeypatch.chdir(tmp_path)
    Path("friction.yaml").write_text(
        "base: {height: 0.275}\n"
        "search: {factor: disturb.friction, from: 1.0, to: 0.05, runs: 24}\n"
    )
    return ["sweep", "friction.yaml", "--workers", "1"]


@pytest.mark.pool
def test_a_sweep_ends_with_a_table_of_where_each_controller_breaks(
    quick_sweep: list[str], capsys: Capture
):
    assert cli.main(quick_sweep) == 0
    out, err = capsys.readouterr()
    assert "half at" in out
    assert "48 rows, 48 of them new; the files are in runs/friction" in out
    assert " of 48: " in err
    assert err.endswith("100 % done\n")
    names = {f.name for f in Path("runs/friction").iterdir()}
    wanted = {"spec.yaml", "runs.csv", "timings.json", "success.png"}
    assert {*wanted, "summary.csv", "curve.csv"} <= names
    record = record_of(quick_sweep, capsys)
    assert (record["rows"], record["new"]) == (48, 0)
    pid, mixed = record["summary"]
    assert pid["half"] == pytest.approx(0.4, abs=0.05)
    assert mixed["half"] == pytest.approx(0.3, abs=0.05)
    sessions = json.loads(Path("runs/friction/timings.json").read_text())["sessions"]
    assert [s["runs"] for s in sessions] == [48]


def test_a_sweep_that_is_interrupted_says_how_to_go_on(
    quick_sweep: list[str], monkeypatch: Patch, capsys: Capture
):
    from clamber.study import sweep

    def interrupt(*args: object, **more: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(sweep, "run_sweep", interrupt)
    assert cli.main([*quick_sweep, "--out", "out"]) == output.INTERRUPTED
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith("clamber: interrupted; the finished rows are in ")


def test_a_sweep_with_a_robot_that_is_not_there_runs_nothing(
    tmp_path: Path, capsys: Capture
):
    spec = tmp_path / "spec.yaml"
    spec.write_text("base: {robot: nobody}\ngrid: {height: [0.2, 0.3]}\n")
    out = tmp_path / "out"
    assert cli.main(["sweep", str(spec), "--out", str(out)]) == output.BAD_INPUT
    assert "nobody" in capsys.readouterr().err
    assert not out.exists()


def test_a_success_that_is_not_as_demonstrated_ends_with_the_success(one_hand_plan):
    fallback = Fallback(
        reason="no stable plan as demonstrated (LHand -> air: too far)",
        source="alternatives",
        surfaces=("LElbow",),
    )
    made = replace(one_hand_plan, fallback=fallback, complete=True)
    said = closing("success: it is there", Path("runs/x"), True, made).splitlines()
    assert said[0].startswith("note: no stable plan as demonstrated (LHand")
    assert said[0].endswith("instead, of the alternatives: LElbow")
    assert said[1:] == ["success: it is there; the files are in runs/x"]
    assert closing("done", Path("x"), True, one_hand_plan).count("\n") == 0
