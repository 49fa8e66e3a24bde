"""ROS bags: a rosbag2 folder, one ``.db3`` or ``.mcap`` file (also ``.zstd``), or a ROS 1 ``.bag`` file.

::

    my_bag/                                 my_recording.bag        # ROS 1
        metadata.yaml                       camera.yaml
        my_bag_0.db3  or  my_bag_0.mcap
        camera.yaml             # optional; overrides the bag's CameraInfo

Topics are found by type, among those that have messages:

- colour: ``sensor_msgs/Image`` or ``CompressedImage``;
- depth, registered to colour: the same types, told apart by encoding (16UC1 and mono16 in
  millimetres, 32FC1 in metres, compressedDepth as PNG or RVL), and for other compressed images by ``depth`` in the
  topic's name;
- camera: ``sensor_msgs/CameraInfo``; if there are several, the one in the colour image's namespace;
- ground truth: ``geometry_msgs/PoseStamped`` on ``/ground_truth/pose``; optional. Poses that are not finite are unknown.

Topics of RealSense Viewer are known by their names, and its unit of depth is used.

Colour and depth are paired by header stamps, as the node pairs them: nearest in time, at most half the time between
colour images apart (but 20 to 50 ms), or ``--max-interval``. ``--use-receive-time`` replaces header stamps by times of
recording. Small changes of the camera, as by autofocus, are rectified to the first camera.

What is whole of an interrupted or damaged bag is read, with a warning. A damaged message costs one frame. Only stamps are kept in
memory; images are read from the file when a frame is asked for.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msg_adapters import camera_info, images, remarks
from msg_adapters.errors import MessageError
from splatam_core.datasets.bag import realsense
from splatam_core.datasets.bag.index import BagIndex, read_index
from splatam_core.datasets.bag.recording import Recording
from splatam_core.datasets.bag.topics import ChosenTopics, choose_topics, namespace
from splatam_core.datasets.bag.typestore import CAMERA_INFO
from splatam_core.datasets.base import ReadOptions
from splatam_core.datasets.camera_file import CameraFile, find_camera_file
from splatam_core.errors import CameraError, DatasetError, FrameError
from splatam_core.geometry.camera import CameraCalibration
from splatam_core.geometry.trajectory import Trajectory, stamp_text
from splatam_core.images.rectification import FrameFactories
from splatam_core.types import RgbdFrame

MILLIMETRES = 1000.0

_log = logging.getLogger(__name__)


class BagSequence:
    """The frames of a bag; the module's docstring says what is read."""

    def __init__(self, path: Path, options: ReadOptions) -> None:
        """Find the topics of a bag and pair its images.

        Args:
            path: the bag.
            options: width, topics and how to read messages.

        Raises:
            DatasetError: the bag is broken or empty, a topic is missing or ambiguous, nothing pairs up,
                the camera changes, or time runs backwards.
            CameraError: the camera cannot be used.
        """
        recording = Recording(path)
        stated = find_camera_file(path if path.is_dir() else path.parent)
        chosen = choose_topics(recording, options.topics, need_info=stated is None)
        index = read_index(recording, chosen, use_receive_time=options.use_receive_time)
        self._cameras = _Cameras(stated, index)
        self._factories = FrameFactories(options.width)
        self.camera = self._factories.of(self._cameras.first).camera
        self._pairs = index.pairs(None if options.max_interval_s is None else round(options.max_interval_s * 1e9))
        self._ground_truth = index.ground_truth
        self._color = _Stream(recording, chosen.rgb, index.recorded_ns(chosen.rgb))
        self._depth = _Stream(recording, chosen.depth, index.recorded_ns(chosen.depth))
        self.depth_scale = _depth_scale(recording, chosen.depth, stated)
        self._rgb_encoding = options.rgb_encoding
        self._path = path
        self.name = path.resolve().name if path.is_dir() else path.stem
        gaps_ns = np.sort([pair.gap_ns for pair in self._pairs])
        for remark in _remarks(recording, chosen, options.rgb_encoding, int(gaps_ns[len(gaps_ns) // 2])):
            _log.warning('%s: %s', path, remark)

    def __len__(self) -> int:
        return len(self._pairs)

    def __getitem__(self, index: int) -> RgbdFrame:
        """Read one frame."""
        pair = self._pairs[index]
        calibration = self._cameras.at(pair.stamp_ns)
        size = calibration.pinhole.width, calibration.pinhole.height
        color, depth = self._color[pair.color], self._depth[pair.depth]
        try:
            rgb = images.decode_color(color(), camera_size=size, rgb_encoding=self._rgb_encoding)
            depth_m = images.decode_depth(depth(), camera_size=size)
        except (MessageError, DatasetError) as error:
            raise FrameError(f'{self._path}: image at {stamp_text(pair.stamp_ns)} s: {error}') from None
        if self.depth_scale is not None and self.depth_scale != MILLIMETRES:
            depth_m = depth_m * np.float32(MILLIMETRES / self.depth_scale)  # decode_depth takes counts as millimetres
        return self._factories.of(calibration).make(pair.stamp_ns, rgb, depth_m)

    def ground_truth(self) -> Trajectory | None:
        """The poses on ``/ground_truth/pose``; None where there are none."""
        return self._ground_truth


class _Cameras:
    """The calibration of the camera at every stamp."""

    def __init__(self, stated: CameraFile | None, index: BagIndex) -> None:
        """Choose the file beside the bag, or the bag's camera infos.

        Raises:
            DatasetError: several cameras took the images.
        """
        if stated is None:
            index.check_cameras()
            self._calibrations = [camera.calibration for camera in index.cameras]
            self._stamps_ns = np.array([camera.stamp_ns for camera in index.cameras], np.int64)
        else:
            self._calibrations, self._stamps_ns = [stated.calibration], np.zeros(1, np.int64)
        self.first = self._calibrations[0]

    def at(self, stamp_ns: int) -> CameraCalibration:
        """Returns the newest calibration that is not newer than the stamp; before the first one, the first."""
        return self._calibrations[max(int(np.searchsorted(self._stamps_ns, stamp_ns, side='right')) - 1, 0)]


class _Stream:
    """Access to the messages of one topic by number. Reading forwards is fast; any other order restarts the iteration."""

    LOOK_AHEAD = 8

    def __init__(self, recording: Recording, topic: str, recorded_ns: NDArray[np.int64]) -> None:
        self._recording, self._topic, self._recorded_ns = recording, topic, recorded_ns
        self._cursor: Iterator[tuple[int, bytes]] = iter(())

    def __getitem__(self, number: int) -> Callable[[], Any]:
        """Returns a function that decodes a message; it raises ``DatasetError`` if that is damaged."""
        data = self._search(number, self.LOOK_AHEAD)
        if data is None:
            self._cursor = self._read_from(number)
            data = self._search(number, None)
        if data is None:
            raise DatasetError(f'{self._recording.path}: message {number} of {self._topic} is gone; did the file change?')
        return partial(self._recording.decode, self._topic, data)

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


def _depth_scale(recording: Recording, topic: str, stated: CameraFile | None) -> float | None:
    """Counts per metre of 16-bit depth; None for depth in metres."""
    if '32FC1' in (recording.encoding(topic) or ''):
        return None
    if stated is not None and stated.depth_scale:
        return stated.depth_scale
    unit_m = recording.depth_unit_m(topic)
    return MILLIMETRES if unit_m is None else float(f'{1 / unit_m:.7g}')


def _remarks(recording: Recording, topics: ChosenTopics, rgb_encoding: str | None, gap_ns: int) -> list[str]:
    """Returns what the user should know of the images.

    Args:
        recording: the bag.
        topics: the topics that are read.
        rgb_encoding: what the user states about images whose encoding does not say the order of channels.
        gap_ns: median of depth's stamps minus colour's.
    """
    color, depth = recording.image_facts(topics.rgb), recording.image_facts(topics.depth)
    found = [remarks.on_gap(gap_ns)]
    if color is not None and depth is not None:
        found.append(remarks.on_encoding(color.encoding, rgb_encoding))
        found.append(remarks.on_frames(color.frame_id, depth.frame_id) or _on_depth_camera(recording, topics))
    return [remark for remark in found if remark]


def _on_depth_camera(recording: Recording, topics: ChosenTopics) -> str:
    """Returns a sentence about depth whose camera info differs from colour's; empty if it does not, or there is none."""
    cameras = [_first_camera(recording, namespace(topic)) for topic in (topics.rgb, topics.depth)]
    if cameras[0] is None or cameras[1] is None:
        return ''
    color, depth = cameras[0].pinhole, cameras[1].pinhole
    if replace(cameras[0], pinhole=color.resized(depth.width, depth.height)).is_close_to(cameras[1]):
        return ''
    viewer = ', which RealSense Viewer does not record' if realsense.is_viewer(topics.depth) else ''
    return (
        f'depth has a camera of its own (fx {depth.fx:g} at {depth.width}x{depth.height}, colour: fx {color.fx:g} at '
        f'{color.width}x{color.height}): depth must be registered to colour, and this is not; use the depth that the driver '
        f'aligns (RealSense: aligned_depth_to_color{viewer})'
    )


def _first_camera(recording: Recording, name: str) -> CameraCalibration | None:
    """Returns the camera of the first camera info below a name; None if there is none that can be used."""
    for topic in recording.topics_of(CAMERA_INFO):
        if namespace(topic) == name:
            for message in islice(recording.messages([topic]), 1):
                try:
                    return CameraCalibration.from_intrinsics(camera_info.parameters(recording.decode(topic, message.data)))
                except (MessageError, CameraError, DatasetError):
                    return None
    return None
