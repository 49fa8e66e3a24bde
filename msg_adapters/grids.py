"""Makes nav_msgs/OccupancyGrid."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from msg_adapters import poses, stamps
from msg_adapters.factory import MessageFactory


def grid_message(
    factory: MessageFactory, cells: NDArray[np.int8], resolution_m: float, T_frame_origin: NDArray[np.float64], *,
    stamp_ns: int, frame_id: str,
) -> Any:  # fmt: skip
    """Make a ``nav_msgs/OccupancyGrid``.

    Args:
        factory: makes the messages.
        cells: [rows, columns] 0 = free, 100 = occupied, -1 = unknown; the first row has the smallest y.
        resolution_m: side of a cell.
        T_frame_origin: [4, 4] the corner of the first cell, with the grid's axes, in the frame.
        stamp_ns: stamp of the message, and time of the map.
        frame_id: coordinate frame.
    """
    rows, columns = cells.shape
    stamp = stamps.time_message(factory, stamp_ns)
    info = factory.make(
        'nav_msgs/msg/MapMetaData', map_load_time=stamp, resolution=float(resolution_m), width=columns, height=rows,
        origin=poses.pose_message(factory, T_frame_origin),
    )  # fmt: skip
    header = stamps.header(factory, stamp_ns, frame_id)
    return factory.make('nav_msgs/msg/OccupancyGrid', header=header, info=info, data=cells.reshape(-1))
