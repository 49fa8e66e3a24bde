"""What tests of every part share."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from splatam_core.config import SlamConfig, apply_threads
from splatam_core.datasets.synthetic import SyntheticSequence

ROOT = Path(__file__).resolve().parents[1]


def pytest_configure(config: pytest.Config) -> None:
    """Rclpy checks the fields of messages in tests; it is too slow to do so otherwise. Threads as in our processes.

    Where there is no GPU, Triton interprets its kernels; it decides so when they are imported.
    """
    os.environ.setdefault('ROS_PYTHON_CHECK_FIELDS', '1')
    if not torch.cuda.is_available():
        os.environ.setdefault('TRITON_INTERPRET', '1')
    apply_threads(SlamConfig())


@pytest.fixture(scope='session')
def recording() -> Callable[[str], Path]:
    """``recording('tum_fr1_rpy')``: the folder of a real recording.

    Skips the test where the recordings are absent; fails it in CI, where they must be there.
    """

    def find(name: str) -> Path:
        data = Path(os.environ.get('SPLATAM_DATA') or ROOT.parent / 'shared' / 'data')
        if (data / name).is_dir():
            return data / name
        message = f'{data / name} is absent; SPLATAM_DATA names the folder of the recordings'
        if os.environ.get('CI', '').lower() in ('true', '1'):
            pytest.fail(message)
        pytest.skip(message)

    return find


@pytest.fixture(scope='session')
def room() -> Callable[..., SyntheticSequence]:
    """``room(frames=3, width=64, noise=False)``: a short synthetic recording; cheap after the first."""

    def make(frames: int = 3, width: int = 64, *, noise: bool = True, seed: int = 0) -> SyntheticSequence:
        return SyntheticSequence(seed=seed, noise=noise, frames=frames, width=width)

    return make
