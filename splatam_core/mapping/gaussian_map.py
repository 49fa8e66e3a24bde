"""The map: the Gaussians, and the Adam optimizer that refines them by autograd."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatam_core.device import HOST
from splatam_core.rasterizer import Gaussians, Moments, Rates
from splatam_core.rasterizer.base import BETA_1, BETA_2, EPSILON, check_isotropic
from splatam_core.rasterizer.bounds import BLOCK, block_bounds
from splatam_core.types import MapSnapshot

_log = logging.getLogger(__name__)

PARAMETERS = ('means', 'log_scales', 'logit_opacities', 'rgb')
ROTATIONS = 'rotations'  # one more parameter of anisotropic maps
ADDED_BY = 'added_by'
BOUNDS = 'bounds'
_NUM_MOMENTS = 8  # of each order, see ``Moments``


class GaussianMap:
    """Gaussians in world coordinates, all isotropic or all anisotropic, on one device.

    Only ``append``, ``extend``, ``keep`` and ``restore`` change how many there are; ``keep`` keeps the optimizer's moments in
    step. Tensors have spare capacity, so that a growing map is not copied each time.

    Attributes:
        means: [N, 3] metres.
        log_scales: [N, 1] log metres; [N, 3] when anisotropic.
        logit_opacities: [N].
        rgb: [N, 3], nominally in [0, 1].
        rotations: [N, 4] see ``Gaussians``; None when isotropic.
        added_by: [N] number of the frame that added each Gaussian, its anchor; 0 for those of a map that was loaded.
        num_refused: number of Gaussians that were not added or were dropped because a value was not finite.
        frame: number of the frame that Gaussians are added by from now on.
    """

    means: Tensor
    log_scales: Tensor
    logit_opacities: Tensor
    rgb: Tensor
    rotations: Tensor | None
    added_by: Tensor

    def __init__(self, anisotropic: bool = False, device: torch.device = HOST) -> None:
        self._size = self.num_refused = self.frame = 0
        self._names = (*PARAMETERS, ROTATIONS) if anisotropic else PARAMETERS
        self._storage = {
            'means': torch.empty(0, 3), 'log_scales': torch.empty(0, 3 if anisotropic else 1),
            'logit_opacities': torch.empty(0), 'rgb': torch.empty(0, 3),
            'first_second': torch.empty(0, 16), 'steps': torch.empty(0, dtype=torch.uint8),
            ADDED_BY: torch.empty(0, dtype=torch.int32),
        }  # fmt: skip
        if anisotropic:
            self._storage[ROTATIONS] = torch.empty(0, 4)
        self._storage = {name: values.to(device) for name, values in self._storage.items()}
        self.rotations = None
        self._bounds = torch.empty(0, 7, device=device)
        self._optimizer: torch.optim.Adam | None = None
        self._refresh_views()

    def __len__(self) -> int:
        return self._size

    @property
    def is_anisotropic(self) -> bool:
        """Whether its Gaussians have three radii and a rotation."""
        return ROTATIONS in self._storage

    @property
    def gaussians(self) -> Gaussians:
        """The parameters themselves, not a copy; they carry gradients during an optimization."""
        bounds = self._bounds if self._optimizer is None else None
        values = self.means, self.log_scales, self.logit_opacities, self.rgb
        return Gaussians(*values, bounds=bounds, rotations=self.rotations, anchors=self.added_by)

    @property
    def moments(self) -> Moments:
        """Adam moments of the fused optimizer (``Rasterizer.fit``); they live as long as their Gaussians."""
        return Moments(self._storage['first_second'][: self._size], self._storage['steps'][: self._size])

    def append(self, new: Gaussians) -> Tensor:
        """Adds Gaussians, but none that is not ``usable``. Ends an optimization in progress. They keep their anchors.

        Returns:
            [K] which of the new Gaussians were added.

        Raises:
            RasterizerError: the new Gaussians are anisotropic and the map is not.
        """
        new = self._of_its_kind(new)
        added = new.usable()
        if not added.all():
            self.refuse(len(new) - int(added.sum()))
            new = new.chosen(added)
        self.stop_optimization()
        old_size, self._size = self._size, self._size + len(new)
        self._reserve()
        for name in ('first_second', 'steps'):
            self._storage[name][old_size : self._size] = 0
        self._storage[ADDED_BY][old_size : self._size] = self.frame if new.anchors is None else new.anchors
        self._refresh_views()
        self._put(new, old_size)
        return added

    def replace_last(self, new: Gaussians) -> None:
        """Replaces the Gaussians that were added last by as many others. Nothing may have moved since then.

        One that is not ``usable`` replaces none.

        Raises:
            RasterizerError: the new Gaussians are anisotropic and the map is not.
        """
        assert self._optimizer is None
        new, begin = self._of_its_kind(new), self._size - len(new)
        usable = new.usable()
        if not usable.all():
            for name in self._names:
                values = getattr(new, name)
                values[~usable] = self._storage[name][begin : self._size][~usable]
        self._put(new, begin)

    def _put(self, new: Gaussians, begin: int) -> None:
        for name in self._names:
            self._storage[name][begin : self._size] = getattr(new, name)
        self._update_bounds(begin // BLOCK)

    def refuse(self, count: int) -> None:
        """Counts Gaussians that are not finite, and says so: each time their number has doubled."""
        before, self.num_refused = self.num_refused, self.num_refused + count
        if self.num_refused.bit_length() > before.bit_length():
            _log.warning(
                '%d Gaussians were not finite and are left out of the map: do depth and calibration fit the camera?',
                self.num_refused,
            )

    def keep(self, kept: Tensor) -> None:
        """Drops all Gaussians but those where ``kept`` [N] is true; these keep their gradients and moments."""
        old = {name: getattr(self, name) for name in self._names}
        kept = torch.nonzero(kept)[:, 0]
        size, self._size = self._size, len(kept)
        for values in self._storage.values():
            values[: self._size] = values[:size].index_select(0, kept)
        self._refresh_views()
        self._update_bounds(0)
        if self._optimizer is not None:
            for name in self._names:
                new = getattr(self, name).requires_grad_()
                new.grad = None if old[name].grad is None else old[name].grad.index_select(0, kept)
                _replace_parameter(self._optimizer, old[name], new, kept)

    def move(self, motion_of: Callable[[NDArray[np.int64]], NDArray[np.float64]]) -> int:
        """Moves each Gaussian with the frame that added it. The moments of its mean turn with it, and all of them stay.

        Without them the fit would begin anew, with long steps, which costs a decibel after a correction.

        Args:
            motion_of: returns the motions [K, 4, 4] in the world of frames [K].

        Returns:
            The number of Gaussians that moved.
        """
        assert self._optimizer is None
        anchors = self.added_by.long()
        frames = torch.nonzero(torch.bincount(anchors))[:, 0]
        if not len(frames):
            return 0
        motions = torch.from_numpy(motion_of(frames.numpy(force=True)).astype(np.float32)).to(anchors.device)
        row = anchors.new_zeros(int(frames[-1]) + 1)
        row[frames] = torch.arange(len(frames), device=row.device)
        moves = (motions != torch.eye(4, device=row.device)).any(dim=2).any(dim=1)
        moved = torch.nonzero(moves[row[anchors]])[:, 0]
        motion = motions[row[anchors[moved]]]
        self.means[moved] = _applied(motion[:, :3, :3], self.means[moved]) + motion[:, :3, 3]
        if self.rotations is not None:
            self.rotations[moved] = _turned(motion[:, :3, :3], self.rotations[moved])
        first_second, turn = self.moments.first_second, motion[:, :3, :3]
        for begin, by in ((0, turn), (_NUM_MOMENTS, turn.square())):  # squares: as if the axes were independent
            axes = slice(begin, begin + 3)
            first_second[moved, axes] = _applied(by, first_second[moved, axes])
        self._update_bounds(0)
        return len(moved)

    def start_optimization(self, rates: Rates) -> None:
        """Begins an optimization with fresh moments, as the paper does for every frame."""
        self._refresh_views()
        groups = [{'params': [getattr(self, name).requires_grad_()], 'lr': getattr(rates, name)} for name in self._names]
        self._optimizer = torch.optim.Adam(groups, betas=(BETA_1, BETA_2), eps=EPSILON, fused=True)

    def set_rates(self, rates: Rates) -> None:
        """Changes the step sizes of the optimization in progress."""
        assert self._optimizer is not None
        for group, name in zip(self._optimizer.param_groups, self._names):
            group['lr'] = getattr(rates, name)

    def step(self) -> None:
        """Takes one optimizer step along the gradients, and clears them."""
        assert self._optimizer is not None
        self._optimizer.step()
        self._optimizer.zero_grad(set_to_none=True)

    def extend(self, new: Gaussians) -> None:
        """Adds Gaussians during an optimization. The others keep their moments and lose their gradients.

        Raises:
            RasterizerError: the new Gaussians are anisotropic and the map is not.
        """
        assert self._optimizer is not None
        rates = Rates(**{name: group['lr'] for name, group in zip(self._names, self._optimizer.param_groups)})
        states = {name: self._optimizer.state.get(getattr(self, name)) for name in self._names}
        added = int(self.append(new).sum())
        self.start_optimization(rates)
        for name, state in states.items():
            if state:
                self._optimizer.state[getattr(self, name)] = {key: _padded(value, added) for key, value in state.items()}

    def set_opacities(self, opacity: float) -> None:
        """Sets every opacity to one value in (0, 1); clears the gradients and moments of the opacity logits."""
        logits = self.logit_opacities
        with torch.no_grad():
            logits.fill_(math.log(opacity / (1 - opacity)))
        logits.grad = None
        if self._optimizer is not None and (state := self._optimizer.state.get(logits)):
            for name in ('exp_avg', 'exp_avg_sq'):
                state[name].zero_()

    def stop_optimization(self) -> None:
        """Ends the optimization: detaches the parameters from autograd."""
        if self._optimizer is not None:
            self._optimizer = None
            self._refresh_views()
            self._update_bounds(0)

    def snapshot(self) -> MapSnapshot:
        """Returns a copy; later changes of the map do not affect it."""
        with torch.no_grad():
            return MapSnapshot(
                _host_copy(self.means),
                _host_copy(self.rgb),
                torch.sigmoid(self.logit_opacities).numpy(force=True),
                _host_copy(self.log_scales),
                None if self.rotations is None else _host_copy(self.rotations),
            )

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Returns a copy of everything the map holds between two optimizations, by name; ``restore`` takes it on any device."""
        assert self._optimizer is None
        arrays = {name: _host_copy(values[: self._size]) for name, values in self._storage.items()}
        return arrays | {BOUNDS: _host_copy(self._bounds)}

    def restore(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Replaces the content by that of another map.

        Raises:
            ValueError: the arrays do not fit this kind of map.
        """
        size = len(arrays['means']) if 'means' in arrays else 0
        arrays = {ADDED_BY: np.zeros(size, np.int32), **arrays}  # 0.1.0 did not record it
        capacity = {name: values.new_empty(size, *values.shape[1:]) for name, values in self._storage.items()}
        bounds = self._bounds.new_empty(-(-size // BLOCK), *self._bounds.shape[1:])
        expected = capacity | {BOUNDS: bounds}
        found = {name: (array.dtype.name, array.shape) for name, array in sorted(arrays.items())}
        wanted = {name: (str(v.dtype).removeprefix('torch.'), tuple(v.shape)) for name, v in sorted(expected.items())}
        if found != wanted:
            raise ValueError(f'the map is {found}; expected {wanted}')
        if broken := [name for name in sorted(expected) if not np.isfinite(arrays[name]).all()]:
            raise ValueError(f'the map holds numbers in {", ".join(broken)} that are not finite')
        for name, values in expected.items():
            values.copy_(torch.from_numpy(arrays[name]))
        self._size, self._storage, self._bounds, self._optimizer = size, capacity, bounds, None
        self._refresh_views()

    def _of_its_kind(self, new: Gaussians) -> Gaussians:
        if self.is_anisotropic:
            return new.anisotropic()
        check_isotropic(new)
        return new

    def _refresh_views(self) -> None:
        """Makes parameters and anchors views of the used part of the capacity, without gradients."""
        for name in (*self._names, ADDED_BY):
            setattr(self, name, self._storage[name][: self._size])

    def _reserve(self) -> None:
        if self._size <= len(self._storage['means']):
            return
        capacity = self._size + self._size // 4
        for name, old in self._storage.items():
            new = old.new_empty(capacity, *old.shape[1:])
            new[: len(old)] = old
            self._storage[name] = new

    def _update_bounds(self, first_block: int) -> None:
        """Recomputes the bounds of all blocks from ``first_block`` on."""
        begin = first_block * BLOCK
        if self._size <= begin:
            self._bounds = self._bounds[:first_block]
            return
        means, log_scales = self.means[begin:].detach(), self.log_scales[begin:].detach()
        self._bounds = torch.cat([self._bounds[:first_block], block_bounds(means, log_scales)])


def _host_copy(values: Tensor) -> NDArray[Any]:
    return values.detach().to('cpu', copy=True).numpy()


def _applied(matrices: Tensor, vectors: Tensor) -> Tensor:
    """Returns [K, 3] vectors multiplied by matrices [K, 3, 3]; several times as fast as a product of small matrices."""
    x, y, z = vectors.unbind(dim=1)
    columns = matrices.unbind(dim=2)
    return columns[0] * x[:, None] + columns[1] * y[:, None] + columns[2] * z[:, None]


def _turned(turns: Tensor, quaternions: Tensor) -> Tensor:
    """Returns [K, 4] quaternions after turns [K, 3, 3] of less than half a circle."""
    w = 0.5 * (1 + turns.diagonal(dim1=1, dim2=2).sum(dim=1)).clamp(min=1e-6).sqrt()
    skew = turns - turns.mT
    x, y, z = (torch.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]]) / (4 * w)).unbind()
    a, b, c, d = quaternions.unbind(dim=1)
    return torch.stack(
        [
            w * a - x * b - y * c - z * d,
            w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
        ],
        dim=1,
    )


def _padded(value: Tensor, count: int) -> Tensor:
    """Returns moments extended by zeros for new Gaussians; a step count is returned as it is."""
    return torch.cat([value, value.new_zeros(count, *value.shape[1:])]) if value.ndim else value


def _replace_parameter(optimizer: torch.optim.Adam, old: Tensor, new: Tensor, kept: Tensor) -> None:
    group = next(group for group in optimizer.param_groups if group['params'][0] is old)
    group['params'][0] = new
    state = optimizer.state.pop(old, None)
    if state:
        moments = {name: state[name].index_select(0, kept) for name in ('exp_avg', 'exp_avg_sq')}
        optimizer.state[new] = {**state, **moments}
