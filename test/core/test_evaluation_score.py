"""A finished run scored from its folder: matching by stamp, nulls, the report's picture."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from splatam_core import se3
from splatam_core.camera import PinholeCamera
from splatam_core.config import load_config
from splatam_core.errors import FrameError, RunFolderError
from splatam_core.evaluation.report import DPI, WIDTH_IN, write_report
from splatam_core.evaluation.score import combine, score_images, score_trajectory
from splatam_core.ply import write_ply
from splatam_core.rasterizer import Gaussians, make_rasterizer
from splatam_core.run_folder import MAP, RunDescription, RunFolder, RunRecord, Source, read_run
from splatam_core.types import FrameResult, RgbdFrame, StageTimings, Status, Trajectory

CONFIG = load_config('quick', ['threads=1'])
STEP_NS, COUNT, LOST = 33_333_333, 9, 4
CAMERA = PinholeCamera(48, 36, 40.0, 40.0, 23.5, 17.5)
T_TRUTH_WORLD = se3.exp(np.array([3.0, -1.0, 2.0, 0.3, 1.0, -0.5]))


@dataclass(frozen=True)
class Wall:
    """A recording of a coloured wall made of Gaussians, past which the camera moves on an arc."""

    camera: PinholeCamera = CAMERA
    name: str = 'wall'
    depth_scale: float | None = None
    first_ns: int = 10**18
    damaged: frozenset[int] = frozenset()

    @cached_property
    def gaussians(self) -> Gaussians:
        v, u = np.mgrid[-30:30, -40:40] * 0.05
        means = torch.tensor(np.stack([u, v, np.full_like(u, 2.0)], axis=-1).reshape(-1, 3), dtype=torch.float32)
        rgb = 0.5 + 0.4 * torch.sin(means @ torch.tensor([[9.0, 3, 1], [2, 8, 4], [0, 0, 0]]))
        return Gaussians(means, torch.full((len(means), 1), math.log(0.04)), torch.full((len(means),), 5.0), rgb)

    def __len__(self) -> int:
        return COUNT

    def pose(self, index: int) -> np.ndarray:
        angle = 0.1 * index
        x, y, z = 0.3 * math.sin(angle), 0.02 * index**2 / COUNT, 0.2 - 0.2 * math.cos(angle)
        return se3.exp(np.array([x, y, z, 0, 0, angle]))

    def __getitem__(self, index: int) -> RgbdFrame:
        if index in self.damaged:
            raise FrameError('its images do not fit the camera')
        T_cam_world = torch.from_numpy(se3.inverse(self.pose(index))).float()
        render = make_rasterizer('cpu', 1).render(self.gaussians, self.camera, T_cam_world)
        rgb = (render.rgb.clamp(0, 1) * 255).round().byte().permute(1, 2, 0).contiguous().numpy()
        depth_m = render.depth().numpy()
        depth_m[:, :4] = 0
        return RgbdFrame(self.first_ns + index * STEP_NS, rgb, depth_m, self.camera)

    def ground_truth(self) -> Trajectory:
        stamps = self.first_ns + STEP_NS * np.arange(COUNT)
        return Trajectory(stamps, np.array([T_TRUTH_WORLD @ self.pose(index) for index in range(COUNT)]))


def make_run(path: Path, sequence: Wall, with_map: bool = True, program: str = 'splatam run') -> RunRecord:
    """A run whose poses are the truth's, in another world, and whose map is the wall. One frame is lost."""
    source = None if program == 'splatam_node' else Source('/data/wall', max_frames=COUNT)
    with RunFolder.create(path, CONFIG, RunDescription(program, 'quick', source)) as folder:
        for index in range(COUNT):
            pose = None if index == LOST else sequence.pose(index)
            status = Status.LOST if pose is None else Status.TRACKED
            timings = StageTimings(track=20.0, densify=1.0, keyframes=0.5, map=30.0 + index, total=52.0 + index)
            frame, is_keyframe = sequence[index], index % 4 == 0
            result = FrameResult(index, frame.stamp_ns, status, pose, is_keyframe, 4800, 1.0, 1.0, '', timings)
            folder.append(frame, result, 0.05, 0.01)
    if with_map:
        write_ply(path / MAP, sequence.gaussians)
    return read_run(path)


def plain(indices: range) -> range:
    return indices


def test_a_perfect_run_scores_perfectly(tmp_path: Path) -> None:
    sequence = Wall()
    run = make_run(tmp_path, sequence)
    truth, images = score_trajectory(run, sequence.ground_truth()), score_images(run, sequence, 1, plain)
    metrics = combine(run, truth, images).metrics
    assert metrics.ate_rmse_m == pytest.approx(0, abs=1e-8)  # nine decimals in the file
    assert metrics.psnr_db > 55  # 8-bit rounding alone gives 58.9
    assert metrics.depth_l1_m == pytest.approx(0, abs=1e-5)
    assert metrics.ssim > 0.999
    assert (metrics.frames, metrics.tracked, metrics.lost) == (COUNT, COUNT - 1, 1)
    assert (metrics.ate_frames, metrics.evaluated_frames, metrics.evaluated_every) == (COUNT - 1, COUNT - 1, 1)


def test_every_nth_counts_lost_frames_too(tmp_path: Path) -> None:
    sequence = Wall()
    images = score_images(make_run(tmp_path, sequence), sequence, 2, plain)
    assert [(frame.stamp_ns - sequence.first_ns) // STEP_NS for frame in images.frames] == [0, 2, 6, 8]  # 4 is lost


def test_frames_are_matched_by_stamp(tmp_path: Path) -> None:
    """A recording that starts two frames earlier shows frame n at index n + 2; the other frames are not of the run."""
    run = make_run(tmp_path, Wall())
    earlier = Wall(first_ns=10**18 - 2 * STEP_NS)
    images = score_images(run, earlier, 1, plain)
    both = [10**18 + STEP_NS * index for index in range(COUNT - 2) if index != LOST]
    assert [frame.stamp_ns for frame in images.frames] == both
    assert images.frames[0].scores.psnr_db < 40  # the picture of index 2 at the pose of index 0


def test_another_recording_is_an_error(tmp_path: Path) -> None:
    run = make_run(tmp_path, Wall())
    with pytest.raises(RunFolderError, match=r'none of the 8 .* starts at 1000000000\.0.*, the recording at 5\.0'):
        score_images(run, Wall(first_ns=5_000_000_000), 1, plain)


def test_a_frame_that_does_not_fit_is_left_out(tmp_path: Path) -> None:
    images = score_images(make_run(tmp_path, Wall()), Wall(damaged=frozenset({0, 3})), 1, plain)
    assert len(images.frames) == COUNT - 3


def test_no_map_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(RunFolderError, match=r'has no map\.ply'):
        score_images(make_run(tmp_path, Wall(), with_map=False), Wall(), 1, plain)


def test_another_size_is_scored_in_that_size(tmp_path: Path) -> None:
    run = make_run(tmp_path, Wall())
    assert score_images(run, Wall(camera=CAMERA.resized(96, 72)), 1, plain).samples[0].rgb.shape == (72, 96, 3)


def test_samples_go_from_worst_to_best(tmp_path: Path) -> None:
    samples = score_images(make_run(tmp_path, Wall()), Wall(), 1, plain).samples
    assert [sample.title for sample in samples] == ['worst', 'median', 'best']
    psnr = [sample.scores.scores.psnr_db for sample in samples]
    assert psnr == sorted(psnr)
    assert samples[0].frame.stamp_ns == samples[0].scores.stamp_ns


@pytest.mark.parametrize(
    ('program', 'with_truth', 'with_images'),
    [('splatam run', True, True), ('splatam run', False, True), ('splatam_node', True, False)],
)
def test_report_is_drawn_from_whatever_is_known(
    tmp_path: Path, program: str, with_truth: bool, with_images: bool
) -> None:
    sequence = Wall()
    run = make_run(tmp_path, sequence, program=program)
    truth = score_trajectory(run, sequence.ground_truth()) if with_truth else None
    images = score_images(run, sequence, 4, plain) if with_images else None
    write_report(combine(run, truth, images), tmp_path / 'report.png')
    picture = cv2.imread(str(tmp_path / 'report.png'))
    assert picture.shape[1] == round(WIDTH_IN * DPI)
    assert picture.std() > 20  # something is drawn
    assert (picture[:: picture.shape[0] - 1] > 240).all()  # and nothing runs over the edges


def test_report_of_a_run_without_poses(tmp_path: Path) -> None:
    RunFolder.create(tmp_path, CONFIG, RunDescription('splatam_node')).close()
    evaluation = combine(read_run(tmp_path), None, None)
    assert evaluation.metrics.frames == 0 and evaluation.metrics.ate_rmse_m is None
    write_report(evaluation, tmp_path / 'report.png')
    assert cv2.imread(str(tmp_path / 'report.png')) is not None
