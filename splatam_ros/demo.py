"""``make demo``: plays a recording through player, DDS and node, as on a robot, shows the map grow, and scores the result.

Run as ``python -m splatam_ros.demo [SOURCE] [--out DIR]``. DIR becomes the run's folder. The folder ``DIR-input`` beside
it holds the SOURCE as a rosbag2 with the node's topic names and small images, and the node's log.
"""

from __future__ import annotations

import argparse
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from types import FrameType, TracebackType

from splatam_core.errors import ViewerError
from splatam_core.interruption import on_stop_signals
from splatam_core.maps.viewer.browser import find_browser
from splatam_core.maps.viewer.scene import check_viser
from splatam_core.runs.layout import VIEWER_PICTURE

SCENE = 'synthetic'
SCENE_FRAMES = 300
WIDTH = 320
PRESET = 'realtime'
VIEWER_PORT = 8080
VIEWER_LINE = 'viewer at '  # of the node's log
MARKER = '.demo'
COMMANDS = {
    'splatam': 'splatam_core.cli',
    'splatam_node': 'splatam_ros.node.main',
    'splatam_bag_player': 'splatam_ros.player.main',
}
FINISH_TIMEOUT_S = 120.0
VIEWER_TIMEOUT_S = 30.0
STOP_TIMEOUT_S = 20.0
LOG_LINES = 15


class DemoError(Exception):
    """The demo failed; the message explains why to its user."""


class Processes:
    """Child processes of the demo. They end with the ``with`` block.

    Each has its own session, so that Ctrl-C reaches only the demo, which then stops them in order.
    """

    def __init__(self) -> None:
        self._environment = graph_environment(os.environ, os.getpid())
        self._started: list[subprocess.Popen[bytes]] = []

    def start(self, *command: str, log: Path | None = None) -> subprocess.Popen[bytes]:
        """Start one of the package's commands. Its output goes to the log, or to the terminal if there is none."""
        print(f'$ {shlex.join(command)}' + (f' &> {log}' if log else ''), flush=True)
        with log.open('wb') if log else nullcontext() as output, signals_wait():
            process = subprocess.Popen(
                [sys.executable, '-m', COMMANDS[command[0]], *command[1:]],
                env=self._environment, stdin=subprocess.DEVNULL, stdout=output, stderr=output, start_new_session=True,
            )  # fmt: skip
            self._started.append(process)
        return process

    def run(self, *command: str) -> None:
        """Run a command and wait for its end.

        Raises:
            DemoError: the command failed.
        """
        process = self.start(*command)
        if process.wait() != 0:
            raise DemoError(f"'{' '.join(command[:2])}' {ending(process)}; its output is above")

    def __enter__(self) -> Processes:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        running = [process for process in reversed(self._started) if process.poll() is None]
        for process in running:
            process.send_signal(signal.SIGINT)
        try:
            for process in running:
                process.wait(STOP_TIMEOUT_S)
        except (subprocess.TimeoutExpired, KeyboardInterrupt):  # a second Ctrl-C stops waiting
            for process in running:
                process.kill()
                process.wait()


def graph_environment(environment: Mapping[str, str], seed: int) -> dict[str, str]:
    """Returns an environment with a ROS graph of its own, unless the user has set which graph to join."""
    return {
        'ROS_DOMAIN_ID': str(1 + seed % 101),  # above 101 the ports may be in use by other programs
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        **environment,
    }


def ending(process: subprocess.Popen[bytes]) -> str:
    """Returns how a process ended, as the end of a sentence."""
    code = process.returncode
    return f'was killed by {signal.Signals(-code).name}' if code < 0 else f'ended with exit code {code}'


def last_lines(log: Path) -> str:
    """Returns the last lines of a log, indented."""
    return '\n'.join(f'  {line}' for line in log.read_text(errors='replace').splitlines()[-LOG_LINES:])


def require_replaceable(folder: Path) -> None:
    """Check that a folder does not exist, or was created by an earlier demo.

    Raises:
        DemoError: the folder was not created by the demo.
    """
    if folder.exists() and not (folder / MARKER).is_file():
        raise DemoError(f'{folder} exists and was not created by the demo: move it away, or choose another --out')


def has_viewer() -> bool:
    """Returns whether the map can be shown in a browser; if not, says why."""
    try:
        check_viser()
    except ViewerError as error:
        print(f'the map is not shown while it grows: {error}')
        return False
    return True


def play(processes: Processes, bag: Path, out: Path, log: Path, *, is_shown: bool) -> None:
    """Play the recording into the node, at its own rate, until both have ended.

    Args:
        processes: starts them.
        bag: the recording.
        out: folder of the run.
        log: of the node.
        is_shown: whether the node shows the map in a browser.

    Raises:
        DemoError: the player or the node failed.
    """
    parameters = {'preset': PRESET, 'save_path': out, 'queue_policy': 'all', 'exit_on_publisher_end': 'true'}
    parameters |= {'viewer.port': VIEWER_PORT} if is_shown else {}
    settings = [word for name, value in parameters.items() for word in ('-p', f'{name}:={value}')]
    node = processes.start('splatam_node', '--ros-args', *settings, log=log)
    player = processes.start('splatam_bag_player', str(bag), '--wait-for')
    try:
        if is_shown:
            say_address(node, log)
        wait_for_both(player, node)
    except DemoError as error:
        raise DemoError(f'{error}; the last lines of {log}:\n{last_lines(log)}') from None


def say_address(node: subprocess.Popen[bytes], log: Path) -> None:
    """Wait until the node's log tells where the map is shown, and tell it."""
    deadline_s = time.monotonic() + VIEWER_TIMEOUT_S
    while node.poll() is None and time.monotonic() < deadline_s:
        for line in log.read_text(errors='replace').splitlines():
            if line.startswith(VIEWER_LINE):
                print(f'watch the map grow: {line.removeprefix(VIEWER_LINE)}', flush=True)
                return
        time.sleep(0.1)


def take_picture(processes: Processes, out: Path) -> None:
    """Save what a browser shows of the map, which opens the report; say so if that is not possible."""
    if find_browser() is None:
        print('no picture of the viewer: apt install chromium')
        return
    try:
        processes.run('splatam', 'view', str(out), '--screenshot', str(out / VIEWER_PICTURE))
    except DemoError as error:
        print(f'no picture of the viewer: {error}')


def wait_for_both(player: subprocess.Popen[bytes], node: subprocess.Popen[bytes]) -> None:
    """Wait for the player and then for the node. The node must not end first.

    Raises:
        DemoError: one of them failed, or the node does not end in time.
    """
    while player.poll() is None:
        if node.poll() is not None:
            raise DemoError(f'splatam_node {ending(node)} before the end of the recording')
        time.sleep(0.1)
    if player.returncode != 0:
        raise DemoError(f'splatam_bag_player {ending(player)}; its output is above')
    try:
        node.wait(FINISH_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        raise DemoError(f'splatam_node is still running {FINISH_TIMEOUT_S:.0f} s after the end of the recording') from None
    if node.returncode != 0:
        raise DemoError(f'splatam_node {ending(node)}')


def demo(source: str | None, out: Path) -> None:
    """Convert the source to a bag, play it, and score the run.

    Args:
        source: any recording that ``splatam convert`` reads; None = a synthetic room.
        out: folder of the run.

    Raises:
        DemoError: a step failed.
    """
    work = out.with_name(f'{out.name}-input')
    bag = work / 'recording'
    require_replaceable(out)
    require_replaceable(work)
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    (work / MARKER).touch()
    cut = ('--max-frames', str(SCENE_FRAMES)) if source is None else ()
    is_shown = has_viewer()
    with Processes() as processes:
        processes.run('splatam', 'convert', source or SCENE, str(bag), '--width', str(WIDTH), *cut)
        shutil.rmtree(out, ignore_errors=True)
        try:
            play(processes, bag, out, work / 'node.log', is_shown=is_shown)
            if is_shown:
                take_picture(processes, out)
            processes.run('splatam', 'evaluate', str(out), '--truth', str(bag))
        finally:
            if out.is_dir():
                (out / MARKER).touch()


def next_steps(out: Path) -> str:
    """Returns three commands to try next."""
    beside = Path(sys.executable).with_name('splatam')
    program = os.path.relpath(beside) if beside.is_file() else 'splatam'
    commands = (
        (f'{program} view {out}', 'fly through the map, move through time'),
        (f'{program} export {out} {out}/map.yaml --as grid', 'its floor plan, for Nav2'),
        ('make demo BAG=path', 'the same with a recording of your own'),
    )
    width = max(len(command) for command, _ in commands)
    return '\n'.join(['try next:', *(f'  {command:{width}}  # {what}' for command, what in commands)])


def stop(number: int, frame: FrameType | None) -> None:
    """End the demo and its processes."""
    raise KeyboardInterrupt


@contextmanager
def signals_wait() -> Iterator[None]:
    """Lets signals that end the demo wait for the end of a block: a process must be known before they end it."""
    came: list[int] = []
    with on_stop_signals(lambda number, _: came.append(number)):
        yield
    if came:
        raise KeyboardInterrupt


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the demo. Returns the exit code."""
    parser = argparse.ArgumentParser('splatam_ros.demo', description='Play a recording into the node and score it.')
    parser.add_argument('source', nargs='?', metavar='SOURCE', help='a rosbag2 or a dataset (default: a synthetic room)')
    parser.add_argument('--out', type=Path, default=Path('out/demo'), help='folder of the run (default: %(default)s)')
    args = parser.parse_args(arguments)
    try:
        with on_stop_signals(stop):  # background jobs of a shell ignore SIGINT otherwise
            demo(args.source, args.out)
        print(f'look at {args.out}/report.html; beside it are report.png, map.ply, trajectory.txt and metrics.json')
        print(next_steps(args.out))
    except DemoError as error:
        print(f'demo: {error}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print('demo: interrupted', file=sys.stderr)
        return 130
    return 0


if __name__ == '__main__':
    sys.exit(main())
