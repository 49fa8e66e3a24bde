"""The life of a map: when it starts, is reset, survives a time jump, is loaded, saved and finished.

``MapLifecycle`` is the only object that decides these, and the only one that knows the transform from world to map. It
tells the others through explicit methods. Everything here runs on the worker's thread.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rclpy.impl.rcutils_logger import RcutilsLogger

from splatam_core.config import SlamConfig
from splatam_core.errors import ConfigError, MapFileError, SplatamError, printable
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.maps.ply import read_ply
from splatam_core.runs.layout import MAP, MAP_KEYFRAMES
from splatam_core.runs.map_keyframes import read_map_keyframes
from splatam_core.slam import Slam
from splatam_core.state import NO_KEYFRAMES, SavedKeyframes
from splatam_core.types import FrameResult, RgbdFrame, Status
from splatam_ros.frames.buffer import TransformError
from splatam_ros.frames.rep105 import Located, parse_pose
from splatam_ros.frames.robot_frames import RobotFrames
from splatam_ros.node.attempt import attempt
from splatam_ros.node.outputs import Outputs
from splatam_ros.node.parameters import NodeOptions, as_path
from splatam_ros.node.run_recorder import RunRecorder
from splatam_ros.process import StopRequest

Matrix = NDArray[np.float64]

FRAMES_OF_NEW_CAMERA = 2  # that follow each other; a single wrong CameraInfo must not cost the map
SETTLED_S = 3.0  # time from the request to stop until the final fit, if nothing is in the way


class MapLifecycle:
    """Owns epochs, resets, time jumps, the transform from world to map, and the run on disk."""

    def __init__(
        self, options: NodeOptions, config: SlamConfig, logger: RcutilsLogger, frames: RobotFrames, outputs: Outputs
    ) -> None:
        """Create the run's folder.

        Args:
            options: the node's options.
            config: SLAM configuration.
            logger: logger of the node.
            frames: locate the camera in the coordinate frames of ROS.
            outputs: receive a call when a new map begins and when the motion is interrupted.

        Raises:
            RunFolderError: there is no place to save to.
        """
        self._options = options
        self._logger = logger
        self._frames = frames
        self._outputs = outputs
        self._recorder = RunRecorder(options, config, logger)
        self._epoch = 0
        self._T_map_world: Matrix | None = None  # set by the first located frame of a world
        self._lost_since_ns: int | None = None
        self._other_camera: PinholeCamera | None = None
        self._num_other = 0
        self._finish_s = 0.0
        self._told: Matrix | None = None  # pose of the body in the map, for the next frame

    @property
    def folder(self) -> Path | None:
        """The folder in which frames are recorded; None if they are not."""
        return self._recorder.path

    def use(self, options: NodeOptions) -> None:
        """Apply changed options; may be called from any thread."""
        self._options = options
        self._recorder.use(options)

    # --- per frame, in this order ---

    def before_frame(self, slam: Slam, frame: RgbdFrame) -> None:
        """Prepare SLAM for a frame: handle a time jump or a change of the camera, as configured."""
        self._frames.begin_frame(frame)
        if frame.epoch != self._epoch:
            self._epoch = frame.epoch
            self._jump_in_time(slam)
        if self._has_other_camera(slam, frame.camera):
            self.reset(slam, 'the camera changed')
        if self._told is not None:
            self._pass_on(slam, frame, self._told)
            self._told = None

    def _pass_on(self, slam: Slam, frame: RgbdFrame, told: Matrix) -> None:
        """Tell SLAM where a person says that the camera of a frame is."""
        if slam.num_gaussians == 0:
            self._logger.warning('initialpose is refused: there is no map yet')
            return
        try:
            slam.suggest(self._frames.told(frame, told, self._T_map_world))
        except TransformError as error:
            self._logger.warning(f'initialpose is refused: the pose of the camera in the base is not known: {error}')

    def record(self, frame: RgbdFrame, result: FrameResult) -> None:
        """Write a frame to disk; call before anything about it is published."""
        self._recorder.append(frame, result)

    def locate(self, frame: RgbdFrame, result: FrameResult) -> Located | None:
        """Returns where the frame's camera is in the coordinate frames of ROS; None if it is lost or not known."""
        if result.T_world_cam is None:
            return None
        located = self._frames.locate(frame, result.T_world_cam, self._T_map_world, result.T_world_odom)
        if located is not None:
            self._T_map_world = located.T_map_world
        return located

    def after_frame(self, slam: Slam, result: FrameResult) -> None:
        """Start a new map if the camera has been lost for longer than ``lost_reset_after``."""
        if result.status is not Status.LOST or slam.num_gaussians == 0:
            self._lost_since_ns = None
            return
        if self._lost_since_ns is None:
            self._lost_since_ns = result.stamp_ns
        lost_s = (result.stamp_ns - self._lost_since_ns) / 1e9
        if 0 < self._options.lost_reset_after <= lost_s:
            self.reset(slam, f'lost for {lost_s:.1f} s')

    def _has_other_camera(self, slam: Slam, camera: PinholeCamera) -> bool:
        """Returns True if the camera has changed for good, or if there is no map yet that would be lost."""
        if slam.camera in (None, camera):
            self._other_camera, self._num_other = None, 0
            return False
        self._num_other = self._num_other + 1 if camera == self._other_camera else 1
        self._other_camera = camera
        may_reset = self._options.on_camera_change == 'reset' and self._num_other >= FRAMES_OF_NEW_CAMERA
        return may_reset or slam.num_gaussians == 0

    def _jump_in_time(self, slam: Slam) -> None:
        if self._options.on_time_jump == 'reset':
            self.reset(slam, 'time jumped back')
            return
        self._logger.warning('time jumped back: continuing in the same map, from the last pose')
        self._recorder.start_over(slam)  # the stamps of a trajectory must increase
        self._outputs.end_time(slam)
        slam.rest(is_new_time=True)

    # --- on request ---

    def reset(self, slam: Slam, why: str) -> str:
        """Start a new map with the next frame. The run so far is kept in ``previous/``.

        Args:
            slam: has the map.
            why: reason for the log.

        Returns:
            Message for the user.
        """
        kept = self._recorder.start_over(slam)
        slam.reset()
        self._begin_world()
        self._logger.warning(f'map reset: {why}{kept}')
        return f'the next frame starts a new map{kept}'

    def load(self, slam: Slam) -> str:
        """Continue in the map at ``load_path``, from ``load_pose``. The run so far, with its map, is kept in ``previous/``.

        Returns:
            Message for the user.

        Raises:
            SplatamError: there is no such map, it does not fit the configuration, ``load_pose`` is not a pose, or the map
                so far cannot be saved; nothing has changed.
        """
        path = map_path(self._options.load_path)
        T_world_cam = load_pose(self._options)
        gaussians = read_ply(path)
        saved = keyframes_beside(path) if slam.config.tracking.relocalises else NO_KEYFRAMES
        try:
            slam.check_map(gaussians)
        except SplatamError as error:
            raise MapFileError(f'{path}: {error}') from None
        self._recorder.secure(slam)
        start = 'the camera starts at load_pose'
        if T_world_cam is None and saved.keyframes:
            start = 'the camera is looked for by them'
        elif T_world_cam is None:
            T_world_cam = np.eye(4)
            start = (
                'the camera starts where the map began, and cannot be found elsewhere without keyframes: publish its pose on '
                'initialpose if it is elsewhere'
            )
        slam.load(gaussians, T_world_cam, saved)
        is_own = self._recorder.holds(path)
        kept = self._recorder.start_over(slam, is_saved=True)
        self._begin_world()
        if is_own:  # what was loaded has been moved or replaced
            attempt(self._logger, 'saving the loaded map again', lambda: self._recorder.save(slam))
        message = f'loaded {len(gaussians)} Gaussians and {len(saved.keyframes)} keyframes from {path}: {start}{kept}'
        self._logger.info(message)
        return message

    def suggest(self, frame_id: str, T_map_body: Matrix) -> None:
        """Try the next frame where a person says that the robot is; a line in the log says if it is not there.

        Args:
            frame_id: frame of the pose, which must be ``map_frame``.
            T_map_body: [4, 4] pose of the base, or of the camera in body axes if there is no base.
        """
        if frame_id != self._options.map_frame:
            text = f"it is in the frame '{frame_id}', and must be in map_frame, '{self._options.map_frame}'"
            self._logger.warning(f'initialpose is refused: {printable(text)}')
            return
        self._told = T_map_body

    def save(self, slam: Slam) -> str:
        """Save map, trajectory and metrics in ``save_path``.

        Returns:
            Message for the user.

        Raises:
            SplatamError: ``save_path`` is empty, its folder cannot be created, or it cannot be written.
        """
        metrics = self._recorder.save(slam)
        return f'saved {metrics.num_gaussians} Gaussians and {metrics.frames} frames in {self.folder}'

    def _begin_world(self) -> None:
        """Poses so far have no relation to those that follow."""
        self._T_map_world = None
        self._lost_since_ns = None
        self._outputs.begin_map()

    # --- at shutdown ---

    def finish(self, slam: Slam, stop: StopRequest) -> None:
        """Fit the map to all keyframes once more.

        Args:
            slam: has the map.
            stop: tells if the process was asked to stop. If it was before, fitting takes at most ``finish_limit`` seconds,
                and less if the last frame has taken long; otherwise fitting ends when it is done, or at the request.
        """
        begin = time.monotonic()
        if stop.requested:
            late_s = max(0.0, stop.elapsed_s - SETTLED_S)
            steps = slam.finish(max(0.1, self._options.finish_limit - late_s))
        else:
            steps = slam.finish(stop=lambda: stop.requested)
        self._finish_s = time.monotonic() - begin
        if steps:
            self._logger.info(f'fitted the map to all keyframes once more: {steps} steps in {self._finish_s:.1f} s')

    def save_at_end(self, slam: Slam) -> None:
        """Save the run; if no frame was received leave the folder empty.

        Raises:
            SplatamError: as ``save``.
        """
        self._recorder.save_at_end(slam, self._finish_s)

    def close(self) -> None:
        """Close the run's files."""
        self._recorder.close()


def map_path(text: str) -> Path:
    """Returns the PLY file that a path means: the file itself, or the map in a run's folder.

    Raises:
        ConfigError: the path is empty or cannot be used.
        MapFileError: there is no regular file.
    """
    if not text:
        raise ConfigError('load_path is empty: set it to a map.ply, or to the folder of a run')
    path = as_path('load_path', text)
    try:
        path = path / MAP if path.is_dir() else path
        is_file, exists = path.is_file(), path.exists()
    except OSError as error:
        raise MapFileError(f'{path}: cannot be read: {error.strerror}') from None
    if exists and not is_file:  # reading a pipe or a device may never end
        raise MapFileError(f'{path}: cannot be read: it is no regular file; set load_path to a map.ply, or to the folder of a run')
    return path


def keyframes_beside(path: Path) -> SavedKeyframes:
    """Returns the keyframes that a run has saved beside its map; none where it saved none.

    Raises:
        CheckpointError: they cannot be read.
    """
    beside = path.with_name(MAP_KEYFRAMES)
    return read_map_keyframes(beside) if path.name == MAP and beside.is_file() else NO_KEYFRAMES


def load_pose(options: NodeOptions) -> Matrix | None:
    """Returns the [4, 4] pose, camera to world, at which tracking in a loaded map starts; None where none is given.

    Raises:
        ConfigError: ``load_pose`` is not a pose.
    """
    return parse_pose('load_pose', options.load_pose) if options.load_pose else None
