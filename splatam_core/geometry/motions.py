"""Many rigid motions at once: ``se3`` along leading dimensions, with the derivatives that optimisation needs.

Twists are [..., 6]: translation (m), rotation (rad). A motion T is perturbed on its right, ``T exp(twist)``.
"""

from __future__ import annotations

import numpy as np

from splatam_core.geometry import se3
from splatam_core.geometry.se3 import Matrix, Vector

_SMALL = 1e-4  # rad: series below
_BERNOULLI = 1 / 12, -1 / 720, 1 / 30240


def skew(v: Vector) -> Matrix:
    """Returns [..., 3, 3] with ``skew(v) @ w == cross(v, w)`` of vectors [..., 3]."""
    result = np.zeros((*v.shape, 3))
    result[..., 0, 1], result[..., 0, 2], result[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    return result - np.swapaxes(result, -1, -2)


def exp(twists: Vector) -> Matrix:
    """Returns the motions [..., 4, 4] of twists [..., 6]."""
    rho, phi = twists[..., :3], twists[..., 3:]
    angle = np.linalg.norm(phi, axis=-1)[..., None, None]
    safe = np.maximum(angle, _SMALL)
    a = np.where(angle < _SMALL, 1 - angle**2 / 6, np.sin(safe) / safe)
    b = np.where(angle < _SMALL, 0.5 - angle**2 / 24, (1 - np.cos(safe)) / safe**2)
    c = np.where(angle < _SMALL, 1 / 6 - angle**2 / 120, (safe - np.sin(safe)) / safe**3)
    S = skew(phi)
    S_squared = S @ S
    T = np.zeros((*twists.shape[:-1], 4, 4))
    T[..., :3, :3] = np.eye(3) + a * S + b * S_squared
    T[..., :3, 3] = ((np.eye(3) + b * S + c * S_squared) @ rho[..., None])[..., 0]
    T[..., 3, 3] = 1
    return T


def log(T: Matrix) -> Vector:
    """Returns the twists [..., 6] of motions [..., 4, 4]; rotations are less than pi minus a hundredth, or slow."""
    R = T[..., :3, :3]
    axis = 0.5 * np.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], axis=-1)
    sine = np.linalg.norm(axis, axis=-1)
    angle = np.arctan2(sine, 0.5 * (np.trace(R, axis1=-2, axis2=-1) - 1))
    phi = axis * np.where(sine < _SMALL, 1 + sine**2 / 6, angle / np.maximum(sine, _SMALL))[..., None]
    for place in np.argwhere(angle > np.pi - 0.01):  # the axis above loses its digits
        phi[tuple(place)] = se3.rotation_vector(R[tuple(place)])
    angle = np.linalg.norm(phi, axis=-1)
    half = np.maximum(angle, _SMALL) / 2
    c = np.where(angle < _SMALL, 1 / 12 + angle**2 / 720, (1 - half / np.tan(half)) / (4 * half**2))[..., None, None]
    S = skew(phi)
    rho = (np.eye(3) - 0.5 * S + c * (S @ S)) @ T[..., :3, 3:]
    return np.concatenate([rho[..., 0], phi], axis=-1)


def adjoint(T: Matrix) -> Matrix:
    """Returns [..., 6, 6] with ``T exp(x) == exp(adjoint(T) x) T``."""
    result = np.zeros((*T.shape[:-2], 6, 6))
    R = T[..., :3, :3]
    result[..., :3, :3] = result[..., 3:, 3:] = R
    result[..., :3, 3:] = skew(T[..., :3, 3]) @ R
    return result


def inverse_right_jacobian(twists: Vector) -> Matrix:
    """Returns [..., 6, 6] J with ``log(exp(x) exp(d)) == x + J d`` for small d.

    The series of Bernoulli numbers, right to a millionth up to rotations of one radian.
    """
    ad = np.zeros((*twists.shape[:-1], 6, 6))
    ad[..., :3, :3] = ad[..., 3:, 3:] = skew(twists[..., 3:])
    ad[..., :3, 3:] = skew(twists[..., :3])
    result = np.eye(6) + 0.5 * ad
    squared = ad @ ad
    power = squared
    for coefficient in _BERNOULLI:
        result = result + coefficient * power
        power = power @ squared
    return result


def between(T_a: Matrix, T_b: Matrix) -> Matrix:
    """Returns the motions [..., 4, 4] ``T_a^-1 T_b``."""
    return se3.inverse(T_a) @ T_b
