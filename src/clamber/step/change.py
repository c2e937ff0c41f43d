"""One contact change: the next keyframe and the way to it, or why there is none."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np

from clamber.contact.contact import Contact
from clamber.contact.steps import Step
from clamber.errors import Status
from clamber.model.records import short_repr
from clamber.model.scene import GROUND
from clamber.model.se3 import matrix_from_quat, matrix_from_rpy, quat_from_matrix
from clamber.model.world import World
from clamber.step.ik import IK
from clamber.step.methods import METHODS, Method, direct
from clamber.step.path import Phase, plan_path
from clamber.step.posture import (
    ROBUST_BALANCE,
    Keyframe,
    KeyframeOptions,
    KeyframeTask,
    finish,
    orientation_at,
)
from clamber.step.robust import robust_margin_along
from clamber.step.stability import limiting_joint, out_of_reach
from clamber.step.tasks import support_rotation
from clamber.step.transition import (
    Shift,
    approach_contact,
    margins_of,
    plan_shift,
    plan_transition,
    rolled,
)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Change:
    """One contact change that is possible.

    Attributes:
        step: The limb and its contacts; the new one at its optimised place.
        keyframe: The posture after the change.
        phases: The motion there: weight shift, swing, loading.
        margin: Least distance of the centre of mass, throughout the change, from the
            border of the support polygon [m].
    """

    step: Step
    keyframe: Keyframe
    phases: tuple[Phase, ...]
    margin: float

    __repr__ = short_repr

    @property
    def leaving(self) -> tuple[Contact, ...]:
        """The contacts that are broken."""
        breaks = self.step.breaks
        return tuple(c for c in self.phases[0].load_before if c.surface in breaks)

    @property
    def shifted(self) -> np.ndarray:
        """(nq,) the posture with the weight on the contacts that stay."""
        return self.phases[0].q[-1]

    @property
    def touching(self) -> np.ndarray:
        """(nq,) the posture in which the new contact is closed, not yet loaded."""
        return self.phases[1].q[-1]


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Failure:
    """Why a step cannot be planned; as a string, a sentence.

    Attributes:
        status: The kind of reason.
        step: The step that fails; None where no single one does.
        detail: The reason in full, where there is more to say than `status` does.
    """

    status: Status
    step: Step | None = None
    detail: str = ""

    __repr__ = short_repr

    def __str__(self) -> str:
        """The step and the reason."""
        why = self.detail or self.status.value
        return why if self.step is None else f"{self.step}: {why}"


def standing(
    ik: IK, options: KeyframeOptions, at: np.ndarray | None = None
) -> Keyframe:
    """Both feet on the ground in the posture that the robot starts from.

    Args:
        ik: Workspace.
        options: Of the posture optimisation.
        at: (3,) ankles' midpoint x, y [m] and yaw [rad]; None: where the robot starts.
    """
    world, kin = ik.world, ik.kin
    home = world.home if at is None else home_at(world, at)
    kin.update(home)
    up = world.supports[GROUND].normal
    feet = []
    for limb in world.robot.limbs.values():
        if limb.is_arm:
            continue
        surface = limb.surfaces[0]
        s = world.surfaces[surface]
        p = kin.contact_point(surface, up)
        R = kin.rotation(s.body) @ (s.rotation if s.rotation is not None else np.eye(3))
        p = p - up * (p @ up)
        R = support_rotation(world.supports[GROUND], quat_from_matrix(R))
        feet.append(
            Contact(
                surface=surface,
                support=GROUND,
                position=p,
                quaternion=quat_from_matrix(R),
            )
        )
    task = KeyframeTask(held=tuple(feet), new=(), q_reference=home)
    return finish(
        ik,
        task,
        options,
        home,
        method="home",
        iterations=0,
        cost_before=0.0,
    )


def _home_over(world: World, feet: Sequence[Contact]) -> np.ndarray:
    """(nq,) the posture that the robot starts from, over feet somewhere."""
    x, y, z = np.mean([c.position for c in feet], axis=0)
    headings = np.sum([matrix_from_quat(c.quaternion)[:, 0] for c in feet], axis=0)
    q = home_at(world, np.array([x, y, np.arctan2(headings[1], headings[0])]))
    q[2] += z
    return q


def home_at(world: World, at: np.ndarray) -> np.ndarray:
    """(nq,) the posture that the robot starts from, moved along the ground.

    Args:
        world: Robot and scene.
        at: (3,) ankles' midpoint x, y [m] and yaw [rad].
    """
    start, q = world.scene.start, world.home.copy()
    R = matrix_from_rpy(np.array([0.0, 0.0, at[2] - start[2]]))
    q[:2] = R[:2, :2] @ (q[:2] - start[:2]) + at[:2]
    q[3:7] = quat_from_matrix(R @ matrix_from_quat(q[3:7]))
    return q


def change_contact(
    ik: IK,
    before: Keyframe,
    step: Step,
    options: KeyframeOptions,
    method: Method = "direct",
) -> Change | Failure:
    """Change one contact: the next keyframe and the way to it, or why there is none.

    What is tried, until something works: on the contacts that stay as they are, then,
    where a contact is made, with their feet on tiptoe, which reach farther; each with
    the new contact where the optimisation puts it and where the unloaded robot reaches
    it (the other way round where its place is prescribed); each with every one of
    `MARGINS`. Where nothing works and the step `turns`, a flat surface lies as it comes
    to where the unloaded robot reaches.

    Args:
        ik: Workspace.
        before: The keyframe to begin from.
        step: What to change.
        options: Of the posture optimisation.
        method: By which it places the new contact.

    Returns:
        Where there is no way, what the last attempt without tiptoe failed at.
    """
    failure = None
    footings = [
        (held, cache(partial(plan_shift, ik, before, step, held)))
        for held in _footings(ik, before, step)
    ]
    margins = _margins(ik, options)
    for held, shift in footings:
        found = _unbalanced(shift, step, margins)
        if found is None:
            for key in _keyframes(ik, before, step, held, options, method):
                found = _change(ik, shift, key, step, options)
                if isinstance(found, Change):
                    return found
        failure = failure or found
    if step.turns and step.makes is not None:
        for held, shift in footings:
            if _unbalanced(shift, step, margins) is not None:
                continue
            key = _keyframe_turned(ik, before, step, held, options)
            found = _change(ik, shift, replace(key, method=method), step, options)
            if isinstance(found, Change):
                return found
    if failure is None:
        why = "no other contact is loaded"
        return Failure(status=Status.UNBALANCED, step=step, detail=why)
    return failure


def _footings(ik: IK, before: Keyframe, step: Step) -> Iterator[tuple[Contact, ...]]:
    """Support stances of a step: the contacts that stay, then with feet on tiptoe."""
    held = tuple(c for c in before.stance if c.surface not in step.breaks)
    if not held:
        return
    yield held
    if step.makes is not None:
        tiptoe = tuple(rolled(ik, before.q, c, step.makes.position) for c in held)
        if any(a is not b for a, b in zip(held, tiptoe, strict=True)):
            yield tiptoe


def _keyframes(
    ik: IK,
    before: Keyframe,
    step: Step,
    held: tuple[Contact, ...],
    options: KeyframeOptions,
    method: Method,
) -> Iterator[Keyframe]:
    """Postures in which the contact is changed, on the contacts `held`."""
    wanted = step.makes
    task = _task(ik.world, before, step, held)
    begin = task.q_reference if step.stands_up else before.q
    for there in (True, False) if step.fixed else (False, True):
        if there and wanted is not None:
            # Put the contact where the unloaded robot reaches it.
            key = _keyframe_there(ik, task, wanted, step, before.q, options)
            yield replace(key, method=method)
            continue
        key = METHODS[method](ik, task, begin, options)
        yield key
        if wanted is None:
            return
        wanted = next(c for c in key.stance if c.surface == wanted.surface)


def _margins(ik: IK, options: KeyframeOptions) -> tuple[float, ...]:
    margins = margins_of(ik.world)
    if options.robust:
        margins = (max(margins[0], ROBUST_BALANCE), ROBUST_BALANCE)
    return margins


def _unbalanced(
    shift: Callable[..., Shift], step: Step, margins: tuple[float, ...]
) -> Failure | None:
    """Why the contacts that stay cannot take the weight, whatever comes next."""
    tried = []
    for margin in margins:
        tried.append(shift(margin=margin))
        if tried[-1].status is Status.SOLVED:
            return None
    return Failure(status=tried[-1].status, step=step, detail=tried[-1].note)


def _change(
    ik: IK,
    shift: Callable[..., Shift],
    key: Keyframe,
    step: Step,
    options: KeyframeOptions,
) -> Change | Failure:
    """The way to a keyframe with the largest of `MARGINS` for which there is one."""
    if key.status is not Status.SOLVED:
        detail = ""
        if key.status is Status.OVERLOADED:
            detail = limiting_joint(ik.kin, key.q, key.stance)
        elif key.status is Status.UNREACHABLE and step.makes is not None:
            pair = key.residuals.worst_pair
            detail = out_of_reach(ik.kin, key.q, step.makes, pair)
        return Failure(status=key.status, step=step, detail=detail)
    status, detail = key.status, ""
    for margin in _margins(ik, options):
        transition = plan_transition(ik, shift(margin=margin), key, step)
        status, detail = transition.status, transition.note
        if status is not Status.SOLVED:
            continue
        path = plan_path(ik, transition)
        status, detail = path.status, path.note
        if status is Status.SOLVED and options.robust:
            least = robust_margin_along(ik.kin, path.phases)
            if least is not None and least < 0.0:
                status = Status.UNBALANCED
                detail = f"not robust: its worst margin is {1e3 * least:.0f} mm"
        if status is Status.SOLVED:
            return Change(
                step=transition.step,
                keyframe=key,
                phases=path.phases,
                margin=margin,
            )
    return Failure(status=status, step=step, detail=detail)


def _task(
    world: World, before: Keyframe, step: Step, held: tuple[Contact, ...]
) -> KeyframeTask:
    new = () if step.makes is None else (step.makes,)
    task = KeyframeTask(
        held=held,
        new=new,
        q_reference=before.q if step.reference is None else step.reference,
        directions=step.target.posture,
        base_rotation=step.base_rotation,
    )
    if step.stands_up:
        home = _home_over(world, (*held, *new))
        task = replace(task, q_reference=home, directions={})
    return task


def _keyframe_turned(
    ik: IK,
    before: Keyframe,
    step: Step,
    held: tuple[Contact, ...],
    options: KeyframeOptions,
) -> Keyframe:
    """A stable posture with the new contact as the unloaded robot reaches it."""
    assert step.makes is not None
    contact, solution = approach_contact(
        ik, held, step.makes, before.q, step.seeds.touching
    )
    ik.kin.update(solution.q)
    turned = replace(contact, quaternion=orientation_at(ik.kin, contact))
    fixed = replace(_task(ik.world, before, step, held), new=(turned,), fixed=True)
    return direct(ik, fixed, solution.q, options)


def _keyframe_there(
    ik: IK,
    task: KeyframeTask,
    wanted: Contact,
    step: Step,
    q: np.ndarray,
    options: KeyframeOptions,
) -> Keyframe:
    """A stable posture with the new contact at, or nearest to, a given place."""
    contact, solution = approach_contact(ik, task.held, wanted, q, step.seeds.touching)
    fixed = replace(task, new=(contact,), fixed=True)
    # Where it closes nowhere without load, it has been looked for from other postures:
    # what closes under load alone is near where that ended.
    closes = solution.status is Status.SOLVED
    return direct(ik, fixed, solution.q, options, hard=closes)
