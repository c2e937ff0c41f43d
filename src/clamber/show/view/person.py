"""A recording as a stick figure: bones, joints and detected contacts over time.

Shapes: T samples, B bones, J joints.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from clamber.contact.contact import ContactSequence
from clamber.model.scene import Scene
from clamber.recording.demonstration import SIDES, Demonstration, wrist
from clamber.show.view.shown import Touch

CHEST = "Chest"  # the middle of the shoulders, which no recording has
GAP = 0.3  # [m] between the robot's scene and the person's


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Person:
    """A recording as it is shown.

    Attributes:
        sequence: What was detected in it; None where that could not be done.
        position: (T, F, 3) points [m], in the robot's world; seen: (T, F) bool.
        bones: (B, 2) indices of their ends among the points.
        joints: (J,) indices of the points that are ends of bones, the head last.
        offset: (3,) where its world is put [m].
    """

    demo: Demonstration
    sequence: ContactSequence | None
    position: np.ndarray
    seen: np.ndarray
    bones: np.ndarray
    joints: np.ndarray
    offset: np.ndarray


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Figure:
    """The person at a time.

    Attributes:
        bones: (B, 2, 3) their ends [m].
        joints: (J, 3) [m].
        seen: (B,) bool, both ends were recorded then.
        touches: Contacts, where they were detected.
    """

    bones: np.ndarray
    joints: np.ndarray
    seen: np.ndarray
    touches: tuple[Touch, ...]


def show_person(
    demo: Demonstration, sequence: ContactSequence | None, offset: np.ndarray
) -> Person:
    """Find the bones of a recording.

    Args:
        demo: The recording.
        sequence: What was detected in it, at the person's scale.
        offset: (3,) where its world is put [m].
    """
    names = (*demo.names, CHEST)
    at = {n: i for i, n in enumerate(names)}
    pairs = [("LShoulder", CHEST), (CHEST, "RShoulder"), ("LHip", "RHip")]
    pairs += [("Pelvis", CHEST), (CHEST, "Neck"), ("Neck", "Head")]
    for side in SIDES:
        hand = wrist(demo.names, side)
        pairs += [(side + "Shoulder", side + "Elbow"), (side + "Elbow", hand)]
        pairs += [(hand, side + "Hand"), (side + "Hand", side + "Hand.tip")]
        pairs += [(side + a, side + b) for a, b in (("Hip", "Knee"), ("Knee", "Foot"))]
        pairs += [(side + "Foot", side + "Foot.toe")]
    bones = np.array(
        [(at[a], at[b]) for a, b in pairs if a in at and b in at and a != b]
    )
    joints = np.unique(bones)
    if "Head" in at:
        joints = np.append(joints[joints != at["Head"]], at["Head"])
    shoulders = [at["LShoulder"], at["RShoulder"]]
    chest = demo.position[:, shoulders].mean(axis=1, keepdims=True)
    both = demo.valid[:, shoulders].all(axis=1, keepdims=True)
    offset = np.asarray(offset, dtype=float)
    return Person(
        demo=demo,
        sequence=sequence,
        position=np.concatenate([demo.position, chest], axis=1) + offset,
        seen=np.concatenate([demo.valid, both], axis=1),
        bones=bones,
        joints=joints,
        offset=offset,
    )


def figure_at(person: Person, t: float) -> Figure:
    """The person at a time of the recording [s]; at its ends outside of it."""
    demo = person.demo
    t = float(np.clip(t, demo.t[0], demo.t[-1]))
    i = min(int(np.searchsorted(demo.t, t, side="right")) - 1, len(demo.t) - 2)
    share = (t - demo.t[i]) / (demo.t[i + 1] - demo.t[i])
    p = (1 - share) * person.position[i] + share * person.position[i + 1]
    touches = []
    for x in person.sequence.intervals if person.sequence is not None else ():
        if not x.t0 <= t < x.t1:
            continue
        support = demo.scene.support(x.contact.support)
        touches.append(
            Touch(
                surface=x.part,
                support=support.name,
                position=x.contact.position + person.offset,
                normal=support.normal,
                friction=support.friction,
                loaded=True,
                phase="supporting",
                force=None,
            )
        )
    return Figure(
        bones=p[person.bones],
        joints=p[person.joints],
        seen=person.seen[i, person.bones].all(axis=1),
        touches=tuple(touches),
    )


def beside(
    scene: Scene, points: np.ndarray, other: Scene, person: np.ndarray
) -> np.ndarray:
    """(3,) the way from the person's world to a place to the right of the robot's.

    The two start abreast; between the boxes, and all that moves, there is a gap.

    Args:
        scene: The robot's.
        points: (n, 3) where the robot is [m].
        other: The person's scene.
        person: (m, 3) where the person is [m].
    """
    yaw = float(scene.start[2])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])  # cameras stand to the left
    here = np.concatenate([points, _corners(scene)]) @ right
    there = np.concatenate([person, _corners(other)]) @ right
    start = np.array([*scene.start[:2], 0.0])
    ahead = start - np.array([*other.start[:2], 0.0])
    ahead -= (ahead @ right) * right
    return ahead + (float(here.max()) - float(there.min()) + GAP) * right


def _corners(scene: Scene) -> np.ndarray:
    """(8 n, 3) of the boxes [m]."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    corners = [b.position + (signs * b.size / 2) @ b.rotation.T for b in scene.boxes]
    return np.concatenate(corners) if corners else np.zeros((0, 3))


def change_times(person: Person) -> list[float]:
    """When the stance changes, and both ends [s]."""
    t = person.demo.t
    ends = [float(t[0]), float(t[-1])]
    inner = [] if person.sequence is None else person.sequence.t[1:-1].tolist()
    return sorted({*ends, *(float(x) for x in inner)})
