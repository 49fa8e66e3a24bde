"""The one configuration: every setting of SLAM, typed, with help text, unit and bounds beside its default.

Defaults are changed by a preset, then by overrides. YAML files, ``--set``, ROS parameters and the tables of the
documentation all derive from the dataclasses below.
"""

from __future__ import annotations

import difflib
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from splatam_core.errors import ConfigError, one_line
from splatam_core.resources import config_dir
from splatam_core.retired_settings import migrated, tombstone
from splatam_core.settings import Setting, Value, flatten, leaf, setting, settings_of, unflatten, with_leaf
from splatam_core.text_files import parse_yaml, read_yaml

MAX_STEPS, MAX_SAMPLES, MAX_FRAMES = 100_000, 1_000_000, 10**9
MAX_PX = 65_536
MAX_GAUSSIANS = 10**9
MAX_SEED = 2**63 - 1
DEVICES = ('auto', 'cpu', 'cuda')
WHERE = frozenset({'device', 'rasterizer', 'threads', 'keyframes.on_device'})
"""Settings that say where SLAM is computed, and do not change its result by more than rounding."""


@dataclass(frozen=True, slots=True)
class DepthConfig:
    """Which depth readings are used."""

    min_m: float = setting(0.2, 'Ignore readings nearer than this. Increase when near readings are wrong.', unit='m', minimum=0.0)
    max_m: float = setting(100.0, 'Ignore readings farther than this. Decrease when far readings are noisy.', unit='m', minimum=0.0)
    edge_filter: float = setting(
        0.0,
        'Ignore readings that differ from a neighbour by more than this fraction of their depth; 0 = off. Set to about 0.05 '
        'when the sensor reports points in the air beside the edges of objects.',
        minimum=0.0, maximum=1.0,
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class PaperTrackingConfig:
    """Settings of the paper's tracker (``tracking.method: render_and_compare``)."""

    rotation_rate: float = setting(4e-4, 'Adam step size of the unit quaternion. Increase when the camera turns fast.', minimum=0.0)
    translation_rate: float = setting(
        2e-3, 'Adam step size of the translation. Increase when the camera moves fast.', unit='m', minimum=0.0
    )
    extend_above_m: float = setting(
        0.0,
        'Take as many steps again when the mean depth error over the image is above this; 0 = never. Decrease when '
        'fast motion leaves frames off.',
        unit='m',
        minimum=0.0,
    )
    use_silhouette: bool = setting(
        True, 'Compare only pixels where the map is opaque. Off: depth at every reading, colour at every pixel.'
    )
    depth_outlier_ratio: float = setting(
        0.0,
        'Ignore pixels whose depth error exceeds this many median errors; 0 = use all. Decrease when wrong readings '
        'spoil the pose.',
        minimum=0.0,
    )
    blended_depth: bool = setting(False, 'Compare the blended depth sum, as the original code does, instead of the expected depth.')


@dataclass(frozen=True, slots=True)
class RelocalisationConfig:
    """How a camera that is lost is found again, wherever in the map it is."""

    enabled: bool = setting(
        False,
        'Find a lost camera anywhere in the map, by the keyframes that show what it sees. Off: only near its last pose. Takes some '
        'milliseconds and up to 60 kB for each keyframe.',
    )
    every: int = setting(
        10,
        'Once the camera is lost for more than 30 frames, look for it on every n-th frame only, and leave the others out. '
        'Increase to save time while it is lost.',
        unit='frames', minimum=1, maximum=MAX_FRAMES,
    )  # fmt: skip
    candidates: int = setting(
        3,
        'Number of places that a frame is aligned to, the most alike first. Increase when many places look alike, for more time '
        'per frame while the camera is lost.',
        minimum=1, maximum=100,
    )  # fmt: skip
    on_lost: str = setting(
        'wait',
        'What happens when the camera stays lost: wait = until it sees a place that it knows; new_map = it starts a new map of the '
        'place it sees, and joins it to the old one when a place of both is recognised. Needs graph.enabled.',
        choices=('wait', 'new_map'),
    )
    new_map_after: int = setting(
        90,
        'A new map starts when the camera was lost for this many frames (on_lost = new_map). Increase when it is often lost for a '
        'while in places that it knows.',
        unit='frames', minimum=1, maximum=MAX_FRAMES,
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class AlignmentConfig:
    """Settings of direct alignment (``tracking.method: align``)."""

    exposure: bool = setting(True, "Estimate a gain and an offset of brightness per frame, for the camera's automatic exposure.")
    time_offset: bool = setting(
        True, 'Estimate the time between the exposures of colour and depth. Switch off for cameras that trigger both at once.'
    )
    rolling_shutter: bool = setting(
        True,
        'Estimate how long the camera takes to read an image, row by row, and align each row as of its time. Switch off for '
        'cameras with a global shutter.',
    )
    features: bool = setting(
        True, 'Where alignment fails, match ORB features between the frame and the map and align again from the pose they give.'
    )
    again_below: float = setting(
        0.0,
        'Render and align a second time when less than this fraction of the pixels agrees; 0 = never. Increase when single '
        'frames are off, for more time per frame.',
        minimum=0.0, maximum=1.0,
    )  # fmt: skip
    half_render_from: int = setting(
        0,
        'Render the map at half size for frames at least this wide; 0 = never. Decrease to save time.',
        unit='px',
        minimum=0,
        maximum=MAX_PX,
    )
    relocalisation: RelocalisationConfig = field(default_factory=RelocalisationConfig)


@dataclass(frozen=True, slots=True)
class TrackingConfig:
    """Camera tracking (paper, section 3.2), and when a frame is lost."""

    method: str = setting(
        'render_and_compare',
        "How the camera is found: render_and_compare = the paper's Adam through the renderer; align = Gauss-Newton alignment to "
        'one render; none = keep the predicted pose; truth = use the ground truth of the recording.',
        choices=('render_and_compare', 'align', 'none', 'truth'),
    )
    iterations: int = setting(
        40, 'Optimization steps per frame; with align, at most this many per resolution. Increase when the camera moves fast.',
        minimum=0, maximum=MAX_STEPS,
    )  # fmt: skip
    scale: float = setting(
        1.0, 'Size at which frames are tracked, relative to the frame. Decrease to save time.', minimum=0.05, maximum=1.0
    )
    color_weight: float = setting(0.5, 'Weight of the colour error. Increase when surfaces are flat and textured.', minimum=0.0)
    depth_weight: float = setting(1.0, 'Weight of the depth error. Decrease when depth is noisy.', minimum=0.0)
    silhouette_threshold: float = setting(
        0.99,
        'Compare only pixels whose rendered silhouette is above this. Decrease when fast turns leave few pixels to compare.',
        minimum=0.0,
        maximum=1.0,
    )
    motion_model: str = setting(
        'constant_velocity',
        'Which pose tracking starts from: constant_velocity = the motion between the last two poses goes on; '
        'last_pose = the last one.',
        choices=('constant_velocity', 'last_pose'),
    )
    min_visible_fraction: float = setting(
        0.2,
        'A frame is lost when the map is visible at less than this fraction of its depth readings. Decrease when '
        'the camera turns fast, increase when wrong poses are taken.',
        minimum=0.0,
        maximum=1.0,
    )
    min_inlier_fraction: float = setting(
        0.5, 'A frame is lost when less than this fraction of those pixels agrees with the map in depth and colour. Decrease when '
        'much of the view moves, increase when wrong poses are taken.',
        minimum=0.0, maximum=1.0,
    )  # fmt: skip
    max_error_m: float = setting(
        0.04,
        'A frame is uncertain when three standard deviations of its position, or of its rotation in radians, exceed this; more is '
        'allowed in images less than some 250 pixels wide (method align). Decrease when a robot must not rely on doubtful poses, '
        'increase when too few frames are tracked.',
        unit='m', minimum=1e-4, maximum=1e3,
    )  # fmt: skip
    min_explained_fraction: float = setting(
        0.33,
        'A frame is uncertain when brightness and depth fit in less than this fraction of the parts of the view that are mapped '
        '(method align). Decrease when much of the view moves.',
        minimum=0.0, maximum=1.0,
    )  # fmt: skip
    inlier_depth: float = setting(
        0.1, 'Depth agrees when it differs by at most this fraction of the reading. Increase when depth is noisy.', minimum=0.0
    )
    inlier_color: float = setting(
        0.2,
        'Colour agrees when it differs by at most this, as a mean over the channels in [0, 1]. Increase when brightness '
        'changes from frame to frame.',
        minimum=0.0,
    )
    paper: PaperTrackingConfig = field(default_factory=PaperTrackingConfig)
    align: AlignmentConfig = field(default_factory=AlignmentConfig)

    @property
    def relocalises(self) -> bool:
        """Whether a lost camera is looked for anywhere in the map."""
        return self.method == 'align' and self.align.relocalisation.enabled


@dataclass(frozen=True, slots=True)
class DensificationConfig:
    """Where a frame adds Gaussians (paper, section 3.3)."""

    every: int = setting(
        1, 'Add Gaussians on every n-th mapped frame. Increase to save time.', unit='frames', minimum=1, maximum=MAX_FRAMES
    )
    min_visible_fraction: float = setting(
        0.0, 'Add on the frames between as well, when the map is visible at less than this fraction of the readings. '
        'Increase when new places are mapped late.',
        minimum=0.0, maximum=1.0,
    )  # fmt: skip
    scale: float = setting(
        1.0, 'Size at which Gaussians are added, relative to the frame. Decrease for fewer, larger Gaussians.',
        minimum=0.05, maximum=1.0,
    )  # fmt: skip
    max_width: int = setting(
        0,
        'Largest width at which Gaussians are added; 0 = no limit. Decrease for fewer, larger Gaussians.',
        unit='px',
        minimum=0,
        maximum=MAX_PX,
    )
    silhouette_threshold: float = setting(
        0.5, 'Add where the rendered silhouette is below this. Increase when the map has gaps.', minimum=0.0, maximum=1.0
    )
    depth_error_ratio: float = setting(
        50.0,
        'Also add where the reading lies in front of the map by more than this many median depth errors. Increase '
        'for fewer Gaussians.',
        minimum=0.0,
    )
    depth_noise_ratio: float = setting(
        0.0,
        'If not 0, replaces depth_error_ratio: also add where the reading lies in front of the map by more than this many '
        'medians of the depth noise at its distance, which grows with the square of the depth. Increase for fewer Gaussians.',
        minimum=0.0,
    )
    opacity: float = setting(
        0.5, 'Opacity of a new Gaussian. Increase when new surfaces look transparent.', minimum=0.01, maximum=0.99
    )
    bias_correction_rounds: int = setting(
        0,
        'Rounds that move new Gaussians along their rays until the rendered depth matches the readings. Increase when new surfaces '
        'are mapped too near or too far.',
        minimum=0,
        maximum=MAX_STEPS,
    )


@dataclass(frozen=True, slots=True)
class KeyframeConfig:
    """Which frames are kept, and which of them are mapped together (paper, section 3.4)."""

    every: int = setting(
        5, 'Keep every n-th frame. Decrease when the camera moves fast.', unit='frames', minimum=1, maximum=MAX_FRAMES
    )
    at_least: int = setting(
        0, 'Keep frames more often when a recording would give fewer keyframes than this; 0 = off. Has no effect live, where the '
        'length is unknown. Increase for short recordings.',
        minimum=0, maximum=MAX_FRAMES,
    )  # fmt: skip
    window: int = setting(
        24, 'Frames that are mapped together, the current one included. Increase when earlier views get worse.',
        unit='frames', minimum=1, maximum=MAX_FRAMES,
    )  # fmt: skip
    selection: str = setting(
        'overlap',
        'How keyframes are chosen for the window, beside the last one: overlap = at random among those that overlap the current '
        'frame; most_overlap = those that overlap it most; random = any; latest = the latest; uniform = spread evenly.',
        choices=('overlap', 'most_overlap', 'random', 'latest', 'uniform'),
    )
    current_share: float = setting(
        0.0,
        'Fraction of the mapping steps that fit the current frame; 0 = as many as every other view of the window. Decrease when '
        'earlier views get worse.',
        minimum=0.0, maximum=1.0,
    )  # fmt: skip
    overlap_samples: int = setting(
        1600,
        'Pixels sampled to measure the overlap with a keyframe. Decrease to save time.',
        unit='px',
        minimum=1,
        maximum=MAX_SAMPLES,
    )
    overlap_margin: int = setting(
        20,
        'Border of a keyframe inside which a sample does not overlap. Decrease for small images.',
        unit='px',
        minimum=0,
        maximum=MAX_PX,
    )
    budget: int = setting(
        0,
        'Largest number of keyframes; beyond it, the one whose neighbours in time are nearest to each other is dropped. '
        '0 = no limit. Set it for runs of hours; decrease to save memory.',
        unit='frames', minimum=0, maximum=MAX_FRAMES,
    )  # fmt: skip
    on_device: int = setting(
        100, 'On a GPU, largest number of keyframes in its memory, at 20 bytes a pixel. Increase when it has memory to spare.',
        unit='frames', minimum=1, maximum=MAX_FRAMES,
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class PaperMappingConfig:
    """Settings of the paper's optimizer (``mapping.optimizer: paper``)."""

    ssim_weight: float = setting(
        0.2,
        'Weight of 1 - SSIM in the colour loss; the rest is the L1 error. Increase for sharper texture.',
        minimum=0.0,
        maximum=1.0,
    )
    depth_outlier_ratio: float = setting(
        0.0,
        'Ignore readings whose depth error exceeds this many median errors; 0 = use all. Decrease when wrong readings '
        'spoil the map.',
        minimum=0.0,
    )
    prune_every: int = setting(
        20, 'Prune at steps 0, n, 2n, ... of a frame; 0 = never. Increase to save time.', unit='steps', minimum=0, maximum=MAX_STEPS
    )
    prune_until: int = setting(
        20, 'Last step of a frame that may prune. Decrease to save time.', unit='steps', minimum=0, maximum=MAX_STEPS
    )


@dataclass(frozen=True, slots=True)
class FusedMappingConfig:
    """Settings of the fused optimizer (``mapping.optimizer: fused``)."""

    final_passes: int = setting(
        0,
        'Passes over all keyframes after the last frame, with decreasing step sizes; twice as many if loops corrected the map, up '
        'to three times as many if there are few keyframes. Increase for a better final map.',
        minimum=0,
        maximum=MAX_STEPS,
    )
    prune_fraction: float = setting(
        0.0,
        'Prune only when more than this fraction of the Gaussians would be removed, because pruning copies the map; 1 = never. '
        'Increase to save time.',
        minimum=0.0, maximum=1.0,
    )  # fmt: skip
    tolerance: float = setting(
        0.0,
        'Parts of a view, 8x8 pixels each, are not fitted further where the map is off by less than this colour error (root mean '
        'square, colours from 0 to 1; an error of depth counts as the loss weighs it), except after the last frame. 0 = all are. '
        'Increase to save time.',
        minimum=0.0, maximum=1.0,
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class MappingConfig:
    """Map refinement and pruning (paper, section 3.4)."""

    enabled: bool = setting(True, 'Add to the map and refine it. Off: only track the camera in a map that was loaded.')
    every: int = setting(1, 'Map every n-th frame. Increase to save time.', unit='frames', minimum=1, maximum=MAX_FRAMES)
    hold_out: int = setting(
        0,
        'Track every n-th frame, but keep it out of the map, to score the map on it; 0 = none. Decrease to score it on '
        'more frames.',
        unit='frames',
        minimum=0,
        maximum=MAX_FRAMES,
    )
    iterations: int = setting(60, 'Optimization steps per mapped frame. Increase for a sharper map.', minimum=0, maximum=MAX_STEPS)
    first_iterations: int = setting(
        0, 'Additional steps on the first frame. Increase when tracking is poor at the start.', minimum=0, maximum=MAX_STEPS
    )
    scale: float = setting(
        1.0,
        'Size at which views are fitted and kept as keyframes, relative to the frame. Decrease to save time and memory.',
        minimum=0.1,
        maximum=1.0,
    )
    max_width: int = setting(
        0, 'Largest width at which views are fitted; 0 = no limit. Decrease to save time.', unit='px', minimum=0, maximum=MAX_PX
    )
    half_size_every: int = setting(
        0, 'Fit the view at half its size in every n-th step, counted over all frames, for a quarter of the work; 0 = never. '
        'Decrease to save time.',
        unit='steps', minimum=0, maximum=MAX_STEPS,
    )  # fmt: skip
    anisotropic: bool = setting(
        False,
        'Use Gaussians with three radii and a rotation instead of one radius. Several times slower. Needs mapping.optimizer paper.',
    )
    optimizer: str = setting(
        'paper',
        'How the map is fitted: paper = Adam through autograd, restarted on every mapped frame; fused = one native step that '
        'renders, compares (Huber loss, no SSIM) and moves the visible Gaussians.',
        choices=('paper', 'fused'),
    )
    max_gaussians: int = setting(
        0,
        'Largest number of Gaussians; beyond it, a tenth of them is dropped, those farthest from the camera. 0 = no limit; set it '
        'for runs of hours in new places. Each takes about 0.1 kB; increase when there is memory to spare.',
        minimum=0, maximum=MAX_GAUSSIANS,
    )  # fmt: skip
    color_weight: float = setting(0.5, 'Weight of the colour loss. Increase when colours are blurred.', minimum=0.0)
    depth_weight: float = setting(1.0, 'Weight of the depth loss. Decrease when depth is noisy.', minimum=0.0)
    means_rate: float = setting(
        1e-4,
        'Adam step size of the centres. Increase when frames have few steps, decrease when the map gets noisy.',
        unit='m',
        minimum=0.0,
    )
    rgb_rate: float = setting(
        2.5e-3, 'Adam step size of the colours. Increase when frames have few steps, decrease when the map gets noisy.', minimum=0.0
    )
    opacity_rate: float = setting(
        0.05,
        'Adam step size of the opacity logits. Increase when frames have few steps, decrease when the map gets noisy.',
        minimum=0.0,
    )
    scale_rate: float = setting(
        1e-3,
        'Adam step size of the log scales. Increase when frames have few steps, decrease when the map gets noisy.',
        minimum=0.0,
    )
    rotation_rate: float = setting(
        1e-3, "Adam step size of anisotropic Gaussians' unit quaternions. Increase when frames have few steps.", minimum=0.0
    )
    prune_opacity: float = setting(
        0.005, 'Prune Gaussians with a lower opacity than this. Increase for fewer Gaussians.', minimum=0.0, maximum=1.0
    )
    prune_scale: float = setting(
        0.1, 'Prune Gaussians wider than this fraction of the scene radius. Decrease when wide Gaussians blur the map.', minimum=0.0
    )
    scene_radius_ratio: float = setting(
        3.0,
        'Scene radius = deepest reading of the first frame divided by this. It grows when a later frame sees so far that new '
        'Gaussians would be pruned as too wide. Increase when wide Gaussians blur the map.',
        minimum=0.1,
    )
    paper: PaperMappingConfig = field(default_factory=PaperMappingConfig)
    fused: FusedMappingConfig = field(default_factory=FusedMappingConfig)

    def is_held_out(self, index: int) -> bool:
        """Whether a frame, counted from 0, is kept out of the map: frames n - 1, 2n - 1, ... of ``hold_out: n``."""
        return self.hold_out > 0 and (index + 1) % self.hold_out == 0


@dataclass(frozen=True, slots=True)
class GraphConfig:
    """The keyframe graph, which corrects poses and map where the camera comes back to a place."""

    enabled: bool = setting(
        False,
        'Keep a graph of the keyframes, recognise places seen before, and correct poses and map where they disagree. Needs a few '
        'milliseconds per frame.',
    )
    loop_after: int = setting(
        150, 'A place is looked for again when it was mapped at least this many frames ago. Decrease when the camera comes back '
        'soon, increase to save time.',
        unit='frames',
        minimum=1, maximum=MAX_FRAMES,
    )  # fmt: skip
    min_correction_m: float = setting(
        0.03,
        'Correct poses and map only when a place is found again farther than this from where it should be, or turned by as many '
        'radians: loops themselves err by one to three centimetres. Increase when corrections disturb the robot.',
        unit='m', minimum=0.0, maximum=1e3,
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class SlamConfig:
    """Every setting of SLAM. The defaults are the paper's for Replica."""

    seed: int = setting(
        0, 'Seed of every random choice. Set another one to see how much a result depends on chance.', minimum=0, maximum=MAX_SEED
    )
    width: int = setting(
        0,
        "Width to which 'splatam run' shrinks wider frames; --width takes precedence; 0 = as recorded. Decrease to save time.",
        unit='px',
        minimum=0,
        maximum=MAX_PX,
    )
    threads: int = setting(
        0, 'CPU threads; 0 = one per core. Results do not depend on it. Set it to keep some cores free for other processes.',
        minimum=0, maximum=256,
    )  # fmt: skip
    device: str = setting(
        'auto', 'Where the map lives and is computed; auto = a GPU where torch sees one and triton is installed, else the CPU.',
        choices=DEVICES,
    )  # fmt: skip
    rasterizer: str = setting(
        'auto', 'Rasterizer backend; auto = cpu (native code) on the CPU, triton on a GPU; reference = slow, runs on either.',
        choices=('auto', 'cpu', 'triton', 'reference'),
    )  # fmt: skip
    depth: DepthConfig = field(default_factory=DepthConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    densification: DensificationConfig = field(default_factory=DensificationConfig)
    keyframes: KeyframeConfig = field(default_factory=KeyframeConfig)
    mapping: MappingConfig = field(default_factory=MappingConfig)
    graph: GraphConfig = field(default_factory=GraphConfig)


SECTION_OF_METHOD = {
    'tracking.method': {'render_and_compare': 'tracking.paper.', 'align': 'tracking.align.'},
    'mapping.optimizer': {'paper': 'mapping.paper.', 'fused': 'mapping.fused.'},
}
"""Which choice each section of settings belongs to."""


@cache
def settings() -> tuple[Setting, ...]:
    """Returns every setting, in order."""
    return tuple(settings_of(SlamConfig))


def preset_names() -> list[str]:
    """Returns the names of the presets that ship."""
    return sorted(path.stem for path in (config_dir() / 'presets').glob('*.yaml'))


def load_config(preset: str | None = None, overrides: Mapping[str, object] | Iterable[str] = ()) -> SlamConfig:
    """Returns the defaults, changed by a preset, then by overrides.

    Args:
        preset: a shipped preset's name, or the path of a YAML file.
        overrides: dotted names to values, or texts ``name=value``.

    Raises:
        ConfigError: a preset or setting is unknown, a value is not allowed, or an override has no effect.
    """
    values = {} if preset is None else read_values(preset)
    chosen = overrides if isinstance(overrides, Mapping) else parse_overrides(overrides)
    before = _changed(SlamConfig(), values)
    after = with_values(before, chosen)
    check_effect(before, after)
    return after


def read_values(preset: str) -> dict[str, object]:
    """Returns what a preset or YAML file sets: dotted names to unchecked values. Names of earlier versions are translated.

    Raises:
        ConfigError: the preset does not exist, the file is no mapping, or it needs a setting that was removed.
    """
    return migrated(flatten(_read_preset(preset)))


def parse_overrides(texts: Iterable[str]) -> dict[str, object]:
    """Returns texts ``name=value`` as dotted names to unchecked values.

    Raises:
        ConfigError: a text is not of that form.
    """
    return dict(map(_parse_override, texts))


def with_values(config: SlamConfig, values: Mapping[str, object]) -> SlamConfig:
    """Returns the configuration with some settings, by dotted name, changed.

    Raises:
        ConfigError: a name is unknown, or a value is not allowed.
    """
    config = _changed(config, values)
    _check_combinations(config)
    return config


def _changed(config: SlamConfig, values: Mapping[str, object]) -> SlamConfig:
    known = {setting.name: setting for setting in settings()}
    for name, value in values.items():
        if name not in known:
            raise ConfigError(_unknown(name, known))
        config = with_leaf(config, name.split('.'), known[name].check(value))
    return config


def check_effect(before: SlamConfig, after: SlamConfig) -> None:
    """Checks that every change is one that the chosen tracker and optimizer use.

    Raises:
        ConfigError: a setting was changed that belongs to a tracker or optimizer that is not in use.
    """
    for selector, sections in SECTION_OF_METHOD.items():
        chosen = leaf(after, selector)
        for choice, section in sections.items():
            for name in (known.name for known in settings() if known.name.startswith(section)):
                if choice != chosen and leaf(before, name) != leaf(after, name):
                    raise ConfigError(
                        f'{name} = {leaf(after, name)}: has no effect with {selector} = {chosen}; '
                        f'set {selector}={choice}, or leave it out'
                    )


def _check_combinations(config: SlamConfig) -> None:
    if 0 < config.width < 16:
        raise ConfigError(f'width = {config.width}: expected 0 (as recorded) or at least 16 (px)')
    if not config.depth.min_m < config.depth.max_m:
        raise ConfigError(f'depth.min_m = {config.depth.min_m:g}: expected less than depth.max_m = {config.depth.max_m:g}')
    if config.tracking.align.relocalisation.on_lost == 'new_map' and not (config.graph.enabled and config.tracking.relocalises):
        raise ConfigError(
            'tracking.align.relocalisation.on_lost = new_map: maps are joined by the keyframe graph; set graph.enabled=true and '
            'tracking.align.relocalisation.enabled=true, or on_lost=wait'
        )
    if config.device == 'cuda' and config.rasterizer == 'cpu':
        raise ConfigError('rasterizer = cpu: runs on the CPU, but device = cuda; set rasterizer=auto, or device=cpu')
    if config.mapping.hold_out == 1:
        raise ConfigError('mapping.hold_out = 1: would leave no frame for the map; expected 0 (none) or at least 2')
    if config.mapping.optimizer == 'fused' and config.mapping.anisotropic:
        raise ConfigError(
            'mapping.anisotropic = true: the fused optimizer supports isotropic Gaussians only; set it to false, or '
            'mapping.optimizer=paper'
        )


def computed_on(config: SlamConfig, device: str | None) -> SlamConfig:
    """Returns the configuration for another device, with that device's own rasterizer; unchanged where device is None."""
    return config if device is None else with_values(config, {'device': device, 'rasterizer': 'auto'})


def flat_values(config: SlamConfig) -> dict[str, Value]:
    """Returns every setting's value by its dotted name."""
    return {setting.name: leaf(config, setting.name) for setting in settings()}


def to_yaml(config: SlamConfig) -> str:
    """Returns the whole configuration as YAML that ``load_config`` reads back."""
    return yaml.safe_dump(unflatten(flat_values(config)), sort_keys=False)


def _read_preset(preset: str) -> dict[str, Any]:
    path = Path(preset) if preset.endswith(('.yaml', '.yml')) else config_dir() / 'presets' / f'{preset}.yaml'
    if not os.path.isfile(path):  # False for impossible names, too
        raise ConfigError(f"unknown preset '{preset}'; shipped: {', '.join(preset_names())}; or give a .yaml file")
    values = read_yaml(path, ConfigError)
    if not isinstance(values, (dict, type(None))):
        raise ConfigError(f'{path}: expected a mapping of settings')
    return values or {}


def _parse_override(text: str) -> tuple[str, object]:
    name, equals, value = text.partition('=')
    if not equals:
        raise ConfigError(f"'{one_line(text)}': expected key=value, for example tracking.iterations=40")
    try:
        return name.strip(), _number(parse_yaml(value))
    except ValueError:
        raise ConfigError(f"'{one_line(text)}': the value is not valid YAML") from None


def _number(value: object) -> object:
    """YAML 1.1 reads ``1e-3`` as a text; people mean the number."""
    if isinstance(value, str):
        try:
            return float(value)
        except ValueError:
            return value
    return value


def _unknown(name: str, known: Mapping[str, Setting]) -> str:
    if retired := tombstone(name):
        return retired
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    if not close:
        same_leaf = [candidate for candidate in known if candidate.split('.')[-1] == name.split('.')[-1]]
        close = same_leaf[:1]
    hint = f"; did you mean '{close[0]}'?" if close else f'; known: {", ".join(known)}'
    return f"unknown key '{name}'{hint}"


def apply_threads(config: SlamConfig) -> None:
    """Limits the libraries to the configured threads. For whoever owns the process, once.

    The rasterizer has its own threads. Torch gets one: its pool spins while it waits, so on busy cores its many small
    operations take several times as long with two threads as with one.
    """
    import cv2
    import torch

    torch.set_num_threads(1)
    cv2.setNumThreads(config.threads or len(os.sched_getaffinity(0)))
