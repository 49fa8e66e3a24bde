"""Both aligners, native and torch: the same results, and the same pose from the tracker with either."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from splatam_core.config import AlignmentConfig, TrackingConfig, load_config
from splatam_core.datasets.synthetic import SyntheticSequence
from splatam_core.device import HOST
from splatam_core.geometry import se3
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.images.view import View
from splatam_core.rasterizer import make_rasterizer
from splatam_core.rasterizer.cpu import CpuRasterizer
from splatam_core.rasterizer.native import make_native_aligner
from splatam_core.slam import Slam
from splatam_core.tracking import TorchAligner, alignment, make_tracker
from splatam_core.tracking.aligner import AlignmentState, Descent, EvidenceSums, Knowns, Linearization
from splatam_core.tracking.descent import descend
from splatam_core.tracking.evidence import Evidence, Sums, step_of, weigh
from splatam_core.tracking.pace import Pace
from splatam_core.tracking.torch_aligner import TorchLinearSystem
from splatam_core.tracking.verdict import verify

EDGE = 0.05
INLIERS = {'inlier_color': 0.2, 'inlier_depth': 0.1}
Image = np.ndarray
TWIST = np.array([0.01, -0.02, 0.01, 0.003, 0.005, -0.004])
VELOCITY = np.array([0.02, 0.01, -0.01, 0.01, 0.02, 0.003], np.float32)
AT_ONCE, ROLLING = np.zeros(6, np.float32), np.array([0.01, -0.02, 0.01, 0.04, 0.05, -0.03], np.float32)


def _picture(seed: int, size: tuple[int, int]) -> tuple[Image, Image]:
    """Smooth brightness; smooth depth with holes and steps."""
    rng, (height, width) = np.random.default_rng(seed), size
    brightness = cv2.GaussianBlur(rng.random((height, width)).astype(np.float32), (7, 7), 2)
    depth = 2 + cv2.GaussianBlur(rng.random((height, width)).astype(np.float32), (9, 9), 3)
    depth[:, width // 2 :] += 0.6
    depth[rng.random((height, width)) < 0.03] = np.nan
    return brightness, depth.astype(np.float32)


def _camera(size: tuple[int, int]) -> PinholeCamera:
    height, width = size
    return PinholeCamera(width, height, 0.9 * width, 0.91 * width, width / 2 - 0.4, height / 2 - 0.6)


def _settings(
    color_motion: np.ndarray, depth_motion: np.ndarray, gain: float = 1.0, bias: float = 0.0, readout: np.ndarray = AT_ONCE
) -> dict[str, Any]:
    """The fields of a ``Linearization`` but images and camera."""
    return {
        'color_motion': color_motion.astype(np.float32), 'depth_motion': depth_motion.astype(np.float32), 'velocity': VELOCITY,
        'gain': gain, 'bias': bias, 'photometric_scale': 0.03, 'depth_scale': 0.01, 'max_depth_ratio': 0.1, 'readout': readout,
    }  # fmt: skip


def _at(images: Sequence[Any], layers: Any, **settings: Any) -> Linearization[Any]:
    brightness, depth = images
    return Linearization(brightness=brightness, depth=depth, layers=layers, **settings)


def _tensors(*images: Image) -> list[torch.Tensor]:
    return [torch.from_numpy(image) for image in images]


def _on_device(at: Linearization[Any]) -> Linearization[Any]:
    return at.converted(torch.from_numpy)


def _task_on_device(task: Descent[Any]) -> Descent[Any]:
    brightness, depth, layers = _tensors(task.brightness, task.depth, np.ascontiguousarray(task.layers[..., :6]))
    return replace(task, brightness=brightness, depth=depth, layers=layers)


@pytest.mark.parametrize('size', [(48, 65), (37, 40), (2, 2), (1, 5)])
def test_layers_and_halving_are_the_native_ones(size: tuple[int, int]) -> None:
    """Bit for bit: there is one order of the few operations."""
    picture = _picture(1, size)
    native, ours = make_native_aligner(1), TorchAligner()
    expected, found = native.layers(*picture, EDGE), ours.layers(*_tensors(*picture), EDGE).numpy()
    assert np.array_equal(expected[..., :6], found, equal_nan=True)
    if min(size) > 1:
        for half, expected_half in zip(ours.halve(*_tensors(*picture), EDGE), native.halve(*picture, EDGE), strict=True):
            assert np.allclose(half.numpy(), expected_half, rtol=1e-6, equal_nan=True)


@pytest.mark.parametrize('threshold', [0.3, 0.9])
def test_images_of_frames_and_renders_are_the_native_ones(threshold: float) -> None:
    """Frames with holes that are zero or negative; renders whose silhouette is 0, below a half, and above the threshold."""
    rng, native, ours = np.random.default_rng(5), make_native_aligner(2), TorchAligner()
    rgb8 = rng.integers(0, 256, (35, 41, 3), np.uint8)
    depth = _picture(6, (35, 41))[1]
    depth[rng.random(depth.shape) < 0.2] = 0
    depth[10] = -1
    silhouette = rng.random((35, 41), dtype=np.float32)
    silhouette[3] = 0
    drawn = rng.random((3, 35, 41), dtype=np.float32), np.float32(2) * silhouette, silhouette
    for of_torch, expected in (
        (ours.frame_images(*_tensors(rgb8, depth), 3, EDGE), native.frame_images(rgb8, depth, 3, EDGE)),
        (ours.render_images(*_tensors(*drawn), threshold, 1e-3), native.render_images(*drawn, threshold, 1e-3)),
    ):
        for image, expected_image in zip(of_torch, expected, strict=True):
            assert np.allclose(image.numpy(), expected_image, rtol=1e-5, equal_nan=True)  # roundings of a sum of three


@pytest.mark.parametrize('threads', [1, 3])
def test_holes_are_closed_between_readings_of_one_surface(threads: int) -> None:
    """Exactly on a tilted plane; not across a step, a wide hole or the border; by either aligner."""
    v, u = np.mgrid[:24, :40].astype(np.float32)
    plane = 1 / (0.4 + 0.004 * u + 0.002 * v)
    plane[:, 25:] *= 1.3  # a step
    depth = plane.copy()
    depth[5, 3:6] = depth[8:10, 10] = depth[12, 24:27] = depth[15, 5:17] = depth[20, :2] = np.nan
    depth[14:17, 4:18] = np.nan  # wider than four pixels, but only three high

    def filled(depth: Image) -> Image:
        return make_native_aligner(threads).frame_images(np.zeros((*depth.shape, 3), np.uint8), depth, 4, EDGE)[1]

    native = filled(depth)
    by_torch = TorchAligner().frame_images(torch.zeros(24, 40, 3, dtype=torch.uint8), torch.from_numpy(depth), 4, EDGE)[1]
    assert np.allclose(by_torch.numpy(), native, rtol=1e-6, equal_nan=True)
    closed = ~np.isnan(native)
    assert np.allclose(native[closed], plane[closed], rtol=1e-5)
    assert closed[5, 3:6].all() and closed[8:10, 10].all() and closed[14:17, 4:18].all()
    assert closed[12, 24:27].all(), 'the column bridges what the row must not'
    assert np.isnan(filled(depth[12:13])[0, 24:27]).all()
    assert np.isnan(filled(depth[20:21])[0, :2]).all()


def test_colour_is_compared_where_the_frame_has_no_depth() -> None:
    """Half of the frame without readings: all of its colour counts for the pose, and none of it for the agreement."""
    size = (48, 64)
    reference = _picture(4, size)[0], np.full(size, 2.0, np.float32)
    frame_depth = reference[1].copy()
    frame_depth[:, 32:] = np.nan
    native = make_native_aligner(1)
    settings = _settings(np.eye(4), np.eye(4)) | {'camera': _camera(size)}
    half, full = (
        native.linearize(_at(reference, native.layers(reference[0], depth, EDGE), **settings), **INLIERS)
        for depth in (frame_depth, reference[1])
    )
    assert half.compared < 0.55 * full.compared and half.seen == half.compared
    assert half.H[7, 7] == pytest.approx(full.H[7, 7], rel=0.02)  # bias: the weights of colour alone; the border differs
    assert half.H[2, 2] < 0.6 * full.H[2, 2]  # along the axis depth says most, and half of it is missing


@pytest.mark.parametrize(('time_offset', 'readout'), [(0.0, AT_ONCE), (0.3, AT_ONCE), (0.3, ROLLING)], ids=str)
@pytest.mark.parametrize('size', [(48, 65), (120, 160)])
@pytest.mark.parametrize('isa', ['generic', 'avx2', 'avx512'])
def test_linear_system_is_the_native_one(
    isa: str, size: tuple[int, int], time_offset: float, readout: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With NaN depth, steps, another exposure, a time offset, and a rolling shutter; by every instruction set there is.

    Sums of float32 against sums of doubles over up to 19 200 pixels: 1e-5 of the largest entry. Counts may differ by the few
    points that fall on a limit, and medians by a bin (an eighth of an octave) where many lie around its edge.
    """
    monkeypatch.setenv('SPLATAM_ISA', isa)
    if (runs := CpuRasterizer(1).instruction_set) != isa:
        pytest.skip(f'this processor runs {runs}, not {isa}')
    reference, frame = _picture(2, size), _picture(3, size)
    frame = 1.1 * reference[0] + 0.2 * frame[0], np.float32(0.5) * (reference[1] + frame[1])
    native, ours = make_native_aligner(1), TorchAligner()
    motion = se3.exp(TWIST)
    color_motion = se3.exp(time_offset * VELOCITY.astype(np.float64)) @ motion
    settings = _settings(color_motion, motion, gain=1.05, bias=-0.02, readout=readout) | {'camera': _camera(size)}
    expected = native.linearize(_at(reference, native.layers(*frame, EDGE), **settings), **INLIERS)
    found = ours.linearize(_at(_tensors(*reference), ours.layers(*_tensors(*frame), EDGE), **settings), **INLIERS)
    for name in ('H', 'g', 'H_by_time', 'H_by_time_squared', 'g_by_time'):
        a, b = getattr(found, name), getattr(expected, name)
        assert a.shape == b.shape and np.abs(a - b).max() < 1e-5 * np.abs(b).max()
    assert found.cost == pytest.approx(expected.cost, rel=1e-4)
    assert found.points == expected.points
    for name in ('compared', 'seen', 'agreeing'):
        assert abs(getattr(found, name) - getattr(expected, name)) <= 2
    assert found.seen > 0.3 * found.points
    assert found.photometric_median == pytest.approx(expected.photometric_median, rel=0.13)
    assert found.depth_median == pytest.approx(expected.depth_median, rel=0.13)


@pytest.mark.parametrize(('time_offset', 'readout'), [(0.0, AT_ONCE), (0.3, AT_ONCE), (0.3, ROLLING)], ids=str)
@pytest.mark.parametrize('size', [(48, 65), (120, 160), (7, 9)])
def test_evidence_is_the_native_one(size: tuple[int, int], time_offset: float, readout: np.ndarray) -> None:
    """To the rounding of sums of float32; with any number of threads the same."""
    (brightness, z), camera, depth_motion = _picture(1, size), _camera(size), se3.exp(TWIST)
    color_motion = se3.exp(time_offset * VELOCITY.astype(np.float64)) @ depth_motion if time_offset else depth_motion
    settings, sampling = (
        _settings(color_motion, depth_motion, 1.05, 0.01, readout),
        {'max_depth_error': 0.03, 'step': step_of(camera)},
    )
    native, threaded = make_native_aligner(1), make_native_aligner(3)
    at = _at((brightness, z), native.layers(brightness + np.float32(0.02), 1.002 * z, EDGE), camera=camera, **settings)
    expected = TorchAligner().evidence(_on_device(at), **sampling)
    found, again = (aligner.evidence(at, **sampling) for aligner in (native, threaded))
    assert expected.cells[0].sum() > 0.3 * expected.cells[1].sum() > 0
    for name in ('claimed', 'shared', 'scores', 'cells'):
        ours, theirs = getattr(found, name), getattr(expected, name)
        assert np.abs(ours - theirs).max() < 1e-4 * np.abs(theirs).max(), name
        assert np.array_equal(ours, getattr(again, name)), name


WEIGHED = {
    'all unknowns': (range(9), 0.0),
    'no time offset': (range(8), 0.0),
    'camera alone': (range(6), 0.0),
    'of other images': (range(9), 1.0),
    'nothing in sight': (range(9), np.nan),
}


@pytest.mark.parametrize('size', [(48, 65), (240, 320), (7, 9)])
@pytest.mark.parametrize(('is_free', 'noise'), WEIGHED.values(), ids=WEIGHED)
def test_weighing_is_the_native_one(is_free: Sequence[int], noise: float, size: tuple[int, int]) -> None:
    """To the rounding of doubles in systems of which the numbers differ by a millionfold; the same directions and cells."""
    native, camera, at_once = make_native_aligner(1), _camera(size), _settings(se3.exp(TWIST), se3.exp(TWIST), 1.05, 0.01)
    brightness, depth = _picture(1, size)
    other = brightness + np.float32(noise) * np.random.default_rng(3).random(size, np.float32)
    at = _at((brightness, depth * np.float32(1 + 0 * noise)), native.layers(other, 1.002 * depth, EDGE), camera=camera, **at_once)
    sums = native.evidence(at, max_depth_error=0.03, step=step_of(camera))
    prior = np.array([10.0] * 6 + [100, 100, 20])
    known = Knowns(camera, step_of(camera), VELOCITY.astype(np.float64), prior, 7.0, np.isin(np.arange(9), is_free))
    expected, found = weigh(sums, known), native.weigh(sums, known)
    assert (found.num_open, found.num_explained) == (expected.num_open, expected.num_explained)
    assert found.explained == expected.explained
    deviations = np.sqrt(expected.covariance.diagonal())
    assert np.abs(found.covariance - expected.covariance).max() <= 1e-9 * np.outer(deviations, deviations).max()


@pytest.mark.parametrize('name', ['claimed', 'shared'])
@pytest.mark.parametrize('value', [np.nan, np.inf])
def test_equations_that_have_no_solution_are_the_same_error_by_either(name: str, value: float) -> None:
    sums = {'claimed': np.eye(9), 'shared': np.eye(9), 'scores': np.ones((9, 48)), 'cells': np.ones((9, 48))}
    sums[name][2, 3] = sums[name][3, 2] = value
    known = Knowns(_camera((48, 64)), 1, np.zeros(6), np.ones(9), 1.0, np.ones(9, bool))
    for either in (weigh, make_native_aligner(1).weigh):
        with np.errstate(all='ignore'), pytest.raises(np.linalg.LinAlgError):
            either(Sums(**sums), known)


def _descent(size: tuple[int, int], is_free: Sequence[int] = range(10), **changed: Any) -> Descent[Any]:
    """A frame that was taken near its reference, with another exposure."""
    rng, (brightness, depth) = np.random.default_rng(7), _picture(1, size)
    layers = make_native_aligner(1).layers(1.1 * brightness + 0.02, depth + np.float32(0.001) * rng.random(size, np.float32), EDGE)
    known = {
        'brightness': brightness, 'depth': depth, 'predicted_motion': se3.exp(0.5 * TWIST), 'pace': Pace(expected=0.4 * TWIST),
        'mean': np.array([0.0] * 6 + [1, 0, 0.2, 0.1]), 'information': np.array([10.0] * 6 + [100, 100, 20, 30]),
        'scale_factors': np.array([1.0, 1.5]), 'iterations': 5, 'small_step': 1e-4, 'is_free': np.isin(np.arange(10), is_free),
        'max_depth_ratio': 0.1,
    }  # fmt: skip
    return Descent(camera=_camera(size), layers=layers, **known | changed)


def _numbers(state: AlignmentState) -> np.ndarray:
    others = state.gain, state.bias, state.time_offset, state.readout
    return np.concatenate([state.depth_motion.ravel(), others, state.velocity, state.scales])


START = AlignmentState(se3.exp(0.2 * TWIST), gain=1.02, bias=0.01, time_offset=0.15, readout=0.05)
DESCENTS = {
    'all unknowns': {},
    'no readout': {'is_free': range(9)},
    'camera alone, nothing expected': {'is_free': range(6), 'predicted_motion': None},
    'one step': {'iterations': 1},
    'none': {'iterations': 0},
    'a pace that is not possible': {'pace': Pace(2, 30 * TWIST, limit_m=1e-3, limit_rad=1e-3)},
    'half a turn': {'predicted_motion': se3.exp(np.array([1.0, 2, 3, 3.1, 0, 0])), 'pace': Pace(9), 'iterations': 2},
    'too few points': {'brightness': np.full((60, 80), np.nan, np.float32), 'depth': np.full((60, 80), np.nan, np.float32)},
}


@pytest.mark.parametrize('isa', ['generic', 'avx2', 'avx512'])
@pytest.mark.parametrize('changed', DESCENTS.values(), ids=DESCENTS)
def test_descent_is_the_native_one(changed: dict[str, Any], isa: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Native code takes the steps that numpy does, to the rounding of motions to float32 in between; as often with any threads."""
    monkeypatch.setenv('SPLATAM_ISA', isa)
    if (runs := CpuRasterizer(1).instruction_set) != isa:
        pytest.skip(f'this processor runs {runs}, not {isa}')
    task, native = _descent((60, 80), **changed), make_native_aligner(1)
    expected = descend(partial(native.linearize, **INLIERS), task, START)
    found, again = (aligner.descend(task, START) for aligner in (native, make_native_aligner(3)))
    assert np.allclose(_numbers(found), _numbers(expected), rtol=1e-6, atol=1e-6)
    assert np.array_equal(_numbers(found), _numbers(again))
    if not changed.keys() - {'is_free', 'predicted_motion'}:  # what can be aligned is
        assert np.abs(found.depth_motion - np.eye(4)).max() < 0.01
        assert not task.is_free[6] or found.gain == pytest.approx(1.1, abs=0.05)
        by_torch = TorchAligner().descend(_task_on_device(task), START)
        assert np.allclose(_numbers(by_torch)[:20], _numbers(found)[:20], atol=2e-3)  # points on the border fall on either side


def test_nothing_in_sight_gives_an_empty_system() -> None:
    """No points, or none that fall into the frame: zeros, and medians that are NaN."""
    brightness, depth = _picture(4, (40, 50))
    ours, away = TorchAligner(), se3.exp(np.array([50.0, 0, 0, 0, 0, 0]))
    for motion, z in ((away, depth), (np.eye(4), np.full_like(depth, np.nan))):
        tensors = _tensors(brightness, z)
        layers = ours.layers(*_tensors(brightness, depth), EDGE)
        camera = PinholeCamera(50, 40, 45.0, 45.0, 24.0, 19.0)
        system = ours.linearize(_at(tensors, layers, camera=camera, **_settings(motion, motion)), **INLIERS)
        assert not system.H.any() and not system.g.any() and system.cost == 0
        assert system.points == (z > 0).sum() and system.compared == system.seen == system.agreeing == 0
        assert np.isnan([system.photometric_median, system.depth_median]).all()


@pytest.mark.parametrize(('time_offset', 'half_render_from'), [(True, 0), (False, 160)])
def test_tracker_finds_the_same_pose_by_either(
    time_offset: bool, half_render_from: int, room: Callable[..., SyntheticSequence], monkeypatch: pytest.MonkeyPatch
) -> None:
    """To 0.2 mm, a fiftieth of a pixel here: Gauss-Newton amplifies the rounding of points on the border a little."""
    sequence = room(3, 160)
    slam = Slam(load_config('quick', ['threads=1', 'device=cpu']))
    for index in range(2):
        slam.process(sequence[index])
    align = AlignmentConfig(time_offset=time_offset, half_render_from=half_render_from)
    config = TrackingConfig(method='align', iterations=6, align=align)
    view = View.from_frame(sequence[2], slam.config.depth)
    truth = sequence.ground_truth().T_world_cam
    before, guess = (se3.inverse(truth[index]) @ truth[0] for index in (0, 1))
    results = []
    for aligner in (make_native_aligner(1), _Bridge(TorchAligner())):
        monkeypatch.setattr(alignment, 'make_aligner', lambda threads, device, aligner=aligner: aligner)
        tracker = make_tracker(make_rasterizer('cpu', 1), config, 1, HOST)
        results.append(tracker.track(view, slam.map.gaussians, guess, before))
    native, ours = results
    assert not verify(native, config) and not verify(ours, config)
    assert np.abs(native.T_cam_world - ours.T_cam_world).max() < 2e-4
    assert np.abs(native.T_cam_world_depth - ours.T_cam_world_depth).max() < 2e-4
    assert ours.inlier_fraction == pytest.approx(native.inlier_fraction, abs=0.01)


class _Bridge:
    """The aligner in torch, for images as numpy arrays."""

    def __init__(self, aligner: TorchAligner) -> None:
        self._aligner = aligner

    def layers(self, brightness: Image, depth: Image, max_step: float) -> Image:
        return self._aligner.layers(*_tensors(brightness, depth), max_step).numpy()

    def frame_images(self, rgb8: Image, depth: Image, max_gap: int, max_step: float) -> tuple[Image, ...]:
        return tuple(image.numpy() for image in self._aligner.frame_images(*_tensors(rgb8, depth), max_gap, max_step))

    def render_images(self, rgb: Image, depth_acc: Image, silhouette: Image, threshold: float, least: float) -> tuple[Image, ...]:
        drawn = _tensors(rgb, depth_acc, silhouette)
        return tuple(image.numpy() for image in self._aligner.render_images(*drawn, threshold, least))

    def halve(self, brightness: Image, depth: Image, max_step: float) -> tuple[Image, ...]:
        return tuple(image.numpy() for image in self._aligner.halve(*_tensors(brightness, depth), max_step))

    def evidence(self, at: Linearization[Any], **settings: Any) -> EvidenceSums:
        return self._aligner.evidence(_on_device(at), **settings)

    def weigh(self, sums: EvidenceSums, known: Knowns) -> Evidence:
        return self._aligner.weigh(sums, known)

    def descend(self, task: Descent[Any], start: AlignmentState) -> AlignmentState:
        return self._aligner.descend(_task_on_device(task), start)

    def linearize(self, at: Linearization[Any], **settings: Any) -> TorchLinearSystem:
        return self._aligner.linearize(_on_device(at), **settings)
