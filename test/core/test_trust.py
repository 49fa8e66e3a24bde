"""What verdicts do in SLAM: a wall without texture, a covered camera with odometry, and a map that takes back what was wrong."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from splatam_core.config import load_config
from splatam_core.correction import correct
from splatam_core.datasets.registry import open_sequence
from splatam_core.geometry import se3
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.images.observation import Observation
from splatam_core.mapping.posed import PosedFrame
from splatam_core.mapping.schedule import MappingPlan
from splatam_core.slam import Slam
from splatam_core.types import FrameResult, RgbdFrame, Status

CAMERA = PinholeCamera(96, 72, 80.0, 80.0, 47.5, 35.5)
WALL_M, TEXEL_M = 1.5, 0.01
FRAME_NS = 33_000_000


class Wall:
    """A camera that moves along a wall, whose texture is missing between two places."""

    def __init__(self, blank_m: tuple[float, float] = (0.0, 0.0)) -> None:
        self._rng = np.random.default_rng(0)
        texture = cv2.GaussianBlur(self._rng.random((300, 800, 3)).astype(np.float32), (0, 0), 4)
        self._texture = np.clip(0.5 + 3 * (texture - 0.5), 0, 1)
        begin, end = (round((x + 2) / TEXEL_M) for x in blank_m)
        self._texture[:, begin:end] = 0.5

    def frame(self, x_m: float, stamp_ns: int) -> RgbdFrame:
        """Returns what the camera sees at a place, with the noise of a sensor."""
        v, u = np.mgrid[: CAMERA.height, : CAMERA.width].astype(np.float32)
        across = (x_m + 2 + (u - CAMERA.cx) / CAMERA.fx * WALL_M) / TEXEL_M
        down = (1.5 + (v - CAMERA.cy) / CAMERA.fy * WALL_M) / TEXEL_M
        rgb = 255 * cv2.remap(self._texture, across.astype(np.float32), down.astype(np.float32), cv2.INTER_LINEAR)
        rgb += self._rng.normal(0, 3, rgb.shape)
        depth = self._rng.normal(WALL_M, 0.004, u.shape)
        return RgbdFrame(stamp_ns, np.clip(rgb.round(), 0, 255).astype(np.uint8), depth.astype(np.float32), CAMERA)


def walk(speeds_m: list[float]) -> list[float]:
    """Returns places along the wall, given the motion to each from the one before."""
    return np.cumsum([0.0, *speeds_m]).tolist()


def odometry(places: list[float]) -> Callable[[int, int], np.ndarray]:
    """Returns the true motion between two stamps, as another sensor reports it."""

    def motion(from_ns: int, to_ns: int) -> np.ndarray:
        begin, end = (places[ns // FRAME_NS - 1] for ns in (from_ns, to_ns))
        return se3.exp(np.array([end - begin, 0, 0, 0, 0, 0]))

    return motion


def run(slam: Slam, frames: list[RgbdFrame]) -> list[FrameResult]:
    return [slam.process(frame) for frame in frames]


BLANK = (0.8, 3.3)  # 2.5 m; the camera sees 1.8 m
SPEEDS = [0.04] * 43 + [0.03, 0.02, 0.02, 0.03, 0.04, 0.05, 0.06, 0.07] + [0.07] * 15  # other ones where it sees no texture
PLACES = walk(SPEEDS)


@pytest.mark.slow
def test_odometry_bridges_a_blank_wall() -> None:
    """Where the images leave the motion open it is that of the odometry; that is said."""
    wall = Wall(BLANK)
    frames = [wall.frame(x, (index + 1) * FRAME_NS) for index, x in enumerate(PLACES)]
    slam = Slam(load_config('realtime', ['threads=1']), odometry(PLACES))
    results = run(slam, frames)
    blank = [result for result, x in zip(results, PLACES) if BLANK[0] + 0.95 < x < BLANK[1] - 0.95]
    assert len(blank) > 5 and all(result.num_held > 0 for result in blank)
    assert sum(result.status.is_trusted for result in results) > 0.9 * len(results)
    last = results[-1].T_world_cam
    assert last is not None and abs(last[0, 3] - PLACES[-1]) < 0.05


@pytest.mark.slow
def test_without_odometry_a_blank_wall_is_crossed_on_a_guess_and_the_covariance_says_so() -> None:
    wall = Wall(BLANK)
    frames = [wall.frame(x, (index + 1) * FRAME_NS) for index, x in enumerate(PLACES)]
    results = run(Slam(load_config('realtime', ['threads=1'])), frames)
    assert any(result.num_held for result in results)
    for result, x in zip(results, PLACES, strict=True):
        if result.status.is_trusted:
            assert result.T_world_cam is not None and result.covariance is not None
            claimed_m = 3 * np.sqrt(np.trace(result.covariance.total[:3, :3]))
            assert np.linalg.norm(result.T_world_cam[:3, 3] - (x, 0, 0)) < max(0.1, claimed_m)


def test_odometry_bridges_a_covered_camera() -> None:
    """For two thirds of a second, in which the camera goes on by 30 cm and turns back."""
    places = walk([0.02] * 6 + [0.02] * 16 + [-0.02] * 4)
    wall = Wall()
    frames = [wall.frame(x, (index + 1) * FRAME_NS) for index, x in enumerate(places)]
    for index in range(7, 23):
        frames[index] = replace(frames[index], rgb=np.zeros_like(frames[index].rgb), depth_m=np.zeros_like(frames[index].depth_m))
    results = run(Slam(load_config('realtime', ['threads=1']), odometry(places)), frames)
    assert [result.status for result in results[7:23]] == [Status.LOST] * 16
    for result, x in list(zip(results, places, strict=True))[23:]:
        assert result.status is Status.TRACKED and result.T_world_cam is not None
        assert abs(result.T_world_cam[0, 3] - x) < 0.02


def faint(frame: RgbdFrame) -> RgbdFrame:
    """A fifth of the texture's contrast."""
    return replace(frame, rgb=(128 + 0.2 * (frame.rgb.astype(np.float32) - 128)).round().astype(np.uint8))


def test_a_map_without_texture_is_crossed_by_the_motion_that_the_frames_show() -> None:
    """As where the camera has passed too fast: what it mapped is a smear, and then it turns back, which nothing predicts."""
    places = walk([0.02] * 8 + [0.01, 0.0, -0.01, *[-0.02] * 5, -0.01, 0.0, 0.01, *[0.02] * 5])
    wall = Wall()
    frames = [faint(wall.frame(x, (index + 1) * FRAME_NS)) for index, x in enumerate(places)]
    slam = Slam(load_config('realtime', ['threads=1']))
    run(slam, frames[:9])
    with torch.no_grad():
        slam.map.gaussians.rgb[:] = slam.map.gaussians.rgb.mean(dim=0)
    slam.configure(load_config('realtime', ['threads=1', 'mapping.enabled=false']))
    for result, x in zip(run(slam, frames[9:]), places[9:], strict=True):
        assert result.status is Status.TRACKED and result.T_world_cam is not None
        assert np.linalg.norm(result.T_world_cam[:3, 3] - (x, 0, 0)) < 0.04  # two pixels; without, 30 cm


@pytest.fixture(scope='module')
def room() -> list[RgbdFrame]:
    sequence = open_sequence('synthetic', width=96, max_frames=10)
    return [sequence[index] for index in range(10)]


def add_at(slam: Slam, frame: RgbdFrame, T_world_cam: np.ndarray, index: int) -> None:
    """Maps a frame at a pose, right or wrong."""
    seen = Observation.from_frame(frame, slam.config.depth, slam.backend.device)
    posed = PosedFrame(seen, se3.inverse(T_world_cam), slam.config.mapping, index)
    plan = MappingPlan(is_used=True, densifies=True, steps=None, is_keyframe=True)
    slam._mapper.densify(posed, plan)
    slam._mapper.select(posed, plan)


@pytest.mark.parametrize('off_m', [0.0, 0.3])
def test_what_a_wrong_pose_has_added_is_removed(off_m: float, room: list[RgbdFrame]) -> None:
    """And no more: what earlier frames added stays, and so does everything if all poses were right."""
    slam = Slam(load_config('quick', ['threads=1']))
    results = run(slam, room[:6])
    assert results[-1].T_world_cam is not None
    before = slam.snapshot()
    add_at(slam, room[6], results[-1].T_world_cam @ se3.exp(np.array([0, off_m, off_m, 0, 0, 0])), index=6)
    added, keyframes = slam.num_gaussians - len(before.means), [keyframe.frame for keyframe in slam._mapper.keyframes]
    assert added > (100 if off_m else 0) and keyframes == [0, 5, 6]
    removed = correct(slam._mapper, slam.graph, slam._tracker, slam.config.tracking, current=8)
    assert removed == (added if off_m else 0)
    if off_m:
        assert np.array_equal(slam.snapshot().means, before.means)
        assert [keyframe.frame for keyframe in slam._mapper.keyframes] == [0, 5]


def test_uncertain_frames_change_no_map_and_tracking_goes_on(room: list[RgbdFrame]) -> None:
    slam = Slam(load_config('quick', ['threads=1']))
    run(slam, room[:5])
    before = slam.snapshot()
    strict = load_config('quick', ['threads=1', 'tracking.max_error_m=0.0001'])
    slam.configure(strict)
    for result in run(slam, room[5:7]):
        assert result.status is Status.UNCERTAIN and result.reason and not result.is_keyframe
        assert result.T_world_cam is not None and result.covariance is not None
        assert np.sqrt(np.trace(result.covariance.total[:3, :3])) > 1e-4
    assert np.array_equal(slam.snapshot().means, before.means)
    slam.configure(load_config('quick', ['threads=1']))
    assert [result.status for result in run(slam, room[7:])] == [Status.TRACKED] * 3
