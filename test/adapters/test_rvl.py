"""RVL depth, encoded here by Wilson's published description, step by step."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.testing import assert_array_equal
from test_images import compressed_message

from msg_adapters import images, rvl
from msg_adapters.errors import MessageError


class Encoder:
    """The encoder of the paper's listing: one nibble after the other, most significant first, in 32-bit words."""

    def __init__(self):
        self.words, self.word, self.nibbles = [], 0, 0

    def number(self, value):
        while True:
            nibble, value = value & 7, value >> 3
            self.word = self.word << 4 | nibble | (8 if value else 0)
            self.nibbles += 1
            if self.nibbles == 8:
                self.words.append(self.word)
                self.word = self.nibbles = 0
            if not value:
                return

    def finish(self):
        if self.nibbles:
            self.words.append(self.word << 4 * (8 - self.nibbles))
        return b''.join(struct.pack('<I', word) for word in self.words)


def encoded(counts):
    """Width, height and the stream of an image, as the transport sends it."""
    encoder, pixels, at, previous = Encoder(), counts.reshape(-1).tolist(), 0, 0
    while at < len(pixels):
        zeros = next((i for i, value in enumerate(pixels[at:]) if value), len(pixels) - at)
        at += zeros
        readings = next((i for i, value in enumerate(pixels[at:]) if not value), len(pixels) - at)
        encoder.number(zeros)
        encoder.number(readings)
        for value in pixels[at : at + readings]:
            difference = value - previous
            encoder.number(2 * difference if difference >= 0 else -2 * difference - 1)
            previous = value
        at += readings
    height, width = counts.shape
    return struct.pack('<II', width, height) + encoder.finish()


SPARSE = st.one_of(st.just(0), st.integers(0, 2**16 - 1), st.integers(990, 1010))


@given(st.data())
def test_every_image_comes_back(data):
    shape = data.draw(st.tuples(st.integers(1, 9), st.integers(1, 9)))
    counts = data.draw(arrays(np.uint16, shape, elements=SPARSE))
    assert_array_equal(rvl.decode(encoded(counts)), counts)


def test_a_stream_written_down_by_hand():
    """Two zeros, then 1000 and 998: nibbles 2, 2, then 2000 = 0o3720 from its lowest digit on, then 3."""
    word = int('22' + '8' + 'a' + 'f' + '3' + '3' + '0', 16)
    data = struct.pack('<III', 4, 1, word)
    assert_array_equal(rvl.decode(data), np.array([[0, 0, 1000, 998]], np.uint16))


def test_counts_and_inverse_depth_in_messages(factory):
    rng = np.random.default_rng(0)
    counts = rng.integers(400, 4000, (48, 64)).astype(np.uint16) * (rng.random((48, 64)) > 0.3)
    message = compressed_message(factory, '16UC1; compressedDepth rvl', bytes(12) + encoded(counts))
    assert_array_equal(images.decode_depth(message, camera_size=(64, 48)), counts.astype(np.float32) / np.float32(1000))
    assert_array_equal(images.decode_depth(message, 1 / 5000), counts.astype(np.float32) / np.float32(5000))
    a, b = 10100.0, -1009.0
    message = compressed_message(factory, '32FC1; compressedDepth rvl', struct.pack('<iff', 0, a, b) + encoded(counts))
    expected = np.where(counts > 0, np.float32(a) / (counts.astype(np.float32) - np.float32(b)), 0)
    assert_array_equal(images.decode_depth(message), expected.astype(np.float32))


def test_a_signed_difference_that_wraps_is_read_as_other_decoders_do():
    """The paper's code has 16-bit signed pixels: 1 follows 65535 by a difference of 2."""
    encoder = Encoder()
    for number in (0, 2, 1, 4):  # no zeros, two readings: -1 = 65535, then + 2
        encoder.number(number)
    assert_array_equal(rvl.decode(struct.pack('<II', 2, 1) + encoder.finish()), np.array([[65535, 1]], np.uint16))


def test_a_truncated_image_is_an_error():
    counts = np.random.default_rng(0).integers(1, 2**16, (6, 8)).astype(np.uint16)
    whole = encoded(counts)
    for length in range(len(whole) - 4):
        with pytest.raises(MessageError, match='RVL depth image'):
            rvl.decode(whole[:length])


@given(st.binary(max_size=200), st.integers(1, 40), st.integers(1, 40))
def test_whatever_the_stream_holds_only_the_error_of_the_package_comes_out(stream, width, height):
    try:
        assert rvl.decode(struct.pack('<II', width, height) + stream).shape == (height, width)
    except MessageError as error:
        assert '\n' not in str(error)


def test_the_size_is_checked_before_anything_is_allocated(factory, monkeypatch):
    monkeypatch.setattr(rvl, 'decode', lambda _: pytest.fail('decoded before its size was checked'))
    for width, height in ((2**32 - 1, 2**32 - 1), (40000, 40000), (0, 5), (5, 0)):
        data = bytes(12) + struct.pack('<II', width, height) + bytes(8)
        with pytest.raises(MessageError, match=f'depth image is {width}x{height}'):
            images.decode_depth(compressed_message(factory, '16UC1; compressedDepth rvl', data))
    data = bytes(12) + struct.pack('<II', 4000, 3000) + bytes(8)
    with pytest.raises(MessageError, match='4000x3000, more than 4 times as large as the 640x480'):
        images.decode_depth(compressed_message(factory, '16UC1; compressedDepth rvl', data), camera_size=(640, 480))
