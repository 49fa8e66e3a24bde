"""The node: connects parameters, camera, SLAM worker and outputs. No callback does slow work on the executor's thread."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from splatam_core.config import SlamConfig, apply_threads
from splatam_core.geometry.trajectory import stamp_text
from splatam_core.runs import provenance
from splatam_core.slam import Slam
from splatam_core.types import FrameResult, RgbdFrame, Status
from splatam_core.worker import SlamWorker, WorkerStopped
from splatam_ros.frames.robot_frames import RobotFrames
from splatam_ros.node import diagnostics, parameters
from splatam_ros.node.attempt import attempt
from splatam_ros.node.camera_input import CameraInput
from splatam_ros.node.diagnostics import DiagnosticsPublisher, FrameCounters, InputSample, Sample
from splatam_ros.node.frame_assembler import FrameAssembler
from splatam_ros.node.gate import FrameGate
from splatam_ros.node.input_watchdog import InputWatchdog
from splatam_ros.node.map_lifecycle import MapLifecycle
from splatam_ros.node.outputs import Outputs
from splatam_ros.node.parameters import NodeOptions
from splatam_ros.node.reconfiguration import Reconfiguration
from splatam_ros.node.services import Services
from splatam_ros.process import StopRequest
from splatam_ros.subscription import unused_overrides
from splatam_ros.throttled_warnings import ThrottledWarnings

TICK_S = 0.2
PROGRESS_S = 10.0
DRAIN_S = 2.0  # of the 8 s that a node told to stop has; the final fit and saving need the rest


class SplatamNode(Node):
    """RGB-D images in; poses, renders and a Gaussian map out.

    The executor's thread pairs and decodes images. ``SlamWorker`` owns SLAM, the run folder and the publishers.

    Attributes:
        options: the node's parameters; some change at run time.
        is_finished: True when the process should end: the recording is over, or SLAM failed.
    """

    def __init__(self, stop: StopRequest) -> None:
        """Declare the parameters and start everything.

        Args:
            stop: tells if the process was asked to stop.

        Raises:
            SplatamError: a parameter cannot be used, or there is no place to save to.
        """
        super().__init__('splatam', automatically_declare_parameters_from_overrides=True)
        self.options, config = parameters.declare(self)
        options, logger = self.options, self.get_logger()
        apply_threads(config)
        self.is_finished = False
        self._stop = stop
        self._num_dropped = self._num_given_up = 0
        self._progress_s = time.monotonic()
        self._counters = FrameCounters()
        self._warnings = ThrottledWarnings(logger)
        self._frames = RobotFrames(
            self, options.frames, self._warnings, reliability=options.input_reliability, keep_all=options.keeps_all
        )
        self._outputs = Outputs(self, options, self._frames)
        self._lifecycle = MapLifecycle(options, config, logger, self._frames, self._outputs)
        self._slam = Slam(config, self._frames.prior, stop=self._is_out_of_time)
        if self._slam.backend.why:
            logger.info(str(self._slam.backend))
        if options.load_path:
            self._lifecycle.load(self._slam)
        self._gate = FrameGate(options.max_rate_hz)
        assembler = FrameAssembler(options, self._warnings, self._gate, self._outputs.publish_processed, self._now_ns)
        self._camera = CameraInput(self, options, assembler, self._submit)
        self._watchdog = InputWatchdog(self, self._camera.subscriptions)
        self._warn_of_unused_overrides()
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # sim time may stand still
        self.create_timer(TICK_S, self._tick, clock=steady)
        self.create_timer(diagnostics.PERIOD_S, self._publish_diagnostics, clock=steady)
        # Start the thread last: it must be joined, so nothing after it may fail before ``close``.
        self._worker = SlamWorker(
            self._slam, self._on_result, self._on_bad_frame, queue_size=options.queue_size,
            when_full='block' if options.keeps_all else 'drop_oldest', before_frame=self._lifecycle.before_frame,
        )  # fmt: skip
        self._late = self._worker.call(self._outputs.serve_late_subscribers)
        self._service_server = Services(self, self._worker, self._lifecycle, self._outputs, self._gate)
        self._reconfiguration = Reconfiguration(self, options, config, self._use_options, self._use_config)
        self._diagnostics = DiagnosticsPublisher(self, self._sample())
        folder = self._lifecycle.folder
        saving = f'saving to {folder}' if folder else 'saving nothing: save_path is empty'
        logger.info(f"preset '{options.preset}', waiting for {', '.join(self._camera.topics)}, {saving}")

    def _warn_of_unused_overrides(self) -> None:
        odometry = [self._frames.odometry.topic] if self._frames.odometry else []
        topics = [*self._camera.topics, *odometry]
        for name in unused_overrides(self, topics):
            self.get_logger().warning(
                f"parameter '{name}' has no effect; expected qos_overrides.TOPIC.subscription.POLICY, "
                f'TOPIC one of {", ".join(topics)}'
            )

    # --- executor's thread ---

    def _submit(self, frame: RgbdFrame) -> None:
        try:
            self._num_given_up += not self._worker.submit(frame, self._is_out_of_time)
        except WorkerStopped:  # ``close`` logs the cause
            self.is_finished = True
        else:
            self._watchdog.report_frame()

    def _now_ns(self) -> int:
        return self.get_clock().now().nanoseconds

    def _is_out_of_time(self) -> bool:
        """True if frames that wait for SLAM must be dropped, so that the node ends in time."""
        return self._stop.elapsed_s > DRAIN_S

    def _tick(self) -> None:
        if self._worker.pending:
            self._watchdog.postpone()
        elif self._camera.is_stalled:
            self._camera.flush()
        elif self._outputs.has_late_subscriber and self._late.done():  # at most one call waits, however long a save takes
            self._late = self._worker.call(self._outputs.serve_late_subscribers)
        self._report_drops()
        self._watchdog.check(self._camera.statistics, self.options)
        self._check_end()

    def _report_drops(self) -> None:
        self._camera.report_drops()
        dropped = self._worker.dropped
        if dropped > self._num_dropped:
            self._warnings.warn(
                'dropped', f'SLAM is slower than the camera: {dropped} frames dropped so far; '
                'set queue_policy to all to keep every frame of a recording',
            )  # fmt: skip
        self._num_dropped = dropped

    def _check_end(self) -> None:
        """Finish if the worker failed, or if the image publishers have left and everything is processed."""
        has_ended = self._camera.has_ended
        if self._worker.error is not None:
            self.is_finished = True
        elif self.options.exit_on_publisher_end and has_ended:
            self._camera.flush()
            self.is_finished |= self._worker.pending == 0

    def _publish_diagnostics(self) -> None:
        self._diagnostics.publish(self._sample())

    def _sample(self) -> Sample:
        statistics = self._camera.statistics
        return Sample(
            monotonic_s=time.monotonic(),
            inputs=[
                InputSample(item.topic, item.received, item.num_publishers, item.delay_s) for item in self._camera.subscriptions
            ],
            unpaired=statistics.unpaired_color + statistics.unpaired_depth,
            waiting_frames=self._worker.pending,
            dropped_frames=self._worker.dropped,
            refused_frames=self._counters.bad,
            frames=dict(self._counters.by_status),
            poses=self._outputs.num_poses,
            delay_s=self._counters.delay_s,
            result=self._counters.newest,
            rss_mb=provenance.rss_mb(),
            problem=self._watchdog.problem,
            camera_frame=self._frames.camera_frame(self._counters.frame_id),
            relocalised=self._counters.relocalised,
            graph=self._counters.graph,
            shortened=self._counters.shortened,
        )

    def _use_options(self, options: NodeOptions) -> None:
        self.options = options
        self._lifecycle.use(options)
        self._gate.max_rate_hz = options.max_rate_hz
        self._outputs.use(options)

    def _use_config(self, config: SlamConfig) -> None:
        def configure(slam: Slam) -> None:
            slam.configure(config)

        self._worker.call(configure)

    def close(self) -> bool:
        """Stop receiving, process what waits, save, and destroy the node. After a request to stop, all within 8 s.

        Returns:
            True if SLAM worked and everything was saved.
        """
        is_fine = self._attempt('closing the subscriptions', self._camera.close)
        if self.options.keeps_all:
            is_fine &= self._attempt('the last images', self._camera.flush)
        is_fine &= self._attempt('SLAM', self._stop_worker)
        self._report_drops()
        if self._counters.failed and not self._counters.total:
            self.get_logger().error(f'SLAM failed for every frame ({self._counters.failed}); see above')
            is_fine = False
        if self.options.folder is not None and self.options.save_on_shutdown:
            if self._worker.error is None:
                is_fine &= self._attempt('the final fit of the map', partial(self._lifecycle.finish, self._slam, self._stop))
            is_fine &= self._attempt('saving', partial(self._lifecycle.save_at_end, self._slam))
        is_fine &= self._attempt('saving', self._lifecycle.close)
        is_fine &= self._attempt('the viewer', self._outputs.close)
        self.destroy_node()
        return is_fine

    def _stop_worker(self) -> None:
        dropped = self._worker.stop(self.options.keeps_all, self._is_out_of_time)
        if self.options.keeps_all and dropped + self._num_given_up:
            self.get_logger().warning(
                f'{dropped + self._num_given_up} frames that waited for SLAM were dropped, because the node was told to stop'
            )

    def _attempt(self, what: str, action: Callable[[], object]) -> bool:
        return attempt(self.get_logger(), what, action)

    # --- worker's thread ---

    def _on_result(self, frame: RgbdFrame, result: FrameResult) -> None:
        self._lifecycle.record(frame, result)  # before publishing: a frame that was answered is on disk
        self._counters.add(result, frame.frame_id, self._slam.graph.summary)
        if result.reason:
            self._warnings.warn(result.status.value, f'{result.status.value} at {stamp_text(result.stamp_ns)}: {result.reason}')
        self._outputs.publish(frame, result, self._lifecycle.locate(frame, result), self._slam)
        if result.T_world_cam is not None:
            self._counters.delay_s = (self.get_clock().now().nanoseconds - result.stamp_ns) / 1e9
        self._log_progress(result)
        self._lifecycle.after_frame(self._slam, result)

    def _on_bad_frame(self, frame: RgbdFrame, error: Exception) -> None:
        self._counters.add_bad(error)
        self._warnings.warn_of(type(error).__name__, f'frame {stamp_text(frame.stamp_ns)} skipped', error)
        self._outputs.publish_processed(frame.stamp_ns)

    def _log_progress(self, result: FrameResult) -> None:
        is_first = result.status is Status.INITIALIZED
        if is_first or time.monotonic() - self._progress_s > PROGRESS_S:
            self._progress_s = time.monotonic()
            self.get_logger().info(self._counters.progress(result))
