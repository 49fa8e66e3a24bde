"""GPU benchmarks: times beside gsplat and the reference, frames per second, agreement with the CPU, profile of one frame.

    python benchmarks/gpu.py [SOURCE] [--width W] [--only kernels,frames,agreement,profile]

SOURCE is a recording (default: the synthetic room). At most 100 frames of it are read, before any clock starts. gsplat is
compared if it is installed (pip install gsplat). ``--device cpu`` tests this script on a machine without a GPU, with tiny
sizes and Triton's interpreter; its times mean nothing.

kernels: Gaussians one pixel wide, opacity 0.5, at random over the view at a depth of 1 to 3 m. Forward covers everything from
the parameters to the images; backward ends at the gradients of the parameters (map) or of the pose alone (pose).
frames: presets ``splatam`` and ``realtime`` on the recording.
agreement: poses of GPU and CPU from the same state; then free runs of both, and of the CPU with another seed.
profile: the operations of one frame by device time.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from header import print_header
from kernels import camera, with_gradients
from numpy.typing import NDArray
from torch import Tensor

from splatam_core.config import apply_threads, load_config
from splatam_core.datasets.registry import open_sequence
from splatam_core.evaluation.images import ViewScorer
from splatam_core.geometry import se3
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.rasterizer import Gaussians, make_rasterizer
from splatam_core.slam import Slam
from splatam_core.types import RgbdFrame, Status

MAX_FRAMES = 100
PARTS = ('kernels', 'frames', 'agreement', 'profile')
REFERENCE_SCENE = (64, 48, 3000)  # width, height, Gaussians; the reference holds every pair of pixel and Gaussian in memory

Draw = Callable[[Gaussians, Tensor], list[Tensor]]  # from Gaussians and a pose [4, 4] to images


@dataclass(frozen=True, slots=True)
class Plan:
    """What to run, and where.

    Attributes:
        device: ``cuda``, or ``cpu`` to test the script.
        rasterizer: rasterizer of the SLAM runs.
        sizes: image sizes in the table of kernels.
        counts: numbers of Gaussians in that table.
        runs: number of timed runs for each of its lines.
        frames: number of frames of the recording.
        settings: ``name=value`` settings of the SLAM runs, applied after the preset.
    """

    device: str
    rasterizer: str
    sizes: tuple[tuple[int, int], ...]
    counts: tuple[int, ...]
    runs: int
    frames: int
    settings: tuple[str, ...] = ()


GPU = Plan(
    device='cuda', rasterizer='triton', sizes=((640, 480), (1200, 680)), counts=(300_000, 1_000_000, 3_000_000), runs=20,
    frames=MAX_FRAMES,
)  # fmt: skip
TRIAL = Plan(
    device='cpu', rasterizer='triton', sizes=((32, 24),), counts=(100,), runs=1, frames=3,
    settings=('tracking.iterations=2', 'mapping.iterations=2', 'mapping.first_iterations=2', 'tracking.silhouette_threshold=0.5',
              'mapping.prune_scale=1.0'),
)  # fmt: skip


def finish() -> None:
    """Wait for the device."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def median_ms(function: Callable[[], object], runs: int) -> float:
    """Returns the median time of ``runs`` runs, after three that compile kernels and allocate memory."""
    times = []
    for _ in range(3 + runs):
        finish()
        start = time.perf_counter()
        function()
        finish()
        times.append(1e3 * (time.perf_counter() - start))
    return statistics.median(times[-runs:])


def scene(cam: PinholeCamera, count: int, device: str) -> Gaussians:
    """Returns Gaussians at random positions in the view and slightly beyond it."""
    generator = torch.Generator().manual_seed(0)
    u, v, noise = torch.rand(3, count, generator=generator)
    u, v = (1.1 * u - 0.05) * cam.width, (1.1 * v - 0.05) * cam.height
    z = 2 + 0.5 * torch.sin(u / 37) + 0.5 * torch.cos(v / 23) + 0.05 * noise
    means = torch.stack([(u - cam.cx) / cam.fx * z, (v - cam.cy) / cam.fy * z, z], dim=1)
    rgb = torch.rand(count, 3, generator=generator)
    return Gaussians(means, torch.log(z[:, None] / cam.fx), torch.zeros(count), rgb).to(torch.device(device))


def ours(name: str, cam: PinholeCamera) -> Draw:
    """Returns the drawing function of one of this project's rasterizers."""
    rasterizer = make_rasterizer(name)

    def draw(gaussians: Gaussians, pose: Tensor) -> list[Tensor]:
        render = rasterizer.render(gaussians, cam, pose)
        return [render.rgb, render.depth_acc, render.silhouette]

    return draw


def gsplat(cam: PinholeCamera) -> Draw | None:
    """Returns the drawing function of gsplat, or None if it is not installed.

    gsplat has no isotropic Gaussians, so it is given three radii and a rotation.
    """
    try:
        from gsplat import rasterization
    except ImportError:
        return None
    # In gsplat a pixel centre is at +0.5.
    K = torch.tensor([[cam.fx, 0, cam.cx + 0.5], [0, cam.fy, cam.cy + 0.5], [0, 0, 1]], device='cuda')

    def draw(gaussians: Gaussians, pose: Tensor) -> list[Tensor]:
        turned = gaussians.anisotropic()
        images, alphas, _ = rasterization(
            turned.means, turned.rotations, turned.log_scales.exp(), torch.sigmoid(turned.logit_opacities), turned.rgb,
            viewmats=pose[None], Ks=K[None], width=cam.width, height=cam.height, near_plane=0.2, render_mode='RGB+D', packed=False,
        )  # fmt: skip
        return [images, alphas]

    return draw


def kernel_row(name: str, draw: Draw, cam: PinholeCamera, still: Gaussians, runs: int) -> None:
    """Print a line of the table."""
    pose = torch.eye(4, device=still.means.device)
    pose[0, 3] = 0.003
    moving = with_gradients(still)
    if still.means.is_cuda:
        torch.cuda.reset_peak_memory_stats()
    with torch.no_grad():
        forward = median_ms(lambda: draw(still, pose), runs)
    both = median_ms(lambda: forth_and_back(draw, moving, pose), runs)
    to_pose = median_ms(lambda: forth_and_back(draw, still, pose.clone().requires_grad_()), runs)
    print(f'| {name} | {cam.width}x{cam.height} | {len(still):,} | {forward:.2f} | {both:.2f} | {to_pose:.2f} | {peak_mb()} |',
          flush=True)  # fmt: skip


def forth_and_back(draw: Draw, gaussians: Gaussians, pose: Tensor) -> None:
    """Run forward and backward passes, with a gradient of one for every value of every image."""
    images = draw(gaussians, pose)
    torch.autograd.backward(images, [torch.ones_like(image) for image in images])


def peak_mb() -> str:
    """Returns the peak of device memory since the last reset, in MiB."""
    return f'{torch.cuda.max_memory_allocated() / 2**20:.0f}' if torch.cuda.is_available() else '–'


def print_kernels(plan: Plan) -> None:
    """Part ``kernels``: times of the rasterizers."""
    print('| backend | image | Gaussians | forward ms | forward + backward, map ms | forward + backward, pose ms | peak MB |')
    print('|---|---|---|---|---|---|---|')
    for width, height in plan.sizes:
        cam = camera(width, height)
        for count in plan.counts:
            still = scene(cam, count, plan.device)
            kernel_row('triton', ours('triton', cam), cam, still, plan.runs)
            if plan.device == 'cuda' and (draw := gsplat(cam)) is not None:
                kernel_row('gsplat', draw, cam, still, plan.runs)
    width, height, count = REFERENCE_SCENE if plan.device == 'cuda' else (32, 24, 100)
    cam = camera(width, height)
    still = scene(cam, count, plan.device)
    for name in ('triton', 'reference'):
        kernel_row(name, ours(name, cam), cam, still, plan.runs)
    if plan.device != 'cuda' or gsplat(cam) is None:
        print('\ngsplat: not compared, ' + ('not installed.' if plan.device == 'cuda' else 'it needs a GPU.'))
    print()


def slam_of(plan: Plan, preset: str) -> Slam:
    """Returns a new Slam on the plan's device."""
    return Slam(load_config(preset, [*plan.settings, f'device={plan.device}', f'rasterizer={plan.rasterizer}']))


def host_slam(plan: Plan, preset: str, seed: int = 0) -> Slam:
    """Returns a new Slam on the CPU, with the native code."""
    return Slam(load_config(preset, [*plan.settings, f'seed={seed}', 'device=cpu', 'rasterizer=cpu']))


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """The results of processing a recording.

    Attributes:
        slam: the Slam with its map.
        poses: pose of each frame; None = lost.
        seconds: wall time of each frame.
        finish_s: wall time of ``Slam.finish``.
        rasterizer: name of the rasterizer.
    """

    slam: Slam
    poses: list[NDArray[np.float64] | None]
    seconds: list[float]
    finish_s: float
    rasterizer: str

    def psnr_db(self, frames: Sequence[RgbdFrame]) -> float:
        """Returns the mean PSNR of the final map at the estimated poses, over pixels with a depth reading."""
        scorer = ViewScorer(self.slam.map.gaussians, make_rasterizer(self.rasterizer), self.slam.config.depth)
        tracked = [(frame, pose) for frame, pose in zip(frames, self.poses) if pose is not None]
        scores = [scorer.score(frame, pose).scores.psnr_db for frame, pose in tracked]
        return float(np.mean([score for score in scores if score is not None]))


def run(slam: Slam, frames: Sequence[RgbdFrame], rasterizer: str) -> Run:
    """Process every frame, then finish. Each time includes waiting for the device."""
    poses, seconds = [], []
    for frame in frames:
        start = time.perf_counter()
        result = slam.process(frame)
        finish()
        seconds.append(time.perf_counter() - start)
        poses.append(None if result.status is Status.LOST else result.T_world_cam)
    start = time.perf_counter()
    slam.finish()
    finish()
    return Run(slam, poses, seconds, time.perf_counter() - start, rasterizer)


def print_frames(plan: Plan, frames: Sequence[RgbdFrame]) -> None:
    """Part ``frames``: frames per second and memory of the presets. A first run compiles the kernels."""
    print('| preset | image | frames | tracked | fps | ms per frame (median, p95) | Gaussians | peak MB |')
    print('|---|---|---|---|---|---|---|---|')
    for preset in ('splatam', 'realtime'):
        run(slam_of(plan, preset), frames[:2], plan.rasterizer)
        if plan.device == 'cuda':
            torch.cuda.reset_peak_memory_stats()
        done = run(slam_of(plan, preset), frames, plan.rasterizer)
        tracked = sum(pose is not None for pose in done.poses)
        median, p95 = (1e3 * float(np.percentile(done.seconds, share)) for share in (50, 95))
        size = f'{frames[0].camera.width}x{frames[0].camera.height}'
        print(f'| {preset} | {size} | {len(frames)} | {tracked} | {len(frames) / (sum(done.seconds) + done.finish_s):.2f} | '
              f'{median:.1f}, {p95:.1f} | {done.slam.num_gaussians:,} | {peak_mb()} |', flush=True)  # fmt: skip
    print()


def apart_mm(one: Sequence[NDArray[np.float64] | None], other: Sequence[NDArray[np.float64] | None]) -> NDArray[np.float64]:
    """Returns the distance between the camera positions of two runs, for each frame that both track, in millimetres."""
    return np.array([
        1e3 * float(np.linalg.norm(a[:3, 3] - b[:3, 3])) for a, b in zip(one, other) if a is not None and b is not None
    ])  # fmt: skip


def print_same_state(plan: Plan, preset: str, frames: Sequence[RgbdFrame]) -> None:
    """Part ``agreement``: GPU and CPU process every frame from the state that the CPU has reached."""
    host, there = host_slam(plan, preset), slam_of(plan, preset)
    here, poses = [], []
    for frame in frames:
        there.restore(host.state())
        poses.append(there.process(frame).T_world_cam)
        here.append(host.process(frame).T_world_cam)
    apart = apart_mm(here, poses)
    turned = [
        float(np.degrees(np.linalg.norm(se3.log(se3.inverse(a) @ b)[3:])))
        for a, b in zip(here, poses) if a is not None and b is not None
    ]  # fmt: skip
    lost = sum((a is None) != (b is None) for a, b in zip(here, poses))
    print(f'From the same state ({preset}, {len(frames)} frames): poses differ by {apart.max():.4f} mm and {max(turned):.5f} '
          f'degrees at most, median {np.median(apart):.4f} mm; limit 0.2 mm; {lost} frames tracked by only one of them.\n',
          flush=True)  # fmt: skip


def print_free_running(plan: Plan, preset: str, frames: Sequence[RgbdFrame]) -> None:
    """Part ``agreement``: compares the difference between GPU and CPU with that between two seeds on the CPU."""
    cpu, other = (run(host_slam(plan, preset, seed), frames, 'cpu') for seed in (0, 1))
    there = run(slam_of(plan, preset), frames, plan.rasterizer)
    rms = [float(np.sqrt(np.mean(apart_mm(cpu.poses, run_.poses) ** 2))) for run_ in (there, other)]
    psnr = [run_.psnr_db(frames) for run_ in (cpu, other, there)]
    print(f'| {preset}, {len(frames)} frames, free-running | poses apart, mm RMS | PSNR dB |\n|---|---|---|')
    print(f'| CPU, seed 0 | 0 | {psnr[0]:.2f} |\n| CPU, seed 1 | {rms[1]:.3f} | {psnr[1]:.2f} |')
    print(f'| {plan.rasterizer} on {plan.device}, seed 0 | {rms[0]:.3f} | {psnr[2]:.2f} |')
    print(f'\nLimits: {2 * rms[1]:.3f} mm (twice the difference between the seeds), and {psnr[0]:.2f} ± 0.1 dB.\n', flush=True)


def print_profile(plan: Plan, preset: str, frames: Sequence[RgbdFrame]) -> None:
    """Part ``profile``: prints the operations of the last frame by device time."""
    from torch.profiler import ProfilerActivity, profile

    slam = slam_of(plan, preset)
    for frame in frames[:-1]:
        slam.process(frame)
    on_gpu = plan.device == 'cuda'
    with profile(activities=[ProfilerActivity.CPU, *([ProfilerActivity.CUDA] if on_gpu else [])]) as profiled:
        slam.process(frames[-1])
        finish()
    order = 'self_device_time_total' if on_gpu else 'self_cpu_time_total'
    table = profiled.key_averages().table(sort_by=order, row_limit=20, max_name_column_width=60)
    print(f'Frame {len(frames)} of {preset}:\n\n```\n{table}\n```\n')


def plan_or_exit(device: str) -> Plan:
    """Returns the plan for a device. Exits with one line if there is no GPU."""
    if device == 'cpu':
        os.environ['TRITON_INTERPRET'] = '1'  # before triton is imported
        return TRIAL
    if not torch.cuda.is_available():
        sys.exit(f'benchmarks/gpu.py: torch {torch.__version__} finds no CUDA device; --device cpu tests the script without one')
    return GPU


def print_device() -> None:
    """Print GPU, CUDA and Triton versions."""
    if not torch.cuda.is_available():
        print('No GPU: Triton kernels are interpreted, so the times below mean nothing.\n')
        return
    import triton

    properties = torch.cuda.get_device_properties(0)
    runtime = torch.version.cuda or torch.version.hip
    print(f'{properties.name}, {properties.total_memory // 2**30} GB; CUDA or HIP {runtime}; triton {triton.__version__}.\n')


def main() -> None:
    """Print the chosen parts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('source', nargs='?', default='synthetic')
    parser.add_argument('--width', type=int, help='width of the frames (default: as recorded)')
    parser.add_argument('--preset', default='realtime', help='preset of agreement and profile (default: %(default)s)')
    parser.add_argument('--only', default=','.join(PARTS), help='parts to run, separated by commas (default: all)')
    parser.add_argument('--device', choices=('cuda', 'cpu'), default='cuda')
    arguments = parser.parse_args()
    plan = plan_or_exit(arguments.device)
    apply_threads(load_config())
    print_header('GPU', plan.runs)
    print_device()
    parts = arguments.only.split(',')
    if 'kernels' in parts:
        print_kernels(plan)
    if set(parts) & {'frames', 'agreement', 'profile'}:
        sequence = open_sequence(arguments.source, width=arguments.width, max_frames=plan.frames)
        frames = [sequence[index] for index in range(len(sequence))]
        if 'frames' in parts:
            print_frames(plan, frames)
        if 'agreement' in parts:
            print_same_state(plan, arguments.preset, frames)
            print_free_running(plan, arguments.preset, frames)
        if 'profile' in parts:
            print_profile(plan, arguments.preset, frames)


if __name__ == '__main__':
    main()
