"""Robot, policy -> how far its limbs step, where they rest, how it stands.

Everything is in proportion to the robot's own limbs and trunk, so that a robot of
another size goes the same way.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from clamber.contact.policy import GeneralPolicy
from clamber.model.kinematics import Kinematics
from clamber.model.records import short_repr
from clamber.model.robot import Limb
from clamber.model.se3 import turn_about_z

STEPS = 3.0  # f of (5.9): a step is this part of a limb's length, or as was shown
STAND = 0.54  # lengths of a leg from the feet to an edge that is to be climbed
REACH = 0.65  # lengths of an arm that hands reach beyond a stand
# Contacts while climbing, from the edge inwards: in steps of the limb.
DEPTH = {"hand": 2.0, "elbow": 1.4, "knee": 0.35}
# Contacts on all fours: ahead of the body's middle or behind it in lengths of the trunk
# (shorter, and more cycles fail: limbs that are near one another cannot let go), and to
# its side in half distances between shoulders or hips.
AHEAD, BESIDE_ARMS, BESIDE_LEGS = 0.35, 1.1, 1.35
STRETCH = 0.57  # lengths of the trunk from the body's middle to hands or knees
# While climbing, to the side: shares of what it is on all fours.
HANDS_BESIDE, KNEES_BESIDE = 0.36, 0.9
BEHIND = 0.8  # share of the way from an edge to where the body is after a climb


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class StairSteps:
    """Where limbs go on stairs.

    Attributes:
        lead: Hands are set down so far ahead of the feet [m].
        gap: Feet come no nearer to the hands than this [m].
        knee: Knees come so far behind the last edge, at least [m].
        span: From knees to hands at the end [m].
        sides: Of each surface, to the left of the way [m].
    """

    lead: float
    gap: float
    knee: float
    span: float
    sides: Mapping[str, float]

    __repr__ = short_repr


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Proportions:
    """What a robot's lengths say of its steps.

    Attributes:
        step: Of each limb (5.9) [m].
        offsets: (2,) of each limb's contact from the body's frame, on all fours [m].
        feet: Half the distance between the feet [m].
        ahead: (2,) from the ankles' midpoint to the feet's, in the body's frame [m].
        stand: From the feet to an edge that is to be climbed [m].
        behind: From an edge to the body's middle before it climbs down [m].
        reach: From the feet to an edge, at most [m].
        height: That hands reach, standing [m].
        thigh: [m]
        stretch: Half of what it is stretched by on hands and knees [m].
        radius: Of what the body takes up while it turns on all fours [m].
        stairs: On stairs.
    """

    step: Mapping[str, float]
    offsets: Mapping[str, np.ndarray]
    feet: float
    ahead: np.ndarray
    stand: float
    behind: float
    reach: float
    height: float
    thigh: float
    stretch: float
    radius: float
    stairs: StairSteps

    __repr__ = short_repr

    def mount(self, limb: Limb, surface: str) -> np.ndarray:
        """(2,) from an edge inwards, and to the left, where a climb sets a surface."""
        outer = surface == limb.surfaces[0]
        side = self.offsets[limb.name][1]
        if not limb.is_arm:
            kind, side = "knee", KNEES_BESIDE * side
        else:
            kind, side = ("hand", HANDS_BESIDE * side) if outer else ("elbow", side)
        return np.array([DEPTH[kind] * self.step[limb.name], side])


def proportions_of(kin: Kinematics, policy: GeneralPolicy) -> Proportions:
    """The robot's lengths as it stands, and steps as long as the policy shows."""
    world = kin.world
    kin.update(world.home)
    along = turn_about_z(world.scene.start[2])
    limbs = world.robot.limbs.values()
    arms = [x for x in limbs if x.is_arm]
    legs = [x for x in limbs if not x.is_arm]

    def apart(a: str, b: str) -> float:
        return float(np.linalg.norm(kin.landmark(a)[1] - kin.landmark(b)[1]))

    def half_width(pair: list[Limb]) -> float:
        left, right = (along.T @ kin.landmark(x.root)[1][:2] for x in pair)
        return 0.5 * abs(float(left[1] - right[1]))

    trunk = apart(arms[0].root, legs[0].root)
    side = {True: BESIDE_ARMS * half_width(arms), False: BESIDE_LEGS * half_width(legs)}
    length, step, offsets = {}, {}, {}
    for x in limbs:
        length[x.name] = apart(x.root, x.middle) + apart(x.middle, x.end)
        shown = [policy.reach[s] for s in x.surfaces if s in policy.reach]
        step[x.name] = min(1.0 / STEPS, max(shown, default=1.0)) * length[x.name]
        ahead = AHEAD * trunk if x.is_arm else -AHEAD * trunk
        left = 1.0 if x.name.startswith("left") else -1.0
        offsets[x.name] = np.array([ahead, left * side[x.is_arm]])
    leg, arm = length[legs[0].name], length[arms[0].name]
    thigh = apart(legs[0].root, legs[0].middle)
    up = np.array([0.0, 0.0, 1.0])
    soles = [kin.contact_point(x.surfaces[0], up)[:2] for x in legs]
    feet = 0.5 * float(np.linalg.norm(soles[0] - soles[1]))
    sides = {s: float(offsets[x.name][1]) for x in limbs for s in x.surfaces}
    sides |= {x.surfaces[0]: math.copysign(feet, sides[x.surfaces[0]]) for x in legs}
    stand, arm_step = STAND * leg, min(step[x.name] for x in arms)
    rear = max(-o[0] for o in offsets.values())
    return Proportions(
        step=step,
        offsets=offsets,
        feet=feet,
        ahead=along.T @ (np.mean(soles, axis=0) - world.scene.start[:2]),
        stand=stand,
        behind=BEHIND * (rear + DEPTH["knee"] * min(step.values())),
        reach=stand + REACH * arm,
        height=leg + trunk + arm,
        thigh=thigh,
        stretch=STRETCH * trunk,
        # The shanks trail behind the knees.
        radius=max(float(np.linalg.norm(o)) for o in offsets.values()) + leg - thigh,
        stairs=StairSteps(
            lead=stand + DEPTH["hand"] * arm_step,
            gap=arm_step,
            knee=DEPTH["knee"] * min(step[x.name] for x in legs),
            span=float(offsets[arms[0].name][0] - offsets[legs[0].name][0]),
            sides=sides,
        ),
    )
