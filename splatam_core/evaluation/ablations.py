"""The paper's ablations: what each part of SplaTAM contributes, as variants of a preset, and their table.

A variant is a small file in ``config/ablations``, applied on top of a preset and ``full.yaml``, from which all start.
Each variant is one run of ``splatam run``.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from splatam_core.config import parse_overrides, read_values
from splatam_core.errors import ConfigError, RunFolderError
from splatam_core.evaluation.variants import Variant
from splatam_core.resources import config_dir
from splatam_core.runs.layout import METRICS, RUN
from splatam_core.runs.metrics import Metrics
from splatam_core.runs.record import RunSettings, read_settings
from splatam_core.text_files import read_text

FULL = 'full'


def variant_names() -> list[str]:
    """Returns the variants that ship, ``full`` first."""
    names = sorted(path.stem for path in (config_dir() / 'ablations').glob('*.yaml'))
    return [FULL, *(name for name in names if name != FULL)]


def variants(names: Iterable[str], preset: str, overrides: Sequence[str] = ()) -> list[Variant]:
    """Returns variants of a preset.

    Args:
        names: some of ``variant_names``.
        preset: a shipped preset or a YAML file.
        overrides: texts ``name=value``, which take precedence over everything else.

    Raises:
        ConfigError: a variant is unknown, or a setting is not allowed.
    """
    known = variant_names()
    return [_variant(name, known, preset, parse_overrides(overrides)) for name in names]


def _variant(name: str, known: Sequence[str], preset: str, overrides: dict[str, object]) -> Variant:
    if name not in known:
        raise ConfigError(f"unknown ablation '{name}'; shipped: {', '.join(known)}")
    full, own = (read_values(str(config_dir() / 'ablations' / f'{stem}.yaml')) for stem in (FULL, name))
    variant = Variant(name, preset, full | own | overrides)
    variant.config  # noqa: B018 -- raises before the first run, not hours later
    return variant


COLUMNS = 'variant', 'tracked', 'ATE RMSE cm', 'depth L1 cm', 'PSNR dB', 'SSIM', 'Gaussians', 's/frame'


def rows(folders: Mapping[str, Path]) -> list[tuple[str, ...]]:
    """Returns the scores of runs as rows of a table with ``COLUMNS``; a run without results is a row of dashes.

    Args:
        folders: name of a variant to its run folder.

    Raises:
        RunFolderError: the numbers of a run are damaged.
    """
    return [_row(name, folder) for name, folder in folders.items()]


def _row(name: str, folder: Path) -> tuple[str, ...]:
    path = folder / METRICS
    if not path.is_file():
        return (name, *('–' for _ in COLUMNS[1:]))
    m = Metrics.from_json(read_text(path, RunFolderError))
    return (
        name, f'{m.tracked}/{m.frames}', _text(m.ate_rmse_m, 100, '.2f'), _text(m.depth_l1_m, 100, '.2f'),
        _text(m.psnr_db, 1, '.2f'), _text(m.ssim, 1, '.3f'), _text(m.num_gaussians, 1, ','),
        '–' if not m.fps else f'{1 / m.fps:.1f}',
    )  # fmt: skip


def _text(value: float | None, factor: float, digits: str) -> str:
    return '–' if value is None else f'{value * factor:{digits}}'


def provenance(folders: Iterable[Path]) -> str:
    """Returns commit and machine of some runs; each combination once.

    Raises:
        RunFolderError: a run is damaged.
    """
    facts = [read_settings(folder) for folder in folders if (folder / RUN).is_file()]
    return '; '.join(dict.fromkeys(map(_provenance, facts)))


def _provenance(fact: RunSettings) -> str:
    commit, _, dirty = (fact.commit or 'unknown').partition('-')
    machine = [fact.machine.get(name, 'unknown') for name in ('processor', 'cores')]
    return f'commit `{commit[:12]}{"-" * bool(dirty)}{dirty}`, {machine[0]}, {machine[1]} cores'
