"""Ground-truth poses instead of tracking, tracking at a lower resolution, and more steps while the depth error is large."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from splatam_core.cli import main
from splatam_core.config import PaperTrackingConfig, TrackingConfig, load_config
from splatam_core.datasets.known_poses import FramesWithGroundTruth
from splatam_core.datasets.registry import open_sequence
from splatam_core.errors import ConfigError, FrameError
from splatam_core.geometry import se3
from splatam_core.geometry.trajectory import Trajectory
from splatam_core.images.view import View
from splatam_core.rasterizer import Gaussians, Rasterizer, Render, make_rasterizer
from splatam_core.runs.record import read_run
from splatam_core.slam import Slam
from splatam_core.tracking import make_tracker
from splatam_core.types import RgbdFrame, Status

WIDTH = 64
QUICK = ['threads=1', 'mapping.iterations=3', 'mapping.every=1']


class Recording:
    """The room's frames with another ground truth."""

    def __init__(self, truth: Trajectory | None) -> None:
        self._room = open_sequence('synthetic', width=WIDTH, max_frames=4)
        self.name, self.camera, self.depth_scale = 'recording', self._room.camera, None
        self._truth = truth

    def __len__(self) -> int:
        return len(self._room)

    def __getitem__(self, index: int) -> RgbdFrame:
        return self._room[index]

    def ground_truth(self) -> Trajectory | None:
        return self._truth


def test_true_poses_are_taken_as_they_are(tmp_path: Path) -> None:
    """Also for a fast walk, since no tracker has to follow it."""
    source = 'synthetic:motion=fast'
    settings = [word for setting in ['tracking.method=truth', *QUICK] for word in ('--set', setting)]
    arguments = ['run', source, '--width', str(WIDTH), '--max-frames', '4', '--preset', 'quick', '--no-evaluate', *settings]
    assert main([*arguments, '--out', str(tmp_path / 'run')]) == 0
    run = read_run(tmp_path / 'run')
    truth = open_sequence(source, width=WIDTH, max_frames=4).ground_truth().T_world_cam
    assert not run.lost_ns
    np.testing.assert_allclose(run.trajectory.T_world_cam, se3.inverse(truth[0]) @ truth[:4], atol=1e-7)  # 9 decimals


def test_frames_between_true_poses_get_the_pose_between(room) -> None:
    """Half way in time is half way along the motion; beyond the end of the ground truth there is no pose."""
    sequence = room(frames=3, width=WIDTH)
    stamps = sequence.ground_truth().stamps_ns
    ends = np.stack([np.eye(4), se3.exp(np.array([0.2, 0, 0, 0, 0.4, 0]))])
    frames = FramesWithGroundTruth(Recording(Trajectory(stamps[[0, 2]], ends)))
    half = frames.motion(int(stamps[0]), int(stamps[1]))
    np.testing.assert_allclose(half, se3.exp(np.array([0.1, 0, 0, 0, 0.2, 0])), atol=1e-6)  # stamps are whole ns
    assert frames[2].stamp_ns == stamps[2]
    with pytest.raises(FrameError, match='no true pose at 1.100000000 s'):
        frames[3]


def test_without_truth_there_are_no_true_poses() -> None:
    with pytest.raises(ConfigError, match='recording has no ground truth; choose render_and_compare'):
        FramesWithGroundTruth(Recording(None))
    with pytest.raises(ConfigError, match='there is no ground truth here'):
        Slam(load_config('quick', ['tracking.method=truth']))
    slam = Slam(load_config('quick'))
    with pytest.raises(ConfigError, match='there is no ground truth here'):
        slam.configure(load_config('quick', ['tracking.method=truth']))


@pytest.mark.parametrize('method', ['align', 'render_and_compare'])
def test_tracking_at_half_the_resolution(method: str) -> None:
    """Maps at the whole resolution, and tracks with half the pixels: within 2 cm, half a pixel there at 2.5 m."""
    sequence = open_sequence('synthetic', width=160, max_frames=3)
    truth = sequence.ground_truth().T_world_cam
    changes = [f'tracking.method={method}', 'tracking.scale=0.5', 'tracking.iterations=40', 'mapping.iterations=10']
    slam = Slam(load_config('quick', [*QUICK, *changes]))
    results = [slam.process(sequence[index]) for index in range(3)]
    assert [result.status for result in results] == [Status.INITIALIZED, Status.TRACKED, Status.TRACKED]
    assert results[0].num_gaussians > 0.9 * 160 * 120  # densified at the whole resolution
    error = se3.inverse(se3.inverse(truth[0]) @ truth[2]) @ results[2].T_world_cam
    assert np.linalg.norm(error[:3, 3]) < 0.02


class Counting:
    """A rasterizer that counts its renders."""

    def __init__(self) -> None:
        self.sizes: list[int] = []
        self._rasterizer: Rasterizer = make_rasterizer('cpu', 1)

    def render(self, gaussians: Gaussians, *view: object) -> Render:
        self.sizes.append(len(gaussians))
        return self._rasterizer.render(gaussians, *view)


@pytest.mark.parametrize(('extend_above_m', 'iterations', 'renders'), [(0.0, 5, 6), (1e-4, 5, 11), (1.0, 5, 6), (1e-4, 0, 1)])
def test_steps_are_doubled_once_where_depth_stays_off(extend_above_m: float, iterations: int, renders: int) -> None:
    """Every step renders, and so does the last pose; noise alone keeps the depth error above a tenth of a millimetre."""
    sequence = open_sequence('synthetic', width=WIDTH, max_frames=1)
    slam = Slam(load_config('quick', QUICK))
    slam.process(sequence[0])
    rasterizer = Counting()
    config = TrackingConfig(iterations=iterations, paper=PaperTrackingConfig(extend_above_m=extend_above_m))
    tracker = make_tracker(rasterizer, config)
    tracker.track(View.from_frame(sequence[0], slam.config.depth), slam.map.gaussians, np.eye(4))
    assert len(rasterizer.sizes) == renders
