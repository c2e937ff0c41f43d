"""Records on disk: every one comes back, and a mistake is named by its field."""

from __future__ import annotations

import enum
import json
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import clamber
from clamber.contact.policy import GeneralPolicy
from clamber.contact.steps import Skipped
from clamber.errors import InputError, Status
from clamber.execution.events import EVENTS, Event
from clamber.execution.simulation import Rollout
from clamber.execution.verdict import Verdict, judge
from clamber.model.patches import mesh_of
from clamber.model.robot import Limb, Robot
from clamber.model.scene import HeightField, Support
from clamber.model.world import Surface, World
from clamber.planning.records import Fallback, Iteration, Plan, State, Tried
from clamber.planning.trajectory import Samples, Trajectory
from clamber.run.codec import (
    At,
    Codec,
    Form,
    parse,
    read_json,
    read_npz,
    whole_file,
    write_json,
    write_npz,
)
from clamber.run.forms import CODEC
from clamber.step.change import Failure
from records import differences, kinds_in, records_in, same

HERE = Path("made.json")
# In files of their own (`test_folder`), or below what is.
ELSEWHERE = {Plan, Rollout, Event, World, Surface, Support, Trajectory, Limb}
ROUNDED = ("boxes.0.rotation",)  # roll, pitch and yaw there
FOR_OTHERS = {"Stance.region", "Failure.stance", "Failure.reason"} | {
    f"{kind}.{name}" for kind in EVENTS for name in ("type", "text")
}


class Colour(enum.Enum):
    RED = "a warm one"
    BLUE = "a cold one"


@dataclass(frozen=True, eq=False, kw_only=True)
class Shape:
    name: str = ""


@dataclass(frozen=True, eq=False, kw_only=True)
class Round(Shape):
    radius: float


@dataclass(frozen=True, eq=False, kw_only=True)
class Square(Shape):
    side: float = 1.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Thing:
    """A field of every kind."""

    words: str
    count: int
    size: float
    good: bool
    colour: Colour
    speed: float | Literal["max"]
    place: np.ndarray
    flags: np.ndarray
    shape: Shape
    pair: tuple[int, str]
    many: tuple[Round, ...]
    lengths: Mapping[str, float]
    shapes: Mapping[Colour, Shape]
    margin: float = 0.0
    rows: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    inside: Thing | None = None
    note: str = ""
    bent: bool = False

    def __post_init__(self) -> None:
        if self.count < 0:
            raise ValueError("fewer than none")


SMALL = Codec(
    {
        Shape: Form(kinds=(Round, Square)),
        Thing: Form(
            names={"size": "width"}, null={"margin": -np.inf}, columns={"rows": 3}
        ),
    }
)

numbers = st.floats(allow_nan=False, allow_infinity=False)
shapes = st.builds(Round, radius=numbers) | st.builds(Square, side=numbers)
things = st.deferred(
    lambda: st.builds(
        Thing,
        words=st.text(),
        count=st.integers(0, 10**9),
        size=numbers,
        good=st.booleans(),
        colour=st.sampled_from(Colour),
        speed=numbers | st.just("max"),
        place=arrays(float, st.integers(1, 4), elements=numbers),
        flags=arrays(bool, (2, 3)),
        shape=shapes,
        pair=st.tuples(st.integers(), st.text()),
        many=st.lists(st.builds(Round, radius=numbers), max_size=3).map(tuple),
        lengths=st.dictionaries(st.text(), numbers, max_size=3),
        shapes=st.dictionaries(st.sampled_from(Colour), shapes),
        margin=numbers | st.just(-np.inf),
        rows=arrays(float, st.tuples(st.integers(0, 3), st.just(3)), elements=numbers),
        inside=st.none() | things,
        note=st.text(),
        bent=st.booleans(),
    )
)


def through_text(codec: Codec, x: Any, kind: Any) -> Any:
    text = json.dumps(codec.encode(x), allow_nan=False)
    return codec.decode(kind, At(parse(text, At(None, HERE)), HERE))


@given(things)
@pytest.mark.whole
def test_a_record_of_every_kind_of_field_survives_to_the_last_bit(thing: Thing):
    assert same(through_text(SMALL, thing, Thing), thing)


# All records of the package, as it makes them.


@pytest.fixture(scope="module")
def examples(one_hand_plan: Plan, one_hand_rollout: Rollout) -> dict[type, Any]:
    """One record of each type that goes to a JSON file."""
    plan = one_hand_plan
    demo = clamber.detect_contacts(clamber.load_demo("crossing"))
    policy = clamber.learn_policy([demo])
    found: dict[type, Any] = {}
    for x in (plan, demo, policy, judge(plan, one_hand_rollout), *rarer(plan)):
        for record in records_in(x):
            found.setdefault(type(record), record)
    return found


def rarer(plan: Plan) -> Iterator[Any]:
    """Records that a plan has which does not get there as demonstrated, or a run."""
    key = plan.keyframes[-1]
    yield State(done=1, stance=key.stance, loaded=key.stance[:1], q=key.q)
    yield Failure(status=Status.UNREACHABLE, step=plan.changes[0].step)
    tried = (Tried(proposer="search", steps=2, failed=1, last="out of reach"),)
    yield Fallback(reason="no way", source="search", surfaces=("LHand",), tried=tried)
    of = {float: 1 / 3, str: "LHand", bool: True, int: 3}
    for kind in EVENTS.values():
        hints = typing.get_type_hints(kind)
        yield kind(**{f.name: of[hints[f.name]] for f in fields(kind)})
    yield Skipped(stance=1, reason="out of reach")
    yield Iteration(option="ac1", cost=1 / 3)
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]) / 3
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    heights = np.arange(6).reshape(2, 3) / 3
    yield HeightField(
        heights=heights, size=np.ones(2) / 3, position=np.ones(2), yaw=1 / 3
    )
    yield mesh_of("rock", corners, faces, friction=1 / 3, notes=("turned round",))


def test_every_record_of_a_file_survives_it_to_the_last_bit(examples: dict[type, Any]):
    roots = Plan, GeneralPolicy, Verdict, Rollout, *EVENTS.values()
    written = set().union(*map(kinds_in, roots))
    for kind in sorted(written - ELSEWHERE, key=lambda k: k.__name__):
        x = examples[kind]  # a new record wants an example
        off = differences(x, through_text(CODEC, x, kind))
        assert not [at for at in off if not at.endswith(ROUNDED)], kind


def fault_of(kind: Any, content: Any) -> InputError | None:
    try:
        CODEC.decode(kind, At(content, HERE))
    except InputError as e:
        return e
    return None


def test_a_mistake_in_any_field_is_named_with_the_file(examples: dict[type, Any]):
    """Each field left out or, in its place, what no field is."""
    tried = 0
    for kind in examples.keys() - ELSEWHERE - {Robot}:
        whole = CODEC.encode(examples[kind])
        for name in whole:
            for wrong in (None, [[{"no": "field"}]]):
                broken = {k: v for k, v in whole.items() if k != name}
                if wrong is not None:
                    broken[name] = wrong
                fault = fault_of(kind, broken)
                if fault is None:  # for other readers alone, or as it is by default
                    where = f"{kind.__name__}.{name}"
                    known = (
                        wrong is None or name in ("type", "text") or where in FOR_OTHERS
                    )
                    assert known, where
                    continue
                assert fault.source == HERE, (kind, name)
                assert fault.field is not None, (kind, name)
                assert fault.field.split(".")[0] == name, (kind, name, str(fault))
                assert "\n" not in str(fault)
                tried += 1
    assert tried > 100


@pytest.mark.parametrize(
    ("change", "field", "value"),
    [
        ({"count": 1.5}, "count", 1.5),
        ({"count": True}, "count", True),
        ({"width": "wide"}, "width", "wide"),
        ({"colour": "GREEN"}, "colour", "GREEN"),
        ({"speed": "min"}, "speed", "min"),
        ({"place": [0.0, "a", 0.0]}, "place.1", "a"),
        ({"rows": [[1.0, 2.0, 3.0], [4.0]]}, "rows", None),
        ({"shape": {"type": "Star"}}, "shape.type", "Star"),
        ({"shape": {"radius": 1.0}}, "shape.type", None),
        ({"pair": [1]}, "pair", [1]),
        ({"many": {"radius": 1.0}}, "many", {"radius": 1.0}),
        ({"many": [{"type": "Round"}]}, "many.0.radius", None),
        ({"lengths": {"thigh": "long"}}, "lengths.thigh", "long"),
        ({"shapes": {"GREEN": {}}}, "shapes.GREEN", "GREEN"),
        ({"count": -1}, None, None),
    ],
)
def test_a_mistake_is_named_by_its_path(change: dict, field: str | None, value: Any):
    whole = {
        **{"words": "", "count": 0, "width": 1, "good": False, "colour": "RED"},
        **{"speed": 0.3, "place": [0, 1], "flags": [], "pair": [1, "a"], "many": []},
        **{"shape": {"type": "Square"}, "lengths": {}, "shapes": {}},
    }
    assert SMALL.decode(Thing, At(whole, HERE)).place.dtype == float
    with pytest.raises(InputError) as e:
        SMALL.decode(Thing, At(whole | change, HERE))
    assert (e.value.source, e.value.field, e.value.value) == (HERE, field, value)


# Files.


def test_an_interrupted_write_leaves_the_last_whole_file(tmp_path: Path):
    path = tmp_path / "a.json"
    path.write_text("whole")

    def interrupted() -> None:
        with whole_file(path) as draft:
            assert draft.suffix == path.suffix
            draft.write_text("ha")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert path.read_text() == "whole"
    assert list(tmp_path.iterdir()) == [path]
    with whole_file(path) as draft:
        draft.write_text("new")
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_a_json_file_reads_well_and_says_its_version(tmp_path: Path):
    path = tmp_path / "a.json"
    content = {"rows": [[1.5, None], []], "words": ["a", "b"], "none": {}}
    write_json(path, content)
    lines = path.read_text().splitlines()
    assert lines[1:4] == [' "version": 2,', ' "rows": [', "  [1.5, null],"]
    assert read_json(path, maker="").value == {"version": 2, **content}


@pytest.mark.parametrize(
    ("text", "field"),
    [
        ("{", None),
        ("[1]", None),
        ('{"version": 2, "x": NaN}', None),
        ("{}", "version"),
        ('{"version": 1}', "version"),
        (b"\xff\xfe", None),
        (None, None),
    ],
)
def test_a_file_that_cannot_be_read_says_what_makes_one(
    text: str | bytes | None, field: str | None, tmp_path: Path
):
    path = tmp_path / "a.json"
    if text is not None:
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(InputError) as e:
        read_json(path, maker="`clamber plan` writes it")
    assert (e.value.source, e.value.field) == (path, field)
    if text != "[1]":
        assert "`clamber plan` writes it" in str(e.value)


def test_what_is_no_npz_is_refused(tmp_path: Path):
    path = tmp_path / "a.npz"
    np.savez(path, x=np.arange(100.0))
    whole = path.read_bytes()
    for content in (b"", b"no zip", whole[: len(whole) // 2]):
        path.write_bytes(content)
        with pytest.raises(InputError, match="`clamber plan` writes it"):
            read_npz(path, maker="`clamber plan` writes it")
    with path.open("wb") as stream:
        np.save(stream, np.zeros(3))
    with pytest.raises(InputError, match="a whole"):
        read_npz(path, maker="")


def test_what_is_sampled_is_written_as_its_array(tmp_path: Path):
    rows = np.arange(14.0).reshape(7, 2)
    ends = np.array([3, 7])
    sampled = Samples(lambda i: [rows[[0, 3][i] : ends[i]]], 0, ends, 2)
    for name, x in (("a.npz", rows), ("b.npz", sampled)):
        write_npz(tmp_path / name, {"x": x})
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
