"""SLAM with anisotropic Gaussians: map, optimizer, files and loading. The contract test covers rendering."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from splatam_core.config import load_config
from splatam_core.datasets.registry import open_sequence
from splatam_core.errors import ConfigError, RasterizerError
from splatam_core.geometry import se3
from splatam_core.mapping.gaussian_map import GaussianMap
from splatam_core.maps.ply import read_ply, write_ply
from splatam_core.rasterizer import Gaussians, Rates
from splatam_core.slam import Slam
from splatam_core.types import Status

SETTINGS = [
    'threads=1', 'mapping.anisotropic=true', 'tracking.method=render_and_compare', 'tracking.iterations=20',
    'mapping.every=1', 'mapping.iterations=10',
]  # fmt: skip


def isotropic(count: int) -> Gaussians:
    generator = torch.Generator().manual_seed(count)
    return Gaussians(
        torch.randn(count, 3, generator=generator), torch.randn(count, 1, generator=generator),
        torch.randn(count, generator=generator), torch.rand(count, 3, generator=generator),
    )  # fmt: skip


@pytest.fixture(scope='module')
def mapped() -> Slam:
    """Three frames of the room; not to be changed."""
    sequence = open_sequence('synthetic', width=96, max_frames=3)
    truth = sequence.ground_truth().T_world_cam
    slam = Slam(load_config('quick', SETTINGS))
    results = [slam.process(sequence[index]) for index in range(3)]
    assert [result.status for result in results] == [Status.INITIALIZED, Status.TRACKED, Status.TRACKED]
    error = se3.inverse(se3.inverse(truth[0]) @ truth[2]) @ results[2].T_world_cam
    assert np.linalg.norm(error[:3, 3]) < 0.02  # two thirds of a pixel at the walls' 2.5 m, as with isotropic Gaussians
    return slam


def test_radii_and_rotations_are_fitted(mapped: Slam) -> None:
    """Scales start equal and rotations at the identity; both change."""
    snapshot = mapped.snapshot()
    assert snapshot.log_scales.shape == (mapped.num_gaussians, 3)
    assert snapshot.rotations.shape == (mapped.num_gaussians, 4)
    assert np.ptp(snapshot.log_scales, axis=1).mean() > 1e-3
    assert np.abs(snapshot.rotations[:, 1:]).mean() > 1e-3


def test_a_map_goes_on_from_its_file(mapped: Slam, tmp_path: Path) -> None:
    """A map read from its PLY renders the same. An isotropic configuration refuses it; an anisotropic one takes isotropic maps."""
    write_ply(tmp_path / 'map.ply', mapped.map.gaussians)
    gaussians = read_ply(tmp_path / 'map.ply')
    again = Slam(load_config('quick', SETTINGS))
    again.load(gaussians, np.eye(4))
    again.camera = mapped.camera
    np.testing.assert_array_equal(again.render(np.eye(4)).depth_m, mapped.render(np.eye(4)).depth_m)
    with pytest.raises(ConfigError, match='set mapping.anisotropic=true'):
        Slam(load_config('quick')).load(gaussians, np.eye(4))
    again.load(isotropic(7), np.eye(4))
    assert again.snapshot().log_scales.shape == (7, 3) and again.num_gaussians == 7


def test_the_optimiser_follows_what_is_kept() -> None:
    """Rotations change, and their moments stay with their Gaussians."""
    gaussian_map = GaussianMap(anisotropic=True)
    gaussian_map.append(isotropic(6))
    gaussian_map.start_optimization(Rates(0.0, 0.0, 0.0, 0.0, rotations=0.01))
    kept = torch.tensor([True, False, True, True, False, True])
    for _ in range(2):
        (gaussian_map.rotations[:, 1] * torch.arange(1.0, len(gaussian_map) + 1)).sum().backward()
        gaussian_map.keep(kept[: len(gaussian_map)])
        gaussian_map.step()
        kept = torch.ones(len(gaussian_map), dtype=torch.bool)
    gaussian_map.stop_optimization()
    assert len(gaussian_map) == 4
    # Adam's steps are about as long as the rate, whatever the gradient
    torch.testing.assert_close(gaussian_map.rotations[:, 1], torch.full((4,), -0.02), rtol=0.1, atol=0)
    assert torch.equal(gaussian_map.rotations[:, 0], torch.ones(4))
    assert gaussian_map.gaussians.bounds[0, 6] == gaussian_map.log_scales.max()


def test_an_isotropic_map_takes_no_anisotropic_gaussians() -> None:
    with pytest.raises(RasterizerError, match=r'set mapping\.anisotropic=true'):
        GaussianMap().append(isotropic(3).anisotropic())
