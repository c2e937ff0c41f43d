"""What `gradient` and `lbfgs` share: positions, then posture, and again.

The variables are the new contacts' coordinates in their supports' planes, inside the
supports' bounds (4.21). A position out of reach is pulled back to the nearest that the
IK reaches, as the method's text asks.
"""

from __future__ import annotations

import numpy as np

from clamber.step.ik import IK
from clamber.step.posture import (
    Keyframe,
    KeyframeOptions,
    KeyframeTask,
    finish,
    keyframe_problem,
    new_positions,
    prescribed,
    stability_cost,
)
from clamber.step.tasks import EDGE_INSET

INNER_ITERATIONS = 12  # QPs between two updates of the contacts, warm


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
        self.lowest, self.best = np.inf, np.zeros(0)
        margins = [
            (s.polygon.min(axis=0), s.polygon.max(axis=0)) for s in self.supports
        ]
        self.lower = np.array([lo + EDGE_INSET for lo, _ in margins]).ravel()
        self.upper = np.array([hi - EDGE_INSET for _, hi in margins]).ravel()

    def start(self) -> np.ndarray:
        """(2n,) the references, in their supports' planes, inside their bounds."""
        local = [
            s.rotation[:, :2].T @ (c.position - s.position)
            for s, c in zip(self.supports, self.task.new, strict=True)
        ]
        return self.clip(np.concatenate(local)) if local else np.zeros(0)

    def clip(self, x: np.ndarray) -> np.ndarray:
        """(2n,) moved inside the supports' bounds."""
        return np.clip(x, self.lower, self.upper)

    def positions(self, x: np.ndarray) -> np.ndarray:
        """(n, 3) in the world."""
        return np.array(
            [
                s.position + s.rotation[:, :2] @ p
                for s, p in zip(self.supports, x.reshape(-1, 2), strict=True)
            ]
        ).reshape(-1, 3)

    def evaluate(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        """L_s and its gradient (2n,) in the supports' planes, after IK for `x`.

        Every evaluation starts from the posture of the lowest cost so far: a trial that
        went too far leaves no trace.
        """
        q = self._solve(x)
        kin = self.ik.kin
        kin.update(q)
        cost, grad = stability_cost(
            kin,
            self.task,
            new_positions(kin, self.task),
            self.options.stability_weight,
        )
        if cost < self.lowest:
            self.lowest, self.q, self.best = cost, q, x.copy()
        for i, s in enumerate(self.supports):
            grad[i] = s.rotation[:2, :2].T @ grad[i]
        return cost, grad.ravel()

    def finish(self, *, method: str, iterations: int) -> Keyframe:
        """The posture for the best positions evaluated, measured."""
        self.lowest = np.inf
        return finish(
            self.ik,
            self.task,
            self.options,
            self._solve(self.best),
            method=method,
            iterations=iterations,
            cost_before=self.before,
        )

    def _solve(self, x: np.ndarray) -> np.ndarray:
        positions = self.positions(self.clip(x))
        tasks = prescribed(self.ik.world, self.task, positions)
        problem = keyframe_problem(self.ik.world, self.task, self.options, tasks)
        if np.isinf(self.lowest):
            return self.ik.solve_hard(problem, self.q).q
        return self.ik.solve(problem, self.q, iterations=INNER_ITERATIONS).q
