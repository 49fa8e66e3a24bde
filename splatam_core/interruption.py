"""Ends a long frame early, between two of its steps, when there is no time left for it."""

from __future__ import annotations

from collections.abc import Callable

from splatam_core.errors import FrameError

Stop = Callable[[], bool]
"""Asked before each step; no further step is taken once it returns True."""


def never() -> bool:
    """Never stops."""
    return False


def check(stop: Stop) -> None:
    """Gives up the frame that is being tracked if it is time to stop.

    Raises:
        FrameError: it is.
    """
    if stop():
        raise FrameError('its tracking was interrupted, because there is no time left')
