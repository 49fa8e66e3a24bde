"""Maps for viewers in a browser: ``.splat`` files, and compressed ``.spz`` files.

``.splat`` is the layout of antimatter15's viewer, 32 bytes per Gaussian, little-endian: centre and radii as 3 floats each,
colour and opacity as 4 bytes, quaternion w x y z as 4 bytes (128 q + 128). The most visible Gaussians come first, because
viewers show what they have got so far.

``.spz`` is Niantic's format, about a tenth of the size of a PLY file. Its axes are x right, y up, z backward.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatam_core.atomic_io import replaced
from splatam_core.errors import ExportError
from splatam_core.maps.ply import SH_C0, check_usable
from splatam_core.rasterizer import Gaussians

ROW = np.dtype([('mean', '<f4', 3), ('radius', '<f4', 3), ('rgba', 'u1', 4), ('rotation', 'u1', 4)])
SPZ_FRACTION_BITS = 12
"""Of a coordinate: steps of 0.24 mm."""

SPZ_LIMIT_M = 2.0 ** (23 - SPZ_FRACTION_BITS)
SPZ_AXES = np.array([1.0, -1.0, -1.0])
"""From x right, y down, z forward; the sign of the last three parts of a quaternion, too, as this is a half turn about x."""


def write_splat(path: Path, gaussians: Gaussians) -> None:
    """Write a ``.splat`` file. An existing file is replaced only when the new one is complete.

    Colours are clamped to [0, 1] and rounded to 8 bits, as are opacities and rotations.

    Raises:
        MapFileError: a Gaussian is not finite; nothing is written.
        OSError: the file cannot be written.
    """
    check_usable(path, gaussians)
    g = gaussians.detached()
    log_scales = np.broadcast_to(g.log_scales.numpy(force=True), (len(g), 3)).astype(np.float64)
    with np.errstate(over='ignore'):
        opacities = 1 / (1 + np.exp(-g.logit_opacities.numpy(force=True).astype(np.float64)))
        volume = np.exp(np.clip(log_scales.sum(axis=1), -700, 700))
    rows = np.zeros(len(g), dtype=ROW)
    rows['mean'] = g.means.numpy(force=True)
    rows['radius'] = np.exp(np.minimum(log_scales, 80))  # beyond is no 32-bit number
    rows['rgba'] = _bytes(255 * np.column_stack([g.rgb.numpy(force=True), opacities]))
    rows['rotation'] = _bytes(128 * _quaternions(g) + 128)
    with replaced(path) as temporary, temporary.open('wb') as file:
        file.write(rows[np.argsort(-volume * opacities, kind='stable')].tobytes())


def write_spz(path: Path, gaussians: Gaussians) -> None:
    """Write a ``.spz`` file. An existing file is replaced only when the new one is complete.

    Raises:
        ExportError: the package gsply is missing, or a Gaussian is further away than the format can say.
        MapFileError: a Gaussian is not finite; nothing is written.
        OSError: the file cannot be written.
    """
    gsply = _gsply()
    check_usable(path, gaussians)
    g = gaussians.detached()
    means = g.means.numpy(force=True) * SPZ_AXES
    if num_far := int((np.abs(means) >= SPZ_LIMIT_M).any(axis=1).sum()):
        raise ExportError(
            f'{path}: {num_far} of {len(g)} Gaussians are {SPZ_LIMIT_M:g} m away or more, which .spz cannot say: choose .ply'
        )
    content = gsply.GSData(
        means=means.astype(np.float32),
        scales=np.broadcast_to(g.log_scales.numpy(force=True), (len(g), 3)).astype(np.float32),
        quats=(_quaternions(g) * [1.0, *SPZ_AXES]).astype(np.float32),
        opacities=g.logit_opacities.numpy(force=True),
        sh0=((g.rgb.numpy(force=True) - 0.5) / SH_C0).astype(np.float32),
        shN=np.zeros((len(g), 0, 3), np.float32),
    )
    with replaced(path) as temporary:
        gsply.write_spz(temporary, content, fractional_bits=SPZ_FRACTION_BITS)


def _gsply() -> Any:
    try:
        import gsply
    except ImportError as error:
        raise ExportError(f"a .spz file needs gsply ({error}): pip install 'splatam_ros[spz]'") from None
    return gsply


def _quaternions(gaussians: Gaussians) -> NDArray[np.float64]:
    """Return the rotations [N, 4] as quaternions w x y z of length 1."""
    if gaussians.rotations is None:
        return np.tile([1.0, 0.0, 0.0, 0.0], (len(gaussians), 1))
    rotations = gaussians.rotations.numpy(force=True).astype(np.float64)
    return rotations / np.linalg.norm(rotations, axis=1, keepdims=True)


def _bytes(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)
