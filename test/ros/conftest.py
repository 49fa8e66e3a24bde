"""A graph for each test, and one small recording for all."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from graph import Graph

from splatam_core.datasets.convert import write_bag
from splatam_core.datasets.synthetic import SyntheticSequence

FRAMES = 12


@pytest.fixture
def graph(tmp_path: Path) -> Iterator[Graph]:
    before = dict(os.environ)
    graph = Graph(tmp_path)
    try:
        yield graph
    finally:
        graph.close()
        os.environ.clear()
        os.environ.update(before)


@pytest.fixture(scope='session')
def bag(tmp_path_factory: pytest.TempPathFactory, room: Callable[..., SyntheticSequence]) -> Path:
    """Twelve frames of 64x48: colour, depth and info at the same stamps, and true poses."""
    path = tmp_path_factory.mktemp('recording') / 'room'
    write_bag(room(frames=FRAMES, noise=False), path)
    return path
