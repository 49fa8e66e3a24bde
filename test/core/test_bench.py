"""``splatam bench``: every combination is run once, beside others, on a cluster that loses a worker; the rest is a table."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import pytest
from processes import wait_until

from splatam_core.cli import main
from splatam_core.commands import job_runners
from splatam_core.commands.bench import _names
from splatam_core.commands.job_runners import Job, Outcome, run_on_dask, run_side_by_side
from splatam_core.config import load_config
from splatam_core.errors import JobError
from splatam_core.runs.layout import SCORES
from splatam_core.runs.record import Source, read_run

FAST = ['--set', 'threads=1', '--set', 'tracking.iterations=2', '--set', 'mapping.iterations=1']
TINY = ['--width', '32', '--start', '1', '--max-frames', '3', *FAST]


def bench(*arguments: object) -> int:
    return main(['bench', *map(str, arguments)])


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch, undrawn: None) -> list[list[str]]:
    """Runs are made in this process and without pictures, because importing and drawing take longer; lists their words."""
    ran = []

    def run(command: list[str], stdout: object, check: bool) -> subprocess.CompletedProcess[str]:
        assert command[:3] == [sys.executable, '-m', 'splatam_core.cli'] and stdout is None and not check
        ran.append(command[3:])
        return subprocess.CompletedProcess(command, main(command[3:]))

    monkeypatch.setattr('splatam_core.commands.shared.subprocess', SimpleNamespace(run=run))
    return ran


@pytest.mark.slow
def test_every_combination_is_run_once(tmp_path: Path, here: list[list[str]], capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / 'b'
    few = ['synthetic', 'synthetic:noise=off', *TINY, '--presets', 'quick,realtime', '--seeds', '0,1', '--out', out]
    assert bench(*few) == 0
    names = [f'{source}_{preset}_seed{seed}' for source in ('synthetic', 'synthetic_noise_off') for preset in ('quick', 'realtime')
             for seed in (0, 1)]  # fmt: skip
    assert {entry.name for entry in out.iterdir()} == {*names, 'compare.png', 'compare.html'}
    run = read_run(out / 'synthetic_noise_off_realtime_seed1')
    assert run.config == load_config('realtime', [*FAST[1::2], 'seed=1'])
    assert run.description.source == Source('synthetic:noise=off', start=1, max_frames=3, width=32)
    text = capsys.readouterr().out
    every, summary = text.split('Median over seeds (smallest to largest):')
    assert [line.split('|')[1].strip() for line in every.splitlines() if line.startswith('| synthetic')] == names
    rows = [
        [cell.strip() for cell in line.split('|')[1:5]] for line in summary.splitlines() if line.startswith(('| quick', '| real'))
    ]
    assert rows == [
        [preset, source, '2', '6/6'] for source in ('synthetic', 'synthetic:noise=off') for preset in ('quick', 'realtime')
    ]
    page = (out / 'compare.html').read_text()
    assert f'href="{names[0]}/report.html"' in page and page.count('<tr>') == 2 + 4 + 8

    (out / names[3] / 'metrics.json').unlink()  # as if it had been stopped
    here.clear()
    assert bench(*few) == 0
    assert [words[-2] for words in here] == [str(out / names[3])]
    assert '7 of 8 runs are finished already' in capsys.readouterr().err
    assert bench(*few, '--set', 'tracking.iterations=3') == 2
    assert 'holds a run with other settings' in capsys.readouterr().err


@pytest.mark.slow
def test_a_run_that_fails_does_not_stop_the_others(
    tmp_path: Path, here: list[list[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / 'b'
    assert bench(tmp_path / 'nothing', 'synthetic', *TINY, '--presets', 'quick', '--out', out) == 2
    output = capsys.readouterr()
    assert '1 of 2 runs failed; the same command tries them again: nothing_quick: exit code 2; see above' in output.err
    assert '| synthetic_quick |' in output.out and 'nothing_quick' not in output.out


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        (['--presets', 'quick,quickest'], "'quickest'"),
        (['--presets', 'quick,quick'], 'different presets'),
        (['--presets', ''], 'different presets'),
        *(
            (['--presets', 'quick', '--dask', address], f'--dask {address}: ')
            for address in ('foo', 'tcp://', 'http://127.0.0.1:8786', '127.0.0.1:99999', 'tcp://127.0.0.1:x', '')
        ),
        (['--presets', 'quick', '--dask', 'tcp://127.0.0.1:1'], 'no Dask scheduler answers at tcp://127.0.0.1:1'),
    ],
)
def test_what_cannot_be_run_is_refused_before_it_begins(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if '--dask' in arguments:
        pytest.importorskip('distributed')
        monkeypatch.setattr(job_runners, 'CONNECT_S', 0.5)
    assert bench('synthetic', *arguments, '--out', tmp_path / 'b') == 2
    assert message in capsys.readouterr().err and not (tmp_path / 'b').exists()


@pytest.mark.parametrize(
    ('option', 'text', 'message'),
    [
        ('--seeds', '0,0', 'expected different whole numbers separated by commas'),
        ('--seeds', '', 'expected different whole numbers'),
        ('--seeds', '0,x', "'x' is not a whole number"),
        ('--jobs', 'many', "'many' is not a whole number"),
        ('--jobs', '0', '0 is not at least 1'),
        ('--max-interval', 'short', "'short' is not a number"),
    ],
)
def test_wrong_numbers_are_refused_in_plain_words(
    option: str, text: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        bench('synthetic', '--presets', 'quick', option, text, '--out', tmp_path / 'b')
    assert message in capsys.readouterr().err


def test_recordings_of_equal_names_get_folders_of_their_own() -> None:
    assert _names(['/a/room', '/b/room', '/c/x.mcap', '/d/x', 'synthetic', 'synthetic:seed=1,hz=5']) == [
        'room', 'room_2', 'x', 'x_4', 'synthetic', 'synthetic_seed_1_hz_5'
    ]  # fmt: skip


# --- side by side ---

SCRIPT = """
import os, sys, time
from pathlib import Path
name, out = sys.argv[1], Path(sys.argv[3])
together = len(list(out.parent.glob('*.runs')))
Path(f'{out}.runs').write_text('')
print('name', name, flush=True)
time.sleep(float(os.environ['JOB_S']))
os.unlink(f'{out}.runs')
out.mkdir()
(out / 'beside').write_text(str(together))
if name == 'b':
    sys.exit('b is broken')
"""


@pytest.fixture
def scripts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Job]:
    """Jobs that take no time, in place of runs."""
    monkeypatch.setattr(job_runners, 'process_that_ends_with_this', lambda words: [sys.executable, '-c', SCRIPT, *words])
    monkeypatch.setattr(job_runners, 'POLL_S', 0.01)
    monkeypatch.setenv('JOB_S', '0.2')
    return [Job(name, (name,), tmp_path / 'out' / name) for name in 'abcd']


def test_several_run_at_a_time_and_only_failures_leave_what_they_printed(scripts: list[Job], tmp_path: Path) -> None:
    outcomes = {outcome.job.name: outcome.failure for outcome in run_side_by_side(scripts, 2)}
    failure = outcomes.pop('b')
    assert outcomes == dict.fromkeys('acd', '') and failure.startswith('exit code 1: name b / b is broken; all of it is in ')
    assert {path.name for path in (tmp_path / 'out').iterdir()} == {'a', 'b', 'c', 'd', 'b.log'}
    assert max(int(path.read_text()) for path in (tmp_path / 'out').glob('*/beside')) <= 1


def test_runs_end_with_the_bench(scripts: list[Job], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv('JOB_S', '60')
    started = []
    real = job_runners._start
    monkeypatch.setattr(job_runners, '_start', lambda words, log: started.append(real(words, log)) or started[-1])
    monkeypatch.setattr(job_runners.time, 'sleep', lambda seconds: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        list(run_side_by_side(scripts, 3))
    assert len(started) == 3 and all(process.returncode == -signal.SIGTERM for process in started)


# --- on a cluster ---


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Callable[[], subprocess.Popen[bytes]]]:
    """A scheduler on loopback, whose address it has; each call starts a worker."""
    pytest.importorskip('distributed')
    with closing(socket.socket()) as free:
        free.bind(('127.0.0.1', 0))
        port = free.getsockname()[1]
    processes: list[subprocess.Popen[bytes]] = []

    def start(module: str, *arguments: str) -> subprocess.Popen[bytes]:
        with (tmp_path / f'{len(processes)}.log').open('wb') as log:
            command = [sys.executable, '-m', f'distributed.cli.{module}', *arguments, '--host', '127.0.0.1', '--no-dashboard']
            processes.append(subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, cwd=tmp_path))
        return processes[-1]

    start('dask_scheduler', '--port', str(port))

    def worker() -> subprocess.Popen[bytes]:
        return start('dask_worker', worker.address, '--nthreads', '1', '--no-nanny')

    worker.address = f'tcp://127.0.0.1:{port}'
    yield worker
    for process in processes:
        process.kill()
        process.wait()


def children(process: int) -> list[int]:
    found = Path(f'/proc/{process}/task').glob('*/children')
    return [int(child) for path in found for child in path.read_text().split()]


@pytest.mark.slow
def test_a_cluster_that_loses_a_worker_runs_everything(cluster: Callable[[], subprocess.Popen[bytes]], tmp_path: Path) -> None:
    words = ('run', 'synthetic', *TINY, '--preset', 'realtime', '--no-evaluate')
    jobs = [Job(f'seed{seed}', (*words, '--set', f'seed={seed}'), tmp_path / 'b' / f'seed{seed}') for seed in range(3)]
    workers = [cluster(), cluster()]
    outcomes = run_on_dask(jobs, cluster.address)
    first = next(outcomes)
    orphan = kill_one_that_works(workers)
    assert [outcome.failure for outcome in (first, *outcomes)] == [''] * 3
    wait_until(lambda: not is_alive(orphan), 5.0, lambda: 'the run of the worker that was killed has not ended')
    for job in jobs:
        assert {path.name for path in job.folder.iterdir()} == {
            'trajectory.txt',
            'trajectory_final.txt',
            'frames.csv',
            'map.ply',
            'map.keyframes',
            'metrics.json',
            'config.yaml',
            'run.json',
        }
        assert read_run(job.folder).config.seed == int(job.name[-1])


def kill_one_that_works(workers: list[subprocess.Popen[bytes]]) -> int:
    """Kills a worker in the middle of a run. Returns the process of that run."""
    working: list[tuple[subprocess.Popen[bytes], int]] = []

    def found() -> bool:
        working[:] = [(worker, child) for worker in workers for child in children(worker.pid)]
        return bool(working)

    wait_until(found, explain=lambda: 'no worker runs anything')
    worker, orphan = working[0]
    worker.kill()
    worker.wait()
    return orphan


def is_alive(process: int) -> bool:
    try:
        return Path(f'/proc/{process}/stat').read_text().rpartition(')')[2].split()[0] != 'Z'
    except (FileNotFoundError, ProcessLookupError):  # ended, before the file was opened or while it was read
        return False


def test_a_run_that_fails_on_a_worker_says_why(cluster: Callable[[], subprocess.Popen[bytes]], tmp_path: Path) -> None:
    cluster()
    job = Job('broken', ('no-such-command',), tmp_path / 'out' / 'broken')
    (outcome,) = run_on_dask([job], cluster.address)
    assert outcome == Outcome(job, outcome.failure) and outcome.failure.startswith('exit code 2: ')
    assert "invalid choice: 'no-such-command'" in outcome.failure and not job.folder.exists()


def test_without_dask_the_extra_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, 'distributed', None)
    with pytest.raises(JobError, match=r"pip install 'splatam_ros\[dask\]'"):
        list(run_on_dask([Job('a', (), tmp_path)], 'tcp://127.0.0.1:1'))


def test_the_files_of_a_run_arrive_complete_and_nothing_else(tmp_path: Path) -> None:
    job_runners._save(tmp_path / 'run', {SCORES: b'1', '../escape': b'2'})
    assert [path.name for path in tmp_path.rglob('*') if path.is_file()] == [SCORES]
