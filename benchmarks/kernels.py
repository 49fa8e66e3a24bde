"""Times of the rasterizer's passes: one Gaussian per pixel, as a fresh map has them.

    python benchmarks/kernels.py [--runs 20]

Forward is everything from the parameters to the images, projection, sorting and binning included; backward is
everything from the images' gradients to the parameters' (map) or to the pose's alone (pose).
"""

from __future__ import annotations

import argparse
import statistics
from dataclasses import replace

import torch
from header import print_header, timed_ms

from splatam_core.camera import PinholeCamera
from splatam_core.rasterizer import Gaussians, Rasterizer, Render, make_rasterizer
from splatam_core.rasterizer.cpu import CpuRasterizer

SIZES = ((320, 240), (640, 480))


def camera(width: int, height: int) -> PinholeCamera:
    """Of about 63 degrees."""
    focal = 525.0 * width / 640
    return PinholeCamera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def wavy_wall(cam: PinholeCamera) -> Gaussians:
    """One Gaussian per pixel, one pixel wide, opacity one half, between 1 and 3 m."""
    v, u = torch.meshgrid(torch.arange(cam.height), torch.arange(cam.width), indexing='ij')
    z = 2 + 0.5 * torch.sin(u / 37) + 0.5 * torch.cos(v / 23)
    means = torch.stack([(u - cam.cx) / cam.fx * z, (v - cam.cy) / cam.fy * z, z], -1).reshape(-1, 3)
    rgb = torch.rand(len(means), 3, generator=torch.Generator().manual_seed(0))
    return Gaussians(means, torch.log(means[:, 2:] / cam.fx), torch.zeros(len(means)), rgb)


def with_gradients(gaussians: Gaussians) -> Gaussians:
    """Leaves that collect gradients."""
    g = gaussians.detached()
    names = [name for name in ('means', 'log_scales', 'logit_opacities', 'rgb', 'rotations') if getattr(g, name) is not None]
    return replace(g, **{name: getattr(g, name).requires_grad_() for name in names})


def backward(render: Render) -> None:
    """From gradients of one in every value of every image."""
    outputs = [render.rgb, render.depth_acc, render.silhouette]
    torch.autograd.backward(outputs, [torch.ones_like(output) for output in outputs])


def row(name: str, rasterizer: Rasterizer, cam: PinholeCamera, runs: int, anisotropic: bool = False) -> None:
    """One line of the table: medians and the spread of forward plus backward."""
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


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--runs', type=int, default=20)
    runs = parser.parse_args().runs
    torch.set_num_threads(1)
    print_header('Rasterizer kernels', runs)
    print('| backend | image | forward ms | backward, map ms | backward, pose ms | forward + backward, map ms |')
    print('|---|---|---|---|---|---|')
    for size in SIZES:
        for threads in (1, 2):
            rasterizer = CpuRasterizer(threads)
            name = f'cpu, {rasterizer.instruction_set}, {threads} thread{"s"[: threads - 1]}'
            row(name, rasterizer, camera(*size), runs)
            row(f'{name}, anisotropic', rasterizer, camera(*size), runs, anisotropic=True)
    small = camera(64, 48)
    for name in ('cpu', 'reference'):
        row(f'{name}, 1 thread', make_rasterizer(name, 1), small, runs)


if __name__ == '__main__':
    main()
