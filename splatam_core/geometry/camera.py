"""Pinhole cameras and camera calibrations.

A pixel's centre is its integer index, everywhere. Resizing by ``s`` therefore maps
``f' = s f`` and ``c' = (c + 0.5) s - 0.5``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from splatam_core.errors import CameraError

DISTORTION_COEFFICIENTS = {
    'none': (0,),
    'plumb_bob': (4, 5),
    'rational_polynomial': (8,),
    'equidistant': (4,),
}

MAX_SIDE = 16384
"""The largest width and height of images."""

FOCAL_LENGTHS = (1e-2, 1e6)
LARGEST_PRINCIPAL_POINT = 1e6
LARGEST_COEFFICIENT = 1e6


SMALL_CHANGE = 0.05
"""Largest change of focal length, or of principal point as a part of the image, that the focus of one camera explains."""


@dataclass(frozen=True, slots=True)
class PinholeCamera:
    """An ideal camera: size and focal lengths in pixels, principal point in pixel indices."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise CameraError(f'camera size {self.width}x{self.height}: both must be at least 1 pixel')
        if self.width > MAX_SIDE or self.height > MAX_SIDE:
            raise CameraError(f'camera size {self.width}x{self.height}: both must be at most {MAX_SIDE} pixels')
        if not (all(map(math.isfinite, (self.fx, self.fy, self.cx, self.cy))) and self.fx > 0 and self.fy > 0):
            raise CameraError(
                f'camera intrinsics fx={self.fx} fy={self.fy} cx={self.cx} cy={self.cy}: focal lengths must be '
                'positive and all four finite; is the camera calibrated?'
            )
        shortest, longest = FOCAL_LENGTHS
        if not (shortest <= min(self.fx, self.fy) and max(self.fx, self.fy) <= longest):
            raise CameraError(f'camera intrinsics fx={self.fx} fy={self.fy}: must be {shortest:g} to {longest:g} pixels')
        if max(abs(self.cx), abs(self.cy)) > LARGEST_PRINCIPAL_POINT:
            raise CameraError(
                f'camera intrinsics cx={self.cx} cy={self.cy}: must be within {LARGEST_PRINCIPAL_POINT:g} pixels of the image'
            )

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The intrinsic matrix K, [3, 3]."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], dtype=np.float64)

    def cropped(self, width: int, height: int, left: int = 0, top: int = 0) -> PinholeCamera:
        """Returns the camera of a part of the image."""
        return PinholeCamera(width, height, self.fx, self.fy, self.cx - left, self.cy - top)

    def resized(self, width: int, height: int) -> PinholeCamera:
        """Returns the camera of the image resampled to another size."""
        sx, sy = width / self.width, height / self.height
        return PinholeCamera(width, height, self.fx * sx, self.fy * sy, (self.cx + 0.5) * sx - 0.5, (self.cy + 0.5) * sy - 0.5)


class Intrinsics(Protocol):
    """A description of a camera, such as the content of a CameraInfo message or a ``camera.yaml``."""

    @property
    def width(self) -> int:
        """Image width in pixels."""

    @property
    def height(self) -> int:
        """Image height in pixels."""

    @property
    def fx(self) -> float:
        """Focal length along x in pixels."""

    @property
    def fy(self) -> float:
        """Focal length along y in pixels."""

    @property
    def cx(self) -> float:
        """The principal point's x in pixels."""

    @property
    def cy(self) -> float:
        """The principal point's y in pixels."""

    @property
    def distortion_model(self) -> str:
        """``none``, ``plumb_bob``, ``rational_polynomial`` or ``equidistant``."""

    @property
    def distortion(self) -> tuple[float, ...]:
        """Coefficients in OpenCV's order."""


@dataclass(frozen=True, slots=True)
class CameraCalibration:
    """A real camera: a pinhole and the distortion of its lens (coefficients in OpenCV's order)."""

    pinhole: PinholeCamera
    distortion_model: str = 'none'
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        allowed = DISTORTION_COEFFICIENTS.get(self.distortion_model)
        if allowed is None:
            raise CameraError(f"distortion model '{self.distortion_model}' is not one of {', '.join(DISTORTION_COEFFICIENTS)}")
        if not all(abs(value) <= LARGEST_COEFFICIENT for value in self.distortion):
            raise CameraError(f'distortion {list(self.distortion)}: coefficients must be within {LARGEST_COEFFICIENT:g}')
        if self.is_distorted and len(self.distortion) not in allowed:
            raise CameraError(
                f'{self.distortion_model} takes {" or ".join(map(str, allowed))} coefficients, got {len(self.distortion)}'
            )

    @property
    def is_distorted(self) -> bool:
        """Whether any distortion coefficient is not zero."""
        return any(self.distortion)

    def is_close_to(self, other: CameraCalibration) -> bool:
        """Returns True if images of both have one size and nearly one field of view, as those of a camera with autofocus."""
        a, b = self.pinhole, other.pinhole
        return (a.width, a.height) == (b.width, b.height) and all(
            abs(this - that) <= SMALL_CHANGE * scale
            for this, that, scale in (
                (a.fx, b.fx, a.fx), (a.fy, b.fy, a.fy), (a.cx, b.cx, a.width), (a.cy, b.cy, a.height),
            )
        )  # fmt: skip

    @classmethod
    def from_intrinsics(cls, intrinsics: Intrinsics) -> CameraCalibration:
        """Returns the calibration of a described camera."""
        i = intrinsics
        pinhole = PinholeCamera(i.width, i.height, i.fx, i.fy, i.cx, i.cy)
        return cls(pinhole, i.distortion_model, tuple(i.distortion))
