"""The node's ROS parameters: its own, and the whole SLAM configuration below ``slam.``.

Both are tables of ``Setting``: names, help, units and bounds become ROS descriptors. Values from the user are checked
against the same tables, so the command line and ROS report the same errors.
"""

from __future__ import annotations

import difflib
import errno
import os
import sys
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node

from msg_adapters.synchronizer import Mode
from splatam_core.config import SlamConfig, flat_values, load_config, settings
from splatam_core.errors import ConfigError, one_line
from splatam_core.maps.grid import GridSettings
from splatam_core.settings import Setting, Value, shown
from splatam_ros.frames.options import FrameOptions

SLAM = 'slam.'
ROS_OWN = ('use_sim_time', 'start_type_description_service', 'qos_overrides.')
MAX_INTEGER = 2**63 - 1
MIN_WIDTH = 16
MAX_NAME = 255  # bytes; of common file systems


def _setting(
    name: str, default: Value, help: str, unit: str = '', minimum: float | None = None, maximum: float | None = None,
    choices: tuple[str, ...] = (),
) -> Setting:  # fmt: skip
    return Setting(
        name=name, type=type(default), default=default, help=help, unit=unit, minimum=minimum, maximum=maximum,
        choices=choices,
    )  # fmt: skip


NODE_SETTINGS: tuple[Setting, ...] = (
    _setting('preset', 'quick', 'SLAM preset: name of a shipped preset, or path of a .yaml file.'),
    _setting('save_path', '', 'New or empty folder for trajectory, map and metrics; empty = save nothing.'),
    _setting('save_root', '', 'At run time save_path can change to a folder below this one; empty = it cannot change.'),
    _setting('overwrite', False, 'Replace an earlier run in save_path, if the folder holds nothing else.'),
    _setting('save_on_shutdown', True, 'Save map and metrics at shutdown. The trajectory is written frame by frame anyway.'),
    _setting(
        'finish_limit', 3.0, 'Longest time for mapping.fused.final_passes when the node is asked to stop. ros2 launch kills a '
        'process 10 s after Ctrl-C; increase only if nothing kills the node. A node that ends by itself '
        '(exit_on_publisher_end) has no limit.', 's', 0.1,
    ),
    _setting('load_path', '', 'Map to load at start and on ~/load_map: a .ply file, or the folder of a run.'),
    _setting('load_pose', '', 'Pose of the camera in the loaded map: x y z qx qy qz qw; empty = look for it by the keyframes '
             'beside the map (map.keyframes), or without them start where the map began.', 'm'),
    _setting('width', 0, 'Resize frames to this width. Decrease for speed. 0 = keep the size.', 'px', 0, 16384),
    _setting('map_frame', 'map', 'Coordinate frame of poses and map.'),
    _setting('odom_frame', 'odom', 'Coordinate frame between map and base; empty = base is a child of map.'),
    _setting('base_frame', '', 'Coordinate frame of the robot that carries the camera; empty = locate only the camera.'),
    _setting('camera_frame', '', "Optical frame of the camera; empty = use the images' frame id."),
    _setting('camera_in_base', '', 'Pose of the camera in base_frame: x y z qx qy qz qw, or x y z roll pitch yaw; '
             'empty = look it up on /tf_static.', 'm, rad'),
    _setting('world_up', 'optical', 'Axes of map_frame: optical = those of the first camera (z forward, y down); '
             'z_up = upright (x forward, z up).',
             choices=('optical', 'z_up')),
    _setting('publish_tf', True, 'Publish transforms on /tf and /tf_static.'),
    _setting('odom.source', 'none', 'Motion from which tracking starts: none = constant velocity, topic = the topic odom, '
             'tf = odom_frame to base_frame on TF. With topic or tf the node publishes map to odom_frame as the correction.',
             choices=('none', 'topic', 'tf')),
    _setting('odom.max_wait', 0.1, 'Longest wait for odometry that is newer than the frame. Increase when odometry arrives '
             'later than the images.', 's', 0.0, 10.0),
    _setting('stddev.position', 0.02, 'For trackers that estimate no covariance: standard deviation of the position when the '
             'whole frame agrees with the map. Increase when a filter trusts the poses too much.', 'm', 1e-6, 100.0),
    _setting('stddev.orientation', 0.01, 'For trackers that estimate no covariance: standard deviation of the orientation when '
             'the whole frame agrees with the map. Increase when a filter trusts the poses too much.', 'rad', 1e-6, 10.0),
    _setting('rgb_transport', 'raw', 'Transport of rgb/image; compressed = subscribe to rgb/image/compressed.',
             choices=('raw', 'compressed')),
    _setting('depth_transport', 'raw', 'Transport of depth/image; compressedDepth = subscribe to '
             'depth/image/compressedDepth.',
             choices=('raw', 'compressedDepth')),
    _setting('depth_scale', 0.001, 'Length of one step of 16-bit depth images. Set it when they are not in '
             'millimetres (TUM PNG files: 0.0002).', 'm', 1e-6, 1.0),
    _setting('rgb_encoding', '', 'How to read images of encoding 8UC3 or 8UC4, which do not say the order of the channels; empty '
             '= bgr8, with a warning.', choices=('', 'bgr8', 'rgb8')),
    _setting('undistort', True, 'Undistort images by K and D of CameraInfo; false = the images are rectified (image_rect), '
             'and P is their camera.'),
    _setting('sync.mode', 'approximate', 'How colour and depth are paired: by equal stamps, or by the nearest stamps.',
             choices=('exact', 'approximate')),
    _setting('sync.max_interval', 0.0, 'Largest difference between the stamps of a pair (approximate only); 0 = half the time '
             'between colour images, but 0.02 to 0.05. Increase when nothing pairs; decrease when a moving camera smears the map.',
             's', 0.0, 10.0),
    _setting('sync.queue_size', 30, 'Number of colour and of depth images that can wait for a partner. Increase when one '
             'stream arrives much later than the other.', '', 1, 1000),
    _setting('use_receive_time', False, 'Stamp images with the time at which they are received, for drivers that do not stamp. '
             'Colour and depth must then be sent together.'),
    _setting('on_time_jump', 'reset', 'What to do when stamps jump back, e.g. when a recording loops: reset = start a new map, '
             'continue = keep the map and continue from the last pose.',
             choices=('reset', 'continue')),
    _setting('time_jump_threshold', 1.0, 'Stamps that fall back by more than this are a time jump; by less, the image is late '
             'and dropped. Increase when images are delayed by more.', 's', 0.0, 3600.0),
    _setting('on_camera_change', 'reset', 'What to do when CameraInfo changes: reset = start a new map, refuse = drop frames of '
             'the other camera.',
             choices=('reset', 'refuse')),
    _setting('lost_reset_after', 0.0, 'Start a new map after the camera was lost for this long; 0 = never. '
             'Set it when the camera does not come back to where it was.', 's', 0.0, 3600.0),
    _setting('max_rate_hz', 0.0, 'Largest number of frames per second, by their stamps, that are passed to SLAM; 0 = all. '
             'Decrease to leave time to other processes.',
             'Hz', 0.0, 1000.0),
    _setting('input_reliability', 'auto', 'QoS reliability of the inputs; auto = reliable, or best effort if the publisher '
             'offers only that.',
             choices=('auto', 'reliable', 'best_effort')),
    _setting('queue_policy', 'latest', 'What to do when frames come faster than SLAM: latest = drop the oldest (live camera), '
             'all = keep every frame and slow the input down (recording).',
             choices=('latest', 'all')),
    _setting('queue_size', 2, 'Number of frames that can wait for SLAM. Decrease for less delay, increase when the frame rate '
             'is uneven.', '', 1, 1000),
    _setting('max_cloud_points', 200_000, 'Largest number of points in a published cloud. Decrease when the network is slow.',
             '', 1, 50_000_000),
    _setting('max_path_poses', 2000, 'Largest number of poses in a published path; a longer path is thinned out evenly. '
             'Decrease when the network is slow.', '',
             2, 1_000_000),
    _setting('publish_rate.path', 1.0, 'Largest rate of ~/path; 0 = with every pose. Decrease when the network '
             'is slow.', 'Hz', 0.0, 1000.0),
    _setting('publish_rate.render', 0.0, 'Largest rate of ~/render/*; 0 = with every pose. Decrease to save time.', 'Hz', 0.0,
             1000.0),
    _setting('publish_rate.cloud', 1.0, 'Largest rate of ~/map/points; 0 = with every pose. Decrease when the '
             'network is slow.', 'Hz', 0.0, 1000.0),
    _setting('publish_rate.grid', 1.0, 'Largest rate of ~/map/grid; 0 = with every pose. Decrease to save time.', 'Hz', 0.0,
             1000.0),
    _setting('grid.resolution', 0.05, 'Side of a cell of ~/map/grid. Increase for large halls and slow machines.', 'm', 0.01, 1.0),
    _setting('grid.min_height', 0.1, 'Lowest height over the floor (over the base, if base_frame is set) at which something is an '
             'obstacle. Increase when an uneven floor shows as obstacles.', 'm', -10.0, 100.0),
    _setting('grid.max_height', 1.0, 'Highest such height: that of the robot. Increase for a taller robot.', 'm', -10.0, 100.0),
    _setting('grid.range', 4.0, 'Depth beyond this adds nothing to the grid. Increase when depth is precise far away.', 'm', 0.5,
             100.0),
    _setting('grid.imu', False, 'Without base_frame: take up from the topic imu while it rests, instead of from the floor that the '
             'camera sees. How the Imu is fixed to the camera must be on /tf_static.'),
    _setting('viewer.port', 0, 'Port of a web page that shows the map while it grows, the next free one if it is taken; 0 = off. '
             "Set it to watch. Needs pip install 'splatam_ros[viewer]'.", '', 0, 65535),
    _setting('viewer.host', '127.0.0.1', 'Address that the page listens on. 127.0.0.1 is for this machine only; 0.0.0.0 shows the '
             'page, without a password, to everybody who reaches the machine.'),
    _setting('no_data_timeout', 5.0, 'Warn, with the reason, when no frame was received for this long; 0 = never. Increase when '
             'the camera often pauses.', 's', 0.0,
             3600.0),
    _setting('exit_on_publisher_end', False, 'Save and exit when the publishers of the images are gone and every frame is '
             'processed.'),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class NodeOptions:
    """The node's own parameters, described by ``NODE_SETTINGS``. A dot in a name is an underscore here."""

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
    rgb_encoding: str
    undistort: bool
    sync_mode: Mode
    sync_max_interval: float
    sync_queue_size: int
    use_receive_time: bool
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
    publish_rate_grid: float
    grid_resolution: float
    grid_min_height: float
    grid_max_height: float
    grid_range: float
    grid_imu: bool
    viewer_port: int
    viewer_host: str
    no_data_timeout: float
    exit_on_publisher_end: bool

    @property
    def folder(self) -> Path | None:
        """Folder to save in; None = save nothing.

        Raises:
            ConfigError: the path cannot be used; ``check_options`` finds that out.
        """
        return as_path('save_path', self.save_path) if self.save_path else None

    @property
    def keeps_all(self) -> bool:
        """True if every frame is processed, False if old frames are dropped when SLAM is slower than the camera."""
        return self.queue_policy == 'all'

    @property
    def grid(self) -> GridSettings:
        """What the occupancy grid shows."""
        return GridSettings(self.grid_resolution, self.grid_min_height, self.grid_max_height, self.grid_range)

    @property
    def frames(self) -> FrameOptions:
        """Options of the coordinate frames."""
        return FrameOptions(
            map_frame=self.map_frame,
            odom_frame=self.odom_frame,
            base_frame=self.base_frame,
            camera_frame=self.camera_frame,
            camera_in_base=self.camera_in_base,
            world_up=self.world_up,
            publish_tf=self.publish_tf,
            odom_source=self.odom_source,
            odom_max_wait_s=self.odom_max_wait,
            uses_imu=self.grid_imu,
        )


def as_path(name: str, text: str) -> Path:
    """Returns a path that a user gave; ``~`` is the home folder.

    Args:
        name: name of the parameter, for the error message.
        text: its value.

    Raises:
        ConfigError: no file can have that path.
    """
    try:
        path = Path(text).expanduser()
        with suppress(FileNotFoundError, NotADirectoryError):
            path.stat()
        if any(len(os.fsencode(part)) > MAX_NAME for part in path.parts):  # of a folder that is still to be made
            raise OSError(errno.ENAMETOOLONG, os.strerror(errno.ENAMETOOLONG))
    except (OSError, RuntimeError, ValueError) as error:  # too long, no such user, a NUL
        why = error.strerror if isinstance(error, OSError) else one_line(error)
        raise ConfigError(f'{name} = {shown(text)}: cannot be used as a path: {why}; choose another') from None
    return path


def check_options(options: NodeOptions) -> None:
    """Check what the bounds of single parameters cannot say.

    Raises:
        ConfigError: a value is not allowed.
    """
    for name in ('save_path', 'save_root', 'load_path', 'preset'):
        as_path(name, getattr(options, name))
    if 0 < options.width < MIN_WIDTH:
        raise ConfigError(f'width = {options.width}: expected 0 (keep the size), or at least {MIN_WIDTH} (px)')
    if options.grid_min_height >= options.grid_max_height:
        raise ConfigError(
            f'grid.min_height = {options.grid_min_height:g} is not below grid.max_height = {options.grid_max_height:g}'
        )


def field_name(name: str) -> str:
    """Returns the field of ``NodeOptions`` that holds a parameter."""
    return name.replace('.', '_')


# Parameters that can change while the node runs. All others are read only when it starts.
CHANGEABLE = frozenset({
    'save_path', 'save_on_shutdown', 'finish_limit', 'load_path', 'load_pose', 'on_time_jump', 'on_camera_change',
    'lost_reset_after', 'max_rate_hz', 'max_cloud_points', 'publish_rate.path', 'publish_rate.render', 'publish_rate.cloud',
    'publish_rate.grid', 'grid.resolution', 'grid.min_height', 'grid.max_height', 'grid.range',
    'no_data_timeout', 'exit_on_publisher_end',
})  # fmt: skip
FIXED = {
    'preset': 'all other settings start from it; change those below slam.',
    'save_root': 'it limits what may be changed',
    'width': 'frames of another size belong to another camera',
    'viewer.port': 'the viewer is started with the node',
    'viewer.host': 'the viewer is started with the node',
    'max_path_poses': 'the existing path is thinned out by it',
    'slam.seed': 'it seeds the random numbers of this map when the map starts',
    'slam.width': "it is for 'splatam run'; the node's parameter is width",
    'slam.threads': 'the threads are already running',
    'slam.device': 'the map is already on a device',
    'slam.rasterizer': 'the rasterizer is created when the node starts',
    'slam.tracking.motion_model': 'the motion model is created when the map starts',
    'slam.mapping.anisotropic': 'a map has Gaussians of one kind only',
    'slam.mapping.hold_out': 'the evaluation uses it to find the frames that were held out',
    'slam.mapping.scene_radius_ratio': 'it is read when the map starts',
}


def why_fixed(name: str) -> str:
    """Returns why a parameter cannot change while the node runs; empty if it can."""
    if name in CHANGEABLE or (name.startswith(SLAM) and name not in FIXED):
        return ''
    return FIXED.get(name, 'it is read when the node starts')


def declare(node: Node) -> tuple[NodeOptions, SlamConfig]:
    """Declare every parameter of a node that was created with ``automatically_declare_parameters_from_overrides``.

    Returns:
        The node's own parameters, and the SLAM configuration.

    Raises:
        ConfigError: a ``slam.`` parameter is unknown, or a value is not allowed.
    """
    found: Mapping[str, Any] = node.get_parameters_by_prefix('')
    given = {name: parameter.value for name, parameter in found.items()}
    own = _checked(given)
    check_options(node_options(own))
    _check_names(node, given)
    slam = {name.removeprefix(SLAM): value for name, value in given.items() if name.startswith(SLAM)}
    config = _load(str(own['preset']), slam)
    for setting in NODE_SETTINGS:
        _declare(node, setting.name, setting, own[setting.name])
    values = flat_values(config)
    for setting in settings():
        _declare(node, SLAM + setting.name, setting, values[setting.name])
    return node_options(own), config


def node_options(values: Mapping[str, Value]) -> NodeOptions:
    """Returns options with the given values by parameter name; all others have their defaults. Values are not checked."""
    named = {setting.name: setting.default for setting in NODE_SETTINGS} | dict(values)
    fields: dict[str, Any] = {field_name(name): value for name, value in named.items()}
    return NodeOptions(**fields)


def _checked(given: Mapping[str, object]) -> dict[str, Value]:
    return {setting.name: setting.check(given.get(setting.name, setting.default)) for setting in NODE_SETTINGS}


def _load(preset: str, slam: Mapping[str, object]) -> SlamConfig:
    try:
        return load_config(preset, slam)
    except ConfigError as error:
        raise ConfigError(f'parameters slam.*: {error}' if slam else str(error)) from None


def _check_names(node: Node, given: Mapping[str, object]) -> None:
    """Warn about unknown parameters. They are no error, since a file for several nodes may contain those of others."""
    for name in given:
        if not is_known(name):
            node.get_logger().warning(f"unknown parameter '{name}' is ignored{similar_name(name)}")


def is_known(name: str) -> bool:
    """Returns True if a parameter is one of the node, of SLAM or of ROS itself."""
    return name in (setting.name for setting in NODE_SETTINGS) or name.startswith((SLAM, *ROS_OWN))


def similar_name(name: str) -> str:
    """Returns which of the node's parameters has a similar name, as the end of a sentence; empty if none has."""
    close = difflib.get_close_matches(name, [setting.name for setting in NODE_SETTINGS], n=1)
    return f"; did you mean '{close[0]}'?" if close else ''


def _declare(node: Node, name: str, setting: Setting, value: Value) -> None:
    """Declare one parameter. One that the user gave is declared again, so that ROS knows its type and bounds."""
    if node.has_parameter(name):
        node.undeclare_parameter(name)
    node.declare_parameter(name, value, _descriptor(setting, why_fixed(name)), ignore_override=True)


def _descriptor(setting: Setting, why_fixed: str) -> ParameterDescriptor:
    unit = f' [{setting.unit}]' if setting.unit else ''
    # Not read_only: ROS would refuse a change before the node can give the reason.
    descriptor = ParameterDescriptor(description=setting.help + unit)
    constraints = [f'one of {setting.shown_choices}'] if setting.choices else []
    constraints += [f'cannot change at run time: {why_fixed}'] if why_fixed else []
    descriptor.additional_constraints = '; '.join(constraints)
    if setting.minimum is None and setting.maximum is None:
        return descriptor
    limit = MAX_INTEGER if setting.type is int else sys.float_info.max
    low = -limit if setting.minimum is None else setting.minimum
    high = limit if setting.maximum is None else setting.maximum
    if setting.type is int:
        descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
    else:
        descriptor.floating_point_range = [FloatingPointRange(from_value=float(low), to_value=float(high))]
    return descriptor
