"""Times of the rasterizer's passes, with one Gaussian per pixel as in a new map.

    python benchmarks/kernels.py [--runs 20] [--compare generic avx2]

With --compare only the passes of these instruction sets are timed, on one thread and in turn, so that other work on the machine
slows all of them. The ratio to the last one is of the medians.

Forward covers everything from the parameters to the images, including projection, sorting and binning. Backward covers
everything from the gradients of the images to those of the parameters (map), or of the pose alone (pose).

The roofline is the shortest time in which the same cores could do the same work. The work is counted, not measured: the
arithmetic for every pixel of every tile that a Gaussian touches, and each array read and written once. The best rates of
the cores are measured: float32 operations in a matrix product, and bytes in a copy larger than the caches. The count
includes Gaussians behind opaque pixels. A pass skips those, so it looks better here than it is.
"""

from __future__ import annotations

import argparse
import itertools
import math
import os
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
import torch
from header import print_header, timed_ms

from splatam_core.config import load_config
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.images.view import View
from splatam_core.mapping import optimizers
from splatam_core.mapping.gaussian_map import GaussianMap
from splatam_core.rasterizer import Gaussians, Rasterizer, Render, Target, make_rasterizer
from splatam_core.rasterizer.base import BLUR_PX2, MIN_ALPHA
from splatam_core.rasterizer.cpu import CpuRasterizer
from splatam_core.rasterizer.native import make_native_aligner
from splatam_core.tracking import make_tracker
from splatam_core.tracking.aligner import Linearization

SIZES = ((320, 240), (640, 480))
TILE = 8
# Counted in csrc/kernels.inl; a fused multiply-add counts as two.
FORWARD_OPERATIONS = 17  # per pixel of a splat: alpha, its bounds, the weight, five sums, the transmittance
BACKWARD_OPERATIONS = 45
EXPONENTIAL_OPERATIONS = 22  # an exponential and its argument
PROJECTION_OPERATIONS = 120  # from a Gaussian to its splat, or back


def camera(width: int, height: int) -> PinholeCamera:
    """Returns a camera with a horizontal field of view of about 63 degrees."""
    focal = 525.0 * width / 640
    return PinholeCamera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def wavy_wall(cam: PinholeCamera) -> Gaussians:
    """Returns one Gaussian per pixel: one pixel wide, opacity 0.5, at a depth of 1 to 3 m."""
    v, u = torch.meshgrid(torch.arange(cam.height), torch.arange(cam.width), indexing='ij')
    z = 2 + 0.5 * torch.sin(u / 37) + 0.5 * torch.cos(v / 23)
    means = torch.stack([(u - cam.cx) / cam.fx * z, (v - cam.cy) / cam.fy * z, z], -1).reshape(-1, 3)
    rgb = torch.rand(len(means), 3, generator=torch.Generator().manual_seed(0))
    return Gaussians(means, torch.log(means[:, 2:] / cam.fx), torch.zeros(len(means)), rgb)


def with_gradients(gaussians: Gaussians) -> Gaussians:
    """Returns a copy whose parameters are leaves that collect gradients."""
    g = gaussians.detached()
    names = [name for name in ('means', 'log_scales', 'logit_opacities', 'rgb', 'rotations') if getattr(g, name) is not None]
    return replace(g, **{name: getattr(g, name).requires_grad_() for name in names})


def backward(render: Render) -> None:
    """Run the backward pass with a gradient of one for every value of every image."""
    outputs = [render.rgb, render.depth_acc, render.silhouette]
    torch.autograd.backward(outputs, [torch.ones_like(output) for output in outputs])


def row(name: str, rasterizer: Rasterizer, cam: PinholeCamera, runs: int, anisotropic: bool = False) -> None:
    """Print a line of the table: medians, and the spread of forward plus backward."""
    still = wavy_wall(cam).anisotropic() if anisotropic else wavy_wall(cam)
    moving = with_gradients(still)
    pose = torch.eye(4)
    pose[0, 3] = 0.003
    forward = timed_ms(lambda: rasterizer.render(still, cam, pose), runs)
    both = timed_ms(lambda: backward(rasterizer.render(moving, cam, pose)), runs)
    to_pose = timed_ms(lambda: backward(rasterizer.render(still, cam, pose.clone().requires_grad_())), runs)
    f, fb, fp = (statistics.median(times) for times in (forward, both, to_pose))
    print(f'| {name} | {cam.width}x{cam.height} | {f:.1f} | {fb - f:.1f} | {fp - f:.1f} | {fb:.1f} '
          f'({min(both):.1f}-{max(both):.1f}) |', flush=True)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Work:
    """The float32 operations and the bytes moved of one pass, or per second."""

    operations: float
    moved: float

    def roofline_ms(self, rates: Work) -> float:
        """Returns the shortest possible time at these rates per second, in milliseconds."""
        return 1e3 * max(self.operations / rates.operations, self.moved / rates.moved)


def wall_view(cam: PinholeCamera) -> View:
    """Returns the wall as a frame."""
    g = wavy_wall(cam)
    rgb8 = (255 * g.rgb).byte().view(cam.height, cam.width, 3)
    return View(cam, rgb8, g.means[:, 2].reshape(cam.height, cam.width).contiguous())


def realtime_row(name: str, rasterizer: Rasterizer, cam: PinholeCamera, runs: int, threads: int) -> None:
    """Print the times of one alignment and of one fused optimizer step, with the settings of preset `realtime`."""
    config, wall, view = load_config('realtime'), GaussianMap(), wall_view(cam)
    wall.append(wavy_wall(cam))
    pose = torch.eye(4)
    pose[0, 3] = 0.003
    target = Target(cam, view.rgb8, view.depth, pose, config.mapping.color_weight, config.mapping.depth_weight)
    tracker = make_tracker(rasterizer, config.tracking, threads)
    still = wavy_wall(cam)
    times = [
        timed_ms(lambda: tracker.track(view, still, pose.double().numpy()), runs),
        timed_ms(lambda: rasterizer.fit(wall.gaussians, wall.moments, optimizers.rates(config.mapping), target), runs),
    ]
    cells = (f'{statistics.median(ms):.1f} ({min(ms):.1f}-{max(ms):.1f})' for ms in times)
    print(f'| {name} | {cam.width}x{cam.height} | ' + ' | '.join(cells) + ' |', flush=True)


def touched_tiles(gaussians: Gaussians, cam: PinholeCamera) -> int:
    """Returns how many tiles all Gaussians touch, seen from the origin. A footprint is the disc where alpha exceeds 1/255."""
    z = gaussians.means[:, 2]
    centre = torch.stack([cam.fx * gaussians.means[:, 0] / z + cam.cx, cam.fy * gaussians.means[:, 1] / z + cam.cy])
    variance = (cam.fx * gaussians.log_scales[:, 0].exp() / z) ** 2 + BLUR_PX2
    radius = (2 * variance * torch.log(torch.sigmoid(gaussians.logit_opacities) / MIN_ALPHA)).sqrt()
    reach, total = math.ceil(radius.max().item() / TILE), 0
    for x, y in itertools.product(range(-reach, reach + 1), repeat=2):
        tile = torch.div(centre, TILE, rounding_mode='floor') + torch.tensor([[x], [y]])
        nearest = torch.minimum(torch.maximum(centre, TILE * tile), TILE * tile + TILE - 1)
        inside = (tile >= 0).all(0) & (TILE * tile[0] < cam.width) & (TILE * tile[1] < cam.height)
        total += int((inside & (((nearest - centre) ** 2).sum(0) <= radius**2)).sum())
    return total


def work(gaussians: Gaussians, cam: PinholeCamera) -> tuple[Work, Work]:
    """Returns the work of the forward and of the backward pass."""
    entries, count, pixels = touched_tiles(gaussians, cam), len(gaussians), cam.width * cam.height
    forward = Work(
        entries * (TILE**2 * FORWARD_OPERATIONS + 2 * TILE * EXPONENTIAL_OPERATIONS) + count * PROJECTION_OPERATIONS,
        4 * (count * (2 * 8 + 3) + 2 * entries + 5 * pixels),  # parameters, splats, tiles; lists; images
    )
    backward = Work(
        entries * (TILE**2 * BACKWARD_OPERATIONS + 2 * TILE * EXPONENTIAL_OPERATIONS) + count * PROJECTION_OPERATIONS,
        4 * (count * (8 + 8 + 8) + entries + 10 * pixels),  # splats, their gradients, the parameters'; lists; images
    )
    return forward, backward


def best_rates(threads: int) -> Work:
    """Returns the rates per second on this many cores: operations in a matrix product, bytes in a copy."""
    torch.set_num_threads(threads)
    matrix, long = torch.rand(1024, 1024), torch.rand(32_000_000)
    product, copied = torch.empty_like(matrix), torch.empty_like(long)
    operations = 2 * 1024**3 / (1e-3 * min(timed_ms(lambda: torch.mm(matrix, matrix, out=product), 10)))
    moved = 2 * 4 * len(long) / (1e-3 * min(timed_ms(lambda: copied.copy_(long), 5)))
    torch.set_num_threads(1)
    return Work(operations, moved)


def print_roofline() -> None:
    """Print the shortest possible times of the passes in the table above."""
    print('\n| threads | Gflop/s | GB/s | image | forward: Mflop, MB | roofline ms | backward: Mflop, MB | roofline ms |')
    print('|' + '---|' * 8)
    for threads in (1, 2):
        rates = best_rates(threads)
        for size in SIZES:
            cam = camera(*size)
            passes = work(wavy_wall(cam), cam)
            cells = [f'{w.operations / 1e6:.0f}, {w.moved / 1e6:.0f} | {w.roofline_ms(rates):.1f}' for w in passes]
            best = f'{rates.operations / 1e9:.0f} | {rates.moved / 1e9:.1f}'
            print(f'| {threads} | {best} | {cam.width}x{cam.height} | {cells[0]} | {cells[1]} |', flush=True)


def native() -> Iterator[tuple[str, CpuRasterizer, PinholeCamera, int]]:
    """Yields name, rasterizer, camera and threads for each line about the native code."""
    for size, threads in itertools.product(SIZES, (1, 2)):
        rasterizer = CpuRasterizer(threads)
        name = f'cpu, {rasterizer.instruction_set}, {threads} thread{"s"[: threads - 1]}'
        yield name, rasterizer, camera(*size), threads


@contextmanager
def instruction_set(name: str) -> Iterator[None]:
    """Limits what is made in the block to an instruction set."""
    before = os.environ.get('SPLATAM_ISA')
    os.environ['SPLATAM_ISA'] = name
    try:
        yield
    finally:
        os.environ.pop('SPLATAM_ISA')
        if before is not None:
            os.environ['SPLATAM_ISA'] = before


def passes(name: str, cam: PinholeCamera) -> dict[str, Callable[[], float]]:
    """Returns functions that run a pass of an instruction set once and return its time in milliseconds."""
    with instruction_set(name):
        rasterizer, aligner = CpuRasterizer(1), make_native_aligner(1)
    if rasterizer.instruction_set != name:
        raise SystemExit(f'this processor runs {rasterizer.instruction_set}, not {name}')
    still, config, wall, view = wavy_wall(cam), load_config('realtime'), GaussianMap(), wall_view(cam)
    wall.append(wavy_wall(cam))
    moving, pose = with_gradients(still), torch.eye(4)
    pose[0, 3] = 0.003
    target = Target(cam, view.rgb8, view.depth, pose, config.mapping.color_weight, config.mapping.depth_weight)
    brightness, motion = still.rgb.mean(1).view(cam.height, cam.width).numpy(), pose.numpy()
    layers = aligner.layers(brightness, view.depth.numpy(), 0.05)

    def to_map() -> float:
        render = rasterizer.render(moving, cam, pose)
        return once_ms(lambda: backward(render))

    at = Linearization(
        camera=cam, brightness=brightness, depth=view.depth.numpy(), layers=layers, color_motion=motion, depth_motion=motion,
        velocity=np.zeros(6, np.float32), gain=1.0, bias=0.0, photometric_scale=0.05, depth_scale=0.02, max_depth_ratio=0.1,
        readout=np.zeros(6, np.float32),
    )  # fmt: skip

    def align() -> object:
        return aligner.linearize(at, inlier_color=0.1, inlier_depth=0.05)

    return {
        'forward': lambda: once_ms(lambda: rasterizer.render(still, cam, pose)),
        'backward, map': to_map,
        'fit': lambda: once_ms(lambda: rasterizer.fit(wall.gaussians, wall.moments, optimizers.rates(config.mapping), target)),
        'align, one iteration': lambda: once_ms(align),
    }


def once_ms(function: Callable[[], object]) -> float:
    """Returns the wall time of one run, in milliseconds."""
    start = time.perf_counter()
    function()
    return 1e3 * (time.perf_counter() - start)


def compare(names: list[str], runs: int) -> None:
    """Print the times of several instruction sets, and their ratio to those of the last one."""
    print('| pass | image | ' + ' | '.join(f'{name} ms' for name in names) + f' | times {names[-1]} |')
    print('|' + '---|' * (len(names) + 3))
    for size in SIZES:
        sets = [passes(name, camera(*size)) for name in names]
        for name in sets[0]:
            times = [[one[name]() for one in sets] for _ in range(runs + 1)][1:]  # the first is a warm-up
            medians = [statistics.median(column) for column in zip(*times, strict=True)]
            cells = ' | '.join(f'{median:.2f}' for median in medians)
            ratios = ', '.join(f'{median / medians[-1]:.2f}' for median in medians[:-1])
            print(f'| {name} | {size[0]}x{size[1]} | {cells} | {ratios} |', flush=True)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--runs', type=int, default=20)
    parser.add_argument('--compare', nargs='+', metavar='ISA', help='generic, avx2, avx512: compare these')
    options = parser.parse_args()
    runs = options.runs
    torch.set_num_threads(1)
    print_header('Rasterizer kernels', runs)
    if options.compare:
        compare(options.compare, runs)
        return
    print('| backend | image | forward ms | backward, map ms | backward, pose ms | forward + backward, map ms |')
    print('|---|---|---|---|---|---|')
    for name, rasterizer, cam, _ in native():
        row(name, rasterizer, cam, runs)
        row(f'{name}, anisotropic', rasterizer, cam, runs, anisotropic=True)
    small = camera(64, 48)
    for name in ('cpu', 'reference'):
        row(f'{name}, 1 thread', make_rasterizer(name, 1), small, runs)
    print('\n| backend | image | alignment of a frame, ms | fused optimizer step, ms |')
    print('|---|---|---|---|')
    for name, rasterizer, cam, threads in native():
        realtime_row(name, rasterizer, cam, runs, threads)
    for name in ('cpu', 'reference'):
        realtime_row(f'{name}, 1 thread', make_rasterizer(name, 1), small, runs, 1)
    print_roofline()


if __name__ == '__main__':
    main()
