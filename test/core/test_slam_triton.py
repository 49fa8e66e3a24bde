"""The whole SLAM with the Triton rasterizer: on a GPU if there is one, else with interpreted kernels on small frames."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from splatam_core.config import AlignmentConfig, SlamConfig, TrackingConfig, load_config
from splatam_core.datasets.synthetic import SyntheticSequence
from splatam_core.geometry import se3
from splatam_core.images.view import View
from splatam_core.rasterizer import rasterizer_for
from splatam_core.slam import Slam
from splatam_core.tracking import make_tracker
from splatam_core.tracking.verdict import verify
from splatam_core.types import Status

Room = Callable[..., SyntheticSequence]

WIDTH = 48
FEW_STEPS = (
    'mapping.first_iterations=3', 'mapping.iterations=1', 'keyframes.every=2', 'mapping.prune_scale=1.0',
    'tracking.silhouette_threshold=0.7', 'tracking.min_visible_fraction=0.1', 'tracking.iterations=8',
)  # fmt: skip
# Metres and radians: a fifth of a pixel. With so few points, alignment depends on those on the border, which rounding includes or
# excludes. With more points it is far closer, see below; for the paper's tracker see test_rasterizer_triton.py.
TOLERANCE = 1e-2


def _config(rasterizer: str) -> SlamConfig:
    return load_config('realtime', ['threads=1', f'rasterizer={rasterizer}', *FEW_STEPS])


@pytest.mark.slow
def test_frames_of_realtime_are_those_of_the_native_rasterizer(room: Room) -> None:
    """Each starts from the same state, which moves between the two without loss: equal statuses and numbers of Gaussians."""
    sequence = room(4, WIDTH, noise=False)
    native, triton = Slam(_config('cpu')), Slam(_config('triton'))
    for index in range(4):
        state = triton.state()
        native.restore(state)
        assert all(np.array_equal(values, state.map[name]) for name, values in native.state().map.items())
        found, expected = triton.process(sequence[index]), native.process(sequence[index])
        assert found.status is expected.status is (Status.TRACKED if index else Status.INITIALIZED)
        assert np.abs(found.T_world_cam - expected.T_world_cam).max() < TOLERANCE
        assert found.num_gaussians == pytest.approx(expected.num_gaussians, rel=0.01) and found.num_gaussians > 400


@pytest.mark.slow
def test_alignment_to_an_interpreted_render_finds_the_same_pose(room: Room) -> None:
    """From the same map: to 0.2 mm, a fiftieth of a pixel."""
    sequence, slam = room(3, 160), Slam(load_config('quick', ['threads=1', 'rasterizer=cpu']))
    for index in range(2):
        slam.process(sequence[index])
    view, truth = View.from_frame(sequence[2], slam.config.depth), sequence.ground_truth().T_world_cam
    guess = se3.inverse(truth[1]) @ truth[0]
    config = TrackingConfig(method='align', iterations=6, align=AlignmentConfig(half_render_from=64))
    results = []
    for name in ('cpu', 'triton'):
        rasterizer, device = rasterizer_for(load_config('quick', ['threads=1', f'rasterizer={name}']))
        tracker = make_tracker(rasterizer, config, 1, device)
        results.append(tracker.track(view.to(device), slam.map.gaussians.to(device), guess))
    native, triton = results
    assert not verify(native, config) and not verify(triton, config)
    assert np.abs(native.T_cam_world - triton.T_cam_world).max() < 2e-4
