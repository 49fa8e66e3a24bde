"""The node's ROS parameters: its own, and the whole SLAM configuration below ``slam.``.

Both are tables of ``Setting``: names, help, units and bounds become ROS descriptors. What the user gives is
checked against the same tables, so that the command line and ROS complain in the same words.
"""

from __future__ import annotations

import difflib
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node

from splatam_core.config import Setting, SlamConfig, Value, flat_values, load_config, settings
from splatam_core.errors import ConfigError

SLAM = 'slam.'
ROS_OWN = ('use_sim_time', 'start_type_description_service', 'qos_overrides.')
MAX_INTEGER = 2**63 - 1


def _setting(
    name: str, default: Value, help: str, unit: str = '', minimum: float | None = None, maximum: float | None = None,
    choices: tuple[str, ...] = (),
) -> Setting:  # fmt: skip
    return Setting(name, type(default), default, help, unit, minimum, maximum, choices)


NODE_SETTINGS: tuple[Setting, ...] = (
    _setting('preset', 'quick', 'SLAM preset: the name of a shipped one, or a .yaml file.'),
    _setting('save_path', '', 'New or empty folder for trajectory, map and metrics; none = nothing is saved.'),
    _setting('save_root', '', 'save_path may change at run time to a folder below this; none = not at all.'),
    _setting('overwrite', False, 'Replace the run that is in save_path, if nothing else is there.'),
    _setting('save_on_shutdown', True, 'Save map and metrics at the end; the trajectory is written as it goes anyway.'),
    _setting(
        'finish_limit', 3.0, 'Longest time for mapping.final_passes before saving, when asked to stop: launch kills 10 s after '
        'its Ctrl-C. A node that ends by itself (exit_on_publisher_end) takes as long as they need.', 's', 0.1
    ),
    _setting('load_path', '', 'Map for ~/load_map, a .ply file or the folder of a run; loaded at the start, too.'),
    _setting('load_pose', '', 'Where the camera is in a loaded map, x y z qx qy qz qw; none = where it began.', 'm'),
    _setting('width', 0, 'Resize frames to this width; 0 = as they come.', 'px', 0, 16384),
    _setting('map_frame', 'map', 'Frame of poses and map.'),
    _setting('odom_frame', 'odom', 'Frame between map and base; empty = base is a child of map.'),
    _setting('base_frame', '', 'Frame of the robot that the camera is fixed to; empty = the camera is all there is.'),
    _setting('camera_frame', '', "Optical frame of the camera; empty = as the images' headers say."),
    _setting('camera_in_base', '', 'Pose of the camera in base_frame: x y z qx qy qz qw, or x y z roll pitch yaw; '
             'empty = from /tf_static.', 'm, rad'),
    _setting('world_up', 'optical', "Axes of map_frame: the first camera's (z forward, y down), or upright (z up).",
             choices=('optical', 'z_up')),
    _setting('publish_tf', True, 'Publish transforms.'),
    _setting('odom.source', 'none', 'Where to start tracking from: constant velocity, the topic odom, or '
             'odom_frame to base_frame on TF; with the latter two map to odom_frame is published as their correction.',
             choices=('none', 'topic', 'tf')),
    _setting('odom.max_wait', 0.1, 'Wait this long for odometry that is newer than the frame.', 's', 0.0, 10.0),
    _setting('stddev.position', 0.02, 'Of the pose that ~/odometry states, where all of a frame agrees with the map.',
             'm', 1e-6, 100.0),
    _setting('stddev.orientation', 0.01, 'Likewise.', 'rad', 1e-6, 10.0),
    _setting('rgb_transport', 'raw', 'What rgb/image carries; compressed: rgb/image/compressed.',
             choices=('raw', 'compressed')),
    _setting('depth_transport', 'raw', 'What depth/image carries; compressedDepth: depth/image/compressedDepth.',
             choices=('raw', 'compressedDepth')),
    _setting('depth_scale', 0.001, 'A count of 16-bit depth; drivers send millimetres, some recordings others.', 'm',
             1e-6, 1.0),
    _setting('undistort', True, 'Undistort images by K and D; off = they are rectified (image_rect) to camera P.'),
    _setting('sync.mode', 'approximate', 'Pair colour and depth of equal, or of nearby stamps.',
             choices=('exact', 'approximate')),
    _setting('sync.max_interval', 0.02, 'Stamps of a pair differ by at most this.', 's', 0.0, 10.0),
    _setting('sync.queue_size', 30, 'Images of each kind that wait for their partner.', '', 1, 1000),
    _setting('on_time_jump', 'reset', 'When stamps jump back (a recording loops): new map, or go on in this one.',
             choices=('reset', 'continue')),
    _setting('time_jump_threshold', 1.0, 'Stamps that fall back by more have jumped; by less, they are late.', 's',
             0.0, 3600.0),
    _setting('on_camera_change', 'reset', 'When CameraInfo changes: new map, or refuse frames of another camera.',
             choices=('reset', 'refuse')),
    _setting('lost_reset_after', 0.0, 'Start a new map when lost for this long; 0 = never.', 's', 0.0, 3600.0),
    _setting('max_rate_hz', 0.0, 'Frames to SLAM in a second of their own time at most; 0 = all.', 'Hz', 0.0, 1000.0),
    _setting('input_reliability', 'auto', 'QoS of the inputs; auto: reliable, unless a publisher is best effort.',
             choices=('auto', 'reliable', 'best_effort')),
    _setting('queue_policy', 'latest', 'When frames come faster than SLAM: latest drops old ones, all keeps every one.',
             choices=('latest', 'all')),
    _setting('queue_size', 2, 'Frames that wait for SLAM.', '', 1, 1000),
    _setting('max_cloud_points', 200_000, 'Points of a published cloud at most.', '', 1, 50_000_000),
    _setting('max_path_poses', 2000, 'Poses of a published path at most; evenly thinned out.', '', 2, 1_000_000),
    _setting('publish_rate.path', 1.0, 'Paths a second at most; 0 = one a frame.', 'Hz', 0.0, 1000.0),
    _setting('publish_rate.render', 0.0, 'Renders a second at most; 0 = one a frame.', 'Hz', 0.0, 1000.0),
    _setting('publish_rate.cloud', 1.0, 'Clouds a second at most; 0 = one a frame.', 'Hz', 0.0, 1000.0),
    _setting('no_data_timeout', 5.0, 'Say why when no frame has come for this long; 0 = never.', 's', 0.0, 3600.0),
    _setting('exit_on_publisher_end', False, 'Save and exit once the image publishers have left and all is processed.'),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class NodeOptions:
    """The node's own parameters; ``NODE_SETTINGS`` says what each is. Dots are underscores here."""

    preset: str
    save_path: str
    save_root: str
    overwrite: bool
    save_on_shutdown: bool
    finish_limit: float
    load_path: str
    load_pose: str
    width: int
    map_frame: str
    odom_frame: str
    base_frame: str
    camera_frame: str
    camera_in_base: str
    world_up: str
    publish_tf: bool
    odom_source: str
    odom_max_wait: float
    stddev_position: float
    stddev_orientation: float
    rgb_transport: str
    depth_transport: str
    depth_scale: float
    undistort: bool
    sync_mode: str
    sync_max_interval: float
    sync_queue_size: int
    on_time_jump: str
    time_jump_threshold: float
    on_camera_change: str
    lost_reset_after: float
    max_rate_hz: float
    input_reliability: str
    queue_policy: str
    queue_size: int
    max_cloud_points: int
    max_path_poses: int
    publish_rate_path: float
    publish_rate_render: float
    publish_rate_cloud: float
    no_data_timeout: float
    exit_on_publisher_end: bool

    @property
    def folder(self) -> Path | None:
        """Where to save; None = nowhere."""
        return Path(self.save_path).expanduser() if self.save_path else None


def field_name(name: str) -> str:
    """The field of ``NodeOptions`` that a parameter is in."""
    return name.replace('.', '_')


# Everything else is read when the node starts.
CHANGEABLE = frozenset({
    'save_path', 'save_on_shutdown', 'finish_limit', 'load_path', 'load_pose', 'on_time_jump', 'on_camera_change',
    'lost_reset_after', 'max_rate_hz', 'max_cloud_points', 'publish_rate.path', 'publish_rate.render', 'publish_rate.cloud',
    'no_data_timeout', 'exit_on_publisher_end',
})  # fmt: skip
FIXED = {
    'preset': 'it is what all other settings start from; change those below slam.',
    'save_root': 'it is the limit of what may be changed',
    'width': 'frames of another size are those of another camera',
    'max_path_poses': 'the path so far is thinned out by it',
    'slam.seed': 'it is where the random choices of this map started',
    'slam.width': "it is of 'splatam run'; the node's own is width",
    'slam.threads': 'the threads are running',
    'slam.device': 'the map is there',
    'slam.rasterizer': 'it is made when the node starts',
    'slam.tracking.motion_model': 'it is made when the map starts',
    'slam.mapping.anisotropic': 'the map is made of the one kind or of the other',
    'slam.mapping.mode': 'the threads are running',
    'slam.mapping.hold_out': 'frames are told apart by it when the run is scored',
    'slam.mapping.scene_radius_ratio': 'it is read when the map starts',
}


def why_fixed(name: str) -> str:
    """Why a parameter cannot change while the node runs; empty if it can."""
    if name in CHANGEABLE or (name.startswith(SLAM) and name not in FIXED):
        return ''
    return FIXED.get(name, 'it is read when the node starts')


def declare(node: Node) -> tuple[NodeOptions, SlamConfig]:
    """Declare every parameter of a node that was made with ``automatically_declare_parameters_from_overrides``.

    Raises:
        ConfigError: an unknown ``slam.`` parameter, or a value that is not allowed.
    """
    given = {name: parameter.value for name, parameter in node.get_parameters_by_prefix('').items()}
    own = _checked(given)
    _check_names(node, given)
    slam = {name.removeprefix(SLAM): value for name, value in given.items() if name.startswith(SLAM)}
    config = _load(own['preset'], slam)
    for setting in NODE_SETTINGS:
        _declare(node, setting.name, setting, own[setting.name])
    values = flat_values(config)
    for setting in settings():
        _declare(node, SLAM + setting.name, setting, values[setting.name])
    return NodeOptions(**{field_name(name): value for name, value in own.items()}), config


def _checked(given: Mapping[str, object]) -> dict[str, Value]:
    return {setting.name: setting.check(given.get(setting.name, setting.default)) for setting in NODE_SETTINGS}


def _load(preset: str, slam: Mapping[str, object]) -> SlamConfig:
    try:
        return load_config(preset, slam)
    except ConfigError as error:
        raise ConfigError(f'parameters slam.*: {error}' if slam else str(error)) from None


def _check_names(node: Node, given: Mapping[str, object]) -> None:
    """Warn of parameters that are nobody's; a file for several nodes may name them rightly."""
    known = [setting.name for setting in NODE_SETTINGS]
    for name in given:
        if name not in known and not name.startswith((SLAM, *ROS_OWN)):
            close = difflib.get_close_matches(name, known, n=1)
            hint = f"; did you mean '{close[0]}'?" if close else ''
            node.get_logger().warning(f"unknown parameter '{name}' is ignored{hint}")


def _declare(node: Node, name: str, setting: Setting, value: Value) -> None:
    """Declare one parameter, anew if the user gave it: only now its type and bounds are known to ROS."""
    if node.has_parameter(name):
        node.undeclare_parameter(name)
    node.declare_parameter(name, value, _descriptor(setting, why_fixed(name)), ignore_override=True)


def _descriptor(setting: Setting, why_fixed: str) -> ParameterDescriptor:
    unit = f' [{setting.unit}]' if setting.unit else ''
    # Not read_only: ROS would refuse a change before we can say why.
    descriptor = ParameterDescriptor(description=setting.help + unit)
    constraints = ['one of ' + ', '.join(setting.choices)] if setting.choices else []
    constraints += [f'cannot change at run time: {why_fixed}'] if why_fixed else []
    descriptor.additional_constraints = '; '.join(constraints)
    if setting.minimum is None and setting.maximum is None:
        return descriptor
    if setting.type is int:
        low = -MAX_INTEGER if setting.minimum is None else int(setting.minimum)
        high = MAX_INTEGER if setting.maximum is None else int(setting.maximum)
        descriptor.integer_range = [IntegerRange(from_value=low, to_value=high)]
    else:
        low = -sys.float_info.max if setting.minimum is None else setting.minimum
        high = sys.float_info.max if setting.maximum is None else setting.maximum
        descriptor.floating_point_range = [FloatingPointRange(from_value=float(low), to_value=float(high))]
    return descriptor
