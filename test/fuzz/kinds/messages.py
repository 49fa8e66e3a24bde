"""Messages: whatever one holds, only ``MessageError`` comes out of a conversion, in one line."""

from __future__ import annotations

import struct
from functools import partial
from pathlib import Path
from types import SimpleNamespace as Message
from typing import Any

import cv2
import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from rosbags.typesys import Stores, get_typestore
from test_rvl import encoded

from kinds.base import Case, Kind, Tally
from msg_adapters import camera_info, encodings, images, point_clouds, poses, remarks, stamps
from msg_adapters.errors import MessageError
from msg_adapters.factory import RosbagsMessages, message_class

UINT32 = st.one_of(st.integers(0, 70), st.sampled_from([2**16, 2**31, 2**32 - 1]), st.integers(0, 2**32 - 1))
FLOAT = st.one_of(st.floats(), st.sampled_from([0.0, -0.0, 1.0, 1e-320, 1e-200, 1e200, 1e308, float('nan'), float('inf')]))
FLOAT32 = st.floats(width=32)
BYTES = st.binary(max_size=400).map(lambda data: np.frombuffer(data, np.uint8))
STAMP = st.builds(Message, sec=st.integers(-(2**31), 2**31 - 1), nanosec=st.integers(0, 2**32 - 1))
RIGHT_HEADER = Message(stamp=Message(sec=1, nanosec=2), frame_id='camera')
HEADER = st.builds(Message, stamp=STAMP, frame_id=st.text(max_size=5))
COLORS = [*encodings.color_encodings(None)]
DEPTHS = [*encodings.depth_encodings(0.001)]
ENCODINGS = {**encodings.color_encodings(None), **encodings.depth_encodings(0.001)}
ENCODING = st.one_of(st.sampled_from(COLORS + DEPTHS), st.text(max_size=8))
JPEG = cv2.imencode('.jpg', np.arange(48 * 32 * 3, dtype=np.uint8).reshape(32, 48, 3))[1].tobytes()
PNG = cv2.imencode('.png', np.arange(48 * 32 * 3, dtype=np.uint8).reshape(32, 48, 3))[1].tobytes()
PNG16 = cv2.imencode('.png', np.arange(48 * 32, dtype=np.uint16).reshape(32, 48))[1].tobytes()
RVL = encoded(np.arange(48 * 32, dtype=np.uint16).reshape(32, 48))
FORMATS = st.one_of(
    st.sampled_from(['jpeg', 'png', 'rgb8; jpeg compressed bgr8', '16UC1; png compressed', '16UC1; compressedDepth png',
                     '32FC1; compressedDepth', '16UC1; compressedDepth rvl', '32FC1; compressedDepth rvl', '; compressedDepth']),
    st.text(max_size=12),
)  # fmt: skip


@st.composite
def spoilt(draw: st.DrawFn, fields: dict[str, Any], odd: dict[str, st.SearchStrategy[Any]]) -> Message:
    """A message of which none, some or all fields are odd."""
    names = st.lists(st.sampled_from(sorted(odd)), max_size=3, unique=True)
    which = draw(st.one_of(st.just([]), names, names, st.just(sorted(odd))))
    return Message(**(fields | {name: draw(odd[name]) for name in which}))


ODD_IMAGE = {
    'header': HEADER, 'height': UINT32, 'width': UINT32, 'encoding': ENCODING, 'step': UINT32, 'is_bigendian': st.integers(0, 255),
    'data': BYTES,
}  # fmt: skip


@st.composite
def raw_images(draw: st.DrawFn) -> Message:
    """An image that fits its encoding, or of which some fields are odd."""
    name = draw(st.sampled_from(COLORS + DEPTHS))
    encoding = ENCODINGS[name]
    height, width = draw(st.integers(1, 9)), draw(st.integers(1, 9))
    step = width * encoding.channels * np.dtype(encoding.dtype).itemsize + draw(st.integers(0, 3))
    seed, is_float = draw(st.integers(0, 2**32)), encoding.dtype == 'f4'
    data = np.random.default_rng(seed).integers(0, 256, height * step, np.uint8)
    if is_float and seed % 2:
        data[: height * step // 4 * 4].view('<f4')[:] = draw(st.sampled_from([np.nan, -1.0, 2.0, np.inf, 1e-40]))
    fields = {
        'header': RIGHT_HEADER, 'height': height, 'width': width, 'encoding': name, 'step': step,
        'is_bigendian': draw(st.integers(0, 1)), 'data': data,
    }  # fmt: skip
    return draw(spoilt(fields, ODD_IMAGE))


def check_image(tally: Tally, value: tuple[Message, str | None]) -> None:
    message, rgb_encoding = value
    rgb = tally.attempt(partial(images.decode_color, message, rgb_encoding=rgb_encoding), MessageError)
    assert rgb is None or (rgb.shape == (message.height, message.width, 3) and rgb.dtype == np.uint8)
    depth_m = tally.attempt(partial(images.decode_depth, message), MessageError)
    assert depth_m is None or (depth_m.shape == (message.height, message.width) and is_clean(depth_m))


def is_clean(depth_m: np.ndarray) -> bool:
    return depth_m.dtype == np.float32 and bool((np.isfinite(depth_m) & (depth_m >= 0)).all())


@st.composite
def damaged(draw: Any, whole: bytes) -> bytes:
    """Bytes of an image of which some are changed, left out or added."""
    data = bytearray(whole)
    for _ in range(draw(st.sampled_from([0, 1, 1, 2, 6]))):
        at = draw(st.integers(0, min(len(data) - 1, draw(st.sampled_from([40, 10**6])))))
        change = draw(st.sampled_from(['set', 'cut', 'add', 'end']))
        if change == 'set':
            data[at] = draw(st.integers(0, 255))
        elif change == 'cut':
            del data[at : at + draw(st.integers(1, 9))]
        elif change == 'add':
            data[at:at] = draw(st.binary(max_size=9))
        else:
            del data[at:]
        if not data:
            break
    return bytes(data)


@st.composite
def compressed_images(draw: Any) -> Message:
    content = draw(st.one_of(st.sampled_from([JPEG, PNG, PNG16, RVL]).flatmap(damaged), st.binary(max_size=200)))
    right = 'png' if content[:1] == b'\x89' else 'jpeg' if content[:1] == b'\xff' else '16UC1; compressedDepth rvl'
    name = draw(st.one_of(st.just(right), FORMATS))
    has_config = ('compressedDepth' in name) == bool(draw(st.integers(0, 9)))
    config = struct.pack('<iff', draw(st.integers(-9, 9)), draw(FLOAT32), draw(FLOAT32)) if has_config else b''
    return Message(header=RIGHT_HEADER, format=name, data=np.frombuffer(config + content, np.uint8))


def check_compressed_image(tally: Tally, value: tuple[Message, tuple[int, int] | None]) -> None:
    message, camera_size = value
    rgb = tally.attempt(partial(images.decode_color, message, camera_size=camera_size), MessageError)
    assert rgb is None or (rgb.dtype == np.uint8 and camera_size in (None, rgb.shape[1::-1]))
    depth_m = tally.attempt(partial(images.decode_depth, message, camera_size=camera_size), MessageError)
    assert depth_m is None or is_clean(depth_m)


MODEL = st.one_of(st.sampled_from(['plumb_bob', 'equidistant', 'rational_polynomial', 'None', '']), st.text(max_size=9))
K, P = [20.0, 0.0, 11.5, 0.0, 21.0, 7.5, 0.0, 0.0, 1.0], [20.0, 0.0, 11.5, 0.0, 0.0, 21.0, 7.5, 0.0, 0.0, 0.0, 1.0, 0.0]
WHOLE = {'x_offset': 0, 'y_offset': 0, 'width': 0, 'height': 0, 'do_rectify': False}
ODD_INFO = {
    'header': HEADER, 'height': UINT32, 'width': UINT32, 'distortion_model': MODEL, 'd': st.lists(FLOAT, max_size=20),
    'k': st.one_of(st.just([0.0] * 9), st.lists(FLOAT, min_size=9, max_size=9), st.lists(FLOAT, max_size=10)),
    'p': st.one_of(st.just([0.0] * 12), st.lists(FLOAT, min_size=12, max_size=12), st.lists(FLOAT, max_size=13)),
    'binning_x': st.one_of(st.integers(0, 5), UINT32), 'binning_y': st.one_of(st.integers(0, 5), UINT32),
    'roi': spoilt(WHOLE | {'width': 12, 'height': 8}, {'x_offset': UINT32, 'y_offset': UINT32, 'width': UINT32, 'height': UINT32}),
}  # fmt: skip
RIGHT_INFO = {
    'header': RIGHT_HEADER, 'height': 16, 'width': 24, 'distortion_model': 'plumb_bob', 'd': [0.1, 0.0, 0.0, 0.0, 0.0], 'k': K,
    'r': [0.0] * 9, 'p': P, 'binning_x': 0, 'binning_y': 0, 'roi': Message(**WHOLE),
}  # fmt: skip
INFO = spoilt(RIGHT_INFO, ODD_INFO)
SIZES = st.sampled_from([None, None, (48, 32), (48, 32), (1, 1), (16384, 4096)])
KNOWN_NAMES = st.sampled_from(['sensor_msgs/msg/Image', 'std_msgs/msg/Header', 'sensor_msgs/msg/Imag', 'os/msg/path'])
NAMES = st.one_of(st.text(max_size=30), KNOWN_NAMES, st.from_regex(r'[.\w/ ]{0,9}/msg/[.\w/ ]{0,9}', fullmatch=True))


def check_camera_info(tally: Tally, value: tuple[Message, bool]) -> None:
    message, is_rectified = value
    camera = tally.attempt(partial(camera_info.parameters, message, is_rectified=is_rectified), MessageError)
    remarks.on_info(message)
    if camera is not None:
        values = (camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion)
        assert np.isfinite(values).all() and camera.width > 0 and camera.height > 0


FIELD = st.builds(
    Message, name=st.sampled_from(['x', 'y', 'z', 'rgb', 'i', '']), offset=UINT32, datatype=st.integers(0, 9), count=UINT32
)
POINT_FIELDS = [Message(name=name, offset=4 * i, datatype=7, count=1) for i, name in enumerate(('x', 'y', 'z', 'rgb'))]


ODD_CLOUD = {
    'header': HEADER, 'height': UINT32, 'width': UINT32, 'is_bigendian': st.booleans(), 'fields': st.lists(FIELD, max_size=8),
    'point_step': UINT32, 'row_step': UINT32, 'data': BYTES,
}  # fmt: skip


@st.composite
def clouds(draw: st.DrawFn) -> Message:
    """A cloud that can be read, or of which some fields are odd."""
    height, width, point_step = draw(st.integers(0, 4)), draw(st.integers(0, 5)), draw(st.integers(16, 24))
    row_step = width * point_step + draw(st.integers(0, 3))
    data = np.random.default_rng(draw(st.integers(0, 2**32))).integers(0, 256, height * row_step, np.uint8)
    fields = {
        'header': RIGHT_HEADER, 'height': height, 'width': width, 'is_bigendian': False, 'fields': POINT_FIELDS,
        'point_step': point_step, 'row_step': row_step, 'data': data, 'is_dense': True,
    }  # fmt: skip
    return draw(spoilt(fields, ODD_CLOUD))


def check_point_cloud(tally: Tally, message: Message) -> None:
    found = tally.attempt(partial(point_clouds.read_cloud, message), MessageError)
    assert found is None or found[0].shape == found[1].shape == (message.width * message.height, 3)


def check_pose(tally: Tally, values: list[float]) -> None:
    position, rotation = dict(zip('xyz', values)), dict(zip('xyzw', values[3:]))
    pose = Message(position=Message(**position), orientation=Message(**rotation))
    transform = Message(translation=Message(**position), rotation=Message(**rotation))
    for convert in (partial(poses.pose_matrix, pose), partial(poses.transform_matrix, transform)):
        T = tally.attempt(convert, MessageError)
        if T is not None:
            assert np.isfinite(T).all() and np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() < 1e-9


def check_stamp(tally: Tally, value: tuple[Message, bytes]) -> None:
    header, data = value
    for read in (partial(stamps.message_stamp_ns, Message(header=header)), partial(stamps.serialized_stamp_ns, data)):
        stamp_ns = tally.attempt(read, MessageError)
        assert stamp_ns is None or stamps.from_ns(stamp_ns)


def check_name_of_type(tally: Tally, name: str) -> None:
    assert tally.attempt(partial(message_class, name), MessageError) is None or '/msg/' in name


# --- making messages ---

FACTORY = RosbagsMessages(get_typestore(Stores.ROS2_JAZZY))
SHAPES = st.one_of(
    hnp.array_shapes(min_dims=0, max_dims=4, max_side=6), st.sampled_from([(1, 65501, 3), (65501, 1), (0, 4, 3), (3, 0)])
)
PIXELS = hnp.arrays(st.sampled_from(['u1', 'u2', 'f4', 'f8', 'f2', '>f4', 'b1', 'i8']), SHAPES, fill=st.integers(0, 1))
STAMP_NS = st.one_of(st.integers(), st.integers(0, 2**61))
FRAME_ID = st.text(max_size=5)
ODD_FLOATS = st.sampled_from([np.nan, np.inf, -np.inf, 0.0, -1.0, 1e-30, 65.535, 1e30])
MAKERS = {
    'color_message': images.color_message, 'mono_message': images.mono_message, 'depth_message': images.depth_message,
    'compressed_color_message': images.compressed_color_message, 'compressed_depth_message': images.compressed_depth_message,
}  # fmt: skip


@st.composite
def images_to_send(draw: Any) -> tuple[str, np.ndarray, int, str, str]:
    """A function that makes a message, an array for it, which fits now and then, stamp, frame and encoding."""
    name = draw(st.sampled_from(sorted(MAKERS)))
    if draw(st.booleans()):
        pixels = draw(PIXELS)
    else:
        sides = draw(st.integers(1, 9)), draw(st.integers(1, 9))
        kinds = {'color': ((*sides, 3), 'u1'), 'mono': (sides, 'u1'), 'depth': (sides, 'f4')}
        shape, kind = next(value for key, value in kinds.items() if key in name)
        pixels = draw(hnp.arrays(kind, shape, elements=ODD_FLOATS if kind == 'f4' else None, fill=st.nothing()))
    encoding = draw(st.sampled_from(['', '32FC1', '16UC1', 'jpeg', 'png']) | st.text(max_size=4))
    return name, pixels, draw(STAMP_NS), draw(FRAME_ID), encoding


def check_image_to_send(tally: Tally, value: tuple[str, np.ndarray, int, str, str]) -> None:
    """What is made is read back."""
    name, pixels, stamp_ns, frame_id, encoding = value
    options = [encoding] if encoding and ('compressed' in name or 'depth' in name) else []
    message = tally.attempt(partial(MAKERS[name], FACTORY, pixels, stamp_ns, frame_id, *options), MessageError)
    if message is not None:
        decode = images.decode_depth if 'depth' in name else images.decode_color
        assert decode(message).shape[:2] == pixels.shape[:2]
        assert stamps.message_stamp_ns(message) == stamp_ns


CLOUDS_TO_SEND = st.tuples(
    hnp.arrays(st.sampled_from(['f4', 'f8']), st.sampled_from([(0, 3), (4, 3), (4, 2), (3,), (2, 3)]), elements=ODD_FLOATS),
    hnp.arrays(st.sampled_from(['u1', 'u1', 'i4']), st.sampled_from([(0, 3), (4, 3), (2, 3)])),
    STAMP_NS, FRAME_ID, st.dictionaries(st.text(max_size=3), hnp.arrays('f4', st.sampled_from([(4,), (2,), (0,)])), max_size=2),
)  # fmt: skip


def check_cloud_to_send(tally: Tally, value: tuple[np.ndarray, np.ndarray, int, str, dict[str, np.ndarray]]) -> None:
    points, rgb, stamp_ns, frame_id, extra = value
    make = partial(point_clouds.cloud_message, FACTORY, points, rgb, stamp_ns, frame_id, extra)
    message = tally.attempt(make, MessageError)
    if message is not None and not set(extra) & {'x', 'y', 'z', 'rgb'}:
        np.testing.assert_array_equal(point_clouds.read_cloud(message)[1], rgb)


def cases(folder: Path) -> list[Case]:
    many, of_each = 200, 9
    return [
        Case('images', st.tuples(raw_images(), st.sampled_from([None, 'bgr8', 'rgb8'])), check_image, many, crossings=of_each),
        Case('compressed images', st.tuples(compressed_images(), SIZES), check_compressed_image, many, crossings=of_each),
        Case('camera infos', st.tuples(INFO, st.booleans()), check_camera_info, many, crossings=of_each),
        Case('point clouds', clouds(), check_point_cloud, many, crossings=of_each),
        Case('poses', st.lists(st.one_of(st.floats(-2, 2), FLOAT), min_size=7, max_size=7), check_pose, many, crossings=of_each),
        Case('stamps', st.tuples(HEADER, st.binary(max_size=40)), check_stamp, many, crossings=of_each),
        Case('names of types', NAMES, check_name_of_type, many, crossings=of_each),
        Case('images to send', images_to_send(), check_image_to_send, crossings=of_each),
        Case('clouds to send', CLOUDS_TO_SEND, check_cloud_to_send, crossings=of_each),
    ]


KIND = Kind('messages', 290_000, cases)
