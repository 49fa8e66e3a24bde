"""The contract on a GPU: kernels in Triton, gradients written by hand.

The host waits for the device at the first view, at a view of a much larger map or image, and when a result is read. Sums are
taken in a fixed order, so that results are repeatable bit for bit on one device, with one exception: while a view needs more
entries than the capacity of its tile lists (see ``lists.Capacity``), gradients by the map are summed with atomics, in any order.
When the capacity grows depends on wall time.

The pose's gradient is computed from sums in camera coordinates, which requires the upper left of ``T_cam_world`` to be a rotation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
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

# Side of a tile in pixels, and splats per step of a program. On a GPU these fit into the registers, with two pixels per thread.
# The interpreter's time depends on the number of operations, not on their size.
_TILE, _CHUNK = (16, 128) if kernels.INTERPRETED else (8, 4)
_MAX_STEPS = 255


class TritonRasterizer:
    """Takes tensors on ``cuda``, and on the CPU with Triton's interpreter (``TRITON_INTERPRET=1``), for tests."""

    def __init__(self, tile: int = _TILE, capacity: Capacity | None = None) -> None:
        """Does not compile anything yet.

        Args:
            tile: side of a tile in pixels, a power of two.
            capacity: chooses the capacity of tile lists.
        """
        self._lister = Lister(tile, capacity or Capacity())
        self._corrections: Tensor | None = None  # on the device of the last fit

    def render(self, gaussians: Gaussians, camera: PinholeCamera, T_cam_world: Tensor) -> Render:
        """See ``Rasterizer.render``. float32 only. The pose may be on another device.

        If no Gaussian needs a gradient, only the twelve sums of the pose are computed, per tile.

        Raises:
            RasterizerError: a tensor has the wrong device, shape or type, or the Gaussians are anisotropic.
        """
        _check(gaussians, T_cam_world)
        with torch.cuda.device_of(gaussians.means):
            images = _Splat.apply(
                gaussians.means.contiguous(), gaussians.log_scales.contiguous(), gaussians.logit_opacities.contiguous(),
                gaussians.rgb.contiguous(), T_cam_world.to(gaussians.means.device), _Pass(self._lister, camera),
            )  # fmt: skip
        return Render(*images)

    def fit(self, gaussians: Gaussians, moments: Moments, rates: Rates, target: Target) -> Tensor:
        """See ``Rasterizer.fit``. Does not use autograd; the loss stays on the device.

        Raises:
            RasterizerError: a tensor has the wrong device, shape, type or layout, or the Gaussians are anisotropic.
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
            splats=view.splats, starts=view.starts, counts=view.counts, total=view.total, gradients=gradients, pose=view.pose,
            means=g.means, log_scales=g.log_scales, logit_opacities=g.logit_opacities, rgb=g.rgb,
            first_second=moments.first_second, steps=moments.steps, corrections=self._corrections,
            bounds=g.means if g.bounds is None else g.bounds, n=n, capacity=view.capacity,
            fx=camera.fx, fy=camera.fy, cx=camera.cx, cy=camera.cy,
            means_rate=rates.means, log_scales_rate=rates.log_scales, logit_opacities_rate=rates.logit_opacities,
            rgb_rate=rates.rgb, HAS_BOUNDS=g.bounds is not None, BLOCK=BOUNDS_BLOCK, warps=8,
        )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class _Pass:
    """What a forward pass needs that gets no gradient.

    Attributes:
        lister: makes the view.
        camera: the image to draw.
    """

    lister: Lister
    camera: PinholeCamera


class _Splat(torch.autograd.Function):
    """Isotropic Gaussians and a pose to colour, depth_acc and silhouette."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, log_scales: Tensor, logit_opacities: Tensor, rgb: Tensor, T_cam_world: Tensor, given: _Pass
    ) -> tuple[Tensor, Tensor, Tensor]:
        gaussians, camera = Gaussians(means, log_scales, logit_opacities, rgb).detached(), given.camera
        view = given.lister.view(gaussians, camera, T_cam_world.detach().contiguous())
        size = camera.height, camera.width
        images = means.new_empty(3, *size), means.new_empty(size), means.new_empty(size)
        kernels.launch(
            kernels.blend, view.num_tiles, warps=1,
            splats=view.splats, order=view.order, entries=view.entries, begins=view.begins, total=view.total,
            **_by_name(images), n=len(means), **_tiling(view),
        )  # fmt: skip
        ctx.view = view
        ctx.save_for_backward(*images)
        return images

    @staticmethod
    def backward(ctx: Any, *image_gradients: Tensor) -> tuple[Tensor | None, ...]:
        view, images, wanted = ctx.view, ctx.saved_tensors, ctx.needs_input_grad[:5]
        drawn = _by_name(images) | _by_name([gradient.contiguous() for gradient in image_gradients], 'by_')
        by_map: Sequence[Tensor | None] = [None] * 4
        with torch.cuda.device_of(view.splats):
            if any(wanted[:4]):
                *by_map, sums = _map_gradients(view, drawn)
            else:
                sums = _pose_sums(view, drawn)
            gradients = *by_map, _pose_gradient(sums, view.pose) if wanted[4] else None
        return *(gradient if want else None for gradient, want in zip(gradients, wanted, strict=True)), None


def _by_name(images: Sequence[Tensor], prefix: str = '') -> dict[str, Tensor]:
    """Returns the three images, or the gradients by them, by the names of the kernels' parameters."""
    return {prefix + name: image for name, image in zip(('rgb', 'depth_acc', 'silhouette'), images, strict=True)}


def _tiling(view: View) -> dict[str, int]:
    """Returns the parameters that all kernels over tiles share."""
    camera = view.camera
    return {
        'capacity': view.capacity, 'width': camera.width, 'height': camera.height, 'tiles_x': view.tiles_x, 'TILE': view.tile,
        'CHUNK': _CHUNK,
    }  # fmt: skip


def _map_gradients(view: View, drawn: dict[str, Tensor]) -> tuple[Tensor, ...]:
    """Returns gradients by means [N, 3], log_scales [N, 1], logit_opacities [N], rgb [N, 3]; pose sums [programs, 12].

    drawn: the three images and the gradients by them, see ``_by_name``.
    """
    camera, n, gradients = view.camera, len(view.splats), _cleared(view)
    kernels.launch(
        kernels.blend_backward, view.num_tiles, warps=1,
        splats=view.splats, order=view.order, entries=view.entries, slots=view.slots, begins=view.begins, total=view.total,
        **drawn, gradients=gradients, n=n, **_tiling(view),
    )  # fmt: skip
    new, programs = view.splats.new_empty, triton.cdiv(n, BLOCK)
    outputs = {
        'by_means': new(n, 3), 'by_log_scales': new(n, 1), 'by_logit_opacities': new(n), 'by_rgb': new(n, 3),
        'pose_sums': new(programs, 12),
    }  # fmt: skip
    kernels.launch(
        kernels.project_backward, programs, warps=4,
        splats=view.splats, starts=view.starts, counts=view.counts, total=view.total, gradients=gradients, pose=view.pose,
        **outputs, n=n, capacity=view.capacity, fx=camera.fx, fy=camera.fy, cx=camera.cx, cy=camera.cy, BLOCK=BLOCK,
    )  # fmt: skip
    return tuple(outputs.values())


def _pose_sums(view: View, drawn: dict[str, Tensor]) -> Tensor:
    """Returns pose sums [tiles, 12]; drawn: as in ``_map_gradients``."""
    camera, sums = view.camera, view.splats.new_empty(view.num_tiles, 12)
    kernels.launch(
        kernels.blend_backward_to_pose, view.num_tiles, warps=1,
        splats=view.splats, order=view.order, entries=view.entries, begins=view.begins, total=view.total, **drawn,
        pose_sums=sums, n=len(view.splats), fx=camera.fx, fy=camera.fy, cx=camera.cx, cy=camera.cy, **_tiling(view),
    )  # fmt: skip
    return sums


def _pose_gradient(sums: Tensor, pose: Tensor) -> Tensor:
    """Returns [4, 4] the gradient by the pose, from sums of d c^T and d. c = R m + t are the centres, d the gradients by them.

    The gradient by R is the sum of d m^T, and m = R^T (c - t).
    """
    by_centre = sums.sum(dim=0).view(3, 4)
    rotation, translation = pose[:3, :3], pose[:3, 3]
    gradient = torch.zeros_like(pose)
    gradient[:3, :3] = (by_centre[:, :3] - by_centre[:, 3:] * translation) @ rotation
    gradient[:3, 3] = by_centre[:, 3]
    return gradient


def _cleared(view: View) -> Tensor:
    """Returns memory [rows, 8] for the gradients of entries, or of Gaussians if the entries exceed the capacity."""
    rows = max(view.capacity, len(view.splats))
    gradients = view.splats.new_empty(rows, 8)
    block = 4096
    kernels.launch(
        kernels.clear_if_overflowed, triton.cdiv(8 * rows, block), warps=4,
        gradients=gradients, total=view.total, rows=rows, capacity=view.capacity, BLOCK=block,
    )  # fmt: skip
    return gradients


def _fit_tiles(view: View, target: Target, gradients: Tensor) -> Tensor:
    """Writes the gradients of the entries. Returns the losses [tiles]."""
    camera, losses = view.camera, view.splats.new_empty(view.num_tiles)
    kernels.launch(
        kernels.fit_tile, view.num_tiles, warps=1,
        splats=view.splats, order=view.order, entries=view.entries, slots=view.slots, begins=view.begins, total=view.total,
        rgb8=target.rgb8, depth=target.depth, readings=torch.count_nonzero(target.depth > 0), gradients=gradients, losses=losses,
        n=len(view.splats), color_weight=target.color_weight / (3 * camera.width * camera.height),
        depth_weight=target.depth_weight, enough=target.enough / (camera.width * camera.height), **_tiling(view),
    )  # fmt: skip
    return losses


def _corrections() -> Tensor:
    """Returns [256, 2] the bias corrections of Adam's two moments by number of steps; of the first as it is one step ahead."""
    steps = torch.arange(_MAX_STEPS + 1, dtype=torch.float64)
    return torch.stack([1 - BETA_1 ** (steps + 1), 1 - FIT_BETA_2**steps], dim=1).float()


def _check(gaussians: Gaussians, T_cam_world: Tensor) -> None:
    if gaussians.rotations is not None:
        raise RasterizerError(
            'the Gaussians are anisotropic; the triton rasterizer takes isotropic ones: use rasterizer=cpu or rasterizer=reference'
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
            f'the Gaussians are on {device}; the triton rasterizer takes them on cuda (torch finds {found}), and on the CPU only '
            "with Triton's interpreter (TRITON_INTERPRET=1, far slower): use device=cuda, or rasterizer=cpu"
        )


def _check_tensor(name: str, tensor: Tensor, shape: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> None:
    if tensor.shape != shape or tensor.dtype != dtype or tensor.device != device:
        raise RasterizerError(
            f'{name} is {tuple(tensor.shape)} {tensor.dtype} on {tensor.device}; '
            f'the triton rasterizer takes {shape} {dtype} on {device} here'
        )


def _check_fit(gaussians: Gaussians, moments: Moments, target: Target) -> None:
    """Checks what is written in place or read without a copy.

    Raises:
        RasterizerError: a tensor has the wrong device, shape, type or layout.
    """
    n, device, size = len(gaussians), gaussians.means.device, (target.camera.height, target.camera.width)
    expected: dict[str, tuple[Tensor, tuple[int, ...], torch.dtype]] = {
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
