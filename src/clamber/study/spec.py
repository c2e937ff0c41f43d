"""A spec, as a person writes it, and the runs that follow from it.

Runs come in strands: one for each controller and, of a search, for each end that it
goes to. The next runs of a strand follow from the spec and from the outcomes of its
earlier ones alone, so that neither the number of workers nor an interruption changes
what is run.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pydantic

from clamber.errors import InputError, input_error, read_yaml
from clamber.execution.servo import ControlMode
from clamber.model.arguments import checks_types
from clamber.study.climb import FLAGS, Climb, ClimbResult, climb_of

SEED = "disturb.seed"
PATHS = ("demo", "robot", "scene")  # flags that may name a file
COARSE = 8  # runs of a search, one at each of so many levels, before it looks closer
ROUND = 4  # runs of a search that are chosen at once
LAG = 4  # runs that may still be under way when the next are chosen
MIN_ZONE = 0.1  # of the range: a search looks no closer, so that a curve can be drawn
DIGITS = 6  # of the values that are drawn or searched


def _number(x: Any) -> Any:
    """Degrees, where it says so, in radians."""
    if isinstance(x, str) and x.removesuffix("deg") != x:
        try:
            return math.radians(float(x.removesuffix("deg")))
        except ValueError:
            pass
    return x


Number = Annotated[
    float, pydantic.BeforeValidator(_number), pydantic.Field(allow_inf_nan=False)
]
Value = Annotated[
    int | float | str, pydantic.BeforeValidator(_number)
]  # a value of a flag
Flag = Annotated[str, pydantic.Field(pattern=r"^[a-z.]+$")]


class _Strict(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(
        extra="forbid", frozen=True, populate_by_name=True
    )


class Range(_Strict):
    """So many values, evenly from one to the other, both included."""

    from_: Number = pydantic.Field(alias="from")
    to: Number
    steps: int = pydantic.Field(ge=2)

    def values(self) -> list[float]:
        """In order."""
        return [_short(x) for x in np.linspace(self.from_, self.to, self.steps)]


class Uniform(_Strict):
    """Anything between two numbers."""

    uniform: tuple[Number, Number]


class PlusMinus(_Strict):
    """Anything up to so much above and below the middle."""

    plus_minus: Annotated[Number, pydantic.Field(ge=0)]
    about: Number = 0.0


def _way(x: Any) -> str:
    """The intended form of a distribution, for error messages."""
    if isinstance(x, PlusMinus) or (isinstance(x, Mapping) and "plus_minus" in x):
        return "plus_minus"
    if isinstance(x, Uniform | Mapping):
        return "uniform"
    return "list" if isinstance(x, list) else "value"


Levels = Annotated[
    Annotated[list[Value], pydantic.Tag("list")]
    | Annotated[Range, pydantic.Tag("range")],
    pydantic.Discriminator(lambda x: "list" if isinstance(x, list) else "range"),
]
Distribution = Annotated[
    Annotated[Uniform, pydantic.Tag("uniform")]
    | Annotated[PlusMinus, pydantic.Tag("plus_minus")]
    | Annotated[list[Value], pydantic.Tag("list")]
    | Annotated[Value, pydantic.Tag("value")],
    pydantic.Discriminator(_way),
]


class Sample(_Strict):
    """Independent random values; of `either`, one alternative a run."""

    runs: int = pydantic.Field(ge=1)
    factors: dict[Flag, Distribution] = {}
    either: list[dict[Flag, Distribution]] = []

    def draw(self, rng: np.random.Generator) -> dict[str, Any]:
        """One value for each flag."""
        drawn = dict(self.factors)
        if self.either:
            drawn |= self.either[int(rng.integers(len(self.either)))]
        return {k: _draw(d, rng) for k, d in drawn.items()}


class Follows(_Strict):
    """Flags that a level sets: scale times the level, in this or a random direction.

    A random direction of one flag is a sign, of two a direction in their plane.
    """

    flags: list[Flag] = pydantic.Field(min_length=1)
    scale: Number = 1.0
    direction: Literal["plus", "random"] = "plus"

    def values(self, level: float, rng: np.random.Generator) -> dict[str, float]:
        """The flags at a level."""
        along = np.ones(len(self.flags))
        if self.direction == "random":
            along = rng.normal(size=len(self.flags))
            along /= np.linalg.norm(along)
        return {
            k: _short(self.scale * level * float(x))
            for k, x in zip(self.flags, along, strict=True)
        }


class Search(_Strict):
    """One factor, from where it is easy to where it is hard, in one or more directions.

    Attributes:
        factor: A flag, or any name where `sets` says which flags follow from it.
        unit: Of the factor, for plots.
        from_: The easy end.
        to: The hard end or ends; each is searched by itself.
        scale: How levels are spread.
        step: Levels are multiples of this; 0: anything.
        runs: For each controller and end.
        sets: Flags that follow from the level; none: the factor itself is the flag.
    """

    factor: str = pydantic.Field(pattern=r"^[a-z.]+$")
    unit: str = ""
    from_: Number = pydantic.Field(alias="from")
    to: Number | list[Number]
    scale: Literal["linear", "log"] = "linear"
    step: float = pydantic.Field(default=0.0, ge=0)
    runs: int = pydantic.Field(ge=COARSE)
    sets: list[Follows] = []

    @property
    def ends(self) -> list[float]:
        """All hard ends."""
        return self.to if isinstance(self.to, list) else [self.to]

    @pydantic.model_validator(mode="after")
    def _searchable(self) -> Search:
        if not self.ends or len({*self.ends, self.from_}) != len(self.ends) + 1:
            raise ValueError("expected ends that differ from the start and each other")
        if self.scale == "log" and min(self.from_, *self.ends) <= 0:
            raise ValueError("expected positive ends for a log scale")
        return self

    def level(self, u: float, end: float) -> float:
        """The value at u on the way to an end, which is u = 1."""
        if self.scale == "log":
            return self.from_ * (end / self.from_) ** u
        return self.from_ + u * (end - self.from_)

    def rounded(self, level: float) -> float:
        """The level, rounded to a multiple of `step`."""
        if self.step:
            level = round(level / self.step) * self.step
        return _short(level)

    def share(self, level: float, end: float) -> float:
        """The u of a level: `level` turned round."""
        if self.scale == "log":
            return math.log(level / self.from_) / math.log(end / self.from_)
        return (level - self.from_) / (end - self.from_)


class Spec(_Strict):
    """The spec of a sweep: exactly one of `grid`, `random` and `search`.

    Attributes:
        version: Version of the format.
        about: The question that it answers, in a sentence.
        seed: Run k of each series has `--disturb.seed seed + k`.
        controllers: Controllers that are compared; each does all runs.
        base: Flags that all runs share.
        grid: Levels of each flag; every combination is run.
        random: A random sample of flags.
        search: A factor; the level at which success falls through one half is sought.
    """

    version: Literal[1] = 1
    about: str = ""
    seed: int = pydantic.Field(default=0, ge=0)
    controllers: list[ControlMode] = pydantic.Field(
        default=["pid", "mixed"], min_length=1
    )
    base: dict[Flag, Value] = {}
    grid: dict[Flag, Levels] | None = None
    random: Sample | None = None
    search: Search | None = None

    @pydantic.model_validator(mode="after")
    def _one_kind(self) -> Spec:
        if sum(x is not None for x in (self.grid, self.random, self.search)) != 1:
            raise ValueError("expected one of grid, random and search")
        if len(set(self.controllers)) != len(self.controllers):
            raise ValueError("expected different controllers")
        if "controller" in {*self.base, *self.factors}:
            raise ValueError("expected controllers in `controllers`")
        if SEED in self.base:
            raise ValueError(f"expected `seed` of the spec in place of {SEED}")
        unknown = [f for f in (*self.base, *self.flags) if f not in FLAGS]
        if unknown:
            raise ValueError(
                f"flags of climb, not {unknown[0]}; there are {', '.join(FLAGS)}"
            )
        return self

    def __repr__(self) -> str:
        """Its question and its factors."""
        return f"Spec(about={self.about!r:.80}, flags={', '.join(self.flags)!r:.80})"

    @property
    def flags(self) -> list[str]:
        """Flags that differ between runs, the seed aside."""
        if self.grid is not None:
            names = list(self.grid)
        elif self.random is not None:
            names = [*self.random.factors, *itertools.chain(*self.random.either)]
        else:
            assert self.search is not None
            sets = self.search.sets
            names = [x for s in sets for x in s.flags] or [self.search.factor]
        return [n for n in dict.fromkeys(names) if n != SEED]

    @property
    def factors(self) -> list[str]:
        """Names of the columns that differ: the searched one, and the flags."""
        lead = [] if self.search is None else [self.search.factor]
        return list(dict.fromkeys([*lead, *self.flags]))


@dataclass(frozen=True, slots=True, kw_only=True)
class Strand:
    """The runs of one controller towards one end."""

    controller: ControlMode
    end: float | None
    name: str
    runs: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """One row to be.

    Attributes:
        name: Of the run, the same whenever and wherever it is done.
        strand: It belongs to.
        share: The level in [0, 1] of a search; None elsewhere.
        factors: What differs, by `Spec.factors`; a flag that is not set is absent.
        job: To do.
    """

    name: str
    strand: Strand
    share: float | None
    factors: dict[str, Any]
    job: Climb


@checks_types
def load_spec(path: str | Path) -> Spec:
    """Read a spec; files that it names may lie beside it.

    Args:
        path: The YAML file.

    Raises:
        InputError: The file or one of its fields cannot be used.
    """
    path = Path(path)
    content = read_yaml(path)
    try:
        spec = Spec.model_validate(content)
    except pydantic.ValidationError as e:
        raise input_error(e, path) from e

    def beside(name: str, value: Any) -> Any:
        if name in PATHS and isinstance(value, str):
            file = path.parent / value
            return str(file.resolve()) if file.is_file() else value
        return value

    spec = spec.model_copy(
        update={"base": {k: beside(k, v) for k, v in spec.base.items()}}
    )
    try:
        for strand in strands(spec):
            next_runs(spec, strand, [], {})
    except InputError as e:
        raise InputError(
            e.expected, source=e.source or path, field=e.field, value=e.value
        ) from e
    return spec


def goes_on(old: Spec, new: Spec) -> bool:
    """Whether the runs of `old` are the first ones of `new`: the same, or more runs."""
    for kind in ("random", "search"):
        a, b = getattr(old, kind), getattr(new, kind)
        if a is not None and b is not None and a.runs <= b.runs:
            longer = a.model_copy(update={"runs": b.runs})
            old = old.model_copy(update={kind: longer})
    return old == new


def strands(spec: Spec) -> list[Strand]:
    """All strands, in the order of the final table."""
    out = []
    for c in spec.controllers:
        if spec.search is None:
            runs = (
                spec.random.runs
                if spec.random is not None
                else math.prod(len(v) for v in _levels(spec).values())
            )
            out.append(Strand(controller=c, end=None, name=c, runs=runs))
        else:
            ends, runs = spec.search.ends, spec.search.runs
            for end in ends:
                name = c if len(ends) == 1 else f"{c}-to-{end:g}"
                out.append(Strand(controller=c, end=end, name=name, runs=runs))
    return out


def next_runs(
    spec: Spec, strand: Strand, known: Sequence[Run], done: Mapping[str, ClimbResult]
) -> list[Run]:
    """The runs of a strand that can be chosen now, beyond those known.

    Args:
        spec: The spec.
        strand: One of `strands(spec)`.
        known: Its runs chosen so far, in order.
        done: Outcomes by the names of runs.

    Returns:
        Empty where earlier runs must end first, and where all are known.
    """
    begin = len(known)
    if begin >= strand.runs:
        return []
    if spec.search is None:
        return list(_all_runs(spec, strand))
    heard = 0 if begin == 0 else max(COARSE, begin - LAG)
    if any(run.name not in done for run in known[:heard]):
        return []
    if begin == 0:
        shares = np.linspace(0.0, 1.0, COARSE).tolist()
    else:
        u = np.array([run.share for run in known[:heard]], dtype=float)
        reached = np.array([done[run.name].reached for run in known[:heard]])
        lo, hi = zone_of_change(u, reached)
        # A golden step from round to round: levels hardly ever repeat.
        phase = ((begin - COARSE) // ROUND * 0.6180339887498949) % 1.0
        shares = [lo + (hi - lo) * (i + phase) / ROUND for i in range(ROUND)]
    found = [
        _searched(spec, strand, begin + i, u)
        for i, u in enumerate(shares[: strand.runs - begin])
    ]
    return found


def zone_of_change(u: np.ndarray, reached: np.ndarray) -> tuple[float, float]:
    """The part of [0, 1] in which success changes, widened by a quarter of it each way.

    From the last success below all failures to the first failure above all successes:
    while these are separate it shrinks like a bisection, then it holds all levels
    at which runs end now this way, now that. It is never narrower than `MIN_ZONE`.

    Args:
        u: (n,) levels.
        reached: (n,) bool.
    """
    good, bad = u[reached], u[~reached]
    if not len(bad):
        return 0.5, 1.0
    if not len(good):
        return 0.0, 0.5
    lo = float(good[good < bad.min()].max(initial=0.0))
    hi = float(bad[bad > good.max()].min(initial=1.0))
    half = max(0.75 * (hi - lo), 0.5 * MIN_ZONE)
    middle = min(max((lo + hi) / 2, half), 1.0 - half) if half < 0.5 else 0.5
    return max(middle - half, 0.0), min(middle + half, 1.0)


def _searched(spec: Spec, strand: Strand, k: int, u: float) -> Run:
    search, end = spec.search, strand.end
    assert search is not None
    assert end is not None
    level, seed = search.rounded(search.level(u, end)), spec.seed + k
    rng = np.random.default_rng([seed, 4])  # 1 to 3 are the disturbances' own
    sets = search.sets or [Follows(flags=[search.factor])]
    flags = {k: v for s in sets for k, v in s.values(level, rng).items()}
    share = search.share(level, end)
    return _run(spec, strand, k, seed, flags, {search.factor: level, **flags}, share)


def _all_runs(spec: Spec, strand: Strand) -> Iterator[Run]:
    if spec.random is not None:
        for k in range(spec.random.runs):
            seed = spec.seed + k
            flags = spec.random.draw(np.random.default_rng([seed, 4]))
            yield _run(spec, strand, k, seed, flags, flags)
        return
    levels = _levels(spec)
    for k, values in enumerate(itertools.product(*levels.values())):
        flags = dict(zip(levels, values, strict=True))
        yield _run(spec, strand, k, spec.seed + k, flags, flags)


def _run(
    spec: Spec,
    strand: Strand,
    k: int,
    seed: int,
    flags: Mapping[str, Any],
    factors: Mapping[str, Any],
    share: float | None = None,
) -> Run:
    named = {SEED: seed, **spec.base, "controller": strand.controller, **flags}
    return Run(
        name=f"{strand.name}-{k:04d}",
        strand=strand,
        share=share,
        factors={n: v for n, v in factors.items() if n != SEED},
        job=climb_of(named),
    )


def _levels(spec: Spec) -> dict[str, list[Any]]:
    assert spec.grid is not None
    return {
        k: v.values() if isinstance(v, Range) else list(v) for k, v in spec.grid.items()
    }


def _draw(d: Distribution, rng: np.random.Generator) -> Any:
    if isinstance(d, Uniform):
        return _short(rng.uniform(*d.uniform))
    if isinstance(d, PlusMinus):
        return _short(d.about + rng.uniform(-d.plus_minus, d.plus_minus))
    if isinstance(d, list):
        return d[int(rng.integers(len(d)))]
    return d


def _short(x: float) -> float:
    """As few digits as a person would copy."""
    return float(f"{x:.{DIGITS}g}")
