"""``splatam convert``: writes a recording as a rosbag2."""

from __future__ import annotations

import argparse
from pathlib import Path

from splatam_core.commands.shared import Command, add_source_arguments, open_source, progress, source_of


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    add_source_arguments(parser)
    parser.add_argument('bag', type=Path, metavar='BAG', help='folder of the rosbag2 to write')
    parser.add_argument(
        '--storage', choices=('sqlite3', 'mcap'), default='sqlite3', help='storage format of the rosbag2 (default: %(default)s)'
    )
    parser.add_argument('--compressed', action='store_true', help='compress colour as JPEG and depth as PNG')


def convert(args: argparse.Namespace) -> int:
    """Writes a recording as a rosbag2."""
    from splatam_core.datasets.convert import write_bag

    sequence = open_source(source_of(args))
    write_bag(sequence, args.bag, storage=args.storage, compressed=args.compressed, progress=progress('writing'))
    print(f'{len(sequence)} frames of {sequence.name} are in {args.bag}')
    return 0


COMMAND = Command('convert', 'write a recording as a rosbag2', _add_arguments, convert)
