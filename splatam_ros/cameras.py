"""Topics that the drivers of common cameras publish, for the launch file and the documentation.

They are taken from the drivers' documentation (``source``) and were not tested with a camera. Suitable parameters are in
``config/ros/NAME.yaml``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class CameraTopics:
    """Topics of a driver.

    Attributes:
        title: name of the camera.
        driver: command that starts the driver with depth registered to colour.
        rgb: colour topic.
        depth: depth topic, registered to colour.
        info: CameraInfo topic of the colour camera.
        facts: encodings and other facts.
        source: URL of the documentation.
    """

    title: str
    driver: str
    rgb: str
    depth: str
    info: str
    facts: str
    source: str


CAMERAS: Mapping[str, CameraTopics] = {
    'realsense': CameraTopics(
        title='Intel RealSense D4xx',
        driver='ros2 launch realsense2_camera rs_launch.py align_depth.enable:=true enable_sync:=true',
        rgb='/camera/camera/color/image_raw',
        depth='/camera/camera/aligned_depth_to_color/image_raw',
        info='/camera/camera/color/camera_info',
        facts='rgb8, 16UC1 in mm; aligned depth has the stamp of its colour image',
        source='https://github.com/IntelRealSense/realsense-ros',
    ),
    'azure_kinect': CameraTopics(
        title='Azure Kinect',
        driver='ros2 launch azure_kinect_ros_driver driver.launch.py color_enabled:=true',
        rgb='/rgb/image_raw',
        depth='/depth_to_rgb/image_raw',
        info='/rgb/camera_info',
        facts='bgra8, 32FC1 in m or 16UC1 in mm; not undistorted: colour and depth have the same distortion (rational_polynomial)',
        source='https://github.com/microsoft/Azure_Kinect_ROS_Driver/blob/melodic/docs/usage.md',
    ),
    'orbbec': CameraTopics(
        title='Orbbec (Gemini, Femto, Astra)',
        driver='ros2 launch orbbec_camera gemini_330_series.launch.py depth_registration:=true',
        rgb='/camera/color/image_raw',
        depth='/camera/depth/image_raw',
        info='/camera/color/camera_info',
        facts='16UC1 in mm; without depth_registration the depth on the same topic is not registered',
        source='https://orbbec.github.io/OrbbecSDK_ROS2/en/source/4_application_guide/topics.html',
    ),
    'oak': CameraTopics(
        title='Luxonis OAK-D',
        driver='ros2 launch depthai_ros_driver camera.launch.py',
        rgb='/oak/rgb/image_raw',
        depth='/oak/stereo/image_raw',
        info='/oak/rgb/camera_info',
        facts='16UC1 in mm; needs the pipeline type RGBD with i_align_depth; the stamps of colour and depth differ slightly',
        source='https://docs.luxonis.com/software/ros/depthai-ros/driver',
    ),
    'zed': CameraTopics(
        title='Stereolabs ZED',
        driver='ros2 launch zed_wrapper zed_camera.launch.py camera_model:=zed2i',
        rgb='/zed/zed_node/rgb/color/rect/image',
        depth='/zed/zed_node/depth/depth_registered',
        info='/zed/zed_node/rgb/color/rect/camera_info',
        facts='bgra8 or bgr8, 32FC1 in m (16UC1 in mm with openni_depth_mode); rectified; versions of the wrapper before 5 publish '
        'rgb/image_rect_color and rgb/camera_info',
        source='https://www.stereolabs.com/docs/ros2',
    ),
    'tum': CameraTopics(
        title='TUM RGB-D recordings',
        driver='splatam_bag_player rgbd_dataset_freiburg1_desk.bag',
        rgb='/camera/rgb/image_color',
        depth='/camera/depth/image',
        info='/camera/rgb/camera_info',
        facts='rgb8, 32FC1 in m; registered; stamps of colour and depth differ by up to half a frame period; frame ids differ',
        source='https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats',
    ),
}
