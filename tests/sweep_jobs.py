"""Jobs that sweeps of the tests do in place of climbs; workers import them."""

from __future__ import annotations

import hashlib
import os
import time
from pathlib import Path

from clamber.study.climb import Climb, ClimbResult, command_of

LOG = "CLAMBER_TEST_LOG"  # names a folder: each job that begins leaves a file in it
SECONDS = "CLAMBER_TEST_SECONDS"


def breaks_at_friction(job: Climb) -> ClimbResult:
    """Reached above a friction of 0.4, and by chance of its seed around it."""
    mu = job.disturb.friction
    assert mu is not None
    noise = hashlib.sha256(str(job.disturb.seed).encode()).digest()[0] / 255.0 - 0.5
    reached = mu + 0.1 * noise > (0.4 if job.controller == "pid" else 0.3)
    return ClimbResult(
        reached=reached, why="" if reached else "fell", seconds=10.0 * mu
    )


def slow(job: Climb) -> ClimbResult:
    """The same, noted with its process where it begins."""
    if LOG in os.environ:
        digest = hashlib.sha256(command_of(job).encode()).hexdigest()[:12]
        name = f"{digest}-{os.getpid()}-{time.monotonic_ns()}"
        (Path(os.environ[LOG]) / name).touch()
    time.sleep(float(os.environ.get(SECONDS, "0.05")))
    return breaks_at_friction(job)


def crashes_once_in_a_while(job: Climb) -> ClimbResult:
    if job.disturb.seed % 5 == 3:
        raise ZeroDivisionError("no such luck")
    return breaks_at_friction(job)


def dies_on_its_first_try(job: Climb) -> ClimbResult:
    """The worker process is gone, as when memory runs out, the first time only."""
    mark = Path(os.environ[LOG]) / f"died-{job.disturb.seed}"
    if job.disturb.seed == 4 and not mark.exists():
        mark.touch()
        os._exit(9)
    return breaks_at_friction(job)


def always_dies(job: Climb) -> ClimbResult:
    os._exit(9)
