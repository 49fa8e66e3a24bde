"""Kinds of damage to files. Each takes the bytes of a file and a random generator, and returns other bytes."""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Callable

import numpy as np

Damage = Callable[[bytes, np.random.Generator], bytes]

NUMBER = re.compile(rb'(?<![\w.])-?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?(?![\w.])')
ODD_NUMBERS = (
    b'nan', b'.nan', b'NaN', b'inf', b'-.inf', b'Infinity', b'1e300', b'-1e300', b'1e-300', b'1e999', b'0', b'-1', b'0.5', b'1e9',
    b'9' * 30, b'9' * 400, b'9' * 5000, b'1e999999999', b'2001-99-99', b'190:20:30', b'true', b'null', b'None', b'[]', b'{}',
    b'"x"', b'',
    b'!!int ""', b'!!timestamp x', b'!!bool x', b'!!float ""', b'0x' + b'f' * 5000,
)  # fmt: skip


def half(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: len(data) // 2]


def cut(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: rng.integers(0, len(data) + 1)]


def flipped(data: bytes, rng: np.random.Generator) -> bytes:
    """A few bits are other bits."""
    changed = bytearray(data)
    for at in rng.integers(0, max(len(data), 1), 4) if data else ():
        changed[at] ^= 1 << int(rng.integers(0, 8))
    return bytes(changed)


def overwritten(data: bytes, rng: np.random.Generator) -> bytes:
    """Random bytes in a random place, more often near the beginning."""
    at = int(len(data) * rng.random() ** 3)
    return data[:at] + rng.bytes(int(rng.integers(1, 40))) + data[at + 20 :]


def inserted(what: bytes) -> Damage:
    def damage(data: bytes, rng: np.random.Generator) -> bytes:
        at = int(rng.integers(0, len(data) + 1))
        return data[:at] + what + data[at:]

    return damage


def instead(what: bytes) -> Damage:
    return lambda data, rng: what


def odd_number(data: bytes, rng: np.random.Generator) -> bytes:
    """One number of a text is another number, or none."""
    places = [match.span() for match in NUMBER.finditer(data)]
    if not places:
        return data
    start, end = places[int(rng.integers(0, len(places)))]
    return data[:start] + ODD_NUMBERS[int(rng.integers(0, len(ODD_NUMBERS)))] + data[end:]


def odd_line(data: bytes, rng: np.random.Generator) -> bytes:
    """A line is missing, there twice, or swapped with another."""
    lines = data.split(b'\n')
    i, j = rng.integers(0, len(lines), 2)
    kind = rng.integers(0, 3)
    if kind == 0:
        del lines[i]
    elif kind == 1:
        lines.insert(j, lines[i])
    else:
        lines[i], lines[j] = lines[j], lines[i]
    return b'\n'.join(lines)


def another_word(data: bytes, rng: np.random.Generator) -> bytes:
    """A word of a text is another, as of a key that is misspelt."""
    places = [match.span() for match in re.finditer(rb'[A-Za-z_]{2,}', data)]
    if not places:
        return data
    start, end = places[int(rng.integers(0, len(places)))]
    return data[:start] + [b'x', b'\\u0000', b'\\ud800', b'a' * 300, b'../..', b'/'][int(rng.integers(0, 6))] + data[end:]


def png(width: int, height: int) -> bytes:
    """A PNG of a kilobyte that claims any size."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack('>I', len(content)) + kind + content + struct.pack('>I', zlib.crc32(kind + content))

    header = struct.pack('>IIBBBBB', width, height, 16, 0, 0, 0, 0)
    return b'\x89PNG\r\n\x1a\n' + chunk(b'IHDR', header) + chunk(b'IDAT', zlib.compress(bytes(1000))) + chunk(b'IEND', b'')


def jpeg(width: int, height: int) -> bytes:
    frame = struct.pack('>BHHBBBB', 8, height, width, 1, 1, 0x11, 0)
    return b'\xff\xd8\xff\xc0' + struct.pack('>H', len(frame) + 2) + frame + b'\xff\xda' + bytes(1000) + b'\xff\xd9'


ANY_FILE: dict[str, Damage] = {
    'half': half,
    'cut': cut,
    'flipped': flipped,
    'overwritten': overwritten,
    'empty': instead(b''),
    'one byte': instead(b'\x80'),
    'a pointer': instead(b'version https://git-lfs.github.com/spec/v1\n'),
    'zeros': instead(bytes(500)),
}
TEXT: dict[str, Damage] = {
    **{f'odd number {index}': odd_number for index in range(6)},
    **{f'odd line {index}': odd_line for index in range(2)},
    **{f'another word {index}': another_word for index in range(3)},
    'NUL': inserted(b'\0'),
    'Latin-1': inserted(b'\xe4'),
    'a mark': lambda data, rng: b'\xef\xbb\xbf' + data,
    'UTF-16 begun': lambda data, rng: b'\xff\xfe' + data,
    'nested': instead(b'[' * 100_000),
    'nested mappings': instead(b'{"a":' * 5_000),
    'nested where a value was': inserted(b'[' * 2000 + b']' * 2000),
    'a list': instead(b'[1, 2, 3]'),
    'a number': instead(b'7'),
    'aliases': instead(b'a: &a [x, x]\nb: &b [*a, *a]\nwidth: *b\n'),
    'one long line': inserted(b'x' * 200_000),
    'a long number': instead(b'1' * 100_000),
}
IMAGE: dict[str, Damage] = {
    'claims 60000x60000': instead(png(60_000, 60_000)),
    'claims 4 billion': instead(png(2**31 - 1, 2)),
    'claims no size': instead(png(0, 0)),
    'is 1x1': instead(png(1, 1)),
    'JPEG claims 65500x65500': instead(jpeg(65_500, 65_500)),
    'PNM claims 10^9': instead(b'P5 1000000000 1000000000 255\n' + bytes(100)),
}
"""Damages by name."""

TEXT_SUFFIXES = ('.txt', '.json', '.yaml', '.log', '.freiburg')
IMAGE_SUFFIXES = ('.png', '.jpg', '.JPG', '.exr')


def damages_of(suffix: str) -> dict[str, Damage]:
    """Returns the damages for files with a suffix."""
    more = TEXT if suffix in TEXT_SUFFIXES else IMAGE if suffix in IMAGE_SUFFIXES else {}
    return {**ANY_FILE, **more}
