"""Procedural textures of the synthetic room: every function returns [h, w, 3] float32 colours in [0, 1].

Each texture has detail from decimetres down to single texels, so that tracking finds structure
at any distance. The result depends only on the random generator and the arguments.
"""

from __future__ import annotations

from functools import reduce

import cv2
import numpy as np
from numpy.typing import NDArray

Paint = NDArray[np.float32]
Color = tuple[float, float, float]

PIGMENTS = np.array(
    [
        (0.78, 0.62, 0.36), (0.62, 0.24, 0.16), (0.17, 0.26, 0.4), (0.86, 0.82, 0.7),
        (0.24, 0.38, 0.3), (0.5, 0.5, 0.48), (0.1, 0.1, 0.12), (0.84, 0.48, 0.2),
        (0.36, 0.55, 0.66), (0.45, 0.3, 0.2), (0.7, 0.68, 0.3), (0.55, 0.2, 0.3),
    ],
    np.float32,
)  # fmt: skip
"""Colours of book covers, book spines and pictures."""


def noise(rng: np.random.Generator, height: int, width: int, *, coarsest: int = 64, gain: float = 0.7) -> Paint:
    """Returns smooth multi-scale noise, [h, w], with zero mean and unit variance.

    Args:
        rng: generates the noise.
        height: number of rows.
        width: number of columns.
        coarsest: size of the largest blobs in texels; every further octave has half the size.
        gain: ratio of an octave's amplitude to that of the next coarser one.
    """
    total = np.zeros((height, width), np.float32)
    cell, amplitude = coarsest, 1.0
    while cell >= 1:
        grid = rng.standard_normal((height // cell + 3, width // cell + 3), dtype=np.float32)
        size = (grid.shape[1] * cell, grid.shape[0] * cell)
        octave = grid if cell == 1 else cv2.resize(grid, size, interpolation=cv2.INTER_CUBIC)
        total += amplitude * octave[cell : cell + height, cell : cell + width]
        cell, amplitude = cell // 2, amplitude * gain
    return (total - total.mean()) / max(float(total.std()), 1e-6)


def pigment(rng: np.random.Generator) -> Color:
    """Returns one of the pigments, made a little lighter or darker."""
    red, green, blue = np.clip(PIGMENTS[rng.integers(len(PIGMENTS))] * rng.uniform(0.7, 1.15), 0, 1)
    return float(red), float(green), float(blue)


def tinted(base: Color, *shades: Paint) -> Paint:
    """Returns a base colour made lighter and darker by the sum of [h, w] shades."""
    return np.clip(_rgb(base) * (1 + reduce(np.add, shades)[..., None]), 0, 1).astype(np.float32)


def plaster(rng: np.random.Generator, height: int, width: int, base: Color = (0.8, 0.78, 0.72)) -> Paint:
    """A painted wall: faint stains and a rough grain."""
    stains = noise(rng, height, width, coarsest=128, gain=0.6)
    grain = noise(rng, height, width, coarsest=8, gain=0.9)
    return tinted(base, 0.05 * stains, 0.06 * grain)


def wallpaper(rng: np.random.Generator, height: int, width: int, base: Color, motif: Color) -> Paint:
    """Stripes with a row of printed motifs, over plaster."""
    paint = plaster(rng, height, width, base)
    y, x = np.mgrid[:height, :width].astype(np.float32)
    pitch = 60.0
    row = np.floor(y / pitch)
    dx = (x + (row % 2) * pitch / 2) % pitch - pitch / 2
    dy = y % pitch - pitch / 2
    radius, angle = np.hypot(dx, dy), np.arctan2(dy, dx)
    flower = radius < 11 + 6 * np.cos(5 * angle)
    stripe = np.abs(dx) < 2
    paint[flower | stripe] = paint[flower | stripe] * 0.35 + _rgb(motif) * 0.65
    paint[radius < 4] = _rgb(base) * 0.5
    return paint


def planks(rng: np.random.Generator, height: int, width: int, base: Color = (0.55, 0.36, 0.2)) -> Paint:
    """A wooden floor of planks along x, each with a tone and a grain of its own."""
    plank_height, plank_width = 28, 260
    y, x = np.mgrid[:height, :width]
    row = y // plank_height
    shifted = x + (row * 97) % plank_width
    column = shifted // plank_width
    tones = rng.normal(0, 0.16, (row.max() + 1, column.max() + 1)).astype(np.float32)
    long_grain = cv2.resize(noise(rng, height, max(width // 12, 1), coarsest=8), (width, height))
    seams = (y % plank_height < 1) | (shifted % plank_width < 2)
    shade = tones[row, column] + 0.11 * long_grain + 0.05 * noise(rng, height, width, coarsest=4)
    return tinted(base, np.where(seams, np.float32(-0.6), shade))


def wood(rng: np.random.Generator, height: int, width: int, base: Color = (0.62, 0.43, 0.25)) -> Paint:
    """One piece of wood: bent year rings and fine grain along x."""
    y = np.mgrid[:height, :width][0].astype(np.float32)
    bend = noise(rng, height, width, coarsest=128, gain=0.4)
    rings = np.sin(y / 7 + 3.0 * bend)
    grain = cv2.resize(noise(rng, height, max(width // 8, 1), coarsest=4, gain=0.9), (width, height))
    return tinted(base, 0.14 * rings, 0.12 * grain, 0.06 * noise(rng, height, width, coarsest=32))


def fabric(rng: np.random.Generator, height: int, width: int, base: Color, accent: Color) -> Paint:
    """A woven tartan with fluff."""
    y, x = np.mgrid[:height, :width]
    paint = np.broadcast_to(_rgb(base), (height, width, 3)).copy()
    for axis in (x, y):
        wide, thin = axis % 80 < 26, axis % 80 // 4 == 14
        paint[wide] = paint[wide] * 0.6 + _rgb(accent) * 0.4
        paint[thin] = paint[thin] * 0.4 + np.float32(0.6)
    weave = np.where((x // 2 + y // 2) % 2, np.float32(0.05), np.float32(-0.05))
    shade = 1 + weave + 0.09 * noise(rng, height, width, coarsest=64, gain=0.8)
    return np.clip(paint * shade[..., None], 0, 1)


def rug(rng: np.random.Generator, height: int, width: int) -> Paint:
    """A carpet: framed borders around a field of diamonds."""
    palette = np.array([(0.52, 0.1, 0.12), (0.82, 0.68, 0.42), (0.1, 0.16, 0.34), (0.25, 0.42, 0.36), (0.7, 0.35, 0.2)], np.float32)
    y, x = np.mgrid[:height, :width].astype(np.float32)
    edge = np.minimum(np.minimum(x, width - 1 - x), np.minimum(y, height - 1 - y))
    diamond = np.abs(x % 90 - 45) + np.abs(y % 90 - 45)
    index = np.where(edge < 60, edge // 12 + (x // 15 + y // 15) % 2, diamond // 11).astype(int) % len(palette)
    shade = 1 + 0.14 * noise(rng, height, width, coarsest=32, gain=0.9)
    return np.clip(palette[index] * shade[..., None], 0, 1)


def books(rng: np.random.Generator, height: int, width: int, shelf_height: int = 160) -> Paint:
    """The front of a bookcase: rows of spines with titles, dark gaps above them."""
    paint = np.full((height, width, 3), 0.1, np.float32)
    for bottom in range(height, 0, -shelf_height):
        x = int(rng.integers(2, 10))
        while x < width - 6:
            spine = int(rng.integers(10, 30))
            tall = int(shelf_height * rng.uniform(0.6, 0.88))
            _paint_spine(rng, paint[max(bottom - 10 - tall, 0) : max(bottom - 10, 0), x : min(x + spine, width - 3)])
            x += spine + int(rng.integers(0, 3)) + (int(rng.integers(10, 40)) if rng.random() < 0.06 else 0)
        paint[max(bottom - 10, 0) : bottom] = (0.5, 0.35, 0.2)
    paint[:, :6] = paint[:, -6:] = (0.45, 0.3, 0.17)
    shade = 1 + 0.07 * noise(rng, height, width, coarsest=16, gain=0.9)
    return np.clip(paint * shade[..., None], 0, 1)


def _paint_spine(rng: np.random.Generator, spine: Paint) -> None:
    if not spine.size:
        return
    height, width = spine.shape[:2]
    spine[:] = pigment(rng)
    profile = 1 - 0.35 * np.abs(np.linspace(-1, 1, width, dtype=np.float32)) ** 3
    label = (0.9, 0.85, 0.7) if rng.random() < 0.8 else (0.1, 0.1, 0.1)
    for top, bottom in ((0.08, 0.11), (0.9, 0.93)):
        spine[int(top * height) : int(bottom * height)] = label
    for y in range(int(0.2 * height), int(0.7 * height), 5):
        start, stop = sorted(rng.integers(2, max(width - 1, 3), 2))
        spine[y : y + 2, start:stop] = label
    spine *= profile[None, :, None]


def painting(rng: np.random.Generator, height: int, width: int) -> Paint:
    """A framed abstract picture: patches of colour under brush strokes."""
    canvas = np.empty((height, width, 3), np.float32)
    canvas[:] = pigment(rng)
    for size in np.geomspace(0.45, 0.03, 60) * min(height, width):
        center = (int(rng.integers(0, width)), int(rng.integers(0, height)))
        axes = (max(int(size * rng.uniform(0.3, 1)), 2), max(int(size * rng.uniform(0.2, 0.7)), 2))
        cv2.ellipse(
            canvas, center, axes, angle=float(rng.uniform(0, 180)), startAngle=0, endAngle=360,
            color=pigment(rng), thickness=-1, lineType=cv2.LINE_AA,
        )  # fmt: skip
    canvas *= 1 + 0.1 * noise(rng, height, width, coarsest=16, gain=0.9)[..., None]
    _frame(canvas, 14, (0.2, 0.13, 0.08))
    return np.clip(canvas, 0, 1)


def window(rng: np.random.Generator, height: int, width: int) -> Paint:
    """A window onto sky, hills and trees, with white bars."""
    y = np.linspace(0, 1, height, dtype=np.float32)[:, None]
    clouds = np.clip(noise(rng, height, width, coarsest=128, gain=0.55), 0, 2)[..., None]
    paint = _rgb((0.55, 0.72, 0.92)) + y[..., None] * 0.25 + 0.12 * clouds * _rgb((1, 1, 0.8))
    for horizon, color in ((0.55, (0.45, 0.55, 0.6)), (0.7, (0.3, 0.45, 0.25)), (0.85, (0.18, 0.3, 0.12))):
        ridge = horizon + 0.06 * noise(rng, 1, width, coarsest=128, gain=0.5)
        foliage = 1 + 0.22 * noise(rng, height, width, coarsest=16, gain=0.9)[..., None]
        paint = np.where((y > ridge)[..., None], _rgb(color) * foliage, paint)
    for x in (width // 2, width // 2 + 1):
        paint[:, x - 5 : x + 5] = 0.92
    paint[height // 2 - 5 : height // 2 + 5] = 0.9
    _frame(paint, 16, (0.93, 0.92, 0.9))
    return np.clip(paint, 0, 1).astype(np.float32)


def tiles(rng: np.random.Generator, height: int, width: int, base: Color = (0.86, 0.86, 0.84), pitch: int = 120) -> Paint:
    """Ceiling tiles: dark joints, speckles, each tile a little different."""
    y, x = np.mgrid[:height, :width]
    tones = rng.normal(0, 0.04, (height // pitch + 1, width // pitch + 1)).astype(np.float32)
    speckle = np.where(noise(rng, height, width, coarsest=8, gain=0.9) > 1.6, np.float32(-0.25), np.float32(0))
    joints = (y % pitch < 2) | (x % pitch < 2)
    return tinted(base, np.where(joints, np.float32(-0.35), tones[y // pitch, x // pitch] + speckle))


def cardboard(rng: np.random.Generator, height: int, width: int, base: Color = (0.66, 0.5, 0.33)) -> Paint:
    """A parcel: flutes, a strip of tape, a printed label."""
    flutes = 0.04 * np.sin(np.arange(width, dtype=np.float32) * 1.3)[None, :]
    paint = tinted(base, flutes, 0.07 * noise(rng, height, width, coarsest=64, gain=0.8))
    band = slice(int(height * 0.44), int(height * 0.56))
    paint[band] = paint[band] * 0.6 + _rgb((0.8, 0.7, 0.5)) * 0.4
    top, left = int(height * 0.12), int(width * rng.uniform(0.08, 0.4))
    label = paint[top : top + int(height * 0.26), left : left + int(width * 0.4)]
    label[:] = 0.92
    for y in range(4, label.shape[0] - 3, 7):
        label[y : y + 3, 4 : 4 + int(label.shape[1] * rng.uniform(0.3, 0.85))] = rng.uniform(0, 0.35)
    return np.clip(paint, 0, 1)


def screen(rng: np.random.Generator, height: int, width: int) -> Paint:
    """A monitor that shows lines of coloured text."""
    paint = np.full((height, width, 3), (0.07, 0.09, 0.12), np.float32)
    for y in range(18, height - 16, 9):
        x = 18 + 10 * int(rng.integers(0, 5))
        while x < width * rng.uniform(0.5, 0.95):
            length = int(rng.integers(6, 40))
            paint[y : y + 4, x : min(x + length, width - 16)] = rng.uniform(0.35, 0.95, 3)
            x += length + 5
    _frame(paint, 10, (0.03, 0.03, 0.035))
    return paint


def marbled(rng: np.random.Generator, height: int, width: int, a: Color, b: Color) -> Paint:
    """Two colours in veins and continents."""
    land = np.tanh(3 * noise(rng, height, width, coarsest=64, gain=0.6))[..., None] * 0.5 + 0.5
    veins = noise(rng, height, width, coarsest=16, gain=0.9)[..., None]
    return np.clip((_rgb(a) * land + _rgb(b) * (1 - land)) * (1 + 0.12 * veins), 0, 1)


def _frame(paint: Paint, thickness: int, color: Color) -> None:
    for edge in (paint[:thickness], paint[-thickness:], paint[:, :thickness], paint[:, -thickness:]):
        edge[:] = color


def _rgb(color: Color) -> Paint:
    """A colour as an array, [3] float32."""
    return np.array(color, np.float32)
