"""Start the node with an argument for every topic.

ros2 launch splatam_ros splatam.launch.py rgb:=/color depth:=/depth info:=/info namespace:=/robot
"""

from __future__ import annotations

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, Shutdown
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterFile, ParameterValue
from launch_ros.substitutions import FindPackageShare

DEFAULT_PARAMETERS = PathJoinSubstitution([FindPackageShare('splatam_ros'), 'config', 'ros', 'node.yaml'])
ARGUMENTS = (
    ('rgb', 'rgb/image', 'colour topic'),
    ('depth', 'depth/image', 'depth topic, registered to colour'),
    ('info', 'rgb/camera_info', 'camera info of the colour camera'),
    ('odom', 'odom', 'odometry topic; used with odom.source topic'),
    ('name', 'splatam', 'name of the node'),
    ('namespace', '', 'namespace of the node'),
    ('params_file', DEFAULT_PARAMETERS, 'parameter file'),
    ('preset', 'quick', 'SLAM preset: name of a shipped preset, or path of a .yaml file'),
    ('save_path', '', 'folder for trajectory, map and metrics; empty = save nothing'),
    ('load_path', '', 'map to load at start; empty = start a new map'),
    ('use_sim_time', 'false', 'use the time of /clock'),
)


def generate_launch_description() -> LaunchDescription:
    """Returns the node; when it exits, everything launched with it is shut down."""
    value = {name: LaunchConfiguration(name) for name, _, _ in ARGUMENTS}
    node = Node(
        package='splatam_ros',
        executable='splatam_node',
        name=value['name'],
        namespace=value['namespace'],
        output='screen',
        parameters=[
            ParameterFile(value['params_file']),
            {name: ParameterValue(value[name], value_type=str) for name in ('preset', 'save_path', 'load_path')},
            {'use_sim_time': ParameterValue(value['use_sim_time'], value_type=bool)},
        ],
        remappings=[
            ('rgb/image', value['rgb']),
            ('depth/image', value['depth']),
            ('rgb/camera_info', value['info']),
            ('odom', value['odom']),
        ],
        on_exit=Shutdown(),
    )
    arguments = [
        DeclareLaunchArgument(name, default_value=default, description=description) for name, default, description in ARGUMENTS
    ]
    return LaunchDescription([*arguments, node])
