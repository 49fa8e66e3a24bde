"""The poses that the paper's tracker considers, and which of them is best."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from splatam_core.images.filters import is_on_host
from splatam_core.images.view import View
from splatam_core.rasterizer import Render
from splatam_core.tracking.loss import TrackingLoss


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A pose that the tracker considers. Everything is on the map's device, so that the host does not wait for a GPU.

    The loss alone cannot rank poses: a pose that sees less of the map sums over fewer pixels. So a pixel with a reading that
    does not see the map counts as much as the average pixel did at the predicted pose.

    Attributes:
        pose: [4, 4] T_cam_world, float32, detached.
        render: the map from there, detached.
        cost: [] float64; the lower, the better the pose.
        mean_error: [] float64, mean loss of the pixels compared at the predicted pose.
    """

    pose: Tensor
    render: Render
    cost: Tensor
    mean_error: Tensor

    @classmethod
    def of(cls, pose: Tensor, render: Render, view: View, predicted: Candidate | None, loss: TrackingLoss) -> Candidate:
        """Returns the candidate of a pose. predicted: the first candidate, None for that one itself."""
        total, readings = loss.total.detach().double(), view.valid.sum()
        mean_error = predicted.mean_error if predicted else total / loss.num_pixels.clamp(min=1)
        drawn = Render(render.rgb.detach(), render.depth_acc.detach(), render.silhouette.detach())
        return cls(pose.detach(), drawn, total + mean_error * (readings - loss.num_pixels), mean_error)

    def or_better(self, other: Candidate) -> Candidate:
        """Returns the candidate of lower cost; this one if both are equal."""
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
