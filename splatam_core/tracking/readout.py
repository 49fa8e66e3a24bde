"""How long it takes to read an image: with a rolling shutter one row after the other, while the camera moves.

It is found over many frames as the time offset is (``time_offset``): by a scalar Kalman filter that learns how much single frames
scatter. At rest and with a global shutter nothing is used. What is found is relative to the map, which was made of such frames: a
camera that turns evenly sees its own distortion in it. So the estimate never gets so sure that it would no longer follow.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

_FIRST_DEVIATION, _LEAST_DEVIATION = 0.5, 0.05  # of the interval between frames
_GATE = 3.0  # standard deviations: an innovation beyond is an outlier
_LEARNING_RATE = 0.05
_FIRST_INFLATION, _MIN_INFLATION, _MAX_INFLATION = 30.0, 1.0, 1e6
_LEAST_INFORMATION = 1e-3


@dataclass(frozen=True, slots=True)
class ReadoutSeen:
    """The readout as a fraction of the time between two frames: as one frame tells it, or all before it.

    Attributes:
        mean: the fraction.
        information: its inverse variance as normal equations claim it.
    """

    mean: float = 0.0
    information: float = 0.0


@dataclass(frozen=True, slots=True)
class Readout:
    """An estimate of the time from the first row of an image to its last, as far as the map does not show the same.

    Attributes:
        seconds: the time; negative where the last row is read first.
        deviation: standard deviation of the estimate, seconds; 0 before the first frame that tells something.
        inflation: factor by which the variance of one frame's estimate exceeds what its normal equations claim.
    """

    seconds: float = 0.0
    deviation: float = 0.0
    inflation: float = _FIRST_INFLATION

    @property
    def used_s(self) -> float:
        """The time, less where it is hardly larger than its error (James and Stein 1961), so that noise is not used."""
        return self.seconds * max(0.0, 1 - (self.deviation / self.seconds) ** 2) if self.seconds else 0.0

    def prior(self, interval_s: float) -> ReadoutSeen | None:
        """Returns what is known before a frame, so much later than the last one; None where that is not known."""
        if not 0 < interval_s < math.inf:
            return None
        deviation = self.deviation or _FIRST_DEVIATION * interval_s
        return ReadoutSeen(min(max(self.used_s / interval_s, -1.0), 1.0), self.inflation * (interval_s / deviation) ** 2)

    def updated(self, seen: ReadoutSeen, interval_s: float) -> Readout:
        """Returns the estimate after one frame."""
        if not (seen.information > _LEAST_INFORMATION and 0 < interval_s < math.inf):
            return self
        variance = (self.deviation or _FIRST_DEVIATION * interval_s) ** 2
        innovation = seen.mean * interval_s - self.seconds
        innovation_variance = variance + self.inflation / seen.information * interval_s**2
        squared = min(innovation**2 / innovation_variance, _GATE**2)
        inflation = min(max(self.inflation * math.exp(_LEARNING_RATE * (squared - 1)), _MIN_INFLATION), _MAX_INFLATION)
        if squared >= _GATE**2:
            return replace(self, inflation=inflation)
        gain = variance / innovation_variance
        deviation = max(math.sqrt((1 - gain) * variance), _LEAST_DEVIATION * interval_s)
        seconds = float(min(max(self.seconds + gain * innovation, -interval_s), interval_s))
        return Readout(seconds, deviation, inflation)
