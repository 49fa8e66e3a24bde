"""The surfaces of a room, rectangles and spheres, and the intersections of a camera's rays with them.

World axes: x to the right, y forward, z up.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from splatam_core.geometry import se3
from splatam_core.geometry.camera import PinholeCamera

Array = NDArray[np.float64]
Image = NDArray[np.float32]
Paint = Callable[[np.random.Generator, int, int], Image]

NEAR_M = 0.05


@dataclass(frozen=True)
class Rectangle:
    """A one-sided rectangle, visible from the side to which its normal points.

    Attributes:
        corner: [3] metres.
        right, down: [3] unit vectors along its sides; the normal is ``down x right``.
        width, height: metres.
        paint: makes its texture.
        texel_m: size of one texel of the texture.
    """

    corner: Array
    right: Array
    down: Array
    width: float
    height: float
    paint: Paint
    texel_m: float = 0.004

    @cached_property
    def normal(self) -> Array:
        """[3] unit vector."""
        return np.cross(self.down, self.right)

    @property
    def size_texels(self) -> tuple[int, int]:
        """Width and height of its texture."""
        return max(round(self.width / self.texel_m), 2), max(round(self.height / self.texel_m), 2)

    def points(self, u: Array, v: Array) -> tuple[Array, Array]:
        """Returns points and normals, [N, 3] each, at fractions u, v of the sides."""
        points = self.corner + u[:, None] * self.width * self.right + v[:, None] * self.height * self.down
        return points, np.broadcast_to(self.normal, points.shape)

    def intersect(self, view: View, region: Region) -> Hits | None:
        """Intersect with the rays of a region: depth along the optical axis (inf = no hit) and u, v; None if none hits."""
        corner = view.to_camera(self.corner)
        normal, right, down = (view.rotate(axis) for axis in (self.normal, self.right, self.down))
        distance = float(normal @ corner)
        if distance >= 0:  # the camera is behind it
            return None
        x, y = view.rays(region)
        depth = np.float32(distance) / np.minimum(_dot(normal, x, y), np.float32(-1e-6))
        u = (depth * _dot(right, x, y) - np.float32(right @ corner)) / np.float32(self.width)
        v = (depth * _dot(down, x, y) - np.float32(down @ corner)) / np.float32(self.height)
        inside = (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1)
        return Hits(np.where(inside, depth, np.float32(np.inf)), u, v)

    def incidence(self, view: View) -> Image:
        """Returns the cosine between each ray of a view and the normal, [H, W]; meaningful only where the ray hits."""
        x, y = view.rays(view.whole)
        return -_dot(view.rotate(self.normal), x, y) / np.sqrt(x * x + y * y + np.float32(1))

    def outline(self) -> Array:
        """Returns its corners, [8, 3]: each one twice, to have as many as a box."""
        right, down = self.right * self.width, self.down * self.height
        return self.corner + np.array([np.zeros(3), right, down, right + down] * 2)


@dataclass(frozen=True)
class Sphere:
    """A sphere.

    Attributes:
        center: [3] metres.
        radius: metres.
        paint: makes its texture in longitude and latitude.
        texel_m: size of one texel at the equator.
    """

    center: Array
    radius: float
    paint: Paint
    texel_m: float = 0.004

    @property
    def size_texels(self) -> tuple[int, int]:
        """Width and height of its texture."""
        around = 2 * np.pi * self.radius / self.texel_m
        return round(around), round(around / 2)

    def points(self, u: Array, v: Array) -> tuple[Array, Array]:
        """Returns points and normals, [N, 3] each, at fractions u of the longitude and v of the colatitude."""
        longitude, colatitude = 2 * np.pi * u - np.pi, np.pi * v
        sine = np.sin(colatitude)
        normals = np.stack([sine * np.cos(longitude), sine * np.sin(longitude), np.cos(colatitude)], -1)
        return self.center + self.radius * normals, normals

    def intersect(self, view: View, region: Region) -> Hits | None:
        """Intersect with the rays of a region: depth along the optical axis (inf = no hit) and u, v; None if none hits."""
        center = view.to_camera(self.center)
        x, y = view.rays(region)
        a = x * x + y * y + np.float32(1)
        b = _dot(center, x, y)
        discriminant = b * b - a * np.float32(center @ center - self.radius**2)
        depth = (b - np.sqrt(np.maximum(discriminant, 0))) / a
        normal = [(depth * ray - np.float32(c)) / np.float32(self.radius) for ray, c in zip((x, y, 1), center)]
        nx, ny, nz = (sum(np.float32(row[i]) * normal[i] for i in range(3)) for row in view.T_world_cam[:3, :3])
        u = np.arctan2(ny, nx) / np.float32(2 * np.pi) + np.float32(0.5)
        v = np.arccos(np.clip(nz, -1, 1)) / np.float32(np.pi)
        return Hits(np.where((discriminant > 0) & (depth > NEAR_M), depth, np.float32(np.inf)), u, v)

    def incidence(self, view: View) -> Image:
        """Returns the cosine between each ray of a view and the normal, [H, W]; meaningful only where the ray hits."""
        x, y = view.rays(view.whole)
        center = view.to_camera(self.center)
        along = _dot(center, x, y) / np.sqrt(x * x + y * y + np.float32(1))
        missed_by = (np.float32(center @ center) - along**2) / np.float32(self.radius**2)
        return np.sqrt(np.clip(1 - missed_by, 0, 1))

    def shades(self, starts: Image, step: Image) -> NDArray[np.bool_]:
        """Returns which of the segments from ``starts``, [3, N], along ``step``, [3, N], pass through it, [N].

        Segments that start on it do not count: the cosine of incidence already darkens its own far side.
        """
        offset = self.center.astype(np.float32)[:, None] - starts
        along = np.clip((offset * step).sum(axis=0) / (step * step).sum(axis=0), 0, 1)
        near = ((offset - along * step) ** 2).sum(axis=0) < self.radius**2
        return near & ((offset * offset).sum(axis=0) > (1.05 * self.radius) ** 2)

    def outline(self) -> Array:
        """Returns the corners of its bounding box, [8, 3]."""
        signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
        return self.center + self.radius * signs


Surface = Rectangle | Sphere


@dataclass(frozen=True)
class Box:
    """An upright solid, rotated about the vertical.

    Attributes:
        center: [3] metres.
        size: [3] metres.
        yaw: radians.
        paints: make the textures of the front (-y), back, left (-x), right, top and bottom.
        texel_m: size of one texel.
    """

    center: Array
    size: Array
    yaw: float
    paints: tuple[Paint, ...]
    texel_m: float = 0.003

    @cached_property
    def axes(self) -> Array:
        """Its x, y and z axes as the rows of a [3, 3] matrix."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])

    def faces(self) -> Iterator[Rectangle]:
        """Yield its six sides, visible from outside."""
        x, y, z = self.axes
        sides = [(x, -z, -y), (-x, -z, y), (-y, -z, -x), (y, -z, x), (x, -y, z), (x, y, -z)]
        for (right, down, outward), paint in zip(sides, self.paints):
            width, height, depth = (float(np.abs(self.axes @ axis) @ self.size) for axis in (right, down, outward))
            corner = self.center + (outward * depth - right * width - down * height) / 2
            yield Rectangle(corner, right, down, width, height, paint=paint, texel_m=self.texel_m)

    def shades(self, starts: Image, step: Image) -> NDArray[np.bool_]:
        """Returns which of the segments from ``starts``, [3, N], along ``step``, [3, N], pass through it, [N]."""
        axes = self.axes.astype(np.float32)
        start = axes @ (starts - self.center.astype(np.float32)[:, None])
        along = axes @ step
        along[np.abs(along) < 1e-7] = 1e-7
        half = (self.size / 2).astype(np.float32)[:, None]
        a, b = (-half - start) / along, (half - start) / along
        enter = np.minimum(a, b).max(axis=0)
        leave = np.maximum(a, b).min(axis=0)
        return np.maximum(enter, 1e-3) < np.minimum(leave, 1 - 1e-3)


@dataclass(frozen=True)
class Region:
    """A range of columns and rows of an image; right and bottom are exclusive."""

    left: int
    right: int
    top: int
    bottom: int


@dataclass(frozen=True)
class Hits:
    """Intersections of rays with a surface, [h, w] each: depth in metres, and fractions u, v of the surface's sides."""

    depth: Image
    u: Image
    v: Image


@dataclass(frozen=True)
class View:
    """A camera at a pose, and its rays (x, y, 1)."""

    camera: PinholeCamera
    T_world_cam: Array

    @cached_property
    def _columns(self) -> Image:
        return ((np.arange(self.camera.width) - self.camera.cx) / self.camera.fx).astype(np.float32)[None, :]

    @cached_property
    def _rows(self) -> Image:
        return ((np.arange(self.camera.height) - self.camera.cy) / self.camera.fy).astype(np.float32)[:, None]

    def rays(self, region: Region) -> tuple[Image, Image]:
        """Returns the x of the region's rays as a row, and their y as a column."""
        return self._columns[:, region.left : region.right], self._rows[region.top : region.bottom]

    @property
    def whole(self) -> Region:
        """The region of all its pixels."""
        return Region(0, self.camera.width, 0, self.camera.height)

    def rotate(self, vector: Array) -> Array:
        """Rotate a direction into camera axes."""
        return self.T_world_cam[:3, :3].T @ vector

    def to_camera(self, point: Array) -> Array:
        """Transform points [..., 3] into camera axes."""
        return (point - self.T_world_cam[:3, 3]) @ self.T_world_cam[:3, :3]

    def regions_of(self, outlines: Array) -> dict[int, Region]:
        """Returns the image regions of the surfaces by index; surfaces out of view are omitted.

        Args:
            outlines: [S, 8, 3] corners, world axes.
        """
        points = self.to_camera(outlines)
        nearest, farthest = points[..., 2].min(axis=1), points[..., 2].max(axis=1)
        for i in np.flatnonzero((nearest < NEAR_M) & (farthest > NEAR_M)):
            points[i] = _clip_near(points[i])
        with np.errstate(divide='ignore', invalid='ignore'):
            pixels = points[..., :2] / points[..., 2:] * (self.camera.fx, self.camera.fy)
        pixels += (self.camera.cx, self.camera.cy)
        size = np.array((self.camera.width, self.camera.height))
        low = np.clip(np.floor(pixels.min(axis=1)), 0, size).astype(int)
        high = np.clip(np.ceil(pixels.max(axis=1)) + 1, 0, size).astype(int)
        seen = (farthest > NEAR_M) & (low < high).all(axis=1)
        return {int(i): Region(low[i, 0], high[i, 0], low[i, 1], high[i, 1]) for i in np.flatnonzero(seen)}


def look_at(eye: Array, target: Array, roll: float) -> Array:
    """Returns a camera-to-world pose at ``eye`` that looks at ``target``, rotated about its axis by ``roll`` radians."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    T[:3, 3] = eye
    return T @ se3.exp(np.array([0, 0, 0, 0, 0, roll]))


def _dot(vector: Array, x: Image, y: Image) -> Image:
    """Returns the dot product of ``vector`` with each ray (x, y, 1), where x is a row and y a column."""
    a, b, c = (np.float32(value) for value in vector)
    return a * x + (b * y + c)


def _clip_near(corners: Array) -> Array:
    """Returns the corners of a solid or polygon, [8, 3], with corners in front of the near plane moved onto it.

    A corner moves along its lines to the corners beyond the plane. Of all results, only the extreme ones in the image
    are kept, which bound the visible part, though not tightly.
    """
    hidden, visible = corners[corners[:, 2] < NEAR_M], corners[corners[:, 2] >= NEAR_M]
    along = (NEAR_M - hidden[:, None, 2]) / (visible[None, :, 2] - hidden[:, None, 2])
    moved = hidden[:, None] + along[..., None] * (visible[None] - hidden[:, None])
    every = np.concatenate([visible, moved.reshape(-1, 3)])
    projected = every[:, :2] / every[:, 2:]
    extremes = [*projected.argmin(axis=0), *projected.argmax(axis=0)]
    return every[np.array(extremes * 2)]
