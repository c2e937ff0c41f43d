"""Events of execution: records with a readable `str`."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, ClassVar


@dataclass(frozen=True, slots=True, kw_only=True)
class Event:
    """Something that was measured or done.

    Lengths are in metres, angles in radians. `says` is the sentence, its fields filled
    in by `str`.

    Attributes:
        time: Time in the run [s].
    """

    says: ClassVar[str]
    time: float

    def __str__(self) -> str:
        """For people."""
        return self.says.format(**asdict(self))


@dataclass(frozen=True, slots=True, kw_only=True)
class Heavier(Event):
    """The robot's mass is another than described."""

    says = "measured mass is {factor:.0%} of the model's"
    factor: float


@dataclass(frozen=True, slots=True, kw_only=True)
class StartsElsewhere(Event):
    """The robot does not stand where it was planned."""

    says = "start pose is off by {distance:.3f} m and {yaw:.2f} rad"
    distance: float
    yaw: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ContactMoved(Event):
    """A contact is not where it was planned.

    Attributes:
        surface: The surface in contact.
        planned: The surface that was planned: the same, or another of its limb.
        above, aside: Deviation along the support's normal and across it [m].
        made: The contact is just being made; else it is part of the stance.
    """

    surface: str
    planned: str
    above: float
    aside: float
    made: bool

    def __str__(self) -> str:
        """For people."""
        what = "made contact" if self.made else "is in contact"
        if self.surface != self.planned:
            return f"{self.surface} {what} in place of {self.planned}"
        way = "above" if self.above > 0 else "below"
        return (
            f"{self.surface} {what} {abs(self.above):.3f} m {way} and"
            f" {self.aside:.3f} m beside its planned position"
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Paused(Event):
    """The robot was told to slow down and stand.

    Attributes:
        seconds: That it stands.
    """

    says = "told to pause: slowing down, standing for {seconds:.0f} s"
    seconds: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Missing(Event):
    """A contact to be made was probed for, `depth` deep, and not found."""

    says = "{surface}: no contact within {depth:.2f} m of its planned position"
    surface: str
    depth: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Lost(Event):
    """A contact of the stance carries no load: it is re-established by probing."""

    says = "{surface}: contact lost (no load), probing to re-establish it"
    surface: str


@dataclass(frozen=True, slots=True, kw_only=True)
class GivenUp(Event):
    """A lost contact was not re-established: the stance goes on without it."""

    says = "{surface}: contact not re-established, continuing on the other contacts"
    surface: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Unintended(Event):
    """A link carries load on a support where no contact was planned."""

    says = "unintended contact of {link} with {support}: backing off, more clearance"
    link: str
    support: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Replanned(Event):
    """What is left was planned again: so many contact changes."""

    says = "replanned: {changes} contact changes remain"
    changes: int


@dataclass(frozen=True, slots=True, kw_only=True)
class KeptPlan(Event):
    """No better plan was found: the one at hand is followed on."""

    says = "continuing with the current plan ({why})"
    why: str


@dataclass(frozen=True, slots=True, kw_only=True)
class KeptStance(Event):
    """No other plan was found, and none is needed: nothing is left to do."""

    says = "holding this stance ({why})"
    why: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Stopped(Event):
    """The robot stays in the stance that it has, before the end of the plan."""

    says = "stopped: {why}"
    why: str


EVENTS: dict[str, type[Event]] = {
    kind.__name__: kind
    for kind in (
        *(Heavier, StartsElsewhere, ContactMoved, Missing, Lost, GivenUp, Unintended),
        *(Replanned, KeptPlan, KeptStance, Stopped),
    )
}


def event_fields(event: Event) -> dict[str, Any]:
    """An event by the keys of `execution.json`: its type, its fields, its sentence."""
    return {"type": type(event).__name__, **asdict(event), "text": str(event)}
