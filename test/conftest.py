"""Fixtures and hooks for all tests."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch
from other_native import use_other_native_build

from splatam_core.config import SlamConfig, apply_threads
from splatam_core.datasets.synthetic import SyntheticSequence
from splatam_core.maps.viewer.browser import find_browser

ROOT = Path(__file__).resolve().parents[1]


def pytest_configure(config: pytest.Config) -> None:
    """Make rclpy check the fields of messages, which is too slow outside tests, and limit threads as the processes do.

    Without a GPU, Triton interprets its kernels. It reads the variable when the kernels are imported.
    """
    use_other_native_build()
    os.environ.setdefault('ROS_PYTHON_CHECK_FIELDS', '1')
    if not torch.cuda.is_available():
        os.environ.setdefault('TRITON_INTERPRET', '1')
    apply_threads(SlamConfig())


@pytest.hookimpl(tryfirst=True)  # before -m selects
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests that start ROS processes and those that read a real recording."""
    for item in items:
        fixtures = getattr(item, 'fixturenames', ())
        if 'graph' in fixtures or item.path.name == 'test_demo.py':
            item.add_marker('ros')
        if 'recording' in fixtures:
            item.add_marker('recording')


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Run a test marked ``alone`` while no other worker of pytest-xdist runs a test."""
    with machine(exclusive=item.get_closest_marker('alone') is not None):
        yield


@contextmanager
def machine(exclusive: bool) -> Iterator[None]:
    """Hold a lock that test processes share, or that one of them has for itself.

    The first file is a gate: while a test waits for the exclusive lock, no new test can take the shared one.
    """
    with Path(__file__).open('rb') as gate, (ROOT / 'setup.py').open('rb') as lock:
        fcntl.flock(gate, fcntl.LOCK_EX)
        fcntl.flock(lock, fcntl.LOCK_EX if exclusive else fcntl.LOCK_SH)
        fcntl.flock(gate, fcntl.LOCK_UN)
        yield


@pytest.fixture(scope='session')
def recording() -> Callable[[str], Path]:
    """``recording('tum_fr1_rpy')`` returns the folder of a real recording.

    If it is absent, the test is skipped; in CI it fails.
    """

    def find(name: str) -> Path:
        data = Path(os.environ.get('SPLATAM_DATA') or ROOT.parent / 'shared' / 'data')
        if (data / name).is_dir():
            return data / name
        message = f'{data / name} is absent; set SPLATAM_DATA to the folder of the recordings'
        if os.environ.get('CI', '').lower() in ('true', '1'):
            pytest.fail(message)
        pytest.skip(message)

    return find


@pytest.fixture(scope='session')
def browser() -> str:
    """Path of Chromium. Without it, or without Playwright, the test is skipped; with SPLATAM_REQUIRE_BROWSER=1 it fails."""
    program = find_browser()
    if program is not None and find_spec('playwright') is not None:
        return program
    message = 'no Chromium: apt install chromium' if program is None else 'no Playwright: pip install playwright'
    if os.environ.get('SPLATAM_REQUIRE_BROWSER') == '1':
        pytest.fail(message)
    pytest.skip(message)


@pytest.fixture(scope='session')
def room() -> Callable[..., SyntheticSequence]:
    """``room(frames=3, width=64, noise=False)`` returns a short synthetic recording. Only the first call is slow."""

    def make(frames: int = 3, width: int = 64, *, noise: bool = True, seed: int = 0) -> SyntheticSequence:
        return SyntheticSequence(seed=seed, noise=noise, frames=frames, width=width)

    return make


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports are files without content, because drawing one takes seconds; other tests draw and read them."""
    for name in ('picture.write_report', 'html.write_html'):
        monkeypatch.setattr(f'splatam_core.evaluation.report.{name}', lambda evaluation, path: path.write_text('not drawn'))
