"""ROS parameters: whatever is given at start or set at run time is used, or refused with a reason. No node is started."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from hypothesis import strategies as st

from kinds.base import Case, Kind, Tally
from kinds.configs import NAMES, allowed_values
from kinds.damaged import WORDS
from splatam_core.config import SlamConfig, settings
from splatam_core.errors import ConfigError

if TYPE_CHECKING:
    from splatam_ros.node.parameters import NodeOptions

INTEGER = st.one_of(st.integers(-(2**63), 2**63 - 1), st.integers(-2, 70))
ONE = st.one_of(
    st.booleans(), INTEGER, st.floats(), st.floats(0, 2), WORDS, st.text(max_size=10),
    st.sampled_from(['~nosuchuser/x', '/', '/dev/null', 'x' * 300, 'a/' * 3000, '1 2 3 0 0 0 1', '0 0 0 0 0 0 0', 'quick', 'none']),
)  # fmt: skip
VALUE = st.one_of(
    ONE, ONE, ONE, st.none(), st.binary(max_size=3), st.lists(st.booleans(), max_size=2), st.lists(INTEGER, max_size=2),
    st.lists(st.floats(), max_size=2), st.lists(st.text(max_size=3), max_size=2),
)  # fmt: skip
"""Of every type that ROS parameters have, and not set."""


@dataclass
class Parameters:
    """Stands for the node of ROS: holds parameters, takes callbacks and logs nothing."""

    given: Mapping[str, Any]
    checks: list[Callable[[Sequence[Any]], Any]] = field(default_factory=list)
    applies: list[Callable[[Sequence[Any]], None]] = field(default_factory=list)

    def get_parameters_by_prefix(self, prefix: str) -> dict[str, Any]:
        """All parameters."""
        return {name: SimpleNamespace(value=value) for name, value in self.given.items()}

    def has_parameter(self, name: str) -> bool:
        """True if it was given."""
        return name in self.given

    def undeclare_parameter(self, name: str) -> None:
        """Forget nothing."""

    def declare_parameter(self, name: str, value: Any, descriptor: Any, *, ignore_override: bool) -> None:
        """The value must be of a type of ROS, and within the bounds."""
        assert isinstance(value, (bool, int, float, str)), name
        for bounds in (*descriptor.integer_range, *descriptor.floating_point_range):
            assert bounds.from_value <= value <= bounds.to_value, name

    def get_logger(self) -> Any:
        """Logs nothing."""
        return SimpleNamespace(warning=lambda text: None)

    def add_on_set_parameters_callback(self, callback: Callable[[Sequence[Any]], Any]) -> None:
        """Remember who checks changes."""
        self.checks.append(callback)

    def add_post_set_parameters_callback(self, callback: Callable[[Sequence[Any]], None]) -> None:
        """Remember who applies changes."""
        self.applies.append(callback)


def check_start(tally: Tally, given: dict[str, Any]) -> None:
    from splatam_ros.node import parameters

    tally.attempt(partial(parameters.declare, Parameters(given)), ConfigError)


def check_changes(options: NodeOptions, config: SlamConfig, tally: Tally, sets: list[dict[str, Any]]) -> None:
    """A set of changes that is accepted can be applied."""
    from splatam_ros.node.reconfiguration import Reconfiguration

    node = Parameters({})
    Reconfiguration(node, options, config, lambda options: None, lambda config: None)
    for changed in sets:
        changes = [SimpleNamespace(name=name, value=value) for name, value in changed.items()]
        result = node.checks[0](changes)
        tally.attempt(partial(_verdict, result), ConfigError)
        if result.successful:
            node.applies[0](changes)
        tally.end_input()


def _verdict(result: Any) -> None:
    if not result.successful:
        assert 'unexpected' not in result.reason, result.reason
        raise ConfigError(result.reason)


def cases(folder: Path) -> list[Case]:
    from splatam_ros.node.parameters import NODE_SETTINGS, declare, why_fixed

    known = {setting.name: setting for setting in NODE_SETTINGS} | {f'slam.{setting.name}': setting for setting in settings()}
    names = [*known, *(f'slam.{name}' for name in NAMES), 'x', 'use_sim_time', 'slam', 'qos_overrides.a']

    def given(of: list[str]) -> st.SearchStrategy[dict[str, Any]]:
        right = st.one_of(*(st.tuples(st.just(name), allowed_values(known[name])) for name in of))
        odd = st.tuples(st.sampled_from(of), VALUE) | st.tuples(st.sampled_from(names), VALUE)
        return st.lists(right | right | odd, min_size=1, max_size=3).map(dict)

    changeable = [name for name in known if not why_fixed(name)]
    return [
        Case('start', given(list(known)), check_start),
        Case('changes', st.lists(given(changeable), min_size=1, max_size=4), partial(check_changes, *declare(Parameters({})))),
    ]


KIND = Kind('parameters', 20_000, cases, needs='rclpy')
