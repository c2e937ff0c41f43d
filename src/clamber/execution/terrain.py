"""Contacts that were measured -> what boxes and meshes are believed to be like.

Heights measured over a box's top are a plane plus the roughness of the surface,

    z_i = a + b x_i + c y_i + e_i,    a, b, c ~ normal priors,    e_i ~ N(0, s^2),

in the frame of the top as it was believed. The roughness `s` is that of `ROUGHNESS`
under which the heights are most probable (the evidence of the linear model, [Bishop06]
section 3.5): few contacts that contradict one another make a rough top, not a steep
one. The plane is then the maximum a posteriori, lowered until no contact lies below it:
the box that is planned with is inside the real one, rough by what may stick out of it.

Supports of a mesh are such planes each, `a` being the sum of how much higher the mesh
is as a whole and how much more one support is: where one was measured, the
others are believed higher as well.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from clamber.model.scene import EVEN, Box, Mesh, Scene, Support
from clamber.model.se3 import matrix_from_quat

HEIGHT_SIGMA = 0.05  # [m] what is expected of a box's height
SLOPE_SIGMA = 0.12  # [rad] ... and of its slopes
CONTACT_SIGMA = 0.006  # [m] how well a contact's height is measured on a smooth top
CAUTION = 0.02  # [m] least distance more from a top that was measured
PART_SIGMA = 0.015  # [m] of a support's height, besides its mesh's
PART_SLOPE = 0.05  # [rad] ... and of its slopes: what is scanned is known well
ROUGHNESS = (0.0, 0.010, 0.020, 0.035)  # [m] that a top may have


def fitted_box(box: Box, points: np.ndarray) -> Box:
    """The box with its top, and the top's roughness, as contacts were measured.

    Args:
        box: As it was believed.
        points: (n, 3) measured on its top, in the world, n >= 1.
    """
    top = box.top
    X, z = _measured(top, points)
    prior = np.array([HEIGHT_SIGMA, SLOPE_SIGMA, SLOPE_SIGMA])
    rough, (a, b, c) = _most_probable(X, z, prior)
    R, middle = _moved(top, a, b, c)
    normal = R @ top.normal
    lowest = float(((points - middle) @ normal).min()) if rough > 0 else 0.0
    lowest = min(lowest, 0.0)
    return replace(
        box,
        rotation=R @ box.rotation,
        centre=middle + lowest * normal + R @ (box.centre - top.position),
        roughness=max(rough - lowest, CAUTION, box.roughness),
    )


def fitted_mesh(mesh: Mesh, points: Mapping[str, np.ndarray]) -> Mesh:
    """The mesh with its supports, and its roughness, as contacts were measured.

    Args:
        mesh: As it was believed.
        points: (n, 3) measured on supports by name, in the world, n >= 1.
    """
    felt = [s for s in mesh.supports if s.name in points]
    n = sum(len(points[s.name]) for s in felt)
    X, z, row = np.zeros((n, 1 + 3 * len(felt))), np.zeros(n), 0
    for k, s in enumerate(felt):
        x, off = _measured(s, points[s.name])
        rows = slice(row, row + len(x))
        X[rows, 0], X[rows, 1 + 3 * k : 4 + 3 * k], z[rows] = s.normal[2], x, off
        row += len(x)
    prior = [HEIGHT_SIGMA, *[PART_SIGMA, PART_SLOPE, PART_SLOPE] * len(felt)]
    rough, w = _most_probable(X, z, np.array(prior))
    up = np.array([0.0, 0.0, w[0]])
    supports, moves, worst = {}, {}, 0.0
    for s, (a, b, c) in zip(felt, w[1:].reshape(-1, 3), strict=True):
        a += w[0] * s.normal[2]
        R, middle = _moved(s, a, b, c)
        off = (points[s.name] - middle) @ (R @ s.normal)
        lowest = min(float(off.min()), 0.0) if rough > 0 else 0.0
        worst, moves[s.name] = min(worst, lowest), (a + lowest, b, c)
        position = middle + lowest * (R @ s.normal)
        supports[s.name] = replace(s, position=position, rotation=R @ s.rotation)
    pieces = [p + up for p in mesh.pieces]
    for s, under in zip(mesh.supports, mesh.under, strict=True):
        if s.name in moves:
            pieces[under] = _with_top(mesh.pieces[under], pieces[under], s, moves)
    return replace(
        mesh,
        pieces=tuple(pieces),
        supports=tuple(
            supports.get(s.name) or replace(s, position=s.position + up)
            for s in mesh.supports
        ),
        roughness=max(rough - worst, CAUTION, mesh.roughness),
    )


def _with_top(
    before: np.ndarray,
    piece: np.ndarray,
    support: Support,
    moves: Mapping[str, tuple[float, float, float]],
) -> np.ndarray:
    """A piece (K, 3) whose corners on a support are on it as it was measured.

    Args:
        before: As it was believed.
        piece: As far as it has been moved.
        support: As it was believed.
        moves: Height [m] and slopes by which supports are moved.
    """
    local = (before - support.position) @ support.rotation
    on = np.abs(local[:, 2]) < EVEN
    a, b, c = moves[support.name]
    off = a + b * local[:, 0] + c * local[:, 1]
    moved = before + off[:, None] * support.normal
    return np.where(on[:, None], moved, piece)


def _measured(support: Support, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3) of 1, x and y, and (n,) heights of points over a support, in its frame."""
    local = (points - support.position) @ support.rotation
    return np.column_stack([np.ones(len(local)), local[:, :2]]), local[:, 2]


def _most_probable(
    X: np.ndarray, z: np.ndarray, sigma: np.ndarray
) -> tuple[float, np.ndarray]:
    """Roughness, and the maximum a posteriori of coefficients with priors `sigma`."""
    prior = np.diag(sigma) ** 2
    fits = []
    for rough in ROUGHNESS:
        C = X @ prior @ X.T + (CONTACT_SIGMA**2 + rough**2) * np.eye(len(z))
        w = np.linalg.solve(C, z)
        evidence = -0.5 * (z @ w + np.linalg.slogdet(C)[1])
        fits.append((evidence, rough, prior @ X.T @ w))
    _, rough, best = max(fits, key=lambda fit: fit[0])
    return rough, best


def _moved(top: Support, a: float, b: float, c: float) -> tuple[np.ndarray, np.ndarray]:
    """Turn (3, 3) and new middle (3,) of a support that is the plane a + b x + c y."""
    normal = top.rotation @ np.array([-b, -c, 1.0]) / np.sqrt(1.0 + b * b + c * c)
    # The turn that takes the old normal to the new one: 1 + cos, axis times sin.
    turn = np.array([1.0 + normal @ top.normal, *np.cross(top.normal, normal)])
    R = matrix_from_quat(turn / np.linalg.norm(turn))
    return R, top.position + a * top.normal


def believed_scene(scene: Scene, measured: Iterable[tuple[str, np.ndarray]]) -> Scene:
    """The scene with boxes and meshes fitted to the contacts measured on them.

    Args:
        scene: As it was planned for.
        measured: Support and (3,) point of each contact.
    """
    points: dict[str, list[np.ndarray]] = {}
    for support, p in measured:
        points.setdefault(support, []).append(p)
    touched = {name: np.array(p) for name, p in points.items()}
    return replace(
        scene,
        boxes=tuple(
            fitted_box(b, touched[b.name]) if b.name in touched else b
            for b in scene.boxes
        ),
        meshes=tuple(
            fitted_mesh(m, touched) if any(s.name in touched for s in m.supports) else m
            for m in scene.meshes
        ),
    )
