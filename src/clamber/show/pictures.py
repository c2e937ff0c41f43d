"""Sheets of pictures: robots, scenes, the keyframes of a plan, a climb; whole runs."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from clamber.contact.contact import ContactSequence
from clamber.contact.steps import Step
from clamber.errors import InputError
from clamber.execution.simulation import Rollout
from clamber.model.arguments import checks_types
from clamber.model.kinematics import Kinematics
from clamber.model.progress import Progress, silent
from clamber.model.robot import RobotLike
from clamber.model.scene import GROUND, Scene
from clamber.model.terrain import SceneLike
from clamber.model.world import World, build_world
from clamber.planning.records import Plan
from clamber.recording.demonstration import Demonstration
from clamber.run.codec import whole_file
from clamber.run.folder import (
    PLANNED_TRAJECTORY,
    ROLLOUT,
    TIMINGS,
    load_plan,
    load_rollout,
    trajectory_of,
)
from clamber.show.film import Marks, skeleton_of_plan, video
from clamber.show.framing import (
    Preset,
    View,
    frame_view,
    robot_corners,
    seen_points,
    view_of,
)
from clamber.show.marks import (
    DARK,
    LINE,
    PALE,
    PHASE_COLOURS,
    arrow,
    contact_marks,
    dot,
    draw_marks,
    font,
    keyframe_marks,
    loads_of,
)
from clamber.show.plots import (
    contact_plot,
    cost_to_go_plot,
    demonstration_plot,
    stability_plot,
)
from clamber.show.renderer import Camera, outline
from clamber.show.sample import planned_forces, row_at, sample_motion
from clamber.show.skeleton import skeleton_of
from clamber.step.posture import Keyframe
from clamber.step.statics import StaticEquilibrium

CLIMB_FRAMES = 12
PLOTS = 24.0  # of a run take as long as so many pictures of a sheet
SAMPLES = 400  # of a plot over time
FRAME_SIZE = (1920, 1080)
CLOSE = 0.12  # [height of the motion] around it boxes are in a sheet's pictures
REFUSED = (0.72, 0.11, 0.11, 1.0)  # outlines of what is no support
MOST_REFUSED = 12  # of them are said why
FEW = 8  # supports that are marked in full size
TILE = (400, 330)  # of the sheet of keyframes


@checks_types
def draw_robot(
    robot: RobotLike, path: str | Path, *, tile: tuple[int, int] = (560, 640)
) -> Path:
    """Draw the robot as it stands, from behind and from ahead, its surfaces named.

    A dot marks where each surface touches, a ring the mass that its limb supports.

    Args:
        robot: A robot, its name, or its `robot.yaml`.
        path: The PNG file.
        tile: Width and height of each of the two views [px].

    Raises:
        ClamberError: There is no OpenGL.
    """
    world = build_world(robot, Scene(start=np.zeros(3)))
    kin = Kinematics(world)
    kin.update(world.home)
    corners, up = robot_corners(kin), np.array([0.0, 0.0, 1.0])
    fovy = float(world.model.vis.global_.fovy)
    tiles = []
    with Camera(world, tile) as camera:
        for caption, turn in (("from behind", 0.0), ("from ahead", 2.4)):
            view = frame_view(corners, tile[0] / tile[1], yaw=turn, fovy=fovy)
            picture = camera.shot(world.home, view)
            draw = ImageDraw.Draw(picture)
            for limb in world.robot.limbs.values():
                x, y = view.project(kin.landmark(limb.root)[1], tile)
                draw.ellipse((x - 6, y - 6, x + 6, y + 6), outline=DARK, width=2)
                for surface, colour in zip(
                    limb.surfaces, ((194, 65, 12), (29, 78, 216)), strict=False
                ):
                    at = tuple(view.project(kin.contact_point(surface, up), tile))
                    dot(draw, at, 5, colour)
                    draw.text((at[0] + 8, at[1] - 8), surface, font=font(15), fill=DARK)
            tiles.append((picture, [f"{world.robot.name}, {caption}"]))
    return _save_sheet(tiles, path, columns=2)


@checks_types
def draw_scene(
    robot: RobotLike,
    scene: SceneLike,
    path: str | Path,
    *,
    tile: tuple[int, int] = (760, 560),
) -> Path:
    """Draw a scene with the robot at its start, its supports named, the goal marked.

    Of a mesh the supports are outlined, and in red what is none, with the reason.

    Args:
        robot: A robot, its name, or its `robot.yaml`.
        scene: A scene, its file, or the height of one box [m].
        path: The PNG file.
        tile: Width and height [px].

    Raises:
        ClamberError: There is no OpenGL.
    """
    world = build_world(robot, scene)
    robot, scene = world.robot, world.scene
    kin = Kinematics(world)
    kin.update(world.home)
    tops = [s for s in scene.supports if s.name != GROUND]
    refused = [r for m in scene.meshes for r in m.rejected]
    seen = [robot_corners(kin), *(s.vertices for s in tops)]
    seen += [r.outline for r in refused]
    view = view_of(world, np.concatenate(seen), tile[0] / tile[1])
    lines = [x for r in refused for x in outline(r.outline, REFUSED)]
    with Camera(world, tile) as camera:
        picture = camera.shot(world.home, view, lines)
    draw = ImageDraw.Draw(picture)
    shown = [r for r in refused if _is_told(r.outline, view)]
    for r in shown[:MOST_REFUSED]:
        at = view.project(r.outline.mean(axis=0), tile)
        draw.text(tuple(at), r.why, font=font(12), fill=(185, 28, 28), anchor="mm")
    length, size = (0.15, 15) if len(tops) <= FEW else (0.06, 11)
    for s in tops:
        at, tip = view.project(
            np.stack([s.position, s.position + length * s.normal]), tile
        )
        arrow(draw, at, tip, DARK)
        draw.text((at[0] + 8, at[1] + 4), s.name, font=font(size), fill=DARK)
    if scene.goal is not None:
        at = tuple(view.project(np.array([*scene.goal[:2], 0.0]), tile))
        dot(draw, at, 6, PHASE_COLOURS["supporting"])
        draw.text((at[0] + 8, at[1] - 8), "goal", font=font(15), fill=DARK)
    of = "supports" if scene.meshes else "boxes"
    caption = f"{len(tops)} {of}, {robot.name} at the start"
    return _save_sheet([(picture, [caption])], path, columns=1)


def _is_told(outline: np.ndarray, view: View) -> bool:
    """Whether to say why a polygon (K, 3) is no support: not of walls, or backs."""
    normal = np.cross(outline, np.roll(outline, -1, axis=0)).sum(axis=0)
    wall = normal[2] < 0.5 * float(np.linalg.norm(normal))
    return not wall and float(normal @ view.axes[2]) < 0.0


def keyframe_sheet(
    plan: Plan,
    path: str | Path,
    *,
    tile: tuple[int, int] = TILE,
    camera: Preset = "corner",
    report: Progress | None = None,
) -> Path:
    """Draw each keyframe with its contacts, forces and margins.

    A dot marks each contact, seen through the robot: green while it supports, yellow
    within reach of that, blue where friction holds it although it is farther from the
    mass that it supports than the geometric guide value. Arrows are the contact forces;
    a line falls from the centre of mass.
    """
    world = plan.world
    postures = np.array([k.q for k in plan.keyframes])
    seen = seen_points(Kinematics(world), postures, CLOSE)
    view = view_of(world, seen, tile[0] / tile[1], camera)
    tiles, steps = [], [None, *(c.step for c in plan.changes)]
    held = plan.equilibria
    with Camera(world, tile) as drawing:
        still = drawing.still(view)
        for i, key in enumerate(plan.keyframes):
            if report is not None:
                report("pictures", i / len(plan.keyframes), "keyframes")
            picture = drawing.shot(key.q, view, still=still)
            mark_keyframe(picture, view, world, key)
            tiles.append((picture, keyframe_caption(i, key, held[i], steps[i])))
    return _save_sheet(tiles, path, columns=min(4, len(tiles)))


def keyframe_caption(
    i: int, key: Keyframe, held: StaticEquilibrium, step: Step | None
) -> list[str]:
    """Three lines: the step that led there, geometry and balance, forces."""
    new = {c.surface for c in key.stance}
    title = "start, on " + ", ".join(c.surface for c in key.stance)
    if step is not None:
        title, new = str(step), {step.makes.surface} if step.makes else set()
    d = ", ".join(
        f"d {c.contact.surface} {1000 * c.projected_distance:.0f} mm"
        for c in key.contacts
        if c.contact.surface in new
    )
    push = "not in equilibrium"
    if held.feasible:
        push = f"push margin {held.margin:.2f} m g"
    limit = f", limit {held.limiting}" if held.limiting else ""
    return [
        f"{i}  {title}",
        f"{d + '; ' if d else ''}CoM margin {1000 * key.com_margin:.0f} mm",
        push + limit,
    ]


def mark_keyframe(
    picture: Image.Image, view: View, world: World, key: Keyframe
) -> None:
    """Draw contacts, forces and the centre of mass over a picture."""
    floor = max(
        (s.position[2] for s in world.supports.values() if s.inside(key.com)),
        default=0.0,
    )
    plumb = np.array([key.com, [*key.com[:2], floor]])
    draw_marks(picture, view, keyframe_marks(world, key), plumb)


def climb_sheet(
    rollout: Rollout,
    path: str | Path,
    *,
    frames: int = CLIMB_FRAMES,
    tile: tuple[int, int] = (300, 250),
    report: Progress | None = None,
) -> Path:
    """Draw what physics did, in pictures evenly spaced in time."""
    rows = np.linspace(0, len(rollout.time) - 1, frames).round().astype(int)
    seen = seen_points(Kinematics(rollout.world), rollout.qpos, CLOSE)
    view = view_of(rollout.world, seen, tile[0] / tile[1])
    tiles = []
    with Camera(rollout.world, tile) as camera:
        still = camera.still(view)
        for i, row in enumerate(rows):
            if report is not None:
                report("pictures", i / len(rows), "climb")
            picture = camera.shot(rollout.qpos[row], view, still=still)
            tiles.append((picture, [f"{rollout.time[row]:.1f} s"]))
    return _save_sheet(tiles, path, columns=4, colours=200)


def _save_sheet(
    tiles: Sequence[tuple[Image.Image, list[str]]],
    path: str | Path,
    *,
    columns: int,
    colours: int | None = None,
    gap: int = 6,
) -> Path:
    """Tiles in rows, each over its caption; with a palette the file is small."""
    width, height = tiles[0][0].size
    lines = max(len(c) for _, c in tiles)
    band = 8 + 18 * lines
    rows = -(-len(tiles) // columns)
    size = (columns * (width + gap) + gap, rows * (height + band + gap) + gap)
    sheet = Image.new("RGB", size, PALE)
    draw = ImageDraw.Draw(sheet)
    for i, (picture, caption) in enumerate(tiles):
        row, column = divmod(i, columns)
        x, y = gap + column * (width + gap), gap + row * (height + band + gap)
        sheet.paste(picture, (x, y))
        draw.rectangle((x, y, x + width - 1, y + height + band - 1), outline=LINE)
        for k, text in enumerate(caption):
            at = (x + 7, y + height + 4 + 18 * k)
            draw.text(at, text, font=font(15 if k == 0 else 13), fill=DARK)
    if colours is not None:
        sheet = sheet.quantize(colours, dither=Image.Dither.NONE)
    path = Path(path)
    with whole_file(path) as draft:
        sheet.save(draft, optimize=True)
    return path


@checks_types
def render_run(
    folder: str | Path,
    *,
    with_video: bool = True,
    demonstration: tuple[Demonstration, ContactSequence] | None = None,
    report: Progress | None = None,
) -> list[Path]:
    """Draw all there is to draw of a run folder, plots first.

    Args:
        folder: With a plan; with a rollout there is more to see.
        with_video: Also the video, which takes the longest.
        demonstration: The recording and what was found in it; by default, in a video,
            what the plan names, where it is at hand.
        report: Told of stage, share done and a note.

    Raises:
        InputError: A file of the folder is missing or broken; what does without it is
            drawn by then.
        ClamberError: There is no OpenGL for pictures; the plots are done by then.
    """
    folder = Path(folder)
    tell = report or silent
    plan, rollout, broken = _readable(folder)
    files: list[Path] = []
    # What there is to draw is known beforehand, in pictures of a sheet.
    plots, frames = (0.0, 0.0) if rollout is None else (PLOTS, float(CLIMB_FRAMES))
    keyframes = float(len(plan.keyframes))
    whole = plots + keyframes + frames

    def within(drawn: float, count: float) -> Progress:
        return lambda stage, share, note: tell(
            stage, (drawn + share * count) / whole, note
        )

    tell("pictures", 0.0, "plots")
    if demonstration is not None:
        files.append(demonstration_plot(*demonstration, folder / "demonstration.png"))
    if rollout is not None:
        motion = sample_motion(plan, rollout, {}, SAMPLES)
        tell("pictures", plots / 2 / whole, "plots")
        asked = plan.options.keyframe.balance_margin * plan.world.length_scale
        files.append(contact_plot(motion, folder / "contacts.png"))
        files.append(stability_plot(motion, asked, folder / "stability.png"))
    if plan.iterations:
        files.append(cost_to_go_plot(plan, folder / "cost-to-go.png"))
    now = within(plots, keyframes)
    files.append(keyframe_sheet(plan, folder / "keyframes.png", report=now))
    if rollout is not None:
        now = within(plots + keyframes, frames)
        files.append(climb_sheet(rollout, folder / "climb.png", report=now))
    tell("pictures", 1.0, "")
    if rollout is not None and with_video:
        known = demonstration is not None
        person = skeleton_of(*demonstration) if known else skeleton_of_plan(plan)
        files.append(video(plan, rollout, folder, skeleton=person, report=tell))
    if broken is not None:
        raise broken
    return files


def _readable(folder: Path) -> tuple[Plan, Rollout | None, InputError | None]:
    """A plan, a rollout, and why that is not all of a run folder that is broken.

    Raises:
        InputError: Of the plan.
    """
    broken, rollout = None, None
    try:
        plan = load_plan(folder)
    except InputError as e:
        broken, plan = e, load_plan(folder, without=(TIMINGS, PLANNED_TRAJECTORY))
    if (folder / ROLLOUT).exists():
        try:
            rollout = load_rollout(folder)
        except InputError as e:
            broken = broken or e
            with contextlib.suppress(InputError):
                rollout = load_rollout(folder, with_events=False)
    return plan, rollout, broken


def render_frame(
    folder: str | Path,
    time: float,
    *,
    out: str | Path | None = None,
    size: tuple[int, int] = FRAME_SIZE,
    camera: Preset = "corner",
    transparent: bool = False,
    marks: Marks = "contacts",
) -> Path:
    """Draw a run at one time as a PNG.

    Args:
        folder: A run folder; the plan is drawn where physics has not run.
        time: [s]; the state at that time, or the last one before.
        out: The file; `frame-<time>.png` in the run folder by default.
        size: Width and height in pixels.
        camera: From where.
        transparent: Robot and obstacles alone, on a transparent background.
        marks: Whether contacts, or contacts with their forces, are drawn over it; of a
            plan, the least forces that hold the robot at rest.

    Raises:
        InputError: A file is missing or broken, or there is no such time.
        ClamberError: There is no OpenGL.
    """
    folder = Path(folder)
    if (folder / ROLLOUT).exists():
        rollout = load_rollout(folder, with_events=False)
        world, t, q = rollout.world, rollout.time, rollout.qpos

        def loads(row: int) -> tuple[np.ndarray, np.ndarray]:
            (loaded,), (forces,) = loads_of(rollout, np.array([row]))
            return loaded, forces

    else:
        plan = load_plan(folder)
        trajectory = trajectory_of(plan, folder)
        world, t, q = plan.world, trajectory.time, trajectory.q

        def loads(row: int) -> tuple[np.ndarray, np.ndarray]:
            return planned_forces(plan, trajectory, row)

    if not t[0] <= time <= t[-1]:
        raise InputError(
            f"a time from {t[0]:g} to {t[-1]:.2f} s", source="--frame", value=time
        )
    row = row_at(t, time)
    path = folder / f"frame-{time:g}.png" if out is None else Path(out)
    if path.suffix != ".png":
        raise InputError("a name that ends in .png", source=path)
    kin = Kinematics(world)
    view = view_of(world, seen_points(kin, q), size[0] / size[1], camera)
    with Camera(world, size, cutout=transparent) as drawing:
        draw = drawing.cutout if transparent else drawing.shot
        picture = draw(q[row], view)
    if marks != "none" and not transparent:
        loaded, forces = loads(row)
        kin.update(q[row])
        forces = forces if marks == "forces" else None
        draw_marks(picture, view, contact_marks(kin, loaded, forces))
    with whole_file(path) as draft:
        picture.save(draft)
    return path
