"""What is seen in a terminal: 80 columns, one sentence a mistake, completion, codes."""

from __future__ import annotations

import fcntl
import json
import os
import pty
import re
import struct
import subprocess
import sys
import termios
from pathlib import Path

import pytest

from clamber import cli
from clamber.cli import output
from clamber.run import folder as io
from conftest import ROOT

COLUMNS = 80
PROGRAM = "import sys; from clamber.cli import main; sys.exit(main())"
CLAMBER = (sys.executable, "-c", PROGRAM)


@pytest.fixture(scope="module")
def folder(
    one_hand_plan, one_hand_rollout, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """A run folder `run` of the shortest motion, a scene, a spec and a policy."""
    from clamber.execution.verdict import judge

    folder = tmp_path_factory.mktemp("terminal")
    run = folder / "run"
    run.mkdir()
    io.save_sequence(one_hand_plan.sequence, run / "sequence.json")
    io.save_plan(one_hand_plan, run)
    io.save_rollout(one_hand_plan, one_hand_rollout, run)
    io.save_verdict(judge(one_hand_plan, one_hand_rollout), run)
    (folder / "scene.yaml").write_text(
        "boxes:\n- {name: table, size: [0.95, 0.6, 0.275], position: [0.705, 0.0]}\n"
    )
    (folder / "spec.yaml").write_text(
        "controllers: [pid]\nbase: {height: 9.0}\ngrid: {disturb.seed: [0, 1]}\n"
    )
    return folder


# Every command but climb and traverse, which end with the table of simulate.
COMMANDS = {
    "contacts": "contacts climb --out {out}",
    "plan": "plan run/sequence.json --height 0.25 --speed max --out {out}",
    "replan": "replan run --from 1 --search.tries 0 --out {out}",
    "simulate": "simulate run --controller pid",
    "learn": "learn crossing --out {out}/policy.json",
    "report": "report run --out {out}.html",
    "export": "export run --to npz --out {out}.npz",
    "scene": "scene scene.yaml",
    "robot": "robot check coman29",
    "sweep": "sweep spec.yaml --workers 1 --out {out}",
}
# Twice more would be long, and tests/test_cli.py looks at it.
SHORT = [name for name in COMMANDS if name != "learn"]
each_command = pytest.mark.parametrize("name", COMMANDS)


def plain(text: str) -> list[str]:
    """Its lines, without bold and colours."""
    return re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", text).splitlines()


def done(
    name: str, folder: Path, monkeypatch: pytest.MonkeyPatch, *flags: str
) -> int | str | None:
    monkeypatch.chdir(folder)
    out = f"{name}{len(list(folder.iterdir()))}"
    return cli.main([*COMMANDS[name].format(out=out).split(), *flags])


@each_command
def test_results_fit_into_80_columns(
    name: str,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    monkeypatch.setenv("COLUMNS", str(COLUMNS))
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    assert done(name, folder, monkeypatch) in (output.REACHED, output.MISSED)
    lines = plain(capsys.readouterr().out)
    assert lines
    assert max(map(len, lines)) <= COLUMNS
    cut = [line for line in lines if "\N{HORIZONTAL ELLIPSIS}" in line]
    assert not cut, "a cell that is cut off says nothing"


@pytest.mark.parametrize("name", SHORT)
def test_json_is_one_object_on_stdout_and_quiet_says_nothing(
    name: str,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    code = done(name, folder, monkeypatch, "--json")
    record = json.loads(capsys.readouterr().out)
    assert isinstance(record, dict)
    assert record
    assert done(name, folder, monkeypatch, "--quiet") == code
    assert capsys.readouterr() == ("", "")


def on_screen(words: list[str], folder: Path) -> tuple[int, list[str]]:
    """Exit code and lines of a command in a terminal of 80 columns, results alone."""
    pid, screen = pty.fork()
    if pid == 0:
        os.chdir(folder)
        os.environ.pop("COLUMNS", None)
        os.environ["TERM"] = "xterm"
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # progress, which is not looked at
        os.execv(CLAMBER[0], [*CLAMBER, *words])
    fcntl.ioctl(screen, termios.TIOCSWINSZ, struct.pack("HHHH", 24, COLUMNS, 0, 0))
    seen = b""
    while True:
        try:
            part = os.read(screen, 65536)
        except OSError:  # the other end is closed
            break
        if not part:
            break
        seen += part
    code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    return code, plain(seen.decode().replace("\r\n", "\n"))


def test_a_real_terminal_gets_the_same_lines(folder: Path):
    code, lines = on_screen(["contacts", "climb", "--out", "seen"], folder)
    assert code == 0
    assert lines[0].split() == [
        "stance",
        "region",
        "from",
        "[s]",
        "to",
        "[s]",
        "contacts",
    ]
    assert lines[2].rstrip().endswith("LHand on table, LFoot RFoot on ground")
    assert lines[-1].rstrip() == "the sequence is in seen"
    assert max(map(len, lines)) <= COLUMNS


def test_the_last_line_is_wrapped_for_a_person_and_whole_for_a_file(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    words = "word " * 40
    shown = output.Output()
    shown.show({}, note=words)
    assert capsys.readouterr().out.splitlines() == [words]
    monkeypatch.setenv("COLUMNS", str(COLUMNS))
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    shown.show({}, note=words)
    lines = plain(capsys.readouterr().out)
    assert len(lines) == 3
    assert max(map(len, lines)) <= COLUMNS


def test_who_does_not_make_it_is_told_where_to_look(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    assert done("simulate", folder, monkeypatch) == output.MISSED
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith("the robot did not make it (")
    assert last.endswith("`clamber report run` shows how far it came")


# What people do wrong: what is said of it, and what to do instead.
MISTAKES = {
    "view nothing": ("'nothing'", "a file that ends in"),
    "": ("Expected one of {climb, contacts", "clamber --help"),
    "nonsense": ("nonsense", "clamber --help"),
    "plan": ("Missing from clamber plan: SEQUENCE", "clamber plan --help"),
    "climb --hieght 0.3": ("--hieght", "--height METRES"),
    "climb --height abc": ("--height", "['abc']"),
    "climb --height -1": ("--height is -1.0", "expected a positive length [m]"),
    "climb --height 9": ("9.00 m away", "within 1.15 m of the start"),
    "climb --scene a.yaml --height 1": ("--height, --scene", "give one of them alone"),
    "climb --robot nobody": ("--robot is 'nobody'", "a robot.yaml, or one of coman"),
    "climb --robot word.txt": ("'word.txt'", "a robot.yaml beside the model"),
    "climb --demo nobody": (
        "'nobody'",
        "demonstrations ['climb', 'crossing']",
    ),
    "climb --demo no.c3d": ("no.c3d: expected a readable file", "check the path"),
    "climb --demo word.txt": ("word.txt", "expected a recording: .c3d"),
    "climb --scene no.yaml": ("no.yaml: expected a readable file", "check the path"),
    "climb --scene tab.yaml": ("tab.yaml: expected YAML", "line 2"),
    "climb --scene field.yaml": ("boxes.0.colour", "mend its name, or leave it out"),
    "climb --scene inside.yaml": ("start is", "move the one or the other"),
    "climb --speed fast": ("--speed", "'fast'"),
    "climb --speed 0": ("--speed is 0.0", "expected a positive joint speed"),
    "climb --disturb.friction 7": ("--disturb.friction is 7.0", "from 0.01 to 1"),
    "climb --controller magic": ("'magic'", "'mixed'"),
    "climb --search.tries -1": ("--search.tries is -1", "expected 0 or more"),
    "climb --out word.txt/x": ("--out is 'word.txt/x'", "a folder that can be written"),
    "contacts no.bvh": ("no.bvh: expected a readable file", "check the path"),
    "plan no.json": ("no.json: expected a readable file", "check the path"),
    "plan empty": ("empty/sequence.json", "`clamber contacts` writes it"),
    "plan word.txt": ("word.txt: expected whole JSON", "check the path"),
    "plan run/plan.json": ("run/plan.json", "expected a value: it is missing"),
    "replan empty --from 3": ("empty/plan.json", "`clamber plan` writes it"),
    "replan run --from 99": ("--from is", "expected a time of the rollout, 0 to"),
    "simulate nowhere": ("nowhere: expected a run folder", "`clamber climb`"),
    "simulate cut": (
        "cut/plan.json: expected whole JSON",
        "`clamber plan` writes it",
    ),
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
    "render run --size 1080p": ("--size", "give --video, --sheet or --frame too"),
    "render run --frame 1 --size big": ("--size is 'big'", "such as 1080p or 1280x720"),
    "report nowhere": ("nowhere: expected a run folder", "`clamber climb`"),
    "report empty": ("a whole plan.json or verdict.json", "`clamber climb`"),
    "export run": ("--to {csv,mcap,npz}", "clamber export --help"),
    "export run --to xml": ("'xml'", "'mcap'"),
    "export run --to csv --rate 7": ("--rate is 7", "a divisor of 1000 Hz, as 50"),
    "export run --to csv --layout mjlab": ("--layout is", "it goes with --to npz"),
    "export half --to csv": ("half/planned.npz", "`clamber plan` writes it"),
    "scene word.txt": ("word.txt is 'str'", "expected a mapping of fields"),
    "robot check nobody": ("'nobody'", "a robot.yaml, or one of coman, coman29"),
    "robot init no.urdf": ("no.urdf: expected a readable file", "check the path"),
    "robot frob coman": ("'frob'", "'check'"),
    "sweep no.yaml": ("no.yaml: expected a readable file", "check the path"),
    "sweep typo.yaml": ("not disturb.fricton", "there are demo, robot, height"),
    "sweep spec.yaml --workers 0": ("--workers is 0", "expected 1 or more"),
    "sweep spec.yaml --workers 1 --scheduler a:1": ("--workers", "one of them alone"),
}


@pytest.fixture(scope="module")
def mistaken(folder: Path) -> Path:
    """The folder with all that can be wrong in it."""
    box = "boxes:\n- {name: t, size: [1, 1, 0.3], position: [%s, 0]%s}\n"
    for name, text in {
        "word.txt": "hello",
        "tab.yaml": "boxes:\n\t- a\n",
        "field.yaml": box % (0.73, ", colour: red"),
        "inside.yaml": box % (0.3, ""),
        "typo.yaml": "grid: {disturb.fricton: [1, 2]}\n",
        "cut/plan.json": (folder / "run" / "plan.json").read_text()[:500],
        "half/plan.json": (folder / "run" / "plan.json").read_text(),
        "half/planned.xml": (folder / "run" / "planned.xml").read_text(),
        "empty/.keep": "",
    }.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text)
    return folder


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_one_sentence_that_names_the_next_step(
    mistake: str,
    mistaken: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    monkeypatch.chdir(mistaken)
    words = mistake.split()
    quiet = ["--quiet"] if words else []
    assert cli.main([*words, *quiet]) == output.BAD_INPUT
    out, err = capsys.readouterr()
    assert out == ""
    assert "Traceback" not in err
    if err.startswith("clamber: "):
        assert err.count("\n") == 1
    else:  # the parser of the flags has drawn a box
        err = " ".join(err.replace("│", " ").split())
    wrong, instead = MISTAKES[mistake]
    assert wrong in err
    assert instead in err


def test_a_reader_that_has_seen_enough_is_no_error():
    line = f"set -o pipefail; {sys.executable} -c '{PROGRAM}' --help | true"
    done = subprocess.run(["bash", "-c", line], capture_output=True, text=True)
    assert done.stderr == ""
    assert done.returncode in (0, output.READER_GONE)


def test_the_exit_codes_are_those_that_are_documented():
    text = (ROOT / "docs" / "terminal.md").read_text()
    rows = dict(re.findall(r"^\| (\d+) \| (.*?) \|$", text, re.M))
    codes = (
        output.REACHED,
        output.MISSED,
        output.BAD_INPUT,
        output.INTERRUPTED,
        output.READER_GONE,
    )
    assert [int(c) for c in rows] == list(codes)
