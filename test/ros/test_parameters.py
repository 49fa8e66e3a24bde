"""Parameters: from the user's words to checked options, and back to ROS descriptors."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import rclpy
from graph import Graph, node_arguments
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter

from splatam_core.config import load_config, settings
from splatam_core.errors import ConfigError
from splatam_ros import parameters
from splatam_ros.parameters import NODE_SETTINGS

MakeNode = Callable[..., Node]


@pytest.fixture
def make_node(graph: Graph) -> Iterator[MakeNode]:
    context = Context()
    rclpy.init(context=context, domain_id=graph.domain)
    nodes: list[Node] = []

    def make(*ros_arguments: str, **values: Any) -> Node:
        node = Node(
            'splatam', context=context, cli_args=node_arguments(*ros_arguments, **values), use_global_arguments=False,
            automatically_declare_parameters_from_overrides=True,
        )  # fmt: skip
        nodes.append(node)
        return node

    yield make
    for node in nodes:
        node.destroy_node()
    rclpy.try_shutdown(context=context)


def test_nothing_given_means_the_documented_defaults(make_node: MakeNode) -> None:
    node = make_node()
    options, config = parameters.declare(node)
    assert config == load_config('quick')
    for setting in NODE_SETTINGS:
        assert getattr(options, setting.name.replace('.', '_')) == setting.default
        assert node.get_parameter(setting.name).value == setting.default
    assert options.folder is None


def test_ros_shows_what_is_used_not_what_was_the_default(make_node: MakeNode) -> None:
    node = make_node(preset='quick', slam__tracking__iterations=7, sync__max_interval=1, save_path='/tmp/x')
    options, config = parameters.declare(node)
    assert config == load_config('quick', {'tracking.iterations': 7})
    assert node.get_parameter('slam.tracking.iterations').value == 7
    assert node.get_parameter('slam.mapping.iterations').value == load_config('quick').mapping.iterations
    assert options.sync_max_interval == 1.0 and isinstance(options.sync_max_interval, float)
    assert options.folder == Path('/tmp/x')


def test_every_setting_has_a_descriptor_with_help_and_bounds(make_node: MakeNode) -> None:
    node = make_node()
    parameters.declare(node)
    for setting in settings():
        descriptor = node.describe_parameter(f'slam.{setting.name}')
        assert descriptor.description.startswith(setting.help) and descriptor.read_only
        ranges = [*descriptor.integer_range, *descriptor.floating_point_range]
        assert len(ranges) == (setting.minimum is not None or setting.maximum is not None)
        if setting.minimum is not None:
            assert ranges[0].from_value == setting.minimum
        assert all(choice in descriptor.additional_constraints for choice in setting.choices)


def test_a_parameter_file_for_all_nodes_is_read(make_node: MakeNode, tmp_path: Path) -> None:
    path = tmp_path / 'node.yaml'
    path.write_text('/**:\n  ros__parameters:\n    queue_size: 7\n    slam: {keyframes: {every: 9}}\n')
    options, config = parameters.declare(make_node('--params-file', str(path)))
    assert options.queue_size == 7 and config.keyframes.every == 9


@pytest.mark.parametrize(
    ('values', 'message'),
    [
        ({'slam__tracking__iteratons': 3}, "unknown key 'tracking.iteratons'; did you mean 'tracking.iterations'"),
        ({'slam__tracking__iterations': 2.5}, 'tracking.iterations = 2.5: expected a whole number'),
        ({'preset': 'quik'}, "unknown preset 'quik'; shipped:"),
        ({'sync__mode': 'fuzzy'}, "sync.mode = 'fuzzy': expected one of exact, approximate"),
        ({'queue_size': 0}, 'queue_size = 0: expected a whole number at least 1'),
        ({'save_on_shutdown': 'maybe'}, "save_on_shutdown = 'maybe': expected true or false"),
        ({'publish_rate__cloud': -1.0}, 'publish_rate.cloud = -1.0: expected a number at least 0'),
    ],
)
def test_what_is_not_allowed_is_refused(make_node: MakeNode, values: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message.replace('.', r'\.')):
        parameters.declare(make_node(**values))


def test_parameters_cannot_change_at_run_time(make_node: MakeNode) -> None:
    node = make_node()
    parameters.declare(node)
    result = node.set_parameters([Parameter('slam.tracking.iterations', value=3)])[0]
    assert not result.successful
