"""Whatever is wrong with a file of a recording, only the project's own errors come out, in one line.

``test/fuzz`` draws damage at random.
"""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from damage import damages_of, jpeg, png
from dataset_layouts import LAYOUTS
from field_folders import FRAMES, tum

from msg_adapters.image_headers import MAX_PIXELS, stated_size
from splatam_core.cli import main
from splatam_core.config import load_config, parse_overrides
from splatam_core.datasets import files
from splatam_core.datasets.camera_file import read_camera_file
from splatam_core.datasets.registry import open_sequence
from splatam_core.errors import CameraError, ConfigError, DatasetError, SplatamError
from splatam_core.geometry.camera import CameraCalibration, PinholeCamera
from splatam_core.geometry.stamps import stamp_from_text, stamp_text
from splatam_core.geometry.trajectory import read_trajectory
from splatam_core.images.rectification import FrameFactory

FOLDERS = [name for name, layout in LAYOUTS.items() if layout.format != 'rosbag']
CAMERA = 'width: 64\nheight: 48\nfx: 60\nfy: 61\ncx: 31\ncy: 24\n'


def use(source: Path, options: dict[str, object]) -> None:
    """Read all of a recording. Raises everything but the project's own errors, which must be one line."""

    def attempt(step):
        try:
            return step()
        except SplatamError as error:
            assert str(error) and '\n' not in str(error)
            return None

    sequence = attempt(lambda: open_sequence(str(source), **options))
    if sequence is None:
        return
    for index in range(len(sequence)):
        frame = attempt(lambda index=index: sequence[index])
        assert frame is None or (np.isfinite(frame.depth_m).all() and frame.rgb.dtype == np.uint8)
    truth = attempt(sequence.ground_truth)
    assert truth is None or np.isfinite(truth.T_world_cam).all()


def one_of_each_kind(source: Path) -> list[Path]:
    """Files of a recording; of those that differ only by their number, the first."""
    kinds: dict[str, Path] = {}
    for path in sorted(source.rglob('*')):
        if path.is_file():
            kinds.setdefault(re.sub(r'\d+', '0', str(path.relative_to(source))), path)
    return list(kinds.values())


@pytest.mark.slow
@pytest.mark.parametrize('name', FOLDERS)
def test_damaged_files_give_only_known_errors(tmp_path, name):
    if name == 'record3d' and importlib.util.find_spec('OpenEXR') is None:
        pytest.skip("record3d needs OpenEXR: pip install 'splatam_ros[exr]'")
    layout = LAYOUTS[name]
    source = layout.write(tmp_path)
    for path in one_of_each_kind(tmp_path):
        whole = path.read_bytes()
        for kind, damage in damages_of(path.suffix).items():
            seed = zlib.crc32(f'{name} {path.relative_to(tmp_path)} {kind}'.encode())
            path.write_bytes(damage(whole, np.random.default_rng(seed)))
            use(source, layout.options)
        path.write_bytes(whole)


@pytest.mark.parametrize('name', ['tum', 'folder realsense', 'nerfcapture', 'sevenscenes'])
@pytest.mark.parametrize('what', ['folder', 'pipe', 'broken link', 'device'])
def test_what_is_no_file_gives_only_known_errors(tmp_path, name, what):
    layout = LAYOUTS[name]
    source = layout.write(tmp_path)
    for path in one_of_each_kind(tmp_path):
        whole = path.read_bytes()
        path.unlink()
        if what == 'folder':
            path.mkdir()
        elif what == 'pipe':
            os.mkfifo(path)
        else:
            path.symlink_to('/dev/zero' if what == 'device' else 'nowhere')
        use(source, layout.options)
        shutil.rmtree(path) if what == 'folder' else path.unlink()
        path.write_bytes(whole)


# --- names and options ---


@pytest.mark.parametrize('source', ['x' * 300, 'a/' * 3000, 'a\0b', '', '/dev/null', '\udc80', 'synthetic:seed=' + '9' * 5000])
def test_impossible_sources_are_one_error(source):
    with pytest.raises(SplatamError):
        open_sequence(source)
    with pytest.raises(SplatamError):
        open_sequence(source, format='tum')


@pytest.mark.parametrize('words', [['run', 'x' * 300, '--out', 'y'], ['run', 'synthetic', '--preset', 'x' * 300, '--out', 'y']])
def test_impossible_names_are_one_line(capsys, words):
    assert main(words) == 2
    assert capsys.readouterr().err.count('\n') == 1


@pytest.mark.parametrize('options', [{'width': 10**9}, {'width': 10**400}, {'width': 1}, {'width': 15}, {'max_frames': 10**30}])
def test_impossible_sizes_are_one_error(tmp_path, options):
    for source in ('synthetic', str(tum(tmp_path))):
        if 'max_frames' in options:
            assert len(open_sequence(source, width=32, **options)) >= FRAMES
        else:
            with pytest.raises(CameraError, match='width'):
                open_sequence(source, **options)


def test_width_of_the_settings_is_0_or_large_enough():
    with pytest.raises(ConfigError, match='width = 15: expected 0 .* or at least 16'):
        load_config('quick', ['width=15'])


def test_tall_images_are_not_blown_up():
    """1x3000 pixels at a width of 640 would be 640 x 1,920,000."""
    with pytest.raises(CameraError, match='640x1920000'):
        FrameFactory(CameraCalibration(PinholeCamera(1, 3000, 10, 10, 0, 1500)), 640)


# --- YAML and JSON ---


BOMB = 'a: &a [x,x,x,x,x,x,x,x,x]\n' + ''.join(f'{b}: &{b} [{",".join([f"*{a}"] * 9)}]\n' for a, b in zip('abcdefgh', 'bcdefghi'))


@pytest.mark.parametrize('text', [BOMB, 'width: &w 64\n', CAMERA.replace('64', '&w 64').replace('48', '*w')])
def test_anchors_and_aliases_are_refused_everywhere(tmp_path, text):
    path = tmp_path / 'camera.yaml'
    path.write_text(text)
    for read in (read_camera_file, lambda path: load_config(str(path))):
        with pytest.raises((CameraError, ConfigError), match='anchors and aliases .* are not read, line 1; write the value out'):
            read(path)
    with pytest.raises(ConfigError, match='is not valid YAML'):
        parse_overrides(['width=&a 3'])


@pytest.mark.parametrize('text', ['fx: 70\n' + CAMERA, CAMERA + 'distortion: {k1: 0, k1: 1}\n'])
def test_a_key_that_is_there_twice_is_refused_everywhere(tmp_path, text):
    """Which of the two is meant, nobody can tell."""
    path = tmp_path / 'camera.yaml'
    path.write_text(text)
    for read in (read_camera_file, lambda path: load_config(str(path))):
        with pytest.raises((CameraError, ConfigError), match="the key '(fx|k1)' is there twice, line [0-9]+ and below; keep one"):
            read(path)


@pytest.mark.parametrize(
    'value',
    ['.inf', '.nan', '640.5', '2001-99-99', '!!int ""', '!!bool x', '!!timestamp x', '9' * 30, '9' * 5000, '1e300',
     '0x' + 'f' * 5000, 'true', '[]', '-1', '0', '[' * 5000, '20000'],
)  # fmt: skip
def test_odd_values_of_a_camera_are_one_error(tmp_path, value):
    path = tmp_path / 'camera.yaml'
    path.write_text(CAMERA.replace('width: 64', f'width: {value}'))
    with pytest.raises(CameraError) as caught:
        read_camera_file(path)
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize('key', ['fx', 'fy', 'cx', 'cy', 'depth_scale'])
@pytest.mark.parametrize('value', ['1e300', '-1e300', '.inf', '.nan', '9' * 400])
def test_impossible_intrinsics_are_refused(tmp_path, key, value):
    path = tmp_path / 'camera.yaml'
    path.write_text(re.sub(rf'{key}: .*\n', '', CAMERA) + f'{key}: {value}\n')
    with pytest.raises(CameraError):
        read_camera_file(path)


def test_a_large_yaml_file_is_not_read(tmp_path):
    path = tmp_path / 'camera.yaml'
    path.write_text(CAMERA + '#' * 100_000)
    with pytest.raises(CameraError, match='bytes, and at most 65536 are read'):
        read_camera_file(path)


# --- images ---


@pytest.mark.parametrize('size', [(60_000, 60_000), (2**31 - 1, 2), (8193, 8193), (0, 5)])
@pytest.mark.parametrize('make', [png, jpeg])
def test_images_that_claim_too_much_are_not_decoded(tmp_path, monkeypatch, make, size):
    if make is jpeg and max(size) > 65535:
        pytest.skip('cannot be stated')
    path = tmp_path / 'x.png'
    path.write_bytes(make(*size))
    monkeypatch.setattr(files.cv2, 'imdecode', lambda *_: pytest.fail('was decoded'))
    for read in (files.read_color, files.read_depth_counts, files.image_size):
        with pytest.raises(DatasetError, match=f'claims to be {size[0]}x{size[1]} pixels; images of 1 to {MAX_PIXELS}'):
            read(path)


def test_exr_that_claims_too_much_is_not_decoded(tmp_path):
    OpenEXR = pytest.importorskip('OpenEXR')
    path = tmp_path / 'x.exr'
    with OpenEXR.File({'type': OpenEXR.scanlineimage}, {'R': np.ones((48, 64), np.float32)}) as file:
        file.write(str(path))
    assert files.image_size(path) == (64, 48) and files.read_exr(path).shape == (48, 64)
    box = np.array([0, 0, 63, 47], '<i4').tobytes()
    assert box in path.read_bytes()
    path.write_bytes(path.read_bytes().replace(box, np.array([0, 0, 99_999, 99_999], '<i4').tobytes()))
    with pytest.raises(DatasetError, match='claims to be 100000x100000'):
        files.read_exr(path)


@pytest.mark.parametrize('suffix', ['.png', '.jpg', '.bmp', '.tiff', '.webp', '.ppm'])
def test_header_states_what_is_decoded(tmp_path, suffix):
    import cv2

    image = np.random.default_rng(0).integers(0, 255, (33, 47, 3), np.uint8)
    path = tmp_path / f'x{suffix}'
    assert cv2.imwrite(str(path), image)
    assert files.image_size(path) == (47, 33)
    assert files.read_color(path).shape == (33, 47, 3)


@pytest.mark.parametrize('junk', [b'', b'\xff', b'\xff\x00', b'junk', b'\xff\xd0\xff\x01'])
def test_a_jpeg_states_its_size_behind_what_decoders_skip(junk):
    jpeg = cv2.imencode('.jpg', np.zeros((48, 64, 3), np.uint8))[1].tobytes()
    assert stated_size(jpeg[:2] + junk + jpeg[2:]) == (64, 48)


# --- stamps and poses ---


@pytest.mark.parametrize(
    ('stamp_ns', 'text'),
    [
        (-1, '-0.000000001'),
        (-500_000_000, '-0.500000000'),
        (-1_500_000_000, '-1.500000000'),
        (0, '0.000000000'),
        (1_500_000_000, '1.500000000'),
    ],
)
def test_stamps_are_printed_as_they_are_read(stamp_ns, text):
    assert stamp_text(stamp_ns) == text
    assert stamp_from_text(text) == stamp_ns


@pytest.mark.parametrize('text', ['', 'x', 'nan', 'inf', '-inf', 'sNaN', '1e999999999', '1e40', '9' * 30, '5e9', '1\0'])
def test_impossible_stamps_are_value_errors(text):
    with pytest.raises(ValueError):
        stamp_from_text(text)


@pytest.mark.parametrize(
    'pose', ['0 0 0 1e-200 0 0 0', '0 0 0 1e200 0 0 0', '1e300 0 0 0 0 0 1', 'nan 0 0 0 0 0 1', '0 0 0 0 0 0 0']
)
def test_poses_without_meaning_are_refused_in_a_run_s_trajectory(tmp_path, pose):
    path = tmp_path / 'trajectory.txt'
    path.write_text(f'1 0 0 0 0 0 0 1\n2 {pose}\n')
    with pytest.raises(DatasetError, match=r'trajectory\.txt:2: expected'):
        read_trajectory(path)


# --- .npy ---


def test_npy_that_claims_too_much_is_not_allocated(tmp_path):
    path = tmp_path / 'x.npy'
    np.save(path, np.eye(4))
    path.write_bytes(path.read_bytes().replace(b'(4, 4)', b'(9999999999999, 4)').replace(b' ' * 11, b'', 1))
    with pytest.raises(DatasetError, match='is no complete'):
        files.read_numbers(path)


@pytest.mark.parametrize('order', ['C', 'F'])
@pytest.mark.parametrize('dtype', ['f8', 'f4', '>f8', 'i2'])
def test_npy_is_read_as_numpy_reads_it(tmp_path, order, dtype):
    path = tmp_path / 'x.npy'
    np.save(path, np.asarray(np.arange(16).reshape(4, 4), dtype, order=order))
    assert files.read_numbers(path).tolist() == list(range(16))
