"""Play a recording into the node as fast as SLAM allows; save and exit at its end.

ros2 launch splatam_ros bag.launch.py bag:=/path/to/recording save_path:=out/run
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
    ('rgb', '/rgb/image', 'colour topic of the recording'),
    ('depth', '/depth/image', 'depth topic of the recording, registered to colour'),
    ('info', '/rgb/camera_info', 'camera info topic of the recording, of the colour camera'),
    ('rate', 'max', "playback rate; 'max' = as fast as SLAM allows"),
    ('params_file', DEFAULT_PARAMETERS, 'parameter file'),
    ('preset', 'quick', 'SLAM preset: name of a shipped preset, or path of a .yaml file'),
    ('save_path', '', 'folder for trajectory, map and metrics; empty = save nothing'),
)


def generate_launch_description() -> LaunchDescription:
    """Returns the player and the node, which processes every frame and exits at the end of the recording."""
    value = {name: LaunchConfiguration(name) for name, _, _ in ARGUMENTS}
    node = Node(
        package='splatam_ros',
        executable='splatam_node',
        output='screen',
        parameters=[
            ParameterFile(value['params_file']),
            {name: ParameterValue(value[name], value_type=str) for name in ('preset', 'save_path')},
            {'queue_policy': 'all', 'exit_on_publisher_end': True},
        ],
        remappings=[('rgb/image', value['rgb']), ('depth/image', value['depth']), ('rgb/camera_info', value['info'])],
        on_exit=Shutdown(),
    )
    player = Node(
        package='splatam_ros',
        executable='splatam_bag_player',
        output='screen',
        arguments=[LaunchConfiguration('bag'), '--rate', value['rate'], '--wait-for'],
    )
    arguments = [
        DeclareLaunchArgument(name, default_value=default, description=description) for name, default, description in ARGUMENTS
    ]
    bag = DeclareLaunchArgument('bag', description='the recording: a rosbag2 folder or file')
    return LaunchDescription([*arguments, bag, node, player])
