"""The size of an image as its file's header states it, so that a file can be refused before it is decoded.

A few kilobytes may claim an image of gigabytes, and decoders allocate what is claimed.
"""

from __future__ import annotations

import struct

MAX_PIXELS = 2**26
"""The largest image that is decoded, 8192x8192."""

Size = tuple[int, int]
"""Width and height in pixels."""

PNG, JPEG, EXR = b'\x89PNG\r\n\x1a\n', b'\xff\xd8', b'\x76\x2f\x31\x01'
BMP, TIFF_LITTLE, TIFF_BIG, RIFF = b'BM', b'II*\0', b'MM\0*', b'RIFF'
FRAME_HEADERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""JPEG markers that are followed by the size (ITU-T T.81, table B.1)."""

WITHOUT_LENGTH = frozenset({0x00, 0x01, *range(0xD0, 0xD8)})
END_OF_HEADER = frozenset({0xD9, 0xDA})
"""The end of the image and the start of its pixels."""


def stated_size(data: bytes) -> Size | None:
    """Returns the width and height that a PNG, JPEG, OpenEXR, BMP, TIFF, WebP or PNM file states; None if it is none of them.

    Args:
        data: the whole file, or its beginning.
    """
    try:
        return _stated_size(data)
    except (struct.error, ValueError, IndexError):
        return None


def too_large(size: Size) -> str:
    """Returns why an image of a size is not decoded; empty if it may be."""
    width, height = size
    if 0 < width * height <= MAX_PIXELS and min(size) > 0:
        return ''
    return f'claims to be {width}x{height} pixels; images of 1 to {MAX_PIXELS} pixels are read'


def is_cut(data: bytes) -> bool:
    """Returns True if a chunk of a PNG ends behind the data; OpenCV allocates what a chunk claims, up to 4 GB.

    Args:
        data: the whole file; of another format it is never cut.
    """
    at, kind = len(PNG), b''
    while data.startswith(PNG) and kind != b'IEND':
        length, kind = int.from_bytes(data[at : at + 4], 'big'), data[at + 4 : at + 8]
        at += 12 + length
        if at > len(data):
            return True
    return False


def _stated_size(data: bytes) -> Size | None:
    if data.startswith(PNG):
        return _pair('>II', data, 16)
    if data.startswith(JPEG):
        return _jpeg(data)
    if data.startswith(EXR):
        return _exr(data)
    if data.startswith(BMP):
        width, height = _pair('<ii', data, 18)
        return abs(width), abs(height)
    if data.startswith((TIFF_LITTLE, TIFF_BIG)):
        return _tiff(data)
    if data.startswith(RIFF) and data[8:12] == b'WEBP':
        return _webp(data)
    return _pnm(data) if data[:1] == b'P' and data[1:2] in b'123456' else None


def _pair(form: str, data: bytes, offset: int) -> tuple[int, int]:
    first, second = struct.unpack_from(form, data, offset)
    return first, second


def _jpeg(data: bytes) -> Size | None:
    """Like decoders, it looks for the next marker and skips whatever stands before it."""
    at = 2
    while (at := data.find(b'\xff', at)) >= 0:
        while data[at] == 0xFF:  # any number of fill bytes
            at += 1
        marker, at = data[at], at + 1
        if marker in FRAME_HEADERS:
            height, width = _pair('>HH', data, at + 3)
            return width, height
        if marker in END_OF_HEADER:
            return None
        if marker not in WITHOUT_LENGTH:
            (length,) = struct.unpack_from('>H', data, at)
            at += max(length, 2)
    return None


def _exr(data: bytes) -> Size | None:
    """Returns the size of the largest part: each part has a header of attributes (name, type, length, value)."""
    is_multipart = bool(data[5] & 0x10)
    sizes, at = [], 8
    while data[at]:
        while data[at]:
            name, at = _c_string(data, at)
            kind, at = _c_string(data, at)
            (length,) = struct.unpack_from('<i', data, at)
            at += 4
            if name == b'dataWindow' and kind == b'box2i':
                left, top, right, bottom = struct.unpack_from('<iiii', data, at)
                sizes.append((right - left + 1, bottom - top + 1))
            if length < 0:
                return None
            at += length
        at += 1
        if not is_multipart:
            break
    return max(sizes, key=lambda size: abs(size[0] * size[1]), default=None)


def _c_string(data: bytes, at: int) -> tuple[bytes, int]:
    end = data.index(b'\0', at)
    return data[at:end], end + 1


def _tiff(data: bytes) -> Size | None:
    order = '<' if data.startswith(TIFF_LITTLE) else '>'
    (at,) = struct.unpack_from(order + 'I', data, 4)
    (count,) = struct.unpack_from(order + 'H', data, at)
    found = {}
    for entry in range(at + 2, at + 2 + 12 * count, 12):
        tag, kind = _pair(order + 'HH', data, entry)
        if tag in (256, 257):
            (found[tag],) = struct.unpack_from(order + ('H' if kind == 3 else 'I'), data, entry + 8)
    return (found[256], found[257]) if len(found) == 2 else None


def _webp(data: bytes) -> Size | None:
    kind = data[12:16]
    if kind == b'VP8X':
        return int.from_bytes(data[24:27], 'little') + 1, int.from_bytes(data[27:30], 'little') + 1
    if kind == b'VP8L':
        (bits,) = struct.unpack_from('<I', data, 21)
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    width, height = _pair('<HH', data, 26)
    return (width & 0x3FFF, height & 0x3FFF) if kind == b'VP8 ' else None


def _pnm(data: bytes) -> Size | None:
    """Returns the first two numbers after the magic; comments begin with ``#``."""
    lines = [line.partition(b'#')[0] for line in data[:4096].split(b'\n')]
    words = b' '.join(lines).split()[1:3]
    return (int(words[0]), int(words[1])) if len(words) == 2 else None
