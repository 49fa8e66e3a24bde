"""Finds a camera that is lost, wherever in the map it is, and one whose pose was never known or is told by a person.

The view is compared with all keyframes; the map is rendered at the poses that this suggests, and the view aligned to it. A pose
that explains the view by itself, far more clearly than a frame in motion needs to, is tried on the next frame. Only if the
camera can have moved from the one to the other, and the second one is explained as clearly, the camera is there. It is tracked
again as soon as its pose is as sure as the verdict asks: with that frame, or with one of the next, which confirm it as well
(docs/decisions/0014-relocalisation.md).
"""

from __future__ import annotations

import logging
import math
from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from splatam_core.config import TrackingConfig
from splatam_core.geometry import se3
from splatam_core.geometry.se3 import Matrix
from splatam_core.graph.places import Place, Places
from splatam_core.images.view import View
from splatam_core.rasterizer import Gaussians
from splatam_core.tracking import Tracker, TrackingResult
from splatam_core.tracking.evidence import COLUMNS, ROWS
from splatam_core.tracking.motion import Prediction
from splatam_core.tracking.time_offset import TimeOffset
from splatam_core.tracking.verdict import SAME_PLACE, Judge, JudgeState, Verdict, are_equal, better, largest_error, verify
from splatam_core.types import Status

_log = logging.getLogger(__name__)

EAGER_FRAMES = 30
"""A camera lost for no longer than this many frames is looked for more often."""

_AT_FIRST = (10, 1), (EAGER_FRAMES, 3)  # until so many frames in doubt, every n-th one
_NEAR_M, _NEAR_RAD = 2.0, 1.6  # of a pose that a person told: keyframes farther away are not considered
_MAX_SHIFT_M, _MAX_TURN_RAD = 0.3, 0.3  # by which alignment may move the pose that features suggest
_MIN_VISIBLE, _MIN_INLIERS, _MIN_EXPLAINED = 0.2, 0.8, 0.5
_MIN_CELLS = ROWS * COLUMNS // 4  # of the view, in which brightness and depth fit
_MAX_CONFIRMED = 4  # frames that confirm what was recognised; if they do not make the pose sure, the camera is looked for anew
TOLD = -1
"""Stands for the number of a keyframe where a person told the pose."""


@dataclass(frozen=True, slots=True, eq=False)
class Recognition:
    """A pose that the next frame must confirm.

    Attributes:
        stamp_ns: of the frame that it was found for.
        T_world_cam: [4, 4].
        covariance: [6, 6] of the pose, as a twist in the camera's axes.
        keyframe: number of the keyframe that was recognised, or ``TOLD``.
        num_confirmed: number of frames that have confirmed it, while the pose was not sure enough to be tracked.
    """

    stamp_ns: int
    T_world_cam: Matrix
    covariance: Matrix
    keyframe: int
    num_confirmed: int = 0

    @property
    def source(self) -> str:
        """Where the pose is from, for messages."""
        return 'the pose that was told' if self.keyframe == TOLD else f'keyframe {self.keyframe}'


@dataclass(frozen=True, slots=True, eq=False)
class RelocaliserState:
    """What a relocaliser remembers.

    Attributes:
        num_in_doubt: number of frames in a row, the last one included, that were not tracked.
        is_anywhere: True while nothing is known about where the camera is.
        told: [4, 4] pose that a person told and that was not tried yet; None otherwise.
        recognised: what the next frame must confirm; None otherwise.
    """

    num_in_doubt: int = 0
    is_anywhere: bool = False
    told: Matrix | None = None
    recognised: Recognition | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """A frame, and what is needed to look for it in the map.

    Attributes:
        stamp_ns: its stamp.
        view: as it is tracked.
        host: in the host's memory.
        gaussians: the map.
        tracker: aligns.
        time_offset: between colour and depth.
        config: when a pose may be used.
    """

    stamp_ns: int
    view: View
    host: View
    gaussians: Gaussians
    tracker: Tracker
    time_offset: TimeOffset
    config: TrackingConfig

    def places(self, places: Places, exclude: Collection[int] = (), attempt: int = 0) -> list[Place]:
        """Returns where the frame was perhaps taken. attempt: how often the camera was looked for since it was lost."""
        return places.find(self.host, self.config.align.relocalisation.candidates, exclude, attempt)


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """A camera that was found again.

    Attributes:
        result: its pose.
        verdict: tracked.
        judge: what the verdicts leave, apart from the drift.
        keyframe: number of the keyframe that was recognised, or ``TOLD``.
    """

    result: TrackingResult
    verdict: Verdict
    judge: JudgeState
    keyframe: int

    @property
    def T_world_cam(self) -> Matrix:
        """[4, 4] the pose."""
        return se3.inverse(self.result.T_cam_world)


def unknown() -> tuple[TrackingResult, Verdict]:
    """Returns the result of tracking a camera of which nothing is known."""
    nowhere = TrackingResult(np.eye(4), np.eye(4), num_readings=None, visible_fraction=0.0, inlier_fraction=0.0)
    return nowhere, Verdict(Status.LOST, 'the camera has seen no place of the map yet that it recognises')


def recognise(sight: Sight, places: Places, tracked: TrackingResult, attempt: int = 0) -> Recognition | None:
    """Looks for a place that shows what a frame shows.

    Args:
        sight: the frame.
        places: the keyframes.
        tracked: its pose from the usual tracking.
        attempt: how often the camera was looked for since it was lost.

    Returns:
        The pose there; None if no place explains the frame better than the pose tracked, or two places do.
    """
    tried = [_aligned(sight, place.T_cam_world, place.keyframe) for place in sight.places(places, attempt=attempt)]
    best, recognition = tracked, None
    for aligned in filter(None, tried):
        if better(best, aligned.result, sight.config) is aligned.result:
            best, recognition = aligned.result, aligned.recognition
    is_here = not verify(tracked, sight.config) and max(_apart(best.T_cam_world, tracked.T_cam_world)) <= SAME_PLACE
    is_ambiguous = any(aligned is not None and are_equal(best, aligned.result, sight.config) for aligned in tried)
    return None if is_here or is_ambiguous else recognition


class Relocaliser:
    """Looks for a camera that is not tracked, in a bounded number of frames and places.

    Attributes:
        places: the keyframes.
        state: what it remembers.
    """

    def __init__(self, places: Places) -> None:
        self.places = places
        self.state = RelocaliserState()

    def is_resting(self, config: TrackingConfig) -> bool:
        """Returns whether the next frame is left out, so that a camera that is lost for long takes little time."""
        state = self.state
        if not config.relocalises or state.num_in_doubt < EAGER_FRAMES or state.told is not None or state.recognised is not None:
            return False
        return not _is_due(state.num_in_doubt, config)

    def rest(self) -> Verdict:
        """Leaves a frame out."""
        self._count()
        return Verdict(Status.LOST, 'the camera is lost, and looked for on every n-th frame only (relocalisation.every)')

    def interrupt(self) -> None:
        """Forgets what the next frame was to confirm, because its stamp says nothing about the time since then.

        A pose that a person told is tried once more.
        """
        told, recognised = self.state.told, self.state.recognised
        if recognised is not None and recognised.keyframe == TOLD:
            told = recognised.T_world_cam
        self.state = replace(self.state, told=told, recognised=None)

    def tell(self, T_world_cam: Matrix) -> None:
        """Notes a pose [4, 4] that a person told; the next frame is tried there first."""
        self.state = replace(self.state, told=T_world_cam, recognised=None)

    def recover(self, sight: Sight, tracked: TrackingResult, verdict: Verdict) -> Found | None:
        """Looks for the camera of a frame elsewhere, after it was tracked as usual.

        Args:
            sight: the frame.
            tracked: its pose from the usual tracking.
            verdict: about that pose.

        Returns:
            Where the camera is; None if it is where the verdict says.
        """
        if found := self._confirmed(sight):
            self.state = RelocaliserState()
            return found
        if self.state.told is not None:
            self._try_told(sight)
        elif verdict.status.is_trusted:
            recognised = self.state.recognised  # a person may know that it is tracked at a wrong place
            is_told = recognised is not None and recognised.keyframe == TOLD
            self.state = RelocaliserState(recognised=recognised if is_told else None)
        elif self.state.recognised is not None:
            self._count()
        elif sight.config.relocalises:
            since = self.state.num_in_doubt - (verdict.status is Status.UNCERTAIN)  # one such frame is no reason to look elsewhere
            if self.state.num_in_doubt >= EAGER_FRAMES or (since >= 0 and _is_due(since, sight.config)):
                attempt = _attempts(max(since, 0), sight.config)
                self.state = replace(self.state, recognised=recognise(sight, self.places, tracked, attempt))
            self._count()
        return None

    def _count(self) -> None:
        self.state = replace(self.state, num_in_doubt=self.state.num_in_doubt + 1)

    def _try_told(self, sight: Sight) -> None:
        """Tries the pose that a person told, and what the keyframes near it suggest."""
        assert self.state.told is not None
        told = se3.inverse(self.state.told)
        far = [number for number, T_cam_world in self.places.poses().items() if not _is_near(T_cam_world, told)]
        starts = [*(place.T_cam_world for place in sight.places(self.places, exclude=far)), told]
        tried = (_aligned(sight, start, TOLD, _NEAR_M, _NEAR_RAD) for start in starts)
        aligned = next(filter(None, tried), None)
        if aligned is None:
            _log.warning('the pose that was told is refused: what the camera sees does not fit the map there')
        self.state = replace(self.state, told=None, recognised=None if aligned is None else aligned.recognition)

    def _confirmed(self, sight: Sight) -> Found | None:
        """Returns the pose of the frame if it confirms what was recognised before, and is sure. If not, the next one may be."""
        before, self.state = self.state.recognised, replace(self.state, recognised=None)
        if before is None:
            return None
        seconds = 1e-9 * (sight.stamp_ns - before.stamp_ns)
        prediction = Prediction(before.T_world_cam, before.T_world_cam, seconds, is_guess=True)
        start = prediction.T_cam_world
        result = sight.tracker.track(sight.view, sight.gaussians, start, start, sight.time_offset)
        judge = Judge()
        judge.state = JudgeState(covariance=before.covariance)
        result, verdict = judge.decide(result, prediction, sight.config)
        is_here = verdict.status is not Status.LOST and not judge.state.has_jumped and is_convincing(result)
        num_confirmed = before.num_confirmed + is_here
        if not is_here or (verdict.status is not Status.TRACKED and num_confirmed == _MAX_CONFIRMED):
            if before.keyframe == TOLD:
                _log.warning('the pose that was told is refused: the next frames do not confirm it')
            return None
        if verdict.status is not Status.TRACKED:
            pose = se3.inverse(result.T_cam_world)
            recognised = Recognition(sight.stamp_ns, pose, judge.state.covariance, before.keyframe, num_confirmed)
            self.state = replace(self.state, recognised=recognised)
            return None
        found = Found(result, verdict, judge.state, before.keyframe)
        _log.warning('relocalised by %s, at (%s) m', before.source, ', '.join(f'{x:.2f}' for x in found.T_world_cam[:3, 3]))
        return found


def _attempts(count: int, config: TrackingConfig) -> int:
    """Returns on how many of so many frames in a row that are in doubt the camera is looked for."""
    every, begin, attempts = config.align.relocalisation.every, 0, 0
    for end, step in (*_AT_FIRST, (max(count, EAGER_FRAMES), every)):
        attempts += -(-max(0, min(count, end) - begin) // min(step, every))
        begin = end
    return attempts


def _is_due(count: int, config: TrackingConfig) -> bool:
    """Returns whether the camera is looked for on a frame, after so many in doubt."""
    return _attempts(count + 1, config) > _attempts(count, config)


@dataclass(frozen=True, slots=True, eq=False)
class _Aligned:
    """A pose that explains a frame clearly.

    Attributes:
        result: the pose.
        recognition: the same, for the next frame to confirm.
    """

    result: TrackingResult
    recognition: Recognition


def _aligned(
    sight: Sight, T_cam_world: Matrix, keyframe: int, max_shift_m: float = _MAX_SHIFT_M, max_turn_rad: float = _MAX_TURN_RAD
) -> _Aligned | None:
    """Aligns a frame to the map at a guessed pose [4, 4]. Returns None if the pose found does not explain it clearly."""
    result = sight.tracker.track(sight.view, sight.gaussians, T_cam_world)
    guess, judge = se3.inverse(T_cam_world), Judge()
    result, verdict = judge.decide(result, Prediction(guess, guess, math.inf, is_guess=True), sight.config)
    if verdict.status is Status.LOST or not is_convincing(result):
        return None
    shift_m, turn_rad = _apart(result.T_cam_world, T_cam_world)
    if shift_m > max_shift_m or turn_rad > max_turn_rad:
        return None
    pose = se3.inverse(result.T_cam_world)
    return _Aligned(result, Recognition(sight.stamp_ns, pose, judge.state.covariance, keyframe))


def is_convincing(result: TrackingResult) -> bool:
    """Returns whether a pose explains a frame so well that it needs no frame before it.

    It need not be as sure as that of a frame in motion: it says which place it is, and the next frames how it lies.
    """
    evidence = result.evidence
    is_determined = evidence is None or (
        not evidence.num_open
        and evidence.explained >= _MIN_EXPLAINED
        and evidence.num_explained >= _MIN_CELLS
        and largest_error(evidence.covariance) <= SAME_PLACE
    )
    return is_determined and result.visible_fraction >= _MIN_VISIBLE and result.inlier_fraction >= _MIN_INLIERS


def _apart(first: Matrix, second: Matrix) -> tuple[float, float]:
    """Returns how far two poses T_cam_world [4, 4] are apart, m and rad."""
    between = first @ se3.inverse(second)
    return float(np.linalg.norm(between[:3, 3])), float(np.linalg.norm(se3.rotation_vector(between[:3, :3])))


def _is_near(first: Matrix, second: Matrix) -> bool:
    centres = [se3.inverse(T)[:3, 3] for T in (first, second)]
    return bool(np.linalg.norm(centres[0] - centres[1]) < _NEAR_M) and _apart(first, second)[1] < _NEAR_RAD
