"""No Gaussian that is not finite is added, kept, drawn or saved, whatever depth and calibration say."""

from __future__ import annotations

import logging
import math
from pathlib import Path

import numpy as np
import pytest
import rasterizer_scenes as scenes
import torch
from rasterizer_scenes import Scene

from splatam_core.config import load_config
from splatam_core.errors import MapFileError
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.images.view import View
from splatam_core.mapping.densification import corrected, densify
from splatam_core.mapping.gaussian_map import GaussianMap
from splatam_core.mapping.optimizers.base import drop_unusable, prune
from splatam_core.maps.ply import read_ply, write_ply
from splatam_core.rasterizer import Gaussians, Moments, Rates, Target, make_rasterizer
from splatam_core.slam import Slam
from splatam_core.types import RgbdFrame, Status

CAMERA = PinholeCamera(64, 48, 60.0, 60.0, 31.5, 23.5)
NOT_FINITE = (math.nan, math.inf, -math.inf)
PARAMETERS = ('means', 'log_scales', 'logit_opacities', 'rgb')
RATES = Rates(1e-4, 1e-3, 0.05, 2.5e-3)


def fine(count: int, anisotropic: bool = False) -> Gaussians:
    scene = (scenes.anisotropic_scene if anisotropic else scenes.random_scene)(5, count, 32, 24)
    return scenes.on_device(scene.gaussians, 'cpu')


def broken(gaussians: Gaussians, name: str, value: float, index: int = 3) -> Gaussians:
    """A copy in which one value of one Gaussian is replaced."""
    copy = gaussians.chosen(torch.ones(len(gaussians), dtype=torch.bool))
    getattr(copy, name)[index] = value
    return copy


def stereo_frame(index: int, rng: np.random.Generator) -> RgbdFrame:
    """Far stereo depth with correlated noise, a thin thing at 0.8 m, and speckles."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    noise = np.repeat(np.repeat(rng.normal(size=(12, 16)), 4, axis=0), 4, axis=1)
    depth = 25.0 + 0.08 * u + 1.2 * noise
    depth[:, 20 + index : 22 + index] = 0.8
    speckles = rng.random(depth.shape) < 0.01
    depth[speckles] = rng.uniform(0.4, 40.0, speckles.sum())
    rgb = np.stack([u * 3 % 256, v * 5 % 256, (u * v) % 256], axis=-1).astype(np.uint8)
    return RgbdFrame(10**9 * (index + 1), rgb, depth.astype(np.float32), CAMERA)


@pytest.mark.parametrize('preset', ['quick', 'realtime'])
def test_far_and_noisy_stereo_depth_gives_a_finite_map(preset: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    slam = Slam(load_config(preset, ['threads=1', 'mapping.iterations=4', 'tracking.method=none']))
    for index in range(6):
        slam.process(stereo_frame(index, rng))
    assert slam.num_gaussians > 1000 and bool(slam.map.gaussians.usable().all()) and slam.map.num_refused == 0
    write_ply(tmp_path / 'map.ply', slam.map.gaussians)
    assert len(read_ply(tmp_path / 'map.ply')) == slam.num_gaussians


def test_a_correction_larger_than_the_depth_keeps_the_reading() -> None:
    reading = torch.tensor([[2.0, 0.8, 0.8, 5.0, 5.0]])
    bias = torch.tensor([[0.5, 0.8, 2.5, math.nan, -math.inf]])
    assert corrected(reading, bias, reading).tolist() == [[1.5, pytest.approx(0.8), pytest.approx(0.8), 5.0, 5.0]]


@pytest.mark.parametrize('value', NOT_FINITE)
@pytest.mark.parametrize('name', [*PARAMETERS, 'rotations'])
def test_a_map_takes_no_gaussian_that_is_not_finite(name: str, value: float, caplog: pytest.LogCaptureFixture) -> None:
    gaussian_map = GaussianMap(anisotropic=name == 'rotations')
    good = fine(50, name == 'rotations')
    with caplog.at_level(logging.WARNING):
        added = gaussian_map.append(broken(good, name, value))
    assert len(gaussian_map) == 49 == int(added.sum()) and not added[3] and gaussian_map.num_refused == 1
    assert bool(gaussian_map.gaussians.usable().all()) and 'not finite' in caplog.text
    before = gaussian_map.means.clone()
    gaussian_map.replace_last(broken(good.chosen(added), name, value))
    assert bool(gaussian_map.gaussians.usable().all()) and torch.equal(gaussian_map.means, before)


def test_refused_gaussians_are_said_when_their_number_doubles(caplog: pytest.LogCaptureFixture) -> None:
    gaussian_map = GaussianMap()
    with caplog.at_level(logging.WARNING):
        for _ in range(100):
            gaussian_map.append(broken(fine(4), 'means', math.nan))
    assert gaussian_map.num_refused == 100 and len(caplog.records) == 7


def test_gaussians_added_during_an_optimization_are_checked_too() -> None:
    gaussian_map = GaussianMap()
    gaussian_map.append(fine(20))
    gaussian_map.start_optimization(RATES)
    gaussian_map.means.grad = torch.ones_like(gaussian_map.means)
    gaussian_map.step()
    gaussian_map.extend(broken(fine(10), 'rgb', math.nan))
    gaussian_map.means.grad = torch.ones_like(gaussian_map.means)
    gaussian_map.step()
    gaussian_map.stop_optimization()
    assert len(gaussian_map) == 29


@pytest.mark.parametrize('value', NOT_FINITE)
@pytest.mark.parametrize('name', PARAMETERS)
def test_what_became_not_finite_is_dropped_at_any_rate(name: str, value: float) -> None:
    mapping = load_config('quick').mapping
    gaussian_map = GaussianMap()
    gaussian_map.append(fine(30))
    getattr(gaussian_map, name)[7] = value
    prune(gaussian_map, mapping, scene_radius=1e6, min_fraction=1.0)
    assert len(gaussian_map) == 29 and gaussian_map.num_refused == 1 and bool(gaussian_map.gaussians.usable().all())
    drop_unusable(gaussian_map)
    assert len(gaussian_map) == 29


@pytest.mark.parametrize('value', NOT_FINITE)
@pytest.mark.parametrize('name', PARAMETERS)
@pytest.mark.parametrize('backend', ['cpu', 'reference', 'triton'])
def test_what_is_not_finite_is_not_drawn(backend: str, name: str, value: float) -> None:
    """With a log scale of NaN it used to fill the screen."""
    device = scenes.device_of(backend)
    scene = scenes.random_scene(12, 20, 16, 12)
    with_broken = broken(scene.gaussians, name, value)
    without = scene.gaussians.chosen(torch.arange(20) != 3)
    rasterizer, pose = make_rasterizer(backend, 1), scene.T_cam_world.float().to(device)
    images = [
        scenes.images(rasterizer.render(scenes.on_device(g, device), scene.camera, pose)).cpu() for g in (with_broken, without)
    ]
    torch.testing.assert_close(images[0], images[1], rtol=0, atol=1e-6)


@pytest.mark.parametrize('value', (math.nan, math.inf, 100.0))
@pytest.mark.parametrize('name', ['means', 'log_scales', 'rgb', 'rotations'])
@pytest.mark.parametrize('backend', ['cpu', 'reference'])
def test_broken_ellipses_spoil_neither_image_nor_gradients(backend: str, name: str, value: float) -> None:
    scene = scenes.anisotropic_scene(12, 20, 16, 12)
    g = broken(scene.gaussians, name, value)
    weights = torch.ones(5, 12, 16)
    image, gradients = scenes.render_with_gradients(
        make_rasterizer(backend, 1), Scene(g, scene.camera, scene.T_cam_world), torch.float32, weights
    )
    assert torch.isfinite(image).all() and torch.isfinite(gradients['T_cam_world']).all()


@pytest.mark.parametrize('backend', ['cpu', 'reference'])
def test_a_step_that_overflows_is_not_taken(backend: str) -> None:
    """The Gaussian is so large that its gradient by the scale overflows."""
    g = fine(20)
    g.log_scales[3] = 39.0
    g.means[3] = torch.tensor([0.0, 0.0, 0.3])
    moments = Moments(torch.zeros(20, 16), torch.zeros(20, dtype=torch.uint8))
    camera = scenes.camera(32, 24)
    target = Target(camera, torch.zeros(24, 32, 3, dtype=torch.uint8), torch.full((24, 32), 1e3), torch.eye(4), 1e15, 1e15)
    rasterizer = make_rasterizer(backend, 1)
    for _ in range(5):
        rasterizer.fit(g, moments, RATES, target)
    assert bool(g.usable().all()) and bool(torch.isfinite(moments.first_second).all())


@pytest.mark.parametrize('value', NOT_FINITE)
@pytest.mark.parametrize('name', PARAMETERS)
def test_what_read_ply_refuses_is_not_written(name: str, value: float, tmp_path: Path) -> None:
    with pytest.raises(MapFileError, match='1 of 30 Gaussians are not finite'):
        write_ply(tmp_path / 'map.ply', broken(fine(30), name, value))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize('size', [1.0, 1e20, 9e29])
def test_what_write_ply_writes_is_read(size: float, tmp_path: Path) -> None:
    g = fine(10)
    large = Gaussians(g.means * size / g.means.abs().max(), g.log_scales, g.logit_opacities, g.rgb * size)
    write_ply(tmp_path / 'map.ply', large)
    assert len(read_ply(tmp_path / 'map.ply')) == 10


def test_a_senseless_calibration_starts_no_map() -> None:
    """32-bit coordinates overflow."""
    rgb, depth = np.zeros((48, 64, 3), np.uint8), torch.full((48, 64), 2.0)
    view = View(PinholeCamera(64, 48, 60.0, 60.0, 31.5, 23.5), torch.from_numpy(rgb), depth)
    object.__setattr__(view.camera, 'cx', 1e300)
    gaussian_map = GaussianMap()
    densify(gaussian_map, view, torch.eye(4), make_rasterizer('cpu', 1), load_config('quick').densification)
    assert len(gaussian_map) == 0 and gaussian_map.num_refused > 0


def test_a_map_that_holds_what_is_not_finite_is_not_restored() -> None:
    gaussian_map = GaussianMap()
    gaussian_map.append(fine(10))
    arrays = gaussian_map.arrays()
    arrays['rgb'][4, 1] = math.nan
    with pytest.raises(ValueError, match='numbers in rgb that are not finite'):
        GaussianMap().restore(arrays)


def test_frames_after_far_ones_are_tracked_or_lost() -> None:
    rng = np.random.default_rng(1)
    slam = Slam(load_config('quick', ['threads=1', 'mapping.iterations=3', 'tracking.iterations=4']))
    statuses = {slam.process(stereo_frame(index, rng)).status for index in range(4)}
    assert statuses <= set(Status)
