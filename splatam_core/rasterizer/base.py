"""The rasterizer contract: one differentiable pass gives colour, depth and silhouette.

A Gaussian at camera coordinates (x, y, z) with radius r and opacity o lands on pixel position
``u = fx x/z + cx``, ``v = fy y/z + cy`` with variance ``s^2 = (f r/z)^2 + 0.3`` px^2, ``f = (fx + fy)/2``, and
covers the pixel at distance d with ``alpha = min(0.99, o exp(-d^2 / 2 s^2))``, nothing below 1/255.
Gaussians are blended front to back by z, until the transmittance of the pixel is below 1e-4.
Centres at z <= 0.2 m are not drawn. The background is black. Where alpha is clamped its gradient is zero.

Anisotropic Gaussians have rotations: they are ellipsoids with three radii s, rotated by R(q) in the world. They cover the image
with covariance ``S = J W R diag(s^2) R^T W^T J^T + 0.3 I`` px^2. W is the rotation into the camera, and J the Jacobian of the
projection at the centre, with x/z and y/z clamped to the image and a margin of 15 % of its size. A pixel at offset d is
covered with ``alpha = min(0.99, o exp(-d^T S^-1 d / 2))``. Log scales above 10 count as 10 (above 40 in isotropic Gaussians).
Everything else is as above. With three equal radii this differs slightly from the isotropic footprint: J stretches the variance
by ``1 + tan^2`` of the angle off the axis, along that direction, and uses fx and fy separately.

A Gaussian with a value that is not finite, or beyond 1e30, is not drawn and does not change (``Gaussians.usable``).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
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
FIT_BETA_2 = 0.9
"""Of ``fit``, whose moments are kept from frame to frame: a shorter mean follows changes of the view (docs/decisions/0004)."""

COLOR_LIMIT, DEPTH_LIMIT_M = 0.1, 0.02
"""Of ``fit``: limits of Huber's loss, quadratic below and linear above."""

FIT_TILE = 8
"""Of ``fit``: side in pixels of the squares that are fitted or left as they are."""

NOT_COMPARED = -1.0
"""Depth in a ``Target`` of pixels of which neither colour nor depth is compared."""

HUGE = 1e30
"""No value of a Gaussian is larger: its square would overflow, and so would the colour in a map file."""

MIN_QUATERNION = 1e-12
"""Length below which a quaternion is no rotation."""


@dataclass(frozen=True, slots=True, eq=False)
class Gaussians:
    """What a rasterizer draws: N Gaussians.

    Attributes:
        means: [N, 3] metres, world.
        log_scales: [N, 1] log metres if isotropic; [N, 3] along the axes of ``rotations`` if anisotropic.
        logit_opacities: [N].
        rgb: [N, 3], not clamped.
        bounds: [ceil(N / BLOCK), 7] smallest mean, largest mean and largest log scale of each run of BLOCK Gaussians, by which
            a rasterizer may skip what is out of view; None if not computed.
        rotations: [N, 4] quaternions (w, x, y, z) of any non-zero length, axes to world; None: the Gaussians are isotropic.
        anchors: [N] int32 number of the frame that added each, with which it moves when poses are corrected; None if not known.
    """

    means: Tensor
    log_scales: Tensor
    logit_opacities: Tensor
    rgb: Tensor
    bounds: Tensor | None = None
    rotations: Tensor | None = None
    anchors: Tensor | None = None

    def __len__(self) -> int:
        return self.means.shape[0]

    def detached(self) -> Gaussians:
        """Returns the same values, detached from autograd."""
        return Gaussians(
            means=self.means.detach(),
            log_scales=self.log_scales.detach(),
            logit_opacities=self.logit_opacities.detach(),
            rgb=self.rgb.detach(),
            bounds=self.bounds,
            rotations=None if self.rotations is None else self.rotations.detach(),
            anchors=self.anchors,
        )

    def to(self, device: torch.device) -> Gaussians:
        """Returns the Gaussians on a device; the same tensors if they are there already."""
        return Gaussians(
            means=self.means.to(device),
            log_scales=self.log_scales.to(device),
            logit_opacities=self.logit_opacities.to(device),
            rgb=self.rgb.to(device),
            bounds=None if self.bounds is None else self.bounds.to(device),
            rotations=None if self.rotations is None else self.rotations.to(device),
            anchors=None if self.anchors is None else self.anchors.to(device),
        )

    def usable(self) -> Tensor:
        """Returns [N] False where a value is not finite or beyond ``HUGE``, or a quaternion has no length."""
        parts = self.means, self.log_scales, self.logit_opacities[:, None], self.rgb
        usable = torch.ones(len(self), dtype=torch.bool, device=self.means.device)
        for values in parts if self.rotations is None else (*parts, self.rotations):
            usable &= (values.detach().abs() <= HUGE).all(dim=1)  # false for NaN
        if self.rotations is not None:
            usable &= self.rotations.detach().norm(dim=1) > MIN_QUATERNION
        return usable

    def only_usable(self) -> Gaussians:
        """Returns the ``usable`` Gaussians; itself if all are."""
        usable = self.usable()
        return self if bool(usable.all()) else self.chosen(usable)

    def chosen(self, which: Tensor) -> Gaussians:
        """Returns the Gaussians of a mask [N], without bounds."""
        rotations = None if self.rotations is None else self.rotations[which]
        anchors = None if self.anchors is None else self.anchors[which]
        values = self.means[which], self.log_scales[which], self.logit_opacities[which], self.rgb[which]
        return Gaussians(*values, rotations=rotations, anchors=anchors)

    def anisotropic(self) -> Gaussians:
        """Returns them as anisotropic Gaussians: isotropic ones get three equal radii and the identity rotation."""
        if self.rotations is not None:
            return self
        rotations = self.means.new_zeros(len(self), 4)
        rotations[:, 0] = 1.0
        return replace(self, log_scales=self.log_scales.repeat(1, 3), rotations=rotations)


def check_isotropic(gaussians: Gaussians) -> None:
    """Checks that Gaussians are isotropic.

    Raises:
        RasterizerError: they are not.
    """
    if gaussians.rotations is not None:
        raise RasterizerError(
            'the Gaussians are anisotropic; the fused optimizer and isotropic maps take isotropic ones: set '
            'mapping.anisotropic=true and mapping.optimizer=paper'
        )


def joined(first: Gaussians, second: Gaussians) -> Gaussians:
    """Returns the Gaussians of both, the first's first, with bounds if the first has them. Anisotropic if one of them is.

    Their anchors are known if those of both are.
    """
    if first.rotations is not None or second.rotations is not None:
        first, second = first.anisotropic(), second.anisotropic()
    names = 'means', 'log_scales', 'logit_opacities', 'rgb', 'rotations'
    values = {name: torch.cat([getattr(first, name), getattr(second, name)]) for name in names if getattr(first, name) is not None}
    if first.anchors is not None and second.anchors is not None:
        values['anchors'] = torch.cat([first.anchors, second.anchors])
    bounds = first.bounds
    if bounds is not None and len(second):
        full = len(first) // BLOCK
        begin = full * BLOCK
        bounds = torch.cat([bounds[:full], block_bounds(values['means'][begin:], values['log_scales'][begin:])])
    return Gaussians(**values, bounds=bounds)


@dataclass(frozen=True, slots=True, eq=False)
class Moments:
    """Adam's state. Each Gaussian has its own number of steps, because only visible ones take a step.

    Attributes:
        first_second: [N, 16] running means of the gradients by mean, log scale, logit opacity and rgb; of their squares.
        steps: [N] uint8, at most 255.
    """

    first_second: Tensor
    steps: Tensor


@dataclass(frozen=True, slots=True)
class Rates:
    """Adam's step size of each parameter."""

    means: float
    log_scales: float
    logit_opacities: float
    rgb: float
    rotations: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """The images that the map is fitted to, from one pose.

    Attributes:
        camera: the camera of the images.
        rgb8: [H, W, 3] uint8.
        depth: [H, W] metres; 0 = no reading, only colour is compared; negative, ``NOT_COMPARED`` = nothing is.
        T_cam_world: [4, 4] float32.
        color_weight: weight of the mean Huber loss of colour, over pixels and channels, those that are not compared included.
        depth_weight: weight of the mean Huber loss of depth_acc, over readings.
        enough: squares of ``FIT_TILE`` pixels a side, counted from the upper left pixel, give no gradients where the mean loss of
            their pixels is less. The loss of a view is the mean of that of its pixels. 0 = all do.
    """

    camera: PinholeCamera
    rgb8: Tensor
    depth: Tensor
    T_cam_world: Tensor
    color_weight: float
    depth_weight: float
    enough: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Render:
    """One view of the map.

    Attributes:
        rgb: [3, H, W].
        depth_acc: [H, W] metres, sum of w z: less than the depth of the surface where the silhouette is below 1.
        silhouette: [H, W] in [0, 1), sum of w.
    """

    rgb: Tensor
    depth_acc: Tensor
    silhouette: Tensor

    def depth(self, min_silhouette: float = 0.5) -> Tensor:
        """Returns [H, W] expected depth in metres; 0 where the silhouette is below the limit."""
        covered = self.silhouette >= min_silhouette
        return torch.where(covered, self.depth_acc / torch.where(covered, self.silhouette, 1.0), 0.0)

    def images(self) -> RenderedView:
        """Returns the images on the host, for display and metrics: 8-bit colour, expected depth, silhouette."""
        rgb = self.rgb.clamp(0, 1).mul(255).round().byte().permute(1, 2, 0).contiguous()
        return RenderedView(*(image.numpy(force=True) for image in (rgb, self.depth(), self.silhouette)))


class Rasterizer(Protocol):
    """A backend."""

    def render(self, gaussians: Gaussians, camera: PinholeCamera, T_cam_world: Tensor) -> Render:
        """Draws the Gaussians, differentiable in them and in the pose.

        Args:
            gaussians: what to draw.
            camera: the image to draw.
            T_cam_world: [4, 4] world to camera; each entry of its upper three rows receives a gradient.
        """
        ...

    def fit(self, gaussians: Gaussians, moments: Moments, rates: Rates, target: Target) -> float | Tensor:
        """Takes one step of Adam with Nesterov's momentum towards a target, in place. Gaussians without a gradient do not change.

        Returns:
            The loss before the step. On a GPU it is a scalar tensor, so that the host waits only when it reads it.
        """
        ...
