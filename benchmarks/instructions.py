"""Instructions of the native passes, counted by callgrind: the same numbers on a busy machine as on an idle one.

    python benchmarks/instructions.py [CHECKOUT ...] [--isa generic avx2] [--size 96x72]

Counts one call of each pass in each checkout (default: this one), with each instruction set, on one thread: one Gaussian per
pixel. Each checkout needs its native module, built in place. Needs valgrind (``apt install valgrind``), which has no AVX-512.
Takes about two minutes for each checkout and instruction set.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import torch

PASSES = {
    'forward': 'splatam::Engine::forward', 'backward, map': 'splatam::Engine::backward', 'fit': 'splatam::Engine::fit',
    'align, one iteration': 'splatam::Aligner::linearize',
}  # fmt: skip


def work(size: str, isa: str) -> None:
    """Runs each pass once in this process, with the checkout that ``PYTHONPATH`` names."""
    sys.path.remove(str(Path(__file__).parent))  # the benchmarks of that checkout
    import kernels

    from splatam_core.rasterizer import Rates

    torch.set_num_threads(1)
    rasterizer, cam = kernels.CpuRasterizer(1), kernels.camera(*map(int, size.split('x')))
    if rasterizer.instruction_set != isa:
        raise SystemExit(f'this processor runs {rasterizer.instruction_set}, not {isa}')
    pose = torch.eye(4)
    pose[0, 3] = 0.003
    kernels.backward(rasterizer.render(kernels.with_gradients(kernels.wavy_wall(cam)), cam, pose))
    wall, view = kernels.GaussianMap(), kernels.wall_view(cam)
    wall.append(kernels.wavy_wall(cam))
    target = kernels.Target(cam, view.rgb8, view.depth, pose, 2.0, 0.35)
    rasterizer.fit(wall.gaussians, wall.moments, Rates(2e-5, 6e-3, 0.05, 0.015), target)
    if hasattr(kernels, 'passes'):  # 0.1.0 aligned by another call
        kernels.passes(isa, cam)['align, one iteration']()


def counted(checkout: Path, size: str, isa: str) -> dict[str, int]:
    """Returns the instructions of each pass in a checkout."""
    paths = os.pathsep.join(str(path) for path in (checkout, checkout / 'benchmarks'))
    environment = os.environ | {'PYTHONPATH': paths, 'SPLATAM_ISA': isa}
    with tempfile.TemporaryDirectory() as scratch:
        out = Path(scratch, 'out')
        command = ['valgrind', '--tool=callgrind', f'--callgrind-out-file={out}']
        command += [f'--toggle-collect={function}(*)' for function in PASSES.values()]  # but not the lambdas in them
        python = [sys.executable, __file__, '--one', '--size', size, '--isa', isa]
        done = subprocess.run([*command, *python], env=environment, capture_output=True, text=True)
        if done.returncode or not out.is_file():
            raise SystemExit(f'{checkout}: {done.stderr[-2000:]}')
        annotate = ['callgrind_annotate', '--inclusive=yes', '--threshold=100', str(out)]
        report = subprocess.run(annotate, check=True, capture_output=True, text=True).stdout
    found = {}
    for name, function in PASSES.items():
        line = re.search(rf'^ *([\d,]+) .*[: ]{re.escape(function)}\([^{{\n]*$', report, re.MULTILINE)
        if line is not None:
            found[name] = int(line[1].replace(',', ''))
    return found


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('checkouts', nargs='*', type=Path, default=[Path(__file__).parents[1]])
    parser.add_argument('--isa', nargs='+', default=['generic', 'avx2'])
    parser.add_argument('--size', default='96x72')
    parser.add_argument('--one', action='store_true', help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.one:
        work(args.size, args.isa[0])
        return
    print(f'Millions of instructions of one call, {args.size} pixels, one Gaussian per pixel, one thread.\n')
    print('| checkout | instruction set | ' + ' | '.join(PASSES) + ' |\n|' + '---|' * (2 + len(PASSES)))
    for checkout in args.checkouts:
        for isa in args.isa:
            found = counted(checkout.resolve(), args.size, isa)
            cells = (f'{1e-6 * found[name]:.1f}' if name in found else '–' for name in PASSES)
            print(f'| {checkout.resolve().name} | {isa} | ' + ' | '.join(cells) + ' |', flush=True)


if __name__ == '__main__':
    main()
