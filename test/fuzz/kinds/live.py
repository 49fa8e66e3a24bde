"""Live input: whatever arrives on the topics, in whatever order, costs at most its own frame and one expected warning."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import SimpleNamespace as Message
from typing import Any

import numpy as np
from hypothesis import strategies as st

from kinds.base import OWN_ERRORS, Case, Kind, Tally
from kinds.messages import FLOAT, HEADER, INFO, compressed_images, raw_images
from msg_adapters.errors import MessageError
from splatam_core.types import RgbdFrame
from splatam_ros.frames.buffer import TransformBuffer, TransformError

SECOND = 10**9
STAMP_NS = st.one_of(
    st.integers(0, 60).map(lambda i: i * 33_000_000),
    st.sampled_from([0, 1, -SECOND, 2**31 * SECOND - 1, -(2**31) * SECOND, 3600 * SECOND]),
    st.integers(-(2**31) * SECOND, 2**31 * SECOND - 1),
)
OPTIONS = st.fixed_dictionaries(
    {},
    optional={
        'width': st.sampled_from([0, 16, 40]), 'undistort': st.booleans(), 'sync.mode': st.sampled_from(['exact', 'approximate']),
        'sync.max_interval': st.sampled_from([0.0, 1e-9, 10.0]), 'sync.queue_size': st.sampled_from([1, 2, 1000]),
        'time_jump_threshold': st.sampled_from([0.0, 3600.0]), 'depth_scale': st.sampled_from([1e-6, 1.0]),
        'rgb_encoding': st.sampled_from(['bgr8', 'rgb8']), 'max_rate_hz': st.sampled_from([1e-3, 30.0, 1000.0]),
    },
)  # fmt: skip


class FailingWarnings:
    """Takes the warnings of the node. One about an error that is not the project's own is a finding."""

    num_refused = 0

    def warn(self, kind: str, text: str) -> None:
        self.num_refused += 'skipped' in text or 'ignored' in text
        assert text and '\n' not in text and len(text) < 3000, f'not one line: {text!r}'

    def warn_of(self, kind: str, what: str, error: Exception) -> None:
        if not isinstance(error, OWN_ERRORS):
            raise error
        self.warn(kind, f'{what}: {error}')


def header_at(stamp_ns: int) -> Message:
    sec, nanosec = divmod(stamp_ns, SECOND)
    return Message(stamp=Message(sec=sec, nanosec=nanosec), frame_id='camera')


def fitting(kind: str, stamp_ns: int, fill: int, width: int = 24, height: int = 16) -> Message:
    """A message that belongs to a camera of 24x16 pixels."""
    header = header_at(stamp_ns)
    if kind == 'info':
        k = [20.0, 0.0, 11.5, 0.0, 20.0, 7.5, 0.0, 0.0, 1.0]
        return Message(
            header=header, width=width, height=height, distortion_model='plumb_bob', d=[0.0, fill / 1e3, 0.0, 0.0, 0.0], k=k,
            p=[*k[:3], 0.0, *k[3:6], 0.0, *k[6:], 0.0], binning_x=0, binning_y=0,
            roi=Message(x_offset=0, y_offset=0, width=0, height=0, do_rectify=False),
        )  # fmt: skip
    encoding, channels = ('rgb8', 3) if kind == 'color' else ('16UC1', 2)
    data = np.full(width * height * channels, fill, np.uint8)
    return Message(header=header, width=width, height=height, encoding=encoding, step=width * channels, is_bigendian=0, data=data)


@st.composite
def events(draw: st.DrawFn) -> tuple[str, Message]:
    """A topic and a message, which fits it more often than not."""
    kind = draw(st.sampled_from(['info', 'color', 'depth']))
    if draw(st.integers(0, 4)):
        return kind, fitting(kind, draw(STAMP_NS), draw(st.sampled_from([0, 1, 255])))
    message = draw(INFO if kind == 'info' else raw_images() | compressed_images())
    if draw(st.booleans()):
        message.header = header_at(draw(STAMP_NS))
    return kind, message


def check_intake(tally: Tally, value: tuple[dict[str, Any], list[tuple[str, Message]]]) -> None:
    from splatam_ros.node.frame_assembler import FrameAssembler
    from splatam_ros.node.gate import FrameGate
    from splatam_ros.node.parameters import node_options

    options, messages = value
    warnings = FailingWarnings()
    assembler = FrameAssembler(
        node_options(options), warnings, FrameGate(options.get('max_rate_hz', 0.0)), on_rejected=lambda stamp_ns: None
    )
    frames: list[RgbdFrame] = []
    for kind, message in messages:
        add = partial(getattr(assembler, f'add_{kind}'), message)
        tally.attempt(partial(received, add, frames, warnings), MessageError)
        tally.end_input()
    frames += assembler.flush()
    assembler.report_drops()
    for frame in frames:
        size = frame.camera.height, frame.camera.width
        assert frame.rgb.shape == (*size, 3) and frame.rgb.dtype == np.uint8
        assert frame.depth_m.shape == size and frame.depth_m.dtype == np.float32
        assert (np.isfinite(frame.depth_m) & (frame.depth_m >= 0)).all()
    for before, after in itertools.pairwise(frames):
        assert after.epoch > before.epoch or after.stamp_ns > before.stamp_ns


def received(add: Callable[[], list[RgbdFrame]], frames: list[RgbdFrame], warnings: FailingWarnings) -> None:
    """Passes a message on. One about which the node warns is refused."""
    before = warnings.num_refused
    frames += add()
    if warnings.num_refused > before:
        raise MessageError('the node has warned')


@dataclass
class NoNode:
    """Stands for the node of ROS where topics are made that nothing is sent on."""

    def create_subscription(self, *arguments: Any) -> None:
        """Subscribe to nothing."""

    def create_publisher(self, *arguments: Any) -> None:
        """Advertise nothing."""


FRAME_NAMES = st.sampled_from(['map', 'odom', '/odom', 'base', 'camera', '', 'a' * 300])
TRANSFORM = st.builds(
    lambda header, parent, child, values: Message(
        header=Message(stamp=header.stamp, frame_id=parent), child_frame_id=child,
        transform=Message(translation=Message(**dict(zip('xyz', values))), rotation=Message(**dict(zip('xyzw', values[3:])))),
    ),
    HEADER, FRAME_NAMES, FRAME_NAMES,
    st.one_of(st.just([0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0]), st.lists(FLOAT, min_size=7, max_size=7)),
)  # fmt: skip


def check_transforms(tally: Tally, value: list[tuple[bool, Message, int]]) -> None:
    from splatam_ros.frames.options import FrameOptions
    from splatam_ros.frames.tf_topics import TfTopics

    buffer = TransformBuffer()
    options = FrameOptions('map', 'odom', 'base', 'camera', '', 'optical', publish_tf=False, odom_source='tf', odom_max_wait_s=0.0)
    warnings = FailingWarnings()
    topics = TfTopics(NoNode(), options, buffer, warnings)
    for is_static, transform, stamp_ns in value:
        receive = topics._receive_static if is_static else topics._receive_moving
        tally.attempt(partial(received, lambda: receive(Message(transforms=[transform])) or [], [], warnings), MessageError)  # noqa: B023
        T = tally.attempt(partial(buffer.lookup, 'odom', 'base', stamp_ns), TransformError)
        assert T is None or np.isfinite(T).all()
        tally.end_input()


def cases(folder: Path) -> list[Case]:
    return [
        Case('intake', st.tuples(OPTIONS, st.lists(events(), min_size=1, max_size=20)), check_intake),
        Case(
            'transforms',
            st.lists(st.tuples(st.booleans(), TRANSFORM, STAMP_NS), min_size=1, max_size=8),
            check_transforms, short=20,
        ),
    ]  # fmt: skip


KIND = Kind('live junk', 17_000, cases, needs='rclpy')
