"""The numbers of a run, ``metrics.json``. What each of them means is fixed; null is 'cannot be known'."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from typing import Any

import numpy as np

from splatam_core.errors import RunFolderError
from splatam_core.types import StageTimings

STAGES = tuple(entry.name for entry in fields(StageTimings))


@dataclass(frozen=True, slots=True)
class ImageScores:
    """One view's scores, or their mean over views.

    Attributes:
        psnr_db: of the colour over the pixels with a depth reading; None where there is no such pixel.
        ssim: likewise.
        depth_l1_m: mean absolute difference to the reading; a pixel that renders no depth differs by all of it.
        psnr_full_db: of the colour over the whole image, holes included.
        depth_rmse_m: root of the mean squared difference to the reading.
        ms_ssim: of whole images; None where they are too small for it.
        lpips: of whole images; None where it cannot be had.
    """

    psnr_db: float | None = None
    ssim: float | None = None
    depth_l1_m: float | None = None
    psnr_full_db: float | None = None
    depth_rmse_m: float | None = None
    ms_ssim: float | None = None
    lpips: float | None = None


@dataclass(frozen=True, slots=True)
class OriginalScores:
    """What SplaTAM's evaluation computes: both images black where there is no reading, and those pixels count.

    Attributes:
        psnr_db: mean of the channels' PSNR, the render not clamped.
        ms_ssim: which the original prints as "SSIM".
        lpips: AlexNet.
        depth_l1_m: of the sum of ``w z``, not divided by the silhouette; the original prints it as "Depth RMSE" too.
    """

    psnr_db: float | None = None
    ms_ssim: float | None = None
    lpips: float | None = None
    depth_l1_m: float | None = None


@dataclass(frozen=True, slots=True)
class StageStatistics:
    """Wall time of one stage over the frames, milliseconds."""

    median: float
    p95: float


@dataclass(frozen=True, slots=True)
class Metrics:
    """What a run is judged by; docs/evaluation.md defines each number.

    Attributes:
        frames: frames processed.
        tracked: those with a pose, the first included.
        lost: those without.
        fps: frames / time spent in SLAM, decoding excluded.
        fps_with_io: frames / that time and the time spent decoding; None where decoding went on beside SLAM.
        num_gaussians: size of the final map; None where it was not saved.
        peak_rss_mb: most memory the process held, MiB.
        timings_ms: wall time of each stage over the frames.
        finish_s: wall time of fitting the map once more after the last frame; the two rates count it.
        peak_gpu_mb: most memory its tensors took on a GPU, MiB; None where there were none.
        ate_rmse_m: root mean squared distance of the camera centres to the truth, all tracked frames, SE(3)-aligned.
        ate_frames: tracked frames that have a truth and thus enter ``ate_rmse_m``.
        splatam_ate_mean_m: what the original prints as "ATE RMSE".
        rpe_trans_frame_m: relative pose error from frame to frame, RMSE of the translation.
        rpe_rot_frame_deg: of the rotation.
        rpe_frame_pairs: pairs of frames that entered.
        rpe_trans_1s_m: the same over one second.
        rpe_rot_1s_deg: of the rotation.
        rpe_1s_pairs: pairs of frames that entered.
        psnr_db: final map rendered at the estimated poses, over the pixels with a depth reading, mean over frames.
        ssim: likewise.
        depth_l1_m: likewise, of the expected depth.
        psnr_full_db: over whole images, holes included.
        depth_rmse_m: of the expected depth, over the pixels with a reading.
        ms_ssim: of whole images.
        lpips: of whole images.
        evaluated_every: every n-th frame entered the seven above; None before they are evaluated.
        evaluated_frames: frames that entered them.
        splatam: the same frames, scored as the original does.
        heldout_frames: frames kept out of the map that entered ``heldout``; None where there are none.
        heldout: the scores of those, at their estimated poses.
        novel_alignment: how the truth of a test split was brought into the map: ``trajectory`` or ``first``.
        novel_frames: its views without holes, which entered ``novel``.
        novel: their scores, at their true poses.
        novel_holes_frames: its views with holes.
        novel_holes: their scores.
        splatam_novel: the views without holes, scored as the original does.
        notes: why a number is null, by its name, where that needs saying.
    """

    frames: int
    tracked: int
    lost: int
    fps: float | None
    fps_with_io: float | None
    num_gaussians: int | None
    peak_rss_mb: float | None
    timings_ms: Mapping[str, StageStatistics]
    finish_s: float = 0.0
    peak_gpu_mb: float | None = None
    ate_rmse_m: float | None = None
    ate_frames: int | None = None
    splatam_ate_mean_m: float | None = None
    rpe_trans_frame_m: float | None = None
    rpe_rot_frame_deg: float | None = None
    rpe_frame_pairs: int | None = None
    rpe_trans_1s_m: float | None = None
    rpe_rot_1s_deg: float | None = None
    rpe_1s_pairs: int | None = None
    psnr_db: float | None = None
    ssim: float | None = None
    depth_l1_m: float | None = None
    psnr_full_db: float | None = None
    depth_rmse_m: float | None = None
    ms_ssim: float | None = None
    lpips: float | None = None
    evaluated_every: int | None = None
    evaluated_frames: int | None = None
    splatam: OriginalScores = OriginalScores()
    heldout_frames: int | None = None
    heldout: ImageScores = ImageScores()
    novel_alignment: str | None = None
    novel_frames: int | None = None
    novel: ImageScores = ImageScores()
    novel_holes_frames: int | None = None
    novel_holes: ImageScores = ImageScores()
    splatam_novel: OriginalScores = OriginalScores()
    notes: Mapping[str, str] = field(default_factory=dict)

    def values(self) -> dict[str, Any]:
        """Every number by its name in ``metrics.json``: a group's scores carry its name in front."""
        flat: dict[str, Any] = {}
        for entry in fields(self):
            value = getattr(self, entry.name)
            if entry.name in GROUPS:
                flat |= {f'{entry.name}_{name}': score for name, score in asdict(value).items()}
            else:
                flat[entry.name] = value
        return flat

    def to_json(self) -> str:
        """As the text of ``metrics.json``."""
        values = self.values()
        values['timings_ms'] = {name: asdict(stage) for name, stage in self.timings_ms.items()}
        values['notes'] = dict(self.notes)
        return json.dumps(values, indent=2, allow_nan=False) + '\n'

    @classmethod
    def from_json(cls, text: str) -> Metrics:
        """Read back what ``to_json`` wrote; names of other versions are passed over.

        Raises:
            RunFolderError: the text is no JSON object, or lacks a name.
        """
        try:
            values = json.loads(text)
            known = {entry.name: values[entry.name] for entry in fields(cls) if entry.name in values}
            known |= {name: _group(name, kind, values) for name, kind in GROUPS.items()}
            known['timings_ms'] = {name: StageStatistics(**stage) for name, stage in known['timings_ms'].items()}
            return cls(**known)
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise RunFolderError(f'metrics.json cannot be read: {error}; delete it and evaluate again') from None


GROUPS = {
    'splatam': OriginalScores, 'heldout': ImageScores, 'novel': ImageScores, 'novel_holes': ImageScores,
    'splatam_novel': OriginalScores,
}  # fmt: skip


def _group(name: str, kind: type[ImageScores | OriginalScores], values: Mapping[str, Any]) -> ImageScores | OriginalScores:
    return kind(**{entry.name: values.get(f'{name}_{entry.name}') for entry in fields(kind)})


def stage_statistics(timings: Sequence[StageTimings]) -> dict[str, StageStatistics]:
    """Median and 95th percentile of each stage; empty without frames."""
    if not timings:
        return {}
    table = np.array([[getattr(frame, stage) for stage in STAGES] for frame in timings])  # [frames, stages]
    median, p95 = np.percentile(table, [50, 95], axis=0)
    return {stage: StageStatistics(round(float(m), 3), round(float(p), 3)) for stage, m, p in zip(STAGES, median, p95)}
