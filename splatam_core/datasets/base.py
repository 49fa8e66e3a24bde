"""What every reader offers, and what readers share: windows of a recording, image files, nominal stamps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from splatam_core.camera import CameraFile, PinholeCamera, read_camera_file
from splatam_core.errors import DatasetError
from splatam_core.types import RgbdFrame, Trajectory

FIRST_STAMP_NS = 1_000_000_000
NOMINAL_RATE_HZ = 30


class Sequence(Protocol):
    """A recording: frames in increasing time, read when they are asked for.

    Attributes:
        name: what to call it in reports.
        camera: the ideal camera of every frame.
        depth_scale: stored depth counts per metre; None where depth is stored as metres.
    """

    name: str
    camera: PinholeCamera
    depth_scale: float | None

    def __len__(self) -> int:
        """Number of frames."""

    def __getitem__(self, index: int) -> RgbdFrame:
        """Read one frame.

        Raises:
            IndexError: there is no such frame.
            DatasetError: the frame cannot be read.
            FrameError: its images do not fit the camera.
        """

    def ground_truth(self) -> Trajectory | None:
        """The true poses with stamps of their own, camera to the truth's own world; None where unknown."""


@dataclass(frozen=True, slots=True)
class BagTopics:
    """Topics of a bag chosen by hand; None leaves the choice to the reader."""

    rgb: str | None = None
    depth: str | None = None
    info: str | None = None


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """How to read a recording.

    Attributes:
        width: width of the frames in pixels; None keeps the recorded size.
        start: index of the first frame.
        max_frames: how many frames at most; None reads to the end.
        topics: which topics of a bag to read.
    """

    width: int | None = None
    start: int = 0
    max_frames: int | None = None
    topics: BagTopics = BagTopics()

    def __post_init__(self) -> None:
        if self.start < 0:
            raise DatasetError(f'start {self.start}: the first frame has index 0')
        if self.max_frames is not None and self.max_frames < 1:
            raise DatasetError(f'max_frames {self.max_frames}: must be at least 1')


@dataclass(frozen=True, slots=True)
class Format:
    """One row of the table of readers.

    Attributes:
        name: what ``--format`` calls it.
        expects: what a source of this format holds, for the error about an unknown one.
        recognises: whether a SOURCE looks like this format; looks at names only.
        open: opens the whole recording; the window of ``ReadOptions`` is cut by the caller.
        is_path: whether a source is a file or folder.
        has_topics: whether topics can be chosen.
    """

    name: str
    expects: str
    recognises: Callable[[str], bool]
    open: Callable[[str, ReadOptions], Sequence]
    is_path: bool = True
    has_topics: bool = False


class Window:
    """Frames ``start`` to ``stop`` of another sequence. The truth stays whole."""

    def __init__(self, sequence: Sequence, start: int, stop: int) -> None:
        self.name = sequence.name
        self.camera = sequence.camera
        self.depth_scale = sequence.depth_scale
        self._sequence = sequence
        self._indices = range(start, stop)

    def __len__(self) -> int:
        return len(self._indices)

    def __getitem__(self, index: int) -> RgbdFrame:
        """Read one frame of the window."""
        return self._sequence[self._indices[index]]

    def ground_truth(self) -> Trajectory | None:
        """The truth of the whole recording."""
        return self._sequence.ground_truth()


def cut(sequence: Sequence, options: ReadOptions) -> Sequence:
    """The window of a sequence that the options ask for.

    Raises:
        DatasetError: it would be empty.
    """
    length = len(sequence)
    if options.start >= length:
        raise DatasetError(f'{sequence.name}: start {options.start} is beyond its {length} frames')
    stop = length if options.max_frames is None else min(length, options.start + options.max_frames)
    return sequence if (options.start, stop) == (0, length) else Window(sequence, options.start, stop)


def nominal_stamp_ns(frame: int) -> int:
    """Stamp of a frame whose recording has none: from 1 s on, at 30 Hz."""
    return FIRST_STAMP_NS + frame * 1_000_000_000 // NOMINAL_RATE_HZ


def camera_file(folder: Path) -> CameraFile | None:
    """What a folder's ``camera.yaml`` states, or None where there is none.

    Raises:
        CameraError: the file is there and cannot be used.
    """
    path = folder / 'camera.yaml'
    return read_camera_file(path) if path.exists() else None


def read_color(path: Path) -> NDArray[np.uint8]:
    """Read a colour image file as RGB, [H, W, 3].

    Raises:
        DatasetError: the file is missing or no image.
    """
    image = _read_image(path, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def read_depth_counts(path: Path) -> NDArray[np.uint16]:
    """Read a 16-bit depth image file, [H, W] counts.

    Raises:
        DatasetError: the file is missing, no image, or not one channel of 16 bits.
    """
    counts = _read_image(path, cv2.IMREAD_UNCHANGED)
    if counts.dtype != np.uint16 or counts.ndim != 2:
        raise DatasetError(f'{path}: depth must be one channel of 16 bits, got {counts.dtype} {counts.shape}')
    return counts


def metres(counts: NDArray[np.uint16], depth_scale: float) -> NDArray[np.float32]:
    """Depth counts as float32 metres; 0 stays 0."""
    return counts.astype(np.float32) / np.float32(depth_scale)


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image file.

    Raises:
        DatasetError: the file is missing or no image.
    """
    height, width = read_color(path).shape[:2]
    return width, height


def check_increasing(stamps_ns: NDArray[np.int64], name: str) -> None:
    """Make sure that frames come in increasing time.

    Raises:
        DatasetError: they do not; says where.
    """
    falls = np.flatnonzero(np.diff(stamps_ns) <= 0)
    if len(falls):
        at = int(falls[0]) + 1
        raise DatasetError(
            f'{name}: time does not increase from frame {at - 1} ({int(stamps_ns[at - 1])} ns) to frame {at} '
            f'({int(stamps_ns[at])} ns); cut the recording there'
        )


def _read_image(path: Path, flags: int) -> NDArray[np.uint8]:
    try:
        data = np.frombuffer(path.read_bytes(), np.uint8)
    except OSError as error:
        raise DatasetError(f'{path}: cannot be read: {error.strerror}') from None
    image = cv2.imdecode(data, flags) if data.size else None
    if image is None:
        raise DatasetError(f'{path}: is not an image that OpenCV can read ({data.size} bytes); is the copy complete?')
    return image
