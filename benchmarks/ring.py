"""A synthetic ring: the camera drives once around and comes back to where it began, where it sees the same wall again.

The images are rendered as those of growth.py, but the wall is a cylinder around the axis of the ring.
"""

from __future__ import annotations

import numpy as np
from growth import FACING, RELIEF_M, STEP_M, noisy, rays_of, texture
from numpy.typing import NDArray

from splatam_core.geometry import se3
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.types import RgbdFrame

WALL_M = 1.6  # from the way of the camera
HEIGHTS_M = 1.1, -1.1  # floor and ceiling; y points down


def radius_m(once_around: int) -> float:
    """Returns the radius of the way, from the number of frames that it takes."""
    return once_around * STEP_M / (2 * np.pi)


def pose(index: int, once_around: int) -> NDArray[np.float64]:
    """Returns the [4, 4] camera-to-world pose. The axis of the ring is the y axis; the camera sways."""
    angle, radius = 2 * np.pi * index / once_around, radius_m(once_around)
    T = se3.exp(np.array([0, 0, 0, 0, -angle, 0]))
    T[:3, 3] = (radius + 0.05 * np.sin(index / 17)) * np.array([np.cos(angle), 0, np.sin(angle)])
    T[1, 3] = 0.05 * np.sin(index / 11)
    return T @ se3.exp(np.array([0, 0, 0, 0.04 * np.sin(index / 13), FACING + 0.06 * np.sin(index / 23), 0.03 * np.sin(index / 9)]))


def frame_at(T: NDArray[np.float64], stamp_ns: int, once_around: int, cam: PinholeCamera, rng: np.random.Generator) -> RgbdFrame:
    """Renders the view of a camera at a pose [4, 4]."""
    rays, centre, outer = rays_of(T, cam), T[:3, 3], radius_m(once_around) + WALL_M
    depth, colour = np.full(rays.shape[:2], np.inf), np.zeros(rays.shape)
    for height in (None, *HEIGHTS_M):
        relief = np.zeros(rays.shape[:2])
        for _ in range(3):  # found by fixed-point steps
            z = (
                to_wall(rays, centre, outer - relief)
                if height is None
                else to_level(rays, centre, height - np.sign(height) * relief)
            )
            points = centre + np.where(np.isfinite(z), z, 1.0)[..., None] * rays
            along, across = np.arctan2(points[..., 2], points[..., 0]) * outer, points[..., 1]
            if height is not None:
                across = np.hypot(points[..., 0], points[..., 2])
            relief = RELIEF_M * np.sin(3.0 * along) * np.sin(4.0 * across)
        nearer = (z > 0) & (z < depth)
        offset = 1.6 if height is None else 3.0 + height
        colour[nearer] = texture(along, across + offset)[nearer]
        depth[nearer] = z[nearer]
    return noisy(stamp_ns, colour, depth, cam, rng)


def to_wall(rays: NDArray[np.float64], centre: NDArray[np.float64], radius: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns [H, W] the depths at which rays from inside meet a cylinder of radii [H, W]."""
    x, z = rays[..., 0], rays[..., 2]
    a = np.maximum(x**2 + z**2, 1e-9)
    b = x * centre[0] + z * centre[2]
    c = centre[0] ** 2 + centre[2] ** 2 - radius**2
    return (-b + np.sqrt(np.maximum(b**2 - a * c, 0))) / a


def to_level(rays: NDArray[np.float64], centre: NDArray[np.float64], height: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns [H, W] the depths at which rays meet a level at heights [H, W]; infinity where they never do."""
    with np.errstate(divide='ignore', invalid='ignore'):
        z = (height - centre[1]) / rays[..., 1]
    return np.where(z > 0, z, np.inf)
