"""The contents of the room and their positions. Lengths are metres, angles radians; the origin is the floor's centre."""

from __future__ import annotations

from functools import partial

import numpy as np

from splatam_core.datasets.room import textures
from splatam_core.datasets.room.surfaces import Array, Box, Paint, Rectangle, Sphere, Surface

ROOM_SIZE_M = (5.0, 4.2, 2.6)
DESK_CENTER, DESK_TOP = (-0.2, 1.5), 0.75
CUPBOARD_TOP = 1.1
X, Y, Z = np.eye(3)

Triple = tuple[float, float, float]


def shell() -> list[Surface]:
    """Returns floor, ceiling, four walls, the rug, and the pictures and the window on the walls."""
    x, y, z = ROOM_SIZE_M
    wallpaper = partial(textures.wallpaper, base=(0.72, 0.74, 0.66), motif=(0.35, 0.46, 0.42))
    warm, cool = partial(textures.plaster, base=(0.82, 0.72, 0.58)), partial(textures.plaster, base=(0.66, 0.74, 0.8))
    north, east = np.array([-x / 2, y / 2, z]), np.array([x / 2, y / 2, z])
    south, west = np.array([x / 2, -y / 2, z]), np.array([-x / 2, -y / 2, z])
    return [
        Rectangle(np.array([-x / 2, y / 2, 0.0]), X, -Y, x, y, textures.planks),
        Rectangle(np.array([-x / 2, -y / 2, z]), X, Y, x, y, textures.tiles),
        Rectangle(north, X, -Z, x, z, wallpaper),
        Rectangle(south, -X, -Z, x, z, warm),
        Rectangle(east, -Y, -Z, y, z, cool),
        Rectangle(west, Y, -Z, y, z, cool),
        Rectangle(np.array([-1.3, 0.9, 0.004]), X, -Y, 2.6, 1.9, textures.rug),
        _hung(west, Y, 1.2, 0.6, 1.5, 1.1, paint=textures.window),
        _hung(north, X, 1.9, 0.55, 0.9, 0.65),
        _hung(north, X, 0.35, 0.5, 0.5, 0.7),
        _hung(east, -Y, 0.5, 0.6, 0.7, 0.9),
        _hung(east, -Y, 2.6, 0.5, 1.0, 0.7),
        _hung(south, -X, 0.8, 0.6, 1.1, 0.75),
        _hung(south, -X, 3.2, 0.5, 0.8, 0.9),
        _hung(west, Y, 3.1, 0.6, 0.7, 0.85),
    ]


def boxes(rng: np.random.Generator) -> list[Box]:
    """Returns a desk with things on it, a bookcase, a sofa, a cupboard, parcels and a sideboard."""
    return [*_desk(), *_on_desk(), *_book_pile(rng), _bookcase(), *_sofa(rng), *_cupboard(rng), *_along_walls(rng)]


def spheres() -> list[Sphere]:
    """Returns a globe on the desk, a ball on the cupboard, and two balls on the floor."""
    return [
        _ball((0.12, 1.42, DESK_TOP + 0.13), 0.13, (0.25, 0.45, 0.75), (0.8, 0.72, 0.45), 0.002),
        _ball((1.95, -0.5, CUPBOARD_TOP + 0.15), 0.15, (0.6, 0.2, 0.45), (0.85, 0.8, 0.85)),
        _ball((0.95, 0.35, 0.17), 0.17, (0.85, 0.3, 0.15), (0.95, 0.85, 0.7)),
        _ball((-1.35, 0.85, 0.12), 0.12, (0.2, 0.6, 0.35), (0.9, 0.9, 0.3)),
    ]


def _desk() -> list[Box]:
    x, y = DESK_CENTER
    legs = [
        _box((x + side * 0.78, y + end * 0.34, 0.355), (0.07, 0.07, 0.71), textures.wood) for side in (-1, 1) for end in (-1, 1)
    ]
    return [_box((x, y, DESK_TOP - 0.02), (1.7, 0.8, 0.04), textures.wood), *legs]


def _on_desk() -> list[Box]:
    """A screen on its foot, a keyboard, a sheet of paper, a small parcel."""
    x, y = DESK_CENTER
    dark = partial(textures.plaster, base=(0.16, 0.16, 0.18))
    paper = partial(textures.cardboard, base=(0.85, 0.84, 0.8))
    on_desk = partial(_box, texel_m=0.002)
    return [
        on_desk((x - 0.35, y + 0.15, DESK_TOP + 0.24), (0.62, 0.05, 0.38), dark, 0.12, front=textures.screen),
        on_desk((x - 0.35, y + 0.16, DESK_TOP + 0.025), (0.2, 0.16, 0.05), dark, 0.12),
        on_desk((x - 0.3, y - 0.18, DESK_TOP + 0.012), (0.44, 0.15, 0.024), textures.screen, 0.08),
        on_desk((x + 0.12, y - 0.2, DESK_TOP + 0.008), (0.21, 0.3, 0.016), paper, 0.3),
        on_desk((x + 0.62, y + 0.16, DESK_TOP + 0.11), (0.2, 0.26, 0.22), textures.cardboard, -0.3),
    ]


def _book_pile(rng: np.random.Generator) -> list[Box]:
    x, y = DESK_CENTER
    pile, z = [], DESK_TOP
    for thickness in rng.uniform(0.025, 0.05, 4):
        cover = partial(textures.cardboard, base=textures.pigment(rng))
        size = (0.24, 0.17, float(thickness))
        pile.append(_box((x + 0.55, y - 0.2, z + thickness / 2), size, cover, rng.uniform(-0.5, 0.5), texel_m=0.002))
        z += float(thickness)
    return pile


def _bookcase() -> Box:
    side = partial(textures.wood, base=(0.5, 0.34, 0.2))
    return _box((1.75, 1.88, 1.0), (1.1, 0.36, 2.0), side, front=textures.books)


def _sofa(rng: np.random.Generator) -> list[Box]:
    cloth = partial(textures.fabric, base=(0.22, 0.32, 0.42), accent=(0.65, 0.5, 0.3))
    cushion = partial(textures.fabric, base=(0.75, 0.45, 0.2), accent=(0.3, 0.15, 0.2))
    x = -2.02
    return [
        _box((x, -0.3, 0.21), (0.85, 1.8, 0.42), cloth),
        _box((x - 0.32, -0.3, 0.6), (0.22, 1.8, 0.42), cloth),
        _box((x, -1.12, 0.52), (0.85, 0.2, 0.22), cloth),
        _box((x, 0.52, 0.52), (0.85, 0.2, 0.22), cloth),
        _box((x - 0.05, 0.2, 0.6), (0.16, 0.42, 0.38), cushion, rng.uniform(-0.4, 0.1)),
        _box((x + 0.05, -0.75, 0.58), (0.16, 0.4, 0.34), cushion, rng.uniform(0.1, 0.4)),
    ]


def _cupboard(rng: np.random.Generator) -> list[Box]:
    """A cupboard with a parcel and a framed picture on it."""
    doors = partial(textures.wood, base=(0.7, 0.55, 0.36))
    return [
        _box((2.2, -0.6, CUPBOARD_TOP / 2), (0.5, 1.5, CUPBOARD_TOP), doors),
        _box((2.15, -1.05, CUPBOARD_TOP + 0.12), (0.25, 0.3, 0.24), textures.cardboard, rng.uniform(-0.5, 0.5)),
        _box((2.2, -0.05, CUPBOARD_TOP + 0.19), (0.3, 0.06, 0.38), textures.painting, np.pi / 2 + 0.15, texel_m=0.002),
    ]


def _along_walls(rng: np.random.Generator) -> list[Box]:
    """Three parcels, and a sideboard with a radio."""
    return [
        _box((-1.75, 1.6, 0.25), (0.55, 0.5, 0.5), textures.cardboard, rng.uniform(-0.4, 0.4)),
        _box((-1.75, 1.6, 0.65), (0.36, 0.4, 0.3), textures.cardboard, rng.uniform(-0.8, 0.8)),
        _box((-1.0, -1.75, 0.3), (0.6, 0.4, 0.6), textures.cardboard, rng.uniform(-0.3, 0.3)),
        _box((0.6, -1.72, 0.45), (1.2, 0.45, 0.9), textures.wood),
        _box((0.8, -1.68, 0.9 + 0.15), (0.4, 0.25, 0.3), textures.screen, rng.uniform(-0.4, 0.4)),
    ]


def _hung(
    wall: Array, right: Array, across: float, down: float, width: float, height: float, *, paint: Paint = textures.painting
) -> Rectangle:
    """A flat object 4 mm in front of a wall, positioned relative to the wall's upper left corner."""
    corner = wall + across * right - down * Z + 0.004 * np.cross(-Z, right)
    return Rectangle(corner, right, -Z, width, height, paint=paint, texel_m=0.003)


def _box(
    center: Triple, size: Triple, paint: Paint, yaw: float = 0.0, *, front: Paint | None = None, texel_m: float = 0.003
) -> Box:
    return Box(np.array(center), np.array(size), float(yaw), (front or paint, *(paint,) * 5), texel_m)


def _ball(center: Triple, radius: float, a: Triple, b: Triple, texel_m: float = 0.003) -> Sphere:
    return Sphere(np.array(center), radius, partial(textures.marbled, a=a, b=b), texel_m)
