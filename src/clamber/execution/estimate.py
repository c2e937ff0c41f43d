"""Measurements -> where the robot is, what it touches, and what the boxes are like.

Posture and forces are filtered; a contact is judged by the force on its surface and by
where the posture says that this is. Heights measured on boxes make the scene that is
believed (`terrain`). Nothing here acts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from clamber import _core
from clamber.contact.contact import Contact
from clamber.contact.steps import MOVED
from clamber.execution.probe import REACH
from clamber.execution.sensors import Measurement
from clamber.execution.terrain import believed_scene
from clamber.model.kinematics import Kinematics
from clamber.model.scene import GROUND, Scene
from clamber.model.world import PHYSICS_STEP, World
from clamber.planning.start import measured_contact

# Of light robots, less: `World.force_scale`.
TOUCH = 10.0  # [N] normal force that is a contact
PRESSED = 4.0  # [N] ... where it was planned: six times the noise that is left of it
LOST = 1.5  # [N] a contact of the stance that carries less is lost
FORCE_SMOOTHING = 0.03  # [s] time constant of the forces
POSE_SMOOTHING = 0.01  # [s] ... and of the measured posture: it must not lag a touch
TILTED = 0.35  # [rad] a sole that is more so touches with a corner
NEAR = 0.06  # [m] sideways from the planned place, a touch is that contact
DEVIATION = 0.006  # [m] along the normal: a contact is not where it was planned
YIELDS = 0.005  # [m] a contact that bears lies so far beside where its joints aim


class Estimate:
    """State estimate of a robot: base, joints, contact forces, supports.

    Attributes:
        world: As it is believed to be; kin: a workspace of it.
        surfaces: Names of the nS surfaces.
        filter: Of what is measured.
        q: (nq,) filtered posture.
        load: (nS, 3) filtered forces on the surfaces [N], world axes.
        touch, pressed, lost: `TOUCH` and so on, of this robot [N].
    """

    def __init__(self, world: World, q: np.ndarray) -> None:
        """Begin in posture `q` (nq,), nothing loaded."""
        self.believe(world)
        self.surfaces = tuple(world.surfaces)
        self.touch, self.pressed, self.lost = (
            f * world.force_scale for f in (TOUCH, PRESSED, LOST)
        )
        self.filter = _core.Filter(
            q.tolist(),
            len(self.surfaces),
            pose_share=PHYSICS_STEP / POSE_SMOOTHING,
            force_share=PHYSICS_STEP / FORCE_SMOOTHING,
        )
        self.q, self.load = self.filter.q, self.filter.load
        self._measured: dict[tuple[str, int], tuple[str, np.ndarray]] = {}

    def believe(self, world: World) -> None:
        """Take the world to be like this."""
        self.world, self.kin = world, Kinematics(world)
        self._asked: Sequence[Contact] | None = None  # whether all of them bear

    def update(self, m: Measurement) -> None:
        """Take in the measurement of one physics step."""
        self.filter.update(m.q, m.force)

    def expect(self, *contacts: Contact, force: float | None = None) -> None:
        """Have a decision taken at once where a surface of these is pressed so [N].

        Args:
            contacts: Of the surfaces.
            force: None: `touch`.
        """
        self.filter.watch(*self._along(contacts), force or self.touch)

    def row(self, surface: str) -> int:
        """Row of a surface in the forces."""
        return self.surfaces.index(surface)

    def force(self, c: Contact) -> float:
        """Normal force on a contact's surface [N]."""
        n = self.world.supports[c.support].normal
        return float(self.load[self.row(c.surface)] @ n)

    def all_bear(self, contacts: Sequence[Contact]) -> bool:
        """Whether none of the contacts, which are looked at often, is `lost`."""
        if contacts is not self._asked:
            self._asked = contacts
            self.filter.bear(*self._along(contacts))
        return self.filter.least >= self.lost

    def _along(self, contacts: Sequence[Contact]) -> tuple[list[int], np.ndarray]:
        """Rows of surfaces, and normals (n, 3) of their supports."""
        normals = [self.world.supports[c.support].normal for c in contacts]
        rows = [self.row(c.surface) for c in contacts]
        return rows, np.array(normals).reshape(-1, 3)

    def point(self, c: Contact) -> np.ndarray:
        """(3,) where the surface's lowest point is."""
        self.kin.update(self.q)
        n = self.world.supports[c.support].normal
        return self.kin.contact_point(c.surface, n, c.edge)

    def deviation(self, c: Contact) -> tuple[float, float]:
        """Deviation of a contact from its plan: along the normal and tangential [m]."""
        n = self.world.supports[c.support].normal
        off = self.point(c) - c.position - self.kin.roll(c.surface, n, c.link)
        up = float(off @ n)
        return up, float(np.linalg.norm(off - up * n))

    def touches(self, c: Contact, aside: float = NEAR) -> bool:
        """Force on the surface, not far from where its contact was planned."""
        if self.force(c) < self.touch:
            return False
        up, side = self.deviation(c)
        return side < aside and abs(up) < REACH + 0.02

    def is_in_place(self, c: Contact) -> bool:
        """Pressed as little as can be told, where the contact was planned."""
        if self.force(c) < self.pressed:
            return False
        up, side = self.deviation(c)
        return side < NEAR and abs(up) < DEVIATION

    def substitute(self, c: Contact, *, there: bool = False) -> Contact | None:
        """The contact of another surface of the limb that is loaded in place of `c`.

        On the same support; or, if it need not be `there`, on another: a foot that is
        back on the ground.
        """
        if self.force(c) >= self.lost:
            return None
        others = () if there else self.world.supports.keys() - {c.support}
        for surface in self.world.robot.limb_of(c.surface).surfaces:
            for support in (c.support, *sorted(others)):
                other = replace(
                    c, surface=surface, support=support, edge=None, link=None
                )
                if surface != c.surface and self._bears(other):
                    if support != c.support or self._lies(other):
                        return replace(other, position=self.point(other))
        return None

    def _bears(self, c: Contact) -> bool:
        """Whether a surface is loaded over that support."""
        if self.force(c) < self.touch:
            return False
        p, support = self.point(c), self.world.supports[c.support]
        return bool(support.inside(p) and abs(support.height(p)) < REACH)

    def is_lost(self, c: Contact) -> bool:
        """Neither the contact's surface nor another one of the limb is loaded."""
        return self.force(c) < self.lost and self.substitute(c) is None

    def _lies(self, c: Contact) -> bool:
        """Whether a surface lies on its support rather than touching with a corner.

        Only then its middle is where the support is. The kinematics are up to date.
        """
        s = self.world.surfaces[c.surface]
        if s.rotation is None:
            return True
        up = (self.kin.rotation(s.body) @ s.rotation)[:, 2]
        return float(up @ self.world.supports[c.support].normal) > math.cos(TILTED)

    def measured(self, c: Contact) -> Contact:
        """The contact where it is."""
        self.kin.update(self.q)
        return measured_contact(self.kin, c)

    def aimed(self, c: Contact, q: np.ndarray) -> Contact:
        """The contact where it is, but for what it yields to its load.

        Of limbs that are nearly straight, closing millimetres takes a large motion.

        Args:
            c: The contact.
            q: (nq,) measured base, and what the joints are commanded to.
        """
        measured = self.measured(c)
        self.kin.update(q)
        off = measured_contact(self.kin, c).position - measured.position
        off *= min(1.0, YIELDS / max(float(np.linalg.norm(off)), 1e-9))
        return replace(measured, position=measured.position + off)

    def remember(self, contacts: Sequence[Contact], done: int) -> None:
        """Keep where supports were measured, one place for each contact made.

        Args:
            contacts: That are loaded now.
            done: Steps that have been done.
        """
        for c in contacts:
            if c.support != GROUND:
                p = self.point(c)
                near = (
                    k
                    for k, (_, x) in self._measured.items()
                    if k[0] == c.surface
                    and np.linalg.norm(x[:2] - p[:2]) < MOVED.measured
                )
                key = next(near, (c.surface, done))
                self._measured[key] = (c.support, p)

    def scene(self, planned: Scene) -> Scene:
        """The planned scene as it is by what was measured; its start as believed."""
        scene = believed_scene(planned, self._measured.values())
        return replace(scene, start=self.world.scene.start)
