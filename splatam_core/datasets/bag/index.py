"""Reads a bag once, keeping stamps, cameras and poses but no images, and pairs colour with depth."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from msg_adapters import camera_info, poses, remarks
from msg_adapters.errors import MessageError
from msg_adapters.stamps import serialized_stamp_ns
from msg_adapters.synchronizer import RgbdSet, RgbdSynchronizer
from splatam_core.datasets.bag.recording import RawMessage, Recording
from splatam_core.datasets.bag.topics import ChosenTopics
from splatam_core.datasets.base import check_increasing, nearest_depth
from splatam_core.errors import CameraError, DatasetError
from splatam_core.geometry.camera import CameraCalibration
from splatam_core.geometry.stamps import stray_stamps
from splatam_core.geometry.trajectory import Trajectory, stamp_text

QUEUE_SIZE = 300  # ten seconds of one stream before the other begins
JUMP_NS = 1_000_000_000
LEAST_AGREEING = 3  # camera infos, among which one that differs is a stray
MIN_STAMPS = 2

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class ImageEntry:
    """A colour or depth message of the bag, without its image.

    Attributes:
        topic: its topic.
        recorded_ns: its time of recording.
        stamp_ns: its stamp; None if the message is damaged.
    """

    topic: str
    recorded_ns: int
    stamp_ns: int | None


@dataclass(frozen=True, slots=True)
class StampedCamera:
    """The camera that a camera info states, with the stamp of the camera info.

    Attributes:
        stamp_ns: of the first message.
        calibration: the camera.
        count: number of messages one after the other that state the same.
    """

    stamp_ns: int
    calibration: CameraCalibration
    count: int = 1


@dataclass(frozen=True, slots=True)
class BagIndex:
    """What one pass over a bag finds out.

    Attributes:
        path: the bag.
        topics: which topics were read.
        entries: colour and depth messages in the order of the bag.
        cameras: of each camera info that differs from the one before, in order of their stamps.
        ground_truth: the true poses; None where the bag has none.
    """

    path: Path
    topics: ChosenTopics
    entries: Sequence[ImageEntry]
    cameras: Sequence[StampedCamera]
    ground_truth: Trajectory | None

    def recorded_ns(self, topic: str) -> NDArray[np.int64]:
        """[N] times of recording of the messages of an image topic."""
        return np.array([entry.recorded_ns for entry in self.entries if entry.topic == topic], np.int64)

    def check_cameras(self) -> None:
        """Check that one camera took the images; its focus may change.

        Raises:
            DatasetError: there are several.
        """
        first = self.cameras[0].calibration
        for camera in self.cameras:
            if not first.is_close_to(camera.calibration):
                raise DatasetError(
                    f'{self.path}: the camera changes at {stamp_text(camera.stamp_ns)} s from {first} to {camera.calibration}; '
                    'all frames must come from one: cut the bag there, or state one camera in a camera.yaml beside it'
                )

    def pairs(self, max_interval_ns: int | None = None) -> list[RgbdSet]:
        """Pair colour and depth messages; ``color`` and ``depth`` of a pair are their numbers within their topic.

        Args:
            max_interval_ns: largest distance of the stamps; None adapts to the rate.

        Raises:
            DatasetError: nothing pairs up, or time does not increase.
        """
        pairing = RgbdSynchronizer('approximate', max_interval_ns, QUEUE_SIZE, JUMP_NS)
        pairing.add_info(0, None)  # the cameras are known
        rgb, depth = self.topics.rgb, self.topics.depth
        counts = {rgb: 0, depth: 0}
        add = {rgb: pairing.add_color, depth: pairing.add_depth}
        pairs: list[RgbdSet] = []
        for entry in self.entries:
            if entry.stamp_ns is not None:
                pairs += add[entry.topic](entry.stamp_ns, counts[entry.topic])
            counts[entry.topic] += 1
        pairs += pairing.flush()
        if not pairs:
            raise DatasetError(
                f'{self.path}: none of {counts[rgb]} images on {rgb} and {counts[depth]} on {depth} '
                f'are within {pairing.max_interval_ns / 1e6:g} ms of each other by their header stamps{self._nearest()}'
            )
        repeated = counts[rgb] - len({entry.stamp_ns for entry in self.entries if entry.topic == rgb})
        if repeated:
            _log.warning('%s: %d of %d colour images have a stamp that another one has, too', self.path, repeated, counts[rgb])
        if (alone := counts[rgb] - repeated - len(pairs)) > 0:
            _log.warning('%s: %d of %d colour images have no depth', self.path, alone, counts[rgb])
        pairs = self._without_strays(pairs)
        check_increasing(np.array([pair.stamp_ns for pair in pairs], np.int64), str(self.path))
        return pairs

    def _without_strays(self, pairs: list[RgbdSet]) -> list[RgbdSet]:
        """Leaves out single frames with a wrong stamp, as the node does."""
        is_stray = stray_stamps(np.array([pair.stamp_ns for pair in pairs], np.int64))
        if not is_stray.any():
            return pairs
        at = int(np.flatnonzero(is_stray)[0])
        off_ns = pairs[at].stamp_ns - pairs[at - 1 if at else 1].stamp_ns
        _log.warning(
            '%s: %d of %d frames are skipped: of the first, %s, %s',
            self.path, is_stray.sum(), len(pairs), stamp_text(pairs[at].stamp_ns), remarks.on_wrong_stamp(off_ns),
        )  # fmt: skip
        return [pair for pair, stray in zip(pairs, is_stray, strict=True) if not stray]

    def _nearest(self) -> str:
        """Returns how far depth is from colour, for the error message; empty where one of them is missing."""
        color, depth = (
            np.array([entry.stamp_ns for entry in self.entries if entry.topic == topic and entry.stamp_ns is not None], np.int64)
            for topic in (self.topics.rgb, self.topics.depth)
        )
        return nearest_depth(color, depth)


@dataclass(slots=True)
class _Pass:
    """What is collected while a bag is read."""

    entries: list[ImageEntry] = field(default_factory=list)
    cameras: list[StampedCamera] = field(default_factory=list)
    poses_by_stamp: dict[int, NDArray[np.float64]] = field(default_factory=dict)
    num_poses: int = 0
    cameras_by_p: list[StampedCamera] = field(default_factory=list)
    remark: str = ''
    refused: list[str] = field(default_factory=list)
    damaged: dict[str, list[str]] = field(default_factory=dict)


def read_index(recording: Recording, topics: ChosenTopics, *, use_receive_time: bool = False) -> BagIndex:
    """Read a bag once. Messages that cannot be used are left out with a warning.

    Args:
        recording: the bag.
        topics: which of its topics to read.
        use_receive_time: True to take times of recording for stamps.

    Raises:
        DatasetError: the bag is damaged, or nobody stamped the images.
        CameraError: no camera info can be used.
    """
    try:
        found = _read(recording, topics, use_receive_time)
    except DatasetError:
        if not recording.salvage():
            raise
        found = _read(recording, topics, use_receive_time)
    _choose_cameras(found)
    _warn(recording, topics, found)
    if topics.info is not None and not found.cameras:
        reason = found.refused[0] if found.refused else 'there is no message on it'
        raise CameraError(f'{recording.path}: {topics.info}: {reason}')
    for topic in (topics.rgb, topics.depth):
        _check_stamps(recording, topic, [entry.stamp_ns for entry in found.entries if entry.topic == topic])
    cameras = _changes(_without_strays(recording, topics, sorted(found.cameras, key=lambda camera: camera.stamp_ns)))
    return BagIndex(recording.path, topics, found.entries, cameras, _trajectory(found.poses_by_stamp))


def _read(recording: Recording, topics: ChosenTopics, use_receive_time: bool) -> _Pass:
    found = _Pass()
    for message in recording.messages(topics.names):
        stamp_ns: int | None = None
        try:
            stamp_ns = message.time_ns if use_receive_time and message.data else serialized_stamp_ns(message.data)
        except MessageError as error:
            found.damaged.setdefault(message.topic, []).append(str(error))
        if message.topic in (topics.rgb, topics.depth):
            found.entries.append(ImageEntry(message.topic, message.time_ns, stamp_ns))
        elif stamp_ns is not None and message.topic == topics.info:
            _add_camera(found, recording, message, stamp_ns)
        elif stamp_ns is not None:
            _add_pose(found, recording, message, stamp_ns)
    return found


def _add_camera(found: _Pass, recording: Recording, message: RawMessage, stamp_ns: int) -> None:
    try:
        info = recording.decode(message.topic, message.data)
        calibration = CameraCalibration.from_intrinsics(camera_info.parameters(info))
        remark = remarks.on_info(info)
    except (MessageError, CameraError, DatasetError) as error:
        found.refused.append(str(error))
        return
    found.remark = found.remark or remark
    cameras = found.cameras_by_p if remark else found.cameras
    if not cameras or cameras[-1].calibration != calibration or cameras[-1].stamp_ns > stamp_ns:
        cameras.append(StampedCamera(stamp_ns, calibration))
    else:
        cameras[-1] = replace(cameras[-1], count=cameras[-1].count + 1)


def _without_strays(recording: Recording, topics: ChosenTopics, cameras: list[StampedCamera]) -> list[StampedCamera]:
    """Leaves out single messages that state another camera than the messages before and after them, which agree."""
    usual = max((camera.calibration for camera in cameras[:3]), key=lambda c: _num_close(c, cameras), default=None)
    if usual is None or _num_close(usual, cameras) < LEAST_AGREEING:
        return cameras
    is_stray = [not usual.is_close_to(camera.calibration) for camera in cameras]
    if not any(is_stray) or any(stray and camera.count > 1 for stray, camera in zip(is_stray, cameras, strict=True)):
        return cameras
    if any(before and after for before, after in pairwise(is_stray)):
        return cameras
    _log.warning(
        '%s: %d messages on %s state another camera than those before and after them, and are left out',
        recording.path, sum(is_stray), topics.info,
    )  # fmt: skip
    return [camera for stray, camera in zip(is_stray, cameras, strict=True) if not stray]


def _num_close(calibration: CameraCalibration, cameras: list[StampedCamera]) -> int:
    return sum(camera.count for camera in cameras if calibration.is_close_to(camera.calibration))


def _choose_cameras(found: _Pass) -> None:
    """Use camera infos that have only P where no other has K."""
    if found.cameras_by_p and found.cameras:
        found.refused.append('CameraInfo K is all zero')
        found.remark = ''
    elif found.cameras_by_p:
        found.cameras = found.cameras_by_p


def _add_pose(found: _Pass, recording: Recording, message: RawMessage, stamp_ns: int) -> None:
    found.num_poses += 1
    with suppress(MessageError, DatasetError):  # an unknown pose, or a damaged message
        found.poses_by_stamp[stamp_ns] = poses.pose_matrix(recording.decode(message.topic, message.data).pose)


def _warn(recording: Recording, topics: ChosenTopics, found: _Pass) -> None:
    for topic, reasons in found.damaged.items():
        _log.warning('%s: %d messages on %s are left out: the first %s', recording.path, len(reasons), topic, reasons[0])
    if found.refused and found.cameras:
        _log.warning('%s: messages on %s that state no camera are left out: %s', recording.path, topics.info, found.refused[0])
    if found.remark:
        _log.warning('%s: %s', recording.path, found.remark)
    unknown = found.num_poses - len(found.poses_by_stamp)
    if unknown:
        _log.warning(
            '%s: %d of %d poses on %s are unknown (not finite, or stamped twice) and left out',
            recording.path, unknown, found.num_poses, topics.ground_truth,
        )  # fmt: skip
    counts = dict.fromkeys(topics.names, 0)
    for entry in found.entries:
        counts[entry.topic] += 1
    for topic in (topics.rgb, topics.depth):
        stated = recording.topics[topic].num_messages
        if counts[topic] < stated:
            _log.warning(
                '%s: %s has %d messages of the %d that the bag states; is the copy complete?',
                recording.path, topic, counts[topic], stated,
            )  # fmt: skip


def _check_stamps(recording: Recording, topic: str, stamps_ns: Sequence[int | None]) -> None:
    """Refuse images that nobody stamped."""
    known = [stamp for stamp in stamps_ns if stamp is not None]
    if len(known) >= MIN_STAMPS and len(set(known)) == 1:
        raise DatasetError(
            f'{recording.path}: all {len(known)} stamps on {topic} are equal ({stamp_text(known[0])} s): {remarks.NOT_STAMPED}'
        )


def _changes(cameras: Sequence[StampedCamera]) -> list[StampedCamera]:
    return [
        camera for before, camera in zip([None, *cameras], cameras, strict=False)
        if before is None or before.calibration != camera.calibration
    ]  # fmt: skip


def _trajectory(poses_by_stamp: Mapping[int, NDArray[np.float64]]) -> Trajectory | None:
    if not poses_by_stamp:
        return None
    stamps = sorted(poses_by_stamp)
    return Trajectory(np.array(stamps, np.int64), np.stack([poses_by_stamp[stamp] for stamp in stamps]))
