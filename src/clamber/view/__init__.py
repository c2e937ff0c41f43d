"""A run or a recording in the browser, to look at, step through and edit.

`shown` says what there is to see at a time, `charts` writes tables and plots; neither
knows a browser. `stage` and `page` hand them to viser, an optional package.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path

from clamber.errors import InputError, MissingDependency
from clamber.io import PLAN, VERDICT
from clamber.motion import read_run
from clamber.view.shown import show_run


def open_page(source: str | Path, *, host: str = "127.0.0.1", port: int = 8080):
    """Serve a run or a recording as a page, until `close`."""
    if importlib.util.find_spec("viser") is None:
        raise MissingDependency("viser", "view")
    from clamber.view.run import run_page

    folder = Path(source)
    run = read_run(folder)
    if run.plan is None:
        raise InputError(f"a run folder with {PLAN} or {VERDICT}", source=folder)
    shown = show_run(run.plan, run.rollout, run.execution)
    return run_page(run, shown, host, port)
