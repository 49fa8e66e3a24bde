"""The commands that work on finished runs, each on the same tiny one."""

from __future__ import annotations

import resource
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from splatam_core.cli import main
from splatam_core.datasets.registry import open_sequence
from splatam_core.geometry import se3
from splatam_core.geometry.trajectory import pose_line
from splatam_core.maps.ply import read_ply
from splatam_core.rasterizer import make_rasterizer
from splatam_core.runs.metrics import Metrics
from splatam_core.runs.record import RunRecord, read_run

WIDTH, FRAMES, HOLD_OUT = 64, 6, 3
SOURCE = ['synthetic', '--width', WIDTH, '--max-frames', FRAMES]
FAST = ['--set', 'threads=1', '--set', 'tracking.iterations=8', '--set', 'mapping.iterations=3']


def splatam(*arguments: object) -> int:
    return main([str(argument) for argument in arguments])


@pytest.fixture(scope='module')
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run; tests must not change it."""
    folder = tmp_path_factory.mktemp('commands') / 'tiny'
    assert splatam('run', *SOURCE, '--preset', 'quick', *FAST, '--holdout', HOLD_OUT, '--out', folder) == 0
    return folder


@pytest.fixture
def run(finished: Path) -> RunRecord:
    return read_run(finished)


def metrics(folder: Path) -> Metrics:
    return read_run(folder).metrics()


# --- run --holdout ---


def test_held_out_frames_are_tracked_and_scored_apart(run: RunRecord) -> None:
    assert run.config.mapping.hold_out == HOLD_OUT
    scores = run.metrics()
    assert (scores.tracked, scores.evaluated_frames, scores.heldout_frames) == (FRAMES, FRAMES, 2)
    assert scores.heldout.psnr_db > 15 and scores.heldout.psnr_db != scores.psnr_db
    grew = np.diff([0, *(frame.num_gaussians for frame in run.frames)])
    assert (grew[[2, 5]] == 0).all() and not any(run.frames[index].is_keyframe for index in (2, 5))


def test_holding_out_every_frame_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert splatam('run', *SOURCE, '--holdout', 1, '--out', tmp_path / 'run') == 2
    assert 'expected 0 (none) or at least 2' in capsys.readouterr().err


# --- evaluate --novel-views ---


@pytest.fixture(scope='module')
def replica_v2(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The synthetic room in Replica-V2's layout: frames 0 to 3 for training; frames 0 and 40 for testing."""
    folder = tmp_path_factory.mktemp('replica') / 'room_0'
    sequence = open_sequence('synthetic', width=WIDTH, max_frames=41)
    truth, c = sequence.ground_truth().T_world_cam, sequence.camera
    for split, indices in (('00', (0, 1, 2, 3)), ('01', (0, 40))):
        for kind in ('rgb', 'depth'):
            (folder / 'imap' / split / kind).mkdir(parents=True)
        for number, index in enumerate(indices):
            frame = sequence[index]
            depth = np.rint(frame.depth_m * 1000).astype(np.uint16)
            cv2.imwrite(str(folder / 'imap' / split / 'rgb' / f'rgb_{number}.png'), frame.rgb[..., ::-1])
            cv2.imwrite(str(folder / 'imap' / split / 'depth' / f'depth_{number}.png'), depth)
        np.savetxt(folder / 'imap' / split / 'traj_w_c.txt', truth[list(indices)].reshape(-1, 16))
    (folder / 'camera.yaml').write_text(
        f'{{width: {c.width}, height: {c.height}, fx: {c.fx}, fy: {c.fy}, cx: {c.cx}, cy: {c.cy}, depth_scale: 1000}}'
    )
    return folder


@pytest.mark.slow
def test_test_split_is_scored_at_its_true_poses(
    replica_v2: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], request: pytest.FixtureRequest
) -> None:
    assert splatam('run', replica_v2, '--preset', 'quick', *FAST, '--no-evaluate', '--out', tmp_path / 'run') == 0
    assert splatam('evaluate', tmp_path / 'run', '--novel-views') == 0
    assert '1 views without holes; 1 with holes are scored apart' in capsys.readouterr().out
    scores = metrics(tmp_path / 'run')
    assert (scores.novel_alignment, scores.novel_frames, scores.novel_holes_frames) == ('trajectory', 1, 1)
    # The view without holes is a train frame's: it scores about as that does; the other sees mostly what was not mapped.
    assert scores.novel.psnr_db == pytest.approx(scores.psnr_db, abs=2)
    assert scores.novel_holes.depth_l1_m > 2 * scores.novel.depth_l1_m
    assert 'novel view, with holes' in (tmp_path / 'run' / 'report.html').read_text()
    request.getfixturevalue('undrawn')
    assert splatam('evaluate', tmp_path / 'run', '--novel-views', 'first') == 0
    assert metrics(tmp_path / 'run').novel_alignment == 'first'


def test_novel_views_need_a_test_split(finished: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (finished / 'metrics.json').read_bytes()
    assert splatam('evaluate', finished, '--novel-views') == 2
    assert '--novel-views needs a dataset with a test split' in capsys.readouterr().err
    assert (finished / 'metrics.json').read_bytes() == before


# --- compare ---


def test_compare_prints_a_table_and_draws(finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = Path(shutil.copytree(finished, tmp_path / 'other'))
    (other / 'metrics.json').unlink()  # as after a run that was killed
    assert splatam('compare', finished, other, '--plot', tmp_path / 'plot.png', '--html', tmp_path / 'page.html') == 0
    common, _, head, _, *rows = capsys.readouterr().out.splitlines()[:6]
    assert common.startswith('synthetic; commit') and 'cores' in common
    columns = [cell.strip() for cell in head.strip('|').split('|')]
    table = [dict(zip(columns, (cell.strip() for cell in row.strip('|').split('|')))) for row in rows]
    assert [row['run'] for row in table] == ['tiny', 'other']
    assert table[0]['ATE RMSE cm'] == f'{100 * metrics(finished).ate_rmse_m:.3f}'
    assert table[0]['held out: PSNR dB'] == f'{metrics(finished).heldout.psnr_db:.2f}'
    assert table[1]['ATE RMSE cm'] == '\u2013' and table[1]['tracked'] == f'{FRAMES}/{FRAMES}'
    assert 'MS-SSIM' not in columns  # no run has it
    assert cv2.imread(str(tmp_path / 'plot.png')).std() > 20
    page = (tmp_path / 'page.html').read_text()
    assert f'<td class="n">{100 * metrics(finished).ate_rmse_m:.3f}</td>' in page and 'data:image/png;base64,' in page
    assert 'href="other/report.html"' in page  # relative to the page


def test_compare_of_equal_names_shows_their_paths(finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    same = shutil.copytree(finished, tmp_path / 'tiny')
    assert splatam('compare', finished, same, '--plot', tmp_path / 'plot.svg') == 0
    assert str(same) in capsys.readouterr().out and (tmp_path / 'plot.svg').read_text().startswith('<?xml')


@pytest.mark.parametrize(('plot', 'message'), [('a.jpg', "'.jpg' is not one of"), ('no/a.png', 'no/a.png: cannot be written')])
def test_compare_refuses_what_it_cannot_draw(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], plot: str, message: str
) -> None:
    assert splatam('compare', finished, '--plot', tmp_path / plot) == 2
    assert message in capsys.readouterr().err


# --- render ---


def test_render_shows_the_map_from_given_poses(run: RunRecord, tmp_path: Path) -> None:
    poses = [np.eye(4), se3.exp(np.array([0.1, 0, 0, 0, 0.05, 0]))]
    (tmp_path / 'poses.txt').write_text('\n'.join(pose_line(10**8 * i, pose) for i, pose in enumerate(poses)))
    out = tmp_path / 'film'
    assert splatam('render', run.path, '--poses', tmp_path / 'poses.txt', '--out', out) == 0
    for index, pose in enumerate(poses):
        T_cam_world = torch.from_numpy(se3.inverse(pose)).float()
        view = make_rasterizer('cpu', 1).render(run.read_map(), run.camera, T_cam_world).images()
        color, depth, silhouette = (
            cv2.imread(str(out / kind / f'{index:06d}.png'), cv2.IMREAD_UNCHANGED) for kind in ('color', 'depth', 'silhouette')
        )
        assert np.array_equal(color[..., ::-1], view.rgb)
        assert depth.dtype == np.uint16 and np.abs(depth / 1000 - view.depth_m).max() <= 0.0005 + 1e-6
        assert np.abs(silhouette / 255 - view.silhouette).max() <= 0.5 / 255 + 1e-6
    film = cv2.VideoCapture(str(out / 'color.mp4'))
    assert film.get(cv2.CAP_PROP_FRAME_COUNT) == 2 and film.get(cv2.CAP_PROP_FPS) == pytest.approx(10)
    _, first = film.read()
    # The video is lossy: it must be far closer to the picture than to its mirror image.
    picture = cv2.imread(str(out / 'color' / '000000.png')).astype(float)
    assert np.abs(first - picture).mean() < 0.3 * np.abs(first[:, ::-1] - picture).mean()


def test_render_follows_the_run_where_no_poses_are_given(run: RunRecord, tmp_path: Path) -> None:
    assert splatam('render', run.path, '--out', tmp_path / 'film', '--no-video', '--width', 32) == 0
    pictures = sorted((tmp_path / 'film' / 'color').iterdir())
    assert len(pictures) == FRAMES and cv2.imread(str(pictures[0])).shape == (24, 32, 3)
    assert not list((tmp_path / 'film').glob('*.mp4'))


def test_render_refuses_what_leaves_nothing(run: RunRecord, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / 'empty.txt').write_text('# no pose\n')
    for arguments, message in (
        (['--no-video', '--no-images'], 'leave nothing to write'),
        (['--poses', tmp_path / 'empty.txt'], 'no pose to render from'),
        (['--poses', tmp_path / 'nothing.txt'], 'cannot be read'),
    ):
        assert splatam('render', run.path, '--out', tmp_path / 'film', *arguments) == 2
        assert message in capsys.readouterr().err
    assert splatam('render', run.path, '--out', tmp_path) == 2
    assert 'exists: choose another folder' in capsys.readouterr().err
    assert not (tmp_path / 'film').exists()


@pytest.mark.parametrize('what', ['--no-video', '--no-images'])
def test_a_disk_that_is_full_while_rendering_is_said(
    run: RunRecord, tmp_path: Path, capsys: pytest.CaptureFixture[str], what: str
) -> None:
    """OpenCV reports it for neither images nor videos."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
    try:
        code = splatam('render', run.path, '--out', tmp_path / 'film', what)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert code == 2 and 'cannot be written' in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


# --- refine ---


@pytest.mark.slow
@pytest.mark.usefixtures('undrawn')
def test_refine_makes_a_better_map_and_leaves_the_run_alone(
    run: RunRecord, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {path.name: path.read_bytes() for path in run.path.iterdir()}
    assert splatam('refine', run.path, '--out', tmp_path / 'refined', '--iterations', 60) == 0
    assert {path.name: path.read_bytes() for path in run.path.iterdir()} == before
    old, new = run.metrics(), metrics(tmp_path / 'refined')
    assert new.psnr_db > old.psnr_db + 0.5 and new.depth_l1_m < old.depth_l1_m
    assert f'PSNR was {old.psnr_db:.2f} dB, is {new.psnr_db:.2f} dB' in capsys.readouterr().out
    assert (tmp_path / 'refined' / 'trajectory.txt').read_bytes() == before['trajectory.txt']
    assert new.ate_rmse_m == old.ate_rmse_m and new.heldout_frames == old.heldout_frames
    assert read_run(tmp_path / 'refined').description.program == 'splatam refine'
    assert {path.name for path in (tmp_path / 'refined').iterdir()} == set(before)


@pytest.mark.slow
@pytest.mark.usefixtures('undrawn')
def test_refine_may_add_gaussians(run: RunRecord, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr('splatam_core.mapping.offline_refinement.DENSIFY_FROM', 20)
    monkeypatch.setattr('splatam_core.mapping.offline_refinement.DENSIFY_EVERY', 20)
    steps = ['--iterations', 60]
    assert splatam('refine', run.path, '--out', tmp_path / 'same', *steps) == 0
    assert splatam('refine', run.path, '--out', tmp_path / 'grown', *steps, '--densify') == 0
    same, grown = (len(read_ply(tmp_path / name / 'map.ply')) for name in ('same', 'grown'))
    assert same <= len(run.read_map()) < grown
    assert read_run(tmp_path / 'grown').trajectory.stamps_ns.tolist() == run.trajectory.stamps_ns.tolist()


def test_refine_does_not_look_at_held_out_frames(run: RunRecord) -> None:
    stamps_ns = [frame.stamp_ns for frame in run.frames]
    assert sorted(run.mapped_poses()) == [stamps_ns[index] for index in (0, 1, 3, 4)]


def test_refine_needs_a_free_folder(run: RunRecord, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / 'note.txt').write_text('mine')
    assert splatam('refine', run.path, '--out', tmp_path) == 2
    assert 'exists: choose another folder' in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ['note.txt']


# --- export ---


def test_export_of_gaussians_is_the_map(run: RunRecord, tmp_path: Path) -> None:
    assert splatam('export', run.path, tmp_path / 'map.ply') == 0
    exported, own = read_ply(tmp_path / 'map.ply'), run.read_map()
    for name in ('means', 'log_scales', 'logit_opacities', 'rgb'):
        assert torch.allclose(getattr(exported, name), getattr(own, name), atol=1e-6)


def test_export_pads_spherical_harmonics_and_reads_maps_of_other_programs(run: RunRecord, tmp_path: Path) -> None:
    assert splatam('export', run.path, tmp_path / 'strict.ply', '--sh-degree', 3) == 0
    assert b'property float f_rest_44\nproperty float opacity\n' in (tmp_path / 'strict.ply').read_bytes()
    assert splatam('export', tmp_path / 'strict.ply', tmp_path / 'map.ply') == 0
    assert (tmp_path / 'map.ply').stat().st_size == (run.path / 'map.ply').stat().st_size
    assert splatam('export', tmp_path / 'strict.ply', tmp_path / 'points.ply', '--as', 'points', '--min-opacity', 0.1) == 0
    assert splatam('export', tmp_path / 'strict.ply', tmp_path / 'map.splat') == 0
    assert (tmp_path / 'map.splat').stat().st_size == 32 * len(run.read_map())


def test_export_of_a_grid_needs_a_floor(run: RunRecord, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, message in (
        (['--min-height', 2], '--min-height 2 is not below --max-height 1'),
        (['--max-depth', 1], 'there is no grid: '),  # the room's floor is farther away
    ):
        assert splatam('export', run.path, tmp_path / 'm.yaml', '--as', 'grid', *arguments) == 2
        assert message in capsys.readouterr().err
    assert splatam('export', run.path, tmp_path / 'm.yaml', '--as', 'grid', '--every', 1) == 0
    assert 'cells of 0.05 m' in capsys.readouterr().out and {path.name for path in tmp_path.iterdir()} == {'m.yaml', 'm.pgm'}
    assert splatam('export', run.path, tmp_path / 'm.yaml', '--as', 'grid', '--overwrite') == 0
    (tmp_path / 'm.yaml').unlink()
    assert splatam('export', run.path, tmp_path / 'm.yaml', '--as', 'grid') == 2
    assert 'm.pgm exists' in capsys.readouterr().err


def test_export_of_voxels_has_the_axes_of_the_grid(run: RunRecord, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert splatam('export', run.path, tmp_path / 'm.bt', '--as', 'octomap', '--every', 1) == 0
    assert 'free voxels of 0.05 m are in' in capsys.readouterr().out
    assert splatam('export', run.path, tmp_path / 'm.yaml', '--as', 'grid', '--every', 1) == 0
    matrix = (tmp_path / 'm.yaml').read_text().split('T_grid_world:\n')[1].split('image:')[0]
    assert matrix in (tmp_path / 'm.bt').read_bytes().decode(errors='replace')
    assert splatam('export', run.path, tmp_path / 'n.bt', '--as', 'octomap', '--resolution', 1e-4) == 2
    assert 'is too large: choose a larger resolution' in capsys.readouterr().err


@pytest.mark.parametrize('value', ['1e300', '1e-300', 'inf', 'nan', '-1'])
def test_lengths_beyond_any_use_are_refused(value: str, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ('resolution', 'max-depth', 'max-height', 'voxel', 'min-opacity'):
        with pytest.raises(SystemExit):
            splatam('export', 'run', 'm.yaml', '--as', 'grid', f'--{name}={value}')
        assert 'is not a number above 0' in capsys.readouterr().err


def test_export_of_points_is_the_opaque_centres(run: RunRecord, tmp_path: Path) -> None:
    own = run.read_map()
    middle = float(torch.sigmoid(own.logit_opacities).median())
    assert splatam('export', run.path, tmp_path / 'p.ply', '--as', 'points', '--min-opacity', middle) == 0
    header, data = (tmp_path / 'p.ply').read_bytes().split(b'end_header\n', 1)
    rows = np.frombuffer(data, dtype=[('xyz', '<f4', 3), ('rgb', 'u1', 3)])
    opaque = torch.sigmoid(own.logit_opacities) >= middle
    assert f'element vertex {int(opaque.sum())}\n'.encode() in header and 0 < opaque.sum() < len(own)
    assert np.array_equal(rows['xyz'], own.means[opaque].numpy())
    assert np.abs(rows['rgb'] / 255 - own.rgb[opaque].clamp(0, 1).numpy()).max() <= 0.5 / 255 + 1e-6


def test_export_of_a_mesh_names_its_extra(
    run: RunRecord, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, 'open3d', None)
    assert splatam('export', run.path, tmp_path / 'm.ply', '--as', 'mesh') == 2
    assert "pip install 'splatam_ros[mesh]'" in capsys.readouterr().err
    assert not (tmp_path / 'm.ply').exists()


def test_export_of_a_mesh_names_the_libraries_that_open3d_lacks(
    run: RunRecord, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / 'open3d.py').write_text("raise OSError('libusb-1.0.so.0: cannot open shared object file')")
    monkeypatch.delitem(sys.modules, 'open3d', raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    assert splatam('export', run.path, tmp_path / 'm.ply', '--as', 'mesh') == 2
    error = capsys.readouterr().err
    assert 'libusb-1.0.so.0' in error and 'apt install libusb-1.0-0' in error and 'pip install' not in error


def test_exported_mesh_lies_where_the_map_is_seen(run: RunRecord, tmp_path: Path) -> None:
    open3d = pytest.importorskip('open3d')
    arguments = ['--as', 'mesh', '--voxel', 0.03, '--every', 1]
    assert splatam('export', run.path, tmp_path / 'm.ply', *arguments) == 0
    mesh = open3d.io.read_triangle_mesh(str(tmp_path / 'm.ply'))
    points = np.asarray(mesh.vertices)
    assert len(mesh.triangles) > 100
    rendered_m = make_rasterizer('cpu', 1).render(run.read_map(), run.camera, torch.eye(4)).images().depth_m
    u = np.rint(run.camera.fx * points[:, 0] / points[:, 2] + run.camera.cx).astype(int)
    v = np.rint(run.camera.fy * points[:, 1] / points[:, 2] + run.camera.cy).astype(int)
    inside = (u >= 0) & (u < run.camera.width) & (v >= 0) & (v < run.camera.height)
    error_m = np.abs(points[inside, 2] - rendered_m[v[inside], u[inside]])
    assert np.median(error_m) < 0.03  # a voxel


def test_export_for_the_original_s_programs(run: RunRecord, tmp_path: Path) -> None:
    """Names, shapes and poses are those that the original's viewers read; nothing in the file needs pickle."""
    assert splatam('export', run.path, tmp_path / 'params.npz', '--as', 'splatam') == 0
    params = dict(np.load(tmp_path / 'params.npz', allow_pickle=False))
    gaussians, poses, n = run.read_map(), run.trajectory.T_world_cam, len(run.read_map())
    shapes = {name: values.shape for name, values in params.items()}
    assert shapes == {
        'means3D': (n, 3), 'rgb_colors': (n, 3), 'unnorm_rotations': (n, 4), 'logit_opacities': (n, 1),
        'log_scales': (n, 1), 'cam_unnorm_rots': (1, 4, FRAMES), 'cam_trans': (1, 3, FRAMES), 'timestep': (n,),
        'intrinsics': (3, 3), 'w2c': (4, 4), 'org_width': (), 'org_height': (), 'gt_w2c_all_frames': (FRAMES, 4, 4),
        'keyframe_time_indices': params['keyframe_time_indices'].shape,
    }  # fmt: skip
    assert np.array_equal(params['means3D'], gaussians.means) and np.array_equal(params['log_scales'], gaussians.log_scales)
    for index, T_world_cam in enumerate(poses):
        T_cam_world = se3.compose(params['cam_unnorm_rots'][0, :, index], params['cam_trans'][0, :, index])
        assert np.abs(T_cam_world @ T_world_cam - np.eye(4)).max() < 1e-6
    truth = open_sequence('synthetic', width=WIDTH, max_frames=FRAMES).ground_truth().T_world_cam
    assert np.allclose(params['gt_w2c_all_frames'][0], np.eye(4), atol=1e-6)
    assert np.allclose(params['gt_w2c_all_frames'][-1], se3.inverse(truth[FRAMES - 1]) @ truth[0], atol=1e-5)
    keyframes = [index for index, frame in enumerate(run.frames) if frame.is_keyframe]
    assert params['keyframe_time_indices'].tolist() == keyframes and keyframes[0] == 0


def test_export_refuses_what_it_cannot_write(run: RunRecord, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / 'there.ply').write_text('mine')
    for file, message in (
        ('map.obj', "'.obj' files are not written"),
        ('there.ply', 'or replace it with --overwrite'),
        ('no/map.ply', 'cannot be written'),
        ('no/map.splat', 'cannot be written'),
    ):
        assert splatam('export', run.path, tmp_path / file) == 2
        assert message in capsys.readouterr().err
    assert splatam('export', run.path, tmp_path / 'm.splat', '--sh-degree', 3) == 2
    assert '--sh-degree is for .ply files' in capsys.readouterr().err
    assert splatam('export', run.path / 'map.ply', tmp_path / 'm.npz', '--as', 'splatam') == 2
    assert 'needs a run folder' in capsys.readouterr().err
    assert splatam('export', run.path, tmp_path / 'p.ply', '--as', 'points', '--min-opacity', 0.999) == 2
    assert 'is at least 0.999 opaque' in capsys.readouterr().err
    assert (tmp_path / 'there.ply').read_text() == 'mine'
    assert splatam('export', run.path, tmp_path / 'there.ply', '--overwrite') == 0
