"""The checkpoint archive (splatam_core/runs/archive.py) against safetensors: time, size, and what damage does.

    pip install safetensors    # for this benchmark only
    python benchmarks/archive_formats.py [--runs 9] [--flips 4000]

The checkpoint is that of a long run at 320x240: 130,000 Gaussians with their optimizer state, and 60 keyframes in files of
their own. All formats are written in the same way: to a temporary file, fsync, rename. Damage is tried on a smaller
checkpoint of the same form: one flipped bit at a time, and files cut short at each of many lengths.
docs/decisions/0007-archive-format.md draws the conclusion.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib
import json
import os
import statistics
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from header import print_header, timed_ms

from splatam_core.atomic_io import replaced
from splatam_core.errors import CheckpointError
from splatam_core.rasterizer.bounds import BLOCK
from splatam_core.runs.archive import Content, pack, read_archive

NUM_GAUSSIANS, NUM_KEYFRAMES, WIDTH, HEIGHT = 130_000, 60, 320, 240
NUM_GAUSSIANS_DAMAGED = 500
KIND, VERSION = 'checkpoint', 1
TRUNCATIONS = 500


class ChecksumError(Exception):
    """The bytes are not those of the checksum."""


@dataclass(frozen=True, slots=True)
class ArchiveFormat:
    """One way to write a checkpoint.

    Attributes:
        name: in the tables.
        write: writes some content to a path.
        read: reads it back.
        errors: what ``read`` raises for a damaged file.
    """

    name: str
    write: Callable[[Path, Content], None]
    read: Callable[[Path], Content]
    errors: tuple[type[Exception], ...]


def formats() -> list[ArchiveFormat]:
    """Returns the formats to compare.

    Raises:
        SystemExit: safetensors is not installed.
    """
    try:
        safetensors, tensors = (importlib.import_module(name) for name in ('safetensors', 'safetensors.numpy'))
    except ImportError as missing:
        raise SystemExit(f'{missing}: pip install safetensors') from None

    def to_bytes(content: Content) -> bytes:
        return tensors.save(dict(content.arrays), metadata={'values': json.dumps(content.values)})

    def read_plain(path: Path) -> Content:
        with safetensors.safe_open(path, framework='numpy') as file:
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 -- no mapping
            return Content(json.loads(file.metadata()['values']), arrays)

    def write_hashed(path: Path, content: Content) -> None:
        data = to_bytes(content)
        write_bytes(path, hashlib.sha256(data).hexdigest().encode() + b'\n', data)

    def read_hashed(path: Path) -> Content:
        stated, _, data = path.read_bytes().partition(b'\n')
        if hashlib.sha256(data).hexdigest().encode() != stated:
            raise ChecksumError
        length = int.from_bytes(data[:8], 'little')  # ``load`` does not return the metadata
        values = json.loads(data[8 : 8 + length])['__metadata__']['values']
        return Content(json.loads(values), tensors.load(data))

    def write_plain(path: Path, content: Content) -> None:
        write_bytes(path, to_bytes(content))

    def write_in_use(path: Path, content: Content) -> None:
        pack(KIND, VERSION, content).write(path)

    def read_in_use(path: Path) -> Content:
        return read_archive(path, KIND, VERSION)

    refusal = safetensors.SafetensorError
    return [
        ArchiveFormat('SHA-256 line + npz (in use)', write_in_use, read_in_use, (CheckpointError,)),
        ArchiveFormat('safetensors', write_plain, read_plain, (refusal,)),
        ArchiveFormat('SHA-256 line + safetensors', write_hashed, read_hashed, (refusal, ChecksumError)),
    ]


def write_bytes(path: Path, *parts: bytes) -> None:
    """Writes a file in one step, as the archive does."""
    with replaced(path) as temporary, temporary.open('wb') as file:
        for part in parts:
            file.write(part)


def checkpoint(num_gaussians: int, num_keyframes: int) -> Content:
    """Returns what a checkpoint holds; the numbers are random, the names, shapes and types are those of a run."""
    rng = np.random.default_rng(0)
    shapes = {'means': (3,), 'log_scales': (1,), 'logit_opacities': (), 'rgb': (3,), 'first_second': (16,)}
    arrays: dict[str, Any] = {
        f'map.{name}': rng.standard_normal((num_gaussians, *shape), np.float32) for name, shape in shapes.items()
    }
    arrays['map.steps'] = rng.integers(0, 255, num_gaussians, np.uint8)
    arrays['map.bounds'] = rng.standard_normal((-(-num_gaussians // BLOCK), 7), np.float32)
    arrays |= {'T_world_cam': np.eye(4), 'velocity': rng.standard_normal(6)}
    keyframes = [hashlib.sha256(bytes([index])).hexdigest() for index in range(num_keyframes)]
    config = {f'section.setting_{index}': 0.5 for index in range(80)}
    return Content({'rng': rng.bit_generator.state, 'keyframes': keyframes, 'config': config}, arrays)


def keyframe(index: int) -> Content:
    """Returns what the file of a keyframe holds."""
    rng = np.random.default_rng(index)
    rgb8 = rng.integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
    depth = rng.random((HEIGHT, WIDTH), np.float32)
    return Content({}, {'rgb8': rgb8, 'depth': depth, 'T_cam_world': np.eye(4, dtype=np.float32)})


def speed_row(form: ArchiveFormat, folder: Path, runs: int) -> str:
    """Returns a row of the first table."""
    state, frames = checkpoint(NUM_GAUSSIANS, NUM_KEYFRAMES), [keyframe(index) for index in range(NUM_KEYFRAMES)]
    path, paths = folder / 'state', [folder / f'keyframe_{index}' for index in range(NUM_KEYFRAMES)]
    write_ms = statistics.median(timed_ms(lambda: form.write(path, state), runs))
    one_ms = statistics.median(timed_ms(lambda: form.write(paths[0], frames[0]), runs))
    for frame_path, frame in zip(paths, frames):
        form.write(frame_path, frame)
    read_ms = statistics.median(timed_ms(lambda: form.read(path), runs))
    resume_ms = statistics.median(timed_ms(lambda: [form.read(entry) for entry in (path, *paths)], runs))
    sizes = path.stat().st_size, paths[0].stat().st_size
    cells = f'{write_ms:.1f}', f'{one_ms:.2f}', f'{read_ms:.1f}', f'{resume_ms:.1f}', f'{sizes[0]:,}', f'{sizes[1]:,}'
    return f'| {form.name} | {" | ".join(cells)} |'


def damage_row(form: ArchiveFormat, folder: Path, flips: int) -> str:
    """Returns a row of the second table."""
    path, content = folder / 'damaged', checkpoint(NUM_GAUSSIANS_DAMAGED, 4)
    form.write(path, content)
    data = path.read_bytes()
    rng = np.random.default_rng(0)
    flipped: Counter[str] = Counter()
    for bit in (*range(8 * 160), *rng.integers(8 * len(data), size=flips).tolist()):  # the first line, and anywhere
        changed = bytearray(data)
        changed[bit // 8] ^= 1 << bit % 8
        flipped[outcome(form, path, bytes(changed), content)] += 1
    cut = Counter(
        outcome(form, path, data[:length], content) for length in rng.choice(len(data), TRUNCATIONS, replace=False).tolist()
    )
    counts = [flipped[name] for name in OUTCOMES] + [TRUNCATIONS - cut['refused'], cut['refused']]
    return f'| {form.name} | {" | ".join(f"{count:,}" for count in counts)} |'


OUTCOMES = 'refused', 'another error', 'accepted, same content', 'accepted, other content'


def outcome(form: ArchiveFormat, path: Path, data: bytes, content: Content) -> str:
    """Returns what reading these bytes comes to, one of ``OUTCOMES``."""
    path.write_bytes(data)
    try:
        found = form.read(path)
    except form.errors:
        return OUTCOMES[0]
    except Exception:  # noqa: BLE001 -- counted: a reader would have to expect all of these
        return OUTCOMES[1]
    is_same = found.values == content.values and found.arrays.keys() == content.arrays.keys()
    is_same = is_same and all(found.arrays[name].tobytes() == array.tobytes() for name, array in content.arrays.items())
    return OUTCOMES[2] if is_same else OUTCOMES[3]


def main() -> None:
    """Prints both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--runs', type=int, default=9, metavar='N', help='repetitions per time (default: %(default)s)')
    parser.add_argument('--flips', type=int, default=4000, metavar='N', help='bits to flip, one at a time (default: %(default)s)')
    args = parser.parse_args()
    compared = formats()
    print_header(f'Archive formats: {NUM_GAUSSIANS:,} Gaussians, {NUM_KEYFRAMES} keyframes of {WIDTH}x{HEIGHT}', args.runs)
    with tempfile.TemporaryDirectory(dir=os.environ.get('TMPDIR')) as name:
        folder = Path(name)
        print('| format | write state ms | write a keyframe ms | read state ms | read all ms | state bytes | keyframe bytes |')
        print('|---|---|---|---|---|---|---|')
        for form in compared:
            print(speed_row(form, folder, args.runs), flush=True)
        print(f'\nOne of {8 * 160 + args.flips:,} bits flipped; one of {TRUNCATIONS} lengths kept.\n')
        print(f'| format | {" | ".join(f"flip: {name}" for name in OUTCOMES)} | cut: accepted or another error | cut: refused |')
        print('|---|---|---|---|---|---|---|')
        for form in compared:
            print(damage_row(form, folder, args.flips), flush=True)


if __name__ == '__main__':
    main()
