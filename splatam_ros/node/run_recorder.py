"""Writes a run of the node into its folder: every frame, and the map when it is saved."""

from __future__ import annotations

from pathlib import Path

from rclpy.impl.rcutils_logger import RcutilsLogger

from splatam_core.config import SlamConfig
from splatam_core.errors import ConfigError, RunFolderError, SplatamError
from splatam_core.runs.metrics import Metrics
from splatam_core.runs.record import RunDescription
from splatam_core.runs.writer import RunFolder
from splatam_core.slam import Slam
from splatam_core.types import FrameResult, RgbdFrame
from splatam_ros.node.attempt import why
from splatam_ros.node.parameters import NodeOptions
from splatam_ros.throttled_warnings import ThrottledWarnings

PROGRAM = 'splatam_node'


class RunRecorder:
    """Owns the run's folder. Frames are written on the worker's thread; a full disk does not stop SLAM."""

    def __init__(self, options: NodeOptions, config: SlamConfig, logger: RcutilsLogger) -> None:
        """Create the folder, if ``save_path`` is set.

        Args:
            options: the node's options.
            config: SLAM configuration, saved with the run.
            logger: logger of the node.

        Raises:
            RunFolderError: the folder cannot be created, or is in use.
        """
        self._options = options
        self._description = RunDescription(PROGRAM, options.preset)
        self._logger = logger
        self._warnings = ThrottledWarnings(logger)
        self._folder: RunFolder | None = None
        if options.folder is not None:
            self._folder = RunFolder.create(options.folder, config, self._description, overwrite=options.overwrite)

    @property
    def path(self) -> Path | None:
        """The folder in which frames are recorded; None if they are not."""
        return self._folder.path if self._folder else None

    def use(self, options: NodeOptions) -> None:
        """Apply changed options; the next save uses the new ``save_path``."""
        self._options = options

    def append(self, frame: RgbdFrame, result: FrameResult) -> None:
        """Record a frame. If it cannot be written, warn and continue."""
        if self._folder is None:
            return
        try:
            self._folder.append(frame, result, result.timings.total / 1e3)
        except Exception as error:  # noqa: BLE001 - whatever happened to the folder, SLAM continues
            self._warnings.warn('trajectory', f'{self._folder.path}: a frame could not be recorded: {why(error)}')

    def save(self, slam: Slam, finish_s: float = 0.0) -> Metrics:
        """Save map, trajectory and metrics in ``save_path``.

        Args:
            slam: has the map.
            finish_s: wall time spent in ``Slam.finish``.

        Raises:
            SplatamError: ``save_path`` is empty, its folder cannot be created, or it cannot be written.
        """
        path = self._options.folder
        if path is None:
            raise ConfigError('save_path is empty: set it to the folder to save in')
        if self._folder is None:
            self._folder = RunFolder.create(path, slam.config, self._description)
        elif self._folder.path != path:
            self._folder = self._folder.moved(path)
        try:
            metrics = self._folder.save(slam, finish_s)
        except OSError as error:
            raise RunFolderError(
                f'{path}: cannot be saved: {error.strerror}; each file there is complete, either the new one or the one of the '
                'last save; make room and save again'
            ) from None
        self._logger.info(
            f'saved {metrics.frames} frames, {metrics.tracked} of them tracked, and {metrics.num_gaussians} Gaussians in {path}'
        )
        return metrics

    def save_at_end(self, slam: Slam, finish_s: float) -> None:
        """Save the run; if no frame was received leave the folder empty, so that the next start can use it.

        Raises:
            SplatamError: as ``save``.
        """
        folder = self._folder
        if folder is None or not folder.is_empty or folder.has_previous:
            self.save(slam, finish_s)
            return
        folder.discard()
        self._logger.info(f'no frame was received, so nothing is saved in {folder.path}')

    def secure(self, slam: Slam) -> None:
        """Save the map of the run so far, before something replaces it on request.

        Args:
            slam: has the map.

        Raises:
            RunFolderError: it cannot be saved.
        """
        if self._folder is None or self._folder.is_empty:
            return
        try:
            self._folder.save(slam)
        except (OSError, SplatamError) as error:
            reason = f'the map so far cannot be saved: {why(error)}; nothing has changed, make room and try again'
            raise RunFolderError(f'{self._folder.path}: {reason}') from None

    def start_over(self, slam: Slam, *, is_saved: bool = False) -> str:
        """Start a new run in the same folder. The run so far, with its map, moves to ``previous/``.

        If the disk fails, log the error and continue without recording.

        Args:
            slam: has the map of the run so far, unless that is saved already.
            is_saved: True if ``secure`` has saved it.

        Returns:
            Where the run so far is, as the end of a sentence; empty if nothing is recorded.
        """
        if self._folder is None:
            return ''
        if not self._folder.is_empty:
            self._move_to_previous(self._folder, slam, is_saved)
        return f'; the run so far is in {self._folder.path / "previous"}' if self._folder else ''

    def _move_to_previous(self, folder: RunFolder, slam: Slam, is_saved: bool) -> None:
        try:
            if not is_saved:
                folder.save(slam)
        except (OSError, SplatamError) as error:
            self._logger.error(f'{folder.path}: the map before the reset could not be saved: {why(error)}')
        try:
            self._folder = folder.restarted(slam.config)
        except RunFolderError as error:
            self._logger.error(f'{error}; frames are no longer recorded')
            self._folder = None

    def close(self) -> None:
        """Close the folder's files."""
        if self._folder is not None:
            self._folder.close()
