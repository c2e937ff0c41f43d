"""How the true world differs from the planned one, and how well it is sensed."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

from clamber.errors import InputError

LIMITS: dict[str, tuple[float, float]] = {
    "height": (-1.0, 1.0),
    "unevenness": (0.0, 0.2),
    "roll": (-0.8, 0.8),
    "pitch": (-0.8, 0.8),
    "friction": (0.01, 1.0),
    "x": (-1.0, 1.0),
    "y": (-1.0, 1.0),
    "yaw": (-math.pi, math.pi),
    "mass": (0.1, 10.0),
    "effort": (0.01, 10.0),
    "delay": (0.0, 0.1),
    "noise": (0.0, 100.0),
    "push": (0.0, 10_000.0),
    "seed": (0, 2**32),
}


@dataclass(frozen=True, kw_only=True)
class Disturbance:
    """What the planner does not know. Lengths [m], angles [rad], forces [N]."""

    height: float = 0.0
    """Every box is higher by this."""
    unevenness: float = 0.0
    """Tops are warped: tiles whose heights are off by up to this, by `seed`."""
    roll: float = 0.0
    """Boxes are tilted by this about x, through the middle of their near edge."""
    pitch: float = 0.0
    """Boxes are tilted by this about their near edge; positive: the far end sinks."""
    friction: float | None = None
    """Of ground and boxes; none: as in the scene."""
    x: float = 0.0
    """The robot starts off by this."""
    y: float = 0.0
    """The robot starts off by this."""
    yaw: float = 0.0
    """The robot starts turned by this."""
    mass: float = 1.0
    """Factor on the masses and inertias of all links."""
    effort: float = 1.0
    """Factor on the effort limits of all joints."""
    delay: float = 0.002
    """From sensing to command [s]; whole milliseconds."""
    noise: float = 1.0
    """Factor on the noise of the sensors."""
    push: float = 0.0
    """On the pelvis for 0.2 s, horizontal; its time and direction by `seed`."""
    seed: int = 0
    """Of noise, tiles and push."""

    def __post_init__(self) -> None:
        """Check every value.

        Raises:
            InputError: A value is not a number, or out of its bounds.
        """
        for f in fields(self):
            value = getattr(self, f.name)
            if value is None and f.name == "friction":
                continue
            lo, hi = LIMITS[f.name]
            kind, word = (int, "whole ") if f.name == "seed" else ((int, float), "")
            if not isinstance(value, kind) or not lo <= value <= hi:
                raise InputError(
                    f"a {word}number from {lo:g} to {hi:g}",
                    field=f"disturb.{f.name}",
                    value=value,
                )

    @property
    def changes_world(self) -> bool:
        """Whether the true world is another than the planned one."""
        return replace(self, delay=0.002, noise=1.0, push=0.0, seed=0) != Disturbance()
