"""The node's services, all ``std_srvs/Trigger``. What touches the map runs on the worker's thread; nobody waits."""

from __future__ import annotations

import traceback
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Protocol

from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import Trigger

from splatam_core.errors import SplatamError
from splatam_core.slam import Slam
from splatam_core.worker import SlamWorker
from splatam_ros.node.gate import Gate
from splatam_ros.node.map_lifecycle import Session


@dataclass(frozen=True)
class Service:
    """A service of the node.

    Attributes:
        name: below the node's name.
        help: what it does, for the documentation.
    """

    name: str
    help: str


SERVICES = (
    Service('reset', 'forget map and poses; the next frame starts a new map. The run so far is kept in `previous/`'),
    Service('pause', 'let frames go until `~/resume`; the map stays as it is'),
    Service('resume', 'take frames again, from the last pose'),
    Service('save_map', 'save map, trajectory and metrics in `save_path`, each file in one step'),
    Service('load_map', 'go on in the map at `load_path` from `load_pose`; `slam.mapping.enabled` off: only localise'),
)


class Done(Protocol):
    """The part of ``concurrent.futures.Future`` that is used here."""

    def cancelled(self) -> bool:
        """Whether it will never run."""

    def exception(self) -> BaseException | None:
        """What went wrong."""

    def result(self) -> str:
        """What it said."""


class Services:
    """Serves ``SERVICES``. A failure is an answer with ``success`` false and the reason; it never ends the node."""

    def __init__(self, node: Node, worker: SlamWorker, session: Session, gate: Gate) -> None:
        self._node = node
        self._worker = worker
        self._session = session
        self._gate = gate
        actions: dict[str, Callable[[], Awaitable[Trigger.Response]]] = {
            'reset': lambda: self._on_worker(lambda slam: session.reset(slam, 'asked for by ~/reset')),
            'pause': self._pause,
            'resume': self._resume,
            'save_map': lambda: self._on_worker(self._save),
            'load_map': lambda: self._on_worker(session.load),
        }
        for service in SERVICES:
            node.create_service(Trigger, f'~/{service.name}', _handler(actions[service.name]))

    async def _pause(self) -> Trigger.Response:
        was_paused, self._gate.is_paused = self._gate.is_paused, True
        return _succeeded('was paused already' if was_paused else 'paused: frames are let go until ~/resume')

    async def _resume(self) -> Trigger.Response:
        if not self._gate.is_paused:
            return _succeeded('was not paused')
        response = await self._on_worker(_rest)  # before the first new frame, which is admitted only then
        self._gate.is_paused = False
        return response

    def _save(self, slam: Slam) -> str:
        metrics = self._session.save(slam)
        return f'saved {metrics.num_gaussians} Gaussians and {metrics.frames} frames in {self._session.folder}'

    async def _on_worker(self, action: Callable[[Slam], str]) -> Trigger.Response:
        """Run an action between two frames; what it says is the answer."""
        answer = Future()
        self._worker.call(action).add_done_callback(lambda done: answer.set_result(self._response(done)))
        return await answer

    def _response(self, done: Done) -> Trigger.Response:
        if done.cancelled():
            return _failed('SLAM has stopped')
        error = done.exception()
        if error is None:
            return _succeeded(done.result())
        if isinstance(error, OSError):
            return _failed(f'{error.filename}: {error.strerror}' if error.filename else str(error))
        if not isinstance(error, SplatamError):
            self._node.get_logger().error(''.join(traceback.format_exception(error)))
        return _failed(str(error))


def _handler(action: Callable[[], Awaitable[Trigger.Response]]) -> Callable[..., Awaitable[Trigger.Response]]:
    async def handle(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        return await action()

    return handle


def _rest(slam: Slam) -> str:
    slam.rest()
    return 'resumed'


def _succeeded(message: str) -> Trigger.Response:
    return Trigger.Response(success=True, message=message)


def _failed(message: str) -> Trigger.Response:
    return Trigger.Response(success=False, message=message)
