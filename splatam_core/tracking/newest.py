"""What is computed from a frame once, however often the frame is tracked: from several poses, then as the one before the next."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar
from weakref import ref

from splatam_core.images.view import View

T = TypeVar('T')
_NUM_KEPT = 2  # the frame, and the one before


class OfNewestViews(Generic[T]):
    """Computes a function of a view, and keeps the results of the newest views for as long as these exist."""

    def __init__(self, function: Callable[[View], T]) -> None:
        """Start without views.

        Args:
            function: its result must not refer to the view, which would then exist for as long as the result is kept.
        """
        self._function = function
        self._kept: list[tuple[ref[View], T]] = []

    def of(self, view: View) -> T:
        """Returns the function's result for a view, whose images must not change."""
        for known, result in self._kept:
            if known() is view:
                return result
        result = self._function(view)
        self._kept = [*self._kept, (ref(view, self._forget), result)][-_NUM_KEPT:]
        return result

    def _forget(self, gone: ref[View]) -> None:
        self._kept = [(known, result) for known, result in self._kept if known is not gone]
