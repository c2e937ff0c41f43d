"""Options and results of planning."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from clamber.contact.contact import Contact, ContactSequence
from clamber.contact.policy import GeneralPolicy
from clamber.contact.steps import Skipped, Step
from clamber.errors import InputError
from clamber.model.kinematics import Kinematics
from clamber.model.records import frozen_array, short_repr
from clamber.model.shown import Viewed
from clamber.model.world import World
from clamber.planning.timing import Speed
from clamber.planning.trajectory import Trajectory
from clamber.step.change import Change, Failure
from clamber.step.methods import Method
from clamber.step.posture import Keyframe, KeyframeOptions
from clamber.step.stability import equilibrium_at
from clamber.step.statics import StaticEquilibrium

Source = Literal["alternatives", "search", "secondary"]


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class PlanOptions:
    """How a plan is made.

    Attributes:
        method: How contact positions are optimised.
        speed: Largest joint speed [rad/s], the thesis used 0.05; `max`: as fast as
            torques and friction allow.
        max_changes: Contact changes that a policy may take.
        robust: Keep to contact changes throughout which the `robust_margin` is
            positive: mass, friction, centre of mass and contacts may be a little off.
        keyframe: Options of the posture optimisation.
    """

    method: Method = "direct"
    speed: Speed = 2.0
    max_changes: int = 1000
    robust: bool = False
    keyframe: KeyframeOptions = field(default_factory=KeyframeOptions)

    def __post_init__(self) -> None:
        """A robust plan has robust keyframes."""
        if self.robust and not self.keyframe.robust:
            object.__setattr__(self, "keyframe", replace(self.keyframe, robust=True))


@dataclass(frozen=True, slots=True, kw_only=True)
class Iteration:
    """One action of a policy.

    Attributes:
        option: Name of the cycle that it belongs to.
        cost: Cost-to-go after it: from the mean of the contacts to the goal [m].
    """

    option: str
    cost: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Budget:
    """How much a plan may try beyond what is demonstrated.

    Attributes:
        tries: Most steps that each search for other contacts plans; 0: no search. A
            step takes from a tenth of a second to two seconds.
        depth: Most contact changes that a search adds.
        seconds: Time limit of all attempts together [s], checked between two steps;
            None: no limit. With one, what is found depends on the machine.
        ahead: Contact changes of a policy that are planned before it stops for more;
            None: as far as `PlanOptions.max_changes`.
    """

    tries: int = 100
    depth: int = 12
    seconds: float | None = None
    ahead: int | None = None

    def __post_init__(self) -> None:
        """Check that nothing is less than nothing.

        Raises:
            InputError: A field is negative.
        """
        for name in ("tries", "depth", "seconds", "ahead"):
            value = getattr(self, name)
            if value is not None and not value >= 0:
                raise InputError("0 or more", field=f"search.{name}", value=value)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Attempt:
    """A step that was tried.

    Attributes:
        proposer: Who proposed it: `demonstrated`, an alternative's surfaces, `search`.
        step: What it was.
        failure: Why it is not possible; None: it is.
    """

    proposer: str
    step: Step
    failure: Failure | None

    __repr__ = short_repr


@dataclass(frozen=True, slots=True, kw_only=True)
class Tried:
    """Outcome of one proposer.

    Attributes:
        proposer: As of `Attempt`.
        steps: That were tried.
        failed: Of these.
        last: Why the last of those failed; empty where none did.
    """

    proposer: str
    steps: int
    failed: int
    last: str


def summary(attempts: Iterable[Attempt]) -> tuple[Tried, ...]:
    """Outcome of each proposer, in the order in which they were asked."""
    by: dict[str, list[Attempt]] = {}
    for attempt in attempts:
        by.setdefault(attempt.proposer, []).append(attempt)
    out = []
    for proposer, tried in by.items():
        failures = [a.failure for a in tried if a.failure is not None]
        last = str(failures[-1]) if failures else ""
        row = Tried(
            proposer=proposer, steps=len(tried), failed=len(failures), last=last
        )
        out.append(row)
    return tuple(out)


def told(tried: Sequence[Tried]) -> str:
    """One clause: what else was tried, without success, than was demonstrated."""
    others = [t for t in tried if t.proposer not in ("demonstrated", "search")]
    said = "there is no alternative"
    if others:
        n, last = sum(t.steps for t in others), others[-1].last
        said = f"none of {len(others)} alternatives has one ({n} steps tried: {last})"
    for t in tried:
        if t.proposer == "search":
            said += f"; nor has the search ({t.steps} steps tried: {t.last})"
    return said


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class State:
    """The state of a robot from which a plan begins.

    Attributes:
        stance: Its contacts, where they are in the world.
        loaded: Those of them that bear load.
        q: (nq,) its posture, with the commanded joint angles: the motion begins there.
        done: Number of steps of the plan's sequence that it has done.
    """

    stance: tuple[Contact, ...]
    loaded: tuple[Contact, ...]
    q: np.ndarray
    done: int = 0

    __repr__ = short_repr

    def __post_init__(self) -> None:
        """Copy the posture, read-only; what is loaded is of the stance itself."""
        names = {c.surface for c in self.loaded}
        loaded = tuple(c for c in self.stance if c.surface in names)
        object.__setattr__(self, "loaded", loaded)
        object.__setattr__(self, "q", frozen_array(self.q))


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Route:
    """A contact sequence found by a search, complete or not.

    Attributes:
        start: The keyframe that it begins from.
        changes: One after the other.
        failures: Steps left out because there is no way for them, or what it ends at.
        arrived: It gets to where it should.
    """

    start: Keyframe
    changes: tuple[Change, ...] = ()
    failures: tuple[Failure, ...] = ()
    arrived: bool = False

    __repr__ = short_repr

    @property
    def keyframes(self) -> tuple[Keyframe, ...]:
        """The start, then the one after each change."""
        return (self.start, *(c.keyframe for c in self.changes))

    @property
    def end(self) -> Keyframe:
        """The last keyframe."""
        return self.changes[-1].keyframe if self.changes else self.start


def numbered(
    changes: Sequence[Change], index: int = 0, stance: int = 1
) -> tuple[Change, ...]:
    """The changes as the steps of a sequence that has a stance after each of them.

    Args:
        changes: In order.
        index: Of the first one's step.
        stance: That the first one leads to.
    """
    return tuple(
        replace(c, step=replace(c.step, index=index + i, stance=stance + i))
        for i, c in enumerate(changes)
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Fallback:
    """What took the place of what was asked for, and why; as a string, a clause.

    Attributes:
        reason: Why the demonstrated contacts were not taken; empty where they were.
        source: Where the contacts come from that were; None: none was found.
        surfaces: The surfaces that make them.
        detail: The changes that followed a secondary policy, for people.
        tried: Each proposer, with the number of steps that it tried.
    """

    reason: str
    source: Source | None = None
    surfaces: tuple[str, ...] = ()
    detail: str = ""
    tried: tuple[Tried, ...] = ()

    def __str__(self) -> str:
        """Why, and what instead."""
        how = {"alternatives": "of the alternatives", "search": "found by search"}
        if self.source in how:
            used = f"instead, {how[self.source]}: {', '.join(self.surfaces)}"
            return f"{self.reason}; {used}"
        tried = "" if self.source or not self.tried else told(self.tried)
        return "; ".join(filter(None, (self.reason, self.detail, tried)))


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Plan(Viewed):
    """Everything that planning found.

    Attributes:
        world: Robot and scene.
        options: As asked for; the weights are those of the attempt that got farthest.
        sequence: The demonstration at the robot's scale, in its scene.
        start: The first keyframe.
        changes: The contact changes, in order.
        skipped: Stances left out because there was nothing to do.
        failures: Steps that could not be planned; of a policy, the one it stopped at.
        trajectory: The timed reference; None where nothing moves.
        complete: Every step is planned, up to the end.
        state: Where the robot is, if not at the scene's start; the motion begins there
            and goes to the first keyframe.
        fallback: What it does in place of what was asked for; None: nothing.
        policy: The policy that it was planned with; None: it follows a demonstration.
        iterations: The policy's option and cost-to-go, one for each change.
        timings: Computing time by stage [s].
    """

    world: World
    options: PlanOptions
    sequence: ContactSequence
    start: Keyframe
    changes: tuple[Change, ...] = ()
    skipped: tuple[Skipped, ...] = ()
    failures: tuple[Failure, ...] = ()
    trajectory: Trajectory | None
    complete: bool
    state: State | None = None
    fallback: Fallback | None = None
    policy: GeneralPolicy | None = None
    iterations: tuple[Iteration, ...] = ()
    timings: dict[str, float] = field(default_factory=dict)

    __repr__ = short_repr

    @property
    def keyframes(self) -> tuple[Keyframe, ...]:
        """The start, then the one after each change."""
        return (self.start, *(c.keyframe for c in self.changes))

    @property
    def equilibria(self) -> tuple[StaticEquilibrium, ...]:
        """What holds each keyframe, and how firmly; worked out when it is asked for."""
        kin = Kinematics(self.world)
        return tuple(equilibrium_at(kin, k.q, k.stance) for k in self.keyframes)

    @property
    def why_not(self) -> str:
        """The first reason why it is not complete; empty where it is."""
        if self.complete:
            return ""
        reasons = (*map(str, self.failures), *(s.reason for s in self.skipped))
        return next(iter(reasons), "it has no contact change")
