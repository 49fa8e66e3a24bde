"""The transform buffer compared with closed forms: motion on a circle, chains, and unknown transforms."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from splatam_core.errors import ConfigError
from splatam_core.geometry import se3
from splatam_ros.frames.buffer import KEEP_NS, TransformBuffer, TransformError
from splatam_ros.frames.rep105 import parse_pose

SECOND = 10**9
EXACT = 1e-12  # a few float64 products of numbers around one


def on_circle(seconds: float) -> np.ndarray:
    """Returns a pose on a circle of 2 m radius at 0.5 rad/s: a screw motion, so interpolation is exact."""
    return se3.exp(np.array([1.0, 0, 0, 0, 0, 0.5]) * seconds)


def turned(x: float, yaw: float = 0.0) -> np.ndarray:
    T = se3.exp(np.array([0, 0, 0, 0, 0, yaw]))
    T[0, 3] = x
    return T


@pytest.fixture
def tree() -> TransformBuffer:
    """Returns 10 s of the robot at 10 Hz, with a camera two static links away."""
    tree = TransformBuffer()
    tree.set_static('base', 'mast', turned(0.1, 0.2))
    tree.set_static('mast', 'camera', turned(0.3, -0.4))
    for tenth in range(101):
        tree.add('odom', 'base', SECOND + tenth * SECOND // 10, on_circle(tenth / 10))
    return tree


@pytest.mark.parametrize('seconds', [0.0, 0.05, 3.21, 10.0])
def test_poses_between_those_known(tree: TransformBuffer, seconds: float) -> None:
    T = tree.lookup('odom', 'camera', SECOND + round(seconds * SECOND))
    np.testing.assert_allclose(T, on_circle(seconds) @ turned(0.1, 0.2) @ turned(0.3, -0.4), atol=EXACT)


def test_any_two_frames_of_a_tree(tree: TransformBuffer) -> None:
    tree.set_static('base', 'arm', turned(1.0))
    np.testing.assert_allclose(
        tree.lookup('arm', 'camera'), se3.inverse(turned(1.0)) @ turned(0.1, 0.2) @ turned(0.3, -0.4), atol=EXACT
    )
    np.testing.assert_allclose(tree.lookup('camera', 'camera'), np.eye(4), atol=0)
    np.testing.assert_allclose(
        tree.lookup('camera', 'odom', 2 * SECOND) @ tree.lookup('odom', 'camera', 2 * SECOND), np.eye(4), atol=EXACT
    )


def test_what_is_above_the_frames_need_not_be_known(tree: TransformBuffer) -> None:
    tree.add('map', 'odom', 1, np.eye(4))
    tree.lookup('odom', 'base', 2 * SECOND)


@pytest.mark.parametrize(
    ('source', 'stamp_ns', 'message'),
    [
        ('camera', 11 * SECOND + 1, r"'base' in 'odom' is not known at the stamp: the newest is 0\.000 s older"),
        ('camera', SECOND // 2, r'the oldest is 0\.500 s newer'),
        ('lidar', 2 * SECOND, "no transform connects 'lidar' to 'odom'"),
    ],
)
def test_what_is_not_known_is_said(tree: TransformBuffer, source: str, stamp_ns: int, message: str) -> None:
    with pytest.raises(TransformError, match=message):
        tree.lookup('odom', source, stamp_ns)


def test_a_gap_is_not_bridged(tree: TransformBuffer) -> None:
    tree.add('odom', 'base', 20 * SECOND, np.eye(4))
    with pytest.raises(TransformError, match=r'gap of 9\.000 s'):
        tree.lookup('odom', 'base', 15 * SECOND)


def test_a_loop_ends(tree: TransformBuffer) -> None:
    tree.set_static('camera', 'odom', np.eye(4))
    with pytest.raises(TransformError, match='loop'):
        tree.lookup('lidar', 'camera')


def test_messages_may_overtake_each_other_and_time_may_jump_back(tree: TransformBuffer) -> None:
    tree.add('odom', 'base', 10 * SECOND + SECOND // 20, np.eye(4))  # between two that came before it
    np.testing.assert_array_equal(tree.lookup('odom', 'base', 10 * SECOND + SECOND // 20), np.eye(4))
    tree.add('odom', 'base', 2 * SECOND, turned(5.0))  # a recording starts over
    np.testing.assert_array_equal(tree.lookup('odom', 'base', 2 * SECOND), turned(5.0))
    with pytest.raises(TransformError, match='newest'):
        tree.lookup('odom', 'base', 10 * SECOND)


def test_the_past_is_bounded() -> None:
    tree = TransformBuffer()
    stamps_ns = range(SECOND, SECOND + 5 * KEEP_NS, SECOND // 4)
    for stamp_ns in stamps_ns:
        tree.add('odom', 'base', stamp_ns, np.eye(4))
    tree.lookup('odom', 'base', stamps_ns[-1] - KEEP_NS)
    with pytest.raises(TransformError, match='oldest'):
        tree.lookup('odom', 'base', stamps_ns[-1] - 3 * KEEP_NS)


def test_a_pose_that_is_yet_to_come_is_waited_for(tree: TransformBuffer) -> None:
    due_ns = 11 * SECOND + SECOND // 20
    later = threading.Timer(0.1, lambda: tree.add('odom', 'base', 11 * SECOND + SECOND // 10, on_circle(10.1)))
    later.start()
    T = tree.lookup('odom', 'base', due_ns, timeout_s=30.0)  # waited out only when this fails
    later.join()
    np.testing.assert_allclose(T, on_circle(10.05), atol=EXACT)


def test_what_cannot_come_is_not_waited_for(tree: TransformBuffer) -> None:
    started_s = time.monotonic()
    with pytest.raises(TransformError):
        tree.lookup('odom', 'lidar', timeout_s=30.0)
    tree.lookup('odom', 'base', 2 * SECOND, timeout_s=30.0)
    assert time.monotonic() - started_s < 10  # neither waits


def test_poses_as_parameters() -> None:
    np.testing.assert_allclose(parse_pose('p', '1 2 3 0 0 0 2'), translated(1, 2, 3), atol=EXACT)
    # The usual camera on a robot: optical axes from body axes are roll -90°, pitch 0, yaw -90°.
    T = parse_pose('p', f'0.1, 0, 0.5, {-np.pi / 2}, 0, {-np.pi / 2}')
    np.testing.assert_allclose(T[:3, 2], [1, 0, 0], atol=EXACT)  # looks forward
    np.testing.assert_allclose(T[:3, 0], [0, -1, 0], atol=EXACT)  # its right is the robot's right
    np.testing.assert_allclose(T[:3, 3], [0.1, 0, 0.5])


@pytest.mark.parametrize('text', ['1 2 3', '1 2 3 0 0 0 0', 'a b c d e f', '1 2 3 nan 0 0', '1 2 3 4 5 6 7 8'])
def test_what_is_no_pose_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match=f"camera = '{text}': expected 'x y z"):
        parse_pose('camera', text)


def translated(x: float, y: float, z: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = x, y, z
    return T
