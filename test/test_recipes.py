"""What CONTRIBUTING.md and docs/architecture.md promise: whoever forgets one step of a recipe is told so by a test."""

from __future__ import annotations

import ast
import importlib
import inspect
import pkgutil
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

from splatam_core import commands, datasets, rasterizer, tracking
from splatam_core.cli import COMMANDS
from splatam_core.config import TrackingConfig, settings
from splatam_core.datasets.registry import READERS
from splatam_core.rasterizer import make_rasterizer
from splatam_ros.cameras import CAMERAS

ROOT = Path(__file__).resolve().parents[1]
CORE = ROOT / 'splatam_core'
OUTPUTS = ROOT / 'splatam_ros' / 'node' / 'outputs.py'
NO_LAYOUT = {'synthetic'}  # it reads no files, and has tests of its own
RECIPES = ('CONTRIBUTING.md', 'docs/architecture.md')


def choices(setting: str) -> set[str]:
    return {choice for known in settings() if known.name == setting for choice in known.choices}


def modules(package: ModuleType) -> Iterator[ModuleType]:
    for info in pkgutil.walk_packages(package.__path__, package.__name__ + '.'):
        yield importlib.import_module(info.name)


def page(name: str) -> str:
    return (ROOT / 'docs' / name).read_text()


# --- a tracker ---


def test_every_tracker_can_be_chosen() -> None:
    assert set(tracking._TRACKERS) == choices('tracking.method')


def test_every_class_that_tracks_is_in_the_table() -> None:
    trackers = {
        value
        for module in modules(tracking)
        for value in vars(module).values()
        if inspect.isclass(value) and value.__module__ == module.__name__ and hasattr(value, 'track')
    }
    assert trackers - {tracking.Tracker} == set(tracking._TRACKERS.values())


def test_every_tracker_is_made_and_called_alike() -> None:
    for method in tracking._TRACKERS:
        tracker = tracking.make_tracker(make_rasterizer('cpu', 1), TrackingConfig(method=method), threads=1)
        for name in ('track', 'motion'):
            assert inspect.signature(getattr(type(tracker), name)) == inspect.signature(getattr(tracking.Tracker, name)), name


# --- a rasterizer ---


def test_every_rasterizer_can_be_chosen() -> None:
    assert set(rasterizer._BACKENDS) == choices('rasterizer') - {'auto'}


def test_every_rasterizer_is_held_to_the_contract() -> None:
    """Against the reference, which defines the contract."""
    text = (ROOT / 'test' / 'core' / 'test_rasterizer_contract.py').read_text()
    held = re.search(r'^BACKENDS = (\[.*?\])$', text, re.MULTILINE | re.DOTALL)
    assert held and {name for name, _ in ast.literal_eval(held[1])} | {'reference'} == set(rasterizer._BACKENDS)


# --- a dataset reader ---


def test_every_reader_is_in_the_table() -> None:
    formats = {module.FORMAT.name for module in modules(datasets) if hasattr(module, 'FORMAT')}
    assert formats == set(READERS)


def test_every_reader_has_a_layout_for_the_contract_test(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / 'test' / 'core'))
    layouts = sys.modules.get('dataset_layouts') or importlib.import_module('dataset_layouts')
    assert {layout.format for layout in layouts.LAYOUTS.values()} == set(READERS) - NO_LAYOUT


def test_every_reader_is_documented() -> None:
    documented = re.findall(r'^\| `(\w+)` \|', page('datasets.md'), re.MULTILINE)
    assert set(documented) == set(READERS)


# --- a command ---


def test_every_command_is_in_the_table_and_documented() -> None:
    written = {module.COMMAND.name for module in modules(commands) if hasattr(module, 'COMMAND')}
    assert written == {command.name for command in COMMANDS}
    assert {name for name in written if f'`splatam {name} ' not in page('commands.md')} == set()


# --- a published topic ---


def test_every_function_of_an_output_is_used() -> None:
    """A function without a row in the table publishes nothing."""
    tree = ast.parse(OUTPUTS.read_text())
    written = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
    used = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
    assert written - used == set()


# --- a setting ---


def test_every_setting_is_read_by_the_core() -> None:
    """A setting that no code reads does nothing."""
    declared = {'config.py', 'settings.py', 'retired_settings.py'}
    code = '\n'.join(path.read_text() for path in CORE.rglob('*.py') if path.name not in declared)
    read = set(re.findall(r'\.(\w+)', code))
    assert {setting.name for setting in settings() if setting.name.rpartition('.')[2] not in read} == set()


# --- a camera ---


def test_every_camera_has_parameters_and_every_file_of_parameters_a_camera() -> None:
    assert {path.stem for path in (ROOT / 'config' / 'ros').glob('*.yaml')} - {'node'} == set(CAMERAS)


# --- the recipes ---


@pytest.mark.parametrize('name', RECIPES)
def test_files_and_tests_that_a_recipe_names_exist(name: str) -> None:
    text = (ROOT / name).read_text()
    functions = {
        node.name
        for path in (ROOT / 'test').rglob('test_*.py')
        for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.FunctionDef)
    }
    missing = [path for path in re.findall(r'`((?:splatam_core|splatam_ros|msg_adapters|test|tools|config)/[\w/.]+\w)`', text)
               if 'NAME' not in path and not (ROOT / path).exists()]  # fmt: skip
    missing += [test for test in re.findall(r'`(?:[\w/.]+::)?(test_\w+)`', text) if test not in functions]
    assert missing == []
