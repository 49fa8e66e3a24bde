"""The synthetic room: repeatable, exact, and with the documented noise."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
import pytest

from splatam_core.config import load_config
from splatam_core.datasets.registry import open_sequence
from splatam_core.datasets.room import ROOM_SIZE_M, look_at
from splatam_core.datasets.synthetic import CAMERA, MOTIONS, SyntheticSequence, measured
from splatam_core.errors import DatasetError
from splatam_core.geometry import se3
from splatam_core.geometry.camera import PinholeCamera

WIDTH = 160


def warped(frame_a, frame_b, T_a, T_b):
    """Frame b's pixels where frame a's points fall into it: colours, depths, and the depth they should have."""
    camera = frame_a.camera
    y, x = np.mgrid[: camera.height, : camera.width]
    rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], -1)
    points = rays * frame_a.depth_m[..., None]
    T = se3.inverse(T_b) @ T_a
    points = points @ T[:3, :3].T + T[:3, 3]
    u = (points[..., 0] / points[..., 2] * camera.fx + camera.cx).astype(np.float32)
    v = (points[..., 1] / points[..., 2] * camera.fy + camera.cy).astype(np.float32)
    colors = cv2.remap(frame_b.rgb, u, v, cv2.INTER_LINEAR)
    depths = cv2.remap(frame_b.depth_m, u, v, cv2.INTER_LINEAR)
    inside = (u > 1) & (u < camera.width - 2) & (v > 1) & (v < camera.height - 2)
    return colors, depths, points[..., 2], inside


@pytest.mark.parametrize('seed', [0, 1])
def test_frames_agree_under_their_true_poses(room, seed):
    """Poses, intrinsics, pixel convention, depth and colour agree with each other."""
    sequence = room(frames=16, width=WIDTH, noise=False, seed=seed)
    truth = sequence.ground_truth().T_world_cam
    a, b = sequence[0], sequence[15]
    colors, depths, expected, inside = warped(a, b, truth[0], truth[15])
    error = np.abs(depths - expected)[inside]
    # depth is exact where both see the same surface; linear look-up of a plane's depth errs by far less than 2 mm
    # at half a pixel, and the rest (edges, what one of them cannot see) is some per cent of the pixels
    assert inside.mean() > 0.5
    assert np.median(error) < 5e-4
    assert (error < 2e-3).mean() > 0.9
    seen = inside & (np.abs(depths - expected) < 2e-3)
    difference = np.abs(colors.astype(float) - a.rgb).mean(-1)[seen]
    shifted = np.abs(np.roll(colors, 1, axis=1).astype(float) - a.rgb).mean(-1)[seen]
    # paint finer than a pixel is averaged differently by each view: some grey levels; but one pixel off is twice as bad
    assert np.median(difference) < 6
    assert 1.7 * difference.mean() < shifted.mean()


def test_depth_at_known_walls(room):
    """A wall seen head on from a known position has the right distance."""
    sequence = room()
    eye = np.array([0.5, 0.0, 2.2])  # above the furniture
    camera = PinholeCamera(33, 25, 60.0, 60.0, 16.0, 12.0)
    x, y, _ = ROOM_SIZE_M
    for direction, distance in (((-1, 0, 0), x / 2 + 0.5), ((1, 0, 0), x / 2 - 0.5), ((0, 1, 0), y / 2)):
        cast = sequence._room.cast(camera, look_at(eye, eye + direction, 0.0))
        assert cast.depth_m[12, 16] == pytest.approx(distance, abs=5e-3)  # pictures hang 4 mm in front of the wall


def test_every_ray_meets_something_wherever_the_camera_is(room):
    """Close to furniture, surfaces reach behind the camera. None may be lost there, or the room would have holes."""
    sequence, rng = room(), np.random.default_rng(0)
    camera = PinholeCamera(64, 48, 50.0, 50.0, 31.5, 23.5)
    for _ in range(40):
        eye = rng.uniform([-1.4, -1.4, 1.2], [1.4, 0.9, 2.4])
        T_world_cam = look_at(eye, rng.uniform([-2, -2, 0], [2, 2, 2.5]), rng.normal())
        assert sequence._room.cast(camera, T_world_cam).depth_m.max() < np.linalg.norm(ROOM_SIZE_M)


def test_frame_depends_on_nothing_but_seed_index_and_width(room):
    long, short = room(frames=40, width=48), room(frames=8, width=48)
    later, first = long[7], short[2]
    again = SyntheticSequence(seed=0, frames=8, width=48)
    for frame, index in ((later, 7), (first, 2)):
        assert np.array_equal(again[index].rgb, frame.rgb)
        assert np.array_equal(again[index].depth_m, frame.depth_m)
        assert again[index].stamp_ns == frame.stamp_ns
    assert np.array_equal(long.ground_truth().T_world_cam[:8], short.ground_truth().T_world_cam)


def test_seeds_differ(room):
    a, b = room(width=48)[0], room(width=48, seed=1)[0]
    assert not np.array_equal(a.rgb, b.rgb)
    assert not np.array_equal(a.depth_m, b.depth_m)


def test_stamps_and_truth(room):
    sequence = room(frames=31, width=32)
    assert sequence[0].stamp_ns == 1_000_000_000
    assert sequence[30].stamp_ns == 2_000_000_000
    assert sequence.ground_truth().stamps_ns.tolist() == [sequence[i].stamp_ns for i in range(31)]


def test_walk_is_smooth_stays_inside_and_comes_back():
    truth = SyntheticSequence(frames=700, width=32).ground_truth().T_world_cam
    steps = np.array([se3.log(se3.inverse(a) @ b) for a, b in pairwise(truth)])
    assert np.linalg.norm(steps[:, :3], axis=1).max() * 30 < 0.5  # metres per second: a calm hand
    assert np.degrees(np.linalg.norm(steps[:, 3:], axis=1)).max() * 30 < 30  # degrees per second
    assert np.abs(np.diff(steps, axis=0)).max() < 2e-3  # metres or radians from one step to the next: no jerks
    assert np.all(np.abs(truth[:, :3, 3]) < np.array([0.8, 0.8, 1.6]))  # away from walls and furniture
    back = se3.log(se3.inverse(truth[0]) @ truth[300])
    assert np.linalg.norm(back[:3]) < 0.03  # the hand's tremor is a few millimetres either way
    yaws = np.arctan2(truth[:, 0, 2], truth[:, 1, 2])
    assert np.degrees(np.ptp(yaws)) > 60  # it looks around


@pytest.mark.slow
def test_fast_walk_needs_prediction_and_shows_new_ground():
    """The motion is beyond the paper's tracking steps from the last pose, but well within them from a predicted pose."""
    config = load_config('splatam').tracking
    reach = 2 * config.iterations * config.paper.rotation_rate  # radians: Adam moves each half-angle by its rate a step
    walks = [SyntheticSequence(frames=240, width=32, motion=motion, seed=seed) for seed in (0, 1, 2) for motion in MOTIONS]
    for sequence in walks:
        truth = sequence.ground_truth().T_world_cam
        steps = np.array([se3.log(se3.inverse(a) @ b) for a, b in pairwise(truth)])
        turned, surprise = np.linalg.norm(steps[:, 3:], axis=1), np.linalg.norm(np.diff(steps[:, 3:], axis=0), axis=1)
        assert ((turned > reach).mean() > 0.6) == (sequence._walk.motion == 'fast')
        assert turned[0] < reach  # the first step is nobody's to predict
        assert surprise.max() < 0.3 * reach
        assert np.linalg.norm(np.diff(steps[:, :3], axis=0), axis=1).max() < 0.3 * config.iterations * config.paper.translation_rate
        assert np.all(np.abs(truth[:, :3, 3]) < np.array([0.8, 0.8, 1.6]))
    back = se3.log(se3.inverse(truth[0]) @ truth[120])
    assert np.linalg.norm(back[:3]) < 0.03
    assert truth[:, :3, 2].max() > 0.9 and truth[:, :2, 2].min() < -0.9  # it looks everywhere


@pytest.mark.parametrize('width', [320, 100])
def test_width_renders_the_resized_camera(room, width):
    sequence = room(frames=1, width=width)
    height = round(480 * width / 640)
    assert sequence.camera == CAMERA.resized(width, height)
    assert sequence[0].rgb.shape == (height, width, 3)


def test_small_frame_is_the_large_one_resized(room):
    """Pixels see the same directions at every size; a shift of half a pixel would fail."""
    small, large = room(frames=1, width=160, noise=False)[0], room(frames=1, width=320, noise=False)[0]
    averaged = cv2.resize(large.rgb, (160, 120), interpolation=cv2.INTER_AREA)
    difference = np.abs(averaged.astype(float) - small.rgb)
    moved = np.abs(cv2.resize(np.roll(large.rgb, 1, axis=1), (160, 120), interpolation=cv2.INTER_AREA) - small.rgb.astype(float))
    assert difference.mean() < 4  # grey levels: 16 rays to a pixel against 4
    assert moved.mean() > 1.5 * difference.mean()  # half a small pixel to the side is clearly worse


def test_noise_grows_with_the_square_of_depth_and_is_in_millimetres():
    rng = np.random.default_rng(0)
    incidence = np.ones((200, 200), np.float32)
    for depth in (1.0, 2.0, 4.0):
        noisy = measured(np.full((200, 200), depth, np.float32), incidence, rng)
        assert np.array_equal(noisy, np.rint(noisy * 1000).astype(np.float32) / np.float32(1000))
        # 40000 samples know the deviation to 0.4 %; rounding to millimetres adds 2 % at 1 m
        assert noisy.std() == pytest.approx(1.425e-3 * depth**2, rel=0.04)
        assert noisy.mean() == pytest.approx(depth, abs=2e-4)


def test_noise_drops_edges_grazing_and_out_of_range():
    incidence = np.ones((100, 100), np.float32)
    flat = np.full((100, 100), 2.0, np.float32)
    step = flat.copy()
    step[:, 50:] = 3.0
    lost = measured(step, incidence, np.random.default_rng(0)) == 0
    assert 0.5 < lost[:, 49:51].mean() < 0.9  # seven in ten, of 200 pixels
    assert not lost[:, :49].any()
    assert not lost[:, 51:].any()
    assert (measured(flat, 0.08 * incidence, np.random.default_rng(0)) == 0).all()
    for depth in (0.39, 5.01):
        assert (measured(np.full_like(flat, depth), incidence, np.random.default_rng(0)) == 0).all()


def test_noise_off_is_exact_and_complete(room):
    frame = room(noise=False)[0]
    assert (frame.depth_m > 0.4).all()
    assert np.isfinite(frame.depth_m).all()
    assert room(noise=False).depth_scale is None
    assert room(noise=True).depth_scale == 1000


def test_picture_has_detail_to_hold(room):
    """Textures have detail at every scale: they are neither flat nor only fine-grained."""
    gray = cv2.cvtColor(room(frames=1, width=320)[0].rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    for size in (1, 2, 4, 8):
        scaled = cv2.resize(gray, None, fx=1 / size, fy=1 / size, interpolation=cv2.INTER_AREA)
        assert np.abs(cv2.Laplacian(scaled, cv2.CV_32F)).mean() > 5  # grey levels of 255


@pytest.mark.parametrize(
    ('source', 'message'),
    [
        ('synthetic:sed=3', "unknown option 'sed'; use seed=N, noise=on|off, frames=N, motion=calm|fast"),
        ('synthetic:motion=slow', "motion='slow' must be calm or fast"),
        ('synthetic:seed=-1', "seed='-1' must be a whole number, at least 0"),
        ('synthetic:seed=x', "seed='x'"),
        ('synthetic:frames=0', "frames='0' must be a whole number, at least 1"),
        ('synthetic:noise=maybe', "noise='maybe' must be on or off"),
    ],
)
def test_bad_options(source, message):
    with pytest.raises(DatasetError) as caught:
        open_sequence(source)
    assert message in str(caught.value)


def test_options_and_length():
    assert len(open_sequence('synthetic', width=32)) == 300
    assert len(open_sequence('synthetic', width=32, start=500, max_frames=20)) == 20
    exact = open_sequence('synthetic:noise=off,frames=4,seed=1', width=32)
    assert (len(exact), exact.depth_scale, exact.name) == (4, None, 'synthetic_1')
