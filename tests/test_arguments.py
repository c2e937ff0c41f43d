"""What public functions say of themselves, and of what they cannot take."""

from __future__ import annotations

import dataclasses
import inspect
import re
from types import FunctionType

import pytest

import clamber
from clamber.errors import InputError, WrongType
from clamber.model.arguments import checks_types
from clamber.model.scene import Scene

PUBLIC = {n: getattr(clamber, n) for n in clamber._HOME}
FUNCTIONS = {n: f for n, f in PUBLIC.items() if isinstance(f, FunctionType)}
RECORDS = {n: c for n, c in PUBLIC.items() if dataclasses.is_dataclass(c)}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_public_function_names_an_argument_of_another_kind(name: str):
    parameters = inspect.signature(FUNCTIONS[name]).parameters.values()
    needed = [p.name for p in parameters if p.default is p.empty]
    needed = needed or [next(iter(parameters)).name]
    with pytest.raises(WrongType) as caught:
        FUNCTIONS[name](**{n: object() for n in needed})
    assert caught.value.field == needed[0]
    assert f"{name}()" in str(caught.value)
    assert isinstance(caught.value, TypeError)
    assert isinstance(caught.value, InputError)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_help_describes_every_argument(name: str):
    text = inspect.getdoc(FUNCTIONS[name]) or ""
    told = text.partition("Args:\n")[2]
    for p in inspect.signature(FUNCTIONS[name]).parameters:
        assert re.search(rf"^    {p}: \S", told, flags=re.MULTILINE), p


@pytest.mark.parametrize("name", RECORDS)
def test_help_describes_every_field(name: str):
    told = (inspect.getdoc(RECORDS[name]) or "").partition("Attributes:\n")[2]
    for f in dataclasses.fields(RECORDS[name]):
        if not f.name.startswith("_"):
            assert re.search(rf"\b{f.name}(, \w+)*: \S", told), f.name


@checks_types
def _takes(
    scene: Scene | None = None, many: list[int] | None = None, share: float = 0.5
) -> None:
    del scene, many, share


def test_what_fits_is_let_through_and_what_is_not_looked_at_too(box: Scene):
    _takes(box, share=1)
    _takes(None, many="anything")  # type: ignore[arg-type]
    for wrong in ({"scene": 0.3}, {"share": "0.5"}, {"share": True}):
        with pytest.raises(WrongType) as caught:
            _takes(**wrong)  # type: ignore[arg-type]
        assert caught.value.field == next(iter(wrong))
    with pytest.raises(TypeError, match="unexpected keyword"):
        _takes(scenes=box)  # type: ignore[call-arg]


@pytest.fixture
def box() -> Scene:
    return Scene.from_height(0.3)


def test_what_would_make_the_one_of_the_other_is_said(demo_sequence, box: Scene):
    demo = clamber.load_demo("climb")
    for given, maker in (("take.json", "load_sequence"), (demo, "detect_contacts")):
        with pytest.raises(WrongType, match=rf"{maker}\(\.\.\.\)"):
            clamber.plan(given, "coman", box)
    with pytest.raises(WrongType, match=r"\bplan\(\.\.\.\)"):
        clamber.simulate(demo_sequence)
    with pytest.raises(WrongType) as caught:
        clamber.plan(demo_sequence, "coman", box, budget=10)  # type: ignore[arg-type]
    assert caught.value.field == "budget"
    with pytest.raises(WrongType) as caught:
        clamber.learn_policy([demo_sequence, "take.json"])  # type: ignore[list-item]
    assert caught.value.field == "sequences"


def test_a_choice_that_there_is_not_is_refused_by_its_name(tmp_path):
    with pytest.raises(InputError) as caught:
        clamber.export_run(tmp_path, to="bvh")  # type: ignore[arg-type]
    assert (caught.value.field, caught.value.value) == ("to", "bvh")
    assert "csv" in caught.value.expected


def test_a_name_does_for_a_robot_and_a_height_or_file_for_a_scene(tmp_path, box):
    world = clamber.build_world("coman", 0.3)
    assert world.robot.name == "coman"
    assert world.scene.boxes[0].size[2] == pytest.approx(0.3)
    file = tmp_path / "scene.yaml"
    file.write_text("boxes:\n- {name: step, size: [1, 1, 0.2], position: [0.8, 0]}\n")
    assert [b.name for b in clamber.build_world(world.robot, file).scene.boxes] == [
        "step"
    ]
    assert clamber.load_scene(box) is box
    assert clamber.load_robot(world.robot) is world.robot
    assert clamber.check_robot("coman").joints == len(world.joints)
    assert not clamber.check_scene(0.3)
    with pytest.raises(InputError) as caught:
        clamber.build_world("coman", -0.3)
    assert caught.value.field == "height"


def test_a_plan_takes_names_and_heights(demo_sequence, demo_plan):
    found = clamber.plan(demo_sequence, "coman", 0.275)
    assert [str(c.step) for c in found.changes] == [
        str(c.step) for c in demo_plan.changes
    ]
    assert (found.trajectory.q[-1] == demo_plan.trajectory.q[-1]).all()
