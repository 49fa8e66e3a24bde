"""Chooses the device (CPU or GPU) and the rasterizer of a configuration."""

from __future__ import annotations

import importlib.util
import os
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatam_core.config import SlamConfig
from splatam_core.errors import ConfigError

INTERPRET = 'TRITON_INTERPRET'
"""With this environment variable set to 1 before Python starts, Triton interprets its kernels on the CPU; for tests only."""

HOST = torch.device('cpu')
_INSTALL = "install torch's CUDA build (README, 'On a GPU')"


@dataclass(frozen=True, slots=True)
class Backend:
    """The device and rasterizer of a configuration.

    Attributes:
        device: the device of maps.
        rasterizer: ``cpu``, ``triton`` or ``reference``.
        why: why the device was chosen; empty if the configuration names it.
    """

    device: torch.device
    rasterizer: str
    why: str = ''

    def __str__(self) -> str:
        chosen = f'device = auto: {self.device} ({self.why})' if self.why else f'device = {self.device}'
        return f'{chosen}; rasterizer: {self.rasterizer}'


def choose_backend(config: SlamConfig) -> Backend:
    """Returns the device and rasterizer of a configuration on this machine.

    Raises:
        ConfigError: the device or rasterizer is not available.
    """
    device, why = _device(config)
    rasterizer = {'cpu': 'cpu', 'cuda': 'triton'}[device] if config.rasterizer == 'auto' else config.rasterizer
    if rasterizer == 'triton':
        _check_triton(config, device, why)
    place = torch.device(device, torch.cuda.current_device()) if device == 'cuda' else torch.device(device)
    return Backend(place, rasterizer, why)


def pose_tensor(T: NDArray[np.float64], device: torch.device) -> Tensor:
    """Returns a pose [4, 4] as rasterizers take it: float32, on the device. The host does not wait for the transfer."""
    return torch.from_numpy(T).float().to(device, non_blocking=True)


def synchronize(device: torch.device) -> None:
    """Waits until a device has finished its work; returns at once for the CPU."""
    if device.type == 'cuda':
        torch.cuda.synchronize(device)


def _device(config: SlamConfig) -> tuple[str, str]:
    if config.device == 'cpu':
        return 'cpu', ''
    no_gpu = _why_no_gpu()
    if config.device == 'cuda':
        if no_gpu:
            raise ConfigError(f'device = cuda: {no_gpu}; {_INSTALL} and the GPU driver, or set device=cpu')
        return 'cuda', ''
    if config.rasterizer == 'cpu':
        return 'cpu', 'rasterizer = cpu runs on it'
    if config.rasterizer == 'triton' and _is_interpreted():
        return 'cpu', f'{INTERPRET} is 1'
    if no_gpu:
        return 'cpu', no_gpu
    if config.rasterizer == 'auto' and (no_triton := _why_no_triton(config)):
        return 'cpu', f'rasterizer triton: {no_triton}'
    return 'cuda', torch.cuda.get_device_name()


def _check_triton(config: SlamConfig, device: str, why: str) -> None:
    if no_triton := _why_no_triton(config):
        raise ConfigError(f'rasterizer = triton: {no_triton}; set device=cpu and rasterizer=auto')
    if device == 'cpu' and not _is_interpreted():
        reason = why or 'device = cpu'
        raise ConfigError(
            f'rasterizer = triton: needs a GPU, and {reason}; set rasterizer=auto, or set {INTERPRET}=1 in the environment to '
            'interpret its kernels, which is for tests and very slow'
        )


def _why_no_gpu() -> str:
    if torch.cuda.is_available():
        return ''
    built_for = torch.version.cuda or torch.version.hip
    built = f'is built for {built_for} and' if built_for else 'is built without CUDA and'
    return f'torch {torch.__version__} {built} sees no GPU'


def _why_no_triton(config: SlamConfig) -> str:
    if config.mapping.anisotropic:
        return 'it does not draw anisotropic Gaussians (mapping.anisotropic)'
    return '' if importlib.util.find_spec('triton') else "triton is not installed, which comes with torch's CUDA builds"


def _is_interpreted() -> bool:
    return os.environ.get(INTERPRET) == '1'
