"""spec -> table: many jobs on all cores, or on a cluster, each of them done once.

One process, the coordinating one, chooses runs and writes rows; the others do jobs and
know of nothing else. A row is on disk before the next is waited for, so that whatever
ends a sweep, the same call goes on where it stopped.
"""

from __future__ import annotations

import contextlib
import csv
import fcntl
import io as text_io
import json
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, wait
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import IO, Any

import yaml

from clamber.errors import ClamberError, InputError, MissingDependency, unreadable
from clamber.model.arguments import checks_types
from clamber.model.progress import Progress, silent
from clamber.model.robot import load_robot
from clamber.model.terrain import load_scene
from clamber.recording.recording import load_demo
from clamber.run.codec import whole_file
from clamber.study.climb import ClimbResult, command_of, run_climb
from clamber.study.spec import Run, Spec, Strand, goes_on, load_spec, next_runs, strands

SPEC = "spec.yaml"
TABLE = "runs.csv"
TIMINGS = "timings.json"
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
IDLE = 60  # [s] after which a worker without work ends
LOSSES = 3  # workers lost in a row without one row gained end a sweep
CONNECT = 10.0  # [s] in which a scheduler has to answer
CRASHED = "error: "  # begins `why` where a job raised what it never should

JobFunction = Callable[[Any], ClimbResult]
Rows = list[tuple[Run, ClimbResult]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Pace:
    """Timing of one call.

    Attributes:
        runs: Done in this call.
        workers: Processes that did them.
        wall: From the first run's submission to the last one's end [s].
        taken: Seconds of all jobs together, by the clock.
        busy: Processor seconds of all jobs together.
        motion: Simulated seconds of all jobs together.
    """

    runs: int = 0
    workers: int = 0
    wall: float = 0.0
    taken: float = 0.0
    busy: float = 0.0
    motion: float = 0.0

    @property
    def share(self) -> float:
        """Share of the workers' processor time used by jobs."""
        return self.busy / max(self.wall * self.workers, 1e-9)

    @property
    def occupied(self) -> float:
        """Share of the wall time in which the workers had a job."""
        return self.taken / max(self.wall * self.workers, 1e-9)

    @property
    def speed(self) -> float:
        """Simulated seconds in one second of a processor."""
        return self.motion / max(self.busy, 1e-9)


@checks_types
def run_sweep(
    spec: Spec,
    folder: str | Path,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    job: JobFunction = run_climb,
    progress: Progress | None = None,
) -> tuple[Rows, Pace]:
    """Do the runs of a spec that its folder does not hold yet.

    Args:
        spec: What to run; with more `runs` than before, those are added.
        folder: Holds `spec.yaml` and `runs.csv`; made, or continued.
        workers: Processes; None: one for each core.
        scheduler: Address of a `dask.distributed` scheduler whose workers do the runs
            in place of local processes.
        job: Does one job; must be importable by the workers.
        progress: Called with stage, share and note.

    Returns:
        All rows in the order of the spec, and how fast this call went on.

    Raises:
        InputError: The folder is another spec's, or in use; nobody answers at the
            scheduler's address.
        ClamberError: Workers die again and again.
    """
    report = progress or silent
    folder = Path(folder)
    with _table(spec, folder) as table:
        todo = _Todo(spec, table.done)
        report(
            "sweep", len(todo.rows) / todo.total, f"{len(todo.rows)} of {todo.total}"
        )
        pace, losses = Pace(), 0
        began = time.perf_counter()
        try:
            while todo.waiting and losses < LOSSES:
                before = len(todo.rows)
                with contextlib.suppress(BrokenExecutor):
                    with _executor(workers, scheduler) as (executor, count):
                        for run, outcome, cost in _outcomes(executor, count, todo, job):
                            table.add(run, outcome)
                            n = len(todo.rows)
                            said = "reached" if outcome.reached else outcome.why
                            report(
                                "sweep", n / todo.total, f"{n} of {todo.total}: {said}"
                            )
                            pace = Pace(
                                runs=pace.runs + 1,
                                workers=count,
                                wall=time.perf_counter() - began,
                                taken=pace.taken + cost.taken,
                                busy=pace.busy + cost.busy,
                                motion=pace.motion + outcome.seconds,
                            )
                losses = losses + 1 if len(todo.rows) == before else 0
        finally:
            if pace.runs:
                _save_pace(folder / TIMINGS, pace)
        if todo.waiting:
            raise ClamberError(
                f"worker processes ended {LOSSES} times without finishing a run (out of"
                f" memory?); {len(todo.rows)} of {todo.total} rows are kept"
            )
        rows = todo.sorted()
        table.finish(rows)
    return rows, pace


def check_inputs(spec: Spec) -> None:
    """Load once each recording, robot and scene that the first runs name.

    Raises:
        InputError: One of them cannot be used; in a sweep it would fail run by run.
    """
    jobs = [r.job for s in strands(spec)[:1] for r in next_runs(spec, s, [], {})]
    for demo in sorted({j.demo for j in jobs}):
        load_demo(demo)
    for robot in sorted({j.robot for j in jobs}):
        load_robot(robot)
    for scene in sorted({j.scene for j in jobs if j.scene is not None}):
        load_scene(scene)


class _Todo:
    """Known, finished and waiting runs."""

    def __init__(self, spec: Spec, done: Mapping[str, ClimbResult]) -> None:
        self._spec = spec
        self._known: dict[str, list[Run]] = {}
        self._strands = strands(spec)
        self.total = sum(s.runs for s in self._strands)
        self._earlier = dict(done)
        self.rows: dict[str, ClimbResult] = {}
        self.waiting: dict[str, Run] = {}
        for s in self._strands:
            self._known[s.name] = []
            self._choose(s)
        if self._earlier:
            raise InputError(
                "rows of this spec alone",
                source=TABLE,
                field="run",
                value=next(iter(self._earlier)),
            )

    def end(self, run: Run, outcome: ClimbResult) -> list[Run]:
        """Note what became of a run; the runs that follow from that."""
        del self.waiting[run.name]
        self.rows[run.name] = outcome
        return self._choose(run.strand)

    def sorted(self) -> Rows:
        """All rows in the order of the spec."""
        runs = [r for s in self._strands for r in self._known[s.name]]
        return [(r, self.rows[r.name]) for r in runs if r.name in self.rows]

    def _choose(self, strand: Strand) -> list[Run]:
        known, new = self._known[strand.name], []
        while found := next_runs(self._spec, strand, known, self.rows):
            known += found
            for run in found:
                outcome = self._earlier.pop(run.name, None)
                if outcome is None:
                    self.waiting[run.name] = run
                    new.append(run)
                else:
                    self.rows[run.name] = outcome
        return new


@dataclass(frozen=True, slots=True, kw_only=True)
class _Cost:
    """Cost of one job: wall time and CPU time [s]."""

    taken: float
    busy: float


def _outcomes(
    executor: Executor, count: int, todo: _Todo, job: JobFunction
) -> Iterator[tuple[Run, ClimbResult, _Cost]]:
    """Submit what can be run, yield what has ended, until nothing waits."""
    running: dict[Future[tuple[ClimbResult, _Cost]], Run] = {}
    ahead = list(todo.waiting.values())
    while ahead or running:
        # Each worker has one in hand and one to go on with: all else can be called off.
        while ahead and len(running) < 2 * count:
            run = ahead.pop(0)
            running[executor.submit(_timed, job, run.job)] = run
        ended, _ = wait(running, return_when=FIRST_COMPLETED)
        for future in [f for f in running if f in ended]:
            run = running.pop(future)
            try:
                outcome, cost = future.result()
            except BrokenExecutor:
                raise
            except Exception as e:  # not the job's own: `_timed` catches those
                raise ClamberError(
                    f"run {run.name} could not be done ({type(e).__name__}: {e});"
                    f" {len(todo.rows)} of {todo.total} rows are kept, and the same"
                    " command goes on from there"
                ) from e
            ahead += todo.end(run, outcome)
            yield run, outcome, cost


def _timed(job: JobFunction, what: Any) -> tuple[ClimbResult, _Cost]:
    """In a worker: the outcome and its cost. A crash is an outcome too."""
    began, before = time.perf_counter(), time.process_time()
    try:
        outcome = job(what)
    except Exception as e:  # days of runs are not lost for one
        outcome = ClimbResult(reached=False, why=f"{CRASHED}{type(e).__name__}: {e}")
    cost = _Cost(taken=time.perf_counter() - began, busy=time.process_time() - before)
    return outcome, cost


# Who does the jobs.


@contextlib.contextmanager
def _executor(
    workers: int | None, scheduler: str | None
) -> Iterator[tuple[Executor, int]]:
    """Processes of this machine or of a cluster, and how many."""
    if scheduler is not None:
        with _cluster(scheduler) as both:
            yield both
        return
    from joblib import cpu_count
    from joblib.externals.loky import get_reusable_executor

    count = workers or cpu_count()
    executor = get_reusable_executor(
        max_workers=count,
        timeout=IDLE,
        kill_workers=True,
        initializer=_begin_worker,
        initargs=(os.getpid(),),
        env=ONE_THREAD,
    )
    whole = False
    try:
        yield executor, count
        whole = True
    finally:
        executor.shutdown(wait=True, kill_workers=not whole)


@contextlib.contextmanager
def _cluster(address: str) -> Iterator[tuple[Executor, int]]:
    """The workers of a dask scheduler; it gives a lost worker's runs to others."""
    try:
        from distributed import Client
    except ImportError as e:
        raise MissingDependency("dask.distributed", "cluster") from e
    try:
        client = Client(address, timeout=CONNECT, set_as_default=False)
    except (OSError, ValueError) as e:
        raise InputError(
            "the address of a dask scheduler that answers, such as tcp://host:8786",
            source="--scheduler",
            value=address,
        ) from e
    with client:
        workers_seen = client.scheduler_info(n_workers=-1)["workers"]
        threads = sum(w["nthreads"] for w in workers_seen.values())
        if threads == 0:
            raise InputError(
                "a scheduler with workers", source="--scheduler", value=address
            )
        executor = client.get_executor()
        try:
            yield executor, threads
        finally:
            executor.shutdown(wait=False)  # what has not ended is called off


def _begin_worker(coordinator: int) -> None:
    """In a worker: leave Ctrl-C to the coordinating process, and end with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        while os.getppid() == coordinator:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


# The table.


def columns(spec: Spec) -> list[str]:
    """Columns of `runs.csv`."""
    found = [f.name for f in fields(ClimbResult)]
    return ["run", "controller", *spec.factors, "seed", *found, "command"]


def cells(spec: Spec, run: Run, outcome: ClimbResult) -> list[str]:
    """A row of `runs.csv`; a flag that the run does not set is left empty."""
    found = [_text(v) for v in asdict(outcome).values()]
    factors = [_text(run.factors.get(n, "")) for n in spec.factors]
    seed = str(run.job.disturb.seed)
    lead = [run.name, run.strand.controller]
    return [*lead, *factors, seed, *found, command_of(run.job)]


def _text(x: Any) -> str:
    if isinstance(x, bool):
        return "yes" if x else "no"
    return repr(x) if isinstance(x, float) else " ".join(str(x).split())


def _line(words: Sequence[str]) -> bytes:
    stream = text_io.StringIO()
    csv.writer(stream, lineterminator="\n").writerow(words)
    return stream.getvalue().encode()


class _Table:
    """`runs.csv`, open and locked."""

    def __init__(self, spec: Spec, path: Path, stream: IO[bytes]) -> None:
        self._spec, self._path, self._stream = spec, path, stream
        self.done = self._read()

    def add(self, run: Run, outcome: ClimbResult) -> None:
        """Append a row; it is on disk when this returns."""
        self._stream.write(_line(cells(self._spec, run, outcome)))
        self._flush()

    def finish(self, rows: Rows) -> None:
        """The same rows in the order of the spec, not in that in which they ended."""
        with whole_file(self._path) as draft:
            draft.write_bytes(
                _line(columns(self._spec))
                + b"".join(_line(cells(self._spec, *row)) for row in rows)
            )

    def _flush(self) -> None:
        self._stream.flush()
        os.fsync(self._stream.fileno())

    def _read(self) -> dict[str, ClimbResult]:
        """Outcomes by run; a last line that was torn is cut off."""
        content = self._stream.read()
        whole = content[: content.rfind(b"\n") + 1]
        self._stream.truncate(len(whole))
        self._stream.seek(len(whole))
        if not whole:
            self._stream.write(_line(columns(self._spec)))
            self._flush()
            return {}
        return read_outcomes(self._spec, whole.decode(), self._path)


def read_outcomes(spec: Spec, text: str, source: Path) -> dict[str, ClimbResult]:
    """Outcomes by the names of runs.

    Raises:
        InputError: It is no table of this spec.
    """
    header, *rows = csv.reader(text_io.StringIO(text))
    if header != columns(spec):
        raise InputError(
            f"the columns {', '.join(columns(spec))}", source=source, value=header
        )
    out = {}
    for i, words in enumerate(rows, start=2):
        try:
            row = dict(zip(header, words, strict=True))
            if row["reached"] not in ("yes", "no") or row["run"] in out:
                raise ValueError(row["run"])
            out[row["run"]] = ClimbResult(
                reached=row["reached"] == "yes",
                why=row["why"],
                seconds=float(row["seconds"]),
                replans=int(row["replans"]),
                effort=float(row["effort"]),
            )
        except ValueError as e:
            raise InputError(
                "a row of its own for each run", source=source, field=f"line {i}"
            ) from e
    return out


@checks_types
def load_sweep(folder: str | Path) -> tuple[Spec, Rows]:
    """Spec and finished rows of a sweep, also of one that is not done.

    Args:
        folder: The folder that `run_sweep` writes.

    Raises:
        InputError: There is none.
    """
    folder = Path(folder)
    spec, path = load_spec(folder / SPEC), folder / TABLE
    try:
        text = path.read_text()
    except OSError as e:
        raise unreadable(path, e, "`clamber sweep` writes it") from e
    whole = text[: text.rfind("\n") + 1]
    return spec, _Todo(spec, read_outcomes(spec, whole, path)).sorted()


@contextlib.contextmanager
def _table(spec: Spec, folder: Path) -> Iterator[_Table]:
    """The table of a folder, made or continued; no second sweep may write it."""
    path, copy = folder / TABLE, folder / SPEC
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = (folder / ".lock").open("wb")
    except OSError as e:
        raise InputError(
            f"a folder that can be written ({e.strerror})", source="--out", value=folder
        ) from e
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as e:
            raise InputError(
                "a folder in which no other sweep is running",
                source="--out",
                value=str(folder),
            ) from e
        if copy.exists() and not goes_on(load_spec(copy), spec):
            raise InputError(
                f"a folder of this spec, or a new one: {copy} is another spec",
                source="--out",
                value=str(folder),
            )
        content = spec.model_dump(mode="json", by_alias=True, exclude_unset=True)
        with whole_file(copy) as draft:
            draft.write_text(yaml.safe_dump(content, sort_keys=False))
        path.touch()
        with path.open("r+b") as stream:
            yield _Table(spec, path, stream)


def _save_pace(path: Path, pace: Pace) -> None:
    """Add a session to the timings."""
    sessions = []
    if path.exists():
        sessions = json.loads(path.read_text())["sessions"]
    figures = {
        **asdict(pace),
        "share_of_processors": pace.share,
        "share_of_workers": pace.occupied,
        "times_real_time": pace.speed,
    }
    rounded = {k: round(v, 3) for k, v in figures.items()}
    text = json.dumps({"version": 1, "sessions": [*sessions, rounded]}, indent=1)
    with whole_file(path) as draft:
        draft.write_text(text + "\n")
