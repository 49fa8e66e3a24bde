"""``splatam evaluate``: scores a run and writes its report."""

from __future__ import annotations

import argparse
import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from splatam_core.commands.shared import (
    BAG_SUFFIXES,
    EXIT_ERROR,
    Command,
    add_run_argument,
    open_run,
    open_source,
    positive,
    progress,
    say,
    usable_ground_truth,
)
from splatam_core.errors import DatasetError, RunFolderError, SplatamError

if TYPE_CHECKING:
    from splatam_core.datasets.base import Sequence
    from splatam_core.evaluation.results import NovelViews
    from splatam_core.geometry.trajectory import Trajectory
    from splatam_core.runs.metrics import Metrics
    from splatam_core.runs.record import RunRecord

NOT_KNOWN = 'not known'


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    add_run_argument(parser)
    parser.add_argument(
        '--truth', metavar='FILE|BAG|DATASET', help="ground truth: TUM trajectory, bag or dataset (default: the run's own source)"
    )
    parser.add_argument('--every', type=positive, default=1, metavar='N', help='score the images of every n-th frame only')
    parser.add_argument(
        '--novel-views', nargs='?', choices=('trajectory', 'first'), const='trajectory', metavar='ALIGNMENT',
        help="also score the test split of the run's dataset at its ground-truth poses; ALIGNMENT to the map is by the whole "
        "'trajectory' (default) or by its 'first' pose, as the original does",
    )  # fmt: skip


def evaluate(args: argparse.Namespace) -> int:
    """Scores a run and writes its report."""
    from splatam_core.runs.layout import MAP

    run = open_run(args.dir, args.device)
    truth, sequence, fault = _truth_and_frames(run, args.truth)
    if sequence is not None and not (run.path / MAP).is_file():
        say(f'{run.path} has no {MAP} because the run ended before saving it: only the trajectory is scored')
        sequence = None
    novel = _score_novel_views(run, args.novel_views) if args.novel_views else None
    if args.truth is None and sequence is not None:
        metrics = score_own_run(run, truth, sequence, args.every, novel)
    else:
        metrics = score(run, truth, sequence, args.every, novel)
    print_summary(metrics, args.dir)
    return 0 if fault is None else EXIT_ERROR


def score(
    run: RunRecord, truth: Trajectory | None, sequence: Sequence | None, every: int, novel: NovelViews | None = None
) -> Metrics:
    """Scores a run, then writes ``metrics.json``, ``scores.csv`` and the reports. After an error these files are unchanged.

    Args:
        run: to be scored.
        truth: ground-truth poses; None = no trajectory error.
        sequence: the frames; None = no image scores.
        every: score the images of every n-th frame.
        novel: scored test views, if any.
    """
    from splatam_core.atomic_io import replace_text
    from splatam_core.evaluation.report.frame_table import write_frame_table
    from splatam_core.evaluation.report.html import write_html
    from splatam_core.evaluation.report.picture import write_report
    from splatam_core.evaluation.results import combine
    from splatam_core.evaluation.score import score_images, score_trajectory
    from splatam_core.runs.layout import METRICS, PAGE, REPORT, SCORES

    against_truth = None if truth is None else score_trajectory(run, truth)
    against_images = None if sequence is None else score_images(run, sequence, every, progress('scoring'))
    evaluation = combine(run, against_truth, against_images, novel)
    replace_text(run.path / METRICS, evaluation.metrics.to_json())
    write_frame_table(evaluation, run.path / SCORES)
    write_report(evaluation, run.path / REPORT)
    write_html(evaluation, run.path / PAGE)
    return evaluation.metrics


def score_own_run(
    run: RunRecord, truth: Trajectory | None, sequence: Sequence, every: int = 1, novel: NovelViews | None = None
) -> Metrics:
    """Scores a run against its own source; the images only where too few frames are tracked for a trajectory error."""
    from splatam_core.evaluation.score import score_trajectory

    try:
        if truth is not None:
            score_trajectory(run, truth)
    except RunFolderError as error:
        say(f'no trajectory error: {error}')
        truth = None
    return score(run, truth, sequence, every, novel)


def _truth_and_frames(run: RunRecord, given: str | None) -> tuple[Trajectory | None, Sequence | None, SplatamError | None]:
    """Returns the ground truth, the frames to score against, and the fault for which a given ground truth cannot be used.

    The frames are those of the run's own source if possible.

    Raises:
        SplatamError: there is nothing to score against.
    """
    from splatam_core.geometry.trajectory import read_ground_truth
    from splatam_core.runs.record import Source

    if given is None:
        if run.description.source is None:
            raise RunFolderError(f'{run.path} does not say where its frames came from: pass --truth FILE|BAG|DATASET')
        sequence = open_source(run.description.source)
        return usable_ground_truth(sequence), sequence, None
    frames = _open_own_source(run)
    is_bag_or_dataset = not os.path.isfile(given) or Path(given).suffix in BAG_SUFFIXES
    other = open_source(Source(given, width=run.camera.width if run.camera else None)) if is_bag_or_dataset else None
    frames = frames if frames is not None else other
    try:
        truth = read_ground_truth(Path(given)) if other is None else other.ground_truth()
    except SplatamError as error:
        if frames is None:
            raise
        say(f'the ground truth is not used: {error}')
        return None, frames, error
    if truth is None:
        say(f'{given} has no ground-truth poses: only the images are scored')
    return truth, frames, None


def _open_own_source(run: RunRecord) -> Sequence | None:
    if run.description.source is None:
        return None
    try:
        return open_source(run.description.source)
    except SplatamError as error:
        say(f"the run's own source is not used: {error}")
        return None


def _score_novel_views(run: RunRecord, alignment: str) -> NovelViews:
    from splatam_core.evaluation.score import score_novel_views

    source = run.description.source
    if source is None or source.split == 'test':
        which = 'live topics' if source is None else 'a test split'
        raise RunFolderError(f"{run.path} is a run over {which}: novel views need a run over a dataset's train split")
    truth = open_source(source).ground_truth()
    try:
        test = open_source(replace(source, split='test', start=0, max_frames=None, stride=1))
    except DatasetError as error:
        raise RunFolderError(f'--novel-views needs a dataset with a test split: {error}') from None
    if truth is None:
        raise RunFolderError(f'{source.path} has no ground-truth poses, which novel views need')
    return score_novel_views(run, truth, test, alignment, progress('novel views', 'view'))


def print_summary(metrics: Metrics, folder: Path, left_out: int = 0) -> None:
    """Prints the main numbers, one per line, and which are not known. left_out: number of frames that could not be used."""
    m, notes = metrics, metrics.notes
    rows = [
        ('tracked', f'{m.tracked} of {m.frames} frames{_not_tracked(m)}'),
        *([('left out', f'{left_out} of {m.frames + left_out} frames, which could not be used; see above')] if left_out else []),
        ('speed', _text(m.fps, 1, '.2f', 'fps, decoding excluded')),
        ('ATE RMSE', _text(m.ate_rmse_m, 100, '.2f', 'cm')),
        ('RPE', _relative(m)),
        ('PSNR', _text(m.psnr_db, 1, '.2f', 'dB')),
        ('SSIM', _text(m.ssim, 1, '.3f', '')),
        ('MS-SSIM', _text(m.ms_ssim, 1, '.3f', '', notes.get('ms_ssim'))),
        ('LPIPS', _text(m.lpips, 1, '.3f', '', notes.get('lpips'))),
        ('depth L1', _text(m.depth_l1_m, 100, '.2f', 'cm')),
        ('depth RMSE', _text(m.depth_rmse_m, 100, '.2f', 'cm')),
    ]
    if m.heldout_frames:
        scores = f'{_text(m.heldout.psnr_db, 1, ".2f", "dB")}, depth L1 {_text(m.heldout.depth_l1_m, 100, ".2f", "cm")}'
        rows.append(('held out', f'PSNR {scores}; {m.heldout_frames} frames held out of the map'))
    if m.novel_alignment:
        scores = f'{_text(m.novel.psnr_db, 1, ".2f", "dB")}, depth L1 {_text(m.novel.depth_l1_m, 100, ".2f", "cm")}'
        rows.append(
            ('novel', f'PSNR {scores}; {m.novel_frames} views without holes; {m.novel_holes_frames} with holes are scored apart')
        )
    rows.append(('Gaussians', _text(m.num_gaussians, 1, ',', '')))
    unknown = [name for name, value in rows if value == NOT_KNOWN]
    rows = [*(row for row in rows if row[0] not in unknown), *([(NOT_KNOWN, ', '.join(unknown))] if unknown else [])]
    for name, value in [*rows, ('results', str(folder))]:
        print(f'{name:<10} {value}'.rstrip())


def _not_tracked(metrics: Metrics) -> str:
    counts = [f'{count} {name}' for name, count in (('uncertain', metrics.uncertain), ('lost', metrics.lost)) if count]
    return f'; {", ".join(counts)}' if counts else ''


def _relative(metrics: Metrics) -> str:
    if metrics.rpe_trans_frame_m is None:
        return NOT_KNOWN
    per_frame = f'{metrics.rpe_trans_frame_m * 1e3:.2f} mm, {metrics.rpe_rot_frame_deg:.3f} deg per frame'
    if metrics.rpe_trans_1s_m is None:
        return per_frame
    return f'{per_frame}; {metrics.rpe_trans_1s_m * 1e3:.1f} mm, {metrics.rpe_rot_1s_deg:.2f} deg per second'


def _text(value: float | None, factor: float, digits: str, unit: str, why_not: str | None = None) -> str:
    if value is None:
        return f'{NOT_KNOWN}: {why_not}' if why_not else NOT_KNOWN
    return f'{value * factor:{digits}} {unit}'.rstrip()


COMMAND = Command('evaluate', 'score a run and write its report', _add_arguments, evaluate)
