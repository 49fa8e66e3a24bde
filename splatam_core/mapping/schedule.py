"""The rhythm of mapping: which frames add Gaussians, refine the map, become keyframes."""

from __future__ import annotations

from dataclasses import dataclass

from splatam_core.config import SlamConfig


@dataclass(frozen=True, slots=True)
class MappingPlan:
    """What one tracked frame is used for. By default for nothing: it leaves the map as it is.

    Attributes:
        is_used: whether the frame may change the map.
        densifies: whether it adds Gaussians.
        steps: optimization steps; None where the map is not refined on this frame.
        first_step: how many steps the frames before it had.
        is_keyframe: whether it is kept.
    """

    is_used: bool = False
    densifies: bool = False
    steps: int | None = None
    is_keyframe: bool = False
    first_step: int = 0


@dataclass(frozen=True, slots=True)
class MappingSchedule:
    """Decides what each frame is used for.

    Attributes:
        config: every setting.
        num_frames: number of frames of the recording; None where that is unknown.
    """

    config: SlamConfig
    num_frames: int | None = None

    def why_not_mapped(self, index: int) -> str:
        """Returns why a frame, counted from 0, leaves the map as it is; empty where it may change it."""
        if not self.config.mapping.enabled:
            return 'mapping.enabled is off'
        return 'this frame is held out of it (mapping.hold_out)' if self.config.mapping.is_held_out(index) else ''

    def plan(self, index: int, visible_fraction: float) -> MappingPlan:
        """Returns what a frame is used for.

        Args:
            index: number of the frame, from 0.
            visible_fraction: fraction of its depth readings at which the map is visible.
        """
        if self.why_not_mapped(index):
            return MappingPlan()
        mapping, densification = self.config.mapping, self.config.densification
        if mapping.hold_out:
            index -= index // mapping.hold_out  # frames held out do not change the rhythm of the others
        num_mapped, remainder = divmod(index, mapping.every)
        is_mapped = remainder == 0
        densifies = num_mapped % densification.every == 0 or visible_fraction < densification.min_visible_fraction
        steps = mapping.iterations + (mapping.first_iterations if index == 0 else 0)
        return MappingPlan(
            is_used=True,
            densifies=is_mapped and densifies,
            steps=steps if is_mapped else None,
            is_keyframe=self.is_keyframe(index),
            first_step=num_mapped * mapping.iterations + (mapping.first_iterations if index > 0 else 0),
        )

    def is_keyframe(self, index: int) -> bool:
        """Whether a frame, counted from 0 among those not held out, is kept."""
        every, at_least = self.config.keyframes.every, self.config.keyframes.at_least
        if self.num_frames is not None and at_least:
            every = min(every, max(1, self.num_frames // at_least))
        return index % every == 0
