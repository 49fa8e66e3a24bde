"""Assembles frames from messages: pairs, decodes and rectifies the camera's images."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar

from msg_adapters import camera_info, images, remarks, stamps
from msg_adapters.camera_info import CameraParameters
from msg_adapters.synchronizer import RgbdSet, RgbdSynchronizer, SyncStatistics
from splatam_core.geometry.camera import CameraCalibration
from splatam_core.geometry.trajectory import stamp_text
from splatam_core.images.rectification import FrameFactories, FrameFactory
from splatam_core.types import RgbdFrame
from splatam_ros.node.gate import FrameGate
from splatam_ros.node.parameters import NodeOptions
from splatam_ros.node.stamp_filter import StampFilter
from splatam_ros.throttled_warnings import ThrottledWarnings

T = TypeVar('T')
MIN_EQUAL = 6  # images with one stamp, beside the first two, from a driver that does not stamp


class FrameAssembler:
    """Turns the three streams of a camera into frames. Unusable input is skipped with a warning; nothing raises."""

    def __init__(
        self, options: NodeOptions, warnings: ThrottledWarnings, gate: FrameGate, on_rejected: Callable[[int], None],
        now_ns: Callable[[], int] = time.time_ns,
    ) -> None:  # fmt: skip
        """Start without messages.

        Args:
            options: the node's options.
            warnings: receives a warning about each input that is skipped.
            gate: decides about each frame before it is decoded.
            on_rejected: called with the stamp (ns) of each frame that the gate rejects, that has a wrong stamp, or cannot be used.
            now_ns: the node's clock, for ``use_receive_time``.
        """
        jump_ns = round(options.time_jump_threshold * 1e9)
        self._synchronizer = RgbdSynchronizer(
            options.sync_mode, round(options.sync_max_interval * 1e9) or None, options.sync_queue_size, jump_ns
        )
        self._stamps = StampFilter(jump_ns, self._drop_wrong_stamp)
        self._factories = FrameFactories(options.width or None)
        self._has_k = False
        self._is_rectified = not options.undistort
        self._depth_scale = options.depth_scale
        self._rgb_encoding = options.rgb_encoding or None
        self._warnings = warnings
        self._gate = gate
        self._on_rejected = on_rejected
        self._now_ns = now_ns if options.use_receive_time else None
        self._reported = self._synchronizer.statistics

    @property
    def statistics(self) -> SyncStatistics:
        """Counts of received, paired and dropped messages."""
        return self._synchronizer.statistics

    @property
    def is_stalled(self) -> bool:
        """True if a frame waits for the next one, to find out whether its stamp is right."""
        return self._stamps.is_holding

    def add_color(self, message: Any) -> list[RgbdFrame]:
        """Add a colour image; returns the frames that it completes."""
        return self._frames(self._synchronizer.add_color(self._stamp_ns(message), message))

    def add_depth(self, message: Any) -> list[RgbdFrame]:
        """Add a depth image; returns the frames that it completes."""
        return self._frames(self._synchronizer.add_depth(self._stamp_ns(message), message))

    def add_info(self, message: Any) -> list[RgbdFrame]:
        """Add a CameraInfo; returns the frames that waited for the first one. An invalid one is ignored."""
        read = partial(camera_info.parameters, is_rectified=self._is_rectified)
        parameters = self._attempt('CameraInfo', read, message)
        if parameters is None:
            return []
        if not self._is_rectified and camera_info.has_only_p(message):
            if self._has_k:
                self._warnings.warn('CameraInfo', 'CameraInfo skipped: K is all zero')
                return []
            self._remark('info', remarks.on_info(message))
        else:
            self._has_k = True
        return self._frames(self._synchronizer.add_info(self._stamp_ns(message), parameters))

    def flush(self) -> list[RgbdFrame]:
        """Returns the frames that can be assembled without further messages; unpaired images are dropped."""
        return self._frames(self._synchronizer.flush()) + self._admitted(self._stamps.flush())

    def report_drops(self) -> None:
        """Warn about the messages that the synchronizer has dropped since the last report."""
        before, now = self._reported, self._synchronizer.statistics
        self._reported = now
        if now.sets <= 1 and now.duplicates >= MIN_EQUAL:
            self._warnings.warn('not stamped', f'all stamps are equal: {remarks.NOT_STAMPED}')
        else:
            self._report('duplicates', now.duplicates - before.duplicates, 'an image with the same stamp was received before')
        self._report('late', now.late - before.late, 'older than the last frame; do the stamps increase?')
        self._report('color', now.unpaired_color - before.unpaired_color, f'colour without depth{_gap(now)}')
        self._report('depth', now.unpaired_depth - before.unpaired_depth, f'depth without colour{_gap(now)}')
        self._report('without info', now.without_info - before.without_info, 'paired, but no CameraInfo was received')

    def _stamp_ns(self, message: Any) -> int:
        return stamps.message_stamp_ns(message) if self._now_ns is None else self._now_ns()

    def _report(self, kind: str, count: int, why: str) -> None:
        if count > 0:
            self._warnings.warn(f'dropped {kind}', f'{count} image{"s" if count > 1 else ""} dropped: {why}')

    def _frames(self, sets: list[RgbdSet]) -> list[RgbdFrame]:
        return self._admitted([right for found in sets for right in self._stamps.add(found)])

    def _admitted(self, sets: list[RgbdSet]) -> list[RgbdFrame]:
        return [frame for found in sets if self._is_admitted(found) and (frame := self._decoded(found)) is not None]

    def _decoded(self, found: RgbdSet) -> RgbdFrame | None:
        frame = self._attempt('frame', self._frame, found)
        if frame is None:
            self._on_rejected(found.stamp_ns)  # a player may wait for its answer
        return frame

    def _drop_wrong_stamp(self, found: RgbdSet, last_ns: int) -> None:
        self._warnings.warn(
            'wrong stamp', f'frame {stamp_text(found.stamp_ns)} skipped: {remarks.on_wrong_stamp(found.stamp_ns - last_ns)}'
        )
        self._on_rejected(found.stamp_ns)

    def _is_admitted(self, found: RgbdSet) -> bool:
        is_admitted = self._gate.admits(found.resets, found.stamp_ns)
        if not is_admitted:
            self._on_rejected(found.stamp_ns)
        return is_admitted

    def _frame(self, found: RgbdSet) -> RgbdFrame | None:
        factory = self._attempt('camera', self._frame_factory, found.info)
        size = found.info.width, found.info.height
        decode_color = partial(images.decode_color, camera_size=size, rgb_encoding=self._rgb_encoding)
        decode_depth = partial(images.decode_depth, metres_per_count=self._depth_scale, camera_size=size)
        rgb = self._attempt('colour', decode_color, found.color)
        depth_m = self._attempt('depth', decode_depth, found.depth)
        if factory is None or rgb is None or depth_m is None:
            return None
        self._remark('gap', remarks.on_gap(found.gap_ns))
        self._remark('frame ids', remarks.on_frames(found.color.header.frame_id, found.depth.header.frame_id))
        self._remark('encoding', remarks.on_encoding(getattr(found.color, 'encoding', ''), self._rgb_encoding))
        frame = self._attempt('frame', lambda stamp_ns: factory.make(stamp_ns, rgb, depth_m), found.stamp_ns)
        if frame is None:
            return None
        return replace(frame, epoch=found.resets, frame_id=found.color.header.frame_id or found.info.frame_id)

    def _remark(self, kind: str, text: str) -> None:
        if text:
            self._warnings.warn(kind, text)

    def _frame_factory(self, parameters: CameraParameters) -> FrameFactory:
        return self._factories.of(CameraCalibration.from_intrinsics(parameters))

    def _attempt(self, what: str, function: Callable[[Any], T], argument: Any) -> T | None:
        """Returns the function's result, or None after a warning if the input cannot be used."""
        try:
            return function(argument)
        except Exception as error:  # noqa: BLE001 - whatever a message holds, the next one may be fine
            self._warnings.warn_of(what, f'{what} skipped', error)
            return None


def _gap(statistics: SyncStatistics) -> str:
    if statistics.newest_gap_ns is None:
        return ''
    return f'; the newest depth is {statistics.newest_gap_ns / 1e9:+.3f} s from the newest colour'
