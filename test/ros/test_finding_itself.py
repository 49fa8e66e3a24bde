"""The node finds its camera: started in a saved map, carried away, and told where it is."""

from __future__ import annotations

import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from camera import MAKE, Live
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from graph import Graph

from msg_adapters import poses
from splatam_core.config import load_config
from splatam_core.datasets.registry import open_sequence
from splatam_core.geometry import se3
from splatam_core.maps.ply import read_ply, write_ply
from splatam_core.runs.map_keyframes import write_map_keyframes
from splatam_core.slam import Slam
from splatam_core.types import RgbdFrame
from splatam_ros.frames.rep105 import T_BODY_OPTICAL

STEP_NS = 33_333_333
NEAR_M = 0.05  # two pixels at the walls' 2.5 m


class Walk:
    """A walk through the room, of which a part is mapped and saved."""

    def __init__(self, folder: Path) -> None:
        self.sequence = open_sequence('synthetic', width=160)
        truth = self.sequence.ground_truth().T_world_cam
        self.true, self.folder, self._stamp_ns = se3.inverse(truth[0]) @ truth, folder, 10**9
        slam = Slam(load_config('quick', ['threads=1', 'keyframes.every=2']))
        results = [slam.process(self.sequence[index]) for index in range(0, 100, 8)]
        assert results[-1].status.is_trusted
        write_ply(folder / 'map.ply', slam.map.gaussians)
        write_map_keyframes(folder / 'map.keyframes', slam.keyframes, slam.places.arrays())

    def frame(self, index: int) -> RgbdFrame:
        """Returns a frame of the walk, with a stamp that follows the last one's."""
        self._stamp_ns += STEP_NS
        return replace(self.sequence[index], stamp_ns=self._stamp_ns)

    def shows(self, pose: PoseStamped | None, index: int) -> bool:
        """Whether a pose in the map, which is upright, is that of a frame."""
        expected = T_BODY_OPTICAL @ self.true[index]
        return pose is not None and bool(np.linalg.norm((poses.pose_matrix(pose.pose) - expected)[:3, 3]) < NEAR_M)


@pytest.fixture(scope='module')
def walk(tmp_path_factory: pytest.TempPathFactory) -> Walk:
    return Walk(tmp_path_factory.mktemp('run'))


@pytest.mark.slow
def test_a_camera_is_found_in_a_saved_map_carried_away_and_told(graph: Graph, walk: Walk) -> None:
    """The map, which is frozen, stays as it is."""
    out = graph.folder / 'run'
    live = Live(
        graph, load_path=walk.folder, save_path=out, world_up='z_up', slam__mapping__enabled=False,
        slam__tracking__min_inlier_fraction=0.5,
    )  # fmt: skip
    told = graph.publisher(PoseWithCovarianceStamped, '/initialpose')
    assert live.node.says('keyframes', 'is looked for by them')
    dark = walk.frame(12)
    assert live.show(replace(dark, rgb=np.zeros_like(dark.rgb))) is None
    assert live.node.says('lost', 'no place of the map')
    shown = [live.show(walk.frame(index)) for index in range(12, 16)]
    assert shown[0] is None and walk.shows(shown[-1], 15)
    assert live.node.says('relocalised by keyframe')

    carried = [live.show(walk.frame(index)) for index in range(82, 88)]
    assert carried[0] is None and walk.shows(carried[-1], 87)

    def tell(T_map_camera: np.ndarray, frame_id: str = 'map') -> None:
        T_map_body = T_map_camera @ se3.inverse(T_BODY_OPTICAL)
        told.publish(poses.pose_with_covariance(MAKE, T_map_body, np.zeros((6, 6)), 0, frame_id))
        graph.spin_for(0.3)

    graph.spin_until(lambda: told.get_subscription_count() == 1)
    tell(T_BODY_OPTICAL @ walk.true[12], 'odom')
    live.wait_says('initialpose is refused', "'odom'")
    tell(T_BODY_OPTICAL @ walk.true[88] @ se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 2.5, 0.0])))  # it looks elsewhere
    assert all(walk.shows(live.show(walk.frame(index)), index) for index in (88, 89))
    live.wait_says('the pose that was told is refused')
    tell(T_BODY_OPTICAL @ walk.true[12] @ se3.exp(np.array([0.15, 0.0, -0.1, 0.0, 0.1, 0.0])))
    back = [live.show(walk.frame(index)) for index in (12, 13)]
    assert walk.shows(back[-1], 13) and live.node.says('relocalised by the pose that was told')
    live.node.send(signal.SIGINT)
    assert live.node.wait() == 0
    np.testing.assert_array_equal(read_ply(out / 'map.ply').means, read_ply(walk.folder / 'map.ply').means)


@pytest.mark.slow
def test_a_camera_lost_where_nothing_is_mapped_starts_a_new_map(graph: Graph) -> None:
    """Beside the old one, in the same frame, after as many frames as are set."""
    live = Live(
        graph, preset='realtime', slam__graph__enabled=True, slam__tracking__align__relocalisation__on_lost='new_map',
        slam__tracking__align__relocalisation__new_map_after=3, slam__tracking__min_inlier_fraction=0.75,
    )  # fmt: skip
    sequence = open_sequence('synthetic:motion=fast', width=160)  # it turns by a third of a circle from frame 4 to 80
    frames = [replace(sequence[index], stamp_ns=10**9 + k * STEP_NS) for k, index in enumerate([*range(4), *range(80, 90)])]
    shown = [live.show(frame) for frame in frames]
    assert all(shown[:4]) and shown[4] is None and shown[-1] is not None
    live.wait_says('a new map starts beside it')
    assert np.linalg.norm(poses.pose_matrix(shown[-1].pose)[:3, 3]) > 20
