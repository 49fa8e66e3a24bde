"""Whatever a run folder, an archive, a map or a configuration holds, reading it gives a result or one line: a ``SplatamError``.

``SPLATAM_FUZZ_EXAMPLES=10000`` tries that many files of each kind instead of a few.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import shutil
import tracemalloc
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from splatam_core.config import load_config, to_yaml
from splatam_core.datasets.registry import open_sequence
from splatam_core.errors import CheckpointError, MapFileError, RunFolderError, SplatamError
from splatam_core.maps.ply import read_ply, write_ply
from splatam_core.runs.archive import Content, pack, read_archive
from splatam_core.runs.checkpoints import KIND, VERSION, Checkpoints, Progress, checkpoint_paths, read_newest
from splatam_core.runs.layout import check_is_free, remove_run
from splatam_core.runs.record import RunDescription, Source, read_run
from splatam_core.runs.resume import _restore
from splatam_core.runs.writer import RunFolder
from splatam_core.slam import Slam

EXAMPLES = int(os.environ.get('SPLATAM_FUZZ_EXAMPLES', '40'))
FUZZ = settings(
    max_examples=EXAMPLES, deadline=None, database=None, derandomize=EXAMPLES == 40,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow, HealthCheck.data_too_large],
)  # fmt: skip
CONFIG = load_config('quick', ['threads=1', 'tracking.iterations=2', 'mapping.iterations=2', 'keyframes.every=2'])

JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.integers(-(10**400), 10**400) | st.floats() | st.text(max_size=8)
    | st.sampled_from(['', '.', '../..', 'x' * 5000, '\0', 'NaN', '1e400']),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3), max_leaves=5,
)  # fmt: skip
WORDS = st.sampled_from(
    ['nan', 'inf', '-1', '0', '1e400', '1e-400', '9' * 5000, '', '\0', '\ufeff', '"', "'", '\\', ';', '#', '# lost', '\t', 'é', '٣',
     '²', '1_000', '0x10', '+', '- - -', '{', '[' * 3000, '&a [*a]', '*a', '!!python/object:os.system', '2020-13-45', '1:99', '\r',
     '\x85', '\u2028', '9223372036854775808', '-9223372036854775809', 'true', '~', 'null', ',' * 40]
)  # fmt: skip


@dataclass(frozen=True)
class Pristine:
    """A finished run with checkpoints, and its files' bytes."""

    path: Path
    files: dict[str, bytes]


@pytest.fixture(scope='module')
def pristine(tmp_path_factory: pytest.TempPathFactory) -> Pristine:
    path = tmp_path_factory.mktemp('hostile') / 'run'
    sequence, slam = open_sequence('synthetic:noise=off', width=32, max_frames=4), Slam(CONFIG)
    description = RunDescription('splatam run', 'quick', Source('synthetic:noise=off', width=32, max_frames=4), 2)
    with RunFolder.create(path, CONFIG, description) as folder:
        for index in range(4):
            frame = sequence[index]
            folder.append(frame, slam.process(frame), 0.1, 0.1)
        Checkpoints(path / 'checkpoints', 2).save(slam.state(), Progress(4, 3, '0' * 64, 4))
        folder.save(slam)
    files = {str(file.relative_to(path)): file.read_bytes() for file in path.rglob('*') if file.is_file()}
    return Pristine(path, files)


@st.composite
def damage(draw: st.DrawFn, data: bytes) -> bytes:
    """The bytes, changed in a few places."""
    result = bytearray(data)
    for _ in range(draw(st.integers(1, 3))):
        at = draw(st.integers(0, len(result)))
        kind = draw(st.sampled_from(['flip', 'cut', 'drop', 'insert', 'word', 'repeat', 'line']))
        if kind == 'flip' and at < len(result):
            result[at] ^= 1 << draw(st.integers(0, 7))
        elif kind == 'cut':
            del result[at:]
        elif kind == 'drop':
            del result[at : at + draw(st.integers(1, 20))]
        elif kind == 'insert':
            result[at:at] = draw(st.binary(max_size=20))
        elif kind == 'repeat':
            result[at:at] = result[: draw(st.integers(0, len(result)))]
        else:
            begin = result.rfind(b'\n', 0, at) + 1 if kind == 'line' else at
            end = result.find(b'\n', at) if kind == 'line' else at + draw(st.integers(0, 8))
            result[begin : max(begin, end)] = draw(WORDS).encode()
    return bytes(result)


@st.composite
def json_damage(draw: st.DrawFn, data: bytes) -> bytes:
    """A JSON object of which some values, at any depth, are replaced."""
    tree = json.loads(data)
    for _ in range(draw(st.integers(1, 3))):
        node, key = tree, draw(st.sampled_from(sorted(tree)))
        while isinstance(node[key], dict) and node[key] and draw(st.booleans()):
            node, key = node[key], draw(st.sampled_from(sorted(node[key])))
        if draw(st.booleans()):
            node[key] = draw(JSON)
        else:
            del node[key]
        if not tree:
            break
    return json.dumps(tree).encode()


def attempt(use: Callable[[], object], *kinds: type[SplatamError]) -> None:
    """Runs something that may raise the project's own errors, in one line, and no others."""
    try:
        use()
    except SplatamError as error:
        assert isinstance(error, kinds or SplatamError), repr(error)
        assert str(error) and '\n' not in str(error) and len(str(error)) < 3000


def use_run(path: Path) -> None:
    run = read_run(path)
    attempt(run.metrics, RunFolderError)
    attempt(run.read_map, RunFolderError, MapFileError)
    assert len(run.stamps_ns()) == len(run.trajectory) + len(run.lost_ns)
    run.metrics().to_json()


@pytest.mark.parametrize('name', ['run.json', 'metrics.json', 'trajectory.txt', 'frames.csv', 'config.yaml', 'map.ply'])
@FUZZ
@given(data=st.data())
def test_run_folders(name: str, pristine: Pristine, data: st.DataObject) -> None:
    if (original := pristine.files[name]) != (pristine.path / name).read_bytes():
        (pristine.path / name).write_bytes(original)
    changes = damage(original) | json_damage(original) if name.endswith('.json') else damage(original)
    try:
        (pristine.path / name).write_bytes(data.draw(changes))
        attempt(lambda: use_run(pristine.path))
        attempt(lambda: check_is_free(pristine.path))
    finally:
        (pristine.path / name).write_bytes(original)


def test_a_cell_of_a_hundred_kilobytes(pristine: Pristine) -> None:
    """Beyond the limit of the csv library."""
    file, original = pristine.path / 'frames.csv', pristine.files['frames.csv']
    try:
        file.write_bytes(original[:-1] + b'x' * 200_000 + b'\n')
        attempt(lambda: use_run(pristine.path), RunFolderError)
    finally:
        file.write_bytes(original)


@FUZZ
@given(data=st.data())
def test_overwrite_of_a_damaged_run_json(pristine: Pristine, data: st.DataObject, tmp_path: Path) -> None:
    folder = tmp_path / 'run'
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    (folder / 'run.json').write_bytes(data.draw(damage(pristine.files['run.json']) | json_damage(pristine.files['run.json'])))
    (folder / 'mine.txt').touch()
    with pytest.raises(RunFolderError):
        remove_run(folder)
    assert len(list(folder.iterdir())) == 2


def sealed(payload: bytes, kind: str = KIND) -> bytes:
    """An archive whose checksum is right, whatever it holds."""
    return f'splatam_ros {kind} {VERSION} {hashlib.sha256(payload).hexdigest()}\n'.encode() + payload


def use_checkpoint(folder: Path) -> None:
    checkpoint = read_newest(folder)
    slam = Slam(CONFIG)
    attempt(lambda: _restore(slam, checkpoint))


def newest(pristine: Pristine) -> tuple[Path, bytes]:
    path = checkpoint_paths(pristine.path / 'checkpoints')[-1]
    return path, pristine.files[str(path.relative_to(pristine.path))]


def with_checkpoint(pristine: Pristine, content: bytes) -> None:
    path, original = newest(pristine)
    try:
        path.write_bytes(content)
        attempt(lambda: use_checkpoint(path.parent), CheckpointError)
    finally:
        path.write_bytes(original)


@FUZZ
@given(data=st.data())
def test_checkpoints_with_a_right_checksum_around_damaged_bytes(pristine: Pristine, data: st.DataObject) -> None:
    _, original = newest(pristine)
    with_checkpoint(pristine, sealed(data.draw(damage(original.split(b'\n', 1)[1]))))


@FUZZ
@given(data=st.data())
def test_checkpoints_with_other_values(pristine: Pristine, data: st.DataObject) -> None:
    path, _ = newest(pristine)
    content = read_archive(path, KIND, VERSION)
    values = json.loads(data.draw(json_damage(json.dumps(dict(content.values)).encode())))
    archive = pack(KIND, VERSION, Content(values, content.arrays))
    with_checkpoint(pristine, archive.header + bytes(archive.payload))


ARRAYS = hnp.arrays(
    st.sampled_from(['f4', 'f8', 'u1', 'i8', '>f4', 'c8', 'b1', 'S3', 'U2', 'M8[ns]', 'f2']),
    hnp.array_shapes(min_dims=0, max_side=4),
)


@FUZZ
@given(data=st.data())
def test_checkpoints_with_other_arrays(pristine: Pristine, data: st.DataObject) -> None:
    path, _ = newest(pristine)
    content = read_archive(path, KIND, VERSION)
    arrays = dict(content.arrays)
    for name in data.draw(st.lists(st.sampled_from(sorted(arrays)), min_size=1, max_size=3, unique=True)):
        kind = data.draw(st.sampled_from(['other', 'none', 'not finite', 'dtype']))
        if kind == 'none':
            del arrays[name]
        elif kind == 'not finite' and arrays[name].dtype.kind == 'f' and arrays[name].size:
            arrays[name] = arrays[name].copy()
            arrays[name].flat[0] = data.draw(st.sampled_from([np.nan, np.inf, -np.inf]))
        else:
            arrays[name] = arrays[name].astype('f2') if kind == 'dtype' else data.draw(ARRAYS)
    archive = pack(KIND, VERSION, Content(content.values, arrays))
    with_checkpoint(pristine, archive.header + bytes(archive.payload))


HEADERS = [
    b"{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000000,), }",
    b"{'descr': '|O', 'fortran_order': False, 'shape': (1,)}",
    b"{'descr': '<f4', 'fortran_order': False, 'shape': (-1,), }",
    b"{'descr': [('a', '<f4', (1000000,1000000))], 'fortran_order': 1, 'shape': (2,2)}",
    b'(' * 3000, b"{'descr': '<f4'", b'9L 9L', b'"""', b'\\' * 9,
]  # fmt: skip


def npy(header: bytes, end: bytes) -> bytes:
    return b'\x93NUMPY\x01\x00' + len(header).to_bytes(2, 'little') + header + end


@FUZZ
@given(
    names=st.lists(st.sampled_from(['values', 'values.npy', 'x.npy', '../x.npy', 'x/', 'map.means.npy']), max_size=3),
    body=st.binary(max_size=60) | st.builds(npy, st.sampled_from(HEADERS), st.binary(max_size=8)),
    method=st.sampled_from([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA]),
)
@pytest.mark.filterwarnings('ignore:Duplicate name', 'ignore:Reading `.npy` or `.npz` file required additional header parsing')
def test_archives_of_anything(names: list[str], body: bytes, method: int, tmp_path: Path) -> None:
    payload = io.BytesIO()
    with zipfile.ZipFile(payload, 'w', method) as archive:
        for name in names:
            archive.writestr(name, body)
    path = tmp_path / 'x.checkpoint'
    path.write_bytes(sealed(payload.getvalue()))
    attempt(lambda: read_archive(path, KIND, VERSION), CheckpointError)


def test_an_archive_is_not_unpacked_before_its_size_is_known(tmp_path: Path) -> None:
    """Three megabytes that unpack to three gigabytes; and an array that claims more than there is."""
    bomb, claim = io.BytesIO(), io.BytesIO()
    with zipfile.ZipFile(bomb, 'w', zipfile.ZIP_DEFLATED) as archive, archive.open('map.means.npy', 'w', force_zip64=True) as file:
        for _ in range(300):
            file.write(bytes(1 << 20))
    header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (500000000,), }".ljust(117) + b'\n'
    with zipfile.ZipFile(claim, 'w') as archive:
        archive.writestr('values.npy', b'\x93NUMPY\x01\x00' + len(header).to_bytes(2, 'little') + header)
    for payload, said in ((bomb, 'it is compressed'), (claim, 'do not take 0 bytes')):
        path = tmp_path / 'x.checkpoint'
        path.write_bytes(sealed(payload.getvalue()))
        tracemalloc.start()
        with pytest.raises(CheckpointError, match=said):
            read_archive(path, KIND, VERSION)
        assert tracemalloc.get_traced_memory()[1] < 20 << 20
        tracemalloc.stop()


@FUZZ
@given(data=st.data())
def test_keyframes(pristine: Pristine, data: st.DataObject) -> None:
    name = next(name for name in pristine.files if name.endswith('.keyframe'))
    path, original = pristine.path / name, pristine.files[name]
    try:
        path.write_bytes(data.draw(damage(original)))
        attempt(lambda: use_checkpoint(pristine.path / 'checkpoints'), CheckpointError)
    finally:
        path.write_bytes(original)


@FUZZ
@given(
    values=hnp.arrays('f4', (3, 17), elements=st.floats(width=32)),
    header=st.lists(st.sampled_from(
        ['property float x', 'property double y', 'property float z', 'property uchar z', 'element vertex 3', 'element vertex 0',
         'element vertex ' + '9' * 5000, 'element vertex ٣', 'element face 3', 'property list uchar int vertex_indices', 'comment',
         'format ascii 1.0', 'end_header', 'property float \xe9', 'property', 'element', 'property float ' + 'a' * 3000, '']
    ), max_size=3),
    at=st.integers(0, 22),
)  # fmt: skip
def test_maps_of_any_values_and_headers(values: np.ndarray, header: list[str], at: int, pristine: Pristine, tmp_path: Path) -> None:
    lines = pristine.files['map.ply'].split(b'end_header\n')[0].split(b'\n')[:-1]
    lines = [b'element vertex 3' if line.startswith(b'element vertex') else line for line in lines]
    lines[at:at] = [line.encode() for line in header]
    path = tmp_path / 'map.ply'
    path.write_bytes(b'\n'.join([*lines, b'end_header', b'']) + values.tobytes())

    def use() -> None:
        gaussians = read_ply(path)
        assert all(bool(torch.isfinite(part).all()) for part in (gaussians.means, gaussians.log_scales, gaussians.rgb))
        write_ply(tmp_path / 'again.ply', gaussians)
        assert len(read_ply(tmp_path / 'again.ply')) == len(gaussians)

    attempt(use, MapFileError)


@settings(FUZZ, max_examples=max(1, EXAMPLES // 4))  # YAML takes a second a file
@given(data=st.data())
def test_configurations(data: st.DataObject, tmp_path: Path) -> None:
    path = tmp_path / 'config.yaml'
    path.write_bytes(data.draw(damage(to_yaml(CONFIG).encode())))
    attempt(lambda: load_config(str(path)))


NAMES = ['seed', 'width', 'depth.max_m', 'mapping', 'mapping.means_rate', 'keyframes.overlap_samples', '']


@FUZZ
@given(name=st.sampled_from(NAMES), value=WORDS | JSON.map(json.dumps))
def test_overrides(name: str, value: str) -> None:
    attempt(lambda: load_config('quick', [f'{name}={value}']))


@pytest.mark.parametrize('kind', ['fifo', 'folder', 'socket-like device'])
def test_reading_waits_for_nothing(kind: str, tmp_path: Path) -> None:
    path = tmp_path / 'map.ply'
    if kind == 'fifo':
        os.mkfifo(path)
    elif kind == 'folder':
        path.mkdir()
    else:
        path = Path('/dev/zero')
    for read, error in ((read_ply, MapFileError), (lambda path: read_archive(path, KIND, VERSION), CheckpointError)):
        with pytest.raises(error, match='(?i)directory|not a regular file'):
            read(path)
