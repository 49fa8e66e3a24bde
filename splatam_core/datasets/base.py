"""The interface of all readers, and what they share: windows of a recording, nominal stamps, depth counts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from splatam_core.errors import DatasetError, FrameError
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.geometry.trajectory import Trajectory
from splatam_core.types import RgbdFrame

FIRST_STAMP_NS = 1_000_000_000
NOMINAL_RATE_HZ = 30
MIN_SIZE = 16
SPLITS = ('train', 'test')
MAX_INTERVAL_S = 10.0
RGB_ENCODINGS = ('bgr8', 'rgb8')


class Sequence(Protocol):
    """A recording: frames with increasing stamps, read when they are asked for.

    Attributes:
        name: name in reports.
        camera: the ideal camera of every frame.
        depth_scale: stored depth counts per metre; None if depth is stored in metres.
    """

    name: str
    camera: PinholeCamera
    depth_scale: float | None

    def __len__(self) -> int:
        """Number of frames."""
        ...

    def __getitem__(self, index: int) -> RgbdFrame:
        """Read one frame.

        Raises:
            IndexError: there is no such frame.
            DatasetError: the frame cannot be read.
            FrameError: its images do not fit the camera.
        """
        ...

    def ground_truth(self) -> Trajectory | None:
        """True poses with their own stamps, camera to the ground truth's own world frame; None if unknown."""
        ...


@dataclass(frozen=True, slots=True)
class BagTopics:
    """Topics of a bag that the user chose; None leaves the choice to the reader."""

    rgb: str | None = None
    depth: str | None = None
    info: str | None = None


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """How to read a recording.

    Attributes:
        width: width of the frames in pixels; None keeps the recorded size.
        start: index of the first frame.
        max_frames: largest number of frames; None reads to the end.
        topics: which topics of a bag to read.
        stride: read every n-th frame, beginning with the first.
        crop: number of pixels to cut off each edge, after resizing.
        split: ``train`` or ``test`` part of a dataset that has such parts; None reads ``train``.
        skip_bad: True to skip frames that the dataset marks as bad.
        max_interval_s: largest difference between the stamps of a colour and a depth image; None leaves it to the reader.
        use_receive_time: True to take the times of recording of a bag's messages for their stamps.
        rgb_encoding: how to read images of a bag whose encoding does not say the order of channels (8UC3): ``bgr8``, also if
            None, or ``rgb8``.
    """

    width: int | None = None
    start: int = 0
    max_frames: int | None = None
    topics: BagTopics = BagTopics()
    stride: int = 1
    crop: int = 0
    split: str | None = None
    skip_bad: bool = False
    max_interval_s: float | None = None
    use_receive_time: bool = False
    rgb_encoding: str | None = None

    def __post_init__(self) -> None:
        if self.start < 0:
            raise DatasetError(f'start {self.start}: the first frame has index 0')
        if self.max_frames is not None and self.max_frames < 1:
            raise DatasetError(f'max_frames {self.max_frames}: must be at least 1')
        if self.stride < 1:
            raise DatasetError(f'stride {self.stride}: must be at least 1')
        if self.crop < 0:
            raise DatasetError(f'crop {self.crop}: must be at least 0 pixels')
        if self.split not in (None, *SPLITS):
            raise DatasetError(f"split '{self.split}' is not one of {', '.join(SPLITS)}")
        if self.max_interval_s is not None and not 0 <= self.max_interval_s <= MAX_INTERVAL_S:
            raise DatasetError(f'max_interval {self.max_interval_s}: must be from 0 to {MAX_INTERVAL_S:g} s')
        if self.rgb_encoding not in (None, *RGB_ENCODINGS):
            raise DatasetError(f"rgb_encoding '{self.rgb_encoding}' is not one of {', '.join(RGB_ENCODINGS)}")

    @property
    def last_asked(self) -> int | None:
        """Index of the last frame that can be read; None = the recording's last one."""
        return None if self.max_frames is None else self.start + (self.max_frames - 1) * self.stride


@dataclass(frozen=True, slots=True)
class Format:
    """One row of the table of readers.

    Attributes:
        name: value of ``--format``.
        expects: what a source of this format holds, for the error message about an unknown source.
        recognises: returns True if a SOURCE looks like this format; examines names only.
        accepts: returns True if a SOURCE can be read as this format when the user names it; None = as ``recognises``.
        open: opens the whole recording; the caller cuts out the window of ``ReadOptions``.
        is_path: True if a source is a file or folder.
        has_topics: True if topics can be chosen, and messages have times of recording and encodings.
        pairs_by_stamp: True if colour and depth are paired by their stamps.
        has_splits: True if the dataset has ``train`` and ``test`` parts.
        flags_bad: True if the dataset marks bad frames.
        is_last_resort: True to use this format only if no other one fits.
    """

    name: str
    expects: str
    recognises: Callable[[str], bool]
    open: Callable[[str, ReadOptions], Sequence]
    is_path: bool = True
    has_topics: bool = False
    pairs_by_stamp: bool = False
    has_splits: bool = False
    flags_bad: bool = False
    is_last_resort: bool = False
    accepts: Callable[[str], bool] | None = None

    def fits(self, source: str) -> bool:
        """Returns True if the user may read a SOURCE as this format."""
        return (self.accepts or self.recognises)(source)


class Window:
    """Some frames of another sequence, with their edges cut off. The ground truth stays whole.

    Attributes:
        name, camera, depth_scale: see ``Sequence``.
    """

    def __init__(self, sequence: Sequence, indices: range, crop: int = 0) -> None:
        """Choose frames.

        Args:
            sequence: the whole recording.
            indices: of the frames in it.
            crop: number of pixels to cut off each edge.

        Raises:
            DatasetError: fewer than 16 pixels remain in a direction.
        """
        whole = sequence.camera
        width, height = whole.width - 2 * crop, whole.height - 2 * crop
        if crop and min(width, height) < MIN_SIZE:
            raise DatasetError(
                f'crop {crop}: leaves {max(width, 0)}x{max(height, 0)} of the {whole.width}x{whole.height} frames; '
                f'at least {MIN_SIZE} pixels must be left'
            )
        self.name = sequence.name
        self.camera = whole.cropped(width, height, crop, crop)
        self.depth_scale = sequence.depth_scale
        self._sequence = sequence
        self._indices = indices
        self._rows, self._columns = slice(crop, crop + height), slice(crop, crop + width)

    def __len__(self) -> int:
        return len(self._indices)

    def __getitem__(self, index: int) -> RgbdFrame:
        """Read one frame of the window."""
        frame = self._sequence[self._indices[index]]
        if self.camera == self._sequence.camera:
            return frame
        rgb, depth_m = frame.rgb[self._rows, self._columns], frame.depth_m[self._rows, self._columns]
        return replace(frame, rgb=np.ascontiguousarray(rgb), depth_m=np.ascontiguousarray(depth_m), camera=self.camera)

    def ground_truth(self) -> Trajectory | None:
        """The ground truth of the whole recording."""
        return self._sequence.ground_truth()


def frame_or_none(sequence: Sequence, index: int) -> RgbdFrame | None:
    """Returns a frame, or None if its images do not fit the camera: SLAM skips such frames too."""
    try:
        return sequence[index]
    except FrameError:
        return None


def cut(sequence: Sequence, options: ReadOptions) -> Sequence:
    """Returns the part of a sequence that the options select.

    Raises:
        DatasetError: the part is empty.
    """
    length = len(sequence)
    if options.start >= length:
        raise DatasetError(f'{sequence.name}: start {options.start} is beyond its {length} frames')
    indices = range(options.start, length, options.stride)[: options.max_frames]
    whole = indices == range(length) and options.crop == 0
    return sequence if whole else Window(sequence, indices, options.crop)


def nominal_stamp_ns(frame: int, rate_hz: int = NOMINAL_RATE_HZ) -> int:
    """Returns the stamp of a frame of a recording without stamps: frame 0 is at 1 s, the others follow at a nominal rate."""
    return FIRST_STAMP_NS + frame * 1_000_000_000 // rate_hz


def metres(counts: NDArray[np.uint16], depth_scale: float) -> NDArray[np.float32]:
    """Convert depth counts to float32 metres; 0 stays 0."""
    depth_m = counts.astype(np.float32)
    depth_m /= np.float32(depth_scale)
    return depth_m


def check_increasing(stamps_ns: NDArray[np.int64], name: str) -> None:
    """Check that stamps increase from frame to frame.

    Raises:
        DatasetError: they do not.
    """
    falls = np.flatnonzero(np.diff(stamps_ns) <= 0)
    if len(falls):
        at = int(falls[0]) + 1
        raise DatasetError(
            f'{name}: time does not increase from frame {at - 1} ({int(stamps_ns[at - 1])} ns) to frame {at} '
            f'({int(stamps_ns[at])} ns); cut the recording there'
        )


def nearest_depth(color_ns: NDArray[np.int64], depth_ns: NDArray[np.int64]) -> str:
    """Returns how far depth is from colour and which option pairs them, as the end of an error message; empty without images.

    Args:
        color_ns: [N] stamps, in any order.
        depth_ns: [M] stamps, in any order.
    """
    if not (color_ns.size and depth_ns.size):
        return ''
    color, depth = np.sort(color_ns), np.sort(depth_ns)
    after = np.searchsorted(depth, color).clip(0, len(depth) - 1)
    before = (after - 1).clip(0)
    to_after, to_before = depth[after] - color, depth[before] - color
    gap_s = float(np.median(np.where(np.abs(to_after) < np.abs(to_before), to_after, to_before))) / 1e9
    needed_s = np.ceil(abs(gap_s) * 1e3 + 1) / 1e3
    way_out = f'--max-interval {needed_s:g} pairs them' if needed_s <= MAX_INTERVAL_S else 'are their clocks the same?'
    return f'; the nearest depth is {gap_s:+.3f} s from its colour (median): {way_out}'
