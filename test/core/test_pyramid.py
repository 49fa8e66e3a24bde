"""What of a render the alignment compares."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from splatam_core.config import load_config
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.rasterizer import Render
from splatam_core.rasterizer.native import make_native_aligner
from splatam_core.tracking.pyramid import half_pyramid, render_level

CAMERA = PinholeCamera(width=160, height=120, fx=140, fy=140, cx=79.5, cy=59.5)
ALIGNER = make_native_aligner(1)


def render_with_seams(silhouette: float, colour: float = 0.6, depth_m: float = 2.0) -> Render:
    """A grey wall whose silhouette dips at every eighth column, as where the Gaussians of two frames meet."""
    covered = torch.full((CAMERA.height, CAMERA.width), 0.999)
    covered[:, ::8] = silhouette
    return Render(rgb=(colour * covered).expand(3, -1, -1).contiguous(), depth_acc=depth_m * covered, silhouette=covered)


@pytest.mark.parametrize('preset', ['quick', 'realtime'])
def test_seams_between_the_gaussians_of_two_frames_hide_nothing(preset: str) -> None:
    threshold = load_config(preset).tracking.silhouette_threshold
    level = render_level(render_with_seams(0.93), CAMERA, threshold, ALIGNER)
    assert np.isfinite(level.depth).all()
    assert level.brightness == pytest.approx(0.6, abs=1e-4)  # the black behind the map does not show
    finest = half_pyramid(level, ALIGNER)[0]
    assert np.isfinite(finest.depth).all() and finest.depth == pytest.approx(2.0, abs=1e-3)


def test_what_is_not_mapped_is_not_compared() -> None:
    level = render_level(render_with_seams(0.5), CAMERA, 0.9, ALIGNER)
    assert np.isnan(level.depth[:, ::8]).all() and np.isfinite(level.depth[:, 1::8]).all()
    empty = Render(rgb=torch.zeros(3, 120, 160), depth_acc=torch.zeros(120, 160), silhouette=torch.zeros(120, 160))
    level = render_level(empty, CAMERA, 0.0, ALIGNER)
    assert np.isnan(level.depth).all() and (level.brightness == 0).all()
