"""A camera that is lost in a place never seen starts a new map, which joins the old one when a place of both is recognised."""

from __future__ import annotations

import dataclasses
import logging

import numpy as np
import pytest

from splatam_core.config import load_config
from splatam_core.datasets.registry import open_sequence
from splatam_core.errors import ConfigError
from splatam_core.geometry import motions, se3
from splatam_core.graph.links import Kind, Link, brought_together, parts
from splatam_core.slam import Slam
from splatam_core.types import FrameResult, Status

NEW_MAP = 'tracking.align.relocalisation.on_lost=new_map'
FAST = (
    'threads=1', 'keyframes.every=2', 'densification.every=2', 'mapping.iterations=2', 'graph.enabled=true', 'graph.loop_after=20',
    'tracking.align.relocalisation.new_map_after=4', 'tracking.min_inlier_fraction=0.75',
)  # fmt: skip
WAY = [*range(10), *range(80, 107), *range(1, 6), *range(102, 121)]
"""Frames of a walk that turns once in 112 frames: its beginning, a place never seen, for a moment the beginning again, and on."""
STEP_NS = 33_333_333


def turned(*settings: str, until: int = len(WAY)) -> tuple[Slam, list[FrameResult]]:
    """Carries the camera to where it has seen nothing, back, there again, and on until it sees its first place."""
    sequence, slam = open_sequence('synthetic:motion=fast', width=160), Slam(load_config('realtime', [*FAST, *settings]))
    frames = (dataclasses.replace(sequence[index % 112], stamp_ns=10**9 + k * STEP_NS) for k, index in enumerate(WAY[:until]))
    return slam, [slam.process(frame) for frame in frames]


@pytest.mark.slow
def test_a_new_map_starts_and_joins_the_old_one(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO):
        slam, results = turned(NEW_MAP)
    begins = [index for index, result in enumerate(results) if result.status is Status.INITIALIZED]
    assert len(begins) == 2 and 10 <= begins[1] <= 30
    assert all(result.status is Status.LOST for result in results[10 : begins[1]])
    assert results[begins[1]].T_world_cam[0, 3] > 20  # the old map and the new one do not see each other
    assert sum(result.is_relocalised for result in results) in (
        1,
        2,
    )  # the way to the beginning is short: features may tell it, too
    assert slam.graph.num_loops > 0 and slam.graph.num_corrections >= 1
    posed = [(index, result) for index, result in enumerate(results) if result.status.is_trusted]
    odometry = np.array([se3.inverse(result.T_world_odom) @ result.T_world_cam for _, result in posed])
    assert np.linalg.norm(np.diff(odometry[:, :3, 3], axis=0), axis=1).max() < 0.3  # the walk's end is 17 cm from its beginning
    stamps_ns, online = (np.array(values) for values in zip(*((result.stamp_ns, result.T_world_cam) for _, result in posed)))
    final = slam.graph.corrected(stamps_ns, online)
    truth = open_sequence('synthetic:motion=fast', width=160).ground_truth().T_world_cam
    true = np.array([truth[WAY[index] % 112] for index, _ in posed])
    off = np.linalg.norm((se3.inverse(final[0]) @ final - se3.inverse(true[0]) @ true)[:, :3, 3], axis=1)
    assert off.max() < 0.05  # frames before and after a loss, too: 2 pixels of 160 at the walls' 2.5 m
    assert slam.map.means[:, 0].max() < 10  # nothing is left beside it


@pytest.mark.slow
def test_it_waits_where_it_is_told_to() -> None:
    _, results = turned(until=25)
    assert sum(result.status is Status.INITIALIZED for result in results) == 1


def test_a_new_map_needs_the_graph() -> None:
    with pytest.raises(ConfigError, match=r'on_lost = new_map: .* set graph.enabled=true'):
        load_config('realtime', [NEW_MAP, 'graph.enabled=false'])
    with pytest.raises(ConfigError, match=r'on_lost = new_map: '):
        load_config('realtime', [NEW_MAP, 'graph.enabled=true', 'tracking.align.relocalisation.enabled=false'])


def test_parts_are_brought_together_by_what_joins_them() -> None:
    """Three maps: the second lies in the first as one edge says, the third in the second; the rest stays as it is."""
    truth = motions.exp(0.2 * np.random.default_rng(0).standard_normal((7, 6)))
    apart = truth.copy()
    apart[2:4] = se3.exp(np.array([30, 0, 0, 0, 1.0, 0])) @ apart[2:4]
    apart[4:] = se3.exp(np.array([60, 0, 0, 2.0, 0, 0])) @ apart[4:]

    def link(first: int, second: int, kind: Kind) -> Link:
        return Link.measured(first, second, motions.between(truth[first], truth[second]), kind, np.zeros((6, 6)))

    tracks = [link(first, first + 1, Kind.ODOMETRY) for first in (0, 2, 4, 5)]
    part = parts(7, tracks)
    assert part.tolist() == [0, 0, 2, 2, 4, 4, 4]
    together = brought_together(apart, [*tracks, link(0, 3, Kind.LOOP), link(2, 6, Kind.LOOP)], part)
    np.testing.assert_allclose(together, truth, atol=1e-9)
    alone = brought_together(apart, [*tracks, link(0, 3, Kind.LOOP)], part)
    np.testing.assert_allclose(alone[:4], truth[:4], atol=1e-9)
    assert np.array_equal(alone[4:], apart[4:])
