"""A box that moves through the view neither moves the camera nor stays in the map."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
import torch

from splatam_core.config import load_config
from splatam_core.datasets.synthetic import SyntheticSequence
from splatam_core.geometry import se3
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.images.view import View
from splatam_core.mapping.ghosts import without
from splatam_core.mapping.posed import PosedView
from splatam_core.rasterizer.base import NOT_COMPARED
from splatam_core.runs.checkpoints import Checkpoints, Progress, read_checkpoint
from splatam_core.runs.map_keyframes import read_map_keyframes, write_map_keyframes
from splatam_core.slam import Slam
from splatam_core.types import RgbdFrame, Status

FRAMES, BEGIN, LENGTH, NEVER = 24, 8, 10, 1000
BOX_M, BOX_SHARE = 0.8, 0.32  # distance; share of the width and of the height: a tenth of the view


def _with_box(frame: RgbdFrame, count: int) -> RgbdFrame:
    rgb, depth = frame.rgb.copy(), frame.depth_m.copy()
    height, width = depth.shape
    tall, wide = round(BOX_SHARE * height), round(BOX_SHARE * width)
    top, left = (height - tall) // 2, round((width - wide) * count / (LENGTH - 1))
    v, u = np.mgrid[:tall, :wide]
    box = slice(top, top + tall), slice(left, left + wide)
    rgb[box], depth[box] = np.where((u // 8 + v // 8) % 2, 220, 40).astype(np.uint8)[..., None], BOX_M
    return replace(frame, rgb=rgb, depth_m=depth)


@lru_cache(maxsize=3)
def _run(begin: int) -> tuple[Slam, float, float]:
    """Returns SLAM after the room, the RMSE of the camera in m, and the share of the view in which a ghost is rendered."""
    room = SyntheticSequence(frames=FRAMES, width=96)
    truth, errors, shares = room.ground_truth().T_world_cam, [], []
    slam = Slam(load_config('realtime', ['threads=1', 'device=cpu']))
    for index in range(FRAMES):
        frame = room[index]
        if begin <= index < begin + LENGTH:
            frame = _with_box(frame, index - begin)
        result = slam.process(frame)
        assert result.status in (Status.INITIALIZED, Status.TRACKED), (index, result.reason)
        errors.append(np.linalg.norm((se3.inverse(truth[index]) @ truth[0] @ result.T_world_cam)[:3, 3]))
    for index in range(0, FRAMES, 4):
        depth = slam.render(se3.inverse(truth[0]) @ truth[index]).depth_m
        seen = room[index].depth_m
        shares.append(((depth > 0) & (depth < 0.85 * seen)).sum() / (seen > 0).sum())
    return slam, float(np.sqrt(np.mean(np.square(errors)))), float(np.mean(shares))


@pytest.mark.parametrize(('begin', 'worse'), [(BEGIN, 1.15), (0, 1.5)])
def test_a_box_that_moves_through_the_view_leaves_no_ghost(begin: int, worse: float) -> None:
    """It is not mapped where the room was seen before, so the camera is off as without it; in the first view it is, and removed."""
    _, off_m, share = _run(begin)
    _, usual_m, usual_share = _run(NEVER)
    assert share < usual_share + 0.03
    assert off_m < worse * usual_m


def test_keyframes_forget_the_box_and_are_saved_so(tmp_path: Path) -> None:
    slam, _, _ = _run(BEGIN)
    forgotten = [float((keyframe.view.depth == NOT_COMPARED).float().mean()) for keyframe in slam.keyframes]
    assert max(forgotten) > 0.05 and forgotten[0] == forgotten[-1] == 0
    state = read_checkpoint(Checkpoints(tmp_path, 1).save(slam.state(), Progress(FRAMES, FRAMES - 1, '', FRAMES))).state
    for saved, keyframe in zip(state.keyframes, slam.keyframes, strict=True):
        assert torch.equal(saved.view.depth, keyframe.view.depth)
    write_map_keyframes(tmp_path / 'map.keyframes', list(slam.keyframes), slam.places.arrays())
    for saved, keyframe in zip(read_map_keyframes(tmp_path / 'map.keyframes').keyframes, slam.keyframes, strict=True):
        assert (saved.view.depth - keyframe.view.depth.clamp(min=0)).abs().max() < 1e-3  # whole millimetres, rounded
    assert slam.finish() > 0


def test_a_room_in_which_nothing_moves_forgets_nothing() -> None:
    slam, _, _ = _run(NEVER)
    assert all((keyframe.view.depth >= 0).all() for keyframe in slam.keyframes)


@pytest.mark.parametrize('z', [1.0, 2.0, -1.0])
def test_only_what_a_keyframe_shows_is_forgotten(z: float) -> None:
    camera = PinholeCamera(64, 48, 60.0, 60.0, 31.5, 23.5)
    view = View(camera, torch.zeros(48, 64, 3, dtype=torch.uint8), torch.full((48, 64), 2.0))
    keyframe = PosedView(view, torch.eye(4))
    forgotten = without(keyframe, torch.tensor([[0.0, 0.0, z]]))
    assert (forgotten is keyframe) == (z != 2.0)
    assert int((forgotten.view.depth == NOT_COMPARED).sum()) == (9 if z == 2.0 else 0)
