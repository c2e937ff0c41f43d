"""A run or a recording in the browser, to look at, step through and edit.

`shown` and `person` say what there is to see at a time, `edits` what a person changed,
`charts` writes tables and plots: none of them knows a browser. `stage`, `page`, `run`
and `recording` hand them to viser, an optional package.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

from clamber.contact.contact import ContactSequence
from clamber.errors import ClamberError, InputError, MissingDependency
from clamber.model.scene import Scene
from clamber.recording.demonstration import Demonstration
from clamber.recording.detect import detect_contacts
from clamber.recording.library import BUILT_IN, load_demo
from clamber.run.folder import PLAN, SEQUENCE, load_sequence
from clamber.show.sample import Reading, read_run
from clamber.show.view.shown import show_run

BUILT_IN_SOURCE = "built-in "  # what the source of a built-in recording begins with


def open_view(
    source: str | Path,
    *,
    demo: str | Path | None = None,
    scene: Scene | None = None,
    host: str = "127.0.0.1",
    port: int = 8080,
) -> Any:
    """Serve a run or a recording as a page in the browser.

    Args:
        source: A run folder, whole or not; or a recording, a `recording.yaml`, or a
            built-in demonstration by name.
        demo: The recording that is shown beside a run; by default the one that the run
            names as its source, where that is found.
        scene: Of a recording that has none.
        host: To listen on: this machine alone, unless it says otherwise.
        port: Or the next one that is free.

    Returns:
        The page: `url`, `missing` (a sentence for each thing that cannot be shown),
        `port`, and `close()`.

    Raises:
        MissingDependency: There is no viser.
        InputError: There is nothing to show, or no such address.
    """
    if importlib.util.find_spec("viser") is None:
        raise MissingDependency("viser", "view")
    path = Path(source)
    if str(source) in BUILT_IN or not path.is_dir():
        if demo is not None:
            raise InputError("a run folder: --demo goes with one", source=source)
        return _recording(source, scene, host, port)
    return _run(path, demo, scene, host, port)


def _recording(source: str | Path, scene: Scene | None, host: str, port: int) -> Any:
    """The page of a recording."""
    from clamber.show.view.recording import recording_page

    recorded = load_demo(source, scene=scene)
    sequence, missing = None, []
    try:
        sequence = detect_contacts(recorded)
    except ClamberError as e:
        missing.append(f"no contacts: {e}")
    return recording_page(recorded, sequence, missing, host, port)


def _run(
    folder: Path, demo: str | Path | None, scene: Scene | None, host: str, port: int
) -> Any:
    """The page of a run folder."""
    from clamber.show.view.recording import figures_page, recording_page
    from clamber.show.view.run import run_page

    run = read_run(folder)
    reading = Reading(folder, run.missing)
    sequence = None
    if reading.has(SEQUENCE) or not run.written:
        sequence = reading.attempt(lambda: load_sequence(folder))
    if not (run.written or run.verdict or run.execution or sequence is not None):
        raise InputError(
            f"a run folder with {PLAN} or {SEQUENCE} ({'; '.join(run.missing)})",
            source=folder,
        )
    recorded = None
    named = _named_recording(sequence, run.written) if demo is None else demo
    if named is not None:
        recorded = reading.attempt(lambda: _recorded(named, scene, sequence))
    if run.plan is not None:
        shown = show_run(run.plan, run.rollout, run.execution)
        return run_page(run, shown, recorded, host, port)
    if recorded is not None and not (run.written or run.verdict):
        return recording_page(*recorded, run.missing, host, port)
    title = folder.resolve().name
    return figures_page(
        title, run.written, run.verdict, sequence, run.missing, host, port
    )


def _recorded(
    name: str | Path, scene: Scene | None, sequence: ContactSequence | None
) -> tuple[Demonstration, ContactSequence]:
    """A recording and what was detected in it: as the run has it, where it is whole."""
    recorded = load_demo(name, scene=scene)
    if sequence is None or sequence.subject is None:
        sequence = detect_contacts(recorded)
    return recorded, sequence


def _named_recording(sequence: ContactSequence | None, written: Any) -> str | None:
    """The recording that a run names as its source, where it can be found."""
    source = written.get("sequence", {}).get("source", "")
    if sequence is not None:
        source = sequence.source
    for name in BUILT_IN:
        if source.startswith(f"{BUILT_IN_SOURCE}{name}"):
            return name
    return source if source and Path(source).is_file() else None
