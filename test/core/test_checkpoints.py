"""Checkpoints: a resumed run ends like an uninterrupted one; damaged files are refused, and nothing in them is executed."""

from __future__ import annotations

import hashlib
import io
import json
import os
import pickle
import resource
import shutil
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from processes import run_code

from splatam_core import cli
from splatam_core.commands.shared import open_source
from splatam_core.config import load_config
from splatam_core.datasets.registry import open_sequence
from splatam_core.errors import CheckpointError
from splatam_core.runs import checkpoints, resume
from splatam_core.runs.archive import Content, pack, read_archive
from splatam_core.runs.checkpoints import Checkpoints, Progress, checkpoint_paths, read_checkpoint, read_newest
from splatam_core.runs.record import read_run
from splatam_core.slam import Slam
from splatam_core.state import SlamState

ROOT = Path(__file__).resolve().parents[2]
WIDTH, FRAMES, EVERY = 64, 8, 3
SOURCE = ['synthetic:noise=off', '--width', str(WIDTH), '--max-frames', str(FRAMES)]
PRESETS = ('quick', 'splatam', 'realtime')
FAST = ['threads=1', 'mapping.iterations=6', 'keyframes.every=2', 'keyframes.window=3']
ITERATIONS = {'quick': 6, 'splatam': 8, 'realtime': 6}
MEASURED = {'fps', 'fps_with_io', 'timings_ms', 'finish_s', 'peak_rss_mb', 'peak_gpu_mb'}  # wall times, and memory of the process
PROGRESS = Progress(FRAMES, 3, '0' * 64, 4)


def settings(preset: str) -> list[str]:
    return [*FAST, f'tracking.iterations={ITERATIONS[preset]}']


def arguments(preset: str, out: Path, *more: object) -> list[str]:
    changed = [word for setting in settings(preset) for word in ('--set', setting)]
    return ['run', *SOURCE, '--preset', preset, *changed, '--no-evaluate', '--out', str(out), *map(str, more)]


def splatam(*words: object) -> int:
    return cli.main([str(word) for word in words])


def result(folder: Path) -> tuple[bytes, bytes, dict[str, object]]:
    metrics = json.loads((folder / 'metrics.json').read_text())
    kept = {name: value for name, value in metrics.items() if name not in MEASURED}
    return (folder / 'trajectory.txt').read_bytes(), (folder / 'map.ply').read_bytes(), kept


def tree(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob('*') if path.is_file()}


@pytest.fixture(scope='module')
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Uninterrupted runs without checkpoints, by preset; tests must not change them."""
    folder = tmp_path_factory.mktemp('whole')
    for preset in PRESETS:
        assert splatam(*arguments(preset, folder / preset)) == 0
    return {preset: folder / preset for preset in PRESETS}


@pytest.fixture(scope='module')
def broken_off(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run that was killed one frame after its second checkpoint; tests must not change it."""
    folder = tmp_path_factory.mktemp('killed') / 'run'
    killed_after(7, arguments('quick', folder, '--checkpoint-every', EVERY), folder.with_suffix('.log'))
    return folder


@pytest.fixture
def run(broken_off: Path, tmp_path: Path) -> Path:
    """A copy of ``broken_off`` that a test may change."""
    return Path(shutil.copytree(broken_off, tmp_path / 'run'))


@pytest.fixture(scope='module')
def state() -> SlamState:
    """The state of Slam after four frames."""
    slam, frames = Slam(load_config('quick', settings('quick'))), open_sequence(SOURCE[0], width=WIDTH, max_frames=4)
    for index in range(len(frames)):
        slam.process(frames[index])
    return slam.state()


def killed_after(frames: int, words: list[str], log: Path) -> None:
    """Runs the command line in a process that is killed as soon as its folder has this many frames."""
    code = """
        import os, signal, sys
        from splatam_core import cli
        from splatam_core.runs.writer import RunFolder

        append = RunFolder.append

        def append_and_die(folder, *arguments):
            append(folder, *arguments)
            if folder.num_frames == int(sys.argv[1]):
                os.kill(os.getpid(), signal.SIGKILL)

        RunFolder.append = append_and_die
        sys.exit(cli.main(sys.argv[2:]))
    """
    process = run_code(code, frames, *words, log=log)
    assert process.wait() == -signal.SIGKILL, process.text


# --- resuming ---


@pytest.mark.slow
@pytest.mark.parametrize('preset', PRESETS)
def test_a_run_that_was_killed_ends_as_if_it_had_not_been(preset: str, whole: dict[str, Path], tmp_path: Path) -> None:
    killed_after(5, arguments(preset, tmp_path / 'run', '--checkpoint-every', EVERY), tmp_path / 'log')
    assert len((tmp_path / 'run' / 'trajectory.txt').read_text().splitlines()) == 5  # two after the checkpoint
    assert splatam('run', '--resume', tmp_path / 'run', '--no-evaluate') == 0
    assert result(tmp_path / 'run') == result(whole[preset])
    assert len(read_run(whole[preset]).trajectory) >= FRAMES - 2  # otherwise they might agree because all frames are lost
    assert len(read_run(tmp_path / 'run').frames) == FRAMES


def test_writing_checkpoints_changes_nothing(whole: dict[str, Path], tmp_path: Path) -> None:
    assert splatam(*arguments('quick', tmp_path / 'run', '--checkpoint-every', EVERY)) == 0
    assert result(tmp_path / 'run') == result(whole['quick'])
    assert [path.name for path in checkpoint_paths(tmp_path / 'run' / 'checkpoints')] == [
        '000003.checkpoint', '000006.checkpoint',
    ]  # fmt: skip


@pytest.mark.slow
def test_killed_and_resumed_time_and_again(whole: dict[str, Path], tmp_path: Path) -> None:
    killed_after(4, arguments('quick', tmp_path / 'run', '--checkpoint-every', 2, '--keep-checkpoints', 1), tmp_path / 'log')
    killed_after(7, ['run', '--resume', str(tmp_path / 'run'), '--no-evaluate'], tmp_path / 'log')
    folder = tmp_path / 'run' / 'checkpoints'
    assert [path.name for path in checkpoint_paths(folder)] == ['000006.checkpoint']  # both arguments are kept by the run
    assert splatam('run', '--resume', tmp_path / 'run', '--no-evaluate') == 0
    assert result(tmp_path / 'run') == result(whole['quick'])
    resumed = json.loads((tmp_path / 'run' / 'run.json').read_text())['resumed']
    assert [entry['after_frames'] for entry in resumed] == [2, 6]


def test_ctrl_c_saves_a_checkpoint_of_the_last_frame(
    whole: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    after_frame = resume.CheckpointWriter.after_frame

    def interrupted(writer: resume.CheckpointWriter, index: int, *others: object) -> None:
        after_frame(writer, index, *others)
        if index == 3:
            os.kill(os.getpid(), signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(resume.CheckpointWriter, 'after_frame', interrupted)
        assert splatam(*arguments('quick', tmp_path / 'run', '--checkpoint-every', EVERY)) == cli.EXIT_INTERRUPTED
    assert f"'splatam run --resume {tmp_path / 'run'}' continues" in capsys.readouterr().err
    assert read_newest(tmp_path / 'run' / 'checkpoints').progress.num_lines == 4
    assert splatam('run', '--resume', tmp_path / 'run', '--no-evaluate') == 0
    assert result(tmp_path / 'run') == result(whole['quick'])


@pytest.mark.slow
def test_a_run_from_a_gpu_goes_on_without_one(
    run: Path, whole: dict[str, Path], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The device of a run may change, but only on request."""
    monkeypatch.setattr(torch.cuda, 'is_available', lambda: False)
    config = run / 'config.yaml'
    config.write_text(config.read_text().replace('device: auto', 'device: cuda'))
    assert splatam('run', '--resume', run, '--no-evaluate') == cli.EXIT_ERROR
    assert 'device = cuda' in capsys.readouterr().err
    assert splatam('run', '--resume', run, '--device', 'cpu', '--no-evaluate') == 0
    assert result(run) == result(whole['quick'])
    assert 'device: cpu' in config.read_text()
    assert json.loads((run / 'run.json').read_text())['resumed'][-1]['backend'] == 'device = cpu; rasterizer: cpu'


def test_a_finished_run_may_be_resumed(whole: dict[str, Path], tmp_path: Path) -> None:
    assert splatam(*arguments('quick', tmp_path / 'run', '--checkpoint-every', EVERY)) == 0
    assert splatam('run', '--resume', tmp_path / 'run', '--no-evaluate') == 0
    assert result(tmp_path / 'run') == result(whole['quick'])


def test_the_last_line_may_be_cut_off(run: Path, whole: dict[str, Path]) -> None:
    for name in ('trajectory.txt', 'frames.csv'):
        os.truncate(run / name, (run / name).stat().st_size - 5)
    assert splatam('run', '--resume', run, '--no-evaluate') == 0
    assert result(run) == result(whole['quick'])


def test_map_and_scores_of_frames_to_be_redone_are_removed(run: Path) -> None:
    for name in ('map.ply', 'metrics.json', 'report.png'):
        (run / name).write_text('of more frames')
    resume.resume(run, open_source, lambda config: None, lambda text: None).folder.close()
    assert not any((run / name).exists() for name in ('map.ply', 'metrics.json', 'report.png'))
    assert len(read_run(run).frames) == len((run / 'trajectory.txt').read_text().splitlines()) == 6


# --- state ---


def test_state_is_read_back_as_it_was(state: SlamState, tmp_path: Path) -> None:
    path = Checkpoints(tmp_path, 2).save(state, PROGRESS)
    read = read_checkpoint(path)
    assert read.progress == PROGRESS
    for name in ('config', 'camera', 'rng', 'scene_radius', 'num_frames', 'last_stamp_ns'):
        assert getattr(read.state, name) == getattr(state, name), name
    assert state.map.keys() == read.state.map.keys() >= {'means', 'rgb', 'first_second', 'steps', 'bounds'}
    for name, array in state.map.items():
        np.testing.assert_array_equal(read.state.map[name], array, strict=True)
    assert len(read.state.keyframes) == len(state.keyframes) == 2
    for ours, theirs in zip(read.state.keyframes, state.keyframes):
        assert all((getattr(ours.view, name) == getattr(theirs.view, name)).all() for name in ('rgb8', 'depth'))
        assert (ours.T_cam_world == theirs.T_cam_world).all() and ours.view.camera == theirs.view.camera
    np.testing.assert_array_equal(read.state.motion.T_world_cam, state.motion.T_world_cam, strict=True)
    np.testing.assert_array_equal(read.state.motion.velocity, state.motion.velocity, strict=True)


def test_a_state_read_back_goes_on_alike(tmp_path: Path) -> None:
    """Also where the map alone is not sure, so that the frame before counts."""
    frames = open_sequence(SOURCE[0], width=WIDTH, max_frames=5)
    slam = Slam(load_config('realtime', [*FAST, 'tracking.max_error_m=0.002']))
    for index in range(4):
        slam.process(frames[index])
    state = read_checkpoint(Checkpoints(tmp_path, 2).save(slam.state(), PROGRESS)).state
    poses = [slam.process(frames[4]).T_world_cam]
    for start in (state, replace(state, last_view=None)):
        other = Slam(state.config)
        other.restore(start)
        poses.append(other.process(frames[4]).T_world_cam)
    np.testing.assert_array_equal(poses[0], poses[1])
    assert not np.array_equal(poses[0], poses[2])


def test_state_is_a_copy(state: SlamState) -> None:
    """A saved state must not change with later frames."""
    slam, frames = Slam(state.config), open_sequence(SOURCE[0], width=WIDTH, max_frames=6)
    slam.restore(state)
    before = slam.state()
    means, rng = before.map['means'].copy(), json.dumps(before.rng)
    slam.process(frames[4])
    assert not np.array_equal(slam.state().map['means'][: len(means)], means)
    np.testing.assert_array_equal(before.map['means'], means)
    assert (json.dumps(before.rng), len(before.keyframes)) == (rng, 2) and json.dumps(slam.state().rng) != rng


def test_a_state_of_another_kind_of_map_is_refused(state: SlamState) -> None:
    slam = Slam(state.config)
    with pytest.raises(ValueError, match=r'rgb.*expected'):
        slam.restore(replace(state, map={**state.map, 'rgb': state.map['rgb'][:-1]}))


# --- files ---


def test_keyframes_are_written_once_and_removed_with_the_last_checkpoint_that_has_them(state: SlamState, tmp_path: Path) -> None:
    writer = Checkpoints(tmp_path, 2)
    writer.save(replace(state, keyframes=state.keyframes[:1]), PROGRESS)
    first = {path: path.stat().st_mtime_ns for path in (tmp_path / 'keyframes').iterdir()}
    writer.save(state, replace(PROGRESS, num_lines=5))
    both = {path: path.stat().st_mtime_ns for path in (tmp_path / 'keyframes').iterdir()}
    assert len(first) == 1 and len(both) == 2 and first.items() <= both.items()
    resumed = Checkpoints(tmp_path, 2)
    for lines, left in ((6, 2), (7, 0)):
        resumed.save(replace(state, keyframes=()), replace(PROGRESS, num_lines=lines))
        assert len(list((tmp_path / 'keyframes').iterdir())) == left
        read_checkpoint(checkpoint_paths(tmp_path)[0])


def test_only_the_last_ones_are_kept(state: SlamState, tmp_path: Path) -> None:
    writer = Checkpoints(tmp_path, 3)
    for lines in range(999_997, 1_000_002):
        writer.save(state, replace(PROGRESS, num_lines=lines))
    assert [path.stem for path in checkpoint_paths(tmp_path)] == ['999999', '1000000', '1000001']
    assert read_newest(tmp_path).progress.num_lines == 1_000_001


@pytest.mark.slow
def test_a_process_killed_while_saving_leaves_the_checkpoint_before(state: SlamState, tmp_path: Path) -> None:
    """Killed at every fsync: the bytes of a file are written then, but the file does not have its name yet."""
    path = Checkpoints(tmp_path, 1).save(state, PROGRESS)
    before = path.read_bytes()
    code = """
        import os, signal, sys
        from dataclasses import replace
        from pathlib import Path
        from splatam_core.runs.checkpoints import Checkpoints, read_newest

        countdown, fsync = int(sys.argv[2]), os.fsync

        def fsync_or_die(file):
            global countdown
            if not countdown:
                os.kill(os.getpid(), signal.SIGKILL)
            countdown -= 1
            fsync(file)

        os.fsync = fsync_or_die
        old = read_newest(Path(sys.argv[1]))
        Checkpoints(Path(sys.argv[1]), 1).save(old.state, replace(old.progress, num_lines=99))
    """
    counts = range(len(state.keyframes) + 1)
    killed = [run_code(code, tmp_path, files, log=tmp_path.with_suffix(f'.{files}')) for files in counts]
    for process in killed:
        assert process.wait() == -signal.SIGKILL, process.text
    assert list(tmp_path.rglob('.*')), 'nothing was being written'
    assert path.read_bytes() == before and read_newest(tmp_path).progress == PROGRESS
    Checkpoints(tmp_path, 1).save(state, PROGRESS)
    assert not list(tmp_path.rglob('.*')), 'files of the killed processes are still there'


@pytest.mark.slow
def test_a_process_killed_anywhere_while_saving_leaves_a_checkpoint(state: SlamState, tmp_path: Path) -> None:
    Checkpoints(tmp_path, 2).save(state, PROGRESS)
    code = """
        import sys
        from dataclasses import replace
        from pathlib import Path
        from splatam_core.runs.checkpoints import Checkpoints, read_newest

        old = read_newest(Path(sys.argv[1]))
        print('ready', flush=True)
        while True:
            old = read_newest(Path(sys.argv[1]))
            Checkpoints(Path(sys.argv[1]), 2).save(old.state, replace(old.progress, num_lines=old.progress.num_lines + 1))
    """
    for wait_s in (0.05, 0.13, 0.21):
        process = run_code(code, tmp_path, log=tmp_path.with_suffix(f'.{wait_s}'))
        process.wait_says('ready')
        time.sleep(wait_s)
        process.send(signal.SIGKILL)
        process.wait()
        assert read_newest(tmp_path).state.num_frames == state.num_frames
    assert read_newest(tmp_path).progress.num_lines > PROGRESS.num_lines


@contextmanager
def file_size_limit(num_bytes: int) -> Iterator[None]:
    """Makes writing a larger file fail, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (num_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_disk_that_is_full_does_not_stop_slam(
    whole: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    save = Checkpoints.save

    def save_where_little_fits(writer: Checkpoints, state: SlamState, progress: Progress) -> Path:
        if progress.num_lines < FRAMES - 1:
            with file_size_limit(4096):
                return save(writer, state, progress)
        return save(writer, state, progress)

    monkeypatch.setattr(Checkpoints, 'save', save_where_little_fits)
    assert splatam(*arguments('quick', tmp_path / 'run', '--checkpoint-every', 1)) == 0
    said = [line for line in capsys.readouterr().err.splitlines() if 'no checkpoint after frame' in line]
    assert len(said) == FRAMES - 2 and all('File too large; the run continues' in line for line in said)
    assert result(tmp_path / 'run') == result(whole['quick'])
    assert len(checkpoint_paths(tmp_path / 'run' / 'checkpoints')) == 2  # once they fitted
    assert not list((tmp_path / 'run').rglob('.*'))


# --- what is refused ---


def refused(run: Path, capsys: pytest.CaptureFixture[str], *more: object) -> str:
    """Returns the one line that says why a run is not resumed; checks that the folder is unchanged."""
    before = tree(run)
    assert splatam('run', '--resume', run, *more) == cli.EXIT_ERROR
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith('splatam: error: ')]
    assert len(lines) == 1
    assert tree(run) == before
    return lines[0]


def test_truncated_files_are_refused(state: SlamState, tmp_path: Path) -> None:
    path = Checkpoints(tmp_path, 1).save(state, PROGRESS)
    data = path.read_bytes()
    for size in (*range(0, 140), *range(140, len(data), len(data) // 60), len(data) - 1):
        path.write_bytes(data[:size])
        with pytest.raises(CheckpointError, match='000004.checkpoint: .*damaged'):
            read_newest(tmp_path)
    path.write_bytes(data + b'\0')
    with pytest.raises(CheckpointError, match='damaged'):
        read_newest(tmp_path)


def test_changed_bytes_are_refused(state: SlamState, tmp_path: Path) -> None:
    path = Checkpoints(tmp_path, 1).save(state, PROGRESS)
    data = path.read_bytes()
    rng = np.random.default_rng(0)
    for offset in (*range(0, 140), *rng.integers(len(data), size=60)):
        changed = bytearray(data)
        changed[offset] ^= 1 << int(rng.integers(8))
        path.write_bytes(changed)
        with pytest.raises(CheckpointError, match='000004.checkpoint: is (damaged|no checkpoint|of format)'):
            read_newest(tmp_path)


@pytest.mark.parametrize('damage', ['missing', 'cut off', 'changed', 'of another run'])
def test_damaged_keyframes_are_refused(damage: str, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = next(path for path in (run / 'checkpoints' / 'keyframes').iterdir())
    data = path.read_bytes()
    if damage == 'missing':
        path.unlink()
    elif damage == 'cut off':
        path.write_bytes(data[: len(data) // 2])
    elif damage == 'changed':
        path.write_bytes(data[:-9] + bytes([data[-9] ^ 1]) + data[-8:])
    else:
        pack('keyframe', 1, Content({}, {'rgb8': np.zeros(3)})).write(path)
    expected = {'missing': 'No such file', 'of another run': 'not the file that belongs here'}.get(damage, 'is damaged')
    line = refused(run, capsys)
    assert path.name in line and expected in line and 'move 000006.checkpoint away' in line


def test_the_error_shows_a_way_out_that_works(run: Path, whole: dict[str, Path], capsys: pytest.CaptureFixture[str]) -> None:
    newest = run / 'checkpoints' / '000006.checkpoint'
    newest.write_bytes(newest.read_bytes()[:-100])
    assert 'move 000006.checkpoint away to resume from 000003.checkpoint' in refused(run, capsys)
    newest.rename(newest.with_suffix('.damaged'))
    assert splatam('run', '--resume', run, '--no-evaluate') == 0
    assert result(run) == result(whole['quick'])


class Executes:
    """Creates a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, ...]:
        return Path.touch, (self.path,)


def archived(payload: bytes, header: str = 'splatam_ros checkpoint 1') -> bytes:
    return f'{header} {hashlib.sha256(payload).hexdigest()}\n'.encode() + payload


def test_nothing_in_a_checkpoint_is_executed(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    newest, trap = run / 'checkpoints' / '000006.checkpoint', tmp_path / 'executed'
    objects = io.BytesIO()
    np.savez(objects, allow_pickle=True, means=np.array([Executes(trap)], dtype=object))
    bare = io.BytesIO()
    np.save(bare, np.array([Executes(trap)], dtype=object), allow_pickle=True)
    for payload in (objects.getvalue(), bare.getvalue(), pickle.dumps(Executes(trap))):
        newest.write_bytes(archived(payload))
        assert 'something else than arrays of numbers' in refused(run, capsys)
    newest.write_bytes(pickle.dumps(Executes(trap)))
    assert 'is no checkpoint of splatam_ros' in refused(run, capsys)
    assert not trap.exists()
    np.load(io.BytesIO(objects.getvalue()), allow_pickle=True)['means']
    assert trap.exists(), 'the trap does not work'


def test_other_files_are_refused(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    newest = run / 'checkpoints' / '000006.checkpoint'
    payload = newest.read_bytes().split(b'\n', 1)[1]
    newest.write_bytes(archived(payload, 'splatam_ros checkpoint 2'))
    assert "is of format '2' and this version reads format 1" in refused(run, capsys)
    newest.write_bytes(next((run / 'checkpoints' / 'keyframes').iterdir()).read_bytes())
    assert 'is no checkpoint of splatam_ros' in refused(run, capsys)
    newest.write_bytes(b'\x89PNG\r\n\x1a\n' + bytes(100))
    assert r"begins with b'\x89PNG\r" in refused(run, capsys)
    newest.write_bytes(archived(b''))
    assert 'something else than arrays' in refused(run, capsys)


def test_whole_archives_of_senseless_content_are_refused(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The checksum is right, so only the content can be refused."""
    newest = run / 'checkpoints' / '000006.checkpoint'
    content = read_archive(newest, 'checkpoint', 1)
    for values, arrays in (
        ({'rng': {}}, {}),
        ({'rng': {'bit_generator': 'PCG64', 'state': 3}}, {}),
        ({'config': {'no.such.key': 1}}, {}),
        ({'camera': None}, {}),
        ({'camera': {'width': 64}}, {}),
        ({'motion_ns': [1]}, {}),
        ({'progress': {}}, {}),
        ({}, {'velocity': np.zeros(7)}),
        ({}, {'map.means': np.zeros((3, 3))}),
        ({}, {'map.steps': content.arrays['map.steps'].astype(np.float32)}),
    ):
        pack('checkpoint', 1, Content({**content.values, **values}, {**content.arrays, **arrays})).write(newest)
        assert '000006.checkpoint' in refused(run, capsys) or 'keyframe' in refused(run, capsys)


def test_other_settings_are_refused(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = yaml.safe_load((run / 'config.yaml').read_text())
    config['mapping']['iterations'] += 1
    (run / 'config.yaml').write_text(yaml.safe_dump(config))
    assert 'mapping.iterations = 7 (was 6)' in refused(run, capsys)


@pytest.mark.parametrize(
    ('changed', 'said'),
    [
        ({'max_frames': FRAMES + 1}, f'has {FRAMES + 1} frames; it had {FRAMES}'),
        ({'width': 2 * WIDTH}, 'is of PinholeCamera'),
        ({'path': 'synthetic:noise=off,seed=1'}, 'has another frame 5'),
        ({'start': 1}, 'has another frame 5'),
        ({'path': '/nowhere'}, '/nowhere'),
    ],
)
def test_other_frames_are_refused(changed: dict[str, object], said: str, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    information = json.loads((run / 'run.json').read_text())
    information['source'] |= changed
    (run / 'run.json').write_text(json.dumps(information))
    assert said in refused(run, capsys)


def test_a_trajectory_that_is_not_the_checkpoint_s_is_refused(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = (run / 'trajectory.txt').read_text().splitlines(keepends=True)
    (run / 'trajectory.txt').write_text(''.join(lines[1:]))
    assert 'trajectory.txt has frame' in refused(run, capsys)
    (run / 'trajectory.txt').write_text(''.join(lines[:4]))
    assert 'trajectory.txt has frame' in refused(run, capsys)


def test_what_cannot_be_resumed_is_said(
    run: Path, whole: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert 'is no run folder' in refused(tmp_path / 'nothing', capsys)
    assert "run with '--checkpoint-every N'" in refused(whole['quick'], capsys)
    assert 'leave out --preset' in refused(run, capsys, '--preset', 'quick')
    assert 'leave out SOURCE, --max-frames, --out' in refused(run, capsys, 'synthetic', '--max-frames', 3, '--out', run)
    with pytest.raises(SystemExit):
        splatam('run', 'synthetic')
    assert '--out DIR to begin a run, or --resume DIR' in capsys.readouterr().err
    information = json.loads((run / 'run.json').read_text())
    (run / 'run.json').write_text(json.dumps(information | {'source': None}))
    assert 'live topics' in refused(run, capsys)


def test_other_code_is_said(run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(resume.provenance, 'commit', lambda: 'another')
    assert splatam('run', '--resume', run, '--no-evaluate') == 0
    assert 'commit another continues it: the result may differ' in capsys.readouterr().err


def test_an_archive_is_the_same_whenever_it_is_written(monkeypatch: pytest.MonkeyPatch) -> None:
    content = Content({'a': 1.5}, {'b': np.arange(3)})
    first = pack('checkpoint', 1, content)
    monkeypatch.setattr(time, 'localtime', lambda *_: time.gmtime(2e9))  # an npz file can hold dates
    again = pack('checkpoint', 1, content)
    assert (first.header, bytes(first.payload)) == (again.header, bytes(again.payload))


def test_the_module_s_promise_that_numpy_alone_reads_it(state: SlamState, tmp_path: Path) -> None:
    path = Checkpoints(tmp_path, 1).save(state, PROGRESS)
    with np.load(io.BytesIO(path.read_bytes().split(b'\n', 1)[1])) as archive:
        np.testing.assert_array_equal(archive['map.means'], state.map['means'])
    assert checkpoints.VERSION == 1
