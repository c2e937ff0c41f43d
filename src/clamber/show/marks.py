"""Overlays of a picture: contacts, their forces, the centre of mass, captions.

Marks lie over the robot, since what they show is mostly behind it. They are drawn
`FINER` times as large as they are seen, so that their edges are smooth.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from clamber.execution.simulation import Rollout
from clamber.model.kinematics import Kinematics
from clamber.model.world import World
from clamber.show.framing import View
from clamber.show.sample import force_by_contact, steadily_loaded, support_below
from clamber.step.posture import Keyframe
from clamber.step.statics import Phase

RGB = tuple[int, int, int]
DARK, PALE, LINE, WHITE = (35, 40, 48), (248, 249, 250), (205, 209, 214), (255,) * 3
# Of a contact. That geometry alone would have it slide, while friction holds it, is no
# fault: it is not red.
PHASE_COLOURS: dict[Phase, RGB] = {
    "supporting": (22, 163, 74),
    "reach-to-supportable": (234, 179, 8),
    "sliding": (79, 70, 229),
}
FORCE_LENGTH = 0.35  # [m] of the arrow of the robot's weight
SMOOTHED = 0.05  # [s] to either side a force is averaged over
FINER = 3
DOT, SHAFT, HEAD = 5.5, 1.6, 5.0  # [pixels] radius, half widths, at `USUAL` height
USUAL = 480.0  # [pixels] height of a picture at which marks have their size


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Mark:
    """A contact that is shown.

    Attributes:
        point: (3,) [m].
        arrow: (3,) from there [m]; zeros where no force is shown.
        colour: Of both.
    """

    point: np.ndarray
    arrow: np.ndarray
    colour: RGB


@functools.cache
def font(size: int) -> Any:
    """Font of captions; `size` in pixels."""
    return ImageFont.load_default(size=size)


def contact_marks(
    kin: Kinematics, loaded: np.ndarray, forces: np.ndarray | None
) -> list[Mark]:
    """The loaded contacts of a robot at its present posture.

    Args:
        kin: The robot.
        loaded: (nS,) bool, the surfaces that bear.
        forces: (nS, 3) on them [N]; None: no arrows.
    """
    found, scale = [], FORCE_LENGTH / (kin.world.mass * 9.81)
    for j, surface in enumerate(kin.world.surfaces):
        if loaded[j]:
            below = support_below(kin.world, kin, surface)
            point = kin.contact_point(surface, below.normal)
            arrow = np.zeros(3) if forces is None else scale * forces[j]
            colour = PHASE_COLOURS["supporting"]
            found.append(Mark(point=point, arrow=arrow, colour=colour))
    return found


def keyframe_marks(world: World, key: Keyframe) -> list[Mark]:
    """The contacts of a keyframe, and the forces that hold it."""
    forces, scale = force_by_contact(world, key), FORCE_LENGTH / (world.mass * 9.81)
    return [
        Mark(
            point=state.contact.position,
            arrow=scale * forces[state.contact.surface],
            colour=PHASE_COLOURS[state.phase],
        )
        for state in key.contacts
    ]


def draw_marks(
    picture: Image.Image,
    view: View,
    marks: Sequence[Mark],
    plumb: np.ndarray | None = None,
) -> None:
    """Draw contacts over a picture.

    Args:
        picture: Is drawn on.
        view: From where it was made.
        marks: Contacts, those farther away first.
        plumb: (2, 3) the centre of mass and the point below it [m].
    """
    size, finer = picture.size, FINER
    ends = [x for m in marks for x in (m.point, m.point + m.arrow)]
    ends += [] if plumb is None else list(plumb)
    if not ends:
        return
    unit = size[1] / USUAL
    at = view.project(np.array(ends), size)
    room = 4 * DOT * unit
    low = np.maximum(np.floor(at.min(axis=0) - room), 0).astype(int)
    high = np.minimum(np.ceil(at.max(axis=0) + room), size).astype(int)
    if np.any(high <= low):
        return
    patch = picture.crop((*low, *high))
    wide, high_ = patch.size
    patch = patch.resize((finer * wide, finer * high_), Image.Resampling.NEAREST)
    draw, at, unit = ImageDraw.Draw(patch), finer * (at - low), finer * unit
    if plumb is not None:
        (x, y), (x2, y2) = at[-2:]
        draw.line((x, y, x2, y2), fill=DARK, width=round(1.4 * unit))
        draw.line(
            (x2 - 6 * unit, y2, x2 + 6 * unit, y2), fill=DARK, width=round(2 * unit)
        )
        dot(draw, (x, y), DOT * unit, DARK, unit)
    for k, mark in enumerate(marks):
        tail, tip = at[2 * k], at[2 * k + 1]
        if np.linalg.norm(tip - tail) > 1.6 * DOT * unit:
            arrow(draw, tail, tip, mark.colour, unit)
    for k, mark in enumerate(marks):
        dot(draw, tuple(at[2 * k]), DOT * unit, mark.colour, unit)
    picture.paste(patch.resize((wide, high_), Image.Resampling.BOX), tuple(low))


def dot(
    draw: ImageDraw.ImageDraw, at: Any, radius: float, colour: RGB, rim: float = 1.0
) -> None:
    """A disc with a white rim of that width."""
    draw.circle(at, radius + rim, fill=WHITE)
    draw.circle(at, radius, fill=colour)


def arrow(
    draw: ImageDraw.ImageDraw,
    tail: np.ndarray,
    tip: np.ndarray,
    colour: RGB,
    unit: float = 1.0,
) -> None:
    """An arrow with a white rim; `unit`: how large a pixel of it is."""
    way = (tip - tail) / np.linalg.norm(tip - tail)
    side = np.array([-way[1], way[0]])
    for rim, fill in ((1.0, WHITE), (0.0, colour)):
        half, wide = (SHAFT + rim) * unit, (HEAD + 1.4 * rim) * unit
        point = tip + 1.6 * rim * unit * way
        neck = tip - (2 * HEAD + rim) * unit * way
        outline = [
            tail + half * side, neck + half * side, neck + wide * side, point,
            neck - wide * side, neck - half * side, tail - half * side,
        ]  # fmt: skip
        draw.polygon([tuple(p) for p in outline], fill=fill)


def loads_of(rollout: Rollout, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(k, nS) bool, what is loaded in rows (k,) of a rollout, and (k, nS, 3) [N].

    Forces shake from one millisecond to the next: those of a row are the mean of what
    is recorded up to `SMOOTHED` before and after it.
    """
    last = len(rollout.time) - 1
    half = round(SMOOTHED / (float(rollout.time[-1]) / max(last, 1)))
    a, b = np.maximum(rows - half, 0), np.minimum(rows + half, last) + 1
    forces = [
        rollout.contact_force[i:j].mean(axis=0) for i, j in zip(a, b, strict=True)
    ]
    return steadily_loaded(rollout)[rows], np.array(forces)
