"""The arithmetic of direct alignment, behind one contract: native on the CPU, ``TorchAligner`` on any device."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from splatam_core.geometry import se3
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.geometry.se3 import Matrix
from splatam_core.tracking.pace import Pace

Array = NDArray[np.float32]
ImageT = TypeVar('ImageT', Array, Tensor)
OtherT = TypeVar('OtherT', Array, Tensor)

_FIRST_SCALES = 0.1, 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Linearization(Generic[ImageT]):
    """A reference and a frame of the same camera, and the estimate at which their residuals are linearised.

    Attributes:
        camera: the pinhole of both.
        brightness: [H, W] of the reference.
        depth: [H, W] of the reference.
        layers: [H, W, C] of the frame.
        color_motion: [4, 4] from the reference's camera to the frame's camera at the colour image's time.
        depth_motion: [4, 4] the same at the depth image's time.
        velocity: [6] twist by which ``color_motion`` changes per unit of time offset.
        gain: brightness of the frame = gain * brightness of the reference + bias.
        bias: see gain.
        photometric_scale: scale of the residuals of brightness, for Student's t.
        depth_scale: scale of the residuals of depth, relative to the depth.
        max_depth_ratio: points whose relative depth differs by more are on another surface.
        readout: [6] twist of the camera from the first row of an image to its last; 0 where all rows are read at once. The
            motions are those at the middle row. A point is taken to be read with its row of the reference.
    """

    camera: PinholeCamera
    brightness: ImageT
    depth: ImageT
    layers: ImageT
    color_motion: Array
    depth_motion: Array
    velocity: Array
    gain: float
    bias: float
    photometric_scale: float
    depth_scale: float
    max_depth_ratio: float
    readout: Array

    def converted(self, convert: Callable[[ImageT], OtherT]) -> Linearization[OtherT]:
        """Returns the same with each of the images converted."""
        given = {field.name: getattr(self, field.name) for field in fields(self)}
        return Linearization(**given | {name: convert(given[name]) for name in ('brightness', 'depth', 'layers')})


@dataclass(frozen=True, slots=True, eq=False)
class AlignmentState:
    """The estimate that alignment refines.

    Attributes:
        depth_motion: [4, 4] from the reference's camera to the frame's camera at the depth image's time.
        gain: brightness of the frame = gain * brightness of the reference + bias.
        bias: see gain.
        time_offset: frame intervals by which the colour image is later than the depth image.
        velocity: [6] twist of the camera per frame interval.
        readout: fraction of the interval from the first row of an image to its last.
        scales: [2] of the residuals: of brightness in [0, 1], and of depth relative to the depth.
    """

    depth_motion: Matrix
    gain: float = 1.0
    bias: float = 0.0
    time_offset: float = 0.0
    velocity: Matrix = field(default_factory=lambda: np.zeros(6))
    readout: float = 0.0
    scales: Matrix = field(default_factory=lambda: np.array(_FIRST_SCALES))

    @property
    def color_motion(self) -> Matrix:
        """[4, 4] from the reference's camera to the frame's camera at the colour image's time."""
        return se3.exp(self.time_offset * self.velocity) @ self.depth_motion if self.time_offset else self.depth_motion

    def moved(self, step: Matrix) -> AlignmentState:
        """Returns the state after a step [10] of the unknowns."""
        return AlignmentState(
            depth_motion=se3.exp(step[:6]) @ self.depth_motion,
            gain=float(self.gain + step[6]),
            bias=float(self.bias + step[7]),
            time_offset=float(self.time_offset + step[8]),
            velocity=self.velocity,
            readout=float(self.readout + step[9]),
            scales=self.scales,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Descent(Generic[ImageT]):
    """What is aligned at one level of a pyramid, and what is known about it before.

    There are ten unknowns: the twist of the camera (6), gain and bias of the brightness, time offset and readout.

    Attributes:
        camera: the pinhole of reference and frame.
        brightness: [H, W] of the reference.
        depth: [H, W] of the reference.
        layers: [H, W, C] of the frame, see ``Aligner.layers``.
        max_depth_ratio: see ``Linearization``.
        predicted_motion: [4, 4] from the camera at the last pose to the reference's; None if that is not known.
        pace: how the camera is expected to move from frame to frame; counts where the predicted motion is known.
        mean: [10] of the unknowns; 0 for the twist, which is relative to the state.
        information: [10] inverse variances; those of twist, gain and bias of a step.
        is_free: [10] bool, which of the unknowns are solved for.
        scale_factors: [2] by which the scales of the residuals of brightness and depth are multiplied: roots of inverse weights.
        iterations: largest number of steps.
        small_step: m and rad: a smaller step is the last.
    """

    camera: PinholeCamera
    brightness: ImageT
    depth: ImageT
    layers: ImageT
    max_depth_ratio: float
    predicted_motion: Matrix | None
    pace: Pace
    mean: Matrix
    information: Matrix
    is_free: NDArray[np.bool_]
    scale_factors: Matrix
    iterations: int
    small_step: float

    def at(self, state: AlignmentState) -> Linearization[ImageT]:
        """Returns a state as the estimate at which the residuals are linearised."""
        photometric_scale, depth_scale = (state.scales * self.scale_factors).tolist()
        return Linearization(
            camera=self.camera,
            brightness=self.brightness,
            depth=self.depth,
            layers=self.layers,
            color_motion=state.color_motion.astype(np.float32),
            depth_motion=state.depth_motion.astype(np.float32),
            velocity=state.velocity.astype(np.float32),
            gain=state.gain,
            bias=state.bias,
            photometric_scale=photometric_scale,
            depth_scale=depth_scale,
            max_depth_ratio=self.max_depth_ratio,
            readout=(state.readout * state.velocity).astype(np.float32),
        )


class LinearSystem(Protocol):
    """The residuals of a reference in a frame, linearised at one estimate, and how well the two agree there.

    The unknowns are the twist of the camera (6), gain and bias of the brightness, and the time offset between colour and
    depth. A point is a pixel of the reference with depth.
    """

    @property
    def H(self) -> Matrix:
        """[9, 9] weighted normal matrix."""

    @property
    def g(self) -> Matrix:
        """[9] weighted gradient."""

    @property
    def H_by_time(self) -> Matrix:
        """[9, 9] what each row of the reference adds to ``H``, times when it is read: from -0.5 for the first to 0.5."""

    @property
    def H_by_time_squared(self) -> Matrix:
        """[9, 9] the same, times the square of that."""

    @property
    def g_by_time(self) -> Matrix:
        """[9] what each row adds to ``g``, times when it is read."""

    @property
    def cost(self) -> float:
        """Robust cost, summed over the points seen."""

    @property
    def points(self) -> int:
        """Number of points."""

    @property
    def compared(self) -> int:
        """Of these, points that project onto a depth reading of the frame."""

    @property
    def seen(self) -> int:
        """Of these, points on the same surface as the reading. Points without a reading enter ``H`` and ``g`` by colour alone."""

    @property
    def agreeing(self) -> int:
        """Of these, points whose residuals of brightness and depth are inliers."""

    @property
    def photometric_median(self) -> float:
        """Median absolute residual of brightness; NaN if no point is seen."""

    @property
    def depth_median(self) -> float:
        """Median absolute residual of depth, relative to the depth; NaN if no point is seen."""


class EvidenceSums(Protocol):
    """What ``tracking.evidence`` judges a pose by: sums over every n-th point of the reference.

    Cells are those of a grid over the image, row by row. The sums of a cell are, in this order: how many points are compared in
    brightness; how many meet a reading of the frame; of these, how many are near it; the expected brightness of the first, the
    brightness found, the squares of both, their product, and the absolute difference.
    """

    @property
    def claimed(self) -> Matrix:
        """[9, 9] weighted products of the derivatives that the frame's gradients give."""

    @property
    def shared(self) -> Matrix:
        """[9, 9] weighted products of the derivatives that the reference's gradients would give with those."""

    @property
    def scores(self) -> Matrix:
        """[9, cells] weighted products of the latter and the residuals."""

    @property
    def cells(self) -> Matrix:
        """[9, cells] the sums of the cells."""


@dataclass(frozen=True, slots=True, eq=False)
class Knowns:
    """What is known beside the sums of the evidence.

    Attributes:
        camera: of the images compared.
        step: every n-th pixel of every n-th row was compared.
        velocity: [6] twist by which the pose at the colour image's time changes per unit of time offset.
        prior: [9] inverse variances of the unknowns before the frame.
        prior_inflation: factor by which the prior of the time offset is stronger than its own variance says.
        is_free: [9] bool, which of the unknowns are solved for.
    """

    camera: PinholeCamera
    step: int
    velocity: Matrix
    prior: Matrix
    prior_inflation: float
    is_free: NDArray[np.bool_]


class PoseWeight(Protocol):
    """How far a pose may be trusted: see ``tracking.evidence.Evidence``."""

    @property
    def covariance(self) -> Matrix:
        """[6, 6]."""

    @property
    def num_open(self) -> int:
        """Number of directions that the images do not determine."""

    @property
    def explained(self) -> float:
        """Fraction of the cells that see the map in which brightness and depth fit."""

    @property
    def num_explained(self) -> int:
        """Number of these cells."""


class Aligner(Protocol[ImageT]):
    """The operations of direct alignment.

    Images are brightness [H, W] in [0, 1] and depth [H, W] in metres, NaN where there is none.
    """

    def layers(self, brightness: ImageT, depth: ImageT, max_step: float) -> ImageT:
        """Returns [H, W, 6 or more]: brightness, its gradients along u and v, depth, its gradients; then padding.

        Gradients are 0 at the border. Depth is NaN where it changes by more than the fraction ``max_step`` from one pixel
        to the next.
        """

    def frame_images(self, rgb8: Any, depth: ImageT, max_gap: int, max_step: float) -> tuple[ImageT, ImageT]:
        """Returns brightness and depth of a frame, with holes of the depth closed along rows and then along columns.

        A hole of at most ``max_gap`` pixels is closed where the depths on both sides differ by at most the fraction
        ``max_step`` of the nearer one. Inverse depth is interpolated, which is exact on a plane.

        Args:
            rgb8: [H, W, 3] uint8.
            depth: [H, W] metres; no number above 0 is no reading.
            max_gap: pixels.
            max_step: a fraction.
        """

    def render_images(
        self, rgb: ImageT, depth_acc: ImageT, silhouette: ImageT, threshold: float, least: float
    ) -> tuple[ImageT, ImageT]:
        """Returns brightness and depth of a ``Render``, without the black that shows where the silhouette dips.

        Depth is NaN where the silhouette is not above ``threshold``, or ``Render.depth`` is 0. To divide by, the silhouette
        counts as at least ``threshold`` and ``least``.
        """

    def halve(self, brightness: ImageT, depth: ImageT, max_step: float) -> tuple[ImageT, ImageT]:
        """Returns both images [H // 2, W // 2] as means of 2x2 blocks; depth is NaN where a block spans a depth edge."""

    def linearize(self, at: Linearization[ImageT], *, inlier_color: float, inlier_depth: float) -> LinearSystem:
        """Linearises the residuals of a reference in a frame.

        Args:
            at: both images, and the estimate.
            inlier_color: largest residual of brightness of an inlier.
            inlier_depth: largest residual of depth of an inlier.
        """

    def descend(self, task: Descent[ImageT], start: AlignmentState) -> AlignmentState:
        """Returns the state after steps of Gauss-Newton from a start, as ``tracking.descent`` takes them."""

    def evidence(self, at: Linearization[ImageT], *, max_depth_error: float, step: int) -> EvidenceSums:
        """Sums what the residuals at the end of an alignment say about the pose.

        Args:
            at: both images, and the estimate.
            max_depth_error: relative depth by which a point near the map differs at most.
            step: every n-th pixel of every n-th row is compared.
        """

    def weigh(self, sums: EvidenceSums, known: Knowns) -> PoseWeight:
        """Returns how far a pose may be trusted, as ``tracking.evidence.weigh`` does.

        Args:
            sums: at the pose.
            known: what is known beside them.

        Raises:
            LinAlgError: rounding leaves no system of equations to solve.
        """
