"""Map files: the layout that viewers expect, exact round trips, files of 0.1.0, and clear errors for damaged files."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from splatam_core.errors import MapFileError
from splatam_core.maps.ply import PROPERTIES, SH_C0, read_ply, write_ply
from splatam_core.rasterizer.base import Gaussians

FIXTURES = Path(__file__).parent / 'fixtures_0_1_0'
STANDARD = [  # the order of the original 3D Gaussian splatting exporter, degree 0
    'x', 'y', 'z', 'nx', 'ny', 'nz', 'f_dc_0', 'f_dc_1', 'f_dc_2', 'opacity', 'scale_0', 'scale_1', 'scale_2',
    'rot_0', 'rot_1', 'rot_2', 'rot_3',
]  # fmt: skip


def some_gaussians(count: int) -> Gaussians:
    torch.manual_seed(count)
    return Gaussians(torch.randn(count, 3), torch.randn(count, 1) - 4, torch.randn(count) * 3, torch.rand(count, 3))


def split(path: Path) -> tuple[list[str], bytes]:
    """Header lines and body of a file."""
    header, _, body = path.read_bytes().partition(b'end_header\n')
    return header.decode('ascii').splitlines(), body


@pytest.mark.parametrize('count', [0, 1, 1000])
def test_round_trip(tmp_path: Path, count: int) -> None:
    written = some_gaussians(count)
    write_ply(tmp_path / 'map.ply', written)
    back = read_ply(tmp_path / 'map.ply')
    assert torch.equal(back.means, written.means)
    assert torch.equal(back.log_scales, written.log_scales)
    assert torch.equal(back.logit_opacities, written.logit_opacities)
    torch.testing.assert_close(back.rgb, written.rgb, atol=1e-6, rtol=0)  # stored as a 32-bit coefficient
    assert back.log_scales.shape == (count, 1)
    assert [path.name for path in tmp_path.iterdir()] == ['map.ply']  # nothing temporary left


def test_layout_is_the_standard_one(tmp_path: Path) -> None:
    gaussians = Gaussians(
        torch.tensor([[1.0, 2.0, 3.0]]), torch.tensor([[-4.0]]), torch.tensor([0.25]), torch.tensor([[0.5, 1.0, 0.0]])
    )
    write_ply(tmp_path / 'map.ply', gaussians)
    header, body = split(tmp_path / 'map.ply')
    assert header[:2] == ['ply', 'format binary_little_endian 1.0']
    assert [line.split()[2] for line in header if line.startswith('property float ')] == STANDARD == list(PROPERTIES)
    assert 'element vertex 1' in header
    comments = ' '.join(line for line in header if line.startswith('comment'))
    assert 'x right, y down, z forward' in comments and 'integer index' in comments
    f_dc = 0.5 / 0.28209479177387814
    expected = [1, 2, 3, 0, 0, 0, 0, f_dc, -f_dc, 0.25, -4, -4, -4, 1, 0, 0, 0]
    np.testing.assert_array_equal(np.frombuffer(body, '<f4'), np.float32(expected))


def other_map(path: Path, dtype: list[tuple[str, str]], rows: np.ndarray, header: str = '') -> None:
    """Write a map file as another program would."""
    names = {'<f4': 'float', '<f8': 'double', '|u1': 'uchar'}
    properties = ''.join(f'property {names[np.dtype(kind).str]} {name}\n' for name, kind in dtype)
    head = f'ply\nformat binary_little_endian 1.0\n{header}element vertex {len(rows)}\n{properties}end_header\n'
    path.write_bytes(head.encode() + rows.tobytes())


def test_reads_maps_of_other_programs(tmp_path: Path) -> None:
    """Doubles, another order, higher harmonics, extra properties, an object information line."""
    dtype = [(name, '<f8') for name in STANDARD[::-1]] + [('f_rest_0', '<f4'), ('flag', '|u1')]
    rows = np.zeros(3, dtype=dtype)
    rows['x'], rows['f_dc_1'], rows['scale_0'] = [1, 2, 3], 0.25 / SH_C0, -5
    rows['scale_1'] = rows['scale_2'] = -5
    other_map(tmp_path / 'other.ply', dtype, rows, 'obj_info made elsewhere\n')
    gaussians = read_ply(tmp_path / 'other.ply')
    assert gaussians.means[:, 0].tolist() == [1, 2, 3]
    assert gaussians.rgb[0].tolist() == pytest.approx([0.5, 0.75, 0.5])
    assert gaussians.log_scales.tolist() == [[-5.0]] * 3


@pytest.mark.parametrize('preset', ['realtime', 'splatam'])
def test_maps_of_0_1_0_are_read_and_written_alike(tmp_path: Path, preset: str) -> None:
    written_by_0_1_0 = FIXTURES / preset / 'map.ply'
    gaussians = read_ply(written_by_0_1_0)
    last = json.loads((FIXTURES / preset / 'metrics.json').read_text())['num_gaussians']
    assert len(gaussians) == last and gaussians.rotations is None
    write_ply(tmp_path / 'map.ply', gaussians)
    again, before = split(tmp_path / 'map.ply'), split(written_by_0_1_0)
    assert again[0] == before[0]
    # Colour is read as rgb = f_dc * C0 + 0.5 in 32 bits, so its last bits may change; everything else is exact.
    rows = [np.frombuffer(body, '<f4').reshape(-1, len(PROPERTIES)) for _, body in (again, before)]
    is_color = np.char.startswith(np.array(PROPERTIES), 'f_dc')
    np.testing.assert_array_equal(rows[0][:, ~is_color], rows[1][:, ~is_color])
    np.testing.assert_allclose(rows[0][:, is_color], rows[1][:, is_color], atol=1e-6)


def test_anisotropic_maps_keep_scales_and_rotations(tmp_path: Path) -> None:
    g = some_gaussians(20)
    written = Gaussians(g.means, torch.randn(20, 3) - 4, g.logit_opacities, g.rgb, rotations=torch.randn(20, 4))
    write_ply(tmp_path / 'map.ply', written)
    back = read_ply(tmp_path / 'map.ply')
    assert torch.equal(back.log_scales, written.log_scales) and torch.equal(back.rotations, written.rotations)
    assert torch.equal(back.means, written.means)


def test_anisotropic_maps_need_rotations(tmp_path: Path) -> None:
    dtype = [(name, '<f4') for name in STANDARD]
    rows = np.zeros(2, dtype=dtype)
    rows['scale_1'] = [0, 1]
    rows['rot_0'] = [1, 0]
    other_map(tmp_path / 'other.ply', dtype, rows)
    with pytest.raises(MapFileError, match='1 of 2 Gaussians have a quaternion of length zero'):
        read_ply(tmp_path / 'other.ply')
    other_map(tmp_path / 'other.ply', dtype[:-1], rows[[name for name, _ in dtype[:-1]]].astype(dtype[:-1]))
    with pytest.raises(MapFileError, match='rotations are needed, but property rot_3 is missing'):
        read_ply(tmp_path / 'other.ply')


@pytest.mark.parametrize(
    ('old', 'new', 'message'),
    [
        (b'ply\n', b'PK\x03\x04', 'not a PLY file'),
        (b'binary_little_endian', b'ascii', 'ascii 1.0.* is not supported: only format binary_little_endian 1.0 is read'),
        (b'element vertex 5', b'element face 5', "first element must be 'vertex'"),
        (b'element vertex 5', b'element vertex -5', "'-5' is not a number"),
        (b'element vertex 5', b'element vertex 6', 'cut short'),
        (b'element vertex 5', b'element vertex 999999999999999999', 'cut short'),
        (b'property float opacity\n', b'', 'property opacity is missing'),
        (b'property float nx', b'property list uchar int nx', 'not a scalar property'),
        (b'property float nx', b'property quad nx', 'not a scalar property'),
        (b'property float nx', b'property float x', 'more than once'),
        (b'property float nx', b'\xff\xfe', 'not a scalar property'),
        (b'end_header\n', b'', 'end_header'),
    ],
)
def test_damaged_headers_say_what_is_wrong(tmp_path: Path, old: bytes, new: bytes, message: str) -> None:
    path = tmp_path / 'map.ply'
    write_ply(path, some_gaussians(5))
    data = path.read_bytes()
    assert old in data
    path.write_bytes(data.replace(old, new, 1))
    with pytest.raises(MapFileError, match=message) as caught:
        read_ply(path)
    assert str(caught.value).startswith(str(path)) and '\n' not in str(caught.value)


def test_every_truncation_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / 'map.ply'
    write_ply(path, some_gaussians(3))
    data = path.read_bytes()
    for length in range(len(data)):
        path.write_bytes(data[:length])
        with pytest.raises(MapFileError):
            read_ply(path)


def test_random_damage_is_an_error_or_a_map(tmp_path: Path) -> None:
    path = tmp_path / 'map.ply'
    write_ply(path, some_gaussians(3))
    data, rng = path.read_bytes(), np.random.default_rng(0)
    for _ in range(500):
        damaged = bytearray(data)
        for at in rng.integers(0, len(data), 3):
            damaged[at] = rng.integers(256)
        path.write_bytes(damaged)
        try:
            gaussians = read_ply(path)
        except MapFileError:
            continue
        assert all(torch.isfinite(values).all() for values in (gaussians.means, gaussians.rgb, gaussians.log_scales))


def test_not_finite_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / 'map.ply'
    write_ply(path, some_gaussians(4))
    header, body = path.read_bytes().split(b'end_header\n')
    rows = np.frombuffer(body, '<f4').reshape(4, -1).copy()
    rows[2, 1] = np.nan
    path.write_bytes(header + b'end_header\n' + rows.tobytes())
    with pytest.raises(MapFileError, match='1 of 4 Gaussians contain NaN'):
        read_ply(tmp_path / 'map.ply')


def test_missing_file_and_folder(tmp_path: Path) -> None:
    with pytest.raises(MapFileError, match='No such file'):
        read_ply(tmp_path / 'map.ply')
    with pytest.raises(MapFileError, match='directory'):
        read_ply(tmp_path)


def test_a_failed_write_keeps_the_old_map(tmp_path: Path) -> None:
    path = tmp_path / 'map.ply'
    write_ply(path, some_gaussians(3))
    before = path.read_bytes()
    broken = Gaussians(torch.zeros(3, 3), torch.zeros(2, 1), torch.zeros(3), torch.zeros(3, 3))
    with pytest.raises(RuntimeError, match='size of tensor'):
        write_ply(path, broken)
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ['map.ply']
