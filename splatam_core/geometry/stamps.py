"""Time stamps: integer nanoseconds inside, decimal numbers in files.

Files state seconds. Some state milliseconds, microseconds or nanoseconds instead, which ``guess_unit`` recognises.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal

import numpy as np
from numpy.typing import NDArray

NS_PER_S = 1_000_000_000
LIMIT_NS = 2**62
"""Stamps are between -LIMIT_NS and LIMIT_NS (146 years): the difference of two stamps then fits into 64 bits."""

LONGEST_GAP_S = 1e4
"""Stamps of a recording that lie further apart are no seconds."""

FRAME_GAP_S = (1e-4, 10.0)
THIS_CENTURY_S = (946_684_800, 4_102_444_800)


@dataclass(frozen=True, slots=True)
class StampUnit:
    """The unit of the stamps in a file.

    Attributes:
        name: plural.
        per_second: how many make a second.
    """

    name: str
    per_second: int

    def stamp_ns(self, number: Decimal) -> int:
        """Returns the nanoseconds of a number of this unit, exactly.

        Raises:
            ValueError: the stamp is out of range.
        """
        stamp_ns = int((number * (NS_PER_S // self.per_second)).to_integral_value())
        if abs(stamp_ns) >= LIMIT_NS:
            raise ValueError(f"'{number}' {self.name} is not between -{LIMIT_NS // NS_PER_S} s and {LIMIT_NS // NS_PER_S} s")
        return stamp_ns


SECONDS = StampUnit('seconds', 1)
FINER_UNITS = (
    StampUnit('nanoseconds', NS_PER_S),
    StampUnit('microseconds', 1_000_000),
    StampUnit('milliseconds', 1000),
)  # fmt: skip


def guess_unit(numbers: Sequence[Decimal]) -> StampUnit:
    """Returns the unit of a file's stamps: seconds, unless they would be too large or too far apart.

    Among the finer units it is one with which the stamps are as far apart as frames or poses are, and with which they lie
    in this century if there is such a unit.

    Args:
        numbers: the stamps in the file's order.
    """
    values = np.array([float(number) for number in numbers])
    gaps = np.abs(np.diff(values))
    gap = float(np.median(gaps[gaps > 0])) if gaps.any() else None
    size = float(np.median(np.abs(values))) if len(values) else 0.0
    if size < LIMIT_NS / NS_PER_S and (gap is None or gap < LONGEST_GAP_S):
        return SECONDS
    near = [unit for unit in FINER_UNITS if gap is None or FRAME_GAP_S[0] <= gap / unit.per_second <= FRAME_GAP_S[1]]
    dated = [unit for unit in near if THIS_CENTURY_S[0] <= size / unit.per_second <= THIS_CENTURY_S[1]]
    return (dated or near or [SECONDS])[0]


def stamp_number(text: str) -> Decimal:
    """Returns the number that a text states.

    Raises:
        ValueError: the text is not a finite decimal number, or is far too large for a stamp.
    """
    try:
        number = Decimal(text)
        if number.is_finite() and (number == 0 or number.adjusted() < 30):
            return number
    except ArithmeticError:
        pass
    raise ValueError(f"'{text}' is not a number of seconds")


def stamp_from_text(text: str) -> int:
    """Returns the nanoseconds of a decimal number of seconds, exactly.

    Raises:
        ValueError: the text is not a finite decimal number, or the stamp is out of range.
    """
    return SECONDS.stamp_ns(stamp_number(text))


def stamp_text(stamp_ns: int) -> str:
    """Returns seconds with nine decimals, which is exact."""
    seconds, rest_ns = divmod(abs(stamp_ns), NS_PER_S)
    return f'{"-" if stamp_ns < 0 else ""}{seconds}.{rest_ns:09d}'


def stray_stamps(stamps_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Returns which stamps [N] are wrong: time does not increase with them, and does without them.

    Only single ones between others that agree. Where two that follow each other agree against those before, time has jumped.
    """
    known, wrong = stamps_ns.tolist(), np.zeros(len(stamps_ns), bool)
    if len(known) < 3:
        return wrong
    for at in (np.flatnonzero(np.diff(stamps_ns) <= 0) + 1).tolist():
        if known[at - 2] < known[at] if at > 1 else known[1] < known[2]:
            wrong[at - 1] = True
        elif at > 1 and (at + 1 == len(known) or known[at - 1] < known[at + 1]):
            wrong[at] = True
    return wrong
