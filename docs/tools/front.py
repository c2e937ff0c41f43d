"""Draw the moving picture of the first page: `make front`.

python docs/tools/front.py RUNS docs/front.webp

RUNS holds three run folders, `climb` and `crossing` of COMAN and `g1` of a Unitree G1.
On the left is the built-in demonstration, which is synthetic, on the right what physics
made of it. The demonstration of the climb keeps COMAN's pace: at each contact both are
at the same one. All else is played evenly.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
from PIL import Image, ImageDraw

import clamber
from clamber.model.scene import GROUND
from clamber.show.renderer import DARK, PALE, Camera, font, frame_view, view_of
from clamber.show.sample import row_at, thinned
from clamber.show.skeleton import Skeleton, paired_times, skeleton_of

SIZE = (864, 350)  # of the picture, as wide as a page of text
BAND = 46  # [pixels] for the captions above
FPS = 10
SECONDS = {"climb": 7.0, "crossing": 11.0}
HOLD = 1000  # [ms] of the last picture of each part
LIMIT = 950_000  # [bytes] of the file; what is larger is compressed more
QUALITIES = (55, 45, 38, 32, 26, 20)
BONE, HEAD = 0.030, 0.10  # [m] radii
BLUE, GREY = (0.16, 0.36, 0.75, 1.0), (95, 102, 112)
ROBOTS = {"coman": "COMAN", "g1": "Unitree G1"}


@dataclass(frozen=True)
class Panel:
    """Pictures of one figure, and what stands above them."""

    title: str
    note: str
    pictures: list[Image.Image]


def shots(
    world: SimpleNamespace | clamber.World,
    q: np.ndarray,
    view: object,
    size: tuple[int, int],
) -> list[Image.Image]:
    """A picture of each configuration (n, nq)."""
    with Camera(world, (2 * size[0], 2 * size[1]), smooth=False) as camera:
        large = (camera.shot(x, view) for x in q)
        return [x.resize(size, Image.Resampling.BOX) for x in large]


def of_person(skeleton: Skeleton, times: np.ndarray, size: tuple[int, int]) -> Panel:
    """A demonstration at some times (n,): its bones as capsules, among its boxes."""
    model, ends = person_model(skeleton)
    ground = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM.value, GROUND)
    world = SimpleNamespace(model=model, support_geom={GROUND: ground})
    demo, box = skeleton.demo, skeleton.demo.scene.boxes[0]
    points = np.array([points_at(skeleton, t) for t in times])
    around = np.concatenate([points.reshape(-1, 3), box.top.vertices])
    low, high = around.min(axis=0) - HEAD, around.max(axis=0) + HEAD
    grid = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    view = frame_view(low + grid * (high - low), size[0] / size[1])
    q = np.array([np.concatenate([pose(p[list(e)]) for e in ends]) for p in points])
    note = f"box of {box.size[2]:.3g} m, {demo.t[-1]:.0f} s"
    return Panel("Demonstration (synthetic)", note, shots(world, q, view, size))


def person_model(skeleton: Skeleton) -> tuple[mujoco.MjModel, list[tuple[int, ...]]]:
    """Each bone and the head as a body that moves freely, and the points it joins."""
    world = clamber.build_world(clamber.load_robot("coman"), skeleton.demo.scene)
    spec = mujoco.MjSpec.from_string(world.xml)
    for parts in (spec.actuators, spec.sensors, spec.excludes, spec.worldbody.bodies):
        for part in list(parts):
            spec.delete(part)
    points = points_at(skeleton, float(skeleton.demo.t[0]))
    ends: list[tuple[int, ...]] = [tuple(map(int, b)) for b in skeleton.bones]
    if skeleton.head is not None:
        ends.append((skeleton.head,))
    for e in ends:
        body = spec.worldbody.add_body()
        body.add_freejoint()
        half = float(np.linalg.norm(points[e[-1]] - points[e[0]])) / 2
        geom = body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, rgba=BLUE)
        geom.size = [HEAD, 0.0, 0.0]
        if len(e) == 2:
            geom.type, geom.size = mujoco.mjtGeom.mjGEOM_CAPSULE, [BONE, half, 0.0]
    return spec.compile(), ends


def points_at(skeleton: Skeleton, t: float) -> np.ndarray:
    """(F, 3) points [m] at a time [s]; those in a gap are where they were last seen."""
    points = skeleton.at(t)[0].copy()
    row = int(np.searchsorted(skeleton.demo.t, t, "right"))
    for k in np.flatnonzero(~np.isfinite(points).all(axis=1)):
        good = np.isfinite(skeleton.position[:row, k]).all(axis=1)
        points[k] = skeleton.position[np.flatnonzero(good)[-1], k]
    return points


def pose(ends: np.ndarray) -> np.ndarray:
    """(7,) position and quaternion of a capsule between ends (2, 3), or of a point."""
    quat = np.array([1.0, 0.0, 0.0, 0.0])
    if len(ends) == 2:
        mujoco.mju_quatZ2Vec(quat, ends[1] - ends[0])
    return np.concatenate([ends.mean(axis=0), quat])


def of_robot(rollout: clamber.Rollout, seconds: float, size: tuple[int, int]) -> Panel:
    """What physics did, played within so many seconds."""
    world, end = rollout.world, float(rollout.time[-1])
    rows = [row_at(rollout.time, t) for t in np.linspace(0.0, end, _count(seconds))]
    view = view_of(world, thinned(rollout.qpos, 60), size[0] / size[1])
    high = world.scene.boxes[0].size[2]
    return Panel(
        f"{ROBOTS[world.robot.name]}, in physics",
        f"box of {high:.3g} m, {end:.0f} s, shown {end / seconds:.0f}x faster",
        shots(world, rollout.qpos[rows], view, size),
    )


def _count(seconds: float) -> int:
    return round(FPS * seconds)


def demonstrated(name: str) -> Skeleton:
    """A built-in demonstration with its bones."""
    demo = clamber.load_demo(name)
    return skeleton_of(demo, clamber.detect_contacts(demo))


def pages(panels: list[Panel]) -> list[Image.Image]:
    """Panels of as many pictures beside each other, captions above."""
    width, made = SIZE[0] // len(panels), []
    for k in range(len(panels[0].pictures)):
        page = Image.new("RGB", SIZE, PALE)
        draw = ImageDraw.Draw(page)
        for i, panel in enumerate(panels):
            x = i * width + 2
            page.paste(panel.pictures[k], (x, BAND))
            draw.text((x + 8, 4), panel.title, font=font(18), fill=DARK)
            draw.text((x + 8, 26), panel.note, font=font(14), fill=GREY)
        made.append(page)
    return made


def climb(runs: Path) -> list[Image.Image]:
    """The demonstration, COMAN and the G1, each on its box."""
    size, seconds = (SIZE[0] // 3 - 4, SIZE[1] - BAND), SECONDS["climb"]
    coman, plan = (
        clamber.load_rollout(runs / "climb"),
        clamber.load_plan(runs / "climb"),
    )
    end = float(coman.time[-1])
    robot, person = paired_times(plan, plan.trajectory.keyframes.tolist(), end)
    paced = np.interp(np.linspace(0.0, end, _count(seconds)), robot, person)
    left = of_person(demonstrated("climb"), paced, size)
    others = (coman, clamber.load_rollout(runs / "g1"))
    return pages([left, *(of_robot(x, seconds, size) for x in others)])


def crossing(runs: Path) -> list[Image.Image]:
    """The demonstration, and COMAN over a table of another size."""
    size, seconds = (SIZE[0] // 2 - 4, SIZE[1] - BAND), SECONDS["crossing"]
    skeleton = demonstrated("crossing")
    times = np.linspace(0.0, float(skeleton.demo.t[-1]), _count(seconds))
    coman = clamber.load_rollout(runs / "crossing")
    return pages([of_person(skeleton, times, size), of_robot(coman, seconds, size)])


def main(runs: Path, out: Path) -> None:
    """Draw every frame and write the file."""
    parts = (climb(runs), crossing(runs))
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
