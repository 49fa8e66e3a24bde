"""The contract on the CPU: native kernels, tiles of 8x8 pixels, gradients written by hand."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatam_core.errors import RasterizerError
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.rasterizer.base import (
    COLOR_LIMIT,
    DEPTH_LIMIT_M,
    Gaussians,
    Moments,
    Rates,
    Render,
    Target,
    check_isotropic,
)
from splatam_core.rasterizer.bounds import BLOCK
from splatam_core.rasterizer.ewa import Ellipses, project

try:
    from splatam_core import _native
except ImportError as error:
    raise RasterizerError(
        f"the CPU rasterizer's native module cannot be loaded ({error}); build it with 'pip install .' "
        "(needs g++ and Python's headers), or use rasterizer=reference"
    ) from None
if _native.BLOCK != BLOCK:
    raise RasterizerError("the CPU rasterizer's native module is of another version: build it anew with 'pip install .'")


class CpuRasterizer:
    """Sorted, tiled, vectorised and threaded.

    With a fixed number of threads results are repeatable bit for bit; images do not depend on it at all.
    """

    def __init__(self, threads: int = 0) -> None:
        threads = threads or len(os.sched_getaffinity(0))
        self._engine = _native.Engine(threads)
        self._blender = _native.Blender(threads)  # of anisotropic Gaussians

    @property
    def instruction_set(self) -> str:
        """The variant of the kernels this processor got."""
        return self._engine.instruction_set

    def render(self, gaussians: Gaussians, camera: PinholeCamera, T_cam_world: Tensor) -> Render:
        """See ``Rasterizer.render``. float32 only."""
        _check(gaussians, T_cam_world)
        if gaussians.rotations is not None:
            return self._render_ellipses(project(gaussians, camera, T_cam_world), camera)
        return Render(
            *_Splat.apply(
                gaussians.means.contiguous(), gaussians.log_scales.contiguous(),
                gaussians.logit_opacities.contiguous(), gaussians.rgb.contiguous(), T_cam_world, gaussians.bounds,
                self._engine, camera,
            )
        )  # fmt: skip

    def _render_ellipses(self, ellipses: Ellipses, camera: PinholeCamera) -> Render:
        shapes = torch.cat([ellipses.centers, ellipses.conics, ellipses.opacities[:, None]], dim=1)
        image = _Blend.apply(shapes.contiguous(), ellipses.features.contiguous(), self._blender, camera)
        return Render(image[:3], image[3], image[4])

    def fit(self, gaussians: Gaussians, moments: Moments, rates: Rates, target: Target) -> float:
        """See ``Rasterizer.fit``. One native call: nothing of it passes through autograd."""
        check_isotropic(gaussians)
        _check(gaussians, target.T_cam_world)
        camera, readings = target.camera, max(1, int(torch.count_nonzero(target.depth)))
        return self._engine.fit(
            gaussians.means.numpy(), gaussians.log_scales.numpy(), gaussians.logit_opacities.numpy(),
            gaussians.rgb.numpy(), _array(gaussians.bounds), moments.first_second.numpy(), moments.steps.numpy(),
            (rates.means, rates.log_scales, rates.logit_opacities, rates.rgb), target.T_cam_world.numpy(),
            camera.fx, camera.fy, camera.cx, camera.cy, target.rgb8.numpy(), target.depth.numpy(),
            target.color_weight / (3 * camera.width * camera.height), target.depth_weight / readings,
            COLOR_LIMIT, DEPTH_LIMIT_M,
        )  # fmt: skip


def _array(tensor: Tensor | None) -> NDArray[np.float32] | None:
    return None if tensor is None else tensor.numpy()


def _check(gaussians: Gaussians, T_cam_world: Tensor) -> None:
    n = len(gaussians)
    expected = {'means': (n, 3), 'log_scales': (n, 1), 'logit_opacities': (n,), 'rgb': (n, 3)}
    if gaussians.rotations is not None:
        expected |= {'log_scales': (n, 3), 'rotations': (n, 4)}
    tensors = {name: getattr(gaussians, name) for name in expected} | {'T_cam_world': T_cam_world}
    for name, shape in (expected | {'T_cam_world': (4, 4)}).items():
        tensor = tensors[name]
        if tensor.shape != shape or tensor.dtype != torch.float32 or tensor.device.type != 'cpu':
            raise RasterizerError(
                f'{name} is {tuple(tensor.shape)} {tensor.dtype} on {tensor.device}; '
                f'the cpu rasterizer takes {shape} float32 on cpu'
            )


class _Splat(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        log_scales: Tensor,
        logit_opacities: Tensor,
        rgb: Tensor,
        T_cam_world: Tensor,
        bounds: Tensor | None,
        engine: _native.Engine,
        camera: PinholeCamera,
    ) -> tuple[Tensor, Tensor, Tensor]:
        size = (camera.height, camera.width)
        images = torch.empty(3, *size), torch.empty(size), torch.empty(size)
        inputs = means, log_scales, logit_opacities, rgb
        ctx.view = engine.forward(
            *(tensor.detach().numpy() for tensor in inputs), T_cam_world.detach().numpy(),
            camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, _array(bounds),
            *(image.numpy() for image in images),
        )  # fmt: skip
        ctx.engine = engine
        ctx.save_for_backward(*inputs, *images)
        return images

    @staticmethod
    def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor | None, ...]:
        *inputs, rgb_image, depth_acc, silhouette = ctx.saved_tensors
        gradients = [
            torch.zeros_like(tensor) if wanted else None for tensor, wanted in zip(inputs, ctx.needs_input_grad, strict=False)
        ]
        pose = torch.zeros(4, 4)
        ctx.engine.backward(
            ctx.view, *(tensor.detach().numpy() for tensor in inputs),
            [image.detach().numpy() for image in (rgb_image, depth_acc, silhouette)],
            [slope.contiguous().numpy() for slope in slopes],
            *(None if gradient is None else gradient.numpy() for gradient in gradients), pose.numpy(),
        )  # fmt: skip
        return *gradients, pose if ctx.needs_input_grad[4] else None, None, None, None


class _Blend(torch.autograd.Function):
    """Sorted ellipses blended into [5, H, W]: colour, depth_acc, silhouette."""

    @staticmethod
    def forward(ctx: Any, shapes: Tensor, features: Tensor, blender: _native.Blender, camera: PinholeCamera) -> Tensor:
        image = torch.empty(5, camera.height, camera.width)
        ctx.lists = blender.forward(shapes.detach().numpy(), features.detach().numpy(), image.numpy())
        ctx.blender = blender
        ctx.save_for_backward(shapes, features, image)
        return image

    @staticmethod
    def backward(ctx: Any, slopes: Tensor) -> tuple[Tensor | None, ...]:
        shapes, features, image = (tensor.detach() for tensor in ctx.saved_tensors)
        by_shapes, by_features = torch.empty_like(shapes), torch.empty_like(features)
        ctx.blender.backward(
            ctx.lists, shapes.numpy(), features.numpy(), image.numpy(), slopes.contiguous().numpy(),
            by_shapes.numpy(), by_features.numpy(),
        )  # fmt: skip
        return by_shapes, by_features, None, None
