"""When a pose may be trusted: covariances that are true, directions that nothing determines, and verdicts that follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import pytest

from splatam_core.config import TrackingConfig, load_config
from splatam_core.geometry import se3
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.rasterizer.native import make_native_aligner
from splatam_core.tracking.base import TrackingResult
from splatam_core.tracking.evidence import Evidence
from splatam_core.tracking.gauss_newton import Alignment, GaussNewton
from splatam_core.tracking.motion import MAX_ACCELERATION, MotionModel, SeenMotion
from splatam_core.tracking.pyramid import Level
from splatam_core.tracking.time_offset import TimeOffset
from splatam_core.tracking.verdict import Judge, Verdict
from splatam_core.types import Status

Image = np.ndarray
CAMERA = PinholeCamera(160, 120, 140.0, 140.0, 79.5, 59.5)
SHAPE = CAMERA.height, CAMERA.width
FRAME_NS = 33_000_000


def smooth(rng: np.random.Generator, sigma: float) -> Image:
    """Returns an image of standard deviation one whose neighbouring pixels are alike within ``sigma`` pixels."""
    image = rng.normal(size=SHAPE).astype(np.float32)
    image = cv2.GaussianBlur(image, (0, 0), sigma) if sigma else image
    return image / image.std()


def wall(contrast: float, relief_m: float = 0.0) -> tuple[Image, Image]:
    """Returns brightness and depth of a wall, 1.5 m away."""
    rng = np.random.default_rng(1)
    return 0.5 + contrast * smooth(rng, 2), (1.5 + relief_m * smooth(rng, 12)).astype(np.float32)


def stripes() -> tuple[Image, Image]:
    """Returns a wall whose brightness changes from row to row only: like a corridor, it is the same all along."""
    rows = 0.5 + 0.1 * smooth(np.random.default_rng(1), 2)[:, :1]
    return np.repeat(rows, CAMERA.width, axis=1), np.full(SHAPE, 1.5, np.float32)


def aligned(scene: tuple[Image, Image], rng: np.random.Generator, noise: float, correlation_px: float = 0.0) -> Alignment:
    """Aligns a noisy frame of a scene to a noisy render of it from the same pose."""
    brightness, depth = scene
    reference = Level(CAMERA, brightness + 0.002 * smooth(rng, 1), depth + 0.001 * smooth(rng, 1))
    error = noise * smooth(rng, correlation_px), 0.1 * noise * smooth(rng, correlation_px)
    frame = Level(CAMERA, (brightness + error[0]).astype(np.float32), (depth + error[1]).astype(np.float32))
    config = load_config('realtime', {'tracking.iterations': 10, 'tracking.align.time_offset': False}).tracking
    return GaussNewton(make_native_aligner(1), config).align([reference], [frame], None, TimeOffset())


@pytest.mark.parametrize('correlation_px', [0.0, 3.0])
def test_covariances_are_what_noise_does_to_poses(correlation_px: float) -> None:
    """However much the errors of neighbouring pixels are alike: the pixels' number says nothing about that."""
    rng, errors = np.random.default_rng(0), []
    for _ in range(30):
        found = aligned(wall(0.1, 0.1), rng, 0.02, correlation_px)
        twist = se3.log(found.state.color_motion)
        errors.append(np.sqrt(twist @ np.linalg.solve(found.evidence.covariance, twist) / 6))
        assert found.evidence.num_open == 0 and found.evidence.explained > 0.9
    # Each is the root of a mean of six squares, 0.95 in the median for a true covariance; that is estimated from 48 cells.
    assert 0.5 < np.median(errors) < 2


@pytest.mark.parametrize(
    ('scene', 'open_twists'),
    [(wall(0.1), ()), (stripes(), (0,)), (wall(0.0), (0, 1, 5))],
    ids=['textured wall', 'stripes', 'blank wall'],
)
def test_directions_that_the_images_do_not_determine_are_found(scene: tuple[Image, Image], open_twists: Sequence[int]) -> None:
    """Although the noise of a blank wall has gradients enough: their information claims a tenth of a millimetre."""
    for seed in range(5):
        evidence = aligned(scene, np.random.default_rng(seed), 0.02).evidence
        assert evidence.num_open == len(open_twists)
        known = [index for index in range(6) if index not in open_twists]
        deviations = np.sqrt(np.diag(evidence.covariance))
        assert (deviations[list(open_twists)] > 1).all() and (deviations[known] < 0.05).all()


# --- verdicts ---


def evidence(deviation: float = 0.003, explained: float = 0.9) -> Evidence:
    return Evidence(deviation**2 * np.eye(6), 0, explained, round(40 * explained), 0.01)


def result(T_world_cam: np.ndarray, inliers: float = 0.95, **of_evidence: float) -> TrackingResult:
    T = se3.inverse(T_world_cam)
    return TrackingResult(T, T, 1000, 0.8, inliers, evidence=evidence(**of_evidence))


def at(x: float) -> np.ndarray:
    return se3.exp(np.array([x, 0, 0, 0, 0, 0]))


class Bench:
    """A judge and a motion model, as in ``Slam.process``."""

    def __init__(self) -> None:
        self.judge, self.motion, self.config = Judge(), MotionModel(True), TrackingConfig()
        self.stamp_ns = 10**9
        self.judge.start()
        self.motion.observe(self.stamp_ns, np.eye(4))

    def feed(self, *found: TrackingResult, after_ns: int = FRAME_NS, seen: SeenMotion | None = None) -> Verdict:
        """Poses found from the last pose, and from the last one that may be trusted; the motion that the images show."""
        self.stamp_ns += after_ns
        first, *others = self.motion.predictions(self.stamp_ns)
        predictions = [replace(first, seen=seen), *others]
        best, verdict = self.judge.choose(found[: len(predictions)], predictions[: len(found)], self.config)
        if verdict.status is Status.LOST:
            self.motion.stop()
        else:
            self.motion.observe(self.stamp_ns, se3.inverse(best.T_cam_world), is_trusted=verdict.status.is_trusted)
        return verdict


def moving() -> Bench:
    """Returns a bench that has moved by 15 cm."""
    bench = Bench()
    for index in range(1, 31):
        assert bench.feed(result(at(0.005 * index))).status is Status.TRACKED
    return bench


@pytest.fixture
def bench() -> Bench:
    return moving()


HERE, STEP = 0.15, 0.005  # metres: where the bench is, and how far it moves in a frame


def test_a_pose_that_is_poorly_determined_is_uncertain_and_says_so(bench: Bench) -> None:
    """The prediction helps for some frames, but not for ever. To be trusted again takes more than to stay so."""
    for index in range(1, 200):
        verdict = bench.feed(*[result(at(HERE + STEP * index), deviation=0.1)] * 2)
        if verdict.status is Status.UNCERTAIN:
            break
    assert 1 < index < 30 and 'may be off by' in verdict.reason
    assert verdict.covariance is not None and np.sqrt(verdict.covariance.total[0, 0]) > bench.config.max_error_m
    verdict = bench.feed(*[result(at(HERE + STEP * (index + 1)), deviation=0.02)] * 2, after_ns=20 * FRAME_NS)  # nothing predicted
    assert verdict.status is Status.UNCERTAIN and '3.6 cm allowed' in verdict.reason
    assert bench.feed(*[result(at(HERE + STEP * (index + 2)), deviation=0.005)] * 2).status is Status.TRACKED


SEEN = SeenMotion(se3.inverse(at(STEP)), 0.001**2 * np.eye(6))


def test_motion_that_is_seen_carries_the_camera_over_a_poor_map(bench: Bench) -> None:
    """The map is off by 15 cm, and knows that it may be: the pose is the one that the motion leads to."""
    for index in range(1, 21):
        verdict = bench.feed(*[result(at(HERE + STEP * index + 0.15), deviation=0.1)] * 2, seen=SEEN)
        assert verdict.status is Status.TRACKED, index
        off = bench.motion.last_pose[0, 3] - HERE - STEP * index
        assert verdict.covariance is not None and abs(off) < 3 * np.sqrt(verdict.covariance.relative[0, 0])
        assert abs(off) < 0.01  # the map's variance is some thousand times larger, in each of twenty frames


def test_where_map_and_motion_contradict_each_other_no_mean_of_them_is_taken(bench: Bench) -> None:
    """After a jump the motion may be seen wrongly. A mean of both is nowhere, and the next frame begins there."""
    verdict = bench.feed(result(at(HERE + 0.6), deviation=0.01), seen=SEEN)
    assert verdict.status is Status.UNCERTAIN
    np.testing.assert_allclose(bench.motion.last_pose, at(HERE + 0.6), atol=1e-12)
    next_one = at(HERE + 0.6 + STEP)
    verdict = bench.feed(result(next_one), result(next_one), seen=SEEN)
    assert verdict.status is Status.TRACKED and verdict.corrects


def test_motion_that_the_images_leave_open_changes_nothing(bench: Bench) -> None:
    """A blank wall: neither the map nor the frame before tells where the camera went."""
    found = result(at(HERE + STEP), deviation=0.1)
    blank, without = SeenMotion(np.eye(4), 9.0 * np.eye(6)), moving()
    first, second = bench.feed(found, seen=blank), without.feed(found)
    assert first.covariance is not None and second.covariance is not None
    np.testing.assert_allclose(first.covariance.relative, second.covariance.relative, rtol=0.01)
    np.testing.assert_allclose(bench.motion.last_pose, without.motion.last_pose, atol=1e-4)


def test_a_map_that_is_sure_needs_no_motion(bench: Bench) -> None:
    bench.feed(result(at(HERE + STEP + 0.01)), seen=SEEN)
    np.testing.assert_allclose(bench.motion.last_pose, at(HERE + STEP + 0.01), atol=1e-12)


def test_a_pose_that_explains_only_parts_of_the_view_is_uncertain(bench: Bench) -> None:
    verdict = bench.feed(result(at(HERE + STEP), explained=0.3))
    assert verdict.status is Status.UNCERTAIN and '30%' in verdict.reason


def test_a_jump_is_believed_when_the_next_frame_is_there_too(bench: Bench) -> None:
    verdict = bench.feed(result(at(HERE + 0.3)))
    assert verdict.status is Status.UNCERTAIN and '29 cm' in verdict.reason and not verdict.corrects
    verdict = bench.feed(result(at(HERE + 0.3 + STEP)), result(at(HERE + 0.3 + STEP)))
    assert verdict.status is Status.TRACKED and verdict.corrects
    assert not bench.feed(result(at(HERE + 0.3 + 2 * STEP))).corrects


def test_a_jump_that_explains_less_is_taken_back(bench: Bench) -> None:
    assert bench.feed(result(at(HERE + 0.3))).status is Status.UNCERTAIN
    verdict = bench.feed(result(at(HERE + 0.3), explained=0.6), result(at(HERE + 2 * STEP)))
    assert verdict.status is Status.TRACKED and not verdict.corrects
    np.testing.assert_allclose(bench.motion.last_pose, at(HERE + 2 * STEP), atol=1e-12)


def test_two_places_that_explain_a_view_equally_well_are_uncertain(bench: Bench) -> None:
    assert bench.feed(result(at(HERE + 0.3))).status is Status.UNCERTAIN
    verdict = bench.feed(result(at(HERE + 0.3 + STEP)), result(at(HERE + 2 * STEP)))
    assert verdict.status is Status.UNCERTAIN and 'two places' in verdict.reason


def test_poses_that_explain_a_view_alike_make_each_other_uncertain(bench: Bench) -> None:
    """After a jump alignment ends in one place from here, and 5 cm away from there; each of them claims 3 mm."""
    assert bench.feed(result(at(HERE + 0.3))).status is Status.UNCERTAIN
    verdict = bench.feed(result(at(HERE + 0.3 + STEP)), result(at(HERE + 0.35 + STEP)))
    assert verdict.status is Status.UNCERTAIN and 'may be off by' in verdict.reason
    verdict = bench.feed(result(at(HERE + 0.3 + 2 * STEP)), result(at(HERE + 0.302 + 2 * STEP)))
    assert verdict.status is Status.TRACKED and verdict.covariance is not None
    deviation = np.sqrt(verdict.covariance.relative[0, 0])
    assert deviation == pytest.approx(np.sqrt((0.003 * np.sqrt(3)) ** 2 / 3 + 0.002**2 / 2), rel=0.05)


def test_what_is_mapped_after_a_jump_stays_as_far_off_as_its_first_pose(bench: Bench) -> None:
    before = bench.judge.state.position_drift
    bench.feed(result(at(HERE + 0.3)))
    for index, deviation in enumerate((0.003, 0.001, 0.001), start=1):
        found = [result(at(HERE + 0.3 + index * STEP), deviation=deviation) for _ in range(2)]
        verdict = bench.feed(*found)
        assert verdict.status is Status.TRACKED and verdict.covariance is not None
    added = verdict.covariance.drift_position_m**2 - before
    assert added == pytest.approx(0.0075**2 * 3 * STEP + 3 * 0.003**2, rel=1e-3)  # the way, and once the pose


def test_a_jump_is_no_pace(bench: Bench) -> None:
    """Nor is the way from a pose that was wrong; over a gap, and from an older pose, it is that of several frames."""
    predicted, dt = bench.motion.predictions(bench.stamp_ns + FRAME_NS)[0], 1e-9 * FRAME_NS

    def pace(moved_m: float) -> float:
        T_now_last = se3.inverse(at(moved_m))
        return -predicted.pace.twist(T_now_last)[0]

    limit_m = MAX_ACCELERATION * dt**2
    assert pace(STEP + 0.9 * limit_m) == pytest.approx(STEP + 0.9 * limit_m)
    assert pace(STEP + 2 * limit_m) == pytest.approx(STEP + limit_m / 2)
    assert pace(STEP + 20 * limit_m) == pytest.approx(STEP + limit_m / 20)
    late = bench.motion.predictions(bench.stamp_ns + 3 * FRAME_NS)[0].pace
    assert late.num_frames == 3
    np.testing.assert_allclose(late.twist(se3.inverse(at(3 * STEP))), [-STEP, 0, 0, 0, 0, 0], atol=1e-12)
    bench.feed(result(at(HERE + 0.3)))
    assert [at.pace.num_frames for at in bench.motion.predictions(bench.stamp_ns + FRAME_NS)] == [1, 2]


def test_a_camera_may_have_gone_far_in_a_gap(bench: Bench) -> None:
    """At the acceleration of a hand: 30 cm are impossible in 33 ms, and nothing in a third of a second."""
    assert bench.feed(result(at(HERE + 0.3)), after_ns=10 * FRAME_NS).status is Status.TRACKED


def test_a_lost_frame_has_no_covariance_and_stops_the_motion(bench: Bench) -> None:
    verdict = bench.feed(result(at(HERE), inliers=0.2))
    assert (verdict.status, verdict.covariance) == (Status.LOST, None) and 'agrees' in verdict.reason


def test_what_is_left_open_has_the_uncertainty_of_the_prediction_and_it_grows(bench: Bench) -> None:
    """A blank wall: until the camera may be anywhere."""
    covariance, deviations = np.diag([9.0, *[1e-6] * 5]), []
    for index in range(1, 200):
        found = result(at(HERE + STEP * index))
        assert found.evidence is not None
        verdict = bench.feed(*[replace(found, evidence=replace(found.evidence, covariance=covariance, num_open=1))] * 2)
        if verdict.status is Status.UNCERTAIN:
            break
        assert verdict.covariance is not None and verdict.num_held == 1
        deviations.append(np.sqrt(verdict.covariance.relative[0, 0]))
    assert 3 < index < 30 and (np.diff(deviations) > 0).all()


def test_drift_grows_with_the_way_and_covariances_are_in_the_axes_of_the_world() -> None:
    bench = Bench()
    turned = se3.exp(np.array([0, 0, 0, 0, np.pi / 2, 0]))  # the camera's z axis is the world's x axis
    bench.motion.place(turned)
    deviations = np.array([1, 2, 3, 4, 5, 6]) * 1e-3
    one = replace(result(turned), evidence=Evidence(np.diag(deviations**2), 0, 1.0, 40, 0.01))
    covariance = bench.feed(one).covariance
    assert covariance is not None
    np.testing.assert_allclose(np.sqrt(np.diag(covariance.relative)), np.array([3, 2, 1, 6, 5, 4]) * 1e-3, rtol=1e-6)
    assert covariance.drift_position_m == 0
    for index in range(1, 101):
        covariance = bench.feed(result(turned @ at(0.01 * index))).covariance
    assert covariance is not None
    assert covariance.drift_position_m == pytest.approx(0.0075) == covariance.drift_rotation_rad  # a way of 1 m
    np.testing.assert_allclose(covariance.total - covariance.relative, 0.0075**2 * np.eye(6), atol=1e-9)
