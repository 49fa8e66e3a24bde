"""Sizes that keep the code readable: of functions, of calls, of what comes back, and of the pages that people start with."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ('msg_adapters', 'splatam_core', 'splatam_ros', 'tools', 'benchmarks')
MAX_FUNCTION_LINES = 60
MAX_POSITIONAL = 6
MAX_TUPLE = 3
PAGES = {'splatam_core/slam.py': 130, 'splatam_core/tracking/alignment.py': 180, 'splatam_ros/node/node.py': 250}

PARSERS = {'add_arguments', '_add_arguments', 'make_parser', 'main'}  # a list of options is read from top to bottom
DEVICE_CODE = 'splatam_core/rasterizer/triton/kernels.py'  # Triton knows neither keywords nor dataclasses there
AUTOGRAD = {'forward', 'backward'}  # torch prescribes what a Function takes and gives back
PLAIN_LISTS = {'max', 'min', 'zip', 'print', 'run', 'start_camera'}  # any number of like things: words of a command, say


def python_files() -> list[Path]:
    """Every Python file of the project but its tests."""
    return sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob('*.py'))


def findings(source: str, name: str) -> Iterator[str]:
    """One line for everything that is too large."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef):
            lines = node.end_lineno - node.lineno + 1
            if lines > MAX_FUNCTION_LINES and node.name not in PARSERS:
                yield f'{name}:{node.lineno} {node.name} has {lines} lines'
            if (size := tuple_size(node)) > MAX_TUPLE and node.name not in AUTOGRAD and name != DEVICE_CODE:
                yield f'{name}:{node.lineno} {node.name} returns {size} values: return a dataclass'
        elif isinstance(node, ast.Call) and name != DEVICE_CODE:
            positional = [argument for argument in node.args if not isinstance(argument, ast.Starred)]
            called = ast.unparse(node.func).rpartition('.')[2]
            if len(positional) > MAX_POSITIONAL and called not in PLAIN_LISTS:
                yield f'{name}:{node.lineno} calls {called} with {len(positional)} positional arguments: use keywords'


def tuple_size(function: ast.FunctionDef) -> int:
    """How many values of kinds of their own a function's annotation promises; 0 where it returns no tuple."""
    annotation = function.returns
    if not isinstance(annotation, ast.Subscript) or ast.unparse(annotation.value) != 'tuple':
        return 0
    elements = annotation.slice.elts if isinstance(annotation.slice, ast.Tuple) else [annotation.slice]
    return 0 if any(isinstance(element, ast.Constant) for element in elements) else len(elements)


@pytest.mark.parametrize('path', python_files(), ids=lambda path: path.relative_to(ROOT).as_posix())
def test_functions_calls_and_results_are_small(path: Path) -> None:
    assert list(findings(path.read_text(), path.relative_to(ROOT).as_posix())) == []


@pytest.mark.parametrize(('page', 'lines'), PAGES.items())
def test_what_is_read_first_fits_its_page(page: str, lines: int) -> None:
    assert len((ROOT / page).read_text().splitlines()) <= lines


def test_what_is_too_large_is_seen() -> None:
    long = 'def f():\n' + '    pass\n' * MAX_FUNCTION_LINES
    assert [line.partition(' ')[2] for line in findings(long, 'x')] == ['f has 61 lines']
    assert list(findings('g(1, 2, 3, 4, 5, 6, 7)', 'x')) and not list(findings('g(1, 2, 3, 4, 5, 6, a=7, b=8)', 'x'))
    assert list(findings('def f() -> tuple[int, str, int, str]: ...', 'x'))
    assert not list(findings('def f() -> tuple[int, ...]: ...', 'x')) and not list(findings('def f() -> tuple[A, B, C]: ...', 'x'))
