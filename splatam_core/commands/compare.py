"""``splatam compare``: runs side by side, as a table and a picture."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from splatam_core.commands.shared import Command
from splatam_core.errors import RunFolderError


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('dirs', type=Path, nargs='+', metavar='DIR', help='folders of runs')
    add_plot_argument(parser)


def add_plot_argument(parser: argparse.ArgumentParser) -> None:
    """Where the picture goes."""
    parser.add_argument(
        '--plot', type=Path, default=Path('compare.png'), metavar='FILE',
        help='picture to draw, .png, .svg or .pdf (default: %(default)s)',
    )  # fmt: skip


def compare(args: argparse.Namespace) -> int:
    """Print a table of runs and draw them."""
    compare_runs(args.dirs, args.plot)
    return 0


def compare_runs(folders: Sequence[Path], plot: Path) -> None:
    """Print a table of runs and draw them.

    Raises:
        RunFolderError: one of them is no run, or the picture cannot be written.
    """
    from splatam_core.atomic_io import replaced
    from splatam_core.evaluation.report.comparison import comparison_table, draw_comparison
    from splatam_core.runs.run_folder import read_run

    kind = plot.suffix.removeprefix('.').lower()
    if kind not in ('png', 'svg', 'pdf'):
        raise RunFolderError(f"--plot {plot}: '{plot.suffix}' is not one of .png, .svg, .pdf")
    runs = [read_run(folder) for folder in folders]
    print(comparison_table(runs))
    figure = draw_comparison(runs)
    try:
        with replaced(plot) as temporary:
            figure.savefig(temporary, format=kind, dpi=120)
    except OSError as error:
        raise RunFolderError(f'{plot}: cannot be written: {error.strerror}') from None
    print(f'\npicture: {plot}')


COMMAND = Command('compare', 'print a table of runs and draw them side by side', _add_arguments, compare)
