"""Projection of anisotropic Gaussians to ellipses (Zwicker et al., "EWA splatting", 2002)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from splatam_core.geometry.camera import PinholeCamera
from splatam_core.rasterizer.base import BLUR_PX2, HUGE, NEAR_M, Gaussians

MARGIN = 0.15
"""Fraction of the image's size around it, beyond which the Jacobian of the projection is held constant: it would diverge."""

MAX_LOG_SCALE = 10.0
"""Log metres. The covariance of a wider Gaussian overflows near the camera; this one fills the image already."""


@dataclass(frozen=True, slots=True, eq=False)
class Ellipses:
    """K projected Gaussians, front to back.

    Attributes:
        centers: [K, 2] u, v in pixels.
        conics: [K, 3] inverse covariance, xx xy yy, px^-2.
        opacities: [K].
        features: [K, 4] rgb and z.
    """

    centers: Tensor
    conics: Tensor
    opacities: Tensor
    features: Tensor


def project(gaussians: Gaussians, camera: PinholeCamera, T_cam_world: Tensor) -> Ellipses:
    """Projects anisotropic Gaussians, differentiable in them and in the pose, in any precision."""
    gaussians = gaussians.only_usable()
    assert gaussians.rotations is not None
    points = gaussians.means @ T_cam_world[:3, :3].T + T_cam_world[:3, 3]  # [N, 3]
    visible = (points.detach()[:, 2] > NEAR_M) & (points.detach().abs() <= HUGE).all(dim=1)
    drawn = torch.nonzero(visible)[:, 0]
    drawn = drawn[torch.sort(points[drawn, 2].detach(), stable=True).indices]  # [K] front to back
    points = points[drawn]
    x, y, z = points.unbind(-1)
    centers = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], dim=1)
    axes = (
        rotations(gaussians.rotations[drawn]) * gaussians.log_scales[drawn].clamp(max=MAX_LOG_SCALE).exp()[:, None, :]
    )  # [K, 3, 3] columns
    jacobian = _jacobian(points, camera) @ T_cam_world[:3, :3]  # [K, 2, 3] pixels per metre in the world
    on_image = (jacobian[:, :, :, None] * axes[:, None]).sum(dim=2)  # [K, 2, 3]; bmm is far slower on such small matrices
    xx, yy = ((on_image**2).sum(dim=2) + BLUR_PX2).unbind(1)
    xy = (on_image[:, 0] * on_image[:, 1]).sum(dim=1)
    conics = torch.stack([yy, -xy, xx], dim=1) / (xx * yy - xy**2)[:, None]
    features = torch.cat([gaussians.rgb[drawn], z[:, None]], dim=1)
    return Ellipses(centers, conics, torch.sigmoid(gaussians.logit_opacities[drawn]), features)


def _jacobian(points: Tensor, camera: PinholeCamera) -> Tensor:
    """Returns [K, 2, 3] derivatives of the pixel by camera coordinates, at points [K, 3]."""
    x, y, z = points.unbind(-1)
    x_z, y_z = _clamped(x / z, camera.width, camera.fx, camera.cx), _clamped(y / z, camera.height, camera.fy, camera.cy)
    zero = torch.zeros_like(z)
    u_row = torch.stack([camera.fx / z, zero, -camera.fx * x_z / z], dim=1)
    v_row = torch.stack([zero, camera.fy / z, -camera.fy * y_z / z], dim=1)
    return torch.stack([u_row, v_row], dim=1)


def _clamped(ratio: Tensor, size: int, focal: float, center: float) -> Tensor:
    margin = MARGIN * size
    return ratio.clamp((-margin - center) / focal, (size + margin - center) / focal)


def rotations(quaternions: Tensor) -> Tensor:
    """Returns [K, 3, 3] of quaternions [K, 4] (w, x, y, z) of any non-zero length."""
    w, x, y, z = (quaternions / quaternions.norm(dim=1, keepdim=True)).unbind(1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=1).view(-1, 3, 3)
