"""The motion of a camera while it takes a frame: rows are read one after the other, and colour may be later than depth."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from splatam_core.geometry.se3 import Vector


@dataclass(frozen=True, slots=True, eq=False)
class ReadMotion:
    """How a camera moves while it takes a frame.

    Attributes:
        velocity: [6] twist per second by which points move in the camera's axes.
        readout_s: time from the first row of an image to its last, seconds.
        delay_s: time from the depth image to the colour image, seconds.
    """

    velocity: Vector = field(default_factory=lambda: np.zeros(6))
    readout_s: float = 0.0
    delay_s: float = 0.0

    @property
    def rows(self) -> Vector:
        """[6] twist from the first row of an image to its last."""
        return self.readout_s * self.velocity

    @property
    def delay(self) -> Vector:
        """[6] twist from the depth image to the colour image."""
        return self.delay_s * self.velocity


STILL = ReadMotion()
"""Nothing is known, or the camera is at rest."""
