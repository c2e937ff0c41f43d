"""Draw the moving picture of the first page: `make front`.

python docs/tools/front.py RUNS docs/front.webp

RUNS holds two run folders, `climb` of a Unitree G1 and `crossing` of COMAN. Beside the
robot is the built-in demonstration, which is synthetic, as tall as the robot and at its
pace: in the climb they make each contact at the same time, in the crossing they come
onto the table, along and off it at the same time.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

import clamber
from clamber.model.kinematics import Kinematics
from clamber.show.film import Person
from clamber.show.framing import seen_points, view_of
from clamber.show.marks import DARK, PALE, font
from clamber.show.renderer import Camera
from clamber.show.sample import keyframe_times, row_at
from clamber.show.skeleton import paired_times, skeleton_of

SIZE = (864, 340)  # of a scene, as wide as a page of text
BAND = 30  # [pixels] above it for the names
FPS = 10
SECONDS = {"climb": 7.0, "crossing": 11.0}
HOLD = 1000  # [ms] of the last picture of each part
LIMIT = 950_000  # [bytes] of the file; what is larger is compressed more
QUALITIES = (60, 50, 42, 36, 30, 25, 20)
ROBOTS = {"coman": "COMAN", "g1": "Unitree G1"}


def part(folder: Path) -> list[Image.Image]:
    """Pictures of a run, the demonstration of its folder's name beside the robot."""
    plan, rollout = clamber.load_plan(folder), clamber.load_rollout(folder)
    world, end, seconds = rollout.world, float(rollout.time[-1]), SECONDS[folder.name]
    demo = clamber.load_demo(folder.name)
    skeleton = skeleton_of(demo, clamber.detect_contacts(demo))
    paired = paired_times(plan, keyframe_times(plan, rollout), end, skeleton)
    seen = seen_points(Kinematics(world), rollout.qpos)
    person = Person(skeleton, world, seen, "corner")
    view = view_of(world, seen, SIZE[0] / SIZE[1], "corner", person.points)
    high = world.scene.boxes[0].size[2]
    pace = f"box of {high:.3g} m, {end:.0f} s, shown {end / seconds:.0f}x faster"
    words = [(8, BAND + SIZE[1] - 8, pace, "ls", 14)]
    for points, name in (
        (person.points, "demonstration (synthetic)"),
        (seen, f"{ROBOTS[world.robot.name]}, in physics"),
    ):
        words.append((view.project(points, SIZE)[:, 0].mean(), 8, name, "ma", 18))
    pictures = []
    with Camera(world, SIZE, fine=False) as camera:
        still = camera.still(view, person.boxes)
        for t in np.linspace(0.0, end, round(FPS * seconds)):
            shapes = person.figure(float(np.interp(t, *paired)))
            q = rollout.qpos[row_at(rollout.time, t)]
            picture = Image.new("RGB", (SIZE[0], BAND + SIZE[1]), PALE)
            picture.paste(camera.shot(q, view, shapes, still), (0, BAND))
            draw = ImageDraw.Draw(picture)
            for x, y, word, anchor, size in words:
                draw.text((x, y), word, font=font(size), fill=DARK, anchor=anchor)
            pictures.append(picture)
    return pictures


def main(runs: Path, out: Path) -> None:
    """Draw every frame and write the file."""
    parts = [part(runs / name) for name in SECONDS]
    usual = round(1000 / FPS)
    duration = [ms for p in parts for ms in [usual] * (len(p) - 1) + [HOLD]]
    first, *rest = [x for p in parts for x in p]
    look = {"method": 4, "minimize_size": True, "loop": 0, "duration": duration}
    for quality in QUALITIES:
        first.save(out, save_all=True, append_images=rest, quality=quality, **look)
        if out.stat().st_size < LIMIT:
            break
    told = f"{out}: {len(duration)} frames, {out.stat().st_size / 1000:.0f} kB\n"
    sys.stderr.write(told)


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit("usage: python front.py RUNS OUT")
    main(Path(sys.argv[1]), Path(sys.argv[2]))
