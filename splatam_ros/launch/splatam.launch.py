"""Start the node on a camera's topics, or on a recording.

    ros2 launch splatam_ros splatam.launch.py rgb:=/camera/color/image_raw \\
        depth:=/camera/aligned_depth_to_color/image_raw info:=/camera/color/camera_info
    ros2 launch splatam_ros splatam.launch.py bag:=/path/to/recording save_path:=out/run
"""

from __future__ import annotations

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, Shutdown
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution, PythonExpression
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

ARGUMENTS = (
    ('preset', 'quick', 'SLAM preset: the name of a shipped one, or a .yaml file'),
    ('save_path', '', 'folder for trajectory, map and metrics; empty: nothing is saved'),
    ('rgb', '/rgb/image', 'colour topic'),
    ('depth', '/depth/image', 'depth topic, registered to colour'),
    ('info', '/rgb/camera_info', 'camera info of the colour camera'),
    ('bag', '', 'recording to play as well; its end ends everything'),
    ('rate', '1', "speed of the recording; 'max' is as fast as SLAM can follow"),
)


def generate_launch_description() -> LaunchDescription:
    """The node, and the player when there is a recording to play."""
    value = {name: LaunchConfiguration(name) for name, _, _ in ARGUMENTS}
    plays = PythonExpression(["'", value['bag'], "' != ''"])
    parameter_file = PathJoinSubstitution([FindPackageShare('splatam_ros'), 'config', 'ros', 'node.yaml'])
    node = Node(
        package='splatam_ros',
        executable='splatam_node',
        output='screen',
        parameters=[
            parameter_file,
            {
                'preset': ParameterValue(value['preset'], value_type=str),
                'save_path': ParameterValue(value['save_path'], value_type=str),
                'queue_policy': PythonExpression(["'all' if ", plays, " else 'latest'"]),
                'exit_on_publisher_end': ParameterValue(plays, value_type=bool),
            },
        ],
        remappings=[('rgb/image', value['rgb']), ('depth/image', value['depth']), ('rgb/camera_info', value['info'])],
        on_exit=Shutdown(),
    )
    player = Node(
        package='splatam_ros',
        executable='splatam_bag_player',
        output='screen',
        arguments=[value['bag'], '--rate', value['rate'], '--wait-for'],
        condition=IfCondition(plays),
    )
    arguments = [
        DeclareLaunchArgument(name, default_value=default, description=description)
        for name, default, description in ARGUMENTS
    ]
    return LaunchDescription([*arguments, node, player])
