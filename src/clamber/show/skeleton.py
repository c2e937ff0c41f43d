"""A recording as bones, joints and detected contacts over time.

Shapes: T samples, F points, B bones.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from clamber.contact.contact import (
    ContactInterval,
    ContactSequence,
    Region,
    region_of,
)
from clamber.model.records import short_repr
from clamber.model.scene import Scene
from clamber.planning.records import Plan
from clamber.recording.built_in import BUILT_IN, source_of
from clamber.recording.demonstration import SIDES, Demonstration, wrist
from clamber.show.framing import box_corners

CHEST = "Chest"  # the middle of the shoulders, which no recording has
GAP = 0.3  # [m] between the robot's scene and the person's


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Skeleton:
    """A recording as it is shown.

    Attributes:
        sequence: What was detected in it; None where that could not be done.
        position: (T, F, 3) points [m]; seen: (T, F) bool.
        bones: (B, 2) indices of their ends among the points.
        head: Index of the head among the points; None where there is none.
    """

    demo: Demonstration
    sequence: ContactSequence | None
    position: np.ndarray
    seen: np.ndarray
    bones: np.ndarray
    head: int | None

    __repr__ = short_repr

    def at(self, t: float) -> tuple[np.ndarray, np.ndarray]:
        """Points (F, 3) [m] at a time [s], its ends outside of it; seen: (F,) bool."""
        times = self.demo.t
        i = int(np.clip(np.searchsorted(times, t, "right") - 1, 0, len(times) - 2))
        share = np.clip((t - times[i]) / (times[i + 1] - times[i]), 0.0, 1.0)
        p = (1 - share) * self.position[i] + share * self.position[i + 1]
        return p, self.seen[i]

    def contacts(self, t: float) -> list[ContactInterval]:
        """Contacts that were detected at a time [s]."""
        found = () if self.sequence is None else self.sequence.intervals
        return [x for x in found if x.t0 <= t < x.t1]

    def changes(self) -> list[float]:
        """When the stance changes, and both ends [s]."""
        t = self.demo.t
        inner = [] if self.sequence is None else self.sequence.t[1:-1].tolist()
        return sorted({float(t[0]), float(t[-1]), *inner})


def skeleton_of(demo: Demonstration, sequence: ContactSequence | None) -> Skeleton:
    """Find the bones of a recording.

    Args:
        demo: The recording.
        sequence: What was detected in it, at the person's scale.
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
    shoulders = [at["LShoulder"], at["RShoulder"]]
    chest = demo.position[:, shoulders].mean(axis=1, keepdims=True)
    both = demo.valid[:, shoulders].all(axis=1, keepdims=True)
    return Skeleton(
        demo=demo,
        sequence=sequence,
        position=np.concatenate([demo.position, chest], axis=1),
        seen=np.concatenate([demo.valid, both], axis=1),
        bones=np.array(
            [(at[a], at[b]) for a, b in pairs if a in at and b in at and a != b]
        ),
        head=at.get("Head"),
    )


def recording_named(source: str) -> str | None:
    """The recording that a sequence names as its source, where it can be found."""
    for name in BUILT_IN:
        if source == source_of(name):
            return name
    return source if source and Path(source).is_file() else None


def to_the_right(
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
    here = np.concatenate([points, corners(scene)]) @ right
    there = np.concatenate([person, corners(other)]) @ right
    start = np.array([*scene.start[:2], 0.0])
    ahead = start - np.array([*other.start[:2], 0.0])
    ahead -= (ahead @ right) * right
    return ahead + (float(here.max()) - float(there.min()) + GAP) * right


def corners(scene: Scene) -> np.ndarray:
    """(8 n, 3) of the boxes [m]."""
    corners = [box_corners(b.size, b.centre, b.rotation) for b in scene.boxes]
    return np.concatenate(corners) if corners else np.zeros((0, 3))


def paired_times(
    plan: Plan, reached: Sequence[float | None], end: float, person: Skeleton
) -> tuple[np.ndarray, np.ndarray]:
    """Times (n,) of robot and person at which they make the same contact [s].

    A policy makes contacts of its own: there the two leave the ground at the same time,
    are wholly on top, and back on the ground, as far as they do so in the same order.
    Between these times the one clock is the other one, stretched.

    Args:
        plan: What was to be done.
        reached: When each keyframe is reached [s].
        end: Of the robot's motion [s].
        person: Whom the plan goes back to.
    """
    if plan.policy is not None and person.sequence is not None:
        pairs, last = _at_regions(plan, reached, person.sequence)
    else:
        t = plan.sequence.t
        pairs, last = [(0.0, float(t[0]))], float(t[-1])
        for change, at in zip(plan.changes, reached[1:], strict=True):
            if change.step.index is not None and at is not None and at > pairs[-1][0]:
                pairs.append((at, float(t[change.step.stance])))
    if end > pairs[-1][0]:
        pairs.append((end, last))
    robot, other = zip(*pairs, strict=True)
    return np.array(robot), np.array(other)


def _at_regions(
    plan: Plan, reached: Sequence[float | None], person: ContactSequence
) -> tuple[list[tuple[float, float]], float]:
    """Times at which both come to the same region, and where the person is after."""
    keys = zip(reached, plan.keyframes, strict=True)
    mine = _entered((at, region_of(k.stance)) for at, k in keys if at is not None)
    began = person.t[:-1].tolist()
    stances = zip(began, person.stances, strict=True)
    theirs = _entered((t, s.region) for t, s in stances)
    pairs = [(0.0, theirs[0][0])]
    if mine[0][1] == theirs[0][1]:
        for (at, region), (t, other) in zip(mine[1:], theirs[1:], strict=False):
            if region != other or at <= pairs[-1][0]:
                break
            pairs.append((at, t))
    k = len(pairs)
    after = k == len(mine) < len(theirs)  # the robot gets no farther
    return pairs, theirs[k][0] if after else float(person.t[-1])


def _entered(stances: Iterable[tuple[float, Region]]) -> list[tuple[float, Region]]:
    """When each region begins, of times with the region that one is in from then on."""
    runs = itertools.groupby(stances, key=lambda x: x[1])
    return [next(group) for _, group in runs]
