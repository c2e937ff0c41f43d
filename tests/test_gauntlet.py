"""The gauntlet: a row for every file, whatever the commands do that it runs."""

from __future__ import annotations

import csv
import importlib.util
import json
import re
import sys
import time
import zipfile
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

import humanoids
from conftest import ROOT

CLAMBER = """
import json, sys, time
from pathlib import Path
args = sys.argv[1:]
name, out = next(a for a in args if "." in a), Path(args[args.index("--out") + 1])
def end(record, code=0, said=""):
    sys.stderr.write(said)
    print(json.dumps(record), flush=True)
    sys.exit(code)
if args[0] == "robot":
    if "fault" in name:
        end({"mass": 30, "joints": 21, "knee_height": 0.4, "faults": ["lies"]}, 1)
    if "refuse" in name:
        sys.exit("clamber: expected two legs")
    if "usage" in name:
        sys.stderr.write("╭─ Missing ───╮\\n│ a value     │\\n╰─────────────╯\\n")
        sys.exit(2)
    end({"mass": 30, "joints": 21, "knee_height": 0.4, "faults": [], "notes": ["n"]})
if args[0] == "climb":
    assert args[args.index("--height") + 1] == "0.380"
    if "raise" in name:
        raise RuntimeError("sudden")
    if "slow" in name:
        time.sleep(60)
    if "fall" in name:
        end({"note": "failed: not met: did not fall; knee was at its limit"}, 1)
    if "mute" in name:
        end({"out": "here"}, 1, "  9 % plan\\n")
    end({"note": "success"})
if args[0] == "contacts":
    end({"stances": 1 if "stand" in name else 3, "notes": []})
assert name.endswith("contacts/sequence.json"), name
half = "half" in name
end({"complete": not half, "failures": ["no way up"] * half})
"""


@pytest.fixture
def gauntlet(tmp_path, monkeypatch) -> ModuleType:
    """The script, with a stand-in for the command."""
    path = ROOT / "benchmarks" / "gauntlet.py"
    spec = importlib.util.spec_from_file_location("gauntlet", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "gauntlet", module)
    spec.loader.exec_module(module)
    stub = tmp_path / "stub.py"
    stub.write_text(CLAMBER, encoding="utf8")
    monkeypatch.setattr(module, "COMMAND", (sys.executable, "-I", str(stub)))
    return module


def rows(gauntlet, monkeypatch, *args: object) -> dict[str, dict[str, str]]:
    """What it writes of each file."""
    out = Path(str(args[-1]))
    words = ["gauntlet", *map(str, args[:-1]), "--out", str(out)]
    monkeypatch.setattr(sys, "argv", words)
    gauntlet.main()
    with (out / "gauntlet.csv").open(newline="") as f:
        read = list(csv.DictReader(f))
    assert (out / "gauntlet.md").read_text().count("\n") == len(read) + 2
    return {Path(r["file"]).name: r for r in read}


def test_each_model_has_a_row_that_says_what_became_of_it(
    gauntlet, monkeypatch, tmp_path
):
    for name in ("well", "fault", "refuse", "usage", "raise", "fall", "mute"):
        (tmp_path / "in" / name).mkdir(parents=True)
        (tmp_path / "in" / name / f"{name}.xml").write_text(humanoids.mjcf())
    (tmp_path / "in" / "scene.xml").write_text("<mujoco><worldbody/></mujoco>")
    found = rows(gauntlet, monkeypatch, tmp_path / "in", tmp_path / "out")
    assert {n: (r["came_out"], r["why"]) for n, r in found.items()} == {
        "well.xml": ("climbs", ""),
        "fault.xml": ("wrong", "lies"),
        "refuse.xml": ("refused", "clamber: expected two legs"),
        "usage.xml": ("refused", "a value"),
        "raise.xml": ("crashed", "RuntimeError: sudden"),
        "fall.xml": (
            "does not",
            "failed: not met: did not fall; knee was at its limit",
        ),
        "mute.xml": ("does not", ""),
    }
    assert found["well.xml"]["height"] == "0.380"
    assert found["well.xml"]["notes"] == "1"
    # What stands in the table is not done again.
    monkeypatch.setattr(gauntlet, "try_robot", None)
    assert rows(gauntlet, monkeypatch, tmp_path / "in", tmp_path / "out") == found


def test_a_command_beyond_its_limit_is_stopped(gauntlet, tmp_path):
    begin = time.monotonic()
    done = gauntlet.run_command(
        ["climb", "--robot", "slow.yaml", "--height", "0.380", "--out", "x"], 0.3
    )
    assert done.code is None
    assert not done.crashed
    assert 0.3 <= done.silence <= done.seconds < 30
    assert time.monotonic() - begin < 30  # the command would sleep for 60
    row = gauntlet.Row(file="slow")
    assert not gauntlet.settled(row, done, "")
    assert row.came_out == "too slow"


def test_each_recording_has_one_too(gauntlet, monkeypatch, tmp_path):
    for name in ("walk.trc", "half.trc", "stand.trc", "other.csv"):
        (tmp_path / name).write_text("")
    (tmp_path / "take.yaml").write_text("points:\n")
    (tmp_path / "robot.yaml").write_text("limbs:\n")
    found = rows(gauntlet, monkeypatch, tmp_path, tmp_path / "out")
    assert {n: (r["came_out"], r["why"]) for n, r in found.items()} == {
        "half.trc": ("contacts, no plan", "no way up"),
        "stand.trc": ("contacts", "which never change"),
        "take.yaml": ("planned", "2 contact changes"),
        "walk.trc": ("planned", "2 contact changes"),
    }


def test_two_files_of_one_name_have_folders_of_their_own(
    gauntlet, monkeypatch, tmp_path
):
    folders = []
    monkeypatch.setattr(gauntlet, "try_robot", lambda _p, _r, f, *_: folders.append(f))
    for name in ("a.urdf", "a.xml"):
        (tmp_path / name).write_text("")
    files = (tmp_path / "a.urdf", tmp_path / "a.xml")
    assert len(rows(gauntlet, monkeypatch, *files, tmp_path / "out")) == 2
    assert len(set(folders)) == 2


def test_wheels_are_unpacked_once_and_one_that_does_not_come_is_told(
    gauntlet, monkeypatch, tmp_path, capsys
):
    asked = []

    def pip(args: list[str], **_: object) -> SimpleNamespace:
        asked.append(args[-1])
        if args[-1] != "mjlab":
            return SimpleNamespace(returncode=1, stderr="no such thing\n")
        cache = Path(args[args.index("-d") + 1])
        cache.mkdir(parents=True)
        with zipfile.ZipFile(cache / "mjlab-1.whl", "w") as f:
            f.writestr("mjlab/g1.xml", humanoids.mjcf())
        return SimpleNamespace(returncode=0, stderr="")

    monkeypatch.setattr(gauntlet.subprocess, "run", pip)
    gauntlet.fetch(tmp_path)
    assert asked == list(gauntlet.WHEELS)
    assert "armar does not come: no such thing" in capsys.readouterr().err
    found = list(gauntlet.humanoids_and_recordings([tmp_path]))
    assert found == [tmp_path / "mjlab" / "mjlab" / "g1.xml"]
    gauntlet.fetch(tmp_path)
    assert asked.count("mjlab") == 1


@pytest.mark.slow
def test_the_command_itself_is_asked_as_it_wants_to_be(tmp_path, monkeypatch, gauntlet):
    """A robot is proposed, a recording read and planned."""
    monkeypatch.setattr(gauntlet, "COMMAND", (sys.executable, "-m", "clamber"))
    (tmp_path / "h.xml").write_text(humanoids.mjcf())
    (tmp_path / "empty.trc").write_text("")
    broken_off = tmp_path / "out" / re.sub(r"\W", "_", str(tmp_path / "h.xml"))[-80:]
    broken_off.mkdir(parents=True)
    (broken_off / "robot.yaml").write_text("half")
    small = [tmp_path / "h.xml", tmp_path / "empty.trc", "--init-only"]
    found = rows(gauntlet, monkeypatch, *small, tmp_path / "out")
    assert found["h.xml"]["came_out"] == "proposed"
    assert found["empty.trc"]["why"].startswith("clamber: ")
    row = gauntlet.Row(file="climb")
    gauntlet.try_recording(Path("climb"), row, tmp_path / "out" / "climb", 100.0)
    assert row.came_out == "planned", row
    assert json.loads((tmp_path / "out" / "climb" / "plan" / "plan.json").read_text())
