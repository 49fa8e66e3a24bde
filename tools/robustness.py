"""Writes the tables of docs/robustness.md from test/field/robustness.yaml. With ``--check`` only reports if they are out of date.

Run as ``python tools/robustness.py``. Everything between ``<!-- generated: NAME -->`` and ``<!-- end -->`` is replaced; the text
around it is written by hand. ``test/field/test_robustness.py`` fails if the page is out of date, or names a test that does not
exist.
"""

from __future__ import annotations

import argparse
import ast
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / 'docs' / 'robustness.md'
DATA = ROOT / 'test' / 'field' / 'robustness.yaml'
FAILED_BEFORE = ROOT / 'test' / 'field' / 'failed_before.txt'
SECTION = re.compile(r'(<!-- generated: (\w+) -->\n).*?(<!-- end -->)', re.DOTALL)
COLUMNS = {
    'inputs': {'input': 'what people bring', 'was': 'in 0.1.0', 'now': 'now'},
    'critical': {'input': 'fault', 'was': 'in 0.1.0', 'now': 'now'},
    'major': {'input': 'fault', 'was': 'in 0.1.0', 'now': 'now'},
    'minor': {'input': 'fault', 'was': 'in 0.1.0', 'now': 'now'},
    'days': {'what': 'what', 'cap': 'limit', 'dropped': 'what goes beyond it'},
}
"""The columns of each section, and their titles; the tests are one more."""

Row = Mapping[str, Any]


def read_rows() -> dict[str, list[Row]]:
    """Returns the rows of each section."""
    sections: dict[str, list[Row]] = yaml.safe_load(DATA.read_text())
    return sections


def table(name: str, rows: Iterable[Row]) -> str:
    """Returns the Markdown table of a section."""
    columns = COLUMNS[name]
    lines = [[*columns.values(), 'shown by'], ['---'] * (len(columns) + 1)]
    lines += [[*(row[column] for column in columns), _shown(row)] for row in rows]
    return ''.join(f'| {" | ".join(cell.replace("|", chr(92) + "|") for cell in line)} |\n' for line in lines)


def _shown(row: Row) -> str:
    tests = (f'`{test}`{" †" if test in _failed_before() else ""}' for test in row.get('tests', ()))
    return '<br>'.join([*tests, *filter(None, [row.get('not_tested')])])


@cache
def _failed_before() -> frozenset[str]:
    """Returns the tests that were run with the packages of 0.1.0, and fail there."""
    return frozenset(line for line in FAILED_BEFORE.read_text().splitlines() if not line.startswith('#'))


def faults(name: str, row: Row) -> list[str]:
    """Returns what is wrong with a row: keys, missing tests, tests that do not exist."""
    allowed = {*COLUMNS[name], 'tests', 'not_tested'}
    wrong = [f'unknown: {key}' for key in row.keys() - allowed] + [f'missing: {key}' for key in COLUMNS[name].keys() - row.keys()]
    if not (row.get('tests') or row.get('not_tested')):
        wrong.append('no test')
    return wrong + [f'there is no {test}' for test in row.get('tests', ()) if not _exists(test)]


def _exists(test: str) -> bool:
    path, _, function = test.partition('::')
    return (ROOT / path).is_file() and function in _functions(ROOT / path)


@cache
def _functions(path: Path) -> frozenset[str]:
    return frozenset(node.name for node in ast.parse(path.read_text()).body if isinstance(node, ast.FunctionDef))


def generate(text: str, sections: Mapping[str, Sequence[Row]]) -> str:
    """Returns the page with new tables.

    Raises:
        ValueError: the page or the rows have other sections than ``COLUMNS``.
    """
    names = [match[2] for match in SECTION.finditer(text)]
    if not sorted(names) == sorted(sections) == sorted(COLUMNS):
        raise ValueError(f'{PAGE.name} has the sections {names}, the rows {list(sections)}; expected {list(COLUMNS)}')
    return SECTION.sub(lambda match: f'{match[1]}{table(match[2], sections[match[2]])}{match[3]}', text)


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the page, or check it. Returns the exit code."""
    parser = argparse.ArgumentParser(description='Write the tables of docs/robustness.md.')
    parser.add_argument('--check', action='store_true', help='change nothing; exit with 1 if the tables are out of date')
    check = parser.parse_args(arguments).check
    before = PAGE.read_text()
    after = generate(before, read_rows())
    if check:
        if before != after:
            print(f'{PAGE.relative_to(ROOT)} is out of date: run python tools/robustness.py', file=sys.stderr)
        return int(before != after)
    PAGE.write_text(after)
    return 0


if __name__ == '__main__':
    sys.exit(main())
