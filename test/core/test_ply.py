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


ENCODINGS = ['ascii', 'binary_little_endian', 'binary_big_endian']


def encoded(path: Path, encoding: str, rows: np.ndarray, before: str = '', bytes_before: bytes = b'', newline: str = '\n') -> None:
    """Write a structured array as the vertices of a PLY file."""
    names = {'f4': 'float', 'f8': 'double', 'u1': 'uchar', 'i4': 'int'}
    properties = [f'property {names[rows.dtype[name].str[1:]]} {name}' for name in rows.dtype.names]
    head = ['ply', f'format {encoding} 1.0', 'comment of another program', *([before] if before else [])]
    head += [
        f'element vertex {len(rows)}',
        *properties,
        'element face 0',
        'property list uchar int vertex_indices',
        'end_header',
        '',
    ]
    if encoding == 'ascii':
        body = ''.join(' '.join(f'{value:.9g}' for value in row) + newline for row in rows.tolist()).encode()
    else:
        order = '<' if 'little' in encoding else '>'
        body = rows.astype([(name, order + rows.dtype[name].str[1:]) for name in rows.dtype.names]).tobytes()
    path.write_bytes(newline.join(head).encode() + bytes_before + body)


def trained_map(count: int, names: list[str] | None = None) -> np.ndarray:
    """Vertices as 3D Gaussian splatting writes them, with 45 coefficients of view-dependent colour."""
    rest = [f'f_rest_{index}' for index in range(45)]
    names = names or [*STANDARD[:9], *rest, *STANDARD[9:]]
    rows, rng = np.zeros(count, dtype=[(name, '<f4') for name in names]), np.random.default_rng(1)
    for name in names:
        rows[name] = rng.standard_normal(count)
    return rows


@pytest.mark.parametrize('encoding', ENCODINGS)
@pytest.mark.parametrize('newline', ['\n', '\r\n'])
def test_every_encoding_is_read(tmp_path: Path, encoding: str, newline: str) -> None:
    rows = trained_map(7)
    encoded(tmp_path / 'map.ply', encoding, rows, newline=newline)
    gaussians = read_ply(tmp_path / 'map.ply')
    expected = {
        'means': ('x', 'y', 'z'), 'log_scales': ('scale_0', 'scale_1', 'scale_2'), 'rotations': ('rot_0', 'rot_1', 'rot_2', 'rot_3')
    }  # fmt: skip
    for attribute, names in expected.items():
        np.testing.assert_array_equal(getattr(gaussians, attribute), np.column_stack([rows[name] for name in names]))
    colours = np.column_stack([rows[f'f_dc_{c}'] for c in range(3)]) * SH_C0 + 0.5
    np.testing.assert_allclose(gaussians.rgb, colours, atol=1e-6)
    np.testing.assert_array_equal(gaussians.logit_opacities, rows['opacity'])


@pytest.mark.parametrize('encoding', ENCODINGS)
def test_elements_before_the_gaussians_are_skipped(tmp_path: Path, encoding: str) -> None:
    rows, before = trained_map(3), 'element camera 2\nproperty double focal\nproperty uchar kind'
    skipped = b'5 1\n7 2\n' if encoding == 'ascii' else bytes(18)
    encoded(tmp_path / 'map.ply', encoding, rows, before, skipped)
    np.testing.assert_array_equal(read_ply(tmp_path / 'map.ply').means[:, 0], rows['x'])
    encoded(tmp_path / 'list.ply', 'binary_big_endian', rows, 'element face 1\nproperty list uchar int corners', bytes(13))
    with pytest.raises(MapFileError, match="element 'face' before 'vertex' has lists"):
        read_ply(tmp_path / 'list.ply')


@pytest.mark.parametrize('encoding', ENCODINGS)
@pytest.mark.parametrize('scale', ['scale_0', 'scale_x', 'scale'])
def test_one_scale_is_an_isotropic_map(tmp_path: Path, encoding: str, scale: str) -> None:
    rows = trained_map(4, ['opacity', scale, 'z', 'y', 'x', 'f_dc_0', 'f_dc_1', 'f_dc_2'])
    encoded(tmp_path / 'map.ply', encoding, rows)
    gaussians = read_ply(tmp_path / 'map.ply')
    np.testing.assert_array_equal(gaussians.log_scales[:, 0], rows[scale])
    assert gaussians.rotations is None and gaussians.means.tolist() == np.column_stack([rows[name] for name in 'xyz']).tolist()


def test_other_names_of_scales_and_rotations(tmp_path: Path) -> None:
    rotation = ['rot_x', 'rot_y', 'rot_z', 'rot_w']  # as named, whatever their order in the file
    rows = trained_map(5, [*rotation, 'x', 'y', 'z', 'f_dc_0', 'f_dc_1', 'f_dc_2', 'opacity', 'scale_x', 'scale_y', 'scale_z'])
    encoded(tmp_path / 'map.ply', 'binary_little_endian', rows)
    gaussians = read_ply(tmp_path / 'map.ply')
    np.testing.assert_array_equal(gaussians.rotations, np.column_stack([rows[f'rot_{part}'] for part in 'wxyz']))
    np.testing.assert_array_equal(gaussians.log_scales, np.column_stack([rows[f'scale_{axis}'] for axis in 'xyz']))


def test_what_8_bits_cannot_say_is_limited(tmp_path: Path) -> None:
    """An opacity of 255 / 255 has an infinite logit, and a size of zero an infinite logarithm; converters write both."""
    rows = trained_map(4)
    rows['opacity'][:3], rows['scale_1'][1] = [np.inf, -np.inf, 0.5], -np.inf
    encoded(tmp_path / 'map.ply', 'ascii', rows)
    gaussians = read_ply(tmp_path / 'map.ply')
    assert gaussians.logit_opacities[:3].tolist() == [20, -20, 0.5] and gaussians.log_scales[1, 1] == -20
    assert gaussians.usable().all()
    for name, value in (('opacity', np.nan), ('scale_1', np.inf), ('x', np.inf)):
        rows = trained_map(4)
        rows[name][2] = value
        encoded(tmp_path / 'map.ply', 'binary_big_endian', rows)
        with pytest.raises(MapFileError, match='1 of 4 Gaussians contain NaN, infinity'):
            read_ply(tmp_path / 'map.ply')


def test_colours_may_be_bytes(tmp_path: Path) -> None:
    names = ['x', 'y', 'z', 'red', 'green', 'blue', 'opacity', 'scale_0']
    for kind in ('u1', '<f4'):
        rows = np.zeros(2, dtype=[(name, kind if name in ('red', 'green', 'blue') else '<f4') for name in names])
        rows['red'], rows['blue'] = [51, 255], 102
        encoded(tmp_path / f'{kind}.ply', 'binary_little_endian', rows)
    np.testing.assert_allclose(read_ply(tmp_path / 'u1.ply').rgb, [[0.2, 0, 0.4], [1, 0, 0.4]], atol=1e-7)
    with pytest.raises(MapFileError, match='red, green, blue is float32: colours are read as f_dc_0 to f_dc_2, or as uchar'):
        read_ply(tmp_path / '<f4.ply')


def test_text_that_is_cut_short_or_ragged_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / 'map.ply'
    encoded(path, 'ascii', trained_map(5))
    *lines, last = path.read_bytes().splitlines(keepends=True)
    for body, message in (([], 'only 4 follow'), ([b'1 2 3\n'], 'number of columns'), ([b'x' + last], 'could not convert')):
        path.write_bytes(b''.join(lines + body))
        with pytest.raises(MapFileError, match=message):
            read_ply(path)
    header = path.read_bytes().partition(b'end_header\n')[0]
    path.write_bytes(header + b'end_header\n' + b'1 2 3\n' * 5)
    with pytest.raises(MapFileError, match='the lines hold 3 numbers, but the header names 62 properties'):
        read_ply(path)
    path.write_bytes(header.replace(b'vertex 5', b'vertex 999999999999999999999') + b'end_header\n')
    with pytest.raises(MapFileError, match='only 0 follow'):
        read_ply(path)
    path.write_bytes(header.replace(b'vertex 5', b'vertex 0') + b'end_header\n')
    assert len(read_ply(path)) == 0


@pytest.mark.parametrize(('degree', 'rest'), [(0, 0), (1, 9), (2, 24), (3, 45)])
def test_higher_harmonics_are_zero_in_the_standard_order(tmp_path: Path, degree: int, rest: int) -> None:
    written = some_gaussians(6)
    write_ply(tmp_path / 'map.ply', written, sh_degree=degree)
    header, body = split(tmp_path / 'map.ply')
    names = [line.split()[2] for line in header if line.startswith('property float ')]
    assert names == [*STANDARD[:9], *(f'f_rest_{index}' for index in range(rest)), *STANDARD[9:]]
    rows = np.frombuffer(body, '<f4').reshape(6, -1)
    assert not rows[:, 9 : 9 + rest].any() and torch.equal(read_ply(tmp_path / 'map.ply').means, written.means)


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
        (b'binary_little_endian 1.0', b'binary_mixed_endian 1.0', "'format binary_mixed_endian 1.0' is not supported: expected"),
        (b'binary_little_endian 1.0', b'binary_little_endian 2.0', 'is not supported: expected one of format ascii 1.0'),
        (b'binary_little_endian', b'ascii', 'could not convert'),
        (b'element vertex 5', b'element face 5', "no element 'vertex'"),
        (b'element vertex 5', b'property float x', 'not a scalar property'),
        (b'element vertex 5', b'element vertex -5', "'-5' is not a number"),
        (b'element vertex 5', b'element vertex 6', 'cut short'),
        (b'element vertex 5', b'element vertex 999999999999999999', 'cut short'),
        (b'property float opacity\n', b'', 'property opacity is missing'),
        (b'property float f_dc_1\n', b'', 'f_dc_1 is missing: a colour needs three'),
        (b'property float scale_1\n', b'', 'flat Gaussians'),
        (b'property float f_dc_0\n', b'', 'f_dc_0 is missing'),
        (b'property float nx', b'property float packed_position', 'this map is compressed: unpack it first'),
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
