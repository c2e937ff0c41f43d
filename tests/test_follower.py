"""What is done at every physics step, and when something is to be decided."""

from __future__ import annotations

import numpy as np
import pytest

from clamber import _core
from clamber.execution.balance import SMOOTHING
from clamber.execution.estimate import TOUCH, Estimate
from clamber.execution.executive import Executive
from clamber.execution.open_loop import LOOK_STRIDE, OpenLoop
from clamber.execution.sensors import Measurement
from clamber.execution.servo import joint_servo
from clamber.model.world import PHYSICS_STEP


class Watched(Executive):
    """Notes at which steps it decides."""

    def __init__(self, plan):
        super().__init__(plan, plan.world)
        self.decided, self.looked, self.balanced = [], [], []

    def decide(self, look):
        self.decided.append(self.core.steps)
        self.looked += [self.core.steps] if look else []
        super().decide(look)

    def balance(self):
        self.balanced.append(self.core.steps)
        super().balance()


@pytest.fixture
def executive(hands_plan) -> Watched:
    return Watched(hands_plan)


def stand(executive, steps: int, hand: float = 0.0) -> list[np.ndarray]:
    """Commands while it is where it should be, a hand loaded with so much [N]."""
    surfaces = list(executive.estimate.surfaces)
    force = np.zeros((len(surfaces), 3))
    weight = 9.81 * executive.estimate.world.mass
    force[[surfaces.index("LFoot"), surfaces.index("RFoot")], 2] = weight / 2
    force[surfaces.index("LHand"), 2] = hand
    now = executive.reference
    return [executive.command(Measurement(now.copy(), force)) for _ in range(steps)]


def test_between_two_looks_nothing_is_decided(executive):
    stand(executive, 200)
    assert executive.looked == [*range(0, 200, LOOK_STRIDE)]
    assert executive.decided == executive.looked
    assert executive.balanced == [*range(LOOK_STRIDE, 201, LOOK_STRIDE)]


def test_a_touch_that_is_expected_is_noticed_at_the_very_step(executive, hands_plan):
    c = hands_plan.changes[0].step.makes
    assert c.surface == "LHand"
    stand(executive, 101)
    executive.decided.clear()
    stand(executive, 20, hand=10.0 * TOUCH)
    assert executive.decided == [110, 120]  # nobody expects it
    executive.estimate.expect(c)
    stand(executive, 5, hand=10.0 * TOUCH)
    assert executive.decided[2:] == [121, 122, 123, 124, 125]
    executive.estimate.expect()
    stand(executive, 4, hand=10.0 * TOUCH)
    assert executive.decided[7:] == []


def test_what_the_balance_asks_for_is_eased_in_on_top_of_the_reference(hands_plan):
    """By a low pass; the reference itself stays what it is."""
    follower, other = (OpenLoop(hands_plan, hands_plan.world) for _ in range(2))
    w = hands_plan.world
    still = Measurement(hands_plan.trajectory.q[0], np.zeros((len(w.surfaces), 3)))
    follower.core.goal[:] = 0.01
    n = round(SMOOTHING / PHYSICS_STEP)
    for k in range(1, 5 * n):
        more = follower.command(still) - other.command(still)
        expected = 0.01 * (1.0 - (1.0 - 1.0 / n) ** k)
        stiff = w.ki == 0.0
        assert np.allclose(more[stiff], expected)
        assert np.array_equal(follower.reference, other.reference)
    posture = follower.core.commanded - other.core.commanded
    assert np.allclose(posture[-1, w.qadr], expected)
    assert not posture[:, :7].any()


def test_torques_are_scaled_and_nothing_else(hands_plan):
    follower, other = (OpenLoop(hands_plan, hands_plan.world) for _ in range(2))
    w, t = hands_plan.world, hands_plan.trajectory
    still = Measurement(t.q[0], np.zeros((len(w.surfaces), 3)))
    follower.core.scale = 1.1
    more = w.kp * (follower.command(still) - other.command(still))
    assert np.allclose(more, 0.1 * t.tau[0], atol=1e-9)


def test_measurements_of_another_robot_are_refused(executive):
    force = np.zeros((len(executive.estimate.surfaces), 3))
    with pytest.raises(ValueError, match="measurement"):
        executive.command(Measurement(np.zeros(5), force))
    with pytest.raises(ValueError, match="measurement"):
        executive.command(Measurement(executive.reference, force[:2]))


def test_rows_that_do_not_fit_are_refused(hands_plan):
    w = hands_plan.world
    na, ns = len(w.joints), len(w.surfaces)
    track = _core.Track(w.model.nq, na, ns)
    flags = np.zeros((3, ns), dtype=bool)
    with pytest.raises(ValueError, match="row"):
        track.load(
            np.zeros((3, w.model.nq)),
            np.zeros((2, na)),
            np.zeros((3, na)),
            flags,
            flags,
            3,
        )
    assert not track.advance()
    servo = joint_servo(w)
    with pytest.raises(ValueError, match="joint"):
        servo.command(*(np.zeros(na - 1) for _ in range(5)))
    estimate = Estimate(w, w.home)
    with pytest.raises(ValueError, match="surfaces"):
        estimate.filter.watch([ns], np.zeros((1, 3)), TOUCH)
