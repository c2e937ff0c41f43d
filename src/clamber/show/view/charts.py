"""Tables and plots of a run as HTML: strings made once, in which a clock moves.

The clock is a style of its own, some bytes long: it sets how far along a cursor stands
and which stance is marked, for all plots and tables of the page at once. What can be
clicked carries its time and hands it to the field `go to`, as if it had been typed.
Names come from a run folder: they are escaped, every one.

Shapes: n samples.
"""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from clamber.contact.contact import PARTS, ContactSequence, Stance
from clamber.recording.demonstration import SIDES
from clamber.show.pictures import PHASE_COLOURS
from clamber.show.sample import Motion, peaks, row_at
from clamber.show.view.person import Person
from clamber.show.view.shown import Frame, Shown

GO_TO = "go to [s]"  # the field; a time after `@` is one that was clicked
CLICKED = "@"
HEIGHT, ROW = 96, 16  # [px] of a plot, and of a surface on the timeline
POINTS = 360  # of a line of a plot
BOLD_JOINTS = 4  # that come nearest to their limits
LINES = ("#2563eb", "#c2410c", "#0891b2", "#7c3aed", "#15803d", "#db2777")
LIMIT, FAINT = "#dc2626", "#94a3b8"

_SEND = (
    "for(const l of document.querySelectorAll('label')){"
    f"if(l.textContent.trim()!=='{GO_TO}')continue;"
    "let e=l;while(!e.querySelector('input'))e=e.parentElement;"
    "const i=e.querySelector('input');"
    "Object.getOwnPropertyDescriptor(HTMLInputElement.prototype,'value')"
    f".set.call(i,'{CLICKED}'+t);"
    "i.dispatchEvent(new Event('input',{bubbles:true}));break}"
)
ON_ROW = (
    "const r=event.target.closest('[data-t]');if(r){const t=r.dataset.t;" + _SEND + "}"
)
ON_CHART = (
    "if(event.type==='click'||event.buttons){"
    "const b=this.getBoundingClientRect(),d=this.dataset,t=(+d.begin+"
    "(d.end-d.begin)*Math.min(1,Math.max(0,(event.clientX-b.left)/b.width))"
    ").toFixed(2);" + _SEND + "}"
)

STYLE = """<style>
.clamber { --rule: #e2e6eb; --dim: #5b6675; --soft: #dbe7ff; --bad: #b91c1c;
  --good: #15803d; --warn: #92400e; font-size: 12px; line-height: 1.4;
  margin: 0 16px 8px 10px; color: var(--mantine-color-text); }
[data-mantine-color-scheme=dark] .clamber { --rule: #3a414c; --dim: #98a3b3;
  --soft: #1e3a5f; --bad: #f87171; --good: #4ade80; --warn: #fbbf24; }
.clamber h4 { margin: 10px 0 2px; font-size: 12px; font-weight: 600; }
.clamber p { margin: 2px 0; }
.clamber .dim { color: var(--dim); } .clamber .bad { color: var(--bad); }
.clamber .good { color: var(--good); } .clamber .warn { color: var(--warn); }
.clamber .facts { display: flex; gap: 14px; margin-top: 4px; }
.clamber .facts p { flex: 1; min-width: 0; white-space: nowrap; }
.clamber .facts span { display: block; font-size: 11px; overflow: hidden;
  text-overflow: ellipsis; }
.clamber b { font-weight: 600; font-variant-numeric: tabular-nums; }
.clamber table { width: 100%; border-collapse: collapse;
  font-variant-numeric: tabular-nums; }
.clamber th { color: var(--dim); font-weight: 500; text-align: right; }
.clamber td { text-align: right; padding: 1px 0 1px 6px; }
.clamber th:first-child, .clamber td:first-child { text-align: left; }
.clamber [data-t] { cursor: pointer; }
.clamber tbody[data-t]:hover, .clamber-now { background: var(--soft); }
.clamber .wide td { vertical-align: top; }
.clamber .wide td:last-child { white-space: nowrap; }
.clamber tbody { border-top: 1px solid var(--rule); }
.clamber .move td { font-weight: 600; padding-top: 4px; text-align: left; }
.clamber .never { opacity: 0.55; }
.clamber i.dot { display: inline-block; width: 8px; height: 8px; margin-right: 5px;
  border-radius: 50%; }
.clamber .plot { position: relative; margin-left: 34px; cursor: ew-resize;
  touch-action: pan-y; border-left: 1px solid var(--rule);
  border-bottom: 1px solid var(--rule); }
.clamber .plot svg { display: block; width: 100%; height: 100%; }
.clamber .plot::after { content: ""; position: absolute; top: 0; bottom: 0;
  left: var(--clamber-at, 0%); border-left: 1.5px solid #2563eb;
  pointer-events: none; }
.clamber .plot path { fill: none; stroke-width: 1.4; stroke-linejoin: round;
  vector-effect: non-scaling-stroke; }
.clamber .plot path.area { stroke: none; opacity: 0.25; }
.clamber .plot line { stroke: var(--rule); vector-effect: non-scaling-stroke; }
.clamber .plot line.limit { stroke-dasharray: 5 4; stroke-width: 1.2; }
.clamber .plot span { position: absolute; right: 100%; margin-right: 4px;
  transform: translateY(-50%); color: var(--dim); font-size: 10px; }
.clamber .key span { margin-right: 10px; white-space: nowrap; }
.clamber .key i:not(.dot) { display: inline-block; width: 11px; height: 3px;
  margin-right: 4px; vertical-align: middle; }
/* On a phone the panel is a sheet at the bottom: over all of the width, and lower. */
@media (max-width: 36em) { [style*="width: 20em"] { width: 100% !important; }
  .mantine-Paper-root[style*="width: 20em"] { max-height: 52% !important; } }
</style>"""


def escaped(x: object) -> str:
    """Text that is no markup."""
    return html.escape(str(x))


def block(*parts: str) -> str:
    """Parts of the page in its own style."""
    return f'<div class="clamber">{"".join(parts)}</div>'


def clock(shown: Shown, frame: Frame) -> str:
    """Where the cursors stand, which stance is marked, and the figures of the time."""
    share = 100 * min(1.0, frame.time / shown.duration) if shown.duration else 0.0
    stance = shown.stances[frame.stance]
    now = f"keyframe {frame.row}" if shown.motion.stills else f"{frame.time:.2f} s"
    facts = []
    if math.isfinite(frame.margin):
        facts.append(("CoM margin", f"{1000 * frame.margin:.0f} mm"))
    m = shown.motion
    row = row_at(m.time, frame.time)
    if m.effort is not None:
        j = int(np.abs(m.effort[row]).argmax())
        name = escaped(m.world.joints[j])
        facts.append((f"torque, {name}", f"{100 * abs(m.effort[row, j]):.0f} %"))
    if m.error is not None:
        facts.append(("tracking", f"{1000 * m.error[row, 0]:.0f} mrad"))
    return (
        f"<style>:root{{--clamber-at:{share:.2f}%}}"
        f".clamber-s{frame.stance}{{background:var(--soft)}}</style>"
        + block(
            f"<p><b>{now}</b> of {shown.duration:.1f} s &middot; "
            f"{escaped(stance['move'])}</p>",
            '<div class="facts">',
            *(f"<p><span class=dim>{what}</span><b>{x}</b></p>" for what, x in facts),
            "</div>",
        )
    )


def notes(missing: Sequence[str], *more: str) -> str:
    """What cannot be shown, and what else there is to say; nothing where nothing is."""
    parts = [f'<p class="warn">{escaped(text)}</p>' for text in missing]
    parts += [f"<p>{escaped(text)}</p>" for text in more if text]
    return block(*parts) if parts else ""


def legend() -> str:
    """What the colours of contacts mean."""
    parts = [
        f'<span><i class="dot" style="background:rgb{colour}"></i>{name}</span> '
        for name, colour in PHASE_COLOURS.items()
    ]
    return block(f'<p class="key dim">{"".join(parts)}</p>')


def stance_table(stances: Sequence[Mapping[str, Any]]) -> str:
    """The stances of a plan (`stance_rows`), a click on one of which goes there."""
    bodies = []
    for i, s in enumerate(stances):
        t = s["time"]
        go = "" if t is None else f' data-t="{t:.3f}"'
        when = "never" if t is None else f"{t:.1f} s"
        push = f"{s['margin']:.2f}" + (f" ({s['limiting']})" if s["limiting"] else "")
        com = s["com_margin"]
        rows = [
            f'<tr class="move"><td colspan="4">{i} &middot; {escaped(s["move"])}</td>'
            f'<td style="text-align:right">{when}</td></tr>'
        ]
        for c in s["contacts"]:
            force = c["force"]
            size = "-" if force is None else f"{np.linalg.norm(force):.0f}"
            colour = PHASE_COLOURS.get(c["phase"], (100, 116, 139))
            rows.append(
                f'<tr title="{escaped(c["phase"])}"><td>'
                f'<i class="dot" style="background:rgb{colour}"></i>'
                f"{escaped(c['surface'])} on {escaped(c['support'])}</td>"
                f"<td>{1000 * c['projected_distance']:.0f}</td>"
                f"<td>{math.degrees(c['contact_angle']):.0f}</td><td>{size}</td>"
                "<td></td></tr>"
            )
        rows.append(
            f'<tr class="dim"><td colspan="5">CoM margin '
            f"{'-' if com is None else f'{1000 * com:.0f} mm'}, holds a push of "
            f"{escaped(push)} weights</td></tr>"
        )
        lost = "" if t is not None else " never"
        bodies.append(
            f'<tbody class="clamber-s{i}{lost}"{go} data-stance="{i}">'
            f"{''.join(rows)}</tbody>"
        )
    head = (
        "<thead><tr><th>surface</th><th>d mm</th><th>angle &deg;</th><th>force N</th>"
        "<th></th></tr></thead>"
    )
    return block(f'<table onclick="{escaped(ON_ROW)}">{head}{"".join(bodies)}</table>')


def verdict_table(verdict: Mapping[str, Any]) -> str:
    """Reached or not, and by which figures; of the fields of `verdict.json`."""
    if not verdict:
        return block('<p class="dim">planned, not run in physics</p>')
    reached = bool(verdict["reached"])
    word = "reached the goal" if reached else "did not make it"
    rows = "".join(
        f'<tr class="{"" if c["ok"] else "bad"}"><td>{escaped(name)}</td>'
        f"<td>{_neat(c['value'])}</td><td>{_neat(c['limit'])}</td></tr>"
        for name, c in verdict["criteria"].items()
    )
    head = "<thead><tr><th>criterion</th><th>value</th><th>limit</th></tr></thead>"
    return block(
        f'<p class="{"good" if reached else "bad"}"><b>{word}</b></p>',
        f"<table>{head}<tbody>{rows}</tbody></table>",
    )


def _neat(x: float | None) -> str:
    return "-" if x is None else f"{x:.4g}"


# Plots.


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Line:
    """A line of a plot: values (n,), NaN where there is none."""

    name: str
    values: np.ndarray
    colour: str = LINES[0]
    area: bool = False


def plots(shown: Shown) -> str:
    """Contacts, torques, balance and tracking of a run over time."""
    m = shown.motion
    if m.stills:
        return block('<p class="dim">No motion, no plots.</p>')
    ran = m.loads is not None
    parts = [timeline(m.time, list(m.world.surfaces), m.schedule, m.loads)]
    if m.effort is not None:
        parts.append(_torques(m, m.effort))
    margin = 1e3 * m.margin
    lines = [Line(name="measured" if ran else "planned", values=margin)]
    if m.planned_margin is not None:
        planned = 1e3 * m.planned_margin
        lines.append(Line(name="planned", values=planned, colour=FAINT))
    asked = 1e3 * shown.plan.options.keyframe.balance_margin
    limits = {f"asked of keyframes ({asked:.0f} mm)": asked}
    title = "Centre of mass inside its support [mm]"
    parts.append(plot(title, m.time, lines, limits))
    if m.error is not None:
        tracking = [
            Line(name=name, values=1e3 * m.error[:, k], colour=LINES[c])
            for k, c, name in (
                (0, 0, "largest joint [mrad]"),
                (1, 2, "rms [mrad]"),
                (2, 1, "pelvis [mm]"),
            )
        ]
        parts.append(plot("Tracking error", m.time, tracking, {}))
    return block(*parts)


def _torques(m: Motion, effort: np.ndarray) -> str:
    """Joint torques as shares of their limits: the largest ones, and all others."""
    share = 100 * np.abs(effort)
    order = np.argsort(-share.max(axis=0), kind="stable")
    bold, rest = order[:BOLD_JOINTS], order[BOLD_JOINTS:]
    lines = []
    if len(rest):
        others = share[:, rest].max(axis=1)
        lines.append(Line(name="others", values=others, colour=FAINT, area=True))
    for j, colour in zip(bold, LINES, strict=False):
        name = f"{m.world.joints[j]} ({m.world.tau_max[j]:g} N m)"
        lines.append(Line(name=name, values=share[:, j], colour=colour))
    return plot("Joint torque [% of its limit]", m.time, lines, {"limit": 100.0})


def _chart(time: np.ndarray, height: int, shapes: str, ticks: str) -> str:
    """A strip over time that scrubs."""
    on = escaped(ON_CHART)
    return (
        f'<div class="plot" data-begin="{time[0]:.3f}" data-end="{time[-1]:.3f}"'
        f' style="height:{height}px" onclick="{on}" onpointermove="{on}">'
        f'<svg viewBox="0 0 1000 {height}" preserveAspectRatio="none">{shapes}</svg>'
        f"{ticks}</div>"
    )


def _along(time: np.ndarray, t: float | np.ndarray) -> float | np.ndarray:
    """Where a time is on a strip, from 0 to 1000."""
    return 1000 * (t - time[0]) / max(float(time[-1] - time[0]), 1e-9)


def timeline(
    time: np.ndarray,
    names: Sequence[str],
    planned: Sequence[Sequence[tuple[float, float]]],
    loads: Sequence[Sequence[tuple[float, float]]] | None,
) -> str:
    """When each surface is in contact: planned (thin) and in physics (bold).

    Args:
        time: (n,) of which the ends count [s].
        names: Of the surfaces.
        planned: From when to when, for each [s].
        loads: In physics; None where the planned ones are all there is.
    """
    shapes, labels = [], []
    for j, name in enumerate(names):
        y, colour = j * ROW, LINES[j % len(LINES)]
        labels.append(f'<span style="top:{y + ROW / 2}px">{escaped(name)}</span>')
        shapes.append(f'<line x1="0" x2="1000" y1="{y + ROW}" y2="{y + ROW}"/>')
        bars = [(planned[j], 4, 8, colour)]
        if loads is not None:
            bars = [(planned[j], 2, 3, FAINT), (loads[j], 6, 8, colour)]
        for spans, top, thick, fill in bars:
            for a, b in spans:
                x, end = _along(time, a), _along(time, b)
                shapes.append(
                    f'<rect x="{x:.1f}" y="{y + top}" height="{thick}"'
                    f' width="{max(0.6, end - x):.1f}" fill="{fill}"/>'
                )
    note = "" if loads is None else ' <span class="dim">thin: planned, bold: loaded'
    title = f"<h4>Contacts{note}</span></h4>" if note else "<h4>Contacts</h4>"
    height = ROW * max(1, len(names))
    return title + _chart(time, height, "".join(shapes), "".join(labels))


def plot(
    title: str, time: np.ndarray, lines: Sequence[Line], limits: Mapping[str, float]
) -> str:
    """A plot with its legend.

    Args:
        title: With the unit.
        time: (n,) [s].
        lines: What is plotted.
        limits: Dashed lines by name.
    """
    rows = np.unique(np.linspace(0, len(time) - 1, POINTS).round().astype(int))
    drawn = [_reduced(line.values, rows) for line in lines]
    known = np.concatenate([*drawn, [0.0], [*limits.values()]])
    known = known[np.isfinite(known)]
    low, high = float(known.min()), float(known.max())
    high = high + 0.06 * (high - low) if high > low else low + 1.0

    def y(v: float) -> float:
        return HEIGHT * (high - v) / (high - low)

    shapes, ticks = [], []
    for v in _ticks(low, high):
        shapes.append(f'<line x1="0" x2="1000" y1="{y(v):.1f}" y2="{y(v):.1f}"/>')
        ticks.append(f'<span style="top:{100 * y(v) / HEIGHT:.1f}%">{v:g}</span>')
    x = np.asarray(_along(time, time[rows]))
    for line, values in zip(lines, drawn, strict=True):
        text = _path(x, values, y)
        if line.area and text:
            text = f"M0 {y(0):.1f}L{text[1:]}L1000 {y(0):.1f}Z"
            style = f'class="area" style="fill:{line.colour}"'
        else:
            style = f'stroke="{line.colour}"'
        shapes.append(f'<path {style} d="{text}"/>')
    keys = [_key(line.name, line.colour) for line in lines]
    for name, v in limits.items():
        at = f'y1="{y(v):.1f}" y2="{y(v):.1f}"'
        shapes.append(
            f'<line class="limit" x1="0" x2="1000" {at} style="stroke:{LIMIT}"/>'
        )
        keys.append(_key(name, LIMIT))
    legend = f'<p class="key dim">{"".join(keys)}</p>'
    chart = _chart(time, HEIGHT, "".join(shapes), "".join(ticks))
    return f"<h4>{escaped(title)}</h4>{legend}{chart}"


def _key(name: str, colour: str) -> str:
    return f'<span><i style="background:{colour}"></i>{escaped(name)}</span> '


def _path(x: np.ndarray, values: np.ndarray, y: Callable[[float], float]) -> str:
    """Lines through the values, broken where there are none."""
    parts, pen = [], False
    for at, v in zip(x, values, strict=True):
        if math.isfinite(v):
            parts.append(f"{'L' if pen else 'M'}{at:.1f} {y(v):.1f}")
        pen = math.isfinite(v)
    return "".join(parts)


def _reduced(values: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Values at some rows, each the largest in size up to the next."""
    known = np.where(np.isfinite(values), values, 0.0)[:, None]
    out = peaks(known, rows)[:, 0]
    out[~np.isfinite(values[rows])] = math.nan
    return out


def _ticks(low: float, high: float) -> list[float]:
    rough = (high - low) / 3
    power = 10.0 ** math.floor(math.log10(rough))
    size = next(x * power for x in (1, 2, 5, 10) if x * power >= rough)
    first = math.ceil(low / size)
    return [k * size for k in range(first, math.floor(high / size) + 1)]


# A recording.


def recording_clock(person: Person, t: float) -> str:
    """Where the cursors stand, and which stance is marked."""
    times = person.demo.t
    stance, text = -1, ""
    if person.sequence is not None:
        stance = int(np.searchsorted(person.sequence.t, t + 1e-6, side="right")) - 1
        stance = min(stance, len(person.sequence.stances) - 1)
        if stance >= 0:
            text = _resting(person.sequence.stances[stance])
    return (
        f"<style>:root{{--clamber-at:{_along(times, t) / 10:.2f}%}}"
        f".clamber-s{stance}{{background:var(--soft)}}</style>"
        + block(f"<p><b>{t:.2f} s</b></p>", f'<p class="dim">{escaped(text)}</p>')
    )


def _resting(stance: Stance) -> str:
    """Which surfaces are on what."""
    on = ", ".join(f"{c.surface} on {c.support}" for c in stance.contacts)
    return on or "in the air"


def sequence_table(sequence: ContactSequence, *, jumps: bool) -> str:
    """The stances of a sequence.

    Args:
        sequence: As detected.
        jumps: Its times are those of the page: a click goes there.
    """
    bodies = []
    for i, stance in enumerate(sequence.stances):
        t = float(sequence.t[i])
        go = f' data-t="{t:.3f}"' if jumps else ""
        bodies.append(
            f'<tbody class="clamber-s{i}"{go} data-stance="{i}"><tr><td>{i}</td>'
            f'<td style="text-align:left">{escaped(_resting(stance))}</td>'
            f"<td>{t:.1f} s</td></tr></tbody>"
        )
    on = escaped(ON_ROW)
    return block(f'<table class="wide" onclick="{on}">{"".join(bodies)}</table>')


def recording_plots(person: Person) -> str:
    """When each part of a person is in contact, and how high it is."""
    demo, sequence = person.demo, person.sequence
    parts = [p for p in PARTS if p in demo.names]
    out = []
    if sequence is not None:
        spans = [
            [(x.t0, x.t1) for x in sequence.intervals if x.part == p] for p in parts
        ]
        out.append(timeline(demo.t, parts, spans, None))
    for kind in ("Hand", "Elbow", "Knee", "Foot"):
        lines = []
        for side, colour in zip(SIDES, LINES, strict=False):
            height = demo.point(side + kind)[:, 2].copy()
            height[~demo.valid[:, demo.names.index(side + kind)]] = math.nan
            lines.append(Line(name=side + kind, values=height, colour=colour))
        tops = {b.name: float(b.top.position[2]) for b in demo.scene.boxes[:3]}
        out.append(plot(f"Height of the {kind.lower()}s [m]", demo.t, lines, tops))
    return block(*out)
