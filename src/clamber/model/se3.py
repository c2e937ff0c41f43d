"""Rotations and poses, batched: quaternions are wxyz, matrices are (..., 3, 3)."""

from __future__ import annotations

import math

import mujoco
import numpy as np
from numpy.typing import ArrayLike


def matrix_from_rpy(rpy: ArrayLike) -> np.ndarray:
    """Rotation matrix Rz(yaw) Ry(pitch) Rx(roll) of fixed-axis angles [rad]."""
    r, p, y = np.asarray(rpy, dtype=float)
    cr, sr, cp, sp, cy, sy = (
        np.cos(r),
        np.sin(r),
        np.cos(p),
        np.sin(p),
        np.cos(y),
        np.sin(y),
    )
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def matrix_from_quat(quat: ArrayLike) -> np.ndarray:
    """Rotation matrices (..., 3, 3) of unit quaternions (..., 4)."""
    quat = np.asarray(quat, dtype=float)
    if quat.ndim == 1:
        out = np.empty(9)
        mujoco.mju_quat2Mat(out, quat)
        return out.reshape(3, 3)
    w, x, y, z = np.moveaxis(quat, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(r, axis=-1) for r in rows], axis=-2)


def quat_from_matrix(R: ArrayLike) -> np.ndarray:
    """Unit quaternion (4,), w >= 0, of a rotation matrix (3, 3)."""
    q = np.empty(4)
    mujoco.mju_mat2Quat(q, np.ascontiguousarray(R, dtype=float).reshape(9))
    return q if q[0] >= 0 else -q


def quat_multiply(a: ArrayLike, b: ArrayLike) -> np.ndarray:
    """Hamilton product (..., 4)."""
    aw, ax, ay, az = np.moveaxis(np.asarray(a, dtype=float), -1, 0)
    bw, bx, by, bz = np.moveaxis(np.asarray(b, dtype=float), -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def quat_conjugate(q: ArrayLike) -> np.ndarray:
    """Inverse of unit quaternions (..., 4)."""
    return np.asarray(q, dtype=float) * np.array([1.0, -1.0, -1.0, -1.0])


def quat_from_yaw(yaw: float) -> np.ndarray:
    """Quaternion (4,) of a turn about z [rad]."""
    return np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])


def yaw_of(quat: ArrayLike) -> float:
    """Yaw of a unit quaternion (4,): where its x axis points, seen from above [rad]."""
    w, x, y, z = np.asarray(quat, dtype=float)
    return float(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


def rpy_from_matrix(R: np.ndarray) -> np.ndarray:
    """Fixed-axis angles (3,) of R (3, 3): `matrix_from_rpy` gives it back [rad].

    Looking straight up or down, the yaw is zero: it turns about the axis of the roll.
    """
    pitch = math.atan2(-R[2, 0], math.hypot(R[0, 0], R[1, 0]))
    if math.hypot(R[0, 0], R[1, 0]) < 1e-9:
        return np.array([math.atan2(-R[1, 2], R[1, 1]), pitch, 0.0])
    roll, yaw = math.atan2(R[2, 1], R[2, 2]), math.atan2(R[1, 0], R[0, 0])
    return np.array([roll, pitch, yaw]) + 0.0  # no negative zeros


def wrap(angles: ArrayLike) -> np.ndarray:
    """Angles in [-pi, pi) [rad]."""
    return (np.asarray(angles, dtype=float) + np.pi) % (2.0 * np.pi) - np.pi


def turn_about_z(yaw: float) -> np.ndarray:
    """Rotation (2, 2) of the plane by a yaw [rad]."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s], [s, c]])


def upward(quat: np.ndarray) -> np.ndarray:
    """(3,) the turned z axis of a unit quaternion (4,)."""
    w, x, y, z = quat
    return np.array([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])


def rotation_vector(R: np.ndarray) -> np.ndarray:
    """Rotation vector (3,) of a rotation matrix (3, 3) [rad]."""
    quat, out = np.empty(4), np.empty(3)
    mujoco.mju_mat2Quat(quat, R.ravel())
    mujoco.mju_quat2Vel(out, quat, 1.0)
    return out


def frame_from_normal(normal: ArrayLike, heading: ArrayLike) -> np.ndarray:
    """Rotation (3, 3) with z along `normal` and x along `heading` as far as it can.

    Where the heading is parallel to the normal, x is any direction in the plane.
    """
    # In plain floats: numpy takes several times as long for three numbers.
    zx, zy, zz = np.asarray(normal, dtype=float).tolist()
    along_axes = [abs(zx), abs(zy), abs(zz)]
    axis = [0.0, 0.0, 0.0]
    axis[along_axes.index(min(along_axes))] = 1.0
    x = y = z = n = 0.0
    for hx, hy, hz in (np.asarray(heading, dtype=float).tolist(), axis):
        along = hx * zx + hy * zy + hz * zz
        x, y, z = hx - along * zx, hy - along * zy, hz - along * zz
        n = math.sqrt(x * x + y * y + z * z)
        if n >= 1e-9:
            break
    x, y, z = x / n, y / n, z / n
    return np.array(
        [
            [x, zy * z - zz * y, zx],
            [y, zz * x - zx * z, zy],
            [z, zx * y - zy * x, zz],
        ]
    )
