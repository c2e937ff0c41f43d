"""L-BFGS on the contact positions, alternating with inverse kinematics (4.22)."""

from __future__ import annotations

import numpy as np

from clamber.posture.alternating import Alternation
from clamber.posture.ik import IK
from clamber.posture.keyframe import Keyframe, KeyframeOptions, KeyframeTask


def optimise(
    ik: IK, task: KeyframeTask, q: np.ndarray, options: KeyframeOptions
) -> Keyframe:
    """A stable posture for the stance, starting from `q` (nq,)."""
    from scipy.optimize import minimize

    alternation = Alternation(ik, task, q, options)
    x = alternation.start()
    if len(x) == 0:
        return alternation.finish(x, method="lbfgs", iterations=0)

    def cost_and_gradient(x: np.ndarray) -> tuple[float, np.ndarray]:
        cost, grad = alternation.evaluate(x)
        return cost, grad.ravel()

    result = minimize(
        cost_and_gradient,
        x,
        jac=True,
        method="L-BFGS-B",
        options={
            "maxiter": options.max_iterations,
            "ftol": options.delta_stop,
            "gtol": options.gradient_stop,
        },
    )
    return alternation.finish(result.x, method="lbfgs", iterations=int(result.nit))
