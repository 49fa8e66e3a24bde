"""``splatam ablations``: runs the paper's ablations over a recording and prints their table."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from splatam_core.commands.shared import (
    Command,
    add_preset_arguments,
    add_source_arguments,
    at_width,
    open_source,
    run_in_own_process,
    say,
    source_of,
    source_words,
)

if TYPE_CHECKING:
    from splatam_core.runs.record import Source

PAGE = 'ablations.html'


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    add_source_arguments(parser)
    add_preset_arguments(parser)
    parser.add_argument('--only', nargs='+', metavar='NAME', help='run only these (default: all in config/ablations)')
    parser.add_argument('--out', type=Path, required=True, metavar='DIR', help='folder of the runs; finished runs are kept')


def ablations(args: argparse.Namespace) -> int:
    """Runs the paper's ablations one after another, and prints their table. Finished runs are not repeated."""
    from splatam_core.atomic_io import replace_text
    from splatam_core.evaluation.ablations import COLUMNS, provenance, rows, variant_names, variants
    from splatam_core.evaluation.report.tables import Table, page
    from splatam_core.evaluation.variants import is_finished

    chosen = variants(args.only or variant_names(), args.preset, args.set)
    source = at_width(source_of(args), chosen[0].config)
    open_source(source)  # raises before the first run
    folders = {variant.name: args.out / variant.name for variant in chosen}
    for number, variant in enumerate(chosen, 1):
        folder = folders[variant.name]
        say(f'{variant.name} ({number} of {len(chosen)})')
        if is_finished(variant, source, folder):
            continue
        words = ['run', *source_words(source), *variant.words(), '--out', folder, '--overwrite']
        if run_in_own_process(words, stdout=sys.stderr) != 0:
            say(f'{variant.name} failed; see above')
    title = f'{Path(source.path).name}{_window_text(source)}, preset `{args.preset}`'
    made_by, table = provenance(folders.values()), Table('', COLUMNS, rows(folders))
    print(f'{title}; {made_by}; runs: 1.\n\n{table.markdown()}')
    if args.out.is_dir():
        replace_text(args.out / PAGE, page(f'Ablations of {args.preset}', f'{title}; {made_by}'.replace('`', ''), [table]))
        say(f'as a page: {args.out / PAGE}')
    return 0


def _window_text(source: Source) -> str:
    parts = [
        f'from frame {source.start}' if source.start else '',
        f'stride {source.stride}' if source.stride > 1 else '',
        f'at most {source.max_frames} frames' if source.max_frames else '',
        f'width {source.width}' if source.width else '',
    ]
    return ''.join(f', {part}' for part in parts if part)


COMMAND = Command('ablations', "run the paper's ablations over a recording", _add_arguments, ablations)
