"""Writes a run of the node into its folder: every frame, and the map when it is saved."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from rclpy.impl.rcutils_logger import RcutilsLogger

from splatam_core.config import SlamConfig
from splatam_core.errors import ConfigError, RunFolderError, SplatamError
from splatam_core.graph.keyframe_graph import KeyframeGraph
from splatam_core.graph.places import Places
from splatam_core.mapping.gaussian_map import GaussianMap
from splatam_core.mapping.posed import PosedView
from splatam_core.runs.metrics import Metrics
from splatam_core.runs.record import RunDescription
from splatam_core.runs.writer import RunFolder
from splatam_core.slam import Slam
from splatam_core.types import FrameResult, RgbdFrame
from splatam_ros.node.attempt import why
from splatam_ros.node.parameters import NodeOptions, as_path
from splatam_ros.throttled_warnings import ThrottledWarnings

PROGRAM = 'splatam_node'
MAX_WAITING_FRAMES = 10_000  # five minutes at 30 Hz, 10 MB
RETRY_S = 5.0


@dataclass(slots=True)
class Waiting:
    """A run that has ended, whose map does not fit on the disk, and the frames of the run after it. A ``SavableSlam``.

    Attributes:
        config: the settings of its end.
        map: its map.
        keyframes: of the map.
        places: of the keyframes.
        graph: of its keyframes.
        is_saved: True once the map is on the disk.
        frames: the frames since then, without their images.
    """

    config: SlamConfig
    map: GaussianMap
    keyframes: Sequence[PosedView]
    places: Places
    graph: KeyframeGraph
    is_saved: bool
    frames: list[tuple[RgbdFrame, FrameResult]] = field(default_factory=list)

    def add(self, frame: RgbdFrame, result: FrameResult) -> bool:
        """Keep a frame. Returns False if there are too many."""
        if len(self.frames) >= MAX_WAITING_FRAMES:
            return False
        no_images = replace(frame, rgb=np.zeros((1, 1, 3), np.uint8), depth_m=np.zeros((1, 1), np.float32))
        self.frames.append((no_images, result))
        return True


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
            ConfigError: it would be overwritten, and holds the map to load.
        """
        self._options = options
        self._description = RunDescription(PROGRAM, options.preset)
        self._logger = logger
        self._warnings = ThrottledWarnings(logger)
        self._folder: RunFolder | None = None
        self._waiting: Waiting | None = None
        self._retry_s = 0.0
        if options.folder is not None:
            _check_keeps_the_map(options, options.folder)
            self._folder = RunFolder.create(options.folder, config, self._description, overwrite=options.overwrite)

    @property
    def path(self) -> Path | None:
        """The folder in which frames are recorded; None if they are not."""
        return self._folder.path if self._folder else None

    def holds(self, path: Path) -> bool:
        """True if a file is in the run's folder, so that a reset moves or replaces it."""
        return self._folder is not None and _is_in(path, self._folder.path)

    def use(self, options: NodeOptions) -> None:
        """Apply changed options; the next save uses the new ``save_path``."""
        self._options = options

    def append(self, frame: RgbdFrame, result: FrameResult) -> None:
        """Record a frame. If it cannot be written, warn and continue."""
        if self._folder is None:
            return
        if self._ends_run():
            self._append(self._folder, frame, result)
        elif self._waiting is not None and not self._waiting.add(frame, result):
            self._warnings.warn('trajectory', f'{self._folder.path}: a frame is lost: {MAX_WAITING_FRAMES} wait for room already')

    def _append(self, folder: RunFolder, frame: RgbdFrame, result: FrameResult) -> None:
        try:
            folder.append(frame, result, result.timings.total / 1e3)
        except Exception as error:  # noqa: BLE001 - whatever happened to the folder, SLAM continues
            self._warnings.warn('trajectory', f'{folder.path}: a frame could not be recorded: {why(error)}')

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
        if not self._ends_run(at_once=True):
            raise RunFolderError(f'{path}: cannot be saved: the run before the last reset waits for room; make room and save again')
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
            if not self._ends_run(at_once=True):
                raise RunFolderError('the one before the last reset waits for room')
            self._folder.save(slam)
        except (OSError, SplatamError) as error:
            reason = f'the map so far cannot be saved: {why(error)}; nothing has changed, make room and try again'
            raise RunFolderError(f'{self._folder.path}: {reason}') from None

    def start_over(self, slam: Slam, *, is_saved: bool = False) -> str:
        """Start a new run in the same folder. The run so far, with its map, moves to ``previous/``.

        If the disk is full, map and frames wait in memory until there is room.

        Args:
            slam: has the map of the run so far, unless that is saved already.
            is_saved: True if ``secure`` has saved it.

        Returns:
            Where the run so far is, as the end of a sentence; empty if nothing is recorded, or if it waits for room.
        """
        if self._folder is None:
            return ''
        if self._waiting is not None:
            if self._waiting.frames:
                self._logger.error(f'{self._folder.path}: {len(self._waiting.frames)} frames of the run so far are lost: no room')
            self._waiting.frames.clear()
        elif not self._folder.is_empty:
            self._waiting = Waiting(slam.config, slam.map, slam.keyframes, slam.places, slam.graph, is_saved)
        return f'; the run so far is in {self._folder.path / "previous"}' if self._ends_run(at_once=True) else ''

    def _ends_run(self, *, at_once: bool = False) -> bool:
        """Move the run that has ended to ``previous/``, if one waits for that. Returns False if there is no room yet.

        Args:
            at_once: True to try now, False to try every few seconds.
        """
        folder, waiting = self._folder, self._waiting
        if folder is None or waiting is None:
            return True
        if not at_once and time.monotonic() < self._retry_s:
            return False
        try:
            if not waiting.is_saved:
                folder.save(waiting)
                waiting.is_saved = True
            self._folder = restarted = folder.restarted(waiting.config)
        except (OSError, SplatamError) as error:
            self._retry_s = time.monotonic() + RETRY_S
            self._warnings.warn(
                'reset', f'{folder.path}: the run before the reset cannot be saved: {why(error)}; its map and the frames since '
                'wait in memory for room on the disk',
            )  # fmt: skip
            return False
        self._waiting = None
        for frame, result in waiting.frames:
            self._append(restarted, frame, result)
        return True

    def close(self) -> None:
        """Close the folder's files."""
        if self._folder is not None:
            self._folder.close()


def _check_keeps_the_map(options: NodeOptions, folder: Path) -> None:
    """Checks that overwriting a run does not remove the map that is to be loaded.

    Raises:
        ConfigError: it would.
    """
    if options.overwrite and options.load_path and _is_in(as_path('load_path', options.load_path), folder):
        raise ConfigError(
            f'load_path = {options.load_path} is in {folder}, and overwrite would remove it before it is loaded: save to another '
            'folder'
        )


def _is_in(path: Path, folder: Path) -> bool:
    try:
        return path.resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError):  # a loop of links: it cannot be loaded either
        return False
