"""The one configuration: typed, with help, unit and bounds beside each default.

Order: defaults < preset < overrides. YAML files, ``--set``, ROS parameters and the documentation's
table all derive from the dataclasses below.
"""

from __future__ import annotations

import difflib
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, get_type_hints

import yaml

from splatam_core.errors import ConfigError, one_line
from splatam_core.resources import config_dir

Value = bool | int | float | str

DEVICES = ('auto', 'cpu', 'cuda')
WHERE = frozenset({'device', 'rasterizer', 'keyframes.on_device'})
"""Settings that say where SLAM is computed, not what."""


@dataclass(frozen=True, slots=True)
class Setting:
    """One leaf of the configuration.

    Attributes:
        name: dotted path, e.g. ``tracking.iterations``.
        type: bool, int, float or str.
        default: value where neither preset nor user says otherwise.
        help: what it does, one sentence.
        unit: of the value; empty where it has none.
        minimum: smallest allowed number, or None.
        maximum: largest allowed number, or None.
        choices: the allowed strings; empty where any will do.
    """

    name: str
    type: type
    default: Value
    help: str
    unit: str
    minimum: float | None
    maximum: float | None
    choices: tuple[str, ...]

    def check(self, value: object) -> Value:
        """The value in this setting's type.

        Raises:
            ConfigError: wrong type, or outside what is allowed.
        """
        if self.type is float and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        if type(value) is not self.type:
            raise ConfigError(f'{self.name} = {value!r}: expected {self._allowed()}')
        if self.choices and value not in self.choices:
            raise ConfigError(f'{self.name} = {value!r}: expected {self._allowed()}')
        too_low = self.minimum is not None and not value >= self.minimum
        too_high = self.maximum is not None and not value <= self.maximum
        if too_low or too_high:
            raise ConfigError(f'{self.name} = {value}: expected {self._allowed()}')
        return value

    def _allowed(self) -> str:
        if self.choices:
            return 'one of ' + ', '.join(self.choices)
        kind = {bool: 'true or false', int: 'a whole number', float: 'a number', str: 'a text'}[self.type]
        bounds = [f'at least {self.minimum:g}'] if self.minimum is not None else []
        bounds += [f'at most {self.maximum:g}'] if self.maximum is not None else []
        return ' '.join([kind, ' and '.join(bounds), f'({self.unit})' if self.unit else '']).strip()


def _setting(
    default: Value,
    help: str,
    unit: str = '',
    minimum: float | None = None,
    maximum: float | None = None,
    choices: tuple[str, ...] = (),
) -> Any:
    metadata = {'help': help, 'unit': unit, 'minimum': minimum, 'maximum': maximum, 'choices': choices}
    return field(default=default, metadata=metadata)


@dataclass(frozen=True, slots=True)
class DepthConfig:
    """Which depth readings count."""

    min_m: float = _setting(0.2, 'Nearer readings count as none.', 'm', 0.0)
    max_m: float = _setting(100.0, 'Farther readings count as none.', 'm', 0.0)
    edge_filter: float = _setting(
        0.0, 'Drop readings that differ from a neighbour by more than this share of their depth; 0 = off.', '', 0.0, 1.0
    )


@dataclass(frozen=True, slots=True)
class TrackingConfig:
    """Camera tracking (paper, section 3.2), and when to call a frame lost."""

    method: str = _setting(
        'render_and_compare',
        "The paper's Adam through the renderer, Gauss-Newton alignment to one render, the expected pose as it is, or the "
        'true one (of recordings that have it).',
        choices=('render_and_compare', 'align', 'none', 'truth'),
    )
    iterations: int = _setting(40, 'Steps per frame; of alignment, at most per resolution.', '', 0)
    extend_above_m: float = _setting(
        0.0,
        "Of the paper's tracker: as many steps again where the depth L1, over the image's pixels, ends above this; 0 = never.",
        'm', 0.0,
    )  # fmt: skip
    scale: float = _setting(1.0, 'Resolution at which frames are tracked, relative to the frame.', '', 0.05, 1.0)
    exposure: bool = _setting(True, "Of alignment: take up changes of the camera's exposure.")
    half_render_from: int = _setting(
        0, 'Of alignment: render at half the resolution, the finest it works at, where frames are as wide as this; 0 = never.',
        'px', 0,
    )  # fmt: skip
    again_below: float = _setting(
        0.0, 'Of alignment: where a smaller share of the pixels agrees, render and align once more from there; 0 = never.',
        '', 0.0, 1.0,
    )  # fmt: skip
    features: bool = _setting(
        True,
        'Of alignment: where that does not help, start from features (ORB, PnP) that the frame shares with the map as seen from '
        'the last pose.',
    )
    lag: bool = _setting(True, 'Of alignment: take up that colour and depth of a frame were taken at different times.')
    rotation_rate: float = _setting(4e-4, 'Adam step of the unit quaternion.', '', 0.0)
    translation_rate: float = _setting(2e-3, 'Adam step of the translation.', 'm', 0.0)
    color_weight: float = _setting(0.5, 'Weight of the colour L1.', '', 0.0)
    depth_weight: float = _setting(1.0, 'Weight of the depth L1.', '', 0.0)
    silhouette_threshold: float = _setting(0.99, 'Pixels count only where the rendered silhouette is above this.', '', 0.0, 1.0)
    use_silhouette: bool = _setting(
        True,
        "Of the paper's tracker: look at sure map only; off = depth where there is a reading and colour everywhere, "
        'also where there is no map.',
    )
    depth_outlier_ratio: float = _setting(
        0.0, "Of the paper's tracker: pixels count up to this many median depth errors; 0 = all.", '', 0.0
    )
    blended_depth: bool = _setting(
        False, "Of the paper's tracker: compare the blended depth, short where the map is thin, as the original does, and not "
        'the expected one.',
    )  # fmt: skip
    motion_model: str = _setting('constant_velocity', 'Where tracking starts from.', choices=('constant_velocity', 'last_pose'))
    min_sure_fraction: float = _setting(0.2, 'Lost when a smaller share of the pixels with depth sees sure map.', '', 0.0, 1.0)
    min_inlier_fraction: float = _setting(
        0.5, 'Lost when a smaller share of those pixels agrees with the map in depth and colour.', '', 0.0, 1.0
    )
    inlier_depth: float = _setting(0.1, 'Agreeing depth differs by at most this share of the reading.', '', 0.0)
    inlier_color: float = _setting(0.2, 'Agreeing colour differs by at most this, mean over channels in [0, 1].', '', 0.0)


@dataclass(frozen=True, slots=True)
class DensificationConfig:
    """Where a frame adds Gaussians (paper, section 3.3)."""

    every: int = _setting(1, 'Add on every n-th frame of those that are mapped.', 'frames', 1)
    when_unsure: float = _setting(
        0.0, 'Add on other frames too, where a smaller share of the pixels with depth sees sure map.', '', 0.0, 1.0
    )
    scale: float = _setting(1.0, 'Resolution at which Gaussians are added, relative to the frame.', '', 0.05, 1.0)
    max_width: int = _setting(0, 'Width at which Gaussians are added, at most, however large frames are; 0 = any.', 'px', 0)
    silhouette_threshold: float = _setting(0.5, 'Add where the silhouette is below this.', '', 0.0, 1.0)
    depth_error_ratio: float = _setting(
        50.0, 'Also add where the reading is in front of the map by more than this many median errors.', '', 0.0
    )
    opacity: float = _setting(0.5, 'Opacity of a new Gaussian.', '', 0.01, 0.99)
    settle: int = _setting(0, 'Rounds that move new Gaussians along their rays until the rendered depth meets the reading.', '', 0)


@dataclass(frozen=True, slots=True)
class KeyframeConfig:
    """Which frames are kept, and which of them are mapped together (paper, section 3.4)."""

    every: int = _setting(5, 'Keep every n-th frame.', 'frames', 1)
    at_least: int = _setting(
        0, 'Keep more often where a recording is too short to give this many; live the length is not known. 0 = off.', '', 0
    )
    before_last: bool = _setting(False, 'Also keep the last frame but one of a recording.')
    window: int = _setting(24, 'Views in a mapping window, the current frame included.', 'frames', 1)
    selection: str = _setting(
        'overlap',
        'Which kept frames fill the window beside the last: random ones that overlap the current frame, those that overlap '
        'it most, any at random, the latest, or some spread evenly over all.',
        choices=('overlap', 'most_overlap', 'random', 'latest', 'uniform'),
    )
    current_share: float = _setting(
        0.0, 'Share of the steps that fit the current frame; 0 = as many as any other view of the window.', '', 0.0, 1.0
    )
    overlap_samples: int = _setting(1600, 'Pixels sampled to measure overlap with a keyframe.', 'px', 1)
    overlap_margin: int = _setting(20, 'Border of a keyframe in which a sample does not count as seen.', 'px', 0)
    budget: int = _setting(
        0, 'Keyframes at most: where there are more, one whose neighbours in time lie nearest to each other goes; 0 = any '
        'number, which a camera that runs for hours must not have.', 'frames', 0,
    )  # fmt: skip
    on_device: int = _setting(
        100, "Of a GPU: keyframes in its memory at most, those used last, 20 bytes a pixel each; all are in the host's.",
        'frames', 1,
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class MappingConfig:
    """Map refinement and pruning (paper, section 3.4)."""

    mode: str = _setting('sync', 'Map inside each frame.', choices=('sync',))
    enabled: bool = _setting(True, 'Add to the map and refine it; off = only find the camera in a map that was loaded.')
    every: int = _setting(1, 'Densify and refine on every n-th frame.', 'frames', 1)
    hold_out: int = _setting(
        0, 'Keep every n-th frame out of the map, to score it on; its pose is found all the same. 0 = none.', 'frames', 0
    )
    iterations: int = _setting(60, 'Optimisation steps per mapped frame.', '', 0)
    first_iterations: int = _setting(0, 'More steps on the first frame.', '', 0)
    scale: float = _setting(1.0, 'Size at which views are fitted, and kept as keyframes, relative to the frame.', '', 0.1, 1.0)
    max_width: int = _setting(0, 'Width at which views are fitted, at most, however large frames are; 0 = any.', 'px', 0)
    half_size_every: int = _setting(
        0, 'Every n-th step of a frame fits the view at half of its size, for a quarter of the work; 0 = none.', 'steps', 0
    )
    final_passes: int = _setting(
        0, 'After the last frame, how often each keyframe is fitted once more, step sizes fading. Of fused fitting.', '', 0
    )
    anisotropic: bool = _setting(
        False, 'Gaussians with three radii and a rotation instead of one radius; several times slower. Not with fused fitting.'
    )
    optimizer: str = _setting(
        'autograd',
        "The paper's: Adam started anew on every mapped frame; or one native step that renders, compares (Huber, no SSIM) and "
        'moves what is visible.',
        choices=('autograd', 'fused'),
    )
    color_weight: float = _setting(0.5, 'Weight of the colour loss.', '', 0.0)
    depth_weight: float = _setting(1.0, 'Weight of the depth L1.', '', 0.0)
    depth_outlier_ratio: float = _setting(
        0.0, 'Readings count up to this many median depth errors; 0 = all. Not of fused fitting.', '', 0.0
    )
    ssim_weight: float = _setting(0.2, 'Share of 1 - SSIM in the colour loss; the rest is L1. Not of fused fitting.', '', 0.0, 1.0)
    means_rate: float = _setting(1e-4, 'Adam step of the centres.', 'm', 0.0)
    rgb_rate: float = _setting(2.5e-3, 'Adam step of the colours.', '', 0.0)
    opacity_rate: float = _setting(0.05, 'Adam step of the opacity logits.', '', 0.0)
    scale_rate: float = _setting(1e-3, 'Adam step of the log scales.', '', 0.0)
    rotation_rate: float = _setting(1e-3, "Adam step of anisotropic Gaussians' unit quaternions.", '', 0.0)
    prune_every: int = _setting(
        20, 'Prune before every n-th step of a frame; fused fitting, after the last step of each; 0 = never.', 'steps', 0
    )
    prune_from: int = _setting(0, 'First step of a frame that may prune. Not of fused fitting.', 'steps', 0)
    prune_until: int = _setting(20, 'Last step of a frame that may prune or reset opacities. Not of fused fitting.', 'steps', 0)
    prune_opacity: float = _setting(0.005, 'Prune Gaussians fainter than this.', '', 0.0, 1.0)
    prune_last_opacity: float = _setting(
        0.0, 'The same at step prune_until; 0 = as at the others. Not of fused fitting.', '', 0.0, 1.0
    )
    prune_scale: float = _setting(0.1, 'Prune Gaussians wider than this share of the scene radius.', '', 0.0)
    prune_scale_from: int = _setting(0, 'First step of a frame that prunes wide ones too. Not of fused fitting.', 'steps', 0)
    reset_opacity_every: int = _setting(
        0, 'Make all Gaussians 1 % opaque before every n-th step of a frame but the first; 0 = never. Not of fused fitting.',
        'steps', 0,
    )  # fmt: skip
    prune_share: float = _setting(
        0.0, 'Of fused fitting: prune only once this share of the map is to go; the map is copied then.', '', 0.0, 1.0
    )
    scene_radius_ratio: float = _setting(
        3.0, 'Scene radius = deepest reading of the first frame / this; more once a later one sees so far that new Gaussians '
        'would be too wide.', '', 0.1,
    )  # fmt: skip

    def is_held_out(self, index: int) -> bool:
        """Whether a frame, counted from 0, is kept out of the map: frames n - 1, 2n - 1, ..."""
        return self.hold_out > 0 and (index + 1) % self.hold_out == 0

    def num_held_out(self, frames: int) -> int:
        """How many of the first so many frames are kept out of the map."""
        return frames // self.hold_out if self.hold_out else 0


@dataclass(frozen=True, slots=True)
class SlamConfig:
    """Everything that can be set about SLAM. The defaults are the paper's for Replica."""

    seed: int = _setting(0, 'Seed of every random choice.', '', 0)
    width: int = _setting(0, "Of 'splatam run' without --width: wider frames are resized to this width; 0 = as recorded.", 'px', 0)
    threads: int = _setting(0, 'CPU threads; 0 = all cores, 1 = repeatable bit for bit.', '', 0, 256)
    device: str = _setting(
        'auto', 'Where maps live and are computed; auto = on a GPU where torch sees one and triton is there, else cpu.',
        choices=DEVICES,
    )  # fmt: skip
    rasterizer: str = _setting(
        'auto', 'Rasterizer backend; auto = cpu (native) on the processor, triton on a GPU; reference runs on either, slowly.',
        choices=('auto', 'cpu', 'triton', 'reference'),
    )  # fmt: skip
    depth: DepthConfig = field(default_factory=DepthConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    densification: DensificationConfig = field(default_factory=DensificationConfig)
    keyframes: KeyframeConfig = field(default_factory=KeyframeConfig)
    mapping: MappingConfig = field(default_factory=MappingConfig)


def settings() -> list[Setting]:
    """Every leaf of the configuration, in order."""
    return list(_settings(SlamConfig, ''))


def _settings(section: type, prefix: str) -> Iterator[Setting]:
    hints = get_type_hints(section)
    for entry in fields(section):
        if is_dataclass(hints[entry.name]):
            yield from _settings(hints[entry.name], f'{prefix}{entry.name}.')
        else:
            yield Setting(f'{prefix}{entry.name}', hints[entry.name], entry.default, **entry.metadata)


def preset_names() -> list[str]:
    """The presets that ship."""
    return sorted(path.stem for path in (config_dir() / 'presets').glob('*.yaml'))


def load_config(preset: str | None = None, overrides: Mapping[str, object] | Iterable[str] = ()) -> SlamConfig:
    """Defaults, changed by a preset, changed by overrides.

    Args:
        preset: a shipped preset's name, or the path of a YAML file.
        overrides: dotted names to values, or texts ``name=value``.

    Raises:
        ConfigError: an unknown preset or key, or a value that is not allowed.
    """
    values = {} if preset is None else read_values(preset)
    values |= overrides if isinstance(overrides, Mapping) else parse_overrides(overrides)
    return with_values(SlamConfig(), values)


def read_values(preset: str) -> dict[str, object]:
    """What a preset or YAML file sets: dotted names to values, unchecked.

    Raises:
        ConfigError: there is no such preset, or the file is no mapping.
    """
    return _flatten(_read_preset(preset), '')


def parse_overrides(texts: Iterable[str]) -> dict[str, object]:
    """Texts ``name=value`` as dotted names to values, unchecked.

    Raises:
        ConfigError: a text is not of that form.
    """
    return dict(map(_parse_override, texts))


def with_values(config: SlamConfig, values: Mapping[str, object]) -> SlamConfig:
    """The configuration with some leaves, named by dotted path, set anew.

    Raises:
        ConfigError: an unknown name, or a value that is not allowed.
    """
    known = {setting.name: setting for setting in settings()}
    for name, value in values.items():
        if name not in known:
            raise ConfigError(_unknown(name, known))
        config = _replace_leaf(config, name.split('.'), known[name].check(value))
    if not config.depth.min_m < config.depth.max_m:
        raise ConfigError(f'depth.min_m = {config.depth.min_m:g}: expected less than depth.max_m = {config.depth.max_m:g}')
    if config.device == 'cuda' and config.rasterizer == 'cpu':
        raise ConfigError('rasterizer = cpu: runs on the processor, and device = cuda; set rasterizer=auto, or device=cpu')
    if config.mapping.hold_out == 1:
        raise ConfigError('mapping.hold_out = 1: would leave no frame for the map; expected 0 (none) or at least 2')
    if config.mapping.optimizer == 'fused' and config.mapping.anisotropic:
        raise ConfigError(
            'mapping.anisotropic = true: fused fitting knows isotropic Gaussians only; set it to false, or '
            'mapping.optimizer=autograd'
        )
    if config.mapping.optimizer == 'fused':
        _check_fused(config.mapping)
    else:
        _check_not_fused(config.mapping)
    return config


def computed_on(config: SlamConfig, device: str | None) -> SlamConfig:
    """The same SLAM on another device, by that device's own rasterizer; as it was where none is named."""
    return config if device is None else with_values(config, {'device': device, 'rasterizer': 'auto'})


def _check_fused(config: MappingConfig) -> None:
    """Make sure that nothing is asked of fused fitting that it does not do."""
    for name in ('depth_outlier_ratio', 'prune_from', 'prune_last_opacity', 'prune_scale_from', 'reset_opacity_every'):
        if getattr(config, name) > 0:
            raise ConfigError(f'mapping.{name}: fused fitting has none; set it to 0, or mapping.optimizer=autograd')


def _check_not_fused(config: MappingConfig) -> None:
    for name, hint in (('final_passes', "; 'splatam refine' fits a finished map by autograd"), ('prune_share', '')):
        if value := getattr(config, name):
            raise ConfigError(
                f'mapping.{name} = {value:g}: is of fused fitting only; set it to 0, or mapping.optimizer=fused{hint}'
            )


def flat_values(config: SlamConfig) -> dict[str, Value]:
    """Every leaf's value by its dotted name."""
    return {setting.name: _leaf(config, setting.name) for setting in settings()}


def to_yaml(config: SlamConfig) -> str:
    """The whole configuration as YAML that ``load_config`` reads back."""
    tree: dict[str, Any] = {}
    for name, value in flat_values(config).items():
        *sections, leaf = name.split('.')
        branch = tree
        for section in sections:
            branch = branch.setdefault(section, {})
        branch[leaf] = value
    return yaml.safe_dump(tree, sort_keys=False)


def _leaf(config: object, name: str) -> Value:
    for part in name.split('.'):
        config = getattr(config, part)
    return config  # type: ignore[return-value]


def _replace_leaf(config: Any, path: list[str], value: Value) -> Any:
    head, *rest = path
    return replace(config, **{head: _replace_leaf(getattr(config, head), rest, value) if rest else value})


def _read_preset(preset: str) -> dict[str, Any]:
    path = Path(preset) if preset.endswith(('.yaml', '.yml')) else config_dir() / 'presets' / f'{preset}.yaml'
    if not path.is_file():
        raise ConfigError(f"unknown preset '{preset}'; shipped: {', '.join(preset_names())}; or give a .yaml file")
    try:
        values = yaml.safe_load(path.read_text())
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ConfigError(f'{path}: cannot be read: {one_line(error)}') from None
    if not isinstance(values, (dict, type(None))):
        raise ConfigError(f'{path}: expected a mapping of settings')
    return values or {}


def _flatten(tree: Mapping[str, Any], prefix: str) -> dict[str, object]:
    flat: dict[str, object] = {}
    for key, value in tree.items():
        flat |= _flatten(value, f'{prefix}{key}.') if isinstance(value, Mapping) else {f'{prefix}{key}': value}
    return flat


def _parse_override(text: str) -> tuple[str, object]:
    name, equals, value = text.partition('=')
    if not equals:
        raise ConfigError(f"'{text}': expected key=value, for example tracking.iterations=40")
    try:
        return name.strip(), _number(yaml.safe_load(value))
    except yaml.YAMLError:
        raise ConfigError(f"'{text}': the value is not valid YAML") from None


def _number(value: object) -> object:
    """YAML 1.1 reads ``1e-3`` as a text; people mean the number."""
    if isinstance(value, str):
        try:
            return float(value)
        except ValueError:
            return value
    return value


def _unknown(name: str, known: Mapping[str, Setting]) -> str:
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    if not close:
        same_leaf = [candidate for candidate in known if candidate.split('.')[-1] == name.split('.')[-1]]
        close = same_leaf[:1]
    hint = f"; did you mean '{close[0]}'?" if close else f'; known: {", ".join(known)}'
    return f"unknown key '{name}'{hint}"


def apply_threads(config: SlamConfig) -> None:
    """Keep the libraries within the configured threads. For whoever owns the process, once.

    The rasterizer threads itself. Torch gets one thread: its pool spins while it waits, so on cores that others use
    too its many small operations take several times as long with two threads as with one.
    """
    import cv2
    import torch

    torch.set_num_threads(1)
    cv2.setNumThreads(config.threads or len(os.sched_getaffinity(0)))
