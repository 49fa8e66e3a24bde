"""Pairs of frames of a camera that turns: rows that are read one after the other, and colour that is later than depth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from test_readout import CAMERA, FRAME_NS, READOUT, Corner

from splatam_core.config import load_config
from splatam_core.geometry import se3
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.graph.nodes import Nodes
from splatam_core.graph.pairs import PairAligner, Shot
from splatam_core.images.view import View
from splatam_core.tracking.alignment import make_aligner
from splatam_core.tracking.motion import MotionModel
from splatam_core.tracking.pyramid import Level
from splatam_core.tracking.read_motion import STILL, ReadMotion
from splatam_core.tracking.readout import Readout
from splatam_core.tracking.time_offset import TimeOffset
from splatam_core.tracking.unrolling import unrolled

THERE, BACK = 16, 28  # the head is shaken one way, and the other way; places 6 degrees apart
FRAME_S = 1e-9 * FRAME_NS


def shot(corner: Corner, index: int, readout: float, delay: int) -> Shot:
    """Returns a frame, whose depth is so many frames older, and how the camera moved."""
    frame, older = corner.frame(index, readout), corner.frame(index - delay, readout)
    before, after = corner.poses(np.array([index - 0.5, index + 0.5]))
    velocity = se3.log(se3.inverse(after) @ before) / FRAME_S
    view = View(CAMERA, torch.from_numpy(frame.rgb), torch.from_numpy(older.depth_m))
    return Shot(view, ReadMotion(velocity, readout * FRAME_S, delay * FRAME_S))


@pytest.mark.parametrize(('readout', 'delay'), [(READOUT, 0), (-READOUT, 0), (0.0, 1), (READOUT, 1)])
def test_a_pair_knows_how_both_frames_were_taken(readout: float, delay: int) -> None:
    """Errors of a loop between two fast turns, m and rad: without it two centimetres and one or two degrees."""
    corner, pairs = Corner(), PairAligner(make_aligner(1, torch.device('cpu')), load_config('realtime').tracking)
    first, second = (shot(corner, index, readout, delay) for index in (THERE, BACK))
    T_first, T_second = corner.poses(np.array([float(THERE), float(BACK)]))
    truth = se3.inverse(T_second) @ T_first
    errors = []
    for one, other in ((first, second), (replace(first, motion=STILL), replace(second, motion=STILL))):
        off = se3.log(pairs.align(one, other, truth).T_second_first @ se3.inverse(truth)).reshape(2, 3)
        errors.append(np.linalg.norm(off, axis=1))
    assert (errors[0] < 0.3 * errors[1]).all()


def test_a_frame_at_rest_stays_as_it_is() -> None:
    """No bit changes, so a camera that is carried slowly costs nothing; nor where no depth says how pixels move."""
    rng = np.random.default_rng(0)
    camera = PinholeCamera(40, 30, 35.0, 35.0, 19.5, 14.5)
    level = Level(camera, rng.random((30, 40), dtype=np.float32), np.full((30, 40), 2, np.float32))
    assert unrolled(level, STILL) is level
    assert unrolled(level, ReadMotion(np.full(6, 0.03), 0.03, 0.0)) is level
    dark = replace(level, depth=np.full((30, 40), np.nan, np.float32))
    assert unrolled(dark, ReadMotion(np.ones(6), 0.03, 0.0)) is dark


def test_the_motion_of_a_camera_is_that_of_its_points() -> None:
    """Forward in time: points of a camera that moves to the right move to the left."""
    model, T = MotionModel(constant_velocity=True), se3.exp(np.array([0.1, 0, 0.02, 0.03, 0, 0]))
    model.observe(FRAME_NS, np.eye(4))
    model.observe(2 * FRAME_NS, T)
    model.readout, model.time_offset = Readout(0.02, 0.01), TimeOffset(0.5)
    motion = model.read_motion
    np.testing.assert_allclose(se3.exp(FRAME_S * motion.velocity), se3.inverse(T), atol=1e-9)
    assert motion.readout_s == pytest.approx(0.015) and motion.delay_s == pytest.approx(0.5 * FRAME_S)
    assert not MotionModel(constant_velocity=True).read_motion.rows.any()


def test_the_readout_is_that_known_last() -> None:
    """It is a property of the camera, and hardly known in the first frames; the delay is that of each frame."""
    nodes = Nodes()
    for number in range(3):
        motion = ReadMotion(np.full(6, number), 0.01 * number, 0.002 * number)
        nodes = nodes.added(number, number, np.eye(4), motion)
    motion = nodes.motion(1, as_known_at=2)
    assert (motion.velocity == 1).all() and motion.readout_s == 0.02 and motion.delay_s == 0.002
    assert len(nodes.before(2).velocity) == len(nodes.before(2).delay_s) == 2
