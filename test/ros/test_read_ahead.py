"""Reading messages ahead of playback."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import pytest

from splatam_core.datasets.bag.recording import RawMessage
from splatam_core.errors import DatasetError
from splatam_ros.player.read_ahead import ReadAhead

TIMEOUT_S = 10.0  # only ever waited out when a test fails


def messages(count: int, handed_out: list[int] | None = None) -> Iterator[RawMessage]:
    for i in range(count):
        if handed_out is not None:
            handed_out.append(i)
        yield RawMessage('/text', i, b'')


def taken(ahead: ReadAhead) -> Iterator[int]:
    while not ahead.is_over:
        message = ahead.take(TIMEOUT_S)
        if message is not None:
            yield message.time_ns


def test_messages_come_in_order_and_no_more_than_asked_for_are_held() -> None:
    handed_out: list[int] = []
    with ReadAhead(messages(50, handed_out), size=3) as ahead:
        for expected, time_ns in enumerate(taken(ahead)):
            time.sleep(0.001)  # time to read on, if it would
            assert time_ns == expected
            assert len(handed_out) <= expected + 1 + 3 + 1  # this one, those that wait, and one without a place
    assert len(handed_out) == 50


def test_what_was_read_before_an_error_is_played_before_it_is_raised() -> None:
    def breaking() -> Iterator[RawMessage]:
        yield from messages(3)
        raise DatasetError('the file ends in the middle of a message')

    with ReadAhead(breaking(), size=10) as ahead:
        assert [ahead.take(TIMEOUT_S).time_ns for _ in range(3)] == [0, 1, 2]
        assert ahead.take(TIMEOUT_S) is None
        with pytest.raises(DatasetError):
            assert ahead.is_over


def test_nobody_needs_to_take_everything() -> None:
    before = threading.active_count()
    with ReadAhead(messages(10**9), size=5) as ahead:
        assert ahead.take(TIMEOUT_S) is not None
    assert threading.active_count() == before


def test_a_slow_disk_is_waited_for_only_so_long() -> None:
    release = threading.Event()

    def slow() -> Iterator[RawMessage]:
        release.wait(TIMEOUT_S)
        yield from messages(1)

    with ReadAhead(slow(), size=5) as ahead:
        assert ahead.take(0.05) is None and not ahead.is_over
        release.set()
        assert list(taken(ahead)) == [0]
