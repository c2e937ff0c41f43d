"""Path -> the fastest time law along all of it that joints and contacts can bear.

With q(s) given, joint torques and contact forces are linear in u = d2s/dt2 and
x = (ds/dt)^2 [Bobrow85]. In each interval of the path some forces within
the friction cones and some torques within the limits must produce (u, x): how fast each
interval may be begun is found from the end backwards, then the law from the start, by a
small LP each with the forces as variables [Hauser14, Pham18]. Only the two ends are at
rest. Where the path itself turns back its tangent is zero: there s goes on.

Shapes: n intervals of the path, nv velocities.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np

from clamber.contact.contact import Contact
from clamber.model.kinematics import Kinematics
from clamber.model.records import short_repr
from clamber.planning.samples import RATE
from clamber.step.tasks import packed_contacts

Speed = float | Literal["max"]

BASE_LENGTH = 0.3  # [m] of base translation count as one radian
# [rad/s] of the fastest joint, and [1/s] its acceleration against that: inertia is
# nothing, and where not even rest is within the limits the robot moves like this.
SLOW, SLOWLY = 0.3, 2.0
SMOOTHING = 0.06  # [s] width of the kernel that rounds the acceleration's corners
STEP = 1.0 / RATE  # [s]
# Made use of by inertia, of what is left between rest and the border of what can be
# borne. With 0.8 one climb in ten fell at `max`, on boxes 2 cm higher than planned.
SHARE = 0.6
_FLAT = 1e-3  # a path is no flatter than this: where nothing moves, nothing is limited


@dataclass(frozen=True, slots=True, kw_only=True)
class Pace:
    """Bounds of a motion besides joint limits and contact forces.

    Attributes:
        speed: Of the fastest joint [rad/s].
        quickness: [1/s] a joint's acceleration against that: at 4 rad/s and 6 / s what
            servos of 600 N m/rad and 50 N m follow within 0.02 rad on links of half a
            kg m^2.
        touch_speed: [m/s] along the normal, near a contact to be made.
        touch_zone: [m] what is near, in the middle of an interval.
    """

    speed: float
    quickness: float = 6.0
    touch_speed: float = 0.08
    touch_zone: float = 0.02


FASTEST = Pace(speed=4.0, quickness=10.0, touch_speed=0.12, touch_zone=0.01)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Course:
    """A path in intervals.

    Attributes:
        s: (n + 1,) increasing, their ends; the first and the last are at rest.
        q: (n, nq) in their middles.
        slope: (n, nv) dq/ds on the manifold.
        bend: (n, nv) its derivative, d2q/ds2.
        steep, sharp: (n,) the largest of both, of any joint anywhere in the interval;
            base translation scaled.
        stance: (n,) of `stances`, which contacts may bear.
        stances: By number.
        makes: (n,) the contact to be made soon, gently; None for none.
    """

    s: np.ndarray
    q: np.ndarray
    slope: np.ndarray
    bend: np.ndarray
    steep: np.ndarray
    sharp: np.ndarray
    stance: np.ndarray
    stances: Sequence[Sequence[Contact]]
    makes: Sequence[Contact | None]

    __repr__ = short_repr


def inertia_along(kin: Kinematics, course: Course) -> tuple[np.ndarray, np.ndarray]:
    """(n, nv) generalised forces for each unit of u, and of x, besides gravity's."""
    m, d = kin.world.model, kin.data
    of_u, of_x = np.empty_like(course.slope), np.empty_like(course.slope)
    bent, still, moving = np.zeros((3, m.nv))
    for i, q in enumerate(course.q):
        kin.update(q)
        mujoco.mj_makeM(m, d)
        mujoco.mj_mulM(m, d, of_u[i], course.slope[i])
        mujoco.mj_mulM(m, d, bent, course.bend[i])
        for v, out in (0.0, still), (course.slope[i], moving):
            d.qvel[:] = v
            mujoco.mj_comVel(m, d)
            mujoco.mj_rne(m, d, 0, out)
        of_x[i] = bent + moving - still
    d.qvel[:] = 0.0
    return of_u, of_x


def fastest(
    kin: Kinematics,
    course: Course,
    inertia: tuple[np.ndarray, np.ndarray],
    speed: Speed,
) -> np.ndarray:
    """(n + 1,) squared rate (ds/dt)^2 of the fastest law from rest to rest.

    Args:
        kin: Workspace.
        course: The path.
        inertia: Along it, see `inertia_along`.
        speed: Of the fastest joint [rad/s].
    """
    w = kin.world
    pace = FASTEST if speed == "max" else Pace(speed=speed)
    v, quickness = pace.speed, pace.quickness
    steep, bend = (np.maximum(x, _FLAT) for x in (course.steep, course.sharp))
    x_max = np.minimum((v / steep) ** 2, quickness * v / bend)
    for i, c in enumerate(course.makes):
        if c is not None:
            x_max[i] = min(
                x_max[i], _gentle(kin, c, course.q[i], course.slope[i], pace)
            )
    slow = min(v, SLOW)
    x_slow = np.minimum((slow / steep) ** 2, SLOWLY * slow / bend)
    return kin.core.time_law(
        [packed_contacts(w, c) for c in course.stances],
        course.stance.astype(np.int32),
        course.q,
        course.slope,
        *inertia,
        np.stack(
            [
                np.diff(course.s),
                *(quickness * v / steep, x_max),
                *(SLOWLY * slow / steep, x_slow),
            ]
        ),
        w.model.dof_damping,
        SHARE,
    )


def largest(x: np.ndarray) -> np.ndarray:
    """(n,) of tangent vectors (n, nv): of any joint, base translation scaled."""
    return np.maximum(
        np.abs(x[:, 3:]).max(axis=1), np.abs(x[:, :3]).max(axis=1) / BASE_LENGTH
    )


def _gentle(
    kin: Kinematics, c: Contact, q: np.ndarray, slope: np.ndarray, pace: Pace
) -> float:
    """Bound of x near a contact to be made, infinite where it is not near."""
    n = kin.world.supports[c.support].normal
    kin.update(q)
    p = kin.contact_point(c.surface, n, c.edge)
    if (p - c.position) @ n >= pace.touch_zone:
        return math.inf
    J = kin.point_jacobian(kin.world.surfaces[c.surface].body, p)
    return (pace.touch_speed / max(abs(float(n @ J @ slope)), 1e-9)) ** 2


def sample_law(s: np.ndarray, x: np.ndarray) -> np.ndarray:
    """(2, m) path s and ds/dt at each millisecond after the start, made smooth.

    In each interval the acceleration is constant. The law is averaged over a window
    of time, so that its acceleration has no steps; the rate stays its derivative.

    Args:
        s: (n,) ends of intervals.
        x: (n,) squared rates, zero at both ends.
    """
    rate = np.sqrt(x)
    dt = 2.0 * np.diff(s) / np.maximum(rate[1:] + rate[:-1], 1e-9)
    knots = np.concatenate([[0.0], np.cumsum(dt)])
    m = round(SMOOTHING / STEP)
    kernel = 1.0 - np.cos(2.0 * np.pi * (np.arange(m) + 0.5) / m)
    kernel /= kernel.sum()
    n = math.ceil(knots[-1] / STEP) + m
    t = STEP * (np.arange(1 - m, n) + 1.0)
    i = np.clip(np.searchsorted(knots, t, side="right") - 1, 0, len(dt) - 1)
    tau = np.clip(t, 0.0, knots[-1]) - knots[i]
    u = np.diff(rate) / np.maximum(dt, 1e-12)
    raw = s[i] + tau * (rate[i] + 0.5 * u[i] * tau)
    fast = np.where((t <= 0) | (t >= knots[-1]), 0.0, rate[i] + u[i] * tau)
    return np.stack([np.convolve(x, kernel, "valid") for x in (raw, fast)])
