"""Whatever a message holds, only ``MessageError`` comes out of a conversion, in one line."""

from __future__ import annotations

import struct
from collections.abc import Callable
from types import SimpleNamespace as Message
from typing import Any

import cv2
import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from test_rvl import encoded

from msg_adapters import camera_info, encodings, images, point_clouds, poses, remarks, stamps
from msg_adapters.errors import MessageError
from msg_adapters.factory import message_class

EXAMPLES = settings(max_examples=300, deadline=None, suppress_health_check=list(HealthCheck))
UINT32 = st.one_of(st.integers(0, 70), st.sampled_from([2**16, 2**31, 2**32 - 1]), st.integers(0, 2**32 - 1))
FLOAT = st.one_of(st.floats(), st.sampled_from([0.0, -0.0, 1.0, 1e-320, 1e-200, 1e200, 1e308, float('nan'), float('inf')]))
FLOAT32 = st.floats(width=32)
BYTES = st.binary(max_size=400).map(lambda data: np.frombuffer(data, np.uint8))
STAMP = st.builds(Message, sec=st.integers(-(2**31), 2**31 - 1), nanosec=st.integers(0, 2**32 - 1))
HEADER = st.builds(Message, stamp=STAMP, frame_id=st.text(max_size=5))
COLORS = [*encodings.color_encodings(None)]
DEPTHS = [*encodings.depth_encodings(0.001)]
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


def only_known_errors(convert: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
    """The result; None after the package's error."""
    try:
        return convert(*arguments, **options)
    except MessageError as error:
        assert '\n' not in str(error) and len(str(error)) < 2000
        return None


def consistent(draw: Any, message: Message) -> None:
    """Now and then, a layout that fits the data, so that conversion is reached."""
    step = message.width * draw(st.integers(1, 9)) + draw(st.integers(0, 3))
    if message.width < 80 and message.height < 80:
        message.step = step
        message.data = np.resize(np.append(message.data, np.uint8(7)), message.height * step)


@st.composite
def raw_images(draw: Any) -> Message:
    message = Message(
        header=draw(HEADER), height=draw(UINT32), width=draw(UINT32), encoding=draw(ENCODING), step=draw(UINT32),
        is_bigendian=draw(st.integers(0, 255)), data=draw(BYTES),
    )  # fmt: skip
    if draw(st.booleans()):
        consistent(draw, message)
    return message


@EXAMPLES
@given(raw_images(), st.sampled_from([None, 'bgr8', 'rgb8']))
def test_images(message: Message, rgb_encoding: str | None) -> None:
    rgb = only_known_errors(images.decode_color, message, rgb_encoding=rgb_encoding)
    assert rgb is None or (rgb.shape == (message.height, message.width, 3) and rgb.dtype == np.uint8)
    depth_m = only_known_errors(images.decode_depth, message)
    assert depth_m is None or (depth_m.shape == (message.height, message.width) and is_clean(depth_m))


def is_clean(depth_m: np.ndarray) -> bool:
    return depth_m.dtype == np.float32 and bool((np.isfinite(depth_m) & (depth_m >= 0)).all())


@st.composite
def damaged(draw: Any, whole: bytes) -> bytes:
    """Bytes of an image of which some are changed, left out or added."""
    data = bytearray(whole)
    for _ in range(draw(st.integers(0, 6))):
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
    content = (
        draw(damaged(draw(st.sampled_from([JPEG, PNG, PNG16, RVL])))) if draw(st.booleans()) else draw(st.binary(max_size=200))
    )
    config = draw(st.one_of(st.just(b''), st.builds(struct.pack, st.just('<iff'), st.integers(-9, 9), FLOAT32, FLOAT32)))
    data = np.frombuffer(config + content, np.uint8)
    return Message(header=draw(HEADER), format=draw(FORMATS), data=data)


@EXAMPLES
@given(compressed_images(), st.sampled_from([None, (48, 32), (1, 1), (16384, 4096)]))
def test_compressed_images(message: Message, camera_size: tuple[int, int] | None) -> None:
    rgb = only_known_errors(images.decode_color, message, camera_size=camera_size)
    assert rgb is None or (rgb.dtype == np.uint8 and camera_size in (None, rgb.shape[1::-1]))
    depth_m = only_known_errors(images.decode_depth, message, camera_size=camera_size)
    assert depth_m is None or is_clean(depth_m)


REGION = st.builds(Message, x_offset=UINT32, y_offset=UINT32, width=UINT32, height=UINT32, do_rectify=st.booleans())
MODEL = st.one_of(st.sampled_from(['plumb_bob', 'equidistant', 'rational_polynomial', 'None', '']), st.text(max_size=9))
INFO = st.builds(
    Message, header=HEADER, height=UINT32, width=UINT32, distortion_model=MODEL, d=st.lists(FLOAT, max_size=20),
    k=st.one_of(st.just([0.0] * 9), st.lists(FLOAT, min_size=9, max_size=9), st.lists(FLOAT, max_size=10)),
    r=st.just([0.0] * 9), p=st.one_of(st.just([0.0] * 12), st.lists(FLOAT, min_size=12, max_size=12), st.lists(FLOAT, max_size=13)),
    binning_x=UINT32, binning_y=UINT32, roi=REGION,
)  # fmt: skip


@EXAMPLES
@given(INFO, st.booleans())
def test_camera_infos(message: Message, is_rectified: bool) -> None:
    camera = only_known_errors(camera_info.parameters, message, is_rectified=is_rectified)
    remarks.on_info(message)
    if camera is not None:
        values = (camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion)
        assert np.isfinite(values).all() and camera.width > 0 and camera.height > 0


FIELD = st.builds(
    Message, name=st.sampled_from(['x', 'y', 'z', 'rgb', 'i', '']), offset=UINT32, datatype=st.integers(0, 9), count=UINT32
)
POINT_FIELDS = [Message(name=name, offset=4 * i, datatype=7, count=1) for i, name in enumerate(('x', 'y', 'z', 'rgb'))]


@st.composite
def clouds(draw: Any) -> Message:
    message = Message(
        header=draw(HEADER), height=draw(UINT32), width=draw(UINT32), is_bigendian=draw(st.booleans()),
        fields=draw(st.one_of(st.just(POINT_FIELDS), st.lists(FIELD, max_size=8))), point_step=draw(UINT32), row_step=draw(UINT32),
        data=draw(BYTES), is_dense=True,
    )  # fmt: skip
    if draw(st.booleans()) and max(message.height, message.width, message.point_step) < 80:
        message.row_step = message.width * message.point_step + draw(st.integers(0, 3))
        message.data = np.resize(np.append(message.data, np.uint8(7)), message.height * message.row_step)
    return message


@EXAMPLES
@given(clouds())
def test_point_clouds(message: Message) -> None:
    found = only_known_errors(point_clouds.read_cloud, message)
    assert found is None or found[0].shape == found[1].shape == (message.width * message.height, 3)


@EXAMPLES
@given(st.lists(FLOAT, min_size=7, max_size=7))
def test_poses(values: list[float]) -> None:
    position, rotation = dict(zip('xyz', values)), dict(zip('xyzw', values[3:]))
    pose = Message(position=Message(**position), orientation=Message(**rotation))
    transform = Message(translation=Message(**position), rotation=Message(**rotation))
    for T in (only_known_errors(poses.pose_matrix, pose), only_known_errors(poses.transform_matrix, transform)):
        if T is not None:
            assert np.isfinite(T).all() and np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() < 1e-9


@EXAMPLES
@given(HEADER, st.binary(max_size=40))
def test_stamps(header: Message, data: bytes) -> None:
    for stamp_ns in (
        only_known_errors(stamps.message_stamp_ns, Message(header=header)),
        only_known_errors(stamps.serialized_stamp_ns, data),
    ):
        assert stamp_ns is None or stamps.from_ns(stamp_ns)


@EXAMPLES
@given(st.one_of(st.text(max_size=30), st.from_regex(r'[.\w/ ]{0,9}/msg/[.\w/ ]{0,9}', fullmatch=True)))
def test_names_of_types(name: str) -> None:
    assert only_known_errors(message_class, name) is None or '/msg/' in name
