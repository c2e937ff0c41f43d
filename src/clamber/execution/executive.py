"""Plan, measurements -> servo commands: execution that reacts to its contacts.

The trajectory is a reference, not a promise. A limb that touches early stops there and
the contact is taken where it is; one that has not touched at the planned point is
probed for along the normal until it does, or until `REACH` is used up. Where a contact
is not where it was planned, the supports are estimated anew from all contacts measured
so far, the stance is taken as it is, and the remaining contact changes are planned
again from there while the robot stands still. A contact that carries no load at the end
of a change is re-established by probing. Where nothing is found, the others carry the
robot and another place is planned for the limb; where there is none, it stays in the
stance it is in and says why.

Beside the plan there are five reactions, the most urgent first: to an unintended
contact (`_retreat`), to a limb that has slipped back to another support
(`_go_on_from_here`), to a contact that is elsewhere (`_take`, `_accept`), to one that
is missing (`_seek`) and to one that is lost (`_recover`). What is known is an
`Estimate`, what the joints are to do a `Reference`; between them this module decides.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from clamber.contact.contact import Contact
from clamber.contact.steps import split_steps
from clamber.execution.balance import Balance
from clamber.execution.estimate import DEVIATION, Estimate
from clamber.execution.events import (
    ContactMoved,
    Event,
    GivenUp,
    Heavier,
    KeptPlan,
    KeptStance,
    Lost,
    Missing,
    Paused,
    Replanned,
    StartsElsewhere,
    Stopped,
    Unintended,
)
from clamber.execution.open_loop import LOOK_STRIDE, follower
from clamber.execution.probe import REACH, guarded_move
from clamber.execution.progress import (
    FALLBACK,
    AtHand,
    Span,
    nearest_keyframe,
    rest_of,
)
from clamber.execution.reference import Actions, Reference
from clamber.execution.sensors import Measurement
from clamber.execution.servo import self_positioning
from clamber.execution.terrain import CAUTION
from clamber.execution.unintended import LASTS, Watch
from clamber.model.progress import Progress, silent
from clamber.model.se3 import wrap, yaw_of
from clamber.model.world import PHYSICS_STEP, World, limb_links
from clamber.planning.records import Plan, State
from clamber.planning.trajectory import HOLD_END, HOLD_START, Trajectory
from clamber.step.ik import NO_EXTRA

DRIFT = 0.015  # [m] along the support: the rest is planned again
START_DRIFT = 0.010  # [m] of the start, as far as the arms reach
ARM = 0.3  # [m] of it, by which a turn of the start counts
MASS_CHANGE = 0.02  # share: torques are scaled
LOOK = 0.15  # [s] at rest before a posture is measured
THINKING = 0.1  # [s] the robot stands still while the rest is planned again
SEARCHING = 1.0  # [s] ... where other contacts are looked for
PAUSE = 10.0  # [s] that it stands where it is told to pause
FEEL = 0.05  # [s] later than planned that a contact may be felt
SEARCHES = 4  # as often another place is looked for, where a contact is not found
FIRST = round(HOLD_START / PHYSICS_STEP) - 1  # sample from which a trajectory moves

# Of a reaction: whether there was something to react to.
Reaction = Generator[None, None, bool]


class Executive:
    """Follows a plan and reacts to what it measures; see the module's docstring.

    What it does is written as one sequence of actions (`_behave`), each of which takes
    some physics steps: a generator that says what to follow and yields until that is
    done, or something may have happened.

    Attributes:
        core: What is done at every physics step.
        estimate: What is known; watch: what it looks out for.
        events: What was measured, and done about it.
        done: Steps of the plan's sequence that have been done.
        stopped: Why it stopped; empty where it did not.
    """

    def __init__(
        self,
        plan: Plan,
        world: World,
        progress: Progress = silent,
        *,
        pause: float | None = None,
    ) -> None:
        """Follow `plan` on the servos of `world`, which is not looked at otherwise.

        Args:
            plan: What to do.
            world: In which it is done.
            progress: Called with stage, share and note where it plans again.
            pause: When to slow down and stand for `PAUSE` [s]; None: never.
        """
        assert plan.trajectory is not None
        self._plan = plan
        self._report = progress
        self._balance = Balance(world, LOOK_STRIDE * PHYSICS_STEP)
        self.watch = Watch(
            tuple(world.surfaces), LOOK_STRIDE * PHYSICS_STEP, world.force_scale
        )
        self._searches, self._pause = 0, pause
        self._back = 0.0  # [s] that a limb has been back on another support
        # [s] when each keyframe of the plan was reached
        self._reached = [float(plan.trajectory.keyframes[0])]
        self._count_by(plan)
        self.events: list[Event] = []
        self.stopped = ""
        self.estimate = Estimate(plan.world, plan.trajectory.q[0])
        self._ref = Reference(plan.trajectory, plan.world)
        ankles = self_positioning(world, plan.options.speed)
        self.core = follower(world, self.estimate.filter, self._ref, ankles)
        self._adopt(plan, plan.trajectory, 0)
        self._behaviour = self._behave()

    def command(self, measured: Measurement) -> np.ndarray:
        """(na,) servo command of the next physics step."""
        return self.core.command(measured.q, measured.force, self)

    def decide(self, look: bool) -> None:
        """Chooses what to follow next; `look` is true every `LOOK_STRIDE` steps."""
        if look:
            self.watch.look(self.estimate.load, self._in_use)
            back = self._has_slipped(self._bearing)
            self._back = self._back + LOOK_STRIDE * PHYSICS_STEP if back else 0.0
            if (
                self._pause is not None
                and self.core.steps * PHYSICS_STEP >= self._pause
            ):
                self._pause, self._ref.pause = None, PAUSE
                self._note(Paused, seconds=PAUSE)
        next(self._behaviour)

    def close(self) -> None:
        """The run is over: release what its actions hold."""
        self._behaviour.close()

    def balance(self) -> None:
        """Move the centre of mass from its reference where balance asks for it."""
        ref, change = self._ref, self._at_hand.change
        closed = ref.closed.tobytes()
        if self._closed != (change, closed):
            self._closed = change, closed
            surfaces = self.estimate.surfaces
            self._bearing = self._at_hand.closed_contacts(ref.closed, surfaces)
        if self._balance.update(self.estimate.q, ref.q, self._bearing):
            self.core.goal[:] = self._balance.goal

    @property
    def reference(self) -> np.ndarray:
        """(nq,) of the last command, but for what the balance adds."""
        return self._ref.q

    @property
    def left(self) -> int:
        """Physics steps to the end, as far as is known."""
        ref = self._ref
        if self.core.ends:
            return ref.track.left
        ahead = len(ref.trajectory.time) - ref.i
        if self._at_hand.goes_on:  # farther than this part of it
            assert self._plan.trajectory is not None
            whole = len(self._plan.trajectory.time)
            ahead = max(ahead, whole - len(self.core.commanded))
        return ahead

    @property
    def rests_on(self) -> tuple[str, ...]:
        """At the end, contacts by `surface@support`."""
        return () if self.left else tuple(_resting(self.estimate, self.stance))

    @property
    def followed(self) -> Trajectory | None:
        """Trajectory that was followed, if not the plan; velocities of joints only."""
        return self._ref.followed(self.core.commanded, np.array(self._reached))

    @property
    def stance(self) -> tuple[Contact, ...]:
        """Contacts of the last keyframe reached, as planned."""
        return self._at_hand.stance

    # What it does.

    def _behave(self) -> Actions:
        yield from self._ref.play(FIRST)
        yield from self._check_start()
        while not self.stopped:
            at_hand = self._at_hand
            if not at_hand.is_through:
                yield from self._make_change(at_hand.spans[at_hand.change])
            elif at_hand.goes_on:
                yield from self._go_ahead()
            elif not (yield from self._check_end()):
                break
        if self._at_hand.failure and not self.stopped:
            self._stop(self._at_hand.failure)
        if not self.stopped:  # whatever is left was not needed to get there
            left = len(self._plan.keyframes) - len(self._reached)
            self._reached += self._reached[-1:] * left
        yield from self._end()

    def _make_change(self, span: Span) -> Actions:
        """One contact change: shift, swing, touch, settle."""
        if span.makes is not None and (yield from self._make(span, span.makes)):
            return
        yield from self._ref.play(span.end, until=self._is_wrong)
        self._count_change()
        if (yield from self._set_right(span.touch, span.makes)):
            return
        estimate = self.estimate
        loaded = [c for c in self.stance if estimate.force(c) >= estimate.lost]
        estimate.remember(loaded, self.done)
        yield from self._check_stance()

    def _settle(self, to: int) -> Reaction:
        """The way from where planning again began to its first posture.

        It may be what ends an unintended contact; one that comes on the way is new.
        """
        until = None if self.watch.seems_so else self._is_unintended
        yield from self._ref.play(to, until)
        if self.watch.found is None:
            return False
        yield from self._retreat(FIRST)
        return True

    def _make(self, span: Span, c: Contact) -> Reaction:
        """Close a contact; false where that went as planned."""
        ref, touches = self._ref, self.estimate.touches
        if (yield from self._settle(span.begin + 1)):
            return True
        near = (span.swing + span.touch) // 2 + 1
        yield from ref.play(near, until=self._is_wrong)
        if self.watch.found is None and not self._is_back():
            self.estimate.expect(c)
            yield from ref.play(
                span.touch, until=lambda: touches(c) or self._is_wrong()
            )
            self.estimate.expect()
        if (yield from self._set_right(span.begin)):
            return True
        if ref.i < span.touch and self.estimate.deviation(c)[0] > DEVIATION:
            yield from self._take(c, c)
            return True
        late = min(span.touch + round(FEEL / PHYSICS_STEP), span.end)

        def is_there() -> bool:
            return ref.i >= span.touch and self.estimate.is_in_place(c)

        self.estimate.expect(c, force=self.estimate.pressed)
        yield from ref.play(late, until=is_there)
        # Without any load there, torques that count on it would throw the robot.
        missing = self.estimate.force(c) < self.estimate.lost
        yield from ref.stop(until=is_there, push=span.touch if missing else None)
        self.estimate.expect()
        if is_there():
            return False
        yield from ref.back(span.touch)  # where the others hold the robot
        found = yield from self._probe(c)
        if (yield from self._set_right(span.begin)):
            return True
        if found is None:
            yield from self._seek(c)
        elif found is not c or abs(self.estimate.deviation(c)[0]) > DEVIATION:
            yield from self._take(found, c)
        else:
            ref.resume()
            return False
        return True

    def _go_ahead(self) -> Actions:
        """Plans the policy's next steps once those planned ahead are done."""
        key = self._at_hand.keyframes[-1]
        scene, clearance = self.estimate.world.scene, self.watch.clearance
        found = rest_of(self._plan, scene, key, 0.0, clearance, self._report)
        if found.trajectory is None:
            self._at_hand.goes_on = False
            if found.failures:
                self._stop(str(found.failures[0]))
            return
        self._adopt(found, found.trajectory, 0)
        yield from self._ref.play(FIRST)

    def _check_start(self) -> Actions:
        """Is the robot where it should be, and as heavy?"""
        world = self.estimate.world
        weight = self.watch.weight = float(self.estimate.load[:, 2].sum())
        ratio = weight / (9.81 * world.mass)
        if abs(ratio - 1.0) > MASS_CHANGE:
            self._note(Heavier, factor=ratio)
            self.core.scale = float(np.clip(ratio, 0.5, 2.0))
        if self._plan.state is not None:
            yield from self._check_stance()
            return
        q, ref = self.estimate.q, self.reference
        yaw = float(wrap(yaw_of(q[3:7]) - yaw_of(ref[3:7])))
        x, y, theta = world.scene.start
        c, s = np.cos(yaw), np.sin(yaw)
        rel = np.array([x, y]) - ref[:2]
        xy = q[:2] + np.array([c * rel[0] - s * rel[1], s * rel[0] + c * rel[1]])
        away = float(np.linalg.norm(xy - [x, y]))
        off = away + ARM * abs(yaw)
        if off <= START_DRIFT:
            return
        self._note(StartsElsewhere, distance=away, yaw=yaw)
        scene = replace(world.scene, start=np.array([*xy, theta + yaw]))
        found = rest_of(self._plan, scene, None, off, NO_EXTRA, self._report)
        yield from self._ref.rest(THINKING)
        yield from self._follow(found, off)

    def _check_stance(self) -> Actions:
        """At a keyframe: the reactions that are due, the most urgent first."""
        if self._at_hand.is_through and not self._at_hand.goes_on:
            return  # the last one: nothing depends on it
        if not self._is_off():
            return
        yield from self._stand()  # what seems to be so in motion may pass
        # What is unintended takes the load of contacts, which are not lost.
        for react in (self._retreat_from_here, self._recover, self._accept):
            if (yield from react()):
                return

    def _check_end(self) -> Reaction:
        """At the last keyframe: is there still something to do?"""
        yield from self._ref.hold(LOOK)
        if (yield from self._retreat_from_here()):
            return True
        if self._has_slipped(self.stance):
            yield from self._go_on_from_here()
            return True
        return False

    def _is_off(self) -> bool:
        """Is something unintended loaded, or a contact lost or elsewhere?"""
        return (
            self._is_unintended()
            or any(map(self.estimate.is_lost, self.stance))
            or any(map(self._is_elsewhere, self.stance))
        )

    def _actual(self, c: Contact) -> Contact:
        """The contact, or that of another surface of the limb in its place."""
        return self.estimate.substitute(c) or c

    def _has_slipped(self, stance: Sequence[Contact]) -> bool:
        """Is a limb back on another support?"""
        if self.estimate.all_bear(stance):
            return False
        return any(self._actual(c).support != c.support for c in stance)

    def _is_elsewhere(self, c: Contact) -> bool:
        actual = self._actual(c)
        up, side = self.estimate.deviation(actual)
        return actual is not c or abs(up) > DEVIATION or side > DRIFT

    def _stand(self) -> Actions:
        """Come to rest, and look."""
        yield from self._ref.stop()
        yield from self._ref.rest(LOOK)

    def _end(self) -> Actions:
        """Hold the last posture."""
        self.core.ends = True
        yield from self._ref.hold(HOLD_END - (0.0 if self.stopped else LOOK))

    # How it reacts.

    def _retreat_from_here(self) -> Reaction:
        """Is there an unintended contact? Then another way from this very stance."""
        if not self._is_unintended():
            return False
        yield from self._retreat(self._ref.i)
        return True

    def _set_right(self, to: int, makes: Contact | None = None) -> Reaction:
        """Has something gone wrong on the way? Back `to` a sample, or on from here."""
        if self.watch.found is not None:
            yield from self._retreat(to, makes)
        elif self._is_back():
            yield from self._go_on_from_here()
        else:
            return False
        return True

    def _retreat(self, to: int, makes: Contact | None = None) -> Actions:
        """A link is loaded where it should not be: back, on with more clearance of it.

        `makes` is a contact that carries nothing as yet back there.
        """
        at = self.watch.take()
        m = self.estimate.world.model
        link = m.body(m.geom_bodyid[at.geom]).name
        self._note(Unintended, link=link, support=at.support)
        yield from self._ref.back(to)
        actual = {c: self._actual(c) for c in self.stance}
        loaded = [x for c, x in actual.items() if c is not makes]
        at_hand = self._at_hand
        yield from self._replan(tuple(actual.values()), loaded)
        if self._at_hand is at_hand:
            self.watch.accept(at)

    def _take(self, made: Contact, planned: Contact) -> Actions:
        """A contact is made where it was not planned: the rest is planned again."""
        limb = self._plan.world.robot.limb_of(made.surface)
        stance = [
            c for c in self._at_hand.next_stance if c.surface not in limb.surfaces
        ]
        self._note_moved(made, planned, made=True)
        self._count_change()
        yield from self._replan((*stance, made), stance)

    def _seek(self, c: Contact) -> Actions:
        """A contact is not found where it was planned: another place for the limb."""
        missing = Missing(
            time=self.core.steps * PHYSICS_STEP, surface=c.surface, depth=REACH
        )
        if self._searches == SEARCHES:
            self._stop(str(missing))
            return
        self._searches += 1
        self.events.append(missing)
        limb = self._plan.world.robot.limb_of(c.surface)
        held = [x for x in self.stance if x.surface not in limb.surfaces]
        yield from self._replan(held, held)

    def _recover(self) -> Reaction:
        """Does a contact of the stance carry no load? Then probe to re-establish it."""
        for c in self.stance:
            if not self.estimate.is_lost(c):
                continue
            self._note(Lost, surface=c.surface)
            others = [x for x in self.stance if x is not c]
            found = yield from self._probe(c)
            if self.watch.found is not None:
                yield from self._retreat(self._ref.i)
                return True
            if found is None:
                yield from self._stand()  # a robot that rocks bears on it again
                found = None if self.estimate.is_lost(c) else c
            if found is None:
                self._note(GivenUp, surface=c.surface)
                yield from self._replan(others, others)
                return True
            if found is not c or abs(self.estimate.deviation(c)[0]) > DEVIATION:
                yield from self._replan((*others, found), others)
                return True
            self._ref.resume()
        return False

    def _accept(self) -> Reaction:
        """Is a contact elsewhere than planned? Then the rest is planned from there."""
        actual = tuple(map(self._actual, self.stance))
        for c, planned in zip(actual, self.stance, strict=True):
            if self._is_elsewhere(planned):
                self._note_moved(c, planned, made=False)
                yield from self._replan(actual, actual)
                return True
        return False

    def _go_on_from_here(self) -> Actions:
        """A limb has slipped back to another support: on from the stance as it is."""
        self._back = 0.0
        if self._searches == SEARCHES:
            self._stop("a contact slips off its support again and again")
            return
        self._searches += 1
        held = {c: self._actual(c) for c in self._bearing}
        for planned, c in held.items():
            if c is not planned:
                self._note_moved(c, planned, made=False)
        actual = tuple(held.values())
        yield from self._replan(actual, actual)

    def _probe(self, c: Contact) -> Generator[None, None, Contact | None]:
        """Go on along the normal; returns the contact that is found, or None.

        Another surface of the limb that meets the support first is the contact.
        """
        stance = self.stance
        if self._at_hand.next_contact is c:
            after = {x.surface for x in self._at_hand.next_stance}
            stance = tuple(x for x in stance if x.surface in after)
        held = tuple(x for x in stance if x.surface != c.surface)
        ref, estimate = self._ref, self.estimate
        t = guarded_move(estimate.world, held, c, ref.trajectory.q[ref.i])
        ref.left_plan = True
        found: Contact | None = None

        def touches() -> bool:
            nonlocal found
            touches = estimate.touches(c, REACH)
            found = c if touches else estimate.substitute(c, there=True)
            return found is not None

        if t is not None:
            limb = self._plan.world.robot.limb_of(c.surface)
            estimate.expect(*(replace(c, surface=s) for s in limb.surfaces))
            yield from ref.aside(t, touches, self._is_wrong)
            estimate.expect()
        return found

    def _replan(
        self, contacts: Sequence[Contact], loaded: Sequence[Contact]
    ) -> Actions:
        """Take the stance as it is and plan the remaining steps again."""
        yield from self._stand()
        estimate = self.estimate
        actual = {c: self._actual(c) if c in loaded else c for c in contacts}
        loaded = [actual[c] for c in loaded]
        contacts = tuple(actual.values())
        moved = (max(abs(u), s) for u, s in map(estimate.deviation, contacts))
        off = max(moved, default=np.inf)
        if _places(contacts) != _places(self.stance):
            off = np.inf  # then there is no going on as planned
        estimate.remember(contacts, self.done)
        q = self.reference.copy()  # joints as commanded, base as measured
        q[:7] = estimate.q[:7]
        aimed = {c: estimate.aimed(c, q) for c in contacts}
        now = State(
            stance=tuple(aimed.values()),
            loaded=tuple(x for c, x in aimed.items() if c in loaded),
            q=q,
            done=self.done,
        )
        scene = estimate.scene(self._plan.world.scene)
        clearance = self.watch.clearance
        found = rest_of(self._goal, scene, now, off, clearance, self._report)
        yield from self._ref.rest(THINKING if off < FALLBACK else SEARCHING)
        yield from self._follow(found, off)

    def _follow(self, found: Plan, off: float) -> Actions:
        """Go by another plan; or, where that is worse, by the one at hand."""
        why = str(found.failures[0]) if found.failures else ""
        no_better = why and off < FALLBACK and not self._at_hand.failure
        if found.trajectory is None or no_better:
            yield from self._keep_plan(off, why)
            return
        changes = len(found.changes)
        if why and changes == 0:
            self._stop(why)
            return
        self._note(Replanned, changes=changes)
        if self._plan.policy is None and found.fallback and found.fallback.source:
            self._count_by(found)
        self._adopt(found, found.trajectory, FIRST)
        if changes == 0 and not self._at_hand.goes_on:
            # There is still the way to the last posture.
            yield from self._settle(found.trajectory.segments[-1].begin - 1)

    def _keep_plan(self, off: float, why: str) -> Actions:
        """No other plan was found: the one at hand may do, or may not."""
        if self._steps and self.done == self._steps:
            self._note(KeptStance, why=why)
            self._at_hand.change = len(self._at_hand.spans)
        elif off < FALLBACK:
            self._note(KeptPlan, why=why)
            self._ref.resume()
            if self._at_hand.change > 0:
                last = self._at_hand.spans[self._at_hand.change - 1]
                yield from self._ref.play(last.end)
        else:
            self._stop(why)

    def _stop(self, why: str) -> None:
        """Stay in the stance that holds."""
        self._note(Stopped, why=why)
        self.stopped = why

    # What it knows.

    def _adopt(self, plan: Plan, trajectory: Trajectory, sample: int) -> None:
        self.estimate.believe(plan.world)
        scene = plan.world.scene
        self.watch.alert = any(
            x.roughness > CAUTION for x in (*scene.boxes, *scene.meshes)
        )
        self._ref.follow(trajectory, sample)
        self._at_hand = AtHand(plan, trajectory)
        self._bearing: list[Contact] = []  # contacts that are closed
        self._closed: tuple[int, bytes] | None = None  # when, and of which surfaces

    def _count_by(self, plan: Plan) -> None:
        """From here on steps are those of this plan: other contacts have their own."""
        self._goal = plan
        # A policy reads what comes next off the stance: it has no steps to count.
        steps = () if plan.policy else split_steps(plan.sequence, plan.world)[0]
        self.done = 0 if plan.state is None else plan.state.done
        self._steps = len(steps)
        self._begun = self.done + 1 - len(self._reached)

    def _note(self, kind: type[Event], **what: Any) -> None:
        self.events.append(kind(time=self.core.steps * PHYSICS_STEP, **what))

    def _note_moved(self, c: Contact, planned: Contact, *, made: bool) -> None:
        above, aside = self.estimate.deviation(c)
        names = {"surface": c.surface, "planned": planned.surface}
        self._note(ContactMoved, **names, above=above, aside=aside, made=made)

    def _count_change(self) -> None:
        """The present contact change has been done."""
        at_hand = self._at_hand
        made = at_hand.plan.changes[at_hand.change]
        at_hand.change += 1
        n: int | None = len(self._reached)
        if made.step.index is not None:
            done = made.step.index + 1
            self.done = max(self.done, done) if self._steps else done
            n = self.done - self._begun  # one that is made again counts once
        if self._plan.policy is not None and at_hand.plan is not self._plan:
            # Its steps are numbered anew, and there may be more or fewer of them.
            n = nearest_keyframe(self._plan, made, begin=len(self._reached) - 1)
        if n is not None:
            now = (self.core.steps - 1) * PHYSICS_STEP
            self._reached += [now] * (n - len(self._reached))
            self._reached[n:] = [now]

    def _in_use(self) -> set[str]:
        """Surfaces in contact or about to be, or loaded in place of one that is."""
        used = {*self._at_hand.near_contacts()}
        others = map(self.estimate.substitute, self.stance)
        used.update(c.surface for c in others if c is not None)
        makes = self._at_hand.next_contact
        if makes is not None:
            used.update(self._plan.world.robot.limb_of(makes.surface).surfaces)
        return used

    def _is_wrong(self) -> bool:
        """Is a link loaded that should not be, or a limb back on another support?"""
        return self._is_unintended() or self._is_back()

    def _is_back(self) -> bool:
        """Has a limb that was in contact come down on another support?"""
        return self._back >= LASTS

    def _is_unintended(self) -> bool:
        """Is a link loaded where it should not be? Then `watch` has found it."""
        if not self.watch.is_due:
            return False
        makes, world = self._at_hand.next_contact, self.estimate.world
        # The limb on its way grazes an edge and goes on.
        moving = () if makes is None else limb_links(world, makes.surface)
        self.estimate.kin.update(self.estimate.q)
        load = self.estimate.load
        return self.watch.find(self.estimate.kin, load, self._in_use, moving)


def _places(stance: Sequence[Contact]) -> set[tuple[str, str]]:
    """Pairs of surface and support."""
    return {(c.surface, c.support) for c in stance}


def _resting(estimate: Estimate, stance: Sequence[Contact]) -> Iterable[str]:
    """Contacts that bear: those of the stance, and others of its limbs where loaded."""
    for c in stance:
        for surface in estimate.world.robot.limb_of(c.surface).surfaces:
            other = replace(c, surface=surface)
            if surface == c.surface or estimate.force(other) >= estimate.lost:
                yield f"{surface}@{c.support}"
