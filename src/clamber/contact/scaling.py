"""A person's contact sequence in the robot's scene, at the robot's scale.

Positions are taken relative to the near edge of the obstacle that they lie on: depth
behind the edge, distance to the side of where the climber stands, height over the
support. Depth and side are scaled by the length of the limb that makes the contact,
robot's over person's; the height over the support is zero by definition.

Edge frame E: origin on the near edge abreast of the ankles' midpoint, x into the
obstacle, z up.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from clamber.contact.contact import Contact, ContactSequence, Stance
from clamber.errors import InputError
from clamber.model.kinematics import Kinematics, limb_lengths
from clamber.model.records import short_repr
from clamber.model.scene import GROUND, Support
from clamber.model.se3 import matrix_from_quat, quat_from_matrix
from clamber.model.world import World


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class _Edge:
    origin: np.ndarray
    rotation: np.ndarray  # R_WE

    __repr__ = short_repr

    def to_local(self, p: np.ndarray) -> np.ndarray:
        return self.rotation.T @ (p - self.origin)

    def to_world(self, p: np.ndarray) -> np.ndarray:
        return self.origin + self.rotation @ p


def near_edge(support: Support, start: np.ndarray) -> _Edge:
    """The edge frame of a support seen from `start` (x, y)."""
    corners = support.position + support.polygon @ support.rotation[:, :2].T
    best = None
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        along = (b - a)[:2]
        along = along / np.linalg.norm(along)
        inward = np.array([-along[1], along[0]])  # ccw polygon: inside lies to the left
        ahead = float((a[:2] - start) @ inward)
        s = float(np.clip((start - a[:2]) @ along, 0.0, np.linalg.norm((b - a)[:2])))
        foot = a[:2] + s * along
        score = (float(np.linalg.norm(foot - start)), -ahead)
        if best is None or score < best[0]:
            z = a[2] + (b[2] - a[2]) * s / max(np.linalg.norm((b - a)[:2]), 1e-9)
            best = (score, np.array([foot[0], foot[1], z]), inward)
    assert best is not None
    x = np.array([best[2][0], best[2][1], 0.0])
    R = np.stack([x, np.array([-x[1], x[0], 0.0]), [0.0, 0.0, 1.0]], axis=1)
    return _Edge(origin=best[1], rotation=R)


def limb_scales(subject: dict[str, float] | None, kin: Kinematics) -> dict[str, float]:
    """Robot's over person's length of each limb; 1 where the plan is a robot's own."""
    if subject is None:
        return {"arm": 1.0, "leg": 1.0}
    robot = limb_lengths(kin)
    out = {}
    for limb, parts in (("arm", ("upper_arm", "forearm")), ("leg", ("thigh", "shank"))):
        out[limb] = sum(robot[p] for p in parts) / sum(subject[p] for p in parts)
    return out


def _ground_start(sequence: ContactSequence) -> np.ndarray:
    for stance in sequence.stances:
        feet = [c.position[:2] for c in stance.contacts if c.support == GROUND]
        if feet:
            return np.mean(feet, axis=0)
    return sequence.scene.start[:2]


def _box_names(sequence: ContactSequence, world: World) -> dict[str, str]:
    """Robot's box for each of the person's, in the order in which they are touched.

    A robot's own plan means the boxes that it names.
    """
    touched = list(
        dict.fromkeys(
            c.support
            for s in sequence.stances
            for c in s.contacts
            if c.support != GROUND
        )
    )
    boxes = [b.name for b in world.scene.boxes]
    if sequence.subject is None and set(touched) <= set(boxes):
        return {name: name for name in touched}  # a robot's own plan
    if len(boxes) < len(touched):
        raise InputError(
            f"as many boxes as the demonstration touches ({len(touched)})",
            field="scene.boxes",
            value=boxes,
        )
    return dict(zip(touched, boxes, strict=False))


def retarget(sequence: ContactSequence, world: World) -> ContactSequence:
    """Bring a sequence into the robot's scene, at the robot's scale.

    Feet that stand on the ground in the first stance are put where the robot starts;
    later ground contacts keep their scaled offset from there.

    Raises:
        InputError: The scene has fewer boxes than the demonstration touches.
    """
    kin = Kinematics(world)
    kin.update(world.home)
    scales = limb_scales(dict(sequence.subject) if sequence.subject else None, kin)
    names = _box_names(sequence, world)
    there_start, here_start = _ground_start(sequence), world.scene.start[:2]
    edges = {
        a: (
            near_edge(sequence.scene.support(a), there_start),
            near_edge(world.supports[b], here_start),
        )
        for a, b in names.items()
    }
    yaw = world.scene.start[2]
    if edges:
        there, here = next(iter(edges.values()))
        turn = here.rotation @ there.rotation.T
    else:
        turn = np.array(
            [[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1.0]]
        )
    first: dict[str, np.ndarray] = {}

    def move(c: Contact) -> Contact | None:
        if c.surface not in world.surfaces:
            return None
        scale = scales["arm" if world.robot.limb_of(c.surface).is_arm else "leg"]
        if c.support == GROUND:
            home = kin.contact_point(c.surface, np.array([0.0, 0.0, 1.0]))
            home[2] = 0.0
            offset = c.position - first.setdefault(c.surface, c.position)
            position, support = home + turn @ (scale * offset), GROUND
        else:
            there, here = edges[c.support]
            support = names[c.support]
            local = there.to_local(c.position)
            position = here.to_world(
                np.array([scale * local[0], scale * local[1], 0.0])
            )
            s = world.supports[support]
            position = position - s.normal * s.height(position)
        R = turn @ matrix_from_quat(c.quaternion)
        return Contact(
            surface=c.surface,
            support=support,
            position=position,
            quaternion=quat_from_matrix(R),
            fixed=c.fixed,
        )

    stances = []
    for s in sequence.stances:
        moved = tuple(x for x in map(move, s.contacts) if x is not None)
        posture = {n: turn @ u for n, u in s.posture.items()}
        stances.append(Stance(contacts=moved, posture=posture))
    return replace(
        sequence, scene=world.scene, stances=tuple(stances), subject=None, intervals=()
    )
