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
from splatam_core.rasterizer import Render
from splatam_core.rasterizer.base import NOT_COMPARED


@dataclass(frozen=True, slots=True, eq=False)
class PosedView:
    """A view and where it was taken from.

    Attributes:
        view: the images.
        T_cam_world: [4, 4] float32.
        frame: number of the frame that it is of; -1 where that is not known.
    """

    view: View
    T_cam_world: Tensor
    frame: int = -1

    @classmethod
    def at(cls, view: View, T_cam_world: NDArray[np.float64], frame: int = -1) -> PosedView:
        """Returns a view at a pose [4, 4] float64, on the view's device."""
        return cls(view, pose_tensor(T_cam_world, view.depth.device), frame)

    def to(self, device: torch.device) -> PosedView:
        """Returns the same on a device; itself where it is there already."""
        if self.view.depth.device == device:
            return self
        return PosedView(self.view.to(device), self.T_cam_world.to(device, non_blocking=True), self.frame)

    def half_size(self) -> PosedView:
        """Returns the same at half the size."""
        return PosedView(self.view.scaled(0.5), self.T_cam_world, self.frame)

    def comparable(self) -> PosedView:
        """Returns the same, in which nothing is compared far from every reading; itself where that is so already."""
        view = self.view
        depth = torch.where(view.near_readings(), view.depth, NOT_COMPARED)
        return self if torch.equal(depth, view.depth) else replace(self, view=replace(view, depth=depth))

    def bare(self) -> PosedView:
        """Returns the same without cached images: seven bytes a pixel."""
        return PosedView(self.view.bare(), self.T_cam_world, self.frame)


@dataclass(frozen=True, slots=True, eq=False)
class Before:
    """A frame and the map as it found it, at the size at which Gaussians are added.

    Attributes:
        view: the frame.
        render: the map, from there.
    """

    view: View
    render: Render


@dataclass(frozen=True, eq=False)
class PosedFrame:
    """A tracked frame in the forms that mapping needs, each made when it is asked for.

    Attributes:
        observation: the images.
        T_cam_world: [4, 4] float64.
        config: says at which size views are fitted.
        index: number of the frame.
        before: the map as the frame found it; None where it was not rendered.
    """

    observation: Observation
    T_cam_world: NDArray[np.float64]
    config: MappingConfig
    index: int = -1
    before: Before | None = None

    @cached_property
    def host(self) -> PosedView:
        """Full size, in the host's memory: the overlap with keyframes is measured on it."""
        return PosedView.at(self.observation.host, self.T_cam_world, self.index)

    @cached_property
    def device(self) -> PosedView:
        """Full size, on the device: Gaussians are added from it."""
        return PosedView.at(self.observation.device, self.T_cam_world, self.index)

    @cached_property
    def keyframe(self) -> PosedView:
        """At the size at which views are fitted, and with what the optimizer compares, in the host's memory: what is kept."""
        view = self.observation.host.narrowed(self.config.scale, self.config.max_width)
        posed = PosedView.at(view, self.T_cam_world, self.index)
        return posed.comparable() if self.config.optimizer == 'fused' else posed

    @cached_property
    def to_fit(self) -> PosedView:
        """The same on the device."""
        if self.keyframe.view is self.observation.host:
            return self.device
        return self.keyframe.to(self.observation.device.depth.device)
