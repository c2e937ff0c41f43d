"""Three ways to place new contacts and find the posture that goes with them.

`direct` solves for joints and contacts at once: on its support, a contact is where the
posture puts the surface, so L_s, the bounds of the support and the closure of all
contacts are functions of q, and one sequence of QPs solves for all of them.

`lbfgs` (4.22) and `gradient` (4.23, 4.24) alternate: positions, then posture, and
again. Their variables are the new contacts' coordinates in their supports' planes,
inside the supports' bounds (4.21). A position out of reach is pulled back to the
nearest that the IK reaches, as the method's text asks.
"""

from __future__ import annotations

from typing import Literal

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
from clamber.step.tasks import EDGE_INSET, closed, sliding

INNER_ITERATIONS = 12  # QPs between two updates of the contacts, warm
MAX_HALVINGS = 6

Method = Literal["direct", "lbfgs", "gradient"]


def direct(
    ik: IK,
    task: KeyframeTask,
    q: np.ndarray,
    options: KeyframeOptions,
    *,
    hard: bool = True,
) -> Keyframe:
    """Joints and contact positions in one constrained problem.

    Args:
        ik: Workspace.
        task: The stance.
        q: (nq,) to start from.
        options: Of the posture optimisation.
        hard: Try from other postures where it stalls.
    """
    before = _cost_at_references(ik, task, q, options)
    new = tuple(
        closed(ik.world, c)
        if task.fixed
        else sliding(
            ik.world,
            c,
            options.reference_weight,
            stability=options.stability_weight,
        )
        for c in task.new
    )
    problem = keyframe_problem(ik.world, task, options, new)
    found = ik.solve_hard(problem, q) if hard else ik.solve(problem, q)
    return finish(
        ik,
        task,
        options,
        found.q,
        method="direct",
        iterations=found.iterations,
        cost_before=before,
    )


def gradient(
    ik: IK, task: KeyframeTask, q: np.ndarray, options: KeyframeOptions
) -> Keyframe:
    """Descent X <- X - alpha grad L_s; the step is halved while the cost rises."""
    alternation = Alternation(ik, task, q, options)
    x = alternation.start()
    cost, grad = alternation.evaluate(x)
    n = 0
    while n < options.max_iterations and np.linalg.norm(grad) > options.gradient_stop:
        n += 1
        # The weight w steepens the cost; alpha is meant for the plain norm.
        step = options.learning_rate / options.stability_weight
        trial, trial_cost, trial_grad = x, cost, grad
        for _ in range(MAX_HALVINGS):
            trial = alternation.clip(x - step * grad)
            trial_cost, trial_grad = alternation.evaluate(trial)
            if trial_cost <= cost:
                break
            step *= 0.5
        change = abs(cost - trial_cost)
        x, cost, grad = trial, trial_cost, trial_grad
        if change < options.delta_stop:
            break
    return alternation.finish(method="gradient", iterations=n)


def lbfgs(
    ik: IK, task: KeyframeTask, q: np.ndarray, options: KeyframeOptions
) -> Keyframe:
    """L-BFGS on the contact positions."""
    from scipy.optimize import minimize

    alternation = Alternation(ik, task, q, options)
    x = alternation.start()
    if len(x) == 0:
        return alternation.finish(method="lbfgs", iterations=0)

    # In units in which a step along the gradient is X - S, what (4.24) asks for: the
    # method's first step is as long as the gradient, and would leave the robot's reach.
    unit = np.sqrt(2.0 * options.stability_weight)

    def cost_and_gradient(y: np.ndarray) -> tuple[float, np.ndarray]:
        cost, grad = alternation.evaluate(y / unit)
        return cost, grad / unit

    lower, upper = alternation.lower * unit, alternation.upper * unit
    result = minimize(
        cost_and_gradient,
        x * unit,
        jac=True,
        method="L-BFGS-B",
        bounds=list(zip(lower, upper, strict=True)),
        options={
            "maxiter": options.max_iterations,
            "ftol": options.delta_stop,
            "gtol": options.gradient_stop,
        },
    )
    return alternation.finish(method="lbfgs", iterations=int(result.nit))


METHODS = {"direct": direct, "lbfgs": lbfgs, "gradient": gradient}


def _cost_at_references(
    ik: IK, task: KeyframeTask, q: np.ndarray, options: KeyframeOptions
) -> float:
    """L_s with the new contacts where they would be liked, the posture at `q`."""
    ik.kin.update(q)
    references = np.array([c.position for c in task.new]).reshape(-1, 3)
    return stability_cost(ik.kin, task, references, options.stability_weight)[0]


class Alternation:
    """Evaluates L_s as a function of the contact positions alone."""

    def __init__(
        self, ik: IK, task: KeyframeTask, q: np.ndarray, options: KeyframeOptions
    ) -> None:
        """Remember the stance; `start` gives the first variables."""
        self.ik, self.task, self.options, self.q = ik, task, options, q
        self.supports = [ik.world.supports[c.support] for c in task.new]
        self.before = _cost_at_references(ik, task, q, options)
        self.lowest, self.best = np.inf, np.zeros(0)
        corners = [s.polygon for s in self.supports]
        inset = EDGE_INSET * ik.world.length_scale
        self.lower = np.array([p.min(axis=0) + inset for p in corners]).ravel()
        self.upper = np.array([p.max(axis=0) - inset for p in corners]).ravel()

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
        places = zip(self.supports, x.reshape(-1, 2), strict=True)
        return np.array(
            [s.position + s.rotation[:, :2] @ p for s, p in places]
        ).reshape(-1, 3)

    def evaluate(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        """L_s and its gradient (2n,) in the supports' planes, after IK for `x`.

        Every evaluation starts from the posture of the lowest cost so far: a trial that
        went too far leaves no trace.
        """
        q, kin = self._solve(x), self.ik.kin
        kin.update(q)
        at, weight = new_positions(kin, self.task), self.options.stability_weight
        cost, grad = stability_cost(kin, self.task, at, weight)
        if cost < self.lowest:
            self.lowest, self.q, self.best = cost, q, x.copy()
        for i, s in enumerate(self.supports):
            grad[i] = s.rotation[:2, :2].T @ grad[i]
        return cost, grad.ravel()

    def finish(self, *, method: Method, iterations: int) -> Keyframe:
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
