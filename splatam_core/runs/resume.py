"""Runs over a recording that save checkpoints, and go on from the last one when they were broken off."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from splatam_core.config import WHERE, SlamConfig, computed_on, flat_values
from splatam_core.errors import CheckpointError
from splatam_core.runs import provenance
from splatam_core.runs.checkpoints import Checkpoint, Checkpoints, Progress, read_newest
from splatam_core.runs.offline import prepare
from splatam_core.runs.run_folder import CHECKPOINTS, RunFolder, RunSettings, read_run, read_settings, trim_run
from splatam_core.slam import Slam
from splatam_core.types import RgbdFrame

if TYPE_CHECKING:
    from splatam_core.datasets.base import Sequence as FrameSequence
    from splatam_core.runs.run_folder import Source


class CheckpointWriter:
    """Saves a checkpoint every so many frames. One that cannot be written stops nothing."""

    def __init__(self, folder: RunFolder, length: int, every: int | None, keep: int, say: Callable[[str], None]) -> None:
        """Write nothing yet.

        Args:
            folder: of the run.
            length: frames of the recording.
            every: frames from one checkpoint to the next; None = write none.
            keep: how many to keep.
            say: tells the user.
        """
        self._folder, self._length, self._every, self._say = folder, length, every, say
        self._checkpoints = Checkpoints(folder.path / CHECKPOINTS, keep)
        self._last: tuple[int, RgbdFrame] | None = None
        self._saved = folder.num_frames

    def after_frame(self, index: int, frame: RgbdFrame, slam: Slam) -> None:
        """Save if it is time to.

        Args:
            index: of the frame in the recording.
            frame: which is processed and written down.
            slam: after it.
        """
        self._last = index, frame
        if self._every and self._folder.num_frames % self._every == 0:
            self._save(slam)

    def at_stop(self, slam: Slam) -> None:
        """Save what came after the last checkpoint."""
        if self._every and self._saved < self._folder.num_frames:
            self._save(slam)

    def _save(self, slam: Slam) -> None:
        assert self._last is not None
        index, frame = self._last
        progress = Progress(self._length, index, frame_digest(frame), self._folder.num_frames)
        try:
            self._folder.sync()
            self._checkpoints.save(slam.state(), progress)
            self._saved = self._folder.num_frames
        except OSError as error:
            self._say(f'no checkpoint after frame {index}: {self._folder.path / CHECKPOINTS}: {error.strerror}; going on')


@dataclass(frozen=True, slots=True, eq=False)
class ResumedRun:
    """A run that goes on.

    Attributes:
        folder: with the lines of the frames before the checkpoint, and no others.
        settings: of the run.
        slam: as it was.
        sequence: the recording.
        first: index of the next frame in it.
    """

    folder: RunFolder
    settings: RunSettings
    slam: Slam
    sequence: FrameSequence
    first: int


def resume(
    path: Path, open_source: Callable[[Source], FrameSequence], begin: Callable[[SlamConfig], None],
    say: Callable[[str], None], device: str | None = None,
) -> ResumedRun:  # fmt: skip
    """Make ready to go on with a run.

    Args:
        path: its folder.
        open_source: opens a recording.
        begin: told the settings before anything is computed.
        say: tells the user.
        device: where to go on; None = as the run's settings say.

    Raises:
        SplatamError: it cannot go on to the same result; nothing is changed then.
    """
    settings = read_settings(path)
    settings = replace(settings, config=computed_on(settings.config, device))
    if settings.description.source is None:
        raise CheckpointError(f"{path}: its frames came from live topics; only runs of 'splatam run' can be resumed")
    checkpoint = read_newest(path / CHECKPOINTS)
    _check_settings(settings, checkpoint)
    begin(settings.config)
    sequence, slam = prepare(open_source(settings.description.source), settings.config)
    _check_frames(sequence, checkpoint)
    _restore(slam, checkpoint)
    if settings.commit != (commit := provenance.commit()):
        say(f'{path} was begun by commit {settings.commit} and goes on by {commit}: the result may differ from either')
    trim_run(path, checkpoint.progress.num_lines, checkpoint.state.last_stamp_ns)
    folder = RunFolder(path, read_run(path).frames)
    folder.note_resumption(settings.config)
    return ResumedRun(folder, settings, slam, sequence, checkpoint.progress.last_index + 1)


def frame_digest(frame: RgbdFrame) -> str:
    """SHA-256 of a frame's stamp and images, hexadecimal."""
    digest = hashlib.sha256(str(frame.stamp_ns).encode())
    for image in (frame.rgb, frame.depth_m):
        digest.update(image.tobytes())
    return digest.hexdigest()


def _check_settings(settings: RunSettings, checkpoint: Checkpoint) -> None:
    now, before = flat_values(settings.config), flat_values(checkpoint.state.config)
    if differing := [name for name in now if now[name] != before[name] and name not in WHERE]:
        listed = ', '.join(f'{name} = {now[name]} (was {before[name]})' for name in differing[:3])
        raise CheckpointError(
            f'{settings.path / "config.yaml"} is not what {checkpoint.path.name} was made with: {listed}; '
            'set it back, or begin another run with these settings'
        )


def _check_frames(sequence: FrameSequence, checkpoint: Checkpoint) -> None:
    """Make sure that the recording is the one the run began with, as far as one frame tells."""
    progress, camera = checkpoint.progress, checkpoint.state.camera
    if len(sequence) != progress.length:
        what = f'has {len(sequence)} frames; it had {progress.length}'
    elif sequence.camera != camera:
        what = f'is of {sequence.camera}; it was of {camera}'
    elif frame_digest(sequence[progress.last_index]) != progress.last_digest:
        what = f'has another frame {progress.last_index} than'
    else:
        return
    raise CheckpointError(
        f'{sequence.name} {what} when {checkpoint.path} was written; put the recording back, or run anew with --out DIR'
    )


def _restore(slam: Slam, checkpoint: Checkpoint) -> None:
    try:
        slam.restore(checkpoint.state)
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f'{checkpoint.path}: does not fit its own settings: {error}') from None
