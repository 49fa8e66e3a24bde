"""``splatam view``: shows a finished run, or a map, in a browser."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatam_core.commands.shared import Command, add_device_argument, open_run, open_source, positive
from splatam_core.errors import SplatamError, ViewerError, one_line

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from splatam_core.maps.viewer.panel import Panel
    from splatam_core.maps.viewer.scene import Scene
    from splatam_core.rasterizer import Gaussians
    from splatam_core.runs.record import RunRecord

ONLINE_COLOR, FINAL_COLOR = (240, 180, 40), (90, 200, 250)
PICTURE_SIZE = (1280, 720)
IMAGE_WIDTH = 240
STEP_S = 0.04
SAME_M = 1e-3


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('source', type=Path, metavar='RUN_OR_PLY', help='run folder, or a map of any program, .ply')
    add_device_argument(parser, "device to render the camera's image on (default: as the run's settings say)")
    parser.add_argument('--port', type=positive, default=8080, help='port of the page; the next free one if it is taken (8080)')
    parser.add_argument(
        '--host', default='127.0.0.1', help='address to listen on; 0.0.0.0 shows the page to the network (default: %(default)s)'
    )
    parser.add_argument(
        '--screenshot', type=Path, metavar='FILE', help='save a picture, .png, and end; needs chromium, but no screen'
    )  # fmt: skip


def view(args: argparse.Namespace) -> int:
    """Shows a run or a map until interrupted, or saves a picture of it."""
    from splatam_core.maps.ply import read_ply
    from splatam_core.maps.viewer.scene import Scene, address, open_server

    if args.screenshot is not None and args.screenshot.suffix.lower() != '.png':
        raise ViewerError(f'{args.screenshot}: pictures are written as .png')
    run = None if args.source.is_file() else open_run(args.source, args.device)
    gaussians = read_ply(args.source) if run is None else run.read_map()
    if args.screenshot is not None and not len(gaussians):
        raise ViewerError(f'{args.source}: the map has no Gaussians, so there is nothing to take a picture of')
    server = open_server(args.host, args.port)
    shown: Shown = ShownMap(gaussians) if run is None else ShownRun(run, gaussians)
    scene = Scene(server)
    panel = shown.begin(server, scene)
    if args.screenshot is not None:
        _save_picture(server, args.screenshot)
        return 0
    print(f'viewer at {address(server)}; Ctrl-C ends it', flush=True)
    while True:
        time.sleep(STEP_S)
        shown.step(scene, panel)
        panel.apply(scene)


def _save_picture(server: Any, path: Path) -> None:
    from splatam_core.atomic_io import replaced
    from splatam_core.maps.viewer.browser import take_picture
    from splatam_core.maps.viewer.panel import png

    picture = png(take_picture(server, *PICTURE_SIZE))
    with replaced(path) as temporary:
        temporary.write_bytes(picture)
    print(f'{path} shows the map')


class ShownMap:
    """A map alone."""

    def __init__(self, gaussians: Gaussians) -> None:
        self._gaussians = gaussians

    def begin(self, server: Any, scene: Scene) -> Panel:
        """Shows the map and returns the controls."""
        import numpy as np

        from splatam_core.maps.viewer.packing import pack
        from splatam_core.maps.viewer.panel import Panel

        count = len(self._gaussians)
        scene.show_map(pack(_snapshot(self._gaussians)), np.zeros(count, int))
        panel = Panel(server)
        panel.say(f'{count:,} Gaussians')
        return panel

    def step(self, scene: Scene, panel: Panel) -> None:
        """Does nothing: nothing changes."""


class ShownRun:
    """A finished run: map, path and images, at any frame."""

    def __init__(self, run: RunRecord, gaussians: Gaussians) -> None:
        """Prepares what each frame shows.

        Args:
            run: the run.
            gaussians: its map.
        """
        import numpy as np

        from splatam_core.maps.viewer.packing import pack

        if len(run.trajectory) == 0:
            raise ViewerError(f'{run.path}: no frame has a pose')
        self._run, self._gaussians = run, gaussians
        self._rows = pack(_snapshot(gaussians))
        self._final = _corrected_path(run)
        self._in_map = run.poses()
        self._stamps_ns = run.stamps_ns()
        counts = np.array([frame.num_gaussians for frame in run.frames] or [len(gaussians)] * len(self._stamps_ns))
        counts = np.maximum.accumulate(counts) / max(1, counts.max())
        self._counts = np.rint(counts * len(gaussians)).astype(int)
        self._added_by = np.searchsorted(self._counts, np.arange(len(gaussians)), side='right')
        self._images = _Images(run, gaussians)
        self._shown = -1
        self._due_s = 0.0

    def begin(self, server: Any, scene: Scene) -> Panel:
        """Shows the last frame and returns the controls."""
        from splatam_core.maps.viewer.panel import Panel

        panel = Panel(server, num_frames=len(self._stamps_ns))
        scene.watch(self._run.trajectory.T_world_cam[0])
        self._show(scene, panel, len(self._stamps_ns) - 1)
        return panel

    def step(self, scene: Scene, panel: Panel) -> None:
        """Shows the frame that the slider says."""
        if panel.plays and time.monotonic() >= self._due_s:
            self._due_s = time.monotonic() + self._period_s()
            panel.advance()
        if len(self._stamps_ns) > 1 and panel.frame != self._shown:
            self._show(scene, panel, panel.frame)

    def _period_s(self) -> float:
        return max(STEP_S, (self._stamps_ns[-1] - self._stamps_ns[0]) / 1e9 / max(1, len(self._stamps_ns) - 1))

    def _show(self, scene: Scene, panel: Panel, frame: int) -> None:
        stamp_ns, path = self._stamps_ns[frame], self._run.trajectory
        count = int(self._counts[min(frame, len(self._counts) - 1)])
        scene.show_map(self._rows[:count], self._added_by[:count], exactly=True)
        past = path.T_world_cam[path.stamps_ns <= stamp_ns]
        scene.show_line('trajectory', past[:, :3, 3], ONLINE_COLOR)
        scene.show_line('trajectory_final', self._final, FINAL_COLOR)
        pose = self._in_map.get(stamp_ns)  # the map is the final one
        if pose is not None and self._run.camera is not None:
            scene.show_camera(pose, self._run.camera, self._images.at(frame, pose))
            if panel.follows:
                scene.follow(pose)
        status = self._run.frames[frame].status.value if frame < len(self._run.frames) else ''
        panel.say(
            f'**{self._run.path.name}**, frame {frame + 1} of {len(self._stamps_ns)} {status}  \n'
            f'{count:,} of {len(self._rows):,} Gaussians  \n'
            f"camera's image: {self._images.origin}"
        )
        self._shown = frame


def _corrected_path(run: RunRecord) -> NDArray[np.float64]:
    """Returns [N, 3] where the camera was in the final map; [0, 3] where that is where it was tracked: one line is enough then."""
    import numpy as np

    in_map = run.poses()
    positions = np.array([in_map[int(stamp_ns)][:3, 3] for stamp_ns in run.trajectory.stamps_ns])
    moved_m = np.linalg.norm(positions - run.trajectory.T_world_cam[:, :3, 3], axis=1)
    return positions if moved_m.max() > SAME_M else positions[:0]


class _Images:
    """What the camera saw: the recording's images where they can be read, else the map rendered at the pose."""

    def __init__(self, run: RunRecord, gaussians: Gaussians) -> None:
        self._run, self._gaussians = run, gaussians
        self._renderer: Any = None
        self._sequence: Any = None
        self.origin = 'rendered from the map'
        if run.description.source is not None:
            try:
                self._sequence = open_source(run.description.source)
                self.origin = 'recorded'
            except SplatamError as error:
                self.origin += f', because the recording cannot be opened: {error}'

    def at(self, frame: int, T_world_cam: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Returns the image [H, W, 3] of a frame."""
        image = self._recorded(frame)
        if image is None:
            image = self._rendered(T_world_cam)
        step = max(1, image.shape[1] // IMAGE_WIDTH)
        return image[::step, ::step]

    def _recorded(self, frame: int) -> NDArray[np.uint8] | None:
        """Returns the image of the recording; None if it cannot be read, from then on for every frame."""
        if self._sequence is None:
            return None
        try:
            if frame >= len(self._sequence):
                raise ViewerError(f'it has {len(self._sequence)} frames')
            image: NDArray[np.uint8] = self._sequence[frame].rgb
        except (SplatamError, OSError) as error:
            self._sequence = None
            self.origin = f'rendered from the map, because frame {frame + 1} of the recording cannot be read: {one_line(error)}'
            return None
        return image

    def _rendered(self, T_world_cam: NDArray[np.float64]) -> NDArray[np.uint8]:
        import torch

        from splatam_core.device import pose_tensor
        from splatam_core.geometry.se3 import inverse
        from splatam_core.rasterizer import rasterizer_for

        if self._renderer is None:
            rasterizer, device = rasterizer_for(self._run.config)
            camera = self._run.camera_or_error()
            small = camera.resized(IMAGE_WIDTH, max(1, round(camera.height * IMAGE_WIDTH / camera.width)))
            self._renderer = rasterizer, self._gaussians.to(device), small
        rasterizer, gaussians, camera = self._renderer
        with torch.no_grad():
            return rasterizer.render(gaussians, camera, pose_tensor(inverse(T_world_cam), gaussians.means.device)).images().rgb


Shown = ShownMap | ShownRun


def _snapshot(gaussians: Gaussians) -> Any:
    import torch

    from splatam_core.types import MapSnapshot

    g = gaussians.detached()
    return MapSnapshot(
        means=g.means.numpy(force=True),
        rgb=g.rgb.numpy(force=True),
        opacities=torch.sigmoid(g.logit_opacities).numpy(force=True),
        log_scales=g.log_scales.numpy(force=True),
        rotations=None if g.rotations is None else g.rotations.numpy(force=True),
    )


COMMAND = Command('view', 'show a run, or a map of any program, in a browser', _add_arguments, view)
