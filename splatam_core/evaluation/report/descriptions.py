"""What each number of ``metrics.json`` is called and means, for tables that people read."""

from __future__ import annotations

from dataclasses import dataclass

from splatam_core.runs.metrics import Metrics


@dataclass(frozen=True, slots=True)
class Description:
    """One number.

    Attributes:
        name: in ``metrics.json``.
        label: for people.
        unit: shown behind it.
        factor: from the stored unit to the shown one.
        form: how many digits.
        meaning: one sentence; docs/evaluation.md says it in full.
    """

    name: str
    label: str
    unit: str
    factor: float
    form: str
    meaning: str

    def text(self, metrics: Metrics) -> str:
        """The number as text; an en dash where it is not known."""
        value = metrics.values()[self.name]
        if value is None:
            return '\u2013'
        return value if isinstance(value, str) else f'{value * self.factor:{self.form}}'


def _images(prefix: str, of: str) -> tuple[Description, ...]:
    return (
        Description(f'{prefix}psnr_db', 'PSNR', 'dB', 1, '.2f', f'Colour, {of}, over the pixels with a depth reading.'),
        Description(f'{prefix}psnr_full_db', 'PSNR, whole image', 'dB', 1, '.2f', f'Colour, {of}, holes included.'),
        Description(f'{prefix}ssim', 'SSIM', '', 1, '.4f', 'Structural similarity over the pixels with a reading; 1 = alike.'),
        Description(f'{prefix}ms_ssim', 'MS-SSIM', '', 1, '.4f', 'The same at five scales, over whole images.'),
        Description(f'{prefix}lpips', 'LPIPS', '', 1, '.4f', 'Learned distance (AlexNet), over whole images; 0 = alike.'),
        Description(f'{prefix}depth_l1_m', 'depth L1', 'cm', 100, '.2f', 'Mean absolute difference to the readings.'),
        Description(
            f'{prefix}depth_rmse_m',
            'depth RMSE',
            'cm',
            100,
            '.2f',
            'Root of the mean squared difference to the readings.',
        ),
    )


def _original(prefix: str) -> tuple[Description, ...]:
    return (
        Description(
            f'{prefix}psnr_db', 'PSNR, masked', 'dB', 1, '.2f', 'Pixels without a reading are black in both and count as perfect.'
        ),
        Description(f'{prefix}ms_ssim', 'MS-SSIM, masked', '', 1, '.4f', 'Printed by the original as "SSIM".'),
        Description(f'{prefix}lpips', 'LPIPS, masked', '', 1, '.4f', 'AlexNet, on the masked images.'),
        Description(
            f'{prefix}depth_l1_m', 'depth L1, unnormalised', 'cm', 100, '.2f',
            'Of the blended depth, not divided by the silhouette; printed by the original as "Depth RMSE", too.',
        ),
    )  # fmt: skip


DESCRIPTIONS: dict[str, tuple[Description, ...]] = {
    'Run': (
        Description('frames', 'frames', '', 1, ',d', 'Processed.'),
        Description('tracked', 'tracked', '', 1, ',d', 'With a pose, the first included.'),
        Description('lost', 'lost', '', 1, ',d', 'Without a pose; they change no map.'),
        Description('fps', 'speed', 'fps', 1, '.2f', 'Frames by the time spent in SLAM, decoding excluded.'),
        Description('fps_with_io', 'speed with decoding', 'fps', 1, '.2f', 'The same, decoding included.'),
        Description('finish_s', 'fitting after the last frame', 's', 1, '.2f', 'Of the time in SLAM, that after the last frame.'),
        Description('num_gaussians', 'Gaussians', '', 1, ',d', 'Size of the final map.'),
        Description('peak_rss_mb', 'peak memory', 'MiB', 1, ',.0f', 'Most memory the process held.'),
        Description('peak_gpu_mb', 'peak memory of the GPU', 'MiB', 1, ',.0f', "Most memory the process's tensors took on a GPU."),
    ),
    'Trajectory': (
        Description('ate_rmse_m', 'ATE RMSE', 'cm', 100, '.3f', 'Root mean squared distance of camera centres, aligned rigidly.'),
        Description('ate_frames', 'frames with a truth', '', 1, ',d', 'Tracked frames that entered the ATE.'),
        Description('rpe_trans_frame_m', 'RPE a frame', 'mm', 1e3, '.3f', 'Error of the motion from one frame to the next.'),
        Description('rpe_rot_frame_deg', 'RPE a frame, rotation', 'deg', 1, '.4f', 'The same, of the rotation.'),
        Description('rpe_frame_pairs', 'pairs', '', 1, ',d', 'Of consecutive frames that entered.'),
        Description('rpe_trans_1s_m', 'RPE a second', 'mm', 1e3, '.2f', 'Error of the motion over one second: drift.'),
        Description('rpe_rot_1s_deg', 'RPE a second, rotation', 'deg', 1, '.3f', 'The same, of the rotation.'),
        Description('rpe_1s_pairs', 'pairs', '', 1, ',d', 'Of frames a second apart that entered.'),
        Description(
            'splatam_ate_mean_m', 'ATE as the original', 'cm', 100, '.3f',
            'Printed by the original as "ATE RMSE": the mean, and of world-to-camera translations, not of centres.',
        ),
    ),
    'Final map against the frames': (
        *_images('', 'final map at the estimated poses'),
        Description('evaluated_frames', 'frames', '', 1, ',d', 'That entered the scores above.'),
        Description('evaluated_every', 'every', '', 1, ',d', 'Every n-th frame of the run entered.'),
    ),
    'The same frames, as the original counts': _original('splatam_'),
    'Frames kept out of the map': (
        *_images('heldout_', 'final map at the estimated poses'),
        Description('heldout_frames', 'frames', '', 1, ',d', 'Tracked, but never mapped.'),
    ),
    'Novel views: a test split at its true poses': (
        *_images('novel_', 'views without holes'),
        Description('novel_frames', 'views', '', 1, ',d', 'Views without holes.'),
        Description('novel_alignment', 'alignment', '', 1, '', 'What brought the truth into the map: trajectory, or first pose.'),
    ),
    'Novel views with holes': (
        *_images('novel_holes_', 'views that see more than 0.1 % unmapped surface'),
        Description('novel_holes_frames', 'views', '', 1, ',d', 'More than 0.1 % of their pixels have a reading but no map.'),
    ),
    'Novel views without holes, as the original counts': _original('splatam_novel_'),
}  # fmt: skip
"""Every number, by heading. ``timings_ms`` and ``notes`` are tables of their own."""

BY_NAME = {description.name: description for group in DESCRIPTIONS.values() for description in group}
