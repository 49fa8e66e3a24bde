"""Decides when the player may publish the next message: playback time, and frames that are not answered yet."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from msg_adapters.interval import PairInterval
from splatam_core.geometry.trajectory import stamp_text

MIN_RATE, MAX_RATE = 1e-6, 1e6


def why_no_rate(value: object) -> str:
    """Returns why a value cannot be the rate of playback; empty if it can."""
    if type(value) in (int, float) and MIN_RATE <= value <= MAX_RATE:  # type: ignore[operator]
        return ''
    return f'rate = {value!r}: expected a number above 0, from {MIN_RATE:g} to {MAX_RATE:g}'


class PlaybackClock:
    """Recording time that runs at a multiple of wall time, and stands still while frozen."""

    def __init__(self, start_ns: int, rate: float | None) -> None:
        """Start the clock.

        Args:
            start_ns: recording time now.
            rate: recording seconds per wall second; None = as fast as messages can be published.
        """
        self._rate = rate
        self._freezes = 0
        self.restart(start_ns)

    @property
    def rate(self) -> float | None:
        """Recording seconds per wall second; None = as fast as messages can be published."""
        return self._rate

    @rate.setter
    def rate(self, rate: float | None) -> None:
        self.restart(self.now_ns())
        self._rate = rate

    def restart(self, start_ns: int) -> None:
        """Set the recording time."""
        self._anchor_ns = start_ns
        self._anchor_s = time.monotonic()

    def now_ns(self) -> int:
        """Recording time now."""
        if self._rate is None or self._freezes:
            return self._anchor_ns
        return self._anchor_ns + round((time.monotonic() - self._anchor_s) * self._rate * 1e9)

    def seconds_until(self, time_ns: int) -> float:
        """Wall time until a message of this recording time is due; negative when it is late."""
        return 0.0 if self._rate is None else (time_ns - self.now_ns()) / (self._rate * 1e9)

    def published(self, time_ns: int) -> None:
        """Tell the clock that a message was published. While time does not run by itself, the message sets it."""
        if self._rate is None or self._freezes:
            self._anchor_ns = max(self._anchor_ns, time_ns)

    def freeze(self) -> None:
        """Stop the clock; it runs again after as many calls of ``thaw``."""
        self._anchor_ns = self.now_ns()
        self._freezes += 1

    def thaw(self) -> None:
        """Let the clock run on from where it stopped."""
        self._freezes -= 1
        self._anchor_s = time.monotonic()

    @contextmanager
    def frozen(self) -> Iterator[None]:
        """Stop the clock during a ``with`` block, so that time spent waiting is not caught up afterwards."""
        self.freeze()
        try:
            yield
        finally:
            self.thaw()


class Lateness:
    """How late the last messages were published, in wall time."""

    KEPT = 100_000

    def __init__(self) -> None:
        self._late_s: deque[float] = deque(maxlen=self.KEPT)

    def add(self, seconds: float) -> None:
        """Record one message."""
        self._late_s.append(max(0.0, seconds))

    @property
    def p95_ms(self) -> float | None:
        """95th percentile of the lateness in milliseconds; None before the first message."""
        late_s = sorted(self._late_s)
        return 1e3 * late_s[math.ceil(0.95 * len(late_s)) - 1] if late_s else None


@dataclass(slots=True)
class PublishedColor:
    """A colour image that was published and not answered yet.

    Attributes:
        number: counts the colour images of the playback from 1.
        stamp_ns: its stamp.
        is_complete: True if its depth image has been published too.
    """

    number: int
    stamp_ns: int
    is_complete: bool

    def __str__(self) -> str:
        return f'{stamp_text(self.stamp_ns)} (image {self.number})'


class Backlog:
    """Frames that were published and not answered. A frame is a colour image with its depth image.

    A colour image without depth image in the recording is no frame, because the node cannot answer it.
    """

    NUM_DEPTHS = 100  # depth stamps remembered; messages of one instant are close together in a recording

    def __init__(self, needs_depth: bool, max_interval_ns: int | None = None) -> None:
        """Start empty.

        Args:
            needs_depth: True if a colour image is a frame only with its depth image.
            max_interval_ns: largest distance of the two, the node's ``sync.max_interval``; None adapts it to the rate, as the node.
        """
        self.num_colors = 0
        self._interval = PairInterval(max_interval_ns)
        self._num_unpaired = 0
        self._needs_depth = needs_depth
        self._unanswered: deque[PublishedColor] = deque()
        self._depths_ns: deque[int] = deque(maxlen=self.NUM_DEPTHS)

    @property
    def waiting(self) -> int:
        """Number of frames that are not answered."""
        return sum(image.is_complete for image in self._unanswered)

    @property
    def first(self) -> PublishedColor | None:
        """The first frame that is not answered."""
        return next((image for image in self._unanswered if image.is_complete), None)

    @property
    def num_unpaired(self) -> int:
        """Number of colour images without a depth image."""
        return self._num_unpaired + sum(not image.is_complete for image in self._unanswered)

    def color(self, stamp_ns: int) -> None:
        """Record that a colour image was published."""
        self.num_colors += 1
        self._interval.add_color(stamp_ns)
        interval_ns = self._interval.ns
        is_complete = not self._needs_depth or any(abs(stamp_ns - depth_ns) <= interval_ns for depth_ns in self._depths_ns)
        self._unanswered.append(PublishedColor(self.num_colors, stamp_ns, is_complete))

    def depth(self, stamp_ns: int) -> None:
        """Record that a depth image was published."""
        self._depths_ns.append(stamp_ns)
        interval_ns = self._interval.ns
        for image in self._unanswered:
            image.is_complete |= abs(image.stamp_ns - stamp_ns) <= interval_ns

    def answered(self, stamp_ns: int) -> None:
        """Record that the frame with this stamp, and all frames before it, are processed."""
        while self._unanswered and self._unanswered[0].stamp_ns <= stamp_ns:
            image = self._unanswered.popleft()
            self._num_unpaired += not image.is_complete and image.stamp_ns != stamp_ns

    def all_answered(self) -> None:
        """Record that everything published so far has arrived."""
        self._unanswered.clear()

    def restart(self) -> None:
        """Forget all stamps, because the recording starts over."""
        self._num_unpaired = self.num_unpaired
        self._unanswered.clear()
        self._depths_ns.clear()
