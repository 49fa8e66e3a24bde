"""Results do not depend on the number of threads, bit for bit; calls may come from several threads at once."""

from __future__ import annotations

import dataclasses
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch
from rasterizer_scenes import Scene, anisotropic_scene, device_of, on_device, random_scene, render_with_gradients

from splatam_core import _native
from splatam_core.config import load_config
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.maps.ply import write_ply
from splatam_core.rasterizer import Gaussians, Moments, Rates, Target, make_rasterizer
from splatam_core.rasterizer.native import make_native_aligner
from splatam_core.slam import Slam
from splatam_core.tracking.aligner import Linearization
from splatam_core.types import FrameResult, RgbdFrame, Status
from splatam_core.worker import SlamWorker

NUMBERS = (1, 2, 3, 5)
WIDTH, HEIGHT = 150, 90  # no multiple of a tile; 12 rows of tiles
Arrays = Sequence[np.ndarray]


def scene(count: int = 3000) -> Scene:
    """Gaussians that touch one to four rows of tiles, in three blocks."""
    return random_scene(7, count, WIDTH, HEIGHT, sigma_px=3.0)


def drawn(threads: int, given: Scene) -> Arrays:
    """The images of a scene, and the gradients by all of its parameters and by the pose."""
    weights = torch.rand(5, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(1))
    image, gradients = render_with_gradients(make_rasterizer('cpu', threads), given, torch.float32, weights)
    return [image.numpy(), *(gradient.numpy() for gradient in gradients.values())]


def isotropic(threads: int) -> Arrays:
    return drawn(threads, scene())


def anisotropic(threads: int) -> Arrays:
    return drawn(threads, anisotropic_scene(7, 500, WIDTH, HEIGHT))


def fitted(threads: int) -> Arrays:
    """The map after three steps, the optimizer's state and the losses."""
    given, cpu = scene(), make_rasterizer('cpu', threads)
    gaussians = on_device(given.gaussians, device_of('cpu'))
    n, generator = len(gaussians), torch.Generator().manual_seed(2)
    moments = Moments(torch.zeros(n, 16), torch.zeros(n, dtype=torch.uint8))
    rgb8 = torch.randint(0, 256, (HEIGHT, WIDTH, 3), generator=generator, dtype=torch.uint8)
    depth = 1 + torch.rand(HEIGHT, WIDTH, generator=generator)
    target = Target(given.camera, rgb8, depth, given.T_cam_world.float(), 0.5, 1.0)
    losses = [cpu.fit(gaussians, moments, Rates(1e-3, 1e-2, 0.05, 0.01), target) for _ in range(3)]
    changed = gaussians.means, gaussians.log_scales, gaussians.logit_opacities, gaussians.rgb
    return [np.array(losses), *(values.numpy() for values in (*changed, moments.first_second, moments.steps))]


def aligned(threads: int) -> Arrays:
    """The linear system of an alignment, and the images that alignment prepares."""
    aligner, rng = make_native_aligner(threads), np.random.default_rng(3)
    brightness = rng.random((HEIGHT, WIDTH), dtype=np.float32)
    depth = (2 + 0.01 * rng.random((HEIGHT, WIDTH))).astype(np.float32)
    depth[rng.random((HEIGHT, WIDTH)) < 0.05] = np.nan
    layers, motion = aligner.layers(brightness, depth, 0.05), np.eye(4, dtype=np.float32)
    motion[:3, 3] = 0.01, -0.02, 0.005
    at = Linearization(
        camera=scene(1).camera, brightness=brightness, depth=depth, layers=layers, color_motion=motion, depth_motion=motion,
        velocity=np.full(6, 0.01, np.float32), gain=1.1, bias=0.05, photometric_scale=0.1, depth_scale=0.01, max_depth_ratio=0.1,
        readout=np.full(6, 0.02, np.float32),
    )  # fmt: skip
    system = aligner.linearize(at, inlier_color=0.3, inlier_depth=0.02)
    numbers = [system.cost, system.points, system.compared, system.seen, system.agreeing]
    numbers += [system.photometric_median, system.depth_median]
    return [
        system.H, system.g, system.H_by_time, system.H_by_time_squared, system.g_by_time, np.array(numbers), layers,
        *aligner.halve(brightness, depth, 0.05),
        *aligner.frame_images(rng.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8), depth, 4, 0.05),
        *aligner.render_images(rng.random((3, HEIGHT, WIDTH), dtype=np.float32), depth, brightness, 0.3, 1e-3),
    ]  # fmt: skip


CALLS = (isotropic, anisotropic, fitted, aligned)


def same(one: Arrays, other: Arrays) -> bool:
    """Whether every array is the same bit for bit; NaN marks pixels without depth."""
    return all(a.tobytes() == b.tobytes() for a, b in zip(one, other, strict=True))


@pytest.mark.parametrize('call', CALLS)
def test_results_are_the_same_with_any_number_of_threads(call: Callable[[int], Arrays]) -> None:
    expected = call(NUMBERS[0])
    assert all(np.isfinite(values).any() and values.any() for values in expected)
    for threads in NUMBERS[1:]:
        for _ in range(3):  # another thread takes another piece each time
            assert same(call(threads), expected)


def test_slam_is_the_same_with_any_number_of_threads(room: Callable[..., Sequence[RgbdFrame]]) -> None:
    """Poses and map of ten frames, and the map after it was refined."""
    frames, runs = room(frames=10, width=64), []
    for threads in NUMBERS:
        slam = Slam(load_config('realtime', [f'threads={threads}', 'keyframes.every=3', 'mapping.fused.final_passes=2']))
        results = [slam.process(frame) for frame in frames]
        assert all(result.status in (Status.INITIALIZED, Status.TRACKED) for result in results)
        live = slam.snapshot()
        slam.finish()
        runs.append([np.array([result.T_world_cam for result in results]), live.means, live.rgb, slam.snapshot().means])
    for run in runs[1:]:
        assert same(run, runs[0])


def test_several_threads_may_use_the_native_code_at_once() -> None:
    """A caller that finds the pool taken does its work alone. The same engine draws for all."""
    given, cpu = scene(), make_rasterizer('cpu', 3)
    gaussians, T = on_device(given.gaussians, 'cpu'), given.T_cam_world.float()

    def render(_: int) -> Arrays:
        render = cpu.render(gaussians, given.camera, T)
        return [render.rgb.numpy(), render.depth_acc.numpy(), render.silhouette.numpy()]

    calls = [render, *CALLS] * 4
    expected = [render(0), *(call(1) for call in CALLS)] * 4
    with ThreadPoolExecutor(5) as executor:
        found = list(executor.map(lambda call: call(2), calls))
    for one, other in zip(found, expected, strict=True):
        assert same(one, other)


def resident_bytes() -> int:
    """Memory of this process, as the kernel counts it."""
    return int(Path('/proc/self/statm').read_text().split()[1]) * 4096


@pytest.mark.skipif('SPLATAM_NATIVE' in os.environ, reason='sanitizers take memory of their own')
def test_memory_of_gradients_does_not_grow_with_threads() -> None:
    """It used to be 32 bytes for each Gaussian of the map and each thread: 307 MB here, whatever the view shows of it."""
    count, threads = 300_000, 32
    size, pose = (HEIGHT, WIDTH), np.eye(4, dtype=np.float32)
    gaussians = {
        'means': np.zeros((count, 3), np.float32), 'log_scales': np.full((count, 1), -3, np.float32),
        'logit_opacities': np.zeros(count, np.float32), 'rgb': np.ones((count, 3), np.float32),
    }  # fmt: skip
    gaussians['means'][:100, 2] = 2.0  # the others are not before the camera
    images = [np.zeros(shape, np.float32) for shape in ((3, *size), size, size)]
    gradients = {f'{name}_gradient': np.zeros_like(values) for name, values in gaussians.items()}
    engine, camera = _native.Engine(threads), scene(1).camera
    view = engine.forward(
        **gaussians, bounds=None, T_cam_world=pose, camera=camera, image=images[0], depth=images[1], silhouette=images[2]
    )
    before = resident_bytes()
    engine.backward(
        view, **gaussians, image_gradients=[np.ones_like(image) for image in images], **gradients,
        pose_gradient=np.zeros((4, 4), np.float32),
    )  # fmt: skip
    assert gradients['rgb_gradient'][:100].any() and not gradients['rgb_gradient'][100:].any()
    assert resident_bytes() - before < 40_000_000  # the gradients that are returned take 10 MB


@pytest.mark.skipif('SPLATAM_NATIVE' in os.environ, reason='sanitizers take memory of their own')
def test_memory_of_a_tile_does_not_grow_with_what_lies_in_it() -> None:
    """Half a kilobyte is kept for each Gaussian in a tile, but for two thousand at once: for all it would be 155 MB here."""
    count = 300_000
    faint = Gaussians(torch.ones(count, 3), torch.full((count, 1), 3.0), torch.full((count,), -5.5), torch.ones(count, 3))
    moments = Moments(torch.zeros(count, 16), torch.zeros(count, dtype=torch.uint8))
    target = Target(
        PinholeCamera(8, 8, 8.0, 8.0, 3.5, 3.5), torch.zeros(8, 8, 3, dtype=torch.uint8), torch.ones(8, 8), torch.eye(4), 1.0, 1.0
    )
    cpu = make_rasterizer('cpu', 1)
    cpu.render(faint, target.camera, torch.eye(4))
    before = resident_bytes()
    cpu.fit(faint, moments, Rates(0.1, 0.0, 0.0, 0.0), target)
    assert moments.steps.any()
    assert resident_bytes() - before < 60_000_000  # moments that are written for the first time take 19 MB, gradients 10 MB


def test_a_node_may_render_save_and_reset_while_it_processes(room: Callable[..., Sequence[RgbdFrame]], tmp_path: Path) -> None:
    """As the services of the node do, each from a thread of its own. ``make sanitize-threads`` looks for races."""
    frames = list(room(frames=10, width=64))
    frames += [dataclasses.replace(frame, stamp_ns=frame.stamp_ns + 10**10) for frame in frames]
    results: list[FrameResult] = []
    failures: list[Exception] = []
    slam = Slam(load_config('realtime', ['threads=3', 'mapping.first_iterations=6', 'mapping.iterations=3']))

    worker = SlamWorker(
        slam, lambda _, result: results.append(result), lambda _, error: failures.append(error), queue_size=2, when_full='block'
    )
    done = threading.Event()
    gaussians, cpu = on_device(scene().gaussians, 'cpu'), make_rasterizer('cpu', 2)

    def repeat(work: Callable[[], object]) -> None:
        while not done.wait(0.001):
            try:
                work()
            except Exception as error:  # noqa: BLE001 - the test reports it
                failures.append(error)
                return

    def save() -> None:
        worker.call(lambda slam: write_ply(tmp_path / 'map.ply', slam.map.gaussians.detached())).result()

    def view() -> None:
        cpu.render(gaussians, scene(1).camera, torch.eye(4))

    def look() -> None:
        worker.call(lambda slam: slam.render(np.eye(4)) if slam.camera is not None else None).result()

    threads = [threading.Thread(target=repeat, args=[work]) for work in (save, view, look)]
    for thread in threads:
        thread.start()
    for index, frame in enumerate(frames):
        worker.submit(frame)
        if index == 10:
            worker.call(lambda slam: slam.reset())
    while worker.pending:
        done.wait(0.01)
    done.set()
    for thread in threads:
        thread.join()
    worker.stop(drain=True)
    assert not failures
    assert len(results) == len(frames)
    assert sum(result.status is Status.INITIALIZED for result in results) == 2
