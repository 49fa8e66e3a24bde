"""The time offset between colour and depth, followed over frames."""

from __future__ import annotations

import numpy as np
import pytest

from splatam_core.tracking.time_offset import FIRST_VARIANCE, TimeOffset


def _follow(offsets: np.ndarray, overconfidence: float, information: np.ndarray, seed: int = 0) -> list[TimeOffset]:
    """Feeds noisy estimates of true offsets as alignment does: combined with the prior, by claimed weights."""
    rng, estimate, estimates = np.random.default_rng(seed), TimeOffset(), []
    for offset, claimed in zip(offsets, information, strict=True):
        measured = offset + rng.normal() * np.sqrt(overconfidence / claimed)
        weight = estimate.information
        posterior = (claimed * measured + weight * estimate.mean) / (claimed + weight)
        estimate = estimate.updated(float(posterior), float(claimed))
        estimates.append(estimate)
    return estimates


@pytest.mark.parametrize('overconfidence', [10.0, 100.0, 1000.0])
def test_a_constant_offset_is_found_however_much_the_pixels_claim(overconfidence: float) -> None:
    """To three of its own standard deviations, which are far below the scatter of single frames."""
    scatter = np.sqrt(overconfidence / 2000.0)
    final = _follow(np.full(300, 0.4), overconfidence, np.full(300, 2000.0))[-100:]
    errors = np.array([estimate.mean - 0.4 for estimate in final])
    spread = np.sqrt(np.mean([estimate.variance for estimate in final]))
    assert np.abs(errors).max() < 4 * spread and np.sqrt(np.mean(errors**2)) < max(0.6 * scatter, 0.02)


def test_two_clocks_that_drift_apart_are_followed() -> None:
    drifting = np.linspace(-0.3, 0.6, 300)
    estimates = _follow(drifting, 30.0, np.full(300, 5000.0))
    errors = np.array([estimate.mean for estimate in estimates]) - drifting
    assert np.abs(errors[50:]).max() < 0.15


def test_a_camera_at_rest_tells_nothing_and_changes_nothing() -> None:
    estimate = TimeOffset(mean=0.2, variance=0.01)
    for _ in range(1000):
        estimate = estimate.updated(0.2, 0.0)
    assert estimate.mean == 0.2 and estimate.variance == pytest.approx(FIRST_VARIANCE)


def test_a_colour_frame_that_came_twice_is_an_outlier() -> None:
    """It is a whole frame late; the estimate stays within a tenth."""
    offsets = np.zeros(200)
    offsets[100] = 1.0
    estimates = _follow(offsets, 30.0, np.full(200, 20000.0))
    assert abs(estimates[100].mean - estimates[99].mean) < 0.1
