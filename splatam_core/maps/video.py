"""Renders of a map along a path: images and videos of colour, depth and silhouette."""

from __future__ import annotations

import errno
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from splatam_core.device import pose_tensor
from splatam_core.errors import RasterizerError
from splatam_core.geometry import se3
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.geometry.trajectory import Trajectory
from splatam_core.rasterizer import Gaussians, Rasterizer
from splatam_core.types import RenderedView

KINDS = ('color', 'depth', 'silhouette')
DEPTH_COUNTS_PER_M = 1000
MAX_COUNT = 65535
CODEC = 'mp4v'
MIN_RATE_HZ, MAX_RATE_HZ = 1.0, 120.0

Picture = NDArray[np.uint8]


def render_along(
    gaussians: Gaussians,
    rasterizer: Rasterizer,
    camera: PinholeCamera,
    path: Trajectory,
    folder: Path,
    *,
    images: bool,
    rate_hz: float | None,
    progress: Callable[[range], Iterable[int]],
) -> None:
    """Render a map from each pose of a path and write the images and videos.

    The files written are::

        color/000000.png       8 bit RGB
        depth/000000.png       16 bit millimetres, expected depth; 0 = none
        silhouette/000000.png  8 bit, 255 = fully covered by the map
        color.mp4 depth.mp4 silhouette.mp4  depth from near (yellow) to far (blue), black = none

    Args:
        gaussians: the map, on the rasterizer's device.
        rasterizer: renders the map.
        camera: the camera to render with.
        path: the poses to render from, in the map's world.
        folder: an existing empty folder.
        images: True to write the images.
        rate_hz: frame rate of the videos; None writes no videos.
        progress: wraps the loop over the poses, to display progress.

    Raises:
        RasterizerError: this OpenCV build cannot write the videos, or an image is too large.
        OSError: the folder cannot be written.
    """
    map_only = gaussians.detached()
    far_m: float | None = None  # one depth scale for the whole video, set by the first view that has depth: no flicker
    with ExitStack() as stack:
        films = {} if rate_hz is None else {kind: _film(stack, folder, kind, camera, rate_hz) for kind in KINDS}
        for kind in KINDS if images else ():
            (folder / kind).mkdir()
        for index in progress(range(len(path))):
            T_cam_world = pose_tensor(se3.inverse(path.T_world_cam[index]), map_only.means.device)
            with torch.no_grad():
                view = rasterizer.render(map_only, camera, T_cam_world).images()
            far_m = far_m or float(view.depth_m.max()) or None
            if images:
                _write_images(folder, index, view)
            for kind, film in films.items():
                film.write(_film_picture(kind, view, far_m or 1.0))
    for kind in films:
        _check_is_whole(folder / f'{kind}.mp4', len(path))


def median_rate_hz(path: Trajectory) -> float:
    """Return the median rate of a path's poses, limited to the frame rates that videos support."""
    if len(path) < 2:
        return MIN_RATE_HZ
    return float(np.clip(1e9 / np.median(np.diff(path.stamps_ns)), MIN_RATE_HZ, MAX_RATE_HZ))


def _film(stack: ExitStack, folder: Path, kind: str, camera: PinholeCamera, rate_hz: float) -> cv2.VideoWriter:
    path = folder / f'{kind}.mp4'
    film = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*CODEC), rate_hz, (camera.width, camera.height))
    stack.callback(film.release)
    if not film.isOpened():
        raise RasterizerError(f'{path}: this OpenCV build cannot write {CODEC} videos; skip them with --no-video')
    return film


def _check_is_whole(film: Path, num_pictures: int) -> None:
    """Checks that a video holds as many pictures as were written to it; OpenCV does not notice a full disk.

    Raises:
        OSError: it does not.
    """
    reader = cv2.VideoCapture(str(film))
    num_found = int(reader.get(cv2.CAP_PROP_FRAME_COUNT)) if reader.isOpened() else 0
    reader.release()
    if num_found != num_pictures:
        raise OSError(errno.ENOSPC, f'{film.name} holds {num_found} of {num_pictures} pictures; is the disk full?', str(film))


def _film_picture(kind: str, view: RenderedView, far_m: float) -> Picture:
    """Return the video frame [H, W, 3] in BGR, as OpenCV expects it."""
    if kind == 'color':
        return np.ascontiguousarray(view.rgb[..., ::-1])
    if kind == 'silhouette':
        return np.repeat(_silhouette(view)[..., None], 3, axis=2)
    nearness = 1 - np.clip(view.depth_m / far_m, 0, 1)
    colored = np.asarray(cv2.applyColorMap(_to_bytes(nearness), cv2.COLORMAP_VIRIDIS), np.uint8)
    colored[view.depth_m == 0] = 0
    return colored


def _write_images(folder: Path, index: int, view: RenderedView) -> None:
    depth = np.rint(np.clip(view.depth_m * DEPTH_COUNTS_PER_M, 0, MAX_COUNT)).astype(np.uint16)
    pictures: dict[str, NDArray[np.integer]] = {'color': view.rgb[..., ::-1], 'depth': depth, 'silhouette': _silhouette(view)}
    for kind, picture in pictures.items():
        is_encoded, png = cv2.imencode('.png', picture)  # cv2.imwrite does not notice a full disk
        if not is_encoded:
            raise RasterizerError(f'{kind} of {picture.shape[1]}x{picture.shape[0]} pixels cannot be written as PNG')
        (folder / kind / f'{index:06d}.png').write_bytes(png.tobytes())


def _silhouette(view: RenderedView) -> Picture:
    return _to_bytes(np.clip(view.silhouette, 0, 1))


def _to_bytes(values: NDArray[np.floating]) -> Picture:
    """Scale values in [0, 1] to 0..255."""
    return np.rint(255 * values).astype(np.uint8)
