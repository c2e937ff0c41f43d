"""Editing a plan on its page: contacts to drag, surfaces to leave out, plan again.

Edits are made to the sequence of a plan, which is in the robot's scene and at its
scale; it is planned again as ever.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from clamber.contact.contact import Contact, ContactSequence
from clamber.contact.steps import same_place
from clamber.errors import ClamberError
from clamber.execution.simulation import Rollout, simulate
from clamber.execution.verdict import Verdict, judge
from clamber.model.records import short_repr
from clamber.model.se3 import quat_from_matrix
from clamber.planning import planner
from clamber.planning.records import Plan, Progress
from clamber.planning.substitutes import without_surfaces
from clamber.run.folder import (
    SEQUENCE,
    next_free_folder,
    save_plan,
    save_rollout,
    save_sequence,
    save_verdict,
)
from clamber.show.page import Page, paragraphs

INSET = 0.01  # [m] a contact that is dragged stays so far inside its support
FOLDER = "edited"  # in the run folder
GIZMO = 0.22  # [m]
NOTHING = "none"


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Interval:
    """A contact over the stances of a sequence that hold it.

    Attributes:
        contact: As the sequence has it.
        first, last: Its first stance, and the one after its last.
        planned: (3,) where the plan makes it [m], which optimises what it is shown.
    """

    contact: Contact
    first: int
    last: int
    planned: np.ndarray

    __repr__ = short_repr


def intervals_of(plan: Plan) -> dict[str, Interval]:
    """The contacts of a plan's sequence that can be moved: those made on the way.

    By a name for people, in order.
    """
    stances = plan.sequence.stances
    planned = {
        (c.step.stance, x.surface): x.position
        for c in plan.changes
        if c.step.index is not None
        for x in c.keyframe.stance
    }
    found = []
    for surface in plan.world.surfaces:
        before = None
        for i, stance in enumerate(stances):
            c = stance.contact(surface)
            if c is not None and i > 0 and not (before and same_place(before, c)):
                last = i + 1
                while last < len(stances):
                    d = stances[last].contact(surface)
                    if d is None or not same_place(c, d):
                        break
                    last += 1
                place = planned.get((i, surface), c.position)
                found.append(Interval(contact=c, first=i, last=last, planned=place))
            before = c
    found.sort(key=lambda x: x.first)
    return {f"{_on(x.contact)}, stance {x.first}": x for x in found}


def _on(c: Contact) -> str:
    return f"{c.surface} on {c.support}"


def edited_sequence(
    plan: Plan, moved: Mapping[str, np.ndarray], off: Collection[str]
) -> ContactSequence:
    """The sequence of a plan with contacts moved and surfaces left out.

    Args:
        plan: It.
        moved: Places (3,) of contacts by the names of their intervals [m].
        off: Surfaces that are not to be used.
    """
    intervals, stances = intervals_of(plan), list(plan.sequence.stances)
    for name, place in moved.items():
        x = intervals[name]
        on = plan.world.supports[x.contact.support].nearest(place, INSET)
        contact = replace(x.contact, position=on, fixed=True)
        for i in range(x.first, x.last):
            kept = (
                contact if c.surface == contact.surface else c
                for c in stances[i].contacts
            )
            stances[i] = replace(stances[i], contacts=tuple(kept))
    sequence = replace(plan.sequence, stances=tuple(stances))
    return without_surfaces(sequence, off)


def plan_edited(
    plan: Plan,
    moved: Mapping[str, np.ndarray],
    off: Collection[str],
    progress: Progress | None = None,
) -> Plan:
    """Plan again, with contacts moved and surfaces left out as in `edited_sequence`.

    Raises:
        InputError: The scene does not fit what is left of the sequence.
    """
    sequence, world = edited_sequence(plan, moved, off), plan.world
    return planner.plan(
        sequence,
        world.robot,
        world.scene,
        options=plan.options,
        contacts="demonstrated",
        progress=progress,
    )


def save_edited(
    folder: Path, plan: Plan, done: tuple[Rollout, Verdict] | None = None
) -> Path:
    """Save a plan, and what physics made of it, as a run of its own.

    Args:
        folder: The run folder: `edited` in it, or `edited-2` ... where that exists.
        plan: It.
        done: Rollout and verdict, where it has been simulated.

    Raises:
        OSError: It cannot be written.
    """
    out = next_free_folder(folder, FOLDER)
    save_sequence(plan.sequence, out / SEQUENCE)
    save_plan(plan, out)
    if done is not None:
        save_rollout(plan, done[0], out)
        save_verdict(done[1], out)
    return out


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
        self._moved: dict[str, np.ndarray] = {}
        self._off: frozenset[str] = frozenset()
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
        self._choice = gui.add_dropdown("move", (NOTHING, *self._intervals))
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

    def _choose(self) -> None:
        """Put the gizmo on the contact that is chosen."""
        name = str(self._choice.value)
        self._gizmo.visible = name != NOTHING
        if name != NOTHING:
            x = self._intervals[name]
            support = self._plan.world.supports[x.contact.support]
            self._gizmo.wxyz = quat_from_matrix(support.rotation)
            self._gizmo.position = self._moved.get(name, x.planned)

    def _dragged(self, event: Any) -> None:
        """Keep the contact on its support."""
        name = str(self._choice.value)
        if name == NOTHING:
            return
        support = self._plan.world.supports[self._intervals[name].contact.support]
        place = support.nearest(np.array(self._gizmo.position), INSET)
        self._moved[name] = place
        if event.phase == "end":
            self._gizmo.position = place
            self._tell()

    def _switched(self) -> None:
        """Surfaces that are not to be used."""
        self._off = frozenset(s for s, box in self._use.items() if not box.value)
        self._tell()

    def _tell(self, *more: str) -> None:
        """What is edited, and what came of it."""
        off = {n: p - self._intervals[n].planned for n, p in self._moved.items()}
        said = [
            f"{n}: moved by {1000 * np.linalg.norm(d):.0f} mm" for n, d in off.items()
        ]
        if self._off:
            said.append(f"without {', '.join(sorted(self._off))}")
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
        self._handles["Undo all"].disabled = busy or not (
            self._moved or self._off or new
        )

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
        self._new = plan = plan_edited(self._plan, self._moved, self._off, self._report)
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
            return "Physics: success."
        return f"Physics: failed ({', '.join(failed)})."

    def _save(self) -> str:
        assert self._new is not None
        return f"Saved as {save_edited(self._folder, self._new, self._done)}"

    def _forget(self) -> str:
        self._moved, self._off = {}, frozenset()
        self._new = self._done = None
        self._choice.value = NOTHING
        for box in self._use.values():
            box.value = True
        self._replaced(None, None)
        return ""
