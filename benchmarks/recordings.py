"""Compares a recording played through player, DDS and node with the same bag processed offline: equality and scores.

    python benchmarks/recordings.py SOURCE [--preset quick] [--width 320] [--max-frames N] [--out out/benchmarks/NAME]

The two runs use one thread each, one after the other, so that they can be compared bit for bit. A third run uses all cores,
to measure the speed. Each of the three folders holds a report.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

from header import print_header

from splatam_ros.demo import Processes, wait_for_both

COLUMNS = (
    ('run', '{run}'), ('frames', '{frames}'), ('tracked', '{tracked}'), ('ATE RMSE cm', '{ate_cm:.2f}'),
    ('PSNR dB', '{psnr_db:.2f}'), ('PSNR full dB', '{psnr_full_db:.2f}'), ('SSIM', '{ssim:.3f}'),
    ('depth L1 cm', '{depth_cm:.2f}'), ('Gaussians', '{num_gaussians}'), ('peak MB', '{peak_rss_mb:.0f}'),
    ('fps', '{fps:.2f}'),
)  # fmt: skip


def through_the_node(bag: Path, out: Path, preset: str, overrides: list[str]) -> None:
    """Play a bag into the node, without dropping a frame."""
    parameters = [f'preset:={preset}', f'save_path:={out}', 'queue_policy:=all', 'exit_on_publisher_end:=true',
                  'slam.threads:=1', *(f'slam.{entry.replace("=", ":=", 1)}' for entry in overrides)]  # fmt: skip
    with Processes() as processes:
        flags = [word for parameter in parameters for word in ('-p', parameter)]
        node = processes.start('splatam_node', '--ros-args', *flags, log=out.with_suffix('.log'))
        player = processes.start('splatam_bag_player', str(bag), '--rate', 'max', '--wait-for')
        wait_for_both(player, node)
        processes.run('splatam', 'evaluate', str(out), '--truth', str(bag))


def offline(bag: Path, out: Path, preset: str, overrides: list[str]) -> None:
    """Process the same frames without ROS."""
    flags = [word for entry in overrides for word in ('--set', entry)]
    command = ['-m', 'splatam_core.cli', 'run', str(bag), '--preset', preset, '--out', str(out), *flags]
    subprocess.run([sys.executable, *command], check=True)


def table_row(run: str, folder: Path) -> str:
    """Returns the metrics of a run folder as a line of Markdown."""
    metrics = json.loads((folder / 'metrics.json').read_text())
    values = {**metrics, 'run': run, 'ate_cm': 100 * metrics['ate_rmse_m'], 'depth_cm': 100 * metrics['depth_l1_m']}
    return '| ' + ' | '.join(form.format(**values) for _, form in COLUMNS) + ' |'


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('source')
    parser.add_argument('--preset', default='quick')
    parser.add_argument('--width', default='320')
    parser.add_argument('--max-frames')
    parser.add_argument('--set', dest='overrides', action='append', default=[], metavar='KEY=VALUE')
    parser.add_argument('--out', type=Path)
    args = parser.parse_args()
    out = args.out or Path('out/benchmarks') / f'{Path(args.source).name}_{args.preset}_{args.width}'
    out.mkdir(parents=True)
    bag = out / 'recording'
    cut = ['--max-frames', args.max_frames] if args.max_frames else []
    convert = ['-m', 'splatam_core.cli', 'convert', args.source, str(bag), '--width', args.width, *cut]
    subprocess.run([sys.executable, *convert], check=True)
    through_the_node(bag, out / 'node', args.preset, args.overrides)
    offline(bag, out / 'offline', args.preset, ['threads=1', *args.overrides])
    offline(bag, out / 'all_cores', args.preset, args.overrides)

    print_header(f'{Path(args.source).name}, preset `{args.preset}`, width {args.width}', 1)
    print('| ' + ' | '.join(name for name, _ in COLUMNS) + ' |')
    print('|' + '---|' * len(COLUMNS))
    for run, name in (('node', 'node, 1 thread'), ('offline', 'offline, 1 thread'), ('all_cores', 'offline, all cores')):
        print(table_row(name, out / run))
    same = [(out / 'node' / name).read_bytes() == (out / 'offline' / name).read_bytes() for name in ('trajectory.txt', 'map.ply')]
    print(f'\nNode and offline bit-identical: poses {"yes" if same[0] else "NO"}, map {"yes" if same[1] else "NO"}.')


if __name__ == '__main__':
    main()
