"""Configurations: whatever a file or ``--set`` says, it is settings that are allowed or one line."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

from hypothesis import strategies as st

from kinds.base import Case, Kind, Tally
from kinds.damaged import JSON, WORDS, damage
from kinds.finished_run import CONFIG
from splatam_core.config import SlamConfig, flat_values, load_config, settings, to_yaml, with_values
from splatam_core.errors import ConfigError
from splatam_core.settings import Setting, Value

NAMES = [*(setting.name for setting in settings()), 'mapping', 'mapping.means_rate', 'keyframes', '', '.', 'seed.x']


def allowed_values(setting: Setting) -> st.SearchStrategy[Value]:
    """Values that a setting accepts, as far as its bounds say."""
    if setting.choices:
        return st.sampled_from(setting.choices)
    if setting.type is bool:
        return st.booleans()
    if setting.type is str:
        return st.just(setting.default)
    if setting.type is int:
        return st.integers(int(setting.minimum or 0), int(setting.maximum or 2**31))
    return st.floats(setting.minimum or 0.0, setting.maximum or 1e30)


VALUES = st.one_of(WORDS, JSON.map(json.dumps), st.integers().map(str), st.floats().map(repr), st.booleans().map(str))


def check_file(folder: Path, tally: Tally, data: bytes) -> None:
    (folder / 'config.yaml').write_bytes(data)
    check_allowed(tally.attempt(partial(load_config, str(folder / 'config.yaml')), ConfigError))


def check_overrides(tally: Tally, overrides: list[tuple[str, str]]) -> None:
    check_allowed(tally.attempt(partial(load_config, 'quick', [f'{name}={value}' for name, value in overrides]), ConfigError))


def check_allowed(config: SlamConfig | None) -> None:
    """What was accepted is accepted again."""
    if config is not None:
        values = flat_values(config)
        for setting in settings():
            assert setting.check(values[setting.name]) == values[setting.name]
        assert with_values(config, values) == config


def cases(folder: Path) -> list[Case]:
    small = to_yaml(CONFIG).encode()
    some = b''.join(line + b'\n' for line in small.splitlines()[:12])  # YAML is slow
    right = st.one_of(*(st.tuples(st.just(known.name), allowed_values(known).map(str)) for known in settings()))
    overrides = st.lists(right | st.tuples(st.sampled_from(NAMES), VALUES), min_size=1, max_size=3)
    return [
        Case('files', damage(some) | damage(some) | damage(small), partial(check_file, folder), short=15),
        Case('overrides', overrides, check_overrides),
    ]


KIND = Kind('configs', 10_000, cases)
