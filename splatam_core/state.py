"""The state of SLAM between two frames: ``Slam.state`` returns it, a checkpoint stores it, ``Slam.restore`` takes it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from splatam_core.config import SlamConfig
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.graph.places import Places
from splatam_core.graph.relocalisation import RelocaliserState
from splatam_core.images.view import View
from splatam_core.mapping.posed import PosedView
from splatam_core.tracking.motion import MotionState
from splatam_core.tracking.verdict import JudgeState
from splatam_core.types import Arrays


@dataclass(frozen=True, slots=True, eq=False)
class SlamState:
    """Everything in ``Slam`` that later frames depend on.

    Attributes:
        config: every setting.
        camera: of the frames; None before the first.
        map: see ``GaussianMap.arrays``.
        keyframes: at the size they are fitted at, in the host's memory.
        motion: of the motion model.
        judge: what the verdicts so far leave.
        relocaliser: what it remembers of a camera that is lost.
        places: see ``Places.arrays``; empty where lost cameras are not looked for.
        graph: see ``KeyframeGraph.arrays``.
        rng: of numpy's generator, in the form of ``BitGenerator.state``.
        scene_radius: metres; 0 before the first frame.
        num_frames: number of frames processed.
        last_stamp_ns: stamp of the last frame; None where the next frame may have any stamp.
        last_view: what the camera saw at the last pose, in the host's memory; None where there is no such frame.
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
    judge: JudgeState = field(default_factory=JudgeState)
    relocaliser: RelocaliserState = field(default_factory=RelocaliserState)
    places: Arrays = field(default_factory=dict)
    graph: Arrays = field(default_factory=dict)
    last_view: View | None = None


@dataclass(frozen=True, slots=True, eq=False)
class SavedKeyframes:
    """The keyframes of a map, as they are saved beside it.

    Attributes:
        keyframes: in the host's memory.
        places: see ``Places.arrays``.
    """

    keyframes: tuple[PosedView, ...]
    places: Arrays


NO_KEYFRAMES = SavedKeyframes((), Places().arrays())
