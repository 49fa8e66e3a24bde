"""The synthetic room: its furniture, its light, and the ray caster that looks at it.

World axes: x to the right, y forward, z up; the origin is in the middle of the floor. Every surface
is a rectangle or a sphere. All paint lies in one image, the atlas, with the light already in it: the
lamps do not move, so shadows are computed once per room. A view then costs one intersection per ray
and surface, and one look-up in the atlas.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial

import cv2
import numpy as np
from numpy.typing import NDArray

from splatam_core import se3
from splatam_core.camera import PinholeCamera
from splatam_core.datasets import textures

Array = NDArray[np.float64]
Image = NDArray[np.float32]
Paint = Callable[[np.random.Generator, int, int], Image]

ROOM_SIZE_M = (5.0, 4.2, 2.6)
NEAR_M = 0.05
ATLAS_WIDTH = 4096
LUMEL_M = 0.08
"""Spacing of the points where light is computed; in between it is interpolated."""


@dataclass(frozen=True)
class Rectangle:
    """A one-sided rectangle: seen from where its normal points.

    Attributes:
        corner: [3] metres.
        right, down: [3] unit vectors along its sides; the normal is ``down x right``.
        width, height: metres.
        paint: what is on it.
        texel_m: size of one texel of the paint.
    """

    corner: Array
    right: Array
    down: Array
    width: float
    height: float
    paint: Paint
    texel_m: float = 0.004

    @property
    def normal(self) -> Array:
        """[3] unit vector."""
        return np.cross(self.down, self.right)

    @property
    def size_texels(self) -> tuple[int, int]:
        """Width and height of its paint."""
        return max(round(self.width / self.texel_m), 2), max(round(self.height / self.texel_m), 2)

    def points(self, u: Array, v: Array) -> tuple[Array, Array]:
        """Points and normals, [N, 3] each, at fractions u, v of the sides."""
        points = self.corner + u[:, None] * self.width * self.right + v[:, None] * self.height * self.down
        return points, np.broadcast_to(self.normal, points.shape)

    def intersect(self, view: View, region: Region) -> Hits | None:
        """Where the rays of a region meet it: depth along the axis (inf where they do not) and u, v."""
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

    def outline(self) -> Array:
        """Its corners in turn, [4, 3]."""
        right, down = self.right * self.width, self.down * self.height
        return self.corner + np.array([np.zeros(3), right, right + down, down])


@dataclass(frozen=True)
class Sphere:
    """A ball.

    Attributes:
        center: [3] metres.
        radius: metres.
        paint: what is on it, in longitude and latitude.
        texel_m: size of one texel of the paint at the equator.
    """

    center: Array
    radius: float
    paint: Paint
    texel_m: float = 0.004

    @property
    def size_texels(self) -> tuple[int, int]:
        """Width and height of its paint."""
        around = 2 * np.pi * self.radius / self.texel_m
        return round(around), round(around / 2)

    def points(self, u: Array, v: Array) -> tuple[Array, Array]:
        """Points and normals, [N, 3] each, at fractions u of the longitude and v of the latitude."""
        longitude, colatitude = 2 * np.pi * u - np.pi, np.pi * v
        sine = np.sin(colatitude)
        normals = np.stack([sine * np.cos(longitude), sine * np.sin(longitude), np.cos(colatitude)], -1)
        return self.center + self.radius * normals, normals

    def intersect(self, view: View, region: Region) -> Hits | None:
        """Where the rays of a region meet it: depth along the axis (inf where they do not) and u, v."""
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

    def shades(self, starts: Image, step: Image) -> NDArray[np.bool_]:
        """Which of the segments from ``starts``, [3, N], along ``step``, [3, N], pass through it.

        Not those that start on it: the angle of its own surface to the light darkens those.
        """
        offset = self.center.astype(np.float32)[:, None] - starts
        along = np.clip((offset * step).sum(axis=0) / (step * step).sum(axis=0), 0, 1)
        near = ((offset - along * step) ** 2).sum(axis=0) < self.radius**2
        return near & ((offset * offset).sum(axis=0) > (1.05 * self.radius) ** 2)

    def outline(self) -> Array:
        """The corners of a box around it, [8, 3]."""
        signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
        return self.center + self.radius * signs


Surface = Rectangle | Sphere


@dataclass(frozen=True)
class Box:
    """A solid that stands upright, turned about the vertical.

    Attributes:
        center: [3] metres.
        size: [3] metres.
        yaw: radians.
        paints: of the front (-y), back, left (-x), right, top; the bottom stays bare.
        texel_m: size of one texel of the paints.
    """

    center: Array
    size: Array
    yaw: float
    paints: tuple[Paint, ...]
    texel_m: float = 0.003

    @cached_property
    def axes(self) -> Array:
        """Its own x, y and z axis as the rows of a [3, 3]."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])

    def faces(self) -> Iterator[Rectangle]:
        """Its five visible sides and its bottom, seen from outside."""
        x, y, z = self.axes
        sides = [(x, -z, -y), (-x, -z, y), (-y, -z, -x), (y, -z, x), (x, -y, z), (x, y, -z)]
        for (right, down, outward), paint in zip(sides, (*self.paints, self.paints[-1])):
            width, height, depth = (float(np.abs(self.axes @ axis) @ self.size) for axis in (right, down, outward))
            corner = self.center + (outward * depth - right * width - down * height) / 2
            yield Rectangle(corner, right, down, width, height, paint, self.texel_m)

    def shades(self, starts: Image, step: Image) -> NDArray[np.bool_]:
        """Which of the segments from ``starts``, [3, N], along ``step``, [3, N], pass through it."""
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
    """Columns and rows of an image, half-open."""

    left: int
    right: int
    top: int
    bottom: int


@dataclass(frozen=True)
class Hits:
    """Where rays meet a surface, [h, w] each: depth in metres, and fractions of the surface's sides."""

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
        """x as a row and y as a column of the region's rays."""
        return self._columns[:, region.left : region.right], self._rows[region.top : region.bottom]

    def rotate(self, vector: Array) -> Array:
        """A direction in camera axes."""
        return self.T_world_cam[:3, :3].T @ vector

    def to_camera(self, point: Array) -> Array:
        """Points [..., 3] in camera axes."""
        return (point - self.T_world_cam[:3, 3]) @ self.T_world_cam[:3, :3]

    def region_of(self, surface: Surface) -> Region | None:
        """The part of the image that a surface can be seen in; None where it is out of sight."""
        points = self.to_camera(surface.outline())
        if isinstance(surface, Rectangle):
            points = _clip_near(points)
        elif (points[:, 2] < NEAR_M).any():
            return Region(0, self.camera.width, 0, self.camera.height)
        if not len(points):
            return None
        pixels = points[:, :2] / points[:, 2:] * (self.camera.fx, self.camera.fy) + (self.camera.cx, self.camera.cy)
        left, top = np.maximum(np.floor(pixels.min(axis=0)), 0).astype(int)
        right, bottom = np.minimum(np.ceil(pixels.max(axis=0)) + 1, (self.camera.width, self.camera.height)).astype(int)
        return Region(left, right, top, bottom) if left < right and top < bottom else None


@dataclass(frozen=True, eq=False)
class Cast:
    """What each ray of a view meets.

    Attributes:
        depth_m: [H, W] float32 along the optical axis.
        surface: [H, W] int16, index of the surface.
        atlas_x, atlas_y: [H, W] float32, where its paint is.
    """

    depth_m: Image
    surface: NDArray[np.int16]
    atlas_x: Image
    atlas_y: Image


class Room:
    """A furnished room, painted and lit."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng([seed, 1])
        boxes, spheres = _furniture(rng)
        self._surfaces: list[Surface] = [*_shell(rng), *spheres, *(face for box in boxes for face in box.faces())]
        light = _Light(boxes, spheres).on(self._surfaces)
        self._places = _pack([surface.size_texels for surface in self._surfaces])
        bottom = max(y + surface.size_texels[1] for (_, y), surface in zip(self._places, self._surfaces))
        self._atlas = np.zeros((bottom + 1, ATLAS_WIDTH, 3), np.uint8)
        for surface, lightness, (x, y) in zip(self._surfaces, light, self._places):
            width, height = surface.size_texels
            lit = surface.paint(rng, height, width) * lightness[..., None]
            lit = cv2.copyMakeBorder(lit, 1, 1, 1, 1, cv2.BORDER_REPLICATE)  # bilinear look-ups reach over the edge
            self._atlas[y - 1 : y + height + 1, x - 1 : x + width + 1] = _display(lit)

    def incidence(self, camera: PinholeCamera, T_world_cam: Array, cast: Cast) -> Image:
        """Cosine between each ray and the surface it meets, [H, W]; 1 = head on."""
        view = View(camera, T_world_cam)
        x, y = view.rays(Region(0, camera.width, 0, camera.height))
        length = np.sqrt(x * x + y * y + np.float32(1))
        cosine = np.ones_like(cast.depth_m)
        for index in np.unique(cast.surface):
            surface, seen = self._surfaces[index], cast.surface == index
            if isinstance(surface, Rectangle):
                cosine[seen] = (-_dot(view.rotate(surface.normal), x, y) / length)[seen]
            else:
                center = view.to_camera(surface.center)
                closest = np.float32(center @ center) - (_dot(center, x, y) / length) ** 2
                cosine[seen] = np.sqrt(np.clip(1 - closest / np.float32(surface.radius**2), 0, 1))[seen]
        return cosine

    def cast(self, camera: PinholeCamera, T_world_cam: Array) -> Cast:
        """Follow one ray through each pixel's centre."""
        shape = (camera.height, camera.width)
        nearest = Cast(np.full(shape, np.inf, np.float32), np.zeros(shape, np.int16), *np.zeros((2, *shape), np.float32))
        view = View(camera, T_world_cam)
        for index, surface in enumerate(self._surfaces):
            region = view.region_of(surface)
            hits = surface.intersect(view, region) if region else None
            if region and hits:
                self._keep_nearest(nearest, index, region, hits)
        return nearest

    def color(self, camera: PinholeCamera, T_world_cam: Array) -> NDArray[np.uint8]:
        """The view as an image [H, W, 3], four rays to a pixel."""
        fine = self.cast(camera.resized(2 * camera.width, 2 * camera.height), T_world_cam)
        colors = cv2.remap(self._atlas, fine.atlas_x, fine.atlas_y, cv2.INTER_LINEAR)
        return cv2.resize(colors, (camera.width, camera.height), interpolation=cv2.INTER_AREA)

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
    """The room of a seed; building one takes about a second, so the last two are kept."""
    return Room(seed)


class _Light:
    """A lamp under the ceiling and daylight from the window: soft shadows on every surface."""

    AMBIENT = 0.19
    LAMP = 5.8
    DAYLIGHT = 3.4

    def __init__(self, boxes: list[Box], spheres: list[Sphere]) -> None:
        self._solids = [*boxes, *spheres]
        x, _, z = ROOM_SIZE_M
        side = (-1.0, 0.0, 1.0)
        self._lamp = [np.array([0.5 * a, 0.5 * b, z - 0.12]) for a in side for b in side]
        self._window = [np.array([-x / 2 + 0.02, -0.15 + 0.6 * a, 1.45 + 0.45 * b]) for a in side for b in side]

    def on(self, surfaces: list[Surface]) -> list[Image]:
        """Light on each texel of each surface, [h, w] each."""
        grids = [_lumels(surface) for surface in surfaces]
        counts = np.cumsum([u.size for u, _ in grids])[:-1]
        pairs = [surface.points(u.ravel(), v.ravel()) for surface, (u, v) in zip(surfaces, grids)]
        points, normals = (np.concatenate(side).T.astype(np.float32) for side in zip(*pairs))
        light = self.AMBIENT * (1 + 0.2 * normals[2])
        light += self._from(self._lamp, np.float32([0, 0, -1]), self.LAMP, points, normals)
        light += self._from(self._window, np.float32([1, 0, 0]), self.DAYLIGHT, points, normals)
        parts = np.split(light.astype(np.float32), counts)
        return [
            cv2.resize(part.reshape(u.shape), surface.size_texels)
            for part, (u, _), surface in zip(parts, grids, surfaces)
        ]

    def _from(self, sources: list[Array], facing: Image, power: float, points: Image, normals: Image) -> Image:
        """Lambertian light from an area light, sampled at a few sources, on [3, N] points."""
        total = np.zeros(points.shape[1], np.float32)
        raised = points + np.float32(2e-3) * normals
        for source in sources:
            ray = source.astype(np.float32)[:, None] - raised
            squared = (ray * ray).sum(axis=0)
            gain = np.maximum((ray * normals).sum(axis=0), 0) * np.maximum(-(facing @ ray), 0) / squared
            lit = np.flatnonzero(gain > 0)
            lit = lit[~self._shaded(raised[:, lit], ray[:, lit])]
            total[lit] += gain[lit] / (np.float32(0.3) + squared[lit])
        return power * total / len(sources)

    def _shaded(self, points: Image, rays: Image) -> NDArray[np.bool_]:
        shaded = np.zeros(points.shape[1], bool)
        for solid in self._solids:
            shaded |= solid.shades(points, rays)
        return shaded


def _lumels(surface: Surface) -> tuple[Array, Array]:
    """Fractions u, v of a surface's sides where its light is computed, [rows, columns] each."""
    columns, rows = (max(int(size * surface.texel_m / LUMEL_M), 2) for size in surface.size_texels)
    u, v = np.meshgrid((np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows)
    return u, v


def _shell(rng: np.random.Generator) -> list[Surface]:
    """Floor, ceiling, four walls, and what hangs on them."""
    x, y, z = ROOM_SIZE_M
    ex, ey, ez = np.eye(3)
    wallpaper = partial(textures.wallpaper, base=(0.72, 0.74, 0.66), motif=(0.35, 0.46, 0.42))
    warm, cool = partial(textures.plaster, base=(0.82, 0.72, 0.58)), partial(textures.plaster, base=(0.66, 0.74, 0.8))
    near = 0.004  # what hangs on a wall is this far in front of it
    north = np.array([-x / 2, y / 2, z])
    east, west = np.array([x / 2, y / 2, z]), np.array([-x / 2, -y / 2, z])
    south = np.array([x / 2, -y / 2, z])
    surfaces = [
        Rectangle(np.array([-x / 2, y / 2, 0.0]), ex, -ey, x, y, textures.planks),
        Rectangle(np.array([-x / 2, -y / 2, z]), ex, ey, x, y, textures.tiles),
        Rectangle(north, ex, -ez, x, z, wallpaper),
        Rectangle(south, -ex, -ez, x, z, warm),
        Rectangle(east, -ey, -ez, y, z, cool),
        Rectangle(west, ey, -ez, y, z, cool),
        Rectangle(np.array([-1.3, 0.9, near]), ex, -ey, 2.6, 1.9, textures.rug),
        Rectangle(west + (near, 1.2, -0.6), ey, -ez, 1.5, 1.1, textures.window),
    ]
    for corner, right, width, height in (
        (north + (1.9, -near, -0.55), ex, 0.9, 0.65),
        (north + (0.35, -near, -0.5), ex, 0.5, 0.7),
        (east + (-near, -0.5, -0.6), -ey, 0.7, 0.9),
        (east + (-near, -2.6, -0.5), -ey, 1.0, 0.7),
        (south + (-0.8, near, -0.6), -ex, 1.1, 0.75),
        (south + (-3.2, near, -0.5), -ex, 0.8, 0.9),
        (west + (near, 3.1, -0.6), ey, 0.7, 0.85),
    ):
        surfaces.append(Rectangle(corner, right, -ez, width, height, textures.painting, 0.003))
    return surfaces


def _furniture(rng: np.random.Generator) -> tuple[list[Box], list[Sphere]]:
    """A desk with things on it, a bookcase, a sofa, a cupboard, parcels, balls."""
    return (
        [*_desk(rng), *_bookcase(), *_sofa(rng), *_cupboard(rng), *_parcels(rng)],
        [
            Sphere(np.array([0.12, 1.42, 0.75 + 0.13]), 0.13, _marble((0.25, 0.45, 0.75), (0.8, 0.72, 0.45)), 0.002),
            Sphere(np.array([0.95, 0.35, 0.17]), 0.17, _marble((0.85, 0.3, 0.15), (0.95, 0.85, 0.7)), 0.003),
            Sphere(np.array([-1.35, 0.85, 0.12]), 0.12, _marble((0.2, 0.6, 0.35), (0.9, 0.9, 0.3)), 0.003),
            Sphere(np.array([1.95, -0.5, 1.1 + 0.15]), 0.15, _marble((0.6, 0.2, 0.45), (0.85, 0.8, 0.85)), 0.003),
        ],
    )


def _desk(rng: np.random.Generator) -> list[Box]:
    center, size = np.array([-0.2, 1.5, 0.0]), np.array([1.7, 0.8, 0.04])
    wood = _all(textures.wood)
    legs = [
        Box(center + (sx * 0.78, sy * 0.34, 0.355), np.array([0.07, 0.07, 0.71]), 0.0, wood)
        for sx in (-1, 1)
        for sy in (-1, 1)
    ]
    dark = partial(textures.plaster, base=(0.16, 0.16, 0.18))
    paper = partial(textures.cardboard, base=(0.85, 0.84, 0.8))
    things = [
        Box(center + (-0.35, 0.15, 0.75 + 0.24), np.array([0.62, 0.05, 0.38]), 0.12, (textures.screen, *_all(dark)[1:]), 0.002),
        Box(center + (-0.35, 0.16, 0.75 + 0.025), np.array([0.2, 0.16, 0.05]), 0.12, _all(dark), 0.002),
        Box(center + (-0.3, -0.18, 0.75 + 0.012), np.array([0.44, 0.15, 0.024]), 0.08, _all(textures.screen), 0.002),
        Box(center + (0.62, 0.16, 0.75 + 0.11), np.array([0.2, 0.26, 0.22]), -0.3, _all(textures.cardboard), 0.002),
        Box(center + (0.12, -0.2, 0.75 + 0.008), np.array([0.21, 0.3, 0.016]), 0.3, _all(paper), 0.002),
    ]
    z = 0.75
    for _ in range(4):
        thickness = rng.uniform(0.025, 0.05)
        color = textures.pigment(rng)
        cover = _all(partial(textures.cardboard, base=color))
        things.append(
            Box(center + (0.55, -0.2, z + thickness / 2), np.array([0.24, 0.17, thickness]), rng.uniform(-0.5, 0.5), cover, 0.002)
        )
        z += thickness
    return [Box(center + (0, 0, 0.73), size, 0.0, wood), *legs, *things]


def _bookcase() -> list[Box]:
    side = partial(textures.wood, base=(0.5, 0.34, 0.2))
    return [Box(np.array([1.75, 1.88, 1.0]), np.array([1.1, 0.36, 2.0]), 0.0, (textures.books, *_all(side)[1:]))]


def _sofa(rng: np.random.Generator) -> list[Box]:
    cloth = _all(partial(textures.fabric, base=(0.22, 0.32, 0.42), accent=(0.65, 0.5, 0.3)))
    cushion = _all(partial(textures.fabric, base=(0.75, 0.45, 0.2), accent=(0.3, 0.15, 0.2)))
    x = -2.02
    return [
        Box(np.array([x, -0.3, 0.21]), np.array([0.85, 1.8, 0.42]), 0.0, cloth),
        Box(np.array([x - 0.32, -0.3, 0.6]), np.array([0.22, 1.8, 0.42]), 0.0, cloth),
        Box(np.array([x, -1.12, 0.52]), np.array([0.85, 0.2, 0.22]), 0.0, cloth),
        Box(np.array([x, 0.52, 0.52]), np.array([0.85, 0.2, 0.22]), 0.0, cloth),
        Box(np.array([x - 0.05, 0.2, 0.6]), np.array([0.16, 0.42, 0.38]), float(rng.uniform(-0.4, 0.1)), cushion),
        Box(np.array([x + 0.05, -0.75, 0.58]), np.array([0.16, 0.4, 0.34]), float(rng.uniform(0.1, 0.4)), cushion),
    ]


def _cupboard(rng: np.random.Generator) -> list[Box]:
    doors = _all(partial(textures.wood, base=(0.7, 0.55, 0.36)))
    return [
        Box(np.array([2.2, -0.6, 0.55]), np.array([0.5, 1.5, 1.1]), 0.0, doors),
        Box(np.array([2.15, -1.05, 1.1 + 0.12]), np.array([0.25, 0.3, 0.24]), float(rng.uniform(-0.5, 0.5)), _all(textures.cardboard)),
        Box(np.array([2.2, -0.05, 1.1 + 0.19]), np.array([0.3, 0.06, 0.38]), np.pi / 2 + 0.15, _all(textures.painting), 0.002),
    ]


def _parcels(rng: np.random.Generator) -> list[Box]:
    return [
        Box(np.array([-1.75, 1.6, 0.25]), np.array([0.55, 0.5, 0.5]), float(rng.uniform(-0.4, 0.4)), _all(textures.cardboard)),
        Box(np.array([-1.75, 1.6, 0.65]), np.array([0.36, 0.4, 0.3]), float(rng.uniform(-0.8, 0.8)), _all(textures.cardboard)),
        Box(np.array([-1.0, -1.75, 0.3]), np.array([0.6, 0.4, 0.6]), float(rng.uniform(-0.3, 0.3)), _all(textures.cardboard)),
        Box(np.array([0.6, -1.72, 0.45]), np.array([1.2, 0.45, 0.9]), 0.0, _all(textures.wood)),
        Box(np.array([0.8, -1.68, 0.9 + 0.15]), np.array([0.4, 0.25, 0.3]), float(rng.uniform(-0.4, 0.4)), _all(textures.screen)),
    ]


def _all(paint: Paint) -> tuple[Paint, ...]:
    """One paint for the five sides of a box."""
    return (paint,) * 5


def _marble(a: textures.Color, b: textures.Color) -> Paint:
    return partial(textures.marbled, a=a, b=b)


def _display(light: Image) -> NDArray[np.uint8]:
    """Linear light as 8-bit display values, bright light rolled off softly."""
    exposed = 1 - np.exp(-1.7 * light)
    return np.rint(255 * exposed ** (1 / 1.5)).astype(np.uint8)


def _pack(sizes: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Places for rectangles on shelves of the atlas, with a margin of one texel around each."""
    places = [(0, 0)] * len(sizes)
    x = y = shelf = 0
    for index in sorted(range(len(sizes)), key=lambda index: -sizes[index][1]):
        width, height = sizes[index]
        if x + width + 2 > ATLAS_WIDTH:
            x, y, shelf = 0, y + shelf, 0
        places[index] = (x + 1, y + 1)
        x, shelf = x + width + 2, max(shelf, height + 2)
    return places


def _dot(vector: Array, x: Image, y: Image) -> Image:
    """``vector`` times each ray (x, y, 1), where x is a row and y a column."""
    a, b, c = (np.float32(value) for value in vector)
    return a * x + (b * y + c)


def _clip_near(points: Array) -> Array:
    """The corners of a polygon's part beyond the near plane."""
    kept = []
    for a, b in zip(points, np.roll(points, -1, axis=0)):
        if a[2] >= NEAR_M:
            kept.append(a)
        if (a[2] >= NEAR_M) != (b[2] >= NEAR_M):
            kept.append(a + (b - a) * (NEAR_M - a[2]) / (b[2] - a[2]))
    return np.array(kept)


def look_at(eye: Array, target: Array, roll: float) -> Array:
    """Camera-to-world pose at ``eye`` that sees ``target`` in the middle, turned about its axis by ``roll`` radians."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    T[:3, 3] = eye
    return T @ se3.exp(np.array([0, 0, 0, 0, 0, roll]))
