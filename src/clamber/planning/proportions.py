"""Robot, policy -> how far its limbs step, where they rest, how it stands.

Everything is in proportion to the robot's own limbs and trunk, so that a robot of
another size goes the same way.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from clamber.contact.policy import GeneralPolicy
from clamber.model.se3 import turn_about_z
from clamber.planning.stairs import Gait
from clamber.step.ik import IK

STEPS = 3.0  # f of (5.9): a step is this part of a limb's length, or as was shown
# Where the body stands before an edge, in lengths of its legs.
STAND = 0.54
REACH = 0.65  # lengths of an arm that hands reach beyond a stand
# Contacts while climbing, from the edge inwards: in steps of the limb.
DEPTH = {"hand": 2.0, "elbow": 1.4, "knee": 0.35}
STRETCH = 0.57  # lengths of the trunk from the body's middle to hands or knees


@dataclass(frozen=True, eq=False, slots=True)
class Build:
    """What a robot's build says of its steps.

    Attributes:
        step: Of each limb (5.9) [m].
        fours: (2,) offset of each limb's contact from the body's frame, on all fours.
        feet: Half the distance between the feet.
        ahead: (2,) from the ankles' midpoint to the feet's, in the body's frame.
        stand: From the feet to an edge that is to be climbed [m].
        reach: From the feet to an edge, at most [m].
        tall: Height that hands reach, standing [m].
        thigh: [m]
        stretch: Half of what it is stretched by on hands and knees [m].
        round: Radius of what the body takes up while it turns on all fours [m].
        gait: On stairs.
    """

    step: dict[str, float]
    fours: dict[str, np.ndarray]
    feet: float
    ahead: np.ndarray
    stand: float
    reach: float
    tall: float
    thigh: float
    stretch: float
    round: float
    gait: Gait


def build_of(ik: IK, policy: GeneralPolicy) -> Build:
    """The robot's lengths as it stands, and steps as long as the policy shows."""
    world, kin = ik.world, ik.kin
    kin.update(world.home)
    along = turn_about_z(world.scene.start[2])
    limbs = world.robot.limbs.values()
    root = {x.name: along.T @ kin.landmark(x.root)[1][:2] for x in limbs}
    arms = [x for x in limbs if x.is_arm]
    legs = [x for x in limbs if not x.is_arm]
    length = {
        x.name: sum(
            float(np.linalg.norm(kin.landmark(a)[1] - kin.landmark(b)[1]))
            for a, b in ((x.root, x.middle), (x.middle, x.end))
        )
        for x in limbs
    }
    trunk = float(
        np.linalg.norm(kin.landmark(arms[0].root)[1] - kin.landmark(legs[0].root)[1])
    )
    step = {}
    for x in limbs:
        shown = [policy.reach[s] for s in x.surfaces if s in policy.reach]
        step[x.name] = min(1.0 / STEPS, max(shown, default=1.0)) * length[x.name]
    half = {
        kind: 0.5 * abs(float(root[a.name][1] - root[b.name][1]))
        for kind, (a, b) in (("arm", arms), ("leg", legs))
    }
    fours = {}
    for x in limbs:
        sign = 1.0 if x.name.startswith("left") else -1.0
        side = 1.1 * half["arm"] if x.is_arm else 1.35 * half["leg"]
        ahead = 0.35 * trunk if x.is_arm else -0.35 * trunk
        fours[x.name] = np.array([ahead, sign * side])
    up = np.array([0.0, 0.0, 1.0])
    soles = [kin.contact_point(x.surfaces[0], up)[:2] for x in legs]
    leg, arm = length[legs[0].name], length[arms[0].name]
    thigh = float(
        np.linalg.norm(kin.landmark(legs[0].root)[1] - kin.landmark(legs[0].middle)[1])
    )
    feet = 0.5 * float(np.linalg.norm(soles[0] - soles[1]))
    ahead = along.T @ (np.mean(soles, axis=0) - world.scene.start[:2])
    stand, arm_step = STAND * leg, min(step[x.name] for x in arms)
    sides = {}
    for x in limbs:
        y = fours[x.name][1]
        sides |= dict.fromkeys(x.surfaces, float(y))
        if not x.is_arm:
            sides[x.surfaces[0]] = math.copysign(feet, y)
    return Build(
        step=step,
        fours=fours,
        feet=feet,
        ahead=ahead,
        stand=stand,
        reach=stand + REACH * arm,
        tall=leg + trunk + arm,
        thigh=thigh,
        stretch=STRETCH * trunk,
        # The shanks trail behind the knees.
        round=max(float(np.linalg.norm(x)) for x in fours.values()) + leg - thigh,
        gait=Gait(
            lead=stand + DEPTH["hand"] * arm_step,
            gap=arm_step,
            knee=DEPTH["knee"] * min(step[x.name] for x in legs),
            span=float(fours[arms[0].name][0] - fours[legs[0].name][0]),
            sides=sides,
        ),
    )
