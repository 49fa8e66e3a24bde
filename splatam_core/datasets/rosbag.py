"""ROS bags: a rosbag2 folder with ``metadata.yaml``, one ``.db3`` or ``.mcap`` file, or a ROS 1 ``.bag`` file.

::

    my_bag/                                 my_recording.bag        # ROS 1
        metadata.yaml                       camera.yaml
        my_bag_0.db3  or  my_bag_0.mcap
        camera.yaml             # may be missing; wins over the bag's CameraInfo

Topics are found by type, those with messages only:

- colour: ``sensor_msgs/Image`` or ``CompressedImage``;
- depth, registered to colour: the same types, told apart by encoding (16UC1 and mono16 in
  millimetres, 32FC1 in metres, compressedDepth), and for other compressed images by ``depth`` in the
  topic's name;
- camera: ``sensor_msgs/CameraInfo``; of several, the one beside the colour image;
- truth: ``geometry_msgs/PoseStamped`` on ``/ground_truth/pose``, may be missing.

Colour and depth are paired by header stamps, as the node pairs them: nearest in time, at most 20 ms
apart. Only stamps are kept in memory; images are read from the file when a frame is asked for.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags import rosbag1
from rosbags.interfaces import Connection, Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from msg_adapters import camera_info, images, poses
from msg_adapters.errors import MessageError
from msg_adapters.factory import RosbagsMessages
from msg_adapters.synchronizer import RgbdSet, RgbdSynchronizer
from splatam_core.datasets import base, files
from splatam_core.datasets.camera_file import CameraFile
from splatam_core.errors import CameraError, DatasetError, FrameError, SplatamError
from splatam_core.geometry.camera import CameraCalibration
from splatam_core.geometry.trajectory import Trajectory, stamp_text
from splatam_core.images.rectification import FrameFactory
from splatam_core.types import RgbdFrame

IMAGE = 'sensor_msgs/msg/Image'
COMPRESSED = 'sensor_msgs/msg/CompressedImage'
INFO = 'sensor_msgs/msg/CameraInfo'
POSE = 'geometry_msgs/msg/PoseStamped'

RGB_TOPIC, DEPTH_TOPIC, INFO_TOPIC, TRUTH_TOPIC = '/rgb/image', '/depth/image', '/rgb/camera_info', '/ground_truth/pose'
CAMERA_FRAME, WORLD_FRAME = 'camera_optical_frame', 'world'

ROS1_SUFFIX = '.bag'
MAX_INTERVAL_NS = 20_000_000
QUEUE_SIZE = 300  # ten seconds of one stream before the other begins
JUMP_NS = 1_000_000_000
MILLIMETRES = 1000.0
DEPTH_ENCODINGS = ('16UC1', 'mono16', '32FC1')
RELIABLE = Qos(
    QosHistory.KEEP_LAST, 10, QosReliability.RELIABLE, QosDurability.VOLATILE, QosTime(0, 0), QosTime(0, 0),
    QosLiveliness.SYSTEM_DEFAULT, QosTime(0, 0), False,
)  # fmt: skip
"""What written topics say they were offered with; players offer the same."""

_log = logging.getLogger(__name__)


class BagSequence:
    """A bag; see the module's text for what is found in it."""

    def __init__(self, path: Path, *, width: int | None = None, topics: base.BagTopics | None = None) -> None:
        """Find the topics of a bag and pair its images.

        Raises:
            DatasetError: the bag is broken or empty, a topic is missing or not the only one, nothing pairs up,
                the camera changes, or time runs backwards.
            CameraError: the camera cannot be used.
        """
        bag = _Bag(path)
        stated = files.camera_file(path if path.is_dir() else path.parent)
        chosen = _choose_topics(bag, topics or base.BagTopics(), need_info=stated is None)
        index = _Index.of(bag, chosen)
        self._frames = FrameFactory(stated.calibration if stated else _calibration(bag, index), width)
        self._pairs = _pairs(bag, chosen, index)
        self._truth = index.truth
        self._color, self._depth = (_Stream(bag, chosen[kind], index.recorded_ns(kind)) for kind in ('rgb', 'depth'))
        self.depth_scale = _depth_scale(bag, chosen['depth'], stated)
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
        if self.depth_scale not in (None, MILLIMETRES):
            depth_m = depth_m * np.float32(MILLIMETRES / self.depth_scale)  # decoded as millimetres, as ROS has it
        return self._frames.make(pair.stamp_ns, rgb, depth_m)

    def ground_truth(self) -> Trajectory | None:
        """The poses on ``/ground_truth/pose``; None where there are none."""
        return self._truth


# --- reading ---


class _Bag:
    """What is in a bag: its topics, and their messages from any time on."""

    def __init__(self, path: Path) -> None:
        _check_closed(path)
        self.path = path
        self.is_ros1 = path.suffix == ROS1_SUFFIX
        self._encodings: dict[str, str] = {}
        with _reading(path), self._open() as reader:
            self.connections = [connection._replace(owner=None) for connection in reader.connections if connection.msgcount]
        if not self.connections:
            raise DatasetError(f'{path}: the bag is empty: there is no message on any topic; was anything recorded?')

    def topics(self, *types: str) -> list[str]:
        """Topics of some types that have messages."""
        return sorted({connection.topic for connection in self.connections if connection.msgtype in types})

    def type_of(self, topic: str) -> str:
        """The type of a topic's messages."""
        return next(connection.msgtype for connection in self.connections if connection.topic == topic)

    def count(self, topic: str) -> int:
        """How many messages a topic should have."""
        return sum(connection.msgcount for connection in self.connections if connection.topic == topic)

    def messages(self, topics: Iterable[str], start_ns: int | None = None) -> Iterator[tuple[str, int, bytes]]:
        """(topic, time of recording, serialized message), from a time of recording on."""
        wanted = set(topics)
        with _reading(self.path), self._open() as reader:
            connections = [connection for connection in reader.connections if connection.topic in wanted]
            for connection, recorded_ns, data in reader.messages(connections, start=start_ns):
                yield connection.topic, recorded_ns, data

    def encoding(self, topic: str) -> str:
        """How the first image on a topic is encoded: its encoding, or a compressed image's format."""
        if topic not in self._encodings:
            first = next(self.messages([topic]), None)
            if first is None:
                raise DatasetError(f'{self.path}: {topic} has no messages, though the bag states some; is it complete?')
            message = self.decode(topic, first[2])
            self._encodings[topic] = message.encoding if self.type_of(topic) == IMAGE else message.format
        return self._encodings[topic]

    def decode(self, topic: str, data: bytes) -> Any:
        """A message as rosbags' object of its type in ROS 2."""
        type_name = self.type_of(topic)
        with _reading(self.path):
            if not self.is_ros1:
                return _types().deserialize_cdr(data, type_name)
            message = _types(Stores.ROS1_NOETIC).deserialize_ros1(data, type_name)
            return _ros2_info(message) if type_name == INFO else message

    def stamp_ns(self, topic: str, data: bytes) -> int:
        """The header's stamp; a header is the first field of every type read here."""
        if len(data) < 12:
            raise DatasetError(f'{self.path}: a message on {topic} has {len(data)} bytes, too few for a header')
        if self.is_ros1:
            form = '<II'  # after the header's sequence number
        else:
            form = '<iI' if data[1] & 1 else '>iI'  # after four bytes that say how CDR is encoded
        seconds, nanoseconds = struct.unpack_from(form, data, 4)
        return seconds * 1_000_000_000 + nanoseconds

    def _open(self) -> rosbag1.Reader | Reader:
        return (rosbag1.Reader if self.is_ros1 else Reader)(self.path)


class _Stream:
    """The messages of one topic by their number. Reading on is fast, reading elsewhere starts anew."""

    LOOK_AHEAD = 8

    def __init__(self, bag: _Bag, topic: str, recorded_ns: NDArray[np.int64]) -> None:
        self._bag, self._topic, self._recorded_ns = bag, topic, recorded_ns
        self._cursor: Iterator[tuple[int, bytes]] = iter(())

    def __getitem__(self, number: int) -> Any:
        data = self._search(number, self.LOOK_AHEAD)
        if data is None:
            self._cursor = self._read_from(number)
            data = self._search(number, None)
        if data is None:
            raise DatasetError(f'{self._bag.path}: message {number} of {self._topic} is gone; did the file change?')
        return self._bag.decode(self._topic, data)

    def _search(self, number: int, at_most: int | None) -> bytes | None:
        for position, data in islice(self._cursor, at_most):
            if position >= number:
                return data if position == number else None
        return None

    def _read_from(self, number: int) -> Iterator[tuple[int, bytes]]:
        """From the time of a message on; several may have that time, and split bags may overlap."""
        start_ns = int(self._recorded_ns[number])
        for position, (_, _, data) in zip(
            np.flatnonzero(self._recorded_ns >= start_ns), self._bag.messages([self._topic], start_ns), strict=False
        ):
            yield int(position), data


@dataclass(frozen=True)
class _Entry:
    """One colour or depth message: which it is, when it was recorded, and its header's stamp."""

    kind: str
    recorded_ns: int
    stamp_ns: int


@dataclass(frozen=True)
class _Index:
    """What one pass over a bag finds out.

    Attributes:
        entries: colour and depth messages in the order of the bag.
        infos: the first camera info of each different camera, with its stamp.
        truth: the true poses, if any.
    """

    entries: list[_Entry]
    infos: dict[CameraCalibration, int]
    truth: Trajectory | None

    def recorded_ns(self, kind: str) -> NDArray[np.int64]:
        """Times of recording of the messages of a kind."""
        return np.array([entry.recorded_ns for entry in self.entries if entry.kind == kind], np.int64)

    @classmethod
    def of(cls, bag: _Bag, chosen: dict[str, str]) -> _Index:
        """Read a bag once.

        Raises:
            DatasetError: messages are missing or unreadable.
            CameraError: a camera info cannot be used.
        """
        kinds = {topic: kind for kind, topic in chosen.items()}
        counts = dict.fromkeys(kinds, 0)
        entries: list[_Entry] = []
        infos: dict[CameraCalibration, int] = {}
        truth: dict[int, NDArray[np.float64]] = {}
        for topic, recorded_ns, data in bag.messages(kinds):
            counts[topic] += 1
            stamp_ns = bag.stamp_ns(topic, data)
            if kinds[topic] == 'info':
                infos.setdefault(_calibration_of(bag, topic, data), stamp_ns)
            elif kinds[topic] == 'truth':
                truth[stamp_ns] = _pose_of(bag, topic, data)
            else:
                entries.append(_Entry(kinds[topic], recorded_ns, stamp_ns))
        _check_complete(bag, counts)
        return cls(entries, infos, _trajectory(truth))


def _check_closed(path: Path) -> None:
    """A folder without its metadata is a recording that was interrupted."""
    if not path.is_dir() or (path / 'metadata.yaml').exists():
        return
    storages = sorted(file.name for suffix in ('db3', 'mcap') for file in path.glob(f'*.{suffix}'))
    if storages:
        raise DatasetError(
            f'{path}: there is no metadata.yaml, the recording was not closed; run "ros2 bag reindex {path.name}" '
            f'or open {storages[0]} itself'
        )


def _check_complete(bag: _Bag, counts: dict[str, int]) -> None:
    for topic, count in counts.items():
        if count != bag.count(topic):
            raise DatasetError(
                f'{bag.path}: {topic} has {count} messages of the {bag.count(topic)} that the bag states; is the copy complete?'
            )


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Whatever the storage libraries raise inside means a broken bag: one error that says so."""
    try:
        yield
    except SplatamError:
        raise
    except Exception as error:  # broken files surface as any of a dozen types, assertions included
        kind = 'a ROS 1 bag' if path.suffix == ROS1_SUFFIX else 'a rosbag2'
        reason = ' '.join(str(error).split()) or type(error).__name__
        raise DatasetError(f'{path}: cannot be read as {kind}, it may be truncated: {reason}') from error


@lru_cache(maxsize=2)
def _types(store: Stores = Stores.ROS2_JAZZY) -> Typestore:
    return get_typestore(store)


def _ros2_info(info: Any) -> Any:
    """A ROS 1 CameraInfo, whose matrices have capital names, as ROS 2 has it."""
    return _types().types[INFO](**{field.name.lower(): getattr(info, field.name) for field in fields(info) if field.init})


def _calibration_of(bag: _Bag, topic: str, data: bytes) -> CameraCalibration:
    try:
        return CameraCalibration.from_intrinsics(camera_info.parameters(bag.decode(topic, data)))
    except (MessageError, CameraError) as error:
        raise CameraError(f'{bag.path}: {topic}: {error}') from None


def _pose_of(bag: _Bag, topic: str, data: bytes) -> NDArray[np.float64]:
    try:
        return poses.pose_matrix(bag.decode(topic, data).pose)
    except MessageError as error:
        raise DatasetError(f'{bag.path}: {topic}: {error}') from None


def _trajectory(poses_by_stamp: dict[int, NDArray[np.float64]]) -> Trajectory | None:
    if not poses_by_stamp:
        return None
    stamps = sorted(poses_by_stamp)
    return Trajectory(np.array(stamps, np.int64), np.stack([poses_by_stamp[stamp] for stamp in stamps]))


def _calibration(bag: _Bag, index: _Index) -> CameraCalibration:
    """The one camera of a bag."""
    if len(index.infos) > 1:
        (first, _), (second, stamp_ns) = list(index.infos.items())[:2]
        raise DatasetError(
            f'{bag.path}: the camera changes at {stamp_text(stamp_ns)} s from {first} to {second}; all frames must '
            'come from one: cut the bag there, or state one camera in a camera.yaml beside it'
        )
    return next(iter(index.infos))


def _pairs(bag: _Bag, chosen: dict[str, str], index: _Index) -> list[RgbdSet]:
    """Colour and depth messages, by their numbers, that belong together."""
    pairing = RgbdSynchronizer(mode='approximate', max_interval_ns=MAX_INTERVAL_NS, queue_size=QUEUE_SIZE, jump_ns=JUMP_NS)
    pairing.add_info(index.entries[0].stamp_ns if index.entries else 0, None)  # one camera, known beforehand
    counts = {'rgb': 0, 'depth': 0}
    add = {'rgb': pairing.add_color, 'depth': pairing.add_depth}
    pairs: list[RgbdSet] = []
    for entry in index.entries:
        pairs += add[entry.kind](entry.stamp_ns, counts[entry.kind])
        counts[entry.kind] += 1
    pairs += pairing.flush()
    if not pairs:
        raise DatasetError(
            f'{bag.path}: none of {counts["rgb"]} images on {chosen["rgb"]} and {counts["depth"]} on '
            f'{chosen["depth"]} are within {MAX_INTERVAL_NS / 1e6:g} ms of each other by their header stamps'
        )
    if len(pairs) < counts['rgb']:
        _log.warning('%s: %d of %d colour images have no depth', bag.path, counts['rgb'] - len(pairs), counts['rgb'])
    base.check_increasing(np.array([pair.stamp_ns for pair in pairs], np.int64), str(bag.path))
    return pairs


def _depth_scale(bag: _Bag, topic: str, stated: CameraFile | None) -> float | None:
    """Counts per metre of 16-bit depth; None for depth in metres."""
    if '32FC1' in bag.encoding(topic):
        return None
    return (stated.depth_scale if stated else None) or MILLIMETRES


# --- choosing topics ---


def _choose_topics(bag: _Bag, wanted: base.BagTopics, *, need_info: bool) -> dict[str, str]:
    """Topic of each kind: rgb, depth, info where it is needed, truth where there is one."""
    kinds = {topic: _kind(bag, topic) for topic in bag.topics(IMAGE, COMPRESSED)}
    found = {kind: [topic for topic in kinds if kinds[topic] == kind] for kind in ('rgb', 'depth')}
    chosen = {'rgb': _choose(bag, 'colour image', '--rgb', wanted.rgb, found['rgb'], list(kinds))}
    others = [topic for topic in kinds if topic != chosen['rgb']]
    chosen['depth'] = _choose(bag, 'depth image', '--depth', wanted.depth, found['depth'], others)
    if need_info:
        infos = bag.topics(INFO)
        beside = [topic for topic in infos if _namespace(topic) == _namespace(chosen['rgb'])]
        chosen['info'] = _choose(bag, 'camera info', '--info', wanted.info, beside or infos, infos)
    if TRUTH_TOPIC in bag.topics(POSE):
        chosen['truth'] = TRUTH_TOPIC
    return chosen


def _choose(bag: _Bag, what: str, option: str, wanted: str | None, fitting: list[str], allowed: list[str]) -> str:
    """The wanted topic, else the only one that fits."""
    if wanted is not None:
        if wanted not in allowed:
            raise DatasetError(f"{bag.path}: {option} '{wanted}' is no {what} topic with messages; there is {_listed(allowed)}")
        return wanted
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        raise DatasetError(
            f'{bag.path}: several topics could be the {what}: {_listed(fitting)}; '
            f'choose with {option} (--rgb, --depth and --info choose topics)'
        )
    every = _listed(f'{connection.topic} ({connection.msgtype})' for connection in bag.connections)
    raise DatasetError(f'{bag.path}: there is no {what} topic with messages; the bag holds {every}')


def _listed(names: Iterable[str]) -> str:
    return ', '.join(names) or 'none'


def _kind(bag: _Bag, topic: str) -> str:
    encoding = bag.encoding(topic)
    if bag.type_of(topic) == IMAGE:
        return 'depth' if encoding in DEPTH_ENCODINGS else 'rgb'
    is_depth = 'compressedDepth' in encoding or encoding.startswith(DEPTH_ENCODINGS) or 'depth' in topic.lower()
    return 'depth' if is_depth else 'rgb'


def _namespace(topic: str) -> str:
    """Where the topic's camera info is by ROS custom; a compressed image lies one level below its raw one."""
    return topic.removesuffix('/compressed').removesuffix('/compressedDepth').rpartition('/')[0]


# --- writing ---


@dataclass(frozen=True)
class _Topic:
    """A topic that is written."""

    name: str
    type: str


def write(sequence: base.Sequence, folder: Path, storage: str, compressed: bool, indices: Iterable[int]) -> None:
    """Write a recording into a new rosbag2 folder; ``convert.write_bag`` says what is in it."""
    suffixes = ('/compressed', '/compressedDepth') if compressed else ('', '')
    image_type = COMPRESSED if compressed else IMAGE
    topics = {
        'info': _Topic(INFO_TOPIC, INFO),
        'rgb': _Topic(RGB_TOPIC + suffixes[0], image_type),
        'depth': _Topic(DEPTH_TOPIC + suffixes[1], image_type),
    }
    truth = _covering(sequence)
    if truth:
        topics['truth'] = _Topic(TRUTH_TOPIC, POSE)
    with Writer(folder, version=9, storage_plugin=StoragePlugin[storage.upper()]) as writer:
        connections = {
            kind: writer.add_connection(topic.name, topic.type, typestore=_types(), offered_qos_profiles=[RELIABLE])
            for kind, topic in topics.items()
        }
        for kind, stamp_ns, message in _messages_of(sequence, truth, compressed, indices):
            _write_message(writer, connections[kind], stamp_ns, message)


def _write_message(writer: Writer, connection: Connection, stamp_ns: int, message: Any) -> None:
    writer.write(connection, stamp_ns, _types().serialize_cdr(message, connection.msgtype))


def _messages_of(
    sequence: base.Sequence, truth: list[tuple[int, NDArray[np.float64]]], compressed: bool, indices: Iterable[int]
) -> Iterator[tuple[str, int, Any]]:
    """(kind, stamp, message) in the order of the stamps."""
    factory = RosbagsMessages(_types())
    pending = list(reversed(truth))
    for index in indices:
        frame = sequence[index]
        while pending and pending[-1][0] <= frame.stamp_ns:
            stamp_ns, T = pending.pop()
            yield 'truth', stamp_ns, poses.pose_stamped(factory, T, stamp_ns, WORLD_FRAME)
        yield from _frame_messages(factory, frame, sequence.depth_scale == MILLIMETRES, compressed)
    while pending:
        stamp_ns, T = pending.pop()
        yield 'truth', stamp_ns, poses.pose_stamped(factory, T, stamp_ns, WORLD_FRAME)


def _frame_messages(
    factory: RosbagsMessages, frame: RgbdFrame, in_millimetres: bool, compressed: bool
) -> Iterator[tuple[str, int, Any]]:
    where = (frame.stamp_ns, CAMERA_FRAME)
    encoding = '16UC1' if in_millimetres else '32FC1'
    color, depth = (
        (images.compressed_color_message, images.compressed_depth_message)
        if compressed
        else (images.color_message, images.depth_message)
    )
    yield 'info', frame.stamp_ns, camera_info.info_message(factory, _parameters(frame), frame.stamp_ns)
    yield 'rgb', frame.stamp_ns, color(factory, frame.rgb, *where)
    yield 'depth', frame.stamp_ns, depth(factory, frame.depth_m, *where, encoding=encoding)


def _parameters(frame: RgbdFrame) -> camera_info.CameraParameters:
    c = frame.camera
    return camera_info.CameraParameters(c.width, c.height, c.fx, c.fy, c.cx, c.cy, 'none', (), CAMERA_FRAME)


def _covering(sequence: base.Sequence) -> list[tuple[int, NDArray[np.float64]]]:
    """The truth from the pose before the first frame to the one after the last: all that can be interpolated."""
    truth = sequence.ground_truth()
    if truth is None:
        return []
    first_ns, last_ns = sequence[0].stamp_ns, sequence[len(sequence) - 1].stamp_ns
    start = max(int(np.searchsorted(truth.stamps_ns, first_ns, side='right')) - 1, 0)
    stop = int(np.searchsorted(truth.stamps_ns, last_ns, side='left')) + 1
    return [(int(stamp), T) for stamp, T in zip(truth.stamps_ns[start:stop], truth.T_world_cam[start:stop])]


def _recognises(source: str) -> bool:
    path = Path(source)
    if path.is_dir():
        return (path / 'metadata.yaml').is_file() or any(any(path.glob(f'*.{suffix}')) for suffix in ('db3', 'mcap'))
    return path.suffix in ('.db3', '.mcap', ROS1_SUFFIX) and path.is_file()


def _open(source: str, options: base.ReadOptions) -> BagSequence:
    return BagSequence(Path(source), width=options.width, topics=options.topics)


FORMAT = base.Format(
    'rosbag', 'a rosbag2 folder with metadata.yaml, a .db3 or .mcap file, or a ROS 1 .bag file', _recognises, _open,
    has_topics=True,
)  # fmt: skip
