"""Parameter changes while the node runs: checked as a set, then refused with a reason or passed on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from splatam_core.config import SlamConfig, check_effect, with_values
from splatam_core.errors import ConfigError
from splatam_core.lifecycle import check_truth
from splatam_core.runs.layout import check_is_free
from splatam_core.settings import shown
from splatam_ros.node.attempt import why
from splatam_ros.node.map_lifecycle import load_pose
from splatam_ros.node.parameters import (
    NODE_SETTINGS,
    SLAM,
    NodeOptions,
    as_path,
    check_options,
    field_name,
    is_known,
    similar_name,
    why_fixed,
)

SETTINGS = {setting.name: setting for setting in NODE_SETTINGS}


class Reconfiguration:
    """Checks and applies parameter changes. A set of changes is applied as a whole or not at all.

    Attributes:
        options: the node's current parameters.
        config: the current SLAM configuration.
    """

    def __init__(
        self, node: Node, options: NodeOptions, config: SlamConfig,
        on_options: Callable[[NodeOptions], None], on_config: Callable[[SlamConfig], None],
    ) -> None:  # fmt: skip
        """Register with the node.

        Args:
            node: the node that has the parameters.
            options: options at the start.
            config: configuration at the start.
            on_options: called after the node's own parameters have changed.
            on_config: called after the SLAM configuration has changed.
        """
        self.options = options
        self.config = config
        self._node = node
        self._on_options = on_options
        self._on_config = on_config
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._apply)

    def _check(self, changes: Sequence[Parameter]) -> SetParametersResult:
        try:
            for change in changes:
                _check_may_change(change.name)
            options, config = self._changed(changes)
            check_truth(config, None)
            check_options(options)
            if options.save_path != self.options.save_path:
                check_save_path(options)
            load_pose(options)
        except Exception as error:  # noqa: BLE001 - whatever is wrong with a value, the node continues with the old one
            return SetParametersResult(successful=False, reason=why(error))
        return SetParametersResult(successful=True)

    def _apply(self, changes: Sequence[Parameter]) -> None:
        options, config = self._changed(changes)
        if options != self.options:
            self.options = options
            self._on_options(options)
        if config != self.config:
            self.config = config
            self._on_config(config)

    def _changed(self, changes: Sequence[Parameter]) -> tuple[NodeOptions, SlamConfig]:
        own: dict[str, Any] = {
            field_name(change.name): SETTINGS[change.name].check(change.value) for change in changes if change.name in SETTINGS
        }
        slam = {change.name.removeprefix(SLAM): change.value for change in changes if change.name.startswith(SLAM)}
        config = with_values(self.config, slam)
        check_effect(self.config, config)
        return replace(self.options, **own), config


def _check_may_change(name: str) -> None:
    if not is_known(name):
        raise ConfigError(f"unknown parameter '{name}'{similar_name(name)}")
    if (name in SETTINGS or name.startswith(SLAM)) and (why := why_fixed(name)):
        raise ConfigError(f'{name} cannot change while the node runs: {why}')


def check_save_path(options: NodeOptions) -> None:
    """Check that a ``save_path`` set at run time may be written to.

    Raises:
        ConfigError: ``save_root`` is empty, or the folder is not below it.
        RunFolderError: the folder is not empty.
    """
    if not options.save_root:
        raise ConfigError('save_path cannot change while the node runs: save_root is empty; start the node with it set')
    root = as_path('save_root', options.save_root).resolve()
    path = options.folder
    if path is None or root not in path.resolve().parents:  # with links resolved
        raise ConfigError(f'save_path = {shown(options.save_path)}: expected a folder below save_root, which is {root}')
    check_is_free(path)
