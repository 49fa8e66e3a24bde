"""Time that jumps back: a bag that loops, a simulation that restarts.

Streams do not jump together: the last depth images of a loop arrive among the first colour images of
the next. So each message is put into an epoch, and only messages of the same epoch are comparable.
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
    """Tells the epoch of each message by its stream and stamp.

    The last two epochs stay open, and a message belongs to the one whose newest messages are nearer to it. So
    stragglers of a loop find their partners, and a single wrong stamp does not part the streams for good.
    """

    def __init__(self, jump_ns: int) -> None:
        self._jump_ns = jump_ns
        self._open = [_Epoch(0)]

    def epoch_of(self, stream: str, stamp_ns: int) -> int:
        """The epoch of the next message of a stream; a new one if the stream jumped back by more than ``jump_ns``."""
        epoch = min(reversed(self._open), key=lambda candidate: candidate.distance(stamp_ns))
        if epoch.is_jump(stream, stamp_ns, self._jump_ns):
            epoch = _Epoch(self._open[-1].number + 1)
            self._open = [self._open[-1], epoch]
        epoch.newest_ns[stream] = max(stamp_ns, epoch.newest_ns.get(stream, stamp_ns))
        return epoch.number

    def close_before(self, number: int) -> None:
        """Take no more messages into the epochs before this one."""
        self._open = [epoch for epoch in self._open if epoch.number >= number]
