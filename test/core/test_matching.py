"""Descriptors of two images that belong together: the native code's are OpenCV's."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from splatam_core import _native
from splatam_core.tracking import matching


def alike(seed: int, num_first: int, num_second: int) -> tuple[np.ndarray, np.ndarray]:
    """Descriptors of two images, some of them equal, so that many are equally near."""
    rng = np.random.default_rng(seed)
    first = rng.integers(0, 256, (num_first, 32), np.uint8)
    first[::5] = first[0]
    second = first[rng.integers(num_first, size=num_second)] ^ (rng.random((num_second, 32)) < 0.1).astype(np.uint8)
    second[::7] = second[0]
    return first, second


@pytest.mark.parametrize('has_extension', [True, False])
@pytest.mark.parametrize(('num_first', 'num_second'), [(1, 1), (60, 50), (200, 300)])
def test_pairs_are_those_of_opencv(monkeypatch: pytest.MonkeyPatch, has_extension: bool, num_first: int, num_second: int) -> None:
    monkeypatch.setattr(matching, 'has_extension', lambda: has_extension)
    for seed in range(5):
        first, second = alike(seed, num_first, num_second)
        found = matching.matched(first, second)
        expected = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(first, second)
        assert found.first.tolist() == [pair.queryIdx for pair in expected]
        assert found.second.tolist() == [pair.trainIdx for pair in expected]
        assert found.distance.tolist() == [pair.distance for pair in expected]


@pytest.mark.parametrize('has_extension', [True, False])
def test_without_descriptors_there_are_no_pairs(monkeypatch: pytest.MonkeyPatch, has_extension: bool) -> None:
    monkeypatch.setattr(matching, 'has_extension', lambda: has_extension)
    none, some = np.empty((0, 32), np.uint8), np.zeros((3, 32), np.uint8)
    for first, second in ((none, some), (some, none), (none, none)):
        assert not len(matching.matched(first, second).first)


@pytest.mark.parametrize('wrong', [np.zeros((3, 31), np.uint8), np.zeros((3, 32)), np.zeros((6, 64), np.uint8)[::2, ::2], 3])
def test_what_are_no_descriptors_is_refused(wrong: object) -> None:
    right = np.zeros((3, 32), np.uint8)
    for name, arguments in (('ours', (wrong, right)), ('others', (right, wrong))):
        with pytest.raises(TypeError, match=name):
            _native.match(*arguments)
