"""MS-SSIM by hand and against the library the original uses."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from splatam_core.evaluation.similarity import MIN_SIDE, ms_ssim


def noisy_pair(height: int, width: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    image = torch.nn.functional.avg_pool2d(torch.rand(3, height, width, generator=generator), 3, 1, 1)
    return image, image + 0.2 * torch.rand(3, height, width, generator=generator) - 0.1


def test_identical_images_are_one() -> None:
    image, _ = noisy_pair(180, 240)
    assert ms_ssim(image, image) == pytest.approx(1, abs=1e-6)


def test_flat_images_differ_in_luminance_at_the_coarsest_scale_only() -> None:
    a, b, c1 = 0.4, 0.6, 0.01**2
    luminance = (2 * a * b + c1) / (a * a + b * b + c1)
    flat = [torch.full((3, 176, 192), level) for level in (a, b)]  # halved four times without a rest: 11x12
    # Variances of flat images are round-off, 1e-8 of c2 = 9e-4.
    assert ms_ssim(*flat) == pytest.approx(luminance**0.1333, abs=1e-4)


@pytest.mark.parametrize('size', [(161, 161), (203, 178), (240, 320)])  # odd sizes are padded when halved
def test_as_the_library_that_the_original_uses(size: tuple[int, int]) -> None:
    library = pytest.importorskip('pytorch_msssim')
    a, b = noisy_pair(*size)
    expected = float(library.ms_ssim(a[None], b[None], data_range=1.0))
    assert ms_ssim(a, b) == pytest.approx(expected, abs=1e-5)  # windows agree to 32 bits, variances to their differences


def test_too_small_is_no_score() -> None:
    assert ms_ssim(*noisy_pair(MIN_SIDE - 1, 400)) is None
