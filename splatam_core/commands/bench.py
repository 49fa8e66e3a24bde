"""``splatam bench``: presets side by side on one recording."""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

from splatam_core.commands.compare import compare_runs
from splatam_core.commands.shared import Command, add_source_arguments, source_of, source_words
from splatam_core.errors import RunFolderError


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    add_source_arguments(parser)
    parser.add_argument('--presets', required=True, metavar='A,B', help='shipped presets or .yaml files, with commas between')
    parser.add_argument(
        '--set',
        action='append',
        default=[],
        metavar='KEY=VALUE',
        help='change a setting of all; may be given several times',
    )
    parser.add_argument('--out', type=Path, required=True, metavar='DIR', help='folder for the runs, one below it each')


def bench(args: argparse.Namespace) -> int:
    """Run presets one after another, each in a process of its own, and compare them."""
    from splatam_core.config import load_config
    from splatam_core.runs.run_folder import check_is_free

    presets = [preset.strip() for preset in args.presets.split(',') if preset.strip()]
    folders = [args.out / Path(preset).stem for preset in presets]
    if len(set(folders)) < len(folders) or not folders:
        raise RunFolderError(f"--presets {args.presets}: expected different presets with commas between, like 'quick,tum'")
    for preset in presets:
        load_config(preset, args.set)  # a wrong name is said now, not after an hour
    check_is_free(args.out)
    for preset, folder in zip(presets, folders):
        command = [
            sys.executable,
            '-m',
            'splatam_core.cli',
            'run',
            *source_words(source_of(args)),
            '--preset',
            preset,
            '--out',
            folder,
        ]
        done = subprocess.run([*map(str, command), *(word for entry in args.set for word in ('--set', entry))], check=False)
        if done.returncode != 0:
            raise RunFolderError(f'preset {preset} ended with exit code {done.returncode}; see above')
    print()
    compare_runs(folders, args.out / 'compare.png')
    return 0


COMMAND = Command('bench', 'run presets one after another and compare them', _add_arguments, bench)
