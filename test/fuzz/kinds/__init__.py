"""The kinds of input that are fuzzed, for ``make test``, ``make fuzz``, ``make fuzz-long`` and ``make sanitize``."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path

TEST = Path(__file__).resolve().parents[2]
sys.path += [str(TEST / name) for name in ('adapters', 'core', 'field') if str(TEST / name) not in sys.path]

from kinds import (  # noqa: E402 - they use the tests' own material
    bags,
    checkpoints,
    configs,
    dataset_files,
    frames,
    live,
    maps,
    messages,
    native,
    parameters,
    parsers,
    run_folders,
    saved_keyframes,
)
from kinds.base import Kind  # noqa: E402

KINDS = {
    module.KIND.name: module.KIND
    for module in (
        messages, live, dataset_files, parsers, bags, run_folders, checkpoints, saved_keyframes, maps, configs, parameters, frames,
        native,
    )
}  # fmt: skip
"""Kinds by name."""


def available() -> Iterator[Kind]:
    """Yield the kinds whose requirements are installed."""
    for kind in KINDS.values():
        if not kind.needs or importlib.util.find_spec(kind.needs) is not None:
            yield kind
