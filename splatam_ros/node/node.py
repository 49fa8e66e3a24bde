"""The node: parameters, subscriptions, the SLAM worker and what it publishes. Nothing slow runs in its callbacks."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from splatam_core.config import SlamConfig, apply_threads
from splatam_core.errors import FrameError, SplatamError
from splatam_core.geometry.trajectory import stamp_text
from splatam_core.runs import provenance
from splatam_core.slam import Slam
from splatam_core.types import FrameResult, RgbdFrame, Status
from splatam_core.worker import SlamWorker, WorkerStopped
from splatam_ros.frames.geometry import Geometry
from splatam_ros.node import parameters
from splatam_ros.node.diagnostics import InputSample, Monitor, Sample
from splatam_ros.node.frame_assembler import Intake
from splatam_ros.node.gate import Gate
from splatam_ros.node.input_watchdog import Silence
from splatam_ros.node.map_lifecycle import Session
from splatam_ros.node.outputs import Outputs
from splatam_ros.node.parameters import NodeOptions
from splatam_ros.node.reconfiguration import Reconfiguration
from splatam_ros.node.services import Services
from splatam_ros.subscription import Input, unused_overrides
from splatam_ros.throttled_warnings import ThrottledWarnings

TICK_S = 0.2
QUIET_S = 1.0  # without an image: what can be paired by then is paired, and publishers that left are gone
LONG_QUIET_S = 10.0  # the same where one more partner is due; a paused player may be about to send it
PROGRESS_S = 10.0
TRANSPORTS = {
    'raw': ('', Image),
    'compressed': ('/compressed', CompressedImage),
    'compressedDepth': ('/compressedDepth', CompressedImage),
}


class SplatamNode(Node):
    """RGB-D images in; poses, renders and a Gaussian map out.

    The executor's thread pairs and decodes; ``SlamWorker`` owns Slam, the run folder and the publishers.
    """

    def __init__(self) -> None:
        """Declare the parameters and start everything.

        Raises:
            SplatamError: a parameter cannot be used, or there is no place to save to.
        """
        super().__init__('splatam', automatically_declare_parameters_from_overrides=True)
        self.options, config = parameters.declare(self)
        apply_threads(config)
        self.is_finished = False
        self._warnings = ThrottledWarnings(self.get_logger())
        self._gate = Gate(self.options.max_rate_hz)
        self._geometry = Geometry(self, self.options, self._warnings, lambda: self._intake.camera_frame)
        self._outputs = Outputs(self, self.options, self._geometry)
        self._intake = Intake(self.options, self._warnings, self._gate, self._outputs.done)
        self._slam = Slam(config, self._geometry.prior)
        if self._slam.backend.why:
            self.get_logger().info(str(self._slam.backend))
        self._session = Session(self.options, config, self.get_logger(), self._outputs)
        if self.options.load_path:
            self._session.load(self._slam)
        self._inputs = self._subscribe()
        self._warn_of_unused_overrides()
        self._silence = Silence(self, self._inputs)
        self._counts = dict.fromkeys(Status, 0)
        self._num_dropped = self._num_refused = 0
        self._result: FrameResult | None = None
        self._delay_s: float | None = None
        self._heard_s = self._progress_s = time.monotonic()
        self._had_publishers = False
        self.create_timer(TICK_S, self._tick, clock=Clock(clock_type=ClockType.STEADY_TIME))
        # Last, since a thread must be joined: nothing after this may fail.
        self._worker = SlamWorker(
            self._slam, self._on_result, self._on_bad_frame, queue_size=self.options.queue_size,
            when_full='block' if self._keeps_all else 'drop_oldest', before_frame=self._session.before_frame,
        )  # fmt: skip
        self._controls = Services(self, self._worker, self._session, self._gate)
        self._reconfiguration = Reconfiguration(self, self.options, config, self._use_options, self._use_config)
        self.get_logger().info(
            f"preset '{self.options.preset}', waiting for {', '.join(item.topic for item in self._inputs)}, "
            + (f'saving to {self._session.folder}' if self._session.folder else 'saving nothing: save_path is empty')
        )

        self._monitor = Monitor(self, self._sample, lambda: self._geometry.camera_frame)

    @property
    def _keeps_all(self) -> bool:
        return self.options.queue_policy == 'all'

    def _subscribe(self) -> list[Input]:
        rgb_suffix, rgb_class = TRANSPORTS[self.options.rgb_transport]
        depth_suffix, depth_class = TRANSPORTS[self.options.depth_transport]
        streams = (  # of messages that arrive together the executor takes the camera's first
            (CameraInfo, 'rgb/camera_info', self._on_info),
            (rgb_class, f'rgb/image{rgb_suffix}', self._on_color),
            (depth_class, f'depth/image{depth_suffix}', self._on_depth),
        )
        return [
            Input(
                self, message_class, topic, on_message,
                reliability=self.options.input_reliability, keep_all=self._keeps_all,
            )
            for message_class, topic, on_message in streams
        ]  # fmt: skip

    def _warn_of_unused_overrides(self) -> None:
        odometry = [self._geometry.odometry.input] if self._geometry.odometry else []
        topics = [item.topic for item in (*self._inputs, *odometry)]
        for name in unused_overrides(self, topics):
            self.get_logger().warning(
                f"parameter '{name}' overrides nothing; expected qos_overrides.TOPIC.subscription.POLICY, "
                f'TOPIC one of {", ".join(topics)}'
            )

    # --- executor thread ---

    def _on_info(self, message: CameraInfo) -> None:
        self._supply(self._intake.info(message))

    def _on_color(self, message: Image | CompressedImage) -> None:
        self._supply(self._intake.color(message))
        self._heard_s = time.monotonic()  # after supplying, which may have waited for SLAM

    def _on_depth(self, message: Image | CompressedImage) -> None:
        self._supply(self._intake.depth(message))
        self._heard_s = time.monotonic()

    def _supply(self, frames: list[RgbdFrame]) -> None:
        for frame in frames:
            try:
                self._worker.submit(frame)
            except WorkerStopped:  # why is said when the node closes
                self.is_finished = True
                return
            self._silence.end()

    def _tick(self) -> None:
        quiet_s = time.monotonic() - self._heard_s
        if self._worker.pending:
            self._silence.postpone()
        elif self._stalls_on_lookahead(quiet_s):
            self._supply(self._intake.flush())
        elif self._outputs.is_behind:
            self._worker.call(lambda slam: self._outputs.catch_up())
        self._report_drops()
        self._silence.check(self._intake.statistics, self.options)
        self._check_end(quiet_s)

    def _stalls_on_lookahead(self, quiet_s: float) -> bool:
        """Whether images wait for a better partner that will not come: a player may be waiting for us."""
        waiting = self._intake.statistics
        if not (waiting.waiting_color and waiting.waiting_depth):
            return False
        return quiet_s > (QUIET_S if waiting.waiting_color == waiting.waiting_depth else LONG_QUIET_S)

    def _report_drops(self) -> None:
        self._intake.report_drops()
        dropped = self._worker.dropped
        if dropped > self._num_dropped:
            self._warnings.warn(
                'dropped', f'SLAM is slower than the camera: {dropped} frames dropped so far; '
                'queue_policy all keeps every frame of a recording',
            )  # fmt: skip
        self._num_dropped = dropped

    def _check_end(self, quiet_s: float) -> None:
        """Finish when the worker broke down, or the image publishers have left and all of theirs is processed."""
        images = self._inputs[1:]
        has_publishers = any(item.num_publishers for item in images)
        # Publishers may have come and gone while the executor waited for SLAM; their images were received then.
        self._had_publishers |= has_publishers or any(item.received for item in images)
        if self._worker.error is not None:
            self.is_finished = True
        elif self.options.exit_on_publisher_end and self._had_publishers and not has_publishers and quiet_s > QUIET_S:
            self._supply(self._intake.flush())
            self.is_finished |= self._worker.pending == 0

    def _sample(self) -> Sample:
        waiting = self._intake.statistics
        inputs = [InputSample(item.topic, item.received, item.num_publishers, item.delay_s) for item in self._inputs]
        return Sample(
            time.monotonic(), inputs, waiting.unpaired_color + waiting.unpaired_depth, self._worker.pending,
            self._worker.dropped, self._num_refused, dict(self._counts), self._outputs.num_poses, self._delay_s,
            self._result, provenance.rss_mb(),
            self._silence.why,
        )  # fmt: skip

    def _use_options(self, options: NodeOptions) -> None:
        self.options = self._session.options = options
        self._gate.max_rate_hz = options.max_rate_hz
        self._outputs.use(options)

    def _use_config(self, config: SlamConfig) -> None:
        self._worker.call(lambda slam: slam.configure(config))

    def close(self, is_hurried: Callable[[], bool] = lambda: True) -> bool:
        """Take no more messages, finish what waits, save, destroy. Whether all went well.

        Args:
            is_hurried: whether somebody waits for the end, and may kill the process.
        """
        for item in self._inputs:
            item.close()
        if self._keeps_all:
            self._supply(self._intake.flush())
        is_fine = self._attempt('SLAM', lambda: self._worker.stop(drain=self._keeps_all))
        self._report_drops()
        if self.options.folder is not None and self.options.save_on_shutdown:
            if self._worker.error is None:
                is_fine &= self._attempt('fitting the map once more', lambda: self._session.fit(self._slam, is_hurried))
            is_fine &= self._attempt('saving', lambda: self._session.finish(self._slam))
        is_fine &= self._attempt('saving', self._session.close)
        self.destroy_node()
        return is_fine

    def _attempt(self, what: str, action: Callable[[], object]) -> bool:
        """Do something that must not keep the rest of the shutdown from happening."""
        try:
            action()
        except (SplatamError, OSError) as error:
            self.get_logger().error(f'{what} failed: {error}')
        except Exception as error:  # noqa: BLE001 - the rest of the shutdown is to happen
            self.get_logger().error(f'{what} failed:\n{"".join(traceback.format_exception(error))}')
        else:
            return True
        return False

    # --- worker's thread ---

    def _on_result(self, frame: RgbdFrame, result: FrameResult) -> None:
        self._session.record(frame, result)  # before anybody hears of the frame: what was answered is on disk
        self._counts[result.status] += 1
        if result.status is Status.LOST:
            self._warnings.warn('lost', f'lost at {stamp_text(result.stamp_ns)}: {result.reason}')
        self._result = result
        self._outputs.publish(result, self._slam)
        if result.T_world_cam is not None:
            self._delay_s = (self.get_clock().now().nanoseconds - result.stamp_ns) / 1e9
        self._log_progress(result)
        self._session.after_frame(self._slam, result)

    def _on_bad_frame(self, frame: RgbdFrame, error: FrameError) -> None:
        self._num_refused += 1
        self._warnings.warn('refused', f'frame {stamp_text(frame.stamp_ns)} left out: {error}')
        self._outputs.done(frame.stamp_ns)

    def _log_progress(self, result: FrameResult) -> None:
        is_first = result.status is Status.INITIALIZED
        if is_first or time.monotonic() - self._progress_s > PROGRESS_S:
            self._progress_s = time.monotonic()
            self.get_logger().info(
                f'{sum(self._counts.values())} frames, {self._counts[Status.LOST]} lost, '
                f'{result.num_gaussians} Gaussians, {result.timings.total:.0f} ms for this frame'
            )
