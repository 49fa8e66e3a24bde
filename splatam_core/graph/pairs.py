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
from splatam_core.tracking.read_motion import STILL, ReadMotion
from splatam_core.tracking.time_offset import TimeOffset
from splatam_core.tracking.unrolling import unrolled

_KEPT_PYRAMIDS = 8
_READOUT_STEP_S = 1e-3  # an estimate that changes by less is the same: a pyramid is not made anew at every frame


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """A view, and how the camera moved while it took it.

    Attributes:
        view: the images.
        motion: of the camera.
    """

    view: View
    motion: ReadMotion = STILL


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
        self._pyramids: dict[tuple[View, bytes], list[Level]] = {}  # by view and motion, ordered by last use

    def align(self, first: Shot, second: Shot, T_second_first: Matrix) -> PairResult:
        """Aligns the second view to the first, starting at a motion [4, 4] from the first one's camera to the second one's.

        Both motions are those at the time of the colour image's middle row.
        """
        references, frames = self._pyramid(first), self._pyramid(second)
        found = self._gauss_newton.align(references, frames, None, TimeOffset(), T_second_first)
        system = found.system
        return PairResult(
            T_second_first=found.state.color_motion,
            overlap=system.compared / max(1, system.points),
            agreement=system.agreeing / max(1, system.compared),
            weigh=found.weigh,
        )

    def way_back(self, first: Shot, second: Shot, T_second_first: Matrix) -> tuple[float, float]:
        """Aligns the first view to the second. Returns how far from the way there [4, 4] that ends: metres and radians."""
        back = self.align(second, first, se3.inverse(T_second_first))
        off = se3.log(back.T_second_first @ T_second_first)
        return float(np.linalg.norm(off[:3])), float(np.linalg.norm(off[3:]))

    def _pyramid(self, shot: Shot) -> list[Level]:
        """Returns the pyramid of a view, as if all of it was taken at once."""
        motion = replace(shot.motion, readout_s=_READOUT_STEP_S * round(shot.motion.readout_s / _READOUT_STEP_S))
        key = shot.view, motion.rows.tobytes() + motion.delay.tobytes()
        pyramid = self._pyramids.pop(key, None)
        if pyramid is None:
            finest, *coarser = half_pyramid(frame_level(shot.view, self._aligner), self._aligner)
            still = unrolled(finest, motion)
            pyramid = [finest, *coarser] if still is finest else [still, *half_pyramid(still, self._aligner)][: 1 + len(coarser)]
        self._pyramids[key] = pyramid
        while len(self._pyramids) > _KEPT_PYRAMIDS:
            del self._pyramids[next(iter(self._pyramids))]
        return pyramid
