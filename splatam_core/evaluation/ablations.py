"""What each part of SplaTAM is worth: the paper's ablations, one run each, and their table.

A variant is a small file in ``config/ablations``, laid over a preset and over ``full.yaml``, which is where all start.
Runs are folders of ``splatam run``; one that is finished is not done again.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from splatam_core.config import SlamConfig, load_config, parse_overrides, read_values
from splatam_core.errors import ConfigError, RunFolderError
from splatam_core.resources import config_dir
from splatam_core.runs.metrics import Metrics
from splatam_core.runs.run_folder import METRICS, RUN, Source, read_run

FULL = 'full'
EXIT_INTERRUPTED = 130


@dataclass(frozen=True, slots=True)
class Variant:
    """One run of a set.

    Attributes:
        name: of its file, and of its folder.
        preset: what it starts from.
        overrides: dotted names to values, laid over that.
    """

    name: str
    preset: str
    overrides: dict[str, object]

    @property
    def config(self) -> SlamConfig:
        """All its settings."""
        return load_config(self.preset, self.overrides)


def variant_names() -> list[str]:
    """Those that ship, the unabridged one first."""
    names = sorted(path.stem for path in (config_dir() / 'ablations').glob('*.yaml'))
    return [FULL, *(name for name in names if name != FULL)]


def variants(names: Iterable[str], preset: str, overrides: Sequence[str] = ()) -> list[Variant]:
    """Chosen variants over a preset.

    Args:
        names: some of ``variant_names``.
        preset: a shipped preset or a YAML file.
        overrides: texts ``name=value``, which win over everything.

    Raises:
        ConfigError: an unknown variant, or a setting that is not allowed.
    """
    known = variant_names()
    return [_variant(name, known, preset, parse_overrides(overrides)) for name in names]


def _variant(name: str, known: Sequence[str], preset: str, overrides: dict[str, object]) -> Variant:
    if name not in known:
        raise ConfigError(f"unknown ablation '{name}'; shipped: {', '.join(known)}")
    full, own = (read_values(str(config_dir() / 'ablations' / f'{stem}.yaml')) for stem in (FULL, name))
    variant = Variant(name, preset, full | own | overrides)
    variant.config  # noqa: B018 -- what cannot run should be said before the first run
    return variant


def run(variant: Variant, arguments: Sequence[str], source: Source, folder: Path) -> bool:
    """Run a variant in a process of its own, unless that was done before.

    Args:
        variant: what to run.
        arguments: of ``splatam run``: the recording and how to read it.
        source: the same, as a run's folder states it.
        folder: of the run.

    Returns:
        Whether it came to its end.

    Raises:
        RunFolderError: another run is in the folder.
    """
    if is_finished(variant, source, folder):
        return True
    settings = [word for name, value in variant.overrides.items() for word in ('--set', f'{name}={json.dumps(value)}')]
    command = ['run', *arguments, '--preset', variant.preset, *settings, '--out', str(folder), '--overwrite']
    code = subprocess.run([sys.executable, '-m', 'splatam_core.cli', *command], stdout=sys.stderr, check=False).returncode
    if code == EXIT_INTERRUPTED:
        raise KeyboardInterrupt
    return code == 0


def is_finished(variant: Variant, source: Source, folder: Path) -> bool:
    """Whether a variant's run is there, scored.

    Raises:
        RunFolderError: something else is there.
    """
    if not (folder / RUN).is_file():
        return False
    record = read_run(folder)
    if record.config != variant.config or record.description.source != source:
        raise RunFolderError(f'{folder} holds a run of other settings or of another recording: choose another --out')
    return (folder / METRICS).is_file() and record.metrics().psnr_db is not None


COLUMNS = 'variant', 'tracked', 'ATE RMSE cm', 'depth L1 cm', 'PSNR dB', 'SSIM', 'Gaussians', 's/frame'


def table(folders: dict[str, Path]) -> str:
    """Variant to folder of its run, as Markdown; a run that has no result is a row of dashes."""
    lines = [COLUMNS, ('---',) * len(COLUMNS), *(_row(name, folder) for name, folder in folders.items())]
    return '\n'.join('| ' + ' | '.join(cells) + ' |' for cells in lines)


def _row(name: str, folder: Path) -> tuple[str, ...]:
    path = folder / METRICS
    if not path.is_file():
        return (name, *('–' for _ in COLUMNS[1:]))
    m = Metrics.from_json(path.read_text())
    return (
        name, f'{m.tracked}/{m.frames}', _text(m.ate_rmse_m, 100, '.2f'), _text(m.depth_l1_m, 100, '.2f'),
        _text(m.psnr_db, 1, '.2f'), _text(m.ssim, 1, '.3f'), _text(m.num_gaussians, 1, ','),
        '–' if not m.fps else f'{1 / m.fps:.1f}',
    )  # fmt: skip


def _text(value: float | None, factor: float, digits: str) -> str:
    return '–' if value is None else f'{value * factor:{digits}}'


def provenance(folders: Iterable[Path]) -> str:
    """The commits and machines of some runs, one line each way they differ."""
    facts = [json.loads((folder / RUN).read_text()) for folder in folders if (folder / RUN).is_file()]
    return '; '.join(dict.fromkeys(map(_provenance, facts)))


def _provenance(fact: dict[str, Any]) -> str:
    machine = fact['machine']
    commit, _, dirty = (fact['commit'] or 'unknown').partition('-')
    return f'commit `{commit[:12]}{"-" * bool(dirty)}{dirty}`, {machine["processor"]}, {machine["cores"]} cores'
