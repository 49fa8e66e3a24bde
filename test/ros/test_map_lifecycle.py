"""Resets, time jumps and loading: MapLifecycle tells the others, and knows the transform from world to map."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from splatam_core.config import load_config
from splatam_core.errors import ConfigError
from splatam_core.geometry import se3
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.runs.record import RunDescription
from splatam_core.runs.writer import RunFolder
from splatam_core.types import FrameResult, RgbdFrame, StageTimings, Status
from splatam_ros.frames.rep105 import Located
from splatam_ros.node.main import RosLog
from splatam_ros.node.map_lifecycle import MapLifecycle
from splatam_ros.node.parameters import node_options
from splatam_ros.throttled_warnings import ThrottledWarnings

CAMERA = PinholeCamera(4, 3, 4.0, 4.0, 1.5, 1.0)
T_MAP_WORLD = se3.exp(np.array([1.0, 2, 3, 0, 0, 0.5]))


class Calls:
    """Records the calls that it gets under any name; stands in for Slam, outputs and a logger."""

    def __init__(self, **attributes: Any) -> None:
        self.calls: list[str] = []
        self.__dict__.update(attributes)

    def __getattr__(self, name: str) -> Any:
        return lambda *args, **kwargs: self.calls.append(name)


class Frames(Calls):
    """Locates every camera, at the given or else at a new map."""

    def locate(
        self, frame: RgbdFrame, T_world_cam: np.ndarray, T_map_world: np.ndarray | None, T_world_odom: np.ndarray
    ) -> Located:
        self.calls.append('new map' if T_map_world is None else 'same map')
        T = T_MAP_WORLD if T_map_world is None else T_map_world
        return Located(frame.stamp_ns, frame.frame_id, frame.frame_id, T, T @ T_world_cam, T @ T_world_cam, None)


class Bench:
    """A lifecycle without a node."""

    def __init__(self, **options: Any) -> None:
        self.slam = Calls(camera=CAMERA, num_gaussians=1, config=load_config('quick'))
        self.frames, self.outputs, self.logger = Frames(), Calls(), Calls()
        self.lifecycle = MapLifecycle(node_options(options), load_config('quick'), self.logger, self.frames, self.outputs)
        self._stamp_ns = 0

    def feed(self, status: Status = Status.TRACKED, epoch: int = 0, camera: PinholeCamera = CAMERA) -> Located | None:
        self._stamp_ns += 10**9
        T = None if status is Status.LOST else np.eye(4)
        frame = RgbdFrame(self._stamp_ns, np.zeros((3, 4, 3), np.uint8), np.ones((3, 4), np.float32), camera, epoch)
        result = FrameResult(0, self._stamp_ns, status, T, False, 1, 1.0, 1.0, '', StageTimings())
        self.lifecycle.before_frame(self.slam, frame)
        self.lifecycle.record(frame, result)
        located = self.lifecycle.locate(frame, result)
        self.lifecycle.after_frame(self.slam, result)
        return located


def maps(bench: Bench) -> list[str]:
    """Which map each located frame is in."""
    return [call for call in bench.frames.calls if call.endswith('map')]


def test_the_first_located_frame_defines_the_map() -> None:
    bench = Bench()
    assert bench.feed(Status.LOST) is None
    for _ in range(2):
        located = bench.feed()
        assert located is not None and np.array_equal(located.T_map_world, T_MAP_WORLD)
    assert maps(bench) == ['new map', 'same map']
    assert bench.outputs.calls == bench.slam.calls == []


def test_a_reset_begins_another_map() -> None:
    bench = Bench()
    bench.feed()
    assert 'new map' in bench.lifecycle.reset(bench.slam, 'because')
    bench.feed()
    assert maps(bench) == ['new map', 'new map']
    assert (bench.slam.calls, bench.outputs.calls, bench.logger.calls) == (['reset'], ['begin_map'], ['warning'])


@pytest.mark.parametrize(
    ('policy', 'slam', 'outputs', 'second'),
    [('reset', 'reset', 'begin_map', 'new map'), ('continue', 'rest', 'end_time', 'same map')],
)
def test_a_time_jump_is_handled_once_and_as_configured(policy: str, slam: str, outputs: str, second: str) -> None:
    bench = Bench(on_time_jump=policy)
    for epoch in (0, 1, 1):
        bench.feed(epoch=epoch)
    assert maps(bench) == ['new map', second, 'same map']
    assert (bench.slam.calls, bench.outputs.calls) == ([slam], [outputs])


OTHER_CAMERA = replace(CAMERA, fx=5.0)


@pytest.mark.parametrize(('policy', 'calls'), [('reset', ['reset']), ('refuse', [])])
def test_another_camera(policy: str, calls: list[str]) -> None:
    bench = Bench(on_camera_change=policy)
    for camera in (CAMERA, OTHER_CAMERA, CAMERA, replace(CAMERA, fy=5.0), OTHER_CAMERA):
        bench.feed(camera=camera)
    assert bench.slam.calls == []  # a single wrong CameraInfo costs its frame, never the map
    bench.feed(camera=OTHER_CAMERA)
    assert bench.slam.calls == calls


@pytest.mark.parametrize('policy', ['reset', 'refuse'])
def test_a_camera_without_a_map_is_not_kept(policy: str) -> None:
    """A first frame that could not be used must not decide which camera the others have to have."""
    bench = Bench(on_camera_change=policy)
    bench.slam.num_gaussians = 0
    bench.feed(Status.LOST)
    bench.feed(camera=OTHER_CAMERA)
    assert bench.slam.calls == ['reset']


def test_a_camera_that_is_lost_for_long_starts_another_map() -> None:
    bench = Bench(lost_reset_after=2.0)
    bench.feed()
    for _ in range(2):
        bench.feed(Status.LOST)
    bench.feed()  # found again: the time starts over
    for _ in range(2):
        bench.feed(Status.LOST)
    assert bench.slam.calls == []
    bench.feed(Status.LOST)
    assert (bench.slam.calls, bench.outputs.calls) == (['reset'], ['begin_map'])


def test_a_map_that_cannot_be_loaded_changes_nothing(tmp_path: Path) -> None:
    for options in ({}, {'load_path': str(tmp_path), 'load_pose': '1 2 3'}):
        bench = Bench(**options)
        with pytest.raises(ConfigError):
            bench.lifecycle.load(bench.slam)
        assert bench.slam.calls == bench.outputs.calls == []


def overwriting(path: Path, **options: Any) -> Bench:
    return Bench(save_path=str(path), overwrite=True, **options)


def test_a_map_in_the_folder_to_overwrite_is_kept(tmp_path: Path) -> None:
    """It would be removed before it is loaded: the map itself, the run's folder, and the run before a reset."""
    run, link = tmp_path / 'run', tmp_path / 'link'
    RunFolder.create(run, load_config('quick'), RunDescription('splatam_node')).close()
    (run / 'map.ply').write_bytes(b'the map')
    link.symlink_to(run)
    for load_path in (run, run / 'map.ply', run / 'previous', link, link / 'map.ply', run / '..' / 'run'):
        with pytest.raises(ConfigError, match='overwrite would remove it before it is loaded: save to another folder'):
            overwriting(run, load_path=str(load_path))
        with pytest.raises(ConfigError, match='overwrite would remove it'):
            overwriting(link, load_path=str(load_path))
    assert (run / 'map.ply').read_bytes() == b'the map' and (run / 'run.json').exists()
    overwriting(run, load_path=str(tmp_path / 'run2' / 'map.ply'))
    assert not (run / 'map.ply').exists()


def test_warnings_are_one_line_whatever_messages_hold() -> None:
    said: list[str] = []
    logger: Any = SimpleNamespace(warning=said.append, debug=said.append)
    bench = Bench(map_frame='map')
    bench.lifecycle._logger = logger
    for name in ('a\nb', '\x1b[31mred', 'x' * 100_000, '\u2028'):
        bench.lifecycle.suggest(name, np.eye(4))
        ThrottledWarnings(logger).warn('frame ids', f'depth is in frame {name}')
        RosLog(logger).emit(logging.makeLogRecord({'msg': f'{name} is left out', 'levelno': logging.WARNING}))
    assert len(said) == 12 and all(text.isprintable() and len(text) < 3000 for text in said)
