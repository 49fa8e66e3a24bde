"""The heading of a table of poses: it may name the columns in another order than ``stamp tx ty tz qx qy qz qw``.

Such as ``#timestamp [ns],p_x,p_y,p_z,q_w,q_x,q_y,q_z`` of EuRoC, with more columns behind or between.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

_NAMES = ('tx', 'ty', 'tz', 'qx', 'qy', 'qz', 'qw')
_LAST_LINE = 100  # a heading is at the beginning
_UNIT = re.compile(r'\[.*?\]|\(.*?\)')
_OF_TIME = re.compile('time|stamp|^(t|ts|s|sec|ns|nsec)$')
_OF_ROTATION = re.compile('q|rot|orient')


@dataclass(frozen=True, slots=True)
class NamedColumns:
    """Where the numbers of a table are.

    Attributes:
        line: number of the heading, from 1.
        count: columns of the table.
        places: columns of stamp tx ty tz qx qy qz qw, from 0.
    """

    line: int
    count: int
    places: tuple[int, ...]

    @property
    def are_in_order(self) -> bool:
        """True if position and rotation are in the order of a TUM trajectory, and nothing is between them."""
        _, first, *_ = self.places
        return self.places[1:] == tuple(range(first, first + len(_NAMES)))

    def fields(self, line: str) -> list[str]:
        """Returns the texts of stamp tx ty tz qx qy qz qw in a line; empty if it has another number of columns."""
        found = [field.strip() or 'nan' for field in line.split(',')] if ',' in line else line.split()
        return [found[place] for place in self.places] if len(found) == self.count else []


def named_columns(lines: Sequence[str]) -> NamedColumns | None:
    """Returns the columns that a heading among the first lines names; None if there is no heading."""
    for number, line in enumerate(lines[:_LAST_LINE], 1):
        words = re.split(r'[,\s]+', _UNIT.sub('', line).strip(' \t#%/,').lower())
        places: dict[str, int] = {}
        for index, word in enumerate(words):
            if word[-1:] in ('w', 'x', 'y', 'z'):
                places.setdefault(('q' if _OF_ROTATION.search(word) else 't') + word[-1], index)
        if all(name in places for name in _NAMES):
            stamp = next((index for index, word in enumerate(words) if _OF_TIME.search(word)), 0)
            return NamedColumns(number, len(words), (stamp, *(places[name] for name in _NAMES)))
    return None
