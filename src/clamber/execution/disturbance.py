"""Differences of the simulated world from the planned one, and sensor noise."""

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
    """Disturbances that the planner does not know.

    Attributes:
        height: Boxes are higher than planned by this [m].
        unevenness: Tops of boxes are uneven: tiles are up to this much [m] too high or
            too low, drawn by `seed`.
        roll: Boxes are tilted by this [rad] about x, through the middle of their near
            edge.
        pitch: Boxes are tilted by this [rad] about their near edge; positive: the far
            end sinks.
        friction: Friction coefficient of ground and boxes, in place of the scene's.
        x: Error of the start position along x [m].
        y: Error of the start position along y [m].
        yaw: Error of the start heading [rad].
        mass: Factor on the masses and inertias of all links.
        effort: Factor on the effort limits of all joints.
        delay: Latency from sensing to command [s], in whole milliseconds.
        noise: Factor on the sensors' noise.
        push: Horizontal force [N] on the pelvis for 0.2 s, at a time and in a direction
            drawn by `seed`.
        seed: Seed of the random numbers: noise, tiles, push.
    """

    height: float = 0.0
    unevenness: float = 0.0
    roll: float = 0.0
    pitch: float = 0.0
    friction: float | None = None
    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0
    mass: float = 1.0
    effort: float = 1.0
    delay: float = 0.002
    noise: float = 1.0
    push: float = 0.0
    seed: int = 0

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
