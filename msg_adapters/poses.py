"""Converts poses, as [4, 4] matrices, to and from geometry_msgs and nav_msgs. Quaternions here are x, y, z, w."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msg_adapters import stamps
from msg_adapters.errors import MessageError
from msg_adapters.factory import MessageFactory

Matrix = NDArray[np.float64]
MAX_METRES = 1e9
SHORTEST, LONGEST = 1e-6, 1e6  # lengths of quaternions; squares of far shorter ones lose their digits


def pose_matrix(pose: Any) -> Matrix:
    """Convert a ``geometry_msgs/Pose`` to [4, 4]; the quaternion is normalised.

    Raises:
        MessageError: a number is not finite or far too large, or the quaternion is zero.
    """
    return _matrix('pose', pose.position, pose.orientation)


def transform_matrix(transform: Any) -> Matrix:
    """Convert a ``geometry_msgs/Transform`` to [4, 4]; the quaternion is normalised.

    Raises:
        MessageError: a number is not finite or far too large, or the quaternion is zero.
    """
    return _matrix('transform', transform.translation, transform.rotation)


def _matrix(what: str, p: Any, q: Any) -> Matrix:
    xyzw = np.array([q.x, q.y, q.z, q.w], dtype=np.float64)
    T = np.eye(4)
    T[:3, 3] = p.x, p.y, p.z
    with np.errstate(over='ignore'):
        length = np.linalg.norm(xyzw)
    if not (np.abs(T[:3, 3]).max() <= MAX_METRES and SHORTEST <= length <= LONGEST):  # False for NaN
        raise MessageError(
            f'{what} with position {T[:3, 3].tolist()} and quaternion xyzw {xyzw.tolist()}: '
            'all must be finite, and the quaternion not zero'
        )
    T[:3, :3] = _rotation(xyzw / length)
    return T


def pose_message(factory: MessageFactory, T: Matrix) -> Any:
    """Make a ``geometry_msgs/Pose`` of a [4, 4] rigid motion; the quaternion has w >= 0."""
    return factory.make('geometry_msgs/msg/Pose', position=_xyz(factory, 'Point', T[:3, 3]), orientation=_quaternion(factory, T))


def pose_stamped(factory: MessageFactory, T: Matrix, stamp_ns: int, frame_id: str) -> Any:
    """Make a ``geometry_msgs/PoseStamped`` of a [4, 4] pose in ``frame_id``."""
    return factory.make(
        'geometry_msgs/msg/PoseStamped',
        header=stamps.header(factory, stamp_ns, frame_id),
        pose=pose_message(factory, T),
    )


def pose_with_covariance(factory: MessageFactory, T: Matrix, covariance: Matrix, stamp_ns: int, frame_id: str) -> Any:
    """Make a ``geometry_msgs/PoseWithCovarianceStamped`` of a [4, 4] pose in ``frame_id``.

    Args:
        factory: makes the message.
        T: [4, 4] pose.
        covariance: [6, 6] of x y z and the rotations about x y z, in the axes of ``frame_id``.
        stamp_ns: stamp of the message.
        frame_id: frame the pose is in.
    """
    return factory.make(
        'geometry_msgs/msg/PoseWithCovarianceStamped',
        header=stamps.header(factory, stamp_ns, frame_id),
        pose=factory.make('geometry_msgs/msg/PoseWithCovariance', pose=pose_message(factory, T), covariance=np.ravel(covariance)),
    )


def odometry(
    factory: MessageFactory, T: Matrix, stamp_ns: int, frame_id: str, child_frame_id: str, *,
    pose_covariance: Matrix, twist: NDArray[np.float64], twist_covariance: Matrix,
) -> Any:  # fmt: skip
    """Make a ``nav_msgs/Odometry`` of the [4, 4] pose of ``child_frame_id`` in ``frame_id``.

    Args:
        factory: makes the message.
        T: [4, 4] pose.
        stamp_ns: stamp of the header.
        frame_id: frame the pose is in.
        child_frame_id: frame the pose is of.
        pose_covariance: [6, 6] of x y z and the rotations about x y z, in the axes of ``frame_id``.
        twist: [6] linear and angular velocity, in the axes of ``child_frame_id``.
        twist_covariance: [6, 6] covariance of ``twist``.
    """
    linear, angular = (_xyz(factory, 'Vector3', vector) for vector in (twist[:3], twist[3:]))
    return factory.make(
        'nav_msgs/msg/Odometry',
        header=stamps.header(factory, stamp_ns, frame_id),
        child_frame_id=child_frame_id,
        pose=factory.make(
            'geometry_msgs/msg/PoseWithCovariance',
            pose=pose_message(factory, T), covariance=np.ravel(pose_covariance),
        ),
        twist=factory.make(
            'geometry_msgs/msg/TwistWithCovariance',
            twist=factory.make('geometry_msgs/msg/Twist', linear=linear, angular=angular),
            covariance=np.ravel(twist_covariance),
        ),
    )  # fmt: skip


def path(factory: MessageFactory, poses: Sequence[Any], stamp_ns: int, frame_id: str) -> Any:
    """Make a ``nav_msgs/Path`` of ``geometry_msgs/PoseStamped``, each with its own stamp."""
    return factory.make('nav_msgs/msg/Path', header=stamps.header(factory, stamp_ns, frame_id), poses=list(poses))


def transform_stamped(factory: MessageFactory, T: Matrix, stamp_ns: int, frame_id: str, child_frame_id: str) -> Any:
    """Make a ``geometry_msgs/TransformStamped`` of the [4, 4] pose of ``child_frame_id`` in ``frame_id``."""
    transform = factory.make(
        'geometry_msgs/msg/Transform', translation=_xyz(factory, 'Vector3', T[:3, 3]), rotation=_quaternion(factory, T)
    )
    return factory.make(
        'geometry_msgs/msg/TransformStamped',
        header=stamps.header(factory, stamp_ns, frame_id), child_frame_id=child_frame_id, transform=transform,
    )  # fmt: skip


def _xyz(factory: MessageFactory, name: str, vector: NDArray[np.float64]) -> Any:
    x, y, z = (float(value) for value in vector)
    return factory.make(f'geometry_msgs/msg/{name}', x=x, y=y, z=z)


def _quaternion(factory: MessageFactory, T: Matrix) -> Any:
    x, y, z, w = quaternion_xyzw(T[:3, :3]).tolist()
    return factory.make('geometry_msgs/msg/Quaternion', x=x, y=y, z=z, w=w)


def quaternion_xyzw(R: Matrix) -> Matrix:
    """Returns the unit quaternion [4] with w >= 0 of a [3, 3] rotation.

    It is the eigenvector of Bar-Itzhack's symmetric matrix with the largest eigenvalue (Bar-Itzhack 2000, version 3):
    accurate for all angles, and the closest rotation if R is not exactly orthonormal.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = np.asarray(R, dtype=np.float64)
    lower = np.array(
        [
            [xx - yy - zz, 0, 0, 0],
            [yx + xy, yy - xx - zz, 0, 0],
            [zx + xz, zy + yz, zz - xx - yy, 0],
            [zy - yz, xz - zx, yx - xy, xx + yy + zz],
        ]
    )
    q = np.linalg.eigh(lower, UPLO='L')[1][:, -1]
    return q if q[3] >= 0 else -q


def _rotation(xyzw: Matrix) -> Matrix:
    x, y, z, w = xyzw
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
