"""The paper's ablations: each changes what its name says, and an interrupted set continues where it stopped."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest

from splatam_core.cli import main
from splatam_core.commands.shared import run_in_own_process
from splatam_core.config import flat_values
from splatam_core.errors import RunFolderError
from splatam_core.evaluation.ablations import FULL, provenance, rows, variant_names, variants

SMALL = ['synthetic', '--width', '48', '--max-frames', '3', '--set', 'threads=1', '--set', 'tracking.iterations=2',
         '--set', 'mapping.iterations=2']  # fmt: skip


def test_each_variant_changes_what_it_is_named_after_and_nothing_else() -> None:
    full, *others = variants(variant_names(), 'splatam')
    assert full.name == FULL and len(others) >= 9
    values = flat_values(full.config)
    changed = {
        variant.name: {name: value for name, value in flat_values(variant.config).items() if value != values[name]}
        for variant in others
    }
    assert changed['color_only'] == {'tracking.depth_weight': 0.0, 'mapping.depth_weight': 0.0}
    assert changed['depth_only'] == {'tracking.color_weight': 0.0}
    assert changed['no_velocity'] == {'tracking.motion_model': 'last_pose'}
    assert changed['no_silhouette'] == {'tracking.paper.use_silhouette': False}
    assert changed['silhouette_050'] == {'tracking.silhouette_threshold': 0.5}
    assert {name for values in changed.values() for name in values if name.startswith('keyframes')} == {'keyframes.selection'}
    assert all(changed.values())


def in_this_process(command: list[str], **_: object) -> subprocess.CompletedProcess[str]:
    """Replaces a process of its own, which would take seconds to import the libraries again."""
    return subprocess.CompletedProcess(command, main(command[3:]))


@pytest.mark.slow
@pytest.mark.usefixtures('undrawn')
def test_a_set_is_run_once_and_printed(tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    command = ['ablations', *SMALL, '--only', 'full', 'no_velocity', '--out', str(tmp_path)]
    monkeypatch.setattr('splatam_core.commands.shared.subprocess', SimpleNamespace(run=in_this_process))
    assert main(command) == 0
    first = capfd.readouterr()
    assert 'runs: 1' in first.out and all(f'| {name.ljust(11)} | 3/3     |' in first.out for name in ('full', 'no_velocity'))
    assert '<td>no_velocity</td>' in (tmp_path / 'ablations.html').read_text()
    written = {path: path.stat().st_mtime_ns for path in tmp_path.rglob('*') if path.is_file()}
    (tmp_path / 'no_velocity' / 'metrics.json').unlink()  # as if it had been stopped
    assert main(command) == 0
    again = capfd.readouterr()
    rows = [line.rpartition(' | ')[0] for text in (first.out, again.out) for line in text.splitlines() if line[:3] == '| n']
    assert rows[0] == rows[1]  # the same but for the time it took
    unchanged = {path for path, stamp in written.items() if path.stat().st_mtime_ns == stamp}
    assert {path.parent.name for path in unchanged} == {'full'}
    assert main([*command, '--set', 'seed=1']) == 2
    assert 'holds a run with other settings' in capfd.readouterr().err


def test_a_run_is_a_process_of_its_own(capfd: pytest.CaptureFixture[str]) -> None:
    assert run_in_own_process(['run', '--help']) == 0
    assert 'usage: splatam run' in capfd.readouterr().out
    assert run_in_own_process(['run', 'no-such-recording']) == 2


def test_an_unknown_ablation_lists_the_known(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['ablations', *SMALL, '--only', 'no_luck', '--out', 'never']) == 2
    assert "unknown ablation 'no_luck'; shipped: full, " in capsys.readouterr().err


@pytest.mark.parametrize('text', ['', '[' * 100_000, 'null', '{"machine": 3}', '\0', None])
def test_damaged_files_of_a_finished_run_are_one_line(tmp_path: Path, text: str | None) -> None:
    """They used to be read without the checks of other files: a pipe was waited for, deep nesting was a traceback."""
    for name in ('run.json', 'metrics.json', 'config.yaml', 'trajectory.txt'):
        (tmp_path / name).write_text('' if text is None else text)
    if text is None:
        (tmp_path / 'metrics.json').unlink()
        os.mkfifo(tmp_path / 'metrics.json')
    else:
        with pytest.raises(RunFolderError, match=r'metrics\.json:? cannot be read'):
            rows({'full': tmp_path})
    with pytest.raises(RunFolderError, match='cannot be read') as caught:
        provenance([tmp_path])
    assert '\n' not in str(caught.value)
    if text is None:
        assert rows({'full': tmp_path})[0][:2] == ('full', '–')
