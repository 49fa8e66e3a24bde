"""Depth as depth_image_proc's register node publishes it from a smaller depth image: forward warped, a grid of holes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from splatam_core.geometry.trajectory import Trajectory
from splatam_core.types import RgbdFrame

BASELINE_M = 0.015  # between the lenses of colour and depth
TURN_RAD = 0.01  # between the two, about the optical axis


def thinned(depth_m: np.ndarray, ratio: float, focal: float | None = None) -> np.ndarray:
    """Keep the readings that a depth image of a ratio of the size would give.

    Args:
        depth_m: [H, W] dense depth.
        ratio: colour's size over the depth image's size.
        focal: of colour, pixels. With it, the two cameras are a little turned and shifted, so that the grid is a little bent and
            shifts with the depth; without it, whole rows and columns are empty.
    """
    height, width = depth_m.shape
    rows, columns = (np.arange(int(size / ratio)) + 0.5 for size in (height, width))
    v, u = np.meshgrid(ratio * rows - 0.5, ratio * columns - 0.5, indexing='ij')
    if focal is not None:
        u, v = u - TURN_RAD * (v - height / 2), v + TURN_RAD * (u - width / 2)
        z = depth_m[_index(v, height), _index(u, width)]
        u = u + focal * BASELINE_M * np.where(z > 0, 1 / np.maximum(z, 0.1) - 0.5, 0)
    is_inside = (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)
    kept = np.zeros(depth_m.shape, bool)
    kept[_index(v[is_inside], height), _index(u[is_inside], width)] = True
    return np.where(kept, depth_m, np.float32(0))


def _index(position: np.ndarray, size: int) -> np.ndarray:
    return np.clip(np.floor(position + 0.5), 0, size - 1).astype(np.int64)


class ThinnedSequence:
    """A recording whose depth is thinned."""

    def __init__(self, sequence, ratio: float, irregular: bool) -> None:
        self._sequence, self._ratio, self._irregular = sequence, ratio, irregular
        self.camera = sequence.camera

    def __len__(self) -> int:
        return len(self._sequence)

    def __getitem__(self, index: int) -> RgbdFrame:
        frame = self._sequence[index]
        return replace(frame, depth_m=thinned(frame.depth_m, self._ratio, frame.camera.fx if self._irregular else None))

    def ground_truth(self) -> Trajectory | None:
        return self._sequence.ground_truth()
