"""Plays a recording onto the ROS graph, and never runs ahead of those who listen."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator
from contextlib import closing

from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import ReliabilityPolicy
from tqdm import tqdm

from splatam_core.errors import SplatamError
from splatam_ros.player.controls import Controls
from splatam_ros.player.keyboard import Keyboard
from splatam_ros.player.listeners import Answers, Listeners
from splatam_ros.player.offered_qos import publisher_qos
from splatam_ros.player.pacing import Backlog, Lateness, PlaybackClock
from splatam_ros.player.playback_options import Options
from splatam_ros.player.read_ahead import ReadAhead
from splatam_ros.player.recording import CAMERA_INFO, RawMessage, RecordedTopic, Recording, stamp_of
from splatam_ros.player.sim_clock import SimClock
from splatam_ros.process import RosError, StopRequest

STEP_S = 0.05  # longest time without a look at keys, signals and the graph
LOOK_AROUND_S = 0.2
LATE_SUBSCRIBERS_S = 5.0  # after the first image topic is heard; discovery takes up to 3 s
QUIET_S = 3.0  # without an answer, before the player says what it waits for
LINGER_S = 0.5  # at the end, for subscribers that acknowledge nothing: what they have not taken goes with us
IN_FLIGHT = 8  # frames ahead of the transport's acknowledgements, where no topic answers


class PlaybackError(SplatamError):
    """Playback ended before everything had arrived."""


class Interrupted(Exception):
    """A signal asked the player to stop."""


class _Stopped(Exception):
    """A service asked the player to stop."""


class Player:
    """One playback. ``play`` does it all; everything happens in the calling thread."""

    def __init__(self, node: Node, recording: Recording, options: Options, stop: StopRequest, keyboard: Keyboard) -> None:
        """Create the publishers.

        Args:
            node: to publish with; the player spins it.
            recording: open.
            options: how to play.
            stop: ends playback when requested.
            keyboard: steers playback too.
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
        self._answers = [Answers(node, topic, self._answered) for topic in options.wait_for]
        self._clock = PlaybackClock(options.start_ns, options.rate)
        self._sim_clock = SimClock(node, self._clock, options.clock_hz, options.clock_topics)
        self._controls = Controls(node, self._clock, keyboard, self._say)
        self._color: str | None = None
        self._depth: str | None = None
        self._backlog = Backlog(needs_depth=False)
        self._lateness = Lateness()
        self._num_messages = 0
        self._look_around_due_s = 0.0
        self._quiet_s = QUIET_S
        self._bar: tqdm | None = None

    def play(self) -> str:
        """Play it all. What was played, in one line.

        Raises:
            RosError: nobody listens, or nobody answers.
            PlaybackError: listeners left, or a frame was not answered in time.
            DatasetError: the recording breaks off.
            Interrupted: by a signal.
        """
        started_s = time.monotonic()
        try:
            with self._clock.frozen():
                self._clock.restart(self._options.start_ns)
                self._wait_for_listeners()
                self._choose_frames()
                self._wait_for_answering_topic()
            self._listeners.watch()
            started_s = time.monotonic()
            self._play_all()
        except _Stopped:
            return f'stopped; {self._summary(time.monotonic() - started_s)}'
        return self._summary(time.monotonic() - started_s)

    @property
    def progress(self) -> str:
        """How far playback came, and the first frame that was not answered, if any."""
        images = f'{self._backlog.num_colors} colour images' if self._color else f'{self._num_messages} messages'
        first = self._backlog.first
        missing = f'first frame not answered: {first}' if first else 'every frame handed out was answered'
        return f'{images} handed out, {missing}'

    def _create_publisher(self, topic: RecordedTopic) -> Publisher:
        qos = publisher_qos(topic, self._options.qos.get(topic.name, {}), self._options.must_arrive)
        return self._node.create_publisher(topic.message_class, self._options.remap.get(topic.name, topic.name), qos)

    # --- before the first message ---

    def _wait_for_listeners(self) -> None:
        """Wait until images are subscribed to, and a little longer for the rest."""
        images = {self._publishers[name].topic_name for name in self._options.topics if self._is_image(name)}
        if not (images and self._options.wait_for_subscribers):
            return
        self._say(f'waiting for subscribers of {", ".join(sorted(images))}')
        if not self._wait_until(lambda: images.intersection(self._listeners.heard), self._options.discovery_timeout_s):
            wanted = self._listeners.image_topics_wanted(besides=images)
            hint = f'--remap to what is wanted here: {", ".join(wanted)}' if wanted else 'start the node'
            raise RosError(
                f'nobody subscribes to {" or ".join(sorted(images))} after {self._options.discovery_timeout_s:g} s: '
                f'{hint}, or play with --no-wait-for-subscribers'
            )
        if not self._wait_until(lambda: not self._listeners.unheard, LATE_SUBSCRIBERS_S):
            self._say(f'nobody subscribes to {", ".join(self._listeners.unheard)}')

    def _choose_frames(self) -> None:
        """Which colour and which depth topic make the frames that are counted."""
        images = [name for name in self._options.topics if self._is_image(name)]
        heard = self._listeners.heard
        images = [name for name in images if self._publishers[name].topic_name in heard] or images
        depths = [name for name in images if self._recording.is_depth(name)]
        colors = [name for name in images if name not in depths]
        self._color, self._depth = (next(iter(sorted(names)), None) for names in (colors, depths))
        self._backlog = Backlog(needs_depth=bool(self._answers) and self._depth is not None)
        if self._color is None and (self._answers or self._options.rate is None):
            raise RosError('--wait-for and --rate max count colour images, and none are played')

    def _wait_for_answering_topic(self) -> None:
        for answers in self._answers[:1]:
            if not self._wait_until(answers.discover, self._options.discovery_timeout_s):
                raise RosError(
                    f'nobody publishes {answers.topic} after {self._options.discovery_timeout_s:g} s: start the node, '
                    'or name with --wait-for the topic that answers each frame'
                )

    def _wait_until(self, condition: Callable[[], object], timeout_s: float) -> bool:
        deadline_s = time.monotonic() + timeout_s
        while not condition():
            if time.monotonic() > deadline_s:
                return False
            self._step(STEP_S)
        return True

    # --- playing ---

    def _play_all(self) -> None:
        seconds = (self._options.end_ns - self._options.start_ns) / 1e9
        layout = '{percentage:3.0f}%|{bar}| {n:.1f}/{total:.1f} s of the recording [{elapsed}<{remaining}{postfix}]'
        with tqdm(total=seconds, bar_format=layout, disable=None, dynamic_ncols=True) as self._bar:
            if self._options.start_paused:
                self._controls.pause()
            self._play_once()
            while self._options.loop:
                self._say('starting over')
                self._play_once()
            self._finish()

    def _play_once(self) -> None:
        self._backlog.restart()
        self._sim_clock.restart()
        self._clock.restart(self._options.start_ns)
        self._publish_latched()
        self._rest(self._options.delay_s)
        with closing(self._messages()) as messages:
            for message in messages:
                self._wait_until_due(message.time_ns)
                if message.topic == self._color:
                    self._wait_for_room()
                self._publish(message)

    def _rest(self, seconds: float) -> None:
        until_s = time.monotonic() + seconds
        with self._clock.frozen():
            while (left_s := until_s - time.monotonic()) > 0:
                self._step(left_s)

    def _messages(self) -> Generator[RawMessage, None, None]:
        """What is to be played, as soon as it has been read."""
        options = self._options
        messages = self._recording.messages(options.topics, options.start_ns, options.end_ns + 1)
        with ReadAhead(messages, options.read_ahead) as ahead:
            while not ahead.is_over:
                message = ahead.take(STEP_S)
                if message is not None:
                    yield message
                else:
                    self._step(0.0)

    def _publish_latched(self) -> None:
        """What was latched before the start, ``/tf_static`` say, is still true at the start."""
        latched = [name for name in self._options.topics if self._recording.topics[name].is_latched]
        for message in self._recording.messages(latched, None, self._options.start_ns):
            self._publishers[message.topic].publish(message.data)

    def _wait_until_due(self, time_ns: int) -> None:
        self._step(self._clock.seconds_until(time_ns))
        while not self._may_go(time_ns):
            self._step(self._clock.seconds_until(time_ns) if not self._controls.is_paused else STEP_S)

    def _may_go(self, time_ns: int) -> bool:
        if self._controls.is_paused:
            return self._controls.take_step()
        return self._clock.seconds_until(time_ns) <= 0

    def _wait_for_room(self) -> None:
        limit = self._options.max_ahead if self._answers else IN_FLIGHT
        self._wait_for_answers(lambda: self._backlog.waiting < limit)

    def _publish(self, message: RawMessage) -> None:
        self._sim_clock.message_due(message.topic, message.time_ns)
        if not self._controls.is_paused:
            self._lateness.add(-self._clock.seconds_until(message.time_ns))
        self._publishers[message.topic].publish(message.data)
        self._num_messages += 1
        self._clock.published(message.time_ns)
        if message.topic == self._color:
            self._backlog.color(stamp_of(message.data))
        elif message.topic == self._depth:
            self._backlog.depth(stamp_of(message.data))
        if self._bar is not None:
            self._bar.update((message.time_ns - self._options.start_ns) / 1e9 - self._bar.n)

    def _finish(self) -> None:
        """Wait until the last frame is answered and the last message has arrived."""
        with self._clock.frozen():
            self._wait_for_answers(lambda: self._backlog.waiting == 0)
            for publisher in self._publishers.values():
                self._wait_for_acknowledgement(publisher)
            if any(_acknowledges_nothing(self._node, publisher) for publisher in self._publishers.values()):
                time.sleep(LINGER_S)

    def _wait_for_acknowledgement(self, publisher: Publisher) -> None:
        timeout_s = self._options.acknowledge_timeout_s
        if not self._wait_until(lambda: _is_acknowledged(publisher), timeout_s):
            raise PlaybackError(f'a subscriber of {publisher.topic_name} has not taken all messages within {timeout_s:g} s')

    def _summary(self, seconds: float) -> str:
        unpaired, late_ms = self._backlog.num_unpaired, self._lateness.p95_ms
        return (
            f'played {self._num_messages} messages in {seconds:.1f} s, {self._backlog.num_colors} of them colour images'
            + (f'; {unpaired} of those have no depth image in the recording' if unpaired else '')
            + (f'; 95 % of all at most {late_ms:.1f} ms late' if self._clock.rate and late_ms is not None else '')
        )

    # --- answers ---

    def _answered(self, stamp_ns: int) -> None:
        self._backlog.answered(stamp_ns)

    def _wait_for_answers(self, condition: Callable[[], bool]) -> None:
        """Hold playback until a condition on the backlog is met; say so when it takes long.

        Raises:
            PlaybackError: no frame was answered for the whole time-out.
        """
        if condition():
            return
        first, since_s = self._backlog.first, time.monotonic()
        with self._clock.frozen():
            while not condition():
                self._step(STEP_S)
                if self._backlog.first is not first:
                    if time.monotonic() - since_s < QUIET_S:
                        self._quiet_s = QUIET_S
                    first, since_s = self._backlog.first, time.monotonic()
                self._judge_silence(time.monotonic() - since_s)

    def _judge_silence(self, silent_s: float) -> None:
        where = f'on {self._answers[0].topic}' if self._answers else 'from its subscribers'
        if silent_s > self._options.wait_timeout_s:
            raise PlaybackError(f'no answer {where} for {silent_s:.0f} s; {self.progress}')
        if silent_s > self._quiet_s:
            self._say(f'no answer {where} for {silent_s:.0f} s, still waiting; {self.progress}')
            self._quiet_s *= 2  # a slow node is no news each time

    # --- one turn of the loop ---

    def _step(self, seconds: float) -> None:
        """Give ROS up to some time, then look at signals, keys, clock and graph."""
        self._executor.spin_once(timeout_sec=min(max(seconds, 0.0), STEP_S, self._sim_clock.period_s))
        if self._stop.requested:
            raise Interrupted(self.progress)
        if self._controls.is_stopped:
            raise _Stopped
        self._controls.look_at_keys()
        if not self._answers and self._color and _is_acknowledged(self._publishers[self._color]):
            self._backlog.all_answered()
        self._sim_clock.tick()
        now_s = time.monotonic()
        if now_s >= self._look_around_due_s:
            self._look_around_due_s = now_s + LOOK_AROUND_S
            self._look_around()

    def _look_around(self) -> None:
        """Notice who has come and who has left.

        Raises:
            PlaybackError: those we play for have left.
        """
        gone = self._listeners.gone if self._options.wait_for_subscribers else []
        silent = [answers.topic for answers in self._answers[:1] if answers.is_gone]
        if gone or silent:
            who = f'the subscribers of {", ".join(gone)}' if gone else f'the publisher of {silent[0]}'
            raise PlaybackError(f'{who} left in mid-playback; {self.progress}')
        for answers in self._answers[1:]:
            answers.discover()

    def _is_image(self, name: str) -> bool:
        return self._recording.topics[name].is_image

    def _say(self, text: str) -> None:
        tqdm.write(f'splatam_bag_player: {text}')


def _is_awaited(topic: RecordedTopic) -> bool:
    """Whether playback waits for somebody to subscribe to it."""
    return topic.is_image or topic.type_name == CAMERA_INFO


def _is_acknowledged(publisher: Publisher) -> bool:
    """Whether every reliable subscriber has everything that was published."""
    return publisher.wait_for_all_acked(Duration(seconds=0))


def _acknowledges_nothing(node: Node, publisher: Publisher) -> bool:
    """Whether a subscriber has asked for best effort."""
    subscribers = node.get_subscriptions_info_by_topic(publisher.topic_name)
    return any(subscriber.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT for subscriber in subscribers)
