"""Play a recording into the node as fast as SLAM can follow; when it is over, save and end.

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
    ('depth', '/depth/image', 'its depth topic, registered to colour'),
    ('info', '/rgb/camera_info', 'its camera info of the colour camera'),
    ('rate', 'max', "speed; 'max' is as fast as SLAM can follow"),
    ('params_file', DEFAULT_PARAMETERS, 'parameter file'),
    ('preset', 'quick', 'SLAM preset: the name of a shipped one, or a .yaml file'),
    ('save_path', '', 'folder for trajectory, map and metrics; empty: nothing is saved'),
)


def generate_launch_description() -> LaunchDescription:
    """The node, which keeps every frame and ends with the recording, and the player."""
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
