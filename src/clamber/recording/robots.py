"""A robot's motion as a recording: output of retargeting or trackers, as points.

Root and joints over time, by the words of several tools, become the robot's own points
by its own kinematics: joints at the ends of its limbs' segments, and of hands and feet
the surfaces with which they touch.

Shapes: T samples, n joints.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from clamber.errors import InputError
from clamber.model.kinematics import Kinematics
from clamber.model.robot import load_robot
from clamber.model.scene import Scene
from clamber.model.world import World, build_world
from clamber.recording.pickles import as_array
from clamber.recording.points import FARTHEST, Points

_UP = np.array([0.0, 0.0, 1.0])
_ROOT = ("root_pos", "root_trans_offset", "root_trans", "root_translation", "base_pos")
_TURN = ("root_rot", "root_quat", "root_orientation", "base_quat", "root_rotation")
_W_LAST = ("root_rot", "root_rotation")
_JOINTS = ("dof_pos", "dof_positions", "joint_pos", "joint_positions", "dof", "dofs")
_NAMES = ("joint_names", "dof_names", "joints_list")
_RATE = ("fps", "rate", "mocap_framerate", "motion_fps", "framerate", "frame_rate")
_BODIES = (("body_pos_w", "body_quat_w"), ("body_positions", "body_rotations"))
WORDS = {
    *_ROOT, *_TURN, *_JOINTS, *_NAMES, *_RATE, *(w for both in _BODIES for w in both),
    "qpos", "frames",
}  # fmt: skip
NEEDS_ROBOT = (
    "the robot whose motion this is: --demo-robot (robot in a recording.yaml) names it"
)


def is_motion(found: Mapping[str, object]) -> bool:
    """Whether a file holds a robot's motion."""
    return bool({*_JOINTS, "qpos", "frames"} & found.keys())


def read_motion(
    found: Mapping[str, Any],
    robot: str | Path | None,
    names: Sequence[str] | None,
    rate: float | None,
    path: Path,
) -> Points:
    """Points of a robot that moves so.

    Args:
        found: Of the file, by name.
        robot: A built-in robot, or its robot.yaml.
        names: Of the joints, in order, where the file has none.
        rate: In place of the file's own [Hz].
        path: The file, for messages.

    Raises:
        InputError: No robot is named, or its joints are not the file's.
    """
    if robot is None:
        raise InputError(NEEDS_ROBOT, path)
    try:
        root, turn, joints, w_first = _state(found)
        said = next((found[w] for w in _RATE if w in found), None)
        if rate is None and said is not None:
            rate = float(as_array(said).ravel()[0])
        if names is None:
            listed = next((found[w] for w in _NAMES if w in found), None)
            names = None if listed is None else [str(n) for n in np.ravel(listed)]
    except (ValueError, TypeError, IndexError) as e:
        raise InputError(f"a robot's root and joints over time ({e})", path) from e
    if rate is None:
        raise InputError("a value: the file has none", path, "rate")
    world = build_world(load_robot(robot), Scene(start=np.zeros(3)))
    columns = _columns(world, names, joints.shape[1], path)
    quaternion, order = _quaternions(turn, w_first)
    notes = [f"the motion of {world.robot.name} by its own kinematics, {order}"]
    if names is None:
        notes.append(
            "its joints have no names: taken in the order of the robot's model"
        )
    q = np.tile(world.home, (len(root), 1))
    q[:, :3], q[:, 3:7] = root, quaternion
    q[:, world.qadr[columns]] = joints[:, np.arange(joints.shape[1])]
    if not np.all(np.isfinite(q)) or np.abs(q).max() > FARTHEST:
        raise InputError("finite numbers", path)
    kin = Kinematics(world)
    samples = []
    for row in q:
        kin.update(row)
        samples.append(_points(kin))
    kin.update(world.home)
    return Points(
        names=tuple(samples[0]) if samples else (),
        position=np.array([list(s.values()) for s in samples]),
        rate=rate,
        unit=1.0,
        up="z",
        offsets=_offsets(kin),
        notes=tuple(notes),
    )


def _state(
    found: Mapping[str, Any],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, bool]:
    """Root (T, 3), its turn (T, 3 or 4), joints (T, n), and whether w is usually first.

    It is last in what is called `root_rot`, as Isaac Gym has it.
    """
    if "qpos" in found or "frames" in found:
        whole = as_array(found["qpos" if "qpos" in found else "frames"])
        turn = 4 if "qpos" in found else 3
        if whole.ndim != 2 or whole.shape[1] <= 3 + turn:
            raise ValueError(f"an array {whole.shape}")
        return whole[:, :3], whole[:, 3 : 3 + turn], whole[:, 3 + turn :], True
    joints = as_array(next(found[w] for w in _JOINTS if w in found))
    joints = joints.reshape(len(joints), -1)
    n, names = len(joints), next((found[w] for w in _NAMES if w in found), None)
    if names is not None and joints.shape[1] == np.size(names) + 7:  # the root's, too
        return joints[:, :3], joints[:, 3:7], joints[:, 7:], True
    for place, turn in _BODIES:
        if place in found and turn in found:
            bodies = as_array(found[place]).reshape(n, -1, 3)
            turns = as_array(found[turn]).reshape(n, -1, 4)
            return bodies[:, 0], turns[:, 0], joints, True
    root = next((found[w] for w in _ROOT if w in found), None)
    word = next((w for w in _TURN if w in found), None)
    if root is None or word is None:
        raise ValueError("no root_pos or no root_rot")
    turn = as_array(found[word]).reshape(n, -1)
    return as_array(root).reshape(n, 3), turn, joints, word not in _W_LAST


def _quaternions(turn: np.ndarray, w_first: bool) -> tuple[np.ndarray, str]:
    """Quaternions wxyz (T, 4), and how they were written.

    Three numbers are a rotation vector. Of four, w is first or last as usual, unless
    the root were upside down by that and upright by the other.
    """
    if turn.shape[1] == 3:
        angle = np.linalg.norm(turn, axis=1, keepdims=True)
        axis = turn / np.where(angle > 0, angle, 1.0)
        both = [np.cos(angle / 2), np.sin(angle / 2) * axis]
        return np.concatenate(both, axis=1), "its root turned by rotation vectors"
    if turn.shape[1] != 4:
        return np.full((len(turn), 4), np.nan), ""
    length = np.linalg.norm(turn, axis=1, keepdims=True)
    q = turn / np.where(length > 0, length, np.nan)
    first, last = (
        float(np.median(1.0 - 2.0 * (q[:, a] ** 2 + q[:, b] ** 2)))
        for a, b in ((1, 2), (0, 1))
    )
    if abs(first - last) > 1.0:
        w_first = first > last
    if w_first:
        return q, "quaternions w x y z"
    return q[:, [3, 0, 1, 2]], "quaternions x y z w"


def _columns(
    world: World, names: Sequence[str] | None, count: int, path: Path
) -> np.ndarray:
    """Joint index of each column."""
    own = list(world.joints)
    if names is None and count == len(own):
        return np.arange(count)
    if names is None or len(names) != count:
        expected = (
            f"{len(own)} joints, as {world.robot.name} has, or their `names` in order "
            f"in a recording.yaml: {', '.join(own[:6])} ..."
        )
        raise InputError(expected, path, "joints", count)
    plain = {n.removesuffix("_joint"): i for i, n in enumerate(own)}
    found = [plain.get(n.removesuffix("_joint")) for n in names]
    if None in found or len(set(found)) < len(found):
        k = next(i for i, c in enumerate(found) if c is None or found.index(c) < i)
        expected = f"joints of {world.robot.name}, each once"
        raise InputError(expected, path, "names", names[k])
    return np.array(found)


def _points(kin: Kinematics) -> dict[str, np.ndarray]:
    """The robot's points by their canonical names, where it is now."""
    out = {"Pelvis": kin.point(kin.world.base, np.zeros(3)).copy()}
    for limb in kin.world.robot.limbs.values():
        side = limb.name[0].upper()
        words = (
            ("Shoulder", "Elbow", "Hand") if limb.is_arm else ("Hip", "Knee", "Foot")
        )
        ends = (limb.root, limb.middle, limb.end)
        for word, place in zip(words, ends, strict=True):
            out[side + word] = kin.landmark(place)[1].copy()
        if limb.is_arm and side + "Hand" in limb.surfaces:
            out[side + "Hand.tip"] = kin.contact_point(side + "Hand", _UP).copy()
        if not limb.is_arm and side + "Foot" in limb.surfaces:
            out[side + "Foot.toe"] = _front(kin, side + "Foot")
    return out


def _front(kin: Kinematics, surface: str) -> np.ndarray:
    """(3,) the middle of the front edge of a sole; of another surface what touches."""
    s = kin.world.surfaces[surface]
    if s.rotation is None or len(s.corners) < 2:
        return kin.contact_point(surface, _UP).copy()
    ahead = s.corners @ s.rotation[:, 0]
    front = s.corners[ahead > ahead.mean()]
    return kin.point(s.body, front.mean(axis=0))


def _offsets(kin: Kinematics) -> dict[str, float]:
    """Heights of its points over what they rest on [m], standing; of bent limbs, wide.

    A knee or an elbow rests beside its limb's line: by its surface's distance from it.
    """
    out = {"Hand.tip": 0.0, "Foot.toe": 0.0}
    for limb in kin.world.robot.limbs.values():
        side = limb.name[0].upper()
        middle, end = (kin.landmark(n)[1] for n in (limb.middle, limb.end))
        joint = "Elbow" if limb.is_arm else "Knee"
        if side + joint in limb.surfaces:
            s = kin.world.surfaces[side + joint]
            axis = (end - middle) / np.linalg.norm(end - middle)
            off = kin.point(s.body, s.centre) - middle
            off = off - axis * (off @ axis)
            out[joint] = float(np.linalg.norm(off)) + s.radius
        if not limb.is_arm and side + "Foot" in limb.surfaces:
            out["Foot"] = float(end[2] - _front(kin, side + "Foot")[2])
    return out
