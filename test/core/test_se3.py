"""Rigid motions: identities that hold for every motion."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from splatam_core.geometry import se3

angles = st.floats(-3.0, 3.0)  # a rotation vector shorter than pi, so that log is its inverse
twists = st.tuples(*[st.floats(-5, 5)] * 3, *[angles] * 3).map(np.array).filter(lambda t: np.linalg.norm(t[3:]) < 3.1)
TOLERANCE = 1e-9  # float64, a few dozen operations on numbers up to 10


@given(twists)
def test_log_undoes_exp(twist: np.ndarray) -> None:
    np.testing.assert_allclose(se3.log(se3.exp(twist)), twist, atol=1e-7)  # near pi the angle loses half the digits


@given(twists)
def test_inverse(twist: np.ndarray) -> None:
    T = se3.exp(twist)
    np.testing.assert_allclose(se3.inverse(T) @ T, np.eye(4), atol=TOLERANCE)
    np.testing.assert_allclose(se3.inverse(T), se3.exp(-twist), atol=TOLERANCE)


@given(twists)
def test_quaternion_round_trip(twist: np.ndarray) -> None:
    R = se3.exp(twist)[:3, :3]
    q = se3.quaternion_from_rotation(R)
    assert q[0] >= 0
    np.testing.assert_allclose(se3.rotation_from_quaternion(-2.0 * q), R, atol=TOLERANCE)


@pytest.mark.parametrize('axis', [0, 1, 2])
def test_half_turns(axis: int) -> None:
    """Where the quaternion's w is zero."""
    phi = np.zeros(6)
    phi[3 + axis] = np.pi
    T = se3.exp(phi)
    assert np.linalg.norm(se3.log(T)[3:]) == pytest.approx(np.pi)
    np.testing.assert_allclose(se3.exp(se3.log(T)), T, atol=TOLERANCE)


@given(twists, st.floats(0.0, 1.0))
def test_interpolation_ends_at_its_ends(twist: np.ndarray, fraction: float) -> None:
    T_a, T_b = se3.exp(np.array([1.0, 2, 3, 0.3, 0.2, 0.1])), se3.exp(twist)
    np.testing.assert_allclose(se3.interpolate(T_a, T_b, 0.0), T_a, atol=1e-6)
    np.testing.assert_allclose(se3.interpolate(T_a, T_b, 1.0), T_b, atol=1e-6)
    halfway = se3.interpolate(T_a, T_b, fraction)
    np.testing.assert_allclose(halfway[:3, :3].T @ halfway[:3, :3], np.eye(3), atol=TOLERANCE)


def test_small_angles_meet_the_closed_form() -> None:
    """The series and the closed form agree at the angle where they switch."""
    for angle in (0.9e-5, 1.1e-5):
        twist = np.array([0.3, -0.2, 0.5, angle, 0, 0])
        np.testing.assert_allclose(se3.log(se3.exp(twist)), twist, atol=1e-9)
