"""Files that fill the memory or never end are one line. ``test/fuzz`` tries damage of every other kind."""

from __future__ import annotations

import io
import os
import tracemalloc
import zipfile
from pathlib import Path

import pytest
from kinds.checkpoints import sealed
from kinds.finished_run import finished_run

from splatam_core.errors import CheckpointError, MapFileError, RunFolderError
from splatam_core.maps.ply import read_ply
from splatam_core.runs.archive import read_archive
from splatam_core.runs.checkpoints import KIND, VERSION
from splatam_core.runs.record import read_run


def test_a_cell_of_a_hundred_kilobytes(tmp_path: Path) -> None:
    """Beyond the limit of the csv library."""
    run = finished_run(tmp_path / 'run')
    with run.with_file('frames.csv', run.files['frames.csv'][:-1] + b'x' * 200_000 + b'\n'), pytest.raises(RunFolderError):
        read_run(run.path).metrics()


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
