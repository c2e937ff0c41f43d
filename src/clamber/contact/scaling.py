"""A person's contact sequence in the robot's scene, at the robot's scale.

Positions are taken relative to the near edge of the obstacle that they lie on: depth
behind the edge, distance to the side of where the climber stands, height over the
support. Depth and side are scaled by the length of the limb that makes the contact,
robot's over person's; the height over the support is zero by definition.

Edge frame E: origin on the near edge abreast of the ankles' midpoint, x into the
obstacle, z up.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from clamber.contact.contact import Contact, ContactSequence, Stance
from clamber.errors import InputError
from clamber.model.kinematics import Kinematics, limb_lengths
from clamber.model.scene import GROUND
from clamber.model.se3 import matrix_from_quat, quat_from_matrix
from clamber.model.world import World


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
    boxes = [s.name for s in world.scene.tops]
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
            sequence.scene.support(a).edge_towards(there_start),
            world.supports[b].edge_towards(here_start),
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
            x, y, _ = there.rotation.T @ (c.position - there.point)
            position = here.point + here.rotation @ np.array([scale * x, scale * y, 0])
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
