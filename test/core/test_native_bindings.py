"""The native code takes arrays of exactly the stated type, shape and layout; what is too large, or throws, is an error."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from splatam_core import _native
from splatam_core.errors import RasterizerError
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.rasterizer import Gaussians, Moments, Rates, Target, make_rasterizer
from splatam_core.tracking.aligner import Linearization

N, WIDTH, HEIGHT = 5, 16, 8
CAMERA = PinholeCamera(WIDTH, HEIGHT, 14.0, 14.0, 7.5, 3.5)
POSE = np.eye(4, dtype=np.float32)


def floats(*shape: int) -> np.ndarray:
    return np.ones(shape, np.float32)


def gaussians() -> dict[str, np.ndarray]:
    means = floats(N, 3) * np.float32([0, 0, 2])
    return {'means': means, 'log_scales': -floats(N, 1), 'logit_opacities': floats(N), 'rgb': floats(N, 3)}


def images() -> dict[str, np.ndarray]:
    return {'image': floats(3, HEIGHT, WIDTH), 'depth': floats(HEIGHT, WIDTH), 'silhouette': floats(HEIGHT, WIDTH)}


def forward(**changed: object) -> None:
    arguments = gaussians() | {'bounds': None, 'T_cam_world': POSE, 'camera': CAMERA} | images()
    _native.Engine(1).forward(**(arguments | changed))


def backward(**changed: object) -> None:
    engine, drawn = _native.Engine(1), list(images().values())
    view = engine.forward(**gaussians(), bounds=None, T_cam_world=POSE, camera=CAMERA, **images())
    arguments = gaussians() | {'image_gradients': drawn, 'pose_gradient': floats(4, 4)}
    arguments |= {f'{name}_gradient': np.zeros_like(values) for name, values in gaussians().items()}
    for name, value in changed.items():
        kind, _, index = name.partition('_at_')
        if index:
            arguments[kind] = [value if number == int(index) else image for number, image in enumerate(drawn)]
        else:
            arguments[kind] = value
    engine.backward(view, **arguments)


def fit(**changed: object) -> None:
    arguments = gaussians() | {
        'bounds': floats(1, 7), 'moments': floats(N, 16), 'steps': np.zeros(N, np.uint8), 'rates': (0.1, 0.1, 0.1, 0.1),
        'T_cam_world': POSE, 'camera': CAMERA, 'target_rgb': np.zeros((HEIGHT, WIDTH, 3), np.uint8),
        'target_depth': floats(HEIGHT, WIDTH), 'color_weight': 1.0, 'depth_weight': 1.0, 'color_limit': 0.1, 'depth_limit': 0.1,
        'enough': 0.0,
    }  # fmt: skip
    _native.Engine(1).fit(**(arguments | changed))


def linearization(**changed: object) -> Linearization:
    arguments = {
        'brightness': floats(HEIGHT, WIDTH), 'depth': floats(HEIGHT, WIDTH), 'layers': floats(HEIGHT, WIDTH, 8), 'camera': CAMERA,
        'color_motion': POSE, 'depth_motion': POSE, 'velocity': floats(6), 'gain': 1.0, 'bias': 0.0, 'photometric_scale': 0.1,
        'depth_scale': 0.1, 'max_depth_ratio': 0.1, 'readout': floats(6),
    }  # fmt: skip
    return Linearization(**(arguments | changed))


def linearize(**changed: object) -> None:
    _native.Aligner(1).linearize(linearization(**changed), inlier_color=0.1, inlier_depth=0.1)


def descend(**changed: object) -> None:
    task = {
        'camera': CAMERA, 'brightness': floats(HEIGHT, WIDTH), 'depth': floats(HEIGHT, WIDTH), 'layers': floats(HEIGHT, WIDTH, 8),
        'max_depth_ratio': 0.1, 'predicted_motion': np.eye(4), 'mean': np.zeros(10), 'information': np.ones(10),
        'is_free': np.ones(10, bool), 'scale_factors': np.ones(2), 'iterations': 2, 'small_step': 1e-4,
    }  # fmt: skip
    pace = {'num_frames': 1, 'expected': np.zeros(6), 'limit_m': np.inf, 'limit_rad': np.inf}
    start = {
        'depth_motion': np.eye(4), 'gain': 1.0, 'bias': 0.0, 'time_offset': 0.0, 'velocity': np.zeros(6), 'readout': 0.0,
        'scales': np.ones(2),
    }  # fmt: skip
    for name, value in changed.items():
        next(given for given in (task, pace, start) if name in given)[name] = value
    _native.Aligner(1).descend(SimpleNamespace(pace=SimpleNamespace(**pace), **task), SimpleNamespace(**start))


def evidence(**changed: object) -> None:
    _native.Aligner(1).evidence(linearization(**changed), max_depth_error=0.1, step=2)


def weigh(**changed: object) -> _native.PoseWeight:
    sums = {'claimed': np.eye(9), 'shared': np.eye(9), 'scores': np.ones((9, 48)), 'cells': np.ones((9, 48))}
    known = {
        'camera': CAMERA, 'step': 1, 'velocity': np.zeros(6), 'prior': np.ones(9), 'prior_inflation': 1.0,
        'is_free': np.ones(9, bool),
    }  # fmt: skip
    for name, value in changed.items():
        (sums if name in sums else known)[name] = value
    return _native.Aligner(1).weigh(SimpleNamespace(**sums), SimpleNamespace(**known))


def halve(**changed: object) -> None:
    arguments = {'brightness': floats(HEIGHT, WIDTH), 'depth': floats(HEIGHT, WIDTH), 'max_step': 0.1}
    _native.Aligner(1).halve(**(arguments | changed))
    _native.Aligner(1).layers(**(arguments | changed))


def frame_images(**changed: object) -> None:
    arguments = {'rgb8': np.zeros((HEIGHT, WIDTH, 3), np.uint8), 'depth': floats(HEIGHT, WIDTH), 'max_gap': 2, 'max_step': 0.1}
    _native.Aligner(1).frame_images(**(arguments | changed))


def render_images(**changed: object) -> None:
    planes = {'rgb': floats(3, HEIGHT, WIDTH), 'depth_acc': floats(HEIGHT, WIDTH), 'silhouette': floats(HEIGHT, WIDTH)}
    _native.Aligner(1).render_images(**(planes | {'threshold': 0.5, 'least': 0.1} | changed))


def blend(**changed: object) -> None:
    arguments = {'shapes': floats(N, 6), 'features': floats(N, 4), 'image': floats(5, HEIGHT, WIDTH)}
    _native.Blender(1).forward(**(arguments | changed))


def blend_back(**changed: object) -> None:
    blender = _native.Blender(1)
    lists = blender.forward(floats(N, 6), floats(N, 4), floats(5, HEIGHT, WIDTH))
    arguments = {
        'shapes': floats(N, 6), 'features': floats(N, 4), 'image': floats(5, HEIGHT, WIDTH),
        'image_gradient': floats(5, HEIGHT, WIDTH), 'shapes_gradient': floats(N, 6), 'features_gradient': floats(N, 4),
    }  # fmt: skip
    blender.backward(lists, **(arguments | changed))


IMAGE, PLANE = (3, HEIGHT, WIDTH), (HEIGHT, WIDTH)
GAUSSIANS = {'means': (N, 3), 'log_scales': (N, 1), 'logit_opacities': (N,), 'rgb': (N, 3)}
CALLS = {
    forward: GAUSSIANS | {'bounds': (1, 7), 'image': IMAGE, 'depth': PLANE, 'silhouette': PLANE},
    backward: GAUSSIANS
    | {f'{name}_gradient': shape for name, shape in GAUSSIANS.items()}
    | {'pose_gradient': (4, 4), 'image_gradients_at_0': IMAGE, 'image_gradients_at_2': PLANE},
    fit: GAUSSIANS | {'bounds': (1, 7), 'moments': (N, 16), 'target_depth': PLANE},
    linearize: {'brightness': PLANE, 'depth': PLANE, 'layers': (HEIGHT, WIDTH, 8), 'velocity': (6,), 'readout': (6,)},
    descend: {'brightness': PLANE, 'depth': PLANE, 'layers': (HEIGHT, WIDTH, 8)},
    evidence: {'brightness': PLANE, 'depth': PLANE, 'layers': (HEIGHT, WIDTH, 8), 'velocity': (6,), 'readout': (6,)},
    halve: {'brightness': PLANE, 'depth': PLANE},
    frame_images: {'depth': PLANE},
    render_images: {'rgb': IMAGE, 'depth_acc': PLANE, 'silhouette': PLANE},
    blend: {'shapes': (N, 6), 'features': (N, 4), 'image': (5, HEIGHT, WIDTH)},
    blend_back: {
        'shapes': (N, 6), 'features': (N, 4), 'image': (5, HEIGHT, WIDTH), 'image_gradient': (5, HEIGHT, WIDTH),
        'shapes_gradient': (N, 6), 'features_gradient': (N, 4),
    },
}  # fmt: skip
CASES = [(call, name, shape) for call, shapes in CALLS.items() for name, shape in shapes.items()]


def wrong(shape: tuple[int, ...]) -> list[object]:
    """Arrays of another type, size, number of dimensions or layout, and what is no array."""
    many = floats(*(2 * size for size in shape))
    strided = many[tuple(slice(None, None, 2) for _ in shape)]
    values = [
        floats(*shape).astype(np.float64), floats(*shape).astype(np.int16), floats(*shape).astype('>f4'), strided,
        floats(*shape[:-1], shape[-1] + 1), floats(*shape, 1), floats(shape[0] - 1, *shape[1:]), floats(0), [1.0], 'text', 3,
    ]  # fmt: skip
    if len(shape) > 1 and min(shape) > 1:
        values.append(np.asfortranarray(floats(*shape)))
    return values


@pytest.mark.parametrize(('call', 'name', 'shape'), CASES, ids=lambda value: getattr(value, '__name__', str(value)))
def test_every_array_is_checked_by_name(call: object, name: str, shape: tuple[int, ...]) -> None:
    call(**{name: floats(*shape)})
    for value in wrong(shape):
        if call is blend and name == 'image' and np.shape(value) == (5, HEIGHT, WIDTH + 1) and value.dtype == np.float32:
            continue  # an image may have any size
        with pytest.raises((TypeError, ValueError)) as caught:
            call(**{name: value})
        text = str(caught.value)
        assert 'expected' in text or 'incompatible function arguments' in text
    sized = {'means', 'depth', 'depth_acc', 'target_depth', 'brightness', 'shapes'}  # others are compared with these
    if name not in sized and call is not blend:
        with pytest.raises(TypeError, match=name.partition('_at_')[0]):
            call(**{name: floats(*shape[:-1], shape[-1] + 1)})


@pytest.mark.parametrize(
    ('call', 'name'),
    [(forward, 'image'), (forward, 'depth'), (fit, 'means'), (fit, 'moments'), (fit, 'bounds'), (backward, 'pose_gradient'),
     (blend, 'image'), (blend_back, 'shapes_gradient')],
)  # fmt: skip
def test_what_is_written_must_be_writeable(call: object, name: str) -> None:
    array = floats(*CALLS[call][name])
    array.flags.writeable = False
    with pytest.raises(TypeError, match=f'{name} is .* writeable'):
        call(**{name: array})


@pytest.mark.parametrize('pose', [np.eye(3, dtype=np.float32), np.eye(4), floats(5, 4), np.zeros((0, 0), np.float32), None])
@pytest.mark.parametrize('call', [forward, fit])
def test_poses_are_checked(call: object, pose: object) -> None:
    with pytest.raises(TypeError, match='T_cam_world'):
        call(T_cam_world=pose)
    call(T_cam_world=np.asfortranarray(POSE))  # the only array that may have any strides


@pytest.mark.parametrize('call', [linearize, evidence])
def test_what_is_no_linearization_is_refused(call: Callable[..., None], monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (('gain', 'text'), ('depth_scale', None), ('camera', 3), ('color_motion', np.eye(4))):
        with pytest.raises(TypeError, match=name):
            call(**{name: value})
    monkeypatch.setitem(globals(), 'linearization', lambda: SimpleNamespace(brightness=floats(HEIGHT, WIDTH)))
    with pytest.raises(TypeError, match='at has no depth; expected a Linearization'):
        call()


@pytest.mark.parametrize(
    ('name', 'shape'),
    [('mean', (10,)), ('information', (10,)), ('scale_factors', (2,)), ('expected', (6,)), ('velocity', (6,)), ('scales', (2,)),
     ('predicted_motion', (4, 4)), ('depth_motion', (4, 4))],
)  # fmt: skip
def test_what_a_descent_knows_is_checked(name: str, shape: tuple[int, ...]) -> None:
    for value in (np.ones(shape, np.float32), np.ones((*shape, 1)), np.ones((shape[0] - 1, *shape[1:])), [1.0], 'text'):
        with pytest.raises(TypeError, match=f'{name} is .* expected'):
            descend(**{name: value})
    descend(predicted_motion=None)
    for wrong_number in ({'gain': 'text'}, {'iterations': 2.5}, {'num_frames': 'text'}, {'small_step': None}):
        with pytest.raises(TypeError, match=f'{next(iter(wrong_number))} is no number'):
            descend(**wrong_number)
    for impossible in ({'num_frames': 0}, {'limit_m': 0.0}, {'limit_rad': np.nan}):
        with pytest.raises(ValueError, match='greater than 0'):
            descend(**impossible)
    with pytest.raises(TypeError, match='is_free is .* expected'):
        descend(is_free=np.ones(10))
    with pytest.raises(TypeError, match='task has no brightness; expected a Descent'):
        _native.Aligner(1).descend(SimpleNamespace(), SimpleNamespace())


def test_true_is_true_whatever_byte_it_is() -> None:
    """Where a view of bytes is taken for bool, numpy takes every one but 0 for True."""
    expected, found = (weigh(is_free=np.full(9, byte, np.uint8).view(bool)) for byte in (1, 2))
    assert np.array_equal(expected.covariance, found.covariance)


@pytest.mark.parametrize(
    ('name', 'shape'),
    [('claimed', (9, 9)), ('shared', (9, 9)), ('scores', (9, 48)), ('cells', (9, 48)), ('velocity', (6,)), ('prior', (9,))],
)
def test_what_is_weighed_is_checked(name: str, shape: tuple[int, ...]) -> None:
    weigh(**{name: np.ones(shape)} if name not in ('claimed', 'shared') else {})
    for value in (np.ones(shape, np.float32), np.ones((*shape, 1)), np.ones((shape[0] - 1, *shape[1:])), [1.0], 'text'):
        with pytest.raises(TypeError, match=f'{name} is .* expected'):
            weigh(**{name: value})
    for wrong_number in ({'step': 2.5}, {'prior_inflation': 'text'}):
        with pytest.raises(TypeError, match=f'{next(iter(wrong_number))} is no number'):
            weigh(**wrong_number)
    with pytest.raises(ValueError, match='step is 0'):
        weigh(step=0)
    with pytest.raises(TypeError, match='is_free is .* expected'):
        weigh(is_free=np.ones(9))
    with pytest.raises(TypeError, match='sums has no claimed; expected EvidenceSums'):
        _native.Aligner(1).weigh(SimpleNamespace(), SimpleNamespace())


def test_a_depth_of_another_size_than_the_image_is_refused() -> None:
    """It used to be read out of bounds."""
    with pytest.raises(TypeError, match='image is .* expected'):
        forward(depth=floats(4, 4))
    with pytest.raises(TypeError, match='target_rgb is .* expected'):
        fit(target_depth=floats(4, 4))


@pytest.mark.parametrize('kind', ['Engine', 'Aligner', 'Blender'])
@pytest.mark.parametrize('threads', [0, -1, 100_000])
def test_numbers_of_threads_are_checked(kind: str, threads: int) -> None:
    with pytest.raises(ValueError, match='threads is'):
        getattr(_native, kind)(threads)


def test_fitting_checks_moments_and_target() -> None:
    cpu = make_rasterizer('cpu', 1)
    scene = Gaussians(**{name: torch.from_numpy(values) for name, values in gaussians().items()})
    rates = Rates(1e-4, 1e-3, 0.05, 2.5e-3)
    moments = Moments(torch.zeros(N, 16), torch.zeros(N, dtype=torch.uint8))
    rgb8, depth = torch.zeros(HEIGHT, WIDTH, 3, dtype=torch.uint8), torch.ones(HEIGHT, WIDTH)

    def target(rgb8: torch.Tensor = rgb8, depth: torch.Tensor = depth) -> Target:
        return Target(CAMERA, rgb8, depth, torch.eye(4), 1.0, 1.0)

    cpu.fit(scene, moments, rates, target())
    for other in (Moments(torch.zeros(N, 8), moments.steps), Moments(moments.first_second, torch.zeros(N))):
        with pytest.raises(RasterizerError, match='the cpu rasterizer takes'):
            cpu.fit(scene, other, rates, target())
    for changed in ({'rgb8': rgb8[:4]}, {'depth': depth[:, :4]}, {'rgb8': rgb8.float()}, {'depth': depth.double()}):
        with pytest.raises(RasterizerError, match='the cpu rasterizer takes'):
            cpu.fit(scene, moments, rates, target(**changed))


# --- what is too large ---


def full_screen(count: int, anisotropic: bool = False) -> Gaussians:
    """Gaussians that each cover the whole image, all but transparent, so that none hides another."""
    means = torch.zeros(count, 3)
    means[:, 2] = torch.linspace(1.0, 2.0, count)
    flat = Gaussians(means, torch.full((count, 1), 5.0), torch.full((count,), -4.0), torch.ones(count, 3))
    return flat.anisotropic() if anisotropic else flat


@pytest.mark.parametrize('anisotropic', [False, True])
def test_a_view_of_too_many_entries_is_refused_in_one_line(anisotropic: bool) -> None:
    """Their number used to overflow 32 bits, and every render to take as much memory as it liked."""
    camera = PinholeCamera(1024, 768, 800.0, 800.0, 511.5, 383.5)
    cpu = make_rasterizer('cpu', 2)
    count = (1 << 26) // (128 * 96) + 1
    with pytest.raises(RasterizerError, match=f'{count} Gaussians cover 671.* tiles .* at most 67108864') as caught:
        cpu.render(full_screen(count, anisotropic), camera, torch.eye(4))
    assert '\n' not in str(caught.value)
    render = cpu.render(full_screen(3, anisotropic), camera, torch.eye(4))  # it goes on
    assert float(render.silhouette.min()) > 0


def test_an_image_that_the_tiles_cannot_address_is_refused() -> None:
    for shape in ((1, 32769), (32769, 1)):
        images = {'image': floats(3, *shape), 'depth': floats(*shape), 'silhouette': floats(*shape)}
        with pytest.raises(_native.TooLargeError, match='cannot be drawn: expected 1 to 32768 a side'):
            forward(**images)
    with pytest.raises(_native.TooLargeError, match='a side'):
        blend(image=floats(5, 1, 32769))
    for shape in ((1, 32768), (32768, 1)):
        forward(image=floats(3, *shape), depth=floats(*shape), silhouette=floats(*shape))


@pytest.mark.slow
@pytest.mark.skipif('SPLATAM_NATIVE' in os.environ, reason='the address sanitizer needs terabytes of addresses')
@pytest.mark.parametrize('threads', [1, 3])
def test_memory_that_runs_out_in_a_thread_is_an_error(threads: int) -> None:
    """In a process of its own: it used to be aborted."""
    code = """
        import resource, sys
        import torch
        from splatam_core.errors import RasterizerError
        from splatam_core.geometry.camera import PinholeCamera
        from splatam_core.rasterizer import Gaussians, make_rasterizer

        COUNT = 4_300_000  # malloc maps each list of more than 32 MB by itself
        camera, cpu = PinholeCamera(8, 32, 32.0, 32.0, 4.0, 16.0), make_rasterizer('cpu', int(sys.argv[1]))

        def scene(rows):
            means = torch.ones(COUNT, 3)
            means[:, 0], means[:, 1] = 0.0, (torch.arange(COUNT) % rows * 8 - 12) / 32  # in the middle of a tile
            return Gaussians(means, torch.full((COUNT, 1), -8.0), torch.zeros(COUNT), torch.zeros(COUNT, 3))

        def covers(scene):
            return cpu.render(scene, camera, torch.eye(4)).silhouette.max() > 0.9

        in_four_rows, in_one_row = scene(4), scene(1)
        assert covers(in_four_rows)
        before = int(open('/proc/self/statm').read().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (before + (16 << 20), -1))  # to sort the one row, a thread needs 52 MB more
        try:
            covers(in_one_row)
        except RasterizerError as error:
            print(error)
        resource.setrlimit(resource.RLIMIT_AS, (-1, -1))
        assert covers(in_four_rows) and covers(in_one_row)
    """
    done = subprocess.run(
        [sys.executable, '-c', textwrap.dedent(code), str(threads)],
        cwd=Path(__file__).parent, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith('the view does not fit into memory')


def test_the_reference_refuses_what_would_fill_the_memory() -> None:
    camera = PinholeCamera(1000, 1, 800.0, 800.0, 511.5, 0.0)
    with pytest.raises(RasterizerError, match='too many for rasterizer=reference'):
        make_rasterizer('reference').render(full_screen(400_001), camera, torch.eye(4))
