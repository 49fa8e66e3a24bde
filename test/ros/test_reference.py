"""docs/ros.md is up to date with the code, and every test that it names exists."""

from __future__ import annotations

import ast
import importlib.util
from collections.abc import Sequence
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]
LEVELS = ('MUST', 'SHOULD', 'optional', 'not possible')


def load_tool():
    spec = importlib.util.spec_from_file_location('ros_reference', ROOT / 'tools' / 'ros_reference.py')
    tool = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tool)
    return tool


TOOL = load_tool()
FEATURES = yaml.safe_load(TOOL.FEATURES.read_text())
FAULTS = yaml.safe_load(TOOL.FAULTS.read_text())


def test_the_page_is_what_the_code_says(capsys: pytest.CaptureFixture[str]) -> None:
    assert TOOL.main(['--check']) == 0, capsys.readouterr().err


def test_a_stale_page_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / 'ros.md'
    page.write_text(TOOL.PAGE.read_text().replace('`queue_size`', '`queue_length`'))
    monkeypatch.setattr(TOOL, 'PAGE', page)
    monkeypatch.setattr(TOOL, 'ROOT', tmp_path)
    assert TOOL.main(['--check']) == 1 and 'out of date' in capsys.readouterr().err
    assert TOOL.main([]) == 0 and TOOL.main(['--check']) == 0


def test_a_page_without_a_section_is_an_error() -> None:
    with pytest.raises(ValueError, match='sections'):
        TOOL.generate(TOOL.PAGE.read_text().replace('generated: inputs', 'generated: input'))


@pytest.mark.parametrize('row', FEATURES, ids=lambda row: row['feature'][:40])
def test_every_feature_is_shown_by_tests_that_exist(row: dict) -> None:
    assert row.keys() <= {'feature', 'level', 'tests', 'not_tested'} and row['level'] in LEVELS
    assert row.get('tests') or row.get('not_tested')
    check_exist(row.get('tests', ()))


@pytest.mark.parametrize('row', FAULTS, ids=lambda row: row['fault'][:40])
def test_every_fault_is_tried_by_tests_that_exist(row: dict) -> None:
    assert row.keys() == {'fault', 'happens', 'tests'} and row['tests']
    check_exist(row['tests'])


def check_exist(tests: Sequence[str]) -> None:
    for name in tests:
        path, _, function = name.partition('::')
        assert function in functions(ROOT / path), f'{name} does not exist'


def functions(path: Path) -> set[str]:
    """Names of a file's tests."""
    return {node.name for node in ast.parse(path.read_text()).body if isinstance(node, ast.FunctionDef)}
