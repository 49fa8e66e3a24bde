"""Writes a sequence as a rosbag2; ``splatam_core.datasets.convert`` says what is in it."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import StoragePlugin, Writer

from msg_adapters import camera_info, images, poses
from msg_adapters.encodings import DepthEncoding
from msg_adapters.factory import RosbagsMessages
from splatam_core.datasets.bag.topics import DEPTH_TOPIC, GROUND_TRUTH_TOPIC, INFO_TOPIC, RGB_TOPIC
from splatam_core.datasets.bag.typestore import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE, POSE_STAMPED, ros2_types, serialize
from splatam_core.datasets.base import Sequence, frame_or_none
from splatam_core.errors import FrameError, SplatamError
from splatam_core.types import RgbdFrame

COMPRESSED_RGB_TOPIC, COMPRESSED_DEPTH_TOPIC = f'{RGB_TOPIC}/compressed', f'{DEPTH_TOPIC}/compressedDepth'
CAMERA_FRAME, WORLD_FRAME = 'camera_optical_frame', 'world'
MILLIMETRES = 1000.0

_log = logging.getLogger(__name__)

RELIABLE = Qos(
    history=QosHistory.KEEP_LAST,
    depth=10,
    reliability=QosReliability.RELIABLE,
    durability=QosDurability.VOLATILE,
    deadline=QosTime(0, 0),
    lifespan=QosTime(0, 0),
    liveliness=QosLiveliness.SYSTEM_DEFAULT,
    liveliness_lease_duration=QosTime(0, 0),
    avoid_ros_namespace_conventions=False,
)
"""The QoS recorded for every topic; players offer the same."""


def write(sequence: Sequence, folder: Path, storage: str, compressed: bool, indices: Iterable[int]) -> None:
    """Write frames of a sequence into a new rosbag2 folder.

    Args:
        sequence: what to write.
        folder: must not exist.
        storage: ``sqlite3`` or ``mcap``.
        compressed: True to write JPEG and PNG instead of raw images.
        indices: which frames to write, in order.
    """
    raw_types = {RGB_TOPIC: IMAGE, DEPTH_TOPIC: IMAGE}
    compressed_types = {COMPRESSED_RGB_TOPIC: COMPRESSED_IMAGE, COMPRESSED_DEPTH_TOPIC: COMPRESSED_IMAGE}
    types = {INFO_TOPIC: CAMERA_INFO, **(compressed_types if compressed else raw_types)}
    ground_truth = _covering(sequence)
    if ground_truth:
        types[GROUND_TRUTH_TOPIC] = POSE_STAMPED
    with Writer(folder, version=9, storage_plugin=StoragePlugin[storage.upper()]) as writer:
        connections = {
            topic: writer.add_connection(topic, type_name, typestore=ros2_types(), offered_qos_profiles=[RELIABLE])
            for topic, type_name in types.items()
        }
        for topic, stamp_ns, message in _messages(sequence, ground_truth, compressed, indices):
            writer.write(connections[topic], stamp_ns, serialize(message, types[topic]))


def _messages(
    sequence: Sequence, ground_truth: list[tuple[int, NDArray[np.float64]]], compressed: bool, indices: Iterable[int]
) -> Iterator[tuple[str, int, Any]]:
    """Iterate over (topic, stamp, message) in order of the stamps."""
    factory = RosbagsMessages(ros2_types())
    pending = list(reversed(ground_truth))
    encoding: DepthEncoding = '16UC1' if sequence.depth_scale == MILLIMETRES else '32FC1'
    frame_messages = _compressed_messages if compressed else _raw_messages
    for index in indices:
        try:
            frame = sequence[index]
        except FrameError as error:
            _log.warning('frame %d is left out: %s', index, error)
            continue
        while pending and pending[-1][0] <= frame.stamp_ns:
            yield _pose_message(factory, *pending.pop())
        yield INFO_TOPIC, frame.stamp_ns, camera_info.info_message(factory, _parameters(frame), frame.stamp_ns)
        for topic, message in frame_messages(factory, frame, encoding):
            yield topic, frame.stamp_ns, message
    while pending:
        yield _pose_message(factory, *pending.pop())


def _pose_message(factory: RosbagsMessages, stamp_ns: int, T: NDArray[np.float64]) -> tuple[str, int, Any]:
    return GROUND_TRUTH_TOPIC, stamp_ns, poses.pose_stamped(factory, T, stamp_ns, WORLD_FRAME)


def _raw_messages(factory: RosbagsMessages, frame: RgbdFrame, encoding: DepthEncoding) -> Iterator[tuple[str, Any]]:
    where = (frame.stamp_ns, CAMERA_FRAME)
    yield RGB_TOPIC, images.color_message(factory, frame.rgb, *where)
    yield DEPTH_TOPIC, images.depth_message(factory, frame.depth_m, *where, encoding=encoding)


def _compressed_messages(factory: RosbagsMessages, frame: RgbdFrame, encoding: DepthEncoding) -> Iterator[tuple[str, Any]]:
    where = (frame.stamp_ns, CAMERA_FRAME)
    yield COMPRESSED_RGB_TOPIC, images.compressed_color_message(factory, frame.rgb, *where)
    yield COMPRESSED_DEPTH_TOPIC, images.compressed_depth_message(factory, frame.depth_m, *where, encoding=encoding)


def _parameters(frame: RgbdFrame) -> camera_info.CameraParameters:
    c = frame.camera
    return camera_info.CameraParameters(
        width=c.width, height=c.height, fx=c.fx, fy=c.fy, cx=c.cx, cy=c.cy, frame_id=CAMERA_FRAME,
    )  # fmt: skip


def _covering(sequence: Sequence) -> list[tuple[int, NDArray[np.float64]]]:
    """The true poses from the last one before the first frame to the first one after the last frame.

    Between these, the pose of every frame can be interpolated.
    """
    try:
        ground_truth = sequence.ground_truth()
    except SplatamError as error:
        _log.warning('the ground truth is left out: %s', error)
        return []
    if ground_truth is None:
        return []
    stamps_ns = ground_truth.stamps_ns
    first, last = (_first_readable(sequence, indices) for indices in (range(len(sequence)), reversed(range(len(sequence)))))
    if first is None or last is None:
        return []
    first_ns, last_ns = first.stamp_ns, last.stamp_ns
    start = max(int(np.searchsorted(stamps_ns, first_ns, side='right')) - 1, 0)
    stop = int(np.searchsorted(stamps_ns, last_ns, side='left')) + 1
    return [(int(stamp), T) for stamp, T in zip(stamps_ns[start:stop], ground_truth.T_world_cam[start:stop], strict=True)]


def _first_readable(sequence: Sequence, indices: Iterable[int]) -> RgbdFrame | None:
    return next((frame for index in indices if (frame := frame_or_none(sequence, index)) is not None), None)
