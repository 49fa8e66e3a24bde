"""How well the map's renders match the images: PSNR, SSIM and depth L1, over the pixels that have a depth reading.

A pixel without a reading is one the map was never told about. It is left out of the sums, not set to zero on both
sides, which would count it as a perfect one.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatam_core import se3
from splatam_core.config import DepthConfig
from splatam_core.losses import ssim_map
from splatam_core.rasterizer import Gaussians, Rasterizer, Render
from splatam_core.types import RgbdFrame
from splatam_core.view import View

MIN_SQUARED_ERROR = 1e-10
"""Identical images score 100 dB, not infinity: that is no number in JSON, nor can it be averaged."""


@dataclass(frozen=True, slots=True)
class ImageScores:
    """One view's scores, or their mean over views.

    Attributes:
        psnr_db: of the colour over the pixels with a depth reading; None where there is no such pixel.
        ssim: likewise.
        depth_l1_m: mean absolute difference to the reading; a pixel that renders no depth differs by all of it.
        psnr_full_db: of the colour over the whole image, holes included.
    """

    psnr_db: float | None
    ssim: float | None
    depth_l1_m: float | None
    psnr_full_db: float | None


@dataclass(frozen=True, slots=True)
class FrameScores:
    """The scores of one frame.

    Attributes:
        stamp_ns: the frame's stamp.
        scores: how its render matches.
    """

    stamp_ns: int
    scores: ImageScores


class ViewScorer:
    """Renders a finished map at poses and compares with the frames taken there.

    Args:
        gaussians: the map.
        rasterizer: draws it.
        depth: the range in which readings count. Its edge filter does not apply: a run that closes its eyes to
            hard pixels is scored on them all the same.
    """

    def __init__(self, gaussians: Gaussians, rasterizer: Rasterizer, depth: DepthConfig) -> None:
        self._gaussians = gaussians.detached()
        self._rasterizer = rasterizer
        self._depth = replace(depth, edge_filter=0.0)

    def view(self, frame: RgbdFrame) -> View:
        """The frame's images, with the depth readings that count."""
        return View.from_frame(frame, self._depth)

    def render(self, frame: RgbdFrame, T_world_cam: NDArray[np.float64]) -> Render:
        """The map from a pose, in the frame's camera."""
        T_cam_world = torch.from_numpy(se3.inverse(T_world_cam)).to(self._gaussians.means.dtype)
        with torch.no_grad():
            return self._rasterizer.render(self._gaussians, frame.camera, T_cam_world)

    def score(self, frame: RgbdFrame, T_world_cam: NDArray[np.float64]) -> FrameScores:
        """How the map at a pose matches the frame taken there."""
        render, view = self.render(frame, T_world_cam), self.view(frame)
        return FrameScores(frame.stamp_ns, score_view(render.rgb, render.depth(), view.rgb, view.depth, view.valid))


def score_view(rendered: Tensor, rendered_depth_m: Tensor, rgb: Tensor, depth_m: Tensor, mask: Tensor) -> ImageScores:
    """Compare a render with what the camera saw.

    Args:
        rendered: [3, H, W] colour; clamped to [0, 1] here.
        rendered_depth_m: [H, W] expected depth, 0 where nothing was rendered.
        rgb: [3, H, W] in [0, 1].
        depth_m: [H, W].
        mask: [H, W] bool, where there is a depth reading.
    """
    rendered = rendered.clamp(0, 1)
    squared = (rendered - rgb) ** 2
    psnr_full_db = _psnr(squared.mean())
    if not mask.any():
        return ImageScores(None, None, None, psnr_full_db)
    return ImageScores(
        psnr_db=_psnr(squared[:, mask].mean()),
        ssim=float(ssim_map(rendered, rgb)[:, mask].mean()),
        depth_l1_m=float((rendered_depth_m - depth_m)[mask].abs().mean()),
        psnr_full_db=psnr_full_db,
    )


def mean_scores(frames: Iterable[FrameScores]) -> ImageScores:
    """Each score's mean over the frames that have it; None where none does."""
    scores = [frame.scores for frame in frames]
    return ImageScores(
        psnr_db=_mean(s.psnr_db for s in scores),
        ssim=_mean(s.ssim for s in scores),
        depth_l1_m=_mean(s.depth_l1_m for s in scores),
        psnr_full_db=_mean(s.psnr_full_db for s in scores),
    )


def _psnr(mean_squared_error: Tensor) -> float:
    return float(-10 * torch.log10(mean_squared_error.clamp(min=MIN_SQUARED_ERROR)))


def _mean(values: Iterator[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None
