"""What is kept of the newest views."""

from __future__ import annotations

import torch

from splatam_core.geometry.camera import PinholeCamera
from splatam_core.images.view import View
from splatam_core.tracking.newest import OfNewestViews


def test_a_view_is_worked_on_once_while_it_is_among_the_newest_two() -> None:
    camera = PinholeCamera(4, 3, 4.0, 4.0, 1.5, 1.0)
    first, second, third = (View(camera, torch.zeros(3, 4, 3, dtype=torch.uint8), torch.ones(3, 4)) for _ in range(3))  # alike
    worked_on: list[View] = []
    kept = OfNewestViews(lambda view: worked_on.append(view) or len(worked_on))
    assert [kept.of(view) for view in (first, first, second, first, third, second)] == [1, 1, 2, 1, 3, 2]
    assert kept.of(first) == 4 and worked_on == [first, second, third, first]
