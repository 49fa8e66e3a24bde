"""Velocity and covariance compared with closed forms, and the bound of the path."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from splatam_core.geometry import se3
from splatam_core.types import FrameResult, PoseCovariance, StageTimings, Status
from splatam_ros.frames.covariance import UNKNOWN_VARIANCE, MotionEstimator
from splatam_ros.frames.rep105 import Located
from splatam_ros.node.outputs import PathHistory

POSITION_M, ORIENTATION_RAD = 0.02, 0.01
T_BODY_CAMERA = se3.exp(np.array([0.3, 0, 0.5, 0, 0.4, 0]))
TWIST = np.array([0.5, 0, 0.1, 0, 0.2, -0.3])
EXACT = 1e-9  # differences of poses over a tenth of a second, in float64


def observe(estimator, tenths, T_map_body, sure=1.0, inliers=1.0):
    stamp_ns = 10**9 + tenths * 10**8
    located = Located(stamp_ns, 'camera', 'body', np.eye(4), T_map_body @ T_BODY_CAMERA, T_map_body, None)
    result = FrameResult(tenths, stamp_ns, Status.TRACKED, np.eye(4), False, 1, sure, inliers, '', StageTimings())
    return estimator.observe(located, result)


@pytest.fixture
def estimator() -> MotionEstimator:
    return MotionEstimator(POSITION_M, ORIENTATION_RAD)


def test_a_constant_twist_is_found_in_the_bodys_axes(estimator: MotionEstimator) -> None:
    T_start = se3.exp(np.array([1, 2, 3, 0.5, 0.1, 1.2]))
    motions = [observe(estimator, n, T_start @ se3.exp(TWIST * n / 10)) for n in (0, 1, 3)]  # stamps count, not frames
    assert (motions[0].twist == 0).all() and (np.diag(motions[0].twist_covariance) == UNKNOWN_VARIANCE).all()
    for motion in motions[1:]:
        np.testing.assert_allclose(motion.twist, TWIST, atol=EXACT)


def test_over_a_gap_in_which_the_camera_was_lost_there_is_no_velocity(estimator: MotionEstimator) -> None:
    observe(estimator, 0, np.eye(4))
    estimator.interrupt()
    motion = observe(estimator, 9, se3.exp(TWIST))
    assert (motion.twist == 0).all() and (np.diag(motion.twist_covariance) == UNKNOWN_VARIANCE).all()


def test_a_pose_that_fewer_pixels_support_is_less_sure(estimator: MotionEstimator) -> None:
    whole = observe(estimator, 0, np.eye(4)).pose_covariance
    quarter = observe(estimator, 1, np.eye(4), sure=0.5, inliers=0.5).pose_covariance
    np.testing.assert_allclose(quarter, 4 * whole, rtol=1e-12)
    np.testing.assert_allclose(np.sqrt(np.diag(whole)[3:]), ORIENTATION_RAD, rtol=1e-12)


def test_covariances_are_what_perturbed_poses_show(estimator: MotionEstimator) -> None:
    """Monte Carlo: the camera's pose is perturbed with the parameters; the body's must scatter with the stated covariance."""
    rng = np.random.default_rng(0)
    T_before, T_now = (se3.exp(np.array([1, 2, 3, 0.5, 0.1, 1.2])) @ se3.exp(TWIST * s) for s in (0.0, 0.1))
    observe(estimator, 0, T_before)
    stated = observe(estimator, 1, T_now)

    def perturbed(T_map_body: np.ndarray) -> np.ndarray:
        T = T_map_body @ T_BODY_CAMERA
        turned = se3.exp(np.concatenate([np.zeros(3), rng.normal(0, ORIENTATION_RAD, 3)]))
        T = np.block([[turned[:3, :3] @ T[:3, :3], T[:3, 3:] + rng.normal(0, POSITION_M, (3, 1))], [0, 0, 0, 1]])
        return T @ se3.inverse(T_BODY_CAMERA)

    poses, twists = [], []
    for _ in range(4000):
        before, now = perturbed(T_before), perturbed(T_now)
        turn = se3.rotation_vector(now[:3, :3] @ T_now[:3, :3].T)
        poses.append(np.concatenate([now[:3, 3] - T_now[:3, 3], turn]))
        twists.append(se3.log(se3.inverse(before) @ now) / 0.1)
    # A variance of 4000 samples scatters by 2 %; rotation over the interval is taken to be small: 0.04 rad.
    for stated_covariance, samples in ((stated.pose_covariance, poses), (stated.twist_covariance, twists)):
        scale = np.sqrt(np.outer(np.diag(stated_covariance), np.diag(stated_covariance)))
        np.testing.assert_allclose(np.cov(np.array(samples).T) / scale, stated_covariance / scale, atol=0.12)


def test_the_covariance_of_the_tracker_is_that_of_the_body_in_the_map() -> None:
    """The turn of the map counts, the lever of the camera, and the drift; of the velocity only what is relative to the map."""
    estimator = MotionEstimator(POSITION_M, ORIENTATION_RAD)
    T_map_world = se3.exp(np.array([1, 2, 3, 0, 0, np.pi / 2]))  # the world's x axis is the map's y axis
    relative = np.diag([1e-3, 2e-3, 3e-3, 1e-3, 1e-3, 1e-3]) ** 2
    covariance = PoseCovariance(relative, drift_position_m=0.05, drift_rotation_rad=0.0)
    motions = []
    for tenths in range(2):
        T_map_camera = T_map_world @ se3.exp(np.array([0.1 * tenths, 0, 0, 0, 0, 0]))
        located = Located(10**9 + tenths * 10**8, 'camera', 'body', T_map_world, T_map_camera, T_map_camera, None)
        result = FrameResult(
            tenths, located.stamp_ns, Status.TRACKED, np.eye(4), False, 1, 1.0, 1.0, '', StageTimings(), covariance
        )
        motions.append(estimator.observe(located, result))
    expected = np.square([2e-3, 1e-3, 3e-3, 1e-3, 1e-3, 1e-3]) + np.square([0.05, 0.05, 0.05, 0, 0, 0])
    np.testing.assert_allclose(np.diag(motions[1].pose_covariance), expected, rtol=1e-9)
    np.testing.assert_array_equal(motions[1].pose_covariance, motions[1].camera_covariance)
    np.testing.assert_allclose(np.diag(motions[1].twist_covariance), 2 * np.diag(relative) / 0.1**2, rtol=1e-6)


def test_a_path_is_bounded_even_and_ends_with_the_newest() -> None:
    history, uncorrected = PathHistory(10), SimpleNamespace(slam=SimpleNamespace(graph=SimpleNamespace(num_corrections=0)))
    for number in range(1, 1001):
        history.append(number, np.eye(4), number)
        poses = history.poses(uncorrected)
        assert len(poses) <= 10 and poses[-1] == number and poses[0] == 1
    steps = np.diff(poses[:-1])
    assert (steps == steps[0]).all()
