"""Makes visualization_msgs of a graph of poses, for RViz and Foxglove."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from msg_adapters import stamps
from msg_adapters.factory import MessageFactory

SPHERE_LIST, LINE_LIST, ADD, DELETE = 7, 5, 0, 2
NODE_M, LINE_M, LOOP_M = 0.03, 0.005, 0.015
NODE_COLOR, EDGE_COLOR, LOOP_COLOR = (0.2, 0.6, 1.0), (0.6, 0.6, 0.6), (1.0, 0.3, 0.1)


def graph(
    factory: MessageFactory, centres_m: NDArray[np.float64], edges: NDArray[np.integer], loops: NDArray[np.integer], *,
    stamp_ns: int, frame_id: str,
) -> Any:  # fmt: skip
    """Make a ``visualization_msgs/MarkerArray`` of three markers: nodes, edges and loops.

    Args:
        factory: makes the message.
        centres_m: [N, 3] positions of the nodes.
        edges: [E, 2] numbers of the nodes that edges connect.
        loops: [L, 2] the same of loops.
        stamp_ns: stamp of the markers.
        frame_id: frame that the positions are in.
    """
    header = stamps.header(factory, stamp_ns, frame_id)
    shapes = (
        ('keyframes', SPHERE_LIST, NODE_M, NODE_COLOR, centres_m),
        ('edges', LINE_LIST, LINE_M, EDGE_COLOR, centres_m[edges.reshape(-1)]),
        ('loops', LINE_LIST, LOOP_M, LOOP_COLOR, centres_m[loops.reshape(-1)]),
    )
    return factory.make('visualization_msgs/msg/MarkerArray', markers=[_marker(factory, header, *shape) for shape in shapes])


def _marker(
    factory: MessageFactory, header: Any, name: str, kind: int, size_m: float, color: tuple[float, ...], points: NDArray[np.float64]
) -> Any:
    red, green, blue = color
    still = factory.make('geometry_msgs/msg/Quaternion', x=0.0, y=0.0, z=0.0, w=1.0)
    return factory.make(
        'visualization_msgs/msg/Marker',
        header=header,
        ns=name,
        id=0,
        type=kind,
        action=ADD if len(points) else DELETE,  # RViz warns of markers without points
        pose=factory.make(
            'geometry_msgs/msg/Pose', position=factory.make('geometry_msgs/msg/Point', x=0.0, y=0.0, z=0.0), orientation=still
        ),
        scale=factory.make('geometry_msgs/msg/Vector3', x=size_m, y=size_m, z=size_m),
        color=factory.make('std_msgs/msg/ColorRGBA', r=red, g=green, b=blue, a=1.0),
        points=[factory.make('geometry_msgs/msg/Point', x=x, y=y, z=z) for x, y, z in points.tolist()],
    )
