"""Processes under test that start fast: forks of one interpreter that has imported what takes seconds.

A process of its own as any other: its main module runs from the start, and the interpreter ends as usual.
"""

from __future__ import annotations

import ctypes
import io
import json
import os
import select
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
READ_AT_START = ('LD_LIBRARY_PATH', 'LD_PRELOAD', 'PYTHONPATH', 'PYTHONHASHSEED')
_PR_SET_CHILD_SUBREAPER = 36


class Forked:
    """A running fork; it is a child of this process. The methods are those of ``subprocess.Popen``."""

    def __init__(self, pid: int, arguments: Sequence[str]) -> None:
        self.pid, self.returncode = pid, None
        self._arguments, self._descriptor = arguments, os.pidfd_open(pid)

    def poll(self) -> int | None:
        return self._wait(0)

    def wait(self, timeout: float | None = None) -> int:
        code = self._wait(timeout)
        if code is None:
            raise subprocess.TimeoutExpired(self._arguments, timeout or 0.0)
        return code

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def _wait(self, timeout_s: float | None) -> int | None:
        if self.returncode is None and select.select([self._descriptor], [], [], timeout_s)[0]:
            self.returncode = os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])
            os.close(self._descriptor)
        return self.returncode


def can_fork(environment: Mapping[str, str]) -> bool:
    """Returns False if the environment holds what an interpreter reads when it starts, and this one has other values."""
    return all(environment.get(name) == os.environ.get(name) == _server().environment.get(name) for name in READ_AT_START)


def fork(arguments: Sequence[str], environment: Mapping[str, str], output: Path) -> Forked:
    """Start ``python ARGUMENTS``; the arguments begin with ``-m MODULE`` or ``-c CODE``.

    Args:
        arguments: of the interpreter.
        environment: all of it.
        output: an existing file; what the process says is added.
    """
    request = {'arguments': list(arguments), 'environment': dict(environment), 'output': str(output)}
    return Forked(_server().start(request), arguments)


class _Server:
    """The interpreter that forks."""

    def __init__(self) -> None:
        self.environment = dict(os.environ)
        self._process = subprocess.Popen(
            [sys.executable, __file__], cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
        )

    def start(self, request: dict[str, Any]) -> int:
        """Returns the number of the new process. It becomes our child when the process between has ended."""
        assert self._process.stdin is not None and self._process.stdout is not None
        libc = ctypes.CDLL(None)
        libc.prctl(_PR_SET_CHILD_SUBREAPER, 1)
        try:
            print(json.dumps(request), file=self._process.stdin, flush=True)
            return int(self._process.stdout.readline())
        finally:
            libc.prctl(_PR_SET_CHILD_SUBREAPER, 0)


@cache
def _server() -> _Server:
    return _Server()


# --- in the interpreter that forks ---


def serve() -> dict[str, Any] | None:
    """Fork for each request. Returns the request in a fork, and None in the server when there are no more."""
    requests, replies = os.fdopen(os.dup(0)), os.fdopen(os.dup(1), 'w')
    for line in requests:
        reading, writing = os.pipe()
        between = os.fork()
        if between == 0:
            if pid := os.fork():
                os.write(writing, str(pid).encode())
                os._exit(0)
            for file in (reading, writing, requests.fileno(), replies.fileno()):
                os.close(file)
            return json.loads(line)
        os.waitpid(between, 0)
        print(os.read(reading, 32).decode(), file=replies, flush=True)
        os.close(reading)
        os.close(writing)
    return None


def stream(descriptor: int, errors: str, line_buffering: bool) -> io.TextIOWrapper:
    """Returns an output of the process, as its own environment wants it; the server may have been started in another one."""
    unbuffered = bool(os.environ.get('PYTHONUNBUFFERED'))
    raw = os.fdopen(descriptor, 'wb', buffering=0 if unbuffered else -1, closefd=False)
    return io.TextIOWrapper(raw, errors=errors, line_buffering=line_buffering, write_through=unbuffered)


def become(request: dict[str, Any]) -> None:
    """Run the main module that was asked for, as the interpreter does."""
    import runpy

    os.environ.clear()
    os.environ.update(request['environment'])
    output, nothing = os.open(request['output'], os.O_WRONLY | os.O_APPEND), os.open(os.devnull, os.O_RDONLY)
    for source, target in ((nothing, 0), (output, 1), (output, 2)):
        os.dup2(source, target)
    os.close(output)
    os.close(nothing)
    sys.stdout, sys.stderr = stream(1, 'strict', line_buffering=False), stream(2, 'backslashreplace', line_buffering=True)
    option, main, *arguments = request['arguments']
    if option == '-m':
        sys.argv = [main, *arguments]
        runpy.run_module(main, run_name='__main__', alter_sys=True)
    else:
        sys.argv = ['-c', *arguments]
        exec(compile(main, '<string>', 'exec'), {'__name__': '__main__'})


def main() -> None:
    """Import what takes seconds, then fork."""
    import gc

    import cv2
    import matplotlib.figure  # noqa: F401
    import torch
    import torch._dynamo  # torch imports it at the first step of an optimizer: a second  # noqa: F401

    import splatam_core.slam
    import splatam_core.worker  # noqa: F401
    from splatam_core.datasets.room.caster import build_room

    if find_spec('rclpy'):
        import splatam_ros.node.node
        import splatam_ros.player.player  # noqa: F401

    cv2.setNumThreads(1)  # threads do not survive a fork
    build_room(0)
    cv2.setNumThreads(-1)
    gc.freeze()
    if (request := serve()) is not None:
        become(request)


if __name__ == '__main__':
    sys.path[0] = str(ROOT)  # as with python -m and -c
    main()
