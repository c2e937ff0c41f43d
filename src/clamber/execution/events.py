"""What happened during execution: records, each of which says itself to people."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True, slots=True, kw_only=True)
class Event:
    """Something that was measured or done, at a time [s] of the run."""

    time: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Heavier(Event):
    """The robot's mass is another than described, by this factor."""

    factor: float

    def __str__(self) -> str:
        """The factor in percent."""
        return f"weighs {100 * self.factor:.0f} % of what its description says"


@dataclass(frozen=True, slots=True, kw_only=True)
class StartsElsewhere(Event):
    """The robot does not stand where it was planned: off by [m], turned by [rad]."""

    distance: float
    yaw: float

    def __str__(self) -> str:
        """In millimetres and degrees."""
        return (
            f"starts {1e3 * self.distance:.0f} mm and {math.degrees(self.yaw):.0f}"
            " degrees from where it was planned"
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class ContactMoved(Event):
    """A contact is not where it was planned.

    Attributes:
        surface: That is in contact.
        planned: That was planned to be; another one of the same limb, or the same.
        above, aside: Off along the support's normal and across it [m].
        made: It is just being made; otherwise it is part of the stance.
    """

    surface: str
    planned: str
    above: float
    aside: float
    made: bool

    def __str__(self) -> str:
        """Where, in millimetres."""
        verb = "touches" if self.made else "is"
        if self.surface != self.planned:
            return f"{self.surface} {verb} in place of {self.planned}"
        way = "above" if self.above > 0 else "below"
        return (
            f"{self.surface} {verb} {1e3 * abs(self.above):.0f} mm {way},"
            f" {1e3 * self.aside:.0f} mm beside its planned position"
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Missing(Event):
    """A contact to be made was probed for as deep as `depth` [m], and not found."""

    surface: str
    depth: float

    def __str__(self) -> str:
        """How far was looked."""
        return (
            f"{self.surface} finds no support within {1e3 * self.depth:.0f} mm of its"
            " planned position"
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Lost(Event):
    """A contact of the stance carries no load.

    Attributes:
        surface: In contact.
        given_up: It has been probed for again, in vain.
    """

    surface: str
    given_up: bool = False

    def __str__(self) -> str:
        """And what is done about it."""
        if self.given_up:
            return f"{self.surface} finds no support: the others carry the robot"
        return f"{self.surface} carries no load: probed for again"


@dataclass(frozen=True, slots=True, kw_only=True)
class Unintended(Event):
    """A link carries load on a support where no contact was planned."""

    link: str
    support: str

    def __str__(self) -> str:
        """And what is done about it."""
        return (
            f"unintended contact of {self.link} with {self.support}: back, and on with"
            " extra clearance"
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Replanned(Event):
    """The rest was planned again: so many contact changes."""

    changes: int

    def __str__(self) -> str:
        """How many are left."""
        return f"replanned: {self.changes} contact change{'s' * (self.changes != 1)}"


@dataclass(frozen=True, slots=True, kw_only=True)
class NotReplanned(Event):
    """No better plan was found.

    Attributes:
        why: There is none.
        stays: Nothing is left to do, and the robot stays in its stance; otherwise it
            goes on with the plan at hand.
    """

    why: str
    stays: bool

    def __str__(self) -> str:
        """What is done instead."""
        does = "stays in this stance" if self.stays else "goes on as planned"
        return f"{does} ({self.why})"


@dataclass(frozen=True, slots=True, kw_only=True)
class Stopped(Event):
    """The robot stays in the stance that it has, before the end of the plan."""

    why: str

    def __str__(self) -> str:
        """Why."""
        return f"stopped: {self.why}"


EVENTS: dict[str, type[Event]] = {
    kind.__name__: kind
    for kind in (
        *(Heavier, StartsElsewhere, ContactMoved, Missing, Lost, Unintended),
        *(Replanned, NotReplanned, Stopped),
    )
}


def event_fields(event: Event) -> dict[str, Any]:
    """An event by the keys of `execution.json`: its type, its fields, its sentence."""
    return {"type": type(event).__name__, **asdict(event), "text": str(event)}
