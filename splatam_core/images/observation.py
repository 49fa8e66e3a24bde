"""One frame's images where they are needed: in the host's memory, and on the device that computes."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from splatam_core.config import DepthConfig
from splatam_core.images.view import View
from splatam_core.types import RgbdFrame


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """What the camera sees in one frame.

    Attributes:
        host: the images in the host's memory, with only the depth readings that are used.
        device: the same on the device; the same object where that is the host.
    """

    host: View
    device: View

    @classmethod
    def from_frame(cls, frame: RgbdFrame, config: DepthConfig, device: torch.device) -> Observation:
        """Returns the observation of a frame; brings it to the device once."""
        host = View.from_frame(frame, config)
        return cls(host, host.to(device))
