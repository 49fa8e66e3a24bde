"""The node's side of the viewer: starts its process, and hands it the newest frame and the map when it asks."""

from __future__ import annotations

import select
import socket
import subprocess
import sys
import time
from collections.abc import Mapping
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray
from rclpy.impl.rcutils_logger import RcutilsLogger

from splatam_core.graph.keyframe_graph import KeyframeGraph
from splatam_core.maps.viewer.scene import check_viser
from splatam_core.slam import Slam
from splatam_core.types import FrameResult, RgbdFrame
from splatam_ros.viewer.protocol import KINDS, MAX_MESSAGE, FrameUpdate, MapUpdate, SharedMemory, Update, socket_pair, write

IMAGE_WIDTH = 240
MAP_SHARE = 0.04
"""Largest share of the time that copying the map may take; a large map is shown less often."""

END_TIMEOUT_S = 3.0


class ViewerFeed:
    """Hands over what the viewer asks for. Its failure costs the viewer, never a frame.

    ``is_asked`` may be used from any thread, everything else from the worker's thread.
    """

    def __init__(self, connection: socket.socket, memories: Mapping[bytes, SharedMemory], logger: RcutilsLogger) -> None:
        """Begin without a map.

        Args:
            connection: to the viewer.
            memories: of the updates, by kind.
            logger: of the node.
        """
        self._socket, self._memories, self._logger = connection, memories, logger
        self._socket.setblocking(False)
        self._process: subprocess.Popen[bytes] | None = None
        self._is_open = True
        self._wanted: set[bytes] = set()
        self._epoch = self._num_frames = 0
        self._path: list[NDArray[np.float32]] = []  # what the viewer has not got yet
        self._newest: tuple[RgbdFrame, FrameResult] | None = None
        self._map_due_s = 0.0

    @classmethod
    def start(cls, host: str, port: int, logger: RcutilsLogger) -> ViewerFeed:
        """Start the viewer's process, which prints its address, and return the feed.

        Args:
            host: address to listen on.
            port: of the page.
            logger: of the node.

        Raises:
            ViewerError: viser is not installed.
        """
        check_viser()
        ours, other = socket_pair()
        memories = {kind.code: SharedMemory() for kind in KINDS}
        descriptors = [other.fileno(), *(memories[kind.code].descriptor for kind in KINDS)]
        feed = cls(ours, memories, logger)
        feed._process = subprocess.Popen(
            [sys.executable, '-m', 'splatam_ros.viewer.main', host, str(port), *map(str, descriptors)],
            stdin=subprocess.DEVNULL, pass_fds=descriptors, start_new_session=True,
        )  # fmt: skip
        other.close()
        return feed

    @property
    def is_asked(self) -> bool:
        """Whether the viewer waits for something."""
        return self._is_open and bool(self._wanted or select.select([self._socket], [], [], 0)[0])

    def begin_map(self) -> None:
        """Forget the path: a new map begins."""
        self._epoch += 1
        self._path, self._newest = [], None

    def take(self, frame: RgbdFrame, result: FrameResult, slam: Slam) -> None:
        """Take a frame that was processed, and answer what the viewer asks for.

        Args:
            frame: the frame.
            result: its result.
            slam: SLAM in its state after the frame.
        """
        if not self._is_open:
            return
        self._num_frames += 1
        self._newest = frame, result
        if result.status.is_trusted and result.T_world_cam is not None:
            self._path.append(result.T_world_cam[:3, 3].astype(np.float32))
        self.answer(slam)

    def answer(self, slam: Slam) -> None:
        """Answer what the viewer asks for."""
        if not self._is_open:
            return
        try:
            self._receive()
            if FrameUpdate.code in self._wanted and self._newest is not None:
                self._send(self._frame_update(*self._newest, slam.graph))
            if MapUpdate.code in self._wanted and time.monotonic() >= self._map_due_s:
                begin_s = time.monotonic()
                self._send(self._map_update(slam))
                self._map_due_s = time.monotonic() + (time.monotonic() - begin_s) / MAP_SHARE
        except OSError:
            self._end('the viewer has ended; the node goes on without')
        except Exception as error:  # noqa: BLE001 - whatever it is, it costs the viewer alone
            self._end(f'the viewer is ended by an unexpected {error!r}; the node goes on without')

    def _end(self, why: str) -> None:
        self._is_open, self._path, self._newest = False, [], None
        self._logger.warning(why)
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)  # the viewer's process ends when it sees that

    def _receive(self) -> None:
        while True:
            try:
                request = self._socket.recv(MAX_MESSAGE)
            except BlockingIOError:
                return
            if not request:
                raise ConnectionResetError
            self._wanted.add(request)

    def _send(self, update: Update) -> None:
        self._socket.send(write(update, self._memories[update.code]))
        self._wanted.discard(update.code)

    def _frame_update(self, frame: RgbdFrame, result: FrameResult, graph: KeyframeGraph) -> FrameUpdate:
        camera, step = frame.camera, max(1, frame.camera.width // IMAGE_WIDTH)
        path, self._path = self._path, []
        return FrameUpdate(
            epoch=self._epoch,
            num_frames=self._num_frames,
            num_gaussians=result.num_gaussians,
            status=result.status.value,
            reason=result.reason,
            frame_ms=result.timings.total,
            pose=np.zeros((0, 4)) if result.T_world_cam is None else result.T_world_cam,
            camera=np.array([camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy]),
            image=frame.rgb[::step, ::step],
            path=np.array(path, np.float32).reshape(-1, 3),
            nodes=graph.nodes.T_world_cam[:, :3, 3],
            loops=graph.pairs(loops=True).astype(np.int64),
        )

    def _map_update(self, slam: Slam) -> MapUpdate:
        g, rotations = slam.map.gaussians.detached(), slam.map.rotations
        return MapUpdate(
            epoch=self._epoch,
            means=g.means.numpy(force=True),
            log_scales=g.log_scales.numpy(force=True),
            logit_opacities=g.logit_opacities.numpy(force=True),
            rgb=g.rgb.numpy(force=True),
            rotations=np.zeros((0, 4), np.float32) if rotations is None else rotations.numpy(force=True),
            added_by=slam.map.added_by.numpy(force=True),
        )

    def close(self) -> None:
        """End the viewer's process."""
        self._is_open = False
        self._socket.close()  # it ends when it sees that
        if self._process is not None:
            try:
                self._process.wait(END_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        for memory in self._memories.values():
            memory.close()
