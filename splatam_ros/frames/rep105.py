"""Where things are in ROS's frames, ``map → odom → base → camera`` (REP 105).

What is given is where the camera is in the core's world, which is the first camera in optical axes and stays so.
``map`` is the same, or with ``world_up: z_up`` upright (REP 103: x forward, z up): where the base was at first, or
without a base the first camera.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatam_core.errors import ConfigError
from splatam_core.geometry import se3
from splatam_ros.frames.buffer import TransformError, TransformTree
from splatam_ros.node.parameters import NodeOptions
from splatam_ros.throttled_warnings import ThrottledWarnings

Matrix = NDArray[np.float64]

# Optical axes (x right, y down, z forward) in a body's (x forward, y left, z up); REP 103.
T_BODY_OPTICAL: Matrix = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


@dataclass(frozen=True, slots=True, eq=False)
class Located:
    """A tracked camera in ROS's frames.

    Attributes:
        stamp_ns: of the frame.
        camera_frame: name of the camera's optical frame.
        body_frame: name of what is located: the base, or the camera where no base is known.
        T_map_world: [4, 4] from the core's world.
        T_map_camera: [4, 4] pose of the camera.
        T_map_body: [4, 4] pose of the body.
        T_map_odom: [4, 4] what the odometry has to be corrected by; None where it is not known at this stamp.
    """

    stamp_ns: int
    camera_frame: str
    body_frame: str
    T_map_world: Matrix
    T_map_camera: Matrix
    T_map_body: Matrix
    T_map_odom: Matrix | None


class Frames:
    """Names of the frames and the transforms between them."""

    def __init__(self, options: NodeOptions, tree: TransformTree, warnings: ThrottledWarnings) -> None:
        """Check the parameters.

        Raises:
            ConfigError: they contradict each other, or ``camera_in_base`` is no pose.
        """
        self._options = options
        self._tree = tree
        self._warnings = warnings
        self._T_base_camera = parse_pose('camera_in_base', options.camera_in_base) if options.camera_in_base else None
        self._T_map_world: Matrix | None = None
        self._fixes_camera = False
        if self._T_base_camera is not None and not options.base_frame:
            raise ConfigError("camera_in_base is set, but base_frame is ''; name the frame that the camera is fixed to")
        if self.has_odometry and not options.odom_frame:
            raise ConfigError(f"odom_frame is '', but odom.source is {options.odom_source}; name the odometry's frame")
        names = [name for name in (options.map_frame, options.odom_frame, options.base_frame) if name]
        if not options.map_frame or len(set(names)) < len(names):
            raise ConfigError(f'map_frame, odom_frame and base_frame are {names}; map_frame is needed, and all differ')

    @property
    def has_odometry(self) -> bool:
        """Whether somebody else says where the body is in the odometry's frame."""
        return self._options.odom_source != 'none'

    @property
    def looks_up(self) -> bool:
        """Whether the pose of the camera in the base is looked up."""
        return bool(self._options.base_frame) and self._T_base_camera is None

    def reset(self) -> None:
        """A new world begins."""
        self._T_map_world = None

    def camera_frame(self, header_frame: str) -> str:
        """Name of the camera's frame, given what the images' headers say."""
        return self._options.camera_frame or header_frame.removeprefix('/')

    def body_frame(self, camera_frame: str) -> str:
        """Name of what is located."""
        return self._options.base_frame or camera_frame

    def locate(self, stamp_ns: int, T_world_cam: Matrix, camera_frame: str) -> Located | None:
        """A tracked camera in ROS's frames; None, with a warning, while the camera's pose in the base is not known."""
        try:
            T_body_camera = self._T_body_camera(camera_frame, stamp_ns)
        except TransformError as error:
            self._warnings.warn(
                'extrinsic', f"nothing is published: where '{camera_frame}' is in '{self._options.base_frame}' is not "
                f'known ({error}); publish it on /tf_static, or set camera_in_base',
            )  # fmt: skip
            return None
        if self._T_map_world is None:
            self._T_map_world = self._upright(T_body_camera)
        T_map_camera = self._T_map_world @ T_world_cam
        return Located(
            stamp_ns, camera_frame, self.body_frame(camera_frame), self._T_map_world, T_map_camera,
            T_map_camera @ se3.inverse(T_body_camera), self._T_map_odom(T_map_camera, camera_frame, stamp_ns),
        )  # fmt: skip

    def odometry(self, camera_frame: str, stamp_ns: int, timeout_s: float = 0.0) -> Matrix:
        """[4, 4] pose of the camera in the odometry's frame.

        Raises:
            TransformError: it is not known at the stamp, even after waiting for it.
        """
        T_odom_body = self._tree.lookup(self._options.odom_frame, self.body_frame(camera_frame), stamp_ns, timeout_s)
        return T_odom_body @ self._T_body_camera(camera_frame, stamp_ns)

    def moving(self, located: Located) -> dict[tuple[str, str], Matrix]:
        """What belongs on ``/tf``: ``T_parent_child`` by (parent, child)."""
        map_frame, odom_frame = self._options.map_frame, self._options.odom_frame
        if self.has_odometry:
            return {} if located.T_map_odom is None else {(map_frame, odom_frame): located.T_map_odom}
        if (parent := self._tree.fixed_parent(located.body_frame)) is not None:
            self._warnings.warn(
                'parents', f"nothing on /tf: '{located.body_frame}' is fixed to '{parent}' by /tf_static, and a "
                f"frame has one parent; set base_frame to '{self._tree.root(parent)}'",
            )  # fmt: skip
            return {}
        if not odom_frame:
            return {(map_frame, located.body_frame): located.T_map_body}
        return {(map_frame, odom_frame): np.eye(4), (odom_frame, located.body_frame): located.T_map_body}

    def fixed(self, camera_frame: str) -> dict[tuple[str, str], Matrix]:
        """What belongs on ``/tf_static``: the camera in the base, where a parameter says so and nobody else does."""
        if self._T_base_camera is None:
            return {}
        self._fixes_camera |= self._tree.fixed_parent(camera_frame) is None  # then we hear ourselves
        if not self._fixes_camera:
            self._warnings.warn(
                'two extrinsics', f"camera_in_base is used but not published: /tf_static has '{camera_frame}' already"
            )
            return {}
        return {(self._options.base_frame, camera_frame): self._T_base_camera}

    def _T_body_camera(self, camera_frame: str, stamp_ns: int) -> Matrix:
        if not self._options.base_frame:
            return np.eye(4)
        if self._T_base_camera is not None:
            return self._T_base_camera
        return self._tree.lookup(self._options.base_frame, camera_frame, stamp_ns)

    def _upright(self, T_body_camera: Matrix) -> Matrix:
        """[4, 4] ``T_map_world``."""
        if self._options.world_up == 'optical':
            return np.eye(4)
        return T_body_camera if self._options.base_frame else T_BODY_OPTICAL

    def _T_map_odom(self, T_map_camera: Matrix, camera_frame: str, stamp_ns: int) -> Matrix | None:
        if not self.has_odometry:
            return np.eye(4)
        try:
            return T_map_camera @ se3.inverse(self.odometry(camera_frame, stamp_ns))
        except TransformError:  # the motion prior has waited for it, and said so
            return None


def parse_pose(name: str, text: str) -> Matrix:
    """[4, 4] of ``x y z qx qy qz qw`` or ``x y z roll pitch yaw`` (metres, radians, rotations about fixed axes).

    Raises:
        ConfigError: the text of this parameter is no pose.
    """
    try:
        values = np.array([float(word) for word in text.replace(',', ' ').split()])
    except ValueError:
        values = np.empty(0)
    is_pose = len(values) in (6, 7) and np.isfinite(values).all()
    if not is_pose or (len(values) == 7 and not values[3:].any()):
        raise ConfigError(f"{name} = '{text}': expected 'x y z qx qy qz qw' or 'x y z roll pitch yaw', in metres and radians")
    if len(values) == 7:
        return se3.compose(values[[6, 3, 4, 5]], values[:3])
    T = np.eye(4)
    for axis, angle in enumerate(values[3:]):  # about x first, then the fixed y, then the fixed z
        T = se3.exp(np.concatenate([np.zeros(3), angle * np.eye(3)[axis]])) @ T
    T[:3, 3] = values[:3]
    return T
