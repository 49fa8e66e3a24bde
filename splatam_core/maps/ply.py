"""Maps as PLY files in the layout that 3D Gaussian splatting viewers read.

Each Gaussian is one ``vertex`` element of little-endian floats: centre, unused normals, colour as the zeroth
spherical-harmonics coefficient ``f_dc = (rgb - 0.5) / C0``, logit opacity, three log scales in log metres and a
quaternion w x y z. An isotropic Gaussian repeats its scale and has the identity rotation. A last property, an integer that viewers
ignore, is the number of the frame that added the Gaussian, where that is known.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from splatam_core.atomic_io import open_regular, replaced
from splatam_core.errors import MapFileError, one_line
from splatam_core.maps.ply_file import read_vertices
from splatam_core.rasterizer import Gaussians
from splatam_core.rasterizer.base import HUGE, MIN_QUATERNION

SH_C0 = 0.28209479177387814
"""Value of the zeroth spherical harmonic, 1 / (2 sqrt(pi))."""

CENTRE = ('x', 'y', 'z')
NORMALS = ('nx', 'ny', 'nz')
F_DC = ('f_dc_0', 'f_dc_1', 'f_dc_2')
SCALES = ('scale_0', 'scale_1', 'scale_2')
RGB = ('red', 'green', 'blue')
ANCHOR = 'anchor'
ROTATION = ('rot_0', 'rot_1', 'rot_2', 'rot_3')

ALIASES = {
    'scale_0': ('scale_x', 'scale'), 'scale_1': ('scale_y',), 'scale_2': ('scale_z',),
    'rot_0': ('rot_w',), 'rot_1': ('rot_x',), 'rot_2': ('rot_y',), 'rot_3': ('rot_z',),
}  # fmt: skip
"""Other names that programs give to a property."""

REQUIRED = (*((name,) for name in CENTRE), ('opacity',), ('scale_0', *ALIASES['scale_0']))
"""Names of properties that a map must have beside colours, of each group one."""

COMMENTS = (
    'Gaussian map of splatam_ros',
    'world = first camera, optical axes: x right, y down, z forward; metres',
    "a pixel's centre is its integer index: u = fx x/z + cx",
)

OPAQUE = 20.0
"""Logit of an opacity that differs from 1 by 2e-9, which no rasterizer tells from 1."""

POINT = -20.0
"""Log radius of 2 nm: a Gaussian without extent, drawn as the blur of a pixel."""

_LARGEST = HUGE / SH_C0
"""Of a value in a file: a colour of ``HUGE`` is stored as this coefficient."""


def properties(sh_degree: int = 0) -> tuple[str, ...]:
    """Return the names of a Gaussian's properties in the order of the original 3D Gaussian splatting exporter.

    Args:
        sh_degree: of the spherical harmonics, 0 to 3; 0 has no view-dependent colour.
    """
    rest = (f'f_rest_{index}' for index in range(3 * ((sh_degree + 1) ** 2 - 1)))
    return (*CENTRE, *NORMALS, *F_DC, *rest, 'opacity', *SCALES, *ROTATION)


PROPERTIES = properties()


def write_ply(path: Path, gaussians: Gaussians, *, sh_degree: int = 0) -> None:
    """Write a map. An existing file is replaced only when the new one is complete.

    Args:
        path: the file to write.
        gaussians: the map.
        sh_degree: of the spherical harmonics in the file, 0 to 3. Those above 0 are zero: they are for viewers that accept
            nothing else.

    Raises:
        MapFileError: a Gaussian is one that ``read_ply`` would refuse; nothing is written.
        OSError: the file cannot be written.
    """
    check_usable(path, gaussians)
    columns = _columns(gaussians)
    names, anchors = properties(sh_degree), gaussians.anchors
    more = [] if anchors is None else [(ANCHOR, '<i4')]
    rows = np.zeros(len(gaussians), dtype=[*((name, '<f4') for name in names), *more])
    for name, column in columns.items():
        rows[name] = column
    if anchors is not None:
        rows[ANCHOR] = anchors.numpy(force=True)
    header = [
        'ply', 'format binary_little_endian 1.0', *(f'comment {line}' for line in COMMENTS),
        f'element vertex {len(rows)}', *(f'property float {name}' for name in names),
        *(f'property int {name}' for name, _ in more), 'end_header', '',
    ]  # fmt: skip
    with replaced(path) as temporary, temporary.open('wb') as file:
        file.write('\n'.join(header).encode('ascii'))
        file.write(rows.tobytes())


def check_usable(path: Path, gaussians: Gaussians) -> None:
    """Check that every Gaussian can be written.

    Raises:
        MapFileError: one is not finite, or its quaternion has no length.
    """
    if num_broken := len(gaussians) - int(gaussians.usable().sum()):
        raise MapFileError(f'{path}: {num_broken} of {len(gaussians)} Gaussians are not finite, so the map is not written')


def _columns(gaussians: Gaussians) -> dict[str, NDArray[np.float64]]:
    g = gaussians.detached()
    means, rgb, logits, log_scales = (
        tensor.cpu().numpy().astype(np.float64) for tensor in (g.means, g.rgb, g.logit_opacities, g.log_scales)
    )
    columns = dict(zip(CENTRE, means.T)) | dict(zip(F_DC, (rgb.T - 0.5) / SH_C0))
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
    """Read a map of this or another program.

    The properties may come in any order and as numbers of any type, as text or binary. Colour is ``f_dc_0`` to ``f_dc_2``,
    or ``red``, ``green`` and ``blue`` as bytes. Rotations are w x y z, of any length. Higher spherical-harmonics coefficients
    (view-dependent colour) and all other properties are ignored.

    Returns:
        float32 tensors. The map is isotropic if it has one scale, or if the three scales of every Gaussian are equal; else
        anisotropic.

    Raises:
        MapFileError: the file cannot be read, is not a PLY file in this layout, is cut short, holds a number that is
            not finite (but infinite opacities and sizes of zero are limited), or holds anisotropic Gaussians without rotations.
    """
    try:
        with open_regular(path) as file:
            rows = read_vertices(file, REQUIRED)
        names = _names(rows.dtype)
    except OSError as error:
        raise MapFileError(f'{path}: cannot be read: {error.strerror}') from None
    except MemoryError:
        raise MapFileError(f'{path}: cannot be read: it does not fit into memory') from None
    except (ValueError, TypeError) as error:
        raise MapFileError(f'{path}: {one_line(error)}') from None
    scales = [name for name in SCALES if name in names]
    is_anisotropic = any((rows[names[SCALES[0]]] != rows[names[other]]).any() for other in scales[1:])
    needed = [*CENTRE, *(F_DC if F_DC[0] in names else RGB), 'opacity', *(SCALES if is_anisotropic else SCALES[:1])]
    needed += [name for name in ROTATION if is_anisotropic and name in names]
    with np.errstate(over='ignore'):  # a double that does not fit becomes infinite, and is refused below
        values = {name: rows[names[name]].astype(np.float32) for name in needed}
    _limit_infinite(values)
    _check_values(path, values)
    if is_anisotropic:
        _check_rotations(path, values)
    return Gaussians(
        means=_tensor(values, CENTRE),
        log_scales=_tensor(values, SCALES if is_anisotropic else SCALES[:1]),
        logit_opacities=torch.from_numpy(values['opacity']),
        rgb=_tensor(values, F_DC) * SH_C0 + 0.5 if F_DC[0] in values else _tensor(values, RGB) / 255,
        rotations=_tensor(values, ROTATION) if is_anisotropic else None,
        anchors=_anchors(path, rows),
    )


def _names(row: np.dtype) -> dict[str, str]:
    """Return the names in a file by the names that this module uses.

    Args:
        row: the layout of the file's vertices.

    Raises:
        ValueError: the file has a part of the colours or of the scales only, or colours that are neither coefficients nor bytes.
    """
    present = row.names or ()
    names = {name: name for name in present}
    for name, others in ALIASES.items():
        found = next((other for other in (name, *others) if other in present), None)
        if found is not None:
            names[name] = found
    colours = RGB if set(RGB) & set(names) and not set(F_DC) & set(names) else F_DC
    if missing := [name for name in colours if name not in names]:
        raise ValueError(f'property {", ".join(missing)} is missing: a colour needs three')
    if colours == RGB and (wrong := [name for name in RGB if row[name] != np.uint8]):
        raise ValueError(f'property {", ".join(wrong)} is {row[wrong[0]]}: colours are read as f_dc_0 to f_dc_2, or as uchar')
    if len(given := [name for name in SCALES if name in names]) == 2:
        raise ValueError(f'the map has {" and ".join(given)} only: flat Gaussians (2D Gaussian splatting) are not read')
    return names


def _limit_infinite(values: dict[str, NDArray[np.float32]]) -> None:
    """Makes infinite opacities and sizes of zero finite: files that were converted from 8 bits have them."""
    opacities = values['opacity']
    opacities[np.isinf(opacities)] = np.copysign(OPAQUE, opacities[np.isinf(opacities)])
    for name in SCALES:
        if name in values:
            values[name][np.isneginf(values[name])] = POINT


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


def _anchors(path: Path, rows: NDArray[np.void]) -> torch.Tensor | None:
    """Returns [N] the frames that added the Gaussians; None where the file has no such property.

    Raises:
        MapFileError: they are no numbers of frames.
    """
    if ANCHOR not in (rows.dtype.names or ()):
        return None
    anchors = rows[ANCHOR]
    if not np.issubdtype(anchors.dtype, np.integer):
        return None  # of another program
    if len(anchors) and not (anchors.min() >= 0 and anchors.max() < 2**31):
        raise MapFileError(f'{path}: property {ANCHOR} holds {anchors.min()} to {anchors.max()}: expected numbers of frames')
    return torch.from_numpy(anchors.astype(np.int32))


def _tensor(values: dict[str, NDArray[np.float32]], names: tuple[str, ...]) -> torch.Tensor:
    return torch.from_numpy(np.stack([values[name] for name in names], axis=1))
