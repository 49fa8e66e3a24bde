"""Run folders, settings and checkpoints that 0.1.0 wrote are read, or refused in one line that says what to do."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from splatam_core.cli import EXIT_ERROR, main
from splatam_core.config import SlamConfig, flat_values, load_config, parse_overrides
from splatam_core.maps.ply import read_ply
from splatam_core.runs.archive import Content, pack, read_archive
from splatam_core.runs.checkpoints import checkpoint_paths, read_newest
from splatam_core.runs.layout import CHECKPOINTS, CONFIG, FRAMES, MAP, TRAJECTORY
from splatam_core.runs.record import RunDescription, Source, read_run

FIXTURES = Path(__file__).parent / 'fixtures_0_1_0'
FRAMES_RUN, FRAMES_SAVED = 8, 6
WIDTHS = {'realtime': 40, 'splatam': 28}
SETTINGS = {'realtime': ['threads=1'], 'splatam': ['threads=1', 'tracking.iterations=10', 'mapping.iterations=24']}
NAMES = tuple(WIDTHS)
CLOSE_M = 0.045  # two thirds of a pixel of these tiny images: tracking has changed since, and processors round differently


def splatam(*words: object) -> int:
    return main([str(word) for word in words])


PRESET_THEN: dict[str, dict[str, object]] = {
    'realtime': {
        'densification.depth_noise_ratio': 0.0,
        'tracking.silhouette_threshold': 0.99,
        'mapping.max_gaussians': 0,
        'mapping.fused.final_passes': 12,
        'tracking.align.relocalisation.enabled': False,
        'graph.enabled': False,
        'mapping.fused.tolerance': 0.0,
    }
}


def config_of(name: str) -> SlamConfig:
    """The settings that the run was started with; a preset may have changed since."""
    return load_config(name, {**parse_overrides(SETTINGS[name]), **PRESET_THEN.get(name, {})})


def metrics(folder: Path) -> dict[str, object]:
    return json.loads((folder / 'metrics.json').read_text())


@pytest.fixture(params=NAMES)
def name(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture
def run(name: str, tmp_path: Path) -> Path:
    """A copy of a run folder of 0.1.0."""
    return Path(shutil.copytree(FIXTURES / name, tmp_path / name))


def refused(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    """The one line with which a command refuses."""
    capsys.readouterr()
    assert splatam(*words) == EXIT_ERROR
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith('splatam: error: ')]
    assert len(lines) == 1
    return lines[0]


def test_a_run_folder_is_read(name: str) -> None:
    run = read_run(FIXTURES / name)
    source = Source('synthetic:noise=off', width=WIDTHS[name], max_frames=FRAMES_RUN)
    assert run.description == RunDescription('splatam run', name, source, FRAMES_SAVED, 1)
    assert run.versions['splatam_ros'] == '0.1.0' and run.commit is not None and run.commit.startswith('6b97830')
    assert len(run.frames) == len(run.trajectory) == FRAMES_RUN
    assert [frame.stamp_ns for frame in run.frames] == run.trajectory.stamps_ns.tolist()
    header, first, second, *_ = (FIXTURES / name / FRAMES).read_text().splitlines()
    column = header.split(',').index('sure_fraction')  # its name then
    assert [f'{frame.visible_fraction:.4f}' for frame in run.frames[:2]] == [line.split(',')[column] for line in (first, second)]
    assert len(run.read_map()) == run.metrics().num_gaussians == run.frames[-1].num_gaussians
    assert run.metrics().psnr_db == metrics(FIXTURES / name)['psnr_db']


def test_settings_mean_what_they_meant(name: str) -> None:
    config = load_config(str(FIXTURES / name / CONFIG))
    assert config == config_of(name) == read_newest(FIXTURES / name / CHECKPOINTS).state.config


@pytest.mark.slow
def test_a_run_folder_is_evaluated(name: str, run: Path, request: pytest.FixtureRequest) -> None:
    if name != 'realtime':
        request.getfixturevalue('undrawn')
    assert splatam('evaluate', run) == 0
    before, after = metrics(FIXTURES / name), metrics(run)
    assert after.keys() >= before.keys()
    scores = 'ate_rmse_m', 'rpe_rot_frame_deg', 'psnr_db', 'ssim', 'depth_l1_m', 'splatam_psnr_db', 'splatam_depth_l1_m'
    for score in scores:
        assert after[score] == pytest.approx(before[score], rel=1e-4), score
    for number in ('frames', 'tracked', 'lost', 'fps', 'num_gaussians', 'evaluated_frames', 'peak_rss_mb'):
        assert after[number] == before[number], number
    assert (run / 'report.html').is_file() and (run / 'report.png').is_file()


@pytest.mark.slow
@pytest.mark.usefixtures('undrawn')
def test_a_run_folder_is_rendered_exported_compared_and_refined(
    run: Path, name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert splatam('render', run, '--out', tmp_path / 'film', '--no-video') == 0
    assert len(list((tmp_path / 'film' / 'color').iterdir())) == FRAMES_RUN
    assert splatam('export', run, tmp_path / 'map.ply') == 0
    assert torch.equal(read_ply(tmp_path / 'map.ply').means, read_ply(run / MAP).means)
    assert splatam('export', run, tmp_path / 'params.npz', '--as', 'splatam') == 0
    assert np.load(tmp_path / 'params.npz')['cam_trans'].shape == (1, 3, FRAMES_RUN)
    assert splatam('compare', run, '--plot', tmp_path / 'plot.png') == 0
    assert f'| {name} |' in capsys.readouterr().out
    assert splatam('refine', run, '--out', tmp_path / 'refined', '--iterations', 2) == 0
    assert read_run(tmp_path / 'refined').config == config_of(name)


@pytest.mark.slow
def test_a_resumed_run_ends_like_an_uninterrupted_one(name: str, run: Path, tmp_path: Path) -> None:
    """Bit for bit where the present code repeats the recorded run bit for bit; else closely."""
    old, whole = read_run(FIXTURES / name), tmp_path / 'whole'
    words = ['synthetic:noise=off', '--width', WIDTHS[name], '--max-frames', FRAMES_RUN]
    assert splatam('run', *words, '--preset', run / CONFIG, '--no-evaluate', '--out', whole) == 0
    assert splatam('run', '--resume', run, '--no-evaluate') == 0
    new = read_run(run)
    assert len(new.frames) == len(new.trajectory) == FRAMES_RUN
    assert yaml.safe_load((run / CONFIG).read_text()) == yaml.safe_load((whole / CONFIG).read_text())
    if (whole / TRAJECTORY).read_bytes() == (FIXTURES / name / TRAJECTORY).read_bytes():
        assert (run / TRAJECTORY).read_bytes() == (whole / TRAJECTORY).read_bytes()
        assert (run / MAP).read_bytes() == (whole / MAP).read_bytes()
    else:
        centres_m = [record.trajectory.T_world_cam[:, :3, 3] for record in (new, read_run(whole), old)]
        np.testing.assert_allclose(centres_m[0], centres_m[1], atol=CLOSE_M)
        np.testing.assert_allclose(centres_m[1], centres_m[2], atol=CLOSE_M)
        assert len(new.read_map()) == pytest.approx(len(old.read_map()), rel=0.05)


def test_a_removed_setting_that_was_used_is_refused(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its default is dropped, as the tests above show; any other value would be another run."""
    text = (run / CONFIG).read_text()
    (run / CONFIG).write_text(text.replace('reset_opacity_every: 0', 'reset_opacity_every: 9'))
    line = refused(capsys, 'evaluate', run)
    assert 'mapping.reset_opacity_every' in line and 'removed in 0.2.0' in line
    (run / CONFIG).write_text(text)
    path = checkpoint_paths(run / CHECKPOINTS)[-1]
    content = read_archive(path, 'checkpoint', 1)
    config = {**content.values['config'], 'mapping.reset_opacity_every': 9}
    pack('checkpoint', 1, Content({**content.values, 'config': config}, content.arrays)).write(path)
    line = refused(capsys, 'run', '--resume', run)
    assert 'mapping.reset_opacity_every' in line and 'use the version that wrote it' in line


def test_an_old_name_in_set_names_the_new_one(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    old = yaml.safe_load((FIXTURES / name / CONFIG).read_text())
    assert 'settle' in old['densification'] and 'densification.settle' not in flat_values(config_of(name))
    line = refused(capsys, 'run', 'synthetic', '--preset', name, '--set', 'densification.settle=1', '--out', 'never')
    assert "'densification.bias_correction_rounds'" in line
