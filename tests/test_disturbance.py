"""What a disturbance may be, and that by default it is none."""

from __future__ import annotations

import math
from dataclasses import FrozenInstanceError, fields

import numpy as np
import pytest

from clamber.errors import InputError
from clamber.execution.disturbance import LIMITS, Disturbance
from clamber.execution.perturbed import perturbed_scene, push_of
from clamber.model.scene import Scene

NAMES = tuple(f.name for f in fields(Disturbance))
OF_THE_WORLD = {  # a value of each field that physics would notice
    "height": 0.01,
    "unevenness": 0.01,
    "roll": 0.01,
    "pitch": -0.01,
    "friction": 0.5,
    "x": 0.01,
    "y": -0.01,
    "yaw": 0.01,
    "mass": 1.1,
    "effort": 0.9,
}
OF_THE_RUN = {"delay": 0.0, "noise": 0.0, "push": 10.0, "seed": 5}
BOUNDS = [(n, i) for n in NAMES for i in (0, 1)]


def outside(name: str, side: int) -> float:
    """Just beyond one of a field's bounds."""
    return float(np.nextafter(LIMITS[name][side], (-math.inf, math.inf)[side]))


def test_every_field_has_its_limits():
    assert set(LIMITS) == set(NAMES)
    assert {*OF_THE_WORLD, *OF_THE_RUN} == set(NAMES)


@pytest.mark.parametrize(("name", "side"), BOUNDS)
def test_a_bound_itself_is_taken(name, side):
    value = LIMITS[name][side]
    assert getattr(Disturbance(**{name: value}), name) == value


@pytest.mark.parametrize(("name", "side"), BOUNDS)
def test_beyond_a_bound_the_error_names_field_value_and_range(name, side):
    value = outside(name, side)
    with pytest.raises(InputError) as caught:
        Disturbance(**{name: value})
    lo, hi = LIMITS[name]
    assert caught.value.field == f"disturb.{name}"
    assert caught.value.value == value
    kind = "a whole number" if name == "seed" else "a number"
    assert str(caught.value) == (
        f"disturb.{name} is {value!r}; expected {kind} from {lo:g} to {hi:g}"
    )


@pytest.mark.parametrize(
    ("name", "value"), [("mass", None), ("mass", "heavy"), ("seed", 1.5), ("yaw", [0])]
)
def test_what_is_no_such_number_is_refused(name, value):
    with pytest.raises(InputError, match=rf"disturb\.{name}\b.*number from"):
        Disturbance(**{name: value})


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_no_finite_number_is_refused(name, value):
    with pytest.raises(InputError, match=f"disturb.{name} is {value!r}"):
        Disturbance(**{name: value})


def test_the_first_of_two_mistakes_is_named():
    with pytest.raises(InputError, match=r"disturb\.height"):
        Disturbance(mass=0.0, height=2.0)


def test_there_are_sensible_signs():
    """Lengths and angles go both ways, factors and magnitudes are not negative."""
    both = {"height", "roll", "pitch", "x", "y", "yaw"}
    for name, (lo, hi) in LIMITS.items():
        assert lo < hi
        assert (lo == -hi) == (name in both)
        assert (lo >= 0) == (name not in both)


def test_by_default_nothing_differs():
    d = Disturbance()
    scene = Scene.from_height(0.275)
    same = perturbed_scene(scene, d)
    assert not d.changes_world
    assert push_of(d, 10.0) is None
    assert d.friction is None
    assert same.ground_friction == scene.ground_friction
    assert np.array_equal(same.start, scene.start)
    for a, b in zip(same.boxes, scene.boxes, strict=True):
        assert (a.name, a.friction, a.roughness) == (b.name, b.friction, b.roughness)
        assert np.array_equal(a.size, b.size)
        assert np.allclose(a.position, b.position, rtol=0, atol=1e-15)
        assert np.array_equal(a.rotation, b.rotation)


@pytest.mark.parametrize("name", OF_THE_WORLD)
def test_what_physics_would_notice_changes_the_world(name):
    assert Disturbance(**{name: OF_THE_WORLD[name]}).changes_world
    everything_else = {k: v for k, v in OF_THE_WORLD.items() if k != name}
    assert Disturbance(**everything_else, **OF_THE_RUN).changes_world


@pytest.mark.parametrize("name", OF_THE_RUN)
def test_what_only_the_run_notices_leaves_the_world_as_it_is(name):
    assert not Disturbance(**{name: OF_THE_RUN[name]}).changes_world


def test_all_that_only_the_run_notices_leaves_the_world_as_it_is():
    assert not Disturbance(**OF_THE_RUN).changes_world


def test_a_disturbance_is_a_value():
    a, b = (Disturbance(height=0.01, seed=3) for _ in range(2))
    assert a == b
    assert hash(a) == hash(b)
    assert a != Disturbance(height=0.01, seed=4)
    with pytest.raises(FrozenInstanceError):
        a.height = 0.0
