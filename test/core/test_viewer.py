"""What is sent to a browser: rows as viser lays them out, and of a growing map only the chunks that changed."""

from __future__ import annotations

import socket
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from splatam_core.commands import view
from splatam_core.errors import ViewerError
from splatam_core.maps.viewer import scene
from splatam_core.maps.viewer.packing import MOVED_M, ROW, SCALE, Chunks, pack
from splatam_core.runs.record import RunDescription, Source
from splatam_core.types import MapSnapshot


def snapshot(count: int, seed: int = 0, *, anisotropic: bool = False, radius_m: float = 0.01) -> MapSnapshot:
    rng = np.random.default_rng(seed)
    return MapSnapshot(
        means=rng.uniform(-3, 3, (count, 3)).astype(np.float32),
        rgb=rng.uniform(-0.1, 1.1, (count, 3)).astype(np.float32),
        opacities=rng.uniform(0.1, 1, count).astype(np.float32),
        log_scales=np.log(radius_m * rng.uniform(0.5, 2, (count, 3 if anisotropic else 1))).astype(np.float32),
        rotations=rng.normal(size=(count, 4)).astype(np.float32) if anisotropic else None,
    )


@pytest.fixture
def server() -> object:
    opened = scene.open_server('127.0.0.1', 8480)
    yield opened
    opened.stop()


def covariances(given: MapSnapshot) -> np.ndarray:
    """[N, 3, 3], one by one and in double precision."""
    found = []
    for index in range(len(given.means)):
        variances = np.exp(2 * given.log_scales[index].astype(np.float64))
        if given.rotations is None:
            found.append(variances * np.eye(3))
            continue
        w, x, y, z = (q := given.rotations[index].astype(np.float64)) / np.linalg.norm(q)
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        R = np.eye(3) + 2 * w * cross + 2 * cross @ cross
        found.append(R @ np.diag(variances) @ R.T)
    return np.array(found)


@pytest.mark.parametrize('anisotropic', [False, True])
def test_rows_are_what_viser_makes_of_the_same_gaussians(server: object, anisotropic: bool) -> None:
    given = snapshot(50, anisotropic=anisotropic)
    handle = server.scene.add_gaussian_splats(
        '/map', SCALE * given.means, SCALE**2 * covariances(given), np.clip(given.rgb, 0, 1), given.opacities[:, None]
    )
    expected, found = handle.buffer.view(np.uint8).view(ROW)[:, 0], pack(given)
    np.testing.assert_array_equal(found['mean'], expected['mean'])
    # Rounded to 16 bits from other sums; zeros beside the diagonal of a round Gaussian.
    np.testing.assert_allclose(found['covariance'], expected['covariance'], rtol=2e-3, atol=1e-4 * anisotropic)
    assert np.abs(found['rgba'].astype(int) - expected['rgba']).max() <= 1  # one rounds, the other truncates


def test_the_radius_of_a_small_gaussian_survives_16_bits() -> None:
    given = snapshot(1000, radius_m=0.001)
    radii = np.sqrt(pack(given)['covariance'][:, 0].astype(np.float64)) / SCALE
    np.testing.assert_allclose(radii, np.exp(given.log_scales[:, 0]), rtol=0.01)


class Growing:
    """A map of a few frames that each add the same number of Gaussians."""

    def __init__(self, frames: int = 6, each: int = 40) -> None:
        self.rows = pack(snapshot(frames * each))
        self.added_by = np.repeat(np.arange(frames), each)


def test_only_what_changed_is_sent() -> None:
    grown, chunks = Growing(), Chunks(capacity=80)  # two frames a chunk
    assert len(chunks.update(grown.rows[:120], grown.added_by[:120]).changed) == 2
    assert not chunks.update(grown.rows[:120], grown.added_by[:120]).changed
    more = chunks.update(grown.rows, grown.added_by)
    assert len(more.changed) == 2 and not more.removed  # the second is full now, the third is new

    recolored = grown.rows.copy()
    recolored['rgba'][130:140, 0] ^= 0x40
    (chunk,) = chunks.update(recolored, grown.added_by).changed.values()
    np.testing.assert_array_equal(chunk, recolored[80:160])

    kept = np.ones(240, bool)
    kept[10:15] = False  # pruning shifts everything behind, but sends the first chunk alone
    (pruned,) = chunks.update(recolored[kept], grown.added_by[kept]).changed.values()
    np.testing.assert_array_equal(pruned[:75], recolored[kept][:75])
    assert not pruned[75:]['rgba'].any()  # padding cannot be seen


def test_what_cannot_be_seen_waits() -> None:
    grown, chunks = Growing(), Chunks(capacity=80)
    chunks.update(grown.rows, grown.added_by)
    moved = grown.rows.copy()
    moved['mean'] += SCALE * MOVED_M / 2
    assert not chunks.update(moved, grown.added_by).changed
    assert not chunks.update(moved, grown.added_by).changed  # compared with what was sent, so that steps add up
    moved['mean'] += SCALE * MOVED_M
    assert len(chunks.update(moved, grown.added_by).changed) == 3
    moved['mean'] += SCALE * MOVED_M / 2
    assert len(chunks.update(moved, grown.added_by, exactly=True).changed) == 3


def test_chunks_come_and_go_with_their_gaussians() -> None:
    grown, chunks = Growing(), Chunks(capacity=80)
    keys = list(chunks.update(grown.rows, grown.added_by).changed)
    assert chunks.update(grown.rows[:80], grown.added_by[:80]).removed == tuple(keys[1:])  # frames taken back, or a slider
    assert list(chunks.update(grown.rows, grown.added_by).changed) == keys[1:]
    assert chunks.clear() == tuple(keys)
    assert len(chunks.update(grown.rows, grown.added_by).changed) == 3
    loaded = Chunks(capacity=100)  # a map from a file: no frame is known
    assert sorted(map(len, loaded.update(grown.rows, np.zeros(240, int)).changed.values())) == [100, 100, 100]


def test_without_viser_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scene, 'find_spec', lambda name: None)
    with pytest.raises(ViewerError, match=r"pip install 'splatam_ros\[viewer\]'"):
        scene.open_server('127.0.0.1', 8480)


@pytest.mark.parametrize(('host', 'port'), [('127.0.0.1', 70_000), ('203.0.113.1', 8080), ('no such host', 8080)])
def test_an_address_that_cannot_be_used_is_refused_rather_than_waited_for(host: str, port: int) -> None:
    """203.0.113.1 is nobody's (RFC 5737)."""
    pytest.importorskip('viser')
    with pytest.raises(ViewerError, match=f'the viewer cannot use {host}:{port}'):
        scene.open_server(host, port)


@pytest.mark.parametrize(
    ('host', 'said', 'opened'),
    [
        ('127.0.0.1', 'http://127.0.0.1:8080, for this machine only', 'http://127.0.0.1:8080'),
        ('localhost', 'http://127.0.0.1:8080, for this machine only', 'http://127.0.0.1:8080'),
        ('::1', 'http://[::1]:8080, for this machine only', 'http://[::1]:8080'),
        ('0.0.0.0', 'http://0.0.0.0:8080, for everybody who reaches this machine', 'http://127.0.0.1:8080'),
        ('', 'http://0.0.0.0:8080, for everybody who reaches this machine', 'http://127.0.0.1:8080'),
        ('::', 'http://[::]:8080, for everybody who reaches this machine', 'http://[::1]:8080'),
        ('10.1.2.3', 'http://10.1.2.3:8080, for everybody who reaches this machine', 'http://10.1.2.3:8080'),
    ],
)
def test_the_address_says_for_whom_the_page_is(host: str, said: str, opened: str) -> None:
    server = SimpleNamespace(get_host=lambda: host, get_port=lambda: 8080)
    assert (scene.address(server), scene.page_url(server)) == (said, opened)


def test_where_no_port_is_left_one_line_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    """viser waits for ever behind port 65535."""
    pytest.importorskip('viser')
    with socket.socket() as other:
        other.bind(('127.0.0.1', 0))
        other.listen()
        taken = other.getsockname()[1]
        monkeypatch.setattr(scene, 'LAST_PORT', taken)
        with pytest.raises(ViewerError, match=f'cannot use 127.0.0.1:{taken}: this port and those after it are taken'):
            scene.open_server('127.0.0.1', taken)


def test_a_long_path_is_thinned_out_evenly() -> None:
    rng, path, points = np.random.default_rng(0), scene.CameraPath(most=40), np.zeros((1000, 3), np.float32)
    points[:, 0] = np.arange(len(points))
    ends = [0, *np.sort(rng.choice(np.arange(1, 1000), 150)).tolist()]
    for begin, end in pairwise(ends):
        path.extend(points[begin:end])
        *kept, newest = path.points()[:, 0]
        assert newest == end - 1 and len(kept) <= 40 and len({*np.diff(kept)}) <= 1
        assert not kept or kept[0] == 0


def test_a_frame_that_the_recording_lacks_is_rendered_from_the_map(monkeypatch: pytest.MonkeyPatch) -> None:
    """As when a bag was cut, or a disk with it was removed: the page goes on."""
    rendered = np.zeros((24, 32, 3), np.uint8)
    monkeypatch.setattr(view._Images, '_rendered', lambda self, T_world_cam: rendered)
    description = RunDescription('splatam run', source=Source('synthetic', max_frames=2, width=32))
    images = view._Images(SimpleNamespace(description=description), None)
    assert images.at(1, np.eye(4)).any() and images.origin == 'recorded'
    assert images.at(5, np.eye(4)) is not None and images.origin == (
        'rendered from the map, because frame 6 of the recording cannot be read: it has 2 frames'
    )
    assert not images.at(1, np.eye(4)).any()


def test_the_final_path_is_that_of_the_frames_that_are_shown() -> None:
    """A run that was stopped between two lines has final poses of frames that are left out."""
    poses = np.tile(np.eye(4), (3, 1, 1))
    run = SimpleNamespace(
        trajectory=SimpleNamespace(stamps_ns=np.array([1, 2]), T_world_cam=poses[:2]),
        poses=lambda: {stamp: pose + (stamp == 2) for stamp, pose in zip((1, 2, 3), poses)},
    )
    np.testing.assert_array_equal(view._corrected_path(run), [[0, 0, 0], [1, 1, 1]])
    run.poses = lambda: dict(zip((1, 2, 3), poses))
    assert view._corrected_path(run).shape == (0, 3)
