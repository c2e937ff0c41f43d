"""A trajectory, sample by sample, and the ways to leave it and to come back.

Each action is a generator that sets the reference and yields once for every physics
step that it takes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from clamber.model.kinematics import Kinematics
from clamber.model.world import PHYSICS_STEP, World
from clamber.planning.trajectory import Trajectory

BLEND = 0.3  # [s] back to a trajectory that was left

Ticks = Iterator[None]


class Reference:
    """What the joints shall do now, and what they were to do so far.

    Attributes:
        trajectory: That is followed.
        i: The sample of it that was reached.
        q: (nq,); velocity: (na,) of the joints; torque: (na,) fed forward.
        closed: (nS,) bool, contacts by surface.
        left_plan: Something else than the first trajectory was followed.
    """

    def __init__(self, trajectory: Trajectory, world: World) -> None:
        """Begin with the first sample."""
        self._kin, self._dadr = Kinematics(world), world.dadr
        self._rows: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]] = []
        self.left_plan = False
        self.follow(trajectory, 0)
        self.set(trajectory, 0)

    def follow(self, trajectory: Trajectory, i: int) -> None:
        """Go on from sample `i` of another trajectory."""
        self.trajectory, self.i = trajectory, i
        self._offset: tuple[np.ndarray, np.ndarray, int] | None = None

    def set(self, t: Trajectory, i: int) -> None:
        """Be at sample `i` of a trajectory."""
        self.q, self.torque = t.q[i], t.tau[i]
        self.velocity, self.closed = t.v[i][self._dadr], t.contact[i]

    def play(self, to: int, until: Callable[[], bool] | None = None) -> Ticks:
        """Follow the trajectory to sample `to`, or until something happens."""
        while self.i < to:
            if until is not None and until():
                return
            self.i += 1
            self.set(self.trajectory, self.i)
            self._blend()
            yield

    def back(self, to: int) -> Ticks:
        """Follow the trajectory back to sample `to`."""
        self.left_plan = True
        while self.i > to:
            self.i -= 1
            self.set(self.trajectory, self.i)
            self.velocity = -self.velocity
            yield

    def aside(self, t: Trajectory, until: Callable[[], bool]) -> Ticks:
        """Follow another trajectory until something happens, or there and back."""
        self.left_plan = True
        for i in range(len(t.time)):
            self.set(t, i)
            yield
            if until():
                self.stand()
                return
        for i in reversed(range(len(t.time))):
            self.set(t, i)
            self.velocity = -self.velocity
            yield

    def rest(self, seconds: float) -> Ticks:
        """Stand still."""
        self.left_plan = True
        self.stand()
        for _ in range(round(seconds / PHYSICS_STEP)):
            yield

    def stand(self) -> None:
        """Have no velocity from here on."""
        self.velocity = np.zeros(len(self._dadr))

    def resume(self) -> None:
        """Back to the trajectory that was left, little by little while it goes on."""
        t, i = self.trajectory, self.i
        self._offset = self._kin.difference(t.q[i], self.q), self.torque - t.tau[i], 0

    def _blend(self) -> None:
        """Add what is left of the way back."""
        if self._offset is None:
            return
        offset, torque, k = self._offset
        n = round(BLEND / PHYSICS_STEP)
        share = 0.5 + 0.5 * np.cos(np.pi * k / n)
        rate = -0.5 * np.pi / BLEND * np.sin(np.pi * k / n)
        self.q = self._kin.integrate(self.q, share * offset)
        self.torque = self.torque + share * torque
        self.velocity = self.velocity + rate * offset[self._dadr]
        self._offset = (offset, torque, k + 1) if k < n else None

    def closed_ahead(self, seconds: float) -> np.ndarray:
        """(nS,) bool, contacts so much later."""
        t = self.trajectory
        return t.contact[min(self.i + round(seconds / PHYSICS_STEP), len(t.time) - 1)]

    def record(self, q: np.ndarray) -> None:
        """Keep what was commanded: posture `q` (nq,), the rest as set."""
        v = np.zeros(self._kin.world.model.nv)
        v[self._dadr] = self.velocity
        self._rows.append((q, v, self.torque, self.closed))

    @property
    def seconds(self) -> float:
        """Time of the last command that was kept [s]."""
        return (len(self._rows) - 1) * PHYSICS_STEP

    def followed(self, keyframes: np.ndarray) -> Trajectory | None:
        """What was commanded, where that is not the first trajectory.

        Velocities are those of joints only.

        Args:
            keyframes: (K,) when keyframes were reached [s].
        """
        if not self.left_plan:
            return None
        q, v, tau, contact = (np.array(x) for x in zip(*self._rows, strict=True))
        return replace(
            self.trajectory,
            time=np.arange(len(q)) * PHYSICS_STEP,
            q=q,
            v=v,
            tau=tau,
            contact=contact,
            keyframes=keyframes,
            segments=(),
        )
