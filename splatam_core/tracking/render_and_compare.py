"""The paper's tracker (section 3.2): Adam on the pose, through the renderer, where the map is opaque."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor

from splatam_core.config import TrackingConfig
from splatam_core.geometry import se3
from splatam_core.geometry.se3 import Matrix
from splatam_core.images.filters import is_on_host
from splatam_core.images.view import View
from splatam_core.interruption import Stop, check, never
from splatam_core.rasterizer import Gaussians, Rasterizer
from splatam_core.tracking.base import TrackingResult
from splatam_core.tracking.candidate import Candidate
from splatam_core.tracking.loss import TrackingLoss, tracking_loss
from splatam_core.tracking.motion import SeenMotion
from splatam_core.tracking.pace import Pace
from splatam_core.tracking.time_offset import TimeOffset
from splatam_core.tracking.verdict import compare


class RenderAndCompareTracker:
    """Returns the best of all poses that it evaluates, the predicted one included."""

    def __init__(
        self, rasterizer: Rasterizer, config: TrackingConfig, threads: int, device: torch.device, stop: Stop = never
    ) -> None:
        self._rasterizer = rasterizer
        self._config = config
        self._stop = stop

    def track(
        self,
        view: View,
        gaussians: Gaussians,
        T_cam_world: Matrix,
        T_cam_world_before: Matrix | None = None,
        time_offset: TimeOffset | None = None,
        pace: Pace | None = None,
    ) -> TrackingResult:
        """See ``Tracker.track``."""
        config, gaussians = self._config, gaussians.detached()
        quaternion, device = se3.quaternion_from_rotation(T_cam_world[:3, :3]), gaussians.means.device
        rotation = torch.tensor(quaternion, dtype=torch.float32).to(device)
        translation = torch.tensor(T_cam_world[:3, 3], dtype=torch.float32).to(device)
        optimizer = torch.optim.Adam(
            [
                {'params': [rotation.requires_grad_()], 'lr': config.paper.rotation_rate},
                {'params': [translation.requires_grad_()], 'lr': config.paper.translation_rate},
            ],
            fused=not is_on_host(rotation),
        )
        predicted: Candidate | None = None
        steps = config.iterations
        for step in itertools.count():
            check(self._stop)
            pose = _pose(rotation, translation)
            render = self._rasterizer.render(gaussians, view.camera, pose)
            loss = tracking_loss(render, view, config)
            candidate = Candidate.of(pose, render, view, predicted, loss)
            if predicted is None:
                predicted = best = candidate
            else:
                best = best.or_better(candidate)
            if step == config.iterations and self._is_poor(loss, view):
                steps = 2 * config.iterations
            if step == steps:
                break
            optimizer.zero_grad()
            loss.total.backward()
            optimizer.step()
        return compare(_float64(best.pose), best.render, view, config)

    def motion(self, view: View, before: View, T_now_before: Matrix) -> SeenMotion | None:
        """See ``Tracker.motion``: it is not asked for, because no pose has evidence."""
        return None

    def _is_poor(self, loss: TrackingLoss, view: View) -> bool:
        """Returns whether the depth error is large enough for more steps; the original compares the sum over the image."""
        limit_m = self._config.paper.extend_above_m
        return limit_m > 0 and loss.depth.item() > limit_m * view.depth.numel()


def _pose(quaternion: Tensor, translation: Tensor) -> Tensor:
    """Returns [4, 4] of a quaternion (w, x, y, z) of any length and a translation, differentiably."""
    w, x, y, z = (quaternion / quaternion.norm()).unbind()
    one, zero = torch.ones_like(w), torch.zeros_like(w)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), translation[0]],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x), translation[1]],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y), translation[2]],
        [zero, zero, zero, one],
    ]
    return torch.stack([entry for row in rows for entry in row]).view(4, 4)


def _float64(pose: Tensor) -> Matrix:
    """Returns the pose in double precision, with a rotation that is orthonormal to that precision."""
    T = pose.double().numpy(force=True)
    return se3.compose(se3.quaternion_from_rotation(T[:3, :3]), T[:3, 3])
