"""Settings that were renamed or removed: what to use instead, and how files of earlier versions are read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from splatam_core.errors import ConfigError

RENAMED = {
    # 0.2.0: settings of one tracker or one optimizer moved into a section of its own.
    'tracking.extend_above_m': 'tracking.paper.extend_above_m',
    'tracking.rotation_rate': 'tracking.paper.rotation_rate',
    'tracking.translation_rate': 'tracking.paper.translation_rate',
    'tracking.use_silhouette': 'tracking.paper.use_silhouette',
    'tracking.depth_outlier_ratio': 'tracking.paper.depth_outlier_ratio',
    'tracking.blended_depth': 'tracking.paper.blended_depth',
    'tracking.exposure': 'tracking.align.exposure',
    'tracking.lag': 'tracking.align.time_offset',
    'tracking.features': 'tracking.align.features',
    'tracking.again_below': 'tracking.align.again_below',
    'tracking.half_render_from': 'tracking.align.half_render_from',
    'tracking.min_sure_fraction': 'tracking.min_visible_fraction',
    'densification.when_unsure': 'densification.min_visible_fraction',
    'densification.settle': 'densification.bias_correction_rounds',
    'mapping.ssim_weight': 'mapping.paper.ssim_weight',
    'mapping.depth_outlier_ratio': 'mapping.paper.depth_outlier_ratio',
    'mapping.prune_every': 'mapping.paper.prune_every',
    'mapping.prune_until': 'mapping.paper.prune_until',
    'mapping.final_passes': 'mapping.fused.final_passes',
    'mapping.prune_share': 'mapping.fused.prune_fraction',
}
"""Old dotted name to new."""


@dataclass(frozen=True, slots=True)
class Removed:
    """A setting that is gone.

    Attributes:
        default: its last default. A file that states this value means what is done now.
        instead: what to use instead.
    """

    default: object
    instead: str


_SCHEDULE = 'steps 0, mapping.paper.prune_every, ... of a frame prune, up to step mapping.paper.prune_until'
REMOVED = {
    'mapping.mode': Removed('sync', 'mapping always runs inside each frame'),
    'mapping.prune_from': Removed(0, _SCHEDULE),
    'mapping.prune_last_opacity': Removed(0.0, 'mapping.prune_opacity is the limit at every step'),
    'mapping.prune_scale_from': Removed(0, _SCHEDULE),
    'mapping.reset_opacity_every': Removed(0, "'splatam refine --densify' resets opacities in a finished map"),
    'keyframes.before_last': Removed(False, 'keyframes.every decides alone which frames are kept'),
}

RENAMED_VALUES = {('mapping.optimizer', 'autograd'): 'paper'}
"""Setting and old value to the new value."""


def migrated(values: Mapping[str, object]) -> dict[str, object]:
    """Translates the settings of a file that an earlier version may have written.

    Args:
        values: dotted names to values.

    Returns:
        The same settings under their present names. A removed setting is left out where it has its last default.

    Raises:
        ConfigError: a removed setting has another value than its last default.
    """
    result: dict[str, object] = {}
    for name, value in values.items():
        if name in REMOVED:
            if value != REMOVED[name].default:
                raise ConfigError(f'{name} = {value}: {_removed(name)}')
            continue
        result[RENAMED.get(name, name)] = RENAMED_VALUES.get((name, value), value) if isinstance(value, str) else value
    if values.get('mapping.optimizer') == 'fused' and values.get('mapping.prune_every') == 0:
        result['mapping.fused.prune_fraction'] = 1.0  # the fused optimizer never pruned then
    return result


def tombstone(name: str) -> str:
    """What to say to somebody who uses a retired name; empty where the name never existed."""
    if name in RENAMED:
        return f"'{name}' is now '{RENAMED[name]}'"
    return _removed(name) if name in REMOVED else ''


def _removed(name: str) -> str:
    return f"'{name}' was removed in 0.2.0: {REMOVED[name].instead}"
