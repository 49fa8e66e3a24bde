"""Keyframes: which are kept, and which are mapped together with the current view (paper, section 3.4)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatam_core.config import KeyframeConfig, SlamConfig
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.mapping.ghosts import without
from splatam_core.mapping.posed import PosedFrame, PosedView

_TRIES = 2  # pixels drawn for each one with a reading
_BATCH = 64  # keyframes whose overlap is computed at once; more would not fit a core's cache


class KeyframeStore(Sequence[PosedView]):
    """All keyframes, in the host's memory, with copies of the recently used ones on the device.

    Attributes:
        config: the largest number of keyframes, and of copies on the device.
    """

    def __init__(self, device: torch.device, config: KeyframeConfig) -> None:
        self.config = config
        self._device = device
        self._kept: list[PosedView] = []
        self._copies: dict[PosedView, PosedView] = {}  # ordered by last use

    def __len__(self) -> int:
        return len(self._kept)

    def __getitem__(self, index: Any) -> Any:
        """Returns keyframes in the host's memory."""
        return self._kept[index]

    def __iter__(self) -> Iterator[PosedView]:
        """Yields the keyframes in the host's memory, in a tenth of the time that ``Sequence`` takes."""
        return iter(self._kept)

    def append(self, keyframe: PosedView, copy: PosedView | None = None) -> None:
        """Keeps one more keyframe; drops the least needed one beyond the budget.

        Args:
            keyframe: in the host's memory.
            copy: the same on the device, if it exists already.
        """
        self._kept.append(keyframe)
        while 0 < self.config.budget < len(self._kept):
            self._copies.pop(self._kept.pop(least_needed(self._kept)), None)
        if copy is not None and copy.view.depth.device != keyframe.view.depth.device:
            self._remember(keyframe, copy)

    def drop_from(self, frame: int) -> None:
        """Drops the keyframes of the frames from a number on."""
        for keyframe in [keyframe for keyframe in self._kept if keyframe.frame >= frame]:
            self._kept.remove(keyframe)
            self._copies.pop(keyframe, None)

    def forget(self, means: Tensor) -> None:
        """No longer compares what keyframes show of Gaussians that have gone, at means [K, 3]."""
        means = means.cpu()
        for index, old in enumerate(self._kept):
            new = without(old, means)
            if new is not old:
                self._kept[index] = new
                self._copies.pop(old, None)

    def place(self, T_cam_world: Sequence[Tensor]) -> None:
        """Moves all keyframes to other poses [4, 4] float32, one each."""
        moved = {old: replace(old, T_cam_world=T) for old, T in zip(self._kept, T_cam_world, strict=True)}
        self._copies = {
            moved[old]: replace(copy, T_cam_world=moved[old].T_cam_world.to(self._device)) for old, copy in self._copies.items()
        }
        self._kept = list(moved.values())

    def on_device(self, keyframe: PosedView) -> PosedView:
        """Returns a keyframe on the device; copies it there if necessary."""
        if keyframe.view.depth.device == self._device:
            return keyframe.bare()
        copy = self._copies.pop(keyframe, None) or keyframe.to(self._device)
        self._remember(keyframe, copy)
        return copy

    def window(self, views: Sequence[PosedView], current: PosedFrame | None = None) -> Window:
        """Returns views as a window, each of which is copied to the device when it is used; the current frame is the last."""
        return Window(views, self, current)

    def _remember(self, keyframe: PosedView, copy: PosedView) -> None:
        self._copies[keyframe] = copy
        while len(self._copies) > self.config.on_device:
            del self._copies[next(iter(self._copies))]


def least_needed(keyframes: Sequence[PosedView]) -> int:
    """Returns the keyframe to drop: the one whose neighbours in time are nearest to each other; never the first or the last.

    The distance adds metres and radians: both move a point at one metre equally far in the image.
    """
    if len(keyframes) < 3:
        return 0
    T = torch.stack([keyframe.T_cam_world for keyframe in keyframes])
    R, t = T[:, :3, :3], T[:, :3, 3:]
    centres = -(R.mT @ t).squeeze(2)
    between = torch.linalg.norm(centres[2:] - centres[:-2], dim=1)
    turned = torch.linalg.matrix_norm(R[2:] - R[:-2]) / math.sqrt(2)  # 2 sin(angle / 2)
    return 1 + int(torch.argmin(between + turned))


class Window(Sequence[PosedView]):
    """Views that are mapped together; the current one is the last. Each is made, and copied to the device, when it is used."""

    def __init__(self, views: Sequence[PosedView], store: KeyframeStore, current: PosedFrame | None = None) -> None:
        self._views, self._store, self._current = views, store, current

    def __len__(self) -> int:
        return len(self._views) + (self._current is not None)

    def __getitem__(self, index: Any) -> Any:
        """Returns one view, on the device."""
        index = range(len(self))[index]
        if index == len(self._views):
            assert self._current is not None
            return self._store.on_device(self._current.to_fit)
        return self._store.on_device(self._views[index])


def select_keyframes(
    current: PosedView, keyframes: Sequence[PosedView], config: KeyframeConfig, rng: np.random.Generator
) -> list[PosedView]:
    """Returns the keyframes to map with the current view: some by the configured selection, and the last. All in host memory.

    The default draws at random among those that overlap. The best overlaps are nearly the current view, and fitting only
    these would make the map forget the rest.
    """
    if not keyframes or config.window == 1:
        return []
    *earlier, last = keyframes
    count = max(0, config.window - 2)
    chosen = _SELECTIONS[config.selection](current, earlier, count, config, rng)
    return [*(earlier[i] for i in chosen), last]


def _overlapping(
    current: PosedView, keyframes: Sequence[PosedView], count: int, config: KeyframeConfig, rng: np.random.Generator
) -> list[int]:
    overlapping = np.flatnonzero(_seen(current, keyframes, config, rng))
    return list(overlapping[rng.permutation(len(overlapping))[:count]])


def _most_overlapping(
    current: PosedView, keyframes: Sequence[PosedView], count: int, config: KeyframeConfig, rng: np.random.Generator
) -> list[int]:
    seen = _seen(current, keyframes, config, rng)
    best = np.argsort(-seen, kind='stable')[:count]
    return list(best[seen[best] > 0])


def _random(
    current: PosedView, keyframes: Sequence[PosedView], count: int, config: KeyframeConfig, rng: np.random.Generator
) -> list[int]:
    return list(rng.permutation(len(keyframes))[:count])


def _latest(
    current: PosedView, keyframes: Sequence[PosedView], count: int, config: KeyframeConfig, rng: np.random.Generator
) -> list[int]:
    return list(range(max(0, len(keyframes) - count), len(keyframes)))


def _uniform(
    current: PosedView, keyframes: Sequence[PosedView], count: int, config: KeyframeConfig, rng: np.random.Generator
) -> list[int]:
    return list(np.unique(np.linspace(0, len(keyframes) - 1, min(count, len(keyframes))).round().astype(int)))


_SELECTIONS = {
    'overlap': _overlapping, 'most_overlap': _most_overlapping, 'random': _random, 'latest': _latest, 'uniform': _uniform,
}  # fmt: skip


def _seen(
    current: PosedView, keyframes: Sequence[PosedView], config: KeyframeConfig, rng: np.random.Generator
) -> NDArray[np.float64]:
    points = sample_points(current, config.overlap_samples, rng)
    return np.array(overlaps(points, current.view.camera, keyframes, config.overlap_margin))


def sample_points(posed: PosedView, count: int, rng: np.random.Generator) -> Tensor:
    """Returns [count, 3] world points of random pixels with a reading, drawn with replacement; [0, 3] without any."""
    depth = posed.view.depth
    readings = depth.numpy().reshape(-1)
    found = rng.integers(len(readings), size=_TRIES * count)
    z = readings[found]
    has_reading = np.flatnonzero(z > 0)[:count]
    found, z = found[has_reading], z[has_reading]
    if len(found) < count:  # there are too few readings to come upon them
        with_reading = np.flatnonzero(readings > 0)
        if len(with_reading) == 0:
            return depth.new_empty(0, 3)
        found = with_reading[rng.integers(len(with_reading), size=count)]
        z = readings[found]
    camera = posed.view.camera
    v, u = (pixels.astype(np.float32) for pixels in np.divmod(found, camera.width))
    points = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=1)
    return (torch.from_numpy(points) - posed.T_cam_world[:3, 3]) @ posed.T_cam_world[:3, :3]


def overlaps(points: Tensor, camera: PinholeCamera, keyframes: Sequence[PosedView], margin: int) -> list[float]:
    """Returns, for each keyframe, the fraction of world points [K, 3] that it sees at least ``margin`` pixels inside its image."""
    if not len(points) or not keyframes:
        return [0.0] * len(keyframes)
    T = torch.stack([keyframe.T_cam_world for keyframe in keyframes]).numpy()[:, :3]  # [N, 3, 4]
    shares = np.zeros(len(T))
    homogeneous = np.concatenate([points.numpy().T, np.ones((1, len(points)), np.float32)])  # [4, K]
    near = np.flatnonzero(_may_see(homogeneous, camera, T))  # on a long path only a few
    for first in range(0, len(near), _BATCH):
        chosen = near[first : first + _BATCH]
        x, y, z = (T[chosen].reshape(-1, 4) @ homogeneous).reshape(-1, 3, len(points)).swapaxes(0, 1)  # [N, K] each
        inside = z > 0
        inverse_z = 1 / np.where(inside, z, np.float32(1))
        for across, focal, centre, side in ((x, camera.fx, camera.cx, camera.width), (y, camera.fy, camera.cy, camera.height)):
            pixels = focal * across
            pixels *= inverse_z
            pixels += centre
            inside &= pixels > margin
            inside &= pixels < side - margin
        shares[chosen] = np.count_nonzero(inside, axis=1) / len(points)
    result: list[float] = shares.tolist()
    return result


def _may_see(points: NDArray[np.float32], camera: PinholeCamera, T_cam_world: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Returns [N] False where a sphere around points [4, K] is behind the camera at [N, 3, 4], or outside its image."""
    centre = points.mean(axis=1)
    radius = 1.001 * math.sqrt(np.square(points - centre[:, None]).sum(axis=0).max()) + 1e-3  # a margin for rounding
    x, y, z = (T_cam_world @ centre).T
    seen = z > -radius
    for across, focal, pixels in (
        (x, camera.fx, camera.cx), (-x, camera.fx, camera.width - camera.cx),
        (y, camera.fy, camera.cy), (-y, camera.fy, camera.height - camera.cy),
    ):  # fmt: skip
        seen &= focal * across + pixels * z > -radius * math.hypot(focal, pixels)
    return seen


def views_to_fit(
    window: Sequence[PosedView], steps: Iterable[int], config: SlamConfig, rng: np.random.Generator
) -> Iterator[PosedView]:
    """Yields the view of each optimization step: drawn at random from the window, at half size where the rhythm says so.

    Args:
        window: the views.
        steps: numbers of the steps, counted over all frames.
        config: every setting.
        rng: draws them.
    """
    half_size_every = config.mapping.half_size_every
    for step in steps:
        posed = draw(window, config.keyframes, rng)
        yield posed.half_size() if half_size_every and step % half_size_every == half_size_every - 1 else posed


def draw(window: Sequence[PosedView], config: KeyframeConfig, rng: np.random.Generator) -> PosedView:
    """Returns a random view of a window; ``current_share`` of the draws give the current one, which is the last."""
    if config.current_share == 0 or len(window) == 1:
        return window[int(rng.integers(len(window)))]
    return window[-1] if rng.random() < config.current_share else window[int(rng.integers(len(window) - 1))]
