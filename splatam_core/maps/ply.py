"""Maps as PLY files in the layout that 3D Gaussian splatting viewers read.

Each Gaussian is one ``vertex`` element of little-endian floats: centre, unused normals, colour as the zeroth
spherical-harmonics coefficient ``f_dc = (rgb - 0.5) / C0``, logit opacity, three log scales in log metres and a
quaternion w x y z. An isotropic Gaussian repeats its scale and has the identity rotation.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from numpy.typing import NDArray

from splatam_core.atomic_io import open_regular, replaced
from splatam_core.errors import MapFileError, one_line
from splatam_core.rasterizer import Gaussians
from splatam_core.rasterizer.base import HUGE, MIN_QUATERNION

SH_C0 = 0.28209479177387814
"""Value of the zeroth spherical harmonic, 1 / (2 sqrt(pi))."""

NORMALS = ('nx', 'ny', 'nz')
SCALES = ('scale_0', 'scale_1', 'scale_2')
RGB = ('red', 'green', 'blue')
ROTATION = ('rot_0', 'rot_1', 'rot_2', 'rot_3')
REQUIRED = ('x', 'y', 'z', 'f_dc_0', 'f_dc_1', 'f_dc_2', 'opacity', *SCALES)
PROPERTIES = ('x', 'y', 'z', *NORMALS, 'f_dc_0', 'f_dc_1', 'f_dc_2', 'opacity', *SCALES, *ROTATION)

COMMENTS = (
    'Gaussian map of splatam_ros',
    'world = first camera, optical axes: x right, y down, z forward; metres',
    "a pixel's centre is its integer index: u = fx x/z + cx",
)

_SCALAR_TYPES = {
    'char': 'i1', 'int8': 'i1', 'uchar': 'u1', 'uint8': 'u1', 'short': 'i2', 'int16': 'i2', 'ushort': 'u2',
    'uint16': 'u2', 'int': 'i4', 'int32': 'i4', 'uint': 'u4', 'uint32': 'u4', 'float': 'f4', 'float32': 'f4',
    'double': 'f8', 'float64': 'f8',
}  # fmt: skip
_MAX_HEADER_BYTES = 65536
_LARGEST = HUGE / SH_C0
"""Of a value in a file: a colour of ``HUGE`` is stored as this coefficient."""


def write_ply(path: Path, gaussians: Gaussians) -> None:
    """Write a map. An existing file is replaced only when the new one is complete.

    Raises:
        MapFileError: a Gaussian is one that ``read_ply`` would refuse; nothing is written.
        OSError: the file cannot be written.
    """
    if num_broken := len(gaussians) - int(gaussians.usable().sum()):
        raise MapFileError(f'{path}: {num_broken} of {len(gaussians)} Gaussians are not finite, so the map is not written')
    columns = _columns(gaussians)
    rows = np.zeros(len(gaussians), dtype=[(name, '<f4') for name in PROPERTIES])
    for name, column in columns.items():
        rows[name] = column
    header = [
        'ply', 'format binary_little_endian 1.0', *(f'comment {line}' for line in COMMENTS),
        f'element vertex {len(rows)}', *(f'property float {name}' for name in PROPERTIES), 'end_header', '',
    ]  # fmt: skip
    with replaced(path) as temporary, temporary.open('wb') as file:
        file.write('\n'.join(header).encode('ascii'))
        file.write(rows.tobytes())


def _columns(gaussians: Gaussians) -> dict[str, NDArray[np.float64]]:
    g = gaussians.detached()
    means, rgb, logits, log_scales = (
        tensor.cpu().numpy().astype(np.float64) for tensor in (g.means, g.rgb, g.logit_opacities, g.log_scales)
    )
    columns = dict(zip('xyz', means.T))
    columns |= {f'f_dc_{c}': (rgb[:, c] - 0.5) / SH_C0 for c in range(3)}
    columns |= {'opacity': logits, 'rot_0': np.ones(len(means))}
    if g.rotations is not None:
        columns |= dict(zip(ROTATION, g.rotations.cpu().numpy().astype(np.float64).T))
    return columns | dict(zip(SCALES, np.broadcast_to(log_scales, (len(means), 3)).T))


def write_surface(
    path: Path, points_m: NDArray[np.floating], rgb: NDArray[np.floating], triangles: NDArray[np.integer] | None = None
) -> None:
    """Write coloured points or a mesh. An existing file is replaced only when the new one is complete.

    Args:
        path: the file to write.
        points_m: [N, 3].
        rgb: [N, 3] colours; values outside [0, 1] are clamped.
        triangles: [M, 3] indices of points; None writes points only.
    """
    vertices = np.zeros(len(points_m), dtype=[*((name, '<f4') for name in 'xyz'), *((name, 'u1') for name in RGB)])
    for axis, name in enumerate('xyz'):
        vertices[name] = points_m[:, axis]
    for channel, name in enumerate(RGB):
        vertices[name] = np.rint(np.clip(rgb[:, channel], 0, 1) * 255)
    header = [
        'ply', 'format binary_little_endian 1.0', *(f'comment {line}' for line in COMMENTS[:2]),
        f'element vertex {len(vertices)}', *(f'property float {name}' for name in 'xyz'),
        *(f'property uchar {name}' for name in RGB),
    ]  # fmt: skip
    faces = np.zeros(0 if triangles is None else len(triangles), dtype=[('count', 'u1'), ('corners', '<i4', 3)])
    if triangles is not None:
        faces['count'], faces['corners'] = 3, triangles
        header += [f'element face {len(faces)}', 'property list uchar int vertex_indices']
    with replaced(path) as temporary, temporary.open('wb') as file:
        file.write('\n'.join([*header, 'end_header', '']).encode('ascii'))
        file.write(vertices.tobytes() + faces.tobytes())


def read_ply(path: Path) -> Gaussians:
    """Read a map.

    Higher spherical-harmonics coefficients (view-dependent colour) are ignored.

    Returns:
        float32 tensors. The map is isotropic if the three scales of every Gaussian are equal, else anisotropic.

    Raises:
        MapFileError: the file cannot be read, is not a PLY file in this layout, is cut short, holds a number that is
            not finite, or holds anisotropic Gaussians without rotations.
    """
    try:
        with open_regular(path) as file:
            header = _read_header(file)
            rows = _read_rows(file, header)
    except OSError as error:
        raise MapFileError(f'{path}: cannot be read: {error.strerror}') from None
    except MemoryError:
        raise MapFileError(f'{path}: cannot be read: it does not fit into memory') from None
    except (ValueError, TypeError) as error:
        raise MapFileError(f'{path}: {one_line(error)}') from None
    is_anisotropic = any((rows[SCALES[0]] != rows[other]).any() for other in SCALES[1:])
    names = [*REQUIRED, *(name for name in ROTATION if is_anisotropic and name in header.names)]
    with np.errstate(over='ignore'):  # a double that does not fit becomes infinite, and is refused below
        values = {name: rows[name].astype(np.float32) for name in names}
    _check_values(path, values)
    if is_anisotropic:
        _check_rotations(path, values)
    return Gaussians(
        means=_tensor(values, ('x', 'y', 'z')),
        log_scales=_tensor(values, SCALES if is_anisotropic else SCALES[:1]),
        logit_opacities=torch.from_numpy(values['opacity']),
        rgb=_tensor(values, ('f_dc_0', 'f_dc_1', 'f_dc_2')) * SH_C0 + 0.5,
        rotations=_tensor(values, ROTATION) if is_anisotropic else None,
    )


@dataclass(frozen=True, slots=True)
class _Header:
    """The number of Gaussians and the layout of one of them."""

    count: int
    row: np.dtype

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the properties."""
        return self.row.names or ()


def _read_header(file: BinaryIO) -> _Header:
    if file.readline(_MAX_HEADER_BYTES).rstrip() != b'ply':
        raise ValueError("not a PLY file: it does not start with 'ply'")
    lines = []
    while (line := file.readline(_MAX_HEADER_BYTES)).rstrip() != b'end_header':
        if not line.endswith(b'\n') or file.tell() > _MAX_HEADER_BYTES:
            raise ValueError("the header has no 'end_header': the file is damaged or is not a PLY file")
        lines.append(line.decode('ascii', errors='replace').split())
    return _parse_header([words for words in lines if words and words[0] not in ('comment', 'obj_info')])


def _parse_header(lines: list[list[str]]) -> _Header:
    kind = ' '.join(lines[0]) if lines else ''
    if kind != 'format binary_little_endian 1.0':
        raise ValueError(f"'{kind}' is not supported: only format binary_little_endian 1.0 is read")
    if len(lines) < 2 or lines[1][:2] != ['element', 'vertex'] or len(lines[1]) != 3:
        raise ValueError("the first element must be 'vertex' (one vertex per Gaussian)")
    if not lines[1][2].isdecimal():
        raise ValueError(f"'{lines[1][2]}' is not a number of vertices")
    properties = []
    for words in lines[2:]:
        if words[0] == 'element':  # faces and the like follow the vertices and are not needed
            break
        if len(words) != 3 or words[0] != 'property' or words[1] not in _SCALAR_TYPES:
            raise ValueError(f"header line '{' '.join(words)}' is not a scalar property of a vertex")
        properties.append((words[2], '<' + _SCALAR_TYPES[words[1]]))
    names = [name for name, _ in properties]
    if missing := [name for name in REQUIRED if name not in names]:
        raise ValueError(f'property {", ".join(missing)} is missing: this is not a map in the 3D Gaussian splatting layout')
    return _Header(int(lines[1][2]), np.dtype(properties))  # a duplicate name raises ValueError here


def _read_rows(file: BinaryIO, header: _Header) -> NDArray[np.void]:
    available = os.fstat(file.fileno()).st_size - file.tell()
    needed = header.count * header.row.itemsize
    if available < needed:
        raise ValueError(
            f'{header.count} Gaussians need {needed} bytes but only {available} follow the header: the file is cut short'
        )
    return np.fromfile(file, dtype=header.row, count=header.count)


def _check_values(path: Path, values: dict[str, NDArray[np.float32]]) -> None:
    usable = np.all([np.abs(column) <= _LARGEST for column in values.values()], axis=0)  # false for NaN
    if not usable.all():
        raise MapFileError(f'{path}: {int((~usable).sum())} of {len(usable)} Gaussians contain NaN, infinity or more than 1e30')


def _check_rotations(path: Path, values: dict[str, NDArray[np.float32]]) -> None:
    if missing := [name for name in ROTATION if name not in values]:
        raise MapFileError(
            f'{path}: scale_0, scale_1 and scale_2 differ, so rotations are needed, but property {", ".join(missing)} is missing'
        )
    is_zero = ~(np.linalg.norm([values[name] for name in ROTATION], axis=0) > MIN_QUATERNION)
    if is_zero.any():
        raise MapFileError(f'{path}: {int(is_zero.sum())} of {len(is_zero)} Gaussians have a quaternion of length zero')


def _tensor(values: dict[str, NDArray[np.float32]], names: tuple[str, ...]) -> torch.Tensor:
    return torch.from_numpy(np.stack([values[name] for name in names], axis=1))
