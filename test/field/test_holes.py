"""Depth with a grid of holes, as registration from a smaller depth image gives it: tracked, mapped closed, and said once."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from far_stereo import SKY_M, FarStereo, sigma_m
from thinned_depth import ThinnedSequence, thinned

from splatam_core.config import DensificationConfig, load_config
from splatam_core.datasets.registry import open_sequence
from splatam_core.datasets.synthetic import SyntheticSequence
from splatam_core.device import HOST
from splatam_core.evaluation.trajectory import trajectory_error
from splatam_core.geometry.camera import CameraCalibration, PinholeCamera
from splatam_core.geometry.trajectory import Trajectory
from splatam_core.images.observation import Observation
from splatam_core.images.rectification import FrameFactory
from splatam_core.images.spacing import REGISTER_ADVICE, reading_spacing, shrunk_readings
from splatam_core.images.view import View
from splatam_core.mapping.densification import densify, new_widths
from splatam_core.mapping.gaussian_map import GaussianMap
from splatam_core.mapping.posed import PosedFrame
from splatam_core.rasterizer import make_rasterizer
from splatam_core.rasterizer.base import NOT_COMPARED
from splatam_core.runs.checkpoints import Checkpoints, Progress, read_checkpoint
from splatam_core.slam import Slam
from splatam_core.tracking.alignment import make_aligner
from splatam_core.tracking.pyramid import frame_level
from splatam_core.types import FrameResult, RgbdFrame, Status

GRIDS = [(ratio, bent) for ratio in (1.2, 1.5, 2.0, 3.0, 4.0) for bent in (False, True)]
FOCAL = 260.0
CAMERA = PinholeCamera(320, 240, FOCAL, FOCAL, 159.5, 119.5)


def slanted(shape: tuple[int, int] = (240, 320)) -> np.ndarray:
    """Depth of a floor, with a hole in it."""
    depth_m = np.linspace(1, 3, shape[0] * shape[1], dtype=np.float32).reshape(shape)
    depth_m[60:100, 100:180] = 0
    return depth_m


def view_of(depth_m: np.ndarray) -> View:
    rgb = np.random.default_rng(0).integers(0, 255, (*depth_m.shape, 3), np.uint8)
    return View.from_frame(RgbdFrame(1, rgb, depth_m, CAMERA), load_config('realtime').depth)


@pytest.mark.parametrize(('ratio', 'bent'), GRIDS)
def test_the_spacing_of_a_grid_is_measured(ratio: float, bent: bool) -> None:
    depth_m = thinned(slanted(), ratio, FOCAL if bent else None)
    spacing = reading_spacing(depth_m)
    assert spacing == pytest.approx(ratio, rel=0.1)  # a bent grid loses readings that fall on one pixel
    view = view_of(depth_m)
    widths_px = new_widths(view)[view.valid]
    assert widths_px.mean() == pytest.approx(1.14 * spacing, rel=0.15)  # 1.14: what the blur adds to dense Gaussians
    assert widths_px.max() <= 1.5 * spacing  # beside the hole, too


def test_depth_that_is_dense_where_the_sensor_sees_a_surface_is_no_grid() -> None:
    depth_m = slanted()
    depth_m[::40, :] = 0
    depth_m[:, 150:] = 0
    speckled = np.where(np.random.default_rng(0).random(depth_m.shape) < 0.05, np.float32(0), depth_m)
    for dense in (depth_m, speckled, np.zeros_like(depth_m)):
        assert reading_spacing(dense) == 1.0
        assert new_widths(view_of(dense)) is None
        assert frame_level(view_of(dense), make_aligner(1, torch.device('cpu'))).depth_share == 1.0  # exactly: nothing changes


SMALL_WIDTHS = (48, 64, 80, 160, 320)


def small_views(source: str | Path) -> Iterator[tuple[np.ndarray, float]]:
    """Depth of some frames of a recording at all of ``SMALL_WIDTHS``, and the focal length there."""
    for width in SMALL_WIDTHS:
        sequence = open_sequence(str(source), width=width)
        for index in range(0, min(len(sequence), 160), 80):
            yield sequence[index].depth_m, sequence.camera.fx


def assert_only_grids_are_grids(views: Iterator[tuple[np.ndarray, float]]) -> None:
    """In a small image, the readings that are missing along the edges of objects are more than a tenth of the surface."""
    for depth_m, focal in views:
        assert reading_spacing(depth_m) == 1.0, depth_m.shape
        for ratio, bent in [(1.1, False), (1.1, True), *GRIDS]:
            assert reading_spacing(thinned(depth_m, ratio, focal if bent else None)) > 1.0, (depth_m.shape, ratio, bent)


def test_noisy_edges_in_a_small_image_are_no_grid() -> None:
    assert_only_grids_are_grids(small_views('synthetic'))


@pytest.mark.parametrize('name', ['redkitchen_320', 'fr1_rpy_320', 'd435_desk'])
def test_missing_readings_in_a_small_recording_are_no_grid(recording, name: str) -> None:
    assert_only_grids_are_grids(small_views(recording(name)))


@pytest.mark.parametrize(('ratio', 'size'), [(2, (160, 120)), (2, (214, 160)), (3, (160, 120)), (3, (200, 150)), (4, (80, 60))])
def test_no_reading_is_lost_or_used_twice_where_a_grid_is_made_smaller(ratio: float, size: tuple[int, int]) -> None:
    depth_m = thinned(slanted(), ratio)
    readings = shrunk_readings(depth_m, *size)
    assert np.count_nonzero(readings) == np.count_nonzero(depth_m)  # the new pixels are no larger than the grid's
    assert set(readings[readings > 0]) == set(depth_m[depth_m > 0])


def test_frames_that_are_made_smaller_keep_the_readings() -> None:
    """Every second pixel has a reading, and never the one that is nearest to the centre of the new pixel."""
    depth_m = np.zeros((240, 320), np.float32)
    depth_m[::2, ::2] = slanted()[::2, ::2]
    depth_m[depth_m == 0] = np.nan
    frame = FrameFactory(CameraCalibration(CAMERA), width=160).make(1, np.zeros((240, 320, 3), np.uint8), depth_m)
    assert np.count_nonzero(frame.depth_m) == np.count_nonzero(depth_m > 0)
    assert frame.depth_spacing == pytest.approx(2, rel=0.1)


@pytest.mark.parametrize(('ratio', 'bent'), [(1.2, False), (1.5, False), (2.0, False), (3.0, True)])
@pytest.mark.parametrize('scale', [1.0, 0.67])
def test_the_map_is_closed_between_the_readings_and_open_where_there_is_no_surface(ratio: float, bent: bool, scale: float) -> None:
    dense = slanted()
    view, gaussian_map = view_of(thinned(dense, ratio, FOCAL if bent else None)), GaussianMap()
    rasterizer = make_rasterizer('cpu', 1)
    densify(gaussian_map, view, torch.eye(4), rasterizer, DensificationConfig(scale=scale, bias_correction_rounds=1))
    assert len(gaussian_map) <= np.count_nonzero(view.depth)  # readings as received, no others
    silhouette = rasterizer.render(gaussian_map.gaussians, CAMERA, torch.eye(4)).silhouette.numpy()
    margin = 8  # at the border of the image and of the hole there are neighbours on one side only
    surface = dense > 0
    surface[[*range(margin), *range(-margin, 0)]] = surface[:, [*range(margin), *range(-margin, 0)]] = False
    surface[60 - margin : 100 + margin, 100 - margin : 180 + margin] = False
    assert (silhouette[surface] > 0.9).mean() > 0.99
    assert (silhouette[60 + margin : 100 - margin, 100 + margin : 180 - margin] < 0.1).all()


def errors_m(sequence, preset: str, num_frames: int) -> tuple[float, int]:
    """Returns the trajectory error of a run, and the number of frames lost."""
    slam = Slam(load_config(preset, ['threads=1']), num_frames=num_frames)
    results = [slam.process(sequence[index]) for index in range(num_frames)]
    poses = [(result.stamp_ns, result.T_world_cam) for result in results if result.status is not Status.LOST]
    estimate = Trajectory(np.array([stamp_ns for stamp_ns, _ in poses]), np.stack([pose for _, pose in poses]))
    return trajectory_error(estimate, sequence.ground_truth()).rmse_m, num_frames - len(poses)


def test_a_run_that_is_resumed_knows_the_grid(tmp_path: Path) -> None:
    room = ThinnedSequence(SyntheticSequence(width=96, frames=8), 3.0, irregular=False)
    config = load_config('realtime', ['threads=1'])
    through, resumed = Slam(config), Slam(config)
    for index in range(6):
        through.process(room[index])
    path = Checkpoints(tmp_path, keep=1).save(through.state(), Progress(8, 6, '0' * 64, 5))
    resumed.restore(read_checkpoint(path).state)
    assert all(keyframe.view.spacing > 2 for keyframe in resumed.state().keyframes)
    for slam in (through, resumed):
        for index in range(6, 8):
            slam.process(room[index])
        slam.finish()
    assert np.array_equal(through.snapshot().means, resumed.snapshot().means)


def test_the_node_says_it_in_the_same_words() -> None:
    said: list[str] = []

    class Logger:
        def warning(self, text: str) -> None:
            said.append(text)

    handler = pytest.importorskip('splatam_ros.node.main').RosLog(Logger())
    logging.getLogger().addHandler(handler)
    try:
        slam = Slam(load_config('realtime', ['threads=1']))
        for index in range(2):
            slam.process(ThinnedSequence(SyntheticSequence(width=64, frames=2), 2.0, irregular=False)[index])
    finally:
        logging.getLogger().removeHandler(handler)
    assert len(said) == 1 and said[0].endswith(REGISTER_ADVICE)


@pytest.mark.slow
@pytest.mark.parametrize(
    ('preset', 'most', 'grids'), [('realtime', 1.5, [(2.0, False), (3.0, True)]), ('quick', 2.2, [(3.0, True)])]
)
def test_a_grid_is_tracked_like_dense_depth_and_said_once(
    preset: str, most: float, grids: list[tuple[float, bool]], caplog: pytest.LogCaptureFixture
) -> None:
    room = SyntheticSequence(width=160, frames=40)
    dense_m, _ = errors_m(room, preset, len(room))
    assert not caplog.records
    for ratio, bent in grids:
        caplog.clear()
        thinned_m, num_lost = errors_m(ThinnedSequence(room, ratio, bent), preset, len(room))
        assert num_lost == 0
        # quick fits 53x40 readings in ten steps: what it maps is 0.4 % too far away.
        assert thinned_m < most * max(dense_m, 0.002)
        (record,) = caplog.records
        assert 'grid of holes' in record.message and 'fill_upsampling_holes' in record.message


@pytest.mark.slow
def test_a_grid_in_a_real_recording_is_tracked(recording) -> None:
    kitchen = open_sequence(str(recording('redkitchen_320')), max_frames=60)
    dense_m, _ = errors_m(kitchen, 'realtime', len(kitchen))
    for ratio in (1.25, 2.0, 3.0):
        thinned_m, num_lost = errors_m(ThinnedSequence(kitchen, ratio, irregular=True), 'realtime', len(kitchen))
        assert num_lost == 0 and thinned_m < 1.5 * max(dense_m, 0.005), ratio  # the reference is good to half a centimetre


def fog(slam: Slam, T_world_cam: np.ndarray, T_street_cam: np.ndarray) -> float:
    """Returns the fraction of the map's pixels that are nearer than the truth by more than three sigma of a reading and a tenth.

    A tenth: the map holds a thin post no better.
    """
    image, (_, depth_m) = slam.render(T_world_cam), FarStereo.true_view(T_street_cam)
    nearest_m = cv2.erode(depth_m, np.ones((1, 9)))  # near things grow
    is_seen = (depth_m < SKY_M) & (image.depth_m > 0)
    return (is_seen & (image.depth_m < nearest_m - np.maximum(3 * sigma_m(nearest_m), 0.1 * nearest_m))).sum() / is_seen.sum()


def run_street(preset: str, num_frames: int) -> tuple[FarStereo, Slam, list[FrameResult]]:
    street = FarStereo(num_frames)
    slam = Slam(load_config(preset, ['threads=1']), num_frames=num_frames)
    results = [slam.process(street[index]) for index in range(num_frames)]
    slam.finish()
    return street, slam, results


@pytest.mark.slow
@pytest.mark.parametrize(('preset', 'num_frames'), [('realtime', 40), ('quick', 8)])
def test_far_stereo_gives_no_fog_in_front_of_the_surfaces(preset: str, num_frames: int) -> None:
    street, slam, results = run_street(preset, num_frames)
    assert all(result.status is not Status.LOST for result in results) and slam.map.num_refused == 0
    assert all(np.isfinite(values).all() for values in (slam.snapshot().means, slam.snapshot().log_scales))
    for index in (0, num_frames - 1):
        assert fog(slam, results[index].T_world_cam, street.pose(index)) < 0.01
    if preset == 'realtime':
        assert_the_edge_of_a_roof_does_not_grow_into_the_sky(street, slam, results)


def assert_the_edge_of_a_roof_does_not_grow_into_the_sky(street: FarStereo, slam: Slam, results: list[FrameResult]) -> None:
    for index in (0, len(street) - 1):
        _, depth_m = FarStereo.true_view(street.pose(index))
        far_from_surfaces = cv2.erode((depth_m >= SKY_M).view(np.uint8), np.ones((21, 21), np.uint8)).view(bool)
        rendered = slam.render(results[index].T_world_cam)
        assert far_from_surfaces.sum() > 5000
        assert (rendered.silhouette[far_from_surfaces] > 0.5).mean() < 0.05


@pytest.mark.parametrize('optimizer', ['fused', 'paper'])
@pytest.mark.parametrize('spacing', [1, 2])
def test_keyframes_hold_what_is_compared(spacing: int, optimizer: str) -> None:
    """Nothing is far from every reading, at half size and among the readings of a grid as well; twice is as once."""
    depth = np.zeros((240, 320), np.float32)
    depth[::spacing, :160:spacing] = 2.0
    frame = RgbdFrame(0, np.full((240, 320, 3), 90, np.uint8), depth, CAMERA)
    config = load_config('realtime')
    mapping = replace(config.mapping, optimizer=optimizer)
    seen = Observation.from_frame(frame, config.depth, HOST)
    keyframe = PosedFrame(seen, np.eye(4), mapping).keyframe
    for posed in (keyframe, keyframe.half_size()):
        near, far = posed.view.depth.chunk(2, dim=1)
        assert bool((near >= 0).all()) and bool((far[:, 20:] == NOT_COMPARED).all()) == (optimizer == 'fused')
        assert near.max() == posed.view.depth.max() == 2.0
    if optimizer == 'fused':
        assert torch.equal(keyframe.comparable().view.depth, keyframe.view.depth)


def test_speckles_add_nothing_and_thin_things_stay() -> None:
    dense = np.full((240, 320), 20, np.float32)
    dense[:, 80] = 1  # a post, one pixel wide
    dense[:60] = 0
    dense[5, 200] = 9  # what may be the last that is seen of a thin thing
    rng, rasterizer = np.random.default_rng(0), make_rasterizer('cpu', 1)
    is_speckle = rng.random(dense.shape) < 0.005
    speckled = np.where(is_speckle, rng.uniform(0.5, 19, dense.shape), dense).astype(np.float32)
    depths = {}
    for name, depth_m in (('dense', dense), ('speckled', speckled)):
        view, gaussian_map = view_of(depth_m), GaussianMap()
        densify(gaussian_map, view, torch.eye(4), rasterizer, DensificationConfig())
        depths[name] = gaussian_map.means[:, 2].numpy()
    assert len(depths['dense']) == np.count_nonzero(dense)
    assert np.isin(depths['speckled'], speckled[is_speckle]).sum() < 0.05 * is_speckle.sum()  # some stand together by chance
    is_post = (depths['speckled'] == 1).sum()
    assert is_post > 0.95 * (speckled[:, 80] == 1).sum()
