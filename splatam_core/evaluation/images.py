"""How well the map's renders match the images, over the pixels that have a depth reading, and as the original counts.

A pixel without a reading is one the map was never told about. It is left out of the sums, not set to zero on both
sides, which would count it as a perfect one. SplaTAM's own evaluation does the latter: ``OriginalScores`` are for
comparing with its tables. docs/evaluation.md defines each score.
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
"""Identical images score 100 dB, not infinity: that is no number in JSON, nor can it be averaged."""

HOLE_SILHOUETTE = 0.5
MAX_HOLE_SHARE = 0.001
"""A novel view with a larger share of holes shows what was never mapped, not how well it was (the original's limit)."""

ImageDistance = Callable[[Tensor, Tensor], 'float | None']
Scores = TypeVar('Scores', 'ImageScores', 'OriginalScores')


@dataclass(frozen=True, slots=True)
class FrameScores:
    """The scores of one frame.

    Attributes:
        stamp_ns: the frame's stamp.
        scores: how its render matches.
        original: the same as the original counts.
        hole_share: share of the pixels that have a reading and see no map.
    """

    stamp_ns: int
    scores: ImageScores
    original: OriginalScores = OriginalScores()
    hole_share: float = 0.0

    @property
    def has_holes(self) -> bool:
        """Whether it sees more unmapped surface than the novel-view protocol lets pass."""
        return self.hole_share > MAX_HOLE_SHARE


class ViewScorer:
    """Renders a finished map at poses and compares with the frames taken there.

    Args:
        gaussians: the map, on the rasterizer's device; what is compared is brought there.
        rasterizer: draws it.
        depth: the range in which readings count. Its edge filter does not apply: a run that closes its eyes to
            hard pixels is scored on them all the same.
        lpips: a learned distance of images; None leaves it out.
    """

    def __init__(
        self, gaussians: Gaussians, rasterizer: Rasterizer, depth: DepthConfig, lpips: ImageDistance | None = None
    ) -> None:
        self._gaussians = gaussians.detached()
        self._rasterizer = rasterizer
        self._depth = replace(depth, edge_filter=0.0)
        self._lpips = lpips

    def view(self, frame: RgbdFrame) -> View:
        """The frame's images, with the depth readings that count."""
        return View.from_frame(frame, self._depth).to(self._gaussians.means.device)

    def render(self, frame: RgbdFrame, T_world_cam: NDArray[np.float64]) -> Render:
        """The map from a pose, in the frame's camera."""
        T_cam_world = pose_tensor(se3.inverse(T_world_cam), self._gaussians.means.device)
        with torch.no_grad():
            return self._rasterizer.render(self._gaussians, frame.camera, T_cam_world)

    def score(self, frame: RgbdFrame, T_world_cam: NDArray[np.float64]) -> FrameScores:
        """How the map at a pose matches the frame taken there."""
        render, view = self.render(frame, T_world_cam), self.view(frame)
        scores = score_view(render.rgb, render.depth(), view.rgb, view.depth, view.valid, self._lpips)
        original = original_scores(render, view.rgb, torch.from_numpy(frame.depth_m).to(view.depth.device), self._lpips)
        holes = view.valid & (render.silhouette <= HOLE_SILHOUETTE)
        return FrameScores(frame.stamp_ns, scores, original, float(holes.float().mean()))


def score_view(
    rendered: Tensor, rendered_depth_m: Tensor, rgb: Tensor, depth_m: Tensor, mask: Tensor,
    lpips: ImageDistance | None = None,
) -> ImageScores:  # fmt: skip
    """Compare a render with what the camera saw.

    Args:
        rendered: [3, H, W] colour; clamped to [0, 1] here.
        rendered_depth_m: [H, W] expected depth, 0 where nothing was rendered.
        rgb: [3, H, W] in [0, 1].
        depth_m: [H, W].
        mask: [H, W] bool, where there is a depth reading.
        lpips: a learned distance of images; None leaves it out.
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
    """Compare as SplaTAM's ``eval_helpers.py`` does (read at commit da6bbcd; restated, not copied).

    Args:
        render: the map at the pose.
        rgb: [3, H, W] in [0, 1].
        reading_m: [H, W] the sensor's depth, in its whole range; 0 = no reading.
        lpips: a learned distance of images; None leaves it out.
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
    """Each score's mean over the frames that have it; None where none does."""
    return _means(ImageScores, [frame.scores for frame in frames])


def mean_original_scores(frames: Iterable[FrameScores]) -> OriginalScores:
    """The same, as the original counts."""
    return _means(OriginalScores, [frame.original for frame in frames])


def _means(kind: type[Scores], scores: list[Scores]) -> Scores:
    return kind(*(_mean([getattr(entry, field.name) for entry in scores]) for field in fields(kind)))


def _psnr(mean_squared_error: Tensor) -> float:
    return float(-10 * torch.log10(mean_squared_error.clamp(min=MIN_SQUARED_ERROR)))


def _mean(values: list[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None
