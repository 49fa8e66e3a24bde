"""Reproduces the paper's tables on the available recordings: ablations, tracking and rendering, held-out views.

    python benchmarks/paper_tables.py [--data ../shared/data] [--width 320] [--max-frames N] [--no-ablations] [--out ...]

Ablations (Tables 4, 5 and S.1) use the fast walk through the synthetic room, the start of 7scenes_redkitchen, and every
fifth frame of it. Some are repeated under the conditions that docs/ablations.md gives as reasons. Tracking and rendering
(Tables 1 to 3) uses preset `splatam` on both recordings, with this project's metrics and, prefixed `splatam_`, those of the
original code. Held-out views is the same with every 8th frame excluded from mapping (`heldout_`). Runs use one thread and
follow one another, which takes hours. Finished runs are not repeated.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from header import print_header

KITCHEN, DESK = '7scenes_redkitchen', 'tum_fr1_rpy'
HOLDOUT = 8
OWN = ('frames', 'tracked', 'ate_rmse_m', 'psnr_db', 'psnr_full_db', 'ssim', 'depth_l1_m', 'num_gaussians', 'fps')
PREFIXES = ('splatam_', 'heldout_')
EXIT_INTERRUPTED = 130


@dataclass(frozen=True, slots=True)
class Set:
    """A set of ablations.

    Attributes:
        name: part of the folder's name.
        source: the recording.
        stride: use every n-th frame.
        only: names of the variants; empty = all.
        settings: ``name=value`` settings of all variants.
        times: factor on the number of frames.
    """

    name: str
    source: str
    stride: int = 1
    only: tuple[str, ...] = ()
    settings: tuple[str, ...] = ()
    times: int = 1


def sets(kitchen: str) -> tuple[Set, ...]:
    """Returns all sets. The first three are the ablations; the others test the reasons given for differences."""
    room, silhouettes = 'synthetic:motion=fast', ('full', 'silhouette_050', 'no_silhouette')
    blended = ('tracking.paper.blended_depth=true',)
    return (
        Set('room', room), Set('redkitchen', kitchen), Set('redkitchen_every_5th', kitchen, 5),
        Set('room_blended_depth', room, only=silhouettes, settings=blended),
        Set('redkitchen_every_5th_blended_depth', kitchen, 5, only=silhouettes, settings=blended),
        Set('room_exact_depth', f'{room},noise=off', only=('full', 'color_only', 'depth_only')),
        Set('room_longer', room, only=('full', 'no_silhouette'), times=3),
    )  # fmt: skip


def splatam(*arguments: str, prints: bool = False) -> None:
    """Run the command line in a process of its own. If it fails, it prints why, and the tables lack its values."""
    command = [sys.executable, '-m', 'splatam_core.cli', *arguments]
    code = subprocess.run(command, stdout=None if prints else sys.stderr, check=False).returncode
    if code == EXIT_INTERRUPTED:
        raise KeyboardInterrupt


def ablations(chosen: Set, args: argparse.Namespace) -> None:
    """Run a set and print its table."""
    names = [name for name in args.only or chosen.only if not chosen.only or name in chosen.only]
    if args.only and not names:
        return
    frames = args.ablation_frames * chosen.times
    print_header(f'Ablations, {chosen.name}: width {args.ablation_width}, {frames} frames', 1)
    size = ['--width', str(args.ablation_width), '--max-frames', str(frames), '--stride', str(chosen.stride)]
    settings = [word for setting in ('threads=1', *chosen.settings) for word in ('--set', setting)]
    only = ['--only', *names] if names else []
    out = args.out / f'ablations_{chosen.name}_{args.ablation_width}_{frames}'
    splatam('ablations', chosen.source, *size, *settings, *only, '--out', str(out), prints=True)
    print(flush=True)


def scored_run(recording: Path, args: argparse.Namespace, holdout: int) -> Path:
    """Returns the folder of a run of preset `splatam` on a recording. Runs it if the folder has no scores."""
    frames = f'_{args.max_frames}' if args.max_frames else ''
    kind = f'holdout{holdout}' if holdout else 'all'
    folder = args.out / f'{recording.name}_{args.width}{frames}_{kind}'
    if metrics(folder).get('psnr_db') is None:
        cut = ['--max-frames', str(args.max_frames)] if args.max_frames else []
        options = ['--holdout', str(holdout)] if holdout else []
        command = ['run', str(recording), '--preset', 'splatam', '--width', str(args.width), '--set', 'threads=1']
        splatam(*command, *cut, *options, '--out', str(folder), *(['--overwrite'] if folder.exists() else []))
    return folder


def metrics(folder: Path) -> dict[str, object]:
    """Returns the metrics of a run folder; empty if it has none."""
    path = folder / 'metrics.json'
    return json.loads(path.read_text()) if path.is_file() else {}


def print_metrics(folders: Sequence[Path]) -> None:
    """Print runs side by side: this project's metrics, then those with a prefix."""
    columns = [metrics(folder) for folder in folders]
    named = sorted({name for column in columns for name in column if name.startswith(PREFIXES)}, key=_by_prefix)
    print('| metric | ' + ' | '.join(folder.name for folder in folders) + ' |')
    print('|---' * (len(folders) + 1) + '|')
    for name in (*OWN, *named):
        print(f'| `{name}` | ' + ' | '.join(_text(column.get(name)) for column in columns) + ' |')
    print(flush=True)


def _by_prefix(name: str) -> tuple[int, str]:
    return next(index for index, prefix in enumerate(PREFIXES) if name.startswith(prefix)), name


def _text(value: object) -> str:
    if value is None:
        return '–'
    return f'{value:.4g}' if isinstance(value, float) else str(value)


def main() -> None:
    """Do the missing runs and print all tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    default = Path(os.environ.get('SPLATAM_DATA') or '../shared/data')
    parser.add_argument('--data', type=Path, default=default, help=f'folder of {KITCHEN} and {DESK} (default: %(default)s)')
    parser.add_argument('--width', type=int, default=320, help='image width in tracking and rendering (default: %(default)s)')
    parser.add_argument('--max-frames', type=int, help='number of frames in tracking and rendering (default: all)')
    parser.add_argument('--ablation-width', type=int, default=128, help='image width in ablations (default: %(default)s)')
    parser.add_argument('--ablation-frames', type=int, default=40, help='number of frames in ablations (default: %(default)s)')
    parser.add_argument('--only', nargs='+', metavar='NAME', help='names of the ablations to run (default: all)')
    parser.add_argument('--no-ablations', action='store_true', help='skip the ablations')
    parser.add_argument('--out', type=Path, default=Path('out/paper_tables'), help='folder of the runs (default: %(default)s)')
    args = parser.parse_args()
    recordings = [args.data / KITCHEN, args.data / DESK]
    if missing := [str(path) for path in recordings if not path.is_dir()]:
        parser.error(f'{", ".join(missing)} is absent: set --data or SPLATAM_DATA to the folder of the recordings')

    for chosen in () if args.no_ablations else sets(str(recordings[0])):
        ablations(chosen, args)
    for title, holdout in (('Tracking and rendering', 0), (f'Held-out views: every {HOLDOUT}th frame', HOLDOUT)):
        print_header(f'{title}, preset `splatam`, width {args.width}', 1)
        print_metrics([scored_run(recording, args, holdout) for recording in recordings])


if __name__ == '__main__':
    main()
