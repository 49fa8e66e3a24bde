"""The command line as a user sees it: what it writes, what it refuses, how it stops."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from processes import Process, run_code, wait_until

from splatam_core.cli import COMMANDS, main
from splatam_core.commands.frame_notes import FrameNotes
from splatam_core.commands.shared import at_width
from splatam_core.config import load_config
from splatam_core.datasets.registry import open_sequence
from splatam_core.geometry.trajectory import pose_line, stamp_text
from splatam_core.maps.ply import read_ply
from splatam_core.runs.record import RunDescription, Source, read_run
from splatam_core.runs.writer import RunFolder
from splatam_core.slam import Slam
from splatam_core.types import FrameResult, RgbdFrame

ROOT = Path(__file__).resolve().parents[2]
SOURCE = 'synthetic'
WIDTH, FRAMES = 64, 4
SMALL = ['--width', str(WIDTH), '--max-frames', str(FRAMES)]
FAST = ['threads=1', 'tracking.iterations=8', 'mapping.iterations=3']
SETTINGS = ['--preset', 'quick', *(word for setting in FAST for word in ('--set', setting))]
NODE = RunDescription('splatam_node', 'quick')


def splatam(*arguments: object) -> int:
    return main([str(argument) for argument in arguments])


def start(*arguments: object, log: Path, before: str = '') -> Process:
    """The command line as a process of its own. before: Python that it runs before."""
    hangup = 'signal.signal(signal.SIGHUP, signal.SIG_DFL)'  # the tests may have been started with nohup
    code = f'import os, signal, sys; {hangup}; {before}\nfrom splatam_core.cli import main; sys.exit(main())'
    return run_code(code, *arguments, log=log)


def metrics(folder: Path) -> dict[str, object]:
    return json.loads((folder / 'metrics.json').read_text())


def stamps(folder: Path) -> list[int]:
    return read_run(folder).trajectory.stamps_ns.tolist()


@pytest.fixture(scope='module')
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the command line; tests must not change it."""
    folder = tmp_path_factory.mktemp('cli') / 'run'
    assert splatam('run', SOURCE, *SMALL, *SETTINGS, '--out', folder) == 0
    return folder


@pytest.fixture
def copy(finished: Path, tmp_path: Path) -> Path:
    """A copy of ``finished`` that a test may change."""
    return Path(shutil.copytree(finished, tmp_path / 'copy'))


@pytest.fixture(scope='module')
def of_the_node(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder as the node writes it: no source, no decoding times."""
    config = load_config('quick', FAST)
    path, slam = tmp_path_factory.mktemp('node') / 'run', Slam(config)
    sequence = open_sequence(SOURCE, width=WIDTH, max_frames=FRAMES)
    folder = RunFolder.create(path, config, NODE)
    for index in range(len(sequence)):
        result = slam.process(sequence[index])
        folder.append(sequence[index], result, result.timings.total / 1e3)
    folder.finish(slam)
    return path


# --- run ---


def test_run_writes_everything(finished: Path) -> None:
    names = {'trajectory.txt', 'frames.csv', 'map.ply', 'metrics.json', 'config.yaml', 'run.json', 'report.png'}
    names |= {'report.html', 'scores.csv', 'trajectory_final.txt', 'map.keyframes'}
    assert {entry.name for entry in finished.iterdir()} == names
    assert len((finished / 'trajectory.txt').read_text().splitlines()) == FRAMES
    run = read_run(finished)
    assert run.config == load_config('quick', FAST)
    assert run.description == RunDescription('splatam run', 'quick', Source(SOURCE, width=WIDTH, max_frames=FRAMES))
    assert run.camera == open_sequence(SOURCE, width=WIDTH).camera
    assert cv2.imread(str(finished / 'report.png')) is not None


def test_run_s_metrics_are_known_and_sane(finished: Path) -> None:
    m = metrics(finished)
    assert m['frames'] == m['tracked'] == m['evaluated_frames'] == m['ate_frames'] == FRAMES
    assert m['num_gaussians'] == len(read_ply(finished / 'map.ply').means)
    assert 0 < m['fps_with_io'] < m['fps']
    assert m['ate_rmse_m'] < 0.05 and m['psnr_db'] > 15 and 0 < m['ssim'] < 1 and m['depth_l1_m'] < 0.2
    assert m['timings_ms'].keys() == {'track', 'densify', 'keyframes', 'map', 'graph', 'total'}
    assert m['rpe_trans_frame_m'] < 0.05 and m['rpe_frame_pairs'] == FRAMES - 1 and m['depth_rmse_m'] > m['depth_l1_m']
    # Nothing was held out, no test split rendered, four frames last no second, 64 pixels are too few for MS-SSIM, there was
    # no GPU, and no keyframe graph.
    groups = 'heldout_', 'novel_', 'splatam_novel_'
    null = {name for name in m if m[name] is None and not name.startswith(groups)}
    assert null - {'lpips', 'splatam_lpips'} == {
        'rpe_trans_1s_m', 'rpe_rot_1s_deg', 'ms_ssim', 'splatam_ms_ssim', 'peak_gpu_mb', 'loops', 'corrections'
    }  # fmt: skip
    assert all(m[name] is None for name in m if name.startswith(groups))
    assert '64x48' in m['notes']['ms_ssim']


def test_run_says_how_it_went(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert splatam('run', SOURCE, *SMALL, *SETTINGS, '--no-evaluate', '--out', tmp_path / 'run') == 0
    output = capsys.readouterr()
    assert f'tracked    {FRAMES} of {FRAMES} frames' in output.out
    assert 'not known  ATE RMSE, RPE, PSNR, SSIM' in output.out and output.out.count('not known') == 1
    assert f'{FRAMES}/{FRAMES}' in output.err and f'tracked={FRAMES}' in output.err and 'lost=0' in output.err
    assert not (tmp_path / 'run' / 'report.png').exists()
    assert metrics(tmp_path / 'run')['psnr_db'] is None


def test_a_configuration_s_width_is_taken_where_none_is_asked_for(tmp_path: Path) -> None:
    assert splatam('run', SOURCE, '--max-frames', 2, *SETTINGS, '--set', 'width=40', '--no-evaluate', '--out', tmp_path / 'a') == 0
    run = read_run(tmp_path / 'a')
    assert (run.camera.width, run.description.source.width) == (40, 40)  # so that it is scored and resumed at that width
    narrow, wide = load_config('quick', ['width=630']), load_config('quick', ['width=1000'])
    assert at_width(Source(SOURCE, max_frames=1), wide).width is None  # never wider than recorded
    assert at_width(Source(SOURCE, max_frames=1, width=48), narrow).width == 48
    assert at_width(Source(SOURCE, max_frames=1, crop=10), narrow).width == 630  # 640 recorded; cropped after resizing


def test_same_run_gives_the_same_poses_and_map(finished: Path, tmp_path: Path) -> None:
    assert splatam('run', SOURCE, *SMALL, *SETTINGS, '--no-evaluate', '--out', tmp_path / 'again') == 0
    for name in ('trajectory.txt', 'map.ply', 'config.yaml'):
        assert (tmp_path / 'again' / name).read_bytes() == (finished / name).read_bytes()


def test_start_and_max_frames_choose_the_frames(finished: Path, tmp_path: Path) -> None:
    window = ['--width', WIDTH, '--start', 1, '--max-frames', 2]
    assert splatam('run', SOURCE, *window, *SETTINGS, '--no-evaluate', '--out', tmp_path / 'run') == 0
    assert stamps(tmp_path / 'run') == stamps(finished)[1:3]


def test_existing_results_stay_unless_told_otherwise(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (copy / 'trajectory.txt').read_bytes()
    again = ['run', SOURCE, '--width', WIDTH, '--max-frames', 1, *SETTINGS, '--no-evaluate', '--out', copy]
    assert splatam(*again) == 2
    assert 'choose another folder, or replace the run in it with --overwrite' in capsys.readouterr().err
    assert (copy / 'trajectory.txt').read_bytes() == before
    assert splatam(*again, '--overwrite') == 0
    assert len((copy / 'trajectory.txt').read_text().splitlines()) == 1
    assert not (copy / 'report.png').exists()  # the old report showed another run


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        (['--set', 'tracking.iteratons=3'], "did you mean 'tracking.iterations'?"),
        (['--set', 'tracking.iterations=many'], 'a whole number'),
        (['--preset', 'quickest'], "unknown preset 'quickest'"),
        (['--start', '-1'], 'start -1'),
        (['--format', 'vhs'], "'vhs'"),
    ],
)
def test_user_errors_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str) -> None:
    assert splatam('run', SOURCE, *arguments, '--out', tmp_path / 'run') == 2
    error = capsys.readouterr().err
    assert error.startswith('splatam: error: ') and message in error and error.count('\n') == 1
    assert not (tmp_path / 'run').exists()


def test_missing_source_is_one_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert splatam('run', tmp_path / 'nothing', '--out', tmp_path / 'run') == 2
    assert capsys.readouterr().err.startswith('splatam: error: ')
    assert not (tmp_path / 'run').exists()


def test_bugs_keep_their_traceback(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Slam, 'process', lambda self, frame: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        splatam('run', SOURCE, *SMALL, *SETTINGS, '--out', tmp_path / 'run')


def write_tum(folder: Path) -> None:
    """Writes the first frames as a TUM recording without ground truth."""
    sequence = open_sequence(SOURCE, width=WIDTH, max_frames=FRAMES)
    (folder / 'rgb').mkdir(parents=True)
    (folder / 'depth').mkdir()
    c, lines = sequence.camera, {'rgb': '', 'depth': ''}
    for index in range(FRAMES):
        frame = sequence[index]
        cv2.imwrite(str(folder / 'rgb' / f'{index}.png'), frame.rgb[..., ::-1])
        cv2.imwrite(str(folder / 'depth' / f'{index}.png'), (frame.depth_m * 5000).round().astype(np.uint16))
        for name in lines:
            lines[name] += f'{stamp_text(frame.stamp_ns)} {name}/{index}.png\n'
    for name, text in lines.items():
        (folder / f'{name}.txt').write_text(text)
    (folder / 'camera.yaml').write_text(
        f'{{width: {c.width}, height: {c.height}, fx: {c.fx}, fy: {c.fy}, cx: {c.cx}, cy: {c.cy}, depth_scale: 5000}}'
    )


@pytest.mark.slow
@pytest.mark.usefixtures('undrawn')
def test_recording_without_truth_gives_null(tmp_path: Path) -> None:
    write_tum(tmp_path / 'tum')
    assert splatam('run', tmp_path / 'tum', *SETTINGS, '--out', tmp_path / 'run') == 0
    m = metrics(tmp_path / 'run')
    assert m['tracked'] == FRAMES and m['ate_rmse_m'] is None and m['psnr_db'] > 15


@pytest.mark.slow
@pytest.mark.usefixtures('undrawn')
def test_a_damaged_frame_is_left_out_and_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_tum(tmp_path / 'tum')
    (tmp_path / 'tum' / 'rgb' / '2.png').write_bytes(b'not an image')
    assert splatam('run', tmp_path / 'tum', *SETTINGS, '--out', tmp_path / 'run') == 0
    out, error = capsys.readouterr()
    assert len(re.findall(r'frame 2 is skipped: .*2\.png: is not an image', error)) == 1
    assert re.search(rf'left out +1 of {FRAMES} frames', out)
    m = metrics(tmp_path / 'run')
    assert m['frames'] == m['tracked'] == m['evaluated_frames'] == FRAMES - 1


def test_a_frame_of_another_size_is_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_tum(tmp_path / 'tum')
    cv2.imwrite(str(tmp_path / 'tum' / 'rgb' / '1.png'), np.zeros((10, 10, 3), np.uint8))
    assert splatam('run', tmp_path / 'tum', *SETTINGS, '--no-evaluate', '--out', tmp_path / 'run') == 0
    assert 'frame 1 is skipped: ' in capsys.readouterr().err
    assert metrics(tmp_path / 'run')['frames'] == FRAMES - 1


@pytest.mark.parametrize(
    ('scale', 'why'),
    [('1', 'no pixel has a usable depth reading'), ('100000000', 'no pixel has a usable depth reading')],
)  # fmt: skip
def test_a_run_that_maps_nothing_says_why(tmp_path: Path, capsys: pytest.CaptureFixture[str], scale: str, why: str) -> None:
    """Such as depth in another unit: every frame is lost."""
    write_tum(tmp_path / 'tum')
    camera = tmp_path / 'tum' / 'camera.yaml'
    camera.write_text(camera.read_text().replace('5000', scale))
    assert splatam('run', tmp_path / 'tum', *SETTINGS, '--no-evaluate', '--out', tmp_path / 'run') == 0
    error = capsys.readouterr().err
    assert f'frame 0 is lost: the map cannot start: {why}' in error
    assert re.search(rf'splatam: nothing was mapped, all {FRAMES} frames are lost, .*{why}; .*depth_scale', error)
    assert metrics(tmp_path / 'run')['lost'] == FRAMES


def test_the_first_few_of_many_frames_alike_are_named(capsys: pytest.CaptureFixture[str]) -> None:
    notes = FrameNotes()
    for index in range(1000):
        notes.lost(index, f'only {index}% of the view is mapped')
        notes.skipped(index, f'{index}.png: cannot be read')
    notes.lost(1000, 'another reason')
    notes.say_how_many_more()
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 3 + 3 + 1 + 2 and 'splatam: frame 1000 is lost: another reason' in lines
    assert lines[-2:] == ['splatam: 997 more frames are skipped like these', 'splatam: 997 more frames are lost like these']


@pytest.mark.slow
def test_a_run_that_never_finds_its_way_is_still_reported(tmp_path: Path) -> None:
    write_tum(tmp_path / 'tum')
    for path in (tmp_path / 'tum' / 'depth').iterdir():
        cv2.imwrite(str(path), np.zeros_like(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)))
    assert splatam('run', tmp_path / 'tum', *SETTINGS, '--out', tmp_path / 'run') == 0
    m = metrics(tmp_path / 'run')
    assert (m['frames'], m['tracked'], m['lost'], m['num_gaussians']) == (FRAMES, 0, FRAMES, 0)
    assert (m['ate_rmse_m'], m['psnr_db'], m['depth_l1_m']) == (None, None, None)
    lines = (tmp_path / 'run' / 'trajectory.txt').read_text().splitlines()
    assert len(lines) == FRAMES and all(line.startswith('# lost ') for line in lines)
    assert (tmp_path / 'run' / 'report.png').exists()


@pytest.mark.slow
@pytest.mark.usefixtures('undrawn')
def test_too_few_frames_for_a_trajectory_error_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    window = ['--width', WIDTH, '--max-frames', 2]
    assert splatam('run', SOURCE, *window, *SETTINGS, '--out', tmp_path / 'run') == 0
    assert 'no trajectory error: 2 of 2 frames' in capsys.readouterr().err
    assert metrics(tmp_path / 'run')['ate_rmse_m'] is None and metrics(tmp_path / 'run')['psnr_db'] is not None


@pytest.fixture
def long_run(tmp_path: Path) -> Iterator[tuple[Process, Path]]:
    """A run that has processed a few of its many frames."""
    arguments = ['--width', WIDTH, '--max-frames', 500, *SETTINGS, '--out', tmp_path / 'run']
    process = start('run', SOURCE, *arguments, log=tmp_path / 'log')
    trajectory = tmp_path / 'run' / 'trajectory.txt'

    def has_begun() -> bool:
        assert process.is_running, process.text
        return trajectory.exists() and trajectory.read_text().count('\n') >= 6  # some may be uncertain

    wait_until(has_begun, explain=lambda: process.text)
    yield process, tmp_path / 'run'
    process.send(signal.SIGKILL)
    process.wait()


@pytest.mark.slow
@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
@pytest.mark.usefixtures('undrawn')
def test_interrupt_saves_what_was_done(long_run: tuple[Process, Path], number: signal.Signals) -> None:
    process, folder = long_run
    process.send(number)
    assert process.wait() == 130
    m = metrics(folder)
    assert 3 <= m['frames'] < 500
    assert f'stopped after {m["frames"]} of 500 frames' in process.text and 'Traceback' not in process.text
    assert len((folder / 'trajectory.txt').read_text().splitlines()) == m['frames']
    assert m['num_gaussians'] == len(read_ply(folder / 'map.ply').means) > 0
    if number is signal.SIGINT:
        assert splatam('evaluate', folder, '--every', 2) == 0
        assert metrics(folder)['ate_rmse_m'] is not None


@pytest.mark.slow
def test_a_terminal_that_is_gone_ends_no_run_started_with_nohup(tmp_path: Path) -> None:
    ignored = 'signal.signal(signal.SIGHUP, signal.SIG_IGN); os.kill(os.getpid(), signal.SIGHUP)'
    arguments = ['run', SOURCE, *SMALL, *SETTINGS, '--no-evaluate', '--out', tmp_path / 'run']
    process = start(*arguments, before=ignored, log=tmp_path / 'log')
    assert process.wait() == 0 and metrics(tmp_path / 'run')['frames'] == FRAMES
    assert 'stopping' not in process.text


@pytest.mark.slow
@pytest.mark.parametrize(
    'closing',
    [
        'os.close(2); sys.stderr = None',  # as Python finds it after 2>&-
        'reader, writer = os.pipe(); os.close(reader); os.dup2(writer, 2)',
        "os.dup2(os.open('/dev/full', os.O_WRONLY), 2)",
    ],
    ids=['closed', 'nobody reads', 'full'],
)
def test_messages_that_cannot_be_printed_cost_nothing_of_the_run(tmp_path: Path, closing: str) -> None:
    arguments = ['run', SOURCE, *SMALL, *SETTINGS, '--no-evaluate', '--out', tmp_path / 'run']
    process = start(*arguments, before=closing, log=tmp_path / 'log')
    assert process.wait() == 0 and 'frames' in process.text
    assert metrics(tmp_path / 'run')['frames'] == FRAMES and len(read_ply(tmp_path / 'run' / 'map.ply').means) > 0


@pytest.mark.slow
@pytest.mark.usefixtures('undrawn')
def test_kill_keeps_the_trajectory(long_run: tuple[Process, Path]) -> None:
    process, folder = long_run
    process.send(signal.SIGKILL)
    process.wait()
    assert splatam('evaluate', folder, '--every', 100) == 0
    m = metrics(folder)
    assert m['frames'] >= 3 and m['ate_rmse_m'] is not None
    assert m['psnr_db'] is None and m['num_gaussians'] is None


def test_the_steps_after_the_last_frame_are_counted_and_are_not_of_a_run_that_was_stopped(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    few = ['--preset', 'realtime', '--width', WIDTH, '--max-frames', 6, '--no-evaluate']
    assert splatam('run', SOURCE, *few, '--out', tmp_path / 'run') == 0
    assert 'now the final passes over the keyframes' in capsys.readouterr().err
    m, frames = metrics(tmp_path / 'run'), read_run(tmp_path / 'run').frames
    in_frames_s = sum(frame.process_ms for frame in frames) / 1e3
    assert m['finish_s'] > 0 and 6 / m['fps'] == pytest.approx(in_frames_s + m['finish_s'], abs=6e-4)  # of whole ms

    process_frame = Slam.process

    def interrupted(slam: Slam, frame: RgbdFrame) -> FrameResult:
        signal.raise_signal(signal.SIGINT)
        return process_frame(slam, frame)

    monkeypatch.setattr(Slam, 'process', interrupted)
    assert splatam('run', SOURCE, *few, '--out', tmp_path / 'stopped') == 130
    assert 'final passes' not in capsys.readouterr().err and metrics(tmp_path / 'stopped')['finish_s'] == 0


@pytest.mark.slow
@pytest.mark.usefixtures('undrawn')
def test_ctrl_c_while_the_map_is_fitted_once_more_saves_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    finish, steps = Slam.finish, []

    def interrupted(slam: Slam, *, stop: Callable[[], bool]) -> int:
        signal.raise_signal(signal.SIGINT)
        steps.append(finish(slam, stop=stop))
        return steps[0]

    monkeypatch.setattr(Slam, 'finish', interrupted)
    few = ['--preset', 'realtime', '--width', WIDTH, '--max-frames', 6]
    assert splatam('run', SOURCE, *few, '--out', tmp_path / 'run') == 130
    said = capsys.readouterr().err
    assert 'stopping after this step of the final passes' in said and 'stopped during the final passes' in said
    assert steps == [0] and metrics(tmp_path / 'run')['frames'] == 6 and (tmp_path / 'run' / 'map.ply').is_file()
    assert splatam('evaluate', tmp_path / 'run') == 0


# --- evaluate ---


@pytest.mark.usefixtures('undrawn')
def test_evaluate_repeats_the_run_s_own_scores(finished: Path, copy: Path) -> None:
    (copy / 'report.png').unlink()
    assert splatam('evaluate', copy) == 0
    assert metrics(copy) == metrics(finished)
    assert (copy / 'report.png').exists()


@pytest.mark.slow
@pytest.mark.usefixtures('undrawn')
def test_node_and_command_line_are_scored_alike(finished: Path, of_the_node: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(of_the_node, tmp_path / 'node'))
    assert (folder / 'trajectory.txt').read_bytes() == (finished / 'trajectory.txt').read_bytes()
    assert splatam('evaluate', folder, '--truth', SOURCE) == 0  # recorded larger: resized to the run's width
    scores = 'ate_rmse_m', 'psnr_db', 'ssim', 'depth_l1_m', 'psnr_full_db', 'evaluated_frames'
    assert {name: metrics(folder)[name] for name in scores} == {name: metrics(finished)[name] for name in scores}
    assert metrics(folder)['fps_with_io'] is None
    assert (folder / 'report.png').exists()


def test_node_without_truth_asks_for_it(of_the_node: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert splatam('evaluate', of_the_node) == 2
    assert 'pass --truth FILE|BAG|DATASET' in capsys.readouterr().err


def write_truth(path: Path) -> None:
    truth = open_sequence(SOURCE, width=WIDTH).ground_truth()
    path.write_text('\n'.join(map(pose_line, truth.stamps_ns.tolist(), truth.T_world_cam)))


@pytest.mark.slow
@pytest.mark.usefixtures('undrawn')
def test_truth_file_alone_gives_the_trajectory_error(finished: Path, of_the_node: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(of_the_node, tmp_path / 'node'))
    write_truth(tmp_path / 'truth.txt')
    assert splatam('evaluate', folder, '--truth', tmp_path / 'truth.txt') == 0
    m = metrics(folder)
    assert m['ate_rmse_m'] == pytest.approx(metrics(finished)['ate_rmse_m'], abs=1e-8)  # nine decimals in the file
    assert m['psnr_db'] is None and m['evaluated_every'] is None


@pytest.mark.slow
@pytest.mark.usefixtures('undrawn')
def test_truth_file_beside_the_run_s_own_images(finished: Path, copy: Path, tmp_path: Path) -> None:
    write_truth(tmp_path / 'truth.txt')
    assert splatam('evaluate', copy, '--truth', tmp_path / 'truth.txt') == 0
    assert metrics(copy)['psnr_db'] == metrics(finished)['psnr_db']


def test_truth_of_another_recording_is_an_error_that_changes_nothing(
    copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / 'truth.txt').write_text('9000 0 0 0 0 0 0 1\n9001 0 0 0 0 0 0 1\n')
    before = {entry.name: entry.read_bytes() for entry in copy.iterdir()}
    assert splatam('evaluate', copy, '--truth', tmp_path / 'truth.txt') == 2
    assert 'are they of the same recording and clock?' in capsys.readouterr().err
    assert {entry.name: entry.read_bytes() for entry in copy.iterdir()} == before


@pytest.mark.slow
@pytest.mark.usefixtures('undrawn')
def test_scores_stay_until_they_are_scored_again(copy: Path, of_the_node: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(of_the_node, tmp_path / 'node'))
    assert splatam('evaluate', folder, '--truth', SOURCE) == 0
    before = metrics(folder)
    write_truth(tmp_path / 'truth.txt')
    assert splatam('evaluate', folder, '--truth', tmp_path / 'truth.txt') == 0  # no images this time
    assert metrics(folder)['psnr_db'] == before['psnr_db'] is not None


def test_evaluate_of_no_run_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert splatam('evaluate', tmp_path) == 2
    assert 'is no run folder' in capsys.readouterr().err
    assert splatam('evaluate', tmp_path / 'nothing') == 2
    assert 'nothing is no run folder: it does not exist' in capsys.readouterr().err


# --- convert ---


@pytest.mark.slow
@pytest.mark.parametrize('storage', ['sqlite3', 'mcap'])
@pytest.mark.usefixtures('undrawn')
def test_converted_bag_gives_the_same_run(finished: Path, tmp_path: Path, storage: str) -> None:
    bag = tmp_path / 'bag'
    assert splatam('convert', SOURCE, bag, *SMALL, '--storage', storage) == 0
    assert splatam('run', bag, *SETTINGS, '--no-evaluate', '--out', tmp_path / 'run') == 0
    assert (tmp_path / 'run' / 'trajectory.txt').read_bytes() == (finished / 'trajectory.txt').read_bytes()
    assert splatam('evaluate', tmp_path / 'run') == 0
    assert metrics(tmp_path / 'run')['ate_rmse_m'] == pytest.approx(metrics(finished)['ate_rmse_m'], abs=1e-9)


@pytest.mark.slow
@pytest.mark.usefixtures('undrawn')
def test_node_is_scored_with_the_bag_it_was_played(finished: Path, of_the_node: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(of_the_node, tmp_path / 'node'))
    assert splatam('convert', SOURCE, tmp_path / 'bag', *SMALL) == 0
    assert splatam('evaluate', folder, '--truth', tmp_path / 'bag') == 0
    assert metrics(folder)['psnr_db'] == pytest.approx(metrics(finished)['psnr_db'], abs=1e-4)
    assert metrics(folder)['ate_rmse_m'] == pytest.approx(metrics(finished)['ate_rmse_m'], abs=1e-9)


def test_compressed_bag_can_be_run(tmp_path: Path) -> None:
    assert splatam('convert', SOURCE, tmp_path / 'bag', *SMALL, '--compressed') == 0
    assert splatam('run', tmp_path / 'bag', *SETTINGS, '--no-evaluate', '--out', tmp_path / 'run') == 0
    assert metrics(tmp_path / 'run')['tracked'] == FRAMES


# --- all ---


@pytest.mark.parametrize('name', [command.name for command in COMMANDS])
def test_help_names_every_argument(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        splatam(name, '--help')
    assert caught.value.code == 0 and f'usage: splatam {name}' in capsys.readouterr().out


def test_help_imports_nothing_heavy() -> None:
    code = (
        'import sys; from splatam_core.cli import make_parser; make_parser().format_help(); '
        "print({'torch', 'cv2', 'matplotlib', 'numpy'} & sys.modules.keys())"
    )
    done = subprocess.run([sys.executable, '-c', code], cwd=ROOT, env=os.environ, capture_output=True, text=True)
    assert done.stdout.strip() == 'set()'


def test_wrong_arguments_are_the_parser_s(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in ([], ['sing'], ['run', SOURCE], ['run', SOURCE, '--out', 'x', '--width', '0']):
        with pytest.raises(SystemExit) as caught:
            splatam(*arguments)
        assert caught.value.code == 2
    assert '0 is not at least 1' in capsys.readouterr().err
