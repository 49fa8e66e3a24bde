"""What is sent to a browser: rows as viser lays them out, and of a growing map only the chunks that changed."""

from __future__ import annotations

import numpy as np
import pytest

from splatam_core.errors import ViewerError
from splatam_core.maps.viewer import scene
from splatam_core.maps.viewer.packing import MOVED_M, ROW, SCALE, Chunks, pack
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
