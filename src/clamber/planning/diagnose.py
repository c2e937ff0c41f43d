"""Robot or scene -> key figures for planning, and what is wrong with it."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from clamber.errors import InputError
from clamber.model.arguments import checks_types
from clamber.model.facing import sides_told
from clamber.model.kinematics import Kinematics, limb_lengths
from clamber.model.limbs import DENSEST
from clamber.model.records import short_repr
from clamber.model.robot import RobotLike, load_robot
from clamber.model.scene import Box, Scene
from clamber.model.terrain import SceneLike, load_scene
from clamber.model.tree import geom_volume
from clamber.model.world import World, build_world
from clamber.step.change import standing
from clamber.step.ik import IK
from clamber.step.path import overlap, watched_pairs
from clamber.step.posture import Keyframe, KeyframeOptions
from clamber.step.stability import is_stable, limiting_joint

LEVEL = np.radians(2.0)  # soles as the robot stands
SAME_HEIGHT = 0.005  # [m] of both soles
STRAIGHT = np.radians(10.0)  # a limb bent by less is straight
BENT_BACK = 0.02  # share of the leg: a knee that is so far behind bends backward
POINTS_BACK = 0.3  # share of a sole: as much longer behind the ankle than ahead
HEAVY = 1.0  # [kg] a link this heavy needs collision geometry
UNLIKE = 0.02  # share by which the lengths of left and right limbs may differ


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Checkup:
    """A robot by its figures.

    Attributes:
        mass: Mass of the whole robot [kg].
        joints: Number of actuated joints.
        lengths: Length of each limb, root to end [m].
        segments: Lengths of upper arm, forearm, thigh and shank [m].
        knee_height: Height of the knee over the sole with the shank upright [m].
        com_height: Height of the centre of mass in the nominal posture [m].
        faults: What is wrong, a sentence each; without any it can be planned for.
    """

    mass: float
    joints: int
    lengths: dict[str, float]
    segments: dict[str, float]
    knee_height: float
    com_height: float
    faults: tuple[str, ...]

    __repr__ = short_repr


@checks_types
def check_robot(robot: RobotLike) -> Checkup:
    """Check a robot in its nominal posture: figures, and what is wrong with it.

    Args:
        robot: A robot, its name, or its `robot.yaml`.

    Raises:
        InputError: Its files cannot be used at all.
    """
    robot = load_robot(robot)
    world = build_world(robot, Scene(start=np.zeros(3)))
    kin = Kinematics(world)
    kin.update(world.home)
    lengths, shanks = {}, []
    for limb in robot.limbs.values():
        a, b, c = (kin.landmark(n)[1] for n in (limb.root, limb.middle, limb.end))
        lengths[limb.name] = float(np.linalg.norm(b - a) + np.linalg.norm(c - b))
        if not limb.is_arm:
            shanks.append(float(np.linalg.norm(c - b)) + float(c[2]))
    segments = {k: round(v, 4) for k, v in limb_lengths(kin).items()}
    return Checkup(
        mass=world.mass,
        joints=len(world.joints),
        lengths=lengths,
        segments=segments,
        knee_height=round(float(np.mean(shanks)), 4),
        com_height=round(float(kin.com[2]), 4),
        faults=tuple(_faults(world, kin, lengths)),
    )


def _faults(world: World, kin: Kinematics, lengths: dict[str, float]) -> list[str]:
    out = [*_limb_faults(world, kin, lengths), *_foot_faults(world, kin)]
    q = world.home[world.qadr]
    for name, x, low, high in zip(
        world.joints,
        q,
        world.q_min[world.dadr],
        world.q_max[world.dadr],
        strict=True,
    ):
        if not low - 1e-9 <= x <= high + 1e-9:
            out.append(
                f"home.{name} is {x:.3f}, beyond its limits {low:.3f} to {high:.3f} rad"
            )
    out += _geometry_faults(world)
    try:
        ik = IK(world)
        check_start(ik, standing(ik, KeyframeOptions()))
    except InputError as e:
        out.append(str(e))
    return out


def _limb_faults(world: World, kin: Kinematics, lengths: dict[str, float]) -> list[str]:
    out = []
    for limb in world.robot.limbs.values():
        a, b, c = (kin.landmark(n)[1] for n in (limb.root, limb.middle, limb.end))
        upper, lower = b - a, c - b
        if min(np.linalg.norm(upper), np.linalg.norm(lower)) < 1e-6:
            out.append(f"limbs.{limb.name}: two of its landmarks are in one place")
            continue
        cosine = upper @ lower / np.linalg.norm(upper) / np.linalg.norm(lower)
        if np.arccos(np.clip(cosine, -1.0, 1.0)) < STRAIGHT:
            out.append(f"limbs.{limb.name} is straight as it stands: bend it in home")
    for kind in ("arm", "leg"):
        left, right = lengths[f"left_{kind}"], lengths[f"right_{kind}"]
        if abs(left - right) > UNLIKE * max(left, right):
            out.append(f"the {kind}s are {left:.3f} m and {right:.3f} m long")
    out += _ahead_faults(world, kin)
    left, right = (
        kin.landmark(world.robot.limbs[f"{side}_leg"].root)[1]
        for side in ("left", "right")
    )
    if left[1] <= right[1]:
        out.append("the left leg is not on the left: x is forward, y left")
    return out


def _ahead_faults(world: World, kin: Kinematics) -> list[str]:
    """Knees bent backward, feet that point back, crossed arms, sides swapped."""
    out, limbs = [], world.robot.limbs
    for limb in (x for x in limbs.values() if not x.is_arm):
        a, b, c = (kin.landmark(n)[1] for n in (limb.root, limb.middle, limb.end))
        on, off = c - a, b - a
        behind = float((off @ on / (on @ on) * on - off)[0])
        if behind > BENT_BACK * float(np.linalg.norm(on)):
            out.append(
                f"limbs.{limb.name}: its knee is {1e3 * behind:.0f} mm behind the line"
                " from hip to ankle: it bends backward"
            )
        name = limb.surfaces[0]
        along = kin.bearing_points(name, np.array([0.0, 0.0, 1.0]))[:, 0] - c[0]
        ahead, back = float(along.max()), -float(along.min())
        if back - ahead > POINTS_BACK * (ahead + back):
            out.append(
                f"{name} points back: it reaches {1e3 * back:.0f} mm behind its ankle"
                f" and {1e3 * ahead:.0f} mm ahead"
            )
    for kind in ("arm", "leg"):
        left, right = limbs[f"left_{kind}"], limbs[f"right_{kind}"]
        names = [(getattr(left, x), getattr(right, x)) for x in ("root", "middle")]
        if sides_told(names) < 0:
            a, b = names[0]
            out.append(
                f"left and right are swapped: limbs.left_{kind} is that of {a}, and"
                f" limbs.right_{kind} that of {b}"
            )
    hands = [kin.landmark(limbs[f"{s}_arm"].end)[1] for s in ("left", "right")]
    if hands[0][1] <= hands[1][1]:
        out.append("the arms cross as it stands: the left hand is right of the other")
    return out


def _foot_faults(world: World, kin: Kinematics) -> list[str]:
    out, heights = [], []
    up = np.array([0.0, 0.0, 1.0])
    for limb in world.robot.limbs.values():
        if limb.is_arm:
            continue
        name = limb.surfaces[0]
        foot = world.surfaces[name]
        heights.append(float(kin.contact_point(name, up)[2]))
        if foot.rotation is None:
            out.append(f"{name} is a ball: a foot needs a box, to stand on")
            continue
        normal = kin.rotation(foot.body) @ foot.rotation[:, 2]
        tilt = float(np.arccos(np.clip(normal @ up, -1.0, 1.0)))
        if tilt > LEVEL:
            out.append(f"{name} is tilted by {np.degrees(tilt):.0f} degrees in home")
    if np.ptp(heights) > SAME_HEIGHT:
        out.append(f"one foot is {1e3 * np.ptp(heights):.0f} mm higher in home")
    return out


def _geometry_faults(world: World) -> list[str]:
    m, out = world.model, []
    own = np.flatnonzero(m.body_rootid == m.body_rootid[world.base])
    solid = (m.geom_contype | m.geom_conaffinity) != 0
    bearing = set(m.geom_bodyid[solid].tolist())
    for b in own:
        if m.body_mass[b] >= HEAVY and int(b) not in bearing:
            out.append(
                f"{m.body(b).name} weighs {m.body_mass[b]:.2f} kg and has no collision"
                " geometry"
            )
    mine = [g for g in np.flatnonzero(solid) if m.geom_bodyid[g] in own]
    bulk = sum(geom_volume(m, int(g)) for g in mine)
    if bulk * DENSEST < world.mass:
        out.append(
            f"collision geometry of {1e3 * bulk:.1f} l is too little for"
            f" {world.mass:.1f} kg"
        )
    data = mujoco.MjData(m)
    data.qpos[:] = world.home
    mujoco.mj_forward(m, data)
    met = set()
    for i in range(data.ncon):
        bodies = [int(m.geom_bodyid[g]) for g in data.contact[i].geom]
        if all(bodies) and data.contact[i].dist < 0:
            met.add(tuple(sorted(m.body(b).name for b in bodies)))
    out += [f"{a} and {b} overlap as it stands" for a, b in sorted(met)]
    return out


@checks_types
def check_scene(scene: SceneLike) -> dict[str, str]:
    """Faults of supports, by name; those without one are left out.

    A top steeper than its friction angle bears no load, one below the ground is not
    there, one inside another box cannot be stood on, and none may be where the robot
    starts.

    Args:
        scene: A scene, its file, or the height of one box [m].
    """
    scene, out = load_scene(scene), {}
    for s in scene.supports[1:]:
        slope = float(np.arccos(np.clip(s.normal[2], -1.0, 1.0)))
        corners = s.position + s.polygon @ s.rotation[:, :2].T
        inside = [
            b.name for b in scene.boxes if b.name != s.name and _holds(b, corners)
        ]
        if np.tan(slope) > s.friction:
            out[s.name] = "steeper than its friction angle: no contact can be loaded"
        elif corners[:, 2].max() <= 0:
            out[s.name] = "below the ground"
        elif inside:
            out[s.name] = f"its top is inside {inside[0]}"
        elif s.inside(np.array([*scene.start[:2], s.position[2]])):
            out[s.name] = "the robot starts in it: move start"
    return out


def _holds(box: Box, points: np.ndarray) -> bool:
    """Whether all points (K, 3) are inside a box."""
    local = (points - box.centre) @ box.rotation
    return bool(np.all(np.abs(local) < box.size / 2 - 1e-9))


def check_start(ik: IK, start: Keyframe) -> None:
    """A robot that cannot stand, or stands in a box, is the user's mistake.

    Raises:
        InputError: The robot's home posture falls over or exceeds its effort limits, or
            a box is where it stands.
    """
    world = ik.world
    depth, pair = overlap(ik, start.q, watched_pairs(world, start.stance))
    names = (
        [] if pair < 0 else [world.model.geom(int(g)).name for g in world.pairs[pair]]
    )
    scene = world.scene
    boxes = [
        x.name
        for x in (*scene.boxes, *scene.meshes)
        if x.name in map(scene.owner, names)
    ]
    if depth > 0 and boxes:
        raise InputError(
            "a start where no box is: move the one or the other",
            field="scene.start",
            value=" and ".join(names),
        )
    stable = is_stable(ik.kin, start.q, start.stance)
    if start.com_margin < 0 or not stable:
        why = f"its CoM is {-1e3 * start.com_margin:.0f} mm outside its soles"
        if start.com_margin >= 0:
            why = limiting_joint(ik.kin, start.q, start.stance)
        raise InputError(
            f"a posture that stands within the effort limits ({why})",
            field="robot.home",
        )


def check_reach(ik: IK) -> None:
    """A box that no limb could touch from the start is the user's mistake.

    Raises:
        InputError: The nearest point of the first box's top is farther from where the
            robot stands than legs, trunk and arms are long together.
    """
    kin, world = ik.kin, ik.world
    kin.update(world.home)
    limbs = world.robot.limbs.values()
    shoulder, hip = (
        next(kin.landmark(x.root)[1] for x in limbs if x.is_arm == arm)
        for arm in (True, False)
    )
    trunk = float(np.linalg.norm(shoulder - hip))
    reach = trunk + sum(limb_lengths(kin).values())
    start = np.array([*world.scene.start[:2], 0.0])
    tops = world.scene.tops if world.scene.meshes else world.scene.tops[:1]
    if tops:
        away = [float(np.linalg.norm(t.nearest(start) - start)) for t in tops]
        distance, box = min(zip(away, tops, strict=True), key=lambda x: x[0])
        if distance > reach:
            raise InputError(
                f"the nearest point of its top within {reach:.2f} m of the start,"
                " the robot's reach",
                field=f"scene.{world.scene.kind(box.name)}.{box.name}",
                value=f"{distance:.2f} m away",
            )
