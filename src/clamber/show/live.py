"""A run or a recording in the browser: to play, to turn, to edit.

What is only read (plots, tables, criteria) is in the report, which the page hands out.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from clamber.errors import ClamberError, InputError, MissingDependency
from clamber.execution.simulation import Rollout
from clamber.execution.verdict import Verdict
from clamber.model.arguments import checks_types
from clamber.model.terrain import SceneLike
from clamber.planning.records import Plan
from clamber.recording.built_in import BUILT_IN
from clamber.recording.detect import detect_contacts
from clamber.recording.recording import load_demo
from clamber.run.folder import PLAN, SEQUENCE, fallback_note, load_sequence
from clamber.show.chart import Chart
from clamber.show.editor import Editor
from clamber.show.framing import Preset
from clamber.show.handout import Handout
from clamber.show.page import Page, paragraphs, rows_of
from clamber.show.sample import Run, read_run, thinned
from clamber.show.scene3d import BEFORE_EDITING, Figure, Stage
from clamber.show.skeleton import (
    Skeleton,
    corners,
    paired_times,
    recording_named,
    skeleton_of,
    to_the_right,
)
from clamber.show.start import StartPage

FOVY = 45.0  # [deg] of what has no model
PERSON_LAYER = "recording"
LAYERS = {  # name in the page: shown at first
    "planned posture": False,
    "transparent robot": False,
    "contacts": True,
    "forces": True,
    "support polygon": True,
    "swing path": True,
    BEFORE_EDITING: False,
    PERSON_LAYER: False,
}


@checks_types
def open_view(
    source: str | Path | None = None,
    *,
    beside: Sequence[str | Path] = (),
    demo: str | Path | None = None,
    scene: SceneLike | None = None,
    host: str = "127.0.0.1",
    port: int = 8080,
) -> Page:
    """Serve a run, a recording, or the start page of a new climb, to the browser.

    Args:
        source: A run folder, complete or not; a recording, a `recording.yaml`, or a
            built-in demonstration by name. None: a page on which to choose recording,
            robot and scene, and to climb.
        beside: Run folders that are shown to the right of it.
        demo: The recording that is shown beside a run; by default the one that the run
            names as its source, where that is found.
        scene: The scene of a recording that has none.
        host: Address to listen on; by default this machine alone can connect.
        port: Port to listen on, or the next one that is free.

    Returns:
        The page: `url`, `missing` (a sentence for each thing that cannot be shown),
        `port`, and `close()`.

    Raises:
        MissingDependency: There is no viser.
        InputError: There is nothing to show, or no such address.
    """
    if importlib.util.find_spec("viser") is None:
        raise MissingDependency("viser", "view")
    if source is None:
        if demo is not None:
            raise InputError("a run folder: --demo goes with one", source=demo)
        page = Page(host, port)

        def opened(folder: Path) -> None:
            run = read_run(folder)
            _show_run(page, run, person=_person_of(run))

        StartPage(page, opened)
        return page
    path = Path(source)
    if str(source) not in BUILT_IN and path.is_dir():
        runs = [read_run(folder) for folder in (path, *map(Path, beside))]
        for run in runs[1:]:
            if run.plan is None:
                raise InputError(f"a run folder with a whole {PLAN}", source=run.folder)
        person = _person_of(runs[0], demo, scene)
        page = Page(host, port)
        _show_run(page, runs[0], runs[1:], person)
        return page
    if demo is not None or beside:
        raise InputError("a run folder: others, and --demo, go with one", source=source)
    recorded, missing = load_demo(source, scene=scene), []
    sequence = None
    try:
        sequence = detect_contacts(recorded)
    except ClamberError as e:
        missing.append(f"no contacts: {e}")
    page = Page(host, port)
    page.begin(recorded.source, missing, recorded.notes)
    _show_recording(page, skeleton_of(recorded, sequence))
    return page


def _person_of(
    run: Run, demo: str | Path | None = None, scene: SceneLike | None = None
) -> Skeleton | None:
    """The recording that is shown beside a run, where it is found.

    Raises:
        InputError: There is nothing to show of the run.
    """
    sequence = None
    if run.has(SEQUENCE) or not run.written:
        sequence = run.attempt(lambda: load_sequence(run.folder))
    if not (run.written or run.verdict or run.execution or sequence is not None):
        raise InputError(
            f"a run folder with {PLAN} or {SEQUENCE} ({'; '.join(run.missing)})",
            source=run.folder,
        )
    source = run.written.get("sequence", {}).get("source", "")
    if sequence is not None:
        source = sequence.source
    named = recording_named(source) if demo is None else demo
    if named is None:
        return None
    recorded = run.attempt(lambda: load_demo(named, scene=scene))
    if recorded is None:
        return None
    if sequence is None or sequence.subject is None:
        sequence = run.attempt(lambda: detect_contacts(recorded))
    return skeleton_of(recorded, sequence)


def _show_run(
    page: Page, run: Run, others: Sequence[Run] = (), person: Skeleton | None = None
) -> None:
    """The page of a run folder: its motion, else its recording, else text."""
    page.begin(run.folder.resolve().name, run.missing)
    told = _Told(page.server.gui)
    told.of_run(run.verdict)
    notes = (fallback_note(run.written), run.execution.get("stopped", ""))
    if any(notes):  # below the verdict: another plan than the demonstrated may succeed
        page.server.gui.add_html(paragraphs([n for n in notes if n]))
    if run.plan is not None:
        _RunPage(page, run, run.plan, others, person, told)
        return
    if person is not None:
        _show_recording(page, person)
    if run.written or run.verdict:
        Handout(page, run.folder, None)


def _show_recording(page: Page, skeleton: Skeleton) -> None:
    """A recording alone."""
    page.timeline()
    figure, demo = Figure(page.server, skeleton, np.zeros(3)), skeleton.demo
    page.look(figure.seen(), float(demo.scene.start[2]), FOVY)
    page.watch(figure.show)
    page.span(float(demo.t[0]), float(demo.t[-1]), skeleton.changes())


class _Told:
    """The verdict on the page: of the run, or of the edited plan."""

    def __init__(self, gui: Any) -> None:
        """Add a line, and a folder of the criteria; empty."""
        self._line = gui.add_html("", visible=False)
        self._folder = gui.add_folder(
            "Verdict: value, limit", expand_by_default=False, visible=False
        )
        with self._folder:
            self._rows = gui.add_html("")

    def of_run(self, verdict: Verdict | None) -> None:
        """Shows the verdict of the run in its folder."""
        said = "" if verdict is None else _outcome(verdict)
        self._show(said, verdict)

    def of_edited(self, verdict: Verdict | None) -> None:
        """Shows the verdict of an edited plan; None before its simulation."""
        said = "no verdict yet" if verdict is None else _outcome(verdict)
        self._show(f"edited plan: {said}", verdict)

    def _show(self, said: str, verdict: Verdict | None) -> None:
        colour = "#6b7280"
        if verdict is not None:
            colour = "#16a34a" if verdict.reached else "#dc2626"
        self._line.visible, self._folder.visible = bool(said), verdict is not None
        look = f"margin: 4px 12px; font-weight: 600; color: {colour}"
        self._line.content = f'<p style="{look}">{said}</p>'
        rows = () if verdict is None else verdict.rows()
        self._rows.content = rows_of(
            (label if ok else f"{label}: NOT MET", value, _short(limit))
            for label, value, limit, ok in rows
        )


def _short(limit: str) -> str:
    """A limit in a narrow column."""
    return limit.replace("at least ", "≥\u00a0").replace("at most ", "≤\u00a0")


def _outcome(verdict: Verdict) -> str:
    return "reached the goal" if verdict.reached else "failed"


class _RunPage:
    """The page of a run: the run itself, or its edited plan."""

    def __init__(
        self,
        page: Page,
        run: Run,
        plan: Plan,
        others: Sequence[Run],
        skeleton: Skeleton | None,
        told: _Told,
    ):
        page.timeline()
        self._told, self._verdict = told, run.verdict
        self._page, self._plan, self._rollout = page, plan, run.rollout
        self._layers = dict(LAYERS)
        self._stage = self._first = Stage(page.server, plan, run.rollout, "/run")
        self._count, self._figure, gui = 0, None, page.server.gui
        scene = self._stage.motion.world.scene
        self._points = self._stage.seen()
        self._others: list[Stage] = []
        for i, other in enumerate(others):
            assert other.plan is not None
            stage = Stage(page.server, other.plan, other.rollout, f"/other{i}")
            there = stage.motion.world.scene
            offset = to_the_right(scene, self._points, there, stage.seen())
            stage.root.position = offset
            seen = np.concatenate([stage.seen(), corners(there)]) + offset
            self._points = np.concatenate([self._points, seen])
            self._others.append(stage)
        if skeleton is not None:
            person = thinned(skeleton.position, 60).reshape(-1, 3)
            offset = to_the_right(scene, self._points, skeleton.demo.scene, person)
            self._figure = Figure(page.server, skeleton, offset)
        self._pair(plan)
        self._look()
        page.follow(lambda t: self._stage.base(t))
        with page.layers:
            hidden = set() if skeleton is not None else {PERSON_LAYER}
            for name in (n for n in LAYERS if n not in hidden):
                self._toggle(name)
        self._chart = Chart(page, lambda: self._stage.motion)
        with gui.add_folder("Edit", expand_by_default=False):
            Editor(page, run.folder, plan, self.replace)
        with gui.add_folder("Export", expand_by_default=False):
            Handout(page, run.folder, lambda: (self._plan_shown, self._rollout_shown))
        self._plan_shown, self._rollout_shown = plan, run.rollout
        if others:
            told_of = (
                f"{x.folder}: {_outcome(x.verdict) if x.verdict else 'no verdict'}"
                for x in (run, *others)
            )
            gui.add_html(paragraphs(["From the robot's left to its right:", *told_of]))
        page.watch(self._show)
        page.watch_slowly(self._chart.show)
        self._span()

    def replace(
        self, plan: Plan | None, done: tuple[Rollout, Verdict] | None = None
    ) -> None:
        """Show another plan, and what physics made of it; None: the run as it was."""
        with self._page.clock.lock:
            before = self._stage
            if plan is None:
                plan, rollout, self._stage = self._plan, self._rollout, self._first
                self._told.of_run(self._verdict)
            else:
                rollout, verdict = done or (None, None)
                self._told.of_edited(verdict)
                self._count += 1
                name = f"/run{self._count}"
                server = self._page.server
                self._stage = Stage(server, plan, rollout, name, before=self._first)
            self._plan_shown, self._rollout_shown = plan, rollout
            self._pair(plan)
            self._first.root.visible = self._stage is self._first
            if before is not self._first:
                before.root.remove()
            # First: what is sent to a plot just before it goes, the browser misses.
            self._chart.renew()
            self._span()

    def _pair(self, plan: Plan) -> None:
        """Synchronise the person with the robot."""
        if self._figure is not None:
            stage, person = self._stage, self._figure.skeleton
            self._paired = paired_times(plan, stage.reached, stage.duration, person)

    def _span(self) -> None:
        """As long as the longest of what is shown; the contacts of the first."""
        end = max(x.duration for x in (self._stage, *self._others))
        self._page.span(0.0, end, self._stage.events())

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
        camera: Preset = "behind" if self._others else "corner"
        self._page.look(points, float(world.scene.start[2]), fovy, camera)

    def _show(self, t: float) -> str:
        if self._figure is not None:
            self._figure.root.visible = self._layers[PERSON_LAYER]
            if self._layers[PERSON_LAYER]:
                self._figure.show(float(np.interp(t, *self._paired)))
        for other in self._others:
            other.show(t, self._layers)
        return self._stage.show(t, self._layers)
