"""What ``_native.Aligner`` does, in torch: the operations of direct alignment, on whichever device the pictures are.

Residuals are of two kinds, of light and of depth, in this order wherever a dimension has two entries. Sums over pixels are
of float32, in an order of the device's choice; the native ones are of doubles.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Matrix = NDArray[np.float64]
Motion = NDArray[np.float32]
Linearized = tuple[Matrix, Matrix, float, int, int, int, int, float, float]

_UNKNOWNS = 9
_BINS = 1024  # of residuals by magnitude, an eighth of an octave each
_BIN_BITS = 20  # of a float32, that do not matter for its bin
_FIRST_BIN = (127 - 64) << 3


class TorchAligner:
    """Pictures are brightness [H, W], and depth [H, W] in metres with NaN where there is none, on one device."""

    def layers(self, brightness: Tensor, depth: Tensor, max_step: float) -> Tensor:
        """[H, W, 6] brightness, its slopes along u and v, depth, its slopes; slopes are 0 at the border.

        Depth is NaN where it changes by more than ``max_step`` of itself from pixel to pixel.
        """
        result = brightness.new_zeros(*brightness.shape, 6)
        for first, image in ((0, brightness), (3, depth)):
            result[..., first] = image
            result[1:-1, 1:-1, first + 1] = 0.5 * (image[1:-1, 2:] - image[1:-1, :-2])
            result[1:-1, 1:-1, first + 2] = 0.5 * (image[2:, 1:-1] - image[:-2, 1:-1])
        is_surface = (result[..., 4:].abs() <= max_step * depth[..., None]).all(dim=-1)
        result[..., 3] = torch.where(is_surface, depth, torch.nan)
        return result

    def halve(self, brightness: Tensor, depth: Tensor, max_step: float) -> tuple[Tensor, Tensor]:
        """Half the size: averages of 2x2 blocks, and no depth where a block is no surface."""
        light, z = _quarters(brightness), _quarters(depth)
        mean = 0.25 * z.sum(dim=0)  # NaN if any is
        is_surface = z.amax(dim=0) - z.amin(dim=0) <= max_step * mean
        return 0.25 * light.sum(dim=0), torch.where(is_surface, mean, torch.nan)

    def linearize(
        self, brightness: Tensor, depth: Tensor, layers: Tensor, fx: float, fy: float, cx: float, cy: float,
        light_motion: Motion, depth_motion: Motion, velocity: NDArray[np.float32], gain: float, bias: float,
        light_scale: float, depth_scale: float, max_depth_ratio: float, inlier_light: float, inlier_depth: float,
    ) -> Linearized:  # fmt: skip
        """The residuals of a reference in a frame, linearised; the host waits for the device once, for the sums.

        Args:
            brightness: of the reference.
            depth: of the reference.
            layers: of the frame.
            fx: of both.
            fy: of both.
            cx: of both.
            cy: of both.
            light_motion: [4, 4] from the reference's camera to the frame's, when colour was taken.
            depth_motion: [4, 4] when depth was taken.
            velocity: [6] twist by which the former moves as colour lags more.
            gain: frame = gain * reference + bias.
            bias: see gain.
            light_scale: of the residuals of brightness.
            depth_scale: of the relative residuals of depth.
            max_depth_ratio: larger ones are of other surfaces.
            inlier_light: residuals up to this agree.
            inlier_depth: likewise.

        Returns:
            H [9, 9] and g [9] of twist, gain, bias and lag; robust cost; points, compared, seen, agreeing; medians of the
            residuals' magnitudes, light and depth.
        """
        given = np.concatenate([light_motion[:3].ravel(), depth_motion[:3].ravel(), velocity, [light_scale, depth_scale]])
        numbers = torch.from_numpy(given.astype(np.float32)).to(depth.device, non_blocking=True)
        motions, speed, scales = numbers[:24].view(2, 3, 4), numbers[24:30], numbers[30:, None]
        light, known = brightness.flatten(), depth.flatten() > 0
        moved = _Moved.of(_points(depth, fx, fy, cx, cy), known, motions, depth.shape, fx, fy, cx, cy)
        value, along_u, along_v = _sampled(layers, moved).unbind(-1)  # [2, P] each
        residuals = torch.stack([value[0] - (gain * light + bias), (value[1] - moved.z[1]) * moved.inverse_z[1]])
        compared = moved.inside[1] & ~value[1].isnan()
        seen = moved.inside.all(dim=0) & (residuals[1].abs() < max_depth_ratio)  # NaN is not
        tilt = torch.stack([along_u[1] * fx, along_v[1] * fy]) * moved.inverse_z[1]  # [2, P]
        upright = 1 / (1 + (tilt * tilt).sum(dim=0)).sqrt()  # of depth: off along the surface's normal, not along the ray
        residuals = torch.where(seen, torch.stack([residuals[0], residuals[1] * upright]), 0)
        agree = seen & (residuals[0].abs() <= inlier_light) & (residuals[1].abs() <= inlier_depth)
        slopes = _slopes(moved, along_u * fx, along_v * fy, upright, light, speed)
        counts = torch.stack([known, compared, seen, agree]).sum(dim=1)
        return _collected(torch.where(seen, slopes, 0), residuals, scales, counts, _medians(residuals, seen))


@dataclass(frozen=True, slots=True, eq=False)
class _Moved:
    """Points of the reference, P of them, where the frame would show them; all [2, P]."""

    x: Tensor
    y: Tensor
    z: Tensor
    inverse_z: Tensor
    u: Tensor
    v: Tensor
    inside: Tensor

    @classmethod
    def of(
        cls, points: Tensor, known: Tensor, motions: Tensor, size: tuple[int, int], fx: float, fy: float, cx: float,
        cy: float,
    ) -> _Moved:  # fmt: skip
        """Move points [3, P] by motions [2, 3, 4], into an image of a size (height, width)."""
        x, y, z = (motions[:, :, :3] @ points + motions[:, :, 3:]).unbind(1)
        inverse_z = 1 / z
        u, v = fx * x * inverse_z + cx, fy * y * inverse_z + cy
        height, width = size
        inside = known & (z > 0) & (u >= 0) & (v >= 0) & (u < width - 1) & (v < height - 1)
        return cls(x, y, z, inverse_z, u, v, inside)


def _quarters(image: Tensor) -> Tensor:
    """[4, H // 2, W // 2] the pixels of each 2x2 block."""
    height, width = image.shape[0] // 2, image.shape[1] // 2
    return image[: 2 * height, : 2 * width].reshape(height, 2, width, 2).permute(1, 3, 0, 2).reshape(4, height, width)


def _points(depth: Tensor, fx: float, fy: float, cx: float, cy: float) -> Tensor:
    """[3, H * W] camera coordinates of the pixels."""
    columns = (torch.arange(depth.shape[1], device=depth.device, dtype=depth.dtype) - cx) / fx
    rows = (torch.arange(depth.shape[0], device=depth.device, dtype=depth.dtype) - cy) / fy
    return torch.stack([columns * depth, rows[:, None] * depth, depth]).flatten(1)


def _sampled(layers: Tensor, moved: _Moved) -> Tensor:
    """[2, P, 3] value and slopes that the frame shows at the points, each kind at its own place; bilinear."""
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


def _slopes(moved: _Moved, along_u: Tensor, along_v: Tensor, upright: Tensor, light: Tensor, speed: Tensor) -> Tensor:
    """[9, 2, P] change of the residuals with the unknowns; along_u and along_v are those of the frame, times focal length."""
    x, y, z = moved.x, moved.y, moved.z
    a, b = along_u * moved.inverse_z, along_v * moved.inverse_z
    c = -(a * x + b * y) * moved.inverse_z
    by_twist = torch.stack([a, b, c, c * y - b * z, a * z - c * x, b * x - a * y])  # [6, 2, P]
    by_twist[2, 1] -= 1
    by_twist[3, 1] -= y[1]
    by_twist[4, 1] += x[1]
    by_twist[:, 1] *= moved.inverse_z[1] * upright
    others = torch.stack([-light, torch.full_like(light, -1), speed @ by_twist[:, 0]])  # of light only
    return torch.cat([by_twist, torch.stack([others, torch.zeros_like(others)], dim=1)])


def _medians(residuals: Tensor, seen: Tensor) -> Tensor:
    """[2] upper edges of the bins that hold the medians of the magnitudes; NaN where nothing is seen."""
    bins = ((residuals.abs().view(torch.int32) >> _BIN_BITS) - _FIRST_BIN).clamp_(0, _BINS - 1).long()
    histogram = torch.zeros(2, _BINS, dtype=torch.int64, device=bins.device)
    counted = histogram.scatter_add_(1, bins, seen.long().expand(2, -1)).cumsum(dim=1)
    median = (2 * counted < counted[:, -1:]).sum(dim=1)
    edges = ((median + 1 + _FIRST_BIN) << _BIN_BITS).int().view(torch.float32)
    return torch.where(counted[:, -1] > 0, edges, torch.nan)


def _collected(slopes: Tensor, residuals: Tensor, scales: Tensor, counts: Tensor, medians: Tensor) -> Linearized:
    """The sums, brought to the host at once; see ``TorchAligner.linearize``. Student's t with five degrees of freedom."""
    precisions = 1 / (scales * scales)
    squared = residuals * residuals * precisions
    weighted = (slopes * (6 / (5 + squared) * precisions)).flatten(1)
    H, g = weighted @ slopes.flatten(1).T, weighted @ residuals.flatten()
    cost = (squared / (5 + squared)).sum()
    sums = torch.cat([H.flatten(), g, cost[None], medians, counts.float()]).numpy(force=True).astype(np.float64)
    matrix, vector, (total, *middles), tallies = np.split(sums, np.cumsum([_UNKNOWNS**2, _UNKNOWNS, 3]))
    return matrix.reshape(_UNKNOWNS, _UNKNOWNS), vector, float(total), *map(int, tallies), *map(float, middles)
