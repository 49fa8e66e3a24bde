"""``splatam compare``: compares runs in a table and a picture."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from splatam_core.commands.shared import Command
from splatam_core.errors import RunFolderError


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('dirs', type=Path, nargs='+', metavar='DIR', help='run folders')
    add_plot_argument(parser)


def add_plot_argument(parser: argparse.ArgumentParser) -> None:
    """Adds --plot."""
    parser.add_argument(
        '--plot', type=Path, default=Path('compare.png'), metavar='FILE',
        help='picture to draw, .png, .svg or .pdf (default: %(default)s)',
    )  # fmt: skip


def compare(args: argparse.Namespace) -> int:
    """Prints a table of runs and draws them."""
    compare_runs(args.dirs, args.plot)
    return 0


def compare_runs(folders: Sequence[Path], plot: Path) -> None:
    """Prints a table of runs and draws them.

    Raises:
        RunFolderError: one of the folders holds no run, or the picture cannot be written.
    """
    from splatam_core.atomic_io import replaced
    from splatam_core.evaluation.report.comparison import comparison_table, draw_comparison
    from splatam_core.runs.record import read_run

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


COMMAND = Command('compare', 'compare runs in a table and a picture', _add_arguments, compare)
