"""The numbers of a run, ``metrics.json``. What each of them means is fixed; null is 'cannot be known'."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields

import numpy as np

from splatam_core.errors import RunFolderError
from splatam_core.types import StageTimings

STAGES = tuple(entry.name for entry in fields(StageTimings))


@dataclass(frozen=True, slots=True)
class StageStatistics:
    """Wall time of one stage over the frames, milliseconds."""

    median: float
    p95: float


@dataclass(frozen=True, slots=True)
class Metrics:
    """What a run is judged by.

    Attributes:
        frames: frames processed.
        tracked: those with a pose, the first included.
        lost: those without.
        fps: frames / time spent in SLAM, decoding excluded.
        fps_with_io: frames / that time and the time spent decoding; None where decoding went on beside SLAM.
        num_gaussians: size of the final map; None where it was not saved.
        peak_rss_mb: most memory the process held, MiB.
        timings_ms: wall time of each stage over the frames.
        ate_rmse_m: root mean squared distance of the camera centres to the truth, all tracked frames, SE(3)-aligned.
        ate_frames: tracked frames that have a truth and thus enter ``ate_rmse_m``.
        psnr_db: final map rendered at the estimated poses, over the pixels with a depth reading, mean over frames.
        ssim: likewise.
        depth_l1_m: likewise, of the expected depth.
        psnr_full_db: over whole images, holes included.
        evaluated_every: every n-th frame entered the four above; None before they are evaluated.
        evaluated_frames: frames that entered the four above.
    """

    frames: int
    tracked: int
    lost: int
    fps: float | None
    fps_with_io: float | None
    num_gaussians: int | None
    peak_rss_mb: float | None
    timings_ms: Mapping[str, StageStatistics]
    ate_rmse_m: float | None = None
    ate_frames: int | None = None
    psnr_db: float | None = None
    ssim: float | None = None
    depth_l1_m: float | None = None
    psnr_full_db: float | None = None
    evaluated_every: int | None = None
    evaluated_frames: int | None = None

    def to_json(self) -> str:
        """As the text of ``metrics.json``."""
        return json.dumps(asdict(self), indent=2, allow_nan=False) + '\n'

    @classmethod
    def from_json(cls, text: str) -> Metrics:
        """Read back what ``to_json`` wrote; names of other versions are passed over.

        Raises:
            RunFolderError: the text is no JSON object, or lacks a name.
        """
        try:
            values = json.loads(text)
            known = {entry.name: values[entry.name] for entry in fields(cls) if entry.name in values}
            known['timings_ms'] = {name: StageStatistics(**stage) for name, stage in known['timings_ms'].items()}
            return cls(**known)
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise RunFolderError(f'metrics.json cannot be read: {error}; delete it and evaluate again') from None


def stage_statistics(timings: Sequence[StageTimings]) -> dict[str, StageStatistics]:
    """Median and 95th percentile of each stage; empty without frames."""
    if not timings:
        return {}
    table = np.array([[getattr(frame, stage) for stage in STAGES] for frame in timings])  # [frames, stages]
    median, p95 = np.percentile(table, [50, 95], axis=0)
    return {stage: StageStatistics(round(float(m), 3), round(float(p), 3)) for stage, m, p in zip(STAGES, median, p95)}
