"""Centre of mass near the border of its support -> joints that bring it back.

A plan's postures balance, but a compliant robot sags by some millimetres, and where the
support is a narrow triangle that is all there is. Once the margin of the measured
centre of mass falls below `HIGH`, and by `SAG` below the planned one, its deviation e
from the plan, seen from the contacts, is fed back (with all its weight, w = 1, from
`FADE` less on):

    s = -w (P e + D de/dt) - integral(w e / T dt),    |s| <= MOST,

and s is where the centre of mass is moved to from its reference, by the smallest change
of posture that leaves the contacts where they are: the centre-of-mass admittance of
humanoids that walk ([Caron19]), here with any contacts. With the margin that it
was planned with, the robot is let alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from clamber.contact.contact import Contact
from clamber.model.kinematics import Kinematics
from clamber.model.world import World
from clamber.step.polygon import com_margin, support_polygon

HIGH, FADE = 0.022, 0.008  # [m] margin at which feedback sets in, and within how much
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
        self._period = period
        self._deviation = np.zeros(2)
        self._integral = np.zeros(2)
        self.goal = np.zeros(len(world.dadr))

    def update(
        self, q: np.ndarray, reference: np.ndarray, contacts: Sequence[Contact]
    ) -> None:
        """Look at where the centre of mass is; once every period.

        Args:
            q: (nq,) as measured.
            reference: (nq,) as planned.
            contacts: That the plan has closed, loaded or not.
        """
        kin, dt = self._kin, self._period
        if not contacts:
            return
        now, points, margin = self._seen(q, contacts)
        planned, places, meant = self._seen(reference, contacts)
        # The contacts may be turned from where they were planned, all together.
        c = float(np.sum(points * places))
        s = float(np.sum(points[:, 0] * places[:, 1] - points[:, 1] * places[:, 0]))
        n = math.hypot(c, s)
        c, s = (c / n, s / n) if n > 0 else (1.0, 0.0)
        e = np.array([c * now[0] - s * now[1], s * now[0] + c * now[1]]) - planned
        rate = (e - self._deviation) / (RATE_SMOOTHING + dt)
        self._deviation = self._deviation + dt * rate
        e = self._deviation
        w = float(np.clip((min(HIGH, meant - SAG) - margin) / FADE, 0.0, 1.0))
        # Where it is not needed it fades.
        self._integral -= dt / T * (w * e + (1.0 - w) * self._integral)
        shift = self._integral - w * (P * e + D * rate)
        for x in (self._integral, shift):
            x *= MOST / max(float(np.linalg.norm(x)), MOST)
        if w == 0.0 and np.linalg.norm(self._integral) < SETTLED:
            self._integral[:] = 0.0
            self.goal[:] = 0.0
            return
        rows = [kin.com_jacobian()[:2].copy()]
        for contact in contacts:
            n = kin.world.supports[contact.support].normal
            surface = kin.world.surface(contact.surface, contact.edge)
            p = kin.contact_point(contact.surface, n, contact.edge)
            linear, angular = kin.jacobians(surface.body, p)
            rows.append(linear.copy())
            if surface.is_flat and contact.edge is None:
                rows.append(angular.copy())
        A = np.vstack(rows)
        wanted = np.zeros(len(A))
        wanted[:2] = shift
        y = np.linalg.solve(A @ A.T + DAMPING * np.eye(len(A)), wanted)
        self.goal[:] = (A.T @ y)[kin.world.dadr]

    def _seen(
        self, q: np.ndarray, contacts: Sequence[Contact]
    ) -> tuple[np.ndarray, np.ndarray, float]:
        """Centre of mass (2,), bearing points (K, 2), from their middle; margin."""
        kin = self._kin
        kin.update(q)
        supports = kin.world.supports
        points = np.vstack(
            [
                kin.bearing_points(c.surface, supports[c.support].normal, c.edge)
                for c in contacts
            ]
        )[:, :2]
        com, middle = kin.com[:2].copy(), points.mean(axis=0)
        return com - middle, points - middle, com_margin(com, support_polygon(points))
