"""What happens to a map besides frames: resets, jumps of time, saving and loading. All on the worker's thread."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rclpy.impl.rcutils_logger import RcutilsLogger

from splatam_core.config import SlamConfig
from splatam_core.errors import ConfigError, RunFolderError
from splatam_core.maps.ply import read_ply
from splatam_core.runs.metrics import Metrics
from splatam_core.runs.run_folder import MAP, RunDescription, RunFolder
from splatam_core.slam import Slam
from splatam_core.types import FrameResult, RgbdFrame, Status
from splatam_ros.frames.rep105 import parse_pose
from splatam_ros.node.outputs import Outputs
from splatam_ros.node.parameters import NodeOptions
from splatam_ros.throttled_warnings import ThrottledWarnings

PROGRAM = 'splatam_node'


class Session:
    """A map from its beginning to its reset, and the folder it is saved in."""

    def __init__(self, options: NodeOptions, config: SlamConfig, logger: RcutilsLogger, outputs: Outputs) -> None:
        """Make the run's folder.

        Args:
            options: the node's.
            config: of Slam.
            logger: of the node.
            outputs: are told when poses so far have nothing to do with those to come.

        Raises:
            RunFolderError: there is no place to save to.
        """
        self.options = options
        self._description = RunDescription(PROGRAM, options.preset)
        self._logger = logger
        self._warnings = ThrottledWarnings(logger)
        self._outputs = outputs
        self._epoch = 0
        self._lost_since_ns: int | None = None
        self._finish_s = 0.0
        self._folder: RunFolder | None = None
        if options.folder is not None:
            self._folder = RunFolder.create(options.folder, config, self._description, overwrite=options.overwrite)

    @property
    def folder(self) -> Path | None:
        """Where frames are written down; None = nowhere."""
        return self._folder.path if self._folder else None

    # --- around each frame ---

    def before_frame(self, slam: Slam, frame: RgbdFrame) -> None:
        """Make Slam ready for a frame of another time or camera, as configured."""
        if frame.epoch != self._epoch:
            self._epoch = frame.epoch
            self._jump_in_time(slam)
        if slam.camera not in (None, frame.camera) and self.options.on_camera_change == 'reset':
            self.reset(slam, 'the camera changed')

    def record(self, frame: RgbdFrame, result: FrameResult) -> None:
        """Write a frame down. A disk that is full is no reason to stop."""
        if self._folder is None:
            return
        try:
            self._folder.append(frame, result, result.timings.total / 1e3)
        except OSError as error:
            why = f'a frame could not be written down: {error.strerror}'
            self._warnings.warn('trajectory', f'{self._folder.path}: {why}')

    def after_frame(self, slam: Slam, result: FrameResult) -> None:
        """Start over if the camera has been lost for too long."""
        if result.status is not Status.LOST or slam.num_gaussians == 0:
            self._lost_since_ns = None
            return
        if self._lost_since_ns is None:
            self._lost_since_ns = result.stamp_ns
        lost_s = (result.stamp_ns - self._lost_since_ns) / 1e9
        if 0 < self.options.lost_reset_after <= lost_s:
            self.reset(slam, f'lost for {lost_s:.1f} s')

    def _jump_in_time(self, slam: Slam) -> None:
        if self.options.on_time_jump == 'reset':
            self.reset(slam, 'time jumped back')
            return
        self._logger.warning('time jumped back: going on in the same map, from the last pose')
        self._begin_anew(slam, saves_map=True)  # a trajectory's stamps increase
        slam.rest()
        self._outputs.interrupt()

    # --- on request ---

    def reset(self, slam: Slam, why: str) -> str:
        """Forget map and poses; what was written down is kept in ``previous/``. What there is to say."""
        self._begin_anew(slam, saves_map=True)
        slam.reset()
        self._lost_since_ns = None
        self._outputs.forget()
        kept = f'; what was saved before is in {self._folder.path / "previous"}' if self._folder else ''
        self._logger.warning(f'map reset: {why}{kept}')
        return f'the next frame starts a new map{kept}'

    def save(self, slam: Slam, finish_s: float = 0.0) -> Metrics:
        """Save map, trajectory and metrics in ``save_path``.

        Args:
            slam: whose map.
            finish_s: wall time in ``Slam.finish``.

        Raises:
            SplatamError: ``save_path`` is empty, no folder can be made of it, or it cannot be written.
        """
        path = self.options.folder
        if path is None:
            raise ConfigError('save_path is empty: set it to the folder to save in')
        if self._folder is None:
            self._folder = RunFolder.create(path, slam.config, self._description)
        elif self._folder.path != path:
            self._folder = self._folder.moved(path)
        try:
            metrics = self._folder.save(slam, finish_s)
        except OSError as error:
            why = f'cannot be saved: {error.strerror}; each file there is whole, of now or of the last time'
            raise RunFolderError(f'{path}: {why}; save again when that is mended') from None
        self._logger.info(f'saved {metrics.frames} frames, {metrics.tracked} of them tracked, and '
                          f'{metrics.num_gaussians} Gaussians in {path}')  # fmt: skip
        return metrics

    def fit(self, slam: Slam, is_hurried: Callable[[], bool]) -> None:
        """Fit the map once more: within ``finish_limit`` where there is a hurry, else until it is done or there is one."""
        hurried, begin = is_hurried(), time.monotonic()
        steps = slam.finish(self.options.finish_limit) if hurried else slam.finish(stop=is_hurried)
        self._finish_s = time.monotonic() - begin
        if steps:
            self._logger.info(f'fitted the map to all keyframes once more: {steps} steps in {self._finish_s:.1f} s')

    def finish(self, slam: Slam) -> None:
        """Save the map; where no frame ever came leave the folder empty, for the next attempt.

        Raises:
            SplatamError: as ``save``.
        """
        folder = self._folder
        if folder is None or not folder.is_empty or folder.has_previous:
            self.save(slam, self._finish_s)
            return
        folder.discard()
        self._logger.info(f'no frame came, so nothing is saved in {folder.path}')

    def load(self, slam: Slam) -> str:
        """Go on in the map at ``load_path``, from ``load_pose``. What there is to say.

        Raises:
            SplatamError: there is no such map, or ``load_pose`` is no pose; everything stays as it was.
        """
        path = map_path(self.options.load_path)
        T_world_cam = load_pose(self.options)
        gaussians = read_ply(path)
        self._begin_anew(slam, saves_map=False)  # path may be this run's own map, as it was saved last
        slam.load(gaussians, T_world_cam)
        self._lost_since_ns = None
        self._outputs.forget()
        what = f'loaded {len(gaussians)} Gaussians of {path}'
        self._logger.info(what)
        return what

    def close(self) -> None:
        """Close the folder's files."""
        if self._folder is not None:
            self._folder.close()

    def _begin_anew(self, slam: Slam, *, saves_map: bool) -> None:
        """Another run in the same folder. Trouble with the disk must not keep SLAM from going on."""
        if self._folder is None or self._folder.is_empty:
            return
        try:
            if saves_map:
                self._folder.save(slam)
        except OSError as error:
            self._logger.error(f'{self._folder.path}: the map before the reset could not be saved: {error.strerror}')
        try:
            self._folder = self._folder.restarted(slam.config)
        except RunFolderError as error:
            self._logger.error(f'{error}; nothing is written down any more')
            self._folder = None


def map_path(text: str) -> Path:
    """The PLY file that is meant by a file's or a run folder's path.

    Raises:
        ConfigError: the path is empty.
    """
    if not text:
        raise ConfigError('load_path is empty: set it to a map.ply, or to the folder of a run')
    path = Path(text).expanduser()
    return path / MAP if path.is_dir() else path


def load_pose(options: NodeOptions) -> NDArray[np.float64]:
    """[4, 4] camera to world where a loaded map is entered; where the map began, if nobody says otherwise.

    Raises:
        ConfigError: ``load_pose`` is no pose.
    """
    return parse_pose('load_pose', options.load_pose) if options.load_pose else np.eye(4)
