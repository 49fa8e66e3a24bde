"""Folders as people bring them are read, run and scored; what is left out is said."""

from __future__ import annotations

import json
import re
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from field_folders import FOCAL, FOLDERS, FRAMES, LFS_POINTER, Brought, associations, numbered, pose_lines, stamps, tum, with_truth

from splatam_core.cli import main
from splatam_core.datasets.registry import open_sequence
from splatam_core.errors import DatasetError, FrameError

QUICK = ['--preset', 'quick', '--width', '80', '--set', 'threads=1', '--set', 'mapping.iterations=3']


def run(source: Path, out: Path, *more: str) -> int:
    return main(['run', str(source), *QUICK, '--out', str(out), *more])


def metrics(folder: Path) -> dict[str, object]:
    return json.loads((folder / 'metrics.json').read_text())


@pytest.fixture(params=FOLDERS)
def brought(request) -> Brought:
    return FOLDERS[request.param]


def test_folder_is_read(tmp_path, caplog, brought):
    sequence = open_sequence(str(brought.write(tmp_path)))
    truth = sequence.ground_truth()
    assert re.search(brought.says, caplog.text)
    if not brought.says:
        assert not caplog.records
    assert len(sequence) == FRAMES
    assert (sequence.camera.fx, sequence.camera.width) == (FOCAL, 160)
    for index in range(FRAMES):
        if index in brought.unreadable:
            with pytest.raises(FrameError):
                sequence[index]
        else:
            assert np.abs(sequence[index].depth_m - 1.0).max() < 1e-3
    assert (None if truth is None else len(truth)) == brought.truth
    if truth is not None:
        x_m = truth.T_world_cam[:, 0, 3]
        assert np.isfinite(truth.T_world_cam).all() and 6 / FOCAL < x_m[-1] - x_m[0] < 8 / FOCAL


@pytest.mark.parametrize('name', [name for name, brought in FOLDERS.items() if brought.format == 'tum' and 'lists' in name])
def test_stamps_of_lists_are_seconds_in_the_end(tmp_path, name):
    sequence = open_sequence(str(FOLDERS[name].write(tmp_path)))
    gaps_ns = np.diff([sequence[index].stamp_ns for index in range(FRAMES)])
    assert np.abs(gaps_ns - 31_250_000).max() < 1000


def test_truth_in_nanoseconds_has_the_stamps_of_the_frames(tmp_path):
    sequence = open_sequence(str(FOLDERS['truth nanoseconds'].write(tmp_path)))
    assert sequence.ground_truth().stamps_ns.tolist() == [sequence[index].stamp_ns for index in range(FRAMES)]


@pytest.mark.parametrize('name', FOLDERS)
def test_named_format_is_accepted(tmp_path, name):
    brought = FOLDERS[name]
    assert len(open_sequence(str(brought.write(tmp_path)), format=brought.format)) == FRAMES


# --- whole runs ---


@pytest.mark.slow
@pytest.mark.parametrize('name', ['associations', 'pointer', 'missing, numbered', 'NeRFCapture offline', 'truth nan'])
@pytest.mark.usefixtures('undrawn')
def test_folder_is_run_and_scored(tmp_path, capsys, name):
    brought = FOLDERS[name]
    assert run(brought.write(tmp_path / 'in'), tmp_path / 'out') == 0
    out, err = capsys.readouterr()
    m = metrics(tmp_path / 'out')
    assert m['tracked'] == FRAMES - len(brought.unreadable)
    assert m['psnr_db'] > 15 and (tmp_path / 'out/report.html').exists()
    if brought.truth is not None:
        assert m['ate_rmse_m'] < 0.02
    if brought.unreadable:
        assert re.search(r'left out +1 of 8 frames', out)
        assert err.count('is skipped') == 1


FAULTY_TRUTHS = {
    'no numbers': ['hello'] * 8,
    'time runs backwards': pose_lines(stamps())[::-1],
    'all unknown': [f'{text} nan nan nan nan nan nan nan' for text in stamps()],
    'another clock': pose_lines(stamps(first_s=5.0)),
    'in nanoseconds': pose_lines(stamps(10**9, first_s=1.7e9)),
    'stamps out of range': pose_lines(['9' * 25] * 8),
}


@pytest.mark.parametrize('lines', FAULTY_TRUTHS.values(), ids=FAULTY_TRUTHS)
def test_faulty_truth_is_one_error(tmp_path, lines):
    sequence = open_sequence(str(with_truth(tmp_path, lines)))
    assert len(sequence) == FRAMES and sequence[3].depth_m.all()
    with suppress(DatasetError):  # another clock shows only when it is compared with the frames
        assert len(sequence.ground_truth()) == 8 and lines in [FAULTY_TRUTHS['another clock'], FAULTY_TRUTHS['in nanoseconds']]


@pytest.mark.slow
@pytest.mark.parametrize('name', ['no numbers', 'another clock'])
@pytest.mark.usefixtures('undrawn')
def test_faulty_truth_costs_neither_the_run_nor_the_image_scores(tmp_path, capsys, name):
    assert run(with_truth(tmp_path / 'in', FAULTY_TRUTHS[name]), tmp_path / 'out') == 0
    err = capsys.readouterr().err
    assert len(re.findall('the ground truth is not used|no trajectory error', err)) == 1
    assert 0 <= err.find('the ground truth is not used') < err.find('frame/s')  # before the run
    m = metrics(tmp_path / 'out')
    assert m['tracked'] == FRAMES and m['psnr_db'] > 15 and m['ate_rmse_m'] is None
    assert (tmp_path / 'out/report.html').exists()
    if name == 'another clock':
        assert main(['evaluate', str(tmp_path / 'out'), '--every', '4']) == 0


@pytest.mark.usefixtures('undrawn')
def test_given_truth_with_a_fault_leaves_the_image_scores(tmp_path, capsys):
    assert run(tum(tmp_path / 'in'), tmp_path / 'out', '--no-evaluate') == 0
    (tmp_path / 'truth.txt').write_text('\n'.join(FAULTY_TRUTHS['no numbers']))
    assert main(['evaluate', str(tmp_path / 'out'), '--truth', str(tmp_path / 'truth.txt')]) == 2
    assert 'the ground truth is not used' in capsys.readouterr().err
    m = metrics(tmp_path / 'out')
    assert m['psnr_db'] > 15 and m['ate_rmse_m'] is None and (tmp_path / 'out/report.html').exists()


@pytest.mark.slow
@pytest.mark.usefixtures('undrawn')
def test_given_truth_is_read_as_the_recording_s_own(tmp_path):
    assert run(tum(tmp_path / 'in'), tmp_path / 'out', '--no-evaluate') == 0
    for name in ('truth nan', 'truth nanoseconds'):
        truth = FOLDERS[name].write(tmp_path / name) / 'groundtruth.txt'
        assert main(['evaluate', str(tmp_path / 'out'), '--truth', str(truth), '--every', '4']) == 0
        m = metrics(tmp_path / 'out')
        assert m['ate_rmse_m'] < 0.02 and m['psnr_db'] > 15


def test_faulty_truth_and_damaged_frame_are_left_out_of_a_converted_bag(tmp_path, caplog):
    source = with_truth(tmp_path / 'in', FAULTY_TRUTHS['no numbers'])
    (source / 'rgb/0.png').write_bytes(LFS_POINTER)
    assert main(['convert', str(source), str(tmp_path / 'bag')]) == 0
    assert 'frame 0 is left out' in caplog.text and 'the ground truth is left out' in caplog.text
    bag = open_sequence(str(tmp_path / 'bag'))
    assert len(bag) == FRAMES - 1 and bag.ground_truth() is None


# --- what is refused ---


def test_where_more_than_a_tenth_is_missing_the_first_few_are_listed(tmp_path):
    source = tum(tmp_path)
    for frame in (2, 3, 5, 6):
        (source / f'depth/{frame}.png').unlink()
    with pytest.raises(DatasetError, match=r'4 of 8 frames cannot be read.*depth/2\.png.*depth/3\.png.*depth/5\.png.* and so on'):
        open_sequence(str(source))


def test_where_the_files_were_not_fetched_it_is_said_at_once(tmp_path):
    source = numbered(tmp_path)
    for path in source.glob('*.png'):
        path.write_bytes(LFS_POINTER)
    with pytest.raises(DatasetError, match='it is a pointer of Git LFS: fetch the files'):
        open_sequence(str(source))


def test_own_camera_without_intrinsics_is_not_taken_for_another_dataset(tmp_path):
    source = associations(tmp_path / 'desk')
    (source / 'intrinsics.txt').unlink()
    with pytest.raises(DatasetError, match=r'the camera is unknown.*put a camera\.yaml'):
        open_sequence(str(source))


@pytest.mark.parametrize('name', ['living_room_traj2_frei_png', 'office_traj0', 'icl'])
def test_icl_is_recognised_by_its_name_and_its_camera_is_said(tmp_path, caplog, name):
    source = associations(tmp_path / name, '{i} depth/{i}.png {i} rgb/{i}.png')
    for path in (source / 'depth').iterdir():
        path.rename(path.with_name(path.name.removeprefix('d')))
    with pytest.raises(DatasetError, match='is 160x120, but the camera is for 640x480'):
        open_sequence(str(source))
    assert 'states no camera; the camera of ICL-NUIM' in caplog.text
