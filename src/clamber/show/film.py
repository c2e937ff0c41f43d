"""Videos of a run, the person beside the robot where the recording is at hand.

Person and robot are one scene: the person, as tall as the robot, climbs the boxes of
the recording at the side, at each contact in time with the robot.

Shapes: T samples, k pictures.
"""

from __future__ import annotations

import contextlib
import importlib.util
import queue
import sys
import threading
from collections.abc import Callable, Generator, Iterable
from pathlib import Path
from typing import Any, Literal, TypeVar

import mujoco
import numpy as np
from PIL import Image, ImageDraw

from clamber.contact.scaling import limb_scales
from clamber.errors import ClamberError, InputError, MissingDependency
from clamber.execution.simulation import Rollout
from clamber.model.kinematics import Kinematics
from clamber.model.progress import Progress, silent
from clamber.model.se3 import matrix_from_rpy
from clamber.model.world import World
from clamber.planning.records import Plan
from clamber.recording.detect import detect_contacts
from clamber.recording.recording import load_demo
from clamber.run.codec import whole_file
from clamber.show.framing import Preset, flat_axes, seen_points, view_of
from clamber.show.marks import DARK, contact_marks, draw_marks, font, loads_of
from clamber.show.renderer import (
    Camera,
    Colour,
    Shape,
    ball,
    bar,
    block,
)
from clamber.show.sample import change_at, keyframe_times, thinned
from clamber.show.skeleton import (
    Skeleton,
    corners,
    paired_times,
    recording_named,
    skeleton_of,
)

T = TypeVar("T")
Marks = Literal["none", "contacts", "forces"]
FPS = 20
VIDEO_SIZE, WEBP_SIZE = (1280, 720), (640, 360)
VIDEO_SECONDS = 15.0  # at most, for runs that a power of two brings below
CAMERAS = 2  # that draw side by side
AHEAD = 4  # pictures that each may be ahead of what is written
SPEEDUP_AFTER = 12.0  # [s] shorter runs are shown in real time
PERSON: Colour = (0.20, 0.42, 0.68, 1.0)
PERSON_BOX: Colour = (0.84, 0.80, 0.74, 1.0)
PERSON_JOINT: Colour = (0.13, 0.29, 0.49, 1.0)
BONE, JOINT, HEAD = 0.030, 0.040, 0.10  # [m] radii at the person's own size
ROOM = 0.35  # [height of the motion] between the two


class Person:
    """The person of a recording, with the robot's legs for size, beside it."""

    def __init__(
        self, skeleton: Skeleton, world: World, seen: np.ndarray, camera: Preset
    ) -> None:
        """Find size and place.

        Args:
            skeleton: The recording.
            world: Of the robot.
            seen: (n, 3) where the robot and its boxes are [m].
            camera: The person is to the left of the robot in its picture.
        """
        self._skeleton = skeleton
        kin = Kinematics(world)
        kin.update(world.home)
        demo = skeleton.demo
        self._scale = s = limb_scales(dict(demo.subject), kin)["leg"]
        way = float(world.scene.start[2] - demo.scene.start[2])
        self._turn = R = matrix_from_rpy([0.0, 0.0, way])
        valid = thinned(
            np.where(skeleton.seen[..., None], skeleton.position, np.nan), 60
        )
        valid = valid.reshape(-1, 3)
        mine = (valid[np.isfinite(valid).all(axis=1)], corners(demo.scene))
        there = s * np.concatenate(mine) @ R.T
        right, forward = flat_axes(world, camera)
        room = ROOM * float(np.ptp(seen[:, 2]))
        across = float((seen @ right).min() - (there @ right).max()) - room
        along = _middle(seen @ forward) - _middle(there @ forward)
        self._offset = across * right + along * forward
        self.points = there + self._offset  # that a camera has to have in view
        self.boxes = [
            shape
            for b in demo.scene.boxes
            for shape in block(
                s * b.size, self._placed(b.centre), R @ b.rotation, PERSON_BOX
            )
        ]

    def _placed(self, points: np.ndarray) -> np.ndarray:
        return self._scale * points @ self._turn.T + self._offset

    def figure(self, t: float) -> list[Shape]:
        """Bones, joints and head at a time of the recording [s]."""
        skeleton, s = self._skeleton, self._scale
        p, seen = skeleton.at(t)
        p, out = self._placed(p), []
        for pair in skeleton.bones[seen[skeleton.bones].all(axis=1)]:
            kind = mujoco.mjtGeom.mjGEOM_CAPSULE
            if np.linalg.norm(np.diff(p[pair], axis=0)) > 1e-6:
                out.append(bar(kind, p[pair], s * BONE, PERSON))
        ends = np.unique(skeleton.bones)
        out += [ball(x, s * JOINT, PERSON_JOINT) for x in p[ends[seen[ends]]]]
        if skeleton.head is not None and seen[skeleton.head]:
            out.append(ball(p[skeleton.head], s * HEAD, PERSON))
        return out

    @property
    def name(self) -> str:
        """Caption of the stick figure, which says whether it is synthetic."""
        return "person (synthetic)" if self._skeleton.demo.synthetic else "person"


def skeleton_of_plan(plan: Plan) -> Skeleton | None:
    """The recording that a plan goes back to, by way of a policy too.

    None where it is not to be found, or where there are several.
    """
    name = recording_named(plan.sequence.source)
    if name is None:
        return None
    try:
        demo = load_demo(name)
        return skeleton_of(demo, detect_contacts(demo))
    except ClamberError:
        return None


def _middle(x: np.ndarray) -> float:
    return float(x.min() + x.max()) / 2


def speedup_of(duration: float) -> int:
    """By how much a run of that many seconds is sped up."""
    speedup = 1
    while duration > SPEEDUP_AFTER and duration / speedup > VIDEO_SECONDS:
        speedup *= 2
    return speedup


def video(
    plan: Plan,
    rollout: Rollout,
    folder: str | Path,
    *,
    out: str | Path | None = None,
    size: tuple[int, int] | None = None,
    camera: Preset = "corner",
    marks: Marks = "none",
    skeleton: Skeleton | None = None,
    report: Progress | None = None,
) -> Path:
    """Draw the rollout as a time-lapse: `video.mp4`, or `video.webp` without ffmpeg.

    Args:
        plan: What was to be done.
        rollout: What physics made of it.
        folder: Where the video goes under its usual name.
        out: The file instead, an `.mp4` or a `.webp`.
        size: Width and height in pixels, even numbers.
        camera: From where.
        marks: Whether contacts, or contacts with their forces, are drawn over it.
        skeleton: The recording whose person is shown beside the robot.
        report: Told of the share done.

    Raises:
        InputError: Another ending.
        MissingDependency: An `.mp4` was asked for and there is no ffmpeg.
    """
    has_ffmpeg = importlib.util.find_spec("imageio_ffmpeg") is not None
    if out is None:
        out = Path(folder) / ("video.mp4" if has_ffmpeg else "video.webp")
    path = Path(out)
    if path.suffix not in (".mp4", ".webp"):
        raise InputError("a name that ends in .mp4 or .webp", source=path)
    if path.suffix == ".mp4" and not has_ffmpeg:
        raise MissingDependency("imageio-ffmpeg", "video")
    fps, usual = (FPS, VIDEO_SIZE) if path.suffix == ".mp4" else (FPS / 2, WEBP_SIZE)
    size = size or usual
    tell = report or silent
    frames = _frames(plan, rollout, fps, size, camera, marks, skeleton, tell)
    with whole_file(path) as draft, contextlib.closing(frames):
        if path.suffix == ".mp4":
            _write_mp4(frames, draft, size)
        else:
            first, *rest = frames
            options: dict[str, Any] = {"quality": 70, "method": 0, "loop": 0}
            first.save(
                draft,
                save_all=True,
                append_images=rest,
                duration=round(1000 / fps),
                **options,
            )
    tell("video", 1.0, "")
    return path


def _frames(
    plan: Plan,
    rollout: Rollout,
    fps: float,
    size: tuple[int, int],
    camera: Preset,
    marks: Marks,
    skeleton: Skeleton | None,
    report: Progress,
) -> Generator[Image.Image]:
    """Pictures of the rollout with its clock and the move under way."""
    world, duration = rollout.world, float(rollout.time[-1])
    speedup = speedup_of(duration)
    times = np.arange(0.0, duration, speedup / fps)
    rows = np.searchsorted(rollout.time, times)
    loaded, forces = loads_of(rollout, rows)
    moves = [str(c.step) for c in plan.changes]
    reached = keyframe_times(plan, rollout)
    kin = Kinematics(world)
    seen = seen_points(kin, rollout.qpos)
    person, paired = None, None
    if skeleton is not None:
        person = Person(skeleton, world, seen, camera)
        paired = paired_times(plan, reached, duration, skeleton)
    beside = None if person is None else person.points
    view = view_of(world, seen, size[0] / size[1], camera, beside)
    letters = max(14, round(size[1] / 32))
    named = []
    if person is not None:
        for name, points in ((world.robot.name, seen), (person.name, person.points)):
            at = view.project(points, size)[:, 0]
            named.append((name, _middle(at)))

    def drawn(share: range) -> Generator[Image.Image]:
        """Some of the pictures, by a camera of their own."""
        kin = Kinematics(world)
        with Camera(world, size, fine=False) as drawing:
            still = drawing.still(view, () if person is None else person.boxes)
            for i in share:
                row, t = rows[i], times[i]
                shapes: list[Shape] = []
                if person is not None and paired is not None:
                    shapes = person.figure(float(np.interp(t, *paired)))
                picture = drawing.shot(rollout.qpos[row], view, shapes, still)
                if marks != "none":
                    kin.update(rollout.qpos[row])
                    with_forces = forces[i] if marks == "forces" else None
                    points = contact_marks(kin, loaded[i], with_forces)
                    draw_marks(picture, view, points)
                text = change_at(moves, reached, t)
                clock = f"{t:5.1f} s" + (f"   {speedup}x" if speedup > 1 else "")
                below = size[1] - letters // 2
                words = [(letters, below, clock, "ls")]
                words += [(size[0] - letters, below, text, "rs")]
                words += [(x, letters // 2, name, "ma") for name, x in named]
                draw = ImageDraw.Draw(picture)
                for x, y, word, anchor in words:
                    draw.text(
                        (x, y), word, font=font(letters), fill=DARK, anchor=anchor
                    )
                yield picture

    # Much of a picture is made by one core alone. Elsewhere than on Linux a context is
    # the first thread's.
    beside = min(CAMERAS, len(rows)) if sys.platform == "linux" else 1
    pictures = taking_turns(drawn, len(rows), beside)
    with contextlib.closing(pictures):
        for i, picture in enumerate(pictures):
            if i % 5 == 0:
                report("video", i / len(rows), "")
            yield picture


def taking_turns(
    made: Callable[[range], Generator[T]], count: int, workers: int
) -> Generator[T]:
    """Results of threads that take turns, in order.

    Args:
        made: Makes those of its share, in a thread of their own.
        count: Of all.
        workers: Threads.
    """
    if workers < 2:
        yield from made(range(count))
        return
    over = threading.Event()
    lines: list[queue.Queue[T | BaseException]] = [
        queue.Queue(AHEAD) for _ in range(workers)
    ]

    def put(line: queue.Queue[T | BaseException], one: T | BaseException) -> None:
        while not over.is_set():
            with contextlib.suppress(queue.Full):
                return line.put(one, timeout=0.1)

    def work(k: int) -> None:
        try:
            with contextlib.closing(made(range(k, count, workers))) as ones:
                for one in ones:
                    put(lines[k], one)
                    if over.is_set():
                        break
        except BaseException as e:
            put(lines[k], e)

    threads = [threading.Thread(target=work, args=(k,)) for k in range(workers)]
    for thread in threads:
        thread.start()
    try:
        for i in range(count):
            one = lines[i % workers].get()
            if isinstance(one, BaseException):
                raise one
            yield one
    finally:
        over.set()
        for thread in threads:
            thread.join()


def _write_mp4(
    frames: Iterable[Image.Image], path: Path, size: tuple[int, int]
) -> None:
    import imageio_ffmpeg

    writer = imageio_ffmpeg.write_frames(
        str(path),
        size,
        fps=FPS,
        codec="libx264",
        quality=5,
        macro_block_size=2,
        ffmpeg_log_level="error",  # a video that is interrupted is no warning of ours
        output_params=[
            "-preset", "veryfast", "-movflags", "+faststart",
            "-fflags", "+bitexact", "-flags:v", "+bitexact", "-map_metadata", "-1",
        ],
    )  # fmt: skip
    writer.send(None)
    try:
        for frame in frames:
            writer.send(frame.tobytes())
    finally:
        writer.close()
