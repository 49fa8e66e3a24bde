"""Which device and rasterizer a configuration means, and what is said where that cannot be."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from splatam_core import cli
from splatam_core import device as device_module
from splatam_core.config import load_config
from splatam_core.device import INTERPRET, choose_backend
from splatam_core.errors import ConfigError
from splatam_core.slam import Slam

CPU, GPU = torch.device('cpu'), torch.device('cuda', 0)


@pytest.fixture(autouse=True)
def _compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(INTERPRET, raising=False)


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine with a GPU, as far as choosing goes."""
    monkeypatch.setattr(torch.cuda, 'is_available', lambda: True)
    monkeypatch.setattr(torch.cuda, 'current_device', lambda: 0)
    monkeypatch.setattr(torch.cuda, 'get_device_name', lambda: 'A GPU')
    monkeypatch.setattr(device_module.importlib.util, 'find_spec', lambda name: object())


@pytest.fixture
def no_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, 'is_available', lambda: False)


def _chosen(*overrides: str) -> tuple[torch.device, str, str]:
    chosen = choose_backend(load_config('splatam', overrides))
    return chosen.device, chosen.rasterizer, chosen.why


@pytest.mark.usefixtures('gpu')
@pytest.mark.parametrize(
    ('overrides', 'device', 'rasterizer', 'why'),
    [
        ((), GPU, 'triton', 'A GPU'),
        (('device=cuda',), GPU, 'triton', ''),
        (('device=cpu',), CPU, 'cpu', ''),
        (('rasterizer=cpu',), CPU, 'cpu', 'rasterizer = cpu runs on it'),
        (('rasterizer=reference',), GPU, 'reference', 'A GPU'),
        (('device=cpu', 'rasterizer=reference'), CPU, 'reference', ''),
        (('mapping.anisotropic=true',), CPU, 'cpu', 'rasterizer triton: it does not draw anisotropic'),
        (('mapping.anisotropic=true', 'device=cuda', 'rasterizer=reference'), GPU, 'reference', ''),
    ],
)
def test_choices_beside_a_gpu(overrides: tuple[str, ...], device: torch.device, rasterizer: str, why: str) -> None:
    *chosen, reason = _chosen(*overrides)
    assert chosen == [device, rasterizer]
    assert reason.startswith(why) and bool(reason) == bool(why)


@pytest.mark.usefixtures('no_gpu')
def test_choices_without_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """Triton's kernels run there too, but only where its interpreter is asked for."""
    device, rasterizer, why = _chosen()
    assert (device, rasterizer) == (CPU, 'cpu') and torch.__version__ in why and 'sees no GPU' in why
    assert _chosen('rasterizer=reference')[:2] == (CPU, 'reference')
    monkeypatch.setenv(INTERPRET, '1')
    monkeypatch.setattr(device_module.importlib.util, 'find_spec', lambda name: object())
    assert _chosen('rasterizer=triton')[:2] == (CPU, 'triton')
    assert _chosen('rasterizer=triton', 'device=cpu')[:2] == (CPU, 'triton')


@pytest.mark.usefixtures('no_gpu')
@pytest.mark.parametrize(
    ('overrides', 'message'),
    [
        (('device=cuda',), r"device = cuda: torch \S+ .*sees no GPU; install torch's CUDA build .* or set device=cpu"),
        (
            ('rasterizer=triton',),
            f'rasterizer = triton: needs a GPU, and torch .* sees no GPU; set rasterizer=auto, or set {INTERPRET}=1',
        ),
        (('rasterizer=triton', 'device=cpu'), 'rasterizer = triton: needs a GPU, and device = cpu; set rasterizer=auto'),
    ],
)
def test_what_is_not_there_is_one_clear_error(overrides: tuple[str, ...], message: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device_module.importlib.util, 'find_spec', lambda name: object())
    with pytest.raises(ConfigError, match=message) as error:
        Slam(load_config('quick', overrides))
    assert '\n' not in str(error.value)


@pytest.mark.usefixtures('gpu')
def test_a_gpu_without_triton(monkeypatch: pytest.MonkeyPatch) -> None:
    """Auto stays on the processor and says why; asked for, it is an error."""
    monkeypatch.setattr(device_module.importlib.util, 'find_spec', lambda name: None)
    device, rasterizer, why = _chosen()
    assert (device, rasterizer) == (CPU, 'cpu') and 'triton is not installed' in why
    with pytest.raises(ConfigError, match='rasterizer = triton: triton is not installed'):
        _chosen('device=cuda')


def test_the_native_rasterizer_is_not_for_a_gpu() -> None:
    """Said before anything is looked for."""
    with pytest.raises(ConfigError, match=r'rasterizer = cpu: .* device = cuda; set rasterizer=auto, or device=cpu'):
        load_config('quick', ['device=cuda', 'rasterizer=cpu'])


@pytest.mark.usefixtures('no_gpu')
def test_command_line_says_once_what_auto_chose(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """And why; with a device asked for there is nothing to say. Without a GPU, cuda leaves no folder behind."""
    source = ['run', 'synthetic', '--max-frames', '2', '--width', '64', '--preset', 'quick', '--no-evaluate']
    assert cli.main([*source, '--out', str(tmp_path / 'auto')]) == 0
    assert capsys.readouterr().err.count('device = auto: cpu (torch') == 1
    assert cli.main([*source, '--out', str(tmp_path / 'cpu'), '--device', 'cpu']) == 0
    assert 'device' not in capsys.readouterr().err
    assert cli.main([*source, '--out', str(tmp_path / 'cuda'), '--device', 'cuda']) == cli.EXIT_ERROR
    assert capsys.readouterr().err.count('\n') == 1
    assert not (tmp_path / 'cuda').exists()
