"""A run on the page: robot and person on one clock, and a sequence to edit."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from clamber.contact.contact import ContactSequence
from clamber.errors import ClamberError
from clamber.execution.simulation import Rollout, simulate
from clamber.execution.verdict import Verdict, judge
from clamber.model.kinematics import Kinematics
from clamber.model.se3 import quat_from_matrix
from clamber.planning.records import Plan
from clamber.recording.demonstration import Demonstration
from clamber.run.folder import verdict_fields
from clamber.show.renderer import seen_points
from clamber.show.sample import Run
from clamber.show.view import charts
from clamber.show.view.edits import (
    Edits,
    Spell,
    clamped,
    plan_edited,
    save_edited,
    spells_of,
)
from clamber.show.view.page import Page, views_of
from clamber.show.view.person import Person, beside, figure_at, show_person
from clamber.show.view.shown import Shown, frame_at, person_times, show_run
from clamber.show.view.stage import LAYERS, RECORDING, Stage, Stick

GIZMO = 0.22  # [m]
NOTHING = "none"
Recorded = tuple[Demonstration, ContactSequence | None]


def run_page(
    run: Run, shown: Shown, recorded: Recorded | None, host: str, port: int
) -> Page:
    """Serve a run.

    Args:
        run: What could be read of its folder.
        shown: What is to be seen of it.
        recorded: The recording beside it, and what was detected in it; None without.
        host: To listen on.
        port: From which on a free one is taken.
    """
    page = Page(host, port, run.folder.resolve().name)
    page.missing = run.missing
    world = shown.world
    points = seen_points(Kinematics(world), shown.q)
    notes = (run.written.get("instead", ""), run.execution.get("stopped", ""))
    page.server.gui.add_html(charts.notes(run.missing, *notes))
    _RunView(page, run, shown, points, _beside(shown, points, recorded))
    return page


def _beside(
    shown: Shown, points: np.ndarray, recorded: Recorded | None
) -> Person | None:
    """The recording, at the robot's side."""
    if recorded is None:
        return None
    demo, sequence = recorded
    person = demo.position[:: max(1, len(demo.t) // 60)].reshape(-1, 3)
    offset = beside(shown.world.scene, points, demo.scene, person)
    return show_person(demo, sequence, offset)


class _RunView:
    """What the page shows at present: the run, or what editing has made of it."""

    def __init__(
        self,
        page: Page,
        run: Run,
        shown: Shown,
        points: np.ndarray,
        person: Person | None,
    ) -> None:
        self._page, self._run, self._first = page, run, shown
        self._points = points
        self._layers = dict(LAYERS)
        self._count = 0
        self._shown = shown
        self._stick = None
        self._person = person
        if person is not None:
            self._stick = Stick(page.server, person, "/person")
            self._stick.root.visible = self._layers[RECORDING]
        self._look()
        self._put(shown)
        self._panel(shown)
        page.on_fine(lambda client, on: self._stage.fine(client, on))
        page.watch(self._show)
        page.watch(self._show_figures, panel=True)
        page.span(0.0, shown.duration, shown.events())

    def _put(self, shown: Shown) -> None:
        """Make a stage for it, in place of the one before."""
        if self._count:
            for client in self._page.fine:
                self._stage.fine(client, False)
            self._stage.root.remove()
        self._count += 1
        self._shown, self._kin = shown, Kinematics(shown.world)
        self._stage = Stage(self._page.server, shown, f"/run{self._count}")
        for name, on in self._layers.items():
            self._stage.layer(name, on)
        for client in self._page.fine:
            self._stage.fine(client, True)
        self._times = person_times(shown)

    def _look(self) -> None:
        """Have the cameras take in the robot, and the person where it is shown."""
        points = self._points
        if self._person is not None and self._layers[RECORDING]:
            person = self._person.position[:: len(self._person.position) // 60 + 1]
            points = np.concatenate([points, person.reshape(-1, 3)])
        world = self._shown.world
        fovy = float(world.model.vis.global_.fovy)
        self._page.look(views_of(points, float(world.scene.start[2]), fovy))

    def _show(self, t: float) -> None:
        self._frame = frame_at(self._shown, self._kin, t)
        self._stage.show(self._frame)
        if self._stick is not None and self._person is not None:
            on = self._layers[RECORDING]
            self._stick.root.visible = on
            if on:
                at = float(np.interp(t, *self._times))
                self._stick.show(figure_at(self._person, at))

    def _show_figures(self, _: float) -> None:
        self._page.head.content = charts.clock(self._shown, self._frame)

    def _panel(self, shown: Shown) -> None:
        gui = self._page.server.gui
        tabs = gui.add_tab_group()
        with tabs.add_tab("Stances"):
            gui.add_html(charts.legend())
            self._stances = gui.add_html("")
            self._verdict = gui.add_html("")
        with tabs.add_tab("Plots"):
            self._plots = gui.add_html("")
        with tabs.add_tab("Edit"):
            _Editor(self._page, self._run, shown.plan, self._replace)
        with tabs.add_tab("Show"):
            self._page.add_cameras()
            for name in LAYERS:
                if name == RECORDING and self._person is None:
                    continue
                self._toggle(name)
        self._fill(shown, self._run.verdict)

    def _toggle(self, name: str) -> None:
        """A checkbox for one of the layers."""
        box = self._page.server.gui.add_checkbox(name, self._layers[name])

        @box.on_update
        def _(event: Any) -> None:
            clock = self._page.clock
            with clock.lock:
                self._layers[name] = bool(box.value)
                self._stage.layer(name, bool(box.value))
                clock.go(clock.t)
            if name == RECORDING:
                self._look()
                if event.client is not None:
                    self._page.point(event.client, "corner")

    def _fill(self, shown: Shown, verdict: Any) -> None:
        """Tables and plots."""
        self._stances.content = charts.stance_table(shown.stances)
        self._verdict.content = charts.verdict_table(verdict)
        self._plots.content = charts.plots(shown)

    def _replace(self, made: Plan | None, done: tuple[Rollout, Verdict] | None) -> None:
        """Show another plan, and what physics made of it; None: the run as it was."""
        shown, verdict = self._first, self._run.verdict
        if made is not None:
            shown = show_run(made, None if done is None else done[0])
            verdict = {} if done is None else verdict_fields(done[1])
        with self._page.clock.lock:
            self._put(shown)
            self._fill(shown, verdict)
            self._page.span(0.0, shown.duration, shown.events())


class _Editor:
    """Contacts to drag, surfaces to switch off, and what becomes of the plan."""

    def __init__(
        self,
        page: Page,
        run: Run,
        made: Plan,
        replaced: Callable[[Plan | None, tuple[Rollout, Verdict] | None], None],
    ) -> None:
        self._page, self._run, self._made, self._replaced = page, run, made, replaced
        self._spells = spells_of(made)
        self._edits = Edits()
        self._new: Plan | None = None
        self._done: tuple[Rollout, Verdict] | None = None
        self._busy = threading.Lock()
        gui = page.server.gui
        if made.midway is not None:
            text = "The rest of a climb is not edited: edit the plan of the whole one."
            gui.add_html(charts.notes((), text))
            return
        surfaces = [
            s
            for s in made.world.surfaces
            if any(s in x.surfaces for x in made.sequence.stances)
        ]
        self._choice = gui.add_dropdown(
            "move", (NOTHING, *(s.name for s in self._spells))
        )
        self._use = {s: gui.add_checkbox(f"use {s}", True) for s in surfaces}
        self._replan = gui.add_button("Re-plan")
        self._simulate = gui.add_button("Simulate", disabled=True)
        self._save = gui.add_button("Save", disabled=True)
        self._undo = gui.add_button("Undo all", disabled=True)
        self._progress = gui.add_progress_bar(0.0, visible=False)
        self._said = gui.add_html("")
        add = page.server.scene
        self._gizmo = add.add_transform_controls(
            "/edit/contact",
            GIZMO,
            active_axes=(True, True, False),
            disable_rotations=True,
            depth_test=False,
            visible=False,
        )
        self._choice.on_update(lambda _: self._choose())
        self._gizmo.on_update(self._dragged)
        for box in self._use.values():
            box.on_update(lambda _: self._switched())
        self._replan.on_click(lambda _: self._work(self._plan_again))
        self._simulate.on_click(lambda _: self._work(self._run_physics))
        self._save.on_click(lambda _: self._work(self._write))
        self._undo.on_click(lambda _: self._work(self._forget))

    def _spell(self) -> tuple[int, Spell] | None:
        """The contact that is chosen."""
        chosen = str(self._choice.value)
        named = (x for x in enumerate(self._spells) if x[1].name == chosen)
        return next(named, None)

    def _choose(self) -> None:
        """Put the gizmo on the contact that is chosen."""
        chosen = self._spell()
        self._gizmo.visible = chosen is not None
        if chosen is None:
            return
        index, spell = chosen
        support = self._made.world.supports[spell.contact.support]
        self._gizmo.wxyz = quat_from_matrix(support.rotation)
        self._gizmo.position = self._edits.moved.get(index, spell.planned)

    def _dragged(self, event: Any) -> None:
        """Keep the contact on its support."""
        chosen = self._spell()
        if chosen is None:
            return
        index, spell = chosen
        self._page.moves()
        support = self._made.world.supports[spell.contact.support]
        place = clamped(support, np.array(self._gizmo.position))
        self._edits = replace(self._edits, moved={**self._edits.moved, index: place})
        if event.phase == "end":
            self._gizmo.position = place
            self._tell()

    def _switched(self) -> None:
        """Surfaces that are not to be used."""
        off = frozenset(s for s, box in self._use.items() if not box.value)
        self._edits = replace(self._edits, off=off)
        self._tell()

    def _tell(self, *more: str, wrong: str = "") -> None:
        """What is edited, and what came of it."""
        spells = self._spells
        said = [
            f"{spells[i].name}: moved by "
            f"{1000 * np.linalg.norm(p - spells[i].planned):.0f} mm"
            for i, p in self._edits.moved.items()
        ]
        if self._edits.off:
            said.append(f"without {', '.join(sorted(self._edits.off))}")
        self._said.content = charts.notes((wrong,) if wrong else (), *said, *more)
        self._undo.disabled = not self._edits

    def _work(self, job: Callable[[], None]) -> None:
        """Do one thing at a time; what goes wrong is said, not thrown."""
        if not self._busy.acquire(blocking=False):
            return
        buttons = (self._replan, self._simulate, self._save, self._undo)
        before = [b.disabled for b in buttons]
        for b in buttons:
            b.disabled = True
        try:
            job()
        except (ClamberError, OSError) as e:
            self._tell(wrong=str(e))
        finally:
            for b, was in zip(buttons, before, strict=True):
                b.disabled = was
            self._simulate.disabled = self._new is None or self._new.trajectory is None
            self._save.disabled = self._new is None
            self._undo.disabled = not self._edits and self._new is None
            self._progress.visible = False
            self._busy.release()

    def _report(self, stage: str, share: float, note: str) -> None:
        self._progress.visible = True
        self._progress.value = 100.0 * min(max(share, 0.0), 1.0)
        self._said.content = charts.notes((), f"{stage}: {note}" if note else stage)

    def _plan_again(self) -> None:
        made = plan_edited(self._made, self._edits, self._report)
        self._new, self._done = made, None
        self._replaced(made, None)
        if made.complete:
            self._tell(f"Planned to the last stance: {len(made.paths)} moves.")
        else:
            missed = [s.reason for s in made.skipped if s.missed] or ["no move in it"]
            self._tell(wrong=f"No plan to the last stance: {missed[0]}")

    def _run_physics(self) -> None:
        made = self._new
        if made is None or made.trajectory is None:
            return
        rollout = simulate(made, progress=self._report)
        self._done = (rollout, judge(made, rollout))
        self._replaced(made, self._done)
        verdict = self._done[1]
        failed = [n for n, c in verdict.criteria.items() if not c.ok]
        if verdict.reached:
            self._tell("Physics: the robot made it.")
        else:
            self._tell(wrong=f"Physics: it did not make it ({', '.join(failed)}).")

    def _write(self) -> None:
        if self._new is not None:
            out = save_edited(self._run.folder, self._new, self._done)
            self._tell(f"Saved as {out}")

    def _forget(self) -> None:
        self._edits, self._new, self._done = Edits(), None, None
        self._choice.value = NOTHING
        for box in self._use.values():
            box.value = True
        self._replaced(None, None)
        self._tell()
