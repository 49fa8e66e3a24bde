"""The contract on the CPU: native kernels, tiles of 8x8 pixels, gradients written by hand."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

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
from splatam_core.rasterizer.native import make_blender, make_engine, native_errors

if TYPE_CHECKING:
    from splatam_core import _native


class CpuRasterizer:
    """Sorted, tiled, vectorised and threaded.

    Results are repeatable bit for bit and do not depend on the number of threads. It may be used by several threads at once.
    """

    def __init__(self, threads: int = 0) -> None:
        """Starts the threads; 0 = one per core.

        Raises:
            RasterizerError: the native extension is missing.
        """
        self._engine = make_engine(threads)
        self._blender = make_blender(threads)  # of anisotropic Gaussians

    @property
    def instruction_set(self) -> str:
        """The instruction set of the kernels that this processor runs."""
        return self._engine.instruction_set

    def render(self, gaussians: Gaussians, camera: PinholeCamera, T_cam_world: Tensor) -> Render:
        """See ``Rasterizer.render``. float32 only.

        Raises:
            RasterizerError: a tensor is not what the native code takes, or the view needs more memory than is allowed.
        """
        _check(gaussians, T_cam_world)
        if gaussians.rotations is not None:
            return self._render_ellipses(project(gaussians, camera, T_cam_world), camera)
        values = (
            gaussians.means.contiguous(), gaussians.log_scales.contiguous(), gaussians.logit_opacities.contiguous(),
            gaussians.rgb.contiguous(), T_cam_world,
        )  # fmt: skip
        given = _Pass(self._engine, camera, gaussians.bounds)
        with native_errors():
            if torch.is_grad_enabled():
                return Render(*_Splat.apply(*values, given))
            return given.drawn(*values)[0]

    def _render_ellipses(self, ellipses: Ellipses, camera: PinholeCamera) -> Render:
        shapes = torch.cat([ellipses.centers, ellipses.conics, ellipses.opacities[:, None]], dim=1)
        with native_errors():
            image = _Blend.apply(shapes.contiguous(), ellipses.features.contiguous(), self._blender, camera)
        return Render(image[:3], image[3], image[4])

    def fit(self, gaussians: Gaussians, moments: Moments, rates: Rates, target: Target) -> float:
        """See ``Rasterizer.fit``. One native call, without autograd.

        Raises:
            RasterizerError: a tensor is not what the native code takes, or the view needs more memory than is allowed.
            TypeError: a tensor that is written to is not contiguous.
        """
        check_isotropic(gaussians)
        _check(gaussians, target.T_cam_world)
        _check_fit(gaussians, moments, target)
        camera, readings = target.camera, max(1, int(np.count_nonzero(target.depth.numpy() > 0)))
        with native_errors():
            return self._engine.fit(
                **_arrays(gaussians),
                moments=moments.first_second.numpy(),
                steps=moments.steps.numpy(),
                rates=(rates.means, rates.log_scales, rates.logit_opacities, rates.rgb),
                T_cam_world=target.T_cam_world.numpy(),
                camera=camera,
                target_rgb=target.rgb8.contiguous().numpy(),
                target_depth=target.depth.contiguous().numpy(),
                color_weight=target.color_weight / (3 * camera.width * camera.height),
                depth_weight=target.depth_weight / readings,
                color_limit=COLOR_LIMIT,
                depth_limit=DEPTH_LIMIT_M,
                enough=target.enough / (camera.width * camera.height),
            )


def _arrays(gaussians: Gaussians) -> dict[str, Any]:
    """Returns the isotropic Gaussians as the engine takes them."""
    return {
        'means': gaussians.means.numpy(),
        'log_scales': gaussians.log_scales.numpy(),
        'logit_opacities': gaussians.logit_opacities.numpy(),
        'rgb': gaussians.rgb.numpy(),
        'bounds': _array(gaussians.bounds),
    }


def _array(tensor: Tensor | None) -> NDArray[np.float32] | None:
    return None if tensor is None else tensor.numpy()


def _check(gaussians: Gaussians, T_cam_world: Tensor) -> None:
    """Checks shapes, types and devices.

    Raises:
        RasterizerError: a tensor is not what the native code takes.
    """
    n = len(gaussians)
    expected = {'means': (n, 3), 'log_scales': (n, 1), 'logit_opacities': (n,), 'rgb': (n, 3)}
    if gaussians.rotations is not None:
        expected |= {'log_scales': (n, 3), 'rotations': (n, 4)}
    for name, shape in expected.items():
        _check_tensor(name, getattr(gaussians, name), shape)
    if gaussians.bounds is not None:
        _check_tensor('bounds', gaussians.bounds, (-(-n // BLOCK), 7))
    _check_tensor('T_cam_world', T_cam_world, (4, 4))


def _check_fit(gaussians: Gaussians, moments: Moments, target: Target) -> None:
    """Checks the state of the optimizer and the target. Raises RasterizerError as ``_check`` does."""
    n, size = len(gaussians), (target.camera.height, target.camera.width)
    _check_tensor('first_second', moments.first_second, (n, 16))
    _check_tensor('steps', moments.steps, (n,), torch.uint8)
    _check_tensor('rgb8', target.rgb8, (*size, 3), torch.uint8)
    _check_tensor('depth', target.depth, size)


def _check_tensor(name: str, tensor: Tensor, shape: tuple[int, ...], dtype: torch.dtype = torch.float32) -> None:
    if tensor.shape != shape or tensor.dtype != dtype or not tensor.is_cpu:
        raise RasterizerError(
            f'{name} is {tuple(tensor.shape)} {tensor.dtype} on {tensor.device}; the cpu rasterizer takes {shape} {dtype} on cpu'
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Pass:
    """What a forward pass needs that gets no gradient.

    Attributes:
        engine: renders.
        camera: the image to draw.
        bounds: see ``Gaussians.bounds``.
    """

    engine: _native.Engine
    camera: PinholeCamera
    bounds: Tensor | None

    def drawn(
        self, means: Tensor, log_scales: Tensor, logit_opacities: Tensor, rgb: Tensor, T_cam_world: Tensor
    ) -> tuple[Render, _native.View]:  # fmt: skip
        """Draws isotropic Gaussians. Returns the images, and what the backward pass goes on with."""
        size = self.camera.height, self.camera.width
        images = Render(torch.empty(3, *size), torch.empty(size), torch.empty(size))
        view = self.engine.forward(
            **_arrays(Gaussians(means, log_scales, logit_opacities, rgb, self.bounds).detached()),
            T_cam_world=T_cam_world.detach().numpy(),
            camera=self.camera,
            image=images.rgb.numpy(),
            depth=images.depth_acc.numpy(),
            silhouette=images.silhouette.numpy(),
        )
        return images, view


class _Splat(torch.autograd.Function):
    """Isotropic Gaussians and a pose to colour, depth_acc and silhouette."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, log_scales: Tensor, logit_opacities: Tensor, rgb: Tensor, T_cam_world: Tensor, given: _Pass
    ) -> tuple[Tensor, Tensor, Tensor]:
        render, ctx.view = given.drawn(means, log_scales, logit_opacities, rgb, T_cam_world)
        ctx.engine = given.engine
        ctx.save_for_backward(means, log_scales, logit_opacities, rgb)
        return render.rgb, render.depth_acc, render.silhouette

    @staticmethod
    def backward(ctx: Any, *image_gradients: Tensor) -> tuple[Tensor | None, ...]:
        inputs = [tensor.detach() for tensor in ctx.saved_tensors]
        means, log_scales, logit_opacities, rgb = inputs
        gradients = [
            torch.zeros_like(tensor) if wanted else None for tensor, wanted in zip(inputs, ctx.needs_input_grad, strict=False)
        ]
        by_means, by_log_scales, by_logit_opacities, by_rgb = map(_array, gradients)
        by_pose = torch.zeros(4, 4)
        ctx.engine.backward(
            ctx.view,
            means=means.numpy(),
            log_scales=log_scales.numpy(),
            logit_opacities=logit_opacities.numpy(),
            rgb=rgb.numpy(),
            image_gradients=[gradient.contiguous().numpy() for gradient in image_gradients],
            means_gradient=by_means,
            log_scales_gradient=by_log_scales,
            logit_opacities_gradient=by_logit_opacities,
            rgb_gradient=by_rgb,
            pose_gradient=by_pose.numpy(),
        )
        return *gradients, by_pose if ctx.needs_input_grad[4] else None, None


class _Blend(torch.autograd.Function):
    """Sorted ellipses, blended to [5, H, W]: colour, depth_acc, silhouette."""

    @staticmethod
    def forward(ctx: Any, shapes: Tensor, features: Tensor, blender: _native.Blender, camera: PinholeCamera) -> Tensor:
        image = torch.empty(5, camera.height, camera.width)
        ctx.lists = blender.forward(shapes.detach().numpy(), features.detach().numpy(), image.numpy())
        ctx.blender = blender
        ctx.save_for_backward(shapes, features, image)
        return image

    @staticmethod
    def backward(ctx: Any, image_gradient: Tensor) -> tuple[Tensor | None, ...]:
        shapes, features, image = (tensor.detach() for tensor in ctx.saved_tensors)
        by_shapes, by_features = torch.empty_like(shapes), torch.empty_like(features)
        ctx.blender.backward(
            ctx.lists,
            shapes=shapes.numpy(),
            features=features.numpy(),
            image=image.numpy(),
            image_gradient=image_gradient.contiguous().numpy(),
            shapes_gradient=by_shapes.numpy(),
            features_gradient=by_features.numpy(),
        )
        return by_shapes, by_features, None, None
