"""The viewer's process: asks the node for updates and shows them in a browser. The node starts it; it imports no ROS."""

from __future__ import annotations

import os
import select
import signal
import socket
import sys
import time
from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np

from splatam_core.errors import ViewerError
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.maps.viewer.packing import pack
from splatam_core.maps.viewer.panel import Panel
from splatam_core.maps.viewer.scene import CameraPath, Scene, address, open_server
from splatam_core.types import MapSnapshot
from splatam_ros.viewer.protocol import KINDS, MAX_MESSAGE, FrameUpdate, MapUpdate, SharedMemory, read

STEP_S = 0.03
FRAME_PERIOD_S, MAP_PERIOD_S, LINE_PERIOD_S = 0.1, 0.5, 0.5
EXACT_PERIOD_S = 10.0
"""So often everything that differs is sent, not only what can be seen to differ."""

NICENESS = 10  # SLAM comes first
PATH_COLOR, CORRECTED_COLOR, LOOP_COLOR = (240, 180, 40), (90, 200, 250), (240, 80, 80)
RATE_S = 3.0  # over which the rate is measured


class LiveViewer:
    """Asks for updates at a rate that a browser can follow, and shows them."""

    def __init__(self, server: Any, connection: socket.socket, memories: dict[bytes, SharedMemory]) -> None:
        """Begin with an empty page.

        Args:
            server: of ``open_server``.
            connection: to the node.
            memories: of the updates, by kind.
        """
        self._server, self._socket, self._memories = server, connection, memories
        self._scene, self._panel = Scene(server), Panel(server, follow=False)
        self._panel.say('waiting for the first frame')
        self._due_s = {kind.code: 0.0 for kind in KINDS}
        self._epoch = -1
        self._exact_s = self._line_s = 0.0
        self._path = CameraPath()
        self._counts: deque[tuple[float, int]] = deque()

    def step(self) -> bool:
        """Ask, show what has arrived, and do what the controls say. Returns False once the node has ended."""
        self._ask(FrameUpdate.code)
        if self._server.get_clients():
            self._ask(MapUpdate.code)
        if select.select([self._socket], [], [], STEP_S)[0]:
            message = self._socket.recv(MAX_MESSAGE)
            if not message:
                return False
            update = read(message, self._memories)
            (self._show_frame if isinstance(update, FrameUpdate) else self._show_map)(update)  # type: ignore[arg-type]
        self._panel.apply(self._scene)
        return True

    def _ask(self, code: bytes) -> None:
        """Ask for a kind of update, unless it was asked for already or was there just now."""
        now_s = time.monotonic()
        if now_s >= self._due_s[code]:
            self._socket.send(code)
            self._due_s[code] = float('inf')  # until the answer

    def _show_frame(self, update: FrameUpdate) -> None:
        now_s = time.monotonic()
        self._due_s[update.code] = now_s + FRAME_PERIOD_S
        self._begin(update.epoch)
        self._path.extend(update.path.copy())
        if len(update.pose):
            pose, (width, height, fx, fy, cx, cy) = update.pose.copy(), update.camera
            camera = PinholeCamera(int(width), int(height), float(fx), float(fy), float(cx), float(cy))
            self._scene.show_camera(pose, camera, update.image.copy())
            if self._panel.follows:
                self._scene.follow(pose)
        if now_s >= self._line_s:
            self._line_s = now_s + LINE_PERIOD_S
            self._scene.show_line('trajectory', self._path.points(), PATH_COLOR)
            self._scene.show_line('corrected', update.nodes, CORRECTED_COLOR)
            self._scene.show_segments('loops', update.nodes[update.loops], LOOP_COLOR)
        self._panel.say(self._status(update, now_s))

    def _status(self, update: FrameUpdate, now_s: float) -> str:
        self._counts.append((now_s, update.num_frames))
        while now_s - self._counts[0][0] > RATE_S:
            self._counts.popleft()
        (begin_s, first), (end_s, last) = self._counts[0], self._counts[-1]
        rate = (last - first) / (end_s - begin_s) if end_s > begin_s else 0.0
        why = f': {update.reason}' if update.reason else ''
        return (
            f'**{update.status}**{why}  \n{update.num_frames:,} frames, {rate:.1f} per second, {update.frame_ms:.0f} ms each  \n'
            f'{update.num_gaussians:,} Gaussians'
        )

    def _show_map(self, update: MapUpdate) -> None:
        now_s = time.monotonic()
        self._begin(update.epoch)
        snapshot = MapSnapshot(
            means=update.means,
            rgb=update.rgb,
            opacities=(1 / (1 + np.exp(-np.clip(update.logit_opacities, -50, 50)))).astype(np.float32),
            log_scales=update.log_scales,
            rotations=update.rotations if len(update.rotations) else None,
        )
        exactly = now_s >= self._exact_s
        self._exact_s = now_s + EXACT_PERIOD_S if exactly else self._exact_s
        self._scene.show_map(pack(snapshot), update.added_by.copy(), exactly=exactly)
        self._due_s[update.code] = now_s + max(MAP_PERIOD_S, 2 * (time.monotonic() - now_s))

    def _begin(self, epoch: int) -> None:
        if epoch != self._epoch:
            self._epoch, self._path = epoch, CameraPath()
            self._scene.clear()


def main(arguments: Sequence[str] | None = None) -> int:
    """Serve the page until the node ends. Returns the exit code.

    Args:
        arguments: host, port, and the file descriptors of the socket and of the memories in the order of ``KINDS``.
    """
    host, port, *descriptors = sys.argv[1:] if arguments is None else arguments
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the node ends it
    os.nice(NICENESS)
    connection = socket.socket(fileno=int(descriptors[0]))
    codes = [kind.code for kind in KINDS]
    memories = {code: SharedMemory(int(descriptor)) for code, descriptor in zip(codes, descriptors[1:])}
    try:
        server = open_server(host, int(port))
    except ViewerError as error:
        print(f'splatam_node: error: {error}', file=sys.stderr)
        return 2
    print(f'viewer at {address(server)}', flush=True)
    viewer = LiveViewer(server, connection, memories)
    try:
        while viewer.step():
            pass
    except OSError:  # the node was killed
        pass
    os._exit(0)  # at once: the end of viser's threads takes seconds, for which the node would wait


if __name__ == '__main__':
    sys.exit(main())
