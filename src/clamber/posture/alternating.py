"""What `gradient` and `lbfgs` share: positions, then posture, and again.

The variables are the new contacts' coordinates in their supports' planes, inside the
supports' bounds (4.21). A position out of reach is pulled back to the nearest that the
IK reaches, as the method's text asks.
"""

from __future__ import annotations

import numpy as np

from clamber.posture.ik import EDGE_INSET, IK
from clamber.posture.keyframe import (
    Keyframe,
    KeyframeOptions,
    KeyframeTask,
    finish,
    keyframe_problem,
    new_positions,
    prescribed_goals,
    stability_cost,
)

INNER_ITERATIONS = 12  # QPs between two updates of the contacts, warm
FIRST_ITERATIONS = 60


class Alternation:
    """Evaluates L_s as a function of the contact positions alone."""

    def __init__(
        self, ik: IK, task: KeyframeTask, q: np.ndarray, options: KeyframeOptions
    ) -> None:
        """Remember the stance; `start` gives the first variables."""
        self.ik, self.task, self.options, self.q = ik, task, options, q
        self.supports = [ik.world.supports[c.support] for c in task.new]
        ik.kin.update(q)
        references = np.array([c.position for c in task.new]).reshape(-1, 3)
        self.before, _ = stability_cost(
            ik.kin, task, references, options.stability_weight
        )
        self._fresh = True

    def start(self) -> np.ndarray:
        """(2n,) the references, in their supports' planes."""
        local = [
            s.rotation[:, :2].T @ (c.position - s.position)
            for s, c in zip(self.supports, self.task.new, strict=True)
        ]
        return self.clip(np.concatenate(local)) if local else np.zeros(0)

    def clip(self, x: np.ndarray) -> np.ndarray:
        """(2n,) moved inside the supports' bounds."""
        out = x.copy().reshape(-1, 2)
        for i, s in enumerate(self.supports):
            lo, hi = (
                s.polygon.min(axis=0) + EDGE_INSET,
                s.polygon.max(axis=0) - EDGE_INSET,
            )
            out[i] = np.clip(out[i], lo, np.maximum(lo, hi))
        return out.ravel()

    def positions(self, x: np.ndarray) -> np.ndarray:
        """(n, 3) in the world."""
        return np.array(
            [
                s.position + s.rotation[:, :2] @ p
                for s, p in zip(self.supports, x.reshape(-1, 2), strict=True)
            ]
        ).reshape(-1, 3)

    def evaluate(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        """L_s and its gradient (n, 2) in the supports' planes, after IK for `x`."""
        self._solve(x)
        cost, grad = stability_cost(
            self.ik.kin,
            self.task,
            new_positions(self.ik.kin, self.task),
            self.options.stability_weight,
        )
        for i, s in enumerate(self.supports):
            grad[i] = s.rotation[:2, :2].T @ grad[i]
        return cost, grad

    def finish(self, x: np.ndarray, *, method: str, iterations: int) -> Keyframe:
        """The posture for the final positions, measured."""
        self._fresh = True
        self._solve(x)
        return finish(
            self.ik,
            self.task,
            self.options,
            self.q,
            method=method,
            iterations=iterations,
            cost_before=self.before,
        )

    def _solve(self, x: np.ndarray) -> None:
        goals = prescribed_goals(self.ik.world, self.task, self.positions(self.clip(x)))
        problem = keyframe_problem(self.ik.world, self.task, self.options, goals)
        n = FIRST_ITERATIONS if self._fresh else INNER_ITERATIONS
        self._fresh = False
        self.q = self.ik.solve(problem, self.q, iterations=n).q
        self.ik.kin.update(self.q)
