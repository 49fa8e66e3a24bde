"""Rigid motions as [4, 4] float64 matrices, and quaternions as [w, x, y, z]."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]
Vector = NDArray[np.float64]


def inverse(T: Matrix) -> Matrix:
    """Returns the inverse motion [..., 4, 4]; its rotation is as orthonormal as that of T."""
    if T.ndim == 2:  # single numbers: see ``exp``
        (a, b, c, x), (d, e, f, y), (g, h, i, z), _ = T.tolist()
        rows = [a, d, g, -(a * x + d * y + g * z)], [b, e, h, -(b * x + e * y + h * z)], [c, f, i, -(c * x + f * y + i * z)]
        return np.array([*rows, [0.0, 0.0, 0.0, 1.0]])
    R_t = np.swapaxes(T[..., :3, :3], -1, -2)
    result = np.zeros_like(T)
    result[..., :3, :3] = R_t
    result[..., :3, 3] = -np.einsum('...ij,...j->...i', R_t, T[..., :3, 3])
    result[..., 3, 3] = 1.0
    return result


def skew(v: Vector) -> Matrix:
    """Returns [3, 3] with ``skew(v) @ w == cross(v, w)``."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def exp(twist: Vector) -> Matrix:
    """Returns the motion [4, 4] of a twist [6]: translation (metres), rotation (radians)."""
    *rho, x, y, z = (float(value) for value in twist)  # single numbers: arrays as short as this take ten times as long
    squared = x * x + y * y + z * z
    angle = math.sqrt(squared)
    if angle < 1e-5:  # series, because the closed forms lose all digits here
        a, b, c = 1.0 - squared / 6, 0.5 - squared / 24, 1 / 6 - squared / 120
    else:
        a, b, c = math.sin(angle) / angle, (1 - math.cos(angle)) / squared, (angle - math.sin(angle)) / (squared * angle)
    turned = _cross((x, y, z), rho)
    twice = _cross((x, y, z), turned)
    t = [rho[i] + b * turned[i] + c * twice[i] for i in range(3)]
    return np.array(
        [
            [1 + b * (x * x - squared), b * x * y - a * z, b * x * z + a * y, t[0]],
            [b * x * y + a * z, 1 + b * (y * y - squared), b * y * z - a * x, t[1]],
            [b * x * z - a * y, b * y * z + a * x, 1 + b * (z * z - squared), t[2]],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def log(T: Matrix) -> Vector:
    """Returns the twist [6], translation and rotation, whose ``exp`` is T; the rotation angle is in [0, pi]."""
    phi, t = rotation_vector(T[:3, :3]).tolist(), T[:3, 3].tolist()
    angle = math.hypot(*phi)
    if angle < 1e-5:
        c = 1 / 12 + angle**2 / 720
    else:
        half = angle / 2
        c = (1 - half / math.tan(half)) / angle**2
    turned = _cross(phi, t)
    twice = _cross(phi, turned)
    return np.array([*(t[i] - 0.5 * turned[i] + c * twice[i] for i in range(3)), *phi])


def _cross(a: Sequence[float], b: Sequence[float]) -> list[float]:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def rotation_vector(R: Matrix) -> Vector:
    """Returns [3] axis times angle (radians) of a rotation matrix."""
    w, *axis = quaternion_from_rotation(R).tolist()
    sine = math.hypot(*axis)
    factor = 2.0 if sine < 1e-12 else 2.0 * math.atan2(sine, w) / sine
    return np.array([factor * value for value in axis])


def quaternion_from_rotation(R: Matrix) -> Vector:
    """Returns [w, x, y, z] with w >= 0 of a rotation matrix (Shepperd 1978: the largest pivot)."""
    r = R.tolist()
    pivots = [r[0][0] + r[1][1] + r[2][2], r[0][0], r[1][1], r[2][2]]
    k = pivots.index(max(pivots))
    if k == 0:
        q = [1 + pivots[0], r[2][1] - r[1][2], r[0][2] - r[2][0], r[1][0] - r[0][1]]
    else:
        i, j, m = k - 1, k % 3, (k + 1) % 3
        q = [r[m][j] - r[j][m], 0.0, 0.0, 0.0]
        q[1 + i] = 1 + r[i][i] - r[j][j] - r[m][m]
        q[1 + j] = r[j][i] + r[i][j]
        q[1 + m] = r[m][i] + r[i][m]
    length = math.copysign(math.hypot(*q), q[0])
    return np.array(q) / length


def rotation_from_quaternion(q: Vector) -> Matrix:
    """Returns [..., 3, 3] of quaternions [..., 4] (w, x, y, z) of any non-zero length."""
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    return np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        -2,
    )


def compose(q: Vector, t: Vector) -> Matrix:
    """Returns [..., 4, 4] of quaternions [..., 4] (w, x, y, z) and translations [..., 3]."""
    T = np.zeros((*np.shape(t)[:-1], 4, 4))
    T[..., :3, :3] = rotation_from_quaternion(np.asarray(q, dtype=np.float64))
    T[..., :3, 3] = t
    T[..., 3, 3] = 1.0
    return T


def interpolate(T_a: Matrix, T_b: Matrix, fraction: float) -> Matrix:
    """Returns the pose a fraction of the way along the screw from a to b; outside [0, 1] it extrapolates."""
    return T_a @ exp(fraction * log(inverse(T_a) @ T_b))
