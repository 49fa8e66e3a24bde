"""Says why frames of a recording are skipped or lost: the first few of each sort, and how many more there were."""

from __future__ import annotations

import re

from splatam_core.commands.shared import say

SHOWN = 3
"""Of each sort. A recording may have a hundred thousand frames that are alike."""

MAX_SORTS = 20


class FrameNotes:
    """Counts what was said about frames.

    Attributes:
        last_reason: why the last frame was lost; empty if none was.
    """

    def __init__(self) -> None:
        self.last_reason = ''
        self._counts: dict[str, int] = {}
        self._num_more = {'skipped': 0, 'lost': 0}

    def skipped(self, index: int, reason: str) -> None:
        """Notes that a frame could not be read or used."""
        self._note('skipped', index, reason)

    def lost(self, index: int, reason: str) -> None:
        """Notes that the camera is lost at a frame."""
        self.last_reason = reason
        self._note('lost', index, reason)

    def _note(self, what: str, index: int, reason: str) -> None:
        sort = f'{what}: {re.sub("[0-9]+", "0", reason)}'  # numbers of frames, stamps and fractions differ
        if sort not in self._counts and len(self._counts) >= MAX_SORTS:
            sort = what
        self._counts[sort] = self._counts.get(sort, 0) + 1
        if self._counts[sort] <= SHOWN:
            say(f'frame {index} is {what}: {reason}')
        else:
            self._num_more[what] += 1

    def say_how_many_more(self) -> None:
        """Says how many frames were skipped or lost beside those that were named."""
        for what, count in self._num_more.items():
            if count:
                say(f'{count} more {"frames are" if count > 1 else "frame is"} {what} like these')
