"""Gaussians move with the frames that added them, and poses with the keyframes around them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from splatam_core.errors import MapFileError
from splatam_core.geometry import motions, se3
from splatam_core.graph.corrections import Corrections
from splatam_core.graph.nodes import Nodes
from splatam_core.mapping.gaussian_map import GaussianMap
from splatam_core.maps.ply import read_ply, write_ply
from splatam_core.rasterizer import Gaussians
from splatam_core.rasterizer.bounds import block_bounds

SHIFT, TURN = np.array([0.3, 0, 0, 0, 0, 0]), np.array([0, 0.1, 0, 0, 0.4, 0])


def corrections() -> Corrections:
    """Frame 10 stays, frame 20 shifts, frame 30 shifts and turns."""
    return Corrections(np.array([10, 20, 30]), motions.exp(np.array([np.zeros(6), SHIFT, SHIFT + TURN])))


def a_map(frames: list[int], per_frame: int = 700, anisotropic: bool = False) -> GaussianMap:
    result, rng = GaussianMap(anisotropic), np.random.default_rng(0)

    def some(*shape: int) -> torch.Tensor:
        return torch.from_numpy(rng.standard_normal(shape).astype(np.float32))

    for frame in frames:
        result.frame = frame
        rotations = some(per_frame, 4) if anisotropic else None
        scales = some(per_frame, 3 if anisotropic else 1)
        result.append(Gaussians(some(per_frame, 3), scales, some(per_frame), some(per_frame, 3), rotations=rotations))
    result.moments.first_second[:] = 1
    result.moments.steps[:] = 7
    return result


@pytest.mark.parametrize('anisotropic', [False, True])
def test_gaussians_move_with_their_frames(anisotropic: bool) -> None:
    moved, where = a_map([0, 10, 15, 20, 40], anisotropic=anisotropic), corrections()
    before = moved.gaussians.detached().chosen(torch.ones(len(moved), dtype=torch.bool))
    assert moved.move(where.at) == 3 * 700  # those of frames 0 and 10 stay
    expected = where.at(moved.added_by.numpy().astype(np.int64))
    points = np.einsum('nij,nj->ni', expected[:, :3, :3], before.means.double().numpy()) + expected[:, :3, 3]
    np.testing.assert_allclose(moved.means.numpy(), points, atol=1e-5)  # float32 at some metres
    assert torch.equal(moved.means[:1400], before.means[:1400])
    assert torch.equal(moved.gaussians.bounds, block_bounds(moved.means, moved.log_scales))
    first, second = moved.moments.first_second.double().numpy().reshape(-1, 2, 8).swapaxes(0, 1)
    np.testing.assert_allclose(first[:, :3], expected[:, :3, :3].sum(axis=2), atol=1e-6)  # they were ones
    np.testing.assert_allclose(second[:, :3], 1, atol=1e-6)  # the same along every axis
    assert (moved.moments.first_second[:1400] == 1).all() and (moved.moments.steps == 7).all()
    if anisotropic:
        R = expected[:, :3, :3] @ se3.rotation_from_quaternion(before.rotations.double().numpy())
        np.testing.assert_allclose(se3.rotation_from_quaternion(moved.rotations.double().numpy()), R, atol=1e-5)


def test_corrections_leave_no_seam() -> None:
    """Halfway between two keyframes half of the way is moved; before the first and after the last nothing more is."""
    between = corrections().at(np.array([0, 10, 15, 20, 29, 30, 99]))
    np.testing.assert_allclose(between[2, :3, 3], 0.5 * SHIFT[:3], atol=1e-12)
    assert (between[0] == np.eye(4)).all() and (between[-1] == between[-2]).all()
    assert np.linalg.norm(motions.log(se3.inverse(between[4]) @ between[5])) < 0.05


def test_anchors_are_kept(tmp_path: Path) -> None:
    """By keep, by files and by another map; a file without them is read as before."""
    anchored = a_map([3, 70_000], 5)
    anchored.keep(torch.arange(10) % 2 == 0)
    write_ply(tmp_path / 'map.ply', anchored.gaussians)
    back = read_ply(tmp_path / 'map.ply')
    assert back.anchors is not None and back.anchors.tolist() == [3, 3, 3, 70_000, 70_000]
    other = GaussianMap()
    other.append(back)
    assert other.added_by.tolist() == back.anchors.tolist()
    write_ply(tmp_path / 'bare.ply', replace(back, anchors=None))
    assert read_ply(tmp_path / 'bare.ply').anchors is None


def test_anchors_that_are_no_frames_are_refused(tmp_path: Path) -> None:
    write_ply(tmp_path / 'map.ply', replace(a_map([1], 2).gaussians, anchors=torch.tensor([1, -1], dtype=torch.int32)))
    with pytest.raises(MapFileError, match='anchor'):
        read_ply(tmp_path / 'map.ply')


def poses(count: int) -> np.ndarray:
    return motions.exp(np.linspace(0, 1, count)[:, None] * np.array([1, 0, 0, 0, 0.5, 0]))


def test_frames_between_keyframes_follow_both() -> None:
    """Keyframe 2 is corrected when it is added: frames before it move with the correction, frames after it are in it already."""
    T = poses(9)
    nodes = Nodes().added(0, 0, T[0]).added(4, 4, T[4])
    jump = se3.exp(SHIFT)
    nodes = nodes.moved(np.array([T[0], jump @ T[4]]))
    published = np.array([*T[:5], *(jump @ T[5:])])
    nodes = nodes.added(8, 8, published[8])
    final = nodes.corrected(np.arange(9), published)
    np.testing.assert_allclose(final[0], T[0], atol=1e-12)
    np.testing.assert_allclose(final[4:], jump @ T[4:], atol=1e-12)
    np.testing.assert_allclose(final[2], se3.exp(0.5 * SHIFT) @ T[2], atol=1e-12)


def test_without_keyframes_poses_stay() -> None:
    assert (Nodes().corrected(np.arange(3), poses(3)) == poses(3)).all()
