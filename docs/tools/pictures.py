"""Draw the picture of each stage of the method, from one climb: `make pictures`.

python docs/tools/pictures.py docs/stages
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, Polygon, Rectangle

import clamber
from clamber.execution.terrain import fitted_box
from clamber.model.kinematics import Kinematics
from clamber.run.figures import finish_axes, save_plot
from clamber.show.framing import seen_points, view_of
from clamber.show.pictures import mark_keyframe
from clamber.show.renderer import Camera
from clamber.step.polygon import support_ellipse, support_polygon
from clamber.step.posture import STABILITY_WEIGHT

mpl.rcParams.update({"font.size": 9, "axes.titlesize": 9, "savefig.dpi": 110})

BLUE, RED, GREEN, GREY = "#1d4ed8", "#b91c1c", "#15803d", "0.55"
LIMBS = (("LHand", BLUE), ("LElbow", GREEN), ("LKnee", RED), ("LFoot", "0.2"))
BONES = (
    *(("Shoulder", "Elbow"), ("Elbow", "Hand"), ("Hip", "Knee"), ("Knee", "Foot")),
    ("Foot", "Foot.toe"),
)


def cost_shapes() -> Figure:
    """Cost of one contact along x: the norm, and weighted with w = 5 (4.25)."""
    x = np.linspace(-0.5, 0.5, 401)
    fig = Figure(figsize=(6, 3.6), layout="constrained")
    ax = fig.subplots()
    ax.plot(
        x, STABILITY_WEIGHT * np.abs(x), color="#1d4ed8", label="weighted norm, w = 5"
    )
    ax.plot(x, np.abs(x), color="#b91c1c", label="norm")
    ax.plot(
        x,
        STABILITY_WEIGHT * x**2,
        color="0.4",
        ls="--",
        lw=1,
        label="w times its square",
    )
    ax.set_xlabel("contact against the projection of its supported mass, x [m]")
    ax.set_ylabel("cost")
    finish_axes(ax)
    ax.legend(fontsize=8, frameon=False, loc="upper center")
    return fig


def detection(demo, sequence) -> Figure:
    """Height of the left hand over its support, its speed, and the contact found."""
    fig = Figure(figsize=(7, 3.6), layout="constrained")
    high, fast = fig.subplots(2, 1, sharex=True)
    p = demo.point("LHand")
    top = demo.scene.boxes[0].top.position[2]
    high.plot(demo.t, 1000 * (p[:, 2] - top), color=BLUE, lw=1.2, label="left hand")
    window = np.ones(41) / 41  # [samples] at 120 Hz: the noise would drown the speed
    smooth = np.array([np.convolve(x, window, mode="valid") for x in p.T]).T
    t = demo.t[20:-20]
    speed = np.linalg.norm(np.gradient(smooth, t, axis=0), axis=1)
    fast.plot(t, speed, color=BLUE, lw=1.2, label="left hand")
    for ax in (high, fast):
        for k, x in enumerate(i for i in sequence.intervals if i.part == "LHand"):
            name = "contact found" if k == 0 else None
            ax.axvspan(x.t0, x.t1, color=GREEN, alpha=0.18, lw=0, label=name)
        finish_axes(ax)
    high.axhline(0, color=GREY, ls=":", lw=1)
    high.set_ylabel("over the box [mm]")
    fast.set_ylabel("speed [m/s]")
    fast.set_xlabel("time [s]")
    return fig


def scaling(demo, sequence, plan) -> Figure:
    """The synthetic figure on its box, and the contacts on the robot's."""
    fig = Figure(figsize=(7, 3.2), layout="constrained")
    person, robot = fig.subplots(1, 2, sharey=True)
    k = int(np.searchsorted(demo.t, 0.5 * (sequence.t[-2] + sequence.t[-1])))
    frames = ((0, "0.75"), (k, "0.25"))
    for row, colour in frames:
        for side in "LR":
            for a, b in BONES:
                ends = np.array([demo.point(side + x)[row] for x in (a, b)])
                person.plot(ends[:, 0], ends[:, 2], color=colour, lw=2)
        trunk = [
            (demo.point("L" + x)[row] + demo.point("R" + x)[row]) / 2
            for x in ("Shoulder", "Hip")
        ]
        person.plot(*np.array(trunk)[:, [0, 2]].T, color=colour, lw=3)
    for ax, found, title in (
        (person, sequence, "demonstrated (synthetic)"),
        (robot, plan.sequence, "the same at the robot's scale"),
    ):
        for box in found.scene.boxes if ax is person else plan.world.scene.boxes:
            low = box.centre[0] - box.size[0] / 2
            ax.add_patch(
                Rectangle((low, 0), box.size[0], box.size[2], fc="0.9", ec=GREY)
            )
        for stance in found.stances:
            for c in stance.contacts:
                colour = dict(LIMBS).get("L" + c.surface[1:], "k")
                ax.plot(*c.position[[0, 2]], "o", ms=5, color=colour, mec="w", mew=0.6)
        ax.axhline(0, color=GREY, lw=0.8)
        ax.set(aspect="equal", title=title, xlabel="x [m]", xlim=(-0.4, 1.75))
        ax.spines[["top", "right"]].set_visible(False)
    person.set_ylabel("z [m]")
    for surface, colour in LIMBS:
        person.plot([], [], "o", color=colour, label=surface[1:])
    person.legend(fontsize=8, frameon=False, loc="upper right", ncols=2)
    return fig


def moves(sequence, plan) -> Figure:
    """When the demonstration's parts are in contact, and the robot's."""
    fig = Figure(figsize=(7, 3.0), layout="constrained")
    person, robot = fig.subplots(1, 2, sharey=True)
    names = [s + x for x in ("Foot", "Knee", "Elbow", "Hand") for s in "RL"]
    for ax, stances, t in (
        (person, sequence.stances, sequence.t),
        (robot, [k.stance for k in plan.keyframes], np.arange(len(plan.keyframes) + 1)),
    ):
        for i, stance in enumerate(stances):
            contacts = stance.contacts if hasattr(stance, "contacts") else stance
            for c in contacts:
                colour = dict(LIMBS)["L" + c.surface[1:]]
                y = names.index(c.surface)
                ax.barh(y, t[i + 1] - t[i], left=t[i], height=0.7, color=colour)
        ax.set_yticks(range(len(names)), names)
        ax.spines[["top", "right"]].set_visible(False)
    person.set(title="demonstrated stances (synthetic)", xlabel="time [s]")
    robot.set(title="the robot's keyframes", xlabel="keyframe")
    return fig


def stability() -> Figure:
    """A contact, the mass it supports, the angle between them and the cone."""
    fig = Figure(figsize=(7, 2.9), layout="constrained")
    for ax, x, word in zip(
        fig.subplots(1, 2), (0.07, 0.26), ("supporting", "sliding"), strict=True
    ):
        m, p, top = np.array([x, 0.42]), np.zeros(2), np.radians(25)
        wide = 0.36 * np.tan(top)
        ax.add_patch(Polygon([p, (-wide, 0.36), (wide, 0.36)], fc=GREEN, alpha=0.15))
        ax.plot(*np.array([p, m]).T, color=BLUE, lw=3)
        ax.plot([0, 0], [0, 0.46], color=GREY, ls=":", lw=1)
        ax.plot([0, x], [m[1], m[1]], color=RED, lw=1.5)
        ax.plot(*m, "o", ms=16, color=BLUE)
        ax.plot(*p, "o", ms=7, color="k")
        ax.text(m[0] + 0.03, m[1] + 0.01, "m", va="center")
        ax.text(-0.03, 0.02, "p", ha="right")
        ax.text(x / 2, m[1] + 0.02, "d", color=RED, ha="center")
        ax.text(0.52 * x + 0.025, 0.5 * m[1] - 0.02, "l", color=BLUE)
        ax.text(0.11 * x + 0.004, 0.17, "θ", ha="center")
        ax.axhline(0, color="k", lw=1)
        ax.set(aspect="equal", title=word, xlim=(-0.4, 0.5), ylim=(-0.05, 0.52))
        ax.axis("off")
    return fig


def transition(plan) -> Figure:
    """From above: polygon of the contacts that stay, its ellipse, the CoM's path."""
    fig = Figure(figsize=(7, 3.0), layout="constrained")
    chosen = (plan.changes[0], plan.changes[-2])
    for ax, change in zip(fig.subplots(1, 2), chosen, strict=True):
        kin = Kinematics(plan.world)
        com = []
        for phase in change.phases:
            for q in phase.q:
                kin.update(q)
                com.append(kin.com[:2].copy())
        kin.update(change.touching)
        points = [
            p
            for c in change.phases[1].contacts
            for p in kin.bearing_points(
                c.surface, plan.world.supports[c.support].normal, c.edge
            )
        ]
        polygon = support_polygon(np.array(points)[:, :2])
        ellipse = support_ellipse(polygon)
        axis = ellipse.foci[1] - ellipse.foci[0]
        ax.add_patch(Polygon(polygon[:, ::-1] * (-1, 1), fc="0.9", ec=GREY))
        ax.add_patch(
            Ellipse(
                ellipse.centre[::-1] * (-1, 1),
                *(2 * ellipse.semi_axes),
                angle=90 + np.degrees(np.arctan2(axis[1], axis[0])),
                fc="none",
                ec=GREEN,
                lw=1.5,
            )
        )
        ax.plot(*(ellipse.foci[:, ::-1] * (-1, 1)).T, "+", color=GREEN)
        way = np.array(com)[:, ::-1] * (-1, 1)
        ax.plot(*way.T, color=BLUE, lw=1.5)
        ax.plot(*way[0], "o", color="w", mec=BLUE, label="before")
        ax.plot(*way[-1], "o", color=BLUE, label="after")
        ax.set(aspect="equal", title=str(change.step), xlabel="to the right [m]")
        ax.set_ylabel("ahead [m]")
        finish_axes(ax)
        ax.legend(fontsize=8, frameon=False, loc="center left", bbox_to_anchor=(1, 0.9))
    return fig


def paths(plan) -> Figure:
    """The moving surface from the side: the arc, and the postures that follow it."""
    fig = Figure(figsize=(7, 3.0), layout="constrained")
    ax = fig.subplots()
    for box in plan.world.scene.boxes:
        low = box.centre[0] - box.size[0] / 2
        ax.add_patch(Rectangle((low, 0), 0.7, box.size[2], fc="0.9", ec=GREY))
        ax.axhline(box.size[2] + 0.05, color=GREY, ls=":", lw=1)
        ax.text(
            0.92,
            box.size[2] + 0.055,
            "h_obs + h_safe",
            ha="right",
            va="bottom",
            color=GREY,
        )
    up = np.array([0.0, 0.0, 1.0])
    for change, colour in ((plan.changes[0], BLUE), (plan.changes[-2], RED)):
        swing, surface = change.phases[1], change.step.makes.surface
        kin, way = Kinematics(plan.world), []
        for q in swing.q:
            kin.update(q)
            way.append(kin.contact_point(surface, up).copy())
        way = np.array(way)
        ax.plot(swing.arc[:, 0], swing.arc[:, 2], "--", color=colour, lw=1)
        label = str(change.step)
        ax.plot(way[:, 0], way[:, 2], "o-", color=colour, ms=3, lw=1.2, label=label)
    ax.axhline(0, color="k", lw=0.8)
    ax.set(aspect="equal", xlabel="x [m]", ylabel="z [m]", xlim=(-0.15, 0.93))
    finish_axes(ax)
    ax.legend(fontsize=8, frameon=False, loc="upper right")
    return fig


def trajectory(plan, fast) -> Figure:
    """The fastest joint over time, at the speed of the plan and as fast as it can."""
    fig = Figure(figsize=(7, 3.2), layout="constrained")
    slow_ax, fast_ax = fig.subplots(2, 1)
    for ax, p, colour in ((slow_ax, plan, BLUE), (fast_ax, fast, RED)):
        t = p.trajectory
        speed = np.abs(t.v[:, 6:]).max(axis=1)
        ax.plot(t.time[::10], speed[::10], color=colour, lw=0.9)
        for k in t.keyframes:
            ax.axvline(k, color=GREY, ls=":", lw=0.8)
        ax.set_ylabel("fastest joint [rad/s]")
        ax.set_title(f"--speed {p.options.speed}", loc="left")
        ax.spines[["top", "right"]].set_visible(False)
    fast_ax.set_xlabel("time [s]; dotted: keyframes")
    return fig


def physics(plan, rollout) -> Figure:
    """A knee against its reference, and its torque against its limit."""
    fig = Figure(figsize=(7, 3.6), layout="constrained")
    angle, torque = fig.subplots(2, 1, sharex=True)
    joint = plan.trajectory.joints.index("LKneeSag")
    world, t = plan.world, rollout.time
    followed = rollout.followed or plan.trajectory
    angle.plot(
        followed.time,
        followed.q[:, world.qadr[joint]],
        "--",
        color=GREY,
        label="planned",
    )
    angle.plot(t, rollout.qpos[:, world.qadr[joint]], color=BLUE, lw=1, label="physics")
    torque.plot(t, rollout.actuator_force[:, joint], color=BLUE, lw=0.8)
    for sign in (-1, 1):
        torque.axhline(sign * world.tau_max[joint], color=RED, ls=":", lw=1)
    angle.set_ylabel("left knee [rad]")
    torque.set_ylabel("torque [N m]")
    torque.set_xlabel("time [s]; dotted: torque limit")
    finish_axes(angle)
    angle.legend(fontsize=8, frameon=False, loc="upper left")
    torque.spines[["top", "right"]].set_visible(False)
    return fig


def feeling(plan) -> Figure:
    """A top as it was believed, the contacts measured, and the top that fits them."""
    fig = Figure(figsize=(7, 2.6), layout="constrained")
    ax = fig.subplots()
    box = plan.world.scene.boxes[0]
    x = np.array([0.35, 0.42, 0.62, 0.70])
    felt = np.column_stack([x, [0.1, -0.1, 0.1, -0.1], 0.235 + 0.11 * (x - 0.3)])
    new = fitted_box(box, felt)
    line = np.array([0.23, 0.95])
    n, middle = new.top.normal, new.top.position
    ax.plot(line, [box.size[2]] * 2, "--", color=GREY, label="believed before")
    ax.plot(
        line,
        middle[2] - n[0] / n[2] * (line - middle[0]),
        color=BLUE,
        lw=2,
        label="believed after",
    )
    ax.plot(felt[:, 0], felt[:, 2], "o", color=RED, label="contacts measured")
    ax.set(xlabel="x [m]", ylabel="z [m]", ylim=(0.2, 0.33))
    finish_axes(ax)
    ax.legend(fontsize=8, frameon=False, loc="upper left", ncols=3)
    return fig


def keyframe(plan, k: int, path: Path) -> None:
    """One keyframe with its contacts, their forces and the centre of mass."""
    size = (900, 560)
    posture = plan.keyframes[k].q[None]
    seen = seen_points(Kinematics(plan.world), posture)
    view = view_of(plan.world, seen, size[0] / size[1], "corner")
    with Camera(plan.world, size) as camera:
        picture = camera.shot(plan.keyframes[k].q, view)
    mark_keyframe(picture, view, plan.world, plan.keyframes[k])
    picture.convert("P", palette=1, colors=128).save(path, optimize=True)


def main(folder: Path) -> None:
    """Plan and run one climb, and draw everything."""
    folder.mkdir(parents=True, exist_ok=True)
    demo = clamber.load_demo("climb")
    sequence = clamber.detect_contacts(demo)
    robot, scene = clamber.load_robot("coman"), clamber.Scene.from_height(0.275)
    plan = clamber.plan(sequence, robot, scene)
    fast = clamber.plan(
        sequence, robot, scene, options=replace(plan.options, speed="max")
    )
    rollout = clamber.simulate(plan)
    figures: dict[str, Callable[[], Figure]] = {
        "detection": lambda: detection(demo, sequence),
        "scaling": lambda: scaling(demo, sequence, plan),
        "moves": lambda: moves(sequence, plan),
        "stability": stability,
        "transition": lambda: transition(plan),
        "paths": lambda: paths(plan),
        "trajectory": lambda: trajectory(plan, fast),
        "physics": lambda: physics(plan, rollout),
        "feeling": lambda: feeling(plan),
    }
    for name, draw in figures.items():
        save_plot(draw(), folder / f"{name}.png")
    save_plot(cost_shapes(), folder.parent / "cost-shapes.png")
    keyframe(plan, 2, folder / "equilibrium.png")
    keyframe(plan, 5, folder / "posture.png")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python pictures.py FOLDER")
    main(Path(sys.argv[1]))
