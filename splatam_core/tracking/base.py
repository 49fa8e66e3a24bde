"""What every tracker does and returns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatam_core.images.filters import is_on_host
from splatam_core.images.view import View
from splatam_core.rasterizer import Gaussians, Render
from splatam_core.tracking.loss import TrackingLoss

Matrix = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class TrackingResult:
    """A pose and the evidence for it.

    Attributes:
        T_cam_world: [4, 4] float64, when colour was taken.
        T_cam_world_depth: [4, 4] float64, when depth was taken; the same for trackers that take the two to be one.
        num_readings: pixels with a depth reading; None for a tracker that looks at none.
        visible_fraction: fraction of the pixels with a depth reading that see the map at the pose.
        inlier_fraction: fraction of those that agree with the map in depth and colour.
    """

    T_cam_world: Matrix
    T_cam_world_depth: Matrix
    num_readings: int | None
    visible_fraction: float
    inlier_fraction: float


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
    """A pose a tracker considers; all of it is where the map is, so that a GPU need not be waited for.

    The loss alone cannot say which pose is best: one that sees less of the map sums over fewer pixels. So a pixel with
    a reading that sees no sure map is taken to be as wrong as the average pixel was at the first guess.

    Attributes:
        pose: [4, 4] T_cam_world, float32, without gradients.
        render: the map from there, without gradients.
        cost: [] float64; the lower, the better it explains the view.
        mean_error: [] float64, average loss of the pixels that counted, at the first guess.
    """

    pose: Tensor
    render: Render
    cost: Tensor
    mean_error: Tensor

    @classmethod
    def of(cls, pose: Tensor, render: Render, view: View, guess: Candidate | None, loss: TrackingLoss) -> Candidate:
        """Weigh a pose against the first guess, or the first guess itself where there is none yet."""
        total, readings = loss.total.detach().double(), view.valid.sum()
        mean_error = guess.mean_error if guess else total / loss.num_pixels.clamp(min=1)
        drawn = Render(render.rgb.detach(), render.depth_acc.detach(), render.silhouette.detach())
        return cls(pose.detach(), drawn, total + mean_error * (readings - loss.num_pixels), mean_error)

    def or_better(self, other: Candidate) -> Candidate:
        """The one of lower cost, this one where they are equal."""
        better = other.cost < self.cost
        if is_on_host(better):
            return other if better else self
        a, b = self.render, other.render
        render = Render(
            torch.where(better, b.rgb, a.rgb), torch.where(better, b.depth_acc, a.depth_acc),
            torch.where(better, b.silhouette, a.silhouette),
        )  # fmt: skip
        pose, cost = torch.where(better, other.pose, self.pose), torch.where(better, other.cost, self.cost)
        return Candidate(pose, render, cost, self.mean_error)
