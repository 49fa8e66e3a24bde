"""Combines paint and light into the synthetic room, and renders it by ray casting.

The paint of all surfaces lies in one image, the atlas, already multiplied by the light: lamps do not move, so shadows
are computed once per room. Rendering a view takes one intersection per ray and visible surface, and one
look-up in the atlas per ray.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from splatam_core.datasets.room import furniture
from splatam_core.datasets.room.light import Light
from splatam_core.datasets.room.surfaces import Array, Hits, Image, Region, Surface, View
from splatam_core.geometry.camera import PinholeCamera

ATLAS_WIDTH = 4096


@dataclass(frozen=True, eq=False)
class Cast:
    """What each ray of a view hits.

    Attributes:
        depth_m: [H, W] float32 along the optical axis.
        surface: [H, W] int16, index of the surface.
        atlas_x, atlas_y: [H, W] float32, position of its paint in the atlas.
    """

    depth_m: Image
    surface: NDArray[np.int16]
    atlas_x: Image
    atlas_y: Image


class Room:
    """A furnished room, painted and lit."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng([seed, 1])
        boxes, spheres = furniture.boxes(rng), furniture.spheres()
        faces = [face for box in boxes for face in box.faces()]
        self._surfaces: list[Surface] = [*furniture.shell(), *spheres, *faces]
        self._outlines = np.stack([surface.outline() for surface in self._surfaces])
        light = Light(boxes, spheres).on(self._surfaces)
        self._places = _pack([surface.size_texels for surface in self._surfaces])
        bottom = max(y + surface.size_texels[1] for (_, y), surface in zip(self._places, self._surfaces))
        self._atlas = np.zeros((bottom + 1, ATLAS_WIDTH, 3), np.uint8)
        for surface, lightness, place in zip(self._surfaces, light, self._places):
            width, height = surface.size_texels
            self._put(place, surface.paint(rng, height, width) * lightness[..., None])

    def incidence(self, camera: PinholeCamera, T_world_cam: Array, cast: Cast) -> Image:
        """Returns the cosine of the angle between each ray and the normal of the surface it hits, [H, W]."""
        view = View(camera, T_world_cam)
        cosine = np.ones_like(cast.depth_m)
        for index in np.unique(cast.surface):
            np.copyto(cosine, self._surfaces[index].incidence(view), where=cast.surface == index)
        return cosine

    def cast(self, camera: PinholeCamera, T_world_cam: Array) -> Cast:
        """Cast one ray through the centre of each pixel."""
        shape = (camera.height, camera.width)
        nearest = Cast(np.full(shape, np.inf, np.float32), np.zeros(shape, np.int16), *np.zeros((2, *shape), np.float32))
        view = View(camera, T_world_cam)
        for index, region in view.regions_of(self._outlines).items():
            hits = self._surfaces[index].intersect(view, region)
            if hits:
                self._keep_nearest(nearest, index, region, hits)
        return nearest

    def color(self, camera: PinholeCamera, T_world_cam: Array) -> NDArray[np.uint8]:
        """Render the view as an image [H, W, 3], with four rays per pixel."""
        fine = self.cast(camera.resized(2 * camera.width, 2 * camera.height), T_world_cam)
        colors = cv2.remap(self._atlas, fine.atlas_x, fine.atlas_y, cv2.INTER_LINEAR)
        return np.asarray(cv2.resize(colors, (camera.width, camera.height), interpolation=cv2.INTER_AREA), np.uint8)

    def _put(self, place: tuple[int, int], lit: Image) -> None:
        """Write paint into the atlas, with a margin of one texel because bilinear look-ups reach over the edge."""
        (x, y), (height, width) = place, lit.shape[:2]
        margined = np.asarray(cv2.copyMakeBorder(lit, 1, 1, 1, 1, cv2.BORDER_REPLICATE), np.float32)
        self._atlas[y - 1 : y + height + 1, x - 1 : x + width + 1] = _display(margined)

    def _keep_nearest(self, nearest: Cast, index: int, region: Region, hits: Hits) -> None:
        window = (slice(region.top, region.bottom), slice(region.left, region.right))
        closer = hits.depth < nearest.depth_m[window]
        (x, y), (width, height) = self._places[index], self._surfaces[index].size_texels
        np.copyto(nearest.depth_m[window], hits.depth, where=closer)
        np.copyto(nearest.surface[window], np.int16(index), where=closer)
        np.copyto(nearest.atlas_x[window], hits.u * np.float32(width) + np.float32(x - 0.5), where=closer)
        np.copyto(nearest.atlas_y[window], hits.v * np.float32(height) + np.float32(y - 0.5), where=closer)


@lru_cache(maxsize=2)
def build_room(seed: int) -> Room:
    """Returns the room of a seed. Building one takes a second or two, so the last two are kept."""
    return Room(seed)


def _display(light: Image) -> NDArray[np.uint8]:
    """Convert linear light to 8-bit display values, with a soft roll-off in bright areas."""
    exposed = 1 - np.exp(-1.7 * light)
    return np.rint(255 * exposed ** (1 / 1.5)).astype(np.uint8)


def _pack(sizes: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Returns a position in the atlas for each rectangle (width, height): in rows, with a margin of one texel."""
    places = [(0, 0)] * len(sizes)
    x = y = shelf = 0
    for index in sorted(range(len(sizes)), key=lambda index: -sizes[index][1]):
        width, height = sizes[index]
        if x + width + 2 > ATLAS_WIDTH:
            x, y, shelf = 0, y + shelf, 0
        places[index] = (x + 1, y + 1)
        x, shelf = x + width + 2, max(shelf, height + 2)
    return places
