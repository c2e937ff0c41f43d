"""Joints and contact positions in one constrained problem.

The contact positions need no variables of their own: on its support, a contact is where
the posture puts the surface, so L_s, the bounds of the support and the closure of all
contacts are functions of q, and one sequence of QPs solves for all of them.
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
    stability_cost,
)
from clamber.step.tasks import closed, sliding


def optimise(
    ik: IK, task: KeyframeTask, q: np.ndarray, options: KeyframeOptions
) -> Keyframe:
    """A stable posture for the stance, starting from `q` (nq,)."""
    world = ik.world
    ik.kin.update(q)
    references = np.array([c.position for c in task.new]).reshape(-1, 3)
    before, _ = stability_cost(ik.kin, task, references, options.stability_weight)
    tasks = tuple(
        closed(world, c)
        if task.fixed
        else sliding(
            world,
            c,
            options.reference_weight,
            stability=options.stability_weight,
        )
        for c in task.new
    )
    solution = ik.solve_hard(keyframe_problem(world, task, options, tasks), q)
    return finish(
        ik,
        task,
        options,
        solution.q,
        method="direct",
        iterations=solution.iterations,
        cost_before=before,
    )
