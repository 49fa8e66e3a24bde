"""What every tracker returns, and when it counts as lost."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from splatam_core.config import TrackingConfig
from splatam_core.losses import TrackingLoss, tracking_loss
from splatam_core.rasterizer import Gaussians, Render
from splatam_core.view import View

Matrix = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class TrackingResult:
    """A pose and the evidence for it.

    Attributes:
        T_cam_world: [4, 4] float64, when colour was taken.
        T_cam_world_depth: [4, 4] float64, when depth was taken; the same for trackers that take the two to be one.
        sure_fraction: share of the pixels with depth that see sure map.
        inlier_fraction: share of those that agree with the map in depth and colour.
        failure: why the pose must not be used; empty where it may be.
    """

    T_cam_world: Matrix
    T_cam_world_depth: Matrix
    sure_fraction: float
    inlier_fraction: float
    failure: str


class Tracker(Protocol):
    """A way to find the camera."""

    def track(
        self, view: View, gaussians: Gaussians, T_cam_world: Matrix, T_cam_world_before: Matrix | None = None
    ) -> TrackingResult:
        """Find the pose from which the map looks like the view; changes nothing.

        Args:
            view: what the camera sees.
            gaussians: the map.
            T_cam_world: [4, 4] first guess.
            T_cam_world_before: [4, 4] where the camera was a frame ago, if that is known.
        """
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A pose a tracker considers.

    The loss alone cannot say which pose is best: one that sees less of the map sums over fewer pixels. So a pixel with
    a reading that sees no sure map is taken to be as wrong as the average pixel was at the first guess.

    Attributes:
        T_cam_world: [4, 4] float64.
        render: the map from there, without gradients.
        cost: the lower, the better it explains the view.
        mean_error: average loss of the pixels that counted, at the first guess.
    """

    T_cam_world: NDArray[np.float64]
    render: Render
    cost: float
    mean_error: float

    @classmethod
    def of(
        cls, T_cam_world: NDArray[np.float64], render: Render, view: View, config: TrackingConfig,
        guess: Candidate | None, loss: TrackingLoss | None = None,
    ) -> Candidate:  # fmt: skip
        """Weigh a pose against the first guess, or the first guess itself where there is none yet."""
        if loss is None:
            loss = tracking_loss(render, view, config)
        total, readings = loss.total.item(), int(view.valid.sum())
        mean_error = guess.mean_error if guess else total / max(1, loss.num_pixels)
        return cls(T_cam_world, render, total + mean_error * (readings - loss.num_pixels), mean_error)


def judge(T_cam_world: NDArray[np.float64], render: Render, view: View, config: TrackingConfig) -> TrackingResult:
    """Hold the map, rendered at a pose, against the view: is this where the camera is?"""
    readings = int(view.valid.sum())
    sure = view.valid & (render.silhouette > config.silhouette_threshold)
    depth_agrees = (render.depth() - view.depth).abs() <= config.inlier_depth * view.depth
    color_agrees = (render.rgb - view.rgb).abs().mean(dim=0) <= config.inlier_color
    num_sure = int(sure.sum())
    sure_fraction = num_sure / max(1, readings)
    inlier_fraction = int((sure & depth_agrees & color_agrees).sum()) / max(1, num_sure)
    reason = failure(T_cam_world, readings, sure_fraction, inlier_fraction, config)
    return TrackingResult(T_cam_world, T_cam_world, sure_fraction, inlier_fraction, reason)


def failure(
    T_cam_world: NDArray[np.float64], readings: int, sure_fraction: float, inlier_fraction: float, config: TrackingConfig
) -> str:
    """Why a pose must not be used; empty where it may be."""
    if not np.isfinite(T_cam_world).all():
        return 'tracking diverged: the pose is not finite'
    if readings == 0:
        return 'no pixel has a usable depth reading'
    if sure_fraction < config.min_sure_fraction:
        return f'only {sure_fraction:.0%} of the view is mapped (at least {config.min_sure_fraction:.0%} needed)'
    if inlier_fraction < config.min_inlier_fraction:
        return f'only {inlier_fraction:.0%} of it agrees with the map (at least {config.min_inlier_fraction:.0%} needed)'
    return ''
