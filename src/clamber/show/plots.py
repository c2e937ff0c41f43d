"""Figures over time of recordings and runs, and of policies.

Shapes: T samples, M recorded states, nS surfaces.
"""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyArrowPatch, FancyBboxPatch

from clamber.contact.contact import ContactSequence
from clamber.contact.learn import dominant_actions, pelvis_samples
from clamber.contact.policy import DemoPolicy, GeneralPolicy, PelvisDistribution
from clamber.model.robot import Robot
from clamber.model.scene import Scene
from clamber.planning.records import Plan
from clamber.recording.demonstration import Demonstration
from clamber.run.figures import finish_axes, save_plot
from clamber.show.sample import Motion

CYCLE_COLOURS = ("#fde68a", "#bfdbfe", "#bbf7d0", "#fecaca", "#e9d5ff")  # in order
SURFACE_COLOURS = ("#c2410c", "#1d4ed8")  # of a limb's surfaces, the outer one first


def demonstration_plot(
    demonstration: Demonstration, sequence: ContactSequence, path: str | Path
) -> Path:
    """Heights of the person's parts over time, detected contacts in bold."""
    t = demonstration.t
    tracks = {p: demonstration.point(p)[:, 2] for p in _PARTS.values() for p in p}
    contact = {
        p: [(x.t0, x.t1) for x in sequence.intervals if x.part == p] for p in tracks
    }
    fig = _height_figure(t, tracks, contact, _PARTS, sequence.scene)
    fig.suptitle(f"The person: {sequence.source}", fontsize=10)
    return save_plot(fig, path)


def contact_plot(motion: Motion, path: str | Path) -> Path:
    """Heights of the robot's surfaces, bold where they are loaded."""
    robot, names = motion.world.robot, list(motion.world.surfaces)
    tracks = {s: motion.points[:, i, 2] for i, s in enumerate(names)}
    contact = dict(zip(names, motion.loads or motion.schedule, strict=True))
    panels = _limb_panels(robot)
    fig = _height_figure(motion.time, tracks, contact, panels, motion.world.scene)
    fig.suptitle(f"{robot.name} in physics", fontsize=10)
    return save_plot(fig, path)


_PARTS = {
    "left arm": ("LHand", "LElbow"),
    "right arm": ("RHand", "RElbow"),
    "left leg": ("LFoot", "LKnee"),
    "right leg": ("RFoot", "RKnee"),
}


def _limb_panels(robot: Robot) -> dict[str, tuple[str, ...]]:
    return {n.replace("_", " "): limb.surfaces for n, limb in robot.limbs.items()}


def _height_figure(
    t: np.ndarray,
    tracks: dict[str, np.ndarray],
    contact: dict[str, list[tuple[float, float]]],
    panels: dict[str, tuple[str, ...]],
    scene: Scene,
) -> Figure:
    """One panel a limb: heights thin, contacts bold, tops of boxes dotted."""
    fig = Figure(figsize=(10, 5.4), layout="constrained")
    axes = fig.subplots(2, 2, sharex=True, sharey=True).ravel().tolist()
    for ax, (limb, surfaces) in zip(axes, panels.items(), strict=True):
        for top in scene.tops:
            ax.axhline(top.position[2], color="0.45", ls=":", lw=1)
        ax.axhline(0.0, color="0.45", ls=":", lw=1)
        for s, colour in zip(surfaces, SURFACE_COLOURS, strict=False):
            ax.plot(t, tracks[s], color=colour, lw=0.9, alpha=0.8, label=s)
            for t0, t1 in contact[s]:
                inside = (t >= t0) & (t <= t1)
                ax.plot(t[inside], tracks[s][inside], color=colour, lw=3.5)
        ax.set_title(limb, fontsize=9, loc="left")
        finish_axes(ax)
    for ax in axes[2:]:
        ax.set_xlabel("time [s]")
    for ax in axes[::2]:
        ax.set_ylabel("height [m]")
    return fig


def stability_plot(motion: Motion, asked: float, path: str | Path) -> Path:
    """Projected distances of loaded contacts with guide values, and the CoM's margin.

    Args:
        motion: Of physics, or of a plan.
        asked: CoM margin required at keyframes [m].
        path: The file.
    """
    t, margin = motion.time, motion.margin
    d, limit = (
        np.where(motion.bears, x, np.nan) for x in (motion.distance, motion.limit)
    )
    fig = Figure(figsize=(10, 7.2), layout="constrained")
    grid = fig.add_gridspec(3, 2)
    index = {s: i for i, s in enumerate(motion.world.surfaces)}
    for k, (limb, surfaces) in enumerate(_limb_panels(motion.world.robot).items()):
        ax = fig.add_subplot(grid[k // 2, k % 2])
        for s, colour in zip(surfaces, SURFACE_COLOURS, strict=False):
            ax.plot(t, d[:, index[s]], color=colour, lw=1.4, label=s)
            ax.plot(t, limit[:, index[s]], color=colour, lw=0.9, ls="--")
        top = "supported mass: shoulder" if "arm" in limb else "supported mass: hip"
        ax.set_title(f"{limb} ({top})", fontsize=9, loc="left")
        ax.set_xlim(t[0], t[-1])
        ax.set_ylim(0.0, 1.3 * max(0.1, float(np.nanmax(np.append(limit, d)))))
        ax.set_ylabel("d [m]; dashed: guide value", fontsize=8)
        finish_axes(ax)
    ax = fig.add_subplot(grid[2, :])
    ax.plot(t, margin, color="0.15", lw=1.2, label="CoM margin in the support polygon")
    ax.axhline(0.0, color="#b91c1c", lw=1, ls="--", label="its border")
    ax.axhline(asked, color="#15803d", lw=1, ls="--", label="required at keyframes")
    ax.set_xlim(t[0], t[-1])
    ax.set_xlabel("time [s]")
    ax.set_ylabel("margin [m]", fontsize=8)
    ax.set_ylim(top=1.3 * max(0.05, float(np.nanmax(np.append(margin, 0.0)))))
    finish_axes(ax)
    return save_plot(fig, path)


def cost_to_go_plot(plan: Plan, path: str | Path) -> Path:
    """Draw the distance left to the goal after each contact change, by cycle."""
    fig = Figure(figsize=(7.0, 3.2), layout="constrained")
    ax = fig.subplots()
    names = list(dict.fromkeys(i.option for i in plan.iterations))
    colours = dict(zip(names, itertools.cycle(CYCLE_COLOURS), strict=False))
    labelled = set()
    for k, i in enumerate(plan.iterations):
        label = None if i.option in labelled else i.option
        labelled.add(i.option)
        ax.axvspan(k + 0.5, k + 1.5, color=colours[i.option], lw=0, label=label)
    costs = [i.cost for i in plan.iterations]
    ax.plot(range(1, len(costs) + 1), costs, color="black", lw=1.2)
    ax.set_xlim(0.5, len(costs) + 0.5)
    ax.set_ylim(0.0, None)
    ax.set_xlabel("contact change")
    ax.set_ylabel("cost-to-go [m]")
    finish_axes(ax)
    return save_plot(fig, path)


# Policies.


COLOURS = {"G": "#bbf7d0", "M": "#fde68a", "O": "#bfdbfe", "goal": "#bbf7d0"}
MEANING = {"G": "on the ground", "M": "on both", "O": "on the obstacle"}
PER_ROW = 14  # states of the table in one row
ANGLES = ("roll", "pitch", "yaw")


def save_pictures(policy: GeneralPolicy, path: str | Path) -> list[Path]:
    """Draw a policy beside its file: `<name>.png` and `<name>-pelvis.png`."""
    path = Path(path)
    return [
        policy_plot(policy, path.with_suffix(".png")),
        pelvis_plot(policy, path.with_name(f"{path.stem}-pelvis.png")),
    ]


def policy_plot(policy: GeneralPolicy, path: str | Path) -> Path:
    """The options in order, and the states of the first demonstration behind them."""
    demo = policy.demos[0] if policy.demos else None
    rows = 0 if demo is None else math.ceil(len(demo.states) / PER_ROW)
    fig = Figure(figsize=(13, 2.4 + 0.85 * rows), layout="constrained")
    grid = fig.add_gridspec(2, 1, height_ratios=(2.2, max(0.85 * rows, 0.1)))
    _draw_options(fig.add_subplot(grid[0]), policy)
    if demo is not None:
        _draw_table(fig.add_subplot(grid[1]), demo)
    return save_plot(fig, path)


def _draw_options(ax: Axes, policy: GeneralPolicy) -> None:
    """A box for each option, with the arrow of its repetition."""
    n = len(policy.options)
    for k, option in enumerate(policy.options):
        colour = COLOURS[option.region]
        box = FancyBboxPatch(
            (k, 0.0), 0.7, 0.6, boxstyle="round,pad=0.04", fc=colour, ec="0.3"
        )
        ax.add_patch(box)
        place = "goal" if option.region == "goal" else f"$S_{option.region}$"
        ax.text(k + 0.35, 0.48, f"{option.name}   {place}", ha="center", va="center")
        half = math.ceil(len(option.surfaces) / 2)
        lines = (option.surfaces[:half], option.surfaces[half:])
        for row, line in enumerate(lines):
            y = 0.27 - 0.17 * row
            text = ", ".join(line)
            ax.text(k + 0.35, y, text, ha="center", va="center", fontsize=8)
        look = {"connectionstyle": "arc3,rad=1.0", "mutation_scale": 9}
        _arrow(ax, (k + 0.5, 0.66), (k + 0.2, 0.66), **look)
        ax.text(k + 0.35, 0.87, f"{option.repeats} times", ha="center", fontsize=7)
        if k + 1 < n:
            _arrow(ax, (k + 0.75, 0.3), (k + 0.95, 0.3))
    ax.set_xlim(-0.1, max(n, 6) - 0.15)
    ax.set_ylim(-0.1, 1.0)
    ax.set_axis_off()
    ax.set_title("general policy: cycles of contacts by region", fontsize=9, loc="left")


def _draw_table(ax: Axes, demo: DemoPolicy) -> None:
    """States as numbered circles by region, row by row; arrows bear the actions."""
    ruling = dominant_actions(demo)
    for i, state in enumerate(demo.states):
        x, y = float(i % PER_ROW), -0.8 * (i // PER_ROW)
        ax.add_patch(Circle((x, y), 0.2, fc=COLOURS[state.region], ec="0.3", lw=0.8))
        ax.text(x, y, str(i), ha="center", va="center", fontsize=7)
        if i == len(demo.actions):
            break
        _arrow(ax, (x + 0.22, y), (x + 0.78, y))
        action = demo.actions[i]
        weak = {"color": "0.55", "style": "italic"}
        look: dict[str, Any] = {} if i in ruling else weak
        text = "breaks" if action is None else action
        ax.text(x + 0.5, y + 0.1, text, ha="center", fontsize=6.5, **look)
    rows = math.ceil(len(demo.states) / PER_ROW)
    for k, (region, text) in enumerate(MEANING.items()):
        x, y = 1.6 * k, -0.8 * rows
        ax.add_patch(Circle((x, y), 0.12, fc=COLOURS[region], ec="0.3", lw=0.8))
        ax.text(x + 0.2, y, text, va="center", fontsize=7.5)
    grey = "grey: the limb is loaded through another surface, or breaks its contact"
    ax.text(1.6 * 3, -0.8 * rows, grey, va="center", fontsize=7.5, color="0.45")
    ax.set_xlim(-0.4, PER_ROW - 0.1)
    ax.set_ylim(-0.8 * rows - 0.3, 0.4)
    ax.set_aspect("equal")
    ax.set_axis_off()
    title = f"demo policy: states and actions of {demo.source}"
    ax.set_title(title, fontsize=9, loc="left")


def _arrow(
    ax: Axes, a: tuple[float, float], b: tuple[float, float], **look: Any
) -> None:
    look = {"mutation_scale": 8, "lw": 0.8, "shrinkA": 0, "shrinkB": 0, **look}
    ax.add_patch(FancyArrowPatch(a, b, arrowstyle="-|>", color="0.3", **look))


def pelvis_plot(policy: GeneralPolicy, path: str | Path) -> Path:
    """Normal distributions of roll, pitch and yaw near the edge and over the top."""
    fig = Figure(figsize=(9, 5.2), layout="constrained")
    axes = fig.subplots(3, 2, sharex=True)
    samples = [pelvis_samples(d) for d in policy.demos]
    columns = (
        ("near the edge", policy.near_edge, 1),
        ("over the top", policy.over_top, 0),
    )
    for column, (title, distribution, which) in enumerate(columns):
        seen = np.concatenate([np.zeros((0, 3)), *(s[which] for s in samples)])
        for k, name in enumerate(ANGLES):
            _draw_angle(axes[k, column], distribution, k, seen[:, k])
            axes[k, 0].set_ylabel(f"{name}: density [1/deg]", fontsize=8)
        axes[0, column].set_title(
            f"{title}, {distribution.samples} states", fontsize=9, loc="left"
        )
        axes[2, column].set_xlabel("angle [deg]", fontsize=8)
    return save_plot(fig, path)


def _draw_angle(ax: Axes, d: PelvisDistribution, k: int, seen: np.ndarray) -> None:
    """One density [1/deg], its imposed range, and the samples."""
    mean, sigma = math.degrees(d.mean[k]), math.degrees(d.sigma[k])
    imposed = d.imposed[k]
    ax.plot(np.degrees(seen), np.zeros(len(seen)), "|", color="0.5", ms=7)
    label = "no samples"
    if 0.0 < sigma < math.inf:
        grid = np.linspace(-180.0, 180.0, 361)
        near = mean + sigma * np.linspace(-5.0, 5.0, 201)
        x = np.sort(np.concatenate([grid, near]))
        y = np.exp(-0.5 * ((x - mean) / sigma) ** 2) / (sigma * math.sqrt(2 * math.pi))
        ax.plot(x, y, color="#1d4ed8", lw=1.3, ls="-" if imposed else "--")
        label = f"{round(mean)} $\\pm$ {sigma:.1f}"
    if imposed is not None:
        ax.axvspan(*np.degrees(imposed), color="#1d4ed8", alpha=0.15, lw=0)
    text = f"{label} deg, {'imposed' if imposed else 'too wide to impose'}"
    ax.text(0.02, 0.88, text, transform=ax.transAxes, fontsize=8, va="top")
    ax.set_xlim(-180.0, 180.0)
    ax.set_xticks(np.arange(-180, 181, 90))
    ax.margins(y=0.25)
    top = ax.get_ylim()[1]
    ax.set_yticks([y for y in ax.get_yticks() if 0.0 <= y <= top])
    ax.spines[["top", "right"]].set_visible(False)
    ax.tick_params(labelsize=7)
