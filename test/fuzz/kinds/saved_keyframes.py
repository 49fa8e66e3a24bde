"""Saved keyframes of a map: whatever ``map.keyframes`` holds, Slam goes on in the map or one line says why not."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from hypothesis import strategies as st

from kinds.base import Case, Kind, Tally
from kinds.checkpoints import other_arrays, other_values, packed, sealed
from kinds.damaged import damage
from splatam_core.config import load_config
from splatam_core.datasets.registry import open_sequence
from splatam_core.errors import CheckpointError
from splatam_core.rasterizer import Gaussians
from splatam_core.runs.archive import Content, read_archive
from splatam_core.runs.map_keyframes import KIND as ARCHIVE_KIND
from splatam_core.runs.map_keyframes import VERSION, read_map_keyframes, write_map_keyframes
from splatam_core.slam import Slam
from splatam_core.types import RgbdFrame

CONFIG = load_config(
    'realtime', ['threads=1', 'mapping.iterations=1', 'mapping.first_iterations=0', 'keyframes.every=1', 'densification.every=1']
)
"""Looks for lost cameras by keyframes."""


def recorded(path: Path) -> tuple[Gaussians, list[RgbdFrame]]:
    """Writes the keyframes of a run of four frames. Returns its map and its frames."""
    sequence, slam = open_sequence('synthetic:noise=off', width=48, max_frames=4), Slam(CONFIG)
    frames = [sequence[index] for index in range(4)]
    for frame in frames:
        slam.process(frame)
    write_map_keyframes(path, slam.keyframes, slam.places.arrays())
    return slam.map.gaussians.detached(), frames


def check_file(path: Path, gaussians: Gaussians, frames: list[RgbdFrame], tally: Tally, data: bytes) -> None:
    """What is read lets a camera look for itself, and map."""
    path.write_bytes(data)
    saved = tally.attempt(partial(read_map_keyframes, path), CheckpointError)
    if saved is None:
        return
    for T_world_cam in (np.eye(4), None) if saved.keyframes else (np.eye(4),):
        slam = Slam(CONFIG)
        slam.load(gaussians, T_world_cam, saved)
        for frame in frames[:2]:
            slam.process(frame)
        assert bool(slam.map.gaussians.usable().all())


@st.composite
def damaged_images(draw: st.DrawFn, content: Content) -> Content:
    name = draw(st.sampled_from([name for name in sorted(content.arrays) if name.startswith(('rgb.', 'depth.'))]))
    data = draw(damage(content.arrays[name].tobytes()))
    return Content(content.values, {**content.arrays, name: np.frombuffer(data, np.uint8)})


def camera_values() -> st.SearchStrategy[float]:
    return st.one_of(st.floats(), st.floats(-1e6, 1e6), st.integers(), st.booleans())


@st.composite
def other_cameras(draw: st.DrawFn, content: Content) -> Content:
    """Numbers of cameras, spacings and poses; the images stay as they are."""
    cameras = [dict(camera) for camera in content.values['cameras']]
    spacings, poses = list(content.values['spacings']), content.arrays['T_cam_world'].copy()
    index = draw(st.integers(0, len(cameras) - 1))
    for name in draw(st.lists(st.sampled_from([*cameras[index], 'spacing', 'pose']), min_size=1, max_size=3, unique=True)):
        if name == 'spacing':
            spacings[index] = draw(camera_values())
        elif name == 'pose':
            with np.errstate(over='ignore'):
                poses[index, :3, 3] = [draw(st.floats(width=32)) for _ in range(3)]
        else:
            cameras[index][name] = draw(camera_values())
    return Content({**content.values, 'cameras': cameras, 'spacings': spacings}, {**content.arrays, 'T_cam_world': poses})


def cases(folder: Path) -> list[Case]:
    path = folder / 'map.keyframes'
    gaussians, frames = recorded(path)
    whole, content = path.read_bytes(), read_archive(path, ARCHIVE_KIND, VERSION)
    check = partial(check_file, path, gaussians, frames)
    again = partial(packed, kind=ARCHIVE_KIND, version=VERSION)
    below = damage(whole.split(b'\n', 1)[1]).map(partial(sealed, kind=ARCHIVE_KIND, version=VERSION))
    return [
        Case('any bytes', damage(whole), check, short=20),
        Case('bytes below a right checksum', below, check, short=20),
        Case('other values', other_values(content).map(again), check, short=20),
        Case('other arrays', other_arrays(content).map(again), check, short=20),
        Case('images', damaged_images(content).map(again), check, short=20),
        Case('cameras', other_cameras(content).map(again), check, short=20),
    ]


KIND = Kind('saved keyframes', 3_000, cases)
