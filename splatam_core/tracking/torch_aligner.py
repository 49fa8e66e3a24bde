"""``Aligner`` in torch, on whichever device the images are.

Residuals are of two kinds, brightness and depth, in this order wherever a dimension has two entries. Sums over pixels are
float32, in an order that the device chooses; those of the native aligner are double.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor

from splatam_core.geometry.camera import PinholeCamera
from splatam_core.geometry.se3 import Matrix
from splatam_core.images.filters import brightness, luminance
from splatam_core.rasterizer import Render
from splatam_core.tracking.aligner import AlignmentState, Descent, EvidenceSums, Knowns, Linearization
from splatam_core.tracking.descent import descend
from splatam_core.tracking.evidence import Evidence, summed, weigh

_UNKNOWNS = 9
_BINS = 1024  # of the histogram of absolute residuals, an eighth of an octave each
_BIN_BITS = 20  # low bits of a float32 that do not affect its bin
_FIRST_BIN = (127 - 64) << 3


@dataclass(frozen=True, slots=True, eq=False)
class TorchLinearSystem:
    """See ``LinearSystem``; on the host."""

    H: Matrix
    g: Matrix
    H_by_time: Matrix
    H_by_time_squared: Matrix
    g_by_time: Matrix
    cost: float
    points: int
    compared: int
    seen: int
    agreeing: int
    photometric_median: float
    depth_median: float


class TorchAligner:
    """See ``Aligner``."""

    def layers(self, brightness: Tensor, depth: Tensor, max_step: float) -> Tensor:
        """See ``Aligner.layers``."""
        result = brightness.new_zeros(*brightness.shape, 6)
        for first, image in ((0, brightness), (3, depth)):
            result[..., first] = image
            result[1:-1, 1:-1, first + 1] = 0.5 * (image[1:-1, 2:] - image[1:-1, :-2])
            result[1:-1, 1:-1, first + 2] = 0.5 * (image[2:, 1:-1] - image[:-2, 1:-1])
        is_surface = (result[..., 4:].abs() <= max_step * depth[..., None]).all(dim=-1)
        result[..., 3] = torch.where(is_surface, depth, torch.nan)
        return result

    def frame_images(self, rgb8: Tensor, depth: Tensor, max_gap: int, max_step: float) -> tuple[Tensor, Tensor]:
        """See ``Aligner.frame_images``."""
        along_rows = _filled_rows(torch.where(depth > 0, depth, torch.nan), max_gap, max_step)
        return brightness(rgb8), _filled_rows(along_rows.T, max_gap, max_step).T.contiguous()

    def render_images(
        self, rgb: Tensor, depth_acc: Tensor, silhouette: Tensor, threshold: float, least: float
    ) -> tuple[Tensor, Tensor]:
        """See ``Aligner.render_images``."""
        light = luminance(rgb.permute(1, 2, 0)) / silhouette.clamp(min=max(threshold, least))
        depth = Render(rgb, depth_acc, silhouette).depth()
        return light, torch.where((silhouette > threshold) & (depth > 0), depth, torch.nan)

    def halve(self, brightness: Tensor, depth: Tensor, max_step: float) -> tuple[Tensor, Tensor]:
        """See ``Aligner.halve``."""
        z = _blocks(depth)
        mean = 0.25 * z.sum(dim=0)  # NaN if any of the four is
        is_surface = z.amax(dim=0) - z.amin(dim=0) <= max_step * mean
        return 0.25 * _blocks(brightness).sum(dim=0), torch.where(is_surface, mean, torch.nan)

    def linearize(self, at: Linearization[Tensor], *, inlier_color: float, inlier_depth: float) -> TorchLinearSystem:
        """See ``Aligner.linearize``. The host waits for the device once, for the sums."""
        camera = at.camera
        scales_at = [at.photometric_scale, at.depth_scale]
        given = np.concatenate([at.color_motion[:3].ravel(), at.depth_motion[:3].ravel(), at.velocity, at.readout, scales_at])
        numbers = torch.from_numpy(given.astype(np.float32)).to(at.depth.device, non_blocking=True)
        motions, (speed, readout), scales = numbers[:24].view(2, 3, 4), numbers[24:36].view(2, 6), numbers[36:, None]
        times = _times(at.depth)
        intensity, known = at.brightness.flatten(), at.depth.flatten() > 0
        moved = _Moved.of(
            _carried(motions[:, :, :3] @ _points(at.depth, camera) + motions[:, :, 3:], readout, times), known, camera
        )
        value, along_u, along_v = _sampled(at.layers, moved).unbind(-1)  # [2, P] each
        residuals = torch.stack([value[0] - (at.gain * intensity + at.bias), (value[1] - moved.z[1]) * moved.inverse_z[1]])
        compared = moved.inside[1] & ~value[1].isnan()
        seen = moved.inside.all(dim=0) & (residuals[1].abs() < at.max_depth_ratio)  # False for NaN
        unread = moved.inside[1] & value[1].isnan()  # colour needs the depth of the reference only
        used = torch.stack([(seen | unread) & moved.inside[0], seen])  # [2, P]
        tilt = torch.stack([along_u[1] * camera.fx, along_v[1] * camera.fy]) * moved.inverse_z[1]  # [2, P]
        # Turns the depth difference along the ray into a distance from the surface.
        incidence_cosine = 1 / (1 + (tilt * tilt).sum(dim=0)).sqrt()
        residuals = torch.where(used, torch.stack([residuals[0], residuals[1] * incidence_cosine]), 0)
        agree = seen & (residuals[0].abs() <= inlier_color) & (residuals[1].abs() <= inlier_depth)
        image_gradients = torch.stack([along_u * camera.fx, along_v * camera.fy])  # [2, 2, P]
        jacobian = _jacobian(moved, image_gradients, incidence_cosine, intensity, speed)
        counts = torch.stack([known, compared, seen, agree]).sum(dim=1)
        system = torch.where(used, jacobian, 0), residuals
        return _summed(system, scales, times, _Counted(counts, _medians(residuals, used), seen))

    def descend(self, task: Descent[Tensor], start: AlignmentState) -> AlignmentState:
        """See ``Aligner.descend``. Inliers are not counted on the way."""
        return descend(partial(self.linearize, inlier_color=0.0, inlier_depth=0.0), task, start)

    def evidence(self, at: Linearization[Tensor], *, max_depth_error: float, step: int) -> EvidenceSums:
        """See ``Aligner.evidence``. On the host."""
        return summed(at.converted(lambda image: image.numpy(force=True)), max_depth_error, step)

    def weigh(self, sums: EvidenceSums, known: Knowns) -> Evidence:
        """See ``Aligner.weigh``."""
        return weigh(sums, known)


@dataclass(frozen=True, slots=True, eq=False)
class _Moved:
    """The P points of the reference, moved into the frame's camera and projected; all [2, P]."""

    x: Tensor
    y: Tensor
    z: Tensor
    inverse_z: Tensor
    u: Tensor
    v: Tensor
    inside: Tensor

    @classmethod
    def of(cls, points: Tensor, known: Tensor, camera: PinholeCamera) -> _Moved:
        """Projects points [2, 3, P]."""
        x, y, z = points.unbind(1)
        inverse_z = 1 / z
        u, v = camera.fx * x * inverse_z + camera.cx, camera.fy * y * inverse_z + camera.cy
        inside = known & (z > 0) & (u >= 0) & (v >= 0) & (u < camera.width - 1) & (v < camera.height - 1)
        return cls(x=x, y=y, z=z, inverse_z=inverse_z, u=u, v=v, inside=inside)


def _filled_rows(depth: Tensor, max_gap: int, max_step: float) -> Tensor:
    width = depth.shape[1]
    columns, known = torch.arange(width, device=depth.device), depth > 0
    before = torch.where(known, columns, -1).cummax(dim=1).values
    after = width - 1 - torch.where(known, width - 1 - columns, -1).flip(1).cummax(dim=1).values.flip(1)
    near_side, far_side = depth.gather(1, before.clamp(min=0)), depth.gather(1, after.clamp(max=width - 1))
    is_small = (before >= 0) & (after < width) & (after - before <= max_gap + 1)
    is_surface = (far_side - near_side).abs() <= max_step * torch.minimum(near_side, far_side)
    t = (columns - before) / (after - before).clamp(min=1)
    return torch.where(~known & is_small & is_surface, 1 / ((1 - t) / near_side + t / far_side), depth)


def _blocks(image: Tensor) -> Tensor:
    """Returns [4, H // 2, W // 2], the pixels of each 2x2 block."""
    height, width = image.shape[0] // 2, image.shape[1] // 2
    return image[: 2 * height, : 2 * width].reshape(height, 2, width, 2).permute(1, 3, 0, 2).reshape(4, height, width)


def _points(depth: Tensor, camera: PinholeCamera) -> Tensor:
    """Returns [3, H * W] camera coordinates of the pixels."""
    columns = (torch.arange(depth.shape[1], device=depth.device, dtype=depth.dtype) - camera.cx) / camera.fx
    rows = (torch.arange(depth.shape[0], device=depth.device, dtype=depth.dtype) - camera.cy) / camera.fy
    return torch.stack([columns * depth, rows[:, None] * depth, depth]).flatten(1)


def _times(depth: Tensor) -> Tensor:
    """Returns [H * W] when the pixels are read: -0.5 in the first row to 0.5 in the last."""
    height, width = depth.shape
    times = torch.arange(height, device=depth.device, dtype=depth.dtype) / max(1, height - 1) - 0.5 * (height > 1)
    return times.repeat_interleave(width)


def _carried(points: Tensor, twist: Tensor, times: Tensor) -> Tensor:
    """Moves points [2, 3, P] on by a twist [6] per unit of time, for times [P]; to second order, as ``csrc/readout.hpp`` does."""
    turn = twist[3:, None].expand(3, points.shape[2])[None].expand_as(points)
    speed = torch.linalg.cross(turn, points, dim=1) + twist[:3, None]
    return points + times * (speed + 0.5 * times * torch.linalg.cross(turn, speed, dim=1))


def _sampled(layers: Tensor, moved: _Moved) -> Tensor:
    """Returns [2, P, 3] value and gradients of the frame at the points, each kind at its own position; bilinear."""
    height, width, _ = layers.shape
    u, v = torch.where(moved.inside, moved.u, 0), torch.where(moved.inside, moved.v, 0)
    column, row = u.long(), v.long()
    first = row * width + column
    corners = torch.stack([first, first + 1, first + width, first + width + 1]).clamp_(max=height * width - 1)
    kind = torch.arange(2, device=layers.device)[:, None]
    upper_left, upper_right, lower_left, lower_right = layers.view(-1, 2, 3)[corners, kind]  # [2, P, 3] each
    right, below = (u - column)[..., None], (v - row)[..., None]
    upper = upper_left * (1 - right) + upper_right * right
    lower = lower_left * (1 - right) + lower_right * right
    return upper * (1 - below) + lower * below


def _jacobian(moved: _Moved, image_gradients: Tensor, incidence_cosine: Tensor, intensity: Tensor, speed: Tensor) -> Tensor:
    """Returns [9, 2, P] derivatives of the residuals by the unknowns.

    image_gradients: [2, 2, P] of the frame along u and v, times focal length.
    """
    x, y, z = moved.x, moved.y, moved.z
    a, b = (image_gradients * moved.inverse_z).unbind()
    c = -(a * x + b * y) * moved.inverse_z
    by_twist = torch.stack([a, b, c, c * y - b * z, a * z - c * x, b * x - a * y])  # [6, 2, P]
    by_twist[2, 1] -= 1
    by_twist[3, 1] -= y[1]
    by_twist[4, 1] += x[1]
    by_twist[:, 1] *= moved.inverse_z[1] * incidence_cosine
    others = torch.stack([-intensity, torch.full_like(intensity, -1), speed @ by_twist[:, 0]])  # of brightness only
    return torch.cat([by_twist, torch.stack([others, torch.zeros_like(others)], dim=1)])


def _medians(residuals: Tensor, used: Tensor) -> Tensor:
    """Returns [2] upper edges of the bins that hold the medians of the absolute residuals that are used; NaN if none is."""
    bins = ((residuals.abs().view(torch.int32) >> _BIN_BITS) - _FIRST_BIN).clamp_(0, _BINS - 1).long()
    histogram = torch.zeros(2, _BINS, dtype=torch.int64, device=bins.device)
    counted = histogram.scatter_add_(1, bins, used.long()).cumsum(dim=1)
    median = (2 * counted < counted[:, -1:]).sum(dim=1)
    edges = ((median + 1 + _FIRST_BIN) << _BIN_BITS).int().view(torch.float32)
    return torch.where(counted[:, -1] > 0, edges, torch.nan)


@dataclass(frozen=True, slots=True, eq=False)
class _Counted:
    """Counts [4], medians [2], and which points are seen [P]."""

    counts: Tensor
    medians: Tensor
    is_seen: Tensor


def _summed(system: tuple[Tensor, Tensor], scales: Tensor, times: Tensor, counted: _Counted) -> TorchLinearSystem:
    """Returns the sums, brought to the host in one transfer. Weights: Student's t with five degrees of freedom."""
    (jacobian, residuals), precisions = system, 1 / (scales * scales)
    squared = residuals * residuals * precisions
    weighted = (jacobian * (6 / (5 + squared) * precisions)).flatten(1)
    both, by_time = torch.cat([jacobian.flatten(1), residuals.flatten()[None]]).T, weighted * times.repeat(2)
    products = torch.stack([weighted @ both, by_time @ both, (by_time * times.repeat(2)) @ both])  # [3, 9, 10]
    cost = torch.where(counted.is_seen, squared / (5 + squared), 0).sum()
    sums = torch.cat([products.flatten(), cost[None], counted.medians, counted.counts.float()]).numpy(force=True).astype(np.float64)
    matrices, (total, *middles), tallies = np.split(sums, np.cumsum([3 * _UNKNOWNS * (_UNKNOWNS + 1), 3]))
    moments = matrices.reshape(3, _UNKNOWNS, _UNKNOWNS + 1)
    points, compared, seen, agreeing = map(int, tallies)
    photometric_median, depth_median = map(float, middles)
    return TorchLinearSystem(
        H=moments[0, :, :-1],
        g=moments[0, :, -1],
        H_by_time=moments[1, :, :-1],
        H_by_time_squared=moments[2, :, :-1],
        g_by_time=moments[1, :, -1],
        cost=float(total),
        points=points,
        compared=compared,
        seen=seen,
        agreeing=agreeing,
        photometric_median=photometric_median,
        depth_median=depth_median,
    )
