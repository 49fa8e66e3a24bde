"""Which views are mapped together: some that overlap the current one, the last keyframe, the current one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from splatam_core.config import KeyframeConfig
from splatam_core.view import View, unproject


@dataclass(frozen=True, slots=True, eq=False)
class PosedView:
    """A view and where it was taken from.

    Attributes:
        view: the images.
        T_cam_world: [4, 4] float32.
    """

    view: View
    T_cam_world: Tensor


def select_window(
    current: PosedView, keyframes: Sequence[PosedView], config: KeyframeConfig, rng: np.random.Generator
) -> list[PosedView]:
    """The views to map: random overlapping keyframes, the last keyframe and the current view.

    Random, not best: the most overlapping keyframes are nearly the current view, and the map would forget the rest.
    """
    if not keyframes or config.window == 1:
        return [current]
    points = sample_points(current, config.overlap_samples, rng)
    seen = overlaps(points, keyframes[:-1], config.overlap_margin)
    overlapping = [k for k, share in zip(keyframes, seen) if share > 0]
    count = min(max(0, config.window - 2), len(overlapping))
    chosen = rng.permutation(len(overlapping))[:count]
    return [*(overlapping[i] for i in chosen), keyframes[-1], current]


def sample_points(posed: PosedView, count: int, rng: np.random.Generator) -> Tensor:
    """[count, 3] world points of random pixels with a reading, drawn with replacement; none where none has one."""
    v, u = torch.nonzero(posed.view.valid, as_tuple=True)
    if len(u) == 0:
        return torch.empty(0, 3)
    drawn = torch.from_numpy(rng.integers(len(u), size=count))
    points = unproject(posed.view.camera, u[drawn], v[drawn], posed.view.depth[v[drawn], u[drawn]])
    return (points - posed.T_cam_world[:3, 3]) @ posed.T_cam_world[:3, :3]


def overlaps(points: Tensor, keyframes: Sequence[PosedView], margin: int) -> list[float]:
    """Share of world points [K, 3] that project inside each view, more than ``margin`` pixels from its border."""
    if not len(points) or not keyframes:
        return [0.0] * len(keyframes)
    camera = keyframes[0].view.camera
    T = torch.stack([keyframe.T_cam_world[:3] for keyframe in keyframes])  # [N, 3, 4]
    x, y, z = (T[:, :, :3] @ points.T + T[:, :, 3:]).unbind(1)  # [N, K] each
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    inside = (u > margin) & (u < camera.width - margin) & (v > margin) & (v < camera.height - margin) & (z > 0)
    return inside.float().mean(dim=1).tolist()


def draw(window: Sequence[PosedView], config: KeyframeConfig, rng: np.random.Generator) -> PosedView:
    """One view of a window, whose last is the current one."""
    if config.current_share == 0 or len(window) == 1:
        return window[rng.integers(len(window))]
    return window[-1] if rng.random() < config.current_share else window[rng.integers(len(window) - 1)]
