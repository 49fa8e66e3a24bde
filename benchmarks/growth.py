"""Does a frame take longer when the map is large? A long flight along a wall, where each frame shows new surface.

    python benchmarks/growth.py [--preset realtime] [--frames 2000] [--width 320] [--set KEY=VALUE]

The images of wall, floor and ceiling are rendered, with sensor noise. The camera faces the wall at 75 degrees, sways, and
moves by 2 cm per frame, about a hundredth of the view. Prints the time per frame over windows of 100 frames, and the
ratio of the last window to the one at frame 200.
"""

from __future__ import annotations

import argparse
import statistics

import numpy as np
from header import print_header
from numpy.typing import NDArray

from splatam_core.config import apply_threads, load_config
from splatam_core.geometry import se3
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.runs import provenance
from splatam_core.slam import Slam
from splatam_core.types import RgbdFrame

WINDOW = 100
STEP_M = 0.02
FACING = np.radians(75)
SIDES = ((0, 1.6), (1, 1.1), (1, -1.1))  # axis and offset of the planes: wall ahead to the right, floor, ceiling
RELIEF_M = 0.06


def camera(width: int) -> PinholeCamera:
    """Returns a camera with a horizontal field of view of about 63 degrees."""
    focal = 525.0 * width / 640
    return PinholeCamera(width, width * 3 // 4, focal, focal, (width - 1) / 2, (width * 3 // 4 - 1) / 2)


def pose(index: int) -> NDArray[np.float64]:
    """Returns the [4, 4] camera-to-world pose: motion along z, turned towards the wall, swaying."""
    T = np.eye(4)
    T[:3, 3] = 0.05 * np.sin(index / 17), 0.05 * np.sin(index / 11), STEP_M * index
    turn = se3.exp(np.array([0, 0, 0, 0.04 * np.sin(index / 13), FACING + 0.06 * np.sin(index / 23), 0.03 * np.sin(index / 9)]))
    return T @ turn


def texture(along: NDArray[np.float64], across: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns [..., 3] colours that never repeat: tiles and waves of incommensurate lengths."""
    waves = [np.sin(a * along + b * across + c) for a, b, c in ((2.1, 1.3, 0), (5.7, -3.1, 1), (13.3, 8.9, 2), (0.37, 4.1, 3))]
    tiles = np.sign(np.sin(9.1 * along) * np.sin(7.3 * across))
    return 0.5 + 0.12 * np.stack([waves[0] + waves[2] + tiles, waves[1] - waves[2] + tiles, waves[3] + waves[1] - tiles], -1)


def frame(index: int, cam: PinholeCamera, rng: np.random.Generator) -> RgbdFrame:
    """Renders the camera's view of the walls."""
    return frame_at(pose(index), 10**9 + index * 33_333_333, cam, rng)


def rays_of(T: NDArray[np.float64], cam: PinholeCamera) -> NDArray[np.float64]:
    """Returns [H, W, 3] the directions in the world of the pixels of a camera at a pose [4, 4], one metre deep."""
    u, v = np.meshgrid(np.arange(cam.width), np.arange(cam.height))
    return np.stack([(u - cam.cx) / cam.fx, (v - cam.cy) / cam.fy, np.ones(u.shape)], -1) @ T[:3, :3].T


def frame_at(T: NDArray[np.float64], stamp_ns: int, cam: PinholeCamera, rng: np.random.Generator) -> RgbdFrame:
    """Renders the view of a camera at a pose [4, 4]."""
    rays = rays_of(T, cam)
    depth, colour = np.full(rays.shape[:2], np.inf), np.zeros(rays.shape)
    for axis, offset in SIDES:
        with np.errstate(divide='ignore', invalid='ignore'):
            z = (offset - T[axis, 3]) / rays[..., axis]
        for _ in range(2):  # the planes have relief, found by fixed-point steps
            points = T[:3, 3] + z[..., None] * rays
            relief = RELIEF_M * np.sin(3.0 * points[..., 2]) * np.sin(4.0 * points[..., 1 - axis])
            with np.errstate(divide='ignore', invalid='ignore'):
                z = (offset - relief - T[axis, 3]) / rays[..., axis]
        nearer = (z > 0) & (z < depth)
        points = T[:3, 3] + np.where(nearer, z, 1.0)[..., None] * rays
        colour[nearer] = texture(points[..., 2], points[..., 1 - axis] + 3.0 * axis + offset)[nearer]
        depth[nearer] = z[nearer]
    return noisy(stamp_ns, colour, depth, cam, rng)


def noisy(
    stamp_ns: int, colour: NDArray[np.float64], depth: NDArray[np.float64], cam: PinholeCamera, rng: np.random.Generator
) -> RgbdFrame:
    """Returns colours [H, W, 3] from 0 to 1 and depths [H, W] as a camera would see them."""
    depth = np.where(depth > 6.0, 0.0, depth)
    depth += 0.0015 * depth**2 * rng.standard_normal(depth.shape)
    values = 255 * np.clip(colour, 0, 1) + rng.normal(0, 2, colour.shape)
    rgb = np.clip(np.rint(values), 0, 255).astype(np.uint8)
    return RgbdFrame(stamp_ns, rgb, np.maximum(depth, 0).astype(np.float32), cam)


def main() -> None:
    """Process the flight and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--preset', default='realtime')
    parser.add_argument('--frames', type=int, default=2000)
    parser.add_argument('--width', type=int, default=320)
    parser.add_argument('--set', dest='overrides', action='append', default=[], metavar='KEY=VALUE')
    args = parser.parse_args()
    config = load_config(args.preset, args.overrides)
    apply_threads(config)
    slam, cam, rng = Slam(config), camera(args.width), np.random.default_rng(0)
    print_header(f'Growth along a wall, preset `{args.preset}`, width {args.width}', 1)
    print('| frames | mean ms | median ms | p95 ms | Gaussians | RSS peak MB | position error cm | lost |\n|' + '---|' * 8)
    means: list[float] = []
    T_world_start = pose(0)
    for begin in range(0, args.frames, WINDOW):
        results = [slam.process(frame(index, cam, rng)) for index in range(begin, min(begin + WINDOW, args.frames))]
        times = [result.timings.total for result in results]
        means.append(statistics.mean(times))
        poses = [(r.index, r.T_world_cam) for r in results if r.T_world_cam is not None]
        error = np.linalg.norm((T_world_start @ poses[-1][1])[:3, 3] - pose(poses[-1][0])[:3, 3]) if poses else np.nan
        print(f'| {begin}–{begin + len(times)} | {means[-1]:.1f} | {statistics.median(times):.1f} | '
              f'{np.percentile(times, 95):.1f} | {slam.num_gaussians} | {provenance.peak_rss_mb():.0f} | {100 * error:.1f} | '
              f'{len(results) - len(poses)} |', flush=True)  # fmt: skip
    if len(means) > 2:
        print(f'\nLast window to frames 200–300: {means[-1] / means[2]:.2f}.')


if __name__ == '__main__':
    main()
