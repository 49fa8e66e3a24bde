"""Handles backward jumps of time: a bag that loops, a simulation that restarts.

Streams do not jump at the same moment: the last depth images of a loop arrive among the first colour images of
the next. So each message is assigned to an epoch, and only messages of the same epoch are compared.
"""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass
class _Epoch:
    number: int
    newest_ns: dict[str, int] = field(default_factory=dict)

    def distance(self, stamp_ns: int) -> int:
        return min((abs(stamp_ns - newest) for newest in self.newest_ns.values()), default=0)

    def is_jump(self, stream: str, stamp_ns: int, jump_ns: int) -> bool:
        return stamp_ns < self.newest_ns.get(stream, stamp_ns) - jump_ns


class EpochClock:
    """Assigns each message to an epoch by its stream and stamp.

    The last two epochs stay open, and a message belongs to the one whose newest messages are nearer to it. So
    late messages of a loop find their partners, and a single wrong stamp does not separate the streams for good.
    """

    def __init__(self, jump_ns: int) -> None:
        self._jump_ns = jump_ns
        self._open = [_Epoch(0)]

    def epoch_of(self, stream: str, stamp_ns: int) -> int:
        """Returns the epoch of the next message of a stream: a new one if the stream jumped back by more than ``jump_ns``."""
        epoch = min(reversed(self._open), key=lambda candidate: candidate.distance(stamp_ns))
        if epoch.is_jump(stream, stamp_ns, self._jump_ns):
            epoch = _Epoch(self._open[-1].number + 1)
            self._open = [self._open[-1], epoch]
        epoch.newest_ns[stream] = max(stamp_ns, epoch.newest_ns.get(stream, stamp_ns))
        return epoch.number

    def close_before(self, number: int) -> None:
        """Assign no more messages to the epochs before this one."""
        self._open = [epoch for epoch in self._open if epoch.number >= number]
