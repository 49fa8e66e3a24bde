"""Pairs colour, depth and CameraInfo by stamp, for live topics and bags alike.

Messages are opaque objects: this module needs no ROS and no threads. Callers from several threads must hold a lock
around the calls.
"""

from __future__ import annotations

from bisect import insort
from collections import OrderedDict, deque
from dataclasses import dataclass
from typing import Any, Literal

from msg_adapters.epochs import EpochClock
from msg_adapters.interval import PairInterval
from msg_adapters.pairing import Key, first_pair

Mode = Literal['exact', 'approximate']


@dataclass(frozen=True, slots=True, eq=False)
class RgbdSet:
    """Messages that belong together.

    Attributes:
        stamp_ns: the colour's stamp; increases from set to set until ``resets`` changes.
        color, depth, info: the messages, as they were added.
        resets: number of backward jumps of time before this set.
        gap_ns: depth's stamp minus colour's.
    """

    stamp_ns: int
    color: Any
    depth: Any
    info: Any
    resets: int
    gap_ns: int


@dataclass(frozen=True, slots=True)
class SyncStatistics:
    """Counts of messages since the start. Each received message is in a set, dropped or waiting.

    Attributes:
        received_color, received_depth, received_info: messages added.
        sets: sets returned.
        unpaired_color, unpaired_depth: dropped; no partner came in time, or the queue was full.
        duplicates: dropped; a message of the same stream and stamp was already waiting or paired.
        late: dropped; a newer set had already been formed.
        without_info: pairs dropped because no CameraInfo came.
        resets: backward jumps of time after which there was a set.
        waiting_color, waiting_depth: messages waiting for their partner.
        waiting_pairs: pairs waiting for the first CameraInfo.
        gap_ns: depth's stamp minus colour's in the newest pair; None before the first.
        newest_gap_ns: depth's stamp minus colour's of the last received, paired or not; None without both.
        max_interval_ns: largest distance of partners now.
    """

    received_color: int
    received_depth: int
    received_info: int
    sets: int
    unpaired_color: int
    unpaired_depth: int
    duplicates: int
    late: int
    without_info: int
    resets: int
    waiting_color: int
    waiting_depth: int
    waiting_pairs: int
    gap_ns: int | None
    newest_gap_ns: int | None
    max_interval_ns: int


class RgbdSynchronizer:
    """Pairs the messages of three streams; each call returns the sets it completed, in order of their stamps.

    - Exact mode pairs equal stamps. Approximate mode pairs the nearest stamps within ``max_interval_ns``, and returns
      a pair once no better partner can come; so an inexact pair waits for the next message.
    - Sets are returned in the order of their stamps, and each message is in at most one set. A message older than the
      last set is dropped; a message that is less late still finds its partner.
    - A stamp more than ``jump_ns`` before its stream's newest starts a new epoch (a bag loops). The old
      epoch ends when the new one has its first pair; until then its late messages still pair.
    - A pair gets the CameraInfo with the stamp of its colour image if that has arrived, else the newest one.
      Pairs wait for the first CameraInfo.
    - At most ``queue_size`` messages of each stream, pairs without info, and infos are kept; the oldest are dropped first.
    """

    def __init__(
        self,
        mode: Mode = 'exact',
        max_interval_ns: int | None = 20_000_000,
        queue_size: int = 30,
        jump_ns: int = 1_000_000_000,
    ) -> None:
        """Make a synchronizer.

        Args:
            mode: 'exact' or 'approximate'.
            max_interval_ns: largest distance of partners in approximate mode; None adapts it to the rate, see ``PairInterval``.
            queue_size: number of messages of a stream that may wait.
            jump_ns: a stream whose stamps jump back by more than this has restarted.

        Raises:
            ValueError: a value is out of its range.
        """
        if mode not in ('exact', 'approximate'):
            raise ValueError(f"synchronizer mode '{mode}' must be 'exact' or 'approximate'")
        if (max_interval_ns is not None and max_interval_ns < 0) or queue_size < 1 or jump_ns < 0:
            raise ValueError(
                f'synchronizer max_interval_ns={max_interval_ns} queue_size={queue_size} jump_ns={jump_ns}: '
                'the queue must hold at least 1 message, the times must not be negative'
            )
        self._interval = PairInterval(max_interval_ns if mode == 'approximate' else 0)
        self._clock = EpochClock(jump_ns)
        self._color = _Stream('color', queue_size)
        self._depth = _Stream('depth', queue_size)
        self._infos = _Infos(queue_size)
        self._pairs: deque[_Pair] = deque()
        self._queue_size = queue_size
        self._epoch = 0
        self._resets = self._sets = self._without_info = 0
        self._gap_ns: int | None = None

    def add_color(self, stamp_ns: int, message: Any) -> list[RgbdSet]:
        """Add a colour image. Returns the sets that it completes."""
        self._interval.add_color(stamp_ns)
        return self._add(self._color, stamp_ns, message)

    def add_depth(self, stamp_ns: int, message: Any) -> list[RgbdSet]:
        """Add a depth image. Returns the sets that it completes."""
        return self._add(self._depth, stamp_ns, message)

    def add_info(self, stamp_ns: int, message: Any) -> list[RgbdSet]:
        """Add a CameraInfo. Returns the sets that waited for the first one."""
        self._infos.add(stamp_ns, message)
        return self._release()

    def flush(self) -> list[RgbdSet]:
        """End the recording. Returns the sets that can still be made; the remaining messages are dropped and counted."""
        self._form_pairs(is_final=True)
        sets = self._release()
        self._color.drop_all()
        self._depth.drop_all()
        self._without_info += len(self._pairs)
        self._pairs.clear()
        return sets

    @property
    def max_interval_ns(self) -> int:
        """Largest distance of partners now."""
        return self._interval.ns

    @property
    def statistics(self) -> SyncStatistics:
        """The counts until now."""
        color, depth = self._color, self._depth
        newest_gap_ns = None
        if color.newest_ns is not None and depth.newest_ns is not None:
            newest_gap_ns = depth.newest_ns - color.newest_ns
        return SyncStatistics(
            received_color=color.received,
            received_depth=depth.received,
            received_info=self._infos.received,
            sets=self._sets,
            unpaired_color=color.unpaired,
            unpaired_depth=depth.unpaired,
            duplicates=color.duplicates + depth.duplicates,
            late=color.late + depth.late,
            without_info=self._without_info,
            resets=self._resets,
            waiting_color=len(color.keys),
            waiting_depth=len(depth.keys),
            waiting_pairs=len(self._pairs),
            gap_ns=self._gap_ns,
            newest_gap_ns=newest_gap_ns,
            max_interval_ns=self._interval.ns,
        )

    def _add(self, stream: _Stream, stamp_ns: int, message: Any) -> list[RgbdSet]:
        stream.add(Key(self._clock.epoch_of(stream.name, stamp_ns), stamp_ns), message)
        self._form_pairs()
        stream.drop_overflow()
        return self._release()

    def _form_pairs(self, is_final: bool = False) -> None:
        while pair := first_pair(self._color.keys, self._depth.keys, self._interval.ns, is_final):
            self._form_pair(*pair)
        while len(self._pairs) > self._queue_size and not self._infos.is_known:
            self._pairs.popleft()
            self._without_info += 1

    def _form_pair(self, color: Key, depth: Key) -> None:
        self._resets += color.epoch != self._epoch
        self._epoch = color.epoch
        self._clock.close_before(color.epoch)
        self._gap_ns = depth.stamp_ns - color.stamp_ns
        self._pairs.append(_Pair(color.stamp_ns, self._color.take(color), self._depth.take(depth), self._resets, self._gap_ns))

    def _release(self) -> list[RgbdSet]:
        if not self._infos.is_known:
            return []
        sets = [
            RgbdSet(pair.stamp_ns, pair.color, pair.depth, self._infos.at(pair.stamp_ns), pair.resets, pair.gap_ns)
            for pair in self._pairs
        ]
        self._pairs.clear()
        self._sets += len(sets)
        return sets


@dataclass(frozen=True, slots=True)
class _Pair:
    """A set without CameraInfo."""

    stamp_ns: int
    color: Any
    depth: Any
    resets: int
    gap_ns: int


class _Stream:
    """The waiting messages of one stream, sorted, and counts of the others."""

    def __init__(self, name: str, queue_size: int) -> None:
        self.name = name
        self.keys: list[Key] = []
        self.newest_ns: int | None = None
        self.received = self.unpaired = self.duplicates = self.late = 0
        self._queue_size = queue_size
        self._messages: dict[Key, Any] = {}
        self._last_taken: Key | None = None

    def add(self, key: Key, message: Any) -> None:
        self.received += 1
        self.newest_ns = key.stamp_ns
        if key in self._messages or key == self._last_taken:
            self.duplicates += 1
        elif self._last_taken is not None and key < self._last_taken:
            self.late += 1
        else:
            insort(self.keys, key)
            self._messages[key] = message

    def take(self, key: Key) -> Any:
        """Returns the message of a key; older messages cannot be in a set any more and are dropped."""
        self._last_taken = key
        self._drop(self.keys.index(key))
        del self.keys[0]
        return self._messages.pop(key)

    def drop_overflow(self) -> None:
        self._drop(len(self.keys) - self._queue_size)

    def drop_all(self) -> None:
        self._drop(len(self.keys))

    def _drop(self, count: int) -> None:
        for key in self.keys[: max(0, count)]:
            del self._messages[key]
            self.unpaired += 1
        del self.keys[: max(0, count)]


class _Infos:
    """The CameraInfos that were received last."""

    def __init__(self, queue_size: int) -> None:
        self.received = 0
        self._queue_size = queue_size
        self._by_stamp: OrderedDict[int, Any] = OrderedDict()

    @property
    def is_known(self) -> bool:
        return bool(self._by_stamp)

    def add(self, stamp_ns: int, message: Any) -> None:
        self.received += 1
        self._by_stamp[stamp_ns] = message
        self._by_stamp.move_to_end(stamp_ns)
        while len(self._by_stamp) > self._queue_size:
            self._by_stamp.popitem(last=False)

    def at(self, stamp_ns: int) -> Any:
        """Returns the info of this stamp if it has arrived, else the newest one."""
        if stamp_ns in self._by_stamp:
            return self._by_stamp[stamp_ns]
        return self._by_stamp[next(reversed(self._by_stamp))]
