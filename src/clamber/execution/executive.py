"""Plan, measurements -> servo commands: execution that feels its contacts.

The trajectory is a reference, not a promise. A limb that touches early stops there and
the contact is taken where it is; one that has not touched at the planned point goes on
along the normal until it does, or until `REACH` is used up. Where a contact is not
where it was planned, the supports are estimated anew from all contacts felt so far, the
stance is taken as it is, and the remaining keyframes are solved again from there while
the robot stands still. A contact that bears nothing at the end of a step is felt for
again. Where nothing is found, the others bear the robot and another place is planned
for the limb; where there is none, the robot stays in the stance it is in and says why.

What is sensed is `Measurement`: joint encoders, base pose, contact force of each
surface; late and noisy. Nothing else of the physics is looked at.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from clamber.contact.contact import Contact
from clamber.contact.steps import split_moves
from clamber.execution.balance import Balance
from clamber.execution.events import (
    ContactMoved,
    Event,
    Heavier,
    Lost,
    Missing,
    NotReplanned,
    Replanned,
    StartsElsewhere,
    Stopped,
    Unintended,
)
from clamber.execution.leaning import (
    Lean,
    is_leaning,
    leaning_part,
    strikes,
    striking_part,
)
from clamber.execution.sensors import Measurement
from clamber.execution.servo import JointLaw
from clamber.execution.terrain import believed_scene
from clamber.model.kinematics import Kinematics
from clamber.model.scene import GROUND, Scene
from clamber.model.se3 import wrap, yaw_of
from clamber.model.world import PHYSICS_STEP, World, chain_up, limb_links
from clamber.planning.adaptation import (
    REACH,
    adapt_plan,
    feeling,
    felt_contact,
    go_on,
    start_again,
)
from clamber.planning.records import Plan, State
from clamber.planning.trajectory import HOLD_END, HOLD_START, Trajectory
from clamber.step.posture import Keyframe

TOUCH = 10.0  # [N] normal force that is a contact
LOST = 1.5  # [N] a contact of the stance that bears less is lost
FORCE_SMOOTHING = 0.03  # [s] time constant of the forces
POSE_SMOOTHING = 0.01  # [s] ... and of the measured posture: it must not lag a touch
TILTED = 0.35  # [rad] a sole that is more so touches with a corner
NEAR = 0.06  # [m] sideways from the planned place, a touch is that contact
DEVIATION = 0.006  # [m] along the normal: the rest is planned again
DRIFT = 0.015  # [m] along the support: the rest is planned again
START_DRIFT = 0.010  # [m] of the start, as far as the arms reach
MASS_CHANGE = 0.02  # share: torques are scaled
LOOK = 0.15  # [s] at rest before a posture is measured
THINKING = 1.0  # [s] the robot stands still while the rest is planned again
AHEAD = 1.0  # [s] before a foot steps, its ankle is held again
EASING = 0.5  # [s] from held to self-positioned
BLEND = 0.3  # [s] back to a trajectory that was left
FALLBACK = 0.035  # [m] a deviation that the plan at hand may survive as it is
SAME_PLACE = 0.05  # [m] a surface that is felt again this near replaces what was felt
LEANING = 0.1  # [s] a part bears for so long where it should not: it leans
SLOW = 0.5  # [rad/s] in faster motion, inertia is taken for what leans
LOOK_STRIDE = 10  # physics steps between two looks at that, and at the balance
KEPT_OFF = 0.02  # [m] farther than where it leant
WITHDRAWALS = 4  # as often another way is looked for
SEARCHES = 4  # as often another place is looked for, where a contact is not found

Ticks = Iterator[None]


@dataclass(frozen=True, eq=False, slots=True)
class _Leg:
    """One step of a trajectory, from a keyframe to the next, in samples."""

    begin: int  # sample of the keyframe before
    swing: int  # first sample with the limb in the air
    touch: int  # last sample before the new contact is closed
    end: int
    made: Contact | None


class Tracking:
    """The trajectory as it is, sample by sample: open loop."""

    def __init__(self, plan: Plan, world: World) -> None:
        """Follow `plan` on the servos of `world`."""
        assert plan.trajectory is not None
        self._trajectory = plan.trajectory
        self._law = JointLaw(world)
        self._qadr, self._dadr = world.qadr, world.dadr
        self._k = -1
        self.events: list[Event] = []
        self.stopped = ""
        self.followed: Trajectory | None = None
        final = plan.keyframes[-1].stance
        self.rests_on = tuple(f"{c.surface}@{c.support}" for c in final)

    def command(self, measured: Measurement) -> np.ndarray:
        """(na,) servo command of the next physics step."""
        self._k = k = self._k + 1
        t = self._trajectory
        q, v = t.q[k, self._qadr], t.v[k, self._dadr]
        return self._law.command(q, v, t.tau[k], measured.q[self._qadr])

    @property
    def reference(self) -> np.ndarray:
        """(nq,) of the last command."""
        return self._trajectory.q[self._k]

    @property
    def left(self) -> int:
        """Physics steps to the end."""
        return len(self._trajectory.time) - 1 - self._k


class Execution:
    """Follows a plan by feel; see the module's docstring.

    What it does is written as one sequence of actions (`_behave`), each of which takes
    some physics steps: a generator that sets the reference and yields once for each.
    """

    def __init__(self, plan: Plan, world: World) -> None:
        """Follow `plan` on the servos of `world`, which is not looked at otherwise."""
        assert plan.trajectory is not None
        self._plan = plan
        self._law = JointLaw(world)
        self._qadr, self._dadr, self._nv = world.qadr, world.dadr, world.model.nv
        self._surfaces = tuple(world.surfaces)
        # Rows of the surfaces of each arm.
        self._arms = [
            [self._surfaces.index(s) for s in limb.surfaces]
            for limb in world.robot.limbs.values()
            if limb.is_arm
        ]
        self._ankles = _ankles(world)
        self._positioned = np.zeros(len(self._qadr))  # share of (4.32), by joint
        self._made = 0 if plan.state is None else plan.state.done
        # A policy reads what comes next off the stance.
        by_policy = plan.policy is not None
        self._steps = () if by_policy else split_moves(plan.sequence, plan.world)[0]
        self._felt: dict[tuple[str, int], tuple[str, np.ndarray]] = {}
        self._weight = 0.0  # [N] as felt
        speed = plan.options.speed
        self._slow = speed != "max" and speed <= SLOW
        self._leaning = 0.0  # [s] so long
        self._wary: dict[tuple[int, str], float] = {}  # see `IK`
        self._lean: Lean | None = None
        # What leans without there being another way.
        self._stays: set[tuple[int, str]] = set()
        self._withdrawals = 0
        self._searches = 0
        self._scale = 1.0  # of the torques: mass as felt over mass as described
        self._pose = plan.trajectory.q[0].copy()
        self._load = np.zeros((len(self._surfaces), 3))
        self._k = 0  # physics steps so far
        self._velocity = np.zeros(len(self._dadr))
        self._rows: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]] = []
        self._left_plan = False
        self.left = len(plan.trajectory.time)
        self.events: list[Event] = []
        self.stopped = ""
        self.rests_on: tuple[str, ...] = ()
        # As far as it goes it is followed, whatever it misses.
        self._adopt(replace(plan, complete=True, failures=()), plan.trajectory)
        self._set(plan.trajectory, 0)
        self._balance = Balance(world, LOOK_STRIDE * PHYSICS_STEP)
        self._behaviour = self._behave()

    def command(self, measured: Measurement) -> np.ndarray:
        """(na,) servo command of the next physics step."""
        self._sense(measured)
        next(self._behaviour)
        self._k += 1
        v = np.zeros(self._nv)
        v[self._dadr] = self._velocity
        reference = self._balanced()
        self._rows.append((reference, v, self._torque, self._closed))
        return self._law.command(
            reference[self._qadr],
            self._velocity,
            self._scale * self._torque,
            measured.q[self._qadr],
            self._self_positioning(),
        )

    @property
    def followed(self) -> Trajectory | None:
        """What was followed, where that is not the plan; velocities of joints only."""
        if not self._left_plan:
            return None
        q, v, tau, contact = (np.array(x) for x in zip(*self._rows, strict=True))
        first = self._plan.trajectory
        assert first is not None
        return replace(
            first,
            time=np.arange(len(q)) * PHYSICS_STEP,
            q=q,
            v=v,
            tau=tau,
            contact=contact,
            keyframes=first.keyframes[:1],
        )

    # What it does.

    def _behave(self) -> Ticks:
        yield from self._play(round(HOLD_START / PHYSICS_STEP) - 1)
        yield from self._check_start()
        while not self.stopped:
            if self._leg < len(self._legs):
                yield from self._step()
            elif self._more:
                yield from self._go_ahead()
            elif self._leans():
                yield from self._withdraw(self._i)
            else:
                break
        if self._missed and not self.stopped:
            self._stop(self._missed)
        yield from self._end()

    def _step(self) -> Ticks:
        """One leg of the trajectory: shift, swing, touch, settle."""
        leg = self._legs[self._leg]
        c = leg.made
        if c is not None:
            near = 0.5 * (leg.swing + leg.touch)
            # The way to where the leg begins may be what ends a lean.
            yield from self._play(
                leg.touch,
                until=lambda: (
                    (self._i > near and self._touches(c))
                    or (self._i > leg.begin and self._leans())
                ),
            )
            if self._lean is not None:
                yield from self._withdraw(leg.begin)
                return
            if self._i < leg.touch and self._off(c)[0] > DEVIATION:
                yield from self._take(c)
                return
            yield from self._play(leg.touch)
            if not self._touches(c):
                felt = yield from self._feel(c)
                if felt is None:
                    yield from self._seek(c)
                    return
                if felt is not c or abs(self._off(c)[0]) > DEVIATION:
                    yield from self._take(felt)
                    return
                self._resume()
        yield from self._play(leg.end, until=self._leans)
        self._leg += 1
        self._tick_off(leg)
        if self._lean is not None:
            yield from self._withdraw(leg.touch, leg.made)
            return
        stance = self._keyframes[self._leg].stance
        self._remember([c for c in stance if self._force(c) >= LOST])
        yield from self._check_stance()

    def _withdraw(self, to: int, made: Contact | None = None) -> Ticks:
        """A part bears where it should not: back, and on with more distance of it.

        `made` is a contact that bears nothing as yet back there.
        """
        m, lean = self._world.model, self._lean
        assert lean is not None
        self._lean = None
        link = m.body(m.geom_bodyid[lean.geom]).name
        self._note(Unintended, link=link, support=lean.support)
        key = lean.geom, lean.support
        self._wary[key] = KEPT_OFF + max(lean.distance, self._wary.get(key, 0.0))
        self._withdrawals += 1
        yield from self._back(to)
        stance = self._keyframes[self._leg].stance
        actual = {c: self._other(c) or c for c in stance}
        loaded = [x for c, x in actual.items() if c is not made]
        at_hand = self._trajectory
        yield from self._replan(tuple(actual.values()), loaded)
        if self._trajectory is at_hand:
            self._stays.add(key)

    def _go_ahead(self) -> Ticks:
        """What was planned ahead of a policy has been done: the next steps of it."""
        key = self._keyframes[-1]
        found = go_on(self._plan, self._world, key, self._wary)
        if found.trajectory is None:
            self._more = False
            if found.failures:
                self._stop(str(found.failures[0]))
            return
        self._adopt(found, found.trajectory)
        yield from self._play(round(HOLD_START / PHYSICS_STEP) - 1)

    def _take(self, made: Contact) -> Ticks:
        """A contact is made where it was not planned: the rest is planned again."""
        leg = self._legs[self._leg]
        limb = self._plan.world.robot.limb_of(made.surface)
        after = self._keyframes[self._leg + 1].stance
        stance = [c for c in after if c.surface not in limb.surfaces]
        assert leg.made is not None
        self._note_moved(made, leg.made, made=True)
        self._leg += 1
        self._tick_off(leg)
        yield from self._replan((*stance, made), stance)

    def _seek(self, c: Contact) -> Ticks:
        """A contact is not found where it was planned: another place for the limb."""
        missing = Missing(time=self._time, surface=c.surface, depth=REACH)
        if self._searches == SEARCHES:
            self._stop(str(missing))
            return
        self._searches += 1
        self.events.append(missing)
        limb = self._plan.world.robot.limb_of(c.surface)
        stance = self._keyframes[self._leg].stance
        held = [x for x in stance if x.surface not in limb.surfaces]
        yield from self._replan(held, held)

    def _check_start(self) -> Ticks:
        """Is the robot where it should be, and as heavy?"""
        weight = self._weight = float(self._load[:, 2].sum())
        ratio = weight / (9.81 * self._world.mass)
        if abs(ratio - 1.0) > MASS_CHANGE:
            self._note(Heavier, factor=ratio)
            self._scale = float(np.clip(ratio, 0.5, 2.0))
        if self._plan.state is not None:
            yield from self._check_stance()
            return
        q, ref = self._pose, self.reference
        yaw = float(wrap(yaw_of(q[3:7]) - yaw_of(ref[3:7])))
        x, y, theta = self._world.scene.start
        c, s = np.cos(yaw), np.sin(yaw)
        rel = np.array([x, y]) - ref[:2]
        xy = q[:2] + np.array([c * rel[0] - s * rel[1], s * rel[0] + c * rel[1]])
        away = float(np.linalg.norm(xy - [x, y]))
        off = away + 0.3 * abs(yaw)
        if off <= START_DRIFT:
            return
        self._note(StartsElsewhere, distance=away, yaw=yaw)
        scene = replace(self._world.scene, start=np.array([*xy, theta + yaw]))
        found = start_again(self._plan, scene)
        yield from self._rest(THINKING)
        yield from self._follow(found, off)

    def _check_stance(self) -> Ticks:
        """At a keyframe: is every contact where it should be, and does it bear?"""
        stance = self._keyframes[self._leg].stance
        if self._leg == len(self._legs) and not self._more:
            return  # the last one: nothing depends on it
        if self._leans():  # and takes the load of contacts, which are not lost
            yield from self._withdraw(self._i)
            return
        for c in stance:
            if self._force(c) >= LOST or self._other(c) is not None:
                continue
            self._note(Lost, surface=c.surface)
            felt = yield from self._feel(c)
            if felt is None:
                self._note(Lost, surface=c.surface, given_up=True)
                others = [x for x in stance if x is not c]
                yield from self._replan(others, others)
                return
            if felt is not c or abs(self._off(c)[0]) > DEVIATION:
                others = [x for x in stance if x is not c]
                yield from self._replan((*others, felt), others)
                return
            self._resume()
        actual = tuple(self._other(c) or c for c in stance)
        for c, planned in zip(actual, stance, strict=True):
            up, side = self._off(c)
            if c is not planned or abs(up) > DEVIATION or side > DRIFT:
                self._note_moved(c, planned, made=False)
                yield from self._replan(actual, actual)
                return

    def _end(self) -> Ticks:
        """Hold the last posture."""
        n = round(HOLD_END / PHYSICS_STEP)
        self._velocity = np.zeros(len(self._dadr))
        for k in range(n):
            self.left = n - 1 - k
            if self.left == 0:
                self._sum_up()
            yield

    # Actions.

    def _play(self, to: int, until: Callable[[], bool] | None = None) -> Ticks:
        """Follow the trajectory to sample `to`, or until something happens."""
        t = self._trajectory
        while self._i < to:
            if until is not None and until():
                return
            self._i += 1
            self._set(t, self._i)
            self._blend()
            yield

    def _back(self, to: int) -> Ticks:
        """Follow the trajectory back to sample `to`."""
        self._left_plan = True
        while self._i > to:
            self._i -= 1
            self._set(self._trajectory, self._i)
            self._velocity = -self._velocity
            yield

    def _set(self, t: Trajectory, i: int) -> None:
        self.reference, self._torque = t.q[i], t.tau[i]
        self._velocity, self._closed = t.v[i][self._dadr], t.contact[i]

    def _resume(self) -> None:
        """Back to the trajectory that was left, little by little while it goes on."""
        t, i = self._trajectory, self._i
        offset = self._kin.difference(t.q[i], self.reference)
        self._return = (offset, self._torque - t.tau[i], 0)

    def _blend(self) -> None:
        """Add what is left of the way back."""
        if self._return is None:
            return
        offset, torque, k = self._return
        n = round(BLEND / PHYSICS_STEP)
        share = 0.5 + 0.5 * np.cos(np.pi * k / n)
        rate = -0.5 * np.pi / BLEND * np.sin(np.pi * k / n)
        self.reference = self._kin.integrate(self.reference, share * offset)
        self._torque = self._torque + share * torque
        self._velocity = self._velocity + rate * offset[self._dadr]
        self._return = (offset, torque, k + 1) if k < n else None

    def _rest(self, seconds: float) -> Ticks:
        """Stand still."""
        self._velocity = np.zeros(len(self._dadr))
        self._left_plan = True
        for _ in range(round(seconds / PHYSICS_STEP)):
            yield

    def _feel(self, c: Contact) -> Iterator[None]:
        """Go on along the normal; returns the contact that is felt, or None.

        Another surface of the limb that meets the support first is the contact.
        """
        stance = self._keyframes[self._leg].stance
        if self._leg < len(self._legs) and self._legs[self._leg].made is c:
            after = {x.surface for x in self._keyframes[self._leg + 1].stance}
            stance = tuple(x for x in stance if x.surface in after)
        held = tuple(x for x in stance if x.surface != c.surface)
        t = feeling(self._world, held, c, self._trajectory.q[self._i])
        self._left_plan = True
        if t is None:
            return None
        for i in range(len(t.time)):
            self._set(t, i)
            yield
            felt = c if self._touches(c, REACH) else self._other(c)
            if felt is not None:
                self._velocity = np.zeros(len(self._dadr))
                return felt
        for i in reversed(range(len(t.time))):
            self._set(t, i)
            self._velocity = -self._velocity
            yield
        return None

    def _replan(self, contacts: Sequence[Contact], loaded: Sequence[Contact]) -> Ticks:
        """Take the stance as it is and plan the remaining steps again."""
        yield from self._rest(LOOK)
        off = max(max(abs(u), s) for u, s in (self._off(c) for c in contacts))
        if len(contacts) < len(self._keyframes[self._leg].stance):
            off = np.inf  # without a contact there is no going on as planned
        bearing = [c in loaded for c in contacts]
        felt = [self._as_felt(c) for c in contacts]
        self._remember(felt)
        now = State(
            done=self._made,
            stance=tuple(felt),
            loaded=tuple(c for c, b in zip(felt, bearing, strict=True) if b),
            q=self._rebased(),
        )
        found = adapt_plan(
            self._plan, self._believed(), now, self.reference, self._wary
        )
        yield from self._rest(THINKING)
        yield from self._follow(found, off)

    def _follow(self, found: Plan, off: float) -> Ticks:
        """Go by another plan; or, where that is worse, by the one at hand."""
        missed = str(found.failures[0]) if found.failures else ""
        no_better = bool(missed) and off < FALLBACK and not self._missed
        if found.trajectory is None or no_better:
            yield from self._go_on(off, missed)
            return
        steps = len(found.changes)
        if missed and steps == 0:
            self._stop(missed)
            return
        self._note(Replanned, changes=steps)
        self._adopt(found, found.trajectory)
        self._i = round(HOLD_START / PHYSICS_STEP) - 1
        if steps == 0 and not self._more:  # there is still the way to the last posture
            yield from self._play(_arrival(found.trajectory))

    def _go_on(self, off: float, why: str) -> Ticks:
        """No other plan was found: the one at hand may do, or may not."""
        if self._steps and self._made == len(self._steps):
            self._note(NotReplanned, why=why, stays=True)
            self._leg = len(self._legs)
        elif off < FALLBACK:
            self._note(NotReplanned, why=why, stays=False)
            self._resume()
            if self._leg > 0:
                yield from self._play(self._legs[self._leg - 1].end)
        else:
            self._stop(why)

    def _stop(self, why: str) -> None:
        """Stay in the stance that holds."""
        self._note(Stopped, why=why)
        self.stopped = why

    # What it knows.

    def _adopt(self, plan: Plan, trajectory: Trajectory) -> None:
        self._world, self._kin = plan.world, Kinematics(plan.world)
        self._trajectory, self._i = trajectory, 0
        self._keyframes = list(plan.keyframes)
        self._legs, self._leg = _legs(trajectory, plan.keyframes), 0
        self._missed = str(plan.failures[0]) if plan.failures else ""
        self._more = not plan.complete and not plan.failures  # a policy goes on
        self._return: tuple[np.ndarray, np.ndarray, int] | None = None

    @property
    def _time(self) -> float:
        return self._k * PHYSICS_STEP

    def _note(self, kind: type[Event], **what: Any) -> None:
        self.events.append(kind(time=self._time, **what))

    def _note_moved(self, c: Contact, planned: Contact, *, made: bool) -> None:
        above, aside = self._off(c)
        self._note(
            ContactMoved,
            surface=c.surface,
            planned=planned.surface,
            above=above,
            aside=aside,
            made=made,
        )

    def _sense(self, m: Measurement) -> None:
        self._load += PHYSICS_STEP / FORCE_SMOOTHING * (m.force - self._load)
        q = self._pose
        if m.q[3:7] @ q[3:7] < 0:
            q[3:7] *= -1
        q += PHYSICS_STEP / POSE_SMOOTHING * (m.q - q)
        q[3:7] /= math.sqrt(q[3:7] @ q[3:7])
        if self._slow and self._k % LOOK_STRIDE == 0:
            if is_leaning(self._load, self._weight) or self._struck():
                self._leaning += LOOK_STRIDE * PHYSICS_STEP
            else:
                self._leaning = 0.0

    def _balanced(self) -> np.ndarray:
        """(nq,) the reference, its centre of mass moved where balance asks for it."""
        if not self._slow:  # in faster motion the robot need not balance statically
            return self.reference
        if self._k % LOOK_STRIDE == 0:
            self._balance.feel(self._pose, self.reference, self._closed_contacts())
        q = self.reference.copy()
        q[self._qadr] += self._balance.offset(PHYSICS_STEP)
        return q

    def _closed_contacts(self) -> list[Contact]:
        """Those of the plan at present."""
        near = self._keyframes[self._leg : self._leg + 2]
        contacts = {c.surface: c for key in near for c in key.stance}
        index = self._surfaces.index
        return [c for s, c in contacts.items() if self._closed[index(s)]]

    def _struck(self) -> list[str]:
        """Surfaces, neither in contact nor about to be, that strike a side."""
        hit = [self._surfaces[i] for i in np.flatnonzero(strikes(self._load))]
        if not hit:
            return hit
        j = self._leg
        near = {c.surface for key in self._keyframes[j : j + 2] for c in key.stance}
        others = map(self._other, self._keyframes[j].stance)
        near.update(c.surface for c in others if c is not None)
        made = self._next_made()
        if made is not None:
            near.update(self._world.robot.limb_of(made.surface).surfaces)
        return [s for s in hit if s not in near]

    def _next_made(self) -> Contact | None:
        """The contact that the present step makes, if any."""
        return self._legs[self._leg].made if self._leg < len(self._legs) else None

    def _leans(self) -> bool:
        """Whether something leans where it should not: then `_lean` says what."""
        if self._leaning < LEANING or self._withdrawals == WITHDRAWALS:
            return False
        self._leaning = 0.0
        self._kin.update(self._pose)
        if is_leaning(self._load, self._weight):
            self._lean = leaning_part(self._kin, self._load, self._weight)
        else:
            self._lean = striking_part(self._kin, self._struck())
        lean = self._lean
        if lean and (
            self._moves(lean.geom) or (lean.geom, lean.support) in self._stays
        ):
            self._lean = None
        return self._lean is not None

    def _moves(self, geom: int) -> bool:
        """Whether a geom is of the limb on its way: that grazes an edge and goes on."""
        made = self._next_made()
        body = int(self._world.model.geom_bodyid[geom])
        return made is not None and body in limb_links(self._world, made.surface)

    def _force(self, c: Contact) -> float:
        """Normal force on a surface [N]."""
        n = self._world.supports[c.support].normal
        return float(self._load[self._surfaces.index(c.surface)] @ n)

    def _touches(self, c: Contact, aside: float = NEAR) -> bool:
        """Force on the surface, not far from where its contact was planned."""
        if self._force(c) < TOUCH:
            return False
        up, side = self._off(c)
        return side < aside and abs(up) < REACH + 0.02

    def _other(self, c: Contact) -> Contact | None:
        """The contact of another surface of the limb that bears in place of this."""
        if self._force(c) >= LOST:
            return None
        support = self._world.supports[c.support]
        for surface in self._plan.world.robot.limb_of(c.surface).surfaces:
            other = replace(c, surface=surface, edge=None, link=None)
            if surface != c.surface and self._force(other) >= TOUCH:
                p = self._point(other)
                there = support.inside(p) and abs(support.height(p)) < REACH
                if there and self._lies(surface, support.normal):
                    return replace(other, position=p)
        return None

    def _lies(self, surface: str, normal: np.ndarray) -> bool:
        """Whether a surface lies on a support rather than touching with a corner.

        Only then its middle is where the support is. The kinematics are up to date.
        """
        s = self._world.surfaces[surface]
        if s.rotation is None:
            return True
        up = (self._kin.rotation(s.body) @ s.rotation)[:, 2]
        return float(up @ normal) > math.cos(TILTED)

    def _point(self, c: Contact) -> np.ndarray:
        """(3,) where the surface's lowest point is by the sensors."""
        self._kin.update(self._pose)
        n = self._world.supports[c.support].normal
        return self._kin.contact_point(c.surface, n, c.edge)

    def _off(self, c: Contact) -> tuple[float, float]:
        """How far a contact is from its plan, along the normal and sideways [m]."""
        n = self._world.supports[c.support].normal
        off = self._point(c) - c.position - self._kin.roll(c.surface, n, c.link)
        up = float(off @ n)
        return up, float(np.linalg.norm(off - up * n))

    def _as_felt(self, c: Contact) -> Contact:
        """The contact where it is by the sensors."""
        self._kin.update(self._pose)
        return felt_contact(self._kin, c)

    def _remember(self, contacts: Sequence[Contact]) -> None:
        """Where supports have been felt, one place for each contact made."""
        for c in contacts:
            if c.support != GROUND:
                p = self._point(c)
                near = (
                    k
                    for k, (_, x) in self._felt.items()
                    if k[0] == c.surface and np.linalg.norm(x[:2] - p[:2]) < SAME_PLACE
                )
                key = next(near, (c.surface, self._made))
                self._felt[key] = (c.support, p)

    def _believed(self) -> Scene:
        """The scene as it is by what was felt; the start where the robot began."""
        scene = believed_scene(self._plan.world.scene, self._felt.values())
        return replace(scene, start=self._world.scene.start)

    def _rebased(self) -> np.ndarray:
        """(nq,) joint angles as commanded, base as measured."""
        q = self.reference.copy()
        q[:7] = self._pose[:7]
        return q

    def _tick_off(self, leg: _Leg) -> None:
        """Count the steps of the sequence that have been made."""
        a, b = (self._keyframes[j].stance for j in (self._leg - 1, self._leg))
        gone = {c.surface for c in a} - {c.surface for c in b}
        for k in range(self._made, len(self._steps)):
            step = self._steps[k]
            if leg.made is None:
                same = step.makes is None and set(step.breaks) == gone
            else:
                same = (
                    step.makes is not None
                    and step.makes.surface == leg.made.surface
                    and step.makes.support == leg.made.support
                )
            if same:
                self._made = k + 1
                return

    def _sum_up(self) -> None:
        """Which contacts the robot rests on: those of the stance, as they are."""
        out = []
        for c in self._keyframes[self._leg].stance:
            for surface in self._plan.world.robot.limb_of(c.surface).surfaces:
                other = replace(c, surface=surface)
                if surface == c.surface or self._force(other) >= LOST:
                    out.append(f"{surface}@{c.support}")
        self.rests_on = tuple(out)

    def _self_positioning(self) -> np.ndarray | None:
        """(na,) share to which ankles of planted feet position themselves (4.32).

        From when both arms bear load until a foot must step again; eased in and out.
        """
        if not self._ankles:
            return None
        up = self._load[:, 2].tolist()
        bearing = all(any(up[i] > TOUCH for i in rows) for rows in self._arms)
        t = self._trajectory
        ahead = t.contact[min(self._i + round(AHEAD / PHYSICS_STEP), len(t.time) - 1)]
        rate = PHYSICS_STEP / EASING
        for surface, joints in self._ankles.items():
            s = self._surfaces.index(surface)
            free = bearing and self._closed[s] and ahead[s]
            share = float(self._positioned[joints][0]) + (rate if free else -rate)
            self._positioned[joints] = min(max(share, 0.0), 1.0)
        return self._positioned


def _ankles(world: World) -> dict[str, np.ndarray]:
    """(na,) bool by foot: the joints of its leg that position themselves."""
    m = world.model
    own = [j in world.robot.self_positioning for j in world.joints]
    bodies = [int(m.jnt_bodyid[m.joint(j).id]) for j in world.joints]
    out = {}
    for limb in world.robot.limbs.values():
        foot = limb.surfaces[0]
        chain = chain_up(m, world.surfaces[foot].body)
        joints = np.array([o and b in chain for o, b in zip(own, bodies, strict=True)])
        if joints.any() and not limb.is_arm:
            out[foot] = joints
    return out


def _legs(t: Trajectory, keyframes: Sequence[Keyframe]) -> list[_Leg]:
    """The contact changes of a trajectory."""
    out = []
    for j, (before, after) in enumerate(itertools.pairwise(keyframes)):
        parts = [x for x in t.segments if x.change == j]
        begin, end = t.at(float(t.keyframes[j])), parts[-1].end - 1
        making = next((x for x in parts if x.makes is not None), None)
        if making is None:
            out.append(_Leg(begin, begin, end, end, None))
            continue
        # A limb that is in the air swings from the start.
        gone = {c.surface for c in before.stance} - {c.surface for c in after.stance}
        swing = making.begin if gone else begin
        out.append(_Leg(begin, swing, making.end - 1, end, making.makes))
    return out


def _arrival(t: Trajectory) -> int:
    """The sample from which on the last posture is held."""
    return len(t.time) - 1 - round(HOLD_END / PHYSICS_STEP)
