"""L-BFGS on the contact positions, alternating with inverse kinematics (4.22)."""

from __future__ import annotations

import numpy as np

from clamber.step.alternating import Alternation
from clamber.step.ik import IK
from clamber.step.posture import Keyframe, KeyframeOptions, KeyframeTask


def optimise(
    ik: IK, task: KeyframeTask, q: np.ndarray, options: KeyframeOptions
) -> Keyframe:
    """A stable posture for the stance, starting from `q` (nq,)."""
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

    result = minimize(
        cost_and_gradient,
        x * unit,
        jac=True,
        method="L-BFGS-B",
        bounds=list(
            zip(alternation.lower * unit, alternation.upper * unit, strict=True)
        ),
        options={
            "maxiter": options.max_iterations,
            "ftol": options.delta_stop,
            "gtol": options.gradient_stop,
        },
    )
    return alternation.finish(method="lbfgs", iterations=int(result.nit))
