"""What is kept of the newest views."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from splatam_core.config import load_config
from splatam_core.datasets.synthetic import SyntheticSequence
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.images.view import View
from splatam_core.slam import Slam
from splatam_core.tracking.newest import OfNewestViews
from splatam_core.types import Status


def test_a_view_is_worked_on_once_while_it_is_among_the_newest_two() -> None:
    camera = PinholeCamera(4, 3, 4.0, 4.0, 1.5, 1.0)
    first, second, third = (View(camera, torch.zeros(3, 4, 3, dtype=torch.uint8), torch.ones(3, 4)) for _ in range(3))  # alike
    worked_on: list[View] = []
    kept = OfNewestViews(lambda view: worked_on.append(view) or len(worked_on))
    assert [kept.of(view) for view in (first, first, second, first, third, second)] == [1, 1, 2, 1, 3, 2]
    assert kept.of(first) == 4 and worked_on == [first, second, third, first]


def test_the_result_of_a_view_that_is_gone_is_forgotten() -> None:
    camera = PinholeCamera(4, 3, 4.0, 4.0, 1.5, 1.0)
    view = View(camera, torch.zeros(3, 4, 3, dtype=torch.uint8), torch.ones(3, 4))
    kept = OfNewestViews(lambda view: np.zeros(3))
    result = weakref.ref(kept.of(view))
    assert result() is not None
    del view
    assert result() is None


@pytest.mark.parametrize('preset', ['realtime', 'quick', 'splatam'])
def test_of_the_frames_only_the_last_is_held(room: Callable[..., SyntheticSequence], preset: str) -> None:
    """Nothing that is kept of a frame, such as its pyramid, holds its images. Keyframes are smaller here, and do not share them."""
    slam = Slam(load_config(preset, ['threads=1', 'mapping.scale=0.5']))
    held: list[weakref.ref[np.ndarray]] = []
    for frame in room(frames=6, width=96):
        frame = replace(frame, rgb=frame.rgb.copy())
        held.append(weakref.ref(frame.rgb))
        assert slam.process(frame).status in (Status.INITIALIZED, Status.TRACKED)
        del frame
        assert [number for number, images in enumerate(held) if images() is not None] == [len(held) - 1]
