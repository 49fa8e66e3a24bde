"""What a kind of input is: generators, a check for each, and the bounds that every input must keep."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from hypothesis import strategies as st

from msg_adapters.errors import MessageError
from splatam_core.errors import SplatamError

T = TypeVar('T')
OWN_ERRORS = (SplatamError, MessageError)


@dataclass
class Tally:
    """Counts inputs: used if something came of them, refused if the project's own errors did.

    Attributes:
        inputs: number of inputs.
        used: those of which something was used.
        refused: those of which nothing was.
    """

    inputs: int = 0
    used: int = 0
    refused: int = 0
    _attempts: int = 0
    _uses: int = 0

    def attempt(self, use: Callable[[], T], *allowed: type[Exception]) -> T | None:
        """Use the input, or a part of it.

        Args:
            use: uses it. Whatever it raises that is not allowed, is a finding.
            allowed: errors that refuse it; by default all of the project's own, which are one line.

        Returns:
            What came of it; None if it was refused.
        """
        self._attempts += 1
        refusals = allowed or OWN_ERRORS
        try:
            result = use()
        except refusals as error:
            text = str(error)
            is_one_line = text and '\n' not in text and len(text) < 3000
            assert is_one_line or not isinstance(error, OWN_ERRORS), f'not one line: {error!r}'
            return None
        self._uses += 1
        return result

    def end_input(self) -> None:
        """Count what was attempted since the last call as one input."""
        if self._attempts:
            self.inputs += 1
            self.used += self._uses > 0
            self.refused += self._uses == 0
        self._attempts = self._uses = 0


@dataclass(frozen=True)
class Case:
    """One generator and the check of what it generates.

    Attributes:
        name: within its kind.
        strategy: generates values.
        check: uses a value. Whatever it raises is a finding.
        short: number of values in ``make test``.
        examples: values that are always tried first: those that were findings once.
        crossings: after each drawn value, try this many that are crossed from drawn ones (see crossing.py). For what takes much
            longer to draw than to use.
    """

    name: str
    strategy: st.SearchStrategy[Any]
    check: Callable[[Tally, Any], object]
    short: int = 40
    examples: tuple[Any, ...] = ()
    crossings: int = 0


@dataclass(frozen=True)
class Kind:
    """A kind of input.

    Attributes:
        name: as the table and ``--kind`` have it.
        long: number of inputs of ``make fuzz-long``.
        cases: returns the generators; it is given an empty folder for what they need.
        memory_mb: peak memory may grow by this much during one input.
        cpu_s: one value may take this much time of the processor.
        needs: module without which the kind is left out.
    """

    name: str
    long: int
    cases: Callable[[Path], list[Case]]
    memory_mb: int = 256
    cpu_s: float = 20.0
    needs: str = ''
