"""A record as a cell of a notebook shows it: a line, a picture, a table.

A picture that cannot be drawn, for want of OpenGL, is left out.
"""

from __future__ import annotations

import base64
import html as markup
import io
import shutil
import tempfile
import weakref
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from PIL import Image

from clamber.contact.contact import PARTS, ContactSequence
from clamber.errors import ClamberError, InputError
from clamber.execution.simulation import Rollout
from clamber.execution.verdict import Verdict, judge
from clamber.model.kinematics import Kinematics
from clamber.model.world import World
from clamber.planning.records import Plan
from clamber.recording.demonstration import Demonstration
from clamber.run.figures import finish_axes
from clamber.run.folder import save_plan, save_rollout, save_verdict
from clamber.show.framing import seen_points, view_of
from clamber.show.live import open_view
from clamber.show.page import Page
from clamber.show.renderer import Camera
from clamber.show.skeleton import skeleton_of
from clamber.step.robust import robust_margin

TILE = (220, 220)  # [px] of a posture
TILES = 4
DPI = 80
ROWS = 40  # of a table; the middle of a longer one is left out
BONE, BOX = "#1d4ed8", "#cbd5e1"


def html(record: object) -> str:
    """HTML of a record for a notebook."""
    if isinstance(record, Demonstration):
        line, rows, picture = _demonstration(record)
    elif isinstance(record, ContactSequence):
        line, rows, picture = _sequence(record)
    elif isinstance(record, Plan):
        line, rows, picture = _plan(record)
    elif isinstance(record, Rollout):
        line, rows, picture = _rollout(record)
    else:
        assert isinstance(record, Verdict)
        line, rows, picture = _verdict(record)
    parts = [f"<p>{markup.escape(line)}</p>", _img(picture), _table(rows)]
    return f"<div>{''.join(parts)}</div>"


def view(record: Plan | Rollout, plan: Plan | None = None) -> Page:
    """A plan or a rollout as a page in the browser, from a folder of its own."""
    rollout = record if isinstance(record, Rollout) else None
    made = record if isinstance(record, Plan) else record.plan or plan
    if made is None:
        raise InputError("its plan: rollout.show(plan), or open_view(folder)", "show()")
    folder = Path(tempfile.mkdtemp(prefix="clamber-"))
    save_plan(made, folder)
    if rollout is not None:
        save_rollout(made, rollout, folder)
        save_verdict(judge(made, rollout), folder)
    page = open_view(folder)
    weakref.finalize(page, shutil.rmtree, folder, ignore_errors=True)
    return page


_Cell = tuple[str, list[list[str]], bytes | None]


def _demonstration(demo: Demonstration) -> _Cell:
    gaps = sum(not g.filled for g in demo.gaps)
    lengths = ", ".join(f"{n} {x:.2f} m" for n, x in demo.subject.items())
    rows = [
        ["points", str(len(demo.names))],
        ["rate", f"{demo.rate:.4g} Hz"],
        ["boxes", ", ".join(b.name for b in demo.scene.boxes) or "none"],
        ["segment lengths", lengths],
        ["gaps", f"{len(demo.gaps) - gaps} filled, {gaps} left open"],
        *(["note", n] for n in demo.notes),
    ]
    line = f"Demonstration: {demo.source}, {demo.t[-1] - demo.t[0]:.1f} s"
    return line, [["", ""], *rows], _figures(demo)


def _figures(demo: Demonstration) -> bytes:
    """The person from the side, at times evenly spaced, and the boxes."""
    skeleton = skeleton_of(demo, None)
    times = np.linspace(demo.t[0], demo.t[-1], TILES + 2)
    top = float(demo.position[demo.valid][:, 2].max()) + 0.05
    fig = Figure(figsize=(9, 1.9), layout="constrained", dpi=DPI)
    for ax, t in zip(fig.subplots(1, len(times), sharey=True), times, strict=True):
        for box in demo.scene.boxes:
            (x, _, z), (dx, _, dz) = box.centre, box.size
            corner = (x - dx / 2, z - dz / 2)
            ax.add_patch(Rectangle(corner, dx, dz, color=BOX))
        points, seen = skeleton.at(float(t))
        for a, b in skeleton.bones[seen[skeleton.bones].all(axis=1)]:
            ax.plot(*points[[a, b]][:, [0, 2]].T, color=BONE, lw=1.6)
        ax.axhline(0.0, color="0.6", lw=0.8)
        middle = float(np.mean(points[seen][:, 0]))
        ax.set(xlim=(middle - 1.0, middle + 1.0), ylim=(-0.05, top), aspect="equal")
        ax.set_title(f"{t:.1f} s", fontsize=8)
        ax.set_axis_off()
    return _png(fig)


def _sequence(sequence: ContactSequence) -> _Cell:
    rows = [["stance", "region", "from [s]", "to [s]", "contacts"]]
    for i, stance in enumerate(sequence.stances):
        on = ", ".join(f"{c.surface} on {c.support}" for c in stance.contacts)
        times = (f"{t:.2f}" for t in sequence.t[i : i + 2])
        rows.append([str(i), stance.region, *times, on])
    line = f"Contact sequence: {sequence.source}, {len(sequence.stances)} stances"
    return line, rows, _schedule(sequence)


def _schedule(sequence: ContactSequence) -> bytes:
    """Picture of contacts over time, by surface."""
    found = {c.surface for s in sequence.stances for c in s.contacts}
    surfaces = [p for p in PARTS if p in found] + sorted(found - set(PARTS))
    supports = dict.fromkeys(c.support for s in sequence.stances for c in s.contacts)
    fig = Figure(figsize=(9, 0.6 + 0.24 * len(surfaces)), layout="constrained", dpi=DPI)
    ax = fig.subplots()
    for k, support in enumerate(supports):
        spells = [
            (surfaces.index(c.surface), sequence.t[i], sequence.t[i + 1])
            for i, s in enumerate(sequence.stances)
            for c in s.contacts
            if c.support == support
        ]
        at, begin, end = np.array(spells).T
        ax.barh(at, end - begin, left=begin, height=0.7, color=f"C{k}", label=support)
    ax.set_yticks(range(len(surfaces)), surfaces)
    ax.invert_yaxis()
    ax.set_xlabel("time [s]", fontsize=8)
    finish_axes(ax)
    return _png(fig)


def _plan(plan: Plan) -> _Cell:
    rows = [["", "change", "CoM margin [mm]", "robust [mm]", "push margin [m g]"]]
    kin = Kinematics(plan.world)
    for i, (key, held) in enumerate(zip(plan.keyframes, plan.equilibria, strict=True)):
        step = "start" if i == 0 else str(plan.changes[i - 1].step)
        margin = f"{held.margin:.2f}"
        robust = f"{1000 * robust_margin(kin, key.q, key.stance):.0f}"
        rows.append([str(i), step, f"{1000 * key.com_margin:.0f}", robust, margin])
    end = "complete" if plan.complete else f"incomplete: {plan.why_not}"
    seconds = 0.0 if plan.trajectory is None else plan.trajectory.time[-1]
    line = f"Plan: {len(plan.changes)} contact changes in {seconds:.1f} s, {end}"
    return line, rows, _strip(plan.world, [k.q for k in plan.keyframes])


def _rollout(rollout: Rollout) -> _Cell:
    rows = [["at [s]", "event"], *([f"{e.time:.2f}", str(e)] for e in rollout.events)]
    end = "fell" if rollout.fell else rollout.stopped or "ran to its end"
    line = f"Rollout: {rollout.time[-1]:.1f} s of physics, {end}"
    return line, rows, _strip(rollout.world, rollout.qpos)


def _verdict(verdict: Verdict) -> _Cell:
    rows = [["criterion", "value", "limit", ""]]
    rows += [[*row, "ok" if ok else "NO"] for *row, ok in verdict.rows()]
    line = "Verdict: " + ("reached" if verdict.reached else "not reached")
    return line, rows, _bars(verdict)


def _bars(verdict: Verdict) -> bytes:
    """Each value as a share of its limit."""
    names = [f.label for f in verdict.criteria]
    shares = [
        c.value / c.limit if c.limit else c.value for c in verdict.criteria.values()
    ]
    colours = ["#16a34a" if c.ok else "#dc2626" for c in verdict.criteria.values()]
    fig = Figure(figsize=(7, 0.5 + 0.22 * len(names)), layout="constrained", dpi=DPI)
    ax = fig.subplots()
    ax.barh(names, np.minimum(shares, 2.0), color=colours, height=0.7)
    ax.axvline(1.0, color="0.2", lw=1)
    ax.invert_yaxis()
    ax.set_xlabel("share of the limit", fontsize=8)
    ax.tick_params(labelsize=8)
    ax.spines[["top", "right"]].set_visible(False)
    return _png(fig)


def _strip(world: World, postures: Sequence[np.ndarray] | np.ndarray) -> bytes | None:
    """Some of the postures beside each other, first and last among them."""
    which = np.unique(np.linspace(0, len(postures) - 1, TILES).round().astype(int))
    chosen = [postures[i] for i in which]
    strip = Image.new("RGB", (TILE[0] * len(chosen), TILE[1]))
    try:
        with Camera(world, TILE) as camera:
            seen = seen_points(Kinematics(world), np.array(chosen))
            look = view_of(world, seen, TILE[0] / TILE[1])
            for k, q in enumerate(chosen):
                strip.paste(camera.shot(q, look), (k * TILE[0], 0))
    except ClamberError:
        return None
    data = io.BytesIO()
    strip.save(data, "PNG", optimize=True)
    return data.getvalue()


def _png(fig: Figure) -> bytes:
    data = io.BytesIO()
    fig.savefig(data, format="png", metadata={"Software": None})
    return data.getvalue()


def _img(png: bytes | None) -> str:
    if png is None:
        return ""
    text = base64.b64encode(png).decode()
    return f'<img alt="" src="data:image/png;base64,{text}">'


def _table(rows: list[list[str]]) -> str:
    """A table with a head; of a long one, both ends."""
    head, body = rows[0], rows[1:]
    if len(body) > ROWS:
        gap = [["..."] * len(head)]
        body = body[: ROWS // 2] + gap + body[-ROWS // 2 :]

    def line(cells: list[str], tag: str) -> str:
        inside = "".join(f"<{tag}>{markup.escape(c)}</{tag}>" for c in cells)
        return f"<tr>{inside}</tr>"

    top = f"<thead>{line(head, 'th')}</thead>" if any(head) else ""
    return f"<table>{top}<tbody>{''.join(line(r, 'td') for r in body)}</tbody></table>"
