"""``/diagnostics``: once a second, what the node gets, does and gives; read by rqt_robot_monitor and by robots.

Each report is made of two samples of the node's counters, a second apart; rates are over that second.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from msg_adapters import stamps
from msg_adapters.factory import MessageFactory, RclpyMessages
from splatam_core.types import FrameResult, Status
from splatam_ros.player.recording import message_class

OK, WARN, ERROR = b'\x00', b'\x01', b'\x02'
TYPE_NAME = 'diagnostic_msgs/msg/DiagnosticArray'
PERIOD_S = 1.0
QOS_DEPTH = 10


@dataclass(frozen=True, slots=True)
class InputSample:
    """Of one subscription.

    Attributes:
        topic: as resolved.
        received: messages since the start.
        publishers: on the graph.
        delay_s: from the newest message's stamp to its arrival; None before the first.
    """

    topic: str
    received: int
    publishers: int
    delay_s: float | None


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """The node's counters at one moment.

    Attributes:
        monotonic_s: when.
        inputs: subscriptions.
        unpaired: images dropped without ever becoming a frame.
        waiting_frames: frames that wait for SLAM.
        dropped_frames: frames let go because SLAM was busy.
        refused_frames: frames that could not be used.
        frames: by what became of them.
        poses: published.
        delay_s: from the newest pose's stamp to its publication; None before the first.
        result: of the newest frame; None before the first.
        rss_mb: memory of the process; None where it is not known.
        trouble: why no frames come; empty where they do.
    """

    monotonic_s: float
    inputs: Sequence[InputSample]
    unpaired: int
    waiting_frames: int
    dropped_frames: int
    refused_frames: int
    frames: Mapping[Status, int]
    poses: int
    delay_s: float | None
    result: FrameResult | None
    rss_mb: float | None
    trouble: str


class Monitor:
    """Publishes ``/diagnostics`` by the steady clock, so also while sim time stands still."""

    def __init__(self, node: Node, sample: Callable[[], Sample], camera_frame: Callable[[], str]) -> None:
        """Start.

        Args:
            node: to publish with.
            sample: takes a sample of the node's counters.
            camera_frame: gives the name of the camera's frame, the hardware id; empty before it is known.
        """
        self._node = node
        self._take = sample
        self._camera_frame = camera_frame
        self._factory = RclpyMessages()
        self._before = sample()
        self._publisher = node.create_publisher(message_class(TYPE_NAME), '/diagnostics', QOS_DEPTH)
        node.create_timer(PERIOD_S, self._publish, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _publish(self) -> None:
        before, self._before = self._before, self._take()
        found = reports(before, self._before)
        stamp_ns = self._node.get_clock().now().nanoseconds
        hardware_id = self._camera_frame() or 'none'
        self._publisher.publish(message(self._factory, found, stamp_ns, self._node.get_name(), hardware_id))


@dataclass(frozen=True, slots=True)
class Report:
    """One status of the array.

    Attributes:
        name: what it is about; the message puts the node's name in front.
        level: OK, WARN or ERROR.
        text: one line.
        values: details by name.
    """

    name: str
    level: bytes
    text: str
    values: Mapping[str, str]


def reports(before: Sample, now: Sample) -> tuple[Report, ...]:
    """What there is to say, given the counters now and a while ago."""
    return input_report(before, now), tracking_report(now), processing_report(before, now), map_report(now)


def input_report(before: Sample, now: Sample) -> Report:
    """What the camera sends."""
    seconds = now.monotonic_s - before.monotonic_s
    values: dict[str, str] = {}
    for old, new in zip(before.inputs, now.inputs):
        values[f'{new.topic} rate (Hz)'] = f'{(new.received - old.received) / seconds:.1f}'
        values[f'{new.topic} delay (s)'] = _number(new.delay_s, 3)
        values[f'{new.topic} publishers'] = str(new.publishers)
    values['images dropped without a partner'] = str(now.unpaired)
    unpaired = now.unpaired - before.unpaired
    if now.trouble:
        return Report('input', ERROR, f'no frames: {now.trouble}', values)
    if unpaired:
        return Report('input', WARN, f'{unpaired} images dropped without a partner', values)
    return Report('input', OK, 'frames come' if sum(now.frames.values()) else 'waiting for the first frame', values)


def tracking_report(now: Sample) -> Report:
    """Whether it is known where the camera is."""
    values = {f'frames {status.value}': str(count) for status, count in now.frames.items()}
    result = now.result
    if result is None:
        return Report('tracking', WARN, 'no frame yet', values)
    values |= {
        'status': result.status.value,
        'share of the view that is mapped': f'{result.visible_fraction:.2f}',
        'share of it that agrees with the map': f'{result.inlier_fraction:.2f}',
        'stamp': f'{result.stamp_ns / 1e9:.6f}',
    }
    if result.status is Status.LOST:
        return Report('tracking', ERROR, f'lost: {result.reason}', values)
    return Report('tracking', OK, result.status.value, values)


def processing_report(before: Sample, now: Sample) -> Report:
    """Whether SLAM keeps up."""
    seconds = now.monotonic_s - before.monotonic_s
    done = sum(now.frames.values()) - sum(before.frames.values())
    dropped, refused = now.dropped_frames - before.dropped_frames, now.refused_frames - before.refused_frames
    values = {
        'frame rate (Hz)': f'{done / seconds:.1f}',
        'pose rate (Hz)': f'{(now.poses - before.poses) / seconds:.1f}',
        'pose delay (s)': _number(now.delay_s, 3),
        'frames waiting': str(now.waiting_frames),
        'frames dropped': str(now.dropped_frames),
        'frames refused': str(now.refused_frames),
    }
    if now.result is not None:
        timings = now.result.timings
        values |= {f'{stage} (ms)': f'{getattr(timings, stage):.1f}' for stage in timings.__dataclass_fields__}
    if refused:
        return Report('processing', WARN, f'{refused} frames could not be used', values)
    if dropped:
        return Report('processing', WARN, f'slower than the camera: {dropped} frames dropped', values)
    return Report('processing', OK, f'{done / seconds:.1f} frames a second', values)


def map_report(now: Sample) -> Report:
    """How large the map is."""
    count = now.result.num_gaussians if now.result else 0
    return Report('map', OK, f'{count} Gaussians', {'Gaussians': str(count), 'memory (MB)': _number(now.rss_mb, 0)})


def message(factory: MessageFactory, found: Sequence[Report], stamp_ns: int, node_name: str, hardware_id: str) -> Any:
    """A ``diagnostic_msgs/DiagnosticArray``; names as diagnostic_updater makes them, ``node: what``."""
    return factory.make(
        TYPE_NAME,
        header=stamps.header(factory, stamp_ns, ''),
        status=[
            factory.make(
                'diagnostic_msgs/msg/DiagnosticStatus',
                level=report.level,
                name=f'{node_name}: {report.name}',
                message=report.text,
                hardware_id=hardware_id,
                values=[factory.make('diagnostic_msgs/msg/KeyValue', key=key, value=value) for key, value in report.values.items()],
            )
            for report in found
        ],
    )


def _number(value: float | None, digits: int) -> str:
    return 'unknown' if value is None else f'{value:.{digits}f}'
