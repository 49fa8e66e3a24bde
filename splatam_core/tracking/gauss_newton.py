"""Gauss-Newton on photometric and depth residuals, from the coarsest level of a pyramid to the finest."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatam_core.config import TrackingConfig
from splatam_core.geometry.se3 import Matrix
from splatam_core.tracking.aligner import Aligner, AlignmentState, Descent, Knowns, Linearization, LinearSystem
from splatam_core.tracking.descent import READOUT, TIME_OFFSET, Equations
from splatam_core.tracking.evidence import Evidence, max_depth_error, step_of
from splatam_core.tracking.pace import Pace
from splatam_core.tracking.pyramid import EDGE, Level
from splatam_core.tracking.readout import ReadoutSeen
from splatam_core.tracking.time_offset import TimeOffset

_SMALL_STEP = 1e-4  # m, rad: converged; a step is a fraction of the one before
_SMALL_COARSE_STEP = 1e-3  # at a level from which a finer one goes on
_LEAST_WEIGHT = 1e-6
_NUM_UNKNOWNS, _TWIST, _GAIN_AND_BIAS = 10, range(6), range(6, 8)
_ANY_PACE = Pace()
_PRIOR = np.array([0.3] * 6 + [0.1] * 2) ** -2  # variance^-1 of a step: m and rad; gain, bias


@dataclass(frozen=True, slots=True, eq=False)
class _Known:
    """What is known before a frame is aligned.

    Attributes:
        predicted_motion: [4, 4] from the camera at the last pose to the render's; None if that is not known.
        time_offset: between colour and depth.
        pace: how the camera is expected to move from frame to frame.
        readout: how long reading an image takes; None where it is not estimated.
        mean: see ``Descent``.
        information: see ``Descent``.
        is_free: see ``Descent``.
    """

    predicted_motion: Matrix | None
    time_offset: TimeOffset
    pace: Pace
    readout: ReadoutSeen | None
    mean: Matrix
    information: Matrix
    is_free: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """A state, and how well the frame agrees with the reference there.

    Attributes:
        state: the state.
        system: the residuals at the finest level.
        time_offset: between colour and depth, after this frame.
        weigh: returns what the residuals say about the state; it takes as long as a step.
        readout: what the residuals say about the time that reading an image takes; None if nothing.
    """

    state: AlignmentState
    system: LinearSystem
    time_offset: TimeOffset
    weigh: Callable[[], Evidence]
    readout: ReadoutSeen | None = None

    @property
    def evidence(self) -> Evidence:
        """What the residuals say about the state."""
        return self.weigh()


class GaussNewton:
    """Aligns a frame to a reference render.

    Residuals have Student-t weights with scales from the data (DVO; Kerl, Sturm and Cremers, "Robust Odometry Estimation for
    RGB-D Cameras", 2013).
    """

    def __init__(self, aligner: Aligner[Any], config: TrackingConfig) -> None:
        self._aligner = aligner
        self._config = config
        align = config.align
        exposure, time_offset = _GAIN_AND_BIAS if align.exposure else (), (TIME_OFFSET,) if align.time_offset else ()
        self._free = [*_TWIST, *exposure, *time_offset]  # the unknowns to solve for, but the readout
        self._estimates_time_offset = align.time_offset
        self._estimates_readout = align.rolling_shutter

    def align(
        self,
        references: Sequence[Level],
        frames: Sequence[Level],
        predicted_motion: Matrix | None,
        time_offset: TimeOffset,
        start_motion: Matrix | None = None,
        *,
        pace: Pace = _ANY_PACE,
    ) -> Alignment:
        """Aligns from coarse to fine, starting where the reference was rendered, or at another motion.

        Args:
            references: pyramid of the render, finest level first.
            frames: pyramid of the frame, with the same cameras.
            predicted_motion: [4, 4] from the camera at the last pose to the render's; None if that is not known.
            time_offset: between colour and depth, before this frame.
            start_motion: [4, 4] from the reference's camera to the frame's; None = none.
            pace: how the camera is expected to move from frame to frame; counts where the predicted motion is known.

        Returns:
            The state found, or the start where that explains the finest level better.
        """
        start = AlignmentState(np.eye(4) if start_motion is None else start_motion)
        is_predicted = predicted_motion is not None
        readout = pace.readout if self._estimates_readout and is_predicted else None
        state = AlignmentState(
            start.depth_motion,
            time_offset=time_offset.mean if self._estimates_time_offset and is_predicted else 0.0,
            readout=0.0 if readout is None else readout.mean,
        )
        known = self._known(predicted_motion, time_offset, pace, readout)
        for reference, frame in zip(reversed(references), reversed(frames), strict=True):
            task = self._task(reference, frame, known, _SMALL_STEP if reference is references[0] else _SMALL_COARSE_STEP)
            state = self._aligner.descend(task, state)
        at = task.at(state)
        system = self._linearize(at)
        after, equations = time_offset, Equations.of(system, state, task)
        if self._estimates_time_offset:
            after = time_offset.updated(state.time_offset, equations.information(TIME_OFFSET))
        start = replace(start, scales=state.scales)
        at_start = task.at(start)
        system_at_start = self._linearize(at_start)
        if not _is_better(system_at_start, system):
            return Alignment(start, system_at_start, time_offset, partial(self._weigh, at_start, start, known))
        return Alignment(state, system, after, partial(self._weigh, at, state, known), _seen(equations, state, readout))

    def _known(
        self, predicted_motion: Matrix | None, time_offset: TimeOffset, pace: Pace, seen: ReadoutSeen | None
    ) -> _Known:  # fmt: skip
        """Returns what is known at every level."""
        readout, is_free = seen or ReadoutSeen(), np.zeros(_NUM_UNKNOWNS, dtype=np.bool_)
        is_free[self._free], is_free[READOUT] = True, seen is not None
        mean = np.array([0.0] * 6 + [1.0, 0.0, time_offset.mean, readout.mean])
        information = np.array([*_PRIOR, time_offset.information, readout.information])
        return _Known(
            predicted_motion=predicted_motion,
            time_offset=time_offset,
            pace=pace,
            readout=seen,
            mean=mean,
            information=information,
            is_free=is_free,
        )

    def _task(self, reference: Level, frame: Level, known: _Known, small_step: float) -> Descent[Any]:
        """Returns what is done at one level."""
        config = self._config
        # What lies between readings repeats their errors, and adds some.
        weights = np.array([config.color_weight, config.depth_weight * frame.depth_share])
        return Descent(
            camera=reference.camera,
            brightness=reference.brightness,
            depth=reference.depth,
            layers=self._aligner.layers(frame.brightness, frame.depth, EDGE),
            max_depth_ratio=2 * EDGE,
            predicted_motion=known.predicted_motion,
            pace=known.pace,
            mean=known.mean,
            information=known.information,
            is_free=known.is_free,
            scale_factors=1 / np.sqrt(np.maximum(weights, _LEAST_WEIGHT)),
            iterations=config.iterations,
            small_step=small_step,
        )

    def _linearize(self, at: Linearization[Any]) -> LinearSystem:
        return self._aligner.linearize(at, inlier_color=self._config.inlier_color, inlier_depth=self._config.inlier_depth)

    def _weigh(self, at: Linearization[Any], state: AlignmentState, known: _Known) -> Evidence:
        step = step_of(at.camera)
        sums = self._aligner.evidence(at, max_depth_error=max_depth_error(at.depth_scale), step=step)
        prior, is_free = known.information[:READOUT], known.is_free[:READOUT]
        knowns = Knowns(at.camera, step, state.velocity, prior, known.time_offset.inflation, is_free)
        found = self._aligner.weigh(sums, knowns)
        return Evidence(found.covariance, found.num_open, found.explained, found.num_explained, 1 / at.camera.fx)


def _seen(equations: Equations, state: AlignmentState, known: ReadoutSeen | None) -> ReadoutSeen | None:
    """Returns what a frame alone tells about the readout; None if nothing."""
    if known is None or not (information := equations.information(READOUT)) > 0:
        return None
    return ReadoutSeen(state.readout + (state.readout - known.mean) * known.information / information, information)


def _is_better(start: LinearSystem, found: LinearSystem) -> bool:
    """Returns whether an estimate has lower cost than the start. A point that is not seen costs the average of the start's."""
    unseen_cost = start.cost / max(1, start.seen)
    return 2 * found.seen > start.seen and _total_cost(found, unseen_cost) < _total_cost(start, unseen_cost)


def _total_cost(system: LinearSystem, unseen_cost: float) -> float:
    """Returns the robust cost of all points, with a given cost for each point that is not seen."""
    return system.cost + unseen_cost * (system.points - system.seen)
