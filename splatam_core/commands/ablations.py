"""``splatam ablations``: what each part of SplaTAM is worth, as the paper's tables ask."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from splatam_core.commands.shared import Command, add_source_arguments, at_width, open_source, say, source_of, source_words

if TYPE_CHECKING:
    from splatam_core.runs.run_folder import Source


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    add_source_arguments(parser)
    parser.add_argument('--preset', default='splatam', help='what all start from (default: %(default)s)')
    parser.add_argument('--set', action='append', default=[], metavar='KEY=VALUE', help='a setting of all of them')
    parser.add_argument('--only', nargs='+', metavar='NAME', help='some of them (default: all; see config/ablations)')
    parser.add_argument('--out', type=Path, required=True, metavar='DIR', help='folder of the runs; finished ones are kept')


def ablations(args: argparse.Namespace) -> int:
    """Run the paper's ablations over a recording, one after another, and print their table."""
    from splatam_core.evaluation.ablations import provenance, run, table, variant_names, variants

    chosen = variants(args.only or variant_names(), args.preset, args.set)
    source = at_width(source_of(args), chosen[0].config)
    open_source(source)
    folders = {variant.name: args.out / variant.name for variant in chosen}
    for number, variant in enumerate(chosen, 1):
        say(f'{variant.name} ({number} of {len(chosen)})')
        if not run(variant, source_words(source), source, folders[variant.name]):
            say(f'{variant.name} failed; see above')
    title = f'{Path(source.path).name}{_window_text(source)}, preset `{args.preset}`'
    print(f'{title}; {provenance(folders.values())}; runs: 1.\n\n{table(folders)}')
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
