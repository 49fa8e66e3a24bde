"""How far an alignment may be trusted: its covariance, what it leaves open, and where in the view it explains the frame.

Gauss-Newton's normal equations alone claim far too much, because errors of neighbouring pixels are alike: those of calibration,
rolling shutter and the map, and the smoothing of the images. So the gradient of the cost is summed over the cells of a grid,
and the scatter of these sums says how well the pose is determined: the covariance for clustered errors (Liang and Zeger,
"Longitudinal data analysis using generalized linear models", Biometrika 1986). Cells that touch are taken together, because
errors do not end where a cell does.

On a blank wall the gradients of the frame are noise, which looks like information. A gradient of the frame counts only as far
as that of the render shows it too: the noise of the two is independent (instrumental variables). Where next to nothing is left
of what the frame alone claims, the images do not determine the pose.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatam_core.geometry import se3
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.geometry.se3 import Matrix
from splatam_core.tracking.aligner import EvidenceSums, Knowns, Linearization

Image = NDArray[np.float32]
Values = NDArray[np.float32]
Mask = NDArray[np.bool_]

ROWS, COLUMNS = 6, 8
_MAX_COLUMNS = 80  # points compared along a row: more of them add time, but hardly any knowledge
_NUM_UNKNOWNS, _TWIST, _TIME_OFFSET = 9, slice(0, 6), 8
_UNKNOWN = 3.0  # m and rad, where nothing is known
_MIN_CORRELATION = 0.5
_MIN_CONTRAST = 0.02  # standard deviation of brightness in a cell of the render
_MAX_DIFFERENCE = 0.1  # of brightness, in a cell without contrast
_MAX_DEPTH_ERROR = 0.02  # relative; more where the depth of the frame as a whole scatters more
_MIN_FILLED = 0.25  # of a cell


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """What the residuals say about a pose.

    The error of a pose is the twist xi with ``T_cam_world (true) = exp(xi) @ T_cam_world``: m and rad, in the camera's axes.

    Attributes:
        covariance: [6, 6] of the twist; metres where the images do not determine it.
        num_open: number of directions that they do not determine.
        explained: fraction of the cells that see the map in which brightness and depth fit.
        num_explained: number of these cells.
        pixel_rad: angle that a pixel of the images compared is across.
    """

    covariance: Matrix
    num_open: int
    explained: float
    num_explained: int
    pixel_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class Sums:
    """See ``EvidenceSums``."""

    claimed: Matrix
    shared: Matrix
    scores: Matrix
    cells: Matrix


def step_of(camera: PinholeCamera) -> int:
    """Returns how many pixels apart the points are that evidence compares."""
    return max(1, -(-camera.width // _MAX_COLUMNS))


def max_depth_error(depth_scale: float) -> float:
    """Returns the relative depth by which a point near the map differs at most, from the scale of the residuals."""
    return max(_MAX_DEPTH_ERROR, 3 * depth_scale)


def summed(at: Linearization[Image], max_depth_error: float, step: int) -> Sums:
    """Returns what ``Aligner.evidence`` does, in numpy; the native aligner takes a tenth of the time."""
    points = _Points.of(at, step)
    own, shared = points.by_frame(at), points.by_reference(at)
    scores = shared.brightness * (points.weights[0] * points.residuals[0])
    scores[_TWIST] += shared.depth * (points.weights[1] * points.residuals[1])
    fit = points.fit(at, max_depth_error)
    return Sums(_normal_matrix(own, own, points), _normal_matrix(shared, own, points), points.cells(scores), points.cells(fit))


def weigh(sums: EvidenceSums, at: Knowns) -> Evidence:
    """Returns what the residuals at the end of an alignment say about the pose.

    The native aligner does the same in ``csrc/weigh.cpp``, in a thirtieth of the time.
    """
    free = np.flatnonzero(at.is_free)
    of_others = np.diag(np.where(np.arange(_NUM_UNKNOWNS) < 6, 0.0, at.prior))
    of_twist = np.diag(at.prior) - of_others
    claimed = _marginal(sums.claimed + of_others + of_twist, free)
    information = sums.shared + of_others
    by_chance = 1 / math.sqrt(max(1, int(sums.cells[0].sum())))
    directions = _open_directions(claimed, _marginal(information, free), by_chance)
    covariance = _clustered(sums.scores, information + of_twist, at)
    left_open = directions @ directions.T @ claimed
    determined = np.eye(6) - left_open
    fits, judged = _fitting_cells(sums.cells, _cell_sizes(at.camera, at.step))
    return Evidence(
        covariance=determined @ covariance @ determined.T + _UNKNOWN**2 * left_open @ left_open.T,
        num_open=directions.shape[1],
        explained=float(fits.sum() / max(1, judged.sum())),
        num_explained=int(fits.sum()),
        pixel_rad=1 / at.camera.fx,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Jacobians:
    """Derivatives of the residuals by the unknowns: [9, P] of brightness, [6, P] of depth; 0 where not compared."""

    brightness: Values
    depth: Values


@dataclass(frozen=True, slots=True, eq=False)
class _Moved:
    """Points moved into the frame's camera and projected; [P] each."""

    x: Values
    y: Values
    z: Values
    u: Values
    v: Values
    inside: Mask

    @classmethod
    def of(cls, points: Values, camera: PinholeCamera) -> _Moved:
        """Projects points [3, P] in the frame's camera."""
        x, y, z = points
        in_front = z > 0
        z = np.where(in_front, z, np.float32(1))
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        inside = in_front & (u >= 0) & (v >= 0) & (u < camera.width - 1) & (v < camera.height - 1)
        return cls(x, y, z, np.where(inside, u, np.float32(0)), np.where(inside, v, np.float32(0)), inside)

    def sampled(self, layers: Image) -> Values:
        """Returns [C, P] of layers [H, W, C] at the points, bilinearly; anything outside."""
        height, width, channels = layers.shape
        column, row = self.u.astype(np.int32), self.v.astype(np.int32)
        right, below = (self.u - column)[:, None], (self.v - row)[:, None]
        first, flat = row * width + column, layers.reshape(-1, channels)
        ahead, down = int(width > 1), width if height > 1 else 0
        upper = flat[first] * (1 - right) + flat[first + ahead] * right
        lower = flat[first + down] * (1 - right) + flat[first + down + ahead] * right
        return np.ascontiguousarray((upper * (1 - below) + lower * below).T)

    def by_twist(self, along_u: Values, along_v: Values, camera: PinholeCamera) -> Values:
        """Returns [6, P] derivatives of an image value at the points, of given gradients, by a twist that moves them."""
        inverse_z = 1 / self.z
        a, b = along_u * camera.fx * inverse_z, along_v * camera.fy * inverse_z
        c = -(a * self.x + b * self.y) * inverse_z
        return np.stack([a, b, c, c * self.y - b * self.z, a * self.z - c * self.x, b * self.x - a * self.y])

    def incidence_cosine(self, layers: Values, camera: PinholeCamera) -> Values:
        """Returns [P] cosines between ray and surface normal: they turn a difference of depth into a distance."""
        across, down = layers[4] * camera.fx / self.z, layers[5] * camera.fy / self.z
        return 1 / np.sqrt(1 + across * across + down * down)


@dataclass(frozen=True, slots=True, eq=False)
class _Points:
    """The P points of the reference that are compared: every n-th pixel, where it has depth.

    Attributes:
        cell: [P] the cell of each.
        at_color: moved to the colour image.
        at_depth: moved to the depth image.
        reference: [6, P] layers of the reference, see ``Aligner.layers``.
        frame: [6, P] layers of the frame at the points.
        lit: [P] which are compared in brightness.
        seen: [P] which are compared in depth.
        met: [P] which meet a reading of the frame, on whatever surface.
        residuals: [2, P] of brightness and depth; 0 where not compared.
        weights: [2, P] robust weights over squared scales.
    """

    cell: NDArray[np.intp]
    at_color: _Moved
    at_depth: _Moved
    reference: Values
    frame: Values
    lit: Mask
    seen: Mask
    met: Mask
    residuals: Values
    weights: Values

    @classmethod
    def of(cls, at: Linearization[Image], step: int) -> _Points:
        """Samples both images, as ``Aligner.linearize`` does at every pixel."""
        camera = at.camera
        rows, columns = (np.arange(step // 2, side, step) for side in (camera.height, camera.width))
        layers = _layers(at.brightness, at.depth)[:, rows[:, None], columns].reshape(6, -1)
        cells = _cells(len(rows), len(columns))
        known = np.flatnonzero(layers[3] > 0)  # False for NaN
        reference, z = layers[:, known], layers[3, known]
        u, v = columns[known % len(columns)], rows[known // len(columns)]
        points = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z]).astype(np.float32)
        times = (rows[known // len(columns)] / max(1, camera.height - 1) - 0.5 * (camera.height > 1)).astype(np.float32)
        at_depth = _Moved.of(_carried(points, at.depth_motion, at.readout, times), camera)
        frame = at_depth.sampled(at.layers)[:6]
        at_color = at_depth
        if not np.array_equal(at.color_motion, at.depth_motion):
            at_color = _Moved.of(_carried(points, at.color_motion, at.readout, times), camera)
            frame[:3] = at_color.sampled(at.layers)[:3]
        met = at_depth.inside & ~np.isnan(frame[3])
        off = frame[3] / at_depth.z - 1
        seen = met & at_color.inside & (np.abs(off) < at.max_depth_ratio)
        lit = at_color.inside & at_depth.inside & (seen | np.isnan(frame[3]))
        difference = frame[0] - (np.float32(at.gain) * reference[0] + np.float32(at.bias))
        across = off * at_depth.incidence_cosine(frame, camera)
        residuals = np.stack([np.where(lit, difference, 0), np.where(seen, across, 0)]).astype(np.float32)
        precisions = 1 / np.square(np.array((at.photometric_scale, at.depth_scale), np.float32))[:, None]
        weights = (6 / (5 + residuals**2 * precisions) * precisions).astype(np.float32)  # Student's t with five degrees of freedom
        return cls(
            cell=cells[known],
            at_color=at_color,
            at_depth=at_depth,
            reference=reference,
            frame=frame,
            lit=lit,
            seen=seen,
            met=met,
            residuals=residuals,
            weights=weights,
        )

    def cells(self, values: NDArray[Any]) -> NDArray[np.float64]:
        """Returns [K, cells] sums of values [K, P] over the cells."""
        return np.stack([np.bincount(self.cell, of_one, ROWS * COLUMNS) for of_one in values])

    def by_frame(self, at: Linearization[Image]) -> _Jacobians:
        """Returns the derivatives that the frame's gradients give: those that Gauss-Newton uses."""
        return self._jacobians(self.frame, 1.0, at)

    def by_reference(self, at: Linearization[Image]) -> _Jacobians:
        """Returns the derivatives that the reference's gradients would give."""
        return self._jacobians(self.reference, at.gain, at)

    def _jacobians(self, layers: Values, gain: float, at: Linearization[Image]) -> _Jacobians:
        by_brightness = self.at_color.by_twist(np.float32(gain) * layers[1], np.float32(gain) * layers[2], at.camera)
        others = [-self.reference[0], np.full_like(self.reference[0], -1), at.velocity @ by_brightness]
        point = self.at_depth
        by_depth = point.by_twist(layers[4], layers[5], at.camera)
        by_depth[2] -= 1
        by_depth[3] -= point.y
        by_depth[4] += point.x
        by_depth *= point.incidence_cosine(layers, at.camera) / point.z
        return _Jacobians(
            np.where(self.lit, np.vstack([by_brightness, others]), np.float32(0)),
            np.where(self.seen & ~np.isnan(by_depth[0]), by_depth, np.float32(0)),
        )

    def fit(self, at: Linearization[Image], max_depth_error: float) -> NDArray[Any]:
        """Returns [9, P] what ``EvidenceSums.cells`` sums."""
        expected, found = (np.where(self.lit, image, 0) for image in (at.gain * self.reference[0] + at.bias, self.frame[0]))
        near = self.met & (np.abs(self.frame[3] / self.at_depth.z - 1) < max_depth_error)
        moments = [expected, found, expected * expected, found * found, expected * found, np.abs(self.residuals[0])]
        return np.stack([self.lit, self.met, near, *moments])


def _carried(points: Values, T: Image, readout: Image, times: Values) -> Values:
    """Moves points [3, P] by a motion [4, 4] at the middle row, and on by a twist [6], as ``csrc/readout.hpp`` does."""
    moved = T[:3, :3] @ points + T[:3, 3:]
    turn = se3.skew(readout[3:].astype(np.float64)).astype(np.float32)
    speed = turn @ moved + readout[:3, None]
    return moved + times * (speed + np.float32(0.5) * times * (turn @ speed))


def _fitting_cells(sums: Matrix, sizes: NDArray[np.intp]) -> tuple[Mask, Mask]:
    """Returns [cells] which cells of some sizes fit in brightness and in depth, and which see enough of the map to be judged."""
    num_lit, num_met, num_near = sums[:3]
    mean, mean_found, square, square_found, product, difference = sums[3:] / np.maximum(num_lit, 1)
    spread, spread_found = square - mean**2, square_found - mean_found**2
    correlation = (product - mean * mean_found) / np.sqrt(np.maximum(spread * spread_found, 1e-12))
    fits = np.where(spread > _MIN_CONTRAST**2, correlation > _MIN_CORRELATION, difference < _MAX_DIFFERENCE)
    enough = _MIN_FILLED * sizes
    fits &= (num_met < enough) | (2 * num_near >= num_met)
    judged = (np.maximum(num_lit, num_met) >= enough) & (enough > 0)
    return fits & judged, judged


@lru_cache(maxsize=4)
def _cell_sizes(camera: PinholeCamera, step: int) -> NDArray[np.intp]:
    """Returns [cells] how many pixels of each cell are compared where they have depth."""
    height, width = (len(range(step // 2, side, step)) for side in (camera.height, camera.width))
    return np.bincount(_cells(height, width), minlength=ROWS * COLUMNS)


def _layers(brightness: Image, depth: Image) -> Image:
    """Returns [6, H, W] both images and their gradients, which are 0 at the border."""
    layers = np.zeros((6, *brightness.shape), np.float32)
    for first, image in ((0, brightness), (3, depth)):
        layers[first] = image
        layers[first + 1, 1:-1, 1:-1] = 0.5 * (image[1:-1, 2:] - image[1:-1, :-2])
        layers[first + 2, 1:-1, 1:-1] = 0.5 * (image[2:, 1:-1] - image[:-2, 1:-1])
    return layers


@lru_cache(maxsize=4)
def _cells(height: int, width: int) -> NDArray[np.intp]:
    """Returns [height * width] the cell of each pixel; cells are numbered row by row."""
    rows, columns = (np.arange(side) * count // side for side, count in ((height, ROWS), (width, COLUMNS)))
    return (rows[:, None] * COLUMNS + columns).ravel()


def _normal_matrix(left: _Jacobians, right: _Jacobians, points: _Points) -> Matrix:
    """Returns [9, 9] weighted products of derivatives, summed over the points."""
    H = ((left.brightness * points.weights[0]) @ right.brightness.T).astype(np.float64)
    H[_TWIST, _TWIST] += (left.depth * points.weights[1]) @ right.depth.T
    return H


def _marginal(H: Matrix, free: NDArray[np.intp]) -> Matrix:
    """Returns the symmetric [6, 6] part of a normal matrix [9, 9] that is left for the twist, the other unknowns solved for."""
    H = 0.5 * (H + H.T)
    others = free[free >= 6]
    if not len(others):
        return H[_TWIST, _TWIST]
    return H[_TWIST, _TWIST] - H[_TWIST, others] @ np.linalg.solve(H[np.ix_(others, others)], H[others, _TWIST])


def _open_directions(claimed: Matrix, shared: Matrix, least: float) -> Matrix:
    """Returns [6, K] twists of whose information the images share less than a fraction, orthonormal under that claimed."""
    root = np.linalg.inv(np.linalg.cholesky(claimed))
    fractions, vectors = np.linalg.eigh(root @ shared @ root.T)
    return root.T @ vectors[:, fractions < least]


def _clustered(scores: Matrix, information: Matrix, at: Knowns) -> Matrix:
    """Returns the [6, 6] covariance of the twist at the colour image's time, from the scores [9, cells]."""
    padded = np.zeros((_NUM_UNKNOWNS, ROWS + 2, COLUMNS + 2))
    padded[:, 1:-1, 1:-1] = scores.reshape(_NUM_UNKNOWNS, ROWS, COLUMNS)
    blocks = (padded[:, :-1, :-1] + padded[:, 1:, :-1] + padded[:, :-1, 1:] + padded[:, 1:, 1:]).reshape(_NUM_UNKNOWNS, -1)
    scatter = blocks @ blocks.T / 4  # each cell is in four blocks
    num_cells = int((scores != 0).any(axis=0).sum())
    scatter *= num_cells / max(num_cells - 6, 0.5)  # six of them can be fitted exactly
    known_before = at.prior.copy()
    known_before[_TWIST] = 0  # of a step only
    known_before[_TIME_OFFSET] *= at.prior_inflation
    scatter += np.diag(known_before)
    free = np.flatnonzero(at.is_free)
    inverse = np.linalg.pinv(information[np.ix_(free, free)])
    covariance = np.zeros((_NUM_UNKNOWNS, _NUM_UNKNOWNS))
    covariance[np.ix_(free, free)] = inverse @ scatter[np.ix_(free, free)] @ inverse.T
    to_color = np.hstack([np.eye(6), np.zeros((6, 2)), at.velocity[:, None]])
    return to_color @ covariance @ to_color.T
