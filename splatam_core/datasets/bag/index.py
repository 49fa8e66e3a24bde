"""Reads a bag once, keeping stamps, cameras and poses but no images, and pairs colour with depth."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from msg_adapters import camera_info, poses
from msg_adapters.errors import MessageError
from msg_adapters.stamps import serialized_stamp_ns
from msg_adapters.synchronizer import RgbdSet, RgbdSynchronizer
from splatam_core.datasets.bag.recording import RawMessage, Recording
from splatam_core.datasets.bag.topics import ChosenTopics
from splatam_core.datasets.base import check_increasing
from splatam_core.errors import CameraError, DatasetError
from splatam_core.geometry.camera import CameraCalibration
from splatam_core.geometry.trajectory import Trajectory, stamp_text

MAX_INTERVAL_NS = 20_000_000
QUEUE_SIZE = 300  # ten seconds of one stream before the other begins
JUMP_NS = 1_000_000_000

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class ImageEntry:
    """A colour or depth message of the bag, without its image."""

    topic: str
    recorded_ns: int
    stamp_ns: int


@dataclass(frozen=True, slots=True)
class BagIndex:
    """What one pass over a bag finds out.

    Attributes:
        path: the bag.
        topics: which topics were read.
        entries: colour and depth messages in the order of the bag.
        cameras: each different camera, with the stamp of its first camera info.
        ground_truth: the true poses; None where the bag has none.
    """

    path: Path
    topics: ChosenTopics
    entries: list[ImageEntry]
    cameras: Mapping[CameraCalibration, int]
    ground_truth: Trajectory | None

    def recorded_ns(self, topic: str) -> NDArray[np.int64]:
        """[N] times of recording of the messages of an image topic."""
        return np.array([entry.recorded_ns for entry in self.entries if entry.topic == topic], np.int64)

    def calibration(self) -> CameraCalibration:
        """Returns the camera of the bag.

        Raises:
            DatasetError: there are several.
        """
        if len(self.cameras) > 1:
            (first, _), (second, stamp_ns) = list(self.cameras.items())[:2]
            raise DatasetError(
                f'{self.path}: the camera changes at {stamp_text(stamp_ns)} s from {first} to {second}; all frames must '
                'come from one: cut the bag there, or state one camera in a camera.yaml beside it'
            )
        return next(iter(self.cameras))

    def pairs(self) -> list[RgbdSet]:
        """Pair colour and depth messages; ``color`` and ``depth`` of a pair are their numbers within their topic.

        Raises:
            DatasetError: nothing pairs up, or time does not increase.
        """
        pairing = RgbdSynchronizer(mode='approximate', max_interval_ns=MAX_INTERVAL_NS, queue_size=QUEUE_SIZE, jump_ns=JUMP_NS)
        pairing.add_info(self.entries[0].stamp_ns if self.entries else 0, None)  # one camera, known beforehand
        rgb, depth = self.topics.rgb, self.topics.depth
        counts = {rgb: 0, depth: 0}
        add = {rgb: pairing.add_color, depth: pairing.add_depth}
        pairs: list[RgbdSet] = []
        for entry in self.entries:
            pairs += add[entry.topic](entry.stamp_ns, counts[entry.topic])
            counts[entry.topic] += 1
        pairs += pairing.flush()
        if not pairs:
            raise DatasetError(
                f'{self.path}: none of {counts[rgb]} images on {rgb} and {counts[depth]} on {depth} '
                f'are within {MAX_INTERVAL_NS / 1e6:g} ms of each other by their header stamps'
            )
        if len(pairs) < counts[rgb]:
            _log.warning('%s: %d of %d colour images have no depth', self.path, counts[rgb] - len(pairs), counts[rgb])
        check_increasing(np.array([pair.stamp_ns for pair in pairs], np.int64), str(self.path))
        return pairs


def read_index(recording: Recording, topics: ChosenTopics) -> BagIndex:
    """Read a bag once.

    Raises:
        DatasetError: messages are missing or unreadable.
        CameraError: a camera info cannot be used.
    """
    counts = dict.fromkeys(topics.names, 0)
    entries: list[ImageEntry] = []
    cameras: dict[CameraCalibration, int] = {}
    poses_by_stamp: dict[int, NDArray[np.float64]] = {}
    for message in recording.messages(topics.names):
        counts[message.topic] += 1
        stamp_ns = _stamp_ns(recording, message)
        if message.topic == topics.info:
            cameras.setdefault(_calibration(recording, message), stamp_ns)
        elif message.topic == topics.ground_truth:
            poses_by_stamp[stamp_ns] = _pose(recording, message)
        else:
            entries.append(ImageEntry(message.topic, message.time_ns, stamp_ns))
    _check_complete(recording, counts)
    return BagIndex(recording.path, topics, entries, cameras, _trajectory(poses_by_stamp))


def _check_complete(recording: Recording, counts: Mapping[str, int]) -> None:
    for topic, count in counts.items():
        stated = recording.topics[topic].num_messages
        if count != stated:
            raise DatasetError(
                f'{recording.path}: {topic} has {count} messages of the {stated} that the bag states; is the copy complete?'
            )


def _stamp_ns(recording: Recording, message: RawMessage) -> int:
    """Returns the header's stamp; every type read here begins with a header."""
    try:
        return serialized_stamp_ns(message.data)
    except MessageError as error:
        raise DatasetError(f'{recording.path}: a message on {message.topic} {error}') from None


def _calibration(recording: Recording, message: RawMessage) -> CameraCalibration:
    try:
        info = recording.decode(message.topic, message.data)
        return CameraCalibration.from_intrinsics(camera_info.parameters(info))
    except (MessageError, CameraError) as error:
        raise CameraError(f'{recording.path}: {message.topic}: {error}') from None


def _pose(recording: Recording, message: RawMessage) -> NDArray[np.float64]:
    try:
        return poses.pose_matrix(recording.decode(message.topic, message.data).pose)
    except MessageError as error:
        raise DatasetError(f'{recording.path}: {message.topic}: {error}') from None


def _trajectory(poses_by_stamp: Mapping[int, NDArray[np.float64]]) -> Trajectory | None:
    if not poses_by_stamp:
        return None
    stamps = sorted(poses_by_stamp)
    return Trajectory(np.array(stamps, np.int64), np.stack([poses_by_stamp[stamp] for stamp in stamps]))
