"""Filters in torch against those of OpenCV, which the host uses."""

from __future__ import annotations

import pytest
import torch

from splatam_core.images import filters

GENERATOR = torch.Generator().manual_seed(0)


def _random(*size: int) -> torch.Tensor:
    return torch.rand(*size, generator=GENERATOR)


@pytest.mark.parametrize('size', [(48, 64), (33, 21), (5, 3)])
def test_blur_and_box_equal_opencvs(size: tuple[int, int]) -> None:
    """To float32 sums of 121 and of 25 terms up to 1."""
    images = _random(3, *size)
    assert torch.allclose(filters.blurred_by_torch(images), filters.blurred(images), atol=1e-6)
    assert torch.allclose(filters.box_sums_by_torch(images[0], 5), filters.box_sums(images[0], 5), atol=1e-5)


@pytest.mark.parametrize(('width', 'height'), [(32, 24), (35, 26), (61, 47), (64, 48), (1, 1)])
def test_resizing_equals_opencvs(width: int, height: int) -> None:
    """Depth is exact; colours may differ by 1 of 255, because ties are rounded differently."""
    rgb8 = torch.randint(0, 256, (48, 64, 3), generator=GENERATOR, dtype=torch.uint8)
    depth = _random(48, 64)
    difference = filters.shrunk_by_torch(rgb8, width, height).int() - filters.shrunk(rgb8, width, height).int()
    assert difference.abs().max() <= 1 and (difference != 0).float().mean() < 0.2
    assert torch.equal(filters.nearest_by_torch(depth, width, height), filters.nearest(depth, width, height))


@pytest.mark.parametrize(('reach', 'margin'), [(1, 0), (3, 2), (8, 2)])
def test_closing_equals_opencvs(reach: int, margin: int) -> None:
    mask = _random(33, 47) < 0.01
    mask[:, :9] = False
    closed = filters.closed(mask, reach, margin)
    assert torch.equal(filters.closed_by_torch(mask, reach, margin), closed) and (closed >= mask).all()
    assert filters.closed(torch.ones(4, 5, dtype=torch.bool), reach, margin).all()


def test_holes_are_closed_and_edges_stay_where_they_are() -> None:
    mask = torch.zeros(20, 60, dtype=torch.bool)
    mask[:, :10] = mask[:, 15:30] = True  # a hole of 5 pixels, and an edge
    closed = filters.closed(mask, 3, 2)[10]
    assert closed[:32].all() and not closed[32:].any()


@pytest.mark.parametrize('share', [0.0, 0.001, 0.5, 1.0])
def test_median_is_torchs_own_of_what_counts(share: float) -> None:
    values, counts = _random(40, 50), _random(40, 50) < share
    for median in (filters.median, filters.median_by_torch):
        found = median(values, counts)
        assert found.dim() == 0
        assert torch.equal(found, values[counts].median()) if counts.any() else torch.isnan(found)


def test_luminance_is_opencvs() -> None:
    """Of 8 bits and of floats: the weights of BT.601."""
    import cv2

    rgb8 = torch.randint(0, 256, (7, 9, 3), generator=GENERATOR, dtype=torch.uint8)
    expected = torch.from_numpy(cv2.cvtColor(rgb8.numpy().astype('float32') / 255, cv2.COLOR_RGB2GRAY))
    assert torch.allclose(filters.brightness(rgb8), expected, atol=1e-6)
