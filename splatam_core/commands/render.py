"""``splatam render``: renders a run's map along a path."""

from __future__ import annotations

import argparse
from pathlib import Path

from splatam_core.commands.shared import Command, add_run_argument, open_run, positive, progress
from splatam_core.errors import RunFolderError


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    add_run_argument(parser)
    parser.add_argument(
        '--poses', type=Path, metavar='FILE',
        help="TUM trajectory in the map's world frame, which is the run's first camera (default: the run's own trajectory)",
    )  # fmt: skip
    parser.add_argument('--out', type=Path, required=True, metavar='DIR', help='folder for images and videos')
    parser.add_argument('--width', type=positive, metavar='W', help="width of the images in pixels (default: the run's)")
    parser.add_argument('--rate', type=positive, metavar='HZ', help='frame rate of the videos (default: that of the poses)')
    parser.add_argument('--no-images', action='store_true', help='write videos only')
    parser.add_argument('--no-video', action='store_true', help='write images only')


def render(args: argparse.Namespace) -> int:
    """Renders a run's map along a path."""
    from splatam_core.atomic_io import new_folder
    from splatam_core.geometry.trajectory import read_trajectory
    from splatam_core.maps.video import median_rate_hz, render_along
    from splatam_core.rasterizer import rasterizer_for
    from splatam_core.runs.layout import check_is_free

    if args.no_images and args.no_video:
        raise RunFolderError('--no-images and --no-video together leave nothing to write')
    run = open_run(args.dir, args.device)
    camera, (rasterizer, device) = run.camera_or_error(), rasterizer_for(run.config)
    gaussians = run.read_map().to(device)
    path = run.trajectory if args.poses is None else read_trajectory(args.poses)
    if len(path) == 0:
        raise RunFolderError(f'{args.poses or args.dir}: there is no pose to render from')
    if args.width is not None:
        camera = camera.resized(args.width, max(1, round(camera.height * args.width / camera.width)))
    rate_hz = None if args.no_video else args.rate or median_rate_hz(path)
    check_is_free(args.out)
    try:
        with new_folder(args.out) as folder:
            render_along(
                gaussians, rasterizer, camera, path, folder,
                images=not args.no_images, rate_hz=rate_hz, progress=progress('rendering', 'view'),
            )  # fmt: skip
    except OSError as error:
        raise RunFolderError(f'{args.out}: cannot be written: {error.strerror}; choose another folder') from None
    at = '' if rate_hz is None else f', videos at {rate_hz:g} Hz'
    print(f'{len(path)} views of {camera.width}x{camera.height} are in {args.out}{at}')
    return 0


COMMAND = Command('render', "render a run's map along a path: colour, depth, silhouette", _add_arguments, render)
