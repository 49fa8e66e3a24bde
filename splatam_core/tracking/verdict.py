"""When a pose may be trusted.

A frame is *lost* when its pose explains too little of the view. It is *tracked* when the pose explains colour and depth all over
the part of the view that is mapped, the images determine it well enough, and the camera can have moved there since the frame
before. Where one of these fails the frame is *uncertain*: its pose is the best there is, but nothing may rely on it.

A jump that the camera cannot have made is believed when the next frame finds the camera there as well.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from splatam_core.config import TrackingConfig
from splatam_core.geometry import se3
from splatam_core.geometry.se3 import Matrix
from splatam_core.images.view import View
from splatam_core.rasterizer import Render
from splatam_core.tracking.base import TrackingResult
from splatam_core.tracking.evidence import Evidence
from splatam_core.tracking.motion import MAX_ACCELERATION, MAX_ANGULAR_ACCELERATION, Prediction
from splatam_core.types import PoseCovariance, Status

DRIFT_PER_ROOT_METRE = 0.0075
"""Standard deviation by which the map drifts, m and rad, per root of the way in m and rad: half a per cent over two metres."""

DEVIATIONS = 3.0
"""A pose is taken to be off by at most this many standard deviations."""

SAME_PLACE = 0.1  # m and rad: explanations that are nearer to each other are one
_MUCH_BETTER = 1.05  # times as many cells
_FINE_PIXEL_RAD = 0.01  # wider pixels leave more open: at half size, those of images less than some 250 pixels wide
_SURE = 0.5  # of the error allowed: the map alone is sure enough
_WEAK = 0.75  # of the error allowed: beyond, the last frame is asked as well
_ALIKE = 10  # frames in a row whose errors in a weak part of the map are the same one: together they count once
_CONTRADICTION = 3.0  # standard deviations along each axis by which map and motion differ where one of them is wrong
_REENTRY = 0.9  # after a frame in doubt, the next must be so much surer to be trusted
_JUMP_DEVIATIONS = 5.0
_LEARNING_RATE = 0.1
_GATE = 3.0  # standard deviations: a larger error of the prediction is an outlier
_MIN_NOISE, _FIRST_NOISE, _MAX_NOISE = 0.03, 0.3, 3.0  # m/s and rad/s
_USUAL_ACCELERATIONS = np.array([2.0, 4.0])  # m/s^2, rad/s^2
_SPEED = 0.5  # m/s and rad/s: of a camera of which nothing is known
_LONGEST_LESSON = 0.5  # seconds: a longer gap says nothing about the motion from frame to frame
_LONGEST_GAP = 1e3  # seconds
_START_DEVIATION = 1e-4  # m and rad: the first frame defines the world


def compare(T_cam_world: Matrix, render: Render, view: View, config: TrackingConfig) -> TrackingResult:
    """Returns a pose [4, 4] with the evidence for it: how much of the view agrees with the map rendered from there."""
    visible = view.valid & (render.silhouette > config.silhouette_threshold)
    depth_agrees = (render.depth() - view.depth).abs() <= config.inlier_depth * view.depth
    color_agrees = (render.rgb - view.rgb).abs().mean(dim=0) <= config.inlier_color
    counts = torch.stack([view.valid.sum(), visible.sum(), (visible & depth_agrees & color_agrees).sum()])
    num_readings, num_visible, num_inliers = counts.tolist()
    return TrackingResult(
        T_cam_world=T_cam_world,
        T_cam_world_depth=T_cam_world,
        num_readings=num_readings,
        visible_fraction=num_visible / max(1, num_readings),
        inlier_fraction=num_inliers / max(1, num_visible),
    )


def verify(result: TrackingResult, config: TrackingConfig) -> str:
    """Returns why a pose must not be used, so that the frame is lost; empty where it may be used."""
    if not np.isfinite(result.T_cam_world).all():
        return 'tracking diverged: the pose is not finite'
    if result.num_readings == 0:
        return 'no pixel has a usable depth reading'
    if result.visible_fraction < config.min_visible_fraction:
        return f'only {result.visible_fraction:.0%} of the view is mapped (at least {config.min_visible_fraction:.0%} needed)'
    if result.inlier_fraction < config.min_inlier_fraction:
        return f'only {result.inlier_fraction:.0%} of it agrees with the map (at least {config.min_inlier_fraction:.0%} needed)'
    return ''


def better(first: TrackingResult, second: TrackingResult, config: TrackingConfig) -> TrackingResult:
    """Returns the one of two poses of a frame that explains clearly more of it; the first one of two equals."""
    return second if _support(second, config) > _MUCH_BETTER * _support(first, config) else first


def widened(best: TrackingResult, found: Sequence[TrackingResult], config: TrackingConfig) -> TrackingResult:
    """Returns the best of the poses found for a frame, with how far others are from it as part of its covariance.

    Only those count that explain the frame as well: each of them may be the right one.
    """
    if best.evidence is None:
        return best
    alike = [result for result in found if result is not best and _explain_alike(best, result, config)]
    if not alike:
        return best
    apart = np.array([se3.log(result.T_cam_world_depth @ se3.inverse(best.T_cam_world_depth)) for result in alike])
    covariance = best.evidence.covariance + apart.T @ apart / (1 + len(alike))
    return replace(best, evidence=replace(best.evidence, covariance=covariance))


def _explain_alike(first: TrackingResult, second: TrackingResult, config: TrackingConfig) -> bool:
    """Returns whether two poses of a frame explain about as much of it."""
    supports = sorted(_support(result, config) for result in (first, second))
    return supports[0] > 0 and supports[1] <= _MUCH_BETTER * supports[0]


def are_equal(first: TrackingResult, second: TrackingResult, config: TrackingConfig) -> bool:
    """Returns whether two poses of a frame are far apart and explain it equally well."""
    apart = se3.log(first.T_cam_world @ se3.inverse(second.T_cam_world))
    return max(_lengths(apart)) > SAME_PLACE and _explain_alike(first, second, config)


def _support(result: TrackingResult, config: TrackingConfig) -> float:
    """Returns in how much of the view a pose explains brightness and depth, 0 where it must not be used."""
    if verify(result, config):
        return 0.0
    return result.inlier_fraction * (1 if result.evidence is None else result.evidence.num_explained)


@dataclass(frozen=True, slots=True, eq=False)
class Verdict:
    """What is decided about a frame.

    Attributes:
        status: tracked, uncertain or lost.
        reason: why it is not tracked; empty otherwise.
        covariance: of the pose; None if it is lost or the tracker estimates none.
        num_held: number of directions in which the pose is the predicted one.
        corrects: True if a jump is believed, so that poses before it may have been wrong.
    """

    status: Status
    reason: str = ''
    covariance: PoseCovariance | None = None
    num_held: int = 0
    corrects: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class JudgeState:
    """What a judge remembers.

    Attributes:
        position_noise: standard deviation of the prediction's position per second since the last pose, m/s.
        rotation_noise: of its rotation, rad/s.
        covariance: [6, 6] of the last pose, as a twist in the camera's axes.
        position_drift: variance of where the map is, along each axis, m^2.
        rotation_drift: variance of how it is turned, about each axis, rad^2.
        has_jumped: True if the last frame was uncertain because of a jump.
        is_in_doubt: True if the last frame was uncertain or lost.
        unseen_s: for how long the motion was not seen in the images, seconds; less where they said something about it.
    """

    position_noise: float = _FIRST_NOISE
    rotation_noise: float = _FIRST_NOISE
    covariance: Matrix = field(default_factory=lambda: _START_DEVIATION**2 * np.eye(6))
    position_drift: float = 0.0
    rotation_drift: float = 0.0
    has_jumped: bool = False
    is_in_doubt: bool = False
    unseen_s: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class _Blend:
    """How the pose found in the map is combined with the predicted one and with the motion seen since the frame before.

    Attributes:
        found: [6] twist from the predicted to the found pose.
        combined: [6] from the predicted to the combined pose.
        covariance: [6, 6] of the combined pose.
        guessed: [6, 6] covariance of what the motion since the last pose was guessed to be.
        unseen_share: how little of that motion the images tell, in the direction of which they tell least; 0 where they are sure.
    """

    found: Matrix
    combined: Matrix
    covariance: Matrix
    guessed: Matrix
    unseen_share: float

    @classmethod
    def of_found(cls, found: Matrix, covariance: Matrix) -> _Blend:
        """Takes the found pose as it is."""
        return cls(found, found, covariance, np.zeros((6, 6)), 0.0)

    def applied(self, result: TrackingResult) -> TrackingResult:
        """Returns the result at the combined pose."""
        if self.combined is self.found:
            return result
        back = se3.exp(self.combined) @ se3.exp(-self.found)
        return replace(result, T_cam_world=back @ result.T_cam_world, T_cam_world_depth=back @ result.T_cam_world_depth)


class Judge:
    """Decides about frames one after the other.

    Attributes:
        state: what it remembers.
    """

    def __init__(self) -> None:
        self.state = JudgeState()

    def start(self) -> Verdict:
        """Decides about the first frame of a map, whose camera defines the world."""
        self.state = JudgeState()
        return Verdict(Status.INITIALIZED, covariance=PoseCovariance(self.state.covariance, 0.0, 0.0))

    def relocate(self, state: JudgeState, verdict: Verdict) -> Verdict:
        """Takes over what another judge says about a camera that was found elsewhere in the map; the drift stays as it is."""
        drift = self._drift()
        self.state = replace(state, position_drift=self.state.position_drift, rotation_drift=self.state.rotation_drift)
        covariance = None if verdict.covariance is None else PoseCovariance(verdict.covariance.relative, *drift)
        return replace(verdict, covariance=covariance, corrects=False)

    def choose(
        self, found: Sequence[TrackingResult], predictions: Sequence[Prediction], config: TrackingConfig
    ) -> tuple[TrackingResult, Verdict]:
        """Returns the best of the poses that were found for a frame, and the verdict about it.

        Args:
            found: poses, each found from the prediction in its place; at least one.
            predictions: where the camera was expected.
            config: the thresholds.
        """
        best = 0
        for other in range(1, len(found)):
            if better(found[best], found[other], config) is found[other]:
                best = other
        if best:
            self.state = replace(self.state, has_jumped=False)  # it has not: there is a better explanation
        is_ambiguous = any(result is not found[best] and are_equal(found[best], result, config) for result in found)
        return self.decide(widened(found[best], found, config), predictions[best], config, is_ambiguous=is_ambiguous)

    def decide(
        self, result: TrackingResult, prediction: Prediction, config: TrackingConfig, is_ambiguous: bool = False
    ) -> tuple[TrackingResult, Verdict]:
        """Decides about the next frame.

        Args:
            result: its pose.
            prediction: where the camera was expected.
            config: the thresholds.
            is_ambiguous: whether another place explains the frame as well.

        Returns:
            The pose, and the verdict about it. What the images determine poorly is taken from the prediction, as far as that is
            surer.
        """
        if reason := verify(result, config):
            self.state = replace(self.state, has_jumped=False, is_in_doubt=True)
            return result, Verdict(Status.LOST, reason)
        if result.evidence is None:
            return result, Verdict(Status.TRACKED)
        step = se3.log(result.T_cam_world_depth @ prediction.T_world_cam)
        blend = self._blend(step, result.evidence, prediction, config)
        gone = (step, result.evidence.covariance) if prediction.seen is None else (blend.combined, blend.covariance)
        jump = self._jump(*gone, prediction)
        allowed_m = _allowed_m(result.evidence, config) * (_REENTRY if self.state.is_in_doubt else 1)
        weakness = 'two places explain the view equally well' if is_ambiguous else ''
        weakness = weakness or _weakness(result.evidence, blend.covariance, allowed_m, config)
        corrects = self.state.has_jumped and not weakness and not jump
        if not result.evidence.num_open:
            self._learn(step, result.evidence.covariance, prediction.seconds)
        reason = weakness or jump
        if not reason:
            way = sum(_lengths(se3.log(result.T_cam_world_depth @ prediction.T_world_cam_before)))
            # After frames in doubt, what is mapped from here on is as far off as this pose.
            self._drift_on(way, blend.covariance if self.state.is_in_doubt else blend.guessed)
        is_elsewhere = bool(jump) or is_ambiguous  # or where it was expected: the next pose must not be drawn to this one
        self.state = replace(
            self.state,
            covariance=blend.covariance + np.outer(step, step) if is_elsewhere else blend.covariance,
            has_jumped=bool(jump),
            is_in_doubt=bool(reason),
            unseen_s=blend.unseen_share * (self.state.unseen_s + min(prediction.seconds, _LONGEST_GAP)),
        )
        covariance, result = blend.covariance, blend.applied(result)
        if reason:
            covariance = covariance + np.outer(step, step) + config.max_error_m**2 * np.eye(6)
        turn = np.zeros((6, 6))
        turn[:3, :3] = turn[3:, 3:] = result.T_cam_world[:3, :3].T
        return result, Verdict(
            status=Status.UNCERTAIN if reason else Status.TRACKED,
            reason=reason,
            covariance=PoseCovariance(turn @ covariance @ turn.T, *self._drift()),
            num_held=0 if result.evidence is None else result.evidence.num_open,
            corrects=corrects,
        )

    def _blend(self, step: Matrix, evidence: Evidence, prediction: Prediction, config: TrackingConfig) -> _Blend:
        """Returns how map, prediction and motion seen are combined: a Kalman filter where the map alone is not sure enough."""
        if largest_error(evidence.covariance) <= _SURE * config.max_error_m or not math.isfinite(prediction.seconds):
            return _Blend.of_found(step, evidence.covariance)
        noise, moved, unseen, in_map = self._noise(prediction), np.zeros(6), np.eye(6), evidence.covariance
        if prediction.seen is not None:
            gain, noise = _updated(noise, prediction.seen.covariance)
            by_images = prediction.seen.T_now_before @ se3.inverse(prediction.T_world_cam_before)
            moved, unseen = gain @ se3.log(by_images @ prediction.T_world_cam), np.eye(6) - gain
            in_map = _ALIKE * in_map
        expected, off = self.state.covariance + noise, step - moved
        if off @ np.linalg.solve(expected + in_map, off) > 6 * _CONTRADICTION**2:
            return _Blend.of_found(step, evidence.covariance)  # one of the two is wrong, and no mean of them is right
        gain, covariance = _updated(expected, in_map)
        kept = np.eye(6) - gain
        return _Blend(
            found=step,
            combined=moved + gain @ (step - moved),
            covariance=covariance,
            guessed=kept @ noise @ kept.T,
            unseen_share=min(max(float(np.linalg.eigvals(kept @ unseen).real.max()), 0.0), 1.0),
        )

    def _jump(self, step: Matrix, covariance: Matrix, prediction: Prediction) -> str:
        """Returns how far the camera has jumped, if it cannot have moved there; empty otherwise."""
        if not math.isfinite(prediction.seconds):
            return ''
        (moved_m, turned_rad), (deviation_m, deviation_rad) = _lengths(step), _deviations(covariance)
        usual = _JUMP_DEVIATIONS * prediction.seconds
        limit_m = max(usual * self.state.position_noise, MAX_ACCELERATION * prediction.seconds**2)
        limit_rad = max(usual * self.state.rotation_noise, MAX_ANGULAR_ACCELERATION * prediction.seconds**2)
        limit_m, limit_rad = math.hypot(limit_m, DEVIATIONS * deviation_m), math.hypot(limit_rad, DEVIATIONS * deviation_rad)
        if moved_m <= limit_m and turned_rad <= limit_rad:
            return ''
        return (
            f'the camera is {100 * moved_m:.0f} cm and {math.degrees(turned_rad):.0f} degrees from where its motion would take it '
            f'(at most {100 * limit_m:.0f} cm and {math.degrees(limit_rad):.0f} degrees expected)'
        )

    def _learn(self, step: Matrix, covariance: Matrix, seconds: float) -> None:
        """Adapts the noise of the prediction to how far it was off this time, beyond the error of the pose that was found."""
        if not 0 < seconds <= _LONGEST_LESSON:
            return
        pairs = zip(_lengths(step), _deviations(covariance), strict=True)
        off_m, off_rad = (math.sqrt(max(0.0, off**2 - deviation**2)) for off, deviation in pairs)
        self.state = replace(
            self.state,
            position_noise=_adapted(self.state.position_noise, off_m / seconds),
            rotation_noise=_adapted(self.state.rotation_noise, off_rad / seconds),
        )

    def _drift(self) -> tuple[float, float]:
        return math.sqrt(self.state.position_drift), math.sqrt(self.state.rotation_drift)

    def _drift_on(self, way: float, guessed: Matrix) -> None:
        """Adds to the drift: what comes with a way (m and rad), and the covariance [6, 6] of what was guessed on it."""
        by_way = DRIFT_PER_ROOT_METRE**2 * way
        position, rotation = (float(np.trace(block)) for block in (guessed[:3, :3], guessed[3:, 3:]))
        self.state = replace(
            self.state,
            position_drift=self.state.position_drift + by_way + position,
            rotation_drift=self.state.rotation_drift + by_way + rotation,
        )

    def _noise(self, prediction: Prediction) -> Matrix:
        """Returns the [6, 6] covariance by which a predicted pose is less sure than the one that it follows from.

        Errors of measured motions are independent. That of a velocity is the same until the motion is seen again.
        """
        rates = np.array(
            [max(noise, _SPEED * prediction.is_guess) for noise in (self.state.position_noise, self.state.rotation_noise)]
        )
        seconds, before_s = min(prediction.seconds, _LONGEST_GAP), self.state.unseen_s
        if prediction.is_measured:
            variances = (rates * seconds) ** 2
        else:
            off, off_before = (rates * s + 0.5 * _USUAL_ACCELERATIONS * s**2 for s in (before_s + seconds, before_s))
            variances = off**2 - off_before**2
        return np.diag(np.repeat(variances / 3, 3))


def is_weak(result: TrackingResult, config: TrackingConfig) -> bool:
    """Returns whether the map says so little about a pose that the motion since the last frame is worth a look."""
    evidence = result.evidence
    return evidence is not None and not largest_error(evidence.covariance) <= _WEAK * _allowed_m(evidence, config)


def _allowed_m(evidence: Evidence, config: TrackingConfig) -> float:
    """Returns by how much a pose may be off, m and rad: more in images of wide pixels."""
    return config.max_error_m * max(1.0, evidence.pixel_rad / _FINE_PIXEL_RAD)


def largest_error(covariance: Matrix) -> float:
    """Returns by how much a pose of a covariance [6, 6] may be off, m and rad."""
    return DEVIATIONS * max(_deviations(covariance))


def _updated(before: Matrix, measured: Matrix) -> tuple[Matrix, Matrix]:
    """Returns the gain of a Kalman update, and the covariance after it. before, measured: [6, 6] covariances."""
    gain = np.linalg.solve(before + measured, before).T
    kept = np.eye(6) - gain
    return gain, kept @ before @ kept.T + gain @ measured @ gain.T


def _weakness(evidence: Evidence, covariance: Matrix, allowed_m: float, config: TrackingConfig) -> str:
    """Returns why too little is known about the pose of a frame; empty where it is enough."""
    off = largest_error(covariance)
    if not off <= allowed_m:
        return f'its pose may be off by {100 * min(off, 99.0):.1f} cm (at most {100 * allowed_m:.1f} cm allowed)'
    explained = evidence.explained
    if explained < config.min_explained_fraction:
        return (
            f'only {explained:.0%} of its parts fit in brightness and depth (at least {config.min_explained_fraction:.0%} needed)'
        )
    return ''


def _adapted(noise: float, off: float) -> float:
    """Returns a standard deviation after one more deviation from the mean."""
    squared = min((off / noise) ** 2, _GATE**2)
    return min(max(noise * math.exp(0.5 * _LEARNING_RATE * (squared - 1)), _MIN_NOISE), _MAX_NOISE)


def _lengths(twist: Matrix) -> tuple[float, float]:
    """Returns the lengths of the translation and of the rotation of a twist [6]."""
    return float(np.linalg.norm(twist[:3])), float(np.linalg.norm(twist[3:]))


def _deviations(covariance: Matrix) -> tuple[float, float]:
    """Returns the standard deviations of position and rotation, over all axes, of a covariance [6, 6]."""
    x, y, z, *rotation = covariance.diagonal().tolist()  # single numbers: see ``se3.exp``
    return math.sqrt(max(0.0, x + y + z)), math.sqrt(max(0.0, sum(rotation)))
