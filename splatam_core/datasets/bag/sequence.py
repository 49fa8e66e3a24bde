"""ROS bags: a rosbag2 folder with ``metadata.yaml``, one ``.db3`` or ``.mcap`` file, or a ROS 1 ``.bag`` file.

::

    my_bag/                                 my_recording.bag        # ROS 1
        metadata.yaml                       camera.yaml
        my_bag_0.db3  or  my_bag_0.mcap
        camera.yaml             # optional; overrides the bag's CameraInfo

Topics are found by type, among those that have messages:

- colour: ``sensor_msgs/Image`` or ``CompressedImage``;
- depth, registered to colour: the same types, told apart by encoding (16UC1 and mono16 in
  millimetres, 32FC1 in metres, compressedDepth), and for other compressed images by ``depth`` in the
  topic's name;
- camera: ``sensor_msgs/CameraInfo``; if there are several, the one in the colour image's namespace;
- ground truth: ``geometry_msgs/PoseStamped`` on ``/ground_truth/pose``; optional.

Colour and depth are paired by header stamps, as the node pairs them: nearest in time, at most 20 ms
apart. Only stamps are kept in memory; images are read from the file when a frame is asked for.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msg_adapters import images
from msg_adapters.errors import MessageError
from splatam_core.datasets.bag.index import read_index
from splatam_core.datasets.bag.recording import Recording
from splatam_core.datasets.bag.storage import is_bag
from splatam_core.datasets.bag.topics import choose_topics
from splatam_core.datasets.base import BagTopics, Format, ReadOptions
from splatam_core.datasets.camera_file import CameraFile, find_camera_file
from splatam_core.errors import DatasetError, FrameError
from splatam_core.geometry.trajectory import Trajectory, stamp_text
from splatam_core.images.rectification import FrameFactory
from splatam_core.types import RgbdFrame

MILLIMETRES = 1000.0


class BagSequence:
    """The frames of a bag; the module's docstring says what is read."""

    def __init__(self, path: Path, *, width: int | None = None, topics: BagTopics | None = None) -> None:
        """Find the topics of a bag and pair its images.

        Raises:
            DatasetError: the bag is broken or empty, a topic is missing or ambiguous, nothing pairs up,
                the camera changes, or time runs backwards.
            CameraError: the camera cannot be used.
        """
        recording = Recording(path)
        stated = find_camera_file(path if path.is_dir() else path.parent)
        chosen = choose_topics(recording, topics or BagTopics(), need_info=stated is None)
        index = read_index(recording, chosen)
        self._frames = FrameFactory(stated.calibration if stated else index.calibration(), width)
        self._pairs = index.pairs()
        self._ground_truth = index.ground_truth
        self._color = _Stream(recording, chosen.rgb, index.recorded_ns(chosen.rgb))
        self._depth = _Stream(recording, chosen.depth, index.recorded_ns(chosen.depth))
        self.depth_scale = _depth_scale(recording.encoding(chosen.depth) or '', stated)
        self._path = path
        self.name = path.resolve().name if path.is_dir() else path.stem
        self.camera = self._frames.camera

    def __len__(self) -> int:
        return len(self._pairs)

    def __getitem__(self, index: int) -> RgbdFrame:
        """Read one frame."""
        pair = self._pairs[index]
        try:
            rgb = images.decode_color(self._color[pair.color])
            depth_m = images.decode_depth(self._depth[pair.depth])
        except MessageError as error:
            raise FrameError(f'{self._path}: image at {stamp_text(pair.stamp_ns)} s: {error}') from None
        if self.depth_scale is not None and self.depth_scale != MILLIMETRES:
            depth_m = depth_m * np.float32(MILLIMETRES / self.depth_scale)  # decode_depth takes counts as millimetres
        return self._frames.make(pair.stamp_ns, rgb, depth_m)

    def ground_truth(self) -> Trajectory | None:
        """The poses on ``/ground_truth/pose``; None where there are none."""
        return self._ground_truth


class _Stream:
    """Access to the messages of one topic by number. Reading forwards is fast; any other order restarts the iteration."""

    LOOK_AHEAD = 8

    def __init__(self, recording: Recording, topic: str, recorded_ns: NDArray[np.int64]) -> None:
        self._recording, self._topic, self._recorded_ns = recording, topic, recorded_ns
        self._cursor: Iterator[tuple[int, bytes]] = iter(())

    def __getitem__(self, number: int) -> Any:
        data = self._search(number, self.LOOK_AHEAD)
        if data is None:
            self._cursor = self._read_from(number)
            data = self._search(number, None)
        if data is None:
            raise DatasetError(f'{self._recording.path}: message {number} of {self._topic} is gone; did the file change?')
        return self._recording.decode(self._topic, data)

    def _search(self, number: int, at_most: int | None) -> bytes | None:
        for position, data in islice(self._cursor, at_most):
            if position >= number:
                return data if position == number else None
        return None

    def _read_from(self, number: int) -> Iterator[tuple[int, bytes]]:
        """Iterate from a message's time of recording on; several may have that time, and split bags may overlap."""
        start_ns = int(self._recorded_ns[number])
        positions = np.flatnonzero(self._recorded_ns >= start_ns)
        for position, message in zip(positions, self._recording.messages([self._topic], start_ns), strict=False):
            yield int(position), message.data


def _depth_scale(encoding: str, stated: CameraFile | None) -> float | None:
    """Counts per metre of 16-bit depth; None for depth in metres."""
    if '32FC1' in encoding:
        return None
    return (stated.depth_scale if stated else None) or MILLIMETRES


def _recognises(source: str) -> bool:
    return is_bag(Path(source))


def _open(source: str, options: ReadOptions) -> BagSequence:
    return BagSequence(Path(source), width=options.width, topics=options.topics)


FORMAT = Format(
    'rosbag', 'a rosbag2 folder with metadata.yaml, a .db3 or .mcap file, or a ROS 1 .bag file', _recognises, _open,
    has_topics=True,
)  # fmt: skip
