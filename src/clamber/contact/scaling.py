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
from clamber.model.scene import GROUND, Edge, Support
from clamber.model.se3 import matrix_from_quat, quat_from_matrix
from clamber.model.world import World

INSET = 0.03  # [m] of a contact from the border of one of several supports


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


def _obstacles(
    sequence: ContactSequence, world: World
) -> dict[str, tuple[Support, ...]]:
    """Supports of the obstacle for each of the person's, in the order of touching them.

    A box has one, a mesh as many as it has. A robot's own plan means the supports that
    it names.
    """
    touched = list(
        dict.fromkeys(
            c.support
            for s in sequence.stances
            for c in s.contacts
            if c.support != GROUND
        )
    )
    scene, supports = world.scene, world.supports
    if sequence.subject is None and set(touched) <= set(supports):
        return {name: (supports[name],) for name in touched}  # a robot's own plan
    found = [(b.name, (b.top,)) for b in scene.boxes]
    found += [(m.name, m.supports) for m in scene.meshes if m.supports]
    if len(found) < len(touched):
        for m in (m for m in scene.meshes if not m.supports):
            raise InputError(
                "a part of it that is flat, level and wide enough to stand on",
                field=f"scene.meshes.{m.name}",
                value=sorted({r.why for r in m.rejected}) or "nothing flat",
            )
        raise InputError(
            f"as many boxes as the demonstration touches ({len(touched)})",
            field="scene.boxes",
            value=[name for name, _ in found],
        )
    return dict(zip(touched, (tops for _, tops in found), strict=False))


def _near_edge(supports: tuple[Support, ...], start: np.ndarray) -> Edge:
    """The edge nearest to a point (2,), of all edges of some supports."""
    edges = [s.edge_towards(start) for s in supports]
    return min(edges, key=lambda e: float(np.linalg.norm(e.point[:2] - start[:2])))


def _on(supports: tuple[Support, ...], p: np.ndarray) -> Support:
    """The highest of some supports under or over a point (3,), else the nearest."""
    if len(supports) == 1:
        return supports[0]
    level = [np.array([*p[:2], s.level(p)]) for s in supports]
    over = [
        (x[2], i)
        for i, (s, x) in enumerate(zip(supports, level, strict=True))
        if s.inside(x, INSET)
    ]
    if over:
        return supports[max(over)[1]]
    return min(supports, key=lambda s: float(np.linalg.norm(s.nearest(p, INSET) - p)))


def retarget(sequence: ContactSequence, kin: Kinematics) -> ContactSequence:
    """Bring a sequence into the robot's scene, at the robot's scale.

    Feet that stand on the ground in the first stance are put where the robot starts;
    later ground contacts keep their scaled offset from there.

    Args:
        sequence: As demonstrated.
        kin: Workspace of the robot in its scene.

    Raises:
        InputError: The scene has fewer boxes than the demonstration touches.
    """
    world = kin.world
    kin.update(world.home)
    scales = limb_scales(dict(sequence.subject) if sequence.subject else None, kin)
    obstacles = _obstacles(sequence, world)
    there_start, here_start = _ground_start(sequence), world.scene.start[:2]
    edges = {
        a: (
            sequence.scene.support(a).edge_towards(there_start),
            _near_edge(tops, here_start),
        )
        for a, tops in obstacles.items()
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
            x, y, _ = there.rotation.T @ (c.position - there.point)
            position = here.point + here.rotation @ np.array([scale * x, scale * y, 0])
            s = _on(obstacles[c.support], position)
            support, position = s.name, position - s.normal * s.height(position)
            if len(obstacles[c.support]) > 1:
                position = s.nearest(position, INSET)
        R = turn @ matrix_from_quat(c.quaternion)
        return Contact(
            surface=c.surface,
            support=support,
            position=position,
            quaternion=quat_from_matrix(R),
            fixed=c.fixed,
        )

    # Most contacts are those of the stance before.
    each = {id(c): c for s in sequence.stances for c in s.contacts}
    brought = {i: move(c) for i, c in each.items()}
    stances = []
    for s in sequence.stances:
        moved = tuple(x for c in s.contacts if (x := brought[id(c)]) is not None)
        posture = {n: turn @ u for n, u in s.posture.items()}
        stances.append(Stance(contacts=moved, posture=posture))
    return replace(
        sequence, scene=world.scene, stances=tuple(stances), subject=None, intervals=()
    )
