"""Start the node for a camera whose driver is running.

ros2 launch splatam_ros camera.launch.py camera:=realsense save_path:=out/office
"""

from __future__ import annotations

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction, Shutdown
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterFile, ParameterValue
from launch_ros.substitutions import FindPackageShare

from splatam_ros.cameras import CAMERAS

ARGUMENTS = (
    ('camera', 'realsense', 'one of ' + ', '.join(CAMERAS)),
    ('preset', 'quick', 'SLAM preset: name of a shipped preset, or path of a .yaml file'),
    ('save_path', '', 'folder for trajectory, map and metrics; empty = save nothing'),
    ('load_path', '', 'map to load at start; empty = start a new map'),
)


def start(context: LaunchContext) -> list[Node]:
    """Returns the node, on the topics of the chosen camera."""
    name = LaunchConfiguration('camera').perform(context)
    if name not in CAMERAS:
        raise ValueError(f"camera '{name}': expected one of {', '.join(CAMERAS)}")
    camera = CAMERAS[name]
    parameter_file = PathJoinSubstitution([FindPackageShare('splatam_ros'), 'config', 'ros', f'{name}.yaml'])
    given = {name: ParameterValue(LaunchConfiguration(name), value_type=str) for name in ('preset', 'save_path', 'load_path')}
    return [
        Node(
            package='splatam_ros',
            executable='splatam_node',
            output='screen',
            parameters=[ParameterFile(parameter_file), given],
            remappings=[('rgb/image', camera.rgb), ('depth/image', camera.depth), ('rgb/camera_info', camera.info)],
            on_exit=Shutdown(),
        )
    ]


def generate_launch_description() -> LaunchDescription:
    """Returns the arguments, and the node as soon as the name of the camera is known."""
    arguments = [
        DeclareLaunchArgument(name, default_value=default, description=description) for name, default, description in ARGUMENTS
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=start)])
