"""Motion from the posture measured on a robot to the first posture of its plan.

A straight line in joint angles, along it a minimum-jerk profile,

    s(x) = 10 x^3 - 15 x^4 + 6 x^5,    x = t / T,

at rest at both ends; its largest speed is 15/8 of the mean [Flash85]. The base stays
where it is at the start.

Shapes: n samples, na joints.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Real
from pathlib import Path

import numpy as np

from clamber.contact.contact import Contact
from clamber.errors import InputError, read_yaml
from clamber.model.kinematics import Kinematics
from clamber.model.records import short_repr
from clamber.model.world import World
from clamber.planning.trajectory import holding_torques

SPEED = 0.5  # [rad/s] of the fastest joint
PEAK = 1.875  # largest over mean speed of a minimum-jerk motion
CHECK_STEP = 0.01  # [rad] of the fastest joint between two looks at distances
TORQUE_NODES = 11  # postures whose torques are computed


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class States:
    """A motion of the whole robot.

    Attributes:
        q: (n, nq); v: (n, nv) its derivative on the manifold; tau: (n, na) [N m].
    """

    q: np.ndarray
    v: np.ndarray
    tau: np.ndarray

    __repr__ = short_repr

    def then(self, after: States) -> States:
        """This, then another."""
        return States(
            q=np.concatenate([self.q, after.q]),
            v=np.concatenate([self.v, after.v]),
            tau=np.concatenate([self.tau, after.tau]),
        )


def measured_posture(
    world: World, given: str | Path | Mapping[str, float]
) -> np.ndarray:
    """(na,) joint angles [rad] in the world's order.

    Args:
        world: Of the robot.
        given: Angles by joint, a YAML or JSON file of them, or `home`.

    Raises:
        InputError: A joint is unknown, missing, no number, or beyond its limits.
    """
    if isinstance(given, Mapping):
        source, angles = "lead_in", given
    elif str(given) == "home":
        return world.home[world.qadr].copy()
    else:
        source, angles = given, read_yaml(Path(given))
    if unknown := [str(n) for n in angles if n not in world.joints]:
        known = f"a joint of {world.robot.name}: {', '.join(world.joints)}"
        raise InputError(known, source, unknown[0])
    out = np.empty(len(world.joints))
    for i, name in enumerate(world.joints):
        if name not in angles:
            raise InputError("an angle of every joint: there is none", source, name)
        low, high = (x[world.dadr[i]] for x in (world.q_min, world.q_max))
        x = angles[name]
        number = isinstance(x, Real) and not isinstance(x, bool)
        if not number or not low <= x <= high:  # NaN is not either
            text = f"{low:.4g} to {high:.4g} rad, its limits"
            raise InputError(text, source, name, "nothing" if x is None else x)
        out[i] = x
    return out


def lead_in_motion(
    world: World,
    measured: np.ndarray,
    motion: States,
    *,
    stance: tuple[Contact, ...],
    rate: int,
    speed: float = SPEED,
) -> States:
    """Move from a measured posture to the first one of a plan, up to a sample before.

    Args:
        world: Of the plan.
        measured: (na,) joint angles [rad].
        motion: That begins with the first one.
        stance: Its contacts.
        rate: [Hz].
        speed: Of the fastest joint [rad/s].

    Raises:
        InputError: The speed is none, or links would meet on the way.
    """
    if not (speed > 0 and math.isfinite(speed)):
        raise InputError("more than 0 rad/s", "--lead-in-speed", value=speed)
    first = motion.q[0]
    way = first[world.qadr] - measured
    n = math.ceil(PEAK * float((np.abs(way) / speed).max(initial=0.0)) * rate)
    if n:
        _check(world, measured, first, stance)
    x = np.arange(n) / max(n, 1)
    s = x**3 * (10 - 15 * x + 6 * x**2)
    slope = 30 * x**2 * (1 - x) ** 2 * rate / max(n, 1)
    q = np.tile(first, (n, 1))
    q[:, world.qadr] = measured + s[:, None] * way
    v = np.zeros((n, world.model.nv))
    v[:, world.dadr] = slope[:, None] * way
    kin = Kinematics(world)
    nodes = np.linspace(0.0, 1.0, TORQUE_NODES)
    between = np.array([_between(world, measured, first, x) for x in nodes[:-1]])
    held = holding_torques(kin, between, stance)
    columns = np.transpose([*held, motion.tau[0]])
    torques = [np.interp(s, nodes, column) for column in columns]
    return States(q=q, v=v, tau=np.stack(torques, axis=1))


def _between(
    world: World, measured: np.ndarray, first: np.ndarray, share: float
) -> np.ndarray:
    """(nq,) the posture after a share of the way."""
    q = first.copy()
    q[world.qadr] = measured + share * (q[world.qadr] - measured)
    return q


def _check(
    world: World, measured: np.ndarray, first: np.ndarray, stance: tuple[Contact, ...]
) -> None:
    """Refuse a motion in which links collide with each other or the scene.

    A surface against the support that it stands on is not looked at: where the legs
    are bent more or less than in the first posture, the base gives way, which is held
    here.
    """
    kin = Kinematics(world)
    standing = {
        (g, world.support_geom[c.support])
        for c in stance
        for g in world.surfaces[c.surface].geoms
    }
    looked_at = np.array(
        [not {(a, b), (b, a)} & standing for a, b in world.pairs.tolist()]
    )
    way = float(np.abs(first[world.qadr] - measured).max())
    for share in np.linspace(0.0, 1.0, math.ceil(way / CHECK_STEP) + 1):
        kin.update(_between(world, measured, first, float(share)))
        near = kin.proximity(0.0, looked_at)
        if len(near.distance):
            i = int(np.argmin(near.distance))
            a, b = (world.model.geom(int(g)).name for g in world.pairs[near.pairs[i]])
            where = f"after {100 * share:.0f} % of the way" if share else "in it"
            text = (
                "a measured posture from which the first one is reached in a straight"
                f" line: {a} and {b} would meet {where}"
            )
            raise InputError(text, "--lead-in")
