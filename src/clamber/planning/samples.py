"""A path in time -> samples of it, 1 kHz, made when they are asked for.

A `Run` is one phase: a spline through its postures, and how far along it the robot is
at each millisecond. What it is made from is small, and is what is written down of a
planned trajectory; its samples are not kept.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from clamber import _core
from clamber.model import cubics

RATE = 1000.0  # [Hz]

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
    """One phase as a function of its path parameter, from 0 on.

    Attributes:
        coefficients: (4, n - 1, nq) of the raw coordinates between two nodes each, from
            the third power down.
        postures: (n, nq) that it goes through.
        nodes: (n,) of the path parameter.
        ends: (2, nq) its derivatives at the first and the last of them.
        grid: (g,) of the path parameter.
        tau: (g, na) feed-forward torques there [N m].
    """

    coefficients: np.ndarray
    postures: np.ndarray
    nodes: np.ndarray
    ends: np.ndarray
    grid: np.ndarray
    tau: np.ndarray

    @property
    def length(self) -> float:
        """Path parameter at the end."""
        return float(self.nodes[-1])

    def torques(self, s: np.ndarray) -> np.ndarray:
        """(T, na), linear between two points of the grid."""
        return _core.between_rows(self.tau, self.grid, np.ascontiguousarray(s))

    def along(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Along the path parameter, T places of it.

        Returns:
            (T, nq) postures, (T, nv) their derivatives by the path parameter as tangent
            vectors, and (T, nv) the derivatives of those.
        """
        return _core.along_spline(
            self.coefficients, self.nodes, np.ascontiguousarray(s)
        )


def spline_through(
    s: np.ndarray,
    postures: np.ndarray,
    ends: np.ndarray,
    grid: np.ndarray,
    tau: np.ndarray,
) -> Spline:
    """The spline through postures (n, nq) at path parameters (n,); see `Spline`."""
    slopes = _core.smooth_slopes(s, postures, ends)
    c = cubics.pieces(s, postures, slopes)
    return Spline(c, postures, s, ends, grid, tau)


@dataclass(frozen=True, eq=False, slots=True)
class Run:
    """One phase in time, with samples of rest before and after it.

    Attributes:
        spline: The path.
        timing: (2, n) how far along it, and how fast.
        lead, rest: Samples before and after.
    """

    spline: Spline
    timing: np.ndarray
    lead: int
    rest: int

    @property
    def samples(self) -> int:
        """Number of samples, those at rest included."""
        return self.lead + self.timing.shape[1] + self.rest

    def motion(self) -> tuple[np.ndarray, np.ndarray]:
        """Configurations and velocities, rest included."""
        s, rate = self.timing
        q, v, _ = self.spline.along(s)
        first, *_ = self.spline.along(np.zeros(1))
        v *= rate[:, None]
        still = np.zeros((1, v.shape[1]))
        return self._with_rest(first, q, q[-1:]), self._with_rest(still, v, still)

    def torques(self) -> np.ndarray:
        """Feed-forward torques, rest included."""
        tau = self.spline.torques(self.timing[0])
        return self._with_rest(self.spline.torques(np.zeros(1)), tau, tau[-1:])

    def _with_rest(
        self, first: np.ndarray, rows: np.ndarray, last: np.ndarray
    ) -> np.ndarray:
        """Rows, and those of rest, (1, k) each, before and after them."""
        out = np.empty((self.samples, rows.shape[1]))
        out[: self.lead] = first
        out[self.lead : self.lead + len(rows)] = rows
        out[self.lead + len(rows) :] = last
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

    postures, torques = runs[0].spline.postures, runs[0].spline.tau
    return {
        "q": Samples(moving, 0, stops, postures.shape[1], runs),
        "v": Samples(moving, 1, stops, postures.shape[1] - 1, runs),
        "tau": Samples(pushing, 0, stops, torques.shape[1], runs),
    }


def runs_as_arrays(
    *samples: Samples | np.ndarray,
) -> dict[str, np.ndarray] | None:
    """What q, v and tau of a planned trajectory are sampled from; None of others.

    Of R runs: `run_sizes` (R, 5) of each its nodes, the points of its grid, its samples
    and those of rest before and after it; `run_ends` (R, 2, nq) derivatives of the
    path. Of all their N nodes: `node_s` (N,), `node_qpos` (N, nq). Of all points of
    grids, G: `grid_s` (G,), `grid_tau` (G, na). Of all M samples: `timed_s` (M, 2) s
    and ds/dt.
    """
    runs = getattr(samples[0], "runs", ())
    if not runs or any(getattr(x, "runs", ()) is not runs for x in samples):
        return None
    splines = [x.spline for x in runs]
    sizes = [
        (len(x.spline.nodes), len(x.spline.grid), x.timing.shape[1], x.lead, x.rest)
        for x in runs
    ]
    return {
        "run_sizes": np.array(sizes),
        "run_ends": np.stack([x.ends for x in splines]),
        "node_s": np.concatenate([x.nodes for x in splines]),
        "node_qpos": np.concatenate([x.postures for x in splines]),
        "grid_s": np.concatenate([x.grid for x in splines]),
        "grid_tau": np.concatenate([x.tau for x in splines]),
        "timed_s": np.concatenate([x.timing.T for x in runs]),
    }


def runs_of_arrays(arrays: Mapping[str, np.ndarray]) -> tuple[Run, ...]:
    """The runs that `runs_as_arrays` took apart."""
    sizes = arrays["run_sizes"].astype(int)
    stops = np.cumsum(sizes[:, :3], axis=0)
    out = []
    for (*_, lead, rest), stop, start, ends in zip(
        sizes.tolist(), stops, stops - sizes[:, :3], arrays["run_ends"], strict=True
    ):
        node, point, row = (slice(a, b) for a, b in zip(start, stop, strict=True))
        spline = spline_through(
            arrays["node_s"][node],
            arrays["node_qpos"][node],
            ends,
            arrays["grid_s"][point],
            arrays["grid_tau"][point],
        )
        timing = np.ascontiguousarray(arrays["timed_s"][row].T)
        out.append(Run(spline, timing, lead, rest))
    return tuple(out)
