"""``splatam export``: writes a run's map for other programs."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatam_core.commands.shared import (
    Command,
    add_run_argument,
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
    from splatam_core.rasterizer import Gaussians
    from splatam_core.runs.record import RunRecord

FORMS = ('gaussians', 'points', 'mesh', 'splatam')


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    add_run_argument(parser)
    parser.add_argument('file', type=Path, metavar='FILE', help='file to write: .ply, or .npz with --as splatam')
    parser.add_argument(
        '--as', dest='form', choices=FORMS, default='gaussians',
        help="'gaussians': for splat viewers (default); 'points': coloured centres; 'mesh': surface fused from rendered depth "
        "(needs pip install 'splatam_ros[mesh]'); 'splatam': params.npz for the original's programs",
    )  # fmt: skip
    parser.add_argument('--overwrite', action='store_true', help='replace FILE')
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
        help='mesh: ignore depth beyond M metres (default: %(default)s)',
    )
    parser.add_argument('--every', type=positive, default=5, metavar='N', help='mesh: fuse every n-th frame (default: %(default)s)')


def _number(text: str) -> float:
    value = float(text)
    if not 0 < value < float('inf'):
        raise argparse.ArgumentTypeError(f'{text} is not a number above 0')
    return value


def export(args: argparse.Namespace) -> int:
    """Writes a run's map for other programs."""
    from splatam_core.maps.export import centres
    from splatam_core.maps.ply import write_ply, write_surface
    from splatam_core.runs.layout import why_not

    suffix = '.npz' if args.form == 'splatam' else '.ply'
    if args.file.suffix.lower() != suffix:
        raise ExportError(f"{args.file}: '{args.file.suffix}' files are not written; name it {suffix}")
    if os.path.lexists(args.file) and not args.overwrite:
        raise ExportError(f'{args.file} exists: choose another name, or replace it with --overwrite')
    run = open_run(args.dir, args.device)
    gaussians = run.read_map()
    try:
        if args.form == 'gaussians':
            write_ply(args.file, gaussians)
            print(f'{len(gaussians)} Gaussians are in {args.file}')
            return 0
        if args.form == 'splatam':
            _write_splatam(args.file, run, gaussians)
            print(f'{len(gaussians)} Gaussians and {len(run.trajectory)} poses are in {args.file}')
            return 0
        surface = centres(gaussians, args.min_opacity) if args.form == 'points' else _mesh(args, run, gaussians)
        write_surface(args.file, surface.points_m, surface.rgb, surface.triangles)
    except OSError as error:
        raise ExportError(f'{args.file}: cannot be written: {why_not(error)}') from None
    faces = '' if surface.triangles is None else f' and {len(surface.triangles)} triangles'
    print(f'{len(surface.points_m)} points{faces} are in {args.file}')
    return 0


def _mesh(args: argparse.Namespace, run: RunRecord, gaussians: Gaussians) -> Surface:
    from splatam_core.maps.export import fused_mesh
    from splatam_core.rasterizer import rasterizer_for

    rasterizer, device = rasterizer_for(run.config)
    return fused_mesh(
        gaussians.to(device), rasterizer, run.camera_or_error(), run.trajectory.T_world_cam[:: args.every],
        voxel_m=args.voxel, max_depth_m=args.max_depth, progress=progress('fusing', 'view'),
    )  # fmt: skip


def _write_splatam(path: Path, run: RunRecord, gaussians: Gaussians) -> None:
    import numpy as np

    from splatam_core.atomic_io import replaced
    from splatam_core.maps.export import splatam_params
    from splatam_core.types import Status

    poses = run.trajectory.T_world_cam
    tracked = [frame for frame in run.frames if frame.status is not Status.LOST]
    keyframes = [index for index, frame in enumerate(tracked) if frame.is_keyframe]
    arrays: dict[str, Any] = splatam_params(gaussians, run.camera_or_error(), poses, keyframes, _true_poses(run))
    with replaced(path) as temporary, temporary.open('wb') as file:
        np.savez(file, **arrays)


def _true_poses(run: RunRecord) -> NDArray[np.float64]:
    """Returns the ground-truth T_world_cam [T, 4, 4] of the tracked frames; NaN where it is unknown."""
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
    'export', "write a run's map as Gaussians, points or a mesh, or for the original's programs", _add_arguments, export
)
