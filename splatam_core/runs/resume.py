"""Runs over a recording: how they begin, save checkpoints, and resume after an interruption."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from splatam_core.config import WHERE, SlamConfig, computed_on, flat_values
from splatam_core.datasets.base import Sequence as FrameSequence
from splatam_core.datasets.known_poses import FramesWithGroundTruth
from splatam_core.errors import CheckpointError, one_line
from splatam_core.runs import provenance
from splatam_core.runs.checkpoints import Checkpoint, Checkpoints, Progress, read_newest
from splatam_core.runs.layout import CHECKPOINTS, CONFIG
from splatam_core.runs.record import RunSettings, Source, read_settings
from splatam_core.runs.writer import RunFolder
from splatam_core.slam import Slam
from splatam_core.types import RgbdFrame


def prepare(sequence: FrameSequence, config: SlamConfig) -> tuple[FrameSequence, Slam]:
    """Returns the frames to process, and a ``Slam`` with an empty map for them.

    Args:
        sequence: the recording.
        config: of the run.

    Raises:
        ConfigError: ``tracking.method`` is ``truth``, and the recording has no ground truth.
    """
    if config.tracking.method != 'truth':
        return sequence, Slam(config, num_frames=len(sequence))
    frames = FramesWithGroundTruth(sequence)
    return frames, Slam(config, true_motion=frames.motion, num_frames=len(frames))


class CheckpointWriter:
    """Saves a checkpoint every few frames. A checkpoint that cannot be written is reported and stops nothing."""

    def __init__(self, folder: RunFolder, length: int, every: int | None, keep: int, say: Callable[[str], None]) -> None:
        """Writes nothing yet.

        Args:
            folder: of the run.
            length: number of frames of the recording.
            every: frames from one checkpoint to the next; None = write none.
            keep: number of checkpoints to keep.
            say: shows a message to the user.
        """
        self._folder, self._length, self._every, self._say = folder, length, every, say
        self._checkpoints = Checkpoints(folder.path / CHECKPOINTS, keep)
        self._last: tuple[int, RgbdFrame] | None = None
        self._saved = folder.num_frames

    def after_frame(self, index: int, frame: RgbdFrame, slam: Slam) -> None:
        """Saves a checkpoint after every n-th frame.

        Args:
            index: of the frame in the recording.
            frame: the last frame, processed and in the run folder.
            slam: its state after the frame.
        """
        self._last = index, frame
        if self._every and self._folder.num_frames % self._every == 0:
            self._save(slam)

    def at_stop(self, slam: Slam) -> None:
        """Saves a checkpoint if frames came after the last one."""
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
            path = self._folder.path / CHECKPOINTS
            self._say(f'no checkpoint after frame {index}: {path}: {error.strerror}; the run continues')


@dataclass(frozen=True, slots=True, eq=False)
class ResumedRun:
    """A run that continues.

    Attributes:
        folder: holds the frames before the checkpoint, and no others.
        settings: of the run.
        slam: its state after the frames before the checkpoint.
        sequence: the recording.
        first: index of the next frame in the recording.
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
    """Makes a run ready to continue from its newest checkpoint.

    Args:
        path: the run folder.
        open_source: opens a recording.
        begin: called with the run's settings before anything is computed.
        say: shows a message to the user.
        device: where to continue; None = as the run's settings say.

    Raises:
        SplatamError: the run cannot continue to the same result; nothing is changed then.
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
        say(f'commit {settings.commit} began {path}, and commit {commit} continues it: the result may differ from both')
    folder = RunFolder.reopen(path, checkpoint.progress.num_lines, checkpoint.state.last_stamp_ns)
    folder.note_resumption(settings.config)
    return ResumedRun(folder, settings, slam, sequence, checkpoint.progress.last_index + 1)


def frame_digest(frame: RgbdFrame) -> str:
    """Returns the SHA-256 of a frame's stamp and images, hexadecimal."""
    digest = hashlib.sha256(str(frame.stamp_ns).encode())
    for image in (frame.rgb, frame.depth_m):
        digest.update(image.tobytes())
    return digest.hexdigest()


def _check_settings(settings: RunSettings, checkpoint: Checkpoint) -> None:
    now, before = flat_values(settings.config), flat_values(checkpoint.state.config)
    if differing := [name for name in now if now[name] != before[name] and name not in WHERE]:
        listed = ', '.join(f'{name} = {now[name]} (was {before[name]})' for name in differing[:3])
        raise CheckpointError(
            f'{settings.path / CONFIG} differs from the settings of {checkpoint.path.name}: {listed}; '
            'set it back, or begin another run with these settings'
        )


def _check_frames(sequence: FrameSequence, checkpoint: Checkpoint) -> None:
    """Checks that the recording is the one that the run began with, as far as its last processed frame shows."""
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
        f'{sequence.name} {what} when {checkpoint.path} was written; restore the recording, or start a new run with --out DIR'
    )


def _restore(slam: Slam, checkpoint: Checkpoint) -> None:
    try:
        slam.restore(checkpoint.state)
    except Exception as error:  # noqa: BLE001 - whatever a file holds, it is refused in one line
        raise CheckpointError(
            f'{checkpoint.path}: does not fit its own settings: {one_line(error)}; use the version that wrote it, or '
            'start a new run'
        ) from None
