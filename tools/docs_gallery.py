"""Make the pictures of docs/gallery.md: a run on the synthetic room, shown by each command that shows something.

    python tools/docs_gallery.py [--run RUN] [--out docs/images/gallery]

Needs Chromium, for the picture of the viewer. The synthetic room ships with the project, so every picture may be published.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ('synthetic', '--width', '400', '--max-frames', '300', '--preset', 'realtime')
JPEG = [cv2.IMWRITE_JPEG_QUALITY, 88]
CELL_PX = 5
SHOWN = 60  # frame


def splatam(arguments: Sequence[object]) -> None:
    """Run ``splatam``.

    Raises:
        CalledProcessError: it failed.
    """
    subprocess.run([sys.executable, '-m', 'splatam_core.cli', *map(str, arguments)], check=True)


def read(path: Path, mode: int = cv2.IMREAD_COLOR) -> NDArray[np.uint8]:
    """Returns an image.

    Raises:
        SystemExit: it cannot be read.
    """
    image = cv2.imread(str(path), mode)
    if image is None:
        sys.exit(f'{path} cannot be read')
    return np.asarray(image)


def main() -> None:
    """Run SLAM and write the pictures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--out', type=Path, default=ROOT / 'docs' / 'images' / 'gallery')
    parser.add_argument('--run', type=Path, help='a finished and scored run on the synthetic room; without it, one is made')
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        work = Path(scratch)
        run, film = args.run or work / 'synthetic', work / 'film'
        if args.run is None:
            splatam(['run', *SOURCE, '--out', run])
        splatam(['view', run, '--screenshot', work / 'viewer.png'])
        splatam(['export', run, work / 'plan.yaml', '--as', 'grid', '--max-depth', '4'])
        pose = (run / 'trajectory.txt').read_text().splitlines()[SHOWN]
        (work / 'pose.txt').write_text(f'{pose}\n')
        splatam(['render', run, '--poses', work / 'pose.txt', '--out', film, '--width', '640', '--no-video'])
        color, depth = (read(next((film / kind).iterdir()), cv2.IMREAD_UNCHANGED) for kind in ('color', 'depth'))
        near = 255 - cv2.normalize(depth, np.empty(0, np.uint8), 0, 255, cv2.NORM_MINMAX, cv2.CV_8U)
        plan = cv2.resize(read(work / 'plan.pgm'), None, fx=CELL_PX, fy=CELL_PX, interpolation=cv2.INTER_NEAREST)
        pictures = {
            'viewer.jpg': read(work / 'viewer.png'),
            'render.jpg': np.hstack([color, cv2.applyColorMap(near, cv2.COLORMAP_VIRIDIS)]),
            'report.jpg': read(run / 'report.png'),
            'plan.png': np.asarray(plan, np.uint8),
        }
        for name, picture in pictures.items():
            cv2.imwrite(str(args.out / name), picture, JPEG if name.endswith('jpg') else [])
            print(f'{args.out / name}: {(args.out / name).stat().st_size // 1024} kB')


if __name__ == '__main__':
    main()
