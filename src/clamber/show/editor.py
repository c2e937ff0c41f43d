"""The panel that edits a plan: contacts to drag, surfaces to leave out, plan again."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from clamber.errors import ClamberError
from clamber.execution.simulation import Rollout, simulate
from clamber.execution.verdict import Verdict, judge
from clamber.model.se3 import quat_from_matrix
from clamber.planning.records import Plan
from clamber.show.edits import (
    INSET,
    Edits,
    Interval,
    intervals_of,
    plan_edited,
    save_edited,
)
from clamber.show.page import Page, paragraphs

GIZMO = 0.22  # [m]
NOTHING = "none"


class Editor:
    """Contacts to drag, surfaces to switch off, and what becomes of the plan."""

    def __init__(
        self,
        page: Page,
        folder: Path,
        plan: Plan,
        replaced: Callable[[Plan | None, Rollout | None], None],
    ) -> None:
        """Fill the folder of the panel that is open.

        Args:
            page: To edit on.
            folder: Of the run; what is saved goes into it.
            plan: To edit.
            replaced: Told of a new plan, and of what physics made of it; of None, where
                all is undone.
        """
        self._folder, self._plan, self._replaced = folder, plan, replaced
        self._intervals = intervals_of(plan)
        self._edits = Edits()
        self._new: Plan | None = None
        self._done: tuple[Rollout, Verdict] | None = None
        self._busy = threading.Lock()
        gui = page.server.gui
        if plan.state is not None:
            text = "The rest of a climb is not edited: edit the plan of the whole one."
            gui.add_html(paragraphs([text]))
            return
        stances = plan.sequence.stances
        surfaces = [
            s for s in plan.world.surfaces if any(s in x.surfaces for x in stances)
        ]
        names = (NOTHING, *(x.name for x in self._intervals))
        self._choice = gui.add_dropdown("move", names)
        self._use = {s: gui.add_checkbox(f"use {s}", True) for s in surfaces}
        self._buttons = {
            "Re-plan": self._plan_again,
            "Simulate": self._run_physics,
            "Save": self._save,
            "Undo all": self._forget,
        }
        self._handles = {n: gui.add_button(n) for n in self._buttons}
        self._progress = gui.add_progress_bar(0.0, visible=False)
        self._said = gui.add_html("")
        self._gizmo = page.server.scene.add_transform_controls(
            "/edit/contact",
            scale=GIZMO,
            active_axes=(True, True, False),
            disable_rotations=True,
            depth_test=False,
            visible=False,
        )
        self._choice.on_update(lambda _: self._choose())
        self._gizmo.on_update(self._dragged)
        for box in self._use.values():
            box.on_update(lambda _: self._switched())
        for name, job in self._buttons.items():
            self._handles[name].on_click(lambda _, job=job: self._work(job))
        self._enable()

    def _chosen(self) -> tuple[int, Interval] | None:
        named = enumerate(self._intervals)
        return next((x for x in named if x[1].name == self._choice.value), None)

    def _choose(self) -> None:
        """Put the gizmo on the contact that is chosen."""
        chosen = self._chosen()
        self._gizmo.visible = chosen is not None
        if chosen is not None:
            index, interval = chosen
            support = self._plan.world.supports[interval.contact.support]
            self._gizmo.wxyz = quat_from_matrix(support.rotation)
            self._gizmo.position = self._edits.moved.get(index, interval.planned)

    def _dragged(self, event: Any) -> None:
        """Keep the contact on its support."""
        chosen = self._chosen()
        if chosen is None:
            return
        index, interval = chosen
        support = self._plan.world.supports[interval.contact.support]
        place = support.nearest(np.array(self._gizmo.position), INSET)
        self._edits = replace(self._edits, moved={**self._edits.moved, index: place})
        if event.phase == "end":
            self._gizmo.position = place
            self._tell()

    def _switched(self) -> None:
        """Surfaces that are not to be used."""
        off = frozenset(s for s, box in self._use.items() if not box.value)
        self._edits = replace(self._edits, off=off)
        self._tell()

    def _tell(self, *more: str) -> None:
        """What is edited, and what came of it."""
        said = [
            f"{self._intervals[i].name}: moved by "
            f"{1000 * np.linalg.norm(p - self._intervals[i].planned):.0f} mm"
            for i, p in self._edits.moved.items()
        ]
        if self._edits.off:
            said.append(f"without {', '.join(sorted(self._edits.off))}")
        self._said.content = paragraphs([*said, *more])
        self._enable()

    def _enable(self) -> None:
        """The buttons of what can be done now."""
        busy, new = self._busy.locked(), self._new
        self._handles["Re-plan"].disabled = busy
        self._handles["Simulate"].disabled = (
            busy or new is None or new.trajectory is None
        )
        self._handles["Save"].disabled = busy or new is None
        self._handles["Undo all"].disabled = busy or not (self._edits or new)

    def _work(self, job: Callable[[], str]) -> None:
        """Do one thing at a time; what goes wrong is said, not thrown."""
        if not self._busy.acquire(blocking=False):
            return
        self._enable()
        try:
            said = job()
        except (ClamberError, OSError) as e:
            said = str(e)
        self._busy.release()
        self._progress.visible = False
        self._tell(said)

    def _report(self, stage: str, share: float, note: str) -> None:
        self._progress.visible = True
        self._progress.value = 100.0 * min(max(share, 0.0), 1.0)
        self._said.content = paragraphs([f"{stage}: {note}" if note else stage])

    def _plan_again(self) -> str:
        self._new = plan = plan_edited(self._plan, self._edits, self._report)
        self._done = None
        self._replaced(plan, None)
        if plan.complete:
            return f"Planned to the last stance: {len(plan.changes)} changes."
        return f"No plan to the last stance: {plan.why_not}"

    def _run_physics(self) -> str:
        assert self._new is not None
        rollout = simulate(self._new, progress=self._report)
        verdict = judge(self._new, rollout)
        self._done = (rollout, verdict)
        self._replaced(self._new, rollout)
        failed = [n for n, c in verdict.criteria.items() if not c.ok]
        if verdict.reached:
            return "Physics: the robot made it."
        return f"Physics: it did not make it ({', '.join(failed)})."

    def _save(self) -> str:
        assert self._new is not None
        return f"Saved as {save_edited(self._folder, self._new, self._done)}"

    def _forget(self) -> str:
        self._edits, self._new, self._done = Edits(), None, None
        self._choice.value = NOTHING
        for box in self._use.values():
            box.value = True
        self._replaced(None, None)
        return ""
