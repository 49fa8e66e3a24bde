"""The node's services, of type ``std_srvs/Trigger`` but for ``~/get_map``. Those that touch the map run on the worker's thread."""

from __future__ import annotations

import traceback
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any, Protocol

from nav_msgs.srv import GetMap
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import Trigger

from splatam_core.errors import ConfigError, SplatamError
from splatam_core.slam import Slam
from splatam_core.worker import SlamWorker
from splatam_ros.node.attempt import why
from splatam_ros.node.gate import FrameGate
from splatam_ros.node.initial_pose import InitialPose
from splatam_ros.node.map_lifecycle import MapLifecycle
from splatam_ros.node.outputs import Outputs


@dataclass(frozen=True)
class Service:
    """A service of the node.

    Attributes:
        name: name below the node's name.
        help: one line for the documentation.
        type_name: type of the service.
    """

    name: str
    help: str
    type_name: str = 'std_srvs/srv/Trigger'


SERVICES = (
    Service('reset', 'drop map and poses; the next frame starts a new map. The run so far is kept in `previous/`'),
    Service('pause', 'drop frames until `~/resume`; the map does not change'),
    Service('resume', 'process frames again, starting from the last pose'),
    Service('save_map', 'save map, trajectory and metrics in `save_path`; each file is replaced atomically'),
    Service('optimize', 'make poses and map agree best with all that the keyframe graph has measured, now rather than at the end'),
    Service(
        'load_map',
        'continue in the map at `load_path` from `load_pose`, or without it wherever the camera recognises a keyframe of the '
        'map; with `slam.mapping.enabled` off only localize',
    ),
    Service(
        'get_map',
        'the newest floor plan, as on `~/map/grid`, of all keyframes; an empty one if there is none',
        'nav_msgs/srv/GetMap',
    ),
)


class FinishedCall(Protocol):
    """The part of ``concurrent.futures.Future`` that is used here."""

    def cancelled(self) -> bool:
        """Returns True if the call will never run."""

    def exception(self) -> BaseException | None:
        """Returns the exception of the call, if it failed."""

    def result(self) -> Any:
        """Returns the result of the call."""


class Services:
    """Serves ``SERVICES``, and listens to ``initialpose``.

    A failure is answered with ``success`` false and the reason; it never ends the node.
    """

    def __init__(self, node: Node, worker: SlamWorker, lifecycle: MapLifecycle, outputs: Outputs, gate: FrameGate) -> None:
        self._node = node
        self._worker = worker
        self._lifecycle = lifecycle
        self._outputs = outputs
        self._gate = gate
        actions: dict[str, Callable[[], Awaitable[Trigger.Response]]] = {
            'reset': self._reset,
            'pause': self._pause,
            'resume': self._resume,
            'save_map': self._save_map,
            'optimize': self._optimize,
            'load_map': self._load_map,
        }
        for name, action in actions.items():
            node.create_service(Trigger, f'~/{name}', _handler(action))
        node.create_service(GetMap, '~/get_map', self._get_map)
        self._initial_pose = InitialPose(node, worker, lifecycle)

    async def _reset(self) -> Trigger.Response:
        return await self._on_worker(self._reset_slam)

    async def _pause(self) -> Trigger.Response:
        was_paused, self._gate.is_paused = self._gate.is_paused, True
        return _succeeded('was paused already' if was_paused else 'paused: frames are dropped until ~/resume')

    async def _resume(self) -> Trigger.Response:
        if not self._gate.is_paused:
            return _succeeded('was not paused')
        response = await self._on_worker(_rest)  # before the first new frame, which the gate admits only afterwards
        self._gate.is_paused = False
        return response

    async def _save_map(self) -> Trigger.Response:
        return await self._on_worker(self._lifecycle.save)

    async def _optimize(self) -> Trigger.Response:
        return await self._on_worker(self._optimize_graph)

    async def _load_map(self) -> Trigger.Response:
        return await self._on_worker(self._lifecycle.load)

    async def _get_map(self, request: GetMap.Request, response: GetMap.Response) -> GetMap.Response:
        answer = Future()
        self._worker.call(self._outputs.occupancy_grid).add_done_callback(answer.set_result)
        done: FinishedCall = await answer
        if self._failure(done) is None and (grid := done.result()) is not None:
            response.map = grid
        return response

    def _reset_slam(self, slam: Slam) -> str:
        return self._lifecycle.reset(slam, 'requested by ~/reset')

    def _optimize_graph(self, slam: Slam) -> str:
        if not slam.graph.is_used:
            raise ConfigError('there is no keyframe graph: set slam.graph.enabled to true')
        moved_m = slam.optimize_graph()
        self._outputs.refresh()
        summary = slam.graph.summary
        return f'{summary.nodes} keyframes with {summary.loops} loops: corrected by at most {100 * moved_m:.1f} cm'

    async def _on_worker(self, action: Callable[[Slam], str]) -> Trigger.Response:
        """Run an action between two frames; it returns the message of the answer."""
        answer = Future()

        def respond(done: FinishedCall) -> None:
            answer.set_result(self._response(done))

        self._worker.call(action).add_done_callback(respond)
        return await answer

    def _response(self, done: FinishedCall) -> Trigger.Response:
        failure = self._failure(done)
        return _succeeded(done.result()) if failure is None else _failed(failure)

    def _failure(self, done: FinishedCall) -> str | None:
        """Returns why a call failed; None if it did not. Logs what nobody expects."""
        if done.cancelled():
            return 'SLAM has stopped'
        error = done.exception()
        if error is None:
            return None
        if not isinstance(error, Exception):
            return f'SLAM has stopped: {error!r}'
        if not isinstance(error, (SplatamError, OSError)):
            self._node.get_logger().error(f'a service failed: {why(error)}; the traceback is logged at level debug')
            self._node.get_logger().debug(''.join(traceback.format_exception(error)))
        return why(error)


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
