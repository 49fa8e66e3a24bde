"""The map: what its Gaussians are, and the optimiser that refines them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from splatam_core.device import HOST
from splatam_core.rasterizer import Gaussians, Moments, Rates
from splatam_core.rasterizer.base import BETA_1, BETA_2, EPSILON, check_isotropic
from splatam_core.rasterizer.bounds import BLOCK, block_bounds
from splatam_core.types import MapSnapshot

PARAMETERS = ('means', 'log_scales', 'logit_opacities', 'rgb')
ROTATIONS = 'rotations'  # one more parameter of anisotropic maps
BOUNDS = 'bounds'


class GaussianMap:
    """Gaussians in world coordinates, all isotropic or all anisotropic, on one device.

    Only ``append`` and ``keep`` change how many there are; ``keep`` takes the optimiser's moments along. There is room for
    more than there are, so that a growing map is not copied each time.

    Attributes:
        means: [N, 3] metres.
        log_scales: [N, 1] log metres; [N, 3] when anisotropic.
        logit_opacities: [N].
        rgb: [N, 3], nominally in [0, 1].
        rotations: [N, 4] as ``Gaussians`` has them; None when isotropic.
    """

    means: Tensor
    log_scales: Tensor
    logit_opacities: Tensor
    rgb: Tensor
    rotations: Tensor | None

    def __init__(self, anisotropic: bool = False, device: torch.device = HOST) -> None:
        self._size = 0
        self._names = (*PARAMETERS, ROTATIONS) if anisotropic else PARAMETERS
        self._room = {
            'means': torch.empty(0, 3), 'log_scales': torch.empty(0, 3 if anisotropic else 1),
            'logit_opacities': torch.empty(0), 'rgb': torch.empty(0, 3),
            'first_second': torch.empty(0, 16), 'steps': torch.empty(0, dtype=torch.uint8),
        }  # fmt: skip
        if anisotropic:
            self._room[ROTATIONS] = torch.empty(0, 4)
        self._room = {name: values.to(device) for name, values in self._room.items()}
        self.rotations = None
        self._bounds = torch.empty(0, 7, device=device)
        self._optimizer: torch.optim.Adam | None = None
        self._show()

    def __len__(self) -> int:
        return self._size

    @property
    def is_anisotropic(self) -> bool:
        """Whether its Gaussians have three radii and a rotation."""
        return ROTATIONS in self._room

    @property
    def gaussians(self) -> Gaussians:
        """The parameters themselves, as a rasterizer takes them; they carry gradients while being optimised."""
        bounds = self._bounds if self._optimizer is None else None
        return Gaussians(self.means, self.log_scales, self.logit_opacities, self.rgb, bounds, self.rotations)

    @property
    def moments(self) -> Moments:
        """Of the steps that a rasterizer takes itself (``Rasterizer.fit``); they live as long as their Gaussians."""
        return Moments(self._room['first_second'][: self._size], self._room['steps'][: self._size])

    def append(self, new: Gaussians) -> None:
        """Add Gaussians. Ends an optimisation that was under way.

        Raises:
            RasterizerError: anisotropic ones, to an isotropic map.
        """
        new = self._of_its_kind(new)
        self.stop_optimization()
        old_size, self._size = self._size, self._size + len(new)
        self._make_room()
        for name in ('first_second', 'steps'):
            self._room[name][old_size : self._size] = 0
        self._show()
        self.replace_last(new)

    def replace_last(self, new: Gaussians) -> None:
        """Put others in the place of as many that were added last; what has been moved since is not for this.

        Raises:
            RasterizerError: anisotropic ones, to an isotropic map.
        """
        assert self._optimizer is None
        new, begin = self._of_its_kind(new), self._size - len(new)
        for name in self._names:
            self._room[name][begin : self._size] = getattr(new, name)
        self._measure(begin // BLOCK)

    def keep(self, kept: Tensor) -> None:
        """Drop all Gaussians but those where ``kept`` [N] is true; gradients and moments of the others stay."""
        old = {name: getattr(self, name) for name in self._names}
        kept = torch.nonzero(kept)[:, 0]
        size, self._size = self._size, len(kept)
        for values in self._room.values():
            values[: self._size] = values[:size].index_select(0, kept)
        self._show()
        self._measure(0)
        if self._optimizer is not None:
            for name in self._names:
                new = getattr(self, name).requires_grad_()
                new.grad = None if old[name].grad is None else old[name].grad.index_select(0, kept)
                _replace_parameter(self._optimizer, old[name], new, kept)

    def start_optimization(self, rates: Rates) -> None:
        """Begin with fresh moments, as the paper does for every frame."""
        self._show()
        groups = [{'params': [getattr(self, name).requires_grad_()], 'lr': getattr(rates, name)} for name in self._names]
        self._optimizer = torch.optim.Adam(groups, betas=(BETA_1, BETA_2), eps=EPSILON, fused=True)

    def set_rates(self, rates: Rates) -> None:
        """Go on with other step sizes."""
        assert self._optimizer is not None
        for group, name in zip(self._optimizer.param_groups, self._names):
            group['lr'] = getattr(rates, name)

    def step(self) -> None:
        """Move along the gradients collected since the last step."""
        assert self._optimizer is not None
        self._optimizer.step()
        self._optimizer.zero_grad(set_to_none=True)

    def extend(self, new: Gaussians) -> None:
        """Add Gaussians to an optimisation under way; moments of the others stay, gradients go.

        Raises:
            RasterizerError: anisotropic ones, to an isotropic map.
        """
        assert self._optimizer is not None
        rates = Rates(**{name: group['lr'] for name, group in zip(self._names, self._optimizer.param_groups)})
        states = {name: self._optimizer.state.get(getattr(self, name)) for name in self._names}
        self.append(new)
        self.start_optimization(rates)
        for name, state in states.items():
            if state:
                self._optimizer.state[getattr(self, name)] = {key: _padded(value, len(new)) for key, value in state.items()}

    def set_opacities(self, opacity: float) -> None:
        """Give all the same opacity, in (0, 1); what their logits' gradients and moments have collected is forgotten."""
        logits = self.logit_opacities
        with torch.no_grad():
            logits.fill_(math.log(opacity / (1 - opacity)))
        logits.grad = None
        if self._optimizer is not None and (state := self._optimizer.state.get(logits)):
            for name in ('exp_avg', 'exp_avg_sq'):
                state[name].zero_()

    def stop_optimization(self) -> None:
        """Cut the parameters off from autograd."""
        if self._optimizer is not None:
            self._optimizer = None
            self._show()
            self._measure(0)

    def snapshot(self) -> MapSnapshot:
        """A copy that later changes of the map leave alone."""
        with torch.no_grad():
            return MapSnapshot(
                _host_copy(self.means),
                _host_copy(self.rgb),
                torch.sigmoid(self.logit_opacities).numpy(force=True),
                _host_copy(self.log_scales),
                None if self.rotations is None else _host_copy(self.rotations),
            )

    def arrays(self) -> dict[str, NDArray[Any]]:
        """A copy of all it holds between two optimisations, by name; ``restore`` takes it back, on whichever device."""
        assert self._optimizer is None
        arrays = {name: _host_copy(values[: self._size]) for name, values in self._room.items()}
        return arrays | {BOUNDS: _host_copy(self._bounds)}

    def restore(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Hold what another map held, instead of what is here.

        Raises:
            ValueError: the arrays are not those of a map of this kind.
        """
        size = len(arrays['means']) if 'means' in arrays else 0
        room = {name: values.new_empty(size, *values.shape[1:]) for name, values in self._room.items()}
        bounds = self._bounds.new_empty(-(-size // BLOCK), *self._bounds.shape[1:])
        expected = room | {BOUNDS: bounds}
        found = {name: (array.dtype.name, array.shape) for name, array in sorted(arrays.items())}
        wanted = {name: (str(v.dtype).removeprefix('torch.'), tuple(v.shape)) for name, v in sorted(expected.items())}
        if found != wanted:
            raise ValueError(f'the map is {found}; expected {wanted}')
        for name, values in expected.items():
            values.copy_(torch.from_numpy(arrays[name]))
        self._size, self._room, self._bounds, self._optimizer = size, room, bounds, None
        self._show()

    def _of_its_kind(self, new: Gaussians) -> Gaussians:
        if self.is_anisotropic:
            return new.anisotropic()
        check_isotropic(new)
        return new

    def _show(self) -> None:
        """Let the parameters be the used part of the room, without gradients."""
        for name in self._names:
            setattr(self, name, self._room[name][: self._size])

    def _make_room(self) -> None:
        if self._size <= len(self._room['means']):
            return
        room = self._size + self._size // 2
        for name, old in self._room.items():
            new = old.new_empty(room, *old.shape[1:])
            new[: len(old)] = old
            self._room[name] = new

    def _measure(self, first_block: int) -> None:
        """Find the bounds of the blocks from one on."""
        begin = first_block * BLOCK
        if self._size <= begin:
            self._bounds = self._bounds[:first_block]
            return
        means, log_scales = self.means[begin:].detach(), self.log_scales[begin:].detach()
        self._bounds = torch.cat([self._bounds[:first_block], block_bounds(means, log_scales)])


def _host_copy(values: Tensor) -> NDArray[Any]:
    return values.detach().to('cpu', copy=True).numpy()


def _padded(value: Tensor, count: int) -> Tensor:
    """Moments with zeros for so many new Gaussians; what is none, a count of steps, as it is."""
    return torch.cat([value, value.new_zeros(count, *value.shape[1:])]) if value.ndim else value


def _replace_parameter(optimizer: torch.optim.Adam, old: Tensor, new: Tensor, kept: Tensor) -> None:
    group = next(group for group in optimizer.param_groups if group['params'][0] is old)
    group['params'][0] = new
    state = optimizer.state.pop(old, None)
    if state:
        moments = {name: state[name].index_select(0, kept) for name in ('exp_avg', 'exp_avg_sq')}
        optimizer.state[new] = {**state, **moments}
