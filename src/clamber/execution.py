"""Plan, measurements -> servo commands: execution that feels its contacts.

The trajectory is a reference, not a promise. A limb that touches early stops there and
the contact is taken where it is; one that has not touched at the planned point goes on
along the normal until it does, or until `REACH` is used up. Where a contact is not
where it was planned, the supports are estimated anew from all contacts felt so far, the
stance is taken as it is, and the remaining keyframes are solved again from there while
the robot stands still. A contact that bears nothing at the end of a step is felt for
again. Where nothing is found, the robot stays in the stance it is in and says why.

What is sensed is `Measurement`: joint encoders, base pose, contact force of each
surface; late and noisy. Nothing else of the physics is looked at.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from clamber.contact import Contact
from clamber.control import JointLaw
from clamber.errors import InputError, Status
from clamber.model import PHYSICS_STEP, Kinematics, World, build_world
from clamber.moves import split_moves
from clamber.path import ARC_WEIGHT, Phase, bridge
from clamber.pipeline import Plan, search_steps
from clamber.posture import direct
from clamber.posture.ik import IK, ContactGoal, support_rotation
from clamber.posture.keyframe import Keyframe, KeyframeTask
from clamber.scaling import retarget
from clamber.scene import GROUND, Box, Scene
from clamber.se3 import matrix_from_quat, quat_from_matrix
from clamber.search import standing
from clamber.sensing import Measurement
from clamber.trajectory import HOLD_END, HOLD_START, Trajectory, build_trajectory
from clamber.transition import balance_problem

TOUCH = 10.0  # [N] normal force that is a contact
LOST = 1.5  # [N] a contact of the stance that bears less is lost
SMOOTHING = 0.03  # [s] time constant of forces and of the measured posture
REACH = 0.12  # [m] a contact is looked for this far from where it was planned
NEAR = 0.06  # [m] sideways from the planned place, a touch is that contact
FEELING_SPEED = 0.04  # [m/s] along the normal
FEELING_NODES = 9  # postures on the way
DEVIATION = 0.006  # [m] along the normal: the rest is planned again
DRIFT = 0.015  # [m] along the support: the rest is planned again
START_DRIFT = 0.010  # [m] of the start, as far as the arms reach
MASS_CHANGE = 0.02  # share: torques are scaled
LOOK = 0.15  # [s] at rest before a posture is measured
THINKING = 0.6  # [s] the robot stands still while the rest is planned again
AHEAD = 1.0  # [s] before a foot steps, its ankle is held again
EASING = 0.5  # [s] from held to self-positioned
BLEND = 0.3  # [s] back to a trajectory that was left
FALLBACK = 0.035  # [m] a deviation that the plan at hand may survive as it is
HEIGHT_SIGMA = 0.05  # [m] what is expected of a box's height
SLOPE_SIGMA = 0.08  # [rad] ... and of its slopes
CONTACT_SIGMA = 0.006  # [m] ... and of one contact on it
END = 2.0  # [s] the last posture is held

Ticks = Iterator[None]


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Event:
    """What was felt, and what was done about it."""

    time: float
    text: str


@dataclass(frozen=True, eq=False, slots=True)
class _Leg:
    """One step of a trajectory, from a keyframe to the next, in samples."""

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
        self._q = plan.trajectory.q[:, world.qadr]
        self._v = plan.trajectory.v[:, world.dadr]
        self._qadr = world.qadr
        self._k = -1
        self.events: list[Event] = []
        self.stopped = ""
        self.followed: Trajectory | None = None

    def command(self, measured: Measurement) -> np.ndarray:
        """(na,) servo command of the next physics step."""
        self._k = k = self._k + 1
        return self._law.command(
            self._q[k], self._v[k], self._trajectory.tau[k], measured.q[self._qadr]
        )

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
        self._world = plan.world  # as it is believed to be
        self._kin = Kinematics(plan.world)
        self._law = JointLaw(world)
        self._qadr, self._dadr = world.qadr, world.dadr
        self._surfaces = tuple(world.surfaces)
        self._arms = [
            [self._surfaces.index(s) for s in limb.surfaces]
            for limb in world.robot.limbs.values()
            if limb.is_arm
        ]
        self._ankles = _ankles(world)
        self._follow = np.zeros(len(self._qadr))  # of (4.32), by joint
        self._next = 0  # steps of the sequence that have been made
        self._felt: dict[tuple[str, int], tuple[str, np.ndarray]] = {}
        self._scale = 1.0  # of the torques: mass as felt over mass as described
        self._q_smooth = plan.trajectory.q[0].copy()
        self._f_smooth = np.zeros((len(self._surfaces), 3))
        self._k = 0  # physics steps so far
        self._velocity = np.zeros(len(self._dadr))
        self._torque = plan.trajectory.tau[0]
        self._closed = plan.trajectory.contact[0]
        self._rows: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]] = []
        self._replanned = False
        self.reference = plan.trajectory.q[0]
        self.left = len(plan.trajectory.time)
        self.events: list[Event] = []
        self.stopped = ""
        self._adopt(plan.trajectory, plan.keyframes)
        self._behaviour = self._behave()

    def command(self, measured: Measurement) -> np.ndarray:
        """(na,) servo command of the next physics step."""
        self._sense(measured)
        next(self._behaviour)
        self._k += 1
        v = np.zeros(self._world.model.nv)
        v[self._dadr] = self._velocity
        self._rows.append((self.reference, v, self._torque, self._closed))
        return self._law.command(
            self.reference[self._qadr],
            self._velocity,
            self._scale * self._torque,
            measured.q[self._qadr],
            self._self_positioning(),
        )

    @property
    def followed(self) -> Trajectory | None:
        """What was followed, where that is not the plan; velocities of joints only."""
        if not self._replanned:
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
        while self._leg < len(self._legs) and not self.stopped:
            yield from self._step()
        if self._missed and not self.stopped:
            self._stop(self._missed)
        yield from self._end()

    def _step(self) -> Ticks:
        """One leg of the trajectory: shift, swing, touch, settle."""
        leg = self._legs[self._leg]
        c = leg.made
        if c is None:
            yield from self._play(leg.end)
        else:
            yield from self._play(leg.swing)
            near = 0.5 * (leg.swing + leg.touch)
            yield from self._play(
                leg.touch, until=lambda: self._i > near and self._touches(c)
            )
            early = self._i < leg.touch
            if early and self._off(c)[0] > DEVIATION:
                self._note(f"{c.surface} touches {self._words(c)}")
                yield from self._replan(c)
                return
            yield from self._play(leg.touch)
            if not self._touches(c):
                found = yield from self._feel(c)
                if not found:
                    if not self.stopped:
                        self._stop(
                            f"{c.surface} finds no support within"
                            f" {1e3 * REACH:.0f} mm of where it was planned"
                        )
                    return
                if abs(self._off(c)[0]) > DEVIATION:
                    self._note(f"{c.surface} touches {self._words(c)}")
                    yield from self._replan(c)
                    return
                yield from self._back()
            yield from self._play(leg.end)
        self._leg += 1
        self._tick_off(leg)
        self._remember(self._keyframes[self._leg].stance)
        yield from self._check_stance()

    def _check_start(self) -> Ticks:
        """Is the robot where it should be, and as heavy?"""
        weight = float(self._f_smooth[:, 2].sum())
        ratio = weight / (9.81 * self._world.mass)
        if abs(ratio - 1.0) > MASS_CHANGE:
            self._note(f"weighs {100 * ratio:.0f} % of what its description says")
            self._scale = float(np.clip(ratio, 0.5, 2.0))
        q, ref = self._q_smooth, self.reference
        yaw = _yaw(q[3:7]) - _yaw(ref[3:7])
        yaw = float((yaw + np.pi) % (2 * np.pi) - np.pi)
        x, y, theta = self._world.scene.start
        c, s = np.cos(yaw), np.sin(yaw)
        rel = np.array([x, y]) - ref[:2]
        xy = q[:2] + np.array([c * rel[0] - s * rel[1], s * rel[0] + c * rel[1]])
        off = float(np.linalg.norm(xy - [x, y])) + 0.3 * abs(yaw)
        if off <= START_DRIFT:
            return
        self._note(
            f"starts {1e3 * float(np.linalg.norm(xy - [x, y])):.0f} mm and"
            f" {np.degrees(yaw):.0f} degrees from where it was planned"
        )
        start = np.array([*xy, theta + yaw])
        world = build_world(self._world.robot, replace(self._world.scene, start=start))
        yield from self._rest(THINKING)
        ik = IK(world)
        first = standing(ik, self._plan.options.keyframe)
        yield from self._search(ik, first, (), off)

    def _check_stance(self) -> Ticks:
        """At a keyframe: is every contact where it should be, and does it bear?"""
        stance = self._keyframes[self._leg].stance
        for c in stance:
            if self._leg < len(self._legs) and self._force(c) < LOST:
                self._note(f"{c.surface} bears nothing: felt for again")
                found = yield from self._feel(c)
                if not found:
                    self._note(f"{c.surface} finds nothing: the others bear the robot")
                    yield from self._back()
                elif abs(self._off(c)[0]) > DEVIATION:
                    yield from self._replan(None)
                    return
                else:
                    yield from self._back()
        if self._leg == len(self._legs):
            return
        for c in stance:
            up, side = self._off(c)
            if abs(up) > DEVIATION or side > DRIFT:
                self._note(f"{c.surface} is {self._words(c)}")
                yield from self._replan(None)
                return

    def _end(self) -> Ticks:
        """Hold the last posture."""
        n = round(END / PHYSICS_STEP)
        self._velocity = np.zeros(len(self._dadr))
        for k in range(n):
            self.left = n - 1 - k
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
            yield

    def _set(self, t: Trajectory, i: int) -> None:
        self.reference, self._torque = t.q[i], t.tau[i]
        self._velocity, self._closed = t.v[i, self._dadr], t.contact[i]

    def _rest(self, seconds: float) -> Ticks:
        """Stand still."""
        self._velocity = np.zeros(len(self._dadr))
        self._replanned = True
        for _ in range(round(seconds / PHYSICS_STEP)):
            yield

    def _back(self) -> Ticks:
        """From where the reference is to where the trajectory was left."""
        t, i = self._trajectory, self._i
        q, tau = self.reference, self._torque
        d = self._kin.difference(q, t.q[i])
        n = round(BLEND / PHYSICS_STEP)
        for k in range(1, n + 1):
            s = 0.5 - 0.5 * np.cos(np.pi * k / n)
            self.reference = self._kin.integrate(q, s * d)
            self._torque = tau + s * (t.tau[i] - tau)
            rate = 0.5 * np.pi / BLEND * np.sin(np.pi * k / n)
            self._velocity = rate * d[self._dadr]
            yield

    def _feel(self, c: Contact) -> Iterator[None]:
        """Go on along the normal; returns whether the contact is felt."""
        t = self._feeling(c)
        if t is None:
            return False
        self._replanned = True
        for i in range(len(t.time)):
            self._set(t, i)
            yield
            if self._touches(c):
                self._velocity = np.zeros(len(self._dadr))
                yield from self._rest(LOOK)
                return True
        return False

    def _replan(self, made: Contact | None) -> Ticks:
        """Take the stance as it is and plan the remaining steps again."""
        yield from self._rest(LOOK)
        leg = self._legs[self._leg] if self._leg < len(self._legs) else None
        stance = list(self._keyframes[self._leg].stance)
        if made is not None:
            after = self._keyframes[self._leg + 1].stance
            stance = [c for c in after if c.surface != made.surface]
            stance.append(next(c for c in after if c.surface == made.surface))
            assert leg is not None
        off = max(max(abs(u), s) for u, s in (self._off(c) for c in stance))
        contacts = tuple(self._as_felt(c) for c in stance)
        if made is not None:
            assert leg is not None
            self._tick_off(leg, self._leg + 1)
        self._remember(contacts)
        world = self._believed()
        ik = IK(world)
        loaded = contacts if made is None else contacts[:-1]
        problem = balance_problem(
            world,
            held=loaded,
            closed=contacts[len(loaded) :],
            q_reference=self._rebased(),
            posture_weight=1.0,
            margin=0.005,
        )
        problem = replace(problem, ellipse_weight=0.0, com_weight=0.0)
        now = ik.solve_hard(problem, self._rebased())
        task = KeyframeTask(held=contacts, new=(), q_reference=now.q)
        key = direct.optimise(ik, task, now.q, self._plan.options.keyframe)
        yield from self._rest(THINKING)
        if key.status is not Status.SOLVED:
            yield from self._go_on(off, f"no stable posture here: {key.status.value}")
            return
        settle = Phase(
            kind="settle",
            q=bridge(ik, now.q, key.q, contacts, contacts),
            contacts=contacts,
            load_before=loaded,
            load_after=contacts,
        )
        first = now.q.copy()
        first[self._qadr] = self.reference[self._qadr]
        blend = replace(
            settle, kind="shift", q=np.array([first, now.q]), load_after=loaded
        )
        yield from self._search(ik, key, (blend, settle), off)

    def _search(
        self, ik: IK, first: Keyframe, lead: tuple[Phase, ...], off: float
    ) -> Ticks:
        """Plan the remaining steps from `first`, reached by `lead`; follow that."""
        plan, world = self._plan, ik.world
        try:
            sequence = retarget(plan.sequence, world)
        except InputError as e:
            yield from self._go_on(off, str(e))
            return
        steps = split_moves(sequence, world)[0][self._next :]
        found, _ = search_steps(ik, steps, plan.options, start=first)
        reason = found.missed[0].reason if found.missed else ""
        if reason and off < FALLBACK and not self._missed:
            yield from self._go_on(off, reason)
            return
        if reason and not found.paths:
            self._stop(reason)
            return
        phases = [*lead, *(p for path in found.paths for p in path.phases)]
        ends = len(lead) - 1 + np.cumsum([len(path.phases) for path in found.paths])
        if not phases:
            return
        trajectory = build_trajectory(
            world, phases, speed=plan.options.speed, keyframe_after=ends.tolist()
        )
        self._note(f"planned again: {len(found.paths)} steps")
        self._world, self._kin = world, Kinematics(world)
        self._missed = reason
        self._replanned = True
        self._adopt(trajectory, found.keyframes)
        self._missed = reason
        self._i = round(HOLD_START / PHYSICS_STEP) - 1

    def _go_on(self, off: float, why: str) -> Ticks:
        """No other plan was found: the one at hand may do, or may not."""
        if off < FALLBACK:
            self._note(f"goes on as planned ({why})")
            if self._leg < len(self._legs):
                leg = self._legs[self._leg]
                yield from self._back()
                yield from self._play(leg.end)
                self._leg += 1
            return
        self._stop(why)

    def _stop(self, why: str) -> None:
        """Stay in the stance that holds."""
        self._note(f"stopped: {why}")
        self.stopped = why

    # What it knows.

    def _adopt(self, trajectory: Trajectory, keyframes: Sequence[Keyframe]) -> None:
        self._trajectory, self._i = trajectory, 0
        self._keyframes = list(keyframes)
        self._legs, self._leg = _legs(trajectory, keyframes), 0
        self._missed = ""

    def _note(self, text: str) -> None:
        self.events.append(Event(time=self._k * PHYSICS_STEP, text=text))

    def _sense(self, m: Measurement) -> None:
        share = PHYSICS_STEP / SMOOTHING
        self._f_smooth += share * (m.force - self._f_smooth)
        q = self._q_smooth
        if m.q[3:7] @ q[3:7] < 0:
            q[3:7] *= -1
        q += share * (m.q - q)
        q[3:7] /= np.linalg.norm(q[3:7])

    def _force(self, c: Contact) -> float:
        """Normal force on a surface [N]."""
        n = self._world.supports[c.support].normal
        return float(self._f_smooth[self._surfaces.index(c.surface)] @ n)

    def _touches(self, c: Contact) -> bool:
        """Force on the surface, not far from where its contact was planned."""
        if self._force(c) < TOUCH:
            return False
        up, side = self._off(c)
        return side < NEAR and abs(up) < REACH + 0.02

    def _point(self, c: Contact) -> np.ndarray:
        """(3,) where the surface's lowest point is by the sensors."""
        self._kin.update(self._q_smooth)
        n = self._world.supports[c.support].normal
        return self._kin.contact_point(c.surface, n, c.edge)

    def _off(self, c: Contact) -> tuple[float, float]:
        """How far a contact is from its plan, along the normal and sideways [m]."""
        n = self._world.supports[c.support].normal
        off = self._point(c) - c.position - self._kin.roll(c.surface, n, c.link)
        up = float(off @ n)
        return up, float(np.linalg.norm(off - up * n))

    def _words(self, c: Contact) -> str:
        up, side = self._off(c)
        way = "above" if up > 0 else "below"
        return (
            f"{1e3 * abs(up):.0f} mm {way}, {1e3 * side:.0f} mm beside where it was"
            " planned"
        )

    def _as_felt(self, c: Contact) -> Contact:
        """The contact where it is by the sensors."""
        p = self._point(c)
        s = self._world.surfaces[c.surface]
        R = self._kin.rotation(s.body)
        support = self._world.supports[c.support]
        quaternion = c.quaternion
        if s.rotation is not None:
            flat = support_rotation(support, quat_from_matrix(R @ s.rotation))
            quaternion = quat_from_matrix(flat)
        if c.support == GROUND:
            p = p - support.normal * support.height(p)
        return replace(
            c, position=p, quaternion=quaternion, link=quat_from_matrix(R), edge=None
        )

    def _remember(self, contacts: Sequence[Contact]) -> None:
        """Where supports have been felt, one place for each contact made."""
        for c in contacts:
            if c.support != GROUND:
                p = self._point(c)
                key = (c.surface, self._next)
                near = [
                    k
                    for k, (_, x) in self._felt.items()
                    if k[0] == c.surface and np.linalg.norm(x[:2] - p[:2]) < 0.05
                ]
                self._felt[near[0] if near else key] = (c.support, p)

    def _believed(self) -> World:
        """The world with its boxes' tops fitted to the contacts felt on them."""
        first = self._plan.world
        boxes = []
        for b in first.scene.boxes:
            points = [p for s, p in self._felt.values() if s == b.name]
            boxes.append(fitted_box(b, np.array(points)) if points else b)
        scene: Scene = replace(self._world.scene, boxes=tuple(boxes))
        return build_world(self._world.robot, scene)

    def _rebased(self) -> np.ndarray:
        """(nq,) joint angles as commanded, base as measured."""
        q = self.reference.copy()
        q[:7] = self._q_smooth[:7]
        return q

    def _tick_off(self, leg: _Leg, key: int | None = None) -> None:
        """Count the steps of the sequence that have been made."""
        key = self._leg if key is None else key
        a, b = (self._keyframes[j].stance for j in (key - 1, key))
        gone = {c.surface for c in a} - {c.surface for c in b}
        steps = split_moves(self._plan.sequence, self._plan.world)[0]
        for k in range(self._next, len(steps)):
            move = steps[k].move
            if leg.made is None:
                same = move.makes is None and set(move.breaks) == gone
            else:
                same = (
                    move.makes is not None
                    and move.makes.surface == leg.made.surface
                    and move.makes.support == leg.made.support
                )
            if same:
                self._next = k + 1
                return

    def _self_positioning(self) -> np.ndarray | None:
        """(na,) share to which ankles of planted feet position themselves (4.32).

        From when both arms bear load until a foot must step again; eased in and out.
        """
        if not self._ankles:
            return None
        bearing = [any(self._f_smooth[s, 2] > TOUCH for s in arm) for arm in self._arms]
        t = self._trajectory
        ahead = t.contact[min(self._i + round(AHEAD / PHYSICS_STEP), len(t.time) - 1)]
        rate = PHYSICS_STEP / EASING
        for surface, joints in self._ankles.items():
            s = self._surfaces.index(surface)
            free = all(bearing) and self._closed[s] and ahead[s]
            self._follow[joints] += rate if free else -rate
        np.clip(self._follow, 0.0, 1.0, out=self._follow)
        return self._follow

    def _feeling(self, c: Contact) -> Trajectory | None:
        """A reference that goes on along the normal, as far as can be reached."""
        scene = self._world.scene
        lower = [
            replace(b, position=b.position - REACH * b.top.normal)
            if b.name == c.support
            else b
            for b in scene.boxes
        ]
        world = build_world(self._world.robot, replace(scene, boxes=tuple(lower)))
        ik = IK(world)
        stance = self._keyframes[self._leg].stance
        if self._leg < len(self._legs) and self._legs[self._leg].made is c:
            after = {x.surface for x in self._keyframes[self._leg + 1].stance}
            stance = tuple(x for x in stance if x.surface in after)
        held = tuple(x for x in stance if x.surface != c.surface)
        n = world.supports[c.support].normal
        start = self._trajectory.q[self._i]
        nodes, depths = [start], [0.0]
        for depth in np.linspace(0.0, REACH, FEELING_NODES)[1:].tolist():
            goal = ContactGoal(
                surface=c.surface,
                support=c.support,
                position=c.position - depth * n,
                rotation=support_rotation(world.supports[c.support], c.quaternion),
                hard=False,
                reference=ARC_WEIGHT,
            )
            problem = balance_problem(
                world,
                held=held,
                q_reference=nodes[-1],
                extra=(goal,),
                touching={c.surface: c.support},
                posture_weight=0.3,
                margin=0.01,
            )
            problem = replace(problem, ellipse_weight=0.0, com_weight=0.0)
            solution = ik.solve(problem, nodes[-1], iterations=25)
            ik.kin.update(solution.q)
            p = ik.kin.contact_point(c.surface, n)
            if solution.status is not Status.SOLVED or (p - goal.position) @ n > 0.01:
                break
            nodes.append(solution.q)
            depths.append(depth)
        if len(nodes) < 2:
            return None
        phase = Phase(
            kind="swing",
            q=np.array(nodes),
            contacts=held,
            load_before=held,
            load_after=held,
        )
        travel = np.abs(np.diff(phase.q[:, self._qadr], axis=0)).sum(axis=0).max()
        speed = max(float(travel) * FEELING_SPEED / depths[-1], 1e-3)
        t = build_trajectory(world, [phase], speed=speed)
        a = round(HOLD_START / PHYSICS_STEP)
        b = len(t.time) - round(HOLD_END / PHYSICS_STEP)
        return replace(
            t,
            time=t.time[: b - a],
            q=t.q[a:b],
            v=t.v[a:b],
            tau=t.tau[a:b],
            contact=t.contact[a:b],
        )


def fitted_box(box: Box, points: np.ndarray) -> Box:
    """The box with its top where contacts were felt.

    Heights over the top as it was believed are a + b x + c y in the top's frame, with
    normal priors on a, b and c: the maximum a posteriori.

    Args:
        box: As it was believed.
        points: (n, 3) felt, n >= 1.
    """
    top = box.top
    local = (points - top.position) @ top.rotation
    X = np.column_stack([np.ones(len(local)), local[:, :2]])
    weight = X.T @ X / CONTACT_SIGMA**2 + np.diag(
        [HEIGHT_SIGMA**-2, SLOPE_SIGMA**-2, SLOPE_SIGMA**-2]
    )
    a, b, c = np.linalg.solve(weight, X.T @ local[:, 2] / CONTACT_SIGMA**2)
    normal = np.array([-b, -c, 1.0]) / np.sqrt(1.0 + b * b + c * c)
    axis = np.cross([0.0, 0.0, 1.0], normal)
    angle = float(np.linalg.norm(axis))
    half = 0.5 * np.arcsin(min(angle, 1.0))
    axis = axis / angle if angle > 1e-12 else axis
    turn = matrix_from_quat(np.array([np.cos(half), *(np.sin(half) * axis)]))
    R = top.rotation @ turn @ top.rotation.T
    centre = top.position + a * top.normal
    return replace(
        box,
        rotation=R @ box.rotation,
        position=centre + R @ (box.position - top.position),
    )


def _ankles(world: World) -> dict[str, np.ndarray]:
    """(na,) bool by foot: the joints of its leg that position themselves."""
    m = world.model
    own = [j in world.robot.self_positioning for j in world.joints]
    bodies = [int(m.jnt_bodyid[m.joint(j).id]) for j in world.joints]
    out = {}
    for limb in world.robot.limbs.values():
        foot = limb.surfaces[0]
        chain = set()
        body = world.surfaces[foot].body
        while body:
            chain.add(body)
            body = int(world.model.body_parentid[body])
        bodies = [
            int(world.model.jnt_bodyid[world.model.joint(j).id]) for j in world.joints
        ]
        joints = np.array([o and b in chain for o, b in zip(own, bodies, strict=True)])
        if joints.any() and not limb.is_arm:
            out[foot] = joints
    return out


def _legs(t: Trajectory, keyframes: Sequence[Keyframe]) -> list[_Leg]:
    """The steps of a trajectory, from its contact flags."""
    out = []
    ends = [t.at(x) for x in t.keyframes]
    for j in range(len(ends) - 1):
        before = {(c.surface, c.support): c for c in keyframes[j].stance}
        after = keyframes[j + 1].stance
        made = [
            c
            for c in after
            if (c.surface, c.support) not in before
            or np.linalg.norm(before[c.surface, c.support].position - c.position) > 1e-6
        ]
        rows = slice(ends[j], ends[j + 1] + 1)
        if not made:
            out.append(_Leg(ends[j], ends[j + 1], ends[j + 1], None))
            continue
        c = made[0]
        open_ = ~t.contact[rows, t.surfaces.index(c.surface)]
        kept = {x.surface for x in after} - {c.surface}
        gone = [
            t.surfaces.index(x.surface)
            for x in keyframes[j].stance
            if x.surface not in kept
        ]
        air = open_ & ~t.contact[rows][:, gone].any(axis=1)
        k = np.flatnonzero(air)
        if len(k) == 0:
            out.append(_Leg(ends[j], ends[j + 1], ends[j + 1], None))
            continue
        out.append(_Leg(ends[j] + int(k[0]), ends[j] + int(k[-1]), ends[j + 1], c))
    return out


def _yaw(quat: np.ndarray) -> float:
    w, x, y, z = quat
    return float(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
