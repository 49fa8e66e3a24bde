"""Odd frames into ``Slam``: a result or a ``FrameError``; poses and map stay finite, whatever the pixels hold."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st

from kinds.base import Case, Kind, Tally
from splatam_core.config import SlamConfig, load_config
from splatam_core.errors import CameraError, FrameError
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.slam import Slam
from splatam_core.types import RgbdFrame, Status

FEW = ['threads=1', 'mapping.iterations=2', 'mapping.first_iterations=0', 'tracking.iterations=2', 'keyframes.budget=4']
SETTINGS = {
    'quick': ('quick', []),
    'realtime': ('realtime', []),
    'realtime, every frame': ('realtime', ['densification.every=1', 'densification.scale=1.0', 'mapping.fused.final_passes=1']),
    'splatam': ('splatam', []),
    'splatam_s': ('splatam_s', []),
    'anisotropic': ('quick', ['mapping.anisotropic=true']),
    'without tracking': ('realtime', ['tracking.method=none']),
    'edges': ('realtime', ['depth.edge_filter=0.1', 'depth.min_m=0', 'densification.opacity=0.99']),
}
COLORS = ('noise', 'wall', 'black', 'white', 'squares')
DEPTHS = ('flat', 'slanted', 'noise', 'steps', 'none', 'one', 'row', 'near', 'far', 'mixed', 'wide', 'odd', 'grid')


@dataclass(frozen=True)
class Shot:
    """One frame in words.

    Attributes:
        color, depth: patterns.
        distance_m: of the depth.
        shift: of both, in pixels.
        after_ns: time since the frame before.
        seed: of what is random.
        damage: what else is wrong; empty for nothing.
    """

    color: str
    depth: str
    distance_m: float
    shift: int
    after_ns: int
    seed: int
    damage: str = ''


@dataclass(frozen=True)
class Sequence:
    """A camera, the settings, and frames."""

    settings: str
    size: tuple[int, int]
    intrinsics: tuple[float, float, float, float]
    shots: tuple[Shot, ...]


@cache
def config(name: str) -> SlamConfig:
    preset, changes = SETTINGS[name]
    return load_config(preset, [*FEW, *changes])


def color_of(shot: Shot, width: int, height: int) -> np.ndarray:
    v, u = np.mgrid[:height, :width]
    u = u + shot.shift
    if shot.color == 'noise':
        return np.random.default_rng(shot.seed).integers(0, 256, (height, width, 3), np.uint8)
    if shot.color == 'wall':
        return np.stack([u * 9 % 256, v * 13 % 256, (u * v) % 256], axis=-1).astype(np.uint8)
    if shot.color == 'squares':
        return np.repeat(((u // 4 + v // 4) % 2 * 255).astype(np.uint8)[..., None], 3, axis=-1)
    return np.full((height, width, 3), 0 if shot.color == 'black' else 255, np.uint8)


def depth_of(shot: Shot, width: int, height: int) -> np.ndarray:
    rng = np.random.default_rng(shot.seed)
    v, u = np.mgrid[:height, :width].astype(np.float32)
    flat = np.full((height, width), shot.distance_m, np.float32)
    chosen = rng.random((height, width))
    patterns = {
        'flat': lambda: flat,
        'slanted': lambda: flat + 0.05 * (u + shot.shift),
        'noise': lambda: flat * (1 + rng.normal(size=flat.shape) * 0.3),
        'steps': lambda: flat + 3.0 * ((u + shot.shift) // 5 % 2),
        'none': lambda: 0 * flat,
        'one': lambda: flat * (np.arange(flat.size) == shot.seed % flat.size).reshape(flat.shape),
        'row': lambda: flat * (v == shot.seed % height),
        'near': lambda: np.full_like(flat, 0.2000001),
        'far': lambda: np.full_like(flat, 99.9),
        'mixed': lambda: np.where(chosen < 0.5, 0.21, 99.0),
        'wide': lambda: np.float32(10.0) ** rng.uniform(-30, 30, flat.shape),
        'odd': lambda: np.choose((chosen * 6).astype(int), [flat, -flat, flat * np.nan, flat + np.inf, flat * 1e-40, flat * 1e35]),
        'grid': lambda: flat * (u % 3 == 0) * (v % 2 == 0),
    }
    with np.errstate(all='ignore'):
        return np.ascontiguousarray(patterns[shot.depth](), np.float32)


def frame_of(shot: Shot, stamp_ns: int, camera: PinholeCamera) -> RgbdFrame:
    with np.errstate(over='ignore'):
        frame = RgbdFrame(
            stamp_ns, color_of(shot, camera.width, camera.height), depth_of(shot, camera.width, camera.height), camera
        )
    if not shot.damage:
        return frame
    changes: dict[str, Any] = {
        'small colour': {'rgb': frame.rgb[:-1]}, 'small depth': {'depth_m': frame.depth_m[:, :-1]},
        'grey': {'rgb': frame.rgb[..., 0]}, 'four channels': {'rgb': np.dstack([frame.rgb, frame.rgb[..., 0]])},
        'float colour': {'rgb': frame.rgb.astype(np.float32)}, 'double depth': {'depth_m': frame.depth_m.astype(np.float64)},
        'integer depth': {'depth_m': np.zeros(frame.depth_m.shape, np.uint16)}, 'empty': {'depth_m': frame.depth_m[:0]},
        'strided': {'rgb': frame.rgb[:, ::-1], 'depth_m': np.asfortranarray(frame.depth_m)},
        'swapped bytes': {'depth_m': frame.depth_m.astype('>f4')}, 'read-only': {},
        'another camera': {'camera': replace(camera, fx=camera.fx * 1.001)},
    }  # fmt: skip
    changed = replace(frame, **changes[shot.damage])
    if shot.damage == 'read-only':
        changed.rgb.flags.writeable = changed.depth_m.flags.writeable = False
    return changed


DAMAGES = (
    'small colour', 'small depth', 'grey', 'four channels', 'float colour', 'double depth', 'integer depth', 'empty', 'strided',
    'swapped bytes', 'read-only', 'another camera',
)  # fmt: skip
SIDE = st.one_of(st.integers(8, 48), st.integers(12, 24), st.integers(1, 20))


@st.composite
def shots(draw: st.DrawFn, is_still: bool) -> Shot:
    usual = bool(draw(st.integers(0, 2)))
    return Shot(
        color='wall' if is_still else draw(st.sampled_from(COLORS)),
        depth=draw(st.sampled_from(['flat', 'slanted', 'steps', 'grid'] if usual else DEPTHS)),
        distance_m=2.0 if usual else draw(st.sampled_from([0.19, 0.21, 1.0, 25.0, 99.0, 150.0])),
        shift=draw(st.integers(-3, 3)),
        after_ns=33_000_000 if usual else draw(st.sampled_from([1, 10**9, 10**15, 2**60, 0, -5, -(2**62)])),
        seed=draw(st.integers(0, 2**32)),
        damage='' if draw(st.integers(0, 15)) else draw(st.sampled_from(DAMAGES)),
    )


@st.composite
def sequences(draw: st.DrawFn) -> Sequence:
    width, height = draw(SIDE), draw(SIDE)
    usual = (0.9 * width, 0.9 * width, (width - 1) / 2, (height - 1) / 2)
    focal = st.one_of(st.floats(0.01, 1e6), st.sampled_from([0.01, 1e6]))
    centre = st.one_of(st.floats(-1e6, 1e6), st.floats(-100, 100))
    intrinsics = usual if draw(st.integers(0, 3)) else (draw(focal), draw(focal), draw(centre), draw(centre))
    is_still = draw(st.booleans())
    frames = draw(st.lists(shots(is_still), min_size=2, max_size=10))
    return Sequence(draw(st.sampled_from(sorted(SETTINGS))), (width, height), intrinsics, tuple(frames))


def check(tally: Tally, sequence: Sequence) -> None:
    with np.errstate(all='ignore'):  # some pixels are odd
        check_sequence(tally, sequence)


def check_sequence(tally: Tally, sequence: Sequence) -> None:
    slam, stamp_ns = Slam(config(sequence.settings)), 0
    camera = PinholeCamera(*sequence.size, *sequence.intrinsics)
    for shot in sequence.shots:
        stamp_ns += shot.after_ns
        tally.attempt(partial(check_frame, slam, shot, stamp_ns, camera), FrameError, CameraError)
        tally.end_input()
    if slam.num_gaussians:
        slam.finish(limit_s=1.0)
        assert bool(slam.map.gaussians.usable().all()), 'after the last passes the map is not finite'
        view = slam.render(np.eye(4))
        assert np.isfinite(view.depth_m).all() and np.isfinite(view.silhouette).all()


def check_frame(slam: Slam, shot: Shot, stamp_ns: int, camera: PinholeCamera) -> None:
    result = slam.process(frame_of(shot, stamp_ns, camera))
    assert (result.T_world_cam is None) == (result.status is Status.LOST)
    if result.T_world_cam is not None:
        T = result.T_world_cam
        assert np.isfinite(T).all(), 'the pose is not finite'
        assert np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() < 1e-5, 'the pose is no rigid motion'  # float32 inside
    assert 0.0 <= result.visible_fraction <= 1.0 and 0.0 <= result.inlier_fraction <= 1.0
    assert bool(slam.map.gaussians.usable().all()), 'the map is not finite'
    assert '\n' not in result.reason


FAR_FROM_THE_CENTRE = Sequence(  # rounding left a normal matrix that was not positive definite
    'edges', (15, 8), (1.5, 1.5, 612458.8811934837, 612458.8811934837),
    (
        Shot('noise', 'steps', 2.0, -2, 33_000_000, 209), Shot('noise', 'slanted', 2.0, -3, 33_000_000, 11624),
        Shot('noise', 'steps', 2.0, 3, 33_000_000, 2**32), Shot('white', 'steps', 2.0, 2, 33_000_000, 431),
        Shot('wall', 'far', 150.0, 0, -(2**62), 110727670), Shot('noise', 'steps', 2.0, -2, 33_000_000, 209),
        Shot('black', 'grid', 2.0, 3, 33_000_000, 1), Shot('noise', 'far', 0.21, 3, -(2**62), 41910),
        Shot('white', 'grid', 2.0, -2, 33_000_000, 524289), Shot('squares', 'grid', 2.0, -1, 33_000_000, 431),
    ),
)  # fmt: skip


def cases(folder: Path) -> list[Case]:
    still = Shot('wall', 'flat', 2.0, 0, 33_000_000, 0)
    for name in SETTINGS:  # what torch loads late is then there for every child of the fuzzer
        check(Tally(), Sequence(name, (16, 12), (14.0, 14.0, 7.5, 5.5), (still, still)))
    return [Case('frames', sequences(), check, short=50, examples=(FAR_FROM_THE_CENTRE,))]


KIND = Kind('odd frames', 173_000, cases)
