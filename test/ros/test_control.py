"""Services and run-time parameters of the running node."""

from __future__ import annotations

import os
import resource
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from camera import Live, position, still
from control import Control
from graph import Graph

from splatam_core.config import load_config
from splatam_core.datasets.synthetic import SyntheticSequence
from splatam_core.geometry.trajectory import pose_line
from splatam_core.maps.ply import read_ply, write_ply
from splatam_core.rasterizer import Gaussians
from splatam_core.runs.record import read_run
from splatam_core.slam import Slam
from splatam_core.types import RgbdFrame
from splatam_ros.node.gate import FrameGate

SECOND = 10**9
# Largest error of a camera that does not move, at 64 pixels width and with few steps: a pixel is 4 cm at 2.5 m.
STILL_M = 0.04
MOVED_M = 0.06  # two places in these tests are further apart than this


def moving(frames: SyntheticSequence, number: int, view: int) -> RgbdFrame:
    """Returns the view of ``frames[view]`` with the stamp of a frame number."""
    return replace(frames[view], stamp_ns=SECOND + number * 10**8)


def test_pause_resume_reset_and_save(graph: Graph, frames: SyntheticSequence) -> None:
    out = graph.folder / 'run'
    live = Live(graph, save_path=out)
    control = Control(graph)
    assert all(live.show(still(frames, number)) for number in range(3))
    assert '3 frames' in control.succeed('save_map')
    saved = read_ply(out / 'map.ply')
    assert len(saved.means) > 500 and len(read_run(out).trajectory) == 3

    assert 'dropped' in control.succeed('pause') and 'already' in control.succeed('pause')
    assert [live.show(still(frames, number)) for number in (3, 4)] == [None, None]  # answered, but not processed
    control.succeed('save_map')
    assert len(read_run(out).frames) == 3 and len(read_ply(out / 'map.ply').means) == len(saved.means)
    assert control.succeed('resume') == 'resumed' and 'not paused' in control.succeed('resume')
    assert live.show(still(frames, 5))

    assert 'previous' in control.succeed('reset')
    later = replace(frames[6], stamp_ns=SECOND + 6 * 10**8)
    pose = live.show(later)
    assert pose is not None and not position(pose).any()  # a new world begins where the camera is
    assert [len(read_run(path).trajectory) for path in (out, out / 'previous')] == [1, 4]
    assert (out / 'previous' / 'map.ply').is_file()
    assert live.node.says('map reset: requested by ~/reset')


def test_saving_elsewhere_at_run_time(graph: Graph, frames: SyntheticSequence) -> None:
    live = Live(graph, save_root=graph.folder)
    control = Control(graph)
    assert live.show(still(frames, 0))
    assert 'save_path is empty' in control.fail('save_map')
    (refused,) = control.set(save_path=str(graph.folder.parent / 'elsewhere'))
    assert not refused.successful and 'expected a folder below save_root' in refused.reason
    assert 'save_path is empty' in control.fail('save_map')

    for name, frame_count in (('first', 1), ('second', 2)):  # the second contains the trajectory of the first
        control.change(save_path=str(graph.folder / name))
        control.succeed('save_map')
        assert live.show(still(frames, frame_count))
        control.succeed('save_map')
        assert len(read_run(graph.folder / name).trajectory) == frame_count
        assert read_ply(graph.folder / name / 'map.ply').means.any()
    assert not list(graph.folder.glob('.*'))  # no temporary files are left


@pytest.fixture(scope='module')
def saved_map(frames: SyntheticSequence, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns the file of a map of the recording."""
    slam = Slam(load_config('quick', {'threads': 1, 'mapping.every': 1}))
    assert all(slam.process(frame).T_world_cam is not None for frame in frames)
    path = tmp_path_factory.mktemp('map') / 'map.ply'
    write_ply(path, slam.map.gaussians)
    return path


def test_a_saved_map_is_localised_in(graph: Graph, frames: SyntheticSequence, saved_map: Path) -> None:
    """Loaded at start, at the given pose. The map does not change until mapping is enabled."""
    truth = frames.ground_truth().T_world_cam
    near, T = (np.linalg.inv(truth[0]) @ truth[view] for view in (10, 11))
    out = graph.folder / 'run'
    live = Live(
        graph, load_path=saved_map, load_pose=pose_line(0, near).partition(' ')[2], save_path=out,
        slam__mapping__enabled=False, slam__tracking__min_inlier_fraction=0.5,
    )  # fmt: skip
    control = Control(graph)
    pose = live.show(frames[11])
    assert pose is not None and np.linalg.norm(position(pose) - T[:3, 3]) < STILL_M < np.linalg.norm(T[:3, 3])
    control.succeed('save_map')
    np.testing.assert_array_equal(read_ply(out / 'map.ply').means, read_ply(saved_map).means)

    control.change(slam__mapping__enabled=True)
    assert live.show(replace(frames[11], stamp_ns=20 * SECOND))
    control.succeed('save_map')
    assert read_ply(out / 'map.ply').means.shape != read_ply(saved_map).means.shape

    control.change(load_path=str(graph.folder / 'nowhere.ply'))
    assert 'nowhere.ply: cannot be read' in control.fail('load_map')
    live_map = read_ply(out / 'map.ply').means.shape
    control.change(load_path=str(saved_map), load_pose='', slam__mapping__enabled=False)
    message = control.succeed('load_map')
    assert str(saved_map) in message and 'the run so far is in' in message
    assert read_ply(out / 'previous' / 'map.ply').means.shape == live_map  # as after a reset
    pose = live.show(replace(frames[0], stamp_ns=21 * SECOND))
    assert pose is not None and np.linalg.norm(position(pose)) < STILL_M
    assert [len(read_run(path).trajectory) for path in (out, out / 'previous')] == [1, 2]


def fifo(folder: Path) -> Path:
    os.mkfifo(folder / 'pipe.ply')
    return folder / 'pipe.ply'


def run_with_fifo(folder: Path) -> Path:
    (folder / 'other_run').mkdir()
    os.mkfifo(folder / 'other_run' / 'map.ply')
    return folder / 'other_run'


def anisotropic(folder: Path) -> Path:
    gaussians = Gaussians(
        means=torch.zeros(5, 3), log_scales=torch.arange(15.0).reshape(5, 3) / 9, logit_opacities=torch.zeros(5),
        rgb=torch.ones(5, 3), rotations=torch.ones(5, 4),
    )  # fmt: skip
    write_ply(folder / 'anisotropic.ply', gaussians)
    return folder / 'anisotropic.ply'


def empty(folder: Path) -> Path:
    zero = torch.zeros
    write_ply(folder / 'empty.ply', Gaussians(means=zero(0, 3), log_scales=zero(0, 1), logit_opacities=zero(0), rgb=zero(0, 3)))
    return folder / 'empty.ply'


UNUSABLE_MAPS: dict[str, Callable[[Path], Path]] = {
    'no regular file': fifo,
    'cannot be read: ': run_with_fifo,
    'it is no regular': lambda folder: Path('/dev/zero'),
    'anisotropic': anisotropic,
    'no Gaussians': empty,
    'nowhere.ply: cannot be read': lambda folder: folder / 'nowhere.ply',
}


def test_a_map_that_cannot_be_loaded_leaves_everything_as_it_is(graph: Graph, frames: SyntheticSequence) -> None:
    out = graph.folder / 'run'
    live = Live(graph, save_path=out, queue_policy='all')
    control = Control(graph)
    assert live.show(still(frames, 0)) and live.show(still(frames, 1))
    control.succeed('save_map')
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    for message, make in UNUSABLE_MAPS.items():
        control.change(load_path=str(make(graph.folder)))
        why = control.fail('load_map')
        assert message in why and '\n' not in why
        assert {path.name: path.read_bytes() for path in out.iterdir()} == before, message
    assert live.show(still(frames, 2))  # in the same map
    assert '3 frames' in control.succeed('save_map') and not (out / 'previous').exists()
    assert 'Traceback' not in live.node.text


def test_a_map_of_the_run_itself_stays_on_the_disk(graph: Graph, frames: SyntheticSequence) -> None:
    """Loading moves the run so far to previous/, and with it the file that was loaded. Nobody else can take the folder."""
    out = graph.folder / 'run'
    live = Live(graph, save_path=out, queue_policy='all', slam__tracking__align__relocalisation__enabled=False)
    control = Control(graph)
    assert live.show(still(frames, 0)) and live.show(still(frames, 1))
    control.succeed('save_map')
    saved = read_ply(out / 'map.ply').means
    for number, name in enumerate(('', 'previous', ''), start=2):
        control.change(load_path=str(out / name))
        control.succeed('load_map')
        assert len(read_ply(out / 'map.ply')) >= len(saved)
        assert live.show(still(frames, number))
    other = graph.run_node('-r', '__node:=other', save_path=out, overwrite=True)
    assert other.wait() == 2 and other.says('run is in use')
    assert live.show(still(frames, 9)) and read_run(out / 'previous').read_map().means.any()


def test_a_live_map_that_cannot_be_saved_is_not_replaced(graph: Graph, frames: SyntheticSequence, saved_map: Path) -> None:
    out = graph.folder / 'run'
    live = Live(graph, save_path=out, queue_policy='all')
    control = Control(graph)
    assert live.show(still(frames, 0))
    control.change(load_path=str(saved_map))
    resource.prlimit(live.node.pid, resource.RLIMIT_FSIZE, (50, resource.RLIM_INFINITY))
    assert 'the map so far cannot be saved: ' in control.fail('load_map')
    resource.prlimit(live.node.pid, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    assert live.show(still(frames, 1)) and not live.node.says('loaded')
    assert 'the run so far is in' in control.succeed('load_map')
    assert len(read_run(out / 'previous').trajectory) == 2


def test_localising_without_a_map_says_so(graph: Graph, frames: SyntheticSequence) -> None:
    live = Live(graph, slam__mapping__enabled=False)
    assert live.show(frames[0]) is None
    assert live.node.says('lost', 'the map cannot start: mapping.enabled is off')


@pytest.mark.parametrize('policy', ['reset', 'continue'])
def test_time_that_jumps_back(graph: Graph, frames: SyntheticSequence, policy: str) -> None:
    """The camera has moved by the time of the jump: in a new map it is at the origin, in the old one it is not."""
    out = graph.folder / 'run'
    live = Live(graph, on_time_jump=policy, save_path=out, queue_policy='all')
    before = [live.show(moving(frames, 1000 + number, view)) for number, view in enumerate((2, 5, 8, 11))]
    assert np.linalg.norm(position(before[-1])) > MOVED_M
    after = [live.show(moving(frames, number, 11)) for number in range(3)]
    assert live.node.says('time jumped back')
    expected = np.zeros(3) if policy == 'reset' else position(before[-1])
    for pose in after:
        assert pose is not None and np.linalg.norm(position(pose) - expected) < STILL_M
    # The stamps of a trajectory increase, so there is one for before and one for after the jump.
    assert [len(read_run(path).trajectory) for path in (out, out / 'previous')] == [3, 4]
    # A jump forward resets nothing, and processing continues.
    poses = [live.show(moving(frames, 5000 + number, 11)) for number in range(2)]
    assert np.linalg.norm(position(poses[-1]) - expected) < STILL_M


def test_the_frame_rate_is_limited_by_stamps_and_can_be_changed(graph: Graph, frames: SyntheticSequence) -> None:
    live = Live(graph, max_rate_hz=2.5, queue_policy='all')
    poses = [live.show(still(frames, number)) for number in range(9)]  # at 10 Hz of stamps
    assert [number for number, pose in enumerate(poses) if pose] == [0, 4, 8]
    Control(graph).change(max_rate_hz=0.0)
    assert all(live.show(still(frames, number)) for number in (9, 10))


@pytest.mark.parametrize('jitter_ns', [0, 2_000_000, -2_000_000])
def test_a_rate_is_kept_on_average_whatever_the_jitter(jitter_ns: int) -> None:
    gate = FrameGate(max_rate_hz=10.0)
    stamps_ns = [number * 33_333_333 + (number % 2) * jitter_ns for number in range(300)]  # 10 s at 30 Hz
    admitted = [stamp_ns for stamp_ns in stamps_ns if gate.admits(0, stamp_ns)]
    assert 99 <= len(admitted) <= 101


def test_a_new_rate_holds_at_once() -> None:
    gate = FrameGate(max_rate_hz=0.001)
    assert gate.admits(0, SECOND) and not gate.admits(0, 2 * SECOND)
    gate.max_rate_hz = 2.0
    assert [gate.admits(0, 2 * SECOND + number * SECOND // 4) for number in range(4)] == [True, False, True, False]
    gate.max_rate_hz = 0.001
    assert not gate.admits(0, 5 * SECOND)
    gate.max_rate_hz = 0.0
    assert gate.admits(0, 5 * SECOND)


def test_a_gate_follows_time_back() -> None:
    gate = FrameGate(max_rate_hz=1.0)
    assert gate.admits(0, 100 * SECOND) and not gate.admits(0, 100 * SECOND + 1)
    assert gate.admits(1, 5 * SECOND) and not gate.admits(1, 5 * SECOND + 1)
    assert gate.admits(1, 500 * SECOND) and not gate.admits(1, 500 * SECOND + 1)  # no backlog of admissions after a gap
    gate.is_paused = True
    assert not gate.admits(1, 600 * SECOND)


def test_parameters_over_the_graph(graph: Graph, frames: SyntheticSequence) -> None:
    """A refused change has no effect; an accepted one applies from the next frame on."""
    live = Live(graph)
    control = Control(graph)
    assert live.show(still(frames, 0))
    results = control.set(
        max_rate_hz=-1.0, queue_size=0, preset='tum', slam__tracking__iterations=-3, slam__threads=4,
        no_data_timeout=2.0,
    )  # fmt: skip
    assert [result.successful for result in results] == [False] * 5 + [True]
    assert 'out of range' in results[0].reason and 'cannot change while the node runs' in results[2].reason
    assert live.show(still(frames, 1))
    control.change(slam__depth__min_m=50.0)  # every reading is nearer
    assert live.show(still(frames, 2)) is None
    control.change(slam__depth__min_m=0.2)
    assert live.show(still(frames, 3))
    assert 'Traceback' not in live.node.text
