"""The time between the exposures of colour and depth, estimated over many frames.

A single frame says little about it: the offset moves the image by as much as the camera moves in that time, which at slow
motion is less than the noise. It is a property of the camera, constant or slowly drifting where colour and depth run on
clocks of their own, so a scalar Kalman filter follows it. Pixels of one image are not independent, so their normal equations
claim more than they know; the filter learns by how much from its own innovations (adaptive estimation, Mehra 1970). Where
the data do not determine the offset, its estimates scatter, the filter trusts them less and holds what it knows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

FIRST_VARIANCE = 0.5**2  # frame intervals squared: colour and depth of one frame belong together
DRIFT_VARIANCE = 0.03**2  # per frame: two clocks at 30 Hz that differ by a tenth of a per cent
_GATE = 3.0  # standard deviations: an innovation beyond is an outlier, such as a colour frame that came twice
_LEARNING_RATE = 0.05
_FIRST_INFLATION, _MIN_INFLATION, _MAX_INFLATION = 30.0, 1.0, 1e6


@dataclass(frozen=True, slots=True)
class TimeOffset:
    """An estimate of the time offset.

    Attributes:
        mean: frame intervals by which colour is later than depth.
        variance: of the estimate, frame intervals squared.
        inflation: factor by which the variance of one frame's estimate exceeds what its normal equations claim.
    """

    mean: float = 0.0
    variance: float = FIRST_VARIANCE
    inflation: float = _FIRST_INFLATION

    @property
    def information(self) -> float:
        """Weight of ``mean`` as a prior in the normal equations of a frame."""
        return self.inflation / self.variance

    def updated(self, posterior: float, information: float) -> TimeOffset:
        """Returns the estimate after one frame.

        Args:
            posterior: time offset that the frame's normal equations gave, this prior included.
            information: inverse variance that the residuals alone claim for it.
        """
        predicted = replace(self, variance=min(self.variance + DRIFT_VARIANCE, FIRST_VARIANCE))
        if not information > 1e-3:
            return predicted
        measured = posterior + (posterior - self.mean) * self.information / information  # without the prior
        innovation, innovation_variance = measured - self.mean, self.variance + self.inflation / information
        squared = min(innovation**2 / innovation_variance, _GATE**2)
        factor = math.exp(_LEARNING_RATE * (squared - 1))
        inflation = min(max(self.inflation * factor, _MIN_INFLATION), _MAX_INFLATION)
        if squared >= _GATE**2:
            return replace(predicted, inflation=inflation)
        gain = self.variance / innovation_variance
        variance = min((1 - gain) * self.variance + DRIFT_VARIANCE, FIRST_VARIANCE)
        return TimeOffset(self.mean + gain * innovation, variance, inflation)
