"""Image metrics: how well renders of the map match the frames.

Each frame gets two sets of scores. ``ImageScores`` average over the pixels with a depth reading and leave the others
out, because the map has no information about them. ``OriginalScores`` repeat SplaTAM's own evaluation, which blacks out
those pixels in both images and averages over all pixels, so that each of them counts as perfect; they are for comparison
with its tables. docs/evaluation.md defines each score.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, replace
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatam_core.config import DepthConfig
from splatam_core.device import pose_tensor
from splatam_core.evaluation.similarity import ms_ssim
from splatam_core.geometry import se3
from splatam_core.images.ssim import ssim_map
from splatam_core.images.view import View
from splatam_core.rasterizer import Gaussians, Rasterizer, Render
from splatam_core.runs.metrics import ImageScores, OriginalScores
from splatam_core.types import RgbdFrame

MIN_SQUARED_ERROR = 1e-10
"""Limits PSNR to 100 dB: infinity is not valid JSON and has no mean."""

HOLE_SILHOUETTE = 0.5
"""A pixel with a depth reading and at most this silhouette is a hole: the map does not cover it."""

MAX_HOLE_SHARE = 0.001
"""A novel view with a larger share of holes shows unmapped surface, and is scored separately (the original's limit)."""

ImageDistance = Callable[[Tensor, Tensor], 'float | None']
Scores = TypeVar('Scores', 'ImageScores', 'OriginalScores')


@dataclass(frozen=True, slots=True)
class FrameScores:
    """The scores of one frame.

    Attributes:
        stamp_ns: the frame's stamp.
        scores: how well the render matches the frame.
        original: the same as the original computes it.
        hole_share: share of all pixels that are holes.
    """

    stamp_ns: int
    scores: ImageScores
    original: OriginalScores = OriginalScores()
    hole_share: float = 0.0

    @property
    def has_holes(self) -> bool:
        """True if the view has more holes than the novel-view protocol allows."""
        return self.hole_share > MAX_HOLE_SHARE


class ViewScorer:
    """Renders a finished map at given poses and compares the renders with the frames taken there.

    Args:
        gaussians: the map, on the rasterizer's device; frames are moved there.
        rasterizer: renders the map.
        depth: the range of valid depth readings. Its edge filter is ignored, so that a run which filters difficult
            pixels is still scored on them.
        lpips: a learned image distance; None skips it.
    """

    def __init__(
        self, gaussians: Gaussians, rasterizer: Rasterizer, depth: DepthConfig, lpips: ImageDistance | None = None
    ) -> None:
        self._gaussians = gaussians.detached()
        self._rasterizer = rasterizer
        self._depth = replace(depth, edge_filter=0.0)
        self._lpips = lpips

    def view(self, frame: RgbdFrame) -> View:
        """Return the frame as tensors on the map's device, with the valid depth readings."""
        return View.from_frame(frame, self._depth).to(self._gaussians.means.device)

    def render(self, frame: RgbdFrame, T_world_cam: NDArray[np.float64]) -> Render:
        """Render the map at a pose, with the frame's camera."""
        T_cam_world = pose_tensor(se3.inverse(T_world_cam), self._gaussians.means.device)
        with torch.no_grad():
            return self._rasterizer.render(self._gaussians, frame.camera, T_cam_world)

    def score(self, frame: RgbdFrame, T_world_cam: NDArray[np.float64]) -> FrameScores:
        """Score the render at a pose against the frame taken there."""
        render, view = self.render(frame, T_world_cam), self.view(frame)
        scores = score_view(render.rgb, render.depth(), view.rgb, view.depth, view.valid, self._lpips)
        original = original_scores(render, view.rgb, torch.from_numpy(frame.depth_m).to(view.depth.device), self._lpips)
        holes = view.valid & (render.silhouette <= HOLE_SILHOUETTE)
        return FrameScores(frame.stamp_ns, scores, original, float(holes.float().mean()))


def score_view(
    rendered: Tensor, rendered_depth_m: Tensor, rgb: Tensor, depth_m: Tensor, mask: Tensor,
    lpips: ImageDistance | None = None,
) -> ImageScores:  # fmt: skip
    """Compare a render with the frame.

    Args:
        rendered: [3, H, W] rendered colour; this function clamps it to [0, 1].
        rendered_depth_m: [H, W] expected depth, 0 where nothing was rendered.
        rgb: [3, H, W] the frame's colour in [0, 1].
        depth_m: [H, W] the frame's depth.
        mask: [H, W] bool, True where the frame has a depth reading.
        lpips: a learned image distance; None skips it.

    Returns:
        The scores. Those over the depth readings are None if there is no reading.
    """
    rendered = rendered.clamp(0, 1)
    squared = (rendered - rgb) ** 2
    whole = ImageScores(
        psnr_full_db=_psnr(squared.mean()),
        ms_ssim=ms_ssim(rendered, rgb),
        lpips=None if lpips is None else lpips(rendered, rgb),
    )
    if not mask.any():
        return whole
    depth_error_m = (rendered_depth_m - depth_m)[mask]
    return replace(
        whole,
        psnr_db=_psnr(squared[:, mask].mean()),
        ssim=float(ssim_map(rendered, rgb)[:, mask].mean()),
        depth_l1_m=float(depth_error_m.abs().mean()),
        depth_rmse_m=float(depth_error_m.square().mean().sqrt()),
    )


def original_scores(render: Render, rgb: Tensor, reading_m: Tensor, lpips: ImageDistance | None = None) -> OriginalScores:
    """Compare as SplaTAM's ``eval_helpers.py`` does (read at commit da6bbcd; reimplemented, not copied).

    Args:
        render: the map rendered at the frame's pose.
        rgb: [3, H, W] the frame's colour in [0, 1].
        reading_m: [H, W] the frame's depth, not limited to the valid range; 0 = no reading.
        lpips: a learned image distance; None skips it.
    """
    mask = reading_m > 0
    rendered, rgb = render.rgb * mask, rgb * mask
    channel_errors = ((rendered - rgb) ** 2).mean(dim=(1, 2))
    return OriginalScores(
        psnr_db=float(np.mean([_psnr(error) for error in channel_errors])),
        ms_ssim=ms_ssim(rendered, rgb),
        lpips=None if lpips is None else lpips(rendered.clamp(0, 1), rgb),
        depth_l1_m=float((render.depth_acc - reading_m)[mask].abs().mean()) if mask.any() else None,
    )


def mean_scores(frames: Iterable[FrameScores]) -> ImageScores:
    """Return the mean of each score over the frames that have it; None if no frame has it."""
    return _means(ImageScores, [frame.scores for frame in frames])


def mean_original_scores(frames: Iterable[FrameScores]) -> OriginalScores:
    """Return the same means of the original's scores."""
    return _means(OriginalScores, [frame.original for frame in frames])


def _means(kind: type[Scores], scores: list[Scores]) -> Scores:
    return kind(*(_mean([getattr(entry, field.name) for entry in scores]) for field in fields(kind)))


def _psnr(mean_squared_error: Tensor) -> float:
    return float(-10 * torch.log10(mean_squared_error.clamp(min=MIN_SQUARED_ERROR)))


def _mean(values: list[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None
