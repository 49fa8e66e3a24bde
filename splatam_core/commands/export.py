"""``splatam export``: writes a run's map for other programs."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatam_core.commands.shared import (
    Command,
    add_device_argument,
    as_number,
    open_run,
    open_source,
    positive,
    progress,
    usable_ground_truth,
)
from splatam_core.errors import ExportError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from splatam_core.maps.export import Surface
    from splatam_core.maps.grid import DepthView
    from splatam_core.rasterizer import Gaussians
    from splatam_core.runs.record import RunRecord

SUFFIXES = {
    'gaussians': ('.ply', '.splat', '.spz'),
    'points': ('.ply',),
    'mesh': ('.ply',),
    'splatam': ('.npz',),
    'grid': ('.yaml',),
    'octomap': ('.bt',),
}
"""The forms of a map, and the files that each is written to."""

SMALLEST, LARGEST = 1e-6, 1e6


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        'dir', type=Path, metavar='DIR', help='run folder; for gaussians and points also a map of any program, .ply'
    )
    add_device_argument(parser, "device to compute on (default: as the run's settings say)")
    parser.add_argument(
        'file', type=Path, metavar='FILE',
        help='file to write: .ply, .splat or .spz (extra spz); .npz with --as splatam, .yaml with --as grid, .bt with --as octomap',
    )  # fmt: skip
    parser.add_argument(
        '--as', dest='form', choices=SUFFIXES, default='gaussians',
        help="'gaussians': for splat viewers (default); 'points': coloured centres; 'mesh': surface fused from rendered depth "
        "(needs pip install 'splatam_ros[mesh]'); 'splatam': params.npz for the original's programs; 'grid': floor plan for "
        "ROS' map_server, .yaml and .pgm; 'octomap': occupied and free voxels for OctoMap, .bt",
    )  # fmt: skip
    parser.add_argument('--overwrite', action='store_true', help='replace FILE')
    parser.add_argument(
        '--sh-degree', type=int, choices=range(4), default=0, metavar='D',
        help='gaussians, .ply: spherical harmonics up to degree D, zero above 0; some viewers accept only 3 (default: %(default)s)',
    )  # fmt: skip
    parser.add_argument(
        '--min-opacity',
        type=_number,
        default=0.5,
        metavar='O',
        help='points: skip Gaussians of lower opacity (default: %(default)s)',
    )
    parser.add_argument(
        '--voxel', type=_number, default=0.01, metavar='M', help='mesh: size of a voxel in metres (default: %(default)s)'
    )
    parser.add_argument(
        '--max-depth',
        type=_number,
        default=6.0,
        metavar='M',
        help='mesh, grid, octomap: ignore depth beyond M metres (default: %(default)s)',
    )
    parser.add_argument(
        '--every',
        type=positive,
        default=5,
        metavar='N',
        help='mesh, grid, octomap: look from every n-th frame (default: %(default)s)',
    )
    for name, metres, what in (
        ('resolution', 0.05, 'side of a cell; octomap: of a voxel'),
        ('min-height', 0.1, 'lowest obstacle over the floor'),
        ('max-height', 1.0, 'highest obstacle over the floor: the height of the robot'),
    ):
        parser.add_argument(
            f'--{name}', type=_number, default=metres, metavar='M', help=f'grid: {what}, metres (default: %(default)s)'
        )


def _number(text: str) -> float:
    value = as_number(text, float)
    if not SMALLEST <= value <= LARGEST:
        raise argparse.ArgumentTypeError(f'{text} is not a number above 0, from {SMALLEST:g} to {LARGEST:g}')
    return value


def export(args: argparse.Namespace) -> int:
    """Writes a run's map for other programs."""
    from splatam_core.runs.layout import why_not

    suffixes = SUFFIXES[args.form]
    if args.file.suffix.lower() not in suffixes:
        raise ExportError(f"{args.file}: '{args.file.suffix}' files are not written; name it {' or '.join(suffixes)}")
    if os.path.lexists(args.file) and not args.overwrite:
        raise ExportError(f'{args.file} exists: choose another name, or replace it with --overwrite')
    try:
        print(f'{_write(args)} are in {args.file}')
    except OSError as error:
        raise ExportError(f'{args.file}: cannot be written: {why_not(error)}') from None
    return 0


def _write(args: argparse.Namespace) -> str:
    """Writes the file. Returns what is in it, for the user."""
    if os.path.isfile(args.dir):
        if args.form not in ('gaussians', 'points'):
            raise ExportError(f'{args.dir} is a file: --as {args.form} needs a run folder, for its camera and poses')
        from splatam_core.maps.ply import read_ply

        return _write_map(args, read_ply(args.dir))
    run = open_run(args.dir, args.device)
    gaussians = run.read_map()
    if args.form == 'splatam':
        _write_splatam(args.file, run, gaussians)
        return f'{len(gaussians)} Gaussians and {len(run.trajectory)} poses'
    if args.form == 'grid':
        return _write_grid(args, run, gaussians)
    if args.form == 'octomap':
        return _write_octomap(args, run, gaussians)
    if args.form == 'mesh':
        return _write_surface(args.file, _mesh(args, run, gaussians))
    return _write_map(args, gaussians)


def _write_map(args: argparse.Namespace, gaussians: Gaussians) -> str:
    """Writes Gaussians or their centres."""
    from splatam_core.maps.export import centres
    from splatam_core.maps.ply import write_ply
    from splatam_core.maps.splat import write_splat, write_spz

    if args.form == 'points':
        return _write_surface(args.file, centres(gaussians, args.min_opacity))
    kind = args.file.suffix.lower()
    if kind != '.ply' and args.sh_degree:
        raise ExportError(f'{args.file}: --sh-degree is for .ply files; {kind} files are read without it')
    if kind == '.ply':
        write_ply(args.file, gaussians, sh_degree=args.sh_degree)
    else:
        {'.splat': write_splat, '.spz': write_spz}[kind](args.file, gaussians)
    return f'{len(gaussians)} Gaussians'


def _write_surface(path: Path, surface: Surface) -> str:
    from splatam_core.maps.ply import write_surface

    write_surface(path, surface.points_m, surface.rgb, surface.triangles)
    faces = '' if surface.triangles is None else f' and {len(surface.triangles)} triangles'
    return f'{len(surface.points_m)} points{faces}'


def _mesh(args: argparse.Namespace, run: RunRecord, gaussians: Gaussians) -> Surface:
    from splatam_core.maps.export import fused_mesh
    from splatam_core.rasterizer import rasterizer_for

    rasterizer, device = rasterizer_for(run.config)
    return fused_mesh(
        gaussians.to(device), rasterizer, run.camera_or_error(), run.tracked_trajectory().T_world_cam[:: args.every],
        voxel_m=args.voxel, max_depth_m=args.max_depth, progress=progress('fusing', 'view'),
    )  # fmt: skip


def _write_grid(args: argparse.Namespace, run: RunRecord, gaussians: Gaussians) -> str:
    from splatam_core.maps.grid import OCCUPIED, GridSettings, find_floor, grid_of, write_map_server

    if args.min_height >= args.max_height:
        raise ExportError(f'--min-height {args.min_height:g} is not below --max-height {args.max_height:g}')
    settings = GridSettings(args.resolution, args.min_height, args.max_height, args.max_depth)
    picture = args.file.with_suffix('.pgm')
    if os.path.lexists(picture) and not args.overwrite:
        raise ExportError(f'{picture} exists: choose another name, or replace it with --overwrite')
    camera, views = run.camera_or_error(), _depth_views(args, run, gaussians)
    grid = grid_of(views, camera, find_floor(views, camera, settings.range_m), settings)
    write_map_server(args.file, grid)
    rows, columns = grid.cells.shape
    return f'{columns}x{rows} cells of {settings.resolution_m:g} m, {int((grid.cells == OCCUPIED).sum())} of them occupied,'


def _depth_views(args: argparse.Namespace, run: RunRecord, gaussians: Gaussians) -> list[DepthView]:
    from splatam_core.maps.grid import rendered_views
    from splatam_core.rasterizer import rasterizer_for

    (rasterizer, device), camera = rasterizer_for(run.config), run.camera_or_error()
    poses = run.trajectory.T_world_cam[:: args.every]
    return rendered_views(gaussians.to(device), rasterizer, camera, poses, progress('rendering', 'view'))


def _write_octomap(args: argparse.Namespace, run: RunRecord, gaussians: Gaussians) -> str:
    from splatam_core.maps.grid import FREE, OCCUPIED, find_floor, volume_of
    from splatam_core.maps.octomap import write_octomap

    camera, views = run.camera_or_error(), _depth_views(args, run, gaussians)
    T_grid_world = find_floor(views, camera, args.max_depth)
    volume = volume_of(views, camera, T_grid_world, resolution_m=args.resolution, range_m=args.max_depth)
    write_octomap(args.file, volume)
    occupied, free = (int((volume.voxels == state).sum()) for state in (OCCUPIED, FREE))
    return f'{occupied} occupied and {free} free voxels of {volume.resolution_m:g} m'


def _write_splatam(path: Path, run: RunRecord, gaussians: Gaussians) -> None:
    import numpy as np

    from splatam_core.atomic_io import replaced
    from splatam_core.maps.export import splatam_params
    from splatam_core.types import Status

    poses = run.trajectory.T_world_cam
    posed = [frame for frame in run.frames if frame.status is not Status.LOST]
    keyframes = [index for index, frame in enumerate(posed) if frame.is_keyframe]
    arrays: dict[str, Any] = splatam_params(gaussians, run.camera_or_error(), poses, keyframes, _true_poses(run))
    with replaced(path) as temporary, temporary.open('wb') as file:
        np.savez(file, **arrays)


def _true_poses(run: RunRecord) -> NDArray[np.float64]:
    """Returns the ground-truth T_world_cam [T, 4, 4] of the frames with a pose; NaN where it is unknown."""
    import numpy as np

    from splatam_core.geometry.trajectory import interpolate_poses

    source = run.description.source
    truth = None if source is None else usable_ground_truth(open_source(source))
    if truth is None:
        return np.full((len(run.trajectory), 4, 4), np.nan)
    poses, known = interpolate_poses(truth, run.trajectory.stamps_ns)
    poses[~known] = np.nan
    return poses


COMMAND = Command(
    'export',
    "write a run's map as Gaussians, points, a mesh, a floor plan or voxels, or for the original's programs",
    _add_arguments,
    export,
)
