"""Takes back what was mapped at poses that later frames prove wrong."""

from __future__ import annotations

import logging

import numpy as np

from splatam_core.config import TrackingConfig
from splatam_core.geometry import se3
from splatam_core.graph.keyframe_graph import KeyframeGraph
from splatam_core.mapping.mapper import Mapper
from splatam_core.tracking import Tracker
from splatam_core.tracking.verdict import SAME_PLACE, verify

_log = logging.getLogger(__name__)

PROBATION = 15
"""Frames after which what a frame added counts as proven."""


def correct(mapper: Mapper, graph: KeyframeGraph, tracker: Tracker, config: TrackingConfig, current: int) -> int:
    """Removes what was added at wrong poses, after the camera turned out to be elsewhere than those poses led to.

    The keyframes among the last frames are aligned once more, to the map without what these frames have added. From the first
    one on that is clearly elsewhere, everything is removed that the frames have added.

    Args:
        mapper: holds map and keyframes.
        graph: of the keyframes.
        tracker: aligns.
        config: says when an alignment counts.
        current: number of the present frame.

    Returns:
        The number of Gaussians removed.
    """
    if not len(mapper.keyframes):
        return 0
    proven = max(current - PROBATION, int(mapper.map.added_by.min()) + 1)  # the first frame defines the world
    older = mapper.map.gaussians.detached().chosen(mapper.map.added_by < proven)
    right = proven - 1
    for keyframe in [keyframe for keyframe in mapper.keyframes if keyframe.frame >= proven]:
        posed = mapper.keyframes.on_device(keyframe)
        T_cam_world = keyframe.T_cam_world.double().numpy(force=True)
        found = tracker.track(posed.view.scaled(config.scale), older, T_cam_world)
        off = np.linalg.norm(se3.log(found.T_cam_world @ se3.inverse(T_cam_world)).reshape(2, 3), axis=1).max()
        if not verify(found, config) and off > SAME_PLACE:
            removed = mapper.retract(right + 1)
            graph.drop_from(right + 1)
            _log.warning(
                'the pose of frame %d was wrong: what the frames from %d on have added, %d Gaussians, is removed',
                keyframe.frame, right + 1, removed,
            )  # fmt: skip
            return removed
        right = keyframe.frame
    return 0
