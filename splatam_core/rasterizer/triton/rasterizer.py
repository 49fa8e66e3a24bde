"""The contract on a GPU: kernels in Triton, gradients written by hand.

Nothing waits for the device but the first view, one of a much larger map or image, and whoever reads a result. Sums are taken in
a fixed order, so that results repeat bit for bit on the same device, with one exception: while a view needs more room than its
tile lists got (see ``triton_lists.Capacity``), gradients by the map are summed by atomics, in any order. How soon lists get more
room depends on when the device answers.

The pose's gradient comes from sums in camera coordinates, which takes the upper left of ``T_cam_world`` to be a rotation.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from splatam_core.errors import RasterizerError
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.rasterizer.base import BETA_1, FIT_BETA_2, Gaussians, Moments, Rates, Render, Target

try:
    import triton
except ImportError as error:
    raise RasterizerError(
        f"rasterizer=triton needs Triton ({error}): pip install triton (torch's CUDA builds bring it), or use rasterizer=cpu"
    ) from None

from splatam_core.rasterizer.bounds import BLOCK as BOUNDS_BLOCK
from splatam_core.rasterizer.triton import kernels
from splatam_core.rasterizer.triton.lists import BLOCK, Capacity, Lister, View

# Pixels on a tile's side, and splats that a program takes at once. On a GPU these keep to the registers, with two pixels a
# thread; the interpreter pays by the operation, not by its size.
_TILE, _CHUNK = (16, 128) if kernels.INTERPRETED else (8, 4)
_MAX_STEPS = 255


class TritonRasterizer:
    """On ``cuda`` tensors; on those of the CPU under Triton's interpreter (``TRITON_INTERPRET=1``), for tests."""

    def __init__(self, tile: int = _TILE, capacity: Capacity | None = None) -> None:
        """Compile nothing yet.

        Args:
            tile: pixels on a side of a tile, a power of two.
            capacity: decides how much room tile lists get.
        """
        self._lister = Lister(tile, capacity or Capacity())
        self._corrections: Tensor | None = None  # on the device of the last fit

    def render(self, gaussians: Gaussians, camera: PinholeCamera, T_cam_world: Tensor) -> Render:
        """See ``Rasterizer.render``. float32 only; a pose that lies elsewhere is brought to the Gaussians' device.

        Where no Gaussian wants a gradient, none is kept: the pose's twelve entries are summed tile by tile.

        Raises:
            RasterizerError: tensors of another device, shape or type, or anisotropic Gaussians.
        """
        _check(gaussians, T_cam_world)
        with torch.cuda.device_of(gaussians.means):
            images = _Splat.apply(
                gaussians.means.contiguous(), gaussians.log_scales.contiguous(), gaussians.logit_opacities.contiguous(),
                gaussians.rgb.contiguous(), T_cam_world.to(gaussians.means.device), self._lister, camera,
            )  # fmt: skip
        return Render(*images)

    def fit(self, gaussians: Gaussians, moments: Moments, rates: Rates, target: Target) -> Tensor:
        """See ``Rasterizer.fit``. Nothing of it passes through autograd; the loss stays on the device.

        Raises:
            RasterizerError: tensors of another device, shape, type or layout, or anisotropic Gaussians.
        """
        _check(gaussians, target.T_cam_world)
        _check_fit(gaussians, moments, target)
        with torch.no_grad(), torch.cuda.device_of(gaussians.means):
            pose = target.T_cam_world.to(gaussians.means.device).contiguous()
            view = self._lister.view(gaussians, target.camera, pose)
            gradients = _cleared(view)
            losses = _fit_tiles(view, target, gradients)
            self._update(view, gradients, gaussians, moments, rates)
            return losses.sum()

    def _update(self, view: View, gradients: Tensor, gaussians: Gaussians, moments: Moments, rates: Rates) -> None:
        g, camera, n = gaussians, view.camera, len(gaussians)
        if self._corrections is None or self._corrections.device != g.means.device:
            self._corrections = _corrections().to(g.means.device)
        kernels.launch(
            kernels.update, triton.cdiv(n, BOUNDS_BLOCK),
            view.splats, view.starts, view.counts, view.total, gradients, view.pose,
            g.means, g.log_scales, g.logit_opacities, g.rgb, moments.first_second, moments.steps, self._corrections,
            g.means if g.bounds is None else g.bounds, n, view.capacity, camera.fx, camera.fy, camera.cx, camera.cy,
            rates.means, rates.log_scales, rates.logit_opacities, rates.rgb,
            HAS_BOUNDS=g.bounds is not None, BLOCK=BOUNDS_BLOCK, warps=8,
        )  # fmt: skip


class _Splat(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, means: Tensor, log_scales: Tensor, logit_opacities: Tensor, rgb: Tensor, T_cam_world: Tensor,
        lister: Lister, camera: PinholeCamera,
    ) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
        gaussians = Gaussians(*(tensor.detach() for tensor in (means, log_scales, logit_opacities, rgb)))
        view = lister.view(gaussians, camera, T_cam_world.detach().contiguous())
        size = camera.height, camera.width
        images = means.new_empty(3, *size), means.new_empty(size), means.new_empty(size)
        kernels.launch(
            kernels.blend, view.num_tiles,
            view.splats, view.order, view.entries, view.begins, view.total, *images,
            len(means), view.capacity, camera.width, camera.height, view.tiles_x, TILE=view.tile, CHUNK=_CHUNK, warps=1,
        )  # fmt: skip
        ctx.view = view
        ctx.save_for_backward(*images)
        return images

    @staticmethod
    def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor | None, ...]:
        view, images = ctx.view, ctx.saved_tensors
        slopes = tuple(slope.contiguous() for slope in slopes)
        wanted = ctx.needs_input_grad[:5]
        with torch.cuda.device_of(view.splats):
            if any(wanted[:4]):
                *by_map, sums = _map_gradients(view, images, slopes)
            else:
                by_map, sums = [None] * 4, _pose_sums(view, images, slopes)
            gradients = *by_map, _pose_gradient(sums, view.pose) if wanted[4] else None
        return *(gradient if want else None for gradient, want in zip(gradients, wanted, strict=True)), None, None


def _map_gradients(view: View, images: tuple[Tensor, ...], slopes: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """By means [N, 3], log_scales [N, 1], logit_opacities [N], rgb [N, 3]; pose sums [programs, 12]."""
    camera, n, gradients = view.camera, len(view.splats), _cleared(view)
    kernels.launch(
        kernels.blend_backward, view.num_tiles,
        view.splats, view.order, view.entries, view.slots, view.begins, view.total, *images, *slopes, gradients,
        n, view.capacity, camera.width, camera.height, view.tiles_x, TILE=view.tile, CHUNK=_CHUNK, warps=1,
    )  # fmt: skip
    new, programs = view.splats.new_empty, triton.cdiv(n, BLOCK)
    outputs = new(n, 3), new(n, 1), new(n), new(n, 3), new(programs, 12)
    kernels.launch(
        kernels.project_backward, programs,
        view.splats, view.starts, view.counts, view.total, gradients, view.pose, *outputs,
        n, view.capacity, camera.fx, camera.fy, camera.cx, camera.cy, BLOCK=BLOCK, warps=4,
    )  # fmt: skip
    return outputs


def _pose_sums(view: View, images: tuple[Tensor, ...], slopes: tuple[Tensor, ...]) -> Tensor:
    """[tiles, 12]."""
    camera, sums = view.camera, view.splats.new_empty(view.num_tiles, 12)
    kernels.launch(
        kernels.blend_backward_to_pose, view.num_tiles,
        view.splats, view.order, view.entries, view.begins, view.total, *images, *slopes, sums,
        len(view.splats), view.capacity, camera.width, camera.height, view.tiles_x,
        camera.fx, camera.fy, camera.cx, camera.cy, TILE=view.tile, CHUNK=_CHUNK, warps=1,
    )  # fmt: skip
    return sums


def _pose_gradient(sums: Tensor, pose: Tensor) -> Tensor:
    """[4, 4] by the entries of the pose, from sums of d c^T and d: c = R m + t are the centres, d the gradients by them.

    The gradient by R is the sum of d m^T, and m = R^T (c - t).
    """
    by_centre = sums.sum(dim=0).view(3, 4)
    rotation, translation = pose[:3, :3], pose[:3, 3]
    gradient = torch.zeros_like(pose)
    gradient[:3, :3] = (by_centre[:, :3] - by_centre[:, 3:] * translation) @ rotation
    gradient[:3, 3] = by_centre[:, 3]
    return gradient


def _cleared(view: View) -> Tensor:
    """[rows, 8] for gradients: of entries, or of Gaussians where the entries found no room."""
    rows = max(view.capacity, len(view.splats))
    gradients = view.splats.new_empty(rows, 8)
    block = 4096
    kernels.launch(
        kernels.clear_if_overflown, triton.cdiv(8 * rows, block),
        gradients, view.total, rows, view.capacity, BLOCK=block, warps=4,
    )  # fmt: skip
    return gradients


def _fit_tiles(view: View, target: Target, gradients: Tensor) -> Tensor:
    """[tiles] losses; gradients of the entries."""
    camera, losses = view.camera, view.splats.new_empty(view.num_tiles)
    kernels.launch(
        kernels.fit_tile, view.num_tiles,
        view.splats, view.order, view.entries, view.slots, view.begins, view.total,
        target.rgb8, target.depth, torch.count_nonzero(target.depth), gradients, losses,
        len(view.splats), view.capacity, camera.width, camera.height, view.tiles_x,
        target.color_weight / (3 * camera.width * camera.height), target.depth_weight, TILE=view.tile, CHUNK=_CHUNK, warps=1,
    )  # fmt: skip
    return losses


def _corrections() -> Tensor:
    """[256, 2] what Adam's moments are divided by after so many steps."""
    steps = torch.arange(_MAX_STEPS + 1, dtype=torch.float64)
    return torch.stack([1 - BETA_1**steps, 1 - FIT_BETA_2**steps], dim=1).float()


def _check(gaussians: Gaussians, T_cam_world: Tensor) -> None:
    if gaussians.rotations is not None:
        raise RasterizerError(
            'the Gaussians are anisotropic, and the triton rasterizer takes none: use rasterizer=cpu or rasterizer=reference'
        )
    device, n = gaussians.means.device, len(gaussians)
    _check_device(device)
    shapes = {'means': (n, 3), 'log_scales': (n, 1), 'logit_opacities': (n,), 'rgb': (n, 3)}
    for name, shape in shapes.items():
        _check_tensor(name, getattr(gaussians, name), shape, torch.float32, device)
    _check_tensor('T_cam_world', T_cam_world, (4, 4), torch.float32, T_cam_world.device)


def _check_device(device: torch.device) -> None:
    if device.type != 'cuda' and not (kernels.INTERPRETED and device.type == 'cpu'):
        found = 'a CUDA device' if torch.cuda.is_available() else 'no CUDA device'
        raise RasterizerError(
            f'the Gaussians are on {device}; the triton rasterizer takes them on cuda (torch finds {found}), on the CPU only '
            "under Triton's interpreter (TRITON_INTERPRET=1, far slower): use device=cuda, or rasterizer=cpu"
        )


def _check_tensor(name: str, tensor: Tensor, shape: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> None:
    if tensor.shape != shape or tensor.dtype != dtype or tensor.device != device:
        raise RasterizerError(
            f'{name} is {tuple(tensor.shape)} {tensor.dtype} on {tensor.device}; '
            f'the triton rasterizer takes {shape} {dtype} on {device} here'
        )


def _check_fit(gaussians: Gaussians, moments: Moments, target: Target) -> None:
    """What is written in place, or read as it lies in memory."""
    n, device, size = len(gaussians), gaussians.means.device, (target.camera.height, target.camera.width)
    expected = {
        'first_second': (moments.first_second, (n, 16), torch.float32), 'steps': (moments.steps, (n,), torch.uint8),
        'rgb8': (target.rgb8, (*size, 3), torch.uint8), 'depth': (target.depth, size, torch.float32),
    }  # fmt: skip
    if gaussians.bounds is not None:
        expected['bounds'] = gaussians.bounds, (-(-n // BOUNDS_BLOCK), 7), torch.float32
    for name, (tensor, shape, dtype) in expected.items():
        _check_tensor(name, tensor, shape, dtype, device)
    values = {name: getattr(gaussians, name) for name in ('means', 'log_scales', 'logit_opacities', 'rgb')}
    for name, tensor in (values | {name: entry[0] for name, entry in expected.items()}).items():
        if not tensor.is_contiguous():
            raise RasterizerError(
                f'{name} has strides {tensor.stride()}; the triton rasterizer fits contiguous tensors: copy it first'
            )
