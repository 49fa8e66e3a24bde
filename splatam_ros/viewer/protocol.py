"""What node and viewer say to each other: requests, and answers whose arrays lie in memory that both share.

The viewer asks for a kind of update; the node answers after its next frame. Each kind has a memory of its own, which belongs
to the node from a request to its answer, and to the viewer otherwise. So neither waits for the other, and no update is
read while it is written.
"""

from __future__ import annotations

import json
import mmap
import os
import socket
from dataclasses import dataclass, fields
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

MAX_MESSAGE = 1 << 16
ALIGNMENT = 64


@dataclass(frozen=True, slots=True, eq=False)
class FrameUpdate:
    """The newest frame.

    Attributes:
        epoch: number of the map; when it changes, everything before is void.
        num_frames: number of frames so far.
        num_gaussians: size of the map.
        status: of the frame.
        reason: why it is uncertain or lost; empty otherwise.
        frame_ms: time that it took.
        pose: [4, 4] T_world_cam; [0, 4] where it is lost.
        camera: [6] width, height, fx, fy, cx, cy.
        image: [H, W, 3] what the camera saw, made smaller.
        path: [N, 3] positions of the trusted frames since the last update of the same epoch, as tracked.
        nodes: [K, 3] positions of the keyframes after all corrections of the graph, in order.
        loops: [L, 2] numbers of the keyframes that loops connect.
    """

    code: ClassVar[bytes] = b'f'
    epoch: int
    num_frames: int
    num_gaussians: int
    status: str
    reason: str
    frame_ms: float
    pose: NDArray[np.float64]
    camera: NDArray[np.float64]
    image: NDArray[np.uint8]
    path: NDArray[np.float32]
    nodes: NDArray[np.float64]
    loops: NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class MapUpdate:
    """The Gaussians, as ``GaussianMap`` holds them.

    Attributes:
        epoch: number of the map.
        means: [N, 3] metres, world.
        log_scales: [N, 1 or 3] log metres.
        logit_opacities: [N].
        rgb: [N, 3].
        rotations: [N, 4] quaternions; [0, 4] for isotropic Gaussians.
        added_by: [N] number of the frame that added each.
    """

    code: ClassVar[bytes] = b'm'
    epoch: int
    means: NDArray[np.float32]
    log_scales: NDArray[np.float32]
    logit_opacities: NDArray[np.float32]
    rgb: NDArray[np.float32]
    rotations: NDArray[np.float32]
    added_by: NDArray[np.int32]


Update = FrameUpdate | MapUpdate
KINDS: tuple[type[FrameUpdate], type[MapUpdate]] = FrameUpdate, MapUpdate


class SharedMemory:
    """Anonymous memory that grows; the other process gets its file descriptor."""

    def __init__(self, descriptor: int | None = None) -> None:
        """Create it, or open that of the other process."""
        self.descriptor = os.memfd_create('splatam_viewer') if descriptor is None else descriptor
        self._map: mmap.mmap | None = None

    def at_least(self, size: int) -> memoryview:
        """Return the memory, at least ``size`` bytes; it grows by more than that, since a map grows frame by frame."""
        size = max(1, size)  # of nothing, too, such as a map before the first frame
        if self._map is None or len(self._map) < size:
            if os.fstat(self.descriptor).st_size < size:
                os.ftruncate(self.descriptor, max(1 << 16, size + size // 2))
            self._map = mmap.mmap(self.descriptor, os.fstat(self.descriptor).st_size)
        return memoryview(self._map)

    def close(self) -> None:
        """Give the memory back, once nobody uses it."""
        os.close(self.descriptor)


def write(update: Update, memory: SharedMemory) -> bytes:
    """Copy the arrays of an update into the memory. Returns the message that says where they are."""
    values = {field.name: getattr(update, field.name) for field in fields(update)}
    arrays = {name: value for name, value in values.items() if isinstance(value, np.ndarray)}
    places, end = {}, 0
    for name, array in arrays.items():
        places[name] = [end, array.dtype.str, array.shape]
        end += -(-array.nbytes // ALIGNMENT) * ALIGNMENT
    content = memory.at_least(end)
    for name, array in arrays.items():
        np.copyto(np.ndarray(array.shape, array.dtype, content, places[name][0]), array)
    scalars = {name: value for name, value in values.items() if name not in arrays}
    return update.code + json.dumps([scalars, places]).encode()


def read(message: bytes, memories: dict[bytes, SharedMemory]) -> Update:
    """Return an update. Its arrays are those of the memory: they hold until the next request of its kind."""
    kind = next(kind for kind in KINDS if kind.code == message[:1])
    scalars, places = json.loads(message[1:])
    size = max(begin + np.dtype(dtype).itemsize * int(np.prod(shape)) for begin, dtype, shape in places.values())
    content = memories[kind.code].at_least(size)
    arrays = {name: np.ndarray(shape, dtype, content, begin) for name, (begin, dtype, shape) in places.items()}
    return kind(**scalars, **arrays)


def socket_pair() -> tuple[socket.socket, socket.socket]:
    """Return two connected sockets that keep messages apart."""
    return socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
