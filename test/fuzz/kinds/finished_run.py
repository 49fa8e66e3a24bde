"""A finished run with checkpoints, as material for damage."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from splatam_core.config import load_config
from splatam_core.datasets.registry import open_sequence
from splatam_core.runs.checkpoints import Checkpoints, Progress, checkpoint_paths
from splatam_core.runs.record import RunDescription, Source
from splatam_core.runs.writer import RunFolder
from splatam_core.slam import Slam

CONFIG = load_config('quick', ['threads=1', 'tracking.iterations=2', 'mapping.iterations=2', 'keyframes.every=2'])


@dataclass(frozen=True)
class FinishedRun:
    """A run folder, and the bytes of its files by their path in it."""

    path: Path
    files: dict[str, bytes]

    @contextmanager
    def with_file(self, name: str, data: bytes) -> Iterator[None]:
        """Give a file other bytes in the block."""
        try:
            (self.path / name).write_bytes(data)
            yield
        finally:
            (self.path / name).write_bytes(self.files[name])

    @property
    def newest_checkpoint(self) -> str:
        """Name of the file of the newest checkpoint."""
        return str(checkpoint_paths(self.path / 'checkpoints')[-1].relative_to(self.path))


def finished_run(path: Path) -> FinishedRun:
    """Records a run of four frames."""
    sequence, slam = open_sequence('synthetic:noise=off', width=32, max_frames=4), Slam(CONFIG)
    description = RunDescription('splatam run', 'quick', Source('synthetic:noise=off', width=32, max_frames=4), 2)
    with RunFolder.create(path, CONFIG, description) as folder:
        for index in range(4):
            frame = sequence[index]
            folder.append(frame, slam.process(frame), 0.1, 0.1)
        Checkpoints(path / 'checkpoints', 2).save(slam.state(), Progress(4, 3, '0' * 64, 4))
        folder.save(slam)
    files = {str(file.relative_to(path)): file.read_bytes() for file in path.rglob('*') if file.is_file()}
    return FinishedRun(path, files)
