"""The numbers of a run, ``metrics.json``. docs/evaluation.md defines each number; null means that it is not known."""

from __future__ import annotations

import json
import math
import random
from array import array
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatam_core.errors import RunFolderError, one_line
from splatam_core.runs.frame_records import STAGES, FrameRecord
from splatam_core.types import Status

MAX_TIMINGS = 1 << 17
"""Largest number of frames whose timings are kept, for their percentiles: 5 MiB. Longer runs keep a random sample."""


@dataclass(frozen=True, slots=True)
class ImageScores:
    """Scores of one view, or their mean over views.

    Attributes:
        psnr_db: of the colour over the pixels with a depth reading; None where there is no such pixel.
        ssim: over the same pixels.
        depth_l1_m: mean absolute difference to the reading; a pixel that renders no depth differs by the whole reading.
        psnr_full_db: of the colour over the whole image, holes included.
        depth_rmse_m: root of the mean squared difference to the reading.
        ms_ssim: of whole images; None where they are too small for it.
        lpips: of whole images; None where its weights are not installed.
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
    """What SplaTAM's own evaluation computes: both images are black where there is no reading, and those pixels count.

    Attributes:
        psnr_db: mean of the channels' PSNR; the render is not clamped.
        ms_ssim: which the original prints as "SSIM".
        lpips: of AlexNet.
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
    """All numbers of a run.

    Attributes:
        frames: number of frames processed.
        tracked: number of frames with a pose that may be trusted, the first included.
        lost: number of frames without a pose.
        fps: frames / time spent in SLAM, decoding excluded.
        fps_with_io: frames / time spent in SLAM and decoding; None where another thread decoded during SLAM.
        num_gaussians: size of the final map; None where it was not saved.
        peak_rss_mb: largest memory of the process, MiB.
        timings_ms: wall time of each stage over the frames.
        finish_s: wall time of the final passes over the keyframes after the last frame; both rates include it.
        peak_gpu_mb: largest memory of its tensors on a GPU, MiB; None where no GPU was used.
        uncertain: number of frames with a pose that may be wrong; they are not mapped.
        relocalised: number of times that the camera was found anew in the map.
        ate_rmse_m: root mean squared distance of the camera centres to the ground truth, all frames with a pose, SE(3)-aligned.
        ate_frames: number of frames with a pose and ground truth, which enter ``ate_rmse_m``.
        ate_tracked_rmse_m: the same over the tracked frames alone, aligned by themselves.
        worst_error_m: largest distance of a tracked frame's camera centre to the ground truth, aligned as ``ate_tracked_rmse_m``.
        false_tracked: number of tracked frames that are farther off than 10 cm and than three standard deviations.
        splatam_ate_mean_m: what the original prints as "ATE RMSE".
        rpe_trans_frame_m: relative pose error from frame to frame, RMSE of the translation.
        rpe_rot_frame_deg: of the rotation.
        rpe_frame_pairs: number of pairs of frames that entered.
        rpe_trans_1s_m: the same over one second.
        rpe_rot_1s_deg: of the rotation.
        rpe_1s_pairs: number of pairs of frames that entered.
        psnr_db: final map rendered at the estimated poses, over the pixels with a depth reading, mean over frames.
        ssim: over the same pixels.
        depth_l1_m: of the expected depth, over the same pixels.
        psnr_full_db: over whole images, holes included.
        depth_rmse_m: of the expected depth, over the pixels with a reading.
        ms_ssim: of whole images.
        lpips: of whole images.
        evaluated_every: every n-th frame entered the seven above; None before the evaluation.
        evaluated_frames: number of frames that entered them.
        splatam: the same frames, scored as the original does.
        heldout_frames: number of frames in ``heldout``; None where no frame was held out.
        heldout: scores of the frames held out of the map, at their estimated poses.
        novel_alignment: how the ground truth of a test split was aligned to the map: ``trajectory`` or ``first``.
        novel_frames: number of test views without holes, which entered ``novel``.
        novel: their scores, at their true poses.
        novel_holes_frames: number of test views with holes.
        novel_holes: their scores.
        splatam_novel: the views without holes, scored as the original does.
        ate_final_rmse_m: ``ate_rmse_m`` of the poses after all corrections of the keyframe graph.
        loops: number of places that were recognised; None without a graph.
        corrections: number of times that poses and map were corrected by them.
        notes: why a number is null, by its name, where that is not obvious.
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
    uncertain: int = 0
    relocalised: int = 0
    ate_rmse_m: float | None = None
    ate_frames: int | None = None
    ate_tracked_rmse_m: float | None = None
    worst_error_m: float | None = None
    false_tracked: int | None = None
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
    ate_final_rmse_m: float | None = None
    loops: int | None = None
    corrections: int | None = None
    notes: Mapping[str, str] = field(default_factory=dict)

    def values(self) -> dict[str, Any]:
        """Returns every number by its name in ``metrics.json``; scores of a group have the group's name in front."""
        flat: dict[str, Any] = {}
        for entry in fields(self):
            value = getattr(self, entry.name)
            if entry.name in GROUPS:
                flat |= {f'{entry.name}_{name}': score for name, score in asdict(value).items()}
            else:
                flat[entry.name] = value
        return flat

    def to_json(self) -> str:
        """Returns the text of ``metrics.json``."""
        values = {name: None if _is_beyond_numbers(value) else value for name, value in self.values().items()}
        values['timings_ms'] = {name: asdict(stage) for name, stage in self.timings_ms.items()}
        values['notes'] = dict(self.notes)
        return json.dumps(values, indent=2, allow_nan=False) + '\n'

    @classmethod
    def from_json(cls, text: str) -> Metrics:
        """Reads what ``to_json`` wrote; unknown names, of other versions, are ignored.

        Raises:
            RunFolderError: the text is no JSON object, or a required number is missing.
        """
        try:
            values = json.loads(text)
            known = {entry.name: values[entry.name] for entry in fields(cls) if entry.name in values}
            known |= {name: _group(name, kind, values) for name, kind in GROUPS.items()}
            known['timings_ms'] = {name: StageStatistics(**stage) for name, stage in known['timings_ms'].items()}
            metrics = cls(**known)
            metrics._check()
            return metrics
        except Exception as error:  # noqa: BLE001 - whatever the file holds, it is refused in one line
            raise RunFolderError(f'metrics.json cannot be read: {one_line(error)}; delete it and evaluate again') from None

    def _check(self) -> None:
        """Raises ValueError where a value is not of its kind."""
        values = self.values() | {f'timings_ms.{name}': stage.median for name, stage in self.timings_ms.items()}
        values |= {f'timings_ms.{name}.p95': stage.p95 for name, stage in self.timings_ms.items()}
        counts, other = ('frames', 'tracked', 'uncertain', 'lost', 'relocalised'), ('timings_ms', 'notes', 'novel_alignment')
        for name, value in values.items():
            is_number = type(value) in (int, float) and math.isfinite(value)
            is_right = type(value) is int if name in counts else value is None or is_number
            if name not in other and not is_right:
                raise ValueError(f'{name} = {value!r}')
        if not isinstance(self.notes, dict) or not all(isinstance(note, str) for note in self.notes.values()):
            raise ValueError(f'notes = {self.notes!r}')
        if not isinstance(self.novel_alignment, str | None):
            raise ValueError(f'novel_alignment = {self.novel_alignment!r}')


def _is_beyond_numbers(value: object) -> bool:
    return isinstance(value, float) and not math.isfinite(value)


GROUPS: Mapping[str, type[ImageScores] | type[OriginalScores]] = {
    'splatam': OriginalScores, 'heldout': ImageScores, 'novel': ImageScores, 'novel_holes': ImageScores,
    'splatam_novel': OriginalScores,
}  # fmt: skip
"""The fields of ``Metrics`` that are written as one number per score, to their types."""


def _group(name: str, kind: type[ImageScores] | type[OriginalScores], values: Mapping[str, Any]) -> ImageScores | OriginalScores:
    return kind(**{entry.name: values.get(f'{name}_{entry.name}') for entry in fields(kind)})


class FrameStatistics:
    """What ``Metrics`` says of the frames of a run, gathered frame by frame in bounded memory.

    Attributes:
        frames: number of frames.
        uncertain: number of frames with a pose that may be wrong.
        lost: number of frames without a pose.
        relocalised: number of times that the camera was found anew.
    """

    def __init__(self, records: Iterable[FrameRecord] = ()) -> None:
        self.frames = self.uncertain = self.lost = self.relocalised = 0
        self._process_ms = self._decode_ms = 0.0
        self._num_decoded = 0
        self._timings = array('d')  # of all frames, or of so many drawn at random
        self._random = random.Random(0)
        for record in records:
            self.add(record)

    def add(self, record: FrameRecord) -> None:
        """Adds the next frame."""
        timings = array('d', (getattr(record.timings, stage) for stage in STAGES))
        if self.frames < MAX_TIMINGS:
            self._timings.extend(timings)
        elif (place := self._random.randrange(self.frames + 1)) < MAX_TIMINGS:  # Vitter 1985, algorithm R
            self._timings[place * len(STAGES) : (place + 1) * len(STAGES)] = timings
        self.frames += 1
        self.uncertain += record.status is Status.UNCERTAIN
        self.lost += record.status is Status.LOST
        self.relocalised += record.is_relocalised
        self._process_ms += record.process_ms
        if record.decode_ms is not None:
            self._decode_ms += record.decode_ms
            self._num_decoded += 1

    def metrics(
        self, num_gaussians: int | None = None, peak_rss_mb: float | None = None, *,
        peak_gpu_mb: float | None = None, finish_s: float = 0.0,
    ) -> Metrics:  # fmt: skip
        """Returns the metrics that need no ground truth. Arguments: see ``run_metrics``."""
        process_ms = self._process_ms + 1e3 * finish_s
        return Metrics(
            frames=self.frames,
            tracked=self.frames - self.uncertain - self.lost,
            uncertain=self.uncertain,
            lost=self.lost,
            relocalised=self.relocalised,
            fps=_rate(self.frames, process_ms),
            fps_with_io=_rate(self.frames, process_ms + self._decode_ms if self._num_decoded == self.frames else 0.0),
            num_gaussians=num_gaussians,
            peak_rss_mb=peak_rss_mb,
            timings_ms=self._stage_statistics(),
            finish_s=round(finish_s, 3),
            peak_gpu_mb=peak_gpu_mb,
        )

    def _table(self) -> NDArray[np.float64]:
        return np.frombuffer(self._timings, np.float64).reshape(-1, len(STAGES))  # [frames, stages]

    def _stage_statistics(self) -> dict[str, StageStatistics]:
        """Returns median and 95th percentile of each stage over the frames; empty without frames."""
        if not self._timings:
            return {}
        median, p95 = np.percentile(self._table(), [50, 95], axis=0)
        return {stage: StageStatistics(round(float(m), 3), round(float(p), 3)) for stage, m, p in zip(STAGES, median, p95)}


def run_metrics(
    records: Iterable[FrameRecord], num_gaussians: int | None = None, peak_rss_mb: float | None = None, *,
    peak_gpu_mb: float | None = None, finish_s: float = 0.0,
) -> Metrics:  # fmt: skip
    """Returns the metrics that need no ground truth.

    Args:
        records: the frames of the run.
        num_gaussians: size of the final map; None where it was not saved.
        peak_rss_mb: largest memory of the process, MiB; None where unknown.
        peak_gpu_mb: largest memory on a GPU, MiB; None where no GPU was used.
        finish_s: wall time in ``Slam.finish``.
    """
    return FrameStatistics(records).metrics(num_gaussians, peak_rss_mb, peak_gpu_mb=peak_gpu_mb, finish_s=finish_s)


def _rate(frames: int, wall_ms: float) -> float | None:
    return round(frames / wall_ms * 1e3, 3) if wall_ms > 0 else None
