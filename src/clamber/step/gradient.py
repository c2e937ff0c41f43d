"""Gradient descent on the contact positions, alternating with inverse kinematics.

X <- X - alpha grad L_s (4.23, 4.24); the step is halved while the cost rises. After
each update the IK finds the posture for the new positions, and with it the masses'
projections.
"""

from __future__ import annotations

import numpy as np

from clamber.step.alternating import Alternation
from clamber.step.ik import IK
from clamber.step.posture import Keyframe, KeyframeOptions, KeyframeTask

MAX_HALVINGS = 6


def optimise(
    ik: IK, task: KeyframeTask, q: np.ndarray, options: KeyframeOptions
) -> Keyframe:
    """A stable posture for the stance, starting from `q` (nq,)."""
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
