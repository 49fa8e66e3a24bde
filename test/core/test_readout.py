"""A rolling shutter: how long an image takes to read is found, and poses are better for it; a global shutter stays one."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from splatam_core.config import load_config
from splatam_core.geometry import motions, se3
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.runs.checkpoints import Checkpoints, Progress, read_checkpoint
from splatam_core.slam import Slam
from splatam_core.tracking.readout import Readout, ReadoutSeen
from splatam_core.types import RgbdFrame, Status

CAMERA = PinholeCamera(160, 120, 131.0, 131.0, 79.5, 59.5)
FRAME_NS, REST, FRAMES, READOUT = 33_333_333, 4, 34, 0.8
TEXEL_M = 0.01


class Corner:
    """Two walls and a floor that meet in front of a camera, which rests and then shakes its head by up to 2.5 degrees a frame."""

    def __init__(self) -> None:
        rng = np.random.default_rng(0)
        self._texture = np.clip(0.5 + 4 * (cv2.GaussianBlur(rng.random((1024, 1024, 3)).astype(np.float32), (0, 0), 3) - 0.5), 0, 1)
        self._planes = np.array([[0.6, 0.0, 0.8, 2.0], [-0.7, 0.0, 0.714, 2.2], [0.0, 1.0, 0.0, 1.0]])  # normal, distance

    def poses(self, times: np.ndarray) -> np.ndarray:
        """Returns the poses [..., 4, 4] at times in frames."""
        phase = np.maximum(times - REST, 0.0) * (2 * np.pi / 24)
        twists = np.zeros((*times.shape, 6))
        twists[..., 0], twists[..., 3], twists[..., 4] = 0.02 * np.sin(phase), 0.1 * (1 - np.cos(phase)) / 2, 0.16 * np.sin(phase)
        return motions.exp(twists)

    def frame(self, index: int, readout: float) -> RgbdFrame:
        """Returns a frame of which the rows are read one after the other."""
        rows = np.arange(CAMERA.height)
        T = self.poses(index + readout * (rows / (CAMERA.height - 1) - 0.5))  # [H, 4, 4]
        v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
        rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones_like(u, float)], axis=-1)
        rays, origin = np.einsum('hij,hwj->hwi', T[:, :3, :3], rays), T[:, None, :3, 3]
        along = rays @ self._planes[:, :3].T
        depth = np.where(along > 1e-6, (self._planes[:, 3] - origin @ self._planes[:, :3].T) / np.maximum(along, 1e-6), np.inf)
        plane, depth = depth.argmin(axis=-1), depth.min(axis=-1)
        points = origin + depth[..., None] * rays
        across = points[..., 0] + points[..., 2] + 1.3 * plane
        down = np.where(plane == 2, points[..., 2], points[..., 1])
        x, y = ((512 + value / TEXEL_M).astype(np.float32) for value in (across, down))
        rgb = cv2.remap(self._texture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        noise = np.random.default_rng(index).normal(0, 0.003, depth.shape)
        return RgbdFrame((index + 30) * FRAME_NS, (255 * rgb).astype(np.uint8), (depth + noise).astype(np.float32), CAMERA)


def _run(readout: float, *settings: str, frames: int = FRAMES) -> tuple[Slam, float]:
    """Returns SLAM after the walk, and the RMSE of the rotations in degrees."""
    corner, errors = Corner(), []
    slam = Slam(load_config('realtime', ['threads=1', 'tracking.align.time_offset=false', *settings]))
    truth = corner.poses(np.arange(FRAMES, dtype=float))
    for index in range(frames):
        result = slam.process(corner.frame(index, readout))
        assert result.status in (Status.INITIALIZED, Status.TRACKED), (index, result.reason)
        off = se3.inverse(truth[index]) @ truth[0] @ result.T_world_cam
        errors.append(np.degrees(np.linalg.norm(se3.rotation_vector(off[:3, :3]))))
    return slam, float(np.sqrt(np.mean(np.square(errors))))


def test_a_rolling_shutter_is_found_and_poses_are_better() -> None:
    """Most of it: the map, made of such frames, shows some of it too. Poses are four times better here."""
    slam, off_deg = _run(READOUT)
    _, off_without_deg = _run(READOUT, 'tracking.align.rolling_shutter=false')
    assert 0.5 * READOUT < slam.state().motion.readout.seconds / (1e-9 * FRAME_NS) < 1.2 * READOUT
    assert off_deg < 0.5 * off_without_deg


def test_a_global_shutter_stays_one() -> None:
    slam, off_deg = _run(0.0)
    _, off_without_deg = _run(0.0, 'tracking.align.rolling_shutter=false')
    assert abs(slam.state().motion.readout.seconds) < 0.1e-9 * FRAME_NS  # two of its own standard deviations
    assert off_deg < 1.1 * off_without_deg


def test_the_estimate_is_part_of_checkpoints(tmp_path: Path) -> None:
    slam, _ = _run(READOUT, 'mapping.fused.final_passes=0', frames=8)
    path = Checkpoints(tmp_path, 1).save(slam.state(), Progress(8, 7, '', 8))
    readout = read_checkpoint(path).state.motion.readout
    assert readout == slam.state().motion.readout and readout.deviation > 0


def _follow(means: np.ndarray, information: float, interval_s: float = 1 / 30) -> Readout:
    readout = Readout()
    for mean in means:
        readout = readout.updated(ReadoutSeen(float(mean), information), interval_s)
    return readout


def test_what_is_hardly_larger_than_its_error_is_not_used() -> None:
    for mean, used in ((0.0, 0.0), (0.04, 0.0), (0.8, 0.8)):
        prior = _follow(np.full(200, mean), 1e5).prior(1 / 30)
        assert prior.mean == pytest.approx(used, abs=0.01)


def test_it_is_a_time_whatever_the_interval() -> None:
    """Two of three frames are missing: a third of the fraction. No frame before: nothing."""
    readout = _follow(np.full(200, 0.6), 1e5)
    assert readout.prior(3 / 30).mean == pytest.approx(readout.prior(1 / 30).mean / 3)
    assert readout.prior(np.inf) is None and Readout().prior(1 / 30).mean == 0


def test_a_frame_that_tells_nothing_and_outliers_change_little() -> None:
    readout = _follow(np.full(200, 0.6), 1e5)
    assert readout.updated(ReadoutSeen(-50.0, 1e-6), 1 / 30) is readout
    assert readout.updated(ReadoutSeen(-50.0, 1e5), 1 / 30).seconds == readout.seconds
