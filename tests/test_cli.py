"""The command line as a person meets it: help, version, results, mistakes."""

from __future__ import annotations

import functools
import io
import json
import subprocess
import sys
import time
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace
from typing import get_args, get_type_hints

import pytest
from rich.console import Console

import clamber
from clamber import cli
from clamber.cli import commands, output
from clamber.contact.steps import Skipped
from clamber.execution.events import Lost
from clamber.execution.verdict import Figure
from support.files import write_take

COMMANDS = (
    *("climb", "contacts", "plan", "replan", "simulate", "learn"),
    *("render", "report", "export"),
    *("scene", "robot", "sweep"),
)


def run(*args: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", "import sys; from clamber.cli import main"]
    command[-1] += "; sys.exit(main())"
    words = [str(a) for a in args]
    return subprocess.run([*command, *words], capture_output=True, text=True)


@pytest.fixture
def scene_file(tmp_path: Path) -> Path:
    path = tmp_path / "scene.yaml"
    path.write_text(
        "boxes:\n- {name: table, size: [0.95, 0.6, 0.275], position: [0.705, 0.0]}\n"
    )
    return path


def test_help_names_every_command_without_loading_the_planner():
    start = time.perf_counter()
    code = "import sys; from clamber.cli import main\ntry:\n  main(['--help'])\n"
    code += "finally:\n  print('LOADED', *sys.modules)"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert time.perf_counter() - start < 10.0
    text, loaded = out.stdout.split("LOADED")
    assert not {"mujoco", "numpy", "scipy", "clamber.planning.planner"} & set(
        loaded.split()
    )
    for name in COMMANDS:
        assert name in text


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_explains_itself(name: str, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as stop:
        cli.main([name, "--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    assert f"clamber {name}" in text
    assert "--json" in text
    assert "--quiet" in text


@pytest.mark.parametrize("args", [["--version"], ["climb", "--version"]])
def test_version_is_that_of_the_package(
    args: list[str], capsys: pytest.CaptureFixture[str]
):
    assert cli.main(args) == 0
    assert capsys.readouterr().out == f"clamber {clamber.__version__}\n"


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (["climb", "--height", "-1"], "--height is -1.0; expected a positive length"),
        (["climb", "--height", "nan"], "--height is nan; expected a finite number"),
        (["climb", "--robot", "nobody"], "--robot is 'nobody'; expected a robot.yaml"),
        (["climb", "--scene", "no.yaml"], "no.yaml: expected a readable file"),
        (["climb", "--scene", "a.yaml", "--height", "1"], "one of them alone"),
        (["replan", "no.json"], "no.json: expected a readable file"),
        (["replan", "no", "--from", "3"], "no: expected a run folder"),
        (["climb", "--search.tries", "-1"], "--search.tries is -1; expected 0 or more"),
        (["scene", "no.yaml"], "no.yaml: expected a readable file"),
        (["robot", "check", "nobody.urdf"], "expected a robot.yaml"),
        (["sweep", "no.yaml"], "no.yaml: expected a readable file"),
        (
            ["sweep", "a.yaml", "--workers", "1", "--scheduler", "tcp://b:1"],
            "one of them",
        ),
        (["sweep", "no.yaml", "--workers", "0"], "--workers is 0; expected 1 or more"),
    ],
)
def test_a_mistake_is_one_sentence_on_stderr_and_exit_2(
    args: list[str], said: str, capsys: pytest.CaptureFixture[str]
):
    assert cli.main(args) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert err.startswith("clamber: ")
    assert said in err


@pytest.mark.parametrize(
    ("args", "said"),
    [
        ([], "climb, contacts, plan"),
        (["nonsense"], "nonsense"),
        (["plan"], "SEQUENCE"),
        (["climb", "--height", "abc"], "--height"),
        (["climb", "--hight", "1"], "--height"),
        (["climb", "--speed", "fast"], "--speed"),
        (["climb", "--method", "luck"], "gradient"),
        (["replan"], "SEQUENCE"),
    ],
)
def test_wrong_flags_are_named_on_stderr_and_exit_2(
    args: list[str], said: str, capsys: pytest.CaptureFixture[str]
):
    assert cli.main(args) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert said in err
    assert "Traceback" not in err


def test_the_process_ends_with_the_exit_code():
    out = run("scene", "nowhere.yaml")
    assert out.returncode == 2
    assert out.stderr.startswith("clamber: nowhere.yaml")


def test_a_wrong_field_of_a_scene_is_named(
    scene_file: Path, capsys: pytest.CaptureFixture[str]
):
    scene_file.write_text(scene_file.read_text().replace("0.275", "-0.275"))
    assert cli.main(["scene", str(scene_file)]) == 2
    err = capsys.readouterr().err
    for word in (str(scene_file), "boxes.0.size.2", "-0.275", "positive length"):
        assert word in err


def test_json_is_one_object_with_the_figures_of_the_table(
    scene_file: Path, capsys: pytest.CaptureFixture[str]
):
    assert cli.main(["scene", str(scene_file), "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["version"] == 1
    assert [s["name"] for s in record["supports"]] == ["ground", "table"]
    assert record["supports"][1]["centre"] == [0.705, 0.0, 0.275]
    assert cli.main(["scene", str(scene_file)]) == 0
    table = capsys.readouterr().out
    assert "0.705 0.000 0.275" in table
    assert "centre [m]" in table


def test_json_and_quiet_may_also_stand_before_the_command(
    scene_file: Path, capsys: pytest.CaptureFixture[str]
):
    assert cli.main(["--json", "scene", str(scene_file)]) == 0
    assert json.loads(capsys.readouterr().out)["version"] == 1
    assert cli.main(["--quiet", "scene", str(scene_file)]) == 0
    assert capsys.readouterr().out == ""


def test_the_built_in_robot_passes_its_check(capsys: pytest.CaptureFixture[str]):
    assert cli.main(["robot", "check", "coman", "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["mass"] == pytest.approx(28.89, abs=0.05)
    assert record["joints"] == 23
    assert set(record["surfaces"]) == {
        side + part for side in "LR" for part in ("Hand", "Elbow", "Knee", "Foot")
    }


def test_an_interrupt_is_one_sentence_and_exit_130(
    scene_file: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    def interrupt(self: object) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(commands.SceneCommand, "run", interrupt)
    assert cli.main(["scene", str(scene_file)]) == 130
    assert capsys.readouterr().err.count("\n") == 1


def test_the_flags_of_planning_are_fields_of_its_options():
    from clamber.planning.records import Method, PlanOptions

    flags, options = commands.PlanningFlags(), PlanOptions()
    for f in fields(commands.PlanningFlags):
        assert getattr(flags, f.name) == getattr(options, f.name)
    shown = get_type_hints(commands.PlanningFlags)["method"]
    assert get_args(shown) == get_args(Method)


def test_progress_on_a_log_is_one_line_for_each_tenth():
    log = io.StringIO()
    report = output.progress_lines(Console(file=log, width=80))
    for k in range(200):
        report("plan", k / 200, f"move {k}")
    report("simulate", 1.0, "")
    lines = log.getvalue().splitlines()
    assert len(lines) == 11
    assert lines[0] == "plan   0 % move 0"
    assert lines[-1] == "simulate 100 %"


def test_progress_on_a_terminal_shows_stage_share_and_time_left():
    screen = io.StringIO()
    console = Console(file=screen, width=100, force_terminal=True)
    with output.progress_bars(console) as report:
        report("plan", 0.0, "LHand")
        report("plan", 0.5, "[RHand]")
        report("simulate", 0.2, "")
    text = screen.getvalue()
    for word in ("plan", "simulate", "100%", "0:00:00"):
        assert word in text


@pytest.fixture
def stages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """Stand-ins for the stages that note in `calls` what was asked of them."""
    contact = SimpleNamespace(surface="LHand", support="table")
    stance = SimpleNamespace(contacts=(contact,), region="O")
    sequence = SimpleNamespace(stances=(stance,), t=[0.0, 1.5])
    state = SimpleNamespace(contact=contact, projected_distance=0.0425)
    keyframe = SimpleNamespace(
        contacts=(state,),
        com_margin=0.031,
        equilibrium=SimpleNamespace(margin=0.57, limiting="LKneeSag"),
        method="direct",
        iterations=14,
        cost_before=0.805,
        cost_after=0.125,
    )
    change = SimpleNamespace(step="air -> LHand on table")
    skipped = Skipped(stance=3, reason="out of reach [0.4 m]")
    plan = SimpleNamespace(
        keyframes=(keyframe, keyframe),
        changes=(change,),
        skipped=(skipped,),
        failures=(),
        why_not=skipped.reason,
        complete=True,
        fallback=None,
        trajectory="timed",
    )
    event = Lost(time=7.25, surface="LHand")
    criterion = SimpleNamespace(value=0.0123, limit=0.05, ok=True)
    verdict = SimpleNamespace(reached=True, criteria={"speed [m/s]": criterion})
    s = SimpleNamespace(
        calls=[], plan=plan, verdict=verdict, options=None, no_opengl=False, timings={}
    )
    now = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])

    def note(name: str, result: object = None) -> None:
        def stage(*args: object, **options: object) -> object:
            s.calls.append(name)
            if name == "plan":
                s.options = options["options"]
                options["progress"]("plan", 0.0, "air -> LHand on table")
                now[0] += 0.03
                options["progress"]("trajectory", 1.0, "")
            if name == "render_run":
                s.drawing = options
                if s.no_opengl:
                    raise clamber.ClamberError("no OpenGL")
            return result

        monkeypatch.setitem(vars(clamber), name, stage)

    for name, result in {
        "load_demo": SimpleNamespace(notes=("recognised: SMPL", "up: y")),
        "detect_contacts": sequence,
        "new_run_folder": tmp_path / "run",
        "load_sequence": sequence,
        "load_plan": plan,
        "plan": plan,
        "simulate": SimpleNamespace(events=(event,), stopped=""),
        "judge": verdict,
        "render_run": [tmp_path / "run" / "video.mp4"],
    }.items():
        note(name, result)
    for name in ("save_sequence", "save_plan", "save_rollout", "save_verdict"):
        note(name)
    monkeypatch.setitem(vars(clamber), "plan_or_replan", clamber.plan)
    monkeypatch.setattr(
        cli, "_save_timings", lambda folder, clock: s.timings.update(clock.stages())
    )
    return s


def test_climb_saves_each_result_before_the_next_stage_begins(stages: SimpleNamespace):
    assert cli.main(["climb", "--quiet", "--video", "--method", "lbfgs"]) == 0
    assert stages.calls == [
        "load_demo",
        "detect_contacts",
        "new_run_folder",
        "save_sequence",
        "plan",
        "save_plan",
        "simulate",
        "save_rollout",
        "judge",
        "save_verdict",
        "render_run",
    ]
    assert stages.options.method == "lbfgs"
    assert stages.options.speed == clamber.PlanOptions().speed


def test_climb_draws_pictures_and_a_video_if_asked(stages: SimpleNamespace):
    assert cli.main(["climb", "--quiet"]) == 0
    assert stages.drawing["with_video"] is False
    assert cli.main(["climb", "--quiet", "--video"]) == 0
    assert stages.drawing["with_video"] is True


def test_a_climb_without_opengl_is_a_climb(
    stages: SimpleNamespace, capsys: pytest.CaptureFixture[str]
):
    stages.no_opengl = True
    assert cli.main(["climb"]) == 0
    out, err = capsys.readouterr()
    assert "the robot made it" in out
    assert "clamber: no OpenGL" in err
    assert cli.main(["render", "somewhere"]) == 2


def test_each_move_has_its_row_with_figures_and_seconds(
    stages: SimpleNamespace, capsys: pytest.CaptureFixture[str]
):
    assert cli.main(["climb"]) == 0
    rows = capsys.readouterr().out.splitlines()
    row = next(r for r in rows if r.startswith("air -> LHand on table"))
    for word in ("14", "0.03", "0.805", "0.125", "31", "0.57", "LKneeSag"):
        assert word in row
    head = next(r for r in rows if r.startswith("projected distance [mm]"))
    row = next(r for r in rows[rows.index(head) :] if r.startswith("air -> LHand"))
    assert row.rstrip().endswith(" 42")
    assert head.index("LHand") < row.index(" 42") < head.index("LHand") + len("LHand")
    assert cli.main(["climb", "--json"]) == 0
    first, second = json.loads(capsys.readouterr().out)["keyframes"]
    assert first["move"] == "start"
    assert second["projected_distance"] == {"LHand": 0.0425}
    assert second["seconds"] == pytest.approx(0.03)
    assert stages.timings["plan"] == pytest.approx(0.03)


def test_the_clock_adds_up_what_was_tried_again(monkeypatch: pytest.MonkeyPatch):
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


@pytest.mark.parametrize("command", [["climb"], ["simulate", "somewhere"]])
def test_the_exit_code_is_1_if_the_robot_did_not_make_it(
    command: list[str], stages: SimpleNamespace, capsys: pytest.CaptureFixture[str]
):
    stages.verdict.reached = False
    assert cli.main(command) == 1
    assert "the robot did not make it" in capsys.readouterr().out.splitlines()[-1]


def test_a_plan_without_any_move_is_not_simulated(
    stages: SimpleNamespace, capsys: pytest.CaptureFixture[str]
):
    stages.plan.trajectory, stages.plan.complete = None, False
    assert cli.main(["climb"]) == 1
    assert "simulate" not in stages.calls
    assert "cannot do it: out of reach [0.4 m]" in capsys.readouterr().out
    assert cli.main(["simulate", "somewhere"]) == 1
    assert "simulate" not in stages.calls


def test_an_incomplete_plan_gives_the_reason_of_the_first_move_missed(
    stages: SimpleNamespace, capsys: pytest.CaptureFixture[str]
):
    reason = "LFoot -> LKnee on table: too high"
    stages.plan.why_not, stages.plan.complete = reason, False
    stages.verdict.reached = False
    for command in (["climb"], ["plan", "sequence.json"]):
        assert cli.main(command) == 1
        last = capsys.readouterr().out.splitlines()[-1]
        said = "the robot cannot do it: LFoot -> LKnee on table: too high; the files"
        assert last.startswith(said)


def test_the_table_and_the_json_of_a_climb_agree(
    stages: SimpleNamespace, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert cli.main(["climb"]) == 0
    table = capsys.readouterr().out
    for word in ("speed [m/s]", "0.0123", "0.05", "ok", str(tmp_path / "run")):
        assert word in table
    assert "out of reach [0.4 m]" in table
    assert cli.main(["climb", "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["reached"] is True
    assert record["out"] == str(tmp_path / "run")
    assert record["criteria"]["speed [m/s]"] == {
        "value": 0.0123,
        "limit": 0.05,
        "ok": True,
    }
    assert record["skipped"] == [{"stance": 3, "reason": "out of reach [0.4 m]"}]


@pytest.mark.parametrize("complete", [True, False])
def test_plan_succeeds_only_if_it_is_complete(
    complete: bool, stages: SimpleNamespace, capsys: pytest.CaptureFixture[str]
):
    stages.plan.complete = complete
    assert cli.main(["plan", "sequence.json"]) == (0 if complete else 1)
    assert "LHand on table" in capsys.readouterr().out
    assert stages.calls.index("save_sequence") < stages.calls.index("plan")
    assert "simulate" not in stages.calls


def test_contacts_lists_the_stances_it_found(
    stages: SimpleNamespace, capsys: pytest.CaptureFixture[str]
):
    assert cli.main(["contacts", "mine.yaml"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].split() == ["0", "O", "0.00", "1.50", "LHand", "on", "table"]
    assert lines[2:4] == ["recognised: SMPL", "up: y"]


def test_contacts_says_by_how_much_the_floor_was_off(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    from dataclasses import replace

    import numpy as np

    demo = clamber.load_demo("climb")
    lifted = replace(demo, position=demo.position + np.array([0.0, 0.0, 0.035]))
    write_take(lifted, tmp_path / "take.c3d")
    out = ["--out", str(tmp_path / "out"), "--json"]
    assert cli.main(["contacts", str(tmp_path / "take.c3d"), "--fit-floor", *out]) == 0
    notes = json.loads(capsys.readouterr().out)["notes"]
    assert "clamber's own points" in notes[0]
    assert any(n.startswith("fitted: ground +35 mm (foot at rest") for n in notes)


def test_render_names_its_files(
    stages: SimpleNamespace, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert cli.main(["render", "somewhere", "--json"]) == 0
    files = json.loads(capsys.readouterr().out)["files"]
    assert files == [str(tmp_path / "run" / "video.mp4")]


# Mistakes of a user, through the whole command.


RECORDING = """
file: joints.npy
rate: 120
unit: {unit}
names: [LHand, RHand]
"""


def spoiled_robot(folder: Path) -> Path:
    """COMAN's files, the description naming a surface that the model has not."""
    from clamber.model.robot import ROBOTS

    for p in (ROBOTS / "coman").iterdir():
        (folder / p.name).write_bytes(p.read_bytes())
    path = folder / "robot.yaml"
    text = path.read_text().replace("[LHand, LElbow]", "[LHand, LTip]")
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("no.npy", None, "no.npy"),
        ("film.mp4", "", "film.mp4"),
        ("joints.npy", "no array", "joints.npy"),
        ("recording.yaml", RECORDING.format(unit="ell"), "unit"),
        ("recording.yaml", "- a\n- b\n", "recording.yaml"),
        ("recording.yaml", RECORDING.format(unit="m"), "joints.npy"),
    ],
)
def test_a_recording_that_cannot_be_used_is_one_sentence(
    name: str,
    content: str | None,
    said: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
):
    path = tmp_path / name
    if content is not None:
        path.write_text(content)
    for command in (["climb", "--demo", path], ["contacts", path]):
        out = tmp_path / "out"
        assert cli.main([*map(str, command), "--quiet", "--out", str(out)]) == 2
        err = capsys.readouterr().err
        assert said in err
        assert err.count("\n") == 1
        assert not out.exists()


def one_stance(folder: Path) -> Path:
    """A sequence that any scene with a box fits."""
    import numpy as np

    from clamber.contact.contact import Contact, ContactSequence, Stance
    from clamber.model.scene import Scene

    def on(surface: str, support: str, x: float, z: float) -> Contact:
        y = 0.07 if surface[0] == "L" else -0.07
        position, quaternion = np.array([x, y, z]), np.array([1.0, 0, 0, 0])
        return Contact(
            surface=surface, support=support, position=position, quaternion=quaternion
        )

    feet = (on("LFoot", "ground", 0.0, 0.0), on("RFoot", "ground", 0.0, 0.0))
    sequence = ContactSequence(
        source="made up",
        subject=None,
        scene=Scene.from_height(0.3),
        stances=(
            Stance(contacts=feet),
            Stance(contacts=(*feet, on("LHand", "box", 0.43, 0.3))),
        ),
        t=np.array([0.0, 1.0, 2.0]),
    )
    clamber.save_sequence(sequence, folder / "sequence.json")
    return folder / "sequence.json"


def test_a_box_out_of_reach_is_named_with_its_file(
    scene_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    scene_file.write_text(scene_file.read_text().replace("[0.705, 0.0]", "[5.0, 0.0]"))
    command = ["plan", str(one_stance(tmp_path)), "--quiet", "--out", str(tmp_path)]
    assert cli.main([*command, "--scene", str(scene_file)]) == 2
    err = capsys.readouterr().err
    assert err.startswith(f"clamber: {scene_file}: boxes.table is '4.5")
    assert "the robot's reach" in err
    assert cli.main([*command, "--height", "3.0"]) == 2
    assert "--height: boxes.box is '3.0" in capsys.readouterr().err


def test_a_robot_without_the_surface_it_names_is_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    robot = spoiled_robot(tmp_path)
    assert cli.main(["climb", "--robot", str(robot), "--quiet"]) == 2
    err = capsys.readouterr().err
    for word in (str(robot), "limbs.left_arm.surfaces", "LTip", "geoms of coman.xml"):
        assert word in err
    assert err.count("\n") == 1


def test_a_folder_that_cannot_be_written_is_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    (tmp_path / "taken").write_text("")
    out = str(tmp_path / "taken")
    sequence = str(one_stance(tmp_path))
    assert cli.main(["plan", sequence, "--quiet", "--out", out]) == 2
    err = capsys.readouterr().err
    assert err.startswith(f"clamber: --out is '{out}'; expected a folder that can be")
    assert err.count("\n") == 1


@pytest.mark.parametrize("speed", ["0", "-0.3", "nan"])
def test_a_speed_that_is_none_is_refused(
    speed: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    command = ["plan", str(one_stance(tmp_path)), "--quiet", "--out", str(tmp_path)]
    assert cli.main([*command, "--speed", speed]) == 2
    err = capsys.readouterr().err
    assert "speed" in err
    assert err.count("\n") == 1


@pytest.mark.parametrize("command", ["simulate", "render"])
def test_a_run_that_is_none_is_one_sentence(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert cli.main([command, str(tmp_path / "nowhere"), "--quiet"]) == 2
    err = capsys.readouterr().err
    assert "nowhere" in err
    assert "expected a run folder" in err
    (tmp_path / "plan.json").write_text("{")
    assert cli.main([command, str(tmp_path), "--quiet"]) == 2
    assert "plan.json" in capsys.readouterr().err


def test_plan_and_simulate_of_a_real_sequence_leave_the_files_of_the_format(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """One hand on a box that is no goal yet: planned and held, but not on top."""
    run_folder = tmp_path / "run"
    command = ["plan", str(one_stance(tmp_path)), "--height", "0.25", "--json"]
    assert cli.main([*command, "--out", str(run_folder)]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["complete"] is True
    assert [k["move"] for k in record["keyframes"]] == ["start", "air -> LHand on box"]
    assert record["keyframes"][1]["seconds"] > 0
    command = ["simulate", str(run_folder), "--controller", "pid", "--json"]
    assert cli.main(command) == 1
    record = json.loads(capsys.readouterr().out)
    assert record["reached"] is False
    on_top = record["criteria"][Figure.LOAD_ON_OBSTACLES]
    assert 0.0 < on_top["value"] < 0.5
    assert record["criteria"][Figure.LOAD_ON_PLAN]["ok"] is True
    assert {p.name for p in run_folder.iterdir()} == {
        "sequence.json",
        "plan.json",
        "planned.npz",
        "planned.xml",
        "trajectory.npz",
        "scene.xml",
        "timings.json",
        "rollout.npz",
        "execution.json",
        "verdict.json",
    }
    seconds = json.loads((run_folder / "timings.json").read_text())["seconds"]
    assert seconds["simulate"] > 0
    assert seconds["keyframes"] > 0


@pytest.fixture
def quick_sweep(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The words of a sweep whose jobs are quick."""
    import sweep_jobs
    from clamber.study import sweep

    quick = functools.partial(sweep.run_sweep, job=sweep_jobs.breaks_at_friction)
    monkeypatch.setattr(sweep, "run_sweep", quick)
    spec = tmp_path / "friction.yaml"
    spec.write_text(
        "base: {height: 0.275}\n"
        "search: {factor: disturb.friction, from: 1.0, to: 0.05, runs: 24}\n"
    )
    return ["sweep", str(spec), "--workers", "1"]


def test_a_sweep_ends_with_a_table_of_where_each_controller_breaks(
    quick_sweep: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    monkeypatch.chdir(tmp_path)
    assert cli.main(quick_sweep) == 0
    out, err = capsys.readouterr()
    assert "half at" in out
    assert "48 rows, 48 of them new; the files are in runs/friction" in out
    assert "sweep 100 % 48 of 48" in err
    names = {f.name for f in (tmp_path / "runs" / "friction").iterdir()}
    wanted = {"spec.yaml", "runs.csv", "timings.json", "success.png"}
    assert {*wanted, "summary.csv", "curve.csv"} <= names
    assert cli.main([*quick_sweep, "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert (record["rows"], record["new"]) == (48, 0)
    pid, mixed = record["summary"]
    assert pid["half"] == pytest.approx(0.4, abs=0.05)
    assert mixed["half"] == pytest.approx(0.3, abs=0.05)
    sessions = json.loads(Path("runs/friction/timings.json").read_text())["sessions"]
    assert [s["runs"] for s in sessions] == [48]


def test_a_sweep_that_is_interrupted_says_how_to_go_on(
    quick_sweep: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    from clamber.study import sweep

    def interrupt(*args: object, **more: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(sweep, "run_sweep", interrupt)
    assert cli.main([*quick_sweep, "--out", str(tmp_path / "out")]) == 130
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith("clamber: interrupted; the finished rows are in ")
    assert said.endswith("the same command goes on from there")


def test_a_sweep_with_a_robot_that_is_not_there_runs_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    spec = tmp_path / "spec.yaml"
    spec.write_text("base: {robot: nobody}\ngrid: {height: [0.2, 0.3]}\n")
    out = tmp_path / "out"
    assert cli.main(["sweep", str(spec), "--out", str(out)]) == 2
    assert "nobody" in capsys.readouterr().err
    assert not out.exists()


# One picture of a run.


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch, stages: SimpleNamespace) -> list[tuple]:
    """What is asked of the drawing functions, which draw nothing."""
    asked: list[tuple] = []

    def note(name: str, home: str) -> None:
        def draw(*args: object, **options: object) -> Path:
            asked.append((name, args, options))
            return Path("there.png")

        monkeypatch.setattr(f"clamber.show.{home}.{name}", draw)

    note("render_frame", "pictures")
    note("keyframe_sheet", "pictures")
    note("video", "renderer")
    monkeypatch.setitem(vars(clamber), "load_rollout", lambda folder: "rollout")
    return asked


def test_render_passes_on_what_is_asked(drawn: list[tuple]):
    frame = ["--frame", "9.5", "--transparent", "--camera", "top", "--size", "720p"]
    assert cli.main(["render", "run", *frame, "--quiet"]) == 0
    name, args, options = drawn.pop()
    assert name == "render_frame"
    assert args == (Path("run"), 9.5)
    wanted = {"out": None, "transparent": True, "camera": "top", "size": (1280, 720)}
    assert options == wanted
    assert cli.main(["render", "run", "--sheet", "--size", "300x200", "--quiet"]) == 0
    name, args, options = drawn.pop()
    assert (name, args[1]) == ("keyframe_sheet", Path("run/keyframes.png"))
    assert options == {"camera": "corner", "tile": (300, 200)}
    assert cli.main(["render", "run", "--video", "--out", "a.webp", "--quiet"]) == 0
    name, args, options = drawn.pop()
    assert name == "video"
    assert args[1:] == ("rollout", Path("run"))
    assert options["out"] == Path("a.webp")
    assert options["size"] is None


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--video", "--sheet"], "one of them"),
        (["--frame", "1", "--video"], "one of them"),
        (["--transparent", "--sheet"], "--transparent: give --frame too"),
        (["--camera", "top"], "give --video, --sheet or --frame too"),
        (["--out", "x.png"], "give --video, --sheet or --frame too"),
        (
            ["--frame", "1", "--size", "huge"],
            "--size is 'huge'; expected such as 1080p",
        ),
        (["--frame", "1", "--size", "641x480"], "even numbers"),
        (["--video", "--size", "9999p"], "from 64 to 4096"),
        (["--frame", "1", "--camera", "below"], "--camera"),
        (["--sheet", "--out", "x.jpg"], "ends in .png"),
    ],
)
def test_flags_of_a_picture_that_do_not_fit_are_one_sentence(
    flags: list[str],
    said: str,
    drawn: list[tuple],
    capsys: pytest.CaptureFixture[str],
):
    assert cli.main(["render", "run", *flags]) == 2
    err = capsys.readouterr().err
    assert said in err
    assert err.count("\n") == 1
    assert drawn == []


@pytest.mark.parametrize(
    ("text", "size"),
    [("1080p", (1920, 1080)), ("480p", (854, 480)), ("2160p", (3840, 2160))],
)
def test_sizes_by_their_lines_are_16_to_9(text: str, size: tuple[int, int]):
    assert commands._picture_size(text) == size


# Learning.


@pytest.fixture(scope="module")
def learned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a policy, and the sequence that it was learned from."""
    folder = tmp_path_factory.mktemp("learn")
    sequence = clamber.detect_contacts(clamber.load_demo("crossing"))
    clamber.save_sequence(sequence, folder / "sequence.json")
    out = folder / "policy.json"
    code = cli.main(
        ["learn", str(folder / "sequence.json"), "--out", str(out), "--quiet"]
    )
    assert code == 0
    return folder


def test_learn_writes_a_policy_that_is_read_again_and_two_pictures(learned: Path):
    policy = clamber.load_policy(learned / "policy.json")
    assert [o.name for o in policy.options] == "ac1 ac2 ac3 ac2 ac1 ac4".split()
    for name in ("policy.png", "policy-pelvis.png"):
        content = (learned / name).read_bytes()
        assert content.startswith(b"\x89PNG")
        assert len(content) < 1_000_000
    assert not [p for p in learned.iterdir() if p.name.startswith(".")]


def test_learn_shows_options_and_the_pelvis(
    learned: Path, capsys: pytest.CaptureFixture[str]
):
    arguments = ["learn", str(learned), "--out", str(learned / "shown.json")]
    assert cli.main(arguments) == 0
    out = capsys.readouterr().out
    assert "LElbow, RElbow, LKnee, RKnee" in out
    assert "near edge" in out
    assert "over top" in out
    assert str(learned / "shown.json") in out
    assert cli.main([*arguments, "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert [o["region"] for o in record["options"]] == "M M O M M goal".split()
    assert record["options"][2]["surfaces"] == ["LElbow", "RElbow", "LKnee", "RKnee"]
    assert record["near_edge"]["samples"] > 10
    assert len(record["over_top"]["sigma"]) == 3
    assert record["secondary"] == []
    assert record["out"] == str(learned / "shown.json")


def test_learning_twice_writes_the_same_bytes(learned: Path):
    other = learned / "again.json"
    cli.main(["learn", str(learned), "--out", str(other), "--quiet"])
    assert other.read_bytes() == (learned / "policy.json").read_bytes()
    picture = learned / "again.png"
    assert picture.read_bytes() == (learned / "policy.png").read_bytes()


def test_what_cannot_be_learned_from_is_said_in_a_sentence(
    learned: Path, capsys: pytest.CaptureFixture[str]
):
    broken = learned / "broken.json"
    broken.write_text((learned / "sequence.json").read_text()[:5000])
    for arguments, words in (
        (["climb"], ["climb", "no repeated cycle"]),
        (["crossin"], ["crossin", "expected"]),
        ([str(broken)], ["broken.json", "whole JSON"]),
        ([str(learned / "policy.json")], ["policy.json", "expected"]),
        ([str(learned), "--out", str(learned / "policy.txt")], ["policy.txt", ".json"]),
        ([], ["name at least one, such as crossing"]),
    ):
        assert cli.main(["learn", *arguments, "--quiet"]) == cli.BAD_INPUT
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        for word in words:
            assert word in error
