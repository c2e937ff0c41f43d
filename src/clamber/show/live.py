"""A run or a recording in the browser: to play, to turn, to edit.

What is only read (plots, tables, criteria) is in the report, which the page hands out.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np

from clamber.contact.contact import ContactSequence
from clamber.errors import ClamberError, InputError, MissingDependency
from clamber.execution.simulation import Rollout
from clamber.model.arguments import checks_types
from clamber.model.kinematics import Kinematics
from clamber.model.terrain import SceneLike
from clamber.planning.records import Plan
from clamber.recording.built_in import BUILT_IN, source_of
from clamber.recording.detect import detect_contacts
from clamber.recording.recording import load_demo
from clamber.run.folder import PLAN, SEQUENCE, fallback_note, load_sequence
from clamber.show.editor import Editor
from clamber.show.page import Page
from clamber.show.renderer import seen_points
from clamber.show.sample import Run, read_run, thinned
from clamber.show.scene3d import Figure, Stage
from clamber.show.skeleton import Skeleton, beside, paired_times, skeleton_of

FOVY = 45.0  # [deg] of what has no model
PERSON_LAYER = "recording"
LAYERS = {  # name in the page: shown at first
    "planned posture": False,
    "see-through robot": False,
    "contacts": True,
    "forces": True,
    "balance": True,
    "way of the limb": True,
    PERSON_LAYER: False,
}


@checks_types
def open_view(
    source: str | Path,
    *,
    demo: str | Path | None = None,
    scene: SceneLike | None = None,
    host: str = "127.0.0.1",
    port: int = 8080,
) -> Page:
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
        recorded, missing = load_demo(source, scene=scene), []
        sequence = None
        try:
            sequence = detect_contacts(recorded)
        except ClamberError as e:
            missing.append(f"no contacts: {e}")
        page = Page(host, port, recorded.source, missing, recorded.notes)
        _show_recording(page, skeleton_of(recorded, sequence))
        return page
    return _open_run(path, demo, scene, host, port)


def _open_run(
    folder: Path, demo: str | Path | None, scene: SceneLike | None, host: str, port: int
) -> Page:
    """The page of a run folder: of its motion, else of its recording, else of words."""
    run = read_run(folder)
    sequence = None
    if run.has(SEQUENCE) or not run.written:
        sequence = run.attempt(lambda: load_sequence(folder))
    if not (run.written or run.verdict or run.execution or sequence is not None):
        raise InputError(
            f"a run folder with {PLAN} or {SEQUENCE} ({'; '.join(run.missing)})",
            source=folder,
        )
    named, skeleton = _named_recording(sequence, run) if demo is None else demo, None
    if named is not None:
        recorded = run.attempt(lambda: load_demo(named, scene=scene))
        if recorded is not None:
            if sequence is None or sequence.subject is None:
                sequence = run.attempt(lambda: detect_contacts(recorded))
            skeleton = skeleton_of(recorded, sequence)
    notes = (fallback_note(run.written), run.execution.get("stopped", ""))
    page = Page(host, port, folder.resolve().name, run.missing, notes)
    if run.plan is not None:
        _RunPage(page, run, run.plan, skeleton)
    elif skeleton is not None:
        _show_recording(page, skeleton)
    if run.written or run.verdict:
        page.add_report(folder)
    return page


def _named_recording(sequence: ContactSequence | None, run: Run) -> str | None:
    """The recording that a run names as its source, where it can be found."""
    source = run.written.get("sequence", {}).get("source", "")
    if sequence is not None:
        source = sequence.source
    for name in BUILT_IN:
        if source == source_of(name):
            return name
    return source if source and Path(source).is_file() else None


def _show_recording(page: Page, skeleton: Skeleton) -> None:
    """A recording alone."""
    figure, demo = Figure(page.server, skeleton, np.zeros(3)), skeleton.demo
    page.look(figure.seen(), float(demo.scene.start[2]), FOVY)
    page.watch(figure.show)
    page.span(float(demo.t[0]), float(demo.t[-1]), skeleton.changes())


class _RunPage:
    """What the page of a run shows at present: it, or what editing made of it."""

    def __init__(self, page: Page, run: Run, plan: Plan, skeleton: Skeleton | None):
        self._page, self._plan, self._rollout = page, plan, run.rollout
        self._layers = dict(LAYERS)
        self._count = 0
        self._figure = None
        self._put(plan, run.rollout)
        world = self._stage.motion.world
        self._points = seen_points(Kinematics(world), self._stage.motion.q)
        if skeleton is not None:
            person = thinned(skeleton.position, 60).reshape(-1, 3)
            offset = beside(world.scene, self._points, skeleton.demo.scene, person)
            self._figure = Figure(page.server, skeleton, offset)
        self._look()
        with page.layers:
            for name in LAYERS:
                if name != PERSON_LAYER or skeleton is not None:
                    self._toggle(name)
        with page.server.gui.add_folder("Edit", expand_by_default=False):
            Editor(page, run.folder, plan, self.replace)
        page.watch(self._show)
        page.span(0.0, self._stage.duration, self._stage.events())

    def replace(self, plan: Plan | None, rollout: Rollout | None) -> None:
        """Show another plan, and what physics made of it; None: the run as it was."""
        with self._page.clock.lock:
            if plan is None:
                plan, rollout = self._plan, self._rollout
            self._put(plan, rollout)
            self._page.span(0.0, self._stage.duration, self._stage.events())

    def _put(self, plan: Plan, rollout: Rollout | None) -> None:
        """Make a stage for it, in place of the one before."""
        before = self._stage if self._count else None
        self._count += 1
        self._stage = Stage(self._page.server, plan, rollout, f"/run{self._count}")
        self._paired = paired_times(plan, self._stage.reached, self._stage.duration)
        if before is not None:
            before.root.remove()

    def _toggle(self, name: str) -> None:
        """A checkbox for one of the layers."""
        clock = self._page.clock
        box = self._page.server.gui.add_checkbox(name, LAYERS[name])

        @box.on_update
        def _(_: Any) -> None:
            self._layers[name] = bool(box.value)
            clock.go(clock.t, playing=clock.playing)
            if name == PERSON_LAYER:
                self._look()

    def _look(self) -> None:
        """Have the cameras take in the robot, and the person where it is shown."""
        points, world = self._points, self._stage.motion.world
        if self._figure is not None and self._layers[PERSON_LAYER]:
            points = np.concatenate([points, self._figure.seen()])
        fovy = float(world.model.vis.global_.fovy)
        self._page.look(points, float(world.scene.start[2]), fovy)

    def _show(self, t: float) -> str:
        if self._figure is not None:
            self._figure.root.visible = self._layers[PERSON_LAYER]
            if self._layers[PERSON_LAYER]:
                self._figure.show(float(np.interp(t, *self._paired)))
        return self._stage.show(t, self._layers)
