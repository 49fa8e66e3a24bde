"""Plays a recording onto the ROS graph, and never runs ahead of those who listen."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from tqdm import tqdm

from msg_adapters import stamps
from splatam_core.errors import SplatamError
from splatam_ros.keyboard import Keyboard
from splatam_ros.listeners import Answers, Listeners
from splatam_ros.pacing import Backlog, PlaybackClock
from splatam_ros.process import RosError, StopRequest
from splatam_ros.recording import CAMERA_INFO, RawMessage, RecordedTopic, Recording, stamp_of

STEP_S = 0.05  # longest time without a look at keys, signals and the graph
LOOK_AROUND_S = 0.2
LATE_SUBSCRIBERS_S = 5.0  # after the first image topic is heard; discovery takes up to 3 s
QUIET_S = 3.0  # without an answer, before the player says what it waits for
IN_FLIGHT = 8  # frames ahead of the transport's acknowledgements, where no topic answers
IMAGE_DEPTH, OTHER_DEPTH = 50, 1000  # messages kept until they are acknowledged


class PlaybackError(SplatamError):
    """Playback ended before everything had arrived."""


class Interrupted(Exception):
    """A signal asked the player to stop."""


@dataclass(frozen=True, slots=True)
class Options:
    """How to play.

    Attributes:
        topics: names of the topics to play, as recorded.
        remap: from recorded names to names on the graph.
        rate: recording seconds in a wall second; None = as fast as the listeners allow.
        start_offset_s: recording time to leave out at the beginning.
        duration_s: recording time to play; None = to the end.
        loop: start over at the end.
        clock_hz: how often to publish ``/clock``; None = not at all.
        start_paused: wait for the space key before the first message.
        wait_for: the topics that answer frames: the first must come up, the others may. Empty = the transport.
        max_ahead: frames handed out beyond the newest answer.
        wait_timeout_s: longest wait for an answer.
        wait_for_subscribers: wait until the images are subscribed to, and stop when they no longer are.
        discovery_timeout_s: longest wait for subscribers and for the answering topic.
    """

    topics: tuple[str, ...]
    remap: dict[str, str]
    rate: float | None
    start_offset_s: float
    duration_s: float | None
    loop: bool
    clock_hz: float | None
    start_paused: bool
    wait_for: tuple[str, ...]
    max_ahead: int
    wait_timeout_s: float
    wait_for_subscribers: bool
    discovery_timeout_s: float


class Player:
    """One playback. ``play`` does it all; everything happens in the calling thread."""

    def __init__(
        self, node: Node, recording: Recording, options: Options, stop: StopRequest, keyboard: Keyboard
    ) -> None:
        """Create the publishers.

        Args:
            node: to publish with; the player spins it.
            recording: open.
            options: how to play.
            stop: ends playback when requested.
            keyboard: its space key pauses.
        """
        self._node = node
        self._recording = recording
        self._options = options
        self._stop = stop
        self._keyboard = keyboard
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(node)
        self._publishers = {name: self._create_publisher(recording.topics[name]) for name in options.topics}
        awaited = [self._publishers[name] for name in options.topics if _is_awaited(recording.topics[name])]
        self._listeners = Listeners(node, {publisher.topic_name: publisher for publisher in awaited})
        self._answers = [Answers(node, topic, self._answered) for topic in options.wait_for]
        self._clock_publisher = node.create_publisher(Clock, '/clock', 10) if options.clock_hz else None
        self._start_ns = recording.start_ns + round(options.start_offset_s * 1e9)
        self._end_ns = recording.end_ns
        if options.duration_s is not None:
            self._end_ns = min(self._end_ns, self._start_ns + round(options.duration_s * 1e9))
        self._clock = PlaybackClock(self._start_ns, options.rate)
        self._clock.freeze()  # until the first message is due
        self._color: str | None = None
        self._depth: str | None = None
        self._backlog = Backlog(needs_depth=False)
        self._is_paused = False
        self._num_messages = 0
        self._clock_due_s = self._look_around_due_s = 0.0
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
        self._wait_for_listeners()
        self._choose_frames()
        self._wait_for_answering_topic()
        self._listeners.watch()
        started_s = time.monotonic()
        seconds = (self._end_ns - self._start_ns) / 1e9
        layout = '{percentage:3.0f}%|{bar}| {n:.1f}/{total:.1f} s of the recording [{elapsed}<{remaining}{postfix}]'
        with tqdm(total=seconds, bar_format=layout, disable=None, dynamic_ncols=True) as self._bar:
            self._play_once()
            while self._options.loop:
                self._say('starting over')
                self._play_once()
            self._finish()
        return self._summary(time.monotonic() - started_s)

    @property
    def progress(self) -> str:
        """How far playback came, and the first frame that was not answered, if any."""
        images = f'{self._backlog.num_colors} colour images' if self._color else f'{self._num_messages} messages'
        first = self._backlog.first
        missing = f'first frame not answered: {first}' if first else 'every frame handed out was answered'
        return f'{images} handed out, {missing}'

    def _create_publisher(self, topic: RecordedTopic) -> Publisher:
        depth = max(topic.depth, IMAGE_DEPTH if topic.is_image else OTHER_DEPTH)
        durability = DurabilityPolicy.TRANSIENT_LOCAL if topic.is_latched else DurabilityPolicy.VOLATILE
        qos = QoSProfile(depth=depth, reliability=ReliabilityPolicy.RELIABLE, durability=durability)
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

    def _play_once(self) -> None:
        self._backlog.restart()
        self._clock = PlaybackClock(self._start_ns, self._options.rate)
        self._is_paused = False
        if self._options.start_paused and self._num_messages == 0:
            self._toggle_pause()
        self._publish_latched()
        for message in self._recording.messages(self._options.topics, self._start_ns, self._end_ns + 1):
            self._wait_until_due(message.time_ns)
            if message.topic == self._color:
                self._wait_for_room()
            self._publish(message)

    def _publish_latched(self) -> None:
        """What was latched before the start, ``/tf_static`` say, is still true at the start."""
        latched = [name for name in self._options.topics if self._recording.topics[name].is_latched]
        for message in self._recording.messages(latched, None, self._start_ns):
            self._publishers[message.topic].publish(message.data)

    def _wait_until_due(self, time_ns: int) -> None:
        self._step(self._clock.seconds_until(time_ns))
        while self._is_paused or self._clock.seconds_until(time_ns) > 0:
            self._step(STEP_S if self._is_paused else self._clock.seconds_until(time_ns))

    def _wait_for_room(self) -> None:
        limit = self._options.max_ahead if self._answers else IN_FLIGHT
        self._wait_for_answers(lambda: self._backlog.waiting < limit)

    def _publish(self, message: RawMessage) -> None:
        self._publishers[message.topic].publish(message.data)
        self._num_messages += 1
        self._clock.published(message.time_ns)
        if message.topic == self._color:
            self._backlog.color(stamp_of(message.data))
        elif message.topic == self._depth:
            self._backlog.depth(stamp_of(message.data))
        if self._bar is not None:
            self._bar.update((message.time_ns - self._start_ns) / 1e9 - self._bar.n)

    def _finish(self) -> None:
        """Wait until the last frame is answered and the last message has arrived."""
        self._clock.freeze()
        self._wait_for_answers(lambda: self._backlog.waiting == 0)
        for publisher in self._publishers.values():
            if not self._wait_until(lambda: _is_acknowledged(publisher), self._options.wait_timeout_s):  # noqa: B023
                raise PlaybackError(
                    f'a subscriber of {publisher.topic_name} has not taken all messages '
                    f'within {self._options.wait_timeout_s:g} s'
                )

    def _summary(self, seconds: float) -> str:
        unpaired = self._backlog.num_unpaired
        return (
            f'played {self._num_messages} messages in {seconds:.1f} s, {self._backlog.num_colors} of them colour images'
            + (f'; {unpaired} of those have no depth image in the recording' if unpaired else '')
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
        self._executor.spin_once(timeout_sec=min(max(seconds, 0.0), STEP_S, self._clock_period_s()))
        if self._stop.requested:
            raise Interrupted(self.progress)
        if self._keyboard.pressed() == ' ':
            self._toggle_pause()
        if not self._answers and self._color and _is_acknowledged(self._publishers[self._color]):
            self._backlog.all_answered()
        now_s = time.monotonic()
        if self._clock_publisher is not None and now_s >= self._clock_due_s:
            self._clock_due_s = now_s + self._clock_period_s()
            self._publish_clock(self._clock_publisher)
        if now_s >= self._look_around_due_s:
            self._look_around_due_s = now_s + LOOK_AROUND_S
            self._look_around()

    def _clock_period_s(self) -> float:
        return 1 / self._options.clock_hz if self._options.clock_hz else STEP_S

    def _publish_clock(self, publisher: Publisher) -> None:
        message = Clock()
        message.clock.sec, message.clock.nanosec = stamps.from_ns(self._clock.now_ns())
        publisher.publish(message)

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

    def _toggle_pause(self) -> None:
        self._is_paused = not self._is_paused
        if self._is_paused:
            self._clock.freeze()
        else:
            self._clock.thaw()
        key = 'space goes on' if self._keyboard.is_attached else 'no terminal to press space in'
        self._say(f'paused ({key})' if self._is_paused else 'playing')

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
