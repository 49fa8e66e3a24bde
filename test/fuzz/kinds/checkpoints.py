"""Checkpoints and archives: whatever they hold, also below a checksum that is right, Slam continues or one line says why not."""

from __future__ import annotations

import hashlib
import io
import json
import warnings
import zipfile
from functools import partial
from pathlib import Path

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from kinds.base import Case, Kind, Tally
from kinds.damaged import damage, json_damage
from kinds.finished_run import CONFIG, FinishedRun, finished_run
from splatam_core.errors import CheckpointError
from splatam_core.runs.archive import Content, pack, read_archive
from splatam_core.runs.checkpoints import KIND as ARCHIVE_KIND
from splatam_core.runs.checkpoints import VERSION, read_newest
from splatam_core.runs.resume import _restore
from splatam_core.slam import Slam

Arrays = dict[str, np.ndarray]
OTHER = hnp.arrays(
    st.sampled_from(['f4', 'f8', 'u1', 'i8', '>f4', 'c8', 'b1', 'S3', 'U2', 'M8[ns]', 'f2']),
    hnp.array_shapes(min_dims=0, max_side=4),
)
HEADERS = [
    b"{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000000,), }",
    b"{'descr': '|O', 'fortran_order': False, 'shape': (1,)}",
    b"{'descr': '<f4', 'fortran_order': False, 'shape': (-1,), }",
    b"{'descr': [('a', '<f4', (1000000,1000000))], 'fortran_order': 1, 'shape': (2,2)}",
    b'(' * 3000, b"{'descr': '<f4'", b'9L 9L', b'"""', b'\\' * 9,
]  # fmt: skip


def sealed(payload: bytes, kind: str = ARCHIVE_KIND, version: int = VERSION) -> bytes:
    """An archive whose checksum is right, whatever it holds."""
    return f'splatam_ros {kind} {version} {hashlib.sha256(payload).hexdigest()}\n'.encode() + payload


def packed(content: Content, kind: str = ARCHIVE_KIND, version: int = VERSION) -> bytes:
    archive = pack(kind, version, content)
    return archive.header + bytes(archive.payload)


@st.composite
def other_values(draw: st.DrawFn, content: Content) -> Content:
    values = json.loads(draw(json_damage(json.dumps(dict(content.values)).encode())))
    return Content(values, content.arrays)


@st.composite
def other_arrays(draw: st.DrawFn, content: Content) -> Content:
    arrays = dict(content.arrays)
    for name in draw(st.lists(st.sampled_from(sorted(arrays)), min_size=1, max_size=3, unique=True)):
        kind = draw(st.sampled_from(['other', 'none', 'not finite', 'dtype', 'one value']))
        if kind == 'none':
            del arrays[name]
        elif kind == 'not finite' and arrays[name].dtype.kind == 'f' and arrays[name].size:
            arrays[name] = arrays[name].copy()
            arrays[name].flat[0] = draw(st.sampled_from([np.nan, np.inf, -np.inf]))
        elif kind == 'one value' and arrays[name].size:
            arrays[name] = arrays[name].copy()
            arrays[name].reshape(-1).view('u1')[draw(st.integers(0, arrays[name].nbytes - 1))] = draw(st.integers(0, 255))
        else:
            arrays[name] = arrays[name].astype('f2') if kind == 'dtype' else draw(OTHER)
    return Content(content.values, arrays)


def check_file(run: FinishedRun, name: str, tally: Tally, data: bytes) -> None:
    with run.with_file(name, data):
        checkpoint = tally.attempt(partial(read_newest, run.path / 'checkpoints'), CheckpointError)
        if checkpoint is None:
            return
        slam = Slam(CONFIG)
        tally.attempt(partial(_restore, slam, checkpoint))
        assert bool(slam.map.gaussians.usable().all())


def npy(header: bytes, end: bytes) -> bytes:
    return b'\x93NUMPY\x01\x00' + len(header).to_bytes(2, 'little') + header + end


@st.composite
def archives(draw: st.DrawFn) -> bytes:
    """An archive of a few files of anything."""
    names = st.sampled_from(['values', 'values.npy', 'x.npy', '../x.npy', 'x/', 'map.means.npy'])
    body = draw(st.binary(max_size=60) | st.builds(npy, st.sampled_from(HEADERS), st.binary(max_size=8)))
    method = draw(st.sampled_from([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA]))
    payload = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(payload, 'w', method) as archive:
        warnings.filterwarnings('ignore', 'Duplicate name')
        for name in draw(st.lists(names, max_size=3)):
            archive.writestr(name, body)
    return sealed(payload.getvalue())


def check_archive(path: Path, tally: Tally, data: bytes) -> None:
    path.write_bytes(data)
    with warnings.catch_warnings():
        warnings.filterwarnings('ignore', 'Reading `.npy` or `.npz` file required additional header parsing')
        tally.attempt(partial(read_archive, path, ARCHIVE_KIND, VERSION), CheckpointError)


def cases(folder: Path) -> list[Case]:
    run = finished_run(folder / 'run')
    newest = run.newest_checkpoint
    keyframe = next(name for name in sorted(run.files) if name.endswith('.keyframe'))
    content = read_archive(run.path / newest, ARCHIVE_KIND, VERSION)
    check = partial(check_file, run, newest)
    return [
        Case('any bytes', damage(run.files[newest]), check),
        Case('bytes below a right checksum', damage(run.files[newest].split(b'\n', 1)[1]).map(sealed), check),
        Case('other values', other_values(content).map(packed), check),
        Case('other arrays', other_arrays(content).map(packed), check),
        Case('keyframes', damage(run.files[keyframe]), partial(check_file, run, keyframe)),
        Case('archives of anything', archives(), partial(check_archive, folder / 'x.checkpoint')),
    ]


KIND = Kind('checkpoints', 1_500, cases)
