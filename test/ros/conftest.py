"""A graph for each test, and one small recording for all."""

from __future__ import annotations

import ctypes
import fcntl
import importlib
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest
from graph import FRAMES, ROOT, Graph

from splatam_core.datasets.convert import write_bag
from splatam_core.datasets.synthetic import SyntheticSequence

TF2_PREFIX = ROOT / 'build' / 'tf2_msgs' / sys.implementation.cache_tag


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
def tf2_prefix() -> Path | None:
    """Where tf2_msgs was built for tests; None where it is installed. ``make test`` installs it, into .venv."""
    if find_spec('tf2_msgs') is not None:
        return None
    tool = ROOT / 'tools' / 'tf2_msgs.py'
    with tool.open('rb') as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # another test process may be building it
        if not (TF2_PREFIX / 'share' / 'tf2_msgs').is_dir():
            built = subprocess.run([sys.executable, tool, TF2_PREFIX], check=False)
            assert built.returncode == 0, 'tf2_msgs cannot be built; apt install ros-jazzy-tf2-msgs, or see above'
    return TF2_PREFIX


@pytest.fixture
def tf_message(tf2_prefix: Path | None, graph: Graph) -> type:
    """``tf2_msgs/msg/TFMessage``, in this process and in those of the graph."""
    if tf2_prefix is not None:
        site_packages = next(tf2_prefix.glob('lib/python3*/site-packages'))
        if str(site_packages) not in sys.path:
            sys.path.append(str(site_packages))
            for library in sorted((tf2_prefix / 'lib').glob('libtf2_msgs__*.so'), key=is_typesupport):
                ctypes.CDLL(str(library), mode=ctypes.RTLD_GLOBAL)  # LD_LIBRARY_PATH was read when Python started
        prepend_path('LD_LIBRARY_PATH', tf2_prefix / 'lib')
        prepend_path('PYTHONPATH', site_packages)
    return importlib.import_module('tf2_msgs.msg').TFMessage


def is_typesupport(library: Path) -> bool:
    """The generated messages come first: type supports need them."""
    return 'typesupport' in library.name


def prepend_path(variable: str, path: Path) -> None:
    os.environ[variable] = os.pathsep.join(filter(None, [str(path), os.environ.get(variable)]))


@pytest.fixture(scope='session')
def bag(tmp_path_factory: pytest.TempPathFactory, room: Callable[..., SyntheticSequence]) -> Path:
    """Twelve frames of 64x48: colour, depth and info at the same stamps, and true poses."""
    path = tmp_path_factory.mktemp('recording') / 'room'
    write_bag(room(frames=FRAMES, noise=False), path)
    return path


@pytest.fixture(scope='session')
def frames(room: Callable[..., SyntheticSequence]) -> SyntheticSequence:
    """The frames of ``bag``."""
    return room(frames=12, noise=False)
