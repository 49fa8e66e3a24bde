"""docs/robustness.md is up to date with its rows, and every test that it names exists."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]


def load_tool() -> ModuleType:
    spec = importlib.util.spec_from_file_location('robustness', ROOT / 'tools' / 'robustness.py')
    tool = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tool)
    return tool


TOOL = load_tool()
ROWS = [(name, row) for name, rows in TOOL.read_rows().items() for row in rows]


def test_the_page_is_what_the_rows_say(capsys: pytest.CaptureFixture[str]) -> None:
    assert TOOL.main(['--check']) == 0, capsys.readouterr().err


def test_a_stale_page_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / 'robustness.md'
    page.write_text(TOOL.PAGE.read_text().replace('Git LFS', 'Git', 1))
    monkeypatch.setattr(TOOL, 'PAGE', page)
    monkeypatch.setattr(TOOL, 'ROOT', tmp_path)
    assert TOOL.main(['--check']) == 1 and 'out of date' in capsys.readouterr().err
    assert TOOL.main([]) == 0 and TOOL.main(['--check']) == 0


def test_a_page_without_a_section_is_an_error() -> None:
    with pytest.raises(ValueError, match='sections'):
        TOOL.generate(TOOL.PAGE.read_text().replace('generated: days', 'generated: day'), TOOL.read_rows())


@pytest.mark.parametrize(('name', 'row'), ROWS, ids=lambda value: str(value)[:60])
def test_every_row_is_shown_by_tests_that_exist(name: str, row: dict[str, object]) -> None:
    assert TOOL.faults(name, row) == []


@pytest.mark.parametrize(
    ('row', 'fault'),
    [
        ({'what': 'x', 'cap': '1', 'dropped': 'y'}, 'no test'),
        ({'what': 'x', 'cap': '1', 'tests': ['test/field/test_robustness.py::load_tool']}, 'missing: dropped'),
        ({'what': 'x', 'cap': '1', 'dropped': 'y', 'tests': ['test/nowhere.py::test_x']}, 'there is no test/nowhere.py::test_x'),
        ({'what': 'x', 'cap': '1', 'dropped': 'y', 'tests': ['test/field/test_robustness.py::test_x']}, 'there is no'),
    ],
)  # fmt: skip
def test_a_row_with_a_fault_is_noticed(row: dict[str, object], fault: str) -> None:
    (found,) = TOOL.faults('days', row)
    assert found.startswith(fault)
