"""The demo as a process: a complete run, folders that it refuses to remove, and no process left behind."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from domains import reserve_domain
from processes import wait_until

from splatam_core.interruption import STOP_SIGNALS, on_stop_signals
from splatam_core.maps.viewer.browser import find_browser
from splatam_ros.demo import Processes, require_replaceable, stop

DEMO = [sys.executable, '-m', 'splatam_ros.demo']
TAG = 'SPLATAM_TEST_DEMO'
TIMEOUT_S = 240  # a few seconds alone, but continuous integration may share its cores


def start_demo(out: Path, source: str) -> subprocess.Popen[str]:
    """Start the demo; each of its processes is tagged with the folder."""
    return subprocess.Popen(
        [*DEMO, source, '--out', str(out)], env={**os.environ, TAG: str(out)},
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip


def alive(out: Path) -> list[str]:
    """Returns the command lines of the processes with the folder's tag."""
    found = []
    for process in Path('/proc').glob('[0-9]*'):
        try:
            if f'{TAG}={out}'.encode() in (process / 'environ').read_bytes():
                found.append((process / 'cmdline').read_text().replace('\0', ' '))
        except OSError:  # ended meanwhile, or not ours
            continue
    return found


@pytest.fixture(autouse=True)
def domain(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A ROS domain that no other test uses meanwhile."""
    number, reservation = reserve_domain()
    monkeypatch.setenv('ROS_DOMAIN_ID', str(number))
    with reservation:
        yield


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / 'demo'


def test_the_whole_way(out: Path) -> None:
    process = start_demo(out, 'synthetic:frames=4')
    said, _ = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 0, said
    metrics = json.loads((out / 'metrics.json').read_text())
    assert metrics['tracked'] == metrics['frames'] == 4
    assert metrics['ate_rmse_m'] < 0.005  # measured 0.2 cm; poses that all stood still would be off by 0.9 cm
    written = {'report.html', 'report.png', 'map.ply', 'trajectory.txt', *(['viewer.png'] if find_browser() else [])}
    assert written <= {path.name for path in out.iterdir()}
    assert ('alt="the map in the viewer"' in (out / 'report.html').read_text()) == bool(find_browser())
    assert f'{out}/report.html' in said and re.search(r'watch the map grow: http://127\.0\.0\.1:\d+, for this machine only', said)
    assert len(said.partition('try next:\n')[2].splitlines()) == 3
    assert not alive(out)
    require_replaceable(out)  # by the next run


@pytest.mark.parametrize('name', ['demo', 'demo-input'])
def test_what_somebody_else_made_is_left_alone(out: Path, name: str) -> None:
    precious = out.with_name(name) / 'thesis.txt'
    precious.parent.mkdir()
    precious.touch()
    process = start_demo(out, 'synthetic:frames=4')
    said, _ = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 1
    assert said.splitlines() == [
        f'demo: {precious.parent} exists and was not created by the demo: move it away, or choose another --out'
    ]
    assert precious.exists()


def test_a_step_that_fails_is_named(out: Path) -> None:
    process = start_demo(out, str(out / 'nowhere'))
    said, _ = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 1
    assert 'no such file or folder' in said
    assert said.splitlines()[-1] == "demo: 'splatam convert' ended with exit code 2; its output is above"


def test_a_node_that_dies_ends_the_demo_with_its_last_words(out: Path) -> None:
    process = start_demo(out, 'synthetic:frames=30')
    wait_until(lambda: any('splatam_ros.player.main' in command for command in alive(out)), TIMEOUT_S)
    wait_until(lambda: (out / 'trajectory.txt').is_file(), TIMEOUT_S)
    node = next(
        int(path.parent.name)
        for path in Path('/proc').glob('[0-9]*/cmdline')
        if f'save_path:={out}'.encode() in path.read_bytes() and b'splatam_ros.node.main' in path.read_bytes()
    )
    os.kill(node, signal.SIGKILL)
    said, _ = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 1
    assert 'was killed by SIGKILL' in said
    assert 'node.log' in said
    wait_until(lambda: not alive(out), TIMEOUT_S)  # the viewer notices by itself that the node is gone


@pytest.mark.parametrize('number', STOP_SIGNALS)
def test_a_signal_while_a_process_starts_ends_it(number: signal.Signals, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The child lives already, but ``Popen`` has not returned."""
    begun, start = [], subprocess.Popen

    def started(*args: object, **options: object) -> subprocess.Popen[bytes]:
        begun.append(start([sys.executable, '-c', 'import time; time.sleep(60)'], stdout=subprocess.DEVNULL))
        os.kill(os.getpid(), number)
        return begun[0]

    monkeypatch.setattr(subprocess, 'Popen', started)
    with on_stop_signals(stop), pytest.raises(KeyboardInterrupt), Processes() as processes:
        processes.start('splatam', log=tmp_path / 'log')
    assert begun[0].poll() is not None


@pytest.mark.parametrize(('number', 'step'), [(signal.SIGINT, 'convert'), (signal.SIGHUP, 'splatam_ros.player.main')])
def test_a_signal_ends_every_process(out: Path, number: signal.Signals, step: str) -> None:
    process = start_demo(out, 'synthetic:frames=12')
    wait_until(lambda: any(step in command for command in alive(out)), TIMEOUT_S)
    process.send_signal(number)
    said, _ = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 130, said
    assert said.splitlines()[-1] == 'demo: interrupted'
    assert not alive(out)
