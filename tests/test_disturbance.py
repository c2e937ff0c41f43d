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

OF_THE_WORLD = {  # a value of each field that physics would notice
    **{"height": 0.01, "unevenness": 0.01, "roll": 0.01, "pitch": -0.01},
    **{"friction": 0.5, "x": 0.01, "y": -0.01, "yaw": 0.01},
    **{"mass": 1.1, "effort": 0.9},
}
OF_THE_RUN = {"delay": 0.0, "noise": 0.0, "push": 10.0, "seed": 5}


@pytest.mark.parametrize("name", [f.name for f in fields(Disturbance)])
def test_a_value_is_within_its_bounds_or_refused_by_its_name(name):
    lo, hi = LIMITS[name]
    for bound in (lo, hi):
        assert getattr(Disturbance(**{name: bound}), name) == bound
    # Lengths and angles go both ways, factors and magnitudes are not negative.
    assert (lo == -hi) == (name in {"height", "roll", "pitch", "x", "y", "yaw"})
    beyond = [float(np.nextafter(lo, -math.inf)), float(np.nextafter(hi, math.inf))]
    for value in (*beyond, math.nan, math.inf, "heavy", [0]):
        with pytest.raises(InputError) as caught:
            Disturbance(**{name: value})
        assert caught.value.field == f"disturb.{name}"
        assert caught.value.value is value


def test_the_error_says_the_range_and_that_a_seed_is_whole():
    with pytest.raises(InputError, match=r"disturb\.mass.* a number from 0\.1 to 10"):
        Disturbance(mass=None)
    with pytest.raises(InputError, match="a whole number from"):
        Disturbance(seed=1.5)


def test_by_default_nothing_differs():
    d, scene = Disturbance(), Scene.from_height(0.275)
    same = perturbed_scene(scene, d)
    assert push_of(d, 10.0) is None
    assert same.ground_friction == scene.ground_friction
    assert np.array_equal(same.start, scene.start)
    for a, b in zip(same.boxes, scene.boxes, strict=True):
        assert (a.name, a.friction, a.roughness) == (b.name, b.friction, b.roughness)
        assert np.array_equal(a.size, b.size)
        assert np.allclose(a.centre, b.centre, rtol=0, atol=1e-15)
        assert np.array_equal(a.rotation, b.rotation)


def test_the_world_changes_by_what_physics_would_notice_and_by_that_alone():
    assert {*OF_THE_WORLD, *OF_THE_RUN} == {f.name for f in fields(Disturbance)}
    assert not Disturbance(**OF_THE_RUN).changes_world
    for name, value in OF_THE_WORLD.items():
        assert Disturbance(**{name: value}, **OF_THE_RUN).changes_world


def test_a_disturbance_is_a_value():
    a, b = (Disturbance(height=0.01, seed=3) for _ in range(2))
    assert a == b
    assert hash(a) == hash(b)
    assert a != Disturbance(height=0.01, seed=4)
    with pytest.raises(FrozenInstanceError):
        a.height = 0.0
