"""Alignment's operations in torch against the native ones, and the whole tracker by either."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest
import torch

from splatam_core import _native
from splatam_core.config import AlignmentConfig, TrackingConfig, load_config
from splatam_core.datasets.synthetic import SyntheticSequence
from splatam_core.device import HOST
from splatam_core.geometry import se3
from splatam_core.images.view import View
from splatam_core.rasterizer import make_rasterizer
from splatam_core.slam import Slam
from splatam_core.tracking import AlignmentTracker, TorchAligner, make_tracker
from splatam_core.tracking.verdict import verify

EDGE = 0.05
Image = np.ndarray
TWIST = np.array([0.01, -0.02, 0.01, 0.003, 0.005, -0.004])
VELOCITY = np.array([0.02, 0.01, -0.01, 0.01, 0.02, 0.003], np.float32)


def _picture(seed: int, size: tuple[int, int]) -> tuple[Image, Image]:
    """Smooth brightness; smooth depth with holes and steps."""
    rng, (height, width) = np.random.default_rng(seed), size
    brightness = cv2.GaussianBlur(rng.random((height, width)).astype(np.float32), (7, 7), 2)
    depth = 2 + cv2.GaussianBlur(rng.random((height, width)).astype(np.float32), (9, 9), 3)
    depth[:, width // 2 :] += 0.6
    depth[rng.random((height, width)) < 0.03] = np.nan
    return brightness, depth.astype(np.float32)


def _tensors(*images: Image) -> list[torch.Tensor]:
    return [torch.from_numpy(image) for image in images]


@pytest.mark.parametrize('size', [(48, 65), (37, 40), (2, 2), (1, 5)])
def test_layers_and_halving_are_the_native_ones(size: tuple[int, int]) -> None:
    """Bit for bit: there is one order of the few operations."""
    picture = _picture(1, size)
    native, ours = _native.Aligner(1), TorchAligner()
    expected, found = native.layers(*picture, EDGE), ours.layers(*_tensors(*picture), EDGE).numpy()
    assert np.array_equal(expected[..., :6], found, equal_nan=True)
    if min(size) > 1:
        for half, expected_half in zip(ours.halve(*_tensors(*picture), EDGE), native.halve(*picture, EDGE), strict=True):
            assert np.allclose(half.numpy(), expected_half, rtol=1e-6, equal_nan=True)


@pytest.mark.parametrize('lag', [0.0, 0.3])
@pytest.mark.parametrize('size', [(48, 65), (120, 160)])
def test_linear_system_is_the_native_one(size: tuple[int, int], lag: float) -> None:
    """With NaN depth, steps, another exposure, and colour that lags.

    Sums of float32 against sums of doubles over up to 19 200 pixels: 1e-5 of the largest entry. Counts may differ by the few
    points that fall on a limit, and medians by a bin (an eighth of an octave) where so many lie around its edge.
    """
    reference, frame = _picture(2, size), _picture(3, size)
    frame = 1.1 * reference[0] + 0.2 * frame[0], np.float32(0.5) * (reference[1] + frame[1])
    native, ours = _native.Aligner(1), TorchAligner()
    motion = se3.exp(TWIST)
    light = (se3.exp(lag * VELOCITY.astype(np.float64)) @ motion).astype(np.float32)
    camera = 0.9 * size[1], 0.91 * size[1], size[1] / 2 - 0.4, size[0] / 2 - 0.6
    numbers = (*camera, light, motion.astype(np.float32), VELOCITY, 1.05, -0.02, 0.03, 0.01, 0.1, 0.2, 0.1)
    expected = native.linearize(*reference, native.layers(*frame, EDGE), *numbers)
    found = ours.linearize(*_tensors(*reference), ours.layers(*_tensors(*frame), EDGE), *numbers)
    for a, b in zip(found[:2], expected[:2], strict=True):
        assert np.abs(a - b).max() < 1e-5 * np.abs(b).max()
    assert found[2] == pytest.approx(expected[2], rel=1e-4)
    assert found[3] == expected[3]
    assert np.abs(np.subtract(found[4:7], expected[4:7])).max() <= 2 and found[5] > 0.3 * found[3]
    assert found[7:] == pytest.approx(expected[7:], rel=0.13)


def test_nothing_in_sight_gives_an_empty_system() -> None:
    """No points, or none that fall into the frame: zeros, and medians that are NaN."""
    brightness, depth = _picture(4, (40, 50))
    ours, away = TorchAligner(), se3.exp(np.array([50.0, 0, 0, 0, 0, 0])).astype(np.float32)
    still = np.eye(4, dtype=np.float32)
    for motion, z in ((away, depth), (still, np.full_like(depth, np.nan))):
        tensors = _tensors(brightness, z)
        layers = ours.layers(*_tensors(brightness, depth), EDGE)
        numbers = (45.0, 45.0, 24.0, 19.0, motion, motion, VELOCITY, 1.0, 0.0, 0.03, 0.01, 0.1, 0.2, 0.1)
        H, g, cost, points, compared, seen, agreeing, *medians = ours.linearize(*tensors, layers, *numbers)
        assert not H.any() and not g.any() and cost == 0
        assert points == (z > 0).sum() and compared == seen == agreeing == 0
        assert np.isnan(medians).all()


@pytest.mark.parametrize(('lag', 'half_render_from'), [(True, 0), (False, 160)])
def test_tracker_finds_the_same_pose_by_either(
    lag: bool, half_render_from: int, room: Callable[..., SyntheticSequence], monkeypatch: pytest.MonkeyPatch
) -> None:
    """To 0.2 mm, a fiftieth of a pixel here: Gauss-Newton amplifies the rounding of points on the border a little."""
    sequence = room(3, 160)
    slam = Slam(load_config('quick', ['threads=1', 'device=cpu']))
    for index in range(2):
        slam.process(sequence[index])
    config = TrackingConfig(method='align', iterations=6, align=AlignmentConfig(time_offset=lag, half_render_from=half_render_from))
    view = View.from_frame(sequence[2], slam.config.depth)
    truth = sequence.ground_truth().T_world_cam
    before, guess = (se3.inverse(truth[index]) @ truth[0] for index in (0, 1))
    results = []
    for aligner in (_native.Aligner(1), TorchAligner()):
        tracker = make_tracker(make_rasterizer('cpu', 1), config, 1, HOST)
        assert isinstance(tracker, AlignmentTracker)
        monkeypatch.setattr(tracker, '_aligner', _Bridge(aligner) if isinstance(aligner, TorchAligner) else aligner)
        results.append(tracker.track(view, slam.map.gaussians, guess, before))
    native, ours = results
    assert not verify(native, config) and not verify(ours, config)
    assert np.abs(native.T_cam_world - ours.T_cam_world).max() < 2e-4
    assert np.abs(native.T_cam_world_depth - ours.T_cam_world_depth).max() < 2e-4
    assert ours.inlier_fraction == pytest.approx(native.inlier_fraction, abs=0.01)


class _Bridge:
    """The aligner in torch for pictures in numpy's arrays."""

    def __init__(self, aligner: TorchAligner) -> None:
        self._aligner = aligner

    def layers(self, brightness: Image, depth: Image, max_step: float) -> Image:
        return self._aligner.layers(*_tensors(brightness, depth), max_step).numpy()

    def halve(self, brightness: Image, depth: Image, max_step: float) -> tuple[Image, ...]:
        return tuple(image.numpy() for image in self._aligner.halve(*_tensors(brightness, depth), max_step))

    def linearize(self, brightness: Image, depth: Image, layers: Image, *numbers: object) -> tuple:
        return self._aligner.linearize(*_tensors(brightness, depth, layers), *numbers)
