"""What a browser shows: Gaussians, a camera with its image, and lines. Written for viser, which serves the page."""

from __future__ import annotations

import errno
import ipaddress
import logging
import socket
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatam_core.errors import ViewerError
from splatam_core.geometry import se3
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.maps.viewer.packing import ROW, SCALE, Chunks, Key

Matrix = NDArray[np.float64]

FRUSTUM_M = 0.15
LINE_PX = 2.5
MAX_LINE_POINTS = 4000
MAX_PORTS, LAST_PORT = 1000, 65535  # that are tried
ANY, ANY_V6 = '0.0.0.0', '::'  # every address of the machine
CAMERA_COLOR = (230, 230, 230)
BACK_M, ABOVE_M, AHEAD_M = 0.9, 0.35, 2.0
"""From where a camera is watched: behind and above it, towards a point ahead of it."""


def check_viser() -> None:
    """Check that the package which serves the page is installed.

    Raises:
        ViewerError: it is not.
    """
    if find_spec('viser') is None:
        raise ViewerError("the viewer needs viser: pip install 'splatam_ros[viewer]'")


def open_server(host: str, port: int) -> Any:
    """Return a ``viser.ViserServer`` that serves an empty page. If the port is taken, the next free one is used.

    Raises:
        ViewerError: viser is missing, or the address cannot be used.
    """
    check_viser()
    port = _free_port(host, port)
    import rich
    import viser

    rich.reconfigure(quiet=True)  # viser prints a banner through it
    logging.getLogger('websockets').setLevel(logging.CRITICAL)  # browsers open connections that they do not use
    try:
        server: Any = viser.ViserServer(host=host, port=port, label='SplaTAM', verbose=False)
    except (OSError, AssertionError) as error:
        raise ViewerError(f'the viewer cannot use {host}:{port}: {error}') from None
    server.request_share_url = _refuse_to_share
    server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
    server.scene.set_background_image(np.zeros((8, 8, 3), np.uint8))
    return server


def _free_port(host: str, port: int) -> int:
    """Returns the first port from this one that can be listened on: where there is none, viser would wait for ever.

    Raises:
        ViewerError: the address cannot be listened on, or each of these ports is taken.
    """
    where = f'{host}:{port}'
    try:
        family, kind, *_, name = socket.getaddrinfo(host or None, None, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        for number in range(port, min(port + MAX_PORTS, LAST_PORT) + 1):
            with socket.socket(family, kind) as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as viser does: a page that was open just now
                try:
                    probe.bind((name[0], number, *name[2:]))
                    probe.listen()
                    return number
                except OSError as error:
                    if error.errno != errno.EADDRINUSE:
                        raise
    except (OSError, UnicodeError) as error:
        raise ViewerError(f'the viewer cannot use {where}: {error}') from None
    raise ViewerError(f'the viewer cannot use {where}: this port and those after it are taken, or do not exist')


def _refuse_to_share(*_: object, **__: object) -> None:
    """Stands in for viser's tunnel to a public server, which any browser could ask for."""


def address(server: Any) -> str:
    """Return where the page is, and for whom."""
    host = server.get_host()
    if _is_of_this_machine(host):
        return f'{page_url(server)}, for this machine only'
    return f'http://{_in_url(host or ANY)}:{server.get_port()}, for everybody who reaches this machine'


def page_url(server: Any) -> str:
    """Return the page's URL for a browser on this machine."""
    host = {'': '127.0.0.1', ANY: '127.0.0.1', ANY_V6: '::1', 'localhost': '127.0.0.1'}.get(server.get_host(), server.get_host())
    return f'http://{_in_url(host)}:{server.get_port()}'


def _in_url(host: str) -> str:
    return f'[{host}]' if ':' in host else host


def _is_of_this_machine(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == 'localhost'


class CameraPath:
    """Positions of a camera, thinned out evenly as they become many."""

    def __init__(self, most: int = 2 * MAX_LINE_POINTS) -> None:
        """Begin with none.

        Args:
            most: largest number of positions to keep.
        """
        self._most, self._stride, self._count = most, 1, 0
        self._kept: list[NDArray[np.float32]] = []
        self._newest = np.zeros((0, 3), np.float32)

    def extend(self, points: NDArray[np.float32]) -> None:
        """Add positions [N, 3]."""
        if not len(points):
            return
        self._kept += list(points[-self._count % self._stride :: self._stride])
        self._count, self._newest = self._count + len(points), points[-1:]
        while len(self._kept) > self._most:
            del self._kept[1::2]
            self._stride *= 2

    def points(self) -> NDArray[np.float32]:
        """Return the positions [N, 3], the first and the newest of all among them."""
        is_kept = (self._count - 1) % self._stride == 0
        return np.array([*self._kept, *self._newest[is_kept:]], np.float32).reshape(-1, 3)


class Scene:
    """The three-dimensional part of the page, in the axes of the map's world."""

    def __init__(self, server: Any) -> None:
        """Begin with an empty scene.

        Args:
            server: of ``open_server``.
        """
        self._server = server
        self._chunks = Chunks()
        self._handles: dict[Key, Any] = {}
        self._lines: dict[str, Any] = {}
        self._frustum: Any = None
        self._camera: PinholeCamera | None = None
        self._is_visible = True
        self.watch(np.eye(4))
        server.scene.set_up_direction((0.0, -1.0, 0.0))  # of the first camera's image

    def watch(self, T_world_cam: Matrix) -> None:
        """Set where a browser that opens the page looks from: behind and above a camera [4, 4]."""
        view = watching(T_world_cam)
        self._server.initial_camera.position = view[:3, 3]
        self._server.initial_camera.look_at = view[:3, 3] + AHEAD_M * view[:3, 2]
        self._server.initial_camera.up = -T_world_cam[:3, 1]

    def show_map(self, rows: NDArray[np.void], added_by: NDArray[np.integer], *, exactly: bool = False) -> int:
        """Show Gaussians; send the chunks that changed.

        Args:
            rows: [N] of ``pack``.
            added_by: [N] number of the frame that added each.
            exactly: True to send what differs at all, False to send what can be seen to differ.

        Returns:
            The number of chunks sent.
        """
        changes = self._chunks.update(rows, added_by, exactly=exactly)
        with self._server.atomic():
            for key in changes.removed:
                self._handles.pop(key).remove()
            for key, chunk in changes.changed.items():
                self._send(key, chunk)
        return len(changes.changed)

    def _send(self, key: Key, chunk: NDArray[np.void]) -> None:
        if key not in self._handles:
            count = len(chunk)
            self._handles[key] = self._server.scene.add_gaussian_splats(
                f'/map/{key[0]}_{key[1]}', np.zeros((count, 3)), np.zeros((count, 3, 3)), np.zeros((count, 3)),
                np.zeros((count, 1)), scale=1 / SCALE, visible=self._is_visible,
            )  # fmt: skip
        self._handles[key].buffer = chunk.view(np.uint32).reshape(len(chunk), ROW.itemsize // 4)

    def show_camera(self, T_world_cam: Matrix, camera: PinholeCamera, image: NDArray[np.uint8] | None) -> None:
        """Show a camera.

        Args:
            T_world_cam: [4, 4] its pose.
            camera: its intrinsics.
            image: [H, W, 3] what it sees, of any size; None = as before.
        """
        if self._frustum is None or camera != self._camera:
            self._camera = camera
            self._frustum = self._server.scene.add_camera_frustum(
                '/camera', fov=2 * np.arctan2(camera.height / 2, camera.fy), aspect=camera.width / camera.height,
                scale=FRUSTUM_M, color=CAMERA_COLOR, thickness=0.004, cast_shadow=False, receive_shadow=False,
            )  # fmt: skip
        with self._server.atomic():
            self._frustum.wxyz = se3.quaternion_from_rotation(T_world_cam[:3, :3])
            self._frustum.position = T_world_cam[:3, 3]
            if image is not None:
                self._frustum.image = image

    def show_line(self, name: str, points: NDArray[np.floating], color: tuple[int, int, int]) -> None:
        """Show points [N, 3] joined by a line; long ones are thinned out evenly. A line of fewer than two is removed."""
        points = points[np.unique(np.linspace(0, len(points) - 1, min(len(points), MAX_LINE_POINTS)).round().astype(int))]
        self.show_segments(name, np.stack([points[:-1], points[1:]], axis=1), color)

    def show_segments(self, name: str, segments: NDArray[np.floating], color: tuple[int, int, int]) -> None:
        """Show line segments [N, 2, 3]; none removes them."""
        if len(segments) == 0:
            if name in self._lines:
                self._lines.pop(name).remove()
        elif name in self._lines:
            self._lines[name].points = segments.astype(np.float32)
        else:
            self._lines[name] = self._server.scene.add_line_segments(
                f'/{name}', segments.astype(np.float32), color, thickness=LINE_PX, thickness_units='screen'
            )

    def set_visible(self, *, gaussians: bool, camera: bool, lines: bool) -> None:
        """Show or hide parts of the scene."""
        self._is_visible = gaussians
        shown = [(handle, gaussians) for handle in self._handles.values()]
        shown += [(handle, lines) for handle in self._lines.values()]
        shown += [(self._frustum, camera)] if self._frustum is not None else []
        for handle, is_visible in shown:
            if handle.visible != is_visible:
                handle.visible = is_visible

    def follow(self, T_world_cam: Matrix) -> None:
        """Move every browser's view behind a camera [4, 4]."""
        view = watching(T_world_cam)
        for client in self._server.get_clients().values():
            with client.atomic():
                client.camera.wxyz = se3.quaternion_from_rotation(view[:3, :3])
                client.camera.position = view[:3, 3]

    def clear(self) -> None:
        """Remove everything: a new map begins."""
        self._chunks.clear()
        frustum = [self._frustum] if self._frustum is not None else []
        for handle in (*self._handles.values(), *self._lines.values(), *frustum):
            handle.remove()
        self._handles, self._lines, self._frustum = {}, {}, None


def watching(T_world_cam: Matrix) -> Matrix:
    """Return the [4, 4] pose from which a camera is watched; it looks ahead as the camera does, a little downwards."""
    T_cam_view = se3.exp(np.array([0, 0, 0, -np.arctan2(ABOVE_M, BACK_M + AHEAD_M), 0, 0]))
    T_cam_view[:3, 3] = 0, -ABOVE_M, -BACK_M
    return T_world_cam @ T_cam_view
