"""Wrong stamps cost their frame; jumps in time cost none."""

from __future__ import annotations

from msg_adapters.synchronizer import RgbdSet
from splatam_ros.node.stamp_filter import StampFilter

SECOND = 10**9
DAY = 86400 * SECOND
FRAME = SECOND // 30


class Bench:
    """A filter with a threshold of one second, and what it dropped."""

    def __init__(self) -> None:
        self.wrong: list[int] = []
        self.filter = StampFilter(SECOND, lambda found, last_ns: self.wrong.append(found.stamp_ns))

    def feed(self, *stamps_ns: int) -> list[tuple[int, int]]:
        """Returns stamp and epoch of each set that is passed on."""
        passed = [found for stamp_ns in stamps_ns for found in self.filter.add(RgbdSet(stamp_ns, None, None, None, 0, 0))]
        return [(found.stamp_ns, found.resets) for found in passed]


def row(first_ns: int, count: int = 3, gap_ns: int = FRAME) -> list[int]:
    return [first_ns + number * gap_ns for number in range(count)]


def test_stamps_that_increase_are_passed_on_at_once() -> None:
    bench = Bench()
    for stamp_ns in row(100 * SECOND, 50):
        assert bench.feed(stamp_ns) == [(stamp_ns, 0)]
    assert not bench.wrong and not bench.filter.is_holding


def test_one_stamp_that_is_wrong_costs_its_frame_and_no_epoch() -> None:
    for wrong_ns in (101 * SECOND + DAY, 107 * SECOND, 50 * SECOND, 0, -DAY, 100 * SECOND - DAY):
        bench, before, after = Bench(), row(100 * SECOND), row(100 * SECOND + 4 * FRAME)
        assert bench.feed(*before, wrong_ns, *after) == [(stamp_ns, 0) for stamp_ns in before + after], wrong_ns
        assert bench.wrong == [wrong_ns]


def test_a_stamp_of_one_stream_alone_is_no_jump() -> None:
    """The synchronizer begins an epoch when one colour image was stamped ahead; the frames are in line all the same."""
    bench = Bench()
    passed = [*bench.filter.add(RgbdSet(SECOND, None, None, None, 0, 0)), *bench.filter.add(RgbdSet(SECOND + FRAME, 0, 0, 0, 1, 0))]
    assert [found.resets for found in passed] == [0, 0]


def test_a_jump_forward_keeps_every_frame() -> None:
    bench, stamps_ns = Bench(), row(SECOND) + row(DAY)
    assert bench.feed(*stamps_ns) == [(stamp_ns, 0) for stamp_ns in stamps_ns] and not bench.wrong


def test_a_jump_back_keeps_every_frame_and_begins_an_epoch() -> None:
    bench, first, second = Bench(), row(DAY), row(SECOND)
    assert bench.feed(*first, *second, *second) == [
        *((stamp_ns, 0) for stamp_ns in first), *((stamp_ns, 1) for stamp_ns in second), *((stamp_ns, 1) for stamp_ns in ()),
    ]  # fmt: skip
    assert bench.wrong == second  # no jump, but late: less than a second back


def test_the_last_frame_of_a_recording_does_not_wait_for_ever() -> None:
    bench = Bench()
    bench.feed(*row(SECOND), DAY)
    assert bench.filter.is_holding
    assert [(found.stamp_ns, found.resets) for found in bench.filter.flush()] == [(DAY, 0)]
    assert not bench.filter.is_holding and bench.filter.flush() == []


def test_a_slow_camera_is_no_row_of_jumps() -> None:
    bench, stamps_ns = Bench(), row(SECOND, 9, gap_ns=7 * SECOND)
    assert bench.feed(*stamps_ns) == [(stamp_ns, 0) for stamp_ns in stamps_ns]
    assert not bench.wrong


def test_stamps_in_no_order_never_end_it() -> None:
    bench = Bench()
    bench.feed(*(number * 7919 % 1000 * SECOND for number in range(1000)))
    passed = bench.feed(*row(DAY, 5))
    assert len(passed) >= 4
