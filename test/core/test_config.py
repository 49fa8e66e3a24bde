"""The configuration: presets, overrides, and errors that help."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from splatam_core.config import SlamConfig, flat_values, load_config, preset_names, settings, to_yaml
from splatam_core.errors import ConfigError
from splatam_core.retired_settings import REMOVED, RENAMED, RENAMED_VALUES


@pytest.mark.parametrize('preset', preset_names())
def test_every_preset_loads(preset: str) -> None:
    assert isinstance(load_config(preset), SlamConfig)


def test_presets_state_the_papers_numbers() -> None:
    paper, small, tum = (load_config(name) for name in ('splatam', 'splatam_s', 'tum'))
    assert (paper.tracking.iterations, paper.mapping.iterations) == (40, 60)
    assert (small.tracking.iterations, small.mapping.iterations, small.densification.scale) == (10, 15, 0.5)
    assert (tum.tracking.iterations, tum.mapping.iterations, tum.tracking.paper.rotation_rate) == (200, 30, 2e-3)


@pytest.mark.parametrize(
    ('preset', 'tracking', 'mapping', 'window', 'scale'),
    [
        ('replica', (40, 4e-4, 2e-3), 60, 24, 1.0),
        ('replica_v2', (40, 4e-4, 2e-3), 60, 24, 1.0),
        ('splatam_s', (10, 4e-4, 2e-3), 15, 32, 0.5),
        ('tum', (200, 2e-3, 2e-3), 30, 20, 1.0),
        ('scannet', (100, 5e-4, 5e-4), 30, 10, 1.0),
        ('scannetpp', (200, 1e-3, 4e-3), 60, 24, 1.0),
        ('iphone', (60, 1e-3, 4e-3), 60, 32, 0.5),
    ],
)
def test_presets_are_the_originals_configurations(preset, tracking, mapping, window, scale) -> None:
    config = load_config(preset)
    t = config.tracking
    assert (t.iterations, t.paper.rotation_rate, t.paper.translation_rate) == tracking
    assert (config.mapping.iterations, config.keyframes.window, config.densification.scale) == (mapping, window, scale)
    assert (config.mapping.every, config.keyframes.every, t.silhouette_threshold) == (1, 5, 0.99)


ORIGINALS = ('splatam', 'splatam_s', 'replica', 'replica_v2', 'tum', 'scannet', 'scannetpp', 'iphone')


@pytest.mark.parametrize('preset', ORIGINALS)
def test_what_all_of_the_originals_configurations_share(preset: str) -> None:
    config = load_config(preset)
    t, d, k, m = config.tracking, config.densification, config.keyframes, config.mapping
    assert (t.method, t.motion_model, t.paper.use_silhouette) == ('render_and_compare', 'constant_velocity', True)
    assert (t.color_weight, t.depth_weight, m.color_weight, m.depth_weight) == (0.5, 1.0, 0.5, 1.0)
    assert (t.paper.depth_outlier_ratio, m.paper.depth_outlier_ratio, m.paper.ssim_weight) == (0.0, 0.0, 0.2)
    assert (t.silhouette_threshold, d.silhouette_threshold, d.depth_error_ratio, d.opacity) == (0.99, 0.5, 50.0, 0.5)
    assert (m.means_rate, m.rgb_rate, m.rotation_rate, m.opacity_rate, m.scale_rate) == (1e-4, 2.5e-3, 1e-3, 0.05, 1e-3)
    assert (m.paper.prune_every, m.paper.prune_until, m.prune_opacity, m.prune_scale) == (20, 20, 0.005, 0.1)
    assert (m.anisotropic, m.optimizer, m.hold_out) == (False, 'paper', 0)
    assert (k.selection, k.overlap_samples, k.overlap_margin) == ('overlap', 1600, 20)
    assert (m.scene_radius_ratio, k.at_least) == (2.0 if preset == 'tum' else 3.0, 5 if preset == 'iphone' else 0)
    assert config.width == {'scannet': 640, 'scannetpp': 876, 'iphone': 960}.get(preset, 0)
    assert (t.scale, d.scale) == (1.0, 0.5 if preset in ('splatam_s', 'iphone') else 1.0)


def test_presets_for_far_apart_photographs_track_longer_where_depth_stays_off() -> None:
    """The original's 20000 metres times pixels, at the image sizes it was meant for."""
    assert load_config('scannetpp').tracking.paper.extend_above_m == pytest.approx(20000 / (584 * 876), rel=0.01)
    assert load_config('iphone').tracking.paper.extend_above_m == pytest.approx(20000 / (720 * 960), rel=0.01)
    assert all(load_config(name).tracking.paper.extend_above_m == 0 for name in ('splatam', 'splatam_s', 'tum', 'scannet'))


def test_overrides_win_over_the_preset() -> None:
    config = load_config('splatam_s', ['tracking.iterations=7', 'mapping.means_rate=1e-3', 'seed=3'])
    assert (config.tracking.iterations, config.mapping.means_rate, config.seed) == (7, 1e-3, 3)
    assert config.mapping.iterations == 15


def test_yaml_round_trip(tmp_path: Path) -> None:
    config = load_config('quick', {'depth.max_m': 4, 'tracking.motion_model': 'last_pose'})
    path = tmp_path / 'config.yaml'
    path.write_text(to_yaml(config))
    assert load_config(str(path)) == config


@pytest.mark.parametrize(
    ('override', 'message'),
    [
        ('tracking.iteratons=40', "unknown key 'tracking.iteratons'; did you mean 'tracking.iterations'?"),
        ('tracking=4', "unknown key 'tracking'"),
        ('tracking.iterations', 'expected key=value'),
        ('tracking.iterations=many', 'expected a whole number at least 0'),
        ('tracking.iterations=1.5', 'expected a whole number at least 0'),
        ('tracking.iterations=-1', 'expected a whole number at least 0'),
        ('tracking.silhouette_threshold=1.5', 'at least 0 and at most 1'),
        ('tracking.silhouette_threshold=nan', 'at least 0 and at most 1'),
        ('rasterizer=cuda', 'one of auto, cpu, triton, reference'),
        ('depth.min_m=200', 'less than depth.max_m'),
    ],
)
def test_wrong_overrides_say_what_is_right(override: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_config('quick', [override])
    assert message in str(caught.value)


def test_settings_that_exclude_each_other_are_refused() -> None:
    with pytest.raises(ConfigError, match='anisotropic.*mapping.optimizer=paper'):
        load_config('realtime', ['mapping.anisotropic=true'])


@pytest.mark.parametrize(
    ('preset', 'override', 'way_out'),
    [
        ('realtime', 'mapping.paper.depth_outlier_ratio=10', 'mapping.optimizer = fused; set mapping.optimizer=paper'),
        ('realtime', 'mapping.paper.ssim_weight=0.5', 'mapping.optimizer = fused; set mapping.optimizer=paper'),
        ('realtime', 'tracking.paper.rotation_rate=0.1', 'tracking.method = align; set tracking.method=render_and_compare'),
        ('quick', 'mapping.fused.final_passes=3', 'mapping.optimizer = paper; set mapping.optimizer=fused'),
        ('splatam', 'tracking.align.features=false', 'tracking.method = render_and_compare; set tracking.method=align'),
    ],
)
def test_settings_of_what_is_not_in_use_are_refused(preset: str, override: str, way_out: str) -> None:
    """And accepted together with the choice that they belong to."""
    with pytest.raises(ConfigError, match=f'^{override.partition("=")[0]} = .*: has no effect with {way_out}'):
        load_config(preset, [override])
    load_config(preset, [override, way_out.rpartition(' ')[2]])


def test_settings_that_change_nothing_are_accepted_whatever_is_in_use() -> None:
    """ROS writes down every parameter and gives them all back: unused ones, too."""
    for preset in preset_names():
        config = load_config(preset)
        assert load_config(preset, flat_values(config)) == config
        assert load_config('realtime', {**flat_values(load_config('realtime')), 'mapping.optimizer': 'paper'})


@pytest.mark.parametrize('name', [*RENAMED, *REMOVED])
def test_a_retired_name_says_what_to_use_instead(name: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_config('quick', [f'{name}=1'])
    message = str(caught.value)
    assert message.startswith(f"'{name}' ") and '\n' not in message
    assert f"is now '{RENAMED[name]}'" in message if name in RENAMED else REMOVED[name].instead in message


def test_retired_names_lead_to_settings_that_exist() -> None:
    known = {setting.name: setting for setting in settings()}
    assert set(RENAMED.values()) <= set(known) and not (set(RENAMED) | set(REMOVED)) & set(known)
    for (name, _), value in RENAMED_VALUES.items():
        assert known[name].check(value) == value


def test_files_of_earlier_versions_are_translated(tmp_path: Path) -> None:
    path = tmp_path / 'config.yaml'
    path.write_text(
        'tracking: {method: align, lag: false, min_sure_fraction: 0.1}\ndensification: {settle: 1}\n'
        'mapping: {mode: sync, optimizer: autograd, ssim_weight: 0.1, prune_from: 0}\nkeyframes: {before_last: false}\n'
    )
    config = load_config(str(path))
    assert (config.tracking.align.time_offset, config.tracking.min_visible_fraction) == (False, 0.1)
    assert (config.densification.bias_correction_rounds, config.mapping.paper.ssim_weight) == (1, 0.1)
    path.write_text('mapping: {optimizer: fused, prune_every: 0}\n')
    assert load_config(str(path)).mapping.fused.prune_fraction == 1.0
    path.write_text('mapping: {reset_opacity_every: 100}\n')
    with pytest.raises(ConfigError, match=r"mapping.reset_opacity_every = 100: .* was removed in 0.2.0: 'splatam refine"):
        load_config(str(path))


def test_unknown_preset_lists_the_known() -> None:
    with pytest.raises(ConfigError, match='shipped: .*quick.*splatam'):
        load_config('fast')


def test_every_setting_is_documented_and_its_default_allowed() -> None:
    defaults = flat_values(SlamConfig())
    for setting in settings():
        assert setting.help.endswith('.'), setting.name
        assert setting.check(defaults[setting.name]) == setting.default


def test_the_help_of_every_number_says_when_to_change_it() -> None:
    numbers = [setting for setting in settings() if setting.type in (int, float)]
    assert [setting.name for setting in numbers if not re.search(r'[Ii]ncrease|[Dd]ecrease|Set ', setting.help)] == []
