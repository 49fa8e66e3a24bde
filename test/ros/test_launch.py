"""What is shipped to start the node with."""

from __future__ import annotations

from pathlib import Path

import pytest
import rclpy
from graph import ROOT, Graph
from rclpy.context import Context
from rclpy.node import Node

from splatam_core.resources import config_dir
from splatam_ros import parameters

LAUNCH = ROOT / 'splatam_ros' / 'launch' / 'splatam.launch.py'


@pytest.mark.parametrize('path', sorted((config_dir() / 'ros').glob('*.yaml')), ids=lambda path: path.stem)
def test_parameter_files_hold_known_names_and_allowed_values(
    graph: Graph, path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
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


def test_the_launch_file_is_valid_python() -> None:
    compile(LAUNCH.read_text(), str(LAUNCH), 'exec')


def test_the_launch_file_describes_node_and_player() -> None:
    launch = pytest.importorskip('launch', reason='launch comes with a ROS installation, not with pip')
    pytest.importorskip('launch_ros', reason='as above')
    namespace: dict[str, object] = {}
    exec(compile(LAUNCH.read_text(), str(LAUNCH), 'exec'), namespace)
    description = namespace['generate_launch_description']()
    assert isinstance(description, launch.LaunchDescription)
    assert sum(type(entity).__name__ == 'Node' for entity in description.entities) == 2
