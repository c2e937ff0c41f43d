"""Editing a plan on its page: contacts to drag, surfaces to leave out, plan again.

Edits are made to the sequence of a plan, which is in the robot's scene and at its
scale; it is planned again as ever.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from clamber.contact.contact import Contact, ContactSequence
from clamber.contact.steps import same_place
from clamber.execution.simulation import Rollout, simulate
from clamber.execution.verdict import Verdict, judge
from clamber.model.progress import Progress
from clamber.model.records import short_repr
from clamber.model.scene import Box, Scene
from clamber.model.se3 import quat_from_matrix
from clamber.planning import planner
from clamber.planning.records import Plan
from clamber.planning.substitutes import without_surfaces
from clamber.run.folder import (
    SEQUENCE,
    next_free_folder,
    save_plan,
    save_rollout,
    save_sequence,
    save_verdict,
)
from clamber.show.page import Page, Work, paragraphs
from clamber.show.scene3d import ALIKE, GHOST, GHOST_OPACITY
from clamber.show.track import EXECUTION, PLANNING

INSET = 0.01  # [m] a contact that is dragged stays so far inside its support
FOLDER = "edited"  # in the run folder
GIZMO = 0.22  # [m]
BESIDE = 0.05  # [m] from a box that stands where a contact is moved to
NOTHING, BOX = "none", "obstacle "  # what is moved


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Edits:
    """All edits of a plan; each undo step is such a record.

    Attributes:
        moved: Support and place (3,) [m] of contacts, by the names of their intervals.
        off: Surfaces that are not to be used.
        boxes: Boxes that are elsewhere, or of another size, by name.
    """

    moved: Mapping[str, tuple[str, np.ndarray]] = field(default_factory=dict)
    off: frozenset[str] = frozenset()
    boxes: Mapping[str, Box] = field(default_factory=dict)

    __repr__ = short_repr

    def __bool__(self) -> bool:
        """Whether there are any."""
        return bool(self.moved or self.off or self.boxes)


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
    """The contacts of a plan's sequence that can be moved: those made after the start.

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


def edited_sequence(plan: Plan, edits: Edits) -> ContactSequence:
    """The sequence of a plan with contacts moved and surfaces left out."""
    intervals, stances = intervals_of(plan), list(plan.sequence.stances)
    for name, (support, place) in edits.moved.items():
        x = intervals[name]
        on = plan.world.supports[support].nearest(place, INSET)
        contact = replace(x.contact, support=support, position=on, fixed=True)
        for i in range(x.first, x.last):
            kept = (
                contact if c.surface == contact.surface else c
                for c in stances[i].contacts
            )
            stances[i] = replace(stances[i], contacts=tuple(kept))
    sequence = replace(plan.sequence, stances=tuple(stances))
    return without_surfaces(sequence, edits.off)


def edited_scene(plan: Plan, edits: Edits) -> Scene:
    """The scene of a plan with boxes moved; contacts on them go with them."""
    scene = plan.world.scene
    boxes = tuple(edits.boxes.get(b.name, b) for b in scene.boxes)
    return replace(scene, boxes=boxes)


def plan_edited(plan: Plan, edits: Edits, progress: Progress | None = None) -> Plan:
    """Plan again, with the edits made.

    Raises:
        InputError: The scene does not fit what is left of the sequence.
    """
    return planner.plan(
        edited_sequence(plan, edits),
        plan.world.robot,
        edited_scene(plan, edits),
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
    """Contacts and boxes to move, surfaces to switch off; plan and simulate again."""

    def __init__(
        self,
        page: Page,
        folder: Path,
        plan: Plan,
        replaced: Callable[[Plan | None, tuple[Rollout, Verdict] | None], None],
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
        self._edits, self._before = Edits(), list[Edits]()
        self._new: Plan | None = None
        self._done: tuple[Rollout, Verdict] | None = None
        self._came_of_it = ""
        gui = page.server.gui
        if plan.state is not None:
            text = "The rest of a climb is not edited: edit the plan of the whole one."
            gui.add_html(paragraphs([text]))
            return
        stances = plan.sequence.stances
        surfaces = [
            s for s in plan.world.surfaces if any(s in x.surfaces for x in stances)
        ]
        boxes = [f"{BOX}{b.name}" for b in plan.world.scene.boxes]
        self._choice = gui.add_dropdown("move", (NOTHING, *self._intervals, *boxes))
        supports = tuple(plan.world.supports)
        self._onto = gui.add_dropdown("onto", supports, visible=False)
        self._height = gui.add_number(
            "height [m]", 0.3, min=0.01, step=0.005, visible=False
        )
        buttons: dict[str, tuple[Callable[[], str], *tuple[str, ...]]] = {
            "Re-plan": (self._plan_again, *PLANNING[:2]),
            "Simulate": (self._run_physics, *EXECUTION[:1]),
            "Save": (self._save, *EXECUTION[1:]),
            "Undo": (self._undo,),
            "Undo all": (self._forget,),
        }
        self._handles = {n: gui.add_button(n) for n in buttons}
        self._work = Work(gui, self._tell)
        with gui.add_folder("Surfaces", expand_by_default=False):
            self._use = {s: gui.add_checkbox(f"use {s}", True) for s in surfaces}
        self._gizmo = page.server.scene.add_transform_controls(
            "/edit/contact",
            scale=GIZMO,
            active_axes=(True, True, False),
            disable_rotations=True,
            depth_test=False,
            visible=False,
        )
        self._box = page.server.scene.add_box(
            "/edit/box", color=GHOST, opacity=GHOST_OPACITY, visible=False
        )
        self._choice.on_update(lambda _: self._choose())
        self._gizmo.on_update(self._dragged)
        self._onto.on_update(lambda _: self._moved_onto())
        self._height.on_update(lambda _: self._resized())
        for surface, box in self._use.items():
            box.on_update(lambda _, s=surface: self._switched(s))
        for name, job in buttons.items():
            self._handles[name].on_click(lambda _, job=job: self._do(*job))
        self._tell()

    # What is chosen, and where it is.

    def _chosen(self) -> tuple[str, Box | None]:
        """The name that is chosen; the box as it is by now, where it is one."""
        name = str(self._choice.value)
        if not name.startswith(BOX):
            return name, None
        own = name.removeprefix(BOX)
        boxes = {b.name: b for b in edited_scene(self._plan, self._edits).boxes}
        return own, boxes[own]

    def _place(self, name: str) -> tuple[str, np.ndarray]:
        """Support and place (3,) of a contact by now [m]."""
        x = self._intervals[name]
        return self._edits.moved.get(name, (x.contact.support, x.planned))

    def _choose(self) -> None:
        """Put the gizmo on what is chosen, and show what can be done with it."""
        name, box = self._chosen()
        contact = box is None and name != NOTHING
        self._onto.visible, self._height.visible = contact, box is not None
        self._gizmo.visible, self._box.visible = name != NOTHING, box is not None
        if box is not None:
            self._gizmo.wxyz = quat_from_matrix(box.rotation)
            self._gizmo.position = box.top.position
            self._height.value = round(float(box.size[2]), 3)
            self._box.dimensions = tuple((box.size + ALIKE).tolist())
            self._box.position, self._box.wxyz = box.centre, self._gizmo.wxyz
        elif contact:
            support, place = self._place(name)
            rotation = self._plan.world.supports[support].rotation
            self._gizmo.wxyz = quat_from_matrix(rotation)
            self._gizmo.position, self._onto.value = place, support

    # Edits; what the page was only told is no edit.

    def _edit(self, **changed: Any) -> None:
        """One step, which can be undone."""
        self._before.append(self._edits)
        self._edits = replace(self._edits, **changed)
        self._came_of_it = ""
        self._tell()

    def _put_contact(self, name: str, support: str, place: np.ndarray) -> None:
        """On its support, as near as that can be."""
        on = self._plan.world.supports[support].nearest(place, INSET)
        self._edit(moved={**self._edits.moved, name: (support, on)})
        self._choose()

    def _dragged(self, event: Any) -> None:
        """A contact stays on its support, a box on the ground."""
        name, box = self._chosen()
        if event.phase != "end" or name == NOTHING:
            return
        place = np.array(self._gizmo.position)
        if box is None:
            self._put_contact(name, self._place(name)[0], place)
        else:
            at = box.centre + (place - box.top.position) * [1.0, 1.0, 0.0]
            self._put_box(replace(box, centre=at))

    def _moved_onto(self) -> None:
        """A contact goes to the nearest place of another support, under no box."""
        name, box = self._chosen()
        support = str(self._onto.value)
        if box is not None or name == NOTHING:
            return
        before, place = self._place(name)
        if support != before:
            on = self._plan.world.supports[support]
            for other in edited_scene(self._plan, self._edits).boxes:
                top = other.top
                if top.inside(place) and top.level(place) > on.level(place):
                    edge = top.edge_towards(place)
                    place = edge.point - BESIDE * np.array([*edge.inward, 0.0])
            self._put_contact(name, support, place)

    def _resized(self) -> None:
        """A box of another height stands where it stood."""
        _, box = self._chosen()
        if box is None or abs(self._height.value - box.size[2]) < ALIKE:
            return
        size = np.array([*box.size[:2], float(self._height.value)])
        up = (size[2] - box.size[2]) / 2 * box.rotation[:, 2]
        self._put_box(replace(box, size=size, centre=box.centre + up))

    def _put_box(self, box: Box) -> None:
        self._edit(boxes={**self._edits.boxes, box.name: box})
        self._choose()

    def _switched(self, surface: str) -> None:
        """A surface is to be used, or not."""
        off = self._edits.off - {surface}
        if not self._use[surface].value:
            off |= {surface}
        if off != self._edits.off:
            self._edit(off=off)

    def _undo(self) -> str:
        """The last edit."""
        if self._before:
            self._return_to(self._before.pop())
        return ""

    def _return_to(self, edits: Edits) -> None:
        self._edits = edits
        for surface, box in self._use.items():
            box.value = surface not in edits.off
        self._choose()

    # What is said and done.

    def _tell(self) -> None:
        """Show the edits, the result, and which buttons can be pressed."""
        said = []
        for name, (support, place) in self._edits.moved.items():
            x = self._intervals[name]
            off = 1000 * np.linalg.norm(place - x.planned)
            onto = "" if support == x.contact.support else f" onto {support}"
            said.append(f"{name}: moved by {off:.0f} mm{onto}")
        was = {b.name: b for b in self._plan.world.scene.boxes}
        for name, box in self._edits.boxes.items():
            off = 1000 * np.linalg.norm((box.centre - was[name].centre)[:2])
            said.append(f"{name}: {box.size[2]:.3f} m high, moved by {off:.0f} mm")
        if self._edits.off:
            said.append(f"without {', '.join(sorted(self._edits.off))}")
        self._work.say(*said, self._came_of_it)
        busy, new = self._work.busy, self._new
        can = {
            "Re-plan": True,
            "Simulate": new is not None and new.trajectory is not None,
            "Save": new is not None,
            "Undo": bool(self._before),
            "Undo all": bool(self._edits or new),
        }
        for name, possible in can.items():
            self._handles[name].disabled = busy or not possible

    def _do(self, job: Callable[[], str], *stages: str) -> None:
        self._came_of_it = self._work.do(job, *stages)
        self._tell()

    def _plan_again(self) -> str:
        self._new = plan = plan_edited(self._plan, self._edits, self._work.report)
        self._done = None
        self._replaced(plan, None)
        if plan.complete:
            return f"Planned to the last stance: {len(plan.changes)} changes."
        return f"No plan to the last stance: {plan.why_not}"

    def _run_physics(self) -> str:
        assert self._new is not None
        rollout = simulate(self._new, progress=self._work.report)
        verdict = judge(self._new, rollout)
        self._done = (rollout, verdict)
        self._replaced(self._new, self._done)
        if verdict.reached:
            return "Physics: success."
        return f"Physics: failed; not met: {verdict.failed()}."

    def _save(self) -> str:
        assert self._new is not None
        return f"Saved as {save_edited(self._folder, self._new, self._done)}"

    def _forget(self) -> str:
        self._before, self._new, self._done = [], None, None
        self._choice.value = NOTHING
        self._return_to(Edits())
        self._replaced(None, None)
        return ""
