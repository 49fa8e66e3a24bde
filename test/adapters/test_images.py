"""Images to messages and back; messages as drivers send them, and invalid ones."""

from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np
import pytest
from numpy.testing import assert_array_equal
from rosbags.typesys import Stores, get_typestore

from msg_adapters import images, remarks, stamps
from msg_adapters.errors import MessageError
from msg_adapters.factory import RosbagsMessages

STAMP_NS, FRAME = 12_345_678_901, 'camera_color_optical_frame'


def random_rgb(height=6, width=8):
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)


def random_depth(height=6, width=8):
    return np.random.default_rng(1).uniform(0.3, 9, (height, width)).astype(np.float32)


def smooth_rgb(height=48, width=64):
    y, x = np.mgrid[:height, :width]
    return np.stack([4 * x, 5 * y, 255 - 2 * x - 2 * y], axis=-1).astype(np.uint8)


def raw_message(factory, pixels, encoding, *, padding=0, big_endian=False):
    """An Image as a driver might send it: any byte order, rows padded with arbitrary bytes."""
    height, width = pixels.shape[:2]
    ordered = pixels.astype(pixels.dtype.newbyteorder('>' if big_endian else '<'))
    rows = np.frombuffer(ordered.tobytes(), np.uint8).reshape(height, -1)
    rows = np.hstack([rows, np.full((height, padding), 0xAB, np.uint8)])
    return factory.make(
        'sensor_msgs/msg/Image', header=stamps.header(factory, STAMP_NS, FRAME), height=height, width=width,
        encoding=encoding, is_bigendian=int(big_endian), step=rows.shape[1], data=rows.reshape(-1),
    )  # fmt: skip


def compressed_message(factory, image_format, data):
    return factory.make(
        'sensor_msgs/msg/CompressedImage', header=stamps.header(factory, STAMP_NS, FRAME), format=image_format,
        data=np.frombuffer(data, np.uint8),
    )  # fmt: skip


def png(pixels):
    return cv2.imencode('.png', pixels)[1].tobytes()


# Round trips


def test_colour_comes_back_exactly(factory):
    message = images.color_message(factory, random_rgb(), STAMP_NS, FRAME)
    assert (message.encoding, message.step, message.header.frame_id) == ('rgb8', 24, FRAME)
    assert stamps.message_stamp_ns(message) == STAMP_NS
    decoded = images.decode_color(message)
    assert_array_equal(decoded, random_rgb())
    assert decoded.dtype == np.uint8 and decoded.flags.c_contiguous


def test_float_depth_comes_back_exactly(factory):
    decoded = images.decode_depth(images.depth_message(factory, random_depth(), STAMP_NS, FRAME))
    assert_array_equal(decoded, random_depth())
    assert decoded.dtype == np.float32


@pytest.mark.parametrize('build', [images.depth_message, images.compressed_depth_message])
def test_every_millimetre_comes_back_exactly(factory, build):
    counts = np.arange(2**16, dtype=np.uint16).reshape(256, 256)
    metres = counts.astype(np.float32) / np.float32(1000)
    decoded = images.decode_depth(build(factory, metres, STAMP_NS, FRAME, encoding='16UC1'))
    assert_array_equal(decoded, metres)


def test_a_mono_image_becomes_grey(factory):
    grey = random_rgb()[..., 0]
    message = images.mono_message(factory, grey, STAMP_NS, FRAME)
    assert_array_equal(images.decode_color(message), np.stack([grey] * 3, axis=-1))


def test_images_that_are_views_are_sent_as_they_look(factory):
    flipped = random_rgb()[:, ::-1]
    assert_array_equal(images.decode_color(images.color_message(factory, flipped, STAMP_NS, FRAME)), flipped)
    transposed = random_depth().T
    assert_array_equal(images.decode_depth(images.depth_message(factory, transposed, STAMP_NS, FRAME)), transposed)


def test_messages_survive_cdr():
    store = get_typestore(Stores.ROS2_JAZZY)
    message = images.depth_message(RosbagsMessages(store), random_depth(), STAMP_NS, FRAME)
    raw = store.serialize_cdr(message, 'sensor_msgs/msg/Image')
    assert_array_equal(images.decode_depth(store.deserialize_cdr(raw, 'sensor_msgs/msg/Image')), random_depth())


def test_messages_of_one_library_are_the_other_ones_bytes():
    """A message that rosbags wrote and the player published reaches the node unchanged."""
    sensor_msgs = pytest.importorskip('sensor_msgs.msg')
    serialization = pytest.importorskip('rclpy.serialization')
    store = get_typestore(Stores.ROS2_JAZZY)
    message = images.color_message(RosbagsMessages(store), random_rgb(), STAMP_NS, FRAME)
    raw = bytes(store.serialize_cdr(message, 'sensor_msgs/msg/Image'))
    received = serialization.deserialize_message(raw, sensor_msgs.Image)
    assert stamps.message_stamp_ns(received) == STAMP_NS
    assert_array_equal(images.decode_color(received), random_rgb())


def test_decoded_images_do_not_share_the_messages_memory(factory):
    for message, decode in (
        (images.color_message(factory, random_rgb(), STAMP_NS, FRAME), images.decode_color),
        (images.depth_message(factory, random_depth(), STAMP_NS, FRAME), images.decode_depth),
    ):
        assert not np.shares_memory(decode(message), np.frombuffer(message.data, np.uint8))


# Encodings, byte order, padding


@pytest.mark.parametrize('padding', [0, 5])
@pytest.mark.parametrize(
    ('encoding', 'channels'),
    [('rgb8', [0, 1, 2]), ('bgr8', [2, 1, 0]), ('rgba8', [0, 1, 2, 0]), ('bgra8', [2, 1, 0, 1])],
)
def test_channel_orders(factory, encoding, channels, padding):
    message = raw_message(factory, random_rgb()[..., channels], encoding, padding=padding)
    assert_array_equal(images.decode_color(message), random_rgb())


@pytest.mark.parametrize(
    ('encoding', 'stated', 'channels', 'read_as'),
    [
        ('8UC3', None, [2, 1, 0], 'bgr8'), ('8UC3', 'bgr8', [2, 1, 0], ''), ('8UC3', 'rgb8', [0, 1, 2], ''),
        ('8UC4', None, [2, 1, 0, 1], 'bgra8'), ('8UC4', 'rgb8', [0, 1, 2, 0], ''), ('rgb8', None, [0, 1, 2], ''),
        ('rgb8', 'bgr8', [0, 1, 2], ''),
    ],
)  # fmt: skip
def test_encodings_that_do_not_say_the_order_of_channels(factory, encoding, stated, channels, read_as):
    message = raw_message(factory, random_rgb()[..., channels], encoding)
    assert_array_equal(images.decode_color(message, rgb_encoding=stated), random_rgb())
    remark = remarks.on_encoding(encoding, stated)
    assert bool(remark) == bool(read_as) and read_as in remark


def test_8uc1_is_grey(factory):
    decoded = images.decode_color(raw_message(factory, random_rgb()[..., 0], '8UC1'))
    assert_array_equal(decoded, np.stack([random_rgb()[..., 0]] * 3, axis=-1))


@pytest.mark.parametrize('pattern', ['rggb', 'bggr', 'gbrg', 'grbg'])
def test_bayer_patterns(factory, pattern):
    rgb = np.broadcast_to(np.array([200, 120, 40], np.uint8), (8, 10, 3))
    mosaic = np.empty((8, 10), np.uint8)
    for i, colour in enumerate(pattern):
        mosaic[i // 2 :: 2, i % 2 :: 2] = rgb[0, 0, 'rgb'.index(colour)]
    assert_array_equal(images.decode_color(raw_message(factory, mosaic, f'bayer_{pattern}8')), rgb)


@pytest.mark.parametrize(('encoding', 'luma'), [('yuv422', 1), ('uyvy', 1), ('yuv422_yuy2', 0), ('yuyv', 0)])
def test_yuv422(factory, encoding, luma):
    y, u, v = 81, 90, 240  # BT.601's pure red
    pixels = np.empty((4, 6, 2), np.uint8)
    pixels[..., luma] = y
    pixels[:, 0::2, 1 - luma] = u
    pixels[:, 1::2, 1 - luma] = v
    decoded = images.decode_color(raw_message(factory, pixels, encoding))
    # 2 counts: the conversion rounds coefficients and results.
    assert np.abs(decoded.astype(int) - [255, 0, 0]).max() <= 2


@pytest.mark.parametrize('big_endian', [False, True])
@pytest.mark.parametrize('padding', [0, 3])
@pytest.mark.parametrize('encoding', ['16UC1', 'mono16'])
def test_millimetres_in_any_byte_order_and_padding(factory, encoding, padding, big_endian):
    counts = np.array([[0, 1, 256, 1000], [4242, 32768, 65534, 65535]], np.uint16)
    message = raw_message(factory, counts, encoding, padding=padding, big_endian=big_endian)
    assert_array_equal(images.decode_depth(message), counts.astype(np.float32) / np.float32(1000))


def test_counts_of_another_length(factory):
    """TUM's recordings have 5000 counts per metre."""
    counts = np.array([[0, 1, 5000, 65535]], np.uint16)
    data = struct.pack('<iff', 0, 0.0, 0.0) + png(counts)
    compressed = compressed_message(factory, '16UC1; compressedDepth png', data)
    for message in (raw_message(factory, counts, '16UC1'), raw_message(factory, counts, 'mono16'), compressed):
        assert_array_equal(images.decode_depth(message, 1 / 5000), counts.astype(np.float32) / np.float32(5000))
    metres = images.depth_message(factory, random_depth(), STAMP_NS, FRAME)
    assert_array_equal(images.decode_depth(metres, 1 / 5000), random_depth())


@pytest.mark.parametrize('big_endian', [False, True])
@pytest.mark.parametrize('padding', [0, 3])
def test_metres_in_any_byte_order_and_padding(factory, padding, big_endian):
    message = raw_message(factory, random_depth(), '32FC1', padding=padding, big_endian=big_endian)
    decoded = images.decode_depth(message)
    assert_array_equal(decoded, random_depth())
    assert decoded.dtype.isnative and decoded.flags.c_contiguous


def test_what_is_no_reading_becomes_zero(factory):
    depth_m = np.array([[np.nan, np.inf, -np.inf], [-1.0, 0.0, 2.5]], np.float32)
    expected = np.array([[0, 0, 0], [0, 0, 2.5]], np.float32)
    assert_array_equal(images.decode_depth(raw_message(factory, depth_m, '32FC1')), expected)
    for build in (images.depth_message, images.compressed_depth_message):
        for encoding in ('32FC1', '16UC1'):
            message = build(factory, depth_m, STAMP_NS, FRAME, encoding=encoding)
            assert_array_equal(images.decode_depth(message), expected)


def test_depth_too_far_for_16_bits_is_no_reading(factory):
    depth_m = np.array([[65.535, 65.536, 1e30]])
    message = images.depth_message(factory, depth_m, STAMP_NS, FRAME, encoding='16UC1')
    assert_array_equal(images.decode_depth(message), np.array([[65.535, 0, 0]], np.float32))


# Compressed images


def test_png_colour_comes_back_exactly(factory):
    message = images.compressed_color_message(factory, random_rgb(), STAMP_NS, FRAME, format='png')
    assert message.format == 'rgb8; png compressed bgr8'
    assert_array_equal(images.decode_color(message), random_rgb())


def test_jpeg_colour_comes_back_nearly(factory):
    message = images.compressed_color_message(factory, smooth_rgb(), STAMP_NS, FRAME)
    error = np.abs(images.decode_color(message).astype(int) - smooth_rgb())
    # Quality 95 on a smooth image: a few counts; swapped channels would be off by more than 100.
    assert error.mean() < 3 and error.max() < 30


def test_inverse_depth_is_as_exact_as_promised(factory):
    depth_m = np.geomspace(0.4, 12, 48).reshape(6, 8).astype(np.float32)
    depth_m[2, 3] = 0
    message = images.compressed_depth_message(factory, depth_m, STAMP_NS, FRAME, encoding='32FC1')
    decoded = images.decode_depth(message)
    # 1 %: the counts are the rounding error's only large part; float32 adds 1e-7 of the depth.
    assert (np.abs(decoded - depth_m) <= 1.01 * depth_m**2 / (131070 * 0.4) + 1e-6).all()
    assert decoded[2, 3] == 0


def test_inverse_depth_as_image_transport_writes_it(factory):
    """Its settings depth_max 10 m and depth_quantization 100 give A = 10100 and B = 1 - A / 10."""
    a, b = 100 * 101.0, 1 - 100 * 101 / 10.0
    depth_m = np.array([[0.5, 1.0, 2.0, 7.5]])
    counts = np.append((a / depth_m + b).astype(np.uint16), np.uint16(0)).reshape(1, 5)
    data = struct.pack('<iff', 0, a, b) + png(counts)
    decoded = images.decode_depth(compressed_message(factory, '32FC1; compressedDepth', data))
    # One count, cut off, is z**2 / A.
    assert (np.abs(decoded[0, :4] - depth_m[0]) <= depth_m[0] ** 2 / a).all()
    assert decoded[0, 4] == 0


def test_depth_sent_by_the_plain_png_plugin(factory):
    counts = np.array([[0, 1500, 65535]], np.uint16)
    decoded = images.decode_depth(compressed_message(factory, '16UC1; png compressed ', png(counts)))
    assert_array_equal(decoded, np.array([[0, 1.5, 65.535]], np.float32))


@pytest.mark.parametrize('format', ['jpeg', 'png'])
@pytest.mark.parametrize('share', [0.0, 0.2, 0.9, 0.995])
def test_truncated_compressed_colour_is_an_error(factory, format, share):
    whole = images.compressed_color_message(factory, smooth_rgb(), STAMP_NS, FRAME, format=format)
    data = bytes(whole.data)
    with pytest.raises(MessageError, match='truncated|neither'):
        images.decode_color(compressed_message(factory, whole.format, data[: int(share * len(data))]))


def test_a_jpeg_without_its_end_is_an_error(factory):
    """OpenCV 4.6 decodes it, and also one whose last rows are missing, as grey."""
    whole = images.compressed_color_message(factory, smooth_rgb(), STAMP_NS, FRAME)
    with pytest.raises(MessageError, match='truncated'):
        images.decode_color(compressed_message(factory, whole.format, bytes(whole.data)[:-2]))


@pytest.mark.parametrize('length', [0, 11, 12, 15, 60, -5])
def test_truncated_compressed_depth_is_an_error(factory, length):
    whole = images.compressed_depth_message(factory, random_depth(), STAMP_NS, FRAME)
    with pytest.raises(MessageError, match='truncated|neither'):
        images.decode_depth(compressed_message(factory, whole.format, bytes(whole.data)[:length]))


@pytest.mark.parametrize(
    ('image_format', 'data', 'said'),
    [
        ('16UC1; compressedDepth rvl', b'x' * 40, 'depth image is 2021161080x2021161080'),
        ('16UC1; compressedDepth rvl', b'x' * 12 + bytes(7), 'RVL depth image has 7 bytes'),
        ('8UC1; compressedDepth png', bytes(12) + png(np.ones((2, 2), np.uint16)), 'must begin with'),
        ('16UC1; compressedDepth png', bytes(12) + png(np.ones((2, 2), np.uint8)), '16-bit'),
        ('16UC1; compressedDepth png', bytes(12) + png(np.ones((2, 2, 3), np.uint16)), '16-bit'),
        ('rgb8; jpeg compressed bgr8', cv2.imencode('.jpg', random_rgb())[1].tobytes(), '16-bit'),
        ('theora', b'OggS' + bytes(40), 'neither JPEG nor PNG'),
    ],
)
def test_compressed_data_that_are_no_depth(factory, image_format, data, said):
    with pytest.raises(MessageError, match=said):
        images.decode_depth(compressed_message(factory, image_format, data))


# Sizes and orientations that headers state


def with_exif(jpeg, orientation):
    exif = b'Exif\0\0II*\0\x08\0\0\0' + struct.pack('<HHHIII', 1, 0x112, 3, 1, orientation, 0)
    return jpeg[:2] + b'\xff\xe1' + struct.pack('>H', len(exif) + 2) + exif + jpeg[2:]


def jpeg_of_size(width, height):
    """A small JPEG whose header states another size."""
    data = cv2.imencode('.jpg', smooth_rgb())[1].tobytes()
    start = data.index(b'\xff\xc0') + 5
    return data[:start] + struct.pack('>HH', height, width) + data[start + 4 :]


def png_of_size(width, height, pixels=None):
    data = png(random_rgb() if pixels is None else pixels)
    header = b'IHDR' + struct.pack('>II', width, height) + data[24:29]
    return data[:12] + header + struct.pack('>I', zlib.crc32(header)) + data[33:]


@pytest.mark.parametrize('orientation', range(1, 9))
def test_pixels_are_read_as_stored_whatever_orientation_a_jpeg_states(factory, orientation):
    plain = cv2.imencode('.jpg', smooth_rgb()[..., ::-1])[1].tobytes()
    decoded = images.decode_color(compressed_message(factory, 'jpeg', with_exif(plain, orientation)))
    assert_array_equal(decoded, images.decode_color(compressed_message(factory, 'jpeg', plain)))


@pytest.fixture
def no_decoder(monkeypatch):
    monkeypatch.setattr(cv2, 'imdecode', lambda *_: pytest.fail('decoded before its size was checked'))


@pytest.mark.usefixtures('no_decoder')
@pytest.mark.parametrize('size', [(40000, 40000), (65500, 65500), (20000, 20000), (40000, 2), (0, 8), (16384, 16384)])
def test_an_image_that_states_an_impossible_size_is_not_decoded(factory, size):
    width, height = size
    for data in (jpeg_of_size(width, height), png_of_size(width, height)):
        with pytest.raises(MessageError, match=f'colour image is {width}x{height}; both sides must be'):
            images.decode_color(compressed_message(factory, 'jpeg', data))
    counts = np.ones((4, 4), np.uint16)
    data = bytes(12) + png_of_size(width, height, counts)
    with pytest.raises(MessageError, match=f'depth image is {width}x{height}'):
        images.decode_depth(compressed_message(factory, '16UC1; compressedDepth png', data))


@pytest.mark.usefixtures('no_decoder')
def test_an_image_of_another_size_than_the_cameras_is_not_decoded(factory):
    for data in (jpeg_of_size(64, 49), png_of_size(65, 48)):
        with pytest.raises(MessageError, match='but the camera is calibrated for 64x48'):
            images.decode_color(compressed_message(factory, 'jpeg', data), camera_size=(64, 48))
    depth = bytes(12) + png_of_size(64, 48, np.ones((4, 4), np.uint16))
    with pytest.raises(MessageError, match='more than 4 times as large as the 15x12 images'):
        images.decode_depth(compressed_message(factory, '16UC1; compressedDepth png', depth), camera_size=(15, 12))


def test_the_size_is_found_behind_other_segments_and_fill_bytes(factory):
    data = cv2.imencode('.jpg', smooth_rgb())[1].tobytes()
    comment = b'\xff\xfe' + struct.pack('>H', 10) + b'\xff\xc0\x00\x11\x08abc'  # what looks like a size, in a comment
    message = compressed_message(factory, 'jpeg', data[:2] + comment + b'\xff\xff' + data[2:])
    assert images.decode_color(message, camera_size=(64, 48)).shape == (48, 64, 3)


def test_a_whole_header_before_damaged_pixels_is_an_error(factory):
    data = jpeg_of_size(100, 30)
    try:
        assert images.decode_color(compressed_message(factory, 'jpeg', data)).shape == (30, 100, 3)  # lenient decoders fill up
    except MessageError as error:
        assert 'truncated or damaged' in str(error)


def test_compressed_depth_is_no_colour(factory):
    with pytest.raises(MessageError, match='which is depth'):
        images.decode_color(images.compressed_depth_message(factory, random_depth(), STAMP_NS, FRAME))


# Broken messages


@pytest.mark.parametrize(('decode', 'encoding'), [(images.decode_color, '16UC1'), (images.decode_depth, 'rgb8')])
def test_an_encoding_of_the_other_kind_is_an_error_that_lists_the_supported(factory, decode, encoding):
    with pytest.raises(MessageError, match=r"encoding '\w+'; supported are \w+, ") as caught:
        decode(raw_message(factory, np.zeros((2, 2), np.uint16), encoding))
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize('encoding', ['', 'RGB8', 'rgb16', '8UC2', 'nv21'])
def test_an_unknown_encoding_is_an_error(factory, encoding):
    with pytest.raises(MessageError, match=f"'{encoding}'"):
        images.decode_color(raw_message(factory, random_rgb(), encoding))


@pytest.mark.parametrize(
    ('changes', 'said'),
    [
        ({'height': 7}, 'truncated'),
        ({'height': 5}, 'sets a wrong size or step'),
        ({'step': 25}, 'truncated'),
        ({'step': 23}, 'step is 23'),
        ({'step': 0}, 'step is 0'),
        ({'width': 9}, 'step is 24'),
        ({'width': 0}, 'at least 1 pixel'),
        ({'height': 0}, 'at least 1 pixel'),
    ],
)
def test_sizes_that_do_not_fit_the_data_are_errors(factory, changes, said):
    message = images.color_message(factory, random_rgb(), STAMP_NS, FRAME)
    for name, value in changes.items():
        setattr(message, name, value)
    with pytest.raises(MessageError, match=said):
        images.decode_color(message)


@pytest.mark.parametrize('missing', [1, 24, 144])
def test_truncated_data_are_an_error(factory, missing):
    pixels = random_rgb().reshape(-1)[: 144 - missing]
    message = raw_message(factory, pixels[None], 'rgb8')
    message.height, message.width, message.step = 6, 8, 24
    with pytest.raises(MessageError, match='truncated'):
        images.decode_color(message)


def test_an_odd_width_in_yuv422_is_an_error(factory):
    with pytest.raises(MessageError, match='multiple of 2'):
        images.decode_color(raw_message(factory, np.zeros((2, 3, 2), np.uint8), 'yuv422'))


@pytest.mark.parametrize(
    ('build', 'array'),
    [
        (images.color_message, np.zeros((4, 4), np.uint8)),
        (images.color_message, np.zeros((4, 4, 3), np.float32)),
        (images.color_message, np.zeros((0, 4, 3), np.uint8)),
        (images.compressed_color_message, np.zeros((4, 4, 4), np.uint8)),
        (images.mono_message, np.zeros((4, 4, 3), np.uint8)),
        (images.depth_message, np.zeros((4, 4), np.uint16)),
        (images.compressed_depth_message, np.zeros((4, 4, 1), np.float32)),
    ],
)
def test_arrays_of_another_shape_or_type_are_not_sent(factory, build, array):
    with pytest.raises(MessageError, match='expected'):
        build(factory, array, STAMP_NS, FRAME)


def test_unknown_formats_are_not_sent(factory):
    with pytest.raises(MessageError, match='jpeg or png'):
        images.compressed_color_message(factory, random_rgb(), STAMP_NS, FRAME, format='webp')
    for build in (images.depth_message, images.compressed_depth_message):
        with pytest.raises(MessageError, match='must be'):
            build(factory, random_depth(), STAMP_NS, FRAME, encoding='64FC1')
