"""Losses: values worked out by hand, gradients against finite differences."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from splatam_core.config import MappingConfig, PaperMappingConfig, PaperTrackingConfig, TrackingConfig
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.images.ssim import ssim_map
from splatam_core.images.view import View
from splatam_core.mapping.loss import mapping_loss
from splatam_core.rasterizer import Render
from splatam_core.tracking.loss import tracking_loss

CAMERA = PinholeCamera(6, 4, 5.0, 5.0, 3.0, 2.0)
L1 = MappingConfig(paper=PaperMappingConfig(ssim_weight=0.0))
GRAY = torch.full((4, 6, 3), 102, dtype=torch.uint8)  # 0.4


def _view() -> View:
    depth = torch.full((4, 6), 2.0)
    depth[0] = 0.0
    return View(CAMERA, GRAY, depth)


def _render(rgb: float, depth: float, silhouette: torch.Tensor) -> Render:
    return Render(torch.full((3, 4, 6), rgb), torch.full((4, 6), depth), silhouette)


def test_tracking_loss_sums_where_the_map_is_sure_and_depth_is_read() -> None:
    silhouette = torch.zeros(4, 6)
    silhouette[:, :3] = 1.0
    loss = tracking_loss(_render(0.5, 2.3, silhouette), _view(), TrackingConfig())
    pixels = 3 * 3  # three opaque columns, three rows with depth
    assert loss.num_pixels == pixels
    assert float(loss.total) == pytest.approx(pixels * (1.0 * 0.3 + 0.5 * 3 * 0.1), rel=1e-5)


def test_tracking_loss_without_the_silhouette_takes_colour_from_everywhere() -> None:
    render = _render(0.5, 2.3, torch.ones(4, 6))
    render.silhouette[:, :3] = 0.6  # below the threshold
    loss = tracking_loss(render, _view(), TrackingConfig(paper=PaperTrackingConfig(use_silhouette=False)))
    assert loss.num_pixels == 3 * 6  # three rows with depth
    depth = 3 * 3 * (0.3 + 2.3 / 0.6 - 2.0)
    assert float(loss.depth) == pytest.approx(depth, rel=1e-5)
    assert float(loss.total) == pytest.approx(depth + 0.5 * 4 * 6 * 3 * 0.1, rel=1e-5)


def test_blended_depth_is_short_where_the_map_is_thin() -> None:
    """At a silhouette of 0.6 the sum of w z is 0.6 of the depth."""
    render = _render(0.4, 0.6 * 2.0, torch.full((4, 6), 0.6))
    losses = [
        tracking_loss(render, _view(), TrackingConfig(silhouette_threshold=0.5, paper=PaperTrackingConfig(blended_depth=b)))
        for b in (False, True)
    ]
    assert [float(loss.depth) for loss in losses] == pytest.approx([0.0, 18 * 0.8], abs=1e-5)


def test_losses_leave_out_outliers_of_depth() -> None:
    """One pixel 100 times as far off as the median, which is that of the readings alone."""
    render, view = _render(0.5, 2.1, torch.ones(4, 6)), _view()
    render.depth_acc[3, 5] = 12.0
    render.rgb[:, 3, 5] = 0.4
    tracked = [
        tracking_loss(render, view, TrackingConfig(paper=PaperTrackingConfig(depth_outlier_ratio=ratio))) for ratio in (0.0, 10.0)
    ]
    assert [loss.num_pixels for loss in tracked] == [18, 17]
    assert [float(loss.depth) for loss in tracked] == pytest.approx([17 * 0.1 + 10.0, 17 * 0.1], rel=1e-5)
    mapped = [
        mapping_loss(
            render, view, MappingConfig(color_weight=0.0, paper=PaperMappingConfig(ssim_weight=0.0, depth_outlier_ratio=ratio))
        )
        for ratio in (0.0, 10.0)
    ]
    assert [float(loss) for loss in mapped] == pytest.approx([(17 * 0.1 + 10.0) / 18, 0.1], rel=1e-5)
    blind = View(CAMERA, GRAY, torch.zeros(4, 6))
    assert float(tracking_loss(render, blind, TrackingConfig(paper=PaperTrackingConfig(depth_outlier_ratio=10.0))).total) == 0.0


def test_mapping_loss_means_depth_over_readings_and_colour_over_all() -> None:
    loss = mapping_loss(_render(0.5, 2.3, torch.zeros(4, 6)), _view(), L1)
    assert float(loss) == pytest.approx(0.3 + 0.5 * 0.1, rel=1e-5)


def test_mapping_loss_of_a_view_without_depth_is_the_colour_loss() -> None:
    depth = torch.zeros(4, 6)
    view = View(CAMERA, GRAY, depth)
    loss = mapping_loss(_render(0.5, 2.3, torch.zeros(4, 6)), view, L1)
    assert float(loss) == pytest.approx(0.05, rel=1e-5)


def test_ssim_of_equal_images_is_one_and_falls_with_noise() -> None:
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(3, 40, 30, generator=generator)
    noise = torch.randn(3, 40, 30, generator=generator)
    torch.testing.assert_close(ssim_map(image, image), torch.ones(3, 40, 30))
    means = [float(ssim_map(image, image + level * noise).mean()) for level in (0.05, 0.1, 0.3)]
    assert 1 > means[0] > means[1] > means[2] > 0


def test_ssim_by_hand_in_the_middle_of_an_image() -> None:
    """One pixel's value from its definition: Gaussian-weighted means, variances and covariance."""
    rng = np.random.default_rng(1)
    a, b = rng.random((2, 21, 21))
    offsets = np.arange(11) - 5
    window = np.exp(-(offsets[:, None] ** 2 + offsets[None] ** 2) / (2 * 1.5**2))
    window /= window.sum()
    pa, pb = a[5:16, 5:16], b[5:16, 5:16]
    mean_a, mean_b = (window * pa).sum(), (window * pb).sum()
    var_a, var_b = (window * pa**2).sum() - mean_a**2, (window * pb**2).sum() - mean_b**2
    covariance = (window * pa * pb).sum() - mean_a * mean_b
    expected = (2 * mean_a * mean_b + 1e-4) * (2 * covariance + 9e-4)
    expected /= (mean_a**2 + mean_b**2 + 1e-4) * (var_a + var_b + 9e-4)
    stack = lambda image: torch.from_numpy(np.stack([image] * 3))  # noqa: E731
    assert float(ssim_map(stack(a), stack(b))[0, 10, 10]) == pytest.approx(expected, rel=1e-9)


def test_ssim_gradients() -> None:
    """Central differences in float64; 1e-5 is what a step of 1e-6 resolves."""
    generator = torch.Generator().manual_seed(2)
    a = torch.rand(3, 14, 13, generator=generator, dtype=torch.float64, requires_grad=True)
    b = torch.rand(3, 14, 13, generator=generator, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda image: ssim_map(image, b), (a,), eps=1e-6, atol=1e-5)
