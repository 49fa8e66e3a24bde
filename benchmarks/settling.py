"""The depth bias of a new map, with and without the initial depth-bias correction (decision 0003).

    python benchmarks/settling.py

Uses the first frame of the synthetic room, preset quick and one thread. Bias is the mean of rendered minus measured depth,
where the silhouette exceeds the tracking threshold.
"""

from __future__ import annotations

import torch
from header import print_header

from splatam_core.config import apply_threads, load_config
from splatam_core.datasets.registry import open_sequence
from splatam_core.images.view import View
from splatam_core.rasterizer import make_rasterizer
from splatam_core.slam import Slam
from splatam_core.types import RgbdFrame


def bias_mm(frame: RgbdFrame, rounds: int, steps: int) -> float:
    """Returns the mean depth bias of the map after its first frame, in millimetres."""
    config = load_config('quick', {'threads': 1, 'densification.bias_correction_rounds': rounds, 'mapping.iterations': steps})
    slam = Slam(config)
    slam.process(frame)
    view = View.from_frame(frame, config.depth)
    render = make_rasterizer('cpu', 1).render(slam.map.gaussians, view.camera, torch.eye(4))
    compared = view.valid & (render.silhouette > config.tracking.silhouette_threshold)
    return 1e3 * float((render.depth() - view.depth)[compared].mean())


def main() -> None:
    """Print the table."""
    apply_threads(load_config('quick'))
    print_header('Depth bias of a new map', 1)
    print('| image | rounds of correction | bias mm | after 10 mapping steps | after 60 |\n|---|---|---|---|---|')
    for width in (96, 320):
        frame = open_sequence('synthetic', width=width, max_frames=1)[0]
        for rounds in (0, 1, 3):
            biases = ' | '.join(f'{bias_mm(frame, rounds, steps):+.1f}' for steps in (0, 10, 60))
            print(f'| {frame.camera.width}x{frame.camera.height} | {rounds} | {biases} |', flush=True)


if __name__ == '__main__':
    main()
