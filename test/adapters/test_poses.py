"""Poses to messages and back, for every kind of rotation."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from msg_adapters import poses
from msg_adapters.errors import MessageError
from msg_adapters.factory import RosbagsMessages
from msg_adapters.stamps import message_stamp_ns

# Quaternions, square roots and a matrix product in float64: a few units in the last of 16 digits.
EXACT = 1e-14

MOTION = {
    'twist': np.arange(1.0, 7.0),
    'pose_covariance': np.arange(36.0).reshape(6, 6),
    'twist_covariance': np.arange(36.0, 72.0).reshape(6, 6),
}

axis = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 1e-3)


def rigid(direction, angle, translation=(1.0, -2.0, 3.0)):
    """Rodrigues' formula."""
    x, y, z = np.asarray(direction) / np.linalg.norm(direction)
    S = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    T = np.eye(4)
    T[:3, :3] += np.sin(angle) * S + (1 - np.cos(angle)) * S @ S
    T[:3, 3] = translation
    return T


@given(axis, st.one_of(st.floats(0, np.pi), st.floats(0, 1e-8), st.floats(np.pi - 1e-8, np.pi)))
def test_any_rotation_comes_back(direction, angle):
    factory = RosbagsMessages(get_typestore(Stores.ROS2_JAZZY))
    T = rigid(direction, angle)
    message = poses.pose_message(factory, T)
    assert message.orientation.w >= 0
    np.testing.assert_allclose(poses.pose_matrix(message), T, atol=EXACT)


def test_the_quaternion_is_xyzw(factory):
    quarter_turn_about_z = poses.pose_message(factory, rigid([0, 0, 1], np.pi / 2)).orientation
    half = np.sqrt(0.5)
    q = [quarter_turn_about_z.x, quarter_turn_about_z.y, quarter_turn_about_z.z, quarter_turn_about_z.w]
    np.testing.assert_allclose(q, [0, 0, half, half], atol=EXACT)


def test_a_quaternion_of_another_length_is_the_same_rotation(factory):
    message = poses.pose_message(factory, rigid([1, 2, 3], 1.0))
    q = message.orientation
    q.x, q.y, q.z, q.w = (-3.0 * value for value in (q.x, q.y, q.z, q.w))
    np.testing.assert_allclose(poses.pose_matrix(message), rigid([1, 2, 3], 1.0), atol=EXACT)


@pytest.mark.parametrize('q', [(0.0, 0.0, 0.0, 0.0), (0.0, 0.0, float('nan'), 1.0), (float('inf'), 0.0, 0.0, 1.0)])
def test_a_quaternion_that_is_no_rotation_is_an_error(factory, q):
    message = poses.pose_message(factory, np.eye(4))
    message.orientation.x, message.orientation.y, message.orientation.z, message.orientation.w = q
    with pytest.raises(MessageError, match='quaternion'):
        poses.pose_matrix(message)


def test_a_position_that_is_not_finite_is_an_error(factory):
    message = poses.pose_message(factory, np.eye(4))
    message.position.y = float('nan')
    with pytest.raises(MessageError, match='finite'):
        poses.pose_matrix(message)


def test_pose_stamped_and_odometry_carry_stamp_and_frames(factory):
    T = rigid([1, 0, 0], 0.3)
    stamped = poses.pose_stamped(factory, T, 77, 'map')
    odometry = poses.odometry(factory, T, 78, 'map', 'camera', **MOTION)
    assert (message_stamp_ns(stamped), stamped.header.frame_id) == (77, 'map')
    assert (message_stamp_ns(odometry), odometry.header.frame_id, odometry.child_frame_id) == (78, 'map', 'camera')
    np.testing.assert_allclose(poses.pose_matrix(stamped.pose), T, atol=EXACT)
    np.testing.assert_allclose(poses.pose_matrix(odometry.pose.pose), T, atol=EXACT)


def test_odometry_says_how_fast_and_how_sure(factory):
    odometry = poses.odometry(factory, np.eye(4), 78, 'map', 'camera', **MOTION)
    linear, angular = odometry.twist.twist.linear, odometry.twist.twist.angular
    assert [linear.x, linear.y, linear.z, angular.x, angular.y, angular.z] == MOTION['twist'].tolist()
    np.testing.assert_array_equal(np.reshape(odometry.pose.covariance, (6, 6)), MOTION['pose_covariance'])
    np.testing.assert_array_equal(np.reshape(odometry.twist.covariance, (6, 6)), MOTION['twist_covariance'])


def test_a_transform_comes_back(factory):
    T = rigid([1, 2, 3], 1.0)
    message = poses.transform_stamped(factory, T, 79, 'base', 'camera')
    assert (message_stamp_ns(message), message.header.frame_id, message.child_frame_id) == (79, 'base', 'camera')
    np.testing.assert_allclose(poses.transform_matrix(message.transform), T, atol=EXACT)
    message.transform.rotation.w = float('nan')
    with pytest.raises(MessageError, match='transform with position'):
        poses.transform_matrix(message.transform)


def test_a_path_keeps_the_stamp_of_each_pose(factory):
    trajectory = [(10 * i, rigid([0, 1, 0], 0.1 * i)) for i in range(4)]
    stamped = [poses.pose_stamped(factory, T, stamp_ns, 'map') for stamp_ns, T in trajectory]
    path = poses.path(factory, stamped, 30, 'map')
    assert message_stamp_ns(path) == 30
    assert [message_stamp_ns(pose) for pose in path.poses] == [0, 10, 20, 30]
    for pose, (_, T) in zip(path.poses, trajectory):
        np.testing.assert_allclose(poses.pose_matrix(pose.pose), T, atol=EXACT)


@pytest.mark.parametrize('name', ['PoseStamped', 'Odometry', 'Path'])
def test_messages_can_be_written_to_a_bag(name):
    store = get_typestore(Stores.ROS2_JAZZY)
    factory = RosbagsMessages(store)
    message, type_name = {
        'PoseStamped': (poses.pose_stamped(factory, np.eye(4), 1, 'map'), 'geometry_msgs/msg/PoseStamped'),
        'Odometry': (poses.odometry(factory, np.eye(4), 1, 'map', 'camera', **MOTION), 'nav_msgs/msg/Odometry'),
        'Path': (poses.path(factory, [poses.pose_stamped(factory, np.eye(4), 1, 'map')] * 2, 1, 'map'), 'nav_msgs/msg/Path'),
    }[name]
    raw = store.serialize_cdr(message, type_name)
    assert message_stamp_ns(store.deserialize_cdr(raw, type_name)) == 1
