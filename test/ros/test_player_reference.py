"""Checks the statements of docs/player.md."""

from __future__ import annotations

import re
from pathlib import Path

from graph import ROOT

from splatam_ros.player.main import make_parser

TEXT = (ROOT / 'docs' / 'player.md').read_text()


def test_every_switch_is_in_the_table_and_every_one_there_exists() -> None:
    switches = {word for action in make_parser()._actions for word in action.option_strings if word.startswith('--')}
    table = [line for line in TEXT.splitlines() if line.startswith('|') and 'test_' in line]
    assert switches - {'--help'} == set(re.findall(r'--[a-z][a-z-]+', ' '.join(table)))


def test_every_test_that_is_named_exists() -> None:
    named = re.findall(r'`(test_\w+\.py)::(test_\w+)`', TEXT)
    assert len(named) > 20
    for file, name in named:
        assert f'\ndef {name}(' in (Path(__file__).parent / file).read_text(), f'{file}::{name}'
