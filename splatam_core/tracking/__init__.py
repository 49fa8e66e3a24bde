"""Trackers: (frame, map, first guess of the pose) in, pose and how far to trust it out."""

from __future__ import annotations

import torch

from splatam_core.config import TrackingConfig
from splatam_core.device import HOST
from splatam_core.rasterizer import Rasterizer
from splatam_core.tracking.alignment import AlignmentTracker
from splatam_core.tracking.base import Tracker, TrackingResult
from splatam_core.tracking.none import NullTracker
from splatam_core.tracking.render_and_compare import RenderAndCompareTracker
from splatam_core.tracking.torch_aligner import TorchAligner

__all__ = [
    'AlignmentTracker', 'NullTracker', 'RenderAndCompareTracker', 'TorchAligner', 'Tracker', 'TrackingResult', 'make_tracker',
]  # fmt: skip

_TRACKERS = {
    'render_and_compare': RenderAndCompareTracker, 'align': AlignmentTracker,
    'none': NullTracker, 'truth': NullTracker,  # which Slam hands the true pose as its first guess
}  # fmt: skip


def make_tracker(rasterizer: Rasterizer, config: TrackingConfig, threads: int = 0, device: torch.device = HOST) -> Tracker:
    """The tracker that the configuration names.

    Args:
        rasterizer: draws the map.
        config: what to do.
        threads: CPU threads; 0 = all cores.
        device: where map and frames are.
    """
    return _TRACKERS[config.method](rasterizer, config, threads, device)
