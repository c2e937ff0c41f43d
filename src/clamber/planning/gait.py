"""A policy and a stance -> which contacts to try next, in order: geometry alone.

Algorithm 3 of the thesis: the policy's cycles are run from the initial state until the
goal; contacts start at the obstacle's closest points and go on by shares of what the
limb reaches, towards the goal. What comes next is read off the stance alone, so that a
plan can go on from any stance, as it is measured: steps on the feet, the climb of an
edge or a flight of stairs, a cycle on all fours, the way down.

Nothing is tried here. A manoeuvre yields its proposals, the best one first, and is sent
what came of each; whoever tries them (`traverse`) stops at the first that is accepted.

The way down is a way up: a climb that is statically stable is so backwards as well. The
ascent is planned from where the robot will stand behind the far edge; each of its
steps, reversed, is where a step of the descent is looked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from clamber.contact.contact import Contact
from clamber.contact.policy import (
    GeneralPolicy,
    Option,
    pelvis_angles,
    pelvis_distribution,
    pelvis_rotation,
)
from clamber.contact.steps import MOVED, Seeds, Step
from clamber.errors import InputError
from clamber.model.kinematics import Kinematics
from clamber.model.scene import GROUND, Edge
from clamber.model.se3 import matrix_from_quat, turn_about_z
from clamber.model.world import World
from clamber.planning.gaps import due_near_gap, gaps_ahead
from clamber.planning.proportions import STAND, proportions_of
from clamber.planning.proposals import (
    FREELY,
    IMPOSED,
    TOGETHER,
    Accept,
    Climb,
    Goal,
    Made,
    Manoeuvre,
    Outcome,
    Part,
    Proposal,
    Round,
)
from clamber.planning.route import (
    ARRIVED,
    FACING,
    Frame,
    Platform,
    contact_at,
    find_place,
    find_platforms,
    goal_of,
    room_on,
)
from clamber.planning.stairs import CLEAR, FLUSH, Flight
from clamber.step.change import home_at
from clamber.step.posture import Keyframe

# Of the body in one cycle on all fours, at most: [rad], and in steps of the limb that
# steps least. Longer ones, and the cycle fails: then it is tried shorter.
TURN, STRIDE = 0.4, 1.6
STEP_TURN = 0.30  # [rad] of the body in one step of each foot, at most
SHARES = (1.0, 0.6, 0.3)  # of its length: a step that fails is tried shorter
RISER_SHARES = (1.0, 0.5, 0.25)  # ... a cycle over a riser
NEARER = (0.0, 0.4)  # share of the way to a limb that is stuck, to stand around it
NEARLY = 0.12  # [m] where it gets no nearer to an edge, it may climb down from here
STAND_TOLERANCE = 0.12  # lengths of a leg, from where the body stands before an edge
BESIDE_TOLERANCE = 0.10  # [m] along the edge
# Knees stay so far from a riser, in lengths of a thigh: nearer to it, the thigh meets
# its upper edge before it leans far enough for the weight to get past the other knee.
BEFORE_RISER = 0.5


class Gait:
    """What a policy does in a world.

    Attributes:
        world: Robot and scene.
        policy: Its options, in order.
        cycle: The one on top of an obstacle (region O), if it has one; else the last.
        proportions: Of the robot.
        platforms: Between start and goal.
        goal: (2,) where the body shall get to.
        goal_yaw: How it shall face there; None: as it does.
    """

    def __init__(self, world: World, policy: GeneralPolicy) -> None:
        """Look at the robot and the way once.

        Raises:
            InputError: The goal cannot be.
        """
        scene = world.scene
        self.world, self.policy = world, policy
        on_top = (o for o in policy.options if o.region == "O")
        self.cycle = next(on_top, policy.options[-1])
        self._kin = Kinematics(world)
        self.proportions = proportions_of(self._kin, policy)
        self.goal = goal_of(scene)
        self.platforms = find_platforms(scene, self.goal)
        yaw = scene.goal
        self.goal_yaw = float(yaw[2]) if yaw is not None and len(yaw) == 3 else None

    def check_route(self) -> None:
        """A scene that cannot be crossed from where the robot stands.

        Raises:
            InputError: The policy has no cycle on top, or the first obstacle is too
                far, or one is too high.
        """
        if not self.platforms:
            return
        if self.cycle.region != "O":
            raise InputError(
                "a policy with a cycle on the obstacle (region O)",
                field="policy.options",
                value=[o.region for o in self.policy.options],
            )
        reach, height = self.proportions.reach, self.proportions.height
        for name in (b for p in self.platforms for b in p.boxes):
            top = float(self.world.supports[name].position[2])
            if top > height:
                raise InputError(
                    f"a top within {height:.2f} m, what the robot reaches, between"
                    " start and goal",
                    field=f"scene.{self.world.scene.kind(name)}.{name}",
                    value=f"{top:.2f} m high",
                )
        first = self.platforms[0]
        away = -first.entry.distance(self.world.scene.start)
        if away > reach:
            raise InputError(
                f"an obstacle within {reach:.2f} m, the robot's reach: it must first"
                f" walk {away - self.proportions.stand:.2f} m",
                field=f"scene.{self.world.scene.kind(first.boxes[0])}.{first.boxes[0]}",
                value=f"{away:.2f} m away",
            )

    def propose(self, at: Outcome) -> Manoeuvre:
        """What to try next from a stance; returns whether it has arrived.

        Args:
            at: Its stance; the posture counts where a limb has lost its contact.
        """
        platform = self.platform_of(at.stance)
        if platform is None:
            return (yield from self._on_feet(at))
        feet = [c.position for c in at.stance if c.support == GROUND]
        edge = platform.exit
        if feet and edge is not None and edge.distance(np.mean(feet, axis=0)) < 0:
            yield from self._dismount(at, platform)
        elif feet or self._next_treads(at, platform):
            yield from self._mount(at, platform)
        else:
            return (yield from self._on_top(at, platform))
        return False

    def platform_of(self, stance: Sequence[Contact]) -> Platform | None:
        """The first one that a stance is on, whole or in part."""
        for platform in self.platforms:
            if any(c.support in platform.boxes for c in stance):
                return platform
        return None

    # On its feet.

    def _on_feet(self, at: Outcome) -> Manoeuvre:
        """Steps to the next obstacle and up, or to the goal."""
        frame = self.feet_frame(at.stance)
        ahead = next((p for p in self.platforms if not p.is_passed(frame.xy)), None)
        if ahead is None:
            yaw = frame.yaw if self.goal_yaw is None else self.goal_yaw
            wanted = Frame(self.goal, yaw)
            if frame.is_at(wanted):
                return True
            yield self._walk(at, frame, wanted)
            return False
        wanted = Frame.behind(ahead.entry, -self.proportions.stand)
        off = wanted.local(frame.xy)
        if (
            abs(off[0]) <= STAND_TOLERANCE * self.proportions.stand / STAND
            and abs(off[1]) <= BESIDE_TOLERANCE
            and abs(frame.turn_to(wanted)) <= FACING
        ):
            yield from self._mount(at, ahead)
        else:
            yield self._walk(at, frame, wanted)
        return False

    def feet_frame(self, stance: Sequence[Contact]) -> Frame:
        """Midpoint of the feet, and the mean of how they are turned."""
        soles = [x.surfaces[0] for x in self.world.robot.limbs.values() if not x.is_arm]
        feet = [c for c in stance if c.surface in soles]
        ways = np.sum([matrix_from_quat(c.quaternion)[:2, 0] for c in feet], axis=0)
        middle = np.mean([c.position[:2] for c in feet], axis=0)
        return Frame(middle, float(np.arctan2(ways[1], ways[0])))

    def _walk(self, at: Outcome, frame: Frame, wanted: Frame) -> Proposal:
        """One step of each foot towards where it shall stand."""
        legs = [x for x in self.world.robot.limbs.values() if not x.is_arm]
        step = min(self.proportions.step[x.name] for x in legs)
        body = frame.towards(wanted, step, STEP_TURN)
        turn = self.proportions.feet * frame.turn_to(body)
        left_first = frame.local(body.xy)[1] + turn > 0
        legs.sort(key=lambda x: x.name.startswith("left") != left_first)
        goals = []
        for leg in legs:
            left = 1.0 if leg.name.startswith("left") else -1.0
            to = np.array(
                [*body.at(np.array([0.0, left * self.proportions.feet])), 0.0]
            )
            ground = self.world.supports[GROUND]
            contact = contact_at(leg.surfaces[0], ground, to, body.yaw)
            goals.append(self._goal(at, self.policy.options[-1], contact))
        return Proposal(
            after=at,
            goals=goals,
            body=body,
            rounds=IMPOSED,
            posture="home",
            accept="some",
        )

    def ankles(self, body: Frame) -> np.ndarray:
        """(3,) x, y, yaw of the ankles' midpoint where the feet are at the body's."""
        return np.array([*body.at(-self.proportions.ahead), body.yaw])

    # Up and down.

    def _next_treads(
        self, at: Outcome, platform: Platform
    ) -> list[tuple[Contact, ...]]:
        """What goes up a flight of stairs next; empty where it is none, or is up."""
        flight = Flight(self.world, platform, self.goal, self.proportions.stairs)
        return flight.next_contacts(at.stance) if flight.is_climbable() else []

    def _mount(self, at: Outcome, platform: Platform) -> Part:
        """The next contacts of a flight of stairs, or all that is left of a climb."""
        wanted = self._next_treads(at, platform)
        if not wanted:
            yield Climb(after=at, steps=self._left_of_ascent(at, platform))
            return
        # Where not all of a pair get to their places, all go to their next best.
        some, options = None, self.policy.options
        for rank in range(max(map(len, wanted))):
            goals = []
            for places in wanted:
                to = places[min(rank, len(places) - 1)]
                moving = (o.name for o in options if to.surface in o.surfaces)
                goals.append(Goal(next(moving, options[-1].name), (to,)))
            tried = yield Proposal(
                after=at,
                goals=goals,
                body=Frame.behind(platform.entry),
                rounds=FREELY * 2,
                posture="upright",
            )
            some = some or (tried if tried.changes else None)
        if some is not None:
            yield _taken(some)

    def _left_of_ascent(
        self, at: Outcome, platform: Platform
    ) -> list[tuple[Step, str]]:
        """The steps after the surfaces that each limb is on."""
        rows = self._ascent(platform.entry, platform)
        on = {c.surface for c in at.stance}
        left = []
        for k, (step, option) in enumerate(rows):
            later = (s.makes for s, _ in rows[k:] if s.limb == step.limb)
            if not any(c is not None and c.surface in on for c in later):
                left.append((step, option))
        return left

    def _ascent(self, edge: Edge, platform: Platform) -> list[tuple[Step, str]]:
        """The steps of a climb with the options that they belong to."""
        rows: list[tuple[Step, str]] = []
        on: dict[str, str] = {}
        for option in self.policy.options:
            for surface in option.surfaces:
                limb = self.world.robot.limb_of(surface)
                if on.get(limb.name) == surface:
                    continue
                if option.region == "O" and limb.is_arm and limb.name in on:
                    continue
                offset = self.proportions.mount(limb, surface)
                contact = self.place(platform, surface, Frame.behind(edge), offset)
                breaks = () if limb.is_arm else limb.surfaces[:1]
                if limb.name in on:
                    breaks = (on[limb.name],)
                on[limb.name] = surface
                step = Step(limb=limb.name, breaks=breaks, makes=contact)
                rows.append((step, option.name))
            if option.region == "O":
                break
        return rows

    def _dismount(self, at: Outcome, platform: Platform) -> Part:
        """The ascent from behind the far edge reversed, as far as it is left.

        Where that cannot be, contacts move to where it begins: from there is a way, at
        worst with feet that lie turned.
        """
        edge = platform.exit
        assert edge is not None
        ankles = self.ankles(Frame.behind(edge, -self.proportions.stand))
        ascent = self._ascent(edge, platform)
        up = yield Climb(after=at, steps=ascent, start=ankles, accept="never")
        if up.failure:
            return
        here = self._by_limb(at)
        on = {limb: c.surface for limb, c in here.items()}
        steps = []
        for step, option in reversed_steps(up.changes, home_at(self.world, ankles)):
            if on.get(step.limb) in step.breaks:
                del on[step.limb]
                if step.makes is not None:
                    on[step.limb] = step.makes.surface
                steps.append((step, option))
        yield Climb(after=at, steps=steps)
        if not steps or any(c.support == GROUND for c in at.stance):
            return
        body, goals = self.quadrupedal_frame(up.stance), []
        for limb, c in self._by_limb(up).items():
            if limb not in here or not _is_same(here[limb], c):
                to = self.world.supports[c.support], c.position
                contact = contact_at(c.surface, *to, body.yaw)
                goals.append(self._goal(at, self.cycle, contact))
        yield Proposal(after=at, goals=goals, body=body, rounds=IMPOSED, accept="some")
        turning = [(replace(step, turns=True), option) for step, option in steps]
        yield Climb(after=at, steps=turning)

    # On all fours.

    def _on_top(self, at: Outcome, platform: Platform) -> Manoeuvre:
        """One cycle on top, or the descent where it begins."""
        frame = self.quadrupedal_frame(at.stance)
        yield from self._set_down(at, platform, frame)
        edge = platform.exit
        if edge is None:
            yaw = frame.yaw if self.goal_yaw is None else self.goal_yaw
            if self.goal_yaw is None and self.has_risers(platform):
                yaw = platform.entry.yaw  # a riser is climbed square to it
            wanted = Frame(self.goal, yaw)
            if frame.is_at(wanted):
                return True
            yield from self._crawl(at, platform, frame, wanted)
            return False
        # It faces inwards, and climbs down backwards.
        wanted = Frame.behind(edge, self.proportions.behind)
        if not frame.is_at(wanted):
            yield from self._crawl(at, platform, frame, wanted)
            if frame.away(wanted) > NEARLY:
                return False
        yield from self._dismount(at, platform)
        return False

    def quadrupedal_frame(self, stance: Sequence[Contact]) -> Frame:
        """The middle of the contacts; the yaw that fits them best on all fours."""
        limbs = [self.world.robot.limb_of(c.surface).name for c in stance]
        offsets = [self.proportions.offsets[n] for n in limbs]
        middle = np.mean([c.position[:2] for c in stance], axis=0)
        centre = np.mean(offsets, axis=0)
        dot = cross = 0.0
        for offset, c in zip(offsets, stance, strict=True):
            a, b = offset - centre, c.position[:2] - middle
            dot += float(a @ b)
            cross += float(a[0] * b[1] - a[1] * b[0])
        return Frame(middle, float(np.arctan2(cross, dot)))

    def has_risers(self, platform: Platform) -> bool:
        """Its boxes are of different heights."""
        tops = [self.world.supports[n].position[2] for n in platform.boxes]
        return max(tops) - min(tops) > FLUSH

    def _set_down(self, at: Outcome, platform: Platform, frame: Frame) -> Part:
        """Limbs that lost their contact: where they belong, else where they are."""
        on = self._by_limb(at)
        for surface in self.cycle.surfaces:
            limb = self.world.robot.limb_of(surface).name
            if limb in on:
                continue
            self._kin.update(at.key.q)
            here = self._kin.contact_point(surface, np.array([0.0, 0.0, 1.0]))[:2]
            contacts = (
                self.place(platform, surface, frame, self.proportions.offsets[limb]),
                self.place(platform, surface, Frame(here, frame.yaw), np.zeros(2)),
            )
            goals = [Goal(self.cycle.name, contacts)]
            at = yield Proposal(
                after=at, goals=goals, body=frame, rounds=IMPOSED, accept="never"
            )
        if at.changes:
            yield _taken(at)

    def _crawl(
        self, at: Outcome, platform: Platform, frame: Frame, wanted: Frame
    ) -> Part:
        """One cycle towards `wanted`."""
        if gaps_ahead(platform, at.stance, wanted.xy):
            wanted = Frame(wanted.xy, platform.entry.yaw)
        heading = self.heading(platform, frame, wanted)
        yield from self._over_gap(at, platform, frame, heading)
        step, risers = min(self.proportions.step.values()), self.has_risers(platform)
        full = frame.towards(heading, step if risers else STRIDE * step, TURN)
        leading = self.leading_first(frame, full)
        if risers:
            # The second knee over a riser wants the elbows near, so that knees may have
            # to go first; and where the next riser leaves elbows no room, hands bear
            # the trunk higher.
            limbs = {s: self.world.robot.limb_of(s) for s in leading}
            hands = [x.surfaces[0] if x.is_arm else s for s, x in limbs.items()]
            for surfaces in (leading, hands):
                for share in RISER_SHARES:
                    body = frame.part_way(full, share)
                    for order in (surfaces, _others_first(surfaces)):
                        yield self._cycle(at, platform, body, order)
        stuck = []
        for body, order in (
            (full, leading),
            (full, _others_first(leading)),
            (frame.part_way(full, 0.5), leading),
            (Frame(full.xy, frame.yaw), leading),
            (Frame(frame.xy, full.yaw), leading),
            (frame, leading),  # on the spot, as it should stand
        ):
            tried = yield self._cycle(at, platform, body, order)
            if tried.changes:
                stuck.append((body, tried))
        for body, tried in stuck:
            yield from self._brought_back(tried, platform, body)

    def _cycle(
        self,
        at: Outcome,
        platform: Platform,
        body: Frame,
        surfaces: Sequence[str],
        rounds: tuple[Round, ...] = TOGETHER,
        *,
        back: bool = False,
    ) -> Proposal:
        """Surfaces at their places around a body, those that have to move.

        Where they go back for another one's sake, those that climbed a riser stay above
        it.
        """
        tops = {n: self.world.supports[n].position[2] for n in platform.boxes}
        on, goals = self._by_limb(at), []
        for surface in surfaces:
            limb = self.world.robot.limb_of(surface).name
            here, boxes = on.get(limb), platform.boxes
            if here is not None and back:
                low = tops[here.support] - FLUSH
                boxes = tuple(n for n in boxes if tops[n] >= low)
            there = self.place(
                platform, surface, body, self.proportions.offsets[limb], boxes
            )
            if here is None or surface != here.surface or not _is_same(here, there):
                goals.append(self._goal(at, self.cycle, there))
        accept = "never" if back else "all"
        return Proposal(after=at, goals=goals, body=body, rounds=rounds, accept=accept)

    def _brought_back(self, at: Outcome, platform: Platform, body: Frame) -> Part:
        """The others around the first surface that is left behind, which then follows.

        They have gone too far ahead. First they stand around it on all fours, then
        nearer to it, so that they bear more of the weight and it is stretched less.
        """
        stuck = at.left[:1]
        limb = self.world.robot.limb_of(stuck[0]).name
        here = self._by_limb(at).get(limb)
        if here is None:
            return
        others = [s for s in self.cycle.surfaces if s not in stuck]
        # Over a riser it may follow before all are back.
        groups = [[s] for s in others] if self.has_risers(platform) else [others]
        for nearer in NEARER:
            offset = (1.0 - nearer) * self.proportions.offsets[limb]
            xy = here.position[:2] - turn_about_z(body.yaw) @ offset
            around, now = Frame(xy, body.yaw), at
            for group in groups:
                now = yield self._cycle(now, platform, around, group, FREELY, back=True)
                yield self._cycle(now, platform, body, stuck, FREELY)

    def leading_first(self, frame: Frame, to: Frame) -> tuple[str, ...]:
        """The cycle, begun with the limbs that are ahead on the way: arms, or legs.

        Where elbows follow knees and step first, what bears the robot shrinks.
        """
        arms_lead = frame.local(to.xy)[0] > -1e-6
        surfaces, limb_of = self.cycle.surfaces, self.world.robot.limb_of
        leads = [limb_of(s).is_arm == arms_lead for s in surfaces]
        k = leads.index(True) if True in leads else 0
        return surfaces[k:] + surfaces[:k]

    def heading(self, platform: Platform, frame: Frame, wanted: Frame) -> Frame:
        """`wanted`, or the part of the way there before or after the body can turn.

        Between walls it keeps its yaw; where it can turn now but not there, it does so
        now.
        """
        if abs(frame.turn_to(wanted)) <= FACING:
            return wanted
        radius, scene = self.proportions.radius, self.world.scene
        if room_on(scene, platform.boxes, frame.xy) < radius:
            if frame.away(wanted) > ARRIVED:
                return Frame(wanted.xy, frame.yaw)
        elif room_on(scene, platform.boxes, wanted.xy) < radius:
            return Frame(frame.xy, wanted.yaw)
        return wanted

    def _over_gap(
        self, at: Outcome, platform: Platform, frame: Frame, wanted: Frame
    ) -> Part:
        """One cycle near a gap; nothing where there is none.

        Where elbows and knees do not reach across, hands do, and knees do from a stand
        on both feet.
        """
        limbs, on = self.world.robot.limbs, self._by_limb(at)
        inner = {self.world.robot.limb_of(s).name: s for s in self.cycle.surfaces}
        if abs(frame.turn_to(wanted)) > FACING or not on.keys() >= inner.keys():
            return
        walks, hops = due_near_gap(
            self.proportions,
            platform,
            {n: on[n] for n in inner},
            frame,
            wanted,
            lambda n, body, offset: self.place(platform, inner[n], body, offset),
        )

        def moved(after: Outcome, goals: Sequence[Goal], accept: Accept) -> Proposal:
            return Proposal(after=after, goals=goals, body=wanted, accept=accept)

        def goal(after: Outcome, to: Contact, surfaces: Sequence[str]) -> Goal:
            ways = (replace(to, surface=s) for s in surfaces)
            return self._goal(after, self.cycle, *ways)

        goals = []
        for n, to in walks.items():
            same = on[n].surface
            kept = sorted(limbs[n].surfaces, key=lambda s, same=same: s != same)
            goals.append(goal(at, to, kept if limbs[n].is_arm else [to.surface]))
        walked = yield moved(at, goals, "never")
        hopping = [self._goal(walked, self.cycle, to) for to in hops.values()]
        yield moved(walked, hopping, "all")
        if not hops:
            return
        stands = []
        for n in hops:
            if on[n].surface == inner[n] and not limbs[n].is_arm:
                top, yaw = self.world.supports[on[n].support], wanted.yaw
                foot = contact_at(limbs[n].surfaces[0], top, on[n].position, yaw)
                stands.append(self._goal(walked, self.cycle, foot))
        stood = yield moved(walked, stands, "never")
        # Hands before elbows, but knees before feet.
        order = {n: limbs[n].surfaces[:: 1 if limbs[n].is_arm else -1] for n in hops}
        across = [goal(stood, to, order[n]) for n, to in hops.items()]
        hopped = yield moved(stood, across, "all")
        yield _taken(hopped if len(hopped.changes) > len(stood.changes) else walked)

    # One contact.

    def _goal(self, at: Outcome, option: Option, *wanted: Contact) -> Goal:
        """The first contact of a limb that can be made, there or part of the way."""
        here = self._by_limb(at).get(self.world.robot.limb_of(wanted[0].surface).name)
        contacts = []
        for c in wanted:
            contacts.append(c)
            if here is not None and here.support == c.support:
                top, way = self.world.supports[c.support], c.position - here.position
                for share in SHARES[1:]:
                    nearer = top.project(here.position + share * way)
                    contacts.append(replace(c, position=nearer))
        return Goal(option.name, tuple(contacts))

    def place(
        self,
        platform: Platform,
        surface: str,
        body: Frame,
        offset: np.ndarray,
        boxes: tuple[str, ...] = (),
    ) -> Contact:
        """Where a surface can rest, nearest to a point (2,) of the body's frame.

        On the platform, or on some boxes of it.
        """
        boxes, wanted = boxes or platform.boxes, body.at(offset)
        beside = self.world.surfaces[surface].radius + CLEAR
        if self.has_risers(platform) and not self.world.robot.limb_of(surface).is_arm:
            beside = max(beside, BEFORE_RISER * self.proportions.thigh)
        found = find_place(self.world.scene, boxes, wanted, beside)
        name, point = found or (boxes[0], np.array([*wanted, 0.0]))
        return contact_at(surface, self.world.supports[name], point, body.yaw)

    def pelvis(self, key: Keyframe, body: Frame) -> np.ndarray | None:
        """(3, 3) how the pelvis should be held [algorithm 3, step 14]; None: anyhow.

        As it is, turned the way that the body faces, its roll within what the policy
        imposes. Pitch is left to the robot: a person, whose thighs are longer than the
        upper arms, crawls with the hips high, and a robot of another build that is held
        so has its weight on its elbows and cannot lift them.
        """
        platform = self.platform_of(key.stance)
        if platform is None:
            return None
        self._kin.update(key.q)
        angles = pelvis_angles(self._kin.rotation(self.world.base))
        position = np.array([*body.xy, key.q[2]])
        held = pelvis_distribution(
            self.policy, platform.edges, position, near=self.proportions.thigh
        )
        if held is not None:
            angles[0] = held.clip(angles)[0]
        return pelvis_rotation(np.array([angles[0], angles[1], body.yaw]))

    def _by_limb(self, at: Outcome) -> dict[str, Contact]:
        return {self.world.robot.limb_of(c.surface).name: c for c in at.stance}


def _taken(outcome: Outcome) -> Proposal:
    """What was made is enough."""
    return Proposal(after=outcome, goals=(), body=Frame(np.zeros(2), 0.0))


def _others_first(surfaces: Sequence[str]) -> tuple[str, ...]:
    k = len(surfaces) // 2
    return (*surfaces[k:], *surfaces[:k])


def _is_same(here: Contact, there: Contact) -> bool:
    return bool(np.linalg.norm(there.position - here.position) < MOVED.wanted)


def reversed_steps(changes: Made, home: np.ndarray) -> list[tuple[Step, str]]:
    """The steps of an ascent backwards, from its end to its start.

    Args:
        changes: Of the ascent.
        home: (nq,) the posture that it began with.
    """
    out = []
    for up, option in changes[::-1]:
        assert up.step.makes is not None
        before = up.leaving[0] if up.leaving else None
        step = Step(
            limb=up.step.limb,
            breaks=(up.step.makes.surface,),
            makes=before,
            fixed=True,
            seeds=Seeds(shifted=up.touching, touching=up.shifted),
            reference=home if before is None else None,
            stands_up=up is changes[0][0],
        )
        out.append((step, option))
    return out
