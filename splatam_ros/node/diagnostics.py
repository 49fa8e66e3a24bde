"""Publishes ``/diagnostics``: input, tracking, processing and map, for rqt_robot_monitor and for robots.

Each report is computed from two samples of the node's counters. Rates are per second of the time between them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from rclpy.node import Node

from msg_adapters import stamps
from msg_adapters.factory import MessageFactory, RclpyMessages, message_class
from splatam_core.errors import FrameError
from splatam_core.types import FrameResult, GraphSummary, Status

OK, WARN, ERROR = b'\x00', b'\x01', b'\x02'
TYPE_NAME = 'diagnostic_msgs/msg/DiagnosticArray'
PERIOD_S = 1.0
QOS_DEPTH = 10


@dataclass(frozen=True, slots=True)
class InputSample:
    """Counters of one subscription.

    Attributes:
        topic: resolved name.
        received: number of messages since the start.
        publishers: number of publishers on the graph.
        delay_s: time from the newest message's stamp to its arrival; None before the first message.
    """

    topic: str
    received: int
    publishers: int
    delay_s: float | None


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """The node's counters at one time.

    Attributes:
        monotonic_s: time of the sample.
        inputs: the subscriptions.
        unpaired: number of images dropped because no partner came.
        waiting_frames: number of frames that wait for SLAM, or are being processed.
        dropped_frames: number of frames dropped because SLAM was busy.
        refused_frames: number of frames that SLAM could not use, or that failed.
        frames: number of processed frames by status.
        poses: number of poses published.
        delay_s: time from the newest pose's stamp to its publication; None before the first pose.
        result: result of the newest frame; None before the first frame.
        rss_mb: memory of the process; None if it is not known.
        problem: why no frames are received; empty while they are.
        camera_frame: coordinate frame of the camera; empty before the first frame.
        relocalised: number of times that a lost camera was found anew in the map.
        graph: what the keyframe graph holds.
        shortened: number of frames that took fewer optimization steps than usual, because others waited.
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
    problem: str
    camera_frame: str
    relocalised: int = 0
    graph: GraphSummary = GraphSummary()
    shortened: int = 0


class FrameCounters:
    """Counts processed frames by outcome. The worker's thread counts, the executor's thread reads.

    Attributes:
        by_status: number of processed frames by status.
        refused: number of frames that SLAM could not use.
        relocalised: number of times that a lost camera was found anew in the map.
        shortened: number of frames that postponed optimization steps.
        failed: number of frames for which SLAM or publishing failed.
        newest: result of the newest frame; None before the first.
        delay_s: time from the newest pose's stamp to its publication; None before the first pose.
        frame_id: frame id of the newest frame's colour image; empty before the first.
        graph: what the keyframe graph holds after the newest frame.
    """

    def __init__(self) -> None:
        self.by_status = dict.fromkeys(Status, 0)
        self.refused = self.failed = self.relocalised = self.shortened = 0
        self.newest: FrameResult | None = None
        self.delay_s: float | None = None
        self.frame_id = ''
        self.graph = GraphSummary()

    @property
    def total(self) -> int:
        """Number of processed frames."""
        return sum(self.by_status.values())

    @property
    def bad(self) -> int:
        """Number of frames that SLAM could not use, or that failed."""
        return self.refused + self.failed

    def add_bad(self, error: Exception) -> None:
        """Count a frame that was refused, by a FrameError, or that failed, by any other error."""
        if isinstance(error, FrameError):
            self.refused += 1
        else:
            self.failed += 1

    def add(self, result: FrameResult, frame_id: str, graph: GraphSummary | None = None) -> None:
        """Count a processed frame."""
        self.by_status[result.status] += 1
        self.relocalised += result.is_relocalised
        self.shortened += result.postponed_steps > 0
        self.newest, self.graph = result, graph or GraphSummary()
        self.frame_id = frame_id

    def progress(self, result: FrameResult) -> str:
        """Returns a line for the log, after a frame."""
        hurried = f'{self.shortened} fitted the map less because others waited, ' if self.shortened else ''
        return (
            f'frame {self.total}: {self.by_status[Status.UNCERTAIN]} uncertain and {self.by_status[Status.LOST]} lost so far, '
            f'{hurried}{result.num_gaussians} Gaussians, {result.timings.total:.0f} ms for this frame'
        )


class DiagnosticsPublisher:
    """Publishes reports about the time since the previous sample."""

    def __init__(self, node: Node, first: Sample) -> None:
        """Advertise the topic.

        Args:
            node: the node that publishes.
            first: sample with which the first report is compared.
        """
        self._node = node
        self._factory = RclpyMessages()
        self._before = first
        self._publisher = node.create_publisher(message_class(TYPE_NAME), '/diagnostics', QOS_DEPTH)

    def publish(self, now: Sample) -> None:
        """Publish the reports about the time from the last sample to this one."""
        before, self._before = self._before, now
        stamp_ns = self._node.get_clock().now().nanoseconds
        hardware_id = now.camera_frame or 'none'
        self._publisher.publish(message(self._factory, reports(before, now), stamp_ns, self._node.get_name(), hardware_id))


@dataclass(frozen=True, slots=True)
class Report:
    """One status of the array.

    Attributes:
        name: subject; the message puts the node's name in front.
        level: OK, WARN or ERROR.
        text: one line.
        values: details by name.
    """

    name: str
    level: bytes
    text: str
    values: Mapping[str, str]


def reports(before: Sample, now: Sample) -> tuple[Report, ...]:
    """Returns one report per subject, given the counters now and earlier."""
    return input_report(before, now), tracking_report(now), processing_report(before, now), map_report(now)


def input_report(before: Sample, now: Sample) -> Report:
    """Report on the images that are received."""
    seconds = now.monotonic_s - before.monotonic_s
    values: dict[str, str] = {}
    for old, new in zip(before.inputs, now.inputs):
        values[f'{new.topic} rate (Hz)'] = f'{(new.received - old.received) / seconds:.1f}'
        values[f'{new.topic} delay (s)'] = _number(new.delay_s, 3)
        values[f'{new.topic} publishers'] = str(new.publishers)
    values['images dropped without a partner'] = str(now.unpaired)
    unpaired = now.unpaired - before.unpaired
    if now.problem:
        return Report('input', ERROR, f'no frames: {now.problem}', values)
    if unpaired:
        return Report('input', WARN, f'{unpaired} images dropped without a partner', values)
    has_frames = sum(now.frames.values()) > 0
    return Report('input', OK, 'receiving frames' if has_frames else 'waiting for the first frame', values)


def tracking_report(now: Sample) -> Report:
    """Report on whether the pose of the camera is known."""
    values = {f'frames {status.value}': str(count) for status, count in now.frames.items()}
    result = now.result
    if result is None:
        return Report('tracking', WARN, 'no frame yet', values)
    values |= {
        'status': result.status.value,
        'visible fraction': f'{result.visible_fraction:.2f}',
        'inlier fraction': f'{result.inlier_fraction:.2f}',
        'stamp': f'{result.stamp_ns / 1e9:.6f}',
    }
    values |= {
        'position standard deviation (m)': _number(_deviation_m(result), 4),
        'directions held by the prediction': str(result.num_held),
        'times found anew in the map': str(now.relocalised),
    }
    if result.status is Status.LOST:
        return Report('tracking', ERROR, f'lost: {result.reason}', values)
    if result.status is Status.UNCERTAIN:
        return Report('tracking', WARN, f'uncertain: {result.reason}', values)
    if result.num_held:
        return Report('tracking', WARN, f'tracked; {result.num_held} of 6 directions are held by the prediction', values)
    return Report('tracking', OK, result.status.value, values)


def processing_report(before: Sample, now: Sample) -> Report:
    """Report on whether SLAM is fast enough for the camera."""
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
        'frames that shortened mapping': str(now.shortened),
    }
    if now.result is not None:
        timings = now.result.timings
        values |= {f'{stage} (ms)': f'{getattr(timings, stage):.1f}' for stage in timings.__dataclass_fields__}
    if refused:
        return Report('processing', WARN, f'{refused} frames could not be used', values)
    if dropped:
        return Report('processing', WARN, f'SLAM is slower than the camera: {dropped} frames dropped', values)
    shortened = now.shortened - before.shortened
    hurried = f', of {done} frames {shortened} fitted the map less because others waited' if shortened else ''
    return Report('processing', OK, f'{done / seconds:.1f} frames per second{hurried}', values)


def map_report(now: Sample) -> Report:
    """Report on the size of the map, and on its corrections."""
    count, graph = now.result.num_gaussians if now.result else 0, now.graph
    values = {
        'Gaussians': str(count),
        'memory (MB)': _number(now.rss_mb, 0),
        'keyframes in the graph': str(graph.nodes),
        'loops': str(graph.loops),
        'corrections': str(graph.corrections),
        'last correction (m)': _number(graph.last_correction_m if graph.corrections else None, 3),
    }
    return Report('map', OK, f'{count} Gaussians', values)


def message(factory: MessageFactory, found: Sequence[Report], stamp_ns: int, node_name: str, hardware_id: str) -> Any:
    """Returns a ``diagnostic_msgs/DiagnosticArray``. Statuses are named ``NODE: SUBJECT``, as by diagnostic_updater."""
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


def _deviation_m(result: FrameResult) -> float | None:
    """Returns the standard deviation of the position, over all axes; None where there is none."""
    return None if result.covariance is None else float(np.sqrt(np.trace(result.covariance.total[:3, :3])))


def _number(value: float | None, digits: int) -> str:
    return 'unknown' if value is None else f'{value:.{digits}f}'
