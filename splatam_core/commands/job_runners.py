"""Many runs of ``splatam run``: one after another, several at a time, or on the workers of a Dask cluster."""

from __future__ import annotations

import subprocess
import time
import uuid
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from splatam_core.commands.shared import process_that_ends_with_this, run_in_own_process, say
from splatam_core.errors import JobError, one_line

POLL_S = 0.2
CONNECT_S = 20
LAST_LINES = 3
"""Of what a run printed, shown if it failed."""


@dataclass(frozen=True, slots=True)
class Job:
    """One run.

    Attributes:
        name: for people.
        words: the words after ``splatam``, without ``--out``.
        folder: where its run folder is to be.
    """

    name: str
    words: tuple[str, ...]
    folder: Path


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a run ended.

    Attributes:
        job: the run.
        failure: why there is no result; '' = it went well.
    """

    job: Job
    failure: str = ''


def run_one_by_one(jobs: Sequence[Job]) -> Iterator[Outcome]:
    """Runs jobs one after another; what they print appears here."""
    for job in jobs:
        code = run_in_own_process([*job.words, '--out', job.folder, '--overwrite'])
        yield Outcome(job, f'exit code {code}; see above' if code else '')


def run_side_by_side(jobs: Sequence[Job], count: int) -> Iterator[Outcome]:
    """Runs several jobs at a time. What a job prints is in a file beside its folder until it went well.

    Args:
        jobs: the jobs.
        count: how many run at a time.
    """
    waiting: list[Job] = list(jobs)
    running: dict[subprocess.Popen[bytes], Job] = {}
    try:
        while waiting or running:
            while waiting and len(running) < count:
                job = waiting.pop(0)
                job.folder.parent.mkdir(parents=True, exist_ok=True)
                with _log(job).open('wb') as log:
                    running[_start([*job.words, '--out', str(job.folder), '--overwrite'], log)] = job
            ended = [process for process in running if process.poll() is not None]
            for process in ended:
                yield _ended(running.pop(process), process.returncode)
            if not ended:
                time.sleep(POLL_S)
    finally:
        for process in running:
            process.terminate()
        for process in running:
            process.wait()


def _log(job: Job) -> Path:
    return job.folder.with_name(f'{job.folder.name}.log')


def _ended(job: Job, code: int) -> Outcome:
    if code:
        return Outcome(job, f'{_why(code, _log(job).read_bytes())}; all of it is in {_log(job)}')
    _log(job).unlink()
    return Outcome(job)


def _start(words: Sequence[str], log: Any) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        process_that_ends_with_this(words), stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT
    )  # fmt: skip


def _why(code: int, printed: bytes) -> str:
    lines = [line.strip() for line in printed.decode(errors='replace').replace('\r', '\n').splitlines() if line.strip()]
    return f'exit code {code}: {one_line(" / ".join(lines[-LAST_LINES:])) or "it printed nothing"}'


# --- on a cluster ---


@dataclass(frozen=True, slots=True)
class RemoteRun:
    """What a worker sends back.

    Attributes:
        code: the exit code.
        printed: what the run printed.
        files: content of the files of the run folder, by name; empty if the run failed.
    """

    code: int
    printed: bytes
    files: Mapping[str, bytes] = field(default_factory=dict)


def run_on_dask(jobs: Sequence[Job], address: str) -> Iterator[Outcome]:
    """Runs jobs on the workers of a Dask cluster, in the order in which they end.

    A worker runs a job in a temporary folder and sends the run folder back, so that no file system need be shared, and a run
    that lost its worker starts anew on another one. Recordings must be at the same paths on every worker.

    Args:
        jobs: the jobs.
        address: of the scheduler, such as ``tcp://host:8786``.

    Raises:
        JobError: the package is missing, or no scheduler answers.
    """
    distributed = _distributed()
    _check_address(address)
    try:
        client = distributed.Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError, distributed.TimeoutError) as error:
        raise JobError(
            f'no Dask scheduler answers at {address}: {one_line(error) or "timed out"}; start one: dask scheduler'
        ) from None
    with client:
        if not client.scheduler_info()['workers']:
            say(f'the scheduler has no workers yet: dask worker {address} --nthreads 1')
        submitted = {
            client.submit(run_remotely, job.words, job.name, key=f'{job.name}-{uuid.uuid4()}', pure=False): job for job in jobs
        }
        try:
            for future in distributed.as_completed(list(submitted), loop=client.loop):
                yield _received(submitted.pop(future), future)
                future.release()  # the worker may forget the files
        finally:
            client.cancel(list(submitted))


def _distributed() -> Any:
    try:
        import distributed
    except ImportError as error:
        raise JobError(f"--dask needs Dask ({error}): pip install 'splatam_ros[dask]'") from None
    return distributed


def _check_address(address: str) -> None:
    """Checks an address before Dask does, which would wait for 40 s and print a traceback.

    Raises:
        JobError: no scheduler can have it.
    """
    from distributed.comm.addressing import get_address_host_port

    try:
        _, port = get_address_host_port(address)
        if not 0 < int(port) < 1 << 16:
            raise ValueError(f'there is no port {port}')
    except ValueError as error:
        raise JobError(f'--dask {address}: {one_line(error)}; expected an address like tcp://host:8786') from None


def _received(job: Job, future: Any) -> Outcome:
    if future.status != 'finished':
        why = one_line(repr(future.exception())) if future.status == 'error' else f'it was {future.status}'
        return Outcome(job, f'the cluster did not run it: {why}')
    run: RemoteRun = future.result()
    if run.code:
        return Outcome(job, _why(run.code, run.printed))
    _save(job.folder, run.files)
    return Outcome(job)


def _save(folder: Path, files: Mapping[str, bytes]) -> None:
    """Puts a run folder in its place, complete or not at all. An unfinished run there makes room."""
    from splatam_core.atomic_io import new_folder
    from splatam_core.runs.layout import FILES, remove_run

    if folder.is_dir() and any(folder.iterdir()):
        remove_run(folder)
    with new_folder(folder) as temporary:
        for name in FILES:
            if name in files:
                (temporary / name).write_bytes(files[name])


def run_remotely(words: Sequence[str], name: str) -> RemoteRun:
    """Runs a job where this is called, in a process of its own, which ends if this process does.

    Args:
        words: the words after ``splatam``, without ``--out``.
        name: of the run folder, which its report shows.
    """
    from splatam_core.runs.layout import FILES

    with TemporaryDirectory(prefix='splatam_bench_') as scratch:
        folder, log = Path(scratch, name), Path(scratch, 'log')
        with log.open('wb') as file:
            code = _start([*words, '--out', str(folder)], file).wait()
        if code:
            return RemoteRun(code, log.read_bytes())
        found = {file: (folder / file).read_bytes() for file in FILES if (folder / file).is_file()}
        return RemoteRun(code, log.read_bytes(), found)
