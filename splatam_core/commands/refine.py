"""``splatam refine``: optimizes a finished map over all frames of its run."""

from __future__ import annotations

import argparse
from pathlib import Path

from splatam_core.commands.evaluate import print_summary, score_own_run
from splatam_core.commands.shared import Command, add_run_argument, open_run, open_source, positive, progress, usable_ground_truth
from splatam_core.errors import RunFolderError


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    add_run_argument(parser)
    parser.add_argument('--out', type=Path, required=True, metavar='DIR', help='folder for the refined run')
    parser.add_argument('--iterations', type=positive, default=2000, metavar='N', help='optimizer steps (default: %(default)s)')
    parser.add_argument(
        '--densify', action='store_true',
        help='clone and split Gaussians of large screen-space gradient during the first half of the steps, as 3D Gaussian '
        'splatting does; needs 1000 steps or more to help',
    )  # fmt: skip
    parser.add_argument(
        '--every', type=positive, default=1, metavar='N', help='score every n-th frame only, before and after refinement'
    )


def refine(args: argparse.Namespace) -> int:
    """Optimizes a finished map over all frames of its run."""
    from splatam_core.evaluation.images import mean_scores
    from splatam_core.evaluation.score import score_images
    from splatam_core.mapping.offline_refinement import refine_map
    from splatam_core.rasterizer import rasterizer_for
    from splatam_core.runs.layout import check_is_free
    from splatam_core.runs.writer import write_refined

    run = open_run(args.dir, args.device)
    rasterizer, device = rasterizer_for(run.config)
    gaussians = run.read_map().to(device)
    if run.description.source is None:
        raise RunFolderError(f"{args.dir}: its frames came from live topics; only runs of 'splatam run' can be refined")
    check_is_free(args.out)
    sequence = open_source(run.description.source)
    truth = usable_ground_truth(sequence)
    before = mean_scores(score_images(run, sequence, args.every, progress('scoring')).frames)
    refined = refine_map(
        gaussians, sequence, run.mapped_poses(), rasterizer, run.config,
        iterations=args.iterations, progress=progress('refining', 'step'), densify=args.densify,
    )  # fmt: skip
    write_refined(run, args.out, refined, args.iterations, args.densify)
    metrics = score_own_run(open_run(args.out, args.device), truth, sequence, args.every)
    print_summary(metrics, args.out)
    if before.psnr_db is not None and metrics.psnr_db is not None:
        print(f'PSNR was {before.psnr_db:.2f} dB, is {metrics.psnr_db:.2f} dB')
    return 0


COMMAND = Command('refine', 'optimize a finished map over all frames of its run', _add_arguments, refine)
