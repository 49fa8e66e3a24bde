"""Native calls: arrays of any values, sizes and layouts give a result, a TypeError or a ValueError, and no access out of bounds.

``make sanitize`` runs them under the address and undefined-behaviour sanitizers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from hypothesis import strategies as st

from kinds.base import Case, Kind, Tally
from splatam_core import _native
from splatam_core.tracking.aligner import Linearization

REFUSED = (TypeError, ValueError)  # as the bindings document; TooLargeError is a ValueError
ODD = np.float32([np.nan, np.inf, -np.inf, 0.0, -0.0, 1e38, -1e38, 1e-40, 88.8, -104.0, 3e9, 1e-7])
REPEATS = 4
MIXTURES = ('usual', 'usual', 'few odd', 'odd', 'wide', 'zero')


@dataclass(frozen=True)
class Call:
    """A native call in words.

    Attributes:
        mixture: of which values the arrays are.
        count: number of Gaussians.
        size: width and height of the images.
        seed: of what is random.
        wrong: number of the argument that is replaced by one of another type, shape or layout; None for none.
        how: what it is replaced by.
        scalars: replace numbers, in turn.
        threads: of the engine.
    """

    mixture: str
    count: int
    size: tuple[int, int]
    seed: int
    wrong: int | None
    how: int
    scalars: tuple[float, ...]
    threads: int


SIDE = st.one_of(st.integers(1, 20), st.sampled_from([1, 8, 9, 16, 17, 33]))
SIZE = st.one_of(st.tuples(SIDE, SIDE), st.tuples(SIDE, SIDE), st.sampled_from([(64, 48), (300, 2), (1, 500)]))
SCALAR = st.one_of(st.floats(0, 2, width=32), st.sampled_from([0.1, 1.0, 0.0, -1.0, 1e38, 1e-40, float('nan'), float('inf')]))
COUNT = st.one_of(st.integers(0, 40), st.integers(0, 40), st.sampled_from([0, 1, 255, 256, 257]))
CALLS = st.builds(
    Call, mixture=st.sampled_from(MIXTURES), count=COUNT, size=SIZE, seed=st.integers(0, 2**32),
    wrong=st.none() | st.none() | st.none() | st.integers(0, 20), how=st.integers(0, 9),
    scalars=st.lists(SCALAR, min_size=0, max_size=4).map(tuple), threads=st.sampled_from([1, 1, 1, 2]),
)  # fmt: skip


class Values:
    """Makes the arguments of one call."""

    def __init__(self, call: Call) -> None:
        self.call = call
        self.rng = np.random.default_rng(call.seed)
        self._scalars = list(call.scalars)

    def floats(self, *shape: int, low: float = 0.0, high: float = 1.0) -> np.ndarray:
        usual = self.rng.uniform(low, high, shape).astype(np.float32)
        if self.call.mixture == 'zero':
            return np.zeros(shape, np.float32)
        if self.call.mixture == 'usual':
            return usual
        if self.call.mixture == 'wide':
            sign = self.rng.choice([-1.0, 1.0], shape)
            return (sign * 10.0 ** self.rng.uniform(-42, 38, shape)).astype(np.float32)
        share = 0.02 if self.call.mixture == 'few odd' else 0.5
        return np.where(self.rng.random(shape) < share, self.rng.choice(ODD, shape), usual)

    def scalar(self, usual: float) -> float:
        return self._scalars.pop() if self._scalars and self.rng.random() < 0.5 else usual

    def pose(self) -> np.ndarray:
        if self.call.mixture == 'usual' or self.rng.random() < 0.5:
            return np.eye(4, dtype=np.float32) + self.rng.normal(size=(4, 4)).astype(np.float32) * np.float32(0.02)
        return self.floats(4, 4, low=-1.0)

    def camera(self) -> SimpleNamespace:
        width, height = self.call.size
        return SimpleNamespace(
            width=width, height=height, fx=self.scalar(0.8 * width), fy=self.scalar(0.9 * width), cx=self.scalar(width / 2),
            cy=self.scalar(height / 2),
        )  # fmt: skip

    def gaussians(self) -> dict[str, np.ndarray]:
        n = self.call.count
        means = self.floats(n, 3, low=-1.0)
        means[:, 2] = means[:, 2] * 2 + 2
        size = self.rng.choice([-4.0, -2.0, 0.0])
        return {
            'means': means, 'log_scales': self.floats(n, 1, low=size - 2, high=size), 'rgb': self.floats(n, 3),
            'logit_opacities': self.floats(n, low=-3, high=3),
        }  # fmt: skip

    def bounds(self) -> np.ndarray | None:
        return None if self.rng.random() < 0.5 else self.floats(-(-self.call.count // _native.BLOCK), 7, low=-3, high=3)

    def image(self, *channels: int, low: float = 0.0, high: float = 1.0) -> np.ndarray:
        return self.floats(*channels, self.call.size[1], self.call.size[0], low=low, high=high)

    def spoilt(self, arguments: dict[str, Any]) -> dict[str, Any]:
        """The arguments, one of which may be replaced."""
        if self.call.wrong is None:
            return arguments
        names = sorted(arguments)
        name = names[self.call.wrong % len(names)]
        return arguments | {name: wrong(arguments[name], self.call.how)}


def wrong(value: Any, how: int) -> Any:
    """Something else in the place of an argument: of another type, size, number of dimensions or layout."""
    if not isinstance(value, np.ndarray):
        return [None, 'text', [1.0], 10**400, -1, np.zeros(3), np.float64(0.5), 2**31, float('nan'), {}][how]
    frozen = value.copy()
    frozen.flags.writeable = False
    wider = np.zeros((*value.shape[:-1], value.shape[-1] + 1), value.dtype) if value.ndim else value
    return [
        None, value.astype(np.float64), value.astype('>f4'), np.asfortranarray(value), value[..., ::-1], frozen, wider,
        value[..., None], value[:-1], np.repeat(value, 2, axis=0)[::2],
    ][how]  # fmt: skip


def is_sound(values: Values) -> bool:
    """True if all numbers are usual ones, so that what is computed must be finite."""
    return values.call.mixture == 'usual' and not values.call.scalars and values.call.wrong is None


def forward(values: Values, tally: Tally) -> None:
    images = {'image': values.image(3), 'depth': values.image(), 'silhouette': values.image()}
    arguments = values.spoilt(
        values.gaussians() | images | {'bounds': values.bounds(), 'T_cam_world': values.pose(), 'camera': values.camera()}
    )
    tally.attempt(partial(_native.Engine(values.call.threads).forward, **arguments), *REFUSED)
    if is_sound(values):
        assert all(np.isfinite(image).all() for image in images.values())


def backward(values: Values, tally: Tally) -> None:
    engine = _native.Engine(values.call.threads)
    given = values.gaussians()
    drawn = [values.image(3), values.image(), values.image()]
    view = engine.forward(
        **given, bounds=values.bounds(), T_cam_world=values.pose(), camera=values.camera(), image=drawn[0], depth=drawn[1],
        silhouette=drawn[2],
    )  # fmt: skip
    if values.rng.random() < 0.2:  # what was not drawn
        drawn = [values.image(3), values.image(), values.image()]
        given = values.gaussians()
    gradients = {f'{name}_gradient': np.zeros_like(array) for name, array in given.items()}
    gradients = {name: None if values.rng.random() < 0.1 else array for name, array in gradients.items()}
    arguments = given | gradients | {'pose_gradient': values.floats(4, 4)}
    arguments |= {'images': drawn, 'image_gradients': [values.image(3, low=-1), values.image(low=-1), values.image(low=-1)]}
    tally.attempt(partial(engine.backward, view, **values.spoilt(arguments)), *REFUSED)


def fit(values: Values, tally: Tally) -> None:
    n, (width, height) = values.call.count, values.call.size
    given = values.gaussians()
    arguments = given | {
        'bounds': values.bounds(), 'moments': np.zeros((n, 16), np.float32) if values.rng.random() < 0.5 else values.floats(n, 16),
        'steps': values.rng.integers(0, 256, n).astype(np.uint8), 'rates': tuple(values.scalar(0.01) for _ in range(4)),
        'T_cam_world': values.pose(), 'camera': values.camera(), 'target_depth': values.image(high=4.0),
        'target_rgb': values.rng.integers(0, 256, (height, width, 3)).astype(np.uint8), 'color_weight': values.scalar(1.0),
        'depth_weight': values.scalar(1.0), 'color_limit': values.scalar(0.1), 'depth_limit': values.scalar(0.1),
        'enough': values.scalar(0.01),
    }  # fmt: skip
    loss = tally.attempt(partial(_native.Engine(values.call.threads).fit, **values.spoilt(arguments)), *REFUSED)
    if is_sound(values):
        assert np.isfinite(loss) and all(np.isfinite(array).all() for array in given.values())


def linearize(values: Values, tally: Tally) -> None:
    aligner = _native.Aligner(values.call.threads)
    brightness, depth = values.image(), values.image(high=4.0)
    layers = aligner.layers(values.image(), values.image(high=4.0), values.scalar(0.1))
    if values.rng.random() < 0.3:
        layers = values.floats(*layers.shape, low=-1)
    arguments = values.spoilt({
        'brightness': brightness, 'depth': depth, 'layers': layers, 'camera': values.camera(), 'color_motion': values.pose(),
        'depth_motion': values.pose(), 'velocity': values.floats(6, low=-1), 'gain': values.scalar(1.0), 'bias': values.scalar(0.0),
        'photometric_scale': values.scalar(0.1), 'depth_scale': values.scalar(0.1), 'max_depth_ratio': values.scalar(0.1),
        'readout': values.floats(6, low=-1),
    })  # fmt: skip
    inliers = {name: values.scalar(0.1) for name in ('inlier_color', 'inlier_depth')}
    system = tally.attempt(partial(aligner.linearize, Linearization(**arguments), **inliers), *REFUSED)
    if system is None:
        return
    assert 0 <= system.agreeing <= system.compared and 0 <= system.seen <= system.points <= brightness.size
    if is_sound(values):
        assert np.isfinite(system.H).all() and np.isfinite(system.g).all()


def weigh(values: Values, tally: Tally) -> None:
    width, height = values.call.size
    root = values.floats(9, 20, low=-1).astype(np.float64)
    sums = {
        'claimed': root @ root.T, 'shared': root @ root.T + values.floats(9, 9, low=-0.1).astype(np.float64),
        'scores': values.floats(9, 48, low=-1).astype(np.float64), 'cells': values.floats(9, 48, high=9).astype(np.float64),
    }  # fmt: skip
    arguments = values.spoilt(sums | {
        'velocity': values.floats(6, low=-1).astype(np.float64), 'prior': values.floats(9).astype(np.float64),
        'prior_inflation': values.scalar(1.0), 'step': int(values.rng.choice([1, 1, 2, 4, 0, -1, 2**31 - 1])),
        'is_free': values.rng.random(9) < 0.8, 'camera': values.camera(),
    })  # fmt: skip
    given = SimpleNamespace(**arguments)
    found = tally.attempt(partial(_native.Aligner(1).weigh, given, given), *REFUSED, np.linalg.LinAlgError)
    if found is not None:
        assert 0 <= found.num_open <= 6 and 0 <= found.explained <= 1 and 0 <= found.num_explained <= 48
    if found is not None and is_sound(values):
        assert np.isfinite(found.covariance).all()


def pyramid(values: Values, tally: Tally) -> None:
    aligner = _native.Aligner(values.call.threads)
    arguments = values.spoilt({
        'brightness': values.image(), 'depth': values.image(high=4.0), 'max_step': values.scalar(0.1)
    })  # fmt: skip
    halves = tally.attempt(partial(aligner.halve, **arguments), *REFUSED)
    if halves is not None:
        assert halves[0].shape == halves[1].shape == tuple(side // 2 for side in arguments['brightness'].shape)
    tally.attempt(partial(aligner.layers, **arguments), *REFUSED)


def levels(values: Values, tally: Tally) -> None:
    aligner = _native.Aligner(values.call.threads)
    drawn = {'rgb': values.image(3), 'depth_acc': values.image(high=4.0), 'silhouette': values.image()}
    limits = {'threshold': values.scalar(0.5), 'least': values.scalar(0.1)}
    tally.attempt(partial(aligner.render_images, **values.spoilt(drawn | limits)), *REFUSED)
    depth = values.image(high=4.0)
    depth[values.rng.random(depth.shape) < 0.5] = 0
    gap = int(values.rng.choice([0, 1, 3, 100, -1, 2**31 - 1, -(2**31)]))
    rgb8 = values.rng.integers(0, 256, (*depth.shape, 3), np.uint8)
    arguments = values.spoilt({'rgb8': rgb8, 'depth': depth, 'max_gap': gap, 'max_step': values.scalar(0.1)})
    images = tally.attempt(partial(aligner.frame_images, **arguments), *REFUSED)
    assert images is None or images[1].shape == arguments['depth'].shape
    if is_sound(values):
        assert np.isfinite(images[0]).all() and np.array_equal(images[1][depth > 0], depth[depth > 0])


def shapes(values: Values) -> np.ndarray:
    """[K, 6] of ellipses: u, v, conic and opacity."""
    width, height = values.call.size
    low, high = [-5, -5, 0.01, -0.01, 0.01, 0.0], [width + 5, height + 5, 1.0, 0.01, 1.0, 1.0]
    result = values.floats(values.call.count, 6)
    if values.call.mixture in ('usual', 'few odd'):
        result = np.float32(low) + result * (np.float32(high) - np.float32(low))
    return result


def blend(values: Values, tally: Tally) -> None:
    blender = _native.Blender(values.call.threads)
    given = {'shapes': shapes(values), 'features': values.floats(values.call.count, 4), 'image': values.image(5)}
    tally.attempt(partial(blender.forward, **values.spoilt(given)), *REFUSED)
    lists = blender.forward(**given)
    if is_sound(values):
        assert np.isfinite(given['image']).all()
    if values.rng.random() < 0.2:
        given = {'shapes': shapes(values), 'features': values.floats(values.call.count, 4), 'image': values.image(5)}
    arguments = given | {
        'image_gradient': values.image(5, low=-1), 'shapes_gradient': np.zeros_like(given['shapes']),
        'features_gradient': np.zeros_like(given['features']),
    }  # fmt: skip
    tally.attempt(partial(blender.backward, lists, **values.spoilt(arguments)), *REFUSED)


NATIVE_CALLS: dict[str, Callable[[Values, Tally], None]] = {
    'forward': forward, 'backward': backward, 'fit': fit, 'linearize': linearize, 'weigh': weigh, 'pyramid': pyramid,
    'levels': levels, 'blend': blend,
}  # fmt: skip


def check(use: Callable[[Values, Tally], None], tally: Tally, call: Call) -> None:
    with np.errstate(all='ignore'):
        for number in range(REPEATS):  # with other numbers: to draw a call takes longer than to make it
            use(Values(replace(call, seed=call.seed + number)), tally)
            tally.end_input()


def cases(folder: Path) -> list[Case]:
    return [Case(name, CALLS, partial(check, use)) for name, use in NATIVE_CALLS.items()]


KIND = Kind('native calls', 308_000, cases)
