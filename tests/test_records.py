from __future__ import annotations

import enum
from dataclasses import dataclass, field

import numpy as np
import pytest

import clamber
from clamber.model.records import frozen_array, short_repr
from records import records_in


class Kind(enum.Enum):
    FIRST = "a sentence about it"


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Record:
    name: str = "knee"
    kind: Kind = Kind.FIRST
    place: np.ndarray = field(default_factory=lambda: np.array([0.1, 1 / 3, 2e-7]))
    many: np.ndarray = field(default_factory=lambda: np.zeros((7, 3)))
    parts: tuple = (object(),) * 9
    short: tuple = ("left", 2)
    hidden: int = field(default=1, repr=False)

    __repr__ = short_repr


def test_the_repr_of_a_record_shows_what_is_small_and_the_shape_of_what_is_not():
    assert repr(Record()) == (
        "Record(name='knee', kind=FIRST, place=[0.1, 0.3333, 2e-07],"
        " many=array(7, 3), parts=<9>, short=('left', 2))"
    )


def test_the_repr_of_every_record_of_the_model_is_short():
    scene = clamber.Scene.from_height(0.3)
    world = clamber.build_world(clamber.load_robot("coman"), scene)
    foot = world.surfaces["LFoot"]
    for record in (world, world.robot, world.scene, world.scene.ground, foot):
        assert len(repr(record)) < 300, record
        assert repr(record).startswith(type(record).__name__ + "(")
    near = clamber.Kinematics(world)
    near.update(world.home)
    assert len(repr(near.proximity(0.1))) < 300


def test_a_frozen_array_is_a_copy_that_nobody_writes_to():
    given = [[1, 2], [3, 4]]
    x = frozen_array(np.array(given), (-1, 2))
    with pytest.raises(ValueError, match="read-only"):
        x[0] = 0.0
    with pytest.raises(ValueError, match="shape"):
        frozen_array(given, (3,))


def test_the_repr_of_whatever_a_run_is_made_of_is_short(
    one_hand_plan, one_hand_rollout, demo_sequence
):
    demo = clamber.load_demo("climb")
    verdict = clamber.judge(one_hand_plan, one_hand_rollout)
    whole = (one_hand_plan, one_hand_rollout, verdict, demo_sequence, demo)
    long = {type(x).__name__: repr(x) for x in records_in(whole) if len(repr(x)) >= 300}
    assert not long
