"""Compare two checkouts bit for bit: are trajectory.txt and map.ply the same, for every preset and recording?

    python benchmarks/same_results.py OLD_CHECKOUT NEW_CHECKOUT [--data DIR] [--out out/same_results]

Every run uses one thread, which makes it repeatable. Each checkout needs its native module, built in place by
``python setup.py build_ext --inplace``. Results of a clean checkout are kept under OUT by commit and used again.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from header import print_header

FILES = ('trajectory.txt', 'map.ply')


@dataclass(frozen=True)
class Case:
    """One run: a preset on a recording, of which ``max_frames`` frames are used (0 = all)."""

    preset: str
    recording: str
    max_frames: int

    @property
    def name(self) -> str:
        """Folder name of the case."""
        return f'{self.preset}_{self.recording}'


CASES = [
    Case(preset, recording, max_frames)
    for preset, max_frames in (('quick', 0), ('realtime', 0), ('splatam', 60))
    for recording in ('7scenes_redkitchen', 'tum_fr1_rpy')
]


def commit_of(checkout: Path) -> str:
    """The commit of a checkout; ``-dirty`` is appended where tracked files were changed."""
    describe = ['git', '-C', str(checkout), 'describe', '--always', '--dirty', '--abbrev=10', '--exclude=*']
    return subprocess.run(describe, check=True, capture_output=True, text=True).stdout.strip()


def run_case(checkout: Path, case: Case, data: Path, out: Path) -> Path:
    """Run a case with the code of a checkout. Returns the run folder."""
    folder = out / commit_of(checkout) / case.name
    if folder.joinpath(FILES[-1]).is_file() and not folder.parent.name.endswith('-dirty'):
        return folder
    command = [
        sys.executable, '-m', 'splatam_core.cli', 'run', str(data / case.recording), '--preset', case.preset,
        '--width', '320', '--set', 'threads=1', '--no-evaluate', '--overwrite', '--out', str(folder),
    ]  # fmt: skip
    if case.max_frames:
        command += ['--max-frames', str(case.max_frames)]
    folder.parent.mkdir(parents=True, exist_ok=True)
    environment = {**os.environ, 'PYTHONPATH': str(checkout)}
    with folder.with_suffix('.log').open('w') as log:
        subprocess.run(command, check=True, cwd=checkout, env=environment, stdout=log, stderr=log)
    return folder


def main() -> int:
    """Run all cases with both checkouts; returns 1 if a file differs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('old', type=Path)
    parser.add_argument('new', type=Path)
    parser.add_argument('--data', type=Path, default=Path(os.environ.get('SPLATAM_DATA', '../shared/data')))
    parser.add_argument('--out', type=Path, default=Path('out/same_results'))
    args = parser.parse_args()
    old, new, data, out = (path.resolve() for path in (args.old, args.new, args.data, args.out))

    print_header(f'{commit_of(old)} and {commit_of(new)}, width 320, one thread', 1)
    print(f'| preset | recording | frames | {" | ".join(FILES)} |')
    print('|---|---|---|' + '---|' * len(FILES))
    differs = False
    for case in CASES:
        before, after = (run_case(checkout, case, data, out) for checkout in (old, new))
        same = [(before / name).read_bytes() == (after / name).read_bytes() for name in FILES]
        differs |= not all(same)
        verdicts = ' | '.join('same' if is_same else '**differs**' for is_same in same)
        print(f'| {case.preset} | {case.recording} | {case.max_frames or "all"} | {verdicts} |', flush=True)
    return int(differs)


if __name__ == '__main__':
    sys.exit(main())
