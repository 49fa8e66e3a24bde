"""Map files: whatever a PLY holds, a finite map or one line; what is written can be read."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import torch
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from rasterizer_scenes import anisotropic_scene, on_device, random_scene

from kinds.base import Case, Kind, Tally
from kinds.damaged import damage
from splatam_core.errors import MapFileError
from splatam_core.maps.ply import read_ply, write_ply
from splatam_core.rasterizer import Gaussians

LINES = st.sampled_from(
    ['property float x', 'property double y', 'property float z', 'property uchar z', 'element vertex 3', 'element vertex 0',
     'element vertex ' + '9' * 5000, 'element vertex ٣', 'element face 3', 'property list uchar int vertex_indices', 'comment',
     'format ascii 1.0', 'end_header', 'property float \xe9', 'property', 'element', 'property float ' + 'a' * 3000, '']
)  # fmt: skip
FLOATS = st.floats(width=32)


@st.composite
def files(draw: st.DrawFn, whole: bytes) -> bytes:
    """Three Gaussians of any numbers, with a header to which lines are added."""
    lines = whole.split(b'end_header\n')[0].split(b'\n')[:-1]
    lines = [b'element vertex 3' if line.startswith(b'element vertex') else line for line in lines]
    at = draw(st.integers(0, 22))
    lines[at:at] = [line.encode() for line in draw(st.lists(LINES, max_size=3))]
    values = draw(hnp.arrays('f4', (3, 17), elements=FLOATS))
    return b'\n'.join([*lines, b'end_header', b'']) + values.tobytes()


def check_file(folder: Path, tally: Tally, data: bytes) -> None:
    (folder / 'map.ply').write_bytes(data)
    gaussians = tally.attempt(partial(read_ply, folder / 'map.ply'), MapFileError)
    if gaussians is not None:
        assert bool(gaussians.usable().all())
        write_ply(folder / 'again.ply', gaussians)
        assert len(read_ply(folder / 'again.ply')) == len(gaussians)


@st.composite
def gaussians_to_write(draw: st.DrawFn) -> Gaussians:
    """Four Gaussians of any numbers, with rotations or without."""
    is_anisotropic = draw(st.booleans())
    sizes = (3, 3 if is_anisotropic else 1, 0, 3)
    element = draw(st.sampled_from([FLOATS, st.floats(-10, 10, width=32)]))
    parts = [torch.from_numpy(draw(hnp.arrays('f4', (4, size) if size else (4,), elements=element))) for size in sizes]
    rotations = torch.from_numpy(draw(hnp.arrays('f4', (4, 4), elements=element))) if is_anisotropic else None
    return Gaussians(*parts, rotations=rotations)


def check_written(folder: Path, tally: Tally, gaussians: Gaussians) -> None:
    path = folder / 'written.ply'
    path.unlink(missing_ok=True)
    tally.attempt(partial(write_ply, path, gaussians), MapFileError)
    if path.exists():
        assert len(read_ply(path)) == len(gaussians)


def whole(folder: Path, anisotropic: bool) -> bytes:
    scene = (anisotropic_scene if anisotropic else random_scene)(3, 5, 16, 12)
    write_ply(folder / 'whole.ply', on_device(scene.gaussians, 'cpu'))
    return (folder / 'whole.ply').read_bytes()


def cases(folder: Path) -> list[Case]:
    isotropic, anisotropic = whole(folder, False), whole(folder, True)
    check = partial(check_file, folder)
    return [
        Case('damaged', damage(isotropic) | damage(anisotropic), check),
        Case('any values and headers', files(isotropic), check),
        Case('written', gaussians_to_write(), partial(check_written, folder)),
    ]


KIND = Kind('maps', 20_000, cases)
