"""Datasets: whatever is wrong with a file of a recording, frames are read or one line says what is wrong."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
from damage import damages_of
from dataset_layouts import LAYOUTS
from hypothesis import strategies as st
from test_field_damage import one_of_each_kind

from kinds.base import Case, Kind, Tally
from kinds.damaged import damage
from splatam_core.datasets.registry import open_sequence


@dataclass(frozen=True)
class Recording:
    """A recording, and the bytes of its files: of those that differ only by their number, the first."""

    source: Path
    options: dict[str, object]
    files: dict[Path, bytes] = field(repr=False)


@dataclass(frozen=True)
class Change:
    """Other bytes for a file."""

    file: Path
    data: bytes


def record(folder: Path, name: str) -> Recording:
    """Writes a recording."""
    source = LAYOUTS[name].write(folder)
    return Recording(source, LAYOUTS[name].options, {path: path.read_bytes() for path in one_of_each_kind(folder)})


@st.composite
def changes(draw: st.DrawFn, recording: Recording) -> list[Change]:
    """Damage to one file of a recording, and now and then to a second one."""
    files = draw(st.lists(st.sampled_from(sorted(recording.files)), min_size=1, max_size=2, unique=True))
    return [Change(file, draw(damaged_file(file.suffix, recording.files[file]))) for file in files]


@st.composite
def damaged_file(draw: st.DrawFn, suffix: str, whole: bytes) -> bytes:
    """Damage of the kinds that files with a suffix can have, or of any."""
    if not draw(st.integers(0, 3)):
        return draw(damage(whole))
    kinds = damages_of(suffix)
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    return kinds[draw(st.sampled_from(sorted(kinds)))](whole, rng)


def read_whole(source: Path, options: dict[str, object]) -> None:
    """Reads an undamaged recording; the libraries that this loads are then there for every child of the fuzzer."""
    tally = Tally()
    read_all(tally, source, options)
    tally.end_input()
    assert tally.used, f'{source} cannot be read'


def read_all(tally: Tally, source: Path, options: dict[str, object]) -> None:
    """Reads every frame of a recording, and its ground truth."""
    sequence = tally.attempt(partial(open_sequence, str(source), **options))
    if sequence is None:
        return
    for index in range(len(sequence)):
        frame = tally.attempt(partial(sequence.__getitem__, index))
        assert frame is None or (np.isfinite(frame.depth_m).all() and frame.rgb.dtype == np.uint8)
    truth = tally.attempt(sequence.ground_truth)
    assert truth is None or np.isfinite(truth.T_world_cam).all()


def check(recording: Recording, tally: Tally, changed: list[Change]) -> None:
    try:
        for change in changed:
            change.file.write_bytes(change.data)
        read_all(tally, recording.source, recording.options)
    finally:
        for change in changed:
            change.file.write_bytes(recording.files[change.file])


def cases(folder: Path) -> list[Case]:
    result = []
    for name, layout in LAYOUTS.items():
        if layout.format == 'rosbag' or (name == 'record3d' and importlib.util.find_spec('OpenEXR') is None):
            continue
        (folder / name).mkdir()
        recording = record(folder / name, name)
        read_whole(recording.source, recording.options)
        result.append(Case(name, changes(recording), partial(check, recording), short=6))
    return result


KIND = Kind('dataset files', 61_000, cases, memory_mb=1024)  # an image may state 8192x8192 pixels
