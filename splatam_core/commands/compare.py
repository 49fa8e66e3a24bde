"""``splatam compare``: compares runs in a table and a picture."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from splatam_core.commands.shared import Command
from splatam_core.errors import RunFolderError


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('dirs', type=Path, nargs='+', metavar='DIR', help='run folders')
    parser.add_argument('--html', type=Path, metavar='FILE', help='also write tables and picture as one page')
    parser.add_argument(
        '--plot', type=Path, default=Path('compare.png'), metavar='FILE',
        help='picture to draw, .png, .svg or .pdf (default: %(default)s)',
    )  # fmt: skip


def compare(args: argparse.Namespace) -> int:
    """Prints a table of runs and draws them."""
    compare_runs(args.dirs, args.plot, args.html)
    return 0


def compare_runs(folders: Sequence[Path], plot: Path, html: Path | None = None) -> None:
    """Prints a table of runs and draws them; runs that differ in their seed only have a line in a table of their own, too.

    Args:
        folders: of the runs.
        plot: the picture.
        html: a page with tables and picture; None = none.

    Raises:
        RunFolderError: one of the folders holds no run, or a file cannot be written.
    """
    from splatam_core.atomic_io import replace_text, replaced
    from splatam_core.evaluation.report.comparison import (
        comparison_page,
        comparison_table,
        draw_comparison,
        in_common,
        summary_table,
    )
    from splatam_core.runs.record import read_run

    kind = plot.suffix.removeprefix('.').lower()
    if kind not in ('png', 'svg', 'pdf'):
        raise RunFolderError(f"--plot {plot}: '{plot.suffix}' is not one of .png, .svg, .pdf")
    runs = [read_run(folder) for folder in folders]
    print(f'{in_common(runs)}\n\n{comparison_table(runs).markdown()}')
    if (summary := summary_table(runs)) is not None:
        print(f'\n{summary.title}:\n\n{summary.markdown()}')
    figure = draw_comparison(runs)
    with _write_errors(plot), replaced(plot) as temporary:
        figure.savefig(temporary, format=kind, dpi=120)
    if html is not None:
        with _write_errors(html):
            replace_text(html, comparison_page(runs, html.parent))
    print(f'\npicture: {plot}' + ('' if html is None else f'\npage: {html}'))


@contextmanager
def _write_errors(path: Path) -> Iterator[None]:
    """Turns an error of the system into one line that names the file.

    Raises:
        RunFolderError: the block raised such an error.
    """
    try:
        yield
    except OSError as error:
        raise RunFolderError(f'{path}: cannot be written: {error.strerror}') from None


COMMAND = Command('compare', 'compare runs in a table and a picture', _add_arguments, compare)
