"""The whole SLAM on a device whose memory is not the host's: a second device made of the first (``second_device``)."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from second_device import DEVICE, DeviceRasterizer, DeviceTensor, SecondDevice

from splatam_core import lifecycle, stopwatch
from splatam_core.config import KeyframeConfig, PaperTrackingConfig, SlamConfig, TrackingConfig, load_config
from splatam_core.datasets.synthetic import SyntheticSequence
from splatam_core.device import Backend
from splatam_core.evaluation.images import ViewScorer
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.images.view import View
from splatam_core.mapping import densification, posed
from splatam_core.mapping.keyframes import KeyframeStore
from splatam_core.mapping.offline_refinement import refine_map
from splatam_core.mapping.posed import PosedView
from splatam_core.maps.export import centres
from splatam_core.maps.ply import read_ply, write_ply
from splatam_core.rasterizer import make_rasterizer
from splatam_core.runs.metrics import ImageScores, OriginalScores
from splatam_core.slam import Slam
from splatam_core.tracking import make_tracker
from splatam_core.types import Status

Room = Callable[..., SyntheticSequence]

FEW_STEPS = {
    'splatam': (
        'tracking.iterations=4', 'mapping.iterations=4', 'keyframes.every=2', 'tracking.paper.depth_outlier_ratio=20',
        'mapping.paper.depth_outlier_ratio=20', 'mapping.paper.prune_every=2', 'densification.scale=0.9',
        'tracking.paper.extend_above_m=0.001', 'tracking.silhouette_threshold=0.9',
    ),
    'realtime': ('mapping.first_iterations=10', 'keyframes.every=2', 'mapping.fused.prune_fraction=0.0'),
}  # fmt: skip
WIDTHS = {'splatam': 96, 'realtime': 160}
WIDTH = 160


@contextmanager
def _on_device(monkeypatch: pytest.MonkeyPatch) -> Iterator[SecondDevice]:
    """A Slam made in here computes on the second device."""
    with monkeypatch.context() as patch, SecondDevice() as device:
        patch.setattr(lifecycle, 'choose_backend', lambda config: Backend(DEVICE, 'cpu'))
        patch.setattr(lifecycle, 'make_rasterizer', lambda name, threads: DeviceRasterizer())
        patch.setattr(stopwatch, 'synchronize', lambda device: None)
        yield device


def _config(preset: str, *more: str) -> SlamConfig:
    return load_config(preset, ['threads=1', 'device=cpu', *FEW_STEPS[preset], *more])


# Of a pose from the same state, metres and radians: splatam sums float32 in another order; alignment, besides, decides by
# single pixels (is a point that falls on the border inside? is a seam of the map opaque enough?) how far its steps go, and
# stops short of convergence. A pixel of these images is 7e-3.
TOLERANCE = {'splatam': 1e-4, 'realtime': 5e-4}


@pytest.mark.slow
@pytest.mark.parametrize('preset', FEW_STEPS)
def test_frames_on_the_device_are_those_of_the_host(preset: str, room: Room, monkeypatch: pytest.MonkeyPatch) -> None:
    """No frame touches the host's memory unasked, and from the same state both find the same pose."""
    sequence, host = room(4, WIDTHS[preset], noise=False), Slam(_config(preset))
    with _on_device(monkeypatch):
        there = Slam(_config(preset, 'keyframes.on_device=2'))
        for index in range(4):
            host.restore(there.state())
            found, expected = there.process(sequence[index]), host.process(sequence[index])
            assert found.status is expected.status is (Status.TRACKED if index else Status.INITIALIZED)
            assert np.abs(found.T_world_cam - expected.T_world_cam).max() < TOLERANCE[preset]
            assert found.num_gaussians == pytest.approx(expected.num_gaussians, rel=1e-3) and found.num_gaussians > 2000
        assert isinstance(there.map.means, DeviceTensor)


def test_state_moves_between_host_and_device_without_loss(room: Room, monkeypatch: pytest.MonkeyPatch) -> None:
    """Map, moments, bounds and keyframes, bit for bit."""
    sequence, here = room(4, WIDTH), Slam(_config('realtime'))
    for index in range(3):
        here.process(sequence[index])
    before = here.state()
    with _on_device(monkeypatch):
        there = Slam(_config('realtime'))
        there.restore(before)
        assert isinstance(there.map.gaussians.bounds, DeviceTensor)
        after = there.state()
    assert before.map.keys() == after.map.keys()
    for name, values in before.map.items():
        assert values.dtype == after.map[name].dtype and np.array_equal(values, after.map[name]), name
    assert all(a is b for a, b in zip(before.keyframes, after.keyframes, strict=True))
    here.restore(after)
    assert here.process(sequence[3]).status is Status.TRACKED


def test_keyframes_are_in_the_hosts_memory_and_a_bounded_number_on_the_device() -> None:
    """Those used last stay there, and are brought there once."""
    camera = PinholeCamera(4, 3, 4.0, 4.0, 1.5, 1.0)
    with SecondDevice() as device:
        store = KeyframeStore(DEVICE, KeyframeConfig(on_device=2))
        kept = [
            PosedView(View(camera, torch.zeros(3, 4, 3, dtype=torch.uint8), torch.full((3, 4), float(k))), torch.eye(4))
            for k in range(4)
        ]
        for keyframe in kept:
            store.append(keyframe)
        window = store.window(store)
        first, second = window[0], window[1]
        assert isinstance(first.view.depth, DeviceTensor) and isinstance(first.T_cam_world, DeviceTensor)
        assert not any(isinstance(keyframe.view.depth, DeviceTensor) for keyframe in store)
        assert window[0] is first and window[1] is second
        assert window[0] is first  # used last
        third = window[2]
        assert window[0] is first and window[2] is third and window[1] is not second
        assert device.waits.total() == 0


def test_a_frame_goes_to_the_device_once(room: Room, monkeypatch: pytest.MonkeyPatch) -> None:
    """To be tracked and, smaller, to be fitted, if a step draws it or it is a keyframe. None is read back."""
    sequence, brought = room(6, WIDTH), []
    original = View.to

    def to(view: View, device: torch.device) -> View:
        moved = original(view, device)
        brought.extend([moved] * (moved is not view))
        return moved

    monkeypatch.setattr(View, 'to', to)
    with _on_device(monkeypatch):
        slam = Slam(_config('realtime'))
        for index in range(6):
            slam.process(sequence[index])
        assert len(slam.state().keyframes) == 3
    widths = Counter(view.camera.width for view in brought)
    assert widths.pop(WIDTH) == 6 and 3 <= widths.pop(WIDTH * 3 // 4) <= 6 and not widths


def test_no_step_of_tracking_waits_for_the_device(room: Room, monkeypatch: pytest.MonkeyPatch) -> None:
    """However many steps the paper's tracker takes, the host waits as often; alignment waits once a step, for its sums."""
    sequence = room(2, WIDTH)
    with _on_device(monkeypatch) as device:
        slam = Slam(_config('realtime'))
        slam.process(sequence[0])
        view = View.from_frame(sequence[1], slam.config.depth).to(DEVICE)
        waits = {}
        for config in (
            *(
                TrackingConfig(method='render_and_compare', iterations=n, paper=PaperTrackingConfig(depth_outlier_ratio=20.0))
                for n in (1, 5)
            ),
            TrackingConfig(method='align', iterations=1),
        ):
            before = device.waits.total()
            tracker = make_tracker(DeviceRasterizer(), config, 1, DEVICE)
            tracker.track(view, slam.map.gaussians, np.eye(4))
            waits[config.method, config.iterations] = device.waits.total() - before
    assert waits['render_and_compare', 1] == waits['render_and_compare', 5] <= 4  # where it starts, what it found
    assert waits['align', 1] == 7  # one step, the two fits that decide, how many readings there are, three images as evidence


def test_renders_scores_and_files_come_from_the_device(room: Room, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The same numbers, to the rounding of sums, and the same bytes."""
    sequence = room(2, WIDTH)
    slam = Slam(_config('realtime'))
    slam.process(sequence[0])
    gaussians, depth = slam.map.gaussians, slam.config.depth
    expected = ViewScorer(gaussians, make_rasterizer('cpu', 1), depth).score(sequence[0], np.eye(4))
    write_ply(tmp_path / 'host.ply', gaussians)
    with _on_device(monkeypatch):
        there = Slam(_config('realtime'))
        there.load(read_ply(tmp_path / 'host.ply'), np.eye(4))
        there.camera = sequence.camera
        moved = gaussians.to(DEVICE)
        found = ViewScorer(moved, DeviceRasterizer(), depth).score(sequence[0], np.eye(4))
        write_ply(tmp_path / 'device.ply', moved)
        assert np.array_equal(there.render(np.eye(4)).rgb, slam.render(np.eye(4)).rgb)
        assert np.array_equal(there.snapshot().means, slam.snapshot().means)
        assert np.array_equal(centres(moved, 0.1).points_m, centres(gaussians, 0.1).points_m)
    assert _known(found.scores) == pytest.approx(_known(expected.scores), rel=1e-4)
    assert _known(found.original) == pytest.approx(_known(expected.original), rel=1e-4)
    assert (tmp_path / 'device.ply').read_bytes() == (tmp_path / 'host.ply').read_bytes()


def _known(scores: ImageScores | OriginalScores) -> dict[str, float]:
    return {name: value for name, value in dataclasses.asdict(scores).items() if value is not None}


def test_refining_a_map_happens_on_the_device(room: Room, monkeypatch: pytest.MonkeyPatch) -> None:
    sequence = room(2, WIDTH)
    slam = Slam(_config('realtime'))
    slam.process(sequence[0])
    stamp_ns = sequence[0].stamp_ns
    with _on_device(monkeypatch):
        there = slam.map.gaussians.to(DEVICE)
        refined = refine_map(there, sequence, {stamp_ns: np.eye(4)}, DeviceRasterizer(), slam.config, 3, iter)
        assert isinstance(refined.means, DeviceTensor) and not torch.equal(refined.rgb[: len(there)], there.rgb)


@pytest.mark.parametrize(
    ('module', 'name', 'wrong'),
    [
        (densification, 'box_sums', lambda image, side: torch.zeros(image.shape)),
        (posed, 'pose_tensor', lambda T, device: torch.from_numpy(T).float()),
    ],
)
def test_what_forgets_the_device_is_noticed(
    module: ModuleType, name: str, wrong: Callable[..., torch.Tensor], room: Room, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second device is strict: mistakes that a GPU would refuse are refused here."""
    sequence = room(3, 64)
    monkeypatch.setattr(module, name, wrong)
    with _on_device(monkeypatch):
        slam = Slam(_config('realtime'))
        with pytest.raises(RuntimeError, match='expected all tensors on the device'):
            for index in range(3):
                slam.process(sequence[index])
