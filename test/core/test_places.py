"""Keyframes as places: a view is recognised, whatever its kind, and nothing is found where there is nothing to recognise."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from splatam_core.config import DepthConfig
from splatam_core.datasets.registry import open_sequence
from splatam_core.geometry import se3
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.graph.places import Places
from splatam_core.images.view import View
from splatam_core.mapping.posed import PosedView
from splatam_core.rasterizer import Render
from splatam_core.tracking.features import features_of, pose_by_features

KEYFRAMES = range(0, 300, 30)


@pytest.fixture(scope='module')
def room() -> tuple[dict[int, View], np.ndarray]:
    """Some views of a walk through the room, and the true poses of all, relative to the first."""
    sequence = open_sequence('synthetic', width=160)
    truth = sequence.ground_truth().T_world_cam
    chosen = {*KEYFRAMES, *(index + 7 for index in KEYFRAMES)}
    views = {index: View.from_frame(sequence[index], DepthConfig()) for index in chosen}
    return views, se3.inverse(truth[0]) @ truth


@pytest.fixture(scope='module')
def places(room: tuple[dict[int, View], np.ndarray]) -> Places:
    views, truth = room
    places = Places()
    for index in KEYFRAMES:
        places.add(index, views[index], se3.inverse(truth[index]))
    return places


def test_views_between_the_keyframes_are_recognised(room: tuple[dict[int, View], np.ndarray], places: Places) -> None:
    """The guess needs to be good enough for alignment: a pixel is 0.3 degrees, so that 10 cm and 5 degrees are some 15 pixels."""
    views, truth = room
    right = 0
    for index in (key + 7 for key in KEYFRAMES):
        found = places.find(views[index], 3)
        assert [place.num_inliers for place in found] == sorted((place.num_inliers for place in found), reverse=True)
        for place in found:
            off = place.T_cam_world @ truth[index]
            right += np.linalg.norm(off[:3, 3]) < 0.1 and np.linalg.norm(se3.rotation_vector(off[:3, :3])) < 0.09
            break
    assert right >= 9


def test_a_place_says_how_the_camera_moved_from_its_keyframe(room: tuple[dict[int, View], np.ndarray], places: Places) -> None:
    views, truth = room
    for place in places.find(views[37], 3):
        assert np.allclose(place.T_cam_keyframe @ se3.inverse(truth[place.keyframe]), place.T_cam_world)


def test_the_same_view_is_found_the_same(room: tuple[dict[int, View], np.ndarray], places: Places) -> None:
    views, _ = room
    first, second = places.find(views[37], 3), places.find(views[37], 3)
    assert [place.keyframe for place in first] == [place.keyframe for place in second]
    assert all(np.array_equal(a.T_cam_world, b.T_cam_world) for a, b in zip(first, second, strict=True))


def test_excluded_keyframes_are_not_found(room: tuple[dict[int, View], np.ndarray], places: Places) -> None:
    views, _ = room
    assert places.find(views[30], 1)[0].keyframe == 30
    assert 30 not in {place.keyframe for place in places.find(views[30], 10, exclude={30})}
    assert places.find(views[30], 10, exclude=set(KEYFRAMES)) == []


@pytest.mark.parametrize('kind', ['dark', 'without depth', 'tiny'])
def test_views_with_nothing_to_recognise(room: tuple[dict[int, View], np.ndarray], kind: str) -> None:
    """Neither as a keyframe nor as a view."""
    views, truth = room
    view = views[30]
    odd = {
        'dark': View(view.camera, torch.zeros_like(view.rgb8), view.depth),
        'without depth': View(view.camera, view.rgb8, torch.zeros_like(view.depth)),
        'tiny': view.scaled(0.1),
    }[kind]
    places = Places()
    assert places.find(view, 3) == []
    places.add(0, odd, np.eye(4))
    assert places.find(view, 3) == []
    places.add(30, view, se3.inverse(truth[30]))
    assert places.find(odd, 3) == [] or kind == 'without depth'  # depth is needed on one side only


def test_places_follow_the_keyframes(room: tuple[dict[int, View], np.ndarray]) -> None:
    """Those that are added, dropped and moved."""
    views, truth = room
    posed = {index: PosedView.at(views[index], se3.inverse(truth[index]), index) for index in (0, 30, 60)}
    places = Places()
    places.follow(posed.values())
    assert list(places.poses()) == [0, 30, 60]
    moved = se3.exp(np.array([1.0, 0, 0, 0, 0, 0]))
    places.follow([posed[30], PosedView.at(views[60], moved, 60)])
    assert list(places.poses()) == [30, 60] and np.allclose(places.poses()[60], moved)
    assert np.allclose(places.find(views[60], 1)[0].T_cam_world, moved, atol=0.02)  # a few millimetres: pixels are rounded


@pytest.mark.parametrize('size', [(1, 1), (1, 160), (160, 1), (4000, 2), (2, 2), (8, 8), (30, 400)])
def test_images_too_small_for_a_feature_have_none(places: Places, size: tuple[int, int]) -> None:
    """OpenCV fails over those of a few pixels; a keyframe of a damaged file may have any size."""
    width, height = size
    rgb = torch.from_numpy(np.random.default_rng(0).integers(0, 255, (height, width, 3), np.uint8))
    view = View(PinholeCamera(width, height, 50.0, 50.0, width / 2, height / 2), rgb, torch.ones(height, width))
    assert places.find(view, 3) == []
    few = Places()
    few.add(0, view, np.eye(4))
    assert len(few) == 1 and len(few.arrays()['points']) == 0
    flat = torch.ones(height, width)
    render = Render(rgb.permute(2, 0, 1) / 255, flat, flat)
    assert pose_by_features(render, view.camera, features_of(view)) is None
