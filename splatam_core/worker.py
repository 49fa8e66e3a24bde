"""Runs Slam on its own thread, behind a bounded queue of frames. This is the core's only thread."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from splatam_core.interruption import Pressure, never
from splatam_core.types import FrameResult, RgbdFrame

if TYPE_CHECKING:
    from splatam_core.slam import Slam

_log = logging.getLogger(__name__)

T = TypeVar('T')
WhenFull = Literal['drop_oldest', 'block']
POLL_S = 0.1  # longest time until ``give_up`` is asked again


class WorkerStopped(RuntimeError):
    """A frame was submitted to a worker that has stopped; ``__cause__`` is the exception that stopped it, if any."""


class SlamWorker:
    """Owns a Slam. Only the worker's thread may use it, until ``stop`` has returned.

    Frames wait in a bounded queue and are processed in the order of submission. When the queue is full,
    use ``drop_oldest`` for a live camera and ``block`` for a recording. With ``drop_oldest``, frames that wait postpone the
    optimization of the map; it catches up while none waits.

    An exception costs the frame that caused it: it is reported, and the next frame is processed. Only what is no
    ``Exception``, such as SystemExit, stops the worker: waiting frames are dropped, ``submit`` raises WorkerStopped,
    and ``stop`` raises the exception.
    """

    def __init__(
        self,
        slam: Slam,
        on_result: Callable[[RgbdFrame, FrameResult], None],
        on_bad_frame: Callable[[RgbdFrame, Exception], None],
        *,
        queue_size: int,
        when_full: WhenFull,
        before_frame: Callable[[Slam, RgbdFrame], None] | None = None,
    ) -> None:
        """Start the thread.

        Args:
            slam: the caller must not use it before ``stop`` has returned.
            on_result: called on the worker's thread after each frame; may use the Slam.
            on_bad_frame: called on the worker's thread with each frame that Slam refused, with its FrameError, or for which
                Slam or a callback failed, with any other exception.
            queue_size: largest number of waiting frames, in addition to the one being processed.
            when_full: what ``submit`` does when the queue is full.
            before_frame: called on the worker's thread before each frame; may change the Slam.

        Raises:
            ValueError: queue_size below 1, or an unknown when_full.
        """
        if queue_size < 1:
            raise ValueError(f'queue_size = {queue_size}: expected at least 1')
        if when_full not in ('drop_oldest', 'block'):
            raise ValueError(f"when_full = '{when_full}': expected drop_oldest or block")
        self._slam = slam
        self._on_result = on_result
        self._on_bad_frame = on_bad_frame
        self._queue_size = queue_size
        self._when_full = when_full
        self._before_frame = before_frame
        self._frames: deque[RgbdFrame] = deque()
        self._tasks: deque[tuple[Future[Any], Callable[[Slam], Any]]] = deque()
        self._busy = False
        self._dropped = 0
        self._stopping = False
        self._error: BaseException | None = None
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name='slam')
        self._thread.start()

    @property
    def error(self) -> BaseException | None:
        """Exception that stopped the worker; None if there was none."""
        with self._changed:
            return self._error

    @property
    def dropped(self) -> int:
        """Number of frames dropped because the queue was full."""
        with self._changed:
            return self._dropped

    @property
    def pending(self) -> int:
        """Number of frames that wait or are being processed."""
        with self._changed:
            return len(self._frames) + self._busy

    def submit(self, frame: RgbdFrame, give_up: Callable[[], bool] = never) -> bool:
        """Queue a frame. If the queue is full, drop the oldest frame or wait, as configured.

        Args:
            frame: the frame.
            give_up: asked while waiting; once it returns True the frame is dropped.

        Returns:
            True if the frame is queued.

        Raises:
            WorkerStopped: the worker is stopping or has stopped.
        """
        with self._changed:
            while self._when_full == 'block' and not self._changed.wait_for(self._accepts_or_stops, POLL_S):
                if give_up():
                    return False
            if self._stopping:
                raise WorkerStopped('the SLAM worker has stopped and accepts no frames') from self._error
            if len(self._frames) == self._queue_size:
                self._frames.popleft()
                self._dropped += 1
            self._frames.append(frame)
            self._changed.notify_all()
        return True

    def call(self, function: Callable[[Slam], T]) -> Future[T]:
        """Run a function on the worker's thread, before the next waiting frame.

        The future is cancelled if the worker stops before the function has started.
        """
        future: Future[T] = Future()
        with self._changed:
            if self._stopping:
                future.cancel()
            else:
                self._tasks.append((future, function))
                self._changed.notify_all()
        return future

    def stop(self, drain: bool, give_up: Callable[[], bool] = never) -> int:
        """End the thread and wait for it.

        Args:
            drain: True to process the waiting frames first, False to drop them.
            give_up: asked while frames and calls wait; once it returns True they are dropped and cancelled.

        Returns:
            Number of waiting frames that were dropped.

        Raises:
            BaseException: the exception that stopped the worker, if there was one.
        """
        with self._changed:
            self._stopping = True
            num_dropped = 0 if drain else self._drop_waiting()
            self._changed.notify_all()
            while not self._changed.wait_for(self._is_idle, POLL_S):
                if give_up():
                    num_dropped += self._drop_waiting()
                    break
            futures = self._take_futures()
        for future in futures:
            future.cancel()
        self._thread.join()
        if self._error is not None:
            raise self._error
        return num_dropped

    def _pressure(self) -> Pressure:
        """Returns what waits for the present frame to be done. A recording waits as long as that takes."""
        if self._when_full == 'block':
            return Pressure.NONE
        with self._changed:
            if len(self._frames) == self._queue_size:
                return Pressure.FULL
            return Pressure.WAITING if self._frames or self._tasks or self._stopping else Pressure.NONE

    def _accepts_or_stops(self) -> bool:
        return self._stopping or len(self._frames) < self._queue_size

    def _is_idle(self) -> bool:
        return not (self._frames or self._tasks or self._busy)

    def _drop_waiting(self) -> int:
        num_dropped = len(self._frames)
        self._frames.clear()
        return num_dropped

    def _take_futures(self) -> list[Future[Any]]:
        futures = [future for future, _ in self._tasks]
        self._tasks.clear()
        return futures

    def _run(self) -> None:
        try:
            while (job := self._next()) is not None:
                job()
                self._done()
        except BaseException as error:  # noqa: BLE001 - stop() raises it
            self._fail(error)

    def _next(self) -> Callable[[], None] | None:
        """Wait for the next job. Returns None when the worker is stopping and nothing is left to do."""
        with self._changed:
            self._changed.wait_for(lambda: self._tasks or self._frames or self._stopping)
            if self._tasks:
                future, function = self._tasks.popleft()
                return lambda: self._fulfil(future, function)
            if not self._frames:
                return None
            frame = self._frames.popleft()
            self._busy = True
            self._changed.notify_all()
            return lambda: self._process(frame)

    def _process(self, frame: RgbdFrame) -> None:
        try:
            if self._before_frame is not None:
                self._before_frame(self._slam, frame)
            result = self._slam.process(frame, self._pressure)
            self._on_result(frame, result)
        except Exception as error:  # noqa: BLE001 - whatever it is, the next frame may be fine
            self._report_bad_frame(frame, error)
            return
        if result.status.is_trusted:
            self._catch_up(frame)

    def _catch_up(self, frame: RgbdFrame) -> None:
        try:
            self._slam.catch_up(self._pressure)
        except Exception as error:  # noqa: BLE001 - as above; the frame itself is done
            _log.error('fitting the map after frame %d ns failed: %r', frame.stamp_ns, error)

    def _report_bad_frame(self, frame: RgbdFrame, error: Exception) -> None:
        try:
            self._on_bad_frame(frame, error)
        except Exception as another:  # noqa: BLE001 - likewise
            _log.error('frame %d ns failed (%r), and so did the report about it: %r', frame.stamp_ns, error, another)

    def _fulfil(self, future: Future[T], function: Callable[[Slam], T]) -> None:
        if not future.set_running_or_notify_cancel():
            return
        try:
            future.set_result(function(self._slam))
        except Exception as error:  # noqa: BLE001 - the future raises it
            future.set_exception(error)

    def _done(self) -> None:
        with self._changed:
            self._busy = False
            self._changed.notify_all()

    def _fail(self, error: BaseException) -> None:
        with self._changed:
            self._error = error
            self._stopping = True
            self._busy = False
            self._drop_waiting()
            futures = self._take_futures()
            self._changed.notify_all()
        for future in futures:
            future.cancel()
