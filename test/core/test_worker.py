"""SlamWorker: order, full queues, bad frames, crashes and shutdown, with a Slam that the test can pause."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from splatam_core.errors import FrameError
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.interruption import Pressure, PressureGauge
from splatam_core.types import FrameResult, RgbdFrame, StageTimings, Status
from splatam_core.worker import SlamWorker, WorkerStopped

CAMERA = PinholeCamera(4, 3, 4.0, 4.0, 1.5, 1.0)
TIMEOUT_S = 10.0  # only ever waited out when the test fails


def frame(stamp_ns: int) -> RgbdFrame:
    return RgbdFrame(stamp_ns, np.zeros((3, 4, 3), np.uint8), np.ones((3, 4), np.float32), CAMERA)


class HeldSlam:
    """Processes one frame per ``release``; raises FrameError at stamp 13, another exception at 98, SystemExit at 99."""

    def __init__(self, held: bool = True) -> None:
        self.gate = threading.Semaphore(0 if held else 10_000)
        self.started = threading.Semaphore(0)
        self.threads: set[threading.Thread] = set()
        self.pressures: list[Pressure] = []
        self.caught_up: list[Pressure] = []
        self.is_broken = False

    def release(self, frames: int) -> None:
        self.gate.release(frames)

    def wait_started(self) -> None:
        assert self.started.acquire(timeout=TIMEOUT_S)

    def process(self, frame: RgbdFrame, pressure: PressureGauge) -> FrameResult:
        self.threads.add(threading.current_thread())
        self.started.release()
        assert self.gate.acquire(timeout=TIMEOUT_S)
        self.pressures.append(pressure())
        if frame.stamp_ns == 13:
            raise FrameError('unlucky')
        if frame.stamp_ns == 98:
            raise ZeroDivisionError('broken')
        if frame.stamp_ns == 99:
            raise SystemExit('ended')
        status = Status.LOST if frame.stamp_ns == 77 else Status.TRACKED
        return FrameResult(0, frame.stamp_ns, status, np.eye(4), False, 0, 1.0, 1.0, '', StageTimings())

    def catch_up(self, pressure: PressureGauge) -> None:
        self.caught_up.append(pressure())
        if self.is_broken:
            raise ZeroDivisionError('broken')


class Recorder:
    """Records what a worker reports."""

    def __init__(self) -> None:
        self.results: list[int] = []
        self.bad: list[tuple[int, str]] = []

    def on_result(self, frame: RgbdFrame, result: FrameResult) -> None:
        assert frame.stamp_ns == result.stamp_ns
        self.results.append(result.stamp_ns)

    def on_bad_frame(self, frame: RgbdFrame, error: Exception) -> None:
        self.bad.append((frame.stamp_ns, str(error)))


def start(slam: HeldSlam, queue_size: int = 2, when_full: str = 'block') -> tuple[SlamWorker, Recorder]:
    recorder = Recorder()
    worker = SlamWorker(
        slam, recorder.on_result, recorder.on_bad_frame, queue_size=queue_size, when_full=when_full
    )  # fmt: skip
    return worker, recorder


def submit_in_thread(worker: SlamWorker, stamp_ns: int) -> tuple[threading.Thread, list[BaseException]]:
    raised: list[BaseException] = []

    def run() -> None:
        try:
            worker.submit(frame(stamp_ns))
        except WorkerStopped as error:
            raised.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    return thread, raised


def test_processes_in_order_on_one_thread_that_is_not_the_callers() -> None:
    slam = HeldSlam(held=False)
    worker, recorder = start(slam)
    for stamp_ns in range(1, 8):
        worker.submit(frame(stamp_ns))
    worker.stop(drain=True)
    assert recorder.results == [1, 2, 3, 4, 5, 6, 7]
    assert len(slam.threads) == 1 and threading.current_thread() not in slam.threads
    assert worker.pending == 0 and worker.dropped == 0 and worker.error is None


def test_drop_oldest_keeps_the_newest_and_counts() -> None:
    slam = HeldSlam()
    worker, recorder = start(slam, queue_size=2, when_full='drop_oldest')
    worker.submit(frame(1))
    slam.wait_started()
    for stamp_ns in (2, 3, 4, 5):
        worker.submit(frame(stamp_ns))
    assert worker.dropped == 2 and worker.pending == 3
    slam.release(3)
    worker.stop(drain=True)
    assert recorder.results == [1, 4, 5]


@pytest.mark.parametrize(
    ('when_full', 'queue_size', 'expected'),
    [
        ('drop_oldest', 2, [Pressure.FULL, Pressure.WAITING, Pressure.NONE]),
        ('drop_oldest', 3, [Pressure.WAITING, Pressure.WAITING, Pressure.NONE]),
        ('block', 2, [Pressure.NONE, Pressure.NONE, Pressure.NONE]),
    ],
)
def test_a_live_camera_presses_and_a_recording_never(when_full: str, queue_size: int, expected: list[Pressure]) -> None:
    slam = HeldSlam()
    worker, recorder = start(slam, queue_size=queue_size, when_full=when_full)
    worker.submit(frame(1))
    slam.wait_started()
    worker.submit(frame(2))
    worker.submit(frame(3))
    slam.release(3)
    while worker.pending:
        threading.Event().wait(0.001)
    assert slam.pressures == slam.caught_up == expected
    worker.stop(drain=True)
    assert recorder.results == [1, 2, 3]


def test_a_call_presses_and_a_frame_that_is_lost_catches_up_with_nothing() -> None:
    slam = HeldSlam()
    worker, _ = start(slam, when_full='drop_oldest')
    worker.submit(frame(77))
    slam.wait_started()
    called = worker.call(lambda owned: None)
    slam.release(1)
    called.result(TIMEOUT_S)
    assert slam.pressures == [Pressure.WAITING] and not slam.caught_up
    worker.stop(drain=True)


def test_a_frame_that_is_done_is_not_reported_because_the_map_cannot_catch_up(caplog: pytest.LogCaptureFixture) -> None:
    slam = HeldSlam(held=False)
    slam.is_broken = True
    worker, recorder = start(slam, when_full='drop_oldest')
    worker.submit(frame(1))
    while worker.pending:
        threading.Event().wait(0.001)
    worker.submit(frame(2))
    worker.stop(drain=True)
    assert recorder.results == [1, 2] and not recorder.bad
    assert 'fitting the map after frame 1 ns failed' in caplog.text


def test_block_waits_for_room_and_loses_nothing() -> None:
    slam = HeldSlam()
    worker, recorder = start(slam, queue_size=1, when_full='block')
    worker.submit(frame(1))
    slam.wait_started()
    worker.submit(frame(2))
    thread, _ = submit_in_thread(worker, 3)
    thread.join(0.1)
    assert thread.is_alive() and worker.pending == 2
    slam.release(3)
    thread.join(TIMEOUT_S)
    assert not thread.is_alive()
    worker.stop(drain=True)
    assert recorder.results == [1, 2, 3] and worker.dropped == 0


def test_stop_without_drain_lets_waiting_frames_go_but_finishes_the_current_one() -> None:
    slam = HeldSlam()
    worker, recorder = start(slam, queue_size=5)
    for stamp_ns in (1, 2, 3):
        worker.submit(frame(stamp_ns))
    slam.wait_started()
    stopper = threading.Thread(target=worker.stop, kwargs={'drain': False})
    stopper.start()
    while worker.pending > 1:  # until stop() has cleared the queue
        stopper.join(0.01)
    slam.release(1)
    stopper.join(TIMEOUT_S)
    assert not stopper.is_alive()
    assert recorder.results == [1]


def test_bad_frames_are_reported_and_the_next_one_is_processed() -> None:
    worker, recorder = start(HeldSlam(held=False))
    for stamp_ns in (12, 13, 14):
        worker.submit(frame(stamp_ns))
    worker.stop(drain=True)
    assert recorder.results == [12, 14]
    assert recorder.bad == [(13, 'unlucky')]


def test_whatever_one_frame_raises_the_next_one_is_processed() -> None:
    worker, recorder = start(HeldSlam(held=False))
    for stamp_ns in (1, 98, 2):
        worker.submit(frame(stamp_ns))
    assert worker.stop(drain=True) == 0
    assert recorder.results == [1, 2] and recorder.bad == [(98, 'broken')]


@pytest.mark.parametrize('failing', ['before_frame', 'on_result', 'on_bad_frame'])
def test_whatever_a_callback_raises_the_next_frame_is_processed(failing: str, caplog: pytest.LogCaptureFixture) -> None:
    recorder = Recorder()
    callbacks = {'before_frame': lambda *_: None, 'on_result': recorder.on_result, 'on_bad_frame': recorder.on_bad_frame}
    works, count = callbacks[failing], iter(range(100))

    def fails_once(first: object, second: object) -> None:
        if next(count) == 0:
            raise OSError('no space left')
        works(first, second)

    worker = SlamWorker(HeldSlam(held=False), queue_size=9, when_full='block', **{**callbacks, failing: fails_once})
    stamps_ns = [13, 1, 13] if failing == 'on_bad_frame' else [1, 2]
    for stamp_ns in stamps_ns:
        worker.submit(frame(stamp_ns))
    worker.stop(drain=True)
    assert recorder.results == ([1] if failing == 'on_bad_frame' else [2])
    assert recorder.bad == ([(13, 'unlucky')] if failing == 'on_bad_frame' else [(1, 'no space left')])
    assert ('no space left' in caplog.text) == (failing == 'on_bad_frame')


def test_a_worker_in_a_hurry_drops_what_waits() -> None:
    slam, hurry = HeldSlam(), threading.Event()
    worker, recorder = start(slam, queue_size=2)
    for stamp_ns in (1, 2, 3):
        worker.submit(frame(stamp_ns))
        if stamp_ns == 1:
            slam.wait_started()
    call, given_up = worker.call(lambda owned: None), []
    thread = threading.Thread(target=lambda: given_up.append(worker.submit(frame(4), hurry.is_set)))  # waits for room
    thread.start()
    thread.join(0.1)
    assert thread.is_alive()
    hurry.set()
    thread.join(TIMEOUT_S)
    assert given_up == [False]
    dropped: list[int] = []
    stopper = threading.Thread(target=lambda: dropped.append(worker.stop(drain=True, give_up=hurry.is_set)))
    stopper.start()
    while worker.pending > 1:
        stopper.join(0.01)
    slam.release(1)
    stopper.join(TIMEOUT_S)
    assert dropped == [2] and recorder.results == [1] and call.cancelled()


def test_a_crash_stops_intake_and_surfaces_in_stop() -> None:
    slam = HeldSlam()
    worker, recorder = start(slam, queue_size=1)
    worker.submit(frame(99))
    slam.wait_started()
    worker.submit(frame(100))
    thread, raised = submit_in_thread(worker, 101)  # waits for a full queue that never empties
    slam.release(1)
    thread.join(TIMEOUT_S)
    assert isinstance(raised[0].__cause__, SystemExit)
    with pytest.raises(WorkerStopped):
        worker.submit(frame(102))
    assert isinstance(worker.error, SystemExit) and worker.pending == 0
    with pytest.raises(SystemExit, match='ended'):
        worker.stop(drain=True)
    assert recorder.results == []


def test_calls_run_between_frames_ahead_of_those_that_wait() -> None:
    slam = HeldSlam()
    worker, recorder = start(slam, queue_size=3)
    worker.submit(frame(1))
    slam.wait_started()
    worker.submit(frame(2))
    future = worker.call(lambda owned: (owned, threading.current_thread(), list(recorder.results)))
    slam.release(2)
    owned, thread, done_before = future.result(TIMEOUT_S)
    assert owned is slam and thread in slam.threads and done_before == [1]
    worker.stop(drain=True)
    assert recorder.results == [1, 2]


def test_a_failing_call_hands_its_exception_to_the_caller_and_harms_nothing() -> None:
    worker, recorder = start(HeldSlam(held=False))
    future = worker.call(lambda slam: 1 // 0)
    with pytest.raises(ZeroDivisionError):
        future.result(TIMEOUT_S)
    worker.submit(frame(1))
    worker.stop(drain=True)
    assert recorder.results == [1]


def test_calls_to_a_stopped_or_crashed_worker_are_cancelled() -> None:
    slam = HeldSlam()
    worker, _ = start(slam)
    worker.submit(frame(99))
    slam.wait_started()
    waiting = worker.call(lambda owned: None)
    # The crash comes first: the call waits behind the frame being processed.
    slam.release(1)
    with pytest.raises(SystemExit):
        worker.stop(drain=False)
    assert waiting.cancelled()
    assert worker.call(lambda owned: None).cancelled()


@pytest.mark.parametrize(('queue_size', 'when_full'), [(0, 'block'), (1, 'drop_newest')])
def test_refuses_senseless_arguments(queue_size: int, when_full: str) -> None:
    with pytest.raises(ValueError, match='expected'):
        SlamWorker(HeldSlam(), print, print, queue_size=queue_size, when_full=when_full)


def test_what_comes_before_a_frame_may_change_the_slam() -> None:
    slam, recorder, seen = HeldSlam(held=False), Recorder(), []
    worker = SlamWorker(
        slam, recorder.on_result, recorder.on_bad_frame, queue_size=2, when_full='block',
        before_frame=lambda slam, frame: seen.append((slam, frame.stamp_ns, list(recorder.results))),
    )  # fmt: skip
    for stamp_ns in (1, 2):
        worker.submit(frame(stamp_ns))
    worker.stop(drain=True)
    assert seen == [(slam, 1, []), (slam, 2, [1])]
