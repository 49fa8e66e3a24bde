"""The map: what its Gaussians are, and the optimiser that refines them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from splatam_core.rasterizer import Gaussians
from splatam_core.types import MapSnapshot

PARAMETERS = ('means', 'log_scales', 'logit_opacities', 'rgb')


class GaussianMap:
    """Isotropic Gaussians in world coordinates.

    Only ``append`` and ``keep`` change how many there are; ``keep`` takes the optimiser's moments along.

    Attributes:
        means: [N, 3] metres.
        log_scales: [N, 1] log metres.
        logit_opacities: [N].
        rgb: [N, 3], nominally in [0, 1].
    """

    def __init__(self) -> None:
        self.means = torch.empty(0, 3)
        self.log_scales = torch.empty(0, 1)
        self.logit_opacities = torch.empty(0)
        self.rgb = torch.empty(0, 3)
        self._optimizer: torch.optim.Adam | None = None

    @classmethod
    def from_arrays(
        cls, means: ArrayLike, log_scales: ArrayLike, logit_opacities: ArrayLike, rgb: ArrayLike
    ) -> GaussianMap:
        """A map of given Gaussians, shapes as in the class."""
        result = cls()
        arrays = (np.array(values, dtype=np.float32) for values in (means, log_scales, logit_opacities, rgb))
        result.append(Gaussians(*map(torch.from_numpy, arrays)))
        return result

    def __len__(self) -> int:
        return len(self.means)

    @property
    def gaussians(self) -> Gaussians:
        """The parameters themselves, as a rasterizer takes them; they carry gradients while being optimised."""
        return Gaussians(self.means, self.log_scales, self.logit_opacities, self.rgb)

    def append(self, new: Gaussians) -> None:
        """Add Gaussians. Ends an optimisation that was under way."""
        self.stop_optimization()
        for name in PARAMETERS:
            setattr(self, name, torch.cat([getattr(self, name), getattr(new, name)]))

    def keep(self, kept: Tensor) -> None:
        """Drop all Gaussians but those where ``kept`` [N] is true; gradients and moments of the others stay."""
        for name in PARAMETERS:
            old = getattr(self, name)
            new = old.detach()[kept].requires_grad_(old.requires_grad)
            new.grad = None if old.grad is None else old.grad[kept]
            setattr(self, name, new)
            if self._optimizer is not None:
                _replace_parameter(self._optimizer, old, new, kept)

    def start_optimization(self, rates: Mapping[str, float]) -> None:
        """Begin with fresh moments, as the paper does for every frame.

        Args:
            rates: Adam's step size by parameter name.
        """
        for name in PARAMETERS:
            setattr(self, name, getattr(self, name).detach().requires_grad_())
        groups = [{'params': [getattr(self, name)], 'lr': rates[name]} for name in PARAMETERS]
        self._optimizer = torch.optim.Adam(groups, eps=1e-15, fused=True)

    def step(self) -> None:
        """Move along the gradients collected since the last step."""
        assert self._optimizer is not None
        self._optimizer.step()
        self._optimizer.zero_grad(set_to_none=True)

    def stop_optimization(self) -> None:
        """Cut the parameters off from autograd."""
        self._optimizer = None
        for name in PARAMETERS:
            setattr(self, name, getattr(self, name).detach())

    def snapshot(self) -> MapSnapshot:
        """A copy that later changes of the map leave alone."""
        with torch.no_grad():
            return MapSnapshot(
                self.means.numpy(force=True).copy(),
                self.rgb.numpy(force=True).copy(),
                torch.sigmoid(self.logit_opacities).numpy(force=True),
                self.log_scales.numpy(force=True).copy(),
            )


def _replace_parameter(optimizer: torch.optim.Adam, old: Tensor, new: Tensor, kept: Tensor) -> None:
    group = next(group for group in optimizer.param_groups if group['params'][0] is old)
    group['params'][0] = new
    state = optimizer.state.pop(old, None)
    if state:
        moments = {name: state[name][kept] for name in ('exp_avg', 'exp_avg_sq')}
        optimizer.state[new] = {**state, **moments}
