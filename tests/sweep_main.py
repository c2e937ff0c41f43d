"""`clamber sweep` in a process that tests can kill, with quick jobs for climbs."""

from __future__ import annotations

import functools
import sys

import sweep_jobs
from clamber import cli
from clamber.study import sweep

if __name__ == "__main__":
    sweep.run_sweep = functools.partial(sweep.run_sweep, job=sweep_jobs.slow)
    sys.exit(cli.main(["sweep", *sys.argv[1:]]))
