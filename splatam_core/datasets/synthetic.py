"""A synthetic room, seen by a hand-held RGB-D camera whose poses are known exactly.

SOURCE is ``synthetic``, or ``synthetic:`` with options separated by commas::

    synthetic:seed=3,noise=off,frames=600,motion=fast

``seed``
    Selects the room and the walk through it (default 0). Frame i of a seed does not depend on how
    many frames there are or which of them are read.
``noise``
    ``on`` (default): depth has the noise of a Kinect, in whole millimetres. ``off``: exact depth.
``frames``
    Length (default: as needed for ``--max-frames``, else 300). The walk closes a loop every 300
    frames and then continues along nearly the same path.
``motion``
    ``calm`` (default): the camera looks around one side of the room. ``fast``: the camera turns a full circle
    in 120 frames, by 1 degree per frame at the start and by 5 degrees after 30 frames, so that unseen parts
    of the room come into view all the time. Without a prediction of the motion, preset ``splatam`` cannot
    follow: in a frame's 40 steps it turns by at most 2 x 40 x 4e-4 rad = 1.8 degrees. The rotation rate
    changes slowly: a prediction at constant velocity is within half a degree.

Frames are 640x480; with ``--width`` they are rendered at that size, not resized.
There is no motion blur and no noise in the colours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatam_core.datasets import base
from splatam_core.datasets.room import build_room, look_at
from splatam_core.errors import DatasetError
from splatam_core.geometry.camera import CameraCalibration, PinholeCamera
from splatam_core.geometry.trajectory import Trajectory
from splatam_core.images.rectification import FrameFactory
from splatam_core.types import RgbdFrame

CAMERA = PinholeCamera(640, 480, 525.0, 525.0, 319.5, 239.5)
MOTIONS = {'calm': 300, 'fast': 120}
"""Number of frames in a loop, by the name of the motion."""
LOOP_FRAMES = MOTIONS['calm']
MAX_FRAMES = 1_000_000  # nine hours
MAX_SEED = 2**63 - 1
SCHEME = 'synthetic'
OPTIONS = 'seed=N, noise=on|off, frames=N, motion=calm|fast'


class SyntheticSequence:
    """The frames of one walk through one room."""

    def __init__(
        self, *, seed: int = 0, noise: bool = True, frames: int = LOOP_FRAMES, width: int | None = None,
        motion: str = 'calm',
    ) -> None:  # fmt: skip
        self.name = f'{SCHEME}_{seed}' if motion == 'calm' else f'{SCHEME}_{seed}_{motion}'
        self.camera = FrameFactory(CameraCalibration(CAMERA), width).camera
        self.depth_scale: float | None = 1000.0 if noise else None
        self._seed = seed
        self._frames = range(frames)
        self._walk = Walk.of(seed, motion)
        self._room = build_room(seed)

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: int) -> RgbdFrame:
        """Render one frame."""
        frame = self._frames[index]
        T_world_cam = self._walk.pose(frame)
        cast = self._room.cast(self.camera, T_world_cam)
        depth_m = cast.depth_m
        if self.depth_scale is not None:
            incidence = self._room.incidence(self.camera, T_world_cam, cast)
            depth_m = measured(depth_m, incidence, np.random.default_rng([self._seed, 2, frame]))
        rgb = self._room.color(self.camera, T_world_cam)
        return RgbdFrame(base.nominal_stamp_ns(frame), rgb, depth_m, self.camera)

    def ground_truth(self) -> Trajectory:
        """The pose of every frame in the room's axes (z up)."""
        stamps = np.array([base.nominal_stamp_ns(frame) for frame in self._frames], np.int64)
        return Trajectory(stamps, np.stack([self._walk.pose(frame) for frame in self._frames]))


@dataclass(frozen=True, eq=False)
class Walk:
    """The path of a hand-held camera: a loop in which it looks around, plus the tremor of the hand.

    Attributes:
        motion: one of ``MOTIONS``.
        phases: [4] radians, the position in the loop of the first frame.
        tremor_hz: [6, 3] frequencies of the tremor along x, y, z and about yaw, pitch, roll.
        tremor_phases: [6, 3] radians.
    """

    motion: str
    phases: NDArray[np.float64]
    tremor_hz: NDArray[np.float64]
    tremor_phases: NDArray[np.float64]

    @classmethod
    def of(cls, seed: int, motion: str = 'calm') -> Walk:
        """Returns the walk of a seed."""
        rng = np.random.default_rng([seed, 0])
        turn = 2 * np.pi
        phases = rng.uniform(0, turn, 4)
        if motion == 'fast':
            phases[2] = np.pi / 2 if phases[2] < np.pi else 3 * np.pi / 2  # start where it turns slowest
        return cls(motion, phases, rng.uniform(0.4, 2.2, (6, 3)), rng.uniform(0, turn, (6, 3)))

    def pose(self, frame: int) -> NDArray[np.float64]:
        """Returns the [4, 4] camera-to-world pose; up to 0.35 m/s and 25 degrees/s (calm), or 0.8 m/s and 160 degrees/s (fast)."""
        around = 2 * np.pi * frame / MOTIONS[self.motion] + self.phases
        seconds = frame / base.NOMINAL_RATE_HZ
        tremor = np.sin(2 * np.pi * self.tremor_hz * seconds + self.tremor_phases).mean(axis=1)
        eye = np.array([0.1 + 0.45 * np.cos(around[0]), -0.4 + 0.3 * np.sin(around[0]), 1.4 + 0.08 * np.sin(around[1])])
        turn = 0.6 * np.sin(around[2]) if self.motion == 'calm' else around[2] + 0.35 * np.sin(2 * around[2])
        yaw = turn + 0.006 * tremor[3]
        pitch = -0.24 + 0.12 * np.sin(around[3]) + 0.006 * tremor[4]
        forward = np.array([np.sin(yaw) * np.cos(pitch), np.cos(yaw) * np.cos(pitch), np.sin(pitch)])
        eye = eye + 0.006 * tremor[:3]
        return look_at(eye, eye + forward, 0.03 * np.sin(around[1]) + 0.006 * tremor[5])


def measured(depth_m: NDArray[np.float32], incidence: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """Simulate the depth measurement of a structured-light camera.

    The error along the optical axis grows with the square of the depth (Khoshelham and Elberink 2012, 1.4 mm
    at 1 m). There is no reading out of range, on surfaces seen at a grazing angle, and on most pixels
    at depth edges, where the pattern is in shadow. Readings are whole millimetres.

    Args:
        depth_m: [H, W] true depth.
        incidence: [H, W] cosine between ray and surface normal.
        rng: generates the errors.

    Returns:
        [H, W] metres, 0 = no reading.
    """
    error_m = 1.425e-3 * depth_m**2 * rng.standard_normal(depth_m.shape, dtype=np.float32)
    chance = rng.random(depth_m.shape, dtype=np.float32)
    lost = (depth_m < 0.4) | (depth_m > 5.0)
    lost |= chance < (0.21 - incidence) / 0.12  # none below 78 degrees, all from 85 on
    lost |= _depth_edges(depth_m) & (chance < 0.7)
    millimetres = np.rint(1000 * (depth_m + error_m)).astype(np.uint16)
    return base.metres(np.where(lost, np.uint16(0), millimetres), 1000.0)


def _depth_edges(depth_m: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Returns True at pixels with a neighbour that is more than 4 % nearer or farther, [H, W]."""
    edges = np.zeros(depth_m.shape, bool)
    for axis in (0, 1):
        jump = np.abs(np.diff(np.log(depth_m), axis=axis)) > 0.04
        before, after = [slice(None)] * 2, [slice(None)] * 2
        before[axis], after[axis] = slice(None, -1), slice(1, None)
        edges[tuple(before)] |= jump
        edges[tuple(after)] |= jump
    return edges


def _recognises(source: str) -> bool:
    return source == SCHEME or source.startswith(f'{SCHEME}:')


def _open(source: str, options: base.ReadOptions) -> SyntheticSequence:
    given = _parse(source)
    asked = LOOP_FRAMES if options.last_asked is None else min(options.last_asked + 1, MAX_FRAMES)
    return SyntheticSequence(
        seed=_integer('seed', given.get('seed', '0'), 0, MAX_SEED),
        noise=_choice('noise', given.get('noise', 'on'), ('on', 'off')) == 'on',
        frames=_integer('frames', given.get('frames', str(asked)), 1, MAX_FRAMES),
        width=options.width,
        motion=_choice('motion', given.get('motion', 'calm'), tuple(MOTIONS)),
    )


def _parse(source: str) -> dict[str, str]:
    options: dict[str, str] = {}
    for part in filter(None, source.removeprefix(SCHEME).removeprefix(':').split(',')):
        key, _, value = part.partition('=')
        if key not in ('seed', 'noise', 'frames', 'motion'):
            raise DatasetError(f"{source}: unknown option '{key}'; use {OPTIONS}")
        options[key] = value
    return options


def _integer(key: str, text: str, minimum: int, maximum: int) -> int:
    if not text.isascii() or not text.isdigit() or len(text) > 20 or not minimum <= int(text) <= maximum:
        raise DatasetError(f"{SCHEME}: {key}='{text[:40]}' must be a whole number, at least {minimum} and at most {maximum}")
    return int(text)


def _choice(key: str, text: str, allowed: tuple[str, ...]) -> str:
    if text not in allowed:
        raise DatasetError(f"{SCHEME}: {key}='{text}' must be {' or '.join(allowed)}")
    return text


FORMAT = base.Format(SCHEME, f"'{SCHEME}' or '{SCHEME}:' with {OPTIONS}", _recognises, _open, is_path=False)
