"""rows -> small tables and a picture: success against each factor, with intervals.

Shares are of bins and carry Wilson intervals; a search is also fitted by a logistic
curve, whose half point is where it breaks.
"""

from __future__ import annotations

import csv
import itertools
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from clamber.model.arguments import checks_types
from clamber.run.codec import whole_file
from clamber.run.figures import finish_axes, save_plot
from clamber.study.climb import ClimbResult
from clamber.study.spec import Spec, Strand, strands
from clamber.study.statistics import Break, fit_break, wilson
from clamber.study.sweep import CRASHED, Rows

SUMMARY = "summary.csv"
CURVE = "curve.csv"
PICTURE = "success.png"
BIN_RUNS = 6  # at least, in a bin that holds more than one value
MAX_BINS = 8
Cases = list[tuple[Any, ClimbResult]]  # values of a factor, and what became of it
COLOURS = {"pid": "#b91c1c", "mixed": "#1d4ed8"}
MARKERS = {"pid": "s", "mixed": "o"}
UNITS = {
    "height": "m",
    "speed": "rad/s",
    "disturb.height": "m",
    "disturb.unevenness": "m",
    "disturb.roll": "rad",
    "disturb.pitch": "rad",
    "disturb.x": "m",
    "disturb.y": "m",
    "disturb.yaw": "rad",
    "disturb.delay": "s",
    "disturb.push": "N",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Summary:
    """One strand in one row.

    Attributes:
        controller: Of all its runs.
        factor: That was searched; empty elsewhere.
        start: The easy end; None elsewhere.
        end: The hard end; None elsewhere.
        runs: How many.
        reached: How many of them succeeded.
        share: reached / runs.
        low: Of the share's 95 % Wilson interval.
        high: Likewise.
        half: Where success falls through 50 %, in words where that is out of the range.
        half_from: Of its 95 % interval, at the easy side; None: not within the range.
        half_to: Likewise at the hard side.
        errors: Runs that crashed; they count as not reached.
    """

    controller: str
    factor: str
    start: float | None
    end: float | None
    runs: int
    reached: int
    share: float
    low: float
    high: float
    half: float | str
    half_from: float | None
    half_to: float | None
    errors: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Bin:
    """Runs whose values of a factor are neighbours."""

    controller: str
    factor: str
    first: float | str
    last: float | str
    middle: float | str
    runs: int
    reached: int
    share: float
    low: float
    high: float


def summarise(spec: Spec, rows: Rows) -> list[Summary]:
    """A row for each strand, in the order of the spec."""
    return [_summary(spec, s, _of(rows, s)) for s in strands(spec)]


def bins(spec: Spec, rows: Rows) -> list[Bin]:
    """Shares of each factor's bins, by controller and, of a search, by end.

    Up to eight values are a bin each; more are put together, neighbours in equal
    numbers, six or more. Of a search that is its factor alone, without the flags that
    follow from it.
    """
    names = spec.factors if spec.search is None else [spec.search.factor]
    out = []
    for s in strands(spec):
        for name in names:
            found = [
                (run.factors[name], outcome)
                for run, outcome in _of(rows, s)
                if name in run.factors
            ]
            out += [_bin(s.controller, name, part) for part in _parts(found)]
    return out


def fit_strand(spec: Spec, strand: Strand, rows: Rows) -> Break | None:
    """The logistic curve of a search's strand, over u; None where all ended alike."""
    mine = _of(rows, strand)
    share = np.array([run.share for run, _ in mine], dtype=float)
    return fit_break(share, [outcome.reached for _, outcome in mine])


@checks_types
def save_curves(spec: Spec, rows: Rows, folder: str | Path) -> list[Path]:
    """Write `summary.csv`, `curve.csv` and `success.png`.

    Args:
        spec: The sweep's spec.
        rows: Its finished runs.
        folder: An existing folder.
    """
    folder = Path(folder)
    tables = {SUMMARY: summarise(spec, rows), CURVE: bins(spec, rows)}
    for name, records in tables.items():
        kind = Summary if name == SUMMARY else Bin
        with whole_file(folder / name) as draft, draft.open("w", newline="") as f:
            writer = csv.writer(f, lineterminator="\n")
            writer.writerow([x.name for x in fields(kind)])
            writer.writerows([_cell(x) for x in asdict(r).values()] for r in records)
    picture = draw_success(spec, rows, folder / PICTURE)
    return [*(folder / name for name in tables), picture]


def draw_success(spec: Spec, rows: Rows, path: Path) -> Path:
    """Success against each factor: bins with intervals, of a search its curve too."""
    names = spec.factors if spec.search is None else [spec.search.factor]
    across = max(1, min(len(names), 3))  # seeds alone differ: an empty picture
    down = max(1, -(-len(names) // across))
    size = (6.4 if across == 1 else 3.6 * across, 3.4 * down + 0.6)
    fig = Figure(figsize=size, layout="constrained")
    axes = fig.subplots(down, across, squeeze=False, sharey=True).ravel().tolist()
    every = bins(spec, rows)
    for ax, name in zip(axes, names, strict=False):
        for c in spec.controllers:
            mine = [b for b in every if (b.controller, b.factor) == (c, name)]
            _draw_bins(ax, c, mine)
        if spec.search is not None:
            for s in strands(spec):
                _draw_fit(ax, spec, s, fit_strand(spec, s, rows))
                _draw_runs(ax, name, s, _of(rows, s))
            if spec.search.scale == "log":
                ax.set_xscale("log")
        unit = UNITS.get(name, "")
        if spec.search is not None and spec.search.unit:
            unit = spec.search.unit
        ax.set_xlabel(f"{name} [{unit}]" if unit else name)
        ax.set_ylim(-0.06, 1.06)
        finish_axes(ax)
        ax.legend(fontsize=8, frameon=False, loc="best")
    for ax in axes[len(names) :]:
        ax.set_visible(False)
    for ax in axes[::across]:
        ax.set_ylabel("success")
    said = "bars: 95 % (Wilson)" + ("; curve: logistic fit" if spec.search else "")
    fig.suptitle(f"{spec.about or 'Success'} ({said})", fontsize=9, wrap=True)
    return save_plot(fig, path)


def _of(rows: Rows, strand: Strand) -> Rows:
    return [(r, o) for r, o in rows if r.strand == strand]


def _summary(spec: Spec, strand: Strand, rows: Rows) -> Summary:
    n, k = len(rows), sum(o.reached for _, o in rows)
    low, high = wilson(k, n)
    search, end = spec.search, strand.end
    half: float | str = ""
    half_from = half_to = None
    if search is not None and end is not None and n:
        fit = fit_strand(spec, strand, rows)
        beyond, before = f"beyond {end:g}", f"before {search.from_:g}"

        def level(u: float | None) -> float | None:
            return None if u is None else search.level(u, end)

        if fit is None:
            half = beyond if k else before
        else:
            within = level(fit.half)
            half = within if within is not None else before
            if within is None and fit.centre > 1:
                half = beyond
            half_from, half_to = level(fit.low), level(fit.high)
    return Summary(
        controller=strand.controller,
        factor="" if search is None else search.factor,
        start=None if search is None else search.from_,
        end=end,
        runs=n,
        reached=k,
        share=k / n if n else 0.0,
        low=low,
        high=high,
        half=half,
        half_from=half_from,
        half_to=half_to,
        errors=sum(o.why.startswith(CRASHED) for _, o in rows),
    )


def _parts(found: Cases) -> list[Cases]:
    """Neighbouring values together."""
    if any(isinstance(v, str) for v, _ in found):
        found = [(str(v), o) for v, o in found]
    ordered = sorted(found, key=lambda x: x[0])
    values = sorted({v for v, _ in found})
    if len(values) <= MAX_BINS or isinstance(values[0], str):
        return [[x for x in ordered if x[0] == v] for v in values]
    number = max(min(MAX_BINS, len(ordered) // BIN_RUNS), 1)
    edges = np.linspace(0, len(ordered), number + 1).astype(int).tolist()
    return [ordered[a:b] for a, b in itertools.pairwise(edges)]


def _bin(controller: str, factor: str, part: Cases) -> Bin:
    n, k = len(part), sum(o.reached for _, o in part)
    low, high = wilson(k, n)
    values = [v for v, _ in part]
    # The mean of equal numbers can differ from them in the last bit.
    middle = values[0] if values[0] == values[-1] else float(np.mean(values))
    return Bin(
        controller=controller,
        factor=factor,
        first=values[0],
        last=values[-1],
        middle=middle,
        runs=n,
        reached=k,
        share=k / n,
        low=low,
        high=high,
    )


def _cell(x: Any) -> Any:
    return f"{x:.4g}" if isinstance(x, float) else x


def _draw_bins(ax: Axes, controller: str, mine: Sequence[Bin]) -> None:
    """Points with vertical intervals, and the bins' widths as horizontal bars."""
    x = [b.middle for b in mine]
    share = np.array([b.share for b in mine])
    ends = np.array([[b.share - b.low, b.high - b.share] for b in mine]).reshape(-1, 2)
    wide = None
    if not any(isinstance(v, str) for v in x):
        edges = np.array([[b.first, b.middle, b.last] for b in mine], dtype=float)
        wide = np.diff(edges.reshape(-1, 3), axis=1).T
    ax.errorbar(
        x,
        share,
        yerr=np.maximum(ends.T, 0.0),
        xerr=wide,
        fmt=MARKERS[controller],
        ms=6,
        mfc="none",
        lw=1,
        capsize=2,
        color=COLOURS[controller],
        label=f"{controller} ({sum(b.runs for b in mine)} runs)",
    )


def _draw_fit(ax: Axes, spec: Spec, strand: Strand, fit: Break | None) -> None:
    """The logistic curve, and the interval of its half point as a bar at one half."""
    search, end = spec.search, strand.end
    if fit is None or search is None or end is None:
        return
    colour, u = COLOURS[strand.controller], np.linspace(0.0, 1.0, 201)
    ax.plot([search.level(x, end) for x in u], fit.success(u), color=colour, lw=1.2)
    low = 0.0 if fit.low is None else fit.low
    high = 1.0 if fit.high is None else fit.high
    ends = [search.level(low, end), search.level(high, end)]
    ax.plot(ends, [0.5, 0.5], color=colour, lw=5, alpha=0.3, solid_capstyle="butt")


def _draw_runs(ax: Axes, name: str, strand: Strand, rows: Rows) -> None:
    """A tick for each run: above where it succeeded, below where it failed."""
    colour = COLOURS[strand.controller]
    x = [run.factors[name] for run, _ in rows]
    y = [1.04 if outcome.reached else -0.04 for _, outcome in rows]
    ax.plot(x, y, "|", ms=5, mew=0.8, color=colour, alpha=0.7)
