"""What readers are made of: texts, headers, stamps, trajectories, arrays, calibrations. Any bytes are one, or one error."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st
from test_field_damage import CAMERA as CAMERA_YAML

from kinds.base import Case, Kind, Tally
from kinds.damaged import WORDS, damage
from kinds.messages import FLOAT
from msg_adapters.image_headers import stated_size
from splatam_core.datasets import files
from splatam_core.datasets.camera_file import read_camera_file
from splatam_core.errors import CameraError, DatasetError
from splatam_core.geometry.camera import DISTORTION_COEFFICIENTS, CameraCalibration, PinholeCamera
from splatam_core.geometry.stamps import SECONDS, guess_unit, stamp_from_text, stamp_number, stamp_text
from splatam_core.geometry.trajectory import read_ground_truth, read_trajectory
from splatam_core.images.rectification import FrameFactory
from splatam_core.text_files import parse_json, parse_yaml

TEXT = st.one_of(st.text(max_size=200), st.text('[]{}:,- \n&*!|>"\'#%@`0123456789.einfatr~<=', max_size=200))
MAGIC = st.sampled_from(
    [b'\x89PNG\r\n\x1a\n', b'\xff\xd8', b'\x76\x2f\x31\x01', b'BM', b'II*\0', b'MM\0*', b'RIFF0000WEBPVP8X', b'P5']
)
STAMP_TEXT = st.one_of(WORDS, st.text('0123456789.eE-+_', max_size=30), st.floats().map(repr), st.integers().map(str))
POSES = b''.join(b'%d.5 0 %d 0 0 0 0 1\n' % (second, second) for second in range(6))
TRAJECTORY = st.binary(max_size=300) | st.text('0123456789.eE-+ nainf,#\n', max_size=300).map(str.encode) | damage(POSES)


def check_text(tally: Tally, text: str) -> None:
    try:
        tally.attempt(partial(parse_yaml, text))
    except ValueError as error:
        assert '\n' not in str(error)
    tally.attempt(partial(parse_json, text), ValueError)  # in the library's own words, which the callers shorten


def check_header(tally: Tally, data: bytes) -> None:
    size = tally.attempt(partial(stated_size, data))
    assert size is None or all(isinstance(side, int) for side in size)


def check_stamp(tally: Tally, text: str) -> None:
    stamp_ns = tally.attempt(partial(stamp_from_text, text), ValueError)
    assert stamp_ns is None or stamp_from_text(stamp_text(stamp_ns)) == stamp_ns


def check_seconds(tally: Tally, values: list[float]) -> None:
    """Seconds of a recording of an hour stay seconds."""
    rates = sorted(2e9 + value / 4e9 * 3600 for value in values)
    assert tally.attempt(lambda: guess_unit([stamp_number(repr(value)) for value in rates])) is SECONDS


def check_trajectory(folder: Path, tally: Tally, data: bytes) -> None:
    path = folder / 'trajectory.txt'
    path.write_bytes(data)
    for read in (read_trajectory, read_ground_truth):
        found = tally.attempt(partial(read, path), DatasetError)
        assert found is None or np.isfinite(found.T_world_cam).all()


def check_npy(folder: Path, tally: Tally, data: bytes) -> None:
    path = folder / 'numbers.npy'
    path.write_bytes(data)
    found = tally.attempt(partial(files.read_numbers, path), DatasetError)
    assert found is None or found.dtype == np.float64


def npy(folder: Path) -> bytes:
    path = folder / 'whole.npy'
    np.save(path, np.eye(4))
    return path.read_bytes()


def check_camera_file(folder: Path, tally: Tally, data: bytes) -> None:
    path = folder / 'camera.yaml'
    path.write_bytes(data)
    tally.attempt(partial(read_camera_file, path), CameraError)


SIDE = st.one_of(st.integers(1, 64), st.sampled_from([0, -1, 16384, 16385]))
FOCAL = st.one_of(st.floats(0.01, 1e6), FLOAT)


@st.composite
def calibrations(draw: st.DrawFn) -> dict[str, Any]:
    """The arguments of a camera with a lens, sizes of its images, and the width that is wished."""
    model = draw(st.sampled_from(sorted(DISTORTION_COEFFICIENTS)))
    count = draw(st.sampled_from([*DISTORTION_COEFFICIENTS[model], 3]))
    coefficient = st.one_of(st.floats(-1, 1), FLOAT)
    return {
        'size': (draw(SIDE), draw(SIDE)), 'intrinsics': [draw(FOCAL) for _ in range(4)], 'model': model,
        'distortion': tuple(draw(coefficient) for _ in range(count)), 'width': draw(st.none() | st.integers(14, 80)),
        'depth_size': draw(st.none() | st.tuples(st.integers(1, 64), st.integers(1, 64))),
    }  # fmt: skip


def check_calibration(tally: Tally, given: dict[str, Any]) -> None:
    tally.attempt(partial(_rectify, given))


def _rectify(given: dict[str, Any]) -> None:
    (width, height), (fx, fy, cx, cy) = given['size'], given['intrinsics']
    calibration = CameraCalibration(PinholeCamera(width, height, fx, fy, cx, cy), given['model'], given['distortion'])
    factory = FrameFactory(calibration, given['width'])
    if width * height > 10_000 or factory.camera.width * factory.camera.height > 10_000:
        return  # used, and costly
    depth_width, depth_height = given['depth_size'] or (width, height)
    depth_m = np.full((depth_height, depth_width), 2.0, np.float32)
    frame = factory.make(0, np.zeros((height, width, 3), np.uint8), depth_m)
    assert np.isfinite(frame.depth_m).all() and frame.depth_m.shape == frame.rgb.shape[:2]
    assert all(map(math.isfinite, (frame.camera.fx, frame.camera.cx)))


def cases(folder: Path) -> list[Case]:
    camera_yaml = damage(CAMERA_YAML.encode()) | damage(CAMERA_YAML.encode() + b'distortion: [0.1, 0, 0, 0]\n')
    return [
        Case('texts', TEXT, check_text, short=100, crossings=4),
        Case('headers of images', st.builds(bytes.__add__, MAGIC, st.binary(max_size=200)), check_header, short=200, crossings=4),
        Case('stamps', STAMP_TEXT, check_stamp, short=100, crossings=4),
        Case('units of stamps', st.lists(st.floats(0, 4e9), min_size=2, max_size=50), check_seconds, crossings=4),
        Case('trajectories', TRAJECTORY, partial(check_trajectory, folder), short=100, crossings=4),
        Case('arrays', damage(npy(folder)) | st.binary(max_size=120), partial(check_npy, folder), short=100, crossings=4),
        Case('camera.yaml', camera_yaml, partial(check_camera_file, folder), crossings=4),
        Case('calibrations', calibrations(), check_calibration),
    ]


KIND = Kind('texts and headers', 100_000, cases)
