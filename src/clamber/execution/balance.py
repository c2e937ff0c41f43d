"""Centre of mass near the border of its support -> joints that bring it back.

A plan's postures balance, but a compliant robot sags by some millimetres, and where the
support is a narrow triangle that is all there is. Once the margin of the measured
centre of mass falls below `HIGH`, and by `SAG` below the planned one, its deviation e
from the plan, seen from the contacts, is fed back (with all its weight, w = 1, from
`FADE` less on; with feet on the ground alone both are `ON_GROUND`: a robot that leans
towards what it reaches for, brought back over weak ankles, falls backward):

    s = -w (P e + D de/dt) - integral(w e / T dt),    |s| <= MOST,

and s is where the centre of mass is moved to from its reference, by the smallest change
of posture that leaves the contacts where they are: the centre-of-mass admittance of
humanoids that walk ([Caron19]), here with any contacts. With the margin that it
was planned with, the robot is let alone.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from clamber import _core
from clamber.contact.contact import Contact
from clamber.model.core import core_of
from clamber.model.kinematics import Kinematics
from clamber.model.scene import GROUND
from clamber.model.world import World
from clamber.step.tasks import contact_rows

HIGH, FADE = 0.045, 0.02  # [m] margin at which feedback sets in, and within how much
ON_GROUND = 0.022, 0.008  # ... where nothing but feet on the ground bears
SAG = 0.003  # [m] less than the planned margin is no danger
P, D, T = 0.5, 0.1, 1.0  # gain; [s] of the rate; [s] of the integral
MOST = 0.03  # [m]
RATE_SMOOTHING = 0.03  # [s] time constant of the deviation
SMOOTHING = 0.02  # [s] ... and of the joints' offsets
SETTLED = 1e-4  # [m] less is nothing
DAMPING = 1e-4  # of the least-squares posture, where contacts are redundant


class Balance:
    """The feedback above for one robot, with its integral.

    Attributes:
        goal: (na,) [rad] to add to the reference, eased in by `SMOOTHING`.
    """

    def __init__(self, world: World, period: float) -> None:
        """Feed back every `period` [s]."""
        self._kin = Kinematics(world)
        self._core = _core.Balance(
            core_of(world),
            most=MOST * world.length_scale,
            **{"sag": SAG, "p": P, "d": D, "t": T},
            **{"smoothing": RATE_SMOOTHING, "settled": SETTLED},
            period=period,
        )
        self._contacts: Sequence[Contact] = ()
        self._acts = False
        self.goal = np.zeros(len(world.dadr))

    def update(
        self, q: np.ndarray, reference: np.ndarray, contacts: Sequence[Contact]
    ) -> bool:
        """Look at where the centre of mass is; once every period.

        Args:
            q: (nq,) as measured.
            reference: (nq,) as planned.
            contacts: That the plan has closed, loaded or not.

        Returns:
            Whether the goal is another one.
        """
        if not contacts:
            return False
        if contacts is not self._contacts:
            self._hold(contacts)
        acted, self._acts = self._acts, self._core.update(q, reference)
        if acted or self._acts:
            self.goal[:] = self._moved(reference) if self._acts else 0.0
        return acted or self._acts

    def _hold(self, contacts: Sequence[Contact]) -> None:
        """These contacts are loaded from here on."""
        world, bodies, local, sole = self._kin.world, [], [], []
        on_ground = all(
            c.support == GROUND and world.surface(c.surface, c.edge).radius == 0.0
            for c in contacts
        )
        high, fade = ON_GROUND if on_ground else (HIGH, FADE)
        for c in contacts:
            s = world.surface(c.surface, c.edge)
            bodies += [s.body] * len(s.corners)
            local.append(s.corners)
            down = -s.radius * world.supports[c.support].normal
            sole.append(np.tile(down, (len(s.corners), 1)))
        self._core.hold(
            bodies,
            np.concatenate(local),
            np.concatenate(sole),
            high=high * world.length_scale,
            fade=fade * world.length_scale,
        )
        self._contacts = contacts

    def _moved(self, reference: np.ndarray) -> np.ndarray:
        """(na,) that moves the centre of mass as is asked for, the contacts held."""
        kin = self._kin
        kin.update(reference)
        com = kin.com_jacobian()[:2].copy()
        A = np.concatenate([com, contact_rows(kin, self._contacts)])
        wanted = np.zeros(len(A))
        wanted[:2] = self._core.shift
        y = np.linalg.solve(A @ A.T + DAMPING * np.eye(len(A)), wanted)
        return (A.T @ y)[kin.world.dadr]
