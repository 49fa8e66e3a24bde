"""Image metrics against values worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from splatam_core.config import DepthConfig
from splatam_core.evaluation.images import FrameScores, ViewScorer, mean_scores, original_scores, score_view
from splatam_core.geometry import se3
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.rasterizer import Gaussians, Render, make_rasterizer
from splatam_core.runs.metrics import ImageScores
from splatam_core.types import RgbdFrame

ROUND_OFF_DB = 1e-4  # 32-bit colours around 0.5
H, W = 40, 60
LEFT_QUARTER = torch.zeros(H, W, dtype=torch.bool)
LEFT_QUARTER[:, : W // 4] = True
EVERYWHERE = torch.ones(H, W, dtype=torch.bool)


def gray(level: float) -> Tensor:
    return torch.full((3, H, W), level)


def depth(metres: float) -> Tensor:
    return torch.full((H, W), float(metres))


def test_identical_is_perfect_and_finite() -> None:
    rgb = torch.rand(3, H, W, generator=torch.Generator().manual_seed(0))
    scores = score_view(rgb, depth(2), rgb, depth(2), EVERYWHERE)
    assert scores == ImageScores(pytest.approx(100), pytest.approx(1), 0, pytest.approx(100), depth_rmse_m=0)


def test_psnr_of_a_known_offset() -> None:
    scores = score_view(gray(0.6), depth(2), gray(0.5), depth(2), EVERYWHERE)
    assert scores.psnr_db == pytest.approx(20, abs=ROUND_OFF_DB)  # 10 log10(1 / 0.1^2)


def test_pixels_without_a_reading_count_neither_as_good_nor_as_bad() -> None:
    rendered = gray(0.5)
    rendered[:, LEFT_QUARTER] += 0.1
    inside = score_view(rendered, depth(2), gray(0.5), depth(2), LEFT_QUARTER)
    outside = score_view(rendered, depth(2), gray(0.5), depth(2), ~LEFT_QUARTER)
    assert inside.psnr_db == pytest.approx(20, abs=ROUND_OFF_DB)
    assert outside.psnr_db == pytest.approx(100)
    # Whole image: the same squared error over four times the pixels.
    assert inside.psnr_full_db == outside.psnr_full_db == pytest.approx(20 + 10 * math.log10(4), abs=ROUND_OFF_DB)


def test_all_channels_enter() -> None:
    rendered = gray(0.5)
    rendered[1] += 0.1
    scores = score_view(rendered, depth(2), gray(0.5), depth(2), EVERYWHERE)
    assert scores.psnr_db == pytest.approx(20 + 10 * math.log10(3), abs=ROUND_OFF_DB)


def test_render_is_clamped() -> None:
    assert score_view(gray(1.7), depth(2), gray(1.0), depth(2), EVERYWHERE).psnr_db == pytest.approx(100)
    assert score_view(gray(-0.3), depth(2), gray(0.0), depth(2), EVERYWHERE).psnr_db == pytest.approx(100)


def test_depth_l1_counts_holes_of_the_render_in_full() -> None:
    rendered = depth(2.1)
    rendered[LEFT_QUARTER] = 0  # nothing rendered there
    scores = score_view(gray(0.5), rendered, gray(0.5), depth(2), EVERYWHERE)
    assert scores.depth_l1_m == pytest.approx(0.25 * 2.0 + 0.75 * 0.1, abs=1e-6)


def test_depth_l1_leaves_out_pixels_without_a_reading() -> None:
    reading = depth(2)
    reading[LEFT_QUARTER] = 0
    scores = score_view(gray(0.5), depth(2.1), gray(0.5), reading, ~LEFT_QUARTER)
    assert scores.depth_l1_m == pytest.approx(0.1, abs=1e-6)


def test_ssim_of_flat_images_is_the_luminance_term() -> None:
    a, b, c1 = 0.4, 0.6, 0.01**2
    interior = torch.zeros(H, W, dtype=torch.bool)
    interior[5:-5, 5:-5] = True  # where the 11x11 window does not reach the padding
    expected = (2 * a * b + c1) / (a * a + b * b + c1)
    assert score_view(gray(a), depth(2), gray(b), depth(2), interior).ssim == pytest.approx(expected, abs=1e-3)


def test_ssim_is_averaged_over_readings_only() -> None:
    generator = torch.Generator().manual_seed(0)
    rgb = torch.rand(3, H, W, generator=generator)
    noisy = rgb.clone()
    noisy[:, :, W // 2 :] = torch.rand(3, H, W // 2, generator=generator)
    left = score_view(noisy, depth(2), rgb, depth(2), LEFT_QUARTER)  # 15 px from the noise: its window sees none
    assert left.ssim == pytest.approx(1, abs=1e-5)
    assert score_view(noisy, depth(2), rgb, depth(2), ~LEFT_QUARTER).ssim < 0.7


def test_no_reading_at_all_is_not_a_score() -> None:
    scores = score_view(gray(0.6), depth(2), gray(0.5), depth(0), ~EVERYWHERE)
    assert (scores.psnr_db, scores.ssim, scores.depth_l1_m) == (None, None, None)
    assert scores.psnr_full_db == pytest.approx(20, abs=ROUND_OFF_DB)


def test_means_are_over_the_frames_that_have_a_score() -> None:
    frames = [FrameScores(0, ImageScores(20, 0.5, 0.1, 10)), FrameScores(1, ImageScores(None, None, None, 30))]
    assert mean_scores(frames) == ImageScores(20, 0.5, 0.1, 20)
    assert mean_scores([]) == ImageScores(None, None, None, None)


def test_depth_rmse_by_hand() -> None:
    rendered = depth(2.1)
    rendered[:, : W // 2] = 2.3
    scores = score_view(gray(0.5), rendered, gray(0.5), depth(2), EVERYWHERE)
    assert scores.depth_l1_m == pytest.approx(0.2, abs=1e-6)
    assert scores.depth_rmse_m == pytest.approx(math.sqrt((0.1**2 + 0.3**2) / 2), abs=1e-6)


def test_whole_image_scores_come_from_the_distance_given() -> None:
    scores = score_view(gray(0.9), depth(2), gray(0.5), depth(2), LEFT_QUARTER, lpips=lambda a, b: float((a - b).max()))
    assert scores.lpips == pytest.approx(0.4)
    assert scores.ms_ssim is None  # 60x40 is too small


# --- as the original counts ---


def seen(rgb: Tensor, depth_acc: Tensor, silhouette: float = 1.0) -> Render:
    return Render(rgb, depth_acc, torch.full((H, W), silhouette))


def test_the_original_counts_masked_pixels_as_perfect() -> None:
    reading = torch.where(LEFT_QUARTER, 2.0, 0.0)
    original = original_scores(seen(gray(0.6), depth(2)), gray(0.5), reading)
    # The squared error of a quarter of the pixels, over all of them.
    assert original.psnr_db == pytest.approx(20 + 10 * math.log10(4), abs=ROUND_OFF_DB)
    honest = score_view(gray(0.6), depth(2), gray(0.5), reading, LEFT_QUARTER)
    assert honest.psnr_db == pytest.approx(20, abs=ROUND_OFF_DB)


def test_the_original_averages_the_channels_psnr_and_does_not_clamp() -> None:
    rendered = torch.stack([depth(1.1), depth(1.01), depth(1.001)])  # too bright by 0.1, 0.01, 0.001
    original = original_scores(seen(rendered, depth(2)), gray(1.0), depth(2))
    assert original.psnr_db == pytest.approx((20 + 40 + 60) / 3, abs=1e-2)  # 0.001 of 1 keeps four digits in 32 bits
    assert score_view(rendered, depth(2), gray(1.0), depth(2), EVERYWHERE).psnr_db == pytest.approx(100)


def test_the_original_s_depth_is_not_divided_by_the_silhouette() -> None:
    render = seen(gray(0.5), depth(0.9 * 2.0), silhouette=0.9)  # exactly at 2 m, but a tenth is seen through
    assert original_scores(render, gray(0.5), depth(2)).depth_l1_m == pytest.approx(0.2, abs=1e-6)
    assert score_view(gray(0.5), render.depth(), gray(0.5), depth(2), EVERYWHERE).depth_l1_m == pytest.approx(0, abs=1e-6)


def test_the_original_s_scores_without_a_reading() -> None:
    original = original_scores(seen(gray(0.6), depth(2)), gray(0.5), depth(0))
    assert original.psnr_db == pytest.approx(100) and original.depth_l1_m is None  # two black images


CAMERA = PinholeCamera(W, H, 50, 50, W / 2, H / 2)


def wall(distance_m: float = 2.0) -> Gaussians:
    """A coloured wall across the view, one opaque Gaussian a pixel."""
    v, u = torch.meshgrid(torch.arange(H * 2.0) - H / 2, torch.arange(W * 2.0) - W / 2, indexing='ij')
    x, y = (u - CAMERA.cx) / CAMERA.fx * distance_m, (v - CAMERA.cy) / CAMERA.fy * distance_m
    means = torch.stack([x, y, torch.full_like(x, distance_m)], dim=-1).reshape(-1, 3)
    rgb = 0.5 + 0.4 * torch.sin(means @ torch.tensor([[9.0, 3, 1], [2, 8, 4], [0, 0, 0]]))
    return Gaussians(means, torch.full((len(means), 1), math.log(0.04)), torch.full((len(means),), 5.0), rgb)


def test_a_map_is_scored_at_the_pose_given() -> None:
    gaussians, here = wall(), np.eye(4)
    there = se3.exp(np.array([0.2, 0.1, 0, 0, 0, 0.1]))
    rasterizer = make_rasterizer('cpu', 1)
    render = rasterizer.render(gaussians, CAMERA, torch.from_numpy(se3.inverse(there)).float())
    rgb = (render.rgb.clamp(0, 1) * 255).round().byte().permute(1, 2, 0).contiguous().numpy()
    frame = RgbdFrame(5, rgb, render.depth().numpy(), CAMERA)
    scorer = ViewScorer(gaussians, rasterizer, DepthConfig())
    right, wrong = scorer.score(frame, there), scorer.score(frame, here)
    assert right.stamp_ns == 5
    # Rounding to 8 bits alone: error uniform in half a step, 10 log10(12 * 255^2) = 58.9 dB.
    assert right.scores.psnr_db == pytest.approx(58.9, abs=0.5)
    assert right.scores.depth_l1_m == pytest.approx(0, abs=1e-6)
    assert wrong.scores.psnr_db < 20 and wrong.scores.ssim < right.scores.ssim


def test_depth_out_of_range_is_no_reading_but_an_edge_is() -> None:
    depth_m = np.full((H, W), 2, np.float32)
    depth_m[:10], depth_m[10:20], depth_m[20:30] = 0.0, 9.0, 0.1
    frame = RgbdFrame(0, np.zeros((H, W, 3), np.uint8), depth_m, CAMERA)
    scorer = ViewScorer(wall(), make_rasterizer('cpu', 1), DepthConfig(min_m=0.2, max_m=5.0, edge_filter=0.05))
    assert scorer.view(frame).valid.numpy().tolist() == (depth_m == 2).tolist()


def test_holes_are_readings_without_map() -> None:
    """The camera turned round sees nothing of the map: every pixel with a reading, half of them, is a hole."""
    scorer = ViewScorer(wall(), make_rasterizer('cpu', 1), DepthConfig())
    depth_m = np.full((H, W), 2, np.float32)
    depth_m[: H // 2] = 0
    frame = RgbdFrame(0, np.zeros((H, W, 3), np.uint8), depth_m, CAMERA)
    away = scorer.score(frame, se3.exp(np.array([0, 0, 0, 0, np.pi, 0])))
    assert away.hole_share == pytest.approx(0.5) and away.has_holes
    assert not scorer.score(frame, np.eye(4)).has_holes
