"""The state of SLAM that outlives a frame: what a checkpoint stores and ``Slam.restore`` takes back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from splatam_core.config import SlamConfig
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.mapping.posed import PosedView
from splatam_core.tracking.motion import MotionState
from splatam_core.types import Arrays


@dataclass(frozen=True, slots=True, eq=False)
class SlamState:
    """All of ``Slam`` that the frames to come depend on.

    Attributes:
        config: every setting.
        camera: of the frames; None before the first.
        map: see ``GaussianMap.arrays``.
        keyframes: as they were kept, in the host's memory.
        motion: of the motion model.
        rng: of numpy's generator, as ``BitGenerator.state`` has it.
        scene_radius: metres; 0 before the first frame.
        num_frames: frames processed.
        last_stamp_ns: stamp of the last one; None where the next may have any.
    """

    config: SlamConfig
    camera: PinholeCamera | None
    map: Arrays
    keyframes: tuple[PosedView, ...]
    motion: MotionState
    rng: dict[str, Any]
    scene_radius: float
    num_frames: int
    last_stamp_ns: int | None
