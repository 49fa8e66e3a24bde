"""The vertices of a PLY file, whichever of its three encodings it has: the container that maps of Gaussians come in.

Turk, "The PLY Polygon File Format", 1994: a header in text that lists elements and their properties, then the elements in
that order, as text or as binary numbers of either byte order.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from io import TextIOWrapper
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

_SCALAR_TYPES = {
    'char': 'i1', 'int8': 'i1', 'uchar': 'u1', 'uint8': 'u1', 'short': 'i2', 'int16': 'i2', 'ushort': 'u2',
    'uint16': 'u2', 'int': 'i4', 'int32': 'i4', 'uint': 'u4', 'uint32': 'u4', 'float': 'f4', 'float32': 'f4',
    'double': 'f8', 'float64': 'f8',
}  # fmt: skip
_BYTE_ORDERS = {'ascii': '=', 'binary_little_endian': '<', 'binary_big_endian': '>'}
_MAX_HEADER_BYTES = 65536
_PACKED = 'packed_position'
"""A property of compressed maps, as PlayCanvas and SuperSplat write them."""


@dataclass(frozen=True, slots=True)
class _Element:
    """An element of the header: its name, the number of its rows, and name and kind of their properties."""

    name: str
    count: int
    properties: tuple[tuple[str, str], ...] = ()
    has_lists: bool = False

    def row(self, byte_order: str) -> np.dtype:
        """Returns the layout of a row. A duplicate name raises ValueError."""
        return np.dtype([(name, byte_order + kind) for name, kind in self.properties])


def read_vertices(file: BinaryIO, required: Sequence[Sequence[str]]) -> NDArray[np.void]:
    """Reads the vertices of a PLY file.

    Args:
        file: at its beginning.
        required: names of properties, of each group at least one.

    Returns:
        A structured array, one row per vertex, one field per property.

    Raises:
        ValueError, TypeError: it is no PLY file, is damaged or cut short, or lacks a required property.
        OSError: it cannot be read.
    """
    encoding, elements = _read_header(file)
    before, vertex = _up_to_vertex(elements)
    names = [name for name, _ in vertex.properties]
    if _PACKED in names:
        raise ValueError("this map is compressed: unpack it first, with 'npx @playcanvas/splat-transform IN.ply OUT.ply'")
    if missing := [' or '.join(names_of_one) for names_of_one in required if not set(names_of_one) & set(names)]:
        raise ValueError(f'property {", ".join(missing)} is missing: this is not a map in the 3D Gaussian splatting layout')
    row = vertex.row(_BYTE_ORDERS[encoding])
    if encoding == 'ascii':
        return _read_text(file, sum(element.count for element in before), vertex.count, row)
    skipped = 0
    for element in before:
        if element.has_lists:
            raise ValueError(f"element '{element.name}' before 'vertex' has lists, so its size is unknown: save the map without it")
        skipped += element.count * element.row('<').itemsize
    return _read_binary(file, skipped, vertex.count, row)


def _read_header(file: BinaryIO) -> tuple[str, list[_Element]]:
    """Reads up to the header's end. Returns the encoding and the elements."""
    if file.readline(_MAX_HEADER_BYTES).rstrip() != b'ply':
        raise ValueError("not a PLY file: it does not start with 'ply'")
    lines = []
    while (line := file.readline(_MAX_HEADER_BYTES)).rstrip() != b'end_header':
        if not line.endswith(b'\n') or file.tell() > _MAX_HEADER_BYTES:
            raise ValueError("the header has no 'end_header': the file is damaged or is not a PLY file")
        lines.append(line.decode('ascii', errors='replace').split())
    lines = [words for words in lines if words and words[0] not in ('comment', 'obj_info')]
    kind = ' '.join(lines[0]) if lines else ''
    encodings = {f'format {name} 1.0': name for name in _BYTE_ORDERS}
    if kind not in encodings:
        raise ValueError(f"'{kind}' is not supported: expected one of {', '.join(encodings)}")
    return encodings[kind], _elements(lines[1:])


def _elements(lines: Sequence[Sequence[str]]) -> list[_Element]:
    elements: list[_Element] = []
    for words in lines:
        if words[0] == 'element' and len(words) == 3:
            if not words[2].isdecimal():
                raise ValueError(f"'{words[2]}' is not a number of elements")
            elements.append(_Element(words[1], int(words[2])))
        elif elements and words[0] == 'property' and (elements[-1].name != 'vertex' or _is_scalar(words)):
            elements[-1] = _with_property(elements[-1], words)
        else:
            raise ValueError(f"header line '{' '.join(words)}' is not a scalar property of a vertex")
    return elements


def _with_property(element: _Element, words: Sequence[str]) -> _Element:
    if _is_scalar(words):
        return replace(element, properties=(*element.properties, (words[2], _SCALAR_TYPES[words[1]])))
    return replace(element, has_lists=True)


def _is_scalar(words: Sequence[str]) -> bool:
    return len(words) == 3 and words[1] in _SCALAR_TYPES


def _up_to_vertex(elements: Sequence[_Element]) -> tuple[Sequence[_Element], _Element]:
    """Returns the elements before the vertices, and the vertices; what follows them is not needed."""
    for index, element in enumerate(elements):
        if element.name == 'vertex':
            return elements[:index], element
    raise ValueError("the header has no element 'vertex' (one vertex per Gaussian)")


def _read_binary(file: BinaryIO, skipped: int, count: int, row: np.dtype) -> NDArray[np.void]:
    available = os.fstat(file.fileno()).st_size - file.tell() - skipped
    needed = count * row.itemsize
    if available < needed:
        raise ValueError(
            f'{count} Gaussians need {needed} bytes but only {max(available, 0)} follow the header: the file is cut short'
        )
    file.seek(skipped, os.SEEK_CUR)
    return np.fromfile(file, dtype=row, count=count)


def _read_text(file: BinaryIO, skipped: int, count: int, row: np.dtype) -> NDArray[np.void]:
    """Reads vertices written as text, one line each."""
    rows = np.zeros(0, dtype=row)
    if count == 0:
        return rows
    text = TextIOWrapper(file, encoding='ascii', errors='replace')
    with warnings.catch_warnings():
        warnings.simplefilter('ignore', UserWarning)  # numpy's, where nothing follows
        table = np.loadtxt(text, dtype=np.float64, comments=None, skiprows=skipped, max_rows=min(count, 1 << 40), ndmin=2)
    text.detach()
    if len(table) < count:
        raise ValueError(f'{count} Gaussians are announced but only {len(table)} follow the header: the file is cut short')
    if table.shape[1] != len(row.names or ()):
        raise ValueError(f'the lines hold {table.shape[1]} numbers, but the header names {len(row.names or ())} properties')
    rows = np.zeros(count, dtype=row)
    with np.errstate(all='ignore'):  # what does not fit its type becomes infinite, and is refused later
        for index, name in enumerate(row.names or ()):
            rows[name] = table[:, index]
    return rows
