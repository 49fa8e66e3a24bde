"""Run folders: written line by line, never overwritten by accident, and read back completely."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import resource
import signal
import subprocess
import sys
import textwrap
import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from splatam_core.atomic_io import new_folder
from splatam_core.cli import main
from splatam_core.config import load_config
from splatam_core.errors import RunFolderError
from splatam_core.geometry import se3
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.maps.ply import read_ply
from splatam_core.runs import provenance
from splatam_core.runs.frame_records import CSV_HEADER, FrameRecord
from splatam_core.runs.layout import check_is_free
from splatam_core.runs.metrics import MAX_TIMINGS, FrameStatistics, Metrics, StageStatistics, run_metrics
from splatam_core.runs.record import RunDescription, Source, read_run
from splatam_core.runs.writer import RunFolder
from splatam_core.slam import Slam
from splatam_core.types import FrameResult, PoseCovariance, RgbdFrame, StageTimings, Status

CAMERA = PinholeCamera(48, 36, 40.0, 40.0, 23.5, 17.5)
CONFIG = load_config('quick', ['threads=1', 'tracking.iterations=3', 'mapping.iterations=2'])
NODE = RunDescription('splatam_node', 'quick')
OFFLINE = RunDescription('splatam run', 'quick', Source('/data/room', width=48, rgb='/camera/rgb'))
STEP_NS = 33_333_333


def frame(index: int) -> RgbdFrame:
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    rgb = np.stack([u * 5, v * 7, (u + v) * 3 % 255], axis=-1).astype(np.uint8)
    return RgbdFrame(10**18 + index * STEP_NS, rgb, np.full(u.shape, 1.5, np.float32), CAMERA)


def result(index: int, status: Status = Status.TRACKED, total_ms: float = 10.0) -> FrameResult:
    pose = None if status is Status.LOST else se3.exp(np.array([0.01, 0.02, -0.01, 0.1, 0, 0.05]) * index)
    reason = 'too few inliers, "bad"' if pose is None else ''
    timings = StageTimings(track=total_ms * 0.6, map=total_ms * 0.4, total=total_ms)
    stamp_ns = 10**18 + index * STEP_NS
    return FrameResult(index, stamp_ns, status, pose, index % 2 == 0, 100 + index, 0.9, 0.8, reason, timings)


def tree(path: Path) -> dict[str, bytes]:
    return {str(entry.relative_to(path)): entry.read_bytes() for entry in path.rglob('*') if entry.is_file()}


def test_every_frame_is_one_line_that_is_there_at_once(tmp_path: Path) -> None:
    with RunFolder.create(tmp_path / 'run', CONFIG, NODE) as folder:
        for index, status in enumerate([Status.INITIALIZED, Status.TRACKED, Status.LOST, Status.TRACKED]):
            folder.append(frame(index), result(index, status), 0.01)
            assert len((tmp_path / 'run' / 'trajectory.txt').read_text().splitlines()) == index + 1
            assert len((tmp_path / 'run' / 'frames.csv').read_text().splitlines()) == index + 2
    lines = (tmp_path / 'run' / 'trajectory.txt').read_text().splitlines()
    assert lines[0] == '1000000000.000000000' + ' 0.000000000' * 6 + ' 1.000000000'
    assert lines[2] == '# lost 1000000000.066666666'


def test_what_was_written_is_read_back(tmp_path: Path) -> None:
    results = [result(0, Status.INITIALIZED), result(1), result(2, Status.LOST), result(3)]
    with RunFolder.create(tmp_path, CONFIG, OFFLINE) as folder:  # an empty folder may be there
        for index, entry in enumerate(results):
            folder.append(frame(index), entry, 0.25, 0.5 if index else 0.125)
    run = read_run(tmp_path)
    assert (run.config, run.description, run.camera) == (CONFIG, OFFLINE, CAMERA)
    assert run.trajectory.stamps_ns.tolist() == [results[index].stamp_ns for index in (0, 1, 3)]
    for index, pose in zip((0, 1, 3), run.trajectory.T_world_cam):
        np.testing.assert_allclose(pose, results[index].T_world_cam, atol=3e-9)  # nine decimals
    assert run.lost_ns == (results[2].stamp_ns,)
    assert [record.status for record in run.frames] == [entry.status for entry in results]
    assert [record.is_keyframe for record in run.frames] == [True, False, True, False]
    assert run.frames[2].reason == results[2].reason
    assert (run.frames[0].process_ms, run.frames[0].decode_ms) == (250, 125)
    assert run.frames[1].timings == results[1].timings


def uncertain(index: int) -> FrameResult:
    """An uncertain frame, and a covariance of which no two entries are equal."""
    root = np.random.default_rng(index).normal(size=(6, 6))
    covariance = PoseCovariance(1e-4 * root @ root.T, 0.01 * index, 0.02 * index)
    return dataclasses.replace(result(index), status=Status.UNCERTAIN, reason='too far', covariance=covariance, num_held=2)


def test_verdicts_and_covariances_are_read_back_and_counted(tmp_path: Path) -> None:
    results = [result(0, Status.INITIALIZED), result(1), uncertain(2), result(3, Status.LOST), uncertain(4)]
    with RunFolder.create(tmp_path, CONFIG, OFFLINE) as folder:
        for index, entry in enumerate(results):
            folder.append(frame(index), entry, 0.25, 0.125)
        metrics = folder.save(Slam(CONFIG))
    assert (metrics.tracked, metrics.uncertain, metrics.lost) == (2, 2, 1)
    run = read_run(tmp_path)
    assert [record.status for record in run.frames] == [entry.status for entry in results]
    assert [record.num_held for record in run.frames] == [0, 0, 2, 0, 2]
    assert run.covariances().keys() == {results[2].stamp_ns, results[4].stamp_ns}
    for entry in (results[2], results[4]):
        found, expected = run.covariances()[entry.stamp_ns], entry.covariance
        np.testing.assert_allclose(found.total, expected.total, rtol=1e-5)  # six digits are written
        np.testing.assert_allclose(found.relative, expected.relative, rtol=1e-2, atol=1e-7)
    assert [*run.poses()] == [results[index].stamp_ns for index in (0, 1, 2, 4)]  # an uncertain frame has a pose
    assert [*run.mapped_poses()] == run.tracked_trajectory().stamps_ns.tolist() == [results[0].stamp_ns, results[1].stamp_ns]


def test_a_folder_without_covariances_is_continued_with_them(tmp_path: Path) -> None:
    with RunFolder.create(tmp_path, CONFIG, OFFLINE) as folder:
        for index in range(2):
            folder.append(frame(index), result(index), 0.25, 0.125)
    rows = (tmp_path / 'frames.csv').read_text().splitlines()
    count = CSV_HEADER.index('reason') + 1  # as in 0.1.0
    (tmp_path / 'frames.csv').write_text(''.join(','.join(row.split(',')[:count]) + '\n' for row in rows))
    with RunFolder.reopen(tmp_path, 2, result(1).stamp_ns) as folder:
        folder.append(frame(2), uncertain(2), 0.25, 0.125)
    frames = read_run(tmp_path).frames
    assert [record.covariance is None for record in frames] == [True, True, False] and frames[2].num_held == 2


def test_frames_of_an_older_version_are_read(tmp_path: Path) -> None:
    with RunFolder.create(tmp_path, CONFIG, OFFLINE) as folder:
        folder.append(frame(0), result(0, Status.INITIALIZED), 0.25, 0.125)
    frames = tmp_path / 'frames.csv'
    frames.write_text(frames.read_text().replace('visible_fraction', 'sure_fraction'))
    assert read_run(tmp_path).frames[0].visible_fraction == result(0, Status.INITIALIZED).visible_fraction


def test_run_json_says_what_ran_where(tmp_path: Path) -> None:
    RunFolder.create(tmp_path, CONFIG, OFFLINE).close()
    information = json.loads((tmp_path / 'run.json').read_text())
    assert information['program'] == 'splatam run' and information['source']['path'] == '/data/room'
    assert information['camera'] is None  # no frame yet
    assert {'system', 'processor', 'cores', 'memory_mb', 'gpu'} == information['machine'].keys()
    assert 'rasterizer' in information['backend']
    assert information['versions']['torch'] and information['versions']['python']
    assert information['commit'] == provenance.commit()
    assert re.fullmatch(r'\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\+00:00', information['started'])


def test_commit_is_the_repository_s_or_unknown() -> None:
    root = Path(__file__).resolve().parents[2]
    git = subprocess.run(['git', '-C', root, 'rev-parse', 'HEAD'], capture_output=True, text=True)
    tracked = subprocess.run(['git', '-C', root, 'ls-files', '--error-unmatch', provenance.__file__], capture_output=True)
    expected = git.stdout.strip() if git.returncode == tracked.returncode == 0 else None
    commit = provenance.commit()
    assert (None if commit is None else commit.removesuffix('-dirty')) == expected


def test_finish_saves_map_and_metrics(tmp_path: Path) -> None:
    slam = Slam(CONFIG)
    folder = RunFolder.create(tmp_path, CONFIG, NODE)
    folder.append(frame(0), slam.process(frame(0)), 0.5)
    early = folder.save(slam)  # as the node's save service does
    assert early.frames == 1 and (tmp_path / 'map.ply').exists()
    folder.append(frame(1), slam.process(frame(1)), 0.5)
    metrics = folder.finish(slam)
    assert len(read_ply(tmp_path / 'map.ply').means) == slam.num_gaussians == metrics.num_gaussians > 0
    assert Metrics.from_json((tmp_path / 'metrics.json').read_text()) == metrics == read_run(tmp_path).metrics()
    assert (metrics.frames, metrics.tracked, metrics.fps, metrics.fps_with_io) == (2, 2, 2.0, None)
    written = json.loads((tmp_path / 'metrics.json').read_text())
    unknown = 'ate_rmse_m', 'psnr_db', 'ssim', 'depth_l1_m', 'psnr_full_db'
    assert {name: written[name] for name in unknown} == dict.fromkeys(unknown)
    assert 10 < metrics.peak_rss_mb < 100_000
    with pytest.raises(ValueError, match='closed'):
        folder.append(frame(2), result(2), 0.1)


def test_a_run_without_frames_is_saved_too(tmp_path: Path) -> None:
    metrics = RunFolder.create(tmp_path, CONFIG, NODE).finish(Slam(CONFIG))
    assert (metrics.frames, metrics.tracked, metrics.fps, metrics.timings_ms) == (0, 0, None, {})
    run = read_run(tmp_path)
    assert len(run.trajectory) == 0 and run.camera is None and run.metrics() == metrics


def test_metrics_by_hand(tmp_path: Path) -> None:
    with RunFolder.create(tmp_path, CONFIG, OFFLINE) as folder:
        for index in range(5):
            status = Status.LOST if index == 3 else Status.TRACKED
            folder.append(frame(index), result(index, status, total_ms=10.0 * (index + 1)), 0.2, 0.05)
    metrics = run_metrics(read_run(tmp_path).frames, None, None)
    assert (metrics.frames, metrics.tracked, metrics.lost) == (5, 4, 1)
    assert (metrics.fps, metrics.fps_with_io) == (5.0, 4.0)  # 5 / 1 s, 5 / 1.25 s
    # 10 20 30 40 50: the middle one, and 95 % of the way along their four steps.
    assert metrics.timings_ms['total'] == StageStatistics(median=30.0, p95=48.0)
    assert metrics.timings_ms['track'] == StageStatistics(median=18.0, p95=28.8)


def test_damaged_metrics_are_one_line(tmp_path: Path) -> None:
    RunFolder.create(tmp_path, CONFIG, NODE).finish(Slam(CONFIG))
    for text in ('{', '[]', '{}', '{"frames": 1}', '{"timings_ms": {"track": 3}}'):
        (tmp_path / 'metrics.json').write_text(text)
        with pytest.raises(RunFolderError, match=r'metrics\.json cannot be read'):
            read_run(tmp_path).metrics()


def test_existing_results_stay(tmp_path: Path) -> None:
    RunFolder.create(tmp_path, CONFIG, NODE).close()
    before = tree(tmp_path)
    with pytest.raises(RunFolderError, match='exists: choose another folder, or replace the run in it with --overwrite'):
        RunFolder.create(tmp_path, CONFIG, OFFLINE)
    assert tree(tmp_path) == before


def test_only_what_can_overwrite_a_run_says_how(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = written(RunFolder.create(tmp_path / 'run', CONFIG, NODE), 0)
    other = written(RunFolder.create(tmp_path / 'other', CONFIG, NODE), 0)
    with pytest.raises(RunFolderError, match='exists: choose another folder') as caught:
        other.moved(tmp_path / 'run')
    run.close()
    other.close()
    assert main(['merge', str(tmp_path / 'run'), str(tmp_path / 'run'), '--out', str(tmp_path / 'other')]) == 2
    for text in (str(caught.value), capsys.readouterr().err):
        assert 'exists: choose another folder' in text and '--overwrite' not in text


def test_overwrite_removes_a_run_and_nothing_else(tmp_path: Path) -> None:
    run = tmp_path / 'run'
    with RunFolder.create(run, CONFIG, NODE) as folder:
        folder.append(frame(0), result(0), 0.1)
    keyframes = run / 'checkpoints' / 'keyframes'
    keyframes.mkdir(parents=True)
    for path in (
        run / 'checkpoints' / '000040.checkpoint',
        keyframes / f'{"0" * 64}.keyframe',
        keyframes / f'.{"a" * 64}.keyframe.77',
    ):
        path.touch()
    (run / '.map.ply.4242').touch()  # left by a writer that was killed
    RunFolder.create(run, CONFIG, OFFLINE, overwrite=True).close()
    assert read_run(run).description == OFFLINE and len(read_run(run).trajectory) == 0
    assert not (run / 'checkpoints').exists() and not (run / '.map.ply.4242').exists()

    (run / 'thesis.tex').write_text('years of work')
    before = tree(run)
    with pytest.raises(RunFolderError, match=r'more than a run \(thesis\.tex\)'):
        RunFolder.create(run, CONFIG, NODE, overwrite=True)
    assert tree(run) == before


@pytest.mark.parametrize(
    'name',
    [
        'checkpoints/thesis.tex', 'checkpoints/1', 'checkpoints/keyframes/holiday.jpg', 'keyframes/000001.keyframe',
        'previous/notes.txt', 'previous/checkpoints/000001.checkpoint', 'map.ply/inside', '.map.ply.old', 'config.yaml.bak',
    ],
)  # fmt: skip
def test_overwrite_refuses_what_no_run_writes_wherever_it_is(tmp_path: Path, name: str) -> None:
    RunFolder.create(tmp_path, CONFIG, NODE).close()
    (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / name).write_text('years of work')
    before = tree(tmp_path)
    with pytest.raises(RunFolderError, match='more than a run') as caught:
        RunFolder.create(tmp_path, CONFIG, NODE, overwrite=True)
    assert name.split('/')[0] in str(caught.value) and tree(tmp_path) == before


@pytest.mark.parametrize(
    'text', ['', '{', '[]', '{}', '{"program": "npm run"}', '{"program": "splatam run"}', 'null', '\0', '[' * 10000]
)
def test_overwrite_refuses_a_run_json_of_another_program(tmp_path: Path, text: str) -> None:
    (tmp_path / 'run.json').write_text(text)
    (tmp_path / 'checkpoints').mkdir()
    (tmp_path / 'checkpoints' / '000001.checkpoint').write_text('weights of a month of training')
    before = tree(tmp_path)
    with pytest.raises(RunFolderError, match='holds no run'):
        RunFolder.create(tmp_path, CONFIG, NODE, overwrite=True)
    assert tree(tmp_path) == before


@pytest.mark.parametrize('overwrite', [False, True])
def test_a_folder_that_is_being_written_is_not_taken(tmp_path: Path, overwrite: bool) -> None:
    """Neither by another process nor by another run of this one; nor is it resumed. It is free again when the writer has ended."""
    writer = """
import sys
from pathlib import Path
from splatam_core.config import load_config
from splatam_core.runs.record import RunDescription
from splatam_core.runs.writer import RunFolder
run = RunFolder.create(Path(sys.argv[1]), load_config('quick'), RunDescription('splatam_node'))
print('writes', flush=True)
input()
"""
    with subprocess.Popen([sys.executable, '-c', writer, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stdout.readline() == b'writes\n'
        with pytest.raises(RunFolderError, match='is in use' if overwrite else 'exists'):
            RunFolder.create(tmp_path, CONFIG, NODE, overwrite=overwrite)
        with pytest.raises(RunFolderError, match='is in use'):
            RunFolder.reopen(tmp_path, 0, None)
        process.kill()
    run = RunFolder.create(tmp_path, CONFIG, NODE, overwrite=True)
    with pytest.raises(RunFolderError, match='is in use'):
        RunFolder.create(tmp_path, CONFIG, NODE, overwrite=True)
    restarted = written(run, 0).restarted(CONFIG)
    with pytest.raises(RunFolderError, match='is in use'):
        RunFolder.create(tmp_path, CONFIG, NODE, overwrite=True)
    restarted.close()
    RunFolder.create(tmp_path, CONFIG, NODE, overwrite=True).close()


def test_overwrite_follows_no_link_out_of_the_folder(tmp_path: Path) -> None:
    elsewhere, run = tmp_path / 'elsewhere', tmp_path / 'run'
    (elsewhere / 'checkpoints').mkdir(parents=True)
    (elsewhere / 'checkpoints' / '000001.checkpoint').write_text('of another run')
    (elsewhere / 'map.ply').write_text('of another run')
    for name in ('checkpoints', 'map.ply'):
        RunFolder.create(run, CONFIG, NODE, overwrite=run.exists()).close()
        (run / name).symlink_to(elsewhere / name)
        before = tree(elsewhere)
        with pytest.raises(RunFolderError, match=f'more than a run \\({name}\\)'):
            RunFolder.create(run, CONFIG, NODE, overwrite=True)
        assert tree(elsewhere) == before
        (run / name).unlink()


def test_overwrite_replaces_a_run_behind_a_link(tmp_path: Path) -> None:
    run, link = tmp_path / 'run', tmp_path / 'latest'
    written(RunFolder.create(run, CONFIG, NODE), 0).close()
    link.symlink_to(run)
    RunFolder.create(link, CONFIG, OFFLINE, overwrite=True).close()
    assert link.is_symlink() and read_run(run).description == OFFLINE and len(read_run(link).frames) == 0


def test_a_link_to_nowhere_is_said_in_one_line(tmp_path: Path) -> None:
    (tmp_path / 'link').symlink_to(tmp_path / 'nowhere')
    for overwrite in (False, True):
        with pytest.raises(RunFolderError, match='exists: choose another folder'):
            RunFolder.create(tmp_path / 'link', CONFIG, NODE, overwrite=overwrite)


def test_what_a_killed_process_of_the_same_number_left_is_replaced(tmp_path: Path) -> None:
    for name in ('new', 'moved'):
        (tmp_path / f'.{name}.{os.getpid()}').mkdir()
        (tmp_path / f'.{name}.{os.getpid()}' / 'cut.png').touch()
    with new_folder(tmp_path / 'new') as folder:
        (folder / 'whole.png').touch()
    folder = written(RunFolder.create(tmp_path / 'run', CONFIG, NODE), 0).moved(tmp_path / 'moved')
    folder.close()
    assert {path.name for path in tmp_path.iterdir()} == {'new', 'run', 'moved'}
    assert [path.name for path in (tmp_path / 'new').iterdir()] == ['whole.png'] and len(read_run(tmp_path / 'moved').frames) == 1


def test_a_reset_leaves_what_others_put_into_previous(tmp_path: Path) -> None:
    folder = written(RunFolder.create(tmp_path, CONFIG, NODE), 0).restarted(CONFIG)
    (tmp_path / 'previous' / 'notes.txt').write_text('mine')
    written(written(folder, 1).restarted(CONFIG), 2).close()
    assert (tmp_path / 'previous' / 'notes.txt').read_text() == 'mine'
    assert len(read_run(tmp_path / 'previous').frames) == 1


@pytest.mark.parametrize('path', ['x' * 300, 'a/' * 3000, 'a\0b'])
def test_impossible_paths_are_one_line(tmp_path: Path, path: str) -> None:
    for use in (lambda p: RunFolder.create(p, CONFIG, NODE), lambda p: RunFolder.create(p, CONFIG, NODE, overwrite=True),
                read_run, check_is_free):  # fmt: skip
        with pytest.raises(RunFolderError) as caught:
            use(tmp_path / path)
        assert '\n' not in str(caught.value) and 'None' not in str(caught.value)


@pytest.mark.parametrize('overwrite', [False, True])
def test_other_folders_and_files_stay(tmp_path: Path, overwrite: bool) -> None:
    (tmp_path / 'photos').mkdir()
    (tmp_path / 'photos' / 'cat.jpg').write_bytes(b'meow')
    (tmp_path / 'file').write_bytes(b'text')
    before = tree(tmp_path)
    for name in ('photos', 'file', 'file/below'):
        with pytest.raises(RunFolderError, match='choose another folder'):
            RunFolder.create(tmp_path / name, CONFIG, NODE, overwrite=overwrite)
    assert tree(tmp_path) == before


def test_no_run_folder_and_damaged_ones_are_one_line(tmp_path: Path) -> None:
    with pytest.raises(RunFolderError, match=r'is no run folder: it has no trajectory\.txt, config\.yaml, run\.json'):
        read_run(tmp_path)
    RunFolder.create(tmp_path, CONFIG, NODE).close()
    for name, text in (
        ('run.json', '{'), ('run.json', '{}'), ('config.yaml', 'tracking: {iteratons: 3}'),
        ('trajectory.txt', '# lost soon\n'), ('trajectory.txt', '1 2 3\n'), ('frames.csv', 'stamp\n1\n'),
    ):  # fmt: skip
        good = (tmp_path / name).read_bytes()
        (tmp_path / name).write_text(text)
        with pytest.raises(RunFolderError, match='cannot be read') as caught:
            read_run(tmp_path)
        assert '\n' not in str(caught.value)
        (tmp_path / name).write_bytes(good)
    read_run(tmp_path)


def test_kill_loses_nothing_written(tmp_path: Path) -> None:
    script = """
        import os, signal, sys
        from pathlib import Path
        from test_run_folder import CONFIG, NODE, RunFolder, frame, result
        folder = RunFolder.create(Path(sys.argv[1]), CONFIG, NODE)
        for index in range(7):
            folder.append(frame(index), result(index), 0.1)
        os.kill(os.getpid(), signal.SIGKILL)
    """
    path = os.pathsep.join([str(Path(__file__).parent), str(Path(__file__).parents[2])])
    done = subprocess.run(
        [sys.executable, '-c', textwrap.dedent(script), str(tmp_path / 'run')], env=os.environ | {'PYTHONPATH': path}
    )
    assert done.returncode == -signal.SIGKILL
    run = read_run(tmp_path / 'run')
    assert len(run.trajectory) == len(run.frames) == run.metrics().frames == 7
    assert run.metrics().num_gaussians is None


@pytest.mark.parametrize('torn', ['1000000000.1 0.5 0.', '1', '# lost 10000', '\0' * 40, '', '1000000001.0 0 0 0 0 0 0 1'])
def test_a_torn_last_line_is_left_out_and_said(tmp_path: Path, torn: str, caplog: pytest.LogCaptureFixture) -> None:
    written(RunFolder.create(tmp_path, CONFIG, NODE), 0, 1, 2).close()
    whole = read_run(tmp_path)
    for name in ('trajectory.txt', 'frames.csv'):
        with (tmp_path / name).open('a') as file:
            file.write(torn)
    with caplog.at_level('WARNING'):
        run = read_run(tmp_path)
    assert run.stamps_ns() == whole.stamps_ns() and run.frames == whole.frames and run.metrics() == whole.metrics()
    assert [record.message.partition(': ')[2] for record in caplog.records] == (
        ['its last line is incomplete and left out: was the writer stopped by force?'] * (2 if torn else 0)
    )


@pytest.mark.parametrize('longer', ['trajectory.txt', 'frames.csv'])
@pytest.mark.parametrize('count', [0, 2])
def test_a_frame_that_only_one_file_has_is_left_out_and_said(
    tmp_path: Path, longer: str, count: int, caplog: pytest.LogCaptureFixture
) -> None:
    """A writer that is killed between the two lines of a frame used to leave a run whose counts differ."""
    written(RunFolder.create(tmp_path, CONFIG, NODE), *range(count)).close()
    expected = read_run(tmp_path)
    shorter = {'trajectory.txt', 'frames.csv'}.difference([longer]).pop()
    kept = (tmp_path / shorter).read_text()
    written(RunFolder(tmp_path), count).close()
    (tmp_path / shorter).write_text(kept)
    run = read_run(tmp_path)
    assert run.stamps_ns() == expected.stamps_ns() and run.frames == expected.frames and run.metrics() == expected.metrics()
    assert 'the last 1 frames are in one of trajectory.txt and frames.csv only, and left out' in caplog.text


def test_a_line_that_is_torn_in_the_middle_is_one_line(tmp_path: Path) -> None:
    written(RunFolder.create(tmp_path, CONFIG, NODE), 0, 1).close()
    with (tmp_path / 'trajectory.txt').open('a') as file:
        file.write('1000000000.1 0.5\n')
    with pytest.raises(RunFolderError, match=r'trajectory\.txt:3: expected'):
        read_run(tmp_path)


@contextmanager
def full_disk() -> Iterator[None]:
    """No file may grow beyond one byte."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_disk_that_is_full_at_the_first_frames_costs_no_frame_once_there_is_room(tmp_path: Path) -> None:
    """The camera used to be lost for good: no command could use the run."""
    folder = RunFolder.create(tmp_path, CONFIG, NODE)
    with full_disk():
        for index in range(3):
            with pytest.raises(OSError, match='too large'):
                folder.append(frame(index), result(index), 0.01)
    written(folder, 3).close()
    run = read_run(tmp_path)
    assert run.camera == CAMERA and len(run.frames) == len(run.trajectory) == 4
    assert run.stamps_ns() == [result(index).stamp_ns for index in range(4)]


@pytest.mark.slow
def test_a_disk_that_stays_full_loses_whole_frames_and_bounds_the_memory(tmp_path: Path) -> None:
    folder = RunFolder.create(tmp_path, CONFIG, NODE)
    with full_disk():
        refused = 0
        for index in range(20_000):
            try:
                folder.append(frame_of_a_pixel(index), result(index, Status.LOST), 0.01)
            except OSError:
                refused += 1
        assert refused == 20_000 and folder.num_frames < 20_000
        kept = folder.num_frames
    folder.append(frame_of_a_pixel(20_000), result(20_000), 0.01)
    folder.close()
    run = read_run(tmp_path)
    assert len(run.frames) == len(run.stamps_ns()) == kept + 1


def test_a_disk_that_is_full_at_the_end_closes_the_files(tmp_path: Path) -> None:
    folder = RunFolder.create(tmp_path, CONFIG, NODE)
    with full_disk():
        with pytest.raises(OSError, match='too large'):
            folder.append(frame(0), result(0), 0.01)
        with pytest.raises(OSError, match='too large'):
            folder.close()
    folder.close()
    assert len(read_run(tmp_path).frames) == 0


def frame_of_a_pixel(index: int) -> RgbdFrame:
    return RgbdFrame(10**18 + index * STEP_NS, np.zeros((1, 1, 3), np.uint8), np.ones((1, 1), np.float32), CAMERA)


def result_of_day(index: int) -> FrameResult:
    pose = np.eye(4) if index % 100 == 0 else None
    status = Status.LOST if pose is None else Status.TRACKED
    timings = StageTimings(total=float(index % 1000))
    return FrameResult(index, 10**18 + index * STEP_NS, status, pose, False, 100 + index, 0.9, 0.8, '', timings)


@pytest.mark.slow
def test_the_last_of_a_million_frames_take_no_memory(tmp_path: Path) -> None:
    """Nine hours at 30 Hz; a list of records would take 500 MB. Of the traced frames, even a list of numbers takes 200 kB.

    The first are only counted: their lines would take most of the time, and how long a file is costs no memory.
    """
    folder, some = RunFolder.create(tmp_path, CONFIG, NODE), frame_of_a_pixel(0)
    records = [FrameRecord.of(result_of_day(index), 0.01, None) for index in range(1000)]  # then they repeat
    for _ in range(970):
        for record in records:
            folder._statistics.add(record)
    for index in range(970_000, 1_000_001):
        folder.append(some, result_of_day(index), 0.01)
        if index == 975_000:
            tracemalloc.start()
    grown = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    metrics = folder._statistics.metrics()
    folder.close()
    assert grown < 1 << 16
    assert (metrics.frames, metrics.lost, metrics.fps) == (1_000_001, 990_000, 100.0)
    assert metrics.timings_ms['total'].median == pytest.approx(499.5, abs=5)
    assert metrics.timings_ms['total'].p95 == pytest.approx(949, abs=5)


@pytest.mark.slow
@pytest.mark.parametrize('count', [1, MAX_TIMINGS - 1, MAX_TIMINGS, 3 * MAX_TIMINGS + 5])
def test_percentiles_are_exact_up_to_a_number_of_frames_and_close_beyond(count: int) -> None:
    rng, statistics = np.random.default_rng(0), FrameStatistics()
    total = rng.exponential(10.0, count)
    for value in total:
        statistics.add(FrameRecord(0, Status.TRACKED, False, 0, 0.0, 0.0, 1.0, None, StageTimings(total=float(value)), ''))
    stage = statistics.metrics().timings_ms['total']
    exact = count <= MAX_TIMINGS
    assert stage.median == pytest.approx(np.percentile(total, 50), rel=1e-9 if exact else 0.02, abs=6e-4)
    assert stage.p95 == pytest.approx(np.percentile(total, 95), rel=1e-9 if exact else 0.02, abs=6e-4)
    assert statistics.metrics().frames == count


def written(folder: RunFolder, *indices: int) -> RunFolder:
    for index in indices:
        folder.append(frame(index), result(index), 0.01)
    return folder


def test_a_run_begun_anew_keeps_the_one_before(tmp_path: Path) -> None:
    folder = written(RunFolder.create(tmp_path, CONFIG, NODE), 0, 1)
    other = load_config('quick', ['tracking.iterations=7'])
    folder = written(folder.restarted(other), 5)
    before, now = read_run(tmp_path / 'previous'), read_run(tmp_path)
    assert (len(before.trajectory), len(now.trajectory)) == (2, 1)
    assert (before.config, now.config) == (CONFIG, other)
    assert before.description == now.description == NODE and now.camera == before.camera
    written(folder.restarted(CONFIG), 7, 8, 9).close()  # only the last of the previous runs is kept
    assert (len(read_run(tmp_path / 'previous').trajectory), len(read_run(tmp_path).trajectory)) == (1, 3)
    RunFolder.create(tmp_path, CONFIG, NODE, overwrite=True).close()  # all its files belong to a run
    assert not (tmp_path / 'previous').exists()


def test_a_disk_that_is_full_when_a_run_begins_anew_changes_nothing(tmp_path: Path) -> None:
    """The files used to be closed, and nothing could be recorded any more."""
    folder = written(RunFolder.create(tmp_path, CONFIG, NODE), 0, 1)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with full_disk(), pytest.raises(RunFolderError, match='a new run cannot begin: File too large'):
        folder.restarted(CONFIG)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.is_file()} == before
    folder = written(written(folder, 2).restarted(CONFIG), 3)
    folder.close()
    assert [len(read_run(path).frames) for path in (tmp_path / 'previous', tmp_path)] == [3, 1]
    assert not list(tmp_path.rglob('.*'))


def test_a_run_goes_on_in_another_folder_with_all_that_was_written(tmp_path: Path) -> None:
    first, second = tmp_path / 'a', tmp_path / 'b' / 'c'
    second.parent.mkdir()
    folder = written(RunFolder.create(first, CONFIG, NODE), 0, 1).moved(second)
    written(folder, 2).close()
    assert (len(read_run(first).frames), len(read_run(second).frames)) == (2, 3)
    assert len(read_run(second).trajectory) == 3


def test_a_run_does_not_move_where_something_is(tmp_path: Path) -> None:
    folder = written(RunFolder.create(tmp_path / 'a', CONFIG, NODE), 0)
    (tmp_path / 'b').mkdir()
    (tmp_path / 'b' / 'thesis.tex').touch()
    with pytest.raises(RunFolderError, match='choose another folder'):
        folder.moved(tmp_path / 'b')
    with pytest.raises(RunFolderError, match='cannot be written'):
        folder.moved(tmp_path / 'b' / 'thesis.tex' / 'c')
    written(folder, 1).close()  # and it continues where it is
    assert len(read_run(tmp_path / 'a').trajectory) == 2
