"""Parameters: from user input to checked options, and to ROS descriptors."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import rclpy
from graph import Graph, node_arguments
from rcl_interfaces.msg import SetParametersResult
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter

from splatam_core.config import SlamConfig, load_config, settings
from splatam_core.errors import ConfigError
from splatam_core.settings import Setting
from splatam_ros.node import parameters
from splatam_ros.node.main import make_parser
from splatam_ros.node.parameters import NODE_SETTINGS, NodeOptions
from splatam_ros.node.reconfiguration import Reconfiguration

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
    named = {f'slam.{setting.name}': setting for setting in settings()} | {item.name: item for item in NODE_SETTINGS}
    for name, setting in named.items():
        descriptor = node.describe_parameter(name)
        assert setting.help and descriptor.description.startswith(setting.help)
        assert not setting.unit or descriptor.description.endswith(f'[{setting.unit}]')
        why = parameters.why_fixed(name)
        assert ('cannot change at run time' in descriptor.additional_constraints) == bool(why)
        ranges = [*descriptor.integer_range, *descriptor.floating_point_range]
        assert len(ranges) == (setting.minimum is not None or setting.maximum is not None)
        if setting.minimum is not None:
            assert ranges[0].from_value == setting.minimum
        assert all((choice or "''") in descriptor.additional_constraints for choice in setting.choices)


def test_the_help_of_every_number_says_when_to_change_it() -> None:
    numbers = [setting for setting in NODE_SETTINGS if setting.type in (int, float)]
    assert [setting.name for setting in numbers if not re.search(r'[Ii]ncrease|[Dd]ecrease|Set ', setting.help)] == []


def test_what_is_empty_is_shown_in_help_and_constraints() -> None:
    empty = Setting('name', str, '', 'Help.', '', None, None, ('', 'one'))
    assert (empty.shown_default, empty.shown_choices) == ('empty', "'', one")
    with pytest.raises(ConfigError, match="name = 'two': expected one of '', one"):
        empty.check('two')
    assert '(, ' not in make_parser().format_help() and 'One of ,' not in make_parser().format_help()


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


class Changes:
    """A node whose parameters can change; records the calls about changes."""

    def __init__(self, node: Node) -> None:
        self.node = node
        self.options: list[NodeOptions] = []
        self.configs: list[SlamConfig] = []
        Reconfiguration(node, *parameters.declare(node), self.options.append, self.configs.append)

    def set(self, **values: Any) -> SetParametersResult:
        changes = [Parameter(name.replace('__', '.'), value=value) for name, value in values.items()]
        return self.node.set_parameters_atomically(changes)


def test_what_may_change_at_run_time_is_handed_on(make_node: MakeNode) -> None:
    changes = Changes(make_node())
    assert changes.set(max_rate_hz=5.0, publish_rate__cloud=2.0, slam__tracking__iterations=3).successful
    assert (changes.options[0].max_rate_hz, changes.options[0].publish_rate_cloud) == (5.0, 2.0)
    assert changes.configs == [load_config('quick', {'tracking.iterations': 3})]
    assert changes.set(slam__depth__max_m=3.0).successful
    assert changes.configs[1] == load_config('quick', {'tracking.iterations': 3, 'depth.max_m': 3.0})
    assert len(changes.options) == 1


@pytest.mark.parametrize(
    ('values', 'reason'),
    [
        ({'preset': 'tum'}, 'preset cannot change while the node runs: all other settings start from it'),
        ({'width': 320}, 'width cannot change while the node runs: frames of another size'),
        ({'sync__mode': 'exact'}, 'sync.mode cannot change while the node runs: it is read when the node starts'),
        ({'slam__threads': 2}, 'slam.threads cannot change while the node runs: the threads are already running'),
        ({'save_path': '/tmp/elsewhere'}, 'save_root is empty'),
        ({'max_rate_hz': -1.0}, 'max_rate_hz out of range'),
        ({'slam__tracking__iterations': -1}, 'slam.tracking.iterations out of range'),
        ({'max_rate_hz': 'fast'}, 'Wrong parameter type'),
        ({'on_time_jump': 'explode'}, "on_time_jump = 'explode': expected one of reset, continue"),
        ({'load_pose': '1 2 3'}, "load_pose = '1 2 3': expected 'x y z qx qy qz qw'"),
        ({'load_pose': '1 2 3 0 0 0 0'}, "load_pose = '1 2 3 0 0 0 0': expected"),
        ({'slam__depth__min_m': 200.0}, 'expected less than depth.max_m'),
        ({'load_pose': '1e300 2 3 0 0 0'}, "load_pose = '1e300 2 3 0 0 0': expected"),
        ({'load_pose': '1 2 3 0 0 0 1e-200'}, 'expected'),
        ({'load_path': '~nosuchuser/x.ply'}, "load_path = '~nosuchuser/x.ply': cannot be used as a path"),
        ({'load_path': '/' + 'x' * 300}, 'cannot be used as a path: File name too long'),
        ({'load_path': '/tmp/a\0b'}, 'cannot be used as a path'),
        ({'slam__keyframes__overlap_samples': 10**15}, 'slam.keyframes.overlap_samples out of range'),
        ({'slam__mapping__means_rate': float('nan')}, 'means_rate'),
        ({'slam__mapping__means_rate': float('inf')}, 'means_rate'),
        ({'finish_limit': float('inf')}, 'finish_limit'),
    ],
)  # fmt: skip
def test_what_may_not_change_at_run_time_is_refused_with_the_reason(
    make_node: MakeNode, values: dict[str, Any], reason: str
) -> None:
    changes = Changes(make_node())
    result = changes.set(**values, no_data_timeout=1.0)
    assert not result.successful and reason in result.reason
    assert not changes.options and not changes.configs  # all or nothing
    assert changes.node.get_parameter('no_data_timeout').value == 5.0


@pytest.mark.parametrize(
    'name', [*(f'slam.{setting.name}' for setting in settings()), *(setting.name for setting in NODE_SETTINGS)]
)
def test_no_value_of_any_parameter_raises(make_node: MakeNode, name: str) -> None:
    """Whatever is set at run time is accepted or refused with a reason in one line."""
    changes = Changes(make_node(save_root='/nowhere/at/all'))
    setting = next(item for item in (*settings(), *NODE_SETTINGS) if item.name == name.removeprefix('slam.'))
    odd = {
        int: [2**63 - 1, -(2**63), 0], float: [1e308, -1e308, 5e-324, float('nan'), float('inf'), 0.0], bool: [True, False],
        str: ['', 'x' * 100_000, '~nosuchuser/x', '/' + 'x' * 300, '/nowhere/at/all/' + 'x' * 300, 'a\0b', '\n'],
    }[setting.type]  # fmt: skip
    for value in odd:
        result = changes.node.set_parameters_atomically([Parameter(name, value=value)])
        assert result.successful or (result.reason and '\n' not in result.reason), (value, result.reason)


def test_every_whole_number_has_an_upper_bound() -> None:
    unbounded = [setting.name for setting in (*settings(), *NODE_SETTINGS) if setting.type is int and setting.maximum is None]
    assert unbounded == []


def test_a_parameter_that_nobody_knows_is_refused_at_run_time(make_node: MakeNode) -> None:
    changes = Changes(make_node(max_rate_hzz=5.0))  # at start a warning, since a file may be for several nodes
    result = changes.set(max_rate_hzz=6.0)
    assert not result.successful and "unknown parameter 'max_rate_hzz'; did you mean 'max_rate_hz'?" in result.reason


def test_a_folder_to_save_in_may_change_below_the_root_only(make_node: MakeNode, tmp_path: Path) -> None:
    root, outside = tmp_path / 'root', tmp_path / 'outside'
    for folder in (root / 'full', outside):
        folder.mkdir(parents=True)
    (root / 'full' / 'thesis.tex').touch()
    (root / 'link').symlink_to(outside)
    changes = Changes(make_node(save_root=root))
    for path in (outside / 'run', root, root / '..' / 'outside' / 'run', root / 'link' / 'run'):
        result = changes.set(save_path=str(path))
        assert not result.successful and 'expected a folder below save_root' in result.reason, path
    for path in (root / ('x' * 300), root / 'a\0b', root / '~nosuchuser' / ('x' * 300)):
        result = changes.set(save_path=str(path))
        assert not result.successful and 'cannot be used as a path' in result.reason, path
    result = changes.set(save_path=str(root / 'full'))
    assert not result.successful and 'choose another folder' in result.reason
    assert changes.set(save_path=str(root / 'new' / 'run')).successful
    assert [options.folder for options in changes.options] == [root / 'new' / 'run']
