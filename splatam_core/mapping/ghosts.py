"""What has gone: something that moved through the view and was mapped stays in the map as a ghost, until a frame sees through it.

What is seen where an earlier view saw through must have moved there: it is not mapped. What moves into a part of the world that was
not seen before cannot be told from a surface. It is mapped, and what a later frame sees through is taken back: its Gaussians, and
the part of the keyframes that shows it, which would bring it back otherwise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from splatam_core.images.filters import box_sums
from splatam_core.images.view import View, unproject
from splatam_core.mapping.posed import PosedView
from splatam_core.rasterizer import Render
from splatam_core.rasterizer.base import NOT_COMPARED

_BEHIND = 0.1  # a reading that is farther than the map by this fraction sees through it
_SAME = 0.05  # depths that differ by less than this fraction may be those of one surface
_LEAST_SIDE = 0.04  # of the width: a narrower strip may be a depth edge, seen from a pose that is slightly off
_LEAST_SHARE = 0.01  # of the view
_MOST_SHARE = 0.25  # of the view: more is a sign of a wrong pose
_AROUND = 0.02  # of the width: what is between points that have gone has gone, too


@dataclass(frozen=True, slots=True, eq=False)
class _Projected:
    """N points in a view.

    Attributes:
        row: [N] the nearest pixel; any where the point is not in the view.
        column: [N].
        z: [N] metres.
        inside: [N] which are in the view.
    """

    row: Tensor
    column: Tensor
    z: Tensor
    inside: Tensor

    @classmethod
    def of(cls, means: Tensor, posed: PosedView) -> _Projected:
        """Projects points [N, 3] of the world."""
        camera, T = posed.view.camera, posed.T_cam_world
        x, y, z = (means @ T[:3, :3].T + T[:3, 3]).unbind(1)
        in_front = z > 0
        inverse_z = 1 / torch.where(in_front, z, 1.0)
        u, v = (camera.fx * x * inverse_z + camera.cx).round(), (camera.fy * y * inverse_z + camera.cy).round()
        inside = in_front & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
        return cls(torch.where(inside, v, 0).long(), torch.where(inside, u, 0).long(), z, inside)


def seen_through(render: Render, view: View) -> Tensor | None:
    """Returns [H, W] bool, where a view sees through the map rendered from there; None where that is but a small part."""
    depth, side = render.depth(), _side(view, _LEAST_SIDE)
    core = _core((depth > 0) & (view.depth > (1 + _BEHIND) * depth), side)
    return None if core is None else (box_sums(core, side) > 0.5) & view.valid


def moved_in(render: Render, posed: PosedView, before: Sequence[PosedView]) -> Tensor | None:
    """Returns [H, W] bool, where a view shows something in front of the map, where earlier views saw through; None if nowhere."""
    view, side = posed.view, _side(posed.view, _LEAST_SIDE)
    in_front = view.valid & (render.depth() > (1 + _BEHIND) * view.depth)
    if _core(in_front, side) is None:
        return None
    v, u = torch.nonzero(in_front, as_tuple=True)
    T_world_cam = torch.linalg.inv(posed.T_cam_world)
    points = unproject(view.camera, u, v, view.depth[v, u]) @ T_world_cam[:3, :3].T + T_world_cam[:3, 3]
    was_free = torch.zeros_like(u, dtype=torch.bool)
    for earlier in before:
        at = _Projected.of(points, earlier)
        was_free |= at.inside & (earlier.view.depth[at.row, at.column] > (1 + _BEHIND) * at.z)
    core = _core(torch.zeros_like(in_front).masked_scatter(in_front, was_free), side)
    return None if core is None else box_sums(core, side) > 0.5


def ghosts(means: Tensor, posed: PosedView, gone: Tensor) -> Tensor:
    """Returns [N] bool, which points [N, 3] are in front of what a view sees, where it sees through the map [H, W]."""
    at = _Projected.of(means, posed)
    return at.inside & gone[at.row, at.column] & ((1 + _SAME) * at.z < posed.view.depth[at.row, at.column])


def without(keyframe: PosedView, means: Tensor) -> PosedView:
    """Returns a keyframe in which nothing is compared where it shows points [K, 3] that have gone; itself if it shows none."""
    view, at = keyframe.view, _Projected.of(means, keyframe)
    is_shown = at.inside & ((at.z - view.depth[at.row, at.column]).abs() < _SAME * at.z)
    if not is_shown.any():
        return keyframe
    shown = torch.zeros_like(view.depth)
    shown[at.row[is_shown], at.column[is_shown]] = 1
    depth = torch.where(box_sums(shown, _side(view, _AROUND)) > 0.5, NOT_COMPARED, view.depth)
    return replace(keyframe, view=replace(view, depth=depth))


def _core(mask: Tensor, side: int) -> Tensor | None:
    """Returns [H, W] the centres of squares that a mask [H, W] fills; None if they are too little or too much of the view."""
    core = (box_sums(mask.float(), side) > side * side - 0.5).float()
    return core if _LEAST_SHARE * core.numel() < core.sum() < _MOST_SHARE * core.numel() else None


def _side(view: View, share: float) -> int:
    """Returns the side of a square in pixels, an odd number, that is a share of the width."""
    return 2 * max(1, round(0.5 * share * view.camera.width)) + 1
