"""Contacts that were measured -> what boxes are believed to be like.

Heights measured over a box's top are a plane plus the roughness of the surface,

    z_i = a + b x_i + c y_i + e_i,    a, b, c ~ normal priors,    e_i ~ N(0, s^2),

in the frame of the top as it was believed. The roughness `s` is that of `ROUGHNESS`
under which the heights are most probable (the evidence of the linear model, [Bishop06]
section 3.5): few contacts that contradict one another make a rough top, not a steep
one. The plane is then the maximum a posteriori, lowered until no contact lies below it:
the box that is planned with is inside the real one, rough by what may stick out of it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from clamber.model.scene import Box, Scene
from clamber.model.se3 import matrix_from_quat

HEIGHT_SIGMA = 0.05  # [m] what is expected of a box's height
SLOPE_SIGMA = 0.12  # [rad] ... and of its slopes
CONTACT_SIGMA = 0.006  # [m] how well a contact's height is measured on a smooth top
CAUTION = 0.02  # [m] least distance more from a top that was measured
ROUGHNESS = (0.0, 0.010, 0.020, 0.035)  # [m] that a top may have


def fitted_box(box: Box, points: np.ndarray) -> Box:
    """The box with its top, and the top's roughness, as contacts were measured.

    Args:
        box: As it was believed.
        points: (n, 3) measured on its top, in the world, n >= 1.
    """
    top = box.top
    local = (points - top.position) @ top.rotation
    X = np.column_stack([np.ones(len(local)), local[:, :2]])
    z = local[:, 2]
    prior = np.diag([HEIGHT_SIGMA, SLOPE_SIGMA, SLOPE_SIGMA]) ** 2
    fits = []
    for rough in ROUGHNESS:
        C = X @ prior @ X.T + (CONTACT_SIGMA**2 + rough**2) * np.eye(len(z))
        w = np.linalg.solve(C, z)
        evidence = -0.5 * (z @ w + np.linalg.slogdet(C)[1])
        fits.append((evidence, rough, prior @ X.T @ w))
    _, rough, (a, b, c) = max(fits, key=lambda fit: fit[0])
    normal = top.rotation @ np.array([-b, -c, 1.0]) / np.sqrt(1.0 + b * b + c * c)
    # The turn that takes the old normal to the new one: 1 + cos, axis times sin.
    turn = np.array([1.0 + normal @ top.normal, *np.cross(top.normal, normal)])
    R = matrix_from_quat(turn / np.linalg.norm(turn))
    middle = top.position + a * top.normal
    lowest = float(((points - middle) @ normal).min()) if rough > 0 else 0.0
    lowest = min(lowest, 0.0)
    return replace(
        box,
        rotation=R @ box.rotation,
        centre=middle + lowest * normal + R @ (box.centre - top.position),
        roughness=max(rough - lowest, CAUTION, box.roughness),
    )


def believed_scene(scene: Scene, measured: Iterable[tuple[str, np.ndarray]]) -> Scene:
    """The scene with its boxes fitted to the contacts measured on them.

    Args:
        scene: As it was planned for.
        measured: Support and (3,) point of each contact.
    """
    points: dict[str, list[np.ndarray]] = {}
    for support, p in measured:
        points.setdefault(support, []).append(p)
    return replace(
        scene,
        boxes=tuple(
            fitted_box(b, np.array(points[b.name])) if b.name in points else b
            for b in scene.boxes
        ),
    )
