"""The absolute trajectory error against cases whose answer is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from splatam_core.errors import RunFolderError
from splatam_core.evaluation.calibration import TruthNoise, adjoint, normalized_errors
from splatam_core.evaluation.trajectory import (
    RelativePoseError,
    align,
    align_poses,
    falsely_tracked,
    relative_pose_errors,
    splatam_ate_mean_m,
    trajectory_error,
    transformed,
)
from splatam_core.geometry import se3
from splatam_core.geometry.trajectory import (
    MAX_GROUND_TRUTH_GAP_NS,
    STAMP_ROUNDING_NS,
    Trajectory,
    interpolate_centres,
    interpolate_poses,
    read_ground_truth,
)
from splatam_core.types import PoseCovariance

EPOCH_NS = 1_700_000_000_123_456_789
STEP_NS = 33_333_333
ROUND_OFF_M = 1e-12  # a few metres in 64-bit floats


def wandering(count: int, seed: int = 0) -> Trajectory:
    """A path that turns and moves in all directions."""
    steps = np.random.default_rng(seed).normal(0, 0.05, (count, 6))
    poses = [np.eye(4)]
    for step in steps[1:]:
        poses.append(poses[-1] @ se3.exp(step))
    return Trajectory(EPOCH_NS + STEP_NS * np.arange(count), np.array(poses))


def moved(trajectory: Trajectory, offsets: np.ndarray) -> Trajectory:
    """The same with its camera centres shifted, each by its own offset."""
    T = trajectory.T_world_cam.copy()
    T[:, :3, 3] += offsets
    return Trajectory(trajectory.stamps_ns, T)


def square(centre_noise: np.ndarray) -> tuple[Trajectory, Trajectory]:
    """Ground truth at the corners of a square of side 2 about the origin, and an estimate that is off by the noise."""
    corners = np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]], dtype=float)
    ground_truth = Trajectory(EPOCH_NS + STEP_NS * np.arange(4), se3.compose(np.tile([1.0, 0, 0, 0], (4, 1)), corners))
    return moved(ground_truth, centre_noise), ground_truth


def test_known_noise_gives_the_error_by_hand() -> None:
    # Up, down, up, down by 3 cm: no motion of the square (shift, tilt, turn) follows that, so all of it is error.
    noise = np.array([[0, 0, 0.03], [0, 0, -0.03], [0, 0, 0.03], [0, 0, -0.03]])
    assert trajectory_error(*square(noise)).rmse_m == pytest.approx(0.03, abs=ROUND_OFF_M)


def test_scale_is_not_aligned_away() -> None:
    estimate, ground_truth = square(np.zeros((4, 3)))
    grown = moved(ground_truth, 0.1 * ground_truth.T_world_cam[:, :3, 3])
    # Each corner lies sqrt(2) from the centre, and a tenth of that too far out.
    assert trajectory_error(grown, ground_truth).rmse_m == pytest.approx(0.1 * np.sqrt(2), abs=ROUND_OFF_M)
    assert trajectory_error(estimate, ground_truth).rmse_m == pytest.approx(0, abs=ROUND_OFF_M)


def test_a_mirror_image_is_not_aligned_away() -> None:
    ground_truth = wandering(50)
    mirrored = Trajectory(ground_truth.stamps_ns, ground_truth.T_world_cam.copy())
    mirrored.T_world_cam[:, 0, 3] *= -1
    T = trajectory_error(mirrored, ground_truth).T_estimate_ground_truth
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1)
    assert trajectory_error(mirrored, ground_truth).rmse_m > 0.01


@pytest.mark.parametrize('seed', range(5))
def test_the_world_of_the_ground_truth_changes_nothing(seed: int) -> None:
    rng = np.random.default_rng(seed)
    ground_truth = wandering(80)
    estimate = moved(ground_truth, rng.normal(0, 0.02, (80, 3)))
    T = se3.exp(rng.normal(0, 2, 6))
    here, there = trajectory_error(estimate, ground_truth), trajectory_error(estimate, transformed(ground_truth, T))
    assert there.rmse_m == pytest.approx(here.rmse_m, abs=ROUND_OFF_M)
    np.testing.assert_allclose(there.ground_truth_m, here.ground_truth_m, atol=1e-10)  # cancels T and its inverse


def test_independent_noise_shows_in_full() -> None:
    ground_truth, sigma, count = wandering(2000), 0.02, 2000
    noise = np.random.default_rng(1).normal(0, sigma, (count, 3))
    # 3 N noisy numbers less the 6 a rigid motion fits. The sum of their squares strays by sqrt(2 / 3 N) = 1.8 %,
    # its root by half of that: 3 % is over three sigma.
    expected = sigma * np.sqrt(3 * (1 - 6 / (3 * count)))
    assert trajectory_error(moved(ground_truth, noise), ground_truth).rmse_m == pytest.approx(expected, rel=0.03)


def test_alignment_finds_the_motion() -> None:
    rng = np.random.default_rng(2)
    points, T = rng.normal(size=(20, 3)), se3.exp(rng.normal(size=6))
    np.testing.assert_allclose(align(points, points @ T[:3, :3].T + T[:3, 3]), T, atol=ROUND_OFF_M)


def test_alignment_is_the_least_squares_one() -> None:
    rng = np.random.default_rng(3)
    source, target = rng.normal(size=(30, 3)), rng.normal(size=(30, 3))
    best = align(source, target)

    def cost(T: np.ndarray) -> float:
        return float(np.sum((source @ T[:3, :3].T + T[:3, 3] - target) ** 2))

    assert all(cost(se3.exp(rng.normal(0, 0.01, 6)) @ best) > cost(best) for _ in range(50))


def test_ground_truth_is_interpolated_at_the_stamp_of_the_frame() -> None:
    ends = se3.compose(np.tile([1.0, 0, 0, 0], (2, 1)), np.array([[0.0, 0, 0], [4.0, -8.0, 2.0]]))
    ground_truth = Trajectory(EPOCH_NS + np.array([0, 40_000_000]), ends)
    centres, known = interpolate_centres(ground_truth, EPOCH_NS + np.array([0, 10_000_000, 40_000_000]))
    assert known.all()
    np.testing.assert_allclose(centres, [[0, 0, 0], [1, -2, 0.5], [4, -8, 2]], atol=ROUND_OFF_M)


def test_frames_without_ground_truth_are_not_scored() -> None:
    ground_truth = wandering(100)
    keep = np.r_[10:40, 60:90]
    partial = Trajectory(ground_truth.stamps_ns[keep], ground_truth.T_world_cam[keep])
    assert ground_truth.stamps_ns[60] - ground_truth.stamps_ns[39] > MAX_GROUND_TRUTH_GAP_NS
    wild = moved(ground_truth, np.where(np.isin(np.arange(100), keep), 0.0, 50.0)[:, None])
    error = trajectory_error(wild, partial)
    np.testing.assert_array_equal(error.stamps_ns, partial.stamps_ns)
    assert error.rmse_m == pytest.approx(0, abs=ROUND_OFF_M)


def test_rounded_stamps_at_the_ends_still_count() -> None:
    ground_truth = wandering(5)
    just_outside = np.array([ground_truth.stamps_ns[0] - STAMP_ROUNDING_NS, ground_truth.stamps_ns[-1] + STAMP_ROUNDING_NS])
    too_far = just_outside + np.array([-1, 1])
    assert interpolate_centres(ground_truth, just_outside)[1].all()
    assert not interpolate_centres(ground_truth, too_far)[1].any()


def test_other_clock_is_an_error_that_names_both_spans() -> None:
    ground_truth = wandering(10)
    later = Trajectory(ground_truth.stamps_ns + 10**12, ground_truth.T_world_cam)
    with pytest.raises(RunFolderError, match=r'0 of 10 .* 1700001000\.1\d+ .* 1700000000\.1\d+'):
        trajectory_error(later, ground_truth)
    with pytest.raises(RunFolderError, match='2 of 2'):
        trajectory_error(Trajectory(ground_truth.stamps_ns[:2], ground_truth.T_world_cam[:2]), ground_truth)
    nothing = Trajectory(np.zeros(0, np.int64), np.zeros((0, 4, 4)))
    with pytest.raises(RunFolderError, match='the ground truth nothing'):
        trajectory_error(ground_truth, nothing)


# --- relative pose errors ---


def at_30_hz(poses: list[np.ndarray]) -> Trajectory:
    return Trajectory(EPOCH_NS + STEP_NS * np.arange(len(poses)), np.array(poses))


def test_relative_errors_of_a_drift_by_hand() -> None:
    """Each step is 1 mm and 0.1 degrees too long: that per frame, thirty times as much per second (999.99999 ms)."""
    step, wrong = np.array([0.02, 0, 0, 0, 0, 0]), np.array([0.021, 0, 0, 0, 0, 0])
    turn = np.array([0, 0, 0, 0, np.radians(0.5), 0]), np.array([0, 0, 0, 0, np.radians(0.6), 0])
    moving = [at_30_hz([se3.exp(i * twist) for i in range(61)]) for twist in (step, wrong)]
    per_frame, per_second = relative_pose_errors(moving[1], moving[0])
    assert (per_frame.pairs, per_second.pairs) == (60, 31)
    assert per_frame.translation_rmse_m == pytest.approx(0.001, abs=ROUND_OFF_M)
    assert per_second.translation_rmse_m == pytest.approx(0.030, abs=ROUND_OFF_M)
    turning = [at_30_hz([se3.exp(i * twist) for i in range(61)]) for twist in turn]
    per_frame, per_second = relative_pose_errors(turning[1], turning[0])
    assert per_frame.rotation_rmse_deg == pytest.approx(0.1, abs=1e-6)  # an angle this small keeps half its digits
    assert per_second.rotation_rmse_deg == pytest.approx(3.0, abs=1e-6)


def test_relative_errors_do_not_depend_on_the_world_of_the_ground_truth() -> None:
    ground_truth = wandering(40)
    elsewhere = transformed(ground_truth, se3.exp(np.array([3.0, -2, 1, 0.5, 1, -2])))
    for error in relative_pose_errors(ground_truth, elsewhere):
        assert error.translation_rmse_m == pytest.approx(0, abs=1e-10)
        assert error.rotation_rmse_deg == pytest.approx(0, abs=1e-4)


def test_one_jump_is_one_wrong_step() -> None:
    ground_truth = wandering(50)
    jumped = moved(ground_truth, np.where(np.arange(50)[:, None] >= 20, [0.1, 0, 0], 0.0))
    per_frame, _ = relative_pose_errors(jumped, ground_truth)
    assert per_frame.translation_rmse_m == pytest.approx(0.1 / np.sqrt(49), abs=ROUND_OFF_M)


def test_no_step_is_taken_over_lost_frames() -> None:
    ground_truth = wandering(50)
    tracked = np.arange(50) != 25
    estimate = Trajectory(ground_truth.stamps_ns[tracked], ground_truth.T_world_cam[tracked])
    assert relative_pose_errors(estimate, ground_truth)[0].pairs == 48  # 24 to 26 is the next tracked frame
    assert relative_pose_errors(estimate, ground_truth, [int(ground_truth.stamps_ns[25])])[0].pairs == 47


def test_without_a_frame_a_second_later_there_is_no_such_error() -> None:
    ground_truth = wandering(20)
    per_frame, per_second = relative_pose_errors(ground_truth, ground_truth)
    assert per_frame.pairs == 19
    assert per_second == RelativePoseError(None, None, 0)
    nothing = Trajectory(np.zeros(0, np.int64), np.zeros((0, 4, 4)))
    assert relative_pose_errors(nothing, ground_truth) == (RelativePoseError(None, None, 0),) * 2


def test_poses_between_two_true_ones() -> None:
    turned = se3.exp(np.array([1.0, 0, 0, 0, 0, np.pi / 2]))
    turned[:3, 3] = [1.0, 0, 0]
    ground_truth = Trajectory(np.array([0, 400_000_000]), np.array([np.eye(4), turned]))
    poses, known = interpolate_poses(ground_truth, np.array([0, 100_000_000, 400_000_000, 900_000_000]))
    assert known.tolist() == [True, True, True, False]
    assert poses[1, :3, 3] == pytest.approx([0.25, 0, 0])
    assert se3.rotation_vector(poses[1, :3, :3]) == pytest.approx([0, 0, np.pi / 8])
    assert np.allclose(poses[[0, 2]], ground_truth.T_world_cam, atol=ROUND_OFF_M)


# --- what the original computes ---


def test_the_original_s_ate_is_a_mean_of_world_to_camera_translations() -> None:
    """Cameras that do not turn have -c there: then it is the mean distance of the centres, aligned."""
    noise = np.array([[0, 0, 0.04], [0, 0, -0.04], [0, 0, 0.04], [0, 0, -0.04]])
    estimate, ground_truth = square(noise)
    assert splatam_ate_mean_m(estimate, ground_truth) == pytest.approx(0.04, abs=1e-3)  # the first pose's own error tilts nothing


def test_the_original_s_ate_sees_a_turn_with_the_distance_from_the_origin() -> None:
    """Ten metres out, half a degree of wrong rotation in every second pose: no centre is off, the original's is by cm."""
    ground_truth = at_30_hz([se3.compose(np.array([1.0, 0, 0, 0]), np.array([1.0 * i, i % 3, i % 2])) for i in range(11)])
    T = ground_truth.T_world_cam.copy()
    T[1::2, :3, :3] = se3.exp(np.array([0, 0, 0, 0, np.radians(0.5), 0]))[:3, :3]
    turned = Trajectory(ground_truth.stamps_ns, T)
    assert trajectory_error(turned, ground_truth).rmse_m == pytest.approx(0, abs=ROUND_OFF_M)
    assert splatam_ate_mean_m(turned, ground_truth) > 0.01


def test_poses_are_aligned_where_centres_leave_it_open() -> None:
    """Along a line the centres do not tell how the world is turned about it; the cameras' rotations do."""
    ground_truth = at_30_hz([se3.exp(np.array([0.1 * i, 0, 0, 0, 0, 0])) for i in range(5)])
    T = se3.exp(np.array([1.0, 2, 3, 0.4, -0.5, 0.6]))
    assert np.allclose(align_poses(ground_truth.T_world_cam, transformed(ground_truth, T).T_world_cam), T, atol=ROUND_OFF_M)
    assert np.allclose(align_poses(ground_truth.T_world_cam[:1], transformed(ground_truth, T).T_world_cam[:1]), T, atol=ROUND_OFF_M)


def test_aligned_poses_share_the_error() -> None:
    ground_truth = wandering(4)
    off = np.array([[0.03, 0, 0], [-0.03, 0, 0], [0, 0.03, 0], [0, -0.03, 0]])  # cancels out
    assert np.allclose(align_poses(ground_truth.T_world_cam, moved(ground_truth, off).T_world_cam), np.eye(4), atol=ROUND_OFF_M)


# --- covariances ---


def test_a_tracked_frame_is_false_beyond_ten_centimetres_and_three_deviations() -> None:
    truth = wandering(1000)
    poses = truth.T_world_cam.copy()
    for index, off_m in ((10, 0.09), (11, 0.13), (12, 0.13), (13, 0.5)):
        poses[index, 0, 3] += off_m
    error = trajectory_error(Trajectory(truth.stamps_ns, poses), truth)
    covariances = {
        int(truth.stamps_ns[index]): PoseCovariance(np.diag([deviation_m**2, 0, 0, 0, 0, 0]), 0.0, 0.0)
        for index, deviation_m in ((11, 0.02), (12, 0.06), (13, 0.06))
    }
    assert np.flatnonzero(falsely_tracked(error, covariances)).tolist() == [11, 13]


def test_adjoints_move_twists_past_motions() -> None:
    T, twist = se3.exp(np.array([1, -2, 0.5, 0.3, 0.2, -1])), np.array([0.1, 0.2, -0.3, 0.2, 0.1, 0.4])
    np.testing.assert_allclose(se3.exp(adjoint(T) @ twist), T @ se3.exp(twist) @ se3.inverse(T), atol=1e-12)


def test_errors_in_deviations_are_one_where_covariances_are_true() -> None:
    """Monte Carlo: each pose is perturbed as its covariance says, and drifts; in the world's axes, with the camera turned."""
    rng, truth = np.random.default_rng(0), wandering(2000)
    relative = np.diag([0.004, 0.01, 0.002, 0.01, 0.003, 0.006]) ** 2
    drift_m = drift_rad = 0.001  # per root of a frame
    poses, covariances, drift = [], {}, np.eye(4)
    for index, T in enumerate(truth.T_world_cam):
        step, noise = rng.normal(size=6) * 0.001, rng.multivariate_normal(np.zeros(6), relative)
        drift = drift @ T @ se3.exp(step) @ se3.inverse(T)  # at the camera, in its axes
        moved = T.copy()
        moved[:3, :3] = se3.exp(np.concatenate([np.zeros(3), noise[3:]]))[:3, :3] @ T[:3, :3]
        moved[:3, 3] += noise[:3]
        poses.append(drift @ moved)
        turn = np.kron(np.eye(2), drift[:3, :3])
        covariance = PoseCovariance(turn @ relative @ turn.T, drift_m * np.sqrt(index), drift_rad * np.sqrt(index))
        covariances[int(truth.stamps_ns[index])] = covariance
    estimate = Trajectory(truth.stamps_ns, np.array(poses))
    errors = normalized_errors(estimate, truth, covariances)
    assert len(errors) == 1990 and np.mean(errors**2) == pytest.approx(1, abs=0.1)  # 1990 pairs overlap: 200 are independent
    assert np.median(errors) == pytest.approx(0.95, abs=0.05)
    unsure = normalized_errors(estimate, truth, covariances, noise=TruthNoise(1.0, 1.0))
    assert unsure.max() < 0.1
    assert len(normalized_errors(estimate, truth, {})) == 0


@pytest.mark.parametrize(
    ('heading', 'line'),
    [
        ('#timestamp [ns],p_x [m],p_y [m],p_z [m],q_w [],q_x [],q_y [],q_z []', '{},1,2,3,0.6,0.8,0,0'),
        ('#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], v_RS_R_x [m s^-1], '
         'v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], b_w_RS_S_x [rad s^-1]', '{}, 1, 2, 3, 0.6, 0.8, 0, 0, 9, 9, 9, 9'),
        ('# timestamp(s) tx ty tz qx qy qz qw Pr11 Pr12', '{} 1 2 3 0.8 0 0 0.6 5 5'),
        ('frame;time;x;y;z;qw;qx;qy;qz', '7;{};1;2;3;0.6;0.8;0;0'),
        ('header.stamp pose.orientation.w pose.orientation.x pose.orientation.y pose.orientation.z pose.position.x '
         'pose.position.y pose.position.z', '{} 0.6 0.8 0 0 1 2 3'),
        ('# timestamp tx ty tz qx qy qz qw', '{} 1 2 3 0.8 0 0 0.6'),
        ('# a trajectory: tx ty tz qx qy qz qw, by axes x and y', '{} 1 2 3 0.8 0 0 0.6'),
    ],
)  # fmt: skip
def test_columns_are_read_as_their_heading_names_them(
    tmp_path: Path, heading: str, line: str, caplog: pytest.LogCaptureFixture
) -> None:
    """A quaternion that begins with w used to be read as one that ends with it, in silence."""
    path = tmp_path / 'truth.csv'
    path.write_text('\n'.join([heading, *(line.format(stamp) for stamp in (1.0, 1.1, 1.2))]))
    truth = read_ground_truth(path)
    assert truth.stamps_ns.tolist() == [1_000_000_000, 1_100_000_000, 1_200_000_000]
    assert np.allclose(truth.T_world_cam[:, :3, 3], [1, 2, 3])
    assert np.allclose(truth.T_world_cam[0, :3, :3], [[1, 0, 0], [0, -0.28, -0.96], [0, 0.96, -0.28]])
    is_usual = line == '{} 1 2 3 0.8 0 0 0.6'
    said = [record.message.partition(': ')[2] for record in caplog.records]
    assert said == ([] if is_usual else ['columns are read as line 1 names them'])
