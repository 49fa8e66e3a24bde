"""Every backend against the reference, the reference against finite differences and hand-worked cases."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable

import numpy as np
import pytest
import rasterizer_scenes as scenes
import torch
from rasterizer_scenes import Scene

import splatam_core
from splatam_core.errors import RasterizerError
from splatam_core.geometry import se3
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.rasterizer import Gaussians, Moments, Rasterizer, Rates, Target, make_rasterizer, native
from splatam_core.rasterizer.base import FIT_TILE, MAX_ALPHA, MIN_ALPHA, NOT_COMPARED
from splatam_core.rasterizer.cpu import CpuRasterizer
from splatam_core.rasterizer.reference import ReferenceRasterizer

BACKENDS = [('cpu', 1), ('cpu', 2), ('cpu', 3), ('triton', 0)]

# float32 against float64: 24 bits through a sum of some hundred terms, in units of the largest value.
IMAGE_TOLERANCE = 1e-5
GRADIENT_TOLERANCE = 5e-5


def _behind(seed: int) -> Scene:
    scene = scenes.random_scene(seed, 200, 40, 30)
    means = scene.gaussians.means.clone()
    means[::2, 2] -= 3.0
    return Scene(
        Gaussians(means, scene.gaussians.log_scales, scene.gaussians.logit_opacities, scene.gaussians.rgb),
        scene.camera, scene.T_cam_world,
    )  # fmt: skip


def _nearly_equal_depths() -> Scene:
    """A wall seen head-on, with depths that differ in the lowest bits alone, and one Gaussian far away."""
    scene = scenes.random_scene(10, 700, 37, 8)
    wall = scene.gaussians.means.clone()
    wall *= 2.0 / wall[:, 2:]
    wall[:, 2] += torch.randperm(len(wall), generator=torch.Generator().manual_seed(10)) * 2.0**-22
    wall[-1] *= 1e6
    gaussians = Gaussians(wall, scene.gaussians.log_scales, scene.gaussians.logit_opacities - 1.0, scene.gaussians.rgb)
    return Scene(gaussians, scene.camera, torch.eye(4, dtype=torch.float64))


def _none() -> Scene:
    return scenes.random_scene(0, 0, 21, 13)


SCENES = {
    'random': scenes.random_scene(1, 300, 64, 48),
    'odd size': scenes.random_scene(2, 300, 61, 45),
    'smaller than a tile': scenes.random_scene(3, 40, 5, 3),
    'one pixel': scenes.random_scene(3, 40, 1, 1),
    'many, deep': scenes.random_scene(4, 3000, 33, 25),
    'thousands in a tile': scenes.random_scene(10, 6000, 8, 8, sigma_px=0.5, logit=-4.0),  # three parts of kPart (kernels.hpp)
    'behind the camera': _behind(5),
    'nearly equal depths': _nearly_equal_depths(),
    'empty': _none(),
    'huge': scenes.random_scene(6, 60, 50, 37, sigma_px=60.0),
    'tiny': scenes.random_scene(7, 400, 50, 37, sigma_px=0.01),
    'opaque': scenes.random_scene(8, 300, 50, 37, logit=6.0),
    'faint': scenes.random_scene(9, 300, 50, 37, logit=-5.0),
    'at the left border': scenes.one((-0.59 * 2, 0.0, 2.0), 0.05, 0.7, scenes.camera(40, 30)),
    'anisotropic': scenes.anisotropic_scene(31, 300, 61, 45),
    'anisotropic, many': scenes.anisotropic_scene(32, 3000, 33, 25),
    'anisotropic, opaque': scenes.anisotropic_scene(33, 200, 50, 37, logit=6.0),
    'anisotropic, none': scenes.anisotropic_scene(34, 0, 21, 13),
    'at the near plane': scenes.one((0.0, 0.0, 0.2000001), 0.01, 0.7, scenes.camera(40, 30)),
    'small': scenes.random_scene(41, 120, 37, 27),
    'small, deep': scenes.random_scene(42, 400, 13, 9),
    'small, huge': scenes.random_scene(43, 40, 26, 19, sigma_px=40.0),
    'small, tiny': scenes.random_scene(44, 120, 26, 19, sigma_px=0.01),
    'small, opaque': scenes.random_scene(45, 120, 26, 19, logit=6.0),
}
INTERPRETED = ('small', 'smaller than a tile', 'one pixel', 'empty', 'at the left border', 'at the near plane')
FITTED = (
    'random',
    'odd size',
    'smaller than a tile',
    'many, deep',
    'thousands in a tile',
    'behind the camera',
    'empty',
    'opaque',
    'small, opaque',
)


def _cases(names: Iterable[str]) -> list[tuple[str, str, int]]:
    """Every backend with every scene that it draws; Triton's interpreter takes seconds for a thousand pixels."""
    interpreted = scenes.device_of('triton') == 'cpu'
    return [
        (name, backend, threads)
        for backend, threads in BACKENDS
        for name in names
        if backend != 'triton' or (not name.startswith('anisotropic') and (not interpreted or name.startswith(INTERPRETED)))
    ]


@pytest.mark.parametrize(('name', 'backend', 'threads'), _cases(SCENES))
def test_backend_equals_reference(name: str, backend: str, threads: int) -> None:
    """Image and every gradient, map and pose."""
    _assert_equals_reference(make_rasterizer(backend, threads), SCENES[name], scenes.device_of(backend))


def _assert_equals_reference(rasterizer: Rasterizer, scene: Scene, device: str = 'cpu') -> None:
    clear = scenes.clear_pixels(scene)
    assert clear.float().mean() > 0.9
    generator = torch.Generator().manual_seed(0)
    weights = torch.randn(5, scene.camera.height, scene.camera.width, generator=generator) * clear
    expected, expected_gradients = scenes.render_with_gradients(ReferenceRasterizer(), scene, torch.float64, weights)
    actual, gradients = scenes.render_with_gradients(rasterizer, scene, torch.float32, weights, device)
    assert _relative_error(actual * clear, expected * clear) < IMAGE_TOLERANCE
    for parameter, gradient in expected_gradients.items():
        assert _relative_error(gradients[parameter], gradient) < GRADIENT_TOLERANCE, parameter


@pytest.mark.parametrize(
    'name', ['odd size', 'smaller than a tile', 'many, deep', 'thousands in a tile', 'behind the camera', 'opaque', 'huge', 'tiny']
)
@pytest.mark.parametrize('isa', ['generic', 'avx2', 'avx512'])
def test_every_instruction_set_equals_reference(isa: str, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the processor has it: the run-time choice must not change image, gradients, fit or update.

    Alignment: ``test_torch_aligner.py``.
    """
    monkeypatch.setenv('SPLATAM_ISA', isa)
    rasterizer = CpuRasterizer(1)
    if rasterizer.instruction_set != isa:
        pytest.skip(f'this processor runs {rasterizer.instruction_set}, not {isa}')
    _assert_equals_reference(rasterizer, SCENES[name])
    if name in FITTED:
        _assert_fits_like_the_reference(rasterizer, SCENES[name])


@pytest.mark.parametrize('isa', ['avx3', 'AVX2', 'neon'])
def test_an_unknown_instruction_set_is_one_line(isa: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv('SPLATAM_ISA', isa)
    for make in (lambda: make_rasterizer('cpu', 1), lambda: native.make_native_aligner(1)):
        with pytest.raises(RasterizerError, match=f"SPLATAM_ISA is '{isa}'; expected generic, avx2 or avx512"):
            make()


def test_a_missing_native_module_is_said_where_it_is_needed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not at import: a GPU, and the reference, need none."""
    monkeypatch.setitem(sys.modules, 'splatam_core._native', None)
    monkeypatch.delattr(splatam_core, '_native', raising=False)
    native._extension.cache_clear()
    for needs_it in (lambda: make_rasterizer('cpu'), lambda: native.make_native_aligner(1)):
        with pytest.raises(RasterizerError, match=r"cannot be loaded .* build it with 'pip install \.'") as error:
            needs_it()
        assert '\n' not in str(error.value)
    make_rasterizer('reference')


def test_fitting_natively_refuses_arrays_that_it_would_copy() -> None:
    """A copy would be fitted, and dropped."""
    scene = SCENES['odd size']
    gaussians, count = scenes.on_device(scene.gaussians, 'cpu'), len(scene.gaussians)
    wide = torch.zeros(count, 6)
    strided = Gaussians(wide[:, ::2], gaussians.log_scales, gaussians.logit_opacities, gaussians.rgb)
    moments = Moments(torch.zeros(count, 16), torch.zeros(count, dtype=torch.uint8))
    with pytest.raises(TypeError, match='means'):
        make_rasterizer('cpu', 1).fit(strided, moments, Rates(1e-4, 1e-3, 0.05, 2.5e-3), _target(scene))


def _target(scene: Scene, device: str = 'cpu') -> Target:
    """Noise, with holes in the depth, and a corner that is not compared."""
    camera, generator = scene.camera, torch.Generator().manual_seed(1)
    rgb8 = torch.randint(0, 256, (camera.height, camera.width, 3), generator=generator, dtype=torch.uint8)
    depth = 4 * torch.rand(camera.height, camera.width, generator=generator)
    depth[depth < 0.5] = 0.0
    depth[: camera.height // 3, : camera.width // 3] = NOT_COMPARED
    return Target(camera, rgb8.to(device), depth.to(device), scene.T_cam_world.float().to(device), 0.5, 1.0)


def _fitted(
    rasterizer: Rasterizer, scene: Scene, steps: int, device: str = 'cpu'
) -> tuple[list[torch.Tensor], Moments, list[float]]:
    gaussians, count, target = scenes.on_device(scene.gaussians, device), len(scene.gaussians), _target(scene, device)
    moments = Moments(torch.zeros(count, 16, device=device), torch.zeros(count, dtype=torch.uint8, device=device))
    rates = Rates(means=1e-4, log_scales=1e-3, logit_opacities=0.05, rgb=2.5e-3)
    losses = [float(rasterizer.fit(gaussians, moments, rates, target)) for _ in range(steps)]
    values = [getattr(gaussians, name).cpu() for name in scenes.PARAMETERS]
    return values, Moments(moments.first_second.cpu(), moments.steps.cpu()), losses


@pytest.mark.parametrize(('name', 'backend', 'threads'), _cases(FITTED))
def test_fitting_steps_equal_the_reference(name: str, backend: str, threads: int) -> None:
    """Five steps of rendering, Huber's loss and Adam in native code, against the same written with autograd."""
    _assert_fits_like_the_reference(make_rasterizer(backend, threads), SCENES[name], scenes.device_of(backend))


def _assert_fits_like_the_reference(rasterizer: Rasterizer, scene: Scene, device: str = 'cpu') -> None:
    expected, expected_moments, expected_losses = _fitted(ReferenceRasterizer(), scene, 5)
    actual, moments, losses = _fitted(rasterizer, scene, 5, device)
    assert losses == pytest.approx(expected_losses, rel=1e-5, abs=1e-7)  # float32 sums over the image
    assert losses == sorted(losses, reverse=True)
    # Adam makes full steps of the faintest gradients, so values are compared by what they lead to (the losses); the
    # gradients themselves by the moments. A pixel whose alpha is on a threshold may fall on either side: hence 99 %.
    first, expected_first = moments.first_second[:, :8], expected_moments.first_second[:, :8]
    close = (first - expected_first).abs() <= 1e-3 * expected_first.abs().amax(dim=0, keepdim=True) if len(first) else first
    assert close.float().mean() > 0.99 or not len(first)
    assert (moments.steps == expected_moments.steps).float().mean() > 0.99 or not len(first)
    for one, other in zip(actual, expected, strict=True):
        assert one.shape == other.shape and torch.isfinite(one).all()


def _by_triton(tile: int) -> Rasterizer:
    from splatam_core.rasterizer.triton.rasterizer import TritonRasterizer

    return TritonRasterizer(tile)


@pytest.mark.parametrize('isa', ['generic', 'avx2', 'avx512', 'triton'])
def test_squares_that_are_fitted_well_are_left_as_they_are(isa: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where half of a view is what the map shows, its squares of 8x8 pixels give no gradients: by every backend the same ones.

    61x27 pixels: the last squares of a row and of a column are smaller.
    """
    monkeypatch.setenv('SPLATAM_ISA', 'generic' if isa == 'triton' else isa)
    scene, device = scenes.random_scene(46, 150, 61, 27), scenes.device_of('triton') if isa == 'triton' else 'cpu'
    rasterizer = _by_triton(FIT_TILE) if isa == 'triton' else CpuRasterizer(1)
    if isa != 'triton' and rasterizer.instruction_set != isa:
        pytest.skip(f'this processor runs {rasterizer.instruction_set}, not {isa}')
    render = ReferenceRasterizer().render(scene.gaussians.detached(), scene.camera, scene.T_cam_world)
    noise = 0.5 * torch.rand(3, 27, 61, generator=torch.Generator().manual_seed(2)) * (torch.arange(61) >= 24)
    rgb8 = (255 * (render.rgb + noise)).clamp(0, 255).round().byte().permute(1, 2, 0).contiguous()
    fitted = []
    for backend, at, enough in (
        (rasterizer, device, 0.01),
        (ReferenceRasterizer(), 'cpu', 0.01),
        (ReferenceRasterizer(), 'cpu', 0.0),
    ):
        g, n = scenes.on_device(scene.gaussians, at), len(scene.gaussians)
        moments = Moments(torch.zeros(n, 16, device=at), torch.zeros(n, dtype=torch.uint8, device=at))
        target = Target(
            scene.camera, rgb8.to(at), render.depth_acc.float().to(at), scene.T_cam_world.float().to(at), 1.0, 1.0, enough
        )
        loss = float(backend.fit(g, moments, Rates(1e-4, 1e-3, 0.05, 2.5e-3), target))
        fitted.append((loss, moments.steps.cpu(), moments.first_second[:, :8].cpu()))
    (loss, steps, first), (expected_loss, expected_steps, expected_first), (_, all_steps, _) = fitted
    assert loss == pytest.approx(expected_loss, rel=1e-5)
    assert torch.equal(steps, expected_steps) and 0 < 1.3 * int(steps.sum()) < int(all_steps.sum())
    assert torch.allclose(first, expected_first, atol=1e-4 * float(expected_first.abs().max()))


@pytest.mark.parametrize(('backend', 'threads'), [('reference', 1), ('cpu', 2), ('triton', 0)])
def test_pixels_that_are_not_compared_change_nothing(backend: str, threads: int) -> None:
    scene, device = SCENES['odd size'], scenes.device_of(backend)
    target, fitted = _target(scene, device), []
    for value in (0, 255):
        gaussians, count = scenes.on_device(scene.gaussians, device), len(scene.gaussians)
        moments = Moments(torch.zeros(count, 16, device=device), torch.zeros(count, dtype=torch.uint8, device=device))
        target.rgb8[target.depth == NOT_COMPARED] = value
        loss = float(make_rasterizer(backend, threads).fit(gaussians, moments, Rates(1e-4, 1e-3, 0.05, 2.5e-3), target))
        fitted.append([loss, *(getattr(gaussians, name).cpu() for name in scenes.PARAMETERS)])
    assert all(np.array_equal(*values) for values in zip(*fitted, strict=True))


@pytest.mark.parametrize('scene', [scenes.random_scene(11, 25, 16, 12), scenes.anisotropic_scene(11, 25, 16, 12)])
def test_reference_gradients_equal_finite_differences(scene: Scene) -> None:
    """Central differences in float64, along random directions in all parameters and the pose at once."""
    weights = torch.randn(5, 12, 16, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    _, gradients = scenes.render_with_gradients(ReferenceRasterizer(), scene, torch.float64, weights)
    generator = torch.Generator().manual_seed(3)
    for _ in range(5):
        direction = {
            name: torch.randn(gradient.shape, generator=generator, dtype=torch.float64) for name, gradient in gradients.items()
        }
        slope = sum((direction[name] * gradient).sum() for name, gradient in gradients.items())
        # 1e-8: no pixel crosses a threshold in so small a step, and float64 still resolves the difference to 1e-6.
        difference = (_loss(scene, direction, 1e-8, weights) - _loss(scene, direction, -1e-8, weights)) / 2e-8
        assert difference == pytest.approx(float(slope), rel=1e-5)


def _loss(scene: Scene, direction: dict[str, torch.Tensor], step: float, weights: torch.Tensor) -> float:
    names = scenes.parameters(scene.gaussians)
    moved = {name: getattr(scene.gaussians, name) + step * direction[name] for name in names}
    T = scene.T_cam_world.clone()
    T[:3] += step * direction['T_cam_world']
    return float((scenes.images(ReferenceRasterizer().render(Gaussians(**moved), scene.camera, T)) * weights).sum())


ALL = [('reference', 1), ('cpu', 2), ('triton', 0)]


def _draw(backend: str, threads: int, scene: Scene) -> torch.Tensor:
    device = scenes.device_of(backend)
    gaussians, pose = scenes.on_device(scene.gaussians, device), scene.T_cam_world.float().to(device)
    return scenes.images(make_rasterizer(backend, threads).render(gaussians, scene.camera, pose)).cpu()


@pytest.mark.parametrize(('backend', 'threads'), ALL)
def test_one_gaussian_by_hand(backend: str, threads: int) -> None:
    """Peak at its projection, width and depth from the contract's formulas."""
    cam = scenes.camera(41, 31)
    z, sigma_m, opacity = 2.0, 0.1, 0.6
    x, y = (20 - cam.cx) / cam.fx * z, (15 - cam.cy) / cam.fy * z  # onto the centre of pixel (20, 15)
    image = _draw(backend, threads, scenes.one((x, y, z), sigma_m, opacity, cam))
    variance = ((cam.fx + cam.fy) / 2 * sigma_m / z) ** 2 + 0.3
    assert float(image[4, 15, 20]) == pytest.approx(opacity, rel=1e-5)
    assert float(image[4, 15, 23]) == pytest.approx(opacity * math.exp(-9 / (2 * variance)), rel=1e-5)
    assert float(image[3, 15, 20]) == pytest.approx(z * opacity, rel=1e-5)
    reach = math.sqrt(2 * math.log(opacity / MIN_ALPHA) * variance)
    touched = torch.nonzero(image[4])
    assert int((touched - torch.tensor([15, 20])).pow(2).sum(1).max()) <= reach**2


@pytest.mark.parametrize(('backend', 'threads'), [('reference', 1), ('cpu', 2)])
def test_one_ellipse_by_hand(backend: str, threads: int) -> None:
    """A needle on the optical axis, turned by 30 degrees about it, and the camera by another 15: 45 degrees on the image."""
    cam, z = PinholeCamera(41, 31, 40.0, 40.0, 20.0, 15.0), 2.0
    turn = math.radians(15.0)
    needle = Gaussians(
        torch.tensor([[0.0, 0.0, z]]),
        torch.log(torch.tensor([[0.3, 0.05, 0.01]])),
        torch.tensor([0.0]),
        torch.ones(1, 3),
        rotations=2.0 * torch.tensor([[math.cos(turn), 0.0, 0.0, math.sin(turn)]]),  # any length will do
    )
    roll = torch.from_numpy(se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, turn]))).float()
    image = scenes.images(make_rasterizer(backend, threads).render(needle, cam, roll))
    along, across = ((cam.fx * radius / z) ** 2 + 0.3 for radius in (0.3, 0.05))
    assert float(image[4, 15, 20]) == pytest.approx(0.5, rel=1e-5)
    assert float(image[4, 18, 23]) == pytest.approx(0.5 * math.exp(-18 / (2 * along)), rel=1e-4)  # (3, 3): u right, v down
    assert float(image[4, 16, 19]) == pytest.approx(0.5 * math.exp(-2 / (2 * across)), rel=1e-4)  # (-1, 1)
    assert float(image[3, 15, 20]) == pytest.approx(z * 0.5, rel=1e-5)


def test_equal_radii_are_the_isotropic_gaussian_up_to_the_projection_s_stretch() -> None:
    """On the axis they agree; off it the variance grows by 1 + tan^2 along the direction outwards (base.py)."""
    cam = PinholeCamera(81, 61, 60.0, 60.0, 40.0, 30.0)
    rasterizer, pose = make_rasterizer('reference'), torch.eye(4, dtype=torch.float64)
    centred = scenes.one((0.0, 0.0, 2.0), 0.1, 0.6, cam).gaussians
    aside = scenes.one((1.0, 0.0, 2.0), 0.1, 0.6, cam).gaussians  # tan = 0.5, at pixel 70
    one, other = (scenes.images(rasterizer.render(g, cam, pose)) for g in (centred, centred.anisotropic()))
    torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-12)
    silhouette = rasterizer.render(aside.anisotropic(), cam, pose).silhouette
    variance = (60.0 * 0.1 / 2) ** 2
    assert float(silhouette[30, 74]) == pytest.approx(0.6 * math.exp(-16 / (2 * (1.25 * variance + 0.3))), rel=1e-9)
    assert float(silhouette[34, 70]) == pytest.approx(0.6 * math.exp(-16 / (2 * (variance + 0.3))), rel=1e-9)


@pytest.mark.parametrize('backend', ['cpu', 'reference'])
def test_fused_fitting_refuses_anisotropic_gaussians(backend: str) -> None:
    scene = SCENES['anisotropic']
    moments = Moments(torch.zeros(300, 16), torch.zeros(300, dtype=torch.uint8))
    with pytest.raises(RasterizerError, match='anisotropic'):
        make_rasterizer(backend, 1).fit(scene.gaussians, moments, Rates(1e-4, 1e-3, 0.05, 2.5e-3), _target(scene))


@pytest.mark.parametrize(('backend', 'threads'), ALL)
def test_nearer_gaussian_hides_the_farther(backend: str, threads: int) -> None:
    """Blended front to back by depth, whatever the order in the map; alpha never above 0.99."""
    cam = scenes.camera(9, 9)
    near, far = (scenes.one((0.0, 0.0, z), 30.0, 0.9999, cam).gaussians for z in (1.0, 2.0))
    both = Gaussians(*(torch.cat([getattr(far, n), getattr(near, n)]) for n in scenes.PARAMETERS))
    image = _draw(backend, threads, Scene(both, cam, torch.eye(4, dtype=torch.float64)))
    u, v = round(cam.cx), round(cam.cy)
    second = (1 - MAX_ALPHA) * MAX_ALPHA
    assert float(image[4, v, u]) == pytest.approx(MAX_ALPHA + second, rel=1e-4)
    assert float(image[3, v, u]) == pytest.approx(1.0 * MAX_ALPHA + 2.0 * second, rel=1e-4)


@pytest.mark.parametrize(('backend', 'threads'), ALL)
def test_blending_stops_once_a_pixel_is_opaque(backend: str, threads: int) -> None:
    """At alpha 0.95 transmittance is 0.05, 2.5e-3, 1.25e-4, 6.25e-6: the fourth layer counts, the fifth does not."""
    cam = scenes.camera(9, 9)
    u, v = round(cam.cx), round(cam.cy)
    silhouettes = []
    for count in (3, 4, 6):
        layers = [scenes.one((0.0, 0.0, 1 + 0.1 * k), 30.0, 0.95, cam).gaussians for k in range(count)]
        stack = Gaussians(*(torch.cat([getattr(g, n) for g in layers]) for n in scenes.PARAMETERS))
        image = _draw(backend, threads, Scene(stack, cam, torch.eye(4, dtype=torch.float64)))
        silhouettes.append(float(image[4, v, u]))
    assert silhouettes[0] < silhouettes[1] == silhouettes[2]


@pytest.mark.parametrize(('backend', 'threads'), ALL)
def test_gaussians_nearer_than_the_near_plane_are_not_drawn(backend: str, threads: int) -> None:
    """z <= 0.2 m, and behind the camera."""
    for z in (0.19, 0.0, -1.0):
        assert not _draw(backend, threads, scenes.one((0.0, 0.0, z), 0.1, 0.9, scenes.camera(16, 16))).any()


@pytest.mark.parametrize('value', [math.nan, math.inf])
@pytest.mark.parametrize('backend', ['cpu', 'triton'])
def test_gaussians_that_are_not_finite_spoil_nothing(value: float, backend: str) -> None:
    """A broken centre is not drawn; the others are."""
    scene = scenes.random_scene(12, 50, 32, 24)
    g = scene.gaussians
    broken = torch.cat([g.means, torch.full((1, 3), value, dtype=torch.float64)])
    more = Gaussians(
        broken, torch.cat([g.log_scales, g.log_scales[:1]]),
        torch.cat([g.logit_opacities, g.logit_opacities[:1]]), torch.cat([g.rgb, g.rgb[:1]]),
    )  # fmt: skip
    torch.testing.assert_close(
        _draw(backend, 2, Scene(more, scene.camera, scene.T_cam_world)), _draw(backend, 2, scene), rtol=0, atol=0
    )


@pytest.mark.parametrize('name', ['many, deep', 'anisotropic, many'])
def test_threads_do_not_change_the_image_and_repeats_do_not_change_gradients(name: str) -> None:
    """Bit for bit."""
    scene = SCENES[name]
    weights = torch.randn(5, 25, 33, generator=torch.Generator().manual_seed(4))
    runs = [
        scenes.render_with_gradients(make_rasterizer('cpu', threads), scene, torch.float32, weights) for threads in (1, 2, 2, 5)
    ]
    for image, _ in runs[1:]:
        assert torch.equal(image, runs[0][0])
    for name, gradient in runs[1][1].items():
        assert torch.equal(gradient, runs[2][1][name])


@pytest.mark.parametrize('backend', ['cpu', 'triton'])
def test_two_renders_before_their_backwards(backend: str) -> None:
    """What one forward pass keeps for its backward pass survives another forward pass."""
    first, second = scenes.random_scene(20, 60, 20, 15), scenes.random_scene(21, 90, 26, 19)
    rasterizer, device = make_rasterizer(backend, 2), scenes.device_of(backend)
    leaves = [getattr(first.gaussians, n).to(device, torch.float32).requires_grad_() for n in scenes.PARAMETERS]
    image = scenes.images(rasterizer.render(Gaussians(*leaves), first.camera, first.T_cam_world.float()))
    scenes.render_with_gradients(rasterizer, second, torch.float32, torch.ones(5, 19, 26), device)
    image.sum().backward()
    _, expected = scenes.render_with_gradients(rasterizer, first, torch.float32, torch.ones(5, 15, 20), device)
    assert torch.equal(leaves[0].grad.cpu(), expected['means'])


@pytest.mark.parametrize('backend', ['cpu', 'triton'])
def test_wrong_input_is_refused(backend: str) -> None:
    """Before it reaches the kernels."""
    scene = scenes.random_scene(1, 10, 16, 12)
    with pytest.raises(RasterizerError, match=r'float64|on cpu; the triton'):
        make_rasterizer(backend, 1).render(scene.gaussians, scene.camera, scene.T_cam_world)


def _relative_error(actual: torch.Tensor, expected: torch.Tensor) -> float:
    if expected.numel() == 0:
        return float(actual.numel())
    scale = max(float(expected.abs().max()), 1e-3)
    return float((actual.double() - expected.double()).abs().max()) / scale
