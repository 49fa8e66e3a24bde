"""Runs that belong together: the same recording with other settings, each one call of ``splatam run``."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from splatam_core.config import SlamConfig, load_config
from splatam_core.errors import RunFolderError
from splatam_core.runs.layout import METRICS, RUN
from splatam_core.runs.record import Source, read_run


@dataclass(frozen=True, slots=True)
class Variant:
    """The settings of one run of a set.

    Attributes:
        name: of the run.
        preset: the preset it starts from.
        overrides: dotted names to values, applied on top of the preset.
    """

    name: str
    preset: str
    overrides: Mapping[str, object]

    @property
    def config(self) -> SlamConfig:
        """All its settings."""
        return load_config(self.preset, self.overrides)

    def words(self) -> list[str]:
        """Returns its settings as arguments of ``splatam run``."""
        settings = [word for name, value in self.overrides.items() for word in ('--set', f'{name}={json.dumps(value)}')]
        return ['--preset', self.preset, *settings]


def is_finished(variant: Variant, source: Source, folder: Path) -> bool:
    """Returns True if the folder holds the variant's run, with scores.

    Args:
        variant: whose run.
        source: the recording it must be of; where it states no width, the run may have taken that of its settings.
        folder: of the run.

    Raises:
        RunFolderError: the folder holds another run.
    """
    if not (folder / RUN).is_file():
        return False
    record = read_run(folder)
    made_of = record.description.source
    if made_of is not None and source.width is None and variant.config.width:
        made_of = replace(made_of, width=None)
    if record.config != variant.config or made_of != source:
        raise RunFolderError(f'{folder} holds a run with other settings or of another recording: choose another --out')
    return (folder / METRICS).is_file() and record.metrics().psnr_db is not None
