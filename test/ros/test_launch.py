"""Launch files and parameter files."""

from __future__ import annotations

import ast
import sys
import types
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
import rclpy
from graph import ROOT, Graph
from rclpy.context import Context
from rclpy.node import Node

from splatam_core.resources import config_dir
from splatam_ros.cameras import CAMERAS
from splatam_ros.interface import INPUTS
from splatam_ros.node import parameters
from splatam_ros.node.parameters import NODE_SETTINGS

LAUNCH = ROOT / 'splatam_ros' / 'launch'


@pytest.mark.parametrize('path', sorted((config_dir() / 'ros').glob('*.yaml')), ids=lambda path: path.stem)
def test_parameter_files_hold_known_names_and_allowed_values(graph: Graph, path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    context = Context()
    rclpy.init(context=context, domain_id=graph.domain)
    node = Node(
        'splatam', context=context, cli_args=['--ros-args', '--params-file', str(path)], use_global_arguments=False,
        automatically_declare_parameters_from_overrides=True,
    )  # fmt: skip
    try:
        parameters.declare(node)
    finally:
        node.destroy_node()
        rclpy.try_shutdown(context=context)
    assert 'unknown parameter' not in ''.join(capfd.readouterr())


class Recorder:
    """Stands in for a class of ``launch``, which pip does not have; records its arguments."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.args, self.kwargs = args, kwargs

    def find(self, name: str) -> Iterator[Recorder]:
        """Yields every recorded object of a class among the arguments, recursively."""
        yield from _find((self.args, self.kwargs), name)

    def perform(self, context: Mapping[str, str]) -> str:
        return context[self.args[0]]


def _find(value: Any, name: str) -> Iterator[Recorder]:
    if isinstance(value, Recorder):
        if type(value).__name__ == name:
            yield value
        yield from value.find(name)
    elif isinstance(value, Mapping):
        for item in value.values():
            yield from _find(item, name)
    elif isinstance(value, (list, tuple)):
        for item in value:
            yield from _find(item, name)


@pytest.fixture
def describe(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Recorder]:
    """Returns a function that runs a launch file's ``generate_launch_description``."""

    def run(name: str) -> Recorder:
        source = (LAUNCH / name).read_text()
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.ImportFrom) and node.module.split('.')[0] in ('launch', 'launch_ros'):
                module = sys.modules.get(node.module) or types.ModuleType(node.module)
                for alias in node.names:
                    setattr(module, alias.name, type(alias.name, (Recorder,), {}))
                monkeypatch.setitem(sys.modules, node.module, module)
        namespace: dict[str, Any] = {'__name__': name}
        exec(compile(source, name, 'exec'), namespace)
        return namespace['generate_launch_description']()

    return run


FILES = ('splatam.launch.py', 'camera.launch.py', 'bag.launch.py')


@pytest.mark.parametrize('name', FILES)
def test_launch_files_use_arguments_that_they_declare(describe: Callable[[str], Recorder], name: str) -> None:
    """They use all of them, no others, and each has a description."""
    description = describe(name)
    declared = {argument.args[0] for argument in description.find('DeclareLaunchArgument')}
    assert all(argument.kwargs['description'] for argument in description.find('DeclareLaunchArgument'))
    entities = list(description.args[0])
    for action in description.find('OpaqueFunction'):
        entities += action.kwargs['function']({'camera': 'realsense'})
    used = {value.args[0] for value in _find(entities, 'LaunchConfiguration')} | ({'camera'} & declared)
    assert used == declared


@pytest.mark.parametrize('camera', ['', *CAMERAS])
def test_launch_files_remap_inputs_and_set_parameters_that_exist(describe: Callable[[str], Recorder], camera: str) -> None:
    if camera:
        (action,) = describe('camera.launch.py').find('OpaqueFunction')
        nodes = action.kwargs['function']({'camera': camera})
        remapped = dict(nodes[0].kwargs['remappings'])
        found = CAMERAS[camera]
        assert (remapped['rgb/image'], remapped['depth/image']) == (found.rgb, found.depth)
        assert (config_dir() / 'ros' / f'{camera}.yaml').is_file()
    else:
        nodes = [node for name in FILES[::2] for node in describe(name).find('Node')]
    inputs = {topic.name for topic in INPUTS}
    settings = {setting.name for setting in NODE_SETTINGS} | {'use_sim_time'}
    for node in nodes:
        assert node.kwargs['executable'] in ('splatam_node', 'splatam_bag_player')
        assert {name for name, _ in node.kwargs.get('remappings', ())} <= inputs
        for given in node.kwargs.get('parameters', ()):
            assert isinstance(given, Recorder) or given.keys() <= settings


def test_a_camera_that_nobody_knows_is_one_error_that_lists_them(describe: Callable[[str], Recorder]) -> None:
    (action,) = describe('camera.launch.py').find('OpaqueFunction')
    with pytest.raises(ValueError, match="camera 'kinect': expected one of realsense, azure_kinect"):
        action.kwargs['function']({'camera': 'kinect'})
