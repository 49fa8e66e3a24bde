"""SLAM over a whole recording: what is known of it before the first frame."""

from __future__ import annotations

from splatam_core.config import SlamConfig
from splatam_core.datasets.base import Sequence
from splatam_core.datasets.known_poses import FramesWithTruth
from splatam_core.slam import Slam


def prepare(sequence: Sequence, config: SlamConfig) -> tuple[Sequence, Slam]:
    """The frames to process, and an empty map for them.

    Raises:
        ConfigError: the true poses are asked for, and are not there.
    """
    if config.tracking.method != 'truth':
        return sequence, Slam(config, num_frames=len(sequence))
    frames = FramesWithTruth(sequence)
    return frames, Slam(config, true_motion=frames.motion, num_frames=len(frames))
