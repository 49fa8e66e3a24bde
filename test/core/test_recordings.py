"""The first seconds of the real recordings, offline, at a size that takes a few seconds."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from splatam_core.config import load_config
from splatam_core.datasets.registry import open_sequence
from splatam_core.evaluation.trajectory import trajectory_error
from splatam_core.geometry.trajectory import Trajectory
from splatam_core.slam import Slam
from splatam_core.types import Status


@pytest.mark.parametrize(
    ('preset', 'width', 'name', 'rmse_m'),
    [
        # At 160 pixels width one pixel is 1.5 cm at 2 m; the truth itself is good to 0.5 cm.
        ('quick', 160, '7scenes_redkitchen', 0.01),
        # Turning up to 60 degrees a second with motion blur: half as much again.
        ('quick', 160, 'tum_fr1_rpy', 0.025),
        ('realtime', 320, '7scenes_redkitchen', 0.01),
        ('realtime', 320, 'tum_fr1_rpy', 0.025),
        ('realtime', 640, 'tum_fr1_rpy', 0.025),  # renders for tracking at half size
    ],
)
def test_tracks_the_first_frames(preset: str, width: int, name: str, rmse_m: float, recording: Callable[[str], Path]) -> None:
    """Every frame."""
    sequence = open_sequence(str(recording(name)), width=width, max_frames=40)
    slam = Slam(load_config(preset, ['threads=1']))
    results = [slam.process(sequence[i]) for i in range(len(sequence))]
    assert [result.status for result in results[1:]] == [Status.TRACKED] * 39
    stamps = np.array([result.stamp_ns for result in results], dtype=np.int64)
    estimate = Trajectory(stamps, np.stack([result.T_world_cam for result in results]))
    assert trajectory_error(estimate, sequence.ground_truth()).rmse_m < rmse_m
