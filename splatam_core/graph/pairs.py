"""The motion between two keyframes, from their images alone: no map, no rendering."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from splatam_core.config import TrackingConfig
from splatam_core.geometry import se3
from splatam_core.geometry.se3 import Matrix
from splatam_core.images.view import View
from splatam_core.tracking.aligner import Aligner
from splatam_core.tracking.evidence import Evidence
from splatam_core.tracking.gauss_newton import GaussNewton
from splatam_core.tracking.pyramid import Level, frame_level, half_pyramid
from splatam_core.tracking.time_offset import TimeOffset

_KEPT_PYRAMIDS = 8


@dataclass(frozen=True, slots=True, eq=False)
class PairResult:
    """How one view was found relative to another.

    Attributes:
        T_second_first: [4, 4] from the first one's camera to the second one's.
        overlap: fraction of the first one's depths that meet a reading of the second.
        agreement: fraction of these that agree in colour and depth.
        weigh: returns how far the motion may be trusted.
    """

    T_second_first: Matrix
    overlap: float
    agreement: float
    weigh: Callable[[], Evidence]


class PairAligner:
    """Aligns views directly."""

    def __init__(self, aligner: Aligner[Any], config: TrackingConfig) -> None:
        still = replace(config, align=replace(config.align, time_offset=False))  # it is part of both views
        self._aligner, self._gauss_newton = aligner, GaussNewton(aligner, still)
        self._pyramids: dict[View, list[Level]] = {}  # ordered by last use

    def align(self, first: View, second: View, T_second_first: Matrix) -> PairResult:
        """Aligns the second view to the first, starting at a motion [4, 4] from the first one's camera to the second one's."""
        references, frames = self._pyramid(first), self._pyramid(second)
        found = self._gauss_newton.align(references, frames, None, TimeOffset(), T_second_first)
        system = found.system
        return PairResult(
            T_second_first=found.state.color_motion,
            overlap=system.compared / max(1, system.points),
            agreement=system.agreeing / max(1, system.compared),
            weigh=found.weigh,
        )

    def way_back(self, first: View, second: View, there: PairResult) -> tuple[float, float]:
        """Aligns the first view to the second. Returns how far from the way there that ends: metres and radians."""
        back = self.align(second, first, se3.inverse(there.T_second_first))
        off = se3.log(back.T_second_first @ there.T_second_first)
        return float(np.linalg.norm(off[:3])), float(np.linalg.norm(off[3:]))

    def _pyramid(self, view: View) -> list[Level]:
        pyramid = self._pyramids.pop(view, None) or half_pyramid(frame_level(view, self._aligner), self._aligner)
        self._pyramids[view] = pyramid
        while len(self._pyramids) > _KEPT_PYRAMIDS:
            del self._pyramids[next(iter(self._pyramids))]
        return pyramid
