"""Growing, pruning and refining the map."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from splatam_core.config import DensificationConfig, KeyframeConfig, MappingConfig, SlamConfig, load_config
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.images.view import View, unproject
from splatam_core.mapping.densification import densify, new_gaussians, unexplained
from splatam_core.mapping.gaussian_map import PARAMETERS, GaussianMap
from splatam_core.mapping.keyframes import KeyframeStore, draw, overlaps, select_keyframes, views_to_fit
from splatam_core.mapping.loss import mapping_loss
from splatam_core.mapping.optimizers import FusedOptimizer, TimeLimit, fused, make_optimizer, prunable
from splatam_core.mapping.optimizers.fused import FINAL_COLORS, FINAL_FIRST, FINAL_LAST, FINAL_MEANS
from splatam_core.mapping.posed import PosedView
from splatam_core.mapping.schedule import MappingSchedule
from splatam_core.rasterizer import Gaussians, Moments, Rasterizer, Rates, Render, Target, joined, make_rasterizer
from splatam_core.rasterizer.bounds import block_bounds
from splatam_core.rasterizer.cpu import CpuRasterizer

CAMERA = PinholeCamera(32, 24, 30.0, 30.0, 15.5, 11.5)
EYE = torch.eye(4)
NO_LIMIT = TimeLimit()
RATES = Rates(means=1e-4, log_scales=1e-3, logit_opacities=0.05, rgb=2.5e-3)


def _view(depth_m: float = 2.0) -> View:
    """A wall with a smooth pattern."""
    v, u = torch.meshgrid(torch.arange(24.0), torch.arange(32.0), indexing='ij')
    rgb = torch.stack([0.5 + 0.4 * torch.sin(u / 3), 0.5 + 0.4 * torch.cos(v / 4), 0.5 + 0.01 * u])
    rgb8 = rgb.mul(255).round().byte().permute(1, 2, 0).contiguous()
    return View(CAMERA, rgb8, torch.full((24, 32), depth_m))


def _refine(
    gaussian_map: GaussianMap, window: list[PosedView], rasterizer: Rasterizer, config: SlamConfig, scene_radius: float = 1.0
) -> None:
    """Fits a map to a window as the mapper does."""
    views = views_to_fit(window, range(config.mapping.iterations), config, np.random.default_rng(0))
    make_optimizer(rasterizer, config.mapping).fit(gaussian_map, views, scene_radius)


def _map(view: View) -> GaussianMap:
    result = GaussianMap()
    result.append(new_gaussians(view, view.valid, view.depth, EYE, 0.5))
    return result


def _at(x: float, turn: float = 0.0) -> torch.Tensor:
    """World to camera: at x, turned about the vertical."""
    c, s = math.cos(turn), math.sin(turn)
    R = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    T = torch.eye(4)
    T[:3, :3], T[:3, 3] = R, -R @ torch.tensor([x, 0.0, 0.0])
    return T


def test_new_gaussians_lie_on_their_pixels() -> None:
    """Position, width of one pixel, colour, opacity; from a moved camera."""
    view, T = _view(), _at(0.3, 0.2)
    gaussians = new_gaussians(view, view.valid, view.depth, T, 0.5)
    camera = gaussians.means @ T[:3, :3].T + T[:3, 3]
    u = CAMERA.fx * camera[:, 0] / camera[:, 2] + CAMERA.cx
    torch.testing.assert_close(u.view(24, 32)[7], torch.arange(32.0), atol=1e-4, rtol=0)  # float32 at 32 px
    torch.testing.assert_close(camera[:, 2], torch.full((768,), 2.0))
    torch.testing.assert_close(gaussians.log_scales.exp(), torch.full((768, 1), 2.0 / 30.0))
    torch.testing.assert_close(gaussians.rgb.T.reshape(3, 24, 32), view.rgb)
    assert not gaussians.logit_opacities.any()


def test_a_fresh_wall_renders_above_the_tracking_gate() -> None:
    """One Gaussian per pixel at opacity 0.5 covers to 0.99: start values and gate belong together (facts, section 3)."""
    render = make_rasterizer('cpu', 1).render(_map(_view()).gaussians, CAMERA, EYE)
    assert float(render.silhouette[8:16, 8:24].min()) > 0.99


def _densified(gaussian_map: GaussianMap, view: View, config: DensificationConfig, threads: int = 1) -> Gaussians:
    """What was added."""
    before = len(gaussian_map)
    densify(gaussian_map, view, EYE, make_rasterizer('cpu', threads), config)
    g = gaussian_map.gaussians
    return Gaussians(*(values[before:] for values in (g.means, g.log_scales, g.logit_opacities, g.rgb)))


def test_densification_adds_nothing_where_the_map_explains_the_view() -> None:
    view = _view()
    added = _densified(_map(view), view, DensificationConfig())
    assert len(added) == 0


def test_densification_adds_unmapped_pixels_with_a_reading() -> None:
    view = _view()
    unseen = view.valid.clone()
    unseen[:, 16:] = False
    half = GaussianMap()
    half.append(new_gaussians(view, unseen, view.depth, EYE, 0.5))
    added = _densified(half, view, DensificationConfig())
    u = CAMERA.fx * added.means[:, 0] / added.means[:, 2] + CAMERA.cx
    assert 24 * 13 <= len(added) <= 24 * 16
    assert float(u.min()) > 15.5


def test_densification_adds_what_stands_in_front_of_the_map() -> None:
    """A new object: 64 pixels far nearer than the mapped wall; the wall's own noise adds nothing."""
    wall = _view()
    generator = torch.Generator().manual_seed(0)
    depth = wall.depth + 0.002 * torch.randn(24, 32, generator=generator)
    depth[8:16, 8:16] = 1.2
    depth[0:2] = 0.0  # no reading: must neither count in the median nor be added
    view = View(CAMERA, wall.rgb8, depth)
    render = make_rasterizer('cpu', 1).render(_map(wall).gaussians, CAMERA, EYE)
    chosen = unexplained(render, view, DensificationConfig())
    assert chosen[8:16, 8:16].all()
    chosen[8:16, 8:16] = False
    assert not chosen[2:-2, 2:-2].any()


def test_densification_at_half_resolution_adds_a_quarter_of_wider_gaussians() -> None:
    view = _view()
    added = _densified(GaussianMap(), view, DensificationConfig(scale=0.5))
    assert len(added) == 24 * 32 // 4
    torch.testing.assert_close(added.log_scales.exp(), torch.full((192, 1), 2.0 / 15.0))


@pytest.mark.parametrize(('max_width', 'width'), [(0, 32), (64, 32), (16, 16), (8, 8)])
def test_the_width_of_the_image_bounds_how_many_are_added(max_width: int, width: int) -> None:
    added = _densified(GaussianMap(), _view(), DensificationConfig(max_width=max_width))
    assert len(added) == width * width * 3 // 4


def test_settled_gaussians_render_at_the_depth_they_were_read_at() -> None:
    """On a floor seen at a grazing angle, blending front to back favours the nearer neighbours; settling undoes that."""
    v = torch.arange(24.0)[:, None].expand(24, 32)
    depth = (1.0 / (0.3 + 0.01 * v)).contiguous()  # a plane: inverse depth is linear in the image
    view = View(CAMERA, torch.full((24, 32, 3), 128, dtype=torch.uint8), depth)
    rasterizer = make_rasterizer('cpu', 1)
    bias = []
    for rounds in (0, 3):
        fresh = _densified(GaussianMap(), view, DensificationConfig(bias_correction_rounds=rounds))
        render = rasterizer.render(fresh, CAMERA, EYE)
        bias.append(float((render.depth() - depth)[4:-4, 4:-4].mean()))
    assert bias[0] < -0.01
    assert abs(bias[1]) < 0.2 * abs(bias[0])


@pytest.mark.parametrize('optimizer', ['paper', 'fused'])
def test_mapping_makes_the_render_look_like_the_view(optimizer: str) -> None:
    view = _view()
    gaussian_map = _map(view)
    gaussian_map.rgb *= 0.7
    rasterizer = make_rasterizer('cpu', 1)

    def error(render: Render) -> float:
        return float((render.rgb - view.rgb).abs().mean())

    before = error(rasterizer.render(gaussian_map.gaussians, CAMERA, EYE))
    window = [PosedView(view, EYE)]
    config = load_config(overrides={'mapping.iterations': 60, 'mapping.optimizer': optimizer})
    _refine(gaussian_map, window, rasterizer, config)
    after = error(rasterizer.render(gaussian_map.gaussians, CAMERA, EYE))
    assert after < 0.5 * before


def test_every_other_step_fits_at_half_size() -> None:
    sizes = []

    class Watched(CpuRasterizer):
        def fit(self, gaussians: Gaussians, moments: Moments, rates: Rates, target: Target) -> float:
            sizes.append((target.camera.width, *target.rgb8.shape[:2], *target.depth.shape))
            return super().fit(gaussians, moments, rates, target)

    config = load_config(overrides={'mapping.iterations': 5, 'mapping.optimizer': 'fused', 'mapping.half_size_every': 2})
    _refine(_map(_view()), [PosedView(_view(), EYE)], Watched(1), config)
    assert sizes == [full := (32, 24, 32, 24, 32), half := (16, 12, 16, 12, 16), full, half, full]


def test_the_rhythm_of_half_size_goes_on_from_frame_to_frame() -> None:
    """Else the first of three steps was never at half size."""
    config = load_config(overrides={'mapping.iterations': 3, 'mapping.first_iterations': 4, 'mapping.every': 2})
    plans = [MappingSchedule(config).plan(index, 1.0) for index in range(7)]
    steps = [range(plan.first_step, plan.first_step + plan.steps) for plan in plans if plan.steps is not None]
    assert [step for of_frame in steps for step in of_frame] == list(range(4 + 4 * 3))


class _Listed(CpuRasterizer):
    """Remembers what it was asked to fit."""

    def __init__(self) -> None:
        super().__init__(1)
        self.asked: list[tuple[Rates, Target]] = []

    def fit(self, gaussians: Gaussians, moments: Moments, rates: Rates, target: Target) -> float:
        self.asked.append((rates, target))
        return super().fit(gaussians, moments, rates, target)


def _finishing(passes: int, **more: object) -> MappingConfig:
    values = {'optimizer': 'fused', 'fused.final_passes': passes} | more
    return load_config(overrides={f'mapping.{name}': value for name, value in values.items()}).mapping


@pytest.mark.usefixtures('any_number_of_steps')
def test_what_fits_is_left_alone_on_the_way_but_not_at_the_end() -> None:
    """The tolerance is an error of colour: ``enough`` is its Huber loss, weighted as colour is."""
    rasterizer, view = _Listed(), PosedView(_view(), EYE)
    optimizer = FusedOptimizer(rasterizer, _finishing(1, color_weight=2.0, **{'fused.tolerance': 0.02}))
    optimizer.fit(gaussian_map := _map(_view()), [view], 1.0)
    optimizer.finish(gaussian_map, [view], np.random.default_rng(0), NO_LIMIT, is_corrected=False)
    assert [target.enough for _, target in rasterizer.asked] == [pytest.approx(2 * 0.02**2 / 0.2), 0.0]


@pytest.fixture
def any_number_of_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """As many passes as the settings say, however few keyframes there are."""
    monkeypatch.setattr(fused, 'LEAST_STEPS', 0)


def _finish(
    keyframes: list[PosedView],
    rasterizer: Rasterizer,
    config: MappingConfig,
    rng: np.random.Generator,
    limit: TimeLimit = NO_LIMIT,
    *,
    is_corrected: bool = False,
) -> int:
    return make_optimizer(rasterizer, config).finish(_map(_view()), keyframes, rng, limit, is_corrected=is_corrected)


@pytest.mark.parametrize(('keyframes', 'passes'), [(1, 12), (25, 6), (30, 5), (38, 4), (80, 4)])
def test_few_keyframes_are_fitted_more_often_at_the_end(keyframes: int, passes: int) -> None:
    """At least 150 steps, but at most three times as many passes."""
    posed, rasterizer = [PosedView(_view(), EYE)] * keyframes, _Listed()
    assert _finish(posed, rasterizer, _finishing(4), np.random.default_rng(0)) == passes * keyframes


@pytest.mark.usefixtures('any_number_of_steps')
def test_a_map_that_was_corrected_is_fitted_twice_as_often_at_the_end() -> None:
    rasterizer = _Listed()
    assert _finish([PosedView(_view(), EYE)], rasterizer, _finishing(3), np.random.default_rng(0), is_corrected=True) == 6
    assert len(rasterizer.asked) == 6


@pytest.mark.usefixtures('any_number_of_steps')
def test_finishing_fits_every_keyframe_as_often_with_fading_steps() -> None:
    """Each pass has all three, in an order of its own; step sizes fade along half a cosine."""
    keyframes = [PosedView(_view(), _at(0.1 * i)) for i in range(3)]
    rasterizer, config = _Listed(), _finishing(7)
    assert _finish(keyframes, rasterizer, config, np.random.default_rng(0)) == 21
    x = [round(-10 * float(target.T_cam_world[0, 3])) for _, target in rasterizer.asked]
    passes = [tuple(x[i : i + 3]) for i in range(0, 21, 3)]
    assert {frozenset(one) for one in passes} == {frozenset({0, 1, 2})} and len(set(passes)) > 1
    colours = np.array([rates.rgb for rates, _ in rasterizer.asked]) / config.rgb_rate / FINAL_COLORS
    falling = np.cos(np.linspace(0, np.pi, 22))[:21]
    np.testing.assert_allclose(colours, FINAL_LAST + (FINAL_FIRST - FINAL_LAST) * (1 + falling) / 2)
    assert rasterizer.asked[0][0].means == pytest.approx(FINAL_MEANS * FINAL_FIRST * config.means_rate)


@pytest.mark.parametrize(('scale', 'max_width', 'width'), [(1.0, 0, 32), (0.75, 0, 24), (0.75, 30, 24), (0.75, 20, 20)])
def test_views_are_made_smaller_by_scale_and_width(scale: float, max_width: int, width: int) -> None:
    view = _view().narrowed(scale, max_width)
    assert view.camera.width == view.rgb8.shape[1] == view.depth.shape[1] == width
    assert view.camera == _view().camera.resized(width, width * 3 // 4)


@pytest.mark.usefixtures('any_number_of_steps')
def test_finishing_ends_when_its_time_is_up_and_nothing_is_asked_of_it_by_default(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fused.time, 'monotonic', itertools.count(step=1e-3).__next__)  # a step takes a millisecond
    keyframe, rng = PosedView(_view(), EYE), np.random.default_rng(0)
    in_time = _Listed()
    assert _finish([keyframe], in_time, _finishing(100_000), rng, TimeLimit(0.0205)) == 20
    first, last = in_time.asked[0][0].rgb, in_time.asked[-1][0].rgb
    assert last < 0.1 * first  # it faded, from 5 to about 0.2 of the usual
    assert _finish([keyframe], _Listed(), _finishing(5), rng, TimeLimit(0.0)) == 0
    stopped = _Listed()
    assert _finish([keyframe], stopped, _finishing(5), rng, TimeLimit(stop=lambda: len(stopped.asked) == 3)) == 3
    assert _finish([keyframe], rasterizer := _Listed(), _finishing(0), rng) == 0 and not rasterizer.asked
    assert _finish([], _Listed(), _finishing(5), rng) == 0


@pytest.mark.parametrize('optimizer', ['paper', 'fused'])
def test_mapping_prunes_on_the_way(optimizer: str) -> None:
    view = _view()
    gaussian_map = _map(view)
    gaussian_map.logit_opacities[::4] = -8.0
    config = load_config(overrides={'mapping.iterations': 3, 'mapping.optimizer': optimizer})
    _refine(gaussian_map, [PosedView(view, EYE)], make_rasterizer('cpu', 1), config, 10.0)
    assert len(gaussian_map) == 24 * 32 * 3 // 4


def test_pruning_drops_the_faint_and_the_wide() -> None:
    gaussian_map = _map(_view())
    gaussian_map.logit_opacities[3] = math.log(0.004 / 0.996)
    gaussian_map.log_scales[5] = math.log(0.11)
    chosen = prunable(gaussian_map, min_opacity=0.005, max_scale_m=0.1)
    assert torch.nonzero(chosen)[:, 0].tolist() == [3, 5]


@pytest.mark.parametrize(
    ('every', 'until', 'pruned_at'),
    [(0, 20, []), (3, 3, [0, 3]), (3, 4, [0, 3]), (3, 2, [0]), (2, 20, [0, 2, 4]), (1, 1, [0, 1])],
)
def test_pruning_by_its_schedule(every: int, until: int, pruned_at: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    """At steps 0, n, 2n, ... of five, up to the last that may; nothing moves in between, so the first takes all five."""
    view, sizes = _view(), []
    gaussian_map = _map(view)
    gaussian_map.logit_opacities[:2] = -8.0
    gaussian_map.log_scales[6:9] = math.log(0.11)
    keep, step = gaussian_map.keep, gaussian_map.step
    monkeypatch.setattr(gaussian_map, 'keep', lambda kept: (keep(kept), pruned.append(len(sizes))))
    monkeypatch.setattr(gaussian_map, 'step', lambda: (step(), sizes.append(len(gaussian_map))))
    pruned: list[int] = []
    still = {'means_rate': 0.0, 'rgb_rate': 0.0, 'opacity_rate': 0.0, 'scale_rate': 0.0}
    values = {'iterations': 5, 'paper.prune_every': every, 'paper.prune_until': until} | still
    config = load_config(overrides={f'mapping.{name}': value for name, value in values.items()})
    _refine(gaussian_map, [PosedView(view, EYE)], make_rasterizer('cpu', 1), config)
    assert pruned == pruned_at
    assert sizes == [763 if pruned_at else 768] * 5


def test_opacities_that_are_reset_step_as_if_for_the_first_time() -> None:
    """Set between gradient and step 2 of 2, 3 and 4: 1 % opaque, then 0.05 of the logit a step."""
    opacities, view, rasterizer = [], _view(), make_rasterizer('cpu', 1)
    for iterations in (2, 3, 4):
        gaussian_map = _map(view)
        gaussian_map.start_optimization(RATES)
        for step in range(iterations):
            render = rasterizer.render(gaussian_map.gaussians, CAMERA, EYE)
            mapping_loss(render, view, MappingConfig()).backward()
            if step == 2:
                gaussian_map.set_opacities(0.01)
            gaussian_map.step()
        gaussian_map.stop_optimization()
        opacities.append(torch.sigmoid(gaussian_map.logit_opacities))
    before, at, after = opacities
    assert before.min() > 0.3
    torch.testing.assert_close(at, torch.full_like(at, 0.01))  # nothing is left to step by
    moved = (torch.logit(after) - math.log(0.01 / 0.99)).abs()
    # the moments were forgotten, Adam's step count was not: 0.1 / sqrt(0.001) of the rate, its corrections for step 3 of 3
    expected = 0.05 * (0.1 / (1 - 0.9**3)) / math.sqrt(0.001 / (1 - 0.999**3))
    assert float(moved.median()) == pytest.approx(expected, rel=1e-3)


def test_keep_takes_gradients_and_moments_along() -> None:
    """A step after pruning moves each survivor exactly as without pruning."""
    view = _view()
    pruned, whole = _map(view), _map(view)
    kept = torch.ones(len(whole), dtype=torch.bool)
    kept[::3] = False
    for gaussian_map in (pruned, whole):
        gaussian_map.start_optimization(RATES)
    for step in range(3):
        generator = torch.Generator().manual_seed(step)
        slopes = {name: torch.randn(getattr(whole, name).shape, generator=generator) for name in PARAMETERS}
        for name in PARAMETERS:
            getattr(whole, name).grad = slopes[name].clone()
            own = slopes[name] if len(pruned) == len(whole) else slopes[name][kept]
            getattr(pruned, name).grad = own.clone()
        if step == 1:
            pruned.keep(kept)
        for gaussian_map in (pruned, whole):
            gaussian_map.step()
    for name in PARAMETERS:
        assert torch.equal(getattr(pruned, name), getattr(whole, name)[kept]), name


def test_snapshot_stays_as_it_was() -> None:
    gaussian_map = _map(_view())
    snapshot = gaussian_map.snapshot()
    means = snapshot.means.copy()
    gaussian_map.means += 1.0
    gaussian_map.append(gaussian_map.gaussians)
    np.testing.assert_array_equal(snapshot.means, means)
    np.testing.assert_allclose(snapshot.opacities, 0.5)


def test_overlap_is_the_share_seen_inside_the_margin() -> None:
    view = _view()
    v, u = torch.nonzero(view.valid, as_tuple=True)
    points = unproject(view.camera, u, v, view.depth[v, u])
    here, behind = PosedView(view, EYE), PosedView(view, _at(0.0, math.pi))
    assert overlaps(points, view.camera, [here, behind], 0) == pytest.approx([1.0, 0.0], abs=0.1)  # the outermost are on the rim
    assert overlaps(points, view.camera, [here], 8) == pytest.approx([15 * 7 / 768], abs=0.01)
    assert overlaps(points[:0], view.camera, [here], 0) == [0.0]
    assert overlaps(points, view.camera, [], 0) == []
    assert overlaps(points, view.camera, [behind], 0) == [0.0]  # a camera that has turned away from all that it saw


def test_keyframes_that_cannot_see_the_points_are_left_out_unseen() -> None:
    """Of many places and directions the shares are those found point by point."""
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(50, 3, generator=generator) * torch.tensor([2.0, 1.0, 0.5]) + torch.tensor([3.0, -0.5, 2.0])
    poses = [_at(12 * float(torch.rand((), generator=generator)) - 3, 0.05 * k) for k in range(200)]
    shares = overlaps(points, CAMERA, [PosedView(_view(), T) for T in poses], 2)
    for T, share in zip(poses, shares, strict=True):
        x, y, z = (points @ T[:3, :3].T + T[:3, 3]).unbind(1)
        u, v = CAMERA.fx * x / z + CAMERA.cx, CAMERA.fy * y / z + CAMERA.cy
        inside = (z > 0) & (u > 2) & (u < 30) & (v > 2) & (v < 22)
        assert share == pytest.approx(float(inside.float().mean()), abs=1e-6)
    assert 20 < sum(share > 0 for share in shares) < 180


def test_beyond_the_budget_the_keyframe_goes_that_its_neighbours_replace() -> None:
    """A camera that rests fills no memory, and what it saw on its way stays; the last frame is always there."""
    store = KeyframeStore(torch.device('cpu'), KeyframeConfig(budget=6))
    way = [0.0, 0.5, 1.0, 1.5, 2.0]
    for x in [*way, *[2.0] * 50]:
        store.append(PosedView(_view(), _at(x)))
    last = PosedView(_view(), _at(2.0, 0.1))
    store.append(last)
    assert [round(-float(keyframe.T_cam_world[0, 3]), 3) for keyframe in store][:5] == way and len(store) == 6
    assert store[-1] is last
    store.append(PosedView(_view(), _at(2.0, 1.2)))  # turned away: more than half a metre would move it
    assert [keyframe is last for keyframe in store].count(True) == 1 and len(store) == 6
    for budget, expected in ((1, [3.0]), (2, [0.0, 3.0])):
        store = KeyframeStore(torch.device('cpu'), KeyframeConfig(budget=budget))
        for x in (0.0, 1.0, 2.0, 3.0):
            store.append(PosedView(_view(), _at(x)))
        assert [-float(keyframe.T_cam_world[0, 3]) for keyframe in store] == expected


def test_the_current_view_gets_its_share_of_the_steps() -> None:
    view = _view()
    window = [PosedView(view, _at(0.01 * k)) for k in range(9)]
    rng = np.random.default_rng(0)
    for share, expected in ((0.0, 1 / 9), (0.25, 0.25), (1.0, 1.0)):
        drawn = [draw(window, KeyframeConfig(current_share=share), rng) is window[-1] for _ in range(2000)]
        assert np.mean(drawn) == pytest.approx(expected, abs=0.04)  # four standard deviations of 2000 draws


def _cluster(n: int, generator: torch.Generator) -> Gaussians:
    where = 6 * torch.rand(3, generator=generator) - 3
    means = where + 0.5 * torch.randn(n, 3, generator=generator)
    log_scales = -4 + 2 * torch.rand(n, 1, generator=generator)
    rgb = torch.rand(n, 3, generator=generator)
    return Gaussians(means, log_scales, torch.randn(n, generator=generator), rgb)


def test_gaussians_out_of_view_are_skipped_without_a_trace() -> None:
    """Bounds change nothing but time: with and without them the images are the same, bit for bit."""
    generator = torch.Generator().manual_seed(0)
    rasterizer = make_rasterizer('cpu', 2)
    gaussian_map = GaussianMap()
    for _ in range(20):
        gaussian_map.append(_cluster(int(torch.randint(1, 1500, (1,), generator=generator)), generator))
    gaussian_map.keep(torch.rand(len(gaussian_map), generator=generator) > 0.1)
    bounded = gaussian_map.gaussians
    assert bounded.bounds is not None and len(bounded.bounds) == -(-len(gaussian_map) // 1024)
    unbounded = replace(bounded, bounds=None)
    for k in range(12):
        pose = _at(0.5 * k - 3, 0.5 * k)
        first, second = (rasterizer.render(gaussians, CAMERA, pose) for gaussians in (bounded, unbounded))
        assert torch.equal(first.rgb, second.rgb) and torch.equal(first.silhouette, second.silhouette)


@pytest.mark.parametrize('value', [math.nan, math.inf])
def test_one_that_is_not_finite_hides_none_of_its_block(value: float) -> None:
    gaussian_map, broken = _map(_view()), _map(_view()).gaussians.detached()
    broken.means[5] = value
    gaussian_map.append(broken)
    bounded = gaussian_map.gaussians
    assert bounded.bounds is not None
    first, second = (make_rasterizer('cpu', 1).render(g, CAMERA, EYE) for g in (bounded, replace(bounded, bounds=None)))
    assert torch.equal(first.rgb, second.rgb) and first.silhouette.mean() > 0.9


def test_fused_pruning_waits_until_a_share_of_the_map_is_to_go() -> None:
    for faint, left in ((4, 768), (40, 728)):
        gaussian_map = _map(_view())
        gaussian_map.logit_opacities[:faint] = -9.0
        config = load_config(
            overrides={'mapping.iterations': 1, 'mapping.optimizer': 'fused', 'mapping.fused.prune_fraction': 0.02}
        )
        _refine(gaussian_map, [PosedView(_view(), EYE)], make_rasterizer('cpu', 1), config, 10.0)
        assert len(gaussian_map) == left


@pytest.mark.parametrize(('old', 'new'), [(0, 5), (1024, 0), (1024, 3000), (1500, 10), (2500, 3000)])
def test_joined_gaussians_are_bounded_as_one_map_of_them(old: int, new: int) -> None:
    generator = torch.Generator().manual_seed(0)
    gaussian_map, more = GaussianMap(), _cluster(new, generator)
    gaussian_map.append(_cluster(old, generator))
    together = joined(gaussian_map.gaussians, more)
    gaussian_map.append(more)
    assert torch.equal(together.bounds, gaussian_map.gaussians.bounds)
    gaussian_map.replace_last(moved := replace(more, means=more.means + 1))
    assert torch.equal(torch.cat([together.means[:old], moved.means]), gaussian_map.means)
    assert torch.equal(block_bounds(gaussian_map.means, gaussian_map.log_scales), gaussian_map.gaussians.bounds)
    assert len(joined(more, more)) == 2 * new and joined(more, more).bounds is None


def test_bounds_follow_what_fitting_moves() -> None:
    gaussian_map = _map(_view())
    config = load_config(overrides={'mapping.iterations': 20, 'mapping.optimizer': 'fused', 'mapping.means_rate': 0.01})
    away = PosedView(_view(1.5), EYE)
    _refine(gaussian_map, [away], make_rasterizer('cpu', 2), config, 10.0)
    bounds = gaussian_map.gaussians.bounds
    assert bounds is not None
    assert (gaussian_map.means >= bounds[0, :3]).all() and (gaussian_map.means <= bounds[0, 3:6]).all()
    assert gaussian_map.log_scales.max() <= bounds[0, 6]


def test_overlapping_keyframes_and_the_last_are_mapped_with_the_current_view() -> None:
    view = _view()
    near = [PosedView(view, _at(0.01 * k)) for k in range(6)]
    away = [PosedView(view, _at(0.0, math.pi)) for _ in range(4)]
    last, current = PosedView(view, _at(9.0)), PosedView(view, EYE)
    config = KeyframeConfig(window=5, overlap_margin=2)
    rng = np.random.default_rng(0)
    windows = [select_keyframes(current, [*near, *away, last], config, rng) for _ in range(20)]
    for window in windows:
        assert len(window) == 4 and window[-1] is last
        assert all(any(w is k for k in near) for w in window[:-1])
        assert len({id(w) for w in window}) == 4
    assert len({frozenset(map(id, window)) for window in windows}) > 1  # random, not always the same


@pytest.mark.parametrize(
    ('selection', 'expected'),
    [('most_overlap', {0, 1, 2}), ('latest', {7, 8, 9}), ('uniform', {0, 4, 9}), ('random', None)],
)
def test_other_selections_of_keyframes(selection: str, expected: set[int] | None) -> None:
    """Ten keyframes that overlap the less the later they are, then the last."""
    view = _view()
    keyframes = [PosedView(view, _at(0.0, 0.07 * k)) for k in range(10)]
    last, current = PosedView(view, _at(9.0)), PosedView(view, EYE)
    config = KeyframeConfig(window=5, overlap_margin=0, overlap_samples=4000, selection=selection)
    rng = np.random.default_rng(0)
    windows = [select_keyframes(current, [*keyframes, last], config, rng) for _ in range(20)]
    chosen = [{next(i for i, k in enumerate(keyframes) if k is w) for w in window[:-1]} for window in windows]
    assert all(window[-1] is last for window in windows)
    assert all(len(some) == 3 for some in chosen)
    if expected is None:
        assert set.union(*chosen) == set(range(10))
    else:
        assert all(some == expected for some in chosen)
    few = select_keyframes(current, [*keyframes[:2], last], config, rng)
    assert {id(w) for w in few} == {id(w) for w in (*keyframes[:2], last)}


@pytest.mark.parametrize(
    ('config', 'num_frames', 'kept'),
    [
        (KeyframeConfig(), 12, [0, 5, 10]),
        (KeyframeConfig(at_least=5), 10, [0, 2, 4, 6, 8]),  # the original's n // 5 for recordings below 25 frames
        (KeyframeConfig(at_least=5), 3, [0, 1, 2]),
        (KeyframeConfig(at_least=5), 30, [0, 5, 10, 15, 20, 25]),
        (KeyframeConfig(at_least=5), None, [0, 5, 10]),  # live
    ],
)
def test_which_frames_are_kept(config: KeyframeConfig, num_frames: int | None, kept: list[int]) -> None:
    schedule = MappingSchedule(SlamConfig(keyframes=config), num_frames)
    assert [i for i in range(num_frames or 12) if schedule.is_keyframe(i)] == kept


def test_no_keyframe_is_mapped_with_the_first_frame_or_in_a_window_of_one() -> None:
    current = PosedView(_view(), EYE)
    rng = np.random.default_rng(0)
    assert select_keyframes(current, [], KeyframeConfig(), rng) == []
    assert select_keyframes(current, [current], KeyframeConfig(window=1), rng) == []
