"""What planning is asked for and what it finds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from clamber.contact.contact import Contact, ContactSequence
from clamber.contact.policy import GeneralPolicy
from clamber.contact.steps import Skipped
from clamber.model.world import World
from clamber.planning.trajectory import Trajectory
from clamber.step.path import Path
from clamber.step.posture import Keyframe, KeyframeOptions

Method = Literal["direct", "lbfgs", "gradient"]
Progress = Callable[[str, float, str], None]


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class PlanOptions:
    """How a plan is made.

    Attributes:
        method: How contact positions are optimised.
        speed: Largest joint speed [rad/s], the thesis used 0.05; `max`: as fast as
            joints and contacts bear.
        max_changes: Contact changes that a policy may take.
        keyframe: Options of the posture optimisation.
    """

    method: Method = "direct"
    speed: float | Literal["max"] = 0.3
    max_changes: int = 1000
    keyframe: KeyframeOptions = field(default_factory=KeyframeOptions)


@dataclass(frozen=True, slots=True, kw_only=True)
class Iteration:
    """One action of a policy.

    Attributes:
        option: Name of the cycle that it belongs to.
        cost: Cost-to-go after it: from the mean of the contacts to the goal [m].
    """

    option: str
    cost: float


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Midway:
    """Where a robot is in the middle of a climb.

    Attributes:
        made: Steps of the plan's sequence that have been made.
        contacts: Its stance, each contact where it is.
        loaded: Those of them that bear load already.
        q: (nq,) its posture.
    """

    made: int
    contacts: tuple[Contact, ...]
    loaded: tuple[Contact, ...]
    q: np.ndarray

    def __post_init__(self) -> None:
        """Copy the posture and make it read-only."""
        q = np.array(self.q, dtype=float)
        q.setflags(write=False)
        object.__setattr__(self, "q", q)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Plan:
    """Everything that planning found.

    Attributes:
        world: Robot and scene.
        sequence: The demonstration in the robot's scene.
        options: With the weights of the search that got farthest.
        keyframes: The start first; one more after each path.
        paths: Between neighbouring keyframes.
        skipped: Stances left out, and steps for which there is no way.
        trajectory: None where not even one move was found.
        complete: Every step that the demonstration asks for has a path.
        timings: Seconds by stage.
        midway: Where it begins, where that is not the scene's start: the rest of a
            climb, from its first keyframe, which is settled into.
        instead: Why it makes other contacts than the demonstrated ones, and which, or
            where it followed a secondary policy; empty where it does not.
        policy: That it was planned with; None where it follows a demonstration.
        iterations: Of the policy, one for each path.
    """

    world: World
    options: PlanOptions
    sequence: ContactSequence
    keyframes: tuple[Keyframe, ...]
    paths: tuple[Path, ...]
    skipped: tuple[Skipped, ...]
    trajectory: Trajectory | None
    complete: bool
    timings: dict[str, float]
    midway: Midway | None = None
    instead: str = ""
    policy: GeneralPolicy | None = None
    iterations: tuple[Iteration, ...] = ()
