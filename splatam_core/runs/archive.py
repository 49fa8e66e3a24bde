r"""Archives: files of JSON values and arrays. A damaged or foreign file is refused, and nothing in a file is executed.

One line of ASCII, ``splatam_ros KIND VERSION SHA-256 of the rest``, then an npz file: the arrays, and the values as JSON in
the array ``values``. ``numpy.load(io.BytesIO(path.read_bytes().split(b'\n', 1)[1]))`` reads it without this package.
docs/decisions/0007-archive-format.md compares it with safetensors.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from splatam_core.atomic_io import open_regular, replaced
from splatam_core.errors import CheckpointError, one_line
from splatam_core.types import Arrays

MAGIC = 'splatam_ros'
_VALUES = 'values'
_MAX_HEADER_BYTES = 128


@dataclass(frozen=True, slots=True, eq=False)
class Content:
    """What an archive holds.

    Attributes:
        values: anything that JSON can express.
        arrays: by name; no arrays of objects.
    """

    values: Mapping[str, Any]
    arrays: Arrays


@dataclass(frozen=True, slots=True, eq=False)
class ArchiveFile:
    """The bytes of an archive that is not written yet.

    Attributes:
        digest: SHA-256 of the payload, hexadecimal.
        header: the first line.
        payload: the npz file.
    """

    digest: str
    header: bytes
    payload: memoryview

    def write(self, path: Path) -> None:
        """Writes the file in one step; it replaces the file at the path.

        Raises:
            OSError: the file cannot be written; what was at the path stays.
        """
        with replaced(path) as temporary, temporary.open('wb') as file:
            file.write(self.header)
            file.write(self.payload)


def pack(kind: str, version: int, content: Content) -> ArchiveFile:
    """Returns the archive of some content. Equal content gives equal bytes.

    Args:
        kind: one word that says what the content is.
        version: of the content's form.
        content: to be written.
    """
    buffer = io.BytesIO()
    values = np.frombuffer(json.dumps(content.values).encode(), np.uint8)
    arrays: dict[str, Any] = {_VALUES: values, **content.arrays}
    np.savez(buffer, allow_pickle=False, **arrays)
    payload = buffer.getbuffer()
    digest = hashlib.sha256(payload).hexdigest()
    return ArchiveFile(digest, f'{MAGIC} {kind} {version} {digest}\n'.encode('ascii'), payload)


def read_archive(path: Path, kind: str, version: int, digest: str | None = None) -> Content:
    """Reads an archive.

    Args:
        path: the file.
        kind: the kind it must have.
        version: the version it must have.
        digest: the SHA-256 that it must have, hexadecimal; None = any.

    Raises:
        CheckpointError: the file cannot be read, is damaged, or has another kind, version or digest.
    """
    try:
        with open_regular(path) as file:
            data = file.read()
    except OSError as error:
        raise CheckpointError(f'{path}: cannot be read: {error.strerror}') from None
    except MemoryError:
        raise CheckpointError(f'{path}: cannot be read: it does not fit into memory') from None
    header, newline, _ = data[:_MAX_HEADER_BYTES].partition(b'\n')
    stated = _stated_digest(path, header if newline else data[:_MAX_HEADER_BYTES], kind, version)
    payload = memoryview(data)[len(header) + 1 :]
    found = hashlib.sha256(payload).hexdigest()
    if found != stated:
        raise CheckpointError(f'{path}: is damaged: its {len(payload)} bytes have checksum {found[:16]}, not {stated[:16]}')
    if digest not in (None, found):
        raise CheckpointError(f'{path}: is not the file that belongs here: its checksum is {found[:16]}, not {digest[:16]}')
    return _unpack(path, payload)


def _stated_digest(path: Path, header: bytes, kind: str, version: int) -> str:
    words = header.decode('ascii', 'replace').split(' ')
    if words[:2] != [MAGIC, kind] or len(words) != 4:
        raise CheckpointError(f'{path}: is no {kind} of {MAGIC}, or damaged: it begins with {header[:32]!r}')
    if words[2] != str(version):
        raise CheckpointError(
            f'{path}: is of format {words[2]!r} and this version reads format {version}: use the version that wrote it'
        )
    return words[3]


def _unpack(path: Path, payload: memoryview) -> Content:
    try:
        with zipfile.ZipFile(io.BytesIO(payload)) as archive:
            _check_sizes(archive, len(payload))
            arrays = {entry.filename.removesuffix('.npy'): _array(archive.read(entry)) for entry in archive.infolist()}
        values = json.loads(arrays.pop(_VALUES).tobytes())
        if not isinstance(values, dict):
            raise ValueError(f'its values are of type {type(values).__name__}')
    except Exception as error:  # noqa: BLE001 - zip, npy and JSON raise a dozen kinds of errors over what a file may hold
        raise CheckpointError(f'{path}: holds something else than arrays of numbers: {one_line(error)}') from None
    return Content(values, arrays)


def _check_sizes(archive: zipfile.ZipFile, available: int) -> None:
    """Checks, before anything is unpacked, that the content is not larger than the file: ``pack`` does not compress."""
    entries = archive.infolist()
    if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
        raise ValueError('it is compressed')
    if (stated := sum(entry.file_size for entry in entries)) > available:
        raise ValueError(f'its {len(entries)} arrays claim {stated} bytes of {available}')


def _array(data: bytes) -> NDArray[Any]:
    """Returns the array in the bytes of an npy file, which must be as long as its header says."""
    file = io.BytesIO(data)
    read_header = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}[npy.read_magic(file)]
    shape, is_fortran, dtype = read_header(file)
    if dtype.hasobject:
        raise ValueError('objects')
    if any(size < 0 for size in shape) or math.prod(shape) * dtype.itemsize != len(data) - file.tell():
        raise ValueError(f'{shape} {dtype} do not take {len(data) - file.tell()} bytes')
    flat = np.frombuffer(data, dtype, offset=file.tell()) if math.prod(shape) else np.empty(0, dtype)
    return flat.reshape(shape, order='F' if is_fortran else 'C').copy(order='K')
