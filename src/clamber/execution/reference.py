"""A trajectory, sample by sample, and the ways to leave it and to come back.

Each action is a generator. It says what the joints are to do in the steps to come, and
yields; it goes on once that is done, or earlier where something may have happened.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Generator
from dataclasses import replace

import numpy as np

from clamber import _core
from clamber.model.kinematics import Kinematics
from clamber.model.world import PHYSICS_STEP, World
from clamber.planning.samples import Samples
from clamber.planning.trajectory import Trajectory

BLEND = 0.3  # [s] back to a trajectory that was left
AHEAD = 1.0  # [s] before a foot steps, its ankle is held again

# What was commanded is written down, and commands are given, in multiples of a
# microradian or micrometre, of what single precision holds of a rotation, 0.03 mrad/s
# and a millinewtonmetre: finer than any encoder and motor, and a fraction in a file.
STEPS = {"q": 2.0**-20, "quaternion": 2.0**-23, "v": 2.0**-15, "tau": 2.0**-10}

Actions = Generator[None, None, None]


class Reference:
    """What the joints shall do now, and what they were to do so far.

    Attributes:
        trajectory: That is followed.
        track: The rows that are being followed.
        q: (nq,); velocity: (na,) of the joints; torque: (na,) fed forward; closed:
            (nS,) bool, contacts by surface. As of the last step, in place.
        left_plan: Something else than the first trajectory was followed.
    """

    def __init__(self, trajectory: Trajectory, world: World) -> None:
        """Begin with the first sample."""
        self._kin, self._dadr = Kinematics(world), world.dadr
        nq, surfaces = world.model.nq, len(world.surfaces)
        self.track = now = _core.Track(nq, len(self._dadr), surfaces)
        self.q, self.velocity = now.q, now.velocity
        self.torque, self.closed = now.torque, now.closed
        self._rows: list[tuple[np.ndarray, ...]] = []  # of the track, less q
        self._steps: list[int] = []  # that each of them was followed
        self.left_plan, self._way = False, 0
        self.follow(trajectory, 0)
        self._load(trajectory, slice(1))
        self.track.advance()
        self._rows.clear()

    @property
    def i(self) -> int:
        """The sample of the trajectory that was reached."""
        return self._begin + self._way * self.track.done

    def follow(self, trajectory: Trajectory, i: int) -> None:
        """Go on from sample `i` of another trajectory."""
        self.trajectory, self._begin, self._way = trajectory, i, 0
        self._offset: tuple[np.ndarray, np.ndarray, int] | None = None

    def play(self, to: int, until: Callable[[], bool] | None = None) -> Actions:
        """Follow the trajectory to sample `to`, or until something happens."""
        if self.i < to and not (until is not None and until()):
            self._load(self.trajectory, slice(self.i + 1, to + 1), way=1)
            yield
            while self.i < to and not (until is not None and until()):
                yield

    def back(self, to: int) -> Actions:
        """Follow the trajectory back to sample `to`."""
        self.left_plan = True
        if self.i > to:
            self._load(self.trajectory, slice(to, self.i), way=-1, back=True)
            yield from self._done()

    def aside(self, t: Trajectory, until: Callable[[], bool]) -> Actions:
        """Follow another trajectory until something happens, or there and back."""
        self.left_plan = True
        self._load(t, slice(None))
        for _ in self._done():
            yield
            if until():
                return
        self._load(t, slice(None), back=True)
        yield from self._done()

    def rest(self, seconds: float) -> Actions:
        """Stand still; the trajectory is left."""
        self.left_plan = True
        yield from self.hold(seconds)

    def hold(self, seconds: float) -> Actions:
        """Stand still."""
        steps, still = round(seconds / PHYSICS_STEP), np.zeros((1, len(self._dadr)))
        now = self.q, self.torque, self.closed
        q, torque, closed = (x[None].copy() for x in now)
        ahead = self._ahead(np.array([self.i]))
        self._begin_rows(q, still, torque, closed, ahead, way=0, steps=steps)
        yield from self._done()

    def resume(self) -> None:
        """Back to the trajectory that was left, little by little while it goes on."""
        t, i = self.trajectory, self.i
        offset = self._kin.difference(t.q[i], self.q)
        self._offset = offset, self.torque - t.tau[i], i + 1

    def followed(self, q: np.ndarray, keyframes: np.ndarray) -> Trajectory | None:
        """What was commanded, where that is not the first trajectory.

        Velocities are those of joints only.

        Args:
            q: (n, nq) postures as they were commanded.
            keyframes: (K,) when keyframes were reached [s].
        """
        if not self.left_plan:
            return None
        steps = [*self._steps, self.track.done]
        rows = [
            [np.resize(x, (n, x.shape[-1])) if len(x) < n else x[:n] for x in row]
            for row, n in zip(self._rows, steps, strict=True)
        ]
        velocity, tau, contact = (np.concatenate(x) for x in zip(*rows, strict=True))
        v = np.zeros((len(q), self._kin.world.model.nv))
        v[:, self._dadr] = velocity
        return in_steps(
            replace(
                self.trajectory,
                time=np.arange(len(q)) * PHYSICS_STEP,
                q=q,
                v=v,
                tau=tau,
                contact=contact,
                keyframes=keyframes,
                segments=(),
            )
        )

    def _load(
        self, t: Trajectory, rows: slice, *, way: int = 0, back: bool = False
    ) -> None:
        """Follow samples of a trajectory from the next step on.

        Args:
            t: The trajectory.
            rows: Its samples.
            way: By how much each takes the trajectory at hand on.
            back: The last of them first.
        """
        parts = t.q[rows], t.v[rows][:, self._dadr], t.tau[rows], t.contact[rows]
        if back:
            parts = parts[0], -parts[1], *parts[2:]
            parts = tuple(x[::-1] for x in parts)
        q, velocity, torque, closed = map(np.ascontiguousarray, parts)
        at = self.i + way * np.arange(1, len(q) + 1)
        if self._offset is not None and way == 1:
            q, torque = q.copy(), torque.copy()
            self._blend(at - self._offset[2], q, velocity, torque)
        rest = {"way": way, "steps": len(q)}
        self._begin_rows(q, velocity, torque, closed, self._ahead(at), **rest)

    def _begin_rows(
        self,
        q: np.ndarray,
        velocity: np.ndarray,
        torque: np.ndarray,
        closed: np.ndarray,
        ahead: np.ndarray,
        *,
        way: int,
        steps: int,
    ) -> None:
        self._begin, self._way = self.i, way
        if self._rows:
            self._steps.append(self.track.done)
        self.track.load(q, velocity, torque, closed, ahead, steps)
        self._rows.append((velocity, torque, closed))

    def _done(self) -> Actions:
        """Until what was begun is done."""
        while self.track.left:
            yield

    def _ahead(self, at: np.ndarray) -> np.ndarray:
        """(n, nS) bool, contacts a little later than at samples (n,)."""
        contact = self.trajectory.contact
        return contact[np.minimum(at + round(AHEAD / PHYSICS_STEP), len(contact) - 1)]

    def _blend(
        self, k: np.ndarray, q: np.ndarray, velocity: np.ndarray, torque: np.ndarray
    ) -> None:
        """Add what is left of the way back, `k` (n,) steps after its begin, to rows."""
        assert self._offset is not None
        offset, push, _ = self._offset
        n = round(BLEND / PHYSICS_STEP)
        k = k[k <= n]
        share = 0.5 + 0.5 * np.cos(np.pi * k / n)
        rate = -0.5 * np.pi / BLEND * np.sin(np.pi * k / n)
        for row, s in zip(q, share, strict=False):
            row[:] = self._kin.integrate(row, s * offset)
        torque[: len(k)] += share[:, None] * push
        velocity[: len(k)] += rate[:, None] * offset[self._dadr]


def in_steps(t: Trajectory) -> Trajectory:
    """The trajectory, in multiples of `STEPS`."""
    unit = np.full(np.shape(t.q)[1], STEPS["q"])
    unit[3:7] = STEPS["quaternion"]
    out = {}
    for name, step in {"q": unit, "v": STEPS["v"], "tau": STEPS["tau"]}.items():
        rounded = functools.partial(_multiples, step)
        x = getattr(t, name)
        out[name] = x.through(rounded) if isinstance(x, Samples) else rounded(x)
    return replace(t, **out)


def _multiples(step: np.ndarray | float, x: np.ndarray) -> np.ndarray:
    """The nearest multiples of steps that are powers of two."""
    out = x * (1.0 / step)
    np.rint(out, out=out)
    out *= step
    return out
