"""Optimization steps while frames wait: which are postponed, which are made up for, and what never changes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np
import pytest

from splatam_core.config import load_config
from splatam_core.interruption import Pressure, no_pressure
from splatam_core.mapping.backlog import MAX_OWED_FRAMES, MAX_WITHOUT, StepBacklog
from splatam_core.rasterizer.cpu import CpuRasterizer
from splatam_core.slam import Slam
from splatam_core.types import RgbdFrame, Status

NONE, WAITING, FULL = Pressure.NONE, Pressure.WAITING, Pressure.FULL


def gauge(*pressures: Pressure) -> Callable[[], Pressure]:
    """Returns what answers with each pressure in turn, and with the last one from then on."""
    left = list(pressures)
    return lambda: left.pop(0) if len(left) > 1 else left[0]


@pytest.mark.parametrize(
    ('pressure', 'taken'),
    [
        (gauge(NONE), [6, 7, 8]),
        (gauge(WAITING), [6]),
        (gauge(NONE, NONE, WAITING), [6, 7]),
        (gauge(FULL), []),
        (gauge(WAITING, FULL), [6]),
        (gauge(NONE, FULL), [6]),
    ],
)
def test_a_frame_takes_fewer_steps_while_others_wait(pressure: Callable[[], Pressure], taken: list[int]) -> None:
    backlog = StepBacklog()
    assert list(backlog.due(range(6, 9), pressure)) == taken
    assert backlog.owed == backlog.postponed == 3 - len(taken)


def test_steps_that_are_owed_are_made_up_for_while_nothing_waits() -> None:
    backlog = StepBacklog()
    assert not list(backlog.due(range(3), gauge(FULL)))
    assert list(backlog.due(range(3, 6), gauge(WAITING))) == [0]
    assert not list(backlog.overdue(gauge(WAITING))) and backlog.owed == 5
    assert list(backlog.overdue(gauge(NONE, NONE, FULL))) == [1, 2]
    assert list(backlog.overdue(gauge(NONE))) == [3, 4, 5] and backlog.owed == 0
    assert list(backlog.due(range(6, 9), gauge(NONE))) == [6, 7, 8] and backlog.postponed == 0


@pytest.mark.parametrize('pressure', [NONE, WAITING, FULL])
def test_every_second_step_stays_every_second_one_whatever_waits(pressure: Pressure) -> None:
    """Four steps a frame: their first would be of full size in every frame, or of half size in every one."""
    backlog = StepBacklog()
    taken = [step for first in range(0, 80, 4) for step in backlog.due(range(first, first + 4), gauge(pressure))]
    assert taken == list(range(len(taken))) and len(taken) >= 5


@pytest.mark.parametrize('iterations', [3, 60])
def test_some_steps_are_taken_and_few_are_owed_however_long_the_queue_is_full(iterations: int) -> None:
    backlog, taken, num_frames = StepBacklog(), Counter[int](), 10 * MAX_OWED_FRAMES
    for number in range(num_frames):
        taken[number] += len(list(backlog.due(range(iterations * number, iterations * (number + 1)), gauge(FULL))))
    assert [number for number, count in taken.items() if count] == list(range(MAX_WITHOUT, num_frames, MAX_WITHOUT + 1))
    assert set(taken.values()) == {0, 1} and backlog.owed == MAX_OWED_FRAMES * iterations


@pytest.fixture
def steps(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Counts the steps of the fused optimizer."""
    counted, fit = [0], CpuRasterizer.fit

    def counting(*args: object, **kwargs: object) -> object:
        counted[0] += 1
        return fit(*args, **kwargs)

    monkeypatch.setattr(CpuRasterizer, 'fit', counting)
    return counted


def run(frames: Sequence[RgbdFrame], pressure: Callable[[], Pressure], *overrides: str) -> tuple[Slam, list[np.ndarray], list[int]]:
    """Processes frames as the worker does. Returns SLAM, the poses, and how many steps each frame postponed."""
    slam, poses, postponed = Slam(load_config('realtime', ['threads=1', *overrides])), [], []
    for frame in frames:
        result = slam.process(frame, pressure)
        assert result.status is (Status.TRACKED if poses else Status.INITIALIZED)
        poses.append(result.T_world_cam)
        postponed.append(result.postponed_steps)
        slam.catch_up(pressure)
    return slam, poses, postponed


def test_without_pressure_nothing_changes(room: Callable[..., Sequence[RgbdFrame]]) -> None:
    frames = room(frames=8, width=64)
    slam = Slam(load_config('realtime', ['threads=1']))
    poses = [slam.process(frame).T_world_cam for frame in frames]
    live, live_poses, postponed = run(frames, no_pressure)
    assert np.array_equal(poses, live_poses) and not any(postponed)
    assert all(np.array_equal(a, b) for a, b in zip(slam.map.arrays().values(), live.map.arrays().values(), strict=True))


def test_tracking_and_the_first_frame_are_never_cut(room: Callable[..., Sequence[RgbdFrame]], steps: list[int]) -> None:
    """The first pose after the start follows from a map that is fitted in full: it is the same bit for bit."""
    frames = list(room(frames=8, width=64))
    _, (_, second, *_), _ = run(frames[:2], no_pressure)
    of_two, steps[0] = steps[0], 0
    config = load_config('realtime')
    _, (_, hurried, *_), postponed = run(frames, gauge(FULL))
    assert of_two == config.mapping.first_iterations + 2 * config.mapping.iterations
    assert np.array_equal(second, hurried)
    assert postponed[0] == 0 and sum(postponed[1:]) == 7 * config.mapping.iterations - 1  # one step after three frames without
    assert steps[0] == config.mapping.first_iterations + config.mapping.iterations + 1


def test_a_map_catches_up_on_the_views_of_the_last_frame(room: Callable[..., Sequence[RgbdFrame]], steps: list[int]) -> None:
    frames = room(frames=4, width=64)
    slam, _, postponed = run(frames, gauge(FULL))
    before = steps[0]
    slam.catch_up(gauge(NONE, NONE, WAITING))  # asked once before, then before each step
    assert steps[0] - before == 1
    slam.catch_up(no_pressure)
    slam.catch_up(no_pressure)
    assert steps[0] - before == sum(postponed)


def test_views_that_a_correction_has_moved_are_not_fitted_where_they_were(
    room: Callable[..., Sequence[RgbdFrame]], steps: list[int]
) -> None:
    slam, _, postponed = run(room(frames=3, width=64), gauge(FULL))
    before = steps[0]
    slam._mapper.correct(lambda frames: np.tile(np.eye(4), (len(frames), 1, 1)))
    slam.catch_up(no_pressure)
    assert sum(postponed) and steps[0] == before


def test_a_map_catches_up_after_a_frame_that_is_not_mapped(room: Callable[..., Sequence[RgbdFrame]], steps: list[int]) -> None:
    """Preset quick maps every other frame; those between leave time."""
    frames = list(room(frames=4, width=64))
    slam, _, postponed = run(frames[:3], gauge(FULL), 'mapping.every=2')
    before = steps[0]
    assert slam.process(frames[3]).status is Status.TRACKED and steps[0] == before  # not mapped
    slam.catch_up(no_pressure)
    assert steps[0] - before == sum(postponed) > 0


@pytest.mark.parametrize('off', ['mapping.enabled=false', 'mapping.iterations=0'])
def test_a_map_that_is_fitted_no_more_catches_up_with_nothing(
    room: Callable[..., Sequence[RgbdFrame]], steps: list[int], off: str
) -> None:
    frames = list(room(frames=4, width=64))
    slam, _, postponed = run(frames[:3], gauge(FULL))
    before = steps[0]
    slam.configure(load_config('realtime', ['threads=1', off]))
    slam.catch_up(no_pressure)
    assert slam.process(frames[3]).status is Status.TRACKED
    slam.catch_up(no_pressure)
    assert sum(postponed) and steps[0] == before
