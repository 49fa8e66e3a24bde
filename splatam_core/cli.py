"""``splatam``: the command line. Each command is a file in ``commands/`` and a row of ``COMMANDS``."""

from __future__ import annotations

import argparse
import logging
import signal
import sys
from collections.abc import Sequence

from splatam_core.commands import (
    ablations,
    bench,
    compare,
    convert,
    evaluate,
    export,
    lpips_weights,
    merge,
    refine,
    render,
    run,
    view,
)
from splatam_core.commands.shared import EXIT_ERROR, EXIT_INTERRUPTED
from splatam_core.errors import SplatamError, one_line, printable
from splatam_core.interruption import on_stop_signals
from splatam_core.output import unfailing_output

COMMANDS = (
    run.COMMAND,
    evaluate.COMMAND,
    ablations.COMMAND,
    convert.COMMAND,
    compare.COMMAND,
    render.COMMAND,
    refine.COMMAND,
    merge.COMMAND,
    export.COMMAND,
    view.COMMAND,
    bench.COMMAND,
    lpips_weights.COMMAND,
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command line. Errors that a user can cause are printed in one line; others keep their traceback.

    Args:
        arguments: the words after ``splatam``; None = those of this process.

    Returns:
        The exit code.
    """
    with unfailing_output():
        return _main(make_parser().parse_args(arguments))


def _main(args: argparse.Namespace) -> int:
    """Runs a command. Returns the exit code."""
    handler = logging.StreamHandler()
    handler.addFilter(_Once())
    logging.basicConfig(level=logging.WARNING, format='splatam: %(levelname)s: %(message)s', handlers=[handler])
    try:
        with on_stop_signals(signal.default_int_handler):
            return args.run(args)
    except SplatamError as error:
        print(f'splatam: error: {error}', file=sys.stderr)
        return EXIT_ERROR
    except OSError as error:  # of the system: a path, a full disk, a closed pipe
        where = '' if error.filename is None else f'{error.filename}: '
        print(f'splatam: error: {where}{error.strerror or one_line(error)}', file=sys.stderr)
        return EXIT_ERROR
    except MemoryError:
        print('splatam: error: the memory is full: choose a smaller --width, or --preset realtime', file=sys.stderr)
        return EXIT_ERROR
    except KeyboardInterrupt:
        print('splatam: interrupted', file=sys.stderr)
        return EXIT_INTERRUPTED


class _Once:
    """Lets each warning pass once, as one line: a recording is opened several times by some commands."""

    def __init__(self) -> None:
        self._said: set[str] = set()

    def filter(self, record: logging.LogRecord) -> bool:
        """Returns False for a message that was said already."""
        text = printable(record.getMessage())
        record.msg, record.args = text, ()
        is_new = text not in self._said
        self._said.add(text)
        return is_new


def make_parser() -> argparse.ArgumentParser:
    """Returns the parser of all commands."""
    parser = argparse.ArgumentParser('splatam', description='Dense RGB-D SLAM with 3D Gaussians.')
    commands = parser.add_subparsers(metavar='COMMAND', required=True)
    for command in COMMANDS:
        subparser = commands.add_parser(command.name, help=command.help, description=command.help)
        command.add_arguments(subparser)
        subparser.set_defaults(run=command.run)
    return parser


if __name__ == '__main__':
    sys.exit(main())
