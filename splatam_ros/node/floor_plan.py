"""The occupancy grid of a node: which way is up, and the message. Everything here runs on the worker's thread."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msg_adapters.factory import MessageFactory
from msg_adapters.grids import grid_message
from splatam_core.errors import ExportError
from splatam_core.geometry import se3
from splatam_core.mapping.posed import PosedView
from splatam_core.maps.grid import DepthView, find_floor, points_of, upright
from splatam_core.maps.keyframe_grid import KeyframeGrid
from splatam_core.slam import Slam
from splatam_ros.frames.rep105 import Located
from splatam_ros.node.parameters import NodeOptions
from splatam_ros.throttled_warnings import ThrottledWarnings

Matrix = NDArray[np.float64]

AT_ONCE = 6
"""Keyframes that are carved or moved for one message; each takes some 5 ms. The others follow with the next messages."""

FIRST_LOOK, MAX_LOOK = 3, 30
"""Number of keyframes from which the floor is looked for at first, and at most."""


LOWEST_PERCENT = 1.0  # of the points that are seen; lower ones are errors of depth


class FloorPlan:
    """Makes ``~/map/grid`` of the keyframes.

    Up is the base's z axis if ``base_frame`` is set; else against gravity, with ``grid.imu``; else the normal of the floor,
    once it was seen.
    """

    def __init__(self, warnings: ThrottledWarnings) -> None:
        """Begin without a map.

        Args:
            warnings: receives a warning while it is not known which way is up.
        """
        self._warnings = warnings
        self.begin_map()

    def begin_map(self) -> None:
        """Forget everything: a new map begins."""
        self._grid: KeyframeGrid | None = None
        self._next_look = FIRST_LOOK

    def message(
        self, slam: Slam, located: Located, options: NodeOptions, factory: MessageFactory, *, is_complete: bool = False
    ) -> Any:
        """Return the grid as a message; None, after a warning, if there is none yet.

        Args:
            slam: has the keyframes.
            located: the newest camera in the coordinate frames of ROS.
            options: the node's options.
            factory: makes the message.
            is_complete: True to take in every keyframe now, False to leave some for the next message.
        """
        keyframes = slam.keyframes
        try:
            plan = self._plan(keyframes, located, options)
            if plan is None:
                return None
            plan.update(keyframes, len(keyframes) if is_complete else AT_ONCE)
            grid = plan.grid()
        except ExportError as error:
            self._warnings.warn('grid', f'nothing is published on ~/map/grid: {error}')
            return None
        if plan.left_out:
            self._warnings.warn('grid', f'~/map/grid shows a part of the map: {plan.left_out}')
        T_grid_corner = np.eye(4)
        T_grid_corner[:2, 3] = grid.origin_m
        T_map_corner = located.T_map_world @ se3.inverse(grid.T_grid_world) @ T_grid_corner
        return grid_message(
            factory, grid.cells, grid.resolution_m, T_map_corner, stamp_ns=located.stamp_ns, frame_id=options.map_frame
        )  # fmt: skip

    def _plan(self, keyframes: Sequence[PosedView], located: Located, options: NodeOptions) -> KeyframeGrid | None:
        """Returns the grid of these options; None while the floor has not been looked for.

        Raises:
            ExportError: it was, and not seen.
        """
        if self._grid is not None and self._grid.settings != options.grid:
            self._grid = KeyframeGrid(self._grid.T_grid_world, options.grid)
        if self._grid is None:
            T_world_map = se3.inverse(located.T_map_world)
            if options.base_frame:
                T_world_base = T_world_map @ located.T_map_body
                up, on_floor = T_world_base[:3, 2], T_world_base[:3, 3]
            elif options.grid_imu:
                if located.up_world is None:
                    raise ExportError('it is not known which way is up: the Imu on the topic imu has not rested yet')
                up, on_floor = located.up_world, _lowest(keyframes, located.up_world, options)
            elif len(keyframes) >= self._next_look:
                self._next_look = 2 * len(keyframes)
                up, on_floor = _floor(keyframes, options)
            else:
                return None
            self._grid = KeyframeGrid(along_map(up, on_floor, T_world_map), options.grid)
        return self._grid


def _floor(keyframes: Sequence[PosedView], options: NodeOptions) -> tuple[Matrix, Matrix]:
    """Returns the upward direction [3] and a point [3] of the floor that keyframes see, in the world.

    Raises:
        ExportError: they see none.
    """
    camera = keyframes[-1].view.camera  # a loaded map may be of another one
    seen = [keyframe for keyframe in keyframes if keyframe.view.camera == camera]
    chosen = seen[:: -(-len(seen) // MAX_LOOK)]
    views = [_depth_view(keyframe) for keyframe in chosen]
    try:
        T_world_floor = se3.inverse(find_floor(views, camera, options.grid_range))
    except ExportError as error:
        raise ExportError(f'{error}; set base_frame, whose z axis is taken to point up') from None
    return T_world_floor[:3, 2], T_world_floor[:3, 3]


def _lowest(keyframes: Sequence[PosedView], up: Matrix, options: NodeOptions) -> Matrix:
    """Returns a point [3] of the world at the height of the lowest surface that keyframes see: the floor, if they see it.

    Raises:
        ExportError: they see nothing in range.
    """
    points = np.concatenate([
        points_of(_depth_view(keyframe), keyframe.view.camera, options.grid_range, stride=4)
        for keyframe in keyframes[:: max(1, -(-len(keyframes) // MAX_LOOK))]
    ] or [np.zeros((0, 3))])  # fmt: skip
    if not len(points):
        raise ExportError('there is no grid: nothing is within range')
    return float(np.percentile(points @ up, LOWEST_PERCENT)) * up


def _depth_view(keyframe: PosedView) -> DepthView:
    return DepthView(keyframe.view.depth.numpy(), se3.inverse(keyframe.T_cam_world.numpy().astype(np.float64)))


def along_map(up: Matrix, on_floor: Matrix, T_world_map: Matrix) -> Matrix:
    """Return T_grid_world [4, 4]: z up, 0 on the floor; x along that of the map, whose origin is above the grid's.

    Args:
        up: [3] direction in the world.
        on_floor: [3] a point of the floor.
        T_world_map: [4, 4] the map's frame.
    """
    T_world_forward = T_world_map.copy()
    T_world_forward[:3, :3] = T_world_map[:3, [1, 2, 0]]  # ``upright`` looks along z, here the map's x
    return upright(up, on_floor, T_world_forward)
