"""The room's static lighting: the light on each texel of its surfaces, with soft shadows, computed once."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from splatam_core.datasets.room.furniture import ROOM_SIZE_M
from splatam_core.datasets.room.surfaces import Array, Box, Image, Sphere, Surface

LUMEL_M = 0.08
"""Spacing of the points at which light is computed; between them it is interpolated."""


class Light:
    """A lamp under the ceiling and daylight from the window: soft shadows on every surface."""

    AMBIENT = 0.19
    LAMP = 5.8
    DAYLIGHT = 3.4

    def __init__(self, boxes: list[Box], spheres: list[Sphere]) -> None:
        self._solids: list[Box | Sphere] = [*boxes, *spheres]
        x, _, z = ROOM_SIZE_M
        side = (-1.0, 0.0, 1.0)
        self._lamp = [np.array([0.5 * a, 0.5 * b, z - 0.12]) for a in side for b in side]
        self._window = [np.array([-x / 2 + 0.02, -0.15 + 0.6 * a, 1.45 + 0.45 * b]) for a in side for b in side]

    def on(self, surfaces: list[Surface]) -> list[Image]:
        """Compute the light on each texel of each surface, [h, w] each."""
        grids = [_lumels(surface) for surface in surfaces]
        counts = np.cumsum([u.size for u, _ in grids])[:-1]
        pairs = [surface.points(u.ravel(), v.ravel()) for surface, (u, v) in zip(surfaces, grids)]
        points, normals = (np.concatenate(side).T.astype(np.float32) for side in zip(*pairs))
        light = self.AMBIENT * (1 + 0.2 * normals[2])
        light += self._from(self._lamp, np.array([0, 0, -1], np.float32), self.LAMP, points, normals)
        light += self._from(self._window, np.array([1, 0, 0], np.float32), self.DAYLIGHT, points, normals)
        parts = np.split(light.astype(np.float32), counts)
        return [
            np.asarray(cv2.resize(part.reshape(u.shape), surface.size_texels), np.float32)
            for part, (u, _), surface in zip(parts, grids, surfaces)
        ]

    def _from(self, sources: list[Array], facing: Image, power: float, points: Image, normals: Image) -> Image:
        """Compute the Lambertian light of an area light, sampled at a few sources, on [3, N] points."""
        total = np.zeros(points.shape[1], np.float32)
        raised = points + np.float32(2e-3) * normals
        for source in sources:
            ray = source.astype(np.float32)[:, None] - raised
            squared = (ray * ray).sum(axis=0)
            gain = np.maximum((ray * normals).sum(axis=0), 0) * np.maximum(-(facing @ ray), 0) / squared
            lit = np.flatnonzero(gain > 0)
            lit = lit[~self._shaded(raised[:, lit], ray[:, lit])]
            total[lit] += gain[lit] / (np.float32(0.3) + squared[lit])
        return np.asarray(power * total / len(sources), np.float32)

    def _shaded(self, points: Image, rays: Image) -> NDArray[np.bool_]:
        shaded = np.zeros(points.shape[1], bool)
        for solid in self._solids:
            shaded |= solid.shades(points, rays)
        return shaded


def _lumels(surface: Surface) -> tuple[Array, Array]:
    """Returns the fractions u, v of a surface's sides at which its light is computed, [rows, columns] each."""
    columns, rows = (max(int(size * surface.texel_m / LUMEL_M), 2) for size in surface.size_texels)
    u, v = np.meshgrid((np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows)
    return u, v
