"""Options of the coordinate frames, TF and odometry."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class FrameOptions:
    """Names of the coordinate frames and where their transforms come from.

    Attributes:
        map_frame: fixed frame of poses and map.
        odom_frame: frame between map and base; empty if base is a child of map.
        base_frame: frame of the robot; empty if only the camera is located.
        camera_frame: optical frame of the camera; empty to take it from the images' headers.
        camera_in_base: pose of the camera in base_frame as text; empty to look it up on ``/tf_static``.
        world_up: axes of map_frame, ``optical`` or ``z_up``.
        publish_tf: True to publish transforms.
        odom_source: where odometry comes from, ``none``, ``topic`` or ``tf``.
        odom_max_wait_s: longest wait for odometry that is newer than the frame.
        uses_imu: True to take up from an Imu at rest.
    """

    map_frame: str
    odom_frame: str
    base_frame: str
    camera_frame: str
    camera_in_base: str
    world_up: str
    publish_tf: bool
    odom_source: str
    odom_max_wait_s: float
    uses_imu: bool = False

    @property
    def has_odometry(self) -> bool:
        """True if external odometry provides the pose of the base in odom_frame."""
        return self.odom_source != 'none'

    @property
    def looks_up_camera(self) -> bool:
        """True if the pose of the camera in the base is looked up on TF."""
        return bool(self.base_frame) and not self.camera_in_base

    @property
    def subscribes_tf_static(self) -> bool:
        """True if the node needs ``/tf_static``: to look up the camera or the Imu, or to find out which frames have a parent."""
        return self.publish_tf or self.looks_up_camera or self.has_odometry or self.uses_imu

    @property
    def subscribes_tf(self) -> bool:
        """True if the node needs ``/tf``: it carries the odometry."""
        return self.odom_source == 'tf'

    @property
    def needs_tf_messages(self) -> bool:
        """True if the node cannot do all that is configured without tf2_msgs."""
        return self.publish_tf or self.looks_up_camera or self.subscribes_tf
