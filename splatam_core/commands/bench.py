"""``splatam bench``: compares presets on one recording."""

from __future__ import annotations

import argparse
from pathlib import Path

from splatam_core.commands.compare import compare_runs
from splatam_core.commands.shared import (
    Command,
    add_set_argument,
    add_source_arguments,
    run_in_own_process,
    source_of,
    source_words,
)
from splatam_core.errors import RunFolderError


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    add_source_arguments(parser)
    parser.add_argument('--presets', required=True, metavar='A,B', help='shipped presets or .yaml files, separated by commas')
    add_set_argument(parser)
    parser.add_argument('--out', type=Path, required=True, metavar='DIR', help='folder for the runs, one subfolder each')


def bench(args: argparse.Namespace) -> int:
    """Runs presets one after another, each in a process of its own, and compares them."""
    from splatam_core.config import load_config
    from splatam_core.runs.layout import check_is_free

    presets = [preset.strip() for preset in args.presets.split(',') if preset.strip()]
    folders = [args.out / Path(preset).stem for preset in presets]
    if len(set(folders)) < len(folders) or not folders:
        raise RunFolderError(f"--presets {args.presets}: expected different presets separated by commas, like 'quick,tum'")
    for preset in presets:
        load_config(preset, args.set)  # raises before the first run
    check_is_free(args.out)
    settings = [word for entry in args.set for word in ('--set', entry)]
    for preset, folder in zip(presets, folders):
        words = ['run', *source_words(source_of(args)), '--preset', preset, '--out', folder, *settings]
        if code := run_in_own_process(words):
            raise RunFolderError(f'preset {preset} ended with exit code {code}; see above')
    print()
    compare_runs(folders, args.out / 'compare.png')
    return 0


COMMAND = Command('bench', 'run presets one after another and compare them', _add_arguments, bench)
