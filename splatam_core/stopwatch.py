"""Measures the time a frame spends in each stage."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import torch

from splatam_core.device import synchronize
from splatam_core.types import StageTimings


@dataclass(slots=True)
class Stopwatch:
    """Wall time of the stages of one frame. Waits for the device at the end of each stage."""

    device: torch.device
    started: float = field(default_factory=time.perf_counter)
    lapped: float = field(default_factory=time.perf_counter)
    laps: dict[str, float] = field(default_factory=dict)

    def lap(self, stage: str) -> None:
        """Ends a stage; the next one begins."""
        synchronize(self.device)
        now = time.perf_counter()
        self.laps[stage] = 1e3 * (now - self.lapped)
        self.lapped = now

    def timings(self) -> StageTimings:
        """Returns the times so far, in milliseconds."""
        synchronize(self.device)
        return StageTimings(**self.laps, total=1e3 * (time.perf_counter() - self.started))
