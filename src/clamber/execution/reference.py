"""A trajectory, sample by sample, and the ways to leave it and to come back.

Each action is a generator. It says what the joints are to do in the steps to come, and
yields; it goes on once that is done, or earlier where something may have happened.
"""

from __future__ import annotations

import functools
import math
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
RESTS = 1e-3  # [rad/s] a trajectory that is slower rests
RAMP = 0.15  # [s] to rest on the way, and from rest to the planned speed again
UNHURRIED = 0.3  # [s] of a trajectory: less of it is gone back more slowly
FULL = 0.99  # rate above which the trajectory is followed sample by sample
# [m/s^2] the centre of mass slows down on average for a pause, [s] in no more than this
BRAKING, LONGEST = 0.3, 1.2

# What was commanded is written down, and commands are given, in multiples of a
# microradian or micrometre, of what single precision holds of a rotation, 0.03 mrad/s
# and a millinewtonmetre: finer than any encoder and motor, and a fraction in a file.
STEPS = {"q": 2.0**-20, "quaternion": 2.0**-23, "v": 2.0**-15, "tau": 2.0**-10}

Actions = Generator[None, None, None]


class Reference:
    """Reference of the joints: now, and as commanded so far.

    Attributes:
        trajectory: That is followed.
        track: The rows that are being followed.
        q: (nq,); velocity: (na,) of the joints; torque: (na,) feed-forward; closed:
            (nS,) bool, contacts by surface. As of the last step, in place.
        left_plan: Something else than the first trajectory was followed.
        pause: [s] to stand still as soon as it can be, on the way; 0: go on.
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
        self.left_plan, self.pause = False, 0.0
        self.follow(trajectory, 0)
        self._load(trajectory, slice(1))
        self.track.advance()
        self._rows.clear()

    @property
    def i(self) -> int:
        """The sample of the trajectory that was reached."""
        return math.floor(self._place + 1e-9)

    @property
    def _place(self) -> float:
        """The same, between samples where it is followed more slowly."""
        done = self.track.done
        return float(self._at[done - 1]) if done and len(self._at) else self._begin

    @property
    def rate(self) -> float:
        """At which the trajectory is followed: 1 as planned, 0 where it is not."""
        done = self.track.done
        return float(self._rate[done - 1]) if 0 < done <= len(self._rate) else 0.0

    @property
    def moves(self) -> bool:
        """The trajectory is being followed, and does not rest where it is."""
        return self.rate > 0.0 and self._passes(self.i)

    def _passes(self, i: int) -> bool:
        """The trajectory does not rest at a sample."""
        return bool(np.abs(self.trajectory.v[i]).max() > RESTS)

    def follow(self, trajectory: Trajectory, i: int) -> None:
        """Go on, from rest, at sample `i` of another trajectory."""
        self.trajectory, self._begin = trajectory, i
        # Of each row, the sample of the trajectory, and how fast it is followed there.
        self._at, self._rate = np.zeros(0), np.zeros(0)
        self._offset: tuple[np.ndarray, np.ndarray, int] | None = None

    def play(self, to: int, until: Callable[[], bool] | None = None) -> Actions:
        """Follow the trajectory to sample `to`, or until something happens.

        From where the robot has slowed down on the way, at first more slowly.
        """
        i, rate = self.i, self.rate
        if i < to and not (until is not None and until()):
            if rate < FULL and i >= 0 and self._passes(i):
                self._load_at(to, up=rate)
            else:
                self._load(self.trajectory, slice(i + 1, to + 1), plays=True)
            yield
            while self.i < to and not (until is not None and until()):
                if self.pause > 0.0:
                    yield from self._stand(to)
                yield

    def stop(
        self, until: Callable[[], bool] | None = None, push: int | None = None
    ) -> Actions:
        """Slow down along the trajectory, to rest before a limb leaves.

        Args:
            until: Something happens: then it can go on without having stopped.
            push: Sample whose feed-forward torques are used; None: its own at each.
        """
        if not self.moves or (until is not None and until()):
            return
        i, t = self.i, self.trajectory
        leaves = (x.begin for x in t.segments if x.kind == "swing" and x.begin > i)
        by = min(next(leaves, len(t.time)) - 1, i + round(0.5 * RAMP / PHYSICS_STEP))
        self.left_plan = True
        if by > i:
            self._load_at(by, down=True, push=push)
            for _ in self._done():
                yield
                if until is not None and until():
                    return
        self._rate = np.zeros(0)

    def _stand(self, to: int) -> Actions:
        """Pause, if the way to sample `to` is long enough to slow down on it."""
        i = self.i
        self._kin.update(self.trajectory.q[i])
        speed = np.linalg.norm(self._kin.com_jacobian() @ self.trajectory.v[i])
        ramp = float(np.clip(self.rate * speed / BRAKING, RAMP, LONGEST))
        by = i + round(0.5 * self.rate * ramp / PHYSICS_STEP)
        if by >= to:
            return
        self.left_plan = True
        seconds, self.pause = self.pause, 0.0
        if by > i and self.moves:
            self._load_at(by, down=True, ramp=ramp)
            yield from self._done()
        yield from self.hold(seconds)
        self._load_at(to, up=0.0)

    def back(self, to: int) -> Actions:
        """Come to rest, and follow the trajectory back to rest at sample `to`.

        Fed forward are the torques of `to`: contacts made after it may be missing.
        """
        yield from self.stop()
        self.left_plan = True
        if self.i > to:
            # To turn round at once would throw the robot over its toes.
            pace = min(1.0, max((self.i - to) * PHYSICS_STEP / UNHURRIED, 0.25))
            self._load_at(to, up=0.0, down=True, pace=pace, push=to)
            yield from self._done()
            self._rate = np.zeros(0)

    def aside(
        self, t: Trajectory, until: Callable[[], bool], unless: Callable[[], bool]
    ) -> Actions:
        """Follow another trajectory until something happens, or there and back.

        Back at once where something else does.
        """
        self.left_plan = True
        self._load(t, slice(None))
        for _ in self._done():
            yield
            if until():
                return
            if unless():
                break
        self._load(t, slice(self.track.done), back=True)
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
        ahead, none = self._ahead(np.array([self.i])), np.zeros(0)
        self._begin_rows(q, still, torque, closed, ahead, none, none, steps)
        yield from self._done()

    def resume(self) -> None:
        """Back to the trajectory that was left, little by little while it goes on."""
        t, i = self.trajectory, self.i
        offset = self._kin.difference(t.q[i], self.q)
        self._offset = offset, self.torque - t.tau[i], i + 1

    def followed(self, q: np.ndarray, keyframes: np.ndarray) -> Trajectory | None:
        """Trajectory as commanded, if it is not the first one.

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
        self, t: Trajectory, rows: slice, *, plays: bool = False, back: bool = False
    ) -> None:
        """Follow samples of a trajectory from the next step on.

        Args:
            t: The trajectory.
            rows: Its samples.
            plays: It is the one at hand, which goes on with them.
            back: The last of them first.
        """
        parts = t.q[rows], t.v[rows][:, self._dadr], t.tau[rows], t.contact[rows]
        if back:
            parts = parts[0], -parts[1], *parts[2:]
            parts = tuple(x[::-1] for x in parts)
        q, velocity, torque, closed = map(np.ascontiguousarray, parts)
        at = np.arange(rows.start, rows.stop) if plays else np.zeros(0)
        if plays and self._offset is not None:
            q, torque, velocity = q.copy(), torque.copy(), velocity.copy()
            self._blend(at, np.ones(len(at)), q, velocity, torque)
        ahead = self._ahead(at if plays else np.full(len(q), self.i))
        rate = np.ones(len(at))
        self._begin_rows(q, velocity, torque, closed, ahead, at, rate, len(q))

    def _load_at(
        self,
        to: int,
        *,
        up: float | None = None,
        down: bool = False,
        ramp: float = RAMP,
        pace: float = 1.0,
        push: int | None = None,
    ) -> None:
        """Follow the trajectory at hand to a sample, slower at the ends of the way.

        Args:
            to: The sample.
            up: From this rate.
            down: To rest.
            ramp: Between rest and the planned speed [s].
            pace: Share of that at most.
            push: Sample whose feed-forward torques are used throughout; None: its own.
        """
        i = self._place
        way = 1 if to > i else -1
        done, rate = ramped(abs(to - i) / pace, up=up, down=down, ramp=ramp)
        done, rate = pace * done, pace * rate
        done[-1] = abs(to - i)
        at = i + way * done
        t, low = self.trajectory, np.floor(at).astype(int)
        first, share = low.min(), (at - low)[:, None]
        rows = slice(first, min(low.max() + 2, len(t.time)))
        low, high = low - first, np.minimum(low + 1, len(t.time) - 1) - first

        def between(x: np.ndarray) -> np.ndarray:
            return x[low] + share * (x[high] - x[low])

        q, v, torque = (between(x[rows]) for x in (t.q, t.v, t.tau))
        if push is not None:
            torque = np.tile(t.tau[push], (len(torque), 1))
        velocity = way * rate[:, None] * v[:, self._dadr]
        closed = t.contact[rows][low]
        if self._offset is not None and way == 1:
            self._blend(at, rate, q, velocity, torque)
        ahead = self._ahead(low + first)
        self._begin_rows(q, velocity, torque, closed, ahead, at, rate, len(q))

    def _begin_rows(
        self,
        q: np.ndarray,
        velocity: np.ndarray,
        torque: np.ndarray,
        closed: np.ndarray,
        ahead: np.ndarray,
        at: np.ndarray,
        rate: np.ndarray,
        steps: int,
    ) -> None:
        self._begin, self._at = self._place, at
        self._rate = rate
        if self._rows:
            self._steps.append(self.track.done)
        self.track.load(q, velocity, torque, closed, ahead, steps)
        self._rows.append((velocity, torque, closed))

    def _done(self) -> Actions:
        """Until what was begun is done."""
        while self.track.left:
            yield

    def _ahead(self, at: np.ndarray) -> np.ndarray:
        """(n, nS) bool, contacts that lie flat a little later than at samples (n,)."""
        t = self.trajectory
        later = np.minimum(at + round(AHEAD / PHYSICS_STEP), len(t.contact) - 1)
        out = t.contact[later]
        for x in t.segments:  # on tiptoe nothing but its ankle holds a foot
            if x.edges and x.begin <= later[-1] and later[0] < x.end:
                rows = (x.begin <= later) & (later < x.end)
                for s in x.edges:
                    out[rows, t.surfaces.index(s)] = False
        return out

    def _blend(
        self,
        at: np.ndarray,
        rate: np.ndarray,
        q: np.ndarray,
        velocity: np.ndarray,
        torque: np.ndarray,
    ) -> None:
        """Add what is left of the way back to rows at samples (n,), at rates (n,)."""
        assert self._offset is not None
        offset, push, begin = self._offset
        n = round(BLEND / PHYSICS_STEP)
        k = at[at <= begin + n] - begin
        share = 0.5 + 0.5 * np.cos(np.pi * k / n)
        rate = -0.5 * np.pi / BLEND * np.sin(np.pi * k / n) * rate[: len(k)]
        for row, s in zip(q, share, strict=False):
            row[:] = self._kin.integrate(row, s * offset)
        torque[: len(k)] += share[:, None] * push
        velocity[: len(k)] += rate[:, None] * offset[self._dadr]


def ramped(
    distance: float, *, up: float | None = None, down: bool = False, ramp: float = RAMP
) -> tuple[np.ndarray, np.ndarray]:
    """Samples of the way done (n,) at each step, and the rate (n,) in [0, 1].

    Args:
        distance: The way in samples, which take a step each at the planned speed.
        up: From this rate.
        down: To rest.
        ramp: Between rest and the planned speed [s].
    """
    ramps = (up is not None) + down
    n = min(round(ramp / PHYSICS_STEP), int(2 * distance) // max(ramps, 1)) // 2 * 2
    rise = 0.5 - 0.5 * np.cos(np.pi * (np.arange(n) + 0.5) / max(n, 1))
    first = rise[:0] if up is None else rise[rise > up]
    last = rise[::-1] if down else rise[:0]
    plain = distance - float(np.sum(first) + np.sum(last))
    rate = np.concatenate([first, np.ones(max(math.ceil(plain), 0)), last])
    rate *= min(distance / np.sum(rate), 1.0 / rate.max())
    done = np.cumsum(rate)
    done[-1] = distance
    return done, rate


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
