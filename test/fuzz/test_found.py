"""What the fuzzer found, as families: each member was an unexpected error before."""

from __future__ import annotations

import resource
import warnings
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from kinds.bags import Statement, check_tables
from kinds.base import Tally
from kinds.messages import FACTORY, MAKERS
from test_bags_of_people import scene, write

from msg_adapters import images
from msg_adapters.errors import MessageError
from msg_adapters.image_headers import is_cut
from splatam_core import _native
from splatam_core.config import load_config
from splatam_core.datasets import files
from splatam_core.datasets.camera_file import read_camera_file
from splatam_core.errors import CameraError, DatasetError, FrameError, SplatamError
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.images.view import View
from splatam_core.slam import Slam
from splatam_core.types import RgbdFrame

CAMERA = PinholeCamera(24, 16, 20.0, 20.0, 11.5, 7.5)
RGB, DEPTH_M = np.full((16, 24, 3), 100, np.uint8), np.full((16, 24), 2.0, np.float32)


@pytest.mark.parametrize('preset', ['quick', 'realtime', 'splatam'])
@pytest.mark.parametrize(
    'change',
    [
        {'rgb': RGB[:-1]}, {'rgb': RGB[..., 0]}, {'rgb': np.zeros((16, 24, 4), np.uint8)}, {'rgb': RGB.astype(np.float32)},
        {'depth_m': DEPTH_M[:, :-1]}, {'depth_m': DEPTH_M[:0]}, {'depth_m': DEPTH_M[..., None]}, {'depth_m': DEPTH_M.astype('f8')},
        {'depth_m': DEPTH_M.astype('u2')}, {'depth_m': DEPTH_M.astype('>f4')},
    ],
)  # fmt: skip
def test_a_frame_that_is_not_of_its_camera_costs_itself(preset: str, change: dict[str, np.ndarray]) -> None:
    slam = Slam(load_config(preset, ['threads=1', 'mapping.iterations=1', 'tracking.iterations=1']))
    frame = RgbdFrame(1, RGB, DEPTH_M, CAMERA)
    for _ in range(2):  # the first frame, and one that is tracked
        with pytest.raises(FrameError, match='of the frame is .*; expected'):
            slam.process(replace(frame, **change))
        slam.process(frame)
        frame = replace(frame, stamp_ns=frame.stamp_ns + 1)


@pytest.mark.parametrize(('width', 'height'), [(24, 16), (1, 20), (20, 1), (1, 1)])
@pytest.mark.parametrize('turned', [np.s_[::-1], np.s_[:, ::-1], np.s_[::-1, ::-1]])
def test_images_that_are_views_of_turned_ones_are_used(width: int, height: int, turned: slice) -> None:
    rgb = np.random.default_rng(0).integers(0, 255, (height, width, 3), np.uint8)[turned]
    depth_m = np.ones((height, width), np.float32)[turned]
    frame = RgbdFrame(1, rgb, depth_m, replace(CAMERA, width=width, height=height))
    view = View.from_frame(frame, load_config('quick').depth)
    assert np.array_equal(view.rgb8.numpy(), rgb) and np.array_equal(view.depth.numpy(), depth_m)


def test_images_that_cannot_be_written_to_are_used() -> None:
    rgb, depth_m = RGB.copy(), DEPTH_M.copy()
    rgb.flags.writeable = depth_m.flags.writeable = False
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        assert Slam(load_config('quick', ['threads=1'])).process(RgbdFrame(1, rgb, depth_m, CAMERA)).num_gaussians > 0


@pytest.mark.parametrize('camera', [None, 'camera', 7, np.zeros(3)])
def test_what_is_no_camera_is_a_type_error(camera: object) -> None:
    images = {'image': np.zeros((3, 4, 4), np.float32), 'depth': np.zeros((4, 4), np.float32)}
    gaussians = {name: np.zeros((0, size), np.float32) for name, size in (('means', 3), ('log_scales', 1), ('rgb', 3))}
    with pytest.raises(TypeError, match='expected a PinholeCamera'):
        _native.Engine(1).forward(
            **gaussians, **images, logit_opacities=np.zeros(0, np.float32), silhouette=np.zeros((4, 4), np.float32), bounds=None,
            T_cam_world=np.eye(4, dtype=np.float32), camera=camera,
        )  # fmt: skip


@pytest.mark.parametrize('quoted', ['[' * 2000, 'x' * 100_000, 'a\nb', '\x1b[2J', '\udc80', '\u2028'])
def test_errors_are_one_line_whatever_they_quote(tmp_path: Path, quoted: str) -> None:
    text = str(SplatamError(f'x.txt: {quoted} is no number'))
    assert text.isprintable() and len(text) < 3000 and text.startswith('x.txt: ') and text.endswith(' is no number')
    (tmp_path / 'camera.yaml').write_bytes(f'width: 96\nheight: 72\nfx: 7{quoted}\n'.encode(errors='ignore'))
    with pytest.raises(CameraError) as caught:
        read_camera_file(tmp_path / 'camera.yaml')
    assert len(str(caught.value)) < 3000


VALUES = [b'\x1f/\xf8', 'text', 1.5, -1, None]


@pytest.mark.parametrize('where', ['id = 1', '1'])
@pytest.mark.parametrize('column', ['messages.timestamp', 'messages.data', 'messages.topic_id', 'topics.name', 'topics.type'])
def test_tables_of_a_bag_with_values_of_any_type(tmp_path: Path, column: str, where: str) -> None:
    bag, tally = write(tmp_path / 'bag', scene(3)), Tally()
    table, _, name = column.partition('.')
    for value in VALUES:
        check_tables(bag, tally, [Statement(f'UPDATE OR IGNORE {table} SET {name} = ? WHERE {where}', (value,))])


@pytest.mark.parametrize('sides', [(1, 65501), (65501, 1), (1, 16385), (16384, 4097)])
@pytest.mark.parametrize('name', MAKERS)
def test_an_image_that_could_not_be_read_back_is_not_sent(name: str, sides: tuple[int, int]) -> None:
    """A wide JPEG was an AttributeError; the others were messages that no reader of ours takes."""
    pixels = np.zeros((*sides, 3) if 'color' in name else sides, np.float32 if 'depth' in name else np.uint8)
    with pytest.raises(MessageError, match='both sides must be from 1 to 16384 pixels'):
        MAKERS[name](FACTORY, pixels, 1, 'camera')


@pytest.mark.parametrize('chunk', [b'IHDR', b'IDAT', b'IEND', b'tEXt', b'PLTE', b'acTL', b'fcTL'])
@pytest.mark.parametrize('length', [2**31 - 1, 3_506_438_793, 2**32 - 1])
def test_a_chunk_of_a_png_that_claims_gigabytes_is_not_allocated(tmp_path: Path, chunk: bytes, length: int) -> None:
    """One took 3.3 GB."""
    whole = cv2.imencode('.png', DEPTH_M.astype(np.uint16))[1].tobytes()
    at = 8 + 25  # behind the header
    data = whole[:at] + length.to_bytes(4, 'big') + chunk + whole[at:]
    assert is_cut(data)
    (tmp_path / 'x.png').write_bytes(data)
    before_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(DatasetError):
        files.read_depth_counts(tmp_path / 'x.png')
    message = SimpleNamespace(format='png', data=np.frombuffer(data, np.uint8))
    with pytest.raises(MessageError):
        images.decode_depth(message)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < before_kb + 200_000


def test_a_png_is_cut_wherever_it_ends_too_early() -> None:
    whole = cv2.imencode('.png', DEPTH_M.astype(np.uint16))[1].tobytes()
    assert not is_cut(whole) and not is_cut(b'no PNG')
    assert all(is_cut(whole[:length]) for length in range(8, len(whole)))
