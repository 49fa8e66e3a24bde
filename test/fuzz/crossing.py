"""Makes further values out of drawn ones: Hypothesis takes ten times as long to draw a value as most code takes to use it."""

from __future__ import annotations

import random
from dataclasses import fields, is_dataclass, replace
from types import SimpleNamespace
from typing import Any

POOL = 40
"""Drawn values of which parts are taken."""


class Crossing:
    """Crosses drawn values; with the same seed in the same way."""

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed)
        self._pool: list[Any] = []
        self._share = 0.5

    def add(self, value: Any) -> None:
        """Remember a drawn value, in the place of another one if there are many."""
        if len(self._pool) < POOL:
            self._pool.append(value)
        else:
            self._pool[self._random.randrange(POOL)] = value

    def next_to(self, value: Any) -> Any:
        """Returns a value of the same form: some parts, or many, are those of another drawn value."""
        other = self._random.choice(self._pool)
        self._share = self._random.choice((0.1, 0.25, 0.5))
        if type(other) is type(value) and isinstance(value, (str, bytes)):
            return self._joined(value, other)
        return self._crossed(value, other)

    def _crossed(self, first: Any, second: Any) -> Any:
        """Numbers, words and arrays are taken whole, so that each stays what its generator promises."""
        if type(first) is type(second):
            if isinstance(first, SimpleNamespace):
                return SimpleNamespace(**self._entries(vars(first), vars(second)))
            if isinstance(first, dict):
                return self._entries(first, second)
            if isinstance(first, (list, tuple)):
                return type(first)(map(self._crossed, first, second)) if len(first) == len(second) else self._joined(first, second)
            if is_dataclass(first):
                return replace(first, **self._entries(_parts(first), _parts(second)))
        return second if self._random.random() < self._share else first

    def _entries(self, first: dict[Any, Any], second: dict[Any, Any]) -> dict[Any, Any]:
        result = {key: self._crossed(value, second.get(key, value)) for key, value in first.items()}
        if 'seed' in result:
            result['seed'] = self._random.randrange(2**32)
        return result

    def _joined(self, first: Any, second: Any) -> Any:
        """The begin of one and the end of the other, neither shorter nor longer than both."""
        joined = first[: self._random.randint(0, len(first))] + second[self._random.randint(0, len(second)) :]
        shorter, longer = sorted((len(first), len(second)))
        return joined[:longer] if len(joined) >= shorter else first


def _parts(value: Any) -> dict[str, Any]:
    return {part.name: getattr(value, part.name) for part in fields(value)}
