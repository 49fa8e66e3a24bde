"""A second device made of the first: tensors that live 'on a GPU' where there is none, and are as strict about it.

Inside ``SecondDevice`` a tensor on ``DEVICE`` holds its values in an ordinary one. Whatever a GPU's tensor refuses, it
refuses: numpy, and operations with tensors of the host (numbers excepted). What makes the host wait is counted.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections import Counter
from typing import Any, TypeVar

import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map_only

from splatam_core.geometry.camera import PinholeCamera
from splatam_core.rasterizer import Gaussians, Moments, Rasterizer, Rates, Render, Target, make_rasterizer

DEVICE = torch.device('cuda', 7)
META = torch.device('meta')  # what torch itself takes the tensors to be on

aten = torch.ops.aten
WAITS = {
    aten._local_scalar_dense.default, aten.nonzero.default, aten.masked_select.default, aten.equal.default,
    aten.median.default, aten.nanmedian.default, aten.bincount.default, aten.is_nonzero.default,
}  # fmt: skip
MAY_MIX = {aten.copy_.default}


class DeviceTensor(torch.Tensor):
    """A tensor on ``DEVICE``."""

    values: torch.Tensor

    @staticmethod
    def __new__(cls, values: torch.Tensor) -> DeviceTensor:
        assert type(values) is torch.Tensor
        tensor = torch.Tensor._make_wrapper_subclass(
            cls, values.size(), strides=values.stride(), storage_offset=values.storage_offset(), dtype=values.dtype,
            device=META,
        )  # fmt: skip
        tensor.values = values
        return tensor

    @property
    def device(self) -> torch.device:
        return DEVICE

    @property
    def is_cuda(self) -> bool:
        return True

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        raise AssertionError(f'{func} outside of SecondDevice')

    __torch_function__ = torch._C._disabled_torch_function_impl


def on_host(value: Any) -> Any:
    """The values of tensors on the device."""
    return tree_map_only(DeviceTensor, lambda tensor: tensor.values, value)


class SecondDevice(contextlib.AbstractContextManager['SecondDevice']):
    """Makes ``DEVICE`` usable.

    Attributes:
        waits: how often the host had to wait, by operation.
    """

    def __init__(self) -> None:
        self.waits: Counter[str] = Counter()
        self._modes = contextlib.ExitStack()

    def __enter__(self) -> SecondDevice:
        self._modes.enter_context(_Functions(self))
        self._modes.enter_context(_Dispatch(self))
        return self

    def __exit__(self, *error: object) -> None:
        self._modes.close()


class _Functions(TorchFunctionMode):
    """Sends what names the device there; torch would look for CUDA."""

    def __init__(self, device: SecondDevice) -> None:
        super().__init__()
        self._device = device

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        if func is torch.Tensor.to and DEVICE in (*args[1:], kwargs.get('device')):
            return self._to(args[0], bool(kwargs.get('non_blocking')))
        if func in (torch.Tensor.numpy, torch.Tensor.tolist) and isinstance(args[0], DeviceTensor):
            if func is torch.Tensor.numpy and not kwargs.get('force'):
                raise TypeError("can't convert cuda:7 device type tensor to numpy")
            self._device.waits[func.__name__] += 1
            return func(args[0].values.clone())  # torch has no memory to read them from
        if kwargs.get('device') == DEVICE:
            if func is torch.tensor:
                self._device.waits['torch.tensor'] += 1
            kwargs['device'] = torch.device('cpu')
            return DeviceTensor(func(*args, **kwargs))
        return func(*args, **kwargs)

    def _to(self, tensor: torch.Tensor, non_blocking: bool) -> torch.Tensor:
        if isinstance(tensor, DeviceTensor):
            return tensor
        assert not tensor.requires_grad
        if not non_blocking:
            self._device.waits['to the device'] += 1
        return DeviceTensor(tensor.clone())


class _Dispatch(TorchDispatchMode):
    def __init__(self, device: SecondDevice) -> None:
        super().__init__()
        self._device = device

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        tensors = [value for value in tree_flatten((args, kwargs))[0] if isinstance(value, torch.Tensor)]
        there = [tensor for tensor in tensors if isinstance(tensor, DeviceTensor)]
        is_factory = not tensors and kwargs.get('device') == META
        if not there and not is_factory:
            return func(*args, **kwargs)
        self._check(func, tensors)
        self._count(func, there, kwargs)
        to_host = func is aten._to_copy.default and kwargs.get('device') == torch.device('cpu')
        if kwargs.get('device') == META:
            kwargs['device'] = torch.device('cpu')
        result = func(*on_host(args), **on_host(kwargs))
        if to_host:
            return result
        by_values = {id(tensor.values): tensor for tensor in there}  # what is changed in place stays the tensor it is
        return tree_map_only(torch.Tensor, lambda v: by_values[id(v)] if id(v) in by_values else DeviceTensor(v), result)

    def _check(self, func: Any, tensors: list[torch.Tensor]) -> None:
        strangers = [tensor for tensor in tensors if not isinstance(tensor, DeviceTensor) and tensor.dim() > 0]
        if strangers and func not in MAY_MIX:
            sizes = ', '.join(str(tuple(tensor.shape)) for tensor in strangers)
            raise RuntimeError(f'{func}: expected all tensors on the device, found {sizes} on the host')

    def _count(self, func: Any, there: list[DeviceTensor], kwargs: dict[str, Any]) -> None:
        by_mask = func in (aten.index.Tensor, aten.index_put_.default) and any(tensor.dtype == torch.bool for tensor in there[1:])
        to_host = func is aten._to_copy.default and kwargs.get('device') == torch.device('cpu')
        if func in WAITS or by_mask or to_host:
            self._device.waits[str(func)] += 1


T = TypeVar('T', Gaussians, Moments, Target)


class DeviceRasterizer:
    """The native rasterizer for tensors on the device."""

    def __init__(self) -> None:
        self._native = make_rasterizer('cpu', 1)

    def render(self, gaussians: Gaussians, camera: PinholeCamera, T_cam_world: torch.Tensor) -> Render:
        """See ``Rasterizer.render``."""
        fields = dataclasses.fields(Gaussians)
        return Render(*_Native.apply(self._native, camera, T_cam_world, *(getattr(gaussians, f.name) for f in fields)))

    def fit(self, gaussians: Gaussians, moments: Moments, rates: Rates, target: Target) -> float:
        """See ``Rasterizer.fit``."""
        return self._native.fit(_values(gaussians), _values(moments), rates, _values(target))


class _Native(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, native: Rasterizer, camera: PinholeCamera, pose: torch.Tensor, *parts: torch.Tensor | None
    ) -> tuple[torch.Tensor, ...]:
        needed = ctx.needs_input_grad[2:]
        ctx.inputs = [
            None if part is None else on_host(part.detach()).requires_grad_(need) for part, need in zip((pose, *parts), needed)
        ]
        with torch.enable_grad():
            render = native.render(Gaussians(*ctx.inputs[1:]), camera, ctx.inputs[0])
        ctx.images = render.rgb, render.depth_acc, render.silhouette
        return tuple(DeviceTensor(image.detach()) for image in ctx.images)

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        wanted = [tensor for tensor in ctx.inputs if tensor is not None and tensor.requires_grad]
        found = iter(torch.autograd.grad(ctx.images, wanted, [on_host(gradient) for gradient in gradients]))
        return (
            None,
            None,
            *(DeviceTensor(next(found)) if tensor is not None and tensor.requires_grad else None for tensor in ctx.inputs),
        )


def _values(parts: T) -> T:
    """The same parts with the values of their tensors; changing them changes the parts."""
    names = [field.name for field in dataclasses.fields(parts)]
    return dataclasses.replace(parts, **{name: on_host(getattr(parts, name)) for name in names})
