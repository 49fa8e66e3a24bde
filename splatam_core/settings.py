"""What a setting is: a typed dataclass field with help text, unit and bounds beside its default."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any, TypeVar, get_type_hints

from splatam_core.errors import ConfigError

Value = bool | int | float | str
Section = TypeVar('Section')


@dataclass(frozen=True, slots=True)
class Setting:
    """One leaf of the configuration.

    Attributes:
        name: dotted path, for example ``tracking.iterations``.
        type: bool, int, float or str.
        default: value where neither preset nor user sets another.
        help: what it does, and when to change it.
        unit: of the value; empty where it has none.
        minimum: smallest allowed number, or None.
        maximum: largest allowed number, or None.
        choices: the allowed strings; empty where any string is allowed.
    """

    name: str
    type: type
    default: Value
    help: str
    unit: str
    minimum: float | None
    maximum: float | None
    choices: tuple[str, ...]

    def check(self, value: object) -> Value:
        """Returns the value in this setting's type.

        Raises:
            ConfigError: the value has the wrong type or is outside what is allowed.
        """
        if self.type is float and type(value) is int and abs(value) <= sys.float_info.max:
            value = float(value)
        if not isinstance(value, Value) or type(value) is not self.type or (self.choices and value not in self.choices):
            raise ConfigError(f'{self.name} = {shown(value)}: expected {self._allowed()}')
        if not isinstance(value, str) and not self._contains(value):
            raise ConfigError(f'{self.name} = {shown(value)}: expected {self._allowed()}')
        return value

    @property
    def shown_default(self) -> str:
        """The default as it is written in YAML; ``empty`` for an empty text."""
        return str(self.default).lower() if isinstance(self.default, bool) else str(self.default) or 'empty'

    @property
    def shown_choices(self) -> str:
        """The allowed strings, separated by commas, the empty one in quotes; empty where any string is allowed."""
        return ', '.join(choice or "''" for choice in self.choices)

    @property
    def shown_range(self) -> str:
        """Type, bounds and unit for a table, for example ``float ≥ 0 m``."""
        bounds = [f'{sign} {bound:g}' for sign, bound in (('≥', self.minimum), ('≤', self.maximum)) if bound is not None]
        return ' '.join(part for part in (self.type.__name__, ', '.join(bounds), self.unit) if part)

    def _contains(self, number: float) -> bool:
        if isinstance(number, float) and not math.isfinite(number):
            return False
        is_high_enough = self.minimum is None or number >= self.minimum
        return is_high_enough and (self.maximum is None or number <= self.maximum)

    def _allowed(self) -> str:
        if self.choices:
            return f'one of {self.shown_choices}'
        kind = {bool: 'true or false', int: 'a whole number', float: 'a number', str: 'a text'}[self.type]
        bounds = [f'at least {self.minimum:g}'] if self.minimum is not None else []
        bounds += [f'at most {self.maximum:g}'] if self.maximum is not None else []
        return ' '.join([kind, ' and '.join(bounds), f'({self.unit})' if self.unit else '']).strip()


def shown(value: object) -> str:
    """Returns a value as it is written in one line, without the middle of a very long one."""
    try:
        text = repr(value)
    except ValueError:  # Python writes no number of more than 4300 digits
        return 'a number of thousands of digits'
    return text if len(text) <= 200 else f'{text[:100]}...{text[-20:]}'


def setting(
    default: Value,
    help: str,
    *,
    unit: str = '',
    minimum: float | None = None,
    maximum: float | None = None,
    choices: tuple[str, ...] = (),
) -> Any:
    """Returns a dataclass field that is a setting."""
    metadata = {'help': help, 'unit': unit, 'minimum': minimum, 'maximum': maximum, 'choices': choices}
    return field(default=default, metadata=metadata)


def settings_of(section: type, prefix: str = '') -> Iterator[Setting]:
    """Yields every setting of a section and of the sections in it, in order."""
    hints = get_type_hints(section)
    for entry in fields(section):
        if is_dataclass(hints[entry.name]):
            yield from settings_of(hints[entry.name], f'{prefix}{entry.name}.')
        else:
            default: Any = entry.default  # every setting has one
            yield Setting(f'{prefix}{entry.name}', hints[entry.name], default, **entry.metadata)


def leaf(section: object, name: str) -> Value:
    """Returns the value of a setting by its dotted name."""
    value: Any = section
    for part in name.split('.'):
        value = getattr(value, part)
    return value


def with_leaf(section: Section, path: list[str], value: Value) -> Section:
    """Returns the section with one setting, at a path of names, set to a value."""
    head, *rest = path
    changed = with_leaf(getattr(section, head), rest, value) if rest else value
    return replace(section, **{head: changed})  # type: ignore[type-var]  # every section is a dataclass


def flatten(tree: Mapping[str, Any], prefix: str = '') -> dict[str, object]:
    """Returns nested mappings as one: dotted names to values."""
    flat: dict[str, object] = {}
    for key, value in tree.items():
        flat |= flatten(value, f'{prefix}{key}.') if isinstance(value, Mapping) else {f'{prefix}{key}': value}
    return flat


def unflatten(values: Mapping[str, Value]) -> dict[str, Any]:
    """Returns dotted names as nested mappings."""
    tree: dict[str, Any] = {}
    for name, value in values.items():
        *sections, last = name.split('.')
        branch = tree
        for section in sections:
            branch = branch.setdefault(section, {})
        branch[last] = value
    return tree
