"""The rasterizer contract: one differentiable pass gives colour, depth and silhouette.

A Gaussian at camera coordinates (x, y, z) with radius r and opacity o lands on pixel position
``u = fx x/z + cx``, ``v = fy y/z + cy`` with variance ``s^2 = (f r/z)^2 + 0.3`` px^2, ``f = (fx + fy)/2``, and
covers the pixel at distance d with ``alpha = min(0.99, o exp(-d^2 / 2 s^2))``, nothing below 1/255.
Gaussians are blended front to back by z; a pixel takes no more once its transmittance is below 1e-4.
Centres at z <= 0.2 m are not drawn. The background is black. Where alpha is clamped it has no gradient.

Anisotropic Gaussians, those with rotations, are ellipsoids of three radii s turned by R(q) in the world. They cover the image
with covariance ``S = J W R diag(s^2) R^T W^T J^T + 0.3 I`` px^2, W the rotation into the camera and J the slope of the
projection at the centre (its x/z and y/z held within the image and 15 % of its size around), and a pixel at offset d with
``alpha = min(0.99, o exp(-d^T S^-1 d / 2))``. All else is as above. With three equal radii this is not quite the isotropic
footprint: J stretches it by ``1 + tan^2`` of the angle off the axis along that direction (variance), and uses fx and fy each
for itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from splatam_core.errors import RasterizerError
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.rasterizer.bounds import BLOCK, block_bounds
from splatam_core.types import RenderedView

NEAR_M = 0.2
BLUR_PX2 = 0.3
MAX_ALPHA = 0.99
MIN_ALPHA = 1.0 / 255.0
MIN_TRANSMITTANCE = 1e-4
BETA_1, BETA_2, EPSILON = 0.9, 0.999, 1e-15
FIT_BETA_2 = 0.99
"""Of ``fit``, whose moments live long: a mean over fewer steps follows what the view shows (docs/decisions/0004)."""

COLOR_LIMIT, DEPTH_LIMIT_M = 0.1, 0.02
"""Of ``fit``: up to here a residual counts by its square (over twice the limit), beyond by its size (Huber)."""


@dataclass(frozen=True, slots=True, eq=False)
class Gaussians:
    """What a rasterizer draws.

    Attributes:
        means: [N, 3] metres, world.
        log_scales: [N, 1] log metres: isotropic; [N, 3] along the axes of ``rotations``: anisotropic.
        logit_opacities: [N].
        rgb: [N, 3], not clamped.
        bounds: [ceil(N / BLOCK), 7] of each run of BLOCK Gaussians the smallest mean, the largest mean and the largest log
            scale, so that a rasterizer may skip what is out of view; None where nobody has looked.
        rotations: [N, 4] quaternions (w, x, y, z) of any length but zero, axes to world; None of isotropic Gaussians.
    """

    means: Tensor
    log_scales: Tensor
    logit_opacities: Tensor
    rgb: Tensor
    bounds: Tensor | None = None
    rotations: Tensor | None = None

    def __len__(self) -> int:
        return len(self.means)

    def detached(self) -> Gaussians:
        """The same values, cut off from autograd."""
        return Gaussians(
            self.means.detach(), self.log_scales.detach(), self.logit_opacities.detach(), self.rgb.detach(), self.bounds,
            None if self.rotations is None else self.rotations.detach(),
        )  # fmt: skip

    def to(self, device: torch.device) -> Gaussians:
        """The same on a device; themselves where they are there already."""
        values = (self.means, self.log_scales, self.logit_opacities, self.rgb, self.bounds, self.rotations)
        return Gaussians(*(None if value is None else value.to(device) for value in values))

    def anisotropic(self) -> Gaussians:
        """The same as anisotropic Gaussians: three equal radii, not turned, where they are isotropic."""
        if self.rotations is not None:
            return self
        upright = self.means.new_zeros(len(self), 4)
        upright[:, 0] = 1.0
        return Gaussians(self.means, self.log_scales.repeat(1, 3), self.logit_opacities, self.rgb, self.bounds, upright)


def check_isotropic(gaussians: Gaussians) -> None:
    """Refuse anisotropic Gaussians.

    Raises:
        RasterizerError: they are.
    """
    if gaussians.rotations is not None:
        raise RasterizerError(
            'the Gaussians are anisotropic, and fused fitting and isotropic maps take none: set mapping.anisotropic=true '
            'and mapping.optimizer=autograd'
        )


def joined(first: Gaussians, second: Gaussians) -> Gaussians:
    """Both, the first's before the second's, with bounds where the first has them. Anisotropic where one of them is."""
    if first.rotations is not None or second.rotations is not None:
        first, second = first.anisotropic(), second.anisotropic()
    names = 'means', 'log_scales', 'logit_opacities', 'rgb', 'rotations'
    values = {name: torch.cat([getattr(first, name), getattr(second, name)]) for name in names if getattr(first, name) is not None}
    bounds = first.bounds
    if bounds is not None and len(second):
        full = len(first) // BLOCK
        begin = full * BLOCK
        bounds = torch.cat([bounds[:full], block_bounds(values['means'][begin:], values['log_scales'][begin:])])
    return Gaussians(**values, bounds=bounds)


@dataclass(frozen=True, slots=True, eq=False)
class Moments:
    """Of Adam, Gaussian by Gaussian: each has been stepped as often as it was seen.

    Attributes:
        first_second: [N, 16] running means of the gradients of mean, log scale, logit opacity and rgb; of their squares.
        steps: [N] uint8, counted to 255.
    """

    first_second: Tensor
    steps: Tensor


@dataclass(frozen=True, slots=True)
class Rates:
    """Adam's step sizes by parameter."""

    means: float
    log_scales: float
    logit_opacities: float
    rgb: float
    rotations: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """What the map should look like from a pose.

    Attributes:
        camera: the image's.
        rgb8: [H, W, 3] uint8.
        depth: [H, W] metres, 0 = no reading.
        T_cam_world: [4, 4] float32.
        color_weight: of the mean difference of colour (Huber), over pixels and channels.
        depth_weight: of that of depth_acc, over readings.
    """

    camera: PinholeCamera
    rgb8: Tensor
    depth: Tensor
    T_cam_world: Tensor
    color_weight: float
    depth_weight: float


@dataclass(frozen=True, slots=True, eq=False)
class Render:
    """One view of the map.

    Attributes:
        rgb: [3, H, W].
        depth_acc: [H, W] metres, sum of w z: short of the surface where the silhouette is below 1.
        silhouette: [H, W] in [0, 1), sum of w.
    """

    rgb: Tensor
    depth_acc: Tensor
    silhouette: Tensor

    def depth(self, min_silhouette: float = 0.5) -> Tensor:
        """[H, W] expected depth in metres; 0 where the silhouette is below the limit."""
        seen = self.silhouette >= min_silhouette
        return torch.where(seen, self.depth_acc / torch.where(seen, self.silhouette, 1.0), 0.0)

    def images(self) -> RenderedView:
        """The same for people and for metrics: 8-bit colour, expected depth, silhouette."""
        rgb = self.rgb.clamp(0, 1).mul(255).round().byte().permute(1, 2, 0).contiguous()
        return RenderedView(*(image.numpy(force=True) for image in (rgb, self.depth(), self.silhouette)))


class Rasterizer(Protocol):
    """A backend."""

    def render(self, gaussians: Gaussians, camera: PinholeCamera, T_cam_world: Tensor) -> Render:
        """Draw the Gaussians, differentiably in them and in the pose.

        Args:
            gaussians: what to draw.
            camera: the image to draw.
            T_cam_world: [4, 4] world to camera; its upper three rows receive gradients entry by entry.
        """
        ...

    def fit(self, gaussians: Gaussians, moments: Moments, rates: Rates, target: Target) -> float | Tensor:
        """Take one Adam step towards a target, in place; Gaussians that get no gradient stay as they are.

        Returns:
            The loss before the step; of a backend on a device a scalar there, so that only who reads it waits.
        """
        ...
