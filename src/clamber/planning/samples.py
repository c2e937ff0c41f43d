"""A path in time -> samples of it, 1 kHz, made when they are asked for.

A `Run` is one phase: a spline through its postures, and a velocity profile along it
that accelerates, cruises and brakes. What it is made from is small, and is what is
written down of a planned trajectory; its samples are not kept.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from clamber import _core

RATE = 1000.0  # [Hz]
ACCELERATION = 4.0  # [1/s] the cruise speed is reached after a quarter of a second
MIN_PHASE = 0.2  # [s]

Sampling = Callable[[int], Sequence[np.ndarray]]


class Samples:
    """(T, n) rows that are sampled when they are asked for, block after block.

    Indexed as an array is, by rows and then by columns; `np.asarray` gives all of it.
    The last block is kept, so that neighbouring rows cost no more than those of an
    array: a reference of 1000 samples a second takes no memory.
    """

    def __init__(
        self,
        sample: Sampling,
        which: int,
        ends: np.ndarray,
        n: int,
        runs: tuple[Run, ...] = (),
    ) -> None:
        """Rows of one of the arrays (m, n) that `sample` gives for each block.

        Args:
            sample: By the number of the block; called again where it was left.
            which: Of its arrays.
            ends: (B,) the row at which each block ends.
            n: Columns.
            runs: That are sampled.
        """
        self.runs = runs
        self.shape = int(ends[-1]), n
        self._sample, self._which, self._ends = sample, which, ends
        # From which row on, and the rows: one value, for who reads in several threads.
        self._held = 0, np.zeros((0, n))

    def __len__(self) -> int:
        """T."""
        return self.shape[0]

    def __getitem__(self, key: Any) -> np.ndarray:
        """Rows, and columns of them where there are two indices."""
        rows, *columns = key if isinstance(key, tuple) else (key,)
        if isinstance(rows, (int, np.integer)):
            k = range(len(self))[rows]
            start, block = self._around(k)
            return block[(k - start, *columns)]
        if isinstance(rows, slice) and rows.step in (None, 1):
            return self._stretch(*rows.indices(len(self))[:2])[(slice(None), *columns)]
        index = np.arange(len(self))[rows]
        out = np.empty((index.size, self.shape[1]))
        number = np.searchsorted(self._ends, index.ravel(), side="right")
        for i in np.unique(number):
            mine = number == i
            start, block = self._look(i)
            out[mine] = block[index.ravel()[mine] - start]
        all_ = slice(None), np.arange(index.size).reshape(index.shape)
        return out[(all_[not isinstance(rows, slice)], *columns)]

    def __iter__(self) -> Iterator[np.ndarray]:
        """Row after row."""
        for block in self.blocks():
            yield from block

    def __array__(
        self, dtype: np.dtype | None = None, copy: bool | None = None
    ) -> np.ndarray:
        """All rows."""
        return np.concatenate(list(self.blocks())).astype(dtype, copy=False)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled as the array of all rows."""
        return np.asarray, (np.asarray(self),)

    def through(self, change: Callable[[np.ndarray], np.ndarray]) -> Samples:
        """The rows (m, n) of each block as a function changes them."""

        def sample(i: int) -> tuple[np.ndarray]:
            return (change(self._look(i)[1]),)

        return Samples(sample, 0, self._ends, self.shape[1])

    def blocks(self) -> Iterator[np.ndarray]:
        """(m, n) the rows of one block after the other."""
        for i in range(len(self._ends)):
            yield self._look(i)[1]

    def _stretch(self, begin: int, end: int) -> np.ndarray:
        """Rows `begin` to `end`, without the latter: of one block as they are."""
        out = []
        while begin < end:
            start, block = self._around(begin)
            out.append(block[begin - start : end - start])
            begin = start + len(block)
        return (
            out[0]
            if len(out) == 1
            else np.concatenate([np.zeros((0, self.shape[1])), *out])
        )

    def _around(self, k: int) -> tuple[int, np.ndarray]:
        """The block with row `k`, and its first row."""
        start, block = self._held
        if start <= k < start + len(block):
            return start, block
        return self._look(np.searchsorted(self._ends, k, side="right"))

    def _look(self, i: int | np.integer) -> tuple[int, np.ndarray]:
        block = self._sample(int(i))[self._which]
        self._held = int(self._ends[i]) - len(block), block
        return self._held


@dataclass(frozen=True, eq=False, slots=True)
class Spline:
    """One phase as a function of its path parameter.

    Attributes:
        curve: Of the raw coordinates.
        postures: (n, nq) that it goes through.
        nodes: (n,) of the path parameter.
        held: (n, na) torques there [N m].
        cruise: ds/dt at which the fastest joint has the speed limit.
    """

    curve: CubicSpline
    postures: np.ndarray
    nodes: np.ndarray
    held: np.ndarray
    cruise: float

    @property
    def length(self) -> float:
        """Path parameter at the end."""
        return float(self.nodes[-1])

    def tau(self, s: np.ndarray) -> np.ndarray:
        """(T, na) torques, in equal steps between two nodes."""
        return _core.between_rows(self.held, self.nodes, np.ascontiguousarray(s))

    def along(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(T, nq) postures, and (T, nv) their derivatives by the path parameter."""
        return _core.along_spline(self.curve.c, self.nodes, np.ascontiguousarray(s))


def spline_through(
    s: np.ndarray, postures: np.ndarray, held: np.ndarray, cruise: float
) -> Spline:
    """The spline through postures (n, nq) at path parameters (n,); see `Spline`."""
    ends = "natural" if len(s) > 2 else "not-a-knot"
    return Spline(CubicSpline(s, postures, bc_type=ends), postures, s, held, cruise)


def profile_samples(length: float, cruise: float) -> int:
    """How many samples a `profile` has."""
    ramp = 1.5 / ACCELERATION
    cruise = min(cruise, length / ramp)
    return int(np.ceil(max(length / cruise + ramp, MIN_PHASE, 2 * ramp) * RATE))


@functools.lru_cache(maxsize=2)  # a run's motion and its torques ask for the same
def profile(length: float, cruise: float, stride: int = 1) -> np.ndarray:
    """(2, n) s and ds/dt at 1 kHz: smooth rise to the cruise speed, smooth fall.

    The rise is a raised cosine, so that acceleration has no jumps.
    """
    n, ramp = profile_samples(length, cruise), 1.5 / ACCELERATION
    total = n / RATE  # a whole number of samples, else ds/dt is not the derivative
    t = np.arange(1, n + 1, stride) / RATE

    def rise(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x = np.clip(x, 0.0, ramp)
        return (
            0.5 * (x - ramp / np.pi * np.sin(np.pi * x / ramp)),
            0.5 * (1 - np.cos(np.pi * x / ramp)),
        )

    up, up_rate = rise(t)
    down, down_rate = rise(total - t)
    plateau = max(total - 2 * ramp, 0.0)
    s = np.where(
        t <= ramp,
        up,
        np.where(t <= ramp + plateau, 0.5 * ramp + (t - ramp), ramp + plateau - down),
    )
    rate = np.where(t <= ramp, up_rate, np.where(t <= ramp + plateau, 1.0, down_rate))
    scale = length / (ramp + plateau)
    out = np.stack([s * scale, rate * scale])
    out.setflags(write=False)
    return out


@dataclass(frozen=True, eq=False, slots=True)
class Run:
    """One phase in time, with samples of rest before and after it.

    How far along the path it is and how fast, (2, n), and the torques (n, na) are kept
    where they are not those of the profile and of the spline.
    """

    spline: Spline
    n: int
    timing: np.ndarray | None
    tau: np.ndarray | None
    lead: int
    rest: int

    @property
    def samples(self) -> int:
        """How many, rest included."""
        return self.lead + self.n + self.rest

    def motion(self) -> tuple[np.ndarray, np.ndarray]:
        """Configurations and velocities, rest included."""
        s, rate = self._timed()
        q, v = self.spline.along(s)
        first, _ = self.spline.along(np.zeros(1))
        v *= rate[:, None]
        still = np.zeros((1, v.shape[1]))
        return self._with_rest(first, q, q[-1:]), self._with_rest(still, v, still)

    def torques(self) -> np.ndarray:
        """Feed-forward torques, rest included."""
        tau = self.spline.tau(self._timed()[0]) if self.tau is None else self.tau
        return self._with_rest(self.spline.tau(np.zeros(1)), tau, tau[-1:])

    def _timed(self) -> np.ndarray:
        """(2, n) s and ds/dt."""
        if self.timing is not None:
            return self.timing
        return profile(self.spline.length, self.spline.cruise)

    def _with_rest(
        self, first: np.ndarray, rows: np.ndarray, last: np.ndarray
    ) -> np.ndarray:
        """Rows, and those of rest, (1, k) each, before and after them."""
        out = np.empty((self.samples, rows.shape[1]))
        out[: self.lead] = first
        out[self.lead : self.lead + self.n] = rows
        out[self.lead + self.n :] = last
        out.setflags(write=False)
        return out


def sampled(runs: Sequence[Run]) -> dict[str, Samples]:
    """`q`, `v` and `tau` of a trajectory, which are sampled when they are asked for."""
    runs, stops = tuple(runs), np.cumsum([x.samples for x in runs])

    @functools.lru_cache(maxsize=1)
    def moving(i: int) -> tuple[np.ndarray, np.ndarray]:
        return runs[i].motion()

    @functools.lru_cache(maxsize=1)
    def pushing(i: int) -> tuple[np.ndarray]:
        return (runs[i].torques(),)

    postures, torques = runs[0].spline.postures, runs[0].spline.held
    return {
        "q": Samples(moving, 0, stops, postures.shape[1], runs),
        "v": Samples(moving, 1, stops, postures.shape[1] - 1, runs),
        "tau": Samples(pushing, 0, stops, torques.shape[1], runs),
    }


def runs_as_arrays(
    *samples: Samples | np.ndarray,
) -> dict[str, np.ndarray] | None:
    """What q, v and tau of a planned trajectory are sampled from; None of others.

    Of R runs: `run_sizes` (R, 4) of each its nodes, the samples of its own timing, and
    those of rest before and after it; `run_cruise` (R,) ds/dt at the largest speed. Of
    all their N nodes: `node_s` (N,), `node_qpos` (N, nq), `node_tau` (N, na). Of the M
    samples of their own timing: `timed_s` (M, 2) s and ds/dt, `timed_tau` (M, na).
    """
    runs = getattr(samples[0], "runs", ())
    if not runs or any(getattr(x, "runs", ()) is not runs for x in samples):
        return None
    splines, na = [x.spline for x in runs], runs[0].spline.held.shape[1]
    timing, tau = [np.zeros((0, 2))], [np.zeros((0, na))]
    for x in runs:
        if x.timing is not None and x.tau is not None:
            timing.append(x.timing.T)
            tau.append(x.tau)
    sizes = [
        (len(x.spline.nodes), x.n if x.timing is not None else 0, x.lead, x.rest)
        for x in runs
    ]
    return {
        "run_sizes": np.array(sizes),
        "run_cruise": np.array([x.cruise for x in splines]),
        "node_s": np.concatenate([x.nodes for x in splines]),
        "node_qpos": np.concatenate([x.postures for x in splines]),
        "node_tau": np.concatenate([x.held for x in splines]),
        "timed_s": np.concatenate(timing),
        "timed_tau": np.concatenate(tau),
    }


def runs_of_arrays(arrays: Mapping[str, np.ndarray]) -> tuple[Run, ...]:
    """The runs that `runs_as_arrays` took apart."""
    sizes, out, node, row = arrays["run_sizes"].astype(int), [], 0, 0
    for (nodes, samples, lead, rest), cruise in zip(
        sizes.tolist(), arrays["run_cruise"].tolist(), strict=True
    ):
        mine = slice(node, node + nodes)
        s, q, torques = arrays["node_s"], arrays["node_qpos"], arrays["node_tau"]
        spline = spline_through(s[mine], q[mine], torques[mine], cruise)
        timing = tau = None
        n = samples
        if samples:
            timing = np.ascontiguousarray(arrays["timed_s"][row : row + samples].T)
            tau = arrays["timed_tau"][row : row + samples]
        else:
            n = profile_samples(spline.length, cruise)
        out.append(Run(spline, n, timing, tau, lead, rest))
        node, row = node + nodes, row + samples
    return tuple(out)
