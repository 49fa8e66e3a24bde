"""Being told to stop, or to hurry: the signals that ask for it, and how a long frame ends early, between two of its steps."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from enum import Enum
from types import FrameType

from splatam_core.errors import FrameError

Stop = Callable[[], bool]
"""Asked before each step; no further step is taken once it returns True."""


class Pressure(Enum):
    """What waits for the present frame to be done."""

    NONE = 'nothing'
    WAITING = 'the next frame, or a call'
    FULL = 'as many frames as can wait: the next one costs one of them'


PressureGauge = Callable[[], Pressure]
"""Asked before each optimization step, which is postponed while others wait."""


STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Ctrl-C, the end of a service or a container, and the end of the terminal or of an ssh connection."""


@contextmanager
def on_stop_signals(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Calls a handler on each signal that asks to stop. ``nohup`` keeps its meaning: SIGHUP is ignored then.

    Python takes handlers from the main thread only; in another one, nothing changes.
    """
    is_nohup = signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    numbers = [number for number in STOP_SIGNALS if not (is_nohup and number is signal.SIGHUP)]
    previous = {}
    with suppress(ValueError):
        for number in numbers:
            previous[number] = signal.signal(number, handler)
    try:
        yield
    finally:
        for number, before in previous.items():
            signal.signal(number, before)


def never() -> bool:
    """Never stops."""
    return False


def no_pressure() -> Pressure:
    """Nothing ever waits, as in a recording."""
    return Pressure.NONE


def check(stop: Stop) -> None:
    """Gives up the frame that is being tracked if it is time to stop.

    Raises:
        FrameError: it is.
    """
    if stop():
        raise FrameError('its tracking was interrupted, because there is no time left')
