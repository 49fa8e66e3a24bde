"""Views with the pose they were taken from."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatam_core.config import MappingConfig
from splatam_core.device import pose_tensor
from splatam_core.images.observation import Observation
from splatam_core.images.view import View


@dataclass(frozen=True, slots=True, eq=False)
class PosedView:
    """A view and where it was taken from.

    Attributes:
        view: the images.
        T_cam_world: [4, 4] float32.
    """

    view: View
    T_cam_world: Tensor

    @classmethod
    def at(cls, view: View, T_cam_world: NDArray[np.float64]) -> PosedView:
        """Returns a view at a pose [4, 4] float64, on the view's device."""
        return cls(view, pose_tensor(T_cam_world, view.depth.device))

    def to(self, device: torch.device) -> PosedView:
        """Returns the same on a device; itself where it is there already."""
        if self.view.depth.device == device:
            return self
        return PosedView(self.view.to(device), self.T_cam_world.to(device, non_blocking=True))

    def half_size(self) -> PosedView:
        """Returns the same at half the size."""
        return PosedView(self.view.scaled(0.5), self.T_cam_world)

    def bare(self) -> PosedView:
        """Returns the same without cached images: seven bytes a pixel."""
        return PosedView(replace(self.view), self.T_cam_world)


@dataclass(frozen=True, eq=False)
class PosedFrame:
    """A tracked frame in the forms that mapping needs, each made when it is asked for.

    Attributes:
        observation: the images.
        T_cam_world: [4, 4] float64.
        config: says at which size views are fitted.
    """

    observation: Observation
    T_cam_world: NDArray[np.float64]
    config: MappingConfig

    @cached_property
    def host(self) -> PosedView:
        """Full size, in the host's memory: the overlap with keyframes is measured on it."""
        return PosedView.at(self.observation.host, self.T_cam_world)

    @cached_property
    def device(self) -> PosedView:
        """Full size, on the device: Gaussians are added from it."""
        return PosedView.at(self.observation.device, self.T_cam_world)

    @cached_property
    def keyframe(self) -> PosedView:
        """At the size at which views are fitted, in the host's memory: what is kept."""
        return PosedView.at(self.observation.host.narrowed(self.config.scale, self.config.max_width), self.T_cam_world)

    @cached_property
    def to_fit(self) -> PosedView:
        """The same on the device."""
        if self.keyframe.view is self.observation.host:
            return self.device
        return self.keyframe.to(self.observation.device.depth.device)
