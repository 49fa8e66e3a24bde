"""Gauss-Newton on photometric and depth residuals, from the coarsest level of a pyramid to the finest."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from torch import Tensor

from splatam_core.config import TrackingConfig
from splatam_core.geometry import se3
from splatam_core.geometry.se3 import Matrix
from splatam_core.tracking.aligner import Aligner, Array, Linearization, LinearSystem
from splatam_core.tracking.evidence import Evidence, Knowns, max_depth_error, step_of, weigh
from splatam_core.tracking.motion import Pace
from splatam_core.tracking.pyramid import EDGE, Level
from splatam_core.tracking.readout import ReadoutSeen
from splatam_core.tracking.time_offset import TimeOffset

_MIN_POINTS = 50
_SMALL_STEP = 1e-4  # m, rad: converged; a step is a fraction of the one before
_SMALL_COARSE_STEP = 1e-3  # at a level from which a finer one goes on
_FIRST_SCALES = 0.1, 0.02  # of residuals: brightness in [0, 1], relative depth
_MIN_SCALES = 0.004, 0.001  # no sensor is better
_MAD_TO_DEVIATION = 1.4826  # standard deviation over median absolute deviation, for a normal distribution
_LEAST_WEIGHT = 1e-6
_TWIST, _GAIN_AND_BIAS, _TIME_OFFSET, _READOUT = range(6), range(6, 8), range(8, 9), range(9, 10)  # the unknowns
_ANY_PACE = Pace()
_PRIOR = np.array([0.3] * 6 + [0.1] * 2) ** -2  # variance^-1 of a step: m and rad; gain, bias


@dataclass(frozen=True, slots=True, eq=False)
class AlignmentState:
    """The estimate that alignment refines.

    Attributes:
        depth_motion: [4, 4] from the reference's camera to the frame's camera at the depth image's time.
        gain: brightness of the frame = gain * brightness of the reference + bias.
        bias: see gain.
        time_offset: frame intervals by which the colour image is later than the depth image.
        velocity: [6] twist of the camera per frame interval.
        readout: fraction of the interval from the first row of an image to its last.
    """

    depth_motion: Matrix
    gain: float = 1.0
    bias: float = 0.0
    time_offset: float = 0.0
    velocity: Matrix = field(default_factory=lambda: np.zeros(6))
    readout: float = 0.0

    @property
    def color_motion(self) -> Matrix:
        """[4, 4] from the reference's camera to the frame's camera at the colour image's time."""
        return se3.exp(self.time_offset * self.velocity) @ self.depth_motion if self.time_offset else self.depth_motion

    def moved(self, step: Matrix) -> AlignmentState:
        """Returns the state after a step [10] of the unknowns."""
        return AlignmentState(
            depth_motion=se3.exp(step[:6]) @ self.depth_motion,
            gain=self.gain + step[6],
            bias=self.bias + step[7],
            time_offset=self.time_offset + step[8],
            velocity=self.velocity,
            readout=self.readout + step[9],
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Pair:
    """What is aligned at one level.

    Attributes:
        reference: the render.
        layers: of the frame, see ``Aligner.layers``.
        depth_share: of the frame, see ``Level``.
        predicted_motion: [4, 4] from the camera at the last pose to the render's; None if that is not known.
        time_offset: between colour and depth, before this frame.
        pace: how the camera is expected to move from frame to frame.
        readout: how long reading an image takes, before this frame; None where it is not estimated.
    """

    reference: Level
    layers: Array | Tensor
    depth_share: float
    predicted_motion: Matrix | None
    time_offset: TimeOffset
    pace: Pace
    readout: ReadoutSeen | None


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
        exposure, time_offset = _GAIN_AND_BIAS if align.exposure else (), _TIME_OFFSET if align.time_offset else ()
        self._free = [*_TWIST, *exposure, *time_offset]  # the unknowns to solve for
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
        start = state = AlignmentState(np.eye(4) if start_motion is None else start_motion)
        if self._estimates_time_offset and predicted_motion is not None:
            state = replace(state, time_offset=time_offset.mean)
        readout = pace.readout if self._estimates_readout and predicted_motion is not None else None
        if readout is not None:
            state = replace(state, readout=readout.mean)
        scales = _FIRST_SCALES
        for reference, frame in zip(reversed(references), reversed(frames), strict=True):
            layers = self._aligner.layers(frame.brightness, frame.depth, EDGE)
            pair = _Pair(
                reference=reference,
                layers=layers,
                depth_share=frame.depth_share,
                predicted_motion=predicted_motion,
                time_offset=time_offset,
                pace=pace,
                readout=readout,
            )
            small_step = _SMALL_STEP if reference is references[0] else _SMALL_COARSE_STEP
            state, scales = self._iterate(pair, state, scales, small_step)
        system = self._linearize(pair, state, scales)
        after, equations, free = time_offset, _Equations.of(system, state, pair), self._unknowns(pair)
        if self._estimates_time_offset:
            after = time_offset.updated(state.time_offset, equations.information(_TIME_OFFSET[0], free))
        at_start = self._linearize(pair, start, scales)
        if not _is_better(at_start, system):
            return Alignment(start, at_start, time_offset, partial(self._weigh, pair, start, scales))
        return Alignment(state, system, after, partial(self._weigh, pair, state, scales), _seen(equations, state, pair, free))

    def _iterate(
        self, pair: _Pair, state: AlignmentState, scales: tuple[float, float], small_step: float
    ) -> tuple[AlignmentState, tuple[float, float]]:
        """Takes steps at one level until one is small, m and rad. Returns the state and the scales of the residuals."""
        for _ in range(self._config.iterations):
            if pair.predicted_motion is not None:
                state = replace(state, velocity=pair.pace.twist(state.depth_motion @ pair.predicted_motion))
            system = self._linearize(pair, state, scales)
            scales = _scales(system)
            step = _Equations.of(system, state, pair).step(self._unknowns(pair))
            if step is None:
                break
            state = state.moved(step)
            if np.abs(step[:6]).max() < small_step:
                break
        return state, scales

    def _linearize(self, pair: _Pair, state: AlignmentState, scales: tuple[float, float]) -> LinearSystem:
        config = self._config
        at = self._at(pair, state, scales)
        return self._aligner.linearize(at, inlier_color=config.inlier_color, inlier_depth=config.inlier_depth)

    def _at(self, pair: _Pair, state: AlignmentState, scales: tuple[float, float]) -> Linearization[Any]:
        reference = pair.reference
        photometric_scale, depth_scale = self._weighted(pair, scales)
        return Linearization(
            camera=reference.camera,
            brightness=reference.brightness,
            depth=reference.depth,
            layers=pair.layers,
            color_motion=state.color_motion.astype(np.float32),
            depth_motion=state.depth_motion.astype(np.float32),
            velocity=state.velocity.astype(np.float32),
            gain=state.gain,
            bias=state.bias,
            photometric_scale=photometric_scale,
            depth_scale=depth_scale,
            max_depth_ratio=2 * EDGE,
            readout=(state.readout * state.velocity).astype(np.float32),
        )

    def _unknowns(self, pair: _Pair) -> list[int]:
        """Returns the indices of what is solved for."""
        return self._free if pair.readout is None else [*self._free, *_READOUT]

    def _weighted(self, pair: _Pair, scales: tuple[float, float]) -> tuple[float, float]:
        """Returns the scales of the residuals of brightness and depth, divided by the roots of their weights."""
        # What lies between readings repeats their errors, and adds some.
        weights = self._config.color_weight, self._config.depth_weight * pair.depth_share
        color, depth = (scale / math.sqrt(max(weight, _LEAST_WEIGHT)) for scale, weight in zip(scales, weights, strict=True))
        return color, depth

    def _weigh(self, pair: _Pair, state: AlignmentState, scales: tuple[float, float]) -> Evidence:
        at = self._at(pair, state, scales)
        sums = self._aligner.evidence(at, max_depth_error=max_depth_error(at.depth_scale), step=step_of(at.camera))
        prior = np.append(_PRIOR, pair.time_offset.information)
        return weigh(sums, Knowns(at.camera, state.velocity, prior, pair.time_offset.inflation, self._free))


def _seen(equations: _Equations, state: AlignmentState, pair: _Pair, free: list[int]) -> ReadoutSeen | None:
    """Returns what a frame alone tells about the readout; None if nothing."""
    if pair.readout is None or not (information := equations.information(_READOUT[0], free)) > 0:
        return None
    return ReadoutSeen(state.readout + (state.readout - pair.readout.mean) * pair.readout.information / information, information)


def _is_better(start: LinearSystem, found: LinearSystem) -> bool:
    """Returns whether an estimate has lower cost than the start. A point that is not seen costs the average of the start's."""
    unseen_cost = start.cost / max(1, start.seen)
    return 2 * found.seen > start.seen and _total_cost(found, unseen_cost) < _total_cost(start, unseen_cost)


def _scales(system: LinearSystem) -> tuple[float, float]:
    """Returns the scales of the residuals of brightness and depth, from their medians."""
    return (
        max(_MIN_SCALES[0], _MAD_TO_DEVIATION * system.photometric_median),
        max(_MIN_SCALES[1], _MAD_TO_DEVIATION * system.depth_median),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Equations:
    """The normal equations of all ten unknowns, the readout the last of them, without what is known before.

    Attributes:
        H: [10, 10].
        g: [10].
        prior: [10] inverse variances.
        off: [10] by how much the state differs from what is known before.
        num_seen: number of points.
    """

    H: Matrix
    g: Matrix
    prior: Matrix
    off: Matrix
    num_seen: int

    @classmethod
    def of(cls, system: LinearSystem, state: AlignmentState, pair: _Pair) -> _Equations:
        """Returns those of a system. A point moves with the readout as with the time offset, times when its row is read."""
        H, g, turn = np.zeros((10, 10)), np.zeros(10), state.velocity
        H[:9, :9], g[:9] = system.H, system.g
        readout = pair.readout or ReadoutSeen()
        if pair.readout is not None:
            H[:9, 9] = H[9, :9] = system.H_by_time[:, :6] @ turn
            H[9, 9] = turn @ system.H_by_time_squared[:6, :6] @ turn
            g[9] = turn @ system.g_by_time[:6]
        prior = np.array([*_PRIOR, pair.time_offset.information, readout.information])
        found = state.gain - 1, state.bias, state.time_offset - pair.time_offset.mean, state.readout - readout.mean
        return cls(H, g, prior, np.array([0.0] * 6 + [*found]), system.seen)

    def information(self, unknown: int, free: list[int]) -> float:
        """Returns the inverse variance that the residuals claim for an unknown, the other free ones marginalized."""
        others, H = [other for other in free if other != unknown], self.H + np.diag(self.prior)
        return float(self.H[unknown, unknown] - H[unknown, others] @ np.linalg.solve(H[np.ix_(others, others)], H[others, unknown]))

    def step(self, free: list[int]) -> Matrix | None:
        """Returns the step [10] of the free unknowns that minimises the residuals; None if they do not determine one.

        On a ramp of brightness a shift looks like a change of bias. The priors decide what the residuals leave open.
        """
        if self.num_seen < _MIN_POINTS:
            return None
        H, g, step = self.H + np.diag(self.prior), self.g + self.prior * self.off, np.zeros(10)
        try:
            step[free] = -np.linalg.solve(H[np.ix_(free, free)], g[free])
        except np.linalg.LinAlgError:
            return None
        return step


def _total_cost(system: LinearSystem, unseen_cost: float) -> float:
    """Returns the robust cost of all points, with a given cost for each point that is not seen."""
    return system.cost + unseen_cost * (system.points - system.seen)
