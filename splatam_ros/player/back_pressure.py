"""Holds playback until frames have been processed, or, without ``--wait-for``, received."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from rclpy.duration import Duration
from rclpy.publisher import Publisher

from splatam_core.errors import SplatamError
from splatam_ros.player.listeners import AnswerTopic
from splatam_ros.player.pacing import Backlog, PlaybackClock

IN_FLIGHT = 8  # frames ahead of the transport's acknowledgements, where no topic answers
QUIET_S = 3.0  # without an answer, until the player says what it waits for
POLL_S = 0.05


class PlaybackError(SplatamError):
    """Playback ended before everything had arrived."""


class BackPressure:
    """Counts the frames that were published, and makes playback wait for those that listen.

    A frame is answered by a message with its stamp on an answer topic. Without answer topics, all frames count as
    answered whenever the reliable subscribers have acknowledged everything.

    Attributes:
        backlog: the frames that were published and not answered.
    """

    def __init__(
        self,
        answer_topics: Sequence[AnswerTopic],
        clock: PlaybackClock,
        *,
        max_ahead: int,
        timeout_s: float,
        step: Callable[[float], None],
        say: Callable[[str], None],
    ) -> None:
        """Start without frames.

        Args:
            answer_topics: the first one's publisher is named when answers fail to come.
            clock: is frozen while playback waits.
            max_ahead: number of frames that may be unanswered, with answer topics.
            timeout_s: longest wait for an answer.
            step: runs the player's node for up to some seconds.
            say: shows a message to the user.
        """
        self.backlog = Backlog(needs_depth=False)
        self._answer_topics = answer_topics
        self._clock = clock
        self._limit = max_ahead if answer_topics else IN_FLIGHT
        self._timeout_s = timeout_s
        self._step = step
        self._say = say
        self._quiet_s = QUIET_S
        self._color: Publisher | None = None

    def count_frames(self, color: Publisher | None, *, has_depth: bool, max_interval_ns: int | None) -> None:
        """Say which images are frames.

        Args:
            color: publishes the colour images; None if none are played.
            has_depth: True if depth images are played, which a frame then needs too.
            max_interval_ns: largest distance of colour and depth of a frame; None adapts it to the rate.
        """
        self._color = color
        self.backlog = Backlog(bool(self._answer_topics) and has_depth, max_interval_ns)

    def notice_acknowledgements(self) -> None:
        """Count all frames as answered if no topic answers and everything has been acknowledged."""
        if not self._answer_topics and self._color is not None and is_acknowledged(self._color):
            self.backlog.all_answered()

    def wait_for_capacity(self) -> None:
        """Wait until another frame may be published.

        Raises:
            PlaybackError: no frame was answered before the time-out.
        """
        self._wait_for_answers(lambda: self.backlog.waiting < self._limit)

    def wait_for_all(self) -> None:
        """Wait until every frame is answered.

        Raises:
            PlaybackError: no frame was answered before the time-out.
        """
        self._wait_for_answers(lambda: self.backlog.waiting == 0)

    @property
    def missing(self) -> str:
        """The first frame that was not answered, in words."""
        first = self.backlog.first
        return f'first frame not answered: {first}' if first else 'every frame handed out was answered'

    @property
    def progress(self) -> str:
        """How many colour images were published and which frame is missing, in words."""
        return f'{self.backlog.num_colors} colour images handed out, {self.missing}'

    def _wait_for_answers(self, is_met: Callable[[], bool]) -> None:
        if is_met():
            return
        first, since_s = self.backlog.first, time.monotonic()
        with self._clock.frozen():
            while not is_met():
                self._step(POLL_S)
                if self.backlog.first is not first:
                    if time.monotonic() - since_s < QUIET_S:
                        self._quiet_s = QUIET_S
                    first, since_s = self.backlog.first, time.monotonic()
                self._check_quiet(time.monotonic() - since_s)

    def _check_quiet(self, quiet_s: float) -> None:
        """Tell the user, or give up, if the oldest frame has waited long for its answer."""
        where = f'on {self._answer_topics[0].name}' if self._answer_topics else 'from its subscribers'
        if quiet_s > self._timeout_s:
            raise PlaybackError(f'no answer {where} for {quiet_s:.0f} s; {self.progress}')
        if quiet_s > self._quiet_s:
            self._say(f'no answer {where} for {quiet_s:.0f} s, still waiting; {self.progress}')
            self._quiet_s *= 2  # a node that is slow throughout need not be reported for each frame


def is_acknowledged(publisher: Publisher) -> bool:
    """Returns True if every reliable subscriber has received everything that was published."""
    return publisher.wait_for_all_acked(Duration(seconds=0))
