"""Types of the native extension, which ``csrc/bindings.cpp`` defines.

Arrays are C-contiguous and have exactly the stated type and shape, else they are a TypeError that names the argument; nothing is
converted or copied. Only 4x4 poses may have any strides.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from splatam_core.geometry.camera import PinholeCamera
from splatam_core.tracking.aligner import AlignmentState, Descent, Knowns, Linearization
from splatam_core.tracking.aligner import EvidenceSums as GivenSums

Floats = NDArray[np.float32]
Bytes = NDArray[np.uint8]
Doubles = NDArray[np.float64]

class UndeterminedError(np.linalg.LinAlgError):
    """A system of equations without a solution."""

BLOCK: int
"""Gaussians per row of ``Gaussians.bounds``."""

class TooLargeError(ValueError):
    """A view that cannot be drawn: more than 32768 pixels a side, or more than 2^26 pairs of a Gaussian and a tile."""

class View:
    """What ``Engine.forward`` stores for ``Engine.backward``."""

class Engine:
    """Renders and fits isotropic Gaussians."""

    def __init__(self, threads: int) -> None: ...
    @property
    def instruction_set(self) -> str:
        """``generic``, ``avx2`` or ``avx512``."""

    def forward(
        self,
        *,
        means: Floats,
        log_scales: Floats,
        logit_opacities: Floats,
        rgb: Floats,
        bounds: Floats | None,
        T_cam_world: Floats,
        camera: PinholeCamera,
        image: Floats,
        depth: Floats,
        silhouette: Floats,
    ) -> View:
        """Draws Gaussians; writes image [3, H, W], depth [H, W] (``depth_acc``) and silhouette [H, W]."""

    def backward(
        self,
        view: View,
        *,
        means: Floats,
        log_scales: Floats,
        logit_opacities: Floats,
        rgb: Floats,
        image_gradients: Sequence[Floats],
        means_gradient: Floats | None,
        log_scales_gradient: Floats | None,
        logit_opacities_gradient: Floats | None,
        rgb_gradient: Floats | None,
        pose_gradient: Floats,
    ) -> None:
        """Writes gradients of a loss, given those by the three images.

        The gradients by the Gaussians must be zero before; None where one is not wanted. ``pose_gradient`` is [4, 4].
        """

    def fit(
        self,
        *,
        means: Floats,
        log_scales: Floats,
        logit_opacities: Floats,
        rgb: Floats,
        bounds: Floats | None,
        moments: Floats,
        steps: Bytes,
        rates: tuple[float, float, float, float],
        T_cam_world: Floats,
        camera: PinholeCamera,
        target_rgb: Bytes,
        target_depth: Floats,
        color_weight: float,
        depth_weight: float,
        color_limit: float,
        depth_limit: float,
        enough: float,
    ) -> float:
        """Takes one Adam step in place, with ``rates`` for the first four arrays. Returns the loss before the step.

        Tiles with less loss per pixel than ``enough`` give no gradients.
        """

class LinearSystem:
    """See ``tracking.aligner.LinearSystem``."""

    @property
    def H(self) -> NDArray[np.float64]: ...
    @property
    def g(self) -> NDArray[np.float64]: ...
    @property
    def H_by_time(self) -> NDArray[np.float64]: ...
    @property
    def H_by_time_squared(self) -> NDArray[np.float64]: ...
    @property
    def g_by_time(self) -> NDArray[np.float64]: ...
    @property
    def cost(self) -> float: ...
    @property
    def points(self) -> int: ...
    @property
    def compared(self) -> int: ...
    @property
    def seen(self) -> int: ...
    @property
    def agreeing(self) -> int: ...
    @property
    def photometric_median(self) -> float: ...
    @property
    def depth_median(self) -> float: ...

class EvidenceSums:
    """See ``tracking.aligner.EvidenceSums``."""

    @property
    def claimed(self) -> NDArray[np.float64]: ...
    @property
    def shared(self) -> NDArray[np.float64]: ...
    @property
    def scores(self) -> NDArray[np.float64]: ...
    @property
    def cells(self) -> NDArray[np.float64]: ...

class PoseWeight:
    """See ``tracking.aligner.PoseWeight``."""

    @property
    def covariance(self) -> NDArray[np.float64]: ...
    @property
    def num_open(self) -> int: ...
    @property
    def explained(self) -> float: ...
    @property
    def num_explained(self) -> int: ...

class Aligner:
    """See ``tracking.aligner.Aligner``. Layers have two more channels of padding."""

    def __init__(self, threads: int) -> None: ...
    def layers(self, brightness: Floats, depth: Floats, max_step: float) -> Floats: ...
    def frame_images(self, rgb8: Bytes, depth: Floats, max_gap: int, max_step: float) -> tuple[Floats, Floats]: ...
    def render_images(
        self, rgb: Floats, depth_acc: Floats, silhouette: Floats, threshold: float, least: float
    ) -> tuple[Floats, Floats]: ...
    def halve(self, brightness: Floats, depth: Floats, max_step: float) -> tuple[Floats, Floats]: ...
    def linearize(self, at: Linearization[Floats], *, inlier_color: float, inlier_depth: float) -> LinearSystem: ...
    def descend(self, task: Descent[Floats], start: AlignmentState) -> AlignmentState: ...
    def evidence(self, at: Linearization[Floats], *, max_depth_error: float, step: int) -> EvidenceSums: ...
    def weigh(self, sums: GivenSums, known: Knowns) -> PoseWeight: ...

def solve_blocks(place: NDArray[np.int32], blocks: Doubles, right_hand_side: Doubles) -> None:
    """Solves a sparse symmetric system of 6x6 blocks; the solution [N, 6] replaces the right-hand side.

    ``blocks`` [K, 6, 6] are those of the lower triangle, at row and column ``place`` [K, 2]; blocks at one place are added. A
    matrix that is not positive definite is a ValueError.
    """

def match(ours: Bytes, others: Bytes) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Returns for each descriptor [N, 32] its mutually nearest one of the others [M, 32], and in how many bits; or -1 and -1."""

class TileLists:
    """What ``Blender.forward`` stores for ``Blender.backward``."""

class Blender:
    """Blends ellipses front to back: the image half of anisotropic rendering."""

    def __init__(self, threads: int) -> None: ...
    def forward(self, shapes: Floats, features: Floats, image: Floats) -> TileLists:
        """Writes image [5, H, W], from shapes [K, 6] (u, v, conic, opacity) and features [K, 4] (rgb, z), front to back."""

    def backward(
        self,
        lists: TileLists,
        *,
        shapes: Floats,
        features: Floats,
        image: Floats,
        image_gradient: Floats,
        shapes_gradient: Floats,
        features_gradient: Floats,
    ) -> None:
        """Writes the gradients of a loss, given that by the image, which must be as drawn."""
