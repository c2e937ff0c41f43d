"""Robots by name: built in, proposed in the current folder, or in a wheel."""

from __future__ import annotations

from pathlib import Path

import pytest

import clamber
from clamber import cli
from clamber.errors import InputError
from clamber.model.wheels import MODELS, how_to_get, model_of
from humanoids import mjcf


def install(folder: Path, wheel: str, file: str, text: str) -> Path:
    """A distribution with one file, as pip leaves it."""
    info = folder / f"{wheel.replace('-', '_')}-1.0.dist-info"
    info.mkdir(parents=True, exist_ok=True)
    (info / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {wheel}\nVersion: 1\n"
    )
    path = folder / file
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder on the path, none of whose wheels is installed yet."""
    monkeypatch.chdir(tmp_path)
    for name in MODELS:
        if model_of(name) is not None:
            pytest.skip("a wheel with robots is installed")
    monkeypatch.syspath_prepend(tmp_path / "site")
    return tmp_path / "site"


def test_a_robot_of_a_wheel_is_proposed_by_its_name_and_then_found(
    site: Path, capsys: pytest.CaptureFixture[str]
):
    with pytest.raises(InputError) as caught:
        clamber.propose_robot("g1")
    assert "pip install" in str(caught.value)
    made = install(site, *MODELS["g1"][0], mjcf())
    assert model_of("g1") == (made, None)
    assert how_to_get("g1") == "`clamber robot init g1`"
    with pytest.raises(InputError) as caught:
        clamber.load_robot("g1")
    assert how_to_get("g1") in caught.value.expected
    assert cli.main(["robot", "init", "g1", "--quiet"]) == 0
    robot = clamber.load_robot("g1")
    assert robot.name == "g1"
    assert robot.path.parent == Path("robots") / "g1"
    assert cli.main(["robot", "check", "g1", "--json"]) == 0


def test_the_start_page_offers_a_robot_of_a_wheel_and_makes_it_once(site: Path):
    start = pytest.importorskip("clamber.show.start")
    assert "icub" not in start.known_robots().values()
    install(site, *MODELS["icub"][0], mjcf())
    assert start.known_robots()["icub (from a package)"] == "icub"
    start.make_of_wheel("icub")
    made = clamber.load_robot("icub")
    start.make_of_wheel("icub")  # it is there
    start.make_of_wheel("coman")  # and no wheel's
    assert Path(start.known_robots()["robots/icub"]).parent == made.path.parent
    assert "icub (from a package)" not in start.known_robots()


def test_effort_limits_come_from_the_wheel_that_has_them(site: Path):
    first, second = MODELS["g1"]
    install(site, *first, mjcf(effort=False))
    assert clamber.propose_robot("g1").guessed
    with_limits = install(site, *second, mjcf())
    model, limits = model_of("g1") or (None, None)
    assert limits == with_limits
    assert model != limits
    assert not clamber.propose_robot("g1").guessed


def test_a_robot_that_nobody_knows_is_told_those_that_there_are(site: Path):
    with pytest.raises(InputError) as caught:
        clamber.load_robot("talso")
    for name in ("coman", *MODELS):
        assert name in caught.value.expected
    assert "did you mean talos" in caught.value.expected
