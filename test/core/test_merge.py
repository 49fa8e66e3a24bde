"""Two runs of one room are joined; runs that cannot be joined are refused in one line."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from splatam_core.cli import main
from splatam_core.config import load_config
from splatam_core.datasets.registry import open_sequence
from splatam_core.geometry import se3
from splatam_core.geometry.trajectory import interpolate_poses
from splatam_core.maps.joining import Joint, SavedMap, find_joint, joined, transformed
from splatam_core.maps.ply import read_ply, write_ply
from splatam_core.rasterizer import make_rasterizer
from splatam_core.runs.map_keyframes import read_map_keyframes
from splatam_core.runs.record import read_run
from splatam_core.slam import Slam
from splatam_core.tracking import make_tracker
from splatam_core.types import Status

pytestmark = pytest.mark.slow

WIDTH, FRAMES, START = 160, 20, 10
ROOM = 'synthetic:motion=fast'
FAST = ('threads=1', 'mapping.iterations=1', 'mapping.fused.final_passes=1', 'keyframes.every=2', 'densification.every=2')


def splatam(*arguments: object) -> int:
    return main([str(argument) for argument in arguments])


def record(folder: Path, source: str, start: int) -> Path:
    settings = [word for setting in FAST for word in ('--set', setting)]
    limits = ['--width', WIDTH, '--start', start, '--max-frames', FRAMES, '--no-evaluate']
    assert splatam('run', source, *limits, '--preset', 'realtime', *settings, '--out', folder) == 0
    return folder


@pytest.fixture(scope='module')
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two runs in a room that share some of it."""
    folder = tmp_path_factory.mktemp('merge')
    return record(folder / 'first', ROOM, 0), record(folder / 'second', ROOM, START)


@pytest.fixture(scope='module')
def merged(runs: tuple[Path, Path]) -> Path:
    out = runs[0].parent / 'merged'
    assert splatam('merge', *runs, '--out', out) == 0
    return out


def saved_map(folder: Path) -> SavedMap:
    return SavedMap(read_ply(folder / 'map.ply'), read_map_keyframes(folder / 'map.keyframes'))


def error_line(capsys: pytest.CaptureFixture[str]) -> str:
    line = capsys.readouterr().err.strip()
    assert line.startswith('splatam: error: ') and '\n' not in line
    return line


def test_two_runs_become_one(runs: tuple[Path, Path], merged: Path) -> None:
    first, second, both = read_run(runs[0]), read_run(runs[1]), read_run(merged)
    assert len(both.trajectory) == len(both.frames) == 2 * FRAMES and both.description.program == 'splatam merge'
    assert (np.diff(both.trajectory.stamps_ns) > 0).all()
    truth = open_sequence(ROOM, width=WIDTH).ground_truth()
    poses = np.concatenate([interpolate_poses(truth, run.trajectory.stamps_ns)[0] for run in (first, second)])
    in_first = se3.inverse(poses[0]) @ poses
    off = np.linalg.norm(both.trajectory.T_world_cam[:, :3, 3] - in_first[:, :3, 3], axis=1)
    assert off.max() < 0.05  # two pixels at the walls' 2.5 m
    maps = [saved_map(folder) for folder in (*runs, merged)]
    sizes = [len(one.gaussians) for one in maps]
    assert sizes[0] < sizes[2] < sizes[0] + 0.9 * sizes[1]  # what both show is there once
    assert len(maps[2].saved.keyframes) == sum(len(one.saved.keyframes) for one in maps[:2])


def test_what_is_merged_is_a_run_folder(merged: Path, tmp_path: Path) -> None:
    assert splatam('render', merged, '--out', tmp_path / 'film') == 0
    for name in ('map.ply', 'map.splat'):
        assert splatam('export', merged, tmp_path / name) == 0
    assert splatam('export', merged, tmp_path / 'grid.yaml', '--as', 'grid') == 0


def test_a_camera_finds_itself_in_the_merged_map(merged: Path) -> None:
    slam, frames = Slam(read_run(merged).config), open_sequence(ROOM, width=WIDTH)
    one = saved_map(merged)
    slam.load(one.gaussians, None, one.saved)
    results = [slam.process(frames[index]) for index in (5, 6, START + FRAMES - 4, START + FRAMES - 3)]
    assert results[1].status is Status.TRACKED


def test_it_does_not_matter_which_run_sees_the_other(
    runs: tuple[Path, Path], merged: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where no keyframe of the second is recognised in the first, those of the first are looked for in the second."""
    calls: list[int] = []

    def seen_from_one_side(first: SavedMap, second: SavedMap, *rest: object) -> Joint:
        calls.append(len(first.gaussians))
        return find_joint(first, second, *rest) if len(calls) == 2 else Joint(None, 1, 0, 0)  # type: ignore[arg-type]

    monkeypatch.setattr('splatam_core.maps.joining.find_joint', seen_from_one_side)
    assert splatam('merge', *runs, '--out', tmp_path / 'out') == 0
    assert calls == [len(saved_map(folder).gaussians) for folder in runs]
    transforms = [json.loads((folder / 'run.json').read_text())['T_first_second'] for folder in (merged, tmp_path / 'out')]
    np.testing.assert_allclose(*transforms, atol=0.03)  # m: maps of 160 pixels


def test_a_run_that_was_merged_is_not_merged_again(
    runs: tuple[Path, Path], merged: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for pair in ((merged, runs[1]), (runs[0], merged)):
        capsys.readouterr()
        assert splatam('merge', *pair, '--out', tmp_path / 'out') == 2
        assert f'{merged} has all keyframes of' in error_line(capsys)
    assert not (tmp_path / 'out').exists()


@pytest.mark.parametrize('fault', ['same', 'copied', 'another room', 'no keyframes', 'anisotropic'])
def test_runs_that_cannot_be_joined(
    runs: tuple[Path, Path], fault: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = runs
    if fault == 'same':
        second = first
    elif fault == 'copied':
        second = Path(shutil.copytree(first, tmp_path / 'copy'))
    elif fault == 'another room':
        second = record(tmp_path / 'other', f'{ROOM},seed=1', 0)
    else:
        second = Path(shutil.copytree(second, tmp_path / 'copy'))
        if fault == 'no keyframes':
            (second / 'map.keyframes').unlink()
        else:
            gaussians = read_ply(second / 'map.ply').anisotropic()
            write_ply(second / 'map.ply', dataclasses.replace(gaussians, log_scales=gaussians.log_scales + torch.arange(3)))
    capsys.readouterr()
    assert splatam('merge', first, second, '--out', tmp_path / 'out') == 2
    says = {
        'same': 'are the same run',
        'copied': 'are the same run',
        'another room': 'too few to be sure|different places that look alike|must show the same place',
        'no keyframes': 'has no map.keyframes',
        'anisotropic': 'isotropic Gaussians and',
    }[fault]
    line = error_line(capsys)
    assert any(text in line for text in says.split('|')), line
    assert not (tmp_path / 'out').exists()


def test_a_run_that_began_upside_down(runs: tuple[Path, Path]) -> None:
    """Its world has another up axis: the camera was turned by half a circle about its axis."""
    config = load_config('realtime', FAST)
    tracker = make_tracker(make_rasterizer('cpu', 1), config.tracking, 1)
    first, second = saved_map(runs[0]), saved_map(runs[1])
    turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    keyframes = tuple(
        dataclasses.replace(
            one,
            view=dataclasses.replace(one.view, rgb8=one.view.rgb8.flip(0, 1), depth=one.view.depth.flip(0, 1)),
            T_cam_world=torch.from_numpy(turn.astype(np.float32)) @ one.T_cam_world @ torch.from_numpy(turn.astype(np.float32)),
        )
        for one in second.saved.keyframes
    )
    upside_down = SavedMap(transformed(second.gaussians, turn), dataclasses.replace(second.saved, keyframes=keyframes))
    straight, turned = (find_joint(first, each, tracker, config).T_first_second for each in (second, upside_down))
    np.testing.assert_allclose(turned @ turn, straight, atol=0.03)
    assert len(joined(first, upside_down, turned).gaussians) > len(first.gaussians)
