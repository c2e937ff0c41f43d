"""A trajectory on the servos: what is done at every physics step, and nothing else."""

from __future__ import annotations

import numpy as np

from clamber import _core
from clamber.execution.balance import SMOOTHING
from clamber.execution.estimate import TOUCH, Estimate
from clamber.execution.events import Event
from clamber.execution.reference import Reference
from clamber.execution.sensors import Measurement
from clamber.execution.servo import joint_servo, self_positioning
from clamber.model.world import PHYSICS_STEP, World
from clamber.planning.records import Plan
from clamber.planning.trajectory import Trajectory

LOOK_STRIDE = 10  # physics steps between two looks at what is measured
PART = 10_000  # samples that are followed open loop, before the next ones are made


class OpenLoop:
    """The trajectory as it is, sample by sample.

    Attributes:
        core: What is done at every physics step.
    """

    def __init__(self, plan: Plan, world: World) -> None:
        """Follow `plan` on the servos of `world`."""
        assert plan.trajectory is not None
        t = plan.trajectory
        self._last = len(t.time) - 1
        self._ref = Reference(t, world)
        self._ref.follow(t, -1)
        filter_ = Estimate(plan.world, t.q[0]).filter
        held = self_positioning(world, "max")  # no ankle follows what is measured
        self.core = follower(world, filter_, self._ref, held)
        self.events: list[Event] = []
        self.followed: Trajectory | None = None
        final = plan.keyframes[-1].stance
        self.rests_on = tuple(f"{c.surface}@{c.support}" for c in final)

    def command(self, measured: Measurement) -> np.ndarray:
        """(na,) servo command of the next physics step."""
        return self.core.command(measured.q, measured.force, self)

    def decide(self, look: bool) -> None:
        """Go on with the next part of the trajectory, if it is time."""
        del look
        if self._ref.track.left == 0:
            end = min(self._ref.i + PART, self._last)
            self.core.ends = self._last - end < PART
            next(self._ref.play(self._last if self.core.ends else end))

    def balance(self) -> None:
        """Nothing is measured."""

    @property
    def reference(self) -> np.ndarray:
        """(nq,) of the last command."""
        return self._ref.q

    @property
    def left(self) -> int:
        """Physics steps to the end."""
        return self._last - self._ref.i


def follower(
    world: World, filter_: _core.Filter, ref: Reference, ankles: _core.SelfPositioning
) -> _core.Follower:
    """Follower of a reference by the joint servos of a world."""
    return _core.Follower(
        filter_,
        ref.track,
        joint_servo(world),
        ankles,
        qadr=world.qadr.tolist(),
        period=LOOK_STRIDE,
        touch=TOUCH * world.force_scale,
        shift_share=PHYSICS_STEP / SMOOTHING,
    )
