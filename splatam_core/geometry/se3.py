"""Rigid motions as [4, 4] float64 matrices, and quaternions as [w, x, y, z]."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]
Vector = NDArray[np.float64]


def inverse(T: Matrix) -> Matrix:
    """Returns the inverse motion [..., 4, 4]; its rotation is as orthonormal as that of T."""
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
    rho, phi = np.asarray(twist[:3], dtype=np.float64), np.asarray(twist[3:], dtype=np.float64)
    angle = float(np.linalg.norm(phi))
    S = skew(phi)
    if angle < 1e-5:  # series, because the closed forms lose all digits here
        a, b, c = 1.0 - angle**2 / 6, 0.5 - angle**2 / 24, 1 / 6 - angle**2 / 120
    else:
        a = np.sin(angle) / angle
        b = (1 - np.cos(angle)) / angle**2
        c = (angle - np.sin(angle)) / angle**3
    T = np.eye(4)
    T[:3, :3] = np.eye(3) + a * S + b * S @ S
    T[:3, 3] = (np.eye(3) + b * S + c * S @ S) @ rho
    return T


def log(T: Matrix) -> Vector:
    """Returns the twist [6], translation and rotation, whose ``exp`` is T; the rotation angle is in [0, pi]."""
    phi = rotation_vector(T[:3, :3])
    angle = float(np.linalg.norm(phi))
    S = skew(phi)
    if angle < 1e-5:
        c = 1 / 12 + angle**2 / 720
    else:
        half = angle / 2
        c = (1 - half / np.tan(half)) / angle**2
    V_inverse = np.eye(3) - 0.5 * S + c * S @ S
    return np.concatenate([V_inverse @ T[:3, 3], phi])


def rotation_vector(R: Matrix) -> Vector:
    """Returns [3] axis times angle (radians) of a rotation matrix."""
    q = quaternion_from_rotation(R)
    sine = float(np.linalg.norm(q[1:]))
    if sine < 1e-12:
        return 2.0 * q[1:]
    return q[1:] * (2.0 * np.arctan2(sine, q[0]) / sine)


def quaternion_from_rotation(R: Matrix) -> Vector:
    """Returns [w, x, y, z] with w >= 0 of a rotation matrix (Shepperd 1978: the largest pivot)."""
    trace = float(np.trace(R))
    candidates = np.array([trace, R[0, 0], R[1, 1], R[2, 2]])
    k = int(np.argmax(candidates))
    q = np.empty(4)
    if k == 0:
        q[:] = 1 + trace, R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    else:
        i = k - 1
        j, m = (i + 1) % 3, (i + 2) % 3
        q[0] = R[m, j] - R[j, m]
        q[1 + i] = 1 + R[i, i] - R[j, j] - R[m, m]
        q[1 + j] = R[j, i] + R[i, j]
        q[1 + m] = R[m, i] + R[i, m]
    q /= np.linalg.norm(q)
    return -q if q[0] < 0 else q


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
