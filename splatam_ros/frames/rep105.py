"""Transforms between the coordinate frames of REP 105: ``map → odom → base → camera``.

The core reports the pose of the camera in its world: the first camera, in optical axes. ``map`` equals that world, or
with ``world_up: z_up`` it is upright (REP 103: x forward, z up) and starts at the first base, or at the first camera
if there is no base.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from splatam_core.errors import ConfigError
from splatam_core.geometry import se3
from splatam_core.settings import shown
from splatam_ros.frames.buffer import TransformBuffer, TransformError
from splatam_ros.frames.options import FrameOptions
from splatam_ros.throttled_warnings import ThrottledWarnings

Matrix = NDArray[np.float64]
Link = tuple[str, str]  # parent and child

MAX_METRES = 1e6
SHORTEST_QUATERNION = 1e-6  # squares of shorter ones lose their digits

# Optical axes (x right, y down, z forward) in body axes (x forward, y left, z up); REP 103.
T_BODY_OPTICAL: Matrix = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


@dataclass(frozen=True, slots=True, eq=False)
class Located:
    """A tracked camera in the coordinate frames of ROS.

    Attributes:
        stamp_ns: stamp of the frame.
        camera_frame: name of the camera's optical frame.
        body_frame: name of the located body: the base, or the camera if there is no base.
        T_map_world: [4, 4] core's world to map.
        T_map_camera: [4, 4] pose of the camera in the map.
        T_map_body: [4, 4] pose of the body in the map.
        T_map_odom: [4, 4] correction of the odometry; None if the odometry is not known at this stamp.
        T_map_steady: [4, 4] all corrections of the map by loops, and jumps of a camera that was found elsewhere: poses times its
            inverse never jump.
        up_world: [3] upward direction in the core's world, by an Imu at rest; None if it is not known.
    """

    stamp_ns: int
    camera_frame: str
    body_frame: str
    T_map_world: Matrix
    T_map_camera: Matrix
    T_map_body: Matrix
    T_map_odom: Matrix | None
    T_map_steady: Matrix = field(default_factory=lambda: np.eye(4))
    up_world: Matrix | None = None

    @property
    def T_steady_body(self) -> Matrix:
        """[4, 4] pose of the body in a frame in which it never jumps."""
        return se3.inverse(self.T_map_steady) @ self.T_map_body


class CoordinateFrames:
    """Names of the coordinate frames and the transforms between them."""

    def __init__(self, options: FrameOptions, buffer: TransformBuffer, warnings: ThrottledWarnings) -> None:
        """Check the options.

        Args:
            options: names and sources of the frames.
            buffer: transforms received from others.
            warnings: receives a warning when a transform is missing.

        Raises:
            ConfigError: the options contradict each other, or ``camera_in_base`` is not a pose.
        """
        self._options = options
        self._buffer = buffer
        self._warnings = warnings
        self._T_base_camera = parse_pose('camera_in_base', options.camera_in_base) if options.camera_in_base else None
        self._publishes_camera = False
        if self._T_base_camera is not None and not options.base_frame:
            raise ConfigError("camera_in_base is set, but base_frame is ''; name the frame that the camera is fixed to")
        if options.has_odometry and not options.odom_frame:
            raise ConfigError(f"odom_frame is '', but odom.source is {options.odom_source}; name the odometry's frame")
        names = [name for name in (options.map_frame, options.odom_frame, options.base_frame) if name]
        if not options.map_frame or len(set(names)) < len(names):
            raise ConfigError(f'map_frame, odom_frame and base_frame are {names}; map_frame must be set, and all names must differ')

    def camera_frame(self, frame_id: str) -> str:
        """Returns the name of the camera's frame, given the frame id of an image."""
        return self._options.camera_frame or frame_id.removeprefix('/')

    def body_frame(self, camera_frame: str) -> str:
        """Returns the name of the located body: the base, or the camera if there is no base."""
        return self._options.base_frame or camera_frame

    def locate(
        self, stamp_ns: int, frame_id: str, T_world_cam: Matrix, T_map_world: Matrix | None, T_world_odom: Matrix | None = None
    ) -> Located | None:
        """Express a tracked camera in the coordinate frames of ROS.

        Args:
            stamp_ns: stamp of the frame.
            frame_id: frame id of its colour image.
            T_world_cam: [4, 4] camera to the core's world.
            T_map_world: [4, 4] core's world to map; None for the first located frame of a world, which defines it.
            T_world_odom: [4, 4] all corrections of the core's world so far; None = none.

        Returns:
            None, after a warning, while the pose of the camera in the base is not known.
        """
        camera_frame = self.camera_frame(frame_id)
        try:
            T_body_camera = self._T_body_camera(camera_frame, stamp_ns)
        except TransformError as error:
            self._warnings.warn(
                'extrinsic', f"nothing is published: the pose of '{camera_frame}' in '{self._options.base_frame}' is not "
                f'known ({error}); publish it on /tf_static, or set camera_in_base',
            )  # fmt: skip
            return None
        if T_map_world is None:
            T_map_world = self._new_map(T_body_camera)
        T_map_camera = T_map_world @ T_world_cam
        T_map_steady = _steady(T_map_world, T_world_odom)
        return Located(
            stamp_ns=stamp_ns,
            camera_frame=camera_frame,
            body_frame=self.body_frame(camera_frame),
            T_map_world=T_map_world,
            T_map_camera=T_map_camera,
            T_map_body=T_map_camera @ se3.inverse(T_body_camera),
            T_map_odom=self._T_map_odom(T_map_camera, camera_frame, stamp_ns) if self._options.has_odometry else T_map_steady,
            T_map_steady=T_map_steady,
        )

    def told(self, stamp_ns: int, frame_id: str, T_map_body: Matrix, T_map_world: Matrix | None) -> Matrix:
        """Returns the [4, 4] pose of the camera in the core's world that a person means by a pose of the body in the map.

        Without a base the pose is that of the camera in body axes: its x axis is where the camera looks.

        Args:
            stamp_ns: stamp of the frame that the pose is for.
            frame_id: frame id of its colour image.
            T_map_body: [4, 4] what the person says.
            T_map_world: [4, 4] core's world to map; None before the first located frame of a world.

        Raises:
            TransformError: the pose of the camera in the base is not known.
        """
        T_body_camera = self._T_body_camera(self.camera_frame(frame_id), stamp_ns)
        if T_map_world is None:
            T_map_world = self._new_map(T_body_camera)
        return se3.inverse(T_map_world) @ T_map_body @ (T_body_camera if self._options.base_frame else T_BODY_OPTICAL)

    def odometry(self, camera_frame: str, stamp_ns: int, timeout_s: float = 0.0) -> Matrix:
        """Returns the [4, 4] pose of the camera in the odometry's frame.

        Raises:
            TransformError: it is not known at the stamp, even after waiting for it.
        """
        T_odom_body = self._buffer.lookup(self._options.odom_frame, self.body_frame(camera_frame), stamp_ns, timeout_s)
        return T_odom_body @ self._T_body_camera(camera_frame, stamp_ns)

    def moving(self, located: Located) -> dict[Link, Matrix]:
        """Returns the transforms to publish on ``/tf``: ``T_parent_child`` by (parent, child)."""
        map_frame, odom_frame = self._options.map_frame, self._options.odom_frame
        if located.body_frame in ('', map_frame, odom_frame):
            self._warnings.warn(
                'body', f"nothing is published on /tf: the camera's frame is '{located.body_frame}', which must have a name, and "
                f"another one than '{map_frame}' and '{odom_frame}'; set the images' frame id in the driver, or camera_frame",
            )  # fmt: skip
            return {}
        if self._options.has_odometry:
            return {} if located.T_map_odom is None else {(map_frame, odom_frame): located.T_map_odom}
        if (parent := self._buffer.static_parent(located.body_frame)) is not None:
            self._warnings.warn(
                'parents', f"nothing is published on /tf: on /tf_static '{located.body_frame}' is fixed to '{parent}', and "
                f"a frame can have one parent only; set base_frame to '{self._buffer.static_root(parent)}'",
            )  # fmt: skip
            return {}
        if not odom_frame:
            return {(map_frame, located.body_frame): located.T_map_body}
        return {(map_frame, odom_frame): located.T_map_steady, (odom_frame, located.body_frame): located.T_steady_body}

    def lasting(self, moving: Mapping[Link, Matrix]) -> dict[Link, Matrix]:
        """Returns those of the moving transforms that still hold while the camera is lost: the correction of the odometry."""
        link = self._options.map_frame, self._options.odom_frame
        return {link: moving[link]} if link in moving else {}

    def corrected(self, lasting: Mapping[Link, Matrix], located: Located, T_world_odom: Matrix) -> dict[Link, Matrix]:
        """Returns transforms from the map that were right at a frame, after the corrections since.

        Args:
            lasting: the transforms.
            located: the frame.
            T_world_odom: [4, 4] all corrections of the core's world until now.
        """
        now = _steady(located.T_map_world, T_world_odom)
        if (now == located.T_map_steady).all():
            return dict(lasting)
        return {link: now @ se3.inverse(located.T_map_steady) @ T for link, T in lasting.items()}

    def static(self, camera_frame: str) -> dict[Link, Matrix]:
        """Returns the transforms to publish on ``/tf_static``: the camera in the base, unless someone else publishes it."""
        if self._T_base_camera is None:
            return {}
        self._publishes_camera |= self._buffer.static_parent(camera_frame) is None  # later, the buffer holds our own
        if not self._publishes_camera:
            self._warnings.warn(
                'two extrinsics',
                f"camera_in_base is used but not published, because /tf_static already has '{camera_frame}'",
            )
            return {}
        return {(self._options.base_frame, camera_frame): self._T_base_camera}

    def _T_body_camera(self, camera_frame: str, stamp_ns: int) -> Matrix:
        if not self._options.base_frame:
            return np.eye(4)
        if self._T_base_camera is not None:
            return self._T_base_camera
        return self._buffer.lookup(self._options.base_frame, camera_frame, stamp_ns)

    def _new_map(self, T_body_camera: Matrix) -> Matrix:
        """Returns the [4, 4] ``T_map_world`` of a world that begins."""
        if self._options.world_up == 'optical':
            return np.eye(4)
        return T_body_camera if self._options.base_frame else T_BODY_OPTICAL

    def _T_map_odom(self, T_map_camera: Matrix, camera_frame: str, stamp_ns: int) -> Matrix | None:
        try:
            return T_map_camera @ se3.inverse(self.odometry(camera_frame, stamp_ns))
        except TransformError:  # OdometryPrior has waited for it and has warned
            return None


def _steady(T_map_world: Matrix, T_world_odom: Matrix | None) -> Matrix:
    """Returns all corrections [4, 4] of the core's world, as motions in the map; see ``Located.T_map_steady``."""
    if T_world_odom is None or (T_world_odom == np.eye(4)).all():
        return np.eye(4)
    return T_map_world @ T_world_odom @ se3.inverse(T_map_world)


def parse_pose(name: str, text: str) -> Matrix:
    """Parse ``x y z qx qy qz qw`` or ``x y z roll pitch yaw`` (metres, radians, rotations about fixed axes).

    Args:
        name: name of the parameter, for the error message.
        text: numbers separated by spaces or commas.

    Returns:
        [4, 4] pose.

    Raises:
        ConfigError: the text is not a pose.
    """
    try:
        values = np.array([float(word) for word in text.replace(',', ' ').split()])
    except ValueError:
        values = np.empty(0)
    is_pose = len(values) in (6, 7) and (np.abs(values) <= MAX_METRES).all()  # False for NaN
    if not is_pose or (len(values) == 7 and not np.linalg.norm(values[3:]) >= SHORTEST_QUATERNION):
        raise ConfigError(f"{name} = {shown(text)}: expected 'x y z qx qy qz qw' or 'x y z roll pitch yaw', in metres and radians")
    if len(values) == 7:
        return se3.compose(values[[6, 3, 4, 5]], values[:3])
    T = np.eye(4)
    for axis, angle in enumerate(values[3:]):  # about x first, then the fixed y, then the fixed z
        T = se3.exp(np.concatenate([np.zeros(3), angle * np.eye(3)[axis]])) @ T
    T[:3, 3] = values[:3]
    return T
