"""Transition -> collision-free path: control points and the postures at them.

The moving surface follows an arc (4.29). At each control point the posture is solved
from the one before, balanced on the contacts that stay; a control point nearer to
anything than `p_safe`, itself or through the links below it, is pushed along the normal
until it keeps that distance (4.30): in the QP the arc is a soft target and every
distance a constraint, so the push is the constraint's doing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from clamber import _core
from clamber.contact.contact import Contact
from clamber.errors import Status
from clamber.model.kinematics import Kinematics
from clamber.model.records import short_repr
from clamber.model.world import World
from clamber.step.ik import IK
from clamber.step.stability import limiting_joint
from clamber.step.tasks import packed_contacts, packed_parts
from clamber.step.transition import Transition

DRIFT_LIMIT: float = _core.DRIFT_LIMIT  # [m] of contacts, anywhere on the path
OVERLAP_LIMIT: float = _core.OVERLAP_LIMIT  # [m] of links, anywhere on the path


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Phase:
    """Postures in order while the same contacts are closed.

    Attributes:
        kind: shift (the weight), swing (the limb) or settle (load on the new contact).
        q: (n, nq) postures; the first is the last of the phase before.
        contacts: Contacts closed.
        load_before, load_after: Contacts that bear load at its start and end.
        arc: (m, 3) control points of the moving surface before adaptation; empty where
            nothing moves.
    """

    kind: str
    q: np.ndarray
    contacts: tuple[Contact, ...]
    load_before: tuple[Contact, ...]
    load_after: tuple[Contact, ...]
    arc: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))

    __repr__ = short_repr


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Path:
    """The phases of one transition; end points equal its postures."""

    transition: Transition
    phases: tuple[Phase, ...]
    status: Status
    note: str = ""

    __repr__ = short_repr


def plan_path(ik: IK, transition: Transition, *, adapt: bool = True) -> Path:
    """Postures along the whole transition, checked at all of them and half-way between.

    Args:
        ik: Workspace.
        transition: Its four postures.
        adapt: Push control points away from collisions (4.30); without it the arc is
            taken as it is, for comparison.
    """
    t = transition
    postures = [t.before, t.shifted, t.touching, t.after]
    *postures, control, found = ik.core.path(
        postures,
        packed_parts(ik.world, t.held, t.rolling, t.step.makes),
        t.margin,
        adapt,
    )
    phases = contact_phases(
        t.stance, t.held, t.rolling, t.step.makes, postures, control
    )
    status, note = _verdict(ik, t, found)
    return Path(transition=t, phases=phases, status=status, note=note)


def check_phases(
    ik: IK, t: Transition, postures: Sequence[np.ndarray]
) -> tuple[Status, str]:
    """Overlaps and contacts at all postures and half-way, without the solver.

    Whether the contacts hold the robot at the postures of a swing, too: those at its
    ends the transition has looked at, and while weight shifts more contacts bear.

    Args:
        ik: Workspace.
        t: Whose contacts are looked at.
        postures: (n, nq) of shift, swing and settle.
    """
    return _verdict(
        ik,
        t,
        ik.core.check_path(
            list(postures), packed_parts(ik.world, t.held, t.rolling, t.step.makes)
        ),
    )


_KINDS = ("shift", "swing", "settle")


def _verdict(
    ik: IK, t: Transition, found: tuple[int, int, float, int, np.ndarray]
) -> tuple[Status, str]:
    """The core's verdict on a path, in words."""
    status, phase, depth, pair, weak = found
    kind = _KINDS[phase]
    if status == _core.PATH_OPENS:
        return Status.UNREACHABLE, f"a contact opens by {1e3 * depth:.0f} mm ({kind})"
    note = ""
    if pair >= 0:
        names = [ik.world.model.geom(int(g)).name for g in ik.world.pairs[pair]]
        note = f"{' and '.join(names)} overlap by {1e3 * depth:.1f} mm ({kind})"
    if status == _core.PATH_OVERLAPS:
        return Status.COLLIDING, note
    if status == _core.PATH_WEAK:
        return Status.OVERLOADED, limiting_joint(ik.kin, weak, t.held)
    return Status.SOLVED, note


def contact_phases(
    stance: tuple[Contact, ...],
    held: tuple[Contact, ...],
    rolling: tuple[Contact, ...],
    made: Contact | None,
    postures: Sequence[np.ndarray],
    arc: np.ndarray,
) -> tuple[Phase, Phase, Phase]:
    """The phases that change one contact: shift, swing and settle.

    Args:
        stance: Contacts before it.
        held: Those that stay; a foot that goes on tiptoe is on its edge here.
        rolling: Those that are broken, as they are let go.
        made: The new contact, if any.
        postures: (n, nq) of each phase.
        arc: (m, 3) control points of the swing.
    """
    after = held if made is None else (*held, made)
    shift, swing, settle = postures
    return (
        Phase(
            kind="shift",
            q=shift,
            contacts=(*held, *rolling),
            load_before=stance,
            load_after=held,
        ),
        Phase(
            kind="swing",
            q=swing,
            contacts=held,
            load_before=held,
            load_after=held,
            arc=arc,
        ),
        Phase(
            kind="settle",
            q=settle,
            contacts=after,
            load_before=held,
            load_after=after,
        ),
    )


def interpolate(kin: Kinematics, a: np.ndarray, b: np.ndarray, s: float) -> np.ndarray:
    """(nq,) at share `s` of the geodesic from `a` to `b`."""
    return kin.integrate(a, s * kin.difference(a, b))


def bridge(
    ik: IK, a: np.ndarray, b: np.ndarray, contacts: Sequence[Contact]
) -> np.ndarray:
    """(n, nq) postures from `a` to `b`, all contacts closed, near the geodesic."""
    return ik.core.bridge(a, b, *packed_contacts(ik.world, contacts))


def can_be_gone(ik: IK, q: np.ndarray, contacts: Sequence[Contact]) -> bool:
    """Whether contacts stay closed and hold the robot along a way, without overlaps.

    Args:
        ik: Workspace.
        q: (n, nq) postures; half-way between is looked at, too.
        contacts: All that bear load.
    """
    parts = packed_parts(ik.world, contacts, (), None)
    status, *_ = ik.core.check_path([q[:1], q, q[-1:]], parts)
    return not status


def straightened(ik: IK, settle: Phase, shift: Phase) -> tuple[Phase, Phase] | None:
    """Two phases of one stance, from the first posture to the last without a detour.

    The posture in which the new contact is best loaded lies between them; on the way to
    the next change the robot need not come by. It is left halfway along the new way.

    Args:
        ik: Workspace.
        settle: A contact has been made.
        shift: The next one is to be changed.

    Returns:
        None where the stance is another one, or that way cannot be gone.
    """
    contacts = settle.contacts
    if {(c.surface, c.edge) for c in contacts} != {
        (c.surface, c.edge) for c in shift.contacts
    }:
        return None
    q = bridge(ik, settle.q[0], shift.q[-1], contacts)
    if not can_be_gone(ik, q, contacts):
        return None
    if len(q) == 2:
        q = np.stack([q[0], interpolate(ik.kin, q[0], q[1], 0.5), q[1]])
    half = len(q) // 2
    return replace(settle, q=q[: half + 1]), replace(shift, q=q[half:])


def watched_pairs(world: World, contacts: Sequence[Contact]) -> np.ndarray:
    """(P,) bool: pairs that must not overlap; those of the contacts may."""
    out = np.ones(len(world.pairs), bool)
    for c in contacts:
        mine = np.isin(world.pairs, world.surfaces[c.surface].geoms).any(axis=1)
        support = np.isin(world.pairs, world.support_geom[c.support]).any(axis=1)
        out &= ~(mine & support)
    return out


def overlap(ik: IK, q: np.ndarray, watched: np.ndarray) -> tuple[float, int]:
    """Deepest overlap at `q` [m] among the watched pairs, and which pair; 0, -1: none.

    Leaves the kinematics at `q`.
    """
    ik.kin.update(q)
    near = ik.kin.proximity(0.0, watched)
    if len(near.distance) == 0:
        return 0.0, -1
    i = int(np.argmin(near.distance))
    return -float(near.distance[i]), int(near.pairs[i])
