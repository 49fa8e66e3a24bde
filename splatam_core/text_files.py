"""Reads the files that people bring as bytes, text, YAML or JSON. Whatever is wrong with a file is one error, in one line.

A file is read only if it is a regular file of at most a stated size, so that a pipe does not block and a large file does not
fill the memory. Text is UTF-8, with or without a byte order mark, or UTF-16 with one.
"""

from __future__ import annotations

import codecs
import json
import os
import stat
from pathlib import Path
from typing import Any

import yaml

from splatam_core.errors import SplatamError, one_line

MAX_TEXT_BYTES = 256 * 2**20
"""A trajectory of two million poses; the JSON file of a long recording."""

MAX_YAML_BYTES = 64 * 2**10
"""Settings and cameras take a few kilobytes, and the YAML library is slow."""

MAX_YAML_DEPTH = 50
LEAST_READ = 2**20
"""Bytes; files of the kernel state no size."""

WAYS_TO_FAIL = (ValueError, TypeError, AttributeError, LookupError, ArithmeticError, RecursionError, yaml.YAMLError)
"""What the YAML library raises for invalid dates, numbers without digits, unknown truth values, and so on."""


def read_bytes(path: Path, error: type[SplatamError], at_most: int, beginning: int | None = None) -> bytes:
    """Read a regular file.

    Args:
        path: the file.
        error: the class of error to raise.
        at_most: the largest size, bytes.
        beginning: how many bytes to read; None = all.

    Raises:
        SplatamError: there is no such file, it is no regular file, or it is larger.
    """
    try:
        with open(path, 'rb', opener=_open_without_waiting) as file:
            status = os.fstat(file.fileno())
            if not stat.S_ISREG(status.st_mode):
                raise error(f'{path}: cannot be read: it is no regular file')
            if status.st_size > at_most:
                raise error(f'{path}: cannot be read: it has {status.st_size} bytes, and at most {at_most} are read')
            wanted = at_most if beginning is None else beginning
            return file.read(min(wanted, max(status.st_size, LEAST_READ)))  # which allocates as much
    except OSError as fault:
        raise error(f'{path}: cannot be read: {fault.strerror}') from None
    except ValueError:  # a NUL or half of a surrogate pair in the name
        raise error(f'{str(path)!r}: cannot be read: this is no possible file name') from None


def _open_without_waiting(path: str, flags: int) -> int:
    """Open a file without waiting for the other end of a pipe."""
    return os.open(path, flags | os.O_NONBLOCK)


def read_text(path: Path, error: type[SplatamError], at_most: int = MAX_TEXT_BYTES) -> str:
    """Read a text file; see ``read_bytes``.

    Raises:
        SplatamError: the file cannot be read, or is no text.
    """
    data = read_bytes(path, error, at_most)
    is_wide = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    try:
        text = data.decode('utf-16' if is_wide else 'utf-8-sig')
    except UnicodeDecodeError as fault:
        raise error(f'{path}: cannot be read: it is no UTF-8 text ({fault.reason} at byte {fault.start})') from None
    if '\0' in text:
        raise error(f'{path}: cannot be read: it holds a NUL character at {text.index(chr(0))}; is it a text file?')
    return text


def read_yaml(path: Path, error: type[SplatamError]) -> Any:
    """Read a YAML file; see ``parse_yaml``.

    Raises:
        SplatamError: the file cannot be read, or is no YAML.
    """
    text = read_text(path, error, MAX_YAML_BYTES)
    try:
        return parse_yaml(text)
    except ValueError as fault:
        raise error(f'{path}: cannot be read: {fault}') from None


def parse_yaml(text: str) -> Any:
    """Parse YAML with plain values only. Anchors and aliases are refused: with them a few lines expand to gigabytes.

    Raises:
        ValueError: the text is no such YAML; the message is one line.
    """
    try:
        return yaml.load(text, Loader=_PlainLoader)
    except WAYS_TO_FAIL as fault:
        raise ValueError(one_line(fault) or type(fault).__name__) from None


class _PlainLoader(yaml.SafeLoader):
    """Reads neither aliases, nor deeply nested values, nor a key that is there twice."""

    _depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        """See ``yaml.composer.Composer``."""
        event = self.peek_event()
        if isinstance(event, yaml.AliasEvent) or getattr(event, 'anchor', None) is not None:
            where = f'line {event.start_mark.line + 1}'
            raise yaml.YAMLError(f'anchors and aliases (& and *) are not read, {where}; write the value out')
        if self._depth == MAX_YAML_DEPTH:
            raise yaml.YAMLError(f'it is nested more than {MAX_YAML_DEPTH} levels deep')
        self._depth += 1
        try:
            return super().compose_node(parent, index)
        finally:
            self._depth -= 1

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        """See ``yaml.constructor.BaseConstructor``."""
        values = super().construct_mapping(node, deep)
        names = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise yaml.YAMLError(f"the key '{twice[0]}' is there twice, line {node.start_mark.line + 1} and below; keep one")
        return values

    def construct_yaml_int(self, node: Any) -> int:
        """See ``yaml.constructor.SafeConstructor``."""
        value = super().construct_yaml_int(node)
        if value.bit_length() > 64:
            raise yaml.YAMLError(f'a whole number has {value.bit_length()} bits, and at most 64 are read')
        return value


_PlainLoader.add_constructor('tag:yaml.org,2002:int', _PlainLoader.construct_yaml_int)


def read_json(path: Path, error: type[SplatamError]) -> Any:
    """Read a JSON file.

    Raises:
        SplatamError: the file cannot be read, or is no JSON.
    """
    text = read_text(path, error)
    try:
        return parse_json(text)
    except ValueError as fault:
        raise error(f'{path}: cannot be read as JSON: {fault}') from None


def parse_json(text: str) -> Any:
    """Parse JSON.

    Raises:
        ValueError: the text is no JSON, or is nested too deep.
    """
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError('it is nested too deep') from None
