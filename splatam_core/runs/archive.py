r"""Files of values and arrays that are whole or refused, and in which nothing can be executed.

One line of ASCII, ``splatam_ros KIND VERSION SHA-256 of the rest``, then an npz archive: the arrays, and the values as JSON
in the array ``values``. ``numpy.load(io.BytesIO(path.read_bytes().split(b'\n', 1)[1]))`` reads it without this package.
"""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from splatam_core.atomic_io import replaced
from splatam_core.errors import CheckpointError
from splatam_core.types import Arrays

MAGIC = 'splatam_ros'
_VALUES = 'values'
_MAX_HEADER_BYTES = 128


@dataclass(frozen=True, slots=True, eq=False)
class Content:
    """What a sealed file holds.

    Attributes:
        values: whatever JSON can say.
        arrays: by name; not of objects.
    """

    values: Mapping[str, Any]
    arrays: Arrays


@dataclass(frozen=True, slots=True, eq=False)
class SealedFile:
    """A file's bytes, not written yet.

    Attributes:
        digest: SHA-256 of the payload, hexadecimal.
        header: first line.
        payload: the archive.
    """

    digest: str
    header: bytes
    payload: memoryview

    def write(self, path: Path) -> None:
        """Write the file in one step, in place of the one that is there.

        Raises:
            OSError: it cannot be written; what was there before stays.
        """
        with replaced(path) as temporary, temporary.open('wb') as file:
            file.write(self.header)
            file.write(self.payload)


def seal(kind: str, version: int, content: Content) -> SealedFile:
    """The file of some content; of equal content the same, byte for byte."""
    buffer = io.BytesIO()
    values = np.frombuffer(json.dumps(content.values).encode(), np.uint8)
    np.savez(buffer, allow_pickle=False, **{_VALUES: values}, **content.arrays)
    payload = buffer.getbuffer()
    digest = hashlib.sha256(payload).hexdigest()
    return SealedFile(digest, f'{MAGIC} {kind} {version} {digest}\n'.encode('ascii'), payload)


def unseal(path: Path, kind: str, version: int, digest: str | None = None) -> Content:
    """Read a file back.

    Args:
        path: the file.
        kind: what it has to be.
        version: the format it has to have.
        digest: of the file that is meant; None = any.

    Raises:
        CheckpointError: it cannot be read, is another thing, of another version or another content, or damaged.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise CheckpointError(f'{path}: cannot be read: {error.strerror}') from None
    header, newline, payload = data[:_MAX_HEADER_BYTES].partition(b'\n')
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
        with np.load(io.BytesIO(payload), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        values = json.loads(arrays.pop(_VALUES).tobytes())
    except (ValueError, KeyError, EOFError, OSError, NotImplementedError, zipfile.BadZipFile) as error:
        reason = ' '.join(str(error).split())
        raise CheckpointError(f'{path}: holds something else than arrays of numbers: {reason}') from None
    return Content(values, arrays)
