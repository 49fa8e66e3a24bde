"""The Triton backend: capacity of tile lists, the pose-only path, what it refuses, and that its kernels compile.

The contract, and agreement with the reference, are in ``test_rasterizer_contract.py``.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import rasterizer_scenes as scenes
import torch
from rasterizer_scenes import Scene

from splatam_core.config import load_config
from splatam_core.datasets.synthetic import SyntheticSequence
from splatam_core.errors import RasterizerError
from splatam_core.mapping.gaussian_map import GaussianMap
from splatam_core.rasterizer import Gaussians, Moments, Rates, Target, make_rasterizer
from splatam_core.rasterizer.triton.lists import Capacity
from splatam_core.rasterizer.triton.rasterizer import TritonRasterizer
from splatam_core.slam import Slam
from splatam_core.types import Status

ROOT = Path(__file__).resolve().parents[2]
DEVICE = scenes.device_of('triton')
RATES = Rates(means=1e-4, log_scales=1e-3, logit_opacities=0.05, rgb=2.5e-3)
SCENE = scenes.random_scene(51, 90, 26, 19)


class FixedCapacity(Capacity):
    """Always the same capacity, sufficient or not."""

    def __init__(self, entries: int) -> None:
        super().__init__()
        self.entries = entries

    def of(self, total: torch.Tensor, num_gaussians: int, num_tiles: int) -> int:
        assert int(total) > 100  # else the tests below would not overflow
        return self.entries


def _weights(scene: Scene) -> torch.Tensor:
    return torch.randn(5, scene.camera.height, scene.camera.width, generator=torch.Generator().manual_seed(0))


def _pose_gradient(rasterizer: TritonRasterizer, scene: Scene, wants_means: bool) -> torch.Tensor:
    gaussians, pose = scenes.on_device(scene.gaussians, DEVICE), scene.T_cam_world.to(DEVICE, torch.float32).requires_grad_()
    gaussians.means.requires_grad_(wants_means)
    image = scenes.images(rasterizer.render(gaussians, scene.camera, pose))
    (image * _weights(scene).to(DEVICE)).sum().backward()
    assert (gaussians.means.grad is not None) == wants_means
    return pose.grad.cpu()


def test_the_pose_alone_gets_the_gradient_that_it_gets_beside_the_map() -> None:
    """Summed by pixel or by Gaussian: the same to float32. The last row is constant."""
    beside, alone = (_pose_gradient(TritonRasterizer(), SCENE, wants_means) for wants_means in (True, False))
    assert float((alone - beside).abs().max()) < 1e-5 * float(beside.abs().max())
    assert not alone[3].any() and alone[:3].all()


def test_lists_beyond_their_capacity_change_nothing_but_the_time() -> None:
    """Image, gradients by map and pose, and a fitting step, where no tile's list is complete."""
    enough, too_small = TritonRasterizer(), TritonRasterizer(capacity=FixedCapacity(16))
    image, gradients = scenes.render_with_gradients(enough, SCENE, torch.float32, _weights(SCENE), DEVICE)
    same_image, same_gradients = scenes.render_with_gradients(too_small, SCENE, torch.float32, _weights(SCENE), DEVICE)
    torch.testing.assert_close(same_image, image, rtol=0, atol=1e-5)
    for name, gradient in gradients.items():
        assert float((same_gradients[name] - gradient).abs().max()) < 5e-5 * float(gradient.abs().max()), name
    alone = _pose_gradient(too_small, SCENE, wants_means=False)
    assert float((alone[:3] - gradients['T_cam_world']).abs().max()) < 5e-5 * float(gradients['T_cam_world'].abs().max())
    loss, first = _fit(enough, SCENE)
    same_loss, same_first = _fit(too_small, SCENE)
    assert same_loss == pytest.approx(loss, rel=1e-5)
    # Residuals near zero take the sign of their gradient from rounding.
    assert float((same_first - first).abs().max()) < 1e-3 * float(first.abs().max())


def _fit(rasterizer: TritonRasterizer, scene: Scene) -> tuple[float, torch.Tensor]:
    """Loss, and first moments of one step: gradients, that is."""
    moments = _moments(len(scene.gaussians))
    loss = rasterizer.fit(scenes.on_device(scene.gaussians, DEVICE), moments, RATES, _target(scene))
    return float(loss), moments.first_second[:, :8].cpu()


def _moments(count: int) -> Moments:
    return Moments(torch.zeros(count, 16, device=DEVICE), torch.zeros(count, dtype=torch.uint8, device=DEVICE))


def _target(scene: Scene) -> Target:
    camera = scene.camera
    rgb8 = torch.full((camera.height, camera.width, 3), 90, dtype=torch.uint8, device=DEVICE)
    depth = torch.full((camera.height, camera.width), 2.0, device=DEVICE)
    return Target(camera, rgb8, depth, scene.T_cam_world.float(), 0.5, 1.0)


def test_capacity_is_two_fifths_more_than_was_needed_and_follows_one_view_later() -> None:
    """The host waits for the first view, and for a much larger map; growth shows one view later."""
    capacity = Capacity()

    def chosen(entries: int, gaussians: int = 1000) -> int:
        return capacity.of(torch.tensor([entries]), gaussians, 100)  # tensors of the CPU arrive at once

    assert chosen(10_000) == 14_000
    assert chosen(15_000) == 14_000 and chosen(15_000) == 21_000
    assert chosen(20_000) == 21_000 and chosen(20_000) == 28_000
    assert chosen(100_000, gaussians=1300) == 140_000
    steady = [chosen(10_000, gaussians=1300) for _ in range(300)]
    assert steady[0] == 140_000 and steady[-1] < 31_000  # memory is given back in time


def test_a_view_of_too_many_entries_is_refused_in_one_line() -> None:
    """The lists used to take as much memory as they liked."""
    capacity = Capacity()
    for gaussians in (1000, 1000):  # the first view, and every one after it until there are fewer entries
        with pytest.raises(RasterizerError, match='cover 67108865 tiles of the image, and at most 67108864 can be drawn'):
            capacity.of(torch.tensor([2**26 + 1]), gaussians, 100)
    assert capacity.of(torch.tensor([10_000]), 1000, 100) == 14_000  # it goes on
    capacity.of(torch.tensor([2**27]), 1001, 100)  # of a little larger map the number is known one view later
    with pytest.raises(RasterizerError, match='134217728 tiles'):
        capacity.of(torch.tensor([10_000]), 1001, 100)
    assert capacity.of(torch.tensor([10_000]), 1001, 100) == 14_000


@pytest.mark.parametrize('tile', [8, 32])
def test_the_size_of_tiles_changes_nothing(tile: int) -> None:
    image, gradients = scenes.render_with_gradients(TritonRasterizer(), SCENE, torch.float32, _weights(SCENE), DEVICE)
    same, same_gradients = scenes.render_with_gradients(TritonRasterizer(tile), SCENE, torch.float32, _weights(SCENE), DEVICE)
    torch.testing.assert_close(same, image, rtol=0, atol=1e-5)
    for name, gradient in gradients.items():
        assert float((same_gradients[name] - gradient).abs().max()) < 5e-5 * float(gradient.abs().max()), name


def test_the_same_again_bit_for_bit() -> None:
    """No sum depends on which program comes first."""
    runs = [scenes.render_with_gradients(TritonRasterizer(), SCENE, torch.float32, _weights(SCENE), DEVICE) for _ in range(2)]
    assert torch.equal(runs[0][0], runs[1][0])
    assert all(torch.equal(gradient, runs[1][1][name]) for name, gradient in runs[0][1].items())


def test_equal_depths_keep_the_order_of_the_map() -> None:
    """Of two Gaussians in one place the first in the map is in front."""
    camera = scenes.camera(9, 9)
    one = scenes.one((0.0, 0.0, 2.0), 1.0, 0.9, camera).gaussians
    for order in ([1.0, 0.0], [0.0, 1.0]):
        rgb = torch.tensor([[red, 0.0, 1.0 - red] for red in order])
        both = Gaussians(one.means.repeat(2, 1), one.log_scales.repeat(2, 1), one.logit_opacities.repeat(2), rgb)
        render = TritonRasterizer().render(scenes.on_device(both, DEVICE), camera, torch.eye(4))
        red, _, blue = render.rgb[:, 4, 4].tolist()
        assert (red > 2 * blue) == (order[0] == 1.0)


def test_bounds_grow_with_what_is_fitted() -> None:
    """So that the map can be given to a rasterizer that skips blocks out of view."""
    gaussians = GaussianMap()
    gaussians.append(scenes.on_device(SCENE.gaussians, 'cpu'))
    g = gaussians.gaussians
    on_device = Gaussians(*(values.to(DEVICE) for values in (g.means, g.log_scales, g.logit_opacities, g.rgb, g.bounds)))
    before = on_device.bounds.clone()
    moments = _moments(len(g))
    for _ in range(2):
        TritonRasterizer().fit(on_device, moments, Rates(0.05, 0.1, 0.05, 0.01), _target(SCENE))
    lowest, highest = on_device.means.amin(dim=0), on_device.means.amax(dim=0)
    bounds = on_device.bounds[0]
    assert (bounds[:3] <= lowest).all() and (bounds[3:6] >= highest).all() and bounds[6] >= on_device.log_scales.max()
    assert (bounds[:3] <= before[0, :3]).all() and (bounds[3:] >= before[0, 3:]).all() and not torch.equal(bounds, before[0])


@pytest.mark.slow
def test_frames_find_the_poses_of_the_cpu(room: Callable[..., SyntheticSequence]) -> None:
    """The whole of ``Slam.process``, the paper's way: from the same state poses agree within 0.2 mm, as GPUs are to.

    Alignment, and fitting in the kernels, are in ``test_slam_triton.py``.
    Few pixels and steps, for the interpreter's sake, and short ones, so that a step or two find a better pose than the guess.
    """
    few = [
        'threads=1', 'tracking.iterations=3', 'tracking.paper.translation_rate=0.0005', 'tracking.paper.rotation_rate=0.0001',
        'mapping.iterations=2', 'mapping.first_iterations=2', 'mapping.prune_scale=1.0', 'keyframes.every=3',
    ]  # fmt: skip
    sequence = room(5, 16, noise=False)
    there = Slam(load_config('splatam', [*few, 'rasterizer=triton', f'device={DEVICE}']))
    host = Slam(load_config('splatam', [*few, 'rasterizer=cpu', 'device=cpu']))
    for index in range(5):
        host.restore(there.state())
        found, expected = there.process(sequence[index]), host.process(sequence[index])
        assert found.status is expected.status is (Status.TRACKED if index else Status.INITIALIZED)
        assert np.abs(found.T_world_cam - expected.T_world_cam).max() < 2e-4
        assert found.num_gaussians == pytest.approx(expected.num_gaussians, abs=2)  # a pixel on the silhouette's limit
    assert np.abs(found.T_world_cam[:3, 3]).max() > 1e-3


def test_anisotropic_gaussians_are_refused() -> None:
    scene = scenes.anisotropic_scene(1, 10, 16, 12)
    with pytest.raises(RasterizerError, match='anisotropic.*rasterizer=cpu'):
        make_rasterizer('triton').render(scenes.on_device(scene.gaussians, DEVICE), scene.camera, torch.eye(4))


def test_images_that_tile_numbers_cannot_hold_are_refused() -> None:
    scene = scenes.random_scene(1, 1, 1, 1)
    object.__setattr__(scene.camera, 'width', 4096 * 32)  # a camera itself refuses to be as wide
    with pytest.raises(RasterizerError, match='too large'):
        TritonRasterizer(32).render(scenes.on_device(scene.gaussians, DEVICE), scene.camera, torch.eye(4))


def test_fitting_refuses_what_it_could_not_write_to() -> None:
    """A strided view would be copied, and the copy fitted."""
    gaussians = scenes.on_device(SCENE.gaussians, DEVICE)
    wide = torch.zeros(len(gaussians), 6, device=DEVICE)
    strided = Gaussians(wide[:, ::2], gaussians.log_scales, gaussians.logit_opacities, gaussians.rgb)
    with pytest.raises(RasterizerError, match='means has strides'):
        make_rasterizer('triton').fit(strided, _moments(len(gaussians)), RATES, _target(SCENE))


def _python(code: str, *arguments: str, **environment: str) -> str:
    """What another process prints, Triton's interpreter off."""
    surroundings = {name: value for name, value in os.environ.items() if name != 'TRITON_INTERPRET'}
    run = subprocess.run(
        [sys.executable, '-W', 'ignore', '-c', code, *arguments], cwd=ROOT, capture_output=True, text=True, check=False,
        env=surroundings | {'PYTHONPATH': str(ROOT)} | environment,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr[-4000:]
    return run.stdout


@pytest.mark.slow
def test_tensors_of_the_cpu_need_the_interpreter() -> None:
    said = _python("""
import torch
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.rasterizer import Gaussians, make_rasterizer
try:
    g = Gaussians(torch.zeros(1, 3), torch.zeros(1, 1), torch.zeros(1), torch.zeros(1, 3))
    make_rasterizer('triton').render(g, PinholeCamera(8, 8, 8.0, 8.0, 4.0, 4.0), torch.eye(4))
except Exception as error:
    print(type(error).__name__, error)
""")
    assert said.startswith('RasterizerError the Gaussians are on cpu; the triton rasterizer takes them on cuda (torch finds ')
    assert 'TRITON_INTERPRET=1' in said and len(said.splitlines()) == 1


@pytest.mark.slow
def test_without_triton_the_error_says_what_to_install() -> None:
    said = _python("""
import sys
sys.modules['triton'] = None
from splatam_core.rasterizer import make_rasterizer
try:
    make_rasterizer('triton')
except Exception as error:
    print(type(error).__name__, error)
""")
    assert said.startswith('RasterizerError ') and 'pip install triton' in said and len(said.splitlines()) == 1


COMPILE = """
import sys
import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
from splatam_core.rasterizer.triton import kernels

POINTERS = {
    'order': 'i64', 'ends': 'i64', 'starts': 'i64', 'slots': 'i64', 'total': 'i64', 'readings': 'i64', 'rects': 'i32',
    'counts': 'i32', 'ids': 'i32', 'entries': 'i32', 'begins': 'i32', 'tiles': 'i16', 'rgb8': 'u8', 'steps': 'u8',
}
INTEGERS = {'n', 'rows', 'capacity', 'width', 'height', 'tiles_x'}
FLOATS = {
    'fx', 'fy', 'cx', 'cy', 'color_weight', 'depth_weight', 'enough', 'means_rate', 'log_scales_rate', 'logit_opacities_rate',
    'rgb_rate',
}
CONSTANTS = {'TILE': 8, 'CHUNK': 4, 'BLOCK': 256, 'HAS_BOUNDS': True}

def type_of(name):
    if name in CONSTANTS:
        return 'constexpr'
    return 'i32' if name in INTEGERS else 'fp32' if name in FLOATS else '*' + POINTERS.get(name, 'fp32')

for target, form in ((GPUTarget('cuda', 80, 32), 'cubin'), (GPUTarget('hip', 'gfx942', 64), 'hsaco')):
    for name in sys.argv[1:]:
        kernel = getattr(kernels, name)
        constants = {name: value for name, value in CONSTANTS.items() if name in kernel.arg_names}
        source = ASTSource(kernel, {name: type_of(name) for name in kernel.arg_names}, constants)
        options = {'num_warps': 1 if 'CHUNK' in constants else 4, 'enable_fp_fusion': True}
        print(form, name, len(triton.compile(source, target=target, options=options).asm[form]))
"""
LAUNCHED = (
    'project', 'list_tiles', 'blend', 'blend_backward', 'blend_backward_to_pose', 'clear_if_overflowed', 'project_backward',
    'fit_tile', 'update',
)  # fmt: skip


@pytest.mark.slow
def test_the_compiler_takes_every_kernel(tmp_path: Path) -> None:
    """Ahead of time, to machine code of a card of either maker, without a card: the interpreter takes more than the compiler."""
    said = [line.split() for line in _python(COMPILE, *LAUNCHED, TRITON_CACHE_DIR=str(tmp_path)).splitlines()]
    assert [(form, name) for form, name, _ in said] == [(form, name) for form in ('cubin', 'hsaco') for name in LAUNCHED]
    assert all(int(size) > 1000 for _, _, size in said)


def test_every_kernel_that_is_launched_is_compiled_above() -> None:
    sources = ''.join((ROOT / 'splatam_core/rasterizer/triton' / name).read_text() for name in ('rasterizer.py', 'lists.py'))
    assert set(re.findall(r'launch\(\s*kernels\.(\w+)', sources)) == set(LAUNCHED)
