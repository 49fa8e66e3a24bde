"""Maps for viewers in a browser: bytes where they look for them, and what a library of its own reads back."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from splatam_core.errors import ExportError, MapFileError
from splatam_core.geometry import se3
from splatam_core.maps.splat import write_splat, write_spz
from splatam_core.rasterizer.base import Gaussians


def some_gaussians(count: int, is_anisotropic: bool) -> Gaussians:
    generator = torch.Generator().manual_seed(count)
    scales = torch.randn(count, 3 if is_anisotropic else 1, generator=generator) - 4
    return Gaussians(
        means=3 * torch.randn(count, 3, generator=generator),
        log_scales=scales,
        logit_opacities=3 * torch.randn(count, generator=generator),
        rgb=1.2 * torch.rand(count, 3, generator=generator) - 0.1,
        rotations=5 * torch.randn(count, 4, generator=generator) if is_anisotropic else None,
    )


@pytest.mark.parametrize('is_anisotropic', [False, True])
def test_splat_has_32_bytes_per_gaussian_the_most_visible_first(tmp_path: Path, is_anisotropic: bool) -> None:
    g = some_gaussians(50, is_anisotropic)
    write_splat(tmp_path / 'map.splat', g)
    data = (tmp_path / 'map.splat').read_bytes()
    assert len(data) == 32 * 50
    scales = np.exp(g.log_scales.numpy().astype(float)) * np.ones(3)
    opacities = torch.sigmoid(g.logit_opacities).numpy()
    order = np.argsort(-(scales.prod(axis=1) * opacities), kind='stable')
    for index, at in zip(order, range(0, len(data), 32)):
        np.testing.assert_array_equal(np.frombuffer(data, '<f4', 3, at), g.means[index])
        np.testing.assert_allclose(np.frombuffer(data, '<f4', 3, at + 12), scales[index], rtol=1e-6)
        colour = np.frombuffer(data, 'u1', 4, at + 24) / 255
        np.testing.assert_allclose(colour, [*g.rgb[index].clamp(0, 1), opacities[index]], atol=0.5 / 255 + 1e-6)
        quaternion = (np.frombuffer(data, 'u1', 4, at + 28) - 128.0) / 128
        expected = np.array([1.0, 0, 0, 0]) if g.rotations is None else (g.rotations[index] / g.rotations[index].norm()).numpy()
        np.testing.assert_allclose(quaternion, expected, atol=1 / 128)  # 1 is clamped to 127 / 128


@pytest.mark.parametrize('write', [write_splat, write_spz])
def test_gaussians_that_are_not_finite_are_not_written(tmp_path: Path, write: object, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, 'gsply', sys)  # anything; it is not used
    g = some_gaussians(3, False)
    g.means[1, 2] = float('nan')
    with pytest.raises(MapFileError, match='1 of 3 Gaussians are not finite'):
        write(tmp_path / 'map', g)
    assert not list(tmp_path.iterdir())


def test_extreme_gaussians_are_written(tmp_path: Path) -> None:
    g = some_gaussians(2, False)
    g.log_scales[:], g.logit_opacities[:] = torch.tensor([[1e20], [-1e20]]), torch.tensor([1e20, -1e20])
    write_splat(tmp_path / 'map.splat', g)
    radii = np.frombuffer((tmp_path / 'map.splat').read_bytes(), '<f4').reshape(2, 8)[:, 3:6]
    assert np.isfinite(radii).all() and radii[1].tolist() == [0, 0, 0]


def test_spz_without_its_library_names_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, 'gsply', None)
    with pytest.raises(ExportError, match=r"pip install 'splatam_ros\[spz\]'"):
        write_spz(tmp_path / 'map.spz', some_gaussians(3, False))


@pytest.mark.parametrize('is_anisotropic', [False, True])
def test_spz_is_read_back_with_its_axes_turned(tmp_path: Path, is_anisotropic: bool) -> None:
    gsply = pytest.importorskip('gsply')
    g = some_gaussians(200, is_anisotropic)
    write_spz(tmp_path / 'map.spz', g)
    back, turn = gsply.read_spz(tmp_path / 'map.spz'), np.diag([1.0, -1.0, -1.0])
    np.testing.assert_allclose(back.means, g.means.numpy() @ turn, atol=0.5 / 4096 + 1e-6)
    np.testing.assert_allclose(back.scales, g.log_scales.numpy() * np.ones(3), atol=0.5 / 16 + 1e-6)
    assert np.abs(back.sh0 * 0.28209479177387814 + 0.5 - g.rgb.numpy()).max() < 0.01
    for index in range(200):
        ours = np.eye(3) if g.rotations is None else rotation(g.rotations[index].numpy())
        theirs, radii = rotation(back.quats[index]), np.exp(g.log_scales[index].numpy()) * np.ones(3)
        expected = turn @ ours @ np.diag(radii**2) @ ours.T @ turn
        np.testing.assert_allclose(theirs @ np.diag(radii**2) @ theirs.T, expected, atol=0.02 * radii.max() ** 2)


def rotation(quaternion: np.ndarray) -> np.ndarray:
    return se3.compose(quaternion / np.linalg.norm(quaternion), np.zeros(3))[:3, :3]


def test_spz_refuses_what_is_too_far_away(tmp_path: Path) -> None:
    pytest.importorskip('gsply')
    g = some_gaussians(3, False)
    g.means[2, 0] = 2048
    with pytest.raises(ExportError, match='1 of 3 Gaussians are 2048 m away or more'):
        write_spz(tmp_path / 'map.spz', g)
