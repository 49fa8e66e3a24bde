"""Plays a recording onto the ROS graph, at the pace of its listeners."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator
from contextlib import closing

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import ReliabilityPolicy
from tqdm import tqdm

from msg_adapters.errors import MessageError
from msg_adapters.factory import message_class
from msg_adapters.stamps import serialized_stamp_ns
from splatam_core.datasets.bag.recording import RawMessage, RecordedTopic, Recording
from splatam_core.datasets.bag.typestore import CAMERA_INFO
from splatam_ros.player.back_pressure import BackPressure, PlaybackError, is_acknowledged
from splatam_ros.player.controls import Controls
from splatam_ros.player.keyboard import Keyboard
from splatam_ros.player.listeners import AnswerTopic, Listeners
from splatam_ros.player.offered_qos import is_latched, publisher_qos
from splatam_ros.player.options import Options
from splatam_ros.player.pacing import Lateness, PlaybackClock
from splatam_ros.player.read_ahead import ReadAhead
from splatam_ros.player.sim_clock import SimClock
from splatam_ros.process import RosError, StopRequest

STEP_S = 0.05  # longest time without a look at keys and signals
CHECK_GRAPH_S = 0.2
LATE_SUBSCRIBERS_S = 5.0  # after the first image topic has a subscriber; discovery takes up to 3 s
LINGER_S = 0.5  # at the end, for subscribers that acknowledge nothing: what they have not received is lost when we exit
SHORTEST_MESSAGE = 4  # bytes of the CDR encapsulation
REPLY_S = 0.3  # for the answer of the service ~/stop to arrive: ROS does not tell when it has
BAR_FORMAT = '{percentage:3.0f}%|{bar}| {n:.1f}/{total:.1f} s of the recording [{elapsed}<{remaining}{postfix}]'


class Interrupted(Exception):
    """A signal asked the player to stop."""


class _Stopped(Exception):
    """A service asked the player to stop."""


class Player:
    """One playback: ``play`` does everything, in the calling thread."""

    def __init__(self, node: Node, recording: Recording, options: Options, stop: StopRequest, keyboard: Keyboard) -> None:
        """Create the publishers.

        Args:
            node: publishes; the player spins it.
            recording: what to play.
            options: how to play.
            stop: ends playback when requested.
            keyboard: steers playback, besides the services.
        """
        self._node = node
        self._recording = recording
        self._options = options
        self._stop = stop
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(node)
        self._publishers = {name: self._create_publisher(recording.topics[name]) for name in options.topics}
        awaited = [self._publishers[name] for name in options.topics if _is_awaited(recording.topics[name])]
        self._listeners = Listeners(node, {publisher.topic_name: publisher for publisher in awaited})
        self._answer_topics = [AnswerTopic(node, topic, self._answered) for topic in options.wait_for]
        self._clock = PlaybackClock(options.start_ns, options.rate)
        self._sim_clock = SimClock(node, self._clock, options.end_ns, options.clock_hz, options.clock_topics)
        self._controls = Controls(node, self._clock, keyboard, _say)
        self._back_pressure = BackPressure(
            self._answer_topics, self._clock,
            max_ahead=options.max_ahead, timeout_s=options.wait_timeout_s, step=self._step, say=_say,
        )  # fmt: skip
        self._color: str | None = None
        self._depth: str | None = None
        self._lateness = Lateness()
        self._num_messages = self._num_damaged = 0
        self._check_graph_due_s = 0.0
        self._bar: tqdm | None = None

    def play(self) -> str:
        """Play the recording.

        Returns:
            What was played, in one line.

        Raises:
            RosError: there is no subscriber, or no answer topic.
            PlaybackError: listeners left, or a frame was not answered in time.
            DatasetError: the recording is damaged.
            Interrupted: by a signal.
        """
        started_s = time.monotonic()
        try:
            with self._clock.frozen():
                self._clock.restart(self._options.start_ns)
                self._wait_for_listeners()
                self._choose_frames()
                self._wait_for_answer_topic()
            self._listeners.watch()
            started_s = time.monotonic()
            self._play_all()
        except _Stopped:
            time.sleep(REPLY_S)
            return f'stopped; {self._summary(time.monotonic() - started_s)}'
        return self._summary(time.monotonic() - started_s)

    @property
    def progress(self) -> str:
        """How much was published, and the first frame that was not answered, in words."""
        if self._color is not None:
            return self._back_pressure.progress
        return f'{self._num_messages} messages handed out, {self._back_pressure.missing}'

    def _create_publisher(self, topic: RecordedTopic) -> Publisher:
        qos = publisher_qos(topic, self._options.qos.get(topic.name, {}), self._options.must_arrive)
        name = self._options.remap.get(topic.name, topic.name)
        return self._node.create_publisher(message_class(topic.type_name), name, qos)

    # --- before the first message ---

    def _wait_for_listeners(self) -> None:
        """Wait until an image topic has a subscriber, and a little longer for the other topics."""
        images = {self._publishers[name].topic_name for name in self._options.topics if self._is_image(name)}
        if not (images and self._options.wait_for_subscribers):
            return
        _say(f'waiting for subscribers of {", ".join(sorted(images))}')
        if not self._wait_until(lambda: images.intersection(self._listeners.subscribed), self._options.discovery_timeout_s):
            wanted = self._listeners.image_topics_wanted(besides=images)
            hint = f'--remap to what is wanted here: {", ".join(wanted)}' if wanted else 'start the node'
            raise RosError(
                f'nobody subscribes to {" or ".join(sorted(images))} after {self._options.discovery_timeout_s:g} s: '
                f'{hint}, or play with --no-wait-for-subscribers'
            )
        if not self._wait_until(lambda: not self._listeners.unsubscribed, LATE_SUBSCRIBERS_S):
            _say(f'nobody subscribes to {", ".join(self._listeners.unsubscribed)}')

    def _choose_frames(self) -> None:
        """Choose the colour and the depth topic whose images are counted as frames."""
        images = [name for name in self._options.topics if self._is_image(name)]
        subscribed = self._listeners.subscribed
        images = [name for name in images if self._publishers[name].topic_name in subscribed] or images
        depths = [name for name in images if self._recording.is_depth(name)]
        colors = [name for name in images if name not in depths]
        self._color, self._depth = (next(iter(sorted(names)), None) for names in (colors, depths))
        if self._color is None and (self._answer_topics or self._options.rate is None):
            raise RosError('--wait-for and --rate max count colour images, and none are played')
        color = None if self._color is None else self._publishers[self._color]
        self._back_pressure.count_frames(color, has_depth=self._depth is not None, max_interval_ns=self._options.max_interval_ns)

    def _wait_for_answer_topic(self) -> None:
        for topic in self._answer_topics[:1]:
            if not self._wait_until(topic.discover, self._options.discovery_timeout_s):
                raise RosError(
                    f'nobody publishes {topic.name} after {self._options.discovery_timeout_s:g} s: start the node, '
                    'or name with --wait-for the topic that answers each frame'
                )

    def _wait_until(self, is_met: Callable[[], object], timeout_s: float) -> bool:
        """Returns False if a condition is not met in time."""
        deadline_s = time.monotonic() + timeout_s
        while not is_met():
            if time.monotonic() > deadline_s:
                return False
            self._step(STEP_S)
        return True

    # --- playing ---

    def _play_all(self) -> None:
        seconds = (self._options.end_ns - self._options.start_ns) / 1e9
        with tqdm(total=seconds, bar_format=BAR_FORMAT, disable=None, dynamic_ncols=True) as self._bar:
            if self._options.start_paused:
                self._controls.pause()
            self._play_once()
            while self._options.loop:
                _say('starting over')
                self._play_once()
            self._finish()

    def _play_once(self) -> None:
        self._back_pressure.backlog.restart()
        self._sim_clock.restart()
        self._clock.restart(self._options.start_ns)
        self._publish_earlier()
        self._rest(self._options.delay_s)
        with closing(self._messages()) as messages:
            for message in messages:
                self._wait_until_due(message.time_ns)
                if message.topic == self._color:
                    self._back_pressure.wait_for_capacity()
                self._publish(message)

    def _rest(self, seconds: float) -> None:
        """Let wall time pass, with the playback clock frozen."""
        until_s = time.monotonic() + seconds
        with self._clock.frozen():
            while (left_s := until_s - time.monotonic()) > 0:
                self._step(left_s)

    def _messages(self) -> Generator[RawMessage, None, None]:
        """Iterate over the messages to play, each as soon as it has been read."""
        options = self._options
        messages = self._recording.messages(options.topics, options.start_ns, options.end_ns + 1)
        with ReadAhead(messages, options.read_ahead) as ahead:
            while not ahead.is_over:
                message = ahead.take(STEP_S)
                if message is not None:
                    yield message
                else:
                    self._step(0.0)

    def _publish_earlier(self) -> None:
        """Publish messages from before the start that still hold: latched ones (such as ``/tf_static``), and the last camera infos.

        Some recorders write a camera info only once.
        """
        topics = [self._recording.topics[name] for name in self._options.topics]
        latched = [topic.name for topic in topics if is_latched(topic)]
        infos = [topic.name for topic in topics if topic.type_name == CAMERA_INFO and topic.name not in latched]
        start_ns = self._options.start_ns
        for message in (*self._recording.messages(latched, None, start_ns), *self._recording.last_before(infos, start_ns)):
            if len(message.data) >= SHORTEST_MESSAGE:
                self._publishers[message.topic].publish(message.data)

    def _wait_until_due(self, time_ns: int) -> None:
        self._step(self._clock.seconds_until(time_ns))
        while not self._is_due(time_ns):
            self._step(self._clock.seconds_until(time_ns) if not self._controls.is_paused else STEP_S)

    def _is_due(self, time_ns: int) -> bool:
        if self._controls.is_paused:
            return self._controls.take_step()
        return self._clock.seconds_until(time_ns) <= 0

    def _publish(self, message: RawMessage) -> None:
        self._sim_clock.before_message(message.topic, message.time_ns)
        if len(message.data) < SHORTEST_MESSAGE:
            self._num_damaged += 1
            return
        if not self._controls.is_paused:
            self._lateness.add(-self._clock.seconds_until(message.time_ns))
        self._publishers[message.topic].publish(message.data)
        self._num_messages += 1
        self._clock.published(message.time_ns)
        self._count(message)
        if self._bar is not None:
            self._bar.update((message.time_ns - self._options.start_ns) / 1e9 - self._bar.n)

    def _count(self, message: RawMessage) -> None:
        """Count an image; the node does not answer one whose stamp is damaged."""
        if message.topic not in (self._color, self._depth):
            return
        try:
            stamp_ns = serialized_stamp_ns(message.data)
        except MessageError:
            self._num_damaged += 1
            return
        if message.topic == self._color:
            self._back_pressure.backlog.color(stamp_ns)
        else:
            self._back_pressure.backlog.depth(stamp_ns)

    def _finish(self) -> None:
        """Wait until the last frame is answered and the last message has arrived."""
        with self._clock.frozen():
            self._back_pressure.wait_for_all()
            for publisher in self._publishers.values():
                self._wait_for_acknowledgement(publisher)
            if any(_has_best_effort_subscriber(self._node, publisher) for publisher in self._publishers.values()):
                time.sleep(LINGER_S)

    def _wait_for_acknowledgement(self, publisher: Publisher) -> None:
        timeout_s = self._options.acknowledge_timeout_s
        if not self._wait_until(lambda: is_acknowledged(publisher), timeout_s):
            raise PlaybackError(f'a subscriber of {publisher.topic_name} has not taken all messages within {timeout_s:g} s')

    def _summary(self, seconds: float) -> str:
        unpaired, late_ms = self._back_pressure.backlog.num_unpaired, self._lateness.p95_ms
        return (
            f'played {self._num_messages} messages in {seconds:.1f} s, '
            f'{self._back_pressure.backlog.num_colors} of them colour images'
            + (f'; {unpaired} of those have no depth image in the recording' if unpaired else '')
            + (f'; {self._num_damaged} messages are damaged' if self._num_damaged else '')
            + (f'; 95 % of all at most {late_ms:.1f} ms late' if self._clock.rate and late_ms is not None else '')
        )

    # --- between messages ---

    def _step(self, seconds: float) -> None:
        """Run ROS callbacks for up to some time, then handle signals, keys, clock and changes of the graph.

        Raises:
            PlaybackError: the listeners have left.
            Interrupted: by a signal.
        """
        self._executor.spin_once(timeout_sec=min(max(seconds, 0.0), STEP_S, self._sim_clock.period_s))
        if self._stop.requested:
            raise Interrupted(self.progress)
        if self._controls.is_stopped:
            raise _Stopped
        self._controls.handle_keys()
        self._back_pressure.notice_acknowledgements()
        self._sim_clock.tick()
        now_s = time.monotonic()
        if now_s >= self._check_graph_due_s:
            self._check_graph_due_s = now_s + CHECK_GRAPH_S
            self._check_graph()

    def _check_graph(self) -> None:
        """Stop if the listeners have left; subscribe to answer topics that have appeared.

        Raises:
            PlaybackError: the listeners have left.
        """
        lost = self._listeners.lost if self._options.wait_for_subscribers else []
        silent = [topic.name for topic in self._answer_topics[:1] if topic.is_gone]
        if lost or silent:
            who = f'the subscribers of {", ".join(lost)}' if lost else f'the publisher of {silent[0]}'
            raise PlaybackError(f'{who} left in mid-playback; {self.progress}')
        for topic in self._answer_topics[1:]:
            topic.discover()

    def _answered(self, stamp_ns: int) -> None:
        self._back_pressure.backlog.answered(stamp_ns)

    def _is_image(self, name: str) -> bool:
        return self._recording.topics[name].is_image


def _say(text: str) -> None:
    tqdm.write(f'splatam_bag_player: {text}')


def _is_awaited(topic: RecordedTopic) -> bool:
    """Returns True if playback waits for a subscriber of the topic."""
    return topic.is_image or topic.type_name == CAMERA_INFO


def _has_best_effort_subscriber(node: Node, publisher: Publisher) -> bool:
    """Returns True if a subscriber asked for best effort: such a subscriber acknowledges nothing."""
    subscribers = node.get_subscriptions_info_by_topic(publisher.topic_name)
    return any(subscriber.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT for subscriber in subscribers)
