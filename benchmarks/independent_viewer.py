"""Our map in a viewer that others wrote: its picture beside ours, from the same pose.

    python benchmarks/independent_viewer.py RUN [--frames 0,150,299] [--width 640] [--out DIR]

The viewer is Spark (three.js) from npm, in Chromium without a screen and with graphics in software. It reads the run's map as
``splatam export`` writes it: ``.ply``, ``.ply`` with spherical harmonics, ``.splat``. PSNR is over the whole image. The two differ
where the contract of our rasterizer differs from 3DGS': round footprints, black beyond the map. Needs npm, Chromium and Playwright.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from header import print_header
from numpy.typing import NDArray

from splatam_core.device import pose_tensor
from splatam_core.geometry import se3
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.maps.ply import write_ply
from splatam_core.maps.splat import write_splat
from splatam_core.maps.viewer.browser import FLAGS, find_browser
from splatam_core.rasterizer import rasterizer_for
from splatam_core.runs.record import read_run

PACKAGES = ('@sparkjsdev/spark@2.2.0', 'three@0.180.0')
FILES = ('map.ply', 'map_sh3.ply', 'map.splat')
NEAR_M, FAR_M = 0.05, 100.0
DRAWN_FRAMES = 12  # the viewer sorts in the background

PAGE = """<!DOCTYPE html>
<meta charset="utf-8"><style>body { margin: 0; background: #000; } canvas { display: block; }</style>
<script type="importmap">{"imports": {
  "three": "/node_modules/three/build/three.module.js",
  "three/addons/": "/node_modules/three/examples/jsm/",
  "@sparkjsdev/spark": "/node_modules/@sparkjsdev/spark/dist/spark.module.js"}}</script>
<script type="module">
import * as THREE from 'three';
import { SparkRenderer, SplatMesh } from '@sparkjsdev/spark';
const renderer = new THREE.WebGLRenderer({ preserveDrawingBuffer: true });
renderer.setSize(innerWidth, innerHeight, false);
document.body.append(renderer.domElement);
const scene = new THREE.Scene();
scene.add(new SparkRenderer({ renderer }));
const camera = new THREE.PerspectiveCamera();
camera.matrixAutoUpdate = false;
let mesh = null;
window.load = async (url) => {
  if (mesh) { scene.remove(mesh); mesh.dispose(); }
  mesh = new SplatMesh({ url });
  await mesh.initialized;
  scene.add(mesh);
};
window.show = async (pose, projection, frames) => {
  camera.matrix.fromArray(pose);
  camera.matrix.decompose(camera.position, camera.quaternion, camera.scale);
  camera.updateMatrixWorld(true);
  camera.projectionMatrix.fromArray(projection);
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  for (let i = 0; i < frames; i++) {
    renderer.render(scene, camera);
    await new Promise((done) => setTimeout(done, 25));
  }
};
window.ready = true;
</script>
"""


def projection(camera: PinholeCamera) -> NDArray[np.float64]:
    """Returns the [4, 4] projection of OpenGL with a camera's intrinsics; pixel centres are whole numbers."""
    P = np.zeros((4, 4))
    P[0, 0], P[1, 1] = 2 * camera.fx / camera.width, 2 * camera.fy / camera.height
    P[0, 2] = 1 - 2 * (camera.cx + 0.5) / camera.width
    P[1, 2] = 2 * (camera.cy + 0.5) / camera.height - 1
    P[2, 2], P[2, 3], P[3, 2] = -(FAR_M + NEAR_M) / (FAR_M - NEAR_M), -2 * FAR_M * NEAR_M / (FAR_M - NEAR_M), -1
    return P


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """Serve a folder. Yields its address."""
    command = [sys.executable, '-u', '-m', 'http.server', '0', '--bind', '127.0.0.1', '--directory', str(folder)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    try:
        assert process.stdout is not None
        yield 'http://127.0.0.1:' + process.stdout.readline().split(' port ')[1].split()[0]
    finally:
        process.terminate()
        process.wait()


def pictures(page: Any, camera: PinholeCamera, poses: list[NDArray[np.float64]]) -> Iterator[NDArray[np.uint8]]:
    """Yields the viewer's picture [H, W, 3] from each pose."""
    to_opengl = np.diag([1.0, -1, -1, 1])  # y up, z backward
    for T_world_cam in poses:
        arguments = [(T_world_cam @ to_opengl).T.ravel().tolist(), projection(camera).T.ravel().tolist(), DRAWN_FRAMES]
        page.evaluate('([pose, projection, frames]) => window.show(pose, projection, frames)', arguments)
        encoded = np.frombuffer(page.screenshot(), np.uint8)
        yield np.asarray(cv2.cvtColor(np.asarray(cv2.imdecode(encoded, cv2.IMREAD_COLOR)), cv2.COLOR_BGR2RGB), np.uint8)


def psnr_db(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> float:
    """Returns the PSNR of two images."""
    error = ((a.astype(np.float64) - b) ** 2).mean()
    return float(10 * np.log10(255**2 / max(error, 1e-12)))


def install(folder: Path) -> None:
    """Install the viewer with npm.

    Raises:
        SystemExit: npm fails.
    """
    (folder / 'package.json').write_text(json.dumps({'name': 'viewer', 'private': True}))
    done = subprocess.run(['npm', 'install', '--no-fund', '--no-audit', '--ignore-scripts', *PACKAGES], cwd=folder, check=False)
    if done.returncode != 0:
        sys.exit('npm cannot install the viewer')
    (folder / 'index.html').write_text(PAGE)


def main() -> None:
    """Render, compare and print the table."""
    from playwright.sync_api import sync_playwright

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('run', type=Path, metavar='RUN', help='run folder')
    parser.add_argument('--frames', default='0,-1', help='frames with a pose, by number (default: %(default)s)')
    parser.add_argument('--width', type=int, default=640)
    parser.add_argument('--out', type=Path, help='folder for the pictures, ours beside theirs')
    args = parser.parse_args()
    run = read_run(args.run)
    gaussians, (rasterizer, device) = run.read_map(), rasterizer_for(run.config)
    camera = run.camera_or_error()
    camera = camera.resized(args.width, round(camera.height * args.width / camera.width))
    poses = [run.trajectory.T_world_cam[int(number)] for number in args.frames.split(',')]
    with torch.no_grad():
        ours = [
            rasterizer.render(gaussians.to(device), camera, pose_tensor(se3.inverse(pose), device)).images().rgb for pose in poses
        ]
    print_header(f'The map of {args.run.name} in Spark, {camera.width}x{camera.height}', 1)
    print('| file | frame | PSNR, dB |')
    print('|---|---|---|')
    with tempfile.TemporaryDirectory() as scratch, sync_playwright() as playwright:
        folder = Path(scratch)
        install(folder)
        write_ply(folder / FILES[0], gaussians)
        write_ply(folder / FILES[1], gaussians, sh_degree=3)
        write_splat(folder / FILES[2], gaussians)
        browser = playwright.chromium.launch(executable_path=find_browser(), args=list(FLAGS[1:]))
        page = browser.new_page(viewport={'width': camera.width, 'height': camera.height})
        page.set_default_timeout(120_000)
        with served(folder) as address:
            page.goto(address)
            page.wait_for_function('window.ready')
            for name in FILES:
                page.evaluate('(url) => window.load(url)', f'/{name}')
                for number, (own, other) in enumerate(zip(ours, pictures(page, camera, poses), strict=True)):
                    print(f'| {name} | {args.frames.split(",")[number]} | {psnr_db(own, other):.1f} |', flush=True)
                    if args.out is not None:
                        args.out.mkdir(parents=True, exist_ok=True)
                        cv2.imwrite(str(args.out / f'{name}_{number}.png'), np.hstack([own, other])[:, :, ::-1])
        browser.close()


if __name__ == '__main__':
    main()
