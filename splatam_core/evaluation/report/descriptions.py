"""Label, unit and meaning of each number of ``metrics.json``, for tables that people read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from splatam_core.runs.metrics import Metrics


@dataclass(frozen=True, slots=True)
class Description:
    """How one number is shown.

    Attributes:
        name: its name in ``metrics.json``.
        label: its name for people.
        unit: the unit it is shown in.
        factor: converts the stored unit to the shown one.
        form: format specification of the shown value.
        meaning: one sentence; docs/evaluation.md has the full definition.
    """

    name: str
    label: str
    unit: str
    factor: float
    form: str
    meaning: str

    def text(self, metrics: Metrics) -> str:
        """Return the number as text without its unit; an en dash if it is not known."""
        value = metrics.values()[self.name]
        if value is None:
            return '\u2013'
        return value if isinstance(value, str) else self.form_of(value)

    def form_of(self, value: float) -> str:
        """Return a stored number as text without its unit; the mean of two counts is rounded."""
        shown = value * self.factor
        return f'{round(shown) if self.form.endswith("d") else shown:{self.form}}'


def _image_scores(prefix: str, of: str) -> list[Description]:
    return [
        Description(f'{prefix}psnr_db', 'PSNR', 'dB', 1, '.2f', f'Colour, {of}, over the pixels with a depth reading.'),
        Description(f'{prefix}psnr_full_db', 'PSNR, whole image', 'dB', 1, '.2f', f'Colour, {of}, holes included.'),
        Description(
            f'{prefix}ssim', 'SSIM', '', 1, '.4f',
            'Structural similarity over the pixels with a depth reading; 1 = equal.',
        ),
        Description(
            f'{prefix}ms_ssim', 'MS-SSIM', '', 1, '.4f',
            'Structural similarity at five scales, over whole images; 1 = equal.',
        ),
        Description(f'{prefix}lpips', 'LPIPS', '', 1, '.4f', 'Learned image distance (AlexNet), over whole images; 0 = equal.'),
        Description(f'{prefix}depth_l1_m', 'depth L1', 'cm', 100, '.2f', 'Mean absolute difference of the depth to the readings.'),
        Description(
            f'{prefix}depth_rmse_m', 'depth RMSE', 'cm', 100, '.2f',
            'Root mean squared difference of the depth to the readings.',
        ),
    ]  # fmt: skip


def _original_scores(prefix: str) -> list[Description]:
    return [
        Description(
            f'{prefix}psnr_db', 'PSNR, masked', 'dB', 1, '.2f',
            'Pixels without a depth reading are black in both images and count as perfect.',
        ),
        Description(f'{prefix}ms_ssim', 'MS-SSIM, masked', '', 1, '.4f', 'The original prints it as "SSIM".'),
        Description(f'{prefix}lpips', 'LPIPS, masked', '', 1, '.4f', 'AlexNet, on the masked images.'),
        Description(
            f'{prefix}depth_l1_m', 'depth L1, unnormalised', 'cm', 100, '.2f',
            'Of the blended depth, not divided by the silhouette; the original also prints it as "Depth RMSE".',
        ),
    ]  # fmt: skip


DESCRIPTIONS: dict[str, Sequence[Description]] = {
    'Run': (
        Description('frames', 'frames', '', 1, ',d', 'Frames processed.'),
        Description('tracked', 'tracked', '', 1, ',d', 'Frames with a pose that may be trusted, including the first.'),
        Description('uncertain', 'uncertain', '', 1, ',d', 'Frames with a pose that may be wrong; they are not mapped.'),
        Description('lost', 'lost', '', 1, ',d', 'Frames without a pose; they do not change the map.'),
        Description('relocalised', 'relocalised', '', 1, ',d', 'Times that a lost camera was found anew, anywhere in the map.'),
        Description('fps', 'speed', 'fps', 1, '.2f', 'Frames divided by the time spent in SLAM, without decoding.'),
        Description(
            'fps_with_io', 'speed with decoding', 'fps', 1, '.2f',
            'Frames divided by the time spent in SLAM and decoding.',
        ),
        Description(
            'finish_s', 'optimization after the last frame', 's', 1, '.2f',
            'Part of the time in SLAM that follows the last frame.',
        ),
        Description('num_gaussians', 'Gaussians', '', 1, ',d', 'Size of the final map.'),
        Description('peak_rss_mb', 'peak memory', 'MiB', 1, ',.0f', 'Peak memory of the process.'),
        Description('peak_gpu_mb', 'peak GPU memory', 'MiB', 1, ',.0f', "Peak GPU memory of the process's tensors."),
    ),
    'Trajectory': (
        Description(
            'ate_rmse_m', 'ATE RMSE', 'cm', 100, '.3f',
            'Root mean squared distance of the camera centres after rigid alignment.',
        ),
        Description(
            'ate_final_rmse_m', 'ATE RMSE, final', 'cm', 100, '.3f',
            'The same after all corrections of the keyframe graph: where the frames are in the final map.',
        ),
        Description('loops', 'loops', '', 1, ',d', 'Places that were recognised as seen before.'),
        Description('corrections', 'corrections', '', 1, ',d', 'Times that poses and map were corrected by loops.'),
        Description(
            'ate_frames', 'frames with ground truth', '', 1, ',d',
            'Frames with a pose, tracked and uncertain, that the ATE is computed from.',
        ),
        Description(
            'ate_tracked_rmse_m', 'ATE RMSE, tracked', 'cm', 100, '.3f',
            'The same over the tracked frames alone, aligned by themselves.',
        ),
        Description('worst_error_m', 'worst tracked frame', 'cm', 100, '.2f', 'Largest position error of a tracked frame.'),
        Description(
            'false_tracked', 'false "tracked"', '', 1, ',d',
            'Tracked frames that are farther off than 10 cm and than three standard deviations.',
        ),
        Description(
            'rpe_trans_frame_m', 'RPE per frame', 'mm', 1e3, '.3f',
            'Translation error of the motion from one frame to the next.',
        ),
        Description(
            'rpe_rot_frame_deg', 'RPE per frame, rotation', 'deg', 1, '.4f',
            'Rotation error of the motion from one frame to the next.',
        ),
        Description(
            'rpe_frame_pairs', 'frame pairs', '', 1, ',d',
            'Pairs of consecutive frames that the RPE per frame is computed from.',
        ),
        Description(
            'rpe_trans_1s_m', 'RPE per second', 'mm', 1e3, '.2f',
            'Translation error of the motion over one second: drift.',
        ),
        Description('rpe_rot_1s_deg', 'RPE per second, rotation', 'deg', 1, '.3f', 'Rotation error of the motion over one second.'),
        Description('rpe_1s_pairs', 'one-second pairs', '', 1, ',d', 'Pairs of frames that the RPE per second is computed from.'),
        Description(
            'splatam_ate_mean_m', 'ATE as the original', 'cm', 100, '.3f',
            'The original prints it as "ATE RMSE": a mean, and of world-to-camera translations instead of camera centres.',
        ),
    ),
    'Final map against the frames': (
        *_image_scores('', 'final map at the estimated poses'),
        Description('evaluated_frames', 'frames', '', 1, ',d', 'Frames that the scores above are computed from.'),
        Description('evaluated_every', 'stride', '', 1, ',d', 'Every n-th frame of the run is scored.'),
    ),
    'The same frames, scored as the original does': _original_scores('splatam_'),
    'Frames kept out of the map': (
        *_image_scores('heldout_', 'final map at the estimated poses'),
        Description('heldout_frames', 'frames', '', 1, ',d', 'Tracked, but not used for mapping.'),
    ),
    'Novel views: a test split at its true poses': (
        *_image_scores('novel_', 'views without holes'),
        Description('novel_frames', 'views', '', 1, ',d', 'Views without holes.'),
        Description(
            'novel_alignment', 'alignment', '', 1, '',
            'What aligned the ground truth to the map: the whole trajectory or the first pose.'
        ),
    ),
    'Novel views with holes': (
        *_image_scores('novel_holes_', 'views with more than 0.1 % unmapped surface'),
        Description(
            'novel_holes_frames', 'views',
            '', 1, ',d', 'More than 0.1 % of their pixels have a depth reading but see no map.',
        ),
    ),
    'Novel views without holes, scored as the original does': _original_scores('splatam_novel_'),
}  # fmt: skip
"""All numbers by heading, except ``timings_ms`` and ``notes``, which are tables of their own."""

BY_NAME = {description.name: description for group in DESCRIPTIONS.values() for description in group}
