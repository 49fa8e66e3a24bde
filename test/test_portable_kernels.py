"""The kernels of 64-bit ARM are vector code: GCC takes apart, lane by lane, what does not fit the registers."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

CSRC = Path(__file__).resolve().parents[1] / 'splatam_core/csrc'
ARM = 'aarch64-linux-gnu'
# The last two may be inlined into others.
KERNELS = ('project', 'forward', 'fit', 'project_back', 'update', 'align', 'backward_tile', 'blend_back')
# Arithmetic on single values; a register of one value is called s0 or d0, a vector v0.4s.
SCALAR = re.compile(r'^f(?!mov|cvt)\w+\s+[sd]\d+, (?!v)')
VECTOR = re.compile(r'^f(?!mov)\w+\s+v\d+')


def flags() -> list[str]:
    """Those of setup.py."""
    found = re.search(r'COMPILE_FLAGS = \[(.*?)\]', (CSRC.parents[1] / 'setup.py').read_text(), re.DOTALL)
    return re.findall(r"'(-[^']+)'", found.group(1))


@pytest.fixture(scope='module')
def functions(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[tuple[int, str]]]:
    """Addresses and instructions of every kernel, by its signature."""
    if shutil.which(f'{ARM}-g++') is None:
        pytest.skip(f'no {ARM}-g++ (apt install g++-{ARM})')
    compiled = tmp_path_factory.mktemp('arm') / 'kernels.o'
    subprocess.run([f'{ARM}-g++', *flags(), '-c', str(CSRC / 'kernels_generic.cpp'), '-o', str(compiled)], check=True)
    listing = subprocess.run(
        [f'{ARM}-objdump', '--disassemble', '--no-show-raw-insn', '--demangle', str(compiled)],
        capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    by_name = {}
    for block in re.split(r'\n(?=[0-9a-f]+ <)', listing)[1:]:
        name, *lines = block.splitlines()
        instructions = [re.match(r'\s*([0-9a-f]+):\s+(.*)', line) for line in lines]
        if re.search(rf'generic::({"|".join(KERNELS)})[(<]', name):
            by_name[name] = [(int(found[1], 16), found[2]) for found in instructions if found]
    return by_name


def innermost_loops(instructions: list[tuple[int, str]]) -> list[list[str]]:
    """Each loop that contains no other: from the target of a branch backwards to the branch."""
    ends = []
    for address, text in instructions:
        found = re.match(r'(?:b|cbn?z|tbn?z)\S*\s+(?:.*, )?([0-9a-f]+) <', text)
        if found and instructions[0][0] <= int(found[1], 16) <= address:
            ends.append((int(found[1], 16), address))
    inner = [(a, b) for a, b in ends if not any(a <= c and d <= b and (a, b) != (c, d) for c, d in ends)]
    return [[text for address, text in instructions if a <= address <= b] for a, b in inner]


def test_no_loop_of_the_arm_kernels_computes_single_values(functions: dict[str, list[tuple[int, str]]]) -> None:
    """What is left stands outside: what is constant over a tile or an image."""
    assert {name for name in KERNELS if any(f'generic::{name}' in signature for signature in functions)} >= {*KERNELS} - {
        'blend_back'
    }
    loops = 0
    for signature, instructions in functions.items():
        for loop in innermost_loops(instructions):
            loops += sum(bool(VECTOR.match(text)) for text in loop) > 8
            # A row's loss is added as a double.
            assert not [text for text in loop if SCALAR.match(text) and not text.startswith('fadd\td')], signature
    assert loops >= 6  # project, forward, backward with and without colours, fit, align: they were found
    texts = [text for instructions in functions.values() for _, text in instructions]
    scalar, vector = (sum(bool(pattern.match(text)) for text in texts) for pattern in (SCALAR, VECTOR))
    assert scalar < 0.03 * vector, (scalar, vector)  # 332 to 94 with vectors of 32 bytes, in `forward` alone


def test_loops_are_found() -> None:
    """The parser above, on a loop within a loop."""
    code = [
        (0, 'fmov s0, #1.0'),
        (4, 'fadd s0, s0, s1'),
        (8, 'fmul v0.4s, v0.4s, v1.s[0]'),
        (12, 'b.ne\t8 <f+0x8>'),
        (16, 'b 4 <f+0x4>'),
    ]
    assert innermost_loops(code) == [['fmul v0.4s, v0.4s, v1.s[0]', 'b.ne\t8 <f+0x8>']]
    assert [bool(SCALAR.match(text)) for _, text in code[:3]] == [False, True, False]
    assert [bool(SCALAR.match(text)) for text in ('fmaxv s0, v1.4s', 'faddp d0, v1.2d', 'fcsel s1, s2, s3, gt', 'fcmp s0, s1')] == [
        False, False, True, True,
    ]  # fmt: skip
