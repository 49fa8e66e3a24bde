"""Trackers find the pose of a frame in the map, from a predicted pose, with the evidence for it."""

from __future__ import annotations

from collections.abc import Callable

import torch

from splatam_core.config import TrackingConfig
from splatam_core.device import HOST
from splatam_core.interruption import Stop, never
from splatam_core.rasterizer import Rasterizer
from splatam_core.tracking.alignment import AlignmentTracker
from splatam_core.tracking.base import Tracker, TrackingResult
from splatam_core.tracking.none import NullTracker
from splatam_core.tracking.render_and_compare import RenderAndCompareTracker
from splatam_core.tracking.torch_aligner import TorchAligner

__all__ = [
    'AlignmentTracker', 'NullTracker', 'RenderAndCompareTracker', 'TorchAligner', 'Tracker', 'TrackingResult', 'make_tracker',
]  # fmt: skip

_TRACKERS: dict[str, Callable[[Rasterizer, TrackingConfig, int, torch.device, Stop], Tracker]] = {
    'render_and_compare': RenderAndCompareTracker, 'align': AlignmentTracker,
    'none': NullTracker, 'truth': NullTracker,  # with truth, the predicted pose is the true one
}  # fmt: skip


def make_tracker(
    rasterizer: Rasterizer, config: TrackingConfig, threads: int = 0, device: torch.device = HOST, stop: Stop = never
) -> Tracker:
    """Returns the tracker that the configuration names.

    Args:
        rasterizer: renders the map.
        config: the settings.
        threads: CPU threads; 0 = one per core.
        device: the device of map and frames.
        stop: asked between the steps of a frame; the frame is given up once it returns True.
    """
    return _TRACKERS[config.method](rasterizer, config, threads, device, stop)
