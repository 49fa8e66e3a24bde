"""Scores of a finished run: frames matched by stamp, missing scores, and the report in its forms."""

from __future__ import annotations

import base64
import csv
import dataclasses
import math
import re
from dataclasses import dataclass
from functools import cached_property
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from splatam_core.config import load_config
from splatam_core.errors import FrameError, RunFolderError
from splatam_core.evaluation import lpips
from splatam_core.evaluation.report.descriptions import DESCRIPTIONS
from splatam_core.evaluation.report.frame_table import write_frame_table
from splatam_core.evaluation.report.html import html_report
from splatam_core.evaluation.report.picture import DPI, WIDTH_IN, write_report
from splatam_core.evaluation.report.theme import DARK, LIGHT
from splatam_core.evaluation.results import NovelViews, combine
from splatam_core.evaluation.score import score_images, score_novel_views, score_trajectory
from splatam_core.geometry import se3
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.geometry.trajectory import Trajectory, stamp_from_text
from splatam_core.maps.ply import write_ply
from splatam_core.rasterizer import Gaussians, make_rasterizer
from splatam_core.runs.layout import MAP
from splatam_core.runs.metrics import GROUPS, Metrics, OriginalScores
from splatam_core.runs.record import RunDescription, RunRecord, Source, read_run
from splatam_core.runs.writer import RunFolder
from splatam_core.types import FrameResult, RgbdFrame, StageTimings, Status

CONFIG = load_config('quick', ['threads=1'])
STEP_NS, COUNT, LOST = 33_333_333, 9, 4
ORIGINAL = [entry.name for entry in dataclasses.fields(OriginalScores)]
CAMERA = PinholeCamera(48, 36, 40.0, 40.0, 23.5, 17.5)
T_GROUND_TRUTH_WORLD = se3.exp(np.array([3.0, -1.0, 2.0, 0.3, 1.0, -0.5]))


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
        return Trajectory(stamps, np.array([T_GROUND_TRUTH_WORLD @ self.pose(index) for index in range(COUNT)]))


def make_run(path: Path, sequence: Wall, with_map: bool = True, program: str = 'splatam run') -> RunRecord:
    """Write a run whose poses are the ground truth in another world, and whose map is the wall. One frame is lost."""
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
    trajectory, images = score_trajectory(run, sequence.ground_truth()), score_images(run, sequence, 1, plain)
    metrics = combine(run, trajectory, images).metrics
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
    ('program', 'with_ground_truth', 'with_images'),
    [('splatam run', True, True), ('splatam run', False, True), ('splatam_node', True, False)],
)
def test_report_is_drawn_with_missing_parts(tmp_path: Path, program: str, with_ground_truth: bool, with_images: bool) -> None:
    sequence = Wall()
    run = make_run(tmp_path, sequence, program=program)
    trajectory = score_trajectory(run, sequence.ground_truth()) if with_ground_truth else None
    images = score_images(run, sequence, 4, plain) if with_images else None
    write_report(combine(run, trajectory, images), tmp_path / 'report.png')
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


# --- held-out and novel views ---


def test_held_out_frames_are_scored_apart_whatever_every_says(tmp_path: Path) -> None:
    sequence = Wall()
    run = make_run(tmp_path, sequence)
    run = dataclasses.replace(run, config=load_config('quick', ['threads=1', 'mapping.hold_out=3']))
    images = score_images(run, sequence, 4, plain)
    assert [(frame.stamp_ns - sequence.first_ns) // STEP_NS for frame in images.frames] == [0, 8]  # 4 is lost
    assert [(frame.stamp_ns - sequence.first_ns) // STEP_NS for frame in images.held_out] == [2, 5, 8]
    metrics = combine(run, None, images).metrics
    assert metrics.heldout_frames == 3 and metrics.heldout.psnr_db > 55 and metrics.evaluated_frames == 2
    assert set(run.mapped_poses()) == {sequence.first_ns + STEP_NS * index for index in (0, 1, 3, 6, 7)}
    assert images.samples[-1].title == 'median held out'


@dataclass(frozen=True)
class Aside(Wall):
    """A test split of the wall: 10 cm beside the path, and turned round from view 6 on."""

    name: str = 'wall_test'

    def pose(self, index: int) -> np.ndarray:
        turn = np.pi if index >= 6 else 0.0
        return se3.exp(np.array([0.1, 0.0, 0, 0, 0, 0])) @ Wall.pose(self, index) @ se3.exp(np.array([0, 0, 0, 0, turn, 0]))

    def __getitem__(self, index: int) -> RgbdFrame:
        frame = Wall.__getitem__(self, index)
        return dataclasses.replace(frame, depth_m=np.full_like(frame.depth_m, 2.0)) if index >= 6 else frame


@pytest.mark.parametrize('alignment', ['trajectory', 'first'])
def test_novel_views_are_rendered_at_true_poses_and_holes_apart(tmp_path: Path, alignment: str) -> None:
    run = make_run(tmp_path, Wall())
    novel = score_novel_views(run, Wall().ground_truth(), Aside(), alignment, plain)
    metrics = combine(run, None, None, novel).metrics
    assert (metrics.novel_frames, metrics.novel_holes_frames, metrics.novel_alignment) == (6, 3, alignment)
    assert metrics.novel.psnr_db > 50  # 8 bits; alignment leaves the file's nine decimals
    assert metrics.novel_holes.psnr_db is not None and metrics.novel_holes.depth_l1_m > 1.9  # nothing rendered at 2 m
    assert metrics.splatam_novel.depth_l1_m == pytest.approx(0, abs=0.02)
    written = Metrics.from_json(metrics.to_json())
    assert written == metrics


def test_a_wrong_first_pose_spoils_the_first_pose_s_alignment_only(tmp_path: Path) -> None:
    run = make_run(tmp_path, Wall())
    poses = run.trajectory.T_world_cam.copy()
    poses[0] = poses[0] @ se3.exp(np.array([0, 0, 0, 0, np.radians(3), 0]))  # turned; its centre stays
    run = dataclasses.replace(run, trajectory=Trajectory(run.trajectory.stamps_ns, poses))
    by_all, by_first = (
        combine(run, None, None, score_novel_views(run, Wall().ground_truth(), Aside(), how, plain)).metrics.novel.psnr_db
        for how in ('trajectory', 'first')
    )
    assert by_all > by_first + 5  # one of eight rotations is wrong: an eighth of it enters the mean


# --- the page ---


class Page(HTMLParser):
    """The tags, links, identifiers and text of a page or of an SVG image."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.links: list[str] = []
        self.light_charts: list[str] = []
        self.dark_charts: list[str] = []
        self.ids: list[str] = []
        self.text = ''
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        if ('class', 'chart') in attrs:
            self.light_charts.append(svg_text(dict(attrs)['src']))
        if tag == 'source':
            assert dict(attrs)['media'] == '(prefers-color-scheme: dark)'
            self.dark_charts.append(svg_text(dict(attrs)['srcset']))
        for name, value in attrs:
            if name in ('src', 'srcset', 'href', 'xlink:href'):
                self.links.append(value or '')
            if name == 'id':
                self.ids.append(value or '')

    def handle_data(self, data: str) -> None:
        self.text += data


def svg_text(address: str) -> str:
    """Decode the address of an SVG image."""
    kind, data = address.split(',', 1)
    assert kind == 'data:image/svg+xml;base64'
    return base64.b64decode(data, validate=True).decode()


def check_self_contained(text: str) -> Page:
    """A page or image needs no other file and no network, and every reference in it has one target."""
    page = Page(text)
    assert all(link.startswith(('data:image/', '#')) for link in page.links)
    assert not {'script', 'link', 'iframe'} & set(page.tags) and '@import' not in text
    assert {url for url in re.findall(r'url\(([^)]*)\)', text) if not url.startswith('#')} == set()
    referenced = set(re.findall(r'url\(#([^)]*)\)', text)) | {link[1:] for link in page.links if link.startswith('#')}
    targets = [name for name in page.ids if name in referenced]
    assert referenced <= set(page.ids) and len(targets) == len(set(targets))
    return page


def check_page(text: str) -> Page:
    """The page is self-contained, defines the colours it uses, and has every chart in light and dark."""
    page = check_self_contained(text)
    assert set(re.findall(r'var\((--[a-z-]+)\)', text)) <= set(re.findall(r'(--[a-z-]+):', text))
    assert len(page.light_charts) == len(page.dark_charts) == 4
    for charts, theme, other in ((page.light_charts, LIGHT, DARK), (page.dark_charts, DARK, LIGHT)):
        for chart in charts:
            check_self_contained(chart)
            assert theme.ink in chart and other.ink not in chart and other.card not in chart
    return page


@pytest.mark.slow
@pytest.mark.parametrize(('with_ground_truth', 'with_images'), [(True, True), (False, True), (True, False)])
def test_page_is_complete_and_needs_nothing_else(tmp_path: Path, with_ground_truth: bool, with_images: bool) -> None:
    sequence = Wall()
    run = make_run(tmp_path / 'a run & <more>', sequence)
    trajectory = score_trajectory(run, sequence.ground_truth()) if with_ground_truth else None
    images = score_images(run, sequence, 4, plain) if with_images else None
    novel = score_novel_views(run, sequence.ground_truth(), Aside(), 'first', plain) if with_ground_truth and with_images else None
    page = check_page(html_report(combine(run, trajectory, images, novel)))
    assert 'a run & <more>' in page.text and f'of {COUNT}' in page.text and 'more' not in page.tags
    assert ('ATE RMSE' in page.text) and ('tracking.iterations' in page.text)
    assert page.tags.count('figure') == 7 * (len(images.samples) if images else 0) + 7 * (len(novel.samples) if novel else 0)
    assert ('novel view, with holes' in page.text) == (novel is not None)
    assert ('No frames or no map' in page.text) == (not with_images)


@pytest.mark.parametrize('frames', [0, 1])
def test_page_of_hardly_a_run(tmp_path: Path, frames: int) -> None:
    with RunFolder.create(tmp_path, CONFIG, RunDescription('splatam_node')) as folder:
        for index in range(frames):
            result = FrameResult(index, 5, Status.INITIALIZED, np.eye(4), True, 10, 1.0, 1.0, '', StageTimings(total=1.0))
            folder.append(Wall()[0], result, 0.01)
    page = check_page(html_report(combine(read_run(tmp_path), None, None)))
    assert f'of {frames}' in page.text


def test_the_table_of_frames_is_what_the_means_are_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(lpips.PATH_VARIABLE, str(tmp_path / 'none'))
    sequence = Wall()
    run = make_run(tmp_path, sequence)
    trajectory, images = score_trajectory(run, sequence.ground_truth()), score_images(run, sequence, 1, plain)
    novel = NovelViews('first', images.frames[:2], images.frames[2:3], ())
    evaluation = combine(run, trajectory, images, novel)
    write_frame_table(evaluation, tmp_path / 'scores.csv')
    rows = list(csv.DictReader((tmp_path / 'scores.csv').open()))
    assert [row['kind'] for row in rows] == ['frame'] * (COUNT - 1) + ['novel'] * 3
    frames = rows[: COUNT - 1]
    assert [stamp_from_text(row['stamp']) for row in frames] == [frame.stamp_ns for frame in images.frames]
    for column, mean in (('psnr_db', evaluation.metrics.psnr_db), ('splatam_depth_l1_m', evaluation.metrics.splatam.depth_l1_m)):
        assert np.mean([float(row[column]) for row in frames]) == pytest.approx(mean, rel=1e-5)
    errors = [float(row['position_error_m']) for row in frames]
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(evaluation.metrics.ate_rmse_m, abs=1e-8)
    assert {row['lpips'] for row in rows} == {''} and rows[-1]['position_error_m'] == ''


def test_lpips_is_scored_where_its_weights_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sequence = Wall()
    run = make_run(tmp_path / 'run', sequence)
    monkeypatch.setenv(lpips.PATH_VARIABLE, str(tmp_path / 'weights.npz'))
    missing = score_images(run, sequence, 1, plain)
    assert missing.frames[0].scores.lpips is None and 'lpips-weights' in missing.notes['lpips']
    lpips.save_weights({name: np.full(shape, 0.01, np.float32) for name, shape in lpips.SHAPES.items()})
    scored = score_images(run, sequence, 1, plain)
    assert 'lpips' not in scored.notes
    assert all(0 <= score < 1e-3 for frame in scored.frames for score in (frame.scores.lpips, frame.original.lpips))


def test_every_number_is_described_once() -> None:
    numbers = set(Metrics(0, 0, 0, None, None, None, None, {}).values()) - {'timings_ms', 'notes'}
    described = [description.name for group in DESCRIPTIONS.values() for description in group]
    assert sorted(described) == sorted(numbers)
    page = (Path(__file__).resolve().parents[2] / 'docs' / 'evaluation.md').read_text()
    own = {entry.name for entry in dataclasses.fields(Metrics)} - set(GROUPS) | {f'splatam_{name}' for name in ORIGINAL}
    assert [name for name in own if f'`{name}`' not in page] == []
    assert [group for group in GROUPS if f'`{group}_' not in page] == []
