"""Sweeps do each run once, whatever ends them, and write the same table."""

from __future__ import annotations

import collections
import csv
import functools
import hashlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import sweep_jobs
from clamber.errors import ClamberError, InputError, MissingDependency
from clamber.study.climb import ClimbResult
from clamber.study.spec import Spec, load_spec
from clamber.study.sweep import CRASHED, load_sweep, read_outcomes, run_sweep

pytestmark = pytest.mark.pool
SEARCH = """
base: {height: 0.275}
search: {factor: disturb.friction, from: 1.0, to: 0.05, runs: 20}
"""
RUNS = 40  # of the search, both controllers


@pytest.fixture
def spec_file(tmp_path: Path) -> Path:
    path = tmp_path / "friction.yaml"
    path.write_text(SEARCH)
    return path


@pytest.fixture
def spec(spec_file: Path) -> Spec:
    return load_spec(spec_file)


@pytest.fixture
def log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder in which jobs note that they begin."""
    folder = tmp_path / "log"
    folder.mkdir()
    monkeypatch.setenv(sweep_jobs.LOG, str(folder))
    return folder


@pytest.fixture(scope="session")
def uninterrupted(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The table of the search, done in one go by one worker."""
    folder = tmp_path_factory.mktemp("whole")
    (folder / "spec.yaml").write_text(SEARCH)
    spec = load_spec(folder / "spec.yaml")
    run_sweep(spec, folder / "out", workers=1, job=sweep_jobs.breaks_at_friction)
    return (folder / "out" / "runs.csv").read_bytes()


def rows_of(folder: Path) -> list[dict[str, str]]:
    """Whole rows only, as a sweep that goes on would read them."""
    path = folder / "runs.csv"
    text = path.read_text() if path.exists() else ""
    return list(csv.DictReader(text[: text.rfind("\n") + 1].splitlines()))


def begun(log: Path) -> collections.Counter[str]:
    """How often each command was begun, by its digest."""
    return collections.Counter(f.name.split("-")[0] for f in log.iterdir())


def digest(row: dict[str, str]) -> str:
    return hashlib.sha256(row["command"].encode()).hexdigest()[:12]


def wait_until(holds: Callable[[], bool], seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


def is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def start(spec_file: Path, out: Path) -> subprocess.Popen[str]:
    """A sweep in its own group of processes, as a terminal starts it."""
    command = [sys.executable, str(Path(__file__).with_name("sweep_main.py"))]
    return subprocess.Popen(
        [*command, str(spec_file), "--out", str(out), "--workers", "2"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, sweep_jobs.SECONDS: "0.15"},
        start_new_session=True,
        # Whatever starts the tests in the background has interrupts ignored.
        preexec_fn=functools.partial(signal.signal, signal.SIGINT, signal.SIG_DFL),
    )


@pytest.fixture
def under_way(spec_file: Path, log: Path, tmp_path: Path) -> Iterator[subprocess.Popen]:
    """A sweep into `tmp_path / "out"` that has finished a few rows."""
    process = start(spec_file, tmp_path / "out")
    wait_until(
        lambda: len(rows_of(tmp_path / "out")) >= 5 or process.poll() is not None
    )
    assert process.poll() is None, process.communicate()
    yield process
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)
    process.communicate()


def test_the_table_does_not_depend_on_the_number_of_workers(
    spec: Spec, tmp_path: Path, uninterrupted: bytes
):
    rows, pace = run_sweep(
        spec, tmp_path / "out", workers=2, job=sweep_jobs.breaks_at_friction
    )
    assert (tmp_path / "out" / "runs.csv").read_bytes() == uninterrupted
    assert len(rows) == pace.runs == RUNS
    assert pace.workers == 2
    assert pace.motion == pytest.approx(sum(outcome.seconds for _, outcome in rows))


def test_the_pace_says_how_much_of_the_workers_time_was_used(
    spec: Spec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv(sweep_jobs.SECONDS, "0.05")
    _, pace = run_sweep(spec, tmp_path / "out", workers=2, job=sweep_jobs.slow)
    assert 0.05 * RUNS <= pace.taken <= pace.workers * pace.wall
    assert pace.busy < 0.5 * pace.taken  # these jobs sleep
    assert pace.occupied == pace.taken / (2 * pace.wall)
    assert pace.share == pace.busy / (2 * pace.wall)
    assert pace.speed == pace.motion / pace.busy
    session = json.loads((tmp_path / "out" / "timings.json").read_text())["sessions"][0]
    assert session["share_of_workers"] == round(pace.occupied, 3)
    assert session["times_real_time"] == round(pace.speed, 3)


def test_a_row_says_what_was_run_and_what_became_of_it(uninterrupted: bytes):
    rows = list(csv.DictReader(uninterrupted.decode().splitlines()))
    assert [r["run"] for r in rows[:2]] == ["pid-0000", "pid-0001"]
    assert len({r["run"] for r in rows}) == len({r["command"] for r in rows}) == RUNS
    for r in rows:
        assert f"--controller {r['controller']}" in r["command"]
        assert f"--disturb.friction {r['disturb.friction']}" in r["command"]
        assert (r["reached"] == "yes") == (r["why"] == "")
        assert float(r["seconds"]) == pytest.approx(10 * float(r["disturb.friction"]))


def test_a_killed_sweep_goes_on_and_does_no_finished_run_again(
    under_way: subprocess.Popen,
    spec: Spec,
    log: Path,
    tmp_path: Path,
    uninterrupted: bytes,
):
    under_way.send_signal(signal.SIGKILL)
    under_way.wait()
    out = tmp_path / "out"
    finished = rows_of(out)
    assert 5 <= len(finished) < RUNS
    with (out / "runs.csv").open("a") as f:
        f.write("pid-0019,pid,0.41")  # the line that was being written
    rows, pace = run_sweep(spec, out, workers=2, job=sweep_jobs.slow)
    assert pace.runs == RUNS - len(finished)
    assert [begun(log)[digest(r)] for r in finished] == [1] * len(finished)
    assert len(rows) == RUNS
    assert (out / "runs.csv").read_bytes() == uninterrupted


def test_the_workers_of_a_killed_sweep_end_too(under_way: subprocess.Popen, log: Path):
    def seen() -> set[int]:
        return {int(f.name.split("-")[1]) for f in log.iterdir()}

    # One may have started late.
    wait_until(lambda: len(seen()) == 2 or under_way.poll() is not None)
    workers = seen()
    assert len(workers) == 2
    under_way.send_signal(signal.SIGKILL)
    under_way.wait()
    wait_until(lambda: not any(is_alive(w) for w in workers), seconds=30.0)


def test_an_interrupt_ends_at_once_says_how_to_go_on_and_keeps_the_rows(
    under_way: subprocess.Popen, log: Path, tmp_path: Path
):
    os.killpg(under_way.pid, signal.SIGINT)
    out, err = under_way.communicate(timeout=20)
    assert under_way.returncode == 130
    assert out == ""
    said = err.splitlines()[-1]
    assert "the same command goes on from there" in said
    assert str(tmp_path / "out") in said
    assert "Traceback" not in err
    assert 5 <= len(rows_of(tmp_path / "out")) < RUNS
    workers = {int(f.name.split("-")[1]) for f in log.iterdir()}
    wait_until(lambda: not any(is_alive(w) for w in workers), seconds=10.0)


def test_a_second_sweep_into_the_same_folder_is_refused(
    under_way: subprocess.Popen, spec: Spec, tmp_path: Path
):
    with pytest.raises(InputError, match="no other sweep is running"):
        run_sweep(spec, tmp_path / "out", job=sweep_jobs.breaks_at_friction)


def test_a_finished_sweep_does_nothing_more(
    spec: Spec, tmp_path: Path, log: Path, uninterrupted: bytes
):
    out = tmp_path / "out"
    run_sweep(spec, out, workers=1, job=sweep_jobs.breaks_at_friction)
    rows, pace = run_sweep(spec, out, workers=1, job=sweep_jobs.slow)
    assert pace.runs == 0
    assert not any(log.iterdir())
    assert (out / "runs.csv").read_bytes() == uninterrupted
    assert load_sweep(out) == (spec, rows)


def test_a_folder_of_another_spec_is_refused(
    spec: Spec, spec_file: Path, tmp_path: Path
):
    out = tmp_path / "out"
    run_sweep(spec, out, workers=1, job=sweep_jobs.breaks_at_friction)
    before = (out / "runs.csv").read_bytes()
    spec_file.write_text(SEARCH.replace("0.05", "0.1"))
    with pytest.raises(InputError, match=r"spec\.yaml is another spec"):
        run_sweep(load_spec(spec_file), out, job=sweep_jobs.breaks_at_friction)
    assert (out / "runs.csv").read_bytes() == before
    spec_file.write_text("# only a comment\n" + SEARCH)
    assert run_sweep(load_spec(spec_file), out, job=sweep_jobs.slow)[1].runs == 0


def test_a_sweep_may_be_made_longer_but_not_shorter(
    spec: Spec, spec_file: Path, tmp_path: Path, log: Path, uninterrupted: bytes
):
    out = tmp_path / "out"
    spec_file.write_text(SEARCH.replace("runs: 20", "runs: 10"))
    run_sweep(load_spec(spec_file), out, workers=1, job=sweep_jobs.breaks_at_friction)
    _, pace = run_sweep(spec, out, workers=1, job=sweep_jobs.slow)
    assert pace.runs == RUNS // 2
    assert (out / "runs.csv").read_bytes() == uninterrupted
    with pytest.raises(InputError, match="is another spec"):
        run_sweep(load_spec(spec_file), out, job=sweep_jobs.slow)


def test_a_table_that_does_not_fit_is_refused(spec: Spec, uninterrupted: bytes):
    text = uninterrupted.decode()
    lines = text.splitlines(keepends=True)
    table = Path("runs.csv")
    assert len(read_outcomes(spec, text, table)) == RUNS
    with pytest.raises(InputError, match="expected the columns run, controller"):
        read_outcomes(spec, text.replace("effort", "torque", 1), table)
    with pytest.raises(InputError, match="line 42"):
        read_outcomes(spec, text + lines[1], table)  # a run twice
    with pytest.raises(InputError, match="line 2"):
        read_outcomes(spec, text.replace(",yes,", ",perhaps,", 1), table)


def test_rows_that_the_spec_would_not_choose_are_refused(
    spec: Spec, tmp_path: Path, uninterrupted: bytes
):
    out = tmp_path / "out"
    out.mkdir()
    row = uninterrupted.decode().splitlines(keepends=True)[1]
    header = uninterrupted.decode().splitlines(keepends=True)[0]
    (out / "runs.csv").write_text(header + row.replace("pid-0000", "pid-9999"))
    with pytest.raises(InputError, match="pid-9999"):
        run_sweep(spec, out, job=sweep_jobs.breaks_at_friction)


def test_a_job_that_crashes_is_a_row_that_says_so(spec: Spec, tmp_path: Path):
    rows, _ = run_sweep(
        spec, tmp_path / "out", workers=1, job=sweep_jobs.crashes_once_in_a_while
    )
    crashed = [(run, o) for run, o in rows if run.job.disturb.seed % 5 == 3]
    assert len(rows) == RUNS
    assert crashed
    for _, outcome in crashed:
        assert not outcome.reached
        assert outcome.why == f"{CRASHED}ZeroDivisionError: no such luck"


def test_a_worker_that_dies_costs_no_row(
    spec: Spec, tmp_path: Path, log: Path, uninterrupted: bytes
):
    rows, _ = run_sweep(
        spec, tmp_path / "out", workers=2, job=sweep_jobs.dies_on_its_first_try
    )
    assert (log / "died-4").exists()
    assert len(rows) == RUNS
    assert (tmp_path / "out" / "runs.csv").read_bytes() == uninterrupted


def test_workers_that_always_die_end_the_sweep_with_a_sentence(
    spec: Spec, tmp_path: Path
):
    with pytest.raises(ClamberError, match=r"ended 3 times.* 0 of 40 rows are kept"):
        run_sweep(spec, tmp_path / "out", workers=1, job=sweep_jobs.always_dies)


def test_a_cluster_that_loses_a_worker_in_mid_run_loses_and_doubles_no_row(
    spec: Spec,
    log: Path,
    tmp_path: Path,
    uninterrupted: bytes,
    monkeypatch: pytest.MonkeyPatch,
):
    distributed = pytest.importorskip("distributed")
    monkeypatch.setenv(sweep_jobs.SECONDS, "0.3")
    out = tmp_path / "out"
    results: list[tuple] = []
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as cluster:
        address = cluster.scheduler_address

        def coordinate() -> None:
            results.append(run_sweep(spec, out, scheduler=address, job=sweep_jobs.slow))

        thread = threading.Thread(target=coordinate)
        thread.start()
        wait_until(lambda: len(rows_of(out)) >= 6)
        last = max(log.iterdir(), key=lambda f: int(f.name.split("-")[2]))
        os.kill(int(last.name.split("-")[1]), signal.SIGKILL)
        killed_at = len(rows_of(out))
        thread.join(timeout=60)
        assert not thread.is_alive()
    rows, pace = results[0]
    assert killed_at < RUNS
    assert pace.runs == len(rows) == RUNS
    assert (out / "runs.csv").read_bytes() == uninterrupted
    counts = begun(log)
    assert len(counts) == RUNS
    # What the lost worker was doing was begun again by another.
    assert counts[last.name.split("-")[0]] == 2
    assert sum(counts.values()) <= RUNS + 2


def test_a_cluster_that_gives_a_run_up_ends_the_sweep_with_a_sentence(
    spec: Spec, tmp_path: Path
):
    distributed = pytest.importorskip("distributed")
    import dask

    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 0}),
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=1, processes=True, dashboard_address=None
        ) as cluster,
        pytest.raises(ClamberError, match=r"run pid-00\d\d could not be done \(Killed"),
    ):
        run_sweep(
            spec,
            tmp_path / "out",
            scheduler=cluster.scheduler_address,
            job=sweep_jobs.always_dies,
        )


def test_a_scheduler_that_goes_away_ends_the_sweep_and_keeps_the_rows(
    spec: Spec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    distributed = pytest.importorskip("distributed")
    monkeypatch.setenv(sweep_jobs.SECONDS, "0.2")
    out = tmp_path / "out"
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=True, dashboard_address=None
    ) as cluster:

        def leave(stage: str, share: float, note: str) -> None:
            if share > 0.1:
                cluster.close()

        with pytest.raises(ClamberError, match="goes on from there"):
            run_sweep(
                spec,
                out,
                scheduler=cluster.scheduler_address,
                job=sweep_jobs.slow,
                progress=leave,
            )
    assert 4 < len(rows_of(out)) < RUNS


def test_a_scheduler_that_does_not_answer_is_named(
    spec: Spec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    pytest.importorskip("distributed")
    monkeypatch.setattr("clamber.study.sweep.CONNECT", 0.5)
    with pytest.raises(InputError, match=r"--scheduler is 'tcp://127\.0\.0\.1:1'"):
        run_sweep(spec, tmp_path / "out", scheduler="tcp://127.0.0.1:1")


def test_without_dask_the_extra_is_named(
    spec: Spec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingDependency, match=r"clamber\[cluster\]"):
        run_sweep(spec, tmp_path / "out", scheduler="tcp://127.0.0.1:8786")


def test_dask_is_not_loaded_for_a_local_sweep():
    code = "import sys, clamber.study.sweep; print('distributed' in sys.modules)"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert out.stdout == "False\n"


def test_progress_counts_the_rows_that_were_there(spec: Spec, tmp_path: Path):
    seen: list[tuple[str, float, str]] = []
    out = tmp_path / "out"
    run_sweep(
        spec,
        out,
        workers=1,
        job=sweep_jobs.breaks_at_friction,
        progress=lambda *x: seen.append(x),
    )
    assert seen[0] == ("sweep", 0.0, "0 of 40")
    assert seen[-1][:2] == ("sweep", 1.0)
    assert len(seen) == RUNS + 1
    lines = (out / "runs.csv").read_text().splitlines(keepends=True)
    (out / "runs.csv").write_text("".join(lines[:9]))
    seen.clear()
    run_sweep(
        spec,
        out,
        workers=1,
        job=sweep_jobs.breaks_at_friction,
        progress=lambda *x: seen.append(x),
    )
    assert seen[0] == ("sweep", 8 / RUNS, "8 of 40")


def test_an_outcome_survives_the_table(spec: Spec, tmp_path: Path):
    rows, _ = run_sweep(
        spec, tmp_path / "out", workers=1, job=sweep_jobs.breaks_at_friction
    )
    kept = load_sweep(tmp_path / "out")[1]
    assert [o for _, o in kept] == [o for _, o in rows]
    assert all(isinstance(o, ClimbResult) for _, o in kept)
